"""Provide a projector with a lens of finite aperture for the reference estimator.

Plugin ``mitsim_projector``
---------------------------
An area emitter for a ``disk``, the aperture of a thin lens. A ray that leaves the disk at q in direction w meets the
focus plane, at distance ``focus`` along the axis, in a point that the pinhole projector (same place, axis, field of
view and bitmap) would light with some texel; the ray carries that texel's light. So the picture is sharp on the focus
plane, and elsewhere each of its points is a disk, of radius a |z - focus| / focus on the plane at z.

The aperture has the area A, and a ray at the angle theta to the axis has the radiance::

    L(q, w) = pi scale texture / (A cos(theta)^4)

A point on a plane z = const. gets E = integral over the aperture of L cos(theta)^2 / r^2 with r = z / cos(theta), which
is pi scale / z^2 times the mean of the texture over the aperture's view of the picture: exactly the stock projector's
irradiance where the picture is even, whatever the aperture, and its limit everywhere for a small one.

==============  ========  ========  ==========================================================================
parameter       unit      default   meaning
==============  ========  ========  ==========================================================================
``irradiance``  -         (needed)  texture, the picture; use a raw, nearest, clamped bitmap
``scale``       -         1         irradiance at z = 1 mm is pi x scale x texture
``fov``         degrees   (needed)  full angle of the picture along x, as ``fov_axis`` x of ``projector``
``focus``       mm        (needed)  distance of the sharp plane from the aperture, along the axis
``to_world``    -         identity  rigid transform of the projector; give the disk the same, times its radius
==============  ========  ========  ==========================================================================

XML::

    <shape type="disk">
        <transform name="to_world"> <scale x="2" y="2"/> <translate x="60"/> </transform>
        <bsdf type="diffuse"> <spectrum name="reflectance" value="0"/> </bsdf>
        <emitter type="mitsim_projector">
            <transform name="to_world"> <translate x="60"/> </transform>
            <float name="fov" value="33.398488"/> <float name="scale" value="151250"/> <float name="focus" value="400"/>
            <texture name="irradiance" type="bitmap"> ... </texture>
        </emitter>
    </shape>

"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import integer, stream
from mitsim.transport.plugins.base import Surface

PLUGIN = "mitsim_projector"


def plugin_class() -> type:
    class ApertureProjector(mi.Emitter):  # type: ignore[misc]
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.m_flags = mi.EmitterFlags.Surface | mi.EmitterFlags.SpatiallyVarying
            self.scale = float(props.get("scale", 1.0))
            for name, high in (("focus", math.inf), ("fov", 180)):
                if not 0 < float(props.get(name, 0)) < high:
                    got = f"{props[name]:g}" if name in props else "missing"
                    raise MitsimError(f"{PLUGIN}: {name} is {got}; give a number above 0 and below {high:g}")
            if "irradiance" not in props:
                raise MitsimError(f"{PLUGIN}: irradiance is missing; give a bitmap texture")
            self.focus, self.reach = float(props["focus"]), math.tan(math.radians(float(props["fov"])) / 2)
            self.irradiance = props["irradiance"]
            width, height = self.irradiance.resolution()
            self.aspect = float(width) / float(height)
            self.to_world = mi.Transform4f(props.get("to_world", mi.ScalarAffineTransform4f()).matrix)

        def _radiance(
            self, point: mi.Point3f, direction: mi.Vector3f, wavelengths: mi.Color0f, active: mi.Bool
        ) -> mi.Spectrum:
            inverse = self.to_world.inverse()
            o, d = inverse @ point, inverse @ direction
            active &= d.z > 0
            sharp = o + d * ((self.focus - o.z) / d.z)
            x, y = sharp.x / (self.focus * self.reach), sharp.y * self.aspect / (self.focus * self.reach)
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.uv = mi.Point2f(0.5 - 0.5 * x, 0.5 - 0.5 * y)
            si.wavelengths = wavelengths
            active &= (dr.abs(x) <= 1) & (dr.abs(y) <= 1)
            power = dr.select(active, dr.pi * self.scale * self.irradiance.eval(si, active), 0)
            return dr.select(d.z > 0, power / (self.get_shape().surface_area() * dr.square(dr.square(d.z))), 0)

        def eval(self, si: Surface, active: mi.Bool = True) -> mi.Spectrum:
            active &= si.wi.z > 0
            return mi.depolarizer(self._radiance(si.p, si.to_world(si.wi), si.wavelengths, active))

        def sample_direction(
            self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
        ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
            ds = self.get_shape().sample_direction(it, sample, active)
            active &= (dr.dot(ds.d, ds.n) < 0) & (ds.pdf > 0)
            light = self._radiance(ds.p, -ds.d, it.wavelengths, active) / ds.pdf
            ds.emitter = mi.EmitterPtr(self)
            return ds, mi.depolarizer(light) & active

        def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Float:
            active &= dr.dot(ds.d, ds.n) < 0
            return dr.select(active, self.get_shape().pdf_direction(it, ds, active), 0)

        def eval_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Spectrum:
            active &= dr.dot(ds.d, ds.n) < 0
            return mi.depolarizer(self._radiance(ds.p, -ds.d, it.wavelengths, active))

        def bbox(self) -> mi.BoundingBox3f:
            return self.get_shape().bbox()

        def to_string(self) -> str:
            return f"{PLUGIN}[scale={self.scale}, focus={self.focus}]"

    return ApertureProjector


# -------- A refractive diffuser before a bare sensor
#  Pattern of light that a refractive diffuser before a bare sensor makes of a distant point.
#
# A sheet of glass has a random, smooth relief towards the sensor. For small slopes a ray at x lands at x + d (n - 1)
# grad h(x), with h the thickness, so that the irradiance is 1 / |det(1 + d (n - 1) Hess h)|, summed over all x that
# land there: the caustics of a diffuser.

_RAYS_AT_ONCE = 2**22
_VERTICES = 12


@dataclass(frozen=True, eq=False)
class Relief:
    side_mm: float
    height_mm: FloatArray
    slope_x: FloatArray
    slope_y: FloatArray


def random_relief(side_mm: float, correlation_mm: float, slope: float, seed: int) -> Relief:
    """Draw a normal random surface with the autocorrelation exp(-r^2 / (2 correlation^2)) and an rms slope.

    Raises MitsimError for lengths that do not fit, or a slope that is no small positive number.
    """
    if not (0 < correlation_mm < side_mm / 4 and 0 < slope <= 0.5):
        raise MitsimError(
            f"diffuser of {side_mm:g} mm with correlation {correlation_mm:g} mm and slope {slope:g}: give a "
            "correlation above 0 and below a quarter of the side, and a slope above 0 and up to 0.5"
        )
    # Twice as wide as it is used, so that it does not repeat.
    cells = scipy.fft.next_fast_len(int(np.ceil(2 * side_mm / correlation_mm * _VERTICES)))
    step = 2 * side_mm / cells
    wave = 2 * np.pi * np.fft.fftfreq(cells, step)
    wave_x, wave_y = wave[:, None], wave[None, :]
    noise = scipy.fft.fft2(stream(seed, "diffuser").standard_normal((cells, cells)))
    spectrum = noise * np.exp(-(correlation_mm**2) * (wave_x**2 + wave_y**2) / 4)
    used = slice(0, cells // 2 + 1)
    height, slope_x, slope_y = (
        np.asarray(scipy.fft.ifft2(spectrum * factor).real[used, used]) for factor in (1, 1j * wave_x, 1j * wave_y)
    )
    gain = slope / float(np.sqrt((np.square(slope_x).mean() + np.square(slope_y).mean()) / 2))
    return Relief((cells // 2) * step, height * gain, slope_x * gain, slope_y * gain)


@dataclass(frozen=True, eq=False)
class Diffuser:
    """Sheet of an index at a distance [mm] before a sensor; its caustics resemble those of DiffuserCam."""

    relief: Relief = field(default_factory=lambda: random_relief(6.0, 0.35, 0.05, 0))
    index: float = 1.5
    distance_mm: float = 8.0


def point_spread(
    diffuser: Diffuser, shape: tuple[int, int], pitch_mm: float, rays: int = 4096, seed: int = 0
) -> FloatArray:
    """Return the irradiance (rows, columns) of a distant point behind a diffuser, over that before it.

    ``rays`` is the number along an axis.
    """
    relief, (rows, columns), n = diffuser.relief, shape, diffuser.index
    side, cells = relief.side_mm, len(relief.height_mm) - 1
    light = np.zeros(rows * columns)
    band = max(1, _RAYS_AT_ONCE // rays)
    for first in range(0, rays, band):
        count = min(band, rays - first)
        jitter = stream(integer(seed, "diffuser rays"), first).random((2, count, rays))
        at = (np.arange(first, first + count)[:, None] + jitter[0]) / rays, (np.arange(rays) + jitter[1]) / rays
        height, *slopes = (
            scipy.ndimage.map_coordinates(part, np.multiply(at, cells), order=1)
            for part in (relief.height_mm, relief.slope_x, relief.slope_y)
        )
        # Cosines to the relief's normal in glass and in air, and Fresnel's reflectances of both polarisations.
        glass = 1 / np.sqrt(1 + np.square(slopes).sum(axis=0))
        air = np.sqrt(np.maximum(1 - n**2 * (1 - glass**2), 0))
        reflected = np.square([(n * glass - air) / (n * glass + air), (n * air - glass) / (n * air + glass)])
        part = (1 - reflected.mean(axis=0)) * (1 - ((n - 1) / (n + 1)) ** 2) * (air > 0)
        bend = (diffuser.distance_mm - height) * glass * (n * glass - air) / (air * glass + n * (1 - glass**2))
        y, x = ((place - 0.5) * side + bend * slope for place, slope in zip(at[::-1], slopes[::-1], strict=True))
        row, column = (np.floor(size / 2 - place / pitch_mm) for size, place in ((rows, y), (columns, x)))
        seen = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        index = (row[seen] * columns + column[seen]).astype(np.int64)
        light += np.bincount(index, part[seen], minlength=rows * columns)
    return np.asarray(light.reshape(shape) * (side / rays / pitch_mm) ** 2)
