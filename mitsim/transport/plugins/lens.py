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

Python: :func:`aperture_scene_parts` turns a stock ``projector`` into such a disk.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.errors import MitsimError
from mitsim.transport.plugins.base import RIGID, rigidity_error
from mitsim.transport.projector import CanvasMap

PLUGIN = "mitsim_projector"


def aperture_scene_parts(projector: mi.Emitter, radius: float, focus: float) -> dict[str, Any]:
    """Return scene parts that replace a stock projector: its aperture as a disk that shines alike.

    Raises MitsimError for a radius or focus [mm] that is not above 0, or a projector without a bitmap or with a scaled
    ``to_world``. The bitmap is taken to be nearest and clamped.
    """
    for name, value in (("radius", radius), ("focus", focus)):
        if not (math.isfinite(value) and value > 0):
            raise MitsimError(f"projector aperture: {name} is {value} mm; give a finite number above 0")
    parameters = mi.traverse(projector)
    if "irradiance.data" not in parameters:
        raise MitsimError("projector aperture: the projector's irradiance is not a bitmap; give it a raw bitmap")
    canvas = CanvasMap.of(projector)
    if rigidity_error(canvas.turn) > RIGID:
        raise MitsimError("projector aperture: the projector's to_world scales or shears; move and turn it only")
    to_world = mi.ScalarAffineTransform4f(
        np.block([[canvas.turn, canvas.origin[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]).tolist()
    )
    emitter = {
        "type": PLUGIN,
        "to_world": to_world,
        "fov": math.degrees(2 * math.atan(abs(float(canvas.x[0])) / 2)),
        "scale": float(np.array(parameters["scale"]).ravel()[0]),
        "focus": float(focus),
        "irradiance": {
            "type": "bitmap",
            "bitmap": mi.Bitmap(np.array(parameters["irradiance.data"])),
            "raw": True,
            "filter_type": "nearest",
            "wrap_mode": "clamp",
        },
    }
    black = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}}
    disk = to_world @ mi.ScalarAffineTransform4f().scale([radius, radius, 1])
    return {"projector_aperture": {"type": "disk", "to_world": disk, "bsdf": black, "emitter": emitter}}


def _number(props: mi.Properties, name: str, low: float, high: float) -> float:
    if name not in props:
        raise MitsimError(f"{PLUGIN}: {name} is missing; give a number above {low:g}")
    value = float(props[name])
    if not low < value < high:
        raise MitsimError(f"{PLUGIN}: {name} is {value:g}; give a number above {low:g} and below {high:g}")
    return value


def plugin_class() -> type:
    class ApertureProjector(mi.Emitter):  # type: ignore[misc]
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.m_flags = mi.EmitterFlags.Surface | mi.EmitterFlags.SpatiallyVarying
            self.scale = float(props.get("scale", 1.0))
            self.focus = _number(props, "focus", 0, math.inf)
            self.reach = math.tan(math.radians(_number(props, "fov", 0, 180)) / 2)
            if "irradiance" not in props:
                raise MitsimError(f"{PLUGIN}: irradiance is missing; give a bitmap texture")
            self.irradiance = props["irradiance"]
            width, height = self.irradiance.resolution()
            self.aspect = float(width) / float(height)
            self.to_world = mi.Transform4f(props.get("to_world", mi.ScalarAffineTransform4f()).matrix)

        def _power(
            self, point: mi.Point3f, direction: mi.Vector3f, wavelengths: mi.Color0f, active: mi.Bool
        ) -> tuple[mi.Spectrum, mi.Float]:
            inverse = self.to_world.inverse()
            o, d = inverse @ point, inverse @ direction
            active &= d.z > 0
            sharp = o + d * ((self.focus - o.z) / d.z)
            x, y = sharp.x / (self.focus * self.reach), sharp.y * self.aspect / (self.focus * self.reach)
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.uv = mi.Point2f(0.5 - 0.5 * x, 0.5 - 0.5 * y)
            si.wavelengths = wavelengths
            active &= (dr.abs(x) <= 1) & (dr.abs(y) <= 1)
            return dr.select(active, dr.pi * self.scale * self.irradiance.eval(si, active), 0), d.z

        def _radiance(
            self, point: mi.Point3f, direction: mi.Vector3f, wavelengths: mi.Color0f, active: mi.Bool
        ) -> mi.Spectrum:
            power, cosine = self._power(point, direction, wavelengths, active)
            return dr.select(cosine > 0, power / (self.get_shape().surface_area() * dr.square(dr.square(cosine))), 0)

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
