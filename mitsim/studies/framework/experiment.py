"""Declaration of a study (axes, measurement of one point, claims, panels), and its results."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache, cached_property
from itertools import product
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsim.bench.request import AUTO, Request
from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import read_name
from mitsim.reconstruct.request import METHODS, TIKHONOV, ImageRequest
from mitsim.report import CONVENTIONS
from mitsim.studies import ALL, EXPERIMENTS, GONE, SHARED

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from mitsim.core.arrays import FloatArray
    from mitsim.report.pages import Value

# -------- Where a study measures: setups, points, axes

_KEY_DIGITS = 16
"""Digits of a point's name: two of 10^4 points collide with a probability of 10^-11."""


@dataclass(frozen=True)
class Setup:
    """A scene and its devices: points of one setup share its light and its calibration.

    Attributes
    ----------
    scene
        scene XML, or the name of a shipped scene.
    picture
        print that replaces the scene's own (:func:`mitsim.studies.framework.studio.picture`); None keeps it.
    parameters
        (name, value) of the scene's parameters.
    camera, projector, variant, outside
        as for :func:`mitsim.open_bench`; ``outside`` is its ``allow_outside_files``.
    accuracy
        requested relative error of the light.
    """

    scene: str = "photograph"
    picture: str | None = None
    parameters: tuple[tuple[str, str], ...] = ()
    camera: str | None = None
    projector: str | None = None
    variant: str = DEFAULT_VARIANT
    outside: bool = False
    accuracy: float = 1e-3

    def with_parameters(self, **parameters: object) -> Setup:
        new = {**dict(self.parameters), **{name: f"{value}" for name, value in parameters.items()}}
        return replace(self, parameters=tuple(sorted(new.items())))


@dataclass(frozen=True)
class Point:
    """One measurement of a study: its ``setup``, and the ``values`` of everything else that varies, by name."""

    setup: Setup
    values: tuple[tuple[str, Value], ...]

    @classmethod
    def of(cls, setup: Setup, **values: Value) -> Point:
        return cls(setup, tuple(values.items()))

    def __getitem__(self, name: str) -> Any:
        return dict(self.values)[name]

    def row(self, **measured: Value) -> dict[str, Value]:
        return {"picture": self.setup.picture, **dict(self.setup.parameters), **dict(self.values), **measured}

    @property
    def key(self) -> str:
        text = json.dumps(asdict(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:_KEY_DIGITS]


@dataclass(frozen=True)
class Scope:
    """The measured part of a study, and its scene.

    Attributes
    ----------
    setup
        scene and devices where nothing varies.
    pictures
        prints to average over; (None,) where the scene keeps its own.
    seeds
        seeds of the noise to average over.
    quick
        True for a few points, as a first look.
    sweep, measures
        knobs of `mitsim study sweep` with their values, and the shown measures; empty for other studies.
    patterns
        patterns of a sweep that does not vary them, and of a drift.
    recipe
        recipe of a calibration whose drift is studied; None: the shipped one.
    data
        folder of real captures.
    style
        style of the figures.
    """

    setup: Setup
    pictures: tuple[str | None, ...]
    seeds: tuple[int, ...] = (0,)
    quick: bool = False
    sweep: tuple[tuple[str, tuple[str, ...]], ...] = ()
    measures: tuple[str, ...] = ()
    patterns: str = "dots:7"
    recipe: str | None = None
    data: str | None = None
    style: str = "screen"

    @property
    def repeats(self) -> tuple[int, ...]:
        three = (self.seeds[0] + more for more in range(3))
        return self.choose(tuple(dict.fromkeys((*self.seeds, *three))), self.seeds)

    def choose(self, everything: Sequence[Any], few: Sequence[Any]) -> tuple[Any, ...]:
        return tuple(few if self.quick else everything)


@dataclass(frozen=True)
class Axes:
    """Points of a study on a grid: all combinations of scenes, prints, seeds and ``values``.

    Attributes
    ----------
    values
        values by name, such as patterns, exposure and model; the last name varies fastest.
    scene
        values of scene parameters by name; each combination is a setup with light of its own.
    quick
        values that replace those of ``values`` or ``scene`` in a quick study.
    prints
        pictures on the print; None: those of the scope.
    quick_prints
        number of prints of a quick study; None: all of the scope's.
    repeats
        True for three seeds (:attr:`Scope.repeats`), for studies whose means are over seeds.
    default
        shipped scene of a study whose user names none; None: that of the scope.
    kept
        chooses the combinations that are points, from their values by name; None: all.
    """

    values: Mapping[str, Sequence[Value]]
    scene: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    quick: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    prints: Sequence[str | None] | None = None
    quick_prints: int | None = None
    repeats: bool = False
    default: str | None = None
    kept: Callable[[Mapping[str, Value]], bool] | None = None

    def __call__(self, scope: Scope) -> list[Point]:
        def chosen(name: str, everything: Sequence[Any]) -> tuple[Any, ...]:
            return scope.choose(everything, self.quick.get(name, everything))

        def combinations(axes: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
            each = product(*(chosen(name, values) for name, values in axes.items()))
            return [dict(zip(axes, values, strict=True)) for values in each]

        prints = chosen("picture", self.prints or scope.pictures)
        prints = scope.choose(prints, prints[: self.quick_prints])
        own = self.default is None or scope.pictures == (None,)
        setup = scope.setup if own else replace(scope.setup, scene=str(self.default))
        setups = [
            replace(setup, picture=name).with_parameters(**parameters)
            for parameters in combinations(self.scene)
            for name in prints
        ]
        points = [
            Point.of(each, **values, seed=seed)
            for each in setups
            for seed in (scope.repeats if self.repeats else scope.seeds)
            for values in combinations(self.values)
        ]
        return [point for point in points if self.kept is None or self.kept(dict(point.values))]


# -------- Results

IMAGE = "image"
TRUTH = "truth"


@dataclass(frozen=True, eq=False)
class Found:
    """Findings of one point: ``rows`` of the table, and ``arrays`` by name, such as :data:`IMAGE`, for figures."""

    rows: tuple[Mapping[str, Value], ...]
    arrays: Mapping[str, FloatArray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Results:
    """All findings of a study.

    Attributes
    ----------
    rows
        rows of all points as JSON has them; the column ``point`` holds the points' keys.
    arrays
        arrays by key of the point and name.
    """

    rows: Sequence[Mapping[str, Value]]
    arrays: Mapping[tuple[str, str], FloatArray] = field(default_factory=dict)
    scope: Scope = field(default_factory=lambda: Scope(Setup(), (None,)))

    @cached_property
    def frame(self) -> DataFrame:
        from pandas import DataFrame  # here, because it takes half a second and processes that measure do without

        return DataFrame([dict(row) for row in self.rows], dtype=object)

    def array(self, row: Mapping[str, Value], name: str = IMAGE) -> FloatArray | None:
        return self.arrays.get((str(row.get("point")), name))


# -------- Declaration of a study

TEST_IMAGES = ("astronaut", "camera", "chelsea", "coffee", "coins", "rocket", "page", "brick")
"""Images of scikit-image, which states their licences; the paper does not name the eight of its means."""
QUICK_IMAGES = ("chelsea", "page")
KNOBS = "{knobs}"
HEADS = "Paper", "Idealised", "Rendered"


@dataclass(frozen=True)
class Claim:
    """A judged claim: its sentence, the paper's figure, the figures of both models, and the verdict.

    ``verdict`` is "confirmed", "confirmed only ...", "not confirmed", or "not decided at this size"; a missing figure
    is empty.
    """

    claim: str
    paper: str
    idealised: str
    rendered: str
    verdict: str


@dataclass(frozen=True)
class Study:
    """A study of many points.

    Attributes
    ----------
    name, title, question
        name on the command line, head of the page, and the question that the study answers.
    points
        function from a scope to all points, such as :class:`Axes`; points of one setup should follow each other.
    measure
        measures one point, in a :class:`mitsim.studies.framework.studio.Studio`.
    claims
        claims with thresholds (:mod:`mitsim.studies.framework.claims`), or functions from all results to judged claims.
    panels
        figures (:mod:`mitsim.studies.framework.panels`), or functions from all results to figures by file name.
    tables
        tables of the page (:class:`mitsim.studies.framework.panels.Pivot`), or functions from all results to its parts.
    about
        method of measurement; empty for claims of the paper, which the page explains.
    heads
        heads of a claim's three figures; a figure without a head has no column.
    note
        remarks on the figures.
    traced
        True if light is traced, to an accuracy that the page states.
    kept
        True to keep plans, calibrations and other shared objects in the study's folder, so that any process can measure
        any point.
    """

    name: str
    title: str
    question: str
    points: Callable[[Scope], Sequence[Point]]
    measure: Callable[[Any, Point], Found]
    claims: Sequence[Any] = ()
    panels: Sequence[Any] = ()
    tables: Sequence[Any] = ()
    about: str = ""
    heads: tuple[str, str, str] = HEADS
    note: str = ""
    traced: bool = True
    kept: bool = False

    def judge(self, results: Results) -> list[Claim]:
        return [claim for each in self.claims for claim in (each(results) if callable(each) else each.judge(results))]

    def draw(self, results: Results) -> dict[str, Figure]:
        drawn = [each(results) if callable(each) else each.draw(results) for each in self.panels]
        return {file: figure for figures in drawn for file, figure in figures.items()}

    def parts(self, results: Results) -> list[Any]:
        parts = (each(results) if callable(each) else each.draw(results).values() for each in self.tables)
        return [part for own in parts for part in own]


def group_by_setup(points: Sequence[Point]) -> list[Point]:
    """Return ``points`` with those of one setup together, because they share its light."""
    order = {setup: index for index, setup in enumerate(dict.fromkeys(point.setup for point in points))}
    return sorted(points, key=lambda point: order[point.setup])


@cache
def find_experiment(name: str) -> Study:
    """Return the study ``name``: a shipped one, or a user's file or dotted module; MitsimError for another."""
    check_study(name)
    module = name if "." in name else f"mitsim.studies.{SHARED.get(name, f'{name}_study')}"
    try:
        if module.endswith(".py"):
            spec = importlib.util.spec_from_file_location(f"mitsim_study_{Path(module).stem}", module)
            assert spec is not None and spec.loader is not None, "a file of Python has a loader"
            loaded: Any = importlib.util.module_from_spec(spec)
            sys.modules[spec.name] = loaded  # dataclasses of the file look for it there
            spec.loader.exec_module(loaded)
        else:
            loaded = importlib.import_module(module)
        found: Study = loaded.STUDIES[name] if name in SHARED else loaded.STUDY
    except (ImportError, AttributeError, OSError, SyntaxError) as error:
        raise MitsimError(
            f"study {name}: the module {module} cannot be used ({error}); it needs a STUDY, as "
            "`mitsim new study NAME` writes one"
        ) from error
    return found


def check_study(name: str) -> None:
    """Raise MitsimError for an unknown ``name``."""
    if name in GONE:
        raise MitsimError(f"study {name}: is no study of its own any more; use `mitsim {GONE[name]}`")
    if name not in (*EXPERIMENTS, ALL) and "." not in name:
        raise MitsimError(f"study {name!r}: there is no such study; use {', '.join(EXPERIMENTS)}")


# -------- Knobs and measures of a sweep, in the words of a command line

MEASURES = {
    "psnr": ("psnr_db", "PSNR [dB]"),
    "ssim": ("ssim", "SSIM [1]"),
    "misfit": ("misfit", "misfit: part of the measurements that no image explains [1]"),
    "chi_square": ("chi_square", "chi-square of a measurement, 1 where the model fits [1]"),
    "uncertainty": ("uncertainty", "standard uncertainty, rms [reflectance]"),
    "lambda": ("lambda", "lambda, weight of the regularisation [(electrons/s)²]"),
    "seconds": ("seconds", "time of the solution [s]"),
}
ASKED = "asked_lambda"
"""Knob and column of the requested lambda, beside the column of the lambda that was used."""
NO_SCENE = ("patterns", "exposure", "seed", "accuracy", "method", ASKED)
"""Knobs of a sweep that are no parameters of the scene."""
OTHERS = {"point", "picture", "model", "shots", "exposure_s", "flagged", "reason", *(c for c, _ in MEASURES.values())}
"""Columns of every study's table that are no knob."""
_MOST = 10_000
"""Most points of one sweep: more are a typing error."""
Sweep = Sequence[tuple[str, Sequence[str]]]


def values_of(text: str) -> tuple[str, tuple[str, ...]]:
    """Return name and values of a knob: NAME=FIRST:LAST:COUNT, evenly spaced, or NAME=VALUE,VALUE,...

    MitsimError for anything else.
    """
    name, equals, given = text.partition("=")
    ends = given.split(":")
    if not (name and equals and given):
        raise MitsimError(f"--over {text!r}: give NAME=FIRST:LAST:COUNT or NAME=VALUE,VALUE")
    if name in ("patterns", "exposure", "seed", "method") or len(ends) != 3:
        return name, tuple(given.split(","))
    try:
        first, last, count = float(ends[0]), float(ends[1]), int(ends[2])
    except ValueError:
        raise MitsimError(f"--over {text!r}: {given} is not FIRST:LAST:COUNT in numbers") from None
    if not 2 <= count <= _MOST:
        raise MitsimError(f"--over {text!r}: give 2 to {_MOST} values")
    return name, tuple(f"{first + (last - first) * index / (count - 1):.6g}" for index in range(count))


def check_sweep(sweep: Sweep, pictures: int) -> None:
    """Raise MitsimError for a ``sweep`` that varies nothing, or an impossible knob."""
    knobs, allowed = dict(sweep), {"exposure": CONVENTIONS, "method": METHODS}
    if len(knobs) < len(sweep):
        raise MitsimError("study sweep: something is varied twice; give all its values at once")
    if not knobs:
        raise MitsimError(
            "study sweep: nothing is varied; give --over NAME=FIRST:LAST:COUNT, such as roughness=0.1:0.5:5"
        )
    if taken := OTHERS.intersection(knobs):
        raise MitsimError(f"--over {taken.pop()}: is a column of every study's table; give the parameter another name")
    if (points := pictures * prod(len(values) for values in knobs.values())) > _MOST:
        raise MitsimError(f"study sweep: {points} points; give at most {_MOST}")
    for name, text in ((name, text) for name, texts in knobs.items() for text in texts):
        if re.fullmatch(r"\s*[+-]?(nan|inf|infinity)\s*", text, re.IGNORECASE):  # as Python and Mitsuba read them
            raise MitsimError(f"--over {name}={text}: give finite numbers")
        if text not in allowed.get(name, (text,)):
            raise MitsimError(f"--over {name}={text}: use {', '.join(allowed[name])}")
        if name == "patterns":
            read_name(text)
        elif name in ("seed", "accuracy"):
            Request.of(**{name: number_of(name, text, int if name == "seed" else float)})
    for method, lam in product(knobs.get("method", (TIKHONOV,)), knobs.get(ASKED, (AUTO,))):
        number: Any = lam if lam == AUTO else number_of("lambda", lam)
        ImageRequest(method=method, lam=number)


def number_of(knob: str, text: str, kind: type[int] | type[float] = float) -> float:
    """Return a number of a ``kind``; MitsimError for anything else."""
    try:
        return kind(text)
    except ValueError:
        raise MitsimError(f"--over {knob}={text}: give {'whole ' if kind is int else ''}numbers") from None
