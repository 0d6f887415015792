"""The accuracy study on a small scene: knobs turn one thing, errors behave as theory has it, the judge says its own."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.capture import pilot
from mitsim.capture.bench import Bench, open_bench
from mitsim.capture.evidence import GROUPS
from mitsim.capture.light import Sampling, trace_light
from mitsim.capture.planning import make_plan
from mitsim.capture.request import Request
from mitsim.core.job import Job
from mitsim.study import accuracy, find_study, plots
from mitsim.study.accuracy import AccuracyFindings
from mitsim.study.knobs import Stand, at_once, reformed, sampled, trials, without
from mitsim.study.runner import StudyResult
from mitsim.study.solver_cost import make_problem, time_solver

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
def result(bench: Bench, folder: Path) -> StudyResult:
    """The whole study at three accuracies of five; the solver's part on a small problem."""
    problem = make_problem(np.random.default_rng(1).random((12, 8)), 2, SEED)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(accuracy, "ACCURACIES", (3e-2, 1e-2, accuracy.QUOTED))
        patch.setattr(accuracy, "time_solver", lambda seed, progress: time_solver(seed, progress, problem, 1))
        return find_study("accuracy")(bench, folder, Request.of(patterns=PATTERNS, seed=SEED), None)


@pytest.fixture(scope="module")
def study(result: StudyResult) -> AccuracyFindings:
    assert isinstance(result.findings, AccuracyFindings)
    return result.findings


def test_every_knob_has_rows(study: AccuracyFindings) -> None:
    knobs = {row.knob for row in study.rows}
    assert {"accuracy", "samples", "cells", "anchors", "bounces", "wavelengths", "spp"} <= knobs
    for row in study.rows:
        assert row.seconds > 0 and np.isfinite(row.error) and 0 < row.mc_error < 10
    assert len({(row.knob, row.setting) for row in study.rows}) == len(study.rows)


def test_whole_plans_keep_their_accuracy(study: AccuracyFindings) -> None:
    """Against an independent answer, with room for that answer's own error."""
    own = np.hypot(study.judge.mc_error, study.judge.systematic_error)
    for row in study.rows:
        if row.knob == "accuracy":
            asked = float(row.setting.split()[1])
            assert row.error <= 1.25 * np.hypot(asked, own), row


def test_more_samples_leave_less(study: AccuracyFindings) -> None:
    errors = [row.mc_error for row in study.rows if row.knob == "samples"]
    assert len(errors) == 3
    # Independent samples gain 8^0.5 = 2.8 a step; stratified ones up to 8.
    assert errors[0] > 2 * errors[1] > 4 * errors[2]


def test_the_reference_is_unbiased_against_its_own_judge(study: AccuracyFindings) -> None:
    for row in study.rows:
        if row.estimator == "reference":
            assert 0.8 < row.error / row.mc_error < 1.25, row


def test_leaving_out_diffraction_shows_in_rows_of_effects(study: AccuracyFindings) -> None:
    found = {effect.name: effect.error_if_off for effect in study.effects}
    assert {"diffraction", "interreflection", "black-level"} <= found.keys()
    assert max(found, key=lambda name: found[name]) == "diffraction" and found["diffraction"] > 0.02
    assert found["interreflection"] == pytest.approx(0, abs=1e-9), "one flat sheet lights nothing but the camera"


def test_the_front_is_marked(study: AccuracyFindings) -> None:
    marked = sorted((row.seconds, row.error) for row in study.rows if row.on_front)
    assert marked == plots.pareto_front([(row.seconds, row.error) for row in study.rows]) and marked


def test_speedup_is_that_of_equal_error(study: AccuracyFindings) -> None:
    quoted = next(row for row in study.rows if row.setting == "accuracy 0.001")
    slow = study.rows[-1]
    expected = slow.seconds * (slow.error / quoted.error) ** 2 / quoted.seconds
    assert study.speedup_at_equal_error == pytest.approx(expected) and expected > 1


def test_what_is_written(result: StudyResult, study: AccuracyFindings, folder: Path) -> None:
    assert {path.name for path in folder.iterdir()} == {"accuracy.json", "accuracy.png", "effects.png", "solver.png"}
    assert result.payload()["output"] == str(folder) and result.payload()["patterns"] == PATTERNS
    kept = json.loads((folder / "accuracy.json").read_text())
    assert len(kept["rows"]) == len(study.rows) and kept["judge"]["seed"] == SEED + 1
    assert kept["sensor_noise"] == pytest.approx(study.sensor_noise) and 1e-4 < kept["sensor_noise"] < 1
    text = "\n".join(result.lines())
    assert "diffraction buys" in text and "judge's own error" in text and str(folder) in text


def test_knobs_turn_one_thing_at_a_time(bench: Bench) -> None:
    lighting = bench.family(PATTERNS).lighting
    plan = make_plan(bench, lighting, 1e-3, SEED)
    evidence = pilot.measure(bench, lighting, 1e-3, SEED)
    kinds = ("direct", "anchored", "indirect", "from_camera", "followed", "occluded")
    samples = {f"{name}_samples" for name in kinds}
    turned = {
        "samples": samples,
        "cells": {"subdivision"},
        "anchors": {"anchors"},
        "bounces": {"effects"},
        "layers": {"layers"},
    }
    tried = list(trials(bench, plan, evidence, 100.0))
    assert {trial.knob for trial in tried} >= {"samples", "cells", "anchors", "bounces", "wavelengths"}
    for trial in tried:
        now, then = plan.settings, trial.plan.settings
        differ = {name for name in now.__dataclass_fields__ if getattr(now, name) != getattr(then, name)}
        assert differ <= turned.get(trial.knob, set())
        assert (trial.bench is bench) == (trial.knob != "wavelengths")
        assert trial.bench.spectrum.weights.sum() == pytest.approx(1)
    fewer = list(trials(bench, plan, evidence, 0.0))
    assert len(fewer) < len(tried), "what takes longer than the patience and than the plan itself is left out"


def test_sampled_fixes_the_number_of_samples(bench: Bench) -> None:
    lighting = bench.family(PATTERNS).lighting
    plan = make_plan(bench, lighting, 1e-3, SEED)
    plan = replace(plan, settings=replace(plan.settings, anchors=1, effects=frozenset()))
    for samples in (1, 8):
        fixed = replace(plan, settings=sampled(plan.settings, samples))
        light = trace_light(bench, fixed, lighting, 0, Sampling(target=at_once))
        assert light.paths == GROUPS * samples * bench.n**2


def test_without_names_each_effect_once(bench: Bench) -> None:
    plan = make_plan(bench, bench.family(PATTERNS).lighting, 1e-4, SEED)
    present = frozenset({"diffraction", "interreflection", "speckle"})
    settings = replace(plan.settings, anchors=2)
    switched = dict(without(settings, present))
    assert present - switched.keys() == {"speckle"}, "it is not part of expected frames"
    assert "anchors" in switched and switched["anchors"] == replace(settings, anchors=1)
    for name in present & switched.keys():
        assert switched[name].effects == settings.effects - {name}


THICK = '<float name="mask_thickness" value="0.3"/>'


@pytest.mark.parametrize("lacking", ["thick mask", "lens and blur"])
def test_the_judge_of_the_reference_has_what_the_registry_says(
    shared_scene: Callable[..., Path], variant: str, tmp_path: Path, lacking: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thick mask is in the reference, the projector's lens and blur are not, nor can traced light be rid of them.

    The error of the reference against the right judge is its own noise alone. Against a thin mask's shadow it is 2.5
    times that at 2048 samples, against light that came through the lens 1.27 times at 64 (both bugs planted).
    """
    print_ = np.random.default_rng(4).integers(40, 256, (16, 16))
    scene = shared_scene(f"judge_{lacking[:4].strip()}", n=16, reflectance=print_)
    projector = None
    if lacking == "thick mask":
        scene.write_text(scene.read_text().replace('<film type="hdrfilm">', THICK + '<film type="hdrfilm">'))
    else:
        projector = tmp_path / "soft.toml"
        projector.write_text(
            'name = "soft"\neffective_wavelength_nm = 562.0\naperture_radius_mm = 8.0\nblur_pixels = 1.5\n'
            "focus_mm = 200.0\n"
        )
    bench = open_bench(scene, variant, projector=projector)
    stand = Stand(bench, bench.family("hadamard:2"), SEED, Job(), 1e-2)
    judge = accuracy._Judge.trace(stand, stand.plan(1e-2))
    monkeypatch.setattr(accuracy, "_SAMPLES", (64, 2048))
    for row in judge.reference():
        assert 0.8 < row.error / row.mc_error < 1.25, row


def test_reformed_light_is_that_of_a_plan_without_the_effect(bench: Bench) -> None:
    lighting = bench.family(PATTERNS).lighting
    # Sampling in one round, so that both have the same paths.
    plan = replace(make_plan(bench, lighting, 1e-2, SEED, {"diffraction": True}), sampling_target=math.inf)
    light = trace_light(bench, plan, lighting, SEED)
    plain = replace(plan, settings=replace(plan.settings, effects=plan.settings.effects - {"diffraction"}))
    for ours, theirs in zip(
        reformed(light, frozenset({"diffraction"})).frames(lighting, SEED),
        trace_light(bench, plain, lighting, SEED).frames(lighting, SEED),
        strict=True,
    ):
        assert np.array_equal(ours.irradiance, theirs.irradiance)
