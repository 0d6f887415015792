"""Data of an image in the diagonal basis in, the scene's power spectrum and the energy of each coefficient out.

A scene is taken for stationary: its cosine coefficients are independent numbers whose variance S hangs on frequency
alone. Coefficient (a, b) of the diagonal basis, whose vectors have the cosines C_L and C_R, then has the mean square
e = sum_kl C_L[k, a]^2 S[k, l] C_R[l, b]^2, and its datum sigma^2 e + noise. Every datum tells of all frequencies that
its vector holds: under patterns that leave dark pixels between lit ones, well-seen coefficients hold the finest.

S is linear, in the logarithm of frequency, between octaves, and chosen by the data's likelihood and what is known of
scenes before: log S falls with the square of frequency, as spectra of photographs do (Field, J. Opt. Soc. Am. A 4,
1987), and departs from that by a normal process that forgets itself over octaves. So where data tell nothing, S goes on
as the last octaves that are told, and further on as scenes do. How far off that may be, the curvature of the likelihood
says (Laplace's method).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import dct

from mitsim.core.arrays import FloatArray
from mitsim.reconstruct.regularisation import DiagonalProblem
from mitsim.reconstruct.sides import Side

_FALL = -2.0
"""Power of frequency that spectra of scenes fall with (Field 1987)."""
_CONTRAST = 0.4
"""Standard deviation of a scene over its mean, before anything is known: 0.2 (gravel) to 0.6 (a portrait) in eight
photographs of scikit-image."""
_DEPARTURE, _MEMORY = 2.0, 4.0
"""Standard deviation of log S about that, and the octaves over which it forgets itself. Of 2 and 3, and of 2 and 4,
those with which most images are covered to 90 % without the stated uncertainty passing twice the error: 13 scenes,
uniform light, dots:4, dots:7 and hadamard:4, at 0.003 to 0.05 of the full well (docs/physics.md, uncertainty)."""
_CERTAIN = 100.0
"""Data of a group that count in full; more only tell how far a scene is from stationary, a tenth in amplitude."""
_GREY, _GREY_VARIANCE = 0.35, 1.0
"""Mean reflectance of a scene before it is seen, and the variance of the logarithm of its square: 0.2 to 0.6 within one
standard deviation. Where lambda takes even the mean away (a FlatCam without its constant term, little light) the image
is black, and this is all that is known."""
_STEPS, _STILL = 60, 1e-4
"""Most steps of Newton's method, and the log-likelihood below which a step ends it: 10 to 30 are taken."""
_FARTHEST = 3.0
"""Largest step of log S."""


@dataclass(frozen=True, eq=False)
class Spectrum:
    """The power spectrum of a scene.

    Attributes
    ----------
    log_power, covariance
        (J,) log S of the mean and at J - 1 octaves, and its (J, J) covariance.
    shares
        (J, r, r') mean square of each coefficient by a unit of S of each.
    """

    log_power: FloatArray
    covariance: FloatArray
    shares: FloatArray

    @property
    def energy(self) -> FloatArray:
        """(r, r') mean square of each coefficient."""
        return np.asarray(np.tensordot(np.exp(self.log_power), self.shares, axes=1))

    @property
    def of_mean(self) -> FloatArray:
        """(r, r') the part of :attr:`energy` that is the image's mean."""
        return np.asarray(np.exp(self.log_power[0]) * self.shares[0])

    def spread(self, weights: FloatArray) -> float:
        """Variance of the logarithm of the sum of all coefficients' mean squares times ``weights`` (r, r')."""
        parts = np.exp(self.log_power) * np.tensordot(self.shares, weights, axes=2)
        parts = parts / max(float(parts.sum()), 1e-300)
        return float(parts @ self.covariance @ parts)


def scene_spectrum(
    sides: tuple[Side, Side], problem: DiagonalProblem, noise: float | FloatArray, mean: float
) -> Spectrum | None:
    """The spectrum of a scene; None where there are no data.

    Parameters
    ----------
    sides
        of the model.
    problem
        its data in the diagonal basis.
    noise
        variance of each number of ``problem.projected`` (r, r'), or of all.
    mean
        of the image.
    """
    measured = problem.sigma > 0
    if not problem.projected[measured].any():
        return None
    left, right = (np.square((side.basis if side.dual is None else side.dual).T @ _cosines(side)) for side in sides)
    octaves, step = _octaves(len(left.T), len(right.T))
    shares = np.stack([left @ weight @ right.T for weight in octaves])
    # Noise that is not known to be more than rounding is that.
    least = float(np.square(problem.projected).max()) * np.finfo(np.float64).eps
    level = np.maximum(np.broadcast_to(noise, problem.sigma.shape)[measured], least)
    seen = np.square(problem.sigma[measured]) / level
    told, counts, found = _grouped(seen, shares[:, measured], np.square(problem.projected[measured]) / level)
    place = step * np.arange(len(octaves) - 1)
    fall = np.exp2(_FALL * place)
    pixels, bright = octaves[0].size, max(abs(mean), 1e-300)
    contrast = np.square(_CONTRAST * bright) * pixels / float(fall @ octaves[1:].sum(axis=(1, 2)))
    usual = np.log(np.concatenate([[pixels * _GREY**2], fall * contrast]))
    spread = np.zeros((len(usual), len(usual)))
    spread[0, 0] = _GREY_VARIANCE
    spread[1:, 1:] = _DEPARTURE**2 * np.exp(-np.abs(place[:, None] - place) / _MEMORY)
    return Spectrum(*_likeliest(told, counts, found, usual, np.asarray(np.linalg.inv(spread), np.float64)), shares)


def _cosines(side: Side) -> FloatArray:
    """(n, n) orthonormal cosines of a ``side``'s scene pixels, by column."""
    return np.asarray(dct(np.eye(side.scene_size), axis=0, norm="ortho").T)


def _octaves(rows: int, columns: int) -> tuple[FloatArray, float]:
    """(J, rows, columns) weights of the mean and of J - 1 nodes at every frequency, and the octaves between nodes."""
    frequency = np.hypot(np.arange(rows)[:, None] / rows, np.arange(columns) / columns)
    octave = np.log2(np.maximum(frequency * max(rows, columns), 1.0))
    top = max(float(octave.max()), 1.0)
    count = int(np.ceil(top)) + 1
    nodes = np.maximum(1 - np.abs(octave / top * (count - 1) - np.arange(count)[:, None, None]), 0.0)
    nodes[:, 0, 0] = 0.0
    mean = np.zeros((1, rows, columns))
    mean[0, 0, 0] = 1.0
    return np.concatenate([mean, nodes]), top / (count - 1)


def _grouped(seen: FloatArray, shares: FloatArray, data: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Means over coefficients that are seen alike (by half octaves of ``seen``) and hold the same frequencies.

    Parameters
    ----------
    seen, data
        (count,) sigma^2 and squared data, both over the noise.
    shares
        (J, count).

    Returns the groups' (groups, J) sigma^2 times shares, their sizes, and their squared data.
    """
    fine = shares[1:]
    middle = (np.arange(len(fine)) @ fine) / np.maximum(fine.sum(axis=0), 1e-300)
    keys = np.rint(2 * np.log2(seen)) * 2 * len(shares) + np.rint(2 * middle)
    _, group = np.unique(keys, return_inverse=True)
    counts = np.bincount(group)
    told = np.stack([np.bincount(group, seen * share) / counts for share in shares], axis=1)
    return told, counts.astype(np.float64), np.bincount(group, data) / counts


def _likeliest(
    told: FloatArray, counts: FloatArray, found: FloatArray, usual: FloatArray, precision: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """log S (J,) and its covariance, by Fisher scoring.

    Parameters
    ----------
    told, counts, found
        of :func:`_grouped`.
    usual, precision
        (J,) and (J, J) of log S before.
    """
    weight = counts / (1 + counts / _CERTAIN)

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
    return power, np.asarray(np.linalg.inv(information(power)[2]), np.float64)
