"""One bench under one choice of settings: what is traced, how light is filed, which shadow the mask casts.

An effect that is off takes its neutral value here and nowhere else: a pinhole for the lens, a thin mask, a geometric
shadow. :mod:`mitsim.capture.pilot` switches effects on and off to see what they are worth; :mod:`mitsim.capture.light`
samples the choice that the plan made.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from mitsim.capture.bench import Bench
from mitsim.capture.evidence import Settings
from mitsim.core.arrays import FloatArray, Labels
from mitsim.optics.anchors import anchor_positions, anchor_weights
from mitsim.optics.frames import ClassFrames, ExpectedFrames, Filed, FrameOptics
from mitsim.rig.camera import CameraGeometry
from mitsim.rig.patterns import Lighting
from mitsim.rig.projector import Spectrum
from mitsim.transport.camera_side import CameraTracer, Paths
from mitsim.transport.cells import CellGrid, aligned_grid
from mitsim.transport.direct import DirectTracer
from mitsim.transport.histogram import DIRECT, INDIRECT, Bundle, Deposits
from mitsim.transport.indirect import IndirectTracer
from mitsim.transport.source import Projector

AMBIENT_NM, AMBIENT_BANDS = (400.0, 700.0), 13
"""Ambient light: a flat spectrum of photons over this range, in so many bands."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """One estimate of the light of a scene, (classes + 1, places) each, the last row ambient light [W m^-2].

    ``fine`` is what the sensor sees on average, in fine cells and layers; ``coarse`` is what each anchor sees beyond
    that, and ``smooth`` is indirect light: small or smooth, so coarse cells hold them well.
    """

    fine: sparse.csr_array
    coarse: sparse.csr_array
    smooth: sparse.csr_array

    def __add__(self, other: Estimate) -> Estimate:
        return Estimate(self.fine + other.fine, self.coarse + other.coarse, self.smooth + other.smooth)

    def __truediv__(self, count: float) -> Estimate:
        return Estimate(self.fine / count, self.coarse / count, self.smooth / count)


@dataclass(frozen=True)
class Stage:
    """A tracer, the samples of it that the plan predicted, and how its light is filed (deposits, labels, samples)."""

    tracer: DirectTracer | IndirectTracer | CameraTracer
    predicted: float
    file: Callable[[Deposits, Labels, int], Estimate]


class Simulation:
    """A bench with settings; its parts are prepared when they are first asked for."""

    def __init__(self, bench: Bench, settings: Settings, pixels: int | None = None) -> None:
        """``pixels``: cells a side of the projector's window, instead of one a pixel."""
        self.bench, self.settings = bench, settings
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
        self.bundle = Bundle(self._grid(pixels, settings.subdivision), 1, settings.depths)
        depths = settings.depths if settings.coarse_layers else (settings.depth,)
        self.coarse = Bundle(self._grid(pixels, settings.coarse_cells), settings.anchors, depths)
        self.smooth = replace(self.coarse, anchors=1)

    def _grid(self, pixels: int, subdivision: int) -> CellGrid:
        """Cells as far as the sensor's edge sees through the field stop: directions are those from its centre.

        The same for any number of anchors and layers, so that their light can be compared.
        """
        windows = self.bench.windows_at(self.settings.depth)
        reach = self.geometry.tan_half_fov + self.geometry.half_width / self.settings.depth
        return aligned_grid(*windows, pixels, subdivision, reach)

    @cached_property
    def source(self) -> Projector:
        """The projector, ideal but for the effects that are on."""
        on, source = self.settings.effects, self.bench.source
        source = source if "aperture" in on else replace(source, aperture=0.0)
        return source if "blur" in on else replace(source, blur=0.0)

    @cached_property
    def direct(self) -> DirectTracer:
        """Follows direct light from the projector to the sensor's centre, or to all of it where anchors are used."""
        loaded, spread = self.bench.loaded, self.settings.anchors > 1
        return DirectTracer(loaded.scene, loaded.camera, self.source, 1, self.geometry, spread)

    @cached_property
    def anchored(self) -> DirectTracer | None:
        """The same to every anchor."""
        loaded, anchors = self.bench.loaded, self.settings.anchors
        return DirectTracer(loaded.scene, loaded.camera, self.source, anchors, self.geometry) if anchors > 1 else None

    @cached_property
    def indirect(self) -> IndirectTracer | None:
        """Follows light over several surfaces from the projector to the sensor's centre; none where there is none."""
        loaded, more = self.bench.loaded, (self._over_mirrors, "interreflection" in self.settings.effects)
        return IndirectTracer(loaded.scene, loaded.camera, self.source, *more, self.geometry) if any(more) else None

    @cached_property
    def other(self) -> CameraTracer | None:
        """Follows all other light from the sensor's centre; none where there is none."""
        loaded, bounces = self.bench.loaded, "interreflection" in self.settings.effects
        emitters = loaded.lamps if self.lit_by_lamps else ()
        if not (emitters or self._over_mirrors or (bounces and loaded.glossy)):
            return None
        paths = Paths(self._over_mirrors, bounces, emitters)
        return CameraTracer(loaded.scene, loaded.camera, self.source, self.aim, paths, self.geometry)

    def followed(self, seed: int, samples: int) -> Deposits:
        """Light of :attr:`indirect` and :attr:`other` in as many samples of each, for :meth:`file_other`."""
        tracers = [tracer for tracer in (self.indirect, self.other) if tracer is not None]
        return Deposits.joined([tracer.trace(seed, 0, samples) for tracer in tracers])

    @property
    def _over_mirrors(self) -> bool:
        return "mirrors" in self.settings.effects and self.bench.loaded.mirrors

    @cached_property
    def optics(self) -> FrameOptics:
        """The mask's shadow in the projector's light, for light filed finely."""
        return self._optics(self.bench.spectrum, self.bundle)

    @cached_property
    def coarse_optics(self) -> FrameOptics:
        """The same for light filed coarsely."""
        return self._optics(self.bench.spectrum, self.coarse)

    @cached_property
    def smooth_optics(self) -> FrameOptics:
        """The same for indirect light."""
        return self._optics(self.bench.spectrum, self.smooth)

    @cached_property
    def ambient_optics(self) -> FrameOptics:
        """The mask's shadow in the light of other lamps."""
        return self._optics(_bands(*AMBIENT_NM, AMBIENT_BANDS), self.bundle)

    def _optics(self, spectrum: Spectrum, bundle: Bundle) -> FrameOptics:
        waves = spectrum if self.waves else None
        return FrameOptics(self.geometry, bundle.rows, bundle.columns, bundle.depths, bundle.anchors, waves)

    @cached_property
    def mean_weights(self) -> FloatArray:
        """(anchors,) weight of each anchor in the mean over the sensor."""
        edges = self.geometry.pixel_edges
        positions = anchor_positions(self.settings.anchors, self.geometry.half_width)
        return np.asarray(anchor_weights(positions, (edges[:-1] + edges[1:]) / 2).mean(axis=0))

    def file(self, found: Deposits, labels: Labels, samples: int) -> Estimate:
        """Light of :attr:`direct`, per sample."""
        return self._light(fine=self.bundle.file(found, labels, samples))

    def file_anchored(self, found: Deposits, labels: Labels, samples: int) -> Estimate:
        """Light of :attr:`anchored` beyond its mean over the sensor, per sample."""
        mean = self.smooth.file(found.averaged(self.mean_weights), labels, samples)
        return self._light(coarse=self.coarse.file(found, labels, samples) - self.coarse.repeated(mean))

    def file_other(self, found: Deposits, labels: Labels, samples: int) -> Estimate:
        """Light of :attr:`indirect` or :attr:`other`, per sample."""
        indirect = found.order == INDIRECT
        fine = self.bundle.file(found.where(~indirect), labels, samples)
        return self._light(fine=fine, smooth=self.smooth.file(found.where(indirect), labels, samples))

    def _light(self, **parts: sparse.csr_array) -> Estimate:
        rows = next(iter(parts.values())).shape[0]
        sizes = {"fine": self.bundle.size, "coarse": self.coarse.size, "smooth": self.smooth.size}
        return Estimate(**{name: parts.get(name, sparse.csr_array((rows, size))) for name, size in sizes.items()})

    def tracers(self) -> dict[str, Stage]:
        """What is traced: samples a group is predicted to need, and how the light is filed, by name."""
        settings = self.settings
        stages = {"direct": Stage(self.direct, settings.direct_samples, self.file)}
        if self.anchored is not None:
            stages["anchored"] = Stage(self.anchored, settings.anchored_samples, self.file_anchored)
        if self.indirect is not None:
            stages["indirect"] = Stage(self.indirect, settings.indirect_samples, self.file_other)
        if self.other is not None:
            stages["other"] = Stage(self.other, settings.other_samples, self.file_other)
        return stages

    def flux(self, found: Deposits, samples: int) -> FloatArray:
        """(n^2,) irradiance of each projector pixel's direct light on the sensor, its mean, without the mask."""
        value = found.value * (found.order == DIRECT) / samples
        return np.asarray(np.bincount(found.source, value, minlength=self.bench.n**2 + 1)[:-1], dtype=np.float64)

    def mirrored(self, labels: Labels) -> ClassFrames | None:
        """Frames of light that comes from the projector over mirrors alone, by class; None without such light.

        It is a pinhole's light, whatever the projector's lens.
        """
        if not self._over_mirrors:
            return None
        return self.bench.mirror_light.frames(labels, self.geometry, self.bench.spectrum if self.waves else None)

    @property
    def waves(self) -> bool:
        """Whether the mask's shadow is wave-optical."""
        return "diffraction" in self.settings.effects

    def expected(
        self, groups: Sequence[Estimate], rows: Labels, weights: FloatArray, seed: int, exact: ClassFrames | None = None
    ) -> ExpectedFrames:
        """Frames of the captures ``weights`` (captures, classes); ``rows`` maps the groups' rows to classes."""
        first = len(rows)
        emitted = self.black + (1 - self.black) * weights
        lights, ambient = [Filed(self.optics, tuple(group.fine[:first] for group in groups))], []
        if self.settings.anchors > 1:
            lights.append(Filed(self.coarse_optics, tuple(group.coarse[:first] for group in groups)))
        if "interreflection" in self.settings.effects:
            lights.append(Filed(self.smooth_optics, tuple(group.smooth[:first] for group in groups)))
        if self.lit_by_lamps:
            ambient.append(Filed(self.ambient_optics, tuple(group.fine[first:] for group in groups)))
        return ExpectedFrames(lights, Lighting(rows, emitted), seed, ambient, exact)

    @property
    def lit_by_lamps(self) -> bool:
        """Whether ambient light is simulated."""
        return "ambient" in self.settings.effects and bool(self.bench.loaded.lamps)


def _bands(low_nm: float, high_nm: float, count: int) -> Spectrum:
    """Equal photons in ``count`` bands between two wavelengths, each taken at its centre."""
    edges = np.linspace(low_nm, high_nm, count + 1)
    return Spectrum((edges[:-1] + edges[1:]) / 2, np.full(count, 1 / count))
