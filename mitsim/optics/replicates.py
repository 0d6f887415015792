"""Replicates: frames of independent groups of light in, the Monte Carlo error of their mean and its bound out.

Squared norms are estimated without bias from products with random signs (Hutchinson's estimator), because forming as
many frames as there are groups would cost more than the frames themselves.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import stdtrit

from mitsim.core.arrays import FloatArray
from mitsim.core.seeds import stream

PROBES = 8
"""Random signs beside the constant vector; chosen so that probing costs less than a frame (:func:`probe_vectors`)."""
_SURE = 0.95
"""How often an error is to be below its bound."""


def probe_vectors(pixels: int, seed: int) -> FloatArray:
    """(pixels, 1 + 8) vectors v with E sum |A v|^2 = ||A||^2: the constant one exactly, the rest by random signs.

    Most of a frame's error is common to its columns, and a few signs alone would see that part with 12 % scatter.

    Parameters
    ----------
    pixels, seed
        columns of a frame, and of the signs.
    """
    constant = np.full((pixels, 1), pixels**-0.5)
    signs = stream(seed, "probe").choice((-1.0, 1.0), size=(pixels, PROBES)) / PROBES**0.5
    return np.concatenate([constant, signs - constant @ (constant.T @ signs)], axis=1)


def noise_of_groups(probed: FloatArray, rows: int, groups: int) -> FloatArray:
    """(groups,) squared norms of the differences of groups' frames from their mean.

    Not products of vectors: BLAS adds up in an order that hangs on its threads.

    Parameters
    ----------
    probed
        (rows * groups * probes,) the groups' frames times :func:`probe_vectors`.
    rows, groups
        of a frame, and of the light.
    """
    by_group = probed.reshape(rows, groups, -1)
    return np.asarray(np.square(by_group - by_group.mean(axis=1, keepdims=True)).sum(axis=(0, 2)))


def bound_of(parts: FloatArray, energy: float) -> float:
    """What a relative Monte Carlo error is below, at 95 %, from its square's ``parts`` by group and frames' ``energy``.

    The error that was made is one draw, and its estimate another. Where few paths make the noise, groups of the light
    differ much in the energy of theirs, and so would other draws: with v the relative variance of that energy among G
    groups, the squared error is below 1 + t sqrt(v G / (G - 1)) times its estimate. Student's t of G - 1 degrees of
    freedom, as v is an estimate too.
    """
    if not energy or not parts.sum():
        return 0.0
    count = len(parts)
    above = bound_over_error((float(parts.std(ddof=1) / parts.mean())) ** 2, count) if count > 1 else 1.0
    return above * float(np.sqrt(parts.sum() / energy))


def bound_over_error(variance: float, count: int) -> float:
    """How far :func:`bound_of` lies above the error, as a ratio.

    Parameters
    ----------
    variance
        relative variance of the energy of the noise among groups.
    count
        of groups.
    """
    return math.sqrt(1 + math.sqrt(variance) * _deviations(count))


def _deviations(count: int) -> float:
    """Standard deviations of so many groups' energies from their mean to the bound on an error's."""
    return float(stdtrit(count - 1, _SURE)) * math.sqrt(count / (count - 1))


def shares_of_bound(parts: FloatArray) -> FloatArray:
    """(lights,) what each of several lights brings to the square of :func:`bound_of`, from their ``parts`` (lights,
    groups) of the variance, on their scale: none less than nothing.

    The bound's square is the variance and a multiple of how much groups differ in it; of that, a light brings its
    covariance with all light.
    """
    total, count = parts.sum(axis=0), parts.shape[1]
    deviation = float(total.std(ddof=1))
    found = parts.sum(axis=1)
    if deviation:
        along = (parts * (total - total.mean())).sum(axis=1) / (count - 1) / deviation
        found = found + _deviations(count) * count * along
    return np.asarray(np.maximum(found, 0.0))
