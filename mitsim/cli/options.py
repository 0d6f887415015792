"""Options that several commands share: words of a command line in, a bench, a request or a job out, or a refusal."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import mitsim
from mitsim.cli.screen import showing_progress
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.devices.patterns import pattern_names, read_name

if TYPE_CHECKING:
    from mitsim.api.bench import Bench
    from mitsim.bench.request import Exposure
    from mitsim.core.job import Job
    from mitsim.devices.session import SessionRecipe
    from mitsim.studies.framework.experiment import Scope

_OPTIONS = {"lam": "lambda"}
"""Options that are not called like the argument."""
SPELLED = {"scene": "SCENE", "define": "-D", "outside": "--allow-outside-files", "planning": "--plan"}
"""Options that are not called like their parameter."""
_BENCH_ARGUMENTS = ("scene", "variant", "camera", "projector", "allow_outside_files", "for_render")

Scene = Annotated[str, typer.Argument(help="scene XML, or the name of a shipped scene", metavar="SCENE")]
SceneOrFrames = Annotated[
    str | None, typer.Argument(help="scene XML, or the name of a shipped scene; none with --frames", metavar="[SCENE]")
]
Json = Annotated[bool, typer.Option("--json", help="one JSON object on stdout, nothing else there")]
Quiet = Annotated[bool, typer.Option("--quiet", help="no progress")]
Variant = Annotated[
    str,
    typer.Option(
        help="Mitsuba variant: llvm_ad_mono, llvm_ad_rgb or llvm_ad_spectral; with a GPU, cuda_ for llvm_",
        callback=lambda name: variant_of(name),
    ),
]
Patterns = Annotated[str, typer.Option(help=pattern_names())]
Accuracy = Annotated[float, typer.Option(help="relative rms error of the expected frames")]
AccuracyOrSeconds = Annotated[
    float | None, typer.Option("--accuracy", help="relative rms error of the expected frames", show_default="0.001")
]
Seconds = Annotated[
    float | None, typer.Option("--seconds", help="the finest accuracy that a run of so long buys", metavar="S")
]
Seed = Annotated[int, typer.Option(help="root of every random stream")]
Effects = Annotated[str, typer.Option("--effects", help="override the plan: +NAME,-NAME", metavar="+NAME,-NAME")]
Camera = Annotated[str | None, typer.Option(help="camera electronics: name or TOML file", metavar="NAME|FILE")]
Projector = Annotated[str | None, typer.Option(help="projector: name or TOML file", metavar="NAME|FILE")]
Defines = Annotated[list[str] | None, typer.Option("-D", help="set a <default> of the scene", metavar="NAME=VALUE")]
Outside = Annotated[bool, typer.Option("--allow-outside-files", help="let the scene read files outside its own folder")]
Resume = Annotated[bool, typer.Option("--resume", help="go on where an interrupted one of the same options stopped")]
MaxSeconds = Annotated[float, typer.Option("--max-seconds", help="refuse work that would take longer")]
MaxMemory = Annotated[
    float | None,
    typer.Option(
        "--max-memory", help="refuse work that would take more; nine tenths of what is free if not given", metavar="GIB"
    ),
]
MAIN_PATTERNS, MAIN_MEASURE = "dots:7", "psnr"
"""What `mitsim study` takes where nothing is said."""
DAY = 86400.0
"""Work that would take longer is a mistake, unless it is asked for."""


def variant_of(name: str) -> str:
    """The ``name``, refused when it is none that light can be traced in; every verb checks it alike."""
    from mitsim.core.environment import VARIANTS, check_driver

    # CUDA has the same kinds; whether a driver has a GPU too shows when the variant is loaded.
    if name.replace("cuda_", "llvm_", 1) not in VARIANTS:
        raise MitsimError(f"--variant {name!r}: use {', '.join(VARIANTS)}")
    check_driver(name)
    return name


def request_of(**values: object) -> dict[str, Any]:
    """Checked ``values`` of a request's fields, without an accuracy that was not given; refused before work."""
    from mitsim.bench.request import Request

    values = {name: value for name, value in values.items() if name != "accuracy" or value is not None}
    request = Request.of(**values).model_dump()
    return {name: request[name] for name in values}


def scope_of(
    scene: str | None,
    variant: str,
    camera: str | None,
    projector: str | None,
    define: Sequence[str] | None,
    outside: bool,
    quick: bool,
) -> Scope:
    """How much of a study a command line asks for: eight test images on the photograph's sheet, or one ``scene``.

    Parameters
    ----------
    scene, variant, camera, projector, define, outside
        as for :func:`bench_of`; no scene: the test images.
    quick
        a few points and two images.

    Raises
    ------
    MitsimError
        for a define that is none.
    """
    from mitsim.studies.framework.experiment import Scope
    from mitsim.studies.framework.setup import QUICK_IMAGES, TEST_IMAGES, Setup

    parameters = tuple(sorted(defines_of(define).items()))
    setup = Setup(scene or "photograph", None, parameters, camera, projector, variant, outside)
    pictures: tuple[str | None, ...] = (None,) if scene else QUICK_IMAGES if quick else TEST_IMAGES
    return Scope(setup, pictures, quick=quick)


def swept(name: str, scope: Scope, patterns: str, over: Sequence[str], measure: str) -> Scope:
    """The ``scope`` of a study with what a sweep varies and shows; other studies take nothing of it.

    Parameters
    ----------
    name, scope
        of the study.
    patterns, over, measure
        as the options say.

    Raises
    ------
    MitsimError
        for options that the study does not have, or that cannot be read.
    """
    from mitsim.studies.framework.experiment import check_drifts, check_sweep, measures_of, values_of

    varied = tuple(values_of(text) for text in over)
    if name == "sweep":
        check_sweep(varied, len(scope.pictures))
        read_name(patterns)
        return replace(scope, sweep=varied, measures=measures_of(measure), patterns=patterns)
    if name == "drift" and measure == MAIN_MEASURE:
        check_drifts(varied)
        read_name(patterns)
        return replace(scope, sweep=varied, patterns=patterns)
    if over or patterns != MAIN_PATTERNS or measure != MAIN_MEASURE:
        others = "--measure is for sweep, --over and --patterns for drift and sweep"
        raise MitsimError(f"study {name}: has its own points and measures; {others}")
    return scope


def check_setup(scope: Scope, scene: str | None) -> None:
    """MitsimError where the files that a ``scope`` names cannot be used, before the renderer is imported; a study
    without a ``scene`` of its own may take others."""
    from mitsim.bench.open import check_devices, check_scene
    from mitsim.bench.request import Exposure
    from mitsim.core.configuration import load_model
    from mitsim.devices.sensor import load_sensor
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


def recipe_for(name: str, recipe: Path | None) -> SessionRecipe | None:
    """The session in the file ``recipe`` that the study ``name`` is of, where one is given.

    MitsimError for a study that takes none, and for a file that is no recipe.
    """
    from mitsim.devices.session import load_recipe

    if recipe is None:
        return None
    if name not in ("calibration", "drift"):
        raise MitsimError(f"study {name}: has no session of its own; --recipe is for calibration and drift")
    return load_recipe(recipe)


def check_work(output: Path, resume: bool, kind: str, several: bool = False) -> None:
    """MitsimError, before the renderer is imported, where a RUN or CAL folder cannot be written.

    Parameters
    ----------
    output, resume
        the folder, and whether work in it is to go on.
    kind
        capture or calibration.
    several
        whether it is to hold several such folders.
    """
    from mitsim.core.files import check_output
    from mitsim.core.manifests import MANIFEST, resumable

    begun = (output / MANIFEST).is_file()
    if resume and begun and not several:
        resumable(output, kind)
    check_output(output, overwrite=resume and begun != several)


def check_shown(patterns: Sequence[str], scene: str, define: Sequence[str] | None, outside: bool) -> None:
    """MitsimError, before the renderer is imported, for ``patterns`` that the scene's projector has too few pixels for.

    Parameters
    ----------
    patterns
        names of families.
    scene, define, outside
        as for :func:`bench_of`.
    """
    from mitsim.bench.open import check_scene

    check_scene(scene, defines_of(define), outside, patterns)


def check_camera(camera: str | None, exposure: Exposure) -> None:
    """MitsimError, before the renderer is imported, for a ``camera`` that cannot have an ``exposure``."""
    from mitsim.bench.open import check_devices
    from mitsim.devices.sensor import load_sensor

    path, _ = check_devices(camera, None)
    exposure.check(load_sensor(path), path)


def bench_of(
    scene: str,
    variant: str,
    camera: str | None,
    projector: str | None,
    define: Sequence[str] | None,
    outside: bool,
    for_render: bool = False,
) -> Bench:
    """The bench that a command line describes; see :func:`mitsim.open_bench`.

    Parameters
    ----------
    scene, variant, camera, projector, outside, for_render
        as there.
    define
        NAME=VALUE of the scene's parameters.

    Raises
    ------
    MitsimError
        as there, and for a parameter that is not written so.
    """
    parameters: dict[str, Any] = defines_of(define)
    return mitsim.open_bench(scene, variant, camera, projector, outside, for_render, **parameters)


def defines_of(define: Sequence[str] | None) -> dict[str, str]:
    """The scene's parameters in ``define``, NAME=VALUE each; MitsimError for what is not written so."""
    parameters = {}
    for text in define or ():
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise MitsimError(f"-D {text!r}: give NAME=VALUE")
        if name in _BENCH_ARGUMENTS:
            raise MitsimError(f"-D {text!r}: mitsim itself uses the name {name}; give the scene's <default> another")
        parameters[name] = value
    return parameters


def number_of(argument: str, text: str, words: Sequence[str] = ("auto",)) -> Any:
    """The number in a text, or one of a few words.

    Parameters
    ----------
    argument
        what a refusal names.
    text, words
        what was given, and the words that are allowed instead of a number.
    """
    if text in words:
        return text
    try:
        return float(text)
    except ValueError:
        told = f"{text!r}: give a number or {' or '.join(words)}"
        raise ArgumentError("lam" if argument == "lambda" else argument, told) from None


def is_given(context: typer.Context, name: str) -> bool:
    """Whether the command line of a ``context`` names the parameter ``name``."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def refuse_unused(context: typer.Context, names: Sequence[str], where: str) -> None:
    """Refuse options that have no effect: one that is passed over would be taken for obeyed.

    Parameters
    ----------
    context
        of the command line.
    names
        parameters that have no effect.
    where
        they have none, for the message.

    Raises
    ------
    MitsimError
        when one of them is given.
    """
    for name in names:
        if is_given(context, name):
            option = SPELLED.get(name, f"--{name.replace('_', '-')}")
            raise MitsimError(f"{option}: has no effect {where}; leave it out")


@contextmanager
def job_of(silent_progress: bool, seconds: float = DAY, gibibytes: float | None = None) -> Iterator[Job]:
    """A job with limits, and progress on stderr while the context lasts.

    Parameters
    ----------
    silent_progress
        no progress.
    seconds, gibibytes
        longest time [s]; most memory [GiB], nine tenths of what is free if None.
    """
    from mitsim.core.job import Clock, Job
    from mitsim.core.resources import Limits, running_seconds

    limits = Limits(seconds, None if gibibytes is None else gibibytes * 2**30)
    with showing_progress(silent_progress) as progress:
        yield Job(Clock(running_seconds()), progress, limits)


def spoken(error: MitsimError) -> str:
    """The message of an ``error`` with its arguments written as options."""
    text = str(error)
    if isinstance(error, ArgumentError):
        option = _OPTIONS.get(error.argument, error.argument).replace("_", "-")
        text = f"--{option}{text.removeprefix(error.argument)}"
    text = re.sub(r"^parameter (?=\w+=)", "-D ", text)
    return re.sub(
        r"(?<!-)\b(\w+(?==True)|max_seconds|max_memory)(=True)?", lambda m: "--" + m[1].replace("_", "-"), text
    )
