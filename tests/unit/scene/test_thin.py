"""Thin cylinders and spheres as meshes: where they lie, what is refused, and that nothing else is touched."""

from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.scene import thin
from mitsim.scene.load import LoadedScene, load_scene

pytestmark = pytest.mark.usefixtures("variant")
MATT = '<bsdf type="diffuse"/>'
TURNED = """<transform name="to_world"><rotate y="1" angle="40"/><rotate x="1" angle="-70"/><scale value="1.5"/>
    <translate x="3" y="-2" z="7"/></transform>"""
SHAPES = {
    "cylinder": f"""<shape type="cylinder"><point name="p0" x="1" y="2" z="-1"/><point name="p1" x="2" y="-3" z="4"/>
        <float name="radius" value="1"/>{TURNED}</shape>""",
    "sphere": f"""<shape type="sphere"><point name="center" x="1" y="2" z="-1"/><float name="radius" value="1"/>
        {TURNED}</shape>""",
}


def wire(radius: float, bsdf: str = MATT, z: float = 380, more: str = "") -> str:
    return f"""<shape type="cylinder"><point name="p0" x="-40" y="-30" z="{z}"/><point name="p1" x="40" y="30" z="{z}"/>
        <float name="radius" value="{radius}"/>{bsdf}{more}</shape>"""


@pytest.fixture
def loaded(small_scene: Callable[..., Path]) -> Callable[[str], LoadedScene]:
    return lambda extra: load_scene(small_scene(extra=extra, integrator="volpath"))


@pytest.mark.parametrize("kind", SHAPES)
def test_a_mesh_is_where_mitsuba_has_the_round_shape(kind: str) -> None:
    """Rays inwards, a little beside its corners, meet the round one at the same place, normal and uv."""
    config = mi.parser.ParserConfig("scalar_rgb")
    config.parallel = config.merge_equivalent = config.merge_meshes = False
    state = mi.parser.parse_string(config, f'<scene version="3.0.0">{SHAPES[kind]}</scene>')
    mi.parser.transform_all(config, state)
    points, normals, uv, triangles = thin._mesh(state.nodes[1].props, kind)
    # Off the seam, where u is 0 or 1, and off the poles, which have all u.
    chosen = np.flatnonzero((uv[:, 0] > 0) & (uv[:, 0] < 1) & (uv[:, 1] >= 0.1 * (kind == "sphere")) & (uv[:, 1] < 0.9))
    config.variant = mi.variant()
    scene = mi.parser.instantiate(config, state)
    inwards = 0.02 * (points.mean(axis=0) - points[chosen])  # from a cylinder's end face to its side
    origin = points[chosen] + inwards * (kind == "cylinder") + normals[chosen]
    start, inward = (np.ascontiguousarray(each.T, dtype=np.float32) for each in (origin, -normals[chosen]))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(start), mi.Vector3f(inward)))
    assert np.array(si.is_valid()).all()
    # The mesh stands out a little, so that its mean width is that of the round shape.
    offset = np.linalg.norm(np.array(si.p).T - points[chosen] - inwards * (kind == "cylinder"), axis=1)
    assert offset.max() < {"cylinder": 0.035, "sphere": 0.01}[kind]
    assert np.abs(np.array(si.n).T - normals[chosen]).max() < 0.03
    assert np.abs(np.array(si.uv).T[:, 0] - uv[chosen, 0]).max() < 6e-3
    corner = points[triangles]
    double = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    outward = np.einsum("ij,ij->i", double, normals[triangles].mean(axis=1))
    assert (outward > 0).all()
    area = {"cylinder": 2 * np.pi * 1.5 * 1.5 * np.sqrt(51), "sphere": 4 * np.pi * 1.5**2}[kind]
    assert np.linalg.norm(double, axis=1).sum() / 2 == pytest.approx(area, rel=1e-9)


def test_only_what_is_thin_for_its_distance(loaded: Callable[[str], LoadedScene]) -> None:
    balls = "".join(
        f'<shape type="sphere"><point name="center" x="0" y="0" z="{z}"/><float name="radius" value="0.05"/></shape>'
        for z in (100, 900)
    )
    kinds = [shape.class_name() for shape in loaded(wire(0.15) + wire(2.0) + balls).scene.shapes()]
    assert kinds == ["Rectangle", "PLYMesh", "Cylinder", "Sphere", "PLYMesh"]


def test_a_wire_that_shines_has_no_vertex_normals(loaded: Callable[[str], LoadedScene]) -> None:
    """By them it would lose light."""
    lamp = '<emitter type="area"><spectrum name="radiance" value="1"/></emitter>'
    shining, matt = loaded(wire(0.15, more=lamp) + wire(0.15)).scene.shapes()[1:]
    assert shining.has_face_normals() and matt.has_vertex_normals() and not matt.has_face_normals()


def test_a_mirror_stays_round(loaded: Callable[[str], LoadedScene]) -> None:
    mirror = '<bsdf type="twosided"><bsdf type="conductor"/></bsdf>'
    assert loaded(wire(0.15, mirror)).scene.shapes()[1].class_name() == "Cylinder"


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        (wire(0.001), r"radius: got 0.001 mm at a distance of .* holds 0.0039 mm there; take a larger radius"),
        (wire(0.1, '<bsdf type="plastic"/>'), r"radius: got 0.1 mm at .* holds 0.99 mm there; take roughplastic"),
    ],
)
def test_what_cannot_be_held_is_refused(loaded: Callable[[str], LoadedScene], shape: str, words: str) -> None:
    with pytest.raises(MitsimError, match=words):
        loaded(shape)


def test_a_full_disk_is_a_line(loaded: Callable[[str], LoadedScene], monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(thin, "_write", full)
    with pytest.raises(MitsimError, match=r"thin shapes: .*No space left on device; free some space"):
        loaded(wire(0.15))
