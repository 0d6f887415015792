"""Which patterns: uniform, random, shifting dots and repeated Hadamard, 1 to 64 of them, by three ways to expose them.

Paper, section IV-B and figure 4: singular values, and the mean PSNR of eight test images by the number of patterns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from matplotlib.figure import Figure

from mitsim.report import CONVENTIONS, EQUAL_FRAME, MODELS, RENDERED
from mitsim.report.charts import curves, image_grid
from mitsim.report.compare import label
from mitsim.report.lit_scene import DIM
from mitsim.report.plots import singular_values
from mitsim.report.table import Table
from mitsim.studies.framework.claims import (
    Holds,
    by_print,
    difference,
    imaged,
    judged,
    panels,
    pictured,
    stated,
    within,
)
from mitsim.studies.framework.experiment import Claim, Experiment, Found, Results, Scope
from mitsim.studies.framework.setup import Point
from mitsim.studies.framework.studio import Studio

FAMILIES = (
    "uniform", "random:2", "random:4", "random:5", "random:7", "random:8", "dots:2", "dots:3", "dots:4", "dots:5",
    "dots:6", "dots:7", "dots:8", "hadamard:2", "hadamard:4", "hadamard:8",
)  # fmt: skip
_FEW = ("uniform", "random:7", "dots:2", "dots:4", "dots:7", "dots:8", "hadamard:4", "hadamard:8")
_KINDS = {"dots": "shifting dots", "hadamard": "repeated Hadamard", "random": "random"}
_STATED = {"uniform": (21.0, 23.0), "dots:7": (34.0, 35.5)}
"""Decibels in the paper's figures 4 to 6, of one uniform pattern and of 49 dots, mask at 2000 um."""
_SHOWN = ("uniform", "random:7", "dots:4", "dots:7", "hadamard:8")
_SPECTRUM = "spectrum"
"""Squares of the left factor's singular values, of the calibrated camera with the family's patterns."""


def _points(scope: Scope) -> Sequence[Point]:
    return [
        Point.of(scope.setup.printed(name), model=model, patterns=family, exposure=exposure, seed=seed)
        for name in scope.pictures
        for seed in scope.seeds
        for family in scope.chosen(FAMILIES, _FEW)
        for exposure in (*scope.chosen(CONVENTIONS, CONVENTIONS[:2]), *((DIM,) if family in _STATED else ()))
        for model in MODELS
    ]


def _measure(studio: Studio, point: Point) -> Found:
    frames = studio.frames(point.setup, point["model"], point["patterns"], int(point["seed"]))
    made = imaged(studio, point, _SHOWN)
    count = frames.family.left.shape[1] * frames.family.right.shape[1]
    arrays = dict(made.arrays)
    if point["patterns"] in _SHOWN and point["model"] == RENDERED:
        arrays[_SPECTRUM] = frames.prepared().left.singular ** 2
    return replace(made, rows=tuple({**row, "patterns_count": count} for row in made.rows), arrays=arrays)


def _claims(results: Results) -> Sequence[Claim]:
    table = results.table
    families = Table(tuple(row for row in table.rows if row["exposure"] != DIM))
    return [
        stated(table.where(patterns="uniform"), "One uniform pattern gives 21 to 23 dB", _STATED["uniform"]),
        stated(table.where(patterns="dots:7"), "49 shifting dots give 34 to 35.5 dB", _STATED["dots:7"]),
        _better(families, "More dots, better images (49 against 4)", "dots:7", "dots:2"),
        _better(families, "Orthogonal patterns outperform random ones (49 each)", "dots:7", "random:7"),
        _better(families, "Hadamard patterns perform best, for their light (64 each)", "hadamard:8", "dots:8"),
    ]


def _better(table: Table, claim: str, better: str, other: str) -> Claim:
    """A claim that one family is ``better`` than an ``other``."""

    def judge(rows: Table) -> tuple[str, Holds]:
        gain = difference(rows.where(patterns=better), rows.where(patterns=other), "psnr_db")
        return f"{gain:+} dB", within(gain, low=0)

    return judged(table, claim, "higher", judge)


def _figures(results: Results) -> Mapping[str, Figure]:
    table, drawn = results.table, {}
    for exposure in (each for each in CONVENTIONS if each in table.distinct("exposure")):
        lines = {
            said: Table(tuple(row for row in table.where(exposure=exposure).rows if _is(row["patterns"], kind)))
            for kind, said in _KINDS.items()
        }
        drawn[f"psnr_{exposure.replace(' ', '_')}.png"] = curves(
            panels(lines, "patterns_count"), "patterns", title=f"PSNR by the number of patterns, exposure {exposure}"
        )
    spectra = {
        label(str(row["patterns"])): found for row in table.rows if (found := results.array(row, _SPECTRUM)) is not None
    }
    drawn["singular_values.png"] = singular_values(spectra)
    grid = pictured(results, by_print(table.where(exposure=EQUAL_FRAME)), "patterns", _SHOWN)
    if grid:
        drawn["images.png"] = image_grid(grid, [label(family) for family in _SHOWN], f"exposure {EQUAL_FRAME}")
    return drawn


def _is(patterns: object, kind: str) -> bool:
    """Whether ``patterns`` are of a ``kind``; one uniform pattern is the first of each."""
    return str(patterns).partition(":")[0] in (kind, "uniform")


EXPERIMENT = Experiment(
    "patterns",
    "Which patterns, and how many",
    "What do uniform, random, shifting-dots and Hadamard patterns recover, by their number and exposure?",
    _points, _measure, _claims, _figures,
)  # fmt: skip
