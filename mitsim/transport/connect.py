"""Connections from a lit surface point to the irradiance that it casts on the sensor, and to the projector's lens.

A surface point P that receives the flux phi irradiates the bare sensor with::

    E = f(P) cos_s / cos_g  phi  cos_P cos_a / r^2  r(t)        [W m^-2]

f is the BSDF, cos_s and cos_g the arriving light's cosines to the shading and the geometric normal at P, cos_P and
cos_a those of the connection at P and at the sensor, and r(t) the pixel's angular response. Light is followed from the
projector's side because every path then counts for a known pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import keep_scenes
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.projector import Lines
from mitsim.optics.image_formation import anchor_positions
from mitsim.transport.plugins.base import generator, panchromatic, rows_columns, streams, x_y
from mitsim.transport.projector import ProjectorOptics, ProjectorRays, line_wavelengths
from mitsim.transport.records import Sightings
from mitsim.transport.transmission import Passage, refracted_way


@dataclass(frozen=True)
class SensorPoints:
    """Points of the sensor to which light is followed: anchors along each axis, or with ``spread`` random points.

    Paths from all points are aimed at the same cells at ``distance`` [mm].
    """

    half_width: float
    anchors: int = 1
    spread: bool = False
    distance: float = math.inf

    @property
    def count(self) -> int:
        return self.anchors**2

    @property
    def positions(self) -> FloatArray:
        return anchor_positions(self.anchors, self.half_width)

    def of(self, lane: mi.UInt32, paths: int) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        count, anchors = dr.opaque(mi.UInt32, paths), dr.opaque(mi.UInt32, self.anchors)
        anchor = lane // count
        return lane % count, anchor // anchors, anchor % anchors

    def at(self, row: mi.UInt32, column: mi.UInt32, rng: mi.PCG32) -> mi.Point3f:
        spread = dr.opaque(mi.Bool, self.spread)
        return self.place(row, column, mi.Point2f(rng.next_float32(spread), rng.next_float32(spread)))

    def place(self, row: mi.UInt32, column: mi.UInt32, point: mi.Point2f) -> mi.Point3f:
        # For a single number Dr.Jit would compile another kernel.
        positions = mi.Float(np.append(self.positions, 0).astype(np.float32))
        anchor = mi.Point3f(*x_y(dr.gather(mi.Float, positions, row), dr.gather(mi.Float, positions, column)), 0)
        return dr.select(dr.opaque(mi.Bool, self.spread), self.inside(point), anchor)

    def inside(self, point: mi.Point2f) -> mi.Point3f:
        side = 2 * dr.opaque(mi.Float, self.half_width)
        return mi.Point3f((point.x - 0.5) * side, (point.y - 0.5) * side, 0)


@dataclass
class Way:
    """Way from a surface point P to a point of the sensor.

    ``geometric`` has all factors of the irradiance but the BSDF and the arriving light's cosine [mm^-2].
    """

    open: mi.Bool
    direction: mi.Vector3f
    passed: mi.Spectrum
    geometric: mi.Float
    row: mi.Float
    column: mi.Float
    inverse_depth: mi.Float


@dataclass
class Reception:
    """Irradiance for each unit of flux that comes by a ``way`` [mm^-2]; ``pdf`` is that of the reverse turn [1/sr]."""

    irradiance: mi.Spectrum
    pdf: mi.Float
    way: Way

    def solid_angle(self, local: mi.Point3f) -> mi.Float:
        row, column = rows_columns(local.x, local.y)
        inverse = self.way.inverse_depth
        squared = 1 + dr.square(self.way.row - row * inverse) + dr.square(self.way.column - column * inverse)
        return dr.square(inverse) / (squared * dr.sqrt(squared))

    def sightings(self, light: mi.UnpolarizedSpectrum, pixel: mi.UInt32, by_line: bool = False) -> Sightings:
        return Sightings.of(light, by_line, pixel, self.way.row, self.way.column, self.way.inverse_depth)


@dataclass(frozen=True, eq=False)
class OpticalSetup:
    scene: mi.Scene
    camera: mi.Sensor
    projector: ProjectorOptics
    geometry: CameraGeometry

    @cached_property
    def passage(self) -> Passage:
        return Passage(self.scene)

    @cached_property
    def rays(self) -> ProjectorRays:
        return ProjectorRays(self.projector)

    @cached_property
    @keep_scenes()
    def board(self) -> float:
        pixel = dr.arange(mi.UInt32, self.projector.n**2)
        wavelengths, spectral = sample_wavelengths(self.camera, generator(mi.UInt32(0), pixel), self.projector.lines)
        flux = np.array(panchromatic(self.rays.flux(pixel, wavelengths) * spectral))
        return float(flux.mean(dtype=np.float64)) / (math.pi * self.geometry.scene_distance**2)

    def receive(
        self, si: mi.SurfaceInteraction3f, toward: mi.Vector3f, local: mi.Point3f, active: mi.Bool
    ) -> Reception:
        return self.received(si, toward, self.way(si, local, active))

    def way(self, si: mi.SurfaceInteraction3f, local: mi.Point3f, active: mi.Bool) -> Way:
        to_world = self.camera.world_transform()
        point = to_world.inverse() @ si.p
        sensor = to_world @ local
        apparent, bent = si.p, None
        if self.passage.panes:
            bent = refracted_way(self.passage, si, sensor, active)
            apparent, active = bent.apparent, active & bent.open
            point = to_world.inverse() @ apparent
        offset = sensor - apparent
        squared = dr.squared_norm(offset)
        direction = offset * dr.rsqrt(squared) if bent is None else bent.direction
        t = mi.Vector2f(point.x - local.x, point.y - local.y) / point.z
        stop = dr.opaque(mi.Float, self.geometry.tan_half_fov)
        active = active & (point.z > dr.opaque(mi.Float, self.geometry.mask_distance))
        active &= (dr.abs(t.x) <= stop) & (dr.abs(t.y) <= stop)
        if bent is None:
            seen, passed = self.passage.between(si, sensor, active)
            active &= seen
        else:
            passed = bent.part
        cosine = dr.rsqrt(1 + dr.squared_norm(t))
        geometric = dr.abs(dr.dot(si.n, direction)) * cosine / squared
        if self.geometry.angular_exponent > 0:
            geometric *= dr.power(cosine, dr.opaque(mi.Float, self.geometry.angular_exponent))
        inverse_depth = dr.rcp(point.z)
        row, column = rows_columns(point.x, point.y)
        return Way(active, direction, passed, geometric, row * inverse_depth, column * inverse_depth, inverse_depth)

    @staticmethod
    def received(si: mi.SurfaceInteraction3f, toward: mi.Vector3f, way: Way) -> Reception:
        si.wi = si.to_local(way.direction)
        reflected, pdf = si.bsdf().eval_pdf(mi.BSDFContext(), si, si.to_local(toward), way.open)
        geometric = way.geometric / dr.abs(dr.dot(si.n, toward))
        irradiance = dr.select(way.open, mi.unpolarized_spectrum(reflected) * way.passed * geometric, 0)
        return Reception(irradiance, pdf, way)


def sample_wavelengths(camera: mi.Sensor, rng: mi.PCG32, lines: Lines | None = None) -> tuple[mi.Color0f, mi.Spectrum]:
    """Return wavelengths of a path and their weights; none and 1 but in spectral variants.

    The mean of weighted light is the mean over 360-830 nm, or the sum over given lines, four at most.
    """
    wavelengths, weight = camera.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), rng.next_float32(), True)
    if not mi.is_spectral:
        return wavelengths, weight
    if lines is None:
        return wavelengths, weight / (mi.MI_CIE_MAX - mi.MI_CIE_MIN)
    wavelengths, weights = line_wavelengths(lines)
    return wavelengths, mi.Spectrum(*(dr.opaque(mi.Float, float(weight)) for weight in weights))


# -------- Landings of light that leaves surfaces in known directions
#
# Light that is sampled from a surface goes where its lobe sends it, through flat glass bent by Snell's law, until it
# crosses the plane of the sensor.


@dataclass
class Landing:
    x: mi.Float
    y: mi.Float
    cosine: mi.Float
    length: mi.Float
    arrives: mi.Bool


def landing(setup: OpticalSetup, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> Landing:
    inverse, passage = setup.camera.world_transform().inverse(), setup.passage
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


# -------- Connections to the projector
#
# Each has the projector pixel that it used. A pinhole is the stock Mitsuba ``projector``. With a lens of finite radius,
# a point q of the lens shows the pattern that is sharp on the focus plane: a ray from q through surface point p
# carries the projector pixel whose image lies where the ray meets that plane. Radiance is pi scale texture /
# (A cos^4 theta), so that a small lens of area A casts the pinhole's irradiance. A blurred spot moves each connection
# by a normal deviate in projector pixels.


@dataclass
class Connection:
    direction: mi.Vector3f
    target: mi.Point3f
    weight: mi.Spectrum
    pdf: mi.Float
    pixel: mi.UInt32
    valid: mi.Bool


@dataclass
class LensHit:
    radiance: mi.Spectrum
    pdf: mi.Float
    pixel: mi.UInt32
    met: mi.Bool


class ProjectorConnector:
    def __init__(self, projector: ProjectorOptics) -> None:
        self.projector, self.emitter = projector, projector.emitter
        if not projector.ideal:
            self._to_world = self.emitter.world_transform()
            self._pixel_at_unit = projector.pixel_size()

    def lens_point(self, rng: mi.PCG32) -> mi.Point3f:
        if self.projector.aperture == 0:
            return mi.Point3f(0)
        disk = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(rng.next_float32(), rng.next_float32()))
        return mi.Point3f(disk.x, disk.y, 0) * dr.opaque(mi.Float, self.projector.aperture)

    def connect(
        self, si: mi.SurfaceInteraction3f, rng: mi.PCG32, active: mi.Bool, lens: mi.Point3f | None = None
    ) -> Connection:
        if self.projector.ideal:
            ds, weight = self.emitter.sample_direction(si, mi.Point2f(0.5), active)
            return Connection(ds.d, ds.p, weight, mi.Float(0), self.projector.pixel_at(ds.uv), active & (ds.pdf > 0))
        local = self._to_world.inverse() @ si.p
        lens = self.lens_point(rng) if lens is None else lens
        offset = local - lens
        pixel, power, valid = self._pixel_power(lens, offset, rng, active & (local.z > 0))
        distance = dr.norm(offset)
        cosine = offset.z / distance
        # Irradiance on a plane z = const is pi scale texture / z^2 from every point of the lens.
        weight = power / (dr.square(local.z) * cosine)
        target = self._to_world @ lens
        pdf = dr.square(distance) / (cosine * self._area) if self.projector.aperture > 0 else mi.Float(0)
        return Connection(dr.normalize(target - si.p), target, weight, pdf, pixel, valid)

    def hit(
        self, ray: mi.Ray3f, reach: mi.Float, rng: mi.PCG32, active: mi.Bool, since: mi.Float | float = 0.0
    ) -> LensHit:
        inverse = self._to_world.inverse()
        origin, direction = inverse @ ray.o, inverse @ ray.d
        distance = -origin.z / direction.z
        lens = origin + direction * distance
        radius = dr.opaque(mi.Float, self.projector.aperture)
        met = active & (origin.z > 0) & (direction.z < 0) & (distance < reach)
        met &= dr.square(lens.x) + dr.square(lens.y) <= dr.square(radius)
        pixel, power, met = self._pixel_power(lens, -direction, rng, met)
        cosine = -direction.z
        radiance = power / (self._area * dr.square(dr.square(cosine)))
        return LensHit(radiance, dr.square(distance + since) / (cosine * self._area), pixel, met)

    @property
    def _area(self) -> mi.Float:
        return dr.pi * dr.square(dr.opaque(mi.Float, self.projector.aperture))

    def _pixel_power(
        self, lens: mi.Point3f, direction: mi.Vector3f, rng: mi.PCG32, active: mi.Bool
    ) -> tuple[mi.UInt32, mi.Spectrum, mi.Bool]:
        focus = dr.opaque(mi.Float, self.projector.focus)
        image = lens + direction * (focus / direction.z)
        if self.projector.blur > 0:
            spot = mi.warp.square_to_std_normal(mi.Point2f(rng.next_float32(), rng.next_float32()))
            step = dr.opaque(mi.Float, self.projector.blur) * focus
            image += mi.Vector3f(spot.x * self._pixel_at_unit[0], spot.y * self._pixel_at_unit[1], 0) * step
        at = dr.zeros(mi.SurfaceInteraction3f)
        # A point plus a vector is a vector to Mitsuba, and vectors are not moved.
        at.p = self._to_world @ mi.Point3f(image)
        ds, weight = self.emitter.sample_direction(at, mi.Point2f(0.5), active)
        power = weight * (dr.square(image.z) * image.z / dr.norm(image))
        return self.projector.pixel_at(ds.uv), power, active & (ds.pdf > 0)


# -------- Light of a lamp onto the sensor, over no surface
#
# No path runs into a point, spot or directional lamp, few run into a small one that has a surface, and no tracer
# connects the sensor itself to either. Of a projector such light is a beam's (:mod:`mitsim.transport.specular`).

_SENSOR_POINTS = 129
_LAMP_POINTS = 2**10


@keep_scenes()
def shines_in(scene: mi.Scene, camera: mi.Sensor, lamp: mi.Emitter) -> bool:
    edge = np.linspace(-1, 1, _SENSOR_POINTS) * camera.geometry.half_width
    x, y = (mi.Float(axis.ravel()) for axis in np.meshgrid(edge, edge))
    to_world, sensor = camera.world_transform(), dr.zeros(mi.SurfaceInteraction3f, _SENSOR_POINTS**2)
    sensor.p = to_world @ mi.Point3f(x, y, 0)
    _, rng = streams(0, dr.arange(mi.UInt32, _SENSOR_POINTS**2), mi.UInt32(0))
    sensor.wavelengths, _ = sample_wavelengths(camera, rng)
    ds, light = lamp.sample_direction(sensor, mi.Point2f(0.5), True)
    met = _in_view(camera, ds.d) & (dr.max(mi.unpolarized_spectrum(light)) > 0)
    if not np.array(met).any():
        return False
    seen, _ = Passage(scene).between(sensor, ds.p, met)
    return bool(np.array(met & seen).any())


@keep_scenes()
def part_of_view(scene: mi.Scene, camera: mi.Sensor, shape: mi.Shape) -> float:
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
    # Solid angle of dA on the lamp, and its area on the plane at unit distance.
    area = facing / distance**2 / (to_world.inverse() @ way).z ** 3
    total = float(np.array(dr.select(met & seen, area, 0)).mean()) * float(shape.surface_area()[0])
    return total / float(2 * camera.geometry.tan_half_fov) ** 2


def _in_view(camera: mi.Sensor, direction: mi.Vector3f) -> mi.Bool:
    toward = camera.world_transform().inverse() @ direction
    stop = camera.geometry.tan_half_fov * toward.z
    return (dr.abs(toward.x) <= stop) & (dr.abs(toward.y) <= stop)
