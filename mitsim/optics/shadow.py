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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import ByValue, FloatArray, SeparableTerm
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask import Mask
from mitsim.devices.plate import Plate
from mitsim.optics.edge_profile import Steps

SeparableTerms = list[SeparableTerm]
EVEN = ((0.0, 0.0), (0.0, 0.0))
"""The tilt of an even mask."""
Places = tuple[tuple[int, ...], tuple[int, ...]]
"""Increasing rows and columns of a frame."""
_WIDE = 32


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
    means = _thick_means if shadow.thickness_mm else _thin_means
    left, right = both_axes(shadow, rows, columns, means)
    return [(weight * a, b) for weight, a, b in zip(shadow.weights(), left, right, strict=True)]


def _thin_means(shadow: ShadowGeometry, profiles: list[FloatArray], directions: Directions) -> FloatArray:
    boxes = shadow.on_tilted_mask(directions), shadow.half_pixel, shadow.half_cell(directions)
    feature = shadow.mask.feature_mm
    if not shadow.mask.even or boxes[1] + boxes[2] > _WIDE * feature:
        return np.stack([profile.box_means(*boxes) for profile in shadow.clear(profiles, 0.0)])
    in_features = [np.asarray(each / feature) for each in boxes]
    return np.stack([trapezoid_mean(profile, *in_features) for profile in profiles])


def _thick_means(shadow: ShadowGeometry, profiles: list[FloatArray], directions: Directions) -> FloatArray:
    crossings, half_cell = shadow.crossings(directions), shadow.half_cell(directions)
    means = np.empty((len(shadow.weights()), *crossings.shape))
    for j, tau in enumerate(directions.centres):
        for term, clear in enumerate(shadow.clear(profiles, float(tau))):
            means[term, :, j] = clear.box_means(crossings[:, j], shadow.half_pixel, half_cell)
    return means


def trapezoid_mean(profile: FloatArray, crossing: FloatArray, half_a: FloatArray, half_b: FloatArray) -> FloatArray:
    """Return the mean of the profile around each crossing over two boxes, in features; ``half_b`` may be 0."""
    short, long = np.minimum(half_a, half_b), np.maximum(half_a, half_b)

    def below(x: FloatArray) -> FloatArray:
        distance = np.abs(x)
        # The tail is used only where it is between 0 and 2 short, so that neither bound changes a value.
        tail = np.square(np.clip(short + long - distance, 0, 2 * short))
        tail /= np.maximum(8 * short * long, np.finfo(float).tiny)
        upper = np.where(distance <= long - short, 0.5 - distance / (2 * long), tail)
        return np.asarray(np.where(x < 0, upper, 1 - upper))

    centre = crossing + len(profile) / 2
    reach = half_a + half_b
    first = np.floor(centre - reach)
    feature = np.clip(first, -(2**62), 2**62).astype(np.intp)
    offset = first - centre
    padded = np.concatenate(([0.0], profile, [0.0]))
    total, before = np.zeros_like(centre), np.zeros_like(centre)
    for step in range(int(np.ceil(2 * reach.max())) + 1):
        upto = below(offset + (step + 1))
        total += padded[np.clip(feature + (step + 1), 0, len(profile) + 1)] * (upto - before)
        before = upto
    return total


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
