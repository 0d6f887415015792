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
from mitsim.capture.evidence import GROUPS, LOOKS, Drawn, Effort, Estimate, Forming, Noise, Part, Settings
from mitsim.capture.filing import Tray
from mitsim.capture.pilot.looks import EVEN_CELLS, GOOD_ENOUGH, Sample, coarsened, known, ladder, noise, norm
from mitsim.capture.rasters import cells_to_choose, drawing_seconds
from mitsim.capture.simulation import Simulation, emitted
from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.parallel import in_threads
from mitsim.core.resources import workers
from mitsim.core.seeds import integer
from mitsim.optics.closed_form import raster_error
from mitsim.optics.frames import ExpectedFrames, Filed
from mitsim.optics.raster import cells_per_pixel
from mitsim.rig.patterns import Lighting
from mitsim.rig.projector import Spectrum
from mitsim.transport.direct import DirectTracer
from mitsim.transport.histogram import Deposits

ANCHOR_LADDER, LAYER_LADDER, CELL_LADDER = (1, 2, 3, 5, 8), (1, 2, 3, 4, 6, 8, 12), (1, 2, 4, 8)
"""Numbers that are tried, each step about half the error of the one before or less."""
_FIRST_JUDGES = {"anchors": 2, "layers": 2, "cells": 1}
"""Indices of the numbers that judge at first: two steps, or one where it is known how the error falls."""
OCCLUDED_LADDER = (1, 2, 3, 5, 8, 16, 32)
"""Numbers that are tried for occluded pixels. An edge's penumbra has kinks, at which interpolation between N anchors
errs by about 1 / N^1.5; 32 leave a hundredth of what one does."""
_FEW_ANCHORS, _FEW_OCCLUDED = 3, 5
"""Anchors whose noise is measured: fewer leave a plan's choice to them unseen."""
_JUDGING = 4
"""Layers that judge one layer for light in coarse cells: the error of one is told to a twentieth."""
_FLAT = 1e-4
"""Relative range of depths below which one layer is exact: rounding in single precision is a thousandth of it."""
_STEEPEST = 0.9
"""Power of the samples that the error of direct light falls with at most: over a few samples it may fall faster, but
edges in the scene bring it to 0.75 in the end."""
_SIDE, _TRIALS = 256, 4
"""Side and number of the products that tell how fast the machine multiplies: 0.13 Gflop, some 5 ms on two cores."""
_SURE_OF_RASTER = 1.5
"""Largest error of a raster over that of a few pixels about the axis: 1.04 to 1.11 of 96 x 96 pixels for random, grey,
blurred and dusty masks, in dots and in uniform light (tests/physics/test_raster.py)."""
_OF_FINER = (1.0, 1.75)
"""Error of a raster, and its bound, over its difference from one of half the cells there: against 24 cells a pixel 0.87
to 1.08 for masks turned by 0.3 and 1 degrees, 1.1 to 1.5 for pictures of light, whose error falls slowest, on as few
pixels."""
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
        self._simulation = simulation = sample.simulation(bench, base)
        self._tracer = _tracer(simulation, _shown(base, sample), base.anchors)
        self._deposits = self._tracer.trace_looks(self._seeds, sample.fine)
        apart, samples = simulation.apart, sample.sharp(simulation)
        self._sharp = apart.trace_looks(self._seeds, samples) if apart else []

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
        first, tolerance = _FIRST_JUDGES["cells"], GOOD_ENOUGH * self.accuracy * norm(self._whole)
        cells = ladder(CELL_LADDER, lambda count: self._frames((), count), first, tolerance, EVEN_CELLS)
        found |= {Part("cells", count): change for count, change in cells.items()}
        if len(self.layers) > 1:
            first = _FIRST_JUDGES["layers"]
            layers = ladder(self.layers, lambda count: self._frames(self.layers[count], 2), first, tolerance)
            found |= {Part("layers", count): change for count, change in layers.items()}
        return found

    def effort(self, light: float) -> Effort:
        """Monte Carlo error of one estimate of what the sensor's centre sees, relative to all ``light``, how fast it
        falls, and its paths."""
        return self._effort(self._noise, light)

    def spread(self, light: float) -> Effort:
        """The same, as a part of ``light``, of what random points of the sensor see: gloss differs over the sensor, and
        makes noise there."""
        return self._effort(self._spread_noise, light)

    def _effort(self, noises: tuple[float, float], light: float) -> Effort:
        many, few = noises
        steep = many > 0 and few > 0 and self._fewer < self.sample.fine
        rate = math.log(few / many) / math.log(self.sample.fine / self._fewer) if steep else 0.5
        relative = many / light if light else 0.0
        return Effort(Noise(relative, self.sample.fine, min(max(rate, 0.5), _STEEPEST)), self.bench.n**2)

    @property
    def _fewer(self) -> int:
        return max(1, self.sample.fine // 4)

    @cached_property
    def _whole(self) -> FloatArray:
        """(looks, ...) frames of the light in the cells and layers of the base."""
        return self._formed(self._simulation, self._deposits, self.sample.fine)

    @cached_property
    def _noise(self) -> tuple[float, float]:
        return self._noise_of(self._tracer, self._whole)

    @cached_property
    def _spread_noise(self) -> tuple[float, float]:
        tracer = _tracer(self._simulation, _shown(self.base, self.sample), 1, spread=True)
        seen = tracer.trace_looks(self._seeds, self.sample.fine)
        return self._noise_of(tracer, self._formed(self._simulation, seen, self.sample.fine))

    def _noise_of(self, tracer: DirectTracer, many: FloatArray) -> tuple[float, float]:
        """Error of a look of the ``tracer`` whose frames of all samples are ``many``, and of one with fewer."""
        few = tracer.trace_looks(self._seeds, self._fewer)
        return noise(many), noise(self._formed(self._simulation, few, self._fewer))

    def forming(self, family: Lighting) -> Forming:
        """What forming frames of a ``family`` takes; timed with one cell a pixel, its optics prepared."""
        simulation = Simulation(self.bench, self.base)
        rows, weights = self.sample.rows, self.sample.lighting.weights
        light = simulation.fine.file(self._deposits[0], self.sample.lighting.labels, self.sample.fine)
        filed, timed = Filed(simulation.fine.optics, (light[: len(rows)],) * GROUPS), weights[: workers()]
        started = time.perf_counter()
        list(ExpectedFrames([filed], Lighting(rows, timed), 0))
        seconds = (time.perf_counter() - started) / len(timed)
        cells = max(simulation.fine.bundle.cells)
        geometry = self.bench.geometry
        waves = self.bench.waves
        return Forming(
            pixels=geometry.frame_side,
            cells=cells,
            lit=self._lit(simulation, light) / cells,
            terms=float(len(self.bench.spectrum.weights) * geometry.mask_terms),
            shots=len(family.weights),
            classes=family.weights.shape[1],
            seconds=seconds,
            product=_product_seconds(),
            geometric_terms=float(geometry.mask_terms),
            correlated=(geometry.drawn(waves=False), geometry.drawn(geometry.diffracts)),
            phases=float(cells_per_pixel(geometry) ** 2),
            drawing=(drawing_seconds(geometry, None), drawing_seconds(geometry, waves)),
            parted=bool(self.bench.loaded.parting),
        )

    def raster(self) -> tuple[Drawn, Drawn]:
        """What a shadow on a raster leaves of a frame, without diffraction and with it."""
        simulation = Simulation(self.bench, self.base)
        bundle, geometry = simulation.fine.bundle, self.bench.geometry
        filed = simulation.fine.file(self._deposits[0], self.sample.lighting.labels, self.sample.fine)
        shot = sparse.csr_array(self.sample.lighting.weights[:1]) @ filed[: self.sample.lighting.weights.shape[1]]
        light = shot.toarray().reshape(bundle.anchors, bundle.cells[0], bundle.anchors, bundle.cells[1])

        def drawn(spectrum: Spectrum | None) -> Drawn:
            waves = spectrum is not None
            if not (geometry.drawn(waves) or geometry.may_be_drawn(waves)):
                return Drawn()
            seen = light[0, :, 0]
            error, known = raster_error(geometry, bundle.rows, bundle.columns, self.base.depth, spectrum, seen)
            found = Estimate(error, _SURE_OF_RASTER * error) if known else Estimate(*(error * by for by in _OF_FINER))
            return Drawn(found, geometry.drawn(waves), cells_to_choose(geometry, spectrum))

        without, waves = drawn(None), self.bench.waves
        return without, drawn(waves) if waves else without

    def _lit(self, simulation: Simulation, light: sparse.csr_array) -> float:
        """Rows of cells that hold light in a shot, their mean."""
        shots = (self.sample.lighting.weights @ (light[: len(self.sample.rows)] != 0)) != 0
        width = simulation.fine.bundle.cells[1]
        places = [np.flatnonzero(shot) if isinstance(shot, np.ndarray) else shot.indices for shot in shots]
        return max(1.0, float(np.mean([len(np.unique(place // width)) for place in places])))

    def _frames(self, layers: tuple[float, ...], subdivision: int) -> FloatArray:
        settings = replace(self.base, layers=layers, subdivision=subdivision)
        simulation = self.sample.simulation(self.bench, settings)
        return self._formed(simulation, self._deposits, self.sample.fine, self._sharp)

    def _formed(
        self, simulation: Simulation, deposits: list[Deposits], samples: int, sharp: Sequence[Deposits] = ()
    ) -> FloatArray:
        sample, light = self.sample, emitted(simulation.physics, self.sample.lighting)
        frames = sample.frames(simulation.fine, deposits, samples, light)
        return frames + sample.frames(simulation.sharp, sharp, sample.sharp(simulation), light) if sharp else frames


def _product_seconds() -> float:
    """Of a multiplication in products like those of frames, all processors at work: the better of two trials."""
    matrix, taken = np.ones((_SIDE, _SIDE)), []
    for _ in range(2):
        started = time.perf_counter()
        in_threads(lambda _: matrix @ matrix, range(_TRIALS))
        taken.append(time.perf_counter() - started)
    return min(taken) / (_TRIALS * _SIDE**3)


class AnchoredLight:
    """The frames with fewer anchors; every anchor is connected to the same points, so little noise is left.

    Frames, not radiance: the falloff's error is odd in the scene's coordinates and mostly cancels in a frame. Of one
    wavelength: anchors change the same with all (to 0.2 % in photograph, cards and corner), coarse cells at most a
    quarter less.

    Parameters
    ----------
    bench, base, sample, seed
        as for :class:`FineLight`.
    tolerance
        norm of a change at which the search for enough may stop.
    layers
        depths [mm] that judge one layer; none for a flat scene.
    """

    _ladder: tuple[int, ...] = ANCHOR_LADDER
    _part, _name, _few_anchors = "anchors", "anchored", _FEW_ANCHORS

    def __init__(
        self,
        bench: Bench,
        base: Settings,
        sample: Sample,
        tolerance: float,
        seed: int,
        layers: tuple[float, ...] = (),
    ) -> None:
        self.bench, self.base, self.sample, self.tolerance = bench, base, sample, tolerance
        self.layers = layers
        self._seeds = [integer(seed, "pilot", "anchors", look) for look in range(LOOKS)]
        self.pixels, self._samples = self._of(sample)

    def _of(self, sample: Sample) -> tuple[Labels, int]:
        """Pixels that are followed, and samples of each in a look."""
        return np.setdiff1d(_shown(self.base, sample), self.base.occluded), sample.anchored

    @property
    def paths(self) -> int:
        """Paths of all looks to one anchor."""
        return LOOKS * len(self.pixels) * self._samples

    @cached_property
    def changes(self) -> dict[Part, FloatArray]:
        """Change of the frames by every number of anchors that was tried, and by coarse cells for what they see."""
        coarse = coarsened(self._name, self._beyond, self.layers)
        return {**self._until(self.tolerance), **coarse}

    @property
    def few(self) -> dict[Part, FloatArray]:
        """Change of the frames by the numbers of anchors that are always tried, as far as they tell."""
        return self._until(math.inf)

    def _until(self, tolerance: float) -> dict[Part, FloatArray]:
        found = ladder(self._ladder, self._frames, _FIRST_JUDGES["anchors"], tolerance)
        return {Part(self._part, count): change for count, change in found.items()}

    def effort(self, light: float) -> Effort:
        """Monte Carlo error of one estimate of what a few anchors see beyond their mean, relative to all ``light``."""
        relative = self._noise / light if light else 0.0
        return Effort(Noise(relative, self._samples, 0.5), self._lanes)

    @property
    def _lanes(self) -> int:
        return self.bench.n**2 - len(self.base.occluded)

    @cached_property
    def _noise(self) -> float:
        return noise(self._beyond(1, ()))

    @known
    def _beyond(self, cells: int, layers: tuple[float, ...]) -> FloatArray:
        """Frames of what a few anchors see beyond their mean, in coarse cells and layers."""
        coarse = replace(self.base, coarse_cells=cells, coarse_layers=bool(layers), layers=layers)
        simulation = self._simulation(self._few_anchors, coarse)
        tray, weights = self._tray(simulation), simulation.mean_weights(self._few_anchors)
        mean = [look.averaged(weights) for look in self._few]
        frames = self._frames(self._few_anchors) if coarse == self.base else self._formed(tray, self._few)
        return frames - self._formed(tray.of_mean, mean)

    @cached_property
    def _few(self) -> list[Deposits]:
        return self._traced(self._simulation(self._few_anchors, self.base))

    @known
    def _frames(self, anchors: int) -> FloatArray:
        simulation = self._simulation(anchors, self.base)
        traced = self._few if anchors == self._few_anchors else self._traced(simulation)
        return self._formed(self._tray(simulation), traced)

    def _simulation(self, anchors: int, settings: Settings) -> Simulation:
        return self.sample.simulation(self.bench, replace(settings, anchors=anchors), one_line=True)

    def _tray(self, simulation: Simulation) -> Tray:
        """Where light of these pixels is filed."""
        return simulation.coarse

    def _traced(self, simulation: Simulation) -> list[Deposits]:
        """Light to every anchor, look by look."""
        anchors = self._tray(simulation).bundle.anchors
        tracer = _tracer(simulation, self.pixels, anchors)
        return tracer.trace_looks(self._seeds, self._samples)

    def _formed(self, tray: Tray, looks: list[Deposits]) -> FloatArray:
        """(looks, shots, places, places) frames of light in a ``tray``."""
        return self.sample.frames(tray, looks, self._samples)


class OccludedLight(AnchoredLight):
    """The same of occluded pixels, which many anchors see."""

    _ladder = OCCLUDED_LADDER
    _part, _name, _few_anchors = "occluded_anchors", "occluded", _FEW_OCCLUDED

    def _of(self, sample: Sample) -> tuple[Labels, int]:
        pixels = np.intersect1d(_shown(self.base, sample), self.base.occluded)
        return pixels, sample.occluded(len(pixels))

    @property
    def _lanes(self) -> int:
        return len(self.base.occluded)

    def _simulation(self, anchors: int, settings: Settings) -> Simulation:
        return self.sample.simulation(self.bench, replace(settings, occluded_anchors=anchors), one_line=True)

    def _tray(self, simulation: Simulation) -> Tray:
        return simulation.occluded


def _shown(settings: Settings, sample: Sample) -> Labels:
    """Projector pixels that the shots of a ``sample`` show, but for those that are traced apart."""
    return np.setdiff1d(sample.shown, settings.sharp.pixels) if settings.sharp else sample.shown


def _tracer(simulation: Simulation, pixels: Labels, anchors: int, spread: bool = False) -> DirectTracer:
    """Direct light of some projector ``pixels`` to every anchor, or ``spread`` over the sensor."""
    loaded, physics = simulation.bench.loaded, simulation.physics
    parts = loaded.scene, loaded.camera, physics.projector, anchors, physics.geometry
    return DirectTracer(*parts, spread=spread, pixels=pixels)
