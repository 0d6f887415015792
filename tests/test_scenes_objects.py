"""The shipped scenes with depth, gloss or another light: objects, shadows and highlights are where their files say."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.core.environment import load_variant
from tests.shipped_scenes import SCENES, opened

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
