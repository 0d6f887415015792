"""Plugin ``mitsim_ies``: a small lamp with a measured angular distribution, an IES profile (ANSI/IES LM-63-19).

==============  =========  =========  =================================================================================
parameter       unit       default    meaning
==============  =========  =========  =================================================================================
``filename``    -          (needed)   profile of photometric type C without tilt; only its shape counts
``intensity``   W/sr       1          radiant intensity where the profile is largest; a number, colour or spectrum
``to_world``    -          identity   place and direction; vertical angles begin at +z, horizontal ones turn from +x to
                                      +y
==============  =========  =========  =================================================================================

Candelas are interpolated linearly in both angles; beyond the vertical angles of the file there is no light. Light over
mirrors and glass is found as that of ``spot``.

XML::

    <emitter type="mitsim_ies"> <string name="filename" value="lamp.ies"/> <float name="intensity" value="2e4"/>
        <transform name="to_world"> <lookat origin="0, 300, 0" target="0, 0, 400" up="1, 0, 0"/> </transform>
    </emitter>
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.scene.headers import read_ies
from mitsim.transport.plugins.base import Surface

PLUGIN = "mitsim_ies"
_PER_TURN, _PER_HALF = 721, 361
"""Angles of half a degree, which files rarely subdivide."""


def plugin_class() -> type:
    class IesLamp(mi.Emitter):  # type: ignore[misc]
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.m_flags = mi.EmitterFlags.DeltaPosition | mi.EmitterFlags.SpatiallyVarying
            self.file = str(mi.file_resolver().resolve(mi.filesystem.path(props["filename"])))
            vertical, horizontal, candela = read_ies(Path(self.file))
            profile = np.float32(even_profile(vertical, horizontal, candela / candela.max()))
            self.profile = mi.MarginalContinuous2D0(profile, [], False, False)
            self.intensity = props.get_emissive_texture("intensity", 1.0)
            self.place = mi.Transform4f(props.get("to_world", mi.ScalarAffineTransform4f()).matrix)

        def traverse(self, callback: mi.TraversalCallback) -> None:
            callback.put("to_world", self.place, mi.ParamFlags.NonDifferentiable)
            callback.put("intensity", self.intensity, mi.ParamFlags.Differentiable)

        def sample_direction(
            self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
        ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
            ds = dr.zeros(mi.DirectionSample3f)
            ds.p = self.place @ mi.Point3f(0)
            ds.d, ds.time, ds.delta, ds.pdf = ds.p - it.p, it.time, True, 1
            ds.dist = dr.norm(ds.d)
            ds.d /= ds.dist
            ds.emitter = mi.EmitterPtr(self)
            return ds, self.eval_direction(it, ds, active)

        def eval_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Spectrum:
            way = self.place.inverse() @ -ds.d
            turn = dr.atan2(way.y, way.x) / (2 * dr.pi)
            vertical = dr.atan2(dr.sqrt(dr.square(way.x) + dr.square(way.y)), way.z) / dr.pi
            part = self.profile.eval(mi.Point2f(vertical, turn - dr.floor(turn)), active=active)
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.wavelengths = it.wavelengths
            light = self.intensity.eval(si, active) * part / dr.square(ds.dist)
            return mi.depolarizer(dr.select(active, light, 0))

        def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Float:
            return mi.Float(0)

        def eval(self, si: Surface, active: mi.Bool = True) -> mi.Spectrum:
            return mi.Spectrum(0)

        def bbox(self) -> mi.BoundingBox3f:
            return mi.ScalarBoundingBox3f()

        def to_string(self) -> str:
            return f"{PLUGIN}[{self.file}]"

    return IesLamp


def even_profile(vertical: Any, horizontal: Any, candela: Any) -> Any:
    """Return candelas by horizontal (0 to 360 degrees) and vertical angle (0 to 180), each half a degree.

    ``candela`` is given by horizontal and vertical angle. Files that end at 0, 90 or 180 degrees are symmetric.
    """
    turn = np.linspace(0, 360, _PER_TURN)
    end = horizontal[-1]
    if end <= 180:
        turn = np.minimum(turn, 360 - turn)
    if end <= 90:
        turn = np.minimum(turn, 180 - turn)
    down = np.linspace(0, 180, _PER_HALF)
    rows = np.stack([np.interp(down, vertical, row, left=0, right=0) for row in candela])
    return np.stack([np.interp(turn, horizontal, column) for column in rows.T], axis=1)
