"""Flat panes of glass: from points and targets to the way of the light that is refracted between the two.

A window, an aquarium's wall, a cover glass: between a surface and the sensor or the projector stand flat faces that
bend light. A straight connection misses; but for planes there is one direction that arrives, and Newton's method finds
it from the straight one. A ray is traced with its two differentials (Igehy 1999), which planes keep exact: where it
crosses the target's plane, and how the crossing moves with the direction. After three or four corrections the same
differentials give the solid angle dw that the target's area dA fills, seen from the point, in place of cos / r^2.

Seen from the target, the point seems to lie at distance R = (dA / dw)^(1/2) on the line that its light arrives by:
with this *apparent* point all else is as without glass, and light is weaker by the faces' transmittance. Reflections
inside of a pane are found by paths that are followed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.transport.glass import is_glass

if TYPE_CHECKING:
    from mitsim.transport.passage import Passage

_STEPS = 8
"""Most corrections of a ray's direction: each squares the error, so that four bring 100 mm to float32's rounding."""
_CLOSE = 5e-4
"""Miss [mm] at which correcting ends: three times what float32 leaves at 400 mm; it moves a shadow by 3 nm."""
_MET = 0.02
"""Miss [mm] up to which a ray has met its target: rays that a pane's edge keeps from it end far beyond."""
_LARGEST_STEP = 0.3
"""Most that a direction is corrected by at once [rad], lest one that is wrong at an edge leaves the scene."""
_MOST_FACES = 1000
"""Triangles of a mesh that is looked at: boxes and sheets have a few."""
_FLAT = 1e-4
"""Sine below which two normals count as one: meshes are written with five digits."""


def flat_panes(scene: mi.Scene) -> list[mi.ShapePtr]:
    """Shapes of a ``scene`` that are of smooth glass and flat: rectangles, disks, sheets and boxes."""
    return [
        mi.ShapePtr(shape)
        for shape in scene.shapes()
        if shape.bsdf() is not None and _is_glass(shape.bsdf()) and _is_flat(shape)
    ]


def _is_glass(material: mi.BSDF) -> bool:
    return material.class_name() == "SmoothDielectric" or is_glass(material)


def _is_flat(shape: mi.Shape) -> bool:
    if not shape.is_mesh():
        return shape.class_name() in ("Rectangle", "Disk")
    if shape.face_count() > _MOST_FACES:
        return False
    faces = np.arange(shape.face_count(), dtype=np.uint32)
    normal = np.array(shape.face_normal(mi.UInt32(faces)), dtype=np.float64).T
    if shape.has_vertex_normals() and not shape.has_face_normals():
        corners = np.array(shape.face_indices(mi.UInt32(faces))).T
        shading = np.array(shape.vertex_normal(mi.UInt32(corners.ravel())), dtype=np.float64).T
        if np.abs(np.cross(shading, np.repeat(normal, 3, axis=0))).max() > _FLAT:
            return False
    cosine = np.abs(normal @ normal.T)
    return bool(np.minimum(cosine, 1 - cosine).max() < _FLAT)


@dataclass
class Way:
    """How light gets from points of surfaces to their targets.

    Attributes
    ----------
    direction
        unit, in which it leaves the surface.
    apparent
        where the target sees the surface.
    length
        of the way [mm].
    part
        of the light that arrives.
    eta
        refractive index at the target over that at the surface.
    open
        whether there is a way.
    """

    direction: mi.Vector3f
    apparent: mi.Point3f
    length: mi.Float
    part: mi.Spectrum
    eta: mi.Float
    open: mi.Bool


@dataclass
class _Ray:
    """A ray under way: the last surface that it left, and how it moves with two turns of its start.

    ``clear`` is how far beyond that surface it is looked on from, ``part`` what is left of its light.
    """

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

    def moved(self, distance: mi.Float, normal: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f]:
        """How its crossing moves with the plane of a ``normal`` at a ``distance``."""
        moved = []
        for place, direction in ((self.place_a, self.direction_a), (self.place_b, self.direction_b)):
            at = place + direction * distance
            moved.append(at - self.direction * (dr.dot(at, normal) / dr.dot(self.direction, normal)))
        return moved[0], moved[1]


@dataclass
class _Aim:
    """A direction that is corrected, and what the ray in it did."""

    active: mi.Bool
    direction: mi.Vector3f
    step: mi.UInt32
    miss: mi.Float
    arriving: mi.Vector3f
    squared: mi.Float
    length: mi.Float
    part: mi.Spectrum
    eta: mi.Float


def refracted_way(passage: Passage, si: mi.SurfaceInteraction3f, target: mi.Point3f, active: mi.Bool) -> Way:
    """The way from points to targets through the panes between them; straight where there are none.

    Parameters
    ----------
    passage
        the scene, and what light passes in it.
    si
        points of surfaces.
    target
        points that they are connected to.
    active
        lanes that count.
    """
    search = _Search(passage, si, target, dr.normalize(target - si.p))
    nothing = mi.Float(0)
    start = _Aim(
        mi.Bool(active), search.facing, mi.UInt32(0), mi.Float(dr.inf), search.facing, nothing, nothing, mi.Spectrum(0),
        mi.Float(1),
    )  # fmt: skip
    (aim,) = dr.while_loop((start,), lambda aim: aim.active, lambda aim: (search.corrected(aim),))
    seen = active & (aim.miss < _MET) & (dr.max(aim.part) > 0)
    apparent = target - aim.arriving * dr.sqrt(aim.squared)
    return Way(aim.direction, apparent, aim.length, aim.part, aim.eta, seen)


@dataclass
class _Search:
    """Points of surfaces and their targets; ``facing`` is the straight direction, normal to the target's plane."""

    passage: Passage
    si: mi.SurfaceInteraction3f
    target: mi.Point3f
    facing: mi.Vector3f

    def corrected(self, aim: _Aim) -> _Aim:
        """What the ray of ``aim`` does at the target's plane, and a better direction."""
        facing, (a, b) = self.facing, mi.coordinate_system(aim.direction)
        zero, clear = mi.Vector3f(0), self.passage.clear(self.si, aim.direction)
        ray = _Ray(
            mi.Bool(aim.active), self.si.p, aim.direction, clear, zero, zero, a, b, mi.Float(0), mi.Spectrum(1),
            mi.Float(1),
        )  # fmt: skip
        (ray,) = dr.while_loop((ray,), lambda ray: ray.active, lambda ray: (self.further(ray),))
        distance = self.reach(ray)
        error = self.target - (ray.place + ray.direction * distance)
        u, v = mi.coordinate_system(facing)
        (au, av), (bu, bv), (eu, ev) = (
            (dr.dot(moved, u), dr.dot(moved, v)) for moved in (*ray.moved(distance, facing), error)
        )
        area = au * bv - av * bu
        step = a * ((eu * bv - ev * bu) / area) + b * ((au * ev - av * eu) / area)
        step *= dr.minimum(1, _LARGEST_STEP * dr.rsqrt(dr.squared_norm(step)))
        miss = dr.sqrt(dr.square(eu) + dr.square(ev))
        arrived = aim.active & (distance > 0) & dr.isfinite(miss)
        more = arrived & (miss > _CLOSE) & (aim.step + 1 < _STEPS) & dr.isfinite(dr.squared_norm(step))
        return _Aim(
            more,
            dr.select(more, dr.normalize(aim.direction + step), aim.direction),
            aim.step + 1,
            dr.select(arrived, miss, dr.inf),
            ray.direction,
            dr.abs(area * dr.dot(ray.direction, facing)),
            ray.length + distance,
            ray.part,
            ray.eta,
        )

    def reach(self, ray: _Ray) -> mi.Float:
        """Distance [mm] of a ``ray`` to the target's plane."""
        return dr.dot(self.target - ray.place, self.facing) / dr.dot(ray.direction, self.facing)

    def further(self, ray: _Ray) -> _Ray:
        """A ``ray`` beyond the next surface before the target; what is opaque stops its light, not the search."""
        origin = ray.place + ray.direction * ray.clear
        onward = mi.Ray3f(origin, ray.direction, self.si.time, self.si.wavelengths)
        met = self.passage.next_surface(onward, ray.active)
        distance = met.t + ray.clear
        before = ray.active & met.is_valid() & (distance < self.reach(ray))
        place_a, place_b = ray.moved(distance, met.n)
        passed = self.passage.through(met, ray.direction, before)
        # Snell: d' = d / eta + (c / eta - c') n, c and c' the cosines to the normal that faces the ray.
        normal = met.n * -dr.sign(dr.dot(met.n, ray.direction))
        cosine, inside = -dr.dot(normal, ray.direction), -dr.dot(normal, passed.direction)
        ratio = dr.rcp(passed.eta)

        def turned(direction: mi.Vector3f) -> mi.Vector3f:
            change = -dr.dot(normal, direction)
            return direction * ratio + normal * (ratio * change - dr.square(ratio) * cosine * change / inside)

        changed = _Ray(
            before, met.p, passed.direction, self.passage.clear(met, passed.direction), place_a, place_b,
            turned(ray.direction_a), turned(ray.direction_b), ray.length + distance, ray.part * passed.part,
            ray.eta * passed.eta,
        )  # fmt: skip
        chosen = {name: dr.select(before, getattr(changed, name), getattr(ray, name)) for name in vars(ray)}
        return _Ray(**{**chosen, "active": before})
