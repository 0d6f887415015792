"""The command line: parse, call the Python face, print. No physics; heavy imports happen in the verb that needs them.

Options that make up a request come from :class:`mitsim.bench.request.Request`, so that they are the same in Python.
Errors of the library speak of arguments; :func:`~mitsim.cli.options.message_of` writes them as options.
"""

from __future__ import annotations

import errno
import signal
import sys
import warnings
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import mitsim
from mitsim.cli.calibrate_verb import calibrate
from mitsim.cli.exchange_verbs import export, import_, patterns, transport
from mitsim.cli.frame_verbs import characterise, reconstruct, sense
from mitsim.cli.help_page import LIMITS, QUALITY, WHAT, Program, Verb, parts_of
from mitsim.cli.learned_verbs import pairs, train
from mitsim.cli.options import (
    AUTO,
    MOSAIC,
    NO,
    Accuracy,
    Coloured,
    Common,
    Devices,
    Effects,
    ExposureFraction,
    KnownPlan,
    LimitedPictured,
    LitScene,
    OfPatterns,
    Overwrite,
    Patterns,
    Resume,
    Sampling,
    Scene,
    Seed,
    by_line,
    check_work,
    complete_scene,
    given_of,
    in_colour,
    is_given,
    message_of,
    number_of,
    option,
    pop_patterns,
    refuse_unused,
    request_of,
    verb,
)
from mitsim.cli.report_verb import finish_folder, finish_frame, report
from mitsim.cli.run_verb import run_
from mitsim.cli.screen import finish, kernel_lines, memory_line, payload_of_lines, plan_lines, total_of_lines
from mitsim.cli.shelf_verbs import list_, new
from mitsim.cli.study_verb import study
from mitsim.cli.view_verb import view
from mitsim.core.errors import MitsimError, printable
from mitsim.core.spectral_manifests import LINES, MONO, RUN
from mitsim.core.spectral_manifests import MOSAIC as MOSAIC_RUN
from mitsim.core.worker import INTERRUPTED, RESUME, advise, end_stopped, end_uncaught, is_stopped, say_note
from mitsim.devices.patterns import pattern_names

if TYPE_CHECKING:
    from mitsim.api.bench import Bench
    from mitsim.bench.request import Task
    from mitsim.core.job import Job
    from mitsim.light.plan import Plan

app = typer.Typer(
    name="mitsim",
    help="A physically based simulator of coded-illumination lensless imaging.",
    no_args_is_help=True,
    cls=Program,
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
        with warnings.catch_warnings(record=True) as found:
            code = app(standalone_mode=False)
        for note in dict.fromkeys(str(each.message) for each in found):  # not before: progress is shown meanwhile
            say_note(note)
    except SystemExit as ended:
        if ended.code == 1:  # click's for a reader that went away
            sys.exit(128 + signal.SIGPIPE)
        raise
    except MitsimError as error:
        _fail(*message_of(error).split("\n"))
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
        typer.echo(message, err=True)
        return "give one of the commands above"
    checked = getattr(error.__cause__, "errors", None)
    if checked is not None:
        message += f"; got {checked()[0].get('input')!r}"
    context = getattr(error, "ctx", None)
    return message if context is None else f"{message.rstrip('.')}; see {context.command_path} --help"


def _fail(*lines: str) -> None:
    if is_stopped():
        end_stopped()  # what an interrupt became on its way, as of a module that was being imported
    print("mitsim:", "\n  ".join(" ".join(printable(line).split()) for line in lines), file=sys.stderr)
    sys.exit(2)


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="print the version and exit")] = False) -> None:
    if version:
        print(mitsim.__version__)
        raise typer.Exit


# ---- demo and plan ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DemoRequest:
    """What the demo's captures are asked for."""

    PANEL = WHAT

    patterns: Patterns = "dots:7"
    accuracy: Accuracy = 1e-3
    seed: Seed = 0


@verb
def demo(
    *,
    scene: Annotated[
        str,
        typer.Argument(
            help="scene XML, or the name of a shipped scene", metavar="[SCENE]", autocompletion=complete_scene
        ),
    ] = "photograph",
    output: Annotated[Path, typer.Option("-o", "--output", help="folder of the demo", metavar="DIR")] = Path(
        "demo-output"
    ),
    asked: DemoRequest,
    devices: Devices,
    common: Common,
) -> int:
    """The whole job, from plan to images of five pattern families.

    Plans, captures, calibrates and reconstructs one scene, and writes report.html.

    $ mitsim demo
    $ mitsim demo cookie_bag -o bag --accuracy 0.01
    """
    with common.job() as job:
        result = mitsim.demo(scene, output, job=job, **vars(asked), **devices.arguments, variant=common.variant)
    return finish(common.as_json, result.payload(), result.lines(), result.warnings)


@verb
def plan(
    scene: Scene,
    sampling: OfPatterns,
    devices: Coloured,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="file to make, for capture --plan", metavar="FILE.json")
    ] = None,
    overwrite: Overwrite = False,
    everything: Annotated[bool, typer.Option("--all", help="all effects, and all of their reasons")] = False,
    *,
    common: Common,
) -> int:
    """What a capture will simulate, why, and what it will cost.

    A short look at the scene finds the cheapest combination of effects whose error is within the accuracy.

    $ mitsim plan cookie_bag
    $ mitsim plan photograph --accuracy 1e-4 -D sheet_z=380
    $ mitsim plan cookie_bag -o plan.json
    """
    from mitsim.core.files import check_apart, output_file
    from mitsim.core.job import compiled_kernels, running_seconds

    request = request_of(sampling)
    devices.check_colour(common.variant, sampling.seconds)
    devices.check(scene, sampling.patterns)
    variant = devices.traced_in(common.variant)
    with nullcontext() if output is None else output_file(output, overwrite) as place, common.job() as job:
        bench = devices.open(scene, variant, job)
        if place is not None:
            check_apart(place, (*bench.loaded.files, *devices.models))
        from mitsim.light.memory import first_shadow

        starting, effects = running_seconds(), mitsim.Request.of(**request).effects
        with job.planning(sampling.patterns, first_shadow(bench, effects)):
            found = _plan_of(bench, devices.colour, request).taking(start=starting)
        if place is not None:
            found.save(place)
    written = {} if output is None else {"output": str(output)}
    kernels = asdict(compiled_kernels())
    lines = [] if common.as_json else plan_lines(found, everything or common.verbose)
    lines += [*(f"Plan: {text}" for text in written.values()), *kernel_lines(kernels)]
    return finish(common.as_json, {**found.payload(), **written, "kernels": kernels}, lines, found.warnings)


def _plan_of(bench: Bench, colour: str, request: dict[str, Any]) -> Plan:
    """The plan that a command line asks for.

    Parameters
    ----------
    bench, colour, request
        what it names; of the request, its fields.
    """
    if colour == AUTO:
        return bench.choose_colour(**request).plan
    if colour == NO:
        return bench.plan(**request)
    from mitsim.acquire.spectral import SpectralBench
    from mitsim.bench.request import Request

    kind = MOSAIC_RUN if colour == MOSAIC else RUN
    return SpectralBench.of(in_colour(bench, colour), kind).plan(Request.of(**request))


# ---- capture ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Capturing(Sampling):
    """What is captured, and how long it is exposed: fields of a request."""

    PANEL = WHAT

    patterns: str | None = option(None, f"{pattern_names()}; needed without --plan", metavar="PATTERNS")
    exposure: str = option("auto", "seconds a frame, or auto", metavar="auto|SECONDS")
    exposure_fraction: ExposureFraction = 0.8
    noise_fraction: float | None = option(
        None, "stop sampling at this part of the sensor's noise", metavar="PART", rich_help_panel=QUALITY
    )
    ambient_frame: str = option("auto", "take a frame with the projector off and lamps on", metavar="auto|yes|no")
    ambient_shots: int | None = option(None, "shots of that frame; by the patterns if not given", metavar="N")
    closing_frame: str | None = option(
        None,
        "frame at the end that checks lamp, camera and scene: the first one again, or a uniform one",
        metavar="first|uniform",
    )


@dataclass(frozen=True)
class Made(KnownPlan):
    """What is there already."""

    PANEL = WHAT

    light: Path | None = option(
        None, "file of `mitsim transport`: nothing is traced again", "--light", metavar="FILE.h5"
    )
    resume: Resume = False


@verb
def capture(
    *,
    context: typer.Context,
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="run folder to make", metavar="RUN")],
    capturing: Capturing,
    made: Made,
    devices: Coloured,
    limited: LimitedPictured,
) -> int:
    """Simulate the frames of a scene: one for each pattern.

    Renders, exposes and writes them; in colour, one for each pattern and line of the projector.

    $ mitsim capture photograph -o run --patterns dots:7
    $ mitsim capture cookie_bag -o bag --patterns hadamard:8 --seconds 20
    $ mitsim capture photograph -o again --plan plan.json
    """
    from mitsim.bench.request import Task
    from mitsim.core.job import memory_from_here, memory_since
    from mitsim.core.manifests import MANIFEST

    if capturing.exposure != "auto":
        refuse_unused(context, ["exposure_fraction"], "on an --exposure in seconds")
    if capturing.ambient_frame == "no":
        refuse_unused(context, ["ambient_shots"], "with --ambient-frame no")
    request, known = _request_beside(context, capturing, made)
    if made.light is not None:
        refuse_unused(context, ["resume", "colour"], "on --light, which is of all lines and soon exposed")
    asked = mitsim.Request.of(**request) if known is None else known.request_with(request)
    if known is not None and devices.colour == AUTO:
        devices = replace(devices, colour=_chosen_colour(known))
    colour, variant = devices.colour, devices.traced_in(limited.variant)
    if known is not None and colour != NO:
        pop_patterns(request, known)
    begun_in_one = (output / MANIFEST).is_file()  # which auto may decide for
    check_work(output, made.resume, "capture", several=by_line(colour) or (colour == AUTO and not begun_in_one))
    devices.check_colour(limited.variant, asked.seconds)
    if colour != MOSAIC:
        devices.check_exposure(asked.timing)
    devices.check(scene, asked.patterns)
    advise(RESUME)
    with limited.job() as job:
        bench = devices.open(scene, variant, job)
        held = memory_from_here()
        if made.light is not None:
            payload = _expose(made.light, bench, request, output, job)
        else:
            payload = _capture(bench, colour, known or request.pop("patterns"), request, Task(output, made.resume, job))
    payload["memory_bytes"] = memory_since(held)
    return finish_folder(limited, output, payload, _capture_lines(payload, limited), payload["warnings"])


def _capture(bench: Bench, colour: str, what: Plan | str, request: dict[str, Any], task: Task) -> dict[str, Any]:
    """JSON of a capture.

    Parameters
    ----------
    bench, colour, task
        what is captured, by which word of --colour, and where it goes.
    what, request
        a family or a plan, and fields of the request beside it.
    """
    output, resume, job = task.output, task.resume, task.job
    assert output is not None, "the command line writes a folder"
    if colour == AUTO:
        assert isinstance(what, str), "a plan has chosen"
        from mitsim.light.memory import first_shadow

        with job.planning(what, first_shadow(bench, mitsim.Request.of(**request).effects)):
            chosen = bench.choose_colour(patterns=what, **request)
        bench, what, request, colour = chosen.bench, chosen.plan, {}, NO if chosen.mono else LINES
    if by_line(colour):
        runs = in_colour(bench, colour).capture_lines(what, output, resume, job, **request)
        return payload_of_lines(RUN, {name: run.summary() for name, run in runs.items()}, output)
    take = bench.capture_mosaic if colour == MOSAIC else bench.capture
    return take(what, output, resume, job, **request).summary()


def _expose(path: Path, bench: Bench, request: dict[str, Any], output: Path, job: Job) -> dict[str, Any]:
    """JSON of a capture in light of a file.

    Parameters
    ----------
    path, bench
        the file, and what its light was traced on.
    request, output, job
        fields of the request, the folder, and clock, progress and limits.
    """
    with job.clock.stage("transport"):
        light = mitsim.Light.load(path, bench)
        light.check_serves(request["patterns"])
    return light.expose(request.pop("patterns"), output, job, **request).summary()


def _request_beside(context: typer.Context, capturing: Capturing, made: Made) -> tuple[dict[str, Any], Plan | None]:
    """Checked fields of the request, and the plan that is there: of all fields, or of those that are given beside it
    or light in a file."""
    fields = vars(replace(capturing, exposure=number_of("exposure", capturing.exposure)))
    if made.plan is not None and made.light is not None:
        raise MitsimError(f"--plan {made.plan}: light in a file has a plan of its own; leave out --plan or --light")
    if made.plan is None and capturing.patterns is None:
        raise MitsimError("Missing option '--patterns': give it, or a plan with --plan")
    return made.read(context, fields if made.light is None else given_of(context, fields))


def _chosen_colour(known: Plan) -> str:
    """The word of --colour that a plan of --colour auto chose; MitsimError for another plan."""
    if known.colour is None:
        raise MitsimError("--colour auto: the plan was made with another word of --colour; give that")
    return NO if known.colour.chosen == MONO else known.colour.chosen


def _capture_lines(payload: Mapping[str, Any], common: Common) -> list[str]:
    """What is said of a capture by its ``payload``, as ``common`` options have it: of one that tells no lines apart, a
    coloured one, or of frames behind colour filters."""
    taken = payload["seconds"]
    if payload.get("kind") == RUN:
        each = [
            f"{part['name']}: {part['frames']} frames of {part['shape'][0]}x{part['shape'][1]}, Monte Carlo error "
            f"{part['mc_error']:.1e}, total error up to {part['total_error_bound']:.1e}, exposure "
            f"{part['exposure_s']:.3g} s a frame"
            for part in payload["channels"]
        ]
        return [total_of_lines(payload), *each, *kernel_lines(payload["kernels"]), *_colour_lines(payload)]
    frames = f"{payload['frames']} frames of {payload['shape'][0]}x{payload['shape'][1]}"
    if "mosaic" in payload:
        return [
            f"{frames} behind {payload['mosaic']} filters, {len(payload['channels'])} lines at once, in "
            f"{taken['total']:.1f} s: {payload['output']}",
            f"Monte Carlo error at most {payload['mc_error']:.1e}, total error up to "
            f"{payload['total_error_bound']:.1e}, exposure {payload['exposure_s']:.3g} s a frame",
            *_ambient_lines(payload),
        ]
    lines = [
        f"{frames} in {taken['total']:.1f} s: {payload['output']}",
        f"Monte Carlo error {payload['mc_error']:.1e}, {payload['mc_to_sensor_noise']:.0%} of the sensor's noise; "
        f"exposure {payload['exposure_s']:.3g} s a frame",
        *common.details(
            f"Total error up to {payload['total_error_bound']:.1e}, accuracy {payload['accuracy']:g}",
            f"Seconds: {', '.join(f'{name} {seconds:.2f}' for name, seconds in taken.items() if name != 'total')}",
            memory_line(payload),
        ),
        *kernel_lines(payload["kernels"]),
        *_colour_lines(payload),
    ]
    if payload["asked_seconds"] is not None:
        lines.append(
            f"Asked for {payload['asked_seconds']:g} s, predicted {payload['predicted_seconds']:.1f}, taken "
            f"{taken['total']:.1f}: accuracy {payload['accuracy']:g}, total error up to "
            f"{payload['total_error_bound']:.1e}"
        )
    if closing := payload["closing_frame"]:
        lines.append(f"Closing frame: {closing['kind']}, exposed for {closing['exposure_s']:.3g} s")
    return [*lines, *_ambient_lines(payload)]


def _colour_lines(payload: Mapping[str, Any]) -> list[str]:
    """The line that a capture's ``payload`` says of what was weighed for colour; none where that was not asked for."""
    choice = payload["colour"]
    if choice is None or len(choice["candidates"]) < 2:
        return []
    errors = ", ".join(f"{each['name']} {each['error']:.1e}" for each in choice["candidates"])
    return [f"Colour: {choice['chosen']} (error that each leaves: {errors})"]


def _ambient_lines(payload: Mapping[str, Any]) -> list[str]:
    """The line that a capture's ``payload`` says of its ambient frame; none where none was taken."""
    ambient = payload["ambient_frame"]
    if not ambient:
        return []
    return [
        f"Ambient frame: the mean of {ambient['shots']} shots with the projector off, to be taken off; "
        f"{ambient['part']:.1%} of the frames' light is ambient, noise {ambient['noise']:.2g} of the projector's, "
        f"total error up to {payload['total_error_of_projector']:.1e} of it"
    ]


# ---- render and doctor -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Estimating:
    """What estimates the irradiance, and how finely."""

    PANEL = QUALITY

    estimator: str = option("reference", "reference or factored", metavar="NAME")
    spp: int | None = option(None, "samples a pixel of the reference", show_default="the scene's sample_count, or 64")
    accuracy: Accuracy = 1e-3
    seed: Seed = 0
    effects: Effects = ""


@verb
def render(
    context: typer.Context,
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="frame to write", metavar="FRAME.exr")],
    estimating: Estimating,
    lit: LitScene,
    limited: LimitedPictured,
) -> int:
    """Expected irradiance on the sensor, in the scene's own light.

    The reference follows path by path through the mask, without diffraction; factored is what other verbs use.

    $ mitsim render photograph -o frame.exr --spp 16
    $ mitsim render photograph -o fast.exr --estimator factored
    """
    from mitsim.bench.request import check_samples
    from mitsim.core.files import check_apart, check_output, output_file

    if output.suffix.lower() != ".exr":
        raise MitsimError(f"--output {output}: the frame is an OpenEXR file; give a name that ends in .exr")
    method: Any = estimating.estimator
    accuracy, seed = estimating.accuracy, estimating.seed
    effects = request_of(accuracy=accuracy, seed=seed, effects=estimating.effects)["effects"]
    check_samples(method, estimating.spp)
    ignored = [f"--{name} has no effect on the {method}" for name in _OF_OTHER[method] if is_given(context, name)]
    check_output(output, overwrite=True, kind="file")
    with limited.job() as job:
        bench = lit.open_for_render(scene, limited.variant)
        check_apart(output, bench.loaded.files)
        with output_file(output, overwrite=True) as place:
            frame = bench.render(method, estimating.spp, accuracy, seed, effects, job)
            payload = {**frame.summary(), "output": str(frame.save(place))}
    payload["notes"] = [*payload["notes"], *ignored]
    bound = payload["mc_error_bound"]
    lines = [
        f"{method}: mean irradiance {payload['mean']:.4e} W/m^2, relative noise {payload['mc_error']:.1e}"
        f"{'' if bound is None else f' (below {bound:.1e} at 95 %)'}, {payload['seconds']:.2f} s: {payload['output']}",
        *payload["notes"],
    ]
    shown = frame.mean[..., 0] if frame.mean.shape[2] == 1 else frame.mean
    return finish_frame(limited, (output, shown, "W/m^2"), payload, lines, frame.warnings)


@verb
def doctor(
    common: Common,
    warm: Annotated[
        bool,
        typer.Option(
            "--warm", help="compile the usual kernels into Dr.Jit's cache: half a minute", rich_help_panel=LIMITS
        ),
    ] = False,
) -> int:
    """What works on this machine, and what mends the rest.

    $ mitsim doctor
    $ mitsim doctor --warm
    """
    checks = mitsim.doctor(warm, common.variant)
    lines = [f"{sum(check.ok for check in checks)} of {len(checks)} checks pass"]
    lines += [
        f"{'ok  ' if check.ok else 'FAIL'} {check.name}: {check.detail}"
        + (f"\n     mend with: {check.remedy}" if check.remedy and not check.ok else "")
        for check in checks
    ]
    bad = tuple(f"{check.name}: {check.detail}" for check in checks if not check.ok)
    if not (bad or common.verbose):
        lines = [f"All {len(checks)} checks pass (--verbose lists them)"]
    return finish(common.as_json, {"checks": [asdict(check) for check in checks], "ok": not bad}, lines, bad)


_VERBS = {
    "The main job": (demo, run_, view, plan, capture, calibrate, reconstruct),
    "The bench": (render, sense, characterise),
    "Studies": (study,),
    "Learning": (pairs, train),
    "Exchange": (export, import_, patterns, transport),
    "Files and machine": (report, list_, new, doctor),
}
"""Verbs by heading, in the order of the help."""
for _panel, _verbs in _VERBS.items():
    for _verb in _verbs:
        app.command(
            _verb.__name__.rstrip("_"), cls=Verb, short_help=parts_of(_verb.__doc__)[0], rich_help_panel=_panel
        )(_verb)
