"""A study of many points, from its name and scope to a folder with its points, table, claims, figures and page."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter, ValidationError

from mitsim.bench.open import check_scene
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError, cut
from mitsim.core.files import read_json, sweep, write_json
from mitsim.core.job import Job
from mitsim.core.worker import workers
from mitsim.studies import ALL, EXPERIMENTS, PAPER
from mitsim.studies.framework.experiment import HEADS, Claim, Experiment, Found, Scope, find_experiment
from mitsim.studies.framework.run import POINTS, Shard, Store, batches, check_study_folder, study_folder, write_figures
from mitsim.studies.framework.setup import Point
from mitsim.studies.framework.workers import in_processes, on_cluster

# What draws is imported where it is used: a study that cannot be is refused without it.
if TYPE_CHECKING:
    from mitsim.studies.framework.page import Section


@dataclass(frozen=True)
class Where:
    """Where points are measured: which part of them, by how many processes here, or by a Dask scheduler; ``shared`` is
    a folder of calibrations that studies share."""

    shard: Shard = field(default_factory=Shard)
    jobs: int | None = None
    scheduler: str | None = None
    shared: str | None = None

    def __post_init__(self) -> None:
        if self.jobs is not None and self.jobs < 1:
            raise MitsimError(f"--jobs {self.jobs}: give 1 or more processes")

    def measure(self, name: str, points: Sequence[Point]) -> Iterable[tuple[Point, Found]]:
        """What the experiment ``name`` finds at ``points``, in any order."""
        if self.scheduler is not None:
            return on_cluster(name, batches(points), self.scheduler)
        return in_processes(name, batches(points), self.jobs or workers(), self.shared)


@dataclass(frozen=True)
class CampaignResult:
    """A study, or the part of it whose points are measured: what the command line reports.

    Attributes
    ----------
    study, output
        its name, and the folder that holds it.
    points, missing, seconds
        points that are measured, those of other parts that are not, and what measuring took.
    rows, claims, figures
        of a whole study: all that was measured, what becomes of the paper's claims, and files of figures.
    section
        of a whole study: how a page shows it.
    """

    study: str
    output: str
    points: int
    missing: int
    seconds: float
    rows: tuple[Any, ...] = ()
    claims: tuple[Claim, ...] = ()
    figures: tuple[str, ...] = ()
    section: Section | None = None

    def payload(self) -> dict[str, Any]:
        """As JSON."""
        return {name: value for name, value in asdict(replace(self, section=None)).items() if name != "section"}

    def lines(self) -> list[str]:
        """For people."""
        if self.missing:
            return [
                f"{self.points} points measured, {self.missing} of other parts are missing: {self.output}",
                "Join all parts with: mitsim study merge PART... -o FOLDER",
            ]
        heads = self.section.experiment.heads if self.section else HEADS
        lines = [f"{claim.verdict}: {claim.claim} ({claim.figures_text(heads)})" for claim in self.claims]
        lines += self.section.warnings if self.section else ()
        return [*lines, f"{self.points} points in {self.seconds:.0f} s; table, figures and page: {self.output}"]


def run_experiment(
    study: str, scope: Scope, output: Path | str, job: Job | None = None, where: Where | None = None
) -> CampaignResult:
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
    own, started = where.shard.part(campaign.points), time.perf_counter()
    for setup in dict.fromkeys(point.setup for point in own):
        check_scene(setup.scene, dict(setup.parameters), setup.outside)  # before there is a folder
    with campaign.folder(output) as (folder, store):
        todo = [point for point in own if not store.has(point)]
        for done, (point, found) in enumerate(where.measure(study, todo) if todo else (), start=1):
            store.save(point, found)
            left = (time.perf_counter() - started) / done * (len(todo) - done)
            job.progress(f"{study}: {done} of {len(todo)} points, {_duration_text(left)} left", done / len(todo))
        return campaign.finished(folder, store, time.perf_counter() - started)


def merge(parts: Sequence[Path | str], output: Path | str, experiment: str | None = None) -> CampaignResult:
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
        return campaign.finished(folder, store, time.perf_counter() - started)


def _all(scope: Scope, output: Path | str, each: Callable[[str, Path], CampaignResult]) -> CampaignResult:
    """Every experiment of the paper, made by ``each`` in a folder of its own, and one page of all claims."""
    with study_folder(output, ALL) as folder:
        head = {"kind": ALL, "study": ALL, "scope": asdict(scope), "versions": versions()}
        write_json(folder / f"{ALL}.json", {**head, "status": "incomplete"})
        found = [each(name, folder / name) for name in PAPER]
        sections = [one.section for one in found if one.section]
        if len(sections) == len(found):
            from mitsim.studies.framework.page import build_page

            build_page(sections, folder / f"{ALL}.html", "The paper's claims on rendered frames")
        result = CampaignResult(
            ALL,
            str(folder),
            sum(one.points for one in found),
            sum(one.missing for one in found),
            sum(one.seconds for one in found),
            claims=tuple(claim for one in found for claim in one.claims),
            figures=tuple(f"{one.study}/{name}" for one in found for name in one.figures),
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
    def experiment(self) -> Experiment:
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

    def finished(self, folder: Path, store: Store, seconds: float) -> CampaignResult:
        """Table, claims, figures and page, where all points are there; measuring them took so many ``seconds``."""
        from mitsim.studies.framework.page import Section, build_page

        there, experiment = sum(store.has(point) for point in self.points), self.experiment
        if missing := len(self.points) - there:
            return CampaignResult(self.study, str(folder), there, missing, seconds)
        results = replace(store.results(self.points), measures=self.scope.measures)
        claims, figures = tuple(experiment.claims(results)), experiment.figures(results)
        results.table.write(folder / f"{experiment.name}.csv")
        write_figures(folder, figures)
        section = Section.of(experiment, self.study, self.scope, claims, figures, results)
        build_page([section], folder / f"{experiment.name}.html", section.title)
        rows = tuple(dict(row) for row in results.table.rows)
        found = CampaignResult(self.study, str(folder), there, 0, seconds, rows, claims, tuple(figures), section)
        self._write(folder, status="complete", **found.payload())
        return found

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
