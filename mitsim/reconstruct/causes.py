"""Measurements that fit no image in; why, and how else they may be read, out.

Each cause leaves its own mark. Where a surface is not at the calibrated distance, parallax moves its light along the
baseline: a few measurements of single groups of lit pixels are then explained by light of *any* pixel of the same rows
(or the same columns). Ambient light is the same in every shot, and comes from all pixels. Gloss comes from the lit
pixels, but changes over the sensor: the factors times a polynomial of the place explain it. Other devices explain
nothing.

*Other readings.* Each other reading is added up anew by the same factorised model: frames turned or mirrored, shots in
another order, numbers without a tone curve. U of the model is orthonormal, so that |Y|^2 - |W|^2 is what a reading
leaves.

*Tone curves.* Curves are compared by the likelihood of the numbers as they were read (Box and Cox, 1964): where light
is g(y) of numbers y, -2 log L = n log s + sum log v - 2 sum log g'(y) but for a constant, with v the variance of noise
in that light, and s what the model leaves in units of it. A curve counts that is likelier than none, and of which s is
1 in the dark and in the light: numbers that are crushed to 0 fit any image, but with less noise than the sensor makes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np
from scipy.ndimage import uniform_filter

from mitsim.core.arrays import FloatArray
from mitsim.core.runs import Measurement
from mitsim.reconstruct.accumulation import Accumulation, FrameNoise
from mitsim.reconstruct.estimate_factors import SEPARABLE_RESIDUAL
from mitsim.reconstruct.factorisation import IndexArray, group_pixels
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.subpixel import LitFrame, block_indices, factor_slope, orthonormal, print_part

# ---- Causes, and what tells them apart -------------------------------------------------------------------------------


_PLACES = (0.1, 0.3), (0.4, 0.8), (0.7, 0.1), (0.9, 0.6)
"""Which groups of lit rows and columns are looked at, as parts of their number: chosen, four spread over both."""
_DEGREE = 2
"""Of the polynomials that gloss is told by: chosen, a highlight is wider than half of the sensor."""
_SATURATED = 1e-5
"""Part of the readings at the end of their range that is no accident: 2.6 pixels of 512 x 512."""
_MOST = 0.5
"""Part of the unexplained energy that names a cause: more than all others together."""
_COMMON = 0.15
"""The same of what is common to all shots; less than half, as most of ambient light looks like an image and leaves the
residual. Light that changes from shot to shot has 1 / shots."""
_EVERYWHERE = 0.75
"""The same of what light of all scene pixels explains: a lamp's own colours leave 0.06 to 0.2 of theirs."""
_ALL = 0.3
"""Unexplained part of the measurements above which neither depth nor ambient light is the cause, but other devices."""
STEPS = (
    "one step late: each shot shows the pattern of the shot before",
    "one step early: each shot shows the pattern of the next",
)
"""Ways in which shots are a step beside their patterns."""


class Cause(Enum):
    """Why measurements do not fit; the value is its sentence and the remedy."""

    FRAMES = ("frames that are not what they say", "capture these frames again")
    ORIENTATION = ("frames that are turned or mirrored", "turn them back, or calibrate with the camera as it is")
    ORDER = ("frames in another order than their patterns", "bring the frames into the order of the patterns")
    GAMMA = (
        "numbers that are not proportional to the light",
        "save the camera's raw numbers, without gamma or tone curve",
    )
    SCALE = (
        "numbers that were multiplied, as of few bits left-aligned in more",
        "divide the numbers by that factor, or give a camera file of these numbers",
    )
    SATURATION = ("readings at the full well or the ADC's end", "expose for less")
    AMBIENT = ("ambient light, the same in every shot", "darken the room, or capture with ambient_frame=yes")
    DEPTH = (
        "depth, light that lands beside where the calibration saw it",
        "put the scene at the calibrated distance, calibrate at the scene's, or give its depth as focus (map: one for "
        "each pixel)",
    )
    INDIRECT = (
        "light from scene pixels that are not lit, over other surfaces or from depths along both axes",
        "cover shiny and near surfaces, or use patterns with more dots",
    )
    GLOSS = (
        "gloss, light that changes over the sensor",
        "turn the highlight away from the sensor, or take it as an image of the matt parts alone",
    )
    RIG = (
        "other devices, another mask or pattern than was calibrated, or light over mirrors",
        "calibrate this camera with this projector",
    )
    MASK = (
        "a camera that is not separable, which its calibration shows as well",
        "straighten the mask, or take a separable one",
    )
    DETAIL = (
        "print finer than a scene pixel, light beside the centres of the pixels",
        "use a projector of more pixels, or bring projector and scene closer together",
    )
    UNKNOWN = ("unknown: depth, gloss or indirect light", "compare the map of the misfit with the scene")


@dataclass(frozen=True, eq=False)
class Reading:
    """Another way to take the frames: the ``cause`` that it is, in ``words``; which leaves the part ``left`` of all
    measurements, rms."""

    cause: Cause
    words: str
    left: float = 0.0


@dataclass(frozen=True)
class Signatures:
    """Parts of the unexplained energy, 1 is all; NaN where the patterns cannot tell.

    ``rows``, ``columns``, ``everywhere``: explained by light of any scene row, of any column, of any pixel.
    ``gloss``: explained by factors that change over the sensor. ``common``: the same in every shot. ``saturated``: part
    of the readings at the end of their range. ``mask``: predicted by what the calibration knows that its factors lack.
    ``detail``: light beside the centres of the lit pixels, but not because of depth; NaN where pixels of patterns
    overlap.
    """

    rows: float
    columns: float
    everywhere: float
    gloss: float
    common: float
    saturated: float
    mask: float = np.nan
    detail: float = np.nan


class Evidence:
    """Gathers what tells causes apart, from one measurement after the other.

    Parameters
    ----------
    factors
        of the model.
    patterns
        P_L (n, K) and P_R (n', K').
    predicted
        energy that terms of the camera which the factors lack leave; None: not known.
    """

    def __init__(
        self, factors: Factors, patterns: tuple[FloatArray, FloatArray], predicted: float | None = None
    ) -> None:
        self.predicted = predicted
        self._factors = factors.sides
        noise = factors.manifest.noise
        self.of_factors = noise.unexplained if noise else 0.0
        sides, apart = zip(*(_lit_groups(side) for side in patterns), strict=True)
        self._told_apart = all(apart)
        places = {(int(row * len(sides[0])), int(column * len(sides[1]))) for row, column in _PLACES}
        self._groups = [(sides[0][row], sides[1][column]) for row, column in sorted(places)]
        shape = len(factors.left), len(factors.right)
        self._frames: list[FloatArray] = [np.zeros(shape) for _ in self._groups]
        self._variances = [0.0] * len(self._groups)
        self._common: FloatArray = np.zeros(shape)
        self._common_noise, self._shots = 0.0, 0

    def add(self, measurement: Measurement, frame: FloatArray, residual: FloatArray, variance: float) -> None:
        """Count in one measurement.

        Parameters
        ----------
        measurement
            which pattern it is of.
        frame, residual
            (rows, columns) as the solver takes it, and what the model leaves of it.
        variance
            mean noise variance of its data.
        """
        if measurement.shots == 1:  # the same light in both halves of a pair is gone
            self._common += residual
            self._common_noise += variance * residual.size
            self._shots += 1
        self.collect(measurement, frame, variance)

    def collect(self, measurement: Measurement, frame: FloatArray, variance: float) -> None:
        """Count in one measurement for :meth:`print_part` alone.

        Parameters
        ----------
        measurement, frame, variance
            as of :meth:`add`.
        """
        for k, (rows, columns) in enumerate(self._groups):
            weight = rows.weights[measurement.row] * columns.weights[measurement.column]
            if weight:
                self._frames[k] += weight * frame
                self._variances[k] += weight**2 * variance

    def signatures(self, unexplained: float, saturated: float) -> Signatures:
        """What was gathered; ``unexplained`` is the energy beyond all that is expected, ``saturated`` a part of all
        readings."""
        common = np.nan
        if self._shots > 1 and unexplained > 0:
            common = (float(np.square(self._common).sum()) - self._common_noise) / self._shots / unexplained
        everything = [orthonormal(side) for side in self._factors]
        left = np.zeros(5)
        for each in self._lit_frames:
            own = each.ranges
            glossy = [orthonormal(_modulate(side)) for side in each.factors]
            ranges = own, (everything[0], own[1]), (own[0], everything[1]), everything, glossy
            left += [each.beyond(*pair) for pair in ranges]
        rows, columns, everywhere, gloss = 1 - left[1:] / left[0] if left[0] > 0 else np.full(4, np.nan)
        mask = self.predicted / unexplained if self.predicted is not None and unexplained > 0 else np.nan
        payload = rows, columns, everywhere, gloss, common, saturated, mask, self.print_part()
        return Signatures(*(float(value) for value in payload))

    def print_part(self) -> float:
        """Part of what the lit pixels leave of their frames that is print finer than a pixel; NaN where pixels of
        patterns overlap."""
        return print_part(self._lit_frames) if self._told_apart else np.nan

    @cached_property
    def _lit_frames(self) -> list[LitFrame]:
        slopes = [factor_slope(side, spline=True) for side in self._factors]
        frames = []
        for groups, frame, variance in zip(self._groups, self._frames, self._variances, strict=True):
            rows, columns = (group.pixels for group in groups)
            lit = self._factors[0][:, rows], self._factors[1][:, columns]
            blocks = block_indices(rows, self._factors[0].shape[1]), block_indices(columns, self._factors[1].shape[1])
            frames.append(LitFrame(frame, variance, lit, (slopes[0][:, rows], slopes[1][:, columns]), blocks))
        return frames


@dataclass(frozen=True, eq=False)
class _Lit:
    """Scene ``pixels`` of one side, and the ``weights`` (K,) with which measurements add up to light of these alone."""

    pixels: IndexArray
    weights: FloatArray


def _lit_groups(patterns: FloatArray) -> tuple[list[_Lit], bool]:
    """Groups of one side that measurements can be added up for, and whether there are such; otherwise each pattern's
    own lit pixels."""
    groups = group_pixels(patterns, "block")
    if all(group.shared is not None for group in groups):
        lit = [(group.pixels, group.shared[1]) for group in groups if group.shared and group.shared[1].any()]
        return [_Lit(pixels, psi / np.dot(psi, psi)) for pixels, psi in lit], True
    alone = np.eye(patterns.shape[1])
    own = [_Lit(np.flatnonzero(column), one) for column, one in zip(patterns.T, alone, strict=True) if column.any()]
    return own, False


def likely_cause(signatures: Signatures, unexplained: float, of_factors: float = 0.0) -> Cause:
    """The cause that the signatures point to.

    Parameters
    ----------
    signatures
        parts of what is unexplained.
    unexplained, of_factors
        a part of the measurements, and of the responses that the factors were told from, rms.
    """
    along, across = max(signatures.columns, signatures.rows), min(signatures.columns, signatures.rows)
    if signatures.saturated > _SATURATED:
        return Cause.SATURATION
    if signatures.mask > _MOST or of_factors > max(SEPARABLE_RESIDUAL, unexplained):
        return Cause.MASK
    # One axis explains what the other does not: a baseline. NaN compares as False throughout.
    if along > _MOST and along > 2 * across and not along < signatures.detail:
        return Cause.DEPTH
    if signatures.detail > _MOST:
        return Cause.DETAIL
    if signatures.common > _COMMON and signatures.everywhere > _EVERYWHERE:
        return Cause.AMBIENT
    if unexplained > _ALL:
        return Cause.RIG
    if signatures.everywhere > _MOST:
        return Cause.INDIRECT
    return Cause.GLOSS if signatures.gloss > _MOST else Cause.UNKNOWN


def _modulate(factor: FloatArray) -> FloatArray:
    """A factor's columns (m, c), and these times powers of the place along the sensor: (m, c (degree + 1))."""
    place = np.linspace(-1, 1, len(factor))[:, None]
    return np.concatenate([factor * place**power for power in range(_DEGREE + 1)], axis=1)


# ---- Other readings of the frames ------------------------------------------------------------------------------------


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


def light_around(light: FloatArray) -> FloatArray:
    """The mean ``light`` around each reading, less its own, whose noise it does not know of."""
    return np.asarray(uniform_filter(light, _AROUND) - light / _AROUND**2)


def _shots(measurement: Measurement) -> tuple[FloatArray, ...]:
    """Light of each shot of a ``measurement``."""
    if measurement.shots == 1:
        return (measurement.light,)
    return (measurement.light + measurement.frame) / 2, (measurement.light - measurement.frame) / 2


# ---- Readings of a run ----


class Readings:
    """Other readings of a run, whose measurements are added up in ``data``."""

    def __init__(self, data: Accumulation) -> None:
        self._data, self._prepared, self._noise, self._digital = data, data.prepared, data.noise, data.digital
        self._captures = data.shots.manifest.patterns.captures

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
            numbers = self._noise.readings / self._noise.shots * self._prepared.spare
            chance = min(_CHANCE * expected * np.sqrt(2 / numbers), 0.5 * unexplained**2) if self._noise.stated else 0.0
            fit = left < most * unexplained**2 and (left < _AT_MOST**2 or most > _FITS)
            if fit or left < chance:
                fits.append(Reading(cause, words, float(np.sqrt(left))))
        return min(fits, key=lambda reading: reading.left, default=None) or self.tone_curve()

    def _left_over(self, frames: Frames) -> tuple[float, float]:
        """Part of the energy of ``frames`` that the model leaves, and that noise is expected to leave."""
        sums, noise = self._prepared.accumulator(), 0.0
        for frame, row, column, own in frames:
            sums.add(frame, row, column)
            noise += own
        problem = self._prepared.problem(sums)
        explained = float(np.square(problem.projected[problem.sigma > 0]).sum())
        energy = max(problem.energy, np.finfo(float).tiny)
        return 1 - explained / energy, noise * self._prepared.spare / energy

    def _candidates(self, with_cut: bool) -> Iterator[tuple[Cause, str, Frames, float]]:
        """Cause, words and frames of each reading, and the part of the unexplained energy that it may leave;
        ``with_cut`` as ``all_off`` of :meth:`fitting` takes it."""
        shape = self._prepared.left.sensor_size, self._prepared.right.sensor_size
        for words, turn in _TURNS.items():
            if turn(np.zeros(shape)).shape == shape:
                yield Cause.ORIENTATION, f"the frames are {words}", self._each(turn), _FITS
        count = len(self._captures)
        size = self._prepared.left.pattern_count * self._prepared.right.pattern_count
        if size > 1:
            cut = min(max(_FITS, _CUT / size), _CUT_AT_MOST) if with_cut else _FITS
            orders = {"in the reverse order": lambda number: count - 1 - number}
            if any(shot.sign for shot in self._captures):  # a step is FrameCheck.out_of_step's, by their light
                orders["with the halves of each pair exchanged"] = lambda number: number ^ 1
            else:
                orders |= {STEPS[0]: lambda number: number - 1, STEPS[1]: lambda number: number + 1}
            for words, order in orders.items():
                yield Cause.ORDER, f"the frames are {words}", self._reorder(order), cut

    def _each(self, turn: Callable[[FloatArray], FloatArray]) -> Frames:
        for each in self._data.measurements_again():
            noise = float(self._noise.variance[each.row, each.column]) * each.frame.size
            yield np.ascontiguousarray(turn(each.frame)), each.row, each.column, noise

    def _shots(self) -> Iterator[tuple[int, FloatArray]]:
        """Number and light of each shot."""
        number = {(shot.row, shot.column, shot.sign): n for n, shot in enumerate(self._captures)}
        for each in self._data.measurements_again():
            shots = (each.frame,) if each.shots == 1 else _shots(each)
            for sign, light in zip((0,) if each.shots == 1 else (1, -1), shots, strict=True):
                yield number[each.row, each.column, sign], light

    def _reorder(self, order: Callable[[int], int]) -> Frames:
        """Measurements of the shots, each taken for that which ``order`` gives for its number: halves of signed
        patterns as their difference."""
        waiting: dict[tuple[int, int], tuple[FloatArray, float]] = {}
        for number, light in self._shots():
            shot = self._captures[order(number) % len(self._captures)]
            noise = float(np.maximum(self._digital.variance(light), 0.0).sum())
            own = (shot.sign * light if shot.sign else light), noise
            if shot.sign and (shot.row, shot.column) not in waiting:
                waiting[shot.row, shot.column] = own
                continue
            other = waiting.pop((shot.row, shot.column)) if shot.sign else (np.zeros(()), 0.0)
            yield own[0] + other[0], shot.row, shot.column, own[1] + other[1]

    # ---- Tone curves that numbers went through

    def tone_curve(self) -> Reading | None:
        """The tone curve that the numbers went through; None where they are as likely without, where dark or bright
        ones do not fit with it, or where the sensor's noise is not stated."""
        digital = self._digital
        if not digital.noise_is_stated:
            return None
        largest = max(float(read.max()) for each in self._data.measurements_again() for read in _shots(each))
        own = float(digital.rate(np.array(digital.saturation_dn))) if digital.saturation_dn else largest
        own, dark = max(own + digital.dark_current_e_per_s, _TINY), digital.dark_current_e_per_s
        most = self._compare(_Curve(_power(1.0), own, own)).unlikely
        tried = {words: _Curve(shape, own, own) for words, shape in _SHAPES.items()}
        for bits in _BITS:
            top = float(digital.rate(np.array(2.0**bits - 1))) + dark
            # Its light may have been of as many bits, or of the camera's.
            if _FILLS * top < largest + dark <= top < own:
                over = {f"{words} over {bits} bits": shape for words, shape in _SHAPES.items()}
                tried |= {words: _Curve(shape, top, top) for words, shape in over.items()}
                tried |= {f"{words} instead of its own": _Curve(shape, top, own) for words, shape in over.items()}
        fits: dict[str, float] = {}
        for words, curve in tried.items():
            held = self._compare(curve)
            if held.unlikely < most:
                fits[words] = held.away
        best = min(fits, key=lambda words: fits[words], default="")
        return Reading(Cause.GAMMA, best) if best and self._fits_parts(tried[best]) else None

    def _compare(self, curve: _Curve) -> _Held:
        """All measurements against the model, and of signed patterns the sums of their halves, which are all alike."""
        sums, total, energy, noise, logarithms, count = self._prepared.accumulator(), np.zeros(()), 0.0, 0.0, 0.0, 0
        for each in self._linear(curve):
            sums.add(each.frame, *each.pattern)
            total, energy, count = total + each.light, energy + float(np.vdot(each.light, each.light)), count + 1
            noise += each.variance * each.frame.size
            logarithms += each.shots * each.frame.size * np.log(each.variance) - 2 * each.logarithm
        problem = self._prepared.problem(sums)
        explained = float(np.square(problem.projected[problem.sigma > 0]).sum())
        spreads = [(problem.energy - explained) / (noise * self._prepared.spare)]
        if each.shots == 2 and count > 1:
            spreads.append((energy - float(np.vdot(total, total)) / count) / (noise * (1 - 1 / count)))
        unlikely = sum(count * total.size * float(np.log(max(spread, _TINY))) for spread in spreads) + logarithms
        return _Held(max(abs(spread - 1) for spread in spreads), unlikely, problem.projected)

    def _fits_parts(self, curve: _Curve) -> bool:
        """Whether dark and bright readings have their noise left, each part of them."""
        weights, prepared = self._compare(curve).weights, self._prepared
        parts = np.zeros((2, _CURVE_PARTS))
        for each in self._linear(curve):
            residual = prepared.as_solved(each.frame) - prepared.frame(weights, each.pattern)
            near = light_around(each.light)
            part = np.searchsorted(np.quantile(near, np.arange(1, _CURVE_PARTS) / _CURVE_PARTS), near.ravel())
            variance = np.maximum(self._digital.variance(each.light, each.shots), _TINY).ravel()
            for energy, values in zip(parts, (np.square(residual).ravel(), variance), strict=True):
                energy += np.bincount(part, values, _CURVE_PARTS)
        expected = parts[1] * prepared.spare
        return bool((np.abs(parts[0] - expected) <= _UNEVEN * expected).all())

    def _linear(self, curve: _Curve) -> Iterator[_Linear]:
        """Measurements of light, dark current and ambient light, that the numbers are a ``curve`` of."""
        digital = self._digital
        dark = digital.dark_current_e_per_s

        def linear(read: FloatArray) -> FloatArray:
            return curve.light(read + dark) - dark

        for each in self._data.measurements_again():
            pair = _shots(each)
            halves = [linear(read) for read in pair]
            light = np.asarray(sum(halves))
            frame = halves[0] - halves[1] if each.shots == 2 else light
            if each.shots == 1 and each.frame is not each.light:
                frame = light - linear(each.light - each.frame)  # the ambient frame
            variance = float(np.maximum(digital.variance(light, each.shots), _TINY).mean())
            logarithm = sum(float(np.log(curve.slope(read + dark)).sum()) for read in pair)
            yield _Linear((each.row, each.column), frame, light, each.shots, variance, logarithm)


def multiple(noise: FrameNoise, chi_square: float) -> Reading | None:
    """A finding that all numbers of a run are multiples of one factor, where the noise shows that they were multiplied
    by it.

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
