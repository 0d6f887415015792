"""Which plugins a scene may have.

Those that are left out run or read what cannot be checked beforehand (binary grids, tables and caches), or give
something else than light on a sensor.
"""

from __future__ import annotations

import difflib
from collections.abc import Container

from mitsim.core.errors import cut
from mitsim.scene.guard.outline import Tag

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


def check_plugin(tag: Tag, plugin: str) -> None:
    """MitsimError when the object at ``tag`` cannot be a ``plugin``."""
    allowed = PLUGINS.get(tag.name, "scene").split()
    if plugin not in allowed or (tag.name == "scene" and "version" not in tag.attributes):
        near = difflib.get_close_matches(cut(plugin), allowed, 1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise tag.refusal("type", repr(plugin), f"{hint}allowed are {', '.join(sorted(allowed))}")


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
