"""`mitsim run`: a session file in; the folders of its steps, and a page that links them, out.

Nothing is written before all steps have been checked. A folder of a finished step of the same request is left alone.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsim.bench.apparatus import check_devices
from mitsim.bench.request import Exposure, Request
from mitsim.core.configuration import load_model
from mitsim.core.environment import deciding_versions
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, checked_fields, options_of
from mitsim.core.files import PAGE, check_plain, output_folder, plain, read_json, remove_page, write_json, write_text
from mitsim.core.job import Job
from mitsim.core.manifests import MANIFEST, CalibrationManifest, RunManifest, read_manifest
from mitsim.core.spectral_manifests import bands_of, is_coloured, is_mosaic, spectral_of
from mitsim.devices.sensor import load_sensor
from mitsim.reconstruct.request import MODEL
from mitsim.sessions.session_file import (
    FOLDERS,
    OF_A_BENCH,
    Session,
    Step,
    calibration_for,
    image_request,
    read_session,
    recipe_of,
    request_of,
    sweep_options,
    swept_values,
)
from mitsim.studies.framework.experiment import is_experiment
from mitsim.verbs import WHOLE, Opening, demo, prepare_study

if TYPE_CHECKING:
    from mitsim.acquire.capture import Light
    from mitsim.api.bench import Bench
    from mitsim.light.plan import Plan

SESSION_FILE, SUMMARY = "session.toml", "session.json"
"""What a folder of a session says of itself: what was asked for, and what each step came to."""


@checked_fields
@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """How a session is run.

    Attributes
    ----------
    resume
        go on in a folder of an earlier run: what is finished, and of the same request, is left alone.
    pictures
        whether folders get pictures and pages.
    shard
        "I/N": measure part I of N of the points of a sweep, or of studies.
    scheduler
        of Dask, that measures these points.
    """

    resume: bool = False
    pictures: bool = True
    shard: str = WHOLE
    scheduler: str | None = None


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
        """Of all steps, each with its folder."""
        return tuple(dict.fromkeys(f"{step.output}: {text}" for step in self.steps for text in step.warnings))

    def payload(self) -> dict[str, Any]:
        """As JSON."""
        return {**asdict(self), "warnings": self.warnings}

    def lines(self) -> list[str]:
        """For people."""
        each = [f"{step.output}: {step.says}{' (finished before)' if step.left_alone else ''}" for step in self.steps]
        return [*each, f"Page: {self.page}" if self.page else f"Session: {self.output}"]


@check_arguments
def run(
    session: Path | str | Mapping[str, Any],
    output: Path | str = "session-output",
    values: Mapping[str, Any] | None = None,
    job: Job | None = None,
    **options: Any,
) -> SessionResult:
    """Take all steps of a session: plan, capture, calibrate, reconstruct, study and export, each into its folder.

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
    **options
        of :class:`mitsim.sessions.run_session.RunOptions`: ``resume``, ``pictures``, ``shard``, ``scheduler``.

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
    asked = RunOptions(**options_of(RunOptions, options, "run"))
    read = read_session(session, values)
    place = Path(output)
    again = (place / SUMMARY).is_file()
    if again and not asked.resume:
        raise MitsimError(f"output {place}: holds a session already; go on with resume=True, or choose another folder")
    with output_folder(place, overwrite=again) as folder:
        earlier = _earlier(folder) if again else {}
        steps = _Steps(read, folder, job or Job(), asked)
        prepared = [(step, steps.prepare(step)) for step in read.steps if steps.makes(step)]
        if any(step.verb in OF_A_BENCH for step, _ in prepared):
            steps.bench  # noqa: B018 - opened before anything is written, for it may be refused
        told = {name: (folder / name).read_text(encoding="utf-8") for name in (SESSION_FILE, SUMMARY) if again}
        head = {"kind": KIND, "session": read.tables, "versions": deciding_versions()}
        results: list[StepResult] = []
        try:
            write_text(folder / SESSION_FILE, read.text)
            for step, task in prepared:
                kept = {**earlier, **{each.output: asdict(each) for each in results}}
                write_json(folder / SUMMARY, {**head, "status": "incomplete", "steps": [*kept.values()]})
                results.append(_take(step, task, folder, earlier.get(step.output), asked.pictures))
        except MitsimError:
            if all(each.left_alone for each in results):  # nothing was made: it is the session that it was
                for name, text in told.items():
                    write_text(folder / name, text)
            raise
        remove_page(folder)
        page = _write_page(folder, read, results, job) if asked.pictures else None
        done = SessionResult(tuple(results), str(folder), page)
        write_json(folder / SUMMARY, {**head, **done.payload(), "status": "complete", "command": job and job.command})
    return done


KIND = "session"
"""What session.json says that the folder is."""


def _earlier(folder: Path) -> dict[str, dict[str, Any]]:
    """Steps of an earlier run in a ``folder``, by their output; MitsimError where it holds none of a session."""
    found = read_json(folder / SUMMARY)
    if not isinstance(found, dict) or found.get("kind") != KIND:
        raise MitsimError(f"resume=True: {folder / SUMMARY} is not that of a session; use another folder")
    steps = found.get("steps")
    told = {each.name for each in fields(StepResult)}
    listed = steps if isinstance(steps, list) else []
    return {str(each["output"]): each for each in listed if isinstance(each, dict) and each.keys() == told}


def _take(step: Step, task: _Task, folder: Path, earlier: dict[str, Any] | None, pictures: bool) -> StepResult:
    """What a ``step`` comes to by its ``task``, and its page in the session's ``folder``; where it is finished, what an
    ``earlier`` run says of it."""
    started, place = time.perf_counter(), folder / step.output
    if earlier is not None and task.is_finished():
        found = StepResult(**{**earlier, "warnings": tuple(earlier["warnings"]), "left_alone": True})
    else:
        says, warnings = task.work()
        found = StepResult(step.verb, step.output, says, tuple(warnings), time.perf_counter() - started)
    if pictures and step.verb in FOLDERS and not (found.left_alone and (place / PAGE).is_file()):
        from mitsim.report.folders import report_folder

        report_folder(place)
    pages = [place / PAGE, *sorted(place.glob("*.html"))] if place.is_dir() else []
    page = next((str(each.relative_to(folder)) for each in pages if each.is_file()), "")
    return replace(found, page=page)


def _write_page(folder: Path, session: Session, results: Sequence[StepResult], job: Job | None) -> str:
    """Write the page of a ``session`` in its ``folder``, of its ``results``; its path."""
    from mitsim.report.pages import render_page, write_html

    images = [step.output for step in results if (folder / step.output / "image.png").is_file()]
    flagged = sum(bool(step.warnings) for step in results)
    count = f"{len(results)} step{'s' * (len(results) > 1)}"
    verdict = f"{count} done" + (f", {flagged} flagged" if flagged else "")
    text = render_page(
        "session.html",
        folder=folder.absolute(),
        verdict=verdict,
        warnings=SessionResult(tuple(results), "").warnings,
        command=job and job.command,
        steps=results,
        images=images,
        text=session.text,
        file=SESSION_FILE,
    )
    return str(write_html(folder / PAGE, text))


# ---- Steps -----------------------------------------------------------------------------------------------------------

Said = tuple[str, Sequence[str]]
"""What a step came to, in a line, and its warnings."""


@dataclass(frozen=True)
class _Task:
    """What a step does, checked: its ``work``, and whether it ``is_finished``, as its folder is of the same request."""

    work: Callable[[], Said]
    is_finished: Callable[[], bool] = lambda: False


@dataclass
class _Steps:
    """The steps of a ``session`` in a ``folder``, and what they share, which is made once.

    Attributes
    ----------
    session, folder, job, asked
        as of :func:`run`.
    plan, light
        that the capture is made by; None without a step that makes them.
    """

    session: Session
    folder: Path
    job: Job
    asked: RunOptions
    plan: Plan | None = field(default=None, init=False)
    light: Light | None = field(default=None, init=False)

    def makes(self, step: Step) -> bool:
        """Whether a ``step`` makes anything itself: beside a sweep some are values of its points."""
        return self.session.step("sweep") is None or step.verb not in FOLDERS

    def prepare(self, step: Step) -> _Task:
        """A ``step`` that is checked; MitsimError for what it would refuse, before any work."""
        shared = step.verb == "sweep" or (step.verb == "study" and is_experiment(step.values["name"]))
        for name, value in (("shard", self.asked.shard != WHOLE), ("scheduler", self.asked.scheduler is not None)):
            if value and not shared:
                raise ArgumentError(name, f"has no effect on [{step.verb}], which has no points to share; leave it out")
        return _TASKS[step.verb](self, step)

    # ---- the bench ----

    @cached_property
    def opening(self) -> Opening:
        """How the scene is opened."""
        scene = self.session.scene
        own = {name: value for name, value in scene.items() if name in _OPENING}
        if any(step.values.get("colour", "no") != "no" for step in self.session.steps):
            own["variant"] = spectral_of(own.get("variant", Opening.variant))
        return Opening(**own, parameters={name: scene[name] for name in scene.keys() - {*own, "scene"}})

    @cached_property
    def bench(self) -> Bench:
        """The scene with its devices."""
        return self.opening.open(self.session.scene["scene"], self.job)

    def _check_bench(self, patterns: str, timing: Exposure | None, colour: str = "no") -> None:
        """MitsimError for ``patterns``, an exposure and a ``colour`` that the devices cannot have."""
        camera, projector = check_devices(self.opening.camera, self.opening.projector)
        sensor = load_sensor(camera)
        if colour == "mosaic" and sensor.mosaic is None:
            raise MitsimError(f"colour mosaic: camera {camera} has no colour filters; give one that has")
        if colour != "mosaic" and timing is not None:
            timing.check(sensor, camera)
        if colour not in ("no", "mosaic"):
            from mitsim.devices.projector import ProjectorModel

            light = load_model(projector, ProjectorModel)
            (light if colour == "lines" else light.in_bands(bands_of(colour))).traced_lines  # noqa: B018 - checks itself
        self.opening.check(self.session.scene["scene"], patterns, None)

    def _is_made(self, folder: Path, asked: Mapping[str, Any], more: Sequence[str] = ()) -> bool:
        """Whether a ``folder`` has all files of finished work on this bench.

        Parameters
        ----------
        folder
            of a run or a calibration.
        asked
            entries of its configuration beside the bench's.
        more
            names of entries that it has only where they are asked for.
        """
        if not (folder / MANIFEST).is_file() or is_coloured(folder):
            return False
        found = read_json(folder / MANIFEST)
        if not isinstance(found, dict) or found.get("status") != "complete":
            return False
        whole = {**self.bench.provenance(), **self.bench.identity(), **asked, "versions": deciding_versions()}
        made: dict[str, Any] = found.get("configuration") or {}
        same = all(made.get(name) == value for name, value in plain({**dict.fromkeys(more), **whole}).items())
        return same and _has_files(folder, found.get("checksums") or {})

    # ---- a verb each ----

    def _plan(self, step: Step) -> _Task:
        asked, place = request_of(step), self.folder / step.output / "plan.json"
        self._check_bench(Request.of(**asked).patterns, None)

        def is_finished() -> bool:
            from mitsim.light.plan import Plan

            if not place.is_file() or (known := Plan.load(place)).known_request != Request.of(**asked):
                return False
            known.check_made_of(self.bench.deciding)
            self.plan = known
            return True

        def work() -> Said:
            self.plan = self.bench.plan(**asked)
            place.parent.mkdir(exist_ok=True)
            self.plan.save(place)
            return (
                f"{self.plan.predicted_seconds:.3g} s, error up to {self.plan.systematic_bound:.1e}",
                self.plan.warnings,
            )

        return _Task(work, is_finished)

    def _transport(self, step: Step) -> _Task:
        asked = request_of(step)
        self._check_bench(Request.of(**asked).patterns, None)

        def is_finished() -> bool:
            capture = self.session.step("capture")
            return capture is not None and self._capture(capture).is_finished()

        def work() -> Said:
            self.light = self.bench.light(job=self.job.apart("transport "), **asked)
            return f"{self.light.paths} paths of light by projector pixel", self.light.warnings

        return _Task(work, is_finished)

    def _capture(self, step: Step) -> _Task:
        own, colour, place = request_of(step), step.values.get("colour", "no"), self.folder / step.output
        above = self.session.step("transport") or self.session.step("plan")
        planned = Request.of(**request_of(above)) if above else None
        request = (
            planned.with_values(**Request.of(**own).model_dump(exclude_unset=True)) if planned else Request.of(**own)
        )
        self._check_bench(request.patterns, request.timing, colour)

        def is_finished() -> bool:
            asked: dict[str, Any] = dict(request.deciding)
            if planned and above and above.verb == "transport":
                asked["light"] = {"patterns": planned.patterns, "seed": planned.seed}
            elif planned and planned.seed != request.seed:
                asked["plan_seed"] = planned.seed
            return colour == "no" and self._is_made(place, asked, ("light", "plan_seed"))

        def work() -> Said:
            job, resume = self.job.apart("capture "), self.asked.resume
            more = {name: value for name, value in own.items() if name != "patterns"}
            if self.light is not None:
                from mitsim.acquire.capture import expose

                return _of_run(expose(self.light, request.patterns, place, job, resume, **more).summary())
            if self.plan is not None:
                return _of_run(self.bench.capture(self.plan, place, resume, job, **own).summary())
            if colour == "mosaic":
                return _of_run(self.bench.capture_mosaic(request.patterns, place, resume, job, **more).summary())
            if colour == "no":
                return _of_run(self.bench.capture(request.patterns, place, resume, job, **more).summary())
            runs = _in_colour(self.bench, colour).capture_lines(request.patterns, place, resume, job, **more)
            return _of_lines({name: _of_run(run.summary()) for name, run in runs.items()})

        return _Task(work, is_finished)

    def _calibrate(self, step: Step) -> _Task:
        values, place = step.values, self.folder / step.output
        colour, recipe = values.get("colour", "no"), recipe_of(values)
        asked = {name: values.get(name, default) for name, default in (("seed", 0), ("accuracy", 1e-3))}
        if colour != "no":
            recipe.of_one_depth()
        self._check_bench("uniform", Exposure(None, recipe.exposure_fraction), colour)

        def is_finished() -> bool:
            model = recipe.model_dump(exclude_defaults=True, exclude={"depths"})
            return colour == "no" and not recipe.depths and self._is_made(place, {**asked, "recipe": model})

        def work() -> Said:
            whole: dict[str, Any] = {**asked, "output": place, "resume": self.asked.resume}
            whole |= {"job": self.job.apart("calibrate "), "recipe": recipe}
            if colour == "no" and not recipe.depths:
                return _of_calibration(self.bench.calibrate(**whole).manifest.result)
            if recipe.depths:
                found: Mapping[Any, Any] = self.bench.calibrate_depths(**whole)
            elif colour == "mosaic":
                found = self.bench.calibrate_mosaic(**{**whole, "recipe": recipe if "recipe" in values else None})
            else:
                found = _in_colour(self.bench, colour).calibrate_lines(**whole)
            return _of_lines({str(name): _of_calibration(each.manifest.result) for name, each in found.items()})

        return _Task(work, is_finished)

    def _reconstruct(self, step: Step) -> _Task:
        values, place, options = step.values, self.folder / step.output, image_request(step)
        run, calibration = (self._source(step, name) for name in ("run", "calibration"))
        capture = self.session.step("capture")
        coloured = is_coloured(run) if "run" in values else bool(capture and capture.values.get("colour", "no") != "no")
        if "run" in values and not coloured:
            read_manifest(run, RunManifest)
        if "calibration" in values and not is_coloured(calibration):
            read_manifest(calibration, CalibrationManifest)
        chart = None
        if "chart" in values:
            from mitsim.devices.chart import load_chart

            if not coloured:
                raise ArgumentError("chart", f"{values['chart']}: the frames are not coloured; leave it out")
            chart = load_chart(values["chart"])
        if str(options.get("method", "")).endswith(MODEL):
            check_plain(options["method"])

        def solving() -> dict[str, Any]:
            if str(options.get("method", "")).endswith(MODEL):
                from mitsim.learn.verbs import load_network

                return {**options, "method": load_network(options["method"])}
            return options

        def is_finished() -> bool:
            from mitsim.core.runs import load_run
            from mitsim.reconstruct.factors import load_calibration
            from mitsim.reconstruct.reconstruct import RESULT_FILE
            from mitsim.reconstruct.request import IMAGE_FILE, ImageRequest

            if coloured or not ((place / IMAGE_FILE).is_file() and (place / RESULT_FILE).is_file()):
                return False
            inputs = ImageRequest(**solving()).inputs(load_run(run), load_calibration(calibration))
            found = read_json(place / RESULT_FILE)
            return isinstance(found, dict) and found.get("inputs") == plain(inputs)

        def work() -> Said:
            from mitsim.report import quality

            job = self.job.apart(f"{step.output} ")
            if coloured:
                whole = {"lam": options.get("lam", "auto")} if is_mosaic(run) else solving()
                colours = quality.reconstruct_colours(run, calibration, place, chart, job=job, page=False, **whole)
                known = "" if colours.psnr_db is None else f", PSNR {colours.psnr_db:.2f} dB over all lines"
                return f"an image of every line{known}", colours.warnings
            judged = quality.reconstruct(run, calibration, place, job=job, **solving())
            image = judged.reconstruction
            return str(judged.quality or f"{image.status.sentence}."), judged.summary()["warnings"]

        return _Task(work, is_finished)

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
            scene, job = self.session.scene["scene"], self.job.apart("demo ")
            opening = {name: getattr(self.opening, name) for name in (*_OPENING, "parameters")}
            found = demo(scene, self.folder / step.output, **step.values, job=job, **opening)
            return found.verdict, found.warnings

        return _Task(work)

    def _sweep(self, step: Step) -> _Task:
        scene = {name: getattr(self.opening, name) for name in (*_OPENING, "parameters")}
        options = {name: value for name, value in scene.items() if value != getattr(Opening(), name)}
        return self._study_of(
            "sweep", self.session.scene["scene"], step, {**sweep_options(self.session, step), **options}
        )

    def _study(self, step: Step) -> _Task:
        values = {name: value for name, value in step.values.items() if name not in ("name", "scene")}
        if "over" in values:
            values["over"] = swept_values(values["over"])
        return self._study_of(step.values["name"], step.values.get("scene"), step, values)

    def _study_of(self, name: str, scene: str | None, step: Step, options: Mapping[str, Any]) -> _Task:
        """The study of a ``name`` and its ``options``, of points shared as is asked for."""
        shared = {"shard": self.asked.shard} if self.asked.shard != WHOLE else {}
        shared |= {"scheduler": self.asked.scheduler} if self.asked.scheduler else {}
        place, patterns = self.folder / step.output, options.get("patterns")
        others = {key: value for key, value in options.items() if key != "patterns"}
        study = prepare_study(name, scene, place, patterns, self.job.apart(f"{step.output} "), **others, **shared)

        def work() -> Said:
            found = study()
            return found.lines()[0], found.warnings

        return _Task(work)

    def _export(self, step: Step) -> _Task:
        values = {name: value for name, value in step.values.items() if name in ("format", "projector")}
        run, calibration = self._source(step, "run"), None
        if "calibration" in step.values or calibration_for(self.session, step):
            calibration = self._source(step, "calibration")

        def work() -> Said:
            from mitsim.exchange.formats import export

            file = self.folder / step.output
            overwrite = self.asked.resume and file.is_file()
            found = export(run, output=file, calibration=calibration, overwrite=overwrite, **values)
            return f"{found['frames']} frames as {found['format']}", ()

        return _Task(work, lambda: (self.folder / step.output).is_dir())


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
_OPENING = "variant", "camera", "projector", "allow_outside_files"
"""Arguments that open a bench, beside the scene and its parameters."""


def _has_files(folder: Path, checksums: Mapping[str, Any]) -> bool:
    """Whether the files of a ``folder`` are whole, by their ``checksums``."""
    from mitsim.core.exr import checksum

    places = {folder / name: value for name, value in checksums.items()}
    return bool(places) and all(place.is_file() and checksum(place) == value for place, value in places.items())


def _in_colour(bench: Bench, colour: str) -> Bench:
    return bench if colour == "lines" else bench.in_bands(bands_of(colour))


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
    """What is said of several folders, by their names."""
    warnings = [f"{name}: {text}" for name, (_, texts) in each.items() for text in texts]
    return "; ".join(f"{name} {says}" for name, (says, _) in each.items()), warnings
