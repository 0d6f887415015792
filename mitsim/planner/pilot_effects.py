"""Changes of the frames by anchors and effects, and the noise of each pass."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property, partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import DIRECT, EFFECTS, FOLLOWED
from mitsim.core.arrays import FloatArray
from mitsim.core.seeds import integer
from mitsim.light.cost_model import SHARED_COST
from mitsim.light.passes import PASSES, Grid, Simulation, emission
from mitsim.light.settings import REPLICATES, WIDE, Approximation, ErrorCovariance, SampleCost, Settings
from mitsim.planner.pilot_direct import (
    EVEN_CELLS,
    GOOD_ENOUGH,
    SHARP_RATE,
    Known,
    Sample,
    coarsening_changes,
    ladder,
    noise,
    norm,
    shown_pixels,
)
from mitsim.transport import records
from mitsim.transport.direct import DirectTracer
from mitsim.transport.integrator import KINDS, adaptive_counts, block_moments, effect_of
from mitsim.transport.path_reuse import PathReuseTracer
from mitsim.transport.records import PathSamples

_JUDGE = 2
_AT_ONCE = 2**20
_AS_ROUGH = 15.0
"""Limit of the change by one cell or layer of light beyond its mean over all, or indirect over direct (at most 9)."""
_FAINT = 0.6
_FOLLOWED_JUDGE = 1
_FOLLOWED = tuple(name for name, row in PASSES.items() if not (row.even or row.anchors))
"""Passes that follow light to one point of the sensor."""
_OVER_SEVERAL = "indirect", "from_camera"
"""Those passes that hold only light over several surfaces, in mirrors and of lamps."""
_WORTH_REPEATING = 0.85
_OF_INDIRECT = 0.2
_WORTH_SHARING_S = 0.5
"""Seconds of indirect light above which shared paths are tried."""
_SHARING, _CLEARLY = 2, 0.7
"""Replicates that try shared paths, and the ratio of variance times paths below which paths are shared."""
_CLOSER, _OF_CLOSER = 16, 4
"""Samples of a closer look in those of a replicate, and in those of its first part."""
_OPEN = 0.15
"""Part of the accuracy that noise may hide of the change of indirect light by one cell a pixel."""


# -------- Anchors


class AnchorRuns:
    """Frames with fewer anchors, each connected to the same points, so that differences have little noise.

    Frames are compared, not radiance, because most of the falloff's error cancels in a frame. ``coarse`` has the
    changes of such light by one cell a pixel, and by one layer, over the tolerance.
    """

    _pass = PASSES["anchor_residual"]
    _stream = "fine"
    ladder: tuple[int, ...] = (1, 2, 3, 5, 8)
    few = 3

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
        self._beyond_mean: Callable[[int, tuple[float, ...]], FloatArray] = cache(self._in_cells)
        self._choose(sample)

    def _choose(self, sample: Sample) -> None:
        self.pixels = np.setdiff1d(shown_pixels(self.base, sample), self.base.occluded)
        self._samples, self._lanes = sample.anchored, self.bench.n**2 - len(self.base.occluded)

    def take_over(self, known: Mapping[int, Sequence[PathSamples]]) -> None:
        for anchors, replicates in known.items():
            self.traced[anchors] = [light.where(np.isin(light.pixel, self.pixels)) for light in replicates]

    @property
    def paths(self) -> int:
        return REPLICATES * len(self.pixels) * self._samples

    @property
    def connections(self) -> int:
        return sum(part.count**2 for part in self.changes if part.name == self._pass.anchors)

    @cached_property
    def changes(self) -> dict[Approximation, FloatArray]:
        changes, (cells, layers) = self.until(self.tolerance), self._worth_a_look
        if not (cells or layers):
            return changes
        return {**changes, **coarsening_changes(self._pass.name, self._beyond_mean, layers)}

    @property
    def _worth_a_look(self) -> tuple[bool, tuple[float, ...]]:
        most = _AS_ROUGH * norm(self._beyond_mean(1, ()))
        cells, layer = (most * part > 1 for part in self.coarse)
        return cells, self.layers if layer else ()

    def until(self, tolerance: float, judge: int = _JUDGE) -> dict[Approximation, FloatArray]:
        found = ladder(self.ladder, self._frames, judge, tolerance)
        return {Approximation(self._pass.anchors, count): change for count, change in found.items()}

    def sample_costs(self, light: float) -> dict[str, SampleCost]:
        beyond = noise(self._beyond_mean(1, ()))
        return {self._pass.name: SampleCost.relative(beyond, light, self._samples, self._lanes)}

    def _in_cells(self, cells: int, layers: tuple[float, ...]) -> FloatArray:
        known = self._frames(self.few) if cells == 1 and not layers else None
        return self._beyond(self._simulation(self.few, cells, layers), self._few, known)

    def _beyond(
        self, simulation: Simulation, seen: Sequence[PathSamples], frames: FloatArray | None = None
    ) -> FloatArray:
        weights, grids = simulation.mean_weights(self.few), self._grids(simulation)
        mean = [replicate.average(weights) for replicate in seen]
        frames = self._form(grids, seen) if frames is None else frames
        return frames - self._form([replace(grid, bundle=replace(grid.bundle, anchors=1)) for grid in grids], mean)

    @cached_property
    def _few(self) -> list[PathSamples]:
        return self._trace(self._simulation(self.few))

    def _at_anchors(self, anchors: int) -> FloatArray:
        simulation = self._simulation(anchors)
        return self._form(self._grids(simulation), self._few if anchors == self.few else self._trace(simulation))

    def _simulation(self, anchors: int = 1, cells: int = 1, layers: tuple[float, ...] = ()) -> Simulation:
        changes: dict[str, Any] = {"coarse_layers": True, "layers": layers} if layers else {}
        settings = replace(self.base, **changes | {self._pass.anchors: anchors})
        return self.sample.simulation(self.bench, settings, one_line=True, judging_cells=cells)

    def _grids(self, simulation: Simulation) -> list[Grid]:
        name = self._pass.grid
        lamps = [simulation.ambient[name]] if self.bench.loaded.lamps and name in simulation.ambient else []
        return [simulation.grids[name], *lamps]

    def _trace(self, simulation: Simulation) -> list[PathSamples]:
        anchors = self._grids(simulation)[0].bundle.anchors
        if anchors not in self.traced:
            tracer = DirectTracer(simulation.setup, anchors, pixels=self.pixels)
            self.traced[anchors] = tracer.replicates(self._seeds, self._samples)[0]
        return self.traced[anchors]

    def _form(self, grids: Sequence[Grid], replicates: Sequence[PathSamples]) -> FloatArray:
        frames = self.sample.frames(grids[0], replicates, self._samples)
        return frames + self.sample.lamps(grids[1], replicates, self._samples) if len(grids) > 1 else frames


class PenumbraRuns(AnchorRuns):
    """Frames with fewer anchors for occluded pixels.

    A penumbra has kinks, at which N anchors err by about 1 / N^1.5.
    """

    _pass = PASSES["penumbra"]
    ladder = (1, 2, 3, 5, 8, 16, 32)
    few = 5

    def _choose(self, sample: Sample) -> None:
        self.pixels = np.intersect1d(shown_pixels(self.base, sample), self.base.occluded)
        self._samples, self._lanes = sample.samples_of_occluded(len(self.pixels)), len(self.base.occluded)


class FollowedRuns(AnchorRuns):
    _pass = PASSES["indirect_residual"]
    _stream = "followed"
    ladder = (1, 2, 3, 5, 8, 12)
    few = 2

    def _choose(self, sample: Sample) -> None:
        self._samples = sample.followed

    @cached_property
    def changes(self) -> dict[Approximation, FloatArray]:
        if not self._lit or not any(self._simulation().at_anchors) or not norm(self._frames(1)):
            return {}
        found, one = self.until(self.tolerance, _FOLLOWED_JUDGE), self._beyond_mean(1, ())
        cells, layers = self._worth_a_look
        missing = (self._beyond_mean(2, ()) - one) / (1 - EVEN_CELLS) if cells else np.zeros_like(one)
        layered = self._beyond_mean(1, layers) if layers else one
        return {**found, WIDE: np.asarray(layered + missing - self._beyond_mean(0, ()))}

    def sample_costs(self, light: float) -> dict[str, SampleCost]:
        found, tracers = {}, self._simulation().at_anchors
        every = self._beyond_mean(1, ()) if self.changes else None
        for place, (name, tracer) in enumerate(zip(("indirect_residual", "camera_residual"), tracers, strict=True)):
            found[name] = SampleCost(0.0, 1, 0)
            if every is not None and tracer is not None:
                seen = every
                if None not in tracers:
                    seen = self._from_camera if place else every - self._from_camera
                found[name] = SampleCost.relative(noise(seen), light, self._samples, tracer.paths_per_sample)
        return found

    @cached_property
    def _from_camera(self) -> FloatArray:
        return self._beyond(self._simulation(self.few), self._few_by_tracer[1])

    @cached_property
    def _few(self) -> list[PathSamples]:
        return _join(self._few_by_tracer)

    @cached_property
    def _few_by_tracer(self) -> list[list[PathSamples]]:
        tracers = self._simulation(self.few).at_anchors
        return [tracer.replicates(self._seeds, self._samples)[0] for tracer in tracers if tracer is not None]

    def _at_anchors(self, anchors: int) -> FloatArray:
        simulation, samples, found = self._simulation(anchors), self._samples, []
        grids, tracers = self._grids(simulation), [each for each in simulation.at_anchors if each is not None]
        if anchors == self.few:
            return self._form(grids, self._few)
        if anchors > self.few and len(self._few_by_tracer) > 1:
            camera = math.sqrt(float(np.square(self._from_camera).sum()) / REPLICATES)
            if camera < _FAINT * self.tolerance:  # Light from the camera's side needs no more anchors than a few.
                tracers = tracers[:1]
                found.append(self._form(self._grids(self._simulation(self.few)), self._few_by_tracer[1]))
        each = max(1, _AT_ONCE // (REPLICATES * sum(tracer.paths_per_sample for tracer in tracers)))
        for first in range(0, samples, each):
            some = min(each, samples - first)
            traced = [tracer.replicates(self._seeds, some, first=first)[0] for tracer in tracers]
            found.append(self._form(grids, _join(traced)))
        return np.asarray(sum(found))


def _join(traced: Sequence[list[PathSamples]]) -> list[PathSamples]:
    return [PathSamples.join(replicates) for replicates in zip(*traced, strict=True)]


# -------- Effects


class Bounced(NamedTuple):
    replicates: list[PathSamples]
    indirect: list[PathSamples]
    samples: int

    @classmethod
    def of(cls, replicates: list[PathSamples], samples: int) -> Bounced:
        return cls(replicates, [light.where(light.kind == records.INDIRECT) for light in replicates], samples)


class EffectRuns:
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
        found = {}
        for name, effect in EFFECTS.items():
            if name not in self.everything.effects or not effect.in_frames:
                continue
            effects = self.everything.effects - {name}
            simulation = self.sample.simulation(self.bench, replace(self.everything, effects=effects))
            retraced = effect.retraced(simulation.physics)
            direct, sharp = self.direct, self.sharp
            if DIRECT in retraced:
                direct, sharp = self._direct(simulation), self._sharp(simulation)
            if FOLLOWED in retraced:
                followed = self._by_kind({each: self._follow(simulation, each) for each in _FOLLOWED})
            else:
                followed = {kind: light for kind, light in self._kinds.items() if kind != effect.kind}
            found[Approximation(name)] = self.frames - self._form(simulation, direct, followed, sharp)
        return {**found, **self._coarse}

    @cached_property
    def _coarse(self) -> dict[Approximation, FloatArray]:
        if self._is_faint or not any(light.value.size for light in self._looks[1].indirect):
            return {}
        changes = coarsening_changes("indirect", self._indirect, ())
        if self.layers:
            layered, one = (self._indirect(1, layers, self._looks[0]) for layers in (self.layers, ()))
            changes[Approximation("indirect layers", 1)] = layered - one
        return changes

    @cached_property
    def _is_faint(self) -> bool:
        """Return True if so little light is indirect that one cell a pixel and one layer certainly suffice."""
        direct = sum(float(light.value.sum()) for light in self.direct) / (REPLICATES * self.sample.direct)
        part = self.received / (direct + self.received) if self.received else 0.0
        # Direct light that lies in its cells gives no information about indirect light.
        return 0 < _AS_ROUGH * max(self._as_direct()) * part < GOOD_ENOUGH * self.accuracy

    @property
    def coarse(self) -> tuple[float, float]:
        light = norm(self._indirect(1, ())) if self._coarse else 0.0
        if not light:
            return math.inf, math.inf
        parts = (Approximation(f"indirect {each}", 1) for each in ("cells", "layers"))
        cells, layer = (norm(self._coarse[part]) / light if part in self._coarse else 0.0 for part in parts)
        return cells, layer

    def _indirect(self, cells: int, layers: tuple[float, ...], seen: Bounced | None = None) -> FloatArray:
        seen = seen or self._looks[1]
        effects = self.everything.effects - {"black-level"}
        coarse = replace(self.everything, effects=effects, coarse_layers=bool(layers), layers=layers)
        simulation = self.sample.simulation(self.bench, coarse, one_line=True, judging_cells=cells)
        return self._form(simulation, followed={"indirect": seen.indirect}, samples=seen.samples)

    def _noise_of_bounced(self, seen: Bounced) -> float:
        size, whole = (sum(each.value.size for each in light) for light in (seen.indirect, seen.replicates))
        if size == whole:
            return noise(self._indirect(1, (), seen))
        followed = self._by_kind({"indirect": seen.replicates})
        return noise(self._form(self.simulation, followed=followed, samples=seen.samples))

    @cached_property
    def _looks(self) -> tuple[Bounced, Bounced]:
        first, tracer = Bounced.of(self.followed["indirect"], self.sample.followed), self.simulation.indirect
        if tracer is None or self._is_faint or not any(light.value.size for light in first.indirect):
            return first, first
        seen = coarsening_changes("indirect", partial(self._indirect, seen=first), ())
        value, bound = ErrorCovariance.between(seen, self.light**2).estimate(seen)
        wanted = math.ceil(first.samples * (bound**2 - value**2) / (_OPEN * self.accuracy) ** 2)
        cost = SampleCost.relative(self._noise_of_bounced(first), self.light, first.samples, 1)
        most = _OF_INDIRECT * float(cost.samples_for(self.accuracy)) / REPLICATES
        enough = self.sample.within(_CLOSER * self.sample.followed, tracer.paths_per_sample)
        more = min(wanted, enough, math.ceil(most))
        if more <= first.samples:
            return first, first
        # Own seeds, because vague first replicates do not imply that these are vague.
        seeds, few = [integer(seed, "closer") for seed in self.seeds], math.ceil(more / _OF_CLOSER)
        some, whole = tracer.replicates(seeds, few, more)
        return Bounced.of(some, few), Bounced.of(whole, more)

    @property
    def received(self) -> float:
        light = sum(float(replicate.value.sum()) for replicates in self.followed.values() for replicate in replicates)
        return light / (REPLICATES * self.sample.followed)

    @cached_property
    def indirect_cost(self) -> tuple[SampleCost, bool, tuple[int, ...]]:
        """Return the cost of indirect light, True if pixels share paths, and the paths of each block."""
        plain = sample_cost = self.sample_costs["indirect"]
        taken, shared = plain.samples_for(self.accuracy) * plain.paths * PASSES["indirect"].unit_cost, False
        tracer = None
        if plain.error and taken >= _WORTH_SHARING_S:
            tracer = self.sample.simulation(self.bench, replace(self.everything, shared=True)).indirect
        if isinstance(tracer, PathReuseTracer) and tracer.shares():
            samples = max(1, self._looks[1].samples // SHARED_COST)
            seen = tracer.replicates([integer(seed, "shared") for seed in self.seeds[:_SHARING]], samples)[0]
            seen += [PathSamples.none()] * (REPLICATES - _SHARING)
            frames = self._indirect(1, (), Bounced.of(seen, samples))[:_SHARING]
            own = SampleCost.relative(noise(frames), self.light, samples, SHARED_COST * tracer.paths_per_sample)
            shared = own.variance * own.paths < _CLEARLY * plain.variance * plain.paths
            sample_cost = own if shared else plain
        pixels = self.bench.n
        moments = [block_moments(replicate.pixel, replicate.value, pixels) for replicate in self._looks[1].indirect]
        # Each half is judged by the other replicates, because a single heavy path favours only its own block.
        halves = np.sum(moments[::2], axis=0), np.sum(moments[1::2], axis=0)
        judged = [effect_of(adaptive_counts(one), other) for one, other in (halves, halves[::-1])]
        variance, paths = (float(each) for each in np.mean(judged, axis=0))
        if variance * paths > _WORTH_REPEATING:
            return sample_cost, shared, ()
        repeats = tuple(int(count) for count in adaptive_counts(np.sum(moments, axis=0)).ravel())
        error = sample_cost.error * math.sqrt(variance)
        return replace(sample_cost, error=error, paths=math.ceil(sample_cost.paths * paths)), shared, repeats

    @cached_property
    def sample_costs(self) -> dict[str, SampleCost]:
        found = {}
        for name, each in self.simulation.passes.items():
            samples, paths, rate = self.sample.followed, each.tracer.paths_per_sample, 0.5
            if name == "sharp":
                samples, rate = self.sample.sharp(self.simulation), SHARP_RATE
                error = noise(self._form(self.simulation, sharp=self.sharp))
            elif name == "indirect":
                samples = self._looks[1].samples
                error = self._noise_of_bounced(self._looks[1])
            elif name in _FOLLOWED:
                error = noise(self._form(self.simulation, followed=self._by_kind({name: self.followed[name]})))
            else:
                continue
            found[name] = SampleCost.relative(error, self.light, samples, paths, rate)
        return {**dict.fromkeys(_FOLLOWED, SampleCost(0.0, 1, 0)), **found}

    def _direct(self, simulation: Simulation) -> list[PathSamples]:
        return simulation.direct.replicates(self.seeds, self.sample.direct)[0]

    def _follow(self, simulation: Simulation, name: str) -> list[PathSamples]:
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
        replicates = [PathSamples.join(replicates) for replicates in zip(*followed.values(), strict=True)]
        return {
            name: [replicate.where(replicate.kind == kind) for replicate in replicates] for name, kind in KINDS.items()
        }

    def _sharp(self, simulation: Simulation) -> list[PathSamples]:
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
