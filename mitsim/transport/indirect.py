"""Indirect light from the projector's side: every pixel's rays, followed over any number of surfaces to the sensor.

After the first surface a path is connected at each surface to the sensor. Of the connections of a path to one anchor,
one is drawn in proportion to its light, and carries the light of all.

Connections rarely meet the lobe of a last surface that turns light sharply; there the camera's side finds the light
(:func:`mitsim.transport.integrator.camera_part`). Light that only mirrors have turned before the last surface (a
caustic) belongs to direct light.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray, mean_of_neighbours
from mitsim.transport import integrator
from mitsim.transport.connect import SensorPoints, Way, sample_wavelengths
from mitsim.transport.plugins.base import sobol_point, streams
from mitsim.transport.records import DeviceAccumulator, PathSamples, Sightings

_ROOMS = (4**2, 12**2)


class IndirectTracer(integrator.FollowingTracer):
    adaptive: AdaptiveSamples | None = None

    def with_adaptive_counts(self, repeats: Sequence[int]) -> IndirectTracer:
        again = copy(self)
        again.adaptive = AdaptiveSamples.of(by_pixel(repeats, self.projector.n))
        return again

    @property
    def paths_per_sample(self) -> int:
        return len(self.adaptive) if self.adaptive else self.projector.n**2 * self.points.count

    @property
    def connections_per_path(self) -> int:
        return self.points.count

    @property
    def board(self) -> float:
        return self.setup.board

    def _launch(self, flight: integrator.InFlight, accumulator: DeviceAccumulator | None = None) -> list[PathSamples]:
        return ProjectorPaths(self, self._emission(flight)).path_samples(accumulator)

    def _emission(self, flight: integrator.InFlight) -> Emission:
        index, sample, weight = flight.index, flight.sample, 1.0
        if self.adaptive:
            index, sample, weight = self.adaptive.at(index, sample)
        pixel, row, column = self.points.of(index, self.projector.n**2)
        # The first turn is stratified, because a pixel is small but its light leaves the surface in all directions.
        shared, rng = streams(flight.seed, pixel, sample)
        return Emission(pixel, (row, column), rng, sobol_point(sample, shared), weight)


@dataclass
class Emission:
    pixel: mi.UInt32
    anchor: tuple[mi.UInt32, mi.UInt32]
    rng: mi.PCG32
    first_turn: mi.Point2f
    weight: mi.Float | float


class ProjectorPaths(integrator.PathIntegrator[integrator.PathState]):
    IMPORTANCE = True

    def __init__(self, tracer: IndirectTracer, emission: Emission) -> None:
        super().__init__(tracer)
        self.pixel, self.anchor = emission.pixel, emission.anchor
        self.first_turn, rng = emission.first_turn, emission.rng
        wavelengths, spectral = sample_wavelengths(tracer.setup.camera, rng, tracer.projector.lines)
        jitter = mi.Point2f(rng.next_float32(), rng.next_float32())
        ray = tracer.setup.rays.sample(self.pixel, jitter, rng, wavelengths)
        self.flux = tracer.setup.rays.flux(self.pixel, wavelengths) * spectral * emission.weight
        connections = _OneConnection if tracer.points.count == 1 else _AnchorConnections
        self.connections = connections(tracer.points, emission)
        sightings = self.connections.none(("direct", "indirect") if self.rules.mirrors else ("indirect",), self.by_line)
        self.paths = integrator.PathState(active=mi.Bool(True), ray=ray, rng=rng, sightings=sightings)

    def _connect(self, paths: integrator.PathState, si: mi.SurfaceInteraction3f, first: bool) -> None:
        if first:
            return
        drawn = self._draw_numbers(paths)

        def connect(held: Held, number: mi.UInt32) -> None:
            way = self._way(paths, si, self.connections.sensor(number))
            self._keep_light(paths, si, way, drawn, (held, number))

        paths.sightings = self.connections.at_each(paths.sightings, paths.active, connect)

    @staticmethod
    def _draw_numbers(paths: integrator.PathState) -> dict[str, mi.Float]:
        return {kind: paths.rng.next_float32() for kind in ("direct", "indirect")}

    def _way(self, paths: integrator.PathState, si: mi.SurfaceInteraction3f, sensor: mi.Point3f) -> Way:
        # Light that has only passed surfaces belongs to the direct tracer.
        active = paths.active & ~paths.straight
        return self.setup.way(si, sensor, active)

    def _keep_light(
        self,
        paths: integrator.PathState,
        si: mi.SurfaceInteraction3f,
        way: Way,
        drawn: dict[str, mi.Float],
        at: tuple[Held, mi.UInt32],
    ) -> None:
        reception = self.setup.received(si, -paths.ray.d, way)
        light = reception.irradiance * self.flux * paths.throughput
        caustic, part = paths.scattered == 0, 1 - integrator.camera_part(reception.pdf)
        if self.rules.steep:
            part *= integrator.part_over_turn(paths, si, integrator.tilt(si, -paths.ray.d))
        light *= dr.select(caustic, 1, part)
        held, number = at
        for kind, chosen in (("direct", caustic), ("indirect", ~caustic)):
            if kind in held:
                seen = reception.sightings(dr.select(chosen, light, 0), self.pixel, self.by_line)
                joined = self.connections.load(held, kind, number).joined_by(seen, drawn[kind])
                self.connections.save(held, kind, number, joined)

    def path_samples(self, accumulator: DeviceAccumulator | None = None) -> list[PathSamples]:
        paths = self.follow(self.paths)
        if accumulator is None:
            return self.connections.fetch(paths.sightings, tuple(paths.sightings))
        drawn = paths.rng.next_float32()

        def add(held: Held, number: mi.UInt32) -> None:
            seen = self.connections.load(held, "indirect", number)
            place = accumulator.place(seen, drawn, self.connections.anchor(number))
            accumulator.add(seen.by_line(accumulator.lines), seen.pixel, place)

        held = self.connections.at_each(paths.sightings, mi.Bool(True), add)
        caustics = tuple(kind for kind in held if kind == "direct")
        return self.connections.fetch(held, caustics, accumulator.sums)


# -------- Connections of a path: to one point of the sensor, or to every anchor

Held = dict[str, Any]


class _OneConnection:
    def __init__(self, points: SensorPoints, emission: Emission) -> None:
        self._anchor, self._sensor = emission.anchor, points.at(*emission.anchor, emission.rng)

    def none(self, kinds: Sequence[str], by_line: bool) -> Held:
        return {kind: Sightings.none(by_line) for kind in kinds}

    def anchor(self, number: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        return self._anchor

    def sensor(self, number: mi.UInt32) -> mi.Point3f:
        return self._sensor

    def load(self, held: Held, kind: str, number: mi.UInt32) -> Sightings:
        found: Sightings = held[kind]
        return found

    def save(self, held: Held, kind: str, number: mi.UInt32, seen: Sightings) -> None:
        held[kind] = seen

    def at_each(self, held: Held, active: mi.Bool, visit: Callable[[Held, mi.UInt32], None]) -> Held:
        visit(held, mi.UInt32(0))
        return held

    def fetch(self, held: Held, kinds: Sequence[str], also: object = ()) -> list[PathSamples]:
        dr.eval([held[kind] for kind in kinds], self._anchor if kinds else (), also)
        return [PathSamples.fetch(held[kind], integrator.KINDS[kind], self._anchor) for kind in kinds]


class _AnchorConnections(_OneConnection):
    def __init__(self, points: SensorPoints, emission: Emission) -> None:
        self._points, self._pixel = points, emission.pixel
        self._side, self._count = (dr.opaque(mi.UInt32, each) for each in (points.anchors, points.count))

    def none(self, kinds: Sequence[str], by_line: bool) -> Held:
        self._numbers = len(_differing(Sightings.none(by_line)))
        anchors = next((room for room in _ROOMS if room >= self._points.count), self._points.count)
        return {kind: dr.alloc_local(mi.Float, self._numbers * anchors, mi.Float(0)) for kind in kinds}

    def anchor(self, number: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        return number // self._side, number % self._side

    def sensor(self, number: mi.UInt32) -> mi.Point3f:
        return self._points.place(*self.anchor(number), mi.Point2f(0))

    def load(self, held: Held, kind: str, number: mi.UInt32) -> Sightings:
        return _sightings(self._pixel, [held[kind][number * self._numbers + place] for place in range(self._numbers)])

    def save(self, held: Held, kind: str, number: mi.UInt32, seen: Sightings) -> None:
        for place, value in enumerate(_differing(seen)):
            held[kind][number * self._numbers + place] = value

    def at_each(self, held: Held, active: mi.Bool, visit: Callable[[Held, mi.UInt32], None]) -> Held:
        def step(number: mi.UInt32, held: Held) -> tuple[mi.UInt32, Held]:
            visit(held, number)
            return number + 1, held

        found: Held = dr.while_loop((mi.UInt32(0), held), lambda number, _: active & (number < self._count), step)[1]
        return found

    def fetch(self, held: Held, kinds: Sequence[str], also: object = ()) -> list[PathSamples]:
        paths = dr.width(self._pixel)
        size, first = paths * self._points.count, dr.arange(mi.UInt32, paths) * self._count
        found = {kind: [dr.zeros(mi.Float, size) for _ in range(self._numbers)] for kind in kinds}

        def unpack(held: Held, number: mi.UInt32) -> None:
            for kind, values in found.items():
                for into, value in zip(values, _differing(self.load(held, kind, number)), strict=True):
                    dr.scatter(into, value, first + number)

        if kinds:
            self.at_each(held, mi.Bool(True), unpack)
        dr.eval(found, self._pixel, also)
        index = dr.arange(mi.UInt32, size)
        pixel, anchor = dr.gather(mi.UInt32, self._pixel, index // self._count), self.anchor(index % self._count)
        return [
            PathSamples.fetch(_sightings(pixel, values), integrator.KINDS[kind], anchor)
            for kind, values in found.items()
        ]


def _differing(seen: Sightings) -> list[mi.Float]:
    lines = () if seen.lines is None else seen.lines
    return [seen.value, seen.row, seen.column, seen.inverse_depth, *lines]


def _sightings(pixel: mi.UInt32, differing: Sequence[mi.Float]) -> Sightings:
    value, row, column, inverse_depth, *lines = differing
    return Sightings(value, pixel, row, column, inverse_depth, mi.UnpolarizedSpectrum(*lines) if lines else None)


# -------- Adaptive sampling: blocks of projector pixels whose light is followed more often than that of others
#
# From how noisy each block's light is to how many paths each takes in a sample, and from a lane to its block. With m_b
# the second moment of a path's light, paths in proportion to sqrt(m_b) leave the least variance for their number; a
# sample holds the mean of a block's paths, so that the light stays what it is whatever the numbers.

SIDE = 4
"""Pixels along an axis of a block: fewer than the 7 of usual shifting dots, whose classes then differ."""
MEMBERS = SIDE**2
_MOST = 8
_SCALES = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)


def blocks_of(pixels: int) -> int:
    return -(-pixels // SIDE)


def block_moments(pixel: npt.NDArray[np.int64], light: FloatArray, pixels: int) -> FloatArray:
    row, column = np.divmod(pixel, pixels)
    count = blocks_of(pixels)
    place = row // SIDE * count + column // SIDE
    return np.asarray(np.bincount(place, np.square(light), count**2).reshape(count, count), dtype=np.float64)


def adaptive_counts(moments: FloatArray) -> npt.NDArray[np.int64]:
    """Return the paths (blocks, blocks) of each block's pixels in a sample, of least variance times cost.

    Blocks without light count a tenth of the mean.
    """
    if not moments.any():
        return np.ones(moments.shape, dtype=np.int64)
    smooth = mean_of_neighbours(moments)
    wanted = np.sqrt(smooth + 0.1 * smooth.mean())
    tried = [np.clip(np.rint(scale * wanted / wanted.mean()), 1, _MOST).astype(np.int64) for scale in _SCALES]
    return min(tried, key=lambda repeats: float(np.prod(effect_of(repeats, smooth))))


def effect_of(repeats: npt.NDArray[np.int64], moments: FloatArray) -> tuple[float, float]:
    total = float(moments.sum())
    return float((moments / repeats).sum()) / total if total else 1.0, float(repeats.mean())


@dataclass(frozen=True, eq=False)
class AdaptiveSamples:
    unit: mi.UInt32
    turn: mi.UInt32
    count: mi.UInt32

    @classmethod
    def of(cls, repeats: npt.NDArray[np.int64]) -> AdaptiveSamples:
        unit = np.repeat(np.arange(len(repeats)), repeats)
        starts = np.cumsum(repeats) - repeats
        turn = np.arange(len(unit)) - starts[unit]
        return cls(*(mi.UInt32(each.astype(np.uint32)) for each in (unit, turn, repeats[unit])))

    def __len__(self) -> int:
        return int(dr.width(self.unit))

    def at(self, index: mi.UInt32, sample: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
        unit, turn, count = (dr.gather(mi.UInt32, each, index) for each in (self.unit, self.turn, self.count))
        return unit, sample * count + turn, dr.rcp(mi.Float(count))


def by_pixel(repeats: Sequence[int], pixels: int) -> npt.NDArray[np.int64]:
    count = blocks_of(pixels)
    whole = np.kron(np.reshape(repeats, (count, count)), np.ones((SIDE, SIDE), dtype=np.int64))
    return np.ascontiguousarray(whole[:pixels, :pixels]).ravel()
