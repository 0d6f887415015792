"""What may be asked of a bench: one model, whose refusals name the argument, the value and what is allowed."""

from __future__ import annotations

import math
from typing import Any

import pytest

from mitsim.bench.effects import SWITCHES
from mitsim.bench.request import HIGHEST_ACCURACY, LONGEST_S, LOWEST_ACCURACY, Exposure, Request
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.devices.sensor import EXPOSURE_FRACTION, EXPOSURE_S


def test_what_is_asked_by_default() -> None:
    request = Request.of()
    assert (request.patterns, request.accuracy, request.seed, request.exposure) == ("dots:7", 1e-3, 0, "auto")
    assert (request.exposure_fraction, request.effects) == (0.8, {})
    assert request.timing == Exposure(None, 0.8)
    assert Request.of(exposure=0.01).timing == Exposure(0.01, 0.8)


@pytest.mark.parametrize(
    ("asked", "chosen"),
    [
        *(("", {}), ("+ambient", {"ambient": True}), ({"ambient": True}, {"ambient": True})),
        ("+ambient,-diffraction", {"ambient": True, "diffraction": False}),
        *((" -anchors , +layers,", {"anchors": False, "layers": True}), ("-blur,-blur", {"blur": False})),
        ("+mask-thickness,-black-level", {"mask-thickness": True, "black-level": False}),
    ],
)
def test_effects_may_be_written_as_on_the_command_line(asked: Any, chosen: dict[str, bool]) -> None:
    assert Request.of(effects=asked).effects == chosen


@pytest.mark.parametrize("text", ["ambient", "+", "-", "+fog", "*ambient", "+ambient,blur", "++ambient", "+cells"])
def test_names_that_are_no_effects_are_refused_with_those_that_are(text: str) -> None:
    with pytest.raises(MitsimError, match=r"^effects") as caught:
        Request.of(effects=text)
    assert all(name in str(caught.value) for name in SWITCHES) and "\n" not in str(caught.value)


def test_a_request_is_a_value() -> None:
    """Frozen, and equal to another of the same fields; a change gives another one."""
    request = Request.of(seed=3)
    assert request == Request.of(seed=3) and request.with_values(seed=3) == request
    assert request.with_values(patterns="uniform") == Request.of(seed=3, patterns="uniform")
    with pytest.raises(ValueError, match="frozen"):
        request.seed = 4  # type: ignore[misc]
    assert Request.of(**request.model_dump(mode="json")) == request, "as the manifest holds it"


def test_seconds_or_an_accuracy() -> None:
    """Not both; the manifest holds the one that was asked for, and reads back as the same request."""
    request = Request.of(seconds=10.0, seed=2)
    assert Request.of(**request.deciding) == request and "accuracy" not in request.deciding
    assert "seconds" not in Request.of().deciding and Request.of().deciding["accuracy"] == 1e-3
    for ask in (Request.of, request.with_values):
        with pytest.raises(ArgumentError, match=r"^seconds 10: decides the accuracy; give one of both"):
            ask(seconds=10.0, accuracy=1e-3)


@pytest.mark.parametrize(
    ("argument", "ends"),
    [
        *(("seconds", (5e-324, LONGEST_S)), ("accuracy", (LOWEST_ACCURACY, HIGHEST_ACCURACY))),
        *(("exposure", EXPOSURE_S), ("exposure_fraction", EXPOSURE_FRACTION)),
    ],
)
def test_the_ends_of_a_range_are_within_it(argument: str, ends: tuple[float, float]) -> None:
    for end in ends:
        assert getattr(Request.of(**{argument: end}), argument) == end


@pytest.mark.parametrize(
    ("argument", "value", "allowed"),
    [
        *(("seconds", value, "above 0, at most 1e+06") for value in (0.0, -1.0, 1e7, math.nan, math.inf)),
        *(("accuracy", value, "from 1e-06 to 0.3") for value in (0.0, -1e-3, 0.5, math.nan, math.inf)),
        *(("exposure", value, "to 1e+06") for value in (0.0, -1.0, 1e7, math.nan, math.inf)),
        *(("exposure_fraction", value, "to 1") for value in (0.0, -0.5, 1.01, math.nan)),
        *(("effects", {"fog": True}, "diffraction"), ("effects", "+ambient,-blur,-ambient", "keep one")),
        *(("ambient_frame", value, "give 'auto', 'yes' or 'no'") for value in ("maybe", "", True)),
    ],
)
def test_values_out_of_range_name_the_argument(argument: str, value: Any, allowed: str) -> None:
    """As Python spells it: the command line alone writes dashes."""
    with pytest.raises(ArgumentError) as caught:
        Request.of(**{argument: value})
    line = str(caught.value)
    assert caught.value.argument == argument and line.startswith(f"{argument} ")
    assert allowed in line and "\n" not in line and "--" not in line
    if isinstance(value, float):
        assert str(value) in line or f"{value:g}" in line


@pytest.mark.parametrize(
    ("values", "fragments"),
    [
        ({"acuracy": 1e-3}, ["acuracy", "did you mean accuracy?"]),
        *(({"seed": 1.5}, ["seed", "1.5", "whole number"]), ({"seed": True}, ["seed", "True"])),
        *(({"seed": "1"}, ["seed", "'1'"]), ({"accuracy": "fine"}, ["accuracy", "'fine'"])),
        *(({"accuracy": True}, ["accuracy", "True"]), ({"exposure": "long"}, ["exposure", "'long'"])),
        ({"patterns": 7}, ["patterns", "7"]),
    ],
    ids=str,
)
def test_values_of_another_kind_are_refused(values: dict[str, Any], fragments: list[str]) -> None:
    with pytest.raises(MitsimError) as caught:
        Request.of(**values)
    assert all(fragment in str(caught.value) for fragment in fragments), str(caught.value)
    assert "\n" not in str(caught.value)
