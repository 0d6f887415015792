"""What paths from the projector and paths from the camera share: launches, who finds which light, how they end."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from copy import copy
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

import drjit as dr
import mitsuba as mi

from mitsim.transport.records import AMBIENT, DIRECT, INDIRECT, Deposits, Sightings
from mitsim.transport.transmission import Passage

if TYPE_CHECKING:
    from typing import Self

    from mitsim.transport.projector import ProjectorOptics

KINDS = MappingProxyType({"direct": DIRECT, "indirect": INDIRECT, "ambient": AMBIENT})
"""Kinds of light by their names in a walk."""
LANES_PER_LAUNCH = 2**22
"""Paths of one kernel: at some 100 bytes of state each, 0.4 GB; and a launch's fixed cost is small beside its work."""
_TOGETHER, _ALL = 4, 2**30
"""Seeds whose paths one kernel follows at most, and samples of one seed beyond any that are asked for; the first times
the second fits 32 bits."""
_SHARP = 1.0
"""Density [1/sr] of sampling a turn above which its light is looked for from the camera.

Three times a matt surface's 0.32, so that none of its light is, and low enough for connections to hold the rest.
"""
_MIRRORS = 16
"""Mirrors that a path meets without the risk to end there: as many as the depth of glints."""
_LONGEST = 0.999
"""Largest chance to go on: paths end even where nothing is absorbed.

In a closed room of reflectance rho the light of a path grows by rho / chance a reflection, and its second moment is
finite only while rho^2 < chance. A chance of 0.95 at most lost 10 % of the light at reflectance 0.99, 79 % at 0.999.
"""
ANY = 2**31
"""More surfaces than any path meets; one more fits 32 bits."""
_LEAST_CHANCE = 1e-6
"""Strength is divided by no less than this: paths of chance 0 have ended, and 1/0 must not be worked out for them."""


def launches(
    lanes: int, first: int, samples: int, at_once: int = LANES_PER_LAUNCH
) -> Iterator[tuple[mi.UInt32, mi.UInt32]]:
    """(sample, lane) of every path, one kernel's at a time.

    Parameters
    ----------
    lanes
        paths of one sample.
    first, samples
        samples ``first`` .. ``first + samples - 1`` are meant.
    at_once
        paths of one kernel.
    """
    total, start = lanes * samples, lanes * first
    for done in range(0, total, at_once):
        index = dr.arange(mi.UInt64, min(at_once, total - done)) + dr.opaque(mi.UInt64, start + done)
        # An opaque number keeps the compiled kernel the same for every count.
        per_sample = dr.opaque(mi.UInt64, lanes)
        yield mi.UInt32(index // per_sample), mi.UInt32(index % per_sample)


def _seeds(few: Sequence[int], samples: int, sample: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
    """Seed of each path, and the number of its sample, where ``samples`` of each of a ``few`` seeds follow each other.

    No division, and one kernel for one seed and for several.
    """
    count, look = dr.opaque(mi.UInt32, samples), mi.UInt32(0)
    for before in range(1, _TOGETHER):
        look += dr.select(sample >= before * count, mi.UInt32(1), 0)
    seeds = mi.UInt32([*few, *[0] * (_TOGETHER - len(few))])
    return dr.gather(mi.UInt32, seeds, look), sample - look * count


def camera_part(pdf: mi.Float) -> mi.Float:
    """Part of the light over the last turn before the sensor that is followed from the camera; the rest is connected.

    ``pdf`` [1/sr] is that of sampling the turn from the camera's side, which both sides know, so the parts add up to
    one. A connection to a lobe sharper than ``_SHARP`` keeps ``_SHARP / pdf`` of its light: it is bounded however sharp
    the lobe. What is matt is never followed from the camera.
    """
    return dr.select(pdf > _SHARP, 1 - _SHARP * dr.rcp(pdf), 0)


def is_delta(sample: mi.BSDFSample3f) -> mi.Bool:
    """Whether the direction of ``sample`` is a mirror's, reflected or refracted."""
    mirror = int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.DeltaTransmission)
    return (sample.sampled_type & mirror) != 0


class Tracer(ABC):
    """Light of a scene; prepared once, each seed is an independent estimate.

    Attributes
    ----------
    lanes_per_launch
        paths of one kernel.
    """

    lanes_per_launch: ClassVar[int] = LANES_PER_LAUNCH
    projector: ProjectorOptics

    @property
    @abstractmethod
    def lanes(self) -> int:
        """Paths, or connections, of one sample."""

    @property
    def per_lane(self) -> int:
        """Paths, or connections, that each lane of a kernel stands for."""
        return 1

    def _launches(self, first: int, samples: int) -> Iterator[tuple[mi.UInt32, mi.UInt32]]:
        """As :func:`launches`, ``lanes_per_launch`` paths of all lanes together."""
        return launches(self.lanes // self.per_lane, first, samples, max(1, self.lanes_per_launch // self.per_lane))

    @property
    def apart(self) -> Sequence[Self]:
        """Itself, or where glass parts light of several wavelengths, the same for each of them alone."""
        projectors = self.projector.apart
        return [self] if len(projectors) == 1 else [self._lit_by(projector) for projector in projectors]

    def _lit_by(self, projector: ProjectorOptics) -> Self:
        again = copy(self)
        again.projector = projector
        return again

    @abstractmethod
    def _launch(self, seed: mi.UInt32, sample: mi.UInt32, lane: mi.UInt32) -> list[Deposits]:
        """Light of the paths of one kernel, a ``seed`` for each."""

    def trace(self, seed: int, first: int = 0, samples: int = 1) -> Deposits:
        """Light of some samples, their sum.

        Parameters
        ----------
        seed
            of the random numbers.
        first, samples
            samples ``first`` .. ``first + samples - 1`` of the seed's sequence are traced.

        Raises
        ------
        MitsimError
            when the scene sends NaN or infinite light to the camera.
        """
        launched = [
            tracer._launch(_seeds([seed], _ALL, sample)[0], sample, lane)
            for tracer in self.apart
            for sample, lane in self._launches(first, samples)
        ]
        return Deposits.joined([deposits for parts in launched for deposits in parts])

    def trace_looks(self, seeds: Sequence[int], samples: int = 1) -> list[Deposits]:
        """``samples`` as :meth:`trace` finds them for each of some ``seeds``, in as few kernels as may be."""
        each, found, tracers = self.lanes * samples, list[Deposits](), self.apart
        together = min(self.lanes_per_launch // each, _TOGETHER)
        if together < 2:
            return [self.trace(seed, 0, samples) for seed in seeds]
        for start in range(0, len(seeds), together):
            few = seeds[start : start + together]
            ((sample, lane),) = self._launches(0, samples * len(few))
            launched = [tracer._launch(*_seeds(few, samples, sample), lane) for tracer in tracers]
            parts = [deposits for of_one in launched for deposits in of_one]
            for look in range(len(few)):
                found.append(Deposits.joined([part.of_lanes(look * each, (look + 1) * each) for part in parts]))
        return found


class FollowingTracer(Tracer):
    """Light that is followed over any number of surfaces, or of some orders alone.

    The *order* of light is the number of surfaces that have turned it and are no mirrors: 1 for what a projector lights
    and the sensor sees, 0 for a lamp that is seen.
    """

    orders: tuple[int, int] | None = None

    def of_orders(self, fewest: int, most: int) -> Self:
        """The same paths, whose light is kept of the orders ``fewest`` to ``most``, and which end where no more can
        come; one kernel serves all of them."""
        again = copy(self)
        again.orders = fewest, most
        return again


class Walk(ABC):
    """The paths of one launch, a lane each: the first surface apart, and all others in a loop of one kernel.

    Of each kind of light one connection a path is kept. ``STATE`` names the attributes that change on the way; the
    first tells which paths still go on. ``straight`` are those that have only passed surfaces so far
    (:mod:`mitsim.transport.transmission`): their light is direct light's own. ``anchor`` is the row and the column of
    that which each path is followed to."""

    STATE: ClassVar[tuple[str, ...]]

    active: mi.Bool
    strength: mi.Spectrum
    bounce: mi.UInt32
    straight: mi.Bool
    rng: mi.PCG32
    anchor: tuple[mi.UInt32, mi.UInt32]

    def __init__(
        self,
        passage: Passage,
        mirrors: bool,
        interreflection: bool,
        orders: tuple[int, int] | None = None,
        by_line: bool = False,
    ) -> None:
        """Paths before their first surface.

        Parameters
        ----------
        passage
            the scene, and what light passes in it.
        mirrors, interreflection
            paths over delta reflections and transmissions, and over other surfaces.
        orders
            of :class:`FollowingTracer`; None: all.
        by_line
            whether light is told apart by line.
        """
        self.passage, self.scene, self.straight = passage, passage.scene, mi.Bool(True)
        self.mirrors, self.interreflection = mirrors, interreflection
        self.by_line = by_line
        self.kept = {kind: Sightings.none(by_line) for kind in KINDS}
        self._orders = [dr.opaque(mi.UInt32, order) for order in orders or ()]

    @abstractmethod
    def vertex(self, first: bool) -> None:
        """Find the next surface of every path (its ``first`` or a later one), connect it, and leave it."""

    def _keep(self, kind: str, seen: Sightings) -> None:
        """Keep light of one connection a path, or that of an earlier one of its kind, which then stands for both."""
        self.kept[kind] = self.kept[kind].joined_by(seen, self.rng.next_float32())

    def _wanted(self, order: mi.UInt32) -> mi.Bool:
        """Whether light of an ``order`` is kept."""
        if not self._orders:
            return mi.Bool(True)
        fewest, most = self._orders
        return (order >= fewest) & (order <= most)

    def _goes_on(self, least: mi.UInt32) -> mi.Bool:
        """Whether a path may bring light that is kept, of which the ``least`` order is to come."""
        return least <= self._orders[1] if self._orders else mi.Bool(True)

    def _sampled(
        self, si: mi.SurfaceInteraction3f, mode: mi.TransportMode, chosen: mi.Point2f | None = None
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum, mi.Bool]:
        """Where each path could go on, the light it would keep, and whether such turns are followed.

        The point ``chosen`` stands in for a random one.
        """
        number, point = self.rng.next_float32(), mi.Point2f(self.rng.next_float32(), self.rng.next_float32())
        point = point if chosen is None else chosen
        sample, value = si.bsdf().sample(mi.BSDFContext(mode), si, number, point, self.active)
        going = self.active & (sample.pdf > 0)
        if not self.interreflection:
            going &= (is_delta(sample) & self.mirrors) | self.passage.passes(si, sample)
        elif not self.mirrors:
            going &= ~is_delta(sample) | self.passage.passes(si, sample)
        return sample, mi.unpolarized_spectrum(value), going

    def _end_some(self, going: mi.Bool, mirrored: mi.Bool, passing: mi.Bool, first: bool) -> None:
        """Go on with a chance: what a path still carries; but chains of mirrors are short and full of light.

        What only passes a surface goes on.
        """
        self.bounce += dr.select(passing, mi.UInt32(0), mi.UInt32(1))
        if not first:
            carried = dr.minimum(dr.max(self.strength), _LONGEST)
            chance = dr.select((mirrored & (self.bounce < _MIRRORS)) | passing, 1, carried)
            going &= self.rng.next_float32() < chance
            self.strength *= dr.rcp(dr.maximum(chance, _LEAST_CHANCE))
        self.active = going & (dr.max(self.strength) > 0)

    def deposits(self, further: bool) -> list[Deposits]:
        """Light on the host of every path, followed to its end or, unless ``further``, to the first surface only."""
        self.follow(further)
        dr.eval(self.kept)
        return [Deposits.fetched(seen, KINDS[kind], self.anchor) for kind, seen in self.kept.items()]

    def follow(self, further: bool) -> None:
        """Follow every path to its end or, unless ``further``, to the first surface only."""
        self.vertex(first=True)
        if further:
            self._follow_on()

    def _follow_on(self) -> None:
        """Follow every path from where it is."""
        self._load(dr.while_loop(self._values(), lambda *values: values[0], self._body, labels=self.STATE))

    def _body(self, *values: object) -> tuple[object, ...]:
        self._load(values)
        self.vertex(first=False)
        return self._values()

    def _values(self) -> tuple[object, ...]:
        return tuple(getattr(self, name) for name in self.STATE)

    def _load(self, values: tuple[object, ...]) -> None:
        for name, value in zip(self.STATE, values, strict=True):
            setattr(self, name, value)
