"""Plugin ``mitsim_measured``, which renders a scene's ``measured``: a material by a table of measured values.

Tables are files of the RGL material database (J. Dupuy and W. Jakob, ACM Trans. Graph. 37, 274, 2018), in Mitsuba's
tensor format. The meaning is that of Mitsuba's ``measured``, which does not serve here: it lacks mono variants, and
light of an isotropic table that is no mirror image of itself depends on uninitialised memory.

============  ======  =================================================================================================
parameter     unit    meaning
============  ======  =================================================================================================
``filename``  -       table with ``spectra`` or with ``rgb``
============  ======  =================================================================================================

Mono variants take ``spectra`` at the projector's effective wavelength, and the luminance of ``rgb``. Spectral variants
need ``spectra``, which are constant beyond the ends of the table, and RGB variants ``rgb``. One-sided. A table need not
be reciprocal: light that is followed forward takes the value of the exchanged directions. A warning states the part
that a table reflects if it exceeds 1. ``mi.traverse`` shows ``wavelength``, which mono variants use.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.configuration import read_toml, shipped_path
from mitsim.core.environment import device_array
from mitsim.core.errors import MitsimError
from mitsim.scene.headers import read_measured
from mitsim.transport.plugins.base import LIGHT, Draw, Surface, Value, adjoint, bsdf_class

_LUMINANCE = 0.212671, 0.715160, 0.072169
"""Weights of sRGB's channels (IEC 61966-2-1), as in Mitsuba."""
_ANGLES, _DRAWS, _MOST = (0, 20, 40, 60, 75), 64, 1.01


def measured_class() -> type:
    class Measured(bsdf_class()):  # type: ignore[misc]
        name, tuned = "mitsim_measured", True

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.m_components = [mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]
            path = Path(str(mi.file_resolver().resolve(mi.filesystem.path(props["filename"]))))
            table = read_measured(path)
            self.model, self.spectral = path.name, "spectra" in table
            if self.spectral if mi.is_rgb else mi.is_spectral and not self.spectral:
                kind, held = ("spectral", "spectra") if self.spectral else ("rgb", "rgb")
                remedy = f"take a {kind} variant, a mono one{', or --colour lines' if self.spectral else ''}"
                raise MitsimError(f"{path.name} has {held}, which {mi.variant()} cannot use; {remedy}")
            at = [table[each].tolist() for each in ("phi_i", "theta_i")]
            self.isotropic = len(at[0]) <= 2
            # Parts of a turn that an anisotropic table covers, by the material's symmetry.
            self.parts = 1 if self.isotropic else round(2 * np.pi / (at[0][-1] - at[0][0]))
            self.normals, self.luminance = (mi.MarginalContinuous2D2(table[each], at) for each in ("vndf", "luminance"))
            third = table["wavelengths"].tolist() if self.spectral else [0.0, 1.0, 2.0]
            self.values = mi.MarginalContinuous2D3(
                table["spectra" if self.spectral else "rgb"], [*at, third], False, False
            )
            self.ndf, self.sigma = (
                mi.MarginalContinuous2D0(table[each], [], False, False) for each in ("ndf", "sigma")
            )
            self.divided = bool(table["jacobian"][0])
            self.wavelength = dr.opaque(mi.Float, read_toml(shipped_path(*LIGHT))["effective_wavelength_nm"])
            if (part := self._largest_part()) > _MOST:
                warnings.warn(f"material {path.name}: reflects up to {part:.3g} of the light", stacklevel=2)

        def traverse(self, callback: mi.TraversalCallback) -> None:
            callback.put("wavelength", self.wavelength, mi.ParamFlags.NonDifferentiable)

        def parameters_changed(self, keys: Sequence[str] = ()) -> None:
            dr.make_opaque(self.wavelength)

        def _channels(self, si: Surface, sample: mi.Point2f, at: mi.Point2f, active: mi.Bool) -> mi.Spectrum:
            def value(third: Any) -> mi.Float:
                return self.values.eval(sample, mi.Vector3f(at.x, at.y, third), active)

            if mi.is_spectral:
                return mi.Spectrum([value(each) for each in si.wavelengths])
            if self.spectral:
                return mi.Spectrum(value(self.wavelength))
            red, green, blue = (value(mi.Float(each)) for each in range(3))
            weighted = zip(_LUMINANCE, (red, green, blue), strict=True)
            return mi.Spectrum([red, green, blue] if mi.is_rgb else sum(weight * each for weight, each in weighted))

        def _signs(self, wi: mi.Vector3f) -> mi.Vector3f:
            """Return the signs by which directions turn into the part of a turn that the table covers."""
            y = -dr.mulsign(mi.Float(1), wi.y) if self.parts > 1 else mi.Float(1)
            return mi.Vector3f(-dr.mulsign(mi.Float(1), wi.x) if self.parts == 4 else y, y, 1)

        def sample(
            self, ctx: mi.BSDFContext, si: Surface, s1: mi.Float, s2: mi.Point2f, active: mi.Bool = True
        ) -> Draw:
            active = active & (si.wi.z > 0) & ctx.is_enabled(mi.BSDFFlags.GlossyReflection)
            signs = self._signs(si.wi)
            wi = si.wi * signs
            at = mi.Point2f(dr.atan2(wi.y, wi.x), _elevation(wi))
            unit = self.normals.sample(self.luminance.sample(mi.Point2f(s2.y, s2.x), at, active)[0], at, active)[0]
            azimuth = (2 * unit.y - 1) * dr.pi + (at.x if self.isotropic else 0)
            (sine, cosine), (across, up) = dr.sincos(azimuth), dr.sincos(dr.square(unit.x) * dr.pi / 2)
            m = mi.Vector3f(cosine * across, sine * across, up)
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = (2 * dr.dot(wi, m) * m - wi) * signs
            value, bs.pdf = self.eval_pdf(ctx, si, bs.wo, active)
            bs.eta, bs.sampled_type = 1, mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            return bs, dr.select(bs.pdf > 0, value / bs.pdf, 0)

        def eval_pdf(self, ctx: mi.BSDFContext, si: Surface, wo: mi.Vector3f, active: mi.Bool = True) -> Value:
            active = active & (si.wi.z > 0) & (wo.z > 0) & ctx.is_enabled(mi.BSDFFlags.GlossyReflection)
            signs = self._signs(si.wi)
            wi = si.wi * signs
            m = dr.normalize(wi + wo * signs)
            at = mi.Point2f(dr.atan2(wi.y, wi.x), _elevation(wi))
            turned = dr.atan2(m.y, m.x) - (at.x if self.isotropic else 0)
            unit = mi.Point2f(_root(_elevation(m)), turned / (2 * dr.pi) + 0.5)
            unit.y -= dr.floor(unit.y)
            sample, density = self.normals.invert(unit, at, active)
            # From the unit square to half vectors, theta = pi u^2 / 2 and phi = pi (2 v - 1), and to directions.
            area = 2 * dr.square(dr.pi) * unit.x * dr.sqrt(dr.square(m.x) + dr.square(m.y))
            pdf = density * self.luminance.eval(sample, at, active) / (dr.maximum(area, 1e-6) * 4 * dr.dot(wi, m))
            if ctx.mode == mi.TransportMode.Importance:
                value = adjoint(self, ctx, si, wo, active)
            else:
                value = self._channels(si, sample, at, active)
                if self.divided:
                    area = self.sigma.eval(mi.Point2f(_root(at.y), at.x / (2 * dr.pi) + 0.5), active=active)
                    value *= self.ndf.eval(unit, active=active) / (4 * area)
            return dr.select(active, value, 0), dr.select(active, pdf, 0)

        def _largest_part(self) -> float:
            """Return the largest reflected part over angles of incidence, by samples on an even grid."""
            even = (np.arange(_DRAWS) + 0.5) / _DRAWS
            angle, *s2 = (device_array(mi.Float, each) for each in np.meshgrid(np.radians(_ANGLES), even, even))
            si = dr.zeros(mi.SurfaceInteraction3f, dr.width(angle))
            if mi.is_spectral:
                si.wavelengths = mi.Spectrum(np.linspace(400, 700, 4).tolist())
            si.wi = mi.Vector3f(-dr.sin(angle), 0, dr.cos(angle))
            weight = np.array(self.sample(mi.BSDFContext(), si, mi.Float(0.5), mi.Point2f(*s2))[1])
            return float(weight.reshape(-1, _DRAWS, len(_ANGLES), _DRAWS).mean(axis=(1, 3)).max())

    return Measured


def _elevation(direction: mi.Vector3f) -> mi.Float:
    """Return the angle to the normal, also where its cosine is rounded to 1."""
    away = mi.Vector3f(direction.x, direction.y, direction.z - 1)
    return 2 * dr.safe_asin(0.5 * dr.norm(away))


def _root(angle: mi.Float) -> mi.Float:
    return dr.sqrt(angle * (2 / dr.pi))
