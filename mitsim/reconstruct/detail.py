"""Factors, patterns and halves of the sensor in; out comes how light beside its pixel's centre shows in an image.

Print that changes within a projector pixel has its light a dipole d beside the centre, which moves the frames by Phi_L
(P_ij o d) Phi_R'^T, Phi_R' being the slope of Phi_R along its columns, and by the same of rows. The image tells the
dipole of its ramp, g / 12, but not of finer print; frames do. A slope is another vector for every pixel, so halves of
the sensor's columns take it for different images: W_0 - G W of :mod:`mitsim.reconstruct.halves` holds sum_j (U_0j -
U_j G)^T Phi_R' diag(p_j) d^T, as known as the sum_j U_j^T Phi_R' diag(p_j) d^T that strikes the image. For independent
dipoles one energy is in closed form a multiple of the other, and turns the disagreement that noise does not explain
into an error of the image, place by place. A surface beside the calibrated distance moves light alike, and is told too.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from mitsim.core.arrays import FloatArray
from mitsim.reconstruct.halves import Halves, half_spread
from mitsim.reconstruct.sides import Side
from mitsim.reconstruct.solver import Prepared

EDGES = 2.9
"""Energy of hard edges at any place within a pixel over that of the ramp that their image shows: the dipole of an edge
at t is t (1 - t) / 2 with a mean square of 1/120; the slopes that the image shows around it bring 1/346."""
PRINT = (1 + EDGES) / 2
"""The same of print that may have hard edges or none: their mean."""
_ALIKE = 0.5
"""Correlation with the moved neighbour from which responses count as one moving shadow: 0.9 behind a mask of features
wider than a sensor pixel, 0.3 by chance of 64 pixels."""
_LEAST_TOLD = 0.01
"""Least energy that halves disagree on over that of the image's error, as noise is magnified by its inverse: a ninth to
a half under patterns, nothing under uniform light where neighbours in the scene tell the slope."""
_SIGNIFICANT = 3.0
"""Standard deviations of the known errors' energy above which halves disagree by more than chance."""
_NEAR = 2.0
"""Scene pixels around a place whose disagreement tells of its error, so that some 50 squares make a mean: 1, 2, 3 and 5
cover alike (within 1 %, 48 arrangements of prints, mask and patterns)."""


def print_energy(
    prepared: Prepared,
    factors: tuple[FloatArray, FloatArray],
    patterns: tuple[FloatArray, FloatArray],
    image: FloatArray,
) -> float:
    """Energy outside the model's range of print that changes within a projector pixel.

    Light of slope g a pixel moves the frames by Phi_L (P_ij o g / 12) Phi_R'^T, Phi_R' being the slope of Phi_R along
    its columns. With C = S_L V_L^T g / 12 that is sum_pq (C^T C o P_R P_R^T o Phi_R'^T Phi_R')[p, q] in all, of which
    |C T|^2 is in the range, T being :func:`moved_responses`; and the same of the other side.

    Parameters
    ----------
    prepared, factors, patterns
        the factorised model, its factors, and P_L (n, K) and P_R (n', K').
    image
        (n, n').
    """
    total = 0.0
    left, right = prepared.left, prepared.right
    sides = (left, right, factors[1], patterns[1], image), (right, left, factors[0], patterns[0], image.T)
    for other, own, factor, lit, seen in sides:
        if seen.shape[1] > 1:
            slope = slope_of(factor)
            along = (other.basis * other.singular).T @ np.gradient(seen, axis=1) / 12
            everything = np.sum((along.T @ along) * (lit @ lit.T) * (slope.T @ slope))
            total += float(everything - np.square(along @ moved_responses(own, factor, lit).sum(axis=0)).sum())
    return EDGES * max(total, 0.0)


def moved_responses(side: Side, factor: FloatArray, patterns: FloatArray) -> FloatArray:
    """(2, n, r) sum_j diag(p_j) Phi'^T U_j over each half of the sensor: what coefficients see of light one pixel
    beside the centre of its own.

    Parameters
    ----------
    side, factor, patterns
        one side of the model, its factor Phi (m, n), and its patterns (n, K).
    """
    slope = slope_of(factor)
    total = np.zeros((2, factor.shape[1], len(side.singular)))
    for half, strips in zip(total, side.halves, strict=True):
        own = np.concatenate([slope[strip] for strip in strips]).T if strips else np.zeros((factor.shape[1], 0))
        for column, slab in zip(patterns.T, side.slabs, strict=True):
            seen = np.concatenate([slab.matrix[strip] for strip in strips]) if strips else slab.matrix[:0]
            half[:, slab.columns] += column[:, None] * (own @ seen)
    return total


def slope_of(factor: FloatArray) -> FloatArray:
    """(m, n) Phi', change of a ``factor`` (m, n) by scene pixel.

    Where a shadow moves by more than a sensor pixel from one scene pixel to the next, its slope is that along the
    sensor, since neighbours in the scene may be a whole feature of the mask apart; otherwise that of neighbours.
    """
    rows, columns = factor.shape
    if columns == 1:
        return np.zeros_like(factor)
    shift = _shift(factor) if rows > 2 else 0.0
    return np.asarray(np.gradient(factor, axis=1) if abs(shift) < 1 else -shift * np.gradient(factor, axis=0))


def disagreement(
    prepared: Prepared,
    gain: FloatArray,
    halves: Halves,
    moved: tuple[FloatArray, FloatArray],
    known: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """(n, n') variance of an image by what halves of the sensor disagree on; 0 where that is no more than chance.

    Parameters
    ----------
    prepared, gain
        the factorised model, and G (r, r').
    halves
        of its data.
    moved
        :func:`moved_responses` of both sides.
    known
        (n, n') variances of the image by known errors that change from sensor row to row, and from column to column.
    """
    total = np.zeros_like(known[0])
    sides = (prepared.left, prepared.right), (prepared.right, prepared.left)
    for axis, ((own, other), response, variance) in enumerate(zip(sides, moved, known, strict=True)):
        weights, light = np.square(gain.T if axis else gain), np.square(other.singular)
        whole = response.sum(axis=0)
        parts = whole, response[0] - whole @ own.first_half
        struck, told = (float(np.square(part).sum(axis=0) @ weights @ light) for part in parts)
        # White noise of variance v has the energy v sum G^2 in the image and v sum (spread G^2) in the difference.
        spread = half_spread(own.first_half)[:, None] * weights
        level = float(variance.sum() / weights.sum())
        difference = gain * halves.differences[axis]
        beyond = float(np.square(difference).sum()) - level * float(spread.sum())
        chance = level * float(np.sqrt(2 * np.square(spread).sum()))
        if told > _LEAST_TOLD * struck and beyond > _SIGNIFICANT * chance:
            excess = np.square(prepared.image(difference)) - variance * float(spread.sum() / weights.sum())
            total += struck / told * gaussian_filter(excess, _NEAR, mode="nearest")
    return np.maximum(total, 0.0)


def _shift(factor: FloatArray) -> float:
    """Sensor pixels by which a shadow moves from one scene pixel to the next; 0 where it is no moving shadow."""
    rows = len(factor)
    spectrum = np.fft.rfft(factor - factor.mean(axis=0), 2 * rows, axis=0)
    size = float(np.square(factor - factor.mean(axis=0)).sum())
    correlation = np.fft.irfft((spectrum[:, 1:] * spectrum[:, :-1].conj()).sum(axis=1), 2 * rows)
    place = int(np.argmax(correlation))
    before, peak, after = correlation[np.arange(place - 1, place + 2) % (2 * rows)]
    if not (peak > _ALIKE * size and before + after < 2 * peak):
        return 0.0
    whole = place if place < rows else place - 2 * rows
    return whole + 0.5 * float((before - after) / (before - 2 * peak + after))  # a parabola's peak
