"""Shots in; the tone curve out without which their light fits an image with the noise that its sensor makes.

Curves are compared by the likelihood of the numbers as they were read (Box and Cox, 1964): where light is g(y) of
numbers y, -2 log L = n log s + sum log v - 2 sum log g'(y) but for a constant, with v the variance of noise in that
light, and s what the model leaves in units of it. A curve counts that is likelier than none, and of which s is 1:
numbers that are crushed to 0 fit any image, but with less noise than the sensor makes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.manifests import RunManifest
from mitsim.core.measurement import Measurement
from mitsim.reconstruct.accumulator import centred
from mitsim.reconstruct.solver import Prepared

_NOISE = 0.1
"""Of the sensor's noise, by which what is left of linear light may differ: chosen, neighbours among the curves differ
by twice that."""
_CHANCE = 6.0
"""Standard deviations of a frame's noise energy that are left to chance."""
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
class _Linear:
    """A measurement of linear light: its ``pattern``, the ``frame`` as the solver takes it, the ``light`` of all its
    ``shots``, the mean ``variance`` of their noise, and of each shot what was ``read``, 0 to 1."""

    pattern: tuple[int, int]
    frame: FloatArray
    light: FloatArray
    variance: float
    read: tuple[FloatArray, ...]


@dataclass(frozen=True, eq=False)
class _Held:
    """What is left in units of the noise that is expected, of the measurements and of signed patterns' sums, how many
    numbers either are, and W."""

    spreads: tuple[float, ...]
    numbers: int
    weights: FloatArray

    @property
    def away(self) -> float:
        """How far that is from the noise, as a part of it."""
        return max(abs(spread - 1) for spread in self.spreads)


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
        """The curve that the numbers went through, in words; empty where they are as likely without, where single
        frames do not fit with it, or where the sensor's noise is not stated."""
        if not self.manifest.digital.noise_is_stated:
            return ""
        fits = {words: held for words, curve in _CURVES.items() if (held := self._held(curve)).away < _NOISE}
        if fits:
            most = self._unlikely(_power(1.0), self._held(_power(1.0)))
            fits = {words: held for words, held in fits.items() if self._unlikely(_CURVES[words], held) < most}
        best = min(fits, key=lambda words: fits[words].away, default="")
        return best if best and self._fits_each(_CURVES[best]) else ""

    def _held(self, curve: Curve) -> _Held:
        """All measurements against the model, and of signed patterns the sums of their halves, which are all alike."""
        sums, total, energy, noise, count = self.prepared.accumulator(), np.zeros(()), 0.0, 0.0, 0
        for each in self._linear(curve):
            sums.add(each.frame, *each.pattern)
            total, energy, count = total + each.light, energy + float(np.vdot(each.light, each.light)), count + 1
            noise += each.variance * each.frame.size
        problem = self.prepared.problem(sums)
        explained = float(np.square(problem.projected[problem.sigma > 0]).sum())
        spreads = [(problem.energy - explained) / (noise * self.prepared.spare)]
        if len(each.read) == 2 and count > 1:
            spreads.append((energy - float(np.vdot(total, total)) / count) / (noise * (1 - 1 / count)))
        return _Held(tuple(spreads), count * total.size, problem.projected)

    def _unlikely(self, curve: Curve, held: _Held) -> float:
        """-2 log L of a ``curve``, by which the measurements are ``held`` against the model."""
        unlikely = sum(held.numbers * float(np.log(max(spread, _TINY))) for spread in held.spreads)
        for each in self._linear(curve):
            slopes = (curve[1](np.maximum(np.abs(read), _LEAST)) for read in each.read)
            logarithm = sum(float(np.log(values).sum()) for values in slopes)
            unlikely += len(each.read) * each.frame.size * float(np.log(each.variance)) - 2 * logarithm
        return unlikely

    def _fits_each(self, curve: Curve) -> bool:
        """Whether every measurement has no more than its noise left: a single one that is wrong bends no numbers."""
        weights, prepared = self._held(curve).weights, self.prepared
        for each in self._linear(curve):
            left, right = prepared.left.slabs[each.pattern[0]], prepared.right.slabs[each.pattern[1]]
            frame = centred(each.frame) if prepared.centre else each.frame
            residual = frame - left.matrix @ weights[left.columns][:, right.columns] @ right.matrix.T
            spread = float(np.vdot(residual, residual)) / (frame.size * each.variance * prepared.spare)
            if spread > 1 + 2 * _NOISE + _CHANCE * np.sqrt(2 / frame.size):
                return False
        return True

    def _linear(self, curve: Curve) -> Iterator[_Linear]:
        """Measurements of light, dark current and ambient light, that the numbers are a ``curve`` of."""
        digital, light_of = self.manifest.digital, curve[0]
        dark, top = digital.dark_current_e_per_s, digital.saturation_dn
        peak = float(digital.rate(np.array(top))) if top else max(float(each.light.max()) for each in self.measured())
        peak = max(peak + dark, _TINY)

        def part(rate: FloatArray) -> FloatArray:
            return np.asarray((rate + dark) / peak)

        def linear(read: FloatArray) -> FloatArray:
            return np.asarray(peak * np.sign(read) * light_of(np.abs(read)) - dark)

        for each in self.measured():
            pair = ((each.light + each.frame) / 2, (each.light - each.frame) / 2) if each.shots == 2 else (each.light,)
            reads = tuple(part(rate) for rate in pair)
            halves = [linear(read) for read in reads]
            light = np.asarray(sum(halves))
            frame = halves[0] - halves[1] if each.shots == 2 else light
            if each.shots == 1 and each.frame is not each.light:
                frame = light - linear(part(each.light - each.frame))  # the ambient frame
            variance = float(np.maximum(digital.variance(light, each.shots), _TINY).mean())
            yield _Linear((each.row, each.column), frame, light, variance, reads)
