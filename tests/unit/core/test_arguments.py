"""Arguments of another kind than their annotation says are refused in a line, and all others are let pass."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from mitsim.core.errors import ArgumentError, check_arguments, checked_fields

Alias = Literal["a", "b"] | int


class Plan:
    """A class that annotations name."""


class Finer(Plan):
    """What inherits from it is one."""


@check_arguments
def work(
    plan: Plan | str = "dots:7",
    output: Path | str | None = None,
    seed: int = 0,
    lam: float | Literal["auto"] = "auto",
    resume: bool = False,
    effects: Mapping[str, bool] | None = None,
    alias: Alias = 1,
    anything: Any = None,
    *rest: str,
    **more: float,
) -> str:
    """A public function."""
    return f"{plan} {seed}"


@checked_fields
@dataclass(frozen=True)
class Limits:
    """A public class."""

    seconds: float = 1.0


ALLOWED = {
    "plan": [Plan(), Finer(), "dots:3", ""],
    "output": [None, "run", Path("run"), "n" * 255, "a/" * 2000 + "b"],
    "seed": [0, np.int64(3), 10**40, -1],
    "lam": ["auto", 0, 1.5, np.float32(2), float("nan")],
    "resume": [True, np.False_],
    "effects": [None, {}, {"gloss": True}],
    "alias": ["a", 3, object()],
    "anything": [object(), None, b""],
    "seconds": [0, 1.5],
}
REFUSED = {
    "plan": [None, 3, b"dots:3", object(), np.zeros(2)],
    "output": [3, b"run", "", "n" * 256, "a" * 5000, "a\0b", ("run",), np.zeros(0)],
    "seed": [None, 1.5, "3", True, float("nan"), np.zeros(1), 1j],
    "lam": ["car", None, True, [1.0], np.zeros(2), 1j, b"auto"],
    "resume": [0, 1, "yes", None, np.zeros(0)],
    "effects": ["gloss", ["gloss"], 3],
    "seconds": [None, "3", True, object()],
}


@pytest.mark.parametrize("name", ALLOWED)
def test_arguments_of_their_kind_are_let_pass(name: str) -> None:
    for value in ALLOWED[name]:
        assert work(**{name: value})


@pytest.mark.parametrize("name", REFUSED)
def test_others_are_refused_in_a_line(name: str) -> None:
    """(Planted: numpy's numbers refused; True for a number; a text for any path; further arguments let pass.)"""
    for value in REFUSED[name]:
        with pytest.raises(ArgumentError, match=f"^{name} .*: give ") as refusal:
            work(**{name: value})
        assert len(str(refusal.value).splitlines()) == 1 and len(str(refusal.value)) < 200


@pytest.mark.parametrize(
    ("name", "value", "line"),
    [("lam", "car", "lam 'car': give a number or 'auto'"), ("output", 3, "output 3: give a path or None")],
)
def test_what_is_allowed_is_said_in_words(name: str, value: object, line: str) -> None:
    with pytest.raises(ArgumentError) as refusal:
        work(**{name: value})  # type: ignore[arg-type]
    assert str(refusal.value) == line
    with pytest.raises(ArgumentError) as refusal:
        Limits(None)  # type: ignore[arg-type]
    assert str(refusal.value) == "seconds None: give a number"


def test_a_call_that_cannot_be_one_is_pythons_own_error() -> None:
    with pytest.raises(TypeError, match="multiple values"):
        work("dots:3", plan="dots:4")


def test_a_refusal_passes_between_processes() -> None:
    """(Planted: the way of all exceptions, which makes one of what it says alone.)"""
    refusal = pickle.loads(pickle.dumps(ArgumentError("sheet_z", "0: give a distance")))
    assert (str(refusal), refusal.argument) == ("sheet_z 0: give a distance", "sheet_z")
