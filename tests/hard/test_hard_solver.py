"""The solver where the model is short, dark, close or repeated: finite, bounded, told in the status."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsim.core.errors import MitsimError
from mitsim.reconstruct.solver import ROUNDING_LIMIT, pattern_blocks, prepare
from mitsim.reconstruct.solvers import solve_tv
from tests.exact_solver import dots
from tests.hard.hard_models import EPS, LAMBDAS, check_ending, frames_of, shadow, spread, summed
from tests.robustness import Recorder

pytestmark = pytest.mark.robustness("Solver")


@pytest.mark.parametrize("distance", [2.0, 1.0, 0.5, 0.2, 0.1, 0.05, 0.02])
def test_full_size_masks_from_2_mm_to_20_um(measured: Recorder, distance: float) -> None:
    """512 pixels, 128 x 128 scene, one frame, every lambda: finite; rank, condition and rounding told.

    The error is held against the filtered truth V k V^T X V k V^T in the solver's own basis, so it measures what the
    data went through: frames, projections and division. (The basis itself is judged in test_solver_digits.py.)
    """
    phi, one, image = shadow(distance), np.ones((128, 1)), np.random.default_rng(1).random((128, 128))
    prepared = prepare(phi, phi, one, one)
    sums = summed(prepared, frames_of(phi, phi, one, one, image))
    problem = prepared.problem(sums)
    for relative in LAMBDAS:
        lam = relative * problem.scale
        solution = prepared.solve(sums, lam)
        check_ending(str(solution.status), prepared)
        assert np.isfinite(solution.image).all()
        expected = prepared.image(problem.kept_share(lam) * prepared.coefficients(image))
        error = np.linalg.norm(solution.image - expected) / np.linalg.norm(image)
        measured(error / solution.rounding, at_most=1, what="of the stated bound")
        assert f"rounding below {solution.rounding:.0e}." in str(solution.status)
        if relative:
            assert solution.ok and solution.rounding < 56 * EPS / np.sqrt(relative)
        elif prepared.rank < prepared.unknowns:
            assert not solution.ok and str(solution.status).startswith("Rank deficient")
        else:
            assert solution.ok == (solution.rounding <= ROUNDING_LIMIT)
    assert (prepared.rank == 128**2) == (distance > 0.1)


@pytest.mark.parametrize("n", [12, 13])
def test_dots_of_every_pitch(measured: Recorder, n: int) -> None:
    """k = 1 to n, whether it divides n or not: exact frames give the image back within the stated rounding."""
    factor, image = shadow(2.0, 4 * n, n), np.random.default_rng(2).random((n, n))
    conditions = []
    for k in range(1, n + 1):
        P = dots(n, k)
        prepared = prepare(factor, factor, P, P)
        solution = prepared.solve(summed(prepared, frames_of(factor, factor, P, P, image)), 0.0)
        assert solution.ok and prepared.rank == n * n and len(pattern_blocks(P)) == k
        error = np.linalg.norm(solution.image - image) / np.linalg.norm(image)
        measured(error, at_most=solution.rounding)
        conditions.append(prepared.condition)
    assert conditions[0] > 1e3 and conditions[-1] < 2, "n dots are n separate pixels"


@pytest.mark.parametrize(("pixels", "k"), [(512, 1), (256, 1), (128, 1), (64, 1), (32, 1), (512, 7), (64, 7), (32, 7)])
def test_binned_sensors(measured: Recorder, pixels: int, k: int) -> None:
    """512 to 32 pixels for 128 scene pixels: what is not measured is named, what is measured is right.

    The answer at lambda = 0 is the truth's part in the measured subspace. With one frame that is all there is below 128
    pixels; 49 dots are enough for 32.
    """
    phi, P, image = shadow(2.0, pixels), dots(128, k), np.random.default_rng(1).random((128, 128))
    prepared = prepare(phi, phi, P, P)
    sums = summed(prepared, frames_of(phi, phi, P, P, image))
    solution = prepared.solve(sums, 0.0)
    check_ending(str(solution.status), prepared)
    visible = prepared.image((prepared.problem(sums).sigma > 0) * prepared.coefficients(image))
    error = np.linalg.norm(solution.image - visible) / np.linalg.norm(image)
    measured(error, at_most=min(solution.rounding, 1e-4))
    short = pixels * k < 128
    assert solution.ok == (not short and solution.rounding <= ROUNDING_LIMIT)
    assert str(solution.status).startswith("Under-determined") == short
    assert prepared.rank == min(pixels * k, 128) ** 2
    if not short:
        assert np.linalg.norm(visible - image) < 1e-4 * np.linalg.norm(image)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(dark=st.sets(st.integers(0, 8), max_size=8), seed=st.integers(0, 99), k=st.integers(1, 4))
def test_unlit_projector_pixels(measured: Recorder, dark: set[int], seed: int, k: int) -> None:
    """Rows of scene pixels without light come out as exact zeros, the others as if alone; the status counts them."""
    rng = np.random.default_rng(seed)
    factor, image, P = rng.random((14, 9)), rng.random((9, 9)), dots(9, k)
    lit = np.array([i not in dark for i in range(9)])
    P_L = P * lit[:, None]
    prepared = prepare(factor, factor, P_L, P)
    frames = frames_of(factor, factor, P_L, P, image)
    solution = prepared.solve(summed(prepared, frames), 0.0)
    check_ending(str(solution.status), prepared)
    assert prepared.rank == 9 * lit.sum() and solution.ok == bool(lit.all())
    assert not solution.image[~lit].any()
    # Nine random columns have a condition below 100 a side; ten eps times 1e4 and room for the worst draw.
    measured(np.abs(solution.image[lit] - image[lit]).max(), at_most=1e-9)
    if dark:
        assert f"{9 * (~lit).sum()} of 81 directions" in str(solution.status)


def test_models_that_see_nothing_are_refused() -> None:
    """Light where the factor is dark, and a factor that is constant once centred: refused, not divided by zero."""
    one = np.ones((4, 1))
    half = np.random.default_rng(0).random((6, 4))
    half[:, :2] = 0
    lit = np.array([[1.0], [1.0], [0.0], [0.0]])
    with pytest.raises(MitsimError, match="no scene pixel that the left factor sees"):
        prepare(half, np.eye(5, 4), lit, one)
    with pytest.raises(MitsimError, match="no scene pixel that the right factor sees"):
        prepare(np.eye(5, 4), half, one, lit)
    with pytest.raises(MitsimError, match="left factor once centred"):
        prepare(np.full((6, 4), 0.1), half, one, one, centre=True)
    # One column without contrast: its pixel is not measured, and no rounding stands in for it.
    flat = np.random.default_rng(1).random((6, 4))
    flat[:, 2] = 0.1
    assert prepare(flat, flat, one, one, centre=True).rank == 9


# ---- what the status says --------------------------------------------------------------------------------------------


def test_every_status_names_rank_and_condition() -> None:
    rng = np.random.default_rng(0)
    one, image = np.ones((8, 1)), rng.random((8, 8))
    twin = spread(10)
    twin[:, 1] = twin[:, 0]
    cases = {
        "Solved: every": (spread(10), 0.0, True),
        "Ill-conditioned": (spread(1e7), 0.0, False),
        "Rank deficient": (twin, 0.0, False),
        "Solved, but": (twin, 1e-3, True),
        "Under-determined": (spread(10, 8, 8)[:5], 1e-3, False),
    }
    for start, (factor, lam, ok) in cases.items():
        prepared = prepare(factor, factor, one, one)
        sums = summed(prepared, frames_of(factor, factor, one, one, image))
        solution = prepared.solve(sums, lam)
        assert str(solution.status).startswith(start) and solution.ok == ok
        check_ending(str(solution.status), prepared)
        tv = solve_tv(prepared, sums, 1e-6, iterations=2)
        check_ending(str(tv.status), prepared)
        assert str(tv.status).startswith("Not converged") and not tv.ok
        # A tolerance that the first step meets: TV may fill in what is not measured, but says how much that is.
        tv = solve_tv(prepared, sums, 1e-6, iterations=2, tolerance=1e9)
        check_ending(str(tv.status), prepared)
        lost = prepared.unknowns - prepared.rank
        assert tv.ok and (f"{lost} of 64 directions are not measured" in str(tv.status)) == bool(lost)


@pytest.mark.parametrize("exponent", range(13))
def test_rounding_is_bounded_or_flagged(measured: Recorder, exponent: int) -> None:
    """Full rank at lambda = 0, cond(A) of each side from 1 to 1e24: the error keeps to the bound; above 1 % is flagged.

    cond(A) = 1e14 each side is a condition of 1e14 in sigma, and two digits: flagged. The lambda that the status names
    is enough.
    """
    left, right = spread(10.0**exponent, seed=1), spread(10.0**exponent, seed=2)
    one, image = np.ones((8, 1)), np.random.default_rng(0).random((8, 8))
    prepared = prepare(left, right, one, one)
    sums = summed(prepared, frames_of(left, right, one, one, image))
    solution = prepared.solve(sums, 0.0)
    assert prepared.rank == 64 and np.isfinite(solution.image).all()
    assert solution.rounding == pytest.approx(110 * EPS * 100.0**exponent, rel=2e-2)
    measured(np.linalg.norm(solution.image - image) / np.linalg.norm(image), at_most=solution.rounding)
    assert solution.ok == (exponent <= 5)
    if not solution.ok:
        advised = float(re.search(r"lambda above (\S+),", str(solution.status))[1])
        again = prepared.solve(sums, 1.05 * advised)
        assert again.ok and again.rounding < ROUNDING_LIMIT
