"""One bench under one choice of settings: what is traced, how light is filed, which shadow the mask casts.

An effect that is off takes its neutral value here and nowhere else: a pinhole for the lens, a thin mask, a geometric
shadow. :mod:`mitsim.capture.pilot` switches effects on and off to see what they are worth; :mod:`mitsim.capture.light`
samples the choice that the plan made.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import sparse

from mitsim.capture.bench import Bench
from mitsim.optics.camera import CameraGeometry, anchor_positions, anchor_weights
from mitsim.optics.diffraction import Spectrum
from mitsim.optics.frames import ClassFrames, ExpectedFrames, Filed, FrameOptics
from mitsim.scene.plan import Settings
from mitsim.transport.cells import CellGrid, aligned_grid
from mitsim.transport.factored import Paths, Tracer
from mitsim.transport.histogram import DIRECT, INDIRECT, Bundle, Deposits

FloatArray = npt.NDArray[np.float64]
Labels = npt.NDArray[np.int64]
AMBIENT_NM, AMBIENT_BANDS = (400.0, 700.0), 13
"""Ambient light: a flat spectrum of photons over this range, in so many bands."""


@dataclass(frozen=True, eq=False)
class Light:
    """One estimate of the light of a scene, (classes + 1, places) each, the last row ambient light [W m^-2].

    ``fine`` is what the sensor sees on average, in fine cells and layers. ``coarse`` is the rest: what each anchor sees
    beyond that, and indirect light; it is small or smooth, so coarse cells hold it well.
    """

    fine: sparse.csr_array
    coarse: sparse.csr_array

    def __add__(self, other: Light) -> Light:
        return Light(self.fine + other.fine, self.coarse + other.coarse)

    def __truediv__(self, count: float) -> Light:
        return Light(self.fine / count, self.coarse / count)


class Simulation:
    """A bench with settings; its parts are prepared when they are first asked for."""

    def __init__(self, bench: Bench, settings: Settings, common: bool = False, pixels: int | None = None) -> None:
        """``common``: anchors share random numbers; ``pixels``: cells a side of the window, instead of its own."""
        self.bench, self.settings, self.common = bench, settings, common
        on = settings.effects
        neutral: dict[str, float] = {}
        if "mask-thickness" not in on:
            neutral["mask_thickness"] = 0.0
        if "pixel-response" not in on:
            neutral |= {"pixel_fill_factor": 1.0, "angular_exponent": 0.0}
        self.geometry: CameraGeometry = bench.geometry.model_copy(update=neutral)
        self.black = bench.projector.black_level if "black-level" in on else 0.0
        pixels = pixels or bench.n
        self.aim = self._grid(pixels, 1)
        self.bundle = Bundle(self._grid(pixels, settings.subdivision), 1, settings.depths, settings.linear)
        depths = settings.depths if settings.coarse_layers else (settings.depth,)
        subdivision, linear = settings.coarse_cells
        self.coarse = Bundle(self._grid(pixels, subdivision), settings.anchors, depths, linear)

    def _grid(self, pixels: int, subdivision: int) -> CellGrid:
        """Cells as far as the sensor's edge sees through the field stop: directions are those from its centre.

        The same for any number of anchors and layers, so that their light can be compared.
        """
        windows = self.bench.windows_at(self.settings.depth)
        reach = self.geometry.tan_half_fov + self.geometry.half_width / self.settings.depth
        return aligned_grid(*windows, pixels, subdivision, reach, multiple=subdivision)

    @cached_property
    def tracer(self) -> Tracer:
        """Follows the paths that the settings ask for."""
        on, bench = self.settings.effects, self.bench
        source = bench.source
        if "aperture" not in on:
            source = replace(source, aperture=0.0)
        if "blur" not in on:
            source = replace(source, blur=0.0)
        paths = Paths(
            mirrors="mirrors" in on,
            interreflection="interreflection" in on,
            emitters=bench.loaded.lamps if self.lit_by_lamps else (),
        )
        return Tracer(
            bench.loaded.scene,
            bench.loaded.camera,
            source,
            self.aim,
            self.settings.anchors,
            self.settings.depth,
            paths,
            self.common,
            self.geometry,
        )

    @cached_property
    def optics(self) -> FrameOptics:
        """The mask's shadow in the projector's light, for light filed finely."""
        return self._optics(self.bench.spectrum, self.bundle)

    @cached_property
    def coarse_optics(self) -> FrameOptics:
        """The same for light filed coarsely."""
        return self._optics(self.bench.spectrum, self.coarse)

    @cached_property
    def ambient_optics(self) -> tuple[FrameOptics, FrameOptics]:
        """The mask's shadow in the light of other lamps, fine and coarse."""
        bands = _bands(*AMBIENT_NM, AMBIENT_BANDS)
        return self._optics(bands, self.bundle), self._optics(bands, self.coarse)

    def _optics(self, spectrum: Spectrum, bundle: Bundle) -> FrameOptics:
        waves = spectrum if self.waves else None
        return FrameOptics(self.geometry, bundle.rows, bundle.columns, bundle.depths, bundle.anchors, waves)

    @cached_property
    def mean_weights(self) -> FloatArray:
        """(anchors,) weight of each anchor in the mean over the sensor."""
        edges = self.geometry.pixel_edges
        positions = anchor_positions(self.settings.anchors, self.geometry.half_width)
        return np.asarray(anchor_weights(positions, (edges[:-1] + edges[1:]) / 2).mean(axis=0))

    def file(self, found: Deposits, labels: Labels, samples: int) -> Light:
        """Light of the projector's direct and the lamps' light, per sample [W m^-2]."""
        found = found.where(found.order != INDIRECT)
        mean = found.averaged(self.mean_weights)
        fine = self.bundle.file(mean, labels, samples)
        if self.settings.anchors == 1:
            return Light(fine, sparse.csr_array((fine.shape[0], self.coarse.size)))
        single = replace(self.coarse, anchors=1).file(mean, labels, samples)
        return Light(fine, self.coarse.file(found, labels, samples) - self.coarse.repeated(single))

    def file_indirect(self, found: Deposits, labels: Labels, samples: int) -> sparse.csr_array:
        """(classes + 1, places) indirect light of every class in coarse cells, per sample [W m^-2]."""
        return self.coarse.file(found.where(found.order == INDIRECT), labels, samples)

    def flux(self, found: Deposits, samples: int) -> FloatArray:
        """(n^2,) irradiance of each projector pixel's direct light on the sensor, its mean, without the mask."""
        mean = self.mean_weights
        value = found.value * mean[found.anchor_row] * mean[found.anchor_column] * (found.order == DIRECT) / samples
        return np.asarray(np.bincount(found.source, value, minlength=self.bench.n**2 + 1)[:-1], dtype=np.float64)

    def mirrored(self, labels: Labels) -> ClassFrames | None:
        """Frames of light that comes from the projector over mirrors alone, by class; None without such light.

        It is a pinhole's light, whatever the projector's lens.
        """
        if "mirrors" not in self.settings.effects or not self.bench.loaded.mirrors:
            return None
        return self.bench.mirror_light.frames(labels, self.geometry, self.bench.spectrum if self.waves else None)

    @property
    def waves(self) -> bool:
        """Whether the mask's shadow is wave-optical."""
        return "diffraction" in self.settings.effects

    def expected(
        self, groups: Sequence[Light], rows: Labels, weights: FloatArray, seed: int, exact: ClassFrames | None = None
    ) -> ExpectedFrames:
        """Frames of the captures ``weights`` (captures, classes); ``rows`` maps the groups' rows to classes."""
        first = len(rows)
        emitted = self.black + (1 - self.black) * weights
        fine, coarse = [group.fine for group in groups], [group.coarse for group in groups]
        more, ambient = [], []
        if any(light.nnz for light in coarse):
            more = [Filed(self.coarse_optics, tuple(light[:first] for light in coarse))]
        if self.lit_by_lamps:
            ambient = [
                Filed(optics, tuple(light[first:] for light in part))
                for optics, part in zip(self.ambient_optics, (fine, coarse), strict=True)
            ]
        direct = [light[:first] for light in fine]
        return ExpectedFrames(self.optics, direct, rows, emitted, seed, more, ambient, exact)

    @property
    def lit_by_lamps(self) -> bool:
        """Whether ambient light is simulated."""
        return "ambient" in self.settings.effects and bool(self.bench.loaded.lamps)


def _bands(low_nm: float, high_nm: float, count: int) -> Spectrum:
    """Equal photons in ``count`` bands between two wavelengths, each taken at its centre."""
    edges = np.linspace(low_nm, high_nm, count + 1)
    return Spectrum((edges[:-1] + edges[1:]) / 2, np.full(count, 1 / count))
