"""Tikhonov's closed form against least total variation, at the automatic and at the best weight: quality and time.

Paper, supplement: TV-l1 images are not visibly better than those of the l2-regularised closed form.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from mitsim.reconstruct.tv import solve_tv
from mitsim.study.charts import image_grid
from mitsim.study.compare import label
from mitsim.study.experiment import Claim, Experiment, Found, Point, Results, Scope, thumbnail
from mitsim.study.metrics import psnr
from mitsim.study.paper.measure import captioned, image_name, said
from mitsim.study.pictures import QUICK_IMAGES
from mitsim.study.plots import quality_bars
from mitsim.study.studio import EQUAL_FRAME, IDEALISED, LAMBDAS, MODELS, RENDERED, Studio
from mitsim.study.table import Value

FAMILIES = ("uniform", "dots:4", "dots:7")
TIKHONOV, TV = METHODS = ("tikhonov", "tv")
_WEIGHTS = tuple(float(weight) for weight in np.logspace(-1.5, 1.5, 7))
"""Around the automatic weight of the total variation: half a decade apart, which is 0.3 dB at the best of them."""
_VISIBLE_DB = 1.0
"""A gain that may be seen: a fifth of the squared error."""


def _points(scope: Scope) -> Sequence[Point]:
    return [
        Point.of(
            scope.setup.printed(name), model=model, patterns=family, exposure=EQUAL_FRAME, seed=seed, method=method
        )
        for name in scope.pictures
        for seed in scope.seeds
        for family in scope.chosen(FAMILIES, ("uniform", "dots:7"))
        for model in MODELS
        for method in METHODS
    ]


def _measure(studio: Studio, point: Point) -> Found:
    setup, model, seed = point.setup, point["model"], int(point["seed"])
    shoot, truth = studio.shoot(setup, model, point["patterns"], seed), studio.scene(setup).truth
    prepared, sums = shoot.data(studio.shoot(setup, model, "uniform", seed).peak_s)
    started = time.perf_counter()
    if point["method"] == TIKHONOV:
        image = prepared.solve(sums, "auto").image
        seconds, scale = time.perf_counter() - started, prepared.problem(sums).scale
        others = [prepared.solve(sums, scale * relative).image for relative in LAMBDAS]
    else:
        solution = solve_tv(prepared, sums, "auto")
        image, seconds = solution.image, time.perf_counter() - started
        others = [solve_tv(prepared, sums, solution.lam * weight).image for weight in _WEIGHTS]
    best = max([image, *others], key=lambda each: psnr(each, truth))
    row: dict[str, Value] = {"picture": setup.picture, **dict(setup.parameters), **dict(point.values)}
    row |= {"psnr_db": psnr(image, truth), "psnr_best_db": psnr(best, truth), "seconds": seconds}
    shown = setup.picture in (*QUICK_IMAGES, None) and point["patterns"] != "dots:4"
    return Found((row,), {image_name(row): thumbnail(image)} if shown else {})


def _claims(results: Results) -> Sequence[Claim]:
    table, claims = results.table, []
    for column, which in (("psnr_db", "automatic"), ("psnr_best_db", "best")):
        for family in ("uniform", "dots:7"):
            gain = {
                model: [table.mean(column, model=model, patterns=family, method=method) for method in (TIKHONOV, TV)]
                for model in MODELS
            }
            told = [f"{said(gain[model][0])} to {said(gain[model][1])}" for model in (IDEALISED, RENDERED)]
            holds = [model for model in MODELS if gain[model][1].value - gain[model][0].value < _VISIBLE_DB]
            verdict = "confirmed" if len(holds) == 2 else f"confirmed only {holds[0]}" if holds else "not confirmed"
            claim = f"Total variation is not visibly better, {label(family).lower()}, {which} weight"
            claims.append(Claim(claim, "not better", told[0], told[1], verdict))
    return claims


def _figures(results: Results) -> Mapping[str, Figure]:
    table, drawn = results.table, {}
    for column, which in (("psnr_db", "automatic"), ("psnr_best_db", "best")):
        bars = {
            f"{label(family)}, {method}": (
                table.mean(column, model=IDEALISED, patterns=family, method=method).value,
                table.mean(column, model=RENDERED, patterns=family, method=method).value,
            )
            for family in ("uniform", "dots:7")
            for method in METHODS
        }
        drawn[f"psnr_{which}.png"] = quality_bars(bars)
    for family in ("uniform", "dots:7"):
        if grid := captioned(results, "method", METHODS, patterns=family):
            drawn[f"images_{family.replace(':', '')}.png"] = image_grid(grid, ["Tikhonov", "total variation"])
    return drawn


EXPERIMENT = Experiment(
    name="regularisation",
    title="Tikhonov or total variation",
    question="Is an iterative, edge-preserving image worth its time?",
    points=_points,
    measure=_measure,
    claims=_claims,
    figures=_figures,
)
