"""The report of a session: errors of factors beside their prediction, on drawn noise; no scene is loaded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsim.capture.calibrate import NOISE_FREE, NOISY, estimates
from mitsim.core.job import Job
from mitsim.study.calibration import _row, judged, singular_rows, spent
from tests.unit.capture.test_responses import CLIPPED, lit_session

SEEDS = 40


def test_errors_of_factors_are_those_that_are_predicted() -> None:
    """Over 40 sessions of their own noise: 168 and 189 entries of unit variance each, less what a common scale takes.
    (Planted: the other side's common vector, N left out.)"""
    lit = lit_session(7)
    squares: dict[str, list[float]] = {"left": [], "right": []}
    found_errors, stated_errors = [], []
    for seed in range(SEEDS):
        own = replace(lit, session=replace(lit.session, seed=seed))
        (noisy, clean), _ = estimates(own, Job(), (NOISY, NOISE_FREE))
        report = judged(own, noisy, clean)
        for row in report.entries:
            squares[row.factor].append(row.chi_square)
            found_errors.append(row.error)
            stated_errors.append(row.predicted_error)
    for values in squares.values():
        assert np.mean(values) == pytest.approx(1, abs=0.06)
    assert np.sqrt(np.mean(np.square(found_errors))) == pytest.approx(np.mean(stated_errors), rel=0.03)


def test_singular_values_and_vectors_move_as_their_perturbation_says() -> None:
    """300 draws of noise on a factor of 40 x 4, whose rows have different noise: mean and spread of each value, and the
    angle of each right vector. (Planted: bias of the other sign, angles without the gaps.)"""
    rng = np.random.default_rng(5)
    left, _ = np.linalg.qr(rng.standard_normal((40, 4)))
    right, _ = np.linalg.qr(rng.standard_normal((4, 4)))
    exact = left * [40.0, 25.0, 12.0, 6.0] @ right.T
    deviation = rng.uniform(0.3, 0.5, 40)
    draws = [
        list(singular_rows("left", exact, exact + deviation[:, None] * rng.standard_normal(exact.shape), deviation))
        for _ in range(300)
    ]
    for rows in zip(*draws, strict=True):
        moved = np.array([row.noisy - row.value for row in rows])
        assert moved.std() == pytest.approx(rows[0].standard_error, rel=0.2)
        assert moved.mean() == pytest.approx(rows[0].bias, abs=5 * rows[0].standard_error / np.sqrt(300))
        angles = np.array([row.angle for row in rows])
        assert np.sqrt(np.mean(angles**2)) == pytest.approx(rows[0].predicted_angle, rel=0.2)


def test_light_and_time_of_a_session_are_counted() -> None:
    """8 patterns of either side, two halves, three repeats at 0.02 and 0.08 s; each pair is a uniform frame's light."""
    lit = lit_session(7, rig=CLIPPED, repeats=3, exposure_ladder=(1.0, 4.0))
    found = spent(lit)
    assert found["frames"] == 2 * 16 * 3 * 2 and found["exposure_seconds"] == pytest.approx(2 * 16 * 3 * 0.1)
    assert found["photoelectrons"] == pytest.approx(float(lit.uniform_rate.sum()) * 16 * 3 * 0.1)
    assert found["photons"] == pytest.approx(2 * found["photoelectrons"])
    dark = lit_session(7, "uniform", rig=CLIPPED, dark_frames=5)
    assert spent(dark)["exposure_seconds"] == pytest.approx((18 + 5) * 0.02)


def test_a_cause_has_the_part_by_which_the_squared_residual_falls_without_it() -> None:
    assert _row("board", 0.05, 0.03).part == pytest.approx(0.04)
    assert _row("board", 0.03, 0.05).part == pytest.approx(-0.04)
    assert _row("board", 0.03, 0.03).part == 0
