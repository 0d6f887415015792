"""Scene files are loaded here as Mitsuba scenes with camera geometry and projector grid, or refused in one line."""

from __future__ import annotations

import re
import tempfile
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import keep_scenes
from mitsim.core.errors import MitsimError
from mitsim.core.images import fit_square, read_reflectance
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.sensor import PITCH_TOLERANCE, SensorModel
from mitsim.scene import check
from mitsim.scene.headers import check_obj, check_ply
from mitsim.scene.outline import Outline, Tag

# -------- The projector's pixel grid: n x n pixels of a stock ``projector`` emitter and the directions that they light
#
# The emitter's texture is its all-white frame. The rectangle of lit texels is the *window* of n x n pixels that
# patterns use; dark texels around it are canvas. A window off the canvas's centre is a lens shift, which causes no
# keystone. Row 0 is at +y and column 0 at +x for a viewer along +z.

_NO_KEYSTONE = 1e-3
"""Keystone in projector pixels that counts as rounding."""
_MOST_ACROSS = 16384
"""Largest number of projector pixels across the camera's field: 67 MB for 512 sensor pixels and a layer."""
_Place = tuple[int, float, float, tuple[int, int]]


@dataclass(frozen=True)
class ProjectorGrid:
    """A window of n x n projector pixels in a canvas (rows, columns), and its position on the camera's aligned plane.

    ``first_row`` and ``first_column`` are the texel of pixel (0, 0), fractional for a drifted picture. ``row_tan`` and
    ``column_tan`` are (first edge, last edge) of the window's bounding box as tan-angles in index coordinates.
    ``keystone`` is the largest deviation of the corners from that box in projector pixels.
    """

    n: int
    first_row: float
    first_column: float
    canvas: tuple[int, int]
    row_tan: tuple[float, float]
    column_tan: tuple[float, float]
    keystone: float

    @property
    def place(self) -> _Place:
        return self.n, self.first_row, self.first_column, self.canvas


def locate_projector(where: str, projector: mi.Emitter, camera: mi.Sensor) -> ProjectorGrid:
    """Find the lit window of a projector and its position in front of a camera.

    Raises MitsimError, which begins with ``where``, if the texture is no bitmap with a lit square window, or does not
    light the camera's aligned plane.
    """
    parameters = mi.traverse(projector)
    if "irradiance.data" not in parameters:
        raise MitsimError(f"{where}: the projector's irradiance is no bitmap; give one with its pixels as white texels")
    texels = np.array(parameters["irradiance.data"])
    lit = texels.reshape(texels.shape[0], texels.shape[1], -1).max(axis=-1) > 0
    rows, columns = np.flatnonzero(lit.any(axis=1)), np.flatnonzero(lit.any(axis=0))
    if not rows.size:
        raise MitsimError(f"{where}: the projector's bitmap is all black; its white texels are the projector's pixels")
    height, width = int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1
    if height != width or not lit[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].all():
        raise MitsimError(f"{where}: the projector's lit texels span {height}x{width} and must fill a square")
    z = camera.geometry.scene_distance
    window = width, int(rows[0]), int(columns[0]), (int(lit.shape[0]), int(lit.shape[1]))
    corners = _window_corners(where, projector, camera, window, z)
    low, high = corners.min(axis=0), corners.max(axis=0)
    span = float((high - low).min())
    across = 2 * camera.geometry.tan_half_fov * width / span if span > 0 else np.inf
    if across > _MOST_ACROSS:
        problem = f"{where}: the camera's field is {across:.3g} pixels of the projector wide"
        remedy = f"at most {_MOST_ACROSS} are simulated, so widen the projector's fov, or narrow the camera's"
        raise MitsimError(f"{problem}; {remedy}")
    ideal = np.array([[low[0], low[1]], [low[0], high[1]], [high[0], low[1]], [high[0], high[1]]])
    keystone = float(np.abs((corners - ideal) / (high - low)).max()) * width
    tangents = (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))
    return ProjectorGrid(*window, *tangents, keystone if keystone > _NO_KEYSTONE else 0.0)


def window_at(
    where: str, projector: mi.Emitter, camera: mi.Sensor, grid: ProjectorGrid, depth: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return row and column tan-angles (first edge, last edge) on a plane, or raise MitsimError if it is unlit."""
    corners = _window_corners(where, projector, camera, grid.place, depth)
    (top, left), (bottom, right) = corners.min(axis=0), corners.max(axis=0)
    return (float(top), float(bottom)), (float(left), float(right))


def _window_corners(where: str, projector: mi.Emitter, camera: mi.Sensor, window: _Place, z: float) -> FloatArray:
    """Return the (4, 2) tan-angles (row, column) of the window's corners on the plane at ``z``, from four probes."""
    half = 0.25 * z  # any four points do
    probes = np.array([[half, half], [half, -half], [-half, half], [-half, -half]])
    interaction = dr.zeros(mi.SurfaceInteraction3f, len(probes))
    # Opaque numbers keep the compiled kernel the same for every plane.
    place, across, away = dr.arange(mi.UInt32, len(probes)), dr.opaque(mi.Float, half), dr.opaque(mi.Float, z)
    x, y = (dr.select((place & bit) == 0, across, -across) for bit in (2, 1))
    interaction.p = camera.world_transform() @ mi.Point3f(x, y, away)
    sample, _ = projector.sample_direction(interaction, mi.Point2f(0.5))
    uv = np.array(sample.uv, dtype=np.float64).T
    uv = uv.T if uv.shape[0] == 2 and uv.shape[1] == len(probes) else uv
    homography = _homography(uv, probes) if np.isfinite(uv).all() else np.full((3, 3), np.nan)
    n, row, column, canvas = window
    rows = (row + n * np.array([0, 0, 1, 1])) / canvas[0]
    columns = (column + n * np.array([0, 1, 0, 1])) / canvas[1]
    mapped = np.stack([columns, rows, np.ones(4)], axis=1) @ homography.T
    points = mapped[:, :2] / mapped[:, 2:]
    if not np.isfinite(points).all():
        raise MitsimError(f"{where}: the projector does not light the plane at {z:g} mm; aim it at the scene")
    return np.stack([-points[:, 1] / z, -points[:, 0] / z], axis=1)


def _homography(source: FloatArray, target: FloatArray) -> FloatArray:
    rows = []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows.append([x, y, 1, 0, 0, 0, -u * x, -u * y, -u])
        rows.append([0, 0, 0, x, y, 1, -v * x, -v * y, -v])
    return np.asarray(np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3))


# -------- Loading of a scene file

SENSOR_PLUGIN = "mitsim_lensless"
_FLAT, _TURNED = ("Rectangle", "Disk"), 1e-6
"""Flat shapes, and the difference between parallel normals in single precision."""
_SMOOTH_BY_CLASS = ("Instance", "SDFGrid")
_PARALLEL = 0.9999
"""Cosine between normals of a face and of its vertices that counts as flat."""


@dataclass(frozen=True)
class LoadedScene:
    """A scene ready for transport; ``projector`` and ``grid`` are None only for ``render``.

    Attributes
    ----------
    files
        All files that Mitsuba read, the scene first.
    mirrors, glossy
        True if a surface reflects or refracts into single directions, or into lobes.
    shapes
        Tags of ``scene.shapes()``; empty if one tag gave several shapes.
    small_lamps
        Lamps that no path can hit, with their tags.
    coloured, parting
        Tags of objects that may depend on wavelength, and of dispersive glass.
    one_way
        True if no surface sees another.
    sensor_note
        Difference between the sensor of a camera file and the scene's.
    in_view
        True if a projector shines directly on the sensor; such light is traced like that of mirrors.
    """

    path: Path
    files: tuple[Path, ...]
    scene: mi.Scene
    camera: mi.Sensor
    projector: mi.Emitter | None
    grid: ProjectorGrid | None
    lamps: tuple[mi.Emitter, ...]
    mirrors: bool
    glossy: bool
    unfit: check.Unfit
    shapes: tuple[Tag, ...]
    small_lamps: tuple[tuple[mi.Emitter, Tag], ...]
    coloured: tuple[Tag, ...]
    parting: tuple[Tag, ...] = ()
    samples: int | None = None
    one_way: bool = False
    sensor_note: str | None = None
    own: Mapping[str, str] = field(default_factory=dict)
    in_view: bool = False

    @property
    def pixels(self) -> ProjectorGrid:
        if self.grid:
            return self.grid
        found = [emitter for emitter in self.scene.emitters() if emitter.class_name() == "Projector"]
        if len(found) != 1:
            raise _one_projector(self.path, found)
        return locate_projector(str(self.path), found[0], self.camera)

    @cached_property
    def hairy(self) -> bool:
        return any(shape.bsdf() and holds_hair(shape.bsdf().flags()) for shape in self.scene.shapes())

    @cached_property
    def smoothed(self) -> bool:
        """Return True if a shape has normals that are not its faces' own, or may hide such a shape."""
        for shape in self.scene.shapes():
            if not shape.is_mesh() or not shape.has_vertex_normals():
                if shape.class_name() in _SMOOTH_BY_CLASS:
                    return True
                continue
            # Rectangles and cubes are meshes without the parameters of one.
            held = shape.faces_buffer(), shape.vertex_positions_buffer(), shape.vertex_normals_buffer()
            faces, positions, normals = (np.array(each).reshape(-1, 3) for each in held)
            corners = positions[faces].astype(np.float64)
            own = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            cosines = np.abs((normals[faces] * own[:, None]).sum(axis=2))
            if (cosines < _PARALLEL * np.linalg.norm(own, axis=1)[:, None]).any():
                return True
        return False


@keep_scenes()
def load_scene(
    path: Path,
    defines: Mapping[str, str] | None = None,
    needs_projector: bool = True,
    outside: bool = False,
    sensor: SensorModel | None = None,
) -> LoadedScene:
    """Load a scene XML into the current variant; the plugin ``mitsim_lensless`` must be registered.

    ``needs_projector`` refuses a scene without exactly one projector, or one that the factored estimator cannot render.
    Pitch and format of a ``sensor`` replace the scene's. ``outside`` allows files outside the scene's folder.

    Raises MitsimError of one line that names the file, for any fault.
    """
    checked = check.check_file(path, defines or {}, outside, mi.variant())
    if needs_projector and checked.unfit.factored is not None:
        raise checked.unfit.factored
    checked.config.variant = mi.variant()
    sensor_note = None if sensor is None else fit_film(checked, sensor)
    with with_own_files(checked), check.looking_beside(checked.outline):
        move_to_camera(checked.outline, checked.state)
        check_thin_shapes(checked.outline, checked.state.nodes)
        put_wrappers(checked.state)
        scene = mi.parser.instantiate(checked.config, checked.state)
    for mesh, materials in checked.unread.items():
        if materials:
            warnings.warn(f"mesh {mesh}: its materials ({materials}) are not read; it has the scene's", stacklevel=2)
    _add_up_normals(scene, {name for name, given in checked.normals.items() if given == {False}})
    # Texels are checked after normals were added up, because Mitsuba's own normals once had a NaN.
    check_texels(path, scene, checked.limits)
    cameras = [sensor for sensor in scene.sensors() if hasattr(sensor, "geometry")]
    if len(cameras) != 1:
        raise MitsimError(f'{path}: {len(cameras)} sensors of type "{SENSOR_PLUGIN}"; a scene needs exactly one')
    emitters, shapes = list(scene.emitters()), scene.shapes()
    projectors = [emitter for emitter in emitters if emitter.class_name() == "Projector"]
    for projector in projectors:
        scale = float(np.array(mi.traverse(projector)["scale"]).ravel()[0])
        if scale < 0:
            raise MitsimError(f"{path}: the projector's scale: got {scale:g}; light is at least 0")
    if needs_projector and len(projectors) != 1:
        raise _one_projector(path, projectors)
    grid = None
    if len(projectors) == 1:
        try:
            grid = locate_projector(str(path), projectors[0], cameras[0])
        except MitsimError:
            if needs_projector:
                raise
    # Groups are in the scene only by their instances.
    tags = checked.tags_of(set(check.PLUGINS["shape"]) - {"shapegroup"})
    single = [emitter for emitter in emitters if mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)]
    small = [emitter for emitter in single if emitter.class_name() != "Projector"]
    flags = [shape.bsdf().flags() for shape in shapes if shape.bsdf()]
    polished = int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.DeltaTransmission)
    hidden = any(shape.class_name() == "Instance" for shape in shapes)
    flat = all(shape.class_name() in _FLAT and shape.bsdf() for shape in shapes)
    one_sided = flat and not any(mi.has_flag(own, mi.BSDFFlags.BackSide) for own in flags)
    normals = [np.array(shape.sample_position(0.0, mi.Point2f(0.5)).n).ravel() for shape in shapes if one_sided]
    return LoadedScene(
        path,
        checked.files,
        scene,
        cameras[0],
        projectors[0] if grid else None,
        grid,
        lamps=tuple(emitter for emitter in emitters if grid is None or emitter.class_name() != "Projector"),
        mirrors=any(own & polished for own in flags) or checked.unfit.instances is not None,
        glossy=hidden or any(mi.has_flag(own, mi.BSDFFlags.Glossy) for own in flags),
        unfit=checked.unfit,
        shapes=tuple(tags) if len(tags) == len(shapes) else (),
        small_lamps=tuple(zip(small, checked.tags_of(check.SMALL_LAMPS), strict=True)),
        coloured=tuple(checked.coloured),
        parting=tuple(checked.parting),
        samples=checked.samples,
        one_way=bool(normals) and float(np.ptp(normals, axis=0).max()) < _TURNED,
        sensor_note=sensor_note,
        own=checked.own,
    )


def _one_projector(path: Path, found: Sequence[mi.Emitter]) -> MitsimError:
    return MitsimError(f"{path}: needs one emitter of type projector, the file has {len(found) or 'none'}")


def holds_hair(flags: Any) -> Any:
    """Return True for ``flags`` of a material that is, or holds, hair."""
    both = int(mi.BSDFFlags.NonSymmetric) | int(mi.BSDFFlags.Null)
    return (flags & both) == both


# -------- Changes to the tree of a checked scene that let Mitsuba render what the scene describes
#
# Mitsuba makes objects in single precision, but its parser's tree is in double precision. Therefore objects are moved
# in the tree, and refused where single precision would lose their position, width or brightness.

_CENTRES = {"sphere": "center", "cylinder": "p0"}
_PLACED = ("mitsim_ies", "point", "spot", "projector", "mitsim_projector")
"""Lamps with a position."""
_SINGLE = ("projector", "obj", "ply", "instance")
"""Objects whose numbers are of single precision already."""
_SINGLE_ROUNDING = 2.0**-24
"""Relative rounding of single precision."""
_COARSEST = 5e-6
"""Largest rounding over distance [rad]: 1/400 pixel of 128 over 17 degrees, which changes frames by 1e-3."""


def move_to_camera(outline: Outline, state: mi.parser.ParserState) -> None:
    """Move all objects of a checked tree so that its first ``mitsim_lensless`` is at the origin; directions are kept.

    Single precision leaves 0.03 mm at 300 m, 2e-2 of frames. Raises MitsimError for a projector or mesh whose origin is
    too far from the camera.
    """
    nodes = state.nodes
    cameras = [node for node in nodes if node.props.plugin_name() == "mitsim_lensless"]
    away, reach = np.eye(4), float(CameraGeometry.model_fields["scene_distance"].default)
    if cameras:
        away[:3, 3] = -placement_of(cameras[0].props)[:3, 3]
        reach = float(cameras[0].props.get("scene_distance", reach))
    for index in standing(nodes):
        props = nodes[index].props
        plugin, place = props.plugin_name(), away @ placement_of(props)
        distance = float(np.linalg.norm(place[:3, 3]))
        if plugin in _SINGLE and distance * _SINGLE_ROUNDING > _COARSEST * reach:
            farthest = f"its origin may be {_COARSEST / _SINGLE_ROUNDING * reach:.0f} mm away"
            rule = f"single precision loses places {reach:g} mm before the camera; {farthest}"
            tag = outline.tag(mi.parser.SceneNode(nodes[index]), "to_world")
            raise tag.refusal("to_world", f"{distance:.0f} mm from the camera", rule)
        if not away[:3, 3].any():
            continue
        if plugin == "cylinder" and "p0" in props:
            last = np.array(props.get("p1", (0, 0, 1)), dtype=np.float64)  # its default
            props["p1"] = mi.ScalarPoint3d(last - np.array(props["p0"], dtype=np.float64))
        if _CENTRES.get(plugin, "to_world") in props and plugin in _CENTRES:
            props[_CENTRES[plugin]] = mi.ScalarPoint3d(0)
        elif "position" in props:
            props["position"] = mi.ScalarPoint3d(place[:3, 3])
            continue
        props["to_world"] = mi.ScalarAffineTransform4d(place)


def standing(nodes: Sequence[mi.parser.SceneNode], at: int = 0) -> Iterator[int]:
    """Yield the indices of nodes that have a place in the world, below node ``at``; a merged shape has its parts'."""
    for index in check.references(nodes[at].props):
        plugin = nodes[index].props.plugin_name()
        if plugin == "merge":
            yield from standing(nodes, index)
        elif plugin != "shapegroup" and plugin in (*check.PLUGINS["shape"], *check.PLUGINS["sensor"], *_PLACED):
            yield index


def placement_of(props: mi.Properties, centred: bool = True) -> FloatArray:
    name = _CENTRES.get(props.plugin_name(), "position")
    matrix = np.array(props["to_world"].matrix, dtype=np.float64) if "to_world" in props else np.eye(4)
    if centred and name in props:
        shift = np.eye(4)
        shift[:3, 3] = np.array(props[name], dtype=np.float64)
        return matrix @ shift
    return matrix


# -------- Thin cylinders and small lamps
#
# Mitsuba solves a quadratic in single precision for the point where a ray meets a cylinder. With radius r at distance
# D its discriminant errs by 6e-8 (D / r)^2, by 100 % for 0.15 mm at 400 mm, which loses 3 to 7 % of the light.
# Triangles keep the rounding of their corners, 3e-8 D. Specular chains meet cylinders in double precision. Spheres are
# met from the ray's nearest point, which loses 5e-4 of the light for r = 1e-5 D. Mitsuba draws points of an emitting
# sphere by the cosine of its visible radius, 1 - (r / D)^2 / 2, which single precision resolves only to 1.2e-7
# (D / r)^2: its light on surfaces is 3 % too much for 0.5 mm at 300 mm, and zero for 0.05 mm.

_SLENDER, _POLISHED_SLENDER, _SMALL_LAMP, _SMALL_BALL = 400.0, 1e5, 64.0, 1e6
"""Ratios of distance to radius at which a cylinder loses 8e-4 of its light, a lamp 5e-4, and a sphere 5e-3."""
_POLISHED = ("conductor", "dielectric", "mitsim_glass", "thindielectric")


def check_thin_shapes(outline: Outline, nodes: Sequence[mi.parser.SceneNode]) -> None:
    """Raise MitsimError for cylinders and spheres that are too thin for their distance from what they light."""
    projectors = [node.props for node in nodes if node.props.plugin_name() == "projector"]
    eyes = [np.zeros(3), *(placement_of(props)[:3, 3] for props in projectors)]
    places = [placement_of(nodes[index].props)[:3, 3] for index in standing(nodes)]
    found = [(index, np.eye(4)) for index in standing(nodes)]
    for instance in [nodes[index].props for index in standing(nodes) if nodes[index].props.plugin_name() == "instance"]:
        for group in check.references(instance):
            found += [(index, placement_of(instance)) for index in standing(nodes, group)]
    for index, to_world in found:
        props, kind = nodes[index].props, nodes[index].props.plugin_name()
        below = {inner.props.plugin_name() for inner in check.nodes_below(nodes, nodes[index])}
        if kind not in _CENTRES:
            continue
        lamp = kind == "sphere" and "area" in below
        most = _SMALL_LAMP if lamp else _SMALL_BALL
        local, ends = to_world @ placement_of(props, centred=False), [(to_world @ placement_of(props))[:3, 3]]
        if kind == "cylinder":
            most = _SLENDER if below.isdisjoint(_POLISHED) else _POLISHED_SLENDER
            ends.append(local[:3, :3] @ np.array(props.get("p1", (0, 0, 1)), dtype=np.float64) + local[:3, 3])
        radius = float(np.linalg.svd(local[:3, :3], compute_uv=False)[0]) * float(props.get("radius", 1.0))
        distance = max(float(np.linalg.norm(a - b)) for a in ends for b in eyes + (places if lamp else []))
        if distance > most * radius:
            rule = f"single precision holds {distance / most:.2g} mm there; take a larger radius, or a mesh"
            tag = outline.tag(mi.parser.SceneNode(nodes[index]), "radius")
            raise tag.refusal("radius", f"{radius:g} mm at a distance of {distance:.4g} mm", rule)


# -------- Materials made of others, and lamps that are meshes


def put_wrappers(state: mi.parser.ParserState) -> None:
    """Replace materials of Mitsuba by wrappers that return all light, forward and backward.

    Mitsuba's own materials lose light of mirrors, or are correct only for light from the camera
    (:mod:`mitsim.transport.plugins.materials`). A choice between materials without mirrors or holes is correct in
    Mitsuba and stays.

    Emitting meshes emit by their faces. Mitsuba draws points of a mesh with the normals of its vertices, and weighs the
    light by their cosine instead of the face's: of normals 30 and 60 degrees off it keeps 0.85 and 0.47.
    """
    nodes = state.nodes
    below = [{inner.props.plugin_name() for inner in check.nodes_below(nodes, node)} for node in nodes]
    for node, inner in zip(nodes, below, strict=True):
        plugin = str(node.props.plugin_name())
        inside = {*check.references(node.props)}
        sides = [index for index in inside if nodes[index].props.plugin_name() in check.PLUGINS["bsdf"]]
        sharp = not inner.isdisjoint((*check.MIRRORS, *check.STRAIGHT)) and (plugin != "twosided" or len(sides) > 1)
        if plugin in check.DIRECTED or (plugin in check.CHOICES and sharp):
            node.props.set_plugin_name(f"mitsim_{plugin}")
        if plugin in ("obj", "ply") and "area" in inner:
            node.props["face_normals"] = True


# -------- The film of a camera file
#
# The scene's film and ``pixel_pitch`` are defaults, which the sensor of a camera file replaces.
_FILMS = check.PLUGINS["film"]
_WINDOW = "crop_offset_x", "crop_offset_y", "crop_width", "crop_height"
_PITCH = float(CameraGeometry.model_fields["pixel_pitch"].default)


def fit_film(checked: check.CheckedScene, sensor: SensorModel) -> str:
    """Give the cameras of a scene the pitch and format of a camera file; return a sentence if something changes.

    A pitch within :data:`PITCH_TOLERANCE` stays. Raises MitsimError for a camera without a film whose size can be
    set.
    """
    nodes, changed = checked.state.nodes, False
    (own_row, own_column), shape = sensor.pitches_mm, sensor.frame_shape
    for node in nodes:
        if node.props.plugin_name() != "mitsim_lensless":
            continue
        films = [nodes[at].props for at in check.references(node.props) if nodes[at].props.plugin_name() in _FILMS]
        if not films:
            tag = checked.outline.tag(mi.parser.SceneNode(node))
            raise tag.refusal("film", "none", "the camera file's rows and columns are its size; give it a <film>")
        column = float(node.props.get("pixel_pitch", _PITCH))
        row = float(node.props.get("row_pitch", column))
        if abs(own_column - column) > PITCH_TOLERANCE * column or abs(own_row - row) > PITCH_TOLERANCE * row:
            changed, node.props["pixel_pitch"] = True, own_column
            if "row_pitch" in node.props:
                del node.props["row_pitch"]
            if own_row != own_column:
                node.props["row_pitch"] = own_row
        if shape is not None:
            window = [name for name in _WINDOW if name in films[0]]
            changed |= bool(window) or (films[0].get("height", 576), films[0].get("width", 768)) != tuple(shape)
            films[0]["height"], films[0]["width"] = shape
            for name in window:
                del films[0][name]
    if not changed:
        return ""
    size = "" if shape is None else f"{shape[0]} x {shape[1]} "
    pitch = f"{own_row * 1e3:g} x {own_column * 1e3:g} um"
    return f"sensor {sensor.name!r}: {size}pixels of {pitch}, as its camera file says, in place of the scene's own"


# -------- Values of a loaded scene's bitmaps and meshes
# OpenEXR files and colours of vertices may hold NaN, infinity, negative numbers and reflectances above 1, which
# Mitsuba accepts. The renderer would spread one such texel over every frame.

_ANY = check.Range(-np.inf, np.inf)
_ROUNDING = 1e-5


_WHOLE = 2.0**40
"""Whole number for a normal of length 1: a vertex may have a million faces."""


def _add_up_normals(scene: mi.Scene, without_normals: set[str]) -> None:
    """Compute vertex normals of mesh files without normals such that every load gives the same bits.

    Mitsuba adds them up in 32 bits in the order of its threads. Here whole numbers are summed, because their order does
    not matter, with the angles of the faces as weights (Thuermer and Wuethrich 1998, as in Mitsuba). A zero sum gives
    Mitsuba's default normal.
    """
    parameters = mi.traverse(scene)
    for key in parameters.keys():  # noqa: SIM118 - SceneParameters is no dict
        if key.rpartition(".")[2] != "vertex_normals":
            continue
        mesh = parameters.properties[key][2]
        files = re.search(r'name = "([^"]*)"', str(mesh))
        if not (files and mesh.has_vertex_normals() and without_normals.issuperset(files[1].split(" + "))):
            continue
        corners = mesh.face_indices(dr.arange(mi.UInt32, mesh.face_count()))
        points = [mesh.vertex_position(corner) for corner in corners]
        across = dr.normalize(dr.cross(points[1] - points[0], points[2] - points[0]))
        sums = [dr.zeros(mi.Int64, mesh.vertex_count()) for _ in range(3)]
        for i, (corner, here) in enumerate(zip(corners, points, strict=True)):
            after, before = points[(i + 1) % 3], points[(i + 2) % 3]
            angle = dr.unit_angle(dr.normalize(after - here), dr.normalize(before - here))
            weighted = across * angle * _WHOLE
            for total, value in zip(sums, weighted, strict=True):
                dr.scatter_reduce(dr.ReduceOp.Add, total, mi.Int64(dr.round(value)), corner, dr.isfinite(value))
        added = mi.Vector3f(*map(mi.Float, sums))
        normals = dr.select(dr.squared_norm(added) > 0, mi.Normal3f(dr.normalize(added)), mi.Normal3f(1, 0, 0))
        parameters[key] = dr.ravel(normals)
    parameters.update()


def check_texels(path: Path, scene: mi.Scene, limits: Mapping[str, check.Range]) -> None:
    """Raise MitsimError for bitmaps and meshes with values outside ``limits`` by use, or that are not finite.

    The message has the file or mesh, the texel and its value.
    """
    parameters = mi.traverse(scene)
    for key in parameters.keys():  # noqa: SIM118 - SceneParameters is no dict
        name, _, last = key.rpartition(".")
        if last == "data" or last.startswith(("vertex_", "face_")):
            values = np.array(parameters[key])
            if values.dtype.kind != "f":
                continue  # Mitsuba may keep bitmaps of 8 bits as they are: those hold nothing impossible
            held = str(parameters.properties[key][2])
            if mi.is_spectral and (last.endswith("_color") or ("raw = 0" in held and values.shape[-1] == 3)):
                continue  # coefficients of smooth spectra in Mitsuba's model: of any, they lie within 0 and 1
            file = re.search(r'name = "([^"]*)"', held)
            named = file[1] if file else name
            # Mitsuba names a texture by its parameter, and a referenced texture by a number.
            limit = limits.get(named if last == "data" else last) or limits.get(name.rpartition(".")[2], _ANY)
            wrong = ~np.isfinite(values) | (values < limit.low) | (values > limit.high + _ROUNDING)
            if wrong.any():
                at, value, count = np.argwhere(wrong)[0], values[wrong][0], wrong.any(axis=-1).sum()
                place = f"mesh {named}: number {at[0]} of its {last} is {value:g}"
                if values.ndim == 3:
                    texel = f"the texel in row {at[0]}, column {at[1]}"
                    place = f"bitmap {named}: {texel} is {value:g} ({count} such texels)"
                words = f" of {limit.low:g} to {limit.high:g}{limit.hint}" if limit is not _ANY else ""
                raise MitsimError(f"{path}: {place}; allowed are finite numbers{words}")


# -------- Pictures and meshes that a user names
#
# Pictures and meshes of the user in the tree of a checked scene, converted to files that Mitsuba reads.
#
# A picture becomes the reflectances of a sheet (:func:`mitsim.core.images.read_reflectance`), in the middle of a
# square. A mesh is moved and scaled before the scene's own ``to_world`` acts: its longest side is 1, it stands on the
# plane y = 0, and the middle of its box is over the origin.

_BEHIND = 0.01
"""Part of a mesh's corners whose normal may oppose the winding, because of slivers."""
_CODE_ROUNDING = 1e-9
"""Rounding of 8-bit codes that were divided by 255 and are multiplied again."""


@contextmanager
def with_own_files(checked: check.CheckedScene) -> Iterator[None]:
    """Prepare the files that the user named; the prepared files exist within the context.

    Raises MitsimError for a picture that is no reflectance, a mesh without faces or with normals that point inwards,
    and if files cannot be written.
    """
    with ExitStack() as stack:
        for node in checked.state.nodes:
            name = str(node.props["filename"]) if "filename" in node.props else ""
            if name not in checked.own:
                continue
            if checked.own[name] != check.PICTURE:
                checked.unread[name] = _place_object(node.props, Path(name))
                continue
            square = fit_square(read_reflectance(Path(name)))
            codes = np.rint(255 * square)
            # Whole codes are written as in a shipped print, so that the same picture gives the same frames.
            whole = bool(np.abs(codes - 255 * square).max() < _CODE_ROUNDING)
            made = Path(stack.enter_context(tempfile.TemporaryDirectory())) / f"picture{'.png' if whole else '.exr'}"
            values = codes.astype(np.uint8) if whole else square.astype(np.float32)
            try:
                mi.Bitmap(values[..., None]).write(str(made))
            except RuntimeError as error:
                raise MitsimError(f"picture {name}: {made} cannot be written ({error}); set TMPDIR") from None
            node.props["filename"], node.props["raw"] = str(made), True
        yield


def _place_object(props: mi.Properties, path: Path) -> str:
    kinds = {".ply": check_ply, ".obj": check_obj}
    kind = path.suffix.lower()
    if kind not in kinds:
        raise MitsimError(f"object {path}: ends in {kind or 'nothing'}; read are .ply (triangles) and .obj")
    try:
        smooth, unread = kinds[kind](path)
        data = mi.traverse(mi.load_dict({"type": kind[1:], "filename": str(path)}))
    except (ValueError, RuntimeError, OSError) as error:
        raise MitsimError(f"object {path}: the file {str(error).strip().splitlines()[-1]}") from None
    props.set_plugin_name(kind[1:])
    props["filename"] = str(path)
    props["face_normals"] = not smooth  # Mitsuba would smooth the edges of a mesh that states no normals
    faces = np.array(data["faces"]).reshape(-1, 3)
    corners = np.array(data["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    if smooth:
        normals = np.array(data["vertex_normals"], dtype=np.float64).reshape(-1, 3)[faces]
        a, b, c = (corners[faces[:, i]] for i in range(3))
        against = (normals * np.cross(b - a, c - a)[:, None]).sum(axis=2) < 0
        if against.mean() > _BEHIND:
            got = f"the normals of {against.sum()} of {against.size} corners face against the way that their faces are"
            raise MitsimError(f"object {path}: {got} wound; recompute normals outwards, or export without")
    low, high = corners.min(axis=0), corners.max(axis=0)
    longest = float((high - low).max())
    if longest <= 0:
        raise MitsimError(f"object {path}: all its vertices are one point; export the mesh again")
    middle = (low + high) / 2
    upright = np.diag([1 / longest, 1 / longest, 1 / longest, 1.0])
    upright[:3, 3] = -np.array([middle[0], low[1], middle[2]]) / longest
    props["to_world"] = mi.ScalarAffineTransform4d(placement_of(props) @ upright)
    return unread


def why_dark(loaded: LoadedScene) -> str:
    """Return where a scene lies that no light of the projector reaches, and the place that the projector lights."""
    box, distance = loaded.scene.bbox(), loaded.camera.geometry.scene_distance
    if not box.valid():
        return "the scene has no surfaces; add a shape"
    corners = mi.Point3f(np.array([list(box.corner(i)) for i in range(8)]).T)
    seen = np.array(loaded.camera.world_transform().inverse() @ corners).reshape(3, -1)
    ends = zip("xyz", seen.min(axis=1), seen.max(axis=1), strict=True)
    place = ", ".join(f"{axis} = {low:.4g} to {high:.4g}" for axis, low, high in ends)
    x, y = (
        f"{-distance * high:.4g} to {-distance * low:.4g}"
        for low, high in (loaded.pixels.column_tan, loaded.pixels.row_tan)
    )
    lit = f"the camera looks along +z, and the projector lights x = {x}, y = {y} mm at z = {distance:g} mm"
    remedy = "move the scene there (1 unit is 1 mm), its front to camera and projector (or twosided), nothing before it"
    return f"the scene lies at {place} mm of the camera; {lit}; {remedy}"
