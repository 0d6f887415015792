"""Specular chains: beams that reach the sensor from a pinhole projector over perfect mirrors alone, or directly.

A path projector - mirror - sensor has a delta at both ends, so no path from the camera finds it. Such light is traced
from the projector (:mod:`mitsim.transport.specular_rays`) through a grid of points of each pixel. Four neighbours that
met the same surfaces in the same way (the same *chain*) bound a beam. Beams near the sensor are divided until the map
from the window to the sensor is bilinear over each. The flux of a beam is its area on the plane at unit distance times
the projector's irradiance there, pi x scale x texture.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import keep_scenes
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry
from mitsim.optics.mirror_frames import Beams
from mitsim.transport.connect import PinholeRays, ProjectorOptics
from mitsim.transport.plugins.base import turn_and_origin
from mitsim.transport.specular_rays import Boxes, Chains, Crossings, IntArray, Mask, Rays, SpecularRays, grazing, join

_UNIT = 2**24
"""Lattice points along a projector pixel: a ball of 10 um lights a sensor through 0.1 um of a pixel of 2 mm."""
_DIVISIONS = 2**14
"""Most parts along a square of the first grid: a rim in a pixel of 300 sensor pixels is found to a 20th of one."""
_DEEPER = 2**4
_MOST = 2**16
"""Squares of one size beyond which none is divided: a wire of 0.15 mm reaches it, in 5 processor seconds."""
_AT_ONCE = 2**18
_COARSE = 128
"""Fewest coarse beams along the window: a mirror of a hundredth of the window is found."""
_TURNED, _MIRRORS = 256, 16
_ACROSS_SENSOR = 128
"""Rays across a sensor in the projector's direct light: a hole that lights a 128th of it is found."""
_TOLERANCE = 0.02
"""Largest departure from a bilinear map, in sensor pixels: twice float32's error at the sensor."""
_SHADES = 0.01
_SMALL = 2.0
"""Sensor pixels below which whole beams are not divided."""
_PAINT = 0.5
_RIM = 1 / 16
"""The limit for beams that a rim cuts: 1.5 % of a pixel along a straight rim; each halving doubles the beams."""
_SHARES = np.outer([0.25, 0.5, 0.25], [0.25, 0.5, 0.25])
_MARGIN = 0.02
_ARRAYS = ("pixel", "flux", "sensor", "tangent", "throughput")


@keep_scenes()
def trace_specular_chains(
    scene: mi.Scene, camera: mi.Sensor, projector: ProjectorOptics, max_depth: int = _MIRRORS
) -> Beams:
    """Return the beams from the projector's pinhole to the sensor over perfect mirrors or lenses alone, or directly.

    A mirror that no ray of the coarse grid meets is not found.
    """
    if max_depth < 1:
        raise MitsimError(f"max_depth of specular chains is {max_depth}; give at least 1")
    geometry, n = camera.geometry, projector.n
    nothing = np.zeros((0, 2, 2, 2))
    parts = [Beams(np.zeros(0, np.int64), np.zeros(0), nothing, nothing, np.zeros((0, 2, 2)), 0.0)]
    left = np.zeros(2)
    # A sensor within the window is searched as finely as small mirrors.
    sides = np.array([[geometry.half_width], [2 * geometry.half_width / _ACROSS_SENSOR]])
    for each in projector.per_wavelength:
        tracer = SpecularRays(scene, camera, each, max_depth)
        arcs, close = grazing(tracer, geometry.half_width, _UNIT)
        left[0] += close
        arcs.append(_window_boxes(_Spots(tracer.camera_place[None], *sides), tracer.rays))
        for size, row, column in first_squares(tracer.mirrors, tracer.rays, n, _COARSE, arcs):
            for first in range(0, len(row), _AT_ONCE):
                chosen = slice(first, first + _AT_ONCE)
                beams, lost = _search(tracer, row[chosen], column[chosen], size, n, geometry)
                parts += beams
                left += lost
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
    return Beams(**arrays, unresolved=float(left[0]), error=math.sqrt(left[1]))


def turned_by_mirrors(scene: mi.Scene, camera: mi.Sensor, projector: ProjectorOptics) -> Rays:
    """Return the rays that mirrors have turned, before each surface, for a grid over the window."""
    parts = list[Rays]()
    for each in projector.per_wavelength:
        tracer = SpecularRays(scene, camera, each, _MIRRORS)
        for size, row, column in first_squares(tracer.mirrors, tracer.rays, each.n, _TURNED):
            turned = list[Rays]()
            tracer.follow((np.stack([row, column], axis=1) + size / 2) / _UNIT, turned)
            rays, area = join(turned), tracer.rays.area * (size / _UNIT) ** 2
            flux = _fluxes(tracer, row, column, size, each.n)[rays.index] * (rays.spectrum @ tracer.colour)
            parts.append(replace(rays, spectrum=np.stack([flux, flux / area], axis=1)))
    return join(parts)


def _search(
    tracer: SpecularRays, row: IntArray, column: IntArray, size: int, n: int, geometry: CameraGeometry
) -> tuple[list[Beams], FloatArray]:
    crossings, place = _trace_squares(tracer, row, column, np.array([0, size]))
    # Squares that a chain has a corner of, one for each chain; corners (row, column) by the ray that they are.
    chains, number = np.unique(crossings.chain, return_inverse=True)
    order = np.argsort(place.ravel(), kind="stable")
    corner_of = place.ravel()[order]
    first, last = (np.searchsorted(corner_of, crossings.ray, side=side) for side in ("left", "right"))
    counts = last - first
    touched = order[np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts - first, counts)] // 4
    pairs = np.unique(np.repeat(number, counts) * len(row) + touched)
    chain, square = np.divmod(pairs, len(row))
    nodes = _nodes(crossings, chains[chain], place[square])
    spread = _spread(nodes, np.full((len(square), 2), np.inf))
    chosen = _near(nodes, spread, geometry)
    square, chain = square[chosen], chain[chosen]
    return _refine(tracer, (chains[chain], row[square], column[square], spread[chosen]), size, n, geometry)


# -------- Nodes: quantities at points of the lattice


@dataclass(frozen=True, eq=False)
class _Nodes:
    valid: Mask
    sensor: FloatArray
    tangent: FloatArray
    throughput: FloatArray

    def take(self, index: Any) -> _Nodes:
        return _Nodes(self.valid[index], self.sensor[index], self.tangent[index], self.throughput[index])

    def quarter(self, i: int, j: int) -> _Nodes:
        return self.take((slice(None), slice(i, i + 2), slice(j, j + 2)))


def _trace_squares(
    tracer: SpecularRays, row: IntArray, column: IntArray, steps: IntArray
) -> tuple[Crossings, IntArray]:
    rows, columns = np.broadcast_arrays(row[:, None, None] + steps[:, None], column[:, None, None] + steps)
    line, number = np.unique(columns, return_inverse=True)
    key, place = np.unique(rows.ravel() * len(line) + number.ravel(), return_inverse=True)
    row, number = np.divmod(key, max(1, len(line)))
    return tracer.follow(np.stack([row, line[number]], axis=1) / _UNIT), place.reshape(rows.shape)


def _nodes(crossings: Crossings, chain: Chains, place: IntArray) -> _Nodes:
    chains, number = np.unique(crossings.chain, return_inverse=True)
    rays = int(max(place.max(initial=0), crossings.ray.max(initial=0))) + 1
    key = number * rays + crossings.ray
    order = np.argsort(key, kind="stable")
    mine = np.searchsorted(chains, chain)
    known = mine < len(chains)
    known[known] = chains[mine[known]] == chain[known]
    wanted = np.where(known, mine, len(chains))[:, None, None] * rays + place
    if not len(order):
        nothing = np.full((*wanted.shape, 2), np.nan)
        return _Nodes(np.zeros(wanted.shape, bool), nothing, nothing, np.zeros(wanted.shape))
    # The last of equal ones.
    at = order[np.maximum(np.searchsorted(key[order], wanted, side="right") - 1, 0)]
    valid = key[at] == wanted
    sensor, tangent = (np.where(valid[..., None], v[at], np.nan) for v in (crossings.sensor, crossings.tangent))
    return _Nodes(valid, sensor, tangent, np.where(valid, crossings.throughput[at], 0))


# -------- Division of squares until light is bilinear over each


def _refine(
    tracer: SpecularRays,
    squares: tuple[Chains, IntArray, IntArray, FloatArray],
    size: int,
    n: int,
    geometry: CameraGeometry,
) -> tuple[list[Beams], FloatArray]:
    chain, row, column, spread = squares
    parts: list[Beams] = []
    unresolved = variance = 0.0
    finest, pitch = max(1, size // _DIVISIONS), min(geometry.pitches)
    while len(row):
        half = size // 2
        crossings, place = _trace_squares(tracer, row, column, half * np.arange(3))
        nodes = _nodes(crossings, chain, place)
        extent = _size(*_box(nodes.valid, nodes.sensor))
        whole = nodes.valid.all(axis=(1, 2))
        smooth = (_departure(nodes.sensor) < _TOLERANCE * pitch) & (extent < geometry.half_width)
        even = _departure(nodes.throughput[..., None]) <= _SHADES * nodes.throughput.max(axis=(1, 2))
        done = whole & (smooth | (extent < _SMALL * pitch)) & (even | (extent < _PAINT * pitch))
        spread = _spread(nodes, spread)
        edge = ~whole & (spread[:, 0] < _RIM * pitch)
        # Light that small balls send to each other is faint, and its place is known too late.
        unknown = (half <= finest * _DEEPER) & (spread[:, 0] > pitch)
        lost = ~done & (edge | unknown | (half == finest) | (len(row) > _MOST))
        # Squares that are given up become points of light at those of their nodes that the sensor sees.
        left, flux = nodes.take(lost), _fluxes(tracer, row, column, size, n)[lost]
        seen = left.valid & (np.abs(left.sensor) < geometry.half_width).all(axis=-1)
        seen &= (np.abs(left.tangent) <= geometry.tan_half_fov).all(axis=-1)
        if len(row) <= _MOST:
            light = _SHARES * left.throughput * flux[:, None, None]
            unresolved += float(light[seen & unknown[lost][:, None, None]].sum())
            seen &= ~unknown[lost][:, None, None]
        number, i, j = np.nonzero(seen)
        light = (_SHARES * left.throughput * flux[:, None, None])[number, i, j]
        sensor, tangent = (
            np.broadcast_to(values[number, i, j][:, None, None], (len(number), 2, 2, 2))
            for values in (left.sensor, left.tangent)
        )
        pixel = _pixel(row, column, n)[lost][number]
        parts.append(Beams(pixel, light, sensor, tangent, np.ones((len(number), 2, 2)), 0.0))
        variance += float(np.square(np.bincount(number, light)).sum()) if len(number) else 0.0
        following = []
        for i, j in np.ndindex(2, 2):
            corners, at = nodes.quarter(i, j).take(done), (row[done] + i * half, column[done] + j * half)
            flux = _fluxes(tracer, *at, half, n)
            parts.append(Beams(_pixel(*at, n), flux, corners.sensor, corners.tangent, corners.throughput, 0.0))
            goes_on = ~done & ~lost & _near(nodes.quarter(i, j), spread, geometry)
            at = row[goes_on] + i * half, column[goes_on] + j * half
            following.append((chain[goes_on], *at, spread[goes_on]))
        chain, row, column, spread = (np.concatenate(part) for part in zip(*following, strict=True))
        size = half
    return parts, np.array([unresolved, variance])


def _box(valid: Mask, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    low, high = (np.where(valid[..., None], values, limit) for limit in (np.inf, -np.inf))
    return low.min(axis=(1, 2)), high.max(axis=(1, 2))


def _size(low: FloatArray, high: FloatArray) -> FloatArray:
    return np.asarray(np.where(np.isfinite(low), high - low, 0).max(axis=-1))


def _spread(nodes: _Nodes, before: FloatArray) -> FloatArray:
    sizes = np.stack([_size(*_box(nodes.valid, values)) for values in (nodes.sensor, _sines(nodes))], axis=1)
    return np.asarray(np.where(sizes > 0, sizes, before))


def _near(nodes: _Nodes, spread: FloatArray, geometry: CameraGeometry) -> Mask:
    """Return (q,) True for squares that may light the sensor within the field stop."""
    sine = geometry.tan_half_fov / np.hypot(1, geometry.tan_half_fov)
    whole = nodes.valid.all(axis=(1, 2))
    near = nodes.valid.any(axis=(1, 2))
    of_places = nodes.sensor, spread[:, 0], geometry.half_width + max(geometry.pitches)
    for values, above, reach in (of_places, (_sines(nodes), spread[:, 1], sine + _MARGIN)):
        low, high = _box(nodes.valid, values)
        margin = np.where(whole, _size(low, high) / 2, above)[:, None]
        with np.errstate(invalid="ignore"):
            near &= ((low - margin < reach) & (high + margin > -reach)).all(axis=1)
    return np.asarray(near)


def _sines(nodes: _Nodes) -> FloatArray:
    return np.asarray(nodes.tangent / np.sqrt(1 + np.square(nodes.tangent).sum(axis=-1, keepdims=True)))


def _departure(values: FloatArray) -> FloatArray:
    blend = np.array([[1, 0], [0.5, 0.5], [0, 1]])
    flat = np.einsum("ia,jb,qabk->qijk", blend, blend, values[:, ::2, ::2])
    return np.asarray(np.linalg.norm(values - flat, axis=-1).max(axis=(1, 2)))


def _fluxes(tracer: SpecularRays, row: IntArray, column: IntArray, size: int, n: int) -> FloatArray:
    power = tracer.rays.power.mean(axis=1)[_pixel(row, column, n)]
    return np.asarray(power * tracer.rays.area * (size / _UNIT) ** 2)


def _pixel(row: IntArray, column: IntArray, n: int) -> IntArray:
    return (row // _UNIT) * n + column // _UNIT


# -------- Small mirrors: how finely each square of a grid over the window is divided
#
# A ball of 0.4 mm lies between the rays of a grid of 1 mm, and still sends the projector's light to the sensor. So rays
# are aimed: each mirror is cut into *spots* no larger than a few squares, and where these are seen, squares are divided
# until several rays meet the smallest of them.

_ACROSS_BALL = 0.25
"""Step of the finer grid in radii of a ball, disk or wire: some 50 rays meet a ball."""
_ACROSS_FACE = 1 / 3
"""Step in heights of a flat facet, whose inscribed circle contains a point of any such grid."""
_ACROSS_SMOOTH = 1.0
_SPOT_MARGIN = 1.5
"""Radius of a spot in the window over that at the axis: perspective stretches by 1 / cos^2, 1.3 at 30 degrees."""
_BOXES_AT_ONCE = 2**20
_MOST_SPOTS = 2**21


@dataclass(frozen=True, eq=False)
class _Spots:
    centre: FloatArray
    radius: FloatArray
    step: FloatArray


def first_squares(
    mirrors: Sequence[mi.Shape], rays: PinholeRays, n: int, coarse: int, more: Sequence[Boxes] = ()
) -> Iterator[tuple[int, IntArray, IntArray]]:
    size = _UNIT // min(_UNIT, 2 ** max(0, int(np.ceil(np.log2(coarse / n)))))
    line = np.arange(0, n * _UNIT, size)
    row, column = (axis.ravel() for axis in np.meshgrid(line, line, indexing="ij"))
    cell = size / _UNIT * np.sqrt(rays.area)  # side of a square at unit distance
    spots = [_window_boxes(_spots(shape, rays, cell), rays) for shape in mirrors]
    spots = [(low, high, np.maximum(step, _DIVISIONS)) for low, high, step in spots]
    none = np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
    low, high, step = (np.concatenate(parts) for parts in zip(none, *spots, *more, strict=True))
    low, high = (np.clip(ends, -1.0, n * _UNIT) for ends in (low, high))  # what is beside the window may be far
    while len(row):
        small = step < size
        low, high, step = low[small], high[small], step[small]
        divided = np.zeros(len(row), dtype=bool)
        if len(low):  # squares that one of the boxes meets
            first, last = (np.floor(ends / size).astype(np.int64) for ends in (low, high))
            rows, columns = (last - first + 1).T
            stride = int(max((column // size).max(), last[:, 1].max())) + 2
            keys = row // size * stride + column // size
            order, counts = np.argsort(keys), rows * columns
            ends = np.cumsum(counts)
            start = np.searchsorted(ends, np.arange(0, ends[-1] + _BOXES_AT_ONCE, _BOXES_AT_ONCE), side="left")
            for begin, end in pairwise([*np.unique(np.minimum(start, len(counts) - 1)), len(counts)]):
                chosen = slice(begin, end)
                box = np.repeat(np.arange(begin, end), counts[chosen])
                place = np.arange(len(box)) - np.repeat(np.cumsum(counts[chosen]) - counts[chosen], counts[chosen])
                down, across = np.divmod(place, columns[box])
                wanted = np.unique((first[box, 0] + down) * stride + first[box, 1] + across)
                at = np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)
                divided[order[at[keys[order][at] == wanted]]] = True
        yield size, row[~divided], column[~divided]
        size //= 2
        row, column = (
            np.concatenate([axis[divided] + offset * size for offset in offsets])
            for axis, offsets in ((row, (0, 0, 1, 1)), (column, (0, 1, 0, 1)))
        )


def _window_boxes(spots: _Spots, rays: PinholeRays) -> tuple[FloatArray, FloatArray, FloatArray]:
    place, depth = rays.points(spots.centre)
    front = (depth > 0) & np.isfinite(place).all(axis=1)
    place, scale = place[front] * _UNIT, _UNIT / (np.sqrt(rays.area) * depth[front])
    reach = (_SPOT_MARGIN * spots.radius[front] + spots.step[front]) * scale
    return place - reach[:, None], place + reach[:, None], spots.step[front] * scale


def _spots(shape: mi.Shape, rays: PinholeRays, cell: float) -> _Spots:
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
    length = float(np.linalg.norm(way))
    count = min(max(1, int(np.ceil(length / max(radius, square, 1e-9)))), _MOST_SPOTS)
    middle = (np.arange(count) + 0.5) / count
    reach = np.hypot(length / count / 2, radius)
    return _Spots(start + middle[:, None] * way, np.full(count, reach), np.full(count, step))


def _of_faces(shape: mi.Shape, rays: PinholeRays, cell: float) -> _Spots:
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
    return max(float(rays.points(place[None])[1][0]), 1.0)
