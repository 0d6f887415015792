"""Lamps that are meshes: a checked scene in, its tree changed so that they emit by their faces, and what to say of it.

Mitsuba draws points of a mesh emitter with the normals of its vertices, and weighs the light by their cosine instead of
the face's: of normals 30 and 60 degrees off it keeps 0.85 and 0.47. ``face_normals`` drops them. They also say which
side emits, so faces that are wound the other way are flipped.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.scene.guard.check import CheckedScene

_MESHES = ("obj", "ply")
_FLAT = 1e-4
"""Sine of the angle to a face below which a normal is the face's own: meshes are written with five digits."""


def emit_by_faces(checked: CheckedScene) -> tuple[str, ...]:
    """Set ``face_normals`` on meshes of the ``checked`` scene that emit and whose normals are not those of their faces.

    Returns
    -------
    for each of them, a sentence that says so.

    Raises
    ------
    MitsimError
        for a mesh whose normals lie on either side of its faces: then no side is known to emit.
    """
    notes, nodes = [], checked.state.nodes
    for node in nodes:
        props = node.props
        if props.plugin_name() not in _MESHES or not _emits(props, nodes) or props.get("face_normals", False):
            continue
        sines, sides = _tilts(props)
        if not sines.size or sines.max() < _FLAT:
            continue
        tag = checked.outline.tag(node)
        behind = int((~(sides > 0)).sum())
        if behind not in (0, sides.size):
            raise tag.refusal(
                "normals",
                f"{behind} of {sides.size} corners that do not face the way that their face is wound",
                "a lamp emits from one side; wind all faces alike, or give face_normals",
            )
        props["face_normals"] = True
        if behind:
            props["flip_normals"] = not props.get("flip_normals", False)
        notes.append(
            f"{tag.path.name}:{tag.line}: this lamp emits by its faces (face_normals), for its vertex normals are up "
            f"to {np.degrees(np.arcsin(sines.max())):.3g} degrees off them"
        )
    return tuple(notes)


def _emits(props: mi.Properties, nodes: list[mi.parser.SceneNode]) -> bool:
    objects = (name for name in props.keys() if props.type(name) == mi.Properties.Type.ResolvedReference)  # noqa: SIM118
    return any(nodes[props[name].index()].props.plugin_name() == "area" for name in objects)


def _tilts(props: mi.Properties) -> tuple[FloatArray, FloatArray]:
    """At every corner of the faces, (k,) each: sine of the angle between its normal and the face, and their cosine."""
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
