"""Time and error of captures at several accuracies, of each part of their light, and of the reference, on one scene.

Every error is relative to the *judge*, a factored answer with its own seed and every effect of the scene. The judge's
own noise is subtracted, because independent squares add. *run*: a whole `mitsim capture`. *part*: the error without an
effect, or with anchors, layers or cells reduced to one, and the time that this part costs. *surfaces*: the same for
light over 2, 3, 4 and more surfaces. *reference*: one frame of the scene's own integrator, extrapolated to all frames.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from operator import add
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsim.acquire.capture import capture
from mitsim.acquire.exposure import NoiseTarget
from mitsim.acquire.reference import render, show_pattern
from mitsim.acquire.spectral import SpectralBench
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import EFFECTS, Physics, names, present
from mitsim.bench.request import Exposure, Request, Task
from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.devices.patterns import PatternFamily, read_name
from mitsim.light.cost_model import frame_seconds
from mitsim.light.light import SampledLight, Sampling, Target, first_samples, trace_light, traced_again
from mitsim.light.passes import PASSES
from mitsim.light.plan import Plan
from mitsim.light.settings import (
    COUNTED,
    GROUPS,
    REPLICATES,
    Approximation,
    ErrorCovariance,
    Estimate,
    PilotResult,
    Settings,
)
from mitsim.light.simulation import Simulation
from mitsim.metrics import relative_error
from mitsim.optics.frames import ExpectedFrames
from mitsim.planner import pilot
from mitsim.planner.choose import counts_of, predicted_candidate
from mitsim.planner.planner import SceneFacts, explain_plan
from mitsim.report.pages import Value
from mitsim.report.plots import pareto_front
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.studies.causes import MOST, OfOrders, ablations, reform
from mitsim.studies.framework.claims import Judged, choose_rows
from mitsim.studies.framework.experiment import Found, Point, Results, Scope, Study
from mitsim.studies.framework.panels import Bars, Lines
from mitsim.studies.framework.studio import Studio

if TYPE_CHECKING:
    from pandas import DataFrame

ACCURACIES = (3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4)
QUOTED = 1e-3
SAMPLES = (16, 64)
LONGEST_S = 30.0
"""Predicted seconds above which a run, or a step of the reference, is skipped."""
PART_S, JUDGE_S = 1.5, 12.0
"""Predicted seconds of light with all parts, and of the judge's."""
_REPEATS, _REPEATED_S = 3, 5.0
"""Repeats of work that takes at most so many seconds; longer work is timed once."""
_ALIKE = 0.1
_FINER, _STEP = 10.0, 1.25
"""The judge's noise is a tenth of the quoted accuracy where time allows, and grows by this factor otherwise."""
RUN, PART, REFERENCE, PARENT = "factored", "part", "reference", "interreflection"
ORDERS = {"2 surfaces": (2, 2), "3 surfaces": (3, 3), "4 surfaces": (4, 4), "5 or more": (5, MOST)}
_FEWER = 4
"""Factor of samples that an order saves because it is traced alone."""

# -------- A scene and its patterns, with the results of the pilot


@dataclass(frozen=True, eq=False)
class Probe:
    bench: Apparatus
    family: PatternFamily
    seed: int
    accuracy: float

    @cached_property
    def pilot_runs(self) -> pilot.PilotRuns:
        return pilot.PilotRuns(self.bench, self.family.lighting, self.accuracy, self.seed)

    @property
    def pilot_result(self) -> PilotResult:
        return self.pilot_runs.pilot_result

    @cached_property
    def few_shots(self) -> Labels:
        return np.unique(np.linspace(0, len(self.family.shots) - 1, 8).astype(np.int64))

    def plan(self, accuracy: float) -> Plan:
        return explain_plan(accuracy, self.pilot_result, SceneFacts.of(self.bench))

    def finest(self, plan: Plan) -> Plan:
        ladders, now = self.pilot_result.ladders, plan.settings
        anchors, layers, cells, followed, occluded = (
            next((finer for finer in ladders[name] if finer > count), count)
            for name, count in zip(COUNTED, counts_of(now), strict=True)
        )
        settings = replace(
            now,
            anchors=anchors,
            layers=self.pilot_result.layers[layers] if layers > 1 else (),
            subdivision=cells,
            effects=frozenset(present(self.bench)),
            followed_anchors=followed,
            occluded_anchors=occluded,
            coarse_layers=True,
        )
        return replace(plan, settings=settings)

    def within(self, plan: Plan, seconds: float) -> tuple[Plan, float]:
        """Return the ``plan`` with the least noise within the predicted ``seconds``, if possible, and its time."""
        accuracy = plan.accuracy / _FINER
        while True:
            choice = predicted_candidate(accuracy, self.pilot_result, plan.settings, {})
            if choice.work <= seconds or accuracy > plan.accuracy:
                return replace(plan, settings=choice.settings, sampling_target=choice.target), choice.work
            accuracy *= _STEP

    def trace(
        self, plan: Plan, seed: int, bench: Apparatus | None = None, target: Target | None = None
    ) -> SampledLight:
        return trace_light(
            bench or self.bench, plan, self.family.lighting, seed, Sampling(by_pixel=False, target=target)
        )


def stack_frames(expected: ExpectedFrames) -> tuple[FloatArray, float]:
    """Return all ``expected`` frames (shots, m, m') and their relative Monte Carlo error.

    MitsimError if all frames are dark.
    """
    formed = list(expected)
    frames = np.stack([frame.irradiance for frame in formed])
    if not frames.any():
        raise MitsimError("all frames are dark; nothing can be compared")
    noise = sum(frame.variance * frame.irradiance.size for frame in formed)
    return frames, float(np.sqrt(noise / np.square(frames).sum()))


@dataclass(frozen=True, eq=False)
class Judge:
    """Reference answer for errors: its light, its expected frames, and their errors."""

    probe: Probe
    light: SampledLight
    expected: ExpectedFrames
    frames: FloatArray
    mc_error: float
    systematic_error: float

    @classmethod
    def trace(cls, probe: Probe, seconds: float = JUDGE_S) -> Judge:
        plan, seed = probe.plan(probe.accuracy), probe.seed + 1
        finest, work = probe.within(probe.finest(plan), seconds)
        if work > seconds:  # the plan's own numbers then; what they leave is stated with the judge
            finest, _ = probe.within(plan, seconds)
        light = probe.trace(finest, seed)
        expected = light.frames(probe.family.lighting, seed)
        counted = zip(COUNTED, counts_of(finest.settings), strict=True)
        left = probe.pilot_result.error(*(Approximation(*both) for both in counted)).value
        return cls(probe, light, expected, *stack_frames(expected), left)

    def error(self, frames: FloatArray) -> float:
        """Return the relative error of ``frames`` without the judge's own noise, at least half of that noise."""
        distance = relative_error(frames, self.frames)
        return max(math.sqrt(max(distance**2 - self.mc_error**2, 0.0)), self.mc_error / 2)

    def row(self, **measured: Value) -> dict[str, Value]:
        sensor = self.probe.bench.sensor
        noise = NoiseTarget(self.probe.bench.devices, Exposure(), 1.0)(self.expected)
        judge = {"judge_error": math.hypot(self.mc_error, self.systematic_error), "judge_mc_error": self.mc_error}
        return {**measured, **judge, "sensor_noise": noise if np.isfinite(sensor.full_well_e) else None}

    def of_reference(self) -> SampledLight:
        probe, plan, absent = self.probe, self.light.plan, names(lambda effect: not effect.in_reference)
        if not any(EFFECTS[name].retraced(Physics.of(probe.bench)) for name in absent & plan.settings.effects):
            return reform(self.light, absent)
        plain = replace(plan, settings=replace(plan.settings, effects=plan.settings.effects - absent))
        return probe.trace(plain, probe.seed + 1)


# -------- Times


def repeated(work: Callable[[], float]) -> list[float]:
    seconds = [work()]
    return seconds + [work() for _ in range(_REPEATS - 1) if seconds[0] <= _REPEATED_S]


def spread(seconds: Sequence[float]) -> dict[str, Value]:
    return {
        "seconds": median(seconds), "least_s": min(seconds), "most_s": max(seconds), "repeats": len(seconds)
    }  # fmt: skip


def extra(with_it: Sequence[float], without: Sequence[float]) -> dict[str, Value]:
    """Return the columns of a difference of two repeated times.

    ``seconds`` is None if the difference may be chance (``within_noise``). A single measurement may be a tenth off.
    """
    (least, most), (low, high) = (
        (min(each), max(each)) if len(each) > 1 else ((1 - _ALIKE) * each[0], (1 + _ALIKE) * each[0])
        for each in (with_it, without)
    )
    noisy = least <= high
    return {
        "seconds": None if noisy else median(with_it) - median(without),
        "least_s": max(least - high, 0.0),
        "most_s": max(most - low, 0.0),
        "within_noise": noisy,
        "repeats": min(len(with_it), len(without)),
    }


def _timed(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


# -------- Measurement of one point


def measure_run(judge: Judge, accuracy: float, opening_s: float) -> Iterator[dict[str, Value]]:
    probe, stages, errors = judge.probe, [], []
    bench, plan = probe.bench, probe.plan(accuracy)
    around = probe.pilot_runs.seconds + sum(frame_seconds(bench, len(probe.family.shots)).values())
    known: dict[str, Value] = {"estimator": RUN, "setting": f"accuracy {accuracy:g}", "accuracy": accuracy}
    if (predicted := plan.predicted_seconds + around) > LONGEST_S:
        by = f"not measured, predicted to take {predicted:.0f} s"
        yield judge.row(**known, seconds=predicted, extrapolated=True, by=by)
        return
    # Speckle is drawn anew in every frame and is no error of the light.
    effects = {"speckle": False} if "speckle" in present(bench) else {}
    request = Request.of(patterns=probe.family.name, seed=probe.seed, accuracy=accuracy, effects=effects)

    def run() -> float:
        job = Job()
        with TemporaryDirectory(prefix="mitsim-study-") as folder:
            shots = capture(SpectralBench(bench), request, Task(Path(folder) / "run", job=job)).runs[0]
            seconds = job.clock.seconds()
            devices = bench.devices
            wavelength = devices.projector.effective_wavelength_nm
            unit = electrons_from_irradiance(1.0, shots.exposure_s, devices.sensor, wavelength)
            errors.append((judge.error(np.asarray(shots.electrons, np.float64) / unit), shots.manifest.mc_error or 0.0))
        total = seconds.pop("total")
        stages.append({"open scene": opening_s, **seconds})
        return total + opening_s

    took = repeated(run)
    by_stage = {f"{name}_s".replace(" ", "_"): median(each[name] for each in stages) for name in stages[0]}
    error, noise = errors[0]
    yield judge.row(**known, error=error, mc_error=noise, **spread(took), extrapolated=False, by="", **by_stage)


def measure_parts(judge: Judge) -> Iterator[dict[str, Value]]:
    probe, found = judge.probe, []
    full = full_plan(probe)
    whole = repeated(_light_of(probe, probe.bench, full))
    for name, less in ablations(full.settings, frozenset(present(probe.bench))):
        known = {"followed-anchors": "followed_anchors"}.get(name, name)
        part = Approximation(known, 1) if known in probe.pilot_result.ladders else Approximation(known)
        found.append((name, probe.pilot_result.error(part), probe.bench, replace(full, settings=less)))
    if len(probe.bench.spectrum.weights) > 1:
        mono, shots = one_line(probe.bench), probe.few_shots
        seen = replace(judge.light, simulation=Simulation(mono, judge.light.simulation.settings))
        frames, _ = stack_frames(seen.frames(probe.family.lighting.shots(shots), probe.seed + 1))
        error = relative_error(frames, judge.frames[shots])
        found.append(("lines", Estimate(error, error), mono, full))
    planned = {
        name for name, _ in ablations(probe.plan(probe.accuracy).settings, probe.plan(probe.accuracy).settings.effects)
    }
    for name, (error, bound), bench, plan in sorted(found, key=lambda part: -part[1][0]):
        took = extra(whole, repeated(_light_of(probe, bench, plan)))
        yield _part_row(judge, name, error, bound, took, name == "lines" or name in planned)


def _part_row(
    judge: Judge, name: str, error: float, bound: float, took: dict[str, Value], planned: bool, of: str = ""
) -> dict[str, Value]:
    label = f"{of}: {name}" if of else name
    return judge.row(
        estimator=PART, setting=label, name=name, of=of, error_if_off=error, error_bound=bound, **took, in_plan=planned
    )


def full_plan(probe: Probe) -> Plan:
    plan = probe.plan(probe.accuracy)
    now, finer = plan.settings, probe.finest(plan).settings
    counted = ("anchors", "followed_anchors", "occluded_anchors", "subdivision")
    numbers = {name: getattr(finer if getattr(now, name) == 1 else now, name) for name in counted}
    settings = replace(now, effects=finer.effects, layers=now.layers or finer.layers, **numbers)
    for accuracy in (1e-3, 3e-3, 1e-2, 3e-2, 0.1):
        choice = predicted_candidate(accuracy, probe.pilot_result, settings, {})
        if choice.work <= PART_S:
            break
    return replace(plan, settings=choice.settings)


def _light_of(probe: Probe, bench: Apparatus, plan: Plan) -> Callable[[], float]:

    def work(plan: Plan) -> object:
        return list(probe.trace(plan, probe.seed, bench, at_once).frames(probe.family.lighting, probe.seed))

    work(replace(plan, settings=with_samples(plan.settings, 1)))
    return lambda: _timed(lambda: work(plan))


def measure_surfaces(judge: Judge, settings: Settings) -> Iterator[dict[str, Value]]:
    probe = judge.probe
    if PARENT not in probe.plan(probe.accuracy).settings.effects:
        return
    bench, family = probe.bench, probe.family
    samples = first_samples(Simulation(bench, settings))

    def light_of(simulation: Simulation, samples: dict[str, int]) -> SampledLight:
        return traced_again(replace(judge.light, seed=probe.seed, samples=samples), simulation, "orders")

    def looks(fewest: int, most: int) -> FloatArray:
        """Return (REPLICATES, shots, m, m') frames by light of some orders alone."""
        fewer = {name: max(1, count // _FEWER) for name, count in samples.items()}
        light = light_of(OfOrders(bench, settings, fewest, most), fewer)
        each = [reduce(add, light.groups[look::REPLICATES]) / (GROUPS // REPLICATES) for look in range(REPLICATES)]
        shots = family.lighting.shots(probe.few_shots)
        return np.array(
            [[frame.irradiance for frame in replace(light, groups=(one,)).frames(shots, probe.seed)] for one in each]
        )

    def following(last: int) -> list[float]:
        simulation = OfOrders(bench, settings, 0, last)
        if last == 1:
            simulation = OfOrders(bench, replace(settings, effects=settings.effects - {PARENT}), 0, MOST)
            if not simulation.passes:
                return [0.0]
            light_of(simulation, dict.fromkeys(samples, 1))  # compiles its kernels
        return repeated(lambda: _timed(lambda: list(light_of(simulation, samples).frames(family.lighting, probe.seed))))

    energy = float(np.square(judge.frames[probe.few_shots]).sum())
    changes = ErrorCovariance.between({Approximation(name): looks(*each) for name, each in ORDERS.items()}, energy)
    before = following(1)
    for name, (_, most) in ORDERS.items():
        error, bound = changes.estimate([Approximation(name)])
        after = following(most)
        yield _part_row(judge, name, error, bound, extra(after, before), True, PARENT)
        before = after


def measure_reference(judge: Judge) -> Iterator[dict[str, Value]]:
    probe, shots = judge.probe, judge.probe.family.shots
    index, predicted_s = len(shots) // 2, 0.0
    answer, _ = stack_frames(judge.of_reference().frames(probe.family.lighting.shots([index]), probe.seed + 1))
    with show_pattern(probe.bench, probe.family.light(shots[index])):
        predicted_s = _timed(lambda: render(probe.bench, REFERENCE, SAMPLES[0], 1e-3, probe.seed))  # compiles kernels
        for spp in SAMPLES:
            if predicted_s > LONGEST_S:
                return
            rendered = render(probe.bench, REFERENCE, spp, 1e-3, probe.seed)
            one = float(rendered.facts["seconds"])
            predicted_s = 5 * one  # four times the samples, and some more
            error = relative_error(rendered.mean.mean(axis=2), answer[0])
            by = f"one of {len(shots)} frames was measured, {one:.2g} s" if len(shots) > 1 else ""
            yield judge.row(
                estimator=REFERENCE, setting=f"{spp} spp", error=error, mc_error=rendered.mc_error,
                **spread([one * len(shots)]), extrapolated=bool(by), by=by,
            )  # fmt: skip


def at_once(expected: ExpectedFrames) -> float:
    return float("inf")


def with_samples(settings: Settings, samples: int) -> Settings:
    each = {name: samples / 8 if row.anchors else float(samples) for name, row in PASSES.items() if name != "sharp"}
    return replace(settings, samples={**settings.samples, **each})


def one_line(bench: Apparatus) -> Apparatus:
    model = bench.projector
    changes = {"wavelengths_nm": (model.effective_wavelength_nm,), "radiant_shares": (1.0,)}
    return replace(bench, devices=replace(bench.devices, projector=model.model_copy(update=changes)))


# -------- The study


def _points(scope: Scope) -> list[Point]:
    read_name(scope.patterns)
    settings = [*(f"{each:g}" for each in scope.choose(ACCURACIES, (1e-2, QUOTED))), REFERENCE]
    settings += scope.choose((PART, "surfaces"), ())
    return [Point.of(scope.setup, patterns=scope.patterns, seed=scope.seeds[0], measured=each) for each in settings]


def _measure(studio: Studio, point: Point) -> Found:
    def opened() -> tuple[Judge, float]:
        seconds = _timed(lambda: studio.bench(point.setup))
        bench, seed = studio.bench(point.setup), int(point["seed"])
        return Judge.trace(Probe(bench, bench.family(point["patterns"], seed), seed, QUOTED)), seconds

    judge, opening_s = studio.once("judge", 1, (point.setup, point["patterns"], point["seed"]), opened)
    kinds: dict[str, Callable[[], Iterator[dict[str, Value]]]] = {
        PART: lambda: measure_parts(judge),
        "surfaces": lambda: measure_surfaces(judge, full_plan(judge.probe).settings),
        REFERENCE: lambda: measure_reference(judge),
    }
    rows = kinds.get(point["measured"], lambda: measure_run(judge, float(point["measured"]), opening_s))()
    return Found(tuple(point.row(**row) for row in rows))


def _derive(results: Results) -> Results:
    """Add the column ``on_front`` for runs that no other run beats, and the reference at the quoted run's error."""
    runs = [row for row in results.rows if row["estimator"] == RUN and not row["extrapolated"]]
    front = pareto_front([(float(str(row["seconds"])), float(str(row["error"]))) for row in runs])
    rows = [{**row, "on_front": (row["seconds"], row.get("error")) in front} for row in results.rows]
    slow = [row for row in rows if row["estimator"] == REFERENCE][-1:]
    for quoted in [row for row in runs if row["accuracy"] == QUOTED][:1]:
        rows += [_reaching(row, float(str(quoted["error"]))) for row in slow]
    return replace(results, rows=rows)


def _reaching(row: dict[str, Any], error: float) -> dict[str, Any]:
    more = (row["error"] / error) ** 2
    times = {name: row[name] * more for name in ("seconds", "least_s", "most_s")}
    setting = f"{float(row['setting'].split()[0]) * more:.0e} spp"
    by = f"error falls with 1/sqrt(samples) from {row['setting']}"
    return {
        **row, **times, "setting": setting, "error": error, "mc_error": row["mc_error"] / more**0.5,
        "extrapolated": True, "by": by,
    }  # fmt: skip


def _kept(rows: DataFrame) -> tuple[str, bool | None]:
    rows = rows[rows["error"].notna()]
    over = [row["error"] / math.hypot(row["accuracy"], row["judge_error"]) for row in rows.to_dict("records")]
    return (f"error over accuracy at most {max(over):.2f}", max(over) <= 1.25) if over else ("not measured", None)


def _unbiased(rows: DataFrame) -> tuple[str, bool]:
    over = [row["error"] / row["mc_error"] for row in rows.to_dict("records") if not row["by"].startswith("error")]
    return f"error over Monte Carlo error {min(over):.2f} to {max(over):.2f}", all(0.8 < each < 1.25 for each in over)


def _faster(rows: DataFrame) -> tuple[str, bool | None]:
    quoted = choose_rows(rows, {"estimator": RUN, "accuracy": QUOTED, "extrapolated": False}).to_dict("records")
    slow = choose_rows(rows, {"estimator": REFERENCE}).to_dict("records")
    if not quoted or not slow:
        return "not measured", None
    speedup = slow[-1]["seconds"] / (quoted[0]["transport_s"] + quoted[0]["optics_s"])
    return f"the reference takes {speedup:.1e} times as long (extrapolated)", speedup > 1


_TIME, _STAGES = "wall time [s]", ("open scene", "plan", "transport", "truth", "optics", "sensor", "write")

STUDY = Study(
    "accuracy",
    "What accuracy costs in time",
    "How long do a capture, each part of its light, and the reference take for their errors?",
    points=_points,
    measure=_measure,
    derive=_derive,
    claims=(
        Judged("Whole runs keep their accuracy", _kept, where={"estimator": RUN}),
        Judged("The reference has no error but noise", _unbiased, where={"estimator": REFERENCE}, optional=True),
        Judged(f"At the error of the run at {QUOTED:g} the factored light is faster than the reference", _faster),
    ),
    panels=(
        Lines(
            "seconds", _TIME, y="error", y_label="relative error of the frames [1]", file="accuracy", log=True,
            title="Whole runs from opening the scene to the last file; reference: light alone, extrapolated",
            where={"estimator": (RUN, REFERENCE)}, colour="estimator", facet="", ticks=False,
        ),
        Bars(
            {f"{name}_s".replace(" ", "_"): name for name in _STAGES}, file="stages", title="Stages of whole runs",
            where={"estimator": RUN, "extrapolated": False}, colour="setting", x_label=_TIME,
        ),
        Bars(
            "setting", file="effects", title="Error without each part of the light", where={"estimator": PART},
            colour={"error_if_off": "error without it", "error_bound": "below, at 95 %"},
            x_label="relative error of the frames [1]",
        ),
        Bars(
            "setting", file="parts", title="Time of each part of the light", where={"estimator": PART},
            colour={"seconds": "measured", "most_s": "at most"}, x_label=_TIME,
        ),
    ),
    about="Errors are those of the noise-free frames against the judge (columns judge_error and sensor_noise), whose "
    "Monte Carlo error is subtracted. Times are medians with the least and the most of three repeats, or were measured "
    "once. A part's time is a difference of two such times, and empty where noise hides it.",
    heads=("", "", "Found"),
    traced=False,
)  # fmt: skip
