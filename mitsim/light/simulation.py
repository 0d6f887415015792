"""A bench under one choice of settings: trace its passes, accumulate their light, and form frames.

An effect that is off takes its neutral value here: a pinhole for the lens, a thin mask, a geometric shadow.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse

from mitsim.bench.effects import Physics
from mitsim.core.arrays import FloatArray, Labels
from mitsim.devices.patterns import Lighting
from mitsim.light.passes import GRIDS, PASSES, LightEstimate, Pass, PassTracer, Tracers
from mitsim.light.settings import PATHS_AT_ONCE
from mitsim.optics.frames import AccumulatedLight, ClassFrames, ExpectedFrames
from mitsim.transport.direct import DirectTracer
from mitsim.transport.indirect import IndirectTracer
from mitsim.transport.records import DIRECT, INDIRECT, Bundle, DeviceAccumulator, DeviceSums, PathSamples

_FEWEST_AT_ONCE = 2**18


@dataclass(frozen=True)
class TracedPass:
    row: Pass
    tracer: PassTracer
    predicted: float

    @property
    def whole(self) -> int:
        return int(self.row.whole(self.predicted))

    def trace(self, seed: int, first: int, samples: int, accumulator: DeviceAccumulator | None = None) -> PathSamples:
        if accumulator is None:
            return self.tracer.trace(seed, first, samples)
        assert isinstance(self.tracer, DirectTracer | IndirectTracer), "the others have none"
        return self.tracer.trace(seed, first, samples, accumulator)


class Simulation(Tracers):
    @cached_property
    def passes(self) -> Mapping[str, TracedPass]:
        found = {}
        for row in PASSES.values():
            several = not row.anchors or getattr(self.settings, row.anchors) > 1
            if several and (tracer := row.tracer(self)) is not None:
                found[row.name] = TracedPass(row, tracer, row.predicted_samples(self.settings))
        return found

    @cached_property
    def paths_at_once(self) -> int:
        most = max(each.whole * each.tracer.paths_per_sample for each in self.passes.values())
        paths_per_sample = max(each.tracer.paths_per_sample for each in self.passes.values())
        return max(min(max(most, _FEWEST_AT_ONCE), PATHS_AT_ONCE), paths_per_sample)

    def follow(self, seed: int, samples: int) -> PathSamples:
        tracers = [tracer for tracer in (self.indirect, self.from_camera) if tracer is not None]
        return PathSamples.join([tracer.trace(seed, 0, samples) for tracer in tracers])

    # ---- Accumulation

    def accumulator(self, name: str, labels: Labels, lines: int) -> DeviceAccumulator | None:
        each, bundle = self.passes[name], self.grids[PASSES[name].grids[-1]].bundle
        if not each.row.device:
            return None
        assert isinstance(each.tracer, DirectTracer | IndirectTracer), "has sums on the device"
        paths = each.predicted * each.tracer.paths_per_sample if each.row.device == "pays" else math.inf
        if each.row.flux:  # which is told pixel by pixel
            pixels, labels = self._pixels_of(each.row), np.zeros_like(labels)
            labels[pixels] = np.arange(len(pixels))
        if not DeviceAccumulator.holds(bundle, labels, lines, paths):
            return None
        return DeviceAccumulator(bundle, labels, each.tracer.board, lines)

    def accumulate(self, name: str, found: PathSamples | DeviceSums, labels: Labels, samples: int) -> LightEstimate:
        row = PASSES[name]
        if isinstance(found, DeviceSums):
            return self._of_sums(row, found, labels, samples)
        parts = {row.grid: found}
        if row.indirect_grid:
            indirect = found.kind == INDIRECT
            parts = {row.grid: found.where(~indirect), row.indirect_grid: found.where(indirect)}
        light = {grid: self.grids[grid].bundle.accumulate(part, labels, samples) for grid, part in parts.items()}
        bundle = self.grids[row.grid].bundle
        if row.anchors:
            return self._estimate({row.grid: self._residual(bundle, light[row.grid])})
        mean = found if bundle.anchors == 1 else found.average(self.mean_weights(bundle.anchors))
        received, outside = float(mean.value.sum()) / samples, bundle.outside(mean) / samples
        return self._estimate(light, received, outside, self.flux(mean, samples) if row.flux else None)

    def _of_sums(self, row: Pass, found: DeviceSums, labels: Labels, samples: int) -> LightEstimate:
        grid, (light, received, outside) = row.grids[-1], found.light(samples)
        bundle = self.grids[grid].bundle
        if row.anchors:
            return self._estimate({grid: self._residual(bundle, light)})
        if not row.flux:
            return self._estimate({grid: light}, received, outside)
        pixels, weights = self._pixels_of(row), self.mean_weights(bundle.anchors)
        beyond = np.einsum("pab,a,b->p", found.beyond(samples), weights, weights)
        by_pixel = np.asarray(bundle.average(light, weights).sum(axis=1))[: len(pixels)] + beyond
        rows = np.append(labels[pixels], labels.max() + 1 + np.arange(self.lamp_rows))
        shape = int(labels.max()) + 1 + self.lamp_rows, len(rows)
        classes = sparse.csr_array((np.ones(len(rows)), (rows, np.arange(len(rows)))), shape=shape)
        flux = np.zeros(self.bench.n**2)
        flux[pixels] = by_pixel
        light = sparse.csr_array(classes @ light)
        return self._estimate({grid: light}, float(by_pixel.sum()), float(beyond.sum()), flux)

    def _pixels_of(self, row: Pass) -> Labels:
        sharp = self.settings.sharp if row.grid == "sharp" else None
        return np.array(sharp.pixels if sharp else range(self.bench.n**2), dtype=np.int64)

    def _residual(self, bundle: Bundle, light: sparse.csr_array) -> sparse.csr_array:
        return light - bundle.repeat(bundle.average(light, self.mean_weights(bundle.anchors)))

    def flux(self, mean: PathSamples, samples: int) -> FloatArray:
        value = mean.value * (mean.kind == DIRECT) / samples
        return np.asarray(np.bincount(mean.pixel, value, minlength=self.bench.n**2 + 1)[:-1], dtype=np.float64)

    def _estimate(self, light: Mapping[str, sparse.csr_array], *totals: Any) -> LightEstimate:
        rows = next(iter(light.values())).shape[0]
        every = {
            name: light[name] if name in light else sparse.csr_array((rows, grid.bundle.size))
            for name, grid in self.grids.items()
        }
        return LightEstimate(every, *totals)

    # ---- Frames

    def with_optics(
        self, groups: Sequence[LightEstimate], first: int
    ) -> tuple[list[AccumulatedLight], list[AccumulatedLight]]:
        lights = [
            AccumulatedLight(self.grids[row.name].optics, tuple(_rows(group[row.name], 0, first) for group in groups))
            for row in GRIDS.values()
            if row.formed(self.settings, self.physics)
        ]
        return lights, self.of_lamps(groups, first) if self.physics.lamps else []

    def of_lamps(
        self, groups: Sequence[LightEstimate], first: int, bands: slice = slice(None)
    ) -> list[AccumulatedLight]:
        return [
            AccumulatedLight(grid.optics, tuple(_rows(group[name], row, row + 1) for group in groups))
            for row, grids in list(enumerate(self.by_band, first))[bands]
            for name, grid in grids.items()
            if GRIDS[name].formed(self.settings, self.physics)
        ]

    def specular_frames(self, labels: Labels) -> ClassFrames | None:
        if not self.physics.mirrors:
            return None
        found = self.bench.specular.frames(labels, self.physics.geometry, self.physics.spectrum)
        if found is None or self.places is None:
            return found
        return replace(found, irradiance=found.irradiance[:, self.places[0]][:, :, self.places[1]])


def _rows(light: sparse.csr_array, first: int, last: int) -> sparse.csr_array:
    start, stop = light.indptr[first], light.indptr[last]
    entries = light.data[start:stop], light.indices[start:stop], light.indptr[first : last + 1] - start
    return sparse.csr_array(entries, shape=(last - first, light.shape[1]), copy=False)


def expected_of(
    parts: Sequence[tuple[Simulation, Sequence[LightEstimate]]],
    rows: Labels,
    lighting: Lighting,
    seed: int,
    leaking: bool = True,
    probed: FloatArray | None = None,
    restated: float = 1.0,
) -> ExpectedFrames:
    """Return expected frames of light in several parts, for simulations of the same devices.

    Leakage is that of the first simulation, specular chains are those of the last.
    """
    light = emission(parts[0][0].physics, lighting, leaking)
    formed = [simulation.with_optics(groups, len(rows)) for simulation, groups in parts]
    lights, ambient = ([each for part in formed for each in part[kind]] for kind in (0, 1))
    specular = parts[-1][0].specular_frames(lighting.labels)
    return ExpectedFrames(lights, Lighting(rows, light), seed, ambient, specular, probed, restated)


def emission(physics: Physics, lighting: Lighting, leaking: bool = True) -> FloatArray:
    black = physics.black_level if leaking else 0.0
    return np.asarray(black + (1 - black) * lighting.weights)
