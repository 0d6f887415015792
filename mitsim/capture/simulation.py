"""One bench under one choice of settings: what is traced, how light is filed, which shadow the mask casts.

An effect that is off takes its neutral value here and nowhere else: a pinhole for the lens, a thin mask, a geometric
shadow. :mod:`mitsim.capture.pilot` switches effects on and off to see what they are worth; :mod:`mitsim.capture.light`
samples the choice that the plan made.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from mitsim.capture.bench import Bench
from mitsim.capture.effects import Physics
from mitsim.capture.evidence import Settings
from mitsim.core.arrays import FloatArray, Labels
from mitsim.optics.anchors import anchor_positions, anchor_weights
from mitsim.optics.closed_form import FrameOptics
from mitsim.optics.frames import ClassFrames, ExpectedFrames, Filed
from mitsim.rig.camera import CameraGeometry
from mitsim.rig.patterns import Lighting
from mitsim.rig.projector import Spectrum
from mitsim.transport.aimed import AimedTracer
from mitsim.transport.cells import CellGrid, aligned_grid
from mitsim.transport.direct import DirectTracer
from mitsim.transport.from_camera import FromCameraTracer, Paths
from mitsim.transport.histogram import DIRECT, INDIRECT, Bundle, Deposits
from mitsim.transport.indirect import IndirectTracer
from mitsim.transport.ledger import Ledger
from mitsim.transport.neighbours import NeighbourTracer
from mitsim.transport.receiver import SensorPoints

_AMBIENT_NM, _AMBIENT_BANDS = (400.0, 700.0), 13
"""Ambient light: a flat spectrum of photons over what a camera with a usual filter sees, in bands of 23 nm, over which
a shadow's fringes hardly move."""
TRAYS = ("fine", "coarse", "occluded", "smooth", "followed", "sharp")
"""Parts of an :class:`FiledLight`."""
AT_ANCHORS = ("indirect at anchors", "from camera at anchors")
"""Names of the stages that follow light to every anchor."""
_MOST_ROWS = 2**12
"""Rows of anchors times cells of sharp light: a class that lights them all is a matrix of 128 MiB."""


@dataclass(frozen=True, eq=False)
class FiledLight:
    """One estimate of the light of a scene, (classes + 1, places) each, the last row ambient light [W m^-2].

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
        return FiledLight(*(getattr(self, field.name) / count for field in fields(self)))

    @property
    def totals(self) -> FloatArray:
        """(classes + 1,) light of each row, a mean over the sensor, but for pixels that are traced apart [W m^-2]."""
        return np.asarray(self.fine.sum(axis=1) + self.smooth.sum(axis=1), dtype=np.float64)

    @property
    def lost(self) -> float:
        """Part of the light that is in no frame."""
        return self.outside / self.received if self.outside else 0.0


def _sum(one: Any, other: Any) -> Any:
    """Of numbers or matrices; a matrix to which nothing is added is not copied."""
    if not isinstance(one, sparse.csr_array) or (one.nnz and other.nnz):
        return one + other
    return one if one.nnz else other


@dataclass(frozen=True)
class Stage:
    """A tracer, the samples of it that the plan predicted, how its light is filed, and its random stream's name.

    ``file`` takes deposits, labels and the number of samples. ``ledger`` makes, from labels, what indirect light is
    filed in on the device, where that has room, and ``file_ledger`` takes it and its sums on the host; None for other
    light.
    """

    tracer: DirectTracer | IndirectTracer | FromCameraTracer
    predicted: float
    file: Callable[[Deposits, Labels, int], FiledLight]
    stream: str
    ledger: Callable[[Labels], Ledger | None] = lambda labels: None
    file_ledger: Callable[[Ledger, npt.NDArray[np.uint64]], FiledLight] | None = None

    def trace(self, seed: int, first: int, samples: int, ledger: Ledger | None) -> Deposits:
        """Light of some samples, but for what is filed in the ``ledger``.

        Parameters
        ----------
        seed, first, samples
            as for :meth:`mitsim.transport.paths.Tracer.trace`.
        ledger
            of :attr:`ledger`.
        """
        if ledger is None or not isinstance(self.tracer, IndirectTracer):
            return self.tracer.trace(seed, first, samples)
        return self.tracer.trace_into(ledger, seed, first, samples)


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
    """

    def __init__(self, bundle: Bundle, geometry: CameraGeometry, spectrum: Spectrum | None) -> None:
        self.bundle, self._geometry, self._spectrum = bundle, geometry, spectrum

    @cached_property
    def optics(self) -> FrameOptics:
        """From light in these cells to frames."""
        bundle = self.bundle
        return FrameOptics(self._geometry, bundle.rows, bundle.columns, bundle.depths, bundle.anchors, self._spectrum)

    def file(self, deposits: Deposits, labels: Labels, samples: int) -> sparse.csr_array:
        """(classes + 1, places) light per sample.

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


class Simulation:
    """A bench with settings; its parts are prepared when they are first asked for.

    Parameters
    ----------
    bench, settings
        what is simulated, and how finely.
    pixels
        cells a side of the projector's window, instead of one a pixel.
    one_line
        whether diffraction is that of the light's mean wavelength alone: for what hardly hangs on it, in a third of the
        time.

    Attributes
    ----------
    physics
        what is simulated of the bench.
    fine, coarse, occluded, smooth, followed, sharp
        trays for the parts of an :class:`FiledLight`; ``ambient`` and ``followed_ambient`` for lamps' light in the
        cells of ``fine`` and of ``followed``.
    """

    def __init__(self, bench: Bench, settings: Settings, pixels: int | None = None, one_line: bool = False) -> None:
        self.bench, self.settings = bench, settings
        self.physics = Physics.simulated(bench, settings.effects)
        if one_line and self.physics.spectrum:
            self.physics = replace(self.physics, spectrum=self.physics.spectrum.mean)
        pixels = pixels or bench.n
        # The sensor's centre sees nothing beyond the field stop, so near surfaces ask for no more directions.
        self.aim = self._grid(pixels, 1, None)
        fine = Bundle(self._grid(pixels, settings.subdivision, settings.reach), 1, settings.depths)
        depths = settings.depths if settings.coarse_layers else (settings.depth,)
        coarse = self._grid(pixels, settings.coarse_cells, settings.reach)
        self.fine = self._tray(fine)
        self.coarse = self._tray(Bundle(coarse, settings.anchors, depths))
        self.occluded = self._tray(Bundle(coarse, settings.occluded_anchors, depths))
        self.smooth = self._tray(Bundle(coarse, 1, depths))
        wide = self._grid(-(-pixels // settings.followed_width), 1, settings.reach)
        broad = (wide, (settings.depth,)) if settings.followed_width > 1 else (coarse, depths)
        several = Bundle(broad[0], settings.followed_anchors, broad[1])
        self.followed = self._tray(several)
        self.sharp = self._tray(self._apart(pixels))
        lamps = _bands(*_AMBIENT_NM, _AMBIENT_BANDS)
        self.ambient, self.followed_ambient = self._tray(fine, lamps), self._tray(several, lamps)

    def _tray(self, bundle: Bundle, light: Spectrum | None = None) -> Tray:
        """``light`` None: the projector's. All light diffracts or none."""
        spectrum = self.physics.spectrum
        return Tray(bundle, self.physics.geometry, (light or spectrum) if spectrum else None)

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
            return Bundle(self._grid(pixels, 1, None), 1, (settings.depth,))

        def part(subdivision: int) -> CellGrid:
            whole, window = self._grid(pixels, subdivision, settings.reach), sharp.window
            return CellGrid(whole.rows.part(*window[:2]), whole.columns.part(*window[2:]))

        most = max(1, _MOST_ROWS // (sharp.anchors * max(part(1).shape)))
        return Bundle(part(min(settings.subdivision, most)), sharp.anchors, settings.depths, between=True)

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
    def from_camera(self) -> FromCameraTracer | None:
        """Follows all other light, from the same points; none where there is none."""
        return self._from_camera(self._mean_points)

    @property
    def at_anchors(self) -> tuple[IndirectTracer | None, FromCameraTracer | None]:
        """Both, to every anchor of followed light."""
        points = self._points(self.settings.followed_anchors)
        return self._indirect(points), self._from_camera(points)

    @property
    def _mean_points(self) -> SensorPoints:
        return self._points(1, self.settings.followed_anchors > 1)

    def _points(self, anchors: int, spread: bool = False) -> SensorPoints:
        return SensorPoints(self.physics.geometry.half_width, anchors, spread, self.settings.depth)

    def _indirect(self, points: SensorPoints, shared: bool = False) -> IndirectTracer | None:
        loaded, physics = self.bench.loaded, self.physics
        paths = physics.mirrors, physics.interreflection
        if not any(paths):
            return None
        parts = loaded.scene, loaded.camera, physics.projector, *paths, physics.geometry, points
        return NeighbourTracer(*parts) if shared else IndirectTracer(*parts)

    def _from_camera(self, points: SensorPoints) -> FromCameraTracer | None:
        loaded, physics = self.bench.loaded, self.physics
        if not (physics.lamps or physics.mirrors or (physics.interreflection and loaded.glossy)):
            return None
        paths = Paths(physics.mirrors, physics.interreflection, physics.lamps)
        parts = loaded.scene, loaded.camera, physics.projector
        return FromCameraTracer(*parts, self.aim, paths, physics.geometry, points)

    def follow(self, seed: int, samples: int) -> Deposits:
        """Light of :attr:`indirect` and :attr:`from_camera` in ``samples`` of each from ``seed``, to be filed."""
        tracers = [tracer for tracer in (self.indirect, self.from_camera) if tracer is not None]
        return Deposits.joined([tracer.trace(seed, 0, samples) for tracer in tracers])

    @cached_property
    def sharp_weights(self) -> FloatArray:
        """(anchors,) weight of each of the sharp pixels' anchors in the mean over the sensor."""
        return self._mean_weights(self.sharp.bundle.anchors)

    def _mean_weights(self, anchors: int) -> FloatArray:
        """(anchors,) weight of each anchor in the mean over the sensor."""
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
        return light - bundle.repeated(bundle.averaged(light, self._mean_weights(bundle.anchors)))

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

    def smooth_ledger(self, labels: Labels) -> Ledger | None:
        """What indirect light is filed in by class in ``labels`` (n^2,), where it has room."""
        return self._ledger(self.smooth.bundle, labels)

    def file_smooth(self, ledger: Ledger, counted: npt.NDArray[np.uint64]) -> FiledLight:
        """Light in a ``ledger`` of :meth:`smooth_ledger`, from what it ``counted``."""
        smooth, received, outside = ledger.filed(counted)
        return replace(self._light(None, 1, smooth=smooth), received=received, outside=outside)

    def anchors_ledger(self, labels: Labels) -> Ledger | None:
        """What indirect light at anchors is filed in by class in ``labels`` (n^2,), where it has room."""
        return self._ledger(self.followed.bundle, labels)

    def file_anchors(self, ledger: Ledger, counted: npt.NDArray[np.uint64]) -> FiledLight:
        """Light in a ``ledger`` of :meth:`anchors_ledger` beyond its mean, from what it ``counted``."""
        light, *_ = ledger.filed(counted)
        return self._light(None, 1, followed=self._less_mean(self.followed.bundle, light))

    def _ledger(self, bundle: Bundle, labels: Labels) -> Ledger | None:
        fits = self.indirect is not None and Ledger.holds(bundle, labels)
        return Ledger(bundle, labels, self.indirect.board) if self.indirect and fits else None

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

    def _light(self, deposits: Deposits | None, samples: int, **parts: sparse.csr_array) -> FiledLight:
        """Light in ``parts``; of ``deposits`` in so many ``samples`` it is told what is received, and what lost."""
        rows = next(iter(parts.values())).shape[0]
        sizes = {name: getattr(self, name).bundle.size for name in TRAYS}
        filed = {name: parts.get(name, sparse.csr_array((rows, size))) for name, size in sizes.items()}
        if deposits is None:
            return FiledLight(**filed)
        received, outside = float(deposits.value.sum()), self.fine.bundle.outside(deposits)
        return FiledLight(**filed, received=received / samples, outside=outside / samples)

    def tracers(self) -> dict[str, Stage]:
        """What is traced: samples a group is predicted to need, and how the light is filed, by name."""
        settings = self.settings
        stages = {"direct": Stage(self.direct, settings.direct_samples, self.file_direct, "direct")}
        if self.anchored is not None:
            stages["anchored"] = Stage(self.anchored, settings.anchored_samples, self.file_anchored, "anchored")
        if self.anchored_occluded is not None:
            stages["occluded"] = Stage(
                self.anchored_occluded, settings.occluded_samples, self.file_occluded, "occluded"
            )
        if self.apart is not None:
            stages["sharp"] = Stage(self.apart, settings.sharp_samples, self.file_sharp, "sharp")
        if self.indirect is not None:
            ledger = self.smooth_ledger, self.file_smooth
            stages["indirect"] = Stage(
                self.indirect, settings.indirect_samples, self.file_followed, "indirect", *ledger
            )
        if self.from_camera is not None:
            # The stream keeps the name that it had in 0.3.0, so that the same seed gives the same frames.
            samples = settings.from_camera_samples
            stages["from_camera"] = Stage(self.from_camera, samples, self.file_followed, "other")
        if settings.followed_anchors > 1:
            samples, file, names = settings.followed_samples, self.file_at_anchors, AT_ANCHORS
            indirect, from_camera = self.at_anchors
            if indirect is not None:
                stages[names[0]] = Stage(indirect, samples, file, names[0], self.anchors_ledger, self.file_anchors)
            if from_camera is not None:
                stages[names[1]] = Stage(from_camera, samples, file, names[1])
        return stages

    def flux(self, deposits: Deposits, samples: int) -> FloatArray:
        """(n^2,) irradiance of each projector pixel's direct light on the sensor, its mean, without the mask.

        ``deposits`` are those of :attr:`direct` or :attr:`apart` in so many ``samples``.
        """
        if self.settings.sharp and len(deposits.pixel) and deposits.anchor_row.any():
            deposits = deposits.averaged(self.sharp_weights)
        value = deposits.value * (deposits.kind == DIRECT) / samples
        return np.asarray(np.bincount(deposits.pixel, value, minlength=self.bench.n**2 + 1)[:-1], dtype=np.float64)

    def glint_frames(self, labels: Labels) -> ClassFrames | None:
        """Frames of the projector's glint by class in ``labels`` (n^2,); None without such light.

        It is a pinhole's light, whatever the projector's lens.
        """
        if not self.physics.mirrors:
            return None
        return self.bench.glint.frames(labels, self.physics.geometry, self.physics.spectrum)

    def expected(
        self, groups: Sequence[FiledLight], rows: Labels, lighting: Lighting, seed: int, leaking: bool = True
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
        """
        return expected_of([(self, groups)], rows, lighting, seed, leaking)

    def filed(self, groups: Sequence[FiledLight], first: int) -> tuple[list[Filed], list[Filed]]:
        """Light of the projector and ambient light, with the optics that form their frames.

        Parameters
        ----------
        groups, first
            independent estimates of the light, and the row of ambient light in them, the last.
        """
        lights, ambient = [Filed(self.fine.optics, tuple(_rows(group.fine, 0, first) for group in groups))], []
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
            ambient.append(Filed(self.ambient.optics, tuple(_rows(group.fine, first, first + 1) for group in groups)))
            if self.settings.followed_anchors > 1:
                beyond = tuple(_rows(group.followed, first, first + 1) for group in groups)
                ambient.append(Filed(self.followed_ambient.optics, beyond))
        return lights, ambient


def expected_of(
    parts: Sequence[tuple[Simulation, Sequence[FiledLight]]],
    rows: Labels,
    lighting: Lighting,
    seed: int,
    leaking: bool = True,
) -> ExpectedFrames:
    """Expected frames of light in several parts.

    Parameters
    ----------
    parts
        simulations of one rig, each with the light that it filed; black pixels leak as the first says, glint is that of
        the last.
    rows, lighting, seed, leaking
        as for :meth:`Simulation.expected`.
    """
    physics = parts[0][0].physics
    black = physics.black_level if leaking else 0.0
    emitted = black + (1 - black) * lighting.weights
    filed = [simulation.filed(groups, len(rows)) for simulation, groups in parts]
    lights, ambient = ([each for part in filed for each in part[kind]] for kind in (0, 1))
    glint = parts[-1][0].glint_frames(lighting.labels)
    return ExpectedFrames(lights, Lighting(rows, emitted), seed, ambient, glint)


def _rows(light: sparse.csr_array, first: int, last: int) -> sparse.csr_array:
    """Rows ``first`` .. ``last`` - 1 of ``light``, not copied."""
    start, stop = light.indptr[first], light.indptr[last]
    entries = light.data[start:stop], light.indices[start:stop], light.indptr[first : last + 1] - start
    return sparse.csr_array(entries, shape=(last - first, light.shape[1]), copy=False)


def _bands(low_nm: float, high_nm: float, count: int) -> Spectrum:
    """Equal photons in ``count`` bands between two wavelengths, each taken at its centre."""
    edges = np.linspace(low_nm, high_nm, count + 1)
    return Spectrum((edges[:-1] + edges[1:]) / 2, np.full(count, 1 / count))
