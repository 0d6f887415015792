"""Planes at grazing angles, beside and behind the camera, and with hardly a gap: direct light against quadrature.

Then scenes in other units, closed rooms, single and bad texels, and scenes with nothing to see.
"""

import re
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsim.api.bench import Bench, open_bench
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import Lighting
from mitsim.planner.planner import make_plan
from mitsim.transport.direct import DirectTracer
from tests.hard.hard_light import HALF, PLACE, SCALE, SEVEN, SLOW, N, Z, gauss, matt, mean, plate, seen_alone
from tests.robustness import Recorder

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.robustness("Light")]
EPSILON = 9e-5 * (1 + Z)
"""Mitsuba's ray epsilon at the sheet [mm]."""


@pytest.fixture(scope="module")
def plane(shared_scene: Callable[..., Path], variant: str) -> Callable[..., Bench]:
    """A two-sided matt square of 60 mm about ``centre`` with unit ``normal``, alone in the scene; albedo 0.5."""
    count = iter(range(100))

    def load(centre: np.ndarray, normal: np.ndarray, half: float = HALF, **numbers: object) -> Bench:
        u, v = axes_of(normal)
        rows = np.stack([half * u, half * v, normal, centre], axis=1)
        matrix = " ".join(f"{value:.17g}" for value in [*rows.ravel(), 0, 0, 0, 1])
        extra = plate(f'<matrix value="{matrix}"/>', matt(0.5))
        path = shared_scene(f"plane{next(count)}", extra=extra, **{"sheet_z": -500, **numbers})
        return open_bench(path, variant, for_render=True)

    return load


def axes_of(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    u = np.cross(normal, [0.0, 1.0, 0.0])
    u /= np.linalg.norm(u)
    return u, np.cross(normal, u)


def of_plane(centre: np.ndarray, normal: np.ndarray, sensor: np.ndarray, half: float = HALF, stop: float = 0.17632698):
    """Irradiance that the square casts on a sensor point, by quadrature over the square: E dA = pi scale dp dq."""
    u, v = axes_of(normal)
    (a, da), count = gauss(-half, half, 400), 400
    point = centre + a[:, None, None] * u + a[None, :, None] * v
    out, back = np.array([PLACE, 0, 0]) - point, sensor - point
    same = np.sign(out @ normal) == np.sign(back @ normal)
    p, q = -out[..., 0] / point[..., 2], -out[..., 1] / point[..., 2]
    t = (point[..., :2] - sensor[:2]) / point[..., 2:]
    inside = same & (point[..., 2] > 2) & (p > -0.3) & (p < 0) & (abs(q) < 0.15) & (abs(t).max(axis=-1) < stop)
    r = np.linalg.norm(back, axis=-1)
    received = np.pi * SCALE * np.abs(out @ normal) / point[..., 2] ** 3
    light = 0.5 / np.pi * received * np.abs(back @ normal) * point[..., 2] / r**4
    assert light.shape == (count, count)
    return float(da @ np.where(inside, light, 0) @ da)


@pytest.mark.parametrize("angle", [pytest.param(80.0, marks=SLOW), 89.99])
def test_a_plane_lit_at_grazing_incidence(measured: Recorder, plane: Callable[..., Bench], angle: float) -> None:
    """Turned about y until the projector's ray meets its centre at the angle; at 89.99 degrees one ray in 80 000 does.

    Only the columns that it lies in are traced.
    """
    centre = np.array([3.0, 0.0, Z])
    toward = np.array([PLACE, 0, 0]) - centre
    toward /= np.linalg.norm(toward)
    across = np.array([toward[2], 0.0, -toward[0]])  # leans to the camera, which sees the lit side
    normal = np.cos(np.radians(angle)) * toward + np.sin(np.radians(angle)) * across
    bench, expected = plane(centre, normal), of_plane(centre, normal, np.zeros(3))
    column = np.arange(N) if angle < 89 else np.arange(7, 9)
    pixels = (np.arange(N)[:, None] * N + column).ravel()
    found, error = mean(seen_alone(bench, 8, 2**11 if angle < 89.9 else 2**15, pixels=pixels)[:, 0, 0])
    # Float32 places the plane to 3e-5 mm; at 89.99 degrees the lit strip is 0.01 mm wide as the projector sees it.
    gate = SEVEN * error + 1e-3 * found
    measured(abs(found / expected - 1), at_most=gate / expected)
    assert gate < 0.12 * expected


@pytest.mark.parametrize("angle", [pytest.param(80.0, marks=SLOW), 89.99])
def test_a_plane_seen_at_grazing_incidence(measured: Recorder, plane: Callable[..., Bench], angle: float) -> None:
    """Turned until the camera's centre sees it at the angle from its normal, on the side that is lit."""
    centre = np.array([-10.0, 0.0, Z])
    toward = -centre / np.linalg.norm(centre)
    across = np.array([-toward[2], 0.0, toward[0]])
    normal = np.cos(np.radians(angle)) * toward + np.sin(np.radians(angle)) * across
    bench, expected = plane(centre, normal), of_plane(centre, normal, np.zeros(3))
    found, error = mean(seen_alone(bench, 8, 2**12)[:, 0, 0])
    # The centre is placed to 3e-5 mm, 4e-4 of the 0.07 mm by which the plane of 89.99 degrees misses the sensor.
    gate = SEVEN * error + 1e-3 * found
    measured(abs(found / expected - 1), at_most=gate / expected)
    assert gate < 0.06 * expected


def test_a_plane_through_the_cameras_axis(plane: Callable[..., Bench]) -> None:
    """Its light is exactly 0 at the sensor's centre and linear in x off it; the lit side alone shines."""
    centre, normal = np.array([0.0, 0.0, Z]), np.array([1.0, 0.0, 0.0])
    bench = plane(centre, normal, pixels=64, pitch=0.625)
    found, place = seen_alone(bench, 4, 2**12, anchors=2), bench.geometry.half_width / np.sqrt(2)
    for row, column in np.ndindex(2, 2):
        sensor = np.array([place if column == 0 else -place, place if row == 0 else -place, 0.0])
        expected = of_plane(centre, normal, sensor)
        value, error = mean(found[:, row, column])
        assert (expected == 0) == (column == 1) and abs(value - expected) <= 9 * error + 1e-3 * expected
        assert error < 0.03 * expected or not expected
    assert seen_alone(bench, 1, 64).max() < 1e-6 * found.max()


def test_a_scene_that_the_sensors_centre_cannot_see_is_refused(plane: Callable[..., Bench]) -> None:
    """The plane alone: the pilot looks from the centre, to which it is a line. Not silently black, and it says why."""
    bench = plane(np.array([0.0, 0.0, Z]), np.array([1.0, 0.0, 0.0]))
    with pytest.raises(MitsimError, match="centre sees no light") as caught:
        make_plan(bench, Lighting.uniform(N), 1e-2, 1)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("x", [-40.0, -300.0])
def test_a_plane_that_reaches_beside_and_behind_the_camera(
    measured: Recorder, plane: Callable[..., Bench], x: float
) -> None:
    """A wall from z = -500 to 500 through the plane z = 0: what lies before the camera shines, nothing else."""
    centre, normal = np.array([x, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
    bench = plane(centre, normal, half=500.0, fov=60)
    found = [DirectTracer(bench.setup, 1).trace(s, 0, 256) for s in range(8)]
    totals = np.array([one.value.sum() / 256 for one in found])
    # Quadrature over z alone sees the lit part: smaller square about it.
    if x == -300.0:
        assert not totals.any(), "the projector's window ends before it reaches this wall"
        return
    assert min((1 / one.inverse_depth).min() for one in found) > 100 / 0.3 * (1 - 1e-6)
    lit = np.array([x, 0.0, 416.0])
    expected = of_plane(lit, normal, np.zeros(3), 84.0, np.tan(np.radians(30)))
    value, error = mean(totals)
    # Edges of the lit strip cut 400 Gauss nodes of 168 mm: 2 of them.
    measured(abs(value / expected - 1), at_most=SEVEN * error / expected + 5e-3)
    assert error < 5e-3 * expected


def test_projector_and_camera_in_one_place(measured: Recorder, small_scene: Callable[..., Path]) -> None:
    """Every ray comes back on itself. E = albedo scale times the integral of (1 + p^2 + q^2)^-2 / Z^2."""
    bench = open_bench(small_scene(projector_turn='<translate x="-60"/>', fov=40))
    (p, dp), (q, dq) = gauss(-64 / Z, 0.0), gauss(-0.15, 0.15)  # the sheet ends at 64 mm, the window's light at 120
    expected = 0.5 * SCALE / Z**2 * dp @ (1 + p[:, None] ** 2 + q**2) ** -2.0 @ dq
    found, error = mean(seen_alone(bench, 8, 16)[:, 0, 0])
    measured(abs(found / expected - 1), at_most=SEVEN * error / expected + 2e-6)
    assert error < 5e-4 * expected


# ---- gaps


GAPS = [10.0, 1.0, 0.1, EPSILON, 1e-2, 1e-3, 1e-4]
CARD = 20.0


def hidden(gap: float) -> float:
    """Light of the sheet at the sensor's centre that a black card of 40 mm before it takes away, by quadrature."""
    grown = CARD * Z / (Z - gap)
    shadow = PLACE + (np.array([-CARD, CARD]) - PLACE) * Z / (Z - gap)
    view = np.array([-grown, grown])

    def part(low: float, high: float) -> float:
        (x, dx), (y, dy) = gauss(low, high), gauss(-grown, grown)
        fall = (1 + (x[:, None] / Z) ** 2 + (y / Z) ** 2) ** -2.0
        return float(0.5 * SCALE / Z**4 * dx @ fall @ dy)

    both = part(max(view[0], shadow[0]), min(view[1], shadow[1]))
    return part(*view) + part(*shadow) - both


@pytest.mark.parametrize("gap", GAPS)
def test_no_light_leaks_through_a_gap(measured: Recorder, small_scene: Callable[..., Path], gap: float) -> None:
    """A black card before the sheet: the light that is left, and none from behind it, whatever the gap.

    A ray to the sensor starts one epsilon off the sheet. Below that gap it starts before the card, and a strip under
    the card's edge is seen that should not be: no wider than the projector's ray reaches under it, gap x 0.2. At 1e-4,
    three steps of float32 at 400 mm, rounding lets less than one in a hundred of the card's rays by.
    """
    card = plate(f'<scale x="{CARD}" y="{CARD}"/><translate z="{Z - gap}"/>', matt(0.0))
    bench = open_bench(small_scene(extra=card))
    tracer = DirectTracer(bench.setup, 1)
    found = [tracer.trace(seed, 0, 1024) for seed in range(8)]
    (x, dx), (y, dy) = gauss(-60, 60), gauss(-60, 60)
    whole = 0.5 * SCALE / Z**4 * dx @ (1 + (x[:, None] / Z) ** 2 + (y / Z) ** 2) ** -2.0 @ dy
    value, error = mean(np.array([one.value.sum() / 1024 for one in found]))
    rounded = 0.01 if gap < 5e-4 else 0.0
    leak, allowed = value - (whole - hidden(gap)), 0.2 * min(gap, EPSILON) * 8 * CARD / 120**2 * whole
    allowed += rounded * (2 * CARD) ** 2 / 120**2 * whole
    measured(abs(leak) / whole, at_most=(SEVEN * error + allowed) / whole, what="of all light")
    assert SEVEN * error + allowed < 1.5e-3 * whole
    for one in found:
        place = np.maximum(np.abs(one.row), np.abs(one.column)) / one.inverse_depth
        behind = place < CARD - 0.2 * min(gap, EPSILON) - 1e-3
        assert behind.sum() <= rounded * 1024 * N**2 * (2 * CARD) ** 2 / 120**2, "light from behind the card"


def test_a_gap_below_float32_is_no_gap(small_scene: Callable[..., Path]) -> None:
    """1e-5 mm at 400 mm is lost in float32: card and sheet are one plane, and which is met is Mitsuba's to choose.

    The light that comes then is between that of the card's and that of the sheet's whole square: bounded, and finite.
    """
    card = plate(f'<scale x="{CARD}" y="{CARD}"/><translate z="{Z - 1e-5}"/>', matt(0.0))
    value = seen_alone(open_bench(small_scene(extra=card)), 2, 64).mean()
    whole = seen_alone(open_bench(small_scene("bare")), 2, 64).mean()
    assert whole - hidden(0.0) - 1e-3 * whole < value < whole * (1 + 1e-3)


# ---- Scenes in other units, closed rooms, texels, nothing to see ----


def scaled_scene(write: Callable[..., Path], scale: float) -> Path:
    """The small scene with a box, with every length times ``scale``."""
    lengths = {"pitch": 0.01172, "mask_feature": 0.06, "mask_distance": 2, "scene_distance": Z, "sheet_z": Z}
    box = (
        f'<shape type="cube"><transform name="to_world"><scale value="{25 * scale}"/><rotate y="1" angle="30"/>'
        f'<translate x="{-10 * scale}" z="{350 * scale}"/></transform>{matt(0.8)}</shape>'
    )
    path = write(f"scaled{scale:g}", extra=box, **{name: value * scale for name, value in lengths.items()})
    text = path.read_text()
    for old, new in (('<translate x="60"/>', 60), ('<scale x="64" y="64"/>', 64)):
        assert text.count(old) == 1
        text = text.replace(old, re.sub(r'"\d+"', f'"{new * scale}"', old))
    path.write_text(text)
    return path


@pytest.mark.parametrize(("scale", "words"), [(1e-3, "this looks like metres"), (1e3, "pixel pitch")])
def test_metres_and_micrometres_are_refused(small_scene: Callable[..., Path], scale: float, words: str) -> None:
    """A scene in other units has lengths or pixels that no camera has; it is refused before any light is traced."""
    with pytest.raises(MitsimError, match=words) as caught:
        open_bench(scaled_scene(small_scene, scale))
    assert "\n" not in str(caught.value)


# ---- single texels


PIXEL = 0.3 / N


def test_one_pixel_is_a_projector(small_scene: Callable[..., Path]) -> None:
    """n = 1: a window of one texel among 4 x 8. All its light is the window's."""
    canvas = np.zeros((4, 8))
    canvas[1, 5] = 255
    bench = open_bench(small_scene(canvas=canvas))
    assert bench.n == 1 and bench.loaded.pixels.canvas == (4, 8)
    (x, dx), (y, dy) = gauss(-0.075, 0.0), gauss(-0.075, 0.0)
    expected = 0.5 * SCALE / Z**2 * dx @ (1 + x[:, None] ** 2 + y**2) ** -2.0 @ dy
    found, error = mean(seen_alone(bench, 8, 4096)[:, 0, 0])
    assert error < 1e-4 * expected and abs(found - expected) < SEVEN * error + 1e-6 * expected


@settings(max_examples=8, deadline=None, derandomize=True)
@given(row=st.integers(0, N - 1), column=st.integers(0, N - 1))
def test_one_lit_pixel_of_many(white: Bench, row: int, column: int) -> None:
    """Its own light and no other: albedo scale / Z^2 times the integral of the falloff over the pixel."""
    found = DirectTracer(white.setup, 1).trace(row * N + column, 0, 64)
    (x, dx), (y, dy) = (gauss(-0.15 + at * PIXEL, -0.15 + (at + 1) * PIXEL) for at in (column, row))
    expected = 0.5 * SCALE / Z**2 * dx @ (1 + x[:, None] ** 2 + y**2) ** -2.0 @ dy
    mine = found.where(found.pixel == row * N + column)
    # 64 stratified points; over a pixel the falloff changes by 1 %.
    assert mine.value.sum() / 64 == pytest.approx(expected, rel=5e-4)


def test_a_print_of_one_texel(small_scene: Callable[..., Path], white: Bench) -> None:
    """A 1 x 1 bitmap is an even reflectance: 51/255 against 0.5, to the last digits of float32."""
    bench = open_bench(small_scene(reflectance=np.full((1, 1), 51)))
    ratio = seen_alone(bench, 1, 16).mean() / seen_alone(white, 1, 16).mean()
    assert ratio == pytest.approx(0.2 / 0.5, rel=1e-5)


# ---- texels that no light and no surface can have


def bad_scene(write: Callable[..., Path], which: str, value: float) -> Path:
    """A scene whose reflectance or projector is an OpenEXR with one bad texel, in row 3, column 20."""
    path = write(reflectance=np.full((4, 4), 128))
    texels = np.zeros((16, 32, 1), np.float32)
    texels[:, 16:] = 0.5
    texels[3, 20] = value
    mi.Bitmap(texels).write(str(path.parent / "bad.exr"))
    path.write_text(path.read_text().replace(f"small_{which}.png", "bad.exr"))
    return path


BAD = [("reflectance", 1.01), *((which, value) for which in ("reflectance", "projector") for value in (
    np.nan, np.inf, -np.inf, -1e-3))]  # fmt: skip


@pytest.mark.parametrize(("which", "value"), BAD)
def test_bad_texels_are_refused(small_scene: Callable[..., Path], which: str, value: float) -> None:
    """Before any work, in one line: scene, bitmap, texel, value, what is allowed."""
    path = bad_scene(small_scene, which, value)
    with pytest.raises(MitsimError) as caught:
        open_bench(path)
    line = str(caught.value)
    assert "\n" not in line and str(path) in line and "bad.exr" in line
    assert "row 3, column 20" in line and f"{value:g}" in line and "(1 such texels)" in line


def test_good_texels_pass(small_scene: Callable[..., Path]) -> None:
    """Reflectance 0 to 1, and a projector of any brightness."""
    assert open_bench(bad_scene(small_scene, "reflectance", 1.0)).n == N
    assert open_bench(bad_scene(small_scene, "projector", 250.0)).n == N


def test_a_mesh_with_a_bad_corner_is_refused(small_scene: Callable[..., Path]) -> None:
    path = small_scene(extra=f'<shape type="obj"><string name="filename" value="bad.obj"/>{matt(0.5)}</shape>')
    corners = "v 0 0 300\nv 10 {} 300\nv 0 10 300\nf 1 2 3\n"
    (path.parent / "bad.obj").write_text(corners.format("nan"))
    with pytest.raises(MitsimError, match=r"^[^\n]*bad\.obj[^\n]* vertices that are not finite[^\n]*$"):
        open_bench(path)
    (path.parent / "bad.obj").write_text(corners.format("0"))
    assert open_bench(path).n == N


# ---- nothing to see


EMPTY = {
    "nothing is there": lambda path: re.sub(r"<shape.*</shape>", "", path.read_text(), flags=re.DOTALL),
    "all of it behind the camera": lambda path: path.read_text().replace('<translate z="400"/>', '<translate z="-9"/>'),
    "all of it black": lambda path: path.read_text().replace('"albedo" value="0.5"', '"albedo" value="0"'),
    "in the sensor's plane": lambda path: path.read_text().replace('<translate z="400"/>', '<translate z="0"/>'),
}


@pytest.mark.usefixtures("soon_dark")
@pytest.mark.parametrize("what", EMPTY)
def test_a_scene_without_light_is_refused(small_scene: Callable[..., Path], tmp_path: Path, what: str) -> None:
    """Frames of noise alone would look like a success; nothing is left behind."""
    path = small_scene()
    path.write_text(EMPTY[what](path))
    with pytest.raises(MitsimError, match="no light of the projector reaches the camera") as caught:
        open_bench(path).capture("uniform", tmp_path / "run", accuracy=1e-2)
    assert "\n" not in str(caught.value) and not list((tmp_path / "run").glob("*.exr"))
