"""The effect plan: settings that keep an accuracy, an honest word on each effect, and the budget that sampling has."""

import math
from dataclasses import replace

import pytest

from mitsim.bench.effects import EFFECTS, SWITCHES
from mitsim.bench.request import check_accuracy
from mitsim.core.errors import MitsimError
from mitsim.light.plan import Plan
from mitsim.light.settings import Approximation, Drawn, Estimate
from tests.unit.planner.invented_pilot_result import (
    ACCURACIES,
    ONE_CLASS,
    PILOT_RESULT,
    SIZES,
    changes,
    plan,
    rows,
)


def test_effects_that_the_scene_does_not_have_stay_off() -> None:
    found = rows(plan(1e-3))["mirrors"]
    assert found.state == "off" and found.error_if_off == 0 and found.reason == EFFECTS["mirrors"].absent


def test_a_flat_scene_has_one_layer_whatever_is_asked_for() -> None:
    sizes = {part: size for part, size in SIZES.items() if "layers" not in part.name}
    flat = replace(PILOT_RESULT, layers={1: (400.0,)}, changes=changes(sizes), depth=400.0)
    for effects in ("", "+layers", "-layers"):
        assert plan(1e-4, flat, effects).settings.depths == (400.0,)


def test_what_takes_no_time_is_always_on() -> None:
    for accuracy in (*ACCURACIES, 0.3):
        assert {"blur", "speckle"} <= plan(accuracy).settings.effects


# ---- rows


def test_every_switch_has_a_row_and_more() -> None:
    names = [effect.name for effect in plan().effects]
    assert len(set(names)) == len(names)
    assert set(SWITCHES) <= set(names)
    assert {"cells", "keystone", "spectrum", "sensor-noise"} <= set(names)
    for effect in plan().effects:
        assert effect.state in ("exact", "approximate", "off")
        assert (effect.reason or effect.state == "exact") and "\n" not in effect.reason


def test_rows_carry_the_measured_errors() -> None:
    found = rows(plan())
    assert found["anchors"].error_if_off == pytest.approx(SIZES[Approximation("anchors", 1)])
    assert found["layers"].error_if_off == pytest.approx(SIZES[Approximation("layers", 1)])
    for name, error in PILOT_RESULT.effects.items():
        assert found[name].error_if_off == error.value
    assert found["diffraction"].reason == "Fresnel number 3.2"


def test_a_row_is_found_by_its_name() -> None:
    found = plan()
    assert all(found.row(row.name) is row for row in found.effects)
    with pytest.raises(MitsimError, match=r"plan: no row 'lens'; there are anchors, layers, .*aperture"):
        found.row("lens")


def test_it_shows_itself() -> None:
    found = plan(pilot_result=replace(PILOT_RESULT, changes=changes(SIZES | {Approximation("ambient"): 0.0})))
    shown = found._repr_html_()
    assert all(row.name in shown for row in found.effects) and "0.0e+00" not in shown
    assert repr(found).startswith("Plan(accuracy 0.001: anchors approximate") and "ambient" not in repr(found)


# ---- the budget


@pytest.mark.parametrize("accuracy", ACCURACIES)
def test_sampling_gets_what_is_left(accuracy: float) -> None:
    found = plan(accuracy)
    assert 0 < found.sampling_target < accuracy
    if not found.warnings:
        assert math.hypot(found.systematic_bound, found.sampling_target) <= accuracy
    total = found.total(Estimate(0.8 * found.sampling_target, found.sampling_target))
    assert total.value == pytest.approx(math.hypot(found.systematic_error, 0.8 * found.sampling_target))
    assert total.bound == pytest.approx(math.hypot(found.systematic_bound, found.sampling_target))


def test_what_does_not_fit_is_flagged_with_the_largest_part() -> None:
    found = plan(1e-3, effects="-interreflection,-diffraction")
    (warning,) = found.warnings
    assert "largest: diffraction (off), 3.0e-01" in warning
    assert found.systematic_error == pytest.approx(0.3, rel=0.01) and "0.001" in warning
    (warning,) = plan(1e-6, ONE_CLASS).warnings
    assert "largest: layers (4), 5.0e-05" in warning


def test_what_nothing_can_make_up_for_does_not_make_the_rest_finer() -> None:
    """Without speckle the frames are 8e-3 off, without the spot 1e-3; the rest is as for the accuracy asked for."""
    with_it, without = plan(1e-3).settings, plan(1e-3, effects="-speckle,-blur").settings
    assert with_it.effects - without.effects == {"speckle", "blur"}
    assert replace(without, effects=with_it.effects) == with_it


def test_what_a_masks_raster_leaves_is_in_the_budget() -> None:
    """With waves alone where only these are drawn on one: in the systematic error, and told as the largest part where
    the accuracy is finer. (Planted: left out of the sum; without waves too; never chosen.)"""
    drawn = replace(PILOT_RESULT, raster=(Drawn(), Drawn(Estimate(3e-3, 4e-3), needed=True)))
    loose, without = plan(1e-2, drawn), plan(1e-2)
    assert loose.settings.raster and not without.settings.raster and not loose.warnings
    assert loose.systematic_bound >= 4e-3 and loose.systematic_error >= 3e-3
    assert "on a raster" in loose.row("mask-shadow").reason
    fine = plan(3.9e-3, drawn)
    assert any("largest: the mask's raster, 4.0e-03" in reported for reported in fine.warnings)
    assert not plan(3.9e-3, drawn, "-diffraction").settings.raster and not plan(3.9e-3).warnings


def test_a_raster_has_as_many_cells_as_the_accuracy_needs() -> None:
    """Of 6, 8 and 12 a pixel, which leave up to 4e-3, 2.6e-3 and 1.4e-3. (Planted: the error of
    the fewest for all.)"""
    drawn = replace(PILOT_RESULT, raster=(Drawn(), Drawn(Estimate(3e-3, 4e-3), needed=True, cells=(6, 8, 12))))
    found = {accuracy: plan(accuracy, drawn) for accuracy in (1e-2, 2e-3)}
    assert [each.settings.raster_cells for each in found.values()] == [6, 12]
    assert not any(each.warnings for each in found.values())
    row = found[2e-3].row("mask-shadow")
    assert "12 cells a pixel" in row.reason and "leaves 1.1e-03" in row.reason and row.seconds > 0
    assert found[2e-3].block()["settings"]["raster_cells"] == 12
    fewest = found[1e-2].row("mask-shadow")
    assert "leaves 3.0e-03" in fewest.reason and 0 < fewest.seconds < row.seconds
    (warning,) = plan(1e-3, drawn).warnings
    assert "the mask's raster, 1.4e-03" in warning


def test_many_terms_are_summed_or_formed_by_fft_whichever_takes_less() -> None:
    """At the accuracy. (Planted: always by FFT; the raster's error not counted; drawing for nothing.)"""

    def shown(accuracy: float, terms: float, drawing: float = 0.05) -> Plan:
        forming = replace(PILOT_RESULT.forming, geometric_terms=terms, drawing=(drawing, 0.0))
        candidate = replace(PILOT_RESULT, forming=forming, raster=(Drawn(Estimate(4e-4, 6e-4)), Drawn()))
        return plan(accuracy, candidate, "-diffraction")

    few, many = shown(1e-2, 3.0), shown(1e-2, 200.0)
    assert not few.settings.raster and many.settings.raster
    assert not shown(5e-4, 200.0).settings.raster and not shown(1e-2, 200.0, drawing=100.0).settings.raster
    assert few.row("mask-shadow").state == "exact" and "3 separable terms are summed" in few.row("mask-shadow").reason
    row = many.row("mask-shadow")
    assert row.state == "approximate" and "by FFT" in row.reason
    assert many.block()["settings"]["raster"] is True


@pytest.mark.parametrize("accuracy", [0.0, -1e-3, 1e-7, 0.5, math.nan, math.inf])
def test_accuracies_that_cannot_be_promised(accuracy: float) -> None:
    with pytest.raises(MitsimError, match=r"^accuracy"):
        check_accuracy(accuracy)
    with pytest.raises(MitsimError, match=r"^accuracy"):
        plan(accuracy)
