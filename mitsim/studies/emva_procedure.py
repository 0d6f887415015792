"""A camera and the sizes of a characterisation in, the session that its frames tell out: measured, expected, and drawn.

Which frames are taken, their statistics, what closed forms expect of them, and how far sessions of such statistics lie
apart (GUM, supplement 1).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.job import Job
from mitsim.core.parallel import in_threads
from mitsim.core.seeds import stream
from mitsim.devices.sensor import EXPOSURE_S, SensorModel
from mitsim.sensor.chain import expose
from mitsim.sensor.emva import SPLIT, Pair, Session, Stack, pair_of, pairs_of, stack_of
from mitsim.sensor.moments import frame_moments
from mitsim.sensor.specimen import dark_current_variance, mean_dark_current, response_variance
from mitsim.studies.emva_options import Procedure, efficiency_of

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
_SESSIONS = 1000
"""Drawn statistics of sessions: they tell a standard error to 2 %."""


@dataclass(frozen=True)
class Frames:
    """Which frames are taken of a camera.

    Attributes
    ----------
    sensor, procedure
        of what, and how.
    electrons
        (steps,) light of the ladder's pairs [electrons a pixel].
    half, beyond
        that of the bright stack, and of overexposed frames.
    exposure_s
        of all of these [s].
    dark_times
        exposures of the dark series [s].
    """

    sensor: SensorModel
    procedure: Procedure
    electrons: FloatArray
    half: float
    beyond: float
    exposure_s: float
    dark_times: FloatArray

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
        return cls(sensor, procedure, steps, capacity / 2, 2 * capacity + 20 * math.sqrt(capacity), exposure_s, times)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.procedure.pixels, self.procedure.pixels

    @property
    def photons(self) -> FloatArray:
        """(steps,) light of the ladder in photons a pixel."""
        return self.electrons / efficiency_of(self.sensor, self.procedure)

    def _frame(self, electrons: float, exposure_s: float, *names: str | int) -> FloatArray:
        shot, read = (stream(self.procedure.seed, "characterise", noise, *names) for noise in ("shot", "read"))
        return np.asarray(expose(np.full(self.shape, electrons), exposure_s, self.sensor, shot, read), dtype=np.float64)

    def _pair(self, electrons: float, exposure_s: float, name: str, index: int = 0) -> Pair:
        return pair_of(*(self._frame(electrons, exposure_s, name, index, side) for side in (0, 1)))

    def measured(self, job: Job) -> Session:
        """What the frames say, which are taken one after the other; ``job`` is told how far it is."""
        job.progress("light", 0.0)
        steps = in_threads(
            lambda step: self._pair(step[1], self.exposure_s, "ladder", step[0]), [*enumerate(self.electrons)]
        )
        job.progress("dark", 0.4)
        dark = in_threads(lambda step: self._pair(0.0, step[1], "dark series", step[0]), [*enumerate(self.dark_times)])
        job.progress("stacks", 0.5)
        stacks = in_threads(
            lambda light: stack_of(self._frames(*light)), [(0.0, "dark stack"), (self.half, "bright stack")]
        )
        return Session(
            shape=self.shape,
            photons=self.photons,
            ladder=pairs_of(steps),
            dark=self._pair(0.0, self.exposure_s, "dark"),
            overexposed=np.asarray(self._frame(self.beyond, self.exposure_s, "overexposed").mean()),
            dark_times=self.dark_times,
            dark_series=pairs_of(dark),
            dark_stack=stacks[0],
            bright_stack=stacks[1],
            rounded=self.sensor.bits is not None,
        )

    def _frames(self, electrons: float, name: str) -> Iterator[FloatArray]:
        for index in range(self.procedure.frames):
            yield self._frame(electrons, self.exposure_s, name, index)

    def expected(self) -> Session:
        """The same statistics as closed forms expect them of all specimens; nonuniformity as it was set."""
        ladder, dark = self._expected_pair(self.electrons), self._expected_pair(0.0)
        series = [self._expected_pair(0.0, time) for time in self.dark_times]
        return Session(
            shape=self.shape,
            photons=self.photons,
            ladder=ladder,
            dark=dark,
            overexposed=self._expected_pair(self.beyond).mean,
            dark_times=self.dark_times,
            dark_series=pairs_of(series),
            dark_stack=self._expected_stack(dark.mean, 0.0),
            bright_stack=self._expected_stack(self._expected_pair(self.half).mean, self.half),
            rounded=self.sensor.bits is not None,
        )

    def _expected_pair(self, electrons: FloatArray | float, exposure_s: float | None = None) -> Pair:
        """Means over all pixels: undamaged ones, and dead ones, which see the dark."""
        time = self.exposure_s if exposure_s is None else exposure_s
        (lit, noise), (dark, still) = (
            frame_moments(np.atleast_1d(light), time, self.alike) for light in (electrons, np.zeros_like(electrons))
        )
        dead = self.sensor.dead_pixels
        mean, variance = (1 - dead) * lit + dead * dark, (1 - dead) * noise + dead * still
        rows = (self.sensor.superpixel_row_noise_e * self.sensor.gain_dn_per_e) ** 2
        pair = mean, variance, np.minimum(rows, variance)
        return Pair(*(part if np.ndim(electrons) else part[0] for part in pair))

    def _expected_stack(self, mean: FloatArray, electrons: float) -> Stack:
        rows, columns, pixel = (self.slope(electrons) ** 2 * part for part in self.parts(electrons))
        m, n = self.shape
        parts = rows + columns + pixel, rows + pixel / n, columns + pixel / m
        return Stack(mean, *(np.asarray(part) for part in parts))

    @property
    def alike(self) -> SensorModel:
        """The sensor with pixels that are all alike, of the same mean dark current, lit evenly."""
        names = (
            *(f"dsnu_{part}_e" for part in SPLIT[1:]),
            *(f"prnu_{part}" for part in SPLIT[1:]),
            *("dark_current_spread_e_per_s", "hot_pixels", "hot_dark_current_e_per_s", "dead_pixels", "crosstalk"),
        )
        mean = self.sensor.dark_current_e_per_s + self.sensor.hot_pixels * self.sensor.hot_dark_current_e_per_s
        return self.sensor.model_copy(update={**dict.fromkeys(names, 0.0), "dark_current_e_per_s": mean})

    def slope(self, electrons: float) -> float:
        """Digital numbers for another electron, around so many ``electrons``."""
        if not self.sensor.linearity:
            return self.sensor.gain_dn_per_e
        around = np.array([electrons * 0.999, electrons * 1.001 + 1])
        mean, _ = frame_moments(around, self.exposure_s, self.alike)
        return float(np.diff(mean)[0] / np.diff(around)[0])

    def parts(self, electrons: float) -> tuple[float, float, float]:
        """Set spatial variances by row, column and pixel [e-^2] under light of so many ``electrons``."""
        pixel, row, column = (part**2 for part in self.sensor.offset_parts)
        dark = dark_current_variance(self.sensor) * self.exposure_s**2
        _, row_response, column_response = (part**2 for part in self.sensor.response_parts)
        own = response_variance(self.sensor) - row_response - column_response
        light = electrons**2
        return row + row_response * light, column + column_response * light, pixel + dark + own * light


def draw_sessions(frames: Frames, expected: Session) -> Session:
    """Statistics of :data:`_SESSIONS` sessions, each as far off the ``expected`` ones of ``frames`` as noise and
    specimen make them.

    A variance of n pixels whose rows share v_r of v has the variance (2 v_o^2 + k_4 / 2)/n + 4 v_o v_r/n + 2 v_r^2/M,
    v_o = v - v_r, k_4 = K^4 mu the fourth cumulant of the counts, dark ones among them.
    """
    sensor, rng = frames.sensor, stream(frames.procedure.seed, "characterise", "sessions")
    m, n = frames.shape
    gain, (pixel, row, column) = sensor.gain_dn_per_e, sensor.response_parts
    response = rng.standard_normal((_SESSIONS, 1)) * math.sqrt(row**2 / m + column**2 / n + pixel**2 / m / n)
    leak = rng.standard_normal((_SESSIONS, 1)) * math.sqrt(dark_current_variance(sensor) / m / n)
    dark_electrons = mean_dark_current(sensor)

    def pairs(pair: Pair, electrons: FloatArray, times: FloatArray | float) -> Pair:
        mean, variance, rows = (np.atleast_1d(part)[None, :] for part in (pair.mean, pair.variance, pair.rows))
        own = variance - rows
        z = rng.standard_normal((3, _SESSIONS, mean.shape[1]))
        specimen = gain * (electrons * response + np.asarray(times) * leak) * (own > 0)
        mean = mean + specimen + z[0] * np.sqrt((own / m / n + rows / m) / 2)
        fourth = gain**4 * (electrons + dark_electrons * np.asarray(times)) / 2
        spread = (2 * own**2 + fourth + 4 * own * rows) / m / n
        shared = np.sqrt(2.0 / m) * rows * z[2]
        alone = np.sqrt(2.0 / m) * own / n * rng.standard_normal(z[2].shape)
        return Pair(mean, variance + np.sqrt(spread) * z[1] + shared, rows + shared + alone)

    ladder = pairs(expected.ladder, frames.electrons, frames.exposure_s)
    dark = pairs(expected.dark, np.zeros(1), frames.exposure_s)
    series = pairs(expected.dark_series, np.zeros(_DARK_STEPS), frames.dark_times)
    stacks = _drawn_stacks(frames, expected, rng)
    beyond = expected.overexposed + np.sqrt(expected.dark.variance / m / n) * rng.standard_normal(_SESSIONS)
    return Session(
        frames.shape,
        frames.photons,
        ladder,
        Pair(*(part[:, 0] for part in (dark.mean, dark.variance, dark.rows))),
        beyond,
        frames.dark_times,
        series,
        *stacks,
        expected.rounded,
    )


def _drawn_stacks(frames: Frames, expected: Session, rng: np.random.Generator) -> tuple[Stack, Stack]:
    """Dark and bright stacks as they may come out: sums of squares of offsets, responses and what is left of noise.

    By row, column and pixel these are independent; of f degrees of freedom, squares are chi-square and products of two
    parts normal. Offsets are the same in both stacks.
    """
    m, n = frames.shape
    count = frames.procedure.frames
    noise = [
        float(np.interp(light, [0, *frames.electrons], [expected.dark.variance, *expected.ladder.variance]))
        for light in (0.0, frames.half)
    ]
    shared = min(float(expected.dark.rows), min(noise))
    sizes = {"row": (m - 1, n), "column": (n - 1, m), "pixel": ((m - 1) * (n - 1), 1)}
    squares: dict[str, list[FloatArray]] = {}
    dark, bright = frames.parts(0.0), frames.parts(frames.half)
    for index, (name, (freedom, averaged)) in enumerate(sizes.items()):
        of_pixel = dark[2] / averaged if averaged > 1 else 0.0
        offset = (dark[index] + of_pixel) * frames.slope(0.0) ** 2
        light = bright[index] - dark[index] + ((bright[2] - dark[2]) / averaged if averaged > 1 else 0.0)
        light *= frames.slope(frames.half) ** 2
        left = [((each - shared) / averaged + (shared if name == "row" else 0.0)) / count for each in noise]
        parts = np.sqrt([offset, light, *left])
        products = _products(freedom, len(parts), rng)
        squares[name] = [
            freedom * np.einsum("i,ijs,j->s", parts[used], products[np.ix_(used, used)], parts[used])
            for used in ([0, 2], [0, 1, 3])
        ]
    stacks = []
    for side, (stack, each) in enumerate(zip((expected.dark_stack, expected.bright_stack), noise, strict=True)):
        row, column, pixel = (squares[name][side] for name in ("row", "column", "pixel"))
        total = (row * n + column * m + pixel) / (m * n - 1)
        mean = np.full(_SESSIONS, float(stack.mean))
        taken = each / count
        stacks.append(Stack(mean, total - taken, row / m - taken / n, column / n - taken / m))
    return stacks[0], stacks[1]


def _products(freedom: int, count: int, rng: np.random.Generator) -> FloatArray:
    """(count, count, sessions) mean products of as many independent normal samples of some degrees of ``freedom``."""
    products = rng.standard_normal((count, count, _SESSIONS)) / math.sqrt(freedom)
    products = (products + products.transpose(1, 0, 2)) / math.sqrt(2)
    products[np.arange(count), np.arange(count)] = rng.chisquare(freedom, (count, _SESSIONS)) / freedom
    return np.asarray(products)
