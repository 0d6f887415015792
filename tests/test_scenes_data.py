"""The shipped scenes: pictures and meshes equal their recipe; light and objects are where the scene files say."""

from __future__ import annotations

import importlib
import math
import re
import sys
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mitsim.core.configuration import read_toml, shipped
from mitsim.core.environment import load_variant

SCENES = Path(__file__).parents[1] / "scenes"
# One sheet of 128 mm at 400 mm, as the paper has it.
NAMES = ("photograph", "colour_chart", "resolution_target", "lamp_bench")
# Nearest and farthest z [mm] that the camera sees inside the projector's window, as the scene files say.
DEPTHS = {
    **dict.fromkeys(NAMES, (400.0, 400.0)),
    "corner": (390.0, 450.0),
    "cards": (370.0, 430.0),
    "mirror": (397.8, 405.0),
}
POWER = 151250.0  # scale of the scenes' projector


def _generator() -> ModuleType:
    """scenes/generate.py, which imports its neighbours as a script does."""
    sys.path.insert(0, str(SCENES))
    try:
        return importlib.import_module("generate")
    finally:
        sys.path.remove(str(SCENES))


generate = _generator()


def _reflectance(name: str) -> np.ndarray:
    return np.asarray(Image.open(SCENES / name / "reflectance.png")) / 255.0


def _projector_pixels(name: str) -> np.ndarray:
    """(128, 128) exact mean reflectance over each projector pixel: the sheet's central 120 of 128 mm."""
    sheet = _reflectance(name)
    texels = np.arange(sheet.shape[0] + 1) * 128.0 / sheet.shape[0] - 64.0
    edges = np.linspace(-60.0, 60.0, 129)
    low, high = np.maximum(edges[:-1, None], texels[:-1]), np.minimum(edges[1:, None], texels[1:])
    share = np.maximum(high - low, 0.0) / (120.0 / 128.0)
    assert np.allclose(share.sum(axis=1), 1.0)
    return share @ sheet @ share.T


@pytest.mark.parametrize("name", sorted(generate.TEXTURES))
def test_shipped_texture_is_what_its_recipe_makes(name: str) -> None:
    assert generate.difference(SCENES, name) is None


def test_every_texture_of_a_scene_has_a_recipe() -> None:
    shipped = {str(path.relative_to(SCENES)) for path in SCENES.rglob("*.png")}
    assert shipped == set(generate.TEXTURES)
    assert {path.parent.name for path in SCENES.glob("*/scene.xml")} == set(DEPTHS)


def test_a_changed_texture_is_noticed(tmp_path: Path) -> None:
    name = "colour_chart/projector.png"
    (tmp_path / "colour_chart").mkdir()
    assert "missing" in str(generate.difference(tmp_path, name))
    canvas = generate.projector_window()
    canvas[5, 7] = 1
    Image.fromarray(canvas).save(tmp_path / name)
    assert "in 1 pixels" in str(generate.difference(tmp_path, name))
    generate.write(tmp_path, name)
    assert generate.difference(tmp_path, name) is None


@pytest.mark.parametrize("name", NAMES)
def test_reflectances_are_physical_and_no_symmetry_hides_a_flip(name: str) -> None:
    pixels = _projector_pixels(name)
    assert pixels.min() > 0.02 and pixels.max() < 0.91
    views = [np.rot90(flipped, turns) for flipped in (pixels, pixels.T) for turns in range(4)][1:]
    assert min(float(np.sqrt(np.mean((view - pixels) ** 2))) for view in views) > 0.05


def test_chart_patches_keep_the_grey_scale_in_order() -> None:
    # Last row of a ColorChecker: white, four ever darker greys, black. Patches are 74 texels apart.
    greys = _reflectance("colour_chart")[103 + 10 + 3 * 74 + 32, 29 + 10 + 32 + 74 * np.arange(6)]
    assert np.all(np.diff(greys) < 0)
    # N. Ohta's flat greys: 0.89 (white 9.5) and 0.03 (black 2), to 8 bits.
    assert greys[0] == pytest.approx(0.888, abs=0.003) and greys[-1] == pytest.approx(0.034, abs=0.003)


def test_group_5_is_the_last_that_the_projector_grid_resolves() -> None:
    white, black = np.rint(np.array([0.90, 0.04]) * 255) / 255
    pixels = _projector_pixels("resolution_target")
    # Group 5 starts at pixel row 3 + 2 x 31 + 8, column 3; a bar is one pixel: nine white, eight black.
    vertical = pixels[73:90, 3:20]
    assert np.allclose(vertical, np.where(np.arange(17) % 2 == 0, white, black))
    # Horizontal bars lie right of them, two pixels apart.
    assert np.allclose(pixels[73:90, 22:39], vertical.T)
    # Group 2, 0.75 mm a line pair: averaged over pixels of 0.94 mm, less than half the contrast is left.
    fine = pixels[106:120, 5:18]
    assert np.ptp(fine) / (fine.max() + fine.min()) < 0.5 * (white - black) / (white + black)


@cache
def _loaded(name: str) -> tuple[Any, Any]:
    """Mitsuba and the scene, through mitsim's own checks."""
    mi = load_variant("llvm_ad_mono")
    from mitsim.scene.load import load_scene
    from mitsim.transport.lensless import register

    register()
    return mi, load_scene(SCENES / name / "scene.xml").scene


@pytest.fixture(params=NAMES)
def scene(request: pytest.FixtureRequest) -> tuple[str, Any, Any]:
    return request.param, *_loaded(request.param)


@pytest.fixture(params=sorted(DEPTHS))
def any_scene(request: pytest.FixtureRequest) -> tuple[str, Any, Any]:
    return request.param, *_loaded(request.param)


def _emitter(scene: Any, kind: str) -> Any:
    (found,) = (emitter for emitter in scene.emitters() if emitter.class_name() == kind)
    return found


def _light(mi: Any, scene: Any, x: list[float], y: list[float], z: float) -> tuple[np.ndarray, np.ndarray]:
    """Projector uv (2, k) at points (x, y, z), and irradiance (k,) on the plane z = const there."""
    import drjit as dr

    point = dr.zeros(mi.SurfaceInteraction3f, len(x))
    point.p = mi.Point3f(mi.Float(x), mi.Float(y), mi.Float(z))
    sample, weight = _emitter(scene, "Projector").sample_direction(point, mi.Point2f(0.5), True)
    return np.array(sample.uv), np.array(weight[0] * dr.abs(sample.d.z))


def test_window_lands_squarely_on_the_sheet(scene: tuple[str, Any, Any]) -> None:
    """Pixel (0, 0) at x = y = +60 mm, top left seen along +z; E = pi scale / z^2 inside, none outside."""
    _, mi, loaded = scene
    inside = 59.99
    x, y = [inside, -inside, inside, -inside, 0.0], [inside, inside, -inside, -inside, 0.0]
    uv, irradiance = _light(mi, loaded, x, y, 400.0)
    canvas_column, canvas_row = 256 * uv[0], 128 * uv[1]
    assert np.allclose(canvas_column, 128 + (60 - np.array(x)) / 120 * 128, atol=1e-3)
    assert np.allclose(canvas_row, (60 - np.array(y)) / 120 * 128, atol=1e-3)
    assert np.allclose(irradiance, math.pi * POWER / 400**2, rtol=1e-4)  # float32 geometry
    outside = _light(mi, loaded, [60.01, -60.01, 0.0, 0.0], [0.0, 0.0, 60.01, -60.01], 400.0)[1]
    assert np.all(outside == 0.0)


@pytest.mark.parametrize("name", sorted(DEPTHS))
def test_power_follows_from_the_projector_file(name: str) -> None:
    """E = flux / efficacy / area of the picture at 400 mm, 16:9, and scale = E z^2 / pi, z in mm.

    Five digits are written in the scene; the file's own radiant flux, rounded to three, must agree to those.
    """
    text = (SCENES / name / "scene.xml").read_text(encoding="utf-8")
    written = re.search(r'<default name="projector_scale" value="([^"]+)"', text)
    assert written is not None and float(written[1]) == POWER
    light = read_toml(shipped("calibration", "mp_cl1.toml"))
    watts = light["luminous_flux_lm"] / light["luminous_efficacy_lm_per_w"]
    width_m = 0.4 / light["throw_ratio"]
    irradiance = watts / (width_m * width_m * 9 / 16)
    assert pytest.approx(irradiance * 400**2 / math.pi, rel=5e-5) == POWER
    assert light["radiant_flux_w"] == pytest.approx(watts, rel=5e-3)


def test_print_is_upright_and_not_mirrored(scene: tuple[str, Any, Any]) -> None:
    """Texel (row, column) of the PNG is met at y = 64 - row pitch, x = 64 - column pitch, face on."""
    import drjit as dr

    name, mi, loaded = scene
    sheet = _reflectance(name)
    size = sheet.shape[0]
    rng = np.random.default_rng(3)
    row, column = rng.integers(0, size, (2, 400))
    x, y = 64 - (column + 0.5) * 128 / size, 64 - (row + 0.5) * 128 / size
    direction = dr.normalize(mi.Vector3f(mi.Float(x), mi.Float(y), mi.Float(400.0)))
    hit = loaded.ray_intersect(mi.Ray3f(mi.Point3f(0.0), direction))
    assert np.allclose(np.array(hit.p)[2], 400.0, atol=1e-3)
    assert np.all(np.array(hit.wi)[2] > 0), "the sheet's front faces the camera"
    seen = np.array(hit.bsdf().eval_diffuse_reflectance(hit)[0])
    assert np.allclose(seen, sheet[row, column], atol=1e-6)


def test_camera_is_the_papers(any_scene: tuple[str, Any, Any]) -> None:
    geometry = any_scene[2].sensors()[0].geometry
    wanted = {
        "pixels": 512,
        "pixel_pitch": 0.01172,
        "mask": "separable",
        "mask_order": 9,
        "mask_feature": 0.06,
        "mask_distance": 2.0,
        "scene_distance": 400.0,
        "fov": 20.0,
    }
    assert {name: getattr(geometry, name) for name in wanted} == wanted


def _cast(mi: Any, scene: Any, origin: tuple[float, float, float], tan: np.ndarray) -> tuple[Any, np.ndarray]:
    """Intersections of rays from `origin` along (x/z, y/z) = `tan` (2, k), and their points (3, k)."""
    import drjit as dr

    direction = dr.normalize(mi.Vector3f(mi.Float(tan[0]), mi.Float(tan[1]), 1.0))
    hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(*origin), direction))
    return hit, np.array(hit.p)


def _grid(low: float, high: float, count: int = 201) -> np.ndarray:
    return np.linspace(low, high, count)


def test_window_falls_on_objects_that_the_camera_may_see(any_scene: tuple[str, Any, Any]) -> None:
    """Every projector pixel meets something face on, inside the field stop, at the depths that the scene file says."""
    name, mi, loaded = any_scene
    if name == "keystone":
        pytest.skip("its projector is turned; it has a test of its own")
    # The window as seen from the projector at (60, 0, 0): x/z from -0.3 to 0, y/z within 0.15.
    tan = np.stack(np.meshgrid(_grid(-0.2999, -0.0001), _grid(-0.1499, 0.1499))).reshape(2, -1)
    hit, point = _cast(mi, loaded, (60.0, 0.0, 0.0), tan)
    assert np.all(np.array(hit.is_valid()))
    assert np.all(np.array(hit.wi)[2] > 0), "fronts face the light"
    assert np.abs(point[:2] / point[2]).max() < math.tan(math.radians(10))
    near, far = DEPTHS[name]
    assert point[2].min() == pytest.approx(near, abs=0.5) and point[2].max() == pytest.approx(far, abs=0.5)


def test_nothing_but_a_lamp_is_closer_than_300_mm(any_scene: tuple[str, Any, Any]) -> None:
    _, _, loaded = any_scene
    for shape in loaded.shapes():
        if not shape.is_emitter():
            assert shape.bbox().min.z > 300.0


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


def test_corner_walls_meet_at_a_right_angle() -> None:
    mi, loaded = _loaded("corner")
    hit, point = _cast(mi, loaded, (0.0, 0.0, 0.0), np.array([[0.08, -0.08, 0.0001, -0.0001], [0.0] * 4]))
    normal = np.array(hit.n)
    assert normal[:, 0] == pytest.approx([-math.sqrt(0.5), 0, -math.sqrt(0.5)], abs=1e-6)
    assert normal[:, 1] == pytest.approx([math.sqrt(0.5), 0, -math.sqrt(0.5)], abs=1e-6)
    assert point[2] == pytest.approx(450 - np.abs(point[0]), abs=1e-3)
    # Mitsuba may merge two shapes of one material into one.
    assert sum(shape.surface_area()[0] for shape in loaded.shapes()) == pytest.approx(2 * 120 * 200, rel=1e-5)


def test_near_card_hides_and_shades_the_far_one() -> None:
    """The near card's right side, x = -10 at 370, is seen at -11.62 and its shadow ends at -21.35 on the far card."""
    mi, loaded = _loaded("cards")
    x = np.array([-11.0, -12.5, -20.5, -22.0])
    seen = _cast(mi, loaded, (0.0, 0.0, 0.0), np.stack([x / 430, np.full(4, -30 / 430)]))[1][2]
    assert seen == pytest.approx([370, 430, 430, 430], abs=1e-3)
    lit = _cast(mi, loaded, (60.0, 0.0, 0.0), np.stack([(x - 60) / 430, np.full(4, -30 / 430)]))[1][2]
    assert lit == pytest.approx([370, 370, 370, 430], abs=1e-3)


def test_mirror_shows_the_projector_at_its_middle() -> None:
    """A ray from the sensor's centre to the mirror's middle goes on to the pinhole at (60, 0, 0)."""
    mi, loaded = _loaded("mirror")
    hit, point = _cast(mi, loaded, (0.0, 0.0, 0.0), np.zeros((2, 1)))
    assert point[:, 0] == pytest.approx([0, 0, 400], abs=1e-3)
    sample, weight = hit.bsdf().sample(mi.BSDFContext(), hit, mi.Float(0.5), mi.Point2f(0.5))
    assert mi.has_flag(sample.sampled_type, mi.BSDFFlags.DeltaReflection)[0] and weight[0][0] == pytest.approx(0.9)
    away = np.array(hit.to_world(sample.wo))[:, 0]
    assert point[:, 0] - away * point[2, 0] / away[2] == pytest.approx([60, 0, 0], abs=0.01)
    # The image is one of 128 x 128 pixels, at the border of columns 63 and 64.
    uv, irradiance = _light(mi, loaded, [0.0], [0.0], float(point[2, 0]))
    assert 256 * uv[0] - 128 == pytest.approx(64, abs=0.01) and irradiance[0] > 0


def test_lamp_adds_a_tenth_of_the_projectors_light() -> None:
    """E at the sheet's middle: radiance x sum of cos cos / r^2 over the lamp; the plugin agrees, sampled (seed 3)."""
    import drjit as dr

    mi, loaded = _loaded("lamp_bench")
    x, z = np.meshgrid(np.arange(-199.5, 200), np.arange(220.5, 380))
    radiance = 11.7
    squared = x**2 + 600.0**2 + (400 - z) ** 2
    wanted = radiance * float((600 * (400 - z) / squared**2).sum())
    assert wanted == pytest.approx(0.1 * math.pi * POWER / 400**2, rel=2e-3)
    point = dr.zeros(mi.SurfaceInteraction3f, 1 << 16)
    point.p = mi.Point3f(0.0, 0.0, 400.0)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, 1 << 16)
    sample, weight = _emitter(loaded, "AreaLight").sample_direction(point, sampler.next_2d())
    # Directions differ little over the lamp: one value spreads by 0.4 of the mean, 2^16 of them by 0.0016.
    assert np.mean(np.array(weight[0] * -sample.d.z)) == pytest.approx(wanted, rel=0.01)
    lamp = next(shape for shape in loaded.shapes() if shape.is_emitter())
    assert lamp.bbox().min.y / lamp.bbox().max.z > math.tan(math.radians(10)), "outside the field stop"
