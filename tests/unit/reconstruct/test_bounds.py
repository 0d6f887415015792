"""Images within bounds of a separable camera, against active sets, a slow projected gradient, and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear, nnls

from mitsim.core.errors import MitsimError
from mitsim.reconstruct.solver import Accumulator, Prepared, Verdict, prepare
from mitsim.reconstruct.solvers import solve_nonnegative, solve_tv

SIZE = 9


def seen(rows: int, period: int) -> tuple[Prepared, Accumulator, np.ndarray, np.ndarray]:
    """A scene of numbers of both signs under dots, its frames with noise of 0.05; the matrix, and all data."""
    rng = np.random.default_rng(0)
    left, right = (rng.random((rows, SIZE)) for _ in range(2))
    lit = (np.arange(SIZE)[:, None] % period == np.arange(period)).astype(float)
    prepared, scene = prepare(left, right, lit, lit), rng.normal(size=(SIZE, SIZE))
    sums, matrices, data = prepared.accumulator(), [], []
    for i, j in np.ndindex(period, period):
        matrices.append(np.kron(left * lit[:, i], right * lit[:, j]))
        frame = (matrices[-1] @ scene.ravel()).reshape(rows, rows) + 0.05 * rng.normal(size=(rows, rows))
        sums.add(frame, i, j)
        data.append(frame.ravel())
    return prepared, sums, np.concatenate(matrices), np.concatenate(data)


@pytest.mark.parametrize(("rows", "period"), [(14, 1), (14, 2), (6, 1)])
@pytest.mark.parametrize("lam", [1e-2, 1.0])
@pytest.mark.parametrize("bounds", [None, (0.0, 0.5), (-0.3, np.inf)])
def test_the_image_is_that_of_active_sets(
    rows: int, period: int, lam: float, bounds: tuple[float, float] | None
) -> None:
    """scipy's active sets end at a vertex of the right face; the gap is nowhere below what the objective is above
    theirs. Of more unknowns than data (6 rows of 9), too. (Planted: a ridge that the gap forgets; multipliers of the
    wrong sign.)"""
    prepared, sums, matrix, data = seen(rows, period)
    system = np.concatenate([matrix, np.sqrt(lam) * np.eye(SIZE**2)])
    target = np.concatenate([data, np.zeros(SIZE**2)])
    if bounds is None:
        exact = nnls(system, target)[0]
    else:
        exact = lsq_linear(system, target, bounds, method="bvls", tol=1e-14).x
    least = 0.5 * float(np.square(system @ exact - target).sum())
    for iterations in (3, 5000):
        found = solve_nonnegative(prepared, sums, lam, iterations, 1e-7, bounds)
        assert found.objective is not None and found.relative_gap is not None
        assert least * (1 - 1e-9) <= found.objective <= least + found.relative_gap * found.objective * (1 + 1e-9) + 1e-9
        low, high = bounds or (0.0, np.inf)
        assert low <= found.image.min() and found.image.max() <= high
    assert found.ok, str(found.status)
    # lambda / 2 |X - X'|^2 is the least that an image X beside the minimiser X' costs.
    assert np.linalg.norm(found.image.ravel() - exact) < np.sqrt(2e-7 * least / lam) + 1e-9


def test_total_variation_within_bounds_is_least_there() -> None:
    """No image within the bounds between it and others is better: convexity makes a local minimum global. Bounds that
    the free image keeps change nothing."""
    prepared, sums, matrix, data = seen(14, 2)
    free, held = (solve_tv(prepared, sums, 0.5, tolerance=1e-8, bounds=each) for each in (None, (0.0, 0.8)))
    assert free.image.min() < 0 and held.image.min() >= 0 and held.image.max() <= 0.8 and held.ok
    wide = solve_tv(prepared, sums, 0.5, tolerance=1e-8, bounds=(-9.0, 9.0))
    np.testing.assert_allclose(wide.image, free.image, atol=1e-3)

    def objective(image: np.ndarray) -> float:
        down, across = (np.diff(image, axis=axis, append=image.take([-1], axis)) for axis in (0, 1))
        misfit = np.square(matrix @ image.ravel() - data).sum() / 2
        return float(misfit + 0.5 * np.hypot(down, across).sum())

    assert held.objective == pytest.approx(objective(held.image), rel=1e-9)
    rng = np.random.default_rng(1)
    others = [
        np.clip(free.image, 0, 0.8),
        *(np.clip(held.image + s * rng.normal(size=(9, 9)), 0, 0.8) for s in (1e-3, 1)),
    ]
    for other in others:
        for step in (1e-3, 1e-2, 1.0):
            assert objective(held.image + step * (other - held.image)) >= held.objective * (1 - 1e-7)


def test_too_few_steps_are_said_and_no_steps_refused() -> None:
    prepared, sums, _, _ = seen(14, 1)
    found = solve_nonnegative(prepared, sums, 1e-2, 2, 1e-9)
    assert found.status.verdict is Verdict.NOT_CONVERGED and "least squares may still be" in str(found.status)
    for wrong in (-1.0, np.inf, "none"):
        with pytest.raises(MitsimError, match="give a finite number of at least 0"):
            solve_nonnegative(prepared, sums, wrong)
    with pytest.raises(MitsimError, match="give at least 1"):
        solve_nonnegative(prepared, sums, 1.0, 0)
    assert solve_nonnegative(prepared, sums).lam > 0
