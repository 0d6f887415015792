"""Light that tracers find seldom or never: a scene and its projector in, how much of it there is and whose out.

Light that mirrors or curved glass bring both from the projector to a surface and from there to the camera (a print in a
bottle), and the part of indirect light that is followed from the camera to a caustic: a path from the camera meets no
pinhole, and none from the projector the sensor's centre. A small lens in the pinhole's place casts the same light, and
paths run into it. A lens of the projector's own they run into as well, but seldom where it is smaller.

So do paths over one mirror and one sharp lobe. Connections may meet such a lobe by chance: of the projector's side from
the lobe to the sensor, of the camera's side from the lobe, seen in a mirror, to the projector. With x the light of a
path that runs into the lens and I that of the connection along the same way, E[x I] is a connection's second moment, so
a sample of connections sees the light L of a shape's lobes as ``L^2 / E[x I]`` equal hits would
(:mod:`mitsim.transport.sharp_lobes`). Whether that is enough, whoever asks knows: lobes of curved surfaces are met
seldom however broad they are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray, Labels
from mitsim.transport.connect import LensHit, OpticalSetup, sample_wavelengths
from mitsim.transport.from_camera import CameraPaths, CameraState, FromCameraTracer
from mitsim.transport.integrator import InFlight, Paths, Turn, camera_part
from mitsim.transport.plugins.base import channels, device_vectors, host_values, turn_and_origin, vectors
from mitsim.transport.projector import PinholeRays, wavelength_sets
from mitsim.transport.records import DIRECT, INDIRECT, CellGrid, PathSamples, Sightings
from mitsim.transport.sampler import panchromatic, streams
from mitsim.transport.transmission import Passage

_LENS = 0.02
"""Radius of the lens over the scene's distance: 8 mm at 400, which one path in 3000 meets from a matt surface."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Light that is left out, by the place among the scene's shapes of what it comes over, (k,) each.

    Attributes
    ----------
    mirrors, lens_hits
        irradiance at the sensor's centre [W m^-2] that no connection finds, by the last mirror or glass, seen from the
        camera; equal hits of the projector's own lens that a sample of paths makes.
    lobes, hits
        irradiance over a mirror and one sharp lobe, by the shape that has the lobe; equal hits that a sample of
        connections makes.
    """

    mirrors: FloatArray
    lens_hits: FloatArray
    lobes: FloatArray
    hits: FloatArray

    @classmethod
    def none(cls) -> LeftOut:
        """Nothing."""
        return cls(*np.zeros((4, 0)))

    def unseen(self, fewest: float, of_lens: float) -> tuple[float, int | None]:
        """Irradiance that nothing tells of, and over which shape most of it comes.

        ``fewest``: hits of a sample that tell of a lobe; ``of_lens``: of the projector's own lens, that tell of light.
        """
        light = np.where(self.lens_hits < of_lens, self.mirrors, 0) + np.where(self.hits < fewest, self.lobes, 0)
        return float(light.sum()), int(np.argmax(light)) if light.any() else None


def left_out_light(setup: OpticalSetup, grid: CellGrid, seed: int, samples: int) -> LeftOut:
    """Light that is left out, or may be.

    Parameters
    ----------
    setup
        scene, camera and projector.
    grid
        cells that paths start in.
    seed, samples
        of the random numbers, and paths of each cell.

    Raises
    ------
    MitsimError
        when the scene sends NaN or infinite light to the camera.
    """
    far = setup.geometry.scene_distance
    lens = replace(setup.projector, aperture=_LENS * far, focus=far)
    paths = Paths(mirrors=True, interreflection=True)
    found = _MissedTracer(replace(setup, projector=lens), grid, paths).trace(seed, 0, samples)
    # Path samples name shapes by their number in Dr.Jit's registry.
    numbers = np.array(dr.reinterpret_array(mi.UInt32, setup.scene.shapes_dr())).astype(np.int64)

    def by_shape(light: PathSamples, values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(light.pixel, values, int(numbers.max()) + 1)[numbers] / samples)

    lost, met = (found.where(found.kind == kind) for kind in (INDIRECT, DIRECT))
    mirrors, hits = _equal_hits(by_shape(lost, lost.value), by_shape(lost, np.square(lost.value)))
    # A lens of half the radius is met a quarter as often, and four times as bright.
    seldom = np.square(setup.projector.aperture / lens.aperture)
    return LeftOut(mirrors, hits * seldom, *_equal_hits(by_shape(met, met.value), by_shape(met, met.value * met.row)))


def _equal_hits(light: FloatArray, moments: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``light`` (k,) by shape, and from the second ``moments`` of a sample how many equal hits it is."""
    return light, np.divide(np.square(light), moments, out=np.zeros(len(light)), where=light > 0)


class _MissedTracer(FromCameraTracer):
    """Light that a lens would bring, filed under shapes: that which no connection finds as indirect light, that over a
    mirror and a lobe as direct light, with what a connection brings in the row's stead."""

    def _paths(self, flight: InFlight) -> _MissedPaths:
        return _MissedPaths(self, flight)


@dataclass(kw_only=True)
class _MissedState(CameraState):
    """``mirror`` and ``lobe`` are the last shape of either kind that a path met, ``density`` that of the turn there."""

    mirror: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))
    lobe: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))
    density: mi.Float = field(default_factory=lambda: mi.Float(0))


class _MissedPaths(CameraPaths[_MissedState]):
    """Paths from the camera that only running into the lens can end."""

    def __init__(self, tracer: FromCameraTracer, flight: InFlight) -> None:
        super().__init__(tracer, _MissedState, flight)
        self._rays = tracer.setup.rays  # made before the loop, in which nothing can be evaluated

    def _connect(self, paths: _MissedState, si: mi.SurfaceInteraction3f, first: bool) -> None:
        """Nothing: what connections find is not left out."""

    def _hit_lens(self, paths: _MissedState, si: mi.SurfaceInteraction3f) -> None:
        """Light that mirrors bring from the lens to the last surface, or over a mirror and a sharp lobe."""
        lost = self._is_foreign(paths) & paths.by_delta
        once = paths.active & (paths.scattered == 1) & (paths.in_mirror != paths.by_delta)
        met = once & (camera_part(paths.density) > 0)
        hit = self.connector.hit(paths.ray, si.t, paths.rng, lost | met, paths.since)
        light, none, by_line = self._irradiance(paths, hit.radiance), mi.Float(0), self.by_line
        missed = dr.select(hit.met & lost, light * paths.part, 0)
        self._join(paths, "indirect", Sightings.of(missed, by_line, paths.mirror, none, none, none))
        met &= hit.met
        in_mirror = panchromatic(light) * paths.density / hit.pdf
        connected = dr.select(met, dr.select(paths.in_mirror, in_mirror, self._projector_light(paths, hit)), 0)
        self._join(paths, "direct", Sightings.of(dr.select(met, light, 0), by_line, paths.lobe, connected, none, none))

    def _projector_light(self, paths: _MissedState, hit: LensHit) -> mi.Float:
        """What a connection of the projector's side, from the first surface to the sensor, brings [W m^-2]."""
        grid = self.tracer.grid
        flux = self._rays.flux(hit.pixel, paths.ray.wavelengths)
        # The path's weight without its part of the view; its first surface is at 1 / (inverse depth * slope).
        view = dr.opaque(mi.Float, grid.rows.size * grid.columns.size) * dr.square(dr.square(self.slope))
        distance = paths.inverse_depth * self.slope
        return panchromatic(self._irradiance(paths, flux)) / view * paths.density * self.slope * dr.square(distance)

    def _note_turn(self, paths: _MissedState, si: mi.SurfaceInteraction3f, turn: Turn, first: bool) -> mi.Bool:
        going = super()._note_turn(paths, si, turn, first)
        shape = dr.reinterpret_array(mi.UInt32, dr.select(si.instance != None, si.instance, si.shape))  # noqa: E711
        turned = ~turn.passing & ~paths.by_delta
        paths.mirror = dr.select(~turn.passing & paths.by_delta, shape, paths.mirror)
        paths.lobe = dr.select(turned, shape, paths.lobe)
        paths.density = dr.select(turned, paths.came_pdf, paths.density)
        return going


def polished_shapes(scene: mi.Scene) -> tuple[int, ...]:
    """Places, among the shapes of a ``scene``, of those that reflect or bend light into single directions."""
    polished = int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.DeltaTransmission)
    shapes = enumerate(scene.shapes())
    return tuple(number for number, shape in shapes if shape.bsdf() is not None and shape.bsdf().flags() & polished)


# -------- Light of a lamp onto the sensor, over no surface
#
# No path runs into a point, spot or directional lamp, few run into a small one that has a surface, and no tracer
# connects the sensor itself to either.

_SENSOR_POINTS = 9
"""Points along each side of the sensor, its edges with them: things in the way are larger than an eighth of it."""
_LAMP_POINTS = 2**10
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
    edge = np.linspace(-1, 1, _SENSOR_POINTS) * camera.geometry.half_width
    x, y = (mi.Float(axis.ravel()) for axis in np.meshgrid(edge, edge))
    to_world, sensor = camera.world_transform(), dr.zeros(mi.SurfaceInteraction3f, _SENSOR_POINTS**2)
    sensor.p = to_world @ mi.Point3f(x, y, 0)
    _, rng = streams(0, dr.arange(mi.UInt32, _SENSOR_POINTS**2), mi.UInt32(0))
    sensor.wavelengths, _ = sample_wavelengths(camera, rng)
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
    _, rng = streams(0, dr.arange(mi.UInt32, _LAMP_POINTS), mi.UInt32(0))
    to_world, place = (
        camera.world_transform(),
        shape.sample_position(0, mi.Point2f(rng.next_float32(), rng.next_float32())),
    )
    sensor = dr.zeros(mi.SurfaceInteraction3f, _LAMP_POINTS)
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


# -------- Highlights of glossy balls
#
# The light that a ball of radius r sends to a point comes from a spot of some alpha r: rays that are spread over the
# projector's window, or over all directions that the ball reflects to, may meet none of many small ones, and nothing
# tells of it. Where the spot lies is known, so points are drawn about it, as many in each octave of distance from it,
# and what they send to the sensor's centre is added up with the scene's own materials and shadows.

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


def highlights(setup: OpticalSetup) -> Highlights:
    """Highlights of all glossy balls of a ``setup`` that the projector's pinhole and the sensor's centre both see."""
    scene, projector = setup.scene, setup.projector
    balls = [s for s in scene.shapes() if s.class_name() == "Sphere" and s.bsdf() is not None and _glossy(s.bsdf())]
    balls = balls[:: -(-len(balls) // _MOST_BALLS)] if balls else []
    if not balls:
        return Highlights(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    wavelengths = wavelength_sets(projector.lines)
    rays = PinholeRays(projector, wavelengths)
    turn, eye = turn_and_origin(setup.camera.world_transform())
    centre = np.array([np.array(ball.bbox().center(), dtype=np.float64).ravel() for ball in balls])
    radius = np.array([float(np.array(ball.bbox().extents()).max()) / 2 for ball in balls])
    normal = _mirror_normals(centre, radius, rays.origin, eye)
    # Angles from the middle, evenly in their logarithm, and about it.
    octaves = math.log(math.pi / 2 / _NEAREST)
    angle = np.asarray(_NEAREST * np.exp(octaves * (np.arange(_POINTS) + 0.5) / _POINTS), dtype=np.float64)
    area = np.sin(angle) * angle * octaves * 2 * math.pi / _POINTS
    points = centre[:, None] + radius[:, None, None] * _directions_about(
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
    sent, facing = _radiance_toward(scene, rays.origin, aimed, eye, np.repeat(radius, _POINTS))
    local = -back @ turn
    stop = (np.abs(local[:, :2]) <= setup.geometry.tan_half_fov * local[:, 2:]).all(axis=1)
    # Part of the window that each point stands for, by the tangents of one pixel, and what it brings.
    seen = np.tile(area, len(balls)) * np.repeat(radius, _POINTS) ** 2 * np.maximum(facing, 0) * far / depth**3
    received = sent * (local[:, 2] / near) / near**2
    light = rays.power.mean(axis=1)[pixel] * received * (inside & stop)
    each = seen * light
    irradiance, moments = (v.reshape(len(balls), -1).sum(axis=1) for v in (each, each * light * rays.area))
    return Highlights(pixel[::_POINTS], irradiance, moments)


def _glossy(bsdf: mi.BSDF) -> bool:
    return bool(bsdf.flags() & int(mi.BSDFFlags.GlossyReflection))


def _mirror_normals(centre: FloatArray, radius: FloatArray, one: FloatArray, other: FloatArray) -> FloatArray:
    """(k, 3) normals of balls where a mirror would turn light from ``one`` place to the ``other``."""
    normal = np.zeros_like(centre)
    for _ in range(50):
        at = centre + radius[:, None] * normal
        ways = [(place - at) / np.linalg.norm(place - at, axis=1, keepdims=True) for place in (one, other)]
        normal = ways[0] + ways[1]
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return normal


def _directions_about(normal: FloatArray, angle: FloatArray, turned: FloatArray) -> FloatArray:
    """(k, p, 3) directions at (p,) angles from normals (k, 3), ``turned`` about them."""
    helper = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    across = np.cos(turned)[:, None] * first[:, None] + np.sin(turned)[:, None] * second[:, None]
    return np.asarray(np.cos(angle)[:, None] * normal[:, None] + np.sin(angle)[:, None] * across)


def _radiance_toward(
    scene: mi.Scene, origin: FloatArray, aimed: FloatArray, eye: FloatArray, radius: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(k,) light that sharp lobes at points send to the ``eye`` [1/sr], mean over channels, and cosines of what comes
    to them; 0 where either way is blocked."""
    to = aimed - origin
    ray = mi.Ray3f(
        mi.Point3f(origin.tolist()), mi.Vector3f(*device_vectors(to / np.linalg.norm(to, axis=1, keepdims=True)))
    )
    si = scene.ray_intersect(ray)
    target = mi.Point3f(eye.tolist())
    context = mi.BSDFContext(mi.TransportMode.Importance)
    way = si.to_local(dr.normalize(target - si.p))
    active = si.is_valid() & ~scene.ray_test(si.spawn_ray_to(target))
    value, density = si.bsdf().eval_pdf(context, si, way, active)
    count = len(aimed)
    light = channels(mi.unpolarized_spectrum(dr.select(active & (density > _SHARP), value, 0)), count).mean(axis=1)
    met = np.linalg.norm(vectors(si.p, count) - aimed, axis=1) < _ON_BALL * radius + 1e-4 * np.abs(aimed).max(axis=1)
    return light * met, host_values(dr.abs(mi.Frame3f.cos_theta(si.wi)), count)
