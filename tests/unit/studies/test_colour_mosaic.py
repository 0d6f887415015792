"""`mitsim reconstruct` of a run behind colour filters: lines that share every frame come apart; the page shows them."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.core.exr import read_frame
from mitsim.core.runs import load_mosaic
from mitsim.metrics import psnr
from mitsim.reconstruct.colour import ColourModel, chart, delta_e
from mitsim.report.reconstruct_run import ColourImage, reconstruct_colours
from tests.coloured import LINES, PLACE, WEIGHTS, mosaic_folders, scenes
from tests.unit.studies.test_colour_by_line import main

pytestmark = pytest.mark.usefixtures("draft_figures")


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return mosaic_folders(tmp_path_factory.mktemp("mosaic"))


def solved(pair: tuple[Path, Path], output: Path, **options: object) -> ColourImage:
    return reconstruct_colours(*pair, output, **options)  # type: ignore[arg-type]


def test_the_folder_holds_what_was_saved(pair: tuple[Path, Path]) -> None:
    found = load_mosaic(pair[0])
    assert np.array_equal(found.weights, WEIGHTS) and found.manifest.mosaic == "BGGR"
    truth = found.truth(0.5)
    assert truth is not None, "of a board of 0.99, told relative to one of half that"
    assert np.allclose(truth[..., 1], scenes()["520nm"] * 0.99 / 0.5, rtol=1e-6)


def test_lines_come_apart_and_have_their_colours(pair: tuple[Path, Path], tmp_path: Path) -> None:
    found = solved(pair, tmp_path / "image", chart=PLACE)
    for number, (name, truth) in enumerate(scenes().items()):
        assert psnr(found.images[..., number], truth) > 30
        kept = read_frame(tmp_path / "image" / name / "image.exr")[0]["reflectance"]
        assert np.allclose(kept, found.images[..., number], atol=1e-6)
    floor = delta_e(ColourModel.of_lines(LINES).xyz(chart().at(LINES)), chart().xyz)
    reported = json.loads((tmp_path / "image" / "colour.json").read_text())
    assert reported["kind"] == "colour-image" and reported["mosaic"] == "joint" and reported["psnr"] == found.psnr_db
    assert reported["delta_e_floor"] == pytest.approx(floor.mean()) and reported["delta_e_chart"] < floor.mean() + 1
    assert [patch["name"] for patch in reported["patches"]] == list(chart().names)
    assert reported["unexplained"] < 3.5e-3 and found.ok
    seen = found.delta_e
    assert seen is not None and reported["delta_e"] == pytest.approx(seen.mean())
    page = (tmp_path / "image" / "report.html").read_text()
    assert all(text in page for text in ("638 nm", "black 2", "The truth", "joint", "the chart in this image"))
    assert "data:image/png" in found._repr_html_() and "520nm" in found._repr_html_()


def test_lambda_is_found_from_the_data(pair: tuple[Path, Path], tmp_path: Path) -> None:
    """Within half a decibel of the best of a ladder. An image of other inputs is kept."""
    found = solved(pair, tmp_path / "image")
    before = (tmp_path / "image" / "colour.json").read_bytes()
    with pytest.raises(MitsimError, match=r"other inputs \(lambda differ\)"):
        solved(pair, tmp_path / "image", lam=1.0)
    assert json.loads(before)["inputs"] == json.loads((tmp_path / "image" / "colour.json").read_text())["inputs"]
    lam = found.solution["lambda"]
    steps = (0.1, 0.3, 3.0, 10.0)
    ladder = [solved(pair, tmp_path / "image", lam=lam * step, overwrite=True).psnr_db for step in steps]
    assert found.psnr_db > max(ladder) - 0.5, ladder


def test_a_real_camera_has_no_truth(tmp_path: Path) -> None:
    found = solved(mosaic_folders(tmp_path, truths=False), tmp_path / "image")
    assert found.psnr_db is None and found.delta_e is None and found.summary()["delta_e_chart"] is None
    page = (tmp_path / "image" / "report.html").read_text()
    assert "No truth to compare it with" in page and "The truth." not in page


def test_a_camera_that_does_not_explain_the_frames_is_flagged(pair: tuple[Path, Path], tmp_path: Path) -> None:
    """Lines that lend each other their factors are half a pixel off."""
    run, calibration = pair
    shutil.copytree(calibration, tmp_path / "cal")
    for name, other in (("638nm", "445nm"), ("445nm", "638nm")):
        shutil.rmtree(tmp_path / "cal" / name)
        shutil.copytree(calibration / other, tmp_path / "cal" / name)
    found = solved((run, tmp_path / "cal"), tmp_path / "image")
    assert not found.ok and "explained by no image of these lines" in found.warnings[0]


def test_the_command_line_tells_of_every_line(
    pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, calibration = pair
    command = ["reconstruct", str(run), "--calibration", str(calibration), "-o", str(tmp_path / "image")]
    assert main([*command, "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert [line["name"] for line in reported["channels"]] == ["638nm", "520nm", "445nm"]
    assert reported["mosaic"] == "joint" and reported["steps"] > 0 and reported["lambda"] > 0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--method", "tv"), "--method tv: runs behind colour filters are solved by tikhonov"),
        (("--focus", "auto"), "--focus auto: runs behind colour filters"),
        (("--lambda", "0"), "--lambda 0.0: behind colour filters give a finite number above 0"),
    ],
)
def test_what_filters_do_not_allow_is_refused(
    pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], words: str
) -> None:
    run, calibration = map(str, pair)
    assert main(["reconstruct", run, "--calibration", calibration, "-o", str(tmp_path / "image"), *options]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "image").exists()


def test_folders_that_do_not_fit_are_refused(pair: tuple[Path, Path], tmp_path: Path) -> None:
    run, calibration = pair
    shutil.copytree(calibration, tmp_path / "cal")
    path = tmp_path / "cal" / "520nm" / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "camera": {"sensor": {"mosaic": "RGGB"}}}))
    with pytest.raises(MitsimError, match=r"520nm: sensor.* is .*; calibrate the run's camera"):
        solved((run, tmp_path / "cal"), tmp_path / "image")
    named = json.loads((calibration / "colour.json").read_text())
    named["channels"].pop()
    (tmp_path / "cal" / "colour.json").write_text(json.dumps(named))
    with pytest.raises(MitsimError, match=r"its lines are 638nm, 520nm, but .* calibrate each line"):
        solved((run, tmp_path / "cal"), tmp_path / "image")


def test_a_manifest_has_a_weight_for_each_line(pair: tuple[Path, Path], tmp_path: Path) -> None:
    shutil.copytree(pair[0], tmp_path / "run")
    path = tmp_path / "run" / "colour.json"
    data = json.loads(path.read_text())
    path.write_text(json.dumps({**data, "weights": [row[:2] for row in data["weights"]]}))
    with pytest.raises(MitsimError, match="weights have 2, 2, 2, 2 numbers; give each of the four pixels one for each"):
        load_mosaic(tmp_path / "run")
