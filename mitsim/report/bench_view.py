"""A bench in; a drawing of it to scale, pictures of it in its own light and a model that can be turned, out."""

from __future__ import annotations

import html
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
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
from mitsim.reconstruct.depth import SPARE
from mitsim.report.pages import page_figure, render_page, typeset
from mitsim.report.plots import BLACK, BLUE, GREY, ORANGE, PALE

if TYPE_CHECKING:
    from plotly.graph_objects import Figure as Model

_DPI = 110
"""Of the drawing: 1430 pixels wide."""
_SMALL = 8.5
"""Points of words in a drawing."""
_PLAN_INCHES, _SQUARE_INCHES = (4.4, 2.4), (3.6, 3.6)
"""Of a page's pictures: narrower than 500 pixels, so that a telephone shows them whole."""
_FEW = 60_000
"""Triangles up to which a shape is filled in the drawing, in a second; of more its corners are dots."""
_FLAT = 1e-4
"""Relative difference of depths below which they are one: single precision is 1e-7."""
_NO_PIXELS = 5e-3
"""Parallax [projector pixels] that no image shows."""
_IN_SIGHT = 1.4
"""Longest side of the model over the mean of all that its picture has room for: `lamp_bench` has 1.34."""
_ACROSS = 7
"""Period of dots across the baseline: the paper's."""
_NAMES = 3
"""Of things outside a plan that its title has room for."""
_BESIDE, _BEHIND = 0.3, 1.2
"""How far beside the light, of its width, and behind it the drawing shows the scene; chosen: it is of the bench."""
_LAMP, _DARK = "#f0c419", "#9a6b00"
"""Of lamps, and of words about orange things."""


def view(bench: Apparatus) -> BenchView:
    """What a ``bench`` looks like."""
    layout = layout_of(bench)
    return BenchView(bench, layout, previews(bench, layout))


@dataclass(frozen=True, eq=False)
class BenchView:
    """Where all of a bench stands, which shows itself in a notebook.

    Attributes
    ----------
    bench
        the bench.
    layout
        its devices and surfaces [mm], in the camera's frame.
    previews
        what a pinhole camera sees of it from the sensor's place, and from a free place.
    """

    bench: Apparatus
    layout: Layout
    previews: tuple[Preview, Preview]

    # ---- In words and numbers ----

    @cached_property
    def facts(self) -> dict[str, str]:
        """Distances and sizes in words, by what they are of."""
        bench, layout, geometry = self.bench, self.layout, self.bench.geometry
        height, width = self._window_mm
        window = f"{height:.4g} x {width:.4g} mm at {geometry.scene_distance:.4g} mm, {bench.n} x {bench.n} pixels"
        if bench.loaded.pixels.keystone:
            window += f"; keystone: its corners are up to {bench.loaded.pixels.keystone:.3g} pixels off a rectangle"
        (rows, columns), (row, column) = geometry.shape, geometry.pitches
        pitch = f"{column * 1e3:.4g} um" if row == column else f"{row * 1e3:.4g} x {column * 1e3:.4g} um"
        stop = f"{geometry.fov:g} degrees, {2 * geometry.tan_half_fov * geometry.scene_distance:.4g} mm wide there"
        if bench.field_stop_cuts:
            stop += "; it hides a part of the window from a part of the sensor"
        mask = f"{geometry.mask_words}, {geometry.mask_distance:g} mm before the sensor"
        return {
            "projector": _place_words(layout.projector),
            "window": window,
            "light is seen": self._light_words,
            "parallax": self._parallax_words,
            **self._dots_words,
            "field stop": stop,
            "sensor": f"{rows} x {columns} pixels of {pitch}: {rows * row:.3g} x {columns * column:.3g} mm",
            "mask": f"{mask}, features of {geometry.build_mask().feature_mm * 1e3:.4g} um",
        }

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return why no calibration can give an image of the bench."""
        return self.layout.obstacles

    def summary(self) -> dict[str, Any]:
        """What the command line reports, but for the file's name."""
        layout, geometry = self.layout, self.bench.geometry
        depths = layout.depths
        return {
            "scene": str(self.bench.loaded.path),
            "projector_mm": layout.projector.tolist(),
            "scene_distance_mm": geometry.scene_distance,
            "window_mm": self._window_mm,
            "projector_pixels": self.bench.n,
            "keystone_pixels": self.bench.loaded.pixels.keystone,
            "depths_mm": depths,
            "seen_pixels": layout.seen,
            "parallax_pixels": layout.parallax,
            "field_stop_deg": geometry.fov,
            "field_stop_cuts": self.bench.field_stop_cuts,
            "sensor_pixels": geometry.shape,
            "sensor_mm": [2 * half for half in geometry.half_sides],
            "mask_distance_mm": geometry.mask_distance,
            "surfaces": [
                {
                    "name": surface.name,
                    "lamp": surface.is_lamp,
                    "low_mm": surface.points.min(axis=0).tolist(),
                    "high_mm": surface.points.max(axis=0).tolist(),
                }
                for surface in layout.surfaces
            ],
            "warnings": self.warnings,
        }

    def lines(self) -> list[str]:
        """The facts, a line each."""
        return [f"{name}: {words}" for name, words in self.facts.items()]

    @property
    def _window_mm(self) -> tuple[float, float]:
        """Height and width of the projector's window on the aligned plane, of the box around it."""
        rows, columns = self.bench.windows
        distance = self.bench.geometry.scene_distance
        return (rows[1] - rows[0]) * distance, (columns[1] - columns[0]) * distance

    @property
    def _light_words(self) -> str:
        layout, every = self.layout, self.bench.n**2
        if layout.depths is None:
            return "in mirrors alone" if self.bench.loaded.mirrors else "nowhere"
        near, far = layout.depths
        where = f"at {near:.4g} mm" if far - near < _FLAT * far else f"from {near:.4g} to {far:.4g} mm"
        more = "; mirrors may show more" if self.bench.loaded.mirrors and layout.seen < every else ""
        return f"{where}, of {layout.seen} of {every} projector pixels ({layout.seen / every:.1%}){more}"

    @property
    def _parallax_words(self) -> str:
        """Between the depths of the light, or to a depth that is 1 % nearer."""
        between, where, aligned = self.layout.parallax, "between these depths", self.bench.geometry.scene_distance
        if max(between) < _NO_PIXELS:
            between = self.layout.parallax_between(0.99 * aligned, aligned)
            where = f"none; {0.01 * aligned:.3g} mm nearer"
        rows, columns = ("0" if value < _NO_PIXELS else f"{value:.3g}" for value in between)
        return f"{where} the window moves by {rows} rows and {columns} columns of its pixels"

    @property
    def _dots_words(self) -> dict[str, str]:
        """Which dots tell the depths apart, where there are several: no two are a period of the dots away."""
        rows, columns = self.layout.parallax
        if max(rows, columns) < _NO_PIXELS:
            return {}
        period = 2 ** math.ceil(math.log2(max(rows, columns) + SPARE))
        if period > self.bench.n:
            return {"depth map": "no dots tell it: parallax spans the window"}
        name = f"dots:{_ACROSS}x{period}" if columns >= rows else f"dots:{period}x{_ACROSS}"
        return {"depth map": f"{name} and reconstruct --focus map tell it; a shorter period may leave it off by one"}

    # ---- As a drawing ----

    def figure(self) -> Figure:
        """The drawing: from above, from the side, the camera enlarged, and both previews."""
        figure = Figure(figsize=(13, 8.6), layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.add_gridspec(3, 2, width_ratios=(2.3, 1))
        draws = (self._plan_from_above, self._camera), (self._plan_from_side, self._preview), (self._words, self._aside)
        for row, both in enumerate(draws):
            for column, draw in enumerate(both):
                draw(figure.add_subplot(grid[row, column]))
        figure.suptitle(f"{_as_text(self._name)}: the bench to scale", fontsize=13, fontweight="bold")
        return figure

    def _words(self, axes: Axes) -> None:
        """All facts."""
        axes.set_axis_off()
        lines = _as_text("\n".join(typeset(line) for line in self.lines()))
        axes.text(0, 0.95, lines, va="top", fontsize=_SMALL + 0.5, linespacing=1.6, transform=axes.transAxes)

    @property
    def _name(self) -> str:
        path = self.bench.loaded.path
        return path.parent.name if path.name == "scene.xml" else path.stem

    def _plan_from_above(self, axes: Axes) -> None:
        self._plan(axes, 0)

    def _plan_from_side(self, axes: Axes) -> None:
        self._plan(axes, 1)

    @cached_property
    def _end(self) -> float:
        """Depth [mm] to which light is drawn: the aligned plane, or the farthest that is lit."""
        depths = self.layout.depths
        return max(self.bench.geometry.scene_distance, depths[1] if depths else 0.0)

    @cached_property
    def _range(self) -> tuple[float, float]:
        """Ends [mm] of both plans across z: of the light, and of the scene where that is not far beside it."""
        layout, reach = self.layout, self.bench.geometry.tan_half_fov * self._end
        lit = np.concatenate([[-reach, reach], layout.projector[:2], layout.window_at(self._end)[:, :2].ravel()])
        low, high = float(lit.min()), float(lit.max())
        room = _BESIDE * (high - low)
        for points in (surface.points for surface in layout.surfaces):
            across = points[points[:, 2] < _BEHIND * self._end][:, :2]
            if across.size:
                low, high = min(low, float(across.min())), max(high, float(across.max()))
        return max(low, float(lit.min()) - room), min(high, float(lit.max()) + room)

    def _plan(self, axes: Axes, axis: int) -> None:
        """Seen from above (``axis`` 0, +x upwards) or from the side (1, +y upwards)."""
        layout, end, (low, high) = self.layout, self._end, self._range
        aligned, tan = self.bench.geometry.scene_distance, self.bench.geometry.tan_half_fov
        start, across = min(0.0, float(layout.projector[2])), high - low
        length = end - start
        _fill_surfaces(axes, [each for each in layout.surfaces if self._has_room(each.points)], axis)
        light = np.concatenate([layout.projector[None], layout.window_at(end)])[:, [2, axis]]
        outline = light[ConvexHull(light).vertices]
        axes.add_patch(Polygon(outline, closed=True, facecolor=ORANGE, alpha=0.22, lw=0))
        axes.plot([end, 0, end], [tan * end, 0, -tan * end], color=BLUE, lw=1, ls=(0, (5, 4)))
        axes.axvline(aligned, color=BLACK, lw=0.8, ls=":")
        window = layout.window[:, axis]
        axes.plot([aligned] * 2, [window.min(), window.max()], color=ORANGE, lw=3.5, solid_capstyle="butt")
        facing = layout.window.mean(axis=0) - layout.projector
        for place, along, color in ((layout.projector, facing, ORANGE), (np.zeros(3), np.array([0, 0, 1.0]), BLUE)):
            corners = _body(place[[2, axis]], along[[2, axis]], 0.022 * length)
            axes.add_patch(Polygon(corners, closed=True, color=color, zorder=4))
        for place in (each for each in layout.lamps.values() if self._has_room(each[None])):
            axes.plot(place[2], place[axis], "*", color=_LAMP, mec=BLACK, ms=10, zorder=4)
        self._name_devices(axes, axis, length)
        size = self._window_mm[1 - axis]
        words = f"window\n{size:.4g} mm,\n{self.bench.n} pixels"
        axes.text(max(end, aligned) + 0.03 * length, window.mean(), words, color=_DARK, va="center", fontsize=_SMALL)
        axes.text(aligned, high + 0.03 * across, "calibrated plane", ha="center", va="bottom", fontsize=_SMALL)
        _measure(axes, (0, low - 0.07 * across), (aligned, low - 0.07 * across), f"{aligned:.4g} mm")
        axes.set(xlim=(start - 0.32 * length, end + 0.24 * length), ylim=(low - 0.12 * across, high + 0.16 * across))
        axes.set_aspect("equal", adjustable="box")
        title = "From above" if axis == 0 else "From the camera's right side"
        axes.set_title(f"{title}{_as_text(self._outside)}", fontsize=_SMALL + 1.5, loc="left")
        axes.set_xlabel("z, distance from the sensor [mm]", fontsize=_SMALL)
        axes.set_ylabel("x, to the left [mm]" if axis == 0 else "y, up [mm]", fontsize=_SMALL)
        _open(axes)

    def _name_devices(self, axes: Axes, axis: int, length: float) -> None:
        """The words beside projector, camera and field stop, and the baseline."""
        place, stop, gap = self.layout.projector, self.bench.geometry, 0.04 * length
        names = [("projector", place, _DARK), ("camera", np.zeros(3), BLUE)]
        if np.hypot(place[2], place[axis]) < 2 * gap:
            names = [("camera and\nprojector", np.array([0.0, 0.0, min(place[2], 0.0)]), BLACK)]
        elif abs(place[axis]) > gap:
            _measure(axes, (gap, 0), (gap, place[axis]), f"{abs(place[axis]):.4g} mm", upright=True)
        for name, at, color in names:
            axes.text(at[2] - 1.6 * gap, at[axis], name, color=color, ha="right", va="center", fontsize=_SMALL)
        z = 0.45 * stop.scene_distance
        words = {"xytext": (0, -3), "textcoords": "offset points", "ha": "right", "va": "top", "fontsize": _SMALL}
        axes.annotate(f"field stop, {stop.fov:g}°", (z, -stop.tan_half_fov * z), color=BLUE, **words)

    def _has_room(self, points: FloatArray) -> bool:
        """Whether some of a box around ``points`` (k, 3) is in the plans: what is not would hide what is."""
        (low, high), ahead = self._range, _BEHIND * self._end
        across, z = points[:, :2], points[:, 2]
        inside = (across.max(axis=0) >= low) & (across.min(axis=0) <= high)
        return bool(inside.all() and z.min() <= ahead and z.max() >= min(0.0, self.layout.projector[2]))

    @cached_property
    def _outside(self) -> str:
        """Shapes and lamps that the plans have no room for, in words."""
        every = {surface.name: surface.points for surface in self.layout.surfaces}
        every |= {name: place[None] for name, place in self.layout.lamps.items()}
        names = [name for name, points in every.items() if not self._has_room(points)]
        return f"  (outside: {', '.join(names[:_NAMES])}{' ...' if len(names) > _NAMES else ''})" if names else ""

    def _camera(self, axes: Axes) -> None:
        """Sensor and mask, in a scale of their own, along columns."""
        geometry = self.bench.geometry
        half, distance, tan = geometry.half_sides[1], geometry.mask_distance, geometry.tan_half_fov
        reach = 1.25 * (half + distance * tan)
        mask = geometry.build_mask()
        is_open = mask.openings[0][1]
        edges = (np.arange(len(is_open) + 1) - len(is_open) / 2) * mask.feature_mm + geometry.mask_offset[1]
        # s = -x, and the drawing has +x upwards.
        closed = [
            ((distance, -a), (distance, -b))
            for a, b, clear in zip(edges[:-1], edges[1:], is_open, strict=True)
            if not clear and abs(a) < 2 * reach
        ]
        thick = max(geometry.mask_thickness, 0.0)
        axes.add_collection(LineCollection(closed, colors=BLACK, lw=3.5, capstyle="butt"))
        if thick:
            moved = [tuple((z + thick, s) for z, s in line) for line in closed]
            axes.add_collection(LineCollection(moved, colors=BLACK, lw=3.5, capstyle="butt"))
        wide = 1.6 * (distance + thick)
        axes.add_patch(Rectangle((-0.06 * wide, -half), 0.06 * wide, 2 * half, color=BLUE))
        for sign in (1, -1):
            axes.plot([0, wide], [sign * half, sign * (half + tan * wide)], color=BLUE, lw=1, ls=(0, (5, 4)))
        _measure(axes, (0, 0), (distance, 0), f"{distance:.4g} mm")
        columns = geometry.shape[1]
        axes.text(
            0.04 * wide,
            -0.55 * half,
            f"sensor\n{columns} pixels of\n{geometry.pitches[1] * 1e3:.4g} µm",
            color=BLUE,
            va="center",
            fontsize=_SMALL,
        )
        axes.text(
            distance + thick + 0.05 * wide,
            0.55 * half,
            f"mask\nfeatures of\n{mask.feature_mm * 1e3:.3g} µm",
            va="center",
            fontsize=_SMALL,
        )
        axes.set(xlim=(-0.12 * wide, wide), ylim=(-reach, reach))
        axes.set_title("The camera enlarged, from above", fontsize=_SMALL + 1.5, loc="left")
        axes.set_xlabel("z [mm]", fontsize=_SMALL)
        axes.set_ylabel("x [mm]", fontsize=_SMALL)
        _open(axes)

    def _preview(self, axes: Axes) -> None:
        """The preview from the sensor's place."""
        _show(axes, self.previews[0], "From the camera, without its mask")

    def _aside(self, axes: Axes) -> None:
        """The preview from a free place, with the light and the camera's field drawn over it."""
        preview, layout, geometry = self.previews[1], self.layout, self.bench.geometry
        _show(axes, preview, "From beside")
        axes.set_xlabel("orange: the projector's light; blue: the camera's field", fontsize=_SMALL)
        reach = geometry.tan_half_fov * geometry.scene_distance
        stop = np.array([[x, y, geometry.scene_distance] for x, y in _SQUARE * reach])
        for eye, corners, color in ((layout.projector, layout.window, ORANGE), (np.zeros(3), stop, BLUE)):
            axes.add_patch(Polygon(preview.project(corners), closed=True, fill=False, color=color, lw=1.2))
            for corner in corners:
                # Up to where the free camera is: what is behind that has no place in its picture.
                shown = preview.project(corner + np.linspace(0, 1, 50)[:, None] * (eye - corner))
                ahead = np.isfinite(shown).all(axis=1)
                axes.plot(*shown[ahead].T, color=color, lw=0.9)
        rows, columns = preview.picture.shape[:2]
        axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))

    # ---- As a model that can be turned ----

    def model(self) -> Model:
        """The bench in three dimensions, as a figure of plotly, which shows itself in a notebook."""
        from plotly import graph_objects

        layout, geometry = self.layout, self.bench.geometry
        figure = graph_objects.Figure()
        for surface in layout.surfaces:
            figure.add_trace(
                _mesh(surface.name, surface.points, surface.triangles, surface.reflectance, surface.is_lamp)
            )
        end, reach = self._end, geometry.tan_half_fov * self._end
        stop = np.array([[x, y, end] for x, y in _SQUARE * reach])
        for name, eye, corners, color in (
            ("projector and its light", layout.projector, layout.window_at(end), ORANGE),
            ("camera and its field stop", np.zeros(3), stop, BLUE),
        ):
            path = [
                eye,
                *(
                    point
                    for pair in zip(corners, np.roll(corners, -1, axis=0), strict=True)
                    for point in (pair[0], pair[1], eye)
                ),
            ]
            figure.add_trace(_line(name, np.array(path), color))
        figure.add_trace(_line("calibrated window", layout.window[[0, 1, 2, 3, 0]], ORANGE, 6))
        for name, half, z, color in (
            ("sensor", geometry.half_sides, 0.0, BLUE),
            ("mask", (geometry.build_mask().extent_mm / 2,) * 2, geometry.mask_distance, BLACK),
        ):
            corners = np.array([[x * half[1], y * half[0], z] for x, y in _SQUARE])
            figure.add_trace(_line(name, corners[[0, 1, 2, 3, 0]], color, 5))
        for name, place in layout.lamps.items():
            figure.add_trace(_line(name, place[None], _LAMP, 5, mode="markers"))
        ends = np.array([[[min(side), max(side)] for side in (each.x, each.y, each.z)] for each in figure.data])
        sides = ends[:, :, 1].max(axis=0) - ends[:, :, 0].min(axis=0)
        # Plotly makes the sides' geometric mean 1: of a high room the longest is far more, and the eye goes back.
        back = max(1.0, float(sides.max() / np.cbrt(sides.prod())) / _IN_SIGHT)
        titles = {"xaxis": "z, from the sensor [mm]", "yaxis": "x, to the left [mm]", "zaxis": "y, up [mm]"}
        figure.update_layout(
            scene={
                **{name: {"title": {"text": title}} for name, title in titles.items()},
                "aspectmode": "data",
                "camera": {
                    "eye": {"x": -2.1 * back, "y": -1.45 * back, "z": 1.0 * back},
                    "center": {"x": 0, "y": 0, "z": -0.15},
                },
            },
            legend={"orientation": "h", "y": 0, "yanchor": "top"},
            margin={"l": 0, "r": 0, "t": 0, "b": 0},
            height=560,
        )
        for trace in figure.data:  # plotly reads HTML in its texts, and a scene's names are any text
            trace.name = html.escape(trace.name)
        return figure

    # ---- As a file, and in a notebook ----

    @check_arguments
    def save(self, path: Path | str) -> Path:
        """Write the drawing to a PNG file, or all of it to a page without network, an HTML file; returns its path.

        Parameters
        ----------
        path
            the file, which is replaced.

        Raises
        ------
        MitsimError
            for another ending, and when the file cannot be written.
        """
        path = check_view(path)
        write_bytes(path, self._repr_png_() if path.suffix.lower() == ".png" else self._page().encode())
        return path

    def _page(self) -> str:
        """The page."""
        model = self.model().to_html(full_html=False, include_plotlyjs=True, config=_CONTROLS)
        pictures = {
            "From above": self._alone(_PLAN_INCHES, self._plan_from_above),
            "From the camera's right side": self._alone(_PLAN_INCHES, self._plan_from_side),
            "The camera enlarged": self._alone(_PLAN_INCHES, self._camera),
            "From the camera, without its mask": self._alone(_SQUARE_INCHES, self._preview),
            "From beside": self._alone(_SQUARE_INCHES, self._aside),
        }
        return render_page(
            "view.html",
            title=self._name,
            scene=str(self.bench.loaded.path),
            facts=self.facts,
            warnings=self.warnings,
            model=model,
            pictures=pictures,
            versions=versions(),
        )

    @staticmethod
    def _alone(inches: tuple[float, float], draw: Callable[[Axes], None]) -> tuple[str, int]:
        """One picture for the page."""
        figure = Figure(figsize=inches, layout="constrained")
        FigureCanvasAgg(figure)
        draw(figure.subplots())
        return page_figure(figure)

    def __repr__(self) -> str:
        return f"BenchView({self.bench!r})"

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.figure().savefig(buffer, format="png", dpi=_DPI)
        return buffer.getvalue()


# -------- Parts of drawings

_SQUARE = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
_CONTROLS = {"displayModeBar": False, "responsive": True}


def _fill_surfaces(axes: Axes, surfaces: Sequence[Surface], axis: int) -> None:
    """The scene as it is seen from above (``axis`` 0) or the right (1): what is nearer covers what is not."""
    corners, heights, colors = [], [], []
    for surface in surfaces:
        if len(surface.triangles) > _FEW:
            axes.plot(surface.points[:, 2], surface.points[:, axis], ",", color=GREY)
            continue
        points = surface.points[surface.triangles]
        normals = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        length = np.linalg.norm(normals, axis=1)
        facing = np.abs(normals[:, 1 - axis]) / np.where(length > 0, length, 1)
        shade = 0.55 + 0.33 * facing
        corners.append(points[..., [2, axis]])
        heights.append(points[..., 1 - axis].mean(axis=1) * (1 if axis == 0 else -1))
        warm = np.array([1.0, 0.85, 0.3]) if surface.is_lamp else np.array([0.94, 0.97, 1.0])
        colors.append(shade[:, None] * warm)
    if corners:
        order = np.argsort(np.concatenate(heights), kind="stable")
        shown = np.concatenate(colors)[order]
        # The edge keeps a sheet visible that is seen edge on, and closes seams.
        faces = PolyCollection(np.concatenate(corners)[order], facecolors=shown, edgecolors=shown, lw=1.4)
        faces.set_rasterized(True)  # as shapes, those of a print of 128 x 128 pixels take 6 MB of a page
        axes.add_collection(faces)


def _as_text(name: str) -> str:
    """Return a name for matplotlib, which takes what stands between two dollar signs for a formula."""
    return name.replace("$", r"\$")


def _body(place: FloatArray, along: FloatArray, half: float) -> FloatArray:
    """Corners (4, 2) of a device's symbol behind its pinhole, which looks along a direction."""
    ahead = along / np.linalg.norm(along)
    across = np.array([-ahead[1], ahead[0]])
    return np.array([place + across * half * s - ahead * half * b for s, b in ((1, 0), (1, 2), (-1, 2), (-1, 0))])


def _measure(
    axes: Axes, start: tuple[float, float], end: tuple[float, float], words: str, upright: bool = False
) -> None:
    """A dimension between two points."""
    arrow = {"arrowstyle": "<->", "color": BLACK, "lw": 0.9, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, start, arrowprops=arrow)
    middle = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
    axes.annotate(
        words,
        middle,
        xytext=(5, 0) if upright else (0, 3),
        textcoords="offset points",
        ha="left" if upright else "center",
        va="center" if upright else "bottom",
        fontsize=_SMALL,
    )


def _open(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=_SMALL - 0.5)


def _show(axes: Axes, preview: Preview, title: str) -> None:
    picture = lightness(preview.picture)
    axes.imshow(picture if picture.shape[2] == 3 else picture[..., 0], cmap="gray", vmin=0, vmax=1)
    axes.set(xticks=[], yticks=[])
    axes.set_title(title, fontsize=_SMALL + 1.5, loc="left")
    for spine in axes.spines.values():
        spine.set_color(PALE)


def _mesh(name: str, points: FloatArray, triangles: Any, reflectance: FloatArray, is_lamp: bool) -> Any:
    """A shape of the model, in the greys or colours of its print."""
    from plotly import graph_objects

    z, x, y = points.astype(np.float32).T[[2, 0, 1]]
    shown = lightness(reflectance)
    color: dict[str, Any]
    if is_lamp:
        color = {"color": _LAMP}
    elif shown.shape[1] == 1:
        grey = shown[:, 0].astype(np.float32)
        color = {"intensity": grey, "colorscale": "gray", "cmin": 0, "cmax": 1, "showscale": False}
    else:
        color = {"vertexcolor": np.rint(255 * shown).astype(int).tolist()}
    i, j, k = triangles.astype(np.int32).T
    light = {"ambient": 0.75, "diffuse": 0.35, "specular": 0.0}
    common = {"name": name, "showlegend": True, "lighting": light, "flatshading": True}
    hover = "%{x:.4g} mm from the sensor<br>x %{y:.4g} mm, y %{z:.4g} mm"
    return graph_objects.Mesh3d(x=z, y=x, z=y, i=i, j=j, k=k, hovertemplate=hover, **common, **color)


def _line(name: str, points: FloatArray, color: str, width: float = 3, mode: str = "lines") -> Any:
    """A line of the model."""
    from plotly import graph_objects

    z, x, y = points.T[[2, 0, 1]]
    style = (
        {"line": {"color": color, "width": width}} if mode == "lines" else {"marker": {"color": color, "size": width}}
    )
    return graph_objects.Scatter3d(x=z, y=x, z=y, mode=mode, name=name, **style)


def _place_words(place: FloatArray) -> str:
    """Where the projector stands, in words."""
    sides = ("left", "right"), ("above", "below"), ("ahead", "behind")
    words = []
    for value, (plus, minus) in zip(place, sides, strict=True):
        side = plus if value > 0 else minus
        if abs(value) > _FLAT * float(np.linalg.norm(place)):
            words.append(f"{abs(value):.4g} mm {side}{' of' if plus == 'left' else ''}")
    return f"{', '.join(words)} the camera's sensor" if words else "at the camera's sensor"
