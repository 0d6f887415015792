"""Pattern families compared on one scene: its light and a camera's factors in, images and their quality out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mitsim.capture.ambient import taken_off
from mitsim.capture.bench import Bench
from mitsim.capture.exposer import Exposer, peak_irradiance
from mitsim.capture.light import Light
from mitsim.capture.request import Exposure
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import Capture
from mitsim.optics.frames import ExpectedFrames
from mitsim.reconstruct.accumulator import Accumulator
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruction import reconstruct
from mitsim.reconstruct.solver import Prepared, prepare
from mitsim.rig.patterns import PatternFamily
from mitsim.sensor.chain import Digital
from mitsim.study.ideal import IdealCamera
from mitsim.study.metrics import Quality
from mitsim.study.report import FamilyResult, Recovery
from mitsim.study.trust import Trust

CONVENTIONS = ("equal peak", "equal frame", "equal total")
_SECOND_SHOWN = 0.4
"""Part of a family's shots after which its second example of a pattern comes, so that it is neither like the first nor
its mirror image."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Reconstructions of any family in the same light, with the same sensor, judged against the same truth.

    Exposure conventions: *equal peak* exposes each family so that its brightest pixel fills the same part of the full
    well; *equal frame* gives every frame the exposure of uniform light; *equal total* shares that exposure among the
    family's frames.

    ``light`` is the scene's, by projector pixel, ``factors`` the camera's.
    """

    light: Light
    factors: Factors

    def family(self, name: str, shots: Capture | None = None) -> FamilyResult:
        """Both reconstructions of the family ``name`` at equal peak, the rendered one with how far to trust it, and its
        PSNR [dB] under each exposure convention.

        Parameters
        ----------
        name
            of the family; MitsimError when it does not fit the projector.
        shots
            of it at equal peak, where they were taken already.
        """
        bench, seed = self.light.bench, self.light.seed
        family = bench.family(name, seed)
        expected = self._merged.frames(family.lighting, seed)
        factors, sides = self.factors, (family.left, family.right)
        model = prepare(factors.left, factors.right, *sides, centre=factors.manifest.centre)
        times = dict(
            zip(
                CONVENTIONS,
                (peak_time(bench, expected), self._uniform_s, self._uniform_s / len(family.shots)),
                strict=True,
            )
        )
        rendered = {times[CONVENTIONS[0]]: self._trusted(shots or self.light.expose(name))}
        for time in times.values():
            if time not in rendered:
                rendered[time] = self._recovery(self._exposer(time), family, expected, model)
        singular = np.sort(model.left.singular**2)[::-1]
        examples = family.shots[0], family.shots[int(len(family.shots) * _SECOND_SHOWN)]
        return FamilyResult(
            name=name,
            label=label(name),
            shots=len(family.shots),
            patterns=tuple(family.light(shot) for shot in dict.fromkeys(examples)),
            singular_values=singular / singular[0],
            idealised=self._idealised(family),
            rendered=rendered[times[CONVENTIONS[0]]],
            by_exposure={convention: rendered[time].quality.psnr_db for convention, time in times.items()},
        )

    def white(self) -> Digital:
        """The noisy frame of uniform light at equal peak [DN]."""
        (shot,), (frame,) = self.light.bench.family("uniform").shots, self._uniform
        exposer = self._exposer(self._uniform_s)
        return exposer.digital(exposer.lit(frame, *shot.names), *shot.names)

    @cached_property
    def _merged(self) -> Light:
        return self.light.merged()

    @cached_property
    def _ideal(self) -> IdealCamera:
        return IdealCamera(self.light.bench, self.light.bench.geometry.mask)

    @cached_property
    def _uniform(self) -> ExpectedFrames:
        return self._merged.frames(self.light.bench.family("uniform").lighting, self.light.seed)

    @cached_property
    def _uniform_s(self) -> float:
        return peak_time(self.light.bench, self._uniform)

    def _exposer(self, seconds: float) -> Exposer:
        return Exposer(self.light.bench.rig, seconds, self.light.seed, self.light.simulation.physics.speckle)

    def _idealised(self, family: PatternFamily) -> Recovery:
        """The paper's model of the same scene, with noise of its own."""
        camera, flux = self._ideal, float(self.light.apparent.board_flux.mean())
        expected = camera.frames(family, self.light.truth * flux)
        exposer = Exposer(camera.bench.rig, peak_time(camera.bench, expected), self.light.seed + 1)
        model = prepare(*camera.calibrated(flux), family.left, family.right, centre=camera.centre)
        return self._recovery(exposer, family, expected, model)

    def _trusted(self, shots: Capture) -> Recovery:
        """As a user's own frames are reconstructed."""
        image = reconstruct(shots, self.factors)
        quality = Quality.of(image.image, self.light.truth, self.light.apparent.error)
        # What the capture and the calibration are flagged for is in the report's notes, once for all families.
        status = replace(image.status, flags=())
        return Recovery(image.image, quality, image.lam, str(status), Trust.of(image, self.light.truth))

    def _recovery(self, exposer: Exposer, family: PatternFamily, expected: ExpectedFrames, model: Prepared) -> Recovery:
        (sums,) = accumulate(exposer, family, expected, [model])
        solution = model.solve(sums, "auto")
        quality = Quality.of(solution.image, self.light.truth, self.light.apparent.error)
        return Recovery(solution.image, quality, solution.lam, str(solution.status))


def label(name: str) -> str:
    """What people call the patterns ``name``, such as "49 dots" for ``dots:7`` and "7 x 14 dots" for ``dots:7x14``."""
    kind, _, size = name.partition(":")
    count = size.replace("x", " x ") if "x" in size else size and str(int(size) ** 2)
    return f"{count} {'Hadamard' if kind == 'hadamard' else kind}" if count else kind.capitalize()


def peak_time(bench: Bench, expected: ExpectedFrames) -> float:
    """Exposure time [s] on ``bench`` at equal peak: the brightest pixel of the ``expected`` frames fills the default
    part of the full well."""
    return Exposure().choose(bench.rig, peak_irradiance(expected))


def accumulate(
    exposer: Exposer, family: PatternFamily, expected: ExpectedFrames, models: Sequence[Prepared]
) -> list[Accumulator]:
    """One noisy exposure of a family's frames, ambient light taken off where there is some, added up for each model.

    Parameters
    ----------
    exposer, family, expected, models
        the camera and its exposure, patterns, their frames without noise, and what these are to be solved with.
    """
    sums = [model.accumulator() for model in models]
    with single_threaded_blas():
        ambient = taken_off(exposer, family, expected)
        for measurement, row, column in exposer.measurements(family, expected):
            for each in sums:
                each.add(measurement - ambient, row, column)
    return sums
