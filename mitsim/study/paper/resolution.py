"""How fine: bars of 0.13 to 0.6 line pairs a mm under 9, 16 and 49 patterns, and the transfer of a slanted edge.

The paper takes (I_max - I_min) / (I_max + I_min) of the mean along the bars, of which noise alone makes 0.2 to
0.5: it is in the table as `contrast_of_extremes`; figure and verdicts take the contrast at the bars' own frequency.

Paper, section V-C and figure 11. Pixels of the image are 0.9375 mm, so 0.533 line pairs a mm are the most there can be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from matplotlib.figure import Figure

from mitsim.study.charts import curves, image_grid
from mitsim.study.compare import label
from mitsim.study.experiment import Claim, Experiment, Found, Point, Results, Scope, thumbnail
from mitsim.study.paper.measure import image_name
from mitsim.study.studio import EQUAL_FRAME, IDEALISED, MODELS, RENDERED, Studio
from mitsim.study.table import Mean, Table, Value
from mitsim.study.transfer import contrast, modulation, slanted_edge

PAIRS_A_MM = (0.13, 0.17, 0.21, 0.26, 0.35, 0.43, 0.52, 0.6)
"""The paper's groups 20 to 5, and one that no pixel of 0.9375 mm can tell."""
FAMILIES = ("uniform", "dots:3", "dots:4", "dots:7")
PIXEL_MM = 120 / 128
"""Of the image, on the print: 120 mm of it are lit."""
_TOLD = 0.1
"""Contrast below which bars are not told apart: what the eye needs of a print."""
_SEEN = slice(16, -16)
"""Pixels that are looked at: the margin is beside the bars of the sheet's other half, or beyond the print."""
_FINEST = 0.52  # the paper's group 5


def _points(scope: Scope) -> Sequence[Point]:
    pairs = scope.chosen(PAIRS_A_MM, (0.13, 0.26, 0.52))
    prints = [f"bars {each:g}" for each in pairs] + ["edge"]
    return [
        Point.of(scope.setup.printed(name), model=model, patterns=family, exposure=EQUAL_FRAME, seed=seed)
        for name in prints
        for seed in scope.seeds
        for family in scope.chosen(FAMILIES, ("uniform", "dots:7"))
        for model in MODELS
    ]


def _measure(studio: Studio, point: Point) -> Found:
    name, values = str(point.setup.picture), dict(point.values)
    found = studio.image(point.setup, point["model"], point["patterns"], int(point["seed"]), EQUAL_FRAME)
    row: dict[str, Value] = {"picture": name, **dict(point.setup.parameters), **values, **found.row()}
    kind, _, frequency = name.partition(" ")
    if kind == "edge":
        cycles, transfer = slanted_edge(found.image[_SEEN, _SEEN])
        rows = [
            {**row, "pairs_a_mm": float(each) / PIXEL_MM, "transfer": float(value)}
            for each, value in zip(cycles, transfer, strict=True)
        ]
        return Found(tuple(rows))
    left, right = np.split(found.image, 2, axis=1)
    halves = (left[_SEEN, 8:-8], 0), (right[_SEEN, 8:-8], 1)
    own = float(frequency) * PIXEL_MM
    row |= {
        "pairs_a_mm": float(frequency),
        "contrast": float(np.mean([modulation(*half, own) for half in halves])),
        "contrast_of_extremes": float(np.mean([contrast(*half) for half in halves])),
    }
    return Found((row,), {image_name(row): thumbnail(found.image)})


def _claims(results: Results) -> Sequence[Claim]:
    bars = results.table
    finest = {model: {family: _limit(bars, model, family) for family in bars.distinct("patterns")} for model in MODELS}
    counts = [family for family in bars.distinct("patterns") if family != "uniform"]
    order = ["uniform", *counts]
    rises = [all(finest[model][a] <= finest[model][b] for a, b in pairwise(order)) for model in MODELS]
    told = [
        ", ".join(f"{label(family).lower()} {finest[model][family]:g}" for family in order)
        for model in (IDEALISED, RENDERED)
    ]
    kept = [
        f"contrast {bars.mean('contrast', model=model, patterns='dots:7', pairs_a_mm=_FINEST).value:.2f}"
        for model in (IDEALISED, RENDERED)
    ]
    full = all(finest[model]["dots:7"] >= _FINEST for model in MODELS)
    return [
        Claim(
            "Resolution rises with the number of patterns (finest bars of 10 % contrast, line pairs a mm)", "rises",
            told[0], told[1], "confirmed" if all(rises) else "not confirmed",
        ),
        Claim(
            "49 patterns tell 0.52 line pairs a mm apart", "told apart",
            kept[0], kept[1], "confirmed" if full else "not confirmed",
        ),
    ]  # fmt: skip


def _limit(bars: Table, model: str, family: str) -> float:
    """Finest bars up to which all are told apart; 0 for none."""
    limit = 0.0
    for pairs in sorted(bars.where(model=model, patterns=family).distinct("pairs_a_mm")):
        rows = bars.where(model=model, patterns=family, pairs_a_mm=pairs)
        if not rows.numbers("contrast"):
            continue
        if rows.mean("contrast").value < _TOLD:
            break
        limit = float(pairs)
    return limit


def _figures(results: Results) -> Mapping[str, Figure]:
    table, drawn = results.table, {}
    for column, file, axis in (("contrast", "contrast", "contrast [1]"), ("transfer", "edge", "transfer [1]")):
        panels = {}
        for model in MODELS:
            shown = {}
            for family in table.distinct("patterns"):
                own = table.where(model=model, patterns=family)
                found: dict[float, Mean] = {}
                for pairs in sorted(own.distinct("pairs_a_mm")):
                    at = own.where(pairs_a_mm=pairs)
                    if at.numbers(column):
                        found[float(pairs)] = at.mean(column)
                shown[label(family)] = found
            panels[model] = shown
        drawn[f"{file}.png"] = curves(panels, "line pairs a mm of the print", axis, ticks=False)
    names = [str(name) for name in table.distinct("picture") if str(name).startswith("bars")]
    grid = {
        f"{label(family)}, {model}": [
            (results.images[image_name(row)], f"contrast {row['contrast']:.2f}")
            for name in names
            for row in table.where(model=model, patterns=family, picture=name).rows[:1]
        ]
        for family in table.distinct("patterns")
        for model in MODELS
    }
    if names:
        drawn["images.png"] = image_grid(grid, [name.replace("bars ", "") for name in names])
    return drawn


EXPERIMENT = Experiment(
    name="resolution",
    title="How fine",
    question="Which bars are told apart, and how much contrast does an edge keep?",
    points=_points,
    measure=_measure,
    claims=_claims,
    figures=_figures,
)
