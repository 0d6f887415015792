"""Pages of folders that were made up.

They are complete, self-contained, deterministic, from the files alone, and never of something older.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import time
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from mitsim.cli.commands import Pictured, command_line
from mitsim.core.colour_files import RUN, ColourManifest, write_colours
from mitsim.core.errors import MitsimError
from mitsim.core.exr import write_frame
from mitsim.core.files import write_json
from mitsim.core.images import lightness
from mitsim.core.job import Job
from mitsim.core.manifests import MANIFEST
from mitsim.core.runs import Recorder, load_run
from mitsim.report.folder_page import report_folder
from mitsim.report.pages import Picture, contact_sheet, lines_of, page_figure, stages_of, typeset
from mitsim.report.reconstruct_run import reconstruct
from mitsim.studies.framework.panels import Part, Section, write_page
from tests.exchanged import COLUMNS, DIGITAL, ROWS, Made, made

pytestmark = pytest.mark.usefixtures("draft_figures")
N = 32


class _Outside(HTMLParser):
    """Collects every attribute value that would make a browser load something, and unbalanced tags."""

    def __init__(self) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [value or "" for name, value in attrs if name in ("src", "href", "data", "srcset")]
        if tag not in ("meta", "img", "br", "link", "input", "hr"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, f"</{tag}> closes nothing"


def test_time_outside_all_stages_is_not_hidden() -> None:
    for stages, total, shown in (
        ({"a": 1.0, "b": 2.0}, 5.0, {"a": 1.0, "b": 2.0, "all else": 2.0}),
        ({"a": 1.0, "b": 0.006, "c": 0.009}, 1.015, {"a": 1.0, "all else": pytest.approx(0.015)}),
        ({"a": 1.0, "b": 2.0}, 3.02, {"a": 1.0, "b": 2.0}),
    ):
        assert stages_of({**stages, "total": total}) == {**shown, "total": total}
    assert stages_of({"a": 1.0}) == {"a": 1.0, "total": 1.0}


def test_numbers_of_findings_stand_to_the_right_and_words_to_the_left(tmp_path: Path) -> None:
    """A column of words after one of numbers does not go right."""
    rows = (("shot noise", "+7.4 +- 0.1", "2.8e+12", "1"), ("read noise", "nothing", "", "one"))
    part = Part("Title", "512 x 512 pixels", ("Source", "Lost", "Photons", "Runs"), rows, ("a.png",))
    assert part.numeric == (False, True, True, False)
    pictures = {"a.png": page_figure(Figure(figsize=(3.0, 2.0)))}
    section = Section("toy", "A study", "7 dB", "Scene toy", pictures, (part,), scene="toy", camera="Camera 4")
    page = write_page([section], tmp_path / "page.html", "A study").read_text(encoding="utf-8")
    assert (
        '<p class="verdict">7 dB</p>' in page
        and page.count('<th class="n">') == 2
        and page.count('<td class="n">') == 4
    )
    assert re.search(r"<title>A study: toy, Camera 4, \d{4}-\d\d-\d\d \d\d:\d\d</title>", page)
    assert "512 \u00d7 512 pixels" in page and "2.8\u00d710\u00b9\u00b2" in page and "wide small" in page


def test_warnings_of_findings_stand_at_the_head_and_notes_below_the_figures(tmp_path: Path) -> None:
    """(Planted: warnings on the command line alone.)"""
    part = Part("Title", "the lead", notes=("how to read it",))
    section = Section("toy", "A study", "", "Scene toy", {}, (part,), warnings=("losses: a cause is missing",))
    page = write_page([section], tmp_path / "page.html", "A study").read_text(encoding="utf-8")
    head, body = page.split("</header>")
    assert "Losses: a cause is missing." in head and body.index("the lead") < body.index("how to read it")


# ---- Pages of folders ----


EFFECTS = (
    {"name": "diffraction", "state": "exact", "reason": "openings of 60 um", "error_if_off": 0.1, "seconds": 0.8},
    {"name": "cells", "state": "approximate", "reason": "4x4 cells", "error_if_off": 1e-3, "seconds": 0.0},
    {"name": "mirrors", "state": "off", "reason": "there are none", "error_if_off": 0.0, "seconds": 0.0},
)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return made(tmp_path_factory.mktemp("shown"), ambient=True)


@pytest.fixture(scope="module")
def image(folders: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An image of these folders, in one of its own."""
    output = tmp_path_factory.mktemp("image") / "image"
    reconstruct(folders.run, folders.calibration, output, job=Job(command="mitsim reconstruct 'my run'"))
    return output


def copy(folder: Path, place: Path, **changes: Any) -> Path:
    """A copy of a ``folder`` in ``place``, its manifest with ``changes``."""
    shutil.copytree(folder, place)
    data = json.loads((place / MANIFEST).read_text())
    write_json(place / MANIFEST, {**data, **changes})
    return place


def page_of(folder: Path) -> str:
    """The page of a ``folder``, which loads nothing from elsewhere, closes its tags, and links to what is there."""
    text = report_folder(folder).read_text(encoding="utf-8")
    parser = _Outside()
    parser.feed(text)
    assert parser.open == [] and "<script" not in text and "url(" not in text
    links = [source for source in parser.sources if not source.startswith("data:image/png;base64,")]
    assert all((folder / unquote(link)).is_file() for link in links)
    return text


def words(page: str) -> str:
    """What a ``page`` says, without its style, pictures and tags."""
    text = re.sub(r"<style>.*?</style>|data:image/png;base64,[A-Za-z0-9+/=]+|<[^>]+>", " ", page, flags=re.S)
    return re.sub(r"\s+", " ", text)


def picture(folder: Path, name: str) -> np.ndarray:
    """A picture of a ``folder``'s page, by ``name``."""
    return np.asarray(Image.open(folder / "pictures" / f"{name}.png"))


def test_a_run_shows_its_frames_its_truth_and_how_it_was_made(folders: Made, tmp_path: Path) -> None:
    """(Planted: the command left out of the page.)"""
    command = "mitsim capture 'my scene' -o run"
    changes = {"command": command, "warnings": ["saturation: 3 frames"], "seconds": {"optics": 2.0, "total": 2.5}}
    plan = {"accuracy": 1e-3, "effects": [*EFFECTS, {"name": "of others"}]}
    run = copy(folders.run, tmp_path / "run", plan=plan, total_error_bound=8e-4, **changes)
    text = words(page_of(run))
    for wanted in (
        "Captured 6 frames of 40 \N{MULTIPLICATION SIGN} 52 pixels, total error up to 8.0\N{MULTIPLICATION SIGN}10⁻⁴",
        *("40 \N{MULTIPLICATION SIGN} 52 pixels", "accuracy 0.001 asked for", "exposure 0.0213 s a frame"),
        *("optics", "2.00 s", "all else", "0.50 s", "diffraction", "approximate", "digital.gain_dn_per_e 0.37"),
        "1 effects are off, because they change nothing here: mirrors",
    ):
        assert wanted in text, wanted
    head = words((run / "report.html").read_text().partition("</header>")[0])
    assert "Saturation: 3 frames." in head and "mitsim capture &#39;my scene&#39; -o run" in head
    names = {path.stem for path in (run / "pictures").iterdir()}
    assert names == {"frames", "frame", "ambient", "truth"} and "of others" not in text


def test_a_contact_sheet_is_of_the_frames_on_one_scale(folders: Made, tmp_path: Path) -> None:
    """Pattern by pattern, black at the black level. (Planted: the black level left in.)"""
    run = copy(folders.run, tmp_path / "run")
    text = words(page_of(run))
    sheet, shots = picture(run, "frames"), load_run(run)
    light = shots.dn - DIGITAL.black_level_dn
    # Two rows of three frames of 40 x 52 with 2 pixels between them, enlarged four times: 160 columns are below 512.
    copies = 4
    assert sheet.shape == (copies * (2 * ROWS + 2), copies * (3 * COLUMNS + 4))
    small = sheet[::copies, ::copies]
    for number, frame in enumerate(light):
        top, left = (place * (side + 2) for place, side in zip(divmod(number, 3), (ROWS, COLUMNS), strict=True))
        shown = small[top : top + ROWS, left : left + COLUMNS]
        assert np.abs(shown - 255 * lightness(frame / light.max())).max() < 0.51
    assert f"0 {light.max():.0f} DN above the black level Contact sheet." in text
    assert text.index("First frame.") < text.index("Contact sheet."), "results are first"


def test_many_frames_are_evenly_taken_and_large_ones_are_fewer_and_smaller() -> None:
    """(Planted: the first 64.)"""
    seen: list[int] = []

    def read(number: int) -> np.ndarray:
        """A frame that is its number."""
        seen.append(number)
        return np.full((8, 8), float(number))

    shown = contact_sheet(read, 640, (8, 8))
    assert sorted(seen) == list(range(0, 640, 10)) and "64 of 640 frames, evenly spaced, 8 in each row" in shown.caption
    seen.clear()
    large = contact_sheet(lambda number: read(number).repeat(256, 0).repeat(256, 1), 9, (2048, 2048))
    assert len(seen) == 4 and "4 of 9 frames" in large.caption
    assert max(Image.open(BytesIO(large.data)).size) <= 1024


def test_a_picture_says_what_is_black_white_and_beyond() -> None:
    """(Planted: the part beyond not counted.)"""
    values = np.array([[-1.0, 0.0], [0.5, 3.0]])
    shown = Picture.of("name", "Title", values, "what it is", "units")
    assert shown.caption == "what it is; 50 % of the pixels lie outside the scale"
    assert shown.ends == ("0", "1") and shown.scale == "black 0, white 1 units"
    levels = np.asarray(Image.open(BytesIO(shown.data)))
    assert levels.shape == (512, 512) and [*levels[0, ::256], *levels[-1, ::256]] == [0, 0, 188, 255]
    assert not np.asarray(Image.open(BytesIO(Picture.of("a", "A", 0 * values, ends=(None, None)).data))).any()


@pytest.mark.parametrize(
    ("quantity", "numbers", "colours"),
    [
        ("uncertainty", (0.0, 4.0), ((68, 1, 84), (253, 231, 37))),
        ("difference", (-2.0, 0.0, 2.0), ((0, 60, 94), (245, 245, 245), (110, 47, 0))),
        ("chi-square", (0.0, 1.0, 4.0), ((0, 60, 94), (245, 245, 245), (110, 47, 0))),
    ],
)
def test_a_quantity_chooses_its_colours(quantity: str, numbers: Any, colours: Any) -> None:
    """A diverging map is white at the number that is expected, which is not the middle of the numbers. (Planted: the
    middle of the scale in place of 1.)"""
    shown = Picture.of("a", "A", np.array([numbers]), "", "1", (numbers[0], numbers[-1]), quantity=quantity)
    assert shown.ends == tuple(f"{number:g}" for number in numbers)
    pixels = np.asarray(Image.open(BytesIO(shown.data)))
    assert [*map(tuple, pixels[0, :: pixels.shape[1] // len(numbers)][: len(numbers)].tolist())] == [*colours]


def test_a_title_has_scene_camera_and_date_and_every_picture_a_scale(
    folders: Made, image: Path, tmp_path: Path
) -> None:
    """The date is that of the files, so that a page that is made again has the same. (Planted: the present date; a
    picture without a scale.)"""
    made_at, camera = 1.7e9, {"name": "bench 3", "sensor": {"name": "Camera 4"}}
    changes = {"camera": camera, "configuration": {"scene": "/scenes/shelf/scene.xml"}}
    run = copy(folders.run, tmp_path / "run", **changes)
    calibration = copy(folders.calibration, tmp_path / "cal", **changes)
    solved = tmp_path / "image"
    shutil.copytree(image, solved)
    result = json.loads((solved / "result.json").read_text())
    write_json(solved / "result.json", {**result, "made_of": {**result["made_of"], "run": str(run)}})
    date = time.strftime("%Y-%m-%d %H:%M", time.localtime(made_at))
    for kind, folder, file in (
        ("Capture", run, MANIFEST),
        ("Calibration", calibration, MANIFEST),
        ("Image", solved, "result.json"),
    ):
        os.utime(folder / file, (made_at, made_at))
        page = page_of(folder)
        title = f"{kind}: shelf, Camera 4, {date}"
        assert f"<title>{title}</title>" in page and f"<h1>{title}</h1>" in page
        assert page.count('class="scale"') == page.count("<img ") > 0


def test_an_image_shows_what_is_known_of_it(image: Path) -> None:
    """The same files give the same page, byte for byte."""
    text = words(page_of(image))
    result = json.loads((image / "result.json").read_text())
    assert f"PSNR {result['psnr']:.2f} dB" in text
    assert typeset(result["headline"]) in text and "mitsim reconstruct &#39;my run&#39;" in text
    names = {path.stem for path in (image / "pictures").iterdir()}
    assert {"image", "truth", "error", "uncertainty", "misfit"} <= names
    assert picture(image, "image").shape == (37 * 10, 37 * 14), "14 pixels of 37 are 512 or more"
    before = (image / "report.html").read_bytes()
    assert report_folder(image).read_bytes() == before, "the same files, the same page"


def test_a_truth_is_shown_while_it_is_the_image_s_own(folders: Made, image: Path, tmp_path: Path) -> None:
    """Not of another run that has taken its place. (Planted: the fingerprint not compared.)"""
    other = copy(folders.run, tmp_path / "other", configuration_sha256="another")
    for run, there in ((folders.run, True), (other, False), (tmp_path / "gone", False)):
        place = tmp_path / f"image of {run.name}"
        shutil.copytree(image, place)
        result = json.loads((place / "result.json").read_text())
        write_json(place / "result.json", {**result, "made_of": {**result["made_of"], "run": str(run)}})
        text = words(page_of(place))
        assert ("The truth." in text) == there and (place / "pictures" / "truth.png").exists() == there
        assert "PSNR" in text, "which the image's files state"


def test_a_calibration_shows_its_factors(folders: Made, tmp_path: Path) -> None:
    """(Planted: the left factor twice.)"""
    calibration = copy(folders.calibration, tmp_path / "cal", result={"phi_error": 2.6e-3, "faults": [], "n": 10})
    text = words(page_of(calibration))
    assert (
        "factor error 2.6\N{MULTIPLICATION SIGN}10⁻³" in text
        and "10 projector rows (down) x 40 sensor rows (across)" in text
    )
    assert (
        picture(calibration, "left").shape == (10 * 13, 40 * 13) and picture(calibration, "right").shape[0] == 14 * 10
    )
    assert "The command is not known" in text


def test_a_flagged_calibration_says_so_at_the_head(folders: Made, tmp_path: Path) -> None:
    """In red, as a flagged image does, and once. (Planted: its estimate among the details.)"""
    flags = {
        "verdict": "mostly noise",
        "estimate": "Factors are mostly noise.",
        "warnings": ["Factors are mostly noise."],
    }
    page = page_of(copy(folders.calibration, tmp_path / "cal", **flags))
    assert words(page).count("Factors are mostly noise.") == 1 and "Flagged: factors are mostly noise" in words(page)
    assert '<p class="trouble">Factors are mostly noise.</p>' in page


def test_lines_and_depths_have_a_page_for_all_and_one_each(folders: Made, tmp_path: Path) -> None:
    """(Planted: pages of the lines left out.)"""
    coloured = tmp_path / "col"
    coloured.mkdir()
    for name in ("638nm", "520 nm?"):
        copy(folders.run, coloured / name, warnings=["dim"])
    lines = [{"name": name, "wavelength_nm": 520.0} for name in ("638nm", "520nm")]
    (coloured / "520 nm?").rename(coloured / "520nm")
    write_colours(coloured, ColourManifest.model_validate({"kind": RUN, "channels": lines}))
    text = words(page_of(coloured))
    assert "2 lines: 638nm, 520nm" in text and text.count("Dim.") == 1
    assert (coloured / "638nm" / "report.html").is_file() and (coloured / "520nm" / "pictures" / "frames.png").is_file()
    for name in ("400", "450"):
        copy(folders.calibration, tmp_path / "depths" / name)
    assert "2 depths: 400, 450 mm" in words(page_of(tmp_path / "depths"))


def test_a_page_is_gone_before_what_it_shows_changes(folders: Made, image: Path, tmp_path: Path) -> None:
    """A page of what was there before would be taken for one of what is. What others put beside stays. (Planted: kept
    by a run that begins again, and by an image that is written again.)"""
    run = copy(folders.run, tmp_path / "run")
    report_folder(run)
    (run / "pictures" / "note.txt").write_text("mine")
    Recorder(run, load_run(run).manifest).begin()
    assert not (run / "report.html").exists() and [each.name for each in (run / "pictures").iterdir()] == ["note.txt"]
    place = tmp_path / "image"
    shutil.copytree(image, place)
    report_folder(place)
    reconstruct(folders.run, folders.calibration, place, lam=0.5, overwrite=True)
    assert not (place / "report.html").exists() and not (place / "pictures").exists()


def test_a_full_disk_costs_the_page_alone(
    folders: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """(Planted: the error raised.)"""
    run = copy(folders.run, tmp_path / "run")
    report_folder(run)
    before, replace = {path.name for path in run.iterdir()} - {"report.html", "pictures"}, os.replace

    def full(source: Any, target: Any) -> None:
        if str(target).endswith("truth.png"):
            raise OSError(28, "No space left on device")
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        assert Pictured(as_json=True).finish_folder(run, {"headline": "said", "warnings": ()}, []) == 1
    out, err = capsys.readouterr()
    assert json.loads(out) == {"headline": "said", "warnings": [], "report": None}
    assert "No space left" in err and f"`mitsim report {run}` makes them later" in err
    assert {path.name for path in run.iterdir()} == before and load_run(run).dn.shape[0] == 6


def test_pictures_are_made_unless_nobody_wants_them(
    folders: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = copy(folders.run, tmp_path / "run")
    assert Pictured(no_pictures=True).finish_folder(run, {"headline": "said", "warnings": ()}, []) == 0
    assert capsys.readouterr().out == "said\n" and not (run / "report.html").exists()
    assert Pictured(as_json=True).finish_folder(run, {"headline": "", "warnings": ()}, []) == 0
    found = json.loads(capsys.readouterr().out)["report"]
    assert found["page"] == str(run / "report.html") and 0 < found["seconds"] < 60
    assert found["pictures"] == [
        str(run / "pictures" / f"{name}.png") for name in ("ambient", "frame", "frames", "truth")
    ]


def test_a_frame_in_one_file_has_its_picture_beside(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Named after the whole of its name: `render -o frame.exr` leaves `sense -o frame.png` alone. (Planted: .exr
    replaced by .png.)"""
    (tmp_path / "frame.png").write_bytes(b"another's")
    values = np.linspace(2.0, 4.0, 12).reshape(3, 4)
    assert Pictured().finish_frame((tmp_path / "frame.exr", values, "W/m^2"), {"warnings": ()}, ["said"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert said.endswith(f"picture {tmp_path / 'frame.exr.png'}: black 2, white 4 W/m^2")
    assert (tmp_path / "frame.png").read_bytes() == b"another's"
    colour = np.stack([values, 0 * values, values], axis=-1)
    assert Pictured(as_json=True).finish_frame((tmp_path / "c.exr", colour, "W/m^2"), {"warnings": ()}, []) == 0
    assert np.asarray(Image.open(json.loads(capsys.readouterr().out)["picture"]["file"])).shape == (384, 512, 3)


def test_plain_data_are_lines_of_a_table() -> None:
    data = {"a": {"b": True, "c_bytes": 3 * 2**20}, "d": None, "e": [1, 2.5], "f": [[1]], "g": [0] * 99, "h": 1 / 3}
    assert lines_of(data) == {"a.b": "yes", "a.c_bytes": "3 MiB", "e": "1, 2.5", "h": "0.333333"}


def test_the_command_is_kept_as_a_shell_takes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of this program alone: of another, which calls what serves it, nobody knows. (Planted: of any.)"""
    for program, known in (("/usr/bin/mitsim", True), ("mitsim/__main__.py", True), ("pytest/__main__.py", False)):
        monkeypatch.setattr("sys.argv", [program, "capture", "a b", "-D", "x=\x1b1"])
        assert command_line() == ("mitsim capture 'a b' -D 'x= 1'" if known else None)


def test_what_is_no_folder_of_ours_is_refused_and_left_alone(folders: Made, tmp_path: Path) -> None:
    (tmp_path / "study").mkdir()
    write_json(tmp_path / "study" / "accuracy.json", {})
    unfinished = copy(folders.run, tmp_path / "part", status="incomplete")
    for folder, words_of_it in (
        (tmp_path / "none", "no such folder"),
        (tmp_path / "study", "holds no run, calibration or image"),
        (unfinished, "finish it with resume=True"),
    ):
        with pytest.raises(MitsimError, match=words_of_it):
            report_folder(folder)
        assert not (folder / "report.html").exists() and not (folder / "pictures").exists()
    damaged = copy(folders.run, tmp_path / "damaged")
    write_frame(damaged / "truth.exr", {"reflectance": np.ones((2, 2), np.float32)}, {})
    with pytest.raises(MitsimError, match="checksum differs"):
        report_folder(damaged)
    assert not (damaged / "report.html").exists()
