"""A scene's tree as Mitsuba's parser read it in; the same tree with its camera at the origin out, or a refusal.

Mitsuba makes objects in single precision, which leaves 0.03 mm at 300 m: 2e-2 of frames. The tree is in double
precision, so what stands far from the origin is moved there before objects are made of it. The vertices of a mesh file
are single precision already; where too few of their digits are left near the camera the scene is refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.devices.camera import CameraGeometry
from mitsim.scene.guard.limits import PLUGINS
from mitsim.scene.guard.outline import Outline, Tag

_CENTRES = {"sphere": "center", "cylinder": "p0"}
"""Points of shapes that are places beside ``to_world``, and single precision in Mitsuba."""
_PLACED = ("point", "spot", "projector", "mitsim_projector")
"""Lamps that stand somewhere; all others but those of shapes only have a direction."""
_ROUNDING = 2.0**-24
"""Half of the distance between numbers of single precision, relatively."""
_COARSEST = 5e-6
"""Rounding over distance from the camera [rad]: 1/400 of a pixel of 128 over 17 degrees, by which frames of a print
change by 1e-3."""
_ALIGNED = float(CameraGeometry.model_fields["scene_distance"].default)
_Type = mi.Properties.Type


def move_to_camera(outline: Outline, state: mi.parser.ParserState) -> tuple[tuple[Tag, float], ...]:
    """Move all that stands in the world of a checked tree so that its first ``mitsim_lensless`` is at the origin.

    A scene whose camera is there already, or that has none, is left as it is. Directions are kept.

    Parameters
    ----------
    outline
        of the scene, for refusals.
    state
        the tree, which is changed.

    Returns
    -------
    for each shape of the scene, in its order, its tag and how far [mm] vertices of single precision are moved to the
    world: 0 for what has none.

    Raises
    ------
    MitsimError
        for a projector so far from its camera that single precision loses its light's places.
    """
    nodes = state.nodes
    cameras = [node for node in nodes if node.props.plugin_name() == "mitsim_lensless"]
    away, reach = np.eye(4), _ALIGNED
    if cameras:
        away[:3, 3] = -placed(cameras[0].props)[:3, 3]
        reach = float(cameras[0].props.get("scene_distance", reach))
    places = {index: away @ placed(nodes[index].props) for index in standing(nodes)}
    for index, place in places.items():
        props, distance = nodes[index].props, float(np.linalg.norm(place[:3, 3]))
        if props.plugin_name() == "projector" and distance * _ROUNDING > _COARSEST * reach:
            rule = (
                f"single precision loses the places that it lights {reach:g} mm before the camera; it may stand "
                f"{_COARSEST / _ROUNDING * reach:.0f} mm away"
            )
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
    """MitsimError for a mesh whose vertices have lost their digits near the camera.

    Parameters
    ----------
    moved
        as :func:`move_to_camera` gives it.
    scene
        made of that tree.
    """
    if len(moved) != len(scene.shapes()):
        return
    for (tag, distance), shape in zip(moved, scene.shapes(), strict=True):
        if not distance:
            continue
        if shape.is_mesh():
            vertices = np.array(shape.vertex_position(mi.UInt32(np.arange(shape.vertex_count()))), dtype=np.float64)
            nearest = float(np.sqrt(np.square(vertices).sum(axis=0)).min(initial=np.inf))
        else:
            box = shape.bbox()
            nearest = float(np.linalg.norm(np.clip(0, np.array(box.min), np.array(box.max))))
        if distance * _ROUNDING > _COARSEST * nearest:
            rule = (
                f"vertices are of single precision; {nearest:.4g} mm from the camera, as these are at their nearest, "
                f"they may be moved by {_COARSEST / _ROUNDING * nearest:.0f} mm; write the mesh about its own origin"
            )
            raise tag.refusal("mesh", f"vertices that are moved by {distance:.0f} mm to stand before the camera", rule)


def standing(nodes: Sequence[mi.parser.SceneNode], at: int = 0, merged: bool = True) -> Iterator[int]:
    """Numbers of the nodes that stand in the world.

    Parameters
    ----------
    nodes
        of a tree, the root first.
    at
        number of the node that they are below.
    merged
        give each part of what is merged into one shape, in place of the whole.
    """
    props = nodes[at].props
    for name in props.keys():  # noqa: SIM118 - Properties is no dict
        if props.type(name) != _Type.ResolvedReference:
            continue
        index = props[name].index()
        node = nodes[index]
        if node.props.plugin_name() == "merge" and merged:
            yield from standing(nodes, index)
        elif _is(node, "shape") or _is(node, "sensor") or node.props.plugin_name() in _PLACED:
            yield index


def _is(node: mi.parser.SceneNode, kind: str) -> bool:
    plugin = node.props.plugin_name()
    return plugin in PLUGINS[kind].split() and plugin != "shapegroup"


def placed(props: mi.Properties, centred: bool = True) -> FloatArray:
    """(4, 4) from an object to the world.

    Parameters
    ----------
    props
        of the object.
    centred
        from about its ``center``, ``p0`` or ``position``, where it has one.
    """
    name = _CENTRES.get(props.plugin_name(), "position")
    matrix = np.array(props["to_world"].matrix, dtype=np.float64) if "to_world" in props else np.eye(4)
    return matrix @ _shift(props[name]) if centred and name in props else matrix


def _place(props: mi.Properties, matrix: FloatArray) -> None:
    """Have what is described stand where a ``matrix`` says, about its centre."""
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


def _shift(point: mi.ScalarPoint3d) -> FloatArray:
    matrix = np.eye(4)
    matrix[:3, 3] = np.array(point, dtype=np.float64)
    return matrix
