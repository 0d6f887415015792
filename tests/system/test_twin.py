"""`mitsim study twin` on real captures, where these are; what is no such folder is refused in a line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage
from skimage import data
from skimage.transform import resize

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
    frames = {row["frame"]: row for row in found["rows"] if row["kind"] == "frame"}
    assert len(frames) == 8
    for row in frames.values():
        assert row["correlation"] > row["correlation_other_scene"] + 0.15
        assert 1.3 < row["chi_square"] < 1.7 and row["render_error"] < 0.06
        assert sum(part for name, part in row.items() if name.startswith("part_")) == pytest.approx(1)
    for name, least in {"fc_6 gb": 0.875, "fc_6 gr": 0.875, "fc_7 gb": 0.805, "fc_7 gr": 0.805}.items():
        assert frames[name]["correlation"] > least
    assert {claim["verdict"] for claim in found["claims"]} == {"confirmed"} and len(found["claims"]) == 4

    flatcam = SHARED / "flatcam"
    call("import", flatcam / "fc_7.png", "--list", "flatcam", "-o", tmp_path / "run", "--json", "--quiet")
    (tmp_path / "known.toml").write_text(
        f'centre = true\nterms = 1\n[[known]]\nrun = "run"\npicture = "{(flatcam / "rec_7.png").as_posix()}"\n'
    )
    known = call("calibrate", "--known", tmp_path / "known.toml", "-o", tmp_path / "cal", "--json", "--quiet")
    learned = frames["fc_6 gb"]
    assert learned["orientation"] == known.payload["orientation"]
    for name, error in (("scale", 1e-9), ("told", 1e-6)):
        assert [learned[f"{name}_{side}"] for side in ("rows", "columns")] == pytest.approx(
            known.payload[name], rel=error
        )


def simulated(folder: Path) -> None:
    """Two captures and their images, by numpy alone: random steps of two pixels as codes, seen through shifts by each
    plane of a mosaic at its place; images upside down; shot noise of 0.09 DN an electron; 10 bits, shifted to 16."""
    draws = np.random.default_rng(11)
    codes = [ndimage.gaussian_filter1d(np.repeat(draws.choice([-1, 1], 420), 2).astype(float), 0.7) for _ in range(2)]
    for number, picture in ((6, data.astronaut()), (7, data.coffee()[:400, 100:500])):
        image = np.round(resize(picture / 255, (256, 256), anti_aliasing=True) * 255).astype(np.uint8)
        Image.fromarray(image[::-1]).save(folder / f"rec_{number}.png")
        raw = np.zeros((1024, 1280))
        for (row, column), channel in {(0, 0): 2, (0, 1): 1, (1, 0): 1, (1, 1): 0}.items():
            left, right = (
                np.interp(np.arange(count)[:, None] + place / 2 + scale * np.arange(256), np.arange(len(code)), code)
                for code, scale, place, count in zip(codes, (0.6, 0.55), (row, column), (512, 640), strict=True)
            )
            coded = left @ (image[..., channel] / 255) @ right.T
            coded *= 12 / (coded - coded.mean(axis=0) - coded.mean(axis=1, keepdims=True) + coded.mean()).std()
            light = np.maximum(400 + coded - coded.mean(), 20)
            raw[row::2, column::2] = 0.09 * draws.poisson(light / 0.09)
        Image.fromarray((np.clip(np.round(raw), 0, 1023) * 64).astype(np.uint16)).save(folder / f"fc_{number}.png")


@pytest.mark.slow
def test_simulated_captures_leave_their_noise_alone(call: Callable[..., Any], tmp_path: Path) -> None:
    """Of two captures that other code drew, every frame is predicted but for its noise: a tenth of its energy."""
    (tmp_path / "flatcam").mkdir()
    simulated(tmp_path / "flatcam")
    found = call("study", "twin", "--data", tmp_path, "-o", tmp_path / "out", "--json", "--quiet").payload
    assert len(found["rows"]) == 8
    for row in found["rows"]:
        assert row["correlation"] > 0.94 and row["chi_square"] < 1.15
        assert 0.09 < row["noise"] < 0.11 and abs(row["part_rest"]) < 0.005
    for each in found["rows"]:
        assert each["orientation"] == "upside down"
        assert [each["scale_rows"], each["scale_columns"]] == pytest.approx([0.6, 0.55], rel=2e-3)


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
    mentioned("fc_6.png", "(600, 800)", "(1024, 1280)")
