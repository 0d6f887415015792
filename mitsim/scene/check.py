"""Checks of a scene file before Mitsuba makes objects of it.

Making objects can run native code and read any file, and Mitsuba accepts NaN, negative light or a reflectance of 2.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi
import numpy as np
import pydantic

from mitsim.core.configuration import limits_of
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry
from mitsim.scene import limits
from mitsim.scene.headers import MOST_TEXELS, check_image, check_obj, check_ply
from mitsim.scene.limits import PLUGINS, SMALL_LAMPS, Range, Unfit, check_plugin, check_variant, references
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
_Type = mi.Properties.Type


@dataclass(frozen=True)
class CheckedScene:
    """A scene of which Mitsuba may make objects, its files (the scene first), and allowed ranges ``limits`` by name.

    ``shapes``, ``small_lamps`` (which no path can hit), ``coloured`` (may depend on wavelength) and ``parting``
    (dispersive glass) are tags in order. ``own`` are files that a user names and mitsim prepares. ``unread`` are names
    of materials that meshes refer to. ``unfit`` has the estimators that must refuse the scene.
    """

    outline: Outline
    config: mi.parser.ParserConfig
    state: mi.parser.ParserState
    files: tuple[Path, ...]
    limits: Mapping[str, Range]
    unfit: Unfit
    shapes: tuple[Tag, ...]
    small_lamps: tuple[Tag, ...]
    coloured: tuple[Tag, ...]
    parting: tuple[Tag, ...]
    samples: int | None
    without_normals: frozenset[str]
    own: Mapping[str, str]
    unread: dict[str, str]


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
    tree = _Tree(outline, files, variant, [mi.parser.SceneNode(node) for node in state.nodes])
    tree.check()
    # Groups are in the scene only by their instances.
    shapes = [plugin for plugin in PLUGINS["shape"].split() if plugin != "shapegroup"]
    facts = tuple(files.used), tree.limits, Unfit.of(outline, tree.nodes)
    own = {str(path): name for path, name in files.own.items() if name in PREPARED}
    listed = tuple(tree.tags_of(shapes)), tuple(tree.tags_of(SMALL_LAMPS)), tuple(tree.coloured), tuple(tree.parting)
    without_normals = frozenset(name for name, given in tree.normals.items() if given == {False})
    return CheckedScene(outline, config, state, *facts, *listed, tree.samples, without_normals, own, tree.unread)


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


@dataclass
class _Tree:
    """Copies of the tree's nodes, because Mitsuba marks a property that is read."""

    outline: Outline
    files: SceneFiles
    variant: str | None
    nodes: list[mi.parser.SceneNode]
    limits: dict[str, Range] = field(default_factory=lambda: dict(limits.LIMITS))
    texels: int = 0
    coloured: list[Tag] = field(default_factory=list)
    parting: list[Tag] = field(default_factory=list)
    samples: int | None = None
    normals: dict[str, set[bool]] = field(default_factory=dict)
    unread: dict[str, str] = field(default_factory=dict)

    def check(self) -> None:
        for node in self.nodes:
            tag, plugin = self.outline.tag(node), node.props.plugin_name()
            check_plugin(tag, plugin)
            if self.variant is not None:
                check_variant(tag, plugin, node.props, self.variant)
            # A metal is copper unless it states another material, or an index.
            plain = _text(node, "material") == "none" or ("material" not in node.props and "eta" in node.props)
            if plugin in _COLOURED or (plugin in _METALS and not plain):
                self.coloured.append(tag)
            if plugin == _PARTING:
                self.parting.append(tag)
            for name in node.props.keys():  # noqa: SIM118 - Properties is no dict
                self._check_property(node, name)
            if plugin in _READERS:
                self._check_resource(node)
            if plugin == "mitsim_lensless":
                self._check_camera(node)
        for tag in self.tags_of(_ON_SHAPES):
            problem = "it is the light of a shape"
            raise tag.refusal("emitter", repr(tag.attributes.get("type")), f"{problem}; put it into one")
        self._check_sizes()

    def tags_of(self, plugins: Sequence[str]) -> Iterator[Tag]:
        for child in (self.nodes[index] for index in references(self.nodes[0].props)):
            if child.props.plugin_name() in plugins:
                yield self.outline.tag(child)

    def _check_property(self, node: mi.parser.SceneNode, name: str) -> None:
        tag, kind, plugin = self.outline.tag(node, name), node.props.type(name), node.props.plugin_name()
        kinds, given_by = _PLACES.get(name, ((kind.name,), ""))
        if kind.name not in kinds:
            got = "an object" if kind == _Type.ResolvedReference else f"a {kind.name.lower()}"
            raise tag.refusal(name, got, f"it is given by {given_by}")
        if kind == _Type.Transform:
            matrix = np.array(_words(node, name), dtype=np.float64).reshape(4, 4)
            limits.check_transform(tag, name, matrix, name == "to_world" and plugin in _RIGID)
        elif kind == _Type.ResolvedReference:
            inner = self._child(node, name)
            within = inner.props.plugin_name()
            shape, emitter = (PLUGINS[kind].split() for kind in ("shape", "emitter"))
            if plugin in shape and within in emitter and within not in _ON_SHAPES:
                rule = f"a shape holds {' or '.join(_ON_SHAPES)} only; put other lamps beside the shapes"
                raise self.outline.tag(inner).refusal("type", repr(within), rule)
            if name in limits.LIMITS:
                self._check_texture(inner, name, limits.LIMITS[name])
            if plugin == "projector" and name == "irradiance" and "to_uv" in inner.props:
                rule = "the projector's window is found in the bitmap as it is; remove it, and turn the projector"
                raise self.outline.tag(inner, "to_uv").refusal("to_uv", "a transform", rule)
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
            table = self.outline.tag(node).name in ("texture", "spectrum") and name in limits.TABLES
            light = table or kind in (_Type.Color, _Type.Spectrum, _Type.String)
            other = {_Type.Vector: limits.COORDINATE, _Type.Integer: limits.WHOLE}.get(kind, limits.ANY)
            numbers = self._numbers(node, name)
            limits.LIMITS.get(name, limits.LIGHT if light else other).check(tag, name, numbers)
            if kind in (_Type.Color, _Type.Spectrum) and len(set(numbers)) > 1:
                self.coloured.append(tag)

    def _check_texture(self, node: mi.parser.SceneNode, name: str, limit: Range) -> None:
        plugin = node.props.plugin_name()
        if plugin in ("blackbody", "d65") and limit.high <= 1:
            raise self.outline.tag(node).refusal("type", repr(plugin), f"{name} is no light; give another texture")
        own = {"mesh_attribute": "name", "bitmap": "filename"}.get(plugin, "")
        for meant in filter(None, (name, Path(_text(node, own) or "").name)):
            self.limits[meant] = min(self.limits.get(meant, limit), limit, key=lambda one: one.high)
        for key in limits.TABLES:
            if key in node.props and node.props.type(key) == _Type.ResolvedReference:
                self._check_texture(self._child(node, key), key, limit)
            elif key in node.props:
                limit.check(self.outline.tag(node, key), name, self._numbers(node, key))

    def _check_resource(self, node: mi.parser.SceneNode) -> None:
        plugin, tag = node.props.plugin_name(), self.outline.tag(node, "filename")
        name = _text(node, "filename")
        if name is None:
            got = "no text" if "filename" in node.props else "nothing"
            raise tag.refusal("filename", got, f"a {plugin} reads one file")
        path = self.files.find(tag, name)
        if self.files.own.get(path) in PREPARED:
            return  # mitsim reads it itself, and makes a file of it that is as Mitsuba needs it
        try:
            if plugin in _IMAGES:
                texels, grey = check_image(path)
                self.texels += texels
                if not grey:
                    self.coloured.append(tag)
            else:
                given, self.unread[str(path)] = (check_ply if plugin == "ply" else check_obj)(path)
                self.normals.setdefault(Path(name).name, set()).add(given)
        except (ValueError, OSError) as error:
            raise tag.refusal("filename", repr(name), f"the file {error}") from None
        if self.texels > MOST_TEXELS:
            raise tag.refusal("texels", self.texels, f"all bitmaps together may have {MOST_TEXELS}")

    def _check_camera(self, node: mi.parser.SceneNode) -> None:
        for below in references(node.props):
            props = self.nodes[below].props
            if props.plugin_name() in PLUGINS["sampler"].split() and "sample_count" in props:
                self.samples = int(props["sample_count"])
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
                found.append(self.outline.tag(node, name).refusal(name, shown, rule))
            if len(found) == 1:
                raise found[0] from None
            head = f"{self.outline.path}: the camera has {len(found)} mistakes:"
            raise MitsimError(head, *map(str, found)) from None

    def _check_sizes(self) -> None:
        known: dict[int, tuple[int, int]] = {}

        def unfold(index: int, depth: int) -> tuple[int, int]:
            node = self.nodes[index]
            if index not in known and depth <= DEEPEST:
                parts = [unfold(below, depth + 1) for below in references(node.props)]
                sides = 2 if node.props.plugin_name() == "twosided" else 1  # each side is a copy
                deepest = max((levels for levels, _ in parts), default=0)
                known[index] = 1 + deepest, 1 + sides * sum(size for _, size in parts)
            levels, size = known.get(index, (DEEPEST + 1, 1))
            tag = self.outline.tag(node)
            most = _LARGEST_MATERIAL if tag.name == "bsdf" else MOST_ELEMENTS
            if levels > DEEPEST or size > most:
                got = f"{levels} levels of {size} objects with references followed"
                raise tag.refusal("nesting", got, f"{DEEPEST} levels and {most} objects are allowed")
            return levels, size

        unfold(0, 0)

    def _child(self, node: mi.parser.SceneNode, name: str) -> mi.parser.SceneNode:
        return self.nodes[node.props[name].index()]

    def _numbers(self, node: mi.parser.SceneNode, name: str) -> list[float]:
        if node.props.type(name) != _Type.Spectrum:
            try:
                return [float(word) for word in _words(node, name)]
            except ValueError:
                raise self.outline.tag(node, name).refusal(name, repr(node.props[name]), "give numbers") from None
        spectrum = node.props[name]
        limits.WAVELENGTH.check(self.outline.tag(node, name), name, spectrum.wavelengths)
        return list(spectrum.values)


def _text(node: mi.parser.SceneNode, name: str) -> str | None:
    return node.props[name] if name in node.props and node.props.type(name) == _Type.String else None


def _words(node: mi.parser.SceneNode, name: str) -> list[str]:
    return re.findall(r"[^\s,\[\]\"]+", node.props.as_string(name))
