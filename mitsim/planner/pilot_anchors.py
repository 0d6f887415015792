"""A bench with few anchors, and with more, in; what that changes of the frames, and noise of what anchors see beyond
their mean, out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from mitsim.bench.apparatus import Apparatus
from mitsim.core.arrays import FloatArray
from mitsim.core.seeds import integer
from mitsim.light.grids import Grid
from mitsim.light.passes import PASSES, PassTracer
from mitsim.light.settings import REPLICATES, Approximation, Noise, SampleCost, Settings
from mitsim.light.simulation import Simulation
from mitsim.planner.pilot_direct import shown_pixels, tracer_of
from mitsim.planner.pilot_samples import (
    EVEN_CELLS,
    Sample,
    coarsening_changes,
    heavy_paths,
    ladder,
    noise,
    norm,
)
from mitsim.transport.records import PathSamples

_JUDGE = 2
"""Index of the number of anchors that judges at first: two steps tell how fast the error falls."""
WIDTHS = (1, 2, 4)
"""Projector pixels a side of a cell that are tried: what anchors see beyond their mean is little light, and need not be
as fine as all of it; wider cells hold light of many anchors in memory."""
_AT_ONCE = 2**20
"""Connections that are traced at a time: 0.5 GB while they are accumulated."""
AS_ROUGH = 15.0
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
        most = AS_ROUGH * norm(self._beyond_mean())
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
