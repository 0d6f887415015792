"""The finest accuracy that a time buys, of invented pilot result: more seconds never buy less, and what is bought
fits."""

import math
from itertools import pairwise
from typing import Any

import pytest

from mitsim.bench.request import HIGHEST_ACCURACY
from mitsim.light.cost_model import FIXED, truth_seconds
from mitsim.planner.choose import (
    FIRST_ACCURACY,
    AccuracyForTime,
    Candidates,
    accuracies,
    accuracy_for_time,
)
from tests.unit.planner.invented_pilot_result import PILOT_RESULT, cheapest

TIMES = (0.01, 0.3, 0.95, 1.0, 2.0, 4.0, 10.0, 40.0, 1e5)


@pytest.fixture(scope="module")
def candidates() -> Candidates:
    return Candidates(PILOT_RESULT, {})


@pytest.fixture(scope="module")
def bought(candidates: Candidates) -> list[AccuracyForTime]:
    return [accuracy_for_time(candidates, seconds, 1e-4) for seconds in TIMES]


def test_accuracies_fall_by_the_same_step_down_to_the_finest() -> None:
    grid = accuracies(FIRST_ACCURACY)
    assert grid[0] == HIGHEST_ACCURACY and grid[-1] == FIRST_ACCURACY
    assert all(1.15 < coarse / fine < 1.3 for coarse, fine in pairwise(grid))
    assert accuracies(0.0)[-1] == 1e-5


def test_candidates_choose_as_the_plan_does(candidates: Candidates) -> None:
    """What is shared between accuracies does not depend on them, nor on their order."""
    for accuracy in (3e-4, 0.1, 3e-3):
        found = candidates.best(accuracy)
        candidate = cheapest(accuracy, PILOT_RESULT, {})
        assert found.settings == candidate.settings
        seconds, keeps = candidates.seconds(accuracy)
        assert seconds == pytest.approx(
            candidate.work + truth_seconds(PILOT_RESULT, candidate.settings, FIXED), rel=1e-12
        )
        assert keeps is candidate.fits


def test_more_seconds_never_buy_less(bought: list[AccuracyForTime]) -> None:
    assert bought[0].accuracy == HIGHEST_ACCURACY and not bought[0].fits
    found = [each.accuracy for each in bought]
    assert found == sorted(found, reverse=True) and len(set(found)) > 4


def test_what_is_bought_fits_and_the_next_finer_does_not(bought: list[AccuracyForTime], candidates: Candidates) -> None:
    grid = accuracies(1e-4)
    for seconds, each in zip(TIMES[2:6], bought[2:6], strict=True):
        assert each.fits and each.seconds <= seconds
        assert each.seconds == candidates.seconds(each.accuracy)[0]
        finer = grid[grid.index(each.accuracy) + 1]
        assert candidates.seconds(finer)[0] > seconds


def test_no_finer_than_the_pilot_result_is_good_for(bought: list[AccuracyForTime], candidates: Candidates) -> None:
    assert bought[-1].accuracy >= 1e-4 and bought[-1].fits
    assert accuracy_for_time(candidates, math.inf, FIRST_ACCURACY).accuracy == FIRST_ACCURACY
    kept, costly_effects = (accuracy_for_time(candidates, math.inf, 0.0, kept=kept) for kept in (True, False))
    assert costly_effects.accuracy == 1e-5 < kept.accuracy, "the ladders end before it, so only its price is known"


@pytest.mark.parametrize("seconds", [0.05, 0.2])
def test_where_nothing_is_kept_time_alone_counts(seconds: float) -> None:
    """The loosest is taken; that it is not kept is for the plan to say. (Planted: told as too few seconds.)"""

    class Hopeless:
        def seconds(self, accuracy: float) -> tuple[float, bool]:
            return 0.1, False

    found: Any = Hopeless()
    assert accuracy_for_time(found, seconds, 1e-4) == AccuracyForTime(HIGHEST_ACCURACY, 0.1, seconds > 0.1)
