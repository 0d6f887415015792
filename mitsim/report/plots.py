"""Draw figures with matplotlib: one message each, units on every axis, colours for the colour-blind.

A figure is drawn for the screen. :func:`style_figure` gives it the sizes of a paper, and :func:`save_figure` writes it.
No state of pyplot is touched.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import FuncNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import Drawn
from mitsim.core.errors import ArgumentError
from mitsim.core.files import prepare_output, whole_file
from mitsim.core.images import lightness, linear_light
from mitsim.report.pages import Mean, scientific, typeset

if TYPE_CHECKING:
    from mitsim.core.runs import Capture
    from mitsim.light.plan import Plan
    from mitsim.reconstruct.factors import Factors
    from mitsim.reconstruct.reconstruct import Reconstruction

BLUE, ORANGE, GREEN, VERMILION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
SKY, PURPLE, BLACK = "#56B4E9", "#CC79A7", "#1b1f24"
"""Okabe and Ito's palette, distinct in all common forms of colour blindness and in grey."""
_PALETTE = (BLACK, ORANGE, SKY, BLUE, VERMILION, GREEN, PURPLE)
_STYLES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)))
_GRID, GREY, PALE = "#e5e7eb", "#6b7280", "#c7d2de"
FONT = 11.0
WIDTH = 8.6
COLUMN = 4.65
"""Inches of a figure of curves, of which two fit a page side by side."""
_BARS = 6.2
_PANEL = 2.3
_CELL = 1.5
_LABEL = 1.1
_CAPTION = 0.32
_LETTER = 0.085
"""Mean width of a letter [inches]."""
_HANDLE = 0.6
ROW = 0.27
"""Inches of a row of bars."""
_NAME_LETTERS = 34
_UPRIGHT_LETTERS, TITLE_LETTERS = 26, 46
LOGARITHMIC = 30.0
"""Ratio of largest to least value from which an axis is logarithmic."""
Layout = Literal["constrained", "compressed"]
Curve = Mapping[Any, Mean]
"""Means by what varies: numbers, or their text."""


# -------- Figures


def curves(
    panels: Mapping[str, Mapping[str, Curve]], x: str, y: str = "PSNR [dB]", log: bool = False, title: str = ""
) -> Figure:
    """Draw curves with bars of one standard error, in panels below each other on one scale.

    Panels with fewer than two places along x are left out; a figure of none has no axes. A curve without a name is not
    in the legend. ``log`` forces a logarithmic x axis.
    """
    names = list(dict.fromkeys(name for shown in panels.values() for name in shown))
    found: dict[str, dict[str, FloatArray]] = {}
    for panel, shown in panels.items():
        rows = {}
        for name, curve in shown.items():
            points = sorted((float(number), mean.value, mean.error) for number, mean in curve.items())
            each = np.array(points, dtype=np.float64).reshape(-1, 3)
            rows[name] = each[np.isfinite(each[:, :2]).all(axis=1)]
        if len(np.unique(np.concatenate([each[:, 0] for each in rows.values()] or [np.empty(0)]))) > 1:
            found[panel] = rows
    if not found:
        return Figure()
    figure, places = panels_of(len(found), 1, _PANEL * len(found) + 0.9, COLUMN, sharex=True, sharey=True)
    every = np.concatenate([each for rows in found.values() for each in rows.values()])
    shown_by_name: dict[str, Any] = {}
    for axes, (panel, rows) in zip(places[:, 0], found.items(), strict=True):
        for name, each in ((name, each) for name, each in rows.items() if len(each)):
            style = {"marker": "o", "ms": 5.0, "capsize": 3, "lw": 1.8, **line_style(names.index(name))}
            drawn = axes.errorbar(each[:, 0], each[:, 1], _bar_errors(each[:, 2]), label=name, **style)
            shown_by_name[name] = drawn  # a panel may lack curves that another has
        axes.set_title(panel, fontsize=FONT)
        label_axes(axes, fill(x, TITLE_LETTERS) if axes is places[-1, 0] else "", fill(y, _UPRIGHT_LETTERS))
        if log or spans_decades(every[:, 0]):
            axes.set_xscale("log")
            axes.xaxis.set_minor_formatter("")  # the labels of minor ticks overlap
        if spans_decades(every[:, 1]):
            axes.set_yscale("log")
    if labels := [name for name in names if name and name in shown_by_name]:
        room = figure.get_figwidth() / (_HANDLE + _LETTER * max(map(len, labels)))
        style = {"fontsize": FONT - 1, "frameon": False, "loc": "outside lower center"}
        handles = [shown_by_name[name] for name in labels]
        figure.legend(handles, labels, ncols=max(min(int(room), len(labels)), 1), **style)
    if title:
        figure.suptitle(fill(title, TITLE_LETTERS), fontsize=FONT + 1)
    return figure


def spans_decades(values: Iterable[float]) -> bool:
    """Return True if all ``values`` are positive and span a factor of :data:`LOGARITHMIC`."""
    found = np.array(list(values), dtype=np.float64)
    return bool(found.size and found.min() > 0 and found.max() >= LOGARITHMIC * found.min())


def image_grid(
    rows: Mapping[str, Sequence[tuple[FloatArray, str]]],
    columns: Sequence[str],
    title: str = "",
    scale: tuple[Mapping[str, Any], str] | None = None,
) -> Figure:
    """Draw images with captions in rows; with a ``scale``, arguments of imshow and a label, they share a colour bar."""
    size = min(_CELL, (WIDTH - _LABEL) / len(columns))
    inches = (size + _CAPTION) * len(rows) + 0.3, size * len(columns) + _LABEL
    figure, cells = panels_of(len(rows), len(columns), *inches, layout="compressed")

    def wrap(text: str) -> str:
        return "\n".join(fill(line, int(size / _LETTER)) for line in text.split("\n"))

    for index, (name, images) in enumerate(rows.items()):
        line = cells[index]
        for axes, (image, caption), column in zip(line, images, columns, strict=True):
            style = scale[0] if scale else {"cmap": "gray", "vmin": 0, "vmax": 1}
            drawn = axes.imshow(image if scale else lightness(image), interpolation="none", **style)
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_visible(True)
            axes.set_xlabel(wrap(caption), fontsize=FONT - 2)
            if index == 0:
                axes.set_title(wrap(column), fontsize=FONT - 1)
        fits = len(name) * _LETTER <= size + _CAPTION
        line[0].set_ylabel(name if fits else name.replace(", ", ",\n"), fontsize=FONT - 1)
    if scale:
        bar = figure.colorbar(drawn, ax=cells, extend="both")
        bar.set_label(fill(scale[1], 20), fontsize=FONT - 2)
        bar.set_ticks([tick for tick in bar.get_ticks() if drawn.norm.vmin <= tick <= drawn.norm.vmax])
    if title:
        figure.suptitle(fill(title, int(figure.get_figwidth() / _LETTER)), fontsize=FONT)
    return figure


def grouped_bars(groups: Mapping[str, Mapping[str, Mean]], x: str, title: str = "") -> Figure:
    """Draw horizontal bars with one standard error: a group for each name, a bar for each kind."""
    kinds = list(dict.fromkeys(kind for bars in groups.values() for kind in bars))
    slots = len(kinds) if max(map(len, groups.values())) > 1 else 1
    lines = [len(fill(typeset(name), _NAME_LETTERS).split("\n")) for name in groups]
    rows_height = ROW * len(lines) * (1 + 0.6 * (max(lines) - 1))
    figure, ((axes,),) = panels_of(1, 1, 0.9 + max(0.75 * slots, 1.0) * rows_height, _BARS)
    height, places = 0.8 / slots, np.arange(len(groups))[::-1]
    for index, kind in enumerate(kinds):
        own = [(place, bars[kind]) for place, bars in zip(places, groups.values(), strict=True) if kind in bars]
        shift = (slots / 2 - 0.5 - index) * height if slots > 1 else 0.0
        values, errors = (np.array([getattr(mean, part) for _, mean in own]) for part in ("value", "error"))
        colour = (PALE, BLUE, ORANGE, GREEN, PURPLE)[index % 5] if len(kinds) > 1 else BLUE
        style = {"xerr": _bar_errors(errors), "color": colour, "capsize": 3, "label": kind}
        drawn = axes.barh([place + shift for place, _ in own], values, 0.92 * height, **style)
        axes.bar_label(drawn, [scientific(float(value)) for value in values], fontsize=FONT - 2, padding=3)
    axes.set_yticks(places, [fill(typeset(name), _NAME_LETTERS) for name in groups])
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(-0.6, len(groups) - 0.4)
    if len(kinds) > 1:
        axes.legend(fontsize=FONT - 1, frameon=False, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    if title:
        figure.suptitle(fill(title, TITLE_LETTERS + 10), fontsize=FONT)
    axes.margins(x=0.2)
    label_axes(axes, x, "", grid="x")
    return figure


# -------- Parts of figures


def _bar_errors(errors: FloatArray) -> FloatArray | None:
    return None if np.isnan(errors).all() else errors


def line_style(index: int) -> dict[str, Any]:
    return {"color": _PALETTE[index % len(_PALETTE)], "ls": _STYLES[index % len(_STYLES)]}


def label_axes(axes: Axes, x: str, y: str, grid: Literal["both", "x", "y"] = "both") -> None:
    axes.set_xlabel(x, fontsize=FONT)
    axes.set_ylabel(y, fontsize=FONT)
    axes.grid(True, which="major", axis=grid, color=_GRID)
    axes.set_axisbelow(True)


def panels_of(
    rows: int, columns: int, height: float, width: float = WIDTH, layout: Layout = "constrained", **shared: Any
) -> tuple[Figure, Any]:
    """Return an empty figure [inches] with axes.

    The layout "compressed" leaves space around images of fixed aspect.
    """
    figure = Figure(figsize=(width, height), layout=layout)
    places: Any = figure.subplots(rows, columns, squeeze=False, **shared)
    for axes in places.flat:
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=FONT - 1)
        axes.locator_params("x", nbins=6)  # more labels overlap
    return figure, places


# -------- Styles and files of figures

_MM = 1 / 25.4
_PAPER_FONT, _PAPER_COLUMNS = 8.0, (89 * _MM, 183 * _MM)
"""Letters [pt], and widths of one and two columns [inches], as common journals ask for them."""
_THIN = 0.55
"""Lines and marks of a paper relative to those of a screen: curves of 1 pt, axes of 0.45 pt."""
_SHARP_DPI = {"screen": 150, "paper": 300}
KINDS = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
"""Endings of figures, each with the metadata that are left out, because they differ from run to run."""


def style_figure(figure: Figure, style: str, columns: int = 0) -> None:
    """Give a finished figure the sizes of a ``style``: "screen", as it is drawn, or "paper".

    A figure of a paper has the width of one or two ``columns``, by default the number that its letters need.
    """
    figure.set_dpi(_SHARP_DPI[style])
    if style == "screen":
        return
    ratio, before = _PAPER_FONT / FONT, float(figure.get_figwidth())
    columns = columns or 1 + (ratio * before > 1.02 * _PAPER_COLUMNS[0])
    width = _PAPER_COLUMNS[columns - 1]
    # Images keep their shape. Curves and bars keep the height of their letters.
    stretch = width / before if any(axes.images for axes in figure.axes) else ratio
    figure.set_size_inches(width, stretch * figure.get_figheight())
    for text in figure.findobj(Text):
        text.set_fontsize(min(ratio * text.get_fontsize(), _PAPER_FONT))
    for part in figure.findobj(lambda each: isinstance(each, (Line2D, LineCollection, Patch))):
        part.set_linewidth(_THIN * np.asarray(part.get_linewidth()))
    for line in figure.findobj(Line2D):
        line.set_markersize(_THIN * line.get_markersize())
        line.set_markeredgewidth(_THIN * line.get_markeredgewidth())
    for axes in figure.axes:  # ticks that later sizes of the axes add
        axes.tick_params(labelsize=ratio * (FONT - 1), width=_THIN * 0.8, length=_THIN * 3.5)
    figure.draw_without_rendering()  # places the axes, whose sizes their texts have to fit
    for axes in figure.axes:
        sides = width * axes.get_position().width, figure.get_figheight() * axes.get_position().height
        for text, inches in ((axes.xaxis.label, sides[0]), (axes.title, sides[0]), (axes.yaxis.label, sides[1])):
            most = int(1.1 * inches / (ratio * _LETTER))
            if max(map(len, text.get_text().split("\n"))) > most:
                text.set_text(fill(text.get_text(), max(most, 12)))


def save_figure(figure: Figure, path: Path | str) -> None:
    """Write a figure as PNG, SVG and PDF with fonts embedded, the same bytes for the same figure.

    ``path`` may have one of the endings of :data:`KINDS`, or none.
    """
    place = prepare_output(path, overwrite=True, kind="file")
    stem = place.stem if place.suffix in KINDS else place.name
    for ending, left_out in KINDS.items():
        with (
            rc_context({"svg.hashsalt": "mitsim", "pdf.fonttype": 42}),
            whole_file(place.with_name(stem + ending)) as part,
        ):
            figure.savefig(part, format=ending[1:], dpi=figure.get_dpi(), metadata=left_out)


def _drawn(draw: Callable[..., Axes]) -> Callable[..., Axes]:

    @wraps(draw)
    def call(*arguments: Any, **options: Any) -> Axes:
        asked, axes = Drawn(**options), draw(*arguments)
        if options:
            style_figure(axes.figure, asked.style, 1)
        if asked.output is not None:
            save_figure(axes.figure, asked.output)
        return axes

    return call


# -------- Results on axes: frames, factors, images and plans, for the `plot` methods


@_drawn
def draw_shot(
    shots: Capture, shot: int = 0, quantity: Literal["dn", "electrons", "truth"] = "dn", ax: Axes | None = None
) -> Axes:
    """Draw a frame of a capture in digital numbers or expected electrons, or its truth.

    Raises MitsimError for a shot that does not exist, and for a quantity that a real camera does not know.
    """
    name = shots.manifest.patterns.family or "patterns"
    if quantity == "truth":
        if shots.truth is None:
            raise ArgumentError("quantity", "'truth': is not known of frames of a real camera; draw dn")
        return _draw(ax, shots.truth, f"{name}: truth", "reflectance, 1 = board", pixel="projector ", white=1.0)
    captures = shots.manifest.patterns.captures
    if not 0 <= shot < len(captures):
        raise ArgumentError("shot", f"{shot}: give 0 to {len(captures) - 1}")
    taken = captures[shot]
    channels, _ = shots.read(taken.file)
    channel, unit = ("DN", "digital number [DN]") if quantity == "dn" else ("electrons", "expected electrons [e-]")
    if channel not in channels:
        raise ArgumentError("quantity", "'electrons': are not known of frames of a real camera; draw dn")
    sign = {1: ", its positive half", -1: ", its negative half"}.get(taken.sign, "")
    return _draw(ax, channels[channel], f"{name}, shot {shot}: pattern ({taken.row}, {taken.column}){sign}", unit)


@_drawn
def draw_frame(frame: npt.ArrayLike, title: str, unit: str, ax: Axes | None = None) -> Axes:
    return _draw(ax, frame, title, unit)


@_drawn
def draw_factor(factors: Factors, side: Literal["left", "right"] = "left", ax: Axes | None = None) -> Axes:
    line = "row" if side == "left" else "column"
    title = f"{side.capitalize()} factor, of {line}s"
    axes = _draw(ax, getattr(factors, side), title, r"entry [$\sqrt{\mathrm{e^-/s}}$]")
    axes.set(aspect="auto", xlabel=f"scene {line} [projector pixel]", ylabel=f"sensor {line} [pixel]")
    return axes


@_drawn
def draw_image(
    image: Reconstruction, quantity: Literal["image", "uncertainty", "depth"] = "image", ax: Axes | None = None
) -> Axes:
    """Draw a recovered image, its standard uncertainty, or its depths; MitsimError where they are not known."""
    board = "reflectance, 1 = board"
    if quantity == "image":
        unit, title = "light [electrons/s]" if "psf" in image.inputs else board, f"Image: {image.status.verdict.value}"
        return _draw(ax, image.image, title, unit, pixel="projector ", white=image.white)
    values, title, unit = {
        "uncertainty": (image.uncertainty, "Standard uncertainty of each pixel", board),
        "depth": (None if image.depths is None else image.depths.mm, "Depth of each pixel", "depth [mm]"),
    }[quantity]
    if values is None:
        raise ArgumentError("quantity", f"{quantity!r}: is not known of this image; draw image")
    return _draw(ax, values, title, unit, pixel="projector ")


@_drawn
def draw_plan(plan: Plan, quantity: Literal["error", "seconds"] = "error", ax: Axes | None = None) -> Axes:
    """Draw the error of the frames without each effect, or the predicted seconds of each stage, as bars."""
    if quantity == "error":
        values = {f"{row.name} ({row.state})": row.error_if_off for row in plan.effects if row.error_if_off is not None}
        label, title = "relative error of the frames if it were off [1]", f"Plan at accuracy {plan.accuracy:g}"
    else:
        values = dict(plan.predicted)
        label, title = "predicted time [s]", f"Plan: {plan.predicted_seconds:.2f} s from start to finish"
    names = sorted(values, key=values.__getitem__) if quantity == "error" else [*values][::-1]
    axes = _axes(ax, 1.0 + ROW * len(values))
    bars = axes.barh(names, [values[name] for name in names], color=BLUE)
    axes.bar_label(bars, [scientific(values[name]) for name in names], padding=3, fontsize=FONT - 1)
    if quantity == "error":
        axes.set_xscale("log")
        axes.axvline(plan.accuracy, color=VERMILION, lw=1.5, ls="--")
    axes.margins(x=0.12)
    label_axes(axes, label, "", grid="x")
    axes.set_title(title, fontsize=FONT)
    return axes


def reflectance_norm(white: float) -> FuncNorm:
    """Return the scale from 0 to ``white`` by the sRGB curve, as screens show light."""
    return FuncNorm((lambda part: lightness(part / white), lambda shade: white * linear_light(shade)), 0.0, white)


def _axes(ax: Axes | None, height: float = 0.5 * WIDTH, width: float = 0.7 * WIDTH) -> Axes:
    if ax is not None:
        return ax
    from matplotlib import pyplot

    return pyplot.subplots(figsize=(width, height), layout="constrained")[1]


def _draw(
    ax: Axes | None, values: npt.ArrayLike, title: str, unit: str, pixel: str = "", white: float | None = None
) -> Axes:
    """Draw numbers in equal steps, or reflectances as a screen shows them where ``white`` is given.

    Numbers of the projector's pixels that are no reflectances are in colour.
    """
    shown, axes = np.asarray(values, dtype=np.float64), _axes(ax)
    style: dict[str, Any] = {"cmap": "viridis" if pixel and white is None else "gray", "interpolation": "none"}
    extend, scale = "neither", "linear"
    if white is not None:
        style["norm"], scale = reflectance_norm(white), "shown by the sRGB curve"
        extend = "both" if shown.min() < 0 or shown.max() > white else "neither"
    drawn = axes.imshow(shown, **style)
    axes.set_title(title, fontsize=FONT)
    axes.set_xlabel(f"column [{pixel}pixel]", fontsize=FONT)
    axes.set_ylabel(f"row [{pixel}pixel]", fontsize=FONT)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(integer=True))
    axes.figure.colorbar(drawn, ax=axes, extend=extend).set_label(f"{unit}, {scale}", fontsize=FONT - 1)
    return axes
