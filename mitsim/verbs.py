"""Verbs of the Python face that belong to no object: scenes, cameras and folders by name in; results out.

Each is a verb of the command line, which calls it: what is asked is checked here before anything heavy is imported.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mitsim.api.bench import open_bench
from mitsim.bench.apparatus import check_devices, check_scene, spelling
from mitsim.bench.request import Exposure, Request, check_f_number, check_image, check_wavelength
from mitsim.core.configuration import CAMERA, load_model, locate, opening_words, shipped_files
from mitsim.core.environment import DEFAULT_VARIANT, Check
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, checked_fields, options_of
from mitsim.core.job import Job
from mitsim.core.seeds import check_root
from mitsim.devices.sensor import load_sensor
from mitsim.devices.session import load_recipe
from mitsim.studies import EXPOSED, OF_CAPTURES, OF_NO_SCENE

if TYPE_CHECKING:
    from mitsim.acquire.sense import Sensed
    from mitsim.api.bench import Bench
    from mitsim.core.arrays import FloatArray
    from mitsim.studies.characterise import Characterisation
    from mitsim.studies.demo import DemoResult
    from mitsim.studies.framework.campaign import CampaignResult
    from mitsim.studies.framework.experiment import Scope
    from mitsim.studies.framework.run import StudyResult


# ---- this machine, and what is shipped -------------------------------------------------------------------------------


@check_arguments
def doctor(warm: bool = False, variant: str = DEFAULT_VARIANT) -> list[Check]:
    """What works on this machine: checks, each with ``ok``, what was found, and the command that mends it.

    Some ten seconds; what can crash or hang runs in child processes.

    Parameters
    ----------
    warm
        whether the usual kernels are compiled into Dr.Jit's cache too, in half a minute.
    variant
        of Mitsuba, that they are compiled for.
    """
    from mitsim.core.environment import check_variant, warm_up
    from mitsim.core.environment import doctor as check_machine

    check_variant(variant)
    checks = check_machine()
    return [*checks, warm_up(variant)] if warm and all(check.ok for check in checks) else checks


def scenes() -> dict[str, str]:
    """What each shipped scene shows, a sentence, by the name that :func:`mitsim.open_bench` takes.

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


@checked_fields
@dataclass(frozen=True, kw_only=True)
class Opening:
    """What opens a bench beside its scene.

    Attributes
    ----------
    variant, camera, projector, allow_outside_files
        as for :func:`mitsim.open_bench`.
    parameters
        values of the scene's, by name.
    """

    variant: str = DEFAULT_VARIANT
    camera: Path | str | None = None
    projector: Path | str | None = None
    allow_outside_files: bool = False
    parameters: Mapping[str, Any] = field(default_factory=dict)

    @property
    def texts(self) -> dict[str, str]:
        """The parameters as a scene spells them."""
        return {name: spelling(value) for name, value in self.parameters.items()}

    def check(self, scene: Path | str, patterns: str, timing: Exposure | None) -> None:
        """Refuse, before the renderer is imported, what cannot be.

        Parameters
        ----------
        scene, patterns
            of the bench.
        timing
            how it is exposed; None: it is not.

        Raises
        ------
        MitsimError
            for files that cannot be used, patterns that do not fit, and an exposure that the camera cannot have.
        """
        if timing is not None:
            camera, _ = check_devices(self.camera, None)
            timing.check(load_sensor(camera), camera)
        check_scene(scene, self.texts, self.allow_outside_files, [patterns])

    def open(self, scene: Path | str, job: Job) -> Bench:
        """The bench of a ``scene``, opened in a stage of the ``job``."""
        with job.clock.stage("open scene"):
            return open_bench(
                scene, self.variant, self.camera, self.projector, self.allow_outside_files, **self.parameters
            )


# ---- the demo --------------------------------------------------------------------------------------------------------


@check_arguments
def demo(
    scene: Path | str = "photograph",
    output: Path | str = "demo-output",
    patterns: str = "dots:7",
    accuracy: float = 1e-3,
    seed: int = 0,
    job: Job | None = None,
    **devices: Any,
) -> DemoResult:
    """The main job: plan, capture, calibrate and reconstruct under five pattern families, and report.html.

    Parameters
    ----------
    scene
        name of a shipped one, or a path.
    output
        folder that is made, or of an earlier demo, which is replaced.
    patterns, accuracy, seed
        of the main family's capture.
    job
        clock, progress and limits.
    **devices
        ``variant``, ``camera``, ``projector`` and ``allow_outside_files`` as for :func:`mitsim.open_bench`, and
        ``parameters`` of the scene by name.

    Raises
    ------
    MitsimError
        for files that cannot be used, patterns that do not fit, a camera without a full well, a scene without light, an
        output that cannot be written or holds something else, or work beyond the job's limits.
    """
    from mitsim.studies.framework.run import check_study_folder

    opening, job = Opening(**options_of(Opening, devices, "demo")), job or Job()
    request = Request.of(patterns=patterns, accuracy=accuracy, seed=seed)
    check_study_folder(output, "demo")
    opening.check(scene, patterns, request.timing)
    bench = opening.open(scene, job)
    from mitsim.studies.demo import demo as run_demo  # only now: it takes seconds to import

    return run_demo(bench, output, request, job)


# ---- studies ---------------------------------------------------------------------------------------------------------

MERGE = "merge"
"""In the place of a study's name: joins the parts of one."""
WHOLE = "1/1"
"""The only part of a study that is not shared."""
_MAIN_PATTERNS, _MAIN_MEASURE = "dots:7", "psnr"
"""What is studied where nothing is said."""
_OF_SCENES = ("patterns", "camera", "projector", "parameters", "allow_outside_files")
"""Options of studies of a scene."""
_OF_POINTS = ("over", "measure", "shard", "jobs", "scheduler")
"""Options of studies of many points."""


@checked_fields
@dataclass(frozen=True, kw_only=True)
class StudyOptions(Opening):
    """How a study is made.

    Attributes
    ----------
    seed
        root of every random stream.
    recipe
        of calibration and drift: file of the session.
    data
        of twin and transfer: folder of real captures.
    experiment
        of merge: the module, where the study is one of the user's own.
    quick
        whether a few points are enough.
    shard
        "I/N": measure part I of N of the points.
    jobs
        processes; None: one a processor.
    scheduler
        of Dask, that measures the points.
    over
        what sweep and drift vary: values by name; or texts, "NAME=FIRST:LAST:COUNT" or "NAME=VALUE,VALUE".
    measure
        what sweep shows, names with commas between.
    """

    seed: int = 0
    recipe: Path | str | None = None
    data: Path | str | None = None
    experiment: str | None = None
    quick: bool = False
    shard: str = WHOLE
    jobs: int | None = None
    scheduler: str | None = None
    over: Mapping[str, Any] | Sequence[str] = ()
    measure: str = _MAIN_MEASURE

    @property
    def varied(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """Names and values of what is varied; MitsimError for what cannot be read."""
        from mitsim.studies.framework.experiment import values_of

        if isinstance(self.over, Mapping):
            each = {
                name: values if isinstance(values, (list, tuple)) else [values] for name, values in self.over.items()
            }
            return tuple((name, tuple(spelling(value) for value in values)) for name, values in each.items())
        if wrong := [text for text in self.over if not isinstance(text, str)]:
            raise ArgumentError("over", f"{wrong[0]!r}: give texts such as NAME=VALUE,VALUE, or values by name")
        return tuple(values_of(text) for text in self.over)


@check_arguments
def study(
    name: str,
    scene: Path | str | Sequence[Path | str] | None = None,
    output: Path | str = "study-output",
    patterns: str | None = None,
    job: Job | None = None,
    **options: Any,
) -> StudyResult | CampaignResult:
    """An experiment with figures, CSV and JSON in a folder.

    Parameters
    ----------
    name
        of the study, or ``merge``, which joins the parts of ``shard``.
    scene
        name of a shipped one, or a path; None: the photograph, or the study's own. Of ``merge`` folders of parts.
    output
        folder that is made, or of an earlier run of the study, which goes on or is replaced.
    patterns
        of the frames; None: 49 dots, or the study's own.
    job
        clock, progress and limits.
    **options
        of :class:`mitsim.verbs.StudyOptions`: ``seed``, ``quick``, ``over`` and ``measure`` of a sweep, ``recipe``,
        ``data``, ``shard``, ``jobs``, ``scheduler``; ``camera``, ``projector``, ``variant``, ``parameters``.

    Returns
    -------
    StudyResult or CampaignResult
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
    return prepare_study(name, scene, output, patterns, job, **options)()


Study = Callable[[], "StudyResult | CampaignResult"]
"""One that only has to be measured: what it is asked for was checked."""


def prepare_study(
    name: str,
    scene: Path | str | Sequence[Path | str] | None,
    output: Path | str,
    patterns: str | None,
    job: Job | None,
    **options: Any,
) -> Study:
    """What :func:`study` does once it is called; before that it refuses what that refuses before work.

    Parameters
    ----------
    name, scene, output, patterns, job, options
        as there.
    """
    from mitsim.studies.framework.experiment import is_experiment

    asked = StudyOptions(**options_of(StudyOptions, options, "study"))
    given = {*options, *(() if patterns is None else ("patterns",))}
    if name == MERGE:
        _refuse(given, [each for each in given if each not in ("experiment", "variant")],
                "on parts, which say themselves what they are of")  # fmt: skip
        from mitsim.studies.framework.campaign import merge

        return partial(merge, [Path(part) for part in _scenes_of(scene)], output, asked.experiment)
    _refuse(given, ["experiment"], "but with merge; give the module as the study's name")
    if name not in OF_CAPTURES:
        _refuse(given, ["data"], f"but on the studies {' and '.join(OF_CAPTURES)}")
    if asked.recipe is not None and name not in ("calibration", "drift"):
        raise MitsimError(f"study {name}: has no session of its own; a recipe is for calibration and drift")
    request = Request.of(patterns=patterns or _MAIN_PATTERNS, seed=asked.seed)
    named = _scenes_of(scene)
    if len(named) > 1:
        raise MitsimError(f"study {name}: got {len(named)} scenes, {' '.join(map(str, named))}; give one scene")
    place = str(named[0]) if named else None
    prepare = _study_of_points if is_experiment(name) else _study_of_a_bench
    return prepare(name, place, Path(output), request, job or Job(), asked, given)


def _scenes_of(scene: Path | str | Sequence[Path | str] | None) -> list[Path | str]:
    """The scenes, or folders of parts, that are named."""
    each: list[Any] = [] if scene is None else [*scene] if isinstance(scene, (list, tuple)) else [scene]
    if wrong := [one for one in each if not isinstance(one, (str, Path))]:
        raise ArgumentError("scene", f"{wrong[0]!r}: give a path")
    return each


def _refuse(given: set[str], names: Sequence[str], where: str) -> None:
    """ArgumentError for the first of some ``names`` that is ``given`` and has no effect ``where``."""
    for name in names:
        if name in given:
            raise ArgumentError(name, f"has no effect {where}; leave it out")


def _study_of_points(
    name: str, scene: str | None, output: Path, request: Request, job: Job, asked: StudyOptions, given: set[str]
) -> Study:
    """A study of many points: eight test images on the photograph's sheet (two, where it is quick), or one scene."""
    from mitsim.studies.framework.campaign import Where, run_experiment
    from mitsim.studies.framework.experiment import QUICK_IMAGES, TEST_IMAGES, Scope, Setup
    from mitsim.studies.framework.run import Shard

    camera = None if asked.camera is None else str(asked.camera)
    projector = None if asked.projector is None else str(asked.projector)
    parameters = tuple(sorted(asked.texts.items()))
    setup = Setup(scene or "photograph", None, parameters, camera, projector, asked.variant, asked.allow_outside_files)
    pictures: tuple[str | None, ...] = (None,) if scene else QUICK_IMAGES if asked.quick else TEST_IMAGES
    recipe = None if asked.recipe is None else str(asked.recipe)
    if recipe is not None:
        load_recipe(recipe)
    scope = Scope(setup, pictures, seeds=(asked.seed,), quick=asked.quick, recipe=recipe)
    scope = scope_of(name, scope, request.patterns, asked.varied, asked.measure)
    if name not in ("sweep", "drift"):
        _refuse(given, ["patterns"], f"on the study {name}, which has its own")
    if asked.scheduler is not None:
        _refuse(given, ["jobs"], "with a scheduler, whose machines have processes of their own")
    where = Where(Shard.of(asked.shard), asked.jobs, asked.scheduler)
    _check_setup(scope, scene)
    return partial(run_experiment, name, scope, output, job, where)


def scope_of(
    name: str, scope: Scope, patterns: str, varied: Sequence[tuple[str, tuple[str, ...]]], measure: str
) -> Scope:
    """The ``scope`` of a study with what a sweep varies and shows; other studies take nothing of it.

    Parameters
    ----------
    name, scope
        of the study.
    patterns, varied, measure
        as :class:`StudyOptions` has them.

    Raises
    ------
    MitsimError
        for options that the study does not have, or that cannot be.
    """
    from mitsim.devices.patterns import read_name
    from mitsim.studies.framework.experiment import check_drifts, check_sweep, measures_of

    if name == "sweep":
        check_sweep(tuple(varied), len(scope.pictures))
        read_name(patterns)
        return replace(scope, sweep=tuple(varied), measures=measures_of(measure), patterns=patterns)
    if name == "drift" and measure == _MAIN_MEASURE:
        check_drifts(tuple(varied))
        read_name(patterns)
        return replace(scope, sweep=tuple(varied), patterns=patterns)
    if varied or patterns != _MAIN_PATTERNS or measure != _MAIN_MEASURE:
        others = "measure is for sweep, over and patterns for drift and sweep"
        raise MitsimError(f"study {name}: has its own points and measures; {others}")
    return scope


def _check_setup(scope: Scope, scene: str | None) -> None:
    """MitsimError where the files that a ``scope`` names cannot be used, before the renderer is imported; a study
    without a ``scene`` of its own may take others."""
    from mitsim.studies.framework.experiment import NO_SCENE

    camera, projector = check_devices(scope.setup.camera, scope.setup.projector)
    # A study in colour may see through colour filters; all fill a part of the full well.
    Exposure().check(load_sensor(camera).model_copy(update={"mosaic": None}), camera)
    if scene or scope.measures:
        knobs = dict(scope.sweep) if scope.measures else {}
        varied = {name: values[0] for name, values in knobs.items() if name not in NO_SCENE}
        shown = knobs.get("patterns", (scope.patterns,) if scope.measures else ())
        check_scene(scope.setup.scene, {**dict(scope.setup.parameters), **varied}, scope.setup.outside, shown)
    from mitsim.devices.projector import ProjectorModel  # last: it imports numpy

    load_model(projector, ProjectorModel)


def _study_of_a_bench(
    name: str, scene: str | None, output: Path, request: Request, job: Job, asked: StudyOptions, given: set[str]
) -> Study:
    """A study of one bench, or of none."""
    from mitsim.studies.framework.run import check_study_folder, find_study

    if name in OF_NO_SCENE:
        if scene is not None:
            raise MitsimError(f"study {name} {scene}: it is of no scene; leave the scene out")
        _refuse(given, _OF_SCENES, f"on the study {name}, which is of no scene")
    settings: dict[str, Any] = {} if asked.recipe is None else {"recipe": load_recipe(asked.recipe)}
    if name in OF_CAPTURES:
        from mitsim.studies.twin_files import TwinFiles

        settings = {"files": TwinFiles.find(None if asked.data is None else Path(asked.data), name)}
        settings |= {"variant": asked.variant} if name == "twin" else {}
    run_study = find_study(name, **settings)
    if asked.over or asked.measure != _MAIN_MEASURE or asked.shard != WHOLE or asked.jobs or asked.scheduler:
        raise MitsimError(f"study {name}: is measured whole, here; leave out over, measure, shard, jobs and scheduler")
    _refuse(given, ["quick"], f"on the study {name}, which has no points to leave out")
    if name in OF_NO_SCENE:
        check_study_folder(output, name)
        return partial(run_study, None, output, request, job)
    check_study_folder(output, name)
    place = scene or "photograph"
    asked.check(place, request.patterns, request.timing if name in EXPOSED else None)
    return lambda: run_study(asked.open(place, job), output, request, job)


# ---- a camera's sensor alone -----------------------------------------------------------------------------------------


@check_arguments
def characterise(
    camera: Path | str | None = None,
    output: Path | str | None = None,
    frames: int | Path | str = 100,
    job: Job | None = None,
    **procedure: Any,
) -> Characterisation:
    """Measure a camera after EMVA 1288: on simulated frames, beside what its file sets, or on real frames.

    Parameters
    ----------
    camera
        name or TOML file; None: a real one, by its frames.
    output
        folder of page, plots, JSON and the camera's file, or of an earlier characterisation, which is replaced; None
        writes nothing.
    frames
        of each stack; without a camera, folder of a real one's frames under even light and in the dark.
    job
        clock, progress and limits.
    **procedure
        of simulated frames: ``pixels`` a side (256), ``steps`` of light (50), ``seed`` (0), ``wavelength`` (550 nm)
        for a curve of quantum efficiency.

    Raises
    ------
    MitsimError
        for a camera that light never saturates, a wavelength outside its curve, options that have no effect, frames
        that cannot be read or tell nothing of the camera, or a folder that holds something else.

    Examples
    --------
    >>> import mitsim as ms
    >>> found = ms.characterise("imx249", pixels=64, steps=50, frames=16)  # doctest: +SKIP
    """
    from mitsim.devices.flatlist import Procedure, capacity_of, load_flats
    from mitsim.studies.framework.run import check_study_folder

    asked = dict(options_of(_Simulated, procedure, "characterise"))
    _Simulated(**asked)
    if camera is None:
        if not isinstance(frames, (str, Path)):
            raise MitsimError(
                "characterise: got no camera; give one to simulate, or as frames the folder of a real one"
            )
        _refuse({*asked}, [*asked], "on frames of a real camera")
        listed = load_flats(Path(frames))
        if output is not None:
            check_study_folder(output, "characterise")
        from mitsim.studies.characterise import characterise_frames

        return characterise_frames(listed, output, job)
    sensor = load_sensor(locate(camera, "calibration", ".toml", CAMERA))
    if isinstance(frames, (str, Path)):
        raise ArgumentError("frames", f"{frames}: give the frames of each stack, or no camera, to measure a real one")
    if sensor.quantum_efficiency_curve is None:
        _refuse({*asked}, ["wavelength"], f"on {camera}, whose file has no curve of quantum efficiency")
    if "wavelength" in asked:
        asked["wavelength_nm"] = asked.pop("wavelength")
    done = Procedure(frames=frames, **asked)
    check_wavelength(done.wavelength_nm)
    capacity_of(sensor)
    done.efficiency(sensor)
    if output is not None:
        check_study_folder(output, "characterise")
    from mitsim.studies.characterise import characterise as run_characterise

    return run_characterise(sensor, done, output, job)


@checked_fields
@dataclass(frozen=True, kw_only=True)
class _Simulated:
    """How frames of a camera are simulated."""

    pixels: int = 256
    steps: int = 50
    seed: int = 0
    wavelength: float = 550.0


@check_arguments
def sense(
    image: Path | str | FloatArray,
    camera: Path | str,
    exposure: float | Literal["auto"] = "auto",
    exposure_fraction: float = 0.8,
    seed: int = 0,
    wavelength: float = 550.0,
    **irradiance: Any,
) -> Sensed:
    """Put an image of any renderer behind a camera's sensor: digital numbers with its noise.

    Parameters
    ----------
    image
        (rows, columns) irradiance [W/m^2], or a file of it, OpenEXR or NPY. Its pixels are the camera's (binned) ones.
    camera
        name or TOML file of the electronics.
    exposure
        seconds; ``auto``: so that the brightest pixel fills ``exposure_fraction`` of the full well.
    exposure_fraction
        of the full well.
    seed
        of the noise.
    wavelength
        of the light [nm].
    **irradiance
        ``f_number``: the image is radiance [W/m^2/sr] before a lens of it; ``scale``: what its numbers are multiplied
        by; ``channel``: of several in a file, the one to take.

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
    facts = _Irradiance(**options_of(_Irradiance, irradiance, "sense"))
    asked = Exposure(None if exposure == "auto" else exposure, exposure_fraction)
    if not 0 < facts.scale < math.inf:
        raise ArgumentError("scale", f"{facts.scale:g}: give a finite number above 0")
    check_wavelength(wavelength)
    if facts.f_number is not None:
        check_f_number(facts.f_number)
    check_root(seed)
    if isinstance(image, str | Path):
        check_image(Path(image))
    elif facts.channel is not None:
        raise ArgumentError("channel", f"{facts.channel!r}: an array has no channels; leave it out")
    from mitsim.acquire.sense import irradiance_behind_lens, read_image
    from mitsim.acquire.sense import sense as run_sense

    light, notes = read_image(image, facts.channel) if isinstance(image, str | Path) else (image, tuple[str, ...]())
    light = light * facts.scale
    if facts.f_number is not None:
        light = irradiance_behind_lens(light, facts.f_number)
    return run_sense(light, sensor, asked, seed, wavelength, notes)


@checked_fields
@dataclass(frozen=True, kw_only=True)
class _Irradiance:
    """How an image's numbers are light on the sensor."""

    f_number: float | None = None
    scale: float = 1.0
    channel: str | None = None
