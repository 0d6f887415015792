"""Statistics of lit and dark frames at several exposures in, the camera that explains them out, with standard errors.

EMVA 1288 reads gain and noise off straight lines, which readings that are cut at 0 and rounding to few codes bend. Here
the closed-form moments of the whole chain (`mitsim.sensor.moments`) are fitted to means and variances at once, so
that cutting, rounding and saturation are part of what is expected. Light of a set may be off by what the lamp varies.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy

from mitsim.core.arrays import FloatArray
from mitsim.devices.sensor import SensorModel
from mitsim.sensor.emva import HIDDEN, LEAST_DARK, MOST_FITTED, Alike
from mitsim.sensor.moments import frame_moments

NAMES = ("gain", "read", "black", "dark", "response", "bend", "bend_2", "spatial")
"""Fitted numbers: K [DN/e-], noise of reading [DN], black level [DN], dark electrons a second, photoelectrons for a
unit of light, the first two coefficients of linearity, and the variance of the pixels' offsets [DN^2]."""
_DARK = NAMES.index("dark")
_STEPS = np.array([1e-3, 1e-2, 0.0, 1e-3, 1e-3, 0.0, 0.0, 1e-2])
"""Relative steps of the numerical derivatives, which change moments by some of their errors."""
_LEAST_STEPS = np.array([1e-15, 1e-3, 1e-2, 1e-4, 1e-15, 1e-3, 1e-3, 1e-5])
"""Least steps in each number's unit, for numbers near 0."""
_STARTS = (1.0, 0.9, 0.8, 0.65, 0.5)
"""Parts of the gain that straight lines give: rounding of next to no noise makes variances too large, up to twice."""
_TRIED, _SOLVED = 10, 25
"""Evaluations in which another beginning must be better, and those of a solution; chosen: a camera of 8 bits that no
numbers fit takes 10 s."""
_DITHERED = 0.44
"""Variance [DN^2] below which rounding moves means: noise of 0.6 DN, which leaves 2e-3 of an offset's error."""
_HALF = 0.5
"""Codes to which an offset is known whatever the noise hides."""
_NODES = 9
"""Offsets in place of all pixels', as Gauss and Hermite have them: exact to the seventeenth power of the spread."""
_CUT = 1e-4
"""Part of the numbers at the ADC's end from which a set does not count as below saturation."""
_STEADY = 1e-5
"""Least relative scatter that a lamp is taken to have: below what means of a million pixels tell."""
_CHANCE = 1e-3
"""Significance from which light is off by more than is known."""
_FITS = 2.0
"""Chi-square over its degrees of freedom from which other beginnings of the fit are tried."""
_TELLS = 9.0
"""By how much less chi-square variances must have before they tell a bent camera from a drifting lamp: three standard
errors."""
_SATURATED, _FALLEN = 0.05, 0.5
"""Part of the largest variance that light makes, below which the brightest frames are saturated; and the same where
their mean rises by less than the first part of what light does."""


Light = Literal["steady", "scatters", "drifts", "undecided"]
"""What was seen of the light of sets."""


@dataclass(frozen=True, eq=False)
class Taken:
    """Frames that were taken alike.

    Attributes
    ----------
    light
        that fell on a pixel, in photons or in any unit; 0 is dark.
    exposure_s
        of each.
    said
        their statistics.
    """

    light: float
    exposure_s: float
    said: Alike


@dataclass(frozen=True, eq=False)
class Transfer:
    """The camera that explains means and variances.

    Attributes
    ----------
    values, covariance
        (8,) by :data:`NAMES`, and (8, 8) of their errors; 0: not fitted.
    saturation_dn
        mean of saturated frames; None where no frame is.
    saturates
        whether that is the end of the full well and not of the ADC.
    lamp
        relative scatter of the light of sets about what their exposures say.
    light
        ``steady``: as exposures say. ``scatters`` about that. ``drifts``: means rise with exposure otherwise than
        variances with means. ``undecided``: means bend, and variances do not tell whether camera or lamp is at fault;
        the camera is then bent, and the covariance holds what it would be otherwise.
    chi_square, freedom
        of the fit: squares of what is left, and how many are free.
    off
        (sets, 2) by how many errors each set's mean and variance are off; not a number where it was not used.
    """

    values: FloatArray
    covariance: FloatArray
    saturation_dn: float | None
    saturates: bool
    lamp: float
    light: Light
    chi_square: float
    freedom: int
    off: FloatArray

    def __getitem__(self, name: str) -> float:
        return float(self.values[NAMES.index(name)])

    def error(self, name: str) -> float:
        """Standard error of the number of that ``name``."""
        index = NAMES.index(name)
        return math.sqrt(self.covariance[index, index])

    @property
    def light_error(self) -> float:
        """Relative error that light of all sets shares: of a lamp that is off, no set is known to be right."""
        return self.lamp if self.light in ("scatters", "drifts") else 0.0


# ---- what sets are used ----------------------------------------------------------------------------------------------


def saturation_of(taken: Sequence[Taken]) -> tuple[int, int | None]:
    """Which set has the largest variance, and which one is saturated: the brightest, if its variance is small; or None.

    Where rounding leaves some of it, other light that makes a set as bright tells. The ``taken`` sets are
    in any order.
    """
    mean, variance = (
        np.array([float(getattr(each.said.pair, name)) for each in taken]) for name in ("mean", "variance")
    )
    lit = np.flatnonzero([each.light > 0 for each in taken])
    still = variance[[not each.light for each in taken]].min()
    peak, last = lit[variance[lit].argmax()], lit[mean[lit].argmax()]
    light = np.array([each.light for each in taken])
    left, most = variance[last] - still, variance[peak] - still
    others = lit[light[lit] != light[last]]
    if left < _FALLEN * most and others.size:
        near = others[mean[others].argmax()]
        rise = (mean[last] - mean[near]) / (mean[last] - mean[light == 0].min())
        if rise < _SATURATED * abs(1 - light[near] / light[last]):
            return int(peak), int(last)
    return int(peak), int(last) if left < _SATURATED * most else None


def nonuniform(taken: Sequence[Taken]) -> tuple[int, int]:
    """Which of the ``taken`` sets tell nonuniformity: one in the dark, and one under light of its exposure.

    Under light that of most frames between three and seven tenths of saturation, or of the brightest; of several the
    nearest to half.
    """
    mean = np.array([float(each.said.pair.mean) for each in taken])
    dark = [index for index, each in enumerate(taken) if not each.light]
    lit = [index for index, each in enumerate(taken) if each.light and each.said.cut[1] < _CUT]
    floor, full = mean[dark].min(), mean[saturation_of(taken)[0]]
    part = (mean - floor) / max(full - floor, 1e-9)
    near = [index for index in lit if 0.3 <= part[index] <= MOST_FITTED] or lit
    bright = max(near, key=lambda index: (taken[index].said.count, -abs(part[index] - 0.5)))
    time = taken[bright].exposure_s
    return min(dark, key=lambda index: (abs(taken[index].exposure_s - time), -taken[index].said.count)), bright


# ---- the fit ---------------------------------------------------------------------------------------------------------


def average_moments(
    electrons: npt.ArrayLike, exposure_s: float, model: SensorModel, spread: float, response: float = 0.0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mean and variance [DN] of pixels that differ, and the variance over pixels of their means.

    An offset acts as another black level. The average over a normal law is a Gauss and Hermite sum, with one node for
    offset and response: offsets matter in the dark, responses at saturation, and in between moments are straight.

    Parameters
    ----------
    electrons
        (...) expected photoelectrons.
    exposure_s, model
        time, and a sensor whose pixels are alike.
    spread, response
        standard deviations of the offsets [DN], and of the responses over their mean.
    """
    light = np.asarray(electrons, dtype=np.float64)
    if not spread and not response:
        return *frame_moments(light, exposure_s, model), np.zeros(light.shape)
    places, weights = np.polynomial.hermite_e.hermegauss(_NODES)
    lit = np.multiply.outer(np.maximum(1 + response * places, 0.0), light)
    models = [model.model_copy(update={"black_level_dn": model.black_level_dn + place * spread}) for place in places]
    found = [frame_moments(*each) for each in zip(lit, [exposure_s] * _NODES, models, strict=True)] if spread else [
        frame_moments(lit, exposure_s, model)
    ]  # fmt: skip
    means, noises = (np.reshape(part, lit.shape) for part in zip(*found, strict=True))
    mean, noise = (np.average(part, axis=0, weights=weights) for part in (means, noises))
    return mean, noise, np.average(np.square(means - mean), axis=0, weights=weights)


def fit(taken: Sequence[Taken], bits: int | None, still: int, spatial: tuple[float, float]) -> Transfer:
    """Fit a camera to the ``taken`` sets.

    Parameters
    ----------
    taken
        sets of frames, a dark one among them.
    bits
        of the ADC; None: real numbers.
    still, spatial
        a dark set, and the variance over pixels of its mean image [DN^2] with its standard error.
    """
    problem = _Problem.of(taken, bits, still, spatial)
    steady = problem.begin()
    if steady.light_fits or len(steady.lights) < 4:
        return steady.transfer("steady")
    bent = problem.solve(bend=True, lamp=problem.lamp)
    explains = bent.light_fits
    bent, wide = problem.settle(bent), problem.settle(steady)
    told = bent.variance_chi_square - wide.variance_chi_square
    if told < -_TELLS:
        return bent.transfer("steady" if explains else "scatters")
    if explains and told < _TELLS:
        off = bent.values - wide.values
        return replace(bent, covariance=bent.covariance + np.outer(off, off)).transfer("undecided")
    return wide.transfer("drifts" if bent.lamp < wide.lamp / 2 else "scatters")


@dataclass(frozen=True, eq=False)
class _Solution:
    """Fitted numbers with their covariance, and what is left, in standard errors.

    `left` (2, count) is of means and variances, `lights` (lit sets,) of how far the light is off; the light of sets
    scatters by a part `lamp`, and by a part `scatter` about the fit.
    """

    problem: _Problem
    values: FloatArray
    covariance: FloatArray
    bend: bool
    lamp: float
    scatter: float
    left: FloatArray
    lights: FloatArray
    freedom: int

    @property
    def chi_square(self) -> float:
        """Return the sum of squares of all that is left."""
        return float(np.square(self.left).sum() + np.square(self.lights).sum())

    @property
    def variance_chi_square(self) -> float:
        """Return the sum of squares of the lit sets' variances."""
        return float(np.square(self.left[1, self.problem.light > 0]).sum())

    @property
    def worse(self) -> float:
        """Chi-square over its degrees of freedom, of all or of lit sets' variances: readings of one code always fit."""
        return max(self.chi_square / max(self.freedom, 1), self.variance_chi_square / max(len(self.lights) - 2, 1))

    @property
    def light_fits(self) -> bool:
        """Return True if light is off by no more than is known."""
        off = np.square(self.left[0, self.problem.light > 0]).sum() + np.square(self.lights).sum()
        return bool(off <= scipy.stats.chi2.isf(_CHANCE, max(len(self.lights) - 2, 1)))

    def transfer(self, light: Light) -> Transfer:
        """Return the camera under such ``light``."""
        problem = self.problem
        found = Transfer(
            self.values, self.covariance * max(self.worse, 1.0), problem.saturation_dn,
            problem.saturates, self.lamp, light, self.chi_square, self.freedom, np.full((len(problem.used), 2), np.nan),
        )  # fmt: skip
        found.off[problem.used] = self.left.T
        response = NAMES.index("response")
        found.covariance[response, response] += (found.light_error * found["response"]) ** 2
        return found


@dataclass(frozen=True, eq=False)
class _Problem:
    """Sets below saturation, and where the others say that saturation is.

    `light` and `time` (count,), `measured` means and variances and their `errors` (2, count).
    """

    light: FloatArray
    time: FloatArray
    measured: FloatArray
    errors: FloatArray
    still: int
    spatial: tuple[float, float]
    hidden: bool
    bits: int | None
    saturation_dn: float | None
    saturates: bool
    lamp: float
    used: np.ndarray
    start: FloatArray

    @classmethod
    def of(cls, taken: Sequence[Taken], bits: int | None, still: int, spatial: tuple[float, float]) -> _Problem:
        said = [each.said for each in taken]
        light, time = np.array([(each.light, each.exposure_s) for each in taken]).T
        mean, variance = measured = np.array([(float(each.pair.mean), float(each.pair.variance)) for each in said]).T
        cut, flicker = np.array([each.cut for each in said]).T, np.array([each.flicker for each in said])
        dark = float(mean[light == 0].min())
        peak, last = saturation_of(taken)
        used = (cut[1] < _CUT) | (light == 0)
        if last is not None:
            used &= (light == 0) | (mean - dark <= MOST_FITTED * (mean[peak] - dark))
        saturation = None if last is None else float(mean[last])
        lamp = np.square(flicker / np.maximum(mean - dark, 1e-9)) / np.array([each.count for each in said])
        lit = used & (light > 0)
        # A set without any noise, of which few codes leave nothing, is known to a code's rounding.
        least = 1e-3 if bits is not None else 1e-6 * max(dark, 1.0)
        errors = np.array([(each.mean_error, each.variance_error) for each in said]).T
        # Moments depend on the offsets where an end of the ADC or its steps hide part of the noise.
        found = cls(
            light[used], time[used], measured[:, used], np.maximum(errors[:, used], [[least / 10], [least]]),
            int(used[:still].sum()), spatial,
            bits is not None and (variance.min() < _DITHERED or cut[0].max() > _CUT / 100), bits,
            saturation, saturation is not None and saturation < (math.inf if bits is None else 2.0**bits - 2),
            max(math.sqrt(lamp[lit].mean()) if lit.any() else 0.0, _STEADY), used, np.zeros(len(NAMES)),
        )  # fmt: skip
        return replace(found, start=found._start())

    def _start(self) -> FloatArray:
        """Return numbers near enough to begin at: lines through what is not cut."""
        lit, (mean, variance) = self.light > 0, self.measured
        first = int(np.argmin(np.where(lit, np.inf, self.time)))
        signal, noise, times = mean[lit] - mean[first], variance[lit], self.time[~lit]
        gain = float(np.polyfit(signal, noise, 1, w=1 / self.errors[1, lit])[0]) if lit.sum() > 1 else 0.0
        if not gain > 0:
            gain = max(float((noise.sum() - variance[first]) / max(signal.sum(), 1e-9)), 1e-9)
        response = float((self.light[lit] * signal).sum() / np.square(self.light[lit]).sum()) / gain
        current = max(float(np.polyfit(times, mean[~lit], 1)[0]) / gain, 0.0) if np.ptp(times) > 0 else 0.0
        read = math.sqrt(max(float(variance[first]) - current * times.min() * gain**2 - 1 / 12, 0.01))
        return np.array([gain, read, mean[first], current, max(response, 1e-12), 0.0, 0.0, self.spatial[0]])

    def moments(self, values: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return expected means and variances [DN] of all sets, and of the dark set the variance over its pixels."""
        gain, read, black, current, response, *bends = (float(value) for value in values[:-1])
        gain, response, spatial = max(abs(gain), 1e-12), abs(response), float(values[-1])
        end = self.saturation_dn if self.saturates else None
        if end is None and self.bits is not None:
            end = 2.0**self.bits - 1
        bends = bends if any(bends) else []
        full = math.inf if end is None else max((end - black) / gain / (1 + sum(bends)), 1.0)
        model = _BASE.model_copy(
            update={
                "gain_dn_per_e": gain, "read_noise_e": abs(read) / gain, "black_level_dn": black, "bits": self.bits,
                "full_well_e": full, "linearity": tuple(bends) if math.isfinite(full) else (),
            }
        )  # fmt: skip
        electrons = response * self.light + np.maximum(current, 0.0) * self.time
        if not self.hidden:
            return *frame_moments(electrons, 0.0, model), spatial
        spread = max(spatial, float(_LEAST_STEPS[-1]))
        mean, noise, between = average_moments(electrons, 0.0, model, math.sqrt(spread))
        return mean, noise, float(between[self.still]) * spatial / spread

    def begin(self) -> _Solution:
        """The fit of a linear camera, from other numbers too where the first ones lead nowhere: of few codes, variances
        rise and fall with the mean, and several cameras explain them where no dark noise is seen."""
        found, hidden = [self.solve(bend=False, lamp=self.lamp)], self.measured[1].min() < HIDDEN
        for part in _STARTS if self.measured[1].min() < LEAST_DARK else ():
            best = min(found, key=lambda each: each.chi_square)
            if best.worse <= _FITS and not hidden:
                break
            start = self.start * [part, 0.5, 1.0, 0.0, 1 / part, 0.0, 0.0, 1.0]
            found.append(replace(self, start=start).solve(bend=False, lamp=self.lamp, most=_TRIED))
            if found[-1].chi_square < best.chi_square:
                found.append(replace(self, start=found[-1].values).solve(bend=False, lamp=self.lamp))
        best = min(found, key=lambda each: each.chi_square)
        others = [each.values - best.values for each in found if each.chi_square < best.chi_square + _TELLS]
        off = max(others, key=lambda other: abs(float(other[0])))
        return replace(best, covariance=best.covariance + np.outer(off, off))

    def settle(self, solution: _Solution) -> _Solution:
        """The ``solution`` with the lamp's scatter as large as light is off."""
        for _ in range(3):
            if solution.light_fits:
                break
            solution = self.solve(solution.bend, max(solution.scatter, 1.5 * solution.lamp))
        return solution

    def solve(self, bend: bool, lamp: float, most: int = _SOLVED) -> _Solution:
        """Fit means and variances by least squares, where the light of sets scatters by a part ``lamp``.

        The light of a set moves its mean and its variance together, as (signal, noise of light). The best deviation of
        the light follows from what is left of both, so that it is no parameter.
        """
        lit = self.light > 0
        # Where all readings in the dark are one code, and only rarely the next, their mean tells no current.
        seen = np.ptp(self.time[~lit]) > 0 and self.measured[1, ~lit].max() > HIDDEN
        free = np.array([True, True, True, seen, lit.any(), bend, bend, True])
        values = np.where(free | (np.arange(len(NAMES)) != _DARK), self.start, 0.0)
        by_light = lamp * lit * (self.measured - self.measured[:, ~lit].min(axis=1, keepdims=True)) / self.errors

        def rest(x: FloatArray) -> FloatArray:
            values[free] = x
            mean, variance, spatial = self.moments(values)
            left = (self.measured - [mean, variance]) / self.errors
            light = (by_light * left).sum(axis=0) / (1 + np.square(by_light).sum(axis=0))
            left -= by_light * light
            return np.concatenate([*left, light[lit], [(self.spatial[0] - spatial) / self.spatial[1]]])

        def slopes(x: FloatArray) -> FloatArray:
            steps, here = np.maximum(np.abs(x) * _STEPS[free], _LEAST_STEPS[free]), rest(x)
            return np.stack([(rest(x + step) - here) / step.sum() for step in np.diag(steps)], axis=1)

        solved = scipy.optimize.least_squares(
            rest, values[free], slopes, x_scale="jac", xtol=1e-10, ftol=1e-10, max_nfev=most
        )
        values[free] = solved.x
        # Readings in the dark are known to half a code, and pixels to be alike to it, whatever few codes hide.
        span, code = float(np.ptp(self.time[~lit])), max(_HALF, abs(values[1]))
        known = np.diag([0.0, 1 / code, 1 / code, 0.0, 0.0, 1.0, 1.0, code**-2])
        known[0, [0, _DARK]] = np.array([values[_DARK], values[0]]) * span / code
        normal = solved.jac.T @ solved.jac + known[:, free].T @ known[:, free]
        size = np.sqrt(np.diagonal(normal))
        covariance = np.zeros((len(NAMES), len(NAMES)))
        covariance[np.ix_(free, free)] = np.linalg.pinv(normal / np.outer(size, size), hermitian=True)
        covariance[np.ix_(free, free)] /= np.outer(size, size)
        values[[0, 1, 4]] = np.abs(values[[0, 1, 4]])
        count = len(self.light)
        left, lights = solved.fun[: 2 * count].reshape(2, count), solved.fun[2 * count : -1]
        # Means that are off show the lamp too: both parts of how far light is off.
        off = lamp * lights + (left[0] * self.errors[0])[lit] / np.maximum(self.measured[0, lit] - values[2], 1e-9)
        scatter = float(np.sqrt(np.square(off).sum() / max(lit.sum() - 1 - 2 * bend, 1)))
        freedom = 2 * count - int(free.sum()) + 1
        return _Solution(self, values, covariance, bend, lamp, scatter, left, lights, freedom)


_BASE = SensorModel(
    name="fitted", pixel_pitch_um=1.0, full_well_e=math.inf, read_noise_e=0.0, gain_dn_per_e=1.0, source="frames"
)
