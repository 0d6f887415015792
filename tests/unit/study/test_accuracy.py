"""The accuracy study on a small scene: knobs turn one thing, errors behave as theory has it, the judge says its own."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.capture import pilot
from mitsim.capture.bench import Bench, open_bench
from mitsim.capture.evidence import GROUPS
from mitsim.capture.light import collect, make_plan
from mitsim.core.arrays import silent
from mitsim.study import accuracy, plots
from mitsim.study.accuracy import AccuracyStudy, study_accuracy
from mitsim.study.knobs import at_once, sampled, variants, without
from mitsim.study.solver_cost import make_problem, solver_costs

pytestmark = pytest.mark.usefixtures("variant")
PATTERNS, SEED = "dots:2", 5


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str) -> Bench:
    print_ = np.random.default_rng(4).integers(40, 256, (16, 16))
    return open_bench(shared_scene("accuracy", n=16, reflectance=print_), variant)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("study")


@pytest.fixture(scope="module")
def study(bench: Bench, folder: Path) -> AccuracyStudy:
    """The whole study; the solver's part on a small problem."""
    problem = make_problem(np.random.default_rng(1).random((12, 8)), 2, SEED)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(accuracy, "solver_costs", lambda seed, progress: solver_costs(seed, progress, problem, 1))
        return study_accuracy(bench, folder, PATTERNS, SEED, silent)


def test_every_knob_has_rows(study: AccuracyStudy) -> None:
    knobs = {row.knob for row in study.rows}
    assert {"accuracy", "samples", "cells", "anchors", "bounces", "wavelengths", "spp"} <= knobs
    for row in study.rows:
        assert row.seconds > 0 and np.isfinite(row.error) and 0 < row.mc_error < 10
    assert len({(row.knob, row.setting) for row in study.rows}) == len(study.rows)


def test_whole_plans_keep_their_accuracy(study: AccuracyStudy) -> None:
    """Against an independent answer, with room for that answer's own error."""
    own = np.hypot(study.judge.mc_error, study.judge.systematic_error)
    for row in study.rows:
        if row.knob == "accuracy":
            asked = float(row.setting.split()[1])
            assert row.error <= 1.25 * np.hypot(asked, own), row


def test_more_samples_leave_less(study: AccuracyStudy) -> None:
    errors = [row.mc_error for row in study.rows if row.knob == "samples"]
    assert len(errors) == 3
    # Independent samples gain 8^0.5 = 2.8 a step; stratified ones up to 8.
    assert errors[0] > 2 * errors[1] > 4 * errors[2]


def test_the_reference_is_unbiased_against_its_own_judge(study: AccuracyStudy) -> None:
    for row in study.rows:
        if row.estimator == "reference":
            assert 0.8 < row.error / row.mc_error < 1.25, row


def test_leaving_out_diffraction_shows_in_rows_of_effects(study: AccuracyStudy) -> None:
    found = {effect.name: effect.error_if_off for effect in study.effects}
    assert {"diffraction", "interreflection", "black-level"} <= found.keys()
    assert max(found, key=lambda name: found[name]) == "diffraction" and found["diffraction"] > 0.02
    assert found["interreflection"] == pytest.approx(0, abs=1e-9), "one flat sheet lights nothing but the camera"


def test_the_front_is_marked(study: AccuracyStudy) -> None:
    marked = sorted((row.seconds, row.error) for row in study.rows if row.on_front)
    assert marked == plots.pareto_front([(row.seconds, row.error) for row in study.rows]) and marked


def test_speedup_is_that_of_equal_error(study: AccuracyStudy) -> None:
    quoted = next(row for row in study.rows if row.setting == "accuracy 0.001")
    slow = study.rows[-1]
    expected = slow.seconds * (slow.error / quoted.error) ** 2 / quoted.seconds
    assert study.speedup_at_equal_error == pytest.approx(expected) and expected > 1


def test_what_is_written(study: AccuracyStudy, folder: Path) -> None:
    assert {path.name for path in folder.iterdir()} == {"accuracy.json", "accuracy.png", "effects.png", "solver.png"}
    kept = json.loads((folder / "accuracy.json").read_text())
    assert len(kept["rows"]) == len(study.rows) and kept["judge"]["seed"] == SEED + 1
    assert kept["sensor_noise"] == pytest.approx(study.sensor_noise) and 1e-4 < kept["sensor_noise"] < 1
    text = "\n".join(study.lines())
    assert "diffraction buys" in text and "judge's own error" in text


def test_knobs_turn_one_thing_at_a_time(bench: Bench) -> None:
    labels, weights = bench.family(PATTERNS).lighting
    plan = make_plan(bench, labels, weights, 1e-3, SEED)
    evidence = pilot.measure(bench, labels, weights, 1e-3, SEED)
    samples = {"direct_samples", "anchored_samples", "indirect_samples", "from_camera_samples"}
    turned = {
        "samples": samples,
        "cells": {"subdivision"},
        "anchors": {"anchors"},
        "bounces": {"effects"},
        "layers": {"layers"},
    }
    for variant in variants(bench, plan, evidence, 100.0):
        now, then = plan.settings, variant.plan.settings
        differ = {name for name in now.__dataclass_fields__ if getattr(now, name) != getattr(then, name)}
        assert differ <= turned.get(variant.knob, set())
        assert (variant.bench is bench) == (variant.knob != "wavelengths")
        assert variant.bench.spectrum.weights.sum() == pytest.approx(1)


def test_sampled_fixes_the_number_of_samples(bench: Bench) -> None:
    labels, weights = bench.family(PATTERNS).lighting
    plan = make_plan(bench, labels, weights, 1e-3, SEED)
    plan = replace(plan, settings=replace(plan.settings, anchors=1, effects=frozenset()))
    for samples in (1, 8):
        fixed = replace(plan, settings=sampled(plan.settings, samples))
        assert collect(bench, fixed, labels, weights, 0, target=at_once).paths == GROUPS * samples * bench.n**2


def test_without_names_each_effect_once(bench: Bench) -> None:
    plan = make_plan(bench, bench.family(PATTERNS).lighting, 1e-4, SEED)
    names = frozenset({"diffraction", "interreflection"})
    found = dict(without(plan.settings, names))
    assert names <= found.keys()
    assert "anchors" in found and found["anchors"].anchors == 1 and plan.settings.anchors > 1
    for name in names:
        assert found[name].effects == plan.settings.effects - {name}
