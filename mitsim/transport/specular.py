"""Specular chains: beams that reach the sensor from a pinhole projector over perfect mirrors alone, or directly.

A path projector - mirror - sensor has a delta at both ends, so no path from the camera finds it. Such light is traced
from the projector through a grid of points of each pixel. Four neighbours that
met the same surfaces in the same way (the same *chain*) bound a beam. Beams near the sensor are divided until the map
from the window to the sensor is bilinear over each. The flux of a beam is its area on the plane at unit distance times
the projector's irradiance there, pi x scale x texture.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import device_array, keep_scenes
from mitsim.core.errors import MitsimError
from mitsim.optics.frames import Beams
from mitsim.optics.image_formation import IntArray
from mitsim.transport.connect import PinholeRays, ProjectorOptics, wavelength_sets
from mitsim.transport.plugins.base import Surface, channels, device_vectors, host_values, turn_and_origin, vectors
from mitsim.transport.transmission import CLEAR, flat_panes, transmits

# -------- Rays that follow perfect mirrors, from points of the window to where they cross the sensor plane
#
# Mitsuba's float32 is good to about 1e-4 mm at the sensor: 1 % of a pixel, and as much error in a masked frame. So each
# hit is computed again in float64: the ray meets the tangent plane of the surface, and is reflected or refracted there.
# Round surfaces and smooth meshes are met in float64 too.

Chains = npt.NDArray[np.uint64]
Mask = npt.NDArray[np.bool_]
_FAINTEST = 1e-5
"""Part of its light at which a ray ends, after three or four reflections of glass: a hundredth of accuracy 1e-3."""
_AGREEMENT = 1e-4
_OFFSET = 1e-4
"""Start of a ray off its surface, for each mm of its coordinates: Mitsuba's own ray epsilon."""
_GRAZING = 0.02
_CHAIN = np.uint64(0x9E3779B97F4A7C15)


@dataclass(frozen=True, eq=False)
class Crossings:
    """Rays that crossed the sensor plane from the front: (k, 2) place [mm] and tan-angles (row, column).

    One ray may arrive several times.
    """

    ray: IntArray
    chain: Chains
    sensor: FloatArray
    tangent: FloatArray
    throughput: FloatArray


@dataclass(frozen=True, eq=False)
class Rays:
    index: IntArray
    mirror: IntArray
    origin: FloatArray
    direction: FloatArray
    start: FloatArray
    chain: Chains
    spectrum: FloatArray


Some = TypeVar("Some", Crossings, Rays)


def join(parts: Sequence[Some]) -> Some:
    return type(parts[0])(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))


class SpecularRays:
    """Rays of a projector over delta reflections, refractions and straight transmissions to the sensor plane.

    A ray goes both ways where a surface reflects and transmits, and ends where it scatters, because the camera finds
    that light.
    """

    def __init__(self, scene: mi.Scene, camera: mi.Sensor, projector: ProjectorOptics, max_depth: int) -> None:
        self._scene, self._max_depth, self.geometry, self.n = scene, max_depth, camera.geometry, projector.n
        self._clear = CLEAR if transmits(scene) else _OFFSET
        self._wavelengths = wavelength_sets(projector.lines)
        self.rays = PinholeRays(projector, self._wavelengths)
        mean = self.rays.power.mean(axis=0)
        self.colour = mean / mean.sum() if mean.sum() > 0 else np.full(len(mean), 1 / len(mean))
        # Registry numbers of materials with a delta part, by its kind and component.
        self._lobes: dict[tuple[int, int], list[int]] = {}
        straight, known = int(mi.BSDFFlags.Null), list[mi.BSDF]()
        for bsdf in (shape.bsdf() for shape in scene.shapes()):
            if bsdf is None or not bsdf.flags() & int(mi.BSDFFlags.Delta) or bsdf in known:
                continue
            known.append(bsdf)
            kinds = [int(bsdf.flags(i)) & int(mi.BSDFFlags.Delta) for i in range(bsdf.component_count())]
            parts = [(kind, i) for i, kind in enumerate(kinds) if kind not in (0, straight)]
            for part in [(straight, 0)] * (straight in kinds) + parts:
                number = np.array(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf)))
                self._lobes.setdefault(part, []).append(int(number.ravel()[0]))
        polished = int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.DeltaTransmission)
        self.mirrors = [s for s in scene.shapes() if s.bsdf() is not None and s.bsdf().flags() & polished]
        exact = {_number(shape): exact_hits(shape) for shape in self.mirrors}
        self._exact = {number: meet for number, meet in exact.items() if meet is not None}
        self._panes = [_number(pane) for pane in flat_panes(scene)]
        self._camera_turn, self.camera_place = turn_and_origin(camera.world_transform())

    def pixel(self, row: IntArray, column: IntArray) -> IntArray:
        return (row // _UNIT) * self.n + column // _UNIT

    def fluxes(self, row: IntArray, column: IntArray, size: int) -> FloatArray:
        power = self.rays.power.mean(axis=1)[self.pixel(row, column)]
        return np.asarray(power * self.rays.area * (size / _UNIT) ** 2)

    def follow(self, points: FloatArray, turned: list[Rays] | None = None) -> Crossings:
        count = len(points)
        origin = np.broadcast_to(self.rays.origin, (count, 3))
        rays = Rays(
            np.arange(count),
            np.zeros(count, np.int64),
            origin,
            self.rays.directions(points),
            origin,
            np.zeros(count, dtype=np.uint64),
            np.ones((count, len(self.colour))),
        )
        crossings = []
        for _ in range(self._max_depth + 1):
            ray = mi.Ray3f(mi.Point3f(*device_vectors(rays.start)), mi.Vector3f(*device_vectors(rays.direction)))
            si = self._scene.ray_intersect(ray, mi.RayFlags.All, True)
            dr.eval(si)
            distance = np.where(host_values(si.is_valid(), len(rays.index)), host_values(si.t, len(rays.index)), np.inf)
            distance = distance + np.linalg.norm(rays.start - rays.origin, axis=1)
            # Those that cross the sensor plane from the front before they meet another surface.
            place = (rays.origin - self.camera_place) @ self._camera_turn
            way = rays.direction @ self._camera_turn
            ahead = (place[:, 2] > 0) & (way[:, 2] < 0)
            reach = np.full(len(ahead), np.inf)
            np.divide(-place[:, 2], way[:, 2], out=reach, where=ahead)
            arrived = ahead & (reach < distance)
            o, d, r = place[arrived], way[arrived], reach[arrived, None]
            rows_columns = -(o + d * r)[:, 1::-1], -(d / d[:, 2:])[:, 1::-1]
            light = rays.spectrum[arrived] @ self.colour
            crossings.append(Crossings(rays.index[arrived], rays.chain[arrived], *rows_columns, light))
            met = ~arrived & np.isfinite(distance)
            if turned is not None:
                own = met & (rays.mirror != 0)
                turned.append(Rays(*(values[own] for values in vars(rays).values())))
            onward = self._bounce(rays, si, met)
            if not onward:
                break
            rays = join(onward)
        return join(crossings)

    def _bounce(self, rays: Rays, si: Surface, active: Mask) -> list[Rays]:
        count = len(active)
        # Each ray meets the tangent plane of the surface, or its round or smooth shape.
        hit, geometric, normal = (vectors(v, count) for v in (si.p, si.n, si.sh_frame.n))
        with np.errstate(all="ignore"):
            geometric /= np.linalg.norm(geometric, axis=1, keepdims=True)
            along = ((hit - rays.origin) * geometric).sum(axis=1) / (rays.direction * geometric).sum(axis=1)
            point = rays.origin + rays.direction * along[:, None]
            good = np.linalg.norm(point - hit, axis=1) < 10 * _OFFSET * (1 + np.abs(hit).max(axis=1))
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        point, shading = np.where(good[:, None], point, hit), normal.copy()
        shapes = host_values(dr.reinterpret_array(mi.UInt32, si.shape), count).astype(np.uint64)
        numbers, faces = shapes.astype(np.int64), host_values(si.prim_index, count).astype(np.int64)
        for number in np.intersect1d(numbers, list(self._exact)) if self._exact else ():
            mine = np.flatnonzero(numbers == number)
            with np.errstate(all="ignore"):
                old = point[mine], geometric[mine], normal[mine]
                new = self._exact[int(number)](rays.origin[mine], rays.direction[mine], old, faces[mine])
            good = np.isfinite(new[0]).all(axis=1) & np.isfinite(new[2]).all(axis=1)
            for values, better in zip((point, geometric, normal), new, strict=True):
                values[mine[good]] = better[good]
        onward: list[Rays] = []
        materials = host_values(dr.reinterpret_array(mi.UInt32, si.bsdf()), count)
        for (lobe, component), own in self._lobes.items():
            own_lobe = active & np.isin(materials, own)
            if not own_lobe.any():
                continue
            here = mi.Bool(own_lobe)
            weights = []
            context = mi.BSDFContext(mi.TransportMode.Importance)
            context.component = component
            for wavelengths in self._wavelengths:
                if wavelengths is not None:
                    si.wavelengths = wavelengths
                sample, part = si.bsdf().sample(context, si, 0.5, mi.Point2f(0.5), here)
                if lobe == int(mi.BSDFFlags.Null):
                    # Whatever was sampled, light that passes keeps its direction.
                    part, sample.wo = si.bsdf().eval_null_transmission(si, here), -si.wi
                    sample.sampled_type, sample.eta = mi.UInt32(lobe), mi.Float(1)
                part = dr.select((sample.sampled_type & lobe) != 0, part, 0)
                weights.append(channels(mi.unpolarized_spectrum(part), dr.width(si.t)))
            weight = np.concatenate(weights, axis=1)
            kind, eta = host_values(sample.sampled_type, count), host_values(sample.eta, count)
            single = (kind & int(mi.BSDFFlags.Delta)) != 0
            spectrum = rays.spectrum * np.nan_to_num(weight)
            chosen = np.flatnonzero(own_lobe & single & ((spectrum @ self.colour) > _FAINTEST))
            traced = vectors(si.to_world(sample.wo), count)[chosen]
            turn = kind[chosen], eta[chosen], rays.direction[chosen]
            # Mitsuba's result with its own normal shows which law applies; the better normal gives the direction.
            as_by_law = np.linalg.norm(_redirect(shading[chosen], *turn) - traced, axis=1) < _AGREEMENT
            direction = np.where(as_by_law[:, None], _redirect(normal[chosen], *turn), traced)
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            slope = np.abs((direction * geometric[chosen]).sum(axis=1))
            clear = self._clear * (1 + np.abs(point[chosen]).max(axis=1, initial=0)) / np.maximum(slope, _GRAZING)
            reflected = (kind[chosen] & int(mi.BSDFFlags.DeltaReflection)) != 0
            # Mirrors of one shape that face different ways are parts of different beams.
            code = shapes[chosen] * np.uint64(2) + reflected.astype(np.uint64) + np.uint64(1)
            code += np.maximum(component - ~reflected, 0).astype(np.uint64) << np.uint64(40)
            straight = lobe == int(mi.BSDFFlags.Null)
            chain = rays.chain[chosen] if straight else rays.chain[chosen] * _CHAIN + code
            passes = straight | (np.isin(numbers[chosen], self._panes) & ~reflected)
            mirror = np.where(passes, rays.mirror[chosen], numbers[chosen])
            ways = point[chosen], direction, point[chosen] + direction * clear[:, None]
            if len(chosen):
                onward.append(Rays(rays.index[chosen], mirror, *ways, chain, spectrum[chosen]))
        return onward


def _redirect(normal: FloatArray, kind: IntArray, eta: FloatArray, direction: FloatArray) -> FloatArray:
    cosine = (direction * normal).sum(axis=1, keepdims=True)
    reflected = direction - 2 * cosine * normal
    inside = 1 - (1 - cosine**2) / eta[:, None] ** 2
    refracted = (direction - cosine * normal) / eta[:, None] + np.sign(cosine) * np.sqrt(np.maximum(inside, 0)) * normal
    polished = np.where((kind & int(mi.BSDFFlags.DeltaTransmission))[:, None] != 0, refracted, direction)
    return np.asarray(np.where((kind & int(mi.BSDFFlags.DeltaReflection))[:, None] != 0, reflected, polished))


# -------- Curved mirrors in double precision
#
# A float32 place at 400 mm is good to 3e-5 mm. On a mirror ball of 1 mm that turns the normal by 3e-5, and the light by
# half a sensor pixel; so each ray is met once more with the sphere, cylinder or triangle that it hit. Flat surfaces
# need none of it: their normal is the same all over.


Hits = tuple[FloatArray, FloatArray, FloatArray]
"""Points, geometric normals and shading normals (k, 3)."""
Meet = Callable[[FloatArray, FloatArray, Hits, IntArray], Hits]
"""Function of origins, directions, hits in single precision and numbers of faces that returns better hits."""


def exact_hits(shape: mi.Shape) -> Meet | None:
    """Return the function that meets a round or smooth shape in double precision; None for a flat one."""
    if shape.is_mesh():
        data = mi.traverse(shape)
        smooth = shape.has_vertex_normals() and not shape.has_face_normals() and "faces" in data
        return _smooth_mesh(data) if smooth else None
    kind = shape.class_name()
    if kind not in ("Sphere", "Cylinder"):
        return None
    turn, centre = turn_and_origin(mi.traverse(shape)["to_world"])
    radius = float(np.linalg.norm(turn[:, 0]))
    axis = turn[:, 2] / np.linalg.norm(turn[:, 2]) if kind == "Cylinder" else np.zeros(3)

    def across(vectors: FloatArray) -> FloatArray:
        return np.asarray(vectors - (vectors @ axis)[:, None] * axis)

    def meet(origin: FloatArray, direction: FloatArray, hits: Hits, _: IntArray) -> Hits:
        start, way = across(origin - centre), across(direction)
        a, b = np.square(way).sum(axis=1), (start * way).sum(axis=1)
        root = np.sqrt(b**2 - a * (np.square(start).sum(axis=1) - radius**2))
        near = ((hits[0] - origin) * direction).sum(axis=1)
        # Of the two, the crossing that was hit: b and a root of the other sign cancel only where it is far from both.
        first, second = (-b - root) / a, (-b + root) / a
        distance = np.where(np.abs(first - near) < np.abs(second - near), first, second)
        point = origin + direction * distance[:, None]
        normal = across(point - centre) / radius
        normal *= np.sign((normal * hits[2]).sum(axis=1))[:, None]
        return point, normal, normal

    return meet


def _smooth_mesh(data: mi.SceneParameters) -> Meet:
    corners = np.array(data["faces"]).reshape(-1, 3)
    places, normals = (
        np.array(data[name], dtype=np.float64).reshape(-1, 3)[corners]
        for name in ("vertex_positions", "vertex_normals")
    )

    def meet(origin: FloatArray, direction: FloatArray, hits: Hits, face: IntArray) -> Hits:
        corner, *others = np.moveaxis(places[face], 1, 0)
        along, across = (other - corner for other in others)
        geometric = np.cross(along, across)
        scale = (direction * geometric).sum(axis=1)
        offset = origin - corner
        turned = np.cross(offset, direction)
        b, c = (across * turned).sum(axis=1) / -scale, (along * turned).sum(axis=1) / scale
        weights = np.stack([1 - b - c, b, c], axis=1)
        normal = (normals[face] * weights[:, :, None]).sum(axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        normal *= np.sign((normal * hits[2]).sum(axis=1))[:, None]
        geometric /= np.linalg.norm(geometric, axis=1, keepdims=True)
        geometric *= np.sign((geometric * hits[1]).sum(axis=1))[:, None]
        return corner + along * b[:, None] + across * c[:, None], geometric, normal

    return meet


def _number(shape: mi.Shape) -> int:
    return int(np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))).ravel()[0])


# -------- Balls of glass, whose light comes from close to their rim

_ACROSS = 2**10
_TO_RIM = 0.25
_TOO_CLOSE = 1 / 64
"""Distance to the rim [radii] within which light is counted but not traced: 4 % of it, and 98 % of the squares."""
_FINEST = 2**10
_PIECE, _MOST_PIECES = 4.0, 2**10
Boxes = tuple[FloatArray, FloatArray, FloatArray]
"""Corners (k, 2) of boxes in the window, and the step (k,) of rays that finds their content [lattice points]."""


def grazing(tracer: SpecularRays) -> tuple[list[Boxes], float]:
    """Return where balls of glass send light to the sensor from near their rim, and the flux too near to trace.

    Light that is reflected inside a ball leaves more steeply the closer to the rim it entered. Rays across the middle
    of each ball, in its plane with projector and sensor, show where; by symmetry the rest lies on an arc.
    """
    glass, half_width = int(mi.BSDFFlags.DeltaTransmission), tracer.geometry.half_width
    balls = [s for s in tracer.mirrors if s.class_name() == "Sphere" and s.bsdf().flags() & glass]
    if not balls:
        return [], 0.0
    across = np.sin((np.arange(_ACROSS) + 0.5) / _ACROSS * np.pi - np.pi / 2)
    planes = [_Plane(ball, tracer) for ball in balls]
    met = tracer.follow(np.concatenate([tracer.rays.points(plane.places(across, 0 * across))[0] for plane in planes]))
    found, left = [], 0.0
    for chain in np.unique(met.chain):
        own = np.flatnonzero(met.chain == chain)
        order = own[np.argsort(met.ray[own], kind="stable")]
        one, other = order[:-1], order[1:]
        beside = (met.ray[other] == met.ray[one] + 1) & (met.ray[other] % _ACROSS != 0)
        one, other = one[beside], other[beside]
        distance = np.linalg.norm(met.sensor[other] - met.sensor[one], axis=1)
        near = (
            np.linalg.norm((met.sensor[one] + met.sensor[other]) / 2, axis=1) < distance / 2 + math.sqrt(2) * half_width
        )
        for first, width in zip(one[near], distance[near], strict=True):
            ball, place = divmod(int(met.ray[first]), _ACROSS)
            plane, part = planes[ball], across[place : place + 2]
            arc = plane.arc(part)
            if 1 - np.abs(part).max() > _TOO_CLOSE and arc[2].min() > _FINEST:
                found.append(arc)
            else:
                met_by = min(2 * half_width / width, 1.0) * float(met.throughput[first])
                left += met_by * plane.flux(part)
    return found, left


class _Plane:
    def __init__(self, ball: mi.Shape, tracer: SpecularRays) -> None:
        box, self.rays, origin = ball.bbox(), tracer.rays, tracer.rays.origin
        to_ball = np.array(box.center(), dtype=np.float64).ravel() - origin
        self.distance, self.radius = float(np.linalg.norm(to_ball)), float(np.array(box.extents()).max()) / 2
        ahead, to_sensor = to_ball / self.distance, tracer.camera_place - origin
        across = to_sensor - (to_sensor @ ahead) * ahead
        aside, half_width = float(np.linalg.norm(across)), tracer.geometry.half_width
        self.half_angle = min(math.pi, math.sqrt(2) * half_width / max(aside, half_width / 4))
        if aside < 1e-9 * self.distance:  # all directions are alike
            across = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
        across /= np.linalg.norm(across)
        self.axes = ahead, across, np.cross(ahead, across)

    def places(self, across: FloatArray, turned: FloatArray) -> FloatArray:
        sine = across * min(self.radius / self.distance, 1.0)
        ahead, aside, out = self.axes
        to = np.cos(turned)[:, None] * aside + np.sin(turned)[:, None] * out
        ways = np.sqrt(1 - sine**2)[:, None] * ahead + sine[:, None] * to
        return np.asarray(self.rays.origin + self.distance * ways)

    def arc(self, across: FloatArray) -> Boxes:
        step, wide, rays = _TO_RIM * (1 - float(np.abs(across).max())), self.half_angle, self.rays
        low, high = float(across.min()) - step, float(across.max()) + step
        count = min(math.ceil(2 * wide / (_PIECE * step)), _MOST_PIECES)
        ends = np.linspace(-wide, wide, count + 1)
        corners = [
            rays.points(self.places(np.full(count, part), turned))[0] * _UNIT
            for part in (low, high)
            for turned in (ends[:-1], ends[1:])
        ]
        depth = float(rays.points((rays.origin + self.distance * self.axes[0])[None])[1][0])
        scale = _UNIT / (math.sqrt(rays.area) * depth)
        return np.min(corners, axis=0), np.max(corners, axis=0), np.full(count, step * self.radius * scale)

    def flux(self, across: FloatArray) -> float:
        ring = abs(across[1] ** 2 - across[0] ** 2) / 2 * (self.radius / self.distance) ** 2
        return float(self.rays.power.mean() * ring * 2 * self.half_angle)


# -------- Beams of four rays of one chain

_UNIT = 2**24
"""Lattice points along a projector pixel: a ball of 10 um lights a sensor through 0.1 um of a pixel of 2 mm."""
_DIVISIONS = 2**14
"""Most parts along a square of the first grid: a rim in a pixel of 300 sensor pixels is found to a 20th of one."""
_DEEPER = 2**4
_MOST = 2**16
"""Squares of one size beyond which none is divided: a wire of 0.15 mm reaches it, in 5 processor seconds."""
_AT_ONCE = 2**18
_COARSE = 128
"""Fewest coarse beams along the window: a mirror of a hundredth of the window is found."""
_TURNED, _MIRRORS = 256, 16
_ACROSS_SENSOR = 128
"""Rays across a sensor in the projector's direct light: a hole that lights a 128th of it is found."""
_TOLERANCE = 0.02
"""Largest departure from a bilinear map, in sensor pixels: twice float32's error at the sensor."""
_SHADES = 0.01
_SMALL = 2.0
"""Sensor pixels below which whole beams are not divided."""
_PAINT = 0.5
_RIM = 1 / 16
"""The limit for beams that a rim cuts: 1.5 % of a pixel along a straight rim; each halving doubles the beams."""
_SHARES = np.outer([0.25, 0.5, 0.25], [0.25, 0.5, 0.25])
_MARGIN = 0.02
_ARRAYS = ("pixel", "flux", "sensor", "tangent", "throughput")


@keep_scenes()
def trace_specular_chains(
    scene: mi.Scene, camera: mi.Sensor, projector: ProjectorOptics, max_depth: int = _MIRRORS
) -> Beams:
    """Return the beams from the projector's pinhole to the sensor over perfect mirrors or lenses alone, or directly.

    A mirror that no ray of the coarse grid meets is not found.
    """
    if max_depth < 1:
        raise MitsimError(f"max_depth of specular chains is {max_depth}; give at least 1")
    half = camera.geometry.half_width
    nothing = np.zeros((0, 2, 2, 2))
    parts = [Beams(np.zeros(0, np.int64), np.zeros(0), nothing, nothing, np.zeros((0, 2, 2)), 0.0)]
    left = np.zeros(2)
    # A sensor within the window is searched as finely as small mirrors.
    sides = np.array([[half], [2 * half / _ACROSS_SENSOR]])
    for each in projector.per_wavelength:
        tracer = SpecularRays(scene, camera, each, max_depth)
        arcs, close = grazing(tracer)
        left[0] += close
        arcs.append(_window_boxes((tracer.camera_place[None], *sides), tracer.rays))
        for size, row, column in first_squares(tracer, _COARSE, arcs):
            for first in range(0, len(row), _AT_ONCE):
                chosen = slice(first, first + _AT_ONCE)
                down, across = row[chosen], column[chosen]
                crossings, place = _trace_squares(tracer, down, across, np.array([0, size]))
                # Squares that a chain has a corner of, one for each chain; corners by the ray that they are.
                chains, number = np.unique(crossings.chain, return_inverse=True)
                order = np.argsort(place.ravel(), kind="stable")
                corner = place.ravel()[order]
                low, high = (np.searchsorted(corner, crossings.ray, side=side) for side in ("left", "right"))
                counts = high - low
                touched = order[np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts - low, counts)] // 4
                pairs = np.unique(np.repeat(number, counts) * len(down) + touched)
                chain, square = np.divmod(pairs, len(down))
                nodes = _nodes(crossings, chains[chain], place[square])
                spread = _spread(nodes, np.full((len(square), 2), np.inf))
                near = _near(tracer, nodes, spread)
                square = square[near]
                beams, lost = _refine(tracer, chains[chain[near]], down[square], across[square], spread[near], size)
                parts += beams
                left += lost
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
    return Beams(**arrays, unresolved=float(left[0]), error=math.sqrt(left[1]))


def turned_by_mirrors(scene: mi.Scene, camera: mi.Sensor, projector: ProjectorOptics) -> Rays:
    """Return the rays that mirrors have turned, before each surface, for a grid over the window."""
    parts = list[Rays]()
    for each in projector.per_wavelength:
        tracer = SpecularRays(scene, camera, each, _MIRRORS)
        for size, row, column in first_squares(tracer, _TURNED):
            turned = list[Rays]()
            tracer.follow((np.stack([row, column], axis=1) + size / 2) / _UNIT, turned)
            rays, area = join(turned), tracer.rays.area * (size / _UNIT) ** 2
            flux = tracer.fluxes(row, column, size)[rays.index] * (rays.spectrum @ tracer.colour)
            parts.append(replace(rays, spectrum=np.stack([flux, flux / area], axis=1)))
    return join(parts)


# -------- Nodes: quantities at points of the lattice


@dataclass(frozen=True, eq=False)
class _Nodes:
    valid: Mask
    sensor: FloatArray
    tangent: FloatArray
    throughput: FloatArray

    def take(self, index: Any) -> _Nodes:
        return _Nodes(self.valid[index], self.sensor[index], self.tangent[index], self.throughput[index])

    def quarter(self, i: int, j: int) -> _Nodes:
        return self.take((slice(None), slice(i, i + 2), slice(j, j + 2)))


def _trace_squares(
    tracer: SpecularRays, row: IntArray, column: IntArray, steps: IntArray
) -> tuple[Crossings, IntArray]:
    rows, columns = np.broadcast_arrays(row[:, None, None] + steps[:, None], column[:, None, None] + steps)
    line, number = np.unique(columns, return_inverse=True)
    key, place = np.unique(rows.ravel() * len(line) + number.ravel(), return_inverse=True)
    row, number = np.divmod(key, max(1, len(line)))
    return tracer.follow(np.stack([row, line[number]], axis=1) / _UNIT), place.reshape(rows.shape)


def _nodes(crossings: Crossings, chain: Chains, place: IntArray) -> _Nodes:
    chains, number = np.unique(crossings.chain, return_inverse=True)
    rays = int(max(place.max(initial=0), crossings.ray.max(initial=0))) + 1
    key = number * rays + crossings.ray
    order = np.argsort(key, kind="stable")
    mine = np.searchsorted(chains, chain)
    known = mine < len(chains)
    known[known] = chains[mine[known]] == chain[known]
    wanted = np.where(known, mine, len(chains))[:, None, None] * rays + place
    if not len(order):
        nothing = np.full((*wanted.shape, 2), np.nan)
        return _Nodes(np.zeros(wanted.shape, bool), nothing, nothing, np.zeros(wanted.shape))
    # The last of equal ones.
    at = order[np.maximum(np.searchsorted(key[order], wanted, side="right") - 1, 0)]
    valid = key[at] == wanted
    sensor, tangent = (np.where(valid[..., None], v[at], np.nan) for v in (crossings.sensor, crossings.tangent))
    return _Nodes(valid, sensor, tangent, np.where(valid, crossings.throughput[at], 0))


# -------- Division of squares until light is bilinear over each


def _refine(
    tracer: SpecularRays, chain: Chains, row: IntArray, column: IntArray, spread: FloatArray, size: int
) -> tuple[list[Beams], FloatArray]:
    parts, geometry = list[Beams](), tracer.geometry
    unresolved = variance = 0.0
    finest, pitch = max(1, size // _DIVISIONS), min(geometry.pitches)
    while len(row):
        half = size // 2
        crossings, place = _trace_squares(tracer, row, column, half * np.arange(3))
        nodes = _nodes(crossings, chain, place)
        extent = _size(*_box(nodes.valid, nodes.sensor))
        whole = nodes.valid.all(axis=(1, 2))
        smooth = (_departure(nodes.sensor) < _TOLERANCE * pitch) & (extent < geometry.half_width)
        even = _departure(nodes.throughput[..., None]) <= _SHADES * nodes.throughput.max(axis=(1, 2))
        done = whole & (smooth | (extent < _SMALL * pitch)) & (even | (extent < _PAINT * pitch))
        spread = _spread(nodes, spread)
        edge = ~whole & (spread[:, 0] < _RIM * pitch)
        # Light that small balls send to each other is faint, and its place is known too late.
        unknown = (half <= finest * _DEEPER) & (spread[:, 0] > pitch)
        lost = ~done & (edge | unknown | (half == finest) | (len(row) > _MOST))
        # Squares that are given up become points of light at those of their nodes that the sensor sees.
        left, flux = nodes.take(lost), tracer.fluxes(row, column, size)[lost]
        seen = left.valid & (np.abs(left.sensor) < geometry.half_width).all(axis=-1)
        seen &= (np.abs(left.tangent) <= geometry.tan_half_fov).all(axis=-1)
        if len(row) <= _MOST:
            light = _SHARES * left.throughput * flux[:, None, None]
            unresolved += float(light[seen & unknown[lost][:, None, None]].sum())
            seen &= ~unknown[lost][:, None, None]
        number, i, j = np.nonzero(seen)
        light = (_SHARES * left.throughput * flux[:, None, None])[number, i, j]
        sensor, tangent = (
            np.broadcast_to(values[number, i, j][:, None, None], (len(number), 2, 2, 2))
            for values in (left.sensor, left.tangent)
        )
        pixel = tracer.pixel(row, column)[lost][number]
        parts.append(Beams(pixel, light, sensor, tangent, np.ones((len(number), 2, 2)), 0.0))
        variance += float(np.square(np.bincount(number, light)).sum()) if len(number) else 0.0
        following = []
        for i, j in np.ndindex(2, 2):
            corners, at = nodes.quarter(i, j).take(done), (row[done] + i * half, column[done] + j * half)
            flux = tracer.fluxes(*at, half)
            parts.append(Beams(tracer.pixel(*at), flux, corners.sensor, corners.tangent, corners.throughput, 0.0))
            goes_on = ~done & ~lost & _near(tracer, nodes.quarter(i, j), spread)
            at = row[goes_on] + i * half, column[goes_on] + j * half
            following.append((chain[goes_on], *at, spread[goes_on]))
        chain, row, column, spread = (np.concatenate(part) for part in zip(*following, strict=True))
        size = half
    return parts, np.array([unresolved, variance])


def _box(valid: Mask, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    low, high = (np.where(valid[..., None], values, limit) for limit in (np.inf, -np.inf))
    return low.min(axis=(1, 2)), high.max(axis=(1, 2))


def _size(low: FloatArray, high: FloatArray) -> FloatArray:
    return np.asarray(np.where(np.isfinite(low), high - low, 0).max(axis=-1))


def _spread(nodes: _Nodes, before: FloatArray) -> FloatArray:
    sizes = np.stack([_size(*_box(nodes.valid, values)) for values in (nodes.sensor, _sines(nodes))], axis=1)
    return np.asarray(np.where(sizes > 0, sizes, before))


def _near(tracer: SpecularRays, nodes: _Nodes, spread: FloatArray) -> Mask:
    """Return (q,) True for squares that may light the sensor within the field stop."""
    geometry = tracer.geometry
    sine = geometry.tan_half_fov / np.hypot(1, geometry.tan_half_fov)
    whole = nodes.valid.all(axis=(1, 2))
    near = nodes.valid.any(axis=(1, 2))
    of_places = nodes.sensor, spread[:, 0], geometry.half_width + max(geometry.pitches)
    for values, above, reach in (of_places, (_sines(nodes), spread[:, 1], sine + _MARGIN)):
        low, high = _box(nodes.valid, values)
        margin = np.where(whole, _size(low, high) / 2, above)[:, None]
        with np.errstate(invalid="ignore"):
            near &= ((low - margin < reach) & (high + margin > -reach)).all(axis=1)
    return np.asarray(near)


def _sines(nodes: _Nodes) -> FloatArray:
    return np.asarray(nodes.tangent / np.sqrt(1 + np.square(nodes.tangent).sum(axis=-1, keepdims=True)))


def _departure(values: FloatArray) -> FloatArray:
    blend = np.array([[1, 0], [0.5, 0.5], [0, 1]])
    flat = np.einsum("ia,jb,qabk->qijk", blend, blend, values[:, ::2, ::2])
    return np.asarray(np.linalg.norm(values - flat, axis=-1).max(axis=(1, 2)))


# -------- Small mirrors: how finely each square of a grid over the window is divided
#
# A ball of 0.4 mm lies between the rays of a grid of 1 mm, and still sends the projector's light to the sensor. So rays
# are aimed: each mirror is cut into *spots* no larger than a few squares, and where these are seen, squares are divided
# until several rays meet the smallest of them.

_ACROSS_BALL = 0.25
"""Step of the finer grid in radii of a ball, disk or wire: some 50 rays meet a ball."""
_ACROSS_FACE = 1 / 3
"""Step in heights of a flat facet, whose inscribed circle contains a point of any such grid."""
_ACROSS_SMOOTH = 1.0
_SPOT_MARGIN = 1.5
"""Radius of a spot in the window over that at the axis: perspective stretches by 1 / cos^2, 1.3 at 30 degrees."""
_BOXES_AT_ONCE = 2**20
_MOST_SPOTS = 2**21


Spots = tuple[FloatArray, FloatArray, FloatArray]
"""Centres (k, 3), radii (k,) and steps (k,) of parts of mirrors [mm]."""


def first_squares(
    tracer: SpecularRays, coarse: int, more: Sequence[Boxes] = ()
) -> Iterator[tuple[int, IntArray, IntArray]]:
    rays, n = tracer.rays, tracer.n
    size = _UNIT // min(_UNIT, 2 ** max(0, int(np.ceil(np.log2(coarse / n)))))
    line = np.arange(0, n * _UNIT, size)
    row, column = (axis.ravel() for axis in np.meshgrid(line, line, indexing="ij"))
    cell = size / _UNIT * np.sqrt(rays.area)  # side of a square at unit distance
    spots = [_window_boxes(_spots(shape, rays, cell), rays) for shape in tracer.mirrors]
    spots = [(low, high, np.maximum(step, _DIVISIONS)) for low, high, step in spots]
    none = np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
    low, high, step = (np.concatenate(parts) for parts in zip(none, *spots, *more, strict=True))
    low, high = (np.clip(ends, -1.0, n * _UNIT) for ends in (low, high))  # what is beside the window may be far
    while len(row):
        small = step < size
        low, high, step = low[small], high[small], step[small]
        divided = np.zeros(len(row), dtype=bool)
        if len(low):  # squares that one of the boxes meets
            first, last = (np.floor(ends / size).astype(np.int64) for ends in (low, high))
            rows, columns = (last - first + 1).T
            stride = int(max((column // size).max(), last[:, 1].max())) + 2
            keys = row // size * stride + column // size
            order, counts = np.argsort(keys), rows * columns
            ends = np.cumsum(counts)
            start = np.searchsorted(ends, np.arange(0, ends[-1] + _BOXES_AT_ONCE, _BOXES_AT_ONCE), side="left")
            for begin, end in pairwise([*np.unique(np.minimum(start, len(counts) - 1)), len(counts)]):
                chosen = slice(begin, end)
                box = np.repeat(np.arange(begin, end), counts[chosen])
                place = np.arange(len(box)) - np.repeat(np.cumsum(counts[chosen]) - counts[chosen], counts[chosen])
                down, across = np.divmod(place, columns[box])
                wanted = np.unique((first[box, 0] + down) * stride + first[box, 1] + across)
                at = np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)
                divided[order[at[keys[order][at] == wanted]]] = True
        yield size, row[~divided], column[~divided]
        size //= 2
        row, column = (
            np.concatenate([axis[divided] + offset * size for offset in offsets])
            for axis, offsets in ((row, (0, 0, 1, 1)), (column, (0, 1, 0, 1)))
        )


def _window_boxes(spots: Spots, rays: PinholeRays) -> Boxes:
    centre, radius, step = spots
    place, depth = rays.points(centre)
    front = (depth > 0) & np.isfinite(place).all(axis=1)
    place, scale = place[front] * _UNIT, _UNIT / (np.sqrt(rays.area) * depth[front])
    reach = (_SPOT_MARGIN * radius[front] + step[front]) * scale
    return place - reach[:, None], place + reach[:, None], step[front] * scale


def _spots(shape: mi.Shape, rays: PinholeRays, cell: float) -> Spots:
    if shape.is_mesh() and shape.class_name() != "Rectangle":
        count = shape.face_count()
        chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST_SPOTS // 4)).astype(np.uint32))
        corners = np.array(shape.face_indices(device_array(mi.UInt32, chosen))).T
        places = np.array(shape.vertex_position(device_array(mi.UInt32, corners)), dtype=np.float64).T.reshape(-1, 3, 3)
        edges = places[:, [1, 2, 0]] - places
        lengths = np.linalg.norm(edges, axis=2)
        longest = lengths.max(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            height = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / longest
        whole = np.flatnonzero(height > 0)
        smooth = shape.has_vertex_normals() and not shape.has_face_normals()
        square = cell * _depth(rays, places.mean(axis=(0, 1)))
        pieces = np.maximum(1, np.ceil(longest / np.maximum(height, square)))[whole].astype(np.int64)
        pieces = np.minimum(pieces, max(1, _MOST_SPOTS // max(1, len(whole))))
        face = np.repeat(whole, pieces)
        of_face = np.repeat(pieces, pieces)
        middle = (np.arange(len(face)) - np.repeat(np.cumsum(pieces) - pieces, pieces) + 0.5) / of_face
        at = np.argmax(lengths, axis=1)[face]
        # Pieces lie along the longest edge, and reach across by the height.
        centre = places[face, at] + middle[:, None] * edges[face, at]
        reach = np.hypot(longest[face] / of_face / 2, height[face])
        return centre, reach, (_ACROSS_SMOOTH if smooth else _ACROSS_FACE) * height[face]
    box = shape.bbox()
    if shape.class_name() == "Sphere":
        centre, radius = np.array(box.center()).ravel(), float(np.array(box.extents()).max()) / 2
        return centre[None], np.array([radius]), np.array([_ACROSS_BALL * radius])
    turn, origin = turn_and_origin(mi.traverse(shape)["to_world"])
    sides = np.linalg.norm(turn, axis=0)
    if shape.class_name() == "Cylinder":
        return _along(origin, turn[:, 2], sides[0], _ACROSS_BALL * sides[0], cell * _depth(rays, origin))
    # A rectangle or disk: two half sides.
    short, long = sorted((0, 1), key=lambda i: float(sides[i]))
    step = sides[short] * (_ACROSS_BALL if shape.class_name() == "Disk" else 2 * _ACROSS_FACE)
    start = origin - turn[:, long]
    return _along(start, 2 * turn[:, long], sides[short], step, cell * _depth(rays, origin))


def _along(start: FloatArray, way: FloatArray, radius: float, step: float, square: float) -> Spots:
    length = float(np.linalg.norm(way))
    count = min(max(1, int(np.ceil(length / max(radius, square, 1e-9)))), _MOST_SPOTS)
    middle = (np.arange(count) + 0.5) / count
    reach = np.hypot(length / count / 2, radius)
    return start + middle[:, None] * way, np.full(count, reach), np.full(count, step)


def _depth(rays: PinholeRays, place: FloatArray) -> float:
    return max(float(rays.points(place[None])[1][0]), 1.0)
