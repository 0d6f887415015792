"""Materials: dispersive glass, a reflecting diffraction grating, and materials made of others.

Plugin ``mitsim_glass``
-----------------------
A smooth face that reflects and refracts by wavelength: Mitsuba's ``dielectric`` with an index of refraction that
follows the wavelength, by one of::

    n^2 = 1 + sum over i of  B_i lambda^2 / (lambda^2 - C_i)              W. Sellmeier 1871; lambda in um, C_i in um^2
    n   = n_d + (n_d - 1) / V_d (lambda^-2 - lambda_d^-2) / (lambda_F^-2 - lambda_C^-2)                   A. Cauchy 1836

with n_d at 587.56 nm and Abbe's number V_d = (n_d - 1) / (n_F - n_C) of Fraunhofer's lines F, 486.13, and C, 656.27 nm,
as data sheets state them. Fresnel's formulas for unpolarised light give the reflected and the refracted part.
Indices are those relative to air, as catalogues measure them.

===============  ====  ===========  ===================================================================================
parameter        unit  default      meaning
===============  ====  ===========  ===================================================================================
``glass``        -     n-bk7        ``n-bk7``, ``n-sf11``, ``fused-silica``, ``pmma``, ``polycarbonate`` or ``water``
``sellmeier``    um^2  -            in place of ``glass``: B_1, C_1, B_2, C_2, ..., up to four pairs
``index``        -     -            in place of both: n_d, 1 to 5
``abbe``         -     -            V_d, 5 to 200; belongs to ``index``
``wavelength``   nm    projector's  whose index mono and RGB variants use, 360 to 830
===============  ====  ===========  ===================================================================================

Mono variants have one wavelength: the projector's effective one, which a bench sets (:func:`tune`), or the one given.
In spectral variants light of several wavelengths on one path would part at the glass. A face refracts by the path's
first wavelength, so each path must carry one alone
(:attr:`mitsim.transport.connect.ProjectorOptics.per_wavelength`). Glass
absorbs nothing. No polarisation. ``mi.traverse`` shows ``wavelength``.

XML, a prism's material::

    <bsdf type="mitsim_glass"> <string name="glass" value="n-sf11"/> </bsdf>

Python: ``register(); mi.load_dict({"type": "mitsim_glass", "index": 1.62, "abbe": 36.4})``.

Plugin ``mitsim_grating``
-------------------------
A reflecting diffraction grating, from two directions to radiance reflected into diffraction orders.

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

import re
from collections.abc import Iterator, Sequence
from functools import reduce
from operator import or_
from types import MappingProxyType
from typing import Annotated, Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from mitsim.core.configuration import read_toml, shipped_path, validate
from mitsim.core.errors import MitsimError
from mitsim.scene.check import BUMPS, CHOICES, DIRECTED
from mitsim.transport.plugins.base import LIGHT, Draw, Light, Surface, Value, adjoint, bsdf_class
from mitsim.transport.plugins.measured import measured_class

GLASS, GRATING = "mitsim_glass", "mitsim_grating"


def plugin_classes() -> dict[str, type]:
    return {GLASS: _glass(), GRATING: _grating(), **_wrappers(), f"{PREFIX}measured": measured_class()}


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def _numbers(text: str) -> list[float]:
    return [float(word) for word in re.split(r"[\s,]+", text.strip()) if word]


# -------- Glass

_USUAL = "n-bk7"
CATALOGUE = MappingProxyType(
    {
        # Schott, optical glass data sheets 2023.
        "n-bk7": (1.03961212, 0.00600069867, 0.231792344, 0.0200179144, 1.01046945, 103.560653),
        "n-sf11": (1.73759695, 0.013188707, 0.313747346, 0.0623068142, 1.89878101, 155.23629),
        # I. H. Malitson, J. Opt. Soc. Am. 55, 1205 (1965).
        "fused-silica": (0.6961663, 0.0684043**2, 0.4079426, 0.1162414**2, 0.8974794, 9.896161**2),
        # N. Sultanova, S. Kasarova, I. Nikolov, Acta Phys. Pol. A 116, 585 (2009).
        "pmma": (1.1819, 0.011313),
        "polycarbonate": (1.4182, 0.021304),
        # M. Daimon, A. Masumura, Appl. Opt. 46, 3811 (2007), at 20 degrees.
        "water": (
            *(0.5684027565, 0.005101829712, 0.1726177391, 0.01821153936),
            *(0.02086189578, 0.02620722293, 0.1130748688, 10.69792721),
        ),
    }
)
"""Sellmeier's B_1, C_1 [um^2], B_2, C_2, ... of glasses, with their sources."""
_LINE_D, _LINE_F, _LINE_C = 0.58756, 0.48613, 0.65627
_PAIRS = 4
_VISIBLE = 360.0, 830.0
_CHECKED_WAVELENGTHS = 48
_MOST_INDEX = 5.0


class GlassModel(_Model):
    glass: str | None = None
    sellmeier: tuple[float, ...] | None = Field(None, min_length=2, max_length=2 * _PAIRS)
    index: float | None = Field(None, ge=1, le=_MOST_INDEX, description="at 587.56 nm")
    abbe: float | None = Field(None, ge=5, le=200, description="(n_d - 1) / (n_F - n_C)")
    wavelength: float | None = Field(None, ge=_VISIBLE[0], le=_VISIBLE[1], description="of mono variants [nm]")

    @classmethod
    def build(cls, **values: object) -> GlassModel:
        text = values.get("sellmeier")
        if text is not None:
            try:
                values["sellmeier"] = _numbers(str(text).strip(" []"))
            except ValueError:
                raise MitsimError(f"{GLASS}: sellmeier: got {text!r}; give numbers separated by commas") from None
        model = validate(cls, values, GLASS)
        given = [name for name in ("glass", "sellmeier", "index") if getattr(model, name) is not None]
        if len(given) > 1:
            raise MitsimError(f"{GLASS}: {given[1]}: {given[0]} states the index already; give one of the two")
        if (model.index is None) != (model.abbe is None):
            lacking = "abbe" if model.abbe is None else "index"
            raise MitsimError(f"{GLASS}: {lacking}: is not given; index and abbe belong together")
        if model.glass is not None and model.glass not in CATALOGUE:
            raise MitsimError(f"{GLASS}: glass: got {model.glass!r}; give {', '.join(CATALOGUE)}, or sellmeier")
        if model.sellmeier is not None and len(model.sellmeier) % 2:
            raise MitsimError(
                f"{GLASS}: sellmeier: got {len(model.sellmeier)} numbers; give pairs B_1, C_1, B_2, C_2, ..."
            )
        for wavelength in np.linspace(*_VISIBLE, _CHECKED_WAVELENGTHS):
            squared = model.index_squared(float(wavelength))
            if not 1 <= squared <= _MOST_INDEX**2:
                raise MitsimError(
                    f"{GLASS}: {given[0]}: its index squared is {squared:.4g} at {wavelength:.0f} nm; give glass "
                    f"of an index of 1 to {_MOST_INDEX:g} from 360 to 830 nm"
                )
        return model

    def index_squared(self, wavelength: Any) -> Any:
        square = (wavelength * 1e-3) ** 2
        if self.index is not None and self.abbe is not None:
            slope = (self.index - 1) / (self.abbe * (_LINE_F**-2 - _LINE_C**-2))
            return (self.index + slope * (1 / square - _LINE_D**-2)) ** 2
        terms = self.sellmeier or CATALOGUE[self.glass or _USUAL]
        pairs = zip(terms[::2], terms[1::2], strict=True)
        return 1 + sum(strength * square / (square - pole) for strength, pole in pairs)


def is_glass(material: mi.BSDF) -> bool:
    return isinstance(getattr(material, "model", None), GlassModel)


def tune(scene: mi.Scene, wavelength_nm: float) -> None:
    """Set the wavelength of glass and tables in mono and RGB variants, unless the scene file names one."""
    parameters = mi.traverse(scene)
    for name, (_, _, node, _) in parameters.properties.items():
        if getattr(node, "tuned", False):
            parameters[name] = wavelength_nm
    parameters.update()


def _glass() -> type:
    class DispersiveGlass(bsdf_class()):  # type: ignore[misc]
        name = GLASS

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.model = GlassModel.build(**{name: props[name] for name in GlassModel.model_fields if name in props})
            usual = read_toml(shipped_path(*LIGHT))["effective_wavelength_nm"]
            self.wavelength = dr.opaque(mi.Float, self.model.wavelength or usual)
            self.tuned = self.model.wavelength is None
            both = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            refracted = mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.NonSymmetric
            self.m_components = [mi.BSDFFlags.DeltaReflection | both, refracted | both]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def traverse(self, callback: mi.TraversalCallback) -> None:
            callback.put("wavelength", self.wavelength, mi.ParamFlags.NonDifferentiable)

        def parameters_changed(self, keys: Sequence[str] = ()) -> None:
            dr.make_opaque(self.wavelength)

        def sample(
            self, ctx: mi.BSDFContext, si: Surface, s1: mi.Float, s2: mi.Point2f, active: mi.Bool = True
        ) -> Draw:
            wavelength = si.wavelengths[0] if mi.is_spectral else self.wavelength
            part, cosine, eta_it, eta_ti = mi.fresnel(si.wi.z, dr.sqrt(self.model.index_squared(wavelength)))
            kinds = mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission
            may = [ctx.is_enabled(kind, component) for component, kind in enumerate(kinds)]
            # If both are possible, chance decides and the weight is 1; else the weight is the part.
            reflected = s1 < part if all(may) else mi.Bool(may[0])
            chosen = dr.select(reflected, part, 1 - part)
            active = active & (si.wi.z != 0) & any(may)
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = dr.select(reflected, mi.reflect(si.wi), mi.refract(si.wi, cosine, eta_ti))
            bs.eta = dr.select(reflected, 1, eta_it)
            bs.pdf = dr.select(active, chosen if all(may) else 1, 0)
            bs.sampled_component = dr.select(reflected, mi.UInt32(0), 1)
            bs.sampled_type = dr.select(reflected, mi.UInt32(+kinds[0]), mi.UInt32(+kinds[1]))
            weight = mi.Float(1) if all(may) else chosen
            if ctx.mode == mi.TransportMode.Radiance:
                # A face preserves radiance over the square of the index (E. Veach 1997, 5.2).
                weight *= dr.select(reflected, 1, dr.square(eta_ti))
            return bs, mi.depolarizer(mi.Spectrum(dr.select(active & (bs.pdf > 0), weight, 0)))

    return DispersiveGlass


# -------- Grating

_ORDERS = 16
_ROUNDING = 1e-6

Part = Annotated[float, Field(ge=0, le=1)]
Wavelength = Annotated[float, Field(ge=1, le=1e6)]
Share = Annotated[float, Field(ge=0, le=1e9)]


class GratingModel(_Model):
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
    def of(cls, props: mi.Properties) -> GratingModel:
        values: dict[str, Any] = {}
        if "wavelengths" not in props:
            light = read_toml(shipped_path(*LIGHT))
            values = {"wavelengths": light["wavelengths_nm"], "shares": light["radiant_shares"]}
        for name in cls.model_fields:
            if name not in props:
                continue
            values[name] = value = props[name]
            if name != "grooves" and not isinstance(value, bool | int | float):
                try:
                    text = isinstance(value, str)
                    values[name] = _numbers(value) if text else np.array(value, dtype=np.float64).tolist()
                except (TypeError, ValueError):
                    raise MitsimError(f"{GRATING}: {name}: got {value!r}; give numbers separated by commas") from None
            elif name in ("efficiencies", "negative_efficiencies", "wavelengths", "shares"):
                values[name] = [value]
        values.setdefault("shares", [1.0] * len(values["wavelengths"]))
        model = validate(cls, values, GRATING)
        total = sum(model.orders.values()) + model.diffuse
        if total > 1 + _ROUNDING:
            raise MitsimError(
                f"{GRATING}: efficiencies of all orders and diffuse: got a sum of {total:g}; nothing reflects more "
                "than 1, lower them (orders below 0 count too)"
            )
        if len(model.shares) != len(model.wavelengths) or not sum(model.shares) > 0:
            raise MitsimError(
                f"{GRATING}: shares: got {model.shares} for wavelengths {model.wavelengths}; give one number for each "
                "line, not all 0"
            )
        if not any(model.direction):
            raise MitsimError(f"{GRATING}: direction: got {model.direction}; give a vector that is not 0")
        return model

    @property
    def orders(self) -> dict[int, float]:
        positive = self.efficiencies[1:]
        negative = positive if self.negative_efficiencies is None else self.negative_efficiencies
        below = {-1 - i: part for i, part in enumerate(negative)}
        above = {i: part for i, part in enumerate(self.efficiencies)}
        return dict(sorted({**below, **above}.items()))


def _grating() -> type:
    class Grating(bsdf_class()):  # type: ignore[misc]
        name = GRATING

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.model = GratingModel.of(props)
            if mi.is_rgb and len(self.model.wavelengths) != 3:
                raise MitsimError(
                    f"{GRATING}: wavelengths: got {len(self.model.wavelengths)} lines; variant {mi.variant()} wants "
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

        def _grating_vector(self, si: Surface) -> mi.Vector2f:
            circular = self.model.grooves == "circular"
            across = si.to_local(si.dp_du if circular else mi.Vector3f(self.model.direction))
            flat = mi.Vector2f(across.x, across.y)
            length = dr.norm(flat)
            return dr.select(length > 0, flat / length, mi.Vector2f(1, 0))

        def _lobes(self, si: Surface) -> Iterator[tuple[mi.Float, Light]]:
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

        def eval_pdf(self, ctx: mi.BSDFContext, si: Surface, wo: mi.Vector3f, active: mi.Bool = True) -> Value:
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
            self, ctx: mi.BSDFContext, si: Surface, s1: mi.Float, s2: mi.Point2f, active: mi.Bool = True
        ) -> Draw:
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


# -------- Materials made of others
#  Plugins ``mitsim_blendbsdf``, ``mitsim_mask``, ``mitsim_twosided``
# ------------------------------------------------------------------ Mitsuba's ``blendbsdf`` weighs a mirror's direction
# by the density of the other material there as well, as if both were densities: half a mirror over half a matt surface
# keeps 0.8 of the light. Its ``mask`` samples nothing when only the lobes of its material are asked for, and a
# ``twosided`` of two materials all lobes of the second in place of one. All three choose one of two materials: by
# weight, by opacity (the other is ``null``), or by side. Here a single direction (delta or null) has the chance of its
# choice as its ``pdf``, and a context with a component gives the part of the light that this component sends on,
# without chance.
#
# Plugins ``mitsim_bumpmap``, ``mitsim_normalmap``, ``mitsim_hair``, ``mitsim_principledthin``
# --------------------------------------------------------------------------------------------
# These are not reciprocal: the value f(wi, wo) is defined for light that arrives from wo and is seen from wi. Light
# that is followed forward (``TransportMode.Importance``) needs the adjoint f(wo, wi), which Mitsuba does not give (E.
# Veach 1997, 5.3). Here the forward value is that of the exchanged directions, so that an integrator takes the cosines
# to the shading normal of the surface alone. Directions of mirrors have no value to exchange; for them a white matt
# material under the same bumps gives the ratio of both, c = cos_p(wi) G(wi) / (cos_p(wo) G(wo)), where cos_p is the
# cosine to the bumps' normal and G is Mitsuba's shadowing of bumps.
#
# Parameters are those of Mitsuba's plugins of the same name. :mod:`mitsim.scene.load` puts these plugins into a scene.

PREFIX = "mitsim_"
_ANY = 2**32 - 1


def _wrappers() -> dict[str, type]:
    class Wrapper(bsdf_class()):  # type: ignore[misc]
        parts: list[mi.BSDF]

        def _hold(self, props: mi.Properties, *parts: mi.BSDF) -> None:
            self.name, self.model, self.parts = props.plugin_name(), parts, list(parts)
            self.m_components = [part.flags(i) for part in parts for i in range(part.component_count())]
            self.m_flags = reduce(or_, (part.flags() for part in parts))

        def _shares(self, si: Surface, active: mi.Bool) -> Sequence[mi.Float]:
            return (mi.Float(1),)

        def traverse(self, callback: mi.TraversalCallback) -> None:
            for number, part in enumerate(self.parts):
                callback.put(f"part_{number}", part, mi.ParamFlags.Differentiable)

        def eval_null_transmission(self, si: Surface, active: mi.Bool = True) -> mi.Spectrum:
            shares = zip(self._shares(si, active), self.parts, strict=True)
            return sum((part.eval_null_transmission(si, active) * share for share, part in shares), mi.Spectrum(0))

        def eval_diffuse_reflectance(self, si: Surface, active: mi.Bool = True) -> mi.Spectrum:
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

        def _shares(self, si: Surface, active: mi.Bool) -> Sequence[mi.Float]:
            side = dr.select(si.wi.z < 0, mi.Float(1), 0)
            second = side if self.weight is None else dr.clip(self.weight.eval_1(si, active), 0, 1)
            return 1 - second, second

        def sample(
            self, ctx: mi.BSDFContext, si: Surface, s1: mi.Float, s2: mi.Point2f, active: mi.Bool = True
        ) -> Draw:
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

        def eval_pdf(self, ctx: mi.BSDFContext, si: Surface, wo: mi.Vector3f, active: mi.Bool = True) -> Value:
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
            self, ctx: mi.BSDFContext, si: Surface, s1: mi.Float, s2: mi.Point2f, active: mi.Bool = True
        ) -> Draw:
            bs, value = self.parts[0].sample(ctx, si, s1, s2, active)
            if ctx.mode == mi.TransportMode.Radiance:
                return bs, value
            single = active & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            if self.white is not None:
                # Refracted light is looked at from the side that it comes from, where white matt has a value.
                beside = bs.wo * dr.mulsign(dr.mulsign(mi.Float(1), si.wi.z), bs.wo.z)
                values = adjoint(self.white, ctx, si, beside, single), self.white.eval(ctx, si, beside, single)
                into, out = (mi.unpolarized_spectrum(each)[0] for each in values)
                value *= dr.select(single, dr.select(out > 0, into / out, 0), 1)
            turned = adjoint(self.parts[0], ctx, si, bs.wo, active & ~single)
            return bs, dr.select(single, value, dr.select(bs.pdf > 0, turned / bs.pdf, 0))

        def eval_pdf(self, ctx: mi.BSDFContext, si: Surface, wo: mi.Vector3f, active: mi.Bool = True) -> Value:
            value, density = self.parts[0].eval_pdf(ctx, si, wo, active)
            if ctx.mode == mi.TransportMode.Importance:
                value = adjoint(self.parts[0], ctx, si, wo, active)
            return value, density

    made = {**dict.fromkeys(CHOICES, Choice), **dict.fromkeys(DIRECTED, Directed)}
    return {PREFIX + name: each for name, each in made.items()}
