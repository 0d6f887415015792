"""What a study declares: what varies, what is measured at each point, which claims and figures come of all points."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import prod
from typing import TYPE_CHECKING, Any

from mitsim.bench.request import Request
from mitsim.core.errors import MitsimError
from mitsim.devices.drift import Drift
from mitsim.devices.patterns import read_name
from mitsim.report import CONVENTIONS
from mitsim.studies import ALL, EXPERIMENTS, STUDIES
from mitsim.studies.framework.setup import Point, Setup

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mitsim.core.arrays import FloatArray
    from mitsim.report.pages import Table, Value
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
    (:mod:`mitsim.studies.framework.claims`); what the paper does not say, or the idealised model lacks, is empty.
    """

    claim: str
    paper: str
    idealised: str
    rendered: str
    verdict: str

    def figures_text(self, heads: tuple[str, str, str]) -> str:
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


def group_by_setup(points: Sequence[Point]) -> list[Point]:
    """The ``points``, those of one setup together: they share its light."""
    order = {setup: index for index, setup in enumerate(dict.fromkeys(point.setup for point in points))}
    return sorted(points, key=lambda point: order[point.setup])


def find_experiment(name: str) -> Experiment:
    """The experiment ``name``, a shipped one or a module of the user's with a dot in its name.

    MitsimError for another name, with those that there are, and for a module without an ``EXPERIMENT``.
    """
    if not is_experiment(name) or name == ALL:
        raise MitsimError(f"study {name!r}: there is no such study; use {', '.join((*STUDIES, *EXPERIMENTS))}")
    module = name if "." in name else f"mitsim.studies.{name}_study"
    try:
        found: Experiment = importlib.import_module(module).EXPERIMENT
    except (ImportError, AttributeError) as error:
        raise MitsimError(
            f"study {name}: the module {module} cannot be used ({error}); it needs an EXPERIMENT"
        ) from error
    return found


def is_experiment(name: str) -> bool:
    """Whether ``name`` is that of a study of many points."""
    return name in (*EXPERIMENTS, ALL) or "." in name


# -------- What a sweep varies and shows, in the words of a command line

MEASURES = {
    "psnr": ("psnr_db", "PSNR [dB]"),
    "ssim": ("ssim", "SSIM [1]"),
    "misfit": ("misfit", "misfit: part of the measurements that no image explains [1]"),
    "chi_square": ("chi_square", "chi-square of a measurement, 1 where the model fits [1]"),
    "uncertainty": ("uncertainty", "standard uncertainty, rms [reflectance]"),
    "lambda": ("lambda", "lambda, weight of the regularisation [(electrons/s)²]"),
}
"""Column of the table and axis, by what people ask for."""
NO_SCENE = ("patterns", "exposure", "seed", "accuracy")
"""What a sweep may vary besides parameters of the scene."""
OTHERS = {"point", "picture", "model", "shots", "exposure_s", "flagged", "reason", "lambda", "psnr_db", "ssim"} | {
    column for column, _ in MEASURES.values()
}
"""Columns of every study's table, which are no knob."""
_NOT_FINITE = re.compile(r"\s*[+-]?(nan|inf|infinity)\s*", re.IGNORECASE)
"""As Python and Mitsuba read them."""
_LISTED = ("patterns", "exposure", "seed")
"""Knobs whose values are a list, whatever stands between its commas."""
_MOST = 10_000
"""Points of one sweep: more are a typing error."""
Sweep = Sequence[tuple[str, Sequence[str]]]
"""Knobs and their values."""


def values_of(text: str) -> tuple[str, tuple[str, ...]]:
    """Name and values of a knob in ``text``: NAME=FIRST:LAST:COUNT, evenly spaced, or NAME=VALUE,VALUE,...

    MitsimError for anything else.
    """
    name, equals, given = text.partition("=")
    ends = given.split(":")
    if not (name and equals and given):
        raise MitsimError(f"--over {text!r}: give NAME=FIRST:LAST:COUNT or NAME=VALUE,VALUE")
    if name in _LISTED or len(ends) != 3:
        return name, tuple(given.split(","))
    try:
        first, last, count = float(ends[0]), float(ends[1]), int(ends[2])
    except ValueError:
        raise MitsimError(f"--over {text!r}: {given} is not FIRST:LAST:COUNT in numbers") from None
    if not 2 <= count <= _MOST:
        raise MitsimError(f"--over {text!r}: give 2 to {_MOST} values")
    return name, tuple(f"{first + (last - first) * index / (count - 1):.6g}" for index in range(count))


def measures_of(text: str) -> tuple[str, ...]:
    """Measures named in ``text``, separated by commas; MitsimError for one that there is not."""
    names = tuple(text.split(","))
    for name in names:
        if name not in MEASURES:
            raise MitsimError(f"--measure {name!r}: use {', '.join(MEASURES)}")
    return names


def check_sweep(sweep: Sweep, pictures: int) -> None:
    """MitsimError for a ``sweep`` over so many ``pictures`` that varies nothing, or what it cannot."""
    knobs = dict(sweep)
    if not knobs:
        raise MitsimError(
            "study sweep: nothing is varied; give --over NAME=FIRST:LAST:COUNT, such as roughness=0.1:0.5:5"
        )
    if taken := OTHERS.intersection(knobs):
        raise MitsimError(f"--over {taken.pop()}: is a column of every study's table; give the parameter another name")
    if (points := pictures * prod(len(values) for values in knobs.values())) > _MOST:
        raise MitsimError(f"study sweep: {points} points; give at most {_MOST}")
    for name, text in ((name, text) for name, texts in knobs.items() for text in texts):
        if _NOT_FINITE.fullmatch(text):
            raise MitsimError(f"--over {name}={text}: give finite numbers")
    for text in knobs.get("exposure", ()):
        if text not in CONVENTIONS:
            raise MitsimError(f"--over exposure={text}: use {', '.join(CONVENTIONS)}")
    for text in knobs.get("patterns", ()):
        read_name(text)
    for name, kind in (("seed", int), ("accuracy", float)):
        for text in knobs.get(name, ()):
            Request.of(**{name: number_of(name, text, kind)})


def check_drifts(sweep: Sweep) -> None:
    """MitsimError for a ``sweep`` of anything but kinds of drift and their amounts."""
    still = Drift(power_ripple_hz=1.0, lamp_ripple_hz=1.0)  # a recipe states them, which is not read yet
    for kind, texts in sweep:
        for text in texts:
            still.alone(kind, number_of(kind, text))


def number_of(knob: str, text: str, kind: type[int] | type[float] = float) -> float:
    """A value of a knob.

    Parameters
    ----------
    knob, text
        its name and the value, as they were given.
    kind
        of number.

    Raises
    ------
    MitsimError
        for what is no such number.
    """
    try:
        return kind(text)
    except ValueError:
        raise MitsimError(f"--over {knob}={text}: give {'whole ' if kind is int else ''}numbers") from None
