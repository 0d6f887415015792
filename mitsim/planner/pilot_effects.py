"""A bench with all effects, with each switched off, and with few anchors: what that changes of the frames, and noise of
each pass."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property, partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import DIRECT, EFFECTS, FOLLOWED, Effect
from mitsim.core.arrays import FloatArray
from mitsim.core.seeds import integer
from mitsim.light.cost_model import SHARED_COST
from mitsim.light.grids import Grid
from mitsim.light.passes import PASSES, PassTracer
from mitsim.light.settings import REPLICATES, Approximation, ErrorCovariance, Noise, SampleCost, Settings
from mitsim.light.simulation import Simulation, emission
from mitsim.planner.pilot_direct import SHARP_RATE, shown_pixels, tracer_of
from mitsim.planner.pilot_samples import (
    EVEN_CELLS,
    GOOD_ENOUGH,
    Known,
    Sample,
    coarsening_changes,
    heavy_paths,
    ladder,
    noise,
    norm,
)
from mitsim.transport import records
from mitsim.transport.indirect import adaptive_counts, block_moments, effect_of
from mitsim.transport.integrator import KINDS
from mitsim.transport.path_reuse import PathReuseTracer
from mitsim.transport.records import PathSamples

_FOLLOWED = tuple(name for name, row in PASSES.items() if not (row.even or row.anchors))
"""Passes of light that is followed to one point of the sensor."""
_OVER_SEVERAL = "indirect", "from_camera"
"""Those of it that hold light over several surfaces, in mirrors and of lamps alone."""
_WORTH_REPEATING = 0.85
"""Variance times paths, over that of even ones, below which blocks are followed unevenly: short replicates tell it so
well."""
_OF_INDIRECT = 0.2
"""Part of what indirect light is predicted to take that closer replicates of it may take at most."""
_WORTH_SHARING_S = 0.5
"""Seconds of indirect light, at fixed unit costs, from which it is looked at whether shared paths take fewer: to see
that takes 0.13 to 0.28 processor seconds (metal_blade, corner, cookie_bag), and where they do, they save half."""
_SHARING, _CLEARLY = 2, 0.7
"""Replicates that tell whether shared paths take fewer, and the part of others' variance times paths below which they
are taken to: two tell it to a fifth (corner 0.27, 0.32, 0.34, where four tell 0.31, 0.30, 0.34), and may miss heavy
paths (cookie_bag 0.98, and the run took 24 processor seconds in place of 20)."""
_OF_CLOSER = 4
"""Samples of closer replicates over those that tell what layers change of indirect light: it changes alike in all."""
_OPEN = 0.15
"""Part of the accuracy that noise may leave open of what coarse cells for indirect light change: a fiftieth of the
budget's square. Where more is, the capture follows ten times as many paths as the closer replicates, or more (corner at
5e-4, first replicates: 1e-3 open, and 110 processor seconds in place of 33)."""


class Bounced(NamedTuple):
    """Light from the projector's side, replicate by replicate; what of it is indirect light; and samples of each."""

    replicates: list[PathSamples]
    indirect: list[PathSamples]
    samples: int

    @classmethod
    def of(cls, replicates: list[PathSamples], samples: int) -> Bounced:
        """That of ``replicates`` of so many ``samples``."""
        indirect = [light.where(light.kind == records.INDIRECT) for light in replicates]
        return cls(replicates, indirect, samples)

    @property
    def is_indirect(self) -> bool:
        """Whether it is all indirect light; else some came over mirrors or curved glass."""
        return sum(light.value.size for light in self.indirect) == sum(light.value.size for light in self.replicates)


# -------- All effects, and each switched off


class EffectRuns:
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
    as_direct
        gives parts that one cell a pixel, and one layer, leave of direct light, as far as known.
    """

    def __init__(
        self,
        bench: Apparatus,
        everything: Settings,
        sample: Sample,
        seed: int,
        layers: tuple[float, ...] = (),
        accuracy: float = math.inf,
        as_direct: Callable[[], tuple[float, float]] = lambda: (math.inf, math.inf),
    ) -> None:
        self.bench, self.everything, self.sample, self.layers = bench, everything, sample, layers
        self.accuracy, self._as_direct = accuracy, as_direct
        self.seeds = [integer(seed, "pilot", "effects", replicate) for replicate in range(REPLICATES)]
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
    def changes(self) -> dict[Approximation, FloatArray]:
        """Change of the frames by each effect that they have, and by coarse cells for indirect light."""
        shown = [name for name in EFFECTS if name in self.everything.effects and EFFECTS[name].in_frames]
        found = {Approximation(name): self.frames - self._without(EFFECTS[name]) for name in shown}
        return {**found, **self._coarse}

    @cached_property
    def _coarse(self) -> dict[Approximation, FloatArray]:
        """Change of the frames by coarse cells for indirect light; none where there is no such light."""
        if self._is_faint or not any(light.value.size for light in self._closer.indirect):
            return {}
        changes = coarsening_changes("indirect", self._indirect, ())
        if self.layers:
            layered, one = (self._indirect(1, layers, self._few) for layers in (self.layers, ()))
            changes[Approximation("indirect layers", 1)] = layered - one
        return changes

    @cached_property
    def _is_faint(self) -> bool:
        """Whether so little light is indirect that one coarse cell a pixel, and one layer, serve."""
        direct = sum(float(light.value.sum()) for light in self.direct) / (REPLICATES * self.sample.direct)
        part = self.received / (direct + self.received) if self.received else 0.0
        # Direct light that lies in its cells tells nothing of indirect light.
        return 0 < _AS_ROUGH * max(self._as_direct()) * part < GOOD_ENOUGH * self.accuracy

    @property
    def coarse(self) -> tuple[float, float]:
        """Parts that one cell a pixel, and one layer, leave of indirect light."""
        light = norm(self._indirect(1, ())) if self._coarse else 0.0
        if not light:
            return math.inf, math.inf
        parts = (Approximation(f"indirect {each}", 1) for each in ("cells", "layers"))
        cells, layer = (norm(self._coarse[part]) / light if part in self._coarse else 0.0 for part in parts)
        return cells, layer

    def _indirect(self, cells: int, layers: tuple[float, ...], seen: Bounced | None = None) -> FloatArray:
        """Frames of indirect light that was ``seen``, of closer replicates where not given, in coarse cells and layers;
        of the mean wavelength and of what the shots show alone, as those of :class:`AnchorRuns`."""
        seen = seen or self._closer
        effects = self.everything.effects - {"black-level"}
        coarse = replace(
            self.everything, effects=effects, coarse_cells=cells, coarse_layers=bool(layers), layers=layers
        )
        simulation = self.sample.simulation(self.bench, coarse, one_line=True)
        return self._form(simulation, followed={"indirect": seen.indirect}, samples=seen.samples)

    def _noise_of_bounced(self, seen: Bounced) -> float:
        """Error of a replicate of light that was ``seen``."""
        if seen.is_indirect:
            return noise(self._indirect(1, (), seen))
        followed = self._by_kind({"indirect": seen.replicates})
        return noise(self._form(self.simulation, followed=followed, samples=seen.samples))

    @property
    def _closer(self) -> Bounced:
        """Light from the projector's side in closer replicates."""
        return self._looks[1]

    @property
    def _few(self) -> Bounced:
        """The first of these samples: layers change the same in all of them."""
        return self._looks[0]

    @cached_property
    def _looks(self) -> tuple[Bounced, Bounced]:
        """Looks at the projector's side's light: more where noise hides what coarse cells change."""
        first, tracer = Bounced.of(self.followed["indirect"], self.sample.followed), self.simulation.indirect
        if tracer is None or self._is_faint or not any(light.value.size for light in first.indirect):
            return first, first
        seen = coarsening_changes("indirect", partial(self._indirect, seen=first), ())
        value, bound = ErrorCovariance.between(seen, self.light**2).estimate(seen)
        wanted = math.ceil(first.samples * (bound**2 - value**2) / (_OPEN * self.accuracy) ** 2)
        cost = SampleCost.relative(self._noise_of_bounced(first), self.light, first.samples, 1)
        most = _OF_INDIRECT * float(cost.noise.samples_for(self.accuracy)) / REPLICATES
        more = min(wanted, self.sample.closer(tracer.paths_per_sample), math.ceil(most))
        if more <= first.samples:
            return first, first
        # Seeds of their own: that the first replicates are vague says nothing of these.
        seeds, few = [integer(seed, "closer") for seed in self.seeds], math.ceil(more / _OF_CLOSER)
        some, whole = tracer.replicates(seeds, few, more)
        return Bounced.of(some, few), Bounced.of(whole, more)

    @property
    def received(self) -> float:
        """Light that is followed, as irradiance at the sensor's centre [W m^-2]."""
        light = sum(float(replicate.value.sum()) for replicates in self.followed.values() for replicate in replicates)
        return light / (REPLICATES * self.sample.followed)

    @property
    def apart(self) -> dict[str, float]:
        """Error of leaving out each effect that is drawn with the sensor's noise: speckle's contrast."""
        effects = self.everything.effects
        return {name: self.simulation.physics.speckle for name in effects if not EFFECTS[name].in_frames}

    @property
    def paths_per_sample(self) -> dict[str, int]:
        """Paths in a sample of each tracer."""
        return {name: paths_per_sample for name, (_, _, paths_per_sample) in self._noise.items()}

    def sample_cost(self, name: str) -> SampleCost:
        """Monte Carlo error of one estimate by the pass ``name``, relative to all light, and its paths."""
        if name not in self._noise:
            return SampleCost.none()
        error, samples, paths_per_sample = self._noise[name]
        return SampleCost.relative(error, self.light, samples, paths_per_sample)

    def with_more(self, samples: int) -> SampleCost:
        """Sample cost of from-camera light, measured anew by replicates of so many ``samples``."""
        tracer = self.simulation.from_camera
        if tracer is None or not self.light:
            return SampleCost.none()
        seen = [heavy_paths(tracer, integer(seed, "heavy"), samples) for seed in self.seeds]
        frames = self._form(self.simulation, followed=self._by_kind({"from_camera": seen}), samples=samples)
        paths = np.concatenate([replicate.value for replicate in seen])
        return SampleCost(Noise.among(frames, self.light, samples, paths), tracer.paths_per_sample)

    def indirect_cost(self) -> tuple[SampleCost, bool, tuple[int, ...]]:
        """What light over several surfaces takes, whether that is less where neighbouring pixels share it, and how
        often each block of pixels is followed in a sample."""
        sample_cost, shared = self._shared_or_not
        repeats, (variance, paths) = self._repeats
        if variance * paths > _WORTH_REPEATING:
            return sample_cost, shared, ()
        noise_left = replace(sample_cost.noise, error=sample_cost.noise.error * math.sqrt(variance))
        return replace(sample_cost, noise=noise_left, paths=math.ceil(sample_cost.paths * paths)), shared, repeats

    @cached_property
    def _repeats(self) -> tuple[tuple[int, ...], tuple[float, float]]:
        """Paths of each block of pixels in a sample, and what that makes of variance and paths, by other replicates."""
        pixels = self.bench.n
        moments = [block_moments(replicate.pixel, replicate.value, pixels) for replicate in self._closer.indirect]
        repeats = adaptive_counts(np.sum(moments, axis=0))
        # Judged by replicates that had no say, a half each: a single heavy path recommends only its own block.
        halves = np.sum(moments[::2], axis=0), np.sum(moments[1::2], axis=0)
        judged = [effect_of(adaptive_counts(one), other) for one, other in (halves, halves[::-1])]
        variance, paths = np.mean(judged, axis=0)
        return tuple(int(count) for count in repeats.ravel()), (float(variance), float(paths))

    @cached_property
    def _shared_or_not(self) -> tuple[SampleCost, bool]:
        """What light over several surfaces takes, and whether it is shared."""
        plain = self.sample_cost("indirect")
        taken = plain.noise.samples_for(self.accuracy) * plain.paths * PASSES["indirect"].unit_cost
        if not plain.noise.error or taken < _WORTH_SHARING_S:
            return plain, False
        tracer = self._sharing.indirect
        if not isinstance(tracer, PathReuseTracer) or not tracer.shares():
            return plain, False
        samples = max(1, self._closer.samples // SHARED_COST)
        seen = tracer.replicates([integer(seed, "shared") for seed in self.seeds[:_SHARING]], samples)[0]
        seen += [PathSamples.none()] * (REPLICATES - _SHARING)
        frames = self._indirect(1, (), Bounced.of(seen, samples))[:_SHARING]
        shared = SampleCost.relative(noise(frames), self.light, samples, SHARED_COST * tracer.paths_per_sample)
        less = shared.variance * shared.paths < _CLEARLY * plain.variance * plain.paths
        return (shared, True) if less else (plain, False)

    @cached_property
    def _sharing(self) -> Simulation:
        return self.sample.simulation(self.bench, replace(self.everything, shared=True))

    @property
    def sample_costs(self) -> dict[str, SampleCost]:
        """Sample costs of all passes that are traced to one point of the sensor, and of sharp pixels if there are
        any."""
        found = {name: self.sample_cost(name) for name in _FOLLOWED}
        tracer = self.simulation.sharp
        return {**found, "sharp": self._sharp_cost(tracer.paths_per_sample)} if tracer else found

    def _sharp_cost(self, paths_per_sample: int) -> SampleCost:
        """That of pixels that are traced apart, their rate being that of stratified rays."""
        samples, error = self.sample.sharp(self.simulation), noise(self._form(self.simulation, sharp=self.sharp))
        return SampleCost.relative(error, self.light, samples, paths_per_sample, SHARP_RATE)

    @cached_property
    def _noise(self) -> dict[str, tuple[float, int, int]]:
        """Error of a replicate by each tracer, the replicate's samples, and paths of one."""
        found = {}
        for name, each in self.simulation.passes.items():
            if name in _FOLLOWED:
                if name == "indirect":
                    error, samples = self._noise_of_bounced(self._closer), self._closer.samples
                else:
                    samples = self.sample.followed
                    seen = self._by_kind({name: self.followed[name]})
                    error = noise(self._form(self.simulation, followed=seen, samples=samples))
                found[name] = error, samples, each.tracer.paths_per_sample
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

    def _direct(self, simulation: Simulation) -> list[PathSamples]:
        return simulation.direct.replicates(self.seeds, self.sample.direct)[0]

    def _follow(self, simulation: Simulation, name: str) -> list[PathSamples]:
        """Light of the pass ``name``, replicate by replicate."""
        loaded = self.bench.loaded
        # Light comes over several surfaces only where one sees another.
        none = name in _OVER_SEVERAL and loaded.one_way and not (loaded.lamps or loaded.mirrors)
        tracer = None if none else PASSES[name].tracer(simulation)
        if tracer is None:
            return [PathSamples.none()] * REPLICATES
        seeds, samples = [integer(seed, name) for seed in self.seeds], self.sample.followed
        if not hasattr(tracer, "replicates"):  # as of a pass that somebody added
            return [tracer.trace(seed, 0, samples) for seed in seeds]
        return tracer.replicates(seeds, samples)[0]

    @staticmethod
    def _by_kind(followed: dict[str, list[PathSamples]]) -> dict[str, list[PathSamples]]:
        """Light of several tracers together by its kind, replicate by replicate."""
        replicates = [PathSamples.join(replicates) for replicates in zip(*followed.values(), strict=True)]
        return {
            name: [replicate.where(replicate.kind == kind) for replicate in replicates] for name, kind in KINDS.items()
        }

    def _sharp(self, simulation: Simulation) -> list[PathSamples]:
        """Light of pixels that are traced apart, replicate by replicate."""
        tracer, samples = simulation.sharp, self.sample.sharp(simulation)
        if tracer is None:
            return []
        return tracer.replicates([integer(seed, "sharp") for seed in self.seeds], samples)[0]

    def _form(
        self,
        simulation: Simulation,
        direct: Sequence[PathSamples] = (),
        followed: Mapping[str, Sequence[PathSamples]] = MappingProxyType({}),
        sharp: Sequence[PathSamples] = (),
        samples: int | None = None,
    ) -> FloatArray:
        """Frames of light replicate by replicate, where there is any; ``samples`` of followed light, if not as many as
        of all."""
        sample, known, physics = self.sample, self._known, simulation.physics
        light, few = emission(physics, sample.lighting), samples or sample.followed
        grids = simulation.grids
        parts = [(grids["fine"], direct, sample.direct), (grids["fine"], followed.get("direct", ()), few)]
        parts.append((grids["sharp"], sharp, sample.sharp(simulation)))
        if physics.interreflection:
            parts.append((grids["indirect"], followed.get("indirect", ()), few))
        frames = np.zeros((REPLICATES, len(light), *sample.shape))
        for grid, replicates, count in parts:
            if any(replicate.value.size for replicate in replicates):
                frames += sample.frames(grid, replicates, count, light, known)
        lamps = followed.get("ambient", ())
        if physics.lamps and lamps:
            frames += sample.lamps(simulation.ambient["fine"], lamps, few, known)
        specular = simulation.specular_frames(sample.lighting.labels)
        return frames if specular is None else frames + np.tensordot(light[:, specular.classes], specular.irradiance, 1)


# -------- Light at anchors of the sensor

_JUDGE = 2
"""Index of the number of anchors that judges at first: two steps tell how fast the error falls."""
WIDTHS = (1, 2, 4)
"""Projector pixels a side of a cell that are tried: what anchors see beyond their mean is little light, and need not be
as fine as all of it; wider cells hold light of many anchors in memory."""
_AT_ONCE = 2**20
"""Connections that are traced at a time: 0.5 GB while they are accumulated."""
_AS_ROUGH = 15.0
"""Part that one cell, or layer, leaves of what a few anchors see beyond their mean, over what it leaves of all their
light, at most (photograph 3.9, cards 4.2, gift_card 5.6, metal_blade 6.3, cookie_bag 7.4); and that part of indirect
light over that of direct light (corner 0.13, cookie_bag 1.3, metal_blade 5 to 9, most of it noise)."""
_FAINT = 0.6
"""Part of the tolerance for followed light that makes up what direct light may leave."""
_FOLLOWED_JUDGE = 1
"""Index of the number that judges at first, for light that is followed."""


class AnchorRuns:
    """The frames with fewer anchors; every anchor is connected to the same points, so little noise is left.

    Frames, not radiance: the falloff's error is odd in the scene's coordinates and mostly cancels in a frame. Of one
    wavelength: anchors change the same with all (to 0.2 % in photograph, cards and corner), coarse cells at most a
    quarter less.

    Parameters
    ----------
    bench, base
        what is traced, and the settings that are varied.
    sample
        shots and samples.
    tolerance
        norm of a change at which the search for enough may stop.
    seed
        root of the random streams.
    layers
        depths [mm] that judge one layer; none for a flat scene.
    lit
        whether other replicates found any such light, where that is not certain.

    Attributes
    ----------
    traced
        light by number of anchors, replicate by replicate.
    coarse
        parts that one cell a pixel, and one layer, leave of such light as a whole, over what all may leave.
    """

    _pass = PASSES["anchor_residual"]
    _stream = "fine"
    ladder: tuple[int, ...] = (1, 2, 3, 5, 8)
    """Numbers that are tried, each step about half the error of the one before or less."""
    few = 3
    """Anchors whose noise is measured: fewer leave a plan's choice to them unseen."""

    def __init__(
        self,
        bench: Apparatus,
        base: Settings,
        sample: Sample,
        tolerance: float,
        seed: int,
        layers: tuple[float, ...] = (),
        lit: bool = True,
    ) -> None:
        self.bench, self.base, self.sample, self.tolerance = bench, base, sample, tolerance
        self.layers, self._lit = layers, lit
        self.traced: dict[int, list[PathSamples]] = {}
        self.coarse = math.inf, math.inf
        self._seeds = [integer(seed, "pilot", self._stream, replicate) for replicate in range(REPLICATES)]
        self._frames: Callable[[int], FloatArray] = cache(self._at_anchors)
        self._beyond_mean: Callable[..., FloatArray] = cache(self._in_cells)
        self._choose(sample)

    def _choose(self, sample: Sample) -> None:
        """Pixels that are followed, and samples of each in a replicate."""
        self.pixels = np.setdiff1d(shown_pixels(self.base, sample), self.base.occluded)
        self._samples, self._lanes = sample.anchored, self.bench.n**2 - len(self.base.occluded)

    def take_over(self, known: Mapping[int, Sequence[PathSamples]]) -> None:
        """Use light of as many samples that is ``known`` by anchors, of all these pixels and of others, and trace it no
        more."""
        for anchors, replicates in known.items():
            self.traced[anchors] = [light.where(np.isin(light.pixel, self.pixels)) for light in replicates]

    @property
    def paths(self) -> int:
        """Paths of all replicates to one anchor."""
        return REPLICATES * len(self.pixels) * self._samples

    @property
    def connections(self) -> int:
        """Connections of each path to all anchors that were tried."""
        return sum(part.count**2 for part in self.changes if part.name == self._pass.anchors)

    @cached_property
    def changes(self) -> dict[Approximation, FloatArray]:
        """Change of the frames by every number of anchors that was tried, and by coarse cells for what they see beyond
        their mean, where that may be too much."""
        changes, (cells, layers) = self._until(self.tolerance), self._worth_a_look
        if not (cells or layers):
            return changes
        return {**changes, **coarsening_changes(self._pass.name, self._coarsen, layers)}

    @property
    def _worth_a_look(self) -> tuple[bool, tuple[float, ...]]:
        """Whether coarse cells, and which layers, may change too much of what a few anchors see beyond their mean."""
        most = _AS_ROUGH * norm(self._beyond_mean())
        cells, layer = (most * part > 1 for part in self.coarse)
        return cells, self.layers if layer else ()

    @property
    def of_few(self) -> dict[Approximation, FloatArray]:
        """Change of the frames by the numbers of anchors that are always tried, as far as they tell."""
        return self._until(math.inf)

    def _until(self, tolerance: float, judge: int = _JUDGE) -> dict[Approximation, FloatArray]:
        found = ladder(self.ladder, self._frames, judge, tolerance)
        return {Approximation(self._pass.anchors, count): change for count, change in found.items()}

    def sample_costs(self, light: float) -> dict[str, SampleCost]:
        """Monte Carlo error of one estimate of what a few anchors see beyond their mean, relative to all ``light``, by
        pass."""
        return {self._pass.name: SampleCost.relative(noise(self._beyond_mean()), light, self._samples, self._lanes)}

    def _coarsen(self, cells: int, layers: tuple[float, ...]) -> FloatArray:
        coarse = {"coarse_cells": cells, "coarse_layers": bool(layers), "layers": layers}
        return self._beyond_mean(**coarse) if cells > 1 or layers else self._beyond_mean()

    def _in_cells(self, **cells: Any) -> FloatArray:
        """Frames of what a few anchors see beyond their mean, in such ``cells``."""
        return self._beyond(self._simulation(self.few, **cells), self._few, None if cells else self._frames(self.few))

    def _beyond(
        self,
        simulation: Simulation,
        replicates: Sequence[PathSamples],
        frames: FloatArray | None = None,
        samples: int | None = None,
    ) -> FloatArray:
        """Frames of light to a few anchors beyond its mean, in a ``simulation``; of all of it, where they are known."""
        weights, grids = simulation.mean_weights(self.few), self._grids(simulation)
        mean = [replicate.average(weights) for replicate in replicates]
        frames = self._form(grids, replicates, samples) if frames is None else frames
        return frames - self._form([grid.of_mean for grid in grids], mean, samples)

    @cached_property
    def _few(self) -> list[PathSamples]:
        """Light to a few anchors, replicate by replicate."""
        return self._trace(self._simulation(self.few))

    def _at_anchors(self, anchors: int) -> FloatArray:
        simulation = self._simulation(anchors)
        return self._form(self._grids(simulation), self._few if anchors == self.few else self._trace(simulation))

    def _simulation(self, anchors: int = 1, **cells: Any) -> Simulation:
        cells[self._pass.anchors] = anchors
        settings = replace(self.base, **cells)
        return self.sample.simulation(self.bench, settings, one_line=True)

    def _grids(self, simulation: Simulation) -> list[Grid]:
        """Where the light is accumulated, and that of lamps where there are any."""
        name = self._pass.grid
        lamps = [simulation.ambient[name]] if self.bench.loaded.lamps and name in simulation.ambient else []
        return [simulation.grids[name], *lamps]

    def _trace(self, simulation: Simulation) -> list[PathSamples]:
        """Light to every anchor, replicate by replicate."""
        anchors = self._grids(simulation)[0].bundle.anchors
        if anchors not in self.traced:
            tracer = tracer_of(simulation, self.pixels, anchors)
            self.traced[anchors] = tracer.replicates(self._seeds, self._samples)[0]
        return self.traced[anchors]

    def _form(self, grids: Sequence[Grid], replicates: Sequence[PathSamples], samples: int | None = None) -> FloatArray:
        """(replicates, shots, places, places) frames of light in ``grids``; of so many ``samples``, if not of as many
        as others."""
        samples = samples or self._samples
        frames = self.sample.frames(grids[0], replicates, samples)
        return frames + self.sample.lamps(grids[1], replicates, samples) if len(grids) > 1 else frames


class PenumbraRuns(AnchorRuns):
    """The same of occluded pixels, which many anchors see. An edge's penumbra has kinks, at which interpolation between
    N anchors errs by about 1 / N^1.5; 32 leave a hundredth of what one does."""

    _pass = PASSES["penumbra"]
    ladder = (1, 2, 3, 5, 8, 16, 32)
    few = 5

    def _choose(self, sample: Sample) -> None:
        self.pixels = np.intersect1d(shown_pixels(self.base, sample), self.base.occluded)
        self._samples, self._lanes = sample.samples_of_occluded(len(self.pixels)), len(self.base.occluded)


class FollowedRuns(AnchorRuns):
    """The same of light that is followed, of settings with all effects on; to every anchor go the same paths.

    Attributes
    ----------
    before
        the same of their first samples alone, which are not traced again.
    """

    _pass = PASSES["indirect_residual"]
    _stream = "followed"
    ladder = (1, 2, 3, 5, 8, 12)
    few = 2
    passes = "indirect_residual", "camera_residual"
    """From the projector's side, and from the camera's."""

    def __init__(self, *arguments: Any, before: FollowedRuns | None = None, **others: Any) -> None:
        """Nothing is traced yet.

        Parameters
        ----------
        arguments, others
            as for :class:`AnchorRuns`.
        before
            what the first samples told, if they were looked at.
        """
        self.before = before
        super().__init__(*arguments, **others)

    def _choose(self, sample: Sample) -> None:
        self._all_samples = sample.followed
        self._first = self.before._all_samples if self.before else 0
        self._samples = self._all_samples - self._first

    @cached_property
    def changes(self) -> dict[Approximation, FloatArray]:
        """Change of the frames by every number of anchors that was tried; none where there is no such light."""
        if not self._lit or not _tracers(self._simulation()) or not norm(self._frames(1)):
            return {}
        anchors = self._until(self.tolerance, _FOLLOWED_JUDGE)
        # Where the judge was never judged, few anchors serve, and their light is held in any cells.
        return {**anchors, **self._widths} if len(anchors) > _FOLLOWED_JUDGE + 1 else anchors

    def sample_costs(self, light: float) -> dict[str, SampleCost]:
        """The same, relative to all ``light``, from the projector's side and from the camera's."""
        tracers = self._simulation().at_anchors
        if not self.changes:
            return dict.fromkeys(self.passes, SampleCost.none())
        every = self._beyond_mean()
        seen = (every, every) if None in tracers else (every - self._from_camera, self._from_camera)
        return {
            name: SampleCost.relative(noise(each), light, self._all_samples, tracer.paths_per_sample)
            if tracer
            else SampleCost.none()
            for name, each, tracer in zip(self.passes, seen, tracers, strict=True)
        }

    @property
    def _camera_is_faint(self) -> bool:
        """Whether more anchors than few need not see the camera's part: it and its noise differ little from anchor to
        anchor."""
        if None in self._simulation(self.few).at_anchors:
            return False
        return math.sqrt(float(np.square(self._from_camera).sum()) / REPLICATES) < _FAINT * self.tolerance

    @cached_property
    def _from_camera(self) -> FloatArray:
        """The camera's part of the frames of what a few anchors see beyond their mean."""
        seen = self._beyond(self._simulation(self.few), self._few_by_tracer[1])
        return self._with_first(seen, lambda before: before._from_camera)

    def with_more(self, light: float, samples: int) -> SampleCost:
        """That of what is followed from the camera, by replicates of so many ``samples``; ``light`` as for those."""
        simulation = self._simulation(self.few)
        tracer, one = simulation.at_anchors[1], self._simulation().at_anchors[1]
        if tracer is None or one is None or not self.changes or not light:
            return SampleCost.none()
        seen = [heavy_paths(tracer, integer(seed, "heavy"), samples) for seed in self._seeds]
        frames = self._beyond(simulation, seen, samples=samples)
        # The heaviest paths come to one anchor of several: each connection counts.
        found = Noise.among(frames, light, samples, np.concatenate([replicate.value for replicate in seen]))
        return SampleCost(found, one.paths_per_sample)

    @property
    def _widths(self) -> dict[Approximation, FloatArray]:
        """Change of the frames by every width of cells for what a few anchors see beyond their mean."""
        one, (cells, layers) = self._beyond_mean(), self._worth_a_look
        missing = (self._beyond_mean(coarse_cells=2) - one) / (1 - EVEN_CELLS) if cells else np.zeros_like(one)
        layered = self._beyond_mean(coarse_layers=True, layers=layers) if layers else one
        wide = {width: layered + missing - self._beyond_mean(followed_width=width) for width in WIDTHS[1:]}
        return {Approximation("followed_width", width): change for width, change in {1: missing, **wide}.items()}

    @cached_property
    def _few(self) -> list[PathSamples]:
        return _join(self._few_by_tracer)

    @cached_property
    def _few_by_tracer(self) -> list[list[PathSamples]]:
        """The same by tracer."""
        tracers = _tracers(self._simulation(self.few))
        return [tracer.replicates(self._seeds, self._samples, first=self._first)[0] for tracer in tracers]

    def _at_anchors(self, anchors: int) -> FloatArray:
        simulation, samples = self._simulation(anchors), self._samples
        grids, tracers = self._grids(simulation), _tracers(simulation)
        if anchors == self.few:
            return self._with_first(self._form(grids, self._few), lambda before: before._frames(anchors))
        found = []
        if anchors > self.few and self._camera_is_faint:
            tracers = tracers[:1]
            found.append(self._form(self._grids(self._simulation(self.few)), self._few_by_tracer[1]))
        each = max(1, _AT_ONCE // (REPLICATES * sum(tracer.paths_per_sample for tracer in tracers)))
        for first in range(0, samples, each):
            some = min(each, samples - first)
            traced = [tracer.replicates(self._seeds, some, first=self._first + first)[0] for tracer in tracers]
            found.append(self._form(grids, _join(traced)))
        return self._with_first(np.asarray(sum(found)), lambda before: before._frames(anchors))

    def _in_cells(self, **cells: Any) -> FloatArray:
        if self.before is None:
            return super()._in_cells(**cells)
        seen = self._beyond(self._simulation(self.few, **cells), self._few)
        return self._with_first(seen, lambda before: before._beyond_mean(**cells))

    def _with_first(self, seen: FloatArray, of: Callable[[FollowedRuns], FloatArray]) -> FloatArray:
        """Frames of all samples, from those that were ``seen`` of the new ones and those ``of`` the first."""
        if self.before is None:
            return seen
        return seen + (self._first / self._all_samples) * (of(self.before) - seen)


def _tracers(simulation: Simulation) -> list[PassTracer]:
    return [tracer for tracer in simulation.at_anchors if tracer is not None]


def _join(traced: Sequence[list[PathSamples]]) -> list[PathSamples]:
    """Light of several tracers together, replicate by replicate."""
    return [PathSamples.join(replicates) for replicates in zip(*traced, strict=True)]
