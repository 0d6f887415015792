"""Time and error of captures at several accuracies, and of the reference, on one scene.

Every error is relative to the *judge*, a factored answer with its own seed and every effect of the scene. The judge's
own noise is subtracted, because independent squares add. A run is a whole `mitsim capture`. The reference is one frame
of the scene's own integrator, extrapolated to all frames.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsim.acquire.capture import capture, render, show_pattern
from mitsim.acquire.spectral import SpectralBench
from mitsim.api.bench import Bench
from mitsim.bench.effects import names, present
from mitsim.bench.request import Request, Task
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.devices.patterns import PatternFamily, read_name
from mitsim.light.light import SampledLight, Sampling, trace_light
from mitsim.metrics import relative_error
from mitsim.optics.frames import ExpectedFrames
from mitsim.report.pages import Value
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.studies.framework.claims import Judged, choose_rows
from mitsim.studies.framework.experiment import Found, Point, Scope, Study
from mitsim.studies.framework.panels import Bars, Lines
from mitsim.studies.framework.studio import Studio

if TYPE_CHECKING:
    from pandas import DataFrame

ACCURACIES = (3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4)
QUOTED = 1e-3
SAMPLES = (16, 64)
LONGEST_S = 30.0
"""Predicted seconds above which a run, or a step of the reference, is skipped."""
JUDGE_S = 12.0
"""Predicted seconds of the judge."""
_REPEATS, _REPEATED_S = 3, 5.0
"""Repeats of runs that take at most so many seconds; longer runs are timed once."""
RUN, REFERENCE = "factored", "reference"


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
    """Reference answer for errors: light with every effect of the scene, its expected frames, and their noise."""

    bench: Bench
    family: PatternFamily
    seed: int
    light: SampledLight
    frames: FloatArray
    mc_error: float

    @classmethod
    def trace(cls, bench: Bench, family: PatternFamily, seed: int, seconds: float) -> Judge:
        """Trace light as accurately as the predicted ``seconds`` allow, and at least to the quoted accuracy."""
        asked: dict[str, Any] = {"seed": seed + 1, "effects": dict.fromkeys(present(bench), True)}
        plan = bench.plan(family.name, seconds=seconds, **asked)
        if plan.accuracy > QUOTED:
            plan = bench.plan(family.name, accuracy=QUOTED, **asked)
        light = trace_light(bench, plan, family.lighting, seed + 1, Sampling(by_pixel=False))
        return cls(bench, family, seed, light, *stack_frames(light.frames(family.lighting, seed + 1)))

    def error(self, frames: FloatArray) -> float:
        """Return the relative error of ``frames`` without the judge's own noise, at least half of that noise."""
        distance = relative_error(frames, self.frames)
        return max(math.sqrt(max(distance**2 - self.mc_error**2, 0.0)), self.mc_error / 2)

    def row(self, **measured: Value) -> dict[str, Value]:
        return {**measured, "judge_error": math.hypot(self.mc_error, self.light.plan.systematic_error)}


# -------- Measurement of one point


def measure_run(judge: Judge, accuracy: float, opening_s: float) -> dict[str, Value]:
    """Return the row of a whole capture, with the median of repeated times and stages."""
    bench, name, stages, errors = judge.bench, judge.family.name, [], []
    known: dict[str, Value] = {"estimator": RUN, "setting": f"accuracy {accuracy:g}", "accuracy": accuracy}
    if (predicted := bench.plan(name, accuracy=accuracy, seed=judge.seed).predicted_seconds) > LONGEST_S:
        by = f"not measured, predicted to take {predicted:.0f} s"
        return judge.row(**known, seconds=predicted, extrapolated=True, by=by)
    # Speckle is drawn anew in every frame and is no error of the light.
    effects = {"speckle": False} if "speckle" in present(bench) else {}
    request = Request.of(patterns=name, seed=judge.seed, accuracy=accuracy, effects=effects)
    took: list[float] = []
    while len(took) < (_REPEATS if not took or took[0] <= _REPEATED_S else 1):
        job = Job()
        with TemporaryDirectory(prefix="mitsim-study-") as folder:
            shots = capture(SpectralBench(bench), request, Task(Path(folder) / "run", job=job)).runs[0]
            seconds = job.clock.seconds()
            devices = bench.devices
            wavelength = devices.projector.effective_wavelength_nm
            unit = electrons_from_irradiance(1.0, shots.exposure_s, devices.sensor, wavelength)
            errors.append((judge.error(np.asarray(shots.electrons, np.float64) / unit), shots.manifest.mc_error or 0.0))
        took.append(seconds.pop("total") + opening_s)
        stages.append({"open scene": opening_s, **seconds})
    by_stage = {f"{name}_s".replace(" ", "_"): median(each[name] for each in stages) for name in stages[0]}
    error, noise = errors[0]
    times = {"seconds": median(took), "least_s": min(took), "most_s": max(took), "repeats": len(took)}
    return judge.row(**known, error=error, mc_error=noise, **times, extrapolated=False, by="", **by_stage)


def measure_reference(judge: Judge) -> list[dict[str, Value]]:
    """Return a row for each number of samples of the reference whose predicted time is short enough."""
    bench, family, light, shots = judge.bench, judge.family, judge.light, judge.family.shots
    plan, absent = light.plan, names(lambda effect: not effect.in_reference)
    if absent & plan.settings.effects:
        plain = replace(plan, settings=replace(plan.settings, effects=plan.settings.effects - absent))
        light = trace_light(bench, plain, family.lighting, judge.seed + 1, Sampling(by_pixel=False))
    index, rows = len(shots) // 2, list[dict[str, Value]]()
    answer, _ = stack_frames(light.frames(family.lighting.shots([index]), judge.seed + 1))
    with show_pattern(bench, family.light(shots[index])):
        started = time.perf_counter()
        render(bench, REFERENCE, SAMPLES[0], Request(seed=judge.seed), Job())  # compiles kernels
        predicted_s = time.perf_counter() - started
        for spp in SAMPLES:
            if predicted_s > LONGEST_S:
                break
            rendered = render(bench, REFERENCE, spp, Request(seed=judge.seed), Job())
            one = float(rendered.facts["seconds"])
            predicted_s = 5 * one  # four times the samples, and some more
            error = relative_error(rendered.mean.mean(axis=2), answer[0])
            by = f"one of {len(shots)} frames was measured, {one:.2g} s" if len(shots) > 1 else ""
            rows.append(judge.row(
                estimator=REFERENCE, setting=f"{spp} spp", error=error, mc_error=rendered.mc_error,
                seconds=one * len(shots), extrapolated=bool(by), by=by,
            ))  # fmt: skip
    return rows


# -------- The study


def _points(scope: Scope) -> list[Point]:
    read_name(scope.patterns)
    settings = [*(f"{each:g}" for each in scope.choose(ACCURACIES, (1e-2, QUOTED))), REFERENCE]
    return [Point.of(scope.setup, patterns=scope.patterns, seed=scope.seeds[0], measured=each) for each in settings]


def _measure(studio: Studio, point: Point) -> Found:
    def opened() -> tuple[Judge, float]:
        started, seed = time.perf_counter(), int(point["seed"])
        bench = studio.bench(point.setup)
        seconds = time.perf_counter() - started
        return Judge.trace(bench, bench.family(point["patterns"], seed), seed, JUDGE_S), seconds

    judge, opening_s = studio.once("judge", 1, (point.setup, point["patterns"], point["seed"]), opened)
    if point["measured"] == REFERENCE:
        return Found(tuple(point.row(**row) for row in measure_reference(judge)))
    return Found((point.row(**measure_run(judge, float(point["measured"]), opening_s)),))


def _kept(rows: DataFrame) -> tuple[str, bool | None]:
    rows = rows[rows["error"].notna()]
    over = [row["error"] / math.hypot(row["accuracy"], row["judge_error"]) for row in rows.to_dict("records")]
    return (f"error over accuracy at most {max(over):.2f}", max(over) <= 1.25) if over else ("not measured", None)


def _unbiased(rows: DataFrame) -> tuple[str, bool]:
    over = rows["error"].astype(float) / rows["mc_error"].astype(float)
    text = f"error over Monte Carlo error {over.min():.2f} to {over.max():.2f}"
    return text, bool(over.between(0.8, 1.25, inclusive="neither").all())


def _faster(rows: DataFrame) -> tuple[str, bool | None]:
    quoted = choose_rows(rows, {"estimator": RUN, "accuracy": QUOTED, "extrapolated": False}).to_dict("records")
    slow = choose_rows(rows, {"estimator": REFERENCE}).to_dict("records")
    if not quoted or not slow:
        return "not measured", None
    # The reference's error falls with 1 / sqrt(samples).
    seconds = slow[-1]["seconds"] * (slow[-1]["error"] / quoted[0]["error"]) ** 2
    speedup = seconds / (quoted[0]["transport_s"] + quoted[0]["optics_s"])
    return f"the reference takes {speedup:.1e} times as long (extrapolated)", speedup > 1


_TIME, _STAGES = "wall time [s]", ("open scene", "plan", "transport", "truth", "optics", "sensor", "write")

STUDY = Study(
    "accuracy",
    "What accuracy costs in time",
    "How long do a capture and the reference take for their errors?",
    points=_points,
    measure=_measure,
    claims=(
        Judged("Whole runs keep their accuracy", _kept, where={"estimator": RUN}),
        Judged("The reference has no error but noise", _unbiased, where={"estimator": REFERENCE}, optional=True),
        Judged(f"At the error of the run at {QUOTED:g} the factored light is faster than the reference", _faster),
    ),
    panels=(
        Lines(
            "seconds", _TIME, y="error", y_label="relative error of the frames [1]", file="accuracy", log=True,
            title="Whole runs from opening the scene to the last file; reference: light alone, extrapolated",
            colour="estimator", facet="",
        ),
        Bars(
            {f"{name}_s".replace(" ", "_"): name for name in _STAGES}, file="stages", title="Stages of whole runs",
            where={"estimator": RUN, "extrapolated": False}, colour="setting", x_label=_TIME,
        ),
    ),
    about="Errors are those of the noise-free frames against the judge (column judge_error), whose Monte Carlo error "
    "is subtracted. Times are medians with the least and the most of three repeats, or were measured once.",
    heads=("", "", "Found"),
    traced=False,
)  # fmt: skip
