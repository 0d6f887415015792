"""Curved mirrors in double precision: float32 hits of rays in, points and normals of the very surfaces out.

A float32 place at 400 mm is good to 3e-5 mm. On a mirror ball of 1 mm that turns the normal by 3e-5, and the light by
half a sensor pixel; so each ray is met once more with the sphere, cylinder or triangle that it hit. Flat surfaces need
none of it: their normal is the same all over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.transport.coordinates import turn_and_origin

IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Hits:
    """Points and normals (k, 3) where rays met surfaces, geometric and for shading."""

    point: FloatArray
    geometric: FloatArray
    normal: FloatArray

    def put(self, chosen: IntArray, other: Hits) -> None:
        """Take the ``other`` hits for those ``chosen``, where they are finite."""
        good = np.isfinite(other.point).all(axis=1) & np.isfinite(other.normal).all(axis=1)
        for name in vars(self):
            getattr(self, name)[chosen[good]] = getattr(other, name)[good]


class _Surface(Protocol):
    def met(self, origin: FloatArray, direction: FloatArray, hits: Hits, face: IntArray) -> Hits: ...


class ExactHits:
    """The spheres, cylinders and smooth meshes among some ``shapes``."""

    def __init__(self, shapes: Sequence[mi.Shape]) -> None:
        self._surfaces: dict[int, _Surface] = {}
        for shape in shapes:
            surface = _surface(shape)
            if surface is not None:
                number = int(np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))).ravel()[0])
                self._surfaces[number] = surface

    def refine(self, origin: FloatArray, direction: FloatArray, hits: Hits, shape: IntArray, face: IntArray) -> None:
        """Replace ``hits`` on the surfaces that are known.

        Parameters
        ----------
        origin, direction
            (k, 3) of the rays.
        hits
            in float32's precision.
        shape, face
            (k,) numbers of the shapes in Dr.Jit's registry, and of their faces.
        """
        for number in np.intersect1d(shape, list(self._surfaces)) if self._surfaces else ():
            mine = np.flatnonzero(shape == number)
            old = Hits(*(getattr(hits, name)[mine] for name in vars(hits)))
            with np.errstate(all="ignore"):
                hits.put(mine, self._surfaces[int(number)].met(origin[mine], direction[mine], old, face[mine]))


def _surface(shape: mi.Shape) -> _Surface | None:
    if shape.is_mesh():
        data = mi.traverse(shape)
        smooth = shape.has_vertex_normals() and not shape.has_face_normals() and "faces" in data
        return _Mesh.of(data) if smooth else None
    kind = shape.class_name()
    if kind not in ("Sphere", "Cylinder"):
        return None
    turn, origin = turn_and_origin(mi.traverse(shape)["to_world"])
    radius = float(np.linalg.norm(turn[:, 0]))
    axis = turn[:, 2] / np.linalg.norm(turn[:, 2]) if kind == "Cylinder" else np.zeros(3)
    return _Round(origin, axis, radius)


@dataclass(frozen=True, eq=False)
class _Round:
    """All points at the ``radius`` from a centre, or from the line along an ``axis`` through it."""

    centre: FloatArray
    axis: FloatArray
    radius: float

    def met(self, origin: FloatArray, direction: FloatArray, hits: Hits, face: IntArray) -> Hits:
        start, way = (self._across(vectors) for vectors in (origin - self.centre, direction))
        a, b = np.square(way).sum(axis=1), (start * way).sum(axis=1)
        root = np.sqrt(b**2 - a * (np.square(start).sum(axis=1) - self.radius**2))
        near = ((hits.point - origin) * direction).sum(axis=1)
        # Of the two, the crossing that was hit: b and a root of the other sign cancel only where it is far from both.
        first, second = (-b - root) / a, (-b + root) / a
        distance = np.where(np.abs(first - near) < np.abs(second - near), first, second)
        point = origin + direction * distance[:, None]
        normal = self._across(point - self.centre) / self.radius
        normal *= np.sign((normal * hits.normal).sum(axis=1))[:, None]
        return Hits(point, normal, normal)

    def _across(self, vectors: FloatArray) -> FloatArray:
        return np.asarray(vectors - (vectors @ self.axis)[:, None] * self.axis)


@dataclass(frozen=True, eq=False)
class _Mesh:
    """Triangles, (k, 3, 3) each, and the normals of their corners."""

    places: FloatArray
    normals: FloatArray

    @classmethod
    def of(cls, data: mi.SceneParameters) -> _Mesh:
        corners = np.array(data["faces"]).reshape(-1, 3)
        of_vertices = (data["vertex_positions"], data["vertex_normals"])
        return cls(*(np.array(values, dtype=np.float64).reshape(-1, 3)[corners] for values in of_vertices))

    def met(self, origin: FloatArray, direction: FloatArray, hits: Hits, face: IntArray) -> Hits:
        corner, along, across = _edges(self.places[face])
        geometric = np.cross(along, across)
        scale = (direction * geometric).sum(axis=1)
        offset = origin - corner
        turned = np.cross(offset, direction)
        b, c = (across * turned).sum(axis=1) / -scale, (along * turned).sum(axis=1) / scale
        normals = self.normals[face]
        weights = np.stack([1 - b - c, b, c], axis=1)
        normal = (normals * weights[:, :, None]).sum(axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        normal *= np.sign((normal * hits.normal).sum(axis=1))[:, None]
        geometric /= np.linalg.norm(geometric, axis=1, keepdims=True)
        geometric *= np.sign((geometric * hits.geometric).sum(axis=1))[:, None]
        return Hits(corner + along * b[:, None] + across * c[:, None], geometric, normal)


def _edges(triangles: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """First corner, and the edges from it to the others."""
    return triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
