"""The search for the least light, and sessions that are found by it, against sessions that are run.

Factors whose noise is drawn in closed form, against those of sessions whose every frame was exposed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mitsim as ms
from mitsim.calibrate.board_session import LitSession
from mitsim.calibrate.calibrate import NOISE_FREE, estimate, session_sums
from mitsim.calibrate.session_plan import drawn_estimate, least_dose
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError
from mitsim.core.job import Job
from mitsim.devices.session import SessionRecipe, load_recipe, recipe_text
from mitsim.reconstruct.factors import Estimate
from tests.unit.calibrate.test_responses import lit_session

SMALLEST = 1e-6


def curve(ceiling_db: float, noise: float) -> tuple[Callable[[float], float], list[float]]:
    """PSNR of a mean squared error a + b / dose, and the doses that it was asked for."""
    asked: list[float] = []

    @cache
    def quality(dose: float) -> float:
        asked.append(dose)
        return -10 * math.log10(10 ** (-ceiling_db / 10) + noise / dose)

    return quality, asked


@pytest.mark.parametrize("wanted", [12.0, 25.0, 31.0, 38.5])
def test_the_least_part_of_an_exposure_is_found_to_a_twentieth_of_a_decibel(wanted: float) -> None:
    quality, asked = curve(40.0, 1e-5)
    dose = least_dose(quality, wanted, SMALLEST)
    exact = 1e-5 / (10 ** (-wanted / 10) - 1e-4)
    assert exact <= dose <= 1 and 0 <= quality(dose) - wanted <= 0.051
    assert len(asked) <= 12  # each is an image or several


@pytest.mark.parametrize(("wanted", "noise"), [(30.0, 3e-3), (36.0, 3e-3), (39.0, 4e-4), (39.9, 1.5e-3)])
def test_the_fewest_repeats_are_found_to_a_twentieth_of_a_decibel(wanted: float, noise: float) -> None:
    quality, asked = curve(40.0, noise)
    repeats = least_dose(quality, wanted, SMALLEST)
    exact = noise / (10 ** (-wanted / 10) - 1e-4)
    assert exact <= repeats < 1.01 * exact + 1 or quality(repeats) - wanted <= 0.05
    assert quality(repeats) >= wanted and repeats == round(repeats) > 1
    assert len(asked) <= 14


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


@pytest.mark.slow
def test_a_session_by_the_plan_has_the_images_that_it_promised(bench: Any, plan: ms.CalibrationPlan) -> None:
    """Four sessions, each with noise of its own; an image of 256 pixels scatters, as the plan says itself."""
    assert plan.reached and not plan.warnings and plan.ceiling.psnr_db > plan.trial.psnr_db + 3
    assert plan.recipe.exposure_fraction < 0.8 and plan.recipe.repeats == 1
    found = []
    for seed in range(1, 5):
        shots = bench.capture("dots:2", seed=seed, accuracy=0.005)
        factors = bench.calibrate(seed=seed, accuracy=0.005, recipe=plan.recipe)
        assert factors.manifest.result["frames"] == plan.frames
        assert factors.manifest.result["exposure_s"] == pytest.approx(plan.exposure_s, rel=0.01)
        found.append(ms.psnr(ms.reconstruct(shots, factors).image, shots.truth))
    error = plan.trial.spread_db * math.sqrt(1 / 4 + 1 / 6)
    assert np.mean(found) == pytest.approx(plan.trial.psnr_db, abs=0.3 + 3 * error)


def test_its_light_is_that_of_the_session(bench: Any, plan: ms.CalibrationPlan) -> None:
    """A quarter of the mask's shadow is open where both rows and columns are: the mean is less than the peak's half."""
    reported = plan.payload()
    peak = plan.recipe.exposure_fraction * bench.sensor.superpixel_full_well_e
    assert 0.05 * peak < plan.electrons < 0.5 * peak
    assert plan.photons == pytest.approx(plan.electrons / bench.sensor.quantum_efficiency)
    assert reported["exposure_total_s"] == pytest.approx(plan.frames * plan.exposure_s)
    assert reported["electrons_a_pixel_total"] == pytest.approx(plan.frames * plan.electrons)
    assert plan.simulation_s > 0 and "30 dB under dots:2" in plan.lines()[0]


def test_more_than_the_capture_allows_is_said_in_one_line(bench: Any, kept_plans: None) -> None:
    plan = ms.plan_calibration(bench, 75.0, "dots:2", accuracy=0.005)
    assert not plan.reached and plan.recipe.repeats == 1
    (line,) = plan.warnings
    assert "75 dB cannot be reached under dots:2" in line and f"{plan.ceiling.psnr_db:.1f} dB" in line
    assert "most of its error is" in line and "\n" not in line


# ---- Predicted sessions ----


SEEDS, DRAWS = 120, 480


def squares(found: list[Estimate], clean: Estimate, side: str) -> FloatArray:
    """(m, n) mean squared error of each number."""
    errors = [getattr(each, side) - getattr(clean, side) for each in found]
    return np.asarray(np.mean(np.square(errors), axis=0))


def exposed(lit: LitSession) -> list[Estimate]:
    sessions = (replace(lit.session, seed=seed) for seed in range(SEEDS))
    return [estimate(replace(lit, session=session), Job())[0] for session in sessions]


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "n", "repeats"), [("pair", 7, 1), ("uniform", 8, 1), ("pair", 4, 3)])
def test_drawn_noise_is_that_of_exposed_frames_number_by_number(mode: str, n: int, repeats: int) -> None:
    """The mean squared error of a row of a factor, and of a column, by 120 sessions and by 480 draws.

    Of k normal numbers it is known to sqrt(2 / k): a row of 4 to 8 numbers to 6.5 % of 480, a column of 24 to 2.6 %.
    Five deviations of the worst, with its part of the draws, are 36 %; without the part that the uniform shot brings,
    the first column of 8 would have a ninth. All numbers together are known to 3 %.
    """
    lit = lit_session(n, mode, repeats=repeats)
    sums = session_sums(lit, Job(), (NOISE_FREE,))[0][NOISE_FREE]
    clean = drawn_estimate(lit, sums, None)
    drawn, found = [drawn_estimate(lit, sums, draw) for draw in range(DRAWS)], exposed(lit)
    for side in ("left", "right"):
        law, seen = squares(drawn, clean, side), squares(found, clean, side)
        for axis in (0, 1):
            np.testing.assert_allclose(law.mean(axis=axis), seen.mean(axis=axis), rtol=0.36)
        assert law.mean() == pytest.approx(seen.mean(), rel=0.15)
    reported = [np.mean([each.separability_residual for each in those]) for those in (drawn, found)]
    assert reported[0] == pytest.approx(reported[1], rel=0.02)
    assert np.mean([each.predicted_error for each in drawn]) == pytest.approx(
        np.mean([each.predicted_error for each in found]), rel=0.02
    )


def test_without_noise_it_is_the_noise_free_session() -> None:
    lit = lit_session(7, "uniform")
    sums = session_sums(lit, Job(), (NOISE_FREE,))[0][NOISE_FREE]
    clean, direct = drawn_estimate(lit, sums, None), estimate(lit, Job(), noise_free=True)[0]
    np.testing.assert_allclose(clean.left, direct.left, rtol=1e-12)
    np.testing.assert_allclose(clean.right, direct.right, rtol=1e-12)
    assert clean.ok and clean.separability_residual < 1e-12
