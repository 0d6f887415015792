"""Shipped scenes as Mitsuba sees them, for tests of what their files say."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.environment import load_variant

SCENES = Path(__file__).parents[1] / "scenes"


@cache
def opened(name: str) -> tuple[Any, Any]:
    """Mitsuba and the scene, through mitsim's own checks."""
    mi = load_variant("llvm_ad_mono")
    from mitsim.scene.load import load_scene
    from mitsim.transport import plugins

    plugins.register()
    return mi, load_scene(SCENES / name / "scene.xml").scene


def emitter(scene: Any, kind: str) -> Any:
    """The one emitter of a class."""
    (found,) = (emitter for emitter in scene.emitters() if emitter.class_name() == kind)
    return found


def projected(mi: Any, scene: Any, x: list[float], y: list[float], z: float) -> tuple[np.ndarray, np.ndarray]:
    """Projector uv (2, k) at points (x, y, z), and irradiance (k,) on the plane z = const there."""
    import drjit as dr

    point = dr.zeros(mi.SurfaceInteraction3f, len(x))
    point.p = mi.Point3f(mi.Float(x), mi.Float(y), mi.Float(z))
    sample, weight = emitter(scene, "Projector").sample_direction(point, mi.Point2f(0.5), True)
    return np.array(sample.uv), np.array(weight[0] * dr.abs(sample.d.z))
