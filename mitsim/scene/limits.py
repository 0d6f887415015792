"""Numbers that a scene can have: finite, of a sensible size, and no more light out of a surface than into it."""

from __future__ import annotations

from collections.abc import Container, Iterable
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.errors import cut, near_name
from mitsim.devices.camera import CameraGeometry
from mitsim.scene.headers import FARTHEST
from mitsim.scene.outline import Tag

_LARGEST = 1e20
"""Squared, still far from the end of single precision (3.4e38) in which Mitsuba calculates."""
_RIGID = 1e-4
"""Above the 2e-5 by which a matrix that is written with five digits departs from a rotation."""
_SMALLEST_SIZE = 1e-9
"""Of what a transform stretches, in mm: far below any light's wavelength, and 1 / its cube is still finite."""
_MOST_UNEVEN = 1e7
"""Single precision has seven digits: a transform that stretches one side so much more cannot be undone."""


@dataclass(frozen=True)
class Range:
    """Numbers from ``low`` to ``high``; ``above`` and ``below`` leave out the bounds themselves."""

    low: float
    high: float
    above: bool = False
    below: bool = False
    hint: str = ""

    def check(self, tag: Tag, name: str, numbers: Iterable[float]) -> None:
        """MitsimError for the first number that is not allowed.

        Parameters
        ----------
        tag, name
            where it stands, and what it is called.
        numbers
            in order.
        """
        for number in numbers:
            if not np.isfinite(number):
                raise tag.refusal(name, number, "give a finite number")
            over = number > self.low if self.above else number >= self.low
            if not (over and (number < self.high if self.below else number <= self.high)):
                words = f"{'above ' if self.above else ''}{self.low:g} to {'below ' if self.below else ''}{self.high:g}"
                raise tag.refusal(name, number, f"allowed is {words}{self.hint}")


def _of_camera(field: str) -> Range:
    """What the camera allows."""
    bounds = {
        kind: getattr(bound, kind)
        for bound in CameraGeometry.model_fields[field].metadata
        for kind in ("ge", "le")
        if hasattr(bound, kind)
    }
    return Range(bounds["ge"], bounds["le"])


ANY = Range(-_LARGEST, _LARGEST)
LIGHT = Range(0, _LARGEST, hint=", light is at least 0")
REFLECTED = Range(0, 1, hint=": light is at least 0, and nothing reflects more than 1")
WHOLE = Range(-1e9, 1e9)
"""Mitsuba stores whole numbers of 32 bits."""
WAVELENGTH = Range(0, 1e6, above=True)
"""In nm, to a millimetre."""
COORDINATE = Range(-FARTHEST, FARTHEST)
_PART = Range(0, 1)
_ANGLE = Range(0, 180, above=True, below=True)
_ROUGHNESS = Range(0, 1, above=True)
_INDEX = Range(1, 10)
_METRES = "; 1 unit is 1 mm, and this looks like metres"
REFLECTANCES = (
    *("reflectance", "diffuse_reflectance", "albedo", "base_color"),
    *("specular_reflectance", "specular_transmittance", "transmittance"),
)
"""Parameters that are the part of light that a surface sends on."""
LIMITS = {
    **dict.fromkeys(REFLECTANCES, REFLECTED),
    **dict.fromkeys(("radiance", "irradiance", "intensity", "scale", "sigma_t", "sigma_a"), LIGHT),
    **dict.fromkeys(("eumelanin", "pheomelanin"), LIGHT),
    **dict.fromkeys(("alpha", "alpha_u", "alpha_v"), _ROUGHNESS),
    **dict.fromkeys(("roughness", "anisotropic", "metallic", "opacity", "weight"), _PART),
    # Further weights of principled materials, of which Mitsuba takes any number.
    **dict.fromkeys(("sheen", "sheen_tint", "spec_tint", "spec_trans", "specular"), _PART),
    **dict.fromkeys(("flatness", "clearcoat", "clearcoat_gloss"), _PART),
    "diff_trans": Range(0, 2),
    **dict.fromkeys(("eta", "k"), Range(0, 1000)),
    **dict.fromkeys(("fov", "cutoff_angle", "beam_width"), _ANGLE),
    **dict.fromkeys(("int_ior", "ext_ior"), _INDEX),
    **dict.fromkeys(("width", "height", "crop_width", "crop_height"), _of_camera("pixels")),
    "radius": Range(0, FARTHEST, above=True),
    "temperature": Range(0, 1e5, above=True),
    "g": Range(-1, 1, above=True, below=True),
    "sample_count": Range(1, 1e6),
    "max_depth": Range(-1, 10000),
    "rr_depth": Range(1, 10000),
    # Below a wavelength of light, and too near for a camera whose mask lies in front of it: lengths given in metres.
    **dict.fromkeys(("pixel_pitch", "row_pitch", "mask_feature"), Range(1e-4, FARTHEST, hint=_METRES)),
    "scene_distance": Range(1, FARTHEST, hint=_METRES),
}
"""What a number may be, by the name of the parameter, whatever plugin has it; those of the camera it checks itself."""
TABLES = ("value", "values", "color", "color0", "color1", "scale")
"""Numbers by which a texture without a file says how much light it stands for."""


def check_transform(tag: Tag, name: str, matrix: npt.NDArray[np.float64], rigid: bool) -> None:
    """MitsimError for a transform that cannot be undone.

    Parameters
    ----------
    tag, name
        where it stands, and what it is called.
    matrix
        (4, 4).
    rigid
        whether it may only turn and move.
    """
    if not np.isfinite(matrix).all():
        raise tag.refusal(name, np.nan, "give finite numbers")
    turn = matrix[:3, :3]
    sizes = np.linalg.svd(turn, compute_uv=False)
    even = sizes[2] > _SMALLEST_SIZE and sizes[0] < FARTHEST and sizes[0] < _MOST_UNEVEN * sizes[2]
    if not (even and np.abs(matrix).max() <= FARTHEST):
        got = f"stretching by {sizes[2]:g} to {sizes[0]:g}, moving by {np.abs(matrix[:3, 3]).max():g}"
        rule = f"it must be invertible, with sizes of {_SMALLEST_SIZE:g} to {FARTHEST:g}"
        raise tag.refusal(name, got, rule)
    error = float(np.abs(turn.T @ turn - np.eye(3)).max())
    if rigid and not (error < _RIGID and np.linalg.det(turn) > 0):
        rule = "a camera or projector is moved and turned only: no scaling, no mirroring"
        raise tag.refusal(name, f"R^T R {error:.2g} from 1", rule)


# -------- Which plugins a scene may have
# Those that are left out run or read what cannot be checked beforehand (binary grids, tables and caches), or give
# something else than light on a sensor.

_TEXTURES = "bitmap blackbody checkerboard d65 irregular mesh_attribute rawconstant regular srgb uniform"
PLUGINS = {
    "bsdf": "blendbsdf bumpmap circular conductor dielectric diffuse hair mask mitsim_glass mitsim_grating normalmap "
    "null plastic polarizer pplastic principled principledthin retarder roughconductor roughdielectric roughplastic "
    "thindielectric twosided",
    "emitter": "area constant directional envmap mitsim_projector point projector spot",
    "film": "hdrfilm specfilm",
    "integrator": "direct path ptracer volpath volpathmis",
    "medium": "homogeneous",
    "phase": "blendphase hg isotropic rayleigh",
    "rfilter": "box catmullrom gaussian lanczos mitchell tent",
    "sampler": "independent ldsampler multijitter orthogonal stratified",
    "sensor": "irradiancemeter mitsim_lensless orthographic perspective radiancemeter thinlens",
    "shape": "cube cylinder disk instance merge obj ply rectangle shapegroup sphere",
    "spectrum": _TEXTURES,
    "texture": _TEXTURES,
    "volume": "constvolume",
}
"""Plugins by tag, beside ``<scene>``."""
_SPECTRAL_ALONE = "only spectral variants have it; use --variant {spectral}, or --colour lines or mosaic"
_LACKED = {
    "blackbody": _SPECTRAL_ALONE,
    "irregular": f'{_SPECTRAL_ALONE}, or write the table as value="400:0.2, 700:0.5"',
    "regular": f'{_SPECTRAL_ALONE}, or write the table as value="400:0.2, 700:0.5"',
    "specfilm": "only spectral variants have it; use hdrfilm",
}
"""Plugins of Mitsuba 3.9.1 that its variants without wavelengths lack, and what to do. Textures are loaded there, and
end the run when light meets them."""


def references(props: mi.Properties) -> list[int]:
    """Numbers of the nodes that an object's ``props`` refer to."""
    resolved = mi.Properties.Type.ResolvedReference
    return [props[name].index() for name in props.keys() if props.type(name) == resolved]  # noqa: SIM118 - no dict


def check_plugin(tag: Tag, plugin: str) -> None:
    """MitsimError when the object at ``tag`` cannot be a ``plugin``."""
    allowed = PLUGINS.get(tag.name, "scene").split()
    if plugin not in allowed or (tag.name == "scene" and "version" not in tag.attributes):
        raise tag.refusal(
            "type", repr(plugin), f"{near_name(cut(plugin), allowed)}allowed are {', '.join(sorted(allowed))}"
        )


def check_variant(tag: Tag, plugin: str, given: Container[str], variant: str) -> None:
    """MitsimError when a Mitsuba ``variant`` lacks the ``plugin`` at ``tag``, or what it needs of it.

    Parameters
    ----------
    tag, plugin
        the object.
    given
        names of its properties.
    variant
        of Mitsuba.
    """
    backend, _, kind = variant.rpartition("_")
    if plugin in _LACKED and kind != "spectral":
        rule = f"{variant} lacks it: {_LACKED[plugin].format(spectral=f'{backend}_spectral')}"
        raise tag.refusal("type", repr(plugin), rule)
    if plugin == "hair" and kind == "mono" and "sigma_a" not in given:
        rule = f"{variant} has no colours for its pigments; give sigma_a in their place, or use --variant {backend}_rgb"
        raise tag.refusal("type", repr(plugin), rule)
