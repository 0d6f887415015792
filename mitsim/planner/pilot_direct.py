"""Direct light, accumulated in different ways: what few layers or cells change, noise, and pixels of their own."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy import sparse

from mitsim.bench.apparatus import Apparatus
from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.parallel import in_threads
from mitsim.core.seeds import integer
from mitsim.devices.patterns import Lighting
from mitsim.devices.projector import Spectrum
from mitsim.light.memory import cells_to_choose, drawing_seconds
from mitsim.light.settings import (
    REPLICATES,
    Approximation,
    Drawn,
    Estimate,
    Forming,
    SampleCost,
    Settings,
    SharpPixels,
)
from mitsim.light.simulation import Simulation, emission
from mitsim.optics.fft_shadow import cells_per_pixel, raster
from mitsim.optics.image_formation import number_of_terms, raster_error
from mitsim.planner.pilot_samples import EVEN_CELLS, GOOD_ENOUGH, Known, Sample, ladder, noise, norm
from mitsim.transport.direct import DirectTracer
from mitsim.transport.missed import SharpLight, with_neighbours
from mitsim.transport.records import PathSamples

LAYER_LADDER, CELL_LADDER = (1, 2, 3, 4, 6, 8, 12), (1, 2, 4, 8)
"""Numbers that are tried, each step about half the error of the one before or less."""
_CELL, _LAYER = Approximation("cells", 1), Approximation("layers", 1)
_FIRST_JUDGES = {"layers": 2, "cells": 1}
"""Indices of the numbers that judge at first: two steps, or one where it is known how the error falls."""
_JUDGING = 4
"""Layers that judge one layer for light in coarse cells: the error of one is told to a twentieth."""
_FLAT = 1e-4
"""Relative range of depths below which one layer is exact: rounding in single precision is a thousandth of it."""
_STEEPEST = 0.9
"""Power of the samples that the error of direct light falls with at most: over a few samples it may fall faster, but
edges in the scene bring it to 0.75 in the end."""
_SIDE, _AT_ONCE, _MOST_TRIALS = 256, 4, 12
"""Side and number of the products that tell how fast the machine multiplies, 1.3 ms on two cores, and how often they
are tried at most."""
_BETTER = 0.9
"""Of the best one's seconds that a trial takes after which two more are made: processors that rested take up to 2.5
times as long at first (4.9, 3.5, 3.1, then 1.9 three times)."""
_SURE_OF_RASTER = 1.5
"""Largest error of a raster over that of a few pixels about the axis: 1.04 to 1.11 of 96 x 96 pixels for random, grey,
blurred and dusty masks, in dots and in uniform light (tests/physics/test_raster.py)."""
_OF_FINER = (1.0, 1.75)
"""Error of a raster, and its bound, over its difference from one of half the cells there: against 24 cells a pixel 0.87
to 1.08 for masks turned by 0.3 and 1 degrees, 1.1 to 1.5 for pictures of light, whose error falls slowest, on as few
pixels."""
_FARTHEST = 1e-4
"""Inverse depth, relative to the scene's, below which light counts as infinitely far."""


class DirectRuns:
    """Direct light in many samples a cell, accumulated in different ways.

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

    Attributes
    ----------
    first
        light of the first samples, as many as tell anchors apart, replicate by replicate.
    """

    def __init__(self, bench: Apparatus, base: Settings, sample: Sample, accuracy: float, seed: int) -> None:
        self.bench, self.base, self.sample, self.accuracy = bench, base, sample, accuracy
        self._known: Known = {}
        self._seeds = [integer(seed, "pilot", "fine", replicate) for replicate in range(REPLICATES)]
        self._simulation = simulation = sample.simulation(bench, base)
        tracer = tracer_of(simulation, shown_pixels(base, sample), base.anchors)
        self.first, self._path_samples = self._trace(tracer)
        apart, samples = simulation.sharp, sample.sharp(simulation)
        self._sharp = apart.replicates(self._seeds, samples)[0] if apart else []

    def _trace(self, tracer: DirectTracer) -> list[list[PathSamples]]:
        """Replicates of a tracer's light, of few samples and of all."""
        return tracer.replicates(self._seeds, self.sample.anchored, self.sample.fine)

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
        inverse = np.concatenate([path_samples.inverse_depth for path_samples in (*self._path_samples, *self._sharp)])
        if not inverse.size:
            return self.base.depth, self.base.depth
        return 1 / float(inverse.max()), 1 / max(float(inverse.min()), _FARTHEST / self.base.depth)

    @cached_property
    def changes(self) -> dict[Approximation, FloatArray]:
        """Change of the frames by every number of cells and layers that was tried."""
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
        """Parts that one cell a pixel, and one layer, leave of the light."""
        whole = norm(self._whole)
        cells, layer = (norm(self.changes[part]) if part in self.changes else 0.0 for part in (_CELL, _LAYER))
        return (cells / whole, layer / whole) if whole else (math.inf, math.inf)

    def sample_cost(self, light: float) -> SampleCost:
        """Monte Carlo error of one estimate of the light at the sensor's centre, relative to all ``light``; how fast it
        falls with samples; and paths of a sample."""
        return self._sample_cost(self._noise, light)

    def spread(self, light: float) -> SampleCost:
        """The same, as a part of ``light``, of what random points of the sensor see: gloss differs over the sensor, and
        makes noise there."""
        if self.bench.loaded.one_way and not self.bench.loaded.glossy:
            return self.sample_cost(light)
        return self._sample_cost(self._spread_noise, light)

    def _sample_cost(self, noises: tuple[float, float], light: float) -> SampleCost:
        many, few = noises
        steep = many > 0 and few > 0 and self.sample.anchored < self.sample.fine
        rate = math.log(few / many) / math.log(self.sample.fine / self.sample.anchored) if steep else 0.5
        return SampleCost.relative(many, light, self.sample.fine, self.bench.n**2, min(max(rate, 0.5), _STEEPEST))

    @cached_property
    def _whole(self) -> FloatArray:
        """(replicates, ...) frames of the light in the cells and layers of the base."""
        return self._form(self._simulation, self._path_samples, self.sample.fine)

    @cached_property
    def _noise(self) -> tuple[float, float]:
        return self._noise_of(self._whole, self.first)

    @cached_property
    def _spread_noise(self) -> tuple[float, float]:
        tracer = tracer_of(self._simulation, shown_pixels(self.base, self.sample), 1, spread=True)
        first, seen = self._trace(tracer)
        return self._noise_of(self._form(self._simulation, seen, self.sample.fine), first)

    def _noise_of(self, many: FloatArray, first: list[PathSamples]) -> tuple[float, float]:
        """Error of a replicate whose frames of all samples are ``many``, and of its ``first`` few."""
        return noise(many), noise(self._form(self._simulation, first, self.sample.anchored))

    def forming(self, family: Lighting) -> Forming:
        """What forming frames of a ``family`` takes."""
        simulation = Simulation(self.bench, self.base)
        fine = simulation.grids["fine"]
        light = fine.bundle.accumulate(self._path_samples[0], self.sample.lighting.labels, self.sample.fine)
        cells = max(fine.bundle.cells)
        geometry = self.bench.geometry
        waves = self.bench.waves
        return Forming(
            pixels=geometry.frame_side,
            cells=cells,
            lit=self._lit_rows(simulation, light) / cells,
            terms=float(len(self.bench.spectrum.weights) * geometry.mask_terms),
            shots=len(family.weights),
            classes=family.weights.shape[1],
            product=_product_seconds(),
            geometric_terms=float(geometry.mask_terms),
            correlated=(geometry.is_drawn(waves=False), geometry.is_drawn(geometry.diffracts)),
            phases=float(cells_per_pixel(geometry) ** 2),
            largest_terms=(self._largest_terms(None), self._largest_terms(waves)),
            drawing=(drawing_seconds(geometry, None), drawing_seconds(geometry, waves)),
            parted=bool(self.bench.loaded.parting),
        )

    def _largest_terms(self, spectrum: Spectrum | None) -> float:
        """Terms of the shadow of the light's depth that must be drawn; infinite where they are too many, or none."""
        geometry = self.bench.geometry
        if not geometry.is_drawn(spectrum is not None):
            return math.inf
        return number_of_terms(raster(geometry, self.base.depth, spectrum))

    def raster(self) -> tuple[Drawn, Drawn]:
        """What a shadow on a raster leaves of a frame, without diffraction and with it."""
        simulation = Simulation(self.bench, self.base)
        bundle, geometry = simulation.grids["fine"].bundle, self.bench.geometry
        light = bundle.accumulate(self._path_samples[0], self.sample.lighting.labels, self.sample.fine)
        shot = sparse.csr_array(self.sample.lighting.weights[:1]) @ light[: self.sample.lighting.weights.shape[1]]
        light = shot.toarray().reshape(bundle.anchors, bundle.cells[0], bundle.anchors, bundle.cells[1])

        def draw_shadow(spectrum: Spectrum | None) -> Drawn:
            waves = spectrum is not None
            if not (geometry.is_drawn(waves) or geometry.may_be_drawn(waves)):
                return Drawn()
            seen = light[0, :, 0]
            error, known = raster_error(geometry, bundle.rows, bundle.columns, self.base.depth, spectrum, seen)
            found = Estimate(error, _SURE_OF_RASTER * error) if known else Estimate(*(error * by for by in _OF_FINER))
            return Drawn(found, geometry.is_drawn(waves), cells_to_choose(geometry, spectrum))

        without, waves = draw_shadow(None), self.bench.waves
        return without, draw_shadow(waves) if waves else without

    def _lit_rows(self, simulation: Simulation, light: sparse.csr_array) -> float:
        """Rows of cells that hold light in a shot, their mean."""
        shots = (self.sample.lighting.weights @ (light[: len(self.sample.rows)] != 0)) != 0
        width = simulation.grids["fine"].bundle.cells[1]
        places = [np.flatnonzero(shot) if isinstance(shot, np.ndarray) else shot.indices for shot in shots]
        return max(1.0, float(np.mean([len(np.unique(place // width)) for place in places])))

    def _frames(self, layers: tuple[float, ...], subdivision: int, one_line: bool = False) -> FloatArray:
        """Frames in so many layers and cells; of the mean wavelength alone where that tells enough: few layers then
        leave 1.1 to 1.4 times as much (gift_card, metal_blade, corner, cookie_bag, cards), in a third of the time."""
        settings = replace(self.base, layers=layers, subdivision=subdivision)
        simulation = self.sample.simulation(self.bench, settings, one_line)
        return self._form(simulation, self._path_samples, self.sample.fine, self._sharp)

    def _form(
        self, simulation: Simulation, path_samples: list[PathSamples], samples: int, sharp: Sequence[PathSamples] = ()
    ) -> FloatArray:
        sample, light = self.sample, emission(simulation.physics, self.sample.lighting)
        grids = simulation.grids
        frames = sample.frames(grids["fine"], path_samples, samples, light, self._known)
        return frames + sample.frames(grids["sharp"], sharp, sample.sharp(simulation), light) if sharp else frames


def _product_seconds() -> float:
    """Of a multiplication in products like those of frames, all processors at work: the best of trials, until two in a
    row are no better."""
    matrix, best, last = np.ones((_SIDE, _SIDE)), math.inf, 2
    for trial in range(_MOST_TRIALS):
        started = time.perf_counter()
        in_threads(lambda _: matrix @ matrix, range(_AT_ONCE))
        taken = time.perf_counter() - started
        if taken < _BETTER * best:
            last = trial + 2
        best = min(best, taken)
        if trial >= last:
            break
    return best / (_AT_ONCE * _SIDE**3)


def shown_pixels(settings: Settings, sample: Sample) -> Labels:
    """Projector pixels that the shots of a ``sample`` show, but for those that ``settings`` trace apart."""
    return np.setdiff1d(sample.shown, settings.sharp.pixels) if settings.sharp else sample.shown


def tracer_of(simulation: Simulation, pixels: Labels, anchors: int, spread: bool = False) -> DirectTracer:
    """What traces direct light of some projector pixels.

    Parameters
    ----------
    simulation, pixels
        what is simulated, and the pixels' numbers.
    anchors, spread
        to so many anchors a side, or spread over the sensor.
    """
    return DirectTracer(simulation.setup, anchors, spread, pixels)


# -------- Projector pixels whose light is hidden from part of the sensor

_ANCHORS, SMOOTH = 5, 3
"""Anchors a side that tell where light is rough over the sensor, and how many hold all of what is smooth: what a
polynomial of that many coefficients leaves. Falloff leaves 1e-7 of three (`cards`, `cookie_bag`), an edge a third."""
_FIRST, _NEAR = 2, 16
"""Rays of every pixel, and of each near one that is hidden in part: sixteen meet an edge that crosses a tenth of it
four times in five; of every pixel two do, as an edge crosses many in a row."""
_LEFT = 0.1
"""Part of the accuracy that may stay on the other pixels."""
_MOST = 1 / 16
"""Part of all pixels beyond which light is rough everywhere, which more anchors for all of them serve as well."""


def occluded_pixels(simulation: Simulation, accuracy: float, seed: int) -> tuple[int, ...]:
    """The pixels, increasing, of those that are not traced apart.

    An object's edge hides a pixel's light from a part of the sensor only where its shadow, cast from the sensor, has
    its penumbra: a line of pixels, while all others are smooth over the sensor.

    Parameters
    ----------
    simulation
        the bench.
    accuracy
        relative error asked for.
    seed
        of the rays.
    """
    n, sharp = simulation.bench.n, simulation.settings.sharp
    pixels = np.setdiff1d(np.arange(n**2), sharp.pixels) if sharp else np.arange(n**2)
    rough, whole = _roughness(simulation, pixels, _FIRST, seed)
    rest = (_LEFT * accuracy) ** 2 * whole
    found = pixels[_most(rough, rest)]
    every, looked = np.zeros(n**2), np.zeros(n**2, dtype=bool)
    # Few rays miss what is hidden by a little; it lies beside what is hidden by much.
    while len(near := np.intersect1d(_beside(found, n), pixels[~looked[pixels]])):
        if looked.sum() + len(near) > 9 * _MOST * n**2:
            return ()
        every[near], _ = _roughness(simulation, near, _NEAR, integer(seed, "near", int(looked.sum())))
        looked[near] = True
        found = _most(every, rest)
    return tuple(np.sort(found).tolist()) if len(found) <= _MOST * n**2 else ()


def _beside(found: Labels, n: int) -> Labels:
    """The pixels of ``found`` and their neighbours."""
    chosen = np.zeros(n**2, dtype=bool)
    chosen[found] = True
    return with_neighbours(chosen, n)


def _most(rough: FloatArray, rest: float) -> Labels:
    """Indices of the largest values of ``rough`` whose others sum to no more than the ``rest``."""
    order = np.argsort(-rough, kind="stable")
    left = rough.sum() - np.cumsum(rough[order])
    return order[: int(np.argmax(left <= rest)) + 1] if rough.sum() > rest else order[:0]


def _roughness(simulation: Simulation, pixels: Labels, samples: int, seed: int) -> tuple[FloatArray, float]:
    """(m,) square of what a smooth function of the place on the sensor leaves of each pixel's light, and of all light.

    Parameters
    ----------
    simulation
        the bench.
    pixels
        (m,) of the projector.
    samples
        rays of each.
    seed
        of the rays.
    """
    light = DirectTracer(simulation.setup, _ANCHORS, pixels=pixels).sums(seed, samples) / samples
    # Orthonormal polynomials at Chebyshev's nodes, by degree: the discrete cosine transform.
    angle = (np.arange(_ANCHORS) + 0.5) * np.pi / _ANCHORS
    basis = np.cos(np.outer(np.arange(_ANCHORS), angle)) * np.sqrt(2 / _ANCHORS)
    basis[0] /= np.sqrt(2)
    squares = np.square(basis @ light @ basis.T)
    smooth = squares[:, :SMOOTH, :SMOOTH].sum(axis=(1, 2))
    whole = squares.sum(axis=(1, 2))
    return np.asarray(whole - smooth), float(whole.sum())


# -------- Projector pixels that light sharp lobes

_FEW = 8
"""Anchors a side up to which ordinary light does as well: sharp pixels are traced apart only where that is cheaper."""
_MOST_SHARP = 384
"""Most anchors a side: they follow lobes down to a fiftieth of the sensor's half-width, as matrices of some 100 MiB."""
_LEFT_SHARP = 0.25
"""Part of the accuracy that interpolation between anchors may leave, and pixels that are not traced apart may hold."""
_EVEN = 0.1
"""Variance of an ordinary pixel's connection, relative to its square: print and falloff (photograph: 0.05 to 0.2)."""
_WORTH = 0.5
"""Part of the paths that tracing apart must save before it is done for their sake alone; it costs a pass of its own."""
SHARP_RATE = 0.75
"""Power of the samples that the error falls with, as rays are stratified (flat plates of 1e-3 and 1e-4: 0.7 to 0.9)."""
_WELL_MET = 30.0
"""Hits of one connection of each pixel from which even points meet lobes often enough, where few anchors do: in
compact_disc (125 hits) tracing 600 pixels apart took 1.5 times the time for the same error."""
_SEEN = 0.5
"""Hits of one connection of each pixel from which the pilot's ordinary replicates, 64 connections or more, tell how a
lobe's light varies over the sensor: they meet it thirty times."""
_TRIAL, _LARGEST_TRIAL = 16, 2**21
"""Samples that tell how noisy the light is, and connections of them, some 0.5 s."""
_MOST_CONNECTIONS = 2.0**29
"""Connections, some 100 s, beyond which sharp lobes are left unresolved, and said to be."""
_RAYS_OF_WINDOW = 64
"""Rays of each pixel that tell which directions its light comes from; what they overlook is counted when it is
accumulated."""


def sharp_pixels(
    simulation: Simulation, sharp: SharpLight, light: float, accuracy: float, seed: int
) -> SharpPixels | None:
    """The pixels that are better traced apart, or None.

    A lobe of radius w on a sensor of half-width H is analytic but for poles at w from the sensor, so the interpolation
    between N Chebyshev nodes converges as exp(-N asinh(w / H)) (Trefethen, Approximation Theory, theorem 8.2).

    Parameters
    ----------
    simulation, sharp
        the bench, and what sampling its lobes found.
    light
        all other direct light, mean over the sensor [W m^-2].
    accuracy
        relative error asked for.
    seed
        of the rays that tell where the light comes from.
    """
    if not sharp.irradiance:
        return None
    whole, rate = sharp.irradiance + light, math.asinh(sharp.width / simulation.physics.geometry.half_width)
    anchors = max(2, math.ceil(math.log(1 / (_LEFT_SHARP * accuracy)) / rate))
    if anchors > _MOST_SHARP or (anchors <= _FEW and sharp.hits >= _WELL_MET):
        return None
    order = np.argsort(-sharp.moments, kind="stable")
    lit = min(int(np.count_nonzero(sharp.moments)), len(order) - 1)
    moments = np.cumsum(sharp.moments[order])[:lit]
    paths = _paths(moments, light**2 / len(order) * _EVEN, len(order), anchors)
    if anchors <= _FEW:
        count = max(int(np.argmin(paths[1:])) + 1, _unseen(sharp, order[:lit], _LEFT_SHARP * accuracy * whole))
        if paths[count] > _WORTH * paths[0]:
            return None
    else:
        order = np.argsort(-sharp.by_pixel, kind="stable")
        held = np.cumsum(sharp.by_pixel[order])[:lit]
        count = min(int(np.searchsorted(held, sharp.irradiance - _LEFT_SHARP * accuracy * whole)) + 1, lit)
    # Beside a lobe's light is that of its tails, which ordinary replicates meet as seldom where it is small.
    pixels = with_neighbours(np.isin(np.arange(len(order)), order[:count]), simulation.bench.n)
    # One pixel at least stays with the others.
    if len(pixels) == len(order):
        pixels = np.sort(order[:count])
    left = math.exp(-anchors * rate) * sharp.irradiance / whole
    chosen = SharpPixels(tuple(pixels.tolist()), anchors, _window(simulation, pixels, seed), left)
    return chosen if _connections(simulation, chosen, accuracy, seed) <= _MOST_CONNECTIONS else None


def _unseen(sharp: SharpLight, order: Labels, negligible: float) -> int:
    """Pixels, the first in ``order``, without which the others' light is ``negligible`` or seen by ordinary
    replicates."""
    held, moments = (np.cumsum(values[order][::-1])[::-1] for values in (sharp.by_pixel, sharp.moments))
    settled = (held <= negligible) | (np.square(held) >= _SEEN * moments)
    return int(np.argmax(settled)) if settled.any() else len(order)


def _connections(simulation: Simulation, chosen: SharpPixels, accuracy: float, seed: int) -> float:
    """Connections that light of ``chosen`` pixels takes to be known to the ``accuracy``, by a short trial."""
    if len(chosen.pixels) * chosen.anchors**2 > _MOST_CONNECTIONS:
        return math.inf
    tracer = Simulation(simulation.bench, replace(simulation.settings, sharp=chosen)).sharp
    assert tracer is not None
    samples = min(max(_LARGEST_TRIAL // tracer.paths_per_sample, 2), _TRIAL)
    seen = [tracer.trace(integer(seed, half), 0, samples) for half in range(2)]
    place = [(light.pixel * chosen.anchors + light.anchor_row) * chosen.anchors + light.anchor_column for light in seen]
    every, where = np.unique(np.concatenate(place), return_inverse=True)
    parts = np.split(where, [len(place[0])])
    first, second = (np.bincount(at, light.value, len(every)) for at, light in zip(parts, seen, strict=True))
    energy = float((first * second).sum())
    noise = math.sqrt(float(np.square(first - second).sum()) / 2 / energy) if energy > 0 else math.inf
    return float(tracer.paths_per_sample * samples * (noise / accuracy) ** (1 / SHARP_RATE))


def _paths(moments: FloatArray, even: float, pixels: int, anchors: int) -> FloatArray:
    """(k + 1,) paths for a given error, to a factor, with the first 0..k of ``pixels`` traced apart.

    ``moments`` (k,) are running sums; two kinds of light with variances V and paths P a sample take (sum sqrt(V P))^2.
    """
    count = np.arange(len(moments) + 1)
    apart = np.concatenate([[0.0], moments])
    rest = np.maximum(moments[-1] - apart, 0) + even
    return np.asarray(np.sqrt(rest * (pixels - count)) + np.sqrt(apart * count * anchors**2)) ** 2


def _window(simulation: Simulation, pixels: Labels, seed: int) -> tuple[float, float, float, float]:
    """First and last tan-angle, along rows and along columns, of the surfaces that ``pixels`` light."""
    seen = DirectTracer(simulation.setup, 2, pixels=pixels).trace(seed, 0, _RAYS_OF_WINDOW)
    if not seen.value.size:
        return (0.0, 0.0, 0.0, 0.0)
    return float(seen.row.min()), float(seen.row.max()), float(seen.column.min()), float(seen.column.max())
