"""Frames of a few independent replicates, and changes and noise of direct light.

Replicates show the same change with independent noise, so the mean product of two replicates estimates its square.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from mitsim.bench.apparatus import Apparatus
from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.parallel import in_threads
from mitsim.core.seeds import integer
from mitsim.devices.patterns import Lighting
from mitsim.devices.projector import Spectrum
from mitsim.light.cost_model import cells_to_choose, drawing_seconds
from mitsim.light.passes import Grid, Simulation, emission
from mitsim.light.settings import REPLICATES, Approximation, Drawn, Estimate, Forming, SampleCost, Settings
from mitsim.optics.fft_shadow import cells_per_pixel, raster
from mitsim.optics.image_formation import Entries, number_of_terms, raster_error
from mitsim.optics.shadow import Places
from mitsim.transport.direct import DirectTracer
from mitsim.transport.records import Bundle, PathSamples

Known = dict[Hashable, tuple[Sequence[PathSamples], FloatArray]]
"""Frames that were formed already, with their light."""
_SHOTS, _MOST_SHOTS, _SHOWN = 4, 16, 1024
"""Fewest and most shots of the pilot, and shown pixels below which it takes more than the fewest."""
_PLACES = 96
"""Rows and columns of the sensor in the pilot's frames."""
_GOLDEN = (math.sqrt(5) - 1) / 2  # Steps of it are never in phase with a mask's features.
_DIGITS = 12  # of a pattern's light, without rounding
_SPARSE = 8  # places per entry of light above which entries are sorted
_PIXELS = 64**2  # Fewer pixels get more samples each.
_MOST_PATHS = 2**20  # of one replicate in memory: 60 MB
_SHARP_PATHS = 2**18
_MOST_SHARP = 256  # samples of a sharp pixel: an error of 3e-3
_OCCLUDED, _MOST_OCCLUDED, _FEWEST_OCCLUDED = 2**9, 2**11, 4
"""Points on occluded pixels in a first replicate, the most in any, and the fewest of one pixel."""
FINER = 4
"""Ratio of samples of successive runs."""
EVEN_CELLS = 0.25
"""Fraction of the error that remains in cells of half the size, for smooth light."""
_UNKNOWN_GAIN = 0.5
"""Largest assumed ratio of successive steps."""
GOOD_ENOUGH = 0.3
"""Part of the accuracy below which no finer step is tried."""
SHARP_RATE = 0.75
"""Exponent of the error against samples for stratified rays (flat plates of 1e-3 and 1e-4: 0.7 to 0.9)."""
LAYER_LADDER, CELL_LADDER = (1, 2, 3, 4, 6, 8, 12), (1, 2, 4, 8)
_CELL, _LAYER = Approximation("cells", 1), Approximation("layers", 1)
_FIRST_JUDGES = {"layers": 2, "cells": 1}
_JUDGING = 4
_FLAT = 1e-4
_STEEPEST = 0.9
"""Largest exponent of the error against samples."""
_SURE_OF_RASTER = 1.5
"""Largest error of a raster over that of a few pixels about the axis (measured: 1.04 to 1.11)."""
_OF_FINER = (1.0, 1.75)
"""Error of a raster, and its bound, over the difference from a raster of half the cells (measured: 0.87 to 1.5)."""
_FARTHEST = 1e-4


# -------- Frames of replicates


@dataclass(frozen=True)
class Sample:
    lighting: Lighting
    places: Places
    times: int = 1

    @classmethod
    def of(cls, lighting: Lighting, shape: tuple[int, int], mirrors: bool) -> Sample:
        shots = len(lighting.weights)
        lit = np.bincount(lighting.labels, minlength=lighting.weights.shape[1]) @ (lighting.weights[0] != 0)
        # Of many patterns that overlap, few are stripes, whose frames have six times the error of the others.
        unlike = shots > _MOST_SHOTS and bool((lighting.weights != 0).sum(axis=0).max() > 1)
        few = _MOST_SHOTS if mirrors or unlike else _SHOWN // max(int(lit), 1)
        wanted = min(max(_SHOTS, few), _MOST_SHOTS, shots)
        chosen = np.unique(np.linspace(0, shots - 1, wanted).astype(int))
        return cls(lighting.shots(chosen), (_spread(shape[0]), _spread(shape[1])))

    @property
    def finer(self) -> Sample:
        """Return a copy with more samples, so that standard errors are at least halved."""
        return replace(self, times=FINER * self.times)

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.places[0]), len(self.places[1])

    @property
    def shown(self) -> Labels:
        return np.flatnonzero((self.lighting.weights != 0).any(axis=0)[self.lighting.labels])

    @property
    def fine(self) -> int:
        return self.within(4 * self.times * max(1, _PIXELS // len(self.shown)), len(self.shown))

    @property
    def anchored(self) -> int:
        return max(1, self.fine // 4)

    @property
    def direct(self) -> int:
        pixels = len(self.lighting.labels)
        return self.within(2 * self.times * max(1, _PIXELS // pixels), pixels)

    @property
    def followed(self) -> int:
        return max(1, self.direct // 2)

    def samples_of_occluded(self, pixels: int) -> int:
        return max(_FEWEST_OCCLUDED, min(self.times * _OCCLUDED, _MOST_OCCLUDED) // max(pixels, 1))

    def sharp(self, simulation: Simulation) -> int:
        paths = simulation.sharp.paths_per_sample if simulation.sharp else 1
        return min(max(_SHARP_PATHS // paths, 4), _MOST_SHARP)

    def within(self, samples: int, pixels: int) -> int:
        return max(1, min(samples, _MOST_PATHS // pixels))

    def simulation(
        self, bench: Apparatus, settings: Settings, one_line: bool = False, judging_cells: int = 0
    ) -> Simulation:
        made = Simulation(bench, settings, one_line=one_line, places=self.places, judging_cells=judging_cells)
        made.divides = False
        return made

    def frames(
        self,
        grid: Grid,
        replicates: Sequence[PathSamples],
        samples: int,
        emitted: FloatArray | None = None,
        known: Known | None = None,
    ) -> FloatArray:
        """Form (replicates, shots, rows, columns) frames; negative values are kept.

        ``emitted`` (shots, classes) replaces the light of each class in the shots; ``known`` is a cache.
        """
        emitted = self.lighting.weights if emitted is None else emitted
        least, most = emitted.min(axis=1), emitted.max(axis=1)
        span = np.where(most > least, most - least, 1.0)
        pattern = (emitted - least[:, None]) / span[:, None]
        of_all = np.ones((int(least.any()), emitted.shape[1]))
        seen = self._class_frames(grid, replicates, np.concatenate([pattern, of_all]), known)
        frames = span[:, None, None] * seen[:, : len(pattern)]
        if len(of_all):
            frames += least[:, None, None] * seen[:, len(pattern) :]
        return frames / samples

    def lamps(
        self, grid: Grid, replicates: Sequence[PathSamples], samples: int, known: Known | None = None
    ) -> FloatArray:
        pattern = np.zeros((1, self.lighting.weights.shape[1] + 1))
        pattern[:, -1] = 1
        return self._class_frames(grid, replicates, pattern, known) / samples

    def _class_frames(
        self, grid: Grid, replicates: Sequence[PathSamples], patterns: FloatArray, known: Known | None
    ) -> FloatArray:
        known = {} if known is None else known
        classes = self.lighting.weights.shape[1]
        patterns = np.pad(patterns, ((0, 0), (0, classes + 1 - patterns.shape[1])))
        light = grid.key, *map(id, replicates)
        keys = [(*light, np.round(row, _DIGITS).tobytes()) for row in patterns]
        missing = [place for place, key in enumerate(keys) if key not in known]
        classes_of = np.append(self.lighting.labels, [classes] * grid.bundle.lamps)
        size = grid.bundle.size
        entries = in_threads(grid.bundle.entries, replicates) if missing else []
        optics = grid.optics if any(len(place) for place, *_ in entries) else None

        def gather(places: Labels, values: FloatArray) -> Entries:
            lit = values != 0
            places, values = places[lit], values[lit]
            if size > _SPARSE * len(places):
                found, index = np.unique(places, return_inverse=True)
                return found, np.bincount(index, values, len(found)).astype(np.float64)
            light = np.bincount(places, values, size).astype(np.float64)
            found = np.flatnonzero(light)
            return found, light[found]

        def form(row: int) -> None:
            frames = np.zeros((len(replicates), *self.shape))
            if optics:
                share = patterns[row][classes_of]
                seen = optics.probe([gather(place, value * share[pixel]) for place, value, pixel in entries])
                frames = np.moveaxis(seen.reshape(len(frames[0]), len(frames), -1), 1, 0)
            # The replicates are held with the frames: their numbers must not be given to others.
            known[keys[row]] = replicates, frames

        in_threads(form, missing)
        return np.stack([known[key][1] for key in keys], axis=1)


def _spread(count: int) -> tuple[int, ...]:
    some = min(count, _PLACES)
    places = (np.arange(some) + (np.arange(some) * _GOLDEN) % 1) * count / some
    return tuple(places.astype(int).tolist())


def ladder(
    steps: Iterable[int], frames: Callable[[int], FloatArray], first: int, tolerance: float, least_gain: float = 0.0
) -> Mapping[int, FloatArray]:
    """Return the change from each step to the limit of ever finer steps.

    Each step is assumed to gain as much as the one before, and at least ``least_gain``. Steps finer than the ``first``
    judge are tried until the norm of the remaining change is below ``tolerance``.
    """
    counts = list(steps)
    tried = {count: frames(count) for count in counts[: first + 1]}
    while True:
        *earlier, before, judge = tried
        last = tried[judge] - tried[before]
        gain, former = _UNKNOWN_GAIN, norm(tried[before] - tried[earlier[-1]]) if earlier else 0.0
        if former > 0:
            gain = min(norm(last) / former, gain)
        rest = max(gain, least_gain) / (1 - max(gain, least_gain))
        # Two steps give the error that the judge leaves; a single step gives that of the step before it.
        if (rest if earlier else 1 + rest) * norm(last) <= tolerance or judge == counts[-1]:
            break
        following = counts[counts.index(judge) + 1]
        tried[following] = frames(following)
    limit = tried[judge] + rest * last
    return {count: limit - found for count, found in tried.items()}


def coarsening_changes(
    name: str, frames: Callable[[int, tuple[float, ...]], FloatArray], layers: tuple[float, ...]
) -> dict[Approximation, FloatArray]:
    one, two = frames(1, ()), frames(2, ())
    changes = {Approximation(f"{name} cells", 1): (two - one) / (1 - EVEN_CELLS)}
    return {**changes, Approximation(f"{name} layers", 1): frames(1, layers) - one} if layers else changes


def norm(seen: FloatArray) -> float:
    """Return the norm of frames without their noise."""
    replicates = len(seen)
    # Sums by numpy: those of BLAS depend on the number of its threads in the last bits.
    whole = float(np.square(seen.sum(axis=0)).sum())
    return math.sqrt(max((whole - float(np.square(seen).sum())) / (replicates * (replicates - 1)), 0.0))


def noise(seen: FloatArray) -> float:
    """Return the norm of the error of one replicate."""
    return math.sqrt(float(np.square(seen - seen.mean(axis=0)).sum()) / (len(seen) - 1))


# -------- Direct light in different layers and cells


class DirectRuns:
    def __init__(self, bench: Apparatus, base: Settings, sample: Sample, accuracy: float, seed: int) -> None:
        self.bench, self.base, self.sample, self.accuracy = bench, base, sample, accuracy
        self._known: Known = {}
        self._noises: dict[bool, tuple[float, float]] = {}
        self._seeds = [integer(seed, "pilot", "fine", replicate) for replicate in range(REPLICATES)]
        self._simulation = simulation = sample.simulation(bench, base)
        self.first, self._path_samples = self._trace(base.anchors)
        apart, samples = simulation.sharp, sample.sharp(simulation)
        self._sharp = apart.replicates(self._seeds, samples)[0] if apart else []
        inverse = np.concatenate([light.inverse_depth for light in (*self._path_samples, *self._sharp)])
        near = far = base.depth
        if inverse.size:
            near, far = 1 / float(inverse.max()), 1 / max(float(inverse.min()), _FARTHEST / base.depth)
        self.layers: dict[int, tuple[float, ...]] = {1: (base.depth,)}
        """Candidates for the layers' depths [mm], by their number."""
        if far > near * (1 + _FLAT):
            for count in LAYER_LADDER[1:]:
                self.layers[count] = tuple(float(node) for node in 1 / np.linspace(1 / far, 1 / near, count))
        self.judging = self.layers.get(_JUDGING, ())
        """Depths [mm] of the layers that judge one layer; none for a flat scene."""

    def _trace(self, anchors: int, spread: bool = False) -> list[list[PathSamples]]:
        tracer = DirectTracer(self._simulation.setup, anchors, spread, shown_pixels(self.base, self.sample))
        return tracer.replicates(self._seeds, self.sample.anchored, self.sample.fine)

    @cached_property
    def changes(self) -> dict[Approximation, FloatArray]:
        found: dict[Approximation, FloatArray] = {}
        first, tolerance = _FIRST_JUDGES["cells"], GOOD_ENOUGH * self.accuracy * norm(self._whole)
        cells = ladder(CELL_LADDER, lambda count: self._frames((), count), first, tolerance, EVEN_CELLS)
        found |= {Approximation("cells", count): change for count, change in cells.items()}
        if len(self.layers) > 1:
            first = _FIRST_JUDGES["layers"]
            layers = ladder(self.layers, lambda count: self._frames(self.layers[count], 2, True), first, tolerance)
            found |= {Approximation("layers", count): change for count, change in layers.items()}
        return found

    @property
    def coarse(self) -> tuple[float, float]:
        whole = norm(self._whole)
        cells, layer = (norm(self.changes[part]) if part in self.changes else 0.0 for part in (_CELL, _LAYER))
        return (cells / whole, layer / whole) if whole else (math.inf, math.inf)

    @cached_property
    def _whole(self) -> FloatArray:
        return self._form(self._simulation, self._path_samples, self.sample.fine)

    def sample_cost(self, light: float, spread: bool = False) -> SampleCost:
        """Return the sample cost, relative to ``light``, at the sensor's centre or with ``spread`` at random points."""
        spread = spread and not (self.bench.loaded.one_way and not self.bench.loaded.glossy)
        sample = self.sample
        if spread not in self._noises:
            first, seen = self._trace(1, spread=True) if spread else (self.first, self._path_samples)
            each = (seen, sample.fine), (first, sample.anchored)
            many, few = (noise(self._form(self._simulation, light, count)) for light, count in each)
            self._noises[spread] = many, few
        many, few = self._noises[spread]
        steep = many > 0 and few > 0 and sample.anchored < sample.fine
        rate = math.log(few / many) / math.log(sample.fine / sample.anchored) if steep else 0.5
        return SampleCost.relative(many, light, sample.fine, self.bench.n**2, min(max(rate, 0.5), _STEEPEST))

    def forming(self, family: Lighting) -> Forming:
        geometry, waves = self.bench.geometry, self.bench.waves
        bundle, light = self._accumulated
        shots = (self.sample.lighting.weights @ (light[: self.sample.lighting.weights.shape[1]] != 0)) != 0
        places = [np.flatnonzero(shot) if isinstance(shot, np.ndarray) else shot.indices for shot in shots]
        rows = max(1.0, float(np.mean([len(np.unique(place // bundle.cells[1])) for place in places])))

        def largest_terms(spectrum: Spectrum | None) -> float:
            if not geometry.is_drawn(spectrum is not None):
                return math.inf
            return number_of_terms(raster(geometry, self.base.depth, spectrum))

        return Forming(
            pixels=geometry.frame_side,
            cells=max(bundle.cells),
            lit=rows / max(bundle.cells),
            terms=float(len(self.bench.spectrum.weights) * geometry.mask_terms),
            shots=len(family.weights),
            classes=family.weights.shape[1],
            geometric_terms=float(geometry.mask_terms),
            correlated=(geometry.is_drawn(waves=False), geometry.is_drawn(geometry.diffracts)),
            phases=float(cells_per_pixel(geometry) ** 2),
            largest_terms=(largest_terms(None), largest_terms(waves)),
            drawing=(drawing_seconds(geometry, None), drawing_seconds(geometry, waves)),
            parted=bool(self.bench.loaded.parting),
        )

    @cached_property
    def _accumulated(self) -> tuple[Bundle, sparse.csr_array]:
        bundle = Simulation(self.bench, self.base).grids["fine"].bundle
        return bundle, bundle.accumulate(self._path_samples[0], self.sample.lighting.labels, self.sample.fine)

    @cached_property
    def raster(self) -> tuple[Drawn, Drawn]:
        geometry, lighting, (bundle, light) = self.bench.geometry, self.sample.lighting, self._accumulated
        shot = sparse.csr_array(lighting.weights[:1]) @ light[: lighting.weights.shape[1]]
        seen = shot.toarray().reshape(bundle.anchors, bundle.cells[0], bundle.anchors, bundle.cells[1])[0, :, 0]

        def draw_shadow(spectrum: Spectrum | None) -> Drawn:
            waves = spectrum is not None
            if not (geometry.is_drawn(waves) or geometry.may_be_drawn(waves)):
                return Drawn()
            error, known = raster_error(geometry, *bundle.directions, self.base.depth, spectrum, seen)
            found = Estimate(error, _SURE_OF_RASTER * error) if known else Estimate(*(error * by for by in _OF_FINER))
            return Drawn(found, geometry.is_drawn(waves), cells_to_choose(geometry, spectrum))

        without, waves = draw_shadow(None), self.bench.waves
        return without, draw_shadow(waves) if waves else without

    def _frames(self, layers: tuple[float, ...], subdivision: int, one_line: bool = False) -> FloatArray:
        settings = replace(self.base, layers=layers, subdivision=subdivision)
        simulation = self.sample.simulation(self.bench, settings, one_line)
        frames = self._form(simulation, self._path_samples, self.sample.fine)
        if not self._sharp:
            return frames
        light, samples = emission(simulation.physics, self.sample.lighting), self.sample.sharp(simulation)
        return frames + self.sample.frames(simulation.grids["sharp"], self._sharp, samples, light)

    def _form(self, simulation: Simulation, light: list[PathSamples], samples: int) -> FloatArray:
        emitted = emission(simulation.physics, self.sample.lighting)
        return self.sample.frames(simulation.grids["fine"], light, samples, emitted, self._known)


def shown_pixels(settings: Settings, sample: Sample) -> Labels:
    return np.setdiff1d(sample.shown, settings.sharp.pixels) if settings.sharp else sample.shown
