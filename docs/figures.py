"""Figures that the pages state: the commands and formulas that give them in, docs/figures.json and the pages out.

    python docs/figures.py [closed] [plan] [tour] [walks] [pictures]    all, unless some are named; `make figures`

*closed*: closed forms, a second. *plan*: two plans of the photograph, seconds. *tour*: a plan and README's commands, a
minute, and their outputs. *walks*: the commands of docs/bench.md through captures, half a minute, their outputs and
pictures. *pictures*: docs/images/make.py and drawings.py, three minutes. Seconds and memory on a page stay: they are an
idle machine's. tests/test_docs.py compares pages with the file, closed forms with the file and, slow, commands.
"""

from __future__ import annotations

import json
import math
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ROOT / "docs" / "figures.json"
IMAGES = ROOT / "docs" / "images"


@dataclass(frozen=True)
class Stated:
    """One place of a page that states a figure."""

    page: str
    words: str
    """Text around it, of which ``{}`` is the figure."""
    name: str
    """In the file of figures, as part.name."""
    form: str
    """Format specification; percent are stated of parts."""

    @property
    def pattern(self) -> re.Pattern[str]:
        """What finds it, whatever number stands there and wherever lines end."""
        before, after = (r"\s+".join(map(re.escape, part.split(" "))) for part in self.words.split("{}"))
        return re.compile(rf"({before})([-\d.]+(?:e[+-]?\d+)?)({after})")

    def text(self, figures: dict[str, dict[str, float]]) -> str:
        """The figure as this place states it."""
        part, name = self.name.split(".")
        value = f"{figures[part][name]:{self.form}}"
        return value.removesuffix("%").replace("e-0", "e-")


PHYSICS, EFFECTS, COLOUR = "docs/physics.md", "docs/effects.md", "docs/colour.md"
IMAGES_PAGE, BENCH, STUDIES = "docs/reconstruction.md", "docs/bench.md", "docs/studies.md"
STATED = (
    Stated("README.md", "# {}, as above", "tour.psnr_db", ".2f"),
    Stated(BENCH, "captures and calibrates itself it is {} dB", "tour.psnr_db", ".1f"),
    Stated(BENCH, "correlate with theirs at {} (red)", "walks.correlation_r", ".2f"),
    Stated(BENCH, "(red), {} and", "walks.correlation_gb", ".2f"),
    Stated(BENCH, "and {} (green)", "walks.correlation_gr", ".2f"),
    Stated(BENCH, "(green) and {} (blue)", "walks.correlation_b", ".2f"),
    Stated("docs/error_budget.md", "back to its causes: the PSNR of {} dB", "tour.psnr_db", ".2f"),
    Stated(COLOUR, "off by a Delta E of {} in the mean", "closed.delta_e_floor", ".2f"),
    Stated(COLOUR, "in the mean, {} at most", "closed.delta_e_floor_most", ".1f"),
    Stated(STUDIES, "three lines without a camera, is {} (red", "closed.delta_e_floor", ".2f"),
    Stated(EFFECTS, "from the geometric one by {} % (450 nm)", "closed.diffraction_450_nm", ".0%"),
    Stated(EFFECTS, "(450 nm) to {} % (640 nm)", "closed.diffraction_640_nm", ".0%"),
    Stated(PHYSICS, "One anchor leaves {} on the photograph", "plan.anchors", ".1e"),
    Stated(PHYSICS, "under `dots:7` and {} under uniform light", "plan.anchors_uniform", ".1e"),
    Stated(PHYSICS, "falls with $1/c^2$: {} for $c = 1$", "plan.cells", ".1e"),
    Stated(EFFECTS, "geometric shadow. It is off by {} for", "plan.diffraction", ".1e"),
    Stated(EFFECTS, "and `dots:7`, and by {} for `uniform`", "plan.diffraction_uniform", ".1e"),
    Stated(EFFECTS, "infinite contrast ({} off for `dots:7`)", "plan.black_level", ".1e"),
    Stated(EFFECTS, "three lines has $C = {}$ lit at once", "closed.speckle_white", ".3f"),
    Stated(EFFECTS, "lit at once and {} with a beam of", "closed.speckle_white_beam", ".4f"),
    Stated(IMAGES_PAGE, "| cookie_bag (`dots:7x16`) | {} dB |", "pictures.each_depth_psnr_db", ".1f"),
    Stated(IMAGES_PAGE, "| {} dB | 27.2 dB | 0.3 mm |", "pictures.one_depth_psnr_db", ".1f"),
    Stated(IMAGES_PAGE, "pixels in tan-angle. {} pixels from 363", "closed.parallax_cookie_bag", ".1f"),
)
"""Every place whose figure is another place's, or follows from a closed form."""


def read() -> dict[str, dict[str, float]]:
    """The file of figures."""
    figures: dict[str, dict[str, float]] = json.loads(FIGURES.read_text(encoding="utf-8"))
    return figures


def stale(figures: dict[str, dict[str, float]]) -> list[str]:
    """Places that state another figure than the file, or none."""
    found = []
    for place in STATED:
        matches = place.pattern.findall((ROOT / place.page).read_text(encoding="utf-8"))
        if [match[1] for match in matches] != [place.text(figures)]:
            found.append(f"{place.page}: {place.words!r}: {[match[1] for match in matches]}, not {place.text(figures)}")
    return found


def write_pages(figures: dict[str, dict[str, float]]) -> None:
    """Every stated figure as the file has it."""
    for place in STATED:
        page = ROOT / place.page
        value = place.text(figures)
        text, count = place.pattern.subn(
            lambda found, value=value: found[1] + value + found[3], page.read_text("utf-8")
        )
        if count != 1:
            raise SystemExit(f"{place.page}: {count} places state {place.words!r}; there should be one")
        page.write_text(text, encoding="utf-8")


# ---- closed forms ----------------------------------------------------------------------------------------------------


def closed() -> dict[str, float]:
    """Figures that follow from the shipped devices and the paper's geometry: no machine's."""
    import numpy as np

    from mitsim.core.configuration import load_model, shipped_path
    from mitsim.devices.camera import CameraGeometry, Devices
    from mitsim.devices.projector import Coherence, ProjectorModel, Spectrum
    from mitsim.devices.sensor import load_sensor
    from mitsim.optics.frames import contrast_of
    from mitsim.optics.shadow import Directions
    from mitsim.optics.terms import shadow_terms
    from mitsim.reconstruct.colour import ColourModel, chart, delta_e

    camera, n, window = CameraGeometry(), 128, 120.0
    projector = load_model(shipped_path("calibration", "mp_cl1.toml"), ProjectorModel)
    lines = projector.wavelengths_nm
    patches = delta_e(ColourModel.of_lines(lines).xyz(chart().at(lines)), chart().xyz)
    pitch = window / n / camera.scene_distance
    scene = Directions.cells((np.arange(n + 1) - n / 2) * pitch)

    def sided(nm: float) -> float:
        """How far the shadow of one side is from the geometric one."""
        line = Spectrum(np.array([nm]), np.array([1.0]))
        ((wave, _),), ((rays, _),) = (
            shadow_terms(camera, scene, scene, camera.scene_distance, light) for light in (line, None)
        )
        return float(np.linalg.norm(wave - rays) / np.linalg.norm(rays))

    def contrast(lit: Any, **coherence: float) -> float:
        devices = Devices(
            camera,
            load_sensor(shipped_path("calibration", "imx249.toml")),
            projector.model_copy(update={"speckle": Coherence(**coherence)}),
            "",
        )
        return contrast_of(devices, (window / n, window / n), lit)

    white = np.ones((n, n))
    return {
        "delta_e_floor": float(patches.mean()),
        "delta_e_floor_most": float(patches.max()),
        "diffraction_450_nm": sided(450.0),
        "diffraction_640_nm": sided(640.0),
        "speckle_white": contrast(white),
        "speckle_white_beam": contrast(white, beam_radius_mm=0.5),
        "parallax_cookie_bag": 60.0 * (1 / 363 - 1 / 451) / pitch,
    }


# ---- the tour of the command line ------------------------------------------------------------------------------------

_README = ROOT / "README.md"
TOUR = {"plan": ROOT / "docs" / "tour.md", "capture": _README, "calibrate": _README, "reconstruct": _README}
"""Pages that print a plan of cookie_bag, and of photograph all from scene to image with every figure at its default."""
STATUSES = ROOT / "docs" / "howto.md"
"""The page that has the table of exit statuses."""
_BLOCK = r"^    \$ mitsim ({verb} .*)\n((?:    (?!\$ ).*\n)*)"
_MACHINE = re.compile(
    r"\b(?:in |0\.001: )[\d.]+ s\b|(?<=e[+-]\d\d) +\d+\.\d\d(?= )|(?<= [-0]) +\d+\.\d\d(?= )|"
    r"\bSeconds:(?: \w+ [\d.e-]+,?)+|\bAt most [\d.]+ GiB|\b\d+ kernels were compiled .*? are kept"
)
"""Parts of an output that depend on the machine and its caches, and not on the scene."""
_NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def printed(verb: str) -> tuple[str, str]:
    """The command line of a ``verb`` of the tour, and the output under it."""
    found = re.search(_BLOCK.format(verb=verb), TOUR[verb].read_text(encoding="utf-8"), flags=re.M)
    assert found, f"{TOUR[verb]} has no command of {verb}"
    return found[1], found[2]


def outputs(folder: Path) -> Iterator[tuple[str, str]]:
    """Each verb of the tour, and what its command prints in ``folder``."""
    for verb in TOUR:
        command = [sys.executable, "-m", "mitsim", *shlex.split(printed(verb)[0]), "--quiet"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{shlex.join(command)}: {done.returncode}\n{done.stderr}"
        yield verb, done.stdout


def differences(reported: str, now: str) -> list[str]:
    """Figures of an output ``now`` that differ from those ``reported`` by more than one of the last digit printed, or
    the sentences, where those differ."""
    texts = [" ".join(_MACHINE.sub("", " ".join(text.split())).split()) for text in (reported, now)]
    sentences = [_NUMBER.sub("#", text) for text in texts]
    if sentences[0] != sentences[1]:
        return [f"{sentences[0]}\n{sentences[1]}"]
    pairs = zip(*(_NUMBER.findall(text) for text in texts), strict=True)
    return [f"{old} -> {new}" for old, new in pairs if abs(float(old) - float(new)) > 1.001 * last_digit(old)]


def last_digit(number: str) -> float:
    """What one of the last printed digit is worth; a whole number's is 1."""
    mantissa, _, exponent = number.partition("e")
    return math.pow(10, int(exponent or 0) - len(mantissa.partition(".")[2]))


def statuses(folder: Path) -> dict[str, str]:
    """Sentences in the table of exit statuses whose figures differ, and what their commands say now."""
    found, page = {}, STATUSES.read_text(encoding="utf-8")
    rows = re.findall(r'^\| \d \|.*\| `mitsim ([^`]+)`: "([^"]+)" \|$', page, flags=re.M)
    for command, sentence in rows:
        program = [sys.executable, "-m", "mitsim", *shlex.split(command)]
        done = subprocess.run(program, cwd=folder, capture_output=True, text=True, check=False)
        words = re.escape(_NUMBER.sub("#", sentence)).replace(re.escape("#"), _NUMBER.pattern)
        now = re.search(words, " ".join(done.stderr.split()))
        found |= {sentence: now[0]} if now and now[0] != sentence else {}
    return found


def tour_figures() -> dict[str, float]:
    """What stands under the tour's commands, as numbers."""
    text = " ".join(" ".join(printed(verb)[1] for verb in TOUR).split())
    patterns = {
        "psnr_db": r"PSNR ([\d.]+) dB",
        "ssim": r"SSIM ([\d.]+),",
        "truth_db": r"truth good to ([\d.]+) dB",
        "mc_error": r"Monte Carlo error ([\d.e+-]+),",
        "factor_error": r"factor error ([\d.e+-]+)",
        "uncertainty": r"Standard uncertainty ([\d.e+-]+) rms",
    }
    return {name: float(re.findall(pattern, text)[0]) for name, pattern in patterns.items()}


def tour(work: Path) -> dict[str, float]:
    """The tour's commands run in ``work``; their outputs stand on its pages then."""
    for line, now in statuses(work).items():
        sys.stdout.write(f"{line} -> {now}\n")
        STATUSES.write_text(STATUSES.read_text(encoding="utf-8").replace(line, now), encoding="utf-8")
    for verb, now in outputs(work):
        for difference in differences(printed(verb)[1], now):
            sys.stdout.write(f"{verb}: {difference}\n")
        page = TOUR[verb]
        page.write_text(updated(page.read_text(encoding="utf-8"), verb, now), encoding="utf-8")
    return tour_figures()


def updated(page: str, verb: str, now: str) -> str:
    """The ``page`` with the output ``now`` of a ``verb``, the machine's figures too."""
    command, old = printed(verb)
    lines = "".join(f"    {line}\n" for line in now.splitlines())
    return page.replace(f"    $ mitsim {command}\n{old}", f"    $ mitsim {command}\n{lines}")


def plan(work: Path) -> dict[str, float]:
    """What the photograph's frames lose with one anchor, one cell a pixel, or an effect off, by its plans at 1e-3."""

    def errors(patterns: str) -> dict[str, float]:
        program = [sys.executable, "-m", "mitsim", "plan", "photograph", "--patterns", patterns, "--json", "--quiet"]
        done = subprocess.run(program, cwd=work, capture_output=True, text=True, check=True)
        return {row["name"].replace("-", "_"): row["error_if_off"] for row in json.loads(done.stdout)["effects"]}

    dots, uniform = errors("dots:7"), errors("uniform")
    names = ("anchors", "cells", "diffraction", "black_level")
    return {name: dots[name] for name in names} | {
        f"{name}_uniform": uniform[name] for name in ("anchors", "diffraction")
    }


# ---- walks of docs/bench.md through captures -------------------------------------------------------------------------

WALKS = "## 2. A FlatCam", "## 3. A DiffuserCam"
_EXAMPLE = re.compile(r"^    \$ mitsim (.*)\n((?:    (?!\$ ).*\n)*)", flags=re.M)
LEFT_OUT = "..."
"""What a page prints in the place of words that it leaves out."""


def section(page: str, heading: str) -> str:
    """What stands on a ``page`` under a ``heading`` of the second level."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return text.partition(f"\n{heading}\n")[2].partition("\n## ")[0]


def examples(text: str) -> list[tuple[str, str]]:
    """Commands after `mitsim` in a ``text``, and the output under each."""
    return _EXAMPLE.findall(text)


def put_inputs(heading: str, folder: Path) -> None:
    """What the commands of a walk read: the captures and the walk's list, in ``folder``."""
    if not (folder / "captures").exists():
        (folder / "captures").symlink_to(ROOT / "captures")
    for listed in re.findall(r"^```toml\n(.*?)^```", section(BENCH, heading), flags=re.M | re.S):
        (folder / "known.toml").write_text(listed, encoding="utf-8")


def walked(heading: str, folder: Path) -> Iterator[tuple[str, str, str]]:
    """Each command of a walk, the output under it, and what it prints now in ``folder``."""
    put_inputs(heading, folder)
    for command, reported in examples(section(BENCH, heading)):
        program = [sys.executable, "-m", "mitsim", *shlex.split(command), "--quiet"]
        done = subprocess.run(program, cwd=folder, capture_output=True, text=True, check=False)
        yield command, reported, done.stdout + done.stderr


def pairs(reported: str, now: str) -> list[tuple[str, str]]:
    """Each figure of an output that a page has, and the same of the output ``now``; seconds are the machine's.

    ValueError where other words are printed, but for those that the page leaves out.
    """
    texts = [" ".join(_MACHINE.sub("", " ".join(text.split())).split()) for text in (reported, now)]
    words = re.escape(_NUMBER.sub("#", texts[0])).replace(re.escape("#"), f"({_NUMBER.pattern})")
    found = re.fullmatch(words.replace(re.escape(LEFT_OUT), ".*?"), texts[1])
    if not found:
        raise ValueError(f"a page has\n{texts[0]}\nand its command prints\n{texts[1]}")
    return list(zip(_NUMBER.findall(texts[0]), found.groups(), strict=True))


def correlations(folder: Path) -> dict[str, float]:
    """Of the planes of capture 7's image in ``folder`` with its authors' image."""
    import numpy as np
    from PIL import Image

    from mitsim.core.exr import read_frame

    theirs = np.array(Image.open(folder / "captures" / "flatcam" / "rec_7.png"), float)
    found = {}
    for name, colour in {"r": 0, "gb": 1, "gr": 1, "b": 2}.items():
        ours = read_frame(folder / "run7" / "reconstruction" / name / "image.exr")[0]["reflectance"]
        found[name] = float(np.corrcoef(ours.ravel(), theirs[..., colour].ravel())[0, 1])
    return found


def walks(work: Path) -> dict[str, float]:
    """The walks' commands run in ``work``; their figures stand in bench.md then, and their pictures are drawn."""
    page, work = ROOT / BENCH, work / "walks"  # the tour has folders of the same names
    work.mkdir()
    for heading in WALKS:
        for command, reported, now in walked(heading, work):
            new = iter([figure for _, figure in pairs(reported, now)])
            words = re.sub(
                f"({_MACHINE.pattern})|{_NUMBER.pattern}",
                lambda found, new=new: found[0] if found[1] else next(new),
                reported,
            )
            text = page.read_text(encoding="utf-8")
            page.write_text(text.replace(f"{command}\n{reported}", f"{command}\n{words}"), encoding="utf-8")
    subprocess.run([sys.executable, str(IMAGES / "make.py"), str(work), "flatcam", "diffusercam"], check=True)
    return {f"correlation_{name}": value for name, value in correlations(work).items()}


# ---- pictures --------------------------------------------------------------------------------------------------------


def titles(picture: str) -> list[float]:
    """Decibels in the titles of a picture, which its file holds as text."""
    from PIL.PngImagePlugin import PngImageFile

    return [float(psnr) for psnr in re.findall(r": ([\d.]+) dB", PngImageFile(IMAGES / picture).text["Description"])]


def picture_figures() -> dict[str, float]:
    """The figures in the titles of the pictures of README and of the tour."""
    names = ("uniform_psnr_db", "dots_psnr_db"), ("one_depth_psnr_db", "each_depth_psnr_db")
    values = titles("demo.png"), titles("depth.png")
    return {name: value for pair in zip(names, values, strict=True) for name, value in zip(*pair, strict=True)}


def pictures(work: Path) -> dict[str, float]:
    """The pages' pictures and all drawings, made anew; runs that are in ``work`` are used."""
    for script, *arguments in (["make.py", str(work)], ["drawings.py"]):
        subprocess.run([sys.executable, str(IMAGES / script), *arguments], check=True)
    return picture_figures()


WAYS = {"closed": lambda _: closed(), "plan": plan, "tour": tour, "walks": walks, "pictures": pictures}


def main() -> None:
    parts = sys.argv[1:] or list(WAYS)
    figures = read() if FIGURES.exists() else {}
    with tempfile.TemporaryDirectory() as folder:
        for part in parts:
            figures[part] = WAYS[part](Path(folder))
    # Six digits: the last ones are the machine's BLAS's.
    kept = {part: {name: float(f"{value:.6g}") for name, value in of.items()} for part, of in figures.items()}
    FIGURES.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    write_pages(figures)


if __name__ == "__main__":
    main()
