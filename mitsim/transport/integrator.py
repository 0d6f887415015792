"""The path loop, from a scene and the places where paths start and connect to the light that they bring to the camera.

Direct light draws no direction, and specular chains are traced on the host in double precision; both have own loops.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar, Generic, TypeAlias, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray, mean_of_neighbours
from mitsim.core.environment import device_array, keep_scenes
from mitsim.core.job import compiled_kernels
from mitsim.scene.load import holds_hair
from mitsim.transport.connect import OpticalSetup, SensorPoints, Way, sample_wavelengths
from mitsim.transport.plugins.base import Surface, sobol_point, streams
from mitsim.transport.records import AMBIENT, DIRECT, INDIRECT, Anchor, DeviceAccumulator, PathSamples, Sightings

KINDS = MappingProxyType({"direct": DIRECT, "indirect": INDIRECT, "ambient": AMBIENT})
PATHS_PER_LAUNCH = 2**22
_SHARP = 1.0
"""Density [1/sr] of a turn above which the camera follows its light: three times a matt surface's 0.32."""
_STEEP = 64.0
"""Factor of a later turn's shading normal above which the camera follows its light (cookie_bag: 0.02 %)."""
_MIRRORS = 16
_LONGEST = 0.999
"""Largest chance to go on, so that paths end even where nothing is absorbed.

In a closed room of reflectance rho the light of a path grows by rho / chance a reflection, and its second moment is
finite only while rho^2 < chance. A chance of 0.95 lost 10 % of the light at reflectance 0.99, 79 % at 0.999.
"""
_NOTED = 32
_LEAST_CHANCE = 1e-6


def launches(
    paths_per_sample: int, first: int, samples: int, at_once: int = PATHS_PER_LAUNCH
) -> Iterator[tuple[mi.UInt32, mi.UInt32]]:
    total, start = paths_per_sample * samples, paths_per_sample * first
    for done in range(0, total, at_once):
        index = dr.arange(mi.UInt64, min(at_once, total - done)) + dr.opaque(mi.UInt64, start + done)
        # An opaque number keeps the compiled kernel the same for every count.
        per_sample = dr.opaque(mi.UInt64, paths_per_sample)
        yield mi.UInt32(index // per_sample), mi.UInt32(index % per_sample)


@dataclass(frozen=True, eq=False)
class InFlight:
    seed: mi.UInt32
    sample: mi.UInt32
    index: mi.UInt32


@dataclass(frozen=True)
class Paths:
    """Light that is followed besides projector - surface - camera.

    ``steep`` divides light that shading normals or hair make heavy between both sides (:func:`projector_part`).
    """

    mirrors: bool = False
    interreflection: bool = False
    emitters: tuple[mi.Emitter, ...] = ()
    steep: bool = False


class Tracer(ABC):
    """Tracer of light over one surface, or of all light that ``paths`` name.

    The *order* of light is the number of surfaces that have turned it and are no mirrors; a lamp in view has 0.
    """

    paths_per_launch: ClassVar[int] = PATHS_PER_LAUNCH
    brightest: ClassVar[float] = 1.0

    def __init__(self, setup: OpticalSetup, paths: Paths | None = None, points: SensorPoints | None = None) -> None:
        self.setup, self.projector, self.paths = setup, setup.projector, paths or Paths()
        self.points = points or SensorPoints(setup.geometry.half_width)

    @property
    @abstractmethod
    def paths_per_sample(self) -> int:
        """Paths, or connections, of one sample."""

    @property
    def connections_per_path(self) -> int:
        return 1

    @property
    def by_line(self) -> bool:
        return self.projector.by_line

    @property
    def board(self) -> float:
        return self.brightest * self.setup.board

    @property
    def per_wavelength(self) -> Sequence[Any]:
        projectors = self.projector.per_wavelength
        if len(projectors) == 1:
            return [self]
        tracers = [copy(self) for _ in projectors]
        for tracer, projector in zip(tracers, projectors, strict=True):
            tracer.projector = projector
        return tracers

    @abstractmethod
    def _launch(self, flight: InFlight, accumulator: DeviceAccumulator | None = None) -> list[PathSamples]:
        """Trace the paths of one kernel."""

    def _flights(self, seeds: Sequence[int], first: int, samples: int) -> Iterator[InFlight]:
        count = self.connections_per_path
        at_once = max(1, self.paths_per_launch // count)
        # Looked up, also where there is but one, so that one kernel serves any number; Dr.Jit looks nothing up in one.
        known, each = mi.UInt32([*seeds, seeds[-1]]), dr.opaque(mi.UInt32, samples)
        for number, index in launches(self.paths_per_sample // count, 0, len(seeds) * samples, at_once):
            place = number // each
            sample = number - place * each + dr.opaque(mi.UInt32, first)
            yield InFlight(dr.gather(mi.UInt32, known, place), sample, index)

    @keep_scenes()
    def replicates(self, seeds: Sequence[int], *samples: int, first: int = 0) -> list[list[PathSamples]]:
        each, most = self.paths_per_sample, samples[-1]
        starts = [each * most * place for place in range(len(seeds))]
        ranges = np.array([(start, start + each * count) for count in samples for start in starts])
        found: list[list[PathSamples]] = [[] for _ in ranges]
        for tracer in self.per_wavelength:
            before = 0
            for flight in tracer._flights(seeds, first, most):
                for launched in tracer._launch(flight):
                    assert launched.lane is not None, "as it was fetched"
                    for own, part in zip(found, np.searchsorted(launched.lane, ranges - before).tolist(), strict=True):
                        own.append(launched.where(slice(*part)))
                before += dr.width(flight.index) * self.connections_per_path
        compiled_kernels()
        joined = list(map(PathSamples.join, found))
        return [joined[start : start + len(seeds)] for start in range(0, len(joined), len(seeds))]

    @keep_scenes()
    def trace(
        self, seed: int, first: int = 0, samples: int = 1, accumulator: DeviceAccumulator | None = None
    ) -> PathSamples:
        """Return the light of samples from ``first`` on, except for that in an accumulator.

        The accumulator's unit is ``board``; the camera's side fills none. Raises MitsimError for NaN or infinite light.
        """
        parts = list[PathSamples]()
        for tracer in self.per_wavelength:
            for flight in tracer._flights([seed], first, samples):
                parts += tracer._launch(flight, accumulator)
        if accumulator is not None:
            accumulator.traced += 1
        # If all light is fetched, nothing remains to be awaited.
        if accumulator is None or accumulator.traced % _NOTED == 0:
            compiled_kernels()
        return PathSamples.join(parts)


# -------- The path loop


@dataclass(kw_only=True)
class PathState:
    """Buffer of paths under way.

    ``depth`` and ``scattered`` count the vertices that turned the path, with and without mirrors. ``straight`` paths
    have only passed surfaces and belong to direct light.
    """

    active: mi.Bool
    ray: mi.Ray3f
    rng: mi.PCG32
    sightings: Any
    throughput: mi.Spectrum = field(default_factory=lambda: mi.Spectrum(1))
    depth: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))
    scattered: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))
    straight: mi.Bool = field(default_factory=lambda: mi.Bool(True))


State = TypeVar("State", bound=PathState)


@dataclass
class Turn:
    sample: mi.BSDFSample3f
    passing: mi.Bool
    delta: mi.Bool


class PathIntegrator(ABC, Generic[State]):
    """Paths of one launch, followed from vertex to vertex: the first apart, all others in a loop of one kernel.

    A subclass defines where paths start and the light that they bring from a vertex.
    """

    IMPORTANCE: ClassVar[bool]

    first_turn: mi.Point2f | None = None

    def __init__(self, tracer: Tracer) -> None:
        self.rules, self.setup, self.by_line = tracer.paths, tracer.setup, tracer.by_line
        self.scene, self.passage = tracer.setup.scene, tracer.setup.passage
        self.followed = self.rules.mirrors or self.rules.interreflection or self.passage.open

    def follow(self, paths: State) -> State:
        self.vertex(paths, first=True)
        return self.follow_on(paths) if self.followed else paths

    def follow_on(self, paths: State) -> State:
        def further(paths: State) -> tuple[State]:
            self.vertex(paths, first=False)
            return (paths,)

        return dr.while_loop((paths,), lambda paths: paths.active, further)[0]  # type: ignore[no-any-return]

    def vertex(self, paths: State, first: bool) -> None:
        # ---- Surface interaction: to the first one rays of neighbours go side by side, in half the time of others
        si = self.scene.ray_intersect(paths.ray, mi.RayFlags.All, first, paths.active)

        # ---- Lights that paths have run into
        self._run_into(paths, si, first)
        paths.active &= si.is_valid()

        # ---- Connections to the sensor, or to lights
        self._connect(paths, si, first)

        # ---- On to the next vertex
        if self.followed:
            self.scatter(paths, si, first)

    def scatter(self, paths: State, si: Surface, first: bool) -> None:
        # ---- BSDF sample; the connection may have looked at the surface from elsewhere
        toward, rules = -paths.ray.d, self.rules
        si.wi = si.to_local(toward)
        number, point = paths.rng.next_float32(), mi.Point2f(paths.rng.next_float32(), paths.rng.next_float32())
        if first and self.first_turn is not None:
            point = self.first_turn
        mode = mi.TransportMode.Importance if self.IMPORTANCE else mi.TransportMode.Radiance
        sample, value = si.bsdf().sample(mi.BSDFContext(mode), si, number, point, paths.active)
        onward, weight = si.to_world(sample.wo), mi.unpolarized_spectrum(value)
        passing, mirrored = self.passage.passes(si, sample), is_delta(sample)
        going = paths.active & (sample.pdf > 0)
        if not rules.interreflection:
            going &= (mirrored & rules.mirrors) | passing
        elif not rules.mirrors:
            going &= ~mirrored | passing
        turn = Turn(sample, passing, mirrored & ~passing)
        going &= self._note_turn(paths, si, turn, first)

        # ---- Throughput
        if self.IMPORTANCE:
            corrected = shading_correction(si, sample.wo, onward, toward)
            weight *= dr.select(dr.isfinite(corrected), dr.abs(corrected), 0)
            if rules.steep:
                weight *= dr.select(mirrored | passing, 1, part_over_turn(paths, si, corrected))
        paths.throughput *= weight

        # ---- Russian roulette; chains of mirrors are short and full of light, and light that only passes goes on
        paths.depth += dr.select(passing, mi.UInt32(0), mi.UInt32(1))
        if not first:
            chain = paths.scattered == 0
            if self.IMPORTANCE:
                chain &= turn.delta
            carried = dr.minimum(dr.max(paths.throughput), _LONGEST)
            chance = dr.select((chain & (paths.depth < _MIRRORS)) | passing, 1, carried)
            going &= paths.rng.next_float32() < chance
            paths.throughput *= dr.rcp(dr.maximum(chance, _LEAST_CHANCE))
        paths.active = going & (dr.max(paths.throughput) > 0)

        # ---- Order of the light, and the next ray
        paths.scattered += dr.select(turn.delta | passing, mi.UInt32(0), mi.UInt32(1))
        if first or self.passage.open:
            paths.straight &= passing
        paths.ray = self.passage.leaving(si, onward)

    def _run_into(self, paths: State, si: Surface, first: bool) -> None:
        """Keep light that paths meet on their way; none from the projector's side."""

    @abstractmethod
    def _connect(self, paths: State, si: Surface, first: bool) -> None:
        """Keep light that the vertices send to the sensor, or along their paths."""

    def _note_turn(self, paths: State, si: Surface, turn: Turn, first: bool) -> mi.Bool:
        return mi.Bool(True)


def is_delta(sample: mi.BSDFSample3f) -> mi.Bool:
    mirror = int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.DeltaTransmission)
    return (sample.sampled_type & mirror) != 0


def shading_correction(si: Surface, local: mi.Vector3f, onward: mi.Vector3f, toward: mi.Vector3f) -> mi.Float:
    """Return the factor of light followed forward, which sees shading normals the other way (Veach 1997, 5.3)."""
    correction = mi.Frame3f.cos_theta(si.wi) * dr.dot(si.n, onward)
    return correction / (mi.Frame3f.cos_theta(local) * dr.dot(si.n, toward))


def tilt(si: Surface, direction: mi.Vector3f) -> mi.Float:
    return dr.dot(si.sh_frame.n, direction) / dr.dot(si.n, direction)


def part_over_turn(paths: PathState, si: Surface, correction: mi.Float) -> mi.Float:
    """Return the part of the light over the next turn that is followed from the projector.

    For a first turn it is :func:`matt_part`, after a mirror one, because the camera's side finds nothing there.
    """
    later = dr.select(paths.scattered > 0, projector_part(si, correction), matt_part(si))
    return dr.select(paths.depth == paths.scattered, later, 1)


def projector_part(si: Surface, correction: mi.Float) -> mi.Float:
    """Return the part of the light over a later turn that is followed from the projector.

    A shading normal's correction may grow without bound for grazing light, so that the variance would be infinite.
    """
    return matt_part(si) * dr.select(dr.abs(correction) > _STEEP, _STEEP / dr.abs(correction), 1)


def matt_part(si: Surface) -> mi.Float:
    """Return 0 for hair, whose light is followed from the camera, and 1 elsewhere.

    Mitsuba samples hair for a view. Forward, its values over the density have no bound, and single paths dominate.
    """
    return dr.select(holds_hair(si.bsdf().flags()), mi.Float(0), 1)


def camera_part(pdf: mi.Float) -> mi.Float:
    """Return the part of the light over the last turn before the sensor that is followed from the camera.

    Both sides know the density ``pdf`` [1/sr] of sampling the turn from the camera's side, so the parts add up to one.
    A connection to a lobe sharper than ``_SHARP`` keeps ``_SHARP / pdf`` of its light, so that it is bounded.
    """
    return dr.select(pdf > _SHARP, 1 - _SHARP * dr.rcp(pdf), 0)


# -------- Indirect light from the projector's side: every pixel's rays, followed over any number of surfaces
#
# After the first surface a path is connected at each surface to the sensor. Of the connections of a path to one anchor,
# one is drawn in proportion to its light, and carries the light of all.
#
# Connections rarely meet the lobe of a last surface that turns light sharply; there the camera's side finds the light
# (camera_part). Light that only mirrors have turned before the last surface (a caustic) belongs to direct light.

_ROOMS = (4**2, 12**2)
Held: TypeAlias = "dict[str, Any]"


class IndirectTracer(Tracer):
    adaptive: AdaptiveSamples | None = None
    in_blocks: ClassVar[bool] = False

    def with_adaptive_counts(self, repeats: Sequence[int]) -> IndirectTracer:
        again, n = copy(self), self.projector.n
        counts = np.asarray(repeats, dtype=np.int64) if self.in_blocks else by_pixel(repeats, n)
        again.adaptive = AdaptiveSamples.of(counts)
        return again

    @property
    def paths_per_sample(self) -> int:
        return len(self.adaptive) if self.adaptive else self.projector.n**2 * self.points.count

    @property
    def connections_per_path(self) -> int:
        return self.points.count

    def _launch(self, flight: InFlight, accumulator: DeviceAccumulator | None = None) -> list[PathSamples]:
        return ProjectorPaths(self, flight).path_samples(accumulator)

    def emission(self, flight: InFlight) -> tuple[Any, ...]:
        """Return pixels, anchors, random numbers, points of first turns and weights of paths."""
        index, sample, weight = flight.index, flight.sample, 1.0
        if self.adaptive:
            index, sample, weight = self.adaptive.at(index, sample)
        pixel, row, column = self.points.of(index, self.projector.n**2)
        # The first turn is stratified, because a pixel is small but its light leaves the surface in all directions.
        shared, rng = streams(flight.seed, pixel, sample)
        return pixel, (row, column), rng, sobol_point(sample, shared), weight


class ProjectorPaths(PathIntegrator[PathState]):
    IMPORTANCE = True

    def __init__(self, tracer: IndirectTracer, flight: InFlight) -> None:
        super().__init__(tracer)
        pixel, anchor, rng, self.first_turn, weight = tracer.emission(flight)
        self.pixel = pixel
        wavelengths, spectral = sample_wavelengths(tracer.setup.camera, rng, tracer.projector.lines)
        jitter = mi.Point2f(rng.next_float32(), rng.next_float32())
        ray = tracer.setup.rays.sample(pixel, jitter, rng, wavelengths)
        self.flux = tracer.setup.rays.flux(pixel, wavelengths) * spectral * weight
        connections = _OneConnection if tracer.points.count == 1 else _AnchorConnections
        self.connections = connections(tracer.points, pixel, anchor, rng)
        sightings = self.connections.none(("direct", "indirect") if self.rules.mirrors else ("indirect",), self.by_line)
        self.paths = PathState(active=mi.Bool(True), ray=ray, rng=rng, sightings=sightings)

    def _connect(self, paths: PathState, si: Surface, first: bool) -> None:
        if first:
            return
        drawn = {kind: paths.rng.next_float32() for kind in ("direct", "indirect")}

        def connect(held: Held, number: mi.UInt32) -> None:
            # Light that has only passed surfaces belongs to the direct tracer.
            way = self.setup.way(si, self.connections.sensor(number), paths.active & ~paths.straight)
            self._keep_light(paths, si, way, drawn, (held, number))

        paths.sightings = self.connections.at_each(paths.sightings, paths.active, connect)

    def _keep_light(self, paths: PathState, si: Surface, way: Way, drawn: Held, at: tuple[Held, mi.UInt32]) -> None:
        reception = self.setup.received(si, -paths.ray.d, way)
        light = reception.irradiance * self.flux * paths.throughput
        caustic, part = paths.scattered == 0, 1 - camera_part(reception.pdf)
        if self.rules.steep:
            part *= part_over_turn(paths, si, tilt(si, -paths.ray.d))
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


class _OneConnection:
    def __init__(self, points: SensorPoints, pixel: mi.UInt32, anchor: Anchor, rng: mi.PCG32) -> None:
        self._anchor, self._sensor = anchor, points.at(*anchor, rng)

    def none(self, kinds: Sequence[str], by_line: bool) -> Held:
        return {kind: Sightings.none(by_line) for kind in kinds}

    def anchor(self, number: mi.UInt32) -> Anchor:
        return self._anchor

    def sensor(self, number: mi.UInt32) -> mi.Point3f:
        return self._sensor

    def load(self, held: Held, kind: str, number: mi.UInt32) -> Sightings:
        return held[kind]  # type: ignore[no-any-return]

    def save(self, held: Held, kind: str, number: mi.UInt32, seen: Sightings) -> None:
        held[kind] = seen

    def at_each(self, held: Held, active: mi.Bool, visit: Callable[[Held, mi.UInt32], None]) -> Held:
        visit(held, mi.UInt32(0))
        return held

    def fetch(self, held: Held, kinds: Sequence[str], also: object = ()) -> list[PathSamples]:
        dr.eval([held[kind] for kind in kinds], self._anchor if kinds else (), also)
        return [PathSamples.fetch(held[kind], KINDS[kind], self._anchor) for kind in kinds]


class _AnchorConnections(_OneConnection):
    def __init__(self, points: SensorPoints, pixel: mi.UInt32, anchor: Anchor, rng: mi.PCG32) -> None:
        self._points, self._pixel = points, pixel
        self._side, self._count = (dr.opaque(mi.UInt32, each) for each in (points.anchors, points.count))

    def none(self, kinds: Sequence[str], by_line: bool) -> Held:
        self._numbers = len(_differing(Sightings.none(by_line)))
        anchors = next((room for room in _ROOMS if room >= self._points.count), self._points.count)
        return {kind: dr.alloc_local(mi.Float, self._numbers * anchors, mi.Float(0)) for kind in kinds}

    def anchor(self, number: mi.UInt32) -> Anchor:
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

        return dr.while_loop((mi.UInt32(0), held), lambda number, _: active & (number < self._count), step)[1]  # type: ignore[no-any-return]

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
        return [PathSamples.fetch(_sightings(pixel, values), KINDS[kind], anchor) for kind, values in found.items()]


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
        return cls(*(device_array(mi.UInt32, each) for each in (unit, turn, repeats[unit])))

    def __len__(self) -> int:
        return int(dr.width(self.unit))

    def at(self, index: mi.UInt32, sample: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
        unit, turn, count = (dr.gather(mi.UInt32, each, index) for each in (self.unit, self.turn, self.count))
        return unit, sample * count + turn, dr.rcp(mi.Float(count))


def by_pixel(repeats: Sequence[int], pixels: int) -> npt.NDArray[np.int64]:
    count = blocks_of(pixels)
    whole = np.kron(np.reshape(repeats, (count, count)), np.ones((SIDE, SIDE), dtype=np.int64))
    return np.ascontiguousarray(whole[:pixels, :pixels]).ravel()
