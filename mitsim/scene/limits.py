"""Limits of a scene: finite numbers of sensible size, reflectances up to 1, allowed plugins, and unfit estimators."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from mitsim.core.errors import MitsimError
from mitsim.devices.camera import PIXELS
from mitsim.scene.headers import FARTHEST
from mitsim.scene.outline import Tag

if TYPE_CHECKING:
    from mitsim.scene.outline import Outline

_LARGEST = 1e20
"""Largest number: its square is far from the end of single precision (3.4e38)."""


@dataclass(frozen=True)
class Range:
    low: float
    high: float
    above: bool = False
    below: bool = False
    hint: str = ""

    def check(self, tag: Tag, name: str, numbers: Iterable[float]) -> None:
        for number in numbers:
            if not np.isfinite(number):
                raise tag.refusal(name, number, "give a finite number")
            over = number > self.low if self.above else number >= self.low
            if not (over and (number < self.high if self.below else number <= self.high)):
                words = f"{'above ' if self.above else ''}{self.low:g} to {'below ' if self.below else ''}{self.high:g}"
                raise tag.refusal(name, number, f"allowed is {words}{self.hint}")


ANY = Range(-_LARGEST, _LARGEST)
LIGHT = Range(0, _LARGEST, hint=", light is at least 0")
REFLECTED = Range(0, 1, hint=": light is at least 0, and nothing reflects more than 1")
WHOLE = Range(-1e9, 1e9)
"""Whole numbers of 32 bits."""
WAVELENGTH = Range(0, 1e6, above=True)
"""Wavelengths in nm, up to a millimetre."""
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
LIMITS = {
    **dict.fromkeys(REFLECTANCES, REFLECTED),
    **dict.fromkeys(("radiance", "irradiance", "intensity", "scale", "sigma_t", "sigma_a"), LIGHT),
    **dict.fromkeys(("eumelanin", "pheomelanin"), LIGHT),
    **dict.fromkeys(("alpha", "alpha_u", "alpha_v"), _ROUGHNESS),
    **dict.fromkeys(("roughness", "anisotropic", "metallic", "opacity", "weight"), _PART),
    # These are further weights of principled materials, for which Mitsuba accepts any number.
    **dict.fromkeys(("sheen", "sheen_tint", "spec_tint", "spec_trans", "specular"), _PART),
    **dict.fromkeys(("flatness", "clearcoat", "clearcoat_gloss"), _PART),
    "diff_trans": Range(0, 2),
    **dict.fromkeys(("eta", "k"), Range(0, 1000)),
    **dict.fromkeys(("fov", "cutoff_angle", "beam_width"), _ANGLE),
    **dict.fromkeys(("int_ior", "ext_ior"), _INDEX),
    **dict.fromkeys(("width", "height", "crop_width", "crop_height"), Range(*PIXELS)),
    "radius": Range(0, FARTHEST, above=True),
    "temperature": Range(0, 1e5, above=True),
    "g": Range(-1, 1, above=True, below=True),
    "sample_count": Range(1, 1e6),
    # Only the reference reads these, and it would lose light by other values.
    **dict.fromkeys(("shading_samples", "emitter_samples", "bsdf_samples"), Range(1, 1e6)),
    "sampling_weight": Range(0, _LARGEST, above=True, hint=": the reference would find no light of this lamp"),
    "timeout": Range(-1, 0, hint=": the reference would stop before all its light is in"),
    "max_depth": Range(-1, 10000),
    "rr_depth": Range(1, 10000),
    # The lower limit refuses lengths in metres: it is below a wavelength, and too near for a camera with a mask.
    **dict.fromkeys(("pixel_pitch", "row_pitch", "mask_feature"), Range(1e-4, FARTHEST, hint=_METRES)),
    "scene_distance": Range(1, FARTHEST, hint=_METRES),
}
"""Allowed range by name of the parameter, for any plugin; the camera checks its own."""
TABLES = ("value", "values", "color", "color0", "color1", "scale")


# -------- Which plugins a scene may have
# Other plugins run or read content that cannot be checked beforehand (binary grids, tables and caches), or give no
# light on a sensor.

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
"""Allowed plugins by tag, beside ``<scene>``."""
_SPECTRAL_ALONE = "only spectral variants have it; use --variant {spectral}, or --colour lines or mosaic"
LACKED = {
    "blackbody": _SPECTRAL_ALONE,
    "irregular": f'{_SPECTRAL_ALONE}, or write the table as value="400:0.2, 700:0.5"',
    "regular": f'{_SPECTRAL_ALONE}, or write the table as value="400:0.2, 700:0.5"',
    "specfilm": "only spectral variants have it; use hdrfilm",
}
"""Plugins of Mitsuba 3.9.1 that variants without wavelengths lack, and the remedy."""


def references_of(props: mi.Properties) -> list[str]:
    resolved = mi.Properties.Type.ResolvedReference
    return [name for name in props.keys() if props.type(name) == resolved]  # noqa: SIM118 - no dict


def references(props: mi.Properties) -> list[int]:
    return [props[name].index() for name in references_of(props)]


# -------- Estimators, and what they cannot render
#
# Refusals of a checked scene by each estimator, and light that is known to be lost.
#
# The factored estimator supports only surfaces. The reference is the scene's own integrator. Of Mitsuba's, only
# integrators for volumes see a light through surfaces that let it pass straight: the others treat a hole in a cut-out
# material as opaque when they connect a surface to a lamp or projector, and lose that light.

STRAIGHT = ("circular", "mask", "null", "polarizer", "retarder", "thindielectric")
"""Materials that let light pass straight on."""
BUMPS = ("bumpmap", "normalmap")
"""Materials that change the frame of another one and hide which light it lets pass."""
DIRECTED = (*BUMPS, "hair", "principledthin")
"""Materials that are not reciprocal."""
CHOICES = ("blendbsdf", "mask", "twosided")
"""Materials that choose between two others."""
MIRRORS = ("conductor", "dielectric", "mitsim_glass", "plastic", "thindielectric")
"""Materials that reflect or refract into single directions."""
_TURNING, _ALONG = (*BUMPS, "hair", "mitsim_grating"), ("alpha_u", "alpha_v", "anisotropic")
"""Materials that vary along the surface, and parameters that cause this."""
SMALL_LAMPS = ("directional", "point", "spot")
"""Lamps that no path can hit."""
_VOLUMETRIC = ("volpath", "volpathmis")


@dataclass(frozen=True)
class Unfit:
    """Refusals of a scene by each estimator, and light that is lost in a scene that is accepted; None for neither.

    ``caustics`` is lost by the reference: light from lamps that no path can hit, over mirrors or glass. ``lamps`` is
    the same for the factored estimator, and ``instances`` its light over mirrors or glass inside instances.
    """

    factored: MitsimError | None = None
    reference: MitsimError | None = None
    caustics: str | None = None
    lamps: str | None = None
    instances: str | None = None


def find_unfit(outline: Outline, nodes: Sequence[mi.parser.SceneNode]) -> Unfit:
    """Return the refusals of a checked tree by each estimator, and the light that is lost."""

    def below(node: mi.parser.SceneNode) -> Iterator[mi.parser.SceneNode]:
        for child in (nodes[index] for index in references(node.props)):
            yield child
            yield from below(child)

    def plugin(node: mi.parser.SceneNode) -> str:
        return str(node.props.plugin_name())

    # All references to an object. The scene, and materials without a shape, are ignored because they only list.
    materials = PLUGINS["bsdf"].split()
    users = [node for node in nodes[1:] if plugin(node) not in materials]
    used = [inner for node in users for inner in below(node) if plugin(inner) in materials]
    links = [
        (node, name, nodes[node.props[name].index()]) for node in (*users, *used) for name in references_of(node.props)
    ]

    def first(plugins: Sequence[str]) -> tuple[mi.parser.SceneNode, str, mi.parser.SceneNode] | None:
        return next((link for link in links if plugin(link[2]) in plugins), None)

    factored: MitsimError | None = None
    reference: MitsimError | None = None
    # ---- The factored estimator cannot render pictures that blend texels, sheets that multiply light, and media
    for node in nodes:
        if plugin(node) == "projector" and "irradiance" in references_of(node.props):
            picture = nodes[node.props["irradiance"].index()]
            kind = picture.props.get("filter_type", "bilinear")  # Mitsuba's default
            if plugin(picture) == "bitmap" and kind != "nearest" and factored is None:
                why = "the projector's pixels would run into each other, where patterns need them even; give its bitmap"
                nearest = '<string name="filter_type" value="nearest"/>'
                rule = f"{why} {nearest}, and blur_pixels of the projector's TOML file for a blur"
                factored = outline.tag(picture, "filter_type").refusal("filter_type", repr(kind), rule)
    for *_, sheet in links:
        # A number, or a texture of unknown values.
        if plugin(sheet) == "principledthin" and sheet.props.get("spec_trans", 0.0) != 0.0 and factored is None:
            why = "its sharp transmission is defined for light from the camera alone, so only the reference renders it"
            rule = f"{why}; remove it, or use diff_trans, a thindielectric or render's reference"
            factored = outline.tag(sheet, "spec_trans").refusal("spec_trans", "a transmission", rule)
    medium = first(PLUGINS["medium"].split())
    if medium is not None:
        rule = "only the reference estimator follows light through media; remove it, or render by it with volpath"
        factored = outline.tag(medium[0]).refusal(medium[1], "a medium", rule)
    # ---- The scene's integrator, the reference, loses light
    integrator = next((node for node in nodes if plugin(node) in PLUGINS["integrator"].split()), None)
    kind = "path" if integrator is None else plugin(integrator)  # Mitsuba's own default
    cause = medium or first(STRAIGHT)
    if kind == "ptracer":
        rule = "it starts paths at lamps alone, and mitsim_lensless needs those of the camera; use path or volpath"
        reference = outline.tag(integrator).refusal("integrator", repr(kind), rule)
    elif cause is not None and kind not in _VOLUMETRIC:
        place = outline.tag(cause[0])
        rule = f"it loses light at {place.path.name}:{place.line} ({plugin(cause[2])}); use volpath"
        reference = outline.tag(integrator or nodes[0]).refusal("integrator", repr(kind), rule)
    # ---- Materials under bumps, which Mitsuba treats as opaque or turns about the normal
    for bumps in (child for *_, child in links if plugin(child) in BUMPS):
        for inner in (each for each in below(bumps) if plugin(each) in materials):
            if plugin(inner) in STRAIGHT:
                why = (
                    f"inside of a {plugin(bumps)} Mitsuba takes it for opaque wherever it connects a surface to a light"
                )
                remedy = "turn them round: the mask, or other material that light passes, outermost"
                rule = f"{why}, so that is missing; {remedy}"
            elif plugin(bumps) == "bumpmap" and (
                plugin(inner) in _TURNING or any(each in inner.props for each in _ALONG)
            ):
                why = "inside of a bumpmap Mitsuba mixes up the axes along the surface, so it would be turned about its"
                remedy = "give one bumpmap, a normalmap outermost, or a material that is alike in all directions"
                rule = f"{why} normal; {remedy}"
            else:
                continue
            refusal = outline.tag(inner).refusal("bsdf", repr(plugin(inner)), rule)
            factored, reference = factored or refusal, reference or refusal
    # ---- Light that is lost over mirrors
    mirror, lost = first(MIRRORS), list[str | None]()
    for lights, estimator in ((("projector", *SMALL_LAMPS), "the reference"), (SMALL_LAMPS, "the factored estimator")):
        light = next((node for node in nodes if plugin(node) in lights), None)
        if mirror is None or light is None:
            lost.append(None)
            continue
        place = outline.tag(mirror[0])
        brought = (
            f"that {place.path.name}:{place.line} ({plugin(mirror[2])}) brings to other surfaces, so that is missing"
        )
        remedy = "use a light that has a surface (area; mitsim_projector for the reference)"
        rule = f"{estimator} finds no light of it {brought}; {remedy}"
        lost.append(str(outline.tag(light).refusal("light", repr(plugin(light)), rule)))
    groups = (node for node in nodes if plugin(node) == "shapegroup")
    hidden = next((inner for node in groups for inner in below(node) if plugin(inner) in MIRRORS), None)
    instances = None
    if hidden is not None:
        why = "inside of an instance glass is no pane and a mirror casts no glint"
        rule = f"{why}: light that it brings from the projector is missing; place the shape itself"
        instances = str(outline.tag(hidden).refusal("bsdf", repr(plugin(hidden)), rule))
    return Unfit(factored, reference, lost[0], lost[1], instances)
