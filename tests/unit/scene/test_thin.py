"""Thin cylinders as prisms: where they lie, what is refused, and that nothing else is touched."""

from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.scene import tree as thin
from mitsim.scene.load import LoadedScene, load_scene

pytestmark = pytest.mark.usefixtures("variant")
MATT = '<bsdf type="diffuse"/>'
TURNED = """<transform name="to_world"><rotate y="1" angle="40"/><rotate x="1" angle="-70"/><scale value="1.5"/>
    <translate x="3" y="-2" z="7"/></transform>"""
CYLINDER = f"""<shape type="cylinder"><point name="p0" x="1" y="2" z="-1"/><point name="p1" x="2" y="-3" z="4"/>
    <float name="radius" value="1"/>{TURNED}</shape>"""


def wire(radius: float, bsdf: str = MATT, z: float = 380, more: str = "") -> str:
    return f"""<shape type="cylinder"><point name="p0" x="-40" y="-30" z="{z}"/><point name="p1" x="40" y="30" z="{z}"/>
        <float name="radius" value="{radius}"/>{bsdf}{more}</shape>"""


def ball(radius: float) -> str:
    return f"""<shape type="sphere"><point name="center" x="0" y="0" z="380"/>
        <float name="radius" value="{radius}"/></shape>"""


@pytest.fixture
def loaded(small_scene: Callable[..., Path]) -> Callable[[str], LoadedScene]:
    return lambda extra: load_scene(small_scene(extra=extra, integrator="volpath"))


def test_a_prism_is_where_mitsuba_has_the_cylinder() -> None:
    """Rays inwards, a little beside its corners, meet the cylinder at the same place, normal and uv."""
    config = mi.parser.ParserConfig(mi.variant())
    config.parallel = config.merge_equivalent = config.merge_meshes = False
    state = mi.parser.parse_string(config, f'<scene version="3.0.0">{CYLINDER}</scene>')
    mi.parser.transform_all(config, state)
    points, normals, uv, triangles = thin.prism(state.nodes[1].props)
    scene = mi.parser.instantiate(config, state)
    chosen = np.flatnonzero((uv[:, 0] > 0) & (uv[:, 0] < 1))  # off the seam
    along = 0.02 * (points.mean(axis=0) - points[chosen])  # from an end's edge
    start, inward = (
        np.ascontiguousarray(each.T, dtype=np.float32) for each in (points[chosen] + along, -normals[chosen])
    )
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(start - inward), mi.Vector3f(inward)))
    assert np.array(si.is_valid()).all()
    # The prism stands out a little, so that its mean width is that of the cylinder, and ``along`` leads inwards.
    assert np.abs(np.array(si.t) - 1).max() < 0.04
    assert np.abs(np.array(si.n).T - normals[chosen]).max() < 0.03
    assert np.abs(np.array(si.uv).T[:, 0] - uv[chosen, 0]).max() < 6e-3
    corner = points[triangles]
    double = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    assert (np.einsum("ij,ij->i", double, normals[triangles].mean(axis=1)) > 0).all()
    assert np.linalg.norm(double, axis=1).sum() / 2 == pytest.approx(2 * np.pi * 1.5 * 1.5 * np.sqrt(51), rel=1e-9)


def test_only_what_is_thin_for_its_distance(loaded: Callable[[str], LoadedScene]) -> None:
    kinds = [shape.class_name() for shape in loaded(wire(0.15) + wire(2.0) + ball(0.01)).scene.shapes()]
    assert kinds == ["Rectangle", "PLYMesh", "Cylinder", "Sphere"]


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
        (ball(3e-4), r"radius: got 0.0003 mm at .* holds 0.00038 mm there; take a larger radius"),
        (wire(0.1, '<bsdf type="plastic"/>'), r"radius: got 0.1 mm at .* holds 0.99 mm there; take roughplastic"),
    ],
)
def test_what_cannot_be_held_is_refused(loaded: Callable[[str], LoadedScene], shape: str, words: str) -> None:
    with pytest.raises(MitsimError, match=words):
        loaded(shape)


def test_a_full_disk_is_a_line(loaded: Callable[[str], LoadedScene], monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(
        MitsimError, match=r"thin cylinders and small lamps: .*No space left on device; free some space"
    ):
        loaded(wire(0.15))


@pytest.mark.parametrize("mirrored", ["", '<scale x="-1"/>'])
def test_a_small_lamp_is_a_mesh_of_its_area(mirrored: str) -> None:
    """With Mitsuba's uv, and facing as Mitsuba has it: outwards, and inwards where it is mirrored."""
    config = mi.parser.ParserConfig(mi.variant())
    ball = f"""<shape type="sphere"><point name="center" x="1" y="2" z="3"/><float name="radius" value="2"/>
        <transform name="to_world">{mirrored}<rotate x="1" angle="30"/><scale value="1.5"/></transform></shape>"""
    state = mi.parser.parse_string(config, f'<scene version="3.0.0">{ball}</scene>')
    mi.parser.transform_all(config, state)
    points, normals, uv, triangles = thin.ball(state.nodes[1].props)
    scene = mi.parser.instantiate(config, state)
    chosen = np.flatnonzero((np.abs(uv - 0.5) < 0.49).all(axis=1))  # off the seam and the poles
    start, inward = (np.ascontiguousarray(v[chosen].T, dtype=np.float32) for v in (points + normals, -normals))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(start), mi.Vector3f(inward)))
    assert np.abs(np.array(si.t) - 1).max() < 0.01
    assert np.abs(np.array(si.uv).T - uv[chosen]).max() < 1e-5
    corner = points[triangles]
    double = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    whole = np.linalg.norm(double, axis=1) > 1e-9
    outward = np.einsum("ij,ij->i", double, corner.mean(axis=1) - points.mean(axis=0))[whole]
    assert (np.sign(outward) == np.sign((np.array(si.n).T * normals[chosen]).sum(axis=1)[0])).all()
    assert np.linalg.norm(double, axis=1).sum() / 2 == pytest.approx(4 * np.pi * 9, rel=1e-12)


@pytest.mark.parametrize("radius", [4.0, 0.5, 0.1, 0.01])
def test_the_light_of_a_small_lamp(loaded: Callable[[str], LoadedScene], radius: float) -> None:
    """Normal to the way to it, E = pi L (r / D)^2. (Seen failing: 1.03, 1.07 and 0 of it for small ones.)"""
    shining = '<emitter type="area"><spectrum name="radiance" value="1"/></emitter></shape>'
    loaded_lamp = loaded(ball(radius).replace("</shape>", shining))
    count, distance = 2**18, 300.0
    at = dr.zeros(mi.Interaction3f, count)
    at.p = mi.Point3f(0, 0.6 * distance, 380 - 0.8 * distance)
    sample = np.random.default_rng(1).random((2, count), dtype=np.float32)
    _, light = loaded_lamp.lamps[0].sample_direction(at, mi.Point2f(sample), True)
    found = np.array(light, dtype=np.float64).mean()
    assert found == pytest.approx(np.pi * (radius / distance) ** 2, rel=6e-3)


def group(shapes: str, move: str = '<scale value="2"/><translate x="5" z="300"/>') -> str:
    return f"""<shape type="shapegroup" id="group">{shapes}</shape>
        <shape type="instance"><ref id="group"/><transform name="to_world">{move}</transform></shape>"""


def test_a_wire_of_an_instance_is_a_prism_too(loaded: Callable[[str], LoadedScene]) -> None:
    """Rays along the middle of the view meet one of 0.15 mm in the world where it is (Mitsuba's own cylinder: a tenth
    of them missed)."""
    for radius, kind in ((0.075, mi.ShapeType.Mesh), (2.0, mi.ShapeType.Cylinder)):
        scene = loaded(group(wire(radius, z=40))).scene
        x = np.linspace(-60, 60, 2001, dtype=np.float32)
        target = np.stack([x + 5, 0.75 * x, np.full_like(x, 380)])
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f(np.zeros_like(target)), mi.Vector3f(target)))
        assert set(np.array(si.shape.shape_type()).ravel()) == {int(kind)}
        assert np.abs(np.array(si.t) - 1).max() < 4.5 / 380


def test_a_wire_of_an_instance_that_cannot_be_held_is_refused(loaded: Callable[[str], LoadedScene]) -> None:
    """Of one group, the worst instance counts."""
    near = '<shape type="instance"><ref id="group"/><transform name="to_world"><scale value="3"/></transform></shape>'
    with pytest.raises(MitsimError, match=r"radius: got 0.001 mm at a distance of .*; take a larger radius"):
        loaded(group(wire(0.0005, z=40)) + near)
