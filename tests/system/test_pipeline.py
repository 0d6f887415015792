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


def test_the_brightest_pixel_is_at_the_fraction_of_full_well(
    call: Call, lab: Any, runs: Callable[[str], tuple[Path, Any]], tmp_path: Path
) -> None:
    full_well = 4 * 32360.0
    for run, fraction in ((runs("dots:4")[0], 0.8), (tmp_path / "dim", 0.25)):
        if not run.exists():
            options = "--patterns", "dots:4", "--exposure-fraction", fraction
            assert call("capture", *lab.arguments, "-o", run, *options).code == 0
        peak = max(read_frame(path)[0]["electrons"].max() for path in run.glob("frame_*.exr"))
        # Dark current, 6 electrons a second, is the rest.
        assert peak == pytest.approx(fraction * full_well, rel=1e-4)


def test_a_second_reconstruction_replaces_the_first_when_it_is_asked_to(
    call: Call, lab: Any, runs: Callable[[str], tuple[Path, Any]], tmp_path: Path
) -> None:
    """Of the same inputs at once; of others with --overwrite alone, and the refusal says what differs."""
    run, image = runs("dots:4")[0], tmp_path / "image"
    options = "--calibration", lab.calibration, "-o", image, "--json"

    def written() -> object:
        return json.loads((image / "result.json").read_text())["lambda"]

    for _ in range(2):
        call("reconstruct", run, *options, "--lambda", 1.0)
        assert written() == 1.0
    before = {path.name: path.read_bytes() for path in image.iterdir()}
    for other, differ in (
        (("--lambda", 1e9), "lambda differ"),
        (("--lambda", 1.0, "--method", "tv"), "method differ"),
        ((), "lambda differ"),
    ):
        line = call("reconstruct", run, *options, *other).refusal
        assert str(image) in line and f"({differ})" in line and "--overwrite" in line
    line = call("reconstruct", runs("hadamard:4")[0], *options, "--lambda", 1.0).refusal
    assert "(run differ)" in line
    assert {path.name: path.read_bytes() for path in image.iterdir()} == before
    call("reconstruct", run, *options, "--lambda", 1e9, "--overwrite")
    assert written() == 1e9


def test_a_flatcam_from_end_to_end(call: Call, lab: Any, tmp_path: Path) -> None:
    devices = lab.write_scene("flatcam", mask="flatcam"), *lab.electronics
    assert call("capture", *devices, "-o", tmp_path / "run", "--patterns", "dots:4").code == 0
    assert call("calibrate", *devices, "-o", tmp_path / "cal").code in (0, 1)
    assert json.loads((tmp_path / "cal" / "manifest.json").read_text())["centre"] is True
    found = call("reconstruct", tmp_path / "run", "--calibration", tmp_path / "cal", "--json").payload
    assert found["psnr"] > 30


@pytest.mark.slow
def test_both_estimators_render_the_same_frame(call: Call, lab: Any, tmp_path: Path) -> None:
    """Under uniform light both estimators see the same irradiance, but for diffraction, which the reference lacks.

    The mean over the frame, and the frame's projection on the factored one: each within 5 standard errors of the
    reference (two tests, two-sided significance 1e-6), which are the only noise that matters here.
    """
    frames = {}
    factored_as = "--accuracy", "0.0001", "--effects", "-diffraction"
    for name, options in {"reference": ("--spp", 1024), "factored": factored_as}.items():
        outcome = call("render", lab.scene, "-o", tmp_path / f"{name}.exr", "--estimator", name, *options, "--json")
        frames[name] = read_frame(tmp_path / f"{name}.exr")[0]
        assert outcome.payload["mean"] == pytest.approx(float(frames[name]["Y"].mean()), rel=1e-5)
    reference, factored = (frames[name]["Y"].astype(float) for name in ("reference", "factored"))
    error = frames["reference"]["error.Y"].astype(float)
    for weight in (np.ones_like(factored), factored):
        z = ((reference - factored) * weight).sum() / np.sqrt(np.square(error * weight).sum())
        assert abs(z) < 5, z
