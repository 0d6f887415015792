"""Standard uncertainty for each pixel of an image by source, from the factorised model, lambda and stated noise.

*Noise of frames.* With G = sigma / (sigma^2 + lambda) the image X = V_L (G o W) V_R^T is linear in the frames.
Independent noise of variance v in all data leaves

    var X = (V_L o V_L) (v G o G) (V_R o V_R)^T

With the variance of frame (i, j) as a product of its means by sensor row and column, v_ij = r_ij c_ij^T / mean, v
becomes sum_ij ((U_Li o U_Li)^T r_ij) ((U_Rj o U_Rj)^T c_ij)^T / mean. Correlations between coefficients, of ``random``
patterns, are neglected. The noise N of a frame that is subtracted from all others adds (sum_i U_Li)^T N (sum_j U_Rj)
to W. With G = sum_k g_k h_k^T its image is sum_k A_k N B_k^T, A_k = V_L diag(g_k) (sum_i U_Li)^T.

*Noise of factors.* Independent errors of deviation s_L are the same in all frames. With Q = X V_R S_R they change the
image by V_L [G o (T Q)] V_R^T to first order, where T = sum_i U_Li^T d_L diag(p_i) has independent numbers of variance
s_L^2 rho[a, p], rho[a, p] = ||sum_i P_L[p, i] U_Li[:, a]||^2. So

    var X[p, q] = s_L^2 sum_a V_L[p, a]^2 sum_p' rho[a, p'] (sum_b G[a, b] Q[p', b] V_R[q, b])^2

and likewise with the sides exchanged. Where V is not orthonormal, V makes the image and its dual responds to light.

*Print* within a projector pixel: a ramp of slope g a pixel has its light g / 12 pixels off the centre; finer print
follows from the disagreement of the sensor's halves (:mod:`mitsim.reconstruct.accumulation`). *Regularisation* removes
lambda x / (sigma^2 + lambda) of each coefficient x, as large as the scene's energy there.

*The scene's spectrum.* A scene is a mean m, and stationary detail, whose cosine coefficients are independent with a
variance S of frequency. Coefficient (a, b) of the diagonal basis, whose vectors have the cosines C_L and C_R and whose
image of ones is c, is m c_ab and detail of the mean square e = sum_kl C_L[k, a]^2 S[k, l] C_R[l, b]^2. Its datum has
the variance sigma^2 e + noise about sigma m c. S is linear, in the logarithm of frequency, between octaves, separately
for frequencies along rows, along columns and between. S maximises the data's likelihood with a prior: log S falls with
the square of frequency, as spectra of photographs do (Field, J. Opt. Soc. Am. A 4, 1987), apart from a normal process
that is correlated over octaves. Its error follows from the curvature of the likelihood (Laplace's method) and from the
fit of such a spectrum (Birge's ratio).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.fft import dct
from scipy.ndimage import gaussian_filter

from mitsim.core.arrays import FloatArray
from mitsim.core.manifests import FactorNoise
from mitsim.reconstruct.accumulation import PRINT, Accumulation, Model, disagreement
from mitsim.reconstruct.solver import DiagonalProblem, Pair, Side, Solution, coefficient_noise

# ---- The scene's power spectrum --------------------------------------------------------------------------------------


_CONTRAST = 0.4
"""Prior standard deviation of a scene over its mean: 0.2 to 0.6 in eight photographs."""
_DEPARTURE, _MEMORY = 2.0, 4.0
"""Prior standard deviation of log S, and its correlation length in octaves (docs/physics.md, uncertainty)."""
_NARROW = 16
_SINGLE, _BANDS = 8, 4
_NOISE_CERTAIN = 2000.0
_STEPS, _STILL = 60, 1e-4
_FARTHEST = 3.0


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Mean and power spectrum of a scene.

    ``even`` (r, r') are the coefficients of an image of ones, ``log_power`` is log S (J,) at all nodes, and ``shares``
    (J, r, r') are mean squares of coefficients by a unit of S. ``departure`` is the misfit of data to S over chance.
    """

    mean: float
    mean_variance: float
    even: FloatArray
    log_power: FloatArray
    covariance: FloatArray
    shares: FloatArray
    departure: float

    @property
    def energy(self) -> FloatArray:
        return np.asarray(np.tensordot(np.exp(self.log_power), self.shares, axes=1))

    def spread(self, weights: FloatArray) -> float:
        parts = np.exp(self.log_power) * np.tensordot(self.shares, weights, axes=2)
        parts = parts / max(float(parts.sum()), 1e-300)
        return float(parts @ self.covariance @ parts)


def scene_spectrum(sides: tuple[Side, Side], problem: DiagonalProblem, noise: float | FloatArray) -> Spectrum | None:
    """Return the spectrum of a scene, or None without data."""
    sigma, measured = problem.sigma, problem.sigma > 0
    if not problem.projected[measured].any():
        return None
    duals = [side.duals for side in sides]
    even = np.outer(*(dual.sum(axis=0) for dual in duals))
    bands = [_bands(side.scene_size) for side in sides]
    cosines = [dct(np.eye(side.scene_size), axis=0, norm="ortho").T for side in sides]
    parts = zip(duals, cosines, bands, strict=True)
    left, right = (np.add.reduceat(np.square(dual.T @ own), starts, axis=1) for dual, own, (starts, _, _) in parts)
    nodes, step = _nodes(bands[0][1] / len(duals[0]), bands[1][1] / len(duals[1]))
    shares = np.stack([left @ weight @ right.T for weight in nodes])
    # Noise that is not known to be more than rounding is that.
    least = float(np.square(problem.projected).max()) * np.finfo(np.float64).eps
    level = np.maximum(np.broadcast_to(noise, sigma.shape), least)
    place = step * (np.arange(len(nodes)) % (len(nodes) // 2))
    fall = np.exp2(-2.0 * place)
    frequencies = np.outer(bands[0][2], bands[1][2])
    detail_energy = float(fall @ np.tensordot(nodes, frequencies)) or 1.0  # a single pixel has none
    usual = np.square(_CONTRAST) * frequencies.sum() / detail_energy * fall

    def mean(power: FloatArray) -> tuple[float, float]:
        weights = sigma * even / (np.square(sigma) * np.tensordot(power, shares, axes=1) + level)
        variance = 1 / (1.0**-2 + float(np.sum(weights * sigma * even)))
        return variance * float(np.sum(weights * problem.projected)), variance

    brightness, variance = mean(usual * 0.35**2)
    detail = np.square(problem.projected - sigma * brightness * even)
    groups = _group((np.square(sigma) / level)[measured], shares[:, measured], (detail / level)[measured])
    same_octave = np.where(np.equal.outer(*2 * [np.arange(len(nodes)) < len(nodes) // 2]), 1.0, 0.8)
    before = _DEPARTURE**2 * np.exp(-np.abs(place[:, None] - place) / _MEMORY) * same_octave
    level_of_detail = np.log(usual * max(brightness**2, variance))
    power, covariance, departure = _likeliest(*groups, level_of_detail, np.asarray(np.linalg.inv(before)))
    return Spectrum(*mean(np.exp(power)), even, power, covariance, shares, departure)


def _bands(size: int) -> tuple[npt.NDArray[np.intp], FloatArray, npt.NDArray[np.intp]]:
    every = np.arange(size)
    band = np.floor(_BANDS * np.log2(np.maximum(every, _SINGLE) / _SINGLE)) + np.minimum(every, _SINGLE)
    starts = np.flatnonzero(np.diff(band, prepend=-1))
    sizes = np.diff(starts, append=size)
    return starts, starts + (sizes - 1) / 2, sizes


def _nodes(down: FloatArray, across: FloatArray) -> tuple[FloatArray, float]:
    rows, columns = down[:, None], across
    least = min(down[1] if len(down) > 1 else 1.0, across[1] if len(across) > 1 else 1.0)
    octave = np.log2(np.maximum(np.hypot(rows, columns) / least, 1.0))
    top = max(float(octave.max()), 1.0)
    count = int(np.ceil(top)) + 1
    nodes = np.maximum(1 - np.abs(octave / top * (count - 1) - np.arange(count)[:, None, None]), 0.0)
    nodes[:, 0, 0] = 0.0
    between = np.minimum(rows, columns) / np.maximum(np.maximum(rows, columns), least)
    along = 1 - np.log2(1 + (_NARROW - 1) * between) / np.log2(_NARROW)
    return np.concatenate([nodes * along, nodes * (1 - along)]), top / (count - 1)


def _group(seen: FloatArray, shares: FloatArray, data: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    octaves = len(shares) // 2
    whole = np.maximum(shares.sum(axis=0), 1e-300)
    middle, along = (np.arange(len(shares)) % octaves) @ shares / whole, shares[:octaves].sum(axis=0) / whole
    keys = np.rint([2 * np.log2(seen), 2 * middle, 3 * along]).astype(np.int64)
    keys -= keys.min(axis=1, keepdims=True)
    _, group = np.unique(np.ravel_multi_index(tuple(keys), keys.max(axis=1) + 1), return_inverse=True)
    counts = np.bincount(group)
    told = np.stack([np.bincount(group, seen * share) / counts for share in shares], axis=1)
    return told, counts.astype(np.float64), np.bincount(group, data) / counts


def _likeliest(
    told: FloatArray, counts: FloatArray, found: FloatArray, usual: FloatArray, precision: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Return log S (J,), its covariance and the departure from it, by Fisher scoring."""
    signal = np.maximum(1 - 1 / np.maximum(found, 1.0), 0.0)
    weight = counts / (1 + counts * (np.square(signal) / 100.0 + 1 / _NOISE_CERTAIN))

    def cost(power: FloatArray) -> float:
        expected = 1 + told @ np.exp(power)
        off = power - usual
        return 0.5 * float(weight @ (np.log(expected) + found / expected) + off @ precision @ off)

    def information(power: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        slopes, expected = told * np.exp(power), 1 + told @ np.exp(power)
        return slopes, expected, 0.5 * (slopes.T * (weight / expected**2)) @ slopes + precision

    power, damping = usual.copy(), 1e-3
    least = cost(power)
    for _ in range(_STEPS):
        slopes, expected, curvature = information(power)
        gradient = 0.5 * (weight * (1 - found / expected) / expected) @ slopes + precision @ (power - usual)
        damped = curvature + damping * np.diag(np.diag(curvature))
        candidate = power - np.clip(np.linalg.solve(damped, gradient), -_FARTHEST, _FARTHEST)
        reached = cost(candidate)
        if reached > least:
            damping *= 4
            continue
        gained, power, least, damping = least - reached, candidate, reached, max(damping / 3, 1e-6)
        if gained < _STILL:
            break
    _, expected, curvature = information(power)
    departure = float(weight @ np.square(found / expected - 1)) / (2 * max(len(found) - len(power), 1))
    return power, np.asarray(np.linalg.inv(curvature), np.float64), max(departure, 1.0)


# ---- Standard uncertainty by source ----------------------------------------------------------------------------------


_AS_STATED = 1.5
_NEAR = 2.0
RANDOM = ("frame_noise", "ambient_frame", "rendering")


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Standard uncertainty (n, n') of an image by source, and the factor that ``regularisation_bias`` is known to."""

    sources: dict[str, FloatArray]
    bias_factor: float = 1.0

    @property
    def random(self) -> FloatArray:
        return _together([values for name, values in self.sources.items() if name in RANDOM])

    @property
    def systematic(self) -> FloatArray:
        return _together([values for name, values in self.sources.items() if name not in RANDOM])

    @property
    def total(self) -> FloatArray:
        return _together(list(self.sources.values()))

    @property
    def budget(self) -> dict[str, float]:
        return {name: rms(values) for name, values in self.sources.items()}

    @property
    def extrapolated(self) -> bool:
        lost = self.budget.get("regularisation_bias", 0.0)
        return self.bias_factor > 1.35 and 2 * lost**2 > rms(self.total) ** 2

    def loss(self, image: FloatArray) -> str:
        """Return a sentence if lambda removes most of an ``image``, or most of it is noise, else nothing."""
        lost, left, total = self.budget.get("regularisation_bias", 0.0), rms(image), rms(self.total)
        if lost > left:
            return (
                f"Lambda takes away more of the image ({lost:.1e} rms of reflectance, as the uncertainty has it) than "
                f"it leaves ({left:.1e}), so what is dark may be lost; expose longer, take more patterns or shots, or "
                "give a smaller lambda."
            )
        if 2 * total**2 > left**2:  # the image has the energy of its noise, too
            return (
                f"The image is hardly more than noise: its uncertainty is {total:.1e} rms, the image itself "
                f"{left:.1e}; expose longer, take more patterns or shots, or give a larger lambda."
            )
        return ""

    @property
    def gist(self) -> str:
        return f"standard uncertainty {rms(self.total):.1e} rms"

    def __str__(self) -> str:
        parts = sorted(((value, name) for name, value in self.budget.items() if value), reverse=True)
        by_source = ", ".join(f"{name.replace('_', ' ')} {value:.1e}" for value, name in parts)
        known = f"; extrapolated: it is known to a factor of {self.bias_factor:.1f}" if self.extrapolated else ""
        return f"{self.gist}: {by_source or 'no noise is stated'}{known}"


@dataclass(frozen=True, eq=False)
class Propagation:
    model: Model
    lam: float

    @cached_property
    def gain(self) -> FloatArray:
        return self.model.prepared.gain(self.lam)

    @cached_property
    def terms(self) -> Pair:
        """Factors g (r, k) and h (r', k) of whose products G is the sum; a tenth of an SVD's time."""
        rest, energy = self.gain.copy(), float(np.square(self.gain).sum())
        rows, columns = list[FloatArray](), list[FloatArray]()
        while not rows or np.square(rest).sum() > 1e-5 * energy:
            row, column = np.unravel_index(np.argmax(np.abs(rest)), rest.shape)
            rows.append(rest[:, column] / rest[row, column])
            columns.append(rest[row].copy())
            rest -= np.outer(rows[-1], columns[-1])
        return np.stack(rows, axis=1), np.stack(columns, axis=1)

    def of_white(self, variance: float) -> FloatArray:
        return self._spread(np.full(self.gain.shape, variance))

    def of_frames(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        return self._spread(frame_variances(self.model.sides, rows, columns))

    def of_ambient_frame(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        sides = zip(self.model.sides, (rows, columns), strict=True)
        left, right = (side.common * np.sqrt(variance)[:, None] for side, variance in sides)
        mean = max(float(rows.mean()), float(columns.mean()))
        return np.asarray(self._image_variance(left, right) / (mean or 1.0))

    def of_light(self, variance: float) -> FloatArray:
        left, right = self.model.sides
        if left.dual is None and right.dual is None:  # what coefficients get is then independent too
            return self._spread(variance * np.square(self._sigma))
        return variance * self._image_variance(left.response, right.response)

    def _image_variance(self, left: FloatArray, right: FloatArray) -> FloatArray:
        products = []
        for side, own, seen in zip(self.model.sides, self.terms, (left, right), strict=True):
            taken = np.stack([(side.basis * term) @ seen.T for term in own.T], axis=1)
            products.append(taken @ taken.transpose(0, 2, 1))
        return np.asarray(np.einsum("pkl,qkl->pq", *products, optimize=True))

    def of_regularisation(self, problem: DiagonalProblem, variance: float) -> tuple[FloatArray, float]:
        """Return the mean square (n, n') of the detail that lambda removes, and the factor of its error."""
        told_by_data = problem.data_count > np.count_nonzero(problem.sigma)
        noise = coefficient_noise(problem) if told_by_data else variance
        spectrum = scene_spectrum(self.model.sides, problem, noise)
        lost = 1 - problem.kept_share(self.lam)
        if spectrum is None or not lost.any():
            return np.zeros((len(self.model.sides[0].basis), len(self.model.sides[1].basis))), 1.0
        power, image = np.square(self._sigma), self.model.prepared.image
        detail = problem.projected - spectrum.mean * self._sigma * spectrum.even

        def seen_part(energy: FloatArray) -> FloatArray:
            return np.divide(power * energy, power * energy + noise, out=np.zeros_like(power), where=power > 0)

        spread = spectrum.spread(np.square(lost) * (1 - seen_part(spectrum.energy)))
        energy = spectrum.energy * np.exp(spread / 2)  # the mean of what has a logarithm of that variance
        part = seen_part(energy)
        told = np.divide(part * detail, self._sigma, out=np.zeros_like(power), where=power > 0)
        squares = self._pixel_variance(np.square(lost) * (np.square(told) + energy * (1 - part)))
        of_mean = (spectrum.mean**2 + spectrum.mean_variance) * np.square(image(lost * spectrum.even))
        seen = _near(image(lost * told))
        usual = gaussian_filter(self._pixel_variance(np.square(lost) * energy * part), _NEAR, mode="nearest")
        doubt = max(0.1 * float(usual.mean()), 1e-300)
        near = (seen + doubt) / (usual + doubt)
        placed = squares * near
        placed *= squares.mean() / max(float(placed.mean()), 1e-300)
        return of_mean + placed, float(np.exp(np.sqrt(spread * spectrum.departure) / 2))

    def of_factors(self, noise: FactorNoise, image: FloatArray) -> Pair:
        left, right = self.model.sides
        rows = _of_factor(left, right, self.model.patterns[0], self.terms, image)
        columns = _of_factor(right, left, self.model.patterns[1], self.terms[::-1], image.T).T
        return noise.left**2 * rows, noise.right**2 * columns

    def of_print(self, image: FloatArray) -> FloatArray:
        left, right = self.model.sides
        rows, columns = (np.gradient(image, axis=axis) / 12 if image.shape[axis] > 1 else 0 * image for axis in (0, 1))
        moved = [each.sum(axis=0) for each in self.model.moved]
        seen = moved[0].T @ rows @ right.response, left.response.T @ columns @ moved[1]
        squares = (np.square(self.model.prepared.image(self.gain * each)) for each in seen)
        return PRINT * sum(squares, np.zeros_like(image))

    def _spread(self, variances: FloatArray) -> FloatArray:
        return self._pixel_variance(np.square(self.gain) * variances)

    def _pixel_variance(self, variances: FloatArray) -> FloatArray:
        left, right = (np.square(side.basis) for side in self.model.sides)
        return np.asarray(left @ variances @ right.T)

    @cached_property
    def _sigma(self) -> FloatArray:
        return self.model.prepared.sigma


def uncertainty(data: Accumulation, solution: Solution, chi_square: float = 1.0) -> Uncertainty:
    """Compute the standard uncertainty of a ``solution`` that is linear in its frames.

    Where ``chi_square``, residual over stated noise, is far from 1, the residual replaces the stated noise of the
    frames.
    """
    noise, image, manifest = data.noise, solution.image, data.factors.manifest
    problem, lack = data.prepared.problem(data.frames), data.lack(image)
    propagation, zero = Propagation(data.model, solution.lam), np.zeros_like(image)
    # Terms that the factors are known to lack raise the residual, and are a source of their own.
    as_stated = chi_square > 1 / _AS_STATED and (chi_square < _AS_STATED or lack is not None)
    shown = 1.0 if as_stated else chi_square
    frames = shown * propagation.of_frames(noise.rows, noise.columns)
    left, right = propagation.of_factors(manifest.noise, image) if manifest.noise else (zero, zero)
    known, told = (frames + left, frames + right), zero
    if problem.halves:
        told = disagreement(data.model, propagation.gain, problem.halves, known)
    lost, factor = propagation.of_regularisation(problem, float(noise.variance.mean()))
    of_sampling = propagation.of_white(noise.discretisation / problem.data_count)
    calibrated = manifest.digital.exposure_uncertainty if manifest.digital else 0.0
    exposure = math.hypot(data.shots.manifest.digital.exposure_uncertainty, calibrated)
    variances = {
        "frame_noise": frames,
        "ambient_frame": shown * propagation.of_ambient_frame(*noise.ambient) if noise.ambient else zero,
        "rendering": of_sampling + propagation.of_light(noise.light_error**2),
        "calibration_noise": left + right,
        "print_detail": np.maximum(propagation.of_print(image), told),
        "exposure": np.square(exposure * image),
        "inseparability": zero if lack is None else _near(data.prepared.image(propagation.gain * lack[0])),
        "regularisation_bias": lost,
    }
    return Uncertainty({name: np.sqrt(np.maximum(each, 0.0)) for name, each in variances.items()}, factor)


def frame_variances(sides: tuple[Side, Side], rows: FloatArray, columns: FloatArray) -> FloatArray:
    """Return the variance (r, r') of W by independent noise of frames (K, K'), from its means by row and column."""
    left, right = sides
    squares = [np.square(slab.matrix) for slab in right.slabs]
    # Clipped at 0, rows and columns of frames that are darker than nothing have means of their own.
    means = np.maximum(rows.mean(axis=2), columns.mean(axis=2))
    means = np.where(means > 0, means, 1.0)
    total = np.zeros((len(left.singular), len(right.singular)))
    for slab, own_rows, own_columns, mean in zip(left.slabs, rows, columns, means, strict=True):
        seen = np.zeros((len(own_columns), len(right.singular)))
        for part, other, square, column in zip(seen, right.slabs, squares, own_columns, strict=True):
            part[other.columns] = column @ square
        total[slab.columns] += (own_rows @ np.square(slab.matrix)).T @ (seen / mean[:, None])
    return total


def kind_responses(own: Side, patterns: FloatArray) -> Pair:
    """Return ||sum_i P[p, i] U_i[:, a]||^2 (r, kinds) by kind of pixel p, and the pixels (kinds, n) of each kind.

    Pixels that the same patterns light are seen alike.
    """
    kinds, kind = np.unique(patterns, axis=0, return_inverse=True)
    of_kind = (kind.ravel() == np.arange(len(kinds))[:, None]).astype(np.float64)
    stack = np.zeros((len(own.singular), own.pattern_count, own.sensor_size))
    for index, slab in enumerate(own.slabs):
        stack[slab.columns, index] = slab.matrix.T
    return ((kinds @ (stack @ stack.transpose(0, 2, 1))) * kinds).sum(axis=2), of_kind


def _of_factor(own: Side, other: Side, patterns: FloatArray, terms: Pair, image: FloatArray) -> FloatArray:
    seen, (responses, of_kind) = image @ other.response, kind_responses(own, patterns)
    rows, columns = terms
    parts = np.stack([(seen * column) @ other.basis.T for column in columns.T])
    spread = np.zeros((len(own.singular), len(other.basis)))
    for k in range(len(parts)):
        twice = np.where(np.arange(k + 1) < k, 2.0, 1.0) * rows[:, : k + 1] * rows[:, k : k + 1]
        weights = twice[:, :, None] * responses[:, None, :]
        both = of_kind @ (parts[: k + 1] * parts[k])
        spread += weights.reshape(len(spread), -1) @ both.reshape(-1, len(other.basis))
    return np.asarray(np.square(own.basis) @ np.maximum(spread, 0.0))


def _near(error: FloatArray) -> FloatArray:
    return np.asarray(gaussian_filter(np.square(error), _NEAR, mode="nearest"))


def _together(parts: list[FloatArray]) -> FloatArray:
    return np.sqrt(sum(np.square(part) for part in parts))


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.square(values).mean()))
