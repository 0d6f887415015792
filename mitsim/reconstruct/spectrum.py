"""Data of an image in the diagonal basis in, the scene's mean and power spectrum, and each coefficient's energy, out.

A scene is a mean m, and detail that is taken for stationary: its cosine coefficients are independent numbers whose
variance S hangs on frequency. Coefficient (a, b) of the diagonal basis, whose vectors have the cosines C_L and C_R and
whose image of ones is c, is m c_ab and detail of the mean square e = sum_kl C_L[k, a]^2 S[k, l] C_R[l, b]^2; its datum
has the variance sigma^2 e + noise about sigma m c. So m follows from all data at once, by weighted least squares, even
where no datum of its own stands above the noise. Every datum tells of all frequencies that its vector holds: under
patterns that leave dark pixels between lit ones, well-seen coefficients hold the finest.

S is linear, in the logarithm of frequency, between octaves, apart for frequencies along rows and columns, where prints
have most of their edges, and between these. It is chosen by the data's likelihood and what is known of scenes before:
log S falls with the square of frequency, as spectra of photographs do (Field, J. Opt. Soc. Am. A 4, 1987), and departs
from that by a normal process that forgets itself over octaves. So where data tell nothing, S goes on as the last
octaves that are told, and further on as scenes do. How far off that may be, the curvature of the likelihood says
(Laplace's method), and how well such a spectrum fits the data at all (Birge's ratio).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.fft import dct

from mitsim.core.arrays import FloatArray
from mitsim.reconstruct.factorisation import Side
from mitsim.reconstruct.regularisation import DiagonalProblem

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
        """The mean and its variance, by least squares weighted for the spectrum S = ``power`` (J,)."""
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
    """(n, n) orthonormal cosines of a ``side``'s scene pixels, by column."""
    return np.asarray(dct(np.eye(side.scene_size), axis=0, norm="ortho").T)


def _bands(size: int) -> tuple[npt.NDArray[np.intp], FloatArray, npt.NDArray[np.intp]]:
    """First of ``size`` frequencies, mean and number of frequencies, of bands in which S hardly differs."""
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
    keys = (np.rint(2 * np.log2(seen)) * 2 * len(shares) + np.rint(2 * middle)) * 4 + np.rint(3 * along)
    _, group = np.unique(keys, return_inverse=True)
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
