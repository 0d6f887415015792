"""What simulating is predicted to take: multiplications counted by hand, at unit costs of one or none."""

from dataclasses import replace

import pytest

from mitsim.light import cost_model
from mitsim.light.cost_model import (
    Numbers,
    accumulation_seconds,
    checking_seconds,
    forming_seconds,
    optics_seconds,
    tracing_seconds,
    truth_seconds,
)
from mitsim.light.settings import GROUPS, Forming
from mitsim.optics.frames import PROBES
from tests.unit.planner.invented_pilot_result import PILOT_RESULT, plan

FORMING = Forming(pixels=50, cells=10, lit=0.5, terms=3.0, shots=4, classes=4)
ONE = Numbers(*[1.0] * 6)
COSTS = "_FRAME_S", "_ENTRY_S", "_ACCUMULATED_S", "_RAY_S", "_PIXEL_S"


def count(monkeypatch: pytest.MonkeyPatch, **costs: float) -> None:
    """All unit costs are 0 but these; a multiplication of ``formed`` is one second."""
    for name in COSTS:
        monkeypatch.setattr(cost_model, name, costs.get(name, 0.0))


def formed(forming: Forming, numbers: Numbers, frames: float = 1.0) -> float:
    return float(forming_seconds(forming, numbers, frames, 1.0))


def products(rows: float, terms: float = 1.0) -> float:
    """Of left (50, rows) times light (rows, rows) times right (rows, 50), and of the groups' probes in the same way."""
    probes = GROUPS * (PROBES + 1) * (min(rows, 50) + 50) * rows
    return terms * (50 * rows * rows + 50 * 50 * rows + probes)


@pytest.mark.parametrize(
    ("change", "multiplications"),
    [
        ({"waves": 0.0}, products(5)),
        ({}, products(5, 3)),
        ({"layers": 2.0}, 2 * products(5, 3)),
        ({"cells": 4.0}, products(20, 3)),
        ({"anchors": 2.0, "cells": 8.0}, products(40, 3) + products(20, 3)),
        ({"anchors": 2.0, "layers": 3.0, "coarse_layers": 1.0}, 3 * products(5, 3) + 3 * products(10, 3)),
        ({"indirect": 1.0}, products(5, 3) + products(10, 3)),
        ({"followed_anchors": 3.0, "layers": 3.0, "coarse_layers": 1.0}, 3 * products(5, 3) + products(7.5, 3)),
        ({"occluded_anchors": 4.0}, products(5, 3)),
        ({"occluded": 1.0, "occluded_anchors": 4.0}, products(5, 3) + products(2, 3)),
        ({"occluded": 90.0, "occluded_anchors": 4.0}, products(5, 3) + products(20, 3)),
        ({"mixed": 1.0}, products(5, 3) + 4 * 50**2),
    ],
)
def test_forming_a_frame_is_as_many_products_as_its_matrices_have(
    change: dict[str, float], multiplications: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of the ten rows of cells hold light; coarse light of several anchors and indirect light add frames.

    A quarter of the pixels is lit: of one occluded pixel a quarter of two rows, of many no more than of all.
    """
    count(monkeypatch)
    assert formed(FORMING, replace(ONE, **change), 7.0) == pytest.approx(7 * multiplications)


def test_lines_share_paths_and_form_and_file_each_its_own() -> None:
    """Three lines: two fifths more tracing, or three times as much where glass parts them, and all else three times.
    (Planted: shadows of one line; accumulating of one; paths shared whatever parts them.)"""
    three = replace(PILOT_RESULT, forming=replace(PILOT_RESULT.forming, lines=3))
    settings = plan(pilot_result=PILOT_RESULT).settings
    numbers = Numbers.of(settings)
    for seconds in (
        lambda forming: forming_seconds(forming, numbers, 5.0),
        lambda forming: optics_seconds(forming, numbers),
        lambda forming: checking_seconds(forming, numbers),
        lambda forming: accumulation_seconds(forming, numbers, 1e6),
    ):
        assert seconds(three.forming) == pytest.approx(3 * seconds(PILOT_RESULT.forming))  # type: ignore[no-untyped-call]
    one, several = (tracing_seconds(pilot_result, settings) for pilot_result in (PILOT_RESULT, three))
    assert several == pytest.approx({name: 1.4 * each for name, each in one.items()})
    parted = tracing_seconds(replace(three, forming=replace(three.forming, parted=True)), settings)
    assert parted == pytest.approx({name: 3 * each for name, each in one.items()})
    assert truth_seconds(three, settings) == pytest.approx(1.4 * truth_seconds(PILOT_RESULT, settings))
