"""Surfaces in contact with what lets light through: a loaded scene in, what each estimator must refuse of it out.

A ray that has passed a surface starts a little beyond it, and does not see what stands closer: a print in contact with
glass comes out black. Mitsuba's own integrators start 9e-5 of the coordinates beyond, 0.036 mm at 400 mm, the tracers
of this room :data:`mitsim.transport.transmission.CLEAR`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.transport.sampler import generator
from mitsim.transport.transmission import CLEAR, lets_through

_OWN, _MITSUBA = 2 * CLEAR, 1.1 * 1500 * 2.0**-24
"""Gaps, for each mm of coordinates, that our tracers and Mitsuba's integrators still see: their own offsets, with what
rounding leaves of both surfaces."""
_POINTS, _FEWEST = 2**16, 8
"""Points of each surface that are looked at, and how many make a contact: a ball that rests on a pane touches none."""
_PARALLEL = 0.999
"""Cosine between normals of two surfaces in contact; where cards cross they come close, and hide nothing there."""
_MOST = 16
"""Surfaces that are looked at; with more of them contacts of the others are not found."""


@dataclass(frozen=True)
class Contact:
    """Number of a shape that lets light through, its distance [mm] to what stands too close, and the least allowed."""

    shape: int
    gap: float
    least: float

    def words(self, estimator: str) -> tuple[str, str]:
        """What was found, and what an ``estimator`` allows."""
        rule = (
            f"{estimator} sees what stands at least {self.least:.2g} mm from a surface that lets light through; leave "
            "a gap of air, or take one surface with the material of both"
        )
        return f"another surface at a distance of {self.gap:.2g} mm", rule


def contacts(scene: mi.Scene) -> tuple[Contact | None, Contact | None]:
    """Why the factored estimator and the reference must not be given a ``scene``; None where they may."""
    shapes = [shape for shape in scene.shapes() if shape.bsdf() is not None]
    clear = [shape for shape in shapes if lets_through(shape.bsdf())]
    found: list[Contact | None] = [None, None]
    for shape in clear[:_MOST]:
        gap, size = _gaps(shape, [other for other in shapes if other is not shape and _close(shape, other)])
        at = np.argsort(gap / size)[_FEWEST - 1]
        for which, limit in enumerate((_OWN, _MITSUBA)):
            if found[which] is None and gap[at] < limit * size[at]:
                index = list(scene.shapes()).index(shape)
                found[which] = Contact(index, float(gap[at]), float(limit * size[at]))
    return found[0], found[1]


def _close(shape: mi.Shape, other: mi.Shape) -> bool:
    """Whether the boxes of two shapes meet, but for a gap that is looked for."""
    (low, high), (first, last) = ([np.array(box.min), np.array(box.max)] for box in (shape.bbox(), other.bbox()))
    reach = _MITSUBA * (1 + max(np.abs(low).max(), np.abs(high).max()))
    return bool((first - reach <= high).all() and (low - reach <= last).all())


def _gaps(shape: mi.Shape, others: Sequence[mi.Shape]) -> tuple[FloatArray, FloatArray]:
    """Distances [mm] of points of a ``shape`` to the next parallel surface of its own or of ``others``, inf where none
    is close, and the points' coordinates."""
    named = {f"shape{i}": other for i, other in enumerate(others)}
    # Surfaces that coincide with the shape's own are found without it.
    scenes = [(mi.load_dict({"type": "scene", **named, "own": shape}), 2 * CLEAR)]
    if named:
        scenes.append((mi.load_dict({"type": "scene", **named}), -CLEAR))
    rng = generator(mi.UInt32(0), dr.arange(mi.UInt32, _POINTS))
    sample = shape.sample_position(0, mi.Point2f(rng.next_float32(), rng.next_float32()))
    size = 1 + dr.max(dr.abs(sample.p))
    # A disk in its own plane has one normal for all points. Of a single direction for many rays Dr.Jit 1.5.0 writes a
    # kernel that LLVM cannot parse, and ends the process.
    normal = mi.Vector3f(sample.n) + 0 * sample.p
    gap = mi.Float(dr.inf)
    for sign in (1, -1):
        direction = normal * sign
        for among, first in scenes:
            ray = mi.Ray3f(sample.p + direction * (first * size), direction)
            ray.maxt = (_MITSUBA - first) * size
            met = among.ray_intersect(ray)
            parallel = met.is_valid() & (dr.abs(dr.dot(met.n, normal)) > _PARALLEL)
            gap = dr.minimum(gap, dr.select(parallel, dr.abs(met.t + first * size), dr.inf))
    dr.eval(gap, size)
    return np.array(gap, dtype=np.float64), np.array(size, dtype=np.float64)
