"""What a study declares: what varies, what is measured at each point, which claims and figures come of all points."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from mitsim.studies.framework.setup import Point, Setup

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mitsim.core.arrays import FloatArray
    from mitsim.report.table import Table, Value
    from mitsim.studies.framework.studio import Studio

IMAGE = "image"
"""The (n, n) reflectance that a point came to, where it is kept."""


@dataclass(frozen=True, eq=False)
class Found:
    """What one point came to: ``rows`` of the table, and ``arrays`` by name, such as :data:`IMAGE`, for figures."""

    rows: tuple[Mapping[str, Value], ...]
    arrays: Mapping[str, FloatArray] = field(default_factory=dict)


KNOBS = "{knobs}"
"""In the title of a study that sweeps: what varies."""
HEADS = "Paper", "Idealised", "Rendered"
"""Of the columns of a page's table of claims."""


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, its number there, in the idealised model and rendered, and what becomes of it.

    ``verdict`` is "confirmed", "confirmed only if ...", "not confirmed", or "not decided at this size"
    (:mod:`mitsim.studies.framework.verdicts`); what the paper does not say, or the idealised model does not have, is
    empty."""

    claim: str
    paper: str
    idealised: str
    rendered: str
    verdict: str

    def told(self, heads: tuple[str, str, str]) -> str:
        """All of its figures on a line, each by its own of the ``heads``."""
        figures = zip((self.paper, self.idealised, self.rendered), heads, strict=True)
        return ", ".join(f"{head.lower()} {figure}" for figure, head in figures if figure)


@dataclass(frozen=True)
class Scope:
    """How much of a study is wanted, and of what.

    Attributes
    ----------
    setup
        what is studied where nothing varies.
    pictures
        prints that means are taken over; (None,) where the scene keeps its own.
    seeds
        of the noise that means are taken over.
    quick
        a few points, for a first look.
    sweep, measures
        what `mitsim study sweep` varies, values by name, and what it shows; empty for other studies.
    patterns
        of a sweep that does not vary them, and of a drift.
    recipe
        of a calibration whose drift is studied; None: the shipped one.
    """

    setup: Setup
    pictures: tuple[str | None, ...]
    seeds: tuple[int, ...] = (0,)
    quick: bool = False
    sweep: tuple[tuple[str, tuple[str, ...]], ...] = ()
    measures: tuple[str, ...] = ()
    patterns: str = "dots:7"
    recipe: str | None = None

    @property
    def repeats(self) -> tuple[int, ...]:
        """Seeds of what has no prints to take means over: three of a whole study, so that its means have errors."""
        three = (self.seeds[0] + more for more in range(3))
        return self.chosen(tuple(dict.fromkeys((*self.seeds, *three))), self.seeds)

    def chosen(self, everything: Sequence[Any], few: Sequence[Any]) -> tuple[Any, ...]:
        """``few`` where the study is quick, otherwise ``everything``."""
        return tuple(few if self.quick else everything)


@dataclass(frozen=True, eq=False)
class Results:
    """All findings of a study.

    Attributes
    ----------
    table
        all points' rows; the column ``point`` has the points' keys.
    arrays
        by key of the point and name.
    measures
        the scope's.
    """

    table: Table
    arrays: Mapping[tuple[str, str], FloatArray] = field(default_factory=dict)
    measures: tuple[str, ...] = ()

    def array(self, row: Mapping[str, Value], name: str = IMAGE) -> FloatArray | None:
        """The array ``name`` that was kept with a ``row``."""
        return self.arrays.get((str(row["point"]), name))


@dataclass(frozen=True)
class PageTable:
    """A table on a study's page.

    Attributes
    ----------
    title
        above it: what the numbers are, with their unit.
    headings
        of its columns, the first of which has names and the others numbers.
    rows
        as they are shown.
    """

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Experiment:
    """A study of many points.

    Attributes
    ----------
    name, title, question
        on the command line, at the head of its page, and what it is to answer, a sentence.
    points
        from a scope to all points; those of one setup should follow each other.
    measure
        one point, in a studio that keeps what neighbours share.
    claims
        from all results.
    figures
        from all results, by file name; each has one message.
    about
        what its figures are, for who knows nothing of it; empty for claims of the paper, which the page explains.
    heads
        of a claim's three figures; one without a head has no column.
    tables
        from all results, for the page; all numbers are in the study's CSV and JSON as well.
    traced
        whether light is traced, to an accuracy that the page states.
    note
        what the reader of its figures has to know beside their titles and axes.
    """

    name: str
    title: str
    question: str
    points: Callable[[Scope], Sequence[Point]]
    measure: Callable[[Studio, Point], Found]
    claims: Callable[[Results], Sequence[Claim]]
    figures: Callable[[Results], Mapping[str, Figure]]
    tables: Callable[[Results], Sequence[PageTable]] = lambda results: ()
    about: str = ""
    heads: tuple[str, str, str] = HEADS
    note: str = ""
    traced: bool = True


def grouped(points: Sequence[Point]) -> list[Point]:
    """The ``points``, those of one setup together: they share its light."""
    order = {setup: index for index, setup in enumerate(dict.fromkeys(point.setup for point in points))}
    return sorted(points, key=lambda point: order[point.setup])
