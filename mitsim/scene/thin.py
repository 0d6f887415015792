"""Cylinders and spheres too thin for single precision, in a checked tree; the same as meshes, which it holds, out.

Mitsuba solves a quadratic in single precision for the point where a ray meets a cylinder or a sphere: of a cylinder of
radius r the discriminant is off by 6e-8 (D / r)^2 at a distance D, by as much as itself for 0.15 mm at 400 mm, which
loses 2 to 7 % of the light. Triangles keep the rounding of their corners, 3e-8 D. So a thin shape is handed on as a
prism or a polyhedron whose mean width is that of the shape (that of a convex body is its surface's quarter for a
sphere, its perimeter over pi for a prism), made in double precision.
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
from mitsim.scene.guard.outline import Outline
from mitsim.scene.origin import placed, standing

_SLENDER = {"cylinder": 400.0, "sphere": 4000.0}
"""Distance over radius from which single precision leaves a hundredth of a cylinder's discriminant, 6e-8 D^2 / r^2; a
sphere is met from the ray's point nearest to it, which leaves 1.2e-7 D / r, 5e-4 here."""
_FINEST = 1e5
"""Distance over radius at which rounding moves a mesh's corners by 3e-3 of the radius."""
_SIDES = {"cylinder": 96, "sphere": 32}
"""Sides of a prism, whose width then changes by 5e-4 with the direction that it is seen from; of a polyhedron's
equator, by 1e-3."""
_POLISHED = ("conductor", "dielectric", "mitsim_glass", "thindielectric")
"""Materials whose light comes by single directions alone, which are followed on the round shape itself."""
_MIXED = ("plastic", "pplastic")
"""Materials that need the round shape for their glint, and hold no matt light on it."""
_Type = mi.Properties.Type


@contextmanager
def holding_thin_shapes(outline: Outline, state: mi.parser.ParserState) -> Iterator[None]:
    """Have thin cylinders and spheres of a tree be meshes, whose files exist while the context lasts.

    Parameters
    ----------
    outline
        of the scene, for refusals.
    state
        the tree with its camera at the origin, which is changed.

    Raises
    ------
    MitsimError
        for what is thinner than a mesh could hold, for a thin cylinder or sphere of smooth plastic, and where the
        meshes cannot be written.
    """
    thin = list(_thin(outline, state.nodes))
    if not thin:
        yield
        return
    with ExitStack() as stack:
        try:
            folder = stack.enter_context(tempfile.TemporaryDirectory())
            for index in thin:
                _replace(state.nodes, index, Path(folder) / f"{index}.ply")
        except OSError as error:
            rule = "free some space there, or set TMPDIR to another folder"
            raise MitsimError(f"{outline.path}: meshes of its thin shapes: {error}; {rule}") from None
        yield


def _thin(outline: Outline, nodes: Sequence[mi.parser.SceneNode]) -> Iterator[int]:
    """Numbers of the nodes of thin shapes; MitsimError for those that cannot be held."""
    eyes = [placed(node.props)[:3, 3] for node in nodes if node.props.plugin_name() == "projector"] + [np.zeros(3)]
    for index in standing(nodes):
        props, kind = nodes[index].props, nodes[index].props.plugin_name()
        if kind not in _SLENDER:
            continue
        ends, radius = _extent(props, kind)
        distance = max(float(np.linalg.norm(end - eye)) for end in ends for eye in eyes)
        materials = _materials(nodes, index)
        if distance < _SLENDER[kind] * radius or materials & set(_POLISHED):
            continue
        tag = outline.tag(mi.parser.SceneNode(nodes[index]), "radius")
        got, held = f"{radius:g} mm at a distance of {distance:.4g} mm", "single precision holds {:.2g} mm there; {}"
        if distance > _FINEST * radius:
            rule = held.format(distance / _FINEST, "take a larger radius, or a flat strip")
            raise tag.refusal("radius", got, rule)
        if materials & set(_MIXED):
            rule = held.format(distance / _SLENDER[kind], "take roughplastic in place of the smooth one")
            raise tag.refusal("radius", got, rule)
        yield index


def _replace(nodes: Sequence[mi.parser.SceneNode], index: int, path: Path) -> None:
    """Have a node be the mesh of its shape, written to ``path``."""
    props = nodes[index].props
    _write(path, *_mesh(props, props.plugin_name()))
    props.set_plugin_name("ply")
    for name in ("p0", "p1", "center", "radius", "to_world"):
        if name in props:
            del props[name]
    props["filename"] = str(path)
    # A lamp with vertex normals would shine by them, and lose light.
    own = [props[name].index() for name in props.keys() if props.type(name) == _Type.ResolvedReference]  # noqa: SIM118
    props["face_normals"] = any(nodes[below].props.plugin_name() == "area" for below in own)


def _extent(props: mi.Properties, kind: str) -> tuple[list[FloatArray], float]:
    """Ends or centre in the world, and the largest radius there."""
    matrix, local = placed(props), placed(props, False)
    ends = [matrix[:3, 3]]
    if kind == "cylinder":
        ends.append(local[:3, :3] @ _point(props, "p1", (0, 0, 1)) + local[:3, 3])
    stretch = float(np.linalg.svd(local[:3, :3], compute_uv=False)[0])
    return ends, stretch * float(props.get("radius", 1.0))


def _materials(nodes: Sequence[mi.parser.SceneNode], index: int) -> set[str]:
    """Names of all plugins below a node."""
    props, found = nodes[index].props, set[str]()
    for name in props.keys():  # noqa: SIM118 - Properties is no dict
        if props.type(name) == _Type.ResolvedReference:
            below = props[name].index()
            found |= {str(nodes[below].props.plugin_name())} | _materials(nodes, below)
    return found


def _point(props: mi.Properties, name: str, default: tuple[float, float, float]) -> FloatArray:
    return np.array(props.get(name, default), dtype=np.float64)


def _mesh(props: mi.Properties, kind: str) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Corners (k, 3), normals (k, 3) and uv (k, 2) in the world, and triangles (m, 3), as Mitsuba has the shape."""
    sides, radius, matrix = _SIDES[kind], float(props.get("radius", 1.0)), placed(props, False)
    rows = 2 if kind == "cylinder" else sides // 2 + 1
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, sides + 1), indexing="ij")
    across = np.cos(2 * np.pi * u), np.sin(2 * np.pi * u)
    place = np.arange(rows * (sides + 1)).reshape(rows, sides + 1)
    a, b, c, d = (part.ravel() for part in (place[:-1, :-1], place[:-1, 1:], place[1:, :-1], place[1:, 1:]))
    if kind == "cylinder":
        first, last = _point(props, "p0", (0, 0, 0)), _point(props, "p1", (0, 0, 1))
        x, y = _beside((last - first) / np.linalg.norm(last - first))
        normal = across[0][..., None] * x + across[1][..., None] * y
        grown = radius * (np.pi / sides) / np.sin(np.pi / sides)  # a perimeter of 2 pi r
        points = first + v[..., None] * (last - first) + grown * normal
        triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    else:
        polar = np.pi * v
        normal = np.stack([np.sin(polar) * across[0], np.sin(polar) * across[1], np.cos(polar)], axis=-1)
        triangles = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
        corner = normal.reshape(-1, 3)[triangles]
        double = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
        triangles = triangles[double > 1e-9 * double.max()]  # at the poles two corners are one
        grown = radius * np.sqrt(8 * np.pi / double.sum())  # a surface of 4 pi r^2
        points = _point(props, "center", (0, 0, 0)) + grown * normal
    points = points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    normal = normal.reshape(-1, 3) @ np.linalg.inv(matrix[:3, :3])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    if np.linalg.det(matrix[:3, :3]) < 0:
        triangles = triangles[:, ::-1]
    return points, normal, np.stack([u.ravel(), v.ravel()], axis=1), triangles


def _beside(n: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two axes across ``n`` where Mitsuba has them (Duff et al., Building an Orthonormal Basis, Revisited, 2017)."""
    sign = float(np.copysign(1, n[2]))
    a = -1 / (sign + n[2])
    b = n[0] * n[1] * a
    return np.array([1 + sign * n[0] ** 2 * a, sign * b, -sign * n[0]]), np.array([b, sign + n[1] ** 2 * a, -n[1]])


def _write(path: Path, points: FloatArray, normals: FloatArray, uv: FloatArray, triangles: FloatArray) -> None:
    """A binary PLY."""
    names = ("x", "y", "z", "nx", "ny", "nz", "u", "v")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header", ""]
    faces = np.empty(len(triangles), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, triangles
    vertices = np.concatenate([points, normals, uv], axis=1).astype("<f4")
    path.write_bytes("\n".join(header).encode() + vertices.tobytes() + faces.tobytes())
