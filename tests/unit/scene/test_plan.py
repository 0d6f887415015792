"""The effect plan: the cheapest settings that fit the accuracy, and an honest word about the rest."""

import math

import pytest

from mitsim.core.errors import MitsimError
from mitsim.scene.plan import Plan, SceneFacts, check_accuracy, decide

FACTS = SceneFacts(other_emitters=0, fresnel_number=3.2, wavelength_nm=562.0, keystone=0.0)
EVIDENCE = {
    "anchor_error": {1: 1e-3, 2: 5e-5, 3: 1e-6},
    "cell_error": {1: 4e-4, 2: 1e-4, 4: 2.5e-5},
    "sampling_error": {1: 0.02, 2: 0.02, 4: 0.02},
    "cells": {1: 22_500, 2: 90_000, 4: 360_000},
    "seconds_per_batch": 5e-3,
    "seconds_per_path": 2e-7,
    "depth": 400.0,
    "depth_error": 0.0,
    "captures": 49,
    "facts": FACTS,
}


def plan(accuracy: float, **changes: object) -> Plan:
    return decide(accuracy, **{**EVIDENCE, **changes})


def left(found: Plan) -> float:
    return math.hypot(EVIDENCE["anchor_error"][found.anchors], EVIDENCE["cell_error"][found.subdivision])


@pytest.mark.parametrize("accuracy", [0.1, 3e-3, 1e-3, 5e-4, 2e-4, 1e-4])
def test_the_budget_is_kept(accuracy: float) -> None:
    found = plan(accuracy)
    assert left(found) <= 0.8 * accuracy and not found.warnings
    assert left(found) ** 2 + found.sampling_target**2 <= accuracy**2
    assert found.sampling_target > 0.5 * accuracy, "sampling must keep its share"
    assert found.systematic_error == pytest.approx(left(found))


@pytest.mark.parametrize(
    ("accuracy", "choice"), [(3e-3, (1, 1)), (1e-3, (2, 1)), (5e-4, (2, 2)), (1e-4, (2, 4)), (5e-5, (3, 4))]
)
def test_the_cheapest_that_fits(accuracy: float, choice: tuple[int, int]) -> None:
    found = plan(accuracy)
    assert (found.anchors, found.subdivision) == choice


def test_less_error_costs_more() -> None:
    seconds = [plan(accuracy).predicted_seconds for accuracy in (1e-2, 1e-3, 1e-4, 3e-5)]
    assert seconds == sorted(seconds) and seconds[-1] > 10 * seconds[0]


def test_what_does_not_fit_is_flagged() -> None:
    found = plan(1e-5)
    assert (found.anchors, found.subdivision) == (3, 4), "the best there is"
    assert len(found.warnings) == 1 and "2.5e-05" in found.warnings[0] and "1e-05" in found.warnings[0]
    assert found.sampling_target > 0


def test_depth_and_ambient_light_are_flagged() -> None:
    found = plan(1e-3, depth_error=5e-3)
    assert any("depth" in text and "5.0e-03" in text for text in found.warnings)
    assert not plan(1e-3, depth_error=1e-4).warnings
    found = plan(1e-3, facts=SceneFacts(2, 3.2, 562.0, 0.0))
    assert any(text.startswith("2 emitter(s)") for text in found.warnings)


def test_every_effect_of_the_design_has_a_row() -> None:
    effects = {effect.name: effect for effect in plan(1e-3).effects}
    wanted = (
        "anchors",
        "cells",
        "depth",
        "interreflection",
        "ambient",
        "diffraction",
        "aperture",
        "thickness",
        "noise",
    )
    for word in wanted:
        assert any(word in name for name in effects), word
    anchors = next(effect for name, effect in effects.items() if "anchors" in name)
    assert anchors.state == "approximate" and anchors.error_if_off == 1e-3 and anchors.seconds >= 0
    off = next(effect for effect in plan(1e-2).effects if "anchors" in effect.name)
    assert off.state == "off" and off.error_if_off == 1e-3 and off.seconds == 0
    assert all("\n" not in effect.reason and effect.reason for effect in effects.values())


@pytest.mark.parametrize("accuracy", [0.0, -1e-3, 1e-7, 0.5, math.nan, math.inf])
def test_accuracies_that_cannot_be_promised(accuracy: float) -> None:
    with pytest.raises(MitsimError, match="--accuracy"):
        check_accuracy(accuracy)
    with pytest.raises(MitsimError, match="--accuracy"):
        plan(accuracy)


def test_settings_do_not_depend_on_the_machines_pace() -> None:
    """Bit-equal repetition and --resume need it: the same seed must mean the same settings."""
    changes = {
        "anchor_error": {1: 5e-4, 2: 1e-5},
        "cell_error": {1: 7e-4, 2: 1.7e-4},
        "sampling_error": {1: 0.02, 2: 0.03},
        "cells": {1: 20_000, 2: 80_000},
        "captures": 2000,
    }
    slow, fast = (plan(1e-3, seconds_per_path=pace, **changes) for pace in (1e-6, 1e-8))
    assert (slow.anchors, slow.subdivision) == (fast.anchors, fast.subdivision)
