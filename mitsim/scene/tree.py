"""Changes to the tree of a checked scene that let Mitsuba render what the scene describes.

Mitsuba makes objects in single precision, but its parser's tree is in double precision. Therefore objects are moved in
the tree, and refused where single precision would lose their position, width or brightness.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.sensor import PITCH_TOLERANCE, SensorModel
from mitsim.scene.check import CHOICES, DIRECTED, MIRRORS, PLUGINS, STRAIGHT, CheckedScene, references
from mitsim.scene.outline import Outline

_CENTRES = {"sphere": "center", "cylinder": "p0"}
_PLACED = ("point", "spot", "projector", "mitsim_projector")
"""Lamps with a position."""
_SINGLE = ("projector", "obj", "ply", "instance")
"""Objects whose numbers are of single precision already."""
_ROUNDING = 2.0**-24
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
        if plugin in _SINGLE and distance * _ROUNDING > _COARSEST * reach:
            farthest = f"its origin may be {_COARSEST / _ROUNDING * reach:.0f} mm away"
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
    for index in references(nodes[at].props):
        plugin = nodes[index].props.plugin_name()
        if plugin == "merge":
            yield from standing(nodes, index)
        elif plugin != "shapegroup" and plugin in (*PLUGINS["shape"].split(), *PLUGINS["sensor"].split(), *_PLACED):
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
    eyes = [np.zeros(3), *(placement_of(node.props)[:3, 3] for node in nodes if _is(node, "projector"))]
    places = [placement_of(nodes[index].props)[:3, 3] for index in standing(nodes)]
    found = [(index, np.eye(4)) for index in standing(nodes)]
    for instance in [index for index, _ in found if _is(nodes[index], "instance")]:
        for group in references(nodes[instance].props):
            found += [(index, placement_of(nodes[instance].props)) for index in standing(nodes, group)]
    for index, to_world in found:
        props, kind, below = nodes[index].props, nodes[index].props.plugin_name(), plugins_below(nodes, index)
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
            rule = (
                f"single precision holds {distance / most:.2g} mm there; take a larger radius, or a mesh of its shape"
            )
            tag = outline.tag(mi.parser.SceneNode(nodes[index]), "radius")
            raise tag.refusal("radius", f"{radius:g} mm at a distance of {distance:.4g} mm", rule)


def _is(node: mi.parser.SceneNode, plugin: str) -> bool:
    return bool(node.props.plugin_name() == plugin)


def plugins_below(nodes: Sequence[mi.parser.SceneNode], index: int) -> set[str]:
    found = set[str]()
    for below in references(nodes[index].props):
        found |= {str(nodes[below].props.plugin_name())} | plugins_below(nodes, below)
    return found


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
    below = [plugins_below(nodes, index) for index in range(len(nodes))]
    for node, inner in zip(nodes, below, strict=True):
        plugin = str(node.props.plugin_name())
        sides = {
            index for index in references(node.props) if nodes[index].props.plugin_name() in PLUGINS["bsdf"].split()
        }
        sharp = not inner.isdisjoint((*MIRRORS, *STRAIGHT)) and (plugin != "twosided" or len(sides) > 1)
        if plugin in DIRECTED or (plugin in CHOICES and sharp):
            node.props.set_plugin_name(f"mitsim_{plugin}")
        if plugin in ("obj", "ply") and "area" in inner:
            node.props["face_normals"] = True


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
    nodes, changed = checked.state.nodes, False
    (own_row, own_column), shape = sensor.pitches_mm, sensor.frame_shape
    for node in nodes:
        if node.props.plugin_name() != "mitsim_lensless":
            continue
        films = [nodes[at].props for at in references(node.props) if nodes[at].props.plugin_name() in _FILMS]
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
