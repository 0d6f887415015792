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
from mitsim.optics.fft_shadow import CORRELATION_PRODUCTS
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


def test_forming_follows_where_light_lies_and_how_frames_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """Occluded pixels in a column are a narrow matrix; shots that are no mixtures hold their own light alone. (Planted:
    as many columns as rows.)"""
    count(monkeypatch)
    numbers = replace(ONE, occluded=90.0, occluded_anchors=4.0)
    for parts, rows, columns in (((1.0, 0.1), 20, 2), ((0.1, 1.0), 2, 20)):
        narrow = 3 * (50 * rows * columns + 50**2 * 2 + GROUPS * (PROBES + 1) * (columns + 50) * rows)
        found = formed(replace(FORMING, occluded=parts), numbers)
        assert found == pytest.approx(products(5, 3) + narrow)
    forming = replace(FORMING, classes=9)
    assert formed(forming, ONE) == formed(forming, replace(ONE, mixed=1.0)) == pytest.approx(products(5, 3))


def test_shadows_take_entries_of_waves_or_a_thirtieth_of_one_without(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two sides of pixels times cells, for fine light, and once more where light is coarse."""
    count(monkeypatch, _ENTRY_S=1.0)
    one = 2 * 50 * 10
    for change, number in (
        ({}, 3 * one),
        ({"waves": 0.0}, 0.03 * one),
        ({"cells": 2.0, "layers": 2.0}, 4 * 3 * one),
        ({"anchors": 2.0, "cells": 8.0}, (8 + 2) * 3 * one),
        ({"anchors": 2.0, "indirect": 1.0}, (1 + 2) * 3 * one),
        ({"followed_anchors": 2.0, "coarse_layers": 1.0}, (1 + 0.25) * 3 * one),
    ):
        assert optics_seconds(FORMING, replace(ONE, **change)) == pytest.approx(number, rel=1e-4), change
    many = replace(FORMING, geometric_terms=9.0)
    assert optics_seconds(many, replace(ONE, waves=0.0)) == pytest.approx(1.2 * 9 * one, rel=1e-4)


def test_a_frame_by_fft_is_correlations_and_its_raster_is_sharpened(monkeypatch: pytest.MonkeyPatch) -> None:
    """One for each cell of a pixel and layer, and as many for each group's probes; no entries of a shadow. Waves take
    some for each cell. (Planted: cells a side; probes of one group; entries as of sums; cells of waves for nothing.)
    """
    count(monkeypatch)
    forming = replace(FORMING, correlated=(True, True), phases=36.0)
    for cells, phases in ((0.0, 36), (8.0, 64)):
        numbers = replace(ONE, raster_cells=cells, layers=2.0)
        correlations = CORRELATION_PRODUCTS * phases * 2 * 50**2
        assert formed(forming, numbers, 7.0) == pytest.approx(7 * (1 + GROUPS) * correlations)
    numbers = replace(ONE, raster_cells=8.0)
    whole, frames = optics_seconds(forming, numbers), forming_seconds(forming, numbers, FORMING.classes)
    assert whole - frames == pytest.approx(5e-8 * 50**2 * 64)


def test_largest_terms_are_summed_where_that_takes_less_and_memory_holds_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """One lit row of cells: 100 terms of it take less than a correlation, but 256 MiB do not hold those of 8000 rows.
    (Planted: held whatever they take; the dearer way.)"""
    count(monkeypatch)
    one = replace(FORMING, correlated=(True, True), lit=1 / 2000, cells=2000, largest_terms=(100.0, 100.0))
    assert formed(one, ONE) == pytest.approx(products(1, 100))
    correlations = CORRELATION_PRODUCTS * one.phases * 50**2
    large = replace(one, lit=1 / 8000, cells=8000)
    assert formed(large, ONE) == pytest.approx((1 + GROUPS) * correlations)


def test_looks_see_all_classes_or_some_shots_and_more_where_light_is_followed() -> None:
    """At 0.4 of a frame's time, one round and a half and one more of followed light. (Planted: 64 shots always.)"""
    many = replace(FORMING, shots=100, classes=200)
    for numbers, forming, frames in (
        (ONE, many, 1.5 * 16),
        (replace(ONE, indirect=1.0), many, 2.5 * 64),
        (ONE, FORMING, 0.5 * FORMING.classes),
    ):
        assert checking_seconds(forming, numbers) == pytest.approx(forming_seconds(forming, numbers, 0.4 * frames))


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


def test_every_shot_is_looked_through_once_more_than_it_is_formed(monkeypatch: pytest.MonkeyPatch) -> None:
    """For its brightest pixel and its energy, at so much a pixel: shots of 50 x 50 pixels, mixed or not.

    (Planted: a side of the sensor in place of its pixels.)
    """
    count(monkeypatch, _PIXEL_S=1.0)
    for classes in (FORMING.classes, 9):
        forming = replace(FORMING, classes=classes)
        assert optics_seconds(forming, ONE) == pytest.approx(FORMING.shots * 50**2, rel=1e-4)


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


def test_truth_takes_rays_until_it_is_off_by_a_sixth_of_what_the_frames_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """By as many times the frames' samples, of which choosing where they go saves half; and those it begins with, 16 a
    pixel and 8 of a board in each of four groups. Light is as rough as at points of all the sensor where frames have
    anchors, else as at its centre. (Planted: a sixth of the samples; none saved; one roughness for the other.)"""
    count(monkeypatch, _RAY_S=1.0)

    def rays(pixels: int, samples: float, anchors: int = 1) -> float:
        direct = replace(PILOT_RESULT.sample_costs["direct"], paths=pixels, rate=0.5)
        found = with_sample_costs(replace(PILOT_RESULT, spread=replace(direct, rate=1.0)), direct=direct)
        return truth_seconds(found, Settings(depth=400.0, anchors=anchors, samples={"direct": samples}))

    for anchors, times in ((1, 36), (3, 6)):
        assert rays(1000, 6.0, anchors) == pytest.approx(4 * 1000 * (16 + 8) + 0.5 * 4 * 1000 * 6 * times)
    assert rays(1000, 2.0**20) == 2**22 and rays(10**6, 2.0**20) == 128 * 10**6


def test_an_accumulator_is_emptied_and_looked_through_where_it_has_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """4 classes of 10 x 10 cells in two layers, where light is followed over several surfaces."""
    count(monkeypatch, _ACCUMULATED_S=1.0)
    numbers, most = replace(ONE, indirect=1.0, layers=2.0), 2**26 // 200
    for classes, own, passed in (
        (4, numbers, 0.4 * 4 * 200),
        (4, replace(numbers, indirect=0.0), 0.0),
        (most, numbers, 0.4 * most * 200),
        (most + 1, numbers, 0.0),
    ):
        found = accumulation_seconds(replace(FORMING, classes=classes), own, 1000.0)
        assert found == pytest.approx(GROUPS * (1000 + passed))
