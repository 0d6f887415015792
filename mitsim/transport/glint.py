"""Glint: from a scene and a pinhole projector to beams of rays that reach the sensor over perfect mirrors alone.

A path projector - mirror - sensor has a delta at both ends, so no path from the camera finds it: it is traced from the
projector instead (:mod:`mitsim.transport.glint_rays`). Rays go through a grid of points of each projector pixel. Four
neighbours that met the same surfaces in the same way (the same *chain*) bound a beam; beams near the sensor are divided
until the map from the projector's window to the sensor is bilinear over each. :mod:`mitsim.optics.glint` turns beams
into frames.

Flux: the stock projector's irradiance on the plane at unit distance is pi x scale x texture, the same everywhere on it,
so a beam holds that times its area on this plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.optics.glint import Beams
from mitsim.rig.camera import CameraGeometry
from mitsim.transport.glint_rays import Crossings, GlintRays, IntArray, Mask, delta_bsdfs
from mitsim.transport.projector import ProjectorOptics

_UNIT = 2**10
"""Lattice points a projector pixel's side, the finest division: a pixel of 1000 sensor pixels still ends at one."""
_COARSE = 128
"""Least number of coarse beams along the window's side: a mirror of a hundredth of the window is seen."""
_TOLERANCE = 0.02
"""Largest departure from a bilinear map, in sensor pixels: twice what float32 leaves of a place at the sensor."""
_SHADES = 0.01
"""The same for the light left, relative: of a painted mirror, whose paint is seldom known better."""
_SMALL = 2.0
"""Whole beams below this many sensor pixels are not divided further: what varies inside is finer than frames show."""
_RIM = 0.5
"""The same for beams that an edge cuts: those are given up if the edge is a rim, and kept if it is one of paint.

Half a pixel, which a frame does not resolve; each halving doubles the beams along every rim.
"""
_MARGIN = 0.02
"""Sine by which the field stop is widened when squares are left out: 1 degree, more than a square's rays curve."""


def has_mirrors(scene: mi.Scene) -> bool:
    """Whether some surface of the ``scene`` reflects or refracts like a perfect mirror or lens."""
    return bool(delta_bsdfs(scene, int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.DeltaTransmission)))


def trace_glint(scene: mi.Scene, camera: mi.Sensor, projector: ProjectorOptics, max_depth: int = 16) -> Beams:
    """All beams that leave the projector, meet perfect mirrors or lenses alone, and reach the sensor.

    A mirror that no ray of the coarse grid meets (one point a projector pixel, at least 128 a side) is not seen.

    Parameters
    ----------
    scene, camera
        what light meets, and the sensor with its ``geometry``.
    projector
        where it comes from; taken as a pinhole.
    max_depth
        mirrors that a beam may meet, at least 1.

    Raises
    ------
    MitsimError
        for a depth below 1.
    """
    if max_depth < 1:
        raise MitsimError(f"max_depth of glints is {max_depth}; give at least 1")
    if not has_mirrors(scene):
        return _joined([], 0.0)
    parts, unresolved = [], 0.0
    for each in projector.apart:
        beams, lost = _of(GlintRays(scene, camera, each, max_depth), projector.n, camera.geometry)
        parts += beams
        unresolved += lost
    return _joined(parts, unresolved)


def _of(tracer: GlintRays, n: int, geometry: CameraGeometry) -> tuple[list[Beams], float]:
    """Beams of the pixels of a window of ``n`` a side, and what was left unresolved."""
    step = _UNIT // min(_UNIT, 2 ** max(0, int(np.ceil(np.log2(_COARSE / n)))))
    line = np.arange(0, n * _UNIT + 1, step)
    row, column = (axis.ravel() for axis in np.meshgrid(line, line, indexing="ij"))
    crossings = tracer.follow(np.stack([row, column], axis=1) / _UNIT)
    low_row, low_column = (axis.ravel() for axis in np.meshgrid(line[:-1], line[:-1], indexing="ij"))
    first = np.arange(len(line) - 1)
    neighbours = np.array([[0, 1], [len(line), len(line) + 1]])
    corner = (first[:, None] * len(line) + first).ravel()[:, None, None] + neighbours
    parts, unresolved = [], 0.0
    for chain in np.unique(crossings.chain):
        nodes = _nodes(crossings, chain, row.size)
        squares = nodes.take(corner)
        chosen = _near(squares, squares, geometry)
        beams, lost = _refine(tracer, chain, low_row[chosen], low_column[chosen], step, n, geometry)
        parts += beams
        unresolved += lost
    return parts, unresolved


@dataclass(frozen=True, eq=False)
class _Nodes:
    """What is known at lattice points of one chain, any shape: whether a ray arrived, and where, how, how bright."""

    valid: Mask
    sensor: FloatArray
    tangent: FloatArray
    throughput: FloatArray

    def take(self, index: Any) -> _Nodes:
        return _Nodes(self.valid[index], self.sensor[index], self.tangent[index], self.throughput[index])

    def quarter(self, i: int, j: int) -> _Nodes:
        """The corners (q, 2, 2) of a quarter of squares that are known at (q, 3, 3) nodes."""
        return self.take((slice(None), slice(i, i + 2), slice(j, j + 2)))


def _nodes(crossings: Crossings, chain: np.uint64, count: int) -> _Nodes:
    """The crossings of one chain, by number of the ray."""
    mine = crossings.chain == chain
    ray = crossings.ray[mine]
    valid = np.zeros(count, dtype=bool)
    valid[ray] = True
    nodes = _Nodes(valid, np.full((count, 2), np.nan), np.full((count, 2), np.nan), np.zeros(count))
    nodes.sensor[ray], nodes.tangent[ray] = crossings.sensor[mine], crossings.tangent[mine]
    nodes.throughput[ray] = crossings.throughput[mine]
    return nodes


def _refine(
    tracer: GlintRays, chain: np.uint64, row: IntArray, column: IntArray, size: int, n: int, geometry: CameraGeometry
) -> tuple[list[Beams], float]:
    """Beams of one chain inside squares of the lattice (first row and column, ``size``), and the flux not resolved."""
    parts: list[Beams] = []
    unresolved = 0.0
    pitch = min(geometry.pitches)
    while len(row):
        half = size // 2
        nodes = _trace_squares(tracer, chain, row, column, half)
        extent = _extent(nodes)
        whole = nodes.valid.all(axis=(1, 2))
        smooth = (_departure(nodes.sensor) < _TOLERANCE * pitch) & (extent < geometry.half_width)
        even = _departure(nodes.throughput[..., None]) <= _SHADES * nodes.throughput.max(axis=(1, 2))
        done = whole & (smooth | (extent < _SMALL * pitch)) & (even | (extent < _RIM * pitch))
        lost = ~done & ((half == 1) | (~whole & (extent > 0) & (extent < _RIM * pitch)))
        share = nodes.throughput.mean(axis=(1, 2)) * _fluxes(tracer, row, column, size, n)
        unresolved += float(share[lost & _near(nodes, nodes, geometry)].sum())
        for i, j in np.ndindex(2, 2):
            corners = nodes.quarter(i, j).take(done)
            at = row[done] + i * half, column[done] + j * half
            pixel, flux = _pixel(*at, n), _fluxes(tracer, *at, half, n)
            parts.append(Beams(pixel, flux, corners.sensor, corners.tangent, corners.throughput, 0.0))
        following = []
        for i, j in np.ndindex(2, 2):
            goes_on = ~done & ~lost & _near(nodes.quarter(i, j), nodes, geometry)
            following.append((row[goes_on] + i * half, column[goes_on] + j * half))
        row, column = (np.concatenate(part) for part in zip(*following, strict=True))
        size = half
    return parts, unresolved


def _trace_squares(tracer: GlintRays, chain: np.uint64, row: IntArray, column: IntArray, half: int) -> _Nodes:
    """Nodes (q, 3, 3) at corners, edge middles and centre of squares; shared points are traced once."""
    step = half * np.arange(3)
    rows, columns = np.broadcast_arrays(row[:, None, None] + step[:, None], column[:, None, None] + step)
    stride = int(columns.max()) + 1
    key, place = np.unique((rows * stride + columns).ravel(), return_inverse=True)
    crossings = tracer.follow(np.stack(np.divmod(key, stride), axis=1) / _UNIT)
    return _nodes(crossings, chain, len(key)).take(place.reshape(rows.shape))


def _box(valid: Mask, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(q, 2) least and greatest values (q, ., ., 2) at valid nodes, inf and -inf where there are none."""
    low, high = (np.where(valid[..., None], values, limit) for limit in (np.inf, -np.inf))
    return low.min(axis=(1, 2)), high.max(axis=(1, 2))


def _size(low: FloatArray, high: FloatArray) -> FloatArray:
    """(q,) larger side of boxes, 0 where nothing or one ray arrived."""
    return np.asarray(np.where(np.isfinite(low), high - low, 0).max(axis=-1))


def _extent(nodes: _Nodes) -> FloatArray:
    """(q,) larger side of the bounding box of what arrived [mm]."""
    return _size(*_box(nodes.valid, nodes.sensor))


def _near(nodes: _Nodes, parent: _Nodes, geometry: CameraGeometry) -> Mask:
    """(q,) whether a square may light the sensor within the field stop: its corners' box, grown by what may be hidden.

    A whole square bulges by its curvature; one that a rim cuts may be as large as the square ``parent`` that it is part
    of, or of any size if only one ray of that arrived. Directions are compared by sines, which stay finite.
    """
    sine = geometry.tan_half_fov / np.hypot(1, geometry.tan_half_fov)
    whole = nodes.valid.all(axis=(1, 2))
    near = nodes.valid.any(axis=(1, 2))
    of_places = nodes.sensor, parent.sensor, geometry.half_width + max(geometry.pitches)
    for values, above_values, reach in (of_places, (_sines(nodes), _sines(parent), sine + _MARGIN)):
        low, high = _box(nodes.valid, values)
        above = _size(*_box(parent.valid, above_values))
        margin = np.where(whole, _size(low, high) / 2, np.where(above > 0, above, np.inf))[:, None]
        with np.errstate(invalid="ignore"):
            near &= ((low - margin < reach) & (high + margin > -reach)).all(axis=1)
    return np.asarray(near)


def _sines(nodes: _Nodes) -> FloatArray:
    """Sines of the rays' angles to the axis, along rows and columns."""
    return np.asarray(nodes.tangent / np.sqrt(1 + np.square(nodes.tangent).sum(axis=-1, keepdims=True)))


def _departure(values: FloatArray) -> FloatArray:
    """(q,) largest distance of values (q, 3, 3, k) from the bilinear map of their corners; NaN if one lacks."""
    blend = np.array([[1, 0], [0.5, 0.5], [0, 1]])
    flat = np.einsum("ia,jb,qabk->qijk", blend, blend, values[:, ::2, ::2])
    return np.asarray(np.linalg.norm(values - flat, axis=-1).max(axis=(1, 2)))


def _fluxes(tracer: GlintRays, row: IntArray, column: IntArray, size: int, n: int) -> FloatArray:
    """(q,) flux into squares of the lattice [W m^-2 mm^2]."""
    power = tracer.rays.power.mean(axis=1)[_pixel(row, column, n)]
    return np.asarray(power * tracer.rays.area * (size / _UNIT) ** 2)


def _pixel(row: IntArray, column: IntArray, n: int) -> IntArray:
    """(q,) projector pixel of points of the lattice."""
    return (row // _UNIT) * n + column // _UNIT


def _joined(parts: list[Beams], unresolved: float) -> Beams:
    pair = np.zeros((0, 2, 2, 2))
    none = Beams(np.zeros(0, np.int64), np.zeros(0), pair, pair, np.zeros((0, 2, 2)), 0.0)
    names = ("pixel", "flux", "sensor", "tangent", "throughput")
    arrays = {name: np.concatenate([getattr(part, name) for part in (none, *parts)]) for name in names}
    return Beams(**arrays, unresolved=unresolved)
