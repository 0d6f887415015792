"""`mitsim study twin` on real captures, where these are; what is no such folder is refused in a line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from tests.system.refusals import Refused, mentions

SHARED = next(
    (each / "shared" / "data" for each in Path(__file__).resolve().parents if (each / "shared" / "data").is_dir()),
    Path("shared/data"),
)
"""Beside the project, or above; public, and too large for it."""


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason="real captures are not there")
def test_real_captures_are_predicted(call: Callable[..., Any], tmp_path: Path) -> None:
    """Codes of one FlatCam capture predict every plane of the other far better than its neighbour's scene does, and
    only half as much energy again as noise is left; a diffuser's contrast and brightest pixels are within a fifth. The
    codes are those of `mitsim import --list flatcam` and `mitsim calibrate --known` with one term: scales, and numbers
    that frames tell."""
    found = call("study", "twin", "--data", SHARED, "-o", tmp_path / "out", "--json", "--quiet").payload
    frames = {row["frame"]: row for row in found["captures"]}
    assert len(frames) == 8
    for row in frames.values():
        assert row["correlation"] > row["correlation_other_scene"] + 0.15
        assert 1.3 < row["chi_square"] < 1.7 and row["render_error"] < 0.06
        assert sum(row["parts"].values()) == pytest.approx(1)
    for name, least in {"fc_6 gb": 0.875, "fc_6 gr": 0.875, "fc_7 gb": 0.805, "fc_7 gr": 0.805}.items():
        assert frames[name]["correlation"] > least
    for name in ("contrast", "brightest"):
        numbers = found["diffuser"][name]
        assert numbers["simulated"] == pytest.approx(numbers["measured"], rel=0.2)

    flatcam = SHARED / "flatcam"
    call("import", flatcam / "fc_7.png", "--list", "flatcam", "-o", tmp_path / "run", "--json", "--quiet")
    (tmp_path / "known.toml").write_text(
        f'centre = true\nterms = 1\n[[known]]\nrun = "run"\npicture = "{(flatcam / "rec_7.png").as_posix()}"\n'
    )
    known = call("calibrate", "--known", tmp_path / "known.toml", "-o", tmp_path / "cal", "--json", "--quiet")
    learned = found["learned"]["fc_6"]
    assert learned["orientation"] == known.payload["orientation"]
    assert learned["scale"] == pytest.approx(known.payload["scale"], rel=1e-9)
    assert learned["told"] == pytest.approx(known.payload["told"], rel=1e-6)


def test_what_is_no_capture_is_refused_in_a_line(refused: Refused, tmp_path: Path) -> None:
    """A folder with neither camera, a point spread function that is cut short or in colour, captures of another size:
    status 2, nothing written."""

    def mentioned(*words: str) -> None:
        mentions(refused("study", "twin", "--data", tmp_path, "-o", tmp_path / "out"), *words)
        assert not (tmp_path / "out").exists()

    mentioned("has no captures", "flatcam/fc_6.png", "diffusercam/psf_sample.tif")
    psf = tmp_path / "diffusercam" / "psf_sample.tif"
    psf.parent.mkdir()
    Image.new("I;16", (400, 300), 100).save(psf)
    psf.write_bytes(psf.read_bytes()[:2000])
    mentioned(str(psf))
    Image.new("RGB", (400, 300)).save(psf)
    mentioned(str(psf), "is in colour", "grey")
    psf.unlink()
    flatcam = tmp_path / "flatcam"
    flatcam.mkdir()
    for number in (6, 7):
        Image.new("I;16", (800, 600), 100).save(flatcam / f"fc_{number}.png")
        Image.new("RGB", (256, 256)).save(flatcam / f"rec_{number}.png")
    mentioned("fc_6.png", "600 x 800", "1024 x 1280")
