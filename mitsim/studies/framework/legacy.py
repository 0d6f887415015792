"""Claims, figures and declarations of studies that are not on the engine yet; each that moves takes its part along."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mitsim.core.arrays import FloatArray
from mitsim.report import IDEALISED, MODELS, RENDERED, label
from mitsim.report.pages import Mean, Table, Value
from mitsim.report.plots import Curve, curves, image_grid
from mitsim.studies.framework.claims import (
    CONFIRMED,
    NOT_CONFIRMED,
    TOLERANCE_DB,
    UNDECIDED,
    Holds,
    every,
    verdict,
    verdict_at,
    within,
)
from mitsim.studies.framework.experiment import (
    HEADS,
    QUICK_IMAGES,
    TRUTH,
    Claim,
    Found,
    PageTable,
    Point,
    Results,
    Scope,
)
from mitsim.studies.framework.studio import finding, image_arrays, measure_image, single_precision

__all__ = [
    "CONFIRMED",
    "NOT_CONFIRMED",
    "UNDECIDED",
    "finding",
    "image_arrays",
    "measure_image",
    "single_precision",
    "verdict",
    "verdict_at",
]

Judge = Callable[[Table], tuple[str, Holds]]
"""From the rows of one model and exposure to what they say, and whether the claim holds for them."""


def sample_mean(rows: Table, column: str) -> Mean:
    """Mean of a ``column`` over prints, or over seeds of the noise where there is one print; MitsimError where the
    ``rows`` have no number."""
    return _mean(rows, rows, column, column, lambda one, _: one)


def difference(one: Table, other: Table, column: str, other_column: str | None = None) -> Mean:
    """Mean of paired differences, image by image.

    Parameters
    ----------
    one, other
        rows of the same prints and seeds.
    column, other_column
        of ``one``, and of ``other`` if it has another name.

    Raises
    ------
    MitsimError
        where no print, or no seed of the only one, is in both.
    """
    return _mean(one, other, column, other_column or column, lambda first, second: first - second)


def _mean(one: Table, other: Table, column: str, other_column: str, combine: Callable[[float, float], float]) -> Mean:
    prints = {row.get("picture") for row in (*one.rows, *other.rows)}
    by = "picture" if len(prints) > 1 else "seed"
    first, second = (_by(by, rows, name) for rows, name in ((one, column), (other, other_column)))
    return Mean.of_numbers([combine(value, second[key]) for key, value in first.items() if key in second], column)


def _by(by: str, rows: Table, column: str) -> dict[Value, float]:
    """Mean of a ``column`` for each value of another."""
    keys = dict.fromkeys(row.get(by) for row in rows.rows)
    return {key: rows.mean(column, **{by: key}).value for key in keys if rows.numbers(column, **{by: key})}


def judge_claim(table: Table, claim: str, paper: str, judge: Judge) -> Claim:
    """What becomes of a claim at each way of exposing, in each model.

    Parameters
    ----------
    table
        what was measured.
    claim, paper
        what the paper says.
    judge
        from the rows of one model and exposure: what they say, and whether the claim holds for them.
    """
    exposures: list[Value] = table.distinct("exposure") or [None]
    found = {
        (model, each): judge(table.where(model=model) if each is None else table.where(model=model, exposure=each))
        for model in MODELS
        for each in exposures
    }
    figures = {
        model: "; ".join(
            found[model, each][0] if len(exposures) == 1 else f"{each}: {found[model, each][0]}" for each in exposures
        )
        for model in MODELS
    }
    decided = verdict_at({str(each): every(*(found[model, each][1] for model in MODELS)) for each in exposures})
    if decided in (NOT_CONFIRMED, UNDECIDED):
        models = {model: every(*(found[model, each][1] for each in exposures)) for model in MODELS}
        holding = [model for model, holds in models.items() if holds]
        rest = [f", {other} {UNDECIDED}" for other, holds in models.items() if holds is None]
        decided = f"confirmed only {holding[0]}{''.join(rest)}" if holding else decided
    return Claim(claim, paper, figures[IDEALISED], figures[RENDERED], decided)


# -------- What experiments of the paper share

Lines = Mapping[str, Table]
"""Rows of a table by what they are called in a figure."""
Cell = tuple[FloatArray, FloatArray | None, str]
"""Of a grid of images: the image, the truth where it was kept, and a caption."""


def by_patterns(table: Table) -> Lines:
    """The rows of each pattern family in a ``table``."""
    return {label(name): table.where(patterns=name) for name in table.distinct("patterns")}


def panels(lines: Lines, by: str, column: str = "psnr_db") -> Mapping[str, Mapping[str, Curve]]:
    """Means of both models side by side.

    Parameters
    ----------
    lines
        rows by name.
    by, column
        columns: along the axis, and up.
    """
    return {
        model: {name: rows.where(model=model).means(column, by) for name, rows in lines.items()} for model in MODELS
    }


def by_print(table: Table) -> Lines:
    """The rows of a ``table`` of each shown print in both models."""
    return {
        f"{print_ or 'scene'}, {model}": table.where(picture=print_, model=model)
        for print_ in (*QUICK_IMAGES, None)
        for model in MODELS
    }


def image_rows(
    results: Results, lines: Lines, across: str, columns: Sequence[Value], caption: str = "{psnr_db:.1f} dB"
) -> dict[str, list[Cell]]:
    """Rows of an image grid, those of which all images were kept.

    Parameters
    ----------
    results
        with the images.
    lines
        rows of the table by the grid's.
    across, columns
        what varies along a row of the grid, and its values.
    caption
        of an image, from its row of the table.
    """
    grid = {}
    for name, rows in lines.items():
        cells = []
        for value in columns:
            cells += kept_images(results, rows.where(**{across: value}), caption)[:1]
        if len(cells) == len(columns):
            grid[name] = cells
    return grid


def kept_images(results: Results, rows: Table, caption: str = "{psnr_db:.1f} dB") -> list[Cell]:
    """Those of some rows whose images were kept.

    Parameters
    ----------
    results, rows
        with the images, and of which rows of their table.
    caption
        as for :func:`image_rows`; a flagged image says so.
    """
    kept = ((results.array(row), row) for row in rows.rows)
    return [
        (image, results.array(row, TRUTH), caption.format(**row) + ("\nflagged" if row.get("flagged") else ""))
        for image, row in kept
        if image is not None
    ]


def grid_with_truths(grid: Mapping[str, Sequence[Cell]], titles: Sequence[str], title: str) -> Figure:
    """Images with their truths: in a column before the others where each row has but one, else in rows above those
    that have new ones.

    Parameters
    ----------
    grid
        cells by the rows' names.
    titles, title
        of the columns, and of all.
    """
    truths = {name: [truth for _, truth, _ in cells if truth is not None] for name, cells in grid.items()}
    alone = {name: [(image, caption) for image, _, caption in cells] for name, cells in grid.items()}
    if any(len(truths[name]) < len(cells) for name, cells in grid.items()):
        return image_grid(alone, titles, title)
    if all(np.array_equal(own[0], other) for own in truths.values() for other in own):
        beside = {name: [(truths[name][0], ""), *cells] for name, cells in alone.items()}
        return image_grid(beside, ["truth", *titles], title)
    rows: dict[str, list[tuple[FloatArray, str]]] = {}
    before: Sequence[FloatArray] = ()
    several = any(not all(map(np.array_equal, one, other)) for one, other in pairwise(truths.values()))
    for name, cells in alone.items():
        if not before or not all(map(np.array_equal, before, truths[name])):
            rows[f"truth, {name}" if name and several else "truth"] = [(truth, "") for truth in truths[name]]
        rows[name or "image"], before = cells, truths[name]
    return image_grid(rows, titles, title)


def images(
    file: str,
    results: Results,
    lines: Lines,
    across: str,
    columns: Sequence[Value],
    title: str,
    names: Sequence[str] | None = None,
) -> dict[str, Figure]:
    """A grid of images by its file's name; empty where not all images of any row were kept.

    Parameters
    ----------
    file, title
        of the figure.
    results, lines, across, columns
        as for :func:`image_rows`.
    names
        of the columns; None: their values.
    """
    grid = image_rows(results, lines, across, columns)
    return {file: grid_with_truths(grid, names or [str(value) for value in columns], title)} if grid else {}


def family_images(
    results: Results,
    table: Table,
    families: Sequence[str],
    across: str,
    columns: Sequence[Value],
    title: str,
    names: Sequence[str] | None = None,
) -> dict[str, Figure]:
    """A grid of the images of each shown print in both models for each pattern family, by file name.

    Parameters
    ----------
    results, across, columns, names
        as for :func:`images`.
    table, families
        rows of the results, and which of their families have a grid.
    title
        of a grid; braces are its family.
    """
    drawn: dict[str, Figure] = {}
    for family in families:
        file, lines = f"images_{family.replace(':', '')}.png", by_print(table.where(patterns=family))
        drawn |= images(file, results, lines, across, columns, title.format(label(family)), names)
    return drawn


def by_exposure(
    table: Table, lines: Callable[[Table], Lines], by: str, axis: str, title: str, log: bool = False
) -> dict[str, Figure]:
    """PSNR in both models, a figure for each way of exposing.

    Parameters
    ----------
    table, lines
        what was measured, and from the rows of one exposure to rows by name.
    by, axis
        column along the axis, and the axis' name with its unit.
    title, log
        of each, but for the exposure; and whether the axis is logarithmic.
    """
    return {
        f"psnr_{exposure.replace(' ', '_')}.png": curves(
            panels(lines(table.where(exposure=exposure)), by), axis, log=log, title=f"{title}, exposure {exposure}"
        )
        for exposure in table.distinct("exposure")
    }


def psnr_claim(table: Table, claim: str, band: tuple[float, float]) -> Claim:
    """A claim of PSNR within a band.

    Parameters
    ----------
    table
        rows that it is said of.
    claim, band
        what the paper says [dB].
    """

    def judge(rows: Table) -> tuple[str, Holds]:
        mean = sample_mean(rows, "psnr_db")
        return f"{mean} dB", near(mean, band)

    return judge_claim(table, claim, f"{band[0]:g} to {band[1]:g} dB", judge)


def gain_claim(
    table: Table,
    claim: str,
    paper: str,
    pair: tuple[Mapping[str, Value], Mapping[str, Value]],
    text: str = "{gain:+} dB",
    between: tuple[float, float] = (0.0, math.inf),
    column: str = "psnr_db",
) -> Claim:
    """A claim of what some images have over others.

    Parameters
    ----------
    table
        rows of both.
    claim, paper
        what is claimed, and what the paper says.
    pair
        values of columns that choose the rows of the ones, and of the others.
    text
        what is said of them: ``one`` and ``other`` are their means, ``gain`` that of the paired differences.
    between, column
        range of the gain that the claim holds in, and what it is a gain of.
    """

    def judge(rows: Table) -> tuple[str, Holds]:
        one, other = (rows.where(**chosen) for chosen in pair)
        gain = difference(one, other, column)
        figures = text.format(gain=gain, one=sample_mean(one, column), other=sample_mean(other, column))
        return figures, within(gain, *between)

    return judge_claim(table, claim, paper, judge)


def near(psnr_db: Mean, band: tuple[float, float]) -> Holds:
    """Whether a mean ``psnr_db`` is within a ``band`` of the paper's [dB], or no more than TOLERANCE_DB beside it."""
    return within(psnr_db, band[0] - TOLERANCE_DB, band[1] + TOLERANCE_DB)


def bars(lines: Lines, column: str = "psnr_db") -> Mapping[str, tuple[Mean, Mean]]:
    """Means of a ``column`` in both models, by the names of ``lines``."""
    return {
        name: (rows.where(model=IDEALISED).mean(column), rows.where(model=RENDERED).mean(column))
        for name, rows in lines.items()
    }


@dataclass(frozen=True)
class Experiment:
    """A study whose claims and figures are functions; ``Study`` of the module ``experiment`` replaces it."""

    name: str
    title: str
    question: str
    points: Callable[[Scope], Sequence[Point]]
    measure: Callable[[Any, Point], Found]
    claims: Callable[[Results], Sequence[Claim]]
    figures: Callable[[Results], Mapping[str, Figure]]
    tables: Callable[[Results], Sequence[PageTable]] = lambda results: ()
    message: Callable[[Results], str] = lambda results: ""
    about: str = ""
    heads: tuple[str, str, str] = HEADS
    note: str = ""
    traced: bool = True
    kept: bool = False
    solved: bool = False

    def judge(self, results: Results) -> Sequence[Claim]:
        """Return all claims."""
        return self.claims(results)

    def draw(self, results: Results) -> Mapping[str, Figure]:
        """Return all figures by file name."""
        return self.figures(results)
