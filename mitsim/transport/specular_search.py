"""Where mirrors are small: mirrors and a projector in, how finely each square of a grid over its window is divided out.

A ball of 0.4 mm lies between the rays of a grid of 1 mm, and still sends the projector's light to the sensor. So rays
are aimed: each mirror is cut into *spots* no larger than a few squares, and where these are seen, squares are divided
until several rays meet the smallest of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.transport.plugins.base import turn_and_origin
from mitsim.transport.projector import PinholeRays

if TYPE_CHECKING:
    from mitsim.transport.specular_rays import SpecularRays

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
_ACROSS_BALL = 0.25
"""Step of the finer grid in radii of a ball, disk or wire: some 50 rays meet a ball."""
_ACROSS_FACE = 1 / 3
"""The same in heights of a flat facet: its inscribed circle, of two thirds, holds a point of any such grid."""
_ACROSS_SMOOTH = 1.0
"""The same in heights of a smooth mesh's faces: their neighbours' normals go over into each other."""
_MARGIN = 1.5
"""Radius of a spot in the window over its radius at the axis: perspective stretches by 1 / cos^2, 1.3 at 30 degrees."""
_AT_ONCE = 2**20
"""Squares that boxes cover, looked up at a time: some tens of MB."""
_ACROSS = 2**10
"""Rays across a ball of glass: their light turns by a third of a degree from ray to ray, half a sensor at 400 mm."""
_TO_RIM = 0.25
"""Step of the finer grid where light comes from near a rim, over the distance to it."""
_TOO_CLOSE = 1 / 64
"""Distance to the rim, in radii, within which light is counted and not looked for: of a ball of glass of index 1.5 it
is 4 % of what comes back, and 98 % of the squares."""
_FINEST = 2**10
"""Points of the lattice below which the same holds of a step: squares are divided ten times more."""
_PIECE, _MOST_PIECES = 4.0, 2**10
"""Steps along each piece of an arc, and pieces of one at most: boxes about long ones would be mostly empty."""
_MOST_SPOTS = 2**21
"""Spots of all mirrors, some 300 MB; of a mesh of more faces some are left out."""


@dataclass(frozen=True, eq=False)
class _Spots:
    """Pieces of mirrors: centre (k, 3), radius (k,), and the step (k,) of rays that finds what is on them [mm]."""

    centre: FloatArray
    radius: FloatArray
    step: FloatArray


Boxes = tuple[FloatArray, FloatArray, FloatArray]
"""Corners (k, 2) of boxes in the window, least and greatest, and the step (k,) of rays that finds what is in them, in
points of the lattice."""


def first_squares(
    mirrors: Sequence[mi.Shape], rays: PinholeRays, n: int, unit: int, size: int, least: int, more: Sequence[Boxes] = ()
) -> Iterator[tuple[int, IntArray, IntArray]]:
    """Squares that tile the window, small ones where small mirrors are seen: size, first rows and first columns.

    Parameters
    ----------
    mirrors
        shapes whose light is looked for.
    rays
        of the projector.
    n, unit
        projector pixels along the window's side, and points of the lattice a pixel.
    size, least
        of the largest squares and the smallest, in points of the lattice.
    more
        boxes that are looked through besides, as finely as they say.
    """
    line = np.arange(0, n * unit, size)
    row, column = (axis.ravel() for axis in np.meshgrid(line, line, indexing="ij"))
    cell = size / unit * np.sqrt(rays.area)  # side of a square at unit distance
    spots = [_window_boxes(_spots(shape, rays, cell), rays, unit) for shape in mirrors]
    spots = [(low, high, np.maximum(step, least)) for low, high, step in spots]
    low, high, step = (np.concatenate(parts) for parts in zip(*spots, *more, strict=True))
    while len(row):
        small = step < size
        low, high, step = low[small], high[small], step[small]
        divided = _squares_in_boxes(row // size, column // size, low / size, high / size)
        yield size, row[~divided], column[~divided]
        size //= 2
        row, column = (
            np.concatenate([axis[divided] + offset * size for offset in offsets])
            for axis, offsets in ((row, (0, 0, 1, 1)), (column, (0, 1, 0, 1)))
        )


def grazing(tracer: SpecularRays, half_width: float, unit: int) -> tuple[list[Boxes], float]:
    """Where balls of glass send light to the sensor from close to their rim, and flux [W m^-2 mm^2] that comes from too
    close to it to be looked for.

    What is reflected inside of a ball leaves it the more steeply the closer to the rim it came in: two thirds of the
    light that a ball of glass sends back may come from its last thirtieth, which squares that the rim cuts do not show.
    Rays across the middle of each ball, in its plane with projector and sensor, tell where that is; by symmetry the
    rest lies on an arc.

    Parameters
    ----------
    tracer
        mirrors, and the projector's rays.
    half_width
        of the sensor [mm].
    unit
        points of the lattice a pixel.
    """
    glass = int(mi.BSDFFlags.DeltaTransmission)
    balls = [s for s in tracer.mirrors if s.class_name() == "Sphere" and s.bsdf().flags() & glass]
    if not balls:
        return [], 0.0
    across = np.sin((np.arange(_ACROSS) + 0.5) / _ACROSS * np.pi - np.pi / 2)
    planes = [_Plane.of(ball, tracer) for ball in balls]
    met = tracer.follow(np.concatenate([tracer.rays.points(plane.places(across, 0 * across))[0] for plane in planes]))
    found, left = [], 0.0
    for chain in np.unique(met.chain):
        own = np.flatnonzero(met.chain == chain)
        order = own[np.argsort(met.ray[own], kind="stable")]
        one, other = order[:-1], order[1:]
        beside = (met.ray[other] == met.ray[one] + 1) & (met.ray[other] % _ACROSS != 0)
        one, other = one[beside], other[beside]
        distance = np.linalg.norm(met.sensor[other] - met.sensor[one], axis=1)
        near = (
            np.linalg.norm((met.sensor[one] + met.sensor[other]) / 2, axis=1) < distance / 2 + math.sqrt(2) * half_width
        )
        for first, width in zip(one[near], distance[near], strict=True):
            ball, place = divmod(int(met.ray[first]), _ACROSS)
            plane, part = planes[ball], across[place : place + 2]
            arc = plane.arc(part, half_width, tracer.rays, unit)
            if 1 - np.abs(part).max() > _TOO_CLOSE and arc[2].min() > _FINEST:
                found.append(arc)
            else:
                met_by = min(2 * half_width / width, 1.0) * float(met.throughput[first])
                left += met_by * plane.flux(part, half_width, tracer.rays)
    return found, left


@dataclass(frozen=True, eq=False)
class _Plane:
    """The plane through a projector, a ball's centre and a sensor: place of the projector and directions to the ball,
    across in the plane, and out of it; the ball's distance and radius, and the sensor's from the line through both."""

    origin: FloatArray
    axes: tuple[FloatArray, FloatArray, FloatArray]
    distance: float
    radius: float
    aside: float

    @classmethod
    def of(cls, ball: mi.Shape, tracer: SpecularRays) -> _Plane:
        """Of a ``ball`` and what a ``tracer`` knows."""
        box, origin = ball.bbox(), tracer.rays.origin
        to_ball = np.array(box.center(), dtype=np.float64).ravel() - origin
        distance = float(np.linalg.norm(to_ball))
        ahead, to_sensor = to_ball / distance, tracer.camera_place - origin
        across = to_sensor - (to_sensor @ ahead) * ahead
        aside = float(np.linalg.norm(across))
        if aside < 1e-9 * distance:  # all directions are alike
            across = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
        across /= np.linalg.norm(across)
        axes = ahead, across, np.cross(ahead, across)
        return cls(origin, axes, distance, float(np.array(box.extents()).max()) / 2, aside)

    def places(self, across: FloatArray, turned: FloatArray) -> FloatArray:
        """(k, 3) places beside the ball's centre that rays pass the centre by so many radii toward (k,), ``turned`` out
        of the plane by angles (k,)."""
        sine = across * min(self.radius / self.distance, 1.0)
        ahead, aside, out = self.axes
        to = np.cos(turned)[:, None] * aside + np.sin(turned)[:, None] * out
        return np.asarray(self.origin + self.distance * (np.sqrt(1 - sine**2)[:, None] * ahead + sine[:, None] * to))

    def arc(self, across: FloatArray, half_width: float, rays: PinholeRays, unit: int) -> Boxes:
        """Boxes that find what rays ``across`` (2,) send to the sensor, and those beside the plane."""
        step, wide = _TO_RIM * (1 - float(np.abs(across).max())), self._half_angle(half_width)
        low, high = float(across.min()) - step, float(across.max()) + step
        count = min(math.ceil(2 * wide / (_PIECE * step)), _MOST_PIECES)
        ends = np.linspace(-wide, wide, count + 1)
        corners = [
            rays.points(self.places(np.full(count, part), turned))[0] * unit
            for part in (low, high)
            for turned in (ends[:-1], ends[1:])
        ]
        scale = unit / (
            math.sqrt(rays.area) * float(rays.points((self.origin + self.distance * self.axes[0])[None])[1][0])
        )
        return np.min(corners, axis=0), np.max(corners, axis=0), np.full(count, step * self.radius * scale)

    def flux(self, across: FloatArray, half_width: float, rays: PinholeRays) -> float:
        """Flux between the arcs of two rays ``across`` (2,)."""
        ring = abs(across[1] ** 2 - across[0] ** 2) / 2 * (self.radius / self.distance) ** 2
        return float(rays.power.mean() * ring * 2 * self._half_angle(half_width))

    def _half_angle(self, half_width: float) -> float:
        """Angle to either side, about the line from the projector to the ball, that light on the sensor leaves at."""
        return min(math.pi, math.sqrt(2) * half_width / max(self.aside, half_width / 4))


def _squares_in_boxes(row: IntArray, column: IntArray, low: FloatArray, high: FloatArray) -> BoolArray:
    """(q,) whether squares (row, column) meet one of the boxes from ``low`` to ``high`` (k, 2), in squares."""
    found = np.zeros(len(row), dtype=bool)
    if not len(low):
        return found
    first, last = np.floor(low).astype(np.int64), np.floor(high).astype(np.int64)
    (rows, columns), start = (last - first + 1).T, np.zeros(len(low), np.int64)
    stride = int(max(column.max(), last[:, 1].max())) + 2
    keys = row * stride + column
    order = np.argsort(keys)
    counts = rows * columns
    ends = np.cumsum(counts)
    start = np.searchsorted(ends, np.arange(0, ends[-1] + _AT_ONCE, _AT_ONCE), side="left")
    for begin, end in pairwise([*np.unique(np.minimum(start, len(counts) - 1)), len(counts)]):
        chosen = slice(begin, end)
        box = np.repeat(np.arange(begin, end), counts[chosen])
        place = np.arange(len(box)) - np.repeat(np.cumsum(counts[chosen]) - counts[chosen], counts[chosen])
        down, across = np.divmod(place, columns[box])
        wanted = np.unique((first[box, 0] + down) * stride + first[box, 1] + across)
        at = np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)
        found[order[at[keys[order][at] == wanted]]] = True
    return found


def _window_boxes(spots: _Spots, rays: PinholeRays, unit: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Boxes (k, 2) that hold ``spots`` in the window, and steps, in points of the lattice."""
    place, depth = rays.points(spots.centre)
    front = (depth > 0) & np.isfinite(place).all(axis=1)
    place, scale = place[front] * unit, unit / (np.sqrt(rays.area) * depth[front])
    reach = (_MARGIN * spots.radius[front] + spots.step[front]) * scale
    return place - reach[:, None], place + reach[:, None], spots.step[front] * scale


def _spots(shape: mi.Shape, rays: PinholeRays, cell: float) -> _Spots:
    """Spots of one mirror; ``cell`` is a square's side at unit distance."""
    if shape.is_mesh() and shape.class_name() != "Rectangle":
        return _of_faces(shape, rays, cell)
    box = shape.bbox()
    if shape.class_name() == "Sphere":
        centre, radius = np.array(box.center()).ravel(), float(np.array(box.extents()).max()) / 2
        return _Spots(centre[None], np.array([radius]), np.array([_ACROSS_BALL * radius]))
    turn, origin = turn_and_origin(mi.traverse(shape)["to_world"])
    sides = np.linalg.norm(turn, axis=0)
    if shape.class_name() == "Cylinder":
        return _along(origin, turn[:, 2], sides[0], _ACROSS_BALL * sides[0], cell * _depth(rays, origin))
    # A rectangle or disk: two half sides.
    short, long = sorted((0, 1), key=lambda i: float(sides[i]))
    step = sides[short] * (_ACROSS_BALL if shape.class_name() == "Disk" else 2 * _ACROSS_FACE)
    start = origin - turn[:, long]
    return _along(start, 2 * turn[:, long], sides[short], step, cell * _depth(rays, origin))


def _along(start: FloatArray, way: FloatArray, radius: float, step: float, square: float) -> _Spots:
    """Spots along a line, no further apart than their radius or a ``square`` [mm]."""
    length = float(np.linalg.norm(way))
    count = min(max(1, int(np.ceil(length / max(radius, square, 1e-9)))), _MOST_SPOTS)
    middle = (np.arange(count) + 0.5) / count
    reach = np.hypot(length / count / 2, radius)
    return _Spots(start + middle[:, None] * way, np.full(count, reach), np.full(count, step))


def _of_faces(shape: mi.Shape, rays: PinholeRays, cell: float) -> _Spots:
    """Spots of a mesh: its faces, long ones in pieces."""
    count = shape.face_count()
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST_SPOTS // 4)).astype(np.uint32))
    corners = np.array(shape.face_indices(mi.UInt32(chosen))).T
    places = np.array(shape.vertex_position(mi.UInt32(corners.ravel()))).T.astype(np.float64).reshape(-1, 3, 3)
    edges = places[:, [1, 2, 0]] - places
    lengths = np.linalg.norm(edges, axis=2)
    longest = lengths.max(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        height = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / longest
    whole = np.flatnonzero(height > 0)
    smooth = shape.has_vertex_normals() and not shape.has_face_normals()
    square = cell * _depth(rays, places.mean(axis=(0, 1)))
    pieces = np.maximum(1, np.ceil(longest / np.maximum(height, square)))[whole].astype(np.int64)
    pieces = np.minimum(pieces, max(1, _MOST_SPOTS // max(1, len(whole))))
    face = np.repeat(whole, pieces)
    middle = (np.arange(len(face)) - np.repeat(np.cumsum(pieces) - pieces, pieces) + 0.5) / np.repeat(pieces, pieces)
    at = np.argmax(lengths, axis=1)[face]
    # Pieces lie along the longest edge, and reach across by the height.
    centre = places[face, at] + middle[:, None] * edges[face, at]
    reach = np.hypot(longest[face] / np.repeat(pieces, pieces) / 2, height[face])
    return _Spots(centre, reach, (_ACROSS_SMOOTH if smooth else _ACROSS_FACE) * height[face])


def _depth(rays: PinholeRays, place: FloatArray) -> float:
    """Depth [mm] of a place in front of the projector, at least some."""
    return max(float(rays.points(place[None])[1][0]), 1.0)
