"""A bench with all effects, and with each switched off: what that changes of the frames, and noise of each pass."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from types import MappingProxyType

import numpy as np

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import DIRECT, EFFECTS, FOLLOWED, Effect
from mitsim.core.arrays import FloatArray
from mitsim.core.seeds import integer
from mitsim.light.cost_model import SHARED_COST
from mitsim.light.passes import PASSES
from mitsim.light.pilot_result import REPLICATES, Approximation, ErrorCovariance, Noise, SampleCost
from mitsim.light.settings import Settings
from mitsim.light.simulation import Simulation, emitted
from mitsim.planner.pilot_direct import SHARP_RATE
from mitsim.planner.pilot_samples import Known, Sample, coarsened, heavy_paths, noise, norm
from mitsim.transport import records
from mitsim.transport.indirect import adaptive_counts, block_moments, effect_of
from mitsim.transport.integrator import KINDS
from mitsim.transport.path_reuse import PathReuseTracer
from mitsim.transport.records import PathSamples

_FOLLOWED = tuple(name for name, row in PASSES.items() if not (row.even or row.anchors))
"""Passes of light that is followed to one point of the sensor."""
_WORTH_REPEATING = 0.85
"""Variance times paths, over that of even ones, below which blocks are followed unevenly: short replicates tell it so
well."""
_OPEN = 0.1
"""Part of the accuracy that noise may leave open of what coarse cells for indirect light change: a hundredth of the
budget's square. Where more is, the capture follows ten times as many paths as the closer replicates, or more (corner at
5e-4, first replicates: 1e-3 open, and 110 processor seconds in place of 33)."""


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
        if not any(light.value.size for light in self._bounced):
            return {}
        return coarsened("indirect", partial(self._indirect, self._bounced, self._closer[1]), self.layers)

    def _indirect(
        self, bounced: Sequence[PathSamples], samples: int, cells: int, layers: tuple[float, ...]
    ) -> FloatArray:
        """Frames of ``bounced`` light in so many samples, in coarse cells and layers."""
        coarse = replace(self.everything, coarse_cells=cells, coarse_layers=bool(layers), layers=layers)
        simulation = self.sample.simulation(self.bench, coarse)
        return self._form(simulation, followed={"indirect": bounced}, samples=samples)

    @cached_property
    def _bounced(self) -> list[PathSamples]:
        """Indirect light from the projector's side in closer replicates, replicate by replicate."""
        replicates, _ = self._closer
        return self._first_bounced if replicates is self.followed["indirect"] else _indirect_of(replicates)

    @cached_property
    def _first_bounced(self) -> list[PathSamples]:
        return _indirect_of(self.followed["indirect"])

    @cached_property
    def _closer(self) -> tuple[list[PathSamples], int]:
        """Looks at the projector's side's light, and their samples: more where noise hides what coarse cells change."""
        replicates, samples, tracer = self.followed["indirect"], self.sample.followed, self.simulation.indirect
        if tracer is None or not any(light.value.size for light in self._first_bounced):
            return replicates, samples
        seen = coarsened("indirect", partial(self._indirect, self._first_bounced, samples), ())
        value, bound = ErrorCovariance.between(seen, self.light**2).estimate(seen)
        wanted = math.ceil(samples * (bound**2 - value**2) / (_OPEN * self.accuracy) ** 2)
        more = min(wanted, self.sample.closer(tracer.paths_per_sample))
        if more <= samples:
            return replicates, samples
        # Seeds of their own: that the first replicates are vague says nothing of these.
        return [tracer.trace(integer(seed, "closer"), 0, more) for seed in self.seeds], more

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
        relative = error / self.light if self.light else 0.0
        return SampleCost(Noise(relative, samples, 0.5), paths_per_sample)

    def with_more(self, samples: int) -> SampleCost:
        """The same of what is followed from the camera, by replicates of so many ``samples`` of their own."""
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
        moments = [block_moments(replicate.pixel, replicate.value, pixels) for replicate in self._bounced]
        repeats = adaptive_counts(np.sum(moments, axis=0))
        # Judged by replicates that had no say, a half each: a single heavy path recommends only its own block.
        halves = np.sum(moments[::2], axis=0), np.sum(moments[1::2], axis=0)
        judged = [effect_of(adaptive_counts(one), other) for one, other in (halves, halves[::-1])]
        variance, paths = np.mean(judged, axis=0)
        return tuple(int(count) for count in repeats.ravel()), (float(variance), float(paths))

    @cached_property
    def _shared_or_not(self) -> tuple[SampleCost, bool]:
        """What light over several surfaces takes, and whether it is shared."""
        plain, tracer = self.sample_cost("indirect"), self._sharing.indirect
        if not plain.noise.error or not isinstance(tracer, PathReuseTracer) or not tracer.shares():
            return plain, False
        samples = max(1, self._closer[1] // SHARED_COST)
        seen = [tracer.trace(integer(seed, "shared"), 0, samples) for seed in self.seeds]
        error = noise(self._form(self._sharing, followed=self._by_kind({"indirect": seen}), samples=samples))
        error /= self.light
        shared = SampleCost(Noise(error, samples, 0.5), SHARED_COST * tracer.paths_per_sample)
        less = shared.variance * shared.paths < plain.variance * plain.paths
        return (shared, True) if less else (plain, False)

    @cached_property
    def _sharing(self) -> Simulation:
        return self.sample.simulation(self.bench, replace(self.everything, shared=True))

    @property
    def sample_costs(self) -> dict[str, SampleCost]:
        """That of every pass that is followed to one point of the sensor, and of sharp pixels where there are any."""
        found = {name: self.sample_cost(name) for name in _FOLLOWED}
        tracer = self.simulation.sharp
        return {**found, "sharp": self._sharp_cost(tracer.paths_per_sample)} if tracer else found

    def _sharp_cost(self, paths_per_sample: int) -> SampleCost:
        """That of pixels that are traced apart, their rate being that of stratified rays."""
        samples = self.sample.sharp(self.simulation)
        error = noise(self._form(self.simulation, sharp=self.sharp))
        relative = error / self.light if self.light else 0.0
        return SampleCost(Noise(relative, samples, SHARP_RATE), paths_per_sample)

    @cached_property
    def _noise(self) -> dict[str, tuple[float, int, int]]:
        """Error of a replicate by each tracer, the replicate's samples, and paths of one."""
        found = {}
        for name, each in self.simulation.passes.items():
            if name in _FOLLOWED:
                first = self.followed[name], self.sample.followed
                replicates, samples = self._closer if name == "indirect" else first
                frames = self._form(self.simulation, followed=self._by_kind({name: replicates}), samples=samples)
                found[name] = noise(frames), samples, each.tracer.paths_per_sample
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
        return [simulation.direct.trace(seed, 0, self.sample.direct) for seed in self.seeds]

    def _follow(self, simulation: Simulation, name: str) -> list[PathSamples]:
        """Light of the pass ``name``, replicate by replicate."""
        tracer = PASSES[name].tracer(simulation)
        if tracer is None:
            return [PathSamples.none()] * REPLICATES
        return [tracer.trace(integer(seed, name), 0, self.sample.followed) for seed in self.seeds]

    @staticmethod
    def _by_kind(followed: dict[str, list[PathSamples]]) -> dict[str, list[PathSamples]]:
        """Light of several tracers together by its kind, replicate by replicate."""
        replicates = [PathSamples.joined(replicates) for replicates in zip(*followed.values(), strict=True)]
        return {
            name: [replicate.where(replicate.kind == kind) for replicate in replicates] for name, kind in KINDS.items()
        }

    def _sharp(self, simulation: Simulation) -> list[PathSamples]:
        """Light of pixels that are traced apart, replicate by replicate."""
        tracer, samples = simulation.sharp, self.sample.sharp(simulation)
        if tracer is None:
            return []
        return [tracer.trace(integer(seed, "sharp"), 0, samples) for seed in self.seeds]

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
        light, few = emitted(physics, sample.lighting), samples or sample.followed
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
        glint = simulation.specular_frames(sample.lighting.labels)
        return frames if glint is None else frames + np.tensordot(light[:, glint.classes], glint.irradiance, 1)


def _indirect_of(replicates: Sequence[PathSamples]) -> list[PathSamples]:
    """Indirect light in ``replicates``, replicate by replicate."""
    return [light.where(light.kind == records.INDIRECT) for light in replicates]
