"""What simulating is predicted to take: multiplications counted by hand, at unit costs of one or none."""

from dataclasses import replace

import pytest

from mitsim.light import cost_model
from mitsim.light.cost_model import (
    Numbers,
    accumulation_seconds,
    checking_seconds,
    entries,
    forming_seconds,
    optics_seconds,
    tracing_seconds,
    truth_seconds,
)
from mitsim.light.passes import PASSES
from mitsim.light.settings import GROUPS, Forming, SampleCost, Settings
from mitsim.optics.frames import PROBES
from tests.unit.planner.invented_pilot_result import PILOT_RESULT, plan, with_sample_costs

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


def test_tracing_takes_a_path_of_every_sample_in_every_group_and_connections_to_all_anchors() -> None:
    """Samples are whole; differences between 3 x 3 anchors take nine connections each, and one anchor has none."""
    settings = replace(plan().settings, samples={"direct": 2.5, "anchor_residual": 4.0})
    paths, cost = PILOT_RESULT.sample_costs["direct"].paths, {name: row.unit_cost for name, row in PASSES.items()}
    several, one = (tracing_seconds(PILOT_RESULT, replace(settings, anchors=number)) for number in (3, 1))
    assert several["direct"] == one["direct"] == pytest.approx(GROUPS * 3 * paths * cost["direct"])
    anchored = 9 * GROUPS * 4 * PILOT_RESULT.sample_costs["anchor_residual"].paths * cost["anchor_residual"]
    assert several["anchor_residual"] == pytest.approx(anchored) and one["anchor_residual"] == 0
    occluded = with_sample_costs(replace(PILOT_RESULT, occluded=(3, 4, 5)), penumbra=SampleCost(1e-3, 4, 3))
    own = replace(settings, occluded=(3, 4, 5), occluded_anchors=8, samples={"penumbra": 2.0})
    found = tracing_seconds(occluded, own)["penumbra"]
    assert found == pytest.approx(64 * GROUPS * 2 * 3 * cost["penumbra"])
    assert tracing_seconds(occluded, settings)["penumbra"] == 0


def test_light_lies_in_the_cells_that_its_samples_reach() -> None:
    """100 pixels, 7 classes. Direct light: a pixel's own cells and as many beyond its edge, in two layers at most; what
    several anchors see, and twice of it: of each and their mean; followed light: all cells of each class."""
    samples = {"direct": 3.0, "anchor_residual": 50.0, "indirect": 1e3, "indirect_residual": 20.0}
    settings = Settings(depth=400.0, samples=samples)
    for numbers, found in (
        (ONE, 2),
        (replace(ONE, cells=2.0), 3),
        (replace(ONE, cells=2.0, layers=4.0), 2 * 3),
        (replace(ONE, anchors=2.0, cells=8.0), 3 + 2 * 2**2 * 2 * 4),
        (replace(ONE, indirect=1.0, cells=8.0), 3 + 7 * 2**2),
        (replace(ONE, followed_anchors=4.0), 2 + 2 * 4**2 * 7 / 4**2),
        (replace(ONE, followed_anchors=4.0, cells=8.0), 3 + 2 * 4**2 * 7 / 2**2),
        (replace(ONE, followed_anchors=4.0, cells=8.0, coarse_layers=0.0), 3 + 2 * 4**2 * 7 / 4**2),
    ):
        assert entries(100, 7, numbers, settings) == 100 * found, numbers


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
