"""Geometric shadow of a mask: mean transmissions from sensor pixels and directions, as separable terms.

The ray from sensor coordinate u toward tau = x/z, which meets the scene at depth z, crosses the mask plane (distance d)
at s = u (1 - d/z) + d tau. The mean over a pixel and a cell is the profile weighted by a trapezoid. Its integral over
each feature is a difference of a piecewise quadratic function, so that the mean is exact. (A second cumulative sum of
the profile would cancel in float64.)

The entrance face of a thick mask is ``thickness`` further from the sensor. For a point source at (tau z, z), a ray
that
leaves through s entered at::

    s' = s (1 - thickness / (z - d)) + thickness tau / (1 - d/z)

Therefore each direction has its own clear profile M(s) M(s') on the exit face. A cell takes that of its centre.

A mask whose centre is off the axis by o is a centred one seen from its own axis: u - o, and tau - o/z. A mask that is
tilted, at distance d + a s + b, is met by a ray of slope t = tau - u/z at s + t (a s + b) / (1 - a t), times sqrt(1 +
a^2). All coordinates are centred index coordinates in mm.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy

from mitsim.core.arrays import ByValue, FloatArray, SeparableTerm
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask import Mask, Plate

# -------- Piecewise constant transmission of one axis of a mask, and its means over a sensor pixel and a cell
#
# Means over the two boxes follow from the second antiderivative. The mean of the values is subtracted first, so that
# the second difference errs by 1e-11 for values of order 1. A unit step that is blurred by a Gaussian of standard
# deviation sigma is Phi(x / sigma), and its means are differences of these antiderivatives, with phi the normal
# density::
#
#     x Phi + sigma phi    and    ((x^2 + sigma^2) Phi + x sigma phi) / 2

_FEW = 4
"""Edges in the narrower box up to which edges are summed one by one; beyond, a second difference keeps 1e-11."""
_DENSE = 2
_WIDE = 16
"""Product of the half-widths of two boxes, in grid steps, from which cubic interpolation errs by less than 4e-5."""
_BEYOND = 8.3
_POINTLIKE = 1e-4
"""Half-width in standard deviations of the blur below which a box is neglected (error 2e-9)."""
_PER_CELL = 4


@dataclass(frozen=True, eq=False)
class Steps(ByValue):
    """A piecewise constant function: ``values[k]`` from ``edges[k]`` to ``edges[k + 1]`` [mm], 0 outside.

    ``blur_mm`` is the standard deviation of a Gaussian that blurs it.
    """

    edges: FloatArray
    values: FloatArray
    blur_mm: float = 0.0

    @classmethod
    def between(cls, profile: npt.ArrayLike, lines_mm: FloatArray, blur_mm: float = 0.0) -> Steps:
        values = np.asarray(profile, dtype=np.float64)
        starts = np.flatnonzero(np.diff(values, prepend=np.nan))
        return cls(np.append(lines_mm[starts], lines_mm[-1]), values[starts], blur_mm)

    def at(self, s: FloatArray) -> FloatArray:
        """Return the values at points ``s`` [mm]; an edge belongs to the interval that begins there."""
        if self.blur_mm:
            return self.over(s, 0.0)
        padded = np.concatenate(([0.0], self.values, [0.0]))
        return np.asarray(padded[np.searchsorted(self.edges, s, side="right")])

    def seen_through(self, far: Steps, scale: float, shift: float) -> Steps:
        """Return ``self(s) * far(scale * s + shift)``, with scale > 0 and shift in mm."""
        edges = np.unique(np.concatenate((self.edges, (far.edges - shift) / scale)))
        middle = (edges[:-1] + edges[1:]) / 2
        return Steps(edges, self.at(middle) * far.at(scale * middle + shift))

    def cell_means(self, start: float, step: float, count: int) -> FloatArray:
        if self.blur_mm:
            return self.over(np.asarray(start + step * (np.arange(count) + 0.5)), step / 2)
        bounds = start + step * np.arange(count + 1)
        index = np.searchsorted(self.edges, bounds, side="right")
        means = np.concatenate(([0.0], self.values, [0.0]))[index[:-1]]
        # Only cells that an edge cuts are computed from sums, because a difference of large sums loses digits.
        cut = np.flatnonzero(np.diff(index))
        covered = np.concatenate(([0.0], np.cumsum(self.values * np.diff(self.edges))))
        at = np.interp(bounds[[cut, cut + 1]], self.edges, covered)
        means[cut] = (at[1] - at[0]) / step
        return np.asarray(means)

    def amplitude_means(self, start: float, step: float, count: int) -> FloatArray:
        """Return means of the root of the blurred profile, because a blur acts on power."""
        if not self.blur_mm:
            return self.cell_means(start, step, count)
        power = Steps(self.edges, np.square(self.values), self.blur_mm)
        points = np.asarray(start + step / _PER_CELL * (np.arange(count * _PER_CELL) + 0.5))
        return np.asarray(np.sqrt(np.maximum(power.at(points), 0)).reshape(count, _PER_CELL).mean(axis=1))

    def over(self, centres: FloatArray, half: FloatArray | float, other: float = 0.0) -> FloatArray:
        """Return the means over two boxes about ``centres`` [mm], whose half-widths may be 0."""
        reach = half + other + _BEYOND * self.blur_mm
        jumps = np.diff(self.values, prepend=0.0, append=0.0)
        first = np.searchsorted(self.edges, centres - reach, side="right")
        most = int((np.searchsorted(self.edges, centres + reach, side="right") - first).max(initial=0))
        total = np.concatenate(([0.0], self.values, [0.0]))[first]
        for further in range(most):
            edge = np.minimum(first + further, len(jumps))
            beyond = centres - np.append(self.edges, np.inf)[edge]
            total += np.append(jumps, 0.0)[edge] * blurred_step(beyond, half, other, self.blur_mm)
        return np.asarray(total)

    def box_means(self, centres: FloatArray, half_pixel: float, half_cell: float) -> FloatArray:
        if self.blur_mm:
            return self.over(centres, half_pixel, half_cell)
        reach = half_pixel + half_cell
        low, high = centres.min() - reach, centres.max() + reach
        inside = self.edges[(self.edges > low) & (self.edges < high)]
        edges = np.concatenate(([low], inside, [high]))
        values = self.at((edges[:-1] + edges[1:]) / 2)
        return np.asarray(Antiderivative(edges, values[None]).means(centres, half_pixel, half_cell)[0])


def blurred_step(x: FloatArray, half: FloatArray | float, other: float, blur: float) -> FloatArray:
    """Return the mean over boxes of half-widths ``half`` and ``other`` about x of a unit step that a Gaussian blurs.

    Lengths have one unit, x may be -inf, and ``blur`` may be 0 only if there is no second box.
    """
    if other > _POINTLIKE * blur and other > 0:
        ends = (_integral(x + half + other, blur, 2) - _integral(x + half - other, blur, 2)) / (2 * other)
        ends -= (_integral(x - half + other, blur, 2) - _integral(x - half - other, blur, 2)) / (2 * other)
        return np.asarray(ends / (2 * half))
    wide = np.asarray(half) > _POINTLIKE * blur
    width = np.where(wide, half, 1.0)
    means = (_integral(x + width, blur, 1) - _integral(x - width, blur, 1)) / (2 * width)
    point = scipy.special.ndtr(x / blur) if blur else np.asarray(x >= 0, dtype=np.float64)
    return np.asarray(np.where(wide, means, point))


def _integral(x: FloatArray, blur: float, order: int) -> FloatArray:
    """Return the first or second antiderivative of a unit step that a Gaussian blurs."""
    if not blur:
        return np.asarray(np.maximum(x, 0) if order == 1 else np.square(np.maximum(x, 0)) / 2)
    z = np.maximum(x / blur, -2 * _BEYOND)  # both parts are 0 before
    density = np.exp(-np.square(z) / 2) / np.sqrt(2 * np.pi)
    if order == 1:
        return np.asarray(blur * (z * scipy.special.ndtr(z) + density))
    return np.asarray(blur**2 / 2 * ((np.square(z) + 1) * scipy.special.ndtr(z) + z * density))


def _running_sums(parts: FloatArray) -> FloatArray:
    sums = np.zeros((len(parts), parts.shape[1] + 1))
    np.cumsum(parts, axis=1, out=sums[:, 1:])
    return sums


class Antiderivative:
    """First and second antiderivative of piecewise constant functions whose means are subtracted."""

    def __init__(self, edges: FloatArray, values: FloatArray, step: float | None = None) -> None:
        width = np.diff(edges)
        self._edges, self._step = edges, step
        self._mean = (values @ width) / (edges[-1] - edges[0])
        self._values = values - self._mean[:, None]
        self._first = _running_sums(self._values * width)
        # The slope is removed because it cancels in the second difference, where its size would cost digits.
        self._first -= self._first.mean(axis=1, keepdims=True)
        self._second = _running_sums((self._first[:, :-1] + self._first[:, 1:]) * (width / 2))

    @classmethod
    def of_samples(cls, values: FloatArray, start: float, step: float) -> Antiderivative:
        return cls(start + step * np.arange(values.shape[1] + 1), values, step)

    def means(self, centres: FloatArray, half_pixel: float, half_cell: float) -> FloatArray:
        wide, narrow = max(half_pixel, half_cell), min(half_pixel, half_cell)
        total = (self._ends(centres + wide, narrow) - self._ends(centres - wide, narrow)) / (2 * wide)
        return np.asarray(total + self._mean.reshape(-1, *[1] * centres.ndim))

    def smooth_means(self, centres: FloatArray, half_pixel: float, half_cell: float) -> FloatArray:
        step, low = self._step, float(centres.min())
        assert step is not None, "on equal cells"
        count = int((float(centres.max()) - low) / step) + 4
        if centres.size < _DENSE * count or half_pixel * half_cell < _WIDE * step**2:
            return self.means(centres, half_pixel, half_cell)
        nodes = self.means(np.asarray(low + step * (np.arange(count) - 1)), half_pixel, half_cell)
        # Cubic interpolation between four nodes.
        places = (centres - low) / step
        index = places.astype(np.intp)
        beyond = places - index
        result = np.empty((len(nodes), *places.shape))
        for function, out in zip(nodes, result, strict=True):
            before, left, right, after = function[:-3], function[1:-2], function[2:-1], function[3:]
            third = (after - before) / 6 + (left - right) / 2
            second = (before + right) / 2 - left
            np.take(third, index, out=out)
            for coefficient in (second, right - left - second - third, left):
                out *= beyond
                out += coefficient[index]
        return result

    def _ends(self, points: FloatArray, half: float) -> FloatArray:
        if half == 0:
            return self._at(points, order=1)
        # Edge k opens interval k, so these are the edges inside.
        first = self._index(points - half) + 1
        most = int((self._index(points + half) + 1 - first).max())
        if most > _FEW:
            return (self._at(points + half, order=2) - self._at(points - half, order=2)) / (2 * half)
        means = self._at(points, order=1)
        jumps = np.diff(self._values, axis=1, append=self._values[:, -1:])
        for edge in range(most):
            opened = np.minimum(first + edge, self._values.shape[1])
            corner = np.square(np.maximum(half - np.abs(points - self._edges[opened]), 0)) / (4 * half)
            for jump, out in zip(jumps, means, strict=True):
                out += jump[opened - 1] * corner
        return means

    def _index(self, points: FloatArray) -> npt.NDArray[np.intp]:
        if self._step is None:
            index = np.searchsorted(self._edges, points, side="right") - 1
        else:
            index = ((points - self._edges[0]) / self._step).astype(np.intp)
        return np.clip(index, 0, self._values.shape[1] - 1)

    def _at(self, points: FloatArray, order: int) -> FloatArray:
        index = self._index(points)
        beyond = points - self._edges[index]
        result = np.empty((len(self._values), *points.shape))
        for values, first, second, out in zip(self._values, self._first, self._second, result, strict=True):
            if order == 1:
                out[...] = first[index] + values[index] * beyond
            else:
                out[...] = second[index] + (first[index] + values[index] * (beyond / 2)) * beyond
        return result


# -------- Geometric shadow

SeparableTerms = list[SeparableTerm]
EVEN = ((0.0, 0.0), (0.0, 0.0))
"""The tilt of an even mask."""
Places = tuple[tuple[int, ...], tuple[int, ...]]
"""Increasing rows and columns of a frame."""
_MOST_FEATURES = 32


@dataclass(frozen=True, eq=False)
class Directions(ByValue):
    """Directions along one axis: increasing tan-angles ``centres`` (c,) of cells of one ``width``, 0 for points."""

    centres: FloatArray
    width: float

    def __post_init__(self) -> None:
        centres = np.array(self.centres, dtype=np.float64)
        self._hold(centres=centres)

    @classmethod
    def cells(cls, edges: npt.ArrayLike) -> Directions:
        array = np.asarray(edges, dtype=np.float64)
        width = float(array[-1] - array[0]) / (len(array) - 1)
        return cls((array[:-1] + array[1:]) / 2, width)


@dataclass(frozen=True, eq=False)
class ShadowGeometry:
    """Sensor, mask and depth of one shadow [mm]; raises MitsimError for a depth that is not beyond the mask.

    ``pixel_centres_mm`` (m,) serve both axes without ``columns_mm``. ``distance_mm`` is that to the exit face, d, and
    ``depth_mm`` that to the scene, z, which may be ``inf``. ``tilt`` has, for rows and columns, the growth of the
    mask's distance with the coordinate, and its excess at the centre.
    """

    mask: Mask | Plate
    pixel_centres_mm: FloatArray
    active_mm: float
    distance_mm: float
    thickness_mm: float
    depth_mm: float
    offset_mm: tuple[float, float] = (0.0, 0.0)
    tilt: tuple[tuple[float, float], tuple[float, float]] = EVEN
    columns_mm: tuple[FloatArray, float] | None = None

    @classmethod
    def of(cls, camera: CameraGeometry, depth_mm: float, places: Places | None = None) -> ShadowGeometry:
        rows, columns = (camera.centres(axis) for axis in (0, 1))
        if places is not None:
            rows, columns = rows[np.asarray(places[0])], columns[np.asarray(places[1])]
        row_side, column_side = camera.active_sides
        beside = None if row_side == column_side and np.array_equal(rows, columns) else (columns, column_side)
        distances = camera.mask_distance, camera.mask_thickness, depth_mm
        return cls(camera.build_mask(), rows, row_side, *distances, camera.mask_offset, columns_mm=beside)

    def __post_init__(self) -> None:
        mask_mm = self.distance_mm + self.thickness_mm
        if not self.depth_mm > mask_mm:
            raise MitsimError(f"scene depth is {self.depth_mm} mm; it must lie beyond the mask at {mask_mm} mm")

    @property
    def shrink(self) -> float:
        """Return ds/du = 1 - d/z as (z - d)/z, which keeps its digits for a scene close to the mask."""
        return (self.depth_mm - self.distance_mm) / self.depth_mm if np.isfinite(self.depth_mm) else 1.0

    @property
    def half_pixel(self) -> float:
        return self.active_mm * self.shrink / 2

    def half_cell(self, directions: Directions) -> float:
        return self.distance_mm * directions.width / 2

    def along(self, axis: int) -> ShadowGeometry:
        if self.columns_mm is None:
            return self
        if not axis:
            return replace(self, columns_mm=None)
        return replace(self, pixel_centres_mm=self.columns_mm[0], active_mm=self.columns_mm[1], columns_mm=None)

    def from_mask(self, directions: Directions, axis: int) -> tuple[ShadowGeometry, Directions]:
        offset, tilt, own = self.offset_mm[axis], (self.tilt[axis],) * 2, self.along(axis)
        if not offset:
            return (own if tilt == own.tilt else replace(own, tilt=tilt)), directions
        moved = replace(own, pixel_centres_mm=own.pixel_centres_mm - offset, offset_mm=(0.0, 0.0), tilt=tilt)
        return moved, Directions(directions.centres - offset / self.depth_mm, directions.width)

    def crossings(self, directions: Directions) -> FloatArray:
        """Return the (m, c) points [mm] at which rays from pixel centres cross an even mask."""
        return self.shrink * self.pixel_centres_mm[:, None] + self.distance_mm * directions.centres[None, :]

    def on_tilted_mask(self, directions: Directions) -> FloatArray:
        (growth, beyond), even = self.tilt[0], self.crossings(directions)
        if not (growth or beyond):
            return even
        slope = directions.centres - self.pixel_centres_mm[:, None] / self.depth_mm
        return np.asarray((even + slope * (growth * even + beyond) / (1 - growth * slope)) * np.hypot(1, growth))

    def weights(self) -> list[float]:
        weights = [weight for weight, _, _ in self.mask.terms]
        return [a * b for a in weights for b in weights] if self.thickness_mm else weights

    def clear(self, profiles: Sequence[FloatArray], tau: float) -> list[Steps]:
        faces = [Steps.between(profile, self.mask.lines, self.mask.blur_mm) for profile in profiles]
        if not self.thickness_mm:
            return faces
        scale = 1 - self.thickness_mm / (self.depth_mm - self.distance_mm)
        shift = self.thickness_mm * tau / self.shrink
        return [leaves.seen_through(enters, scale, shift) for leaves in faces for enters in faces]


def both_axes(
    shadow: ShadowGeometry,
    rows: Directions,
    columns: Directions,
    axis: Callable[[ShadowGeometry, list[FloatArray], Directions], FloatArray],
) -> tuple[FloatArray, FloatArray]:
    terms = shadow.mask.terms
    row_profiles, column_profiles = [row for _, row, _ in terms], [column for _, _, column in terms]
    by_row, seen_rows = shadow.from_mask(rows, 0)
    left = axis(by_row, row_profiles, seen_rows)
    alike = rows == columns and all(first == second for first, second in (shadow.offset_mm, shadow.tilt))
    if alike and shadow.columns_mm is None and np.array_equal(row_profiles, column_profiles):
        return left, left
    by_column, seen_columns = shadow.from_mask(columns, 1)
    return left, axis(by_column, column_profiles, seen_columns)


def geometric_terms(shadow: ShadowGeometry, rows: Directions, columns: Directions) -> SeparableTerms:
    """Return the separable terms [(left (m, r), right (m, c)), ...], weights folded into left."""

    def means(shadow: ShadowGeometry, profiles: list[FloatArray], directions: Directions) -> FloatArray:
        half_cell = shadow.half_cell(directions)
        if shadow.thickness_mm:
            crossings = shadow.crossings(directions)
            thick = np.empty((len(shadow.weights()), *crossings.shape))
            for j, tau in enumerate(directions.centres):
                for term, clear in enumerate(shadow.clear(profiles, float(tau))):
                    thick[term, :, j] = clear.box_means(crossings[:, j], shadow.half_pixel, half_cell)
            return thick
        boxes, feature = (shadow.on_tilted_mask(directions), shadow.half_pixel, half_cell), shadow.mask.feature_mm
        if shadow.mask.blur_mm or boxes[1] + boxes[2] > _MOST_FEATURES * feature:
            return np.stack([profile.box_means(*boxes) for profile in shadow.clear(profiles, 0.0)])
        in_features = [np.asarray(each / feature) for each in boxes]
        return np.stack([trapezoid_mean(profile, *in_features) for profile in profiles])

    left, right = both_axes(shadow, rows, columns, means)
    return [(weight * a, b) for weight, a, b in zip(shadow.weights(), left, right, strict=True)]


def trapezoid_mean(profile: FloatArray, crossing: FloatArray, half_a: FloatArray, half_b: FloatArray) -> FloatArray:
    """Return the mean of the profile around each crossing over two boxes, in features; ``half_b`` may be 0."""
    padded = np.concatenate(([0.0], profile, [0.0]))
    total = np.zeros_like(crossing)
    for feature, weight in trapezoid_weights(crossing, half_a, half_b, len(profile)):
        total += padded[np.clip(feature + 1, 0, len(profile) + 1)] * weight
    return total


def trapezoid_weights(
    crossing: FloatArray, half_a: FloatArray, half_b: FloatArray, features: int
) -> Iterator[tuple[npt.NDArray[np.intp], FloatArray]]:
    """Yield the feature around each crossing, and its weight in the mean over two boxes, until all are covered."""
    short, long = np.minimum(half_a, half_b), np.maximum(half_a, half_b)

    def below(x: FloatArray) -> FloatArray:
        distance = np.abs(x)
        # The tail is used only where it is between 0 and 2 short, so that neither bound changes a value.
        tail = np.square(np.clip(short + long - distance, 0, 2 * short))
        tail /= np.maximum(8 * short * long, np.finfo(float).tiny)
        upper = np.where(distance <= long - short, 0.5 - distance / (2 * long), tail)
        return np.asarray(np.where(x < 0, upper, 1 - upper))

    centre = crossing + features / 2
    reach = half_a + half_b
    first = np.floor(centre - reach)
    feature = np.clip(first, -(2**62), 2**62).astype(np.intp)
    offset = first - centre
    before = np.zeros_like(centre)
    for step in range(int(np.ceil(2 * reach.max())) + 1):
        upto = below(offset + (step + 1))
        yield feature + step, upto - before
        before = upto


def nodes_between(places: FloatArray, count: int) -> FloatArray:
    reach = float(np.abs(places).max())
    return np.asarray(reach * np.cos(np.pi * (np.arange(count) + 0.5) / count) if count > 1 else np.zeros(1))


def lagrange_weights(places: FloatArray, nodes: FloatArray) -> list[FloatArray]:
    """Return for each node the Lagrange weights that interpolate to ``places``."""
    weights = []
    for node in nodes:
        parts = [(places - other) / (node - other) for other in nodes[nodes != node]]
        weights.append(np.prod([np.ones_like(places), *parts], axis=0))
    return weights
