"""What the halves of the sensor disagree on is noise and errors of the factors, and never the image."""

import numpy as np
import pytest

from mitsim.reconstruct.solver import coefficient_noise, is_misfit, noise_variance, prepare

M, N = 96, 24


def patterns(family):
    if family == "uniform":
        return np.ones((N, 1))
    if family == "dots":
        return (np.arange(N)[:, None] % 3 == np.arange(3)).astype(float)
    if family == "signed":
        return np.array([[1, 1], [1, -1]])[np.arange(N) % 2].astype(float)
    return np.random.default_rng(7).integers(0, 2, (N, 4)).astype(float)


def blurred(rng, size=N):
    """A factor that sees neighbours alike, as a mask's shadow does; condition about 1e4."""
    at = np.linspace(0, size, M)[:, None] - np.arange(size)
    return np.exp(-(at**2) / 4) + 0.1 * rng.random((M, size))


def summed(model, family, image, noise, rng, truth=None, **options):
    """Problem of a model, the pair of factors, in frames that the pair ``truth`` forms."""
    lit = patterns(family)
    prepared = prepare(*model, lit, lit, **options)
    sums = prepared.accumulator()
    left, right = truth or model
    for i, row in enumerate(lit.T):
        for j, column in enumerate(lit.T):
            frame = (left * row) @ image @ (right * column).T
            sums.add(frame + noise * rng.normal(size=frame.shape), i, j)
    return prepared, prepared.problem(sums)


@pytest.mark.parametrize("family", ["uniform", "dots", "signed", "random"])
@pytest.mark.parametrize("options", [{}, {"centre": True}])
def test_frames_without_noise_leave_no_difference(family, options):
    """Rounding alone: 1e-12 of the largest number of W.

    (Planted: a half summed over the other half's rows; G of the whole.)
    """
    rng = np.random.default_rng(0)
    model = blurred(rng), blurred(rng)
    problem = summed(model, family, rng.random((N, N)), 0.0, rng, **options)[1]
    allowed = 1e-12 * np.abs(problem.projected).max()
    assert np.sqrt(problem.halves.typical) < allowed


@pytest.mark.parametrize("family", ["uniform", "dots", "signed", "random"])
@pytest.mark.parametrize("options", [{}, {"centre": True}])
def test_white_noise_has_its_variance_and_no_excess(family, options):
    """Of variance 9, by the median of 2 x 576 squares: 2.33 / sqrt(1152) = 7 %, five of them.

    One row or column of forty exceeds it by chance, and twice its variance: 5 % in the mean; where G is far from
    diagonal (random patterns) squares of a row hang together, and 25 % were seen. (Planted: G instead of G (I - G); the
    median not turned into a variance.)
    """
    rng = np.random.default_rng(1)
    model = blurred(rng), blurred(rng)
    problem = summed(model, family, rng.random((N, N)), 3.0, rng, **options)[1]
    assert problem.halves.typical == pytest.approx(9.0, rel=0.35)
    assert not is_misfit(problem)
    assert problem.halves.excess.mean() < 0.5 * 9.0
    assert np.median(coefficient_noise(problem)) == pytest.approx(noise_variance(problem), rel=0.35)


def test_errors_of_a_factor_are_noise_of_single_columns():
    """U_L^T E X (Phi_R V_R) has the variance e^2 ||X Phi_R^T u_j||^2 in column j, in closed form; errors of the right
    factor the same by rows.

    The first column has the image's brightness. Median over 40 draws of the first column's excess, each a median of 24
    squares: 2.33 / sqrt(24 x 40) = 8 %, three of them. (Planted: rows taken for columns; half the spread.)
    """
    rng = np.random.default_rng(2)
    truth, image, error = (blurred(rng), blurred(rng)), rng.random((N, N)), 0.02
    excess, expected = [], []
    for _ in range(40):
        model = truth[0] + error * rng.normal(size=(M, N)), truth[1]
        prepared, problem = summed(model, "uniform", image, 1e-3, rng, truth)
        light = image @ prepared.right.basis * prepared.right.singular
        excess.append(problem.halves.excess[:, 0])
        expected.append(error**2 * np.square(light[:, 0]).sum())
    assert np.median(excess) == pytest.approx(np.mean(expected), rel=0.25)
