"""Factors by known pictures on public captures of a real camera, where these are: learned from one, judged by the
other, whose image by the authors' own calibration is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsim import calibrate_known, load_calibration, load_run, reconstruct
from mitsim.core.configuration import shipped_path
from tests.known_camera import write_known
from tests.system.refusals import Call

CAPTURES = next(
    (path for parent in Path(__file__).resolve().parents if (path := parent / "shared/data/flatcam").is_dir()), None
)
"""Beside the project; public, and too large for it."""
pytestmark = pytest.mark.skipif(CAPTURES is None, reason="real captures are not there")
PLANES = ("r", "gb", "gr", "b")


def captured(number: int, call: Call, folder: Path, **more: object) -> Path:
    """The RUN folder of a capture, imported by the shipped list with what ``more`` says of `[prepare]` in place of its
    own words."""
    text = shipped_path("calibration", "flatcam.toml").read_text()
    for name, value in more.items():
        before = next(line for line in text.splitlines() if line.startswith(f"{name} = "))
        text = text.replace(before, f"{name} = {value}")
    (folder / "list.toml").write_text(text)
    run = folder / f"run_{number}_{len([*folder.iterdir()])}"
    call("import", CAPTURES / f"fc_{number}.png", "--list", folder / "list.toml", "-o", run, "--json", "--quiet")
    return run


def listing(folder: Path, run: Path, picture: Path, **more: object) -> Path:
    return write_known(folder / f"{run.name}.json", [{"run": run.name, "picture": str(picture)}], **more)


def likeness(image: np.ndarray, number: int, plane: str) -> float:
    """Correlation of an ``image`` with the authors', whose files hold nothing below 0."""
    theirs = np.asarray(Image.open(CAPTURES / f"rec_{number}.png"), dtype=float)[..., "rgb".index(plane[0])]
    return float(np.corrcoef(np.maximum(image, 0).ravel(), theirs.ravel())[0, 1])


POSE = {"orientation": "turned", "scale": [0.473, 0.475], "terms": 1}
"""As the search of the slow test finds them."""
HALF = "{row = 80, column = 100, rows = 340, columns = 420}"


@pytest.mark.slow
def test_half_of_one_plane_tells_the_code(call: Call, tmp_path: Path) -> None:
    """Correlations with the authors' image of the capture that was not learned from were 0.933 and 0.963."""
    runs = {number: captured(number, call, tmp_path, channel='"gb"', crop=HALF) for number in (6, 7)}
    greens = {}
    for number in (6, 7):
        greens[number] = tmp_path / f"green_{number}.png"
        Image.fromarray(np.asarray(Image.open(CAPTURES / f"rec_{number}.png"))[..., 1]).save(greens[number])
    for learned, judged, least in ((6, 7, 0.92), (7, 6, 0.95)):
        listed = listing(tmp_path, runs[learned], greens[learned], centre=True, **POSE)
        (factors,) = calibrate_known(listed, tmp_path / f"cal_{learned}").values()
        image = reconstruct(load_run(runs[judged]), load_calibration(tmp_path / f"cal_{learned}")).image
        assert likeness(image, judged, "g") > least
        assert not factors.ok  # its noise is not stated, and pictures by another calibration lack what that took away


@pytest.mark.slow
@pytest.mark.parametrize(("learned", "judged"), [(6, 7), (7, 6)])
def test_the_other_capture_is_as_its_authors_have_it(call: Call, tmp_path: Path, learned: int, judged: int) -> None:
    """All of it automatic: how pictures lie, scales, codes, their weights, and that of the image. 42 s each."""
    runs = {number: captured(number, call, tmp_path) for number in (6, 7)}
    listed = listing(tmp_path, runs[learned], CAPTURES / f"rec_{learned}.png", centre=True)
    done = call("calibrate", "--known", listed, "-o", tmp_path / "cal", "--json", "--quiet")
    assert done.payload["orientation"] == "turned"
    assert done.payload["scale"] == pytest.approx([0.473, 0.475], abs=0.003)
    assert done.payload["chi_square"] < 2
    found = {}
    for plane in PLANES:
        factors = load_calibration(tmp_path / "cal" / plane)
        found[plane] = likeness(reconstruct(load_run(runs[judged] / plane), factors).image, judged, plane)
    assert min(found.values()) > 0.93, found
