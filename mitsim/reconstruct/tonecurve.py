"""Shots in; the tone curve out without which their light fits an image with the noise that its sensor makes.

Curves are compared by the likelihood of the numbers as they were read (Box and Cox, 1964): where light is g(y) of
numbers y, -2 log L = n log s + sum log v - 2 sum log g'(y) but for a constant, with v the variance of noise in that
light, and s what the model leaves in units of it. A curve counts that is likelier than none, and of which s is 1 in
the dark and in the light: numbers that are crushed to 0 fit any image, but with less noise than the sensor makes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter

from mitsim.core.arrays import FloatArray
from mitsim.core.manifests import RunManifest
from mitsim.core.runs import Measurement
from mitsim.reconstruct.solver import Prepared, centred

_PARTS, _AROUND, _UNEVEN = 4, 5, 0.3
"""Parts of all readings, from the darkest to the brightest by the mean of so many a side around them, of which each
must have its noise; and how far each may be from it: chosen, a curve that fits by chance makes too little in the dark.
"""
_BITS = 8, 10, 12, 14, 16
"""Ranges that files encode light over, beside the camera's own."""
_FILLS = 1 / 16
"""Of such a range, the least that its largest number is: chosen, light below 1/100 of a range has that power of 1/1.8.
"""
_LEAST = 1e-4
"""Of the range, the least number whose slope counts, one of 13 bits: that of a power is 0 or infinite at 0."""
_TINY = float(np.finfo(np.float64).tiny)

_Shape = tuple[Callable[[FloatArray], FloatArray], Callable[[FloatArray], FloatArray]]
"""Light of numbers, both 0 to 1, and its slope."""


def _power(exponent: float) -> _Shape:
    return lambda number: number**exponent, lambda number: exponent * number ** (exponent - 1)


_SRGB: _Shape = (
    lambda number: np.where(number <= 0.04045, number / 12.92, ((number + 0.055) / 1.055) ** 2.4),
    lambda number: np.where(number <= 0.04045, 1 / 12.92, 2.4 / 1.055 * ((number + 0.055) / 1.055) ** 1.4),
)
_SHAPES = {
    "the numbers follow the curve of sRGB": _SRGB,
    **{f"the numbers are the light to the power of 1/{exponent:g}": _power(exponent) for exponent in (1.8, 2.2, 2.4)},
}
"""By which displays and files encode light; that of sRGB after IEC 61966-2-1."""


@dataclass(frozen=True, eq=False)
class _Curve:
    """A ``shape`` over numbers up to ``top``, of light up to ``peak``: both as rates of electrons without the curve."""

    shape: _Shape
    top: float
    peak: float

    def light(self, read: FloatArray) -> FloatArray:
        """Of numbers ``read``."""
        part = read / self.top
        return np.asarray(self.peak * np.sign(part) * self.shape[0](np.abs(part)))

    def slope(self, read: FloatArray) -> FloatArray:
        """Of the light at numbers ``read``."""
        return np.asarray(self.peak / self.top * self.shape[1](np.maximum(np.abs(read) / self.top, _LEAST)))


@dataclass(frozen=True, eq=False)
class _Linear:
    """A measurement of linear light: its ``pattern``, the ``frame`` as the solver takes it, the ``light`` of all its
    ``shots``, the mean ``variance`` of their noise, and the sum of the ``logarithm`` of the curve's slope."""

    pattern: tuple[int, int]
    frame: FloatArray
    light: FloatArray
    shots: int
    variance: float
    logarithm: float


@dataclass(frozen=True, eq=False)
class _Held:
    """How far what is left is ``away`` from the noise that is expected, as a part of it, -2 log L, and W."""

    away: float
    unlikely: float
    weights: FloatArray


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
        """The curve that the numbers went through, in words; empty where they are as likely without, where dark or
        bright ones do not fit with it, or where the sensor's noise is not stated."""
        if not self.manifest.digital.noise_is_stated:
            return ""
        digital = self.manifest.digital
        largest = max(float(read.max()) for each in self.measured() for read in _shots(each))
        own = float(digital.rate(np.array(digital.saturation_dn))) if digital.saturation_dn else largest
        own, dark = max(own + digital.dark_current_e_per_s, _TINY), digital.dark_current_e_per_s
        most = self._held(_Curve(_power(1.0), own, own)).unlikely
        tried = {words: _Curve(shape, own, own) for words, shape in _SHAPES.items()}
        for bits in _BITS:
            top = float(digital.rate(np.array(2.0**bits - 1))) + dark
            if (
                _FILLS * top < largest + dark <= top < own
            ):  # its light may have been of as many bits, or of the camera's
                over = {f"{words} over {bits} bits": shape for words, shape in _SHAPES.items()}
                tried |= {words: _Curve(shape, top, top) for words, shape in over.items()}
                tried |= {f"{words} instead of its own": _Curve(shape, top, own) for words, shape in over.items()}
        fits: dict[str, float] = {}
        for words, curve in tried.items():
            held = self._held(curve)
            if held.unlikely < most:
                fits[words] = held.away
        best = min(fits, key=lambda words: fits[words], default="")
        return best if best and self._fits_parts(tried[best]) else ""

    def _held(self, curve: _Curve) -> _Held:
        """All measurements against the model, and of signed patterns the sums of their halves, which are all alike."""
        sums, total, energy, noise, logarithms, count = self.prepared.accumulator(), np.zeros(()), 0.0, 0.0, 0.0, 0
        for each in self._linear(curve):
            sums.add(each.frame, *each.pattern)
            total, energy, count = total + each.light, energy + float(np.vdot(each.light, each.light)), count + 1
            noise += each.variance * each.frame.size
            logarithms += each.shots * each.frame.size * np.log(each.variance) - 2 * each.logarithm
        problem = self.prepared.problem(sums)
        explained = float(np.square(problem.projected[problem.sigma > 0]).sum())
        spreads = [(problem.energy - explained) / (noise * self.prepared.spare)]
        if each.shots == 2 and count > 1:
            spreads.append((energy - float(np.vdot(total, total)) / count) / (noise * (1 - 1 / count)))
        unlikely = sum(count * total.size * float(np.log(max(spread, _TINY))) for spread in spreads) + logarithms
        return _Held(max(abs(spread - 1) for spread in spreads), unlikely, problem.projected)

    def _fits_parts(self, curve: _Curve) -> bool:
        """Whether dark and bright readings have their noise left, each part of them."""
        weights, prepared = self._held(curve).weights, self.prepared
        parts = np.zeros((2, _PARTS))
        for each in self._linear(curve):
            left, right = prepared.left.slabs[each.pattern[0]], prepared.right.slabs[each.pattern[1]]
            frame = centred(each.frame) if prepared.centre else each.frame
            residual = frame - left.matrix @ weights[left.columns][:, right.columns] @ right.matrix.T
            # By the light around a reading, which does not know of its noise.
            near = uniform_filter(each.light, _AROUND) - each.light / _AROUND**2
            part = np.searchsorted(np.quantile(near, np.arange(1, _PARTS) / _PARTS), near.ravel())
            variance = np.maximum(self.manifest.digital.variance(each.light, each.shots), _TINY).ravel()
            for energy, values in zip(parts, (np.square(residual).ravel(), variance), strict=True):
                energy += np.bincount(part, values, _PARTS)
        expected = parts[1] * prepared.spare
        return bool((np.abs(parts[0] - expected) <= _UNEVEN * expected).all())

    def _linear(self, curve: _Curve) -> Iterator[_Linear]:
        """Measurements of light, dark current and ambient light, that the numbers are a ``curve`` of."""
        digital = self.manifest.digital
        dark = digital.dark_current_e_per_s

        def linear(read: FloatArray) -> FloatArray:
            return curve.light(read + dark) - dark

        for each in self.measured():
            pair = _shots(each)
            halves = [linear(read) for read in pair]
            light = np.asarray(sum(halves))
            frame = halves[0] - halves[1] if each.shots == 2 else light
            if each.shots == 1 and each.frame is not each.light:
                frame = light - linear(each.light - each.frame)  # the ambient frame
            variance = float(np.maximum(digital.variance(light, each.shots), _TINY).mean())
            logarithm = sum(float(np.log(curve.slope(read + dark)).sum()) for read in pair)
            yield _Linear((each.row, each.column), frame, light, each.shots, variance, logarithm)


def _shots(measurement: Measurement) -> tuple[FloatArray, ...]:
    """Light of each shot of a ``measurement``."""
    if measurement.shots == 1:
        return (measurement.light,)
    return (measurement.light + measurement.frame) / 2, (measurement.light - measurement.frame) / 2
