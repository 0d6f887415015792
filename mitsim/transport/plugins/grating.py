"""A reflecting diffraction grating: a Mitsuba BSDF, from two directions to radiance reflected into diffraction orders.

Plugin ``mitsim_grating``
-------------------------
Grating equation (E. Hecht, Optics, section 10.2.8), for grooves of any direction in the surface: w_i and w_o point away
from the surface, | marks the tangential part of a unit vector (its direction cosines), and order m goes to::

    w_o| = -w_i| + m (lambda / pitch) g               g: unit vector across the grooves

An order is no delta here but a lobe of direction cosines (a real disc is neither flat nor regular), with q the
remainder of the grating equation::

    f(w_i, w_o) = reflectance (diffuse / pi + sum over m of  eta_m D(q_m)),  q_m = w_i| + w_o| - m (lambda / pitch) g
    D(q) = exp(-(q . g)^2 / 2 sigma^2 - (q x g)^2 / 2 sigma_groove^2) / (2 pi sigma sigma_groove)

cos(theta) d omega is an area element of the unit disc of direction cosines and D integrates to 1 over the plane, so an
order reflects eta_m times the part of its lobe inside the disc: never more than eta_m. f depends on w_i| + w_o| only,
so it is reciprocal. J. Stam, Diffraction Shaders (SIGGRAPH 1999), derives the same dependence from Kirchhoff's
integral; there the lobes follow from the shape of the grooves, here they are given. Light of orders that do not exist
(|w_o|| > 1) is lost. No Fresnel term, no interference between orders or between reflections.

=========================  ====  ===============  ==================================================================
parameter                  unit  default          meaning
=========================  ====  ===============  ==================================================================
``pitch``                  nm    1600             groove period, 1 to 1e9 (a compact disc: 1.6 um)
``efficiencies``           -     0.3, 0.15, 0.05  eta_0, eta_1, ...: part reflected into each order, to order 16
``negative_efficiencies``  -     as positive      eta_-1, eta_-2, ... of a blazed grating
``sigma``                  -     0.02             standard deviation of a lobe across the grooves, in direction
                                                  cosines, 1e-4 (float32 directions) to 10
``sigma_groove``           -     ``sigma``        the same along the grooves (pits scatter along their track)
``diffuse``                -     0                Lambertian part; with all efficiencies at most 1
``reflectance``            -     1                factor on everything, 0 to 1
``grooves``                -     circular         ``circular``: g = dp/du, the radius on a ``disk`` (the only shape to
                                                  use it on); ``linear``: g along ``direction``
``direction``              -     1, 0, 0          world vector whose tangential part is along g, for ``linear``
``wavelengths``            nm    the projector's  lines of the light, 1 to 1e6
``shares``                 -     the projector's  their radiant shares, relative to their sum; equal where only
                                                  ``wavelengths`` are given
=========================  ====  ===============  ==================================================================

The projector is calibration/mp_cl1.toml. Mono variants see the mean over the lines, weighted by shares (a path over two
gratings at each of them, where light would keep its line). RGB variants want three lines, one for each channel, and no
shares. Spectral variants diffract the traced wavelengths and use neither. One-sided; no polarisation.

Lists are texts in scene files ("0.3, 0.15").

XML, a compact disc::

    <shape type="disk">
        <transform name="to_world"> <scale value="60"/> <translate z="400"/> </transform>
        <boolean name="flip_normals" value="true"/>
        <bsdf type="mitsim_grating">
            <string name="efficiencies" value="0.3, 0.15, 0.05"/> <float name="diffuse" value="0.02"/>
        </bsdf>
    </shape>

Python: ``register(); mi.load_dict({"type": "mitsim_grating", "grooves": "linear", "direction": [0, 1, 0]})``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from mitsim.core.configuration import read_toml, shipped_path, validate
from mitsim.core.errors import MitsimError
from mitsim.transport.plugins.base import bsdf_class, numbers

PLUGIN = "mitsim_grating"
_ORDERS = 16
_ROUNDING = 1e-6

Part = Annotated[float, Field(ge=0, le=1)]
Wavelength = Annotated[float, Field(ge=1, le=1e6)]
Share = Annotated[float, Field(ge=0, le=1e9)]


class GratingModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    pitch: float = Field(1600.0, ge=1, le=1e9, description="groove period [nm]")
    efficiencies: tuple[Part, ...] = Field((0.3, 0.15, 0.05), min_length=1, max_length=_ORDERS + 1)
    negative_efficiencies: tuple[Part, ...] | None = Field(None, max_length=_ORDERS)
    sigma: float = Field(0.02, ge=1e-4, le=10, description="lobe across the grooves [direction cosine]")
    sigma_groove: float | None = Field(None, ge=1e-4, le=10, description="lobe along the grooves [direction cosine]")
    diffuse: Part = 0.0
    reflectance: Part = 1.0
    grooves: Literal["circular", "linear"] = "circular"
    direction: tuple[float, float, float] = (1.0, 0.0, 0.0)
    wavelengths: tuple[Wavelength, ...] = Field(min_length=1, max_length=16, description="lines [nm]")
    shares: tuple[Share, ...]

    @classmethod
    def build(cls, **values: object) -> GratingModel:
        model = validate(cls, values, PLUGIN)
        total = sum(model.orders.values()) + model.diffuse
        if total > 1 + _ROUNDING:
            raise MitsimError(
                f"{PLUGIN}: efficiencies of all orders and diffuse: got a sum of {total:g}; nothing reflects more than "
                "1, lower them (orders below 0 count too)"
            )
        if len(model.shares) != len(model.wavelengths) or not sum(model.shares) > 0:
            raise MitsimError(
                f"{PLUGIN}: shares: got {model.shares} for wavelengths {model.wavelengths}; give one number for each "
                "line, not all 0"
            )
        if not any(model.direction):
            raise MitsimError(f"{PLUGIN}: direction: got {model.direction}; give a vector that is not 0")
        return model

    @property
    def orders(self) -> dict[int, float]:
        positive = self.efficiencies[1:]
        negative = positive if self.negative_efficiencies is None else self.negative_efficiencies
        below = {-1 - i: part for i, part in enumerate(negative)}
        above = {i: part for i, part in enumerate(self.efficiencies)}
        return dict(sorted({**below, **above}.items()))


def _model(props: mi.Properties) -> GratingModel:
    light = read_toml(shipped_path("calibration", "mp_cl1.toml"))
    values: dict[str, Any] = {}
    if "wavelengths" not in props:
        values = {"wavelengths": light["wavelengths_nm"], "shares": light["radiant_shares"]}
    for name in GratingModel.model_fields:
        if name not in props:
            continue
        values[name] = value = props[name]
        if name != "grooves" and not isinstance(value, bool | int | float):
            try:
                values[name] = numbers(value) if isinstance(value, str) else np.array(value, dtype=np.float64).tolist()
            except (TypeError, ValueError):
                raise MitsimError(f"{PLUGIN}: {name}: got {value!r}; give numbers separated by commas") from None
        elif name in ("efficiencies", "negative_efficiencies", "wavelengths", "shares"):
            values[name] = [value]
    values.setdefault("shares", [1.0] * len(values["wavelengths"]))
    return GratingModel.build(**values)


def plugin_class() -> type:
    class Grating(bsdf_class()):  # type: ignore[misc]
        name = PLUGIN

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.model = _model(props)
            if mi.is_rgb and len(self.model.wavelengths) != 3:
                raise MitsimError(
                    f"{PLUGIN}: wavelengths: got {len(self.model.wavelengths)} lines; variant {mi.variant()} wants "
                    "three, for red, green and blue"
                )
            self.orders = tuple(self.model.orders)
            sigma_groove = self.model.sigma if self.model.sigma_groove is None else self.model.sigma_groove
            self.pitch, self.sigma = mi.Float(self.model.pitch), mi.Float(self.model.sigma)
            self.sigma_groove = mi.Float(sigma_groove)
            self.diffuse, self.reflectance = mi.Float(self.model.diffuse), mi.Float(self.model.reflectance)
            self.efficiencies = mi.Float(list(self.model.orders.values()))
            # Parameters as data, not as constants: gratings that differ by numbers share one kernel.
            dr.make_opaque(
                *(self.pitch, self.sigma, self.sigma_groove, self.diffuse, self.reflectance, self.efficiencies)
            )
            total = sum(self.model.shares)
            self._shares = tuple(share / total for share in self.model.shares)
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.Anisotropic
            self.m_components = [flags]
            self.m_flags = flags

        # ---- formula of the module's docstring

        def _grating_vector(self, si: mi.SurfaceInteraction3f) -> mi.Vector2f:
            circular = self.model.grooves == "circular"
            across = si.to_local(si.dp_du if circular else mi.Vector3f(self.model.direction))
            flat = mi.Vector2f(across.x, across.y)
            length = dr.norm(flat)
            return dr.select(length > 0, flat / length, mi.Vector2f(1, 0))

        def _lobes(self, si: mi.SurfaceInteraction3f) -> Iterator[tuple[mi.Float, mi.UnpolarizedSpectrum]]:
            each = map(mi.UnpolarizedSpectrum, self.model.wavelengths)
            lines = list(zip(self._shares, each, strict=True))
            if mi.is_spectral:
                lines = [(1.0, mi.UnpolarizedSpectrum(si.wavelengths))]
            elif mi.is_rgb:
                lines = [(1.0, mi.UnpolarizedSpectrum(list(self.model.wavelengths)))]
            for share, wavelength in lines:
                for index, order in enumerate(self.orders):
                    part = share * dr.gather(mi.Float, self.efficiencies, index)
                    yield part, order * wavelength / self.pitch

        def _total(self) -> mi.Float:
            return self.diffuse + dr.sum(self.efficiencies)

        # ---- Mitsuba's interface

        def eval_pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> tuple[mi.Spectrum, mi.Float]:
            if not ctx.is_enabled(mi.BSDFFlags.GlossyReflection):
                return mi.Spectrum(0), mi.Float(0)
            cosine_i, cosine_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
            active = active & (cosine_i > 0) & (cosine_o > 0)
            g, total = self._grating_vector(si), self._total()
            q = mi.Vector2f(si.wi.x + wo.x, si.wi.y + wo.y)
            along = (q.y * g.x - q.x * g.y) / self.sigma_groove
            value = mi.UnpolarizedSpectrum(0)
            for part, shift in self._lobes(si):
                across = (dr.dot(q, g) - shift) / self.sigma
                value += part * dr.exp(-0.5 * (dr.square(across) + dr.square(along)))
            density = (value / (dr.two_pi * self.sigma * self.sigma_groove) + self.diffuse * dr.inv_pi) * cosine_o
            # Lobes are drawn by their part and the channel evenly: the pdf is the mean over channels.
            pdf = dr.select(active & (total > 0), dr.sum(density) / len(density) / total, 0)
            return mi.depolarizer(dr.select(active, self.reflectance * density, 0)), pdf

        def sample(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, s1: mi.Float, s2: mi.Point2f, active: mi.Bool = True
        ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
            chosen = s1 * self._total()
            reached = mi.Float(self.diffuse)
            lambertian = chosen < reached
            shift = mi.Float(0)
            for part, shifts in self._lobes(si):
                for channel in range(len(shifts)):
                    shift = dr.select(chosen >= reached, shifts[channel], shift)
                    reached += part / len(shifts)
            g = self._grating_vector(si)
            normal = mi.warp.square_to_std_normal(s2)
            across, along = shift + self.sigma * normal.x, self.sigma_groove * normal.y
            lobe = mi.Vector2f(across * g.x - along * g.y, across * g.y + along * g.x)
            lobe -= mi.Vector2f(si.wi.x, si.wi.y)
            flat = dr.select(lambertian, mi.warp.square_to_uniform_disk_concentric(s2), lobe)
            squared = dr.squared_norm(flat)
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = mi.Vector3f(flat.x, flat.y, dr.safe_sqrt(1 - squared))
            value, bs.pdf = self.eval_pdf(ctx, si, bs.wo, active & (squared < 1))
            bs.eta = 1.0
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            bs.sampled_component = 0
            return bs, dr.select(bs.pdf > 0, value / bs.pdf, 0)

    return Grating
