"""Make the plan of a capture from a short pilot run, for a given accuracy or a given time."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import replace

import drjit as dr

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.request import check_accuracy
from mitsim.core.arrays import Labels
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer
from mitsim.devices.patterns import Lighting
from mitsim.light.cost_model import FIXED, ROUNDS, tracing_seconds
from mitsim.light.memory import frame_seconds
from mitsim.light.plan import Plan
from mitsim.light.settings import GROUPS, MOST_PATHS, REPLICATES, PilotResult, SampleCost
from mitsim.light.simulation import Simulation
from mitsim.optics.diffraction import check_openings
from mitsim.optics.fft_shadow import check_waves
from mitsim.planner import pilot
from mitsim.planner.choose import (
    FIRST_ACCURACY,
    Candidate,
    Candidates,
    accuracy_for_time,
    predicted_candidate,
    time_warnings,
    unit_costs_of,
    value_of_refining,
)
from mitsim.planner.explain import SceneFacts, explain_plan

OPENING_S = 1.5
"""Seconds to start the program and open a scene (1.2 to 1.6 on two cores)."""
_LONGER = 2.0
"""Seconds of a second, finer pilot over those of the first."""
_REHEARSED = 2**16
_SELDOM = 3.0
"""Ratio of what a closer run may save to its work below which it is not made: it seldom saves that."""
_OF_RUN = 0.2
"""Part of the work on light and frames that closer runs may take in total."""
_MORE, _OF_ALL, _TIMED = 4, 0.1, 0.02
_MOSTLY = 0.75
_USUAL = 1.5
"""Ratio to its fixed cost from which a launch was disturbed, and is repeated."""
_LEAST_SLOPE = 0.25
"""Smallest part of a path's seconds in a launch that grows with the paths."""
_HEAVY_PATHS, _MOST_HEAVY_PATHS = 2**19, 2**23
"""First and largest number of paths that search for heavy paths, 0.1 s and 1 s."""
_FEW, _FEWEST = 8.0, 4.0
_LEAST, _MOST = 0.7, 5.0
"""Ratios of actual to planned work on few heavy paths: nine of ten runs lie between."""
_HEAVIER = 1.25


@single_threaded_blas()
def make_plan(
    bench: Apparatus,
    lighting: Lighting,
    accuracy: float,
    seed: int,
    switches: Mapping[str, bool] | None = None,
    lines: int = 1,
) -> Plan:
    """Run the pilot and choose what to simulate.

    Parameters
    ----------
    bench, lighting
        the scene, and the family's pixels and shots.
    accuracy
        relative rms error of the expected frames.
    seed
        root of the pilot's random streams.
    switches
        effects that the user switches on or off, by name.
    lines
        lines that share the paths; the bench has one.
    """
    check_accuracy(accuracy)
    _refuse_unfit(bench, switches or {})
    started = time.perf_counter()
    runs = pilot.PilotRuns(bench, lighting, accuracy, seed, lines)
    candidates, notes = _refine(runs, accuracy, switches or {})
    plan = _decide(runs, accuracy, candidates).taking(plan=time.perf_counter() - started)
    return replace(plan, notes=notes)


def _refine(runs: pilot.PilotRuns, accuracy: float, switches: Mapping[str, bool]) -> tuple[Candidates, tuple[str, ...]]:
    """Repeat pilot runs with more samples while that is worth its work; return candidates and notes."""
    spent = 0.0
    while True:
        candidates = Candidates(runs.pilot_result, switches)
        worth, part = value_of_refining(accuracy, candidates)
        run = pilot.run_of(part)
        work = runs.work(run)
        if _SELDOM * work > worth:
            return candidates, ()
        spent += work
        whole = candidates.choice(accuracy).work
        if spent > _OF_RUN * whole:
            note = (
                f"{part.name.replace('_', ' ')} and all that hangs on them are chosen safely: to look closer would "
                f"take {spent:.1f} s, more than a fifth of the {whole:.1f} s of light and frames"
            )
            return candidates, (note,)
        runs.refine(run)


@single_threaded_blas()
def plan_within(
    bench: Apparatus, lighting: Lighting, seconds: float, seed: int, switches: Mapping[str, bool] | None = None
) -> Plan:
    """Make the plan of the finest accuracy whose run is predicted to take at most ``seconds`` from the program's start.

    Predictions use fixed unit costs, so that the same time gives the same plan.
    """
    started, switches = time.perf_counter(), switches or {}
    _refuse_unfit(bench, switches)
    around = OPENING_S + sum(frame_seconds(bench, len(lighting.weights)).values())
    runs = pilot.PilotRuns(bench, lighting, FIRST_ACCURACY, seed)
    around += runs.seconds
    again = _LONGER * runs.seconds
    candidates = Candidates(runs.pilot_result, switches)
    found = accuracy_for_time(candidates, seconds - around, FIRST_ACCURACY)
    # What a look tells of finer accuracies than its own is their price, not whether they are kept.
    aim = accuracy_for_time(candidates, seconds - around - again, 0.0, kept=False)
    if found.fits and aim.fits and aim.accuracy < FIRST_ACCURACY:
        around += again
        closer = pilot.PilotRuns(bench, lighting, aim.accuracy, seed)
        others = Candidates(closer.pilot_result, switches)
        finer = accuracy_for_time(others, seconds - around, aim.accuracy)
        # It may say that no accuracy is kept at all, and then has the loosest.
        if finer.fits and finer.accuracy <= found.accuracy:
            runs, candidates, found = closer, others, finer
    plan = _decide(runs, found.accuracy, candidates).taking(plan=time.perf_counter() - started)
    return replace(plan, asked_seconds=seconds, warnings=(*time_warnings(found, seconds, around), *plan.warnings))


def _refuse_unfit(bench: Apparatus, switches: Mapping[str, bool]) -> None:
    if bench.loaded.unfit.factored is not None:
        raise bench.loaded.unfit.factored
    if bench.geometry.diffracts and switches.get("diffraction") is not False:
        check_openings(bench.geometry.build_mask(), float(bench.spectrum.wavelengths_nm.max()))
        check_waves(bench.geometry, bench.spectrum)


def _decide(runs: pilot.PilotRuns, accuracy: float, candidates: Candidates) -> Plan:
    pilot_result, switches, bench = candidates.pilot_result, candidates.switches, runs.bench
    chosen = candidates.choice(accuracy)
    if pilot_result.sharp is not None and Simulation(bench, chosen.settings).from_camera is not None:
        pilot_result, chosen = _with_heavy_paths(runs, accuracy, chosen, switches)
    simulation = Simulation(bench, chosen.settings)
    timed = _time_paths(pilot_result, simulation, runs.lighting.labels, runs.seed)
    plan = explain_plan(accuracy, timed, SceneFacts.of(bench, switches), switches, chosen)
    plan = replace(plan, predicted_range=_range(timed, plan))
    if simulation.physics.mirrors:
        # The pilot formed the frames of other shots, or of fewer effects, from the same beams.
        plan = plan.taking(optics=plan.predicted["optics"] + bench.specular.seconds)
    return plan


def _with_heavy_paths(
    runs: pilot.PilotRuns, accuracy: float, chosen: Candidate, switches: Mapping[str, bool]
) -> tuple[PilotResult, Candidate]:
    """Return the pilot result and choice with samples for rare heavy paths, which a run's first samples may miss."""
    plain = tracing_seconds(runs.pilot_result, chosen.settings, FIXED)
    paths = _HEAVY_PATHS
    while True:
        known = runs.pilot_result.sample_costs
        heavier = {
            name: replace(known[name], noise=sample_cost.noise)
            for name, sample_cost in runs.heavy(max(1, paths // (REPLICATES * known["from_camera"].paths))).items()
            if sample_cost.variance > known[name].variance
        }
        pilot_result = runs.pilot_result.with_sample_costs(heavier)
        planned = predicted_candidate(accuracy, pilot_result, chosen.settings, switches)
        seconds = tracing_seconds(pilot_result, planned.settings, FIXED)
        if sum(seconds.values()) <= _HEAVIER * sum(plain.values()):
            return runs.pilot_result, chosen
        paths *= _MORE
        asked = {name: seconds[name] / FIXED.passes[name] for name in heavier}
        few = any(sample_cost.noise.heavy < _FEW for sample_cost in heavier.values())
        if paths > (_MOST_HEAVY_PATHS if few else min(_MOST_HEAVY_PATHS, _OF_ALL * sum(asked.values()))):
            return pilot_result, _limit_samples(planned, asked)


def _limit_samples(chosen: Candidate, paths: Mapping[str, float]) -> Candidate:
    samples = dict(chosen.settings.samples)
    samples |= {name: MOST_PATHS / count * samples[name] for name, count in paths.items() if count > MOST_PATHS}
    return replace(chosen, settings=replace(chosen.settings, samples=samples))


def _range(pilot_result: PilotResult, plan: Plan) -> tuple[float, float] | None:
    """Return the seconds between which nine of ten runs end, if few heavy paths make most of their noise."""
    costs, least, most = unit_costs_of(pilot_result), 0.0, 0.0
    for name, seconds in tracing_seconds(pilot_result, plan.settings, costs).items():
        heavy = pilot_result.sample_costs[name].noise.heavy
        if seconds and math.isfinite(heavy):
            limit = MOST_PATHS * costs.passes[name]
            least += (_LEAST - 1) * seconds
            most += max((min(_MOST * seconds, limit) if heavy >= _FEWEST else limit) - seconds, 0.0)
    total = plan.predicted_seconds
    return (total + least, total + most) if most else None


def _seconds(simulation: Simulation, name: str, seed: int, labels: Labels, samples: int) -> float:
    accumulator = simulation.accumulator(name, labels, 1)
    started = time.perf_counter()
    simulation.accumulate(name, simulation.passes[name].trace(seed, 0, samples, accumulator), labels, samples)
    # What is added up on the device is not waited for.
    dr.sync_thread()
    return time.perf_counter() - started


def _time_paths(pilot_result: PilotResult, simulation: Simulation, labels: Labels, seed: int) -> PilotResult:
    """Measure the seconds of a path in the passes that take most, and scale the others."""
    own, spread = integer(seed, "pilot", "paces"), pilot_result.spread
    fixed = {name: 0.0 for name in simulation.passes} | tracing_seconds(pilot_result, simulation.settings, FIXED)
    timed, ratios, ray = dict[str, float](), dict[str, float](), 0.0
    for name in sorted(simulation.passes, key=lambda name: -fixed[name]):
        rest = sum(seconds for other, seconds in fixed.items() if other not in timed)
        if timed and rest <= (1 - _MOSTLY) * sum(fixed.values()):
            break
        # A path of shared light counts for several.
        paths = pilot_result.sample_costs[name].paths if name == "indirect" else _paths_of(simulation, name)
        seconds, alone = _pace(simulation, name, labels, own)
        timed[name], ratios[name] = seconds / paths, seconds / paths / FIXED.passes[name]
        if name == "direct":
            ray = alone / paths
    whole = sum(fixed[name] for name in timed)
    # Where nothing takes any time, what was timed counts alike.
    by = {name: fixed[name] / whole if whole else 1 / len(timed) for name in timed}
    slower = sum(by[name] * ratio for name, ratio in ratios.items()) if timed else 1.0
    found = {
        name: replace(
            pilot_result.sample_costs.get(name, SampleCost.none()), seconds=timed.get(name, slower * FIXED.passes[name])
        )
        for name in simulation.passes
    }
    spread = replace(spread, seconds=ray or slower * FIXED.passes["direct"])
    return replace(pilot_result.with_sample_costs(found), spread=spread)


def _paths_of(simulation: Simulation, name: str) -> int:
    return simulation.passes[name].tracer.paths_per_sample


def _pace(simulation: Simulation, name: str, labels: Labels, seed: int) -> tuple[float, float]:
    """Return seconds of a sample of a pass in a run, and of its paths alone."""
    each, at_once = simulation.passes[name], simulation.paths_at_once
    planned, paths_per_sample = each.whole, each.tracer.paths_per_sample
    every = GROUPS * planned

    def once(samples: int) -> float:
        seconds = _seconds(simulation, name, seed, labels, samples)
        # The first may compile the kernel, and what disturbs a moment would be multiplied.
        unusual = seconds > _USUAL * samples * paths_per_sample * FIXED.passes[name]
        again = unusual and (samples == 1 or samples <= _TIMED * every)
        return min(seconds, _seconds(simulation, name, seed, labels, samples)) if again else seconds

    launch = once(1)
    samples = max(1, _REHEARSED // paths_per_sample)
    longest = once(samples) if samples > 1 else launch
    least = longest / samples
    while _MORE * samples * paths_per_sample <= at_once and _MORE * samples <= _TIMED * every:
        samples *= _MORE
        longest = once(samples)
        least = min(least, longest / samples)
    slope = min(max((longest - launch) / (samples - 1), _LEAST_SLOPE * least), least) if samples > 1 else launch
    launches = ROUNDS * math.ceil(planned / max(1, at_once // paths_per_sample))
    return slope + max(launch - slope, 0.0) * launches / planned, slope
