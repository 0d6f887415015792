"""Grids that accumulate the light of a bench, and one estimate of the light: a sparse matrix for each grid.

A grid has cells, anchors and layers, and the optics that form frames. Frames are added in the order of :data:`GRIDS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property, reduce
from operator import add
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy import sparse

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import Physics
from mitsim.core.arrays import FloatArray
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.projector import Spectrum
from mitsim.light.settings import Settings
from mitsim.optics.fft_shadow import with_few_cells
from mitsim.optics.image_formation import FrameOptics, anchor_positions, anchor_weights
from mitsim.optics.shadow import Places
from mitsim.transport.records import Bundle, CellGrid, aligned_grid

_AMBIENT_NM, _AMBIENT_BANDS = (400.0, 700.0), 13
"""Range of a camera with a usual filter; a shadow's fringes hardly move over a band of 23 nm."""
_MOST_ROWS = 2**12


class Grid:
    """Cells that accumulate light, with optics for a spectrum (None: a geometric shadow) and some places."""

    def __init__(
        self, bundle: Bundle, geometry: CameraGeometry, spectrum: Spectrum | None, places: Places | None = None
    ) -> None:
        self.bundle, self._geometry, self._spectrum, self._places = bundle, geometry, spectrum, places

    @property
    def key(self) -> tuple[Bundle, CameraGeometry, Spectrum | None, Places | None]:
        return self.bundle, self._geometry, self._spectrum, self._places

    @property
    def of_mean(self) -> Grid:
        return Grid(replace(self.bundle, anchors=1), *self.key[1:])

    @cached_property
    def optics(self) -> FrameOptics:
        bundle = self.bundle
        parts = bundle.rows, bundle.columns, bundle.depths, bundle.anchors
        return FrameOptics(self._geometry, *parts, self._spectrum, self._places)


@dataclass(frozen=True)
class GridRow:
    name: str
    key: str
    bundle: Callable[[Grids], Bundle]
    formed: Callable[[Settings, Physics], bool]
    lamps: bool = False


class Grids:
    """Grids of a bench with settings.

    Parameters
    ----------
    pixels
        Cells along an axis of the projector's window, if not one for each pixel.
    one_line
        Use the light's mean wavelength alone for diffraction: a third of the time where diffraction matters little.
    places
        Rows and columns whose frames are formed; None for all.
    judging_cells
        Cells a side of a projector pixel for indirect light and for what anchors see beyond their mean, by which the
        pilot judges those of a run; 0 for those of a run.
    """

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
        counted_lamps = self._counted_lamps
        return self._of_lamps(counted_lamps.whole if counted_lamps else _bands(*_AMBIENT_NM, _AMBIENT_BANDS))

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
        """Largest tan-angle from the sensor's centre that the sensor's edge sees at the light's depth."""
        return self.physics.geometry.reach(self.settings.depth)

    def cells(self, subdivision: int = 1, width: int = 1, reach: float | None = None) -> CellGrid:
        """Return the cells that the sensor's edge sees through the field stop, or to the tan-angle `reach`."""
        depth, farthest = self.settings.depth, max(self.reach, reach or 0.0)
        return aligned_grid(*self.bench.windows_at(depth), -(-self._pixels // width), subdivision, farthest)

    def mean_weights(self, anchors: int) -> FloatArray:
        """Return the weight (anchors,) of each anchor in the mean over the sensor."""
        edges = self.physics.geometry.pixel_edges
        positions = anchor_positions(anchors, self.physics.geometry.half_width)
        return np.asarray(anchor_weights(positions, (edges[:-1] + edges[1:]) / 2).mean(axis=0))


# -------- The table


def _fine(made: Grids) -> Bundle:
    settings = made.settings
    return Bundle(made.cells(settings.subdivision, reach=settings.reach), 1, settings.depths, lamps=made.lamp_rows)


def _coarse(made: Grids, anchors: int, width: int = 1) -> Bundle:
    """Return cells of coarse light, or cells of several pixels in one layer; the pilot judges by cells of its own."""
    settings, wide = made.settings, width > 1 and not made.judging_cells
    depths = settings.depths if settings.coarse_layers and not wide else (settings.depth,)
    cells = 1 if wide else made.judging_cells or settings.coarse_cells
    return Bundle(made.cells(cells, width if wide else 1, settings.reach), anchors, depths, lamps=made.lamp_rows)


def _sharp(made: Grids) -> Bundle:
    settings, sharp = made.settings, made.settings.sharp
    if sharp is None:
        return Bundle(made.aim, 1, (settings.depth,), lamps=made.lamp_rows)

    def part(subdivision: int) -> CellGrid:
        whole, window = made.cells(subdivision, reach=settings.reach), sharp.window
        return CellGrid(whole.rows.part(*window[:2]), whole.columns.part(*window[2:]))

    most = max(1, _MOST_ROWS // (sharp.anchors * max(part(1).shape)))
    cells = part(min(settings.subdivision, most))
    return Bundle(cells, sharp.anchors, settings.depths, between=True, lamps=made.lamp_rows)


_ROWS = (
    # What the sensor sees on average of direct light, caustics and lamps.
    GridRow("fine", "fine", _fine, lambda settings, physics: True, lamps=True),
    # What each anchor sees of direct light beyond that; and of light that is hidden from part of the sensor.
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
GRIDS: Mapping[str, GridRow] = MappingProxyType({row.name: row for row in _ROWS})


def _bands(low_nm: float, high_nm: float, count: int) -> Spectrum:
    edges = np.linspace(low_nm, high_nm, count + 1)
    return Spectrum((edges[:-1] + edges[1:]) / 2, np.full(count, 1 / count))


# -------- One estimate of the light

MEAN_GRIDS = ("fine", "indirect")


@dataclass(frozen=True, eq=False)
class LightEstimate:
    """Light by grid, (classes + 1, places) each [W m^-2]; the last row, or one for each band, is ambient light.

    Attributes
    ----------
    received, outside
        Mean of all light over the sensor without its mask, and the part beyond all cells, which is in no frame [W
        m^-2].
    flux
        (n^2,) mean irradiance of each projector pixel's direct light without the mask [W m^-2], if measured.
    """

    light: Mapping[str, sparse.csr_array]
    received: float = 0.0
    outside: float = 0.0
    flux: FloatArray | None = None

    def __getitem__(self, grid: str) -> sparse.csr_array:
        return self.light[grid]

    def __add__(self, other: LightEstimate) -> LightEstimate:
        return LightEstimate(*(_sum(getattr(self, each.name), getattr(other, each.name)) for each in fields(self)))

    def __truediv__(self, count: float) -> LightEstimate:
        return LightEstimate(*(_divide(getattr(self, each.name), count) for each in fields(self)))

    def with_light(self, light: Mapping[str, sparse.csr_array]) -> LightEstimate:
        return replace(self, light={**self.light, **light})

    @property
    def rows(self) -> int:
        return int(self.light[MEAN_GRIDS[0]].shape[0])

    @property
    def totals(self) -> FloatArray:
        return np.asarray(reduce(add, (self.light[grid].sum(axis=1) for grid in MEAN_GRIDS)), dtype=np.float64)


def _sum(one: Any, other: Any) -> Any:
    if one is None or other is None:
        return one if other is None else other
    if isinstance(one, Mapping):
        return {name: _sum(light, other[name]) for name, light in one.items()}
    if not isinstance(one, sparse.csr_array) or (one.nnz and other.nnz):
        return one + other
    return one if one.nnz else other


def _divide(light: Any, count: float) -> Any:
    if light is None:
        return None
    if isinstance(light, Mapping):
        return {name: _divide(each, count) for name, each in light.items()}
    if not isinstance(light, sparse.csr_array):
        return light / count
    return sparse.csr_array((light.data * (1 / count), light.indices, light.indptr), shape=light.shape)
