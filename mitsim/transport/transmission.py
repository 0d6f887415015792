"""Light that passes surfaces: the way between two points of a scene, and the part of the light it keeps.

The *null lobe* of a cut-out (``mask``), a thin pane (``thindielectric``) or a filter lets a part of the light go
straight on. Flat glass bends it, but to one way between two points only. Such light is therefore treated as without the
surface, but weaker: direct light stays direct.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.environment import device_array
from mitsim.transport.plugins.base import Surface, generator
from mitsim.transport.plugins.materials import is_glass

CLEAR = 32 * 2.0**-24
"""Start of a ray beyond a surface per mm of coordinates: 32 float32 roundings, 8e-4 mm at 400 mm (Mitsuba 0.036)."""
_LOOSE = 1500 * 2.0**-24
"""Start beyond an instance, as far as Mitsuba's own rays: its points are 100 roundings wrong. Points of a cylinder are
up to 6e-8 D^2 / r wrong, 1e-3 mm of a radius r of 6 mm at a distance D of 300. Its rays are Mitsuba's, which start
along the normal: along a grazing ray the distance is longer than the way through a rod of 4 mm."""
_GRAZING = 0.02
State = TypeVar("State", bound=tuple[object, ...])


def lets_through(material: mi.BSDF) -> bool:
    return bool(int(material.flags()) & (int(mi.BSDFFlags.Transmission) | int(mi.BSDFFlags.Null)))


def transmits(scene: mi.Scene) -> bool:
    materials = [shape.bsdf() for shape in scene.shapes()]
    instances = any(shape.class_name() == "Instance" for shape in scene.shapes())
    return instances or any(bsdf is not None and lets_through(bsdf) for bsdf in materials)


@dataclass
class Arrival:
    si: mi.SurfaceInteraction3f
    direction: mi.Vector3f
    light: mi.Spectrum
    active: mi.Bool

    def turn(self, number: mi.Float, point: mi.Point2f) -> mi.BSDFSample3f:
        self.si.wi = self.si.to_local(-self.direction)
        context = mi.BSDFContext(mi.TransportMode.Importance)
        return self.si.bsdf().sample(context, self.si, number, point, self.active)[0]

    def density(self, local: mi.Vector3f) -> mi.Float:
        self.si.wi = self.si.to_local(-self.direction)
        return self.si.bsdf().pdf(mi.BSDFContext(mi.TransportMode.Importance), self.si, local, self.active)


@dataclass
class Passed:
    direction: mi.Vector3f
    part: mi.Spectrum
    eta: mi.Float


class Passage:
    """Transmission of light in a scene: ``open`` if light may pass a surface straight, ``transmits`` if in any way."""

    def __init__(self, scene: mi.Scene) -> None:
        self.scene, self.panes = scene, flat_panes(scene)
        self._instanced = any(shape.class_name() == "Instance" for shape in scene.shapes())
        self._round = any(int(shape.shape_type()) == int(mi.ShapeType.Cylinder) for shape in scene.shapes())
        self.open, self.transmits = self._instanced or bool(self.panes), transmits(scene)
        for bsdf in (shape.bsdf() for shape in scene.shapes()):
            self.open |= bsdf is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)

    def between(self, si: Surface, target: mi.Point3f, active: mi.Bool) -> tuple[mi.Bool, mi.Spectrum]:
        if not self.open:
            return ~self.scene.ray_test(self.leaving_to(si, target), active), mi.Spectrum(1)
        ray = self.leaving_to(si, target)

        def advance(active: mi.Bool, ray: mi.Ray3f, part: mi.Spectrum) -> tuple[mi.Bool, mi.Ray3f, mi.Spectrum]:
            met = self.next_surface(ray, active)
            active &= met.is_valid()
            part = dr.select(active, part * self.straight(met, active), part)
            active &= dr.max(part) > 0
            onward = self.leaving_to(met, target)
            for name in ("o", "d", "maxt"):
                setattr(ray, name, dr.select(active, getattr(onward, name), getattr(ray, name)))
            return active, ray, part

        state = mi.Bool(active), ray, mi.Spectrum(1)
        _, _, part = dr.while_loop(state, lambda active, *_: active, advance, labels=("active", "ray", "part"))
        return dr.max(part) > 0, part

    def along(self, ray: mi.Ray3f, light: mi.Spectrum, state: State, visit: Callable[[Arrival, State], State]) -> State:
        if not self.open:
            si = self.scene.ray_intersect(ray, mi.RayFlags.All, True)
            return visit(Arrival(si, ray.d, light, si.is_valid()), state)

        def advance(active: mi.Bool, ray: mi.Ray3f, light: mi.Spectrum, *state: object) -> tuple[object, ...]:
            si = self.next_surface(ray, active, coherent=True)
            active &= si.is_valid()
            # Before the visit, which may turn the surface to where it is seen from.
            passed = self.through(si, ray.d, active)
            onward = self.onward(si, passed.direction)
            state = visit(Arrival(si, ray.d, light, active), state)  # type: ignore[arg-type]
            light = light * passed.part
            return active & (dr.max(light) > 0), onward, light, *state

        begun = mi.Bool(True), ray, light, *state
        return dr.while_loop(begun, lambda active, *_: active, advance)[3:]  # type: ignore[no-any-return]

    def next_surface(self, ray: mi.Ray3f, active: mi.Bool, coherent: bool = False) -> Surface:
        """Return the next surface on a ray, never behind its start, so that the ray advances.

        On the thin triangles of a wire, single precision may put the point 0.01 mm behind the ray's start.
        """
        si = self.scene.ray_intersect(ray, mi.RayFlags.All, coherent, active)
        si.p = dr.select(dr.dot(si.p - ray.o, ray.d) > 0, si.p, ray(si.t))
        return si

    @staticmethod
    def straight(si: Surface, active: mi.Bool) -> mi.Spectrum:
        return mi.unpolarized_spectrum(si.bsdf().eval_null_transmission(si, active))

    def through(self, si: Surface, direction: mi.Vector3f, active: mi.Bool) -> Passed:
        passed = Passed(mi.Vector3f(direction), self.straight(si, active), mi.Float(1))
        if self.panes:
            context = mi.BSDFContext(mi.TransportMode.Importance)
            context.type_mask = int(mi.BSDFFlags.DeltaTransmission)
            glass = active & self.is_pane(si)
            sample, weight = si.bsdf().sample(context, si, 0.5, mi.Point2f(0.5), glass)
            bent = glass & (sample.pdf > 0)
            passed.direction = dr.select(bent, si.to_world(sample.wo), passed.direction)
            passed.part = dr.select(bent, mi.unpolarized_spectrum(weight), passed.part)
            passed.eta = dr.select(bent, sample.eta, passed.eta)
        return passed

    def is_pane(self, si: Surface) -> mi.Bool:
        found = mi.Bool(False)
        for pane in self.panes:
            found |= si.shape == pane
        return found

    def passes(self, si: Surface, sample: mi.BSDFSample3f) -> mi.Bool:
        if not self.open:
            return mi.Bool(False)
        bent = self.is_pane(si) & mi.has_flag(sample.sampled_type, mi.BSDFFlags.DeltaTransmission)
        return mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null) | bent

    def clear(self, si: Surface, direction: mi.Vector3f) -> mi.Float:
        slope = dr.maximum(dr.abs(dr.dot(si.n, direction)), _GRAZING)
        clear = mi.Float(CLEAR)
        if self._instanced:
            clear = dr.select(si.instance != dr.zeros(mi.ShapePtr), _LOOSE, CLEAR)
        return clear * (1 + dr.max(dr.abs(si.p))) / slope

    def onward(self, si: Surface, direction: mi.Vector3f) -> mi.Ray3f:
        """Return a ray that starts beyond the surface on the line through the point; beside it for a cylinder."""
        start = si.p + direction * self.clear(si, direction)
        if self._round:
            start = dr.select(_is_round(si), si.spawn_ray(direction).o, start)
        return mi.Ray3f(start, direction, si.time, si.wavelengths)

    def leaving(self, si: Surface, direction: mi.Vector3f) -> mi.Ray3f:
        return self.onward(si, direction) if self.transmits else si.spawn_ray(direction)

    def leaving_to(self, si: Surface, target: mi.Point3f) -> mi.Ray3f:
        ray = si.spawn_ray_to(target)
        if self.transmits:
            direction = dr.normalize(target - si.p)
            clear = self.clear(si, direction)
            along = mi.Ray3f(si.p + direction * clear, direction, ray.maxt - clear, ray.time, ray.wavelengths)
            ray = dr.select(_is_round(si), ray, along) if self._round else along
        return ray


def _is_round(si: Surface) -> mi.Bool:
    return si.shape.shape_type() == mi.UInt32(int(mi.ShapeType.Cylinder))


# -------- Flat panes of glass
#
# A window, an aquarium's wall, a cover glass: between a surface and the sensor or the projector are flat faces that
# bend light. A straight connection misses; but for planes there is one direction that arrives, and Newton's method
# finds it from the straight one. A ray is traced with its two differentials (Igehy 1999), which planes keep exact:
# where it crosses the target's plane, and how the crossing moves with the direction. After three or four corrections
# the same differentials give the solid angle dw that the target's area dA fills, seen from the point, in place of cos /
# r^2.
#
# Seen from the target, the point seems to lie at distance R = (dA / dw)^(1/2) on the line that its light arrives by:
# with this *apparent* point all else is as without glass, and light is weaker by the faces' transmittance. Reflections
# inside of a pane are found by paths that are followed.

_STEPS = 8
"""Corrections of a ray's direction: each squares the error, so that four bring 100 mm to float32's rounding."""
_CLOSE = 5e-4
_MET = 0.02
_LARGEST_STEP = 0.3
_MOST_FACES = 1000
_FLAT = 1e-4
"""Sine below which two normals count as one: meshes are written with five digits."""


def flat_panes(scene: mi.Scene) -> list[mi.ShapePtr]:
    """Return the shapes of smooth glass whose faces are flat, with normals along few axes."""
    panes = []
    for shape in scene.shapes():
        glass = shape.bsdf() is not None and (shape.bsdf().class_name() == "SmoothDielectric" or is_glass(shape.bsdf()))
        if glass and not shape.is_mesh() and shape.class_name() in ("Rectangle", "Disk"):
            panes.append(mi.ShapePtr(shape))
        if not glass or not shape.is_mesh() or shape.face_count() > _MOST_FACES:
            continue
        faces = dr.arange(mi.UInt32, shape.face_count())
        normal = np.array(shape.face_normal(faces), dtype=np.float64).T
        if shape.has_vertex_normals() and not shape.has_face_normals():
            corners = np.array(shape.face_indices(faces)).T
            shading = np.array(shape.vertex_normal(device_array(mi.UInt32, corners)), dtype=np.float64).T
            if np.abs(np.cross(shading, np.repeat(normal, 3, axis=0))).max() > _FLAT:
                continue
        cosine = np.abs(normal @ normal.T)
        if np.minimum(cosine, 1 - cosine).max() < _FLAT:
            panes.append(mi.ShapePtr(shape))
    return panes


@dataclass
class RefractedWay:
    direction: mi.Vector3f
    apparent: mi.Point3f
    length: mi.Float
    part: mi.Spectrum
    eta: mi.Float
    open: mi.Bool


@dataclass
class _Ray:
    active: mi.Bool
    place: mi.Point3f
    direction: mi.Vector3f
    clear: mi.Float
    place_a: mi.Vector3f
    place_b: mi.Vector3f
    direction_a: mi.Vector3f
    direction_b: mi.Vector3f
    length: mi.Float
    part: mi.Spectrum
    eta: mi.Float

    def move_crossing(self, distance: mi.Float, normal: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f]:
        moves = []
        for place, direction in ((self.place_a, self.direction_a), (self.place_b, self.direction_b)):
            at = place + direction * distance
            moves.append(at - self.direction * (dr.dot(at, normal) / dr.dot(self.direction, normal)))
        return moves[0], moves[1]


@dataclass
class _Aim:
    active: mi.Bool
    direction: mi.Vector3f
    step: mi.UInt32
    miss: mi.Float
    arriving: mi.Vector3f
    squared: mi.Float
    length: mi.Float
    part: mi.Spectrum
    eta: mi.Float


def refracted_way(passage: Passage, si: Surface, target: mi.Point3f, active: mi.Bool) -> RefractedWay:
    """Find the way through flat glass from a surface to a target."""
    facing, zero, none = dr.normalize(target - si.p), mi.Vector3f(0), mi.Float(0)

    def reach(ray: _Ray) -> mi.Float:
        return dr.dot(target - ray.place, facing) / dr.dot(ray.direction, facing)

    def advance(ray: _Ray) -> tuple[_Ray]:
        """Follow a ray and its differentials through the next face before the target's plane."""
        origin = ray.place + ray.direction * ray.clear
        met = passage.next_surface(mi.Ray3f(origin, ray.direction, si.time, si.wavelengths), ray.active)
        distance = met.t + ray.clear
        before = ray.active & met.is_valid() & (distance < reach(ray))
        moves = ray.move_crossing(distance, met.n)
        passed = passage.through(met, ray.direction, before)
        # Snell: d' = d / eta + (c / eta - c') n, c and c' the cosines to the normal that faces the ray.
        normal = met.n * -dr.sign(dr.dot(met.n, ray.direction))
        cosine, inside = -dr.dot(normal, ray.direction), -dr.dot(normal, passed.direction)
        ratio = dr.rcp(passed.eta)

        def turn(direction: mi.Vector3f) -> mi.Vector3f:
            change = -dr.dot(normal, direction)
            return direction * ratio + normal * (ratio * change - dr.square(ratio) * cosine * change / inside)

        refracted = _Ray(
            before, met.p, passed.direction, passage.clear(met, passed.direction), *moves, turn(ray.direction_a),
            turn(ray.direction_b), ray.length + distance, ray.part * passed.part, ray.eta * passed.eta,
        )  # fmt: skip
        chosen = {name: dr.select(before, getattr(refracted, name), getattr(ray, name)) for name in vars(ray)}
        return (_Ray(**{**chosen, "active": before}),)

    def correct(aim: _Aim) -> tuple[_Aim]:
        """Trace the ray of a direction, and turn it by Newton's step toward the target."""
        a, b = mi.coordinate_system(aim.direction)
        clear = passage.clear(si, aim.direction)
        start = _Ray(
            mi.Bool(aim.active), si.p, aim.direction, clear, zero, zero, a, b, none, mi.Spectrum(1), mi.Float(1)
        )
        (ray,) = dr.while_loop((start,), lambda ray: ray.active, advance)
        distance = reach(ray)
        error = target - (ray.place + ray.direction * distance)
        u, v = mi.coordinate_system(facing)
        (au, av), (bu, bv), (eu, ev) = (
            (dr.dot(move, u), dr.dot(move, v)) for move in (*ray.move_crossing(distance, facing), error)
        )
        area = au * bv - av * bu
        step = a * ((eu * bv - ev * bu) / area) + b * ((au * ev - av * eu) / area)
        step *= dr.minimum(1, _LARGEST_STEP * dr.rsqrt(dr.squared_norm(step)))
        miss = dr.sqrt(dr.square(eu) + dr.square(ev))
        arrived = aim.active & (distance > 0) & dr.isfinite(miss)
        more = arrived & (miss > _CLOSE) & (aim.step + 1 < _STEPS) & dr.isfinite(dr.squared_norm(step))
        direction = dr.select(more, dr.normalize(aim.direction + step), aim.direction)
        squared = dr.abs(area * dr.dot(ray.direction, facing))
        miss, length = dr.select(arrived, miss, dr.inf), ray.length + distance
        return (_Aim(more, direction, aim.step + 1, miss, ray.direction, squared, length, ray.part, ray.eta),)

    begun = _Aim(
        mi.Bool(active), facing, mi.UInt32(0), mi.Float(dr.inf), facing, none, none, mi.Spectrum(0), mi.Float(1)
    )
    (aim,) = dr.while_loop((begun,), lambda aim: aim.active, correct)
    seen = active & (aim.miss < _MET) & (dr.max(aim.part) > 0)
    apparent = target - aim.arriving * dr.sqrt(aim.squared)
    return RefractedWay(aim.direction, apparent, aim.length, aim.part, aim.eta, seen)


# -------- Surfaces in contact with transmitting surfaces
#
# A ray that has passed a surface starts a little beyond it, and misses closer surfaces: a print in contact
# with glass comes out black. Mitsuba's own integrators start 9e-5 of the coordinates beyond, 0.036 mm at 400 mm, the
# tracers of this room CLEAR.

_OWN, _MITSUBA = 2 * CLEAR, 1.1 * 1500 * 2.0**-24
"""Gaps, for each mm of coordinates, that our tracers and Mitsuba's integrators still see."""
_POINTS, _FEWEST = 2**16, 8
_PARALLEL = 0.999
_MOST = 16


def contacts(scene: mi.Scene) -> tuple[tuple[int, str, str] | None, tuple[int, str, str] | None]:
    """Return what the factored estimator and the reference do not see behind surfaces that let light pass.

    It is the number of a shape in the scene, the distance of its neighbour, and the rule; None if all is seen. Rays go
    along the normals of points of a shape, among its neighbours alone, and with the shape itself, because surfaces that
    coincide with its own are found without it.
    """
    found: list[tuple[int, str, str] | None] = [None, None]
    shapes = list(scene.shapes())
    clear = [index for index, shape in enumerate(shapes) if shape.bsdf() is not None and lets_through(shape.bsdf())]
    for index in clear[:_MOST]:
        shape, box = shapes[index], shapes[index].bbox()
        low, high = np.array(box.min), np.array(box.max)
        reach = _MITSUBA * (1 + max(np.abs(low).max(), np.abs(high).max()))
        beside = {
            f"shape{place}": other
            for place, other in enumerate(shapes)
            if place != index
            and other.bsdf() is not None
            and (np.array(other.bbox().min) - reach <= high).all()
            and (low - reach <= np.array(other.bbox().max)).all()
        }
        scenes = [(mi.load_dict({"type": "scene", **beside, "own": shape}), 2 * CLEAR)]
        scenes += [(mi.load_dict({"type": "scene", **beside}), -CLEAR)] if beside else []
        rng = generator(mi.UInt32(0), dr.arange(mi.UInt32, _POINTS))
        sample = shape.sample_position(0, mi.Point2f(rng.next_float32(), rng.next_float32()))
        size, gap = 1 + dr.max(dr.abs(sample.p)), mi.Float(dr.inf)
        # A disk in its own plane has one normal for all points. Of a single direction for many rays Dr.Jit 1.5.0 writes
        # a kernel that LLVM cannot parse, and ends the process.
        normal = mi.Vector3f(sample.n) + 0 * sample.p
        for sign, (among, first) in product((1, -1), scenes):
            ray = mi.Ray3f(sample.p + normal * sign * (first * size), normal * sign)
            ray.maxt = (_MITSUBA - first) * size
            met = among.ray_intersect(ray)
            parallel = met.is_valid() & (dr.abs(dr.dot(met.n, normal)) > _PARALLEL)
            gap = dr.minimum(gap, dr.select(parallel, dr.abs(met.t + first * size), dr.inf))
        dr.eval(gap, size)
        gaps, sizes = np.array(gap, dtype=np.float64), np.array(size, dtype=np.float64)
        at = np.argsort(gaps / sizes)[_FEWEST - 1]
        for which, (limit, name) in enumerate(((_OWN, "the factored estimator"), (_MITSUBA, "the reference"))):
            if found[which] is None and gaps[at] < limit * sizes[at]:
                least = f"{name} needs {limit * sizes[at]:.2g} mm between a surface that transmits light and others"
                rule = f"{least}; leave a gap of air, or take one surface with the material of both"
                found[which] = index, f"another surface at a distance of {gaps[at]:.2g} mm", rule
    return found[0], found[1]
