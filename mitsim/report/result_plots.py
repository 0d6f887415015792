"""What `.plot()` of a result draws on axes of matplotlib: frames, factors, images, plans."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import FuncNorm
from matplotlib.ticker import MaxNLocator

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError
from mitsim.core.images import lightness, linear_light
from mitsim.reconstruct.reconstruct import POINT_SPREAD
from mitsim.report.plots import BLUE, FONT, ROW, WIDTH, error_bars, label_axes

if TYPE_CHECKING:
    from mitsim.acquire.reference import Rendered
    from mitsim.acquire.sense import Sensed
    from mitsim.core.runs import Capture
    from mitsim.light.plan import Plan
    from mitsim.reconstruct.factors import Factors
    from mitsim.reconstruct.reconstruct import Reconstruction


def draw_shot(
    shots: Capture, shot: int = 0, quantity: Literal["dn", "electrons", "truth"] = "dn", ax: Axes | None = None
) -> Axes:
    """A frame of a capture, or its truth; returns the axes.

    Parameters
    ----------
    shots, shot, quantity
        which frame, from 0, in which quantity: digital numbers, expected electrons, or the truth's reflectance.
    ax
        to draw on; None: those of a new figure.

    Raises
    ------
    MitsimError
        for a shot that there is not, and what is not known of a real camera.
    """
    name = shots.manifest.patterns.family or "patterns"
    if quantity == "truth":
        if shots.truth is None:
            raise ArgumentError("quantity", "'truth': is not known of frames of a real camera; draw dn")
        return _draw_reflectance(ax, shots.truth, f"{name}: truth", "reflectance, 1 = board", 1.0)
    captures = shots.manifest.patterns.captures
    if not 0 <= shot < len(captures):
        raise ArgumentError("shot", f"{shot}: give 0 to {len(captures) - 1}")
    channels, _ = shots.read(captures[shot].file)
    channel, unit = ("DN", "digital number [DN]") if quantity == "dn" else ("electrons", "expected electrons [e-]")
    if channel not in channels:
        raise ArgumentError("quantity", "'electrons': are not known of frames of a real camera; draw dn")
    where = f"pattern ({captures[shot].row}, {captures[shot].column})"
    sign = {1: ", its positive half", -1: ", its negative half"}.get(captures[shot].sign, "")
    return _draw_linear(ax, channels[channel], f"{name}, shot {shot}: {where}{sign}", unit)


def draw_sensed(sensed: Sensed, ax: Axes | None = None) -> Axes:
    """Digital numbers of a ``sensed`` frame on the axes ``ax``, or those of a new figure; returns them."""
    title = f"{sensed.sensor.name}, exposure {sensed.exposure_s:.3g} s"
    return _draw_linear(ax, sensed.digital, title, "digital number [DN]")


def draw_rendered(rendered: Rendered, ax: Axes | None = None) -> Axes:
    """Irradiance of a ``rendered`` frame, the mean of its channels, on the axes ``ax``, or those of a new figure;
    returns them."""
    channels = rendered.mean.shape[2]
    title = f"{rendered.facts['estimator']} estimator" + (f", mean of {channels} channels" if channels > 1 else "")
    return _draw_linear(ax, rendered.mean.mean(axis=2), title, "irradiance [W/m$^2$]")


def draw_factor(factors: Factors, side: Literal["left", "right"] = "left", ax: Axes | None = None) -> Axes:
    """One of a camera's factors; returns the axes.

    Parameters
    ----------
    factors, side
        which of them: ``left``, of rows, or ``right``, of columns.
    ax
        to draw on; None: those of a new figure.
    """
    line = "row" if side == "left" else "column"
    title = f"{side.capitalize()} factor, of {line}s"
    axes = _draw_linear(ax, getattr(factors, side), title, r"entry [$\sqrt{\mathrm{e^-/s}}$]", aspect="auto")
    label_axes(axes, f"scene {line} [projector pixel]", f"sensor {line} [pixel]")
    axes.grid(False)
    return axes


def draw_image(
    image: Reconstruction, quantity: Literal["image", "uncertainty", "depth"] = "image", ax: Axes | None = None
) -> Axes:
    """A recovered image, its standard uncertainty, or its depths; returns the axes.

    Parameters
    ----------
    image, quantity
        what is drawn of what.
    ax
        to draw on; None: those of a new figure.

    Raises
    ------
    MitsimError
        for an uncertainty or depths that are not known.
    """
    if quantity == "image":
        unit = "light [electrons/s]" if POINT_SPREAD in image.inputs else "reflectance, 1 = board"
        return _draw_reflectance(ax, image.image, f"Image: {image.status.verdict.value}", unit, image.white)
    depths = None if image.depths is None else image.depths.mm
    values = image.uncertainty if quantity == "uncertainty" else depths
    if values is None:
        raise ArgumentError("quantity", f"{quantity!r}: is not known of this image; draw image")
    title, unit = {
        "uncertainty": ("Standard uncertainty of each pixel", "reflectance, 1 = board"),
        "depth": ("Depth of each pixel", "depth [mm]"),
    }[quantity]
    return _name_scene(_draw_linear(ax, values, title, unit, cmap="viridis"))


def draw_plan(plan: Plan, quantity: Literal["error", "seconds"] = "error", ax: Axes | None = None) -> Axes:
    """What effects would leave in the frames, or what stages take; returns the axes.

    Parameters
    ----------
    plan, quantity
        relative error of each effect if it were off, or predicted seconds of each stage.
    ax
        to draw on; None: those of a new figure.
    """
    if quantity == "error":
        errors = {f"{row.name} ({row.state})": row.error_if_off for row in plan.effects if row.error_if_off is not None}
        axes = _axes(ax, 0.7 + 0.36 * len(errors))
        error_bars(errors, plan.accuracy, axes=axes)
        axes.set_xlabel("relative error of the frames if it were off [1]", fontsize=FONT)
        axes.set_title(f"Plan at accuracy {plan.accuracy:g}", fontsize=FONT, pad=22)
        return axes
    axes = _axes(ax, 1.0 + ROW * len(plan.predicted))
    names = [*plan.predicted][::-1]
    bars = axes.barh(names, [plan.predicted[name] for name in names], color=BLUE)
    axes.bar_label(bars, fmt="%.2f", padding=3, fontsize=FONT - 1)
    axes.margins(x=0.12)
    label_axes(axes, "predicted time [s]", "", grid="x")
    axes.set_title(f"Plan: {plan.predicted_seconds:.2f} s from start to finish", fontsize=FONT)
    return axes


def _axes(ax: Axes | None, height: float = 0.5 * WIDTH, width: float = 0.7 * WIDTH) -> Axes:
    """Axes ``ax`` of the caller's; else those of a new figure of pyplot, which notebooks show, of so many inches."""
    if ax is not None:
        return ax
    from matplotlib import pyplot

    return pyplot.subplots(figsize=(width, height), layout="constrained")[1]


def _draw_linear(
    ax: Axes | None, values: npt.ArrayLike, title: str, unit: str, cmap: str = "gray", aspect: str = "equal"
) -> Axes:
    """Numbers from their least to their largest, in equal steps; the colour bar says so."""
    shown = np.asarray(values, dtype=np.float64)
    return _draw(ax, shown, title, f"{unit}, linear", {"cmap": cmap, "aspect": aspect})


def _draw_reflectance(ax: Axes | None, values: FloatArray, title: str, unit: str, white: float) -> Axes:
    """Numbers as a screen shows reflectances, ``white`` and what is above white; the colour bar says so."""
    curve = FuncNorm((lambda part: lightness(part / white), lambda shade: white * linear_light(shade)), 0.0, white)
    ends = values.min() < 0, values.max() > white
    extend = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}[ends]
    return _name_scene(
        _draw(ax, values, title, f"{unit}, shown by the sRGB curve", {"cmap": "gray", "norm": curve}, extend)
    )


def _draw(
    ax: Axes | None, values: npt.ArrayLike, title: str, unit: str, style: dict[str, Any], extend: str = "neither"
) -> Axes:
    axes = _axes(ax)
    drawn = axes.imshow(values, interpolation="none", **style)
    axes.set_title(title, fontsize=FONT)
    axes.set_xlabel("column [pixel]", fontsize=FONT)
    axes.set_ylabel("row [pixel]", fontsize=FONT)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(integer=True))
    axes.figure.colorbar(drawn, ax=axes, extend=extend).set_label(unit, fontsize=FONT - 1)
    return axes


def _name_scene(axes: Axes) -> Axes:
    """Names of the axes of an image of the scene."""
    axes.set_xlabel("column [projector pixel]", fontsize=FONT)
    axes.set_ylabel("row [projector pixel]", fontsize=FONT)
    return axes
