"""Total variation, where the answer is known: Chambolle's denoising itself, or a closed form."""

import numpy as np
import pytest
from skimage.restoration import denoise_tv_chambolle

from mitsim.reconstruct.accumulator import Accumulator
from mitsim.reconstruct.regularisation import DiagonalProblem
from mitsim.reconstruct.solver import Prepared, prepare
from mitsim.reconstruct.status import Verdict
from mitsim.reconstruct.tv import AUTO_WEIGHT, automatic_weight, solve_tv

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
    ours = solve_tv(prepared, sums, weight, iterations=300, tolerance=1e-5)
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
    found = solve_tv(prepared, sums, 1e-3, iterations=500, tolerance=1e-5)
    assert found.ok and found.status.verdict is Verdict.PARTLY_MEASURED and "12 of 144 directions" in str(found.status)
    # Total variation takes some 1e-3 off the ramp's ends; its discrete form leaves 0.026 in a corner.
    np.testing.assert_allclose(found.image, scene, atol=0.03)


def test_it_stops_when_asked_and_says_whether_that_was_enough() -> None:
    prepared, sums = seen(np.eye(SIZE), np.eye(SIZE), blocks())
    short = solve_tv(prepared, sums, 0.3, iterations=2, tolerance=1e-9)
    assert not short.ok and short.iterations == 2 and short.status.verdict is Verdict.NOT_CONVERGED
    assert f"after 2 iterations the image still changes by {short.change:.1e}" in str(short.status)
    assert np.isfinite(solve_tv(prepared, sums, 0.3, iterations=1).change), "one step is one step"
    full = solve_tv(prepared, sums, 0.3, iterations=500, tolerance=1e-4)
    assert full.ok and 2 < full.iterations < 500 and full.change < 1e-4 and full.status.verdict is Verdict.SOLVED
    assert solve_tv(prepared, sums, 0.3, iterations=full.iterations, tolerance=1e-4).ok
    assert not solve_tv(prepared, sums, 0.3, iterations=full.iterations - 1, tolerance=1e-4).ok


def test_the_automatic_weight_is_the_gradient_s_noise_in_its_unit() -> None:
    """Noise of variance 4 a datum reaches pixel k as sum_i sigma_ik noise_i: deviation 2 rms(sigma)."""
    sigma = np.array([[1.0, 3.0], [5.0, 0.0]])
    problem = DiagonalProblem(sigma, np.zeros((2, 2)), energy=4.0 * 97, data_count=100)
    assert automatic_weight(problem) == pytest.approx(AUTO_WEIGHT * 2 * np.sqrt(35 / 4), rel=1e-12)


def test_frames_of_nothing_have_no_residual() -> None:
    prepared, sums = seen(np.eye(SIZE), np.eye(SIZE), np.zeros((SIZE, SIZE)))
    found = solve_tv(prepared, sums, 0.1)
    assert found.residual == 0.0 and not found.image.any()
