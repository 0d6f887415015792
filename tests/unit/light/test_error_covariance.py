"""Changes that effects make in the frames, as looks of the pilot show them: how they add up, what noise leaves."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mitsim.light.passes import even
from mitsim.light.settings import REPLICATES, Approximation, ErrorCovariance, SampleCost
from tests.unit.planner.invented_pilot_result import PILOT_RESULT, SIZES, changes, plan, rows


def seen(*vectors: list[float]) -> ErrorCovariance:
    """Changes without noise, named a, b, ..."""
    named = {Approximation(chr(97 + index)): np.array([vector] * REPLICATES) for index, vector in enumerate(vectors)}
    return ErrorCovariance.between(named, 4.0)


def test_changes_add_up_with_their_signs() -> None:
    """Frames of norm 2; a and b are opposite, c stands at right angles to both."""
    found = seen([6e-3, 0.0], [-4e-3, 0.0], [0.0, 8e-3])
    a, b, c = found.parts
    assert found.estimate([a]) == pytest.approx((3e-3, 3e-3))
    assert found.estimate([a, b]) == pytest.approx((1e-3, 1e-3))
    assert found.estimate([a, c]) == pytest.approx((5e-3, 5e-3))
    assert found.estimate([a, b, c]) == pytest.approx((math.hypot(1e-3, 4e-3),) * 2)
    assert found.estimate([]) == (0.0, 0.0)


def test_the_noise_of_replicates_is_no_change_and_bounds_hold() -> None:
    """500 scenes whose change of 1e-3 is seen with noise of 3e-3 in each look: unbiased squares, 95 % of bounds."""
    part, scenes = Approximation("blur"), 500
    squares, held = [], 0
    for seed in range(scenes):
        found = changes({part: 1e-3}, 3e-3, seed)
        squares.append(float(found.squared_errors(np.ones((1, 1)))[0][0]))
        held += found.estimate([part]).bound >= 1e-3
    error = np.std(squares) / math.sqrt(scenes)
    assert np.mean(squares) == pytest.approx(1e-6, abs=3 * error) and error < 1e-7
    assert held / scenes > 0.92, "binomial: 0.95 of 500, less three standard deviations"


def test_a_change_that_cannot_be_told_is_told_as_a_bound() -> None:
    """A lens whose change is below the pilot's noise is not exact."""
    noisy = replace(PILOT_RESULT, changes=changes(SIZES | {Approximation("aperture"): 0.0}, 1e-4))
    reason = rows(plan(1e-2, noisy, "-aperture"))["aperture"].reason
    assert "less than" in reason
    assert noisy.effects["aperture"].bound > 1e-6


def test_noise_says_how_many_samples_it_takes() -> None:
    """Error 2e-3 at 16 samples, falling with their power -0.8: a tenth needs 10^(1/0.8) times as many."""
    noise = SampleCost(2e-3, 16, 1, 0.8)
    assert noise.samples_for(2e-3) == pytest.approx(16)
    assert noise.samples_for(2e-4) == pytest.approx(16 * 10**1.25)
    assert 0 < SampleCost(0.0, 16, 1, 1.0).samples_for(1e-9) <= 1


@pytest.mark.parametrize(
    ("asked", "taken"), [(0.2, 1), (1, 1), (1.2, 2), (2.5, 3), (3.1, 4), (12, 12), (12.5, 16), (97, 128)]
)
def test_points_of_a_sobol_sequence_come_in_even_numbers(asked: float, taken: int) -> None:
    assert even(asked) == taken and even(np.array([asked])) == [taken]
