"""The waterfall: its ends are what other studies measure, its steps add up, single effects cost what formulas say."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.configuration import shipped_path
from mitsim.devices.sensor import SensorModel, load_sensor
from mitsim.light.passes import Simulation
from mitsim.metrics import psnr
from mitsim.report import EQUAL_PEAK, IDEALISED, RENDERED
from mitsim.report.lit_scene import LitScene
from mitsim.studies import waterfall_study as waterfall
from mitsim.studies.framework.experiment import Results, Scope, Setup
from mitsim.studies.framework.studio import Studio
from mitsim.studies.waterfall_study import EFFECTS, IN_ORDER, LEFT_OUT, STUDY, Levels

pytestmark = pytest.mark.usefixtures("kept_plans", "draft_figures")

FAMILY = "dots:4"
SEEDS = 3


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


@pytest.mark.slow
def test_quantisation_costs_a_twelfth_of_its_step(studio: Studio, setup: Setup, levels: Levels) -> None:
    """The same draws, rounded or not, of eight bits: images differ by 1/12 DN^2 a datum through the solver, the sum of
    1 / s^2 over the singular values of the idealised model. 3 seeds of 256 pixels tell that to 5 %; three of them are
    allowed. (Planted: 1/6; the gain of one pixel of four.)"""
    bench, lit = levels.lit.bench, studio.lit_scene(setup)
    eight = {"bits": 8, "gain_dn_per_e": 7e-3, "black_level_dn": 2.0}
    camera = replace(bench, devices=replace(bench.devices, sensor=bench.sensor.model_copy(update=eight)))
    light = replace(lit.light, simulation=Simulation(camera, lit.light.simulation.settings))
    other = LitScene(light)
    squares = []
    for seed in range(SEEDS):
        own = Levels(other, FAMILY, seed)
        rounded, exact = (own.image(on).image for on in (frozenset({waterfall.QUANTISATION}), frozenset[str]()))
        squares.append(float(np.square(rounded - exact).mean()))
    frames = other.idealised_frames(bench.family(FAMILY), 0)
    model, step_s = frames.prepare(), camera.sensor.gain_dn_per_e * frames.seconds(EQUAL_PEAK)
    gain = np.square(1 / np.outer(model.left.singular, model.right.singular)).sum() / other.truth.size
    assert np.mean(squares) == pytest.approx(gain / 12 / step_s**2, rel=0.15)


@pytest.mark.slow
def test_steps_add_up_to_the_whole(studio: Studio, setup: Setup) -> None:
    """In order, of a real scene; what it does not call for changes nothing at all."""
    scope = Scope(setup, (None,), seeds=(3,), quick=True)
    points = [point for point in STUDY.points(scope) if point["way"] == IN_ORDER]
    assert [point["effect"] for point in points] == list(EFFECTS)
    rows = [row for point in points for row in STUDY.measure(studio, point).rows]
    assert rows[0]["ideal_db"] + sum(row["change_db"] for row in rows) == pytest.approx(rows[-1]["with_db"], abs=1e-9)
    quiet = [row["change_db"] for row in rows if not row["called_for"]]
    assert len(quiet) > 5 and not any(quiet)
    assert all(row["flagged"] == bool(row["reason"]) for row in rows)
    assert any(row["flagged"] for row in rows)  # factors that no session gave
    wanted = studio.image(setup, RENDERED, "dots:7", 3)
    assert rows[-1]["calibrated_db"] == wanted.quality.psnr_db, "bit-equal to the rendered image of other studies"


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
