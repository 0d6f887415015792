"""The effect plan: settings that keep an accuracy, an honest word on each effect, and the budget that sampling has."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from mitsim.bench.effects import EFFECTS, SWITCHES
from mitsim.bench.request import Request
from mitsim.core.environment import deciding_versions
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.job import Cost
from mitsim.light.passes import even
from mitsim.light.plan import Plan
from mitsim.light.settings import REPLICATES, Approximation, Drawn, ErrorCovariance, Estimate, SampleCost, SharpPixels
from mitsim.planner.planner import make_plan
from tests.unit.planner.test_choice import ACCURACIES, ONE_CLASS, PILOT_RESULT, SIZES, changes, plan, rows
from tests.unit.planner.test_choice import plan as invented_plan


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
        Request.of(accuracy=accuracy)
    with pytest.raises(MitsimError, match=r"^accuracy"):
        make_plan(cast(Any, None), cast(Any, None), accuracy, 0)


# -------- Changes that effects make in the frames
#
# Changes that effects make in the frames, as looks of the pilot show them: how they add up, what noise leaves.


def seen(*vectors: list[float]) -> ErrorCovariance:
    """Changes without noise, named a, b, ..."""
    named = {Approximation(chr(97 + index)): np.array([vector] * REPLICATES) for index, vector in enumerate(vectors)}
    return ErrorCovariance.between(named, 4.0)


def test_changes_add_up_with_their_signs() -> None:
    """Frames of norm 2; a and b are opposite, c stands at right angles to both."""
    found = seen([6e-3, 0.0], [-4e-3, 0.0], [0.0, 8e-3])
    a, b, c = found.parts
    assert found.estimate([a]) == pytest.approx((3e-3, 3e-3))
    assert found.estimate([a, b]) == pytest.approx((1e-3, 1e-3))
    assert found.estimate([a, c]) == pytest.approx((5e-3, 5e-3))
    assert found.estimate([a, b, c]) == pytest.approx((math.hypot(1e-3, 4e-3),) * 2)
    assert found.estimate([]) == (0.0, 0.0)


def test_the_noise_of_replicates_is_no_change_and_bounds_hold() -> None:
    """500 scenes whose change of 1e-3 is seen with noise of 3e-3 in each look: unbiased squares, 95 % of bounds."""
    part, scenes = Approximation("blur"), 500
    squares, held = [], 0
    for seed in range(scenes):
        found = changes({part: 1e-3}, 3e-3, seed)
        squares.append(float(found.squared_errors(np.ones((1, 1)))[0][0]))
        held += found.estimate([part]).bound >= 1e-3
    error = np.std(squares) / math.sqrt(scenes)
    assert np.mean(squares) == pytest.approx(1e-6, abs=3 * error) and error < 1e-7
    assert held / scenes > 0.92, "binomial: 0.95 of 500, less three standard deviations"


def test_a_change_that_cannot_be_told_is_told_as_a_bound() -> None:
    """A lens whose change is below the pilot's noise is not exact."""
    noisy = replace(PILOT_RESULT, changes=changes(SIZES | {Approximation("aperture"): 0.0}, 1e-4))
    reason = rows(plan(1e-2, noisy, "-aperture"))["aperture"].reason
    assert "less than" in reason
    assert noisy.effects["aperture"].bound > 1e-6


def test_noise_says_how_many_samples_it_takes() -> None:
    """Error 2e-3 at 16 samples, falling with their power -0.8: a tenth needs 10^(1/0.8) times as many."""
    noise = SampleCost(2e-3, 16, 1, 0.8)
    assert noise.samples_for(2e-3) == pytest.approx(16)
    assert noise.samples_for(2e-4) == pytest.approx(16 * 10**1.25)
    assert 0 < SampleCost(0.0, 16, 1, 1.0).samples_for(1e-9) <= 1


@pytest.mark.parametrize(
    ("asked", "taken"), [(0.2, 1), (1, 1), (1.2, 2), (2.5, 3), (3.1, 4), (12, 12), (12.5, 16), (97, 128)]
)
def test_points_of_a_sobol_sequence_come_in_even_numbers(asked: float, taken: int) -> None:
    assert even(asked) == taken and even(np.array([asked])) == [taken]


# -------- A plan in a file
#
# A plan in a file: what is read is what was written, and nothing else is read.

MADE_OF = {
    "version": deciding_versions(),
    "colour": None,
    "variant": "llvm_ad_mono",
    "scene": {"its XML": "a" * 64, "print.png": "b" * 64},
    "parameter": {"albedo": "0.4"},
    "board": None,
    "camera": {"mask_distance": 2.0},
    "projector": {"effective_wavelength_nm": 562.0},
}


def planned() -> Plan:
    """With something in every field, in NumPy's numbers too, as a pilot leaves them."""
    plan = invented_plan(1e-3)
    settings = replace(
        plan.settings,
        samples={"direct": np.float64(12.7), "indirect": 1e-3},
        layers=(430.0, np.float64(380.1)),
        repeats=tuple(np.array([1, 4, 2, 0])),
        reach=0.31,
        sharp=SharpPixels((5, 9), 3, (-0.05, 0.05, -0.1, 0.1), 1e-4),
        occluded=(3, 4),
    )
    return replace(
        plan,
        settings=settings,
        request=Request.of(patterns="dots:3", accuracy=1e-3, seed=2**63, effects="-blur"),
        cost=Cost(3.0, 2.0**30, 1e6),
        made_of=MADE_OF,
    )


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return planned().save(tmp_path / "plan.json")


def test_what_is_read_is_what_was_written(file: Path) -> None:
    """To the last bit, and what was left unsaid of the request stays so. (Planted: samples as `plan --json` has them;
    the request's defaults written; the seed left out.)"""
    found = Plan.load(file)
    assert found == planned() and hash(found.settings) == hash(planned().settings)
    assert found.request is not None and planned().request is not None
    assert found.request.model_fields_set <= {*planned().request.model_fields_set, "seconds"}  # type: ignore[union-attr]
    assert found.payload() == planned().payload()


Edit = Callable[[dict[str, Any]], object]
EDITS: dict[str, tuple[Edit, str]] = {
    "negative samples": (lambda plan: plan["settings"]["samples"].update(direct=-3.0), r"samples.direct: got -3"),
    "no number": (lambda plan: plan["settings"]["samples"].update(direct=math.nan), r"samples.direct: got nan"),
    "unknown effect": (lambda plan: plan["settings"]["effects"].append("wombat"), r"no effect 'wombat'"),
    "no anchor": (lambda plan: plan["settings"].update(anchors=0), r"settings.anchors: got 0"),
    "too many anchors": (lambda plan: plan["settings"].update(anchors=10**30), r"settings.anchors: got 1000"),
    "text": (lambda plan: plan["settings"].update(depth="400"), r"settings.depth: got '400'"),
    "misspelt": (lambda plan: plan["settings"].update(anchor=3), r"settings.anchor: got 3"),
    "left out": (lambda plan: plan["settings"].pop("depth"), r"settings.depth: is missing"),
    "another state": (lambda plan: plan["effects"][0].update(state="maybe"), r"effects.0.state: got 'maybe'"),
    "patterns": (lambda plan: plan["request"].update(patterns="dots:x"), r"plan.request: patterns 'dots:x'"),
    "a letter alone": (lambda plan: plan["effects"][0].update(reason="\ud800"), r"invalid JSON"),
    "a number": (lambda plan: plan["settings"].update(anchors=2), r"was changed since mitsim wrote it; plan anew"),
    "a version": (lambda plan: plan["made_of"]["version"].update(mitsim="0.1.0"), r"made by mitsim 0.1.0, and this is"),
    "no version": (lambda plan: plan.pop("made_of"), r"made by mitsim None, and this is"),
}


@pytest.mark.parametrize("name", EDITS)
def test_an_edited_file_is_refused_in_a_line(file: Path, name: str) -> None:
    """With the field where it breaks a rule, else by its checksum. (Planted: no checksum; no end of a count.)"""
    edit, sentence = EDITS[name]
    data = json.loads(file.read_text())
    edit(data["plan"])
    file.write_text(json.dumps(data))
    refused(file, sentence)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "not valid JSON"),
        ("[]", "is no file of a plan; give one that `mitsim plan -o` wrote"),
        ('{"kind": "capture"}', "is no file of a plan"),
        ('{"kind": "plan"}', "was made by mitsim None"),
        ('{"kind": "plan", "kind": "plan"}', "is there twice"),
        ("[" * 100_000, "nested too deep"),
    ],
)
def test_a_file_that_is_none_is_refused_in_a_line(file: Path, text: str, sentence: str) -> None:
    file.write_text(text)
    refused(file, sentence)


def refused(file: Path, sentence: str) -> None:
    with pytest.raises(MitsimError, match=sentence) as refusal:
        Plan.load(file)
    assert len(str(refusal.value).splitlines()) == 1 and file.name in str(refusal.value)


# ---- beside a request, and another bench


def test_what_is_said_again_is_taken_and_what_needs_another_plan_is_not() -> None:
    plan = planned()
    again = plan.request_with({"accuracy": 1e-3, "effects": {"blur": False}, "seed": 5, "exposure": 0.1})
    assert (again.seed, again.exposure, again.patterns, again.accuracy) == (5, 0.1, "dots:3", 1e-3)
    for other, sentence in (
        ({"accuracy": 1e-2}, "accuracy 0.01: the plan was made for 0.001; plan anew"),
        ({"effects": {}}, "effects none: the plan was made for -blur; plan anew"),
        ({"effects": {"blur": True}}, r"effects \+blur: the plan was made for -blur"),
    ):
        with pytest.raises(ArgumentError, match=sentence):
            plan.request_with(other)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"version": {**deciding_versions(), "drjit": "0.1"}}, r"another version: drjit \S+ then, 0.1 now"),
        ({"colour": {"filters": False, "wavelengths_nm": [440.0]}}, "another colour: none then, {"),
        ({"variant": "llvm_ad_rgb"}, "another variant: llvm_ad_mono then, llvm_ad_rgb now"),
        ({"scene": {**MADE_OF["scene"], "its XML": "c" * 64}}, "another scene: the content of its XML differs"),  # type: ignore[dict-item]
        ({"scene": {"its XML": "a" * 64}}, "another scene: the content of print.png differs"),
        ({"camera": {"mask_distance": 1.5}}, "another camera: mask_distance 2.0 then, 1.5 now"),
    ],
)
def test_a_plan_of_another_bench_is_refused_by_what_differs(changes: dict[str, Any], sentence: str) -> None:
    plan = planned()
    plan.check_made_of(MADE_OF)
    with pytest.raises(ArgumentError, match=f"^plan was made for {sentence}"):
        plan.check_made_of({**MADE_OF, **changes})
    with pytest.raises(ArgumentError, match="decided without a bench"):
        replace(plan, made_of=None).check_made_of(MADE_OF)
