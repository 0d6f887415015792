"""Checks of a scene file before Mitsuba makes objects of it.

Making objects can run native code and read any file, and Mitsuba accepts NaN, negative light or a reflectance of 2.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi
import numpy as np
import pydantic

from mitsim.core.configuration import limits_of
from mitsim.core.errors import MitsimError, cut, near_name
from mitsim.devices.camera import PIXELS, CameraGeometry
from mitsim.scene.headers import FARTHEST, MOST_TEXELS, check_image, check_obj, check_ply, read_ies, read_measured
from mitsim.scene.outline import DEEPEST, MOST_ELEMENTS, Outline, Tag

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
    tag: names.split()
    for tag, names in {
        "bsdf": "blendbsdf bumpmap circular conductor dielectric diffuse hair mask measured mitsim_glass "
        "mitsim_grating normalmap null plastic polarizer pplastic principled principledthin retarder "
        "roughconductor roughdielectric roughplastic thindielectric twosided",
        "emitter": "area constant directional envmap mitsim_ies mitsim_projector point projector spot",
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
    }.items()
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


def nodes_below(nodes: Sequence[mi.parser.SceneNode], node: mi.parser.SceneNode) -> Iterator[mi.parser.SceneNode]:
    for child in (nodes[index] for index in references(node.props)):
        yield child
        yield from nodes_below(nodes, child)


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
DIRECTED = (*BUMPS, "hair", "measured", "principledthin")
"""Materials that are not reciprocal."""
CHOICES = ("blendbsdf", "mask", "twosided")
"""Materials that choose between two others."""
MIRRORS = ("conductor", "dielectric", "mitsim_glass", "plastic", "thindielectric")
"""Materials that reflect or refract into single directions."""
_TURNING, _ALONG = (*BUMPS, "hair", "measured", "mitsim_grating"), ("alpha_u", "alpha_v", "anisotropic")
"""Materials that vary along the surface, and parameters that cause this."""
SMALL_LAMPS = ("directional", "mitsim_ies", "point", "spot")
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

    def plugin(node: mi.parser.SceneNode) -> str:
        return str(node.props.plugin_name())

    # All references to an object. The scene, and materials without a shape, are ignored because they only list.
    materials = PLUGINS["bsdf"]
    users = [node for node in nodes[1:] if plugin(node) not in materials]
    used = [inner for node in users for inner in nodes_below(nodes, node) if plugin(inner) in materials]
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
    medium = first(PLUGINS["medium"])
    if medium is not None:
        rule = "only the reference estimator follows light through media; remove it, or render by it with volpath"
        factored = outline.tag(medium[0]).refusal(medium[1], "a medium", rule)
    # ---- The scene's integrator, the reference, loses light
    integrator = next((node for node in nodes if plugin(node) in PLUGINS["integrator"]), None)
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
        for inner in (each for each in nodes_below(nodes, bumps) if plugin(each) in materials):
            if plugin(inner) in STRAIGHT:
                why = f"inside of a {plugin(bumps)} Mitsuba takes it for opaque where it connects a surface to a light"
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
        mirrors = f"{place.path.name}:{place.line} ({plugin(mirror[2])})"
        brought = f"that {mirrors} brings to other surfaces, so that is missing"
        remedy = "use a light that has a surface (area; mitsim_projector for the reference)"
        rule = f"{estimator} finds no light of it {brought}; {remedy}"
        lost.append(str(outline.tag(light).refusal("light", repr(plugin(light)), rule)))
    groups = (node for node in nodes if plugin(node) == "shapegroup")
    hidden = next((inner for node in groups for inner in nodes_below(nodes, node) if plugin(inner) in MIRRORS), None)
    instances = None
    if hidden is not None:
        why = "inside of an instance glass is no pane and a mirror casts no glint"
        rule = f"{why}: light that it brings from the projector is missing; place the shape itself"
        instances = str(outline.tag(hidden).refusal("bsdf", repr(plugin(hidden)), rule))
    return Unfit(factored, reference, lost[0], lost[1], instances)


# -------- Checks of a scene file

_IMAGES = ("bitmap", "envmap")
_READERS = (*_IMAGES, "measured", "mitsim_ies", "ply", "obj")
_LARGEST_MATERIAL = 256
"""Largest number of objects of one BSDF, because all are compiled into every kernel."""
_COLOURED = ("blackbody", "d65", "irregular", "mesh_attribute", "mitsim_glass", "mitsim_grating", "regular")
_PARTING = "mitsim_glass"
"""Material with a dispersive index."""
_ON_SHAPES = ("area", "mitsim_projector")
"""Emitters that are the surface of a shape."""
_RIGID = ("mitsim_ies", "mitsim_lensless", "mitsim_projector", "projector")
"""Plugins that may only be rotated and moved."""
_METALS = ("conductor", "roughconductor")
"""Materials that may be coloured metals."""
_PLACES = {
    "to_world": (("Transform",), "a <transform>"),
    **dict.fromkeys(("center", "p0", "p1", "position"), (("Vector",), "a <point>")),
    **dict.fromkeys(("radius", "scene_distance"), (("Float", "Integer"), "a <float>")),
    **dict.fromkeys(("face_normals", "flip_normals"), (("Bool",), "a <boolean>")),
}
PREPARED = PICTURE, _ = "picture", "object"
_RIGID_ERROR = 1e-4
_SMALLEST_SIZE = 1e-9
"""Smallest scale of a transform [mm]: below any wavelength, and 1 / its cube is still finite."""
_MOST_UNEVEN = 1e7
_Type = mi.Properties.Type


@dataclass(eq=False)
class CheckedScene:
    """A scene of which Mitsuba may make objects, its ``files`` (the scene first), and allowed ranges by name.

    ``nodes`` are copies of the tree's, because Mitsuba marks a property that is read. ``coloured`` (may depend on
    wavelength) and ``parting`` (dispersive glass) are tags in order. ``normals`` has, for each mesh file, whether its
    vertices have normals. ``unread`` are names of materials that meshes refer to. ``unfit`` has the estimators that
    must refuse the scene.
    """

    outline: Outline
    config: mi.parser.ParserConfig
    state: mi.parser.ParserState
    nodes: list[mi.parser.SceneNode]
    unfit: Unfit
    limits: dict[str, Range] = field(default_factory=lambda: dict(LIMITS))
    texels: int = 0
    coloured: list[Tag] = field(default_factory=list)
    parting: list[Tag] = field(default_factory=list)
    samples: int | None = None
    normals: dict[str, set[bool]] = field(default_factory=dict)
    unread: dict[str, str] = field(default_factory=dict)

    def tags_of(self, plugins: Container[str]) -> list[Tag]:
        """Return the tags of the scene's own children of some plugins, in order."""
        children = (self.nodes[index] for index in references(self.nodes[0].props))
        return [self.outline.tag(child) for child in children if child.props.plugin_name() in plugins]

    @property
    def own(self) -> dict[str, str]:
        """Return the parameters by which a user names files, by the path of the file."""
        return {str(path): name for path, name in self.outline.own.items() if name in PREPARED}

    @property
    def files(self) -> tuple[Path, ...]:
        return tuple(self.outline.used)


def check_file(
    path: Path, defines: Mapping[str, str], outside: bool = False, variant: str | None = None
) -> CheckedScene:
    """Read and check a scene, with ``defines`` instead of the values of ``<default>``.

    Files have to be in the scene's folder unless ``outside``. Objects will be made in ``variant`` (None: any).

    Raises
    ------
    MitsimError
        ``file:line: name: got VALUE in <tag ...>; what is allowed``, or without a line if none is at fault.
    """
    outline = Outline(path, defines, outside)
    config = mi.parser.ParserConfig("scalar_rgb")  # any: parsing does not look at it
    # Optimisation is off because it merges rectangles of one material into a mesh without their boxes and names.
    config.parallel = config.merge_equivalent = config.merge_meshes = False
    with looking_beside(outline):
        state = mi.parser.parse_file(config, str(path), **outline.defines)
        mi.parser.transform_all(config, state)
    nodes = [mi.parser.SceneNode(node) for node in state.nodes]
    checked = CheckedScene(outline, config, state, nodes, Unfit())
    for node in nodes:
        _check_node(checked, node, variant)
    for tag in checked.tags_of(_ON_SHAPES):
        raise tag.refusal("emitter", repr(tag.attributes.get("type")), "it is the light of a shape; put it into one")
    _check_sizes(checked)
    checked.unfit = find_unfit(outline, nodes)
    return checked


@contextmanager
def looking_beside(outline: Outline) -> Iterator[None]:
    before = mi.file_resolver()
    beside = mi.FileResolver(before)
    beside.prepend(mi.filesystem.path(str(outline.path.parent)))
    mi.set_file_resolver(beside)
    try:
        yield
    except (RuntimeError, ValueError, TypeError, KeyError) as error:
        raise outline.refusal(error) from None
    finally:
        mi.set_file_resolver(before)


def _check_node(checked: CheckedScene, node: mi.parser.SceneNode, variant: str | None) -> None:
    tag, plugin, props = checked.outline.tag(node), node.props.plugin_name(), node.props
    allowed = PLUGINS.get(tag.name, ["scene"])
    if plugin not in allowed or (tag.name == "scene" and "version" not in tag.attributes):
        rule = f"{near_name(cut(plugin), allowed)}allowed are {', '.join(sorted(allowed))}"
        raise tag.refusal("type", repr(plugin), rule)
    backend, _, kind = (variant or "").rpartition("_")
    if variant and plugin in LACKED and kind != "spectral":
        rule = f"{variant} lacks it: {LACKED[plugin].format(spectral=f'{backend}_spectral')}"
        raise tag.refusal("type", repr(plugin), rule)
    if plugin == "hair" and kind == "mono" and "sigma_a" not in props:
        rule = f"{variant} has no colours for its pigments; give sigma_a in their place, or use --variant {backend}_rgb"
        raise tag.refusal("type", repr(plugin), rule)
    # A metal is copper unless it states another material, or an index.
    plain = _text(node, "material") == "none" or ("material" not in props and "eta" in props)
    if plugin in _COLOURED or (plugin in _METALS and not plain):
        checked.coloured.append(tag)
    if plugin == _PARTING:
        checked.parting.append(tag)
    for name in props.keys():  # noqa: SIM118 - Properties is no dict
        _check_property(checked, node, name)
    if plugin in _READERS:
        _check_resource(checked, node)
    if plugin == "mitsim_lensless":
        _check_camera(checked, node)


def _check_property(checked: CheckedScene, node: mi.parser.SceneNode, name: str) -> None:
    outline, nodes = checked.outline, checked.nodes
    tag, kind, plugin = outline.tag(node, name), node.props.type(name), node.props.plugin_name()
    kinds, given_by = _PLACES.get(name, ((kind.name,), ""))
    if kind.name not in kinds:
        got = "an object" if kind == _Type.ResolvedReference else f"a {kind.name.lower()}"
        raise tag.refusal(name, got, f"it is given by {given_by}")
    if kind == _Type.Transform:
        # Invertible, with sizes of which 1 / the cube is finite; cameras and projectors are moved and turned only.
        matrix = np.array(_words(node, name), dtype=np.float64).reshape(4, 4)
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
        if name == "to_world" and plugin in _RIGID and not (error < _RIGID_ERROR and np.linalg.det(turn) > 0):
            raise tag.refusal(
                name, f"R^T R {error:.2g} from 1", "a camera, projector or profile is moved and turned only"
            )
    elif kind == _Type.ResolvedReference:
        inner = nodes[node.props[name].index()]
        within = inner.props.plugin_name()
        shape, emitter = (PLUGINS[kind] for kind in ("shape", "emitter"))
        if plugin in shape and within in emitter and within not in _ON_SHAPES:
            rule = f"a shape holds {' or '.join(_ON_SHAPES)} only; put other lamps beside the shapes"
            raise outline.tag(inner).refusal("type", repr(within), rule)
        if name in LIMITS:
            _check_texture(checked, inner, name, LIMITS[name])
        if plugin == "projector" and name == "irradiance" and "to_uv" in inner.props:
            rule = "the projector's window is found in the bitmap as it is; remove it, and turn the projector"
            raise outline.tag(inner, "to_uv").refusal("to_uv", "a transform", rule)
    elif kind == _Type.String and name not in ("values", "wavelengths"):
        text = node.props[name]
        if name == "filename" and plugin not in _READERS:
            raise tag.refusal(name, repr(text), f"only {', '.join(_READERS)} read a file")
        if name == "material" and not re.fullmatch(r"[A-Za-z0-9_-]+", text):
            raise tag.refusal(name, repr(text), "give the name of a material, as Au")
        if name not in ("filename", "material") and ("/" in text or ".." in text):
            raise tag.refusal(name, repr(text), "only filename may hold a path")
    elif name == "hide_emitters" and node.props[name]:
        raise tag.refusal(name, "true", "the reference alone would leave out lamps that the sensor sees; remove it")
    elif kind != _Type.Bool:
        table = outline.tag(node).name in ("texture", "spectrum") and name in TABLES
        light = table or kind in (_Type.Color, _Type.Spectrum, _Type.String)
        other = {_Type.Vector: COORDINATE, _Type.Integer: WHOLE}.get(kind, ANY)
        numbers = _numbers(checked, node, name)
        LIMITS.get(name, LIGHT if light else other).check(tag, name, numbers)
        if kind in (_Type.Color, _Type.Spectrum) and len(set(numbers)) > 1:
            checked.coloured.append(tag)


def _check_texture(checked: CheckedScene, node: mi.parser.SceneNode, name: str, limit: Range) -> None:
    plugin, outline = node.props.plugin_name(), checked.outline
    if plugin in ("blackbody", "d65") and limit.high <= 1:
        raise outline.tag(node).refusal("type", repr(plugin), f"{name} is no light; give another texture")
    own = {"mesh_attribute": "name", "bitmap": "filename"}.get(plugin, "")
    for meant in filter(None, (name, Path(_text(node, own) or "").name)):
        checked.limits[meant] = min(checked.limits.get(meant, limit), limit, key=lambda one: one.high)
    for key in TABLES:
        if key in node.props and node.props.type(key) == _Type.ResolvedReference:
            _check_texture(checked, checked.nodes[node.props[key].index()], key, limit)
        elif key in node.props:
            limit.check(outline.tag(node, key), name, _numbers(checked, node, key))


def _check_resource(checked: CheckedScene, node: mi.parser.SceneNode) -> None:
    plugin, tag = node.props.plugin_name(), checked.outline.tag(node, "filename")
    name = _text(node, "filename")
    if name is None:
        got = "no text" if "filename" in node.props else "nothing"
        raise tag.refusal("filename", got, f"a {plugin} reads one file")
    path = checked.outline.find(tag, name)
    if str(path) in checked.own:
        return  # mitsim reads it itself, and makes a file of it that is as Mitsuba needs it
    try:
        if plugin in _IMAGES:
            texels, grey = check_image(path)
            checked.texels += texels
            if not grey:
                checked.coloured.append(tag)
        elif plugin == "measured":
            read_measured(path)
            checked.coloured.append(tag)
        elif plugin == "mitsim_ies":
            read_ies(path)
        else:
            given, checked.unread[str(path)] = (check_ply if plugin == "ply" else check_obj)(path)
            checked.normals.setdefault(Path(name).name, set()).add(given)
            lamp = any(checked.nodes[at].props.plugin_name() == "area" for at in references(node.props))
            if lamp and given and not node.props.get("face_normals", False):
                rule = "a lamp emits by its faces, whose winding says which side; give it face_normals true"
                raise tag.refusal("normals", "vertex normals of a lamp", rule)
    except (ValueError, OSError) as error:
        raise tag.refusal("filename", repr(name), f"the file {error}") from None
    if checked.texels > MOST_TEXELS:
        raise tag.refusal("texels", checked.texels, f"all bitmaps together may have {MOST_TEXELS}")


def _check_camera(checked: CheckedScene, node: mi.parser.SceneNode) -> None:
    for below in references(node.props):
        props = checked.nodes[below].props
        if props.plugin_name() in PLUGINS["sampler"] and "sample_count" in props:
            checked.samples = int(props["sample_count"])
    values = {name: node.props[name] for name in CameraGeometry.model_fields if name in node.props}
    try:
        CameraGeometry(**values)
    except pydantic.ValidationError as error:
        found = []
        for problem in error.errors(include_url=False):
            name = str((*problem["loc"], "mask_distance")[0])
            got = values.get(name, "its default")
            shown = repr(got) if isinstance(got, str) else f"{got:g}"
            ranged = problem["type"].startswith(("greater", "less"))
            rule = problem["msg"].removeprefix("Value error, ")
            rule = f"give a number {limits_of(CameraGeometry.model_fields[name])}" if ranged else rule
            found.append(checked.outline.tag(node, name).refusal(name, shown, rule))
        if len(found) == 1:
            raise found[0] from None
        head = f"{checked.outline.path}: the camera has {len(found)} mistakes:"
        raise MitsimError(head, *map(str, found)) from None


def _check_sizes(checked: CheckedScene) -> None:
    known: dict[int, tuple[int, int]] = {}

    def unfold(index: int, depth: int) -> tuple[int, int]:
        node = checked.nodes[index]
        if index not in known and depth <= DEEPEST:
            parts = [unfold(below, depth + 1) for below in references(node.props)]
            sides = 2 if node.props.plugin_name() == "twosided" else 1  # each side is a copy
            deepest = max((levels for levels, _ in parts), default=0)
            known[index] = 1 + deepest, 1 + sides * sum(size for _, size in parts)
        levels, size = known.get(index, (DEEPEST + 1, 1))
        tag = checked.outline.tag(node)
        most = _LARGEST_MATERIAL if tag.name == "bsdf" else MOST_ELEMENTS
        if levels > DEEPEST or size > most:
            got = f"{levels} levels of {size} objects with references followed"
            raise tag.refusal("nesting", got, f"{DEEPEST} levels and {most} objects are allowed")
        return levels, size

    unfold(0, 0)


def _numbers(checked: CheckedScene, node: mi.parser.SceneNode, name: str) -> list[float]:
    if node.props.type(name) != _Type.Spectrum:
        try:
            return [float(word) for word in _words(node, name)]
        except ValueError:
            raise checked.outline.tag(node, name).refusal(name, repr(node.props[name]), "give numbers") from None
    spectrum = node.props[name]
    WAVELENGTH.check(checked.outline.tag(node, name), name, spectrum.wavelengths)
    return list(spectrum.values)


def _text(node: mi.parser.SceneNode, name: str) -> str | None:
    return node.props[name] if name in node.props and node.props.type(name) == _Type.String else None


def _words(node: mi.parser.SceneNode, name: str) -> list[str]:
    return re.findall(r"[^\s,\[\]\"]+", node.props.as_string(name))
