"""Which tags, attributes and plugins a scene may have.

Plugins that are left out run or read what cannot be checked beforehand (binary grids, tables and caches), or give
something else than light on a sensor.
"""

from __future__ import annotations

import difflib

from mitsim.core.errors import cut
from mitsim.scene.guard.reading import Element

_ATTRIBUTES = {
    "alias": ("id as", ""),
    "boolean": ("name value", ""),
    "default": ("name value", ""),
    "float": ("name value", ""),
    "include": ("filename", "name"),
    "integer": ("name value", ""),
    "lookat": ("origin target", "up"),
    "matrix": ("value", ""),
    "point": ("name", "value x y z"),
    "ref": ("id", "name"),
    "rgb": ("name value", ""),
    "rotate": ("angle", "value x y z"),
    "scale": ("", "value x y z"),
    "spectrum": ("name", "value filename"),
    "string": ("name value", ""),
    "transform": ("name", ""),
    "translate": ("", "value x y z"),
    "vector": ("name", "value x y z"),
}
"""Attributes of the tags that are no plugins: those needed, and those allowed beside."""
_TURNS = ("lookat", "matrix", "rotate", "scale", "translate")

_TEXTURES = "bitmap blackbody checkerboard d65 irregular mesh_attribute rawconstant regular srgb uniform"
PLUGINS = {
    "bsdf": "blendbsdf bumpmap conductor dielectric diffuse hair mask mitsim_grating normalmap null plastic "
    "polarizer pplastic principled principledthin retarder roughconductor roughdielectric roughplastic thindielectric "
    "twosided circular",
    "emitter": "area constant directional directionalarea envmap mitsim_projector point projector spot",
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
"""Plugins by tag."""


def check_words(element: Element, parent: Element | None) -> None:
    """MitsimError for a tag, attribute or plugin that a scene cannot have, or in a place where it cannot be."""
    tag = element.tag
    if tag == "path":
        raise element.refusal(
            "path",
            repr(element.attributes.get("value", "")),
            ("it can load native code; remove it and name files relative to the scene"),
        )
    if parent is None:
        _check_attributes(element, "version", "type id name")
        return
    if (parent.tag == "transform") != (tag in _TURNS):
        raise element.refusal("tag", tag, f"<transform> holds {', '.join(_TURNS)}, and they stand nowhere else")
    if parent.tag in _ATTRIBUTES and parent.tag not in ("transform", "include") and not is_plugin(parent):
        raise element.refusal("tag", tag, f"<{parent.tag}> holds nothing")
    if is_plugin(element):
        _check_attributes(element, "type", "id name")
        allowed = PLUGINS[tag].split()
        if element.kind not in allowed:
            raise element.refusal("type", repr(element.kind), _among(element.kind, allowed))
    elif tag in _ATTRIBUTES:
        _check_attributes(element, *_ATTRIBUTES[tag])
    else:
        raise element.refusal("tag", repr(tag), _among(tag, [*_ATTRIBUTES, *PLUGINS]))


def is_plugin(element: Element) -> bool:
    """Whether the element is an object of its own, not a number, text or transform of its parent."""
    return element.tag in PLUGINS and (element.tag != "spectrum" or "type" in element.attributes)


def _check_attributes(element: Element, needed: str, beside: str) -> None:
    allowed = {*needed.split(), *beside.split()}
    for key in element.attributes:
        if key not in allowed:
            raise element.refusal("attribute", repr(key), _among(key, sorted(allowed)))
    for key in needed.split():
        if key not in element.attributes:
            raise element.refusal(key, "nothing", f"<{element.tag}> needs {needed.replace(' ', ' and ')}")


def _among(word: str, allowed: list[str]) -> str:
    near = difflib.get_close_matches(cut(word), allowed, 1)
    hint = f"did you mean {near[0]}? " if near else ""
    return f"{hint}allowed are {', '.join(sorted(allowed))}"
