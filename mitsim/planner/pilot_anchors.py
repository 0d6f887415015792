"""Light at anchors of the sensor: what fewer of them change in the frames, and noise of what they see beyond."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from mitsim.bench.apparatus import Apparatus
from mitsim.core.arrays import FloatArray
from mitsim.core.seeds import integer
from mitsim.light.grids import Grid
from mitsim.light.passes import PASSES, PassTracer
from mitsim.light.pilot_result import REPLICATES, Approximation, Noise, SampleCost
from mitsim.light.settings import Settings
from mitsim.light.simulation import Simulation
from mitsim.planner.pilot_direct import shown_pixels, tracer_of
from mitsim.planner.pilot_samples import EVEN_CELLS, Sample, coarsened, heavy_paths, ladder, noise, norm
from mitsim.transport.records import PathSamples

_JUDGE = 2
"""Index of the number of anchors that judges at first: two steps tell how fast the error falls."""
WIDTHS = (1, 2, 4)
"""Projector pixels a side of a cell that are tried: what anchors see beyond their mean is little light, and need not be
as fine as all of it; wider cells hold light of many anchors in memory."""
_AT_ONCE = 2**20
"""Connections that are traced at a time: 0.5 GB while they are accumulated."""
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
    """

    _pass = PASSES["anchor_residual"]
    _stream = "anchors"
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
        self._seeds = [integer(seed, "pilot", self._stream, replicate) for replicate in range(REPLICATES)]
        self._frames: Callable[[int], FloatArray] = cache(self._at_anchors)
        self._beyond_mean: Callable[..., FloatArray] = cache(self._in_cells)
        self._choose(sample)

    def _choose(self, sample: Sample) -> None:
        """Pixels that are followed, and samples of each in a replicate."""
        self.pixels = np.setdiff1d(shown_pixels(self.base, sample), self.base.occluded)
        self._samples, self._lanes = sample.anchored, self.bench.n**2 - len(self.base.occluded)

    @property
    def paths(self) -> int:
        """Paths of all replicates to one anchor."""
        return REPLICATES * len(self.pixels) * self._samples

    @cached_property
    def changes(self) -> dict[Approximation, FloatArray]:
        """Change of the frames by every number of anchors that was tried, and by coarse cells for what they see."""
        return {**self._until(self.tolerance), **coarsened(self._pass.name, self._coarsen, self.layers)}

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
        relative = noise(self._beyond_mean()) / light if light else 0.0
        return {self._pass.name: SampleCost(Noise(relative, self._samples, 0.5), self._lanes)}

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
        mean = [replicate.averaged(weights) for replicate in replicates]
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
        lamps = [simulation.ambient[name]] if name in simulation.ambient and self.bench.loaded.lamps else []
        return [simulation.grids[name], *lamps]

    def _trace(self, simulation: Simulation) -> list[PathSamples]:
        """Light to every anchor, replicate by replicate."""
        anchors = self._grids(simulation)[0].bundle.anchors
        tracer = tracer_of(simulation, self.pixels, anchors)
        return [tracer.trace(seed, 0, self._samples) for seed in self._seeds]

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
        self._samples, self._lanes = sample.occluded(len(self.pixels)), len(self.base.occluded)


class FollowedRuns(AnchorRuns):
    """The same of light that is followed, of settings with all effects on; to every anchor go the same paths."""

    _pass = PASSES["indirect_residual"]
    _stream = "followed"
    ladder = (1, 2, 3, 5, 8, 12)
    few = 2
    passes = "indirect_residual", "camera_residual"
    """From the projector's side, and from the camera's."""

    def _choose(self, sample: Sample) -> None:
        self._samples = sample.followed

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
        if None in tracers:
            seen = every, every
        else:
            from_camera = self._beyond(self._simulation(self.few), self._few_by_tracer[1])
            seen = every - from_camera, from_camera
        errors = (noise(each) / light if light else 0.0 for each in seen)
        return {
            name: SampleCost(Noise(error, self._samples, 0.5), tracer.paths_per_sample) if tracer else SampleCost.none()
            for name, error, tracer in zip(self.passes, errors, tracers, strict=True)
        }

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
        one = self._beyond_mean()
        missing = (self._beyond_mean(coarse_cells=2) - one) / (1 - EVEN_CELLS)
        layered = self._beyond_mean(coarse_layers=True, layers=self.layers) if self.layers else one
        wide = {width: layered + missing - self._beyond_mean(followed_width=width) for width in WIDTHS[1:]}
        return {Approximation("followed_width", width): change for width, change in {1: missing, **wide}.items()}

    @cached_property
    def _few(self) -> list[PathSamples]:
        return _join(self._few_by_tracer)

    @cached_property
    def _few_by_tracer(self) -> list[list[PathSamples]]:
        """The same by tracer."""
        tracers = _tracers(self._simulation(self.few))
        return [[tracer.trace(seed, 0, self._samples) for seed in self._seeds] for tracer in tracers]

    def _at_anchors(self, anchors: int) -> FloatArray:
        simulation, samples = self._simulation(anchors), self._samples
        grids, tracers = self._grids(simulation), _tracers(simulation)
        if anchors == self.few:
            return self._form(grids, self._few)
        each = max(1, _AT_ONCE // sum(tracer.paths_per_sample for tracer in tracers))
        found = []
        for first in range(0, samples, each):
            some = min(each, samples - first)
            traced = [[tracer.trace(seed, first, some) for seed in self._seeds] for tracer in tracers]
            found.append(self._form(grids, _join(traced)))
        return np.asarray(sum(found))


def _tracers(simulation: Simulation) -> list[PassTracer]:
    return [tracer for tracer in simulation.at_anchors if tracer is not None]


def _join(traced: Sequence[list[PathSamples]]) -> list[PathSamples]:
    """Light of several tracers together, replicate by replicate."""
    return [PathSamples.joined(replicates) for replicates in zip(*traced, strict=True)]
