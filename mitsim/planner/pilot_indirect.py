"""Light over several surfaces, in mirrors and of lamps, from one point of the sensor or several: what one changes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any

import numpy as np

from mitsim.bench.bench import Apparatus
from mitsim.bench.effects import DIRECT, EFFECTS, FOLLOWED, Effect
from mitsim.core.arrays import FloatArray
from mitsim.core.seeds import integer
from mitsim.light.cost_model import SHARED_COST
from mitsim.light.grids import Grid
from mitsim.light.pass_table import PASSES
from mitsim.light.passes import Simulation, emitted
from mitsim.light.pilot_result import LOOKS, Changes, Effort, Noise, Part
from mitsim.light.settings import Settings
from mitsim.planner.pilot_direct import SHARP_RATE
from mitsim.planner.pilot_samples import EVEN_CELLS, Known, Sample, coarsened, heavy_paths, known, ladder, noise, norm
from mitsim.transport import records
from mitsim.transport.from_camera import Together
from mitsim.transport.indirect import block_moments, chosen_repeats, effect_of
from mitsim.transport.integrator import KINDS, Tracer
from mitsim.transport.path_reuse import NeighbourTracer
from mitsim.transport.records import Deposits

FOLLOWED_LADDER = (1, 2, 3, 5, 8, 12)
"""Numbers of anchors that are tried."""
WIDTHS = (1, 2, 4)
"""Projector pixels a side of a cell that are tried: what anchors see beyond their mean is little light, and need not be
as fine as all of it; wider cells hold light of many anchors in memory."""
_AT_ONCE = 2**20
"""Connections that are traced at a time: 0.5 GB while they are filed."""
_FIRST_JUDGE = 1
"""Index of the number that judges at first."""
_FEW_ANCHORS = 2
"""Anchors whose noise is measured."""
_RESIDUALS = ("indirect_residual", "camera_residual")
"""Passes to every anchor, from either side."""


class FollowedLight:
    """The frames with fewer anchors for light that is followed; to every anchor go the same paths.

    Of one wavelength, as :class:`mitsim.planner.pilot_direct.AnchoredLight` has them.

    Parameters
    ----------
    bench, everything
        what is traced, and settings with all its effects on.
    sample
        shots and samples.
    tolerance
        norm of a change at which the search for enough may stop.
    seed
        root of the random streams.
    layers
        depths [mm] that judge one layer; none for a flat scene.
    lit
        whether other looks found any such light.
    """

    def __init__(
        self,
        bench: Apparatus,
        everything: Settings,
        sample: Sample,
        tolerance: float,
        seed: int,
        layers: tuple[float, ...] = (),
        lit: bool = True,
    ) -> None:
        self.bench, self.everything, self.sample, self.tolerance = bench, everything, sample, tolerance
        self._layers, self._lit = layers, lit
        self._seeds = [integer(seed, "pilot", "followed", look) for look in range(LOOKS)]

    @cached_property
    def changes(self) -> dict[Part, FloatArray]:
        """Change of the frames by every number of anchors that was tried; none where there is no such light."""
        if not self._lit or not self._tracers(self._simulation()) or not norm(self._frames(1)):
            return {}
        found = ladder(FOLLOWED_LADDER, self._frames, _FIRST_JUDGE, self.tolerance)
        anchors = {Part("followed_anchors", count): change for count, change in found.items()}
        # Where the judge was never judged, few anchors serve, and their light is held in any cells.
        return {**anchors, **self._widths} if len(found) > _FIRST_JUDGE + 1 else anchors

    def efforts(self, light: float) -> dict[str, Effort]:
        """Monte Carlo error of one estimate of what a few anchors see beyond their mean, relative to all ``light``, by
        pass: of indirect light from the projector's side, and of what is followed from the camera."""
        tracers = self._simulation().at_anchors
        if not self.changes:
            return dict.fromkeys(_RESIDUALS, Effort.none())
        every = self._beyond_mean()
        if None in tracers:
            seen = every, every
        else:
            simulation = self._simulation(followed_anchors=_FEW_ANCHORS)
            from_camera = self._beyond(simulation, self._few_by_tracer[1])
            seen = every - from_camera, from_camera
        errors = (noise(each) / light if light else 0.0 for each in seen)
        return {
            name: Effort(Noise(error, self.sample.followed, 0.5), tracer.lanes) if tracer else Effort.none()
            for name, error, tracer in zip(_RESIDUALS, errors, tracers, strict=True)
        }

    def with_more(self, light: float, samples: int) -> Effort:
        """That of what is followed from the camera, by looks of so many ``samples``; ``light`` as for those."""
        simulation = self._simulation(followed_anchors=_FEW_ANCHORS)
        tracer = simulation.at_anchors[1]
        if tracer is None or not self.changes or not light:
            return Effort.none()
        seen = [heavy_paths(tracer, integer(seed, "heavy"), samples) for seed in self._seeds]
        frames = self._beyond(simulation, seen, samples=samples)
        # The heaviest paths come to one anchor of several: each connection counts.
        found = Noise.among(frames, light, samples, np.concatenate([look.value for look in seen]))
        return Effort(found, self._simulation().at_anchors[1].lanes)  # type: ignore[union-attr]

    @property
    def _widths(self) -> dict[Part, FloatArray]:
        """Change of the frames by every width of cells for what a few anchors see beyond their mean."""
        one = self._beyond_mean()
        missing = (self._beyond_mean(coarse_cells=2) - one) / (1 - EVEN_CELLS)
        layered = self._beyond_mean(coarse_layers=True, layers=self._layers) if self._layers else one
        wide = {width: layered + missing - self._beyond_mean(followed_width=width) for width in WIDTHS[1:]}
        return {Part("followed_width", width): change for width, change in {1: missing, **wide}.items()}

    @known
    def _beyond_mean(self, **cells: Any) -> FloatArray:
        """Frames of what a few anchors see beyond their mean, in such ``cells``."""
        simulation = self._simulation(followed_anchors=_FEW_ANCHORS, **cells)
        return self._beyond(simulation, self._few, None if cells else self._frames(_FEW_ANCHORS))

    def _beyond(
        self,
        simulation: Simulation,
        looks: list[Deposits],
        frames: FloatArray | None = None,
        samples: int | None = None,
    ) -> FloatArray:
        """Frames of light to a few anchors beyond its mean, in a ``simulation``; of all of it, where they are known."""
        weights = simulation.mean_weights(_FEW_ANCHORS)
        mean = [look.averaged(weights) for look in looks]
        grids = _residual_grids(simulation)
        frames = self._formed(grids, looks, samples) if frames is None else frames
        return frames - self._formed((grids[0].of_mean, grids[1].of_mean), mean, samples)

    @cached_property
    def _few(self) -> list[Deposits]:
        """Light to a few anchors, look by look."""
        return self._joined(self._few_by_tracer)

    @cached_property
    def _few_by_tracer(self) -> list[list[Deposits]]:
        """The same by tracer."""
        tracers, samples = self._tracers(self._simulation(followed_anchors=_FEW_ANCHORS)), self.sample.followed
        return [tracer.trace_looks(self._seeds, samples) for tracer in tracers]

    @staticmethod
    def _joined(traced: Iterable[list[Deposits]]) -> list[Deposits]:
        """Light of several tracers together, look by look."""
        return [Deposits.joined(looks) for looks in zip(*traced, strict=True)]

    @known
    def _frames(self, anchors: int) -> FloatArray:
        simulation, samples = self._simulation(followed_anchors=anchors), self.sample.followed
        tracers = self._tracers(simulation)
        each = max(1, _AT_ONCE // sum(tracer.lanes for tracer in tracers))
        parts = [(first, min(each, samples - first)) for first in range(0, samples, each)]
        grids = _residual_grids(simulation)
        if anchors == _FEW_ANCHORS:
            return self._formed(grids, self._few)
        found = []
        for part in parts:
            first, some = part
            traced = [
                tracer.trace_looks(self._seeds, some)
                if some == samples
                else [tracer.trace(seed, first, some) for seed in self._seeds]
                for tracer in tracers
            ]
            found.append(self._formed(grids, self._joined(traced)))
        return np.asarray(sum(found))

    def _simulation(self, **numbers: Any) -> Simulation:
        return self.sample.simulation(self.bench, replace(self.everything, **numbers), one_line=True)

    @staticmethod
    def _tracers(simulation: Simulation) -> list[Tracer | Together]:
        return [tracer for tracer in simulation.at_anchors if tracer is not None]

    def _formed(self, grids: tuple[Grid, Grid], looks: list[Deposits], samples: int | None = None) -> FloatArray:
        """(looks, shots, places, places) frames of the projector's light, and lamps', in ``grids``; of so many
        ``samples``, if not of as many as others."""
        samples = samples or self.sample.followed
        frames = self.sample.frames(grids[0], looks, samples)
        return frames + self.sample.lamps(grids[1], looks, samples) if self.bench.loaded.lamps else frames


def _residual_grids(simulation: Simulation) -> tuple[Grid, Grid]:
    """Of what anchors see of followed light, and of lamps' light there."""
    return simulation.grids["indirect_residual"], simulation.ambient["indirect_residual"]


# -------- All effects at once, and each of them switched off

_FOLLOWED = tuple(name for name, row in PASSES.items() if not (row.even or row.anchors))
"""Passes of light that is followed to one point of the sensor."""
_WORTH_REPEATING = 0.85
"""Variance times paths, over that of even ones, below which blocks are followed unevenly: short looks tell it so
well."""
_OPEN = 0.1
"""Part of the accuracy that noise may leave open of what coarse cells for indirect light change: a hundredth of the
budget's square. Where more is, the capture follows ten times as many paths as the closer looks, or more (corner at
5e-4, first looks: 1e-3 open, and 110 processor seconds in place of 33)."""


class SwitchedEffects:
    """A bench with all effects; direct and followed light are traced once and reused where they can be.

    Parameters
    ----------
    bench, everything
        what is traced, and settings with all its effects on.
    sample
        shots and samples.
    seed
        root of the random streams.
    layers
        depths [mm] that judge one layer; none for a flat scene.
    accuracy
        what coarse cells change of indirect light is told to a small part of it, where that is cheap.
    """

    def __init__(
        self,
        bench: Apparatus,
        everything: Settings,
        sample: Sample,
        seed: int,
        layers: tuple[float, ...] = (),
        accuracy: float = math.inf,
    ) -> None:
        self.bench, self.everything, self.sample, self.layers = bench, everything, sample, layers
        self.accuracy = accuracy
        self.seeds = [integer(seed, "pilot", "effects", look) for look in range(LOOKS)]
        self.simulation = sample.simulation(bench, everything)
        self.direct = self._direct(self.simulation)
        self.followed = {name: self._follow(self.simulation, name) for name in _FOLLOWED}
        self.sharp = self._sharp(self.simulation)
        self._known: Known = {}
        self._kinds = self._by_kind(self.followed)
        self.frames = self._form(self.simulation, self.direct, self._kinds, self.sharp)
        self.light = norm(self.frames)
        """Norm of the frames of all light."""

    @cached_property
    def changes(self) -> dict[Part, FloatArray]:
        """Change of the frames by each effect that they have, and by coarse cells for indirect light."""
        shown = [name for name in EFFECTS if name in self.everything.effects and EFFECTS[name].in_frames]
        found = {Part(name): self.frames - self._without(EFFECTS[name]) for name in shown}
        return {**found, **self._coarse}

    @cached_property
    def _coarse(self) -> dict[Part, FloatArray]:
        """Change of the frames by coarse cells for indirect light; none where there is no such light."""
        if not any(light.value.size for light in self._bounced):
            return {}
        return coarsened("indirect", partial(self._indirect, self._bounced, self._closer[1]), self.layers)

    def _indirect(self, bounced: Sequence[Deposits], samples: int, cells: int, layers: tuple[float, ...]) -> FloatArray:
        """Frames of ``bounced`` light in so many samples, in coarse cells and layers."""
        coarse = replace(self.everything, coarse_cells=cells, coarse_layers=bool(layers), layers=layers)
        simulation = self.sample.simulation(self.bench, coarse)
        return self._form(simulation, followed={"indirect": bounced}, samples=samples)

    @cached_property
    def _bounced(self) -> list[Deposits]:
        """Indirect light from the projector's side in closer looks, look by look."""
        looks, _ = self._closer
        return self._first_bounced if looks is self.followed["indirect"] else _indirect_of(looks)

    @cached_property
    def _first_bounced(self) -> list[Deposits]:
        return _indirect_of(self.followed["indirect"])

    @cached_property
    def _closer(self) -> tuple[list[Deposits], int]:
        """Looks at the projector's side's light, and their samples: more where noise hides what coarse cells change."""
        looks, samples, tracer = self.followed["indirect"], self.sample.followed, self.simulation.indirect
        if tracer is None or not any(light.value.size for light in self._first_bounced):
            return looks, samples
        seen = coarsened("indirect", partial(self._indirect, self._first_bounced, samples), ())
        value, bound = Changes.between(seen, self.light**2).estimate(seen)
        wanted = math.ceil(samples * (bound**2 - value**2) / (_OPEN * self.accuracy) ** 2)
        more = min(wanted, self.sample.closer(tracer.lanes))
        if more <= samples:
            return looks, samples
        # Seeds of their own: that the first looks are vague says nothing of these.
        return tracer.trace_looks([integer(seed, "closer") for seed in self.seeds], more), more

    @property
    def received(self) -> float:
        """Light that is followed, as irradiance at the sensor's centre [W m^-2]."""
        light = sum(float(look.value.sum()) for looks in self.followed.values() for look in looks)
        return light / (LOOKS * self.sample.followed)

    @property
    def apart(self) -> dict[str, float]:
        """Error of leaving out each effect that is drawn with the sensor's noise: speckle's contrast."""
        effects = self.everything.effects
        return {name: self.simulation.physics.speckle for name in effects if not EFFECTS[name].in_frames}

    @property
    def lanes(self) -> dict[str, int]:
        """Paths in a sample of each tracer."""
        return {name: lanes for name, (_, _, lanes) in self._noise.items()}

    def effort(self, name: str) -> Effort:
        """Monte Carlo error of one estimate by the pass ``name``, relative to all light, and its paths."""
        if name not in self._noise:
            return Effort.none()
        error, samples, lanes = self._noise[name]
        relative = error / self.light if self.light else 0.0
        return Effort(Noise(relative, samples, 0.5), lanes)

    def with_more(self, samples: int) -> Effort:
        """The same of what is followed from the camera, by looks of so many ``samples`` of their own."""
        tracer = self.simulation.from_camera
        if tracer is None or not self.light:
            return Effort.none()
        seen = [heavy_paths(tracer, integer(seed, "heavy"), samples) for seed in self.seeds]
        frames = self._form(self.simulation, followed=self._by_kind({"from_camera": seen}), samples=samples)
        paths = np.concatenate([look.value for look in seen])
        return Effort(Noise.among(frames, self.light, samples, paths), tracer.lanes)

    def indirect_effort(self) -> tuple[Effort, bool, tuple[int, ...]]:
        """What light over several surfaces takes, whether that is less where neighbouring pixels share it, and how
        often each block of pixels is followed in a sample."""
        effort, shared = self._shared_or_not
        repeats, (variance, paths) = self._repeats
        if variance * paths > _WORTH_REPEATING:
            return effort, shared, ()
        noise_left = replace(effort.noise, error=effort.noise.error * math.sqrt(variance))
        return replace(effort, noise=noise_left, paths=math.ceil(effort.paths * paths)), shared, repeats

    @cached_property
    def _repeats(self) -> tuple[tuple[int, ...], tuple[float, float]]:
        """Paths of each block of pixels in a sample, and what that makes of variance and paths, by other looks."""
        pixels = self.bench.n
        moments = [block_moments(look.pixel, look.value, pixels) for look in self._bounced]
        repeats = chosen_repeats(np.sum(moments, axis=0))
        # Judged by looks that had no say, a half each: a single heavy path recommends only its own block.
        halves = np.sum(moments[::2], axis=0), np.sum(moments[1::2], axis=0)
        judged = [effect_of(chosen_repeats(one), other) for one, other in (halves, halves[::-1])]
        variance, paths = np.mean(judged, axis=0)
        return tuple(int(count) for count in repeats.ravel()), (float(variance), float(paths))

    @cached_property
    def _shared_or_not(self) -> tuple[Effort, bool]:
        """What light over several surfaces takes, and whether it is shared."""
        plain, tracer = self.effort("indirect"), self._sharing.indirect
        if not plain.noise.error or not isinstance(tracer, NeighbourTracer) or not tracer.shares():
            return plain, False
        samples = max(1, self._closer[1] // SHARED_COST)
        seen = [tracer.trace(integer(seed, "shared"), 0, samples) for seed in self.seeds]
        error = noise(self._form(self._sharing, followed=self._by_kind({"indirect": seen}), samples=samples))
        error /= self.light
        shared = Effort(Noise(error, samples, 0.5), SHARED_COST * tracer.lanes)
        less = shared.variance * shared.paths < plain.variance * plain.paths
        return (shared, True) if less else (plain, False)

    @cached_property
    def _sharing(self) -> Simulation:
        return self.sample.simulation(self.bench, replace(self.everything, shared=True))

    @property
    def efforts(self) -> dict[str, Effort]:
        """That of every pass that is followed to one point of the sensor, and of sharp pixels where there are any."""
        found = {name: self.effort(name) for name in _FOLLOWED}
        tracer = self.simulation.sharp
        return {**found, "sharp": self._sharp_effort(tracer.lanes)} if tracer else found

    def _sharp_effort(self, lanes: int) -> Effort:
        """That of pixels that are traced apart, their rate being that of stratified rays."""
        samples = self.sample.sharp(self.simulation)
        error = noise(self._form(self.simulation, sharp=self.sharp))
        relative = error / self.light if self.light else 0.0
        return Effort(Noise(relative, samples, SHARP_RATE), lanes)

    @cached_property
    def _noise(self) -> dict[str, tuple[float, int, int]]:
        """Error of a look by each tracer, the look's samples, and paths of one."""
        found = {}
        for name, each in self.simulation.passes.items():
            if name in _FOLLOWED:
                first = self.followed[name], self.sample.followed
                looks, samples = self._closer if name == "indirect" else first
                frames = self._form(self.simulation, followed=self._by_kind({name: looks}), samples=samples)
                found[name] = noise(frames), samples, each.tracer.lanes
        return found

    def _without(self, effect: Effect) -> FloatArray:
        effects = self.everything.effects - {effect.name}
        simulation = self.sample.simulation(self.bench, replace(self.everything, effects=effects))
        retraced = effect.retraced(simulation.physics)
        direct, sharp = self.direct, self.sharp
        if DIRECT in retraced:
            direct, sharp = self._direct(simulation), self._sharp(simulation)
        if FOLLOWED in retraced:
            followed = self._by_kind({name: self._follow(simulation, name) for name in _FOLLOWED})
        else:
            followed = {kind: light for kind, light in self._kinds.items() if kind != effect.kind}
        return self._form(simulation, direct, followed, sharp)

    def _direct(self, simulation: Simulation) -> list[Deposits]:
        return simulation.direct.trace_looks(self.seeds, self.sample.direct)

    def _follow(self, simulation: Simulation, name: str) -> list[Deposits]:
        """Light of the pass ``name``, look by look."""
        tracer = PASSES[name].tracer(simulation)
        if tracer is None:
            return [Deposits.none()] * LOOKS
        return tracer.trace_looks([integer(seed, name) for seed in self.seeds], self.sample.followed)

    @staticmethod
    def _by_kind(followed: dict[str, list[Deposits]]) -> dict[str, list[Deposits]]:
        """Light of several tracers together by its kind, look by look."""
        looks = [Deposits.joined(looks) for looks in zip(*followed.values(), strict=True)]
        return {name: [look.where(look.kind == kind) for look in looks] for name, kind in KINDS.items()}

    def _sharp(self, simulation: Simulation) -> list[Deposits]:
        """Light of pixels that are traced apart, look by look."""
        tracer, samples = simulation.sharp, self.sample.sharp(simulation)
        if tracer is None:
            return []
        return tracer.trace_looks([integer(seed, "sharp") for seed in self.seeds], samples)

    def _form(
        self,
        simulation: Simulation,
        direct: Sequence[Deposits] = (),
        followed: Mapping[str, Sequence[Deposits]] = MappingProxyType({}),
        sharp: Sequence[Deposits] = (),
        samples: int | None = None,
    ) -> FloatArray:
        """Frames of light look by look, where there is any; ``samples`` of followed light, if not as many as of all."""
        sample, known, physics = self.sample, self._known, simulation.physics
        light, few = emitted(physics, sample.lighting), samples or sample.followed
        grids = simulation.grids
        parts = [(grids["fine"], direct, sample.direct), (grids["fine"], followed.get("direct", ()), few)]
        parts.append((grids["sharp"], sharp, sample.sharp(simulation)))
        if physics.interreflection:
            parts.append((grids["indirect"], followed.get("indirect", ()), few))
        frames = np.zeros((LOOKS, len(light), *sample.shape))
        for grid, looks, count in parts:
            if any(look.value.size for look in looks):
                frames += sample.frames(grid, looks, count, light, known)
        lamps = followed.get("ambient", ())
        if physics.lamps and lamps:
            frames += sample.lamps(simulation.ambient["fine"], lamps, few, known)
        glint = simulation.glint_frames(sample.lighting.labels)
        return frames if glint is None else frames + np.tensordot(light[:, glint.classes], glint.irradiance, 1)


def _indirect_of(looks: Sequence[Deposits]) -> list[Deposits]:
    """Indirect light in ``looks``, look by look."""
    return [light.where(light.kind == records.INDIRECT) for light in looks]
