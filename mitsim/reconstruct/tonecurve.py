"""Shots in; the tone curve out without which their light fits an image with the noise that its sensor makes.

Curves are compared by the likelihood of the numbers as they were read (Box and Cox, 1964): where light is g(y) of
numbers y, -2 log L = n log s + sum log v - 2 sum log g'(y) but for a constant, with v the variance of noise in that
light, and s what the model leaves in units of it. A curve counts that is likelier than none, and of which s is 1:
numbers that are crushed to 0 fit any image, but with less noise than the sensor makes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.manifests import RunManifest
from mitsim.core.measurement import Measurement
from mitsim.reconstruct.solver import Prepared

_NOISE = 0.1
"""Of the sensor's noise, by which what is left of linear light may differ: chosen, neighbours among the curves differ
by twice that."""
_LEAST = 1e-4
"""Of the range, the least number whose slope counts, one of 13 bits: that of a power is 0 or infinite at 0."""
_TINY = float(np.finfo(np.float64).tiny)

Curve = tuple[Callable[[FloatArray], FloatArray], Callable[[FloatArray], FloatArray]]
"""Light of numbers, both 0 to 1, and its slope."""


def _power(exponent: float) -> Curve:
    return lambda number: number**exponent, lambda number: exponent * number ** (exponent - 1)


_SRGB: Curve = (
    lambda number: np.where(number <= 0.04045, number / 12.92, ((number + 0.055) / 1.055) ** 2.4),
    lambda number: np.where(number <= 0.04045, 1 / 12.92, 2.4 / 1.055 * ((number + 0.055) / 1.055) ** 1.4),
)
_CURVES = {
    "the numbers follow the curve of sRGB": _SRGB,
    **{f"the numbers are the light to the power of 1/{exponent:g}": _power(exponent) for exponent in (1.8, 2.2, 2.4)},
}
"""By which displays and files encode light; that of sRGB after IEC 61966-2-1."""


@dataclass(frozen=True, eq=False)
class ToneCurves:
    """Tone curves of a run.

    Attributes
    ----------
    prepared
        the factorised model.
    manifest
        of the run, which states the sensor's noise.
    measured
        reads all measurements once more.
    """

    prepared: Prepared
    manifest: RunManifest
    measured: Callable[[], Iterable[Measurement]]

    def likeliest(self) -> str:
        """The curve that the numbers went through, in words; empty where they are as likely without, or where the
        sensor's noise is not stated."""
        if not self.manifest.digital.noise_is_stated:
            return ""
        _, most = self._held(_power(1.0))
        fits: dict[str, float] = {}
        for words, curve in _CURVES.items():
            spreads, unlikely = self._held(curve)
            away = max(abs(spread - 1) for spread in spreads)
            if away < _NOISE and unlikely < most:
                fits[words] = away
        return min(fits, key=lambda words: fits[words], default="")

    def _held(self, curve: Curve) -> tuple[list[float], float]:
        """What is left of linear light in units of the noise, and -2 log L: of measurements, and of signed patterns of
        the sums of their halves, which are all alike."""
        digital, (light, slope) = self.manifest.digital, curve
        dark, top = digital.dark_current_e_per_s, digital.saturation_dn
        peak = float(digital.rate(np.array(top))) if top else max(float(each.light.max()) for each in self.measured())
        peak = max(peak + dark, _TINY)

        def linear(read: FloatArray) -> FloatArray:
            part = (read + dark) / peak  # the curve is of dark current as well
            return np.asarray(peak * np.sign(part) * light(np.abs(part)) - dark)

        sums = self.prepared.accumulator()
        total, energy, noise, logarithms, count = np.zeros(()), 0.0, 0.0, 0.0, 0
        for each in self.measured():
            pair = ((each.light + each.frame) / 2, (each.light - each.frame) / 2) if each.shots == 2 else (each.light,)
            halves = [linear(read) for read in pair]
            both = np.asarray(sum(halves))
            frame = halves[0] - halves[1] if each.shots == 2 else both
            if each.shots == 1 and each.frame is not each.light:
                frame = both - linear(each.light - each.frame)  # of the ambient frame
            sums.add(frame, each.row, each.column)
            variance = float(np.maximum(digital.variance(both, each.shots), _TINY).mean())
            total, energy, count = total + both, energy + float(np.vdot(both, both)), count + 1
            noise += variance * frame.size
            logarithms += each.shots * frame.size * np.log(variance)
            for read in pair:
                logarithms -= 2 * float(np.log(slope(np.maximum(np.abs(read + dark) / peak, _LEAST))).sum())
        problem = self.prepared.problem(sums)
        explained = float(np.square(problem.projected[problem.sigma > 0]).sum())
        spreads = [(problem.energy - explained) / (noise * self.prepared.spare)]
        if each.shots == 2 and count > 1:
            spreads.append((energy - float(np.vdot(total, total)) / count) / (noise * (1 - 1 / count)))
        numbers = count * total.size
        return spreads, sum(numbers * float(np.log(max(spread, _TINY))) for spread in spreads) + logarithms
