"""The path loop, from a scene and the places where paths start and connect to the light that they bring to the camera.

Direct light draws no direction, and specular chains are traced on the host in double precision; both have own loops.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.environment import keep_scenes
from mitsim.core.job import compiled_kernels
from mitsim.scene.load import holds_hair
from mitsim.transport.connect import OpticalSetup, SensorPoints
from mitsim.transport.records import AMBIENT, DIRECT, INDIRECT, DeviceAccumulator, PathSamples

if TYPE_CHECKING:
    from typing import Self


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


class Tracer(ABC):
    paths_per_launch: ClassVar[int] = PATHS_PER_LAUNCH

    def __init__(self, setup: OpticalSetup, points: SensorPoints | None = None) -> None:
        self.setup, self.projector = setup, setup.projector
        self.points = points or SensorPoints(setup.geometry.half_width)

    @property
    @abstractmethod
    def paths_per_sample(self) -> int:
        """Paths, or connections, of one sample."""

    @property
    def connections_per_path(self) -> int:
        return 1

    @property
    def per_wavelength(self) -> Sequence[Self]:
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


@dataclass(frozen=True)
class Paths:
    """Light that is followed besides projector - surface - camera.

    ``steep`` divides light that shading normals or hair make heavy between both sides (:func:`projector_part`).
    """

    mirrors: bool = False
    interreflection: bool = False
    emitters: tuple[mi.Emitter, ...] = ()
    steep: bool = False


class FollowingTracer(Tracer):
    """Tracer of light over any number of surfaces.

    The *order* of light is the number of surfaces that have turned it and are no mirrors; a lamp in view has 0.
    """

    def __init__(self, setup: OpticalSetup, paths: Paths, points: SensorPoints | None = None) -> None:
        super().__init__(setup, points)
        self.paths = paths

    @property
    def by_line(self) -> bool:
        return self.projector.by_line


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

    def __init__(self, tracer: FollowingTracer) -> None:
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

    def scatter(self, paths: State, si: mi.SurfaceInteraction3f, first: bool) -> None:
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

    def _run_into(self, paths: State, si: mi.SurfaceInteraction3f, first: bool) -> None:
        """Keep light that paths meet on their way; none from the projector's side."""

    @abstractmethod
    def _connect(self, paths: State, si: mi.SurfaceInteraction3f, first: bool) -> None:
        """Keep light that the vertices send to the sensor, or along their paths."""

    def _note_turn(self, paths: State, si: mi.SurfaceInteraction3f, turn: Turn, first: bool) -> mi.Bool:
        return mi.Bool(True)


def is_delta(sample: mi.BSDFSample3f) -> mi.Bool:
    mirror = int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.DeltaTransmission)
    return (sample.sampled_type & mirror) != 0


def shading_correction(
    si: mi.SurfaceInteraction3f, local: mi.Vector3f, onward: mi.Vector3f, toward: mi.Vector3f
) -> mi.Float:
    """Return the factor of light followed forward, which sees shading normals the other way (Veach 1997, 5.3)."""
    correction = mi.Frame3f.cos_theta(si.wi) * dr.dot(si.n, onward)
    return correction / (mi.Frame3f.cos_theta(local) * dr.dot(si.n, toward))


def tilt(si: mi.SurfaceInteraction3f, direction: mi.Vector3f) -> mi.Float:
    return dr.dot(si.sh_frame.n, direction) / dr.dot(si.n, direction)


def part_over_turn(paths: PathState, si: mi.SurfaceInteraction3f, correction: mi.Float) -> mi.Float:
    """Return the part of the light over the next turn that is followed from the projector.

    For a first turn it is :func:`matt_part`, after a mirror one, because the camera's side finds nothing there.
    """
    later = dr.select(paths.scattered > 0, projector_part(si, correction), matt_part(si))
    return dr.select(paths.depth == paths.scattered, later, 1)


def projector_part(si: mi.SurfaceInteraction3f, correction: mi.Float) -> mi.Float:
    """Return the part of the light over a later turn that is followed from the projector.

    A shading normal's correction may grow without bound for grazing light, so that the variance would be infinite.
    """
    return matt_part(si) * dr.select(dr.abs(correction) > _STEEP, _STEEP / dr.abs(correction), 1)


def matt_part(si: mi.SurfaceInteraction3f) -> mi.Float:
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
