"""The effect plan: from measured errors to what is simulated, as little as fits, and an honest word about the rest."""

import json
import math
from dataclasses import asdict, replace

import pytest

from mitsim.capture.effects import EFFECTS, SWITCHES, parse_switches
from mitsim.capture.evidence import GROUPS, Effort, Evidence, Noise
from mitsim.capture.plan import Plan, PlanRow, SceneFacts, check_accuracy, decide
from mitsim.core.errors import MitsimError

FACTS = SceneFacts(notes={"diffraction": "Fresnel number 3.2"}, keystone=0.0)
EVIDENCE = Evidence(
    depth=380.0,
    layers={1: (380.0,), 2: (400.0, 300.0), 3: (400.0, 343.0, 300.0), 4: (400.0, 369.0, 327.0, 300.0)},
    anchor_error={1: 2e-3, 2: 3e-4, 3: 4e-5, 5: 1e-5},
    layer_error={1: 4e-3, 2: 6e-4, 3: 2e-4, 4: 5e-5},
    cell_error={1: 6e-3, 2: 2e-3, 4: 1e-4, 6: 3e-5, 8: 1e-5},
    effect_error={"interreflection": 2e-2, "diffraction": 0.3, "ambient": 5e-4, "blur": 1e-3, "speckle": 8e-3},
    direct_part=0.98,
    direct=Effort(Noise(2e-3, 16, 0.8), 16_384, 1e-7),
    anchored=Effort(Noise(3e-4, 4, 0.5), 16_384, 1e-7),
    indirect=Effort(Noise(4e-3, 2, 0.5), 16_384, 2e-7),
    from_camera=Effort(Noise(1e-2, 2, 0.5), 20_000, 6e-7),
    seconds_per_frame=2e-3,
    terms=3.0,
)
ACCURACIES = [0.1, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4]


def plan(accuracy: float = 1e-3, evidence: Evidence = EVIDENCE, effects: str = "", facts: SceneFacts = FACTS) -> Plan:
    return decide(accuracy, evidence, 49, facts, parse_switches(effects))


def rows(found: Plan) -> dict[str, PlanRow]:
    return {effect.name: effect for effect in found.effects}


# ---- effects


@pytest.mark.parametrize("accuracy", ACCURACIES)
def test_an_effect_is_on_when_leaving_it_out_costs_more_than_the_accuracy(accuracy: float) -> None:
    found = plan(accuracy)
    assert found.settings.effects == {name for name, error in EVIDENCE.effect_error.items() if error > accuracy}
    for name in EFFECTS:
        assert (rows(found)[name].state != "off") == (name in found.settings.effects)


def test_the_threshold_itself() -> None:
    """An error of exactly the accuracy is within it."""
    assert "blur" not in plan(1e-3).settings.effects
    assert "blur" in plan(math.nextafter(1e-3, 0)).settings.effects


def test_effects_that_the_scene_does_not_have_stay_off() -> None:
    found = rows(plan(1e-4))["mirrors"]
    assert found.state == "off" and found.error_if_off == 0 and found.reason == EFFECTS["mirrors"].absent


def test_every_switch_has_a_row_and_more() -> None:
    names = [effect.name for effect in plan().effects]
    assert len(set(names)) == len(names)
    assert set(SWITCHES) <= set(names)
    assert {"cells", "keystone", "spectrum", "sensor-noise"} <= set(names)
    for effect in plan().effects:
        assert effect.state in ("exact", "approximate", "off")
        assert effect.reason and "\n" not in effect.reason


@pytest.mark.parametrize("effects", ["", "+mirrors,-diffraction,+anchors,+layers,-interreflection"])
@pytest.mark.parametrize("accuracy", ACCURACIES)
def test_seconds_are_never_negative_and_nothing_off_costs_any(accuracy: float, effects: str) -> None:
    found = plan(accuracy, effects=effects)
    assert found.predicted_seconds > 0
    for effect in found.effects:
        assert 0 <= effect.seconds <= found.predicted_seconds
        if effect.state == "off":
            assert effect.seconds == 0


def test_what_costs_time_says_so() -> None:
    found = rows(plan())
    assert all(found[name].seconds > 0 for name in ("anchors", "layers", "interreflection", "diffraction"))


def test_rows_carry_the_measured_errors() -> None:
    found = rows(plan())
    assert found["anchors"].error_if_off == EVIDENCE.anchor_error[1]
    assert found["layers"].error_if_off == EVIDENCE.layer_error[1]
    for name, error in EVIDENCE.effect_error.items():
        assert found[name].error_if_off == error
    assert found["diffraction"].reason.startswith("Fresnel number 3.2; ")


def test_a_row_is_found_by_its_name() -> None:
    found = plan()
    assert all(found.row(row.name) is row for row in found.effects)
    with pytest.raises(MitsimError, match=r"plan: no row 'lens'; there are anchors, layers, .*aperture"):
        found.row("lens")


def test_it_shows_itself() -> None:
    found = plan(evidence=replace(EVIDENCE, effect_error={**EVIDENCE.effect_error, "ambient": 0.0}))
    shown = found._repr_html_()
    assert all(row.name in shown for row in found.effects) and "0.0e+00" not in shown
    assert repr(found).startswith("Plan(accuracy 0.001: anchors approximate") and "ambient" not in repr(found)


def test_a_plan_is_json_with_the_promised_keys() -> None:
    block = json.loads(json.dumps(asdict(replace(plan(), settings=replace(plan().settings, effects=())))))
    assert {"effects", "accuracy", "predicted_seconds", "settings", "warnings"} <= set(block)
    assert all(set(effect) == {"name", "state", "reason", "error_if_off", "seconds"} for effect in block["effects"])


# ---- numbers of anchors, layers and cells


@pytest.mark.parametrize(
    ("accuracy", "anchors", "layers", "cells"),
    [
        (1e-1, 1, 1, 1),
        (5e-3, 1, 1, 2),  # 4e-3 of one layer is within the accuracy
        (3e-3, 1, 2, 4),
        (1e-3, 2, 3, 4),  # 3e-4 and 2e-4 are below half of it, 6e-4 is not
        (2e-4, 3, 4, 4),  # exactly half
        (1e-4, 3, 4, 6),
    ],
)
def test_the_smallest_numbers_that_fit(accuracy: float, anchors: int, layers: int, cells: int) -> None:
    found = plan(accuracy).settings
    assert (found.anchors, len(found.depths), found.subdivision) == (anchors, layers, cells)
    assert found.depths == EVIDENCE.layers[layers] and found.depth == EVIDENCE.depth


def test_rows_of_numbers_are_off_at_one_and_approximate_beyond() -> None:
    many, one = rows(plan(1e-3)), rows(plan(1e-1))
    for name in ("anchors", "layers"):
        assert many[name].state == "approximate" and one[name].state == "off"


def test_the_best_there_is_when_nothing_fits() -> None:
    found = plan(1e-6).settings
    assert (found.anchors, len(found.depths), found.subdivision) == (5, 4, 8)


def test_a_flat_scene_has_one_layer_whatever_is_asked_for() -> None:
    flat = replace(EVIDENCE, layers={1: (400.0,)}, layer_error={1: 0.0}, depth=400.0)
    for effects in ("", "+layers", "-layers"):
        assert plan(1e-4, flat, effects).settings.depths == (400.0,)


# ---- the budget


@pytest.mark.parametrize("accuracy", ACCURACIES)
def test_sampling_gets_what_is_left(accuracy: float) -> None:
    found = plan(accuracy)
    assert 0 < found.sampling_target < accuracy
    if found.systematic_error <= 0.7 * accuracy:
        assert math.hypot(found.systematic_error, found.sampling_target) <= accuracy
    assert found.sampling_target > 0.6 * accuracy, "sampling must keep its share"


def test_the_systematic_error_is_all_that_was_left_out_or_made_coarse() -> None:
    found = plan(1e-3)
    parts = [3e-4, 2e-4, 1e-4, 5e-4, 1e-3]  # 2 anchors, 3 layers, cells; no ambient, no blur
    # What is filed in coarse cells comes on top, at most 0.4 of the accuracy.
    assert math.hypot(*parts) <= found.systematic_error <= math.hypot(*parts, 4e-4)


def test_less_error_costs_more() -> None:
    seconds = [plan(accuracy).predicted_seconds for accuracy in (1e-1, 1e-2, 1e-3, 1e-4)]
    assert seconds == sorted(seconds) and seconds[-1] > 10 * seconds[0]


def test_a_plan_that_fits_has_no_warning() -> None:
    quiet = replace(EVIDENCE, effect_error={"interreflection": 2e-2, "diffraction": 0.3, "ambient": 2e-4})
    assert not plan(1e-3, quiet).warnings


def test_what_does_not_fit_is_flagged_with_the_largest_part() -> None:
    found = plan(1e-3, effects="-interreflection,-diffraction")
    (warning,) = found.warnings
    assert "largest: diffraction (off), 3.0e-01" in warning
    assert found.systematic_error == pytest.approx(0.3, rel=0.01) and "0.001" in warning
    (warning,) = plan(1e-6).warnings
    assert "largest: layers (4), 5.0e-05" in warning


def test_warnings_of_the_devices_come_first() -> None:
    facts = replace(FACTS, warnings=("the field stop cuts",))
    assert plan(1e-6, facts=facts).warnings[0] == "the field stop cuts"
    assert len(plan(1e-6, facts=facts).warnings) == 2


def test_settings_do_not_depend_on_the_machines_pace() -> None:
    """Bit-equal repetition and --resume need it: the same seed must mean the same settings."""
    efforts = {
        name: replace(getattr(EVIDENCE, name), seconds=1e-4)
        for name in ("direct", "anchored", "indirect", "from_camera")
    }
    slow = replace(EVIDENCE, **efforts, seconds_per_frame=1.0)
    for accuracy in ACCURACIES:
        assert plan(accuracy).settings == plan(accuracy, slow).settings
        assert plan(accuracy).sampling_target == plan(accuracy, slow).sampling_target


# ---- choices of the user


@pytest.mark.parametrize(
    ("text", "chosen"),
    [
        ("", {}),
        ("+ambient", {"ambient": True}),
        ("+ambient,-diffraction", {"ambient": True, "diffraction": False}),
        (" -anchors , +layers,", {"anchors": False, "layers": True}),
        ("-blur,-blur", {"blur": False}),
        ("+mask-thickness,-black-level", {"mask-thickness": True, "black-level": False}),
    ],
)
def test_effects_are_parsed(text: str, chosen: dict[str, bool]) -> None:
    assert parse_switches(text) == chosen


@pytest.mark.parametrize(
    "text", ["ambient", "+", "-", "+fog", "*ambient", "+ambient,blur", "++ambient", "+cells", "+-"]
)
def test_names_that_are_no_effects_are_refused(text: str) -> None:
    with pytest.raises(MitsimError, match=r"^effects") as caught:
        parse_switches(text)
    assert all(name in str(caught.value) for name in SWITCHES) and "\n" not in str(caught.value)


def test_an_effect_both_on_and_off_is_refused() -> None:
    with pytest.raises(MitsimError, match="blur is switched both on and off"):
        parse_switches("+blur,+ambient,-blur")


@pytest.mark.parametrize("name", EFFECTS)
def test_the_users_choice_wins(name: str) -> None:
    assert name in plan(0.3, effects=f"+{name}").settings.effects
    assert name not in plan(1e-6, effects=f"-{name}").settings.effects


def test_the_users_choice_of_anchors_and_layers() -> None:
    more, less = plan(0.3, effects="+anchors,+layers").settings, plan(1e-6, effects="-anchors,-layers").settings
    assert (more.anchors, len(more.depths)) == (2, 2) and (less.anchors, less.layers) == (1, ())


def test_a_choice_is_named_as_the_users_own() -> None:
    found = rows(plan(1e-3, effects="-diffraction,+ambient"))
    assert "switched by the user" in found["diffraction"].reason and found["diffraction"].state == "off"
    assert "switched by the user" in found["ambient"].reason and found["ambient"].state == "exact"
    assert "switched by the user" not in found["interreflection"].reason


# ---- the rest


def test_noise_says_how_many_samples_it_takes() -> None:
    """Error 2e-3 at 16 samples, falling with their power -0.8: a tenth needs 10^(1/0.8) times as many."""
    noise = Noise(2e-3, 16, 0.8)
    assert noise.samples_for(2e-3) == pytest.approx(16)
    assert noise.samples_for(2e-4) == pytest.approx(16 * 10**1.25)
    assert 0 < Noise(0.0, 16, 1.0).samples_for(1e-9) <= 1


def test_a_keystone_is_told() -> None:
    keystone = rows(plan(facts=replace(FACTS, keystone=2.5)))["keystone"]
    assert "2.5" in keystone.reason and "separable" in keystone.reason
    assert "squarely" in rows(plan())["keystone"].reason


@pytest.mark.parametrize("accuracy", [0.0, -1e-3, 1e-7, 0.5, math.nan, math.inf])
def test_accuracies_that_cannot_be_promised(accuracy: float) -> None:
    with pytest.raises(MitsimError, match=r"^accuracy"):
        check_accuracy(accuracy)
    with pytest.raises(MitsimError, match=r"^accuracy"):
        plan(accuracy)


def test_samples_take_the_fewest_paths_for_the_target() -> None:
    """Variances v / N add up to the target's, and N is in proportion to sqrt(v / paths): the least sum of N paths."""
    anchored = replace(EVIDENCE.anchored, noise=Noise(8e-3, 4, 0.5))
    evidence = replace(EVIDENCE, direct=Effort.none(), anchored=anchored)
    found = plan(1e-3, evidence)
    counts = found.settings.anchored_samples, found.settings.indirect_samples, found.settings.from_camera_samples
    anchors = replace(anchored, paths=anchored.paths * found.settings.anchors**2)
    efforts = anchors, evidence.indirect, evidence.from_camera
    variance = sum(effort.variance / count for effort, count in zip(efforts, counts, strict=True))
    assert math.sqrt(variance / GROUPS) == pytest.approx(found.sampling_target)
    ratios = [count / math.sqrt(effort.variance / effort.paths) for effort, count in zip(efforts, counts, strict=True)]
    assert ratios == pytest.approx([ratios[0]] * 3) and min(counts) > 1


@pytest.mark.parametrize(
    ("keystone", "state", "words"), [(0.0, "off", "squarely"), (2.5, "exact", "2.5 of its pixels")]
)
def test_a_keystone_is_there_or_not(keystone: float, state: str, words: str) -> None:
    row = rows(plan(facts=replace(FACTS, keystone=keystone)))["keystone"]
    assert row.state == state and words in row.reason
