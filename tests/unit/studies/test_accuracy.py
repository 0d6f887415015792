"""The accuracy study on a small scene: runs keep their accuracy, and the reference is judged by what it simulates."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.bench.effects import present
from mitsim.studies import accuracy_study as accuracy
from mitsim.studies.accuracy_study import Judge
from mitsim.studies.framework.experiment import Results, Scope, Setup
from mitsim.studies.framework.studio import Studio

pytestmark = pytest.mark.usefixtures("variant", "kept_plans", "draft_figures")
PATTERNS, SEED = "dots:2", 5
QUOTED = 3e-3
"""Replaces the default accuracy, so that whole runs take a ninth of the samples."""


@pytest.fixture(scope="module")
def scene(shared_scene: Callable[..., Path]) -> Path:
    print_ = np.random.default_rng(4).integers(40, 256, (16, 16))
    return shared_scene("accuracy", n=16, reflectance=print_)


@pytest.fixture(scope="module")
def bench(scene: Path, variant: str) -> Bench:
    return open_bench(scene, variant)


@pytest.fixture(scope="module")
def results(scene: Path, variant: str) -> Iterator[Results]:
    """All points at two accuracies, one of them predicted to be too long, with few samples and short repeats."""
    scope = Scope(Setup(str(scene), variant=variant), (None,), (SEED,), patterns=PATTERNS)
    with pytest.MonkeyPatch.context() as patch, Studio() as studio:
        patch.setattr(accuracy, "ACCURACIES", (3e-2, QUOTED, 1e-6))
        patch.setattr(accuracy, "QUOTED", QUOTED)
        patch.setattr(accuracy, "JUDGE_S", 2.5)
        patch.setattr(accuracy, "_REPEATS", 2)
        patch.setattr(accuracy, "_REPEATED_S", math.inf)
        found = [accuracy.STUDY.measure(studio, point) for point in accuracy.STUDY.points(scope)]
        yield Results([row for each in found for row in each.rows], scope=scope)


def rows_of(results: Results, estimator: str) -> list[dict[str, Any]]:
    return [dict(row) for row in results.rows if row["estimator"] == estimator]


def test_whole_runs_keep_their_accuracy_and_state_their_stages(results: Results) -> None:
    """(Planted: the plan left out of the stages.)"""
    *runs, long = rows_of(results, "factored")
    for row in runs:
        assert 0.3 * row["mc_error"] < row["error"] <= 1.25 * np.hypot(row["accuracy"], row["judge_error"]), row
        assert row["least_s"] <= row["seconds"] <= row["most_s"] and row["repeats"] == 2 and not row["extrapolated"]
        stages = ("open_scene", "plan", "transport", "truth", "optics", "sensor", "write")
        assert all(row[f"{stage}_s"] > 0 for stage in stages)
        assert sum(row[f"{stage}_s"] for stage in stages) <= 1.01 * row["most_s"]
    assert long["extrapolated"] and "not measured, predicted to take" in long["by"] and "error" not in long


def test_the_reference_is_unbiased_and_says_what_is_extrapolated(results: Results) -> None:
    measured = rows_of(results, "reference")
    assert [row["setting"] for row in measured] == ["16 spp", "64 spp"]
    for row in measured:
        assert 0.8 < row["error"] / row["mc_error"] < 1.25 and "one of 4 frames was measured" in row["by"]


def test_claims_and_figures_are_of_what_was_measured(results: Results, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(accuracy, "QUOTED", QUOTED)
    claims = accuracy.STUDY.judge(results)
    assert [each.verdict for each in claims] == ["confirmed"] * 3
    quoted = next(row for row in rows_of(results, "factored") if row["accuracy"] == QUOTED)
    slow = rows_of(results, "reference")[-1]
    times = slow["seconds"] * (slow["error"] / quoted["error"]) ** 2 / (quoted["transport_s"] + quoted["optics_s"])
    assert f"{times:.1e} times" in claims[2].rendered
    assert accuracy.STUDY.draw(results).keys() == {"accuracy.png", "stages.png"}


def test_the_judges_own_noise_is_subtracted(bench: Bench) -> None:
    """Frames of the judge's mean light and of independent noise leave that noise."""
    answer = Judge.trace(bench, bench.family("uniform"), SEED, 0.1)
    size = np.linalg.norm(answer.frames) / answer.frames.size**0.5
    rng, noise = np.random.default_rng(0), answer.mc_error
    for own in (3 * noise, 0.01 * noise):
        apart = answer.frames + rng.normal(0, np.hypot(own, noise) * size, answer.frames.shape)
        assert answer.error(apart) == pytest.approx(max(own, noise / 2), rel=0.05)


def test_a_judge_has_every_effect_and_is_at_least_as_accurate_as_the_quoted_run(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """(Planted: effects left to the plan; the loosest plan where no time is enough.)"""
    monkeypatch.setattr(accuracy, "QUOTED", 3e-2)
    in_haste = Judge.trace(bench, bench.family("uniform"), SEED, 0.1)
    at_leisure = Judge.trace(bench, bench.family("uniform"), SEED, 5.0)
    for answer in (in_haste, at_leisure):
        assert answer.light.plan.settings.effects >= frozenset(present(bench)) and answer.light.seed == SEED + 1
    assert in_haste.light.plan.accuracy == 3e-2 and at_leisure.light.plan.accuracy < 3e-3
    assert at_leisure.mc_error < in_haste.mc_error / 3


def test_the_judge_of_the_reference_has_what_the_registry_says(
    shared_scene: Callable[..., Path], variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The projector's lens and blur are not in the reference, nor can traced light be rid of them.

    The error of the reference against the right judge is its own noise alone. Against light that came through the lens
    it is 1.27 times that at 64 samples (planted).
    """
    print_ = np.random.default_rng(4).integers(40, 256, (16, 16))
    scene, projector = shared_scene("judge", n=16, reflectance=print_), tmp_path / "soft.toml"
    projector.write_text(
        'name = "soft"\neffective_wavelength_nm = 562.0\naperture_radius_mm = 8.0\nblur_pixels = 1.5\n'
        "focus_mm = 200.0\n"
    )
    bench = open_bench(scene, variant, projector=projector)
    monkeypatch.setattr(accuracy, "QUOTED", 1e-2)
    answer = Judge.trace(bench, bench.family("hadamard:2"), SEED, 1.0)
    monkeypatch.setattr(accuracy, "SAMPLES", (64, 256))
    monkeypatch.setattr(accuracy, "LONGEST_S", math.inf)
    rows: list[dict[str, Any]] = list(accuracy.measure_reference(answer))
    assert len(rows) == 2 and all(0.8 < row["error"] / row["mc_error"] < 1.25 for row in rows)
