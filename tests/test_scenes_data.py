"""The shipped scenes: pictures and meshes equal their recipe; light and print are where the scene files say."""

from __future__ import annotations

import importlib
import math
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mitsim.core.configuration import read_toml, shipped_path
from tests.shipped_scenes import SCENES, opened, projected

# One sheet of 128 mm at 400 mm, as the paper has it.
NAMES = ("photograph", "colour_chart", "resolution_target", "lamp_bench")
ALL = sorted(path.parent.name for path in SCENES.glob("*/scene.xml"))
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


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            name,
            marks=pytest.mark.slow if name in ("colour_chart/reflectance.png", "colour_checker/patches.xml") else (),
        )
        for name in sorted({**generate.TEXTURES, **generate.MESHES, **generate.TEXTS})
    ],
)
def test_shipped_file_is_what_its_recipe_makes(name: str) -> None:
    assert generate.difference(SCENES, name) is None


def test_every_file_of_a_scene_has_a_recipe() -> None:
    shipped = {str(path.relative_to(SCENES)) for path in SCENES.rglob("*.*") if path.suffix in (".png", ".ply")}
    assert shipped == {*generate.TEXTURES, *generate.MESHES}
    parts = {str(path.relative_to(SCENES)) for path in SCENES.rglob("*.xml") if path.name != "scene.xml"}
    assert parts == set(generate.TEXTS)


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


@pytest.fixture(params=NAMES)
def scene(request: pytest.FixtureRequest) -> tuple[str, Any, Any]:
    return request.param, *opened(request.param)


@pytest.fixture(params=ALL)
def any_scene(request: pytest.FixtureRequest) -> tuple[str, Any, Any]:
    return request.param, *opened(request.param)


def test_window_lands_squarely_on_the_sheet(scene: tuple[str, Any, Any]) -> None:
    """Pixel (0, 0) at x = y = +60 mm, top left seen along +z; E = pi scale / z^2 inside, none outside."""
    _, mi, loaded = scene
    inside = 59.99
    x, y = [inside, -inside, inside, -inside, 0.0], [inside, inside, -inside, -inside, 0.0]
    uv, irradiance = projected(mi, loaded, x, y, 400.0)
    canvas_column, canvas_row = 256 * uv[0], 128 * uv[1]
    assert np.allclose(canvas_column, 128 + (60 - np.array(x)) / 120 * 128, atol=1e-3)
    assert np.allclose(canvas_row, (60 - np.array(y)) / 120 * 128, atol=1e-3)
    assert np.allclose(irradiance, math.pi * POWER / 400**2, rtol=1e-4)  # float32 geometry
    outside = projected(mi, loaded, [60.01, -60.01, 0.0, 0.0], [0.0, 0.0, 60.01, -60.01], 400.0)[1]
    assert np.all(outside == 0.0)


@pytest.mark.parametrize("name", ALL)
def test_power_follows_from_the_projector_file(name: str) -> None:
    """E = flux / efficacy / area of the picture at 400 mm, 16:9, and scale = E z^2 / pi, z in mm.

    Five digits are written in the scene; the file's own radiant flux, rounded to three, must agree to those.
    """
    text = (SCENES / name / "scene.xml").read_text(encoding="utf-8")
    written = re.search(r'<default name="projector_scale" value="([^"]+)"', text)
    assert written is not None and float(written[1]) == POWER
    light = read_toml(shipped_path("calibration", "mp_cl1.toml"))
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
