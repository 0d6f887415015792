"""Light of a bench under one choice of settings, from deposits of tracers to sparse matrices, with the
optics that form their frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse

from mitsim.capture.bench import Bench
from mitsim.capture.effects import Physics
from mitsim.capture.evidence import Settings
from mitsim.core.arrays import FloatArray, Labels
from mitsim.optics.anchors import anchor_positions, anchor_weights
from mitsim.optics.closed_form import FrameOptics
from mitsim.optics.frames import Filed
from mitsim.optics.shadow import Places
from mitsim.rig.camera import CameraGeometry
from mitsim.rig.projector import Spectrum
from mitsim.transport.cells import CellGrid, aligned_grid
from mitsim.transport.histogram import DIRECT, INDIRECT, Bundle, Deposits
from mitsim.transport.ledger import Ledger, LitSums

_AMBIENT_NM, _AMBIENT_BANDS = (400.0, 700.0), 13
"""Ambient light: a flat spectrum of photons over what a camera with a usual filter sees, in bands of 23 nm, over which
a shadow's fringes hardly move."""
TRAYS = ("fine", "coarse", "occluded", "smooth", "followed", "sharp")
"""Parts of an :class:`FiledLight`."""
_MOST_ROWS = 2**12
"""Rows of anchors times cells of sharp light: a class that lights them all is a matrix of 128 MiB."""


@dataclass(frozen=True, eq=False)
class FiledLight:
    """One estimate of the light of a scene, (classes + 1, places) each, the last row ambient light [W m^-2], or one of
    the last for each band of its wavelengths.

    ``fine`` is what the sensor sees on average, in fine cells and layers; ``coarse`` is what each anchor sees of direct
    light beyond that, ``occluded`` the same of occluded pixels, which have more anchors; ``smooth`` is indirect light,
    and ``followed`` what each anchor sees of followed light beyond its average: small or smooth, so coarse cells hold
    them well. ``sharp`` is direct light of the pixels that are traced apart. Of all light ``received``, a mean over the
    sensor without its mask, ``outside`` came from beyond all cells: it is in no frame.
    """

    fine: sparse.csr_array
    coarse: sparse.csr_array
    occluded: sparse.csr_array
    smooth: sparse.csr_array
    followed: sparse.csr_array
    sharp: sparse.csr_array
    received: float = 0.0
    outside: float = 0.0

    def __add__(self, other: FiledLight) -> FiledLight:
        return FiledLight(*(_sum(getattr(self, field.name), getattr(other, field.name)) for field in fields(self)))

    def __truediv__(self, count: float) -> FiledLight:
        return FiledLight(*(_divided(getattr(self, field.name), count) for field in fields(self)))

    @property
    def totals(self) -> FloatArray:
        """(rows,) light of each row, a mean over the sensor, but for pixels that are traced apart [W m^-2]."""
        return np.asarray(self.fine.sum(axis=1) + self.smooth.sum(axis=1), dtype=np.float64)


def _sum(one: Any, other: Any) -> Any:
    """Of numbers or matrices; a matrix to which nothing is added is not copied."""
    if not isinstance(one, sparse.csr_array) or (one.nnz and other.nnz):
        return one + other
    return one if one.nnz else other


def _divided(light: Any, count: float) -> Any:
    """A number or a matrix over ``count``; SciPy would copy where a matrix has its light, which lines may share."""
    if not isinstance(light, sparse.csr_array):
        return light / count
    return sparse.csr_array((light.data * (1 / count), light.indices, light.indptr), shape=light.shape)


class Tray:
    """Cells that light is filed in, and the optics that form its frames; the optics are prepared on first use.

    Parameters
    ----------
    bundle
        cells, anchors and layers.
    geometry
        the camera.
    spectrum
        light whose diffraction is simulated; None: the mask's shadow is geometric.
    places
        rows and columns whose frames are formed; None: all.
    """

    def __init__(
        self,
        bundle: Bundle,
        geometry: CameraGeometry,
        spectrum: Spectrum | None,
        places: Places | None = None,
    ) -> None:
        self.bundle, self._geometry, self._spectrum, self._places = bundle, geometry, spectrum, places

    @property
    def key(self) -> tuple[Bundle, CameraGeometry, Spectrum | None, Places | None]:
        """Equal for trays that form the same light alike."""
        return self.bundle, self._geometry, self._spectrum, self._places

    @property
    def of_mean(self) -> Tray:
        """The same cells for what the sensor sees on average: with one anchor."""
        return Tray(replace(self.bundle, anchors=1), *self.key[1:])

    @cached_property
    def optics(self) -> FrameOptics:
        """From light in these cells to frames."""
        bundle = self.bundle
        parts = bundle.rows, bundle.columns, bundle.depths, bundle.anchors
        return FrameOptics(self._geometry, *parts, self._spectrum, self._places)

    def file(self, deposits: Deposits, labels: Labels, samples: int) -> sparse.csr_array:
        """(rows, places) light per sample: classes, and lamps.

        Parameters
        ----------
        deposits
            of a tracer.
        labels
            (n^2,) class of each projector pixel.
        samples
            that were traced.
        """
        return self.bundle.file(deposits, labels, samples)


class Trays:
    """What light of a bench with settings is filed in; optics are prepared when they are first asked for.

    Parameters
    ----------
    bench, settings
        what is simulated, and how finely.
    pixels
        cells a side of the projector's window, instead of one a pixel.
    one_line
        whether diffraction is that of the light's mean wavelength alone: for what hardly hangs on it, in a third of the
        time.
    places
        rows and columns whose frames are formed; None: all.

    Attributes
    ----------
    physics
        what is simulated of the bench.
    fine, coarse, occluded, smooth, followed, sharp
        trays for the parts of an :class:`FiledLight`; ``ambient`` and ``followed_ambient`` for all light of lamps in
        the cells of ``fine`` and of ``followed``.
    by_band
        of each row of lamps' light, such a pair of trays.
    """

    def __init__(
        self,
        bench: Bench,
        settings: Settings,
        pixels: int | None = None,
        one_line: bool = False,
        places: Places | None = None,
    ) -> None:
        self.bench, self.settings, self.places = bench, settings, places
        self.physics = Physics.simulated(bench, settings.effects)
        if settings.raster:
            by_fft = self.physics.geometry.model_copy(update={"mask_fft": True, "mask_cells": settings.raster_cells})
            self.physics = replace(self.physics, geometry=by_fft)
        if one_line and self.physics.spectrum:
            self.physics = replace(self.physics, spectrum=self.physics.spectrum.mean)
        pixels = pixels or bench.n
        lamplight = bench.lamplight if self.physics.lamps else None
        self._lamp_rows = len(lamplight.bands) if lamplight else 1
        # The sensor's centre sees nothing beyond the field stop, so near surfaces ask for no more directions.
        self.aim = self._grid(pixels, 1, None)
        fine = self._bundle(self._grid(pixels, settings.subdivision, settings.reach), 1, settings.depths)
        depths = settings.depths if settings.coarse_layers else (settings.depth,)
        coarse = self._grid(pixels, settings.coarse_cells, settings.reach)
        self.fine = self._tray(fine)
        self.coarse = self._tray(self._bundle(coarse, settings.anchors, depths))
        self.occluded = self._tray(self._bundle(coarse, settings.occluded_anchors, depths))
        self.smooth = self._tray(self._bundle(coarse, 1, depths))
        wide = self._grid(-(-pixels // settings.followed_width), 1, settings.reach)
        broad = (wide, (settings.depth,)) if settings.followed_width > 1 else (coarse, depths)
        several = self._bundle(broad[0], settings.followed_anchors, broad[1])
        self.followed = self._tray(several)
        self.sharp = self._tray(self._apart(pixels))
        whole = lamplight.whole if lamplight else _bands(*_AMBIENT_NM, _AMBIENT_BANDS)

        def pair(spectrum: Spectrum) -> tuple[Tray, Tray]:
            return self._tray(fine, spectrum), self._tray(several, spectrum)

        self.ambient, self.followed_ambient = pair(whole)
        bands = lamplight.spectra if lamplight else ()
        self.by_band = tuple(map(pair, bands)) or ((self.ambient, self.followed_ambient),)

    def _bundle(self, grid: CellGrid, anchors: int, depths: tuple[float, ...]) -> Bundle:
        return Bundle(grid, anchors, depths, lamps=self._lamp_rows)

    def _tray(self, bundle: Bundle, light: Spectrum | None = None) -> Tray:
        """``light`` None: the projector's. All light diffracts or none."""
        spectrum = self.physics.spectrum
        return Tray(bundle, self.physics.geometry, (light or spectrum) if spectrum else None, self.places)

    @property
    def reach(self) -> float:
        """Largest tan-angle, from the sensor's centre, of what its edge sees at the light's depth."""
        return self.physics.geometry.reach(self.settings.depth)

    def _grid(self, pixels: int, subdivision: int, reach: float | None) -> CellGrid:
        """Cells as far as the sensor's edge sees through the field stop, or to ``reach`` if that is farther.

        The same for any number of anchors and layers, so that their light can be compared.
        """
        depth, reach = self.settings.depth, max(self.reach, reach or 0.0)
        return aligned_grid(*self.bench.windows_at(depth), pixels, subdivision, reach)

    def _apart(self, pixels: int) -> Bundle:
        """Cells of the sharp pixels' light: their part of the fine ones, or coarser where the anchors are too many."""
        settings, sharp = self.settings, self.settings.sharp
        if sharp is None:
            return self._bundle(self._grid(pixels, 1, None), 1, (settings.depth,))

        def part(subdivision: int) -> CellGrid:
            whole, window = self._grid(pixels, subdivision, settings.reach), sharp.window
            return CellGrid(whole.rows.part(*window[:2]), whole.columns.part(*window[2:]))

        most = max(1, _MOST_ROWS // (sharp.anchors * max(part(1).shape)))
        fewer = self._bundle(part(min(settings.subdivision, most)), sharp.anchors, settings.depths)
        return replace(fewer, between=True)

    @cached_property
    def sharp_weights(self) -> FloatArray:
        """(anchors,) weight of each of the sharp pixels' anchors in the mean over the sensor."""
        return self.mean_weights(self.sharp.bundle.anchors)

    def mean_weights(self, anchors: int) -> FloatArray:
        """(anchors,) weight of each of so many ``anchors`` in the mean over the sensor."""
        edges = self.physics.geometry.pixel_edges
        positions = anchor_positions(anchors, self.physics.geometry.half_width)
        return np.asarray(anchor_weights(positions, (edges[:-1] + edges[1:]) / 2).mean(axis=0))

    def file_direct(self, deposits: Deposits, labels: Labels, samples: int) -> FiledLight:
        """Light of :attr:`direct`, per sample.

        Parameters
        ----------
        deposits, labels, samples
            as for :meth:`Tray.file`.
        """
        return self._light(deposits, samples, fine=self.fine.file(deposits, labels, samples))

    def file_anchored(self, deposits: Deposits, labels: Labels, samples: int) -> FiledLight:
        """Light of :attr:`anchored` beyond its mean over the sensor, per sample.

        Parameters
        ----------
        deposits, labels, samples
            as for :meth:`Tray.file`.
        """
        return self._light(None, 1, coarse=self._beyond_mean(self.coarse, deposits, labels, samples))

    def file_occluded(self, deposits: Deposits, labels: Labels, samples: int) -> FiledLight:
        """Light of :attr:`anchored_occluded` beyond its mean over the sensor, per sample.

        Parameters
        ----------
        deposits, labels, samples
            as for :meth:`Tray.file`.
        """
        return self._light(None, 1, occluded=self._beyond_mean(self.occluded, deposits, labels, samples))

    def file_at_anchors(self, deposits: Deposits, labels: Labels, samples: int) -> FiledLight:
        """Light of :attr:`at_anchors` beyond its mean over the sensor, per sample.

        Parameters
        ----------
        deposits, labels, samples
            as for :meth:`Tray.file`.
        """
        return self._light(None, 1, followed=self._beyond_mean(self.followed, deposits, labels, samples))

    def _beyond_mean(self, tray: Tray, deposits: Deposits, labels: Labels, samples: int) -> sparse.csr_array:
        """Light in a ``tray`` beyond its mean over the sensor."""
        return self._less_mean(tray.bundle, tray.file(deposits, labels, samples))

    def _less_mean(self, bundle: Bundle, light: sparse.csr_array) -> sparse.csr_array:
        """``light`` that was filed by a ``bundle``, beyond its mean over the sensor."""
        return light - bundle.repeated(bundle.averaged(light, self.mean_weights(bundle.anchors)))

    def file_followed(self, deposits: Deposits, labels: Labels, samples: int) -> FiledLight:
        """Light of :attr:`indirect` or :attr:`from_camera`, per sample.

        Parameters
        ----------
        deposits, labels, samples
            as for :meth:`Tray.file`.
        """
        indirect = deposits.kind == INDIRECT
        fine = self.fine.file(deposits.where(~indirect), labels, samples)
        smooth = self.smooth.file(deposits.where(indirect), labels, samples)
        return self._light(deposits, samples, fine=fine, smooth=smooth)

    def file_smooth(self, ledger: Ledger, counted: LitSums, labels: Labels, samples: int) -> FiledLight:
        """Light of :attr:`indirect` in a ledger, per sample.

        Parameters
        ----------
        ledger, counted, samples
            as for :meth:`mitsim.transport.ledger.Ledger.filed`.
        labels
            by which the ledger files.
        """
        del labels
        smooth, received, outside = ledger.filed(counted, samples)
        return replace(self._light(None, 1, smooth=smooth), received=received, outside=outside)

    def file_beyond(self, name: str, ledger: Ledger, counted: LitSums, labels: Labels, samples: int) -> FiledLight:
        """Light of anchors in a ledger beyond its mean over the sensor, per sample.

        Parameters
        ----------
        name
            of the tray whose cells the ledger has.
        ledger, counted, labels, samples
            as for :meth:`file_smooth`.
        """
        del labels
        light, *_ = ledger.filed(counted, samples)
        return self._light(None, 1, **{name: self._less_mean(getattr(self, name).bundle, light)})

    def file_sharp(self, deposits: Deposits, labels: Labels, samples: int) -> FiledLight:
        """Light of :attr:`apart`, per sample.

        Parameters
        ----------
        deposits, labels, samples
            as for :meth:`Tray.file`.
        """
        light = self._light(None, 1, sharp=self.sharp.file(deposits, labels, samples))
        mean = deposits.averaged(self.sharp_weights)
        outside = self.sharp.bundle.outside(mean) / samples
        return replace(light, received=float(mean.value.sum()) / samples, outside=outside)

    def file_sharp_sums(self, ledger: Ledger, counted: LitSums, labels: Labels, samples: int) -> FiledLight:
        """Light of :attr:`apart` in a ledger with a row for each of its pixels, per sample.

        Parameters
        ----------
        ledger, counted, samples
            as for :meth:`mitsim.transport.ledger.Ledger.filed`.
        labels
            (n^2,) class of each projector pixel.
        """
        by_pixel, received, outside = self._sharp_sums(ledger, counted, samples)
        rows = np.append(labels[self._sharp_pixels], labels.max() + 1 + np.arange(self._lamp_rows))
        shape = int(labels.max()) + 1 + self._lamp_rows, len(rows)
        classes = sparse.csr_array((np.ones(len(rows)), (rows, np.arange(len(rows)))), shape=shape)
        light = self._light(None, 1, sharp=sparse.csr_array(classes @ by_pixel))
        return replace(light, received=float(received.sum()), outside=float(outside.sum()))

    def sharp_flux(self, ledger: Ledger, counted: LitSums, samples: int) -> FloatArray:
        """What :meth:`flux` tells of the same light.

        Parameters
        ----------
        ledger, counted, samples
            as for :meth:`mitsim.transport.ledger.Ledger.filed`.
        """
        flux = np.zeros(self.bench.n**2)
        flux[self._sharp_pixels] = self._sharp_sums(ledger, counted, samples)[1]
        return flux

    @property
    def _sharp_pixels(self) -> Labels:
        return np.array(self.settings.sharp.pixels if self.settings.sharp else (), dtype=np.int64)

    def _sharp_sums(
        self, ledger: Ledger, counted: LitSums, samples: int
    ) -> tuple[sparse.csr_array, FloatArray, FloatArray]:
        """Light by pixel; of each pixel the mean over the sensor, in all and beyond all cells."""
        light, weights, pixels = ledger.filed(counted, samples)[0], self.sharp_weights, len(self._sharp_pixels)
        outside = np.einsum("pab,a,b->p", ledger.beyond(counted, samples), weights, weights)
        inside = np.asarray(self.sharp.bundle.averaged(light, weights).sum(axis=1))[:pixels]
        return light, inside + outside, outside

    def _light(self, deposits: Deposits | None, samples: int, **parts: sparse.csr_array) -> FiledLight:
        """Light in ``parts``; of ``deposits`` in so many ``samples`` it is told what is received, and what lost."""
        rows = next(iter(parts.values())).shape[0]
        sizes = {name: getattr(self, name).bundle.size for name in TRAYS}
        filed = {name: parts.get(name, sparse.csr_array((rows, size))) for name, size in sizes.items()}
        if deposits is None:
            return FiledLight(**filed)
        received, outside = float(deposits.value.sum()), self.fine.bundle.outside(deposits)
        return FiledLight(**filed, received=received / samples, outside=outside / samples)

    def flux(self, deposits: Deposits, samples: int) -> FloatArray:
        """(n^2,) irradiance of each projector pixel's direct light on the sensor, its mean, without the mask.

        ``deposits`` are those of :attr:`direct` or :attr:`apart` in so many ``samples``.
        """
        if self.settings.sharp and len(deposits.pixel) and deposits.anchor_row.any():
            deposits = deposits.averaged(self.sharp_weights)
        value = deposits.value * (deposits.kind == DIRECT) / samples
        return np.asarray(np.bincount(deposits.pixel, value, minlength=self.bench.n**2 + 1)[:-1], dtype=np.float64)

    def filed(self, groups: Sequence[FiledLight], first: int) -> tuple[list[Filed], list[Filed]]:
        """Light of the projector and ambient light, with the optics that form their frames.

        Parameters
        ----------
        groups, first
            independent estimates of the light, and the first row of ambient light in them.
        """
        lights, ambient = (
            [Filed(self.fine.optics, tuple(_rows(group.fine, 0, first) for group in groups))],
            list[Filed](),
        )
        if self.settings.anchors > 1:
            lights.append(Filed(self.coarse.optics, tuple(_rows(group.coarse, 0, first) for group in groups)))
        if self.settings.with_own_anchors:
            lights.append(Filed(self.occluded.optics, tuple(_rows(group.occluded, 0, first) for group in groups)))
        if self.settings.sharp:
            lights.append(Filed(self.sharp.optics, tuple(_rows(group.sharp, 0, first) for group in groups)))
        if self.settings.followed_anchors > 1:
            lights.append(Filed(self.followed.optics, tuple(_rows(group.followed, 0, first) for group in groups)))
        if self.physics.interreflection:
            lights.append(Filed(self.smooth.optics, tuple(_rows(group.smooth, 0, first) for group in groups)))
        if self.physics.lamps:
            ambient = self.of_lamps(groups, first)
        return lights, ambient

    def of_lamps(self, groups: Sequence[FiledLight], first: int, bands: slice = slice(None)) -> list[Filed]:
        """Lamps' light with the optics that form its frames.

        Parameters
        ----------
        groups, first
            as for :meth:`filed`.
        bands
            of which it is, where not of all.
        """
        found = []
        for row, (tray, beyond) in list(enumerate(self.by_band, first))[bands]:
            found.append(Filed(tray.optics, tuple(_rows(group.fine, row, row + 1) for group in groups)))
            if self.settings.followed_anchors > 1:
                found.append(Filed(beyond.optics, tuple(_rows(group.followed, row, row + 1) for group in groups)))
        return found


def _rows(light: sparse.csr_array, first: int, last: int) -> sparse.csr_array:
    """Rows ``first`` .. ``last`` - 1 of ``light``, not copied."""
    start, stop = light.indptr[first], light.indptr[last]
    entries = light.data[start:stop], light.indices[start:stop], light.indptr[first : last + 1] - start
    return sparse.csr_array(entries, shape=(last - first, light.shape[1]), copy=False)


def _bands(low_nm: float, high_nm: float, count: int) -> Spectrum:
    """Equal photons in ``count`` bands between two wavelengths, each taken at its centre."""
    edges = np.linspace(low_nm, high_nm, count + 1)
    return Spectrum((edges[:-1] + edges[1:]) / 2, np.full(count, 1 / count))
