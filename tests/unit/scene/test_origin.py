"""Devices far from the origin are the devices at the origin, to the rounding of single precision there."""

from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.scene.load import LoadedScene, load_scene
from tests.ply import ply_text

pytestmark = pytest.mark.usefixtures("variant")
FAR = (1e6 + 0.123, -2e5 - 0.456, 3e5 + 0.789)
"""A kilometre away, at numbers that single precision has not."""


def triangle(x: float, y: float, z: float, right: float, top: float) -> str:
    return ply_text([(x, y, z), (right, y, z), (x, top, z)], [(0, 2, 1)])


def standing(away: tuple[float, float, float]) -> str:
    """One of all that can stand somewhere, ``away`` from where the camera is: by a centre, a transform, a parent."""
    x, y, z = away
    move = f'<translate x="{x!r}" y="{y!r}" z="{z!r}"/>'
    turned = f'<rotate y="1" angle="30"/><translate x="2" y="3" z="350"/>{move}'
    return f"""
    <shape type="sphere"><point name="center" x="{x + 5!r}" y="{y - 7!r}" z="{z + 380!r}"/>
        <float name="radius" value="0.3"/></shape>
    <shape type="sphere"><point name="center" x="1" y="2" z="3"/><transform name="to_world">{turned}</transform></shape>
    <shape type="cylinder"><point name="p0" x="{x - 5!r}" y="{y!r}" z="{z + 300!r}"/>
        <point name="p1" x="{x + 15!r}" y="{y + 30!r}" z="{z + 370!r}"/><float name="radius" value="1.5"/></shape>
    <shape type="cylinder"><transform name="to_world">{turned}</transform></shape>
    <shape type="disk"><transform name="to_world">{turned}</transform></shape>
    <shape type="cube"><transform name="to_world">{turned}</transform></shape>
    <shape type="merge"><shape type="cube"><transform name="to_world">{turned}</transform></shape>
        <shape type="cube"><transform name="to_world"><scale value="2"/>{turned}</transform></shape></shape>
    <shape type="shapegroup" id="group"><shape type="sphere"/></shape>
    <shape type="instance"><ref id="group"/><transform name="to_world">{turned}</transform></shape>
    <emitter type="point"><point name="position" x="{x!r}" y="{y!r}" z="{z + 50!r}"/></emitter>
    <emitter type="spot"><transform name="to_world">{turned}</transform></emitter>
    <emitter type="directional"><vector name="direction" x="0" y="0" z="1"/></emitter>"""


def loaded(small_scene: Callable[..., Path], away: tuple[float, float, float], extra: str) -> LoadedScene:
    x, y, z = away
    pose = f"1 0 0 {x!r} 0 1 0 {y!r} 0 0 1 {z!r} 0 0 0 1"
    return load_scene(small_scene(pose=pose, extra=extra, integrator="volpath"))


def places(scene: LoadedScene) -> np.ndarray:
    """Bounds of all shapes, and points that lamps and the projector shine from."""
    boxes = [shape.bbox() for shape in scene.scene.shapes()]
    found = [np.array([box.min, box.max]) for box in boxes]
    aside = mi.SurfaceInteraction3f()
    aside.p = mi.Point3f(3, -4, 360)
    for lamp in (*scene.lamps, scene.projector):
        sample, _ = lamp.sample_direction(aside, mi.Point2f(0.5), True)
        found.append(np.array([sample.p, sample.d]).reshape(2, 3))
    return np.array(found)


def test_everything_is_moved_with_the_camera(small_scene: Callable[..., Path]) -> None:
    here = places(loaded(small_scene, (0, 0, 0), standing((0, 0, 0))))
    far = places(loaded(small_scene, FAR, standing(FAR)))
    assert np.abs(here).max() < 1000
    np.testing.assert_allclose(far, here, atol=1e-4, rtol=0)


def test_a_mesh_file_about_its_own_origin_may_stand_anywhere(small_scene: Callable[..., Path], tmp_path: Path) -> None:
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "own.ply").write_text(triangle(-5, -5, 0, 5, 5))
    x, y, z = FAR
    move = f'<translate x="{x!r}" y="{y!r}" z="{z + 390!r}"/>'
    extra = f"""<shape type="ply"><string name="filename" value="own.ply"/>
        <transform name="to_world">{move}</transform></shape>"""
    box = loaded(small_scene, FAR, extra).scene.shapes()[-1].bbox()
    np.testing.assert_allclose([box.min, box.max], [[-5, -5, 390], [5, 5, 390]], atol=1e-4)


@pytest.mark.parametrize("merged", ["{}", '<shape type="merge">{}</shape>'])
def test_a_mesh_file_in_far_coordinates(small_scene: Callable[..., Path], tmp_path: Path, merged: str) -> None:
    """At 20 m single precision has 1e-3 mm left, at 300 m 0.03."""
    (tmp_path / "scenes").mkdir()
    for far in (2e4, 3e5):
        (tmp_path / "scenes" / f"far{far:g}.ply").write_text(triangle(far - 5, -5, 390, far + 5, 5))
    extra = merged.format('<shape type="ply"><string name="filename" value="far{:g}.ply"/></shape>')
    assert loaded(small_scene, (2e4, 0, 0), extra.format(2e4)).scene.shapes()[-1].is_mesh()
    with pytest.raises(MitsimError, match=r"small.xml:\d+: to_world: got 300000 mm from the camera .* 33554 mm away"):
        loaded(small_scene, (3e5, 0, 0), extra.format(3e5))
    # A mesh that is itself far from the camera needs no more digits.
    assert loaded(small_scene, (0, 0, 0), extra.format(3e5)).scene.shapes()[-1].is_mesh()


def test_a_projector_far_from_its_camera(small_scene: Callable[..., Path]) -> None:
    path = small_scene()
    text = path.read_text()
    path.write_text(text.replace('<translate x="60"/>', '<translate x="60" z="-300000"/>'))
    with pytest.raises(MitsimError, match=r"to_world: got 300000 mm from the camera in .* 33554 mm away"):
        load_scene(path)


# -------- Shapes that are too thin for single precision

MATT, LAMP = '<bsdf type="diffuse"/>', '<emitter type="area"><spectrum name="radiance" value="1"/></emitter>'


def wire(radius: float, inner: str = MATT, z: float = 380) -> str:
    return f"""<shape type="cylinder"><point name="p0" x="-40" y="-30" z="{z}"/><point name="p1" x="40" y="30" z="{z}"/>
        <float name="radius" value="{radius}"/>{inner}</shape>"""


def ball(radius: float, inner: str = "") -> str:
    return f"""<shape type="sphere"><point name="center" x="0" y="0" z="380"/>
        <float name="radius" value="{radius}"/>{inner}</shape>"""


def group(shape: str, scale: float) -> str:
    """Two instances of a group, of which the smaller one is too thin."""
    place = '<transform name="to_world"><scale value="{}"/></transform>'
    instance = f'<shape type="instance"><ref id="group"/>{place}</shape>'
    return f'<shape type="shapegroup" id="group">{shape}</shape>{instance.format(1)}{instance.format(scale)}'


def test_shapes_that_single_precision_holds(small_scene: Callable[..., Path]) -> None:
    """A mirror is met in double precision, and matt balls are met exactly."""
    mirror = wire(0.15, '<bsdf type="twosided"><bsdf type="conductor"/></bsdf>')
    kinds = loaded(small_scene, (0, 0, 0), mirror + wire(2.0) + ball(0.01) + ball(7.0, LAMP)).scene.shapes()
    assert [shape.class_name() for shape in kinds] == ["Rectangle", "Cylinder", "Cylinder", "Sphere", "Sphere"]


@pytest.mark.parametrize(
    ("shape", "held"),
    [
        *((wire(0.15), 0.98), (wire(0.1, '<bsdf type="plastic"/>'), 0.98)),
        *((wire(0.001, '<bsdf type="conductor"/>'), 0.0039), (ball(3e-4), 0.00038), (ball(0.5, LAMP), 6)),
        (group(wire(0.15, z=38), 10), 0.28),
    ],
)
def test_shapes_that_are_too_thin_are_refused(small_scene: Callable[..., Path], shape: str, held: float) -> None:
    """Wires of 0.15 mm lost 2 to 7 % of their light, and small lamps gave 3 % too much."""
    with pytest.raises(MitsimError, match=r"radius: got .* mm at a distance of .* take a larger radius") as caught:
        loaded(small_scene, (0, 0, 0), shape)
    assert float(str(caught.value).partition("holds ")[2].split()[0]) == pytest.approx(held, rel=0.1)
