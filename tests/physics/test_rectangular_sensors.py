"""Sensors that are not square, regions of interest and pixels that are not square, against the square sensor.

Light is followed to the square of the sensor's longer side, whatever part of it a frame shows. So with the same
settings and seed, frames of a part of a square sensor are its frames' part, to rounding; a pixel of two rows sees the
mean of both. The rest of the chain is judged by what it makes of them: an image as good as the square sensor's.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from mitsim.api.bench import Bench, open_bench
from mitsim.core.configuration import shipped_path
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry, MaskProfile
from mitsim.devices.patterns import Lighting
from mitsim.light.light import Sampling, trace_light
from mitsim.light.plan import Plan
from mitsim.optics.image_formation import FrameOptics, raster_error
from mitsim.optics.shadow import Directions
from mitsim.planner.planner import make_plan
from tests.physics.test_estimators_agree import pair_of, z_of_whole

Write = Callable[..., Path]
LIGHTING = Lighting(np.arange(16**2) % 5, np.eye(5))
MIRROR = """<shape type="rectangle">
    <transform name="to_world">
        <rotate y="1" angle="180"/> <scale x="40" y="40"/> <rotate x="1" angle="2"/> <translate x="20" z="380"/>
    </transform>
    <bsdf type="conductor"/>
</shape>"""
PRINT = np.tile(np.linspace(20, 250, 64).astype(np.uint8), (64, 1))
REGION = {"crop_offset_x": 5, "crop_offset_y": 20, "crop_width": 37, "crop_height": 30}
TALL = '<float name="row_pitch" value="0.02344"/>'


def bench_of(write: Write, rows: int, columns: int, crop: dict[str, int], tall: bool = False, **more: str) -> Bench:
    """The small scene with ``rows`` x ``columns`` pixels, 11.72 um wide and, where ``tall``, twice as high; ``more``
    are its ``extra`` shapes, and ``numbers`` of the camera."""
    path = write(reflectance=PRINT, extra=more.get("extra", ""))
    old = '<integer name="width" value="64"/> <integer name="height" value="64"/>'
    numbers = {"width": columns, "height": rows, **crop}
    film = " ".join(f'<integer name="{name}" value="{value}"/>' for name, value in numbers.items())
    text = path.read_text(encoding="utf-8")
    assert old in text
    stated = (TALL if tall else "") + more.get("numbers", "")
    path.write_text(text.replace(old, film).replace("<film", f"{stated}<film"), encoding="utf-8")
    camera = shipped_path("calibration", "imx249.toml")
    if tall:
        high = path.with_name("high.toml")
        high.write_text(f"{camera.read_text(encoding='utf-8')}row_pitch_um = 11.72\n", encoding="utf-8")
        camera = high
    return open_bench(path, camera=camera)


def frames_of(bench: Bench, plan: Plan) -> np.ndarray:
    """(5, rows, columns) expected irradiance of light that is sampled as the ``plan`` says, and no further."""
    light = trace_light(bench, replace(plan, sampling_target=np.inf), LIGHTING, 11, Sampling(by_pixel=False))
    return np.stack([frame.irradiance for frame in light.frames(LIGHTING, 0)])


@pytest.mark.parametrize(
    "extra", [pytest.param("", id="print"), pytest.param(MIRROR, id="mirror", marks=pytest.mark.slow)]
)
def test_frames_of_a_part_of_a_sensor_are_its_frames_part(small_scene: Write, extra: str) -> None:
    """As three anchors see it. (Planted: light followed to the shorter side; anchors' weights of rows for columns.)"""
    square = bench_of(small_scene, 64, 64, {}, extra=extra)
    plan = make_plan(square, LIGHTING, 1e-3, seed=3)
    plan = replace(plan, settings=replace(plan.settings, anchors=3))
    whole = frames_of(square, plan)
    for rows, columns, crop, part in (
        (40, 64, {}, np.s_[:, 12:52]),
        (64, 26, {}, np.s_[:, :, 19:45]),
        (64, 64, REGION, np.s_[:, 20:50, 5:42]),
    ):
        found = frames_of(bench_of(small_scene, rows, columns, crop, extra=extra), plan)
        np.testing.assert_allclose(found, whole[part], rtol=0, atol=1e-12 * whole.max())


@pytest.mark.parametrize(
    ("mask", "by_fft"),
    [
        ({"kind": "random", "features": 61}, False),
        ({"kind": "random", "features": 61}, True),
        ({"kind": "separable", "order": 6, "rotation_deg": 1.0}, False),
        ({"kind": "flatcam", "order": 6, "tilt_row_mrad": 8.0, "tilt_column_mrad": -5.0}, False),
    ],
)
def test_any_masks_shadow_on_a_part_is_the_wholes_part(mask: dict[str, object], by_fft: bool) -> None:
    """By sums, by FFT as chosen and as needed; tilted, which is interpolated between other nodes, and drawn, of which
    the largest terms are another selection on a part: within 1e-4.
    (Planted: crossings of rows for columns in the tilt.)"""
    whole = MaskProfile.model_validate({"feature_mm": 0.06, **mask}).put_on(CameraGeometry(pixels=64), Path())
    whole = whole.model_copy(update={"mask_fft": by_fft})
    part = whole.model_copy(update={"rows": 48, "columns": 60, "roi": (4, 9, 41, 30)})
    assert by_fft == (whole.is_correlated(waves=False) and not whole.is_drawn(waves=False))
    at, light = Directions.cells(np.linspace(-0.15, 0.15, 21)), np.random.default_rng(0).random(400)
    seen = [FrameOptics(each, at, at, (400.0,), 1).frame(np.arange(400), light) for each in (whole, part)]
    expected = seen[0][12:53, 11:41]
    tolerance = 1e-4 if "tilt_row_mrad" in mask or whole.is_drawn(waves=False) else 1e-6 if by_fft else 1e-11
    np.testing.assert_allclose(seen[1], expected, rtol=0, atol=tolerance * expected.mean())


def test_what_is_chosen_behind_a_mask_follows_the_sensors_shape() -> None:
    """No raster under tall pixels; what one leaves is told of a corner's region as of the whole; a tilt has nodes for
    the finer pitch. (Planted: tall pixels not looked at; the region kept on the few pixels; the coarser pitch.)"""
    random = MaskProfile(kind="random", feature_mm=0.06, features=61).put_on(CameraGeometry(pixels=96), Path())
    tall = random.model_copy(update={"row_pitch": 2 * random.pixel_pitch})
    assert random.may_be_drawn(waves=False) and not tall.may_be_drawn(waves=False)
    at, light = Directions.cells(np.linspace(-0.15, 0.15, 21)), np.random.default_rng(0).random((20, 20))
    corner = random.model_copy(update={"roi": (70, 70, 26, 26)})
    reported = [raster_error(each, at, at, 400.0, None, light)[0] for each in (random, corner)]
    assert reported[0] == reported[1] > 0
    tilted = MaskProfile(kind="separable", feature_mm=0.06, order=6, tilt_row_mrad=20.0).put_on(
        CameraGeometry(), Path()
    )
    fine = tilted.model_copy(update={"row_pitch": tilted.pixel_pitch / 2})
    assert max(fine.tilt_nodes(waves=False) or ()) > 1.5 * max(tilted.tilt_nodes(waves=False) or ())


def test_a_pixel_of_two_rows_sees_the_mean_of_both(small_scene: Write) -> None:
    """Geometric shadows, whose mean over a pixel is exact."""
    square = bench_of(small_scene, 64, 64, {})
    plan = make_plan(square, LIGHTING, 1e-3, seed=3, switches={"diffraction": False})
    assert plan.settings.anchors == 1
    whole, tall = frames_of(square, plan), frames_of(bench_of(small_scene, 32, 64, {}, tall=True), plan)
    np.testing.assert_allclose(tall, (whole[:, ::2] + whole[:, 1::2]) / 2, rtol=0, atol=1e-9 * whole.max())


def test_a_camera_file_states_pixels_that_are_not_square(small_scene: Write) -> None:
    """Twice the area gathers twice the electrons, also where the camera is named on a scene of square pixels; with no
    camera named, a scene of tall ones is refused."""
    tall = bench_of(small_scene, 32, 64, {}, tall=True)
    with pytest.raises(MitsimError, match=r"binned row pitch is 11\.72 um, .* 23\.44 um"):
        open_bench(tall.loaded.path)
    square = open_bench(small_scene(reflectance=PRINT))
    assert tall.sensor.superpixel_area_m2 == pytest.approx(2 * square.sensor.superpixel_area_m2, rel=1e-12)
    named = open_bench(square.loaded.path, camera=tall.devices.camera_file)
    assert named.sensor.superpixel_area_m2 == tall.sensor.superpixel_area_m2
    assert named.geometry.half_sides[0] == 2 * named.geometry.half_sides[1]


@pytest.mark.slow
def test_the_estimators_agree_on_a_region_of_tall_pixels(small_scene: Write) -> None:
    """Of which half is active: sums over the frame of 20 x 50 pixels, by their spread between passes and groups; 1 % of
    the mean is seven deviations. As in tests/physics/test_estimators_agree.py, alpha is 1e-3 for all five. (Planted in
    the plugin: the region's rows for its columns; a sensor as high as wide.)"""
    crop = {"crop_offset_x": 5, "crop_offset_y": 3, "crop_width": 50, "crop_height": 20}
    half = '<float name="pixel_fill_factor" value="0.5"/>'
    pair = pair_of(bench_of(small_scene, 28, 64, crop, tall=True, numbers=half), "uniform", 0, 3e-4, 128)
    assert pair.factored.shape == pair.reference.shape == (20, 50)
    scores = z_of_whole(pair, pair.factored)
    assert max(map(abs, scores.values())) < stats.norm.isf(1e-3 / len(scores) / 2), scores
