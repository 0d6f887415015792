"""The command line: parse, call the Python face, print. No physics; heavy imports happen in the verb that needs them.

Options that make up a request come from :class:`mitsim.capture.request.Request`, so that they are the same in Python.
Errors of the library speak of arguments; :func:`~mitsim.cli.options.spoken` writes them as options.
"""

from __future__ import annotations

import errno
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import typer

import mitsim
from mitsim.cli import exchange, sensor
from mitsim.cli.calibration import Wanted, check_no_plan, model_lines, modelling_of
from mitsim.cli.colour import Colour, of_calibration, of_capture, spectral
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
    SceneOrFrames,
    Seconds,
    Seed,
    Variant,
    bench_of,
    job_of,
    number_of,
    recipe_for,
    request_of,
    scope_of,
    spoken,
    swept,
)
from mitsim.cli.screen import finish, print_plan
from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.errors import MitsimError
from mitsim.core.worker import INTERRUPTED, RESUME, advise, end_stopped, stopped
from mitsim.rig.modelling import Modelling

app = typer.Typer(
    name="mitsim",
    help="A physically based simulator of coded-illumination lensless imaging.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

_MODELS = "geometric|wave"
"""What --model may be."""
_OF_FRAMES = {"frames", "camera", "output", "as_json", "quiet"}
"""Options of `mitsim calibrate` that go with --frames."""
_SPELLED = {"scene": "SCENE", "define": "-D", "outside": "--allow-outside-files", "planning": "--plan"}
"""Options that are not called like their parameter."""
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def run() -> None:
    """Serve the command line in this process: exit 0 done, 1 done but flagged, 2 refused, 128 + n ended by signal n."""
    try:
        code = app(standalone_mode=False)
    except MitsimError as error:
        _fail(spoken(error))
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
    request = mitsim.Request.of(patterns=patterns, accuracy=accuracy, seed=seed)
    with job_of(quiet or as_json) as job:
        with job.clock.stage("open scene"):
            bench = bench_of(scene, variant, camera, projector, define, outside)
        from mitsim.study.demo import demo as run_demo  # only now: it takes seconds to import

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
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """What will be simulated, why, and what it costs, before any long work."""
    from mitsim.core.resources import running_seconds

    request = request_of(patterns=patterns, accuracy=accuracy, seconds=seconds, seed=seed, effects=effects)
    bench = bench_of(scene, variant, camera, projector, define, outside)
    starting = running_seconds()
    plan = bench.plan(**request).taking(start=starting)
    if not as_json:
        print_plan(plan)
    return finish(as_json, plan.payload(), [], plan.warnings)


@app.command()
def capture(
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
    colour: Colour = "no",
    max_seconds: MaxSeconds = DAY,
    max_memory: MaxMemory = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Render, expose and write one frame for each pattern; in colour, for each pattern and line of the projector."""
    from mitsim.core.resources import memory_from_here, peak_memory

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
    by_line = colour == "lines"
    advise(RESUME)
    with job_of(quiet or as_json, max_seconds, max_memory) as job:
        with job.clock.stage("open scene"):
            bench = bench_of(scene, spectral(variant) if by_line else variant, camera, projector, define, outside)
        held = memory_from_here()
        if by_line:
            runs = bench.capture_lines(request.pop("patterns"), output, resume, job, **request)
            payload, lines = of_capture(runs, output)
            payload["memory_bytes"] = max(peak_memory() - held, 0.0)
            return finish(as_json, payload, lines, payload["warnings"])
        shots = bench.capture(request.pop("patterns"), output, resume, job, **request)
    payload = {**shots.summary(), "memory_bytes": max(peak_memory() - held, 0.0)}
    taken = payload["seconds"]
    lines = [
        f"{payload['frames']} frames of {payload['shape'][0]}x{payload['shape'][1]} in {taken['total']:.1f} s "
        f"(transport {taken['transport']:.2f}, optics {taken['optics']:.2f}, sensor {taken['sensor']:.2f}, "
        f"write {taken['write']:.2f}): {payload['output']}",
        f"Monte Carlo error {payload['mc_error']:.1e}, {payload['mc_to_sensor_noise']:.0%} of the sensor's noise; "
        f"exposure {payload['exposure_s']:.3g} s a frame; memory {payload['memory_bytes'] / 2**30:.2g} GiB "
        f"of at most {payload['predicted_memory_bytes'] / 2**30:.2g} predicted",
    ]
    if seconds is not None:
        lines.append(
            f"Asked for {seconds:g} s, predicted {payload['predicted_seconds']:.1f}, taken {taken['total']:.1f}: "
            f"accuracy {payload['accuracy']:g}, total error up to {payload['total_error_bound']:.1e}"
        )
    if payload["ambient_frame"]:
        ambient = payload["ambient_frame"]
        lines.append(
            f"Ambient frame: the mean of {ambient['shots']} shots with the projector off, to be taken off; "
            f"{ambient['part']:.1%} of the frames' light is ambient, noise {ambient['noise']:.2g} of the projector's, "
            f"total error up to {payload['total_error_of_projector']:.1e} of it"
        )
    return finish(as_json, payload, lines, shots.warnings)


@app.command()
def calibrate(
    context: typer.Context,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="calibration folder to make; of --plan, recipe to write", metavar="CAL"),
    ] = None,
    scene: SceneOrFrames = None,
    frames: Annotated[
        Path | None, typer.Option(help="folder with the frames of a real session, instead of a scene", metavar="DIR")
    ] = None,
    accuracy: Accuracy = 1e-3,
    camera: Camera = None,
    projector: Projector = None,
    recipe: Annotated[Path | None, typer.Option(help="session recipe, TOML", metavar="FILE.toml")] = None,
    planning: Annotated[
        bool, typer.Option("--plan", help="find the light that an image of --psnr needs; calibrates nothing")
    ] = False,
    psnr: Annotated[float | None, typer.Option(help="wanted of --plan's image [dB]", metavar="DB")] = None,
    patterns: Annotated[str | None, typer.Option(help="of --plan's capture", show_default="dots:7")] = None,
    model: Annotated[
        str | None,
        typer.Option(help="model the factors, its rig fitted to a few frames; of --frames with SCENE", metavar=_MODELS),
    ] = None,
    frames_used: Annotated[
        int | None, typer.Option(help="frames that --model is fitted to, at most", show_default="16", metavar="K")
    ] = None,
    fit: Annotated[
        str | None, typer.Option(help="what --model fits", show_default="mask, magnification, gain", metavar="NAME,...")
    ] = None,
    write_frames: Annotated[
        Path | None, typer.Option(help="folder to write the simulated frames to, for --frames", metavar="DIR")
    ] = None,
    seed: Seed = 0,
    define: Defines = None,
    outside: Outside = False,
    resume: Resume = False,
    variant: Variant = DEFAULT_VARIANT,
    colour: Colour = "no",
    max_seconds: MaxSeconds = DAY,
    max_memory: MaxMemory = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Render a Hadamard session on a white board, or read the frames of a real one, and estimate the camera's
    factors."""
    if model is not None and not planning:
        modelling, folder = modelling_of(model, frames_used, fit, accuracy), check_no_plan(psnr, patterns, output)
        return _calibrate_model(context, modelling, folder)
    for option, value in (("--frames-used", frames_used), ("--fit", fit), ("--model", model)):
        if value is not None:
            raise MitsimError(f"{option} {value}: is for --model without --plan; leave it out")
    if frames is not None:
        given = (name for name in context.params if _is_given(context, name))
        others = sorted({*given} - _OF_FRAMES)
        return _calibrate_frames(frames, check_no_plan(None, None, output), camera, others, as_json, quiet)
    if scene is None:
        raise MitsimError("calibrate: give a scene, or --frames DIR with the frames of a real session")
    from mitsim.core.resources import memory_from_here, peak_memory
    from mitsim.rig.recipe import load_recipe

    request = request_of(accuracy=accuracy, seed=seed)
    session = load_recipe(recipe)
    if write_frames is not None and resume:
        raise MitsimError("--write-frames: a resumed session shows its finished patterns no more; leave out --resume")
    by_line = colour == "lines"
    if by_line and write_frames is not None:
        raise MitsimError(
            f"--write-frames {write_frames}: frames are kept of light that is not told apart; leave one out"
        )
    if planning:
        if write_frames is not None:
            raise MitsimError(f"--write-frames {write_frames}: --plan takes no frames; leave one of them out")
        if by_line:
            raise MitsimError("--colour lines: --plan is for light that is not told apart; leave one of them out")
        wanted = Wanted.of(psnr, patterns, output, resume)
        with job_of(quiet or as_json, max_seconds, max_memory) as job:
            with job.clock.stage("open scene"):
                bench = bench_of(scene, variant, camera, projector, define, outside)
            return wanted.planned(bench, session, request, job, as_json)
    folder = check_no_plan(psnr, patterns, output)
    advise(RESUME)
    with job_of(quiet or as_json, max_seconds, max_memory) as job:
        with job.clock.stage("open scene"):
            bench = bench_of(scene, spectral(variant) if by_line else variant, camera, projector, define, outside)
        held = memory_from_here()
        if by_line:
            colours = bench.calibrate_lines(**request, recipe=session, output=folder, resume=resume, job=job)
            payload, lines = of_calibration(colours, folder)
            payload["memory_bytes"] = max(peak_memory() - held, 0.0)
            return finish(as_json, payload, lines, payload["warnings"])
        whole: dict[str, Any] = {**request, "recipe": session, "output": folder, "job": job}
        if write_frames is not None:
            found = [bench.write_session(write_frames, **whole)]
        elif session.depths:
            found = [*bench.calibrate_depths(**whole, resume=resume).values()]
        else:
            found = [bench.calibrate(**whole, resume=resume)]
    taken = max(peak_memory() - held, 0.0)
    places = [str(folder / f"{depth:g}") for depth in session.depths] or [str(folder)]
    payloads = [
        {**factors.manifest.result, "memory_bytes": taken, "output": place}
        for factors, place in zip(found, places, strict=True)
    ]
    lines = [line for payload in payloads for line in _session_lines(payload)]
    warnings = [text for factors in found for text in factors.warnings]
    if not session.depths:
        return finish(as_json, payloads[0], lines, warnings)
    return finish(as_json, {"depths": payloads, "output": str(folder), "warnings": warnings}, lines, warnings)


def _session_lines(payload: dict[str, Any]) -> list[str]:
    """What is said of a simulated session, by its ``payload``."""
    # JSON has no numbers beyond the finite ones.
    residual, clean, error, condition = (
        math.inf if payload[name] is None else payload[name]
        for name in ("separability_residual", "noise_free_residual", "phi_error", "condition")
    )
    return [
        f"{payload['frames']} frames of {payload['n']} stripes in {payload['seconds']['total']:.1f} s: "
        f"{payload['output']}",
        f"separability residual {residual:.2%} ({clean:.1e} without noise), factor error {error:.1e}, condition "
        f"{condition:.2e}",
        f"memory {payload['memory_bytes'] / 2**30:.2g} GiB of at most {payload['predicted_memory_bytes'] / 2**30:.2g} "
        "predicted",
    ]


def _calibrate_model(context: typer.Context, modelling: Modelling, output: Path) -> int:
    """Factors of a model that is fitted to a few frames.

    Parameters
    ----------
    context
        of `mitsim calibrate`, with all its options.
    modelling, output
        what is fitted, and the CAL folder.

    Raises
    ------
    MitsimError
        for a missing scene, options that a fit does not have, and whatever it refuses.
    """
    from mitsim.rig.framelist import load_frames
    from mitsim.rig.recipe import load_recipe

    asked = context.params
    if asked["scene"] is None:
        raise MitsimError("--model: give the scene too, which states the camera and projector as they were to be built")
    frames_alone = ("recipe", "seed", "accuracy") if asked["frames"] else ()
    for name in ("resume", "write_frames", "colour", *frames_alone):
        if _is_given(context, name):
            other = " of --frames" if name in frames_alone else ""
            raise MitsimError(f"--{name.replace('_', '-')}: is of no use with --model{other}; leave it out")
    request_of(accuracy=asked["accuracy"], seed=asked["seed"])
    recipe, frames = load_recipe(asked["recipe"]), asked["frames"] and load_frames(asked["frames"])
    bench_words = (asked[name] for name in ("scene", "variant", "camera", "projector", "define", "outside"))
    with job_of(asked["quiet"] or asked["as_json"], asked["max_seconds"], asked["max_memory"]) as job:
        with job.clock.stage("open scene"):
            bench = bench_of(*bench_words)
        from mitsim.capture.modelling import calibrate_model

        factors = calibrate_model(bench, modelling, frames, recipe, asked["seed"], output, job)
    result = factors.manifest.result
    return finish(asked["as_json"], {**result, "output": str(output)}, model_lines(result, output), factors.warnings)


def _is_given(context: typer.Context, name: str) -> bool:
    """Whether the command line of a ``context`` names the parameter ``name``."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _calibrate_frames(
    folder: Path, output: Path, camera: str | None, others: Sequence[str], as_json: bool, quiet: bool
) -> int:
    """Factors from the frames of a real session, and how good they are.

    Parameters
    ----------
    folder, output, camera, as_json, quiet
        as the options of `mitsim calibrate`.
    others
        options beside them, which frames leave no choice of.

    Raises
    ------
    MitsimError
        when there are such, and for frames that cannot be used.
    """
    if others:
        name = _SPELLED.get(others[0], f"--{others[0].replace('_', '-')}")
        raise MitsimError(f"--frames {folder}: frames and their list decide; leave out {name}")
    from mitsim.core.resources import memory_from_here, peak_memory
    from mitsim.rig.framelist import load_frames

    session = load_frames(folder)  # refused before the estimator is imported
    from mitsim.reconstruct.measured import calibrate_frames

    held = memory_from_here()
    with job_of(quiet or as_json) as job:
        factors = calibrate_frames(session, output, job, camera)
    payload = {
        **factors.manifest.result,
        "memory_bytes": max(peak_memory() - held, 0.0),
        "output": str(output),
    }
    residual, error, condition = (
        math.inf if payload[name] is None else payload[name]
        for name in ("separability_residual", "predicted_phi_error", "condition")
    )
    lines = [
        f"{payload['frames']} frames of {payload['n']} stripes in {payload['seconds']['total']:.1f} s: {output}",
        f"separability residual {residual:.2%}, factor error {error:.1e} by its noise, condition {condition:.2e}",
        *(f"not known: {text}" for text in payload["not_known"]),
    ]
    return finish(as_json, payload, lines, factors.warnings)


@app.command()
def reconstruct(
    run: Annotated[Path, typer.Argument(help="folder of `mitsim capture`", metavar="RUN")],
    calibration: Annotated[Path, typer.Option(help="folder of `mitsim calibrate`", metavar="CAL")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="folder for the image; RUN/reconstruction if not given")
    ] = None,
    lam: Annotated[str, typer.Option("--lambda", help="regularisation, or auto", metavar="auto|VALUE")] = "auto",
    method: Annotated[str, typer.Option(help="tikhonov or tv")] = "tikhonov",
    focus: Annotated[
        str | None,
        typer.Option(
            help="depth of the scene; auto: found; map: one for each pixel, by dots; the calibrated one if not given",
            metavar="auto|MM|map",
        ),
    ] = None,
    chart: Annotated[
        str | None,
        typer.Option(
            help="of a coloured run: the chart in the image that colours are fitted on, a scene's name or a file",
            metavar="NAME|FILE.json",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace an earlier image in the folder")] = False,
    variant: Variant = DEFAULT_VARIANT,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Recover the image from frames and a calibration alone; of coloured folders, one of each line, and in colour."""
    from mitsim.core.colours import is_coloured
    from mitsim.core.manifests import CalibrationManifest, RunManifest, read_manifest

    strength = number_of("lambda", lam)
    depth = None if focus is None else number_of("focus", focus, ("auto", "map"))
    if is_coloured(run):
        options = {"lam": strength, "method": method, "overwrite": overwrite, "focus": depth}
        return _reconstruct_colours(run, calibration, output or run / "reconstruction", chart, options, as_json)
    if chart is not None:
        raise MitsimError(f"--chart {chart}: {run} is not coloured; leave out --chart")
    # Refused before the solver is imported, which takes half a second.
    read_manifest(run, RunManifest)
    read_manifest(calibration, CalibrationManifest)
    from mitsim.core.resources import memory_from_here, peak_memory
    from mitsim.study.quality import reconstruct as reconstruct_folder

    held = memory_from_here()
    result = reconstruct_folder(run, calibration, output or run / "reconstruction", strength, method, overwrite, depth)
    payload = {**result.summary(), "memory_bytes": max(peak_memory() - held, 0.0)}
    lines = [payload["status"]]
    if result.quality is not None:
        lines.append(str(result.quality))
    lines.append(
        f"lambda {payload['lambda']:.3g}, rank {payload['rank']}, condition {payload['condition_whole']:.3g}, "
        f"residual {payload['residual']:.1e}: {payload['output']}"
    )
    if result.reconstruction.focus is not None:
        lines.append(str(result.reconstruction.focus))
    lines += result.reconstruction.trust
    return finish(as_json, payload, lines, () if result.reconstruction.ok else (payload["status"],))


def _reconstruct_colours(
    run: Path, calibration: Path, output: Path, chart: str | None, options: dict[str, Any], as_json: bool
) -> int:
    """The image of every line of a coloured run, and one in colour.

    Parameters
    ----------
    run, calibration, output, chart, as_json
        as the options of `mitsim reconstruct`.
    options
        those that every line is solved with.
    """
    from mitsim.core.colours import CALIBRATION, RUN, read_colours
    from mitsim.core.manifests import CalibrationManifest, RunManifest, read_manifest
    from mitsim.rig.chart import load_chart

    # Refused before the solver and colour-science are imported.
    for name in read_colours(run, RUN).names:
        read_manifest(run / name, RunManifest)
    for name in read_colours(calibration, CALIBRATION).names:
        read_manifest(calibration / name, CalibrationManifest)
    place = None if chart is None else load_chart(chart)
    from mitsim.core.resources import memory_from_here, peak_memory
    from mitsim.study.colours import reconstruct_colours

    held = memory_from_here()
    found = reconstruct_colours(run, calibration, output, place, **options)
    payload = {**found.summary(), "memory_bytes": max(peak_memory() - held, 0.0)}
    lines = [
        f"{name}: {judged.quality or 'no truth to compare with'}, lambda {judged.reconstruction.lam:.3g}, residual "
        f"{judged.reconstruction.residual:.1e}"
        for name, judged in found.images.items()
    ]
    lines.append(f"colours by a matrix fitted on {found.model.fitted_on}: {found.output}")
    return finish(as_json, payload, lines, found.warnings)


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
    request = request_of(accuracy=accuracy, seed=seed, effects=effects)
    method: Any = estimator
    with job_of(quiet or as_json, max_seconds, max_memory) as job:
        place = prepare_output(output, overwrite=True, kind="file")
        bench = bench_of(scene, variant, None, projector, define, outside, for_render=True)
        frame = bench.render(method, spp, accuracy, seed, request["effects"], job)
        payload = {**frame.summary(), "output": str(frame.save(place))}
    lines = [
        f"{estimator}: mean irradiance {payload['mean']:.4e} W/m^2, relative noise {payload['mc_error']:.1e}, "
        f"{payload['seconds']:.2f} s: {payload['output']}"
    ]
    return finish(as_json, payload, lines, frame.warnings)


@app.command()
def study(
    name: Annotated[str, typer.Argument(help="of the study, or merge", metavar="NAME")],
    scenes: Annotated[
        list[str] | None,
        typer.Argument(help="scene XML, or the name of a shipped scene; of merge, folders", metavar="[SCENE]"),
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="folder of the study")] = Path("study-output"),
    patterns: Patterns = "dots:7",
    seed: Seed = 0,
    camera: Camera = None,
    projector: Projector = None,
    define: Defines = None,
    outside: Outside = False,
    quick: Annotated[bool, typer.Option("--quick", help="a few points, for a first look")] = False,
    shard: Annotated[str, typer.Option(help="measure part I of N of the points", metavar="I/N")] = "1/1",
    jobs: Annotated[int | None, typer.Option(help="processes; one a processor if not given")] = None,
    scheduler: Annotated[str | None, typer.Option(help="Dask scheduler that measures the points")] = None,
    over: Annotated[
        list[str] | None, typer.Option(help="what sweep varies; may be given again", metavar="NAME=FIRST:LAST:COUNT")
    ] = None,
    measure: Annotated[str, typer.Option(help="what sweep shows: psnr, ssim, misfit, ...")] = "psnr",
    recipe: Annotated[
        Path | None, typer.Option(help="of calibration and drift: session recipe", metavar="FILE.toml")
    ] = None,
    variant: Variant = DEFAULT_VARIANT,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """An experiment with figures, CSV and JSON: the paper's, on rendered frames (patterns, distance, or all); `colour`
    of a ColorChecker; what `drift` between calibration and capture costs; `models` of a calibration; `sweep` of any
    knob; what `accuracy` costs in time, on a scene and, of none, in the `solver`; what `diffraction` at the mask does;
    how good a `calibration` session is, and why; `merge` joins the parts of --shard.
    """
    from mitsim.study import OF_NO_SCENE, find_study, is_experiment

    session = recipe_for(name, recipe)
    with job_of(quiet or as_json) as job:
        if name == "merge":
            from mitsim.study.campaign import merge

            result: Any = merge(scenes or (), output)
        elif is_experiment(name):
            from mitsim.study.campaign import Where, run_experiment
            from mitsim.study.points import Shard

            scope = scope_of(_only(scenes), variant, camera, projector, define, outside, quick)
            scope = swept(name, replace(scope, seeds=(seed,)), patterns, over or (), measure)
            scope = replace(scope, recipe=str(recipe) if recipe else None)
            result = run_experiment(name, scope, output, job, Where(Shard.of(shard), jobs, scheduler))
        else:
            run_study = find_study(name, **({"recipe": session} if session else {}))
            request = mitsim.Request.of(patterns=patterns, seed=seed)
            bench = None
            if name in OF_NO_SCENE:
                if scenes:
                    raise MitsimError(f"study {name} {' '.join(scenes)}: it is of no scene; leave the scene out")
            else:
                with job.clock.stage("open scene"):
                    bench = bench_of(_only(scenes) or "photograph", variant, camera, projector, define, outside)
            result = run_study(bench, output, request, job)
    return finish(as_json, result.payload(), result.lines(), ())


def _only(scenes: list[str] | None) -> str | None:
    """The scene that is studied, where one is given; MitsimError for several."""
    if scenes and len(scenes) > 1:
        raise MitsimError(f"{' '.join(scenes)}: give one scene")
    return scenes[0] if scenes else None


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
