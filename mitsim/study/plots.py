"""Arrays in, matplotlib Figures out: one message a figure, units on every axis.

Colours are safe for the colour-blind. The caller saves the figure; no pyplot state is touched.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from mitsim.study.solver_cost import SolverRow

# Okabe and Ito's palette: distinct in all common forms of colour blindness, and in grey.
BLUE, ORANGE, GREEN, VERMILION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
SKY, PURPLE, BLACK = "#56B4E9", "#CC79A7", "#1b1f24"
PALETTE = (BLACK, ORANGE, SKY, BLUE, VERMILION, GREEN, PURPLE)
_STYLES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)))
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
_GRID = "#e5e7eb"
_FONT = 11.0  # points
_BEST = "best for its time"
Point = tuple[float, float]
"""Wall seconds, relative error."""


def frame(values: ArrayLike, unit: str = "DN", width: float = 3.6) -> Figure:
    """A sensor frame (m, m) with its colour bar in `unit`; width in inches. Pixel (0, 0) is top left."""
    image = np.asarray(values, dtype=np.float64)
    # "compressed" makes room around an image of fixed aspect; "constrained" lets the row label run off the figure.
    figure, axes = _figure(width, 0.75 * width, layout="compressed")
    drawn = axes.imshow(image, cmap="viridis", interpolation="none")
    bar = figure.colorbar(drawn, ax=axes)
    bar.set_label(f"signal [{unit}]", fontsize=_FONT - 1)
    bar.ax.tick_params(labelsize=_FONT - 2)
    axes.set_xlabel("sensor column [pixel]", fontsize=_FONT - 1)
    axes.set_ylabel("sensor row [pixel]", fontsize=_FONT - 1)
    axes.tick_params(labelsize=_FONT - 2)
    return figure


def singular_values(spectra: Mapping[str, ArrayLike], width: float = 8.6) -> Figure:
    """Singular values of each family's system, {family: values in any order}, log scale over rank in percent.

    Each curve is divided by its own largest value: what remains is the conditioning.
    """
    figure, axes = _figure(width, 0.42 * width)
    for index, (name, values) in enumerate(spectra.items()):
        ordered = np.sort(np.asarray(values, dtype=np.float64).ravel())[::-1]
        share = 100.0 * np.arange(1, ordered.size + 1) / ordered.size
        axes.semilogy(
            share,
            ordered / ordered[0],
            linestyle=_STYLES[index % len(_STYLES)],
            color=PALETTE[index % len(PALETTE)],
            linewidth=2.0,
            label=name,
        )
    axes.set_xlabel("singular value's rank [% of all]", fontsize=_FONT)
    axes.set_ylabel("relative to the largest [1]", fontsize=_FONT)
    axes.set_xlim(0, 100)
    axes.grid(True, which="major", color="#e5e7eb")
    axes.legend(fontsize=_FONT - 1, frameon=False, loc="lower left")
    return figure


def quality_bars(
    names: Sequence[str], idealised_db: Sequence[float], rendered_db: Sequence[float], width: float = 8.6
) -> Figure:
    """PSNR in dB of each family, a pair of bars each: the paper's idealised model and the rendered light."""
    figure, axes = _figure(width, 0.36 * width)
    place = np.arange(len(names), dtype=np.float64)
    for values, shift, colour, hatch, label in (
        (idealised_db, -0.2, "#c7d2de", "", "idealised model, ideal factors"),
        (rendered_db, 0.2, BLUE, "", "rendered light, calibrated factors"),
    ):
        bars = axes.bar(place + shift, values, 0.38, color=colour, hatch=hatch, label=label)
        axes.bar_label(bars, fmt="%.1f", fontsize=_FONT - 1, padding=2)
    axes.set_xticks(place, names, fontsize=_FONT)
    axes.set_ylabel("PSNR [dB]", fontsize=_FONT)
    axes.margins(y=0.14)
    axes.grid(True, axis="y", color="#e5e7eb")
    axes.set_axisbelow(True)
    axes.legend(fontsize=_FONT - 1, frameon=False, loc="upper left", ncols=2, bbox_to_anchor=(0, 1.16))
    return figure


def error_bars(errors: Mapping[str, float], limit: float | None = None, width: float = 8.6) -> Figure:
    """Relative errors {name: value > 0} on a logarithmic axis, largest on top; `limit`: accuracy asked.

    The values stand in a column beside the axes, where no line can cross them.
    """
    return _error_dots(sorted(errors.items(), key=lambda item: item[1]), limit, width)


def effect_costs(rows: Sequence[tuple[str, float, float]], limit: float | None = None, width: float = 8.6) -> Figure:
    """What each effect buys and costs: rows (name, error when it is left out, seconds it takes), largest error on top.

    An error of 0 has no dot, and its row stands at the bottom. Error and seconds are columns beside the axes.
    """
    ordered = sorted(rows, key=lambda row: row[1])
    figure = _error_dots([(name, error) for name, error, _ in ordered], limit, width)
    axes = figure.axes[0]
    for place, (_, _, seconds) in enumerate(ordered):
        _beside(axes, place, 76, f"{seconds:.2g} s")
    for points, heading in ((8, "error"), (76, "takes")):
        _beside(axes, len(ordered) - 0.2, points, heading, color="#6b7280")
    axes.set_xlabel("relative error of the frames if left out [1]", fontsize=_FONT)
    return figure


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """Points that no other beats in both seconds and error, fastest first."""
    front: list[Point] = []
    for seconds, error in sorted(points):
        if not front or error < front[-1][1]:
            front.append((seconds, error))
    return front


def pareto(
    series: Mapping[str, Sequence[Point]],
    front: Sequence[Point] | None = None,
    noise: float | None = None,
    width: float = 8.6,
    apart: Collection[str] = (),
) -> Figure:
    """Error against wall seconds of several ways to the same result, log-log, {name: [(seconds, error), ...]}.

    ``front`` are the points that nothing beats (found among all when not given), joined by a staircase: the best error
    to be had in a given time. ``noise``: relative error that the sensor's noise makes anyway, a horizontal line.
    ``apart`` names series whose points are different things, not steps of one, and are not joined.
    """
    figure, axes = _figure(width, 0.55 * width)
    for index, (name, points) in enumerate(series.items()):
        seconds, error = zip(*sorted(points), strict=True)
        colour, marker = PALETTE[index % len(PALETTE)], _MARKERS[index % len(_MARKERS)]
        line = "" if name in apart else "-"
        axes.plot(seconds, error, marker, ls=line, color=colour, lw=1.2, ms=7, label=name, zorder=3)
    _draw_front(axes, pareto_front([p for points in series.values() for p in points]) if front is None else front)
    if noise is not None:
        axes.axhline(noise, color="#6b7280", lw=1.8, ls="--", label=f"sensor noise, {noise:.1e}")
    _log_log(axes)
    axes.set_xlabel("wall time for all frames [s]", fontsize=_FONT)
    axes.set_ylabel("relative error of the frames [1]", fontsize=_FONT)
    axes.legend(fontsize=_FONT - 1, frameon=False, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    return figure


def solver_costs(rows: Sequence[SolverRow], width: float = 8.6) -> Figure:
    """Error of the image against seconds of the solver, a panel for each lambda; points that nothing beats ringed."""
    lambdas = sorted({row.lambda_rel for row in rows}, reverse=True)
    figure, _ = _figure(width, 0.55 * width)
    figure.clear()
    panels: Any = figure.subplots(1, len(lambdas), sharex=True, sharey=True, squeeze=False)[0]
    colours = (BLUE, ORANGE, VERMILION, GREEN)
    precisions = list(dict.fromkeys(row.precision for row in rows))
    forms = list(dict.fromkeys((row.method, row.layout) for row in rows))
    for axes, lam in zip(panels, lambdas, strict=True):
        here = [row for row in rows if row.lambda_rel == lam]
        for row in here:
            colour = colours[precisions.index(row.precision)]
            marker = _MARKERS[forms.index((row.method, row.layout))]
            axes.plot([row.seconds], [row.error], marker, color=colour, ms=8, mec="white", mew=0.6, zorder=3)
        _draw_front(axes, pareto_front([(row.seconds, row.error) for row in here]))
        _log_log(axes)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=_FONT - 1)
        axes.set_title(rf"relative $\lambda$ {lam:.0e}", fontsize=_FONT)
        axes.set_xlabel("wall time [s]", fontsize=_FONT)
    panels[0].set_ylabel("relative error of the image [1]", fontsize=_FONT)
    grey = "#9ca3af"
    entries = [(Line2D([], [], ls="", marker="o", color=colours[i], ms=8), name) for i, name in enumerate(precisions)]
    entries.append((panels[0].lines[-1], _BEST))
    marks = [
        (Line2D([], [], ls="", marker=_MARKERS[i], color=grey, ms=8), f"{method}, {layout}")
        for i, (method, layout) in enumerate(forms)
    ]
    # A legend is filled column by column: one row for the colours, one for the markers.
    empty = (Line2D([], [], ls=""), "")
    both = [entry for pair in zip_longest(entries, marks, fillvalue=empty) for entry in pair]
    figure.legend(
        *zip(*both, strict=True), fontsize=_FONT - 1, frameon=False, loc="outside lower center", ncols=len(both) // 2
    )
    return figure


def error_against_time(series: Mapping[str, Sequence[tuple[float, float]]], width: float = 8.6) -> Figure:
    """Relative error over wall seconds for all frames, log-log; {estimator: [(seconds, error), ...]}."""
    figure, axes = _figure(width, 0.55 * width)
    for index, (name, points) in enumerate(series.items()):
        seconds, error = zip(*sorted(points), strict=True)
        axes.loglog(seconds, error, "o-", color=(BLUE, VERMILION)[index % 2], linewidth=2.0, label=name)
    axes.set_xlabel("wall time for all frames [s]", fontsize=_FONT)
    axes.set_ylabel("relative error of the frames [1]", fontsize=_FONT)
    axes.grid(True, which="major", color="#e5e7eb")
    axes.legend(fontsize=_FONT, frameon=False)
    return figure


def seconds_by_stage(seconds: Mapping[str, float], width: float = 8.6) -> Figure:
    """Wall time {stage: seconds} as horizontal bars in the order given."""
    figure, axes = _figure(width, 0.7 + 0.34 * len(seconds))
    place = np.arange(len(seconds))[::-1]
    bars = axes.barh(place, list(seconds.values()), 0.62, color=BLUE)
    axes.bar_label(bars, fmt="%.2g s", fontsize=_FONT - 1, padding=4)
    axes.set_yticks(place, list(seconds), fontsize=_FONT)
    axes.set_xlabel("wall time [s]", fontsize=_FONT)
    axes.margins(x=0.12)
    axes.grid(True, axis="x", color="#e5e7eb")
    axes.set_axisbelow(True)
    return figure


def _error_dots(ordered: Sequence[tuple[str, float]], limit: float | None, width: float) -> Figure:
    """Dots for values >= 0 in the order given, the last on top, each with its value beside the axes."""
    figure, axes = _figure(width, 0.7 + 0.36 * len(ordered))
    values = np.array([value for _, value in ordered], dtype=np.float64)
    reference = np.append(values[values > 0], [] if limit is None else limit)
    low, high = (reference.min(), reference.max()) if reference.size else (1e-3, 1e-3)
    left = 10.0 ** np.floor(np.log10(low) - 0.3)
    seen = np.flatnonzero(values > 0)
    axes.hlines(seen, left, values[seen], color="#d1d5db", lw=2)
    axes.plot(values[seen], seen, "o", color=BLUE, ms=8, zorder=3)
    for row, value in enumerate(values):
        _beside(axes, row, 8, f"{value:.1e}" if value > 0 else "0")
    if limit is not None:
        axes.axvline(limit, color=VERMILION, lw=1.5, ls="--")
        axes.annotate(
            f"accuracy asked for: {limit:g}",
            (limit, 1.0),
            (4, 3),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            color=VERMILION,
            fontsize=_FONT - 1,
        )
    axes.set_xscale("log")
    axes.set_xlim(left, 3.0 * high)
    axes.set_yticks(range(len(values)), [name for name, _ in ordered], fontsize=_FONT)
    axes.set_ylim(-0.6, len(values) - 0.4)
    axes.set_xlabel("relative error [1]", fontsize=_FONT)
    axes.grid(True, axis="x", which="major", color=_GRID)
    axes.set_axisbelow(True)
    return figure


def _beside(axes: Axes, row: float, points: float, text: str, **style: Any) -> None:
    """Text at a row, some points to the right of the axes."""
    where: Any = axes.get_yaxis_transform()
    axes.annotate(
        text, (1.0, row), (points, 0), xycoords=where, textcoords="offset points", va="center", fontsize=_FONT, **style
    )


def _draw_front(axes: Axes, front: Sequence[Point]) -> None:
    """Rings around the points of a Pareto front and the staircase that joins them."""
    seconds, error = zip(*sorted(front), strict=True)
    style: dict[str, Any] = {"color": "#6b7280", "lw": 1.0, "ls": ":", "drawstyle": "steps-post", "zorder": 2}
    axes.plot(seconds, error, "o", ms=13, mfc="none", mec="#6b7280", mew=1.3, label=_BEST, **style)


def _log_log(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    low, high = axes.dataLim.intervalx
    if high < 30 * low:
        # Ticks at powers of ten alone would leave a short axis with one or none.
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(True, which="major", color=_GRID)
    axes.set_axisbelow(True)


def _figure(
    width: float, height: float, layout: Literal["constrained", "compressed"] = "constrained"
) -> tuple[Figure, Axes]:
    """An empty figure, width x height in inches, with its own Agg canvas and one open axes."""
    figure = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(figure)
    axes: Any = figure.add_subplot()
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.tick_params(labelsize=_FONT - 1)
    return figure, axes


def quality_by_factors(rows: Sequence[tuple[str, str, float]], message: str, width: float = 8.6) -> Figure:
    """PSNR [dB] of each system by the factors that its solver used, rows (system, factors, PSNR), first on top."""
    systems = list(dict.fromkeys(system for system, _, _ in rows))
    factors = list(dict.fromkeys(name for _, name, _ in rows))
    figure, axes = _figure(width, 1.3 + 0.46 * len(systems))
    for place, system in enumerate(reversed(systems)):
        here = [value for one, _, value in rows if one == system]
        axes.plot([min(here), max(here)], [place, place], color="#d1d5db", lw=2, zorder=1)
    for index, name in enumerate(factors):
        values = [(value, len(systems) - 1 - systems.index(one)) for one, kind, value in rows if kind == name]
        style = {"color": (VERMILION, BLUE, GREEN)[index % 3], "marker": _MARKERS[index % len(_MARKERS)]}
        axes.plot(*zip(*values, strict=True), ls="", ms=8, label=name, zorder=3, **style)
    axes.set_yticks(range(len(systems)), reversed(systems), fontsize=_FONT - 2)
    axes.set_xlabel("PSNR of the image [dB]", fontsize=_FONT)
    axes.grid(True, axis="x", color=_GRID)
    axes.set_axisbelow(True)
    figure.suptitle(message, fontsize=_FONT)
    figure.legend(fontsize=_FONT - 1, frameon=False, loc="outside lower center", ncols=len(factors))
    return figure


def shadow_profiles(
    position_mm: ArrayLike, profiles: Mapping[str, ArrayLike], reach_mm: float, message: str, width: float = 8.6
) -> Figure:
    """Shadows {light: relative irradiance of each sensor pixel of one row} within ``reach_mm`` of the middle."""
    figure, axes = _figure(width, 0.4 * width)
    position = np.asarray(position_mm, dtype=np.float64)
    inside = np.abs(position) <= reach_mm
    for index, (name, values) in enumerate(profiles.items()):
        shown = np.asarray(values, dtype=np.float64)[inside]
        style = {"color": PALETTE[index % len(PALETTE)], "ls": _STYLES[index % len(_STYLES)]}
        axes.plot(position[inside], shown, lw=1.8, label=name, **style)
    axes.set_xlabel("position on the sensor [mm]", fontsize=_FONT)
    axes.set_ylabel("irradiance, open sensor = 1 [1]", fontsize=_FONT)
    axes.grid(True, color=_GRID)
    axes.set_axisbelow(True)
    axes.set_title(message, fontsize=_FONT)
    axes.legend(fontsize=_FONT - 1, frameon=False, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    return figure
