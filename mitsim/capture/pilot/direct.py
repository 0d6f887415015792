"""Direct light, filed in different ways: the error that few anchors, layers or cells leave, noise and pace."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import sparse

from mitsim.capture.bench import Bench
from mitsim.capture.evidence import GROUPS, Effort, Noise, Settings
from mitsim.capture.pilot.halves import Halves, Sample, ladder, noise, norm
from mitsim.capture.simulation import Simulation
from mitsim.core.arrays import FloatArray
from mitsim.core.seeds import integer
from mitsim.optics.frames import ExpectedFrames, Filed
from mitsim.rig.patterns import Lighting
from mitsim.transport.direct import DirectTracer
from mitsim.transport.histogram import Deposits

ANCHOR_LADDER, LAYER_LADDER, CELL_LADDER = (1, 2, 3, 5, 8), (1, 2, 3, 4, 6, 8, 12), (1, 2, 4, 8)
"""Numbers that are tried, each step about half the error of the one before or less."""
_FIRST_JUDGE, _FEW_ANCHORS = 5, 3
"""Anchors that judge at first, and those whose noise is measured: fewer leave a plan's choice to them unseen."""
_FLAT = 1e-4
"""Relative range of depths below which one layer is exact: rounding in single precision is a thousandth of it."""
_FARTHEST = 1e-4
"""Inverse depth, relative to the scene's, below which light counts as infinitely far."""


class FineLight:
    """Direct light in many samples a cell, filed in different ways."""

    def __init__(self, bench: Bench, base: Settings, sample: Sample, accuracy: float, seed: int) -> None:
        """Trace direct light twice.

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
        self.bench, self.base, self.sample, self.accuracy = bench, base, sample, accuracy
        tracer = _tracer(Simulation(bench, base), sample)
        first, second = (integer(seed, "pilot", "fine", half) for half in range(2))
        many, few = sample.fine, sample.fine // 4
        halves = [tracer.trace(first, 0, many)]
        started = time.perf_counter()
        halves.append(tracer.trace(second, 0, many))
        self.pace = (time.perf_counter() - started) / max(tracer.lanes * many, 1)
        self._many = halves[0], halves[1]
        apart = Simulation(bench, base).apart
        self._sharp = (
            [apart.trace(half, 0, sample.sharp(Simulation(bench, base))) for half in (first, second)] if apart else []
        )
        self._few = tracer.trace(first, 0, few), tracer.trace(second, 0, few)
        self.seconds_per_frame = 0.0

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
        inverse = np.concatenate([deposits.inverse_depth for deposits in (*self._many, *self._sharp)])
        if not inverse.size:
            return self.base.depth, self.base.depth
        return 1 / float(inverse.max()), 1 / max(float(inverse.min()), _FARTHEST / self.base.depth)

    def layer_errors(self, layers: Mapping[int, tuple[float, ...]]) -> Mapping[int, float]:
        """Error by number of ``layers``, judged by the most; the search stops where it is good enough."""
        if len(layers) == 1:
            return {1: 0.0}
        return ladder(layers, lambda count: self._frames(layers[count], 2), 3, self.accuracy)

    def cell_errors(self) -> Mapping[int, float]:
        """Error by cells a side of a projector pixel, judged by the finest that were tried."""
        errors = ladder(CELL_LADDER, lambda count: self._frames((), count), 2, self.accuracy)
        judge, before = max(errors), max(count for count in errors if count < max(errors))
        # Even cells are of second order: with k a side, the error falls with 1/k^2, and the judge has its own part.
        whole = {count: error / (1 - (count / judge) ** 2) for count, error in errors.items() if count < judge}
        return {**whole, judge: whole[before] * (before / judge) ** 2}

    def effort(self, light: float) -> Effort:
        """Monte Carlo error of one estimate, relative to all ``light``, how fast it falls, and what it takes."""
        samples = self.sample.fine
        simulation = Simulation(self.bench, self.base)
        many = noise(self._halves(simulation, self._many, samples), light)
        few = noise(self._halves(simulation, self._few, samples // 4), light)
        rate = math.log(few / many) / math.log(4) if many > 0 and few > 0 else 1.0
        return Effort(Noise(many, samples, min(max(rate, 0.5), 1.0)), self.bench.n**2, self.pace)

    def _frames(self, layers: tuple[float, ...], subdivision: int) -> Halves:
        simulation = Simulation(self.bench, replace(self.base, layers=layers, subdivision=subdivision))
        halves = self._halves(simulation, self._many, self.sample.fine, self._sharp)
        if not (layers or self.seconds_per_frame) and subdivision == 1:
            self.seconds_per_frame = self._seconds(simulation)
        return halves

    def _halves(
        self, simulation: Simulation, deposits: tuple[Deposits, Deposits], samples: int, sharp: Sequence[Deposits] = ()
    ) -> Halves:
        apart = sharp or (None, None)
        first, second = (
            self.sample.frames(simulation, half, samples, sharp=more)
            for half, more in zip(deposits, apart, strict=True)
        )
        return first, second

    def _seconds(self, simulation: Simulation) -> float:
        """Seconds to form one frame, with its share of the groups' errors; its optics are prepared."""
        light = simulation.file_direct(self._many[0], self.sample.lighting.labels, self.sample.fine)
        rows, weights = self.sample.rows, self.sample.lighting.weights
        started = time.perf_counter()
        filed = Filed(simulation.fine.optics, (light.fine[: len(rows)],) * GROUPS)
        list(ExpectedFrames([filed], Lighting(rows, weights), 0))
        return (time.perf_counter() - started) / len(weights)


class AnchoredLight:
    """The frames with fewer anchors; every anchor is connected to the same points, so little noise is left.

    Frames, not radiance: the falloff's error is odd in the scene's coordinates and mostly cancels in a frame.
    """

    def __init__(self, bench: Bench, base: Settings, sample: Sample, light: float, seed: int) -> None:
        """The frames of one anchor.

        Parameters
        ----------
        bench, base, sample, seed
            as for :class:`FineLight`.
        light
            norm of frames of all light, of which direct light is ``part``.
        """
        self.bench, self.base, self.sample, self.light = bench, base, sample, light
        self.seeds = [integer(seed, "pilot", "anchors", half) for half in range(2)]
        self.part = norm(self._frames(1)) / light if light else 0.0

    def errors(self, accuracy: float) -> dict[int, float]:
        """Error by anchors a side; the search stops where it is good enough for ``accuracy``."""
        errors = ladder(ANCHOR_LADDER, self._frames, ANCHOR_LADDER.index(_FIRST_JUDGE), accuracy)
        return {count: self.part * error for count, error in errors.items()}

    def effort(self, pace: float) -> Effort:
        """Monte Carlo error of one estimate of what a few anchors see beyond their mean, at ``pace`` [s a path]."""
        simulation, samples = self._simulation(_FEW_ANCHORS), self.sample.anchored
        halves = []
        for deposits in self._traced(simulation):
            alike = deposits.averaged(simulation.mean_weights)
            mean = simulation.smooth.file(alike, self.sample.lighting.labels, samples)
            everything = self._formed(simulation, self._filed(simulation, deposits))
            halves.append(everything - self._formed(simulation, simulation.coarse.bundle.repeated(mean)))
        return Effort(Noise(noise((halves[0], halves[1]), self.light), samples, 0.5), self.bench.n**2, pace)

    def _frames(self, anchors: int) -> Halves:
        simulation = self._simulation(anchors)
        traced = self._traced(simulation)
        first, second = (self._formed(simulation, self._filed(simulation, deposits)) for deposits in traced)
        return first, second

    def _simulation(self, anchors: int) -> Simulation:
        return Simulation(self.bench, replace(self.base, anchors=anchors))

    def _traced(self, simulation: Simulation) -> Iterator[Deposits]:
        """Light to every anchor, in two halves."""
        tracer = _tracer(simulation, self.sample)
        return (tracer.trace(seed, 0, self.sample.anchored) for seed in self.seeds)

    def _filed(self, simulation: Simulation, deposits: Deposits) -> sparse.csr_array:
        return simulation.coarse.file(deposits, self.sample.lighting.labels, self.sample.anchored)

    def _formed(self, simulation: Simulation, light: sparse.csr_array) -> FloatArray:
        """(shots, pixels, pixels) frames of light to every anchor."""
        rows = self.sample.rows
        filed = Filed(simulation.coarse.optics, (light[: len(rows)],))
        frames = ExpectedFrames([filed], Lighting(rows, self.sample.lighting.weights), 0)
        return np.stack([frame.irradiance for frame in frames])


def _tracer(simulation: Simulation, sample: Sample) -> DirectTracer:
    """Direct light to every anchor, of those projector pixels only that the sample's shots show."""
    loaded, physics = simulation.bench.loaded, simulation.physics
    parts = loaded.scene, loaded.camera, physics.projector, simulation.settings.anchors, physics.geometry
    apart = simulation.settings.sharp
    return DirectTracer(*parts, pixels=np.setdiff1d(sample.shown, apart.pixels) if apart else sample.shown)
