"""Grids that accumulate light, and passes that trace it: for each pass its tracer, its grid and its cost.

A grid has cells, anchors, layers and optics; frames are added in the order of :data:`GRIDS`. A new pass is a row of
:data:`PASSES`, which all code that enumerates light reads, and its tracer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from operator import add
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from scipy import sparse

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import Physics, names
from mitsim.core.arrays import FloatArray, Labels
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.patterns import Lighting
from mitsim.devices.projector import Spectrum
from mitsim.light.settings import PATHS_AT_ONCE, Number, Settings
from mitsim.optics.fft_shadow import with_few_cells
from mitsim.optics.frames import AccumulatedLight, ClassFrames, ExpectedFrames
from mitsim.optics.image_formation import FrameOptics, anchor_positions, anchor_weights
from mitsim.optics.shadow import Places
from mitsim.transport.connect import OpticalSetup, SensorPoints
from mitsim.transport.direct import AimedTracer, DirectTracer
from mitsim.transport.from_camera import CombinedTracer, FromCameraTracer, LampTracer
from mitsim.transport.integrator import IndirectTracer, Paths
from mitsim.transport.path_reuse import PathReuseTracer
from mitsim.transport.records import (
    DIRECT,
    INDIRECT,
    Bundle,
    CellGrid,
    DeviceAccumulator,
    DeviceSums,
    PathSamples,
    aligned_grid,
)

# -------- Grids

_AMBIENT_NM, _AMBIENT_BANDS = (400.0, 700.0), 13
"""Range of a camera with a usual filter; a shadow's fringes hardly move over a band of 23 nm."""
_MOST_ROWS = 2**12


@dataclass(frozen=True, eq=False)
class Grid:
    bundle: Bundle
    geometry: CameraGeometry
    spectrum: Spectrum | None
    places: Places | None = None

    @property
    def key(self) -> tuple[Bundle, CameraGeometry, Spectrum | None, Places | None]:
        return self.bundle, self.geometry, self.spectrum, self.places

    @cached_property
    def optics(self) -> FrameOptics:
        parts = *self.bundle.directions, self.bundle.depths, self.bundle.anchors
        return FrameOptics(self.geometry, *parts, self.spectrum, self.places)


@dataclass(frozen=True)
class GridRow:
    name: str
    key: str
    bundle: Callable[[Simulation], Bundle]
    formed: Callable[[Settings, Physics], bool]
    lamps: bool = False


# -------- The table of grids


def _fine(made: Simulation) -> Bundle:
    settings = made.settings
    return Bundle(made.cells(settings.subdivision, reach=settings.reach), 1, settings.depths, lamps=made.lamp_rows)


def _coarse(made: Simulation, anchors: int, width: int = 1) -> Bundle:
    settings, wide = made.settings, width > 1 and not made.judging_cells
    depths = settings.depths if settings.coarse_layers and not wide else (settings.depth,)
    cells = 1 if wide else made.judging_cells or settings.coarse_cells
    return Bundle(made.cells(cells, width if wide else 1, settings.reach), anchors, depths, lamps=made.lamp_rows)


def _sharp(made: Simulation) -> Bundle:
    settings, sharp = made.settings, made.settings.sharp
    if sharp is None:
        return Bundle(made.aim, 1, (settings.depth,), lamps=made.lamp_rows)

    def part(subdivision: int) -> CellGrid:
        whole, window = made.cells(subdivision, reach=settings.reach), sharp.window
        return CellGrid(whole.rows.part(*window[:2]), whole.columns.part(*window[2:]))

    most = max(1, _MOST_ROWS // (sharp.anchors * max(part(1).shape)))
    cells = part(min(settings.subdivision, most))
    return Bundle(cells, sharp.anchors, settings.depths, between=True, lamps=made.lamp_rows)


_GRID_ROWS = (
    # Mean over the sensor of direct light, caustics and lamps.
    GridRow("fine", "fine", _fine, lambda settings, physics: True, lamps=True),
    # Direct light at each anchor beyond that mean, and light that is hidden from part of the sensor.
    GridRow("anchor_residual", "coarse", lambda made: _coarse(made, made.settings.anchors),
            lambda settings, physics: settings.anchors > 1),
    GridRow("penumbra", "occluded", lambda made: _coarse(made, made.settings.occluded_anchors),
            lambda settings, physics: bool(settings.with_own_anchors)),
    # Direct light over sharp lobes, of the pixels that are traced apart.
    GridRow("sharp", "sharp", _sharp, lambda settings, physics: settings.sharp is not None),
    # What each anchor sees of light over several surfaces, mirrors' and lamps' beyond its mean; and that mean, of light
    # over several surfaces: smooth or small, so coarse cells hold them well.
    GridRow("indirect_residual", "followed",
            lambda made: _coarse(made, made.settings.followed_anchors, made.settings.followed_width),
            lambda settings, physics: settings.followed_anchors > 1, lamps=True),
    GridRow("indirect", "smooth", lambda made: _coarse(made, 1), lambda settings, physics: physics.interreflection),
)  # fmt: skip
GRIDS: Mapping[str, GridRow] = MappingProxyType({row.name: row for row in _GRID_ROWS})


# -------- One estimate of the light

MEAN_GRIDS = ("fine", "indirect")


@dataclass(frozen=True, eq=False)
class LightEstimate:
    """Light by grid, (classes + 1, places) each [W m^-2]; the last row, or one for each band, is ambient light.

    ``received`` is the mean over the sensor without its mask, ``outside`` the part beyond all cells, which is in no
    frame.
    """

    light: Mapping[str, sparse.csr_array]
    received: float = 0.0
    outside: float = 0.0
    flux: FloatArray | None = None

    def __getitem__(self, grid: str) -> sparse.csr_array:
        return self.light[grid]

    def __add__(self, other: LightEstimate) -> LightEstimate:
        light = dict(self.light)
        for name, more in other.light.items():
            if more.nnz:
                light[name] = light[name] + more if light[name].nnz else more
        flux = self.flux if other.flux is None else other.flux if self.flux is None else self.flux + other.flux
        return LightEstimate(light, self.received + other.received, self.outside + other.outside, flux)

    def __truediv__(self, count: float) -> LightEstimate:
        light = {
            name: sparse.csr_array((each.data * (1 / count), each.indices, each.indptr), shape=each.shape)
            for name, each in self.light.items()
        }
        flux = None if self.flux is None else self.flux / count
        return LightEstimate(light, self.received / count, self.outside / count, flux)

    def with_light(self, light: Mapping[str, sparse.csr_array]) -> LightEstimate:
        return replace(self, light={**self.light, **light})

    @property
    def rows(self) -> int:
        return int(self.light[MEAN_GRIDS[0]].shape[0])

    @property
    def totals(self) -> FloatArray:
        return np.asarray(reduce(add, (self.light[grid].sum(axis=1) for grid in MEAN_GRIDS)), dtype=np.float64)


# -------- The table of passes

FromCamera = FromCameraTracer | CombinedTracer
PassTracer = DirectTracer | IndirectTracer | FromCamera

FOLLOWED = names(lambda effect: effect.followed)
"""Effects whose light is followed over several surfaces or from the camera."""


@dataclass(frozen=True)
class Pass:
    """Row of the table of passes.

    Attributes
    ----------
    stream
        Name of the random stream, which never changes, so that the same seed gives the same frames.
    unit_cost
        Time of a path, or of a connection to one anchor [s].
    anchors
        Setting that counts its anchors. The pass then accumulates the residual over their mean.
    effects
        Effects of which one requires the pass; empty if always traced.
    even
        True if samples are points of a Sobol sequence alone, so that their number matters.
    variance_rate
        Power of the samples with which the variance falls.
    device
        ``room`` to add light on the device if the sums fit, ``pays`` if it also saves time; None for the host.
    """

    name: str
    stream: str
    tracer: Callable[[Simulation], PassTracer | None]
    unit_cost: float
    grid: str
    indirect_grid: str = ""
    anchors: str = ""
    effects: frozenset[str] = frozenset()
    even: bool = False
    variance_rate: float = 1.0
    flux: bool = False
    device: Literal["", "room", "pays"] = ""
    pilot: str = "effects"
    key: str = ""

    @property
    def grids(self) -> tuple[str, ...]:
        return tuple(filter(None, (self.grid, self.indirect_grid)))

    def called_for(self, effects: frozenset[str]) -> bool:
        return not self.effects or bool(self.effects & effects)

    def predicted_samples(self, settings: Settings) -> float:
        return settings.samples.get(self.name, 1.0)

    def whole(self, samples: Number) -> Number:
        least = np.maximum(samples, 1.0)
        return even(least) if self.even else np.ceil(least)

    def connections(self, counts: object) -> Number:
        if not self.anchors:
            return 1.0
        count = np.asarray(getattr(counts, self.anchors), dtype=np.float64)
        return np.asarray(count**2 * (count > 1))


def even(samples: Number) -> Number:
    """Return the next 2^k or 3 * 2^k, because so many points of a Sobol sequence are evenly spread."""
    power = np.exp2(np.floor(np.log2(np.maximum(samples, 1.0))))
    found = np.where(samples <= power, power, np.where((samples <= 1.5 * power) & (power > 1), 1.5 * power, 2 * power))
    return found if isinstance(samples, np.ndarray) else float(found)


_ROWS = (
    Pass("direct", "direct", lambda made: made.direct, 1.8e-7, "fine",
         even=True, variance_rate=1.5, flux=True, pilot="cells"),
    Pass("anchor_residual", "anchored", lambda made: made.anchored, 1.6e-7, "anchor_residual",
         even=True, anchors="anchors", device="pays", pilot="anchors", key="anchored"),
    Pass("penumbra", "occluded", lambda made: made.anchored_occluded, 5e-7, "penumbra",
         even=True, anchors="occluded_anchors", pilot="occluded", key="occluded"),
    Pass("sharp", "sharp", lambda made: made.sharp, 3e-7, "sharp",
         even=True, flux=True, device="pays"),
    Pass("indirect", "indirect", lambda made: made.indirect, 1.2e-7, "fine", "indirect",
         effects=FOLLOWED, device="room"),
    Pass("from_camera", "other", lambda made: made.from_camera, 2e-7, "fine", "indirect",
         effects=FOLLOWED),
    Pass("indirect_residual", "indirect at anchors", lambda made: made.at_anchors[0], 1.3e-7, "indirect_residual",
         effects=FOLLOWED, anchors="followed_anchors", device="room", pilot="followed", key="followed"),
    Pass("camera_residual", "from camera at anchors", lambda made: made.at_anchors[1], 1.3e-7, "indirect_residual",
         effects=FOLLOWED, anchors="followed_anchors", pilot="followed", key="followed_from_camera"),
    Pass("glare", "glare", lambda made: made.glare, 3e-7, "fine", "indirect",
         effects=frozenset({"glare"})),
)  # fmt: skip
"""Frames are added in this order. Unit costs are near the times of eight shipped scenes on two cores; only their ratios
matter."""


def table_of(*rows: Pass) -> Mapping[str, Pass]:
    for what in ("name", "stream"):
        values = [getattr(row, what) for row in rows]
        twice = next((value for value in values if values.count(value) > 1), None)
        if twice is not None:
            raise ValueError(f"two passes have the {what} {twice!r}")
    return MappingProxyType({row.name: row for row in rows})


PASSES = table_of(*_ROWS)
EVEN = frozenset(row.name for row in PASSES.values() if row.even)


# -------- A bench under one choice of settings: its passes are traced, their light accumulated, and frames formed
#
# An effect that is off takes its neutral value here: a pinhole for the lens, a thin mask, a geometric shadow.

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


class Simulation:
    """Grids and tracers of a bench with settings.

    ``one_line`` uses the mean wavelength alone for diffraction, in a third of the time. ``judging_cells`` a side of a
    projector pixel judge the coarse cells of a run in the pilot. ``divides`` divides light that shading normals make
    heavy between both sides; it is off for a short pilot.
    """

    divides = True
    settings: Settings

    def __init__(
        self,
        bench: Apparatus,
        settings: Settings,
        pixels: int | None = None,
        one_line: bool = False,
        places: Places | None = None,
        judging_cells: int = 0,
    ) -> None:
        self.bench, self.settings, self.places = bench, settings, places
        self.judging_cells = judging_cells
        self.physics = Physics.with_effects(bench, settings.effects)
        if settings.raster:
            by_fft = self.physics.geometry.model_copy(update={"mask_fft": True, "mask_cells": settings.raster_cells})
            self.physics = replace(self.physics, geometry=by_fft)
        if one_line and self.physics.spectrum:
            self.physics = replace(self.physics, spectrum=self.physics.spectrum.mean)
        if one_line:
            self.physics = replace(self.physics, geometry=with_few_cells(self.physics.geometry, self.physics.spectrum))
        self._pixels = pixels or bench.n
        self._counted_lamps = counted_lamps = bench.counted_lamps if self.physics.lamps else None
        self.lamp_rows = len(counted_lamps.bands) if counted_lamps else 1
        # The sensor's centre sees nothing beyond the field stop, so near surfaces ask for no more directions.
        self.aim = self.cells(1, reach=None)
        self.grids = {row.name: self._grid(row) for row in GRIDS.values()}

    @cached_property
    def ambient(self) -> Mapping[str, Grid]:
        if self._counted_lamps:
            return self._of_lamps(self._counted_lamps.whole)
        edges = np.linspace(*_AMBIENT_NM, _AMBIENT_BANDS + 1)
        return self._of_lamps(Spectrum((edges[:-1] + edges[1:]) / 2, np.full(_AMBIENT_BANDS, 1 / _AMBIENT_BANDS)))

    @cached_property
    def by_band(self) -> tuple[Mapping[str, Grid], ...]:
        bands = self._counted_lamps.spectra if self._counted_lamps else ()
        return tuple(map(self._of_lamps, bands)) or (self.ambient,)

    def _of_lamps(self, light: Spectrum) -> Mapping[str, Grid]:
        return {row.name: self._grid(row, light) for row in GRIDS.values() if row.lamps}

    def _grid(self, row: GridRow, light: Spectrum | None = None) -> Grid:
        spectrum = self.physics.spectrum
        return Grid(row.bundle(self), self.physics.geometry, (light or spectrum) if spectrum else None, self.places)

    @property
    def reach(self) -> float:
        return self.physics.geometry.reach(self.settings.depth)

    def cells(self, subdivision: int = 1, width: int = 1, reach: float | None = None) -> CellGrid:
        depth, farthest = self.settings.depth, max(self.reach, reach or 0.0)
        return aligned_grid(*self.bench.windows_at(depth), -(-self._pixels // width), subdivision, farthest)

    def mean_weights(self, anchors: int) -> FloatArray:
        edges = self.physics.geometry.pixel_edges
        positions = anchor_positions(anchors, self.physics.geometry.half_width)
        return np.asarray(anchor_weights(positions, (edges[:-1] + edges[1:]) / 2).mean(axis=0))

    @cached_property
    def setup(self) -> OpticalSetup:
        return replace(self.bench.setup, projector=self.physics.projector, geometry=self.physics.geometry)

    # ---- Direct light

    @cached_property
    def direct(self) -> DirectTracer:
        return self._direct(1, spread=self.settings.anchors > 1)

    @property
    def spread(self) -> DirectTracer:
        return self._direct(1, spread=True)

    @cached_property
    def anchored(self) -> DirectTracer | None:
        settings = self.settings
        return self._direct(settings.anchors, settings.with_own_anchors) if settings.anchors > 1 else None

    @cached_property
    def anchored_occluded(self) -> DirectTracer | None:
        settings = self.settings
        others = np.setdiff1d(np.arange(self.bench.n**2), settings.with_own_anchors)
        return self._direct(settings.occluded_anchors, others) if settings.with_own_anchors else None

    @cached_property
    def sharp(self) -> AimedTracer | None:
        sharp = self.settings.sharp
        return AimedTracer(self.setup, sharp.anchors, np.array(sharp.pixels)) if sharp else None

    def _direct(self, anchors: int, without: Labels | tuple[int, ...] = (), spread: bool = False) -> DirectTracer:
        sharp = self.settings.sharp
        absent = np.union1d(without, sharp.pixels if sharp else ()).astype(np.int64)
        pixels = np.setdiff1d(np.arange(self.bench.n**2), absent) if len(absent) else None
        return DirectTracer(self.setup, anchors, spread, pixels)

    # ---- Light that is followed further

    @cached_property
    def indirect(self) -> IndirectTracer | None:
        tracer, repeats = self._indirect(self._mean_points, self.settings.shared), self.settings.repeats
        return tracer.with_adaptive_counts(repeats) if tracer and repeats else tracer

    @cached_property
    def from_camera(self) -> FromCamera | None:
        return self._from_camera(self._mean_points)

    @cached_property
    def at_anchors(self) -> tuple[IndirectTracer | None, FromCamera | None]:
        points = self._points(self.settings.followed_anchors)
        return self._indirect(points), self._from_camera(points)

    # ---- Light that the projector's lens scatters

    @cached_property
    def glare(self) -> CombinedTracer | None:
        scattered = replace(self.setup, projector=self.setup.projector.scattered)
        if scattered.projector.share == 0:
            return None
        direct = DirectTracer(scattered, 1, self.settings.anchors > 1)
        indirect = self._indirect(self._mean_points, setup=scattered)
        return CombinedTracer(*filter(None, (direct, indirect)))

    @property
    def _mean_points(self) -> SensorPoints:
        return self._points(1, self.settings.followed_anchors > 1)

    @property
    def from_camera_of_projector(self) -> bool:
        return self.physics.mirrors or (self.physics.interreflection and self.bench.loaded.glossy) or self._steep

    @property
    def _steep(self) -> bool:
        loaded = self.bench.loaded
        return self.physics.interreflection and ((self.divides and loaded.smoothed) or loaded.hairy)

    def _points(self, anchors: int, spread: bool = False) -> SensorPoints:
        return SensorPoints(self.physics.geometry.half_width, anchors, spread, self.settings.depth)

    def _indirect(
        self, points: SensorPoints, shared: bool = False, setup: OpticalSetup | None = None
    ) -> IndirectTracer | None:
        # Light that the lens scatters is followed from the projector alone.
        paths = Paths(self.physics.mirrors, self.physics.interreflection, steep=self._steep and setup is None)
        if not (paths.mirrors or paths.interreflection):
            return None
        return (PathReuseTracer if shared else IndirectTracer)(setup or self.setup, paths, points)

    def _from_camera(self, points: SensorPoints) -> FromCamera | None:
        physics, counted_lamps = self.physics, self.bench.counted_lamps
        of_projector = self.from_camera_of_projector
        if not (physics.lamps or of_projector):
            return None
        paths = Paths(physics.mirrors, physics.interreflection, physics.lamps, self._steep)
        tracer = FromCameraTracer(self.setup, self.aim, paths, points)
        if counted_lamps is None or not physics.lamps:
            return tracer
        # Lamps have wavelengths of their own, and filters of each colour count them on their own.
        units = counted_lamps.units_of(self.bench.projector.lines)
        lamps: list[FromCameraTracer] = []
        for number, response in enumerate(counted_lamps.responses):
            rows = counted_lamps.rows(number)
            own = [unit * response.part for unit in units]
            lamps.append(LampTracer(tracer, response, counted_lamps.bands[rows], own, rows.start))
        if of_projector:
            lamps.insert(0, FromCameraTracer(self.setup, self.aim, replace(paths, emitters=()), points))
        return lamps[0] if len(lamps) == 1 else CombinedTracer(*lamps)

    # ---- Passes

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
