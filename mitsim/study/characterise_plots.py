"""A characterisation in, its plots out: photon transfer, linearity, dark current, and how far every figure is off."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from mitsim.study.plots import BLACK, BLUE, FONT, GREY, ORANGE, VERMILION, WIDTH, figure_of, label_axes
from mitsim.study.typeset import rounded, typeset

if TYPE_CHECKING:
    from mitsim.study.characterise import Characterisation, Row

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
    axes.plot(
        expected.ladder.mean - expected.dark.mean, expected.ladder.variance, color=GREY, lw=1.5, label="closed form"
    )
    axes.plot(signal, session.ladder.variance, "o", color=BLUE, ms=5, label="pairs of frames")
    gain = _figure(done, "system_gain").found
    full = float(signal[int(session.ladder.variance.argmax())])
    line = np.array([0.0, 0.7 * full])
    label = "fit to 70 % of saturation"
    axes.plot(line, session.dark.variance + gain * line, color=VERMILION, lw=2, ls="--", label=label)
    axes.axvline(full, color=ORANGE, lw=1.5, ls=":", label="largest variance: saturation")
    axes.set_title(f"Photon transfer: the gain is {_found(done, 'system_gain')}", fontsize=FONT + 1)
    label_axes(axes, "signal less dark signal [DN]", "temporal variance [DN$^2$]")
    axes.legend(fontsize=FONT - 1, frameon=False, loc="upper left")
    return figure


def _linearity(done: Characterisation) -> Figure:
    """Relative deviation of the signal from a line, over the photons."""
    figure, axes = figure_of(0.42 * WIDTH)
    for session, style, label in (
        (done.expected, {"color": GREY, "lw": 1.5}, "closed form"),
        (done.session, {"color": BLUE, "lw": 0, "marker": "o", "ms": 5}, "pairs of frames"),
    ):
        signal = session.ladder.mean - session.dark.mean
        full = signal[int(session.ladder.variance.argmax())]
        used = (signal >= 0.05 * full) & (signal <= 0.95 * full)
        slope, start = np.polyfit(session.photons[used], signal[used], 1, w=1 / signal[used])
        line = start + slope * session.photons[used]
        axes.plot(session.photons[used], 100 * (signal[used] / line - 1), label=label, **style)
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
    for session, style, label in (
        (done.expected, {"color": GREY, "lw": 1.5}, "closed form"),
        (done.session, {"color": BLUE, "lw": 0, "marker": "o", "ms": 5}, "pairs of frames"),
    ):
        dark = (session.dark_series.mean - done.sensor.superpixel_black_level_dn) / gain
        axes.plot(session.dark_times, dark, label=label, **style)
    axes.set_title(f"The dark current is {_found(done, 'dark_current')}", fontsize=FONT + 1)
    label_axes(axes, "exposure time [s]", "dark signal less black level [e$^-$]")
    axes.legend(fontsize=FONT - 1, frameon=False)
    return figure


def _figure(done: Characterisation, name: str) -> Row:
    """The figure of that ``name``."""
    return next(row for row in done.rows if row.name == name)


def _found(done: Characterisation, name: str) -> str:
    """A figure with its standard error and unit, and what the file sets."""
    row = _figure(done, name)
    error = rounded(row.standard_error, row.standard_error)
    unit = row.unit.replace("e-", "e\N{SUPERSCRIPT MINUS}")
    return typeset(f"{rounded(row.found, row.standard_error)} +- {error} {unit}, set {row.set:g}")


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
    said = f"{far} of {len(names)} figures are" if far else f"None of {len(names)} figures is"
    axes.set_title(f"{said} more than {MOST_OFF:g} standard errors off", fontsize=FONT + 1)
    axes.set_xlim(-1.2 * max(MOST_OFF, float(np.abs(off).max())), 1.2 * max(MOST_OFF, float(np.abs(off).max())))
    label_axes(
        axes, f"found less set or expected [predicted standard errors]; shaded: within {MOST_OFF:g}", "", grid="x"
    )
    return figure
