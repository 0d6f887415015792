"""A projector of finite aperture: its limit, its blur circle and its light, against the pinhole and geometry.

Boards are seen from the camera's own position by a Mitsuba pinhole camera at 64 x 64 pixels. Renderings use fixed
seeds; errors of means come from the spread between pixels or passes, gates are five of them unless stated.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsim.api.bench import open_bench
from mitsim.core.errors import MitsimError
from mitsim.transport import plugins
from mitsim.transport.plugins import lens, lensless, materials
from tests.aperture import aperture_scene_parts
from tests.conftest import write_png
from tests.unit.transport.closed_forms import stock_projector

PICTURE = """<string name="filename" value="picture.png"/> <boolean name="raw" value="true"/>
    <string name="filter_type" value="nearest"/> <string name="wrap_mode" value="clamp"/>"""
BALL = '<shape type="sphere"><point name="center" x="0" y="0" z="370"/><float name="radius" value="15"/>{}</shape>'


def example(manual: str | None, plugin: str) -> str:
    """The block under "XML"; the dots of a texture stand for the picture that formats.md asks of a projector."""
    blocks = re.findall(r"^XML[^\n]*::\n\n((?:(?: {4}[^\n]*)?\n)+)", manual or "", flags=re.M)
    (block,) = (block for block in blocks if f'type="{plugin}"' in block)
    return textwrap.dedent(block).replace(" ... ", PICTURE)


def rendered(path: Path) -> tuple[float, float]:
    """Mean irradiance [W m^-2] of a scene, and its standard error."""
    write_png(path.with_name("picture.png"), np.full((16, 32), 255))
    result = open_bench(path, for_render=True).render("reference", 64)
    assert np.isfinite(result.mean).all()
    return float(result.mean.mean()), float(np.sqrt(np.square(result.error).sum()) / result.error.size)


@pytest.mark.parametrize("plugin", [materials.GLASS, materials.GRATING, lensless.PLUGIN])
def test_the_example_of_a_manual_loads(plugin: str, small_scene: Callable[..., Path]) -> None:
    """As written; tests/unit/scene/test_colours_of_scenes.py renders all plugins."""
    xml = example((lensless if plugin == lensless.PLUGIN else materials).__doc__, plugin)
    path = small_scene(extra="" if xml.startswith("<sensor") else BALL.format(xml) if xml.startswith("<bsdf") else xml)
    if xml.startswith("<sensor"):
        path.write_text(re.sub(r"<sensor.*?</sensor>", xml, path.read_text(), flags=re.S))
    open_bench(path, for_render=True)


def test_the_example_of_the_lens_casts_the_stock_projectors_light(small_scene: Callable[..., Path]) -> None:
    """In the place of a stock projector whose picture is as white, and lights as much: a ratio of their scales.

    Gate: 5 standard errors of both means. (Seen failing: refused inside of the disk that the manual puts it in.)
    """
    path = small_scene(pixels=16, mask="open", canvas=np.full((16, 32), 255))
    stock, of_stock = rendered(path)
    path.write_text(re.sub(r"<emitter.*?</emitter>", example(lens.__doc__, lens.PLUGIN), path.read_text(), flags=re.S))
    found, of_lens = rendered(path)
    expected = 151250 / 111000 * stock
    assert abs(found - expected) < 5 * np.hypot(of_lens, 151250 / 111000 * of_stock) < 0.05 * expected


# -------- aperture

SCALE, ALBEDO, N = 111000.0, 0.5, 16


@pytest.fixture(autouse=True)
def plugin(variant: str) -> None:
    plugins.register()


def stock(place: tuple[float, float, float] = (60, 0, 0), turn: float = 0.0, canvas: np.ndarray | None = None):
    return stock_projector(N, SCALE, place, turn, canvas)


def board(z: float, bsdf: dict | None = None) -> dict:
    place = mi.ScalarAffineTransform4f().translate([0, 0, z]).rotate([0, 1, 0], 180).scale([600, 600, 1])
    grey = {"type": "diffuse", "reflectance": {"type": "uniform", "value": ALBEDO}}
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf or grey}


def picture(light: dict, z: float, half: float, x: float = 0.0, spp: int = 256, **scene: dict) -> np.ndarray:
    """(64, 64) irradiance on a board at z, seen squarely over x +- half, y +- half; row 0 at +y, column 0 at +x."""
    run = mi.ScalarAffineTransform4f().look_at(origin=[x, 0, z - 100], target=[x, 0, z], up=[0, 1, 0])
    film = {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    fov = float(np.degrees(2 * np.arctan(half / 100)))
    camera = {"type": "perspective", "fov": fov, "to_world": run, "film": film}
    path = {"type": "path", "max_depth": 2}
    parts = {"type": "scene", "integrator": path, "camera": camera, "board": board(z), **light, **scene}
    return np.array(mi.render(mi.load_dict(parts), spp=spp, seed=3), dtype=np.float64)[..., 0] * np.pi / ALBEDO


@pytest.mark.parametrize("radius", [0.01, 5.0])
@pytest.mark.parametrize("z", [400.0, 700.0])
def test_an_even_picture_casts_the_stock_projectors_irradiance(radius: float, z: float) -> None:
    """E = pi scale / z^2 inside the picture, at any aperture, in and out of focus; off the axis as well as on it."""
    whole = stock(canvas=np.ones((N, 2 * N)))
    found = picture(aperture_scene_parts(whole, radius, 400.0), z, 40.0)
    expected = np.pi * SCALE / z**2
    # Nothing is left to chance but the place on the aperture, and there L cos^2 / r^2 is constant.
    assert found == pytest.approx(np.full((64, 64), expected), rel=1e-4)
    assert picture({"light": whole}, z, 40.0) == pytest.approx(found, rel=1e-4)


def test_a_small_aperture_is_the_pinhole() -> None:
    """The same picture of random pixels, out of focus, turned: blur of 0.01 mm on pixels of 7 mm."""
    texels = (np.random.default_rng(2).random((N, 2 * N)) > 0.5).astype(float)
    light = stock(turn=4.0, canvas=texels)
    sharp = picture({"light": light}, 500.0, 60.0, 20.0)
    found = picture(aperture_scene_parts(light, 0.02, 250.0), 500.0, 60.0, 20.0)
    assert 0.2 < (sharp > 0.5 * sharp.max()).mean() < 0.8
    # Both use the same sequence of random numbers for the camera; the blur touches 1 path in 500 or so.
    assert np.linalg.norm(found - sharp) < 1e-2 * np.linalg.norm(sharp)


def circle_below(distance: np.ndarray, radius: float) -> np.ndarray:
    """Part of a disk on one side of a line at a distance from its centre (1/2 through the centre)."""
    s = np.clip(distance / radius, -1, 1)
    return 0.5 + (np.arcsin(s) + s * np.sqrt(1 - s**2)) / np.pi


@pytest.mark.parametrize(
    ("z", "focus"), [(800.0, 400.0), pytest.param(400.0, 400.0, marks=pytest.mark.slow), (200.0, 400.0)]
)
def test_an_edge_spreads_by_the_blur_circle(z: float, focus: float) -> None:
    """The window's left edge, texel 16 of 32, is on the projector's axis. A point of the picture is a disk of radius
    a |z - focus| / focus there, so the edge is the disk's part on one side."""
    radius = 4.0
    found = picture(aperture_scene_parts(stock(), radius, focus), z, 6.0, 60.0, spp=1024).mean(axis=0)
    edges = 60 + (32 - np.arange(65)) * 12 / 64  # x falls with the column
    fine = (edges[:-1, None] + (edges[1:] - edges[:-1])[:, None] * (np.arange(32) + 0.5) / 32) - 60
    blur = radius * abs(z - focus) / focus
    lit = circle_below(-fine, blur) if blur else (fine < 0).astype(float)
    # 64 x 1024 paths a column: a standard deviation of 0.5 / 256 at most, times 5.
    assert np.abs(found / (np.pi * SCALE / z**2) - lit.mean(axis=1)).max() < 5 * 0.5 / 256
    assert blur == 0 or (np.abs(lit - 0.5) < 0.49).any()


def photographed(light: dict, bsdf: dict, integrator: str = "path", spp: int = 256, seed: int = 0) -> np.ndarray:
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    camera = {"type": "mitsim_lensless", "mask": "open", "film": film, "pixel_pitch": 0.1875}
    scene = {"type": "scene", "integrator": {"type": integrator}, "camera": camera, "mirror": board(400, bsdf), **light}
    return np.array(mi.render(mi.load_dict(scene), spp=spp, seed=seed), dtype=np.float64)[..., 0]


def test_the_reference_finds_a_mirrors_light_now() -> None:
    """A perfect mirror shows the aperture: hit by chance only, yet E = pi scale / 800^2, where the pinhole gave 0."""
    light = stock()
    found = photographed(aperture_scene_parts(light, 20.0, 400.0), {"type": "conductor"}, spp=2048)
    expected = np.pi * SCALE / 800**2
    error = found.std(ddof=1) / 32
    assert 5 * error < 0.05 * expected
    # The blur circle of 20 mm stays clear of the window's edges for all of the sensor.
    assert abs(found.mean() - expected) < 5 * error
    assert not photographed({"light": light}, {"type": "conductor"}).any()


@pytest.mark.parametrize(("name", "value"), [("focus", 0.0), ("fov", 180.0), ("focus", None), ("irradiance", None)])
def test_bad_parameters_of_the_plugin_are_refused(name: str, value: float | None) -> None:
    disk = aperture_scene_parts(stock(), 1.0, 400.0)["projector_aperture"]
    if value is None:
        del disk["emitter"][name]
    else:
        disk["emitter"][name] = value
    with pytest.raises((MitsimError, RuntimeError), match=rf"mitsim_projector: {name} is"):
        mi.load_dict({"type": "scene", "disk": disk})
