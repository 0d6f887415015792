"""Images of correlated pixels: the dense solution, the closed form of the covariance, and what it is for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsim.devices.patterns import parse_patterns
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.reconstruct.solution import Solution
from mitsim.reconstruct.solver import NEIGHBOURS, Prepared, covariance_root, prepare
from tests.ideal_sessions import Bench

ROWS, COLUMNS = 8, 7
FAMILIES = "uniform", "dots:3", "hadamard:2", "random:3"


def model(patterns: str) -> tuple[Prepared, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """A small model, its matrix and its patterns; rows and columns differ in number, so that exchanged sides show."""
    rng = np.random.default_rng(1)
    left, right = rng.random((13, ROWS)), rng.random((11, COLUMNS))
    P_L, P_R = (parse_patterns(patterns, size, 0).left.astype(float) for size in (ROWS, COLUMNS))
    whole = np.concatenate([np.kron(left * p, right * q) for p in P_L.T for q in P_R.T])
    return prepare(left, right, P_L, P_R).with_correlation(), whole, (P_L, P_R)


def solved(prepared: Prepared, data: np.ndarray, counts: tuple[int, int], lam: float) -> Solution:
    sums = prepared.accumulator()
    for place, frame in zip(np.ndindex(counts), data, strict=True):
        sums.add(frame, *place)
    return prepared.solve(sums, lam)


def covariance(size: int) -> np.ndarray:
    place = np.arange(size)
    return NEIGHBOURS ** np.abs(np.subtract.outer(place, place))


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


@pytest.mark.parametrize("left", ["five rows of pixels", "rank five"])
@pytest.mark.parametrize("lam", [0.0, 0.3])
def test_what_frames_do_not_tell_is_the_likeliest(left: str, lam: float) -> None:
    """Of fewer data than unknowns C A^T (A C A^T + lambda)^+ y, the image of the least X^T C^-1 X at lambda 0.
    (Planted: all right vectors; values that are zero but for rounding kept.)"""
    rng = np.random.default_rng(1)
    few, right = rng.random((5, ROWS)), rng.random((11, COLUMNS))
    factor = few if left == "five rows of pixels" else rng.random((13, 5)) @ few
    lit = [parse_patterns("uniform", size, 0).left.astype(float) for size in (ROWS, COLUMNS)]
    whole, known = np.kron(factor, right), np.kron(covariance(ROWS), covariance(COLUMNS))
    data = whole @ rng.random(ROWS * COLUMNS)
    data += 0.1 * rng.standard_normal(data.shape)
    inverse = np.linalg.pinv(whole @ known @ whole.T + lam * np.eye(len(whole)), rcond=1e-12)
    expected = known @ whole.T @ inverse @ data
    prepared = prepare(factor, right, *lit).with_correlation()
    found = solved(prepared, data.reshape(1, *factor.shape[:1], 11), (1, 1), lam)
    assert found.image.ravel() == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())


def test_a_rank_stays_what_it_is() -> None:
    """Rounding of a camera of 64 pixels and rank 20 makes values of 1e-14 of the largest. (Planted: kept; cut at
    eps / n; ones in their place.)"""
    rng, lit = np.random.default_rng(0), np.ones((64, 1))
    side = prepare(*(rng.random((128, 20)) @ rng.random((20, 64)) for _ in range(2)), lit, lit).with_correlation().left
    assert (side.singular == 0).sum() == 44 and side.singular[19] > 1e-4 * side.singular[0]


def test_coefficients_see_light_as_the_frames_have_it() -> None:
    """W = response_L^T X response_R for any image X, and the image of W / sigma is X. (Planted: the basis for its
    dual.)"""
    prepared, whole, _ = model("dots:3")
    image = np.random.default_rng(3).random((ROWS, COLUMNS))
    sums = prepared.accumulator()
    for place, frame in zip(np.ndindex(3, 3), (whole @ image.ravel()).reshape(-1, 13, 11), strict=True):
        sums.add(frame, *place)
    problem = prepared.problem(sums)
    assert problem.projected == pytest.approx(prepared.left.response.T @ image @ prepared.right.response, abs=1e-10)
    assert prepared.image(problem.projected / problem.sigma) == pytest.approx(image, abs=1e-9)


def test_the_covariance_is_that_of_a_first_order_markov_field() -> None:
    """Its inverse is tridiagonal with 1 / (1 - rho^2) at both ends and (1 + rho^2) / (1 - rho^2) between."""
    root = covariance_root(9)
    precision = np.linalg.inv(root @ root.T) * (1 - NEIGHBOURS**2)
    exact = np.diag([1.0, *[1 + NEIGHBOURS**2] * 7, 1.0]) - NEIGHBOURS * (np.eye(9, k=1) + np.eye(9, k=-1))
    assert precision == pytest.approx(exact, abs=1e-9)


def test_equal_sides_are_factorised_once() -> None:
    factor, lit = np.random.default_rng(0).random((9, 5)), np.ones((5, 1))
    found = prepare(factor, factor, lit, lit).with_correlation()
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


def test_even_parts_of_a_noisy_image_keep_their_brightness() -> None:
    """Twelve captures of few photons: Tikhonov's lambda draws the means of both halves to each other by 13 and 32 %,
    neighbours alike lose 2 and 8 %, and a quarter of the error is left. (Planted: rho of 0.)"""
    camera, scene = noisy()
    errors, means = {"tikhonov": [], "markov": []}, {"tikhonov": [], "markov": []}
    for seed in range(12):
        shots, factors = camera.run("dots:4", scene, seed), camera.calibrated(seed)
        for method in errors:
            image = reconstruct(shots, factors, method=method).image
            errors[method].append(np.square(image - scene).mean())
            means[method].append((image[:, 1:7].mean(), image[:, 9:15].mean()))
    off = {method: np.abs(np.mean(found, axis=0) / (0.2, 0.7) - 1) for method, found in means.items()}
    assert np.mean(errors["markov"]) < 0.4 * np.mean(errors["tikhonov"])
    assert (off["markov"] < 0.4 * off["tikhonov"]).all() and off["tikhonov"].min() > 0.1


def test_the_truth_lies_within_twice_the_uncertainty() -> None:
    """Twenty captures with lambda next to nothing, each with a new calibration: 95 % of the pixels within 1.96 u of the
    frames' and the calibration's noise; 1.5 % are allowed, as in test_uncertainty.py. (Planted: the basis for its
    dual.)"""
    camera, scene = noisy()
    inside = []
    for seed in range(20):
        shots, factors = camera.run("dots:4", scene, seed), camera.calibrated(seed, 0.01)
        found = reconstruct(shots, factors, 1e-9, method="markov")
        assert found.uncertainties is not None
        sources = found.uncertainties.sources
        inside.append(
            np.abs(found.image - scene) < 1.96 * np.hypot(sources["frame_noise"], sources["calibration_noise"])
        )
    assert np.mean(inside) == pytest.approx(0.95, abs=0.015)
