"""A projector of finite aperture for the reference estimator: from a stock pinhole projector to a lens that blurs.

Plugin ``mitsim_projector``
---------------------------
An area emitter for a ``disk``, the aperture of a thin lens. A ray that leaves the disk at q in direction w meets the
focus plane, at distance ``focus`` along the axis, in a point that the pinhole projector (same place, axis, field of
view and bitmap) would light with some texel; the ray carries that texel's light. So the picture is sharp on the focus
plane, and elsewhere each of its points is a disk, of radius a |z - focus| / focus on the plane at z.

Radiance, with A the aperture's area and theta the angle of the ray itself to the axis::

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

import drjit as dr
import mitsuba as mi

from mitsim.core.errors import MitsimError

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

        def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
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
