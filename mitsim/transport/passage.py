"""Light that passes surfaces: from two points of a scene to the way between them and the part of the light it keeps.

The hole of a cut-out (``mask``), a thin pane (``thindielectric``), a filter: their *null lobe* lets a part of the light
go straight on as if nothing were there. Flat glass bends it, but to one way between two points only
(:mod:`mitsim.transport.panes`). No direction that is drawn at random tells such light from that of free space, so it is
what it would be without the surface, weaker: direct light stays direct, and a light is looked for behind a hole as
before it. Scenes without such surfaces keep a plain test of visibility.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import drjit as dr
import mitsuba as mi

from mitsim.transport.panes import flat_panes

CLEAR = 32 * 2.0**-24
"""How far a ray starts beyond a surface, for each mm of its coordinates, where a scene transmits light: 32 roundings of
single precision, 8e-4 mm at 400 mm, where a point is 1 or 2 of them off. Mitsuba's own 9e-5 is 0.036 mm there, and
skips a print so close behind glass."""
_LOOSE = 1500 * 2.0**-24
"""The same beyond a cylinder or what an instance holds, as far as Mitsuba's own rays start: points of a cylinder lie up
to 6e-8 D^2 / r off its surface, 1e-3 mm of a radius r of 6 mm at a distance D of 300, and those of an instance 100
roundings; they would be hidden by their own surface."""
_GRAZING = 0.02
"""Least cosine that this distance is divided by, so that a grazing ray does not skip centimetres."""
State = TypeVar("State", bound=tuple[object, ...])


def lets_through(material: mi.BSDF) -> bool:
    """Whether a ``material`` transmits light, bent, scattered or straight."""
    return bool(int(material.flags()) & (int(mi.BSDFFlags.Transmission) | int(mi.BSDFFlags.Null)))


def transmits(scene: mi.Scene) -> bool:
    """Whether a surface of a ``scene`` lets light through; an instance hides its materials, and may have such."""
    materials = [shape.bsdf() for shape in scene.shapes()]
    return any(bsdf is not None and lets_through(bsdf) for bsdf in materials) or _instanced(scene)


def _instanced(scene: mi.Scene) -> bool:
    return any(shape.class_name() == "Instance" for shape in scene.shapes())


@dataclass
class Passed:
    """Light beyond a surface: where it goes on, the part left, and the refractive index there over that before."""

    direction: mi.Vector3f
    part: mi.Spectrum
    eta: mi.Float


class Passage:
    """What light passes in a ``scene``; prepared once.

    Attributes
    ----------
    scene
        as loaded.
    panes
        shapes of flat glass.
    open
        whether there is a surface that light may pass. An instance hides its materials, and may have such.
    transmits
        whether there is a surface that transmits light in any way, so that something may stand close behind it.
    """

    def __init__(self, scene: mi.Scene) -> None:
        self.scene, self.panes = scene, flat_panes(scene)
        materials = [shape.bsdf() for shape in scene.shapes()]
        self.open = any(bsdf is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in materials)
        self.open |= _instanced(scene) or bool(self.panes)
        self.transmits = transmits(scene)
        kinds = {int(shape.shape_type()) for shape in scene.shapes()}
        self._instanced = _instanced(scene)
        self._loose = self._instanced or int(mi.ShapeType.Cylinder) in kinds

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
            return ~self.scene.ray_test(self.leaving_to(si, target), active), mi.Spectrum(1)
        ray = self.leaving_to(si, target)

        def further(active: mi.Bool, ray: mi.Ray3f, part: mi.Spectrum) -> tuple[mi.Bool, mi.Ray3f, mi.Spectrum]:
            met = self.next_surface(ray, active)
            active &= met.is_valid()
            part = dr.select(active, part * self.straight(met, active), part)
            active &= dr.max(part) > 0
            onward = self.leaving_to(met, target)
            for name in ("o", "d", "maxt"):
                setattr(ray, name, dr.select(active, getattr(onward, name), getattr(ray, name)))
            return active, ray, part

        state = mi.Bool(active), ray, mi.Spectrum(1)
        _, _, part = dr.while_loop(state, lambda active, *_: active, further, labels=("active", "ray", "part"))
        return dr.max(part) > 0, part

    def along(
        self,
        ray: mi.Ray3f,
        light: mi.Spectrum,
        state: State,
        visit: Callable[[mi.SurfaceInteraction3f, mi.Vector3f, mi.Spectrum, mi.Bool, State], State],
    ) -> State:
        """What is made of all surfaces that rays meet one behind another, as far as these let light pass.

        Rays of neighbouring lanes are taken for coherent, which are found faster.

        Parameters
        ----------
        ray, light
            what comes to the first surface.
        state
            before that.
        visit
            of points of surfaces, the direction and the light that come to them, and the lanes that count, makes
            another state of one.
        """
        if not self.open:
            si = self.scene.ray_intersect(ray, mi.RayFlags.All, True)
            return visit(si, ray.d, light, si.is_valid(), state)

        def further(active: mi.Bool, ray: mi.Ray3f, light: mi.Spectrum, *state: object) -> tuple[object, ...]:
            si = self.next_surface(ray, active, coherent=True)
            active &= si.is_valid()
            # Before the visit, which may turn the surface to where it is seen from.
            passed = self.through(si, ray.d, active)
            onward = self.onward(si, passed.direction)
            state = visit(si, ray.d, light, active, state)  # type: ignore[arg-type]
            light = light * passed.part
            return active & (dr.max(light) > 0), onward, light, *state

        begun = mi.Bool(True), ray, light, *state
        return dr.while_loop(begun, lambda active, *_: active, further)[3:]  # type: ignore[no-any-return]

    def next_surface(self, ray: mi.Ray3f, active: mi.Bool, coherent: bool = False) -> mi.SurfaceInteraction3f:
        """Where a ray that goes on meets the next surface: never behind its start, so that it gets on.

        Of triangles as long and thin as those of a wire, single precision may put the point 0.01 mm along the wire,
        behind the ray's start; then it is the ray's own.

        Parameters
        ----------
        ray, active
            rays, and the lanes that count.
        coherent
            whether rays of neighbouring lanes are alike, which are found faster.
        """
        si = self.scene.ray_intersect(ray, mi.RayFlags.All, coherent, active)
        si.p = dr.select(dr.dot(si.p - ray.o, ray.d) > 0, si.p, ray(si.t))
        return si

    @staticmethod
    def straight(si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Spectrum:
        """Part of the light that the surface at ``si`` lets straight on, where ``active``."""
        return mi.unpolarized_spectrum(si.bsdf().eval_null_transmission(si, active))

    def through(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> Passed:
        """What light does that comes to surfaces and passes them.

        Parameters
        ----------
        si
            points of the surfaces, met by a ray of that direction.
        direction
            unit, of the light.
        active
            lanes that count.
        """
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

    def is_pane(self, si: mi.SurfaceInteraction3f) -> mi.Bool:
        """Whether the surface at ``si`` is flat glass."""
        found = mi.Bool(False)
        for pane in self.panes:
            found |= si.shape == pane
        return found

    def passes(self, si: mi.SurfaceInteraction3f, sample: mi.BSDFSample3f) -> mi.Bool:
        """Whether the direction of a ``sample`` at ``si`` is that of light which passes."""
        if not self.open:
            return mi.Bool(False)
        bent = self.is_pane(si) & mi.has_flag(sample.sampled_type, mi.BSDFFlags.DeltaTransmission)
        return mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null) | bent

    def clear(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f) -> mi.Float:
        """How far a ray that leaves the surface at ``si`` in a ``direction`` starts from it [mm]."""
        slope = dr.maximum(dr.abs(dr.dot(si.n, direction)), _GRAZING)
        clear = mi.Float(CLEAR)
        if self._loose:
            loose = si.shape.shape_type() == mi.UInt32(int(mi.ShapeType.Cylinder))
            if self._instanced:
                loose |= si.instance != dr.zeros(mi.ShapePtr)
            clear = dr.select(loose, _LOOSE, CLEAR)
        return clear * (1 + dr.max(dr.abs(si.p))) / slope

    def onward(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f) -> mi.Ray3f:
        """A ray that starts beyond the surface at ``si`` in a ``direction``, on the line through the point itself."""
        clear = self.clear(si, direction)
        return mi.Ray3f(si.p + direction * clear, direction, si.time, si.wavelengths)

    def leaving(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f) -> mi.Ray3f:
        """A ray that leaves the surface at ``si`` in a ``direction``: as Mitsuba has it where no surface transmits."""
        return self.onward(si, direction) if self.transmits else si.spawn_ray(direction)

    def leaving_to(self, si: mi.SurfaceInteraction3f, target: mi.Point3f) -> mi.Ray3f:
        """The ray of :meth:`leaving` that ends short of a ``target``.

        Parameters
        ----------
        si
            points of surfaces.
        target
            points that the rays lead to.
        """
        ray = si.spawn_ray_to(target)
        if self.transmits:
            direction = dr.normalize(target - si.p)
            clear = self.clear(si, direction)
            ray.o, ray.d = si.p + direction * clear, direction
            ray.maxt = ray.maxt - clear
        return ray
