"""Limits of a scene: finite numbers of sensible size, reflectances up to 1, allowed plugins, and unfit estimators."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.errors import MitsimError, cut, near_name
from mitsim.devices.camera import PIXELS
from mitsim.scene.headers import FARTHEST
from mitsim.scene.outline import Tag

if TYPE_CHECKING:
    from mitsim.scene.outline import Outline

_LARGEST = 1e20
"""Largest number: its square is far from the end of single precision (3.4e38)."""
_RIGID = 1e-4
_SMALLEST_SIZE = 1e-9
"""Smallest scale of a transform [mm]: below any wavelength, and 1 / its cube is still finite."""
_MOST_UNEVEN = 1e7


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


def check_transform(tag: Tag, name: str, matrix: npt.NDArray[np.float64], rigid: bool) -> None:
    """Raise MitsimError if a (4, 4) ``matrix`` cannot be inverted, or is not ``rigid``."""
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
_LACKED = {
    "blackbody": _SPECTRAL_ALONE,
    "irregular": f'{_SPECTRAL_ALONE}, or write the table as value="400:0.2, 700:0.5"',
    "regular": f'{_SPECTRAL_ALONE}, or write the table as value="400:0.2, 700:0.5"',
    "specfilm": "only spectral variants have it; use hdrfilm",
}
"""Plugins of Mitsuba 3.9.1 that variants without wavelengths lack, and the remedy."""


def references(props: mi.Properties) -> list[int]:
    resolved = mi.Properties.Type.ResolvedReference
    return [props[name].index() for name in props.keys() if props.type(name) == resolved]  # noqa: SIM118 - no dict


def check_plugin(tag: Tag, plugin: str) -> None:
    allowed = PLUGINS.get(tag.name, "scene").split()
    if plugin not in allowed or (tag.name == "scene" and "version" not in tag.attributes):
        raise tag.refusal(
            "type", repr(plugin), f"{near_name(cut(plugin), allowed)}allowed are {', '.join(sorted(allowed))}"
        )


def check_variant(tag: Tag, plugin: str, given: Container[str], variant: str) -> None:
    backend, _, kind = variant.rpartition("_")
    if plugin in _LACKED and kind != "spectral":
        rule = f"{variant} lacks it: {_LACKED[plugin].format(spectral=f'{backend}_spectral')}"
        raise tag.refusal("type", repr(plugin), rule)
    if plugin == "hair" and kind == "mono" and "sigma_a" not in given:
        rule = f"{variant} has no colours for its pigments; give sigma_a in their place, or use --variant {backend}_rgb"
        raise tag.refusal("type", repr(plugin), rule)


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

    @classmethod
    def of(cls, outline: Outline, nodes: Sequence[mi.parser.SceneNode]) -> Unfit:
        tree = _References(nodes)
        medium = next(tree.to(PLUGINS["medium"].split()), None)
        factored = _unfit_for_factored(outline, tree)
        if medium is not None:
            rule = "only the reference estimator follows light through media; remove it, or render by it with volpath"
            factored = outline.tag(medium[0]).refusal(medium[1], "a medium", rule)
        opaque = _under_bumps(outline, tree)
        return cls(
            factored or opaque,
            _lost_by_integrator(outline, tree, medium or next(tree.to(STRAIGHT), None)) or opaque,
            _caustics(outline, tree, ("projector", *SMALL_LAMPS), "the reference"),
            _caustics(outline, tree, SMALL_LAMPS, "the factored estimator"),
            _in_instances(outline, tree),
        )


def _caustics(outline: Outline, tree: _References, lights: Sequence[str], estimator: str) -> str | None:
    mirror = next(tree.to(MIRRORS), None)
    light = next((node for node in tree.nodes if node.props.plugin_name() in lights), None)
    if mirror is None or light is None:
        return None
    place, what = outline.tag(mirror[0]), tree.plugin(*mirror)
    brought = f"that {place.path.name}:{place.line} ({what}) brings to other surfaces, so that is missing"
    remedy = "use a light that has a surface (area; mitsim_projector for the reference)"
    rule = f"{estimator} finds no light of it {brought}; {remedy}"
    return str(outline.tag(light).refusal("light", repr(str(light.props.plugin_name())), rule))


def _unfit_for_factored(outline: Outline, tree: _References) -> MitsimError | None:
    """Return the refusal of a projector whose picture blends texels, or of a sheet that multiplies light."""
    for node in tree.nodes:
        picture = tree.child(node, "irradiance") if node.props.plugin_name() == "projector" else None
        if picture is None or picture.props.plugin_name() != "bitmap":
            continue
        kind = picture.props.get("filter_type", "bilinear")  # Mitsuba's default
        if kind != "nearest":
            why = "the projector's pixels would run into each other, where patterns need them even; give its bitmap"
            nearest = '<string name="filter_type" value="nearest"/>'
            rule = f"{why} {nearest}, and blur_pixels of the projector's TOML file for a blur"
            return outline.tag(picture, "filter_type").refusal("filter_type", repr(kind), rule)
    for node, name in tree.to(("principledthin",)):
        thin = tree.nodes[node.props[name].index()]
        if thin.props.get("spec_trans", 0.0) != 0.0:  # a number, or a texture of unknown values
            why = "its sharp transmission is defined for light from the camera alone, so only the reference renders it"
            rule = f"{why}; remove it, or use diff_trans, a thindielectric or render's reference"
            return outline.tag(thin, "spec_trans").refusal("spec_trans", "a transmission", rule)
    return None


def _in_instances(outline: Outline, tree: _References) -> str | None:
    groups = (node for node in tree.nodes if node.props.plugin_name() == "shapegroup")
    mirror = next((mirror for node in groups for mirror in tree.below(node, MIRRORS)), None)
    if mirror is None:
        return None
    why = "inside of an instance glass is no pane and a mirror casts no glint: light that it brings from the projector"
    rule = f"{why} is missing; place the shape itself"
    return str(outline.tag(mirror).refusal("bsdf", repr(str(mirror.props.plugin_name())), rule))


def _under_bumps(outline: Outline, tree: _References) -> MitsimError | None:
    """Return the refusal of a material under bumps that Mitsuba treats as opaque or turns about the normal."""
    for node, name in tree.to(BUMPS):
        bumps = tree.nodes[node.props[name].index()]
        what = str(bumps.props.plugin_name())
        for inner in tree.below(bumps, PLUGINS["bsdf"].split()):
            plugin = str(inner.props.plugin_name())
            if plugin in STRAIGHT:
                why = f"inside of a {what} Mitsuba takes it for opaque wherever it connects a surface to a light"
                remedy = "turn them round: the mask, or other material that light passes, outermost"
                rule = f"{why}, so that is missing; {remedy}"
            elif what == "bumpmap" and (plugin in _TURNING or any(each in inner.props for each in _ALONG)):
                why = "inside of a bumpmap Mitsuba mixes up the axes along the surface, so it would be turned about its"
                remedy = "give one bumpmap, a normalmap outermost, or a material that is alike in all directions"
                rule = f"{why} normal; {remedy}"
            else:
                continue
            return outline.tag(inner).refusal("bsdf", repr(plugin), rule)
    return None


def _lost_by_integrator(outline: Outline, tree: _References, cause: _Found | None) -> MitsimError | None:
    found = (node for node in tree.nodes if node.props.plugin_name() in PLUGINS["integrator"].split())
    integrator = next(found, None)
    plugin = integrator.props.plugin_name() if integrator is not None else "path"  # Mitsuba's own default
    if integrator is not None and plugin == "ptracer":
        rule = "it starts paths at lamps alone, and mitsim_lensless needs those of the camera; use path or volpath"
        return outline.tag(integrator).refusal("integrator", repr(plugin), rule)
    if cause is None or plugin in _VOLUMETRIC:
        return None
    place, what = outline.tag(cause[0]), tree.plugin(*cause)
    rule = f"it loses light at {place.path.name}:{place.line} ({what}); use volpath"
    return outline.tag(integrator or tree.nodes[0]).refusal("integrator", repr(plugin), rule)


_Found = tuple[mi.parser.SceneNode, str]


@dataclass(frozen=True)
class _References:
    nodes: Sequence[mi.parser.SceneNode]

    def to(self, plugins: Sequence[str]) -> Iterator[_Found]:
        """Yield nodes, and names of their properties, that refer to one of the ``plugins``.

        The scene and materials without a shape are ignored because they only list.
        """
        materials = PLUGINS["bsdf"].split()
        users = [node for node in self.nodes[1:] if node.props.plugin_name() not in materials]
        used = (other for node in users for other in self.below(node, materials))
        for node in chain(users, used):
            for name in node.props.keys():  # noqa: SIM118 - Properties is no dict
                if self.plugin(node, name) in plugins:
                    yield node, name

    def below(self, node: mi.parser.SceneNode, plugins: Sequence[str]) -> Iterator[mi.parser.SceneNode]:
        for other in (self.nodes[index] for index in references(node.props)):
            if other.props.plugin_name() in plugins:
                yield other
            yield from self.below(other, plugins)

    def child(self, node: mi.parser.SceneNode, name: str) -> mi.parser.SceneNode | None:
        if name not in node.props or node.props.type(name) != mi.Properties.Type.ResolvedReference:
            return None
        return self.nodes[node.props[name].index()]

    def plugin(self, node: mi.parser.SceneNode, name: str) -> str:
        child = self.child(node, name)
        return "" if child is None else str(child.props.plugin_name())
