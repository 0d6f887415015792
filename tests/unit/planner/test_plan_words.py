"""What a plan says: of devices that the model does not cover, of effects, and as JSON; benches are plain numbers."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mitsim.api.bench import Bench
from mitsim.light.settings import Approximation, PilotResult, Settings
from mitsim.planner.planner import SceneFacts
from mitsim.scene.check import Unfit
from mitsim.scene.outline import Tag
from tests.unit.planner.invented_pilot_result import ONE_CLASS, PILOT_RESULT, SIZES, changes, plan, rows, stages


def bench(
    cuts: bool = False,
    shift: float = 0.0,
    feature: float = 0.06,
    glare: float = 0.0,
    mirrors: bool = False,
    curve: object = None,
    coloured: tuple[Tag, ...] = (),
) -> Bench:
    geometry = SimpleNamespace(
        wall_shift_features=shift, mask_thickness=0.5, mask_feature=feature, diffracts=True, mask_plate=None,
        build_mask=lambda: SimpleNamespace(opening_mm=2 * feature),
        tilt_shift_mm=0.0, tilt_left_out=lambda waves: False, mask_tilt=(0.0, 0.0),
    )  # fmt: skip
    return SimpleNamespace(  # type: ignore[return-value]
        field_stop_cuts=cuts,
        geometry=geometry,
        spectrum=SimpleNamespace(wavelengths_nm=np.array([450.0, 620.0])),
        loaded=SimpleNamespace(
            pixels=SimpleNamespace(keystone=2.5),
            unfit=Unfit(),
            shapes=(),
            mirrors=mirrors,
            in_view=False,
            small_lamps=(),
            coloured=coloured,
            parting=(),
        ),
        lines=None,
        projector=SimpleNamespace(glare=glare, aperture_radius_mm=0.0),
        sensor=SimpleNamespace(quantum_efficiency_curve=curve),
    )


@pytest.mark.parametrize(
    ("device", "words"),
    [
        (bench(), []),
        (bench(cuts=True), ["field stop (fov) cuts into the projector's window"]),
        (bench(shift=0.99), []),
        (bench(shift=1.0), ["0.5 mm shifts the far face by 1.0 features"]),
        (bench(feature=6.2e-4), []),
        (bench(feature=6.1e-4), ["less than 2 wavelengths of 620 nm"]),
        (bench(glare=0.02), []),
        (bench(mirrors=True), []),
        (bench(glare=0.02, mirrors=True), ["0.02 of the light over mirrors alone is to be scattered"]),
    ],
)
def test_devices_are_flagged_where_their_model_ends(
    monkeypatch: pytest.MonkeyPatch, device: Bench, words: list[str]
) -> None:
    """At a wall's shift of one feature, and a feature of the longest wavelength."""
    monkeypatch.setattr("mitsim.planner.planner.EFFECTS", {})
    facts = SceneFacts.of(device)
    assert facts.keystone == 2.5 and len(facts.warnings) == len(words)
    for warning, part in zip(facts.warnings, words, strict=True):
        assert part in warning


@pytest.mark.parametrize(
    ("lacking", "words"),
    [
        (
            {"unresolved": 0.2, "left_out": 0.1},
            "of which the frames lack most, 2.0e-01; give",
        ),
        ({"left_out": 9.9e-3}, "a mirror or curved glass twice, or once and a sharp lobe (left out), 9.9e-03; turn"),
        ({"unresolved_specular": 0.2}, "alone, in beams too fine to be placed on the sensor, 2.0e-01; use fewer"),
    ],
)
def test_light_that_frames_lack_is_told_with_its_part_and_a_remedy(lacking: dict[str, float], words: str) -> None:
    """Where it breaks the accuracy, as the largest part; else it is a part of all."""
    (warning,) = plan(1e-2, replace(PILOT_RESULT, **lacking)).warnings
    assert "largest: light over" in warning and words in warning
    assert not plan(1e-2, replace(PILOT_RESULT, **dict.fromkeys(lacking, 1e-4))).warnings
    (other,) = plan(1e-6, ONE_CLASS).warnings
    assert "largest: layers (4)" in other, "light that is all resolved is no reason"


def test_effects_that_are_off_take_no_seconds_and_switches_are_named() -> None:
    found = rows(plan(effects="+ambient,-interreflection"))
    for name, row in found.items():
        assert row.seconds == 0 or row.state != "off", name
        assert ("switched by the user" in row.reason) == (name in ("ambient", "interreflection")), name
    assert found["diffraction"].reason == "Fresnel number 3.2" and found["diffraction"].seconds > 0
    assert found["blur"].reason == "" and found["blur"].state == "exact"
    assert found["blur"].seconds == 0


FOLLOWS = replace(PILOT_RESULT, changes=changes(SIZES | {Approximation("ambient"): 5e-2}))
"""Light of lamps that no budget can do without, seen from two points a side of the sensor."""


def seconds(settings: Settings, pilot_result: PilotResult = FOLLOWS) -> float:
    return sum(stages(pilot_result, settings).values())


@pytest.mark.parametrize("pace", [1.0, 3.0])
def test_seconds_are_those_of_every_stage_once(pace: float) -> None:
    """Paths at the machine's pace, which decides nothing: resuming needs the same settings everywhere."""
    found = plan(pilot_result=FOLLOWS, pace=pace)
    expected = stages(FOLLOWS, found.settings, pace)
    assert found.predicted == pytest.approx(expected) and min(expected.values()) > 0
    assert found.predicted_seconds == pytest.approx(sum(expected.values()))
    assert found.settings == plan(pilot_result=FOLLOWS).settings


def test_a_row_tells_what_one_of_it_would_save_and_leave() -> None:
    """Seconds with and without, samples as they are; the error of one anchor, layer and point, not of two."""
    found = plan(pilot_result=FOLLOWS)
    settings, reported = found.settings, rows(found)
    assert settings.anchors > 1 and settings.layers and settings.followed_anchors == 2
    for name, less in (
        ("anchors", replace(settings, anchors=1)),
        ("layers", replace(settings, layers=())),
        ("followed-anchors", replace(settings, followed_anchors=1)),
        ("diffraction", replace(settings, effects=settings.effects - {"diffraction"})),
    ):
        assert (
            reported[name].seconds == pytest.approx(seconds(settings) - seconds(less)) and reported[name].seconds > 0
        ), name
    assert reported["followed-anchors"].error_if_off == pytest.approx(SIZES[Approximation("followed_anchors", 1)])
