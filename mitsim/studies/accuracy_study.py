"""`mitsim study accuracy`: what accuracy costs in time, on one scene, within two minutes.

The whole study has BUDGET_S seconds. What is worth most comes first, what does not fit is left out and named, and what
is cheap is repeated:

1. the *judge*, one factored answer of its own seed with every effect of the scene and, where time allows, more anchors,
   layers and cells than the plans, that all errors are measured against (:mod:`.judge`);
2. a whole run of `mitsim capture` at the default accuracy, from opening the scene to the last file (:mod:`.runs`);
3. each effect, the anchors, layers, cells and the projector's lines left out in turn (:mod:`.parts`), and light over
   two, three, four and more surfaces where the plan follows it (:mod:`.orders`);
4. whole runs at other accuracies, and the reference on one frame, extrapolated to all;
5. repeats of all but the reference.

The time of the solver depends on no scene; `python benchmarks/solver.py --forms` measures it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import numpy as np

from mitsim.acquire.capture import capture
from mitsim.acquire.spectral import SpectralBench
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import present
from mitsim.bench.request import Request, Task
from mitsim.core.arrays import FloatArray
from mitsim.core.job import Job
from mitsim.core.runs import Capture
from mitsim.light.memory import frame_seconds
from mitsim.light.passes import PASSES
from mitsim.light.settings import Settings
from mitsim.report import plots
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.studies.accuracy_findings import AccuracyFindings, Budget, Row, Timed
from mitsim.studies.accuracy_parts import PARENT, Judge, Orders, Parts, Stand

ACCURACIES = (3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4)
"""Two steps a decade, from a first look to far below the sensor's noise."""
QUOTED = 1e-3
"""The default accuracy."""
BUDGET_S = 100.0
"""Seconds of the whole study on a quiet machine: with starting, opening and figures below two minutes."""
_JUDGE_PART, _FRONT_PART, _PARTS_PART, _ORDERS_PART = 0.12, 0.6, 0.6, 0.4
"""Of what is left, what the judge, one whole run, one look at all parts, and one at light by surfaces may take."""
_SHORTEST_PILOT_S = 1.0
"""Shorter looks tell more of kernels than of the machine's pace."""


def measure(bench: Apparatus, request: Request, job: Job) -> AccuracyFindings:
    """Error against time.

    MitsimError for patterns that do not fit, or a scene without light.

    Parameters
    ----------
    bench, request, job
        the scene, patterns and seed (accuracies are the study's own), and who is told how far the work is; seconds of
        its clock so far, of starting and opening the scene, count for every whole run.
    """
    budget = Budget(BUDGET_S)
    opening = {name: seconds for name, seconds in job.clock.seconds().items() if name in ("start", "open scene")}
    stand = Stand(bench, bench.family(request.patterns, request.seed), request.seed, job, QUOTED)
    job.progress("judge", 0.1)
    with job.clock.stage("judge"):
        started = time.perf_counter()
        looked = stand.pilot_runs.seconds
        budget.saw(time.perf_counter() - started, max(looked, _SHORTEST_PILOT_S))
        judge = Judge.trace(stand, stand.plan(QUOTED), _JUDGE_PART * budget.left / budget.slower)
    runs, parts = Runs(stand, request, judge, opening), Parts(stand, judge)
    job.progress("whole runs", 0.3)
    with job.clock.stage("whole runs"):
        runs.measure(ACCURACIES, budget, 1.0, whatever_it_takes=QUOTED)
    job.progress("parts", 0.4)
    orders = Orders(stand, judge, parts)
    with job.clock.stage("parts"):
        parts.measure(budget, _PARTS_PART)
        orders.measure(budget, _ORDERS_PART)
    job.progress("whole runs", 0.6)
    with job.clock.stage("whole runs"):
        runs.measure(ACCURACIES, budget, _FRONT_PART)
    job.progress("reference", 0.7)
    with job.clock.stage("reference"):
        reference = list(judge.reference(budget))
    job.progress("repeats", 0.8)
    with job.clock.stage("repeats"):
        budget.repeat([*runs.timed, *parts.timed, *orders.timed])
    rows = _mark_front(runs.rows)
    quoted = next(row for row in rows if QUOTED in row.accuracies)
    slow = reference[-1] if reference else None
    return AccuracyFindings(
        rows=(*rows, *reference, *([slow.reaching(quoted.error)] if slow else [])),
        effects=tuple(each for part in parts.costs for each in (part, *(orders.costs if part.name == PARENT else ()))),
        parts_accuracy=parts.accuracy,
        judge=judge.facts,
        sensor_noise=judge.sensor_noise,
        opening=opening,
        speedup_at_equal_error=slow.seconds_at(quoted.error) / runs.light_seconds(QUOTED) if slow else None,
        left_out=tuple(budget.left_out),
        quoted=QUOTED,
        took=budget.seconds - budget.left,
    )


def _mark_front(rows: list[Row]) -> list[Row]:
    """Measured ``rows``, those marked that no other beats in both time and error."""
    front = plots.pareto_front([(row.spread.median, row.error) for row in rows])
    return [replace(row, on_front=(row.spread.median, row.error) in front) for row in rows]


# -------- Whole runs of `mitsim capture`


@dataclass(frozen=True, eq=False)
class _Run:
    """One run and its repeats: the ``accuracies`` that lead to it, its frames' error, and seconds by stage."""

    accuracies: tuple[float, ...]
    timed: Timed
    stages: list[dict[str, float]]
    found: list[tuple[float, float]]


class Runs:
    """Whole runs at several accuracies, each measured at least once.

    Parameters
    ----------
    stand, request, judge
        scene and family, what else is asked of a run, and what its frames are held against.
    opening
        seconds that count for every run.
    """

    def __init__(self, stand: Stand, request: Request, judge: Judge, opening: Mapping[str, float]) -> None:
        self._stand, self._judge, self._opening = stand, judge, opening
        # Speckle is drawn anew in every frame and is no error of the light.
        off = {"speckle": False} if "speckle" in present(stand.bench) else {}
        self._request = request.with_values(effects={**request.effects, **off})
        self._runs: list[_Run] = []

    def measure(
        self, accuracies: Sequence[float], budget: Budget, share: float, whatever_it_takes: float | None = None
    ) -> None:
        """Run each of the ``accuracies`` once that fits and was not run; those that lead to the same settings are one.

        Parameters
        ----------
        accuracies
            all that the study knows: some of them may share their settings.
        budget, share
            time that is left, and the part of it that one run may take.
        whatever_it_takes
            run the group of this accuracy alone, and without asking for time.
        """
        known = {accuracy for run in self._runs for accuracy in run.accuracies}
        for group, predicted in sorted(self._groups(accuracies), key=lambda group: group[1]):
            first = whatever_it_takes in group
            if known.intersection(group) or (whatever_it_takes is not None and not first):
                continue
            name = f"accuracy {_list(group)}"
            if first or budget.allows(name, budget.slower * predicted, share):
                run = self._begin(group)
                run.timed.seconds.append(run.timed.again())
                self._runs.append(run)
                budget.saw(run.timed.spread.median, predicted)

    @property
    def timed(self) -> list[Timed]:
        """What can be repeated."""
        return [run.timed for run in self._runs]

    @property
    def rows(self) -> list[Row]:
        """Of all runs, the loosest first."""
        return [
            Row(
                "factored",
                "accuracy",
                f"accuracy {_list(run.accuracies)}",
                run.timed.spread + sum(self._opening.values()),
                *run.found[0],
                accuracies=run.accuracies,
                stages={**self._opening, **{name: median(each[name] for each in run.stages) for name in run.stages[0]}},
            )
            for run in sorted(self._runs, key=lambda run: -min(run.accuracies))
        ]

    def light_seconds(self, accuracy: float) -> float:
        """Seconds of transport and optics of the run at an ``accuracy``."""
        run = next(run for run in self._runs if accuracy in run.accuracies)
        return median(each["transport"] + each["optics"] for each in run.stages)

    def _groups(self, accuracies: Sequence[float]) -> Iterator[tuple[tuple[float, ...], float]]:
        """Accuracies by the settings that they lead to, and the seconds that a run of them is predicted to take."""
        groups: dict[Settings, list[float]] = {}
        lit: dict[Settings, float] = {}
        for accuracy in sorted(accuracies, reverse=True):
            plan = self._stand.plan(accuracy)
            # With the samples that are taken: parts of one are as good as a whole one.
            taken = {row.name: float(row.whole(row.predicted_samples(plan.settings))) for row in PASSES.values()}
            settings = replace(plan.settings, samples=taken)
            groups.setdefault(settings, []).append(accuracy)
            lit[settings] = plan.predicted_seconds
        around = self._stand.pilot_runs.seconds + sum(
            frame_seconds(self._stand.bench, len(self._stand.family.shots)).values()
        )
        for settings, group in groups.items():
            yield tuple(group), lit[settings] + around

    def _begin(self, accuracies: tuple[float, ...]) -> _Run:
        """A run at the tightest of its ``accuracies`` that was not made yet."""
        request = self._request.with_values(accuracy=min(accuracies))
        stages: list[dict[str, float]] = []
        found: list[tuple[float, float]] = []

        def again() -> float:
            """Seconds of the run."""
            job = Job()
            with TemporaryDirectory(prefix="mitsim-study-") as folder:
                task = Task(Path(folder) / "run", job=job)
                shots = capture(SpectralBench(self._stand.bench), request, task).runs[0]
                seconds = job.clock.seconds()
                if not found:
                    error = self._judge.error(self._irradiance(shots))
                    found.append((error, shots.manifest.mc_error or 0.0))
            total = seconds.pop("total")
            stages.append(seconds)
            return total

        return _Run(accuracies, Timed(again), stages, found)

    def _irradiance(self, shots: Capture) -> FloatArray:
        """(shots, pixels, pixels) expected irradiance that a capture was exposed to [W m^-2]."""
        devices = self._stand.bench.devices
        unit = electrons_from_irradiance(
            1.0, shots.exposure_s, devices.sensor, devices.projector.effective_wavelength_nm
        )
        return np.asarray(shots.electrons, dtype=np.float64) / unit


def _list(accuracies: Sequence[float]) -> str:
    return ", ".join(f"{accuracy:g}" for accuracy in accuracies)
