"""The command line: parse, call the Python face, print. No physics; heavy imports happen in the verb that needs them.

Options that make up a request come from :class:`mitsim.capture.request.Request`, so that they are the same in Python.
Errors of the library speak of arguments; :func:`_spoken` writes them as the options that they are here.
"""

from __future__ import annotations

import errno
import json
import math
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

import mitsim
from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.worker import INTERRUPTED, RESUME, advise, end_stopped

if TYPE_CHECKING:
    from mitsim.capture.bench import Bench
    from mitsim.capture.plan import Plan
    from mitsim.core.arrays import Progress
    from mitsim.core.job import Job

app = typer.Typer(
    name="mitsim",
    help="A physically based simulator of coded-illumination lensless imaging.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_OPTIONS = {"lam": "lambda"}
"""Options that are not called like the argument."""
_BENCH_ARGUMENTS = ("scene", "variant", "camera", "projector", "allow_outside_files", "for_render")

Scene = Annotated[str, typer.Argument(help="scene XML, or the name of a shipped scene", metavar="SCENE")]
Json = Annotated[bool, typer.Option("--json", help="one JSON object on stdout, nothing else there")]
Quiet = Annotated[bool, typer.Option("--quiet", help="no progress bar")]
Variant = Annotated[
    str,
    typer.Option(
        help="Mitsuba variant: llvm_ad_mono, llvm_ad_rgb or llvm_ad_spectral", callback=lambda name: _variant(name)
    ),
]
Patterns = Annotated[str, typer.Option(help="uniform, dots:K, hadamard:K or random:K")]
Accuracy = Annotated[float, typer.Option(help="relative rms error of the expected frames")]
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
DAY = 86400.0
"""Work that would take longer is a mistake, unless it is asked for."""


def run() -> None:
    """Serve the command line in this process: exit 0 done, 1 done but flagged, 2 refused, 128 + n ended by signal n."""
    try:
        code = app(standalone_mode=False)
    except MitsimError as error:
        _fail(_spoken(error))
    except (typer.Abort, KeyboardInterrupt):
        code = INTERRUPTED
    except MemoryError:
        _fail("out of memory; close other programs, or ask for fewer pixels, frames or less accuracy")
    except OSError as error:
        # What no check foresees: a full disk, a name too long, a file taken away. Other errors are faults of ours.
        if error.filename is None and error.errno not in _NO_ROOM:
            raise
        _fail(f"{error.filename or 'output'}: {error.strerror}; choose another place")
    except Exception as error:
        # Usage errors of click (wherever typer keeps it) carry their own one-line message.
        if hasattr(error, "format_message") and hasattr(error, "exit_code"):
            _fail(_usage(error))
        raise
    if code == INTERRUPTED:  # some versions of typer turn Control-C into this status without a word
        end_stopped()
    sys.exit(code if isinstance(code, int) else 0)


def _spoken(error: MitsimError) -> str:
    """The message of an error with its arguments written as options."""
    text = str(error)
    if isinstance(error, ArgumentError):
        option = _OPTIONS.get(error.argument, error.argument).replace("_", "-")
        text = f"--{option}{text.removeprefix(error.argument)}"
    text = re.sub(r"^parameter (?=\w+=)", "-D ", text)
    return re.sub(
        r"(?<!-)\b(\w+(?==True)|max_seconds|max_memory)(=True)?", lambda m: "--" + m[1].replace("_", "-"), text
    )


def _usage(error: Any) -> str:
    """Click's sentence about a command line, with the value that a typer which checks with pydantic leaves out."""
    message: str = error.format_message()
    if message.startswith("Usage:"):  # no command was given, and click's sentence is the whole help
        print(message, file=sys.stderr)
        return "give one of the commands above"
    checked = getattr(error.__cause__, "errors", None)
    if checked is not None:
        message += f"; got {checked()[0].get('input')!r}"
    return message


def _fail(message: str) -> None:
    print(f"mitsim: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(2)


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="print the version and exit")] = False,
) -> None:
    if version:
        print(mitsim.__version__)
        raise typer.Exit


@app.command()
def demo(
    scene: Annotated[str, typer.Argument(help="scene XML, or the name of a shipped scene")] = "photograph",
    output: Annotated[Path, typer.Option("-o", "--output", help="folder of the demo")] = Path("demo-output"),
    patterns: Patterns = "dots:7",
    accuracy: Accuracy = 1e-3,
    seed: Seed = 0,
    camera: Camera = None,
    projector: Projector = None,
    define: Defines = None,
    outside: Outside = False,
    variant: Variant = DEFAULT_VARIANT,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """The main job: plan, capture, calibrate and reconstruct under five pattern families, and report.html."""
    from mitsim.study.demo import demo as run_demo

    request = mitsim.Request.of(patterns=patterns, accuracy=accuracy, seed=seed)
    with _job(quiet or as_json) as job:
        with job.clock.stage("open scene"):
            bench = _open(scene, variant, camera, projector, define, outside)
        result = run_demo(bench, output, request, job)
    return _finish(as_json, result.payload(), result.lines(), result.warnings)


@app.command()
def plan(
    scene: Scene,
    patterns: Patterns = "dots:7",
    accuracy: Accuracy = 1e-3,
    seed: Seed = 0,
    camera: Camera = None,
    projector: Projector = None,
    define: Defines = None,
    outside: Outside = False,
    effects: Effects = "",
    variant: Variant = DEFAULT_VARIANT,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """What will be simulated, why, and what it costs, before any long work."""
    from mitsim.core.resources import running_seconds

    request = _request(patterns=patterns, accuracy=accuracy, seed=seed, effects=effects)
    bench = _open(scene, variant, camera, projector, define, outside)
    starting = running_seconds()
    plan = bench.plan(**request).taking(start=starting)
    if not as_json:
        _print_plan(plan)
    return _finish(as_json, plan.payload(), [], plan.warnings)


@app.command()
def capture(
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="run folder to make", metavar="RUN")],
    patterns: Patterns,
    accuracy: Accuracy = 1e-3,
    camera: Camera = None,
    projector: Projector = None,
    exposure: Annotated[str, typer.Option(help="seconds a frame, or auto", metavar="auto|SECONDS")] = "auto",
    exposure_fraction: Annotated[float, typer.Option(help="brightest pixel, as a part of full well")] = 0.8,
    effects: Effects = "",
    noise_fraction: Annotated[
        float | None, typer.Option(help="stop sampling at this part of the sensor's noise", metavar="PART")
    ] = None,
    ambient_frame: Annotated[
        str, typer.Option(help="take a frame with the projector off and lamps on", metavar="auto|yes|no")
    ] = "auto",
    ambient_shots: Annotated[
        int | None, typer.Option(help="shots of that frame; by the patterns if not given", metavar="N")
    ] = None,
    seed: Seed = 0,
    define: Defines = None,
    outside: Outside = False,
    resume: Resume = False,
    variant: Variant = DEFAULT_VARIANT,
    max_seconds: MaxSeconds = DAY,
    max_memory: MaxMemory = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Render, expose and write one frame for each pattern."""
    request = _request(
        patterns=patterns,
        accuracy=accuracy,
        seed=seed,
        exposure=_number("exposure", exposure),
        exposure_fraction=exposure_fraction,
        effects=effects,
        noise_fraction=noise_fraction,
        ambient_frame=ambient_frame,
        ambient_shots=ambient_shots,
    )
    advise(RESUME)
    with _job(quiet or as_json, max_seconds, max_memory) as job:
        bench = _open(scene, variant, camera, projector, define, outside)
        shots = bench.capture(request.pop("patterns"), output, resume, job, **request)
    payload = shots.summary()
    seconds = payload["seconds"]
    lines = [
        f"{payload['frames']} frames of {payload['shape'][0]}x{payload['shape'][1]} in {seconds['total']:.1f} s "
        f"(transport {seconds['transport']:.2f}, optics {seconds['optics']:.2f}, sensor {seconds['sensor']:.2f}, "
        f"write {seconds['write']:.2f}): {payload['output']}",
        f"Monte Carlo error {payload['mc_error']:.1e}, {payload['mc_to_sensor_noise']:.0%} of the sensor's noise; "
        f"exposure {payload['exposure_s']:.3g} s a frame",
    ]
    if payload["ambient_frame"]:
        ambient = payload["ambient_frame"]
        lines.append(
            f"Ambient frame: the mean of {ambient['shots']} shots with the projector off, to be taken off; "
            f"{ambient['part']:.1%} of the frames' light is ambient, noise {ambient['noise']:.2g} of the projector's, "
            f"total error up to {payload['total_error_of_projector']:.1e} of it"
        )
    return _finish(as_json, payload, lines, shots.warnings)


@app.command()
def calibrate(
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="calibration folder to make", metavar="CAL")],
    accuracy: Accuracy = 1e-3,
    camera: Camera = None,
    projector: Projector = None,
    recipe: Annotated[Path | None, typer.Option(help="session recipe, TOML", metavar="FILE.toml")] = None,
    seed: Seed = 0,
    define: Defines = None,
    outside: Outside = False,
    resume: Resume = False,
    variant: Variant = DEFAULT_VARIANT,
    max_seconds: MaxSeconds = DAY,
    max_memory: MaxMemory = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Render a Hadamard session on a white board and estimate the camera's factors."""
    from mitsim.rig.recipe import load_recipe

    session = load_recipe(recipe)
    advise(RESUME)
    with _job(quiet or as_json, max_seconds, max_memory) as job:
        bench = _open(scene, variant, camera, projector, define, outside)
        factors = bench.calibrate(seed, accuracy, session, output, resume, job)
    payload = {**factors.manifest.result, "output": str(output)}
    # JSON has no numbers beyond the finite ones.
    residual, clean, error, condition = (
        math.inf if payload[name] is None else payload[name]
        for name in ("separability_residual", "noise_free_residual", "phi_error", "condition")
    )
    lines = [
        f"{payload['frames']} frames of {payload['n']} stripes in {payload['seconds']['total']:.1f} s: {output}",
        f"separability residual {residual:.2%} ({clean:.1e} without noise), factor error {error:.1e}, condition "
        f"{condition:.2e}",
    ]
    return _finish(as_json, payload, lines, factors.warnings)


@app.command()
def reconstruct(
    run: Annotated[Path, typer.Argument(help="folder of `mitsim capture`", metavar="RUN")],
    calibration: Annotated[Path, typer.Option(help="folder of `mitsim calibrate`", metavar="CAL")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="folder for the image; RUN/reconstruction if not given")
    ] = None,
    lam: Annotated[str, typer.Option("--lambda", help="regularisation, or auto", metavar="auto|VALUE")] = "auto",
    method: Annotated[str, typer.Option(help="tikhonov or tv")] = "tikhonov",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace an earlier image in the folder")] = False,
    variant: Variant = DEFAULT_VARIANT,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Recover the image from frames and a calibration alone."""
    from mitsim.study.quality import reconstruct as reconstruct_folder

    result = reconstruct_folder(
        run, calibration, output or run / "reconstruction", _number("lambda", lam), method, overwrite
    )
    payload = result.summary()
    lines = [payload["status"]]
    if result.quality is not None:
        lines.append(str(result.quality))
    lines.append(
        f"lambda {payload['lambda']:.3g}, rank {payload['rank']}, condition {payload['condition_whole']:.3g}, "
        f"residual {payload['residual']:.1e}: {payload['output']}"
    )
    misfit, uncertainty = payload["misfit"], payload["uncertainty"]
    if misfit:
        noise = "" if misfit["noise_stated"] else " of shot noise alone, as no other was stated"
        lines.append(
            f"misfit: chi-square {misfit['chi_square']:.3g} a datum{noise}, {misfit['unexplained']:.1e} unexplained"
        )
    if uncertainty is not None:
        budget = sorted(payload["uncertainty_budget"].items(), key=lambda source: -source[1])
        largest = ", ".join(f"{name.replace('_', ' ')} {value:.1e}" for name, value in budget[:3])
        lines.append(f"standard uncertainty {uncertainty:.1e} rms; largest: {largest}")
    return _finish(as_json, payload, lines, () if result.reconstruction.ok else (payload["status"],))


@app.command()
def render(
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="frame to write", metavar="FRAME.exr")],
    estimator: Annotated[str, typer.Option(help="reference or factored")] = "reference",
    spp: Annotated[int, typer.Option(help="samples a pixel of the reference")] = 64,
    accuracy: Accuracy = 1e-3,
    seed: Seed = 0,
    projector: Projector = None,
    define: Defines = None,
    outside: Outside = False,
    effects: Effects = "",
    variant: Variant = DEFAULT_VARIANT,
    max_seconds: MaxSeconds = DAY,
    max_memory: MaxMemory = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Expected irradiance under the scene's own light, by either estimator."""
    from mitsim.core.output import prepare_output

    if output.suffix.lower() != ".exr":
        raise MitsimError(f"--output {output}: the frame is an OpenEXR file; give a name that ends in .exr")
    request = _request(accuracy=accuracy, seed=seed, effects=effects)
    method: Any = estimator
    with _job(quiet or as_json, max_seconds, max_memory) as job:
        place = prepare_output(output, overwrite=True, kind="file")
        bench = _open(scene, variant, None, projector, define, outside, for_render=True)
        frame = bench.render(method, spp, accuracy, seed, request["effects"], job)
        payload = {**frame.summary(), "output": str(frame.save(place))}
    lines = [
        f"{estimator}: mean irradiance {payload['mean']:.4e} W/m^2, relative noise {payload['mc_error']:.1e}, "
        f"{payload['seconds']:.2f} s: {payload['output']}"
    ]
    return _finish(as_json, payload, lines, frame.warnings)


@app.command()
def study(
    name: Annotated[str, typer.Argument(help="accuracy or diffraction", metavar="NAME")],
    scene: Annotated[str, typer.Argument(help="scene XML, or the name of a shipped scene")] = "photograph",
    output: Annotated[Path, typer.Option("-o", "--output", help="folder of the study")] = Path("study-output"),
    patterns: Patterns = "dots:7",
    seed: Seed = 0,
    camera: Camera = None,
    projector: Projector = None,
    define: Defines = None,
    outside: Outside = False,
    variant: Variant = DEFAULT_VARIANT,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """An experiment with plots and JSON: what `accuracy` costs in time, what `diffraction` at the mask does."""
    from mitsim.study import find_study

    run_study = find_study(name)
    request = mitsim.Request.of(patterns=patterns, seed=seed)
    with _job(quiet or as_json) as job:
        bench = _open(scene, variant, camera, projector, define, outside)
        result = run_study(bench, output, request, job)
    return _finish(as_json, result.payload(), result.lines(), ())


@app.command()
def doctor(
    variant: Variant = DEFAULT_VARIANT,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """What works on this machine, and the one command that mends what does not."""
    from mitsim.core.environment import doctor as run_doctor

    checks = run_doctor()
    lines = [
        f"{'ok  ' if check.ok else 'FAIL'} {check.name}: {check.detail}"
        + (f"\n     mend with: {check.remedy}" if check.remedy and not check.ok else "")
        for check in checks
    ]
    bad = tuple(f"{check.name}: {check.detail}" for check in checks if not check.ok)
    return _finish(as_json, {"checks": [asdict(check) for check in checks], "ok": not bad}, lines, bad)


# ---- helpers ---------------------------------------------------------------------------------------------------------


def _variant(name: str) -> str:
    """The name, refused when it is none that light can be traced in; every verb checks it alike."""
    from mitsim.core.environment import VARIANTS

    # CUDA has the same kinds; whether there is a GPU shows when the variant is loaded.
    if name.replace("cuda_", "llvm_", 1) not in VARIANTS:
        raise MitsimError(f"--variant {name!r}: use {', '.join(VARIANTS)}")
    return name


def _request(**values: object) -> dict[str, Any]:
    """Checked fields of a request: refused before anything is opened."""
    from mitsim.capture.request import Request

    request = Request.of(**values).model_dump()
    return {name: request[name] for name in values}


def _open(
    scene: str,
    variant: str,
    camera: str | None,
    projector: str | None,
    define: Sequence[str] | None,
    outside: bool,
    for_render: bool = False,
) -> Bench:
    parameters = {}
    for text in define or ():
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise MitsimError(f"-D {text!r}: give NAME=VALUE")
        if name in _BENCH_ARGUMENTS:
            raise MitsimError(f"-D {text!r}: mitsim itself uses the name {name}; give the scene's <default> another")
        parameters[name] = value
    return mitsim.open_bench(scene, variant, camera, projector, outside, for_render, **parameters)


def _number(argument: str, text: str) -> float | Literal["auto"]:
    """The number in ``text``, or auto."""
    if text == "auto":
        return "auto"
    try:
        return float(text)
    except ValueError:
        raise ArgumentError("lam" if argument == "lambda" else argument, f"{text!r}: give a number or auto") from None


@contextmanager
def _job(silent_progress: bool, seconds: float = DAY, gibibytes: float | None = None) -> Iterator[Job]:
    """A job with limits, and a progress bar on stderr while the context lasts."""
    from mitsim.core.job import Job
    from mitsim.core.resources import Limits

    limits = Limits(seconds, None if gibibytes is None else gibibytes * 2**30)
    with _progress(silent_progress) as progress:
        yield Job(progress=progress, limits=limits)


@contextmanager
def _progress(hidden: bool) -> Iterator[Progress]:
    """A progress bar on stderr; nothing when asked to be quiet, or when stderr is no terminal."""
    if hidden or not sys.stderr.isatty():
        from mitsim.core.arrays import silent

        yield silent
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = TextColumn("{task.description:<18}"), BarColumn(), TimeElapsedColumn()
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda stage, fraction: bar.update(task, description=stage, completed=fraction)


def _print_plan(plan: Plan) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"Effect plan at accuracy {plan.accuracy:g}")
    for heading in ("effect", "state", "reason", "error if off", "seconds"):
        table.add_column(heading, justify="right" if heading in ("error if off", "seconds") else "left")
    for row in plan.effects:
        error = "-" if row.error_if_off is None else f"{row.error_if_off:.1e}"
        table.add_row(row.name, row.state, row.reason, error, f"{row.seconds:.2f}")
    console = Console()
    console.print(table)
    stages = ", ".join(f"{name} {seconds:.2f}" for name, seconds in plan.predicted.items())
    console.print(f"Predicted time from start to finish: {plan.predicted_seconds:.2f} s ({stages})")
    if plan.cost:
        memory, disk = plan.cost.memory_bytes / 2**30, plan.cost.disk_bytes / 2**20
        console.print(f"At most {memory:.2g} GiB of memory, {disk:.3g} MiB of disk")


def _finish(as_json: bool, payload: Any, lines: Sequence[str], warnings: Sequence[str]) -> int:
    """Print the result; exit status 1 when there are warnings."""
    if as_json:
        from mitsim.core.jsonfile import plain

        print(json.dumps(plain(payload), allow_nan=False))
    else:
        for line in lines:
            print(line)
    for warning in warnings:
        print(f"mitsim: warning: {warning}", file=sys.stderr)
    return 1 if warnings else 0
