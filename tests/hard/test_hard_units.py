"""The solver in any unit: factors, patterns and frames from 1e-30 to 1e30 change nothing but the image's scale."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import hadamard

from mitsim.core.errors import MitsimError
from mitsim.reconstruct.solver import prepare
from tests.exact_solver import dots
from tests.hard.hard_models import LAMBDAS, frames_of, shadow, spread, summed
from tests.robustness import Recorder

pytestmark = pytest.mark.robustness("Solver")


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    shifts=st.tuples(*[st.integers(-20, 20)] * 5),
    family=st.sampled_from(["uniform", "dots", "grey"]),
    lam=st.sampled_from(["auto", 0.0, 1e-6]),
)
def test_units_change_nothing(shifts: tuple[int, ...], family: str, lam: float | str) -> None:
    """Factors, patterns and frames times 2^-40 to 2^40 (1e-12 to 1e12) each: the image scales, bit for bit.

    Even powers of two are exact in every step, square roots included, so no tolerance is needed. Rank, condition,
    relative lambda (also the automatic one), residual, rounding and the status do not move.
    """
    rng = np.random.default_rng(7)
    left, right, image = rng.random((12, 6)), rng.random((11, 5)), rng.random((6, 5))
    P_L, P_R = (
        {"uniform": np.ones((size, 1)), "dots": dots(size, 2), "grey": rng.random((size, 2))}[family] for size in (6, 5)
    )
    frames = frames_of(left, right, P_L, P_R, image)
    frames = {key: frame + 1e-3 * rng.normal(size=frame.shape) for key, frame in frames.items()}
    units = [4.0**shift for shift in shifts]
    found = []
    for a, b, c, d, e in (np.ones(5), units):
        prepared = prepare(a * left, b * right, c * P_L, d * P_R)
        sums = summed(prepared, {key: e * frame for key, frame in frames.items()})
        scale = prepared.problem(sums).scale
        solution = prepared.solve(sums, lam if isinstance(lam, str) else lam * scale)
        facts = prepared.rank, prepared.condition, solution.lam / scale, solution.residual, solution.rounding
        found.append((solution, (*facts, solution.ok)))
    (one, facts), (other, same) = found
    np.testing.assert_array_equal(other.image, one.image * (units[4] / np.prod(units[:4])))
    assert facts == same
    assert re.sub("lambda above \\S+", "", str(other.status)) == re.sub("lambda above \\S+", "", str(one.status))


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1e6, 1e12])
def test_signed_patterns_in_any_unit(measured: Recorder, scale: float) -> None:
    """Hadamard stripes that are no whole numbers fall into one block instead of four: the same image to rounding."""
    factor, image = shadow(2.0, 32, 8), np.random.default_rng(0).random((8, 8))
    P = np.tile(hadamard(4), (2, 1)).astype(float)
    frames = frames_of(factor, factor, P, P, image)
    plain, other = prepare(factor, factor, P, P), prepare(factor, factor, scale * P, scale * P)
    one = plain.solve(summed(plain, frames), 0.0)
    two = other.solve(summed(other, frames), 0.0)
    error = np.linalg.norm(two.image * scale**2 - one.image) / np.linalg.norm(image)
    measured(error, at_most=2 * one.rounding)
    assert other.condition == pytest.approx(plain.condition, rel=1e-9)


@pytest.mark.parametrize("size", [1e-150, 1e-31, 1e31, 1e150])
def test_units_whose_squares_leave_double_precision_are_refused(size: float) -> None:
    """sigma^2 of 1e-600 is 0, of 1e600 infinite: one line says so before either can spoil an image."""
    good = {"left": np.eye(5, 4), "right": np.eye(5, 4), "P_L": np.ones((4, 1)), "P_R": np.ones((4, 1))}
    for name, words in (("left", "left factor"), ("right", "right factor"), ("P_L", "P_L"), ("P_R", "P_R")):
        with pytest.raises(MitsimError, match="allowed are 1e-30 to 1e\\+30") as caught:
            prepare(**(good | {name: size * good[name]}))
        assert words in str(caught.value) and f"{size:.1e}" in str(caught.value) and "\n" not in str(caught.value)
    sums = prepare(**good).accumulator()
    if not 1e-100 < size < 1e100:
        with pytest.raises(MitsimError, match="allowed are 0 and 1e-100 to 1e\\+100"):
            sums.add(np.full((5, 5), size), 0, 0)
    sums.add(np.zeros((5, 5)), 0, 0)
    assert not sums.sum.any(), "a dark frame is a frame"


@pytest.mark.parametrize("size", [1e-30, 1e30])
def test_the_largest_and_smallest_allowed_units(size: float) -> None:
    """All four at the limit, every lambda: nothing overflows or vanishes."""
    factor, P, image = spread(1e3), size * dots(8, 3), np.random.default_rng(0).random((8, 8))
    factor *= size / np.abs(factor).max()
    for relative in LAMBDAS:
        prepared = prepare(factor, factor, P, P)
        sums = summed(prepared, frames_of(factor / size**2, factor, P, P, image))
        solution = prepared.solve(sums, relative * prepared.problem(sums).scale)
        assert np.isfinite(solution.image).all() and 0 <= solution.residual < 1
        kept = prepared.problem(sums).kept_share(solution.lam)
        expected = prepared.image(kept * prepared.coefficients(image / size**2))
        assert np.linalg.norm(solution.image - expected) <= solution.rounding * np.linalg.norm(image / size**2)
