"""Light that goes straight on through surfaces: from two points of a scene to the part of the light between them.

The hole of a cut-out (``mask``), a thin pane (``thindielectric``), a filter: their *null lobe* lets a part of the light
pass as if nothing were there. No direction that is drawn at random tells such light from that of free space, so it is
what it would be without the surface, weaker: direct light stays direct, and a lamp is looked for behind a hole as
before it. Scenes without such surfaces keep a plain test of visibility.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

_OFFSET = 9e-5
"""How far a ray starts beyond a surface that it has passed, for each mm of its coordinates: Mitsuba's ray epsilon."""
_GRAZING = 0.02
"""Least cosine that this distance is divided by, so that a grazing ray does not skip centimetres."""


class Passage:
    """What light passes in a scene; prepared once.

    Attributes
    ----------
    scene
        as loaded.
    open
        whether there is a surface that light may pass. An instance hides its materials, and may have such.
    """

    def __init__(self, scene: mi.Scene) -> None:
        self.scene = scene
        materials = [shape.bsdf() for shape in scene.shapes()]
        self.open = any(bsdf is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in materials)
        self.open |= any(shape.class_name() == "Instance" for shape in scene.shapes())

    def between(self, si: mi.SurfaceInteraction3f, target: mi.Point3f, active: mi.Bool) -> tuple[mi.Bool, mi.Spectrum]:
        """Whether points see each other, and the part of the light that what lies between them lets through.

        Parameters
        ----------
        si
            points of surfaces.
        target
            points that they are connected to.
        active
            lanes that count.
        """
        if not self.open:
            return ~self.scene.ray_test(si.spawn_ray_to(target), active), mi.Spectrum(1)
        ray = si.spawn_ray_to(target)

        def further(active: mi.Bool, ray: mi.Ray3f, part: mi.Spectrum) -> tuple[mi.Bool, mi.Ray3f, mi.Spectrum]:
            met = self.scene.ray_intersect(ray, mi.RayFlags.All, False, active)
            active &= met.is_valid()
            part = dr.select(active, part * self.straight(met, active), part)
            active &= dr.max(part) > 0
            ray.o = dr.select(active, met.spawn_ray_to(target).o, ray.o)
            ray.d = dr.select(active, target - ray.o, ray.d)
            return active, ray, part

        state = mi.Bool(active), ray, mi.Spectrum(1)
        _, _, part = dr.while_loop(state, lambda active, *_: active, further, labels=("active", "ray", "part"))
        return dr.max(part) > 0, part

    @staticmethod
    def straight(si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Spectrum:
        """Part of the light that a surface lets straight on."""
        return mi.unpolarized_spectrum(si.bsdf().eval_null_transmission(si, active))

    def passes(self, sample: mi.BSDFSample3f) -> mi.Bool:
        """Whether the direction of a ``sample`` is that of light which passes."""
        return mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null) if self.open else mi.Bool(False)

    @staticmethod
    def onward(si: mi.SurfaceInteraction3f, direction: mi.Vector3f) -> mi.Ray3f:
        """A ray that starts beyond the surface at ``si`` in a ``direction``, on the line through the point itself."""
        slope = dr.maximum(dr.abs(dr.dot(si.n, direction)), _GRAZING)
        clear = _OFFSET * (1 + dr.max(dr.abs(si.p))) / slope
        return mi.Ray3f(si.p + direction * clear, direction, si.time, si.wavelengths)
