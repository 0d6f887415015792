"""The sensor model that explains lit and dark frames of a camera, each number with its standard error.

The closed-form moments of the whole chain (`mitsim.sensor.chain`) are fitted to the means and variances of all sets
at once, because readings cut at 0 and rounding to few codes bend the straight lines of EMVA 1288.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import scipy

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import toml_value, validate
from mitsim.core.errors import MitsimError
from mitsim.devices.sensor import SensorModel
from mitsim.sensor.chain import frame_moments
from mitsim.sensor.emva import HIDDEN, LEAST_DARK, MOST_FITTED, Alike

NAMES = ("gain", "read", "black", "dark", "response", "bend", "bend_2", "spatial")
"""Units: DN/e-, DN, DN, e-/s, e- per unit of light, 1, 1, and DN^2 (variance of offsets)."""
_DARK = NAMES.index("dark")
_STEPS = np.array([1e-3, 1e-2, 0.0, 1e-3, 1e-3, 0.0, 0.0, 1e-2])
"""Relative and least steps of the numerical derivatives."""
_LEAST_STEPS = np.array([1e-15, 1e-3, 1e-2, 1e-4, 1e-15, 1e-3, 1e-3, 1e-5])
_STARTS = (1.0, 0.9, 0.8, 0.65, 0.5)
"""Fractions of the gain from which the fit starts, because rounding of little noise raises variances up to twice."""
_DITHERED = 0.44
"""Variance [DN^2] below which rounding moves means."""
_NODES = 9
_AT_END = 1e-4
"""Fraction of numbers at the ADC's end from which a set is not below saturation."""
_STEADY, _CHANCE = 1e-5, 1e-3
_FITS = 2.0
"""Reduced chi-square from which other starts of the fit are tried."""
_TELLS = 9.0
"""Difference of chi-square that decides between a bent camera and a drifting lamp: three standard errors."""
_SATURATED, _FALLEN = 0.05, 0.5
_DEAD, _HOT, _FILLED = 0.5, 8.0, 0.9
"""Limits of bad pixels: response, dark current in standard deviations, and dark reading as a part of saturation."""
_SURE = 4.0
"""Standard errors from which an effect enters the camera."""
_UNEVEN, _MOST_UNEVEN = 0.01, 0.25
"""Differences of the light over the frame from which a surface is divided out, and from which frames are refused."""
_CUT = 1e-3
"""Fraction of dark readings at 0 from which lit frames determine the black level."""
_HIDES = 2.0
"""Ratio of the fitted to the observed error of offsets from which offsets count as hidden."""
_MOST_RESPONSE = 0.1
_BASE = SensorModel(
    name="fitted", pixel_pitch_um=1.0, full_well_e=math.inf, read_noise_e=0.0, gain_dn_per_e=1.0, source="frames"
)
Light = Literal["steady", "scatters", "drifts", "undecided"]
Images = Callable[[int], FloatArray]
"""Mean image (M, N) [DN] of the set of an index."""
Places = npt.NDArray[np.intp]
"""(M, N) flat index of the pixel that is read in place of each pixel."""
Known = tuple[float, float]
"""A number and its standard error."""


# ---- choice of sets --------------------------------------------------------------------------------------------------


def saturation_of(taken: Sequence[Alike]) -> tuple[int, int | None]:
    """Return the set with the largest variance, and the saturated set: the brightest, if its variance is small."""
    light, mean, variance = np.array([(each.light, each.mean, each.variance) for each in taken]).T
    lit, still = np.flatnonzero(light > 0), variance[light == 0].min()
    peak, last = lit[variance[lit].argmax()], lit[mean[lit].argmax()]
    left, most = variance[last] - still, variance[peak] - still
    others = lit[light[lit] != light[last]]
    if left < _FALLEN * most and others.size:
        near = others[mean[others].argmax()]
        rise = (mean[last] - mean[near]) / (mean[last] - mean[light == 0].min())
        if rise < _SATURATED * abs(1 - light[near] / light[last]):
            return int(peak), int(last)
    return int(peak), int(last) if left < _SATURATED * most else None


def nonuniform(taken: Sequence[Alike]) -> tuple[int, int]:
    """Return the dark and the lit set for nonuniformity; the lit set has most frames near half of saturation."""
    mean = np.array([each.mean for each in taken])
    dark = [index for index, each in enumerate(taken) if not each.light]
    lit = [index for index, each in enumerate(taken) if each.light and each.cut[1] < _AT_END]
    floor, full = mean[dark].min(), mean[saturation_of(taken)[0]]
    part = (mean - floor) / max(full - floor, 1e-9)
    near = [index for index in lit if 0.3 <= part[index] <= MOST_FITTED] or lit
    bright = max(near, key=lambda index: (taken[index].count, -abs(part[index] - 0.5)))
    time = taken[bright].exposure_s
    return min(dark, key=lambda index: (abs(taken[index].exposure_s - time), -taken[index].count)), bright


# ---- fit of means and variances --------------------------------------------------------------------------------------


def average_moments(electrons: FloatArray, model: SensorModel, spread: float) -> tuple[FloatArray, ...]:
    """Return mean and variance [DN] averaged over pixels, and the variance of their means, if offsets `spread` [DN]."""
    places, weights = np.polynomial.hermite_e.hermegauss(_NODES)
    models = [model.model_copy(update={"black_level_dn": model.black_level_dn + z * spread}) for z in places]
    found = [frame_moments(electrons, 0.0, each) for each in models]
    means, noises = (np.stack(part) for part in zip(*found, strict=True))
    mean, noise = (np.average(part, axis=0, weights=weights) for part in (means, noises))
    return mean, noise, np.average(np.square(means - mean), axis=0, weights=weights)


@dataclass(frozen=True, eq=False)
class Transfer:
    """The fit of means and variances.

    Attributes
    ----------
    values, covariance : numbers by `NAMES` and their covariance; 0 if not fitted.
    saturation_dn, saturates : mean of saturated frames [DN]; True if the full well causes it, and not the ADC.
    lamp, scatter : relative scatter of the light, assumed and found.
    light : "undecided" if means bend and variances do not show whether camera or lamp is the cause.
    off : (sets, 2) deviation of mean and variance in standard errors; NaN for unused sets.
    worse : reduced chi-square, also of lit variances, because readings of one code always fit.
    """

    values: FloatArray
    covariance: FloatArray
    saturation_dn: float | None
    saturates: bool
    bent: bool
    lamp: float
    light: Light
    chi_square: float
    freedom: int
    off: FloatArray
    scatter: float
    variance_chi_square: float
    worse: float
    light_fits: bool

    def __getitem__(self, name: str) -> float:
        return float(self.values[NAMES.index(name)])

    def error(self, name: str) -> float:
        index = NAMES.index(name)
        return math.sqrt(self.covariance[index, index])

    def under(self, light: Light) -> Transfer:
        done = replace(self, light=light, covariance=self.covariance * max(self.worse, 1.0))
        if light in ("scatters", "drifts"):  # an error that all sets share, because no set is known to be right
            index = NAMES.index("response")
            done.covariance[index, index] += (self.lamp * done["response"]) ** 2
        return done


def fit(taken: Sequence[Alike], bits: int | None, still: int, spatial: Known) -> Transfer:
    problem = _Problem(taken, bits, still, spatial)
    steady = problem.begin()
    if steady.light_fits or problem.lit.sum() < 4:
        return steady.under("steady")
    bent = problem.solve(problem.start, bend=True, lamp=problem.lamp)
    explains = bent.light_fits
    bent, wide = problem.settle(bent), problem.settle(steady)
    told = bent.variance_chi_square - wide.variance_chi_square
    if told < -_TELLS:
        return bent.under("steady" if explains else "scatters")
    if explains and told < _TELLS:
        off = bent.values - wide.values
        return replace(bent, covariance=bent.covariance + np.outer(off, off)).under("undecided")
    return wide.under("drifts" if bent.lamp < wide.lamp / 2 else "scatters")


class _Problem:
    def __init__(self, taken: Sequence[Alike], bits: int | None, still: int, spatial: Known) -> None:
        light, time, mean, variance, flicker = np.array(
            [(each.light, each.exposure_s, each.mean, each.variance, each.flicker) for each in taken]
        ).T
        cut, dark = np.array([each.cut for each in taken]).T, float(mean[light == 0].min())
        peak, last = saturation_of(taken)
        used = (cut[1] < _AT_END) | (light == 0)
        if last is not None:
            used &= (light == 0) | (mean - dark <= MOST_FITTED * (mean[peak] - dark))
        self.saturation_dn = None if last is None else float(mean[last])
        end = math.inf if bits is None else 2.0**bits - 1
        self.saturates = self.saturation_dn is not None and self.saturation_dn < end - 1
        self.end = self.saturation_dn if self.saturation_dn is not None and self.saturates else end
        lamp = np.square(flicker / np.maximum(mean - dark, 1e-9)) / np.array([each.count for each in taken])
        lit = used & (light > 0)
        self.lamp = max(math.sqrt(lamp[lit].mean()) if lit.any() else 0.0, _STEADY)
        # A set without noise, which few codes hide, is known to the rounding of a code.
        least = 1e-3 if bits is not None else 1e-6 * max(dark, 1.0)
        errors = np.array([(each.mean_error, each.variance_error) for each in taken]).T
        self.errors = np.maximum(errors[:, used], [[least / 10], [least]])
        self.measured = np.array([mean, variance])[:, used]
        self.light, self.time, self.lit, self.used = light[used], time[used], light[used] > 0, used
        self.still, self.spatial, self.bits = int(used[:still].sum()), spatial, bits
        # Moments depend on the offsets where an end of the ADC or its steps hide part of the noise.
        self.hidden = bits is not None and (variance.min() < _DITHERED or cut[0].max() > _AT_END / 100)
        # Straight lines through the used sets, from which the fit starts.
        lit, (mean, variance) = self.lit, self.measured
        first = int(np.argmin(np.where(lit, np.inf, self.time)))
        signal, noise, times = mean[lit] - mean[first], variance[lit], self.time[~lit]
        gain = float(np.polyfit(signal, noise, 1, w=1 / self.errors[1, lit])[0]) if lit.sum() > 1 else 0.0
        if not gain > 0:
            gain = max(float((noise.sum() - variance[first]) / max(signal.sum(), 1e-9)), 1e-9)
        response = float((self.light[lit] * signal).sum() / np.square(self.light[lit]).sum()) / gain
        current = max(float(np.polyfit(times, mean[~lit], 1)[0]) / gain, 0.0) if np.ptp(times) > 0 else 0.0
        read = math.sqrt(max(float(variance[first]) - current * times.min() * gain**2 - 1 / 12, 0.01))
        self.start = np.array([gain, read, mean[first], current, max(response, 1e-12), 0.0, 0.0, self.spatial[0]])

    def moments(self, values: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        gain, read, black, current, response, *bends = (float(value) for value in values[:-1])
        gain, response, spatial = max(abs(gain), 1e-12), abs(response), float(values[-1])
        bends = bends if any(bends) else []
        full = max((self.end - black) / gain / (1 + sum(bends)), 1.0)
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
        mean, noise, between = average_moments(electrons, model, math.sqrt(spread))
        return mean, noise, float(between[self.still]) * spatial / spread

    def begin(self) -> Transfer:
        """Fit a linear camera, from several starts if several cameras may explain few codes."""
        found, hidden = [self.solve(self.start)], self.measured[1].min() < HIDDEN
        for part in _STARTS if self.measured[1].min() < LEAST_DARK else ():
            if hidden or min(found, key=lambda each: each.chi_square).worse > _FITS:
                found.append(self.solve(self.start * [part, 0.5, 1.0, 0.0, 1 / part, 0.0, 0.0, 1.0]))
        best = min(found, key=lambda each: each.chi_square)
        others = [each.values - best.values for each in found if each.chi_square < best.chi_square + _TELLS]
        off = max(others, key=lambda other: abs(float(other[0])))
        return replace(best, covariance=best.covariance + np.outer(off, off))

    def settle(self, found: Transfer) -> Transfer:
        """Refit until the lamp's scatter agrees with the deviations of the light."""
        for _ in range(3):
            if found.light_fits:
                break
            found = self.solve(self.start, found.bent, max(found.scatter, 1.5 * found.lamp))
        return found

    def solve(self, start: FloatArray, bend: bool = False, lamp: float | None = None) -> Transfer:
        """Fit means and variances by least squares if the light of sets scatters by a fraction `lamp`.

        The light of a set moves its mean and variance together. Its best deviation follows from both residuals.
        """
        lit, lamp = self.lit, self.lamp if lamp is None else lamp
        # If all dark readings are one code and rarely the next, their mean shows no current.
        seen = np.ptp(self.time[~lit]) > 0 and self.measured[1, ~lit].max() > HIDDEN
        free = np.array([True, True, True, seen, lit.any(), bend, bend, True])
        values = np.where(free | (np.arange(len(NAMES)) != _DARK), start, 0.0)
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

        limits = {"x_scale": "jac", "xtol": 1e-10, "ftol": 1e-10, "max_nfev": 35}
        solved = scipy.optimize.least_squares(rest, values[free], slopes, **limits)
        values[free] = solved.x
        # Dark readings are known to half a code, and pixels are alike to half a code, even if few codes hide it.
        span, code = float(np.ptp(self.time[~lit])), max(0.5, abs(values[1]))
        known = np.diag([0.0, 1 / code, 1 / code, 0.0, 0.0, 1.0, 1.0, code**-2])
        known[0, [0, _DARK]] = np.array([values[_DARK], values[0]]) * span / code
        normal = solved.jac.T @ solved.jac + known[:, free].T @ known[:, free]
        size = np.sqrt(np.diagonal(normal))
        covariance = np.zeros((len(NAMES), len(NAMES)))
        covariance[np.ix_(free, free)] = np.linalg.pinv(normal / np.outer(size, size), hermitian=True)
        covariance[np.ix_(free, free)] /= np.outer(size, size)
        values[[0, 1, 4]] = np.abs(values[[0, 1, 4]])
        count, number = len(self.light), int(lit.sum())
        left, lights = solved.fun[: 2 * count].reshape(2, count), solved.fun[2 * count : -1]
        # Means that are off show the lamp too: both are parts of how far light is off.
        away = lamp * lights + (left[0] * self.errors[0])[lit] / np.maximum(self.measured[0, lit] - values[2], 1e-9)
        off = np.full((len(self.used), 2), np.nan)
        off[self.used] = left.T
        chi_square, freedom = float(np.square(left).sum() + np.square(lights).sum()), 2 * count - int(free.sum()) + 1
        of_variances, more = float(np.square(left[1, lit]).sum()), max(number - 2, 1)
        of_light = np.square(left[0, lit]).sum() + np.square(lights).sum()
        return Transfer(
            values, covariance, self.saturation_dn, self.saturates, bend, lamp, "steady", chi_square, freedom, off,
            float(np.sqrt(np.square(away).sum() / max(number - 1 - 2 * bend, 1))), of_variances,
            max(chi_square / max(freedom, 1), of_variances / more),
            bool(of_light <= scipy.stats.chi2.isf(_CHANCE, more)),
        )  # fmt: skip


# ---- differences between pixels, and the camera ----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class FoundCamera:
    sensor: SensorModel
    errors: dict[str, float]
    transfer: Transfer = field(repr=False)
    pixels: Pixels = field(repr=False)
    notes: tuple[str, ...]

    def toml(self) -> str:
        lines = ["# Measured by `mitsim characterise`: numbers with their standard errors.", "#"]
        lines += [f"# {note}" for note in self.notes]
        lines.append("")
        for name, value in self.sensor.model_dump(exclude_defaults=True).items():
            error = self.errors.get(name)
            lines.append(f"{name} = {toml_value(value)}" + (f"  # +- {error:.2g}" if error else ""))
        return "\n".join(lines) + "\n"


class Pixels:
    """Differences between pixels, and the fields of the camera that follow.

    Hot and dead pixels are counted and then replaced, so that they affect no other number. ``again`` are statistics
    with some pixels replaced; ``uneven`` and ``surface`` are range and relative variances (row, column, pixel) of the
    light.
    """

    def __init__(self, taken: Sequence[Alike], images: Images, again: Callable[[Places], Sequence[Alike]]) -> None:
        dark, self.bright = nonuniform(taken)
        unlit = [index for index, each in enumerate(taken) if not each.light]
        self.long = max(unlit, key=lambda index: (taken[index].exposure_s, taken[index].count))
        self.least = min(unlit, key=lambda index: (taken[index].exposure_s, -taken[index].count))
        self.short = max(unlit, key=lambda index: (taken[index].count, -taken[index].exposure_s))
        self.taken, self.notes = taken, list[str]()
        offset, longest = images(self.short), images(self.long)
        contrast = images(self.bright) - (offset if dark == self.short else images(dark))
        middle, noise = float(np.median(contrast)), math.sqrt(self._noise(self.bright, dark))
        dead = contrast < _DEAD * middle if 10 * noise < middle else np.zeros(contrast.shape, bool)
        middle, full = float(np.median(longest)), taken[saturation_of(taken)[0]].mean
        filled, hot = longest > middle + _FILLED * (full - middle), np.zeros(contrast.shape, bool)
        excess, self.beyond = None, 0.0
        if taken[self.long].exposure_s > taken[self.least].exposure_s:
            excess = longest - (offset if self.least == self.short else images(self.least))
            middle = float(np.median(excess))
            # With few codes most readings are one number, and the noise is the rest.
            wide = 1.4826 * float(np.median(np.abs(excess - middle)))
            wide = max(math.sqrt(self._noise(self.long, self.least)), wide, 1e-9)
            if taken[self.least].variance < LEAST_DARK:
                wide = max(wide, 12**-0.5)
            hot = excess > middle + _HOT * wide
            self.beyond = float(excess[hot].mean() - excess[~hot].mean()) if hot.any() else 0.0
        dead = (dead | filled) & ~hot  # pixels that are full at every exposure show no light
        bad = dead | hot
        self.dead, self.hot, self.filled = (float(part.mean()) for part in (dead, hot, filled))
        if bad.any():
            # Good pixels from anywhere, drawn at random, so that rows gain no common noise.
            places = np.arange(bad.size).reshape(bad.shape)
            places[bad] = np.random.default_rng(0).choice(np.flatnonzero(~bad), np.count_nonzero(bad))
            self.taken = again(places)
            offset, contrast = offset.flat[places], contrast.flat[places]
            excess = None if excess is None else excess.flat[places]
        surface, self.surface = _surface(contrast), np.zeros(3)
        surface /= surface.mean()
        self.uneven = float(np.ptp(surface))
        if self.uneven > _UNEVEN:
            contrast = contrast / surface
            self.surface = np.roll(_spatial_parts(surface, 0.0, 0.0)[0], -1)
        self.excess, self.shape, self.size = excess, contrast.shape, contrast.size
        self.offsets = _spatial_parts(offset, self._noise(self.short), self._shared(self.short))
        square = float(contrast.mean()) ** 2
        noise, rows = self._noise(self.bright, dark), self._shared(self.bright, dark)
        self.responses = _spatial_parts(contrast / math.sqrt(square), noise / square, rows / square)

    def _noise(self, *sets: int) -> float:
        """Return the variance [DN^2] that noise leaves in a pixel of a difference of mean images."""
        return sum(self.taken[index].variance / self.taken[index].count for index in sets)

    def _shared(self, *sets: int) -> float:
        return sum(self.taken[index].rows / self.taken[index].count for index in sets)

    def _mean_variance(self, parts: FloatArray) -> float:
        return max(float((parts / [self.size, *self.shape]).sum()), 0.0)

    def camera(self, stated: Mapping[str, Any], photons: bool) -> FoundCamera:
        if self.uneven > _MOST_UNEVEN:
            raise MitsimError(
                f"light differs by {100 * self.uneven:.0f} % over the frame; at most {100 * _MOST_UNEVEN:.0f} % is "
                "possible; move the lamp away, or crop the frames to the evenly lit part"
            )
        wide = math.sqrt(max(*self.responses[0], 0.0))
        if wide > _MOST_RESPONSE:
            raise MitsimError(
                f"responses of pixels differ by {100 * wide:.0f} %, and a camera file states at most "
                f"{100 * _MOST_RESPONSE:.0f} %; give the frames of one colour behind filters, and light that is even"
            )
        bits = stated["bits"]
        least = 1e-12 if bits is None else 1 / self.size  # one pixel may have another code
        spatial = float(self.offsets[0].sum()), max(math.hypot(*self.offsets[1]), least)
        transfer = fit(self.taken, bits, self.short, spatial)
        gain, gain_error, bends = transfer["gain"], transfer.error("gain"), (transfer["bend"], transfer["bend_2"])
        found = {"gain_dn_per_e": (gain, gain_error), **self._read(transfer), **self._dark(transfer)}
        found |= self._offsets(transfer, spatial, found["dark_current_spread_e_per_s"][0])
        found["dead_pixels"] = self.dead, math.sqrt(max(self.dead, 1 / self.size) / self.size)
        top = None if bits is None else 2.0**bits - 1
        if any(bends):  # relative responses are steeper or flatter on a bent curve
            well = max(((transfer.saturation_dn or math.inf) - transfer["black"]) / gain / (1 + sum(bends)), 1.0)
            x = transfer["response"] * self.taken[self.bright].light / well
            bent = (1 + 2 * bends[0] * x + 3 * bends[1] * x**2) / (1 + bends[0] * x + bends[1] * x**2)
        else:
            bent = 1.0
        for name, value, error in zip(("pixel", "row", "column"), *self.responses, strict=True):
            found[f"prnu_{name}"] = _root(value / bent**2, error / bent**2)
        if photons:
            still = self._mean_variance(np.maximum(self.responses[0], 0))  # of a specimen's pixels
            value, error = transfer["response"], transfer.error("response")
            found["quantum_efficiency"] = min(value, 1.0), math.hypot(error, value * math.sqrt(still))
            if value > 1 + _SURE * found["quantum_efficiency"][1]:
                raise MitsimError(
                    f"photons_per_s: light makes {value:.3g} electrons a photon; at most 1 is possible, "
                    "so correct photons_per_s (photons on one pixel in a second), or leave it out"
                )
        end = transfer.saturation_dn if transfer.saturates else top
        if transfer.saturation_dn is None:
            what = "is set to the electrons that reach the ADC's end" if top else "is set to infinity"
            self.notes.append(f"full well: no frame is saturated, so it {what}; take brighter frames")
        elif not transfer.saturates:
            self.notes.append("full well: the ADC's end is reached first, so it may be larger")
        full, error = math.inf, 0.0
        if end is not None:
            height, sum_ = end - transfer["black"], 1 + sum(bends)
            full = height / gain / sum_
            if transfer.saturation_dn is not None:  # an assumed number has no error
                # The errors of gain, black level and both bends (`NAMES`) are not independent.
                slopes = np.array([1 / gain, 0, 1 / height, 0, 0, 1 / sum_, 1 / sum_, 0])
                error = full * math.sqrt(slopes @ transfer.covariance @ slopes)
        found["full_well_e"] = full, error
        fields: dict[str, Any] = {name: float(f"{value:.7g}") for name, (value, _) in found.items()}
        errors = {name: error for name, (_, error) in found.items()}
        if any(bends):
            fields["linearity"] = tuple(float(f"{value:.7g}") for value in bends)
            errors["linearity"] = transfer.error("bend")
        sensor = validate(SensorModel, {**fields, **stated}, "camera found")
        return FoundCamera(sensor, errors, transfer, self, tuple(self.notes))

    def _read(self, transfer: Transfer) -> dict[str, Known]:
        gain, read, error = transfer["gain"], transfer["read"], transfer.error("read")
        dark = [each for each in self.taken if not each.light]
        if min(each.variance for each in dark) < LEAST_DARK:
            error = max(error, math.sqrt(LEAST_DARK - 1 / 12) - read)  # few codes hide the noise: an upper limit
        (m, n), values = self.shape, np.array([each.rows for each in dark])
        middle = max(float(np.median(values)), 0.0)
        errors = [math.sqrt(2 / m / (each.count - 1)) * ((each.variance - middle) / n + middle) for each in dark]
        weight = 1 / np.maximum(errors, 1e-12) ** 2
        share = (1 - self.hot - self.dead) ** 2  # the other pixels were read in other rows
        row_error = float(weight.sum() ** -0.5 / share)
        shared, shared_error = _root(float((values * weight).sum() / weight.sum() / share), row_error)
        own = math.sqrt(max(read**2 - shared**2, 0.0))
        apart = row_error / max(2 * own, 1e-9) if shared else 0.0
        own_error = math.hypot(error, own * transfer.error("gain") / gain, apart)
        black = transfer["black"]
        black_error = math.hypot(transfer.error("black"), math.sqrt(self._mean_variance(self.offsets[0])))
        if black < -_SURE * black_error and max(each.cut[0] for each in dark) > _CUT:
            raise MitsimError(
                f"frames: the black level is {black:.3g} +- {black_error:.1g} DN by the frames under light, so that "
                "dark readings are cut at 0; a camera file states 0 or more; raise the black level (offset, pedestal) "
                "of the camera, or subtract less from the frames"
            )
        return {
            "read_noise_e": (own / gain, own_error / gain),
            "row_noise_e": (shared / gain, shared_error / gain),
            "black_level_dn": (max(black, 0.0), black_error),
        }

    def _dark(self, transfer: Transfer) -> dict[str, Known]:
        mean, error = transfer["dark"], transfer.error("dark")
        names = "dark_current_e_per_s", "dark_current_spread_e_per_s", "hot_pixels", "hot_dark_current_e_per_s"
        if self.excess is None:
            self.notes.append("dark current needs dark frames of two exposures, and is set to 0; take them")
            return dict.fromkeys(names, (0.0, 0.0))
        gain, both = transfer["gain"], (self.taken[self.long], self.taken[self.least])
        unit, count, (m, n) = gain * (both[0].exposure_s - both[1].exposure_s), self.size, self.shape
        if not error:
            error = 0.5 / unit
            self.notes.append(f"dark current is hidden by rounding, and set to 0; it is below {error:.2g} e-/s")
        beyond = max(self.beyond, 0.0) / unit
        rows = sum(max(each.rows, 0.0) / each.count for each in both) * (1 - 1 / m)
        noise = self._noise(self.long, self.least) - rows
        even = self.excess - self.excess.mean(axis=1, keepdims=True)
        variance = float(np.square(even).mean()) * n / (n - 1)
        spread, spread_error = (variance - noise) / unit**2, math.sqrt(2 / count) * variance / unit**2
        wide, wide_error = _root(spread if mean > 0 else 0.0, spread_error)
        counted = sum(gain**2 * beyond * each.exposure_s / each.count for each in both)
        hot_error = math.sqrt((variance + counted) / max(self.hot * count, 1) + rows / m) / unit
        found = (
            (max(mean, 0.0), math.hypot(error, wide / math.sqrt(count))), (wide, wide_error),
            (self.hot, math.sqrt(max(self.hot, 1 / count) / count)), (beyond, hot_error if self.hot else 0.0),
        )  # fmt: skip
        return dict(zip(names, found, strict=True))

    def _offsets(self, transfer: Transfer, seen: Known, spread: float) -> dict[str, Known]:
        """Return offsets [e-]; the fit gives their spread, because rounding changes the spread of mean readings."""
        true, error = transfer["spatial"], transfer.error("spatial")
        gain, gain_error = transfer["gain"], transfer.error("gain")
        sure = seen[0] > _SURE * seen[1] and true > _SURE * error
        values = self.offsets[0] * (true / seen[0] if sure else 0.0)
        own = math.sqrt(max(error**2 - seen[1] ** 2, 0.0)) / max(true, 1e-300) if sure else 0.0
        hidden = not sure and error > _HIDES * seen[1]
        errors = np.full(3, error) if hidden else self.offsets[1] * (true / seen[0] if sure else 1.0)
        values[0] -= (gain * spread * self.taken[self.short].exposure_s) ** 2
        found = {}
        for name, value, each in zip(("pixel", "row", "column"), values, errors, strict=True):
            kept, kept_error = _root(value / gain**2, math.hypot(each, value * own) / gain**2)
            found[f"dsnu_{name}_e"] = kept, math.hypot(kept_error, kept * gain_error / gain)
        if hidden:
            self.notes.append(
                "dsnu_*_e are hidden by rounding or by the ADC's end, and set to 0; dsnu_pixel_e is below "
                f"{found['dsnu_pixel_e'][1]:.2g} e-"
            )
        return found


def _spatial_parts(image: FloatArray, noise: float, rows: float) -> tuple[FloatArray, FloatArray]:
    """Return spatial variances of an image by pixel, row and column, and their standard errors."""
    m, n = image.shape
    rows *= 1 - 1 / m  # variances about the frame's mean contain a row of m less
    about = image - image.mean()
    total = float(np.square(about).sum()) / (m * n - 1) - noise
    row, column = (float(np.square(about.mean(axis=k)).mean()) for k in (1, 0))
    row -= (noise - rows) / n + rows
    column -= (noise - rows) / m
    pixel = m * n / (m * n - m - n) * (total - row - column)
    values = np.array([pixel, row - pixel / n, column - pixel / m])
    own = max(pixel, 0.0) + noise - rows
    errors = np.sqrt(2.0 / np.array([(m - 1) * (n - 1), m - 1, n - 1])) * (
        own / np.array([1.0, n, m]) + np.maximum([0.0, values[1] + rows, values[2]], 0.0)
    )
    return values, errors


def _surface(image: FloatArray) -> FloatArray:
    legendre = [np.polynomial.legendre.legvander(np.linspace(-1, 1, side), 2) for side in image.shape]
    y, x = (np.linalg.pinv(each) for each in legendre)
    keep = np.add.outer(np.arange(3), np.arange(3)) <= 2
    return np.asarray(legendre[0] @ ((y @ image @ x.T) * keep) @ legendre[1].T)


def _root(square: float, error: float) -> Known:
    """Return the root of a variance and its standard error; 0 and the largest likely root if it may be chance."""
    root = math.sqrt(square) if square > _SURE * error else 0.0
    return root, error / (2 * root) if root else math.sqrt(max(square, 0.0) + error)
