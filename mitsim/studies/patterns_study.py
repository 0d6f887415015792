"""Which patterns: uniform, random, shifting dots and repeated Hadamard, 1 to 64 of them, by three ways to expose them.

Paper, section IV-B and figure 4: singular values, and the mean PSNR of eight test images by the number of patterns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from matplotlib.figure import Figure

from mitsim.report import CONVENTIONS, EQUAL_FRAME, MODELS, RENDERED, label
from mitsim.report.lit_scene import DIM
from mitsim.report.pages import Table
from mitsim.report.plots import singular_values
from mitsim.studies.framework import claims
from mitsim.studies.framework.claims import Lines
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
    made = claims.measure_image(studio, point, _SHOWN)
    count = frames.family.left.shape[1] * frames.family.right.shape[1]
    arrays = dict(made.arrays)
    if point["patterns"] in _SHOWN and point["model"] == RENDERED:
        arrays[_SPECTRUM] = frames.prepared().left.singular ** 2
    return replace(made, rows=tuple({**row, "patterns_count": count} for row in made.rows), arrays=arrays)


def _claims(results: Results) -> Sequence[Claim]:
    table = results.table
    families = Table(tuple(row for row in table.rows if row["exposure"] != DIM))

    def better(claim: str, family: str, other: str) -> Claim:
        return claims.gain_claim(families, claim, "higher", ({"patterns": family}, {"patterns": other}))

    return [
        claims.psnr_claim(table.where(patterns="uniform"), "One uniform pattern gives 21 to 23 dB", _STATED["uniform"]),
        claims.psnr_claim(table.where(patterns="dots:7"), "49 shifting dots give 34 to 35.5 dB", _STATED["dots:7"]),
        better("More dots, better images (49 against 4)", "dots:7", "dots:2"),
        better("Orthogonal patterns outperform random ones (49 each)", "dots:7", "random:7"),
        better("Hadamard patterns perform best, for their light (64 each)", "hadamard:8", "dots:8"),
    ]


def _figures(results: Results) -> Mapping[str, Figure]:
    table = results.table

    def lines(rows: Table) -> Lines:
        """By kind; one uniform pattern is the first of each."""
        kinds = {kind: (kind, "uniform") for kind in _KINDS}
        return {
            _KINDS[kind]: Table(tuple(row for row in rows.rows if str(row["patterns"]).partition(":")[0] in of))
            for kind, of in kinds.items()
        }

    known = Table(tuple(row for row in table.rows if row["exposure"] in CONVENTIONS))
    drawn = dict(claims.by_exposure(known, lines, "patterns_count", "patterns", "PSNR by the number of patterns"))
    spectra = {
        label(str(row["patterns"])): found for row in table.rows if (found := results.array(row, _SPECTRUM)) is not None
    }
    drawn["singular_values.png"] = singular_values(spectra)
    shown, names = claims.by_print(table.where(exposure=EQUAL_FRAME)), [label(family) for family in _SHOWN]
    return drawn | claims.images("images.png", results, shown, "patterns", _SHOWN, f"exposure {EQUAL_FRAME}", names)


EXPERIMENT = Experiment(
    "patterns",
    "Which patterns, and how many",
    "What do uniform, random, shifting-dots and Hadamard patterns recover, by their number and exposure?",
    _points, _measure, _claims, _figures,
)  # fmt: skip
