"""Factors of a calibrated depth in; out come those of another depth, and the part of the sensor where they are known.

A scene point at tan-angle tau and depth z shades the sensor point u at mask coordinate s = u (1 - d/z) + d tau, and
projector pixel i lights it at tau = A_i + B_i / z, B_i being the baseline. So the factor of depth z is the calibrated
one with its columns moved: sensor pixel u sees pixel i where it saw tau_i + (B_i - u)(1/z - 1/z_0) at the board.
Columns change slowly (a mask feature is some ten pixels wide), so values between them are interpolated. Beyond the
window no column was calibrated; but sensor pixels further on saw the same part of the mask in a column within, at u + v
and tau - v (1/d - 1/z_0), for any v. Only at the sensor's own edge there is nothing left to see, and these few rows are
left out, of frames and factors alike.

What moves is the shadow, not the light: an image is light relative to the board's, pixel by pixel, so each pixel keeps
the brightness that it had at z_0, while values are taken from columns that fall off more or less than its own. Sensor
pixels that see one part of the mask in two columns tell how much.

*Between columns.* Sensor row u + k sees in column i what row u sees at i + k s, s being the columns that one sensor
pixel's step makes up for: the mask's shadow hangs on one coordinate. So each row has the numbers of its neighbours too,
at places between its own, and a cubic spline with knots finer than columns is fitted to all of them: where a projector
pixel is wide, a polynomial through columns alone misses the edges of the mask's features.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
import numpy.typing as npt
from scipy.linalg import solveh_banded

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.manifests import Parallax
from mitsim.core.runs import Ambient, Capture, Measurement
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.request import check_parallax

STEP = 0.5
"""Projector pixels of parallax between displacements that are looked at; a dot's image is some two wide."""
_NEIGHBOURS = 4
"""Columns that a cubic takes: of 2 to 8 it leaves least (a sheet at 360 mm, 128 pixels: 3.1e-3, 2.1e-3, 2.1e-3, 2.1e-3
of the measurements); more neighbours add noise."""
_DEGREE = 4
"""Of the polynomial that brightness over columns is: cos^4 of 8.5 degrees is a parabola to 1e-4."""
_PAIRS = 32
"""Distances along the sensor, at most twice as many, at which columns of the same shadow are compared."""
_HIDDEN = 0.5
"""Part of a pixel's light from which it counts as hidden: chosen, as more of it is then missing than seen."""
LEAST_PART = 0.5
"""Part of the sensor's rows that must remain: chosen, as fewer would be another camera."""


# ---- Factors moved to another depth ----


@dataclass(frozen=True, eq=False)
class MovedFactors:
    """``factors`` of a depth, on the sensor's ``rows`` and ``columns`` where these are known; ``sensor`` is the whole's
    shape, and ``hidden`` the part of the scene's pixels that the field stop takes most of the light of."""

    factors: Factors
    rows: slice
    columns: slice
    sensor: tuple[int, int]
    hidden: float = 0.0

    def of(self, shots: Capture) -> Capture:
        """What that part of the sensor saw of ``shots``."""
        return _Part(shots, self)


def move_factors(factors: Factors, depth_mm: float) -> MovedFactors:
    """The factors of a surface at ``depth_mm`` from the sensor, from calibrated ``factors``.

    ArgumentError for a depth where too little of them is known, MitsimError for a calibration that does not state its
    parallax.
    """
    parallax = parallax_of(factors)
    if not (np.isfinite(depth_mm) and depth_mm > parallax.mask_distance_mm):
        raise ArgumentError(
            "focus", f"{depth_mm:g}: give a depth above {parallax.mask_distance_mm:g} mm, where the mask is"
        )
    shift = 1 / depth_mm - 1 / parallax.depth_mm
    if shift == 0:
        # The calibration's own, to the last bit.
        shape = len(factors.left), len(factors.right)
        return MovedFactors(replace(factors, lacking=()), slice(0, shape[0]), slice(0, shape[1]), shape)
    sides = [FactorOfDepths(side, parallax, axis) for axis, side in enumerate((factors.left, factors.right))]
    (left, rows), (right, columns) = (side.at(shift) for side in sides)
    for known, size in ((rows, len(factors.left)), (columns, len(factors.right))):
        if known.stop - known.start < LEAST_PART * size:
            raise ArgumentError(
                "focus",
                f"{depth_mm:g}: {max(known.stop - known.start, 0)} of {size} sensor rows or columns know the shadow "
                f"there; give a depth nearer to the calibrated {parallax.depth_mm:g} mm, or calibrate at that depth",
            )
    manifest, noise = factors.manifest, factors.manifest.noise
    if noise:
        less = {
            name: getattr(noise, name) * side.noise(shift) for name, side in zip(("left", "right"), sides, strict=True)
        }
        manifest = manifest.model_copy(update={"noise": noise.model_copy(update=less)})
    moved = replace(factors, left=left[rows], right=right[columns], manifest=manifest, lacking=())
    seen = [float((side.hidden_part(shift) < _HIDDEN).mean()) for side in sides]
    return MovedFactors(moved, rows, columns, (len(factors.left), len(factors.right)), 1 - seen[0] * seen[1])


def parallax_of(factors: Factors) -> Parallax:
    """How ``factors`` move with depth; MitsimError where their calibration does not state it."""
    parallax = check_parallax(factors.manifest.parallax, factors.name)
    if min(factors.left.shape[1], factors.right.shape[1]) < _NEIGHBOURS:
        raise MitsimError(
            f"focus: calibration {factors.name} has {factors.left.shape[1]} x {factors.right.shape[1]} projector "
            f"pixels; columns of other depths need at least {_NEIGHBOURS} a side"
        )
    return parallax


def pixels_of_parallax(parallax: Parallax, axis: int, count: int) -> tuple[float, float, float]:
    """Projector pixels that a change of 1/z by 1/mm moves, at the window's first and at its last edge; and what one mm
    along the sensor takes off.

    Parameters
    ----------
    parallax
        of the calibration.
    axis
        0 for rows, 1 for columns.
    count
        n, projector pixels along it.
    """
    window, edges = (parallax.row_tan, parallax.row_mm) if axis == 0 else (parallax.column_tan, parallax.column_mm)
    pixel = (window[1] - window[0]) / count
    return edges[0] / pixel, edges[1] / pixel, 1 / pixel


# ---- One factor at any depth ----


@dataclass(frozen=True, eq=False)
class FactorOfDepths:
    """A calibrated ``factor`` (m, n), the left one (``axis`` 0) or the right one (1), and how it moves with depth."""

    factor: FloatArray
    parallax: Parallax
    axis: int

    def at(self, shift: float | FloatArray) -> tuple[FloatArray, slice]:
        """The columns of another depth, and the sensor rows where all of them are known.

        Parameters
        ----------
        shift
            1/z - 1/z_0 [1/mm] of all scene pixels, or (n,) of each.
        """
        column = self._source_columns(shift)
        row, within, known = self._sources(column)
        shadows = self._shadow.at(row, within) * self._own_brightness
        passed = self._transmission(column)
        mean = passed.mean(axis=0)
        # The image stays light relative to the board's, as the sensor as a whole sees it.
        return shadows * np.divide(passed, mean, out=np.zeros_like(passed), where=mean > 0), _whole(known)

    def hidden_part(self, shift: float) -> FloatArray:
        """(n,) part of each column's light that the field stop keeps from the sensor at another depth: 1/z changed by
        ``shift`` [1/mm]; 0 where the calibration states no stop, or its own window was cut."""
        return np.asarray(1 - self._transmission(self._source_columns(shift)).mean(axis=0))

    def noise(self, shift: float) -> float:
        """Standard deviation of noise in columns at 1/z changed by ``shift`` [1/mm], over that of the calibrated ones:
        less, as each number is fitted to many."""
        white = np.random.default_rng(0).standard_normal(self.factor.shape)
        row, within, _ = self._sources(self._source_columns(shift))
        return float(np.sqrt(np.mean(np.square(ColumnSpline(white, self._step).at(row, within)))))

    def _source_columns(self, shift: float | FloatArray) -> FloatArray:
        """(m, n) column that each sensor row saw at the calibrated depth where it now sees each scene pixel."""
        return np.arange(self.factor.shape[1]) + (self.edges - self._parallax_pixels[2] * self._place[:, None]) * shift

    def _transmission(self, column: FloatArray) -> FloatArray:
        """(m, k) part of the light from each ``column`` (m, k) that the field stop lets through."""
        stop = self.parallax.stop_tan
        if stop is None:
            return np.ones_like(column)
        pixel = 1 / self._parallax_pixels[2]
        first = (self.parallax.row_tan if self.axis == 0 else self.parallax.column_tan)[0]
        ends = first + (np.array([0.5, self.factor.shape[1] - 0.5])) * pixel
        from_edge = np.abs(self._place).max() / self.parallax.depth_mm
        if np.abs(ends).max() + from_edge + pixel / 2 > stop:
            return np.ones_like(column)  # the calibrated columns are cut themselves, nobody knows how far
        tangent = first + (column + 0.5) * pixel - self._place[:, None] / self.parallax.depth_mm
        return np.clip((stop - np.abs(tangent)) / pixel + 0.5, 0.0, 1.0)

    # ---- Columns beside the window, and shadows between columns ----

    def beyond(self, margin: int) -> tuple[FloatArray, slice]:
        """(m, ``margin`` + n + ``margin``) columns at the calibrated depth, with those beside the window, which no
        projector pixel lights; what there is to see beyond the sensor's edge is taken from the last pixel. And the
        sensor rows where that is nothing."""
        rows, count = self.factor.shape
        column = np.arange(-margin, count + margin)
        row, within, known = self._sources(np.broadcast_to(column, (rows, column.size)))
        shadows = self._shadow.at(row, within) * self.brightness(column)
        shadows[:, margin : margin + count] = self.factor
        return shadows, _whole(known)

    def _sources(
        self, column: npt.NDArray[np.floating | np.integer]
    ) -> tuple[npt.NDArray[np.intp], FloatArray, npt.NDArray[np.bool_]]:
        """Rows and columns of the factor that saw the shadow of places between columns (m, k), and whether any did."""
        rows, count = self.factor.shape
        # Columns that one sensor pixel's step along the sensor makes up for.
        step = self._step
        within, row = np.array(column, dtype=np.float64), np.repeat(np.arange(rows)[:, None], column.shape[1], axis=1)
        known = np.ones(within.shape, dtype=np.bool_)
        outside = (within < 0) | (within > count - 1)
        away, own = within[outside], row[outside]
        steps = np.where(away < 0, -np.ceil((1 - away) / step), np.ceil((away - count + 2) / step)).astype(np.intp)
        away, own = away - steps * step, own + steps
        known[outside] = (own >= 0) & (own < rows) & (away >= 0) & (away <= count - 1)
        within[outside], row[outside] = np.clip(away, 0.0, count - 1.0), np.clip(own, 0, rows - 1)
        return row, within, known

    @cached_property
    def _shadow(self) -> ColumnSpline:
        return ColumnSpline(self.factor / self._own_brightness, self._step)

    # ---- Brightness of projector pixels ----

    @cached_property
    def _own_brightness(self) -> FloatArray:
        """(n,) of the calibrated columns."""
        return self.brightness(np.arange(self.factor.shape[1]))

    @property
    def edges(self) -> FloatArray:
        """(n,) projector pixels that a change of 1/z by 1/mm moves the light of each."""
        first, last, _ = self._parallax_pixels
        return np.asarray(np.linspace(first, last, 2 * self.factor.shape[1] + 1)[1::2])

    @property
    def reach(self) -> float:
        """Projector pixels that a change of 1/z by 1/mm moves what some sensor pixel sees."""
        first, last, by_place = self._parallax_pixels
        return float(max(abs(first), abs(last), by_place * len(self.factor) * self._pitch / 2))

    def brightness(self, column: npt.NDArray[np.floating | np.integer]) -> FloatArray:
        """How bright places at each ``column`` and between are, the mask's shadow apart; 1 in the window's middle."""
        return np.asarray(np.exp(np.polynomial.polynomial.polyval(self._across(column), self._falloff)))

    def _across(self, column: npt.NDArray[np.floating | np.integer]) -> FloatArray:
        """Places from the window's middle, its edges being 1 away."""
        middle = (self.factor.shape[1] - 1) / 2
        return np.asarray((column - middle) / middle)

    @cached_property
    def _falloff(self) -> FloatArray:
        """(degrees + 1,) coefficients of the polynomial that the logarithm of brightness is; that of degree 0 is 0."""
        rows, count = self.factor.shape
        unlike, changes = [np.zeros(1)], [np.zeros((1, _DEGREE + 1))]
        apart = np.arange(1, rows // 2, max(1, rows // _PAIRS))
        for offset in (*apart, *-apart):
            column = np.arange(count) - offset * self._step
            to = np.flatnonzero((column >= 0) & (column <= count - 1))
            row = np.arange(max(0, -offset), min(rows, rows - offset))[:, None]
            own, same = self.factor[row, to], _cubic(self.factor, row + offset, column[to])
            weight = np.sqrt(np.maximum((own + same).sum(axis=0) / 2, 0.0))
            difference = (own - same).sum(axis=0)
            unlike.append(np.divide(difference, weight, out=np.zeros(to.size), where=weight > 0))
            powers = [np.polynomial.polynomial.polyvander(self._across(place), _DEGREE) for place in (to, column[to])]
            changes.append(weight[:, None] * (powers[0] - powers[1]))
        return np.asarray(np.linalg.lstsq(np.concatenate(changes), np.concatenate(unlike), rcond=None)[0])

    # ---- Parallax, and places on the sensor ----

    @property
    def _parallax_pixels(self) -> tuple[float, float, float]:
        return pixels_of_parallax(self.parallax, self.axis, self.factor.shape[1])

    @property
    def _step(self) -> float:
        """Columns that one pixel's step along the sensor sees the mask's shadow move."""
        parallax = self.parallax
        inverse = 1 / parallax.mask_distance_mm - 1 / parallax.depth_mm
        return self._pitch * inverse * self._parallax_pixels[2]

    @cached_property
    def _place(self) -> FloatArray:
        """(m,) place of each sensor row, from their middle [mm]."""
        rows = len(self.factor)
        return np.asarray((np.arange(rows) - (rows - 1) / 2) * self._pitch)

    @property
    def _pitch(self) -> float:
        return self.parallax.pitch_mm(self.axis)


# ---- Interpolation between columns ----


def _whole(known: npt.NDArray[np.bool_]) -> slice:
    """Rows of which all numbers are ``known``."""
    inside = np.flatnonzero(known.all(axis=1))
    return slice(int(inside[0]), int(inside[-1]) + 1) if inside.size else slice(0, 0)


def _cubic(factor: FloatArray, row: npt.NDArray[np.intp], column: FloatArray) -> FloatArray:
    """Lagrange's cubic through the four columns around each ``column`` of each ``row``, exact at whole numbers."""
    start = np.clip(np.floor(column).astype(np.intp) - 1, 0, factor.shape[1] - _NEIGHBOURS)
    t = column - start
    weights = (
        -(t - 1) * (t - 2) * (t - 3) / 6,
        t * (t - 2) * (t - 3) / 2,
        -t * (t - 1) * (t - 3) / 2,
        t * (t - 1) * (t - 2) / 6,
    )
    return np.asarray(sum(weight * factor[row, start + k] for k, weight in enumerate(weights)))


# ---- Captures of which something is changed ----


class DerivedCapture(Capture):
    """A ``whole`` capture of which something is changed; all else is its own."""

    def __init__(self, whole: Capture) -> None:
        super().__init__(whole.manifest, whole.folder)
        self.whole = whole

    @cached_property
    def patterns(self) -> tuple[FloatArray, FloatArray]:
        """P_L (n, K) and P_R (n', K')."""
        return self.whole.patterns

    @cached_property
    def ambient(self) -> Ambient | None:
        """What is taken off every frame."""
        return self.whole.ambient

    def pattern_measurements(self, shape: tuple[int, int] | None = None) -> Iterator[Measurement]:
        """What was measured, of a ``shape`` that is asked for."""
        return self.whole.pattern_measurements(shape)


class _Part(DerivedCapture):
    """What a part of the sensor saw of a capture."""

    def __init__(self, whole: Capture, part: MovedFactors) -> None:
        super().__init__(whole)
        self._part = part

    def pattern_measurements(self, shape: tuple[int, int] | None = None) -> Iterator[Measurement]:
        """As of the whole sensor, whose frames must have the shape that the calibration's have."""
        for each in self.whole.pattern_measurements(self._part.sensor):
            yield replace(each, frame=self._cut(each.frame), light=self._cut(each.light))

    @cached_property
    def ambient(self) -> Ambient | None:
        """The ambient frame of that part."""
        whole = self.whole.ambient
        return whole and Ambient(self._cut(whole.rate), self._cut(whole.variance), whole.shots)

    def _cut(self, values: FloatArray) -> FloatArray:
        return values[self._part.rows, self._part.columns]


# ---- Dots whose light parallax moves onto another dot's place ----


def parallax_period(patterns: tuple[FloatArray, FloatArray], parallax: Parallax) -> float:
    """Change of 1/z [1/mm] that moves the light of dots onto the place of others; inf for other patterns, and where
    depth moves no light.

    Parameters
    ----------
    patterns
        P_L (n, K) and P_R (n', K').
    parallax
        of the calibration.
    """
    ends = [pixels_of_parallax(parallax, axis, len(lit))[:2] for axis, lit in enumerate(patterns)]
    moves = np.array([max(map(abs, each)) for each in ends])
    if not (moves.any() and all(are_dots(lit) for lit in patterns)):
        return np.inf
    pixel = 1 / moves.max()
    return float(unambiguous_parallax(moves * pixel, [lit.shape[1] for lit in patterns]) * pixel)


def are_dots(patterns: FloatArray) -> bool:
    """Whether each pixel is lit by one of the (n, K) ``patterns``, as dots light it."""
    values = np.sort(patterns, axis=1)
    return not values[:, :-1].any() and bool((values[:, -1] == 1).all())


def unambiguous_parallax(moves: FloatArray, periods: list[int]) -> float:
    """Projector pixels of parallax by which light moves onto the place of another dot's of the same frame.

    Parameters
    ----------
    moves
        projector pixels along both axes for one of parallax; 0 of an axis that has none.
    periods
        of the dots.
    """
    for parallax in np.arange(1.0, np.prod(periods) + 1, STEP / 4):
        turns = moves * parallax / periods
        if np.round(turns).any() and (np.abs(turns - np.round(turns)) * periods < STEP / 2).all():
            return float(np.ceil(parallax))
    return np.inf


# ---- A factor as a smooth function of the place between its columns --------------------------------------------------


_SPLINE_ROWS = 5
"""Sensor rows to either side whose numbers a row is given: of 2, 3 and 5 the most leave least, 1.9e-3, 1.7e-3, 1.5e-3
of columns of 15 um with noise of 2e-3 (a polynomial through their own row: 2.8e-2); more are another shadow behind
masks with thickness."""
_SPLINE_KNOTS = 4
"""Knots a column: with 2, columns of 15 um are off by 2.5e-3 with noise of 2e-3 instead of 1.5e-3."""
_STIFFNESS = 1e-2
"""Weight of the squared third differences of neighbouring coefficients over that of a number's error: with 1e-3 noise
of 2e-3 leaves 1.7e-3 instead of 1.5e-3, without noise 1.0e-3 instead of 1.2e-3."""
_THIRD = np.array([-1.0, 3.0, -3.0, 1.0])
"""Third difference of four neighbours."""


class ColumnSpline:
    """A ``factor`` (m, n) at any place between its columns.

    Parameters
    ----------
    factor
        free of what changes from column to column but the shadow.
    step
        columns by which the next sensor row sees the shadow moved.
    """

    def __init__(self, factor: FloatArray, step: float) -> None:
        rows, count = factor.shape
        self._last, self._step = (count - 1) * _SPLINE_KNOTS, step
        reach = min(_SPLINE_ROWS, (rows - 1) // 2)
        self._coefficients = np.empty((rows, self._last + 3))
        inner, edges = np.arange(reach, rows - reach), np.array([*range(reach), *range(rows - reach, rows)], dtype=int)
        self._coefficients[inner] = self._fit(factor, inner, np.arange(-reach, reach + 1))
        nearest = np.clip(edges - reach, 0, rows - 2 * reach - 1)[:, None] + np.arange(2 * reach + 1)
        self._coefficients[edges] = self._fit_each(factor[nearest], nearest - edges[:, None])

    def at(self, row: npt.NDArray[np.intp], column: FloatArray) -> FloatArray:
        """Numbers of each ``row`` at each ``column``, from 0 to n - 1, whole or not; the two broadcast."""
        start, weights = self._weights(column * _SPLINE_KNOTS)
        first, numbers = row * self._coefficients.shape[1] + start, self._coefficients.ravel()
        return np.asarray(sum(weight * numbers.take(first + k) for k, weight in enumerate(weights)))

    def _fit(self, factor: FloatArray, rows: npt.NDArray[np.intp], neighbours: npt.NDArray[np.intp]) -> FloatArray:
        """(len(``rows``), coefficients) of the spline of each row, from its ``neighbours``' numbers."""
        normal, start, weights = self._normal(neighbours[None])
        data = np.zeros((self._last + 3, len(rows)))
        for k, first, parts in zip(neighbours, start[0], np.moveaxis(weights[:, 0], 1, 0), strict=True):
            seen = factor[rows + k].T
            for a, part in enumerate(parts):
                # Columns are whole knots apart, so no place is named twice but by those without weight.
                inside = part != 0
                data[first[inside] + a] += part[inside, None] * seen[inside]
        return np.asarray(solveh_banded(normal[0], data, lower=True).T)

    def _fit_each(self, seen: FloatArray, neighbours: npt.NDArray[np.intp]) -> FloatArray:
        """(rows, coefficients) of the spline of each row, from what is ``seen`` (rows, k, n) in the ``neighbours``
        (rows, k) of its own."""
        normal, start, weights = self._normal(neighbours)
        data = np.sum([self._collect(start + a, weight * seen) for a, weight in enumerate(weights)], axis=0)
        found = [solveh_banded(*each, lower=True) for each in zip(normal, data, strict=True)]
        return np.array(found).reshape(len(seen), self._last + 3)

    def _normal(self, neighbours: npt.NDArray[np.intp]) -> tuple[FloatArray, npt.NDArray[np.intp], FloatArray]:
        """Of fits to rows that are ``neighbours`` (fits, k): normal matrices (fits, 4, coefficients) by diagonal, first
        coefficient (fits, k, n) and weights (4, fits, k, n) of each number, 0 beyond the last knot."""
        place = (np.arange(self._last // _SPLINE_KNOTS + 1) + neighbours[..., None] * self._step) * _SPLINE_KNOTS
        start, parts = self._weights(place)
        weights = np.where((place >= 0) & (place <= self._last), parts, 0.0)
        normal = np.zeros((len(neighbours), 4, self._last + 3))
        for a, b in product(range(4), repeat=2):
            if b >= a:
                normal[:, b - a] += self._collect(start + a, weights[a] * weights[b])
                normal[:, b - a, a : self._last + a] += _STIFFNESS * _THIRD[a] * _THIRD[b]
        return normal, start, weights

    def _collect(self, place: npt.NDArray[np.intp], values: FloatArray) -> FloatArray:
        """(fits, coefficients) sums of the ``values`` (fits, k, n) at each ``place`` (fits, k, n)."""
        fits, size = len(place), self._last + 3
        own = (np.arange(fits) * size)[:, None, None] + place
        return np.asarray(np.bincount(own.ravel(), values.ravel(), fits * size).reshape(fits, size), dtype=np.float64)

    def _weights(self, place: FloatArray) -> tuple[npt.NDArray[np.intp], tuple[FloatArray, ...]]:
        """First of the four coefficients at each ``place`` [knots], and the weights of all four: uniform cubic
        B-splines."""
        start = np.clip(np.floor(place).astype(np.intp), 0, self._last - 1)
        t = place - start
        square = t * t
        last = square * t / 6  # powers of arrays take ten times as long
        first = (1 + 3 * (square - t)) / 6 - last
        third = (1 + 3 * (t + square)) / 6 - 3 * last
        return start, (first, 1 - first - third - last, third, last)
