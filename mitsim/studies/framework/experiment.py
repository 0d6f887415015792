"""What a study declares: what varies, what is measured at each point, which claims and figures come of all points.

The paper's means are over eight images, which it does not name. Those here come with scikit-image, which states their
licences.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from itertools import product
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsim.bench.request import Request
from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import read_name
from mitsim.devices.session import Drift
from mitsim.report import CONVENTIONS
from mitsim.studies import ALL, EXPERIMENTS, SHARED, STUDIES

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    from matplotlib.figure import Figure

    from mitsim.core.arrays import FloatArray
    from mitsim.report.pages import Table, Value

# -------- Where a study measures: setups, whose points share light and calibration, and points

_KEY_DIGITS = 16
"""Of a point's name: two of 10^4 points have the same with a chance of 10^-11."""


@dataclass(frozen=True)
class Setup:
    """What light is traced for and a camera calibrated: points that share one share its light.

    Attributes
    ----------
    scene
        scene XML, or the name of a shipped scene.
    picture
        print that the scene's own is replaced with (:func:`picture`); None: its own.
    parameters
        (name, value) of the scene's parameters.
    camera, projector, variant, outside
        as for :func:`mitsim.open_bench`; ``outside`` is its ``allow_outside_files``.
    accuracy
        of the light.
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
        """The same with other ``parameters`` of the scene."""
        new = {**dict(self.parameters), **{name: f"{value}" for name, value in parameters.items()}}
        return replace(self, parameters=tuple(sorted(new.items())))

    def with_print(self, picture: str | None) -> Setup:
        """The same with another ``picture`` on its print."""
        return replace(self, picture=picture)


@dataclass(frozen=True)
class Point:
    """One measurement of a study: its ``setup``, and the ``values`` of all else that varies, by name."""

    setup: Setup
    values: tuple[tuple[str, Value], ...]

    @classmethod
    def of(cls, setup: Setup, **values: Value) -> Point:
        """Of a ``setup``, with these ``values``."""
        return cls(setup, tuple(values.items()))

    @classmethod
    def grid(cls, setups: Iterable[Setup], columns: str, **varied: Sequence[Value]) -> list[Point]:
        """All combinations of what varies, the last fastest, at each of some ``setups``.

        Parameters
        ----------
        setups, columns
            where, and names of the values in the order in which the table has them.
        **varied
            values by name; what is fixed has one.
        """
        names = columns.split()
        chosen = [dict(zip(varied, values, strict=True)) for values in product(*varied.values())]
        return [cls.of(setup, **{name: values[name] for name in names}) for setup in setups for values in chosen]

    def __getitem__(self, name: str) -> Any:
        return dict(self.values)[name]

    def row(self, **measured: Value) -> dict[str, Value]:
        """A row of the table: all that varies, and what was ``measured``."""
        return {"picture": self.setup.picture, **dict(self.setup.parameters), **dict(self.values), **measured}

    @property
    def key(self) -> str:
        """Name of the file that keeps its findings."""
        text = json.dumps(asdict(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:_KEY_DIGITS]


# -------- What a study declares

_PYTHON = ".py"
"""End of the name of a study in a file."""
IMAGE = "image"
"""The (n, n) reflectance that a point came to, where it is kept."""
TRUTH = "truth"
"""What it would be without any error, kept with it."""


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
        return self.choose(tuple(dict.fromkeys((*self.seeds, *three))), self.seeds)

    def choose(self, everything: Sequence[Any], few: Sequence[Any]) -> tuple[Any, ...]:
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
    scope
        of the study.
    """

    table: Table
    arrays: Mapping[tuple[str, str], FloatArray] = field(default_factory=dict)
    scope: Scope = field(default_factory=lambda: Scope(Setup(), (None,)))

    def array(self, row: Mapping[str, Value], name: str = IMAGE) -> FloatArray | None:
        """The array ``name`` that was kept with a ``row``."""
        return self.arrays.get((str(row.get("point")), name))


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
        one point, in a :class:`mitsim.studies.framework.studio.Studio`, which keeps what neighbours share.
    claims
        from all results.
    figures
        from all results, by file name; each has one message.
    message
        from all results, what its page says first, beside how many claims hold; empty for those alone.
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
    solved
        whether all points have patterns whose frames are solved with an automatic lambda, which needs more data than
        unknowns: points without are refused before any is measured.
    kept
        whether what points share is kept in the study's folder: plans, calibrations, and what else a studio makes once.
        A process may then measure any point, whatever its setup, and an interrupted study loses none of it.
    """

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


def group_by_setup(points: Sequence[Point]) -> list[Point]:
    """The ``points``, those of one setup together: they share its light."""
    order = {setup: index for index, setup in enumerate(dict.fromkeys(point.setup for point in points))}
    return sorted(points, key=lambda point: order[point.setup])


def find_experiment(name: str) -> Experiment:
    """The experiment ``name``: a shipped one, or one of the user's, a file or a module with a dot in its name.

    MitsimError for another name, with those that there are, and for a module without an ``EXPERIMENT``.
    """
    if not is_experiment(name) or name == ALL:
        raise MitsimError(f"study {name!r}: there is no such study; use {', '.join((*STUDIES, *EXPERIMENTS))}")
    module = name if "." in name else f"mitsim.studies.{SHARED.get(name, f'{name}_study')}"
    try:
        loaded = _load_file(module) if module.endswith(_PYTHON) else importlib.import_module(module)
        found: Experiment = loaded.EXPERIMENTS[name] if name in SHARED else loaded.EXPERIMENT
    except (ImportError, AttributeError, OSError, SyntaxError) as error:
        raise MitsimError(
            f"study {name}: the module {module} cannot be used ({error}); it needs an EXPERIMENT, as "
            "`mitsim new study NAME` writes one"
        ) from error
    return found


@cache
def _load_file(path: str) -> Any:
    """The module in a file, which is run once."""
    found = importlib.util.spec_from_file_location(f"mitsim_study_{Path(path).stem}", path)
    assert found is not None and found.loader is not None, "a file of Python has a loader"
    module = importlib.util.module_from_spec(found)
    sys.modules[found.name] = module  # dataclasses of the file look for it there
    found.loader.exec_module(module)
    return module


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


# -------- Test images to print


TEST_IMAGES = ("astronaut", "camera", "chelsea", "coffee", "coins", "rocket", "page", "brick")
"""Portraits, an animal, things, a page of text and a texture."""
QUICK_IMAGES = ("chelsea", "page")
"""For a first look: fur and letters."""
PRINT_MM = 128.0
"""Width of the photograph's sheet, which they are printed on."""
EDGE_DEGREES = 5.0
"""Of the slanted edge, as ISO 12233 has it."""
SIDE = 512
"""Pixels a side: four of each of 128 projector pixels."""
_INK, _PAPER = 0.05, 0.90
"""Reflectances of black and white print, as on the shipped scenes."""


def picture(name: str) -> npt.NDArray[np.uint8]:
    """(512, 512) eight-bit reflectance of the test image ``name``: the middle square of it, grey.

    Besides, ``bars 0.26`` are bars of so many line pairs a mm of the print, upright on the left, lying on the right,
    and ``edge`` is one edge 5 degrees off the upright. MitsimError for another name.
    """
    import numpy as np
    from skimage import data
    from skimage.transform import resize

    kind, _, frequency = name.partition(" ")
    if kind == "bars" and frequency:
        return _reflectance(_bars(float(frequency)))
    if name == "edge":
        return _reflectance(_edge())
    if name not in TEST_IMAGES:
        raise MitsimError(f"picture {name!r}: use {', '.join((*TEST_IMAGES, 'edge', 'bars PAIRS_A_MM'))}")
    image = np.asarray(getattr(data, name)(), dtype=np.float64)
    grey = image.mean(axis=2) if image.ndim == 3 else image
    side = min(grey.shape)
    top, left = ((size - side) // 2 for size in grey.shape)
    square = resize(grey[top : top + side, left : left + side], (SIDE, SIDE), anti_aliasing=True)
    return _reflectance((square - square.min()) / (square.max() - square.min()))


def _reflectance(grey: FloatArray) -> npt.NDArray[np.uint8]:
    """Eight-bit reflectance of ``grey``, 0 black to 1 white."""
    import numpy as np

    return np.asarray(np.rint(255 * (_INK + (_PAPER - _INK) * grey)), dtype=np.uint8)


def _bars(frequency: float) -> FloatArray:
    """(512, 512) bars of so many pairs a mm, each texel the mean of the bars over it."""
    import numpy as np

    edges = np.arange(SIDE + 1) * PRINT_MM / SIDE * frequency
    white = np.floor(edges) / 2 + np.minimum(edges % 1, 0.5)  # integral of the bars, in periods
    profile = np.diff(white) / np.diff(edges)
    across = np.broadcast_to(profile, (SIDE, SIDE))
    return np.concatenate([across[:, : SIDE // 2], across.T[:, SIDE // 2 :]], axis=1)


def _edge() -> FloatArray:
    """(512, 512) black to white, each texel the part of it that is right of the edge, by 8 points a row of it."""
    import numpy as np

    rows, columns = ((np.arange(8 * SIDE) + 0.5) / 8, np.arange(SIDE))
    place = SIDE / 2 + (rows - SIDE / 2) * np.tan(np.radians(EDGE_DEGREES))
    return np.asarray(np.clip(columns + 1 - place[:, None], 0, 1).reshape(SIDE, 8, SIDE).mean(axis=1))
