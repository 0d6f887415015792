"""Frames added up for the solver, with their noise, and with light that the model lacks.

*Terms that factors lack.* A camera whose shadow is no single product, for example behind a FlatCam mask with
diffraction, adds sum_k L_k (P_ij o X) R_k^T to the frames. With G_kl = L_k^T L_l and H_kl = R_l^T R_k the energy of
these terms over all patterns is ::

    sum_kl <X, (G_kl o P_L P_L^T) X (H_kl o P_R P_R^T)>

of which |T|^2 lies in the model's range, T = sum_k (sum_i U_Li^T L_k diag(p_i)) X (sum_j U_Rj^T R_k diag(q_j))^T.

*Print within a projector pixel.* Fine print has its light a dipole d beside the pixel's centre, which changes frames by
Phi_L (P_ij o d) Phi_R'^T, Phi_R' being the slope of Phi_R along its columns, and likewise for rows. The image shows the
dipole of its ramp, g / 12, but not finer print. Halves of the sensor's columns disagree about it: W_0 - G W contains
sum_j (U_0j - U_j G)^T Phi_R' diag(p_j) d^T. For independent dipoles its energy is a multiple of the energy of the error
in the image, so that the disagreement beyond noise gives the error of the image, place by place. A surface beside the
calibrated distance moves light likewise and is included."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter

from mitsim.core.arrays import FloatArray, SeparableTerm
from mitsim.core.job import Cost, Limits
from mitsim.core.manifests import Digital, FactorNoise, RunManifest
from mitsim.core.runs import Capture, Measurement
from mitsim.reconstruct.factorisation import IndexArray, Side, group_pixels
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.request import BYTES_A_NUMBER, TIKHONOV, keeps_frames, slab_numbers
from mitsim.reconstruct.solver import Accumulator, Halves, Prepared, Solution, half_spread
from mitsim.reconstruct.solvers import SOLVERS, Solver

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
    groups = group_pixels(patterns)
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


# ---- Noise of frames ----


class FrameNoise:
    """Noise of all measurements of a run, as its manifest states the sensor.

    Parameters
    ----------
    manifest
        of the run.
    ambient
        (m,) and (m',) mean noise variance by sensor row, and by sensor column, of the ambient frame that was taken off
        every shot [(electrons/s)^2]: one draw, common to all; None without one.

    Attributes
    ----------
    variance
        (K, K') mean noise variance of a datum of each pattern by its own shots [(electrons/s)^2].
    rows, columns
        (K, K', m) and (K, K', m') the same of each sensor row, and of each sensor column.
    light_error
        standard error of single projector pixels' light in simulated frames, 1 is the board's; 0: not stated.
    power, light
        sum of the squares of all shots [(electrons/s)^2], and (m, m') of all shots [electrons/s].
    means
        (K, K') mean light of each pattern's shots [electrons/s].
    shots, saturated, readings
        shots of a pattern; readings at the full well or the ADC's end, and all of them.
    factor
        largest whole number that divides all digital numbers; 1 where they are not whole.
    """

    def __init__(self, manifest: RunManifest, ambient: tuple[FloatArray, FloatArray] | None = None) -> None:
        self._digital = manifest.digital
        self.ambient = ambient
        self.light_error = manifest.light_error or 0.0
        self._sampling, self._systematic = manifest.mc_error or 0.0, _number(manifest.plan, "systematic_error")
        counts = len(manifest.patterns.P_L[0]), len(manifest.patterns.P_R[0])
        self.variance: FloatArray = np.zeros(counts)
        self.means: FloatArray = np.zeros(counts)
        self.rows: FloatArray
        self.columns: FloatArray
        self.rows, self.columns = (np.zeros((*counts, 0)) for _ in range(2))
        self.power, self.shots, self.saturated, self.readings = 0.0, 1, 0, 0
        self.factor = 0
        self.light: FloatArray = np.zeros((0, 0))

    @property
    def stated(self) -> bool:
        """Whether all of the sensor's noise is known; otherwise :attr:`variance` is that of its light alone."""
        return self._digital.noise_is_stated

    @property
    def rendering(self) -> float:
        """Energy of what simulated frames are off by, as they state it: Monte Carlo error and discretisation."""
        return float((self._sampling**2 + self._systematic**2) * self.power)

    @property
    def discretisation(self) -> float:
        """The part of :attr:`rendering` that :attr:`light_error` does not tell; all of it where that is not stated."""
        return float(self._systematic**2 * self.power) if self.light_error else self.rendering

    def of(self, light: FloatArray | float, shots: int) -> FloatArray:
        """Noise variance [(electrons/s)^2] of a measurement, with that of the frame that was taken off it.

        Parameters
        ----------
        light, shots
            sum of its shots [electrons/s], any shape, and their number.
        """
        # The difference of a pair has no ambient frame.
        ambient = float(self.ambient[0].mean()) if self.ambient and shots == 1 else 0.0
        return self._own(light, shots) + ambient

    def add(self, measurement: Measurement) -> None:
        """Count in one ``measurement``."""
        pattern, light, shots = (measurement.row, measurement.column), measurement.light, measurement.shots
        if not self.rows.size:
            self.rows, self.columns = (np.zeros((*self.variance.shape, size)) for size in light.shape)
            self.light = np.zeros(light.shape)
        self.light += light
        by_row, by_column = light.mean(axis=1), light.mean(axis=0)
        self.means[pattern] = mean = float(by_row.mean())
        self.variance[pattern] = self._own(mean, shots)
        self.rows[pattern], self.columns[pattern] = self._own(by_row, shots), self._own(by_column, shots)
        self.power += measurement.power
        self.shots = shots
        self.factor = math.gcd(self.factor, measurement.factor)
        self.saturated += measurement.saturated
        self.readings += shots * measurement.frame.size

    def _own(self, light: FloatArray | float, shots: int) -> FloatArray:
        return np.maximum(self._digital.variance(light, shots), 0.0)


def _number(plan: dict[str, Any] | None, name: str) -> float:
    value = (plan or {}).get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        return 0.0
    return float(value)


# ---- Energies beside the image: noise of factors, and separable terms that they lack ----


def factor_energy(
    prepared: Prepared, patterns: tuple[FloatArray, FloatArray], noise: FactorNoise, image: FloatArray
) -> float:
    """Energy that noisy factors add to all frames of an image, less what the fit takes up.

    Frames move by d_L (P_ij o X) Phi_R^T with d_L the error of Phi_L, independent numbers of variance s^2: in the mean
    by m s^2 sum_ij ||(P_ij o X) Phi_R^T||^2 = m s^2 sum_p |P_L[p]|^2 ||X[p] V_R S_R||^2; and by the same of the other
    side.

    Parameters
    ----------
    prepared, patterns
        the factorised model, and P_L (n, K) and P_R (n', K').
    noise
        of its factors.
    image
        (n, n').
    """
    left, right = prepared.left, prepared.right
    total = 0.0
    sides = (left, right, patterns[0], noise.left, image), (right, left, patterns[1], noise.right, image.T)
    for own, other, lit, deviation, seen in sides:
        spread = np.square(seen @ other.response).sum(axis=1)
        spare = 1 - own.rank / own.data_rows
        total += own.sensor_size * deviation**2 * spare * float(np.square(lit).sum(axis=1) @ spread)
    return total


@dataclass(frozen=True, eq=False)
class Lack:
    """What ``terms`` beside a ``model``'s factors, centred as these are, do to its ``image`` (n, n'); one or more."""

    model: Model
    terms: tuple[SeparableTerm, ...]
    image: FloatArray

    @property
    def energy(self) -> float:
        """Energy that they put into all frames outside of the model's range."""
        left, right = (lit @ lit.T for lit in self.model.patterns)
        total = 0.0
        for a, b in self.terms:
            for c, d in self.terms:
                total += float(np.vdot(self.image, ((a.T @ c) * left) @ self.image @ ((d.T @ b) * right)))
        return max(total - float(np.square(self.struck).sum()), 0.0)

    @cached_property
    def struck(self) -> FloatArray:
        """(r, r') what they add to the coefficients W of all frames."""
        sides, patterns = self.model.sides, self.model.patterns
        return np.asarray(
            sum(
                _term_response(sides[0], a, patterns[0]) @ self.image @ _term_response(sides[1], b, patterns[1]).T
                for a, b in self.terms
            )
        )


def _term_response(side: Side, term: FloatArray, patterns: FloatArray) -> FloatArray:
    seen = np.zeros((len(side.singular), term.shape[1]))
    for slab, lit in zip(side.slabs, patterns.T, strict=True):
        seen[slab.columns] += (slab.matrix.T @ term) * lit
    return seen


# ---- Frames added up ----


@dataclass(frozen=True, eq=False)
class Accumulation:
    """A run's frames added up.

    Attributes
    ----------
    shots, factors, solver
        of which, and for what image.
    model
        that the frames are of, factorised.
    frames, noise
        sums of all frames, and of their noise.
    kept
        the frames themselves while they are few; all or none.
    coefficients
        by pattern, what its frame adds to W (c, c'), while the frames are kept.
    iterative
        what the method is told besides (:attr:`mitsim.reconstruct.request.ImageRequest.iterative`).
    """

    shots: Capture
    factors: Factors
    solver: Solver
    model: Model
    frames: Accumulator
    noise: FrameNoise
    kept: tuple[Measurement, ...]
    coefficients: Mapping[tuple[int, int], FloatArray] = field(default_factory=dict)
    iterative: Mapping[str, Any] = field(default_factory=dict)

    @property
    def prepared(self) -> Prepared:
        """The factorised model."""
        return self.model.prepared

    @property
    def digital(self) -> Digital:
        """How numbers of the frames were read."""
        return self.shots.manifest.digital

    @property
    def weights(self) -> FloatArray:
        """(r, r') W of all frames."""
        problem = self.prepared.problem(self.frames)
        return np.where(problem.sigma > 0, problem.projected, 0.0)

    def measurements_again(self) -> Iterable[Measurement]:
        """All measurements once more: those that are kept, or reads them."""
        return self.kept or self.shots.pattern_measurements()

    def solution(self, lam: float | Literal["auto"]) -> Solution:
        """Their image at ``lam``."""
        return self.solver.compute(self.prepared, self.frames, lam, **self.iterative)

    def lack(self, image: FloatArray) -> Lack | None:
        """What the factors are known to lack of the camera, of an ``image`` (n, n'); None where nothing is known."""
        return Lack(self.model, self.factors.lacking, image) if self.factors.lacking else None

    def factor_energy(self, image: FloatArray) -> float | None:
        """What the factors' noise adds to all frames of an ``image`` (n, n'); None where it is not stated."""
        stated = self.factors.manifest.noise
        return factor_energy(self.prepared, self.shots.patterns, stated, image) if stated else None


def accumulate(shots: Capture, factors: Factors, solver: Solver = SOLVERS[TIKHONOV], **iterative: Any) -> Accumulation:
    """The model of shots and factors factorised, and every frame added.

    Parameters
    ----------
    shots, factors
        that fit each other.
    solver, **iterative
        of the image that they are for, as in :class:`Accumulation`.

    Raises
    ------
    MitsimError
        when that takes more memory than is free, or a frame cannot be read.
    """
    check_factorising(shots, factors, solver)
    prepared = solver.init(factors, shots.patterns)
    # The difference of a pair has no ambient frame.
    signed = any(shot.sign for shot in shots.manifest.patterns.captures)
    variance = None if signed or shots.ambient is None else shots.ambient.variance
    ambient = None if variance is None else (variance.mean(axis=1), variance.mean(axis=0))
    noise = FrameNoise(shots.manifest, ambient)
    frames, kept = prepared.accumulator(), list[Measurement]()
    coefficients: dict[tuple[int, int], FloatArray] = {}
    few = keeps_frames(shots, factors)
    for measurement in shots.pattern_measurements((len(factors.left), len(factors.right))):
        own = frames.add(measurement.frame, measurement.row, measurement.column)
        noise.add(measurement)
        if few:
            kept.append(measurement)
            coefficients[measurement.row, measurement.column] = own
    model = Model(prepared, factors.sides, shots.patterns)
    return Accumulation(shots, factors, solver, model, frames, noise, tuple(kept), coefficients, iterative)


def check_factorising(shots: Capture, factors: Factors, solver: Solver) -> None:
    """MitsimError where factorising the model takes more memory than is free.

    Parameters
    ----------
    shots, factors
        the patterns, and the camera.
    solver
        that the model is for.
    """
    cost = Cost(memory_bytes=BYTES_A_NUMBER * slab_numbers(shots, factors, whole=solver.whole))
    cost.check(f"{shots.name}: factorising its patterns", Limits())
