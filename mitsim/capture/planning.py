"""Plans: from a bench, a family's lighting and an accuracy to what is simulated, by as long a look as that is worth."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import drjit as dr

from mitsim.capture import pilot
from mitsim.capture.affordable import FIRST_LOOK, affordable, told
from mitsim.capture.bench import Bench
from mitsim.capture.choice import Candidates, cheapest, doubt, predicted
from mitsim.capture.cost import frame_seconds
from mitsim.capture.decision import SceneFacts, decide
from mitsim.capture.evidence import GROUPS, LOOKS, Evidence, Settings
from mitsim.capture.plan import Plan
from mitsim.capture.prices import paces_of, tracing_seconds
from mitsim.capture.request import check_accuracy
from mitsim.capture.simulation import AT_ANCHORS, Simulation, Stage
from mitsim.core.arrays import Labels
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer
from mitsim.rig.patterns import Lighting

OPENING_S = 1.5
"""Seconds of starting the program and opening a scene (shipped ones: 1.2 to 1.6 on two cores)."""
_LONGER = 2.0
"""Seconds of a second, finer look over those of the first (photograph 1.0, corner 1.1, gift_card 1.3, cookie_bag 2.6 at
a tenth of the accuracy)."""
_REHEARSED, _MOST_REHEARSED = 2**16, 2**18
"""Paths that tell a tracer's pace: a tenth of a second or less, and far more than launching a kernel takes; and how
many tell it without more of them."""
_SELDOM = 3.0
"""What knowing for certain saves at most, over what a closer look may take for it: the look seldom turns out as hoped
(corner and cookie_bag at 1e-3: four looks of 1 to 13 s, and no run was the faster for them)."""
_LONG, _MORE = 5.0, 4
"""Seconds of a stage from which its pace is told by what so many times as many paths take longer: the cost of launches
does not count as if it grew with the paths."""

_HEAVY_PATHS, _MOST_HEAVY_PATHS = 2**19, 2**21
"""Paths from the camera that are looked at for rare heavy ones, 0.1 s, and while they show more of them than was known:
ten glossy balls of alpha 0.02 need a million to tell their noise to a factor of two (25 thousand: 3000 too little)."""
_HEAVIER = 1.25
"""Tracing that takes so many times as long as planned is told; less is what predictions are good to."""

_STOPPED_LATE = 1.5
"""Samples that heavy paths take over those that their noise asks for: sampling stops by a bound that lies further above
it than that of light paths, and rounds overshoot (the glossy balls: 1.1, 1.7 and 2.1 by three seeds of looks)."""

_FIELDS = MappingProxyType(
    {
        "sharp": "sharp_light",
        "occluded": "occluded_light",
        **dict(zip(AT_ANCHORS, ("followed", "followed_from_camera"), strict=True)),
    }
)
"""What evidence calls the light of a stage, where it is not the stage's name."""


@single_threaded_blas()
def make_plan(
    bench: Bench,
    lighting: Lighting,
    accuracy: float,
    seed: int,
    switches: Mapping[str, bool] | None = None,
    lines: int = 1,
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
    lines
        that share the paths, of which the bench shows one; what it takes is told of all.

    Raises
    ------
    MitsimError
        for a scene that the factored estimator cannot render.
    """
    check_accuracy(accuracy)
    _refuse_unfit(bench)
    started = time.perf_counter()
    look = pilot.Look(bench, lighting, accuracy, seed, lines)
    while True:
        evidence = look.evidence
        worth, part = doubt(accuracy, evidence, switches or {})
        stage = pilot.stage_of(part)
        if _SELDOM * look.price(stage) > worth:
            break
        look.refine(stage)
    return _decided(look, accuracy, switches or {}).taking(plan=time.perf_counter() - started)


@single_threaded_blas()
def plan_within(
    bench: Bench, lighting: Lighting, seconds: float, seed: int, switches: Mapping[str, bool] | None = None
) -> Plan:
    """The plan of the finest accuracy whose run is predicted to end within so many seconds.

    Predicted at fixed paces, looking and opening the scene included: the same seconds mean the same plan.

    Parameters
    ----------
    bench, lighting, seed, switches
        as for :func:`make_plan`.
    seconds
        from the start of the program to the last file.

    Raises
    ------
    MitsimError
        as :func:`make_plan`.
    """
    _refuse_unfit(bench)
    started, switches = time.perf_counter(), switches or {}
    around = OPENING_S + sum(frame_seconds(bench, len(lighting.weights)).values())
    look = pilot.Look(bench, lighting, FIRST_LOOK, seed)
    around += look.seconds
    again = _LONGER * look.seconds
    found = affordable(Candidates(look.evidence, switches), seconds - around, FIRST_LOOK)
    # What a look tells of finer accuracies than its own is their price, not whether they are kept.
    aim = affordable(Candidates(look.evidence, switches), seconds - around - again, 0.0, kept=False)
    if found.fits and aim.fits and aim.accuracy < FIRST_LOOK:
        around += again
        closer = pilot.Look(bench, lighting, aim.accuracy, seed)
        finer = affordable(Candidates(closer.evidence, switches), seconds - around, aim.accuracy)
        # It may say that no accuracy is kept at all, and then has the loosest.
        if finer.fits and finer.accuracy <= found.accuracy:
            look, found = closer, finer
    plan = _decided(look, found.accuracy, switches).taking(plan=time.perf_counter() - started)
    return replace(plan, asked_seconds=seconds, warnings=(*told(found, seconds, around), *plan.warnings))


def _refuse_unfit(bench: Bench) -> None:
    """MitsimError for a ``bench`` that the factored estimator cannot render."""
    if bench.loaded.unfit.factored is not None:
        raise bench.loaded.unfit.factored


def _decided(look: pilot.Look, accuracy: float, switches: Mapping[str, bool]) -> Plan:
    """The plan at an ``accuracy`` of what a ``look`` found, with the paces of its choice measured."""
    evidence, bench = look.evidence, look.bench
    chosen = cheapest(accuracy, evidence, switches)
    simulation = Simulation(bench, chosen.settings)
    timed = _timed(evidence, simulation, look.lighting.labels, look.seed)
    plan = decide(accuracy, timed, SceneFacts.of(bench, switches), switches, chosen)
    if simulation.physics.mirrors:
        # The pilot formed the frames of other shots, or of fewer effects, from the same beams.
        plan = plan.taking(optics=plan.predicted["optics"] + bench.glint.seconds)
    if simulation.from_camera is None or evidence.sharp is None:
        return plan
    more = _of_heavy_paths(look, accuracy, timed, chosen.settings, switches)
    return plan.taking(transport=plan.predicted["transport"] + more) if more else plan


def _of_heavy_paths(
    look: pilot.Look, accuracy: float, evidence: Evidence, settings: Settings, switches: Mapping[str, bool]
) -> float:
    """Seconds that ``settings`` take more than with their samples, where rare paths over gloss make most of the noise.

    Settings stay: that light is followed so far is known only while it is sampled. Of looks of ever more paths the
    noisiest counts: what few paths see of such light is nearly always too little.
    """
    pace, known = paces_of(evidence), evidence
    already = sum(tracing_seconds(evidence, settings, pace).values())
    paths, needed = _HEAVY_PATHS, 0.0
    while paths <= _MOST_HEAVY_PATHS:
        found = look.heavy(max(1, paths // (LOOKS * evidence.from_camera.paths)))
        noisier = {
            name: replace(getattr(evidence, name), noise=effort.noise)
            for name, effort in found.items()
            if effort.variance > getattr(known, name).variance
        }
        known = replace(known, **noisier)
        before = needed
        needed = sum(tracing_seconds(known, predicted(accuracy, known, settings, switches).settings, pace).values())
        if needed <= max(_HEAVIER * already, before):
            break
        paths *= _MORE
    return _STOPPED_LATE * needed - already if needed > _HEAVIER * already else 0.0


def _seconds(stage: Stage, seed: int, labels: Labels, samples: int) -> float:
    """What so many ``samples`` of a ``stage`` take to be traced and filed."""
    ledgers = stage.ledgers(labels, 1)
    started = time.perf_counter()
    stage.file(stage.trace(seed, 0, samples, ledgers), labels, samples)
    # What is filed on the device is not waited for.
    dr.sync_thread()
    return time.perf_counter() - started


def _timed(evidence: Evidence, simulation: Simulation, labels: Labels, seed: int) -> Evidence:
    """The ``evidence`` with the seconds that a path takes to be traced and filed in a ``simulation`` of the choice."""
    own, found = integer(seed, "pilot", "paces"), {}
    for name, stage in simulation.tracers().items():
        samples = max(1, _REHEARSED // stage.tracer.lanes)
        _seconds(stage, own, labels, 1)  # compiles the kernel
        once = _seconds(stage, own, labels, samples)
        seconds = once / samples
        if GROUPS * stage.predicted * seconds > _LONG and samples * stage.tracer.lanes < _MOST_REHEARSED:
            more = _seconds(stage, own, labels, _MORE * samples)
            # What disturbs either of the two may not halve the pace, nor hide that more paths take less for each.
            most = min(seconds, more / (_MORE * samples))
            seconds = min(max((more - once) / ((_MORE - 1) * samples), most / 2), most)
        field = _FIELDS.get(name, name)
        effort = getattr(evidence, field)
        # A path of shared light counts for several.
        found[field] = replace(effort, seconds=seconds / (effort.paths if name == "indirect" else stage.tracer.lanes))
    return replace(evidence, **found)
