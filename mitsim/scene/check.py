"""Checks of a scene file before Mitsuba makes objects of it.

Making objects can run native code and read any file, and Mitsuba accepts NaN, negative light or a reflectance of 2.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi
import numpy as np
import pydantic

from mitsim.core.configuration import limits_of
from mitsim.core.errors import MitsimError, cut, near_name
from mitsim.devices.camera import CameraGeometry
from mitsim.scene import limits
from mitsim.scene.headers import FARTHEST, MOST_TEXELS, check_image, check_obj, check_ply
from mitsim.scene.limits import PLUGINS, Range, Unfit, find_unfit, references
from mitsim.scene.outline import DEEPEST, MOST_ELEMENTS, Outline, SceneFiles, Tag

_IMAGES = ("bitmap", "envmap")
_READERS = (*_IMAGES, "ply", "obj")
_LARGEST_MATERIAL = 256
"""Largest number of objects of one BSDF, because all are compiled into every kernel."""
_COLOURED = ("blackbody", "d65", "irregular", "mesh_attribute", "mitsim_glass", "mitsim_grating", "regular")
_PARTING = "mitsim_glass"
"""Material with a dispersive index."""
_ON_SHAPES = ("area", "mitsim_projector")
"""Emitters that are the surface of a shape."""
_RIGID = ("mitsim_lensless", "mitsim_projector", "projector")
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
    scene_files: SceneFiles
    nodes: list[mi.parser.SceneNode]
    unfit: Unfit
    limits: dict[str, Range] = field(default_factory=lambda: dict(limits.LIMITS))
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
        return {str(path): name for path, name in self.scene_files.own.items() if name in PREPARED}

    @property
    def files(self) -> tuple[Path, ...]:
        return tuple(self.scene_files.used)


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
    files = SceneFiles(path, outside)
    outline = Outline(path, defines, files)
    config = mi.parser.ParserConfig("scalar_rgb")  # any: parsing does not look at it
    # Optimisation is off because it merges rectangles of one material into a mesh without their boxes and names.
    config.parallel = config.merge_equivalent = config.merge_meshes = False
    with looking_beside(outline):
        state = mi.parser.parse_file(config, str(path), **outline.defines)
        mi.parser.transform_all(config, state)
    nodes = [mi.parser.SceneNode(node) for node in state.nodes]
    checked = CheckedScene(outline, config, state, files, nodes, Unfit())
    for node in nodes:
        _check_node(checked, node, variant)
    for tag in checked.tags_of(_ON_SHAPES):
        problem = "it is the light of a shape"
        raise tag.refusal("emitter", repr(tag.attributes.get("type")), f"{problem}; put it into one")
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
    allowed = PLUGINS.get(tag.name, "scene").split()
    if plugin not in allowed or (tag.name == "scene" and "version" not in tag.attributes):
        rule = f"{near_name(cut(plugin), allowed)}allowed are {', '.join(sorted(allowed))}"
        raise tag.refusal("type", repr(plugin), rule)
    backend, _, kind = (variant or "").rpartition("_")
    if variant and plugin in limits.LACKED and kind != "spectral":
        rule = f"{variant} lacks it: {limits.LACKED[plugin].format(spectral=f'{backend}_spectral')}"
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
            rule = "a camera or projector is moved and turned only: no scaling, no mirroring"
            raise tag.refusal(name, f"R^T R {error:.2g} from 1", rule)
    elif kind == _Type.ResolvedReference:
        inner = nodes[node.props[name].index()]
        within = inner.props.plugin_name()
        shape, emitter = (PLUGINS[kind].split() for kind in ("shape", "emitter"))
        if plugin in shape and within in emitter and within not in _ON_SHAPES:
            rule = f"a shape holds {' or '.join(_ON_SHAPES)} only; put other lamps beside the shapes"
            raise outline.tag(inner).refusal("type", repr(within), rule)
        if name in limits.LIMITS:
            _check_texture(checked, inner, name, limits.LIMITS[name])
        if plugin == "projector" and name == "irradiance" and "to_uv" in inner.props:
            rule = "the projector's window is found in the bitmap as it is; remove it, and turn the projector"
            raise outline.tag(inner, "to_uv").refusal("to_uv", "a transform", rule)
    elif kind == _Type.String and name not in ("values", "wavelengths"):
        text = node.props[name]
        if name == "filename" and plugin not in _READERS:
            raise tag.refusal(name, repr(text), "only bitmap, envmap, ply and obj read a file")
        if name == "material" and not re.fullmatch(r"[A-Za-z0-9_-]+", text):
            raise tag.refusal(name, repr(text), "give the name of a material, as Au")
        if name not in ("filename", "material") and ("/" in text or ".." in text):
            raise tag.refusal(name, repr(text), "only filename may hold a path")
    elif name == "hide_emitters" and node.props[name]:
        rule = "the reference alone would leave out lamps that the sensor sees; remove it, or those lamps"
        raise tag.refusal(name, "true", rule)
    elif kind != _Type.Bool:
        table = outline.tag(node).name in ("texture", "spectrum") and name in limits.TABLES
        light = table or kind in (_Type.Color, _Type.Spectrum, _Type.String)
        other = {_Type.Vector: limits.COORDINATE, _Type.Integer: limits.WHOLE}.get(kind, limits.ANY)
        numbers = _numbers(checked, node, name)
        limits.LIMITS.get(name, limits.LIGHT if light else other).check(tag, name, numbers)
        if kind in (_Type.Color, _Type.Spectrum) and len(set(numbers)) > 1:
            checked.coloured.append(tag)


def _check_texture(checked: CheckedScene, node: mi.parser.SceneNode, name: str, limit: Range) -> None:
    plugin, outline = node.props.plugin_name(), checked.outline
    if plugin in ("blackbody", "d65") and limit.high <= 1:
        raise outline.tag(node).refusal("type", repr(plugin), f"{name} is no light; give another texture")
    own = {"mesh_attribute": "name", "bitmap": "filename"}.get(plugin, "")
    for meant in filter(None, (name, Path(_text(node, own) or "").name)):
        checked.limits[meant] = min(checked.limits.get(meant, limit), limit, key=lambda one: one.high)
    for key in limits.TABLES:
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
    path = checked.scene_files.find(tag, name)
    if str(path) in checked.own:
        return  # mitsim reads it itself, and makes a file of it that is as Mitsuba needs it
    try:
        if plugin in _IMAGES:
            texels, grey = check_image(path)
            checked.texels += texels
            if not grey:
                checked.coloured.append(tag)
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
        if props.plugin_name() in PLUGINS["sampler"].split() and "sample_count" in props:
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
            rule = f"give a number {limits_of(CameraGeometry.model_fields[name])}" if ranged else problem["msg"]
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
    limits.WAVELENGTH.check(checked.outline.tag(node, name), name, spectrum.wavelengths)
    return list(spectrum.values)


def _text(node: mi.parser.SceneNode, name: str) -> str | None:
    return node.props[name] if name in node.props and node.props.type(name) == _Type.String else None


def _words(node: mi.parser.SceneNode, name: str) -> list[str]:
    return re.findall(r"[^\s,\[\]\"]+", node.props.as_string(name))
