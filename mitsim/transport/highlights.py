"""Highlights of glossy balls: a scene, projector and camera in, what they bring to the sensor and how seldom rays meet
them out.

The light that a ball of radius r sends to a point comes from a spot of some alpha r: rays that are spread over the
projector's window, or over all directions that the ball reflects to, may meet none of many small ones, and nothing
tells of it. Where the spot lies is known, so points are drawn about it, as many in each octave of distance from it, and
what they send to the sensor's centre is added up with the scene's own materials and shadows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray, Labels
from mitsim.devices.camera import CameraGeometry
from mitsim.transport.coordinates import turn_and_origin
from mitsim.transport.plugins.base import channels, lanes_of, per_lane, vectors
from mitsim.transport.projector import PinholeRays, ProjectorOptics, wavelength_sets

_POINTS, _NEAREST = 512, 1e-4
"""Points about each spot, which tell its light to some 5 %, and the angle from its middle that they begin at."""
_MOST_BALLS = 2**12
"""Balls that are looked at, every so many of more: two million points, some 0.5 s."""
_SHARP = 10.0
"""Density [1/sr] of a turn below which its light is left to connections, as in :mod:`mitsim.transport.sharp_lobes`."""
_GOLDEN = math.pi * (3 - math.sqrt(5))
"""Angle by which points about a spot follow each other: evenly spread at any number."""
_FEWEST_MET = 3.0
"""Below so many meetings of all small highlights the pilot may see none, one time in twenty."""
_ON_BALL = 1e-2
"""Distance, in radii, within which a ray has met the point that it was aimed at."""


@dataclass(frozen=True, eq=False)
class Highlights:
    """Light of glossy balls.

    Attributes
    ----------
    pixels
        (k,) projector pixel that each spot lies in.
    irradiance
        (k,) that it brings to the sensor's centre without the mask [W m^-2].
    moments
        (k,) second moment of what one ray of every projector pixel brings of it [W^2 m^-4].
    """

    pixels: Labels
    irradiance: FloatArray
    moments: FloatArray

    def unmet(self, rays: float) -> Highlights:
        """Those that so many ``rays`` of every pixel meet less than once each, and a few times all together; else
        none."""
        seldom = np.square(self.irradiance) * rays < self.moments
        total, moment = float(self.irradiance[seldom].sum()), float(self.moments[seldom].sum())
        if total**2 * rays >= _FEWEST_MET * moment:
            seldom = np.zeros_like(seldom)
        return Highlights(self.pixels[seldom], self.irradiance[seldom], self.moments[seldom])


def highlights(scene: mi.Scene, camera: mi.Sensor, projector: ProjectorOptics, geometry: CameraGeometry) -> Highlights:
    """Highlights of all glossy balls that the projector's pinhole and the sensor's centre both see.

    Parameters
    ----------
    scene, camera, projector
        as loaded.
    geometry
        of the camera.
    """
    balls = [s for s in scene.shapes() if s.class_name() == "Sphere" and s.bsdf() is not None and _glossy(s.bsdf())]
    balls = balls[:: -(-len(balls) // _MOST_BALLS)] if balls else []
    if not balls:
        return Highlights(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    wavelengths = wavelength_sets(projector.lines)
    rays = PinholeRays(projector, wavelengths)
    turn, eye = turn_and_origin(camera.world_transform())
    centre = np.array([np.array(ball.bbox().center(), dtype=np.float64).ravel() for ball in balls])
    radius = np.array([float(np.array(ball.bbox().extents()).max()) / 2 for ball in balls])
    normal = _middles(centre, radius, rays.origin, eye)
    # Angles from the middle, evenly in their logarithm, and about it.
    octaves = math.log(math.pi / 2 / _NEAREST)
    angle = np.asarray(_NEAREST * np.exp(octaves * (np.arange(_POINTS) + 0.5) / _POINTS), dtype=np.float64)
    area = np.sin(angle) * angle * octaves * 2 * math.pi / _POINTS
    points = centre[:, None] + radius[:, None, None] * _about(
        normal, angle, np.asarray(_GOLDEN * np.arange(_POINTS, dtype=np.float64))
    )
    aimed = points.reshape(-1, 3)
    out = aimed - np.repeat(centre, _POINTS, axis=0)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    to, back = aimed - rays.origin, eye - aimed
    far, near = (np.linalg.norm(way, axis=1) for way in (to, back))
    window, depth = rays.points(aimed)
    n = projector.n
    inside = ((window >= 0) & (window < n)).all(axis=1)
    pixel = np.where(
        inside, np.clip(window[:, 0].astype(int), 0, n - 1) * n + np.clip(window[:, 1].astype(int), 0, n - 1), 0
    )
    sent, facing = _sent(scene, rays.origin, aimed, eye, np.repeat(radius, _POINTS))
    local = -back @ turn
    stop = (np.abs(local[:, :2]) <= geometry.tan_half_fov * local[:, 2:]).all(axis=1)
    # Part of the window that each point stands for, by the tangents of one pixel, and what it brings.
    seen = np.tile(area, len(balls)) * np.repeat(radius, _POINTS) ** 2 * np.maximum(facing, 0) * far / depth**3
    received = sent * (local[:, 2] / near) / near**2
    light = rays.power.mean(axis=1)[pixel] * received * (inside & stop)
    each = seen * light
    irradiance, moments = (v.reshape(len(balls), -1).sum(axis=1) for v in (each, each * light * rays.area))
    return Highlights(pixel[::_POINTS], irradiance, moments)


def _glossy(bsdf: mi.BSDF) -> bool:
    return bool(bsdf.flags() & int(mi.BSDFFlags.GlossyReflection))


def _middles(centre: FloatArray, radius: FloatArray, one: FloatArray, other: FloatArray) -> FloatArray:
    """(k, 3) normals of balls where a mirror would turn light from ``one`` place to the ``other``."""
    normal = np.zeros_like(centre)
    for _ in range(50):
        at = centre + radius[:, None] * normal
        ways = [(place - at) / np.linalg.norm(place - at, axis=1, keepdims=True) for place in (one, other)]
        normal = ways[0] + ways[1]
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return normal


def _about(normal: FloatArray, angle: FloatArray, turned: FloatArray) -> FloatArray:
    """(k, p, 3) directions at (p,) angles from normals (k, 3), ``turned`` about them."""
    helper = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    across = np.cos(turned)[:, None] * first[:, None] + np.sin(turned)[:, None] * second[:, None]
    return np.asarray(np.cos(angle)[:, None] * normal[:, None] + np.sin(angle)[:, None] * across)


def _sent(
    scene: mi.Scene, origin: FloatArray, aimed: FloatArray, eye: FloatArray, radius: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(k,) light that sharp lobes at points send to the ``eye`` [1/sr], mean over channels, and cosines of what comes
    to them; 0 where either way is blocked."""
    to = aimed - origin
    ray = mi.Ray3f(mi.Point3f(origin.tolist()), mi.Vector3f(*lanes_of(to / np.linalg.norm(to, axis=1, keepdims=True))))
    si = scene.ray_intersect(ray)
    target = mi.Point3f(eye.tolist())
    context = mi.BSDFContext(mi.TransportMode.Importance)
    way = si.to_local(dr.normalize(target - si.p))
    active = si.is_valid() & ~scene.ray_test(si.spawn_ray_to(target))
    value, density = si.bsdf().eval_pdf(context, si, way, active)
    count = len(aimed)
    light = channels(mi.unpolarized_spectrum(dr.select(active & (density > _SHARP), value, 0)), count).mean(axis=1)
    met = np.linalg.norm(vectors(si.p, count) - aimed, axis=1) < _ON_BALL * radius + 1e-4 * np.abs(aimed).max(axis=1)
    return light * met, per_lane(dr.abs(mi.Frame3f.cos_theta(si.wi)), count)
