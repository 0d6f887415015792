"""The drawings of docs/physics.md, architecture.md and validation.md: devices' numbers and tables in, PNG files out.

    python docs/images/drawings.py [FOLDER]

draws them into FOLDER, or beside this file. Nothing is simulated. Plans are seen from above: +z to the right, +x up,
which is left for one who looks along +z.
"""

from __future__ import annotations

import re
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, Polygon, Rectangle

SCENE_MM, BASELINE_MM, MASK_MM = 400.0, 60.0, 2.0
"""Distances of scenes/photograph: scene, projector beside the camera, mask before the sensor."""
WINDOW_MM, PIXELS, FIELD_DEGREES = 120.0, 128, 20.0
"""The projector's window at the scene, its pixels a side, and the full angle of the camera's field stop."""
PITCH_MM, SENSOR_PIXELS, FEATURE_MM, FEATURES = 0.01172, 512, 0.06, 511
"""The sensor and the mask."""
INK, GREY, LIGHT = "#222222", "#8a8a8a", "#d9d9d9"
BLUE, ORANGE, GREEN, RED = "#0b62a4", "#d95f02", "#1b7f4d", "#b2182b"
DPI = 110
"""Drawings are 1000 pixels wide or so, of some 40 KiB."""


def devices() -> Figure:
    """Where the devices stand."""
    figure, axes = _sheet(10, 4.6)
    half = WINDOW_MM / 2
    axes.fill([0, SCENE_MM, SCENE_MM], [BASELINE_MM, half, -half], color=ORANGE, alpha=0.13, lw=0)
    field = SCENE_MM * np.tan(np.radians(FIELD_DEGREES / 2))
    axes.plot([SCENE_MM, 0, SCENE_MM], [field, 0, -field], color=BLUE, lw=1, ls=(0, (5, 4)))
    axes.plot([SCENE_MM, SCENE_MM], [-82, 82], color=INK, lw=3)
    axes.plot([SCENE_MM + 3, SCENE_MM + 3], [-half, half], color=ORANGE, lw=5, solid_capstyle="butt")
    axes.add_patch(Rectangle((-26, BASELINE_MM - 8), 26, 16, color=ORANGE))
    axes.add_patch(Rectangle((-9, -11), 9, 22, color=BLUE))
    axes.plot([5, 5], [-15, 15], color=INK, lw=2, ls=(0, (2, 1)))
    axes.text(-32, BASELINE_MM, "projector", ha="right", va="center", color=ORANGE)
    axes.text(-16, 0, "camera: sensor\nand mask", ha="right", va="center", color=BLUE)
    axes.text(SCENE_MM - 6, 83, "scene and calibration board", ha="right", va="bottom", color=INK)
    axes.text(
        SCENE_MM + 12,
        0,
        f"window\n{WINDOW_MM:g} mm,\n{PIXELS} pixels of\n{WINDOW_MM / PIXELS:.4g} mm",
        color=ORANGE,
        va="center",
    )
    axes.text(
        300,
        -57,
        f"field stop, {FIELD_DEGREES:g} degrees",
        color=BLUE,
        rotation=-7.5,
        ha="center",
        va="top",
        rotation_mode="anchor",
    )
    axes.text(120, 56, "the projector's light", color=ORANGE, ha="center", va="bottom")
    _measure(axes, (0, -96), (SCENE_MM, -96), f"{SCENE_MM:g} mm")
    _measure(axes, (14, 0), (14, BASELINE_MM), f"baseline\n{BASELINE_MM:g} mm", side="right")
    axes.annotate("", (-58, -96), (-98, -96), arrowprops={"arrowstyle": "->", "color": GREY})
    axes.annotate("", (-98, -56), (-98, -96), arrowprops={"arrowstyle": "->", "color": GREY})
    axes.text(-55, -96, "+z", color=GREY, va="center")
    axes.text(-98, -53, "+x", color=GREY, ha="center", va="bottom")
    axes.set(xlim=(-118, 490), ylim=(-112, 104))
    inset = figure.add_axes((0.27, 0.14, 0.21, 0.2))
    inset.set(xlim=(-1.4, 7.6), ylim=(-4.2, 4.2), xticks=[], yticks=[], facecolor="white")
    size = PITCH_MM * SENSOR_PIXELS
    inset.add_patch(Rectangle((-0.5, -size / 2), 0.5, size, color=BLUE))
    inset.plot([MASK_MM, MASK_MM], [-4.2, 4.2], color=INK, lw=2.5, ls=(0, (1.4, 0.8)))
    _measure(inset, (0, 0), (MASK_MM, 0), f"{MASK_MM:g} mm")
    inset.text(2.5, 2.1, f"mask: {FEATURES} features\nof {FEATURE_MM * 1000:g} µm", fontsize=8, va="center")
    inset.text(
        2.5, -2.1, f"sensor: {SENSOR_PIXELS} pixels\nof {PITCH_MM * 1000:g} µm", fontsize=8, va="center", color=BLUE
    )
    for spine in inset.spines.values():
        spine.set_color(GREY)
    return figure


def axes() -> Figure:
    """Which way rows, columns and coordinates run in every image."""
    figure, sheet = _sheet(8, 3.4)
    sheet.add_patch(Rectangle((-3, -2), 6, 4, facecolor="#e8f0f7", edgecolor=BLUE, lw=1.5))
    for k in range(1, 6):
        sheet.plot([-3 + k, -3 + k], [-2, 2], color="white", lw=1)
    for k in range(1, 4):
        sheet.plot([-3, 3], [-2 + k, -2 + k], color="white", lw=1)
    sheet.add_patch(Rectangle((-3, 1), 1, 1, color=ORANGE, alpha=0.8))
    sheet.text(-2.5, 1.5, "0, 0", ha="center", va="center", color="white")
    arrow = {"arrowstyle": "->", "lw": 1.6}
    for end, start, words, place, color in (
        ((3, 2.45), (-3, 2.45), "columns grow to the right:  $s = -x$", (0, 2.6), ORANGE),
        ((-3.45, -2), (-3.45, 2), "rows grow\ndownwards:\n$s = -y$", (-3.65, 0), ORANGE),
        ((0, 1.5), (0, 0), "$+y$", (0.12, 1.3), INK),
        ((-1.5, 0), (0, 0), "$+x$", (-1.5, 0.12), INK),
    ):
        sheet.annotate("", end, start, arrowprops={**arrow, "color": color, "shrinkA": 0, "shrinkB": 0})
        across = "right" if place[0] < -3 else "left" if place == (0.12, 1.3) else "center"
        sheet.text(*place, words, color=color, ha=across, va="center" if across == "right" else "bottom")
    sheet.plot(0, 0, "o", color=INK, ms=9, mfc="white")
    sheet.plot(0, 0, "x", color=INK, ms=6)
    sheet.text(0.2, -0.3, "$+z$, away from you,\nto the scene", va="top")
    words = "Frame, mask, pattern, truth\nand image all show what\none sees who looks along $+z$\nfrom the sensor."
    sheet.text(3.5, 0, words, va="center")
    sheet.set(xlim=(-6.2, 8.2), ylim=(-2.6, 3.4))
    return figure


def shadow() -> Figure:
    """The mask's shadow shifts with the direction of its point."""
    figure, axes = _sheet(10, 4.6)
    mask_z, point_z, points = 3.0, 9.5, (0.0, 3.4)
    code = np.array([1, 0, 1, 1, 0, 0, 1, 0, 1, 0, 1, 1])
    edges = np.linspace(-4.8, 4.8, len(code) + 1)
    for left, right, clear in zip(edges[:-1], edges[1:], code, strict=True):
        if not clear:
            axes.plot([left, right], [mask_z, mask_z], color=INK, lw=4, solid_capstyle="butt")
    axes.plot([-9, 9], [0, 0], color=GREY, lw=1)
    for x, color, lane in zip(points, (ORANGE, BLUE), (-0.42, -1.02), strict=True):
        axes.plot(x, point_z, "o", color=color, ms=9)
        for left, right, clear in zip(edges[:-1], edges[1:], code, strict=True):
            if clear:
                ends = [x + (edge - x) * point_z / (point_z - mask_z) for edge in (left, right)]
                axes.fill([x, *ends], [point_z, 0, 0], color=color, alpha=0.07, lw=0)
                axes.plot(ends, [lane, lane], color=color, lw=8, solid_capstyle="butt")
    shift = points[1] * (1 - point_z / (point_z - mask_z))
    first = edges[6] * point_z / (point_z - mask_z)
    _measure(axes, (first + shift, -1.62), (first, -1.62), r"shift  $d\,\Delta\tau/(1-d/z)$", below=True)
    _measure(axes, (points[0], 10.3), (points[1], 10.3), r"$z\,\Delta\tau$")
    _measure(axes, (-8.6, 0), (-8.6, mask_z), "$d$ = 2 mm", side="right")
    _measure(axes, (8.6, 0), (8.6, point_z), "$z$ = 400 mm", side="left")
    axes.text(5.1, mask_z, "mask", va="center")
    axes.text(9.15, 0.1, "sensor", va="bottom", color=GREY)
    axes.text(9.15, -0.42, "shadow of the first point", va="center", color=ORANGE, fontsize=9)
    axes.text(9.15, -1.02, "shadow of the second", va="center", color=BLUE, fontsize=9)
    pitch = WINDOW_MM / PIXELS / SCENE_MM
    moved = MASK_MM * pitch / (1 - MASK_MM / SCENE_MM)
    axes.text(
        9.15,
        6.6,
        "Points of one depth cast\nthe same shadow, shifted.\n\nOne projector pixel beside:\n"
        f"$\\Delta\\tau$ = {pitch:.5f}, a shift of\n{moved * 1000:.1f} µm, or {moved / PITCH_MM:.2f}\nsensor pixels.",
        va="center",
    )
    axes.text(-9.3, 10.9, "not to scale", color=GREY, fontsize=9)
    axes.set(xlim=(-9.6, 15.6), ylim=(-2.7, 11.5))
    return figure


def anchors() -> Figure:
    """Where light is seen from, and what it is accumulated in."""
    figure = Figure(figsize=(10, 3.9), layout="constrained")
    FigureCanvasAgg(figure)
    sensor, cells, layers = figure.subplots(1, 3)
    half = PITCH_MM * SENSOR_PIXELS / 2
    nodes = half * np.cos((2 * np.arange(3) + 1) * np.pi / 6)
    sensor.add_patch(Rectangle((-half, -half), 2 * half, 2 * half, facecolor="#e8f0f7", edgecolor=BLUE, lw=1.5))
    grid = np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2)
    sensor.plot(*grid.T, "o", color=BLUE, ms=8)
    sensor.plot(0, 0, "o", color=ORANGE, ms=12)
    sensor.text(0, -0.45, "one anchor:\nthe centre", ha="center", va="top", color=ORANGE)
    sensor.text(0, 1.55, "3 x 3 anchors, at\nChebyshev nodes", ha="center", va="center", color=BLUE)
    sensor.set_title("Anchors: points of the sensor\nthat light is connected to", fontsize=11)
    sensor.set(xlim=(-3.4, 3.4), ylim=(-3.4, 3.4), xlabel="place on the sensor [mm]", aspect="equal")
    pixel = WINDOW_MM / PIXELS / SCENE_MM * 1000
    for k in range(5):
        cells.axhline(k * pixel, color=INK, lw=1.8)
        cells.axvline(k * pixel, color=INK, lw=1.8)
        if k < 4:
            cells.axhline((k + 0.5) * pixel, color=GREY, lw=0.7)
            cells.axvline((k + 0.5) * pixel, color=GREY, lw=0.7)
    cells.add_patch(Rectangle((pixel, 2 * pixel), pixel / 2, pixel / 2, color=ORANGE, alpha=0.8))
    cells.text(
        1.62 * pixel,
        2.25 * pixel,
        "a cell: even light",
        va="center",
        color=ORANGE,
        bbox={"fc": "white", "ec": "none", "pad": 1},
    )
    cells.set_title("Cells: 2 x 2 a projector pixel\n(thick lines), seen from the sensor", fontsize=11)
    cells.set(xlim=(0, 4 * pixel), ylim=(0, 4 * pixel), xlabel="tan-angle [1/1000]", aspect="equal")
    depths = 1 / np.linspace(1 / 450, 1 / 364, 3)
    for place, depth in enumerate(depths):
        layers.plot([depth, depth], [0, 1], color=INK, lw=2)
        name = f"layer {place + 1}\n{depth:.0f} mm"
        layers.text(depth, 1.04, name, ha=("right", "center", "left")[place], va="bottom", fontsize=10)
    light, (near, far) = 382.0, (depths[2], depths[1])
    part = (1 / light - 1 / far) / (1 / near - 1 / far)
    layers.plot(light, 0.5, "o", color=ORANGE, ms=11)
    for end, share in ((near, part), (far, 1 - part)):
        layers.annotate("", (end, 0.5), (light, 0.5), arrowprops={"arrowstyle": "->", "color": ORANGE, "lw": 1.8})
        layers.text((end + light) / 2, 0.57, f"{share:.0%}", ha="center", color=ORANGE)
    layers.text(
        light, 0.36, f"light at {light:g} mm", ha="center", va="top", color=ORANGE, bbox={"fc": "white", "ec": "none"}
    )
    layers.set_title("Layers: even in 1/z; light is\nsplit between two, linearly in 1/z", fontsize=11)
    layers.set(xlim=(352, 462), ylim=(0, 1.35), xlabel="distance z [mm]", yticks=[])
    return figure


def parallax() -> Figure:
    """Another depth is another direction for the camera."""
    figure, axes = _sheet(10, 4.4)
    near, far, projector, x0 = 360.0, SCENE_MM, BASELINE_MM, -24.0
    seen = projector + (x0 - projector) * near / far
    axes.plot([0, far], [projector, x0], color=ORANGE, lw=2)
    axes.text(150, 34, "one projector pixel", color=ORANGE, ha="left", va="bottom")
    for z, name in ((far, "calibrated depth\n$z_0$ = 400 mm"), (near, "surface at\n$z$ = 360 mm")):
        axes.plot([z, z], [-58, 58], color=INK if z == far else GREY, lw=2)
        axes.text(z, 62, name, ha="left" if z == far else "right", va="bottom", color=INK if z == far else GREY)
    for z, x, color in ((far, x0, BLUE), (near, seen, RED)):
        axes.plot([0, far], [0, x * far / z], color=color, lw=1.4, ls="-" if z == far else (0, (5, 3)))
        axes.plot(z, x, "o", color=color, ms=8)
    axes.add_patch(Rectangle((-20, projector - 6), 20, 12, color=ORANGE))
    axes.add_patch(Rectangle((-7, -9), 7, 18, color=BLUE))
    axes.text(-10, projector + 9, "projector", ha="center", va="bottom", color=ORANGE)
    axes.text(-4, -12, "sensor, place $u$", ha="center", va="top", color=BLUE)
    _measure(axes, (-32, 0), (-32, projector), "$B$ = 60 mm", side="left")
    _measure(axes, (far + 6, x0), (far + 6, seen * far / near), "", side="right")
    steps = projector * (1 / near - 1 / far)
    pixels = steps / (WINDOW_MM / PIXELS / SCENE_MM)
    axes.text(
        far + 14,
        (x0 + seen * far / near) / 2 - 8,
        f"seen elsewhere by\n$(B-u)(1/z-1/z_0)$\n= {steps:.4f} at $u$ = 0\n= {pixels:.1f} projector pixels",
        va="center",
        color=RED,
    )
    axes.set(xlim=(-112, 540), ylim=(-70, 92))
    return figure


def passes() -> Figure:
    """Which pass takes which path; one drawing each."""
    figure = Figure(figsize=(10, 6.2), layout="constrained")
    FigureCanvasAgg(figure)
    draws = (
        ("direct", "one surface", _direct),
        ("penumbra", "one surface, partly hidden\nfrom the sensor by an edge", _penumbra),
        ("sharp lobes", "one surface that shines\nin nearly one direction", _sharp),
        ("indirect", "two or more surfaces", _indirect),
        ("path reuse", "pixels of a block share\ntheir second points", _reuse),
        ("from camera", "begun at the camera: sharp\nlast turns, mirrors, lamps", _from_camera),
        ("specular chain", "mirrors alone", _chain),
        ("caustics", "mirrors, then a surface", _caustic),
    )
    for axes, (name, words, draw) in zip(figure.subplots(2, 4).flat, draws, strict=True):
        axes.set(xlim=(0, 10), ylim=(-2.3, 8.4), aspect="equal")
        axes.set_axis_off()
        axes.add_patch(Rectangle((0.2, 6.1), 1.3, 0.9, color=ORANGE))
        axes.add_patch(Rectangle((0.2, 1.0), 0.45, 1.8, color=BLUE))
        axes.plot([1.0, 1.0], [0.8, 3.0], color=INK, lw=1.6, ls=(0, (1.5, 1)))
        draw(axes)
        axes.set_title(name, fontsize=12, fontweight="bold", color=INK)
        axes.text(5, -0.1, words, ha="center", va="top", fontsize=9.5)
    key = (
        "Orange box: projector.  Blue box: sensor behind its mask.  Black surfaces scatter, blue ones shine or mirror."
    )
    figure.supxlabel(key, fontsize=10, color=INK)
    return figure


PROJECTOR, SENSOR = (1.5, 6.55), (0.65, 1.9)
"""Where light leaves and arrives in the drawings of passes."""


def _wall(axes: Axes, color: str = INK) -> None:
    axes.plot([9.2, 9.2], [0.6, 7.6], color=color, lw=4, solid_capstyle="butt")


def _path(axes: Axes, *points: tuple[float, float], color: str = ORANGE, style: str = "-") -> None:
    for start, end in pairwise(points):
        axes.annotate(
            "",
            end,
            start,
            arrowprops={"arrowstyle": "->", "color": color, "lw": 1.6, "ls": style, "shrinkA": 0, "shrinkB": 0},
        )


def _direct(axes: Axes) -> None:
    _wall(axes)
    _path(axes, PROJECTOR, (9.1, 4.4), SENSOR)


def _penumbra(axes: Axes) -> None:
    _wall(axes)
    axes.plot([5.4, 5.4], [0.6, 2.72], color=INK, lw=4, solid_capstyle="butt")
    _path(axes, PROJECTOR, (9.1, 3.4), (0.65, 2.65))
    _path(axes, (9.1, 3.4), (5.45, 2.4), color=RED, style="--")


def _sharp(axes: Axes) -> None:
    _wall(axes, BLUE)
    spread = [(9.1, 4.2), (0.65, 1.55), (0.65, 2.35)]
    axes.add_patch(Polygon(spread, closed=True, color=ORANGE, alpha=0.35, lw=0))
    _path(axes, PROJECTOR, (9.1, 4.2), SENSOR)


def _corner(axes: Axes) -> None:
    _wall(axes)
    axes.plot([3.2, 9.2], [7.6, 7.6], color=INK, lw=4, solid_capstyle="butt")


def _indirect(axes: Axes) -> None:
    _corner(axes)
    _path(axes, PROJECTOR, (9.1, 5.2), (6.3, 7.5), SENSOR)


def _reuse(axes: Axes) -> None:
    _corner(axes)
    for first in (5.6, 5.0, 4.4):
        for second in (6.8, 5.4):
            axes.plot([9.1, second], [first, 7.5], color=ORANGE, lw=0.9)
        axes.plot([PROJECTOR[0], 9.1], [PROJECTOR[1], first], color=ORANGE, lw=0.9)
    for second in (6.8, 5.4):
        _path(axes, (second, 7.5), SENSOR)


def _from_camera(axes: Axes) -> None:
    _wall(axes, BLUE)
    axes.plot([3.2, 9.2], [7.6, 7.6], color=INK, lw=4, solid_capstyle="butt")
    _path(axes, SENSOR, (9.1, 4.6), (6.3, 7.5), color=BLUE)
    _path(axes, (6.3, 7.5), PROJECTOR, color=BLUE, style="--")
    axes.add_patch(Circle((3.6, 5.0), 0.35, color="#e6ab02"))
    axes.text(3.6, 4.45, "lamp", fontsize=9, va="top", ha="center")
    _path(axes, (6.3, 7.5), (3.95, 5.2), color=BLUE, style="--")


def _chain(axes: Axes) -> None:
    _wall(axes, BLUE)
    for offset in (-0.35, 0.0, 0.35):
        _path(axes, PROJECTOR, (9.1, 4.2 + offset), (0.65, 1.9 + offset))


def _caustic(axes: Axes) -> None:
    axes.add_patch(Arc((8.6, 4.6), 1.6, 5.2, theta1=-75, theta2=75, color=BLUE, lw=4))
    axes.plot([3.2, 9.2], [0.45, 0.45], color=INK, lw=4, solid_capstyle="butt")
    for height in (5.6, 4.8):
        _path(axes, PROJECTOR, (9.25, height), (5.2, 0.55))
    _path(axes, (5.2, 0.55), SENSOR)


BOXES = {
    "files": (1, 0, "scene.xml, camera\nand projector files"),
    "bench": (1, 1, "bench\nwhat is loaded, as data"),
    "planner": (1, 2, "planner\npilot, then plan"),
    "light": (1, 3, "light\npasses, light estimate"),
    "transport": (2, 3, "transport\npaths of light"),
    "optics": (1, 4, "optics\nexpected frames"),
    "sensor": (2, 4, "sensor\nelectrons to numbers"),
    "calibrate": (0, 2, "calibrate\nwhite board, stripes"),
    "CAL": (0, 5, "CAL folder"),
    "RUN": (2, 5, "RUN folder"),
    "reconstruct": (1, 6, "reconstruct\naccumulate, solve"),
    "image": (1, 7, "image\nuncertainty, status"),
    "metrics": (2, 7, "metrics\nPSNR, SSIM"),
    "report": (1, 8, "report, studies"),
}
"""Column, row and words of each stage on the way from files to an image."""
FLOW = (
    "files>bench bench>planner bench>calibrate planner>light transport>light light>optics optics>sensor sensor>RUN "
    "calibrate>CAL CAL>reconstruct RUN>reconstruct reconstruct>image image>report metrics>report"
)
COLUMN, ROW, WIDE, HIGH = 3.0, 1.35, 2.5, 0.85
"""Steps between boxes, and their size; chosen so that words of 10 points fit."""


def way() -> Figure:
    """The stages from files to an image. Frames alone lead from the camera's side to the solver's."""
    figure, axes = _sheet(7, 8.4)
    for name, (column, row, words) in BOXES.items():
        x, y, color = column * COLUMN, -row * ROW, GREEN if name in ("RUN", "CAL") else INK
        axes.add_patch(Rectangle((x - WIDE / 2, y - HIGH / 2), WIDE, HIGH, fc="white", ec=color, lw=1.6))
        axes.text(x, y, words, ha="center", va="center", color=color, fontsize=10)
    for arrow in FLOW.split():
        axes.annotate("", **_between(*arrow.split(">")), arrowprops={"arrowstyle": "->", "color": GREY, "lw": 1.6})
    truth = {"arrowstyle": "->", "color": GREY, "lw": 1.6, "ls": (0, (3, 3))}
    axes.annotate("", **_between("RUN", "metrics"), arrowprops=truth)
    axes.text(2 * COLUMN + 0.1, -5.9 * ROW, "truth.exr", color=GREY, va="center", fontsize=10)
    axes.set(xlim=(-WIDE / 2 - 0.1, 2 * COLUMN + WIDE / 2 + 0.1), ylim=(-8 * ROW - 0.6, 0.6))
    return figure


def predicted() -> Figure:
    """Draw predictions against measurements, by the tables of docs/studies.md and docs/growth.md."""
    figure = Figure(figsize=(10, 3.5), layout="constrained")
    FigureCanvasAgg(figure)
    drift, light, seconds = figure.subplots(1, 3)
    rows = [
        [number.split(" +- ") for number in row[-3:-1]] for row in _table("studies.md", "| kind | amount | measured")
    ]
    measured, foretold = (np.array([[float(part) for part in row[side]] for row in rows]) for side in (0, 1))
    drift.errorbar(foretold[:, 0], measured[:, 0], measured[:, 1], foretold[:, 1], fmt="o", ms=4, lw=0.8, color=BLUE)
    drift.set(title="Loss by a drift", xlabel="predicted [dB]", ylabel="measured [dB]", xscale="log", yscale="log")
    rows = [row for row in _table("studies.md", "| scene, patterns | asked") if row[-1] != "-"]
    mean, error = np.array([[float(part) for part in row[-2].split(" +- ")] for row in rows]).T
    light.errorbar([float(row[-3]) for row in rows], mean, error, fmt="o", ms=4, lw=0.8, color=ORANGE)
    light.set(title="Image by a planned calibration", xlabel="predicted [dB]", ylabel="measured [dB]")
    for heading, name, color in (
        ("| case | plan [s] | transport [s] | truth", "captures", BLUE),
        ("| case | plan [s] | transport [s] | optics", "calibrations", ORANGE),
        ("| case | accumulate", "images", GREEN),
    ):
        pairs = [[float(part) for part in row[_TOTAL[name]].split(" / ")] for row in _table("growth.md", heading)]
        seconds.plot(*np.transpose(pairs), "o", ms=4, color=color, label=name)
    seconds.set(title="Time of the work", xlabel="predicted [s]", ylabel="measured [s]", xscale="log", yscale="log")
    seconds.legend(frameon=False, fontsize=8)
    for panel in (drift, light, seconds):
        ends = panel.get_xlim()
        panel.plot(ends, ends, color=GREY, lw=0.8, zorder=0)
    return figure


_TOTAL = {"captures": 7, "calibrations": 5, "images": 4}
"""Columns of the tables in docs/growth.md that have the total."""


def _table(page: str, heading: str) -> list[list[str]]:
    """Return the cells of each row of the table on a page of docs whose first line begins with the heading."""
    text = (Path(__file__).parents[1] / page).read_text(encoding="utf-8")
    block = re.search(rf"^{re.escape(heading)}.*\n.*\n((?:\|.*\n)+)", text, flags=re.M)
    assert block, f"docs/{page} has no table {heading!r}"
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in block[1].splitlines()]


def _between(start: str, end: str) -> dict[str, tuple[float, float]]:
    """The ends of an arrow from one box to another: between the sides that face each other."""
    (column, row, _), (last_column, last_row, _) = BOXES[start], BOXES[end]
    down, right = np.sign(last_row - row), np.sign(last_column - column)
    if down:
        from_, to = (0.0, -down * HIGH / 2), (0.0, down * HIGH / 2)
    else:
        from_, to = (right * WIDE / 2, 0.0), (-right * WIDE / 2, 0.0)
    return {
        "xytext": (column * COLUMN + from_[0], -row * ROW + from_[1]),
        "xy": (last_column * COLUMN + to[0], -last_row * ROW + to[1]),
    }


def _sheet(width: float, height: float) -> tuple[Figure, Axes]:
    """A figure of one drawing without a frame."""
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    return figure, axes


def _measure(
    axes: Axes, start: tuple[float, float], end: tuple[float, float], words: str, side: str = "", below: bool = False
) -> None:
    """A dimension between two points, with its words beside it."""
    axes.annotate("", end, start, arrowprops={"arrowstyle": "<->", "color": INK, "lw": 1, "shrinkA": 0, "shrinkB": 0})
    x, y = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
    if side:
        axes.annotate(
            words,
            (x, y),
            xytext=(6 if side == "right" else -6, 0),
            textcoords="offset points",
            ha="left" if side == "right" else "right",
            va="center",
        )
    else:
        axes.annotate(
            words,
            (x, y),
            xytext=(0, -5 if below else 5),
            textcoords="offset points",
            ha="center",
            va="top" if below else "bottom",
        )


DRAWINGS = (devices, axes, shadow, anchors, parallax, passes, way, predicted)


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    for drawing in DRAWINGS:
        drawing().savefig(folder / f"{drawing.__name__}.png", dpi=DPI, facecolor="white", metadata={"Software": None})


if __name__ == "__main__":
    main()
