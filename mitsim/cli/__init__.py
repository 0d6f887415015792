"""The command line: parse, call the Python face, print. No physics; heavy imports happen in the verb that needs them.

Options that make up a request come from :class:`mitsim.bench.request.Request`, so that they are the same in Python.
Errors of the library speak of arguments; :func:`~mitsim.cli.options.spoken` writes them as options.
"""

from __future__ import annotations

import errno
import signal
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

import mitsim
from mitsim.cli import calibration, exchange, image, sensor, study
from mitsim.cli.colour import (
    AUTO,
    MOSAIC,
    NO,
    Colour,
    ambient_of,
    by_line,
    check_colour,
    chosen_of,
    in_colour,
    of_capture,
    of_mosaic,
    plan_of,
    variant_for,
    weighed,
)
from mitsim.cli.options import (
    DAY,
    Accuracy,
    AccuracyOrSeconds,
    Camera,
    Defines,
    Effects,
    Json,
    MaxMemory,
    MaxSeconds,
    Outside,
    Patterns,
    Projector,
    Quiet,
    Resume,
    Scene,
    Seconds,
    Seed,
    Variant,
    bench_of,
    check_camera,
    check_shown,
    check_work,
    is_given,
    job_of,
    number_of,
    refuse_unused,
    request_of,
    spoken,
)
from mitsim.cli.screen import finish, print_plan
from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.errors import MitsimError, printable
from mitsim.core.worker import INTERRUPTED, RESUME, advise, end_stopped, end_uncaught, stopped

app = typer.Typer(
    name="mitsim",
    help="A physically based simulator of coded-illumination lensless imaging.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

_OF_OTHER = {"reference": ("accuracy", "effects"), "factored": ("spp",)}
"""Options of `mitsim render` that an estimator does not have: a note says so, for programs give both of them all."""
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def run() -> None:
    """Serve the command line in this process: exit 0 done, 1 done but flagged, 2 refused or failed, 128 + n ended by
    signal n."""
    try:
        Path.cwd()
    except FileNotFoundError:
        _fail("the working folder does not exist any more; change to another one")
    try:
        code = app(standalone_mode=False)
    except SystemExit as ended:
        if ended.code == 1:  # click's for a reader that went away
            sys.exit(128 + signal.SIGPIPE)
        raise
    except MitsimError as error:
        _fail(spoken(error))
    except (typer.Abort, KeyboardInterrupt) as error:
        if isinstance(error.__cause__, EOFError):  # which click takes for Control-D
            end_uncaught(error.__cause__)
        code = INTERRUPTED
    except MemoryError:
        _fail("out of memory; close other programs, or ask for fewer pixels, frames or less accuracy")
    except OSError as error:
        # What no check foresees: a full disk, a name too long, a file taken away. Other errors are faults of ours.
        if error.filename is None and error.errno not in _NO_ROOM:
            end_uncaught(error)
        _fail(f"{error.filename or 'output'}: {error.strerror}; choose another place")
    except Exception as error:
        # Usage errors of click (wherever typer keeps it) carry their own one-line message.
        if hasattr(error, "format_message") and hasattr(error, "exit_code"):
            _fail(_usage(error))
        end_uncaught(error)
    if code == INTERRUPTED:  # some versions of typer turn Control-C into this status without a word
        end_stopped()
    sys.exit(code if isinstance(code, int) else 0)


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
    if stopped():
        end_stopped()  # what an interrupt became on its way, as of a module that was being imported
    print(f"mitsim: {' '.join(printable(message).split())}", file=sys.stderr)
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
    from mitsim.studies.framework.run import check_study_folder

    request = mitsim.Request.of(patterns=patterns, accuracy=accuracy, seed=seed)
    check_study_folder(output, "demo")
    check_camera(camera, request.timing)
    check_shown([patterns], scene, define, outside)
    with job_of(quiet or as_json) as job:
        with job.clock.stage("open scene"):
            bench = bench_of(scene, variant, camera, projector, define, outside)
        from mitsim.studies.demo import demo as run_demo  # only now: it takes seconds to import

        result = run_demo(bench, output, request, job)
    return finish(as_json, result.payload(), result.lines(), result.warnings)


@app.command()
def plan(
    scene: Scene,
    patterns: Patterns = "dots:7",
    accuracy: AccuracyOrSeconds = None,
    seconds: Seconds = None,
    seed: Seed = 0,
    camera: Camera = None,
    projector: Projector = None,
    define: Defines = None,
    outside: Outside = False,
    effects: Effects = "",
    variant: Variant = DEFAULT_VARIANT,
    colour: Colour = NO,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """What will be simulated, why, and what it costs, before any long work."""
    from mitsim.core.resources import running_seconds

    request = request_of(patterns=patterns, accuracy=accuracy, seconds=seconds, seed=seed, effects=effects)
    check_colour(colour, variant, projector, seconds)
    check_shown([patterns], scene, define, outside)
    bench = bench_of(scene, variant_for(colour, variant, camera), camera, projector, define, outside)
    starting = running_seconds()
    plan = plan_of(bench, colour, request).taking(start=starting)
    if not as_json:
        print_plan(plan)
    return finish(as_json, plan.payload(), [], plan.warnings)


@app.command()
def capture(
    context: typer.Context,
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="run folder to make", metavar="RUN")],
    patterns: Patterns,
    accuracy: AccuracyOrSeconds = None,
    seconds: Seconds = None,
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
    colour: Colour = NO,
    max_seconds: MaxSeconds = DAY,
    max_memory: MaxMemory = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Render, expose and write one frame for each pattern; in colour, for each pattern and line of the projector."""
    from mitsim.core.manifests import MANIFEST
    from mitsim.core.resources import memory_from_here, memory_since

    if exposure != "auto":
        refuse_unused(context, ["exposure_fraction"], "on an --exposure in seconds")
    if ambient_frame == "no":
        refuse_unused(context, ["ambient_shots"], "with --ambient-frame no")
    request = request_of(
        patterns=patterns,
        accuracy=accuracy,
        seconds=seconds,
        seed=seed,
        exposure=number_of("exposure", exposure),
        exposure_fraction=exposure_fraction,
        effects=effects,
        noise_fraction=noise_fraction,
        ambient_frame=ambient_frame,
        ambient_shots=ambient_shots,
    )
    traced_in = variant_for(colour, variant, camera)
    begun_in_one = (output / MANIFEST).is_file()  # which auto may decide for
    check_work(output, resume, "capture", several=by_line(colour) or (colour == AUTO and not begun_in_one))
    check_colour(colour, variant, projector, seconds)
    if colour != MOSAIC:
        check_camera(camera, mitsim.Request.of(**request).timing)
    check_shown([patterns], scene, define, outside)
    advise(RESUME)
    with job_of(quiet or as_json, max_seconds, max_memory) as job:
        with job.clock.stage("open scene"):
            bench = bench_of(scene, traced_in, camera, projector, define, outside)
        held = memory_from_here()
        if colour == MOSAIC:
            seen = bench.capture_mosaic(request.pop("patterns"), output, resume, job, **request)
            payload, lines = of_mosaic(seen)
            payload["memory_bytes"] = memory_since(held)
            return finish(as_json, payload, lines, seen.warnings)
        what, more = request.pop("patterns"), request
        if colour == AUTO:
            bench, what, colour = chosen_of(bench, {"patterns": what, **request}, job)
            more = {}
        if by_line(colour):
            runs = in_colour(bench, colour).capture_lines(what, output, resume, job, **more)
            payload, lines = of_capture(runs, output)
            payload["memory_bytes"] = memory_since(held)
            return finish(as_json, payload, lines, payload["warnings"])
        shots = bench.capture(what, output, resume, job, **more)
    payload = {**shots.summary(), "memory_bytes": memory_since(held)}
    taken = payload["seconds"]
    lines = [
        f"{payload['frames']} frames of {payload['shape'][0]}x{payload['shape'][1]} in {taken['total']:.1f} s "
        f"(transport {taken['transport']:.2f}, optics {taken['optics']:.2f}, sensor {taken['sensor']:.2f}, "
        f"write {taken['write']:.2f}): {payload['output']}",
        f"Monte Carlo error {payload['mc_error']:.1e}, {payload['mc_to_sensor_noise']:.0%} of the sensor's noise; "
        f"exposure {payload['exposure_s']:.3g} s a frame; memory {payload['memory_bytes'] / 2**30:.2g} GiB "
        f"of at most {payload['predicted_memory_bytes'] / 2**30:.2g} predicted",
    ]
    lines += weighed(payload)
    if seconds is not None:
        lines.append(
            f"Asked for {seconds:g} s, predicted {payload['predicted_seconds']:.1f}, taken {taken['total']:.1f}: "
            f"accuracy {payload['accuracy']:g}, total error up to {payload['total_error_bound']:.1e}"
        )
    return finish(as_json, payload, [*lines, *ambient_of(payload)], shots.warnings)


app.registered_commands += calibration.app.registered_commands + image.app.registered_commands


@app.command()
def render(
    context: typer.Context,
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="frame to write", metavar="FRAME.exr")],
    estimator: Annotated[str, typer.Option(help="reference or factored")] = "reference",
    spp: Annotated[
        int | None,
        typer.Option(help="samples a pixel of the reference", show_default="the scene's sample_count, or 64"),
    ] = None,
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
    from mitsim.bench.request import check_samples
    from mitsim.core.files import check_apart, check_output, output_file

    if output.suffix.lower() != ".exr":
        raise MitsimError(f"--output {output}: the frame is an OpenEXR file; give a name that ends in .exr")
    request = request_of(accuracy=accuracy, seed=seed, effects=effects)
    check_samples(estimator, spp)
    ignored = [f"--{name} has no effect on the {estimator}" for name in _OF_OTHER[estimator] if is_given(context, name)]
    check_output(output, overwrite=True, kind="file")
    method: Any = estimator
    with job_of(quiet or as_json, max_seconds, max_memory) as job:
        bench = bench_of(scene, variant, None, projector, define, outside, for_render=True)
        check_apart(output, bench.loaded.files)
        with output_file(output, overwrite=True) as place:
            frame = bench.render(method, spp, accuracy, seed, request["effects"], job)
            payload = {**frame.summary(), "output": str(frame.save(place))}
    payload["notes"] = [*payload["notes"], *ignored]
    lines = [
        f"{estimator}: mean irradiance {payload['mean']:.4e} W/m^2, relative noise {payload['mc_error']:.1e}, "
        f"{payload['seconds']:.2f} s: {payload['output']}",
        *payload["notes"],
    ]
    return finish(as_json, payload, lines, frame.warnings)


app.registered_commands += study.app.registered_commands
app.registered_commands += exchange.app.registered_commands + sensor.app.registered_commands


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
    return finish(as_json, {"checks": [asdict(check) for check in checks], "ok": not bad}, lines, bad)
