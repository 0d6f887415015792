"""The effect plan: from measured changes to the cheapest settings that keep an accuracy, and an honest word on them."""

import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest

from mitsim.capture.choice import cheapest, doubt, parts_of, predicted
from mitsim.capture.effects import EFFECTS, SWITCHES, parse_switches
from mitsim.capture.evidence import (
    GROUPS,
    LOOKS,
    Changes,
    Effort,
    Estimate,
    Evidence,
    Forming,
    Noise,
    Part,
    Settings,
    even,
)
from mitsim.capture.plan import Plan, PlanRow, SceneFacts, check_accuracy, decide
from mitsim.capture.prices import (
    FIXED,
    Numbers,
    Paces,
    checking_seconds,
    entries,
    optics_seconds,
    tracing_seconds,
    truth_seconds,
)
from mitsim.core.errors import MitsimError

FACTS = SceneFacts(notes={"diffraction": "Fresnel number 3.2"}, keystone=0.0)
SIZES = {
    **{Part("anchors", count): size for count, size in {1: 2e-3, 2: 3e-4, 3: 4e-5, 5: 1e-5}.items()},
    **{Part("layers", count): size for count, size in {1: 4e-3, 2: 6e-4, 3: 2e-4, 4: 5e-5}.items()},
    **{Part("cells", count): size for count, size in {1: 6e-3, 2: 2e-3, 4: 1e-4, 8: 1e-5}.items()},
    **{Part(name): size for name, size in {"interreflection": 2e-2, "diffraction": 0.3, "ambient": 5e-4}.items()},
    **{Part("followed_anchors", count): size for count, size in {1: 7e-4, 2: 9e-5, 3: 1e-5}.items()},
    Part("blur"): 1e-3,
    Part("anchored cells", 1): 2e-4,
    Part("indirect cells", 1): 4e-4,
    Part("indirect layers", 1): 3e-4,
}
APART = {"speckle": 8e-3}


def changes(sizes: dict[Part, float], noise: float = 0.0, seed: int = 0) -> Changes:
    """Changes at right angles to each other, each look with ``noise`` of its own: independent, of norm ``noise``."""
    rng, count = np.random.default_rng(seed), len(sizes)
    vectors = np.diag(list(sizes.values()))
    space = count + 40
    exact = np.zeros((count, space))
    exact[:, :count] = vectors
    looks = exact[:, None] + noise * rng.normal(size=(count, LOOKS, space)) / math.sqrt(space)
    return Changes.between(dict(zip(sizes, looks, strict=True)), 1.0)


EVIDENCE = Evidence(
    depth=380.0,
    layers={1: (380.0,), 2: (400.0, 300.0), 3: (400.0, 343.0, 300.0), 4: (400.0, 369.0, 327.0, 300.0)},
    changes=changes(SIZES),
    direct=Effort(Noise(2e-3, 16, 0.8), 16_384, 1e-7),
    spread=Effort(Noise(2e-3, 16, 0.8), 16_384, 1e-7),
    anchored=Effort(Noise(3e-4, 4, 0.5), 16_384, 1e-7),
    indirect=Effort(Noise(4e-3, 2, 0.5), 16_384, 2e-7),
    from_camera=Effort(Noise(1e-2, 2, 0.5), 20_000, 6e-7),
    followed=Effort(Noise(2e-3, 2, 0.5), 36_384, 6e-7),
    forming=Forming(pixels=512, cells=150, lit=0.2, terms=3.0, shots=49, classes=49, seconds=2e-3),
    apart=APART,
)
ONE_CLASS = replace(EVIDENCE, forming=replace(EVIDENCE.forming, shots=1, classes=1))
"""The same under one pattern, whose light takes no memory."""
PRICED = {"interreflection", "ambient", "diffraction", "black-level"}
ACCURACIES = [0.1, 1e-2, 3e-3, 1e-3, 3e-4]


def plan(accuracy: float = 1e-3, evidence: Evidence = EVIDENCE, effects: str = "", facts: SceneFacts = FACTS) -> Plan:
    return decide(accuracy, evidence, facts, parse_switches(effects))


def rows(found: Plan) -> dict[str, PlanRow]:
    return {effect.name: effect for effect in found.effects}


def stages(evidence: Evidence, settings: Settings, paces: Paces) -> dict[str, float]:
    """Seconds of each stage: paths, filing of what they bring, looks at the error; rays of the truth; frames."""
    forming, numbers = evidence.forming, Numbers.of(settings)
    filing = paces.filed * GROUPS * entries(evidence.direct.paths, forming.classes, numbers, settings)
    looking = checking_seconds(forming, numbers, paces)
    return {
        "transport": sum(tracing_seconds(evidence, settings, paces).values()) + filing + looking,
        "truth": truth_seconds(evidence, settings, paces),
        "optics": optics_seconds(forming, numbers, paces),
    }


def random_evidence(seed: int) -> Evidence:
    """Changes of any size and angle to each other, and light of any noise."""
    rng = np.random.default_rng(seed)
    sizes = {part: size * 10 ** rng.uniform(-1, 1) for part, size in SIZES.items()}
    mixed = rng.normal(size=(len(sizes), 6))
    mixed *= (np.array(list(sizes.values())) / np.linalg.norm(mixed, axis=1))[:, None]
    looks = mixed[:, None] + 3e-5 * rng.normal(size=(len(sizes), LOOKS, 6))
    efforts = {
        name: replace(getattr(EVIDENCE, name), noise=Noise(10 ** rng.uniform(-4, -1.5), 4, 0.5))
        for name in ("direct", "spread", "anchored", "indirect", "from_camera", "followed")
    }
    return replace(EVIDENCE, changes=Changes.between(dict(zip(sizes, looks, strict=True)), 1.0), **efforts)


# ---- changes and their sums


def seen(*vectors: list[float]) -> Changes:
    """Changes without noise, named a, b, ..."""
    named = {Part(chr(97 + index)): np.array([vector] * LOOKS) for index, vector in enumerate(vectors)}
    return Changes.between(named, 4.0)


def test_changes_add_up_with_their_signs() -> None:
    """Frames of norm 2; a and b are opposite, c stands at right angles to both."""
    found = seen([6e-3, 0.0], [-4e-3, 0.0], [0.0, 8e-3])
    a, b, c = found.parts
    assert found.estimate([a]) == pytest.approx((3e-3, 3e-3))
    assert found.estimate([a, b]) == pytest.approx((1e-3, 1e-3))
    assert found.estimate([a, c]) == pytest.approx((5e-3, 5e-3))
    assert found.estimate([a, b, c]) == pytest.approx((math.hypot(1e-3, 4e-3),) * 2)
    assert found.estimate([]) == (0.0, 0.0)


def test_the_noise_of_looks_is_no_change_and_bounds_hold() -> None:
    """500 scenes whose change of 1e-3 is seen with noise of 3e-3 in each look: unbiased squares, 95 % of bounds."""
    part, scenes = Part("blur"), 500
    squares, held = [], 0
    for seed in range(scenes):
        found = changes({part: 1e-3}, 3e-3, seed)
        squares.append(float(found.squared(np.ones((1, 1)))[0][0]))
        held += found.estimate([part]).bound >= 1e-3
    error = np.std(squares) / math.sqrt(scenes)
    assert np.mean(squares) == pytest.approx(1e-6, abs=3 * error) and error < 1e-7
    assert held / scenes > 0.92, "binomial: 0.95 of 500, less three standard deviations"


def test_a_change_that_cannot_be_told_is_told_as_a_bound() -> None:
    """A lens whose change is below the pilot's noise is not exact."""
    noisy = replace(EVIDENCE, changes=changes(SIZES | {Part("aperture"): 0.0}, 1e-4))
    reason = rows(plan(1e-2, noisy, "-aperture"))["aperture"].reason
    assert "less than" in reason
    assert noisy.effects["aperture"].bound > 1e-6


# ---- the choice


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("accuracy", ACCURACIES)
def test_no_choice_that_fits_is_cheaper(accuracy: float, seed: int) -> None:
    """Minimality, by other roads than the search's own: each thing that is on is switched off, each number made less.

    Whatever is cheaper breaks the accuracy; and what was chosen keeps it. What takes no time stays on: no error is left
    in the hope that it makes up for another.
    """
    evidence = random_evidence(seed)
    chosen = cheapest(accuracy, evidence, {})
    if not chosen.fits:
        return
    assert chosen.total.bound <= accuracy
    now = chosen.settings
    others = [replace(now, effects=now.effects - {name}) for name in PRICED & now.effects]
    others += [replace(now, anchors=count) for count in evidence.ladders["anchors"]]
    others += [replace(now, layers=evidence.layers[count] if count > 1 else ()) for count in evidence.ladders["layers"]]
    others += [replace(now, subdivision=count) for count in evidence.ladders["cells"]]
    others += [replace(now, coarse_cells=count, coarse_layers=all_) for count in (1, 2, 4, 8) for all_ in (False, True)]
    others += [replace(now, effects=frozenset({"blur", "speckle"}), anchors=1, layers=(), subdivision=1)]
    for settings in others:
        other = predicted(accuracy, evidence, settings, {})
        assert not other.fits or other.work >= chosen.work * (1 - 1e-12)


@pytest.mark.parametrize("accuracy", ACCURACIES)
def test_the_total_is_predicted_from_all_that_is_left(accuracy: float) -> None:
    """At right angles, squares add up. Where nothing is followed, it does not matter to how many points."""
    chosen = cheapest(accuracy, EVIDENCE, {})
    settings = chosen.settings
    parts = parts_of(EVIDENCE, settings)
    assert {part.name for part in parts if not part.count} == set(EVIDENCE.effects) - settings.effects
    squares = sum(SIZES.get(part, APART.get(part.name, 0.0)) ** 2 for part in parts)
    if "interreflection" in settings.effects:
        layered = (
            SIZES[Part("layers", len(settings.depths))] / SIZES[Part("layers", 1)] if settings.coarse_layers else 1
        )
        squares += (4e-4 / settings.coarse_cells**2) ** 2 + (3e-4 * layered) ** 2
    if settings.anchors > 1:
        squares += (2e-4 / settings.coarse_cells**2) ** 2
    if not {"interreflection", "ambient"} & settings.effects:
        squares -= SIZES[Part("followed_anchors", settings.followed_anchors)] ** 2
    expected = math.sqrt(squares)
    assert chosen.systematic.value == pytest.approx(expected, rel=1e-6)
    assert chosen.total.value == pytest.approx(math.hypot(expected, chosen.noise))


def test_opposite_errors_are_left_together() -> None:
    """Cells and a lens that change the frames by 8e-4 each, one against the other: at 1e-3 neither is needed.

    The same with the same sign: 1.6e-3, so that one of them must go.
    """
    sizes = {part: 0.0 for part in SIZES if part.name not in ("cells", "diffraction")}
    for sign, fits in ((-1.0, True), (1.0, False)):
        vectors = {part: np.zeros((LOOKS, 2)) for part in sizes}
        vectors[Part("cells", 1)], vectors[Part("cells", 2)] = np.full((LOOKS, 2), 5.6e-4), np.zeros((LOOKS, 2))
        vectors[Part("diffraction")] = sign * np.full((LOOKS, 2), 5.6e-4)
        evidence = replace(EVIDENCE, changes=Changes.between(vectors, 1.0), apart={})
        bare = replace(cheapest(1e-3, evidence, {}).settings, effects=frozenset({"blur"}), subdivision=1)
        assert predicted(1e-3, evidence, bare, {}).fits == fits


@pytest.mark.parametrize("accuracy", ACCURACIES)
def test_work_is_transport_and_optics_at_fixed_paces(accuracy: float) -> None:
    """Truth is the same for all choices, and none of it."""
    chosen = cheapest(accuracy, EVIDENCE, {})
    expected = stages(EVIDENCE, chosen.settings, FIXED)
    assert chosen.work == pytest.approx(expected["transport"] + expected["optics"])


def test_light_that_is_missing_leaves_less_for_other_errors_to_be_part_of() -> None:
    """A fifth of the light, and a tenth, come over what no tracer finds: errors are those of the rest."""
    settings = cheapest(1e-2, EVIDENCE, {}).settings
    lacking = replace(EVIDENCE, unresolved=0.2, left_out=0.1)
    before, after = (predicted(1e-2, evidence, settings, {}).systematic for evidence in (EVIDENCE, lacking))
    assert before.value > 1e-3 and after == pytest.approx([0.3 + 0.7 * error for error in before])


def test_what_takes_no_time_is_always_on() -> None:
    for accuracy in (*ACCURACIES, 0.3):
        assert {"blur", "speckle"} <= plan(accuracy).settings.effects


def test_looser_accuracies_are_cheaper() -> None:
    works = [cheapest(accuracy, EVIDENCE, {}).work for accuracy in ACCURACIES]
    assert works == sorted(works) and len(set(works)) == len(works)
    seconds = [plan(accuracy).predicted_seconds for accuracy in ACCURACIES]
    assert seconds == sorted(seconds) and seconds[-1] > 10 * seconds[0]


def test_what_the_pilot_cannot_tell_is_on() -> None:
    """Interreflection of 5e-4 fits into 1e-3 when it is known, and does not when it may be twice as much."""
    sizes = {part: size * 0.1 for part, size in SIZES.items()} | {Part("interreflection"): 5e-4}
    sure = replace(EVIDENCE, changes=changes(sizes), apart={})
    noisy = changes({Part("interreflection"): 5e-4}, 3e-3).products[:, :, 0, 0]
    place, products = sure.changes.parts.index(Part("interreflection")), sure.changes.products.copy()
    products[:, :, place, place] = noisy
    unsure = replace(sure, changes=Changes(sure.changes.parts, products))
    assert "interreflection" not in cheapest(1e-3, sure, {}).settings.effects
    careful, hopeful = (cheapest(1e-3, unsure, {}, sigmas).settings.effects for sigmas in (2.35, 0.0))
    assert "interreflection" in careful
    worth, part = doubt(1e-3, unsure, {})
    assert worth > 0 and part == Part("interreflection") and "interreflection" not in hopeful
    assert doubt(1e-3, sure, {})[0] == 0


def test_effects_that_the_scene_does_not_have_stay_off() -> None:
    found = rows(plan(1e-3))["mirrors"]
    assert found.state == "off" and found.error_if_off == 0 and found.reason == EFFECTS["mirrors"].absent


def test_a_flat_scene_has_one_layer_whatever_is_asked_for() -> None:
    sizes = {part: size for part, size in SIZES.items() if "layers" not in part.name}
    flat = replace(EVIDENCE, layers={1: (400.0,)}, changes=changes(sizes), depth=400.0)
    for effects in ("", "+layers", "-layers"):
        assert plan(1e-4, flat, effects).settings.depths == (400.0,)


# ---- rows


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
    assert found.predicted_seconds == pytest.approx(sum(found.predicted.values())) and found.predicted_seconds > 0
    for effect in found.effects:
        assert 0 <= effect.seconds <= found.predicted_seconds
        if effect.state == "off":
            assert effect.seconds == 0
        assert (effect.state != "off") == on(found, effect.name)


def on(found: Plan, name: str) -> bool:
    """Whether the settings have an effect or discretisation; what is always there counts by its row."""
    settings = found.settings
    counts = {"anchors": settings.anchors > 1, "layers": len(settings.depths) > 1, "cells": True, "sensor-noise": True}
    counts["followed-anchors"] = settings.followed_anchors > 1
    return counts.get(name, name in settings.effects)


def test_what_costs_time_says_so() -> None:
    found = rows(plan())
    assert all(found[name].seconds > 0 for name in ("anchors", "layers", "interreflection", "diffraction"))


def test_rows_carry_the_measured_errors() -> None:
    found = rows(plan())
    assert found["anchors"].error_if_off == pytest.approx(SIZES[Part("anchors", 1)])
    assert found["layers"].error_if_off == pytest.approx(SIZES[Part("layers", 1)])
    for name, error in EVIDENCE.effects.items():
        assert found[name].error_if_off == error.value
    assert found["diffraction"].reason.startswith("Fresnel number 3.2; ")
    assert "without it the error would be up to 3.0e-01 of 0.001 allowed" in found["diffraction"].reason


def test_a_row_is_found_by_its_name() -> None:
    found = plan()
    assert all(found.row(row.name) is row for row in found.effects)
    with pytest.raises(MitsimError, match=r"plan: no row 'lens'; there are anchors, layers, .*aperture"):
        found.row("lens")


def test_it_shows_itself() -> None:
    found = plan(evidence=replace(EVIDENCE, changes=changes(SIZES | {Part("ambient"): 0.0})))
    shown = found._repr_html_()
    assert all(row.name in shown for row in found.effects) and "0.0e+00" not in shown
    assert repr(found).startswith("Plan(accuracy 0.001: anchors approximate") and "ambient" not in repr(found)


def test_a_plan_is_json_with_the_promised_keys() -> None:
    block = json.loads(json.dumps(asdict(replace(plan(), settings=replace(plan().settings, effects=())))))
    assert {"effects", "accuracy", "predicted_seconds", "predicted", "settings", "warnings"} <= set(block)
    assert all(set(effect) == {"name", "state", "reason", "error_if_off", "seconds"} for effect in block["effects"])


# ---- the budget


@pytest.mark.parametrize("accuracy", ACCURACIES)
def test_sampling_gets_what_is_left(accuracy: float) -> None:
    found = plan(accuracy)
    assert 0 < found.sampling_target < accuracy
    if not found.warnings:
        assert math.hypot(found.systematic_bound, found.sampling_target) <= accuracy
    total = found.total(Estimate(0.8 * found.sampling_target, found.sampling_target))
    assert total.value == pytest.approx(math.hypot(found.systematic_error, 0.8 * found.sampling_target))
    assert total.bound == pytest.approx(math.hypot(found.systematic_bound, found.sampling_target))


def test_what_does_not_fit_is_flagged_with_the_largest_part() -> None:
    found = plan(1e-3, effects="-interreflection,-diffraction")
    (warning,) = found.warnings
    assert "largest: diffraction (off), 3.0e-01" in warning
    assert found.systematic_error == pytest.approx(0.3, rel=0.01) and "0.001" in warning
    (warning,) = plan(1e-6, ONE_CLASS).warnings
    assert "largest: followed anchors (2x2), 9.0e-05" in warning, "more cannot be held"


def test_what_nothing_can_make_up_for_does_not_make_the_rest_finer() -> None:
    """Without speckle the frames are 8e-3 off, without the spot 1e-3; the rest is as for the accuracy asked for."""
    with_it, without = plan(1e-3).settings, plan(1e-3, effects="-speckle,-blur").settings
    assert with_it.effects - without.effects == {"speckle", "blur"}
    assert replace(without, effects=with_it.effects) == with_it


def test_the_best_there_is_when_nothing_fits() -> None:
    found = plan(1e-6, ONE_CLASS)
    assert found.warnings and found.settings.subdivision == 8 and len(found.settings.depths) == 4


@pytest.mark.parametrize("accuracy", [1e-3, 1e-4, 1e-6])
def test_no_light_is_asked_for_that_cannot_be_held(accuracy: float) -> None:
    """Of 49 classes indirect light lies in all cells of each: 2^25 entries a group are 12 GB. (Planted: no limit.)"""
    settings, pixels = cheapest(accuracy, EVIDENCE, {}).settings, EVIDENCE.direct.paths
    assert entries(pixels, 49, Numbers.of(settings), settings) <= 2**25
    finest = replace(settings, followed_anchors=3, coarse_cells=8, indirect_samples=1e5, followed_samples=1e5)
    assert entries(pixels, 49, Numbers.of(finest), finest) > 2**28


def test_occluded_pixels_count_with_their_anchors() -> None:
    """Each of 100 pixels lights four places of its own for each of 16 x 16 anchors, in two layers twice as many; with
    one anchor it is a pixel like the others."""
    pixels, few = EVIDENCE.direct.paths, replace(cheapest(1e-2, EVIDENCE, {}).settings, layers=(), coarse_layers=False)
    own = replace(few, occluded=tuple(range(100)), occluded_anchors=16, occluded_samples=9.0)

    def more(settings: Settings) -> float:
        return float(entries(pixels, 49, Numbers.of(settings), settings)) - plain

    plain = float(entries(pixels, 49, Numbers.of(few), few))
    assert more(own) == pytest.approx(100 * 256 * 4 * few.coarse_cells**2)
    assert more(replace(own, occluded_anchors=1)) == 0
    layered = replace(own, layers=(400.0, 300.0), coarse_layers=True)
    plain = float(entries(pixels, 49, Numbers.of(replace(layered, occluded_anchors=1)), layered))
    assert more(layered) == pytest.approx(2 * 100 * 256 * 4 * few.coarse_cells**2)


def with_occluded(sizes: dict[int, float]) -> Evidence:
    """150 pixels that leave so much by the number of their anchors."""
    found = changes(SIZES | {Part("occluded_anchors", count): size for count, size in sizes.items()})
    light = Effort(Noise(1e-4, 4, 0.5), 150)
    return replace(ONE_CLASS, changes=found, occluded=tuple(range(150)), occluded_light=light)


@pytest.mark.parametrize("accuracy", ACCURACIES)
def test_occluded_pixels_have_several_anchors_where_the_others_do(accuracy: float) -> None:
    """One anchor is the sensor's centre, several stand for all of the sensor: for all pixels or for none. What is left
    of either counts. (Planted: the numbers chosen apart; the occluded pixels' share not counted.)"""
    evidence = with_occluded({1: 6e-3, 2: 3e-3, 5: 7e-4, 16: 1e-4, 32: 3e-5})
    chosen = cheapest(accuracy, evidence, {})
    settings = chosen.settings
    assert (settings.anchors > 1) == (settings.occluded_anchors > 1) and settings.occluded == tuple(range(150))
    assert chosen.fits and chosen.total.bound <= accuracy
    left = {1: 6e-3, 2: 3e-3, 5: 7e-4, 16: 1e-4, 32: 3e-5}[settings.occluded_anchors]
    with_none = predicted(accuracy, with_occluded({1: 0.0}), replace(settings, occluded_anchors=1), {})
    assert chosen.systematic.value == pytest.approx(math.hypot(with_none.systematic.value, left), rel=1e-6)
    off = cheapest(1e-3, evidence, {"anchors": False})
    assert off.settings.anchors == off.settings.occluded_anchors == 1 and off.fits, "what the user wants does not count"


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
    slow = replace(EVIDENCE, **efforts, forming=replace(EVIDENCE.forming, seconds=1.0))
    for accuracy in ACCURACIES:
        assert plan(accuracy).settings == plan(accuracy, slow).settings
        assert plan(accuracy).sampling_target == plan(accuracy, slow).sampling_target
        assert plan(accuracy).predicted_seconds < plan(accuracy, slow).predicted_seconds


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
    assert more.anchors > 1 and len(more.depths) > 1 and (less.anchors, less.layers) == (1, ())


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


def test_nothing_is_worth_knowing_where_no_luck_would_keep_the_accuracy() -> None:
    """Every number of cells is known to leave all of the light. (Planted: a second's worth.)"""
    sizes = {part: 1.0 if part.name == "cells" else size for part, size in SIZES.items()}
    assert doubt(1e-3, replace(EVIDENCE, changes=changes(sizes), apart={}), {})[0] == 0.0


def test_light_to_random_points_of_the_sensor_has_its_own_noise() -> None:
    """Ten times the noise takes so many more samples where there are several anchors, and none where there is one.
    (Planted: the centre's noise for both; spread noise with one anchor.)"""
    noisy = replace(EVIDENCE, spread=Effort(Noise(2e-2, 16, 0.5), 16_384))
    for switches, factor in (({"anchors": False}, 1.0), ({"anchors": True}, 10.0)):
        quiet, loud = (cheapest(3e-3, evidence, switches) for evidence in (EVIDENCE, noisy))
        assert (loud.settings.anchors > 1) == (factor > 1)
        if factor == 1:
            assert loud == quiet
        else:
            assert loud.settings.direct_samples > 8 * quiet.settings.direct_samples
            assert 0.3 * loud.target < loud.noise < loud.target


def test_samples_take_the_least_work_for_the_target() -> None:
    """Variances v / N add up to the target's over 1.15, as sampling stops by a bound that lies so far above the error.

    N is in proportion to sqrt(v / price): the least sum of prices. Whole numbers make both a little better.
    """
    noises = {name: Noise(0.0, 1, 0.5) for name in ("direct", "spread", "anchored", "followed")}
    noises["from_camera"] = Noise(3e-2, 2, 0.5)
    evidence = replace(EVIDENCE, **{name: replace(getattr(EVIDENCE, name), noise=n) for name, n in noises.items()})
    found = cheapest(1e-3, evidence, parse_switches("+interreflection"))
    settings = found.settings
    counts = settings.indirect_samples, settings.from_camera_samples
    variances = evidence.indirect.variance, evidence.from_camera.variance
    prices = 16_384 * FIXED.indirect, 20_000 * FIXED.from_camera
    kinds = list(zip(variances, counts, prices, strict=True))
    assert math.sqrt(sum(v / n for v, n, _ in kinds) / GROUPS) == pytest.approx(found.target / 1.15, rel=0.01)
    assert math.sqrt(sum(v / n for v, n, _ in kinds) / GROUPS) < found.target / 1.15
    ratios = [n / math.sqrt(v / price) for v, n, price in kinds]
    assert ratios[0] == pytest.approx(ratios[1], rel=0.02) and min(counts) > 50


@pytest.mark.parametrize(
    ("asked", "taken"), [(0.2, 1), (1, 1), (1.2, 2), (2.5, 3), (3.1, 4), (12, 12), (12.5, 16), (97, 128)]
)
def test_points_of_a_sobol_sequence_come_in_even_numbers(asked: float, taken: int) -> None:
    assert even(asked) == taken and even(np.array([asked])) == [taken]


@pytest.mark.parametrize(
    ("keystone", "state", "words"), [(0.0, "off", "squarely"), (2.5, "exact", "2.5 of its pixels")]
)
def test_a_keystone_is_there_or_not(keystone: float, state: str, words: str) -> None:
    row = rows(plan(facts=replace(FACTS, keystone=keystone)))["keystone"]
    assert row.state == state and words in row.reason
