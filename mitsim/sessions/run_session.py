"""The verb `mitsim run` reads a session file, and writes the folders of its steps and a page that links them.

Nothing is written before all steps have been checked. A folder of a finished step of the same request is left alone.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Generator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel, Field

from mitsim import verbs
from mitsim.bench.request import NO, Exposure, Opening, PredictRequest, Request, SessionRequest, Task
from mitsim.core import files
from mitsim.core.colour_files import MOSAIC, RUN, is_coloured, open_lines
from mitsim.core.configuration import Configuration, refuse_together, takes, validate
from mitsim.core.environment import deciding_versions
from mitsim.core.errors import ArgumentError, MitsimError, cut
from mitsim.core.headline import calibration_headline, each_once, frames_headline, headline, image_headline
from mitsim.core.job import Job
from mitsim.core.manifests import CalibrationManifest, RunManifest, read_manifest
from mitsim.design.goal import Goal
from mitsim.devices.framelist import load_chart
from mitsim.devices.session import SessionRecipe, load_recipe
from mitsim.exchange.formats import OF_FOLDERS, Exported, check_export, export
from mitsim.reconstruct.request import MODEL, ImageRequest
from mitsim.sessions import session_file
from mitsim.verbs import RunOptions, StudyOptions, calibrate_in, capture_in, load_network, open_as, prepare_study

if TYPE_CHECKING:
    from mitsim.acquire.capture import Light
    from mitsim.api.bench import Bench

KIND: Literal["session"] = "session"
"""Kind of the folder in session.json."""


@dataclass(frozen=True)
class StepResult:
    """Result of a step.

    Attributes
    ----------
    step, output
        Verb of the step, and its folder or file in the session's.
    says, warnings
        A line on the result, and the reasons why the step is flagged.
    seconds
        Wall time.
    page
        Page of the step, from the session's folder; empty without one.
    left_alone
        True if the step was finished already.
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
    """Results of a session's ``steps``, in order, with its folder ``output`` and its ``page`` (None without one)."""

    steps: tuple[StepResult, ...]
    output: str
    page: str | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return the warnings of all steps, each once, with the folder of the step that caused it."""
        return each_once({step.output: step.warnings for step in self.steps})

    @property
    def headline(self) -> str:
        """Number of steps, the last figure of any step, and the main flag."""
        figures = [", " + figure for step in self.steps if (figure := step.says.partition(", ")[2])]
        count, last = len(self.steps), "".join(figures[-1:])
        return headline(f"Ran {count} step{'s' * (count > 1)}{last}", self.warnings)

    def payload(self) -> dict[str, Any]:
        return {"headline": self.headline, **asdict(self), "warnings": self.warnings}

    def lines(self) -> list[str]:
        marks = [" (flagged)" * bool(step.warnings) + " (finished before)" * step.left_alone for step in self.steps]
        each = [f"{step.output}: {step.says}{mark}" for step, mark in zip(self.steps, marks, strict=True)]
        return [self.headline, *each, f"Page: {self.page}" if self.page else f"Session: {self.output}"]


class _Made(Configuration):
    """Files of a step: SHA-256 of its ``inputs``, and of each of its ``files`` by name; none of one that was begun."""

    inputs: str
    files: dict[str, str] = Field(default_factory=dict)


class _Earlier(BaseModel):
    """Content of session.json on an earlier run."""

    kind: Literal["session"]
    steps: tuple[StepResult, ...] = ()
    made: dict[str, _Made] = Field(default_factory=dict)


@takes(RunOptions)
def run(
    session: Path | str | Mapping[str, Any],
    output: Path | str = "session-output",
    values: Mapping[str, Any] | None = None,
    job: Job | None = None,
    **options: Any,
) -> SessionResult:
    """Run the steps of a session, such as predict, capture, calibrate and reconstruct, each into its own folder.

    Parameters
    ----------
    session
        Session file, name of a shipped one, or its tables.
    output
        Folder to make; with ``resume`` the folder of an earlier run.
    values
        Values of fields by name, in place of those of the file: ``{"capture.patterns": "dots:4"}``.
    job
        Clock, progress and limits.

    Raises
    ------
    MitsimError
        before any work, for a file with mistakes and for a request that any step would refuse; for an output that holds
        something else, and for errors of a step at work.

    Examples
    --------
    >>> import mitsim as ms
    >>> done = ms.run("demo", "repeated", {"capture.patterns": "dots:4"})  # doctest: +SKIP
    >>> ms.load_run("repeated/run").truth  # doctest: +SKIP
    """
    asked = RunOptions(**options)
    read, place = session_file.read_session(session, values), Path(output)
    needed = session_file.own_files(read.tables).items()
    if missing := [f"{field}: {path} is missing; copy it there" for field, path in needed if not path.exists()]:
        raise refuse_together(f"session {cut(str(session), 100)}", missing)
    again, earlier = (place / session_file.SUMMARY).is_file(), _Earlier(kind=KIND)
    if again and not asked.resume:
        raise MitsimError(f"output {place}: holds a session already; use resume=True, or choose another folder")
    with files.output_folder(place, overwrite=again) as folder:
        if again:
            summary = folder / session_file.SUMMARY
            earlier = validate(_Earlier, files.read_json(summary), f"resume=True: {summary}")
        steps = _Steps(read, folder, job or Job(), asked, {step.output: step for step in earlier.steps}, earlier.made)
        work = []
        for step in read.steps:
            task = getattr(steps, f"_{step.verb}")(step)
            next(task)
            work.append((step, task))
        for step, task in work:
            if step.verb in session_file.OF_A_BENCH:
                next(task)
        head = {"kind": KIND, "session": session_file.stated(read.tables, folder), "versions": deciding_versions()}
        results, text = list[StepResult](), session_file.session_text(read.tables, folder)

        def note(**more: Any) -> None:
            """Write the finished steps and the one at work, so that a killed session can be resumed."""
            kept = {**steps.earlier, **{each.output: each for each in results}}
            known = {"status": "incomplete", "steps": [*map(asdict, kept.values())], "made": steps.made}
            files.write_json(folder / session_file.SUMMARY, {**head, **known, **more})

        if not again:
            files.write_text(folder / session_file.SESSION_FILE, text)
        for step, task in work:
            started = time.perf_counter()
            if steps.is_finished(step):
                found = replace(steps.earlier[step.output], left_alone=True)
            else:
                steps.made[step.output] = _Made(inputs="")  # its earlier files no longer count
                note()
                try:
                    while True:
                        next(task)
                except StopIteration as ended:
                    says, warnings = ended.value
                steps.made[step.output] = _Made(inputs=steps.inputs(step), files=_checksums(folder / step.output))
                found = StepResult(step.verb, step.output, says, tuple(warnings), time.perf_counter() - started)
                # Not before, because a step that is refused changes no session.
                files.write_text(folder / session_file.SESSION_FILE, text)
            results.append(replace(found, page=steps.page_of(step, found.left_alone)))
            note()
        files.remove_page(folder)
        done = SessionResult(tuple(results), str(folder), str(folder / files.PAGE) if asked.pictures else None)
        if asked.pictures:
            from mitsim.report.pages import render_page, scene_name, subject

            opened = any(step.verb in session_file.OF_A_BENCH for step in read.steps)
            made = ", ".join(step.output for step in read.steps)
            about = (scene_name(steps.bench.loaded.path), steps.bench.sensor.name) if opened else (made, "")
            page = render_page(
                "session.html",
                title=f"Session {folder.name}: {subject(*about)}",
                verdict=done.headline,
                warnings=done.warnings,
                command=job and job.command,
                steps=results,
                images=[step for step in results if (folder / step.output / "image.png").is_file()],
                text=text,
                file=session_file.SESSION_FILE,
            )
            files.write_text(folder / files.PAGE, page)
        note(**done.payload(), status="complete", command=job and job.command)
    return done


# ---- Steps -----------------------------------------------------------------------------------------------------------

Said = tuple[str, Sequence[str]]
"""Result of a step in a line, and its warnings."""
Work = Generator[None, None, Said]
"""A step's work. It has checked the request at its first yield, and has written nothing. A step of a bench has checked
the opened scene at a second yield. Then it makes its files, and returns its result."""


@dataclass
class _Steps:
    """The steps of a ``session`` in a ``folder``, and the bench and light that they share.

    ``earlier`` are results of an earlier run in the folder, and ``made`` the files, by the step's output. ``light`` is
    that of an earlier step, in which frames are exposed.
    """

    session: session_file.Session
    folder: Path
    job: Job
    asked: RunOptions
    earlier: Mapping[str, StepResult]
    made: dict[str, _Made]
    light: Light | None = field(default=None, init=False)

    # ---- Files that are there already ----

    def inputs(self, step: session_file.Step) -> str:
        """Return the SHA-256 of all inputs of a ``step``: its values, its input files, and the steps before it."""
        read = "run", "calibration"
        values = {name: _contents(value) for name, value in step.values.items() if name not in read}
        asked: dict[str, Any] = {"versions": deciding_versions(), step.verb: values}
        if step.verb in session_file.OF_A_BENCH:
            above = [each.values for each in self.session.steps if each.verb == "transport"]
            asked |= {**self.bench.deciding, **self.bench.identity(), "above": above}
        if step.verb in ("reconstruct", "export"):
            places = [self._source(step, name) for name in read]
            asked["read"] = [_checksums(place) for place in places if place.exists()]
        return hashlib.sha256(json.dumps(files.plain(asked), sort_keys=True).encode()).hexdigest()

    def is_finished(self, step: session_file.Step) -> bool:
        """Return True if an earlier run wrote this ``step``'s files from the same inputs and they have not changed."""
        if step.verb == "transport":  # whose light is in no file
            capture = self.session.step("capture")
            return step.output in self.earlier and capture is not None and self.is_finished(capture)
        made = self.made.get(step.output)
        if step.verb == "study" or made is None or not made.files or step.output not in self.earlier:
            return False  # a study finds its finished points itself
        there = _checksums(self.folder / step.output)
        return made.inputs == self.inputs(step) and made.files.items() <= there.items()

    def page_of(self, step: session_file.Step, left_alone: bool) -> str:
        """Write the page of a finished ``step`` unless it is there, and return its name; empty without one."""
        place = self.folder / step.output
        there = left_alone and (place / files.PAGE).is_file()
        if self.asked.pictures and step.verb in session_file.FOLDERS and not there:
            from mitsim.report.folder_page import report_folder

            report_folder(place)
        pages = [place / files.PAGE, *sorted(place.glob("*.html"))] if place.is_dir() else []
        return next((str(each.relative_to(self.folder)) for each in pages if each.is_file()), "")

    # ---- The bench, and folders that steps read ----

    @cached_property
    def opening(self) -> Opening:
        scene = {name: value for name, value in self.session.scene.items() if name != "scene"}
        own = {name: scene.pop(name) for name in [*scene] if name in Opening.model_fields}
        return Opening(**own, parameters=scene)

    @cached_property
    def bench(self) -> Bench:
        colours = {step.values.get("colour", NO) for step in self.session.steps} - {NO}
        return open_as(self.session.scene["scene"], self.opening, self.job, min(colours, default=NO))

    def _asked(self, request: Request, timing: Exposure | None, colour: str = NO) -> Generator[None, None, None]:
        self.opening.check(self.session.scene["scene"], request.patterns, timing, colour)
        yield
        self.bench.family(request.patterns, request.seed)
        yield

    def _source(self, step: session_file.Step, name: str) -> Path:
        """Return the folder of the ``run`` or the ``calibration`` of a ``step``: as it states, or this session's."""
        if name in step.values:
            return Path(step.values[name])
        own = self.session.step("capture" if name == "run" else "calibrate")
        return self.folder / (own.output if own else name)

    # ---- A verb each ----

    def _predict(self, step: session_file.Step) -> Work:
        asked = PredictRequest(**_with_recipe(step.of(PredictRequest)))
        self.opening.check(self.session.scene["scene"], asked.patterns, asked.timing)
        yield
        self.bench.family(asked.patterns, asked.seed)
        yield
        from mitsim.design.predict import predict

        found = predict(self.bench, asked, self.job.apart("predict "))
        with files.output_folder(self.folder / step.output, overwrite=self.asked.resume) as folder:
            files.write_json(folder / "prediction.json", found.payload())
        return f"Predicted image under {found.patterns}, PSNR {found.psnr_db:.1f} dB", found.warnings

    def _transport(self, step: session_file.Step) -> Work:
        asked = step.of(Request)
        yield from self._asked(Request(**asked), None)
        self.light = self.bench.light(job=self.job.apart("transport "), **asked)
        return f"{self.light.paths} paths of light by projector pixel", self.light.warnings

    def _capture(self, step: session_file.Step) -> Work:
        own, colour, place = step.of(Request), step.values.get("colour", NO), self.folder / step.output
        above, request = self.session.step("transport"), Request(**own)
        if above:
            request = Request(**above.of(Request)).with_values(**request.model_dump(exclude_unset=True))
        yield from self._asked(request, request.timing, colour)
        task = Task(place, self.asked.resume, self.job.apart("capture "))
        more = {name: value for name, value in own.items() if name != "patterns"}
        found = capture_in(self.bench, colour, request.patterns, more, task, self.light)
        runs = found if isinstance(found, Mapping) else {"": found}
        reasons = each_once({name: run.warnings for name, run in runs.items()})
        return frames_headline([run.summary() for run in runs.values()]), reasons

    def _calibrate(self, step: session_file.Step) -> Work:
        asked, colour = SessionRequest(**_with_recipe(step.of(SessionRequest))), step.values.get("colour", NO)
        recipe = asked.recipe or load_recipe()
        if colour != NO:
            recipe.of_one_depth()
        timing = Exposure(None, recipe.exposure_fraction)
        self.opening.check(self.session.scene["scene"], "uniform", timing, colour)
        yield
        from mitsim.calibrate.board_session import Session as BoardSession

        if colour == NO and not recipe.depths:
            BoardSession(self.bench, recipe, asked.seed).check_mask(self.job)
        yield
        task = Task(self.folder / step.output, self.asked.resume, self.job.apart("calibrate "))
        found = calibrate_in(self.bench, colour, asked, task)
        reasons = each_once({name: factors.warnings for name, factors in found.items()})
        return calibration_headline([factors.manifest.result for factors in found.values()]), reasons

    def _reconstruct(self, step: session_file.Step) -> Work:
        values, place, options = step.values, self.folder / step.output, step.of(ImageRequest)
        run, calibration = (self._source(step, name) for name in ("run", "calibration"))
        if "run" in values:
            coloured, mosaic = is_coloured(run), open_lines(run, RUN, MOSAIC).filters is not None
        else:
            capture = self.session.step("capture")
            colour = capture.values.get("colour", NO) if capture else NO
            coloured, mosaic = colour != NO, colour == "mosaic"
        if str(options.get("method", "")).endswith(MODEL):
            options["method"] = load_network(options["method"])
        if mosaic and (others := options.keys() - {"lam"}):
            raise ArgumentError(min(others), "has no effect on frames behind colour filters; leave it out")
        folders: dict[str, Any] = {"run": RunManifest, "calibration": CalibrationManifest}
        for name in folders.keys() & values.keys() if not coloured else ():
            read_manifest(Path(values[name]), folders[name])
        if not coloured and folders.keys() <= values.keys():
            from mitsim.core.runs import load_run
            from mitsim.reconstruct.factors import load_calibration
            from mitsim.reconstruct.reconstruct import check_image

            check_image(load_run(run), load_calibration(calibration), ImageRequest(**options))
        chart = None
        if "chart" in values:
            if not coloured:
                raise ArgumentError("chart", f"{values['chart']}: the frames are not coloured; leave it out")
            chart = load_chart(values["chart"])
        yield
        from mitsim.report.reconstruct_run import reconstruct, reconstruct_colours

        again: Any = {"overwrite": self.asked.resume, "job": self.job.apart(f"{step.output} ")}
        make: Any = partial(reconstruct_colours, chart=chart, page=False) if coloured else reconstruct
        found = make(run, calibration, place, **again, **options).summary()
        return image_headline(found), found["warnings"]

    def _study(self, step: session_file.Step) -> Work:
        options = dict(step.values)
        name, scene = options.pop("name"), options.pop("scene", None)
        job = self.job.apart(f"{step.output} ")
        study = prepare_study(name, scene, self.folder / step.output, StudyOptions(**options), job)
        yield
        found = study()
        return found.headline.partition(". Flagged")[0], found.warnings

    def _design(self, step: session_file.Step) -> Work:
        place, asked = self.folder / step.output, verbs.DesignOptions(resume=self.asked.resume)
        work = verbs.prepare_design(Goal(**step.of(Goal)), place, asked)
        yield
        found = work(self.job.apart(f"{step.output} "))
        return found.headline.partition(". Flagged")[0], found.warnings

    def _export(self, step: session_file.Step) -> Work:
        values, place = step.values, self.folder / step.output
        how: dict[str, Any] = {name: values[name] for name in ("format", "projector") if name in values}
        run, how["output"] = self._source(step, "run"), place
        if "calibration" in values or session_file.calibration_for(self.session, step):
            how["calibration"] = self._source(step, "calibration")
        if "run" in values and ("calibration" in values or "calibration" not in how):
            check_export(run, Exported(**how))
        pictures = values["format"] in OF_FOLDERS  # a folder of which is not replaced, so it is refused before any work
        if not self.is_finished(step) if pictures else step.output not in self.made:
            files.check_output(place, kind="folder" if pictures else "file")
        yield
        again = self.asked.resume and not pictures
        found = export(run, overwrite=again, **how)
        return f"Exported {found['frames']} frames as {found['format']}", ()


def _with_recipe(values: dict[str, Any]) -> dict[str, Any]:
    if (own := values.get("recipe")) is not None:
        table = isinstance(own, Mapping)
        values["recipe"] = validate(SessionRecipe, dict(own), "recipe") if table else load_recipe(own)
    return values


def _checksums(place: Path) -> dict[str, str]:
    """Return SHA-256 by file name: for one file, or for all files in a folder except pages and unfinished files."""
    found = {}
    for path in sorted(place.rglob("*")) if place.is_dir() else [place] if place.is_file() else []:
        name = path.relative_to(place)
        shown = path.suffix == ".html" or any(part == files.PICTURES or part[0] == "." for part in name.parts)
        if path.is_file() and not (shown and path != place):
            status = path.stat()
            found[str(name)] = _checksum(path, status.st_size, status.st_mtime_ns)
    return found


@lru_cache(maxsize=1 << 16)
def _checksum(path: Path, *_: int) -> str:
    from mitsim.core.exr import checksum

    return checksum(path)


def _contents(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _contents(each) for name, each in value.items()}
    return _checksums(Path(value)) or value if isinstance(value, str) and os.path.isabs(value) else value
