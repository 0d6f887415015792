"""Where a bench's devices and surfaces stand, by closed forms, and what is seen of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mitsim.api.bench import open_bench
from mitsim.bench import layout as module
from mitsim.bench.layout import Layout, layout_of, previews, seen_depths

pytestmark = pytest.mark.usefixtures("variant")
POSE = "0 0 1 500 0 1 0 -20 -1 0 0 30 0 0 0 1"
"""A camera elsewhere that looks along +x."""
NEAR = """<shape type="rectangle"><transform name="to_world">
    <scale x="20" y="30"/> <translate x="10" y="5" z="350"/> <matrix value="{pose}"/>
    </transform><boolean name="flip_normals" value="true"/><bsdf type="diffuse"/></shape>"""
SHAPES = """<shape type="shapegroup" id="pair">
        <shape type="sphere"><float name="radius" value="8"/><bsdf type="diffuse"/></shape>
        <shape type="cube"><transform name="to_world"><scale value="5"/><translate y="20"/></transform>
            <bsdf type="diffuse"/></shape></shape>
    <shape type="instance"><ref id="pair"/><transform name="to_world"><translate x="20" z="370"/></transform></shape>
    <shape type="sphere" id="ball"><float name="radius" value="9"/><point name="center" x="-30" y="-20" z="380"/>
        <bsdf type="diffuse"/></shape>
    <shape type="disk"><transform name="to_world"><scale value="12"/><translate x="-30" y="30" z="390"/></transform>
        <bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>"""


def layout(path: Path) -> Layout:
    return layout_of(open_bench(path))


@pytest.mark.parametrize("pose", ["1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", POSE])
def test_devices_and_light_stand_where_the_scene_says(small_scene: Callable[..., Path], pose: str) -> None:
    """A projector 60 mm beside the camera lights 120 mm at 400 mm by 16 pixels, in the camera's frame wherever that is;
    a card at 350 mm hides some of the sheet. Between both depths a pixel's light moves by 60 (1/350 - 1/400) in
    tangents, of which a pixel has 120 / 16 / 400. (Planted: the camera's turn left out; depths by pixel upside down,
    and of one ray.)"""
    path = small_scene(pose=pose, extra=NEAR.format(pose=pose))
    found, depths = layout(path), seen_depths(open_bench(path))
    assert_allclose(depths[[3, 7, 12], [7, 5, 7]], [350, 350, 400], rtol=1e-5)
    assert 351 < depths[7, 10] < 399
    assert_allclose(found.projector, [60, 0, 0], atol=1e-3)
    assert_allclose(np.ptp(found.window, axis=0), [120, 120, 0], atol=2e-3)
    assert_allclose(found.window[0], [60, 60, 400], atol=2e-3)
    assert_allclose(found.window_at(200.0).mean(axis=0), [30, 0, 200], atol=2e-3)
    assert found.depths == pytest.approx((350, 400), rel=1e-5) and found.obstacles == ()
    assert found.parallax == pytest.approx((0, 60 * (1 / 350 - 1 / 400) * 400 * 16 / 120), abs=1e-4)
    sheet, card = found.surfaces
    assert_allclose([sheet.points.min(axis=0), sheet.points.max(axis=0)], [[-64, -64, 400], [64, 64, 400]], atol=1e-3)
    assert_allclose([card.points.min(axis=0), card.points.max(axis=0)], [[-10, -25, 350], [30, 35, 350]], atol=1e-3)


def test_light_that_is_seen_is_counted(small_scene: Callable[..., Path]) -> None:
    """Of a flat sheet all; through a field stop of 12 degrees only 42 mm to either side, of 60; of nothing none, with
    the reason."""
    assert layout(small_scene()).seen == 16 * 16
    side = 2 * np.floor(400 * np.tan(np.radians(6)) / 7.5)
    assert abs(layout(small_scene(fov=12)).seen - side**2) <= 4 * side  # edges fall inside pixels
    dark = layout(small_scene(sheet_z=-400))
    assert dark.seen == 0 and dark.depths is None and "no light of the projector" in dark.obstacles[0]


def test_shapes_have_their_outlines(small_scene: Callable[..., Path]) -> None:
    """By their surface parameters, or by a box where Mitsuba has none, as of an instance. (Planted: corners of
    neighbouring cells joined over others.)"""
    surfaces = {surface.name: surface for surface in layout(small_scene(extra=SHAPES)).surfaces}
    assert [*surfaces] == ["rectangle 1", "instance 2", "ball", "disk 4"]
    ball = surfaces["ball"]
    assert_allclose(np.linalg.norm(ball.points - [-30, -20, 380], axis=1), 9, atol=1e-3)
    corners = ball.points[ball.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(4 * np.pi * 81, rel=0.02)
    disk = surfaces["disk 4"].points - [-30, 30, 390]
    assert_allclose(disk[:, 2], 0, atol=1e-3)
    assert np.linalg.norm(disk, axis=1).max() == pytest.approx(12, rel=0.01)
    pair = surfaces["instance 2"]
    box = pair.points.max(axis=0), pair.points.min(axis=0)
    assert_allclose(box, [[28, 25, 378], [12, -8, 362]], atol=1e-3)


def test_a_print_is_seen_on_its_surface(small_scene: Callable[..., Path]) -> None:
    """A sheet whose upper left is white, for one who looks along +z: +x is left, +y up. It is divided, and still
    whole. (Planted: parts of a triangle left out; rows and columns of the print exchanged.)"""
    reflectance = np.full((16, 16), 51)
    reflectance[:8, :12] = 255
    (sheet,) = layout(small_scene(reflectance=reflectance)).surfaces
    white = sheet.reflectance[:, 0] > 0.6
    inside = (np.abs(sheet.points[:, :2] - [-32, 0]) > 5).all(axis=1)  # not on the print's edges
    assert_allclose(white[inside], ((sheet.points[:, 0] > -32) & (sheet.points[:, 1] > 0))[inside])
    corners = sheet.points[sheet.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(128**2, rel=1e-4) and len(sheet.triangles) > 10_000


@pytest.mark.slow
def test_previews_show_what_the_camera_sees(small_scene: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """The white quarter at the upper left of what is seen from the sensor's place, and from the free place where its
    corners are projected to."""
    monkeypatch.setattr(module, "_PIXELS", 64)
    reflectance = np.full((16, 16), 51)
    reflectance[:8, :8] = 255
    bench = open_bench(small_scene(reflectance=reflectance, pose=POSE))
    found = layout_of(bench)
    quarters = np.array([[30.0, 30.0], [-30, 30], [-30, -30], [30, -30]])
    for preview in previews(bench, found):
        places = preview.project(np.concatenate([quarters, np.full((4, 1), 400.0)], axis=1))
        columns, rows = np.rint(places).astype(int).T
        seen = preview.picture[rows, columns, 0]
        assert seen[0] > 0.8 and (seen[1:] < 0.4).all()
    assert (rows[0] < rows[3]) and (columns[0] < columns[1])
