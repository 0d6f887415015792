"""Factors, patterns and halves of the sensor in; out comes how light beside its pixel's centre shows in an image.

Print that changes within a projector pixel has its light a dipole d beside the centre, which moves the frames by Phi_L
(P_ij o d) Phi_R'^T, Phi_R' being the slope of Phi_R along its columns, and by the same of rows. The image tells the
dipole of its ramp, g / 12, but not of finer print; frames do. A slope is another vector for every pixel, so halves of
the sensor's columns take it for different images: W_0 - G W of :mod:`mitsim.reconstruct.regularisation` holds
sum_j (U_0j - U_j G)^T Phi_R' diag(p_j) d^T, as known as the sum_j U_j^T Phi_R' diag(p_j) d^T that strikes the image.
For independent dipoles one energy is in closed form a multiple of the other, and turns the disagreement that noise does
not explain into an error of the image, place by place. A surface beside the calibrated distance moves light alike, and
is told too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter

from mitsim.core.arrays import FloatArray
from mitsim.core.runs import Measurement
from mitsim.reconstruct.factorisation import IndexArray, Side, group_pixels
from mitsim.reconstruct.regularisation import Halves, half_spread
from mitsim.reconstruct.solver import Prepared

EDGES = 2.9
"""Energy of hard edges at any place within a pixel over that of the ramp that their image shows: the dipole of an edge
at t is t (1 - t) / 2 with a mean square of 1/120; the slopes that the image shows around it bring 1/346."""
PRINT = (1 + EDGES) / 2
"""The same of print that may have hard edges or none: their mean."""
_ALIKE = 0.5
"""Correlation with the moved neighbour from which responses count as one moving shadow: 0.9 behind a mask of features
wider than a sensor pixel, 0.3 by chance of 64 pixels."""
_LEAST_EIGENVALUE = 0.01
"""Least energy that halves disagree on over that of the image's error, as noise is magnified by its inverse: a ninth to
a half under patterns, nothing under uniform light where neighbours in the scene tell the slope."""
_SIGNIFICANT = 3.0
"""Standard deviations of the known errors' energy above which halves disagree by more than chance."""
_NEAR = 2.0
"""Scene pixels around a place whose disagreement tells of its error, so that some 50 squares make a mean: 1, 2, 3 and 5
cover alike (within 1 %, 48 arrangements of prints, mask and patterns)."""
_BLOCKS = 4
"""Blocks a side of the scene in which a depth of their own is looked for: tilted and stepped surfaces leave a sixteenth
of their dipoles' energy unexplained by blocks, and each has pixels enough to tell a depth from print."""
_EDGE = 0.5
"""Scene pixels from the centre of one to its edge."""
_PLACES = (0.1, 0.3), (0.4, 0.8), (0.7, 0.1), (0.9, 0.6)
"""Groups of lit rows and columns that are looked at, as parts of their number: four that are spread over both."""
_RANK = 1e-6
"""Relative eigenvalue below which a block's depth is not told: chosen, blocks without light have none."""


@dataclass(frozen=True, eq=False)
class Model:
    """A factorised model, and what it sees of light beside the centres of its pixels.

    Parameters
    ----------
    prepared
        the factorised model.
    factors
        Phi_L (m, n) and Phi_R (m', n'), centred where the model is.
    patterns
        P_L (n, K) and P_R (n', K').
    """

    prepared: Prepared
    factors: tuple[FloatArray, FloatArray]
    patterns: tuple[FloatArray, FloatArray]

    @property
    def sides(self) -> tuple[Side, Side]:
        """The factorised sides."""
        return self.prepared.left, self.prepared.right

    @cached_property
    def slopes(self) -> tuple[FloatArray, FloatArray]:
        """Phi_L' and Phi_R', see :func:`factor_slope`."""
        return factor_slope(self.factors[0]), factor_slope(self.factors[1])

    @cached_property
    def moved(self) -> tuple[FloatArray, FloatArray]:
        """:func:`offset_responses` of both sides."""
        left, right = zip(self.sides, self.slopes, self.patterns, strict=True)
        return offset_responses(*left), offset_responses(*right)


def print_energy(model: Model, image: FloatArray) -> float:
    """Energy outside a ``model``'s range of print that changes within a projector pixel, when its ``image`` is (n, n').

    Light of slope g a pixel moves the frames by Phi_L (P_ij o g / 12) Phi_R'^T, Phi_R' being the slope of Phi_R along
    its columns. With C = S_L V_L^T g / 12 that is sum_pq (C^T C o P_R P_R^T o Phi_R'^T Phi_R')[p, q] in all, of which
    |C T|^2 is in the range, T being :func:`offset_responses`; and the same of the other side.
    """
    total = 0.0
    own = tuple(zip(model.sides, model.slopes, model.patterns, model.moved, strict=True))
    for (other, *_), (_, slope, lit, moved), seen in (own[0], own[1], image), (own[1], own[0], image.T):
        if seen.shape[1] > 1:
            along = other.response.T @ np.gradient(seen, axis=1) / 12
            everything = np.sum((along.T @ along) * (lit @ lit.T) * (slope.T @ slope))
            total += float(everything - np.square(along @ moved.sum(axis=0)).sum())
    return EDGES * max(total, 0.0)


@dataclass(frozen=True, eq=False)
class LitFrame:
    """Light of few pixels alone.

    Attributes
    ----------
    frame, variance
        (m, m') of it, and the noise variance of each number.
    factors, slopes
        columns of both sides' factors at the lit pixels, (m, c) and (m', c'), and their slopes.
    blocks
        (c,) and (c',) block of the scene, along its side, that each lit pixel is in.
    """

    frame: FloatArray
    variance: float
    factors: tuple[FloatArray, FloatArray]
    slopes: tuple[FloatArray, FloatArray]
    blocks: tuple[IndexArray, IndexArray]

    @cached_property
    def ranges(self) -> tuple[FloatArray, FloatArray]:
        """Orthonormal columns that span the factors' of both sides."""
        return orthonormal(self.factors[0]), orthonormal(self.factors[1])

    @cached_property
    def wider(self) -> tuple[FloatArray, FloatArray]:
        """The same of factors and slopes."""
        left, right = (
            orthonormal(np.hstack([columns, slope])) for columns, slope in zip(self.factors, self.slopes, strict=True)
        )
        return left, right

    def beyond(self, left: FloatArray, right: FloatArray) -> float:
        """Energy beyond the noise that two orthonormal ranges leave, ``left`` (m, r) and ``right`` (m', r')."""
        seen = left.T @ self.frame @ right
        beyond = np.square(self.frame).sum() - np.square(seen).sum() - (self.frame.size - seen.size) * self.variance
        return float(beyond)

    @cached_property
    def moments(self) -> FloatArray:
        """(3,) sums of squares of the lit pixels' light, and of its dipoles along rows and along columns."""
        inverse = [np.linalg.pinv(np.hstack(both)) for both in zip(self.factors, self.slopes, strict=True)]
        found = inverse[0] @ self.frame @ inverse[1].T
        rows, columns = (side.shape[1] for side in self.factors)
        parts = found[:rows, :columns], found[rows:, :columns], found[:rows, columns:]
        return np.array([np.square(part).sum() for part in parts])

    def of_depths(self) -> tuple[FloatArray, FloatArray]:
        """Normal matrix and right side of the dipoles, along rows and columns of each block, that are the same multiple
        of all its pixels' light, fitted to what the factors alone leave."""
        (left, right), (wide, wide_) = self.ranges, self.wider
        image = np.linalg.pinv(self.factors[0]) @ self.frame @ np.linalg.pinv(self.factors[1]).T
        own, own_ = wide.T @ left, wide_.T @ right
        seen, slid = ([wide.T @ of[0], wide_.T @ of[1]] for of in (self.factors, self.slopes))

        def outside(frame: FloatArray) -> FloatArray:
            return np.asarray(frame - own @ (own.T @ frame @ own_) @ own_.T).ravel()

        moved = []
        for row, column in np.ndindex(_BLOCKS, _BLOCKS):
            part = image * np.outer(self.blocks[0] == row, self.blocks[1] == column)
            moved += [outside(slid[0] @ part @ seen[1].T), outside(seen[0] @ part @ slid[1].T)]
        vectors = np.stack(moved)
        return vectors @ vectors.T, vectors @ outside(wide.T @ self.frame @ wide_)


class LitFrames:
    """Adds measurements up to light of a few groups of scene pixels alone.

    Parameters
    ----------
    factors
        both factors of the model.
    patterns
        P_L (n, K) and P_R (n', K').
    """

    def __init__(self, factors: tuple[FloatArray, FloatArray], patterns: tuple[FloatArray, FloatArray]) -> None:
        self._factors = factors
        sides = [_lit_groups(side) for side in patterns]
        self._apart = all(sides)
        places = {(int(row * len(sides[0])), int(column * len(sides[1]))) for row, column in _PLACES}
        self._groups = [(sides[0][row], sides[1][column]) for row, column in sorted(places)] if self._apart else []
        shape = len(factors[0]), len(factors[1])
        self._frames: list[FloatArray] = [np.zeros(shape) for _ in self._groups]
        self._variances = [0.0] * len(self._groups)

    def collect(self, measurement: Measurement, frame: FloatArray, variance: float) -> None:
        """Add a measurement.

        Parameters
        ----------
        measurement
            its pattern.
        frame
            (m, m') as the solver takes it.
        variance
            mean noise variance of its data.
        """
        for k, ((_, rows), (_, columns)) in enumerate(self._groups):
            weight = rows[measurement.row] * columns[measurement.column]
            if weight:
                self._frames[k] += weight * frame
                self._variances[k] += weight**2 * variance

    def print_part(self) -> float:
        """Return :func:`print_part` of these frames; NaN where pixels of patterns overlap."""
        if not self._apart:
            return float("nan")
        slopes = [factor_slope(side, spline=True) for side in self._factors]
        frames = []
        for ((rows, _), (columns, _)), frame, variance in zip(self._groups, self._frames, self._variances, strict=True):
            lit = self._factors[0][:, rows], self._factors[1][:, columns]
            blocks = block_indices(rows, self._factors[0].shape[1]), block_indices(columns, self._factors[1].shape[1])
            frames.append(LitFrame(frame, variance, lit, (slopes[0][:, rows], slopes[1][:, columns]), blocks))
        return print_part(frames)


def _lit_groups(patterns: FloatArray) -> list[tuple[IndexArray, FloatArray]]:
    """Return groups of scene pixels of one side, each with the weights (K,) of the measurements that add up to its
    light; empty where pixels of patterns overlap."""
    groups = group_pixels(patterns, "block")
    if any(group.shared is None for group in groups):
        return []
    lit = [(group.pixels, group.shared[1]) for group in groups if group.shared and group.shared[1].any()]
    return [(pixels, psi / np.dot(psi, psi)) for pixels, psi in lit]


def print_part(frames: Sequence[LitFrame]) -> float:
    """Part of what lit pixels leave of ``frames`` that is light beside these pixels' centres, but not because of depth.

    Print has its light on either side of the centres; a surface beside the calibrated distance has all of it on one, by
    the same part of a pixel nearby. So what depths explain, the same for all frames, is no print: of the whole scene or
    block by block, told from all frames but that which they explain, as dipoles of print may add up to any depth in
    one. No light is further from its pixel's centre than the edge: more has been moved by something else. Wider ranges
    explain a part of anything, too, in proportion to their size.
    """
    light, *dipoles = np.sum([each.moments for each in frames], axis=0)
    if max(dipoles) > _EDGE**2 * light:
        return 0.0
    own = sum(each.beyond(*each.ranges) for each in frames)
    left_over = 0.0
    for each in frames:
        (left, right), (wide, wide_) = each.ranges, each.wider
        spare = each.frame.size - wide.shape[1] * wide_.shape[1]
        if spare <= 0:
            return 0.0
        left_over += each.beyond(wide, wide_) * (each.frame.size - left.shape[1] * right.shape[1]) / spare
    if own <= 0:
        return 0.0
    depths = [each.of_depths() for each in frames]
    whole = np.tile(np.eye(2), _BLOCKS**2)
    of_depth = max(
        _predicted_energy(depths),
        _predicted_energy([(whole @ matrix @ whole.T, whole @ side) for matrix, side in depths]),
    )
    return float(np.clip(1 - (max(left_over, 0.0) + max(of_depth, 0.0)) / own, 0.0, 1.0))


def _predicted_energy(problems: Sequence[tuple[FloatArray, FloatArray]]) -> float:
    """Energy of least-squares ``problems`` that the solution of all others explains; of a single one, its own."""
    total = 0.0
    for index, (matrix, side) in enumerate(problems):
        others = [each for place, each in enumerate(problems) if place != index] or [(matrix, side)]
        normal, data = (np.sum(parts, axis=0) for parts in zip(*others, strict=True))
        found = np.linalg.lstsq(normal, data, rcond=_RANK)[0]
        total += float(2 * found @ side - found @ matrix @ found)
    return total


def orthonormal(matrix: FloatArray) -> FloatArray:
    """Orthonormal columns that span those of ``matrix``, but for directions that are rounding."""
    left, singular, _ = np.linalg.svd(matrix, full_matrices=False)
    return np.asarray(left[:, singular > singular[0] * max(matrix.shape) * np.finfo(np.float64).eps])


def block_indices(pixels: IndexArray, size: int) -> IndexArray:
    """Which of the blocks along a side of ``size`` scene pixels each of the ``pixels`` is in."""
    return pixels * _BLOCKS // size


def offset_responses(side: Side, slope: FloatArray, patterns: FloatArray) -> FloatArray:
    """(2, n, r) sum_j diag(p_j) Phi'^T U_j over each half of the sensor: what coefficients see of light one pixel
    beside the centre of its own.

    Parameters
    ----------
    side, slope, patterns
        one side of the model, the slope Phi' (m, n) of its factor, and its patterns (n, K).
    """
    total = np.zeros((2, slope.shape[1], len(side.singular)))
    for half, strips in zip(total, side.halves, strict=True):
        own = np.concatenate([slope[strip] for strip in strips]).T if strips else np.zeros((slope.shape[1], 0))
        for column, slab in zip(patterns.T, side.slabs, strict=True):
            seen = np.concatenate([slab.matrix[strip] for strip in strips]) if strips else slab.matrix[:0]
            half[:, slab.columns] += column[:, None] * (own @ seen)
    return total


def factor_slope(factor: FloatArray, spline: bool = False) -> FloatArray:
    """(m, n) Phi', change of a ``factor`` (m, n) by scene pixel.

    Where a shadow moves by more than a sensor pixel from one scene pixel to the next, its slope is that along the
    sensor, since neighbours in the scene may be a whole feature of the mask apart; otherwise that of neighbours.

    Parameters
    ----------
    factor
        of one side.
    spline
        whether by a cubic spline through neighbours instead of their differences: half as much is missed at the edges
        of features, 6 instead of 11 % of the energy of points in pixels of 1.9 mm, and noise counts twice.
    """
    rows, columns = factor.shape
    if columns == 1:
        return np.zeros_like(factor)
    shift = _shift(factor) if rows > 2 else 0.0
    if abs(shift) >= 1:
        return np.asarray(-shift * np.gradient(factor, axis=0))
    places = np.arange(columns)
    return np.asarray(CubicSpline(places, factor, axis=1)(places, 1) if spline else np.gradient(factor, axis=1))


def disagreement(model: Model, gain: FloatArray, halves: Halves, known: tuple[FloatArray, FloatArray]) -> FloatArray:
    """(n, n') variance of an image by what halves of the sensor disagree on; 0 where that is no more than chance.

    Parameters
    ----------
    model, gain
        and its G (r, r').
    halves
        of its data.
    known
        (n, n') variances of the image by known errors that change from sensor row to row, and from column to column.
    """
    total = np.zeros_like(known[0])
    sides = model.sides, model.sides[::-1]
    for axis, ((own, other), response, variance) in enumerate(zip(sides, model.moved, known, strict=True)):
        weights, light = np.square(gain.T if axis else gain), np.square(other.response).sum(axis=0)
        whole = response.sum(axis=0)
        parts = whole, response[0] - whole @ own.first_half
        struck, expected = (float(np.square(part).sum(axis=0) @ weights @ light) for part in parts)
        # White noise of variance v has the energy v sum G^2 in the image and v sum (spread G^2) in the difference.
        spread = half_spread(own.first_half)[:, None] * weights
        level = float(variance.sum() / weights.sum())
        difference = gain * halves.differences[axis]
        beyond = float(np.square(difference).sum()) - level * float(spread.sum())
        chance = level * float(np.sqrt(2 * np.square(spread).sum()))
        if expected > _LEAST_EIGENVALUE * struck and beyond > _SIGNIFICANT * chance:
            excess = np.square(model.prepared.image(difference)) - variance * float(spread.sum() / weights.sum())
            total += struck / expected * gaussian_filter(excess, _NEAR, mode="nearest")
    return np.maximum(total, 0.0)


def _shift(factor: FloatArray) -> float:
    """Sensor pixels by which a shadow moves from one scene pixel to the next; 0 where it is no moving shadow."""
    rows = len(factor)
    shadows = np.ascontiguousarray((factor - factor.mean(axis=0)).T)  # transforms are faster along lines of memory
    spectra = np.fft.rfft(shadows, 2 * rows)
    size = float(np.square(shadows).sum())
    correlation = np.fft.irfft((spectra[1:] * spectra[:-1].conj()).sum(axis=0), 2 * rows)
    place = int(np.argmax(correlation))
    before, peak, after = correlation[np.arange(place - 1, place + 2) % (2 * rows)]
    if not (peak > _ALIKE * size and before + after < 2 * peak):
        return 0.0
    whole = place if place < rows else place - 2 * rows
    return whole + 0.5 * float((before - after) / (before - 2 * peak + after))  # a parabola's peak
