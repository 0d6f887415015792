"""Total variation, where the answer is known: Chambolle's denoising itself, or a closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import lsq_linear, nnls
from skimage import data
from skimage.restoration import denoise_tv_chambolle
from skimage.transform import resize

from mitsim.core.errors import MitsimError
from mitsim.metrics import psnr
from mitsim.reconstruct.solver import Accumulator, Prepared, Verdict, prepare
from mitsim.reconstruct.solvers import solve_nonnegative, solve_tv

SIZE = 12


def seen(left: np.ndarray, right: np.ndarray, frame: np.ndarray) -> tuple[Prepared, Accumulator]:
    """One frame under uniform light."""
    prepared = prepare(left, right, np.ones((left.shape[1], 1)), np.ones((right.shape[1], 1)))
    sums = prepared.accumulator()
    sums.add(frame, 0, 0)
    return prepared, sums


def blocks(seed: int = 0) -> np.ndarray:
    """Two flat parts under noise."""
    return np.where(np.arange(SIZE) < 5, 1.0, 0.3) + 0.1 * np.random.default_rng(seed).normal(size=(SIZE, SIZE))


@pytest.mark.parametrize(("gain", "weight"), [(1.0, 0.02), (3.0, 0.3)])
def test_a_camera_that_is_the_identity_is_chambolle_s_denoising(gain: float, weight: float) -> None:
    """1/2 |Y - g X|^2 + w TV(X) = g^2 (1/2 |X - Y/g|^2 + w/g^2 TV(X)): denoising Y / g with w / g^2.

    Measured: 2e-5 and 3e-4 rms apart; a weight that is 5 % off moves the image by 1.6e-3 and 2.3e-3.
    """
    noisy = blocks()
    prepared, sums = seen(gain * np.eye(SIZE), np.eye(SIZE), gain * noisy)
    ours = solve_tv(prepared, sums, weight, tolerance=1e-6)
    exact = denoise_tv_chambolle(noisy, weight=weight / gain**2, eps=1e-12, max_num_iter=20_000)
    assert ours.ok and ours.lam == weight
    assert np.sqrt(np.mean(np.square(ours.image - exact))) < 6e-4
    misfit = np.linalg.norm(noisy - ours.image) / np.linalg.norm(noisy)
    assert ours.residual == pytest.approx(misfit, rel=1e-9)


def test_what_no_frame_measures_is_filled_by_total_variation() -> None:
    """A sensor that sees all but one column of pixels: of all values there those of least total variation fit.

    The scene is flat along its rows beside that column, so that it is bridged without a step; and it is said.
    """
    scene = np.repeat(np.linspace(0.2, 0.9, SIZE)[:, None], SIZE, axis=1)
    blind = np.delete(np.eye(SIZE), 4, axis=0)
    prepared, sums = seen(np.eye(SIZE), blind, scene @ blind.T)
    found = solve_tv(prepared, sums, 1e-3, tolerance=1e-6)
    assert found.ok and found.status.verdict is Verdict.PARTLY_MEASURED and "12 of 144 directions" in str(found.status)
    # Total variation takes some 1e-3 off the ramp's ends; its discrete form leaves 0.026 in a corner.
    np.testing.assert_allclose(found.image, scene, atol=0.03)


def test_it_stops_when_asked_and_says_whether_that_was_enough() -> None:
    prepared, sums = seen(np.eye(SIZE), np.eye(SIZE), blocks())
    short = solve_tv(prepared, sums, 0.3, iterations=2, tolerance=1e-9)
    assert not short.ok and short.iterations == 2 and short.status.verdict is Verdict.NOT_CONVERGED
    assert f"after 2 iterations total variation may still be {short.relative_gap:.1e} above" in str(short.status)
    assert np.isfinite(solve_tv(prepared, sums, 0.3, iterations=1).relative_gap), "one step is one step"
    full = solve_tv(prepared, sums, 0.3, iterations=500, tolerance=1e-4)
    assert full.ok and 2 < full.iterations < 500 and full.relative_gap < 1e-4 and full.status.verdict is Verdict.SOLVED
    assert solve_tv(prepared, sums, 0.3, iterations=full.iterations, tolerance=1e-4).ok


def smoothed_minimum(matrix: np.ndarray, data: np.ndarray, weight: float) -> tuple[float, float]:
    """Bounds of the least 1/2 |data - A x|^2 + weight TV(x), by Newton's method on what is nowhere below it.

    With sqrt(|grad|^2 + eps^2) for |grad| the minimum is at most weight eps a pixel higher. eps falls tenfold, each
    time from the last minimum, until that is 1e-8 of the value.
    """
    forward = np.diff(np.eye(SIZE), axis=0, append=np.eye(SIZE)[-1:])
    down, across = np.kron(forward, np.eye(SIZE)), np.kron(np.eye(SIZE), forward)
    x = np.full(SIZE * SIZE, 0.5)

    def value(x: np.ndarray, eps: float) -> float:
        lengths = np.sqrt(np.square(down @ x) + np.square(across @ x) + eps**2)
        return float(np.square(data - matrix @ x).sum() / 2 + weight * lengths.sum())

    for eps in 10.0 ** -np.arange(0, 14):
        for _ in range(200):
            a, b = down @ x, across @ x
            length = np.sqrt(a**2 + b**2 + eps**2)
            gradient = matrix.T @ (matrix @ x - data) + weight * (down.T @ (a / length) + across.T @ (b / length))
            curved = [(length**2 - a**2) / length**3, (length**2 - b**2) / length**3, -a * b / length**3]
            crossed = down.T @ (curved[2][:, None] * across)
            hessian = matrix.T @ matrix + weight * (
                down.T @ (curved[0][:, None] * down) + across.T @ (curved[1][:, None] * across) + crossed + crossed.T
            )
            step = np.linalg.lstsq(hessian, -gradient, rcond=1e-15)[0]
            if -gradient @ step < 1e-13 * value(x, eps):
                break
            size = 1.0
            while value(x + size * step, eps) > value(x, eps) + 0.25 * size * float(gradient @ step) and size > 1e-12:
                size /= 2
            x = x + size * step
        if weight * eps * x.size < 1e-8 * value(x, eps):
            break
    return value(x, eps) - weight * eps * x.size, value(x, 0.0)


@pytest.mark.parametrize("camera", ["even", "nearly blind", "short"])
def test_the_minimum_is_what_another_solver_finds_over_six_decades_of_weights(camera: str) -> None:
    """And the gap is never less than what the image exceeds it by.

    (Planted: 1.1 times the weight where gradients shrink; the gap without what mu is for; a longer
    Q.)
    """
    rng = np.random.default_rng(3)
    turned = np.linalg.qr(rng.standard_normal((SIZE, SIZE)))[0]
    values = {"even": np.linspace(1, 2, SIZE), "nearly blind": 10.0 ** -np.linspace(0, 4, SIZE), "short": np.ones(SIZE)}
    left = (turned * values[camera])[: SIZE - 3 * (camera == "short")]
    right = turned.T * values[camera][:, None]
    frame = left @ blocks() @ right.T + 0.01 * rng.standard_normal((len(left), SIZE))
    prepared, sums = seen(left, right, frame)
    for exponent in (-5, -3, -1, 1):
        weight = 3.0 * 10.0**exponent
        lower, upper = smoothed_minimum(np.kron(left, right), frame.ravel(), weight)
        assert upper - lower < 1e-6 * upper, "the other solver has found it"
        found = solve_tv(prepared, sums, weight)
        assert found.ok, str(found.status)
        assert lower * (1 - 1e-9) <= found.objective <= upper * (1 + 1.1e-4), weight
        early = solve_tv(prepared, sums, weight, iterations=3)
        assert early.objective - upper <= early.relative_gap * early.objective * (1 + 1e-9), weight


def test_a_weight_that_flattens_all_but_the_mean_converges() -> None:
    """A weight of 1e4: the image is the mean to rounding, and said to be. (Before: 11 % above the minimum at 3000.)"""
    prepared, sums = seen(np.eye(SIZE), np.eye(SIZE), blocks())
    found = solve_tv(prepared, sums, 1e4)
    assert found.ok
    np.testing.assert_allclose(found.image, blocks().mean(), atol=1e-3)


@pytest.mark.parametrize("noise", [0.005, 0.04])
def test_the_automatic_weight_serves_little_and_much_noise(noise: float) -> None:
    """Blurred random codes under uniform light, a photograph: within half a decibel of the best of seven weights.
    (Planted: the gradient's noise, 0.12 sqrt(v mean sigma^2): 2.5 and 10 dB less.)"""
    draws, side = np.random.default_rng(4), 24
    left, right = (gaussian_filter((draws.random((2 * side, side)) > 0.5).astype(float), (0.7, 0)) for _ in range(2))
    truth = resize(data.page() / 255, (side, side), anti_aliasing=True)
    frame = left @ truth @ right.T
    prepared, sums = seen(left, right, frame + noise * frame.mean() * draws.normal(size=frame.shape))
    automatic = solve_tv(prepared, sums, iterations=1).lam

    def quality(weight: float) -> float:
        return psnr(solve_tv(prepared, sums, weight, tolerance=1e-3).image, truth)

    best = max(quality(automatic * factor) for factor in 10.0 ** np.arange(-1.5, 1.6, 0.5))
    assert quality(automatic) > best - 0.5


def test_without_weight_what_no_frame_measures_is_zero() -> None:
    """Least squares of least norm. (Planted: coefficients of 1 there.)"""
    scene = np.repeat(np.linspace(0.2, 0.9, SIZE)[:, None], SIZE, axis=1)
    blind = np.diag((np.arange(SIZE) != 4).astype(float))
    found = solve_tv(*seen(np.eye(SIZE), blind, scene @ blind.T), 0.0)
    np.testing.assert_allclose(found.image, np.where(np.arange(SIZE) == 4, 0.0, scene), atol=1e-12)


def test_the_objective_is_half_the_misfit_and_the_weighted_variation() -> None:
    """Of the image that is given, with what no image explains: a sensor of more rows than the scene has."""
    left = np.random.default_rng(2).random((SIZE + 6, SIZE))
    frame = left @ blocks() + 0.1 * np.random.default_rng(3).normal(size=(SIZE + 6, SIZE))
    found = solve_tv(*seen(left, np.eye(SIZE), frame), 0.1)
    down, across = (np.diff(found.image, axis=axis, append=found.image.take([-1], axis)) for axis in (0, 1))
    expected = np.square(frame - left @ found.image).sum() / 2 + 0.1 * np.hypot(down, across).sum()
    assert found.objective == pytest.approx(expected, rel=1e-9)


# ---- Bounds ----------------------------------------------------------------------------------------------------------

# Images within bounds of a separable camera, against active sets, a slow projected gradient, and closed forms.

SMALL = 9


def under_dots(rows: int, period: int) -> tuple[Prepared, Accumulator, np.ndarray, np.ndarray]:
    """A scene of numbers of both signs under dots, its frames with noise of 0.05; the matrix, and all data."""
    rng = np.random.default_rng(0)
    left, right = (rng.random((rows, SMALL)) for _ in range(2))
    lit = (np.arange(SMALL)[:, None] % period == np.arange(period)).astype(float)
    prepared, scene = prepare(left, right, lit, lit), rng.normal(size=(SMALL, SMALL))
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
def test_the_image_is_of_active_sets(rows: int, period: int, lam: float, bounds: tuple[float, float] | None) -> None:
    """scipy's active sets end at a vertex of the right face; the gap is nowhere below what the objective is above
    theirs. Of more unknowns than data (6 rows of 9), too. (Planted: a ridge that the gap forgets; multipliers of the
    wrong sign.)"""
    prepared, sums, matrix, data = under_dots(rows, period)
    system = np.concatenate([matrix, np.sqrt(lam) * np.eye(SMALL**2)])
    target = np.concatenate([data, np.zeros(SMALL**2)])
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
    prepared, sums, matrix, data = under_dots(14, 2)
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
    moved = (held.image + s * rng.normal(size=(9, 9)) for s in (1e-3, 1))
    others = [np.clip(each, 0, 0.8) for each in (free.image, *moved)]
    for other in others:
        for step in (1e-3, 1e-2, 1.0):
            assert objective(held.image + step * (other - held.image)) >= held.objective * (1 - 1e-7)


def test_too_few_steps_are_said_and_no_steps_refused() -> None:
    prepared, sums, _, _ = under_dots(14, 1)
    found = solve_nonnegative(prepared, sums, 1e-2, 2, 1e-9)
    assert found.status.verdict is Verdict.NOT_CONVERGED and "least squares may still be" in str(found.status)
    for wrong in (-1.0, np.inf, "none"):
        with pytest.raises(MitsimError, match="give a finite number of at least 0"):
            solve_nonnegative(prepared, sums, wrong)
    with pytest.raises(MitsimError, match="give at least 1"):
        solve_nonnegative(prepared, sums, 1.0, 0)
    assert solve_nonnegative(prepared, sums).lam > 0
