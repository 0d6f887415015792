"""The waterfall: light without some of its effects is as formulas say, its steps add up, and its ends are those of
other studies."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mitsim as ms
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import shipped_path
from mitsim.devices.sensor import SensorModel, load_sensor
from mitsim.light.light import SampledLight, traced_again
from mitsim.light.passes import GRIDS, Simulation
from mitsim.light.settings import SharpPixels
from mitsim.metrics import psnr
from mitsim.report import IDEALISED
from mitsim.report.lit_scene import LitScene
from mitsim.studies import waterfall_study as waterfall
from mitsim.studies.framework.experiment import Results, Setup
from mitsim.studies.framework.studio import Studio
from mitsim.studies.waterfall_study import EFFECTS, IN_ORDER, LEFT_OUT, STUDY, Ablation, Levels
from mitsim.transport.records import DIRECT, PathSamples

pytestmark = pytest.mark.usefixtures("kept_plans", "draft_figures")

FAMILY = "dots:4"


@pytest.fixture(scope="module")
def setup(shared_scene: Callable[..., Path], variant: str) -> Setup:
    """A print 10 mm before the plane that the camera was calibrated at, seen by a region of its sensor. (Planted: the
    region in a calibration's identity as no file has it.)"""
    print_ = np.random.default_rng(2).integers(60, 230, (16, 16))
    path = shared_scene("waterfall", reflectance=print_, sheet_z=390)
    region = {"crop_offset_x": 1, "crop_offset_y": 3, "crop_width": 62, "crop_height": 60}
    film = " ".join(f'<integer name="{name}" value="{value}"/>' for name, value in region.items())
    path.write_text(path.read_text(encoding="utf-8").replace("<rfilter", f"{film}<rfilter"), encoding="utf-8")
    return Setup(str(path), variant=variant, accuracy=1e-2)


@pytest.fixture(scope="module")
def studio() -> Iterator[Studio]:
    with Studio() as kept:
        yield kept


@pytest.fixture(scope="module")
def levels(studio: Studio, setup: Setup) -> Levels:
    lit = studio.lit_scene(setup)
    return Levels(lit, FAMILY, 3)


def test_effects_are_those_that_the_scene_has(studio: Studio, setup: Setup, levels: Levels) -> None:
    """Without any, the image is the idealised one of other studies, to what sampling leaves. (Planted: another
    exposure.)"""
    assert waterfall.DEPTH in levels.effects and waterfall.SATURATION not in levels.effects
    wanted = studio.image(setup, IDEALISED, FAMILY, 3).quality.psnr_db
    assert psnr(levels.image(frozenset()).image, levels.lit.truth) == pytest.approx(wanted, abs=0.3) and wanted > 30


def test_falloff_costs_what_it_takes_from_the_truth(levels: Levels) -> None:
    """With the model assumed the image is the truth times the brightness of the white board: error X (b - 1), b of mean
    1, beside that of noise. (Planted: the brightness of the whole frame.)"""
    truth = levels.lit.truth
    without, having = (levels.image(on).image for on in (frozenset[str](), frozenset({waterfall.FALLOFF})))
    flux = levels.lit.light.apparent.board_flux.reshape(truth.shape)
    wanted = np.square(truth * (flux / flux.mean() - 1)).mean()
    noise, found = (np.square(image - truth).mean() for image in (without, having))
    assert found - noise == pytest.approx(wanted, rel=0.1) and wanted > 3 * noise


@pytest.mark.parametrize("effect", EFFECTS)
def test_ways_differ_by_the_effect_alone(effect: str) -> None:
    for way in (waterfall.ALONE, IN_ORDER, LEFT_OUT):
        before, after = waterfall.ends(way, effect)
        assert after - before == {effect} and before < after
    assert waterfall.ends(IN_ORDER, EFFECTS[0])[0] == waterfall.ends(waterfall.ALONE, effect)[0] == frozenset()
    assert waterfall.ends(IN_ORDER, EFFECTS[-1])[1] == waterfall.ends(LEFT_OUT, effect)[1] == frozenset(EFFECTS)


def sensor() -> SensorModel:
    return load_sensor(shipped_path("calibration", "imx249.toml"))


def test_a_sensor_without_saturation_keeps_its_steps() -> None:
    own = sensor()
    open_ended = waterfall.sensor_without(own, frozenset({waterfall.SATURATION}))
    assert open_ended.superpixel_full_well_e == 1024 * own.superpixel_full_well_e
    assert open_ended.largest_dn is not None and open_ended.largest_dn > 100 * (own.largest_dn or 0)
    assert open_ended.gain_dn_per_e == own.gain_dn_per_e
    smooth = waterfall.sensor_without(own, frozenset({waterfall.QUANTISATION}))
    assert smooth.bits is None and smooth.full_well_e == own.full_well_e
    assert waterfall.sensor_without(own, frozenset()) == own
    binned = waterfall.sensor_without(own.model_copy(update={"binning": 64}), frozenset({waterfall.SATURATION}))
    assert (binned.largest_dn or 0) < 2**32


def test_saturation_is_called_for_where_light_can_reach_the_end() -> None:
    """0.8 of 129 440 electrons are 70 deviations below the end, of 40 electrons one; so is an ADC that ends at 0.82."""
    own = sensor()
    assert not waterfall.fills_well(own, 0.0) and waterfall.fills_well(own, 0.1)
    assert waterfall.fills_well(own.model_copy(update={"full_well_e": 10.0}), 0.0)
    short = own.model_copy(update={"gain_dn_per_e": own.gain_dn_per_e / 0.805})
    assert waterfall.fills_well(short, 0.0)


def invented() -> Results:
    """An effect costs 1 dB in any way; the scene does not call for the last one."""
    rows = [
        {
            "point": f"{way}{effect}{seed}", "picture": None, "way": way, "effect": effect, "seed": seed,
            "called_for": effect != EFFECTS[-1], "ideal_db": 50.0, "calibrated_db": 33.0, "change_db": -1.0,
            "with_db": 49.0 - (EFFECTS.index(effect) if way == IN_ORDER else 0),
        }
        for seed in (0, 1)
        for way in (waterfall.ALONE, IN_ORDER)
        for effect in EFFECTS
    ]  # fmt: skip
    return Results(rows, {(f"{IN_ORDER}{EFFECTS[-1]}0", name): np.full((2, 2), 0.5)
                          for name in ("truth", "idealised", "assumed", "calibrated")})  # fmt: skip


def test_the_figures_have_a_bar_for_each_effect_that_is_called_for() -> None:
    """And images of both ends. (Planted: all effects.)"""
    drawn = STUDY.draw(invented())
    assert set(drawn) == {"waterfall.png", "images.png"}
    axes = drawn["waterfall.png"].axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == list(EFFECTS[:-1])
    assert {bar.get_width() for bar in axes.patches} == {-1.0} and len(axes.patches) == 2 * (len(EFFECTS) - 1)
    captions = [axes.get_xlabel() for axes in drawn["images.png"].axes]
    assert captions == ["", "50.0 dB", "34.0 dB", "33.0 dB"]


def test_claims_tell_the_two_ends() -> None:
    first, second = STUDY.judge(invented())
    assert first.verdict == "not confirmed" and first.idealised.startswith("50.0") and first.rendered.startswith("33.0")
    assert second.verdict == "not confirmed" and second.idealised.startswith("34.0")


# -------- Light without some of its effects

PRINT = np.random.default_rng(4).integers(20, 230, (48, 48))
TURNED = '<rotate y="1" angle="-9"/>'
VALUES = {"effective_wavelength_nm": 562.0, "contrast_ratio": 100.0, "blur_pixels": 0.6, "speckle_contrast": 0.05}
PROJECTOR = "name = 'contrast 100, blurred, with speckle'\n" + "".join(f"{k} = {v}\n" for k, v in VALUES.items())


def frames(light: SampledLight) -> FloatArray:
    lighting = light.bench.family(FAMILY).lighting
    return np.stack([frame.irradiance for frame in light.frames(lighting, 0)])


def apart(found: FloatArray, wanted: FloatArray) -> float:
    return float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))


@pytest.fixture(scope="module")
def far(shared_scene: Callable[..., Path], variant: str) -> SampledLight:
    """A print 20 mm before the aligned plane, whose texels are thirds of projector pixels, under a projector of low
    contrast."""
    path = shared_scene("far", reflectance=PRINT, sheet_z=380, fov=30)
    device = path.parent / "device.toml"
    device.write_text(PROJECTOR)
    return ms.open_bench(path, variant, projector=device).light(FAMILY, accuracy=1e-2)


@pytest.fixture(scope="module")
def turned(shared_scene: Callable[..., Path], variant: str) -> SampledLight:
    """A print that a turned projector lights."""
    path = shared_scene("turned", reflectance=PRINT, projector_turn=TURNED, fov=40)
    return ms.open_bench(path, variant).light(FAMILY, accuracy=1e-2)


def test_nothing_taken_out_is_the_light_itself(far: SampledLight) -> None:
    ablated = Ablation(far)
    assert ablated.without(frozenset()) is far
    assert ablated.without(frozenset({"ambient", waterfall.KEYSTONE, waterfall.GLOSS})) is far, "which it does not have"
    own = ("falloff", "diffraction", "depth", "detail", "black level", "defocus", "speckle", "render noise")
    assert ablated.effects == own


def test_the_same_paths_are_traced_again(far: SampledLight) -> None:
    """To the renderer's float32. (Planted: another purpose's streams.)"""
    again = traced_again(far, waterfall._AblationSimulation(far.bench, far.simulation.settings, True, frozenset()))
    for own, other in zip(far.groups, again.groups, strict=True):
        for grid in GRIDS:
            assert abs(own[grid] - other[grid]).sum() <= 1e-6 * own["fine"].sum()
    assert np.allclose(again.flux, far.flux, rtol=1e-6)


@pytest.mark.parametrize("scene", ["far", "turned"])
def test_without_all_it_is_the_idealised_model(scene: str, request: pytest.FixtureRequest) -> None:
    """An even sheet at the aligned distance that shows the truth, pixel by pixel, though the traced one lies elsewhere,
    blurred, under a keystone. (Planted: each effect left in.)"""
    light = request.getfixturevalue(scene)
    ablated, lit = Ablation(light), LitScene(light)
    wanted = np.stack([frame.irradiance for frame in lit.expected_frames(IDEALISED, light.bench.family(FAMILY))])
    whole = frozenset(ablated.effects)
    assert apart(frames(ablated.without(whole)), wanted) < 5e-5
    for effect in whole - {waterfall.SPECKLE, waterfall.DETAIL}:
        assert apart(frames(ablated.without(whole - {effect})), wanted) > 1e-4, effect
    assert apart(frames(light), wanted) > 0.05


def sharp_path_samples(light: SampledLight) -> PathSamples:
    """A ray from each projector pixel, without blur."""
    settings = light.simulation.settings
    settings = replace(settings, effects=settings.effects - {"blur"})
    return Simulation(light.bench, settings).direct.trace(1, 0, 1)


def pixel_of(light: SampledLight, path_samples: PathSamples) -> FloatArray:
    """Where ``path_samples`` lie on the aligned plane, by projector pixels that fill the window's bounding box."""
    n = light.bench.n
    places = [
        np.floor((tangents - first) / (last - first) * n)
        for tangents, (first, last) in zip((path_samples.row, path_samples.column), light.bench.windows, strict=True)
    ]
    return np.asarray(places[0] * n + places[1])


def test_depth_is_parallax(far: SampledLight) -> None:
    """The projector, 60 mm aside (x = 60, column -60), 20 mm before the plane: light is seen 60 (1/380 - 1/400) aside,
    0.35 pixels, and without depth in its pixel on the plane. (Planted: the projector on the other side.)"""
    path_samples, place = sharp_path_samples(far), waterfall._Place(far.bench)
    aside = place.parallax(path_samples)
    assert np.allclose(aside[1], -60 * (1 / 380 - 1 / 400), rtol=1e-3) and np.abs(aside[0]).max() < 1e-6
    assert (pixel_of(far, path_samples) != path_samples.pixel).mean() > 0.2
    back = place.move(path_samples, frozenset({waterfall.DEPTH}))
    assert np.allclose(back.inverse_depth, 1 / 400) and np.array_equal(pixel_of(far, back), path_samples.pixel)
    assert waterfall.DEPTH in Ablation(far).effects


def test_without_keystone_light_lies_in_its_pixel(turned: SampledLight) -> None:
    """(Planted: the homography the other way round.)"""
    ablated = Ablation(turned)
    assert waterfall.KEYSTONE in ablated.effects and waterfall.DEPTH not in ablated.effects
    path_samples = sharp_path_samples(turned)
    assert (pixel_of(turned, path_samples) != path_samples.pixel).mean() > 0.2
    straight = waterfall._Place(turned.bench).move(path_samples, frozenset({waterfall.KEYSTONE}))
    assert np.array_equal(pixel_of(turned, straight), path_samples.pixel)
    assert np.array_equal(straight.inverse_depth, path_samples.inverse_depth)


def test_falloff_is_the_fourth_power_of_the_cosine(far: SampledLight) -> None:
    """Of a shifted lens, seen from the sensor's centre: (1 + tan^2)^-2. (Planted: the square root.)"""
    rows, columns = (np.linspace(*window, far.bench.n + 1) for window in far.bench.windows)
    middles = [(edges[1:] + edges[:-1]) / 2 for edges in (rows, columns)]
    wanted = (1 + middles[0][:, None] ** 2 + middles[1][None, :] ** 2) ** -2.0
    brightness = (1 / Ablation(far)._even).reshape(wanted.shape)
    # The mean over a small sensor is that of its centre to (half-width / distance)^2 = 1e-6; pixels of 7.5 mm: 2e-4.
    assert np.allclose(brightness, wanted / wanted.mean(), rtol=2e-3)


def test_black_level_adds_a_part_of_uniform_light(far: SampledLight) -> None:
    """b + (1 - b) w of every pixel: frames are (1 - b) of those without, and b of the uniform frame. (Planted: 1 for
    1 - b.)"""
    ablated, leak = Ablation(far), 1 / 100
    without = ablated.without(frozenset({waterfall.BLACK_LEVEL}))
    (uniform,) = without.frames(far.bench.family("uniform").lighting, 0)
    assert apart(frames(far), (1 - leak) * frames(without) + leak * uniform.irradiance) < 1e-9


def test_detail_is_what_cells_of_a_pixel_differ_in(far: SampledLight) -> None:
    """The same flux of each pixel, spread evenly over its cells: c x c of them have the same light. (Planted: the mean
    over all pixels.)"""
    ablated = Ablation(far)
    off = frozenset({waterfall.DETAIL, waterfall.DEFOCUS, waterfall.DEPTH})
    even = ablated.without(off)
    cells = sum(group["fine"] for group in even.groups)[:-1]
    per_pixel = even.simulation.settings.subdivision**2
    assert per_pixel > 1
    for pixel in (0, 37, 255):
        lit = np.sort(cells[[pixel]].toarray()[0])[::-1][:per_pixel]
        assert lit.min() > 0.9 * lit.max() and lit.sum() > 0.999 * cells[[pixel]].sum()
    uneven = sum(group["fine"] for group in ablated.without(off - {waterfall.DETAIL}).groups)[:-1]
    assert np.allclose(uneven.sum(axis=1), cells.sum(axis=1), rtol=1e-9)
    spread = [np.ptp(np.sort(light[[37]].toarray()[0])[::-1][:per_pixel]) for light in (cells, uneven)]
    assert spread[1] > 10 * spread[0]


@pytest.mark.slow
def test_gloss_is_what_the_sensor_sees_beyond_its_mean(shared_scene: Callable[..., Path], variant: str) -> None:
    """A glossy sheet: without gloss all points of the sensor see the mean over it; all light is as much."""
    path = shared_scene("glossy", reflectance=PRINT)
    matt, glossy = '<bsdf type="diffuse">', '<bsdf type="roughplastic"><float name="alpha" value="0.05"/>'
    text = path.read_text().replace(matt, glossy)
    path.write_text(text.replace('name="reflectance" type="bitmap"', 'name="diffuse_reflectance" type="bitmap"'))
    light = ms.open_bench(path, variant).light(FAMILY, accuracy=1e-3)
    ablated = Ablation(light)
    assert waterfall.GLOSS in ablated.effects
    plain = ablated.without(frozenset({waterfall.GLOSS}))
    assert plain.simulation.settings.anchors == 1
    whole, mean = frames(light), frames(plain)
    assert 1e-4 < apart(mean, whole) < 0.1
    assert mean.sum() == pytest.approx(whole.sum(), rel=2e-3)


def test_lobes_are_averaged_over_anchors_with_their_weights(far: SampledLight) -> None:
    """Light of one anchor alone comes to all, times its weight in the mean over it. (Planted: its row's twice.)"""
    sharp = SharpPixels((5,), 3, (-0.05, 0.05, -0.05, 0.05))
    simulation = Simulation(far.bench, replace(far.simulation.settings, sharp=sharp))
    one, zero = np.ones(1), np.zeros(1, np.int64)
    kind = np.full(1, DIRECT, np.int16)
    path_samples = PathSamples(zero + 5, zero + 2, zero + 1, 0 * one, 0 * one, one / 400, one, kind)
    labels = np.arange(far.bench.n**2)
    bundle = simulation.grids["sharp"].bundle
    accumulated, weights = bundle.accumulate(path_samples, labels, 1), simulation.mean_weights(bundle.anchors)
    mean = waterfall._even_lobes(accumulated, simulation)
    weight = weights[2] * weights[1]
    again = bundle.repeat(replace(bundle, anchors=1).accumulate(path_samples.average(weights), labels, 1))
    assert abs(mean - again).max() < 1e-12 and mean.sum() == pytest.approx(9 * weight)
    assert waterfall._even_lobes(accumulated, far.simulation) is accumulated, "nothing is sharp"


def test_what_is_moved_is_added_up_on_the_host(far: SampledLight) -> None:
    """Anchors see light without depth where the sensor's centre does: sums on the device would hold it where it was
    traced. (Planted: sums on the device.)"""
    settings = replace(far.simulation.settings, anchors=3, samples={"anchor_residual": 1e4})
    labels = np.arange(far.bench.n**2)
    for off, held in ((frozenset[str](), True), (frozenset({waterfall.DEPTH}), False)):
        accumulating = waterfall._AblationSimulation(far.bench, settings, True, off)
        assert (accumulating.accumulator("anchor_residual", labels, 1) is not None) == held
