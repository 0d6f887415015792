"""Effects one by one: lamps and pixels against closed forms and the reference, the lens and black level of a projector.

Ambient light is compared with integrals written out here; pixel response, mask thickness and the projector's lens with
the reference estimator, by the sums of :mod:`tests.physics.test_estimators_agree`, each with a mutation: the frame
without the effect has to fail. Seeds are fixed.
"""

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.acquire.capture import show_pattern
from mitsim.api.bench import Bench, open_bench
from mitsim.core.configuration import shipped_path
from mitsim.devices.patterns import Lighting
from mitsim.light.light import Sampling, trace_light
from mitsim.light.passes import Simulation, expected_of
from mitsim.light.settings import Settings
from mitsim.planner.planner import make_plan
from tests.physics.radiosity import gauss, solid_angle
from tests.physics.test_estimators_agree import LIMIT, PASSES, Pair, classes_of, frame_of, pair_of, worst, z_scores

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("variant")]
SmallScene = Callable[..., Path]


def agrees(pair: Pair) -> None:
    name, z = worst(z_scores(pair))
    assert abs(z) < LIMIT, f"{name}: z = {z:.1f}, limit {LIMIT:.1f}"


def differs(pair: Pair, frame: np.ndarray) -> None:
    _, z = worst(z_scores(pair, frame))
    assert abs(z) > LIMIT


# ---- ambient light


def ambient_frame(bench: Bench, samples: int = 8, anchors: int = 3, interreflection: bool = False) -> np.ndarray:
    """The frame of the lamps alone."""
    on = {"ambient"} | ({"interreflection"} if interreflection else set())
    settings = Settings(depth=400.0, anchors=anchors, effects=frozenset(on))
    simulation = Simulation(bench, settings)
    uniform = Lighting.uniform(bench.n)
    light = simulation.accumulate("indirect", simulation.from_camera.trace(5, 0, samples), uniform.labels, samples)
    dark = Lighting(uniform.labels, 0 * uniform.weights)
    return next(iter(expected_of([(simulation, [light])], np.zeros(1, np.int64), dark, 0))).irradiance


def by_lamp(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Irradiance of points (x, y, 400) that face the camera, by the lamp of lamp_bench per radiance.

    Its cosines are (600 - y) / r at the lamp and (400 - z) / r at the sheet, where the lamp lies before the sheet.
    """
    (lx, dx), (lz, dz) = gauss(-200.0, 200.0, 24), gauss(220.0, 380.0, 24)
    away = np.stack(np.broadcast_arrays(lx[:, None], 600.0, lz))
    total = np.zeros(np.shape(x))
    for i, j in np.ndindex(lx.size, lz.size):
        r2 = (away[0, i, j] - x) ** 2 + (600 - y) ** 2 + (400 - away[2, i, j]) ** 2
        total += dx[i] * dz[j] * (600 - y) * (400 - away[2, i, j]) / r2**2
    return total


def test_the_lamp_of_the_bench(shipped_bench: Callable[..., Bench]) -> None:
    """The print, pixel by pixel, times the lamp's irradiance, seen by the middle of each quarter of the sensor."""
    from skimage.io import imread

    bench = shipped_bench("lamp_bench", mask="open")
    frame = ambient_frame(bench, anchors=2)
    reflectance = np.asarray(imread(shipped_path("scenes", "lamp_bench", "reflectance.png")), dtype=float) / 255
    assert reflectance.ndim == 2
    rows, columns = reflectance.shape
    y, x = 64 - (np.arange(rows) + 0.5) * 128 / rows, 64 - (np.arange(columns) + 0.5) * 128 / columns
    coarse = np.linspace(-64, 64, 33)
    grid = by_lamp(*np.meshgrid(coarse, coarse))
    light = np.stack([np.interp(x, coarse, line) for line in grid])  # (coarse y, columns)
    light = np.stack([np.interp(y, coarse, line) for line in light.T], axis=1)  # (rows, columns)
    assert light.max() / light.min() > 1.4
    quarter = bench.geometry.half_width / 2
    expected = np.zeros((2, 2))
    for i, v in enumerate((quarter, -quarter)):
        for j, u in enumerate((quarter, -quarter)):
            squared = (np.square(x - u) + np.square(y[:, None] - v)) / 400**2
            expected[i, j] = 11.7 / np.pi * (reflectance * light / (1 + squared) ** 2).sum() * (128 / rows / 400) ** 2
    found = frame.reshape(2, 256, 2, 256).mean(axis=(1, 3))
    assert found == pytest.approx(expected, rel=3e-3)


CONSTANT = '<emitter type="constant"><spectrum name="radiance" value="3"/></emitter>'


@pytest.mark.parametrize("interreflection", [False, True])
def test_a_sheet_under_a_constant_sky(small_scene: SmallScene, interreflection: bool) -> None:
    """A diffuse sheet that fills the field stop shines with albedo x radiance; nothing else is in the sky's way."""
    # 64 mm at 400 mm reach a tan of 0.16; the window (0.15) and the stop (0.1495) are inside.
    scene = small_scene(mask="open", fov=17, albedo=0.5, extra=CONSTANT)
    scene.write_text(scene.read_text().replace('name="albedo" value="0.5"', 'name="albedo" value="0.8"'))
    frame = ambient_frame(open_bench(scene), samples=64, interreflection=interreflection)
    expected = 0.8 * 3 * solid_angle(np.tan(np.radians(8.5)))
    assert frame.mean() == pytest.approx(expected, rel=2e-3)
    assert np.ptp(frame) < 0.02 * expected


def test_the_sky_itself(small_scene: SmallScene) -> None:
    """No sheet: every path runs into the sky, infinitely far away."""
    scene = small_scene(mask="open", fov=17, extra=CONSTANT)
    scene.write_text(re.sub(r'<shape type="rectangle">.*?</shape>', "", scene.read_text(), flags=re.DOTALL))
    frame = ambient_frame(open_bench(scene), samples=16)
    assert frame.mean() == pytest.approx(3 * solid_angle(np.tan(np.radians(8.5))), rel=2e-3)


# ---- pixels and the mask's thickness


@pytest.mark.parametrize(
    ("options", "effect"),
    [
        ({"angular_exponent": 6}, "pixel-response"),
        ({"pixel_fill_factor": 0.6}, "pixel-response"),
        ({"mask_thickness": 0.03}, "mask-thickness"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_pixels_and_thick_masks_agree(tmp_path: Path, options: dict[str, float], effect: str) -> None:
    folder = tmp_path / "photograph"
    shutil.copytree(shipped_path("scenes", "photograph"), folder)
    text = (folder / "scene.xml").read_text()
    added = "".join(f'<float name="{name}" value="{value}"/>' for name, value in options.items())
    text, found = re.subn(r'(<sensor type="mitsim_lensless"[^>]*>)', rf"\1{added}", text)
    assert found == 1
    (folder / "scene.xml").write_text(text)
    pair = pair_of(open_bench(folder / "scene.xml"), "uniform", 0, 1e-3, 4, (effect,))
    agrees(pair)
    differs(pair, pair.without(effect))


# ---- the projector's lens


GLOSS = """<bsdf type="roughconductor"> <string name="material" value="none"/> <float name="alpha" value="{alpha}"/>
    <spectrum name="specular_reflectance" value="0.9"/></bsdf>"""
TURN = '<rotate z="1" angle="180"/> <scale x="64" y="64"/>'


def glossy(shared_scene: SmallScene, name: str, alpha: float) -> Path:
    """The small scene's sheet as a nearly perfect mirror, turned so that the sensor's middle sees the projector."""
    scene = shared_scene(name)
    text = re.sub(r'<bsdf type="diffuse">.*?</bsdf>', GLOSS.format(alpha=alpha), scene.read_text(), flags=re.DOTALL)
    assert TURN in text
    # The normal (0, 0, -1) leans toward +x, to the projector at x = 60.
    scene.write_text(text.replace(TURN, TURN + ' <rotate y="-1" angle="4.2654"/>'))
    return scene


def with_lens(bench: Bench, radius: float, focus: float | None = None) -> Bench:
    lens = {"aperture_radius_mm": radius, "focus_mm": focus}
    return replace(bench, devices=replace(bench.devices, projector=bench.projector.model_copy(update=lens)))


def reference_with_lens(bench: Bench, shown: np.ndarray, spp: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and its variance by the reference, the projector's lens a disk that shines."""
    import mitsuba as mi

    from mitsim.transport import plugins
    from tests.aperture import aperture_scene_parts

    plugins.register()
    with show_pattern(bench, shown):
        parts = aperture_scene_parts(
            bench.loaded.projector, bench.projector_optics.aperture, bench.projector_optics.focus
        )
    shapes = {f"shape{i}": shape for i, shape in enumerate(bench.loaded.scene.shapes())}
    integrator = {"type": "path", "max_depth": 2}
    scene = mi.load_dict({"type": "scene", "integrator": integrator, "camera": bench.loaded.camera, **shapes, **parts})
    frames = np.stack([np.array(mi.render(scene, spp=spp, seed=300 + i), np.float64)[..., 0] for i in range(PASSES)])
    return frames.mean(axis=0), frames.var(axis=0, ddof=1) / PASSES


def lens_pair(bench: Bench, shown: np.ndarray, spp: int, accuracy: float = 3e-3) -> Pair:
    forced = {"diffraction": False, "black-level": False, "interreflection": False, "aperture": True}
    plan = make_plan(bench, classes_of(shown), accuracy, seed=21, switches=forced)
    frame, groups, light = frame_of(bench, plan, shown)
    return Pair(*reference_with_lens(bench, shown, spp), frame, groups, light, bench, plan, shown)


@pytest.mark.parametrize(("alpha", "spp"), [(0.02, 2048), (0.05, 512)])
def test_a_near_mirror_and_a_lens_agree(shared_scene: SmallScene, alpha: float, spp: int) -> None:
    bench = with_lens(open_bench(glossy(shared_scene, f"gloss{alpha}", alpha)), 5.0)
    pair = lens_pair(bench, np.ones((bench.n, bench.n)), spp)
    agrees(pair)
    assert 0.02 * pair.reference.sum() > LIMIT * np.sqrt(pair.variance.sum()), "sharp enough to see 2 %"
    differs(pair, 0.97 * pair.factored)


def test_defocused_dots_agree(shared_scene: SmallScene) -> None:
    """A diffuse sheet 200 mm behind the sharp plane: each dot (7.5 mm) is blurred by a disk of 10 mm radius."""
    bench = with_lens(open_bench(shared_scene("blurred")), 10.0, 200.0)
    family = bench.family("dots:7")
    shown = family.light(family.shots[17])
    pair = lens_pair(bench, shown, 1024)
    agrees(pair)
    sharp = frame_of(with_lens(bench, 10.0, 400.0), pair.plan, shown)[0]
    differs(pair, sharp)


def test_a_small_lens_is_a_pinhole(shared_scene: SmallScene) -> None:
    """The light of a diffuse sheet, the same to a part of the radius over the distance."""
    bench = open_bench(shared_scene("pinhole"))
    shown = np.ones((bench.n, bench.n))
    off = {"diffraction": False, "black-level": False, "interreflection": False}
    frames = [
        frame_of(one, make_plan(one, classes_of(shown), 1e-3, 23, {**off, "aperture": one is not bench}), shown)[0]
        for one in (bench, with_lens(bench, 1e-3))
    ]
    assert np.linalg.norm(frames[1] - frames[0]) < 3e-3 * np.linalg.norm(frames[0])


# ---- black level


def test_black_pixels_shine_by_one_over_the_contrast(shipped_bench: Callable[..., Bench]) -> None:
    """Contrast 100: every frame is 1 % of the uniform one and 99 % of its own, specular chains included."""
    sharp = shipped_bench("mirror")
    grey = sharp.projector.model_copy(update={"contrast_ratio": 100.0})
    bench = replace(sharp, devices=replace(sharp.devices, projector=grey))
    dots = bench.family("dots:3").lighting
    lighting = Lighting(dots.labels, np.concatenate([dots.weights, np.ones((1, 9)), np.zeros((1, 9))]))
    frames = {}
    for on in (True, False):
        forced = {"black-level": on, "diffraction": False, "mirrors": True, "interreflection": False}
        plan = make_plan(bench, lighting, 3e-2, 31, forced)
        light = trace_light(bench, plan, lighting, 31, Sampling(by_pixel=False))
        frames[on] = np.stack([frame.irradiance for frame in light.merge().frames(lighting, 0)])
    uniform = frames[False][9]
    expected = 0.01 * uniform + 0.99 * frames[False]
    assert np.linalg.norm(frames[True] - expected) < 1e-9 * np.linalg.norm(expected)
    assert not frames[False][10].any()
