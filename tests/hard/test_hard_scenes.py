"""Scenes in other units, closed rooms, single and bad texels, and scenes with nothing to see."""

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
from mitsim.transport.direct import DirectTracer
from mitsim.transport.integrator import IndirectTracer, Paths
from tests.hard.hard_light import SCALE, SEVEN, SLOW, N, Z, gauss, matt, mean, seen_alone
from tests.physics.radiosity import Furnace
from tests.robustness import Recorder

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.robustness("Light")]


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


# ---- closed rooms


def furnace(write: Callable[..., Path], albedo: float) -> IndirectTracer:
    """The devices inside a closed matt sphere."""
    sphere = (
        '<shape type="sphere"><point name="center" x="0" y="0" z="180"/><float name="radius" value="220"/>'
        f'<boolean name="flip_normals" value="true"/>{matt(albedo)}</shape>'
    )
    bench = open_bench(write("furnace", mask="open", extra=sphere, sheet_z=3000))
    return IndirectTracer(bench.setup, Paths(False, True))


@SLOW
@pytest.mark.parametrize(("albedo", "samples"), [(0.9, 64), (0.99, 32), (0.999, 8)])
def test_a_closed_room_that_absorbs_little(
    measured: Recorder, small_scene: Callable[..., Path], albedo: float, samples: int
) -> None:
    """Light of 10, 100 and 1000 reflections against the furnace's closed form."""
    tracer = furnace(small_scene, albedo)
    expected = Furnace(albedo).indirect(float(np.tan(np.radians(10))))
    found, error = mean(np.array([tracer.trace(seed, 0, samples).value.sum() / samples for seed in range(8)]))
    measured(abs(found / expected - 1), at_most=SEVEN * error / expected)
    assert SEVEN * error < 0.2 * expected


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


@pytest.mark.slow
def test_one_pixel_is_captured(small_scene: Callable[..., Path], tmp_path: Path) -> None:
    bench = open_bench(small_scene(canvas=np.pad([[255.0]], ((1, 2), (5, 2)))))
    result = bench.capture("uniform", tmp_path / "run", accuracy=2e-2, seed=1, effects={"diffraction": False})
    assert len(result.dn) == 1 and 0 < result.manifest.mc_error < 2e-2 and np.isfinite(result.exposure_s)


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
