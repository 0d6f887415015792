"""The factorised model, lambda and stated noise in; a standard uncertainty for each pixel of the image out, by source.

With G = sigma / (sigma^2 + lambda) the image X = V_L (G o W) V_R^T is linear in the frames, W = sum_ij U_Li^T Y_ij
U_Rj. Independent noise of variance v in all data leaves, V o V being the squares of V's numbers,

    var X = (V_L o V_L) (v G o G) (V_R o V_R)^T

Light differs from frame to frame and over the sensor. Taking the variance of frame (i, j) for a product of its means by
sensor row and by sensor column, v_ij = r_ij c_ij^T / mean, v becomes sum_ij ((U_Li o U_Li)^T r_ij) ((U_Rj o U_Rj)^T
c_ij)^T / mean, number by number. (For patterns whose blocks share no row, such as ``random``, coefficients are then
correlated, which is left out.) The noise N of a frame that is taken off all others comes in as (sum_i U_Li)^T N (sum_j
U_Rj), whose numbers are correlated too; with G = sum_k g_k h_k^T that is exact, sum_k A_k N B_k^T, A_k = V_L diag(g_k)
(sum_i U_Li)^T.

Factors are off by independent numbers of deviation s_L, one and the same in all frames. To first order the frames are
then off by d_L (P_ij o X) Phi_R^T, and, with Q = X V_R S_R, the image by V_L [G o (T Q)] V_R^T, where T = sum_i U_Li^T
d_L diag(p_i) has independent numbers of variance s_L^2 rho[a, p], rho[a, p] = ||sum_i P_L[p, i] U_Li[:, a]||^2. So

    var X[p, q] = s_L^2 sum_a V_L[p, a]^2 sum_p' rho[a, p'] (sum_b G[a, b] Q[p', b] V_R[q, b])^2

and the same with the sides exchanged. G is taken apart into a few products of a row and a column. (For patterns whose
blocks share no row, such as ``random``, and for neighbours alike, rho leaves out what is correlated between
coefficients.) Where the basis V is not orthonormal (:mod:`mitsim.reconstruct.solver`) V makes the image, its dual sees
light; formulas are the same.

Print that changes within a projector pixel casts another shadow than the board's. A ramp of slope g a pixel has its
light g / 12 pixels off the centre; what that does to the image stands for print that may have hard edges or none, which
is the least. Finer print is told by what halves of the sensor disagree on (:mod:`mitsim.reconstruct.accumulation`).

Simulated light is off by its sampling, projector pixel by projector pixel: an error of the image that is kept as the
image is. What lambda takes away, lambda x / (sigma^2 + lambda) of each coefficient x, is no noise, but as large as the
scene has energy there, by the power spectrum that the data tell (:func:`scene_spectrum`).

*The scene's spectrum.* A scene is a mean m, and detail that is taken for stationary: its cosine coefficients are
independent numbers whose variance S hangs on frequency. Coefficient (a, b) of the diagonal basis, whose vectors have
the cosines C_L and C_R and whose image of ones is c, is m c_ab and detail of the mean square e = sum_kl C_L[k, a]^2
S[k, l] C_R[l, b]^2; its datum has the variance sigma^2 e + noise about sigma m c. So m follows from all data at once,
by weighted least squares, even where no datum of its own stands above the noise. Every datum tells of all frequencies
that its vector holds: under patterns that leave dark pixels between lit ones, well-seen coefficients hold the finest.

S is linear, in the logarithm of frequency, between octaves, apart for frequencies along rows and columns, where prints
have most of their edges, and between these. It is chosen by the data's likelihood and what is known of scenes before:
log S falls with the square of frequency, as spectra of photographs do (Field, J. Opt. Soc. Am. A 4, 1987), and departs
from that by a normal process that forgets itself over octaves. So where data tell nothing, S goes on as the last
octaves that are told, and further on as scenes do. How far off that may be, the curvature of the likelihood says
(Laplace's method), and how well such a spectrum fits the data at all (Birge's ratio).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.fft import dct
from scipy.ndimage import gaussian_filter

from mitsim.core.arrays import FloatArray
from mitsim.core.exr import Channel
from mitsim.core.manifests import FactorNoise
from mitsim.reconstruct.accumulation import PRINT, Accumulation, Model, disagreement
from mitsim.reconstruct.factorisation import Side
from mitsim.reconstruct.solver import DiagonalProblem, Solution, coefficient_noise

# ---- The scene's power spectrum --------------------------------------------------------------------------------------


_FALL = -2.0
"""Power of frequency that spectra of scenes fall with (Field 1987)."""
_CONTRAST = 0.4
"""Standard deviation of a scene over its mean, before anything is known: 0.2 (gravel) to 0.6 (a portrait) in eight
photographs of scikit-image."""
_DEPARTURE, _MEMORY = 2.0, 4.0
"""Standard deviation of log S about that, and the octaves over which it forgets itself. Of 1 to 3, and of 2 to 8,
with a slope of its own or without, no choice covers clearly better (docs/physics.md, uncertainty)."""
_ALIKE = 0.8
"""Correlation of log S along rows and columns with log S between them: their difference then deviates by 1.3; 14
photographs have 0.5 +- 0.7, prints of squares and bars 2 and more."""
_NARROW = 16
"""Frequencies count as along an axis where one is less than this part of the other, and by the logarithm up to equal
ones: the four octaves that 64 pixels have beside the mean and the finest."""
_SINGLE, _BANDS = 8, 4
"""Frequencies below which each is a band of its own, and bands an octave above; S changes by a fifth within one."""
_CERTAIN = 100.0
"""Data of a group that count in full where they are signal; more only tell how far a scene is from stationary, a tenth
in amplitude."""
_NOISE_CERTAIN = 2000.0
"""Data of noise that count in full; more only tell how far off the noise is, which some thousand data outside the
model's range, or medians of as many within, tell to 2 or 3 %."""
_GREY, _BRIGHT = 0.35, 1.0
"""Mean reflectance that weighs the data before any is known, and the standard deviation of means about 0: all that
reflectances may be."""
_STEPS, _STILL = 60, 1e-4
"""Most steps of Newton's method, and the log-likelihood below which a step ends it: 10 to 30 are taken."""
_FARTHEST = 3.0
"""Largest step of log S."""


@dataclass(frozen=True, eq=False)
class Spectrum:
    """The mean and the power spectrum of a scene.

    Attributes
    ----------
    mean, mean_variance
        of the image, and the variance of that.
    even
        (r, r') coefficients of an image of ones.
    log_power, covariance
        (J,) log S at all nodes, and its (J, J) covariance.
    shares
        (J, r, r') mean square of each coefficient by a unit of S of each.
    departure
        mean square by which groups of data are off what S makes of them, over what chance explains; 1 at least.
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
        """(r, r') mean square of each coefficient about the mean's."""
        return np.asarray(np.tensordot(np.exp(self.log_power), self.shares, axes=1))

    def spread(self, weights: FloatArray) -> float:
        """Variance of the logarithm of the sum of all coefficients' mean squares times ``weights`` (r, r')."""
        parts = np.exp(self.log_power) * np.tensordot(self.shares, weights, axes=2)
        parts = parts / max(float(parts.sum()), 1e-300)
        return float(parts @ self.covariance @ parts)


def scene_spectrum(sides: tuple[Side, Side], problem: DiagonalProblem, noise: float | FloatArray) -> Spectrum | None:
    """The spectrum of a scene; None where there are no data.

    Parameters
    ----------
    sides
        of the model.
    problem
        its data in the diagonal basis.
    noise
        variance of each number of ``problem.projected`` (r, r'), or of all.
    """
    sigma, measured = problem.sigma, problem.sigma > 0
    if not problem.projected[measured].any():
        return None
    duals = [side.duals for side in sides]
    even = np.outer(*(dual.sum(axis=0) for dual in duals))
    bands = [_bands(side.scene_size) for side in sides]
    left, right = (
        np.add.reduceat(np.square(dual.T @ _cosines(side)), starts, axis=1)
        for dual, side, (starts, _, _) in zip(duals, sides, bands, strict=True)
    )
    nodes, step = _nodes(bands[0][1] / len(duals[0]), bands[1][1] / len(duals[1]))
    shares = np.stack([left @ weight @ right.T for weight in nodes])
    # Noise that is not known to be more than rounding is that.
    least = float(np.square(problem.projected).max()) * np.finfo(np.float64).eps
    level = np.maximum(np.broadcast_to(noise, sigma.shape), least)
    place = step * (np.arange(len(nodes)) % (len(nodes) // 2))
    fall = np.exp2(_FALL * place)
    frequencies = np.outer(bands[0][2], bands[1][2])
    detail_energy = float(fall @ np.tensordot(nodes, frequencies)) or 1.0  # a single pixel has none
    usual = np.square(_CONTRAST) * frequencies.sum() / detail_energy * fall

    def mean(power: FloatArray) -> tuple[float, float]:
        weights = sigma * even / (np.square(sigma) * np.tensordot(power, shares, axes=1) + level)
        variance = 1 / (_BRIGHT**-2 + float(np.sum(weights * sigma * even)))
        return variance * float(np.sum(weights * problem.projected)), variance

    brightness, variance = mean(usual * _GREY**2)
    detail = np.square(problem.projected - sigma * brightness * even)
    groups = _group((np.square(sigma) / level)[measured], shares[:, measured], (detail / level)[measured])
    same_octave = np.where(np.equal.outer(*2 * [np.arange(len(nodes)) < len(nodes) // 2]), 1.0, _ALIKE)
    before = _DEPARTURE**2 * np.exp(-np.abs(place[:, None] - place) / _MEMORY) * same_octave
    level_of_detail = np.log(usual * max(brightness**2, variance))
    power, covariance, departure = _likeliest(*groups, level_of_detail, np.asarray(np.linalg.inv(before)))
    return Spectrum(*mean(np.exp(power)), even, power, covariance, shares, departure)


def _cosines(side: Side) -> FloatArray:
    return np.asarray(dct(np.eye(side.scene_size), axis=0, norm="ortho").T)


def _bands(size: int) -> tuple[npt.NDArray[np.intp], FloatArray, npt.NDArray[np.intp]]:
    every = np.arange(size)
    band = np.floor(_BANDS * np.log2(np.maximum(every, _SINGLE) / _SINGLE)) + np.minimum(every, _SINGLE)
    starts = np.flatnonzero(np.diff(band, prepend=-1))
    sizes = np.diff(starts, append=size)
    return starts, starts + (sizes - 1) / 2, sizes


def _nodes(down: FloatArray, across: FloatArray) -> tuple[FloatArray, float]:
    """Weights (J, r, c) at all frequencies but the mean's, and the octaves between nodes.

    J / 2 octaves along rows and columns, then those between; ``down`` (r,) and ``across`` (c,) are frequencies in parts
    of the finest, 0 the first.
    """
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
    """Means over coefficients that are seen alike (by half octaves of ``seen``) and hold the same frequencies.

    Parameters
    ----------
    seen, data
        (count,) sigma^2 and squared data, both over the noise.
    shares
        (J, count).

    Returns the groups' (groups, J) sigma^2 times shares, their sizes, and their squared data.
    """
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
    """log S (J,), its covariance and the departure from it, by Fisher scoring.

    Parameters
    ----------
    told, counts, found
        of :func:`_group`.
    usual, precision
        (J,) and (J, J) of log S before.
    """
    signal = np.maximum(1 - 1 / np.maximum(found, 1.0), 0.0)
    weight = counts / (1 + counts * (np.square(signal) / _CERTAIN + 1 / _NOISE_CERTAIN))

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


_LOST = 1e-5
"""Part of the energy of G that its few products may leave out: 0.3 % of its norm, less than 1 % of a variance."""
_EXTRAPOLATED = 1.35
"""Factor by which a stated uncertainty may be off from which that is said: data then hold less than frequencies of half
the detail that is lost."""
_AS_STATED = 1.5
"""Factor that chi-square may be off from 1 before noise counts as other than stated: 1.2 in its deviation."""
_NEAR = 2.0
"""Scene pixels around a place whose detail tells of lost detail there: of 1, 2 and 4 that which covers best."""
_UNSURE = 0.1
"""Detail near a place, in parts of its mean, that places are alike by before any is seen; 0.3 and 1 cover as well."""
NO_UNCERTAINTY = {
    "uncertainty": None,
    "uncertainty_budget": None,
    "uncertainty_extrapolated": None,
    "regularisation_bias_factor": None,
}
"""Entries of result.json where it is not known."""


RANDOM = ("frame_noise", "ambient_frame", "rendering")
"""Sources that another capture draws anew; the others are the same in all captures with one calibration."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Standard uncertainty of an image: (n, n') by source, ``regularisation_bias`` among them; and the factor, either
    way, that this one is known to."""

    sources: dict[str, FloatArray]
    bias_factor: float = 1.0

    @property
    def random(self) -> FloatArray:
        """(n, n') of what another capture draws anew: noise of the frames, and their rendering where simulated."""
        return _together([values for name, values in self.sources.items() if name in RANDOM])

    @property
    def systematic(self) -> FloatArray:
        """(n, n') of what captures with these factors share: noise of the factors, print within a pixel, exposure, what
        lambda takes away."""
        return _together([values for name, values in self.sources.items() if name not in RANDOM])

    @property
    def total(self) -> FloatArray:
        """(n, n') standard uncertainty."""
        return _together(list(self.sources.values()))

    @property
    def budget(self) -> dict[str, float]:
        """Root mean square over the image by source."""
        return {name: _rms(values) for name, values in self.sources.items()}

    @property
    def extrapolated(self) -> bool:
        """Whether most of it is detail that lambda takes away and that the data hardly tell: it then follows from
        coarser detail and from scenes as they are."""
        lost = self.budget.get("regularisation_bias", 0.0)
        return self.bias_factor > _EXTRAPOLATED and 2 * lost**2 > _rms(self.total) ** 2

    def loss(self, image: FloatArray) -> str:
        """Return a sentence if lambda takes away more of an ``image`` (n, n') than it leaves, or if the uncertainty
        exceeds the image; otherwise nothing."""
        lost, left, total = self.budget.get("regularisation_bias", 0.0), _rms(image), _rms(self.total)
        if lost > left:
            return (
                f"Lambda takes away more of the image ({lost:.1e} rms of reflectance, as the uncertainty has it) than "
                f"it leaves ({left:.1e}), so what is dark may be lost; expose longer, take more patterns or shots, or "
                "give a smaller lambda."
            )
        if total > left:
            return (
                f"The image is hardly more than noise: its uncertainty is {total:.1e} rms, the image itself "
                f"{left:.1e}; expose longer, take more patterns or shots, or give a larger lambda."
            )
        return ""

    @property
    def gist(self) -> str:
        """The uncertainty of the whole image in a few words."""
        return f"standard uncertainty {_rms(self.total):.1e} rms"

    def __str__(self) -> str:
        parts = sorted(((value, name) for name, value in self.budget.items() if value), reverse=True)
        by_source = ", ".join(f"{name.replace('_', ' ')} {value:.1e}" for value, name in parts)
        known = f"; extrapolated: it is known to a factor of {self.bias_factor:.1f}" if self.extrapolated else ""
        return f"{self.gist}: {by_source or 'no noise is stated'}{known}"

    def channels(self) -> dict[str, Channel]:
        """(n, n') channels of uncertainty.exr."""
        parts = {"uncertainty": self.total, "random": self.random, "systematic": self.systematic}
        return {name: values.astype(np.float32) for name, values in parts.items()}

    def summary(self) -> dict[str, Any]:
        """What result.json and the command line's JSON say of it."""
        return {
            "uncertainty": _rms(self.total),
            "uncertainty_budget": self.budget,
            "uncertainty_extrapolated": self.extrapolated,
            "regularisation_bias_factor": self.bias_factor,
        }


@dataclass(frozen=True, eq=False)
class Propagation:
    """How noise of a ``model``'s data comes to be noise of its image at ``lam``, lambda."""

    model: Model
    lam: float

    @cached_property
    def gain(self) -> FloatArray:
        """G (r, r'), 0 where nothing is measured."""
        return np.divide(
            self._sigma, np.square(self._sigma) + self.lam, out=np.zeros_like(self._sigma), where=self._sigma > 0
        )

    @cached_property
    def terms(self) -> tuple[FloatArray, FloatArray]:
        """g (r, k) and h (r', k) of which G is the sum of products, few that leave out ``_LOST`` of its energy.

        Each takes away the row and the column of the largest number that is left: for so smooth a table as many as an
        SVD takes or one more, in a tenth of the time.
        """
        rest, energy = self.gain.copy(), float(np.square(self.gain).sum())
        rows, columns = list[FloatArray](), list[FloatArray]()
        while not rows or np.square(rest).sum() > _LOST * energy:
            row, column = np.unravel_index(np.argmax(np.abs(rest)), rest.shape)
            rows.append(rest[:, column] / rest[row, column])
            columns.append(rest[row].copy())
            rest -= np.outer(rows[-1], columns[-1])
        return np.stack(rows, axis=1), np.stack(columns, axis=1)

    def of_white(self, variance: float) -> FloatArray:
        """(n, n') variance of the image by independent noise of this ``variance`` in all data."""
        return self._spread(np.full(self.gain.shape, variance))

    def of_frames(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        """(n, n') variance of the image by noise of the frames.

        Parameters
        ----------
        rows, columns
            (K, K', m) and (K, K', m') mean variance of a datum of each pattern by sensor row, and by sensor column.
        """
        left, right = self.model.sides
        squares = [np.square(slab.matrix) for slab in right.slabs]
        # Clipped at 0, rows and columns of frames that are darker than nothing have means of their own.
        means = np.maximum(rows.mean(axis=2), columns.mean(axis=2))
        means = np.where(means > 0, means, 1.0)
        total = np.zeros_like(self.gain)
        for slab, own_rows, own_columns, mean in zip(left.slabs, rows, columns, means, strict=True):
            seen = np.zeros((len(own_columns), len(right.singular)))
            for part, other, square, column in zip(seen, right.slabs, squares, own_columns, strict=True):
                part[other.columns] = column @ square
            total[slab.columns] += (own_rows @ np.square(slab.matrix)).T @ (seen / mean[:, None])
        return self._spread(total)

    def of_ambient_frame(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        """(n, n') variance of the image by one noisy frame, taken off every measurement.

        Parameters
        ----------
        rows, columns
            (m,) and (m',) mean variance of its pixels by sensor row, and by sensor column.
        """
        sides = zip(self.model.sides, (rows, columns), strict=True)
        left, right = (side.common * np.sqrt(variance)[:, None] for side, variance in sides)
        mean = max(float(rows.mean()), float(columns.mean()))
        return np.asarray(self._image_variance(left, right) / (mean or 1.0))

    def of_light(self, variance: float) -> FloatArray:
        """(n, n') variance of the image by an independent error of this ``variance`` in every scene pixel's light."""
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
        """(n, n') mean square of what lambda takes away from the image of a ``problem``, and the factor within which
        its root is known. The ``variance`` of the data is used where there are no more data than unknowns to measure it
        by.

        A coefficient's mean square is told by its datum and by the scene's spectrum, each as well as it knows. The mean
        is lost as an image of ones is, detail where there is more of it than of noise and detail everywhere: that is
        told by what lambda would take away of the image.
        """
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
        seen = gaussian_filter(np.square(image(lost * told)), _NEAR, mode="nearest")
        usual = gaussian_filter(self._pixel_variance(np.square(lost) * energy * part), _NEAR, mode="nearest")
        doubt = max(_UNSURE * float(usual.mean()), 1e-300)
        near = (seen + doubt) / (usual + doubt)
        placed = squares * near
        placed *= squares.mean() / max(float(placed.mean()), 1e-300)
        return of_mean + placed, float(np.exp(np.sqrt(spread * spectrum.departure) / 2))

    def of_factors(self, noise: FactorNoise, image: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, n') variances of an ``image`` by ``noise`` of the left factor, and of the right one."""
        left, right = self.model.sides
        rows = _of_factor(left, right, self.model.patterns[0], self.terms, image)
        columns = _of_factor(right, left, self.model.patterns[1], self.terms[::-1], image.T).T
        return noise.left**2 * rows, noise.right**2 * columns

    def of_lack(self, struck: FloatArray) -> FloatArray:
        """(n, n') mean square, near each place, of what the image is off by where terms that the factors lack add
        ``struck`` (r, r') to the coefficients W."""
        off = np.square(self.model.prepared.image(self.gain * struck))
        return np.asarray(gaussian_filter(off, _NEAR, mode="nearest"))

    def of_print(self, image: FloatArray) -> FloatArray:
        """(n, n') mean square of what an ``image`` is off by when its print changes within every projector pixel."""
        left, right = self.model.sides
        rows, columns = (np.gradient(image, axis=axis) / 12 if image.shape[axis] > 1 else 0 * image for axis in (0, 1))
        moved = [each.sum(axis=0) for each in self.model.moved]
        seen = moved[0].T @ rows @ right.response, left.response.T @ columns @ moved[1]
        return PRINT * sum(
            (np.square(self.model.prepared.image(self.gain * each)) for each in seen), np.zeros_like(image)
        )

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

    Parameters
    ----------
    data
        all frames, accumulated.
    solution
        their image.
    chi_square
        energy of the residual over what noise as stated puts there. Where it is far from 1 the frames do not have the
        stated noise, and theirs is taken to be what the residual shows.
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
    exposure = math.hypot(data.digital.exposure_uncertainty, calibrated)
    variances = {
        "frame_noise": frames,
        "ambient_frame": shown * propagation.of_ambient_frame(*noise.ambient) if noise.ambient else zero,
        "rendering": of_sampling + propagation.of_light(noise.light_error**2),
        "calibration_noise": left + right,
        "print_detail": np.maximum(propagation.of_print(image), told),
        "exposure": np.square(exposure * image),
        "inseparability": propagation.of_lack(lack.struck) if lack else zero,
        "regularisation_bias": lost,
    }
    return Uncertainty({name: np.sqrt(np.maximum(each, 0.0)) for name, each in variances.items()}, factor)


def _of_factor(
    own: Side, other: Side, patterns: FloatArray, terms: tuple[FloatArray, FloatArray], image: FloatArray
) -> FloatArray:
    seen = image @ other.response
    # Pixels that the same patterns light are seen alike: coefficients answer to each kind of them once.
    kinds, kind = np.unique(patterns, axis=0, return_inverse=True)
    of_kind = (kind.ravel() == np.arange(len(kinds))[:, None]).astype(np.float64)
    responses = _responses(own, kinds)
    rows, columns = terms
    parts = np.stack([(seen * column) @ other.basis.T for column in columns.T])
    spread = np.zeros((len(own.singular), len(other.basis)))
    for k in range(len(parts)):
        twice = np.where(np.arange(k + 1) < k, 2.0, 1.0) * rows[:, : k + 1] * rows[:, k : k + 1]
        weights = twice[:, :, None] * responses[:, None, :]
        both = of_kind @ (parts[: k + 1] * parts[k])
        spread += weights.reshape(len(spread), -1) @ both.reshape(-1, len(other.basis))
    return np.asarray(np.square(own.basis) @ np.maximum(spread, 0.0))


def _responses(side: Side, kinds: FloatArray) -> FloatArray:
    """rho (r, c): squared norm of sum_i P[p, i] U_i[:, a], of coefficient a for light of a pixel of a kind, whose P[p]
    is one of ``kinds`` (c, K)."""
    stack = np.zeros((len(side.singular), side.pattern_count, side.sensor_size))
    for index, slab in enumerate(side.slabs):
        stack[slab.columns, index] = slab.matrix.T
    products = stack @ stack.transpose(0, 2, 1)
    return np.asarray(((kinds @ products) * kinds).sum(axis=2))


def _together(parts: list[FloatArray]) -> FloatArray:
    return np.sqrt(sum(np.square(part) for part in parts))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.square(values).mean()))
