"""A characterisation in, its plots out: photon transfer, linearity, dark current, and how far figures are off."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mitsim.core.arrays import FloatArray
from mitsim.report.pages import round_to_error, typeset
from mitsim.report.plots import BLACK, BLUE, COLUMN, FONT, GREY, ORANGE, TITLE_LETTERS, VERMILION, figure_of, label_axes
from mitsim.sensor.emva import LINEAR, MOST_FITTED, Session
from mitsim.studies.emva_results import MOST_OFF, Characterisation, Row

_HEIGHT = 3.3
"""Inches of a plot."""
_CLOSED: dict[str, Any] = {"color": GREY, "lw": 1.5}
_PAIRS: dict[str, Any] = {"color": BLUE, "lw": 0, "marker": "o", "ms": 5, "label": "pairs of frames"}
"""How what is expected and what was found are drawn."""


def figures_of(done: Characterisation) -> Mapping[str, Figure]:
    """Plots of what is ``done``, by file name; those that its frames tell nothing of are left out."""
    names = {row.name for row in done.rows}
    drawn = {"photon_transfer.png": _photon_transfer(done), "deviations.png": _deviations(done)}
    if "linearity_min" in names:
        drawn["linearity.png"] = _linearity(done)
    if "dark_current" in names:
        drawn["dark_current.png"] = _dark_current(done)
    return drawn


def _chart(
    done: Characterisation, points: Callable[[Session], tuple[FloatArray, FloatArray]], title: str, x: str, y: str
) -> tuple[Figure, Axes]:
    figure, axes = figure_of(_HEIGHT, COLUMN)
    axes.plot(*points(done.expected), **_CLOSED, label="camera found" if done.real else "closed form")
    axes.plot(*points(done.session), **_PAIRS)
    axes.set_title(fill(title, TITLE_LETTERS), fontsize=FONT)
    label_axes(axes, x, y)
    return figure, axes


def _photon_transfer(done: Characterisation) -> Figure:
    """Variance over signal, as found and as closed forms have it, and the line whose slope is the gain."""

    def points(session: Session) -> tuple[FloatArray, FloatArray]:
        _, signal, noise = session.transfer()
        return signal, noise

    title = f"Photon transfer: EMVA 1288 finds a gain of {_figure_text(done, 'system_gain')}"
    figure, axes = _chart(done, points, title, "signal less dark signal [DN]", "variance less dark variance [DN$^2$]")
    signal, noise = points(done.session)
    full = float(signal[int(noise.argmax())]) if done.session.saturates else float(signal.max())
    line = np.array([0.0, MOST_FITTED * full if done.session.saturates else full])
    label = "fit to 70 %" if done.session.saturates else "fit"
    axes.plot(line, _figure(done, "system_gain").found * line, color=VERMILION, lw=2, ls="--", label=label)
    if done.session.saturates:
        axes.axvline(full, color=ORANGE, lw=1.5, ls=":", label="saturation")
        axes.set_xlim(right=1.1 * float(signal.max()))
    axes.legend(fontsize=FONT - 1, frameon=False, loc="upper left")
    return figure


def _linearity(done: Characterisation) -> Figure:
    def points(session: Session) -> tuple[FloatArray, FloatArray]:
        photons, signal, noise = session.transfer()
        top = float(signal[int(noise.argmax())]) if session.saturates else float(signal.max()) / LINEAR[1]
        used = (signal >= LINEAR[0] * top) & (signal <= LINEAR[1] * top * (1 + 1e-12))
        slope, start = np.polyfit(photons[used], signal[used], 1, w=1 / signal[used])
        return photons[used], 100 * (signal[used] / (start + slope * photons[used]) - 1)

    light = "photons on a pixel [1]" if done.sensor.states_efficiency else "light on a pixel [a.u.]"
    ends = [_figure(done, f"linearity_{end}").found for end in ("min", "max")]
    title = f"Linearity: {typeset(f'{ends[0]:.2g}')} to {typeset(f'{ends[1]:+.2g}')} % off a line"
    figure, axes = _chart(done, points, title, light, "deviation from a line [%]")
    axes.axhline(0, color=BLACK, lw=1)
    axes.legend(fontsize=FONT - 1, frameon=False)
    return figure


def _dark_current(done: Characterisation) -> Figure:
    def points(session: Session) -> tuple[FloatArray, FloatArray]:
        signal = session.pairs.mean[session.unlit] - done.sensor.superpixel_black_level_dn
        return session.exposure_s[session.unlit], signal / _figure(done, "system_gain").found

    title = f"EMVA 1288 finds a dark current of {_figure_text(done, 'dark_current')}"
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
    beside = f"{'camera found' if done.real else 'set'} {row.set:.5g}"
    return typeset(f"{round_to_error(row.found, row.standard_error)} +- {error} {unit}, {beside}")


def _deviations(done: Characterisation) -> Figure:
    """By how many standard errors each figure is off."""
    figure, axes = figure_of(0.9 + 0.26 * len(done.rows), COLUMN)
    place = np.arange(len(done.rows))[::-1]
    off = np.clip([row.deviations for row in done.rows], -2 * MOST_OFF, 2 * MOST_OFF)
    axes.axvspan(-MOST_OFF, MOST_OFF, color="#eef2f7", zorder=0)
    axes.axvline(0, color=BLACK, lw=1)
    axes.plot(off, place, "o", color=BLUE, ms=7)
    names = [row.name.replace("_", " ").replace("dsnu", "DSNU").replace("prnu", "PRNU") for row in done.rows]
    axes.set_yticks(place, names, fontsize=FONT - 1)
    far = sum(not abs(row.deviations) <= MOST_OFF for row in done.rows)
    verdict = f"{far} of {len(names)} figures are" if far else f"None of {len(names)} figures is"
    axes.set_title(f"{verdict}\nmore than {MOST_OFF:g} standard errors off", fontsize=FONT)
    axes.set_xlim(-1.2 * max(MOST_OFF, float(np.abs(off).max())), 1.2 * max(MOST_OFF, float(np.abs(off).max())))
    of = "the camera's" if done.real else "set"
    label = f"found less {of} or expected\n[standard errors]; shaded: within {MOST_OFF:g}"
    label_axes(axes, label, "", grid="x")
    return figure
