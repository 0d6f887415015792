"""A drawing of a bench to scale, previews in its own light, and a model that can be turned."""

from __future__ import annotations

import html
import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from scipy.spatial import ConvexHull

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.layout import Layout, Preview, Surface, layout_of, previews
from mitsim.bench.request import check_view
from mitsim.core.arrays import FloatArray
from mitsim.core.environment import versions
from mitsim.core.errors import check_arguments
from mitsim.core.files import write_bytes
from mitsim.core.images import lightness
from mitsim.report.pages import page_figure, render_page, typeset
from mitsim.report.plots import BLACK, BLUE, GREY, ORANGE, PALE

if TYPE_CHECKING:
    from plotly.graph_objects import Figure as Model

_DPI = 110
_STYLE = {
    "font.size": 8.5,
    "axes.titlesize": 10.0,
    "axes.labelsize": 8.5,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
_PLAN_INCHES, _SQUARE_INCHES = (4.4, 2.4), (3.6, 3.6)
_FEW = 60_000
"""Largest number of triangles that are filled in the drawing; corners of larger shapes are dots."""
_FLAT = 1e-4
_NO_PIXELS = 5e-3
"""Parallax [projector pixels] that no image shows."""
_IN_SIGHT = 1.8
"""Longest side of a scene, relative to the mean, that the first view of the model shows whole."""
_NAMES = 3
_BESIDE, _BEHIND = 0.3, 1.2
"""Part of the scene that is drawn beside and behind the light."""
_LAMP, _DARK = "#f0c419", "#9a6b00"
_SQUARE = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
_CLOSED, _PYRAMID = [0, 1, 2, 3, 0], [1, 2, 3, 4, 1, 0, 2, 0, 3, 0, 4]
"""Points of a line around four corners, and of one along all edges of a pyramid, whose tip is point 0."""
_SMALL_GAP: dict[str, Any] = {"textcoords": "offset points"}


def view(bench: Apparatus) -> BenchView:
    layout = layout_of(bench)
    return BenchView(bench, layout, previews(bench, layout))


@dataclass(frozen=True, eq=False)
class BenchView:
    """Places of all parts of a bench [mm] in the camera's frame, and pictures from the sensor's and a free place."""

    bench: Apparatus
    layout: Layout
    previews: tuple[Preview, Preview]

    # ---- In words and numbers ----

    @cached_property
    def facts(self) -> dict[str, str]:
        bench, layout, geometry = self.bench, self.layout, self.bench.geometry
        height, width = self._window_mm
        aligned, n = geometry.scene_distance, bench.n
        window = f"{height:.4g} x {width:.4g} mm at {aligned:.4g} mm, {n} x {n} pixels"
        if keystone := bench.loaded.pixels.keystone:
            window += f"; keystone: its corners are up to {keystone:.3g} pixels off a rectangle"
        light = "in mirrors alone" if bench.loaded.mirrors else "nowhere"
        if layout.depths is not None:
            near, far = layout.depths
            where = f"at {near:.4g} mm" if far - near < _FLAT * far else f"from {near:.4g} to {far:.4g} mm"
            light = f"{where}, of {layout.seen} of {n**2} projector pixels ({layout.seen / n**2:.1%})"
            light += "; mirrors may show more" if bench.loaded.mirrors and layout.seen < n**2 else ""
        moves, depths = layout.parallax, "between these depths"
        if max(moves) < _NO_PIXELS:
            moves, depths = layout.parallax_between(0.99 * aligned, aligned), f"none; {0.01 * aligned:.3g} mm nearer"
        rows, columns = ("0" if value < _NO_PIXELS else f"{value:.3g}" for value in moves)
        stop = f"{geometry.fov:g} degrees, {2 * geometry.tan_half_fov * aligned:.4g} mm wide there"
        if bench.field_stop_cuts:
            stop += "; it hides a part of the window from a part of the sensor"
        (m, k), (row, column) = geometry.shape, geometry.pitches
        pitch = f"{column * 1e3:.4g} um" if row == column else f"{row * 1e3:.4g} x {column * 1e3:.4g} um"
        feature = geometry.build_mask().feature_mm * 1e3
        sides = ("left of", "right of"), ("above", "below"), ("ahead", "behind")
        place = ", ".join(
            f"{abs(value):.4g} mm {plus if value > 0 else minus}"
            for value, (plus, minus) in zip(layout.projector, sides, strict=True)
            if abs(value) > _FLAT * float(np.linalg.norm(layout.projector))
        )
        return {
            "projector": f"{place} the camera's sensor" if place else "at the camera's sensor",
            "window": window,
            "light is seen": light,
            "parallax": f"{depths} the window moves by {rows} rows and {columns} columns of its pixels",
            "field stop": stop,
            "sensor": f"{m} x {k} pixels of {pitch}: {m * row:.3g} x {k * column:.3g} mm",
            "mask": f"{geometry.mask_words}, {geometry.mask_distance:g} mm before the sensor, features of "
            f"{feature:.4g} um",
        }

    @property
    def warnings(self) -> tuple[str, ...]:
        return self.layout.obstacles

    def summary(self) -> dict[str, Any]:
        layout, geometry = self.layout, self.bench.geometry
        surfaces = [
            {
                "name": surface.name,
                "lamp": surface.is_lamp,
                "low_mm": surface.points.min(axis=0).tolist(),
                "high_mm": surface.points.max(axis=0).tolist(),
            }
            for surface in layout.surfaces
        ]
        return {
            "scene": str(self.bench.loaded.path),
            "projector_mm": layout.projector.tolist(),
            "scene_distance_mm": geometry.scene_distance,
            "window_mm": self._window_mm,
            "projector_pixels": self.bench.n,
            "keystone_pixels": self.bench.loaded.pixels.keystone,
            "depths_mm": layout.depths,
            "seen_pixels": layout.seen,
            "parallax_pixels": layout.parallax,
            "field_stop_deg": geometry.fov,
            "field_stop_cuts": self.bench.field_stop_cuts,
            "sensor_pixels": geometry.shape,
            "sensor_mm": [2 * half for half in geometry.half_sides],
            "mask_distance_mm": geometry.mask_distance,
            "surfaces": surfaces,
            "warnings": self.warnings,
        }

    def lines(self) -> list[str]:
        return [f"{name}: {words}" for name, words in self.facts.items()]

    @property
    def _window_mm(self) -> tuple[float, float]:
        distance = self.bench.geometry.scene_distance
        (top, bottom), (left, right) = self.bench.windows
        return (bottom - top) * distance, (right - left) * distance

    # ---- As a drawing ----

    def figure(self) -> Figure:
        with rc_context(_STYLE):
            figure = Figure(figsize=(13, 8.6), layout="constrained")
            FigureCanvasAgg(figure)
            grid = figure.add_gridspec(3, 2, width_ratios=(2.3, 1))
            for place, (_, _, draw) in zip((0, 2, 1, 3, 5), self._parts, strict=True):
                draw(figure.add_subplot(grid[place]))
            axes = figure.add_subplot(grid[4])
            axes.set_axis_off()
            lines = _as_text("\n".join(typeset(line) for line in self.lines()))
            axes.text(0, 0.95, lines, va="top", fontsize=9, linespacing=1.6, transform=axes.transAxes)
            figure.suptitle(f"{_as_text(self._name)}: the bench to scale", fontsize=13, fontweight="bold")
        return figure

    @property
    def _parts(self) -> list[tuple[str, tuple[float, float], Callable[[Axes], None]]]:
        seen = "From the camera, without its mask"
        return [
            ("From above", _PLAN_INCHES, lambda axes: self._plan(axes, 0)),
            ("From the camera's right side", _PLAN_INCHES, lambda axes: self._plan(axes, 1)),
            ("The camera enlarged", _PLAN_INCHES, self._camera),
            (seen, _SQUARE_INCHES, lambda axes: _show(axes, self.previews[0], seen)),
            ("From beside", _SQUARE_INCHES, self._from_beside),
        ]

    @property
    def _name(self) -> str:
        path = self.bench.loaded.path
        return path.parent.name if path.name == "scene.xml" else path.stem

    @cached_property
    def _end(self) -> float:
        return max(self.bench.geometry.scene_distance, self.layout.depths[1] if self.layout.depths else 0.0)

    @cached_property
    def _range(self) -> tuple[float, float]:
        layout, reach = self.layout, self.bench.geometry.tan_half_fov * self._end
        lit = np.concatenate([[-reach, reach], layout.projector[:2], layout.window_at(self._end)[:, :2].ravel()])
        seen = [each.points[each.points[:, 2] < _BEHIND * self._end][:, :2].ravel() for each in layout.surfaces]
        every, room = np.concatenate([lit, *seen]), _BESIDE * float(np.ptp(lit))
        return max(float(every.min()), float(lit.min()) - room), min(float(every.max()), float(lit.max()) + room)

    def _has_room(self, points: FloatArray) -> bool:
        (low, high), z = self._range, points[:, 2]
        inside = (points[:, :2].max(axis=0) >= low) & (points[:, :2].min(axis=0) <= high)
        return bool(inside.all() and z.min() <= _BEHIND * self._end and z.max() >= min(0.0, self.layout.projector[2]))

    def _plan(self, axes: Axes, axis: int) -> None:
        layout, geometry, end, (low, high) = self.layout, self.bench.geometry, self._end, self._range
        aligned, tan, projector = geometry.scene_distance, geometry.tan_half_fov, layout.projector
        start, across = min(0.0, float(projector[2])), high - low
        length = end - start
        _fill_surfaces(axes, [each for each in layout.surfaces if self._has_room(each.points)], axis)
        light = np.concatenate([projector[None], layout.window_at(end)])[:, [2, axis]]
        axes.add_patch(Polygon(light[ConvexHull(light).vertices], closed=True, facecolor=ORANGE, alpha=0.22, lw=0))
        axes.plot([end, 0, end], [tan * end, 0, -tan * end], color=BLUE, lw=1, ls=(0, (5, 4)))
        axes.axvline(aligned, color=BLACK, lw=0.8, ls=":")
        window = layout.window[:, axis]
        axes.plot([aligned] * 2, [window.min(), window.max()], color=ORANGE, lw=3.5, solid_capstyle="butt")
        # Symbols of the devices are drawn behind their pinholes.
        facing, half = layout.window.mean(axis=0) - projector, 0.022 * length
        for place, along, color in ((projector, facing, ORANGE), (np.zeros(3), np.array([0, 0, 1.0]), BLUE)):
            ahead = along[[2, axis]] / np.linalg.norm(along[[2, axis]])
            sides, back = np.array([-ahead[1], ahead[0]]) * half, 2 * half * ahead
            corner = place[[2, axis]]
            body = [corner + sides, corner + sides - back, corner - sides - back, corner - sides]
            axes.add_patch(Polygon(body, closed=True, color=color, zorder=4))
        for lamp in (each for each in layout.lamps.values() if self._has_room(each[None])):
            axes.plot(lamp[2], lamp[axis], "*", color=_LAMP, mec=BLACK, ms=10, zorder=4)
        gap = 0.04 * length
        names = [("projector", projector, _DARK), ("camera", np.zeros(3), BLUE)]
        if np.hypot(projector[2], projector[axis]) < 2 * gap:
            names = [("camera and\nprojector", np.array([0.0, 0.0, start]), BLACK)]
        elif abs(projector[axis]) > gap:
            _measure(axes, (gap, 0), (gap, projector[axis]), f"{abs(projector[axis]):.4g} mm", upright=True)
        for name, at, color in names:
            axes.text(at[2] - 1.6 * gap, at[axis], name, color=color, ha="right", va="center")
        z, below = 0.45 * aligned, {"xytext": (0, -3), "ha": "right", "va": "top"}
        axes.annotate(f"field stop, {geometry.fov:g}°", (z, -tan * z), color=BLUE, **below, **_SMALL_GAP)
        words = f"window\n{self._window_mm[1 - axis]:.4g} mm,\n{self.bench.n} pixels"
        axes.text(max(end, aligned) + 0.03 * length, window.mean(), words, color=_DARK, va="center")
        axes.text(aligned, high + 0.03 * across, "calibrated plane", ha="center", va="bottom")
        _measure(axes, (0, low - 0.07 * across), (aligned, low - 0.07 * across), f"{aligned:.4g} mm")
        axes.set(xlim=(start - 0.32 * length, end + 0.24 * length), ylim=(low - 0.12 * across, high + 0.16 * across))
        axes.set_aspect("equal", adjustable="box")
        every = {surface.name: surface.points for surface in layout.surfaces}
        every |= {name: place[None] for name, place in layout.lamps.items()}
        outside = [name for name, points in every.items() if not self._has_room(points)]
        more = f"  (outside: {', '.join(outside[:_NAMES])}{' ...' if len(outside) > _NAMES else ''})" if outside else ""
        title = "From above" if axis == 0 else "From the camera's right side"
        axes.set_title(f"{title}{_as_text(more)}", loc="left")
        axes.set(xlabel="z, distance from the sensor [mm]", ylabel="x, to the left [mm]" if axis == 0 else "y, up [mm]")

    def _camera(self, axes: Axes) -> None:
        geometry = self.bench.geometry
        half, distance, tan = geometry.half_sides[1], geometry.mask_distance, geometry.tan_half_fov
        reach, mask, thick = 1.25 * (half + distance * tan), geometry.build_mask(), max(geometry.mask_thickness, 0.0)
        is_open = mask.openings[0][1]
        edges = (np.arange(len(is_open) + 1) - len(is_open) / 2) * mask.feature_mm + geometry.mask_offset[1]
        dark = np.flatnonzero(~np.asarray(is_open, dtype=bool) & (np.abs(edges[:-1]) < 2 * reach))
        # s = -x, and the drawing has +x upwards.
        closed = [((distance, -edges[column]), (distance, -edges[column + 1])) for column in dark]
        axes.add_collection(LineCollection(closed, colors=BLACK, lw=3.5, capstyle="butt"))
        if thick:
            moved = [tuple((z + thick, s) for z, s in line) for line in closed]
            axes.add_collection(LineCollection(moved, colors=BLACK, lw=3.5, capstyle="butt"))
        wide = 1.6 * (distance + thick)
        axes.add_patch(Rectangle((-0.06 * wide, -half), 0.06 * wide, 2 * half, color=BLUE))
        for sign in (1, -1):
            axes.plot([0, wide], [sign * half, sign * (half + tan * wide)], color=BLUE, lw=1, ls=(0, (5, 4)))
        _measure(axes, (0, 0), (distance, 0), f"{distance:.4g} mm")
        pixels = f"sensor\n{geometry.shape[1]} pixels of\n{geometry.pitches[1] * 1e3:.4g} µm"
        features = f"mask\nfeatures of\n{mask.feature_mm * 1e3:.3g} µm"
        axes.text(0.04 * wide, -0.55 * half, pixels, color=BLUE, va="center")
        axes.text(distance + thick + 0.05 * wide, 0.55 * half, features, va="center")
        axes.set(xlim=(-0.12 * wide, wide), ylim=(-reach, reach), xlabel="z [mm]", ylabel="x [mm]")
        axes.set_title("The camera enlarged, from above", loc="left")

    def _from_beside(self, axes: Axes) -> None:
        preview, layout, geometry = self.previews[1], self.layout, self.bench.geometry
        _show(axes, preview, "From beside")
        axes.set_xlabel("orange: the projector's light; blue: the camera's field")
        stop = _field_at(geometry.tan_half_fov, geometry.scene_distance)
        for eye, corners, color in ((layout.projector, layout.window, ORANGE), (np.zeros(3), stop, BLUE)):
            axes.add_patch(Polygon(preview.project(corners), closed=True, fill=False, color=color, lw=1.2))
            for corner in corners:
                # Lines end at the free camera, because points behind it are not in its picture.
                shown = preview.project(corner + np.linspace(0, 1, 50)[:, None] * (eye - corner))
                axes.plot(*shown[np.isfinite(shown).all(axis=1)].T, color=color, lw=0.9)
        rows, columns = preview.picture.shape[:2]
        axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))

    # ---- As a model that can be turned ----

    def model(self) -> Model:
        """Return a figure of plotly, which shows itself in a notebook and can be turned there."""
        from plotly import graph_objects

        layout, geometry, end, eye = self.layout, self.bench.geometry, self._end, np.zeros((1, 3))
        light = np.concatenate([layout.projector[None], layout.window_at(end)])
        stop = np.concatenate([eye, _field_at(geometry.tan_half_fov, end)])
        sensor = np.column_stack([_SQUARE * geometry.half_sides[::-1], np.zeros(4)])
        opaque = np.column_stack([_SQUARE * geometry.build_mask().extent_mm / 2, np.full(4, geometry.mask_distance)])
        parts: list[tuple[str, FloatArray, dict[str, Any]]] = [
            ("projector and its light", light[_PYRAMID], {"line": {"color": ORANGE, "width": 3}}),
            ("camera and its field stop", stop[_PYRAMID], {"line": {"color": BLUE, "width": 3}}),
            ("calibrated window", layout.window[_CLOSED], {"line": {"color": ORANGE, "width": 6}}),
            ("sensor", sensor[_CLOSED], {"line": {"color": BLUE, "width": 5}}),
            ("mask", opaque[_CLOSED], {"line": {"color": BLACK, "width": 5}}),
        ]
        lamp = {"mode": "markers", "marker": {"color": _LAMP, "size": 5}}
        parts += [(name, place[None], lamp) for name, place in layout.lamps.items()]
        for surface in layout.surfaces:
            shown = lightness(surface.reflectance)
            color: dict[str, Any] = {"color": _LAMP}
            if not surface.is_lamp and shown.shape[1] == 1:
                grey = shown[:, 0].astype(np.float32)
                color = {"intensity": grey, "colorscale": "gray", "cmin": 0, "cmax": 1, "showscale": False}
            elif not surface.is_lamp:
                color = {"vertexcolor": np.rint(255 * shown).astype(int).tolist()}
            faces = dict(zip("ijk", surface.triangles.astype(np.int32).T, strict=True))
            parts.append((surface.name, surface.points, {**faces, **color}))
        figure = graph_objects.Figure()
        for name, points, style in parts:
            # Plotly's x is the bench's z, and its z, which is up, is y. It reads names, which may be any text, as HTML.
            common = {"name": html.escape(name), **dict(zip("yzx", points.astype(np.float32).T, strict=True)), **style}
            if "i" in style:
                light_on = {"ambient": 0.75, "diffuse": 0.35, "specular": 0.0}
                hover = "%{x:.4g} mm from the sensor<br>x %{y:.4g} mm, y %{z:.4g} mm"
                figure.add_mesh3d(**common, lighting=light_on, flatshading=True, showlegend=True, hovertemplate=hover)
            else:
                figure.add_scatter3d(**{"mode": "lines", **common})
        # Plotly makes the sides' geometric mean 1. Therefore the eye moves back for a scene with one long side.
        extents = np.ptp(np.concatenate([points for _, points, _ in parts]), axis=0)
        back = max(1.0, float(extents.max() / np.cbrt(extents.prod())) / _IN_SIGHT)
        place = {"x": -2.1 * back, "y": -1.45 * back, "z": back}
        titles = {"xaxis": "z, from the sensor [mm]", "yaxis": "x, to the left [mm]", "zaxis": "y, up [mm]"}
        scene = {name: {"title": {"text": title}} for name, title in titles.items()}
        figure.update_layout(
            scene={**scene, "aspectmode": "data", "camera": {"eye": place, "center": {"x": 0, "y": 0, "z": -0.15}}},
            legend={"orientation": "h", "y": 0, "yanchor": "top"},
            margin={"l": 0, "r": 0, "t": 0, "b": 0},
            height=560,
        )
        return figure

    # ---- As a file, and in a notebook ----

    @check_arguments
    def save(self, path: Path | str) -> Path:
        """Write the drawing to a PNG file, or all of it to a page (HTML) without network.

        Raises MitsimError for another ending, and when the file cannot be written.
        """
        path = check_view(path)
        write_bytes(path, self._repr_png_() if path.suffix.lower() == ".png" else self._page().encode())
        return path

    def _page(self) -> str:
        pictures = {}
        for name, inches, draw in self._parts:
            with rc_context(_STYLE):
                figure = Figure(figsize=inches, layout="constrained")
                FigureCanvasAgg(figure)
                draw(figure.subplots())
            pictures[name] = page_figure(figure)
        return render_page(
            "view.html",
            title=self._name,
            scene=str(self.bench.loaded.path),
            facts=self.facts,
            warnings=self.warnings,
            model=self.model().to_html(
                full_html=False, include_plotlyjs=True, config={"displayModeBar": False, "responsive": True}
            ),
            pictures=pictures,
            versions=versions(),
        )

    def __repr__(self) -> str:
        return f"BenchView({self.bench!r})"

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.figure().savefig(buffer, format="png", dpi=_DPI)
        return buffer.getvalue()


# -------- Parts of drawings


def _fill_surfaces(axes: Axes, surfaces: list[Surface], axis: int) -> None:
    corners, heights, colors = [], [], []
    for surface in surfaces:
        if len(surface.triangles) > _FEW:
            axes.plot(surface.points[:, 2], surface.points[:, axis], ",", color=GREY)
            continue
        points = surface.points[surface.triangles]
        normals = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        length = np.linalg.norm(normals, axis=1)
        shade = 0.55 + 0.33 * np.abs(normals[:, 1 - axis]) / np.where(length > 0, length, 1)
        corners.append(points[..., [2, axis]])
        heights.append(points[..., 1 - axis].mean(axis=1) * (1 if axis == 0 else -1))
        colors.append(shade[:, None] * ([1.0, 0.85, 0.3] if surface.is_lamp else [0.94, 0.97, 1.0]))
    if corners:
        order = np.argsort(np.concatenate(heights), kind="stable")
        shown = np.concatenate(colors)[order]
        # The edge keeps a sheet visible that is seen edge on, and closes seams.
        faces = PolyCollection(np.concatenate(corners)[order], facecolors=shown, edgecolors=shown, lw=1.4)
        faces.set_rasterized(True)  # as shapes, those of a print of 128 x 128 pixels take 6 MB of a page
        axes.add_collection(faces)


def _as_text(name: str) -> str:
    """Escape dollar signs, which begin a formula of matplotlib."""
    return name.replace("$", r"\$")


def _field_at(tan: float, depth: float) -> FloatArray:
    return np.column_stack([_SQUARE * tan * depth, np.full(4, depth)])


def _measure(
    axes: Axes, start: tuple[float, float], end: tuple[float, float], words: str, upright: bool = False
) -> None:
    arrow = {"arrowstyle": "<->", "color": BLACK, "lw": 0.9, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, start, arrowprops=arrow)
    middle = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
    offset, sides = ((5, 0), ("left", "center")) if upright else ((0, 3), ("center", "bottom"))
    axes.annotate(words, middle, offset, ha=sides[0], va=sides[1], **_SMALL_GAP)


def _show(axes: Axes, preview: Preview, title: str) -> None:
    picture = lightness(preview.picture)
    axes.imshow(picture if picture.shape[2] == 3 else picture[..., 0], cmap="gray", vmin=0, vmax=1)
    axes.set(xticks=[], yticks=[])
    axes.set_title(title, loc="left")
    axes.spines[:].set_visible(True)
    axes.spines[:].set_color(PALE)
