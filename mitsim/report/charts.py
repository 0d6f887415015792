"""Means and images of a study in, matplotlib Figures out: curves with standard errors, and grids of images."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill, wrap
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from mitsim.core.arrays import FloatArray
from mitsim.core.pictures import lightness
from mitsim.report.html import typeset
from mitsim.report.plots import BLUE, FONT, GREEN, VERMILION, WIDTH, figure_of, label_axes, line_style
from mitsim.report.table import Mean

_CELL = 1.5
"""Inches of an image in a grid, at most: six stand on a page."""
_LABEL = 1.1
"""Inches beside a grid for the names of its rows."""
_CAPTION = 0.32
"""Inches of a row for the captions below its images."""
_LETTER = 0.085
"""Inches of a letter of such a name, on the average."""

_ROW = 0.27
"""Inches of a row of a waterfall: a line of text, and a third of one between two."""
_COLUMNS = (14.0, 92.0)
"""Points from a waterfall to the numbers beside it: "-23.1 ± 0.2" has 60."""
_UPRIGHT_LETTERS = 36
"""Of a line along a figure of curves."""
_LETTERS = 122
"""Of a line below a figure, small ones."""
_END, _QUIET = "#c7d2de", "#6b7280"
"""Bar of the level that a waterfall begins at, and what stands beside the data."""

Curve = Mapping[Any, Mean]
"""Means by what varies: numbers, or their text."""


def curves(
    panels: Mapping[str, Mapping[str, Curve]],
    x: str,
    y: str = "PSNR [dB]",
    log: bool = False,
    ticks: bool = True,
    title: str = "",
) -> Figure:
    """Curves with bars of one standard error, in panels side by side on one scale.

    Parameters
    ----------
    panels
        curves by name, by the panels' titles; one without points has its colour all the same.
    x, y
        names of the axes, with units.
    log
        whether x is logarithmic.
    ticks
        whether every x that was measured has a tick.
    title
        of all panels.

    Notes
    -----
    A curve alone needs no name: an empty one has no line in the legend.
    """
    figure, _ = figure_of(0.46 * WIDTH)
    figure.clear()
    places: Any = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)
    names = list(dict.fromkeys(name for shown in panels.values() for name in shown))
    for axes, (panel, shown) in zip(places[0], panels.items(), strict=True):
        for name, curve in ((name, curve) for name, curve in shown.items() if curve):
            points = sorted((float(number), mean.value, mean.error) for number, mean in curve.items())
            numbers, means, errors = np.array(points).reshape(-1, 3).T
            style = {"marker": "o", "ms": 5.0, "capsize": 3, "lw": 1.8, **line_style(names.index(name))}
            axes.errorbar(numbers, means, _known(errors), label=name, **style)
        axes.set_title(panel, fontsize=FONT)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        axes.tick_params(labelsize=FONT - 1)
        label_axes(axes, x, fill(y, _UPRIGHT_LETTERS) if axes is places[0][0] else "")
        if log:
            axes.set_xscale("log")
        if ticks:
            measured = sorted(
                {float(number) for each in panels.values() for curve in each.values() for number in curve}
            )
            axes.xaxis.set_major_locator(FixedLocator(measured))
            axes.xaxis.set_minor_locator(NullLocator())
            axes.xaxis.set_major_formatter("{x:g}")
    shown_by_name: dict[str, Any] = {}
    for axes in places[0]:  # a panel may lack curves that another has
        shown_by_name |= dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
    labels = [name for name in names if name and name in shown_by_name]
    if labels:
        handles, columns = [shown_by_name[name] for name in labels], min(len(labels), 4)
        figure.legend(handles, labels, fontsize=FONT - 1, frameon=False, loc="outside lower center", ncols=columns)
    if title:
        figure.suptitle(title, fontsize=FONT + 1)
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
    figure, _ = figure_of((size + _CAPTION) * len(rows) + 0.3, size * len(columns) + _LABEL, layout="compressed")
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
                lines = [fill(line, int(size / _LETTER)) for line in column.split("\n")]
                axes.set_title("\n".join(lines), fontsize=FONT - 1)
        fits = len(name) * _LETTER <= size + _CAPTION
        line[0].set_ylabel(name if fits else name.replace(", ", ",\n"), fontsize=FONT - 1)
    if title:
        figure.suptitle(title, fontsize=FONT)
    return figure


def paired(values: Mapping[str, tuple[Mean, Mean]], labels: tuple[str, str], x: str) -> Figure:
    """Two means of each thing beside each other, the first as a bar, the second as a dot, the largest on top.

    Parameters
    ----------
    values
        both means by name.
    labels
        of the two.
    x
        name of the axis, with its unit.
    """
    ordered = sorted(values.items(), key=lambda item: item[1][0].value)
    figure, axes = figure_of(0.9 + _ROW * len(ordered))
    rows = np.arange(len(ordered))
    first, second = (
        np.array([(pair[index].value, pair[index].error) for _, pair in ordered]).reshape(-1, 2).T for index in (0, 1)
    )
    axes.barh(rows, first[0], 0.66, xerr=_known(first[1]), color=_END, capsize=3, label=labels[0])
    style: dict[str, Any] = {"color": VERMILION, "ms": 5.5, "capsize": 3, "lw": 0, "elinewidth": 1.5}
    axes.errorbar(second[0], rows, xerr=_known(second[1]), fmt="D", label=labels[1], **style)
    axes.set_yticks(rows, [typeset(name) for name, _ in ordered])
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(-0.6, len(ordered) - 0.4)
    # Above the axes, where no bar is, however few there are.
    axes.legend(fontsize=FONT - 1, frameon=False, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    label_axes(axes, x, "", grid="x")
    return figure


def bars(kinds: Mapping[str, Mapping[str, Mean]], x: str) -> Figure:
    """A bar and its error for each value, the largest on top.

    Parameters
    ----------
    kinds
        values by name, by what they are: two kinds at most, each in its colour.
    x
        name of the axis, with its unit.
    """
    values = [(mean, name, kind) for kind, means in kinds.items() for name, mean in means.items()]
    ordered = sorted(values, key=lambda value: value[0].value)
    figure, axes = figure_of(1.2 + _ROW * len(ordered))
    for colour, kind in zip((BLUE, _END), kinds, strict=False):
        own = [(row, mean) for row, (mean, _, of) in enumerate(ordered) if of == kind]
        if own:
            rows, means = zip(*own, strict=True)
            errors = [mean.error for mean in means]
            axes.barh(rows, [mean.value for mean in means], 0.66, xerr=errors, color=colour, capsize=3, label=kind)
    axes.set_yticks(range(len(ordered)), [typeset(name) for _, name, _ in ordered])
    axes.tick_params(axis="y", length=0)
    most = max(mean.value + mean.error for mean, _, _ in ordered)
    least = min([0.0, *(1.1 * (mean.value - mean.error) for mean, _, _ in ordered if mean.value < 0)])
    axes.set_xlim(least, 1.1 * most or 1.0)
    axes.set_ylim(-0.6, len(ordered) - 0.4)
    if len({kind for _, _, kind in ordered}) > 1:
        axes.legend(fontsize=FONT - 1, frameon=False, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    label_axes(axes, x, "", grid="x")
    return figure


@dataclass(frozen=True)
class Step:
    """Change [dB] that an effect called ``name`` brings: as a step in order, alone, and to the whole without it; None
    where one was not measured."""

    name: str
    in_order: Mean
    alone: Mean | None = None
    left_out: Mean | None = None

    @property
    def largest(self) -> float:
        """Of the three, by size [dB]."""
        return max(abs(mean.value) for mean in (self.in_order, self.alone, self.left_out) if mean)


@dataclass(frozen=True)
class Fall:
    """A waterfall: PSNR of a ``first`` and of a ``last`` level, and the ``steps`` between them."""

    first: Mean
    steps: tuple[Step, ...]
    last: Mean

    def step(self, name: str) -> Step:
        """That of the effect ``name``."""
        return next(step for step in self.steps if step.name == name)

    @property
    def levels(self) -> FloatArray:
        """(steps + 1,) PSNR [dB] before the first step and after each."""
        return self.first.value + np.cumsum([0.0, *(step.in_order.value for step in self.steps)])


def waterfall(panels: Mapping[str, Fall], seen: float) -> Figure:
    """Levels of PSNR from a first to a last one, a bar for each step, in panels below each other on one scale.

    Parameters
    ----------
    panels
        by their titles; the steps' names are the same in all.
    seen
        change [dB] from which a step has a row, if any panel has it; others are named below, and are one bar.
    """
    names = [step.name for step in next(iter(panels.values())).steps]
    change = {name: max(fall.step(name).largest for fall in panels.values()) for name in names}
    large = {name for name in names if change[name] >= seen}
    figure, _ = figure_of(len(panels) * (_ROW * (len(large) + 3) + 0.6) + 0.9)
    figure.clear()
    places: Any = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    levels = np.concatenate([fall.levels for fall in panels.values()])
    low, high = levels.min(), levels.max()
    room = max(high - low, 1.0)
    places[0].set_xlim(low - 0.12 * room, high + 0.22 * room)
    for axes, (title, fall) in zip(places, panels.items(), strict=True):
        axes.set_title(title, fontsize=FONT, loc="left", fontweight="bold")
        _draw_fall(axes, fall, large)
        label_axes(axes, "PSNR [dB]" if axes is places[-1] else "", "", grid="x")
    small = ", ".join(name for name in names if 0 < change[name] < seen)
    none = ", ".join(name for name in names if change[name] == 0)
    said = ["Changes of PSNR [dB] by each effect: bars in order, beside them alone and on the whole without it."]
    said += [f"Less than {seen:g} dB each, in the bar called others: {small}."] if small else []
    said += [f"Nothing at all, as the scene does not call for them: {none}."] if none else []
    lines = [line for sentence in said for line in wrap(sentence, _LETTERS)]
    figure.supxlabel("\n".join(lines), fontsize=FONT - 2, color=_QUIET, x=0.01, ha="left")
    return figure


def _draw_fall(axes: Any, fall: Fall, large: Collection[str]) -> None:
    """Bars of the steps that are ``large``, and one of all others."""
    others = sum(step.in_order.value for step in fall.steps if step.name not in large)
    steps = [step for step in fall.steps if step.name in large]
    steps += [Step("others", Mean(others, np.nan, 1))] if others else []
    last, level, text = len(steps) + 1, fall.first.value, {"fontsize": FONT - 2, "va": "center"}
    for row, step in enumerate(steps, start=1):
        change = step.in_order.value
        axes.plot([level, level], [row - 1, row], color=_QUIET, lw=0.8, zorder=1)
        axes.barh(row, change, 0.66, left=level, color=VERMILION if change < 0 else GREEN, zorder=3)
        level += change
        place = max(level, level - change), row
        axes.annotate(_signed(step.in_order), place, (5, 0), textcoords="offset points", **text)
        for points, mean in zip(_COLUMNS, (step.alone, step.left_out), strict=True):
            if mean:
                _beside(axes, row, points, _signed(mean))
    axes.plot([level, level], [last - 1, last], color=_QUIET, lw=0.8, zorder=1)
    for row, end, colour in ((0, fall.first, _END), (last, fall.last, BLUE)):
        left = axes.get_xlim()[0]
        axes.barh(row, end.value - left, 0.66, left=left, color=colour, zorder=3)
        axes.annotate(f"{end} dB", (end.value, row), (5, 0), textcoords="offset points", fontweight="bold", **text)
    for points, heading in zip(_COLUMNS, ("alone", "left out"), strict=True):
        if any(getattr(step, heading.replace(" ", "_")) for step in steps):
            _beside(axes, 0, points, heading)
    axes.set_yticks(range(last + 1), ["idealised", *(step.name for step in steps), "rendered"])
    axes.set_ylim(last + 0.5, -0.5)
    axes.tick_params(axis="y", length=0, labelsize=FONT - 1)
    axes.tick_params(axis="x", labelsize=FONT - 1)
    axes.spines[["top", "right", "left"]].set_visible(False)


def _beside(axes: Any, row: float, points: float, text: str) -> None:
    """Grey text at a row, some points to the right of the axes."""
    place: dict[str, Any] = {"xycoords": axes.get_yaxis_transform(), "textcoords": "offset points"}
    axes.annotate(text, (1.0, row), (points, 0), fontsize=FONT - 2, va="center", color=_QUIET, **place)


def _signed(mean: Mean) -> str:
    """A change with its sign, and with its standard error."""
    text = f"{mean.value:+.1f}" if round(mean.value, 1) else "0.0"
    text = text.replace("-", "\N{MINUS SIGN}")
    return text if np.isnan(mean.error) else f"{text} \N{PLUS-MINUS SIGN} {mean.error:.1f}"


def _known(errors: FloatArray) -> FloatArray | None:
    """Errors of bars; None where none is known, so that no bar of zero is drawn."""
    return None if np.isnan(errors).all() else errors
