"""A camera in, which frames a characterisation takes of it out, and what they are expected to say.

The frames are those that a test bench takes: pairs under even light from dark to beyond saturation, pairs in the dark
over a series of exposures, and stacks in the dark and at half of saturation. Those of a real camera are as its list
says. Closed-form moments (`mitsim.sensor.moments`) tell what a statistic is expected to be, and how far it may be off.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.job import Job
from mitsim.core.parallel import in_threads
from mitsim.core.seeds import stream
from mitsim.devices.sensor import EXPOSURE_S, SensorModel
from mitsim.sensor import emva
from mitsim.sensor.chain import expose
from mitsim.sensor.emva import MOST_FITTED, Session
from mitsim.sensor.found_camera import FoundCamera, Places
from mitsim.sensor.moments import frame_moments
from mitsim.sensor.photon_transfer import Taken, average_moments, nonuniform, saturation_of
from mitsim.sensor.specimen import dark_current_variance, mean_dark_current, response_variance
from mitsim.studies.emva_options import Procedure, capacity_of, efficiency_of

_TO = 1.15
"""Light of the brightest step over what saturates: 7 steps of 50 are saturated, so the largest variance is inside."""
_DARK_STEPS = 6
"""Exposures of the dark series: the least that EMVA 1288 4.0 takes."""
_DARK_FILL, _DARK_ELECTRONS = 0.4, 2000.0
"""Dark electrons at the longest of them: a part of saturation, or as many as tell the current to a permille."""
_LONGEST_S = 10.0
"""Of a camera without dark current [s]."""
_FILLED_BY_DARK = 0.01
"""Part of saturation that dark current may fill at the ladder's exposure."""
_DITHERED, _CLEAR = 0.6, 8.0
"""Noise of reading [DN], and deviations from 0, from which mean readings follow offsets."""
_SESSIONS = 1000
"""Drawn statistics of sessions: they tell a standard error to 2 %."""


@dataclass(frozen=True, eq=False)
class Frames:
    """Which frames are taken of a camera, in S sets; those of a set alike.

    Attributes
    ----------
    sensor
        of what.
    shape
        rows and columns.
    light
        (S,) on a pixel, in photons or in any unit; 0 in the dark.
    electrons
        (S,) the same in photoelectrons.
    exposure_s
        (S,) of each [s].
    counts
        (S,) frames of each.
    dark, bright
        which sets tell nonuniformity.
    saturates
        whether the brightest set is saturated.
    seed
        root of every draw.
    lamp
        relative errors of the light: of each set, and of all.
    surface
        relative variances of light that is uneven, by row, column and pixel.
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
    surface: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def of(cls, sensor: SensorModel, procedure: Procedure, capacity: float) -> Frames:
        """Those that a camera is characterised by.

        Parameters
        ----------
        sensor, procedure
            of what, and how.
        capacity
            electrons that saturate a pixel.
        """
        steps = capacity * _TO * np.arange(1, procedure.steps + 1) / procedure.steps
        hottest = (
            sensor.binning**2 * sensor.dark_factor * (sensor.dark_current_e_per_s + sensor.hot_dark_current_e_per_s)
        )
        mean = mean_dark_current(sensor)
        longest = min(_DARK_FILL * capacity / hottest, _DARK_ELECTRONS / mean) if hottest else _LONGEST_S
        longest = min(max(longest, EXPOSURE_S[0] * _DARK_STEPS), EXPOSURE_S[1])
        exposure_s = min(0.01, _FILLED_BY_DARK * capacity / hottest) if hottest else 0.01
        times = longest * np.arange(_DARK_STEPS) / (_DARK_STEPS - 1)
        beyond = 2 * capacity + 20 * math.sqrt(capacity)
        electrons = np.concatenate([steps, [beyond, capacity / 2, 0.0], np.zeros(_DARK_STEPS)])
        exposures = np.concatenate([np.full(procedure.steps + 3, exposure_s), times])
        counts = np.full(len(electrons), 2)
        bright = procedure.steps + 1
        counts[[bright, bright + 1]] = procedure.frames
        side, light = (procedure.pixels, procedure.pixels), electrons / efficiency_of(sensor, procedure)
        return cls(sensor, side, light, electrons, exposures, counts, bright + 1, bright, seed=procedure.seed)

    @classmethod
    def as_taken(cls, taken: list[Taken], found: FoundCamera) -> Frames:
        """Return those of a real camera, of which sets were ``taken`` and which was ``found`` in them."""
        sensor, transfer = found.sensor, found.transfer
        light, time = (np.array([getattr(each, name) for each in taken]) for name in ("light", "exposure_s"))
        return cls(
            sensor, taken[0].said.shape, light, transfer["response"] * light, time,
            np.array([each.said.count for each in taken]), *nonuniform(taken), saturation_of(taken)[1] is not None,
            lamp=(transfer.lamp, transfer.light_error), surface=found.maps.surface,
        )  # fmt: skip

    @property
    def efficiency(self) -> float:
        """Photoelectrons for a unit of light."""
        brightest = int(self.light.argmax())
        return float(self.electrons[brightest] / self.light[brightest])

    @property
    def ladder_of_exposures(self) -> bool:
        """Whether light varies by exposure: noise in the dark is then that at no exposure."""
        return len(np.unique(self.exposure_s[self.light > 0])) >= emva.LINE

    @property
    def brightest_s(self) -> float:
        """Exposure of the brightest set [s]."""
        return float(self.exposure_s[int(self.light.argmax())])

    @property
    def step(self) -> float:
        """Electrons between the set nearest to saturation and the one before it."""
        levels = np.unique(self.electrons)
        capacity = capacity_of(self.sensor)
        return float(np.diff(levels)[np.searchsorted(levels[1:-1], capacity)])

    def images(self, index: int, places: Places | None = None) -> Iterator[FloatArray]:
        """Yield the frames of the set of that ``index``, with the pixel at ``places`` (M, N) in place of each."""
        for number in range(self.counts[index]):
            shot, read = (stream(self.seed, "characterise", noise, index, number) for noise in ("shot", "read"))
            light = np.full(self.shape, self.electrons[index])
            image = np.asarray(expose(light, float(self.exposure_s[index]), self.sensor, shot, read), dtype=np.float64)
            yield image if places is None else image.flat[places]

    def take(self, job: Job, places: Places | None = None) -> list[Taken]:
        """Take the frames of all sets, with the pixel at ``places`` in place of each; ``job`` is told how far it is."""
        largest = math.inf if self.sensor.largest_dn is None else float(self.sensor.largest_dn)
        job.progress("frames", 0.0)
        with job.clock.stage("frames"):
            said = in_threads(lambda index: emva.alike(self.images(index, places), largest), range(len(self.light)))
        return [Taken(*each) for each in zip(self.light.tolist(), self.exposure_s.tolist(), said, strict=True)]

    def session(self, taken: list[Taken]) -> Session:
        """The statistics of sets that were ``taken``, for figures."""
        stacks = (taken[index].said.stack for index in (self.dark, self.bright))
        return self._session(emva.pairs_of([each.said.pair for each in taken]), *stacks)

    def expect(self) -> Session:
        """The same statistics as closed forms expect them of all specimens; nonuniformity as it was set."""
        pairs = emva.pairs_of([self._expected_pair(index) for index in range(len(self.light))])
        stacks = (self._expected_stack(pairs.mean[index], index) for index in (self.dark, self.bright))
        return self._session(pairs, *stacks)

    def _session(self, pairs: emva.Pair, dark: emva.Stack, bright: emva.Stack) -> Session:
        return Session(
            self.shape, self.light, self.exposure_s, pairs, self.dark, self.bright, dark, bright, self.saturates,
            self.sensor.bits is not None,
        )  # fmt: skip

    def _expected_pair(self, index: int, part: float = 1.0) -> emva.Pair:
        """Of a set whose light is a ``part`` of what it should be."""
        time, light = float(self.exposure_s[index]), np.array([part * self.electrons[index], 0.0])
        mean, variance, _ = average_moments(
            light, time, self.alike, self.spread,
            math.hypot(*self.sensor.response_parts) if light[0] > MOST_FITTED * capacity_of(self.sensor) else 0.0,
        )  # fmt: skip
        dead = self.sensor.dead_pixels
        rows = (self.sensor.superpixel_row_noise_e * self.sensor.gain_dn_per_e) ** 2
        lit = [np.asarray((1 - dead) * moment[0] + dead * moment[1]) for moment in (mean, variance)]
        return emva.Pair(lit[0], lit[1], np.minimum(rows, lit[1]))

    def _expected_stack(self, mean: FloatArray, index: int) -> emva.Stack:
        still, parts = self.parts(index, 0.0), self.parts(index)
        slopes = self.offset_slope(index), self.slope(self.electrons[index])
        rows, columns, pixel = slopes[0] ** 2 * still + slopes[1] ** 2 * (parts - still)
        m, n = self.shape
        return emva.Stack(mean, rows + columns + pixel, rows + pixel / n, columns + pixel / m)

    @property
    def alike(self) -> SensorModel:
        """The sensor with pixels that are all alike, of the same mean dark current, lit evenly."""
        names = (
            *(f"dsnu_{part}_e" for part in emva.SPLIT[1:]),
            *(f"prnu_{part}" for part in emva.SPLIT[1:]),
            *("dark_current_spread_e_per_s", "hot_pixels", "hot_dark_current_e_per_s", "dead_pixels", "crosstalk"),
        )
        mean = self.sensor.dark_current_e_per_s + self.sensor.hot_pixels * self.sensor.hot_dark_current_e_per_s
        return self.sensor.model_copy(update={**dict.fromkeys(names, 0.0), "dark_current_e_per_s": mean})

    @property
    def spread(self) -> float:
        """Standard deviation of the pixels' offsets [DN], where rounding or the ADC's end changes it; else 0."""
        sensor, gain = self.sensor, self.sensor.gain_dn_per_e
        spread, noise = math.hypot(*sensor.offset_parts) * gain, sensor.superpixel_reading_noise_e * gain
        clear = noise > _DITHERED and sensor.superpixel_black_level_dn > _CLEAR * math.hypot(noise, spread)
        return 0.0 if sensor.bits is None or clear else spread

    def offset_slope(self, index: int) -> float:
        """Digital numbers for another electron of offset in the set of that ``index``, rms over the pixels."""
        spread = self.spread
        if not spread:
            return self.sensor.gain_dn_per_e
        *_, between = average_moments(self.electrons[[index]], float(self.exposure_s[index]), self.alike, spread)
        return self.sensor.gain_dn_per_e * math.sqrt(float(between[0])) / spread

    def slope(self, electrons: float) -> float:
        """Digital numbers for another electron of light, around so many ``electrons``."""
        if not self.sensor.linearity:
            return self.sensor.gain_dn_per_e
        around = np.array([electrons * 0.999, electrons * 1.001 + 1])
        mean, _ = frame_moments(around, float(self.exposure_s[self.dark]), self.alike)
        return float(np.diff(mean)[0] / np.diff(around)[0])

    def parts(self, index: int, light: float = 1.0) -> FloatArray:
        """Return the spatial variances (row, column, pixel) [e-^2] that are set, in the set of that ``index``.

        ``light`` is a part of the set's.
        """
        sensor, (pixel, row, column) = self.sensor, np.square(self.sensor.offset_parts)
        dark = dark_current_variance(sensor) * float(self.exposure_s[index]) ** 2
        _, rows, columns = np.square(sensor.response_parts)
        responses = np.array([rows, columns, response_variance(sensor) - rows - columns]) + self.surface
        still = np.array([row, column, pixel + dark])
        return np.asarray(still + (light * float(self.electrons[index])) ** 2 * responses)


def draw_sessions(frames: Frames, expected: Session) -> Session:
    """Statistics of :data:`_SESSIONS` sessions, each as far off the ``expected`` ones of ``frames`` as noise and
    specimen make them.

    A variance of n pixels in L frames whose rows share v_r of v has the variance (2 v_o^2/(L-1) + k_4/L)/n + (4 v_o
    v_r/n + 2 v_r^2/M)/(L-1), v_o = v - v_r, k_4 = K^4 mu the fourth cumulant of the counts, dark ones among them.
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
    alone = np.sqrt(2.0 / m / more) * own / n * z[3]
    pairs = emva.Pair(
        mean + specimen + z[0] * np.sqrt((own / m / n + rows / m) / count),
        variance + np.sqrt(spread) * z[1] + shared,
        rows + shared + alone,
    )
    if any(frames.lamp):
        pairs = _under_lamp(frames, pairs, rng)
    dark, bright = _drawn_stacks(frames, expected, rng)
    return replace(expected, pairs=pairs, dark_stack=dark, bright_stack=bright)


def _under_lamp(frames: Frames, pairs: emva.Pair, rng: np.random.Generator) -> emva.Pair:
    """Drawn ``pairs`` (sessions, S) of sets whose light is off, each by its part and all by another."""
    each, every = frames.lamp
    step = min(max(frames.lamp), 0.5)
    sides = [
        emva.pairs_of([frames._expected_pair(index, 1 + side * step) for index in range(len(frames.light))])
        for side in (-1, 1)
    ]
    off = each * rng.standard_normal(pairs.mean.shape) + every * rng.standard_normal((_SESSIONS, 1))
    off = np.maximum(off, -0.9)  # there is some light
    mean, variance = (
        getattr(pairs, name) + off * (getattr(sides[1], name) - getattr(sides[0], name)) / (2 * step)
        for name in ("mean", "variance")
    )
    return emva.Pair(mean, variance, pairs.rows)


def _drawn_stacks(frames: Frames, expected: Session, rng: np.random.Generator) -> list[emva.Stack]:
    """Dark and bright stacks as they may come out: sums of squares of offsets, responses and what is left of noise.

    By row, column and pixel these are independent; of f degrees of freedom, squares are chi-square and products of two
    parts normal. Offsets are the same in both stacks.
    """
    m, n = frames.shape
    places = frames.dark, frames.bright
    noise, counts = expected.pairs.variance[[*places]], frames.counts[[*places]]
    shared = min(float(expected.pairs.rows[frames.dark]), *noise)
    sizes = {"row": (m - 1, n), "column": (n - 1, m), "pixel": ((m - 1) * (n - 1), 1)}
    squares: dict[str, list[FloatArray]] = {}
    own = np.array([[1, 0, 1 / n], [0, 1, 1 / m], [0, 0, 1]])  # a pixel's part is in means of rows and columns
    dark, bright, still = (own @ frames.parts(*each) for each in ((places[0],), (places[1],), (places[1], 0.0)))
    light = frames.slope(float(frames.electrons[frames.bright])) * np.sqrt(np.maximum(bright - still, 0.0))
    offsets = [frames.offset_slope(place) * np.sqrt(part) for place, part in zip(places, (dark, still), strict=True)]
    for index, (name, (freedom, averaged)) in enumerate(sizes.items()):
        left = np.sqrt(((noise - shared) / averaged + (shared if name == "row" else 0.0)) / counts)
        products = _products(freedom, 4, rng)
        sides = [[offsets[0][index], left[0]], [offsets[1][index], light[index], left[1]]]
        squares[name] = [
            freedom * np.einsum("i,ijs,j->s", part, products[np.ix_(used, used)], part)
            for part, used in zip(sides, ([0, 2], [0, 1, 3]), strict=True)
        ]
    stacks = []
    for side, name in enumerate(("dark_stack", "bright_stack")):
        row, column, pixel = (squares[part][side] for part in ("row", "column", "pixel"))
        total = (row * n + column * m + pixel) / (m * n - 1)
        mean = np.full(_SESSIONS, float(getattr(expected, name).mean))
        freedom = (m - 1) * (counts[side] - 1)
        taken = (noise[side] - shared + shared * rng.chisquare(freedom, _SESSIONS) / freedom) / counts[side]
        stacks.append(emva.Stack(mean, total - taken, row / m - taken / n, column / n - taken / m))
    return stacks


def _products(freedom: int, count: int, rng: np.random.Generator) -> FloatArray:
    """(count, count, sessions) mean products of as many independent normal samples of some degrees of ``freedom``."""
    products = rng.standard_normal((count, count, _SESSIONS)) / math.sqrt(freedom)
    products = (products + products.transpose(1, 0, 2)) / math.sqrt(2)
    products[np.arange(count), np.arange(count)] = rng.chisquare(freedom, (count, _SESSIONS)) / freedom
    return np.asarray(products)
