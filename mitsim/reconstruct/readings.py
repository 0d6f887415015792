"""Measurements that fit no image in; out comes how else their frames may be read, where they fit that way.

Each other reading is added up anew by the same factorised model: frames turned or mirrored, shots in another order,
numbers without a tone curve (:class:`ToneCurves`). U of the model is orthonormal, so that
|Y|^2 - |W|^2 is what a reading leaves.

*Tone curves.* Curves are compared by the likelihood of the numbers as they were read (Box and Cox, 1964): where light
is g(y) of numbers y, -2 log L = n log s + sum log v - 2 sum log g'(y) but for a constant, with v the variance of noise
in that light, and s what the model leaves in units of it. A curve counts that is likelier than none, and of which s is
1 in the dark and in the light: numbers that are crushed to 0 fit any image, but with less noise than the sensor makes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter

from mitsim.core.arrays import FloatArray
from mitsim.core.manifests import RunManifest
from mitsim.core.runs import Measurement
from mitsim.reconstruct.causes import STEPS, Cause, Reading
from mitsim.reconstruct.noise import FrameNoise
from mitsim.reconstruct.solver import Prepared

_FITS = 0.05
"""Part of the unexplained energy that a reading may leave: chosen, so that it explains nearly all of it."""
_AT_MOST = 2e-2
"""Part of the measurements, rms, that it may leave: one that is right leaves 1e-2 of a sheet 2 mm beside the calibrated
distance."""
_CHANCE = 3.0
"""Standard deviations of noise that a reading may leave in any case, where that is less than half of what is
unexplained."""
_CUT = 1.5
"""Part of the unexplained energy that another order may leave, times the number of patterns: of a cycle that was
entered late one frame was taken before it."""
_CUT_AT_MOST = 0.3
"""The most of that: runs of a few frames do not tell an order."""
_MULTIPLIED, _LEAST_MULTIPLIED = 0.15, 1.5
"""Chi-square of multiplied numbers, over their factor, and at least: shot noise alone makes that the factor, and
a black level that was multiplied too, which then counts as light, 0.3 of it; what is rounded to a factor has 1.1."""

Frames = Iterator[tuple[FloatArray, int, int, float]]
"""Measurements, their patterns, and the energy that their noise is expected to have."""

_TURNS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "upside down, their rows reversed": lambda frame: frame[::-1],
    "mirrored, their columns reversed": lambda frame: frame[:, ::-1],
    "turned by 180 degrees": lambda frame: frame[::-1, ::-1],
    "transposed, their rows and columns exchanged": lambda frame: frame.T,
    "turned by 90 degrees counter-clockwise": lambda frame: np.rot90(frame, -1),
    "turned by 90 degrees clockwise": lambda frame: np.rot90(frame),
    "transposed about the other diagonal": lambda frame: frame[::-1, ::-1].T,
}
"""What frames may be, and what brings them back."""


@dataclass(frozen=True, eq=False)
class Readings:
    """Other readings of a run.

    Attributes
    ----------
    prepared
        the factorised model.
    manifest, noise
        of the run, and of its measurements.
    measured
        reads all measurements once more.
    """

    prepared: Prepared
    manifest: RunManifest
    noise: FrameNoise
    measured: Callable[[], Iterable[Measurement]]

    def fitting(self, unexplained: float, beside_noise: float, all_off: bool) -> Reading | None:
        """The reading that fits best, where one does.

        Parameters
        ----------
        unexplained
            part of the measurements, rms, that is left of them as they are.
        beside_noise
            part of their energy that rendering, the factors' noise and print put there.
        all_off
            whether most frames are off: then an order counts that leaves one frame of a cycle.
        """
        fits: list[Reading] = []
        for cause, words, frames, most in self._candidates(all_off):
            left_over, expected = self._left_over(frames)
            left = max(left_over - expected - beside_noise, 0.0)
            numbers = self.noise.readings / self.noise.shots * self.prepared.spare
            chance = min(_CHANCE * expected * np.sqrt(2 / numbers), 0.5 * unexplained**2) if self.noise.stated else 0.0
            fit = left < most * unexplained**2 and (left < _AT_MOST**2 or most > _FITS)
            if fit or left < chance:
                fits.append(Reading(cause, words, float(np.sqrt(left))))
        return min(fits, key=lambda reading: reading.left, default=None) or self.curved()

    def curved(self) -> Reading | None:
        """The tone curve that the numbers went through, where one is likelier than none."""
        words = ToneCurves(self.prepared, self.manifest, self.measured).likeliest()
        return Reading(Cause.GAMMA, words) if words else None

    def _left_over(self, frames: Frames) -> tuple[float, float]:
        """Part of the energy of ``frames`` that the model leaves, and that noise is expected to leave."""
        sums, noise = self.prepared.accumulator(), 0.0
        for frame, row, column, own in frames:
            sums.add(frame, row, column)
            noise += own
        problem = self.prepared.problem(sums)
        explained = float(np.square(problem.projected[problem.sigma > 0]).sum())
        energy = max(problem.energy, np.finfo(float).tiny)
        return 1 - explained / energy, noise * self.prepared.spare / energy

    def _candidates(self, with_cut: bool) -> Iterator[tuple[Cause, str, Frames, float]]:
        """Cause, words and frames of each reading, and the part of the unexplained energy that it may leave;
        ``with_cut`` as ``all_off`` of :meth:`fitting` takes it."""
        shape = self.prepared.left.sensor_size, self.prepared.right.sensor_size
        for words, turn in _TURNS.items():
            if turn(np.zeros(shape)).shape == shape:
                yield Cause.ORIENTATION, f"the frames are {words}", self._each(turn), _FITS
        shots = self.manifest.patterns.captures
        size = self.prepared.left.pattern_count * self.prepared.right.pattern_count
        if size > 1:
            cut = min(max(_FITS, _CUT / size), _CUT_AT_MOST) if with_cut else _FITS
            orders = {"in the reverse order": lambda number: len(shots) - 1 - number}
            if any(shot.sign for shot in shots):  # of a step their light tells, as FrameCheck.out_of_step has it
                orders["with the halves of each pair exchanged"] = lambda number: number ^ 1
            else:
                orders |= {STEPS[0]: lambda number: number - 1, STEPS[1]: lambda number: number + 1}
            for words, order in orders.items():
                yield Cause.ORDER, f"the frames are {words}", self._reorder(order), cut

    def _each(self, turn: Callable[[FloatArray], FloatArray]) -> Frames:
        for each in self.measured():
            noise = float(self.noise.variance[each.row, each.column]) * each.frame.size
            yield np.ascontiguousarray(turn(each.frame)), each.row, each.column, noise

    def _shots(self) -> Iterator[tuple[int, FloatArray]]:
        """Number and light of each shot."""
        number = {(shot.row, shot.column, shot.sign): n for n, shot in enumerate(self.manifest.patterns.captures)}
        for each in self.measured():
            shots = (each.frame,) if each.shots == 1 else _shots(each)
            for sign, light in zip((0,) if each.shots == 1 else (1, -1), shots, strict=True):
                yield number[each.row, each.column, sign], light

    def _reorder(self, order: Callable[[int], int]) -> Frames:
        """Measurements of the shots, each taken for that which ``order`` gives for its number: halves of signed
        patterns as their difference."""
        captures = self.manifest.patterns.captures
        waiting: dict[tuple[int, int], tuple[FloatArray, float]] = {}
        for number, light in self._shots():
            shot = captures[order(number) % len(captures)]
            noise = float(np.maximum(self.manifest.digital.variance(light), 0.0).sum())
            own = (shot.sign * light if shot.sign else light), noise
            if shot.sign and (shot.row, shot.column) not in waiting:
                waiting[shot.row, shot.column] = own
                continue
            other = waiting.pop((shot.row, shot.column)) if shot.sign else (np.zeros(()), 0.0)
            yield own[0] + other[0], shot.row, shot.column, own[1] + other[1]


def multiple(noise: FrameNoise, chi_square: float) -> Reading | None:
    """That all numbers of a run are multiples of one, where its noise says that they were multiplied.

    Multiplied numbers count too many electrons: their variance is that many times the shot noise of so many. A camera
    whose file knows of the factor has the noise that it states.

    Parameters
    ----------
    noise
        of the run.
    chi_square
        of its misfit.
    """
    factor = noise.factor
    if factor < 2 or not chi_square > max(_MULTIPLIED * factor, _LEAST_MULTIPLIED):
        return None
    words = f"all numbers are multiples of {factor}"
    if factor & (factor - 1) == 0:
        words += f", as of fewer bits that were moved up by {factor.bit_length() - 1}"
    return Reading(Cause.SCALE, words)


# ---- Tone curves that numbers went through ---------------------------------------------------------------------------


_CURVE_PARTS, _AROUND, _UNEVEN = 4, 5, 0.3
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
        most = self._compare(_Curve(_power(1.0), own, own)).unlikely
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
            held = self._compare(curve)
            if held.unlikely < most:
                fits[words] = held.away
        best = min(fits, key=lambda words: fits[words], default="")
        return best if best and self._fits_parts(tried[best]) else ""

    def _compare(self, curve: _Curve) -> _Held:
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
        weights, prepared = self._compare(curve).weights, self.prepared
        parts = np.zeros((2, _CURVE_PARTS))
        for each in self._linear(curve):
            residual = prepared.as_solved(each.frame) - prepared.frame(weights, each.pattern)
            # By the light around a reading, which does not know of its noise.
            near = uniform_filter(each.light, _AROUND) - each.light / _AROUND**2
            part = np.searchsorted(np.quantile(near, np.arange(1, _CURVE_PARTS) / _CURVE_PARTS), near.ravel())
            variance = np.maximum(self.manifest.digital.variance(each.light, each.shots), _TINY).ravel()
            for energy, values in zip(parts, (np.square(residual).ravel(), variance), strict=True):
                energy += np.bincount(part, values, _CURVE_PARTS)
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
