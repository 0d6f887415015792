"""Planned sessions against the prediction of their images, and against sessions that are run."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mitsim as ms
from mitsim.calibrate.board_session import Session
from mitsim.core.errors import ArgumentError
from mitsim.design.predict import Stand
from mitsim.devices.session import MOST_REPEATS, Drift, SessionRecipe, load_recipe, recipe_text


def test_a_recipe_is_written_as_it_is_read(tmp_path: Path) -> None:
    recipe = load_recipe().model_copy(
        update={"exposure_fraction": 1.23e-5, "repeats": 7, "source": 'a "word", and \\ more'}
    )
    file = tmp_path / "recipe.toml"
    file.write_text(recipe_text(recipe), encoding="utf-8")
    assert load_recipe(file) == recipe
    fields = {name: field.default for name, field in SessionRecipe.model_fields.items() if not field.is_required()}
    file.write_text(recipe_text(recipe.model_copy(update=fields)), encoding="utf-8")
    assert load_recipe(file) == recipe.model_copy(update=fields)


def test_a_quality_that_no_image_has_is_refused(bench: Any) -> None:
    for psnr in (0.0, 101.0, float("nan")):
        with pytest.raises(ArgumentError, match="give 1 to 100 dB"):
            ms.plan_calibration(bench, psnr)


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str) -> Any:
    steps = np.kron(np.random.default_rng(3).integers(30, 220, (8, 8)), np.ones((2, 2)))
    return ms.open_bench(shared_scene("planned", n=16, reflectance=steps), variant)


@pytest.fixture(scope="module")
def plan(bench: Any, kept_plans: None) -> ms.CalibrationPlan:
    return ms.plan_calibration(bench, 30.0, "dots:2", accuracy=0.005)


def changed(**more: object) -> SessionRecipe:
    return load_recipe().model_copy(update=more)


@pytest.mark.parametrize("fraction", [0.8, 1e-4])
def test_the_light_is_the_least_that_reaches_the_quality(bench: Any, kept_plans: None, fraction: float) -> None:
    """A hundredth less of an exposure, or one repeat less, does not reach it by the prediction of the image.

    A drift, which the prediction lacks, is named. (Planted: the light rounded to nearest; a repeat too many; noise of
    the recipe's own light for all doses; no word of the drift.)
    """
    recipe = changed(exposure_fraction=fraction, drift=Drift(session_ramp=0.01))
    plan = ms.plan_calibration(bench, 31.0, "dots:2", accuracy=0.005, recipe=recipe)
    (warning,) = plan.warnings
    assert warning.startswith("drift: ")
    found, whole = plan.recipe, plan.recipe.repeats > 1
    assert whole == (fraction < 0.8) and (found.exposure_fraction == fraction) == whole
    less = {"repeats": found.repeats - 1} if whole else {"exposure_fraction": 0.99 * found.exposure_fraction}
    reached, missed = (
        bench.predict("dots:2", recipe=recipe).psnr_db for recipe in (found, found.model_copy(update=less))
    )
    assert missed < 31 <= reached == pytest.approx(plan.errors.psnr_db, abs=1e-6)


def test_no_session_is_so_dim_that_its_factors_are_mostly_noise(bench: Any, kept_plans: None) -> None:
    """Errors of a tenth in either factor; the first order, and a calibration, fail beyond. (Planted: no limit.)"""
    plan = ms.plan_calibration(bench, 15.0, "dots:2", accuracy=0.005)
    factors = bench.calibrate(accuracy=0.005, recipe=plan.recipe)
    assert factors.manifest.result["phi_error"] == pytest.approx(0.1 * 2**0.5, rel=0.08) and plan.errors.psnr_db > 25


@pytest.mark.parametrize("mode", ["pair", "uniform"])
def test_factors_have_the_noise_that_is_predicted(bench: Any, mode: str) -> None:
    """Two thousand numbers. (Planted: the noise that a uniform shot shares left out; counted in all columns.)"""
    recipe = changed(exposure_fraction=0.01, signed_capture=mode)
    session = Session(bench, recipe, 0)
    stand = Stand.of(session)
    squares = [
        noise**2 * side.size / np.square(side).sum()
        for noise, side in zip(stand.session_noise(session)[0], stand.camera.factors, strict=True)
    ]
    found = bench.calibrate(accuracy=0.005, recipe=recipe).manifest.result["phi_error"]
    assert math.sqrt(sum(squares)) == pytest.approx(found, rel=0.08)


@pytest.mark.slow
def test_a_session_by_the_plan_has_the_images_that_it_promised(bench: Any, plan: ms.CalibrationPlan) -> None:
    """Four sessions, each with noise of its own; an image of 256 pixels scatters, as the plan says itself."""
    assert plan.reached and not plan.warnings and plan.ceiling.psnr_db > plan.errors.psnr_db + 3
    assert plan.recipe.exposure_fraction < 0.8 and plan.recipe.repeats == 1
    found = []
    for seed in range(1, 5):
        shots = bench.capture("dots:2", seed=seed, accuracy=0.005)
        factors = bench.calibrate(seed=seed, accuracy=0.005, recipe=plan.recipe)
        assert factors.manifest.result["frames"] == plan.frames
        assert factors.manifest.result["exposure_s"] == pytest.approx(plan.exposure_s, rel=0.01)
        found.append(ms.psnr(ms.reconstruct(shots, factors).image, shots.truth))
    assert np.mean(found) == pytest.approx(plan.errors.psnr_db, abs=0.3 + 1.5 * plan.spread_db)


def test_its_light_is_that_of_the_session(bench: Any, plan: ms.CalibrationPlan) -> None:
    """A quarter of the mask's shadow is open where both rows and columns are: the mean is less than the peak's half."""
    reported = plan.payload()
    peak = plan.recipe.exposure_fraction * bench.sensor.superpixel_full_well_e
    assert 0.05 * peak < plan.electrons < 0.5 * peak
    assert plan.photons == pytest.approx(plan.electrons / bench.sensor.quantum_efficiency)
    assert reported["exposure_total_s"] == pytest.approx(plan.frames * plan.exposure_s)
    assert reported["electrons_a_pixel_total"] == pytest.approx(plan.frames * plan.electrons)
    assert plan.simulation_s > 0 and "30 dB under dots:2" in plan.lines()[0]


@pytest.mark.parametrize(
    ("psnr", "fraction", "words", "repeats"),
    [(75.0, 0.8, "improve the capture", 1), (33.0, 1e-6, f"by {MOST_REPEATS} repeats", MOST_REPEATS)],
)
def test_more_than_the_capture_or_the_session_allows_is_said_in_one_line(
    bench: Any, kept_plans: None, psnr: float, fraction: float, words: str, repeats: int
) -> None:
    recipe = changed(exposure_fraction=fraction)
    plan = ms.plan_calibration(bench, psnr, "dots:2", accuracy=0.005, recipe=recipe)
    assert not plan.reached and plan.recipe.repeats == repeats
    (line,) = plan.warnings
    assert f"{psnr:g} dB is not reached under dots:2" in line and f"{plan.ceiling.psnr_db:.1f} dB" in line
    assert words in line and "largest error is" in line and "\n" not in line
