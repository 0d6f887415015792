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

What the solver's precision costs is no matter of the scene: `mitsim study solver`.
"""

from __future__ import annotations

import time
from dataclasses import replace

from mitsim.capture.bench import Bench
from mitsim.capture.request import Request
from mitsim.core.job import Job
from mitsim.study import plots
from mitsim.study.accuracy.findings import AccuracyFindings, Row
from mitsim.study.accuracy.judge import Judge
from mitsim.study.accuracy.orders import PARENT, Orders
from mitsim.study.accuracy.parts import Parts
from mitsim.study.accuracy.runs import Runs
from mitsim.study.knobs import Stand
from mitsim.study.spreads import Budget

ACCURACIES = (3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4)
"""Two steps a decade, from a first look to far below the sensor's noise."""
QUOTED = 1e-3
"""The default accuracy."""
BUDGET_S = 100.0
"""Seconds of the whole study on a quiet machine: with starting, opening and figures below two minutes."""
_JUDGE_PART, _FRONT_PART, _PARTS_PART, _ORDERS_PART = 0.12, 0.6, 0.6, 0.4
"""Of what is left, what the judge, one whole run, one look at all parts, and one at light by surfaces may take."""
_SHORTEST_LOOK_S = 1.0
"""Shorter looks tell more of kernels than of the machine's pace."""


def measure(bench: Bench, request: Request, job: Job) -> AccuracyFindings:
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
    started = time.perf_counter()
    looked = stand.look.seconds
    budget.saw(time.perf_counter() - started, max(looked, _SHORTEST_LOOK_S))
    judge = Judge.trace(stand, stand.plan(QUOTED), _JUDGE_PART * budget.left / budget.slower)
    runs, parts = Runs(stand, request, judge, sum(opening.values())), Parts(stand, judge)
    job.progress("whole runs", 0.3)
    runs.measure(ACCURACIES, budget, 1.0, whatever_it_takes=QUOTED)
    job.progress("parts", 0.4)
    parts.measure(budget, _PARTS_PART)
    orders = Orders(stand, judge, parts)
    orders.measure(budget, _ORDERS_PART)
    job.progress("whole runs", 0.6)
    runs.measure(ACCURACIES, budget, _FRONT_PART)
    job.progress("reference", 0.7)
    reference = list(judge.reference(budget))
    job.progress("repeats", 0.8)
    budget.repeat([*runs.timed, *parts.timed, *orders.timed])
    rows = _fronted(runs.rows)
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


def _fronted(rows: list[Row]) -> list[Row]:
    """Measured ``rows``, those marked that no other beats in both time and error."""
    front = plots.pareto_front([(row.spread.median, row.error) for row in rows])
    return [replace(row, on_front=(row.spread.median, row.error) in front) for row in rows]
