"""The accuracy that a time buys, of an invented pilot: light takes PRICE / accuracy^2 seconds, or what is stated."""

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
    """Accuracies that are tried; none finer than KEPT is kept."""
    seen: list[float] = []

    def choose(bench: object, lighting: Lighting, accuracy: float, *_: object) -> Any:
        seen.append(accuracy)
        runs = SimpleNamespace(seconds=PILOT_S, pilot_result=None)
        taken = SimpleNamespace(settings=accuracy, fits=accuracy >= KEPT)
        return planner._Chosen(runs, taken, ())  # type: ignore[arg-type]

    made = plan()
    monkeypatch.setattr(planner, "_choose", choose)
    monkeypatch.setattr(planner, "_stages", lambda result, accuracy, pace: {"transport": PRICE / accuracy**2})
    monkeypatch.setattr(planner, "_explain", lambda accuracy, *_: replace(made, accuracy=accuracy))
    monkeypatch.setattr(planner.cost_model, "frame_seconds", lambda bench, shots: {"sensor": FRAMES})
    return seen


@pytest.mark.parametrize(
    ("seconds", "bought", "number"),
    [(3.3, 1e-3, 1), (12.0, 3.3e-4, 2), (103.0, 1e-4, 2), (1e5, KEPT, None), (2.5, 2e-3, None)],
)
def test_time_buys_the_accuracy_that_takes_it(
    tried: list[float], seconds: float, bought: float, number: int | None
) -> None:
    """Opening, frames and all pilots come off. Nothing is bought that is not kept, or takes longer. (Planted: the
    last try taken; pilots for nothing; finer accuracies for the square of their time.)"""
    found: Any = planner.plan_within(None, LIGHTING, seconds, 3, {})  # type: ignore[arg-type]
    fits = PRICE / found.accuracy**2 + AROUND + PILOT_S <= seconds
    assert found.asked_seconds == seconds and (fits or "too few" in found.warnings[0])
    if number:
        assert found.accuracy == pytest.approx(bought, rel=0.1) and len(tried) == number
    else:
        assert found.accuracy >= KEPT and len(tried) <= planner._TRIES and tried[0] == 1e-3


def test_too_few_seconds_flag_the_loosest_of_the_tries(tried: list[float]) -> None:
    found: Any = planner.plan_within(None, LIGHTING, 0.1, 3, {})  # type: ignore[arg-type]
    assert found.accuracy == max(tried) and found.warnings[0].startswith("0.1 seconds are too few: accuracy")
