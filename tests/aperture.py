"""The stock projector as a lens of some radius: a disk with the plugin ``mitsim_projector``."""

from __future__ import annotations

import math
from typing import Any

import mitsuba as mi
import numpy as np

from mitsim.transport.connect import CanvasMap


def aperture_scene_parts(projector: mi.Emitter, radius: float, focus: float) -> dict[str, Any]:
    """Scene parts that replace a stock projector of a nearest and clamped bitmap: a disk that shines alike [mm]."""
    parameters = mi.traverse(projector)
    canvas = CanvasMap.of(projector)
    to_world = mi.ScalarAffineTransform4f(
        np.block([[canvas.turn, canvas.origin[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]).tolist()
    )
    emitter = {
        "type": "mitsim_projector",
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
