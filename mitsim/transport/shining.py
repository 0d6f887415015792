"""Light of a lamp onto the sensor, over no surface: a scene, its camera and a small lamp in, whether there is some out.

No path runs into a point, spot or directional lamp, and no tracer connects the sensor itself to one.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.transport.passage import Passage
from mitsim.transport.receiver import sampled_wavelengths
from mitsim.transport.sampling import streams

_POINTS = 9
"""Points along each side of the sensor, its edges with them: things in the way are larger than an eighth of it."""


def shines_in(scene: mi.Scene, camera: mi.Sensor, lamp: mi.Emitter) -> bool:
    """Whether a point of the sensor sees the ``lamp`` within the field stop.

    Parameters
    ----------
    scene, camera
        what may stand in the way, and the sensor.
    lamp
        a point, spot or directional one.
    """
    edge = np.linspace(-1, 1, _POINTS) * camera.geometry.half_width
    x, y = (mi.Float(axis.ravel()) for axis in np.meshgrid(edge, edge))
    to_world, sensor = camera.world_transform(), dr.zeros(mi.SurfaceInteraction3f, _POINTS**2)
    sensor.p = to_world @ mi.Point3f(x, y, 0)
    _, rng = streams(0, dr.arange(mi.UInt32, _POINTS**2), mi.UInt32(0))
    sensor.wavelengths, _ = sampled_wavelengths(camera, rng)
    ds, light = lamp.sample_direction(sensor, mi.Point2f(0.5), True)
    toward = to_world.inverse() @ ds.d
    stop = camera.geometry.tan_half_fov * toward.z
    met = (dr.abs(toward.x) <= stop) & (dr.abs(toward.y) <= stop) & (dr.max(mi.unpolarized_spectrum(light)) > 0)
    seen, _ = Passage(scene).between(sensor, ds.p, met)
    return bool(np.array(met & seen).any())
