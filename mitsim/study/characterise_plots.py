"""A characterisation in, its plots out: photon transfer, linearity, dark current, and how far every figure is off."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from mitsim.study.plots import BLACK, BLUE, FONT, GREY, ORANGE, VERMILION, WIDTH, figure_of, label_axes

if TYPE_CHECKING:
    from mitsim.study.characterise import Characterisation

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
    (gain,) = (row.found for row in done.rows if row.name == "system_gain")
    full = float(signal[int(session.ladder.variance.argmax())])
    line = np.array([0.0, 0.7 * full])
    label = f"fit to 70 % of saturation: K = {gain:.5g} DN/e-"
    axes.plot(line, session.dark.variance + gain * line, color=VERMILION, lw=2, ls="--", label=label)
    axes.axvline(full, color=ORANGE, lw=1.5, ls=":", label="largest variance: saturation")
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
    light = "photons on a pixel" if done.sensor.states_efficiency else "photoelectrons of a pixel"
    label_axes(axes, light, "deviation from a line [%]")
    axes.legend(fontsize=FONT - 1, frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1))
    return figure


def _dark_current(done: Characterisation) -> Figure:
    """Dark signal over exposure time."""
    figure, axes = figure_of(0.42 * WIDTH)
    gain = next(row.found for row in done.rows if row.name == "system_gain")
    for session, style, label in (
        (done.expected, {"color": GREY, "lw": 1.5}, "closed form"),
        (done.session, {"color": BLUE, "lw": 0, "marker": "o", "ms": 5}, "pairs of frames"),
    ):
        dark = (session.dark_series.mean - done.sensor.superpixel_black_level_dn) / gain
        axes.plot(session.dark_times, dark, label=label, **style)
    label_axes(axes, "exposure time [s]", "dark signal less black level [e$^-$]")
    axes.legend(fontsize=FONT - 1, frameon=False)
    return figure


def _deviations(done: Characterisation) -> Figure:
    """By how many standard errors each figure is off."""
    figure, axes = figure_of(0.6 + 0.26 * len(done.rows))
    place = np.arange(len(done.rows))[::-1]
    off = np.clip([row.deviations for row in done.rows], -2 * MOST_OFF, 2 * MOST_OFF)
    axes.axvspan(-MOST_OFF, MOST_OFF, color="#eef2f7", zorder=0)
    axes.axvline(0, color=BLACK, lw=1)
    axes.plot(off, place, "o", color=BLUE, ms=7)
    axes.set_yticks(place, [row.name for row in done.rows], fontsize=FONT - 1)
    axes.set_xlim(-1.2 * max(MOST_OFF, float(np.abs(off).max())), 1.2 * max(MOST_OFF, float(np.abs(off).max())))
    label_axes(axes, "found less set [predicted standard errors]; shaded: within 5", "", grid="x")
    return figure
