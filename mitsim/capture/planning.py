"""Plans: from a bench, a family's lighting and an accuracy to what is simulated, by as long a look as that is worth."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace

import drjit as dr

from mitsim.capture import pilot
from mitsim.capture.bench import Bench
from mitsim.capture.choice import cheapest, doubt
from mitsim.capture.evidence import GROUPS, Evidence
from mitsim.capture.plan import Plan, SceneFacts, decide
from mitsim.capture.request import check_accuracy
from mitsim.capture.simulation import AT_ANCHORS, Simulation, Stage
from mitsim.core.arrays import Labels
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer
from mitsim.rig.patterns import Lighting

_REHEARSED = 2**16
"""Paths that tell a tracer's pace: a tenth of a second or less, and far more than launching a kernel takes."""
_SELDOM = 3.0
"""What knowing for certain saves at most, over what a closer look may take for it: the look seldom turns out as hoped
(corner and cookie_bag at 1e-3: four looks of 1 to 13 s, and no run was the faster for them)."""
_LONG, _MORE = 5.0, 16
"""Seconds of a stage from which its pace is told by so many times as many paths: a hundredth of what it takes, and the
cost of launches and of filing few entries no longer counts as if it grew with the paths."""


@single_threaded_blas()
def make_plan(
    bench: Bench, lighting: Lighting, accuracy: float, seed: int, switches: Mapping[str, bool] | None = None
) -> Plan:
    """Look at the scene for a moment and decide what to simulate.

    Parameters
    ----------
    bench, lighting
        the scene, and the family's pixels and shots.
    accuracy
        relative rms error of the expected frames.
    seed
        root of the pilot's random streams.
    switches
        effects that are switched on or off by name, whatever they are worth.

    Raises
    ------
    MitsimError
        for a scene that the factored estimator cannot render.
    """
    check_accuracy(accuracy)
    if bench.loaded.unfit.factored is not None:
        raise bench.loaded.unfit.factored
    started = time.perf_counter()
    look = pilot.Look(bench, lighting, accuracy, seed)
    while True:
        evidence = look.evidence
        worth, part = doubt(accuracy, evidence, switches or {})
        stage = pilot.stage_of(part)
        if _SELDOM * look.price(stage) > worth:
            break
        look.refine(stage)
    chosen = cheapest(accuracy, evidence, switches or {}).settings
    timed = _timed(evidence, Simulation(bench, chosen), lighting.labels, seed)
    plan = decide(accuracy, timed, SceneFacts.of(bench, switches), switches)
    return plan.taking(plan=time.perf_counter() - started)


def _seconds(stage: Stage, seed: int, labels: Labels, samples: int) -> float:
    """What so many ``samples`` of a ``stage`` take to be traced and filed."""
    ledger = stage.ledger(labels)
    started = time.perf_counter()
    stage.file(stage.trace(seed, 0, samples, ledger), labels, samples)
    # What is filed on the device is not waited for.
    dr.sync_thread()
    return time.perf_counter() - started


def _timed(evidence: Evidence, simulation: Simulation, labels: Labels, seed: int) -> Evidence:
    """The ``evidence`` with the seconds that a path takes to be traced and filed in a ``simulation`` of the choice."""
    own, found = integer(seed, "pilot", "paces"), {}
    at_anchors = [0.0, 0]
    for name, stage in simulation.tracers().items():
        samples, taken = max(1, _REHEARSED // stage.tracer.lanes), []
        # The first, small one compiles the kernel; of the others the shorter was less disturbed.
        for count in (1, samples, samples):
            taken.append(_seconds(stage, own, labels, count))
        seconds = min(taken[1:]) / samples
        if GROUPS * stage.predicted * seconds > _LONG:
            again = (_seconds(stage, own, labels, _MORE * samples) for _ in range(2))
            seconds = min(seconds, min(again) / (_MORE * samples))
        if name in AT_ANCHORS:
            at_anchors = [at_anchors[0] + seconds, at_anchors[1] + stage.tracer.lanes]
            continue
        field = f"{name}_light" if name in ("sharp", "occluded") else name
        effort = getattr(evidence, field)
        # A path of shared light counts for several.
        found[field] = replace(effort, seconds=seconds / (effort.paths if name == "indirect" else stage.tracer.lanes))
    if at_anchors[1]:
        found["followed"] = replace(evidence.followed, seconds=at_anchors[0] / at_anchors[1])
    return replace(evidence, **found)
