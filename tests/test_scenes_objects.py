"""The shipped scenes with depth, gloss or another light: objects, shadows and highlights are where their files say."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.core.environment import load_variant
from tests.shipped_scenes import SCENES, emitter, opened, projected

# Nearest and farthest z [mm] of what the projector's window meets, and the shapes that carry a print.
DEPTHS = {
    "photograph": (400.0, 400.0),
    "colour_chart": (400.0, 400.0),
    "colour_checker": (400.0, 400.0),
    "resolution_target": (400.0, 400.0),
    "lamp_bench": (400.0, 400.0),
    "keystone": (400.0, 400.0),
    "corner": (390.0, 450.0),
    "cards": (370.0, 430.0),
    "mirror": (397.8, 405.0),
    "gift_card": (397.1, 420.0),
    "metal_blade": (395.4, 420.0),
    "cookie_bag": (363.6, 450.0),
    "shelf": (341.8, 450.0),
}
PRINTED = {
    "lamp_bench": ("sheet",),
    "keystone": ("sheet",),
    "cards": ("front_card", "back_card"),
    "gift_card": ("card",),
    "metal_blade": ("blade",),
    "cookie_bag": ("bag", "box"),
}
CLOSED = ("cookie_bag/bag.ply", "cookie_bag/box.ply", "shelf/object.ply", "metal_blade/blade.ply")
POWER = 151250.0  # scale of the scenes' projector
FIELD_STOP = math.tan(math.radians(10))


@pytest.fixture(params=sorted(DEPTHS))
def any_scene(request: pytest.FixtureRequest) -> tuple[str, Any, Any]:
    return request.param, *opened(request.param)


def _shape(scene: Any, name: str) -> Any:
    (found,) = (shape for shape in scene.shapes() if shape.id() == name)
    return found


def _cast(mi: Any, scene: Any, origin: tuple[float, float, float], tan: np.ndarray) -> tuple[Any, np.ndarray]:
    """Intersections of rays from `origin` along (x/z, y/z) = `tan` (2, k), and their points (3, k)."""
    import drjit as dr

    direction = dr.normalize(mi.Vector3f(mi.Float(tan[0]), mi.Float(tan[1]), 1.0))
    hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(*origin), direction))
    return hit, np.array(hit.p)


def _square(columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(2, k) all pairs of two coordinates."""
    return np.stack(np.meshgrid(columns, rows)).reshape(2, -1)


def test_depths_of_every_scene_are_known() -> None:
    others = {"compact_disc", "highlight"}  # have tests of their own
    assert {path.parent.name for path in SCENES.glob("*/scene.xml")} - others == set(DEPTHS)


def test_window_falls_on_objects_that_the_camera_may_see(any_scene: tuple[str, Any, Any]) -> None:
    """Every projector pixel meets something face on, inside the field stop, at the depths that the scene file says."""
    import drjit as dr

    name, mi, loaded = any_scene
    # The window from the projector at (60, 0, 0): x/z from -0.3 to 0, y/z within 0.15. The keystone's own is rotated,
    # but covers the same part of its sheet, less than 1 mm from the sides of this one.
    tan = _square(np.linspace(-0.2999, -0.0001, 201), np.linspace(-0.1499, 0.1499, 201))
    hit, point = _cast(mi, loaded, (60.0, 0.0, 0.0), tan)
    assert np.all(np.array(hit.is_valid()))
    # The bag: interpolated normals turn from the light at its silhouette, and one ray in a million slips between two of
    # its triangles to the back inside.
    least = 0.9995 if name == "cookie_bag" else 1.0
    assert np.mean(np.array(dr.dot(hit.n, mi.Point3f(60, 0, 0) - hit.p)) > 0) >= least, "fronts face the light"
    assert np.mean(np.array(hit.wi)[2] > 0) >= least
    assert np.abs(point[:2] / point[2]).max() < FIELD_STOP
    near, far = DEPTHS[name]
    assert point[2].min() == pytest.approx(near, abs=0.2) and point[2].max() == pytest.approx(far, abs=0.2)


def test_nothing_but_a_lamp_is_closer_than_300_mm(any_scene: tuple[str, Any, Any]) -> None:
    """Cast over the field stop and a little more; and no shape's box reaches there either."""
    _, mi, loaded = any_scene
    side = np.linspace(-0.18, 0.18, 101)
    hit, point = _cast(mi, loaded, (0.0, 0.0, 0.0), _square(side, side))
    valid = np.array(hit.is_valid())
    assert valid.mean() > 0.7 and point[2][valid].min() > 300.0
    for shape in loaded.shapes():
        box = shape.bbox()
        assert box.valid() and (shape.is_emitter() or box.min.z > 300.0)


@pytest.mark.parametrize(("name", "shape"), [(name, shape) for name, shapes in PRINTED.items() for shape in shapes])
def test_every_print_is_upright_and_not_mirrored(name: str, shape: str) -> None:
    """Seen by the camera, u grows to the right (-x) and v downwards (-y): a bitmap lies as it is drawn."""
    mi, loaded = opened(name)
    side = np.linspace(-0.17, 0.17, 120)
    tan, step = _square(side, side), 2e-4
    places = []
    for shift in ((0, 0), (-step, 0), (0, -step)):
        hit, _ = _cast(mi, loaded, (0.0, 0.0, 0.0), tan + np.array(shift)[:, None])
        places.append((np.array(hit.shape == mi.ShapePtr(_shape(loaded, shape))), np.array(hit.uv)))
    (on, uv), (on_right, right), (on_down, down) = places
    # Steps across an edge of the box or of the blade are left out.
    near = (np.abs(right - uv).max(axis=0) < 0.02) & (np.abs(down - uv).max(axis=0) < 0.02)
    use = on & on_right & on_down & near
    assert use.sum() > 500
    assert np.all((right - uv)[0, use] > 0) and np.all((down - uv)[1, use] > 0)
    assert uv[:, use].min() >= 0 and uv[:, use].max() <= 1


@pytest.mark.parametrize("name", CLOSED)
def test_meshes_are_closed_and_turned_outward(name: str) -> None:
    """Every edge is run through once in each direction, and the volume by the divergence theorem is positive."""
    mi = load_variant("llvm_ad_mono")
    parameters = mi.traverse(mi.load_dict({"type": "ply", "filename": str(SCENES / name)}))
    points = np.array(parameters["vertex_positions"]).reshape(-1, 3)
    faces = np.array(parameters["faces"]).reshape(-1, 3)
    _, same = np.unique(points, axis=0, return_inverse=True)
    corners = same.ravel()[faces]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert {tuple(edge) for edge in edges} == {tuple(edge) for edge in edges[:, ::-1]}
    a, b, c = (points[faces[:, k]] for k in range(3))
    volume = float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum()) / 6
    # Box: 44 x 48 x 36. Blade: section 26 x 3.2 + 12 x 3.2 / 2, times its length at each height. Bag: to 10 %,
    # 2 x 16 x (8/5)^2 / 4 x 73 x 88 + seams and slack.
    flat = 3.2 * (92 * 26 - 0.5 * (26 * 12 + 26**2 / 2))
    bevel = 3.2 / 2 * 12 * (92 - 0.5 * 8)
    wanted = {"box": 44 * 48 * 36, "object": 938 / 1024 * 36 / 48, "blade": flat + bevel, "bag": 32 * 0.64 * 73 * 88}[
        Path(name).stem
    ]
    assert volume == pytest.approx(wanted, rel=0.1 if "bag" in Path(name).stem else 1e-4)


def _albedos(mi: Any, bsdf: Any, uv: np.ndarray, cosine: float, count: int = 1 << 14) -> np.ndarray:
    """(k,) share of light from the angle `cosine` that `bsdf` sends back at the texture points `uv` (2, k)."""
    import drjit as dr

    points = uv.shape[1]
    lanes = np.repeat(np.arange(points), count)
    interaction = dr.zeros(mi.SurfaceInteraction3f, lanes.size)
    interaction.uv = mi.Point2f(mi.Float(uv[0][lanes]), mi.Float(uv[1][lanes]))
    interaction.wi = mi.Vector3f(math.sqrt(1 - cosine**2), 0.0, cosine)
    interaction.n = mi.Normal3f(0.0, 0.0, 1.0)
    interaction.sh_frame = mi.Frame3f(interaction.n)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(17, lanes.size)
    sample, weight = bsdf.sample(mi.BSDFContext(), interaction, sampler.next_1d(), sampler.next_2d())
    values = np.where(np.array(sample.pdf) > 0, np.array(weight[0]), 0.0)  # one value from a constant mirror
    return np.broadcast_to(values, lanes.shape).reshape(points, count).mean(axis=1)


def test_no_material_returns_more_light_than_it_gets(any_scene: tuple[str, Any, Any]) -> None:
    """A white furnace: 2^14 sampled directions for each of 8 texture points and 4 angles, seed 17.

    The brightest surface of a scene returns 0.9; a sampled weight spreads by less than 1 around its mean, so that the
    mean's standard error is below 0.008 and 1.001 is reached by chance with more than 10 of them only.
    """
    _, mi, loaded = any_scene
    uv = np.random.default_rng(5).random((2, 8))
    for shape in loaded.shapes():
        for cosine in (1.0, 0.8, 0.4, 0.1):
            albedo = _albedos(mi, shape.bsdf(), uv, cosine)
            assert np.all(np.isfinite(albedo)) and albedo.min() >= 0 and albedo.max() < 1.001


def test_lamp_adds_a_tenth_of_the_projectors_light() -> None:
    """E at the sheet's middle: radiance x sum of cos cos / r^2 over the lamp; the plugin agrees, sampled (seed 3)."""
    import drjit as dr

    mi, loaded = opened("lamp_bench")
    x, z = np.meshgrid(np.arange(-199.5, 200), np.arange(220.5, 380))
    radiance = 11.7
    squared = x**2 + 600.0**2 + (400 - z) ** 2
    wanted = radiance * float((600 * (400 - z) / squared**2).sum())
    assert wanted == pytest.approx(0.1 * math.pi * POWER / 400**2, rel=2e-3)
    point = dr.zeros(mi.SurfaceInteraction3f, 1 << 16)
    point.p = mi.Point3f(0.0, 0.0, 400.0)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, 1 << 16)
    sample, weight = emitter(loaded, "AreaLight").sample_direction(point, sampler.next_2d())
    # Directions differ little over the lamp: one value spreads by 0.4 of the mean, 2^16 of them by 0.0016.
    assert np.mean(np.array(weight[0] * -sample.d.z)) == pytest.approx(wanted, rel=0.01)
    lamp = next(shape for shape in loaded.shapes() if shape.is_emitter())
    assert lamp.bbox().min.y / lamp.bbox().max.z > math.tan(math.radians(10)), "outside the field stop"


def test_keystone_lands_as_a_trapezium() -> None:
    """Corners by the rays of a pinhole that looks at (0, 0, 400), 60 mm of window at 404.475 mm; E there."""
    mi, loaded = opened("keystone")
    far = math.hypot(60, 400)
    forward, left = np.array([-60, 0, 400]) / far, np.array([400, 0, 60]) / far
    for column, row in ((0, 0), (127, 0), (0, 127), (127, 127), (40, 90)):
        offset = 60 / far * (1 - 2 * (np.array([column, row]) + 0.5) / 128)
        ray = forward + offset[0] * left + offset[1] * np.array([0, 1, 0])
        point = np.array([60, 0, 0]) + ray * 400 / ray[2]
        uv, irradiance = projected(mi, loaded, [point[0]], [point[1]], 400.0)
        assert 128 * uv[:, 0] == pytest.approx([column + 0.5, row + 0.5], abs=0.01)
        # Intensity pi scale / cos^3 of the angle to the projector's axis; E = I cos / r^2.
        long = float(np.linalg.norm(ray))
        distance = 400 / (ray[2] / long)
        wanted = math.pi * POWER * long**3 * (ray[2] / long) / distance**2
        assert irradiance[0] == pytest.approx(wanted, rel=1e-4)
    # The corners that the scene file states.
    from mitsim.scene.load import locate_projector

    grid = locate_projector("keystone", emitter(loaded, "Projector"), loaded.sensors()[0])
    assert np.array(grid.column_tan) * 400 == pytest.approx([-59.35, 62.05], abs=0.01)
    assert np.array(grid.row_tan) * 400 == pytest.approx([-61.37, 61.37], abs=0.01) and grid.keystone > 2.5
