"""Images of bars and of a slanted edge in, how much contrast is left by spatial frequency out.

The slanted edge is ISO 12233's: the edge's place is fitted row by row, all pixels are put in order of their distance
from it, four bins a pixel, and the spectrum of the derivative is the modulation transfer function.
"""

from __future__ import annotations

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError

_BINS = 4
"""Bins a pixel along the edge's normal, as the standard has them."""
_LEAST_STEP = 0.05
"""Least step of reflectance that an edge is looked for at."""


def contrast(image: FloatArray, axis: int) -> float:
    """(I_max - I_min) / (I_max + I_min) of an ``image`` of bars, averaged along them, which lie along ``axis``.

    The paper's definition; above 1 where the least is negative.
    """
    profile = image.mean(axis=axis)
    high, low = float(profile.max()), float(profile.min())
    return (high - low) / (high + low)


def modulation(image: FloatArray, axis: int, frequency: float) -> float:
    """Contrast of an image of bars at their own frequency, which noise of others does not feign.

    Amplitude over mean of the fundamental of the profile across the bars; a square wave of contrast c has 4 c / pi.

    Parameters
    ----------
    image, axis
        as for :func:`contrast`.
    frequency
        cycles a pixel.
    """
    profile = image.mean(axis=axis)
    phase = 2 * np.pi * frequency * np.arange(len(profile))
    waves = np.stack([np.cos(phase), np.sin(phase), np.ones(len(profile))], axis=1)
    cosine, sine, mean = np.linalg.lstsq(waves, profile, rcond=None)[0]
    return float(np.hypot(cosine, sine) / mean * np.pi / 4)


def slanted_edge(image: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Modulation transfer function of an ``image`` (rows, columns) of one edge, a few degrees off its columns.

    Returns frequencies [cycles a pixel], up to half a cycle, and the transfer, 1 at zero; without that of the bins and
    of the difference that stands for the derivative.

    Raises
    ------
    MitsimError
        for an image without an edge from left to right.
    """
    rows, columns = image.shape
    centres: FloatArray = np.arange(columns, dtype=np.float64) + 0.5
    between: FloatArray = centres[:-1] + 0.5
    if abs(float(image[:, -columns // 4 :].mean() - image[:, : columns // 4].mean())) < _LEAST_STEP:
        raise MitsimError("slanted edge: the image has no step from left to right")
    slopes = np.diff(image, axis=1)
    line = np.polyfit(np.arange(rows), [_centroid(slope, between) for slope in slopes], 1)
    # Once more about the first line, so that noise far from the edge does not move it.
    near = np.exp(-np.square((between - np.polyval(line, np.arange(rows))[:, None]) / 8))
    places = [_centroid(np.asarray(slope), between) for slope in slopes * near]
    line = np.polyfit(np.arange(rows), places, 1)
    distance = (centres - np.polyval(line, np.arange(rows))[:, None]) / np.hypot(1, line[0])
    bins = np.floor(distance * _BINS).astype(int).ravel()
    half = _BINS * (columns // 4)
    inside = (bins >= -half) & (bins < half)
    count = np.bincount(bins[inside] + half, minlength=2 * half)
    edge = np.bincount(bins[inside] + half, image.ravel()[inside], 2 * half) / np.maximum(count, 1)
    spread = np.diff(edge) * np.hanning(2 * half - 1)
    spectrum = np.abs(np.fft.rfft(spread))
    frequency = np.fft.rfftfreq(len(spread)) * _BINS
    own = np.sinc(frequency / _BINS) ** 2
    kept = frequency <= 0.5
    return np.asarray(frequency[kept], dtype=np.float64), np.asarray(spectrum[kept] / spectrum[0] / own[kept])


def _centroid(weights: FloatArray, places: FloatArray) -> float:
    squares = np.square(weights)
    return float((squares * places).sum() / squares.sum())
