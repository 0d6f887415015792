"""The frames that characterise a camera, their statistics, and what closed forms expect of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.job import Job
from mitsim.core.parallel import in_threads
from mitsim.core.seeds import stream
from mitsim.devices.flatlist import capacity_of
from mitsim.devices.sensor import EXPOSURE_S, SensorModel
from mitsim.sensor.camera_fit import FoundCamera, Places, average_moments, nonuniform, saturation_of
from mitsim.sensor.chain import dark_current_variance, expose, mean_dark_current, response_variance
from mitsim.sensor.emva import MOST_FITTED, SPLIT, Alike, Pair, Session, Stack, alike, pairs_of
from mitsim.sensor.moments import frame_moments
from mitsim.studies.emva_options import Procedure

_TO = 1.15
"""Light of the brightest step, relative to saturation, so that the largest variance is inside."""
_DARK_STEPS = 6
_DARK_FILL, _DARK_ELECTRONS = 0.4, 2000.0
"""Dark electrons at the longest exposure: a fraction of saturation, or enough for a current to a permille."""
_LONGEST_S = 10.0
_FILLED_BY_DARK = 0.01
"""Fraction of saturation that dark current may fill at the ladder's exposure."""
_DITHERED, _CLEAR = 0.6, 8.0
"""Noise of reading [DN], and deviations from 0, from which mean readings follow offsets."""
_SESSIONS = 1000


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of a camera in S sets of frames that are taken alike.

    Attributes
    ----------
    light, electrons : (S,) light on a pixel, in any unit, and in photoelectrons; 0 in the dark.
    dark, bright : sets for nonuniformity.
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
    def of(cls, sensor: SensorModel, procedure: Procedure, capacity: float) -> Frames:
        """Return the frames of a simulated camera that `capacity` electrons saturate."""
        steps = capacity * _TO * np.arange(1, procedure.steps + 1) / procedure.steps
        hottest = (
            sensor.binning**2 * sensor.dark_factor * (sensor.dark_current_e_per_s + sensor.hot_dark_current_e_per_s)
        )
        longest = exposure_s = math.inf
        if hottest:
            longest = min(_DARK_FILL * capacity / hottest, _DARK_ELECTRONS / mean_dark_current(sensor))
            exposure_s = _FILLED_BY_DARK * capacity / hottest
        longest = min(max(longest if hottest else _LONGEST_S, EXPOSURE_S[0] * _DARK_STEPS), EXPOSURE_S[1])
        times = longest * np.arange(_DARK_STEPS) / (_DARK_STEPS - 1)
        beyond = 2 * capacity + 20 * math.sqrt(capacity)
        electrons = np.concatenate([steps, [beyond, capacity / 2, 0.0], np.zeros(_DARK_STEPS)])
        exposures = np.concatenate([np.full(procedure.steps + 3, min(0.01, exposure_s)), times])
        counts, bright = np.full(len(electrons), 2), procedure.steps + 1
        counts[[bright, bright + 1]] = procedure.frames
        side, light = (procedure.pixels, procedure.pixels), electrons / procedure.efficiency(sensor)
        return cls(sensor, side, light, electrons, exposures, counts, bright + 1, bright, seed=procedure.seed)

    @classmethod
    def as_taken(cls, taken: list[Alike], found: FoundCamera) -> Frames:
        """Return the frames of a real camera that was found in them."""
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
        """Electrons between the set nearest to saturation and the one before it."""
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
        """Simulate the frames of all sets."""
        largest = math.inf if self.sensor.largest_dn is None else float(self.sensor.largest_dn)

        def taken(index: int) -> Alike:
            return alike(self.images(index, places), largest, float(self.light[index]), float(self.exposure_s[index]))

        job.progress("frames", 0.0)
        with job.clock.stage("frames"):
            return in_threads(taken, range(len(self.light)))

    def session(self, pairs: Iterable[Pair], dark: Stack, bright: Stack) -> Session:
        return Session(
            self.shape, self.light, self.exposure_s, pairs_of([*pairs]), self.dark, self.bright, dark, bright,
            self.saturates, self.sensor.bits is not None,
        )  # fmt: skip

    def expect(self) -> Session:
        """Return the statistics that closed forms expect, with the nonuniformity that is set."""
        pairs = [self.expected_pair(index) for index in range(len(self.light))]
        m, n = self.shape
        stacks = []
        for index in (self.dark, self.bright):
            still, parts = self.parts(index, 0.0), self.parts(index)
            slopes = self.offset_slope(index), self.slope(self.electrons[index])
            rows, columns, pixel = slopes[0] ** 2 * still + slopes[1] ** 2 * (parts - still)
            stacks.append(
                Stack(np.asarray(pairs[index].mean), rows + columns + pixel, rows + pixel / n, columns + pixel / m)
            )
        return self.session(pairs, *stacks)

    def expected_pair(self, index: int, part: float = 1.0) -> Pair:
        """Return the expected statistics of a set at a part of its light."""
        sensor, light = self.sensor, np.array([part * self.electrons[index], 0.0])
        response = math.hypot(*sensor.response_parts) if light[0] > MOST_FITTED * capacity_of(sensor) else 0.0
        moments = average_moments(light, float(self.exposure_s[index]), self.equal, self.spread, response)[:2]
        mean, variance = (
            np.asarray((1 - sensor.dead_pixels) * lit + sensor.dead_pixels * dark) for lit, dark in moments
        )
        return Pair(mean, variance, np.minimum((sensor.superpixel_row_noise_e * sensor.gain_dn_per_e) ** 2, variance))

    @property
    def equal(self) -> SensorModel:
        """The sensor with equal pixels of the same mean dark current."""
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
        """Return digital numbers per electron of offset in a set, rms over the pixels."""
        spread = self.spread
        if not spread:
            return self.sensor.gain_dn_per_e
        *_, between = average_moments(self.electrons[[index]], float(self.exposure_s[index]), self.equal, spread)
        return self.sensor.gain_dn_per_e * math.sqrt(float(between[0])) / spread

    def slope(self, electrons: float) -> float:
        """Return digital numbers per electron of light around a level."""
        if not self.sensor.linearity:
            return self.sensor.gain_dn_per_e
        around = np.array([electrons * 0.999, electrons * 1.001 + 1])
        mean, _ = frame_moments(around, float(self.exposure_s[self.dark]), self.equal)
        return float(np.diff(mean)[0] / np.diff(around)[0])

    def parts(self, index: int, light: float = 1.0) -> FloatArray:
        """Return the spatial variances (row, column, pixel) [e-^2] that are set, at a part of a set's light."""
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
    dark, bright = _drawn_stacks(frames, expected, rng)
    return replace(expected, pairs=Pair(mean, variance, rows), dark_stack=dark, bright_stack=bright)


def _drawn_stacks(frames: Frames, expected: Session, rng: np.random.Generator) -> list[Stack]:
    """Draw dark and bright stacks: sums of squares of offsets, responses and remaining noise.

    By row, column and pixel these are independent: with f degrees of freedom squares are chi-square, and products of
    two parts normal. Offsets are the same in both stacks.
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
