"""Indirect light from the projector's side: every pixel's rays, followed over any number of surfaces to the sensor.

At each surface after the first the light that a path carries is connected to the sensor: its centre, a random point,
or each of several anchors, for which a path is the same and is followed once (:mod:`mitsim.transport.connect`). So
every path that meets a second surface counts, and it counts for its own pixel. Of the connections of a path, to one
anchor, one is handed out, drawn in proportion to its light, and it carries the light of all.

Where the last surface turns light sharply, connections rarely meet the lobe; there the camera's side
(:mod:`mitsim.transport.from_camera`) finds the light instead. :func:`mitsim.transport.integrator.camera_part` divides
it.

Light that only mirrors have turned before the last surface (a caustic) is direct light; the camera's side has no part
in it. Paths end at random (Russian roulette) with a probability that keeps the estimate unbiased.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray, mean_of_neighbours
from mitsim.devices.camera import CameraGeometry
from mitsim.transport.accumulator import Ledger
from mitsim.transport.connect import Receiver, SensorPoints, Way, sampled_wavelengths
from mitsim.transport.integrator import KINDS, FollowingTracer, Walk, camera_part, is_delta
from mitsim.transport.projector import ProjectorOptics, ProjectorRays
from mitsim.transport.records import DIRECT, Deposits, Sightings
from mitsim.transport.sampler import stratified, streams

_ROOMS = (4**2, 12**2)
"""Anchors that a path has room for: few numbers of them, as each is a kernel of its own, 0.4 s to compile; more
than the most that a plan tries are a kernel for each number."""


class IndirectTracer(FollowingTracer):
    """Indirect light of a projector, and its caustics, at points of the sensor."""

    def __init__(
        self,
        scene: mi.Scene,
        camera: mi.Sensor,
        projector: ProjectorOptics,
        mirrors: bool,
        interreflection: bool,
        geometry: CameraGeometry | None = None,
        points: SensorPoints | None = None,
    ) -> None:
        """What is followed.

        Parameters
        ----------
        scene, camera, projector
            as loaded.
        mirrors, interreflection
            paths over delta reflections and transmissions, and over other surfaces.
        geometry
            stands in for the camera's own.
        points
            where to; the sensor's centre if not given.
        """
        self.scene, self.projector, self.mirrors, self.interreflection = scene, projector, mirrors, interreflection
        self.rays, self.receiver = ProjectorRays(projector), Receiver(scene, camera, geometry)
        self.points = points or SensorPoints(self.receiver.geometry.half_width)
        self.turns: Turns | None = None

    def repeating(self, repeats: Sequence[int]) -> IndirectTracer:
        """The same to one point of the sensor, blocks of pixels (:mod:`mitsim.transport.indirect`) as often as
        ``repeats`` (blocks^2,) say."""
        return self._taking(by_pixel(repeats, self.projector.n))

    def _taking(self, repeats: npt.NDArray[np.int64]) -> IndirectTracer:
        """The same with ``repeats`` of single pixels, or of what else it counts."""
        again = copy(self)
        again.turns = Turns.of(repeats)
        return again

    @property
    def lanes(self) -> int:
        """Paths of one sample: one per projector pixel and anchor, or as often as they are repeated."""
        return len(self.turns) if self.turns else self.projector.n**2 * self.points.count

    @property
    def per_lane(self) -> int:
        """Anchors that each lane follows its path to: all of them."""
        return self.points.count

    @cached_property
    def board(self) -> float:
        """Irradiance [W m^-2] that light compares to."""
        return self.receiver.of_board(self.rays)

    def trace_into(self, ledgers: Sequence[Ledger], seed: int, first: int, samples: int) -> Deposits:
        """The same as :meth:`trace`, indirect light filed in ledgers as far as it can be: the rest, on the host.

        Parameters
        ----------
        ledgers
            of light by pixel, whose unit is :attr:`board`; of several lines, one for each.
        seed, first, samples
            as for :meth:`trace`.
        """
        launched = [
            tracer._walk(seed, *launch).file(ledgers)
            for tracer in self.apart
            for launch in self._launches(first, samples)
        ]
        return Deposits.joined([deposits for parts in launched for deposits in parts])

    def _launch(self, seed: mi.UInt32, sample: mi.UInt32, lane: mi.UInt32) -> list[Deposits]:
        return self._walk(seed, sample, lane).deposits(further=True)

    def _walk(self, seed: int | mi.UInt32, sample: mi.UInt32, lane: mi.UInt32) -> IndirectWalk:
        return (IndirectWalk if self.points.count == 1 else AnchorsWalk)(self, seed, sample, lane)


class IndirectWalk(Walk):
    """Paths from the projector's pixels."""

    STATE = ("active", "ray", "strength", "bounce", "scattered", "straight", "rng", "kept")

    def __init__(self, tracer: IndirectTracer, seed: int | mi.UInt32, sample: mi.UInt32, lane: mi.UInt32) -> None:
        """Paths before their first surface.

        Parameters
        ----------
        tracer
            what is followed.
        seed, sample, lane
            of the random numbers; the lane tells pixel and anchor.
        """
        super().__init__(
            tracer.receiver.passage, tracer.mirrors, tracer.interreflection, tracer.orders, tracer.projector.by_line
        )
        self.tracer = tracer
        weight = self._place(sample, lane)
        self._begin(seed)
        wavelengths, spectral = sampled_wavelengths(tracer.receiver.camera, self.rng, tracer.projector.lines)
        jitter = mi.Point2f(self.rng.next_float32(), self.rng.next_float32())
        self.ray = tracer.rays.sample(self.pixel, jitter, self.rng, wavelengths)
        self.flux = tracer.rays.flux(self.pixel, wavelengths) * spectral * weight
        self.strength, self.active = mi.Spectrum(1), mi.Bool(True)
        self.bounce, self.scattered = mi.UInt32(0), mi.UInt32(0)
        self.sensor = tracer.points.at(*self.anchor, self.rng)

    def _place(self, sample: mi.UInt32, lane: mi.UInt32) -> mi.Float | float:
        """Pixel, anchor and sample of each path; its weight."""
        weight: mi.Float | float = 1.0
        if self.tracer.turns:
            lane, sample, weight = self.tracer.turns.at(lane, sample)
        self.pixel, row, column = self.tracer.points.of(lane, self.tracer.projector.n**2)
        self.anchor, self.sample = (row, column), sample
        return weight

    def _begin(self, seed: int | mi.UInt32) -> None:
        """Random numbers of each path, and the points that its first turn is drawn by."""
        # Stratified where it tells most: a pixel is small, but its light goes every way from the first surface.
        shared, self.rng = streams(seed, self.pixel, self.sample)
        self.first_turn = stratified(self.sample, shared)

    def file(self, ledgers: Sequence[Ledger]) -> list[Deposits]:
        """Follow all paths; indirect light goes into ``ledgers``, caustics to the host."""
        self.follow(further=True)
        seen = self.kept["indirect"]
        place = ledgers[0].place(seen, self.rng.next_float32(), self.anchor)
        for ledger, light in zip(ledgers, seen.by_line(len(ledgers)), strict=True):
            ledger.add(light, seen.pixel, place, ~(light == 0))  # not a number is light to be refused
        caustics = self.kept["direct"] if self.tracer.mirrors else None
        # Together: apart, each would follow all paths again.
        dr.eval(caustics, [ledger.sums for ledger in ledgers])
        return [Deposits.fetched(caustics, DIRECT, self.anchor)] if caustics else []

    def vertex(self, first: bool) -> None:
        """Find, connect and leave the next surface, as :meth:`mitsim.transport.integrator.Walk.vertex` does; ``first``
        is not connected."""
        # To the first surface rays of neighbouring pixels go side by side, which take half the time of others.
        si = self.scene.ray_intersect(self.ray, mi.RayFlags.All, first, self.active)
        self.active &= si.is_valid()
        if not first:
            self._connect(si)
        self._leave(si, first)

    def _connect(self, si: mi.SurfaceInteraction3f) -> None:
        """Light that this surface sends to the sensor."""
        self._take(si, self._way(si))

    def _way(self, si: mi.SurfaceInteraction3f) -> Way:
        """To the sensor, for light that is kept."""
        # Light that has met nothing but what it passes is the direct tracer's.
        active = self.active & ~self.straight & self._wanted(self.scattered + 1)
        return self.tracer.receiver.way(si, self.sensor, active)

    def _take(self, si: mi.SurfaceInteraction3f, way: Way) -> None:
        """Keep the light that a surface sends by a ``way``."""
        reception = self.tracer.receiver.received(si, -self.ray.d, way)
        light = reception.irradiance * self.flux * self.strength
        caustic = self.scattered == 0
        light *= dr.select(caustic, 1, 1 - camera_part(reception.pdf))
        for kind, chosen in (("direct", caustic), ("indirect", ~caustic)):
            self._keep(kind, reception.sightings(dr.select(chosen, light, 0), self.pixel, self.by_line))

    def _leave(self, si: mi.SurfaceInteraction3f, first: bool) -> None:
        """Sample where each path goes on, and end some of them."""
        toward = -self.ray.d
        si.wi = si.to_local(toward)
        sample, value, going = self._sampled(si, mi.TransportMode.Importance, self.first_turn if first else None)
        passing = self.passage.passes(si, sample)
        delta = is_delta(sample) & ~passing
        onward = si.to_world(sample.wo)
        # Light that is followed forward sees shading normals the other way round (Veach 1997, 5.3).
        turned = mi.Frame3f.cos_theta(si.wi) * dr.dot(si.n, onward)
        turned /= mi.Frame3f.cos_theta(sample.wo) * dr.dot(si.n, toward)
        self.strength *= value * dr.select(dr.isfinite(turned), dr.abs(turned), 0)
        self._end_some(going, (self.scattered == 0) & delta, passing, first)
        self.scattered += dr.select(delta | passing, mi.UInt32(0), mi.UInt32(1))
        self.active &= self._goes_on(self.scattered + 1)
        self.straight &= passing
        self.ray = self.passage.leaving(si, onward)


class AnchorsWalk(IndirectWalk):
    """Paths to several anchors: each is followed once, and connected to one anchor after the other.

    Each anchor's light is what it would be alone: the same random numbers choose which connection is handed out.
    """

    STATE = (*IndirectWalk.STATE[:-1], "held")

    def __init__(self, tracer: IndirectTracer, seed: int | mi.UInt32, sample: mi.UInt32, lane: mi.UInt32) -> None:
        """Paths before their first surface.

        Parameters
        ----------
        tracer, seed, sample, lane
            as for :class:`IndirectWalk`; the lane tells the pixel.
        """
        super().__init__(tracer, seed, sample, lane)
        self._side, self._count = (dr.opaque(mi.UInt32, each) for each in (tracer.points.anchors, tracer.points.count))
        kinds = ("direct", "indirect") if tracer.mirrors else ("indirect",)
        self._numbers = len(_differing(Sightings.none(self.by_line)))
        size = self._numbers * next((room for room in _ROOMS if room >= tracer.points.count), tracer.points.count)
        self.held = {kind: dr.alloc_local(mi.Float, size, mi.Float(0)) for kind in kinds}

    def file(self, ledgers: Sequence[Ledger]) -> list[Deposits]:
        """Follow all paths; indirect light goes into ``ledgers``, caustics to the host."""
        self.follow(further=True)
        drawn = self.rng.next_float32()

        def filed(number: mi.UInt32) -> None:
            seen = self._held("indirect", number)
            place = ledgers[0].place(seen, drawn, self._anchor(number))
            for ledger, light in zip(ledgers, seen.by_line(len(ledgers)), strict=True):
                ledger.add(light, seen.pixel, place, ~(light == 0))  # not a number is light to be refused

        self._at_each(filed, mi.Bool(True))
        return self._fetched(("direct",) if self.tracer.mirrors else (), [ledger.sums for ledger in ledgers])

    def deposits(self, further: bool) -> list[Deposits]:
        """Light on the host of every path at every anchor, those of a path one after the other.

        Parameters
        ----------
        further
            as for :meth:`mitsim.transport.integrator.Walk.deposits`.
        """
        self.follow(further)
        return self._fetched(tuple(self.held))

    def _connect(self, si: mi.SurfaceInteraction3f) -> None:
        """Light that this surface sends to every anchor."""
        rng, drawn = self.rng, {kind: self.rng.next_float32() for kind in ("direct", "indirect")}

        def connected(number: mi.UInt32) -> None:
            self._at, self._drawn = number, drawn
            self.sensor = self.tracer.points.at(*self._anchor(number), rng)
            self._take(si, self._way(si))

        self._at_each(connected, self.active)

    def _keep(self, kind: str, seen: Sightings) -> None:
        if kind in self.held:
            joined = self._held(kind, self._at).joined_by(seen, self._drawn[kind])
            for place, value in enumerate(_differing(joined)):
                self.held[kind][self._at * self._numbers + place] = value

    def _held(self, kind: str, number: mi.UInt32) -> Sightings:
        """Light of a ``kind`` at an anchor of each path."""
        value, row, column, inverse_depth, *lines = (
            self.held[kind][number * self._numbers + place] for place in range(self._numbers)
        )
        by_line = mi.UnpolarizedSpectrum(*lines) if lines else None
        return Sightings(value, self.pixel, row, column, inverse_depth, by_line)

    def _anchor(self, number: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        """Row and column of an anchor by its number."""
        return number // self._side, number % self._side

    def _at_each(self, visit: Callable[[mi.UInt32], None], active: mi.Bool) -> None:
        """Visit every anchor, by its number, one after the other, where ``active``."""

        def one(number: mi.UInt32, held: dict[str, dr.Local[mi.Float]]) -> tuple[mi.UInt32, object]:
            self.held = held
            visit(number)
            return number + 1, self.held

        state = mi.UInt32(0), self.held
        _, self.held = dr.while_loop(state, lambda number, _: active & (number < self._count), one)

    def _fetched(self, kinds: Sequence[str], also: object = ()) -> list[Deposits]:
        """Light of some ``kinds`` on the host; what it takes is worked out with that of ``also``: apart, each would
        follow all paths again."""
        size = dr.width(self.pixel) * self.tracer.points.count
        found = {kind: [dr.zeros(mi.Float, size) for _ in range(self._numbers)] for kind in kinds}
        lane = dr.arange(mi.UInt32, dr.width(self.pixel)) * self._count

        def unpacked(number: mi.UInt32) -> None:
            for kind, values in found.items():
                for into, value in zip(values, _differing(self._held(kind, number)), strict=True):
                    dr.scatter(into, value, lane + number)

        if kinds:
            self._at_each(unpacked, mi.Bool(True))
        dr.eval(found, self.pixel, also)
        index, deposits = dr.arange(mi.UInt32, size), []
        pixel, anchor = dr.gather(mi.UInt32, self.pixel, index // self._count), self._anchor(index % self._count)
        for kind, (value, row, column, inverse_depth, *lines) in found.items():
            by_line = mi.UnpolarizedSpectrum(*lines) if lines else None
            seen = Sightings(value, pixel, row, column, inverse_depth, by_line)
            deposits.append(Deposits.fetched(seen, KINDS[kind], anchor))
        return deposits


def _differing(seen: Sightings) -> list[mi.Float]:
    """What differs between the anchors of a path, of :class:`Sightings`."""
    lines = () if seen.lines is None else seen.lines
    return [seen.value, seen.row, seen.column, seen.inverse_depth, *lines]


# -------- Blocks of projector pixels whose indirect light is followed more often than that of others

SIDE = 4
"""Pixels a side of a block, below the 7 of usual shifting dots, whose classes then differ."""
MEMBERS = SIDE**2
"""Pixels of a block."""
_MOST = 8
"""Paths of a pixel in a sample, at most: what a short look takes for noisy may be a single path."""
_SCALES = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)
"""Paths of a block of mean noise that are tried: whole numbers fit one scale better than another."""


def blocks_of(pixels: int) -> int:
    """Blocks a side of ``pixels``."""
    return -(-pixels // SIDE)


def block_moments(pixel: npt.NDArray[np.int64], light: FloatArray, pixels: int) -> FloatArray:
    """(blocks, blocks) sums of squares of ``light`` by the block of its ``pixel``.

    Parameters
    ----------
    pixel, light
        (m,) of paths.
    pixels
        of the projector, a side.
    """
    row, column = np.divmod(pixel, pixels)
    count = blocks_of(pixels)
    place = row // SIDE * count + column // SIDE
    return np.asarray(np.bincount(place, np.square(light), count**2).reshape(count, count), dtype=np.float64)


def chosen_repeats(moments: FloatArray) -> npt.NDArray[np.int64]:
    """(blocks, blocks) paths of each block's pixels in a sample, of the least variance times cost.

    ``moments`` (blocks, blocks) are smoothed over neighbours first; blocks without light count a tenth of the mean.
    """
    if not moments.any():
        return np.ones(moments.shape, dtype=np.int64)
    smooth = mean_of_neighbours(moments)
    wanted = np.sqrt(smooth + 0.1 * smooth.mean())
    tried = [np.clip(np.rint(scale * wanted / wanted.mean()), 1, _MOST).astype(np.int64) for scale in _SCALES]
    return min(tried, key=lambda repeats: float(np.prod(effect_of(repeats, smooth))))


def effect_of(repeats: npt.NDArray[np.int64], moments: FloatArray) -> tuple[float, float]:
    """Variance and paths of a sample with ``repeats``, each over those without, by ``moments`` of the light."""
    total = float(moments.sum())
    return float((moments / repeats).sum()) / total if total else 1.0, float(repeats.mean())


@dataclass(frozen=True, eq=False)
class Turns:
    """Which block, or pixel, each of a sample's units of paths belongs to.

    Attributes
    ----------
    unit, turn, count
        (units,) its number, which of its paths in the sample this is, and how many there are.
    """

    unit: mi.UInt32
    turn: mi.UInt32
    count: mi.UInt32

    @classmethod
    def of(cls, repeats: npt.NDArray[np.int64]) -> Turns:
        """Those of units that have so many ``repeats`` (units,)."""
        unit = np.repeat(np.arange(len(repeats)), repeats)
        starts = np.cumsum(repeats) - repeats
        turn = np.arange(len(unit)) - starts[unit]
        return cls(*(mi.UInt32(each.astype(np.uint32)) for each in (unit, turn, repeats[unit])))

    def __len__(self) -> int:
        return int(dr.width(self.unit))

    def at(self, index: mi.UInt32, sample: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
        """Unit, number of its own sample, and weight of entry ``index`` in ``sample``."""
        unit, turn, count = (dr.gather(mi.UInt32, each, index) for each in (self.unit, self.turn, self.count))
        return unit, sample * count + turn, dr.rcp(mi.Float(count))


def by_pixel(repeats: Sequence[int], pixels: int) -> npt.NDArray[np.int64]:
    """(pixels^2,) repeats of each pixel, from those of the blocks row by row.

    Parameters
    ----------
    repeats
        of (blocks^2,) blocks.
    pixels
        a side.
    """
    count = blocks_of(pixels)
    whole = np.kron(np.reshape(repeats, (count, count)), np.ones((SIDE, SIDE), dtype=np.int64))
    return np.ascontiguousarray(whole[:pixels, :pixels]).ravel()
