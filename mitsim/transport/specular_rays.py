"""Rays that follow perfect mirrors: from points of a pinhole projector's window to where they cross the sensor plane.

Mitsuba's float32 is good to about 1e-4 mm at the sensor: 1 % of a pixel, and as much error in a masked frame. So each
hit is computed again in float64: the ray meets the tangent plane of the surface, and is reflected or refracted there.
Round surfaces and smooth meshes are met in float64 too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.transport.connect import PinholeRays, ProjectorOptics, wavelength_sets
from mitsim.transport.plugins.base import channels, device_vectors, host_values, turn_and_origin, vectors
from mitsim.transport.transmission import CLEAR, flat_panes, transmits

IntArray = npt.NDArray[np.int64]
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
        self._scene, self._max_depth = scene, max_depth
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

    def _bounce(self, rays: Rays, si: mi.SurfaceInteraction3f, active: Mask) -> list[Rays]:
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
                old = Hits(point[mine], geometric[mine], normal[mine])
                new = self._exact[int(number)](rays.origin[mine], rays.direction[mine], old, faces[mine])
            good = np.isfinite(new.point).all(axis=1) & np.isfinite(new.normal).all(axis=1)
            for values, better in ((point, new.point), (geometric, new.geometric), (normal, new.normal)):
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


@dataclass(frozen=True, eq=False)
class Hits:
    point: FloatArray
    geometric: FloatArray
    normal: FloatArray


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
        near = ((hits.point - origin) * direction).sum(axis=1)
        # Of the two, the crossing that was hit: b and a root of the other sign cancel only where it is far from both.
        first, second = (-b - root) / a, (-b + root) / a
        distance = np.where(np.abs(first - near) < np.abs(second - near), first, second)
        point = origin + direction * distance[:, None]
        normal = across(point - centre) / radius
        normal *= np.sign((normal * hits.normal).sum(axis=1))[:, None]
        return Hits(point, normal, normal)

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
        normal *= np.sign((normal * hits.normal).sum(axis=1))[:, None]
        geometric /= np.linalg.norm(geometric, axis=1, keepdims=True)
        geometric *= np.sign((geometric * hits.geometric).sum(axis=1))[:, None]
        return Hits(corner + along * b[:, None] + across * c[:, None], geometric, normal)

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


def grazing(tracer: SpecularRays, half_width: float, unit: int) -> tuple[list[Boxes], float]:
    """Return where balls of glass send light to the sensor from near their rim, and the flux too near to trace.

    Light that is reflected inside a ball leaves more steeply the closer to the rim it entered. Rays across the middle
    of each ball, in its plane with projector and sensor, show where; by symmetry the rest lies on an arc.
    """
    glass = int(mi.BSDFFlags.DeltaTransmission)
    balls = [s for s in tracer.mirrors if s.class_name() == "Sphere" and s.bsdf().flags() & glass]
    if not balls:
        return [], 0.0
    across = np.sin((np.arange(_ACROSS) + 0.5) / _ACROSS * np.pi - np.pi / 2)
    planes = [_Plane.of(ball, tracer) for ball in balls]
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
            arc = plane.arc(part, half_width, tracer.rays, unit)
            if 1 - np.abs(part).max() > _TOO_CLOSE and arc[2].min() > _FINEST:
                found.append(arc)
            else:
                met_by = min(2 * half_width / width, 1.0) * float(met.throughput[first])
                left += met_by * plane.flux(part, half_width, tracer.rays)
    return found, left


@dataclass(frozen=True, eq=False)
class _Plane:
    origin: FloatArray
    axes: tuple[FloatArray, FloatArray, FloatArray]
    distance: float
    radius: float
    aside: float

    @classmethod
    def of(cls, ball: mi.Shape, tracer: SpecularRays) -> _Plane:
        box, origin = ball.bbox(), tracer.rays.origin
        to_ball = np.array(box.center(), dtype=np.float64).ravel() - origin
        distance = float(np.linalg.norm(to_ball))
        ahead, to_sensor = to_ball / distance, tracer.camera_place - origin
        across = to_sensor - (to_sensor @ ahead) * ahead
        aside = float(np.linalg.norm(across))
        if aside < 1e-9 * distance:  # all directions are alike
            across = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
        across /= np.linalg.norm(across)
        axes = ahead, across, np.cross(ahead, across)
        return cls(origin, axes, distance, float(np.array(box.extents()).max()) / 2, aside)

    def places(self, across: FloatArray, turned: FloatArray) -> FloatArray:
        sine = across * min(self.radius / self.distance, 1.0)
        ahead, aside, out = self.axes
        to = np.cos(turned)[:, None] * aside + np.sin(turned)[:, None] * out
        return np.asarray(self.origin + self.distance * (np.sqrt(1 - sine**2)[:, None] * ahead + sine[:, None] * to))

    def arc(self, across: FloatArray, half_width: float, rays: PinholeRays, unit: int) -> Boxes:
        step, wide = _TO_RIM * (1 - float(np.abs(across).max())), self._half_angle(half_width)
        low, high = float(across.min()) - step, float(across.max()) + step
        count = min(math.ceil(2 * wide / (_PIECE * step)), _MOST_PIECES)
        ends = np.linspace(-wide, wide, count + 1)
        corners = [
            rays.points(self.places(np.full(count, part), turned))[0] * unit
            for part in (low, high)
            for turned in (ends[:-1], ends[1:])
        ]
        scale = unit / (
            math.sqrt(rays.area) * float(rays.points((self.origin + self.distance * self.axes[0])[None])[1][0])
        )
        return np.min(corners, axis=0), np.max(corners, axis=0), np.full(count, step * self.radius * scale)

    def flux(self, across: FloatArray, half_width: float, rays: PinholeRays) -> float:
        ring = abs(across[1] ** 2 - across[0] ** 2) / 2 * (self.radius / self.distance) ** 2
        return float(rays.power.mean() * ring * 2 * self._half_angle(half_width))

    def _half_angle(self, half_width: float) -> float:
        return min(math.pi, math.sqrt(2) * half_width / max(self.aside, half_width / 4))
