"""The user's choice of effects: text in, switches out, and settings that follow them."""

import pytest

from mitsim.bench.effects import EFFECTS, SWITCHES, parse_switches
from mitsim.core.errors import MitsimError
from tests.unit.planner.invented_pilot_result import plan, rows


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
