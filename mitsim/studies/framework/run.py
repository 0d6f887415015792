"""What all studies share: a bench and what to measure in; findings, and the folder that holds them, out."""

from __future__ import annotations

import importlib
import json
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatch
from functools import partial
from itertools import groupby
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

from mitsim.bench.request import Request
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError
from mitsim.core.files import check_output, check_plain, output_folder, read_json, whole_file, write_json, write_text
from mitsim.core.job import Job
from mitsim.studies import ALL, PAPER, STUDIES
from mitsim.studies.framework.experiment import HEADS, Claim, Found, Point, Results, no_such_study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mitsim.api.bench import Bench
    from mitsim.studies.framework.page import Part, Section


DPI = 150
"""Figures are 8.6 inches wide: 1290 pixels, the width of a page of text on a common screen."""


def write_figures(folder: Path, figures: Mapping[str, Figure]) -> dict[str, Figure]:
    """Write those of some ``figures``, by file name, that tell anything to a ``folder``, and return these; MitsimError
    when one cannot be written."""
    from mitsim.report.plots import tells  # not in processes that measure

    drawn = {file: figure for file, figure in figures.items() if tells(figure)}
    for file, figure in drawn.items():
        with whole_file(folder / file) as part:
            figure.savefig(part, dpi=DPI, format="png")
    return drawn


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write ``rows`` to the CSV file ``path``, all or nothing; MitsimError when it cannot be written."""
    from pandas import DataFrame

    write_text(path, DataFrame([dict(row) for row in rows], dtype=object).to_csv(index=False))


class Findings:
    """What a study of one bench measured, as its folder and the command line show it."""

    title: ClassVar[str] = ""
    """Of its page; without one it has none."""

    def payload(self) -> dict[str, Any]:
        """As JSON holds it."""
        raise NotImplementedError

    def lines(self) -> list[str]:
        """For people: the page's parts, where the study says nothing shorter."""
        return [line for part in self.parts() for line in part.lines()]

    def figures(self) -> Mapping[str, Figure]:
        """By file name."""
        raise NotImplementedError

    def tables(self) -> Mapping[str, Sequence[Mapping[str, Any]]]:
        """Return rows of tables by file name."""
        return {}

    def parts(self) -> Sequence[Part]:
        """Of its page."""
        return ()

    def records(self) -> list[dict[str, Any]]:
        """What was measured, a dictionary a row: the first table, or the first list of such in the JSON."""
        for table in self.tables().values():
            return [dict(row) for row in table]
        lists = (value for value in self.payload().values() if isinstance(value, list | tuple))
        found = ([dict(row) for row in each if isinstance(row, Mapping)] for each in lists)
        return next((rows for rows in found if rows), [])

    @property
    def message(self) -> str:
        """What the page says first; empty for its title alone."""
        return ""

    @property
    def warnings(self) -> Sequence[str]:
        """Why it may not be trusted, and what to do; empty where nothing is wrong."""
        return ()


@dataclass(frozen=True)
class StudyResult:
    """Result of a study, for the command line, programs and notebooks.

    Attributes
    ----------
    study, output
        name, and the folder that holds the study.
    rows
        rows of its table.
    warnings
        reasons why it may not be trusted.
    findings, scene, patterns
        of a study of one bench: findings, and the scene and patterns that they are of; None: of none.
    points, missing, seconds
        of a study of many points: measured points, those of other parts that are missing, and the time of measuring.
    claims, figures, section
        of a whole study of many points: judged claims, files of figures, and its section of a page.
    """

    study: str
    output: str
    rows: tuple[Any, ...] = field(default=(), repr=False)
    warnings: tuple[str, ...] = ()
    findings: Findings | None = None
    scene: str | None = None
    patterns: str | None = None
    points: int = 0
    missing: int = 0
    seconds: float = 0.0
    claims: tuple[Claim, ...] = ()
    figures: tuple[str, ...] = ()
    section: Section | None = field(default=None, repr=False)

    def payload(self) -> dict[str, Any]:
        """Return the result as JSON has it."""
        if self.findings is not None:
            return {**self.findings.payload(), "scene": self.scene, "patterns": self.patterns, "output": self.output}
        names = ("study", "output", "points", "missing", "seconds", "rows", "claims", "figures", "warnings")
        return {name: getattr(self, name) for name in names} | {"claims": [asdict(claim) for claim in self.claims]}

    def lines(self) -> list[str]:
        """Return the result as text."""
        if self.findings is not None:
            return [f"JSON and plots: {self.output}", *self.findings.lines()]
        if self.missing:
            return [
                f"{self.points} points measured, {self.missing} of other parts are missing: {self.output}",
                "Join all parts with: mitsim study merge PART... -o FOLDER",
            ]
        heads = self.section.heads if self.section else HEADS
        lines = [f"{claim.verdict}: {claim.claim} ({claim.figures_text(heads)})" for claim in self.claims]
        return [f"{self.points} points in {self.seconds:.0f} s; table, figures and page: {self.output}", *lines]

    def to_pandas(self) -> Any:
        """Return the rows as a ``pandas.DataFrame``."""
        import pandas

        return pandas.DataFrame([*self.rows])

    @property
    def pictures(self) -> dict[str, Path]:
        """Files of the figures, by name."""
        return {path.name: path for path in sorted(Path(self.output).glob("*.png"))}

    def _repr_html_(self) -> str:
        from mitsim.core.images import card, data_uri

        figures = (
            f'<img style="max-width:100%" src="{data_uri(each.read_bytes())}">' for each in self.pictures.values()
        )
        return card(f"Study in {self.output}", {}, self.lines()) + "".join(figures)


def run_study(
    name: str,
    measure: Callable[[Any, Request, Job], Findings],
    bench: Bench | None,
    output: Path | str,
    request: Request | None = None,
    job: Job | None = None,
) -> StudyResult:
    """Measure, and write NAME.json, figures, tables and a page, where there are such, to a folder.

    MitsimError for an output that cannot be written or holds something else, and for what the study itself refuses.

    Parameters
    ----------
    name, measure
        of the study.
    bench, request, job
        what is studied: the scene, patterns and seed; clock, progress and limits. None for a study of no scene.
    output
        new or empty folder, or one with an earlier study of that name, which is replaced.
    """
    request = request or Request.of()
    with study_folder(output, name) as folder:
        findings = measure(bench, request, job or Job())
        scene, patterns = (str(bench.loaded.path), request.patterns) if bench else (None, None)
        warnings = tuple(findings.warnings)
        result = StudyResult(name, str(folder), tuple(findings.records()), warnings, findings, scene, patterns)
        provenance = {"kind": name, "seed": request.seed, "versions": versions()}
        write_json(folder / f"{name}.json", {**result.payload(), **provenance})
        figures = write_figures(folder, findings.figures())
        if findings.title:
            from mitsim.report.pages import page_figure
            from mitsim.studies.framework.page import build_findings

            scene_name = f"Scene {bench.loaded.path.parent.name}, patterns {patterns}, seed" if bench else "Seed"
            where = f"{scene_name} {request.seed}."
            titles = findings.title, findings.message
            pictures = {file: page_figure(figure) for file, figure in figures.items()}
            page = build_findings(name, titles, where, findings.parts(), pictures, result.warnings)
            write_text(folder / f"{name}.html", page)
        for file, table in findings.tables().items():
            write_table(folder / file, table)
        return result


def find_study(name: str, **settings: object) -> Callable[..., StudyResult]:
    """The study ``name``, to be called with (bench, output, request, job); nothing heavy is imported before the name is
    known to be one, and its folder to be free.

    Parameters
    ----------
    name
        of the study.
    **settings
        further arguments of its function.

    Raises
    ------
    MitsimError
        for another name, with those that there are.
    """
    if name not in STUDIES:
        raise no_such_study(name)

    def measure(bench: Bench | None, request: Request, job: Job) -> Findings:
        """What the study finds."""
        found: Findings = importlib.import_module(f"mitsim.studies.{name}_study").measure(
            bench, request, job, **settings
        )
        return found

    return partial(run_study, name, measure)


# -------- Findings of points on disk

_ROWS = "rows"


@dataclass(frozen=True)
class Store:
    """The findings in a ``folder``, which exists."""

    folder: Path

    def has(self, point: Point) -> bool:
        """Whether a ``point`` is measured."""
        return self._file(point).is_file()

    def save(self, point: Point, found: Found) -> None:
        """Keep what was ``found`` at a ``point``; MitsimError when it cannot be written."""
        import numpy as np

        rows = np.frombuffer(json.dumps([dict(row) for row in found.rows]).encode(), dtype=np.uint8)
        with whole_file(self._file(point)) as part, part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **{_ROWS: rows, **found.arrays})  # type: ignore[arg-type]

    def load(self, point: Point) -> Found:
        """What was found at a ``point``; MitsimError when the file is damaged."""
        from mitsim.core.arrays import read_npz

        path = self._file(point)
        try:
            if not check_plain(path).st_size:
                raise ValueError("it is empty: the disk was full, or the machine stopped")
            with path.open("rb") as file:
                arrays = read_npz(file, path)
            rows = json.loads(arrays.pop(_ROWS).tobytes())
            if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
                raise ValueError("its rows are none")
            return Found(tuple(rows), arrays)
        except (OSError, ValueError, KeyError, RecursionError) as error:
            raise MitsimError(
                f"file {path}: cannot be read as a point of a study ({error}); remove it and run again"
            ) from error

    def take(self, other: Store) -> None:
        """Copy what an ``other`` store has and this one has not."""
        for file in sorted(other.folder.glob("*.npz")):
            if not (self.folder / file.name).exists():
                check_plain(file)
                with whole_file(self.folder / file.name) as part:
                    shutil.copyfile(file, part)

    def results(self, points: Iterable[Point]) -> Results:
        """Everything found at ``points``, in their order."""
        found = {point.key: self.load(point) for point in points}
        rows = tuple({**row, "point": key} for key, each in found.items() for row in each.rows)
        arrays = {(key, name): array for key, each in found.items() for name, array in each.arrays.items()}
        return Results(rows, arrays)

    def _file(self, point: Point) -> Path:
        return self.folder / f"{point.key}.npz"


def batches(points: Sequence[Point], kept: bool = False) -> list[tuple[Point, ...]]:
    """The ``points`` in their order, those of one setup together: they share its light.

    Parameters
    ----------
    points
        of an experiment.
    kept
        whether what they share is kept in files: then each is a batch.
    """
    if kept:
        return [(point,) for point in points]
    return [tuple(group) for _, group in groupby(points, key=lambda point: point.setup)]


@dataclass(frozen=True)
class Shard:
    """Part ``number`` of ``count``, from 1 on, of a study that several jobs of a cluster share."""

    number: int = 1
    count: int = 1

    @classmethod
    def of(cls, text: str) -> Shard:
        """From a ``text`` such as 2/8; MitsimError for anything else."""
        number, slash, count = text.partition("/")
        if not (slash and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
            raise MitsimError(f"--shard {text!r}: give I/N with I from 1 to N, such as 1/4")
        return cls(int(number), int(count))

    def part(self, points: Sequence[Point], kept: bool = False) -> list[Point]:
        """The ``points`` of this part: every ``count``-th of their :func:`batches`, as a batch's light is traced once;
        ``kept`` as there."""
        own = batches(points, kept)[self.number - 1 :: self.count]
        return [point for batch in own for point in batch]


# -------- The folder of a study

POINTS, KEPT = "points", "kept"
"""Folders of what the points of a study came to, and of what they share."""
DEMO_FOLDERS, DEMO_PAGE = ("run", "calibration"), "report.html"
"""What `mitsim demo` writes."""
_PARTS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        ALL: (*PAPER, "*.html"),
        "characterise": ("*.png", "camera.toml", "characterise.html"),
        "demo": (*DEMO_FOLDERS, DEMO_PAGE),
        **{name: ("*.png", "*.csv", f"{name}.html") for name in STUDIES},
    }
)
"""What a study writes beside NAME.json, with wildcards."""
_OF_POINTS = ("*.png", "*.csv", "*.html", POINTS, KEPT)
"""The same of all others, which are of many points."""


def check_study_folder(output: Path | str, name: str) -> None:
    """Refuse an ``output`` that :func:`study_folder` of the study ``name`` would refuse, before what is slow to import.

    MitsimError as there.
    """
    check_output(output, overwrite=_is_earlier(Path(output), name))


@contextmanager
def study_folder(output: Path | str, name: str) -> Iterator[Path]:
    """The folder ``output`` of the study ``name``, held while the context lasts.

    It is new or empty, or holds an earlier study of that name alone, of which nothing is removed. MitsimError when it
    holds anything else, or cannot be written.
    """
    with output_folder(output, overwrite=_is_earlier(Path(output), name)) as folder:
        yield folder


def _is_earlier(place: Path, name: str) -> bool:
    """Whether an earlier study of a ``name``, whose NAME.json says ``"kind": NAME``, has a ``place`` to itself."""
    head, names = place / f"{name}.json", (f"{name}.json", ".*", *_PARTS.get(name, _OF_POINTS))
    found = read_json(head) if head.is_file() else None
    if not isinstance(found, dict) or found.get("kind") != name:
        return False
    return all(any(fnmatch(item.name, known) for known in names) for item in place.iterdir())
