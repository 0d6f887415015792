"""What simulating is predicted to take: multiplications counted by hand, and the pilot's own frame found again."""

from dataclasses import replace

import pytest

from mitsim.light.cost_model import (
    FIXED,
    Numbers,
    UnitCosts,
    accumulation_seconds,
    checking_seconds,
    entries,
    forming_seconds,
    optics_seconds,
    predicted_rays,
    tracing_seconds,
    truth_seconds,
)
from mitsim.light.settings import GROUPS, Forming, Noise, SampleCost, Settings
from mitsim.optics.fft_shadow import CORRELATION_PRODUCTS
from mitsim.optics.forming import PROBES
from mitsim.planner.choose import unit_costs_of
from tests.unit.planner.invented_pilot_result import PILOT_RESULT, plan

FORMING = Forming(pixels=50, cells=10, lit=0.5, terms=3.0, shots=4, classes=4)
ONE = Numbers.coarsest()
COUNTED = UnitCosts(dict.fromkeys(FIXED.passes, 0.0), frame=0.0, product=1.0, entry=0.0, accumulated=0.0, ray=0.0)
"""Unit costs at which seconds are multiplications of forming frames."""


def products(rows: float, terms: float = 1.0) -> float:
    """Of left (50, rows) times light (rows, rows) times right (rows, 50), and of the groups' probes in the same way."""
    probes = GROUPS * (PROBES + 1) * (min(rows, 50) + 50) * rows
    return terms * (50 * rows * rows + 50 * 50 * rows + probes)


def test_a_slower_machine_is_slower_in_all_that_it_does_with_matrices() -> None:
    """As much as its products are, and in rays of the truth as direct light is. (Planted: a frame's own seconds, or a
    ray's, left as they are.)"""
    nothing = replace(
        PILOT_RESULT.with_sample_costs({"direct": replace(PILOT_RESULT.sample_costs["direct"], seconds=0.0)}),
        forming=replace(PILOT_RESULT.forming, product=0.0),
    )
    names = "frame", "product", "entry", "accumulated", "pixel"
    assert unit_costs_of(nothing).passes["direct"] == FIXED.passes["direct"]
    assert [getattr(unit_costs_of(nothing), name) for name in names] == [getattr(FIXED, name) for name in names]
    slow = replace(PILOT_RESULT, forming=replace(PILOT_RESULT.forming, product=6 * FIXED.product))
    slower = [getattr(unit_costs_of(slow), name) / getattr(FIXED, name) for name in names]
    assert slower == pytest.approx([6.0] * len(names))
    other = PILOT_RESULT.with_sample_costs({"direct": replace(PILOT_RESULT.sample_costs["direct"], seconds=5e-6)})
    assert unit_costs_of(other).passes["direct"] == 5e-6
    for times in (3.0, 0.0):
        spread = replace(PILOT_RESULT.spread, seconds=times * FIXED.passes["direct"])
        ray = unit_costs_of(replace(PILOT_RESULT, spread=spread)).ray
        assert ray == pytest.approx((times or 1.0) * FIXED.ray)


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
    change: dict[str, float], multiplications: float
) -> None:
    """Half of the ten rows of cells hold light; coarse light of several anchors and indirect light add frames.

    A quarter of the pixels is lit: of one occluded pixel a quarter of two rows, of many no more than of all.
    """
    assert forming_seconds(FORMING, replace(ONE, **change), 7.0, COUNTED) == pytest.approx(7 * multiplications)


def test_occluded_pixels_in_a_column_are_a_narrow_matrix() -> None:
    """They lie in all rows and a tenth of the columns: two columns of light by 20 rows, or as many of rows. (Planted:
    as many columns as rows.)"""
    numbers = replace(ONE, occluded=90.0, occluded_anchors=4.0)
    for parts, rows, columns in (((1.0, 0.1), 20, 2), ((0.1, 1.0), 2, 20)):
        narrow = 3 * (50 * rows * columns + 50**2 * 2 + GROUPS * (PROBES + 1) * (columns + 50) * rows)
        found = forming_seconds(replace(FORMING, occluded=parts), numbers, 1.0, COUNTED)
        assert found == pytest.approx(products(5, 3) + narrow)


def test_shots_that_are_no_mixtures_hold_their_own_light_alone() -> None:
    """More classes than shots: frames are formed shot by shot, and what leaks in all of them once and for all."""
    forming = replace(FORMING, classes=9)
    assert forming_seconds(forming, ONE, 1.0, COUNTED) == pytest.approx(products(5, 3))
    assert forming_seconds(forming, replace(ONE, mixed=1.0), 1.0, COUNTED) == pytest.approx(products(5, 3))


def test_shadows_take_entries_of_waves_or_a_thirtieth_of_one_without() -> None:
    """Two sides of pixels times cells, for fine light, and once more where light is coarse."""
    entries = replace(COUNTED, product=0.0, entry=1.0)
    one = 2 * 50 * 10
    for change, count in (
        ({}, 3 * one),
        ({"waves": 0.0}, 0.03 * one),
        ({"cells": 2.0, "layers": 2.0}, 4 * 3 * one),
        ({"anchors": 2.0, "cells": 8.0}, (8 + 2) * 3 * one),
        ({"anchors": 2.0, "indirect": 1.0}, (1 + 2) * 3 * one),
        ({"followed_anchors": 2.0, "coarse_layers": 1.0}, (1 + 0.25) * 3 * one),
    ):
        assert optics_seconds(FORMING, replace(ONE, **change), entries) == pytest.approx(count), change
    many = replace(FORMING, geometric_terms=9.0)
    assert optics_seconds(many, replace(ONE, waves=0.0), entries) == pytest.approx(1.2 * 9 * one)


def test_a_frame_by_fft_is_correlations_and_its_raster_is_sharpened() -> None:
    """One for each cell of a pixel and layer, and as many for each group's probes; no entries of a shadow. Waves take
    some for each cell. (Planted: cells a side; probes of one group; entries as of sums; cells of waves for nothing.)
    """
    forming = replace(FORMING, correlated=(True, True), phases=36.0)
    for cells, phases in ((0.0, 36), (8.0, 64)):
        numbers = replace(ONE, raster_cells=cells, layers=2.0)
        correlations = CORRELATION_PRODUCTS * phases * 2 * 50**2
        assert forming_seconds(forming, numbers, 7.0, COUNTED) == pytest.approx(7 * (1 + GROUPS) * correlations)
    costs, numbers = replace(COUNTED, product=FIXED.product, entry=1.0), replace(ONE, raster_cells=8.0)
    formed = forming_seconds(forming, numbers, FORMING.classes, costs)
    assert optics_seconds(forming, numbers, costs) - formed == pytest.approx(5e-8 * 50**2 * 64)


def test_largest_terms_are_summed_where_that_takes_less_and_memory_holds_them() -> None:
    """One lit row of cells: 100 terms of it take less than a correlation, but 256 MiB do not hold those of 8000 rows.
    (Planted: held whatever they take; the dearer way.)"""
    one = replace(FORMING, correlated=(True, True), lit=1 / 2000, cells=2000, largest_terms=(100.0, 100.0))
    assert forming_seconds(one, ONE, 1.0, COUNTED) == pytest.approx(products(1, 100))
    correlations = CORRELATION_PRODUCTS * one.phases * 50**2
    large = replace(one, lit=1 / 8000, cells=8000)
    assert forming_seconds(large, ONE, 1.0, COUNTED) == pytest.approx((1 + GROUPS) * correlations)


def test_looks_see_all_classes_or_some_shots_and_more_where_light_is_followed() -> None:
    """At 0.4 of a frame's time, one round and a half and one more of followed light. (Planted: 64 shots always.)"""
    many = replace(FORMING, shots=100, classes=200)
    one = products(5, 3)
    assert checking_seconds(many, ONE, COUNTED) == pytest.approx(0.4 * 1.5 * 16 * one)
    followed = forming_seconds(many, replace(ONE, indirect=1.0), 1.0, COUNTED)
    assert checking_seconds(many, replace(ONE, indirect=1.0), COUNTED) == pytest.approx(0.4 * 2.5 * 64 * followed)
    assert checking_seconds(FORMING, ONE, COUNTED) == pytest.approx(0.4 * 0.5 * FORMING.classes * one)


def test_tracing_takes_a_path_of_every_sample_in_every_group_and_connections_to_all_anchors() -> None:
    """Samples are whole; differences between 3 x 3 anchors take nine connections each, and one anchor has none."""
    settings = replace(plan().settings, samples={"direct": 2.5, "anchor_residual": 4.0})
    costs, paths = replace(COUNTED, passes=dict.fromkeys(FIXED.passes, 1.0)), PILOT_RESULT.sample_costs["direct"].paths
    several, one = (tracing_seconds(PILOT_RESULT, replace(settings, anchors=count), costs) for count in (3, 1))
    assert several["direct"] == one["direct"] == GROUPS * 3 * paths
    anchored = 9 * GROUPS * 4 * PILOT_RESULT.sample_costs["anchor_residual"].paths
    assert several["anchor_residual"] == anchored and one["anchor_residual"] == 0
    light = SampleCost(Noise(1e-3, 4, 0.5), 3)
    occluded = replace(PILOT_RESULT, occluded=(3, 4, 5)).with_sample_costs({"penumbra": light})
    own = replace(settings, occluded=(3, 4, 5), occluded_anchors=8, samples={"penumbra": 2.0})
    assert tracing_seconds(occluded, own, costs)["penumbra"] == 64 * GROUPS * 2 * 3
    assert tracing_seconds(occluded, settings, costs)["penumbra"] == 0


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


def test_every_shot_is_looked_through_once_more_than_it_is_formed() -> None:
    """For its brightest pixel and its energy, at so much a pixel: shots of 50 x 50 pixels, mixed or not.

    (Planted: a side of the sensor in place of its pixels.)
    """
    looked = replace(COUNTED, product=0.0, pixel=1.0)
    for classes in (FORMING.classes, 9):
        forming = replace(FORMING, classes=classes)
        assert optics_seconds(forming, ONE, looked) == pytest.approx(FORMING.shots * 50**2)


def test_lines_share_paths_and_form_and_file_each_its_own() -> None:
    """Three lines: two fifths more tracing, or three times as much where glass parts them, and all else three times.
    (Planted: shadows of one line; accumulating of one; paths shared whatever parts them.)"""
    three = replace(PILOT_RESULT, forming=replace(PILOT_RESULT.forming, lines=3))
    settings = plan(pilot_result=PILOT_RESULT).settings
    numbers = Numbers.of(settings)
    for seconds in (
        lambda forming: forming_seconds(forming, numbers, 5.0, FIXED),
        lambda forming: optics_seconds(forming, numbers, FIXED),
        lambda forming: checking_seconds(forming, numbers, FIXED),
        lambda forming: accumulation_seconds(forming, numbers, 1e6, FIXED),
    ):
        assert seconds(three.forming) == pytest.approx(3 * seconds(PILOT_RESULT.forming))  # type: ignore[no-untyped-call]
    one, several = (tracing_seconds(pilot_result, settings, FIXED) for pilot_result in (PILOT_RESULT, three))
    assert several == pytest.approx({name: 1.4 * each for name, each in one.items()})
    parted = tracing_seconds(replace(three, forming=replace(three.forming, parted=True)), settings, FIXED)
    assert parted == pytest.approx({name: 3 * each for name, each in one.items()})
    assert truth_seconds(three, settings, FIXED) == pytest.approx(1.4 * truth_seconds(PILOT_RESULT, settings, FIXED))


@pytest.mark.parametrize(("rate", "times"), [(0.5, 36), (1.0, 6)])
def test_truth_takes_rays_until_it_is_off_by_a_sixth_of_what_the_frames_are(rate: float, times: int) -> None:
    """By as many times the frames' samples, of which choosing where they go saves half; and those it begins with, 16 a
    pixel and 8 of a board in each of four groups. (Planted: a sixth of the samples; none saved.)"""
    assert predicted_rays(1000, 5.0, rate) == pytest.approx(4 * 1000 * (16 + 8) + 0.5 * 4 * 1000 * 5 * times)
    assert predicted_rays(1000, 1e6, rate) == 2**22 and predicted_rays(10**6, 1e6, rate) == 128 * 10**6


def test_truth_is_as_rough_as_direct_light_where_the_sensor_sees_it() -> None:
    """At points of all the sensor where frames have anchors, else at its centre. (Planted: one for the other.)"""
    direct = replace(PILOT_RESULT.sample_costs["direct"], paths=1000, noise=Noise(2e-3, 16, 0.5))
    found = replace(PILOT_RESULT, spread=replace(direct, noise=Noise(2e-3, 16, 1.0)))
    found = found.with_sample_costs({"direct": direct})
    for anchors, rate in ((1, 0.5), (3, 1.0)):
        settings = Settings(depth=400.0, anchors=anchors, samples={"direct": 6.0})
        rays = predicted_rays(1000, 6.0, rate)
        assert truth_seconds(found, settings, FIXED) == pytest.approx(FIXED.ray * rays)


def test_an_accumulator_is_emptied_and_looked_through_where_it_has_room() -> None:
    """4 classes of 10 x 10 cells in two layers, where light is followed over several surfaces."""
    numbers = replace(ONE, indirect=1.0, layers=2.0)
    places = 4 * 10**2 * 2
    entry = GROUPS * FIXED.accumulated
    assert accumulation_seconds(FORMING, numbers, 1000.0, FIXED) == pytest.approx(entry * (1000 + 0.4 * places))
    assert accumulation_seconds(FORMING, replace(numbers, indirect=0.0), 1000.0, FIXED) == pytest.approx(entry * 1000)
    most = 2**26 // 200
    large = replace(FORMING, classes=most)
    assert accumulation_seconds(large, numbers, 1000.0, FIXED) == pytest.approx(entry * (1000 + 0.4 * most * 200))
    larger = replace(FORMING, classes=most + 1)
    assert accumulation_seconds(larger, numbers, 1000.0, FIXED) == pytest.approx(entry * 1000)
