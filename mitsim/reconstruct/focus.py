"""Factors of another depth.

A scene point at tan-angle tau and depth z shades the sensor point u at mask coordinate s = u (1 - d/z) + d
tau, and projector pixel i lights it at tau = A_i + B_i / z, B_i being the baseline. So the factor of depth z is the
calibrated one with its columns moved: sensor pixel u sees pixel i where it saw tau_i + (B_i - u)(1/z - 1/z_0) at the
board. Beyond the window, sensor pixels further on saw the same part of the mask in a column within, at u + v and tau -
v (1/d - 1/z_0) for any v. Rows at the sensor's edge without such a column are left out.

*Between columns.* Sensor row u + k sees in column i what row u sees at i + k s, s being the columns that one sensor
pixel's step makes up for. So a cubic spline with knots finer than columns is fitted to neighbouring rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.interpolate import CubicSpline
from scipy.linalg import solveh_banded

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.manifests import Parallax
from mitsim.core.runs import Ambient, Capture, Measurement
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.request import check_parallax

_NEIGHBOURS = 4
_DEGREE = 4
_PAIRS = 32
_HIDDEN = 0.5
LEAST_PART = 0.5


# ---- Captures of which something is changed --------------------------------------------------------------------------


class DerivedCapture(Capture):
    def __init__(
        self,
        whole: Capture,
        part: tuple[slice, slice] = (slice(None), slice(None)),
        sensor: tuple[int, int] | None = None,
    ) -> None:
        super().__init__(whole.manifest, whole.folder)
        self.whole, self._part, self._sensor = whole, part, sensor

    @cached_property
    def patterns(self) -> tuple[FloatArray, FloatArray]:
        return self.whole.patterns

    @cached_property
    def ambient(self) -> Ambient | None:
        whole = self.whole.ambient
        return whole and Ambient(whole.rate[self._part], whole.variance[self._part], whole.shots)

    def pattern_measurements(self, shape: tuple[int, int] | None = None) -> Iterator[Measurement]:
        for each in self.whole.pattern_measurements(self._sensor or shape):
            yield replace(each, frame=each.frame[self._part], light=each.light[self._part])


@dataclass(frozen=True, eq=False)
class MovedFactors:
    factors: Factors
    rows: slice
    columns: slice
    sensor: tuple[int, int]
    hidden: float = 0.0

    def of(self, shots: Capture) -> Capture:
        return DerivedCapture(shots, part=(self.rows, self.columns), sensor=self.sensor)


# ---- Factors moved to another depth ----------------------------------------------------------------------------------


def move_factors(factors: Factors, depth_mm: float) -> MovedFactors:
    """Return the factors of a surface at ``depth_mm``; ArgumentError where too little of them is known."""
    parallax, sensor = parallax_of(factors), (len(factors.left), len(factors.right))
    if not (np.isfinite(depth_mm) and depth_mm > parallax.mask_distance_mm):
        raise ArgumentError(
            "focus", f"{depth_mm:g}: give a depth above {parallax.mask_distance_mm:g} mm, where the mask is"
        )
    shift = 1 / depth_mm - 1 / parallax.depth_mm
    if shift == 0:
        # The calibration's own, to the last bit.
        return MovedFactors(replace(factors, lacking=()), slice(0, sensor[0]), slice(0, sensor[1]), sensor)
    sides = [FactorOfDepths(side, parallax, axis) for axis, side in enumerate((factors.left, factors.right))]
    (left, rows), (right, columns) = (side.at(shift) for side in sides)
    for known, size in zip((rows, columns), sensor, strict=True):
        if known.stop - known.start < LEAST_PART * size:
            raise ArgumentError(
                "focus",
                f"{depth_mm:g}: {max(known.stop - known.start, 0)} of {size} sensor rows or columns know the shadow "
                f"there; give a depth nearer to the calibrated {parallax.depth_mm:g} mm, or calibrate at that depth",
            )
    manifest, noise = factors.manifest, factors.manifest.noise
    if noise:
        less = {"left": noise.left * sides[0].noise(shift), "right": noise.right * sides[1].noise(shift)}
        manifest = manifest.model_copy(update={"noise": noise.model_copy(update=less)})
    moved = replace(factors, left=left[rows], right=right[columns], manifest=manifest, lacking=())
    seen = [float((side.hidden_part(shift) < _HIDDEN).mean()) for side in sides]
    return MovedFactors(moved, rows, columns, sensor, 1 - seen[0] * seen[1])


def parallax_of(factors: Factors) -> Parallax:
    parallax = check_parallax(factors.manifest.parallax, factors.name)
    if min(factors.left.shape[1], factors.right.shape[1]) < _NEIGHBOURS:
        raise MitsimError(
            f"focus: calibration {factors.name} has {factors.left.shape[1]} x {factors.right.shape[1]} projector "
            f"pixels; columns of other depths need at least {_NEIGHBOURS} a side"
        )
    return parallax


def pixels_of_parallax(parallax: Parallax, axis: int, count: int) -> tuple[float, float, float]:
    """Return projector pixels of parallax: two for a change of 1/z by 1/mm, one for a step along the sensor by 1 mm.

    The first two are at the window's first and last edge.
    """
    window, edges = (parallax.row_tan, parallax.row_mm) if axis == 0 else (parallax.column_tan, parallax.column_mm)
    pixel = (window[1] - window[0]) / count
    return edges[0] / pixel, edges[1] / pixel, 1 / pixel


# ---- One factor at any depth -----------------------------------------------------------------------------------------


class FactorOfDepths:
    """A calibrated ``factor`` (m, n) of the left (``axis`` 0) or right side (1), and how it moves with depth.

    A change of 1/z by 1/mm moves the light of each pixel by ``edges`` (n,), and a sensor pixel's view by at most
    ``reach`` projector pixels.
    """

    def __init__(self, factor: FloatArray, parallax: Parallax, axis: int) -> None:
        self.factor, self.parallax = factor, parallax
        rows, count = factor.shape
        self._middle = (count - 1) / 2
        first, last, self._by_place = pixels_of_parallax(parallax, axis, count)
        pitch = parallax.pitch_mm(axis)
        self._place: FloatArray = (np.arange(rows) - (rows - 1) / 2) * pitch
        # Columns that one sensor pixel's step along the sensor makes up for.
        self._step = pitch * (1 / parallax.mask_distance_mm - 1 / parallax.depth_mm) * self._by_place
        self._first_tan = (parallax.row_tan if axis == 0 else parallax.column_tan)[0]
        self.edges: FloatArray = np.linspace(first, last, 2 * count + 1)[1::2]
        self.reach = float(max(abs(first), abs(last), self._by_place * rows * pitch / 2))

    def at(self, shift: float | FloatArray) -> tuple[FloatArray, slice]:
        """Return the factor at another depth, and the sensor rows where all of its columns are known.

        ``shift`` is 1/z - 1/z_0 [1/mm] of all scene pixels, or (n,) of each.
        """
        column = self._source_columns(shift)
        row, within, known = self._sources(column)
        shadows = self._shadow.at(row, within) * self.brightness(np.arange(self.factor.shape[1]))
        passed = self._transmission(column)
        mean, rows = passed.mean(axis=0), np.flatnonzero(known.all(axis=1))
        inside = slice(int(rows[0]), int(rows[-1]) + 1) if rows.size else slice(0, 0)
        # The image stays light relative to the board's, as the sensor as a whole sees it.
        return shadows * np.divide(passed, mean, out=np.zeros_like(passed), where=mean > 0), inside

    def hidden_part(self, shift: float) -> FloatArray:
        return np.asarray(1 - self._transmission(self._source_columns(shift)).mean(axis=0))

    def noise(self, shift: float) -> float:
        white = np.random.default_rng(0).standard_normal(self.factor.shape)
        row, within, _ = self._sources(self._source_columns(shift))
        return float(np.sqrt(np.mean(np.square(ColumnSpline(white, self._step).at(row, within)))))

    def brightness(self, column: npt.NDArray[np.floating | np.integer]) -> FloatArray:
        return np.asarray(np.exp(np.polynomial.polynomial.polyval(column / self._middle - 1, self._falloff)))

    def _source_columns(self, shift: float | FloatArray) -> FloatArray:
        return np.arange(self.factor.shape[1]) + (self.edges - self._by_place * self._place[:, None]) * shift

    def _sources(
        self, column: npt.NDArray[np.floating | np.integer]
    ) -> tuple[npt.NDArray[np.intp], FloatArray, npt.NDArray[np.bool_]]:
        rows, count = self.factor.shape
        within, row = np.array(column, dtype=np.float64), np.repeat(np.arange(rows)[:, None], column.shape[1], axis=1)
        known = np.ones(within.shape, dtype=np.bool_)
        outside = (within < 0) | (within > count - 1)
        away, own = within[outside], row[outside]
        steps = np.where(away < 0, -np.ceil((1 - away) / self._step), np.ceil((away - count + 2) / self._step))
        away, own = away - steps * self._step, own + steps.astype(np.intp)
        known[outside] = (own >= 0) & (own < rows) & (away >= 0) & (away <= count - 1)
        within[outside], row[outside] = np.clip(away, 0.0, count - 1.0), np.clip(own, 0, rows - 1)
        return row, within, known

    def _transmission(self, column: FloatArray) -> FloatArray:
        stop, pixel = self.parallax.stop_tan, 1 / self._by_place
        if stop is None:
            return np.ones_like(column)
        ends = self._first_tan + (np.array([0.5, self.factor.shape[1] - 0.5])) * pixel
        if np.abs(ends).max() + np.abs(self._place).max() / self.parallax.depth_mm + pixel / 2 > stop:
            return np.ones_like(column)  # the calibrated columns are cut themselves, nobody knows how far
        tangent = self._first_tan + (column + 0.5) * pixel - self._place[:, None] / self.parallax.depth_mm
        return np.clip((stop - np.abs(tangent)) / pixel + 0.5, 0.0, 1.0)

    @cached_property
    def _shadow(self) -> ColumnSpline:
        return ColumnSpline(self.factor / self.brightness(np.arange(self.factor.shape[1])), self._step)

    @cached_property
    def _falloff(self) -> FloatArray:
        rows, count = self.factor.shape
        unlike, changes = [np.zeros(1)], [np.zeros((1, _DEGREE + 1))]
        apart = np.arange(1, rows // 2, max(1, rows // _PAIRS))
        between = CubicSpline(np.arange(count), self.factor, axis=1)
        for offset in (*apart, *-apart):
            column = np.arange(count) - offset * self._step
            to = np.flatnonzero((column >= 0) & (column <= count - 1))
            row = np.arange(max(0, -offset), min(rows, rows - offset))[:, None]
            own, same = self.factor[row, to], between(column[to])[row[:, 0] + offset]
            weight = np.sqrt(np.maximum((own + same).sum(axis=0) / 2, 0.0))
            unlike.append(np.divide((own - same).sum(axis=0), weight, out=np.zeros(to.size), where=weight > 0))
            powers = [
                np.polynomial.polynomial.polyvander(place / self._middle - 1, _DEGREE) for place in (to, column[to])
            ]
            changes.append(weight[:, None] * (powers[0] - powers[1]))
        return np.asarray(np.linalg.lstsq(np.concatenate(changes), np.concatenate(unlike), rcond=None)[0])


# ---- A factor as a smooth function of the place between its columns --------------------------------------------------

_SPLINE_ROWS = 5
"""Rows to either side that a row's spline is fitted to: 2, 3 and 5 leave 1.9e-3, 1.7e-3 and 1.5e-3."""
_SPLINE_KNOTS = 4
_STIFFNESS = 1e-2


class ColumnSpline:
    def __init__(self, factor: FloatArray, step: float) -> None:
        rows, count = factor.shape
        self._last, reach = (count - 1) * _SPLINE_KNOTS, min(_SPLINE_ROWS, (rows - 1) // 2)
        size = self._last + 3
        self._coefficients, bends = np.empty((rows, size)), sparse.csr_array(np.diff(np.eye(size), 3, axis=0))
        # Rows away from the edges have equal neighbours, and therefore one normal matrix.
        groups = [(np.arange(reach, rows - reach), np.arange(-reach, reach + 1))]
        for row in (*range(reach), *range(rows - reach, rows)):
            first = min(max(row - reach, 0), rows - 2 * reach - 1)
            groups.append((np.array([row]), np.arange(first, first + 2 * reach + 1) - row))
        for own, neighbours in groups:
            place = ((np.arange(count) + neighbours[:, None] * step) * _SPLINE_KNOTS).ravel()
            start, weights = self._weights(place)
            parts = np.where((place >= 0) & (place <= self._last), weights, 0.0).ravel()
            columns, equations = (start + np.arange(4)[:, None]).ravel(), np.tile(np.arange(place.size), 4)
            design = sparse.csr_array((parts, (equations, columns)), shape=(place.size, size))
            normal, bands = design.T @ design + _STIFFNESS * bends.T @ bends, np.zeros((4, size))
            for k in range(4):
                bands[k, : size - k] = normal.diagonal(-k)
            seen = factor[own[:, None] + neighbours].reshape(len(own), -1)
            self._coefficients[own] = solveh_banded(bands, design.T @ seen.T, lower=True).T

    def at(self, row: npt.NDArray[np.intp], column: FloatArray) -> FloatArray:
        start, weights = self._weights(column * _SPLINE_KNOTS)
        first, numbers = row * self._coefficients.shape[1] + start, self._coefficients.ravel()
        return np.asarray(sum(weight * numbers.take(first + k) for k, weight in enumerate(weights)))

    def _weights(self, place: FloatArray) -> tuple[npt.NDArray[np.intp], tuple[FloatArray, ...]]:
        start = np.clip(np.floor(place).astype(np.intp), 0, self._last - 1)
        t = place - start
        square = t * t
        last = square * t / 6  # powers of arrays take ten times as long
        first = (1 + 3 * (square - t)) / 6 - last
        third = (1 + 3 * (t + square)) / 6 - 3 * last
        return start, (first, 1 - first - third - last, third, last)
