"""Light that the projector's lens scatters: both estimators, the reference shown a picture that is scattered already.

Its picture is made here, by SciPy's Gaussian of 4 x 4 points a pixel, on a canvas three windows wide, as light leaves
the window; the fast estimator traces rays. Compared by the sums of :mod:`tests.physics.test_estimators_agree`, at the
significance there. A mutation must fail: the frame without glare.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mitsim.api.bench import Bench, open_bench
from mitsim.planner.planner import make_plan
from tests.physics.test_effects_agree import agrees, differs
from tests.physics.test_estimators_agree import PASSES, Pair, classes_of, frame_of

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("variant")]
N, SPREAD, FINE = 16, 0.25, 4
PROJECTOR = f"""
name = "a projector of little contrast"
effective_wavelength_nm = 562.0
ansi_contrast = 8.0
glare_spread = {SPREAD}
"""
WALL = """<shape type="rectangle"><transform name="to_world"><scale x="40" y="64"/><rotate y="1" angle="90"/>
    <translate x="-50" z="362"/></transform><bsdf type="twosided"><bsdf type="diffuse">
    <spectrum name="reflectance" value="0.9"/></bsdf></bsdf></shape>"""
"""Stands on the sheet, to the side, half in the picture."""


def scattered(shown: np.ndarray, part: float) -> np.ndarray:
    """(3 n, 3 n) means over pixels of what leaves the lens, the window in the middle."""
    picture = np.kron(np.pad(shown, N), np.ones((FINE, FINE)))
    spots = gaussian_filter(picture, SPREAD * N * FINE, mode="constant", truncate=6.0)
    return ((1 - part) * picture + part * spots).reshape(3 * N, FINE, 3 * N, FINE).mean(axis=(1, 3))


def reference(bench: Bench, shown: np.ndarray, spp: int, depth: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and its variance by the reference, of a projector of sharp pixels that shows what is scattered."""
    import mitsuba as mi

    # The small scene's canvas is n x 2n, its window the right half: one window more on each side of it.
    canvas = np.zeros((3 * N, 4 * N), dtype=np.float32)
    canvas[:, N:] = scattered(shown, bench.projector.glare)
    picture = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(canvas[..., None]),
        "raw": True,
        "filter_type": "nearest",
        "wrap_mode": "clamp",
    }
    projector = {
        "type": "projector",
        "to_world": mi.ScalarTransform4f().translate([60.0, 0.0, 0.0]),
        "fov_axis": "x",
        "fov": float(np.degrees(2 * np.arctan(2 * np.tan(np.radians(33.398488 / 2))))),
        "scale": 111000.0,
        "irradiance": picture,
    }
    shapes = {f"shape{i}": shape for i, shape in enumerate(bench.loaded.scene.shapes())}
    integrator = {"type": "path", "max_depth": depth}
    lit = {"type": "scene", "integrator": integrator, "camera": bench.loaded.camera, "projector": projector, **shapes}
    scene = mi.load_dict(lit)
    frames = np.stack([np.array(mi.render(scene, spp=spp, seed=300 + i), np.float64)[..., 0] for i in range(PASSES)])
    return frames.mean(axis=0), frames.var(axis=0, ddof=1) / PASSES


@pytest.mark.parametrize("walls", [False, True], ids=["sheet", "walls"])
def test_scattered_light_agrees(shared_scene: Callable[..., Path], tmp_path: Path, walls: bool) -> None:
    """A quarter of the picture is lit. Its glare falls beside the window too, on a sheet that is wider; before a wall
    it is followed further."""
    scene = shared_scene(f"glare{walls}", fov=32, extra=WALL if walls else "")
    sheet = '<scale x="64" y="64"/>'
    assert scene.read_text().count(sheet) == 1
    scene.write_text(scene.read_text().replace(sheet, '<scale x="120" y="120"/>'))
    projector = tmp_path / "glare.toml"
    projector.write_text(PROJECTOR)
    bench = open_bench(scene, projector=projector)
    shown = np.zeros((N, N))
    shown[: N // 2, N // 2 :] = 1
    forced = {"diffraction": False, "glare": True, "interreflection": walls}
    plan = make_plan(bench, classes_of(shown), 1.5e-3, 21, forced)
    frame, groups, light = frame_of(bench, plan, shown)
    pair = Pair(*reference(bench, shown, 512, 6 if walls else 2), frame, groups, light, bench, plan, shown)
    agrees(pair)
    differs(pair, pair.without("glare"))
