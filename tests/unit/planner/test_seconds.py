"""The accuracy that a time buys, of an invented pilot: light takes PRICE / accuracy^2 seconds."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mitsim.devices.patterns import Lighting
from mitsim.planner import planner
from tests.unit.planner.invented_pilot_result import plan

LIGHTING, PILOT_S, FRAMES, PRICE, KEPT = Lighting(np.zeros(4, int), np.ones((4, 1))), 0.5, 0.25, 1e-6, 2e-5
AROUND = planner._OPENING_S + FRAMES


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Accuracies of the pilots; each keeps what is looser than its own accuracy and than KEPT."""
    seen: list[float] = []

    def look(bench: object, lighting: Lighting, accuracy: float, *_: object) -> Any:
        seen.append(accuracy)
        return SimpleNamespace(
            runs=SimpleNamespace(seconds=PILOT_S),
            taken=lambda each: SimpleNamespace(fits=each >= KEPT),
            seconds=lambda each: PRICE / each**2,
        )

    made = plan()
    monkeypatch.setattr(planner, "_look", look)
    monkeypatch.setattr(planner, "_explain", lambda accuracy, *_: replace(made, accuracy=accuracy))
    monkeypatch.setattr(planner.cost_model, "frame_seconds", lambda bench, shots: {"sensor": FRAMES})
    return seen


@pytest.mark.parametrize(
    ("seconds", "bought", "pilots"),
    [(2.26, 1e-2, 1), (3.3, 1e-3, 1), (12.0, 3.3e-4, 2), (103.0, 1e-4, 2), (1e5, KEPT, 2)],
)
def test_time_buys_the_accuracy_that_takes_it(tried: list[float], seconds: float, bought: float, pilots: int) -> None:
    """Opening, frames and all pilots come off; a looser accuracy than the first pilot's needs no other. Nothing is
    bought that is not kept, or takes longer. (Planted: pilots for nothing; an accuracy that no pilot of its own keeps;
    the first pilot's answer in place of the second's.)"""
    found: Any = planner.plan_within(None, LIGHTING, seconds, 3, {})  # type: ignore[arg-type]
    assert found.asked_seconds == seconds and not found.warnings
    assert PRICE / found.accuracy**2 + AROUND + pilots * PILOT_S <= seconds
    assert found.accuracy == pytest.approx(bought, rel=0.27) and found.accuracy >= KEPT and len(tried) == pilots


def test_too_few_seconds_flag_the_loosest_accuracy(tried: list[float]) -> None:
    found: Any = planner.plan_within(None, LIGHTING, 0.1, 3, {})  # type: ignore[arg-type]
    assert found.accuracy == planner._GRID[0] and len(tried) == 1
    assert found.warnings[0].startswith("0.1 seconds are too few: even accuracy 0.3, which was taken, is predicted")
