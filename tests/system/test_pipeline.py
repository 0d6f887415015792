"""The main job on a small scene, by the commands a user types: capture, calibrate, reconstruct, render.

The laboratory: a print with shading, a disc and bars on 16 x 16 projector pixels, a 64 x 64 sensor 2 mm behind the
mask, Poisson and read noise, seed 0. Lower limits of image quality lie some 3 dB below what seeds 0 and 1 gave.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.core.exr import read_frame
from tests.system.refusals import Call

FAMILIES = {"uniform": (1, 30.0), "dots:4": (16, 62.0), "hadamard:4": (32, 55.0), "random:4": (16, 50.0)}
"""Frames, and the least PSNR [dB] of an image with automatic lambda."""


@pytest.fixture(scope="module")
def runs(
    call: Call, lab: Any, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], tuple[Path, dict[str, Any]]]:
    """Run folder and report of each family, captured once."""
    folder = tmp_path_factory.mktemp("runs")

    @cache
    def captured(patterns: str) -> tuple[Path, dict[str, Any]]:
        run = folder / patterns.replace(":", "")
        return run, call("capture", *lab.arguments, "-o", run, "--patterns", patterns, "--json").payload

    return captured


@pytest.fixture(scope="module")
def recover(call: Call, lab: Any, runs: Callable[[str], tuple[Path, Any]]) -> Callable[..., Any]:
    """Report of `mitsim reconstruct` on a family's run."""

    @cache
    def recovered(patterns: str, *options: object) -> dict[str, Any]:
        arguments = "--calibration", lab.calibration, "--overwrite", "--json", *options
        return call("reconstruct", runs(patterns)[0], *arguments).payload

    return recovered


@pytest.mark.parametrize("patterns", FAMILIES)
def test_every_family_is_captured_and_recovered(
    runs: Callable[[str], tuple[Path, Any]], recover: Callable[..., Any], patterns: str
) -> None:
    frames, least = FAMILIES[patterns]
    run, captured = runs(patterns)
    assert captured["frames"] == frames == len(list(run.glob("frame_*.exr")))
    assert captured["mc_error"] <= 0.005, "the accuracy that was asked for"
    found = recover(patterns)
    assert least < found["psnr"] < least + 20 and found["rank"] == 256
    image = read_frame(Path(found["output"]) / "image.exr")[0]["reflectance"]
    truth = read_frame(run / "truth.exr")[0]["reflectance"]
    # PSNR is peak 1 with no gain or offset fit, so that anyone can compute it from the files.
    assert found["psnr"] == pytest.approx(-10 * np.log10(np.mean((image - truth.astype(float)) ** 2)), abs=1e-3)


def test_detail_finer_than_a_projector_pixel_costs(call: Call, lab: Any, tmp_path: Path) -> None:
    """Three squares a pixel: uneven light in a pixel casts another shadow than the board's, and 66 dB become 49."""
    devices = lab.write_scene("detail", reflectance=lab.photograph(48)), *lab.electronics
    assert call("capture", *devices, "-o", tmp_path / "run", "--patterns", "dots:4").code == 0
    found = call("reconstruct", tmp_path / "run", "--calibration", lab.calibration, "--json").payload
    assert 46 < found["psnr"] < 56


def test_the_image_stands_upright(lab: Any, recover: Callable[..., Any]) -> None:
    """Row 0 of print, truth and image is the top, column 0 the left: no turn or mirror fits as well.

    The window shows the middle 120 mm of the 128 mm sheet; every projector pixel is the mean of what it lights.
    """
    from skimage.io import imread

    sheet = imread(lab.scene.parent / "laboratory_reflectance.png").astype(float) / 255
    fine = sheet[8:-8, 8:-8].reshape(16, 15, 16, 15).mean(axis=(1, 3))
    truth = read_frame(lab.run / "truth.exr")[0]["reflectance"]
    # The board has reflectance 0.99; what a pixel at an edge of the disc weighs differs a little with its place.
    assert np.sqrt(np.mean((truth - fine / 0.99) ** 2)) < 0.01
    image = read_frame(Path(recover("dots:4")["output"]) / "image.exr")[0]["reflectance"]
    assert np.sqrt(np.mean((image - fine / 0.99) ** 2)) < 0.02
    for other in (fine[::-1], fine[:, ::-1], fine.T, fine[::-1, ::-1]):
        assert np.sqrt(np.mean((image - other / 0.99) ** 2)) > 0.05


def test_a_flatcam_from_end_to_end(call: Call, lab: Any, tmp_path: Path) -> None:
    devices = lab.write_scene("flatcam", mask="flatcam"), *lab.electronics
    assert call("capture", *devices, "-o", tmp_path / "run", "--patterns", "dots:4").code == 0
    assert call("calibrate", *devices, "-o", tmp_path / "cal").code in (0, 1)
    assert json.loads((tmp_path / "cal" / "manifest.json").read_text())["centre"] is True
    found = call("reconstruct", tmp_path / "run", "--calibration", tmp_path / "cal", "--json").payload
    assert found["psnr"] > 30
