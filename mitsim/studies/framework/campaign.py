"""Runner of studies, from name and scope to a folder with points, table, claims, figures and page.

Points are measured in processes, which keep their studio from batch to batch. If a process dies, another one tries its
point again.
"""

from __future__ import annotations

import json
import multiprocessing
import shutil
import tempfile
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, dataclass, field, replace
from fnmatch import fnmatch
from functools import cache
from itertools import groupby
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter, ValidationError

from mitsim.bench.apparatus import check_scene
from mitsim.core import files
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError, cut
from mitsim.core.headline import each_once, headline
from mitsim.core.job import Job
from mitsim.core.worker import say_note, workers
from mitsim.studies import ALL, EXPERIMENTS, PAPER
from mitsim.studies.framework.experiment import HEADS, Claim, Found, Point, Results, Scope, find_experiment

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mitsim.studies.framework.panels import Section

# -------- Results of studies

_SHOWN_ROWS = 16
"""Longest table that the terminal shows."""


@dataclass(frozen=True)
class StudyResult:
    """Result of a study, for the command line, programs and notebooks; ``missing`` are points of other parts."""

    study: str
    output: str
    rows: tuple[Any, ...] = field(default=(), repr=False)
    warnings: tuple[str, ...] = ()
    points: int = 0
    missing: int = 0
    seconds: float = 0.0
    claims: tuple[Claim, ...] = ()
    figures: tuple[str, ...] = ()
    section: Section | None = field(default=None, repr=False)

    @property
    def headline(self) -> str:
        """Number of points, of claims by verdict, and the main flag."""
        from mitsim.studies.framework.claims import tally

        claims = f", {tally(self.claims)}" if self.claims else ""
        made = f"Measured {self.points} point{'s' * (self.points != 1)} of the study {self.study}{claims}"
        return headline(made, [reason.replace(" are flagged", "") for reason in self.warnings])

    def payload(self) -> dict[str, Any]:
        names = ("headline", "study", "output", "points", "missing", "seconds", "rows", "claims", "figures", "warnings")
        return {name: getattr(self, name) for name in names} | {"claims": [asdict(claim) for claim in self.claims]}

    def lines(self) -> list[str]:
        if self.missing:
            return [
                self.headline,
                f"{self.missing} points of other parts are missing: {self.output}",
                "Join all parts with: mitsim study merge PART... -o FOLDER",
            ]
        heads, lines = self.section.heads if self.section else HEADS, []
        for each in self.claims:
            figures = zip(heads, (each.paper, each.idealised, each.rendered), strict=True)
            stated = ", ".join(f"{head.lower()} {figure}" for head, figure in figures if figure)
            lines.append(f"{each.verdict}: {each.claim} ({stated})")
        parts = self.section.parts if self.section and not self.claims else ()
        tables = [line for part in parts if len(part.rows) <= _SHOWN_ROWS for line in (part.title, *part.lines())]
        return [self.headline, f"Table, figures and page: {self.output} (in {self.seconds:.0f} s)", *lines, *tables]

    def to_pandas(self) -> Any:
        import pandas

        return pandas.DataFrame([*self.rows])

    @property
    def pictures(self) -> dict[str, Path]:
        return {path.name: path for path in sorted(Path(self.output).glob("*.png"))}

    def _repr_html_(self) -> str:
        from mitsim.core.images import card, data_uri

        shown = (f'<img style="max-width:100%" src="{data_uri(each.read_bytes())}">' for each in self.pictures.values())
        return card(f"Study in {self.output}", {}, self.lines()) + "".join(shown)


def write_figures(folder: Path, figures: Mapping[str, Figure], style: str = "screen") -> dict[str, Figure]:
    """Write the figures that show something as PNG, SVG and PDF, and return them by the names of their PNG files."""
    from mitsim.report.plots import save_figure, style_figure

    drawn = {file: figure for file, figure in figures.items() if figure.axes}
    for file, figure in drawn.items():
        style_figure(figure, style)
        save_figure(figure, folder / file)
    return drawn


# -------- The folder of a study

POINTS, KEPT = "points", "kept"
DEMO_FOLDERS, DEMO_PAGE = ("run", "calibration"), "report.html"


def check_study_folder(output: Path | str, name: str) -> None:
    files.check_output(output, overwrite=is_earlier(Path(output), name))


def study_folder(output: Path | str, name: str) -> AbstractContextManager[Path]:
    """Hold the new, empty or earlier folder ``output`` of the study ``name``; MitsimError if it holds anything else."""
    return files.output_folder(output, overwrite=is_earlier(Path(output), name))


def is_earlier(place: Path, name: str) -> bool:
    head = place / f"{name}.json"
    found = files.read_json(head) if head.is_file() else None
    written = "*.png", "*.svg", "*.pdf", "*.csv", "*.html", "camera.toml", POINTS, KEPT, *DEMO_FOLDERS, *PAPER
    names = [item.name for item in place.iterdir()] if isinstance(found, dict) and found.get("kind") == name else [""]
    return all(any(fnmatch(each, known) for known in (head.name, ".*", *written)) for each in names)


# -------- Points of a study on disk


@dataclass(frozen=True)
class Store:
    folder: Path

    def has(self, point: Point) -> bool:
        return self._file(point).is_file()

    def save(self, point: Point, found: Found) -> None:
        import numpy as np

        rows = np.frombuffer(json.dumps([dict(row) for row in found.rows]).encode(), dtype=np.uint8)
        with files.whole_file(self._file(point)) as part, part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **{"rows": rows, **found.arrays})  # type: ignore[arg-type]

    def load(self, point: Point) -> Found:
        """Return the findings; MitsimError when the file is damaged."""
        from mitsim.core.arrays import read_npz

        path = self._file(point)
        try:
            if not files.check_plain(path).st_size:
                raise ValueError("it is empty: the disk was full, or the machine stopped")
            with path.open("rb") as file:
                arrays = read_npz(file, path)
            rows = json.loads(arrays.pop("rows").tobytes())
            if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
                raise ValueError("its rows are none")
            return Found(tuple(rows), arrays)
        except (OSError, ValueError, KeyError, RecursionError) as error:
            raise MitsimError(
                f"file {path}: cannot be read as a point of a study ({error}); remove it and run again"
            ) from error

    def _file(self, point: Point) -> Path:
        return self.folder / f"{point.key}.npz"


Batch = tuple[Point, ...]


def batches(points: Sequence[Point], kept: bool = False) -> list[Batch]:
    """Return batches of ``points`` that share light."""
    if kept:
        return [(point,) for point in points]
    return [tuple(group) for _, group in groupby(points, key=lambda point: point.setup)]


def shard_of(text: str) -> tuple[int, int]:
    """Parse a part and the number of parts, such as 2/8; MitsimError for anything else."""
    number, slash, count = text.partition("/")
    if not (slash and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise MitsimError(f"--shard {text!r}: give I/N with I from 1 to N, such as 1/4")
    return int(number), int(count)


# -------- A study of many points


@dataclass(frozen=True)
class Where:
    """Part of the points, and local processes or the Dask scheduler that measure it.

    A ``shard`` (number from 1, count) has every ``count``-th batch, because a batch's light is traced once.
    """

    shard: tuple[int, int] = (1, 1)
    jobs: int | None = None
    scheduler: str | None = None
    shared: str | None = None

    def __post_init__(self) -> None:
        if self.jobs is not None and self.jobs < 1:
            raise MitsimError(f"--jobs {self.jobs}: give 1 or more processes")


def run_experiment(
    study: str, scope: Scope, output: Path | str, job: Job | None = None, where: Where | None = None
) -> StudyResult:
    """Measure the points that are not measured yet, and write table, claims, figures and page.

    ``output`` is a new or empty folder, or that of an earlier run of the same study, which is resumed. MitsimError for
    another study's name, an output that holds something else, and anything that a point refuses.
    """
    job, where = job or Job(), where or Where()
    if study == ALL:
        with tempfile.TemporaryDirectory(prefix="mitsim-study-") as shared:
            together = replace(where, shared=shared)
            return _all(scope, output, lambda name, folder: run_experiment(name, scope, folder, job, together))
    if study in EXPERIMENTS:
        check_study_folder(output, study)  # before the module of the study is imported
    experiment, (number, count) = find_experiment(study), where.shard
    own = batches(experiment.points(scope), experiment.kept)[number - 1 :: count]
    # Before there is a folder.
    for setup in dict.fromkeys(batch[0].setup for batch in own):
        check_scene(setup.scene, dict(setup.parameters), setup.outside)

    def measure(store: Store) -> None:
        parts = [tuple(point for point in batch if not store.has(point)) for batch in own]
        parts, shared, started = [part for part in parts if part], where.shared, time.perf_counter()
        if experiment.kept:
            shared = str(store.folder.parent / KEPT)
            Path(shared).mkdir(exist_ok=True)
        if where.scheduler is not None and parts:
            measured = on_cluster(study, parts, where.scheduler)
        else:
            measured = in_processes(study, parts, where.jobs or workers(), shared)
        todo = sum(map(len, parts))
        for done, (point, found) in enumerate(measured, start=1):
            store.save(point, found)
            left = (time.perf_counter() - started) / done * (todo - done)
            text = f"{left / 60:.0f} min" if left > 90 else f"{left:.0f} s"
            job.progress(f"{study}: {done} of {todo} points, {text} left", done / todo)

    return _complete(study, scope, output, measure, job.command)


def merge(parts: Sequence[Path | str], output: Path | str, experiment: str | None = None) -> StudyResult:
    """Join ``parts``, folders of the same study, in the folder ``output``.

    ``experiment`` is the module of a user's own study. MitsimError for parts of different or unknown studies, parts
    that hold none, and an output that holds something else.
    """
    heads = [_head(Path(part)) for part in parts]
    if not heads:
        raise MitsimError("study merge: give the folders of the parts")
    for part, head in zip(parts, heads, strict=True):
        if any(head[key] != heads[0][key] for key in ("study", "scope")) or head["versions"] != versions():
            raise MitsimError(
                f"study merge: {part} is of another study or scope than {parts[0]}, or was measured by other versions "
                f"than this one ({cut(str(head['versions']))}); run it again"
            )
    study, known = heads[0]["study"], (*PAPER, *EXPERIMENTS, ALL) if experiment is None else (experiment, ALL)
    if not isinstance(study, str) or study not in known:
        instead = "none that ships" if experiment is None else f"not {experiment}"
        raise MitsimError(
            f"study merge: {parts[0]} is of the study {cut(str(study))!r}, {instead}; a study of your own is merged by "
            "its name, --experiment MODULE"
        )
    try:
        scope = TypeAdapter(Scope).validate_python(heads[0]["scope"])
    except ValidationError as error:
        raise MitsimError(f"study merge: {parts[0]}: its scope cannot be read ({error.errors()[0]['msg']})") from error
    if study == ALL:
        for part in parts:
            for name in PAPER:
                _head(Path(part) / name)  # before there is a folder
        return _all(
            scope, output, lambda name, folder: merge([Path(part) / name for part in parts], folder, experiment)
        )

    def copy(store: Store) -> None:
        for file in (file for part in parts for file in sorted((Path(part) / POINTS).glob("*.npz"))):
            if not (store.folder / file.name).exists():
                files.check_plain(file)
                with files.whole_file(store.folder / file.name) as copied:
                    shutil.copyfile(file, copied)

    return _complete(study, scope, output, copy)


def _all(scope: Scope, output: Path | str, each: Callable[[str, Path], StudyResult]) -> StudyResult:
    with study_folder(output, ALL) as folder:
        head = {"kind": ALL, "study": ALL, "scope": asdict(scope), "versions": versions()}
        files.write_json(folder / f"{ALL}.json", {**head, "status": "incomplete"})
        found = [each(name, folder / name) for name in PAPER]
        sections = [one.section for one in found if one.section]
        result = StudyResult(
            ALL,
            str(folder),
            points=sum(one.points for one in found),
            missing=sum(one.missing for one in found),
            seconds=sum(one.seconds for one in found),
            claims=tuple(claim for one in found for claim in one.claims),
            figures=tuple(f"{one.study}/{name}" for one in found for name in one.figures),
            warnings=each_once({one.study: one.warnings for one in found}),
        )
        if len(sections) == len(found):
            from mitsim.studies.framework.panels import write_page

            title = "The paper's claims on rendered frames"
            write_page(sections, folder / f"{ALL}.html", title, result.headline)
        files.write_json(folder / f"{ALL}.json", {**head, "status": "complete", **result.payload()})
        return result


def _complete(
    study: str, scope: Scope, output: Path | str, fill: Callable[[Store], None], command: str | None = None
) -> StudyResult:
    """Fill a study's folder with points, and write table, claims, figures and page if no point is missing."""
    from mitsim.studies.framework.claims import with_intervals
    from mitsim.studies.framework.panels import section_of, write_page

    experiment, started = find_experiment(study), time.perf_counter()
    name, points = experiment.name, experiment.points(scope)  # refuses an impossible scope before there is a folder
    with study_folder(output, name) as folder:
        place, store = folder / f"{name}.json", Store(folder / POINTS)
        head = {"kind": name, "study": study, "scope": asdict(scope), "versions": versions()}
        if place.exists() and (made := files.read_json(place).get("versions")) != versions():
            raise MitsimError(
                f"output {folder}: its points were measured by other versions ({made}); choose another folder"
            )
        store.folder.mkdir(exist_ok=True)
        files.sweep(store.folder)  # half-written files of killed processes
        files.write_json(place, {**head, "status": "incomplete"})
        fill(store)
        there = sum(map(store.has, points))
        took, missing = time.perf_counter() - started, len(points) - there
        result = StudyResult(study, str(folder), points=there, missing=missing, seconds=took)
        if result.missing:
            return result
        found = {point.key: store.load(point) for point in points}
        rows = tuple({**row, "point": key} for key, each in found.items() for row in each.rows)
        arrays = {(key, name): array for key, each in found.items() for name, array in each.arrays.items()}
        results = with_intervals(Results(rows, arrays, scope))
        claims = tuple(experiment.judge(results))
        figures = write_figures(folder, experiment.draw(results), scope.style)
        files.write_text(folder / f"{name}.csv", results.frame.to_csv(index=False))
        section = section_of(experiment, claims, figures, results, command)
        result = replace(
            result,
            rows=tuple(results.rows),
            claims=claims,
            figures=tuple(figures),
            section=section,
            warnings=section.warnings,
        )
        write_page([section], folder / f"{name}.html", section.title, result.headline)
        files.write_json(place, {**head, "status": "complete", "command": command, **result.payload()})
    return result


def _head(folder: Path) -> dict[str, Any]:
    for file in sorted(folder.glob("*.json")):
        head = files.read_json(file)
        whole = isinstance(head, dict) and {"study", "scope", "versions"} <= head.keys()
        if whole and (head["study"] == ALL or (folder / POINTS).is_dir()):
            return dict(head)
    raise MitsimError(f"study merge: {folder} holds no part of a study; give folders that `mitsim study` wrote")


# -------- Batches of points in, measured in processes of their own; findings out as they come

_TRIES = 2
"""Times that a point is tried: a point that ended two processes would end the third."""


@cache
def _open(shared: str | None) -> Any:
    from mitsim.studies.framework.studio import Studio

    return Studio(shared)


@dataclass(frozen=True)
class _LazyStudio:
    shared: str | None

    def __getattr__(self, name: str) -> Any:
        return getattr(_open(self.shared), name)


def measure_batch(name: str, batch: Batch, shared: str | None = None) -> Iterator[tuple[Point, Found | str]]:
    """Yield each point of a ``batch`` with its findings, or with the refusal that ends the batch."""
    for point in batch:
        try:
            yield point, find_experiment(name).measure(_LazyStudio(shared), point)
        except MitsimError as error:
            yield point, str(error)
            return


def in_processes(
    name: str, batches: Sequence[Batch], jobs: int, shared: str | None = None
) -> Iterator[tuple[Point, Found]]:
    """Yield the findings of all points of the experiment ``name``, in any order, from ``jobs`` processes.

    MitsimError for anything that a point refuses, and for a point that ended two processes.
    """
    waiting, tries = deque(batches), dict[Point, int]()
    # Processes are ended, not asked to end: the files in their temporary folder go with it.
    with tempfile.TemporaryDirectory(prefix="mitsim-study-") as scratch:
        folders = scratch, shared or scratch
        crew = [_Worker(name, folders) for _ in range(min(jobs, len(batches)))]
        try:
            while True:
                for worker in crew:
                    if not worker.left and waiting:
                        worker.left = deque(waiting.popleft())
                        with suppress(OSError):  # it died, which is noticed when its answer is read
                            worker.pipe.send(tuple(worker.left))
                busy = {worker.pipe: worker for worker in crew if worker.left}
                if not busy:
                    return
                for worker in (busy[pipe] for pipe in wait(busy)):  # type: ignore[index]
                    point = worker.left[0]
                    try:
                        answer = worker.pipe.recv()
                    except (EOFError, OSError):  # the process died
                        worker.process.join()
                        tries[point] = tries.get(point, 0) + 1
                        if tries[point] == _TRIES:
                            values = {**dict(point.setup.parameters), **point.row()}
                            text = ", ".join(f"{key} = {value}" for key, value in values.items() if value is not None)
                            raise MitsimError(
                                f"study {name}: {_TRIES} processes ended at one point ({text}), the last with exit "
                                f"code {worker.process.exitcode}; finished points are kept. Is memory short? Try "
                                "--jobs 1"
                            ) from None
                        waiting.appendleft(tuple(worker.left))
                        crew[crew.index(worker)] = _Worker(name, folders)
                        continue
                    if isinstance(answer, str):
                        raise MitsimError(answer)
                    yield worker.left.popleft(), answer
        finally:
            for worker in crew:
                worker.pipe.close()
                worker.process.terminate()
                worker.process.join()


class _Worker:
    """Process that measures the points ``left`` of its batch."""

    def __init__(self, name: str, folders: tuple[str, str]) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.left = deque[Point]()
        self.process = context.Process(target=_serve, args=(name, folders, theirs), daemon=True)
        self.process.start()
        theirs.close()  # so that its death ends the pipe


def _serve(name: str, folders: tuple[str, str], pipe: Connection) -> None:
    tempfile.tempdir, shared = folders
    warnings.showwarning = lambda message, *_: say_note(str(message))
    with suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            for _, answer in measure_batch(name, pipe.recv(), shared):
                pipe.send(answer)


def on_cluster(name: str, batches: Sequence[Batch], address: str) -> Iterator[tuple[Point, Found]]:
    """Yield the findings of all points from the Dask cluster at an ``address``.

    MitsimError without the package ``distributed`` or a scheduler, and as :func:`in_processes`.
    """
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise MitsimError("--scheduler: needs the package distributed; pip install 'mitsim[dask]'") from None
    try:
        client = Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        raise MitsimError(f"--scheduler {address}: no Dask scheduler answers there ({error})") from error
    with client:
        for task in as_completed(client.map(lambda batch: [*measure_batch(name, batch)], batches, pure=False)):
            for point, answer in task.result():
                if isinstance(answer, str):
                    raise MitsimError(answer)
                yield point, answer
