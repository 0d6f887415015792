"""The waterfall: light without some of its effects is as formulas say, its steps add up, and its ends are those of
other studies."""

from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import mitsim as ms
from mitsim.core.arrays import FloatArray
from mitsim.light.light import SampledLight
from mitsim.metrics import psnr
from mitsim.report import IDEALISED
from mitsim.report.lit_scene import LitScene
from mitsim.studies import waterfall_study as waterfall
from mitsim.studies.framework.experiment import Point, Results, Setup
from mitsim.studies.framework.studio import Studio
from mitsim.studies.waterfall_study import EFFECTS, FALLOFF, SCENE, STUDY, Ablation, assumed_image

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


def test_the_first_step_is_the_idealised_image_of_other_studies(studio: Studio, setup: Setup) -> None:
    """To 0.3 dB. With falloff its error is that of the traced flux, in units of the white board's mean, beside that of
    noise. (Planted: another exposure; the brightness of the whole frame.)"""
    lit, ablation = studio.lit_scene(setup), Ablation(studio.lit_scene(setup).light)
    off = frozenset(ablation.effects)
    without, having = (assumed_image(ablation.without(off - on), FAMILY, 3).image for on in ({""}, {FALLOFF}))
    wanted_db = studio.image(setup, IDEALISED, FAMILY, 3).quality.psnr_db
    assert psnr(without, lit.truth) == pytest.approx(wanted_db, abs=0.3) and wanted_db > 30
    flux = lit.light.flux.reshape(lit.truth.shape)
    wanted = np.square(flux / lit.board_flux - lit.truth).mean()
    noise, found = (np.square(image - lit.truth).mean() for image in (without, having))
    assert found - noise == pytest.approx(wanted, rel=0.1) and wanted > 3 * noise


def test_steps_add_up_to_the_rendered_image(studio: Studio, setup: Setup) -> None:
    """(Planted: a step that begins before its neighbour's end.)"""
    found = [waterfall._measure(studio, Point.of(setup, patterns=FAMILY, seed=3, effect=name)).rows[0]
             for name in EFFECTS]  # fmt: skip
    assert [row["effect"] for row in found if row["called_for"]] == [FALLOFF, "diffraction", SCENE]
    assert found[0]["without_db"] == found[0]["ideal_db"]
    for one, following in pairwise(found):
        assert one["with_db"] == following["without_db"]
    whole = assumed_image(studio.lit_scene(setup).light, FAMILY, 3).image
    assert found[-1]["with_db"] == psnr(whole, studio.lit_scene(setup).truth)


def invented() -> Results:
    """An effect costs 1 dB; the scene does not call for the last one."""
    rows = [
        {
            "point": f"{effect}{seed}", "picture": None, "patterns": "dots:7", "effect": effect, "seed": seed,
            "called_for": effect != EFFECTS[-1], "ideal_db": 50.0, "calibrated_db": 33.0, "change_db": -1.0,
            "with_db": 49.0 - EFFECTS.index(effect),
        }
        for seed in (0, 1)
        for effect in EFFECTS
    ]  # fmt: skip
    return Results(rows, {(f"{EFFECTS[-1]}0", name): np.full((2, 2), 0.5)
                          for name in ("truth", "idealised", "assumed", "calibrated")})  # fmt: skip


def test_the_figures_have_a_bar_for_each_effect_that_is_called_for() -> None:
    """And images of both ends. (Planted: all effects.)"""
    drawn = STUDY.draw(invented())
    assert set(drawn) == {"waterfall.png", "images.png"}
    axes = drawn["waterfall.png"].axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == list(EFFECTS[:-1])
    assert {bar.get_width() for bar in axes.patches} == {-1.0} and len(axes.patches) == len(EFFECTS) - 1
    captions = [axes.get_xlabel() for axes in drawn["images.png"].axes]
    assert captions == ["", "50.0 dB", f"{50 - len(EFFECTS)}.0 dB", "33.0 dB"]


def test_claims_tell_the_two_ends() -> None:
    first, second = STUDY.judge(invented())
    assert first.verdict == "not confirmed" and first.idealised.startswith("50.0") and first.rendered.startswith("33.0")
    assert second.verdict == "not confirmed" and second.idealised.startswith(f"{50 - len(EFFECTS)}.0")


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
    ablation = Ablation(far)
    assert ablation.effects == (FALLOFF, "diffraction", SCENE, "blur", "black-level", "speckle")
    assert np.array_equal(frames(ablation.without(frozenset())), frames(far))
    assert np.array_equal(frames(ablation.without(frozenset({"ambient"}))), frames(far)), "which it does not have"
    assert ablation.without(frozenset({"speckle"})).speckle() == 0 < far.speckle()


@pytest.mark.parametrize("scene", ["far", "turned"])
def test_without_all_it_is_the_idealised_model(scene: str, request: pytest.FixtureRequest) -> None:
    """An even sheet at the aligned distance that shows the truth, pixel by pixel, though the traced one lies elsewhere,
    blurred, under a keystone. (Planted: each effect left in.)"""
    light = request.getfixturevalue(scene)
    ablation, bench = Ablation(light), light.bench
    family, whole = bench.family(FAMILY), frozenset(ablation.effects)
    wanted = np.stack([frame.irradiance for frame in LitScene(light).expected_frames(IDEALISED, family)])
    assert apart(found := frames(ablation.without(whole)), wanted) < 5e-5
    for effect in whole & {FALLOFF, "diffraction", "black-level"}:
        assert apart(frames(ablation.without(whole - {effect})), found) > 1e-4, effect
    assert apart(frames(light), found) > 0.05


def test_light_without_blur_is_traced_again(far: SampledLight) -> None:
    """With the same paths. (Planted: the blurred light.)"""
    sharp = Ablation(far).without(frozenset({"blur"}))
    assert apart(frames(sharp), frames(far)) > 1e-2
    assert sharp.flux.sum() == pytest.approx(far.flux.sum(), rel=2e-2)


def test_black_level_adds_a_part_of_uniform_light(far: SampledLight) -> None:
    """b + (1 - b) w of every pixel: frames are (1 - b) of those without, and b of the uniform frame. (Planted: 1 for
    1 - b.)"""
    without, leak = Ablation(far).without(frozenset({"black-level"})), 1 / 100
    (uniform,) = without.frames(far.bench.family("uniform").lighting, 0)
    assert apart(frames(far), (1 - leak) * frames(without) + leak * uniform.irradiance) < 1e-9
