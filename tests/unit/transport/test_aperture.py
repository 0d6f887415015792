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
from mitsim.transport.plugins.lens import Diffuser, Relief, point_spread, random_relief
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


@pytest.mark.parametrize("plugin", [materials.GLASS, materials.GRATING, lensless.PLUGIN, lens.PLUGIN])
def test_the_example_of_a_manual_loads(plugin: str, small_scene: Callable[..., Path]) -> None:
    """As written; tests/unit/scene/test_colours_of_scenes.py renders all plugins."""
    manuals = {lensless.PLUGIN: lensless, lens.PLUGIN: lens}
    xml = example(manuals.get(plugin, materials).__doc__, plugin)
    path = small_scene(extra=BALL.format(xml) if xml.startswith("<bsdf") else "")
    tag = {"<sensor": "sensor", "<shape ": "emitter"}.get(xml[:7])
    if tag:
        path.write_text(re.sub(rf"<{tag}.*?</{tag}>", xml, path.read_text(), flags=re.S))
    write_png(path.with_name("picture.png"), np.full((16, 32), 255))
    open_bench(path, for_render=True)


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


@pytest.mark.parametrize(("name", "value"), [("focus", 0.0), ("fov", 180.0), ("focus", None), ("irradiance", None)])
def test_bad_parameters_of_the_plugin_are_refused(name: str, value: float | None) -> None:
    disk = aperture_scene_parts(stock(), 1.0, 400.0)["projector_aperture"]
    if value is None:
        del disk["emitter"][name]
    else:
        disk["emitter"][name] = value
    with pytest.raises((MitsimError, RuntimeError), match=rf"mitsim_projector: {name} is"):
        mi.load_dict({"type": "scene", "disk": disk})


# -------- Light behind a diffuser
#  Light behind a diffuser against ray density in closed form, from reliefs that are sums of cosines written out here.
#
# A ray at x lands at X(x) = x + d (n - 1) grad h(x), for small slopes. Where no two rays land at one place, the
# irradiance there is T / det(1 + d (n - 1) Hess h), T being the transmittance of two faces; where they cross, it is the
# sum over all x. The form leaves out what is of second order in slopes (exact refraction, and the height h beside d):
# 0.02^2 and 0.01 mm / 8 mm, together below 2e-3. Fixed seeds. Rays are one in each cell of a grid, so that only cells
# on an area's edge count at random: of N rays, the square root of 4 sqrt(N) / 6.

pytestmark = pytest.mark.usefixtures("variant")
SIDE, DISTANCE, INDEX = 3.0, 8.0, 1.5
FACES = (1 - ((INDEX - 1) / (INDEX + 1)) ** 2) ** 2
"""Transmittance at normal incidence; slopes of 0.02 change it by their fourth power."""
WAVES = np.array([[2, 1, 0.3, 1.0], [-1, 3, 1.1, 0.8], [3, 2, 2.0, 0.6], [1, -2, 4.0, 1.0], [-3, 1, 5.0, 0.7]])
"""Periods along x and y of the side, phase, and relative curvature."""


def derivatives(x: np.ndarray, y: np.ndarray, strength: float) -> list[np.ndarray]:
    """h, its first and its second derivatives (xx, yy, xy) at points; ``strength`` is the largest curvature's
    d (n - 1) times."""
    parts = [np.zeros(np.broadcast(x, y).shape) for _ in range(6)]
    for along, across, phase, share in WAVES:
        u, v = 2 * np.pi * along / SIDE, 2 * np.pi * across / SIDE
        size = strength * share / WAVES[:, 3].sum() / ((u * u + v * v) * DISTANCE * (INDEX - 1))
        c, s = np.cos(u * x + v * y + phase), np.sin(u * x + v * y + phase)
        for part, term in zip(parts, (c, -u * s, -v * s, -u * u * c, -v * v * c, -u * v * c), strict=True):
            part += size * term
    return parts


def sheet(strength: float) -> Diffuser:
    across = np.linspace(-SIDE / 2, SIDE / 2, 181)
    height, slope_x, slope_y = derivatives(across[:, None], across[None, :], strength)[:3]
    return Diffuser(Relief(SIDE, height, slope_x, slope_y), INDEX, DISTANCE)


def test_without_crossing_rays_the_light_is_one_over_the_jacobian() -> None:
    """Curvatures of 0.6 at most: each pixel's rays come from one x, found by Newton's method.

    32 x 32 pixels of the middle 1.92 mm, 144 points and 105 rays in each: counting leaves 2.5e-2 of a pixel, 1.1e-3 of
    blocks of 8 x 8. Measured: 2.6e-2 and 1.2e-3, rms, with values of 0.57 to 1.39.
    """
    pitch, strength = 0.06, 0.6
    light = point_spread(sheet(strength), (32, 32), pitch, rays=512)
    offsets = ((np.arange(32 * 12) + 0.5) / 12 - 16) * pitch
    target_y, target_x = -offsets[:, None], -offsets[None, :]
    x, y = np.broadcast_arrays(target_x, target_y)
    for _ in range(12):
        _, a, b, xx, yy, xy = (DISTANCE * (INDEX - 1) * part for part in derivatives(x, y, strength))
        miss_x, miss_y = x + a - target_x, y + b - target_y
        determinant = (1 + xx) * (1 + yy) - xy * xy
        x = x - ((1 + yy) * miss_x - xy * miss_y) / determinant
        y = y - ((1 + xx) * miss_y - xy * miss_x) / determinant
    assert max(np.abs(miss_x).max(), np.abs(miss_y).max()) < 1e-9 and determinant.min() > 0.2
    expected = (FACES / determinant).reshape(32, 12, 32, 12).mean(axis=(1, 3))
    ratio = light / expected - 1
    blocks = ratio.reshape(4, 8, 4, 8).mean(axis=(1, 3))
    figures = float(np.sqrt(np.mean(ratio**2))), float(np.sqrt(np.mean(blocks**2)))
    assert figures[0] < 3e-2 and figures[1] < 3e-3


def test_a_random_relief_has_the_slope_and_correlation_that_were_asked_for() -> None:
    """Slopes of a surface with correlation c have the autocorrelation (1 - r^2 / c^2) exp(-r^2 / (2 c^2)) along r.

    24 correlation lengths a side, seed 5: some 24^2 / 6 independent patches, 10 % of the variance.
    """
    relief = random_relief(6.0, 0.25, 0.03, 5)
    step = relief.side_mm / (len(relief.height_mm) - 1)
    assert np.sqrt((relief.slope_x**2 + relief.slope_y**2).mean() / 2) == pytest.approx(0.03, rel=1e-9)
    differences = np.gradient(relief.height_mm, step)
    for slope, difference in zip((relief.slope_x, relief.slope_y), differences, strict=True):
        # Central differences are off by step^2 / 6 of the third derivative, here 0.4 %.
        inner = (slice(2, -2),) * 2
        assert np.linalg.norm((slope - difference)[inner]) < 8e-3 * np.linalg.norm(slope[inner])
    variance = (relief.slope_x**2).mean()
    for steps in (6, 12, 24):
        r = steps * step / 0.25
        found = (relief.slope_x[steps:] * relief.slope_x[:-steps]).mean() / variance
        assert found == pytest.approx((1 - r**2) * np.exp(-(r**2) / 2), abs=0.1)
    other = random_relief(6.0, 0.25, 0.03, 6)
    assert not np.array_equal(relief.height_mm, other.height_mm)


@pytest.mark.parametrize("values", [(6.0, 2.0, 0.1), (6.0, 0.0, 0.1), (6.0, 0.3, 0.0), (6.0, 0.3, 0.9)])
def test_reliefs_that_are_none_are_refused(values: tuple[float, float, float]) -> None:
    with pytest.raises(MitsimError, match="give a correlation above 0"):
        random_relief(*values, seed=0)
