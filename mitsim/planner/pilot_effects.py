"""A bench with all effects, and with each switched off, in; what that changes of the frames, and noise of each
pass, out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import DIRECT, EFFECTS, FOLLOWED, Effect
from mitsim.core.arrays import FloatArray
from mitsim.core.seeds import integer
from mitsim.light.cost_model import SHARED_COST
from mitsim.light.passes import PASSES
from mitsim.light.settings import REPLICATES, Approximation, ErrorCovariance, Noise, SampleCost, Settings
from mitsim.light.simulation import Simulation, emission
from mitsim.planner.pilot_anchors import AS_ROUGH
from mitsim.planner.pilot_direct import SHARP_RATE
from mitsim.planner.pilot_samples import (
    GOOD_ENOUGH,
    Known,
    Sample,
    coarsening_changes,
    heavy_paths,
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
        return 0 < AS_ROUGH * max(self._as_direct()) * part < GOOD_ENOUGH * self.accuracy

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
