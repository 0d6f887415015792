"""Factors for another depth, and a search for the depth that leaves the least energy unexplained.

The search finds one depth for the whole scene, or one for each projector pixel.

*Factors for another depth.* A scene point at tan-angle tau and depth z shades the sensor point u at mask coordinate
s = u (1 - d/z) + d tau, and projector pixel i lights it at tau = A_i + B_i / z, B_i being the baseline. So the factor
of depth z is the calibrated one with its columns moved: sensor pixel u sees pixel i where it saw tau_i + (B_i - u)(1/z
- 1/z_0) at the board. Beyond the window, sensor pixels further on saw the same part of the mask in a column within, at
u + v and tau - v (1/d - 1/z_0) for any v. Rows at the sensor's edge without such a column are left out.

*Between columns.* Sensor row u + k sees in column i what row u sees at i + k s, s being the columns that one sensor
pixel's step makes up for. So a cubic spline with knots finer than columns is fitted to neighbouring rows.

*One depth.* The energy ||Y||^2 - sum_ij ||U_Li^T Y_ij U_Rj||^2, which no lambda changes, has a narrow valley at the
true depth, and others where dots of period k see their neighbours' light. So every valley that may be the lowest is
followed to its bottom, and valleys that chance or the model's misfit may have raised are reported as alternatives.

*A depth for each pixel.* See docs/reconstruction.md. At the end pixels take the depth of a neighbour where that
explains more, which makes edges sharp.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.interpolate import CubicSpline
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter, median_filter, minimum_filter
from scipy.optimize import minimize_scalar

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.manifests import Parallax
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import Capture, Measurement
from mitsim.reconstruct.accumulation import CHANCE, DerivedCapture, FrameNoise, factor_energy
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.request import check_parallax
from mitsim.reconstruct.solver import Side, centre_columns, centre_frame, factorise, group_pixels, prepare

# ---- Factors moved to another depth ----------------------------------------------------------------------------------

_NEIGHBOURS = 4
_DEGREE = 4
LEAST_PART = 0.5


@dataclass(frozen=True, eq=False)
class MovedFactors:
    factors: Factors
    rows: slice
    columns: slice
    sensor: tuple[int, int]
    hidden: float = 0.0

    def of(self, shots: Capture) -> Capture:
        return DerivedCapture(shots, part=(self.rows, self.columns), sensor=self.sensor)


def move_factors(factors: Factors, depth_mm: float) -> MovedFactors:
    """Return the factors of a surface at ``depth_mm``; ArgumentError where too little of them is known."""
    parallax, sensor = parallax_of(factors), (len(factors.left), len(factors.right))
    if not (np.isfinite(depth_mm) and depth_mm > parallax.mask_distance_mm):
        least = f"{parallax.mask_distance_mm:g} mm, where the mask is"
        raise ArgumentError("focus", f"{depth_mm:g}: give a depth above {least}")
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
    seen = [float((side.hidden_part(shift) < 0.5).mean()) for side in sides]
    return MovedFactors(moved, rows, columns, sensor, 1 - seen[0] * seen[1])


def parallax_of(factors: Factors) -> Parallax:
    parallax = check_parallax(factors.manifest.parallax, factors.name)
    if min(factors.left.shape[1], factors.right.shape[1]) < _NEIGHBOURS:
        size = f"{factors.left.shape[1]} x {factors.right.shape[1]} projector pixels"
        least = f"columns of other depths need at least {_NEIGHBOURS} a side"
        raise MitsimError(f"focus: calibration {factors.name} has {size}; {least}")
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
        apart = np.arange(1, rows // 2, max(1, rows // 32))
        between = CubicSpline(np.arange(count), self.factor, axis=1)
        for offset in (*apart, *-apart):
            column = np.arange(count) - offset * self._step
            to = np.flatnonzero((column >= 0) & (column <= count - 1))
            row = np.arange(max(0, -offset), min(rows, rows - offset))[:, None]
            own, same = self.factor[row, to], between(column[to])[row[:, 0] + offset]
            weight = np.sqrt(np.maximum((own + same).sum(axis=0) / 2, 0.0))
            unlike.append(np.divide((own - same).sum(axis=0), weight, out=np.zeros(to.size), where=weight > 0))
            places = (place / self._middle - 1 for place in (to, column[to]))
            powers = [np.polynomial.polynomial.polyvander(place, _DEGREE) for place in places]
            changes.append(weight[:, None] * (powers[0] - powers[1]))
        return np.asarray(np.linalg.lstsq(np.concatenate(changes), np.concatenate(unlike), rcond=None)[0])


# ---- A factor as a smooth function of the place between its columns --------------------------------------------------

_SPLINE_ROWS = 5
"""Rows to either side that a row's spline is fitted to: 2, 3 and 5 leave 1.9e-3, 1.7e-3 and 1.5e-3."""
_SPLINE_KNOTS = 4


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
            normal, bands = design.T @ design + 1e-2 * bends.T @ bends, np.zeros((4, size))
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


# ---- Results ---------------------------------------------------------------------------------------------------------

RANGE = 0.25
"""Searched part of 1/z on either side: 320 to 533 mm for 400."""
_RESOLUTION = 0.01
_OPPOSED = 4.0
"""Times the unexplained energy S by which depths must differ: the wrong one wins if 2 r.d > |r|^2, so |r|^2 < 4 S."""


@dataclass(frozen=True)
class Alternative:
    mm: float
    difference: float


@dataclass(frozen=True)
class Depth:
    mm: float
    error_mm: float | None = None
    doubt: str = ""
    range_mm: tuple[float, float] | None = None
    alternatives: tuple[Alternative, ...] = ()
    at_end: bool = False

    def __str__(self) -> str:
        others = "".join(f" or {other.mm:.6g}" for other in self.alternatives)
        found = f"focus: {self.mm:.6g}{others} mm"
        if self.error_mm is None or self.range_mm is None:
            return found
        near, far = self.range_mm
        return f"{found} +- {self.error_mm:.1g}, by the least misfit from {near:.0f} to {far:.0f} mm"


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Depths [mm] by projector pixel, and their ``image`` (n, n')."""

    image: FloatArray
    mm: FloatArray
    confidence: FloatArray
    lam: float
    left_over: float
    energy: float
    data: int
    part: float
    doubt: str = ""
    range_mm: tuple[float, float] | None = None
    smoothing: float = 1.0
    alternatives: tuple[Alternative, ...] = ()

    def __str__(self) -> str:
        if self.doubt:
            return "focus: no depth could be estimated; the image uses the calibrated depth"
        message = self.summary()
        depths = f"{message['least_mm']:.4g} to {message['most_mm']:.4g} mm, median {message['median_mm']:.4g}"
        return f"focus: depths of {depths}, estimated for {message['told_part']:.0%} of pixels"

    @property
    def reliable(self) -> npt.NDArray[np.bool_]:
        return np.asarray(self.confidence >= _RELIABLE)

    def summary(self) -> dict[str, float]:
        reliable = self.mm[self.reliable] if self.reliable.any() else self.mm
        low, middle, high = (float(value) for value in np.percentile(reliable, (1, 50, 99)))
        return {"least_mm": low, "median_mm": middle, "most_mm": high, "told_part": float(self.reliable.mean())}


# ---- A basis that factors of all depths share ------------------------------------------------------------------------


class CommonBasis:
    """Frames of a capture, and factors of any depth within a range, on a basis that depths share.

    ``stack`` (K, r, K', r') has all measurements; no depth explains the part ``outside`` of their ``energy``.
    """

    def __init__(self, shots: Capture, factors: Factors, shifts: tuple[float, float]) -> None:
        parallax, self.patterns, self._centre = parallax_of(factors), shots.patterns, factors.manifest.centre
        sensor = len(factors.left), len(factors.right)
        self.sides = [FactorOfDepths(side, parallax, axis) for axis, side in enumerate((factors.left, factors.right))]
        self._parts, self._bases = list[slice](), list[FloatArray]()
        for side, size in zip(self.sides, sensor, strict=True):
            tried = np.linspace(*shifts, max(int(np.ceil((shifts[1] - shifts[0]) * side.reach)) + 1, 2))
            found = [side.at(shift) for shift in tried]
            part = slice(max(each.start for _, each in found), min(each.stop for _, each in found))
            if part.stop - part.start < LEAST_PART * size:
                near, far = (1 / (1 / parallax.depth_mm + shift) for shift in reversed(shifts))
                raise ArgumentError(
                    "depth_range",
                    f"{near:.4g} to {far:.4g} mm: {max(part.stop - part.start, 0)} of {size} sensor rows or columns "
                    "know the shadow at all of these depths; give a range nearer to the calibrated "
                    f"{parallax.depth_mm:g} mm",
                )
            own = [centre_columns(columns[part]) if self._centre else columns[part] for columns, _ in found]
            energies, vectors = np.linalg.eigh(sum(each @ each.T for each in own))
            lost = np.cumsum(np.maximum(energies, 0.0))
            self._parts.append(part)
            self._bases.append(vectors[:, -int((lost > 1e-6 * lost[-1]).sum()) :])
        (rows, columns), (left, right) = self._parts, self._bases
        counts = [patterns.shape[1] for patterns in self.patterns]
        self.stack = np.zeros((counts[0], left.shape[1], counts[1], right.shape[1]))
        self.energy, self.noise, kept = 0.0, FrameNoise(shots.manifest), list[Measurement]()
        for each in shots.pattern_measurements(sensor):
            frame = each.frame[rows, columns]
            frame = centre_frame(frame) if self._centre else frame
            self.energy += float(np.square(frame).sum())
            self.noise.add(each)
            small = self.stack[each.row, :, each.column]
            small[:] = left.T @ frame @ right
            kept.append(Measurement(small, each.row, each.column, small, each.shots, 0))
        self.frames = tuple(kept)
        self.outside = self.energy - sum(float(np.square(each.frame).sum()) for each in kept)
        self.data = len(kept) * len(left) * len(right)
        self.part = len(left) * len(right) / (sensor[0] * sensor[1])

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.patterns[0]), len(self.patterns[1])

    def side(self, axis: int, shift: float | FloatArray, margin: int = 0) -> FloatArray:
        side, part = self.sides[axis], self._parts[axis]
        columns = side.at(shift)[0][part]
        if margin:
            before, beyond = (side.at(away / side.edges)[0][part] for away in (-margin, margin))
            columns = np.hstack([before[:, :margin], columns, beyond[:, columns.shape[1] - margin :]])
        return np.asarray(self._bases[axis].T @ (centre_columns(columns) if self._centre else columns))

    def smoothing(self, shift: float) -> float:
        return float(np.mean([side.noise(shift) ** 2 for side in self.sides]))


# ---- The search for the depth that leaves least ----------------------------------------------------------------------

_STEP = 0.5


def chance_difference(difference: float, variance: float, unknowns: int) -> float:
    """Return the energy by which noise may make the residuals of two models differ.

    Light of energy D that the wrong model does not explain meets noise of variance v: 4 v D. Noise that only one model
    takes up has at most the variance 4 v^2 times the ``unknowns``.
    """
    return CHANCE * float(np.sqrt(4 * variance * max(difference, 0.0) + 4 * variance**2 * unknowns))


def shifts_searched(factors: Factors, depth_range: tuple[float, float] | None) -> tuple[float, float]:
    """Return the ends of the searched 1/z - 1/z_0 [1/mm], for a range of depths [mm] or the default one."""
    parallax = parallax_of(factors)
    if depth_range is None:
        return -RANGE / parallax.depth_mm, RANGE / parallax.depth_mm
    near, far = depth_range
    if near <= parallax.mask_distance_mm:
        least = f"{parallax.mask_distance_mm:g} mm, where the mask is"
        raise ArgumentError("depth_range", f"{near:g} to {far:g} mm: begin above {least}")
    return 1 / far - 1 / parallax.depth_mm, 1 / near - 1 / parallax.depth_mm


def _moves(factors: Factors) -> FloatArray:
    counts = factors.left.shape[1], factors.right.shape[1]
    ends = [pixels_of_parallax(parallax_of(factors), axis, count)[:2] for axis, count in enumerate(counts)]
    return np.array([max(map(abs, each)) for each in ends])


def are_dots(patterns: FloatArray) -> bool:
    """Return True if each pixel is lit by one pattern alone."""
    values = np.sort(patterns, axis=1)
    return not values[:, :-1].any() and bool((values[:, -1] == 1).all())


def period_of_dots(factors: Factors, patterns: Sequence[FloatArray]) -> float:
    """Return the change of 1/z [1/mm] that moves the light of dots onto another dot; inf without a baseline."""
    moves = _moves(factors)
    return _period(moves, patterns) if moves.any() else np.inf


def _period(moves: FloatArray, patterns: Sequence[FloatArray]) -> float:
    """Return the change of 1/z [1/mm] that moves the light of dots onto another dot of the same frame."""
    periods, pixel = [lit.shape[1] for lit in patterns], 1 / moves.max()
    for parallax in np.arange(1.0, np.prod(periods) + 1, _STEP / 4):
        turns = moves * pixel * parallax / periods
        if np.round(turns).any() and (np.abs(turns - np.round(turns)) * periods < _STEP / 2).all():
            return float(np.ceil(parallax) * pixel)
    return np.inf


def project_frames(left: Side, right: Side, frames: FloatArray) -> FloatArray:
    """Return W = sum_ij U_Li^T Y_ij U_Rj of ``frames`` (K, m, K', m')."""
    total = np.zeros((len(left.singular), len(right.singular)))
    for slab, own in zip(left.slabs, frames, strict=True):
        seen = (slab.matrix.T @ own.reshape(len(own), -1)).reshape(-1, *own.shape[1:])
        rows = np.arange(len(total))[slab.columns]
        for j, other in enumerate(right.slabs):
            total[rows[:, None], np.arange(total.shape[1])[other.columns]] += seen[:, j] @ other.matrix
    return total


@single_threaded_blas()
def best_depth(shots: Capture, factors: Factors, depth_range: tuple[float, float] | None = None) -> Depth:
    """Return the depth, between two given ones [mm] or a quarter of 1/z either way, whose factors explain most.

    Raises MitsimError without a stated parallax, and ArgumentError for a range that too little of the sensor knows.
    """
    (first, last), moves, beyond = shifts_searched(factors, depth_range), _moves(factors), 0.0
    inverse, stated = 1 / parallax_of(factors).depth_mm, factors.manifest.noise
    if depth_range is None:
        # A surface beyond the range, but for a period, is within it: only where a range is given that is excluded.
        periodic = moves.any() and all(map(are_dots, shots.patterns))
        beyond = min(_period(moves, shots.patterns), last) if periodic else last
    tried = first - beyond, last + beyond
    basis = CommonBasis(shots, factors, tried)
    groups, pixel = [group_pixels(lit) for lit in basis.patterns], 1 / max(side.reach for side in basis.sides)
    unknowns = basis.shape[0] * basis.shape[1]

    def left_over(shift: float) -> float:
        left, right = (factorise(basis.side(axis, shift), basis.patterns[axis], groups[axis]) for axis in (0, 1))
        measured = np.outer(left.singular, right.singular) > 0
        return basis.energy - float(np.square(project_frames(left, right, basis.stack)[measured]).sum())

    # Every valley that may be the lowest is followed to its bottom.
    steps = max(int(np.ceil((tried[1] - tried[0]) / pixel)), 32)
    shifts = np.linspace(*tried, steps + 1)
    scores = np.array([left_over(shift) for shift in shifts])
    beside = np.minimum(np.append(scores[1:], np.inf), np.append(np.inf, scores[:-1]))
    least, below, valleys = np.inf, np.inf, list[tuple[float, float]]()
    for index in sorted(map(int, np.flatnonzero(scores <= beside)), key=lambda index: float(scores[index])):
        if scores[index] - 2.0 * below > least:
            break
        bounds = shifts[max(index - 1, 0)], shifts[min(index + 1, steps)]
        found = minimize_scalar(left_over, bounds=bounds, method="bounded", options={"xatol": _RESOLUTION * pixel})
        valleys.append((float(found.fun), float(found.x)))
        if found.fun < least:
            least, half = float(found.fun), (shifts[1] - shifts[0]) / 2
            below = max(left_over(float(np.clip(found.x + part, *tried))) for part in (-half, half)) - least
    (least, shift), *others = sorted(valleys)
    mm, range_mm = 1 / (inverse + shift), (1 / (inverse + last), 1 / (inverse + first))
    # The standard error follows from the curvature of the valley.
    near, far, before, after = (left_over(shift + part * pixel) for part in (1, -1, -0.25, 0.25))
    curvature, variance = (before - 2 * least + after) / (pixel / 4) ** 2, least / max(basis.data - unknowns, 1)
    error = float(np.sqrt(2 * variance / curvature)) if curvature > 0 else float("inf")
    rise, misfit = min(near, far) - least, 0.0
    if basis.noise.stated and stated:
        prepared = prepare(basis.side(0, shift), basis.side(1, shift), *basis.patterns)
        sums = prepared.accumulator((each.frame, each.row, each.column) for each in basis.frames)
        image = prepared.solve(sums, 1e-3 * prepared.problem(sums).scale).image
        expected = float(basis.noise.variance.mean()) * (basis.data - image.size) + basis.part * basis.noise.rendering
        expected += basis.smoothing(shift) * factor_energy(prepared, basis.patterns, stated, image)
        misfit = max(least - expected, 0.0)

    def indifferent(difference: float) -> float:
        return max(chance_difference(difference, variance, unknowns), _OPPOSED * misfit)

    rises = ((left - least, 1 / (inverse + other)) for left, other in others)
    alike = ((more, other) for more, other in rises if more < indifferent(more))
    alternatives = tuple(Alternative(other, float(np.sqrt(more / basis.energy))) for more, other in alike)
    doubt, at_end = "", min(abs(end - shift) for end in (first, last, *tried)) < 2 * _RESOLUTION * pixel
    if at_end or not first < shift < last:
        doubt = (
            f"End of range: the best depth, {mm:.1f} mm, is at an end of the range from {range_mm[0]:.0f} to "
            f"{range_mm[1]:.0f} mm, so that the scene may lie outside; give a wider range with --depth-range NEAR:FAR "
            "or depth_range, or calibrate nearer to the scene."
        )
    elif not (error < pixel and rise > max(indifferent(rise), 2e-5 * basis.energy)):
        doubt = "These patterns hardly determine depth: use shifting dots of a longer period, such as dots:7x32."
    elif alternatives:
        others_mm = (f"{other.mm:.1f} mm (by {other.difference:.1e} of them less, rms)" for other in alternatives)
        named = " and ".join(others_mm)
        doubt = (
            f"Depth may be wrong by whole periods of the dots: {mm:.1f} mm explains the measurements no better than "
            f"{named}, within the noise and the misfit; use dots of a longer period, or give the range of depths."
        )
    local = float(np.hypot(error, _RESOLUTION * pixel)) * mm**2
    error_mm = float(np.hypot(local, max((abs(other.mm - mm) for other in alternatives), default=0.0)))
    return Depth(mm, error_mm, doubt, range_mm, alternatives, at_end)


# ---- The search for a depth of each projector pixel ------------------------------------------------------------------

_ROUNDS, _BESIDE, _STEP_POOLED = 6, 5, 3.0
_FIRST_LENGTH, _SHORTEST = 0.3, 0.1
"""Parts of the step, which is too long because pixels that are lit together share light."""
_RELIABLE = 0.5
SPARE = 2.0
_MEDIAN = 5


@single_threaded_blas()
def depth_map(
    shots: Capture,
    factors: Factors,
    lam: float | Literal["auto"] = "auto",
    depth_range: tuple[float, float] | None = None,
) -> DepthMap:
    """Return the depth of each projector pixel under shifting dots, and the image with all of them in focus.

    Raises MitsimError for other patterns, and without parallax.
    """
    # Dots of any period determine the depth of a flat scene, however far from the calibrated one.
    ends, inverse = shifts_searched(factors, depth_range), 1 / parallax_of(factors).depth_mm
    range_mm, centre = (1 / (inverse + ends[1]), 1 / (inverse + ends[0])), (ends[0] + ends[1]) / 2
    plane = best_depth(shots, factors, range_mm)
    # Any of several depths will do for a start, but the end of a range is the depth of nothing.
    start = centre if plane.at_end else 1 / plane.mm - inverse
    arrivals = Arrivals(shots, factors, ends, max(abs(start), abs(centre)))
    basis, width, pixel = arrivals.basis, arrivals.width, arrivals.pixel
    pixels = PixelDepths(basis, arrivals.reach, _STEP * pixel)

    # The lambda that finds the light best at the middle is that of the other offsets.
    tried = {(lam, centre / pixel): pixels.solve(arrivals.most(lam, centre / pixel)[0]).left_over for lam in _LAMBDAS}
    if arrivals.limited:
        sharpest = min(tried, key=lambda begin: tried[begin])[0]
        offsets = {begin / pixel + offset for begin in (centre, start) for offset in (0.0, *_OFFSETS)}
        more = sorted({(sharpest, offset) for offset in offsets} - tried.keys())
        tried |= {begin: pixels.solve(arrivals.most(*begin)[0]).left_over for begin in more}
    best = min(tried, key=lambda begin: tried[begin])
    rivals = [other for other, left in tried.items() if left < 2.0 * tried[best]]
    shift, confidence = arrivals.most(*best)
    shift, found = _improve(pixels, shift, (best[1] * pixel - width / 2, best[1] * pixel + width / 2), pixel)
    # The depths are doubted where they explain no more than the calibrated one, or where others explain as much.
    reliable, doubt = confidence >= _RELIABLE, ""
    variance, unknowns = pixels.variance(found), 2 * shift.size
    less = found.left_over - pixels.solve(np.zeros(shift.shape)).left_over
    # Of a sheet at the calibrated depth either may leave more.
    if not reliable.any() or less > chance_difference(less, variance, unknowns):
        doubt = "Depths by pixel explain the measurements no better than the calibrated depth, which the image uses."
    else:
        span = float(np.ptp(np.percentile(shift[reliable], (1, 99))))
        away = (np.abs(arrivals.most(*rival)[0] - shift)[reliable] > width / 2 for rival in rivals)
        spared = not arrivals.limited or width - span >= SPARE * pixel
        ties = [(other.mm, other.difference**2 * basis.energy) for other in plane.alternatives]
        others = [f"{mm:.1f}" for mm, more in ties if more < chance_difference(more, variance, unknowns)]
        if max(float(each.mean()) for each in away) > 0.05 or not spared:
            period = width / pixel
            why = f"Depths a period of the dots away, {period:.0f} projector pixels, explain nearly as much"
            if not spared:
                why = f"Parallax seems to span {span / pixel:.1f} of the {period:.0f} pixels of a period"
            doubt = (
                f"{why}: depths may be off by a whole period, so the image is that of the calibrated one. Use dots of "
                f"a period of {2 * period:.0f} along the baseline, and of a short one across it."
            )
        elif others:
            doubt = (
                f"Depths may be off by a whole period of the dots: {plane.mm:.1f} or {' or '.join(others)} mm "
                "explain a flat scene as well, so the image is that of the calibrated one. Use dots of a longer period "
                "along the baseline, or give the range of depths."
            )
    if doubt:
        shift, confidence = np.zeros(shift.shape), np.zeros(shift.shape)
        found = pixels.solve(shift)
    if lam == "auto":
        power = max(float(np.square(found.image).mean()), np.finfo(float).tiny)
        solved = pixels.solve(shift, min(pixels.variance(found) / power, 0.01 * pixels.scale))
    else:
        solved = pixels.solve(shift, lam)
    sizes, smoothing = (basis.energy, basis.data, basis.part), basis.smoothing(float(np.median(shift)))
    mm = 1 / (inverse + shift)
    return DepthMap(solved.image, mm, confidence, solved.lam, solved.left_over, *sizes, doubt, range_mm, smoothing)


def _improve(
    pixels: PixelDepths, shift: FloatArray, limits: tuple[float, float], pixel: float
) -> tuple[FloatArray, Solved]:
    solved, length, apart = pixels.solve(shift), _FIRST_LENGTH, pixel / 4
    for _ in range(_ROUNDS):
        ahead, behind = pixels.gains(shift, solved.image, [shift + apart, shift - apart])
        slope, curvature = (gaussian_filter(each, _STEP_POOLED) for each in (ahead - behind, -ahead - behind))
        change = apart / 2 * slope / np.maximum(curvature, np.abs(slope) / 8 + np.finfo(float).tiny)
        while length > _SHORTEST:
            there = median_filter(np.clip(shift + length * change, *limits), _MEDIAN)
            now = pixels.solve(there)
            if now.left_over < solved.left_over:
                shift, solved = there, now
                break
            length /= 2
    for _ in range(_ROUNDS):
        others = [of(shift, _BESIDE) for of in (minimum_filter, maximum_filter, median_filter)]
        gains = pixels.gains(shift, solved.image, others)
        sure = gains.max(axis=0) > 25.0 * pixels.variance(solved)
        there = np.where(sure, np.choose(gains.argmax(axis=0), others), shift)
        now = pixels.solve(there)
        if now.left_over >= solved.left_over:
            break
        shift, solved = there, now
    return shift, solved


# -------- The image at a depth for each pixel

_MOST_LIT = 4096
_CUBIC = np.array([[0, -2, 3, -1], [6, -3, -6, 3], [0, 6, 3, -3], [0, -1, 0, 1]]) / 6


class Solved(NamedTuple):
    image: FloatArray
    lam: float
    left_over: float


class PixelDepths:
    def __init__(self, basis: CommonBasis, limit: float, step: float) -> None:
        self._basis = basis
        self._shifts = np.linspace(-limit, limit, max(2 * int(np.ceil(limit / step)) + 1, len(_CUBIC)))
        self._tables = [np.stack([basis.side(axis, shift).T for shift in self._shifts], axis=1) for axis in (0, 1)]
        self._lit = [[np.flatnonzero(column) for column in patterns.T] for patterns in basis.patterns]
        most = max(len(row) for row in self._lit[0]) * max(len(column) for column in self._lit[1])
        if most > _MOST_LIT:
            words = f"{most} pixels are lit at a time, and at most {_MOST_LIT} can be separated"
            raise MitsimError(f"focus map: {words}; use dots further apart")
        middle = len(self._shifts) // 2
        left, right = (float(np.square(table[:, middle]).sum(axis=1).mean()) for table in self._tables)
        self.scale = left * right

    def solve(self, shift: FloatArray, lam: float | None = None) -> Solved:
        lam = 0.001 * self.scale if lam is None else lam
        image, left_over = np.zeros(shift.shape), self._basis.outside
        for frame, lit, left, right in self._columns_of_frames(shift):
            normal, data = (left @ left.T) * (right @ right.T), ((left @ frame) * right).sum(axis=1)
            found = np.linalg.solve(normal + lam * np.eye(len(data)), data)
            image[lit] = found
            left_over += float(np.square(frame).sum() + found @ (normal @ found - 2 * data))
        return Solved(image, lam, left_over)

    def variance(self, solved: Solved) -> float:
        return float(solved.left_over / max(self._basis.data - 2 * solved.image.size, 1))

    def gains(self, shift: FloatArray, image: FloatArray, others: Sequence[FloatArray]) -> FloatArray:
        """Return the energy (others, n, n') that each pixel alone explains more at other changes of 1/z."""
        explained = np.zeros((1 + len(others), *shift.shape))
        for frame, lit, left, right in self._columns_of_frames(shift):
            rest = frame - (left * image[lit][:, None]).T @ right
            for own, other in zip(explained, (shift, *others), strict=True):
                u, v = (self.columns(axis, place, other[lit]) for axis, place in enumerate(lit))
                light = image[lit] * (left * u).sum(axis=1) * (right * v).sum(axis=1)
                size = np.square(u).sum(axis=1) * np.square(v).sum(axis=1)
                own[lit] = np.square(((u @ rest) * v).sum(axis=1) + light) / size
        return np.asarray(explained[1:] - explained[0])

    def _columns_of_frames(
        self, shift: FloatArray
    ) -> Iterator[tuple[FloatArray, tuple[npt.NDArray[np.intp], ...], FloatArray, FloatArray]]:
        for each in self._basis.frames:
            grid = np.meshgrid(self._lit[0][each.row], self._lit[1][each.column], indexing="ij")
            lit = tuple(place.ravel() for place in grid)
            left, right = (self.columns(axis, place, shift[lit]) for axis, place in enumerate(lit))
            yield each.frame, lit, left, right

    def columns(self, axis: int, pixels: npt.NDArray[np.intp], shift: FloatArray) -> FloatArray:
        place = (shift - self._shifts[0]) / (self._shifts[1] - self._shifts[0])
        start = np.clip(np.floor(place).astype(np.intp), 1, len(self._shifts) - 3)
        weights = _CUBIC @ (place - start) ** np.arange(4)[:, None]
        table = self._tables[axis]
        return np.asarray(sum(weight[:, None] * table[pixels, start + k - 1] for k, weight in enumerate(weights)))


# ---- Where most light of each projector pixel arrives ----------------------------------------------------------------

_LAMBDAS = 1e-5, 1e-6, 1e-7
"""Lambdas over the largest sigma^2 where light arrives: smaller ones add noise, larger ones blur dots."""
_OFFSETS = -1.0, -0.5, 0.5, 1.0
_POOLED = 1.0


class Arrivals:
    """Places where light arrives, by pixel and change of 1/z [1/mm] between two ``ends``."""

    def __init__(self, shots: Capture, factors: Factors, ends: tuple[float, float], beside: float) -> None:
        if not all(map(are_dots, shots.patterns)):
            raise MitsimError("focus map: needs shifting dots, such as dots:7x16, whose displacement depends on depth")
        moves, span = _moves(factors), ends[1] - ends[0]
        self._open = [bool(move * span > 0.5) for move in moves]
        if not any(self._open):
            words = f"camera and projector of calibration {factors.name} have no baseline, so depth moves no light"
            raise MitsimError(f"focus map: {words}; give a depth, or auto")
        self.pixel = 1 / float(moves.max())
        self.width = min(span, _period(np.where(self._open, moves, 0.0), shots.patterns))
        self.limited = self.width < span
        self.reach = beside + self.width / 2 + (max(_OFFSETS) + 2) * self.pixel
        self.basis = basis = CommonBasis(shots, factors, (-self.reach, self.reach))
        self._margin = int(np.ceil(self.reach / self.pixel)) + 1
        # Along the baseline each dot's frames have an image of their own, of all pixels as if they were lit.
        self._classes, sides, lit, counts = list[FloatArray](), list[FloatArray](), list[FloatArray](), list[int]()
        for axis, (own, opened) in enumerate(zip(basis.patterns, self._open, strict=True)):
            self._classes.append(own.argmax(axis=1) if opened else np.zeros(len(own)))
            sides.append(basis.side(axis, 0.0, self._margin if opened else 0))
            lit.append(np.ones((sides[-1].shape[1], 1)) if opened else own)
            counts.append(own.shape[1] if opened else 1)
        prepared = prepare(sides[0], sides[1], lit[0], lit[1])
        sums = {key: prepared.accumulator() for key in np.ndindex(*counts)}
        for each in basis.frames:
            (row, column), (down, across) = (each.row, each.column), self._open
            of_class = sums[row if down else 0, column if across else 0]
            of_class.add(each.frame, 0 if down else row, 0 if across else column)
        scales, self._images = [prepared.problem(each).scale for each in sums.values()], dict[float, FloatArray]()
        for lam in _LAMBDAS:
            images = [prepared.solve(*each).image for each in zip(sums.values(), lam * np.array(scales), strict=True)]
            self._images[lam] = np.stack(images).reshape(*counts, *images[0].shape)

    def most(self, lam: float, offset: float) -> tuple[FloatArray, FloatArray]:
        """Return the change of 1/z (n, n') at which most light arrives, and its confidence (n, n')."""
        count = 2 * int(np.ceil(self.width / self.pixel / _STEP / 2)) + 1
        shifts = np.linspace(-self.width / 2, self.width / 2, count) + offset * self.pixel
        light = np.zeros((count, *self.basis.shape))
        for shift, arriving in zip(shifts, light, strict=True):
            (rows, columns) = (
                np.arange(classes.size) + (side.edges * shift + self._margin if opened else 0.0)
                for side, classes, opened in zip(self.basis.sides, self._classes, self._open, strict=True)
            )
            places = np.broadcast_arrays(self._classes[0][:, None], self._classes[1], rows[:, None], columns)
            map_coordinates(self._images[lam], np.stack(places), arriving, order=1, mode="nearest")
        light = np.maximum(gaussian_filter(light, (0, _POOLED, _POOLED)), 0.0)
        place, step, peak = light.argmax(axis=0), shifts[1] - shifts[0], light.max(axis=0)
        beside = np.arange(count)[:, None, None] - place
        near = np.abs(beside) <= round(2.0 * self.pixel / step)
        own, other = np.where(near, light, 0.0), np.where(near, 0.0, light).max(axis=0)
        dark = peak <= np.finfo(float).tiny
        centroid = (own * beside).sum(axis=0) / np.where(dark, 1.0, own.sum(axis=0))
        found = median_filter(shifts[place] + step * centroid, _MEDIAN)
        elsewhere = np.maximum(other, np.median(other))  # of a dark pixel alone it would be small by chance
        return found, np.where(dark, 0.0, np.maximum(1 - elsewhere / np.where(dark, 1.0, peak), 0.0))
