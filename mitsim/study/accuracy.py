"""`mitsim study accuracy`: what accuracy costs in time, for both estimators on one scene.

The judge is a factored answer of its own seed, finer in anchors, cells and samples than anything it judges; its own
Monte Carlo error is stated. The reference is measured on one frame of the family, and its time is counted for all
frames. Where a reference error is out of reach it is extrapolated by 1/sqrt(samples), and said so.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.capture.bench import Bench, PatternFamily
from mitsim.capture.light import Progress, collect, make_plan
from mitsim.capture.render import projected, reference
from mitsim.core.errors import MitsimError
from mitsim.core.manifest import prepare_output, versions, write_json
from mitsim.optics.frames import ExpectedFrames
from mitsim.study import plots
from mitsim.study.metrics import relative_error

FloatArray = npt.NDArray[np.float64]
ACCURACIES = (3e-2, 1e-2, 3e-3, 1e-3, 3e-4)
SAMPLES = (16, 64, 256)
QUOTED = 1e-3
_JUDGE = {"anchors": 3, "subdivision": 4}
_JUDGE_MARGIN = 3.0


@dataclass(frozen=True)
class Row:
    """One setting of one estimator: wall seconds for all frames, error against the judge, own Monte Carlo error."""

    estimator: str
    setting: str
    seconds: float
    error: float
    mc_error: float


@dataclass(frozen=True)
class AccuracyStudy:
    """Rows, and how much longer the reference would take to reach the factored error at 1e-3 (extrapolated)."""

    scene: str
    patterns: str
    rows: tuple[Row, ...]
    judge_mc_error: float
    speedup_at_equal_error: float
    output: str

    def payload(self) -> dict[str, Any]:
        """The JSON of the command line."""
        return {
            "rows": [asdict(row) for row in self.rows],
            "speedup_at_equal_error": self.speedup_at_equal_error,
            "extrapolated": "reference error falls with 1/sqrt(samples)",
            "judge_mc_error": self.judge_mc_error,
            "scene": self.scene,
            "patterns": self.patterns,
            "output": self.output,
        }

    def lines(self) -> list[str]:
        """For people."""
        table = [
            f"{row.estimator:>10} {row.setting:<16} {row.seconds:9.3f} s  error {row.error:.1e}  "
            f"Monte Carlo {row.mc_error:.1e}"
            for row in self.rows
        ]
        return [
            *table,
            f"At the error of the factored estimator at {QUOTED:g} the reference would take "
            f"{self.speedup_at_equal_error:.1e} times as long (extrapolated by 1/sqrt(samples)).",
            f"Plot: {self.output}/accuracy.png",
        ]


def study_accuracy(bench: Bench, output: Path | str, patterns: str, seed: int, progress: Progress) -> AccuracyStudy:
    """Measure error against time and write accuracy.json and accuracy.png to ``output``."""
    # Only an earlier study is replaced.
    folder = prepare_output(output, overwrite=(Path(output) / "accuracy.json").is_file())
    family = bench.family(patterns, seed)
    labels, weights = family.classes()
    finest = min(ACCURACIES)
    plan = make_plan(bench, labels, weights, finest, seed + 1)
    plan = replace(plan, **_JUDGE, sampling_target=finest / _JUDGE_MARGIN)  # type: ignore[arg-type]
    light = collect(bench, plan, labels, weights, seed + 1, progress)
    judge, judge_error = _stack(light.frames(labels, weights, seed + 1))
    rows = list(_factored(bench, family, judge, seed, progress))
    rows += list(_reference(bench, family, judge, seed, progress))
    quoted = next(row for row in rows if row.setting == f"accuracy {QUOTED:g}")
    slow = rows[-1]
    # The reference is unbiased: its error is its noise, and that falls with 1/sqrt(samples).
    needed = slow.seconds * (slow.error / quoted.error) ** 2
    study = AccuracyStudy(
        scene=str(bench.loaded.path),
        patterns=patterns,
        rows=tuple(rows),
        judge_mc_error=judge_error,
        speedup_at_equal_error=needed / quoted.seconds,
        output=str(folder),
    )
    figure = plots.error_against_time(
        {name: [(r.seconds, r.error) for r in rows if r.estimator == name] for name in ("factored", "reference")}
    )
    part = folder / ".accuracy.part.png"
    figure.savefig(part, dpi=150)
    part.replace(folder / "accuracy.png")
    write_json(folder / "accuracy.json", {**study.payload(), "seed": seed, "versions": versions()})
    return study


def _factored(bench: Bench, family: PatternFamily, judge: FloatArray, seed: int, progress: Progress) -> Iterator[Row]:
    labels, weights = family.classes()
    for accuracy in ACCURACIES:
        plan = make_plan(bench, labels, weights, accuracy, seed)
        # Once to compile and to warm caches, once to count.
        for _ in range(2):
            started = time.perf_counter()
            light = collect(bench, plan, labels, weights, seed, progress)
            frames, mc_error = _stack(light.frames(labels, weights, seed))
            seconds = time.perf_counter() - started
        yield Row("factored", f"accuracy {accuracy:g}", seconds, relative_error(frames, judge), mc_error)


def _reference(bench: Bench, family: PatternFamily, judge: FloatArray, seed: int, progress: Progress) -> Iterator[Row]:
    index = len(family.captures) // 2
    with projected(bench, family.light(family.captures[index])):
        reference(bench.loaded, SAMPLES[0], seed, progress)
        for spp in SAMPLES:
            started = time.perf_counter()
            found = reference(bench.loaded, spp, seed, progress)
            seconds = (time.perf_counter() - started) * len(family.captures)
            error = relative_error(found.mean[..., 0], judge[index])
            yield Row("reference", f"{spp} spp", seconds, error, found.mc_error)


def _stack(expected: ExpectedFrames) -> tuple[FloatArray, float]:
    """All frames (captures, pixels, pixels) and their Monte Carlo error."""
    found = list(expected)
    frames = np.stack([frame.irradiance for frame in found])
    if not frames.any():
        raise MitsimError("all frames are dark; nothing can be compared")
    noise = sum(frame.variance * frame.irradiance.size for frame in found)
    return frames, float(np.sqrt(noise / np.square(frames).sum()))
