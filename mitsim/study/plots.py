"""Arrays in, matplotlib Figures out: one message a figure, units on every axis.

Colours are safe for the colour-blind. The caller saves the figure; no pyplot state is touched.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

# Okabe and Ito's palette: distinct in all common forms of colour blindness, and in grey.
BLUE, ORANGE, GREEN, VERMILION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
SKY, PURPLE, BLACK = "#56B4E9", "#CC79A7", "#1b1f24"
PALETTE = (BLACK, ORANGE, SKY, BLUE, VERMILION, GREEN, PURPLE)
_STYLES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)))
_FONT = 11.0  # points


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
    ordered = sorted(errors.items(), key=lambda item: item[1])
    figure, axes = _figure(width, 0.7 + 0.36 * len(ordered))
    values = np.array([value for _, value in ordered], dtype=np.float64)
    reference = values if limit is None else np.append(values, limit)
    left = 10.0 ** np.floor(np.log10(reference.min()) - 0.3)
    axes.hlines(range(len(values)), left, values, color="#d1d5db", lw=2)
    axes.plot(values, np.arange(len(values)), "o", color=BLUE, ms=8, zorder=3)
    for row, value in enumerate(values):
        axes.text(1.02, row, f"{value:.1e}", transform=axes.get_yaxis_transform(), va="center", fontsize=_FONT)
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
    axes.set_xlim(left, 3.0 * reference.max())
    axes.set_yticks(range(len(values)), [name for name, _ in ordered], fontsize=_FONT)
    axes.set_ylim(-0.6, len(values) - 0.4)
    axes.set_xlabel("relative error [1]", fontsize=_FONT)
    axes.grid(True, axis="x", which="major", color="#e5e7eb")
    axes.set_axisbelow(True)
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
