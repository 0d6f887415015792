"""The reference estimator: a Mitsuba sensor, from rays leaving a bare sensor to irradiance behind a coded mask.

Plugin ``mitsim_lensless``
--------------------------
Irradiance at sensor point u, in the units of the scene's radiance times steradian (W m^-2 for W m^-2 sr^-1)::

    E(u) = integral of  L(u, t) M(u + d t) M(u + (d + h) t) cos^n(theta) (1 + |t|^2)^-2  dt

over t = (x/z, y/z) inside the field stop; M is the mask's transmission, d its distance, h its thickness (both faces
count, a thin mask has one), cos^n a pixel's angular response, and the last factor is cos(theta) d omega written in t. A
sample draws u inside its pixel's active square and a place where the mask's near face is open, evenly among all that
the field stop shows from u, which makes t. It traces the ray from u and
returns weight p M(u + (d + h) t) cos^n (1 + |t|^2)^-2 (2 T)^2 times the fill factor, with T = tan(fov / 2) and p the
part of the field stop that is open: irradiance is per pixel area. With t drawn over the whole field stop three of four
rays would end at a separable mask. Where a plate is not open in a few grids, the place is drawn from a rectangle that
holds all that is open, and M(u + d t) is one more factor of the weight; a tilted mask is met where the ray crosses its
plane, a blurred one at a place moved at random by a normal deviate. The mask is a factor, not geometry: thin geometry
suffers from Mitsuba's ray epsilon and blocks connections to delta lights. Diffraction is the factored estimator's: here
light travels along rays.

The local frame is Mitsuba's: origin at the sensor's centre, +z to the scene, +y up, +x to the left of one who looks
along +z. Image row 0 is at +y and column 0 at +x, so a frame shows the scene as one sees it looking along +z.

======================  ========  ==========  =================================================================
parameter               unit      default     meaning
======================  ========  ==========  =================================================================
``pixel_pitch``         mm        0.01172     pixel pitch; the film's size gives the number of pixels,
                                              and its crop window a region of interest
``row_pitch``           mm        -           distance between rows, where pixels are not square
``mask``                -         separable   ``separable``, ``flatcam`` or ``open``; a camera file may give others
``mask_order``          -         9           order of the maximum length sequence (2^order - 1 features a side)
``mask_feature``        mm        0.06        feature size
``mask_distance``       mm        2           sensor to mask (the face next to the sensor)
``mask_thickness``      mm        0           mask thickness; 0 is a thin mask
``mask_offset_row``     mm        0           the mask's centre off the axis, down the rows (toward -y)
``mask_offset_column``  mm        0           the same along the columns (toward -x)
``scene_distance``      mm        400         plane that the bench is aligned to (calibration board, cell grid)
``fov``                 degrees   20          full angle of the square field stop, a baffle: no light beyond it
``pixel_fill_factor``   -         1           active part of a pixel, a centred square
``angular_exponent``    -         0           a pixel responds as cos(theta) to this power; 0 is no angular response
``to_world``            -         identity    rigid transform of the camera
======================  ========  ==========  =================================================================

XML::

    <sensor type="mitsim_lensless">
        <float name="mask_distance" value="2"/>
        <film type="hdrfilm">
            <integer name="width" value="512"/> <integer name="height" value="512"/>
            <rfilter type="box"/> <string name="pixel_format" value="luminance"/>
        </film>
    </sensor>

Python: ``register(); mi.load_dict({"type": "scene", "camera": {"type": "mitsim_lensless", "mask": "open"}, ...})``.

Nothing else is sampled by importance: the reference is the judge, and simple enough to check by eye.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.configuration import validate
from mitsim.core.environment import device_array
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask import BoolArray, Flaws, Plate
from mitsim.transport.plugins import base

PLUGIN = "mitsim_lensless"
_RIGID = 1e-4
"""Largest departure of R^T R from 1: matrices of five digits pass, a scale of 1.0001 does not."""
_BOX_RADIUS = 0.5 + 1e-4
"""Radius [pixels] of a filter that keeps light in its pixel; Mitsuba's box states 0.5 in float32."""


def plugin_class() -> type:
    class Lensless(mi.Sensor):  # type: ignore[misc]
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.m_needs_sample_3 = True
            if self.film().rfilter().radius() > _BOX_RADIUS:
                raise MitsimError(
                    f"{PLUGIN}: the film's filter spreads light between pixels; use <rfilter type='box'/>"
                )
            turn, origin = base.turn_and_origin(self.world_transform())
            error = float(np.abs(turn.T @ turn - np.eye(3)).max())
            finite = np.isfinite(turn).all() and np.isfinite(origin).all()
            if not (finite and error < _RIGID and np.linalg.det(turn) > 0):
                raise MitsimError(
                    f"{PLUGIN}: to_world is no rotation and translation (it scales, shears or mirrors: R^T R is "
                    f"{error:.2g} from 1); lengths are mm everywhere, so move and turn the camera only"
                )
            self._points: tuple[int, int] | None = None
            film, of_film = self.film(), ("pixels", "rows", "columns", "roi")
            values = {
                name: props[name] for name in CameraGeometry.model_fields if name not in of_film and name in props
            }
            parts = film.size(), film.crop_offset(), film.crop_size()
            (columns, rows), first, shown = ([*map(int, part)] for part in parts)
            if rows != columns:
                values |= {"rows": rows, "columns": columns}
            if shown != [columns, rows]:
                values["roi"] = first[1], first[0], shown[1], shown[0]
            self.wear(validate(CameraGeometry, {"pixels": max(rows, columns), **values}, PLUGIN))

        def wear(self, geometry: CameraGeometry) -> None:
            self.geometry = geometry
            mask = geometry.build_mask()
            self._openings = [(OpenAxis(rows), OpenAxis(columns)) for rows, columns in mask.openings]
            self._feature = mask.feature_mm
            self._features = self._cover = round(mask.extent_mm / mask.feature_mm)
            self._terms, self._values = [], None
            self._whole = isinstance(mask, Plate) and mask.grids is None
            self._lines, self._flaws = None, Flaws()
            if isinstance(mask, Plate):
                self._values, self._flaws = device_array(mi.Float, mask.values), mask.flaws
                if not mask.plain:
                    self._features, self._cover = len(mask.values), mask.cover
                    self._lines = device_array(mi.Float, mask.lines)
                return
            for weight, rows, columns in mask.terms:
                self._terms.append((weight, *(device_array(mi.Float, each) for each in (rows, columns))))

        def stratify(self, points: tuple[int, int] | None) -> None:
            """Draw u and t of each pixel from Sobol points scrambled by (seed, paths a pixel); None: at random."""
            self._points = points

        def sample_ray(
            self, time: mi.Float, sample1: mi.Float, sample2: mi.Point2f, sample3: mi.Point2f, active: mi.Bool = True
        ) -> tuple[mi.Ray3f, mi.Spectrum]:
            geometry = self.geometry
            wavelengths, spectral_weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
            if self._points:
                rows, columns = geometry.frame_shape
                count, (seed, paths) = mi.Point2f(columns, rows), self._points
                place = dr.minimum(dr.floor(sample2 * count), count - 1)
                pixel = mi.UInt32(place.y) * columns + mi.UInt32(place.x)
                rng = base.generator(dr.opaque(mi.UInt32, seed), pixel)
                index = dr.arange(mi.UInt32, dr.width(sample2)) % dr.opaque(mi.UInt32, paths)
                sample2 = (place + base.sobol_point(index, rng)) / count
                sample3 = base.sobol_point(base.shuffle(index, rng), rng)
            # ---- u: in the region of interest, and in the active part of its pixel
            if geometry.roi is not None:
                roi, whole = geometry.roi, geometry.shape
                first, shown, whole = (mi.Point2f(part[1], part[0]) for part in (roi[:2], roi[2:], whole))
                sample2 = (first + sample2 * shown) / whole
            if geometry.pixel_fill_factor != 1:
                count = mi.Point2f(geometry.shape[1], geometry.shape[0])
                middle = (dr.floor(sample2 * count) + 0.5) / count
                sample2 = middle + (sample2 - middle) * (geometry.active_sides[1] / geometry.pixel_pitch)
            height, width = geometry.half_sides
            u = (1 - 2 * sample2) * mi.Point2f(width, height)
            # ---- t: toward an open place of what the field stop shows, in features from the mask's first corner
            stop, side = geometry.tan_half_fov, self._feature
            corner = [
                (start - stop * geometry.mask_distance - centre) / side + 0.5 * self._cover
                for start, centre in zip(base.rows_columns(u.x, u.y), geometry.mask_offset, strict=True)
            ]
            view = 2 * stop * geometry.mask_distance / side
            row, column, weight = draw_opening(self._openings, mi.Point2f(*corner), view, sample3)
            t = mi.Vector2f(*base.x_y(*(place * (2 * stop / view) - stop for place in (row, column))))
            squared = 1 + dr.squared_norm(t)
            if self._whole:
                weight *= self._transmission(self._crossing(u, t, sample3), active)
            if geometry.mask_thickness:
                weight *= self._transmission(u + (geometry.mask_distance + geometry.mask_thickness) * t, active)
            if geometry.angular_exponent:
                weight *= squared ** (-geometry.angular_exponent / 2)
            weight *= geometry.pixel_fill_factor * (2 * geometry.tan_half_fov) ** 2 / dr.square(squared)
            to_world = self.world_transform()
            ray = mi.Ray3f(
                to_world @ mi.Point3f(u.x, u.y, 0),
                to_world @ (mi.Vector3f(t.x, t.y, 1) * dr.rsqrt(squared)),
                time,
                wavelengths,
            )
            return ray, spectral_weight * weight

        def sample_ray_differential(
            self, time: mi.Float, sample1: mi.Float, sample2: mi.Point2f, sample3: mi.Point2f, active: mi.Bool = True
        ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
            ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
            return mi.RayDifferential3f(ray), weight

        def _crossing(self, u: mi.Point2f, t: mi.Vector2f, sample: mi.Point2f) -> mi.Point2f:
            distance, flaws = self.geometry.mask_distance, self._flaws
            if any(flaws.tilt_mrad):
                tilt = mi.Vector2f(*base.x_y(*(float(np.tan(angle * 1e-3)) for angle in flaws.tilt_mrad)))
                centre = mi.Point2f(*base.x_y(*self.geometry.mask_offset))
                along = (distance + dr.dot(tilt, u - centre)) / (1 - dr.dot(tilt, t))
                # A length along the tilted plane is longer than its projection on the even one.
                point = (u + along * t - centre) * dr.sqrt(1 + dr.square(tilt)) + centre
            else:
                point = u + distance * t
            if flaws.blur_mm:
                bits = [dr.reinterpret_array(mi.UInt32, mi.Float32(number)) for number in (sample.x, sample.y)]
                rng = base.generator(*bits)
                moved = mi.Point2f(rng.next_float32(), rng.next_float32())
                point += flaws.blur_mm * mi.warp.square_to_std_normal(moved)
            return point

        def _transmission(self, point: mi.Point2f, active: mi.Bool) -> mi.Float:
            centre, count = self.geometry.mask_offset, self._features
            row, column = (s - off for s, off in zip(base.rows_columns(point.x, point.y), centre, strict=True))
            if self._lines is None:
                row, column = (dr.floor(s / self._feature + 0.5 * count) for s in (row, column))
            else:
                lines, angle = self._lines, np.radians(self._flaws.turn_deg)
                if angle:
                    cosine, sine = float(np.cos(angle)), float(np.sin(angle))
                    row, column = cosine * row + sine * column, cosine * column - sine * row
                row, column = (
                    mi.Float(dr.binary_search(0, count + 1, lambda k, s=s: dr.gather(mi.Float, lines, k) <= s)) - 1
                    for s in (row, column)
                )
            inside = (row >= 0) & (row < count) & (column >= 0) & (column < count) & active
            row, column = mi.UInt32(dr.maximum(row, 0)), mi.UInt32(dr.maximum(column, 0))
            if self._values is not None:
                return dr.gather(mi.Float, self._values, row * count + column, inside)
            total = mi.Float(0)
            for weight, rows, columns in self._terms:
                left = dr.gather(mi.Float, rows, row, inside)
                total += weight * left * dr.gather(mi.Float, columns, column, inside)
            return total

        def bbox(self) -> mi.ScalarBoundingBox3f:
            return mi.ScalarBoundingBox3f()

        def to_string(self) -> str:
            return f"{PLUGIN}[{self.geometry}]"

    return Lensless


# -------- Openings of a mask
#
# A mask is a sum of grids that do not overlap (mitsim.devices.mask.Mask.openings): open where both its row and its
# column are. On each axis the open length up to a coordinate is piecewise linear and so is its inverse, which makes a
# random number a place: whatever rows are open, those within the range are met in proportion to their length.


class OpenAxis:
    def __init__(self, bits: BoolArray) -> None:
        self._size = len(bits)
        # Once more at the end, and a place that is not there after the last one: nothing is open beyond the mask.
        before = np.cumsum(np.concatenate([[0], bits, [0]]))
        self._before = device_array(mi.UInt32, before)
        self._places = device_array(mi.UInt32, np.append(np.flatnonzero(bits), len(bits)))

    def open_within(self, low: mi.Float, width: float) -> tuple[mi.Float, Callable[[mi.Float], mi.Float]]:
        """Return the open length of a part of the axis, and the function that makes a random number an open place."""

        def opened(index: mi.UInt32) -> tuple[mi.UInt32, mi.Float]:
            before = dr.gather(mi.UInt32, self._before, index)
            return before, mi.Float(dr.gather(mi.UInt32, self._before, index + 1) - before)

        # From the feature that holds its start: the width of a narrow view keeps its digits.
        start = mi.UInt32(dr.clip(low, 0, self._size))
        within = low - mi.Float(start)
        last = dr.clip(within + width, 0, self._size - mi.Float(start))
        end = mi.UInt32(last)
        (before, first), (after, tail) = opened(start), opened(start + end)
        skipped = first * dr.maximum(within, 0)
        length = dr.maximum(mi.Float(after - before) + tail * (last - mi.Float(end)) - skipped, 0)

        def draw(number: mi.Float) -> mi.Float:
            place = skipped + number * length
            whole = mi.UInt32(place)
            feature = dr.gather(mi.UInt32, self._places, dr.minimum(before + whole, dr.width(self._places) - 1))
            return (mi.Float(feature) - mi.Float(start)) + (place - mi.Float(whole)) - within

        return length, draw


def draw_opening(
    grids: Sequence[tuple[OpenAxis, OpenAxis]], corner: mi.Point2f, width: float, number: mi.Point2f
) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Draw an open place of a square window uniformly; return its row and column, and the open part of the window.

    The place is undefined where the part is 0. For a plate without grids the place lies in a rectangle of all openings.
    """
    seen = [(rows.open_within(corner.x, width), columns.open_within(corner.y, width)) for rows, columns in grids]
    areas = [length * other for (length, _), (other, _) in seen]
    total = sum(areas[1:], areas[0])
    left, chosen = number.y * total, list[mi.Float]()
    for index, (((_, row), (_, column)), area) in enumerate(zip(seen, areas, strict=True)):
        if index:
            further, left = left >= areas[index - 1], left - areas[index - 1]
        place = [row(number.x), column(dr.select(area > 0, left / area, 0))]
        if index:
            place = [dr.select(further, new, old) for new, old in zip(place, chosen, strict=True)]
        chosen = place
    row, column = (dr.clip(place, 0, width) for place in chosen)
    return row, column, total / width**2
