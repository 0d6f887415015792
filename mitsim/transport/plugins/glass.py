"""Dispersive glass: a Mitsuba BSDF, a smooth face that reflects and refracts by wavelength.

Plugin ``mitsim_glass``
-----------------------
Mitsuba's ``dielectric`` with an index of refraction that follows the wavelength, by one of::

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
"""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from mitsim.core.configuration import read_toml, shipped_path, validate
from mitsim.core.errors import MitsimError
from mitsim.transport.plugins.base import bsdf_class, numbers

PLUGIN = "mitsim_glass"
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
Length = TypeVar("Length", float, Any)


class GlassModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    glass: str | None = None
    sellmeier: tuple[float, ...] | None = Field(None, min_length=2, max_length=2 * _PAIRS)
    index: float | None = Field(None, ge=1, le=_MOST_INDEX, description="at 587.56 nm")
    abbe: float | None = Field(None, ge=5, le=200, description="(n_d - 1) / (n_F - n_C)")
    wavelength: float | None = Field(None, ge=_VISIBLE[0], le=_VISIBLE[1], description="of mono variants [nm]")

    @classmethod
    def build(cls, **values: object) -> GlassModel:
        model = validate(cls, values, PLUGIN)
        given = [name for name in ("glass", "sellmeier", "index") if getattr(model, name) is not None]
        if len(given) > 1:
            raise MitsimError(f"{PLUGIN}: {given[1]}: the index is told by {given[0]} already; give one of the two")
        if (model.index is None) != (model.abbe is None):
            lacking = "abbe" if model.abbe is None else "index"
            raise MitsimError(f"{PLUGIN}: {lacking}: is not given; index and abbe belong together")
        if model.glass is not None and model.glass not in CATALOGUE:
            raise MitsimError(f"{PLUGIN}: glass: got {model.glass!r}; give {', '.join(CATALOGUE)}, or sellmeier")
        if model.sellmeier is not None and len(model.sellmeier) % 2:
            raise MitsimError(
                f"{PLUGIN}: sellmeier: got {len(model.sellmeier)} numbers; give pairs B_1, C_1, B_2, C_2, ..."
            )
        for wavelength in np.linspace(*_VISIBLE, _CHECKED_WAVELENGTHS):
            squared = model.index_squared(float(wavelength))
            if not 1 <= squared <= _MOST_INDEX**2:
                raise MitsimError(
                    f"{PLUGIN}: {given[0]}: its index squared is {squared:.4g} at {wavelength:.0f} nm; give glass "
                    f"of an index of 1 to {_MOST_INDEX:g} from 360 to 830 nm"
                )
        return model

    def index_squared(self, wavelength: Length) -> Length:
        square = (wavelength * 1e-3) ** 2
        if self.index is not None and self.abbe is not None:
            slope = (self.index - 1) / (self.abbe * (_LINE_F**-2 - _LINE_C**-2))
            return (self.index + slope * (1 / square - _LINE_D**-2)) ** 2
        terms = self.sellmeier or CATALOGUE[self.glass or _USUAL]
        pairs = zip(terms[::2], terms[1::2], strict=True)
        return 1 + sum(strength * square / (square - pole) for strength, pole in pairs)


def _model(props: mi.Properties) -> GlassModel:
    values = {name: props[name] for name in GlassModel.model_fields if name in props}
    text = values.get("sellmeier")
    if text is not None:
        try:
            values["sellmeier"] = numbers(str(text).strip(" []"))
        except ValueError:
            raise MitsimError(f"{PLUGIN}: sellmeier: got {text!r}; give numbers separated by commas") from None
    return GlassModel.build(**values)


def is_glass(material: mi.BSDF) -> bool:
    return isinstance(getattr(material, "model", None), GlassModel)


def tune(scene: mi.Scene, wavelength_nm: float) -> None:
    """Set the wavelength of a scene's glass in mono and RGB variants, unless its file names one."""
    parameters = mi.traverse(scene)
    for name, (_, _, node, _) in parameters.properties.items():
        if is_glass(node) and node.model.wavelength is None:
            parameters[name] = wavelength_nm
    parameters.update()


def plugin_class() -> type:
    class DispersiveGlass(bsdf_class()):  # type: ignore[misc]
        name = PLUGIN

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.model = _model(props)
            usual = read_toml(shipped_path("calibration", "mp_cl1.toml"))["effective_wavelength_nm"]
            self.wavelength = dr.opaque(mi.Float, self.model.wavelength or usual)
            both = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            refracted = mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.NonSymmetric
            self.m_components = [mi.BSDFFlags.DeltaReflection | both, refracted | both]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def traverse(self, callback: mi.TraversalCallback) -> None:
            callback.put("wavelength", self.wavelength, mi.ParamFlags.NonDifferentiable)

        def parameters_changed(self, keys: Sequence[str] = ()) -> None:
            dr.make_opaque(self.wavelength)

        def sample(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, s1: mi.Float, s2: mi.Point2f, active: mi.Bool = True
        ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
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
