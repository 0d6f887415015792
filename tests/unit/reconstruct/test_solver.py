"""The streamed, projected solution equals the dense least-squares one, and says when it cannot.

Images of correlated pixels: the dense solution, the closed form of the covariance, and what it is for.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import hadamard

from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import parse_patterns
from mitsim.reconstruct import solver
from mitsim.reconstruct.depth import project_frames
from mitsim.reconstruct.reconstruct import reconstruct
from tests.ideal_sessions import Bench


def dots(n, k):
    return (np.arange(n)[:, None] % k == np.arange(k)).astype(float)


def families(n):
    rng = np.random.default_rng(5)
    return {
        "uniform": np.ones((n, 1)),
        "dots": dots(n, 3),
        "repeated hadamard": np.tile(hadamard(4), (n // 4 + 1, 1))[:n].astype(float),
        "random": (rng.random((n, 4)) < 0.6).astype(float),
        "grey": rng.random((n, 3)),
        "with a dark row": dots(n, 3) * (np.arange(n) != 4)[:, None],
        "with a black pattern": np.pad(dots(n, 3), ((0, 0), (1, 1))),
    }


def frames_of(left, right, P_L, P_R, image):
    return {(i, j): left @ (np.outer(p, q) * image) @ right.T for i, p in enumerate(P_L.T) for j, q in enumerate(P_R.T)}


def solve(left, right, P_L, P_R, frames, lam, **options):
    prepared = solver.prepare(left, right, P_L, P_R, **options)
    sums = prepared.accumulator()
    for (i, j), frame in frames.items():
        sums.add(frame, i, j)
    return prepared.solve(sums, lam)


def dense(left, right, P_L, P_R, frames, lam):
    """Tikhonov solution by one stacked matrix of the whole image, nothing separable about it."""
    blocks = [np.kron(left * P_L[:, i], right * P_R[:, j]) for i, j in frames]
    matrix, data = np.concatenate(blocks), np.concatenate([frame.ravel() for frame in frames.values()])
    unknowns = matrix.shape[1]
    stacked = np.concatenate([matrix, np.sqrt(lam) * np.eye(unknowns)])
    image = np.linalg.lstsq(stacked, np.concatenate([data, np.zeros(unknowns)]), rcond=1e-13)[0]
    residual = np.linalg.norm(data - matrix @ image) / np.linalg.norm(data)
    return image.reshape(left.shape[1], right.shape[1]), residual


@pytest.mark.parametrize("family", families(8))
@pytest.mark.parametrize("lam", [0.0, 0.3])
def test_equals_the_dense_solution(family, lam):
    # Noisy frames of other row and column sizes, so that transposed sides would show.
    rng = np.random.default_rng(1)
    left, right = rng.random((13, 8)), rng.random((11, 7))
    P_L, P_R = families(8)[family], families(7)[family]
    frames = frames_of(left, right, P_L, P_R, rng.random((8, 7)))
    frames = {key: frame + 0.1 * rng.normal(size=frame.shape) for key, frame in frames.items()}
    expected, residual = dense(left, right, P_L, P_R, frames, lam)
    solution = solve(left, right, P_L, P_R, frames, lam)
    np.testing.assert_allclose(solution.image, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    assert solution.residual == pytest.approx(residual, rel=1e-6)
    assert solution.lam == lam


def test_block_structure_is_found_and_lit_columns_only_are_touched():
    k, n = 7, 30
    blocks = solver.pattern_blocks(dots(n, k))
    assert [list(b) for b in blocks] == [list(range(r, n, k)) for r in range(k)]
    side = solver.prepare(np.random.default_rng(0).random((40, n)), np.eye(3), dots(n, k), np.eye(3)).left
    assert [slab.matrix.shape[1] for slab in side.slabs] == [len(b) for b in blocks]
    assert len(solver.pattern_blocks(np.tile(hadamard(4), (5, 1)).astype(float))) == 4
    assert len(solver.pattern_blocks(np.ones((9, 2)))) == 1
    # 0.1 and 0.3 are not exact: rows orthogonal only up to rounding are not taken apart.
    assert len(solver.pattern_blocks(np.array([[0.1, 0.3], [0.3, -0.1]]))) == 1
    # Whole numbers are exact as long as their products are: 2^80 is 0 in 64 bits.
    assert len(solver.pattern_blocks(np.array([[100.0, 100.0], [100.0, -100.0]]))) == 2
    assert len(solver.pattern_blocks(np.array([[2.0**40, 0.0], [2.0**40, 1.0]]))) == 1


@pytest.mark.parametrize(
    ("patterns", "stated", "lost", "limit"),
    [
        (1, (8, 8), 0, "rounding"),
        (1, (5, 8), 24, "the calibration's noise"),
        (2, (5, 3), 16, "the calibration's noise"),
    ],
)
def test_factors_of_less_rank_lose_directions_that_patterns_bring_back(patterns, stated, lost, limit):
    """Each pattern measures as many directions as the factor has above its noise. (Planted: the larger of both.)"""
    factor = np.random.default_rng(2).random((12, 8))
    prepared = solver.prepare(factor, factor, dots(8, patterns), dots(8, patterns))
    assert replace(prepared, stated=stated).lost == (lost, limit)


def test_condition_covers_all_blocks_and_the_worse_side():
    left, right = np.diag([8.0, 1.0, 4.0, 1.0]), np.diag([3.0, 1.0])
    prepared = solver.prepare(left, right, dots(4, 2), np.ones((2, 1)))
    assert prepared.condition == pytest.approx(64.0)
    assert (prepared.unknowns, prepared.rank) == (4 * 2, 4 * 2)
    whole = np.kron(left.T @ left * (dots(4, 2) @ dots(4, 2).T), right.T @ right)
    assert prepared.left.condition * prepared.right.condition == pytest.approx(np.linalg.cond(whole), rel=1e-9)
    assert solver.prepare(right, left, np.ones((2, 1)), dots(4, 2)).condition == pytest.approx(64.0)


def test_ill_conditioned_data_recovered_at_lambda_zero():
    # cond(A) = 1e12 a side and both sides together 1e12 in sigma: the projected form leaves 1e12 eps = 2e-4.
    rng = np.random.default_rng(2)
    u, _ = np.linalg.qr(rng.normal(size=(24, 12)))
    v, _ = np.linalg.qr(rng.normal(size=(12, 12)))
    factor = u * np.logspace(0, -6, 12) @ v.T
    image = rng.random((12, 12))
    frames = {(0, 0): factor @ image @ factor.T}
    one = np.ones((12, 1))
    assert np.abs(solve(factor, factor, one, one, frames, 0.0).image - image).max() < 1e-2


def test_values_are_neither_clipped_nor_normalised():
    rng = np.random.default_rng(4)
    factor, one = rng.random((20, 5)), np.ones((5, 1))
    image = 1e3 * rng.normal(size=(5, 5))
    frames = frames_of(factor, factor, one, one, image)
    np.testing.assert_allclose(solve(factor, factor, one, one, frames, 0.0).image, image, rtol=1e-8)


def test_solving_changes_nothing_prepared_and_sums_do_not_grow():
    rng = np.random.default_rng(4)
    factor, P = rng.random((20, 6)), dots(6, 2)
    prepared = solver.prepare(factor, factor, P, P)
    first, second = prepared.accumulator(), prepared.accumulator()
    for key, frame in frames_of(factor, factor, P, P, rng.random((6, 6))).items():
        first.add(frame, *key)
        second.add(frame, *key)
        assert first.sum.shape == (6, 6)
    np.testing.assert_array_equal(prepared.solve(first, 0.1).image, prepared.solve(second, 0.1).image)
    np.testing.assert_array_equal(prepared.solve(first, 0.1).image, prepared.solve(first, 0.1).image)
    with pytest.raises(ValueError, match="read-only"):
        prepared.left.singular[0] = 1.0


@pytest.mark.parametrize(
    ("frame", "row", "column", "words"),
    [
        (np.ones((5, 4)), 0, 0, "shape"),
        (np.full((5, 5), np.nan), 0, 0, "not finite"),
        (np.full((5, 5), np.inf), 0, 0, "not finite"),
        (np.ones((5, 5), complex), 0, 0, "complex"),
        (np.ones((5, 5)), 2, 0, "pattern index"),
        (np.ones((5, 5)), 0, -1, "pattern index"),
        (np.ones((5, 5)), 0.0, 0, "pattern index"),
    ],
)
def test_bad_frames_are_refused_and_leave_the_sum_alone(frame, row, column, words):
    sums = solver.prepare(np.eye(5, 4), np.eye(5, 4), dots(4, 2), dots(4, 2)).accumulator()
    with pytest.raises(MitsimError, match=words):
        sums.add(frame, row, column)
    assert not sums.sum.any()
    assert len(sums.missing) == 4


def test_missing_repeated_and_foreign_frames_are_refused():
    prepared = solver.prepare(np.eye(5, 4), np.eye(5, 4), dots(4, 2), dots(4, 2))
    sums = prepared.accumulator()
    sums.add(np.ones((5, 5)), 0, 1)
    with pytest.raises(MitsimError, match="added before"):
        sums.add(np.ones((5, 5)), 0, 1)
    with pytest.raises(MitsimError, match="3 of 4 frames are missing"):
        prepared.solve(sums, 0.1)
    other = solver.prepare(np.eye(5, 4), np.eye(5, 4), dots(4, 2), dots(4, 2))
    with pytest.raises(MitsimError, match="other factors"):
        other.solve(sums, 0.1)


@pytest.mark.parametrize("lam", [-1.0, float("nan"), float("inf"), "often"])
def test_bad_lambda_is_refused(lam):
    prepared = solver.prepare(np.eye(5, 4), np.eye(5, 4), np.ones((4, 1)), np.ones((4, 1)))
    sums = prepared.accumulator()
    sums.add(np.ones((5, 5)), 0, 0)
    with pytest.raises(MitsimError, match="lambda"):
        prepared.solve(sums, lam)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"left": np.ones(4)}, "2-D"),
        ({"left": np.full((5, 4), np.nan)}, "not finite"),
        ({"P_L": np.ones((3, 1))}, "same number"),
        ({"P_R": np.zeros((4, 1))}, "all zero"),
    ],
)
def test_bad_models_are_refused(change, words):
    good = {"left": np.eye(5, 4), "right": np.eye(5, 4), "P_L": np.ones((4, 1)), "P_R": np.ones((4, 1))}
    with pytest.raises(MitsimError, match=words):
        solver.prepare(**(good | change))


@pytest.mark.parametrize("rows", families(9))
@pytest.mark.parametrize("columns", families(9))
def test_all_frames_at_once_are_the_sum_of_each(rows, columns):
    rng = np.random.default_rng(3)
    left, right = families(9)[rows], families(9)[columns]
    prepared = solver.prepare(rng.random((12, 9)), rng.random((14, 9)), left, right)
    frames = rng.random((left.shape[1], 12, right.shape[1], 14))
    sums = prepared.accumulator()
    for i, j in np.ndindex(left.shape[1], right.shape[1]):
        sums.add(frames[i, :, j], i, j)
    np.testing.assert_allclose(project_frames(prepared.left, prepared.right, frames), sums.sum, rtol=1e-12, atol=1e-12)


# ---- Correlated neighbours ----


ROWS, COLUMNS = 8, 7
FAMILIES = "uniform", "dots:3", "hadamard:2", "random:3"


def model(patterns: str) -> tuple[solver.Prepared, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """A small model, its matrix and its patterns; rows and columns differ in number, so that exchanged sides show."""
    rng = np.random.default_rng(1)
    left, right = rng.random((13, ROWS)), rng.random((11, COLUMNS))
    P_L, P_R = (parse_patterns(patterns, size, 0).left.astype(float) for size in (ROWS, COLUMNS))
    whole = np.concatenate([np.kron(left * p, right * q) for p in P_L.T for q in P_R.T])
    return solver.prepare(left, right, P_L, P_R).with_correlation(), whole, (P_L, P_R)


def solved(prepared: solver.Prepared, data: np.ndarray, counts: tuple[int, int], lam: float) -> solver.Solution:
    sums = prepared.accumulator()
    for place, frame in zip(np.ndindex(counts), data, strict=True):
        sums.add(frame, *place)
    return prepared.solve(sums, lam)


def covariance(size: int) -> np.ndarray:
    place = np.arange(size)
    return solver.NEIGHBOURS ** np.abs(np.subtract.outer(place, place))


@pytest.mark.parametrize("lam", [0.0, 0.3])
@pytest.mark.parametrize("patterns", FAMILIES)
def test_equals_the_dense_solution_with_the_inverse_covariance(patterns: str, lam: float) -> None:
    """(A^T A + lambda C^-1)^-1 A^T y of noisy data. (Planted: the root of one side transposed; slabs not turned.)"""
    prepared, whole, lit = model(patterns)
    rng, counts = np.random.default_rng(2), (lit[0].shape[1], lit[1].shape[1])
    data = whole @ rng.random(ROWS * COLUMNS)
    data += 0.1 * rng.standard_normal(data.shape)
    precision = np.linalg.inv(np.kron(covariance(ROWS), covariance(COLUMNS)))
    expected = np.linalg.solve(whole.T @ whole + lam * precision, whole.T @ data)
    found = solved(prepared, data.reshape(-1, 13, 11), counts, lam)
    assert found.image.ravel() == pytest.approx(expected, abs=1e-8 * np.abs(expected).max())
    residual = np.linalg.norm(data - whole @ expected) / np.linalg.norm(data)
    assert found.residual == pytest.approx(residual, rel=1e-6)


def test_equal_sides_are_factorised_once() -> None:
    factor, lit = np.random.default_rng(0).random((9, 5)), np.ones((5, 1))
    found = solver.prepare(factor, factor, lit, lit).with_correlation()
    assert found.left is found.right and found.left.slabs[0].matrix.shape == (9, 5)


def test_rounding_is_told_by_the_covariance_too() -> None:
    """Eigenvalues of C are (1 - rho) / (1 + rho) to (1 + rho) / (1 - rho) of many pixels: 19 a side for F at most."""
    prepared, whole, _ = model("dots:3")
    data = (whole @ np.ones(ROWS * COLUMNS)).reshape(-1, 13, 11)
    bare = replace(prepared, **{side: replace(getattr(prepared, side), spread=1.0) for side in ("left", "right")})
    spread = prepared.left.spread * prepared.right.spread
    assert 19 < spread < 19**2
    found, usual = (solved(each, data, (3, 3), 1e-3) for each in (prepared, bare))
    assert found.rounding == pytest.approx(spread * usual.rounding, rel=1e-9)


def noisy() -> tuple[Bench, np.ndarray]:
    """A camera of few photons, and a scene of two even halves."""
    rng = np.random.default_rng(0)
    scene = np.full((16, 16), 0.2)
    scene[:, 8:] = 0.7
    return Bench(*(rng.random((40, 16)) for _ in range(2)), peak=30.0), scene


def test_the_truth_lies_within_twice_the_uncertainty() -> None:
    """Twenty captures with lambda next to nothing, each with a new calibration: 95 % of the pixels within 1.96 u of the
    frames' and the calibration's noise; 1.5 % are allowed, as in test_uncertainty.py. (Planted: the basis for its
    dual.)"""
    camera, scene = noisy()
    inside = []
    for seed in range(20):
        shots, factors = camera.run("dots:4", scene, seed), camera.calibrated(seed, 0.01)
        found = reconstruct(shots, factors, 1e-9, method="markov")
        sources = found.uncertainties.sources
        known = np.hypot(sources["frame_noise"], sources["calibration_noise"])
        inside.append(np.abs(found.image - scene) < 1.96 * known)
    assert np.mean(inside) == pytest.approx(0.95, abs=0.015)


# ---- Noise by halves of the sensor -----------------------------------------------------------------------------------

# What the halves of the sensor disagree on is noise and errors of the factors, and never the image.

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
    prepared = solver.prepare(*model, lit, lit, **options)
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
    assert not solver.is_misfit(problem)
    assert problem.halves.excess.mean() < 0.5 * 9.0
    assert np.median(solver.coefficient_noise(problem)) == pytest.approx(solver.noise_variance(problem), rel=0.35)


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
