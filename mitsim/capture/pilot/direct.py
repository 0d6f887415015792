"""Direct light, filed in different ways: what few anchors, layers or cells change, and noise."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy import sparse

from mitsim.capture.bench import Bench
from mitsim.capture.evidence import GROUPS, LOOKS, Effort, Forming, Noise, Part, Settings
from mitsim.capture.pilot.looks import EVEN_CELLS, Sample, coarsened, ladder, noise
from mitsim.capture.simulation import FiledLight, Simulation
from mitsim.core.arrays import FloatArray
from mitsim.core.seeds import integer
from mitsim.optics.frames import ExpectedFrames, Filed
from mitsim.rig.patterns import Lighting
from mitsim.transport.direct import DirectTracer
from mitsim.transport.histogram import Deposits

ANCHOR_LADDER, LAYER_LADDER, CELL_LADDER = (1, 2, 3, 5, 8), (1, 2, 3, 4, 6, 8, 12), (1, 2, 4, 8)
"""Numbers that are tried, each step about half the error of the one before or less."""
_FIRST_JUDGES = {"anchors": 2, "layers": 2, "cells": 1}
"""Indices of the numbers that judge at first: two steps, or one where it is known how the error falls."""
_FEW_ANCHORS = 3
"""Anchors whose noise is measured: fewer leave a plan's choice to them unseen."""
_JUDGING = 4
"""Layers that judge one layer for light in coarse cells: the error of one is told to a twentieth."""
_FLAT = 1e-4
"""Relative range of depths below which one layer is exact: rounding in single precision is a thousandth of it."""
_STEEPEST = 0.9
"""Power of the samples that the error of direct light falls with at most: over a few samples it may fall faster, but
edges in the scene bring it to 0.75 in the end."""
_FARTHEST = 1e-4
"""Inverse depth, relative to the scene's, below which light counts as infinitely far."""


class FineLight:
    """Direct light in many samples a cell, filed in different ways.

    Parameters
    ----------
    bench, base
        what is traced, and the settings that are varied.
    sample
        shots and samples.
    accuracy
        where the search for enough may stop.
    seed
        root of the random streams.
    """

    def __init__(self, bench: Bench, base: Settings, sample: Sample, accuracy: float, seed: int) -> None:
        self.bench, self.base, self.sample, self.accuracy = bench, base, sample, accuracy
        self._seeds = [integer(seed, "pilot", "fine", look) for look in range(LOOKS)]
        self._tracer = _tracer(Simulation(bench, base), sample)
        self._deposits = [self._tracer.trace(seed, 0, sample.fine) for seed in self._seeds]
        simulation = Simulation(bench, base)
        apart, samples = simulation.apart, sample.sharp(simulation)
        self._sharp = [apart.trace(seed, 0, samples) for seed in self._seeds] if apart else []

    @property
    def judging(self) -> tuple[float, ...]:
        """Depths [mm] of enough layers to judge one by; none for a flat scene."""
        return self.layers.get(_JUDGING, ())

    @cached_property
    def layers(self) -> dict[int, tuple[float, ...]]:
        """Candidates for the layers' depths [mm], by their number; one number where all light has one depth."""
        near, far = self._range()
        candidates: dict[int, tuple[float, ...]] = {1: (self.base.depth,)}
        if far > near * (1 + _FLAT):
            for count in LAYER_LADDER[1:]:
                candidates[count] = tuple(float(node) for node in 1 / np.linspace(1 / far, 1 / near, count))
        return candidates

    def _range(self) -> tuple[float, float]:
        """Nearest and farthest depth that the light is seen at [mm]."""
        inverse = np.concatenate([deposits.inverse_depth for deposits in (*self._deposits, *self._sharp)])
        if not inverse.size:
            return self.base.depth, self.base.depth
        return 1 / float(inverse.max()), 1 / max(float(inverse.min()), _FARTHEST / self.base.depth)

    @cached_property
    def changes(self) -> dict[Part, FloatArray]:
        """Change of the frames by every number of cells and layers that was tried."""
        found: dict[Part, FloatArray] = {}
        first = _FIRST_JUDGES["cells"]
        cells = ladder(CELL_LADDER, lambda count: self._frames((), count), first, self.accuracy, EVEN_CELLS)
        found |= {Part("cells", count): change for count, change in cells.items()}
        if len(self.layers) > 1:
            first = _FIRST_JUDGES["layers"]
            layers = ladder(self.layers, lambda count: self._frames(self.layers[count], 2), first, self.accuracy)
            found |= {Part("layers", count): change for count, change in layers.items()}
        return found

    def effort(self, light: float) -> Effort:
        """Monte Carlo error of one estimate, relative to all ``light``, how fast it falls, and its paths."""
        many, few = self._noise
        steep = many > 0 and few > 0 and self._fewer < self.sample.fine
        rate = math.log(few / many) / math.log(self.sample.fine / self._fewer) if steep else 0.5
        relative = many / light if light else 0.0
        return Effort(Noise(relative, self.sample.fine, min(max(rate, 0.5), _STEEPEST)), self.bench.n**2)

    @property
    def _fewer(self) -> int:
        return max(1, self.sample.fine // 4)

    @cached_property
    def _noise(self) -> tuple[float, float]:
        """Error of a look with all samples, and with fewer."""
        simulation = Simulation(self.bench, self.base)
        few = [self._tracer.trace(seed, 0, self._fewer) for seed in self._seeds]
        many = noise(self._formed(simulation, self._deposits, self.sample.fine))
        return many, noise(self._formed(simulation, few, self._fewer))

    def forming(self, family: Lighting) -> Forming:
        """What forming frames of a ``family`` takes; timed with one cell a pixel, its optics prepared."""
        simulation = Simulation(self.bench, self.base)
        rows, weights = self.sample.rows, self.sample.lighting.weights
        light = simulation.file_direct(self._deposits[0], self.sample.lighting.labels, self.sample.fine)
        filed = Filed(simulation.fine.optics, (light.fine[: len(rows)],) * GROUPS)
        started = time.perf_counter()
        list(ExpectedFrames([filed], Lighting(rows, weights), 0))
        seconds = (time.perf_counter() - started) / len(weights)
        cells = max(simulation.fine.bundle.cells)
        lines = len(self.bench.spectrum.weights) * (2 if self.bench.geometry.mask == "flatcam" else 1)
        return Forming(
            pixels=self.bench.geometry.pixels,
            cells=cells,
            lit=self._lit(simulation, light) / cells,
            terms=float(lines),
            shots=len(family.weights),
            classes=family.weights.shape[1],
            seconds=seconds,
        )

    def _lit(self, simulation: Simulation, light: FiledLight) -> float:
        """Rows of cells that hold light in a shot, their mean."""
        shots = (self.sample.lighting.weights @ (light.fine[: len(self.sample.rows)] != 0)) != 0
        width = simulation.fine.bundle.cells[1]
        places = [np.flatnonzero(shot) if isinstance(shot, np.ndarray) else shot.indices for shot in shots]
        return max(1.0, float(np.mean([len(np.unique(place // width)) for place in places])))

    def _frames(self, layers: tuple[float, ...], subdivision: int) -> FloatArray:
        simulation = Simulation(self.bench, replace(self.base, layers=layers, subdivision=subdivision))
        return self._formed(simulation, self._deposits, self.sample.fine, self._sharp)

    def _formed(
        self, simulation: Simulation, deposits: list[Deposits], samples: int, sharp: Sequence[Deposits] = ()
    ) -> FloatArray:
        labels = self.sample.lighting.labels
        lights = [simulation.file_direct(look, labels, samples) for look in deposits]
        if sharp:
            few = self.sample.sharp(simulation)
            apart = [simulation.file_sharp(look, labels, few) for look in sharp]
            lights = [light + more for light, more in zip(lights, apart, strict=True)]
        return self.sample.frames(simulation, lights)


class AnchoredLight:
    """The frames with fewer anchors; every anchor is connected to the same points, so little noise is left.

    Frames, not radiance: the falloff's error is odd in the scene's coordinates and mostly cancels in a frame.

    Parameters
    ----------
    bench, base, sample, accuracy, seed
        as for :class:`FineLight`.
    layers
        depths [mm] that judge one layer; none for a flat scene.
    """

    def __init__(
        self,
        bench: Bench,
        base: Settings,
        sample: Sample,
        accuracy: float,
        seed: int,
        layers: tuple[float, ...] = (),
    ) -> None:
        self.bench, self.base, self.sample, self.accuracy = bench, base, sample, accuracy
        self.layers = layers
        self._seeds = [integer(seed, "pilot", "anchors", look) for look in range(LOOKS)]

    @cached_property
    def changes(self) -> dict[Part, FloatArray]:
        """Change of the frames by every number of anchors that was tried, and by coarse cells for what they see."""
        found = ladder(ANCHOR_LADDER, self._frames, _FIRST_JUDGES["anchors"], self.accuracy)
        coarse = coarsened("anchored", self._beyond, self.layers)
        return {**{Part("anchors", count): change for count, change in found.items()}, **coarse}

    def effort(self, light: float) -> Effort:
        """Monte Carlo error of one estimate of what a few anchors see beyond their mean, relative to all ``light``."""
        relative = self._noise / light if light else 0.0
        return Effort(Noise(relative, self.sample.anchored, 0.5), self.bench.n**2)

    @cached_property
    def _noise(self) -> float:
        return noise(self._beyond(1, ()))

    def _beyond(self, cells: int, layers: tuple[float, ...]) -> FloatArray:
        """Frames of what a few anchors see beyond their mean, in coarse cells and layers."""
        coarse = replace(self.base, anchors=_FEW_ANCHORS, coarse_cells=cells, coarse_layers=bool(layers), layers=layers)
        simulation, labels = Simulation(self.bench, coarse), self.sample.lighting.labels
        looks = (simulation.file_anchored(look, labels, self.sample.anchored) for look in self._few)
        return self._formed(simulation, [light.coarse for light in looks])

    @cached_property
    def _few(self) -> list[Deposits]:
        return self._traced(self._simulation(_FEW_ANCHORS))

    def _frames(self, anchors: int) -> FloatArray:
        simulation, labels = self._simulation(anchors), self.sample.lighting.labels
        traced = self._traced(simulation)
        return self._formed(simulation, [simulation.coarse.file(look, labels, self.sample.anchored) for look in traced])

    def _simulation(self, anchors: int) -> Simulation:
        return Simulation(self.bench, replace(self.base, anchors=anchors))

    def _traced(self, simulation: Simulation) -> list[Deposits]:
        """Light to every anchor, look by look."""
        tracer = _tracer(simulation, self.sample)
        return [tracer.trace(seed, 0, self.sample.anchored) for seed in self._seeds]

    def _formed(self, simulation: Simulation, lights: list[sparse.csr_array]) -> FloatArray:
        """(looks, shots, pixels, columns) frames of light to every anchor."""
        rows = self.sample.rows
        filed = Filed(simulation.coarse.optics, tuple(light[: len(rows)] for light in lights))
        return ExpectedFrames([filed], Lighting(rows, self.sample.lighting.weights), 0).by_group(self.sample.columns)


def _tracer(simulation: Simulation, sample: Sample) -> DirectTracer:
    """Direct light to every anchor, of those projector pixels only that the sample's shots show."""
    loaded, physics = simulation.bench.loaded, simulation.physics
    parts = loaded.scene, loaded.camera, physics.projector, simulation.settings.anchors, physics.geometry
    apart = simulation.settings.sharp
    return DirectTracer(*parts, pixels=np.setdiff1d(sample.shown, apart.pixels) if apart else sample.shown)
