"""A camera in, its figures after EMVA 1288 release 4.0 out: measured on simulated frames, beside those that were set.

The frames are those that a test bench takes: pairs under even light from dark to beyond saturation, pairs in the dark
over a series of exposures, and stacks in the dark and at half of saturation. Each figure's standard error is predicted
before a frame is drawn: closed-form moments (`mitsim.sensor.moments`) tell how far every statistic may be off, and a
thousand sessions of such statistics are evaluated as that of the frames is (GUM, supplement 1).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import versions
from mitsim.core.files import write_json
from mitsim.core.job import Job
from mitsim.devices.sensor import SensorModel
from mitsim.report.pages import round_to_error, typeset
from mitsim.report.plots import BLACK, BLUE, FONT, GREY, ORANGE, VERMILION, WIDTH, figure_of, label_axes
from mitsim.sensor.emva import LEAST_DARK, QUANTISATION, SPLIT, Session, figures
from mitsim.sensor.specimen import mean_dark_current
from mitsim.studies.emva_options import Procedure, capacity_of, efficiency_of
from mitsim.studies.emva_procedure import Frames, draw_sessions
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
    **{f"dsnu_{part}": (f"DSNU1288.{part}", "e-") for part in SPLIT},
    **{f"prnu_{part}": (f"PRNU1288.{part}", "%") for part in SPLIT},
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
        names = ("set", "expected", "found", "std. error")
        head = f"{'figure':<26}{'symbol':<18}{'unit':<10}" + "".join(f"{name:>12}" for name in names) + f"{'off by':>8}"
        lines = [
            f"{self.sensor.name}: {self.procedure.pixels} x {self.procedure.pixels} pixels, "
            f"{self.procedure.steps} steps of light"
        ]
        lines += [head]
        for row in self.rows:
            expected = "" if row.expected is None else f"{row.expected:.5g}"
            lines.append(
                f"{row.name:<26}{row.symbol:<18}{row.unit:<10}{row.set:>12.5g}{expected:>12}"
                f"{round_to_error(row.found, row.standard_error):>12}"
                f"{round_to_error(row.standard_error, row.standard_error):>12}{row.deviations:>8.1f}"
            )
        if any(row.expected is not None for row in self.rows):
            lines.append(
                "expected: where the procedure finds another figure than the one set, at these steps and frames"
            )
        if self.output:
            lines.append(f"JSON and plots: {self.output}")
        return lines

    def figures(self) -> Mapping[str, Figure]:
        """Plots by file name."""
        return figures_of(self)


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
    expected = frames.expected()
    spread = figures(draw_sessions(frames, expected))
    session = frames.measured(job)
    found = figures(session)
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
    if name == "dark_noise" and (given * sensor.gain_dn_per_e) ** 2 + QUANTISATION < LEAST_DARK:
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

_CLOSED: dict[str, Any] = {"color": GREY, "lw": 1.5, "label": "closed form"}
_PAIRS: dict[str, Any] = {"color": BLUE, "lw": 0, "marker": "o", "ms": 5, "label": "pairs of frames"}
"""How what is expected and what was found are drawn."""
MOST_OFF = 5.0
"""Standard errors from which a figure is off: one of twenty figures is so by chance in 1e5 characterisations."""


def figures_of(done: Characterisation) -> Mapping[str, Figure]:
    """Plots of ``done``, by file name."""
    return {
        "photon_transfer.png": _photon_transfer(done),
        "linearity.png": _linearity(done),
        "dark_current.png": _dark_current(done),
        "deviations.png": _deviations(done),
    }


def _photon_transfer(done: Characterisation) -> Figure:
    """Variance over signal, as found and as closed forms have it, and the line whose slope is the gain."""
    figure, axes = figure_of(0.5 * WIDTH)
    session, expected = done.session, done.expected
    signal = session.ladder.mean - session.dark.mean
    axes.plot(expected.ladder.mean - expected.dark.mean, expected.ladder.variance, **_CLOSED)
    axes.plot(signal, session.ladder.variance, **_PAIRS)
    gain = _figure(done, "system_gain").found
    full = float(signal[int(session.ladder.variance.argmax())])
    line = np.array([0.0, 0.7 * full])
    label = "fit to 70 % of saturation"
    axes.plot(line, session.dark.variance + gain * line, color=VERMILION, lw=2, ls="--", label=label)
    axes.axvline(full, color=ORANGE, lw=1.5, ls=":", label="largest variance: saturation")
    axes.set_title(f"Photon transfer: the gain is {_figure_text(done, 'system_gain')}", fontsize=FONT + 1)
    label_axes(axes, "signal less dark signal [DN]", "temporal variance [DN$^2$]")
    axes.legend(fontsize=FONT - 1, frameon=False, loc="upper left")
    return figure


def _linearity(done: Characterisation) -> Figure:
    """Relative deviation of the signal from a line, over the photons."""
    figure, axes = figure_of(0.42 * WIDTH)
    for session, style in ((done.expected, _CLOSED), (done.session, _PAIRS)):
        signal = session.ladder.mean - session.dark.mean
        full = signal[int(session.ladder.variance.argmax())]
        used = (signal >= 0.05 * full) & (signal <= 0.95 * full)
        slope, start = np.polyfit(session.photons[used], signal[used], 1, w=1 / signal[used])
        line = start + slope * session.photons[used]
        axes.plot(session.photons[used], 100 * (signal[used] / line - 1), **style)
    axes.axhline(0, color=BLACK, lw=1)
    light = "photons on a pixel [1]" if done.sensor.states_efficiency else "photoelectrons of a pixel [e$^-$]"
    ends = [_figure(done, f"linearity_{end}").found for end in ("min", "max")]
    axes.set_title(
        f"Linearity: {typeset(f'{ends[0]:.2g}')} to {typeset(f'{ends[1]:+.2g}')} % off a line",
        fontsize=FONT + 1,
        loc="left",
    )
    label_axes(axes, light, "deviation from a line [%]")
    axes.legend(fontsize=FONT - 1, frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1))
    return figure


def _dark_current(done: Characterisation) -> Figure:
    """Dark signal over exposure time."""
    figure, axes = figure_of(0.42 * WIDTH)
    gain = _figure(done, "system_gain").found
    for session, style in ((done.expected, _CLOSED), (done.session, _PAIRS)):
        dark = (session.dark_series.mean - done.sensor.superpixel_black_level_dn) / gain
        axes.plot(session.dark_times, dark, **style)
    axes.set_title(f"The dark current is {_figure_text(done, 'dark_current')}", fontsize=FONT + 1)
    label_axes(axes, "exposure time [s]", "dark signal less black level [e$^-$]")
    axes.legend(fontsize=FONT - 1, frameon=False)
    return figure


def _figure(done: Characterisation, name: str) -> Row:
    """The figure of that ``name``."""
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
