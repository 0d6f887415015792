"""Where light lands that leaves surfaces in known directions: rays in, points of the sensor's plane out.

Light that is sampled from a surface goes where its lobe sends it, through flat glass bent by Snell's law, until it
crosses the plane of the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsim.transport.receiver import Receiver


@dataclass
class Landing:
    """Points (x, y) of the camera's frame [mm], the cosine there, the way's length [mm], and whether light arrives."""

    x: mi.Float
    y: mi.Float
    cosine: mi.Float
    length: mi.Float
    arrives: mi.Bool


def landing(receiver: Receiver, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> Landing:
    """Where light crosses the plane of the sensor from the front; whether something opaque hides it is not asked.

    Parameters
    ----------
    receiver
        the sensor, and the scene with its panes.
    si
        points of surfaces.
    direction
        unit, in which light leaves them.
    active
        lanes that count.
    """
    inverse, passage = receiver.camera.world_transform().inverse(), receiver.passage
    ray, length = mi.Ray3f(si.p, direction, si.time, si.wavelengths), mi.Float(0)

    def further(active: mi.Bool, ray: mi.Ray3f, length: mi.Float) -> tuple[object, ...]:
        met = passage.next_surface(ray, active)
        before = inverse @ met.p
        active &= met.is_valid() & (before.z > 0)
        passed = passage.through(met, ray.d, active)
        active &= dr.max(passed.part) > 0
        beyond = passage.onward(met, passed.direction)
        ray.o, ray.d = dr.select(active, beyond.o, ray.o), dr.select(active, beyond.d, ray.d)
        return active, ray, dr.select(active, length + met.t, length)

    if passage.panes:
        start = passage.onward(si, direction), length
        _, ray, length = dr.while_loop((mi.Bool(active), *start), lambda active, *_: active, further)
    place, onward = inverse @ ray.o, inverse @ ray.d
    reach = -place.z / onward.z
    arrives = active & (onward.z < 0) & (reach > 0)
    return Landing(place.x + onward.x * reach, place.y + onward.y * reach, -onward.z, length + reach, arrives)
