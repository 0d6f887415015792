"""Verbs of the Python face that belong to no object, and take scenes, cameras and folders by name.

The command line calls them. A request is checked here before anything heavy is imported.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from mitsim.bench.request import (
    AUTO,
    MOSAIC,
    NO,
    Exposure,
    Family,
    Irradiance,
    Opening,
    Planned,
    PredictRequest,
    Procedure,
    Request,
    Sampled,
    Seeded,
    SessionRequest,
    Task,
    Working,
    by_line,
    check_image,
    family_of,
)
from mitsim.core import environment
from mitsim.core.colour_files import BANDS, LINES, RUN, bands_of, spectral_of
from mitsim.core.colour_files import MOSAIC as MOSAIC_RUN
from mitsim.core.configuration import (
    CAMERA,
    LIMITS,
    OUTPUT,
    QUALITY,
    WHAT,
    FilePath,
    Options,
    Styled,
    load_model,
    locate,
    opening_words,
    option,
    shipped_files,
    takes,
    validated_by,
)
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, is_path, short_text
from mitsim.core.files import PAIRS, check_apart, check_output, check_plain, output_file
from mitsim.core.job import Job
from mitsim.devices.framelist import capacity_of, load_flats
from mitsim.devices.patterns import pattern_names, read_name
from mitsim.devices.sensor import load_sensor
from mitsim.devices.session import Drift, load_recipe
from mitsim.learn.requests import PairOptions, PairsRequest, Schedule, Training, check_torch
from mitsim.reconstruct.request import TIKHONOV
from mitsim.studies import OF_CAPTURES, OF_NO_SCENE, find_files

if TYPE_CHECKING:
    from mitsim.acquire.capture import Light
    from mitsim.acquire.sense import Sensed
    from mitsim.api.bench import Bench
    from mitsim.core.arrays import FloatArray
    from mitsim.core.runs import Capture
    from mitsim.design.goal import Goal
    from mitsim.design.predict import Prediction
    from mitsim.learn.networks import LearnedSolver, Trained
    from mitsim.learn.pair_store import PairStore
    from mitsim.light.plan import Plan
    from mitsim.reconstruct.factors import Factors
    from mitsim.studies.characterise import Characterisation
    from mitsim.studies.compare import Comparison
    from mitsim.studies.demo import DemoResult
    from mitsim.studies.framework.campaign import StudyResult
    from mitsim.studies.framework.experiment import Scope
    from mitsim.studies.mask_design import Design


# ---- this machine, and what is shipped -------------------------------------------------------------------------------


doctor = check_arguments(environment.doctor)


def scenes() -> dict[str, str]:
    """Return a sentence on each shipped scene, by the name that :func:`mitsim.open_bench` takes.

    Examples
    --------
    >>> import mitsim as ms
    >>> ms.scenes()["photograph"]
    'A printed photograph (a portrait), diffuse, 128 mm a side, 400 mm from the camera'
    """
    return {
        name: opening_words(path)[0].removesuffix(".") for name, path in shipped_files("scenes", "scene.xml").items()
    }


# ---- a scene with its devices ----------------------------------------------------------------------------------------


def open_as(scene: Path | str, opening: Opening, job: Job, colour: str = NO) -> Bench:
    """Open the bench of a ``scene`` as ``opening`` states, for a ``colour``, in a stage of the ``job``."""
    from mitsim.api.bench import open_bench

    variant = opening.variant if colour in (NO, AUTO) else spectral_of(opening.variant)
    with job.clock.stage("open scene"):
        return open_bench(
            scene, variant, opening.camera, opening.projector, opening.allow_outside_files, **opening.parameters
        )


def in_colour(bench: Bench, colour: str) -> Bench:
    """Return the ``bench`` with the lines that ``colour`` names; ArgumentError for more bands than it has lines."""
    return bench.in_bands(bands_of(colour)) if colour.startswith(BANDS) else bench


def plan_in(bench: Bench, colour: str, request: Planned) -> Plan:
    """Return the plan of a ``request`` on a ``bench``, for light in a ``colour``."""
    if colour == AUTO:
        return bench.choose_colour(**request.given).plan
    if colour == NO:
        return bench.plan(**request.given)
    from mitsim.acquire.spectral import SpectralBench

    return SpectralBench.of(in_colour(bench, colour), MOSAIC_RUN if colour == MOSAIC else RUN).plan(
        Request(**request.given)
    )


def capture_in(
    bench: Bench, colour: str, what: Plan | str, request: Mapping[str, Any], task: Task, light: Light | None = None
) -> Capture | Mapping[str, Capture]:
    """Return the capture of a family, or of a plan, in a ``colour``; of lines, one for each by name.

    Parameters
    ----------
    bench, colour
        Bench, and the word of its light that is told apart.
    what, request
        Family or plan, and the fields of a request beside it.
    task, light
        Where frames go; and light that is traced already, of whose patterns ``what`` is one.
    """
    where: dict[str, Any] = {"output": task.output, "resume": task.resume, "job": task.job, **request}
    if light is not None:
        from mitsim.acquire.capture import expose

        return expose(light, str(what), task, **request)
    if colour == AUTO:
        chosen = bench.choose_colour(str(what), **request)
        bench, what, colour = chosen.bench, chosen.plan, NO if chosen.mono else LINES
        where = {name: value for name, value in where.items() if name not in request}
    if by_line(colour):
        return in_colour(bench, colour).capture_lines(what, **where)
    take: Any = bench.capture_mosaic if colour == MOSAIC else bench.capture
    return take(what, **where)  # type: ignore[no-any-return]


def calibrate_in(bench: Bench, colour: str, request: SessionRequest, task: Task) -> Mapping[str, Factors]:
    """Return the factors of a calibration session in a ``colour``: by line, by depth, or of the name "" alone."""
    where: Any = {"output": task.output, "resume": task.resume, "job": task.job, **request.given}
    if colour != NO:
        seen = in_colour(bench, colour)
        return (seen.calibrate_mosaic if colour == MOSAIC else seen.calibrate_lines)(**where)
    if request.recipe is not None and request.recipe.depths:
        return {f"{depth:g}": each for depth, each in bench.calibrate_depths(**where).items()}
    return {"": bench.calibrate(**where)}


class Predicted(PredictRequest, Opening):
    """A prediction, and what opens its bench."""

    VERB = "predict"


@takes(Predicted, without="patterns")
def predict(scene: Path | str, patterns: str = "dots:7", job: Job | None = None, **options: Any) -> Prediction:
    """Open a bench, and predict the PSNR of an image and its errors by cause; see :meth:`mitsim.Bench.predict`.

    Parameters
    ----------
    scene
        name of a shipped one, or a path.
    patterns
        name of a family.
    job
        clock and progress.

    Raises
    ------
    MitsimError
        for files that cannot be used, a request that cannot be served, and a mask without factors.
    """
    asked, job = Predicted(patterns=patterns, **options), job or Job()
    asked.check(scene, asked.patterns, asked.timing)
    return open_as(scene, asked, job).predict(job=job, **asked.part(PredictRequest).given)


# ---- the demo --------------------------------------------------------------------------------------------------------


class DemoRequest(Opening, Sampled, Family):
    """How the demo is made."""

    VERB = "demo"


@takes(DemoRequest, Working, without="resume")
def demo(scene: Path | str = "photograph", output: Path | str = "demo-output", **options: Any) -> DemoResult:
    """Plan, capture, calibrate and reconstruct one scene under five pattern families, and write report.html.

    Parameters
    ----------
    scene
        name of a shipped one, or a path.
    output
        folder that is made, or of an earlier demo, which is replaced.

    Raises
    ------
    MitsimError
        for files that cannot be used, patterns that do not fit, a camera without a full well, a scene without light, an
        output that cannot be written or holds something else, or work beyond the job's limits.
    """
    from mitsim.studies.framework.campaign import check_study_folder

    job, asked = Task.taken(None, options).job, DemoRequest(**options)
    request = Request(patterns=asked.patterns, accuracy=asked.accuracy, seed=asked.seed)
    check_study_folder(output, "demo")
    asked.check(scene, asked.patterns, request.timing)
    bench = open_as(scene, asked, job)
    from mitsim.studies.demo import demo as run_demo  # only now: it takes seconds to import

    return run_demo(bench, output, request, job)


# ---- studies ---------------------------------------------------------------------------------------------------------

MERGE = "merge"
"""In the place of a study's name: joins the parts of one."""
WHOLE = "1/1"
"""The only part of a study that is not shared."""


_KNOBS = {"lam": "asked_lambda", "lambda": "asked_lambda"}
"""Names of a sweep's table for those of the command line and of Python."""


class StudyOptions(Styled, Opening, Seeded):
    """How a study is made."""

    PANEL = WHAT
    VERB = "study"

    patterns: Annotated[str, validated_by(family_of)] | None = option(None, pattern_names(), metavar="PATTERNS")
    recipe: FilePath | None = option(None, "only with calibration and drift: session recipe", metavar="FILE.toml")
    data: FilePath | None = option(None, "only with twin and learned: folder of real captures", metavar="DIR")
    experiment: str | None = option(None, "only with merge of your own study: its module", metavar="MODULE")
    quick: bool = option(False, "measure a few points only, for a first look", panel=QUALITY)
    shard: str = option(WHOLE, "measure part I of N of the points, on one of N machines", metavar="I/N", panel=LIMITS)
    jobs: int | None = option(None, "number of processes", show_default="one for each processor", panel=LIMITS)
    scheduler: str | None = option(None, "Dask scheduler that measures the points", metavar="ADDRESS", panel=LIMITS)
    over: Mapping[str, Any] | Sequence[str] = option(
        (),
        "only with sweep and drift: quantity to vary, with values FIRST:LAST:COUNT or VALUE,VALUE; in sweep a "
        "parameter of the scene, patterns, exposure, seed, accuracy or method; repeatable",
        metavar="NAME=VALUES",
        kind=list[str],
    )
    measure: str = option("psnr", "only with sweep: results to plot, such as psnr, ssim, misfit", metavar="NAME,...")
    method: str | Sequence[str] = option(
        TIKHONOV, "only with sweep: methods of its images", metavar="NAME,...", kind=str
    )
    lam: str | float | Sequence[str | float] = option(
        AUTO, "only with sweep: regularisations of its images, or auto", "--lambda", metavar="auto|VALUE,...", kind=str
    )
    seeds: int = option(
        1, "only with sweep: seeds, from --seed on, to take means and 95 % intervals of", metavar="N", min=1, max=1000
    )

    @property
    def varied(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """Names and values that are varied, and those of method and lambda if they are given."""
        from mitsim.bench.apparatus import spelling
        from mitsim.studies.framework.experiment import values_of

        over = self.over.items() if isinstance(self.over, Mapping) else map(values_of, self.over)
        each = [*over, *((name, values) for name, values in self.given.items() if name in ("method", "lam"))]
        lists = [(name, values.split(",") if isinstance(values, str) else values) for name, values in each]
        lists = [(name, values if isinstance(values, (list, tuple)) else [values]) for name, values in lists]
        return tuple((_KNOBS.get(name, name), tuple(map(spelling, values))) for name, values in lists)


@takes(StudyOptions, Working, without="resume")
def study(
    name: str,
    scene: Path | str | Sequence[Path | str] | None = None,
    output: Path | str = "study-output",
    **options: Any,
) -> StudyResult:
    """Run an experiment, and write its figures, CSV and JSON to a folder.

    Parameters
    ----------
    name
        Name of the study, or ``merge``, which joins the parts of ``shard``.
    scene
        name of a shipped one, or a path; None: the photograph, or the study's own. Of ``merge`` folders of parts.
    output
        folder that is made, or of an earlier run of the study, which goes on or is replaced.

    Returns
    -------
    StudyResult
        with ``rows``, a list of dict; ``to_pandas()``; ``pictures``, paths by name; ``lines()``, what it comes to.

    Raises
    ------
    MitsimError
        for another name, options that have no effect on the study, files that cannot be used, an output that holds
        something else, and whatever the study itself refuses.

    Examples
    --------
    >>> import mitsim as ms
    >>> found = ms.study("sweep", "photograph", "sweep", over={"sheet_z": [390, 400, 410]})  # doctest: +SKIP
    >>> [(row["sheet_z"], row["psnr_db"]) for row in found.rows]  # doctest: +SKIP
    """
    job = Task.taken(None, options).job
    return prepare_study(name, scene, output, StudyOptions(**options), job)()


def prepare_study(
    name: str, scene: Path | str | Sequence[Path | str] | None, output: Path | str, asked: StudyOptions, job: Job
) -> Callable[[], StudyResult]:
    """Check a study as :func:`study` does before the renderer is imported, and return the function that runs it.

    A study is measured on eight test images on the photograph's sheet (two if ``quick``), or on one ``scene``.
    """
    from mitsim.studies.framework.experiment import QUICK_IMAGES, TEST_IMAGES, Scope, Setup, check_study

    scenes: list[Any] = [] if scene is None else [*scene] if isinstance(scene, (list, tuple)) else [scene]
    if wrong := [one for one in scenes if not isinstance(one, (str, Path))]:
        raise ArgumentError("scene", f"{wrong[0]!r}: give a path")
    if name == MERGE:
        others = (name for name in asked.given if name not in ("experiment", "variant"))
        asked.refuse(others, "with merge, because the parts state it")
        from mitsim.studies.framework.campaign import merge

        return partial(merge, [Path(part) for part in scenes], output, asked.experiment)
    asked.refuse(["experiment"], "except with merge (your own study's module is given as its name)")
    if name not in OF_CAPTURES:
        asked.refuse(["data"], f"except on the studies {' and '.join(OF_CAPTURES)}")
    if asked.recipe is not None and name not in ("calibration", "drift"):
        raise MitsimError(f"study {name}: has no session of its own; a recipe is for calibration and drift")
    patterns = Request(patterns=asked.patterns or "dots:7", seed=asked.seed).patterns
    if len(scenes) > 1:
        raise MitsimError(f"study {name}: got {len(scenes)} scenes, {' '.join(map(str, scenes))}; give one scene")
    check_study(name)
    from mitsim.studies.framework.campaign import Where, run_experiment, shard_of

    place = str(scenes[0]) if scenes else None
    camera, projector, recipe, data = (
        None if each is None else str(each) for each in (asked.camera, asked.projector, asked.recipe, asked.data)
    )
    parameters = tuple(sorted(asked.texts.items()))
    setup = Setup(place or "photograph", None, parameters, camera, projector, asked.variant, asked.allow_outside_files)
    pictures: tuple[str | None, ...] = (None,) if place else QUICK_IMAGES if asked.quick else TEST_IMAGES
    if recipe is not None:
        load_recipe(recipe)
    if name in OF_NO_SCENE or data is not None:
        if place is not None:
            raise MitsimError(f"study {name} {place}: this study uses no scene; leave the scene out")
        of_scenes = "patterns", "camera", "projector", "parameters", "allow_outside_files"
        asked.refuse(of_scenes, f"on the study {name}, which uses no scene")
        find_files(None if data is None else Path(data), name)
    if name != "sweep":
        asked.refuse(("method", "lam", "seeds"), f"on the study {name}, but on sweep")
    seeds = tuple(range(asked.seed, asked.seed + asked.seeds))
    Request(seed=seeds[-1])
    scope = Scope(setup, pictures, seeds, asked.quick, recipe=recipe, data=data, style=asked.style)
    scope = scope_of(name, scope, patterns, asked.varied, asked.measure)
    if name not in ("accuracy", "calibration", "sweep", "drift"):
        asked.refuse(["patterns"], f"on the study {name}, which has its own patterns")
    if asked.scheduler is not None:
        asked.refuse(["jobs"], "with a scheduler, whose machines have processes of their own")
    where = Where(shard_of(asked.shard), asked.jobs, asked.scheduler)
    _check_setup(scope, place)
    return partial(run_experiment, name, scope, Path(output), job, where)


def scope_of(
    name: str, scope: Scope, patterns: str, varied: Sequence[tuple[str, tuple[str, ...]]], measure: str
) -> Scope:
    """Return the ``scope`` of a study with the ``varied`` names and values of a sweep or a drift.

    MitsimError for options that the study does not have, or that cannot be.
    """
    from mitsim.studies.framework.experiment import MEASURES, check_sweep, number_of

    if name == "sweep":
        check_sweep(tuple(varied), len(scope.pictures) * len(scope.seeds))
        if len(scope.seeds) > 1 and "seed" in dict(varied):
            raise MitsimError("--seeds: seeds are varied by --over seed already; leave one of them out")
        measures = tuple(measure.split(","))
        if unknown := [each for each in measures if each not in MEASURES]:
            raise MitsimError(f"--measure {unknown[0]!r}: use {', '.join(MEASURES)}")
        scope = replace(scope, measures=measures)
    elif name == "drift" and measure == "psnr":
        still = Drift(power_ripple_hz=1.0, lamp_ripple_hz=1.0)  # a recipe states them, which is not read yet
        for kind, texts in varied:
            for text in texts:
                still.alone(kind, number_of(kind, text))
    elif not (name in ("accuracy", "calibration") and measure == "psnr" and not varied):
        if varied or patterns != "dots:7" or measure != "psnr":
            others = "measure is for sweep; over for drift, sweep; patterns for accuracy, calibration, drift, sweep"
            raise MitsimError(f"study {name}: measures its own points; {others}")
        return scope
    sweep = ((name, tuple(map(read_name, texts)) if name == "patterns" else texts) for name, texts in varied)
    return replace(scope, sweep=tuple(sweep), patterns=read_name(patterns))


def _check_setup(scope: Scope, scene: str | None) -> None:
    """Refuse files of a ``scope`` that cannot be used, before the renderer is imported.

    A study without a ``scene`` of its own may use others.
    """
    from mitsim.bench.apparatus import check_devices, check_scene
    from mitsim.studies.framework.experiment import NO_SCENE, Scope

    camera, projector = check_devices(scope.setup.camera, scope.setup.projector)
    # A study in colour may see through colour filters; all fill a part of the full well.
    Exposure().check(load_sensor(camera).model_copy(update={"mosaic": None}), camera)
    if scene or scope.measures:
        knobs = dict(scope.sweep) if scope.measures else {}
        varied = {name: values[0] for name, values in knobs.items() if name not in NO_SCENE}
        shown = knobs.get("patterns", (scope.patterns,) if scope.measures or scope.patterns != Scope.patterns else ())
        check_scene(scope.setup.scene, {**dict(scope.setup.parameters), **varied}, scope.setup.outside, shown)
    from mitsim.devices.projector import ProjectorModel  # last: it imports numpy

    load_model(projector, ProjectorModel)


class DesignOptions(Options):
    """How a design is run."""

    VERB = "design"

    resume: bool = option(False, "continue a search that was stopped, for the same goal", panel=OUTPUT)
    overwrite: bool = option(False, "replace an earlier design in the folder", panel=OUTPUT)


@takes(DesignOptions)
def design(
    goal: Path | str | Goal, output: Path | str = "design-output", job: Job | None = None, **options: Any
) -> Design:
    """Search the mask with the least expected error, and prove it by rendered images beside simple masks.

    Parameters
    ----------
    goal
        Goal file, as `mitsim new goal` writes one, or a :class:`mitsim.design.goal.Goal`.
    output
        Folder of design.json, page, figures, and a camera file with the drawing of each mask.
    job
        Clock, progress and limits.

    Raises
    ------
    MitsimError
        for a goal that no code meets, which is named, files that cannot be used, and a folder that holds something
        else.

    Examples
    --------
    >>> import mitsim as ms
    >>> ms.design("goal.toml", "design").headline  # doctest: +SKIP
    """
    return prepare_design(goal, output, DesignOptions(**options))(job)


def prepare_design(goal: Path | str | Goal, output: Path | str, asked: DesignOptions) -> Callable[[Job | None], Design]:
    """Check a design before the renderer is imported, and return the function that runs it."""
    if asked.resume and asked.overwrite:
        raise ArgumentError("overwrite", "replaces the work that resume continues; give one of both")
    from mitsim.design.goal import Goal, load_goal

    checked = goal if isinstance(goal, Goal) else load_goal(goal)
    try:
        own = (each if each.startswith("cyclic:") else read_name(each) for each in checked.patterns)
        checked = checked.model_copy(update={"patterns": tuple(own)})
        checked.check_count()
        for patterns in checked.families:
            Opening(camera=checked.camera).check(checked.scene, patterns)
    except ArgumentError as error:  # of a field, not of an option
        raise MitsimError(f"goal: {error}") from None
    if checked.camera and load_sensor(locate(checked.camera, "calibration", ".toml", CAMERA)).mosaic:
        problem = f"goal: camera {checked.camera}: has colour filters, and masks are searched for one line of light"
        raise MitsimError(f"{problem}; give a camera without a mosaic, such as imx249")
    from mitsim.studies.mask_design import design as run_design  # only now: it takes seconds to import

    return partial(run_design, checked, output, resume=asked.resume, overwrite=asked.overwrite)


class CompareOptions(Styled):
    """How a comparison is written."""

    VERB = "compare"

    overwrite: bool = option(False, "replace an earlier comparison in the folder", panel=OUTPUT)


@takes(CompareOptions)
def compare(
    images: Sequence[Path | str], output: Path | str = "compare-output", job: Job | None = None, **options: Any
) -> Comparison:
    """Compare images side by side: on one scale, with difference maps to the first, PSNR and SSIM.

    Parameters
    ----------
    images
        Two or more folders of ``mitsim reconstruct`` or ``mitsim run``, or pictures (OpenEXR, PNG, TIFF, NPY), of one
        size. The others are compared with the first, and all with the truth if the folders' runs have it.
    output
        Folder of page, figures and compare.json.
    job
        Not used: comparing takes a second.

    Raises
    ------
    MitsimError
        for images of different sizes, in colour, or with values that are not finite, for files that cannot be read, and
        for a folder that holds something else, or an earlier comparison without ``overwrite``.

    Examples
    --------
    >>> import mitsim as ms
    >>> ms.compare(["run", "smooth", "mine.npy"], "beside", style="paper").payload()["images"]  # doctest: +SKIP
    """
    asked = CompareOptions(**options)
    each = [images] if isinstance(images, (str, Path)) else [*images]
    if wrong := [one for one in each if not isinstance(one, (str, Path)) or not is_path(str(one))]:
        raise ArgumentError("images", f"{short_text(wrong[0])}: give paths")
    from mitsim.studies.compare import compare as run_compare  # only now: it takes seconds to import

    return run_compare([Path(one) for one in each], output, asked.overwrite, asked.style)


# ---- sessions --------------------------------------------------------------------------------------------------------


class RunOptions(Options):
    """How a session is run."""

    VERB = "run"

    resume: bool = option(False, "continue interrupted work that was begun with the same options", panel=OUTPUT)
    pictures: bool = option(True, "make pictures and pages", kind=False)


# ---- a camera's sensor alone -----------------------------------------------------------------------------------------


@takes(Procedure, Working, without="resume frames")
def characterise(
    camera: Path | str | None = None,
    output: Path | str | None = None,
    frames: int | Path | str = 100,
    **options: Any,
) -> Characterisation:
    """Measure a camera after EMVA 1288: on simulated frames, beside what its file sets, or on real frames.

    Parameters
    ----------
    camera
        Name or TOML file; None for a real camera, measured by its frames.
    output
        Folder of page, plots, JSON and the camera's file, or of an earlier characterisation, which is replaced; None
        writes nothing.
    frames
        Frames of each stack; without a camera, the folder of a real one's frames under even light and in the dark.

    Raises
    ------
    MitsimError
        for a camera that light never saturates, a wavelength outside its curve, options that have no effect, frames
        that cannot be read or that do not determine the camera, or a folder that holds something else.

    Examples
    --------
    >>> import mitsim as ms
    >>> found = ms.characterise("imx249", pixels=64, steps=50, frames=16)  # doctest: +SKIP
    """
    from mitsim.studies.framework.campaign import check_study_folder

    job, asked = Task.taken(None, options).job, Procedure(**options)
    if camera is None:
        if not isinstance(frames, (str, Path)):
            raise MitsimError(
                "characterise: got no camera; name one to simulate, or give as frames the folder of a real one"
            )
        asked.refuse(asked.given.keys() - {"style"}, "on frames of a real camera")
        listed = load_flats(Path(frames))
        if output is not None:
            check_study_folder(output, "characterise")
        from mitsim.studies.characterise import characterise_frames

        return characterise_frames(listed, output, job, asked.style)
    sensor = load_sensor(locate(camera, "calibration", ".toml", CAMERA))
    if isinstance(frames, (str, Path)):
        raise ArgumentError("frames", f"{frames}: a folder is for a real camera; leave out either it or {camera}")
    if sensor.quantum_efficiency_curve is None:
        asked.refuse(["wavelength"], f"on {camera}, whose file has no curve of quantum efficiency")
    done = Procedure(frames=frames, **options)
    capacity_of(sensor)
    done.efficiency(sensor)
    if output is not None:
        check_study_folder(output, "characterise")
    from mitsim.studies.characterise import characterise as run_characterise

    return run_characterise(sensor, done, output, job)


@takes(Irradiance)
def sense(
    image: Path | str | FloatArray, camera: Path | str, exposure: float | Literal["auto"] = "auto", **options: Any
) -> Sensed:
    """Put an image of any renderer behind a camera's sensor: digital numbers with its noise.

    Parameters
    ----------
    image
        (rows, columns) irradiance [W/m^2], or a file of it, OpenEXR or NPY. Its pixels are the camera's (binned) ones.
    camera
        Name or TOML file of the electronics.
    exposure
        Seconds; ``auto``: so that the brightest pixel fills ``exposure_fraction`` of the full well.

    Raises
    ------
    MitsimError
        for an image that cannot be read or is none of light, values that cannot be, and a camera without a quantum
        efficiency or with colour filters.

    Examples
    --------
    >>> import numpy as np, mitsim as ms
    >>> frame = ms.sense(np.full((4, 6), 0.01), "imx249", seed=1)
    >>> frame.digital.shape, frame.digital.dtype
    ((4, 6), dtype('uint32'))
    """
    sensor = load_sensor(locate(camera, "calibration", ".toml", CAMERA))
    asked = Irradiance(exposure=exposure, **options)
    if isinstance(image, str | Path):
        check_image(Path(image))
    elif asked.channel is not None:
        raise ArgumentError("channel", f"{asked.channel!r}: an array has no channels; leave it out")
    from mitsim.acquire.sense import sense as run_sense

    return run_sense(image, sensor, asked)


# ---- networks, which need torch, an extra that is imported when it is used -------------------------------------------


@takes(PairOptions, Working, Request)
def make_pairs(bench: Bench, output: Path | str, count: int, patterns: str = "dots:7", **options: Any) -> PairStore:
    """Make pairs to learn from: pictures on a scene's print, and the frames that the camera takes of them.

    Parameters
    ----------
    output
        Folder of the pairs.
    count
        Number of pairs.
    patterns
        Name of the pattern family.

    Raises
    ------
    MitsimError
        For a request that cannot be served, a scene that is no flat diffuse sheet with a print, pictures that cannot be
        read, an output that cannot be written or holds something else, and more memory, disk or time than is allowed.
    """
    output, task = Path(output), Task.taken(output, options)
    own = {name: options.pop(name) for name in ("pictures", "vary") if name in options}
    asked = PairsRequest(capture=Request(patterns=patterns, **options), count=count, **own)
    check_output(output, overwrite=task.resume and (output / PAIRS).is_file())
    with task.importing():
        from mitsim.learn.pairs import make_pairs
    return make_pairs(bench, asked, task)[0]


pairs = make_pairs


@check_arguments
def load_network(path: Path | str, device: str = "cpu") -> LearnedSolver:
    """Load a trained network, which :func:`mitsim.reconstruct` takes as ``method``.

    Parameters
    ----------
    path
        File of `mitsim train`.
    device
        Device of torch for the network.

    Raises
    ------
    MitsimError
        If torch is not installed, or the file does not hold a network.
    """
    check_plain(path, "model")
    check_torch()
    from mitsim.learn.networks import read_network

    return read_network(path, device)


@takes(Working, Schedule)
def train(
    method: str,
    pairs: Path | str,
    output: Path | str,
    calibration: Path | str | None = None,
    overwrite: bool = False,
    **options: Any,
) -> Trained:
    """Train a network on pairs, and write its file.

    Parameters
    ----------
    method
        One of :data:`mitsim.learn.requests.METHODS`.
    pairs, output
        Folder of `mitsim pairs`, and the file, which ends in ``.pt``.
    calibration
        CAL folder of the pairs' camera; None takes the folder ``calibration`` in that of the pairs.
    overwrite
        True to replace an existing file.

    Raises
    ------
    MitsimError
        If torch is not installed, for options that no network is trained by, folders that cannot be read or do not
        fit each other, a file that is there, and more time or memory than is allowed.
    """
    task = Task.taken(output, options)
    request = Training(method=method, **options)
    place = Path(pairs) / "calibration" if calibration is None else Path(calibration)
    if calibration is None and not place.is_dir():
        raise MitsimError(f"calibration: {pairs} holds none; give the folder of `mitsim calibrate`")
    check_apart(output, [pairs, place])
    check_torch()
    with output_file(output, overwrite) as file:
        from mitsim.learn.pair_store import PairStore
        from mitsim.reconstruct.factors import load_calibration

        store, factors = PairStore.open(Path(pairs)), load_calibration(place)
        from mitsim.learn.networks import train_network  # only now, because torch takes seconds to import

        return train_network(store, factors, request, file, task.job, task.resume)
