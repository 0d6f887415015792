"""`mitsim run`: a session file in; the folders of its steps, and a page that links them, out.

Nothing is written before all steps have been checked. A folder of a finished step of the same request is left alone.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel, Field

from mitsim.bench.request import NO, Exposure, Opening, Request, SessionRequest, Task
from mitsim.core.configuration import Configuration, refuse_unused, takes, validate
from mitsim.core.environment import deciding_versions
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.files import (
    PAGE,
    PICTURES,
    check_output,
    output_folder,
    plain,
    read_json,
    remove_page,
    write_bytes,
    write_json,
    write_text,
)
from mitsim.core.job import Job
from mitsim.core.manifests import MOSAIC, RUN, CalibrationManifest, RunManifest, is_coloured, open_lines, read_manifest
from mitsim.devices.session import SessionRecipe, load_recipe
from mitsim.exchange.formats import PNG, check_export, check_format, export
from mitsim.reconstruct.request import MODEL, ImageRequest
from mitsim.sessions.session_file import (
    FOLDERS,
    OF_A_BENCH,
    SESSION_FILE,
    SUMMARY,
    Session,
    Step,
    calibration_for,
    image_request,
    portable,
    read_session,
    request_of,
    session_text,
    sweep_options,
    swept_values,
)
from mitsim.studies.framework.experiment import is_experiment
from mitsim.verbs import RunOptions, StudyOptions, calibrate_in, capture_in, open_as, prepare_study

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from mitsim.acquire.capture import Light
    from mitsim.api.bench import Bench
    from mitsim.light.plan import Plan
    from mitsim.verbs import RunKeys


class _Made(Configuration):
    """Files of a step: SHA-256 of its ``inputs``, and of each of its ``files`` by name; none of one that was begun."""

    inputs: str
    files: dict[str, str] = Field(default_factory=dict)


@dataclass(frozen=True)
class StepResult:
    """What a step came to.

    Attributes
    ----------
    step, output
        its verb, and its folder or file in the session's.
    says
        a line.
    warnings
        why it is flagged.
    seconds
        wall time.
    page
        of it, from the session's folder; empty without one.
    left_alone
        whether it was finished already.
    """

    step: str
    output: str
    says: str
    warnings: tuple[str, ...] = ()
    seconds: float = 0.0
    page: str = ""
    left_alone: bool = False


@dataclass(frozen=True)
class SessionResult:
    """What a session came to: its ``steps``, in order; its folder ``output``, and the ``page`` in it (None without)."""

    steps: tuple[StepResult, ...]
    output: str
    page: str | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of all steps, each with its folder."""
        return tuple(dict.fromkeys(f"{step.output}: {text}" for step in self.steps for text in step.warnings))

    def payload(self) -> dict[str, Any]:
        return {**asdict(self), "warnings": self.warnings}

    def lines(self) -> list[str]:
        each = [f"{step.output}: {step.says}{' (finished before)' if step.left_alone else ''}" for step in self.steps]
        return [*each, f"Page: {self.page}" if self.page else f"Session: {self.output}"]


@takes(RunOptions)
def run(
    session: Path | str | Mapping[str, Any],
    output: Path | str = "session-output",
    values: Mapping[str, Any] | None = None,
    job: Job | None = None,
    **options: Unpack[RunKeys],
) -> SessionResult:
    """Run the steps of a session: plan, capture, calibrate, reconstruct, study and export, each into its own folder.

    Parameters
    ----------
    session
        its file, the name of a shipped one, or its tables.
    output
        folder to make; with ``resume`` one of an earlier run.
    values
        of fields, in place of the file's, by name: ``{"capture.patterns": "dots:4"}``.
    job
        clock, progress and limits.

    Raises
    ------
    MitsimError
        before any work, for a file with mistakes and for what any step would refuse; for an output that holds something
        else, and for what a step refuses as it works.

    Examples
    --------
    >>> import mitsim as ms
    >>> done = ms.run("demo", "repeated", {"capture.patterns": "dots:4"})  # doctest: +SKIP
    >>> ms.load_run("repeated/run").truth  # doctest: +SKIP
    """
    asked = RunOptions(**options)
    read, place = read_session(session, values), Path(output)
    again = (place / SUMMARY).is_file()
    if again and not asked.resume:
        raise MitsimError(f"output {place}: holds a session already; go on with resume=True, or choose another folder")
    with output_folder(place, overwrite=again) as folder:
        steps = _Steps(read, folder, job or Job(), asked, _earlier(folder) if again else _Earlier())
        prepared = [(step, steps.prepare(step)) for step in read.steps if steps.makes(step)]
        steps.check_bench()
        own = [folder / name for name in (SUMMARY, SESSION_FILE)]
        before = {path: path.read_bytes() if path.is_file() else None for path in own}
        head = {"kind": KIND, "session": portable(read.tables, folder), "versions": deciding_versions()}
        results, text = list[StepResult](), session_text(read.tables, folder)

        def note() -> None:
            """Write what is finished and what is at work, so that a killed session can be resumed."""
            kept = {**steps.earlier.by_output, **{each.output: each for each in results}}
            told = {"status": "incomplete", "steps": [*map(asdict, kept.values())], "made": steps.made}
            write_json(folder / SUMMARY, {**head, **told})

        try:
            for step, task in prepared:
                if not (finished := steps.is_finished(step, task)):
                    steps.begin(step)
                note()
                write_text(folder / SESSION_FILE, text)
                results.append(_take(step, task, steps, finished))
        except MitsimError:
            if all(each.left_alone for each in results):  # nothing was made: it is the session that it was
                for path, data in before.items():
                    path.unlink(missing_ok=True) if data is None else write_bytes(path, data)
            else:
                note()
            raise
        remove_page(folder)
        page = _write_page(folder, text, results, job) if asked.pictures else None
        done = SessionResult(tuple(results), str(folder), page)
        ended = {**done.payload(), "status": "complete", "command": job and job.command, "made": steps.made}
        write_json(folder / SUMMARY, {**head, **ended})
    return done


KIND = "session"
"""What session.json says that the folder is."""


class _Earlier(BaseModel):
    """What session.json states of an earlier run."""

    kind: Literal["session"] = "session"
    steps: tuple[StepResult, ...] = ()
    made: dict[str, _Made] = Field(default_factory=dict)

    @property
    def by_output(self) -> dict[str, StepResult]:
        return {step.output: step for step in self.steps}


def _earlier(folder: Path) -> _Earlier:
    """Return the state of an earlier run in a ``folder``; MitsimError if the folder holds no session."""
    found = read_json(folder / SUMMARY)
    if not isinstance(found, dict) or found.get("kind") != KIND:
        raise MitsimError(f"resume=True: {folder / SUMMARY} is not that of a session; use another folder")
    return validate(_Earlier, found, f"resume=True: {folder / SUMMARY}")


def _take(step: Step, task: _Task, steps: _Steps, finished: bool) -> StepResult:
    """Run the ``task`` of a ``step``, unless it is ``finished``, and write the step's page."""
    started, folder, pictures = time.perf_counter(), steps.folder, steps.asked.pictures
    place = folder / step.output
    if finished:
        found = replace(steps.earlier.by_output[step.output], left_alone=True)
    else:
        with steps.earlier_aside(step):
            says, warnings = task.work()
        steps.end(step)
        found = StepResult(step.verb, step.output, says, tuple(warnings), time.perf_counter() - started)
    if pictures and step.verb in FOLDERS and not (found.left_alone and (place / PAGE).is_file()):
        from mitsim.report.folder_page import report_folder

        report_folder(place)
    pages = [place / PAGE, *sorted(place.glob("*.html"))] if place.is_dir() else []
    page = next((str(each.relative_to(folder)) for each in pages if each.is_file()), "")
    return replace(found, page=page)


def _write_page(folder: Path, session: str, results: Sequence[StepResult], job: Job | None) -> str:
    """Write the page of a session into its ``folder``, and return the page's path."""
    from mitsim.report.pages import render_page

    images = [step.output for step in results if (folder / step.output / "image.png").is_file()]
    flagged = sum(bool(step.warnings) for step in results)
    count = f"{len(results)} step{'s' * (len(results) > 1)}"
    verdict = f"{count} done" + (f", {flagged} flagged" if flagged else "")
    page = render_page(
        "session.html",
        folder=folder.absolute(),
        verdict=verdict,
        warnings=SessionResult(tuple(results), "").warnings,
        command=job and job.command,
        steps=results,
        images=images,
        text=session,
        file=SESSION_FILE,
    )
    write_text(folder / PAGE, page)
    return str(folder / PAGE)


# ---- Steps -----------------------------------------------------------------------------------------------------------

Said = tuple[str, Sequence[str]]
"""What a step came to, in a line, and its warnings."""


@dataclass(frozen=True)
class _Task:
    """What a step does, checked.

    Attributes
    ----------
    work
        makes its files.
    load
        reads what later steps need, where it is finished.
    check
        refuses what only the opened scene shows, before anything is written.
    goes_on
        whether it looks itself into what an earlier run left, and is therefore never left alone.
    """

    work: Callable[[], Said]
    load: Callable[[], object] = lambda: None
    check: Callable[[], object] = lambda: None
    goes_on: bool = False


@dataclass
class _Steps:
    """The steps of a ``session`` in a ``folder``, and what they share, which is made once.

    Attributes
    ----------
    session, folder, job, asked
        as of :func:`run`.
    earlier
        what an earlier run in the folder came to.
    made
        files of each step by its output, of the earlier run until a step begins again.
    plan, light
        that the capture is made by; None without a step that makes them.
    """

    session: Session
    folder: Path
    job: Job
    asked: RunOptions
    earlier: _Earlier
    made: dict[str, _Made] = field(init=False)
    before: _Made | None = field(default=None, init=False)
    checks: list[Callable[[], object]] = field(default_factory=list, init=False)
    plan: Plan | None = field(default=None, init=False)
    light: Light | None = field(default=None, init=False)

    def makes(self, step: Step) -> bool:
        """Return True if a ``step`` makes files itself; next to a sweep, some steps only state values of its points."""
        return self.session.step("sweep") is None or step.verb not in FOLDERS

    def prepare(self, step: Step) -> _Task:
        """Check a ``step`` before any work, and return its task."""
        shared = step.verb == "sweep" or (step.verb == "study" and is_experiment(step.values["name"]))
        if not shared:
            idle = self.asked.without("resume", "pictures")
            refuse_unused(
                [name for name in idle if idle[name] != RunOptions.model_fields[name].default],
                idle,
                f"on [{step.verb}], which has no points to share",
            )
        task = _TASKS[step.verb](self, step)
        self.checks += [task.check] if step.verb in OF_A_BENCH else []
        return task

    # ---- what is there already ----

    def __post_init__(self) -> None:
        self.made = dict(self.earlier.made)

    def inputs(self, step: Step) -> str:
        """Return the SHA-256 of all that decides the files of a ``step``: values, files that it reads, steps before."""
        read = "run", "calibration"
        values = {name: _contents(value) for name, value in step.values.items() if name not in read}
        asked: dict[str, Any] = {"versions": deciding_versions(), step.verb: values}
        if step.verb in OF_A_BENCH:
            above = [each.values for each in self.session.steps if each.verb in ("plan", "transport")]
            asked |= {**self.bench.deciding, **self.bench.identity(), "above": above}
        if step.verb in ("reconstruct", "export"):
            places = [self._source(step, name) for name in read]
            asked["read"] = [_checksums(place) for place in places if place.exists()]
        return hashlib.sha256(json.dumps(plain(asked), sort_keys=True).encode()).hexdigest()

    def is_finished(self, step: Step, task: _Task) -> bool:
        """Return True if an earlier run made the ``step``'s files from the same inputs and they have not changed; the
        ``task`` then loads what later steps need."""
        if step.verb == "transport":  # whose light is in no file
            capture = self.session.step("capture")
            known = step.output in self.earlier.by_output
            return known and capture is not None and self.is_finished(capture, task)
        made = self.made.get(step.output)
        if task.goes_on or made is None or not made.files or step.output not in self.earlier.by_output:
            return False
        there = _checksums(self.folder / step.output)
        same = made.inputs == self.inputs(step) and all(there.get(name) == each for name, each in made.files.items())
        if same:
            task.load()
        return same

    def begin(self, step: Step) -> None:
        """Note that a ``step`` is at work, so that its earlier files no longer count as finished."""
        self.before = self.made.get(step.output)
        self.made[step.output] = _Made(inputs="")

    def end(self, step: Step) -> None:
        self.made[step.output] = _Made(inputs=self.inputs(step), files=_checksums(self.folder / step.output))

    @contextmanager
    def earlier_aside(self, step: Step) -> Iterator[None]:
        """Keep an earlier image or export aside until it is made again, and restore it if that is refused. MitsimError
        if the folder has files that the session did not make."""
        place, aside = self.folder / step.output, self.folder / f".{step.output}.before"
        _remove(aside)
        if self.before is None or step.verb not in ("reconstruct", "export") or not place.exists():
            yield
            return
        others = _checksums(place).keys() - self.before.files.keys() if self.before.files else ()
        if others or place.is_symlink():
            self.made[step.output] = self.before
            other = min(others, default="it")
            raise MitsimError(f"output {place}: is made anew, and {other} is not the session's; move that away")
        os.replace(place, aside)
        try:
            yield
        except BaseException:
            _remove(place)
            os.replace(aside, place)
            self.made[step.output] = self.before
            raise
        _remove(aside)

    # ---- the bench ----

    def check_bench(self) -> None:
        """Open the scene if a step needs it, and refuse what only the opened scene shows."""
        if self.checks:
            self.bench  # noqa: B018 - opens it
        for check in self.checks:
            check()

    @cached_property
    def opening(self) -> Opening:
        scene = {name: value for name, value in self.session.scene.items() if name != "scene"}
        own = {name: scene.pop(name) for name in [*scene] if name in Opening.model_fields}
        return Opening(**own, parameters=scene)

    @cached_property
    def bench(self) -> Bench:
        colours = {step.values.get("colour", NO) for step in self.session.steps} - {NO}
        return open_as(self.session.scene["scene"], self.opening, self.job, min(colours, default=NO))

    def _check_bench(self, patterns: str | None, timing: Exposure | None, colour: str = NO) -> None:
        self.opening.check(self.session.scene["scene"], patterns, timing, colour)

    # ---- a verb each ----

    def _plan(self, step: Step) -> _Task:
        asked, place = request_of(step), self.folder / step.output / "plan.json"
        self._check_bench(Request.of(**asked).patterns, None)

        def load() -> None:
            from mitsim.light.plan import Plan

            self.plan = Plan.load(place)

        def work() -> Said:
            self.plan = self.bench.plan(**asked)
            place.parent.mkdir(exist_ok=True)
            self.plan.save(place)
            return (
                f"{self.plan.predicted_seconds:.3g} s, error up to {self.plan.systematic_bound:.1e}",
                self.plan.warnings,
            )

        return _Task(work, load, self._fits(asked))

    def _transport(self, step: Step) -> _Task:
        asked = request_of(step)
        self._check_bench(Request.of(**asked).patterns, None)

        def work() -> Said:
            self.light = self.bench.light(job=self.job.apart("transport "), **asked)
            return f"{self.light.paths} paths of light by projector pixel", self.light.warnings

        return _Task(work, check=self._fits(asked))

    def _fits(self, asked: Mapping[str, Any]) -> Callable[[], object]:
        """Return a check that the patterns ``asked`` for fit the opened scene's projector."""
        request = Request.of(**asked)
        return lambda: self.bench.family(request.patterns, request.seed)

    def _capture(self, step: Step) -> _Task:
        own, colour, place = request_of(step), step.values.get("colour", NO), self.folder / step.output
        above = self.session.step("transport") or self.session.step("plan")
        planned = Request.of(**request_of(above)) if above else None
        request = (
            planned.with_values(**Request.of(**own).model_dump(exclude_unset=True)) if planned else Request.of(**own)
        )
        self._check_bench(request.patterns, request.timing, colour)

        def work() -> Said:
            task = Task(place, self.asked.resume, self.job.apart("capture "))
            what = self.plan or request.patterns
            more = own if self.plan else {name: value for name, value in own.items() if name != "patterns"}
            found = capture_in(self.bench, colour, what, more, task, self.light)
            if isinstance(found, Mapping):
                return _of_lines({name: _of_run(run.summary()) for name, run in found.items()})
            return _of_run(found.summary())

        return _Task(work, check=self._fits({"patterns": request.patterns, "seed": request.seed}))

    def _calibrate(self, step: Step) -> _Task:
        place, colour = self.folder / step.output, step.values.get("colour", NO)
        values = {name: value for name, value in step.values.items() if name in SessionRequest.model_fields}
        if (own := values.get("recipe")) is not None:
            table = isinstance(own, Mapping)
            values["recipe"] = validate(SessionRecipe, dict(own), "recipe") if table else load_recipe(own)
        asked = SessionRequest(**values)
        recipe = asked.recipe or load_recipe()
        if colour != NO:
            recipe.of_one_depth()
        self._check_bench("uniform", Exposure(None, recipe.exposure_fraction), colour)

        def check() -> None:
            from mitsim.calibrate.board_session import Session as BoardSession

            if colour == NO and not recipe.depths:
                BoardSession(self.bench, recipe, asked.seed).check_mask(self.job)

        def work() -> Said:
            task = Task(place, self.asked.resume, self.job.apart("calibrate "))
            found = calibrate_in(self.bench, colour, asked, task)
            said = {name: _of_calibration(each.manifest.result) for name, each in found.items()}
            return said[""] if [*said] == [""] else _of_lines(said)

        return _Task(work, check=check)

    def _reconstruct(self, step: Step) -> _Task:
        values, place, options = step.values, self.folder / step.output, image_request(step)
        run, calibration = (self._source(step, name) for name in ("run", "calibration"))
        capture = self.session.step("capture")
        coloured = is_coloured(run) if "run" in values else bool(capture and capture.values.get("colour", NO) != NO)
        mosaic = bool(capture and capture.values.get("colour") == "mosaic")
        if "run" in values:
            mosaic = open_lines(run, RUN, MOSAIC).filters is not None
        if str(options.get("method", "")).endswith(MODEL):
            from mitsim.learn.verbs import load_network

            options["method"] = load_network(options["method"])
        if mosaic and (others := options.keys() - {"lam"}):
            raise ArgumentError(min(others), "has no effect on frames behind colour filters; leave it out")
        self._check_folders(step, coloured)
        if not coloured and {"run", "calibration"} <= values.keys():
            from mitsim.core.runs import load_run
            from mitsim.reconstruct.factors import load_calibration
            from mitsim.reconstruct.reconstruct import check_image

            check_image(load_run(run), load_calibration(calibration), ImageRequest(**options))
        chart = None
        if "chart" in values:
            from mitsim.devices.framelist import load_chart

            if not coloured:
                raise ArgumentError("chart", f"{values['chart']}: the frames are not coloured; leave it out")
            chart = load_chart(values["chart"])

        def work() -> Said:
            from mitsim.report.reconstruct_run import reconstruct, reconstruct_colours

            job = self.job.apart(f"{step.output} ")
            if coloured:
                colours = reconstruct_colours(run, calibration, place, chart, job=job, page=False, **options)
                known = "" if colours.psnr_db is None else f", PSNR {colours.psnr_db:.2f} dB over all lines"
                return f"an image of every line{known}", colours.warnings
            judged = reconstruct(run, calibration, place, job=job, **options)
            image = judged.reconstruction
            return str(judged.quality or f"{image.status.sentence}."), judged.summary()["warnings"]

        return _Task(work)

    def _check_folders(self, step: Step, coloured: bool) -> None:
        """Refuse folders that a ``step`` reads and that are damaged, or of another kind."""
        folders: dict[str, Any] = {"run": RunManifest, "calibration": CalibrationManifest}
        for name, model in folders.items():
            if name in step.values and not coloured and not is_coloured(folder := Path(step.values[name])):
                from mitsim.core.exr import verify_files

                remedy = "make it again, or copy it again"
                verify_files(folder, read_manifest(folder, model).checksums, remedy)

    def _source(self, step: Step, name: str) -> Path:
        """Folder of the ``run`` or the ``calibration`` of a ``step``: the one that it names, or this session's."""
        if name in step.values:
            return Path(step.values[name])
        own = self.session.step("capture" if name == "run" else "calibrate")
        return self.folder / (own.output if own else name)

    def _demo(self, step: Step) -> _Task:
        request = Request.of(**request_of(step))
        self._check_bench(request.patterns, request.timing)

        def work() -> Said:
            from mitsim.studies.demo import demo

            found = demo(self.bench, self.folder / step.output, request, self.job.apart("demo "))
            return found.verdict, found.warnings

        return _Task(work, check=self._fits(request_of(step)))

    def _sweep(self, step: Step) -> _Task:
        options = {**sweep_options(self.session, step), **self.opening.given}
        return self._study_of("sweep", self.session.scene["scene"], step, options)

    def _study(self, step: Step) -> _Task:
        values = {name: value for name, value in step.values.items() if name not in ("name", "scene")}
        if "over" in values:
            values["over"] = swept_values(values["over"])
        return self._study_of(step.values["name"], step.values.get("scene"), step, values)

    def _study_of(self, name: str, scene: str | None, step: Step, options: Mapping[str, Any]) -> _Task:
        """Return the study of a ``name`` with its ``options``, of points shared as is asked for."""
        asked = StudyOptions(**options, **self.asked.without("resume", "pictures"))
        study = prepare_study(name, scene, self.folder / step.output, asked, self.job.apart(f"{step.output} "))

        def work() -> Said:
            found = study()
            return found.lines()[0], found.warnings

        return _Task(work, goes_on=True)

    def _export(self, step: Step) -> _Task:
        values = {name: value for name, value in step.values.items() if name in ("format", "projector")}
        run, calibration = self._source(step, "run"), None
        if "calibration" in step.values or calibration_for(self.session, step):
            calibration = self._source(step, "calibration")
        check_format(values["format"], step.output, calibration, values.get("projector"))
        if "run" in step.values and ("calibration" in step.values or calibration is None):
            check_export(run, output=self.folder / step.output, calibration=calibration, **values)
        self._check_folders(step, is_coloured(run))
        if step.output not in self.made:
            check_output(self.folder / step.output, kind="folder" if values["format"] == PNG else "file")

        def work() -> Said:
            found = export(run, output=self.folder / step.output, calibration=calibration, **values)
            return f"{found['frames']} frames as {found['format']}", ()

        return _Task(work)


_TASKS: Mapping[str, Callable[[_Steps, Step], _Task]] = {
    "plan": _Steps._plan,
    "transport": _Steps._transport,
    "capture": _Steps._capture,
    "calibrate": _Steps._calibrate,
    "reconstruct": _Steps._reconstruct,
    "demo": _Steps._demo,
    "sweep": _Steps._sweep,
    "study": _Steps._study,
    "export": _Steps._export,
}


def _checksums(place: Path) -> dict[str, str]:
    """Return the SHA-256 of a file, or of each file of a folder by name, without pages and what writing leaves."""
    found = {}
    for path in sorted(place.rglob("*")) if place.is_dir() else [place] if place.is_file() else []:
        name = path.relative_to(place)
        shown = path.suffix == ".html" or PICTURES in name.parts or any(part.startswith(".") for part in name.parts)
        if path.is_file() and not (shown and path != place):
            status = path.stat()
            found[str(name)] = _checksum(path, status.st_size, status.st_mtime_ns)
    return found


@lru_cache(maxsize=1 << 16)
def _checksum(path: Path, *_: int) -> str:
    """Return the SHA-256 of a file, computed once while its size and time of writing stay."""
    from mitsim.core.exr import checksum

    return checksum(path)


def _contents(value: Any) -> Any:
    """Return values of a step with the checksums of files in place of their whole paths."""
    if isinstance(value, Mapping):
        return {name: _contents(each) for name, each in value.items()}
    return _checksums(Path(value)) or value if isinstance(value, str) and os.path.isabs(value) else value


def _remove(place: Path) -> None:
    """Remove a file, or a folder with all that is in it, if it is there."""
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place)
    else:
        place.unlink(missing_ok=True)


def _of_run(found: Mapping[str, Any]) -> Said:
    size = "x".join(map(str, found["shape"]))
    says = f"{found['frames']} frames of {size}, error up to {found['total_error_bound']:.1e}"
    return f"{says}, {found['exposure_s']:.3g} s each", found["warnings"]


def _of_calibration(result: Mapping[str, Any]) -> Said:
    error, residual = (
        math.inf if result[name] is None else result[name] for name in ("phi_error", "separability_residual")
    )
    says = f"{result['frames']} frames, factor error {error:.1e}, separability residual {residual:.2%}"
    return says, result["warnings"]


def _of_lines(each: Mapping[str, Said]) -> Said:
    warnings = [f"{name}: {text}" for name, (_, texts) in each.items() for text in texts]
    return "; ".join(f"{name} {says}" for name, (says, _) in each.items()), warnings
