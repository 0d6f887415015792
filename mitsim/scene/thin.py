"""Cylinders too thin and lamps too small for single precision, in a checked tree; the same tree with meshes in their
place out.

Mitsuba solves a quadratic in single precision for the point where a ray meets a cylinder: with a radius r at a distance
D its discriminant is off by 6e-8 (D / r)^2, by as much as itself for 0.15 mm at 400 mm, which loses 3 to 7 % of the
light. Triangles keep the rounding of their corners, 3e-8 D. So a thin cylinder is handed on as a prism whose mean width
is that of the cylinder (perimeter over pi), made in double precision. Spheres are met from the ray's point nearest to
them, which loses 5e-4 of the light where r is 1e-5 D, and stay - unless they shine: Mitsuba draws points of such a lamp
by the cosine of its radius seen from afar, 1 - (r / D)^2 / 2, which single precision has only 1.2e-7 (D / r)^2 of. Its
light on surfaces is 3 % too much for 0.5 mm at 300 mm, 7 % for 0.1 mm, and nothing for 0.05 mm. Of a mesh points are
drawn by area. (Cauchy: a convex body shows a quarter of its area in the mean.)
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

_SLENDER = 400.0
"""Distance over radius from which Mitsuba's cylinders lose 8e-4 of their light (2e-4 at half of it)."""
_SMALL = 64.0
"""The same for spheres that shine, whose light is out by 5e-4 there, and by 2e-3 on what is twice as far away."""
_FINEST = {"cylinder": 1e5, "lamp": 1e5, "sphere": 1e6}
"""Distance over radius at which rounding moves a mesh's corners by 3e-3 of the radius, and a sphere loses 5e-3."""
_SIDES = 96
"""Of a prism: its width changes by 5e-4 with the direction that it is seen from."""
_RINGS = 24
"""Of a lamp, with twice as many sides: its area as it is seen changes by 3e-4 (standard deviation over directions), and
rounding moves corners by 2 % of an edge at 1e-5 of the distance."""
_POLISHED = ("conductor", "dielectric", "mitsim_glass", "thindielectric")
"""Materials whose light comes by single directions alone, which are followed on the cylinder itself."""
_MIXED = ("plastic", "pplastic")
"""Materials that need the cylinder for their glint, which holds no matt light."""
_Type = mi.Properties.Type
Mesh = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Corners (k, 3), normals (k, 3) and uv (k, 2), and triangles (m, 3)."""


@contextmanager
def with_thin_shapes_as_meshes(outline: Outline, state: mi.parser.ParserState) -> Iterator[None]:
    """Have thin cylinders and small lamps of a tree be meshes, whose files exist while the context lasts.

    Parameters
    ----------
    outline
        of the scene, for refusals.
    state
        the tree with its camera at the origin, which is changed.

    Raises
    ------
    MitsimError
        for a cylinder or sphere that is too thin for its distance, for a thin cylinder of smooth plastic, and where the
        meshes cannot be written.
    """
    thin = set(_thin(outline, state.nodes))
    with ExitStack() as stack:
        try:
            folder = stack.enter_context(tempfile.TemporaryDirectory()) if thin else ""
            for index in thin:
                _replace(state.nodes, index, Path(folder) / f"{index}.ply")
        except OSError as error:
            rule = "free some space there, or set TMPDIR to another folder"
            raise MitsimError(
                f"{outline.path}: meshes of its thin cylinders and small lamps: {error}; {rule}"
            ) from None
        yield


def _thin(outline: Outline, nodes: Sequence[mi.parser.SceneNode]) -> Iterator[int]:
    """Numbers of the nodes of thin cylinders and small lamps; MitsimError for what cannot be held."""
    eyes = [placed(node.props)[:3, 3] for node in nodes if node.props.plugin_name() == "projector"] + [np.zeros(3)]
    places = [placed(nodes[index].props)[:3, 3] for index in standing(nodes)]
    for index, to_world in _seen(nodes):
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
        if lamp:
            kept, slender, rule = set[str](), _SMALL, "take a matt material"
            mixed = set(_MIXED + _POLISHED)
        else:
            kept, slender, rule = set(_POLISHED), _SLENDER, "take roughplastic in place of the smooth one"
            mixed = set(_MIXED)
        if (kind == "sphere" and not lamp) or below & kept:
            continue
        if distance > slender * radius and below & mixed:
            raise tag.refusal("radius", got, held.format(distance / slender, rule))
        # What a lamp lights may be further away than camera and projector.
        if not below & mixed and (_farthest(ends, eyes + places) if lamp else distance) > slender * radius:
            yield index


def _farthest(ends: Sequence[FloatArray], places: Sequence[FloatArray]) -> float:
    """Largest distance of the ``ends`` from any of the ``places``."""
    return max(float(np.linalg.norm(end - place)) for end in ends for place in places)


def _seen(nodes: Sequence[mi.parser.SceneNode]) -> Iterator[tuple[int, FloatArray]]:
    """Numbers of all nodes of shapes, and (4, 4) from where they stand to the world: of a group's once an instance."""
    for index in standing(nodes):
        yield index, np.eye(4)
        if nodes[index].props.plugin_name() == "instance":
            for group in _below(nodes[index].props):
                yield from ((own, placed(nodes[index].props)) for own in standing(nodes, group))


def _below(props: mi.Properties) -> list[int]:
    """Numbers of the nodes that ``props`` refer to."""
    return [props[name].index() for name in props.keys() if props.type(name) == _Type.ResolvedReference]  # noqa: SIM118


def _replace(nodes: Sequence[mi.parser.SceneNode], index: int, path: Path) -> None:
    """Have a node be the mesh of its cylinder or sphere, written to ``path``."""
    props = nodes[index].props
    _write(path, ball(props) if props.plugin_name() == "sphere" else prism(props))
    props.set_plugin_name("ply")
    for name in ("p0", "p1", "center", "radius", "to_world"):
        if name in props:
            del props[name]
    props["filename"] = str(path)
    # A lamp with vertex normals would shine by them, and lose light.
    props["face_normals"] = any(nodes[below].props.plugin_name() == "area" for below in _below(props))


def _extent(props: mi.Properties, to_world: FloatArray) -> tuple[list[FloatArray], float]:
    """Ends or centre in the world, and the largest radius there."""
    local = to_world @ placed(props, centred=False)
    ends = [(to_world @ placed(props))[:3, 3]]
    if props.plugin_name() == "cylinder":
        ends.append(local[:3, :3] @ _point(props, "p1", (0, 0, 1)) + local[:3, 3])
    stretch = float(np.linalg.svd(local[:3, :3], compute_uv=False)[0])
    return ends, stretch * float(props.get("radius", 1.0))


def _plugins_below(nodes: Sequence[mi.parser.SceneNode], index: int) -> set[str]:
    """Names of all plugins below a node."""
    found = set[str]()
    for below in _below(nodes[index].props):
        found |= {str(nodes[below].props.plugin_name())} | _plugins_below(nodes, below)
    return found


def _point(props: mi.Properties, name: str, default: tuple[float, float, float]) -> FloatArray:
    return np.array(props.get(name, default), dtype=np.float64)


def prism(props: mi.Properties) -> Mesh:
    """The prism of a cylinder's ``props`` in the world, with normals and uv as Mitsuba has the cylinder's."""
    radius = float(props.get("radius", 1.0))
    first, last = _point(props, "p0", (0, 0, 0)), _point(props, "p1", (0, 0, 1))
    v, u = np.meshgrid([0.0, 1.0], np.linspace(0, 1, _SIDES + 1), indexing="ij")
    x, y = _beside((last - first) / np.linalg.norm(last - first))
    normal = np.cos(2 * np.pi * u)[..., None] * x + np.sin(2 * np.pi * u)[..., None] * y
    grown = radius * (np.pi / _SIDES) / np.sin(np.pi / _SIDES)  # a perimeter of 2 pi r
    mirrored = bool(np.linalg.det(placed(props)[:3, :3]) < 0)
    return _in_world(props, first + v[..., None] * (last - first) + grown * normal, normal, (u, v), mirrored)


def ball(props: mi.Properties) -> Mesh:
    """The mesh of a sphere's ``props`` in the world, of the same area."""
    v, u = np.meshgrid(np.linspace(0, 1, _RINGS + 1), np.linspace(0, 1, 2 * _RINGS + 1), indexing="ij")
    sine = np.sin(np.pi * v)
    normal = np.stack([sine * np.cos(2 * np.pi * u), sine * np.sin(2 * np.pi * u), np.cos(np.pi * v)], axis=-1)
    corner = normal.reshape(-1, 3)[_triangles(*u.shape)]
    double = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    grown = float(props.get("radius", 1.0)) * np.sqrt(8 * np.pi / double.sum())
    # A mirrored sphere of Mitsuba's faces inwards.
    return _in_world(props, _point(props, "center", (0, 0, 0)) + grown * normal, normal, (u, v), True)


def _in_world(
    props: mi.Properties, points: FloatArray, normals: FloatArray, uv: Sequence[FloatArray], turned: bool
) -> Mesh:
    """The mesh of a grid (k, l, 3) of points and normals in the frame of ``props``; ``turned``: its triangles the other
    way round."""
    matrix = placed(props, centred=False)
    triangles = _triangles(*uv[0].shape)
    points = points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    normals = normals.reshape(-1, 3) @ np.linalg.inv(matrix[:3, :3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    if turned:
        triangles = triangles[:, ::-1]
    return points, normals, np.stack([each.ravel() for each in uv], axis=1), triangles


def _triangles(rows: int, columns: int) -> FloatArray:
    """Two (m, 3) of each square of a grid of corners."""
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    b, c, d = a + 1, a + columns, a + columns + 1
    return np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


def _beside(n: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two axes across ``n`` where Mitsuba has them (Duff et al., Building an Orthonormal Basis, Revisited, 2017)."""
    sign = float(np.copysign(1, n[2]))
    a = -1 / (sign + n[2])
    b = n[0] * n[1] * a
    return np.array([1 + sign * n[0] ** 2 * a, sign * b, -sign * n[0]]), np.array([b, sign + n[1] ** 2 * a, -n[1]])


def _write(path: Path, mesh: Mesh) -> None:
    """A binary PLY."""
    points, normals, uv, triangles = mesh
    names = ("x", "y", "z", "nx", "ny", "nz", "u", "v")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header", ""]
    faces = np.empty(len(triangles), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, triangles
    vertices = np.concatenate([points, normals, uv], axis=1).astype("<f4")
    path.write_bytes("\n".join(header).encode() + vertices.tobytes() + faces.tobytes())
