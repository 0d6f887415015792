"""Pattern families compared on one scene: sampled light and calibrated factors in, images and their quality out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mitsim.capture.bench import Bench
from mitsim.capture.exposer import Exposer
from mitsim.capture.light import Light
from mitsim.capture.plan import Plan
from mitsim.capture.request import Exposure
from mitsim.capture.run import board_flux
from mitsim.core.arrays import FloatArray, Progress
from mitsim.core.parallel import single_threaded_blas
from mitsim.optics.frames import ExpectedFrames
from mitsim.reconstruct.accumulator import Accumulator
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.solver import Prepared, prepare
from mitsim.rig.patterns import PatternFamily
from mitsim.sensor.chain import Digital, electrons_from_irradiance
from mitsim.study.ideal import ideal_factors, ideal_light
from mitsim.study.metrics import psnr, ssim
from mitsim.study.report import FamilyResult, Recovery

CONVENTIONS = ("equal peak", "equal frame", "equal total")


class Comparison:
    """Reconstructions of any family from the same light, with the same sensor, judged against the same truth.

    Exposure conventions (DESIGN section 5): *equal peak* exposes each family so that its brightest pixel fills the same
    part of the full well; *equal frame* gives every frame the exposure of uniform light; *equal total* shares that
    exposure among the family's frames.
    """

    def __init__(
        self,
        bench: Bench,
        light: Light,
        factors: Factors,
        truth: FloatArray,
        plan: Plan,
        seed: int,
        progress: Progress,
    ) -> None:
        """``light`` is the scene's, ``truth`` (n, n) its apparent reflectance; the board's light is sampled here."""
        self.bench, self.light, self.truth, self.seed, self.progress = bench, light, truth, seed, progress
        self.factors = factors.left, factors.right
        flux = float(board_flux(bench, plan, seed).mean())
        self.ideal = ideal_light(bench, truth, flux)
        rate = float(electrons_from_irradiance(1.0, 1.0, bench.sensor, bench.projector.effective_wavelength_nm))
        self.ideal_factors = ideal_factors(bench, flux, rate)
        self.uniform_s = self._peak_time(self._expected(light, bench.family("uniform")))

    def family(self, name: str, label: str) -> tuple[FamilyResult, dict[str, float]]:
        """Both reconstructions at equal peak, and the PSNR [dB] of the rendered one under each exposure convention."""
        family = self.bench.family(name, self.seed)
        rendered, ideal = self._expected(self.light, family), self._expected(self.ideal, family)
        model, ideal_model = self._model(family, self.factors), self._model(family, self.ideal_factors)
        peak = self._peak_time(rendered)
        at_peak = self._recovery(family, rendered, model, peak, self.seed)
        found = {CONVENTIONS[0]: at_peak.psnr_db}
        for convention, time in zip(
            CONVENTIONS[1:], (self.uniform_s, self.uniform_s / len(family.captures)), strict=True
        ):
            same = time == peak
            found[convention] = (at_peak if same else self._recovery(family, rendered, model, time, self.seed)).psnr_db
        self.progress(label, 1.0)
        shown = family.captures[0], family.captures[len(family.captures) * 2 // 5]
        singular = np.sort(model.left.singular**2)[::-1]
        result = FamilyResult(
            name=name,
            label=label,
            captures=len(family.captures),
            patterns=tuple(family.light(one) for one in dict.fromkeys(shown)),
            singular_values=singular / singular[0],
            idealised=self._recovery(family, ideal, ideal_model, self._peak_time(ideal), self.seed + 1),
            rendered=at_peak,
        )
        return result, found

    def frame(self, name: str, index: int) -> Digital:
        """One noisy frame of a family at equal peak [DN]."""
        family = self.bench.family(name, self.seed)
        expected = self._expected(self.light, family)
        exposer = Exposer(self.bench, self._peak_time(expected), self.seed)
        frame = next(frame for number, frame in enumerate(expected) if number == index)
        return exposer.digital(exposer.electrons(frame), *family.captures[index].names)

    def _recovery(
        self, family: PatternFamily, expected: ExpectedFrames, model: Prepared, exposure_s: float, seed: int
    ) -> Recovery:
        (frames,) = accumulate(Exposer(self.bench, exposure_s, seed), family, expected, [model])
        solution = model.solve(frames, "auto")
        return Recovery(
            solution.image,
            psnr(solution.image, self.truth),
            ssim(solution.image, self.truth),
            solution.lam,
            str(solution.status),
        )

    def _model(self, family: PatternFamily, factors: tuple[FloatArray, FloatArray]) -> Prepared:
        return prepare(*factors, family.left, family.right, centre=self.bench.geometry.mask == "flatcam")

    def _expected(self, light: Light, family: PatternFamily) -> ExpectedFrames:
        return light.merged().frames(family.lighting, self.seed)

    def _peak_time(self, expected: ExpectedFrames) -> float:
        return peak_time(self.bench, expected)


def peak_time(bench: Bench, expected: ExpectedFrames) -> float:
    """Exposure time [s] of a family at equal peak: its brightest pixel fills the default part of the full well."""
    return Exposure().choose(bench, max(float(frame.irradiance.max()) for frame in expected))


def accumulate(
    exposer: Exposer, family: PatternFamily, expected: ExpectedFrames, models: Sequence[Prepared]
) -> list[Accumulator]:
    """One noisy exposure of a family's frames, added up for each model."""
    sums = [model.accumulator() for model in models]
    with single_threaded_blas():
        for measurement, row, column in exposer.measurements(family, expected):
            for frames in sums:
                frames.add(measurement, row, column)
    return sums
