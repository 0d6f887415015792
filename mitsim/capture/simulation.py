"""One bench under one choice of settings: what is traced, how light is filed, which shadow the mask casts.

An effect that is off takes its neutral value here and nowhere else: a pinhole for the lens, a thin mask, a geometric
shadow. :mod:`mitsim.capture.pilot` switches effects on and off to see what they are worth; :mod:`mitsim.capture.light`
samples the choice that the plan made.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import sparse

from mitsim.capture.bench import Bench
from mitsim.optics.camera import CameraGeometry, anchor_positions, anchor_weights
from mitsim.optics.diffraction import Spectrum
from mitsim.optics.frames import Ambient, ClassFrames, ExpectedFrames, FrameOptics, Indirect
from mitsim.scene.plan import Settings
from mitsim.transport.cells import CellGrid, aligned_grid
from mitsim.transport.factored import Paths, Tracer
from mitsim.transport.histogram import DIRECT, INDIRECT, Bundle, Deposits

FloatArray = npt.NDArray[np.float64]
Labels = npt.NDArray[np.int64]
AMBIENT_NM, AMBIENT_BANDS = (400.0, 700.0), 13
"""Ambient light: a flat spectrum of photons over this range, in so many bands."""


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
        self.bundle = Bundle(
            self._grid(pixels, settings.subdivision), settings.anchors, settings.depths, settings.linear
        )

    def _grid(self, pixels: int, subdivision: int) -> CellGrid:
        windows = self.bench.windows_at(self.settings.depth)
        stop = self.geometry.tan_half_fov
        return aligned_grid(*windows, pixels, subdivision, stop, multiple=subdivision)

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
        """The mask's shadow in the projector's light."""
        return self._optics(self.bench.spectrum, self.bundle)

    @cached_property
    def ambient_optics(self) -> FrameOptics:
        """The mask's shadow in the light of other lamps."""
        return self._optics(_bands(*AMBIENT_NM, AMBIENT_BANDS), self.bundle)

    def _optics(self, spectrum: Spectrum, bundle: Bundle) -> FrameOptics:
        waves = spectrum if self.waves else None
        return FrameOptics(self.geometry, bundle.rows, bundle.columns, bundle.depths, bundle.anchors, waves)

    def file(self, found: Deposits, labels: Labels, samples: int) -> sparse.csr_array:
        """(classes + 1, places) light of every class, indirect light apart, and ambient light [W m^-2]."""
        return self.bundle.file(found.where(found.order != INDIRECT), labels, samples)

    def file_indirect(self, found: Deposits, labels: Labels, samples: int) -> sparse.csr_array:
        """(classes, places) indirect light of every class [W m^-2]."""
        return self.indirect.file(found.where(found.order == INDIRECT), labels, samples)[:-1]

    @cached_property
    def indirect(self) -> Bundle:
        """How indirect light is filed: it is smooth, and a small part of the light can do with coarser cells."""
        if not self.settings.coarse_indirect:
            return self.bundle
        return Bundle(self.aim, self.settings.anchors, (self.settings.depth,), False)

    @cached_property
    def indirect_optics(self) -> FrameOptics:
        """The mask's shadow for indirect light."""
        return self._optics(self.bench.spectrum, self.indirect) if self.settings.coarse_indirect else self.optics

    def flux(self, found: Deposits, samples: int) -> FloatArray:
        """(n^2,) irradiance of each projector pixel's direct light on the sensor, its mean, without the mask."""
        edges = self.geometry.pixel_edges
        centres = (edges[:-1] + edges[1:]) / 2
        positions = anchor_positions(self.settings.anchors, self.geometry.half_width)
        mean = anchor_weights(positions, centres).mean(axis=0)
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
        self,
        groups: Sequence[sparse.csr_array],
        indirect: Sequence[sparse.csr_array],
        rows: Labels,
        weights: FloatArray,
        seed: int,
        exact: ClassFrames | None = None,
    ) -> ExpectedFrames:
        """Frames of the captures ``weights`` (captures, classes) from :meth:`file` and :meth:`file_indirect`.

        ``rows`` maps the groups' rows to classes.
        """
        first = len(rows)
        emitted = self.black + (1 - self.black) * weights
        ambient, more = None, None
        if self.lit_by_lamps:
            ambient = Ambient(self.ambient_optics, tuple(group[first:] for group in groups))
        if any(group.nnz for group in indirect):
            more = Indirect(self.indirect_optics, tuple(indirect))
        direct = [group[:first] for group in groups]
        return ExpectedFrames(self.optics, direct, rows, emitted, seed, ambient, exact, more)

    @property
    def lit_by_lamps(self) -> bool:
        """Whether ambient light is simulated."""
        return "ambient" in self.settings.effects and bool(self.bench.loaded.lamps)


def _bands(low_nm: float, high_nm: float, count: int) -> Spectrum:
    """Equal photons in ``count`` bands between two wavelengths, each taken at its centre."""
    edges = np.linspace(low_nm, high_nm, count + 1)
    return Spectrum((edges[:-1] + edges[1:]) / 2, np.full(count, 1 / count))
