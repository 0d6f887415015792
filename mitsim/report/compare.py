"""Pattern families compared on one scene: its light and a camera's factors in, images and their quality out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mitsim.acquire.capture import expose
from mitsim.core.runs import Capture
from mitsim.devices.patterns import FAMILIES
from mitsim.light.light import SampledLight
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.report.exposures import CONVENTIONS, EQUAL_PEAK, LitScene, Unexposed
from mitsim.report.report import FamilyResult, Recovery, Trust
from mitsim.sensor.chain import Digital

_SECOND_SHOWN = 0.4
"""Part of a family's shots after which its second example of a pattern comes, so that it is neither like the first nor
its mirror image."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Reconstructions of any family in the same light, with the same sensor, judged against the same truth.

    ``light`` is the scene's, by projector pixel, ``factors`` the camera's.
    """

    light: SampledLight
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
        lit, seed = self._lit, self.light.seed
        family = lit.bench.family(name, seed)
        frames, ideal = lit.rendered(self.factors, family, seed), lit.idealised(family, seed)
        times = {convention: frames.seconds(convention) for convention in CONVENTIONS}
        rendered = {times[EQUAL_PEAK]: self._trusted(shots or expose(self.light, name))}
        for time in times.values():
            if time not in rendered:
                rendered[time] = self._recovery(frames, time)
        singular = np.sort(frames.prepared().left.singular ** 2)[::-1]
        examples = family.shots[0], family.shots[int(len(family.shots) * _SECOND_SHOWN)]
        return FamilyResult(
            name=name,
            label=label(name),
            shots=len(family.shots),
            patterns=tuple(family.light(shot) for shot in dict.fromkeys(examples)),
            singular_values=singular / singular[0],
            idealised=self._recovery(ideal, ideal.seconds(EQUAL_PEAK)),
            rendered=rendered[times[EQUAL_PEAK]],
            by_exposure={convention: rendered[time].quality.psnr_db for convention, time in times.items()},
        )

    def white(self) -> Digital:
        """The noisy frame of uniform light at equal peak [DN]."""
        frames = self._lit.rendered(self.factors, self.light.bench.family("uniform"), self.light.seed)
        (shot,), (frame,), exposer = frames.family.shots, frames.expected, frames.exposer(frames.seconds(EQUAL_PEAK))
        return exposer.digital(exposer.lit(frame, *shot.names), *shot.names)

    @cached_property
    def _lit(self) -> LitScene:
        return LitScene(self.light)

    def _trusted(self, shots: Capture) -> Recovery:
        """As a user's own frames are reconstructed."""
        image = reconstruct(shots, self.factors)
        quality = self._lit.quality(image.image)
        # What the capture and the calibration are flagged for is in the report's notes, once for all families.
        status = replace(image.status, flags=())
        return Recovery(image.image, quality, image.lam, str(status), Trust.of(image, self.light.truth))

    def _recovery(self, frames: Unexposed, seconds: float) -> Recovery:
        solution = frames.solve(seconds)
        return Recovery(solution.image, self._lit.quality(solution.image), solution.lam, str(solution.status))


def label(name: str) -> str:
    """What people call the patterns ``name``, such as "49 dots" for ``dots:7`` and "7 x 14 dots" for ``dots:7x14``."""
    kind, _, size = name.partition(":")
    count = size.replace("x", " x ") if "x" in size else size and str(int(size) ** 2)
    return f"{count} {FAMILIES[kind].label}" if count else kind.capitalize()


def in_text(name: str) -> str:
    """What people call the patterns ``name`` inside a sentence: "uniform", "49 dots", "64 Hadamard"."""
    return label(name)[:1].lower() + label(name)[1:]
