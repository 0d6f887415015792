"""The user's choice of effects: text in, switches out, and settings that follow them."""

import pytest

from mitsim.bench.effects import SWITCHES, parse_switches
from mitsim.core.errors import MitsimError


@pytest.mark.parametrize(
    ("text", "chosen"),
    [
        *(("", {}), ("+ambient", {"ambient": True})),
        ("+ambient,-diffraction", {"ambient": True, "diffraction": False}),
        *((" -anchors , +layers,", {"anchors": False, "layers": True}), ("-blur,-blur", {"blur": False})),
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
