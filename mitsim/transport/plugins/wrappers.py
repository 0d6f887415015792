"""Materials made of others, in place of Mitsuba's own where these lose light or only hold for light from the camera.

Plugins ``mitsim_blendbsdf``, ``mitsim_mask``, ``mitsim_twosided``
------------------------------------------------------------------
Mitsuba's ``blendbsdf`` weighs a mirror's direction by the density of the other material there as well, as if both were
densities: half a mirror over half a matt surface keeps 0.8 of what it reflects. Its ``mask`` samples nothing when only
the lobes of its material are asked for, and a ``twosided`` of two materials all lobes of the second in place of one.
All three choose one of two materials: by weight, by opacity (the other is ``null``), or by side. Here a single
direction (delta or null) has the chance of its choice as its ``pdf``, and a context with a component gives the part of
the light that this component sends on, without chance.

Plugins ``mitsim_bumpmap``, ``mitsim_normalmap``, ``mitsim_hair``, ``mitsim_principledthin``
--------------------------------------------------------------------------------------------
These are not reciprocal: the value f(wi, wo) is defined for light that arrives from wo and is seen from wi. Light that is
followed forward (``TransportMode.Importance``) needs the adjoint f(wo, wi), which Mitsuba does not give (E. Veach 1997,
5.3). Here the forward value is that of the exchanged directions, so that an integrator takes the cosines to the shading
normal of the surface alone. Directions of mirrors have no value to exchange; for them a white matt material under the
same bumps gives the ratio of both, c = cos_p(wi) G(wi) / (cos_p(wo) G(wo)), where cos_p is the cosine to the bumps'
normal and G is Mitsuba's shadowing of bumps.

Parameters are those of Mitsuba's plugins of the same name. :mod:`mitsim.scene.tree` puts these plugins into a scene.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsim.transport.plugins.base import bsdf_class

PREFIX = "mitsim_"
CHOICES = ("blendbsdf", "mask", "twosided")
"""Materials of Mitsuba that choose between two others."""
BUMPS = ("bumpmap", "normalmap")
"""Materials of Mitsuba that turn another's frame."""
DIRECTED = (*BUMPS, "hair", "principledthin")
"""All materials of Mitsuba that are not reciprocal."""
_ANY = 2**32 - 1
"""Component of a context that asks for all of them."""


def plugin_classes() -> dict[str, Callable[[mi.Properties], mi.BSDF]]:
    """Return the plugins for the variant in use, by name: Mitsuba's base classes exist per variant."""

    class Choice(bsdf_class()):  # type: ignore[misc]
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.parts = [each for _, each in props.objects() if isinstance(each, mi.BSDF)]
            name = props.plugin_name().removeprefix(PREFIX)
            self.weight = None
            if name == "blendbsdf":
                self.weight = props.get_texture("weight")
            elif name == "mask":
                self.weight = props.get_texture("opacity", 0.5)
                self.parts.insert(0, mi.load_dict({"type": "null"}))
            else:
                back = {"type": "twosided", "bsdf": self.parts[1], "allow_transmission": True}
                props.mark_queried("allow_transmission")
                self.parts[1] = mi.load_dict(back)
            self.m_components = [part.flags(i) for part in self.parts for i in range(part.component_count())]
            self.m_flags = self.parts[0].flags() | self.parts[1].flags()

        def traverse(self, callback: mi.TraversalCallback) -> None:
            if self.weight is not None:
                callback.put("weight", self.weight, mi.ParamFlags.Differentiable)
            for number, part in enumerate(self.parts):
                callback.put(f"bsdf_{number}", part, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return f"Choice[{self.parts[0]}, {self.parts[1]}]"

        def _shares(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
            """Return the share of the light of each material."""
            if self.weight is None:
                second = dr.select(si.wi.z < 0, mi.Float(1), 0)
            else:
                second = dr.clip(self.weight.eval_1(si, active), 0, 1)
            return 1 - second, second

        def _mixed(self, values: Callable[..., Any], si: mi.SurfaceInteraction3f, active: mi.Bool) -> Any:
            """Return the sum of the ``values`` of both materials by their shares."""
            first, second = (values(part) * share for part, share in zip(self.parts, self._shares(si, active), strict=True))
            return first + second

        def sample(
            self,
            ctx: mi.BSDFContext,
            si: mi.SurfaceInteraction3f,
            sample1: mi.Float,
            sample2: mi.Point2f,
            active: mi.Bool = True,
        ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
            shares, count = self._shares(si, active), self.parts[0].component_count()
            if ctx.component != _ANY:
                which = int(ctx.component >= count)
                alone = mi.BSDFContext(ctx.mode, ctx.type_mask, ctx.component - which * count)
                bs, value = self.parts[which].sample(alone, si, sample1, sample2, active)
                return bs, value * shares[which]
            second = sample1 < shares[1]
            numbers = (sample1 - shares[1]) / shares[0], sample1 / shares[1]
            (bs, value), (other, its_value) = (
                part.sample(ctx, si, number, sample2, active & chosen)
                for part, number, chosen in zip(self.parts, numbers, (~second, second), strict=True)
            )
            other.sampled_component += count
            bs, value = dr.select(second, other, bs), dr.select(second, its_value, value)
            single = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            mixed, density = self.eval_pdf(ctx, si, bs.wo, active & ~single)
            bs.pdf = dr.select(single, bs.pdf * dr.select(second, shares[1], shares[0]), density)
            return bs, dr.select(single, value, dr.select(density > 0, mixed / density, 0))

        def eval_pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> tuple[mi.Spectrum, mi.Float]:
            value, density = mi.Spectrum(0), mi.Float(0)
            for part, share in zip(self.parts, self._shares(si, active), strict=True):
                own, pdf = part.eval_pdf(ctx, si, wo, active)
                value, density = value + own * share, density + pdf * share
            return value, density

        def eval_null_transmission(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
            return self._mixed(lambda part: part.eval_null_transmission(si, active), si, active)

        def eval_diffuse_reflectance(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
            return self._mixed(lambda part: part.eval_diffuse_reflectance(si, active), si, active)

    class Directed(bsdf_class()):  # type: ignore[misc]
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            for name in props.keys():  # noqa: SIM118 - Properties is no dict
                props.mark_queried(name)
            own = mi.Properties(props)
            own.set_plugin_name(props.plugin_name().removeprefix(PREFIX))
            self.stock, self.white = mi.PluginManager.instance().create_object(own), None
            if own.plugin_name() in BUMPS:
                matt = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 1.0}}
                for name, each in own.objects():
                    if isinstance(each, mi.BSDF):
                        own[name] = mi.load_dict(matt)
                self.white = mi.PluginManager.instance().create_object(own)
            self.m_components = [self.stock.flags(i) for i in range(self.stock.component_count())]
            self.m_flags = self.stock.flags()

        def traverse(self, callback: mi.TraversalCallback) -> None:
            callback.put("stock", self.stock, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return f"Directed[{self.stock}]"

        def sample(
            self,
            ctx: mi.BSDFContext,
            si: mi.SurfaceInteraction3f,
            sample1: mi.Float,
            sample2: mi.Point2f,
            active: mi.Bool = True,
        ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
            bs, value = self.stock.sample(ctx, si, sample1, sample2, active)
            if ctx.mode == mi.TransportMode.Radiance:
                return bs, value
            single = active & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            if self.white is not None:
                # Seen from the side that it comes from, so that refracted light has a cosine, too.
                beyond = mi.Vector3f(bs.wo) * dr.mulsign(dr.mulsign(mi.Float(1), si.wi.z), bs.wo.z)
                into, out = _exchanged(self.white, ctx, si, beyond, single), self.white.eval(ctx, si, beyond, single)
                into, out = (mi.unpolarized_spectrum(each)[0] for each in (into, out))
                value *= dr.select(single & (out > 0), into / out, dr.select(single, mi.Float(0), 1))
            turned = _exchanged(self.stock, ctx, si, bs.wo, active & ~single)
            return bs, dr.select(single, value, dr.select(bs.pdf > 0, turned / bs.pdf, 0))

        def eval_pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> tuple[mi.Spectrum, mi.Float]:
            value, density = self.stock.eval_pdf(ctx, si, wo, active)
            if ctx.mode == mi.TransportMode.Importance:
                value = _exchanged(self.stock, ctx, si, wo, active)
            return value, density

        def eval_null_transmission(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
            return self.stock.eval_null_transmission(si, active)

        def eval_diffuse_reflectance(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
            return self.stock.eval_diffuse_reflectance(si, active)

    made = {**dict.fromkeys(CHOICES, Choice), **dict.fromkeys(DIRECTED, Directed)}
    return {PREFIX + name: each for name, each in made.items()}


def _exchanged(
    bsdf: mi.BSDF, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool
) -> mi.Spectrum:
    """Return the value of a ``bsdf`` for light that comes from ``si.wi`` and is seen from ``wo``, with the cosine of
    ``wo`` in place of that of ``si.wi``."""
    seen = mi.SurfaceInteraction3f(si)
    seen.wi = wo
    context = mi.BSDFContext(mi.TransportMode.Radiance, ctx.type_mask, ctx.component)
    value = bsdf.eval(context, seen, si.wi, active & (si.wi.z != 0))
    return dr.select(si.wi.z != 0, value * dr.abs(wo.z / si.wi.z), 0)
