"""Light of a lamp onto the sensor, over no surface: a scene, its camera and a lamp in; whether it shines there, and how
much of the view it fills, out.

No path runs into a point, spot or directional lamp, few run into a small one that has a surface, and no tracer connects
the sensor itself to either.
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
_SAMPLES = 2**10
"""Points of a lamp: how much of it is seen is known to some percent."""


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
    met = _in_view(camera, ds.d) & (dr.max(mi.unpolarized_spectrum(light)) > 0)
    seen, _ = Passage(scene).between(sensor, ds.p, met)
    return bool(np.array(met & seen).any())


def part_of_view(scene: mi.Scene, camera: mi.Sensor, shape: mi.Shape) -> float:
    """Part of the field stop, in tan-angles, in which the sensor's centre sees a ``shape`` that shines; where nothing
    is before it.

    Parameters
    ----------
    scene, camera, shape
        as of :func:`shines_in`; the side that shines counts.
    """
    _, rng = streams(0, dr.arange(mi.UInt32, _SAMPLES), mi.UInt32(0))
    to_world, place = (
        camera.world_transform(),
        shape.sample_position(0, mi.Point2f(rng.next_float32(), rng.next_float32())),
    )
    sensor = dr.zeros(mi.SurfaceInteraction3f, _SAMPLES)
    sensor.p = to_world @ mi.Point3f(0)
    way = place.p - sensor.p
    distance = dr.norm(way)
    way /= distance
    facing = -dr.dot(place.n, way)
    met = _in_view(camera, way) & (facing > 0)
    seen, _ = Passage(scene).between(sensor, place.p, met)
    # Of dA on the lamp, in solid angle and on the plane at unit distance.
    area = facing / distance**2 / (to_world.inverse() @ way).z ** 3
    total = float(np.array(dr.select(met & seen, area, 0)).mean()) * float(shape.surface_area()[0])
    return total / float(2 * camera.geometry.tan_half_fov) ** 2


def _in_view(camera: mi.Sensor, direction: mi.Vector3f) -> mi.Bool:
    """Whether light from a ``direction`` comes through the field stop."""
    toward = camera.world_transform().inverse() @ direction
    stop = camera.geometry.tan_half_fov * toward.z
    return (dr.abs(toward.x) <= stop) & (dr.abs(toward.y) <= stop)
