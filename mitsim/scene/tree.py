"""Changes to the tree of a checked scene that let Mitsuba render what the scene describes.

Mitsuba makes objects in single precision, but its parser's tree is in double precision. Therefore objects that would
lose position, width or brightness are changed in the tree.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.sensor import PITCH_TOLERANCE, SensorModel
from mitsim.scene.check import CheckedScene
from mitsim.scene.limits import CHOICES, DIRECTED, MIRRORS, PLUGINS, STRAIGHT, references
from mitsim.scene.outline import Outline, Tag

# -------- The camera moved to the origin, or a refusal
#
# Mitsuba makes objects in single precision, which leaves 0.03 mm at 300 m: 2e-2 of frames. The tree is in double
# precision, so what stands far from the origin is moved there before objects are made of it. The vertices of a mesh
# file are single precision already; where too few of their digits are left near the camera the scene is refused.

_CENTRES = {"sphere": "center", "cylinder": "p0"}
_PLACED = ("point", "spot", "projector", "mitsim_projector")
"""Lamps with a position."""
_ROUNDING = 2.0**-24
"""Relative rounding of single precision."""
_COARSEST = 5e-6
"""Largest rounding over distance [rad]: 1/400 pixel of 128 over 17 degrees, which changes frames by 1e-3."""
_ALIGNED = float(CameraGeometry.model_fields["scene_distance"].default)


def move_to_camera(outline: Outline, state: mi.parser.ParserState) -> tuple[tuple[Tag, float], ...]:
    """Move all objects of a checked tree so that its first ``mitsim_lensless`` is at the origin; directions are kept.

    Return the tag and the moved distance [mm] of each shape in single precision. Raises MitsimError if a projector is
    too far from its camera.
    """
    nodes = state.nodes
    cameras = [node for node in nodes if node.props.plugin_name() == "mitsim_lensless"]
    away, reach = np.eye(4), _ALIGNED
    if cameras:
        away[:3, 3] = -placement_of(cameras[0].props)[:3, 3]
        reach = float(cameras[0].props.get("scene_distance", reach))
    places = {index: away @ placement_of(nodes[index].props) for index in standing(nodes)}
    for index, place in places.items():
        props, distance = nodes[index].props, float(np.linalg.norm(place[:3, 3]))
        if props.plugin_name() == "projector" and distance * _ROUNDING > _COARSEST * reach:
            rule = f"single precision loses the places that it lights {reach:g} mm before the camera; it may stand"
            rule = f"{rule} {_COARSEST / _ROUNDING * reach:.0f} mm away"
            got = f"{distance:.0f} mm from the camera"
            raise outline.tag(mi.parser.SceneNode(nodes[index]), "to_world").refusal("to_world", got, rule)
        if away[:3, 3].any():
            _place(props, place)
    moved = []
    for index in filter(lambda index: _is(nodes[index], "shape"), standing(nodes, merged=False)):
        name = "filename" if "filename" in nodes[index].props else "to_world"
        parts = standing(nodes, index) if nodes[index].props.plugin_name() == "merge" else (index,)
        single = [part for part in parts if nodes[part].props.plugin_name() in ("obj", "ply", "instance")]
        distance = max((float(np.linalg.norm(places[part][:3, 3])) for part in single), default=0.0)
        moved.append((outline.tag(mi.parser.SceneNode(nodes[index]), name), distance))
    return tuple(moved)


def check_meshes(moved: Sequence[tuple[Tag, float]], scene: mi.Scene) -> None:
    if len(moved) != len(scene.shapes()):
        return
    for (tag, distance), shape in zip(moved, scene.shapes(), strict=True):
        if not distance:
            continue
        if shape.is_mesh():
            vertices = np.array(mi.traverse(shape)["vertex_positions"], dtype=np.float64).reshape(-1, 3)
            nearest = float(np.sqrt(np.square(vertices).sum(axis=1)).min(initial=np.inf))
        else:
            box = shape.bbox()
            nearest = float(np.linalg.norm(np.clip(0, np.array(box.min), np.array(box.max))))
        if distance * _ROUNDING > _COARSEST * nearest:
            why = f"vertices are of single precision; {nearest:.4g} mm from the camera, as these are at their nearest"
            most = f"{_COARSEST / _ROUNDING * nearest:.0f} mm"
            rule = f"{why}, they may be moved by {most}; write the mesh about its own origin"
            raise tag.refusal("mesh", f"vertices that are moved by {distance:.0f} mm to stand before the camera", rule)


def standing(nodes: Sequence[mi.parser.SceneNode], at: int = 0, merged: bool = True) -> Iterator[int]:
    """Yield the indices of nodes that have a place in the world, below node ``at``.

    With ``merged``, the parts of a merged shape replace the whole.
    """
    props = nodes[at].props
    for index in references(props):
        node = nodes[index]
        if node.props.plugin_name() == "merge" and merged:
            yield from standing(nodes, index)
        elif _is(node, "shape") or _is(node, "sensor") or node.props.plugin_name() in _PLACED:
            yield index


def _is(node: mi.parser.SceneNode, kind: str) -> bool:
    plugin = node.props.plugin_name()
    return plugin in PLUGINS[kind].split() and plugin != "shapegroup"


def placement_of(props: mi.Properties, centred: bool = True) -> FloatArray:
    name = _CENTRES.get(props.plugin_name(), "position")
    matrix = np.array(props["to_world"].matrix, dtype=np.float64) if "to_world" in props else np.eye(4)
    if centred and name in props:
        shift = np.eye(4)
        shift[:3, 3] = np.array(props[name], dtype=np.float64)
        return matrix @ shift
    return matrix


def _place(props: mi.Properties, matrix: FloatArray) -> None:
    plugin = props.plugin_name()
    if plugin == "cylinder" and "p0" in props:
        last = np.array(props.get("p1", (0, 0, 1)), dtype=np.float64)  # its default
        props["p1"] = mi.ScalarPoint3d(last - np.array(props["p0"], dtype=np.float64))
    name = _CENTRES.get(plugin)
    if name and name in props:
        props[name] = mi.ScalarPoint3d(0)
    elif "position" in props:
        props["position"] = mi.ScalarPoint3d(matrix[:3, 3])
        return
    props["to_world"] = mi.ScalarAffineTransform4d(matrix)


# -------- Thin cylinders and small lamps as meshes
#
# Mitsuba solves a quadratic in single precision for the point where a ray meets a cylinder. With radius r at distance
# D its discriminant errs by 6e-8 (D / r)^2, by 100 % for 0.15 mm at 400 mm, which loses 3 to 7 % of the light.
# Triangles keep the rounding of their corners, 3e-8 D. Therefore a thin cylinder is replaced by a prism whose mean
# width is that of the cylinder (perimeter over pi), made in double precision. Spheres are met from the ray's nearest
# point, which loses 5e-4 of the light for r = 1e-5 D, and stay unless they emit. Mitsuba draws points of such a lamp
# by the cosine of its visible radius, 1 - (r / D)^2 / 2, which single precision resolves only to 1.2e-7 (D / r)^2. Its
# light on surfaces is 3 % too much for 0.5 mm at 300 mm, 7 % for 0.1 mm, and zero for 0.05 mm. Points of a mesh are
# drawn by area. (Cauchy: the mean visible area of a convex body is a quarter of its surface.)

_SLENDER = 400.0
"""Ratio of distance to radius from which Mitsuba's cylinders lose 8e-4 of their light."""
_SMALL = 64.0
"""The same ratio for emitting spheres (5e-4)."""
_FINEST = {"cylinder": 1e5, "lamp": 1e5, "sphere": 1e6}
"""Ratio at which rounding moves a mesh's corners by 3e-3 of the radius, and a sphere loses 5e-3."""
_SIDES = 96
"""Sides of a prism: its width changes by 5e-4."""
_RINGS = 24
"""Rings of a lamp, with twice as many sides: its visible area changes by 3e-4."""
_POLISHED = ("conductor", "dielectric", "mitsim_glass", "thindielectric")
_MIXED = ("plastic", "pplastic")
"""Materials whose specular chains need the cylinder, which cannot hold their matt light."""
Uv = tuple[FloatArray, FloatArray]
Mesh = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


@contextmanager
def with_thin_shapes_as_meshes(outline: Outline, state: mi.parser.ParserState) -> Iterator[None]:
    """Replace thin cylinders and small lamps by meshes, whose files exist within the context.

    Raises MitsimError if a shape is too thin for its distance, for a thin cylinder of smooth plastic, and if files
    cannot be written.
    """
    thin = set(_thin_shapes(outline, state.nodes))
    with ExitStack() as stack:
        try:
            folder = stack.enter_context(tempfile.TemporaryDirectory()) if thin else ""
            for index in thin:
                _replace(state.nodes, index, Path(folder) / f"thin shape {index}.ply")
        except OSError as error:
            rule = "free some space there, or set TMPDIR to another folder"
            problem = f"{outline.path}: meshes of its thin cylinders and small lamps: {error}"
            raise MitsimError(f"{problem}; {rule}") from None
        yield


def _thin_shapes(outline: Outline, nodes: Sequence[mi.parser.SceneNode]) -> Iterator[int]:
    projectors = [node.props for node in nodes if node.props.plugin_name() == "projector"]
    eyes = [*(placement_of(props)[:3, 3] for props in projectors), np.zeros(3)]
    places = [placement_of(nodes[index].props)[:3, 3] for index in standing(nodes)]
    occurrences = [(index, np.eye(4)) for index in standing(nodes)]
    for index in [index for index, _ in occurrences if nodes[index].props.plugin_name() == "instance"]:
        to_world = placement_of(nodes[index].props)
        for group in references(nodes[index].props):
            occurrences += [(own, to_world) for own in standing(nodes, group)]
    for index, to_world in occurrences:
        props, kind = nodes[index].props, nodes[index].props.plugin_name()
        if kind not in _FINEST:
            continue
        below = _plugins_below(nodes, index)
        lamp = kind == "sphere" and "area" in below
        ends, radius = _extent(props, to_world)
        distance = _farthest(ends, eyes)
        tag = outline.tag(mi.parser.SceneNode(nodes[index]), "radius")
        got, held = f"{radius:g} mm at a distance of {distance:.4g} mm", "single precision holds {:.2g} mm there; {}"
        finest = _FINEST["lamp" if lamp else kind]
        if distance > finest * radius:
            raise tag.refusal("radius", got, held.format(distance / finest, "take a larger radius"))
        kept, slender, mixed = set(_POLISHED), _SLENDER, set(_MIXED)
        rule = "take roughplastic in place of the smooth one"
        if lamp:
            kept, slender, mixed, rule = set(), _SMALL, {*_MIXED, *_POLISHED}, "take a matt material"
        if (kind == "sphere" and not lamp) or below & kept:
            continue
        if distance > slender * radius and below & mixed:
            raise tag.refusal("radius", got, held.format(distance / slender, rule))
        # Surfaces that a lamp lights may be further away than camera and projector.
        if not below & mixed and (_farthest(ends, eyes + places) if lamp else distance) > slender * radius:
            yield index


def _farthest(ends: Sequence[FloatArray], places: Sequence[FloatArray]) -> float:
    return max(float(np.linalg.norm(end - place)) for end in ends for place in places)


def _replace(nodes: Sequence[mi.parser.SceneNode], index: int, path: Path) -> None:
    props = nodes[index].props
    points, normals, uv, triangles = ball(props) if props.plugin_name() == "sphere" else prism(props)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz", "u", "v")]
    header += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header", ""]
    faces = np.empty(len(triangles), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, triangles
    vertices = np.concatenate([points, normals, uv], axis=1).astype("<f4")
    path.write_bytes("\n".join(header).encode() + vertices.tobytes() + faces.tobytes())
    props.set_plugin_name("ply")
    for name in ("p0", "p1", "center", "radius", "to_world"):
        if name in props:
            del props[name]
    props["filename"] = str(path)
    # A lamp with vertex normals would emit by them, and lose light.
    props["face_normals"] = _emits(props, nodes)


def _extent(props: mi.Properties, to_world: FloatArray) -> tuple[list[FloatArray], float]:
    local = to_world @ placement_of(props, centred=False)
    ends = [(to_world @ placement_of(props))[:3, 3]]
    if props.plugin_name() == "cylinder":
        ends.append(local[:3, :3] @ _point(props, "p1", (0, 0, 1)) + local[:3, 3])
    stretch = float(np.linalg.svd(local[:3, :3], compute_uv=False)[0])
    return ends, stretch * float(props.get("radius", 1.0))


def _plugins_below(nodes: Sequence[mi.parser.SceneNode], index: int) -> set[str]:
    found = set[str]()
    for below in references(nodes[index].props):
        found |= {str(nodes[below].props.plugin_name())} | _plugins_below(nodes, below)
    return found


def _point(props: mi.Properties, name: str, default: tuple[float, float, float]) -> FloatArray:
    return np.array(props.get(name, default), dtype=np.float64)


def prism(props: mi.Properties) -> Mesh:
    radius = float(props.get("radius", 1.0))
    first, last = _point(props, "p0", (0, 0, 0)), _point(props, "p1", (0, 0, 1))
    v, u = np.meshgrid([0.0, 1.0], np.linspace(0, 1, _SIDES + 1), indexing="ij")
    n = (last - first) / np.linalg.norm(last - first)
    # Two axes across n where Mitsuba has them (Duff et al., Building an Orthonormal Basis, Revisited, 2017).
    sign = float(np.copysign(1, n[2]))
    a = -1 / (sign + n[2])
    b = n[0] * n[1] * a
    x = np.array([1 + sign * n[0] ** 2 * a, sign * b, -sign * n[0]])
    y = np.array([b, sign + n[1] ** 2 * a, -n[1]])
    normal = np.cos(2 * np.pi * u)[..., None] * x + np.sin(2 * np.pi * u)[..., None] * y
    grown = radius * (np.pi / _SIDES) / np.sin(np.pi / _SIDES)  # a perimeter of 2 pi r
    mirrored = bool(np.linalg.det(placement_of(props)[:3, :3]) < 0)
    return _in_world(props, first + v[..., None] * (last - first) + grown * normal, normal, (u, v), mirrored)


def ball(props: mi.Properties) -> Mesh:
    v, u = np.meshgrid(np.linspace(0, 1, _RINGS + 1), np.linspace(0, 1, 2 * _RINGS + 1), indexing="ij")
    sine = np.sin(np.pi * v)
    normal = np.stack([sine * np.cos(2 * np.pi * u), sine * np.sin(2 * np.pi * u), np.cos(np.pi * v)], axis=-1)
    corner = normal.reshape(-1, 3)[_triangles(*u.shape)]
    double = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    grown = float(props.get("radius", 1.0)) * np.sqrt(8 * np.pi / double.sum())
    # A mirrored sphere of Mitsuba's faces inwards.
    return _in_world(props, _point(props, "center", (0, 0, 0)) + grown * normal, normal, (u, v), True)


def _in_world(props: mi.Properties, points: FloatArray, normals: FloatArray, uv: Uv, turned: bool) -> Mesh:
    matrix = placement_of(props, centred=False)
    triangles = _triangles(*uv[0].shape)
    points = points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    normals = normals.reshape(-1, 3) @ np.linalg.inv(matrix[:3, :3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    if turned:
        triangles = triangles[:, ::-1]
    return points, normals, np.stack([each.ravel() for each in uv], axis=1), triangles


def _triangles(rows: int, columns: int) -> FloatArray:
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    b, c, d = a + 1, a + columns, a + columns + 1
    return np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


# -------- Materials made of others
#
# Mitsuba's own materials lose light of mirrors, or are correct only for light from the camera
# (:mod:`mitsim.transport.plugins.wrappers`).


def put_wrappers(state: mi.parser.ParserState) -> None:
    """Replace materials of Mitsuba by wrappers that return all light, forward and backward.

    A choice between materials without mirrors or holes is correct in Mitsuba and stays.
    """
    below = [_plugins_below(state.nodes, index) for index in range(len(state.nodes))]
    for node, inner in zip(state.nodes, below, strict=True):
        plugin = str(node.props.plugin_name())
        sides = {index for index in references(node.props) if _is(state.nodes[index], "bsdf")}
        sharp = not inner.isdisjoint((*MIRRORS, *STRAIGHT)) and (plugin != "twosided" or len(sides) > 1)
        if plugin in DIRECTED or (plugin in CHOICES and sharp):
            node.props.set_plugin_name(f"mitsim_{plugin}")


# -------- Lamps that are meshes emit by their faces
#
# Mitsuba draws points of a mesh emitter with the normals of its vertices, and weighs the light by their cosine instead
# of the face's: of normals 30 and 60 degrees off it keeps 0.85 and 0.47. ``face_normals`` drops them. Normals also
# determine which side emits, so that faces that are wound the other way are flipped.

_MESHES = ("obj", "ply")
_FLAT = 1e-4
"""Sine of the angle to a face below which a normal counts as the face's own."""


def emit_by_faces(checked: CheckedScene) -> tuple[str, ...]:
    """Set ``face_normals`` on emitting meshes with other normals; return a sentence for each.

    Raises MitsimError if normals lie on either side of the faces, because then no side is known to emit.
    """
    notes, nodes = [], checked.state.nodes
    for node in nodes:
        props = node.props
        if props.plugin_name() not in _MESHES or not _emits(props, nodes) or props.get("face_normals", False):
            continue
        sines, sides = tilts(props)
        if not sines.size or sines.max() < _FLAT:
            continue
        tag = checked.outline.tag(node)
        behind = int((~(sides > 0)).sum())
        if behind not in (0, sides.size):
            got = f"{behind} of {sides.size} corners that do not face the way that their face is wound"
            raise tag.refusal("normals", got, "a lamp emits from one side; wind all faces alike, or give face_normals")
        props["face_normals"] = True
        if behind:
            props["flip_normals"] = not props.get("flip_normals", False)
        off = f"{np.degrees(np.arcsin(sines.max())):.3g} degrees off them"
        note = "this lamp emits by its faces (face_normals), for its vertex normals are up to"
        notes.append(f"{tag.path.name}:{tag.line}: {note} {off}")
    return tuple(notes)


def _emits(props: mi.Properties, nodes: Sequence[mi.parser.SceneNode]) -> bool:
    return any(nodes[index].props.plugin_name() == "area" for index in references(props))


def tilts(props: mi.Properties) -> tuple[FloatArray, FloatArray]:
    """Return sine and cosine of the angle between normal and face, (k,) at every corner; empty without normals."""
    geometry = {name: props[name] for name in ("filename", "flip_normals", "to_world") if name in props}
    mesh = mi.load_dict({"type": props.plugin_name(), **geometry})
    if not mesh.has_vertex_normals():
        return np.zeros(0), np.zeros(0)
    data = mi.traverse(mesh)
    corners = np.array(data["faces"]).reshape(-1, 3)
    place, normal = (np.array(data[f"vertex_{name}"], np.float64).reshape(-1, 3) for name in ("positions", "normals"))
    a, b, c = (place[corners[:, i]] for i in range(3))
    face = np.cross(b - a, c - a)
    size = np.linalg.norm(face, axis=1)
    face, corners = face[size > 0] / size[size > 0, None], corners[size > 0]
    own = normal[corners]
    with np.errstate(invalid="ignore"):  # a normal of no length faces no way
        own = own / np.linalg.norm(own, axis=2, keepdims=True)
    sine = np.linalg.norm(np.cross(own, face[:, None]), axis=2)
    return np.minimum(sine, 1).ravel(), (own * face[:, None]).sum(axis=2).ravel()


# -------- The film of a camera file
#
# The scene's film and ``pixel_pitch`` are defaults, which the sensor of a camera file replaces.

_FILMS = PLUGINS["film"].split()
_WINDOW = "crop_offset_x", "crop_offset_y", "crop_width", "crop_height"
_PITCH = float(CameraGeometry.model_fields["pixel_pitch"].default)


def fit_film(checked: CheckedScene, sensor: SensorModel) -> str:
    """Give the cameras of a scene the pitch and format of a camera file; return a sentence if something changes.

    A pitch within :data:`PITCH_TOLERANCE` stays. Raises MitsimError for a camera without a film whose size can be
    set.
    """
    nodes, words = checked.state.nodes, ""
    for node in nodes:
        if node.props.plugin_name() != "mitsim_lensless":
            continue
        films = [nodes[at].props for at in references(node.props) if nodes[at].props.plugin_name() in _FILMS]
        if not films:
            tag = checked.outline.tag(mi.parser.SceneNode(node))
            raise tag.refusal("film", "none", "the camera file's rows and columns are its size; give it a <film>")
        before = _sensor_words(node.props, films[0])
        column = float(node.props.get("pixel_pitch", _PITCH))
        row = float(node.props.get("row_pitch", column))
        own_row, own_column = sensor.pitches_mm
        if abs(own_column - column) > PITCH_TOLERANCE * column or abs(own_row - row) > PITCH_TOLERANCE * row:
            node.props["pixel_pitch"] = own_column
            if "row_pitch" in node.props:
                del node.props["row_pitch"]
            if own_row != own_column:
                node.props["row_pitch"] = own_row
        if sensor.frame_shape is not None:
            films[0]["height"], films[0]["width"] = sensor.frame_shape
            for name in _WINDOW:
                if name in films[0]:
                    del films[0][name]
        after = _sensor_words(node.props, films[0])
        if after != before:
            words = f"sensor {sensor.name!r}: {after}, as its camera file says; the scene's own, {before},"
            words = f"{words} stand where no camera is named"
    return words


def _sensor_words(camera: mi.Properties, film: mi.Properties) -> str:
    column = float(camera.get("pixel_pitch", _PITCH))
    row = float(camera.get("row_pitch", column))
    rows, columns = (int(film.get(name, default)) for name, default in (("height", 576), ("width", 768)))
    pitch = f"{column * 1e3:g}" if row == column else f"{row * 1e3:g} x {column * 1e3:g}"
    window = f", of which a window of {film['crop_height']} x {film['crop_width']}" if _WINDOW[-1] in film else ""
    return f"{rows} x {columns} pixels of {pitch} um ({rows * row:.3g} x {columns * column:.3g} mm){window}"
