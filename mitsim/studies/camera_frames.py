"""Frames that characterise a camera: simulated or a real camera's, their statistics, and closed-form expectations."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.images import image_size, read_image
from mitsim.core.job import Cost, Job
from mitsim.core.parallel import in_threads
from mitsim.core.seeds import stream
from mitsim.devices.framelist import DarkSet, FlatFrames, LitSet, capacity_of
from mitsim.devices.sensor import EXPOSURE_S, SensorModel
from mitsim.sensor.camera_fit import FoundCamera, Places, average_moments, nonuniform, saturation_of
from mitsim.sensor.chain import dark_current_variance, expose, mean_dark_current, response_variance
from mitsim.sensor.emva import LEAST_DARK, LINEAR, MOST_FITTED, SPLIT, Alike, Pair, Session, Stack, alike, pairs_of
from mitsim.sensor.moments import frame_moments
from mitsim.studies.emva_options import Procedure

# -------- Simulated frames, and closed-form expectations

_TO = 1.15
_DARK_STEPS = 6
_DARK_FILL, _DARK_ELECTRONS = 0.4, 2000.0
"""Dark electrons at the longest exposure: a fraction of saturation, or enough for a permille."""
_LONGEST_S = 10.0
_FILLED_BY_DARK = 0.01
_DITHERED, _CLEAR = 0.6, 8.0
"""Noise of reading [DN], and deviations from 0, from which mean readings follow offsets."""
_SESSIONS = 1000


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames of a camera in S sets of frames that are taken alike.

    Attributes
    ----------
    light, electrons : (S,) light on a pixel, in any unit, and in photoelectrons; 0 in the dark.
    lamp : relative errors of the light of each set, and of all sets.
    surface : relative variances of uneven light by row, column and pixel.
    """

    sensor: SensorModel
    shape: tuple[int, int]
    light: FloatArray
    electrons: FloatArray
    exposure_s: FloatArray
    counts: npt.NDArray[np.intp]
    dark: int
    bright: int
    saturates: bool = True
    seed: int = 0
    lamp: tuple[float, float] = (0.0, 0.0)
    surface: FloatArray | float = 0.0

    @classmethod
    def of(cls, sensor: SensorModel, procedure: Procedure) -> Frames:
        """Return the frames of a simulated camera; MitsimError if no light saturates it."""
        capacity, steps, pixels = capacity_of(sensor), procedure.steps, procedure.pixels
        hottest = sensor.dark_current_e_per_s + sensor.hot_dark_current_e_per_s
        hottest = sensor.binning**2 * sensor.dark_factor * hottest
        longest, exposure_s = _LONGEST_S, math.inf
        if hottest:
            longest = min(_DARK_FILL * capacity / hottest, _DARK_ELECTRONS / mean_dark_current(sensor))
            exposure_s = _FILLED_BY_DARK * capacity / hottest
        longest = min(max(longest, EXPOSURE_S[0] * _DARK_STEPS), EXPOSURE_S[1])
        times = longest * np.arange(_DARK_STEPS) / (_DARK_STEPS - 1)
        ladder, beyond = capacity * _TO * np.arange(1, steps + 1) / steps, 2 * capacity + 20 * math.sqrt(capacity)
        electrons = np.concatenate([ladder, [beyond, capacity / 2, 0.0], np.zeros(_DARK_STEPS)])
        exposures = np.concatenate([np.full(steps + 3, min(0.01, exposure_s)), times])
        counts, bright = np.full(len(electrons), 2), steps + 1
        counts[[bright, bright + 1]] = procedure.frames
        light = electrons / procedure.efficiency(sensor)
        return cls(
            sensor, (pixels, pixels), light, electrons, exposures, counts, bright + 1, bright, seed=procedure.seed
        )

    @classmethod
    def as_taken(cls, taken: Sequence[Alike], found: FoundCamera) -> Frames:
        transfer = found.transfer
        light, time, counts = (
            np.array([getattr(each, name) for each in taken]) for name in ("light", "exposure_s", "count")
        )
        return cls(
            found.sensor, taken[0].shape, light, transfer["response"] * light, time, counts, *nonuniform(taken),
            saturation_of(taken)[1] is not None, lamp=(transfer.lamp, transfer.light_error),
            surface=found.pixels.surface,
        )  # fmt: skip

    @property
    def step(self) -> float:
        levels = np.unique(self.electrons)
        return float(np.diff(levels)[np.searchsorted(levels[1:-1], capacity_of(self.sensor))])

    def images(self, index: int, places: Places | None = None) -> Iterator[FloatArray]:
        """Yield the frames of a set, with the pixel at `places` (M, N) in place of each pixel."""
        for number in range(self.counts[index]):
            shot, read = (stream(self.seed, "characterise", noise, index, number) for noise in ("shot", "read"))
            light = np.full(self.shape, self.electrons[index])
            image = np.asarray(expose(light, float(self.exposure_s[index]), self.sensor, shot, read), dtype=np.float64)
            yield image if places is None else image.flat[places]

    def take(self, job: Job, places: Places | None = None) -> list[Alike]:
        largest = math.inf if self.sensor.largest_dn is None else float(self.sensor.largest_dn)

        def taken(index: int) -> Alike:
            return alike(self.images(index, places), largest, float(self.light[index]), float(self.exposure_s[index]))

        job.progress("frames", 0.0)
        with job.clock.stage("frames"):
            return in_threads(taken, range(len(self.light)))

    def session(self, pairs: Sequence[Pair | Alike], dark: Stack, bright: Stack) -> Session:
        return Session(
            self.shape, self.light, self.exposure_s, pairs_of(pairs), self.dark, self.bright, dark, bright,
            self.saturates, self.sensor.bits is not None,
        )  # fmt: skip

    def expect(self) -> Session:
        pairs, (m, n), stacks = [self.expected_pair(index) for index in range(len(self.light))], self.shape, []
        for index in (self.dark, self.bright):
            still, parts = self.parts(index, 0.0), self.parts(index)
            slopes = self.offset_slope(index), self.slope(self.electrons[index])
            rows, columns, pixel = slopes[0] ** 2 * still + slopes[1] ** 2 * (parts - still)
            mean = np.asarray(pairs[index].mean)
            stacks.append(Stack(mean, rows + columns + pixel, rows + pixel / n, columns + pixel / m))
        return self.session(pairs, *stacks)

    def expected_pair(self, index: int, part: float = 1.0) -> Pair:
        sensor, light = self.sensor, np.array([part * self.electrons[index], 0.0])
        response = math.hypot(*sensor.response_parts) if light[0] > MOST_FITTED * capacity_of(sensor) else 0.0
        moments = average_moments(light, float(self.exposure_s[index]), self.equal, self.spread, response)[:2]
        mean, variance = (
            np.asarray((1 - sensor.dead_pixels) * lit + sensor.dead_pixels * dark) for lit, dark in moments
        )
        return Pair(mean, variance, np.minimum((sensor.superpixel_row_noise_e * sensor.gain_dn_per_e) ** 2, variance))

    @property
    def equal(self) -> SensorModel:
        names = (
            *(f"dsnu_{part}_e" for part in SPLIT[1:]), *(f"prnu_{part}" for part in SPLIT[1:]),
            "dark_current_spread_e_per_s", "hot_pixels", "hot_dark_current_e_per_s", "dead_pixels", "crosstalk",
        )  # fmt: skip
        mean = self.sensor.dark_current_e_per_s + self.sensor.hot_pixels * self.sensor.hot_dark_current_e_per_s
        return self.sensor.model_copy(update={**dict.fromkeys(names, 0.0), "dark_current_e_per_s": mean})

    @property
    def spread(self) -> float:
        """Standard deviation of the pixels' offsets [DN] if rounding or the ADC's end changes it; otherwise 0."""
        sensor, gain = self.sensor, self.sensor.gain_dn_per_e
        spread, noise = math.hypot(*sensor.offset_parts) * gain, sensor.superpixel_reading_noise_e * gain
        clear = noise > _DITHERED and sensor.superpixel_black_level_dn > _CLEAR * math.hypot(noise, spread)
        return 0.0 if sensor.bits is None or clear else spread

    def offset_slope(self, index: int) -> float:
        spread = self.spread
        if not spread:
            return self.sensor.gain_dn_per_e
        *_, between = average_moments(self.electrons[[index]], float(self.exposure_s[index]), self.equal, spread)
        return self.sensor.gain_dn_per_e * math.sqrt(float(between[0])) / spread

    def slope(self, electrons: float) -> float:
        if not self.sensor.linearity:
            return self.sensor.gain_dn_per_e
        around = np.array([electrons * 0.999, electrons * 1.001 + 1])
        mean, _ = frame_moments(around, float(self.exposure_s[self.dark]), self.equal)
        return float(np.diff(mean)[0] / np.diff(around)[0])

    def parts(self, index: int, light: float = 1.0) -> FloatArray:
        """Return the given spatial variances (row, column, pixel) [e-^2] at a part of a set's light."""
        sensor, (pixel, row, column) = self.sensor, np.square(self.sensor.offset_parts)
        dark = dark_current_variance(sensor) * float(self.exposure_s[index]) ** 2
        _, rows, columns = np.square(sensor.response_parts)
        responses = np.array([rows, columns, response_variance(sensor) - rows - columns]) + self.surface
        still = np.array([row, column, pixel + dark])
        return np.asarray(still + (light * float(self.electrons[index])) ** 2 * responses)


def draw_sessions(frames: Frames, expected: Session) -> Session:
    """Draw statistics of many sessions about the expected ones, with the scatter of noise and specimen.

    A variance of n pixels in L frames whose rows share v_r of v has the variance (2 v_o^2/(L-1) + k_4/L)/n +
    (4 v_o v_r/n + 2 v_r^2/M)/(L-1), with v_o = v - v_r and k_4 = K^4 mu the fourth cumulant of the counts.
    """
    sensor, rng = frames.sensor, stream(frames.seed, "characterise", "sessions")
    m, n = frames.shape
    gain, (pixel, row, column) = sensor.gain_dn_per_e, sensor.response_parts
    response = rng.standard_normal((_SESSIONS, 1)) * math.sqrt(row**2 / m + column**2 / n + pixel**2 / m / n)
    leak = rng.standard_normal((_SESSIONS, 1)) * math.sqrt(dark_current_variance(sensor) / m / n)
    mean, variance, rows = (part[None, :] for part in vars(expected.pairs).values())
    own, count, more = variance - rows, frames.counts, frames.counts - 1
    z = rng.standard_normal((4, _SESSIONS, mean.shape[1]))
    specimen = gain * (frames.electrons * response + frames.exposure_s * leak) * (own > 0)
    fourth = gain**4 * (frames.electrons + mean_dark_current(sensor) * frames.exposure_s) / count
    spread = (2 * own**2 / more + fourth + 4 * own * rows / more) / m / n
    shared = np.sqrt(2.0 / m / more) * rows * z[2]
    mean = mean + specimen + z[0] * np.sqrt((own / m / n + rows / m) / count)
    variance = variance + np.sqrt(spread) * z[1] + shared
    rows = rows + shared + np.sqrt(2.0 / m / more) * own / n * z[3]
    if any(frames.lamp):  # the light of each set is off by one part, and that of all sets by another
        each, every = frames.lamp
        step = min(max(frames.lamp), 0.5)
        low, high = (
            pairs_of([frames.expected_pair(index, 1 + side * step) for index in range(len(frames.light))])
            for side in (-1, 1)
        )
        off = each * rng.standard_normal(mean.shape) + every * rng.standard_normal((_SESSIONS, 1))
        off = np.maximum(off, -0.9)  # some light is left
        mean = mean + off * (high.mean - low.mean) / (2 * step)
        variance = variance + off * (high.variance - low.variance) / (2 * step)
    dark, bright = _draw_stacks(frames, expected, rng)
    return replace(expected, pairs=Pair(mean, variance, rows), dark_stack=dark, bright_stack=bright)


def _draw_stacks(frames: Frames, expected: Session, rng: np.random.Generator) -> list[Stack]:
    """Draw dark and bright stacks with common offsets.

    Sums of squares by row, column and pixel are independent: chi-square, and normal for products of two parts.
    """
    m, n = frames.shape
    places = frames.dark, frames.bright
    noise, counts = expected.pairs.variance[[*places]], frames.counts[[*places]]
    shared = min(float(expected.pairs.rows[frames.dark]), *noise)
    own = np.array([[1, 0, 1 / n], [0, 1, 1 / m], [0, 0, 1]])  # a pixel's part is in means of rows and columns
    dark, bright, still = (own @ frames.parts(*each) for each in ((places[0],), (places[1],), (places[1], 0.0)))
    light = frames.slope(float(frames.electrons[frames.bright])) * np.sqrt(np.maximum(bright - still, 0.0))
    offsets = [frames.offset_slope(place) * np.sqrt(part) for place, part in zip(places, (dark, still), strict=True)]
    squares: list[list[FloatArray]] = [[], []]  # of the dark and the bright stack, by row, column and pixel
    for index, (freedom, averaged) in enumerate(((m - 1, n), (n - 1, m), ((m - 1) * (n - 1), 1))):
        left = np.sqrt(((noise - shared) / averaged + (0.0 if index else shared)) / counts)
        products = rng.standard_normal((4, 4, _SESSIONS)) / math.sqrt(freedom)
        products = (products + products.transpose(1, 0, 2)) / math.sqrt(2)
        products[np.arange(4), np.arange(4)] = rng.chisquare(freedom, (4, _SESSIONS)) / freedom
        sides = [offsets[0][index], left[0]], [offsets[1][index], light[index], left[1]]
        for found, part, used in zip(squares, sides, ([0, 2], [0, 1, 3]), strict=True):
            found.append(freedom * np.einsum("i,ijs,j->s", part, products[np.ix_(used, used)], part))
    stacks = []
    for side, stack in enumerate((expected.dark_stack, expected.bright_stack)):
        row, column, pixel = squares[side]
        total = (row * n + column * m + pixel) / (m * n - 1)
        freedom = (m - 1) * (counts[side] - 1)
        taken = (noise[side] - shared + shared * rng.chisquare(freedom, _SESSIONS) / freedom) / counts[side]
        mean = np.full(_SESSIONS, float(stack.mean))
        stacks.append(Stack(mean, total - taken, row / m - taken / n, column / n - taken / m))
    return stacks


# -------- A real camera's frames

_LEAST_SIDE = 16
_SURE = 6.0
_UNEQUAL = 0.1
_WHITE = 0.02
"""Correlation of neighbours' noise that charge between pixels may cause."""
_OUT, _SWAPPED = 0.02, 1.5
"""Relative response from which a set is reported, and from which frames are refused."""
_MIXED, _SCALED, _PEAK = 0.1, 0.99, 0.6
"""Limits of refusals: neighbours' correlation, a pattern in the codes, and the brightest signal's least fraction."""
_COMB, _EVEN, _STEADY, _STRAIGHT, _STILL, _DARK_CUT, _DEAD = 0.05, 0.03, 0.01, 0.05, 0.1, 0.01, 0.01
"""Limits of remarks, among them unevenness (EMVA 1288 4.0), misfits of a variance and of a dark mean [DN]."""
_FLOATS = 9


def read_sets(flats: FlatFrames, job: Job) -> list[Alike]:
    """Compute the statistics of every set; MitsimError if the frames show nothing of the camera."""
    where = f"frames {flats.folder}"
    shape = image_size(flats.folder / flats.sets[0].files[0], flats.wanted)
    if min(shape) < _LEAST_SIDE:
        raise MitsimError(f"{where}: {shape[0]} x {shape[1]} pixels; give {_LEAST_SIDE} or more a side")
    Cost(memory_bytes=2 * 8 * _FLOATS * math.prod(shape)).check(where, job.limits)
    job.progress("frames", 0.0)
    with job.clock.stage("frames"):
        taken = read_again(flats, shape)
    for fault in _faults(flats, taken):
        raise MitsimError(f"{where}: {fault}")
    return taken


def read_again(flats: FlatFrames, shape: tuple[int, int], places: Places | None = None) -> list[Alike]:
    """Compute the statistics with the pixel at `places` (M, N) read in place of each pixel."""
    bits = flats.listed.bits
    largest = math.inf if bits is None else 2.0**bits - 1

    def frames(listed: DarkSet) -> Iterator[npt.NDArray[np.generic]]:
        for path in (flats.folder / name for name in listed.files):
            values = read_image(path, flats.wanted)
            if values.shape != shape:
                sizes = " and ".join(f"{m} x {n}" for m, n in (shape, values.shape[:2]))
                raise MitsimError(f"frame {path}: frames have {sizes} pixels; give frames of one size")
            least, most = float(values.min()), float(values.max())
            if bits is not None and (least < 0 or most > largest):
                held = f"{least if least < 0 else most:g}, and numbers of {bits} bits are 0 to {largest:g}"
                raise MitsimError(f"frame {path}: holds {held}; correct bits")
            if bits is not None and values.dtype.kind == "f" and np.any(values != np.rint(values)):
                raise MitsimError(f"frame {path}: holds numbers that are not whole; leave bits out")
            yield values if places is None else values.flat[places]

    def taken(listed: DarkSet) -> Alike:
        power = listed.light if isinstance(listed, LitSet) else 0.0
        light = power * listed.exposure_s * (flats.listed.photons_per_s or 1.0)
        return alike(frames(listed), largest, light, listed.exposure_s)

    return in_threads(taken, flats.sets)


def mean_image(flats: FlatFrames, index: int) -> FloatArray:
    files = flats.sets[index].files
    total = 0.0 + sum(read_image(flats.folder / name, flats.wanted).astype(np.float64) for name in files)
    return np.asarray(total / len(files))


def _names(flats: FlatFrames) -> list[str]:
    return [f"{listed.files[0]} to {listed.files[-1]}" for listed in flats.sets]


def _faults(flats: FlatFrames, taken: Sequence[Alike]) -> Iterator[str]:
    seen = dict[bytes, str]()
    for listed, each in zip(flats.sets, taken, strict=True):
        for name, digest in zip(listed.files, each.digests, strict=True):
            if digest and digest in seen:
                yield (
                    f"{seen[digest]} and {name} are equal in every number: one frame twice, or noise below a code; "
                    "take each frame anew, or at a higher gain"
                )
            seen[digest] = name
    dark, lit = {each.exposure_s: each for each in taken if not each.light}, [each for each in taken if each.light]
    brightest = max(each.mean for each in lit)
    for name, said in zip(_names(flats), taken, strict=True):
        still = dark[said.exposure_s]
        signal = said.mean - still.mean
        if said.light and signal <= _SURE * math.hypot(said.mean_error, still.mean_error):
            yield f"{name} is no brighter than the dark frames of its exposure; light it, or list it as dark"
        if said.light and said.flicker > _UNEQUAL * signal:
            yield (
                f"{name} differ by {100 * said.flicker / signal:.0f} % of their light; take the frames of a set with "
                "one exposure, under a steady lamp"
            )
        if not said.light and said.flicker > _UNEQUAL * max(brightest - said.mean, 0.0):
            yield f"{name} are listed as dark and differ by {said.flicker:.3g} DN; cover the camera and take them again"
    if full := 100 * min(each.cut[1] for each in lit):
        yield f"all sets under light hold saturated numbers, {full:.3g} % of them at least; expose some for less"
    yield from (text for _, refused, text in _altered(flats, taken, taken) if refused)


def _altered(flats: FlatFrames, taken: Sequence[Alike], used: Sequence[Alike]) -> list[tuple[bool, bool, str]]:
    names, means = _names(flats), [each.mean for each in taken]
    peak, dark = means[saturation_of(taken)[0]], min(each.mean for each in taken if not each.light)
    combs = [
        (*each.comb, name) for name, each in zip(names, taken, strict=True)
        if each.comb[0] > _SURE / math.sqrt(each.count * math.prod(each.shape))
        and each.light and not any(each.cut) and each.mean < dark + MOST_FITTED * (peak - dark)
    ]  # fmt: skip
    amplitude, period, combed = max(combs, default=(0.0, 1.0, ""))
    # A correlation of neighbours' noise counts beyond chance and charge between pixels.
    noises = [max(map(abs, each.neighbours)) for each in used]
    least = [_WHITE + _SURE / math.sqrt(math.prod(each.shape)) for each in used]
    noises = [noise if noise > chance else 0.0 for noise, chance in zip(noises, least, strict=True)]
    smooth, smoothed = max(noises), names[[*taken].index(used[int(np.argmax(noises))])]
    part = (peak - min(means)) / (max(means) - min(means))
    return [
        (amplitude > _COMB, amplitude > _SCALED, f"codes are missing or too frequent with a period of {period:.2g} DN, "
         f"by an amplitude of {amplitude:.2g} in {combed}: numbers were scaled after the ADC, or a bit of "
         "it is stuck; gain, noise, black level and dsnu_* are of those numbers; give raw frames, or divide by the "
         "period and state fewer bits"),
        (smooth > 0, float(np.median(noises)) > _MIXED, f"noise of neighbouring pixels is correlated by {smooth:.2g} "
         f"in {smoothed}, so frames were compressed, smoothed, scaled or demosaiced, and gain and noise are of those "
         "pictures; give raw frames"),
        (part < _PEAK, part < _PEAK, f"the variance is largest at {100 * part:.0f} % of the brightest signal, not near "
         "it, as after a gamma curve, compression or too coarse codes; give raw frames of more bits, or of a higher "
         "gain"),
        *((True, not 1 / _SWAPPED < ratio < _SWAPPED, f"{name} are {ratio:.3g} times as bright as the other sets are "
           f"at their exposures{as_of}; correct exposure_s, light or files of the list, or leave the set out")
          for name, ratio, as_of in _responses(names, taken)),
    ]  # fmt: skip


def _responses(names: Sequence[str], taken: Sequence[Alike]) -> list[tuple[str, float, str]]:
    dark = {each.exposure_s: each.mean for each in taken if not each.light}
    signals = np.array([each.mean - dark[each.exposure_s] for each in taken])
    light = np.array([each.light for each in taken])
    full = np.max(signals, where=np.array([not each.cut[1] for each in taken]), initial=0.0)
    used = (light > 0) & (signals > LINEAR[0] * full) & (signals < LINEAR[1] * full)
    used |= (signals >= LINEAR[1] * full) & (light < np.max(light, where=used, initial=0.0) * LINEAR[1])
    if used.sum() < 3:
        return []
    names, light = [name for name, use in zip(names, used, strict=True) if use], light[used]
    response = np.log(signals[used] / light)
    slope = scipy.stats.theilslopes(response, light)[0] if np.ptp(light) else 0.0
    off, about = response - slope * light, response - np.median(response)
    off -= float(np.median(off))
    limit = max(_SURE * 1.4826 * float(np.median(np.abs(off))), _OUT)
    off = np.where(np.abs(about) > math.log(_SWAPPED), about, np.where(np.abs(off) > limit, off, 0.0))
    found = []
    for index in np.flatnonzero(off):
        apart = np.abs(np.log(light / light[index]) - off[index])
        of = int(apart.argmin())
        as_of = f", as if they were of the exposure of {names[of]}" if of != index and apart[of] < limit else ""
        found.append((names[index], math.exp(off[index]), as_of))
    return found


def remarks(flats: FlatFrames, found: FoundCamera) -> tuple[str, ...]:
    transfer, pixels = found.transfer, found.pixels
    used = [
        (name, abs(off), taken)
        for name, off, taken in zip(_names(flats), transfer.off, pixels.taken, strict=True) if np.isfinite(off[0])
    ]  # fmt: skip
    darks = [each for each in used if not each[2].light]
    bent, curved = max(
        (off[1] * said.variance_error / max(said.variance, LEAST_DARK), name)
        for name, off, said in used if off[1] > _SURE or name is used[0][0]
    )  # fmt: skip
    moved, moving = max((off[0] * said.mean_error * (off[0] > _SURE), name) for name, off, said in darks)
    noise = math.sqrt(transfer["read"] ** 2 + max(transfer["spatial"], 0.0) + 1 / 12)
    cut, zero = max(said.cut[0] for *_, said in darks), scipy.special.ndtr((0.5 - transfer["black"]) / noise)
    dead, lamp, hot = found.sensor.dead_pixels, 100 * transfer.lamp, round(pixels.filled * math.prod(pixels.shape))
    widened = f"standard errors are widened by {math.sqrt(max(transfer.chi_square / max(transfer.freedom, 1), 1)):.2g}"
    known = (
        "gain and noise hold; quantum_efficiency, saturation_capacity and linearity are known to that, as their "
        "standard errors say; take the frames again under a steady lamp"
    )
    light = {
        "undecided": "means bend with exposure, and variances do not tell whether the camera bends or the lamp drifts: "
        "the standard errors of linearity, gain, full_well and quantum_efficiency include the difference; take more "
        "frames in each set, or list the lamp's measured light",
        "drifts": "means bend with exposure and variances over means do not, so the lamp drifts or exposures are not "
        f"as listed, by {lamp:.2g} %; {known}",
    }.get(transfer.light, f"light scatters by {lamp:.2g} % about what exposures say; {known}")
    table = [
        *((seen, text) for seen, _, text in _altered(flats, pixels.taken, [said for *_, said in used])),
        (bent > _STRAIGHT, f"variances do not rise with means as those of counted electrons: {curved} is off by "
         f"{100 * bent:.0f} %; a gamma curve, compression or automatic gain does that; {widened}"),
        (moved > _STILL, f"dark means do not rise with exposure: {moving} is off by {moved:.2g} DN; black level or "
         "temperature drifts, or exposures are listed wrongly; do not trust black_level_dn and dark_current_e_per_s; "
         f"{widened}"),
        (cut - 1.1 * zero > _DARK_CUT, f"{100 * cut:.2g} % of dark readings are 0 DN, and a normal law of pixels "
         f"explains {100 * zero:.2g} %: some black levels are below 0, which moves black_level_dn, read_noise_e and "
         "dsnu_*; raise the black level of the camera"),
        (pixels.filled > 0, f"{hot} hot pixels ({100 * pixels.filled:.2g} %) are full in the longest dark frames: "
         "the figures of EMVA 1288 include them; the camera found counts them as hot_pixels, or as dead_pixels if full "
         "at every exposure, and its hot_dark_current_e_per_s is a lower limit"),
        (dead > _DEAD, f"{100 * dead:.2g} % of the pixels show less than half of the light of most: dead columns, "
         "dust, or light that does not fill the frame; the camera found counts them as dead_pixels"),
        (transfer.light in ("undecided", "drifts") or transfer.lamp > _STEADY, light),
        (pixels.uneven > _EVEN, f"light differs by {100 * pixels.uneven:.0f} % over the frame, and EMVA 1288 allows "
         f"{100 * _EVEN:.0f} %: the figures prnu_* include it; the camera found is without a surface of second degree"),
    ]  # fmt: skip
    return tuple(text for said, text in table if said)
