"""Direct light over sharp lobes, found from the surface: how much of it there is, and whether connections can see it.

Direct light is found by connecting lit points to the sensor. A connection rarely meets a lobe that is far narrower
than the projector's window: then no estimate holds its light, no spread of estimates tells of it, and the frames would
lack it in silence. Sampled from the surface instead, such a lobe meets the sensor easily. With I the irradiance that a
ray's connection to a sensor point stands for, uniform over the sensor's area A, and q the density [1/mm^2] of meeting
that point by sampling the surface, a met point estimates the mean irradiance by x = I / (A q), and the second moment of
a connection by x I. So N connections see the light L of the lobes as ``N L^2 / E[x I]`` equal hits would.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.rig.camera import CameraGeometry
from mitsim.transport.histogram import check_finite
from mitsim.transport.paths import launches
from mitsim.transport.projector import ProjectorOptics, ProjectorRays
from mitsim.transport.receiver import Receiver, sampled_wavelengths
from mitsim.transport.sampling import panchromatic, streams

_SHARP = 100.0
"""Density [1/sr] of a turn above which its lobe counts as sharp, as a GGX lobe of roughness 0.03 does.

Such a lobe fills 0.01 sr, a tenth of the shipped projector's window: connections from all of it meet broader ones.
"""


@dataclass(frozen=True)
class SharpLight:
    """Light over sharp lobes, mean over the sensor without its mask [W m^-2], and its Monte Carlo ``error``.

    ``hits``: of one connection of every projector pixel, those that would meet a lobe, as far as noise goes.
    """

    irradiance: float
    error: float
    hits: float


def sharp_light(
    scene: mi.Scene, camera: mi.Sensor, projector: ProjectorOptics, geometry: CameraGeometry, seed: int, samples: int
) -> SharpLight:
    """Direct light over lobes too sharp for connections.

    Parameters
    ----------
    scene, camera, projector
        what light meets, the sensor it is received on, and where it comes from.
    geometry
        of the camera.
    seed, samples
        of the random numbers, and rays of every projector pixel.

    Raises
    ------
    MitsimError
        when the scene sends NaN or infinite light to the camera.
    """
    lanes = projector.n**2
    lobes = _Lobes(scene, camera, projector, geometry)
    total = squares = moment = 0.0
    for sample, pixel in launches(lanes, 0, samples):
        mean, connected = lobes.meet(seed, sample, pixel)
        check_finite(mean)
        check_finite(connected)
        total += float(mean.sum())
        squares += float(np.square(mean).sum())
        moment += float((mean * connected).sum())
    error = np.sqrt(max(squares - total**2 / (lanes * samples), 0.0)) / samples
    return SharpLight(total / samples, float(error), total**2 / samples / moment if moment else 0.0)


class _Lobes:
    """Rays of the projector that a sharp lobe of the first surface sends to the sensor."""

    def __init__(
        self, scene: mi.Scene, camera: mi.Sensor, projector: ProjectorOptics, geometry: CameraGeometry
    ) -> None:
        self.scene, self.camera, self.geometry = scene, camera, geometry
        self.rays, self.receiver = ProjectorRays(projector), Receiver(scene, camera, geometry)

    def meet(self, seed: int, sample: mi.UInt32, pixel: mi.UInt32) -> tuple[FloatArray, FloatArray]:
        """Two (lanes,) arrays: estimates x of the mean irradiance, and light I of a connection to the point met."""
        _, rng = streams(seed, pixel, sample)
        jitter = mi.Point2f(rng.next_float32(), rng.next_float32())
        wavelengths, spectral = sampled_wavelengths(self.camera, rng)
        ray = self.rays.sample(pixel, jitter, rng, wavelengths)
        si = self.scene.ray_intersect(ray)
        toward = -ray.d
        si.wi = si.to_local(toward)
        context = mi.BSDFContext(mi.TransportMode.Importance)
        number, point = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        turn, _ = si.bsdf().sample(context, si, number, point, si.is_valid())
        density = si.bsdf().pdf(context, si, turn.wo, si.is_valid())
        active = si.is_valid() & (turn.pdf > 0) & ~mi.has_flag(turn.sampled_type, mi.BSDFFlags.Delta)
        inverse = self.camera.world_transform().inverse()
        start, onward = inverse @ si.p, inverse @ si.to_world(turn.wo)
        reach = -start.z / onward.z
        local = start + onward * reach
        half = dr.opaque(mi.Float, self.geometry.half_width)
        active &= (onward.z < 0) & (reach > 0) & (dr.abs(local.x) <= half) & (dr.abs(local.y) <= half)
        reception = self.receiver.receive(si, toward, mi.Point3f(local.x, local.y, 0), active)
        light = panchromatic(reception.irradiance * self.rays.flux(pixel, wavelengths) * spectral)
        active &= (reception.pdf > dr.opaque(mi.Float, _SHARP)) & (density > 0)
        per_area = density * -onward.z / dr.square(reach)
        mean = dr.select(active, light / (4 * dr.square(half) * per_area), 0)
        light = dr.select(active, light, 0)
        dr.eval(mean, light)
        return np.array(mean, dtype=np.float64), np.array(light, dtype=np.float64)
