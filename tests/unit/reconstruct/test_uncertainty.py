"""Uncertainty: its closed forms against linear algebra by hand, and how often it covers the truth under drawn noise."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.fft import idctn

from mitsim.core.exr import read_frame
from mitsim.core.manifests import Digital, FactorNoise
from mitsim.devices.patterns import parse_patterns
from mitsim.reconstruct.accumulation import EDGES, PRINT, Model, accumulate, print_energy
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.reconstruct.solver import DiagonalProblem, automatic_lambda, prepare
from mitsim.reconstruct.uncertainty import Propagation, scene_spectrum, uncertainty
from tests.ideal_sessions import CALIBRATION_ERROR, Bench, bench, picture, shadow

N, PIXELS = 6, 14
FAMILIES = "uniform", "dots:3", "hadamard:2", "random:3", "dots:3 markov"
NOISE = FactorNoise(left=0.01, right=0.02, unexplained=0.0)


def markov(size: int) -> np.ndarray:
    """(n, n) covariance of neighbours alike."""
    return 0.9 ** np.abs(np.subtract.outer(np.arange(size), np.arange(size)))


class Small:
    """A model small enough for its whole matrix A: 14 x 14 pixels, 6 x 6 scene, lambda 1e-3 of the largest sigma^2."""

    def __init__(self, patterns: str) -> None:
        patterns, _, prior = patterns.partition(" ")
        rng, family = np.random.default_rng(1), parse_patterns(patterns, N, 0)
        self.factors = tuple(rng.random((PIXELS, N)) for _ in range(2))
        self.patterns = family.left.astype(float), family.right.astype(float)
        prepared = prepare(*self.factors, *self.patterns)
        covariance = np.eye(N)
        if prior:
            prepared, covariance = prepared.with_correlation(), markov(N)
        lam = 1e-3 * (prepared.left.singular.max() * prepared.right.singular.max()) ** 2
        self.propagation = Propagation(Model(prepared, self.factors, self.patterns), lam)
        self.A = self.matrix(*self.factors)
        precision = np.linalg.inv(np.kron(covariance, covariance))
        self.solver = np.linalg.solve(self.A.T @ self.A + lam * precision, self.A.T)
        self.image = rng.random((N, N))

    def matrix(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """A (data, N^2) of all patterns, one after the other."""
        P_L, P_R = self.patterns
        return np.concatenate([np.kron(left * p, right * q) for p in P_L.T for q in P_R.T])


@pytest.mark.parametrize("patterns", FAMILIES)
def test_noise_of_frames(patterns: str) -> None:
    """Each frame has noise of its own that changes along the sensor's rows and columns, by up to three times.

    Coefficients are then correlated, which is left out: 10 % of a pixel's uncertainty at most, 30 % for random
    patterns, whose blocks share rows; the mean variance holds to 2 % and 10 %. Even noise is exact. (Planted: columns
    taken for even.)
    """
    small = Small(patterns)
    rng, counts = np.random.default_rng(2), [side.shape[1] for side in small.patterns]
    rows, columns = (rng.uniform(0.5, 1.5, (*counts, PIXELS)) for _ in range(2))
    columns *= rows.mean(axis=2, keepdims=True) / columns.mean(axis=2, keepdims=True)
    each = rows[..., :, None] * columns[..., None, :] / rows.mean(axis=2)[..., None, None]
    exact = np.square(small.solver) @ each.ravel()
    got = small.propagation.of_frames(rows, columns).ravel()
    loose = patterns.startswith("random")
    assert got.mean() == pytest.approx(exact.mean(), rel=0.1 if loose else 0.02)
    assert np.abs(np.sqrt(got / exact) - 1).max() < (0.3 if loose else 0.1)
    exact = np.square(small.solver).sum(axis=1)
    assert small.propagation.of_white(1.0).ravel() == pytest.approx(exact, rel=1e-9)
    even = np.ones((*counts, PIXELS))
    assert small.propagation.of_frames(even, even).ravel() == pytest.approx(exact, rel=1e-9)


def test_frames_without_light_have_finite_noise() -> None:
    """Variances are not negative, so that rows whose means are below 0 have none though some columns have. (Planted:
    divided by the rows' mean, which overflows; and by 0 of an ambient frame.)"""
    small = Small("dots:3")
    none, some = np.zeros((3, 3, PIXELS)), np.full((3, 3, PIXELS), 1e4)
    with np.errstate(all="raise"):
        assert not small.propagation.of_frames(none, some).any()
        assert not small.propagation.of_frames(none, none).any()
        assert not small.propagation.of_ambient_frame(none[0, 0], none[0, 0]).any()
        assert small.propagation.of_frames(some, some).all()


@pytest.mark.parametrize("patterns", FAMILIES)
def test_noise_of_factors(patterns: str) -> None:
    """Against the image's derivative by each number of both factors.

    G is a sum of few products: 1 % of its norm is left out. For random patterns rho leaves out correlations, and for
    neighbours alike. (Planted:
    one side's deviation used for both; the sides' bases exchanged; patterns left out of rho.)
    """
    small = Small(patterns)
    exact = np.zeros(N * N)
    for side, deviation in enumerate((NOISE.left, NOISE.right)):
        for place in np.ndindex(PIXELS, N):
            moved = [np.zeros((PIXELS, N)) if k == side else small.factors[k] for k in range(2)]
            moved[side][place] = deviation
            exact += np.square(small.solver @ (small.matrix(*moved) @ small.image.ravel()))
    got = sum(small.propagation.of_factors(NOISE, small.image)).ravel()
    if patterns.startswith("random"):
        assert got.mean() == pytest.approx(exact.mean(), rel=0.25)
    elif patterns.endswith("markov"):
        assert got.mean() == pytest.approx(exact.mean(), rel=0.05)
    else:
        assert got == pytest.approx(exact, rel=0.02)


@pytest.mark.parametrize("patterns", FAMILIES)
def test_noise_of_an_ambient_frame(patterns: str) -> None:
    """One draw in all frames alike; pairs of signed patterns do not see it, so theirs is judged as if they did.

    G is a sum of few products: 1 % of its norm is left out. (Planted: what coefficients share left out, which is 45 %
    for random patterns.)
    """
    small = Small(patterns)
    rng = np.random.default_rng(2)
    rows, columns = (rng.uniform(0.5, 1.5, PIXELS) for _ in range(2))
    columns *= rows.mean() / columns.mean()
    frames = small.solver.reshape(N * N, -1, PIXELS**2).sum(axis=1)
    exact = np.square(frames) @ np.outer(rows, columns).ravel() / rows.mean()
    assert small.propagation.of_ambient_frame(rows, columns).ravel() == pytest.approx(exact, rel=0.02, abs=1e-12)


@pytest.mark.parametrize("patterns", FAMILIES)
def test_light_that_is_off_by_its_sampling(patterns: str) -> None:
    """Independent errors of scene pixels' light come through as the image does, by (A^T A + lambda)^-1 A^T A."""
    small = Small(patterns)
    assert small.propagation.of_light(3.0).ravel() == pytest.approx(
        3 * np.square(small.solver @ small.A).sum(axis=1), rel=1e-3 if patterns.endswith("markov") else 1e-9
    )


def test_print_within_a_pixel() -> None:
    """The square of what light g / 12 pixels off the centre does to the image, along rows and along columns apart."""
    small = Small("dots:3")
    left, right = small.factors
    rows, columns = (np.gradient(small.image, axis=axis) / 12 for axis in (0, 1))
    exact = np.square(small.solver @ small.matrix(np.gradient(left, axis=1), right) @ rows.ravel())
    exact += np.square(small.solver @ small.matrix(left, np.gradient(right, axis=1)) @ columns.ravel())
    assert small.propagation.of_print(small.image).ravel() == pytest.approx(PRINT * exact, rel=1e-9)
    assert not small.propagation.of_print(np.ones((N, N))).any(), "an even print has nothing within its pixels"


@pytest.mark.parametrize("patterns", FAMILIES)
def test_energy_of_print_within_a_pixel(patterns: str) -> None:
    """What the same light puts outside the range of A. (Planted: the part inside not taken off.)"""
    small = Small(patterns)
    left, right = small.factors
    rows, columns = (np.gradient(small.image, axis=axis) / 12 for axis in (0, 1))
    basis, _ = np.linalg.qr(small.A)
    exact = 0.0
    for matrix, slope in (
        (small.matrix(np.gradient(left, axis=1), right), rows),
        (small.matrix(left, np.gradient(right, axis=1)), columns),
    ):
        moved = matrix @ slope.ravel()
        exact += float(np.square(moved - basis @ (basis.T @ moved)).sum())
    got = print_energy(small.propagation.model, small.image)
    assert got == pytest.approx(EDGES * exact, rel=1e-9)


def stationary(n: int, fall: float, seed: int) -> np.ndarray:
    """(n, n) an image of mean 0.5 and deviation 0.1 whose power falls with that power of frequency."""
    place = np.hypot(*np.meshgrid(np.arange(n), np.arange(n)))
    cosines = np.random.default_rng(seed).standard_normal((n, n)) * np.maximum(place, 1.0) ** (fall / 2)
    cosines[0, 0] = 0.0
    image = idctn(cosines, norm="ortho")
    return 0.5 + 0.1 * image / image.std()


@pytest.mark.parametrize("patterns", ["uniform", "dots:4", "hadamard:4", "dots:4 markov"])
@pytest.mark.parametrize("fall", [-1.0, -2.5])
def test_the_spectrum_tells_the_energy_of_what_is_not_seen(patterns: str, fall: float) -> None:
    """32 x 32 pixels, noise over half of the coefficients: what the image without the coefficients below the
    noise lacks is known to a factor of 1.5 in amplitude in the mean of six scenes, beside what is said in each.
    """
    patterns, _, prior = patterns.partition(" ")
    family, side = parse_patterns(patterns, 32, 0), shadow(n=32)
    prepared = prepare(side, side, family.left.astype(float), family.right.astype(float))
    prepared = prepared.with_correlation() if prior else prepared
    sigma = np.outer(prepared.left.singular, prepared.right.singular)
    ratios = []
    for seed in range(6):
        image, rng = stationary(32, fall, seed), np.random.default_rng([seed, 1])
        sides = [side.basis if side.dual is None else side.dual for side in (prepared.left, prepared.right)]
        exact = sides[0].T @ image @ sides[1]
        variance = 0.1**2 * float(np.median(np.square(sigma)))
        data = sigma * exact + np.sqrt(variance) * rng.standard_normal(sigma.shape)
        found = scene_spectrum((prepared.left, prepared.right), DiagonalProblem(sigma, data, 1.0, 2), variance)
        assert found.mean == pytest.approx(0.5, abs=3 * np.sqrt(found.mean_variance))
        lost = (np.square(sigma) * 0.1**2 < variance).astype(float)
        detail = exact - 0.5 * found.even
        ratio = np.log(float((lost * found.energy).sum() / (lost * np.square(detail)).sum()))
        assert abs(ratio) < 3 * np.sqrt(found.spread(lost)) + 2 * np.log(1.5), (seed, ratio)
        ratios.append(ratio)
    assert abs(np.mean(ratios)) < 2 * np.log(1.5), ratios


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (33, 2)])
def test_scenes_of_few_pixels_have_a_spectrum_too(shape: tuple[int, int]) -> None:
    """A single pixel has no detail, a row one direction; lambda of the largest sigma^2 takes half and
    more away. (Planted: the usual detail divided by that of a scene without any.)"""
    rng = np.random.default_rng(0)
    factors, patterns = tuple(rng.random((2 * size + 3, size)) for size in shape), [np.ones((n, 1)) for n in shape]
    prepared, image = prepare(*factors, *patterns), rng.uniform(0.5, 1.0, shape)
    sums = prepared.accumulator()
    with np.errstate(all="raise"):
        sums.add(factors[0] @ image @ factors[1].T + 1e-3 * rng.standard_normal([len(side) for side in factors]), 0, 0)
        problem = prepared.problem(sums)
        propagation = Propagation(Model(prepared, factors, tuple(patterns)), problem.scale)
        found, factor = propagation.of_regularisation(problem, 1e-6)
    assert np.isfinite(found).all() and factor >= 1
    assert np.sqrt(found.mean()) > 0.2


def test_what_lambda_takes_away() -> None:
    """Over all of the image, the lost part of the energy; more where the image has detail than where it is even."""
    shots, factors = bench().run("uniform", picture(), 0), bench().calibrated(0)
    sums = accumulate(shots, factors)
    problem = sums.prepared.problem(sums.frames)
    lam = automatic_lambda(problem)
    propagation = Propagation(sums.model, lam)
    found, factor = propagation.of_regularisation(problem, 0.0)
    lost = np.square((1 - problem.kept_share(lam)) * sums.prepared.coefficients(picture()))
    assert lost.mean() / 2 < found.mean() < 4 * lost.mean()  # never above twice the error
    assert 1 < factor < 2
    found, _ = Propagation(sums.model, 1e-6 * problem.scale).of_regularisation(problem, 0.0)
    detail = np.hypot(*np.gradient(picture()))
    assert found[detail > np.quantile(detail, 0.8)].mean() > 1.25 * found[detail < np.quantile(detail, 0.2)].mean()
    assert not Propagation(sums.model, 0.0).of_regularisation(problem, 0.0)[0].any()


@pytest.mark.parametrize(("patterns", "peak"), [("hadamard:4", 80.0), ("hadamard:4", 500.0), ("uniform", 80.0)])
def test_little_light_is_neither_covered_badly_nor_overstated(patterns: str, peak: float) -> None:
    """64 x 64 pixels and 80 electrons, so that lambda takes most detail: stated are 0.6 to 2 times the error, and 90 %
    are inside. (A power law of the coefficients' rank: 2.6, 1.6 and 6.3 times the error.)"""
    side = shadow(n=64)
    seen = Bench(side, side, peak=peak)
    truth = picture(1, 64)
    image = reconstruct(seen.run(patterns, truth, 1), seen.calibrated(1))
    assert image.uncertainty is not None
    error = image.image - truth
    ratio = np.sqrt(np.square(image.uncertainty).mean() / np.square(error).mean())
    assert 0.6 < ratio < 2 and np.mean(np.abs(error) < 1.96 * image.uncertainty) > 0.9


@dataclass(frozen=True)
class FlatCam(Bench):
    """A mask (1 + m m^T) / 2: its constant term lights all pixels alike and is centred away."""

    def light(self, shown: np.ndarray) -> np.ndarray:
        return np.maximum(shown.sum() * np.abs(self.left).max() ** 2 + super().light(shown), 0.0) / 2

    def calibrated(self, seed: int, error: float = CALIBRATION_ERROR) -> Factors:
        found = super().calibrated(seed, error)
        centred = found.manifest.model_copy(update={"centre": True})
        return Factors(found.left / np.sqrt(2), found.right / np.sqrt(2), centred, found.status)


@pytest.mark.parametrize(("lam", "lost"), [("auto", False), (1e3, True)])
def test_an_image_of_which_lambda_takes_most_is_flagged(lam: float, lost: bool) -> None:
    """80 electrons and 64 Hadamard patterns: dim, but an image, unless lambda is a thousand times the largest sigma^2.
    (Planted: never flagged; flagged from a tenth of what is left.)"""
    side = shadow(n=32)
    seen = Bench(side, side, peak=80.0)
    shots, factors = seen.run("hadamard:4", picture(1, 32), 1), seen.calibrated(1)
    sums = accumulate(shots, factors)
    lam = lam if isinstance(lam, str) else lam * sums.prepared.problem(sums.frames).scale
    image = reconstruct(shots, factors, lam)
    assert ("Lambda takes away more" in str(image.status)) is lost
    assert image.ok is not lost


def test_what_lambda_takes_away_of_as_many_data_as_unknowns() -> None:
    """8 x 8 pixels under 2 x 2 patterns leave no data to tell the noise: the mean of the frames' stated variance is
    taken; their sum would change the answer by percents. (Planted: their sum.)"""
    rng = np.random.default_rng(0)
    camera = Bench(*(rng.random((8, 16)) for _ in range(2)), peak=20.0)
    shots, factors = camera.run("dots:2", picture(), 0), camera.calibrated(0)
    sums = accumulate(shots, factors)
    problem, stated = sums.prepared.problem(sums.frames), float(np.mean(sums.noise.variance))
    lam = 1e-2 * problem.scale
    uncertainties = reconstruct(shots, factors, lam).uncertainties
    assert uncertainties and sums.noise.variance.shape == (2, 2)
    got = np.square(uncertainties.sources["regularisation_bias"])
    propagation = Propagation(sums.model, lam)
    assert got == pytest.approx(propagation.of_regularisation(problem, stated)[0], rel=1e-9)
    other, _ = propagation.of_regularisation(problem, 4 * stated)
    assert abs(other.mean() / got.mean() - 1) > 0.01


@pytest.mark.parametrize("patterns", ["dots:3", "hadamard:4"])
def test_truth_lies_within_twice_the_uncertainty(patterns: str) -> None:
    """30 sessions, each with a new calibration and new noise: 7680 pixels, of which 95 % shall lie within 1.96 u.

    The binomial deviation is 0.25 %; pixels of one calibration move together a little, so 1.5 % are allowed. The scene
    is even within its pixels, and lambda next to nothing. (Planted: the
    variance of the -1 half left out, 90 %; the factors' noise left out.)
    """
    camera, scene, inside = bench(), picture(), []
    for seed in range(30):
        shots, factors = camera.run(patterns, scene, seed), camera.calibrated(seed, 0.008)
        image = reconstruct(shots, factors, 1e-9)
        budget, sources = image.uncertainties.budget, image.uncertainties.sources
        known = np.hypot(sources["frame_noise"], sources["calibration_noise"])
        inside.append(np.abs(image.image - scene) < 1.96 * known)
        assert budget["calibration_noise"] > 0.3 * budget["frame_noise"], "it shall matter"
    assert np.mean(inside) == pytest.approx(0.95, abs=0.015)


def test_noise_that_the_residual_does_not_show_is_not_stated() -> None:
    """The random part follows chi-square where that is off by more than 1.5; all else stays. And noise larger than the
    image is said."""
    camera = bench()
    data = accumulate(camera.run("dots:4", picture(), 1), camera.calibrated(1))
    solution = data.solution("auto")
    stated = uncertainty(data, solution)
    for chi_square, factor in ((0.015, 0.015**0.5), (0.7, 1.0), (1.4, 1.0), (9.0, 3.0)):
        found = uncertainty(data, solution, chi_square)
        assert np.allclose(found.sources["frame_noise"], factor * stated.sources["frame_noise"])
        assert np.allclose(found.sources["calibration_noise"], stated.sources["calibration_noise"])
        assert found.loss(solution.image) == ""
    assert "hardly more than noise" in uncertainty(data, solution, 1e8).loss(solution.image)


def test_light_that_a_run_states_to_be_off_is_off_in_the_image() -> None:
    """Every scene pixel's light by 3 %, which next to no lambda leaves as it is."""
    shots, factors = bench().run("dots:3", picture(), 0), bench().calibrated(0)
    shots.manifest = shots.manifest.model_copy(update={"light_error": 0.03})
    image = reconstruct(shots, factors, 1e-9)
    assert image.uncertainties.sources["rendering"] == pytest.approx(0.03, rel=1e-3)


def test_exposure_scales_the_image() -> None:
    """Relative uncertainties of both exposures together, 3 % and 4 %, are 5 % of the image."""
    shots, factors = bench().run("dots:3", picture(), 0), bench().calibrated(0)
    digital = shots.manifest.digital.model_copy(update={"exposure_uncertainty": 0.03})
    session = Digital(
        exposure_s=1, gain_dn_per_e=1, black_level_dn=0, dark_current_e_per_s=0, exposure_uncertainty=0.04
    )
    shots.manifest = shots.manifest.model_copy(update={"digital": digital})
    factors = replace(factors, manifest=factors.manifest.model_copy(update={"digital": session}))
    image = reconstruct(shots, factors)
    assert image.uncertainties.sources["exposure"] == pytest.approx(0.05 * np.abs(image.image), rel=1e-9)


def test_the_uncertainty_is_written(tmp_path: Path) -> None:
    shots, factors = bench().run("dots:3", picture(), 0), bench().calibrated(0)
    image = reconstruct(shots, factors)
    image.save(tmp_path / "image")
    written, _ = read_frame(tmp_path / "image" / "uncertainty.exr")
    assert written.keys() == {"uncertainty", "random", "systematic"}
    assert np.allclose(written["uncertainty"], np.hypot(written["random"], written["systematic"]), rtol=1e-6)
    assert image.uncertainty is not None and np.allclose(written["uncertainty"], image.uncertainty, rtol=1e-6)
    result = json.loads((tmp_path / "image" / "result.json").read_text())
    assert result["uncertainty"] == pytest.approx(np.sqrt(np.mean(image.uncertainty**2)))
    assert {"frame_noise", "calibration_noise", "regularisation_bias"} <= result["uncertainty_budget"].keys()
    # Least total variation is not linear in the frames: nothing is stated, and no old file is left.
    other = reconstruct(shots, factors, method="tv")
    other.save(tmp_path / "image", overwrite=True)
    assert other.uncertainty is None and not (tmp_path / "image" / "uncertainty.exr").exists()
    assert json.loads((tmp_path / "image" / "result.json").read_text())["uncertainty"] is None
