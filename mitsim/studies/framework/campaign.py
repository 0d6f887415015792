"""A study of many points, from its name and scope to a folder with its points, table, claims, figures and page.

Points are measured in processes of their own. A process keeps its studio from batch to batch. One that dies loses the
point it was at, which another tries again.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cache, cached_property
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from pydantic import TypeAdapter, ValidationError

from mitsim.bench.apparatus import check_scene, open_apparatus
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError, cut
from mitsim.core.files import read_json, sweep, write_json
from mitsim.core.job import Job
from mitsim.core.worker import say_note, workers
from mitsim.studies import ALL, EXPERIMENTS, PAPER
from mitsim.studies.framework.experiment import Found, Point, Scope, Setup, Study, find_experiment
from mitsim.studies.framework.run import (
    KEPT,
    POINTS,
    Shard,
    Store,
    StudyResult,
    batches,
    check_study_folder,
    study_folder,
    write_figures,
    write_table,
)

if TYPE_CHECKING:
    from mitsim.studies.framework.studio import Studio

# -------- A study by its name and scope in, its folder out


@dataclass(frozen=True)
class Where:
    """Where points are measured: which part of them, by how many processes here, or by a Dask scheduler; ``shared`` is
    a folder of plans and calibrations that studies share."""

    shard: Shard = field(default_factory=Shard)
    jobs: int | None = None
    scheduler: str | None = None
    shared: str | None = None

    def __post_init__(self) -> None:
        if self.jobs is not None and self.jobs < 1:
            raise MitsimError(f"--jobs {self.jobs}: give 1 or more processes")

    def measure(self, name: str, points: Sequence[Point], kept: bool = False) -> Iterable[tuple[Point, Found]]:
        """What an experiment finds, in any order.

        Parameters
        ----------
        name, points
            of the experiment, and where it is measured.
        kept
            as :attr:`mitsim.studies.framework.experiment.Study.kept`.
        """
        if self.scheduler is not None:
            return on_cluster(name, batches(points, kept), self.scheduler)
        return in_processes(name, batches(points, kept), self.jobs or workers(), self.shared)


def run_experiment(
    study: str, scope: Scope, output: Path | str, job: Job | None = None, where: Where | None = None
) -> StudyResult:
    """Measure what is not measured yet, and put everything together.

    Parameters
    ----------
    study
        name of an experiment; ``all`` for those of the paper, each in a folder of its own, on one page.
    scope
        of which scene, and how much.
    output
        new or empty folder, or that of an earlier run of the same study, which goes on.
    job
        progress.
    where
        the points are measured; None: all of them here.

    Raises
    ------
    MitsimError
        for another name, an output that holds something else, and whatever a point refuses.
    """
    if study == ALL:
        with tempfile.TemporaryDirectory(prefix="mitsim-study-") as shared:
            together = replace(where or Where(), shared=shared)
            return _all(scope, output, lambda name, folder: run_experiment(name, scope, folder, job, together))
    campaign, job, where = _Campaign.of(study, scope, output), job or Job(), where or Where()
    kept = campaign.experiment.kept
    own, started = where.shard.part(campaign.points, kept), time.perf_counter()
    # Before there is a folder.
    for setup in dict.fromkeys(point.setup for point in own):
        check_scene(setup.scene, dict(setup.parameters), setup.outside)
    if campaign.experiment.solved:
        _check_data(own)
    with campaign.folder(output) as (folder, store):
        todo = [point for point in own if not store.has(point)]
        if kept:
            (folder / KEPT).mkdir(exist_ok=True)
            where = replace(where, shared=str(folder / KEPT))
        for done, (point, found) in enumerate(where.measure(study, todo, kept) if todo else (), start=1):
            store.save(point, found)
            left = (time.perf_counter() - started) / done * (len(todo) - done)
            job.progress(f"{study}: {done} of {len(todo)} points, {_duration_text(left)} left", done / len(todo))
        return campaign.finish(folder, store, time.perf_counter() - started)


def _check_data(points: Sequence[Point]) -> None:
    """Raise MitsimError for a point whose frames hold no more numbers than its image, so that no lambda can be chosen.

    A bench is opened once for all points that differ in their prints or accuracies alone.
    """
    from mitsim.bench.layout import shortage  # here: it needs the renderer

    asked = {(replace(each.setup, picture=None, accuracy=Setup.accuracy), each["patterns"]) for each in points}
    for setup, patterns in sorted(asked, key=str):
        parameters: dict[str, Any] = dict(setup.parameters)
        with warnings.catch_warnings(action="ignore"):  # whoever measures the point repeats them
            bench = open_apparatus(
                setup.scene, setup.variant, setup.camera, setup.projector, setup.outside, **parameters
            )
        short = shortage(bench, bench.family(patterns))
        if short and short.lost == 1:
            raise MitsimError(f"study: {short.reason}; {short.remedy}")


def merge(parts: Sequence[Path | str], output: Path | str, experiment: str | None = None) -> StudyResult:
    """One study of the points of several ``parts``, folders of the same study, in the folder ``output``.

    Parameters
    ----------
    parts, output
        folders of parts, and the one to make.
    experiment
        module of a study of the user's own; no module is imported because a file names it.

    Raises
    ------
    MitsimError
        for parts of different studies, of one that neither ships nor is ``experiment``, parts that hold none, and an
        output that holds something else.
    """
    started, heads = time.perf_counter(), [_head(Path(part)) for part in parts]
    if not heads:
        raise MitsimError("study merge: give the folders of the parts")
    for part, head in zip(parts, heads, strict=True):
        if any(head[key] != heads[0][key] for key in ("study", "scope", "versions")):
            raise MitsimError(
                f"study merge: {part} is of another study, scope or version than {parts[0]}; run it again"
            )
    study, scope = _known_study(heads[0]["study"], parts[0], experiment), _scope(heads[0]["scope"], parts[0])
    if study == ALL:
        for part in parts:
            for name in PAPER:
                _head(Path(part) / name)  # before there is a folder
        return _all(
            scope, output, lambda name, folder: merge([Path(part) / name for part in parts], folder, experiment)
        )
    if heads[0]["versions"] != versions():
        raise MitsimError(
            f"study merge: {parts[0]} was measured by other versions ({cut(str(heads[0]['versions']))}), by which it "
            "can be merged"
        )
    campaign = _Campaign.of(study, scope, output)
    _ = campaign.points  # which a scope that is none refuses, before there is a folder
    with campaign.folder(output) as (folder, store):
        for part in parts:
            store.take(Store(Path(part) / POINTS))
        return campaign.finish(folder, store, time.perf_counter() - started)


def _all(scope: Scope, output: Path | str, each: Callable[[str, Path], StudyResult]) -> StudyResult:
    """Every experiment of the paper, made by ``each`` in a folder of its own, and one page of all claims."""
    with study_folder(output, ALL) as folder:
        head = {"kind": ALL, "study": ALL, "scope": asdict(scope), "versions": versions()}
        write_json(folder / f"{ALL}.json", {**head, "status": "incomplete"})
        found = [each(name, folder / name) for name in PAPER]
        sections = [one.section for one in found if one.section]
        if len(sections) == len(found):
            from mitsim.studies.framework.page import build_page

            build_page(sections, folder / f"{ALL}.html", "The paper's claims on rendered frames")
        result = StudyResult(
            ALL,
            str(folder),
            points=sum(one.points for one in found),
            missing=sum(one.missing for one in found),
            seconds=sum(one.seconds for one in found),
            claims=tuple(claim for one in found for claim in one.claims),
            figures=tuple(f"{one.study}/{name}" for one in found for name in one.figures),
            warnings=tuple(f"{one.study}: {text}" for one in found for text in one.warnings),
        )
        write_json(folder / f"{ALL}.json", {**head, **result.payload(), "status": "complete"})
        return result


@dataclass(frozen=True)
class _Campaign:
    """A study by its name, and its scope."""

    study: str
    scope: Scope

    @classmethod
    def of(cls, study: str, scope: Scope, output: Path | str) -> _Campaign:
        """Of a ``study`` and its ``scope``; MitsimError, before the module of a shipped one is imported, for an
        ``output`` that it cannot be written to."""
        if study in EXPERIMENTS:
            check_study_folder(output, study)
        return cls(study, scope)

    @cached_property
    def experiment(self) -> Study:
        return find_experiment(self.study)

    @cached_property
    def points(self) -> Sequence[Point]:
        return self.experiment.points(self.scope)

    @contextmanager
    def folder(self, output: Path | str) -> Iterator[tuple[Path, Store]]:
        """The folder ``output`` and its store, held; an earlier run of the same code goes on."""
        name = self.experiment.name
        with study_folder(output, name) as folder:
            head = folder / f"{name}.json"
            if head.exists() and (made := read_json(head).get("versions")) != versions():
                raise MitsimError(
                    f"output {folder}: its points were measured by other versions ({made}); choose another folder"
                )
            (folder / POINTS).mkdir(exist_ok=True)
            store = Store(folder / POINTS)
            sweep(folder / POINTS)  # what killed processes left half-written
            self._write(folder, status="incomplete")
            yield folder, store

    def finish(self, folder: Path, store: Store, seconds: float) -> StudyResult:
        """Table, claims, figures and page, where all points are there; measuring them took so many ``seconds``."""
        from mitsim.studies.framework.page import Section, build_page

        there, experiment = sum(store.has(point) for point in self.points), self.experiment
        result = StudyResult(self.study, str(folder), points=there, missing=len(self.points) - there, seconds=seconds)
        if result.missing:
            return result
        results = replace(store.results(self.points), scope=self.scope)
        claims, figures = tuple(experiment.judge(results)), write_figures(folder, experiment.draw(results))
        write_table(folder / f"{experiment.name}.csv", results.rows)
        section = Section.of(experiment, self.study, claims, figures, results)
        build_page([section], folder / f"{experiment.name}.html", section.title)
        rows, named = tuple(map(dict, results.rows)), tuple(figures)
        result = replace(result, rows=rows, claims=claims, figures=named, section=section, warnings=section.warnings)
        self._write(folder, status="complete", **result.payload())
        return result

    def _write(self, folder: Path, **more: Any) -> None:
        head = {"kind": self.experiment.name, "study": self.study, "scope": asdict(self.scope), "versions": versions()}
        write_json(folder / f"{self.experiment.name}.json", {**head, **more})


def _head(folder: Path) -> dict[str, Any]:
    """What the study in a ``folder`` says of itself."""
    for file in sorted(folder.glob("*.json")):
        head = read_json(file)
        whole = isinstance(head, dict) and {"study", "scope", "versions"} <= head.keys()
        if whole and (head["study"] == ALL or (folder / POINTS).is_dir()):
            return dict(head)
    raise MitsimError(f"study merge: {folder} holds no part of a study; give folders that `mitsim study` wrote")


def read_scope(folder: Path) -> tuple[str, Scope]:
    """Name and scope of the study of many points in a ``folder``; MitsimError for one that holds none."""
    for file in sorted(folder.glob("*.json")) if folder.is_dir() else ():
        head = read_json(file)
        if isinstance(head, dict) and isinstance(head.get("study"), str) and "scope" in head:
            return head["study"], _scope(head["scope"], folder)
    raise MitsimError(
        f"{folder}: holds nothing that a session file repeats; give a folder of mitsim run, capture, calibrate, "
        "reconstruct or demo, or of a study of many points"
    )


def _known_study(study: Any, part: Path | str, experiment: str | None) -> str:
    """The name of a ``study`` as the file of a ``part`` has it, where it ships or was named as ``experiment`` too."""
    known = (*PAPER, *EXPERIMENTS, ALL) if experiment is None else (experiment, ALL)
    if not isinstance(study, str) or study not in known:
        instead = "none that ships" if experiment is None else f"not {experiment}"
        raise MitsimError(
            f"study merge: {part} is of the study {cut(str(study))!r}, {instead}; a study of your own is merged by its "
            "name, --experiment MODULE"
        )
    return study


def _scope(found: Any, part: Path | str) -> Scope:
    try:
        return TypeAdapter(Scope).validate_python(found)
    except ValidationError as error:
        raise MitsimError(f"study merge: {part}: its scope cannot be read ({error.errors()[0]['msg']})") from error


def _duration_text(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds > 90 else f"{seconds:.0f} s"


# -------- Batches of points in, measured in processes of their own; findings out as they come

Batch = tuple[Point, ...]
_TRIES = 2
"""Times that a point is begun: what ended two processes would end the third."""


@dataclass(frozen=True)
class _Studio:
    """This process's own studio, opened when it is first asked for something: to load the renderer takes seconds."""

    shared: str | None

    def __getattr__(self, name: str) -> Any:
        return getattr(_open(self.shared), name)


@cache
def _open(shared: str | None) -> Any:
    from mitsim.studies.framework.studio import Studio

    return Studio(shared)


def measure_point(name: str, point: Point, shared: str | None = None) -> Found:
    """What an experiment finds at a point, in this process's studio.

    Parameters
    ----------
    name, point
        of the experiment, and where it is measured.
    shared
        folder of plans and calibrations that processes share; None: this process keeps its own.
    """
    return find_experiment(name).measure(cast("Studio", _Studio(shared)), point)


def in_processes(
    name: str, batches: Sequence[Batch], jobs: int, shared: str | None = None
) -> Iterator[tuple[Point, Found]]:
    """Findings of all points, in any order.

    MitsimError for what a point refuses, and for one that ended two processes.

    Parameters
    ----------
    name
        of the experiment.
    batches
        points, those of a batch by one process one after the other.
    jobs
        processes at a time.
    shared
        folder of plans and calibrations that they share with others; None: with each other alone.
    """
    waiting, tries = deque(batches), dict[Point, int]()
    # Processes are ended, not asked to end: what they leave in their temporary folder goes with it.
    scratch = tempfile.TemporaryDirectory(prefix="mitsim-study-")
    folders = scratch.name, shared or scratch.name
    crew = [_Worker.start(name, folders) for _ in range(min(jobs, len(batches)))]
    try:
        while True:
            for worker in crew:
                if not worker.left and waiting:
                    worker.give(waiting.popleft())
            busy = [worker for worker in crew if worker.left]
            if not busy:
                return
            ready = wait([worker.pipe for worker in busy])
            for worker in busy:
                if worker.pipe not in ready:
                    continue
                point = worker.left[0]
                answer = worker.answer()
                if answer is None:
                    tries[point] = tries.get(point, 0) + 1
                    if tries[point] == _TRIES:
                        raise MitsimError(
                            f"study {name}: {_TRIES} processes ended at one point ({_point_text(point)}), the last "
                            f"with exit code {worker.process.exitcode}; finished points are kept. Is memory short? Try "
                            "--jobs 1"
                        )
                    waiting.appendleft(tuple(worker.left))
                    crew[crew.index(worker)] = _Worker.start(name, folders)
                else:
                    yield worker.left.popleft(), answer
    finally:
        for worker in crew:
            worker.end()
        scratch.cleanup()


def on_cluster(name: str, batches: Sequence[Batch], address: str) -> Iterator[tuple[Point, Found]]:
    """The same by workers of a Dask cluster, a batch a task.

    MitsimError without the package ``distributed``, without a scheduler there, and as :func:`in_processes`.

    Parameters
    ----------
    name, batches
        as for :func:`in_processes`.
    address
        of the scheduler.
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
        tasks = {client.submit(_batch, name, batch, pure=False): batch for batch in batches}
        for task in as_completed(tasks):
            found, refusal = task.result()
            yield from zip(tasks[task], found, strict=False)
            if refusal:
                raise MitsimError(refusal)


def _batch(name: str, batch: Batch) -> tuple[list[Found], str]:
    """Findings of a whole batch, and what refused it."""
    found = []
    for point in batch:
        try:
            found.append(measure_point(name, point))
        except MitsimError as error:
            return found, str(error)
    return found, ""


@dataclass(eq=False)
class _Worker:
    """A process, the pipe to it, and the points that it has not answered."""

    process: BaseProcess
    pipe: Connection
    left: deque[Point] = field(default_factory=deque)

    @classmethod
    def start(cls, name: str, folders: tuple[str, str]) -> _Worker:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(name, folders, theirs), daemon=True)
        process.start()
        theirs.close()  # so that its death ends the pipe
        return cls(process, ours)

    def give(self, batch: Batch) -> None:
        self.left = deque(batch)
        with suppress(OSError):  # it died; its answer says so
            self.pipe.send(batch)

    def answer(self) -> Found | None:
        """The next; None of a process that died. MitsimError for what the point refuses."""
        try:
            answer = self.pipe.recv()
        except (EOFError, OSError):
            self.process.join()
            return None
        if isinstance(answer, str):
            raise MitsimError(answer)
        assert isinstance(answer, Found)
        return answer

    def end(self) -> None:
        self.pipe.close()
        self.process.terminate()
        self.process.join()


def _serve(name: str, folders: tuple[str, str], pipe: Connection) -> None:
    """Measure every batch that comes, point by point, until the parent is gone; ``folders`` are for temporary files and
    for calibrations that are shared."""
    tempfile.tempdir, shared = folders
    warnings.showwarning = lambda message, *_: say_note(str(message))
    with suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            for point in pipe.recv():
                try:
                    pipe.send(measure_point(name, point, shared))
                except MitsimError as error:
                    pipe.send(str(error))
                    break


def _point_text(point: Point) -> str:
    values = {**dict(point.setup.parameters), "picture": point.setup.picture, **dict(point.values)}
    return ", ".join(f"{name} = {value}" for name, value in values.items() if value is not None)
