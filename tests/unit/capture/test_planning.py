"""Plans within a time: what is looked at, how finely, and what of the time is left for light, of invented prices."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import pytest

from mitsim.capture import pilot, planning
from mitsim.capture.affordable import FIRST_LOOK
from mitsim.capture.plan import Plan
from mitsim.rig.patterns import Lighting
from tests.unit.capture.invented_evidence import plan

LIGHTING, SEED, LOOKING, FRAMES = Lighting.uniform(4), 7, 0.5, {"sensor": 0.2, "write": 0.1}
AROUND = planning.OPENING_S + sum(FRAMES.values()) + LOOKING
"""Seconds of all but light, frames and truth, after one look; a finer one is taken for twice as long."""
PRICE, KEPT = 1e-3, 1.5e-5
"""Light of accuracy e takes PRICE / e seconds, and half of it without diffraction; it keeps no finer one than KEPT."""
OWN = "the plan's own"


@dataclass
class Invented:
    """Stands in for the choices of a look."""

    evidence: Looks
    switches: Mapping[str, bool]

    def seconds(self, accuracy: float) -> tuple[float, bool]:
        price = PRICE * (self.evidence.dearer if len(self.evidence.asked) > 1 else 1.0) / accuracy
        kept = self.evidence.kept if len(self.evidence.asked) > 1 else KEPT
        return price * (1.0 if self.switches.get("diffraction", True) else 0.5), accuracy >= kept


@dataclass
class Looks:
    """Accuracies and seeds of looks, and what was decided at last; a finer one may find all dearer, or less kept."""

    asked: list[tuple[float, int]] = field(default_factory=list)
    decided: tuple[object, float, Mapping[str, bool]] | None = None
    dearer: float = 1.0
    kept: float = KEPT


@pytest.fixture(scope="module")
def made() -> Plan:
    return plan()


@pytest.fixture
def looks(made: Plan, monkeypatch: pytest.MonkeyPatch) -> Looks:
    seen = Looks()

    class Look:
        seconds = LOOKING

        def __init__(self, bench: object, lighting: Lighting, accuracy: float, seed: int) -> None:
            assert lighting is LIGHTING
            seen.asked.append((accuracy, seed))
            self.evidence = seen

    def decided(look: Look, accuracy: float, switches: Mapping[str, bool]) -> Plan:
        seen.decided = look.evidence, accuracy, switches
        return replace(made, accuracy=accuracy, warnings=(OWN,))

    monkeypatch.setattr(pilot, "Look", Look)
    monkeypatch.setattr(planning, "Candidates", Invented)
    monkeypatch.setattr(planning, "_refuse_unfit", lambda bench: None)
    monkeypatch.setattr(planning, "_decided", decided)
    monkeypatch.setattr(planning, "frame_seconds", lambda bench, shots: FRAMES)
    return seen


def within(light: float, switches: Mapping[str, bool] | None = None) -> Plan:
    """Of ``light`` seconds beyond one look and all that is around it."""
    bench: Any = None
    return planning.plan_within(bench, LIGHTING, AROUND + light, SEED, switches)


@pytest.mark.parametrize(
    ("light", "bought", "finer_look"),
    [
        (0.2, 5.01e-3, None),
        (1.01, 1e-3, None),
        (2.2, 1e-3, None),  # after another look 1.2 s are left, and the next finer accuracy takes 1.26
        (2.3, 7.94e-4, 7.94e-4),
        (11.01, 1e-4, 1e-4),
        (math.inf, 1.58e-5, 1e-5),
    ],
)
def test_what_looks_leave_is_for_the_light(looks: Looks, light: float, bought: float, finer_look: float | None) -> None:
    """Opening, frames and looking come off; a finer look is taken where what it leaves buys a finer accuracy."""
    found = within(light)
    finer = [(finer_look, SEED)] if finer_look else []
    assert looks.asked == [(FIRST_LOOK, SEED), *finer]
    assert looks.decided == (looks, bought, {}) and found.accuracy == bought
    assert found.asked_seconds == AROUND + light and found.warnings == (OWN,)


def test_what_is_switched_off_is_not_paid_for(looks: Looks) -> None:
    """In both looks: 0.2 s buy what 0.4 do else, and so do 1.3 after another look."""
    off = {"diffraction": False}
    assert within(0.2, off).accuracy == 2.51e-3
    assert within(2.3, off).accuracy == 3.98e-4 and looks.asked[-1] == (3.98e-4, SEED)
    assert looks.decided == (looks, 3.98e-4, off)


def test_too_few_seconds_are_told_with_what_all_would_take(looks: Looks) -> None:
    found = within(-AROUND + 0.01)
    line, own = found.warnings
    assert found.accuracy == 0.3 and found.asked_seconds == pytest.approx(0.01) and own == OWN
    assert line.startswith("0.01 seconds are too few: even accuracy 0.3")
    assert f"to take {PRICE / 0.3 + AROUND:.1f} s from start to finish" in line
    assert looks.asked == [(FIRST_LOOK, SEED)], "no time for another look"


@pytest.mark.parametrize(("dearer", "bought"), [(1.3, 1.58e-4), (1e5, 1e-3)])
def test_a_finer_look_that_finds_all_dearer_buys_less_or_nothing(looks: Looks, dearer: float, bought: float) -> None:
    looks.dearer = dearer
    found = within(11.01)
    assert len(looks.asked) == 2 and found.accuracy == bought and found.warnings == (OWN,)


def test_a_finer_look_that_finds_no_accuracy_kept_takes_none_away(looks: Looks) -> None:
    """What the first look bought stands. (Planted: the loosest of all, 0.3, which the finer look can pay.)"""
    looks.kept = 1.0
    found = within(11.01)
    assert len(looks.asked) == 2 and found.accuracy == 1e-3 and found.warnings == (OWN,)
