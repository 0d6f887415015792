"""The projector's rays, and connections from a lit surface point to the sensor and to the projector's lens.

A stock ``projector`` emitter does not state its field of view, so that its map is fitted to the uv of many points. It
casts pi x scale x texture on the plane at unit distance. A ray of a pixel that is cut into N rays carries ``phi = pi
scale texture a / N``, a being the pixel's area on that plane: the same through every point of a lens.

A surface point P that receives the flux phi irradiates the bare sensor with::

    E = f(P) cos_s / cos_g  phi  cos_P cos_a / r^2  r(t)        [W m^-2]

f is the BSDF, cos_s and cos_g the arriving light's cosines to the shading and the geometric normal at P, cos_P and
cos_a those of the connection at P and at the sensor, and r(t) the pixel's angular response. Light is followed from the
projector's side because every path then counts for a known pixel.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import device_array, keep_scenes
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.projector import Lines
from mitsim.optics.image_formation import anchor_positions
from mitsim.transport.plugins import base
from mitsim.transport.plugins.base import Light, Numbers, Surface, generator, host_values, rows_columns, x_y
from mitsim.transport.records import Sightings
from mitsim.transport.transmission import Passage, refracted_way

_WAVELENGTH_SETS = 8
_FAR = 1000.0
_PROBES = 24
_FIRST_REACH = 0.02
_PROBE_STEP = 1e-2


@dataclass(frozen=True)
class ProjectorOptics:
    """The emitter and its window: n x n pixels from (first_row, first_column) of a (rows, columns) canvas.

    ``aperture`` is the lens radius [mm] (0: a pinhole), ``focus`` the distance of the sharp plane [mm], ``blur`` the
    standard deviation of a pixel's spot [pixels]. The lens scatters all but ``share`` of the light with a standard
    deviation of ``glare_spread`` pixels.
    """

    emitter: mi.Emitter
    n: int
    first_row: float
    first_column: float
    canvas: tuple[int, int]
    aperture: float = 0.0
    focus: float = 400.0
    blur: float = 0.0
    lines: Lines | None = None
    parted: bool = False
    share: float = 1.0
    glare_spread: float = 0.0

    @property
    def scattered(self) -> ProjectorOptics:
        spread = math.hypot(self.blur, self.glare_spread)
        return replace(self, share=1 - self.share, blur=spread, glare_spread=0.0)

    @property
    def per_wavelength(self) -> tuple[ProjectorOptics, ...]:
        if not (self.parted and mi.is_spectral):
            return (self,)
        if self.lines is None:
            raise MitsimError(
                f"variant {mi.variant()}: its paths carry random wavelengths, which the scene's glass refracts "
                "differently; trace the projector's lines (colour lines), or choose a mono variant"
            )
        return tuple(replace(self, lines=line) for line in self.lines.apart) if self.lines.several else (self,)

    @property
    def by_line(self) -> bool:
        return self.lines is not None and self.lines.several

    @cached_property
    def canvas_map(self) -> CanvasMap:
        return CanvasMap.of(self.emitter)

    @property
    def ideal(self) -> bool:
        return self.aperture == 0 and self.blur == 0

    def canvas_point(
        self, row: Numbers, column: Numbers, number: Callable[[float], Numbers] = float
    ) -> tuple[Numbers, Numbers]:
        rows, columns, first_row, first_column = map(number, (*self.canvas, self.first_row, self.first_column))
        return (column + first_column) / columns, (row + first_row) / rows

    def pixel_at(self, uv: mi.Point2f) -> mi.UInt32:
        n = _opaque(self.n)
        row, column = (
            dr.clip(dr.floor(place * _opaque(count) - _opaque(part)) - _opaque(first), 0, n - 1)
            for place, count, (part, first) in (
                (uv.y, self.canvas[0], math.modf(self.first_row)),
                (uv.x, self.canvas[1], math.modf(self.first_column)),
            )
        )
        return mi.UInt32(row * n + column)


@dataclass(frozen=True, eq=False)
class CanvasMap:
    """Map of a stock ``projector``: local tan-angles x = x[0] u + x[1], y = y[0] v + y[1].

    ``turn`` (3, 3) and ``origin`` (3,) [mm] take local points to the world.
    """

    turn: FloatArray
    origin: FloatArray
    x: FloatArray
    y: FloatArray

    @classmethod
    def of(cls, emitter: mi.Emitter) -> CanvasMap:
        turn, origin = base.turn_and_origin(mi.traverse(emitter)["to_world"])
        reach = _FIRST_REACH
        for _ in range(2):  # first near the axis, to learn the field of view, then over all of it
            x, y = (part.ravel() for part in np.meshgrid(*[np.linspace(-reach, reach, _PROBES)] * 2))
            local = np.stack([x, y, np.ones(x.size)], axis=1)
            uv = _direction_samples(emitter, turn, origin, local, None)[0].uv
            fits = [
                np.linalg.lstsq(np.stack([host_values(part, x.size), np.ones(x.size)], axis=1), tangent, rcond=None)[0]
                for part, tangent in ((uv.x, x), (uv.y, y))
            ]
            reach = 0.49 * min(abs(fits[0][0]), abs(fits[1][0]))
        return cls(turn, origin, fits[0], fits[1])

    def tangents(self, u: Numbers, v: Numbers, number: Callable[[float], Numbers] = float) -> tuple[Numbers, Numbers]:
        x, y = ([number(float(value)) for value in axis] for axis in (self.x, self.y))
        return x[0] * u + x[1], y[0] * v + y[1]

    def pixel_area(self, canvas: Sequence[int]) -> float:
        return float(abs(self.x[0] * self.y[0]) / (canvas[0] * canvas[1]))


class ProjectorRays:
    def __init__(self, projector: ProjectorOptics) -> None:
        self.projector, self._map = projector, projector.canvas_map
        self._origin = mi.Point3f(*map(_opaque, self._map.origin))
        self._turn = mi.Matrix3f(*map(_opaque, self._map.turn.ravel()))

    def sample(self, pixel: mi.UInt32, jitter: mi.Point2f, rng: mi.PCG32, wavelengths: mi.Color0f) -> mi.Ray3f:
        projector = self.projector
        n = dr.opaque(mi.UInt32, projector.n)
        row, column = mi.Float(pixel // n) + jitter.y, mi.Float(pixel % n) + jitter.x
        if projector.blur > 0:
            spot = mi.warp.square_to_std_normal(mi.Point2f(rng.next_float32(), rng.next_float32()))
            spread = dr.opaque(mi.Float, projector.blur)
            row, column = row + spread * spot.y, column + spread * spot.x
        image = self._image(row, column)
        lens = mi.Vector3f(0)
        if projector.aperture > 0:
            disk = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(rng.next_float32(), rng.next_float32()))
            lens = mi.Vector3f(disk.x, disk.y, 0) * dr.opaque(mi.Float, projector.aperture)
            image = image - lens / dr.opaque(mi.Float, projector.focus)
        return mi.Ray3f(self._origin + self._turn @ lens, dr.normalize(self._turn @ image), 0.0, wavelengths)

    def flux(self, pixel: mi.UInt32, wavelengths: mi.Color0f) -> mi.Spectrum:
        n = dr.opaque(mi.UInt32, self.projector.n)
        centre = self._image(mi.Float(pixel // n) + 0.5, mi.Float(pixel % n) + 0.5)
        at = dr.zeros(mi.SurfaceInteraction3f)
        at.wavelengths = wavelengths
        at.p = self._origin + self._turn @ (centre * _FAR)
        _, weight = self.projector.emitter.sample_direction(at, mi.Point2f(0.5), True)
        area = _opaque(self._map.pixel_area(self.projector.canvas) * self.projector.share)
        return weight * (_FAR**2 * dr.rsqrt(dr.squared_norm(centre)) * area)

    def _image(self, row: mi.Float, column: mi.Float) -> mi.Vector3f:
        canvas_point = self.projector.canvas_point(row, column, _opaque)
        return mi.Vector3f(*self._map.tangents(*canvas_point, _opaque), 1)


def _opaque(value: float) -> mi.Float:
    return dr.opaque(mi.Float, float(value))


def line_wavelengths(lines: Lines) -> tuple[mi.Color0f, FloatArray]:
    """Return wavelengths [nm] of a path with some lines, and weights (4,) whose mean is the sum of the lines.

    Fewer than four lines are filled with the first, of weight 0.
    """
    size = len(dr.zeros(mi.UnpolarizedSpectrum))
    more = size - len(lines.shares)
    # Opaque numbers keep the compiled kernel the same for all lines.
    wavelengths = (dr.opaque(mi.Float, value) for value in (*lines.wavelengths_nm, *lines.wavelengths_nm[:1] * more))
    weights = np.array([*lines.shares, *[0.0] * more]) * size
    return type(dr.zeros(mi.Ray3f).wavelengths)(*wavelengths), weights


def wavelength_sets(lines: Lines | None = None) -> list[mi.Color0f | None]:
    if not mi.is_spectral:
        return [None]
    if lines is not None:
        return [line_wavelengths(lines)[0]]
    size = len(dr.zeros(mi.UnpolarizedSpectrum))
    step = (mi.MI_CIE_MAX - mi.MI_CIE_MIN) / (_WAVELENGTH_SETS * size)
    even = mi.MI_CIE_MIN + step * (np.arange(_WAVELENGTH_SETS * size) + 0.5)
    return [type(dr.zeros(mi.Ray3f).wavelengths)(*even[i::_WAVELENGTH_SETS].tolist()) for i in range(_WAVELENGTH_SETS)]


class PinholeRays:
    """Rays of a projector without lens and blur, in float64.

    ``area`` is that of a pixel at unit distance [mm^2], ``power`` (n * n, channels) its irradiance there [W m^-2].
    """

    def __init__(self, projector: ProjectorOptics, wavelengths: Sequence[mi.Color0f | None]) -> None:
        self._projector, n = projector, projector.n
        self._map = projector.canvas_map
        self.origin = self._map.origin
        self.area = self._map.pixel_area(projector.canvas)
        centre = np.stack(np.divmod(np.arange(n * n), n), axis=1) + 0.5
        parts, local = [], self._local(centre)
        for chosen in wavelengths:
            place = self._map.turn, self.origin, local, chosen
            _, emitted, depth, cosine = _direction_samples(projector.emitter, *place)
            parts.append(base.channels(mi.unpolarized_spectrum(emitted), len(centre)) * (cosine * depth**2)[:, None])
        self.power = np.concatenate(parts, axis=1)
        if mi.is_spectral and projector.lines is not None:
            self.power *= line_wavelengths(projector.lines)[1]

    def directions(self, points: FloatArray) -> FloatArray:
        world = self._local(points) @ self._map.turn.T
        return np.asarray(world / np.linalg.norm(world, axis=1, keepdims=True))

    def points(self, places: FloatArray) -> tuple[FloatArray, FloatArray]:
        local = np.linalg.solve(self._map.turn, (places - self.origin).T)
        depth, canvas = local[2], self._projector.canvas
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = ((local[i] / depth - axis[1]) / axis[0] for i, axis in enumerate((self._map.x, self._map.y)))
        row = v * canvas[0] - self._projector.first_row
        return np.stack([row, u * canvas[1] - self._projector.first_column], axis=1), depth

    def _local(self, points: FloatArray) -> FloatArray:
        tangents = self._map.tangents(*self._projector.canvas_point(points[:, 0], points[:, 1]))
        return np.stack([*tangents, np.ones(len(points))], axis=1)


def _direction_samples(
    emitter: mi.Emitter, turn: FloatArray, origin: FloatArray, local: FloatArray, wavelengths: mi.Color0f | None
) -> tuple[mi.DirectionSample3f, mi.Spectrum, float, FloatArray]:
    depth = _FAR * max(1.0, float(np.abs(origin).max()) / 100)
    forward = turn[:, 2] / np.linalg.norm(turn[:, 2])
    world = local @ turn.T
    world *= depth / (world @ forward)[:, None]
    interaction = dr.zeros(mi.SurfaceInteraction3f, len(local))
    interaction.p = mi.Point3f(*base.device_vectors(origin + world))
    if wavelengths is not None:
        interaction.wavelengths = wavelengths
    sample, emitted = emitter.sample_direction(interaction, mi.Point2f(0.5), True)
    return sample, emitted, depth, depth / np.linalg.norm(world, axis=1)


# -------- Connections


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
        positions = device_array(mi.Float, np.append(self.positions, 0))
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

    def sightings(self, light: Light, pixel: mi.UInt32, by_line: bool = False) -> Sightings:
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
        flux = np.array(base.panchromatic(self.rays.flux(pixel, wavelengths) * spectral))
        return float(flux.mean(dtype=np.float64)) / (math.pi * self.geometry.scene_distance**2)

    def receive(self, si: Surface, toward: mi.Vector3f, local: mi.Point3f, active: mi.Bool) -> Reception:
        return self.received(si, toward, self.way(si, local, active))

    def way(self, si: Surface, local: mi.Point3f, active: mi.Bool) -> Way:
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
    def received(si: Surface, toward: mi.Vector3f, way: Way) -> Reception:
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


def landing(setup: OpticalSetup, si: Surface, direction: mi.Vector3f, active: mi.Bool) -> Landing:
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
            # Size of a pixel on the plane at unit distance [mm], by the emitter's own float32: the canvas's map is 1e-4
            # more exact, but frames of a blurred spot would not stay bit-equal.
            probe = dr.zeros(mi.SurfaceInteraction3f, 2)
            probe.p = self._to_world @ mi.Point3f([0.0, _PROBE_STEP], [0.0, _PROBE_STEP], [1.0, 1.0])
            sample, _ = self.emitter.sample_direction(probe, mi.Point2f(0.5))
            u, v = host_values(sample.uv.x, 2), host_values(sample.uv.y, 2)
            rows, columns = projector.canvas
            self._pixel_at_unit = (_PROBE_STEP / (abs(u[1] - u[0]) * columns), _PROBE_STEP / (abs(v[1] - v[0]) * rows))

    def lens_point(self, rng: mi.PCG32) -> mi.Point3f:
        if self.projector.aperture == 0:
            return mi.Point3f(0)
        disk = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(rng.next_float32(), rng.next_float32()))
        return mi.Point3f(disk.x, disk.y, 0) * dr.opaque(mi.Float, self.projector.aperture)

    def connect(self, si: Surface, rng: mi.PCG32, active: mi.Bool, lens: mi.Point3f | None = None) -> Connection:
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
    x, y = (device_array(mi.Float, axis) for axis in np.meshgrid(edge, edge))
    to_world, sensor = camera.world_transform(), dr.zeros(mi.SurfaceInteraction3f, _SENSOR_POINTS**2)
    sensor.p = to_world @ mi.Point3f(x, y, 0)
    _, rng = base.streams(0, dr.arange(mi.UInt32, _SENSOR_POINTS**2), mi.UInt32(0))
    sensor.wavelengths, _ = sample_wavelengths(camera, rng)
    ds, light = lamp.sample_direction(sensor, mi.Point2f(0.5), True)
    met = _in_view(camera, ds.d) & (dr.max(mi.unpolarized_spectrum(light)) > 0)
    if not np.array(met).any():
        return False
    seen, _ = Passage(scene).between(sensor, ds.p, met)
    return bool(np.array(met & seen).any())


@keep_scenes()
def part_of_view(scene: mi.Scene, camera: mi.Sensor, shape: mi.Shape) -> float:
    _, rng = base.streams(0, dr.arange(mi.UInt32, _LAMP_POINTS), mi.UInt32(0))
    to_world = camera.world_transform()
    place = shape.sample_position(0, mi.Point2f(rng.next_float32(), rng.next_float32()))
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
