"""A scene: a drawing of its bench to scale, and exposures of its light under any pattern family, for studies.

The drawing has previews in the bench's own light, and a model that can be turned. Of exposures, the *rendered* model
uses the traced light and calibrated factors. The *idealised* model is the paper's: a planar scene that is lit evenly,
and a geometric shadow of one separable term. Reflectance, exposure and noise are equal. *Equal peak* fills the same
part of the full well with each family's brightest pixel, *equal frame* gives every frame the exposure of uniform light,
and *equal total* shares that exposure among the family's frames.
"""

from __future__ import annotations

import html
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from scipy import sparse
from scipy.spatial import ConvexHull

from mitsim.acquire.exposure import Exposer, peak_irradiance, taken_off, takes_ambient_frame
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.layout import Layout, Preview, Surface, layout_of, previews
from mitsim.bench.request import Exposure, check_view
from mitsim.calibrate.board_session import DARK, READ, ROUNDING, SHOT
from mitsim.core.arrays import FloatArray
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError, check_arguments
from mitsim.core.files import write_bytes
from mitsim.core.images import lightness, reduce_frame
from mitsim.core.parallel import single_threaded_blas
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask import CameraMask
from mitsim.devices.patterns import PatternFamily
from mitsim.devices.projector import Spectrum
from mitsim.light.light import SampledLight
from mitsim.metrics import Quality, psnr
from mitsim.optics.frames import AccumulatedLight, ExpectedFrames
from mitsim.optics.image_formation import FrameOptics
from mitsim.optics.shadow import Directions, SeparableTerms
from mitsim.optics.terms import best_term, centre_terms, shadow_terms
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.solver import Accumulator, Prepared, Solution, prepare
from mitsim.report import EQUAL_PEAK, EQUAL_TOTAL, IDEALISED, RENDERED
from mitsim.report.pages import page_figure, render_page, scene_name, subject, typeset
from mitsim.report.plots import BLACK, BLUE, GREY, ORANGE, PALE
from mitsim.sensor.chain import electrons_from_irradiance, response_variance

if TYPE_CHECKING:
    from plotly.graph_objects import Figure as Model

# -------- Light of a scene and a camera in

NONUNIFORMITY, SPECKLE = "response nonuniformity", "speckle"
"""Names of noise sources beside those of :mod:`mitsim.calibrate.board_session`."""
DIM_E = 5600
"""Electrons of the brightest pixel that give the paper's 22.8 and 34.8 dB of uniform light and 49 dots at 2000 um."""
DIM = f"a peak of {DIM_E} electrons"
LAMBDAS = tuple(float(relative) for relative in np.logspace(-14, 0, 57))
"""Lambdas relative to the largest sigma^2 for a search with the truth."""


class LitScene:
    def __init__(self, light: SampledLight) -> None:
        self.light, self.bench = light, light.bench
        uniform = self.bench.family("uniform")
        self.uniform_s = cache(lambda model: peak_time(self.bench, self.expected_frames(model, uniform)))

    @property
    def truth(self) -> FloatArray:
        return self.light.truth

    def quality(self, image: FloatArray) -> Quality:
        return Quality.of(image, self.truth, self.light.apparent.error)

    def expected_frames(
        self, model: str, family: PatternFamily, plane: Plane | None = None, bench: Apparatus | None = None
    ) -> ExpectedFrames:
        """Return frames without noise, of one of :data:`mitsim.report.MODELS`.

        ``plane`` is the place of an idealised scene, None for the calibrated one; ``bench`` may have another mask.
        """
        if model == RENDERED:
            light = self._merged if bench is None else self._merged.behind(bench)
            return light.frames(family.lighting, self.light.seed)
        camera = self._ideal if bench is None else IdealCamera(bench, bench.geometry.mask)
        return camera.frames(family, self.truth * self.board_flux, plane)

    def rendered_frames(self, factors: Factors, family: PatternFamily, seed: int) -> Unexposed:
        sides = factors.left, factors.right
        return Unexposed(self, RENDERED, family, sides, factors.manifest.centre, seed)

    def idealised_frames(self, family: PatternFamily, seed: int, plane: Plane | None = None) -> Unexposed:
        """Return frames of the paper's model with its own factors; their noise differs from that of rendered frames."""
        camera = self._ideal
        return Unexposed(self, IDEALISED, family, camera.calibrated(self.board_flux), camera.centre, seed + 1, plane)

    @cached_property
    def _merged(self) -> SampledLight:
        return self.light.merge()

    @cached_property
    def _ideal(self) -> IdealCamera:
        return IdealCamera(self.bench, self.bench.geometry.mask)

    @property
    def board_flux(self) -> float:
        """Return the irradiance by a pixel of a white board without the mask [W m^-2]."""
        return float(self.light.apparent.board_flux.mean())


@dataclass(frozen=True, eq=False)
class Unexposed:
    """Frames of a scene before any exposure, and the factors that solve them.

    ``centre`` is True where means are subtracted from frames; ``plane`` is that of an idealised scene, None for that of
    the factors; ``bench`` may have another mask.
    """

    lit: LitScene
    model: str
    family: PatternFamily
    sides: tuple[FloatArray, FloatArray]
    centre: bool
    seed: int
    plane: Plane | None = None
    bench: Apparatus | None = None

    @cached_property
    def expected(self) -> ExpectedFrames:
        return self.lit.expected_frames(self.model, self.family, self.plane, self.bench)

    def seconds(self, exposure: str) -> float:
        if exposure in (EQUAL_PEAK, DIM):
            peak_e = Exposure().fraction * self.lit.bench.sensor.superpixel_full_well_e
            return peak_time(self.lit.bench, self.expected) * (DIM_E / peak_e if exposure == DIM else 1.0)
        return self.lit.uniform_s(self.model) / (len(self.family.shots) if exposure == EQUAL_TOTAL else 1)

    def prepare(self, binning: int = 1) -> Prepared:
        rows, columns = (len(side) for side in self.sides)
        if rows % binning or columns % binning:
            raise MitsimError(
                f"frames of {rows} x {columns} pixels: cannot be averaged {binning} x {binning}; give the scene's film "
                f"multiples of {binning}"
            )
        left, right = (side.reshape(-1, binning, side.shape[1]).mean(axis=1) for side in self.sides)
        return prepare(left, right, self.family.left, self.family.right, centre=self.centre)

    def data(self, seconds: float, binning: int = 1) -> tuple[Prepared, Accumulator]:
        model = self.prepare(binning)
        (sums,) = accumulate(self.exposer(seconds), self.family, self.expected, [model], binning)
        return model, sums

    def solve(self, seconds: float, lam: float | Literal["auto", "best"] = "auto", binning: int = 1) -> Solution:
        """Solve one exposure of ``seconds`` a frame; ``lam="best"`` uses the truth and :data:`LAMBDAS`."""
        model, sums = self.data(seconds, binning)
        if lam != "best":
            return model.solve(sums, lam)
        scale, truth = model.problem(sums).scale, self.lit.truth
        return max((model.solve(sums, scale * each) for each in LAMBDAS), key=lambda one: psnr(one.image, truth))

    @single_threaded_blas()
    def clear(self, lam: float) -> FloatArray:
        model, exposer, expected = self.prepare(), self.exposer(1.0), self.expected
        off = exposer.electrons(expected.projector_off) if takes_ambient_frame("auto", self.family, expected) else 0.0
        measured = self.family.measurements(exposer.electrons(frame) - off for frame in expected)
        return model.solve(model.accumulator(measured), lam).image

    def exposer(self, seconds: float) -> Exposer:
        speckle = self.lit.light.speckle(self.family) if self.model == RENDERED else 0.0
        return Exposer(self.lit.bench.devices, seconds, self.seed, speckle)

    def noise(self, seconds: float) -> float:
        return float(np.sqrt(sum(self.noises(seconds).values())))

    def noises(self, seconds: float) -> dict[str, float]:
        """Return the variance of a datum [(electrons/s)^2] by source.

        Differences between the pixels' responses count as noise because the factors lack them.
        """
        exposer, sensor = self.exposer(seconds), self.lit.bench.sensor
        light = [exposer.electrons(frame) for frame in self.expected]
        square = float(np.mean([np.square(frame).mean() for frame in light]))
        parts = {
            SHOT: float(np.mean([frame.mean() for frame in light])),
            DARK: sensor.superpixel_dark_current_e_per_s * seconds,
            READ: sensor.superpixel_reading_noise_e**2,
            ROUNDING: 0.0 if sensor.largest_dn is None else 1 / (12 * sensor.gain_dn_per_e**2),
            NONUNIFORMITY: response_variance(sensor) * square,
            SPECKLE: exposer.speckle**2 * square,
        }
        return {name: variance / seconds**2 for name, variance in parts.items()}


def peak_time(bench: Apparatus, expected: ExpectedFrames) -> float:
    return Exposure().choose(bench.devices, peak_irradiance(expected))


def accumulate(
    exposer: Exposer, family: PatternFamily, expected: ExpectedFrames, models: Sequence[Prepared], binning: int = 1
) -> list[Accumulator]:
    sums = [model.accumulator() for model in models]
    with single_threaded_blas():
        for measurement, row, column in measured(exposer, family, expected):
            frame = reduce_frame(measurement, binning)
            for each in sums:
                each.add(frame, row, column)
    return sums


def measured(
    exposer: Exposer, family: PatternFamily, expected: ExpectedFrames
) -> Iterator[tuple[FloatArray, int, int]]:
    """Yield noisy measurements without ambient light [electrons/s], and their patterns."""
    ambient = taken_off(exposer, family, expected)
    for measurement, row, column in exposer.measurements(family, expected):
        yield measurement - ambient, row, column


# -------- The paper's idealised camera


Pair = tuple[FloatArray, FloatArray]
"""Left and right factor, (pixels, n) each."""


@dataclass(frozen=True)
class Plane:
    """A plane scene at ``depth_mm``, lit from ``baseline_mm`` beside the camera."""

    depth_mm: float
    baseline_mm: tuple[float, float]


@dataclass(frozen=True, eq=False)
class IdealCamera:
    """The idealised camera of a ``bench``; a ``spectrum`` of None has no diffraction."""

    bench: Apparatus
    mask: CameraMask
    spectrum: Spectrum | None = None

    @property
    def centre(self) -> bool:
        return self._geometry.centred

    @cached_property
    def terms(self) -> SeparableTerms:
        distance = self.bench.geometry.scene_distance
        return shadow_terms(self._geometry, *self.directions, distance, self.spectrum)

    @cached_property
    def factors(self) -> Pair:
        best = best_term(centre_terms(self.terms) if self.centre else self.terms)
        return best.left, best.right

    def calibrated(self, board_flux: float, term: Pair | None = None) -> Pair:
        """Return the factors, or another ``term``, in a calibration's unit [sqrt(electrons / s)]."""
        model = self.bench.projector
        rate = electrons_from_irradiance(board_flux, 1.0, self.bench.sensor, model.effective_wavelength_nm)
        left, right = self.factors if term is None else term
        return left * np.sqrt(rate), right * np.sqrt(rate)

    def frames(self, family: PatternFamily, flux: FloatArray, plane: Plane | None = None) -> ExpectedFrames:
        light = sparse.csr_array(sparse.diags_array(flux.ravel()))
        if plane is None:
            optics = self._optics
        else:
            shift = 1 / plane.depth_mm - 1 / self.bench.geometry.scene_distance
            rows, columns = (
                Directions(pixels.centres + baseline * shift, pixels.width)
                for pixels, baseline in zip(self.directions, plane.baseline_mm, strict=True)
            )
            optics = FrameOptics(self._geometry, rows, columns, (plane.depth_mm,), 1, self.spectrum)
        return ExpectedFrames([AccumulatedLight(optics, (light,))], family.lighting, seed=0)

    @property
    def _geometry(self) -> CameraGeometry:
        return self.bench.geometry.model_copy(update={"mask": self.mask})

    @property
    def directions(self) -> tuple[Directions, Directions]:
        rows, columns = (Directions.cells(np.linspace(*edges, self.bench.n + 1)) for edges in self.bench.windows)
        return rows, columns

    @cached_property
    def _optics(self) -> FrameOptics:
        return FrameOptics(self._geometry, *self.directions, (self.bench.geometry.scene_distance,), 1, self.spectrum)


# -------- The bench of a scene, drawn to scale

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
_TINTS = "#ffffff", "#9fd3f2", "#ffb27f", "#8fe0c0", "#f2a8d0", "#d9c2ff", "#e8e28a", "#c4c9cf"
"""White of each surface of the model, so that the legend distinguishes the surfaces."""
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
        return scene_name(self.bench.loaded.path)

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
        ground = {"fc": "white", "ec": "none", "pad": 1}
        axes.text(aligned, high + 0.03 * across, "calibrated plane", ha="center", va="bottom", bbox=ground)
        below_all = low - 0.2 * across  # below the label of the field stop
        _measure(axes, (0, below_all), (aligned, below_all), f"{aligned:.4g} mm")
        axes.set(xlim=(start - 0.4 * length, end + 0.24 * length), ylim=(low - 0.26 * across, high + 0.18 * across))
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
        for number, surface in enumerate(layout.surfaces):
            shown, tint = lightness(surface.reflectance), _TINTS[number % len(_TINTS)]
            color: dict[str, Any] = {"color": _LAMP}
            legend = _LAMP if surface.is_lamp else tint
            if not surface.is_lamp and shown.shape[1] == 1:
                grey, scale = shown[:, 0].astype(np.float32), [[0, "black"], [1, tint]]
                color = {"intensity": grey, "colorscale": scale, "cmin": 0, "cmax": 1, "showscale": False}
            elif not surface.is_lamp:
                color = {"vertexcolor": np.rint(255 * shown).astype(int).tolist()}
                legend = f"rgb{(*np.rint(255 * shown.mean(axis=0)).astype(int).tolist(),)}"
            faces = dict(zip("ijk", surface.triangles.astype(np.int32).T, strict=True))
            # Plotly's legend shows all meshes alike, so that a square without a place stands for each of them.
            square, group = {"color": legend, "symbol": "square", "size": 11}, {"legendgroup": str(number)}
            nowhere = {"mode": "markers", "marker": {**square, "line": {"width": 2}}, **group}
            parts.append((surface.name, np.full((1, 3), np.nan), nowhere))
            parts.append((surface.name, surface.points, {**faces, **color, **group, "showlegend": False}))
        figure = graph_objects.Figure()
        for name, points, style in parts:
            # Plotly's x is the bench's z, and its z, which is up, is y. It reads names, which may be any text, as HTML.
            common = {"name": html.escape(name), **dict(zip("yzx", points.astype(np.float32).T, strict=True)), **style}
            if "i" in style:
                light_on = {"ambient": 0.75, "diffuse": 0.35, "specular": 0.0}
                hover = "%{x:.4g} mm from the sensor<br>x %{y:.4g} mm, y %{z:.4g} mm"
                figure.add_mesh3d(**common, lighting=light_on, flatshading=True, hovertemplate=hover)
            else:
                figure.add_scatter3d(**{"mode": "lines", **common})
        # Plotly makes the sides' geometric mean 1. Therefore the eye moves back for a scene with one long side.
        every = np.concatenate([points for _, points, _ in parts])
        extents = np.nanmax(every, axis=0) - np.nanmin(every, axis=0)
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
                draw(figure.subplots())
            pictures[name] = page_figure(figure)
        model = self.model().update_layout(height=None)  # the page's style sets the height
        return render_page(
            "view.html",
            name=self._name,
            title=subject(self._name, self.bench.sensor.name),
            scene=str(self.bench.loaded.path),
            facts=self.facts,
            warnings=self.warnings,
            model=model.to_html(
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
