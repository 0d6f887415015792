"""What the solver's sums are adjoint to, and total variation at its minimum."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsim.optics.terms import centre_terms as centred_terms
from mitsim.reconstruct.solver import centre_frame, prepare
from mitsim.reconstruct.solvers import solve_tv
from tests.hard.hard_models import EPS, frames_of, shadow, summed

pytestmark = pytest.mark.robustness("Solver")


@settings(max_examples=40, deadline=None, derandomize=True)
@given(data=st.data())
def test_adjoints(data) -> None:
    """<A x, y> = <x, A^T y> for the basis, for the sum over frames, and for the whole model, centred or not.

    Frames come from an independent dense forward model. Tolerance: eps times the norms times the number of terms.
    """
    n, n2 = data.draw(st.integers(2, 7)), data.draw(st.integers(2, 7))
    rng = np.random.default_rng(data.draw(st.integers(0, 999)))
    left, right = rng.normal(size=(n + 2, n)), rng.normal(size=(n2 + 3, n2))
    P_L, P_R = rng.normal(size=(n, 2)), rng.normal(size=(n2, 3))
    centre = data.draw(st.booleans())
    prepared = prepare(left, right, P_L, P_R, centre=centre)
    image, spectrum = rng.normal(size=(n, n2)), rng.normal(size=(n, n2))

    def close(one: float, other: float, size: float) -> bool:
        return abs(one - other) <= 100 * EPS * n * n2 * size

    norms = float(np.linalg.norm(image) * np.linalg.norm(spectrum))
    assert close(np.vdot(prepared.image(spectrum), image), np.vdot(spectrum, prepared.coefficients(image)), norms)

    data_frames = {(i, j): rng.normal(size=(n + 2, n2 + 3)) for i in range(2) for j in range(3)}
    sums = summed(prepared, data_frames)
    modelled = frames_of(left, right, P_L, P_R, image)
    if centre:
        modelled = {key: centre_frame(frame) for key, frame in modelled.items()}
    forward = sum(float(np.vdot(modelled[key], data_frames[key])) for key in modelled)
    taken = [centre_frame(frame) if centre else frame for frame in data_frames.values()]
    assert sums.energy == pytest.approx(sum(np.square(frame).sum() for frame in taken), rel=1e-12)
    found = prepared.problem(sums)
    gradient = prepared.image(found.sigma * found.projected)
    size = np.sqrt(found.scale * found.energy) * np.linalg.norm(image)
    assert close(forward, np.vdot(gradient, image), size)
    synthesis = {
        (i, j): _wide(prepared.left, i) @ spectrum @ _wide(prepared.right, j).T for i in range(2) for j in range(3)
    }
    both = sum(float(np.vdot(synthesis[key], data_frames[key])) for key in synthesis)
    assert close(both, np.vdot(sums.sum, spectrum), np.sqrt(found.energy) * np.linalg.norm(spectrum))


def _wide(side, index: int) -> np.ndarray:
    """Slab ``index`` with its columns in their places in W, (m, r)."""
    matrix = np.zeros((side.sensor_size, len(side.singular)))
    matrix[:, side.slabs[index].columns] = side.slabs[index].matrix
    return matrix


def test_centring_is_its_own_adjoint() -> None:
    """Of frames and of separable operators: <C Y C, Z> = <Y, C Z C>, C Y C twice is once, <A_c X, Y> = <A X, C Y C>."""
    rng = np.random.default_rng(0)
    one, other = rng.normal(size=(9, 7)), rng.normal(size=(9, 7))
    assert np.vdot(centre_frame(one), other) == pytest.approx(np.vdot(one, centre_frame(other)), abs=1e-13)
    np.testing.assert_allclose(centre_frame(centre_frame(one)), centre_frame(one), atol=1e-15)
    terms = [(rng.normal(size=(9, 4)), rng.normal(size=(7, 5))) for _ in range(3)]
    image = rng.normal(size=(4, 5))
    whole, taken = (sum(left @ image @ right.T for left, right in found) for found in (terms, centred_terms(terms)))
    assert np.vdot(taken, one) == pytest.approx(np.vdot(whole, centre_frame(one)), rel=1e-12)


def test_total_variation_is_at_its_minimum() -> None:
    """No step lowers the objective by more than the tolerance: the inner solver's gradient and divergence fit.

    mitsim has no TV operator of its own (skimage's is used); an adjoint that is not one would miss the minimum. Steps
    go to the images of other weights, the truth, the Tikhonov image and a mirrored one. At a tolerance of 1e-4 the
    objective is 1e-5 high.
    """
    rng = np.random.default_rng(0)
    factor, one = shadow(2.0, 96, 24), np.ones((24, 1))
    image = np.kron(rng.random((3, 3)), np.ones((8, 8)))
    frame = factor @ image @ factor.T
    frame += 1e-3 * frame.max() * rng.normal(size=frame.shape)
    prepared = prepare(factor, factor, one, one)
    sums = summed(prepared, {(0, 0): frame})
    found = solve_tv(prepared, sums)
    assert found.ok

    def objective(x: np.ndarray) -> float:
        down, across = (np.diff(x, axis=axis, append=x.take([-1], axis)) for axis in (0, 1))
        variation = np.sqrt(np.square(down) + np.square(across)).sum()
        return float(np.square(frame - factor @ x @ factor.T).sum() / 2 + found.lam * variation)

    base = objective(found.image)
    others = [solve_tv(prepared, sums, found.lam * change).image for change in (0.5, 2.0)]
    for toward in (*others, image, prepared.solve(sums).image, found.image[::-1]):
        for step in (1e-3, 1e-2, 0.1, 1.0):
            assert objective(found.image + step * (toward - found.image)) > base * (1 - 1e-4)
    assert objective(image) > base and objective(prepared.solve(sums).image) > 1.05 * base
