"""Light of a bench under one choice of settings, from deposits of tracers to sparse matrices, with the
optics that form their frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy import sparse

from mitsim.bench.bench import Apparatus
from mitsim.bench.effects import Physics
from mitsim.core.arrays import FloatArray, Labels
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.patterns import Lighting
from mitsim.devices.projector import Spectrum
from mitsim.light.settings import LANES_AT_ONCE, Settings, whole
from mitsim.optics.frames import ClassFrames, ExpectedFrames, Filed
from mitsim.optics.image_formation import FrameOptics, anchor_positions, anchor_weights
from mitsim.optics.shadow import Places
from mitsim.transport.accumulator import Ledger, LitSums
from mitsim.transport.connect import SensorPoints
from mitsim.transport.direct import DirectTracer
from mitsim.transport.from_camera import Counted, FromCameraTracer, LampTracer, Paths, Together
from mitsim.transport.indirect import IndirectTracer
from mitsim.transport.path_reuse import NeighbourTracer
from mitsim.transport.records import DIRECT, INDIRECT, Bundle, CellGrid, Deposits, aligned_grid
from mitsim.transport.sharp_lobes import AimedTracer

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
        bench: Apparatus,
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
            as for :meth:`mitsim.transport.accumulator.Ledger.filed`.
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
            as for :meth:`mitsim.transport.accumulator.Ledger.filed`.
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
            as for :meth:`mitsim.transport.accumulator.Ledger.filed`.
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


# -------- One bench under one choice of settings in

FromCamera = FromCameraTracer | Together
"""What follows light from the camera's side."""
AT_ANCHORS = ("indirect at anchors", "from camera at anchors")
"""Names of the stages that follow light to every anchor."""
_FEWEST_AT_ONCE = 2**18
"""Paths that are held in memory at a time at least, 130 MB: so many take far longer than launching them."""


@dataclass(frozen=True)
class Stage:
    """A tracer, the samples of it that the plan predicted, how its light is filed, and its random stream's name.

    ``file`` takes deposits, labels and the number of samples. ``ledgers`` makes, from labels and a number of lines,
    what light of each line is filed in on the device, where that has room and pays, and ``file_ledger`` takes one, its
    sums on the host, labels and the number of samples; none for other light.
    """

    tracer: DirectTracer | IndirectTracer | FromCamera
    predicted: float
    file: Callable[[Deposits, Labels, int], FiledLight]
    stream: str
    ledgers: Callable[[Labels, int], tuple[Ledger, ...]] = lambda labels, lines: ()
    file_ledger: Callable[[Ledger, LitSums, Labels, int], FiledLight] | None = None

    def trace(self, seed: int, first: int, samples: int, ledgers: Sequence[Ledger] = ()) -> Deposits:
        """Light of some samples, but for what is filed in the ``ledgers``.

        Parameters
        ----------
        seed, first, samples
            as for :meth:`mitsim.transport.integrator.Tracer.trace`.
        ledgers
            of :attr:`ledgers`.
        """
        if not ledgers or not isinstance(self.tracer, DirectTracer | IndirectTracer):
            return self.tracer.trace(seed, first, samples)
        return self.tracer.trace_into(ledgers, seed, first, samples)


class Simulation(Trays):
    """A bench with settings: what is traced, and frames of what was filed; tracers are prepared when they are first
    asked for. Its parameters are those of :class:`mitsim.light.passes.Trays`.
    """

    @cached_property
    def direct(self) -> DirectTracer:
        """Follows direct light from the projector to the sensor's centre, or to all of it where anchors are used."""
        return self._direct(1, spread=self.settings.anchors > 1)

    @property
    def spread(self) -> DirectTracer:
        """Follows direct light to random points of the sensor."""
        return self._direct(1, spread=True)

    @cached_property
    def anchored(self) -> DirectTracer | None:
        """The same to every anchor, but for occluded pixels."""
        settings = self.settings
        return self._direct(settings.anchors, settings.with_own_anchors) if settings.anchors > 1 else None

    @cached_property
    def anchored_occluded(self) -> DirectTracer | None:
        """Follows direct light of occluded pixels to anchors of their own; none where there are none."""
        settings = self.settings
        others = np.setdiff1d(np.arange(self.bench.n**2), settings.with_own_anchors)
        return self._direct(settings.occluded_anchors, others) if settings.with_own_anchors else None

    @cached_property
    def apart(self) -> AimedTracer | None:
        """Follows direct light of the sharp pixels to their anchors; none where there are none."""
        loaded, physics, sharp = self.bench.loaded, self.physics, self.settings.sharp
        if sharp is None:
            return None
        parts = loaded.scene, loaded.camera, physics.projector, sharp.anchors, physics.geometry
        return AimedTracer(*parts, np.array(sharp.pixels))

    def _direct(self, anchors: int, without: Labels | tuple[int, ...] = (), spread: bool = False) -> DirectTracer:
        """Of all pixels that are not traced apart, ``without`` some."""
        loaded, physics, sharp = self.bench.loaded, self.physics, self.settings.sharp
        absent = np.union1d(without, sharp.pixels if sharp else ()).astype(np.int64)
        pixels = np.setdiff1d(np.arange(self.bench.n**2), absent) if len(absent) else None
        return DirectTracer(loaded.scene, loaded.camera, physics.projector, anchors, physics.geometry, spread, pixels)

    @cached_property
    def indirect(self) -> IndirectTracer | None:
        """Follows light over several surfaces from the projector to the sensor's centre, or to all of it where it has
        anchors; none where there is none."""
        tracer, repeats = self._indirect(self._mean_points, self.settings.shared), self.settings.repeats
        return tracer.repeating(repeats) if tracer and repeats else tracer

    @cached_property
    def from_camera(self) -> FromCamera | None:
        """Follows all other light, from the same points; none where there is none."""
        return self._from_camera(self._mean_points)

    @property
    def at_anchors(self) -> tuple[IndirectTracer | None, FromCamera | None]:
        """Both, to every anchor of followed light."""
        points = self._points(self.settings.followed_anchors)
        return self._indirect(points), self._from_camera(points)

    @property
    def _mean_points(self) -> SensorPoints:
        return self._points(1, self.settings.followed_anchors > 1)

    @property
    def lamps_apart(self) -> bool:
        """Whether lamps' paths are followed for no light of the projector."""
        return not self._from_camera_of_projector

    @property
    def _from_camera_of_projector(self) -> bool:
        return self.physics.mirrors or (self.physics.interreflection and self.bench.loaded.glossy)

    def _points(self, anchors: int, spread: bool = False) -> SensorPoints:
        return SensorPoints(self.physics.geometry.half_width, anchors, spread, self.settings.depth)

    def _indirect(self, points: SensorPoints, shared: bool = False) -> IndirectTracer | None:
        loaded, physics = self.bench.loaded, self.physics
        paths = physics.mirrors, physics.interreflection
        if not any(paths):
            return None
        parts = loaded.scene, loaded.camera, physics.projector, *paths, physics.geometry, points
        return NeighbourTracer(*parts) if shared else IndirectTracer(*parts)

    def _from_camera(self, points: SensorPoints) -> FromCamera | None:
        loaded, physics, lamplight = self.bench.loaded, self.physics, self.bench.lamplight
        of_projector = self._from_camera_of_projector
        if not (physics.lamps or of_projector):
            return None
        paths = Paths(physics.mirrors, physics.interreflection, physics.lamps)
        parts = loaded.scene, loaded.camera, physics.projector
        tracer = FromCameraTracer(*parts, self.aim, paths, physics.geometry, points)
        if lamplight is None or not physics.lamps:
            return tracer
        # Lamps have wavelengths of their own, and filters of each colour count them on their own.
        units = lamplight.units_of(self.bench.projector.lines)
        lamps: list[FromCameraTracer] = []
        for number, response in enumerate(lamplight.responses):
            rows = lamplight.rows(number)
            own = [unit * response.part for unit in units]
            lamps.append(LampTracer(tracer, Counted(response, lamplight.bands[rows], own, rows.start)))
        if of_projector:
            lamps.insert(0, FromCameraTracer(*parts, self.aim, replace(paths, emitters=()), physics.geometry, points))
        return lamps[0] if len(lamps) == 1 else Together(*lamps)

    def follow(self, seed: int, samples: int) -> Deposits:
        """Light of :attr:`indirect` and :attr:`from_camera` in ``samples`` of each from ``seed``, to be filed."""
        tracers = [tracer for tracer in (self.indirect, self.from_camera) if tracer is not None]
        return Deposits.joined([tracer.trace(seed, 0, samples) for tracer in tracers])

    def smooth_ledgers(self, labels: Labels, lines: int) -> tuple[Ledger, ...]:
        """What indirect light of each of ``lines`` is filed in by class in ``labels`` (n^2,), where it has room."""
        return self._ledgers(self.indirect, self.smooth.bundle, labels, lines)

    def anchors_ledgers(self, labels: Labels, lines: int) -> tuple[Ledger, ...]:
        """The same of indirect light at anchors, as :meth:`smooth_ledgers` takes ``labels`` and ``lines``."""
        return self._ledgers(self.indirect, self.followed.bundle, labels, lines)

    def coarse_ledgers(self, labels: Labels, lines: int) -> tuple[Ledger, ...]:
        """The same of direct light at anchors, where its paths are many for its cells.

        Parameters
        ----------
        labels, lines
            as for :meth:`smooth_ledgers`.
        """
        return self._ledgers(self.anchored, self.coarse.bundle, labels, lines, self.settings.anchored_samples)

    def sharp_ledgers(self, labels: Labels, lines: int) -> tuple[Ledger, ...]:
        """The same of :attr:`apart`, whose pixels have a row each.

        Parameters
        ----------
        labels, lines
            as for :meth:`smooth_ledgers`; rows do not hang on classes.
        """
        del labels
        sharp, rows = self.settings.sharp, np.zeros(self.bench.n**2, dtype=np.int64)
        if sharp is not None:
            rows[list(sharp.pixels)] = np.arange(len(sharp.pixels))
        return self._ledgers(self.apart, self.sharp.bundle, rows, lines, self.settings.sharp_samples)

    @staticmethod
    def _ledgers(
        tracer: DirectTracer | IndirectTracer | None,
        bundle: Bundle,
        labels: Labels,
        lines: int,
        samples: float = math.inf,
    ) -> tuple[Ledger, ...]:
        """Ledgers of what a ``tracer`` finds in so many samples; none where it has none, or no room."""
        if tracer is None or not Ledger.holds(bundle, labels, lines, samples * tracer.lanes):
            return ()
        return Ledger.of_lines(lines, bundle, labels, tracer.board)

    def tracers(self) -> dict[str, Stage]:
        """What is traced: samples a group is predicted to need, and how the light is filed, by name."""
        settings = self.settings
        stages = {"direct": Stage(self.direct, settings.direct_samples, self.file_direct, "direct")}
        if self.anchored is not None:
            own = self.coarse_ledgers, partial(self.file_beyond, "coarse")
            stages["anchored"] = Stage(self.anchored, settings.anchored_samples, self.file_anchored, "anchored", *own)
        if self.anchored_occluded is not None:
            stages["occluded"] = Stage(
                self.anchored_occluded, settings.occluded_samples, self.file_occluded, "occluded"
            )
        if self.apart is not None:
            device = self.sharp_ledgers, self.file_sharp_sums
            stages["sharp"] = Stage(self.apart, settings.sharp_samples, self.file_sharp, "sharp", *device)
        if self.indirect is not None:
            samples, device = settings.indirect_samples, (self.smooth_ledgers, self.file_smooth)
            stages["indirect"] = Stage(self.indirect, samples, self.file_followed, "indirect", *device)
        if self.from_camera is not None:
            # The stream keeps the name that it had in 0.3.0, so that the same seed gives the same frames.
            samples = settings.from_camera_samples
            stages["from_camera"] = Stage(self.from_camera, samples, self.file_followed, "other")
        if settings.followed_anchors > 1:
            file, names = self.file_at_anchors, AT_ANCHORS
            indirect, from_camera = self.at_anchors
            if indirect is not None:
                own = self.anchors_ledgers, partial(self.file_beyond, "followed")
                stages[names[0]] = Stage(indirect, settings.followed_samples, file, names[0], *own)
            if from_camera is not None:
                stages[names[1]] = Stage(from_camera, settings.followed_from_camera_samples, file, names[1])
        return stages

    @cached_property
    def paths_at_once(self) -> int:
        """Paths whose light is held in memory at a time: as many as a stage is predicted to need, within limits; rounds
        that turn out to need more take no more memory."""
        stages = self.tracers().items()
        most = max(int(whole(name, stage.predicted)) * stage.tracer.lanes for name, stage in stages)
        lanes = max(stage.tracer.lanes for _, stage in stages)
        return max(min(max(most, _FEWEST_AT_ONCE), LANES_AT_ONCE), lanes)

    def glint_frames(self, labels: Labels) -> ClassFrames | None:
        """Frames of the projector's glint by class in ``labels`` (n^2,); None without such light.

        It is a pinhole's light, whatever the projector's lens.
        """
        if not self.physics.mirrors:
            return None
        found = self.bench.glint.frames(labels, self.physics.geometry, self.physics.spectrum)
        if found is None or self.places is None:
            return found
        return replace(found, irradiance=found.irradiance[:, self.places[0]][:, :, self.places[1]])

    def expected(
        self,
        groups: Sequence[FiledLight],
        rows: Labels,
        lighting: Lighting,
        seed: int,
        leaking: bool = True,
        probed: FloatArray | None = None,
    ) -> ExpectedFrames:
        """Expected frames of all shots of a lighting.

        Parameters
        ----------
        groups
            independent estimates of the light.
        rows
            (groups' rows,) class of ``lighting`` that each row of the estimates belongs to.
        lighting
            the shots.
        seed
            of the probes that tell the Monte Carlo error.
        leaking
            whether black pixels leak, so that every shot lights all of them; without, shots of few pixels form faster.
        probed
            what the frames of other shots say of the same classes, as :class:`ExpectedFrames` takes it.
        """
        return expected_of([(self, groups)], rows, lighting, seed, leaking, probed)


def expected_of(
    parts: Sequence[tuple[Simulation, Sequence[FiledLight]]],
    rows: Labels,
    lighting: Lighting,
    seed: int,
    leaking: bool = True,
    probed: FloatArray | None = None,
) -> ExpectedFrames:
    """Expected frames of light in several parts.

    Parameters
    ----------
    parts
        simulations of one rig, each with the light that it filed; black pixels leak as the first says, glint is that of
        the last.
    rows, lighting, seed, leaking, probed
        as for :meth:`Simulation.expected`.
    """
    light = emitted(parts[0][0].physics, lighting, leaking)
    filed = [simulation.filed(groups, len(rows)) for simulation, groups in parts]
    lights, ambient = ([each for part in filed for each in part[kind]] for kind in (0, 1))
    glint = parts[-1][0].glint_frames(lighting.labels)
    return ExpectedFrames(lights, Lighting(rows, light), seed, ambient, glint, probed)


def emitted(physics: Physics, lighting: Lighting, leaking: bool = True) -> FloatArray:
    """(shots, classes) light of each class of pixels in each shot, as a part of its full power.

    Parameters
    ----------
    physics
        of the projector.
    lighting, leaking
        as for :meth:`Simulation.expected`.
    """
    black = physics.black_level if leaking else 0.0
    return np.asarray(black + (1 - black) * lighting.weights)
