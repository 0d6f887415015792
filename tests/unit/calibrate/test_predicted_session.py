"""Factors whose noise is drawn in closed form, against those of sessions whose every frame was exposed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsim.calibrate.calibrate import estimate
from mitsim.calibrate.lit_session import LitSession
from mitsim.calibrate.session_plan import PredictedSession
from mitsim.core.arrays import FloatArray
from mitsim.core.job import Job
from mitsim.reconstruct.factors import Estimate
from tests.unit.calibrate.test_responses import lit_session

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
    predicted = PredictedSession.of(lit, Job())
    clean = predicted.estimate(None)
    drawn, found = [predicted.estimate(lit, draw) for draw in range(DRAWS)], exposed(lit)
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
    clean, direct = PredictedSession.of(lit, Job()).estimate(None), estimate(lit, Job(), noise_free=True)[0]
    np.testing.assert_allclose(clean.left, direct.left, rtol=1e-12)
    np.testing.assert_allclose(clean.right, direct.right, rtol=1e-12)
    assert clean.ok and clean.separability_residual < 1e-12


def test_equal_numbers_draw_equal_noise_which_falls_with_the_repeats() -> None:
    lit = lit_session(4)
    predicted = PredictedSession.of(lit, Job())
    often = replace(lit, session=replace(lit.session, recipe=lit.session.recipe.model_copy(update={"repeats": 16})))
    clean, once, many = predicted.estimate(None), predicted.estimate(lit, 3), predicted.estimate(often, 3)
    np.testing.assert_allclose(many.left - clean.left, (once.left - clean.left) / 4, rtol=1e-9, atol=1e-9)
    assert not np.allclose(predicted.estimate(lit, 4).left, once.left, rtol=1e-6)
