"""Arrays in, matplotlib Figures out: one message a figure, units on every axis.

Colours are safe for the colour-blind. The caller saves the figure; no pyplot state is touched.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from mitsim.core.arrays import FloatArray
from mitsim.report.html import reflectance, scientific, typeset
from mitsim.report.table import Mean

BLUE, ORANGE, GREEN, VERMILION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
SKY, PURPLE, BLACK = "#56B4E9", "#CC79A7", "#1b1f24"
"""Okabe and Ito's palette: distinct in all common forms of colour blindness, and in grey."""
_PALETTE = (BLACK, ORANGE, SKY, BLUE, VERMILION, GREEN, PURPLE)
_STYLES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)))
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
"""Seven of each, so that as many curves can be told apart."""
_GRID, LINK, GREY = "#e5e7eb", "#d1d5db", "#6b7280"
"""Lines behind the data, between them, and beside them: lighter than any curve."""
FONT = 11.0
"""Points: as large as the text of a page of 8.6 inches."""
WIDTH, _FRAME_WIDTH = 8.6, 3.6
"""Inches: a page of text, and three frames side by side with room for their labels."""
_SHORT_AXIS = 30.0
"""Range of a logarithmic axis below which powers of ten alone leave one tick or none."""
_SHOWN_PERCENT = 99.0
"""Of the errors, those that the scale holds: a normal error's are then within 2.6 deviations."""
_TITLE_LETTERS = 100
"""Of a line above a figure of the page's width."""
_BEST = "best for its time"
Point = tuple[float, float]
"""Wall seconds, relative error."""


def frame(values: npt.ArrayLike) -> Figure:
    """A sensor frame ``values`` (m, m') [DN] with its colour bar; pixel (0, 0) is top left."""
    # "compressed" makes room around an image of fixed aspect; "constrained" lets the row label run off the figure.
    figure, axes = figure_of(0.75 * _FRAME_WIDTH, _FRAME_WIDTH, layout="compressed")
    drawn = axes.imshow(np.asarray(values, dtype=np.float64), cmap="viridis", interpolation="none")
    bar = figure.colorbar(drawn, ax=axes)
    bar.set_label("signal [DN]", fontsize=FONT - 1)
    bar.ax.tick_params(labelsize=FONT - 2)
    axes.set_xlabel("sensor column [pixel]", fontsize=FONT - 1)
    axes.set_ylabel("sensor row [pixel]", fontsize=FONT - 1)
    axes.tick_params(labelsize=FONT - 2)
    return figure


def stated_and_actual(uncertainty: FloatArray, error: FloatArray) -> Figure:
    """An image's standard ``uncertainty`` beside its actual ``error``, both (n, n') [reflectance], on one scale."""
    figure, _ = figure_of(0.46 * WIDTH, layout="compressed")
    figure.clear()
    panels: Any = figure.subplots(1, 2, sharex=True, sharey=True)
    largest = max(float(uncertainty.max()), float(np.percentile(error, _SHOWN_PERCENT)))
    titled = {"stated: standard uncertainty": uncertainty, "actual: |image \N{MINUS SIGN} truth|": error}
    for axes, (title, values) in zip(panels, titled.items(), strict=True):
        drawn = axes.imshow(values, vmin=0, vmax=largest, cmap="viridis", interpolation="none")
        axes.set_title(f"{title}\nrms {reflectance(float(np.sqrt(np.mean(np.square(values)))))}", fontsize=FONT)
        axes.set_xlabel("column [projector pixel]", fontsize=FONT - 1)
        axes.tick_params(labelsize=FONT - 2)
    panels[0].set_ylabel("row [projector pixel]", fontsize=FONT - 1)
    bar = figure.colorbar(drawn, ax=panels, extend="max")
    bar.set_label("reflectance, 1 = board", fontsize=FONT - 1)
    bar.ax.tick_params(labelsize=FONT - 2)
    return figure


def deviations(values: npt.ArrayLike, largest: float, title: str) -> Figure:
    """A map of a factor's errors.

    Parameters
    ----------
    values, largest
        (m, n) error of each entry in predicted deviations, and up to how many the scale goes, of either sign.
    title
        what is said above.
    """
    figure, axes = figure_of(0.5 * WIDTH, 0.5 * WIDTH)
    axes.set_title(title, fontsize=FONT)
    drawn = axes.imshow(
        np.asarray(values), vmin=-largest, vmax=largest, cmap="RdBu_r", interpolation="none", aspect="auto"
    )
    axes.set_xlabel("scene line [projector pixel]", fontsize=FONT - 1)
    axes.set_ylabel("sensor line [pixel]", fontsize=FONT - 1)
    bar = figure.colorbar(drawn, ax=axes, extend="both")
    bar.set_label("error [predicted deviations]", fontsize=FONT - 1)
    bar.ax.tick_params(labelsize=FONT - 2)
    return figure


def singular_errors(factors: Mapping[str, FloatArray]) -> Figure:
    """Errors of singular values of each of ``factors``, and their standard errors as lines; rows are of (without noise,
    with noise less its bias, standard error)."""
    figure, axes = figure_of(0.45 * WIDTH)
    for index, (name, rows) in enumerate(factors.items()):
        exact, noisy, error = rows.T
        # Dashes over a line: the two may coincide.
        style = {"color": _PALETTE[index + 1], "ls": _STYLES[index], "lw": 3.0 - 1.2 * index}
        axes.plot(np.arange(len(rows)), error / exact, label=f"{name}: standard error", **style)
        axes.plot(
            np.arange(len(rows)),
            np.abs(noisy - exact) / exact,
            _MARKERS[index],
            ms=4,
            mfc="none",
            color=_PALETTE[index + 1],
            label=f"{name}: found, less bias",
        )
    axes.set_yscale("log")
    label_axes(axes, "number of the singular value", "relative error [1]")
    _legend_below(figure, 4, *axes.get_legend_handles_labels())
    return figure


def singular_values(curves: Mapping[str, npt.ArrayLike]) -> Figure:
    """Singular values of each family's system, {family: values in any order}, log scale over rank in percent.

    Each of the ``curves`` is divided by its own largest value: what remains is the conditioning.
    """
    figure, axes = figure_of(0.42 * WIDTH)
    for index, (name, values) in enumerate(curves.items()):
        ordered = np.sort(np.asarray(values, dtype=np.float64).ravel())[::-1]
        share = 100.0 * np.arange(1, ordered.size + 1) / ordered.size
        axes.semilogy(share, ordered / ordered[0], lw=2.0, label=name, **line_style(index))
    axes.set_xlim(0, 100)
    label_axes(axes, "singular value's rank [% of all]", "singular value, relative to the largest [1]")
    axes.legend(fontsize=FONT - 1, frameon=False, loc="lower left")
    return figure


def quality_bars(quality: Mapping[str, tuple[Mean, Mean]], title: str = "") -> Figure:
    """PSNR [dB] by family, a pair of bars each, with one standard error where there is one.

    Parameters
    ----------
    quality
        of the idealised model, and of the rendered light.
    title
        of both.
    """
    figure, axes = figure_of(0.36 * WIDTH)
    place = np.arange(len(quality), dtype=np.float64)
    looks = (-0.2, "#c7d2de", "idealised model, ideal factors"), (0.2, BLUE, "rendered light, calibrated factors")
    for means, (shift, colour, label) in zip(zip(*quality.values(), strict=True), looks, strict=True):
        values, errors = (np.array([getattr(mean, part) for mean in means]) for part in ("value", "error"))
        known = None if np.isnan(errors).all() else errors
        bars = axes.bar(place + shift, values, 0.38, color=colour, label=label, yerr=known, capsize=3)
        axes.bar_label(bars, fmt="%.1f", fontsize=FONT - 1, padding=2)
    if title:
        figure.suptitle(title, fontsize=FONT)
    axes.set_xticks(place, list(quality), fontsize=FONT)
    axes.margins(y=0.14)
    label_axes(axes, "", "PSNR [dB]", grid="y")
    axes.legend(fontsize=FONT - 1, frameon=False, loc="upper left", ncols=2, bbox_to_anchor=(0, 1.16))
    return figure


def error_bars(errors: Mapping[str, float], limit: float | None = None) -> Figure:
    """Relative ``errors`` by name, >= 0 (one of 0 has no dot), on a logarithmic axis, largest on top, and the ``limit``
    asked for; numbers stand beside the axes, where no line crosses them."""
    ordered = sorted(errors.items(), key=lambda item: item[1])
    figure, axes = figure_of(0.7 + 0.36 * len(ordered))
    values = np.array([value for _, value in ordered], dtype=np.float64)
    shown = np.append(values[values > 0], [] if limit is None else limit)
    low, high = (shown.min(), shown.max()) if shown.size else (1e-3, 1e-3)
    left = 10.0 ** np.floor(np.log10(low) - 0.3)
    seen = np.flatnonzero(values > 0)
    axes.hlines(seen, left, values[seen], color=LINK, lw=2)
    axes.plot(values[seen], seen, "o", color=BLUE, ms=8, zorder=3)
    for row, (_, value) in enumerate(ordered):
        _beside(axes, row, 8, scientific(value))
    if limit is not None:
        axes.axvline(limit, color=VERMILION, lw=1.5, ls="--")
        where: Any = axes.get_xaxis_transform()
        style = {"color": VERMILION, "fontsize": FONT - 1, "xycoords": where, "textcoords": "offset points"}
        axes.annotate(f"accuracy asked for: {limit:g}", (limit, 1.0), (4, 3), **style)
    axes.set_xscale("log")
    axes.set_xlim(left, 3.0 * high)
    axes.set_yticks(range(len(values)), [name for name, _ in ordered], fontsize=FONT)
    axes.set_ylim(-0.6, len(values) - 0.4)
    label_axes(axes, "relative error [1]", "", grid="x")
    return figure


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """Those of ``points`` that no other beats in both seconds and error, fastest first."""
    front: list[Point] = []
    for seconds, error in sorted(points):
        if not front or error < front[-1][1]:
            front.append((seconds, error))
    return front


class CostRow(Protocol):
    """A row of :func:`solver_costs`: a form of the solution, its seconds and its error."""

    @property
    def method(self) -> str: ...
    @property
    def layout(self) -> str: ...
    @property
    def precision(self) -> str: ...
    @property
    def lambda_rel(self) -> float: ...
    @property
    def seconds(self) -> float: ...
    @property
    def error(self) -> float: ...


def solver_costs(rows: Sequence[CostRow]) -> Figure:
    """Error of the image against seconds of the solver in ``rows``, a panel for each lambda, the best ringed."""
    lambdas = sorted({row.lambda_rel for row in rows}, reverse=True)
    figure, _ = figure_of(0.55 * WIDTH)
    figure.clear()
    panels: Any = figure.subplots(1, len(lambdas), sharex=True, sharey=True, squeeze=False)[0]
    colours = (BLUE, ORANGE, VERMILION, GREEN)
    precisions = list(dict.fromkeys(row.precision for row in rows))
    forms = list(dict.fromkeys((row.method, row.layout) for row in rows))
    for axes, lam in zip(panels, lambdas, strict=True):
        panel = [row for row in rows if row.lambda_rel == lam]
        for row in panel:
            colour = colours[precisions.index(row.precision)]
            marker = _MARKERS[forms.index((row.method, row.layout))]
            axes.plot([row.seconds], [row.error], marker, color=colour, ms=8, mec="white", mew=0.6, zorder=3)
        _draw_front(axes, [(row.seconds, row.error) for row in panel])
        _log_log(axes)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=FONT - 1)
        axes.set_title(typeset(f"relative \N{GREEK SMALL LETTER LAMDA} {lam:.0e}"), fontsize=FONT)
        label_axes(axes, "wall time [s]", "")
    panels[0].set_ylabel("relative error of the image [1]", fontsize=FONT)
    grey: dict[str, Any] = {"ls": "", "ms": 8, "color": "#9ca3af"}
    entries = [(Line2D([], [], ls="", ms=8, color=colours[i], marker="o"), name) for i, name in enumerate(precisions)]
    entries.append((panels[0].lines[-1], _BEST))
    entries += [(Line2D([], [], **grey, marker=_MARKERS[i]), ", ".join(form)) for i, form in enumerate(forms)]
    _legend_below(figure, 4, *zip(*entries, strict=True))
    return figure


def quality_by_factors(rows: Sequence[tuple[str, str, float]], message: str) -> Figure:
    """PSNR [dB] of each system by the factors that its solver used, ``rows`` (system, factors, PSNR), first on top;
    ``message`` above."""
    systems = list(dict.fromkeys(system for system, _, _ in rows))[::-1]
    factors = list(dict.fromkeys(name for _, name, _ in rows))
    figure, axes = figure_of(1.3 + 0.46 * len(systems))
    for place, system in enumerate(systems):
        values = [value for name, _, value in rows if name == system]
        axes.plot([min(values), max(values)], [place, place], color=LINK, lw=2, zorder=1)
    for index, name in enumerate(factors):
        points = [(value, systems.index(system)) for system, kind, value in rows if kind == name]
        style = {"color": (VERMILION, BLUE, GREEN)[index % 3], "marker": _MARKERS[index % len(_MARKERS)]}
        axes.plot(*zip(*points, strict=True), ls="", ms=8, label=name, zorder=3, **style)
    axes.set_yticks(range(len(systems)), systems, fontsize=FONT - 2)
    label_axes(axes, "PSNR of the image [dB]", "", grid="x")
    figure.suptitle(fill(message, _TITLE_LETTERS), fontsize=FONT)
    _legend_below(figure, len(factors), *axes.get_legend_handles_labels())
    return figure


def shadow_profiles(
    position_mm: npt.ArrayLike, profiles: Mapping[str, npt.ArrayLike], reach_mm: float, message: str
) -> Figure:
    """Shadows on one row of the sensor.

    Parameters
    ----------
    position_mm, profiles
        (pixels,) along the row, and relative irradiance there by light.
    reach_mm, message
        how far from the middle of the ``position_mm`` is shown, and what is said above.
    """
    figure, axes = figure_of(0.4 * WIDTH)
    position = np.asarray(position_mm, dtype=np.float64)
    inside = np.abs(position - position.mean()) <= reach_mm
    for index, (name, values) in enumerate(profiles.items()):
        axes.plot(position[inside], np.asarray(values)[inside], lw=1.8, label=name, **line_style(index))
    axes.set_title(message, fontsize=FONT)
    label_axes(axes, "position on the sensor [mm]", "irradiance, open sensor = 1 [1]")
    axes.legend(fontsize=FONT - 1, frameon=False, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    return figure


# ---- parts of figures ------------------------------------------------------------------------------------------------


def _beside(axes: Axes, row: float, points: float, text: str, **style: Any) -> None:
    """Text at a row, some points to the right of the axes."""
    where: Any = axes.get_yaxis_transform()
    axes.annotate(
        text, (1.0, row), (points, 0), xycoords=where, textcoords="offset points", va="center", fontsize=FONT, **style
    )


def _draw_front(axes: Axes, points: Sequence[Point]) -> None:
    """Rings around the points that nothing beats, and the staircase that joins them."""
    seconds, error = zip(*pareto_front(points), strict=True)
    style: dict[str, Any] = {"color": GREY, "lw": 1.0, "ls": ":", "drawstyle": "steps-post", "zorder": 2}
    axes.plot(seconds, error, "o", ms=13, mfc="none", mec=GREY, mew=1.3, label=_BEST, **style)


def _log_log(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    low, high = axes.dataLim.intervalx
    if high < _SHORT_AXIS * low:
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())


def line_style(index: int) -> dict[str, Any]:
    """Colour and dashes of the curve number ``index``."""
    return {"color": _PALETTE[index % len(_PALETTE)], "ls": _STYLES[index % len(_STYLES)]}


def label_axes(axes: Axes, x: str, y: str, grid: Literal["both", "x", "y"] = "both") -> None:
    """Names of the axes, where given, and a grid behind the data.

    Parameters
    ----------
    axes
        that are drawn on.
    x, y
        names, with units; empty for none.
    grid
        lines of which axis.
    """
    if x:
        axes.set_xlabel(x, fontsize=FONT)
    if y:
        axes.set_ylabel(y, fontsize=FONT)
    axes.grid(True, which="major", axis=grid, color=_GRID)
    axes.set_axisbelow(True)


def _legend_below(figure: Figure, columns: int, handles: Any, labels: Any) -> None:
    figure.legend(handles, labels, fontsize=FONT - 1, frameon=False, loc="outside lower center", ncols=columns)


def figure_of(
    height: float, width: float = WIDTH, layout: Literal["constrained", "compressed"] = "constrained"
) -> tuple[Figure, Axes]:
    """An empty figure with its own Agg canvas and one open axes.

    Parameters
    ----------
    height, width
        inches.
    layout
        matplotlib's engine.
    """
    figure = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(figure)
    axes: Any = figure.add_subplot()
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.tick_params(labelsize=FONT - 1)
    return figure, axes
