"""Materials made of others, in place of Mitsuba's own where these lose light or only hold for light from the camera.

Plugins ``mitsim_blendbsdf``, ``mitsim_mask``, ``mitsim_twosided``
------------------------------------------------------------------
Mitsuba's ``blendbsdf`` weighs a mirror's direction by the density of the other material there as well, as if both were
densities: half a mirror over half a matt surface keeps 0.8 of the light. Its ``mask`` samples nothing when only
the lobes of its material are asked for, and a ``twosided`` of two materials all lobes of the second in place of one.
All three choose one of two materials: by weight, by opacity (the other is ``null``), or by side. Here a single
direction (delta or null) has the chance of its choice as its ``pdf``, and a context with a component gives the part of
the light that this component sends on, without chance.

Plugins ``mitsim_bumpmap``, ``mitsim_normalmap``, ``mitsim_hair``, ``mitsim_principledthin``
--------------------------------------------------------------------------------------------
These are not reciprocal: the value f(wi, wo) is defined for light that arrives from wo and is seen from wi. Light that
is followed forward (``TransportMode.Importance``) needs the adjoint f(wo, wi), which Mitsuba does not give (E. Veach
1997, 5.3). Here the forward value is that of the exchanged directions, so that an integrator takes the cosines to the
shading normal of the surface alone. Directions of mirrors have no value to exchange; for them a white matt material
under the same bumps gives the ratio of both, c = cos_p(wi) G(wi) / (cos_p(wo) G(wo)), where cos_p is the cosine to the
bumps' normal and G is Mitsuba's shadowing of bumps.

Parameters are those of Mitsuba's plugins of the same name. :mod:`mitsim.scene.load` puts these plugins into a scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from operator import or_

import drjit as dr
import mitsuba as mi

from mitsim.scene.check import BUMPS, CHOICES, DIRECTED
from mitsim.transport.plugins.base import bsdf_class

PREFIX = "mitsim_"
_ANY = 2**32 - 1


def plugin_classes() -> dict[str, type]:
    class Wrapper(bsdf_class()):  # type: ignore[misc]
        parts: list[mi.BSDF]

        def _hold(self, props: mi.Properties, *parts: mi.BSDF) -> None:
            self.name, self.model, self.parts = props.plugin_name(), parts, list(parts)
            self.m_components = [part.flags(i) for part in parts for i in range(part.component_count())]
            self.m_flags = reduce(or_, (part.flags() for part in parts))

        def _shares(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> Sequence[mi.Float]:
            return (mi.Float(1),)

        def traverse(self, callback: mi.TraversalCallback) -> None:
            for number, part in enumerate(self.parts):
                callback.put(f"part_{number}", part, mi.ParamFlags.Differentiable)

        def eval_null_transmission(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
            shares = zip(self._shares(si, active), self.parts, strict=True)
            return sum((part.eval_null_transmission(si, active) * share for share, part in shares), mi.Spectrum(0))

        def eval_diffuse_reflectance(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
            shares = zip(self._shares(si, active), self.parts, strict=True)
            return sum((part.eval_diffuse_reflectance(si, active) * share for share, part in shares), mi.Spectrum(0))

    class Choice(Wrapper):
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            first, *second = (each for _, each in props.objects() if isinstance(each, mi.BSDF))
            self.weight = None
            if props.plugin_name() == f"{PREFIX}mask":
                self.weight = props.get_texture("opacity", 0.5)
                first, second = mi.load_dict({"type": "null"}), [first]
            elif props.plugin_name() == f"{PREFIX}blendbsdf":
                self.weight = props.get_texture("weight")
            else:
                props.mark_queried("allow_transmission")
                second = [mi.load_dict({"type": "twosided", "bsdf": second[0], "allow_transmission": True})]
            self._hold(props, first, *second)

        def traverse(self, callback: mi.TraversalCallback) -> None:
            super().traverse(callback)
            if self.weight is not None:
                callback.put("weight", self.weight, mi.ParamFlags.Differentiable)

        def _shares(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> Sequence[mi.Float]:
            side = dr.select(si.wi.z < 0, mi.Float(1), 0)
            second = side if self.weight is None else dr.clip(self.weight.eval_1(si, active), 0, 1)
            return 1 - second, second

        def sample(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, s1: mi.Float, s2: mi.Point2f, active: mi.Bool = True
        ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
            shares, count = self._shares(si, active), self.parts[0].component_count()
            if ctx.component != _ANY:
                which = int(ctx.component >= count)
                alone = mi.BSDFContext(ctx.mode, ctx.type_mask, ctx.component - which * count)
                bs, value = self.parts[which].sample(alone, si, s1, s2, active)
                return bs, value * shares[which]
            chosen = s1 < shares[1]
            rest = (s1 - shares[1]) / shares[0]
            bs, value = self.parts[0].sample(ctx, si, rest, s2, active & ~chosen)
            other, its_value = self.parts[1].sample(ctx, si, s1 / shares[1], s2, active & chosen)
            other.sampled_component += count
            bs, value = dr.select(chosen, other, bs), dr.select(chosen, its_value, value)
            single = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            mixed, density = self.eval_pdf(ctx, si, bs.wo, active & ~single)
            bs.pdf = dr.select(single, bs.pdf * dr.select(chosen, shares[1], shares[0]), density)
            return bs, dr.select(single, value, dr.select(density > 0, mixed / density, 0))

        def eval_pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> tuple[mi.Spectrum, mi.Float]:
            shares = self._shares(si, active)
            (first, pdf), (second, its_pdf) = (part.eval_pdf(ctx, si, wo, active) for part in self.parts)
            return first * shares[0] + second * shares[1], pdf * shares[0] + its_pdf * shares[1]

    class Directed(Wrapper):
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            for name in props.keys():  # noqa: SIM118 - Properties is no dict
                props.mark_queried(name)
            own, make = mi.Properties(props), mi.PluginManager.instance().create_object
            own.set_plugin_name(props.plugin_name().removeprefix(PREFIX))
            self._hold(props, make(own))
            self.white = None
            if own.plugin_name() in BUMPS:
                for name, each in own.objects():
                    if isinstance(each, mi.BSDF):
                        own[name] = mi.load_dict({"type": "twosided", "of": {"type": "diffuse", "reflectance": 1.0}})
                self.white = make(own)

        def sample(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, s1: mi.Float, s2: mi.Point2f, active: mi.Bool = True
        ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
            bs, value = self.parts[0].sample(ctx, si, s1, s2, active)
            if ctx.mode == mi.TransportMode.Radiance:
                return bs, value
            single = active & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            if self.white is not None:
                # Refracted light is looked at from the side that it comes from, where white matt has a value.
                beside = bs.wo * dr.mulsign(dr.mulsign(mi.Float(1), si.wi.z), bs.wo.z)
                values = _adjoint(self.white, ctx, si, beside, single), self.white.eval(ctx, si, beside, single)
                into, out = (mi.unpolarized_spectrum(each)[0] for each in values)
                value *= dr.select(single, dr.select(out > 0, into / out, 0), 1)
            turned = _adjoint(self.parts[0], ctx, si, bs.wo, active & ~single)
            return bs, dr.select(single, value, dr.select(bs.pdf > 0, turned / bs.pdf, 0))

        def eval_pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> tuple[mi.Spectrum, mi.Float]:
            value, density = self.parts[0].eval_pdf(ctx, si, wo, active)
            if ctx.mode == mi.TransportMode.Importance:
                value = _adjoint(self.parts[0], ctx, si, wo, active)
            return value, density

    made = {**dict.fromkeys(CHOICES, Choice), **dict.fromkeys(DIRECTED, Directed)}
    return {PREFIX + name: each for name, each in made.items()}


def _adjoint(
    bsdf: mi.BSDF, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool
) -> mi.Spectrum:
    """Return the value for light from ``si.wi`` seen from ``wo``, with the cosine of ``wo``."""
    seen = mi.SurfaceInteraction3f(si)
    seen.wi = wo
    context = mi.BSDFContext(mi.TransportMode.Radiance, ctx.type_mask, ctx.component)
    value = bsdf.eval(context, seen, si.wi, active & (si.wi.z != 0))
    return dr.select(si.wi.z != 0, value * dr.abs(wo.z / si.wi.z), 0)
