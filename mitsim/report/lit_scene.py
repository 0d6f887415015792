"""Exposures of a scene under any pattern family, and the images that they give, for comparisons in studies.

The *rendered* model uses the traced light and calibrated factors. The *idealised* model is the paper's: a planar scene
that is lit evenly, and a geometric shadow of one separable term. Reflectance, exposure and noise are equal. *Equal
peak* fills the same part of the full well with each family's brightest pixel, *equal frame* gives every frame the
exposure of uniform light, and *equal total* shares that exposure among the family's frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Literal

import numpy as np
from scipy import sparse

from mitsim.acquire.exposure import Exposer, peak_irradiance, taken_off, takes_ambient_frame
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.request import Exposure
from mitsim.calibrate.board_session import DARK, READ, ROUNDING, SHOT
from mitsim.core.arrays import FloatArray, single_threaded_blas
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask import CameraMask
from mitsim.devices.patterns import PatternFamily
from mitsim.devices.projector import Spectrum
from mitsim.light.light import SampledLight
from mitsim.metrics import Quality, psnr
from mitsim.optics.frames import AccumulatedLight, ExpectedFrames
from mitsim.optics.image_formation import FrameOptics
from mitsim.optics.shadow import Directions, SeparableTerms
from mitsim.optics.terms import best_term, centre_terms, shadow_terms
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.solver import Accumulator, Prepared, Solution, prepare
from mitsim.report import EQUAL_PEAK, EQUAL_TOTAL, IDEALISED, RENDERED
from mitsim.sensor.chain import electrons_from_irradiance, response_variance

# -------- Light of a scene and a camera in

NONUNIFORMITY, SPECKLE = "response nonuniformity", "speckle"
"""Names of noise sources beside those of :mod:`mitsim.calibrate.board_session`."""
DIM_E = 5600
"""Electrons of the brightest pixel that give the paper's 22.8 and 34.8 dB of uniform light and 49 dots at 2000 um."""
DIM = f"a peak of {DIM_E} electrons"
LAMBDAS = tuple(float(relative) for relative in np.logspace(-14, 0, 57))
"""Lambdas relative to the largest sigma^2 for a search with the truth."""


class LitScene:
    def __init__(self, light: SampledLight) -> None:
        self.light, self.bench = light, light.bench
        self.uniform_s = cache(self._uniform_s)

    @property
    def truth(self) -> FloatArray:
        return self.light.truth

    def quality(self, image: FloatArray) -> Quality:
        return Quality.of(image, self.truth, self.light.apparent.error)

    def expected_frames(
        self, model: str, family: PatternFamily, plane: Plane | None = None, bench: Apparatus | None = None
    ) -> ExpectedFrames:
        """Return frames without noise, of one of :data:`mitsim.report.MODELS`.

        ``plane`` is the place of an idealised scene, None for the calibrated one; ``bench`` may have another mask.
        """
        if model == RENDERED:
            light = self._merged if bench is None else self._merged.behind(bench)
            return light.frames(family.lighting, self.light.seed)
        camera = self._ideal if bench is None else IdealCamera(bench, bench.geometry.mask)
        return camera.frames(family, self.truth * self.board_flux, plane)

    def rendered_frames(self, factors: Factors, family: PatternFamily, seed: int) -> Unexposed:
        sides = factors.left, factors.right
        return Unexposed(self, RENDERED, family, sides, factors.manifest.centre, seed)

    def idealised_frames(self, family: PatternFamily, seed: int, plane: Plane | None = None) -> Unexposed:
        """Return frames of the paper's model with its own factors; their noise differs from that of rendered frames."""
        camera = self._ideal
        return Unexposed(self, IDEALISED, family, camera.calibrated(self.board_flux), camera.centre, seed + 1, plane)

    def _uniform_s(self, model: str) -> float:
        return peak_time(self.bench, self.expected_frames(model, self.bench.family("uniform")))

    @cached_property
    def _merged(self) -> SampledLight:
        return self.light.merge()

    @cached_property
    def _ideal(self) -> IdealCamera:
        return IdealCamera(self.bench, self.bench.geometry.mask)

    @property
    def board_flux(self) -> float:
        """Return the irradiance by a pixel of a white board without the mask [W m^-2]."""
        return float(self.light.apparent.board_flux.mean())


@dataclass(frozen=True, eq=False)
class Unexposed:
    """Frames of a scene before any exposure, and the factors that solve them.

    ``centre`` is True where means are subtracted from frames; ``plane`` is that of an idealised scene, None for that of
    the factors.
    """

    lit: LitScene
    model: str
    family: PatternFamily
    sides: tuple[FloatArray, FloatArray]
    centre: bool
    seed: int
    plane: Plane | None = None

    @cached_property
    def expected(self) -> ExpectedFrames:
        return self.lit.expected_frames(self.model, self.family, self.plane)

    def seconds(self, exposure: str) -> float:
        if exposure in (EQUAL_PEAK, DIM):
            peak_e = Exposure().fraction * self.lit.bench.sensor.superpixel_full_well_e
            return peak_time(self.lit.bench, self.expected) * (DIM_E / peak_e if exposure == DIM else 1.0)
        return self.lit.uniform_s(self.model) / (len(self.family.shots) if exposure == EQUAL_TOTAL else 1)

    def prepare(self, binning: int = 1) -> Prepared:
        rows, columns = (len(side) for side in self.sides)
        if rows % binning or columns % binning:
            raise MitsimError(
                f"frames of {rows} x {columns} pixels: cannot be averaged {binning} x {binning}; give the scene's film "
                f"multiples of {binning}"
            )
        left, right = (side.reshape(-1, binning, side.shape[1]).mean(axis=1) for side in self.sides)
        return prepare(left, right, self.family.left, self.family.right, centre=self.centre)

    def data(self, seconds: float, binning: int = 1) -> tuple[Prepared, Accumulator]:
        model = self.prepare(binning)
        (sums,) = accumulate(self.exposer(seconds), self.family, self.expected, [model], binning)
        return model, sums

    def solve(self, seconds: float, lam: float | Literal["auto", "best"] = "auto", binning: int = 1) -> Solution:
        """Solve one exposure of ``seconds`` a frame; ``lam="best"`` uses the truth and :data:`LAMBDAS`."""
        model, sums = self.data(seconds, binning)
        if lam != "best":
            return model.solve(sums, lam)
        scale, truth = model.problem(sums).scale, self.lit.truth
        return max((model.solve(sums, scale * each) for each in LAMBDAS), key=lambda one: psnr(one.image, truth))

    @single_threaded_blas()
    def clear(self, lam: float) -> FloatArray:
        model, exposer, expected = self.prepare(), self.exposer(1.0), self.expected
        off = exposer.electrons(expected.projector_off) if takes_ambient_frame("auto", self.family, expected) else 0.0
        sums, positive = model.accumulator(), np.zeros(())
        for shot, frame in zip(self.family.shots, expected, strict=True):
            rate = exposer.electrons(frame) - off
            if shot.sign == 1:
                positive = rate
            else:
                sums.add(positive - rate if shot.sign else rate, shot.row, shot.column)
        return model.solve(sums, lam).image

    def exposer(self, seconds: float) -> Exposer:
        speckle = self.lit.light.speckle(self.family) if self.model == RENDERED else 0.0
        return Exposer(self.lit.bench.devices, seconds, self.seed, speckle)

    def noise(self, seconds: float) -> float:
        return float(np.sqrt(sum(self.noises(seconds).values())))

    def noises(self, seconds: float) -> dict[str, float]:
        """Return the variance of a datum [(electrons/s)^2] by source.

        Differences between the pixels' responses count as noise because the factors lack them.
        """
        exposer, sensor = self.exposer(seconds), self.lit.bench.sensor
        light = [exposer.electrons(frame) for frame in self.expected]
        square = float(np.mean([np.square(frame).mean() for frame in light]))
        parts = {
            SHOT: float(np.mean([frame.mean() for frame in light])),
            DARK: sensor.superpixel_dark_current_e_per_s * seconds,
            READ: sensor.superpixel_reading_noise_e**2,
            ROUNDING: 0.0 if sensor.largest_dn is None else 1 / (12 * sensor.gain_dn_per_e**2),
            NONUNIFORMITY: response_variance(sensor) * square,
            SPECKLE: exposer.speckle**2 * square,
        }
        return {name: variance / seconds**2 for name, variance in parts.items()}


def peak_time(bench: Apparatus, expected: ExpectedFrames) -> float:
    return Exposure().choose(bench.devices, peak_irradiance(expected))


def bin_frame(frame: FloatArray, binning: int) -> FloatArray:
    if binning == 1:
        return frame
    rows, columns = (size // binning for size in frame.shape)
    return np.asarray(frame.reshape(rows, binning, columns, binning).mean(axis=(1, 3)))


def accumulate(
    exposer: Exposer, family: PatternFamily, expected: ExpectedFrames, models: Sequence[Prepared], binning: int = 1
) -> list[Accumulator]:
    sums = [model.accumulator() for model in models]
    with single_threaded_blas():
        ambient = taken_off(exposer, family, expected)
        for measurement, row, column in exposer.measurements(family, expected):
            frame = bin_frame(measurement - ambient, binning)
            for each in sums:
                each.add(frame, row, column)
    return sums


# -------- The paper's idealised camera


Pair = tuple[FloatArray, FloatArray]
"""Left and right factor, (pixels, n) each."""


@dataclass(frozen=True)
class Plane:
    """A plane scene at ``depth_mm``, lit from ``baseline_mm`` beside the camera."""

    depth_mm: float
    baseline_mm: tuple[float, float]


@dataclass(frozen=True, eq=False)
class IdealCamera:
    """The idealised camera of a ``bench``; a ``spectrum`` of None has no diffraction."""

    bench: Apparatus
    mask: CameraMask
    spectrum: Spectrum | None = None

    @property
    def centre(self) -> bool:
        return self._geometry.centred

    @cached_property
    def terms(self) -> SeparableTerms:
        distance = self.bench.geometry.scene_distance
        return shadow_terms(self._geometry, *self.directions, distance, self.spectrum)

    @cached_property
    def factors(self) -> Pair:
        best = best_term(centre_terms(self.terms) if self.centre else self.terms)
        return best.left, best.right

    def calibrated(self, board_flux: float) -> Pair:
        """Return the factors in a calibration's unit [sqrt(electrons / s)]."""
        model = self.bench.projector
        rate = electrons_from_irradiance(board_flux, 1.0, self.bench.sensor, model.effective_wavelength_nm)
        left, right = self.factors
        return left * np.sqrt(rate), right * np.sqrt(rate)

    def frames(self, family: PatternFamily, flux: FloatArray, plane: Plane | None = None) -> ExpectedFrames:
        light = sparse.csr_array(sparse.diags_array(flux.ravel()))
        if plane is None:
            optics = self._optics
        else:
            shift = 1 / plane.depth_mm - 1 / self.bench.geometry.scene_distance
            rows, columns = (
                Directions(pixels.centres + baseline * shift, pixels.width)
                for pixels, baseline in zip(self.directions, plane.baseline_mm, strict=True)
            )
            optics = FrameOptics(self._geometry, rows, columns, (plane.depth_mm,), 1, self.spectrum)
        return ExpectedFrames([AccumulatedLight(optics, (light,))], family.lighting, seed=0)

    @property
    def _geometry(self) -> CameraGeometry:
        return self.bench.geometry.model_copy(update={"mask": self.mask})

    @property
    def directions(self) -> tuple[Directions, Directions]:
        rows, columns = (Directions.cells(np.linspace(*edges, self.bench.n + 1)) for edges in self.bench.windows)
        return rows, columns

    @cached_property
    def _optics(self) -> FrameOptics:
        return FrameOptics(self._geometry, *self.directions, (self.bench.geometry.scene_distance,), 1, self.spectrum)
