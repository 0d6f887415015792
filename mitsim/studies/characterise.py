"""A camera in, its figures after EMVA 1288 release 4.0 out: measured on simulated frames, beside those that were set.

The frames are those that a test bench takes: pairs under even light from dark to beyond saturation, pairs in the dark
over a series of exposures, and stacks in the dark and at half of saturation. Each figure's standard error is predicted
before a frame is drawn: closed-form moments (`mitsim.sensor.moments`) tell how far every statistic may be off, and a
thousand sessions of such statistics are evaluated as that of the frames is (GUM, supplement 1).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import versions
from mitsim.core.files import write_json
from mitsim.core.job import Job
from mitsim.core.parallel import in_threads
from mitsim.core.seeds import stream
from mitsim.devices.sensor import EXPOSURE_S, SensorModel
from mitsim.report.pages import round_to_error, typeset
from mitsim.report.plots import BLACK, BLUE, FONT, GREY, ORANGE, VERMILION, WIDTH, figure_of, label_axes
from mitsim.sensor import emva
from mitsim.sensor.chain import expose
from mitsim.sensor.emva import Session
from mitsim.sensor.moments import frame_moments
from mitsim.sensor.specimen import dark_current_variance, mean_dark_current, response_variance
from mitsim.studies.emva_options import Procedure, capacity_of, efficiency_of
from mitsim.studies.framework.page import text_table
from mitsim.studies.framework.run import study_folder, write_figures

UNITS: Mapping[str, tuple[str, str]] = {
    "system_gain": ("K", "DN/e-"),
    "quantum_efficiency": ("eta", "e-/photon"),
    "dark_noise": ("sigma_d", "e-"),
    "row_noise": ("sigma_row", "e-"),
    "saturation_capacity": ("mu_e.sat", "e-"),
    "full_well": ("F", "e-"),
    "linearity_min": ("LE_min", "%"),
    "linearity_max": ("LE_max", "%"),
    "dark_current": ("mu_I.mean", "e-/s"),
    "dark_current_by_variance": ("mu_I.var", "e-/s"),
    **{f"dsnu_{part}": (f"DSNU1288.{part}", "e-") for part in emva.SPLIT},
    **{f"prnu_{part}": (f"PRNU1288.{part}", "%") for part in emva.SPLIT},
}
"""Symbol of the standard, and unit, of each figure in the order in which they are shown."""
_SQUARES = ("row_noise", "dsnu", "prnu")
"""Figures that are found as variances, which may be below zero, and shown as their roots."""
_BIASED, _MISLEADS = 0.5, 1.0
"""Standard errors by which the procedure's own bias by the ADC moves a figure, from which it is held against what is
expected of it, and from which it is flagged: with less, 98 of 100 found figures are still within three standard errors
of the value set."""
_DITHERED = 0.8
"""Noise of reading [DN] below which rounding is named as the cause: above, it is white to 1e-5."""
_CUT = 1e-3
"""Part of the dark readings that are 0 from which these are named as the cause."""
_BY_METHOD = ("saturation_capacity", "linearity_min", "linearity_max")
"""Figures that depend on the steps of light and on their noise, and have no value that a camera file sets."""


@dataclass(frozen=True)
class Row:
    """One figure: what was set, what the procedure is expected to find where that differs (otherwise None), what it
    found, its predicted standard error, by how many of these it is off, and by how many the ADC's ends and steps move
    what is expected from what was set (0 where those are not at fault)."""

    name: str
    symbol: str
    unit: str
    set: float
    expected: float | None
    found: float
    standard_error: float
    deviations: float
    bias: float = 0.0


@dataclass(frozen=True, eq=False)
class Characterisation:
    """A camera's figures.

    Attributes
    ----------
    sensor, procedure
        what was characterised, and how.
    exposure_s
        of the ladder and the stacks [s].
    session, expected
        what the frames said, and what closed forms expect of them.
    rows
        the figures.
    output
        folder of JSON and plots; None where none was asked for.
    """

    sensor: SensorModel
    procedure: Procedure
    exposure_s: float
    session: Session = field(repr=False)
    expected: Session = field(repr=False)
    rows: tuple[Row, ...]
    output: str | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Figures that are off by more than five standard errors, and those that the procedure cannot find."""
        biased = [row for row in self.rows if abs(row.bias) > _MISLEADS]
        off = tuple(
            f"{row.name}: found {row.found:.5g} {row.unit}, {abs(row.deviations):.1f} standard errors off "
            f"{row.set if row.expected is None else row.expected:.5g}; the procedure does not fit this camera"
            for row in self.rows
            if not abs(row.deviations) <= MOST_OFF
        )
        if not biased:
            return off
        found = ", ".join(f"{row.name} {row.expected:.5g} {row.unit} for {row.set:.5g}" for row in biased)
        return (f"the procedure does not find what is set, but {found}: {self._cause}", *off)

    @property
    def _cause(self) -> str:
        """Why the procedure's figures are biased, and what to do."""
        sensor = self.sensor
        noise = sensor.superpixel_reading_noise_e * sensor.gain_dn_per_e
        cut = math.erfc((sensor.superpixel_black_level_dn - 0.5) / (noise * math.sqrt(2))) / 2 if noise else 0.0
        if cut > _CUT:
            return f"{cut:.2g} of all dark readings are 0 DN, which hides their noise; raise black_level_dn"
        if noise < _DITHERED:
            return (
                f"rounding to whole DN is no noise of 1/12 DN^2 beside {noise:.2g} DN in the dark; raise gain_dn_per_e"
            )
        return "the ADC's ends or steps hide part of the noise; raise black_level_dn or lower gain_dn_per_e"

    def payload(self) -> dict[str, Any]:
        """What the command line reports as JSON."""
        return {
            "camera": self.sensor.name,
            **asdict(self.procedure),
            "exposure_s": self.exposure_s,
            "figures": [asdict(row) for row in self.rows],
            "warnings": list(self.warnings),
            "output": self.output,
        }

    def lines(self) -> list[str]:
        """For people."""
        head = ("figure", "symbol", "unit", "set", "expected", "found", "std. error", "off by")
        rows = [
            (
                row.name, row.symbol, row.unit, f"{row.set:.5g}",
                "" if row.expected is None else f"{row.expected:.5g}",
                *(round_to_error(number, row.standard_error) for number in (row.found, row.standard_error)),
                f"{row.deviations:.1f}",
            )
            for row in self.rows
        ]  # fmt: skip
        procedure = f"{self.procedure.pixels} x {self.procedure.pixels} pixels, {self.procedure.steps} steps of light"
        lines = [f"{self.sensor.name}: {procedure}", *text_table(head, rows)]
        if any(row.expected is not None for row in self.rows):
            lines.append(
                "expected: where the procedure finds another figure than the one set, at these steps and frames"
            )
        if self.output:
            lines.append(f"JSON and plots: {self.output}")
        return lines

    def figures(self) -> Mapping[str, Figure]:
        """Plots by file name."""
        drawn = _photon_transfer(self), _linearity(self), _dark_current(self), _deviations(self)
        return dict(zip(_FILES, drawn, strict=True))


def characterise(
    sensor: SensorModel, procedure: Procedure | None = None, output: Path | str | None = None, job: Job | None = None
) -> Characterisation:
    """Run EMVA 1288's procedure on frames of a camera, and write JSON and plots where a folder is given.

    Parameters
    ----------
    sensor
        the camera.
    procedure
        sizes and seed.
    output
        new or empty folder, or one of an earlier characterisation, which is replaced.
    job
        told how far it is.

    Raises
    ------
    MitsimError
        for a camera that light never saturates, a wavelength outside its curve, or a folder that holds something else.
    """
    procedure, job = procedure or Procedure(), job or Job()
    capacity = capacity_of(sensor)
    efficiency_of(sensor, procedure)
    if output is None:
        return _characterise(sensor, procedure, capacity, job)
    with study_folder(output, "characterise") as folder:
        done = _characterise(sensor, procedure, capacity, job, str(folder))
        results = folder / "characterise.json"  # last, so that a folder with it is whole
        results.unlink(missing_ok=True)
        write_figures(folder, done.figures())
        write_json(results, {**done.payload(), "kind": "characterise", "versions": versions()})
    return done


def _characterise(
    sensor: SensorModel, procedure: Procedure, capacity: float, job: Job, output: str | None = None
) -> Characterisation:
    frames = Frames.of(sensor, procedure, capacity)
    expected = frames.expect()
    spread = emva.figures(draw_sessions(frames, expected))
    session = frames.measure(job)
    found = emva.figures(session)
    # Without a quantum efficiency light is counted in electrons, and there is none to find.
    names = [name for name in UNITS if sensor.states_efficiency or name != "quantum_efficiency"]
    rows = tuple(_row(frames, name, found[name], spread[name]) for name in names)
    return Characterisation(sensor, procedure, frames.exposure_s, session, expected, rows, output)


def _set(frames: Frames, name: str) -> float:
    """What the camera's file sets of a figure ``name``; squares of those that are found as variances."""
    sensor, time = frames.sensor, frames.exposure_s
    kind, _, part = name.partition("_")
    if kind in ("dsnu", "prnu"):
        row, column, pixel = frames.parts(0.0)
        if kind == "prnu":
            lit = frames.parts(frames.half)
            alive = frames.half * (1 - sensor.dead_pixels)
            row, column, pixel = ((on - off) / alive**2 for on, off in zip(lit, (row, column, pixel), strict=True))
        return {"total": row + column + pixel, "row": row, "column": column, "pixel": pixel}[part]
    dark = mean_dark_current(sensor)
    return {
        "system_gain": sensor.gain_dn_per_e,
        "quantum_efficiency": efficiency_of(sensor, frames.procedure) * (1 - sensor.dead_pixels),
        "dark_noise": math.sqrt(sensor.superpixel_reading_noise_e**2 + dark * time),
        "row_noise": sensor.superpixel_row_noise_e**2,
        "saturation_capacity": capacity_of(sensor),
        "full_well": (capacity_of(sensor) - dark * time) * (1 - sensor.dead_pixels),
        "linearity_min": 0.0,
        "linearity_max": 0.0,
        "dark_current": dark,
        "dark_current_by_variance": dark,
    }[name]


def _row(frames: Frames, name: str, found: FloatArray, sessions: FloatArray) -> Row:
    """A figure ``name`` as it is shown, of what was ``found`` and what drawn ``sessions`` (count,) say of its error."""
    sensor = frames.sensor
    value, spread, centre = float(found), float(sessions.std()), float(sessions.mean())
    given = _set(frames, name)
    # What the linear method makes of a camera that is not linear, and of rows that share noise, is not what is set.
    method = name in _BY_METHOD or bool(sensor.linearity)
    method |= bool(sensor.row_noise_e) and name.startswith(("dsnu", "prnu"))
    bias = 0.0 if method or not spread or sensor.bits is None else (centre - given) / spread
    method |= abs(bias) > _BIASED
    if name == "dark_noise" and (given * sensor.gain_dn_per_e) ** 2 + emva.QUANTISATION < emva.LEAST_DARK:
        bias = 0.0  # it is found as the standard's limit, as it should be
    if name == "saturation_capacity":
        spread = math.hypot(spread, float(frames.electrons[0]) / math.sqrt(12))
    against = centre if method else given
    off = (value - against) / spread if spread else 0.0 if value == against else math.inf
    symbol, unit = UNITS[name]
    scale = 100.0 if unit == "%" else 1.0
    if name.startswith(_SQUARES):
        root = math.sqrt(max(against, 0.0))
        spread = spread / (2 * max(root, math.sqrt(spread))) if spread else 0.0
        given, value, centre = (math.copysign(math.sqrt(abs(square)), square) for square in (given, value, centre))
    expected = scale * centre if method else None
    return Row(name, symbol, unit, scale * given, expected, scale * value, scale * spread, off, bias)


# -------- A characterisation in, its plots out

_FILES = ("photon_transfer.png", "linearity.png", "dark_current.png", "deviations.png")
_CLOSED: dict[str, Any] = {"color": GREY, "lw": 1.5, "label": "closed form"}
_PAIRS: dict[str, Any] = {"color": BLUE, "lw": 0, "marker": "o", "ms": 5, "label": "pairs of frames"}
"""How what is expected and what was found are drawn."""
MOST_OFF = 5.0
"""Standard errors from which a figure is off: one of twenty figures is so by chance in 1e5 characterisations."""


def _chart(
    done: Characterisation, points: Callable[[Session], tuple[FloatArray, FloatArray]], title: str, x: str, y: str
) -> tuple[Figure, Axes]:
    figure, axes = figure_of(0.45 * WIDTH)
    for session, style in ((done.expected, _CLOSED), (done.session, _PAIRS)):
        axes.plot(*points(session), **style)
    axes.set_title(title, fontsize=FONT + 1)
    label_axes(axes, x, y)
    return figure, axes


def _photon_transfer(done: Characterisation) -> Figure:
    """Variance over signal, as found and as closed forms have it, and the line whose slope is the gain."""

    def points(session: Session) -> tuple[FloatArray, FloatArray]:
        return session.ladder.mean - session.dark.mean, session.ladder.variance

    title = f"Photon transfer: the gain is {_figure_text(done, 'system_gain')}"
    figure, axes = _chart(done, points, title, "signal less dark signal [DN]", "temporal variance [DN$^2$]")
    signal, variance = points(done.session)
    full = float(signal[int(variance.argmax())])
    line, label = np.array([0.0, 0.7 * full]), "fit to 70 % of saturation"
    fit = done.session.dark.variance + _figure(done, "system_gain").found * line
    axes.plot(line, fit, color=VERMILION, lw=2, ls="--", label=label)
    axes.axvline(full, color=ORANGE, lw=1.5, ls=":", label="largest variance: saturation")
    axes.legend(fontsize=FONT - 1, frameon=False, loc="upper left")
    return figure


def _linearity(done: Characterisation) -> Figure:
    def points(session: Session) -> tuple[FloatArray, FloatArray]:
        signal = session.ladder.mean - session.dark.mean
        full = signal[int(session.ladder.variance.argmax())]
        used = (signal >= 0.05 * full) & (signal <= 0.95 * full)
        slope, start = np.polyfit(session.photons[used], signal[used], 1, w=1 / signal[used])
        return session.photons[used], 100 * (signal[used] / (start + slope * session.photons[used]) - 1)

    light = "photons on a pixel [1]" if done.sensor.states_efficiency else "photoelectrons of a pixel [e$^-$]"
    ends = [_figure(done, f"linearity_{end}").found for end in ("min", "max")]
    title = f"Linearity: {typeset(f'{ends[0]:.2g}')} to {typeset(f'{ends[1]:+.2g}')} % off a line"
    figure, axes = _chart(done, points, title, light, "deviation from a line [%]")
    axes.axhline(0, color=BLACK, lw=1)
    axes.legend(fontsize=FONT - 1, frameon=False)
    return figure


def _dark_current(done: Characterisation) -> Figure:
    def points(session: Session) -> tuple[FloatArray, FloatArray]:
        signal = session.dark_series.mean - done.sensor.superpixel_black_level_dn
        return session.dark_times, signal / _figure(done, "system_gain").found

    title = f"The dark current is {_figure_text(done, 'dark_current')}"
    figure, axes = _chart(done, points, title, "exposure time [s]", "dark signal less black level [e$^-$]")
    axes.legend(fontsize=FONT - 1, frameon=False)
    return figure


def _figure(done: Characterisation, name: str) -> Row:
    return next(row for row in done.rows if row.name == name)


def _figure_text(done: Characterisation, name: str) -> str:
    """A figure with its standard error and unit, and what the file sets."""
    row = _figure(done, name)
    error = round_to_error(row.standard_error, row.standard_error)
    unit = row.unit.replace("e-", "e\N{SUPERSCRIPT MINUS}")
    return typeset(f"{round_to_error(row.found, row.standard_error)} +- {error} {unit}, set {row.set:g}")


def _deviations(done: Characterisation) -> Figure:
    """By how many standard errors each figure is off."""
    figure, axes = figure_of(0.6 + 0.26 * len(done.rows))
    place = np.arange(len(done.rows))[::-1]
    off = np.clip([row.deviations for row in done.rows], -2 * MOST_OFF, 2 * MOST_OFF)
    axes.axvspan(-MOST_OFF, MOST_OFF, color="#eef2f7", zorder=0)
    axes.axvline(0, color=BLACK, lw=1)
    axes.plot(off, place, "o", color=BLUE, ms=7)
    names = [row.name.replace("_", " ").replace("dsnu", "DSNU").replace("prnu", "PRNU") for row in done.rows]
    axes.set_yticks(place, names, fontsize=FONT - 1)
    far = sum(not abs(row.deviations) <= MOST_OFF for row in done.rows)
    verdict = f"{far} of {len(names)} figures are" if far else f"None of {len(names)} figures is"
    axes.set_title(f"{verdict} more than {MOST_OFF:g} standard errors off", fontsize=FONT + 1)
    axes.set_xlim(-1.2 * max(MOST_OFF, float(np.abs(off).max())), 1.2 * max(MOST_OFF, float(np.abs(off).max())))
    label_axes(
        axes, f"found less set or expected [predicted standard errors]; shaded: within {MOST_OFF:g}", "", grid="x"
    )
    return figure


# -------- Which frames are taken, and what they tell: measured, expected, and drawn

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

    def _pair(self, electrons: float, exposure_s: float, name: str, index: int = 0) -> emva.Pair:
        return emva.pair_of(*(self._frame(electrons, exposure_s, name, index, side) for side in (0, 1)))

    def measure(self, job: Job) -> Session:
        """What the frames say, which are taken one after the other; ``job`` is told how far it is."""
        job.progress("light", 0.0)
        with job.clock.stage("light"):
            steps = in_threads(
                lambda step: self._pair(step[1], self.exposure_s, "ladder", step[0]), [*enumerate(self.electrons)]
            )
        job.progress("dark", 0.4)
        with job.clock.stage("dark"):
            dark = in_threads(
                lambda step: self._pair(0.0, step[1], "dark series", step[0]), [*enumerate(self.dark_times)]
            )
        job.progress("stacks", 0.5)
        with job.clock.stage("stacks"):
            stacks = in_threads(
                lambda light: emva.stack_of(self._frames(*light)), [(0.0, "dark stack"), (self.half, "bright stack")]
            )
        return Session(
            shape=self.shape,
            photons=self.photons,
            ladder=emva.pairs_of(steps),
            dark=self._pair(0.0, self.exposure_s, "dark"),
            overexposed=np.asarray(self._frame(self.beyond, self.exposure_s, "overexposed").mean()),
            dark_times=self.dark_times,
            dark_series=emva.pairs_of(dark),
            dark_stack=stacks[0],
            bright_stack=stacks[1],
            rounded=self.sensor.bits is not None,
        )

    def _frames(self, electrons: float, name: str) -> Iterator[FloatArray]:
        for index in range(self.procedure.frames):
            yield self._frame(electrons, self.exposure_s, name, index)

    def expect(self) -> Session:
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
            dark_series=emva.pairs_of(series),
            dark_stack=self._expected_stack(dark.mean, 0.0),
            bright_stack=self._expected_stack(self._expected_pair(self.half).mean, self.half),
            rounded=self.sensor.bits is not None,
        )

    def _expected_pair(self, electrons: FloatArray | float, exposure_s: float | None = None) -> emva.Pair:
        time = self.exposure_s if exposure_s is None else exposure_s
        (lit, noise), (dark, still) = (
            frame_moments(np.atleast_1d(light), time, self.alike) for light in (electrons, np.zeros_like(electrons))
        )
        dead = self.sensor.dead_pixels
        mean, variance = (1 - dead) * lit + dead * dark, (1 - dead) * noise + dead * still
        rows = (self.sensor.superpixel_row_noise_e * self.sensor.gain_dn_per_e) ** 2
        pair = mean, variance, np.minimum(rows, variance)
        return emva.Pair(*(part if np.ndim(electrons) else part[0] for part in pair))

    def _expected_stack(self, mean: FloatArray, electrons: float) -> emva.Stack:
        rows, columns, pixel = (self.slope(electrons) ** 2 * part for part in self.parts(electrons))
        m, n = self.shape
        parts = rows + columns + pixel, rows + pixel / n, columns + pixel / m
        return emva.Stack(mean, *(np.asarray(part) for part in parts))

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

    def pairs(pair: emva.Pair, electrons: FloatArray, times: FloatArray | float) -> emva.Pair:
        mean, variance, rows = (np.atleast_1d(part)[None, :] for part in (pair.mean, pair.variance, pair.rows))
        own = variance - rows
        z = rng.standard_normal((3, _SESSIONS, mean.shape[1]))
        specimen = gain * (electrons * response + np.asarray(times) * leak) * (own > 0)
        mean = mean + specimen + z[0] * np.sqrt((own / m / n + rows / m) / 2)
        fourth = gain**4 * (electrons + dark_electrons * np.asarray(times)) / 2
        spread = (2 * own**2 + fourth + 4 * own * rows) / m / n
        shared = np.sqrt(2.0 / m) * rows * z[2]
        alone = np.sqrt(2.0 / m) * own / n * rng.standard_normal(z[2].shape)
        return emva.Pair(mean, variance + np.sqrt(spread) * z[1] + shared, rows + shared + alone)

    ladder = pairs(expected.ladder, frames.electrons, frames.exposure_s)
    dark = pairs(expected.dark, np.zeros(1), frames.exposure_s)
    series = pairs(expected.dark_series, np.zeros(_DARK_STEPS), frames.dark_times)
    stacks = _drawn_stacks(frames, expected, rng)
    beyond = expected.overexposed + np.sqrt(expected.dark.variance / m / n) * rng.standard_normal(_SESSIONS)
    return Session(
        frames.shape,
        frames.photons,
        ladder,
        emva.Pair(*(part[:, 0] for part in (dark.mean, dark.variance, dark.rows))),
        beyond,
        frames.dark_times,
        series,
        *stacks,
        expected.rounded,
    )


def _drawn_stacks(frames: Frames, expected: Session, rng: np.random.Generator) -> tuple[emva.Stack, emva.Stack]:
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
        stacks.append(emva.Stack(mean, total - taken, row / m - taken / n, column / n - taken / m))
    return stacks[0], stacks[1]


def _products(freedom: int, count: int, rng: np.random.Generator) -> FloatArray:
    """(count, count, sessions) mean products of as many independent normal samples of some degrees of ``freedom``."""
    products = rng.standard_normal((count, count, _SESSIONS)) / math.sqrt(freedom)
    products = (products + products.transpose(1, 0, 2)) / math.sqrt(2)
    products[np.arange(count), np.arange(count)] = rng.chisquare(freedom, (count, _SESSIONS)) / freedom
    return np.asarray(products)
