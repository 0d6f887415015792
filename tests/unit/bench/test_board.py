"""The board of a calibration: light on a tilted and on a bowed one in closed form, and pixels that miss it.

What a projector pixel sends is intercepted whole, so a board of reflectance rho casts rho/pi phi cos_P cos_s / d^2 on a
sensor point, phi being the pixel's flux, d the way from the board's point P, cos_P and cos_s its cosines at both ends.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from mitsim.api.bench import Bench, open_bench
from mitsim.bench.effects import EFFECTS
from mitsim.bench.layout import missed_pixels
from mitsim.devices.patterns import Lighting
from mitsim.devices.session import BoardShape
from mitsim.light.light import trace_light
from mitsim.planner.planner import make_plan

pytestmark = pytest.mark.usefixtures("kept_plans")
N, Z, WINDOW = 16, 400.0, 120.0
ORIGIN = np.array([60.0, 0.0, 0.0])
"""The projector stands 60 mm beside the camera."""


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str) -> Bench:
    return open_bench(shared_scene("board16", n=N), variant)


def flux(bench: Bench, shape: BoardShape) -> np.ndarray:
    """(n, n) traced irradiance that each pixel casts on the sensor, without the mask."""
    board = bench.with_board(0.9, shape)
    plan = make_plan(bench.with_board(0.9), Lighting.uniform(N), 1e-3, 0, dict.fromkeys(EFFECTS, False))
    return trace_light(board, plan, Lighting.uniform(N), 3).flux.reshape(N, N)


def expected(shape: BoardShape) -> np.ndarray:
    """The same in closed form, as the mean of 4 x 4 points of every pixel; the sensor is a point.

    Points of a flat board solve n (P - Z e_z) = 0, of a bowed one that faces the camera z = Z + bow r^2 / half^2.
    """
    points = ((np.arange(4 * N) + 0.5) / (4 * N) - 0.5) * WINDOW
    # Rows run down -y and columns down -x.
    y, x = np.meshgrid(-points, -points, indexing="ij")
    way = np.stack([x, y, np.full_like(x, Z)], axis=-1) - ORIGIN
    if shape.bow_mm:
        part = shape.bow_mm / (shape.size_mm / 2) ** 2
        reached = np.ones_like(x)
        for _ in range(60):
            spot = ORIGIN + reached[..., None] * way
            reached = (Z + part * np.square(spot[..., :2]).sum(axis=-1)) / Z
        spot = ORIGIN + reached[..., None] * way
        normal = np.stack([2 * part * spot[..., 0], 2 * part * spot[..., 1], -np.ones_like(x)], axis=-1)
    else:
        slopes = np.tan(np.radians([shape.tilt_row_deg, shape.tilt_column_deg]))
        normal = np.array([-slopes[1], -slopes[0], -1.0])
        reached = (normal @ (np.array([0, 0, Z]) - ORIGIN)) / (way @ normal)
        spot = ORIGIN + reached[..., None] * way
    away = np.linalg.norm(spot, axis=-1)
    cos_board = -(normal * spot).sum(axis=-1) / away / np.linalg.norm(normal, axis=-1)
    light = 0.9 / np.pi * cos_board * (spot[..., 2] / away) / away**2
    # pi scale times a pixel's area on the plane at unit distance.
    return light.reshape(N, 4, N, 4).mean(axis=(1, 3)) * np.pi * 111000 * (WINDOW / N / Z) ** 2


@pytest.mark.parametrize(
    "shape",
    [
        BoardShape(),
        pytest.param(BoardShape(tilt_row_deg=25.0), marks=pytest.mark.slow),
        pytest.param(BoardShape(tilt_column_deg=-30.0), marks=pytest.mark.slow),
        BoardShape(tilt_row_deg=-15.0, tilt_column_deg=20.0, size_mm=200.0),
        pytest.param(BoardShape(bow_mm=6.0, size_mm=200.0), marks=pytest.mark.slow),
        BoardShape(bow_mm=-6.0, size_mm=200.0),
    ],
    ids=lambda shape: shape.words,
)
def test_light_of_a_board_is_its_closed_form(bench: Bench, shape: BoardShape) -> None:
    """Means of 4 x 4 pixels, whose sampling leaves 2e-4. The sensor is no point, but moves way and cosine by 2e-5.

    Tilts change the light by up to 40 %, bows by 3 %. (Planted: tilts swapped, either sign, the board turned round the
    camera, bow halved, normals of a flat board, all seen.)
    """
    off = flux(bench, shape) / expected(shape) - 1
    assert np.abs(off.reshape(4, 4, 4, 4).mean(axis=(1, 3))).max() < 5e-4


@pytest.mark.parametrize(
    ("shape", "missed"),
    [
        (BoardShape(), 0),
        (BoardShape(size_mm=120.0), 0),
        (BoardShape(size_mm=100.0), N**2 - 12**2),  # 13.3 pixels of 7.5 mm: 6 of each half are whole
        (BoardShape(size_mm=119.0), N**2 - 14**2),
        (BoardShape(tilt_column_deg=45.0), 0),
        (BoardShape(tilt_row_deg=60.0, tilt_column_deg=60.0), 0),
        (BoardShape(bow_mm=2.0, size_mm=110.0), N**2 - 14**2),
    ],
    ids=lambda value: value.words if isinstance(value, BoardShape) else str(value),
)
def test_pixels_that_are_not_whole_on_the_board_are_counted(bench: Bench, shape: BoardShape, missed: int) -> None:
    assert missed_pixels(bench.with_board(0.9, shape)) == missed


def test_a_board_that_turns_its_back_is_missed(bench: Bench) -> None:
    import mitsuba as mi

    away = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, Z]).scale([100, 100, 1])}
    scene = mi.load_dict({"type": "scene", "board": away})
    assert missed_pixels(replace(bench, loaded=replace(bench.loaded, scene=scene))) == N**2


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"bow_mm": 1.0}, "without size_mm"),
        ({"bow_mm": 11.0, "size_mm": 100.0}, "up to a tenth"),
        ({"tilt_row_deg": 61.0}, "less than or equal to 60"),
        ({"size_mm": 0.0}, "greater than or equal to 0.001"),
    ],
)
def test_boards_that_cannot_hang_are_refused(wrong: dict[str, float], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        BoardShape(**wrong)
