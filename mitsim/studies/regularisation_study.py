"""Tikhonov's closed form against least total variation, at the automatic and at the best weight: quality, time, memory.

Paper, supplement: TV-l1 images are not visibly better than those of the l2-regularised closed form.
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from mitsim.metrics import psnr
from mitsim.reconstruct.solvers import solve_tv
from mitsim.report import EQUAL_FRAME, MODELS, in_text, label
from mitsim.report.lit_scene import LAMBDAS
from mitsim.report.pages import Table, Value
from mitsim.report.plots import quality_bars
from mitsim.studies.framework import legacy as claims
from mitsim.studies.framework.experiment import Claim, Found, Point, Results, Scope
from mitsim.studies.framework.legacy import Experiment, Holds
from mitsim.studies.framework.studio import Studio, reason_of

FAMILIES = ("uniform", "dots:4", "dots:7")
_SHOWN = ("uniform", "dots:7")
TIKHONOV, TV = METHODS = ("tikhonov", "tv")
_NAMES = "Tikhonov", "total variation"
_WEIGHTS = tuple(float(weight) for weight in np.logspace(-1.5, 1.5, 7))
"""Around the automatic weight of the total variation: half a decade apart, which is 0.3 dB at the best of them."""
_COLUMNS = {"psnr_db": "automatic", "psnr_best_db": "best"}
"""Which weight, by column."""
_VISIBLE_DB = 1.0
"""A difference that may be seen: a fifth of the squared error."""


def _points(scope: Scope) -> Sequence[Point]:
    return Point.grid(
        map(scope.setup.with_print, scope.choose(scope.pictures, scope.pictures[:1])),
        "model patterns exposure seed method",
        seed=scope.seeds,
        patterns=scope.choose(FAMILIES, _SHOWN),
        model=MODELS,
        method=METHODS,
        exposure=(EQUAL_FRAME,),
    )


def _measure(studio: Studio, point: Point) -> Found:
    frames = studio.frames(point.setup, point["model"], point["patterns"], int(point["seed"]))
    model, sums = frames.data(frames.seconds(EQUAL_FRAME))
    truth, started = frames.lit.truth, time.perf_counter()
    if point["method"] == TIKHONOV:
        solution = model.solve(sums, "auto")
        seconds, scale = time.perf_counter() - started, model.problem(sums).scale
        others = (model.solve(sums, scale * factor).image for factor in LAMBDAS)
    else:
        solution = solve_tv(model, sums, "auto")
        seconds = time.perf_counter() - started
        others = (solve_tv(model, sums, solution.lam * weight).image for weight in _WEIGHTS)
    image, reason = solution.image, reason_of(solution.status)
    tracemalloc.start()
    one = next(others)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    best = max(psnr(each, truth) for each in (image, one, *others))
    measured: dict[str, Value] = {"psnr_db": psnr(image, truth), "psnr_best_db": best, "seconds": seconds}
    measured |= {"peak_mib": peak / 2**20, "flagged": bool(reason), "reason": reason}
    return claims.finding(studio, point, image if point["patterns"] in _SHOWN else None, **measured)


def _claims(results: Results) -> Sequence[Claim]:
    def faster(rows: Table) -> tuple[str, Holds]:
        plain, tv = (rows.where(method=method) for method in METHODS)
        costs = [f"{each.mean('seconds').value:.2g} s, {each.mean('peak_mib').value:.2g} MiB" for each in (plain, tv)]
        return " against ".join(costs), claims.within(claims.difference(plain, tv, "seconds"), high=0)

    table, plain, tv = results.table, {"method": TIKHONOV}, {"method": TV}
    alike = [
        claims.gain_claim(
            table.where(patterns=family),
            f"Total variation is as good (within {_VISIBLE_DB:g} dB), {in_text(family)}, {which} weight",
            "not visibly better", (tv, plain), "Tikhonov {other} dB, total variation {one} dB: {gain:+} dB",
            (-_VISIBLE_DB, _VISIBLE_DB), column,
        )
        for column, which in _COLUMNS.items()
        for family in _SHOWN
    ]  # fmt: skip
    return [*alike, claims.judge_claim(table, "The closed form takes less time than total variation", "less", faster)]


def _figures(results: Results) -> Mapping[str, Figure]:
    table, drawn = results.table, {}
    lines = {
        f"{label(family)}, {name}": table.where(patterns=family, method=method)
        for family in _SHOWN
        for method, name in zip(METHODS, _NAMES, strict=True)
    }
    for column, which in _COLUMNS.items():
        drawn[f"psnr_{which}.png"] = quality_bars(
            claims.bars(lines, column), f"PSNR by the regularisation, {which} weight, exposure {EQUAL_FRAME}"
        )
    title = f"{{}}, exposure {EQUAL_FRAME}, automatic weight"
    return drawn | claims.family_images(results, table, _SHOWN, "method", METHODS, title, _NAMES)


EXPERIMENT = Experiment(
    "regularisation",
    "Tikhonov or total variation",
    "Is an iterative, edge-preserving image worth its time?",
    _points, _measure, _claims, _figures,
    note="Automatic weight: chosen by the frames alone. Best weight: that of the highest PSNR, which only who has "
    "the truth can choose. Times are wall times on the machine that made this page, memory is the peak of one "
    "solution.",
)  # fmt: skip
