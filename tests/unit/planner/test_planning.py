"""Plans within a time: what is looked at, how finely, and what of the time is left for light, of invented unit costs;
those of invented launches, and samples for rare heavy paths."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mitsim.devices.patterns import Lighting
from mitsim.light.cost_model import FIXED, ROUNDS
from mitsim.light.plan import Plan
from mitsim.light.settings import GROUPS, MOST_PATHS, REPLICATES, Approximation, Noise, SampleCost
from mitsim.optics.forming import bound_of
from mitsim.planner import pilot, planner
from mitsim.planner.choose import _BOUND_OVER_ERROR, FIRST_ACCURACY, Candidate, _samples_for
from tests.unit.planner.invented_pilot_result import ONE_CLASS, cheapest, plan

LIGHTING, SEED, LOOKING, FRAMES = Lighting.uniform(4), 7, 0.5, {"sensor": 0.2, "write": 0.1}
AROUND = planner.OPENING_S + sum(FRAMES.values()) + LOOKING
"""Seconds of all but light, frames and truth, after one look; a finer one is taken for twice as long."""
PRICE, KEPT = 1e-3, 1.5e-5
"""Light of accuracy e takes PRICE / e seconds, and half of it without diffraction; it keeps no finer one than KEPT."""
OWN = "the plan's own"


@dataclass
class Invented:
    """Stands in for the choices of a look."""

    pilot_result: CountedRuns
    switches: Mapping[str, bool]

    def seconds(self, accuracy: float) -> tuple[float, bool]:
        price = PRICE * (self.pilot_result.dearer if len(self.pilot_result.asked) > 1 else 1.0) / accuracy
        kept = self.pilot_result.kept if len(self.pilot_result.asked) > 1 else KEPT
        return price * (1.0 if self.switches.get("diffraction", True) else 0.5), accuracy >= kept


@dataclass
class CountedRuns:
    """Accuracies and seeds of looks, and what was decided at last; a finer one may find all dearer, or less kept."""

    asked: list[tuple[float, int]] = field(default_factory=list)
    decided: tuple[object, float, Mapping[str, bool]] | None = None
    dearer: float = 1.0
    kept: float = KEPT


@pytest.fixture(scope="module")
def made() -> Plan:
    return plan()


@pytest.fixture
def runs(made: Plan, monkeypatch: pytest.MonkeyPatch) -> CountedRuns:
    seen = CountedRuns()

    class PilotRuns:
        seconds = LOOKING

        def __init__(self, bench: object, lighting: Lighting, accuracy: float, seed: int) -> None:
            assert lighting is LIGHTING
            seen.asked.append((accuracy, seed))
            self.pilot_result = seen

    def decided(look: PilotRuns, accuracy: float, candidates: Invented) -> Plan:
        seen.decided = look.pilot_result, accuracy, candidates.switches
        return replace(made, accuracy=accuracy, warnings=(OWN,))

    monkeypatch.setattr(pilot, "PilotRuns", PilotRuns)
    monkeypatch.setattr(planner.choose, "Candidates", Invented)
    monkeypatch.setattr(planner, "_refuse_unfit", lambda bench, switches: None)
    monkeypatch.setattr(planner, "_decide", decided)
    monkeypatch.setattr(planner.cost_model, "frame_seconds", lambda bench, shots: FRAMES)
    return seen


def within(light: float, switches: Mapping[str, bool] | None = None) -> Plan:
    """Of ``light`` seconds beyond one look and all that is around it."""
    bench: Any = None
    return planner.plan_within(bench, LIGHTING, AROUND + light, SEED, switches)


@pytest.mark.parametrize(
    ("light", "bought", "finer_look"),
    [
        (0.2, 5.01e-3, None),
        (1.01, 1e-3, None),
        (2.2, 1e-3, None),  # after another look 1.2 s are left, and the next finer accuracy takes 1.26
        (2.3, 7.94e-4, 7.94e-4),
        (11.01, 1e-4, 1e-4),
        (math.inf, 1.58e-5, 1e-5),
    ],
)
def test_what_pilot_runs_leave_is_for_the_light(
    runs: CountedRuns, light: float, bought: float, finer_look: float | None
) -> None:
    """Opening, frames and looking come off; a finer look is taken where what it leaves buys a finer accuracy."""
    found = within(light)
    finer = [(finer_look, SEED)] if finer_look else []
    assert runs.asked == [(FIRST_ACCURACY, SEED), *finer]
    assert runs.decided == (runs, bought, {}) and found.accuracy == bought
    assert found.asked_seconds == AROUND + light and found.warnings == (OWN,)


def test_what_is_switched_off_is_not_paid_for(runs: CountedRuns) -> None:
    """In both looks: 0.2 s buy what 0.4 do else, and so do 1.3 after another look."""
    off = {"diffraction": False}
    assert within(0.2, off).accuracy == 2.51e-3
    assert within(2.3, off).accuracy == 3.98e-4 and runs.asked[-1] == (3.98e-4, SEED)
    assert runs.decided == (runs, 3.98e-4, off)


def test_too_few_seconds_are_told_with_what_all_would_take(runs: CountedRuns) -> None:
    found = within(-AROUND + 0.01)
    line, own = found.warnings
    assert found.accuracy == 0.3 and found.asked_seconds == pytest.approx(0.01) and own == OWN
    assert line.startswith("0.01 seconds are too few: even accuracy 0.3")
    assert f"to take {PRICE / 0.3 + AROUND:.1f} s from start to finish" in line
    assert runs.asked == [(FIRST_ACCURACY, SEED)], "no time for another look"


@pytest.mark.parametrize(("dearer", "bought"), [(1.3, 1.58e-4), (1e5, 1e-3)])
def test_a_finer_look_that_finds_all_dearer_buys_less_or_nothing(
    runs: CountedRuns, dearer: float, bought: float
) -> None:
    runs.dearer = dearer
    found = within(11.01)
    assert len(runs.asked) == 2 and found.accuracy == bought and found.warnings == (OWN,)


def test_a_finer_look_that_finds_no_accuracy_kept_takes_none_away(runs: CountedRuns) -> None:
    """What the first look bought stands. (Planted: the loosest of all, 0.3, which the finer look can pay.)"""
    runs.kept = 1.0
    found = within(11.01)
    assert len(runs.asked) == 2 and found.accuracy == 1e-3 and found.warnings == (OWN,)


class Refined:
    """Looks of which each closer one costs the same, and of which none tells more."""

    pilot_result = ONE_CLASS

    def __init__(self, work: float) -> None:
        self.cost, self.refined = work, list[str]()

    def work(self, run: str) -> float:
        return self.cost

    def refine(self, run: str) -> None:
        assert len(self.refined) < 9, "no end"
        self.refined.append(run)


@pytest.mark.parametrize(("part", "closer"), [(0.21, 0), (0.19, 1), (0.06, 3), (0.04, 5)])
def test_closer_looks_take_a_fifth_of_the_run_at_most(
    monkeypatch: pytest.MonkeyPatch, part: float, closer: int
) -> None:
    """However much they promise; and the plan says so. (Planted: each of them for itself.)"""
    whole = cheapest(3e-3, ONE_CLASS, {}).work
    looked: Any = Refined(part * whole)
    doubt = Approximation("followed_anchors", 2)
    monkeypatch.setattr(planner.choose, "value_of_refining", lambda *_: (math.inf, doubt))
    _, (note,) = planner._refine(looked, 3e-3, {})
    assert looked.refined == ["followed"] * closer
    assert "followed anchors and all that hangs on them are chosen safely" in note and f"the {whole:.1f} s" in note
    monkeypatch.setattr(planner.choose, "value_of_refining", lambda *_: (0.0, doubt))
    assert not planner._refine(looked, 3e-3, {})[1], "worth nothing"


LAUNCH_S, PATH_S = 0.02, 1e-7
"""What an invented machine takes for each launch, and for each path of it."""


@dataclass
class Machine:
    """Stands in for a pass's launches; one of them, by its number, takes ten times as long as it should."""

    disturbed: int = -1
    launches: list[int] = field(default_factory=list)

    def seconds(self, simulation: Any, name: str, seed: int, labels: object, samples: int) -> float:
        self.launches.append(samples)
        taken = LAUNCH_S + PATH_S * samples * simulation.passes[name].tracer.paths_per_sample
        return 10 * taken if len(self.launches) - 1 == self.disturbed else taken


@pytest.mark.parametrize("paths_per_sample", [4000, 25_280, 300_000])
@pytest.mark.parametrize("planned", [3, 100, 5000])
@pytest.mark.parametrize("disturbed", [-1, 0, 1, 2, 3, 4, 5, 6])
def test_unit_costs_are_those_of_launches_as_the_run_has_them(
    monkeypatch: pytest.MonkeyPatch, paths_per_sample: int, planned: int, disturbed: int
) -> None:
    """Within 1.5 times of what all launches of the run take together, in one round and a half, one slow moment or none,
    where that is more than a second. (Planted: one round; the pace of the first launch alone, 4
    times too slow; the slower of two launches.)"""
    at_once, machine = 2**21, Machine(disturbed)
    monkeypatch.setattr(planner, "_seconds", machine.seconds)
    each = SimpleNamespace(tracer=SimpleNamespace(paths_per_sample=paths_per_sample), whole=planned)
    simulation: Any = SimpleNamespace(passes={"direct": each}, paths_at_once=at_once)
    pace, longest = planner._pace(simulation, "direct", None, SEED)  # type: ignore[arg-type]
    launches = math.ceil(planned / (at_once // paths_per_sample))
    taken = GROUPS * (ROUNDS * launches * LAUNCH_S + planned * paths_per_sample * PATH_S)
    if disturbed < 0 or taken > 1.0:
        assert GROUPS * planned * pace == pytest.approx(taken, rel=0.15 if disturbed < 0 and planned > 3 else 0.5)
        assert longest == pytest.approx(PATH_S * paths_per_sample, rel=0.5) or planned * paths_per_sample < 1e6
    assert sum(machine.launches[1:]) <= max(2 + 2**16 / paths_per_sample, 0.3 * GROUPS * planned)


class Heavy:
    """A look at pilot result whose light from the camera turns out to have noise of such a variance in a sample."""

    def __init__(self, variance: float, spread: float = 0.0, paths: float = 50.0) -> None:
        residual = replace(ONE_CLASS.sample_costs["indirect_residual"], seconds=0.0)
        self.pilot_result = ONE_CLASS.with_sample_costs({"camera_residual": residual})
        self.variance, self.spread, self.paths, self.looked = variance, spread, paths, list[int]()

    def heavy(self, samples: int) -> dict[str, SampleCost]:
        self.looked.append(samples)
        noise = Noise(math.sqrt(self.variance / samples), samples, 0.5, self.spread, self.paths)
        return {"from_camera": SampleCost(noise, self.pilot_result.sample_costs["from_camera"].paths)}


def planned_with(look: Any, accuracy: float = 3e-3) -> tuple[Candidate, Candidate]:
    """The choice by the look's pilot result, and that with heavy paths."""
    chosen = cheapest(accuracy, look.pilot_result, {})
    assert "interreflection" in chosen.settings.effects
    return chosen, planner._with_heavy_paths(look, accuracy, chosen, {})[1]


def test_rare_heavy_paths_are_sampled_from_the_first() -> None:
    """The run begins with the samples that looks at more paths ask for. (Planted: the settings stay as they were, and
    a run that meets none of these paths ends without them.)"""
    plain = ONE_CLASS.sample_costs["from_camera"].variance
    same, unchanged = planned_with(Heavy(1.01 * plain))
    assert unchanged is same
    look = Heavy(400 * plain)
    before, after = planned_with(look)
    target = after.target
    left = math.sqrt(look.variance / after.settings.samples["from_camera"] / GROUPS)
    assert after.settings.samples["from_camera"] > 20 * before.settings.samples["from_camera"] and left < target
    assert (
        look.looked == sorted(look.looked)
        and look.looked[-1] * REPLICATES * look.pilot_result.sample_costs["from_camera"].paths <= 2**23
    )
    _, more = planned_with(Heavy(400 * plain, spread=4.0))
    assert more.settings.samples["from_camera"] > 1.02 * after.settings.samples["from_camera"]
    _, most = planned_with(Heavy(1e9 * plain))
    assert most.settings.samples["from_camera"] * GROUPS * ONE_CLASS.sample_costs["from_camera"].paths == pytest.approx(
        MOST_PATHS
    )


def test_pilot_runs_go_on_while_few_heavy_paths_are_met() -> None:
    """To the most, whatever they say that the run takes: 5 equal paths tell little of that; 50 end them at a tenth of
    it. (Planted: looks end at a tenth whatever they met.)"""
    plain = ONE_CLASS.sample_costs["from_camera"].variance
    many, few = Heavy(3 * plain, paths=50.0), Heavy(3 * plain, paths=5.0)
    planned_with(many)
    planned_with(few)
    assert many.looked == few.looked[: len(many.looked)] and len(few.looked) > len(many.looked)
    assert few.looked[-1] * REPLICATES * ONE_CLASS.sample_costs["from_camera"].paths == pytest.approx(2**23, rel=0.01)


def test_a_run_of_heavy_paths_has_a_range_of_seconds() -> None:
    """None where many paths make the noise; of some, five times their work at most and 0.7 at least, as the rest takes
    what it takes; of fewer than four, what sampling stops at. (Planted: the rest grows too; a stage that is added is
    in none of the ends.)"""
    pilot_result, settings = ONE_CLASS, plan(3e-3, ONE_CLASS).settings
    settings = replace(settings, samples={**settings.samples, "from_camera": 100.0})
    planned = replace(plan(3e-3, ONE_CLASS), settings=settings)
    assert planner._range(pilot_result, planned) is None and planned.range_words == ""
    pace, total = (
        pilot_result.sample_costs["from_camera"].seconds or FIXED.passes["from_camera"],
        planned.predicted_seconds,
    )
    work = GROUPS * 100 * pilot_result.sample_costs["from_camera"].paths * pace

    def ends(paths: float) -> tuple[float, float] | None:
        light = pilot_result.sample_costs["from_camera"]
        return planner._range(
            pilot_result.with_sample_costs({"from_camera": replace(light, noise=replace(light.noise, heavy=paths))}),
            planned,
        )

    assert ends(20.0) == pytest.approx((total - 0.3 * work, total + 4 * work))
    assert ends(3.0) == pytest.approx((total - 0.3 * work, total - work + MOST_PATHS * pace))
    later = replace(planned, predicted_range=(10.0, 60.0)).taking(plan=4.0)
    assert later.predicted_range == (14.0, 64.0) and "take 14 to 64 s" in later.range_words
    assert later.payload()["predicted_range"] == (14.0, 64.0) and planned.payload()["predicted_range"] is None


def test_bounds_of_few_heavy_paths_take_more_samples() -> None:
    """Sampling stops where a bound meets the target: of groups that some equal heavy paths meet by chance, in pixels
    of their own, half of the bounds do with so many samples. (Planted: samples for the error alone, 9 % of the
    bounds.)"""
    rate, per_look = 2.0, 50  # heavy paths in a look of so many samples
    # Each brings an energy of 1 in its own pixels: variance of a sample, and of a look's energy over its square.
    noise, target = Noise(math.sqrt(rate) / per_look, per_look, 0.5, 1 / rate), 1e-2
    samples = float(_samples_for(SampleCost(noise, 1), target * math.sqrt(GROUPS) / _BOUND_OVER_ERROR))
    rng = np.random.default_rng(5)
    met = rng.poisson(rate * samples / per_look, (4000, GROUPS)).astype(np.float64)
    centre = np.eye(GROUPS) - 1 / GROUPS
    products = [centre @ np.diag(each) @ centre for each in met]
    bounds = np.array([bound_of(each / (samples * GROUPS) ** 2 * GROUPS / (GROUPS - 1), 1.0) for each in products])
    assert 0.35 < float((bounds < target).mean()) < 0.75


def test_noise_tells_how_unlike_replicates_are() -> None:
    """Four looks of which one has all the noise: a relative variance of 16/9 about; of even noise next to none. And as
    how many equal ones paths are: one that brings ten times as much as a hundred others is as 3.9 would be."""
    rng = np.random.default_rng(6)
    even, one = rng.normal(size=(REPLICATES, 4000)), np.zeros((REPLICATES, 4000))
    one[2] = even[2]
    paths = np.append(np.ones(100), 10.0)
    assert Noise.among(even, 2.0, 8, paths).spread < 0.01
    assert Noise.among(even, 2.0, 8, paths).error == pytest.approx(math.sqrt(4000) / 2, rel=0.05)
    assert Noise.among(one, 2.0, 8, paths).spread == pytest.approx(16 / 9, rel=0.01)
    assert Noise.among(one, 2.0, 8, paths).heavy == pytest.approx(200**2 / 10100)
    assert Noise.among(np.zeros((REPLICATES, 3)), 2.0, 8, np.zeros(0)) == Noise(0.0, 8, 0.5, heavy=0.0)
