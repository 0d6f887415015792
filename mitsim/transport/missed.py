"""Undetected light: estimate of the light that tracers find seldom or never, and its source.

Mirrors or curved glass may bring light both from the projector to a surface and from there to the camera (a print in a
bottle). Paths from either side then miss the pinhole and the sensor's centre. So rays of the projector are followed
over mirrors to where they land, and those that land near the vertices of paths from the camera give the missing light:
light per area, over small squares of a surface.

Other paths come over one mirror and one sharp lobe. A small lens in the pinhole's place casts the same light, and paths
run into it. With x the light of such a path and I that of the connection along the same way, E[x I] is a connection's
second moment. A sample of connections therefore sees the light L of a shape's lobes as ``L^2 / E[x I]`` equal hits.

Lobes that the projector lights itself, and the highlights of glossy balls, are searched from the surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray, Labels, mean_of_neighbours
from mitsim.core.environment import device_array, keep_scenes
from mitsim.transport.connect import OpticalSetup, PinholeRays, Reception, landing, sample_wavelengths, wavelength_sets
from mitsim.transport.direct import DirectTracer
from mitsim.transport.from_camera import CameraPaths, CameraState, FromCameraTracer
from mitsim.transport.integrator import InFlight, Paths, Turn, camera_part, launches
from mitsim.transport.plugins import base
from mitsim.transport.plugins.base import Light, Surface
from mitsim.transport.records import DIRECT, INDIRECT, CellGrid, DeviceAccumulator, PathSamples, Sightings, check_finite
from mitsim.transport.specular import turned_by_mirrors
from mitsim.transport.transmission import Arrival

_CUBE, _CUBES = 5e-3, 2**20
"""Side of cubes over the scene's distance, 2 mm at 400, and the number of their codes."""
_GRAZING = 1e-3
_LENS = 0.02
"""Radius of the lens over the scene's distance: 8 mm at 400, which one path in 3000 meets from a matt surface."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Omitted light by shape, (k,) each, as irradiance at the sensor's centre [W m^-2] with its equal hits in a sample.

    ``mirrors`` is by the last mirror or glass before the camera, ``lobes`` by the shape with a sharp lobe.
    """

    mirrors: FloatArray
    lens_hits: FloatArray
    lobes: FloatArray
    hits: FloatArray

    @classmethod
    def none(cls) -> LeftOut:
        return cls(*np.zeros((4, 0)))

    def unseen(self, fewest: float, of_lens: float) -> tuple[float, int | None]:
        light = np.where(self.lens_hits < of_lens, self.mirrors, 0) + np.where(self.hits < fewest, self.lobes, 0)
        return float(light.sum()), int(np.argmax(light)) if light.any() else None


@keep_scenes()
def left_out_light(setup: OpticalSetup, grid: CellGrid, seed: int, samples: int) -> LeftOut:
    far = setup.geometry.scene_distance
    lens = replace(setup.projector, aperture=_LENS * far, focus=far)
    tracer = _MissedTracer(replace(setup, projector=lens), grid, Paths(mirrors=True, interreflection=True))
    tracer.landed = _Landed.of(setup)
    dr.eval(tracer.landed)
    found = tracer.trace(seed, 0, samples)
    # Path samples name shapes by their number in Dr.Jit's registry.
    numbers = np.array(dr.reinterpret_array(mi.UInt32, setup.scene.shapes_dr())).astype(np.int64)

    def by_shape(light: PathSamples, values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(light.pixel, values, int(numbers.max()) + 1)[numbers] / samples)

    lost, met = (found.where(found.kind == kind) for kind in (INDIRECT, DIRECT))
    # A lens of 1 mm^2; one of half the radius is met a quarter as often, and four times as bright.
    parts = list[FloatArray]()
    for each in (lost, met):
        light, moments = by_shape(each, each.value), by_shape(each, each.value * each.row)
        parts += light, np.divide(np.square(light), moments, out=np.zeros(len(light)), where=light > 0)
    parts[1] = parts[1] * math.pi * setup.projector.aperture**2
    return LeftOut(*parts)


@dataclass
class _Turned:
    place: mi.Vector3f
    direction: mi.Vector3f
    mirror: mi.UInt32
    flux: mi.Float
    power: mi.Float


@dataclass(frozen=True, eq=False)
class _Landed:
    first: mi.UInt32
    side: mi.Float
    rays: _Turned

    @classmethod
    def of(cls, setup: OpticalSetup) -> _Landed | None:
        found = turned_by_mirrors(setup.scene, setup.camera, setup.projector)
        if not (count := len(found.index)):
            return None
        start, way = (mi.Vector3f(*base.device_vectors(each)) for each in (found.start, found.direction))
        si, side = setup.scene.ray_intersect(mi.Ray3f(start, way)), mi.Float(_CUBE * setup.geometry.scene_distance)
        scatters = base.host_values(si.bsdf().flags() & int(mi.BSDFFlags.Smooth), count) != 0
        code = np.where(scatters, base.host_values(_cube(si.p, side), count), _CUBES)
        order = np.argsort(code, kind="stable")
        first = np.searchsorted(code[order], np.arange(_CUBES + 1))
        lights = [device_array(mi.Float, each) for each in found.spectrum.T]
        rays = _Turned(mi.Vector3f(si.p), way, device_array(mi.UInt32, found.mirror), *lights)
        return cls(device_array(mi.UInt32, first), side, dr.gather(_Turned, rays, device_array(mi.UInt32, order)))

    def light(self, si: Surface, rng: mi.PCG32, active: mi.Bool) -> tuple[Light, Light, mi.UInt32]:
        """Return the radiance that surfaces send on of the light in their cubes, one ray of each drawn for all."""
        code = _cube(si.p, self.side)
        first, end = (dr.gather(mi.UInt32, self.first, code + step, active) for step in (0, 1))
        count = mi.Float(end - first)
        number = first + mi.UInt32(rng.next_float32() * count)
        ray = dr.gather(_Turned, self.rays, number, active)
        # Cubes far apart may have the same code.
        active &= (number < end) & (dr.squared_norm(ray.place - si.p) < 3 * dr.square(self.side))
        sent = mi.unpolarized_spectrum(si.bsdf().eval(mi.BSDFContext(), si, si.to_local(-ray.direction), active))
        sent /= dr.maximum(dr.abs(dr.dot(si.n, ray.direction)), _GRAZING)
        parts = ray.flux * count / dr.square(self.side), ray.power * dr.pi
        landed, turned = (dr.select(active, sent * part, 0) for part in parts)
        return landed, turned, ray.mirror


def _cube(place: mi.Point3f, side: mi.Float) -> mi.UInt32:
    x, y, z = (mi.UInt32(mi.Int32(dr.floor(part / side + 0.381966))) for part in place)
    return ((x * 73856093) ^ (y * 19349663) ^ (z * 83492791)) & (_CUBES - 1)


class _MissedTracer(FromCameraTracer):
    landed: _Landed | None

    def _launch(self, flight: InFlight, accumulator: DeviceAccumulator | None = None) -> list[PathSamples]:
        return _MissedPaths(self, flight).path_samples()


@dataclass(kw_only=True)
class _MissedState(CameraState):
    lobe: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))
    density: mi.Float = field(default_factory=lambda: mi.Float(0))


class _MissedPaths(CameraPaths[_MissedState]):
    tracer: _MissedTracer
    STATE = _MissedState

    def __init__(self, tracer: _MissedTracer, flight: InFlight) -> None:
        super().__init__(tracer, flight)
        self._rays = tracer.setup.rays  # made before the loop, in which nothing can be evaluated

    def _connect(self, paths: _MissedState, si: Surface, first: bool) -> None:
        if first or self.tracer.landed is None:
            return
        foreign = paths.active & (paths.in_mirror | (paths.scattered > 0))
        # Numbers of its own, so that paths are those of a scene without such light.
        light, turned, mirror = self.tracer.landed.light(si, mi.PCG32(paths.rng), foreign)
        missed, hit = (self._irradiance(paths, each) * paths.part for each in (light, turned))
        none = mi.Float(0)
        self._join(paths, "indirect", Sightings.of(missed, self.by_line, mirror, base.panchromatic(hit), none, none))

    def _hit_lens(self, paths: _MissedState, si: Surface) -> None:
        once = paths.active & (paths.scattered == 1) & (paths.in_mirror != paths.by_delta)
        met = once & (camera_part(paths.density) > 0)
        hit = self.connector.hit(paths.ray, si.t, paths.rng, met, paths.since)
        light, none = self._irradiance(paths, hit.radiance), mi.Float(0)
        met &= hit.met
        in_mirror = base.panchromatic(light) * paths.density / hit.pdf
        # Otherwise the projector lights the lobe: the path's weight without its part of the view. The first surface is
        # at 1 / (inverse depth * slope).
        grid, flux = self.tracer.grid, self._rays.flux(hit.pixel, paths.ray.wavelengths)
        view = dr.opaque(mi.Float, grid.rows.size * grid.columns.size) * dr.square(dr.square(self.slope))
        sent = base.panchromatic(self._irradiance(paths, flux)) / view * paths.density * self.slope
        lit = sent * dr.square(paths.inverse_depth * self.slope)
        connected = dr.select(met, dr.select(paths.in_mirror, in_mirror, lit), 0)
        seen = Sightings.of(dr.select(met, light, 0), self.by_line, paths.lobe, connected, none, none)
        self._join(paths, "direct", seen)

    def _note_turn(self, paths: _MissedState, si: Surface, turn: Turn, first: bool) -> mi.Bool:
        going = super()._note_turn(paths, si, turn, first)
        shape = dr.reinterpret_array(mi.UInt32, dr.select(si.instance != None, si.instance, si.shape))  # noqa: E711
        turned = ~turn.passing & ~paths.by_delta
        paths.lobe = dr.select(turned, shape, paths.lobe)
        paths.density = dr.select(turned, paths.came_pdf, paths.density)
        return going


# -------- Highlights of glossy balls
#
# The light that a ball of radius r sends to a point comes from a spot of some alpha r: rays that are spread over the
# projector's window, or over all directions that the ball reflects to, may meet none of many small ones, and nothing
# shows it. Where the spot lies is known, so points are drawn about it, as many in each octave of distance from it,
# and the light that they send to the sensor's centre is added up with the scene's own materials and shadows.

_POINTS, _NEAREST = 512, 1e-4
"""Points about each spot, which measure its light to some 5 %, and the angle from its middle where they begin."""
_MOST_BALLS = 2**12
_GOLDEN = math.pi * (3 - math.sqrt(5))
_FEWEST_MET = 3.0
_ON_BALL = 1e-2


@dataclass(frozen=True, eq=False)
class Highlights:
    """Light that glossy balls send; ``moments`` [W^2 m^-4] are for one ray from every projector pixel."""

    pixels: Labels
    irradiance: FloatArray
    moments: FloatArray

    def unmet(self, rays: float) -> Highlights:
        seldom = np.square(self.irradiance) * rays < self.moments
        total, moment = float(self.irradiance[seldom].sum()), float(self.moments[seldom].sum())
        if total**2 * rays >= _FEWEST_MET * moment:
            seldom = np.zeros_like(seldom)
        return Highlights(self.pixels[seldom], self.irradiance[seldom], self.moments[seldom])


@keep_scenes()
def highlights(setup: OpticalSetup) -> Highlights:
    scene, projector = setup.scene, setup.projector
    shiny = int(mi.BSDFFlags.GlossyReflection)
    balls = [s for s in scene.shapes() if s.class_name() == "Sphere" and s.bsdf() and s.bsdf().flags() & shiny]
    balls = balls[:: -(-len(balls) // _MOST_BALLS)] if balls else []
    if not balls:
        return Highlights(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    wavelengths = wavelength_sets(projector.lines)
    rays = PinholeRays(projector, wavelengths)
    turn, eye = base.turn_and_origin(setup.camera.world_transform())
    centre = np.array([np.array(ball.bbox().center(), dtype=np.float64).ravel() for ball in balls])
    radius = np.array([float(np.array(ball.bbox().extents()).max()) / 2 for ball in balls])
    # The normal that mirrors the projector into the eye, and directions across it.
    normal = np.zeros_like(centre)
    for _ in range(50):
        at = centre + radius[:, None] * normal
        ways = [(place - at) / np.linalg.norm(place - at, axis=1, keepdims=True) for place in (rays.origin, eye)]
        normal = ways[0] + ways[1]
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    # Angles from the middle, evenly in their logarithm, and about it.
    octaves = math.log(math.pi / 2 / _NEAREST)
    angle = np.asarray(_NEAREST * np.exp(octaves * (np.arange(_POINTS) + 0.5) / _POINTS), dtype=np.float64)
    area = np.sin(angle) * angle * octaves * 2 * math.pi / _POINTS
    turned = np.asarray(_GOLDEN * np.arange(_POINTS, dtype=np.float64))
    across = np.cos(turned)[:, None] * first[:, None] + np.sin(turned)[:, None] * second[:, None]
    directions = np.cos(angle)[:, None] * normal[:, None] + np.sin(angle)[:, None] * across
    points = centre[:, None] + radius[:, None, None] * directions
    aimed = points.reshape(-1, 3)
    to, back = aimed - rays.origin, eye - aimed
    far, near = (np.linalg.norm(way, axis=1) for way in (to, back))
    window, depth = rays.points(aimed)
    n = projector.n
    inside = ((window >= 0) & (window < n)).all(axis=1)
    pixel = np.where(
        inside, np.clip(window[:, 0].astype(int), 0, n - 1) * n + np.clip(window[:, 1].astype(int), 0, n - 1), 0
    )
    # Radiance that each point sends to the eye over its sharp lobe, and its cosine to the projector.
    start, target, count = mi.Point3f(rays.origin.tolist()), mi.Point3f(eye.tolist()), len(aimed)
    si = scene.ray_intersect(mi.Ray3f(start, mi.Vector3f(*base.device_vectors(to / far[:, None]))))
    active = si.is_valid() & ~scene.ray_test(si.spawn_ray_to(target))
    context = mi.BSDFContext(mi.TransportMode.Importance)
    value, density = si.bsdf().eval_pdf(context, si, si.to_local(dr.normalize(target - si.p)), active)
    sharp = mi.unpolarized_spectrum(dr.select(active & (density > _LEAST_SHARP), value, 0))
    reach = _ON_BALL * np.repeat(radius, _POINTS) + 1e-4 * np.abs(aimed).max(axis=1)
    met = np.linalg.norm(base.vectors(si.p, count) - aimed, axis=1) < reach
    sent = base.channels(sharp, count).mean(axis=1) * met
    facing = base.host_values(dr.abs(mi.Frame3f.cos_theta(si.wi)), count)
    local = -back @ turn
    stop = (np.abs(local[:, :2]) <= setup.geometry.tan_half_fov * local[:, 2:]).all(axis=1)
    # Part of the window that each point represents, by the tangents of one pixel, and its light.
    seen = np.tile(area, len(balls)) * np.repeat(radius, _POINTS) ** 2 * np.maximum(facing, 0) * far / depth**3
    received = sent * (local[:, 2] / near) / near**2
    light = rays.power.mean(axis=1)[pixel] * received * (inside & stop)
    each = seen * light
    irradiance, moments = (v.reshape(len(balls), -1).sum(axis=1) for v in (each, each * light * rays.area))
    return Highlights(pixel[::_POINTS], irradiance, moments)


# -------- Direct light over sharp lobes
#
# Direct light over sharp lobes, found from the surface: how much of it there is, and whether connections can see it.
#
# Direct light is found by connecting lit points to the sensor. A connection rarely meets a lobe that is far narrower
# than the projector's window: then no estimate holds its light, no spread of estimates shows it, and the frames
# would lack it in silence. Sampled from the surface instead, such a lobe meets the sensor easily. With I the irradiance
# that a ray's connection to a sensor point stands for, uniform over the sensor's area A, and q the density [1/mm^2] of
# meeting that point by sampling the surface, a met point estimates the mean irradiance by x = I / (A q), and the second
# moment of a connection by x I. So N connections see the light L of the lobes as ``N L^2 / E[x I]`` equal hits would.

_SHARP, _LEAST_SHARP = 100.0, 10.0
"""Density [1/sr] of a turn above which its lobe counts as sharp where all turns of a pixel are (a GGX lobe of roughness
0.03). Where a part of them is, that part of it, but no less than the second (roughness 0.02 and a twentieth of the
light). Such a lobe fills 0.01 sr, a tenth of the shipped projector's window: connections meet broader ones."""
_PLENTY = 2**12
_CONNECTIONS = 2**18
_SEARCHING = 2**20
"""Connections that search faint lobes, 0.1 s: varnish of roughness 0.005 on a ball of 100 mm is met eleven times."""
_QUARTER, _ENOUGH_MET = 4, 16
"""Factor of fewer rays in the first search, and rays met on the sensor from which so few suffice."""
_FEWER, _WIDER = 16, 16.0
"""Factors of fewer rays and a wider sensor in a first search, which meets 16 times as much."""
_BROAD, _WELL_MET = 2.0, 256.0
"""Radius of lobes over the sensor's half-width beyond which none is searched, and hits that measure light to 6 %."""
_SHARPEST = 0.1


# ---- Light over sharp lobes, and the data for its search


@dataclass(frozen=True, eq=False)
class SharpLight:
    """Light over sharp lobes, without the mask.

    Attributes
    ----------
    irradiance, error, rest
        Mean over the sensor, its Monte Carlo error, and all other direct light [W m^-2].
    hits
        Connections, one of every projector pixel, that would meet a lobe.
    by_pixel, moments
        (n^2,) irradiance of each projector pixel, and the second moment of its connection [W^2 m^-4].
    width
        Radius of the lobes on the sensor [mm], sqrt(P / (pi q)), with P the part of a pixel's turns that are sharp, and
        q / P the density of a lobe by itself.
    """

    by_pixel: FloatArray
    moments: FloatArray
    error: float = 0.0
    width: float = math.inf
    rest: float = 0.0

    @property
    def irradiance(self) -> float:
        return float(self.by_pixel.sum())

    @property
    def hits(self) -> float:
        moment = float(self.moments.sum())
        return self.irradiance**2 / moment if moment else 0.0

    @classmethod
    def none(cls, pixels: int) -> SharpLight:
        return cls(np.zeros(pixels), np.zeros(pixels))


@keep_scenes()
def sharp_light(setup: OpticalSetup, seed: int, samples: int) -> SharpLight:
    """Estimate direct light over lobes too sharp for connections."""
    n, pixels = setup.projector.n, setup.projector.n**2
    least, every, count = dr.full(mi.Float, _LEAST_SHARP, pixels), np.arange(pixels), max(1, _CONNECTIONS // pixels)
    first = _trace_lobes(setup, least, every, seed, 0, -(-samples // _FEWER), _WIDER)
    if not len(first.widths):
        return SharpLight.none(pixels)
    least = device_array(mi.Float, np.clip(_SHARP * first.sharp, _LEAST_SHARP, _SHARP))
    if first.widths.min() >= _BROAD * setup.geometry.half_width:
        # Broad lobes are met by connections, which measure their light.
        met, others = (_Connections(setup, least, sharp).trace(seed, 0, count) for sharp in (True, False))
        by_pixel, moments = (np.bincount(met.pixel, met.value**power, minlength=pixels) / count for power in (1, 2))
        error = math.sqrt(max(float(moments.sum()) - float(np.square(by_pixel).sum()), 0.0) / count)
        rest, width = float(others.value.sum()) / count, float(first.widths.min())
        broad = SharpLight(by_pixel, moments, error, width, rest)
        if broad.hits * count >= _WELL_MET:
            return broad
    few = -(-samples // _QUARTER)
    found = _trace_lobes(setup, least, every, seed, 0, few)
    if len(found.widths) < _ENOUGH_MET:
        found = _trace_lobes(setup, least, every, seed, 0, samples)
    else:
        samples = few
    if len(found.widths) < _PLENTY:
        search = _Connections(setup, least, True).trace(seed, 0, max(1, _SEARCHING // pixels))
        lit = np.bincount(search.pixel, minlength=pixels)
        chosen = with_neighbours((found.by_pixel > 0) | (lit > 0), n)
        if len(chosen):
            found = _trace_lobes(setup, least, chosen, seed, samples, samples * pixels // len(chosen))
    rest, width = 0.0, math.inf
    if found.by_pixel.sum():
        rest = float(_Connections(setup, least, False).trace(seed, 0, count).value.sum()) / count
    if found.widths.size:
        order = np.argsort(found.widths)
        sums = np.cumsum(found.weights[order])
        width = float(found.widths[order][np.searchsorted(sums, _SHARPEST * sums[-1])])
    return SharpLight(found.by_pixel, found.moments, found.error, width, rest)


def with_neighbours(chosen: npt.NDArray[np.bool_], side: int) -> Labels:
    return np.flatnonzero(mean_of_neighbours(chosen.reshape(side, side).astype(np.float64)) > 0)


# ---- Light by pixel, and hits of the sensor


@dataclass(frozen=True, eq=False)
class _LobeLight:
    by_pixel: FloatArray
    moments: FloatArray
    sharp: FloatArray
    error: float
    widths: FloatArray
    weights: FloatArray


@dataclass
class _SensorHits:
    mean: mi.Float
    moment: mi.Float
    density: mi.Float
    turns: mi.Float


# ---- Connections over sharp lobes alone


class _Connections(DirectTracer):
    def __init__(self, setup: OpticalSetup, least: mi.Float, over_sharp: bool) -> None:
        super().__init__(setup, 1, spread=True)
        self._least, self._over_sharp = least, over_sharp

    def _by_connection(self, at: Arrival, sensor: mi.Point3f, pixel: mi.UInt32) -> tuple[Reception, Light]:
        reception, received = super()._by_connection(at, sensor, pixel)
        sharp = reception.pdf > dr.gather(mi.Float, self._least, pixel)
        return reception, dr.select(sharp == self._over_sharp, received, 0)


# ---- Rays that sharp lobes send to the sensor


@keep_scenes()
def _trace_lobes(
    setup: OpticalSetup, least: mi.Float, pixels: Labels, seed: int, first: int, samples: int, wider: float = 1.0
) -> _LobeLight:
    """Follow rays of some pixels over lobes sharper than ``least`` of each pixel to a ``wider`` sensor."""
    half = dr.opaque(mi.Float, wider * setup.geometry.half_width)

    def meet(seed: int, sample: mi.UInt32, pixel: mi.UInt32) -> _SensorHits:
        _, rng = base.streams(seed, pixel, sample)
        jitter = mi.Point2f(rng.next_float32(), rng.next_float32())
        wavelengths, spectral = sample_wavelengths(setup.camera, rng, setup.projector.lines)
        ray = setup.rays.sample(pixel, jitter, rng, wavelengths)
        flux, own_least = setup.rays.flux(pixel, wavelengths) * spectral, dr.gather(mi.Float, least, pixel)

        def meet_sensor(at: Arrival, state: tuple[_SensorHits, mi.PCG32]) -> tuple[_SensorHits, mi.PCG32]:
            met, rng = state
            turn = at.turn(rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()))
            density = at.density(turn.wo)
            active = at.active & (turn.pdf > 0) & (density > 0) & ~mi.has_flag(turn.sampled_type, mi.BSDFFlags.Delta)
            turns = dr.select(active & (density > own_least), mi.Float(1), 0)
            place = landing(setup, at.si, at.si.to_world(turn.wo), active)
            active &= place.arrives & (dr.abs(place.x) <= half) & (dr.abs(place.y) <= half)
            sensor = mi.Point3f(place.x, place.y, 0)
            reception = setup.receive(at.si, -at.direction, sensor, active)
            active &= reception.pdf > own_least
            per_area = density * reception.solid_angle(sensor)
            connected = dr.select(active, base.panchromatic(reception.irradiance * at.light), 0)
            mean = dr.select(active, connected / (4 * dr.square(half) * per_area), 0)
            # One of the hits, drawn in proportion to its light, gives the density of all.
            total = met.mean + mean
            new = rng.next_float32() * total < mean
            density = dr.select(new, per_area, met.density)
            return _SensorHits(total, met.moment + mean * connected, density, met.turns + turns), rng

        none = _SensorHits(mi.Float(0), mi.Float(0), mi.Float(1), mi.Float(0))
        return setup.passage.along(ray, flux, (none, rng), meet_sensor)[0]

    squares, met, weights = 0.0, [], []
    by_pixel, moments = np.zeros((2, setup.projector.n**2))
    turned = dr.zeros(mi.Float, len(by_pixel))
    for sample, place in launches(len(pixels), first, samples):
        pixel = dr.gather(mi.UInt32, device_array(mi.UInt32, pixels), place)
        hits = meet(seed, sample, pixel)
        # Whole numbers, whose sums in any order are the same.
        dr.scatter_reduce(dr.ReduceOp.Add, turned, hits.turns, pixel, hits.turns > 0)
        # Few rays meet the sensor: of the others nothing is fetched. What is not a number is no zero either.
        lit = ~(hits.mean == 0)
        dr.eval(hits, turned, lit)
        lit = dr.compress(lit)
        number = np.array(dr.gather(mi.UInt32, pixel, lit), dtype=np.int64)
        mean, product, density = (
            np.array(dr.gather(mi.Float, values, lit), dtype=np.float64)
            for values in (hits.mean, hits.moment, hits.density)
        )
        check_finite(mean)
        check_finite(product)
        by_pixel += np.bincount(number, mean, minlength=len(by_pixel)) / samples
        moments += np.bincount(number, product, minlength=len(by_pixel)) / samples
        squares += float(np.square(mean).sum())
        met.append((number, density))
        weights.append(mean)
    sharp = np.array(turned, dtype=np.float64) / samples
    variance = max(squares / samples - float(by_pixel.sum()) ** 2 / len(pixels), 0.0)
    pixel_of, densities = (np.concatenate(parts) for parts in zip(*met, strict=True))
    widths = np.sqrt(sharp[pixel_of] / (np.pi * densities))
    return _LobeLight(by_pixel, moments, sharp, math.sqrt(variance / samples), widths, np.concatenate(weights))
