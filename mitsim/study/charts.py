"""Means and images of a study in, matplotlib Figures out: curves with standard errors, and grids of images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from mitsim.core.arrays import FloatArray
from mitsim.core.pictures import lightness
from mitsim.study.plots import FONT, WIDTH, figure_of, label_axes, line_style
from mitsim.study.table import Mean

_CELL = 1.5
"""Inches of an image in a grid, at most: six stand on a page."""
_LABEL = 1.1
"""Inches beside a grid for the names of its rows."""

Curve = Mapping[Any, Mean]
"""Means by what varies: numbers, or their text."""


def curves(
    panels: Mapping[str, Mapping[str, Curve]], x: str, y: str = "PSNR [dB]", log: bool = False, ticks: bool = True
) -> Figure:
    """Curves with bars of one standard error, in panels side by side on one scale.

    Parameters
    ----------
    panels
        curves by name, by the panels' titles.
    x, y
        names of the axes, with units.
    log
        whether x is logarithmic.
    ticks
        whether every x that was measured has a tick.
    """
    figure, _ = figure_of(0.46 * WIDTH)
    figure.clear()
    places: Any = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)
    names = list(dict.fromkeys(name for shown in panels.values() for name in shown))
    for axes, (title, shown) in zip(places[0], panels.items(), strict=True):
        for name, curve in shown.items():
            points = sorted((float(number), mean.value, np.nan_to_num(mean.error)) for number, mean in curve.items())
            numbers, means, errors = np.array(points).reshape(-1, 3).T
            style = {"marker": "o", "ms": 5.0, "capsize": 3, "lw": 1.8, **line_style(names.index(name))}
            axes.errorbar(numbers, means, errors, label=name, **style)
        axes.set_title(title, fontsize=FONT)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        axes.tick_params(labelsize=FONT - 1)
        label_axes(axes, x, y if axes is places[0][0] else "")
        if log:
            axes.set_xscale("log")
        if ticks:
            measured = sorted(
                {float(number) for each in panels.values() for curve in each.values() for number in curve}
            )
            axes.xaxis.set_major_locator(FixedLocator(measured))
            axes.xaxis.set_minor_locator(NullLocator())
            axes.xaxis.set_major_formatter("{x:g}")
    handles, labels = places[0][0].get_legend_handles_labels()
    figure.legend(
        handles, labels, fontsize=FONT - 1, frameon=False, loc="outside lower center", ncols=min(len(labels), 4)
    )
    return figure


def image_grid(rows: Mapping[str, Sequence[tuple[FloatArray, str]]], columns: Sequence[str], title: str = "") -> Figure:
    """Images (n, n) [reflectance] with a caption below each, cut to 0..1 for display only.

    Parameters
    ----------
    rows
        images and captions by the rows' names.
    columns
        titles.
    title
        of all.
    """
    size = min(_CELL, (WIDTH - _LABEL) / len(columns))
    figure, _ = figure_of((size + 0.32) * len(rows) + 0.3, size * len(columns) + _LABEL, layout="compressed")
    figure.clear()
    cells: Any = figure.subplots(len(rows), len(columns), squeeze=False)
    for index, (name, images) in enumerate(rows.items()):
        line = cells[index]
        for axes, (image, caption), column in zip(line, images, columns, strict=True):
            axes.imshow(lightness(image), cmap="gray", vmin=0, vmax=1, interpolation="none")
            axes.set_xticks([])
            axes.set_yticks([])
            axes.set_xlabel(caption, fontsize=FONT - 2)
            if index == 0:
                axes.set_title(column, fontsize=FONT - 1)
        line[0].set_ylabel(name, fontsize=FONT - 1)
    if title:
        figure.suptitle(title, fontsize=FONT)
    return figure
