"""Declarations and means of studies that are not on the engine yet; this module goes when they have moved."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

from mitsim.report.pages import Mean, Table
from mitsim.studies.framework.claims import mean_of
from mitsim.studies.framework.experiment import HEADS, Claim, Found, Point, Results, Scope
from mitsim.studies.framework.page import Part


def sample_mean(rows: Table, column: str) -> Mean:
    """Return the mean of a ``column``, as :func:`mitsim.studies.framework.claims.mean_of`."""
    return mean_of(Results(rows.rows).frame, column)


def difference(one: Table, other: Table, column: str, other_column: str | None = None) -> Mean:
    """Return the mean of paired differences.

    Parameters
    ----------
    one, other
        rows of the same prints and seeds.
    column, other_column
        column of ``one``, and of ``other`` if it has another name.
    """
    return mean_of(Results(one.rows).frame, column, Results(other.rows).frame, other_column or column)


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
    tables: Callable[[Results], Sequence[Part]] = lambda results: ()
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
