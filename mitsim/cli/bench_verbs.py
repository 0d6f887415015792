"""Verbs that open a scene with its devices: demo, run, view, plan, capture, render, transport, pairs and study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

import mitsim
from mitsim.bench.request import AUTO, NO, Coloured, LitScene, Opening, Planned, Request, by_line
from mitsim.cli.commands import (
    Common,
    KnownPlan,
    Limited,
    LimitedPictured,
    Overwritten,
    Resumed,
    Scene,
    check_work,
    complete_scene,
    completing,
    show,
    verb,
)
from mitsim.cli.screen import (
    finish,
    finish_folder,
    finish_frame,
    kernel_lines,
    memory_line,
    payload_of_lines,
    plan_lines,
    total_of_lines,
)
from mitsim.core.configuration import LIMITS, OUTPUT, QUALITY, WHAT, Options, option, refuse_unused
from mitsim.core.errors import MitsimError
from mitsim.core.manifests import MONO, RUN
from mitsim.core.worker import RESUME, advise
from mitsim.devices.patterns import pattern_names
from mitsim.learn.requests import PairOptions
from mitsim.studies import ALL, EXPERIMENTS, STUDIES
from mitsim.verbs import DemoRequest, RunOptions, StudyOptions, capture_in, open_as, plan_in

_OF_OTHER = {"reference": ("accuracy", "effects"), "factored": ("spp",)}
"""Options of `mitsim render` without effect on an estimator: a note says so, because programs give all of them."""
_SAMPLING = "accuracy seconds seed effects"
_ACCURACY = {"default": None, "show_default": "0.001"}
"""How an accuracy is shown that seconds may take the place of."""


# ---- demo, run and view ----------------------------------------------------------------------------------------------


@verb
def demo(
    scene: Annotated[
        str,
        typer.Argument(
            help="scene XML, or the name of a shipped scene", metavar="[SCENE]", autocompletion=complete_scene
        ),
    ] = "photograph",
    output: Annotated[Path, typer.Option("-o", "--output", help="folder of the demo", metavar="DIR")] = Path(
        "demo-output"
    ),
    *,
    asked: DemoRequest,
    common: Common,
) -> int:
    """The whole job, from plan to images of five pattern families.

    Plans, captures, calibrates and reconstructs one scene, and writes report.html.

    $ mitsim demo
    $ mitsim demo cookie_bag -o bag --accuracy 0.01
    """
    with common.job() as job:
        result = mitsim.demo(scene, output, job=job, **asked.given)
    return finish(common.as_json, result.payload(), result.lines(), result.warnings)


class Running(RunOptions):
    """How a session is run, and where it goes."""

    output: Path | None = option(
        None,
        "folder to make; of --from, session file",
        "-o",
        "--output",
        metavar="FOLDER",
        show_default="session-output",
    )
    values: list[str] | None = option(
        None, "set a field of the file; may be given again", "-D", metavar="TABLE.FIELD=VALUE", kind=list[str]
    )
    repeated: Path | None = option(None, "write the session file that repeats a folder", "--from", metavar="FOLDER")


@verb
def run_(
    session: Annotated[
        str | None, typer.Argument(help="session file, or the name of a shipped one", metavar="SESSION.toml")
    ] = None,
    *,
    running: Running,
    limited: LimitedPictured,
) -> int:
    """Take all steps of a session file, or write that of a folder.

    Each step, such as capture or a sweep, has its folder in that of the session.

    $ mitsim run demo -o out
    $ mitsim run fig1.toml -o out -D capture.patterns=dots:5
    $ mitsim run --from out/image -o figure.toml
    """
    if running.repeated is not None:
        return _repeat(session, running.repeated, running, limited)
    if session is None:
        raise MitsimError("run: give a session file, or --from FOLDER to write one")
    values = {}
    for text in running.values or ():
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise MitsimError(f"-D {text!r}: give TABLE.FIELD=VALUE")
        values[name] = value
    if "variant" in limited.given:
        values["scene.variant"] = limited.variant
    from mitsim.sessions.session_file import value_of

    asked = {name: value_of(value) for name, value in values.items()}
    advise(RESUME)
    with limited.job() as job:
        done = mitsim.run(
            session,
            running.output or "session-output",
            asked,
            job,
            resume=running.resume,
            pictures=not limited.no_pictures,
            shard=running.shard,
            scheduler=running.scheduler,
        )
    return finish(limited.as_json, done.payload(), done.lines(), done.warnings)


def _repeat(session: str | None, folder: Path, running: Running, limited: LimitedPictured) -> int:
    """Print the session file that repeats a folder, or write it."""
    if session is not None:
        raise MitsimError(f"--from {folder}: writes a session file, and {session} is one; give one of both")
    others = "values", "resume", "shard", "scheduler", "no_pictures", "variant", "max_seconds", "max_memory"
    refuse_unused({**running.given, **limited.given}, others, "with --from, which runs nothing")
    from mitsim.core.files import check_output

    if running.output is not None:
        check_output(running.output, kind="file")
    found = mitsim.session_of(folder)
    written = None if running.output is None else str(found.save(running.output))
    payload = {"session": found.text, "output": written, "warnings": found.warnings}
    lines = [found.text.rstrip()] if written is None else [f"Session file: {written}"]
    return finish(limited.as_json, payload, lines, found.warnings)


@verb
def view(
    scene: Scene,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="picture, or page to turn the bench on", metavar="FILE.png|FILE.html"),
    ] = Path("view.png"),
    *,
    opening: Opening,
    common: Common,
) -> int:
    """Draw the bench to scale, before any light is simulated.

    With its distances, the depths that light is seen at, and what the camera sees. A page (.html) can be turned.

    $ mitsim view cookie_bag
    $ mitsim view photograph -D sheet_z=420 -o bench.html
    """
    from mitsim.bench.request import check_view
    from mitsim.core.files import check_apart, check_output, output_file

    check_output(check_view(output), overwrite=True, kind="file")
    opening.check(scene)
    with output_file(output, overwrite=True) as place, common.job() as job:
        bench = open_as(scene, opening, job)
        check_apart(place, (*bench.loaded.files, *opening.models))
        with job.clock.stage("view"):
            seen = bench.view()
        with job.clock.stage("draw"):
            payload = {**seen.summary(), "output": str(seen.save(place))}
    return finish(common.as_json, payload, [*seen.lines(), f"Drawn: {payload['output']}"], seen.warnings)


# ---- plan and capture ------------------------------------------------------------------------------------------------


@verb
def plan(
    scene: Scene,
    asked: Annotated[Planned, show(accuracy=_ACCURACY)],
    coloured: Coloured,
    opening: Opening,
    overwritten: Overwritten,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="file to make, for capture --plan", metavar="FILE.json")
    ] = None,
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
    from contextlib import nullcontext

    from mitsim.core.files import check_apart, output_file
    from mitsim.core.job import compiled_kernels, running_seconds

    opening.check(scene, asked.patterns, None, coloured.colour, asked.seconds)
    file = nullcontext() if output is None else output_file(output, overwritten.overwrite)
    with file as place, common.job() as job:
        bench = open_as(scene, opening, job, coloured.colour)
        if place is not None:
            check_apart(place, (*bench.loaded.files, *opening.models))
        from mitsim.light.cost_model import first_shadow

        starting = running_seconds()
        with job.planning(asked.patterns, first_shadow(bench, asked.effects)):
            found = plan_in(bench, coloured.colour, asked).taking(start=starting)
        if place is not None:
            found.save(place)
    written = {} if output is None else {"output": str(output)}
    kernels = asdict(compiled_kernels())
    lines = [] if common.as_json else plan_lines(found, everything or common.verbose)
    lines += [*(f"Plan: {text}" for text in written.values()), *kernel_lines(kernels)]
    return finish(common.as_json, {**found.payload(), **written, "kernels": kernels}, lines, found.warnings)


class Made(KnownPlan, Resumed):
    """Work that is done already."""

    PANEL = WHAT

    light: Path | None = option(None, "file of `mitsim transport`: nothing is traced again", metavar="FILE.h5")


@verb
def capture(
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="run folder to make", metavar="RUN")],
    asked: Annotated[
        Request,
        show(
            f"patterns exposure exposure_fraction noise_fraction ambient_frame ambient_shots closing_frame {_SAMPLING}",
            patterns={"default": None, "help": f"{pattern_names()}; needed without --plan"},
            accuracy=_ACCURACY,
        ),
    ],
    made: Made,
    coloured: Coloured,
    opening: Opening,
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

    asked.refuse_idle()
    if made.light is not None:
        if made.plan is not None:
            raise MitsimError(f"--plan {made.plan}: light in a file has a plan of its own; leave out --plan or --light")
        refuse_unused(
            {**made.given, **coloured.given}, ["resume", "colour"], "on --light, which is of all lines and soon exposed"
        )
    if made.plan is None and "patterns" not in asked.given:
        raise MitsimError("Missing option '--patterns': give it, or a plan with --plan")
    colour = coloured.colour
    known = made.read(asked.given, colour != NO)
    request = asked if known is None else known.request_with(asked.given)
    if known is not None and colour == AUTO:
        if known.colour is None:
            raise MitsimError("--colour auto: the plan was made with another word of --colour; give that")
        colour = NO if known.colour.chosen == MONO else known.colour.chosen
    begun_in_one = (output / MANIFEST).is_file()  # which auto may decide for
    check_work(output, made.resume, "capture", several=by_line(colour) or (colour == AUTO and not begun_in_one))
    opening.check(scene, request.patterns, request.timing, colour, request.seconds)
    advise(RESUME)
    with limited.job() as job:
        bench = open_as(scene, opening, job, colour)
        held = memory_from_here()
        light = None
        if made.light is not None:
            with job.clock.stage("transport"):
                light = mitsim.Light.load(made.light, bench)
                light.check_serves(request.patterns)
        found = capture_in(
            bench,
            colour,
            known or request.patterns,
            asked.given if known and colour == NO else asked.without("patterns"),
            Task(output, made.resume, job),
            light,
        )
        if isinstance(found, Mapping):
            payload = payload_of_lines(RUN, {name: run.summary() for name, run in found.items()}, output)
        else:
            payload = found.summary()
    payload["memory_bytes"] = memory_since(held)
    return finish_folder(limited, output, payload, _capture_lines(payload, limited), payload["warnings"])


def _capture_lines(payload: Mapping[str, Any], common: Common) -> list[str]:
    """Return what the terminal shows of a capture, by its ``payload``."""
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
    """Return the line on the choice of colour; none if no choice was made."""
    choice = payload["colour"]
    if choice is None or len(choice["candidates"]) < 2:
        return []
    errors = ", ".join(f"{each['name']} {each['error']:.1e}" for each in choice["candidates"])
    return [f"Colour: {choice['chosen']} (error that each leaves: {errors})"]


def _ambient_lines(payload: Mapping[str, Any]) -> list[str]:
    """Return the line on the ambient frame; none without one."""
    ambient = payload["ambient_frame"]
    if not ambient:
        return []
    return [
        f"Ambient frame: the mean of {ambient['shots']} shots with the projector off, to be taken off; "
        f"{ambient['part']:.1%} of the frames' light is ambient, noise {ambient['noise']:.2g} of the projector's, "
        f"total error up to {payload['total_error_of_projector']:.1e} of it"
    ]


# ---- render, transport and pairs -------------------------------------------------------------------------------------


class Estimating(Options):
    """The estimator of the irradiance."""

    PANEL = QUALITY

    estimator: str = option("reference", "reference or factored", metavar="NAME")
    spp: int | None = option(None, "samples a pixel of the reference", show_default="the scene's sample_count, or 64")


@verb
def render(
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="frame to write", metavar="FRAME.exr")],
    estimating: Estimating,
    sampled: Annotated[Request, show("accuracy seed effects")],
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
    check_samples(method, estimating.spp)
    given = {**estimating.given, **sampled.given}
    ignored = [f"--{name} has no effect on the {method}" for name in _OF_OTHER[method] if name in given]
    check_output(output, overwrite=True, kind="file")
    with limited.job() as job:
        bench = mitsim.open_bench(
            scene, lit.variant, None, lit.projector, lit.allow_outside_files, True, **lit.parameters
        )
        check_apart(output, bench.loaded.files)
        with output_file(output, overwrite=True) as place:
            frame = bench.render(method, estimating.spp, sampled.accuracy, sampled.seed, sampled.effects, job)
            payload = {**frame.summary(), "output": str(frame.save(place))}
    payload["notes"] = [*payload["notes"], *ignored]
    bound = payload["mc_error_bound"]
    lines = [
        f"{method}: mean irradiance {payload['mean']:.4e} W/m^2, relative noise {payload['mc_error']:.1e}"
        f"{'' if bound is None else f' (below {bound:.1e} at 95 %)'}, {payload['seconds']:.2f} s: {payload['output']}",
        *payload["notes"],
    ]
    mean = frame.mean[..., 0] if frame.mean.shape[2] == 1 else frame.mean
    return finish_frame(limited, (output, mean, "W/m^2"), payload, lines, frame.warnings)


@verb
def transport(
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="HDF5 file to make", metavar="FILE.h5")],
    asked: Annotated[Planned, show(accuracy=_ACCURACY)],
    planned: KnownPlan,
    overwritten: Overwritten,
    opening: Opening,
    limited: Limited,
) -> int:
    """Trace a scene's light, for frames of any pattern.

    Written by projector pixel, for capture --light and for programs without mitsim.

    $ mitsim transport photograph -o light.h5
    $ mitsim capture photograph -o run --light light.h5 --patterns dots:5
    """
    from mitsim.core.files import check_apart, output_file

    known = planned.read(asked.given, True)
    patterns = asked.patterns if known is None else known.known_request.patterns
    opening.check(scene, patterns)
    with limited.job() as job, output_file(output, overwritten.overwrite) as output:
        bench = open_as(scene, opening, job)
        check_apart(output, (*bench.loaded.files, *opening.models, *filter(None, [planned.plan])))
        light = bench.light(known or patterns, job, **asked.without("patterns"))
        with job.clock.stage("write"):
            light.save(output)
    size = output.stat().st_size
    payload = {**light.summary(), "bytes": size, "seconds": job.clock.seconds(), "output": str(output)}
    payload["kernels"] = job.clock.kernels()
    shape, taken = payload["shape"], payload["seconds"]
    lines = [
        f"Light of {payload['n']}x{payload['n']} projector pixels to {shape[0]}x{shape[1]} of the sensor in "
        f"{taken['total']:.1f} s, {payload['entries']} numbers, {size / 2**20:.3g} MiB: {output}",
        f"Monte Carlo error {payload['mc_error']:.1e} of the frames of {patterns}, total error up to "
        f"{payload['total_error_bound']:.1e}",
    ]
    return finish(limited.as_json, payload, lines, payload["warnings"])


@verb
def pairs(
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="folder to make", metavar="DIR")],
    asked: PairOptions,
    frames: Annotated[
        Request,
        show(
            "patterns accuracy seed effects exposure exposure_fraction ambient_frame ambient_shots",
            exposure={"help": "seconds a frame, or auto: each pair for itself"},
        ),
    ],
    resumed: Resumed,
    opening: Opening,
    limited: Limited,
) -> int:
    """Make pairs to learn from: pictures and their frames.

    Pictures stand on a scene's print, and the camera takes frames of them.

    $ mitsim pairs photograph --count 500 -o pairs
    $ mitsim pairs photograph --count 500 --pictures photos -o mine
    """
    from mitsim.bench.request import Task
    from mitsim.core.files import PAIRS, check_output
    from mitsim.learn.requests import PairsRequest

    frames.refuse_idle()
    wanted = PairsRequest(capture=frames, **asked.given)
    wanted.check()
    check_output(output, overwrite=resumed.resume and (output / PAIRS).is_file())
    opening.check(scene, frames.patterns, frames.timing)
    advise(RESUME)
    with limited.job() as job:
        from mitsim.learn.pairs import make_pairs

        def open_drawn(drawn: Mapping[str, str]) -> mitsim.Bench:
            parameters = {**opening.parameters, **drawn}
            return open_as(scene, opening.model_copy(update={"parameters": parameters}), job)

        made, cost = make_pairs(open_drawn, wanted, Task(output, resumed.resume, job))
        payload = {**made.summary(), "predicted_seconds": cost.seconds, "predicted_bytes": cost.disk_bytes}
        payload |= {"seconds": job.clock.seconds(), "kernels": job.clock.kernels()}
    rows, columns = payload["shape"]
    lines = [
        f"{payload['count']} pairs of {payload['frames']} frames of {rows}x{columns} in "
        f"{payload['seconds']['total']:.1f} s ({cost.seconds:.3g} s predicted), "
        f"{payload['bytes'] / 2**20:.3g} MiB: {output}",
        *([f"Light is traced for each picture: {payload['traced_anew']}"] if payload["traced_anew"] else []),
    ]
    return finish(limited.as_json, payload, lines, payload["warnings"])


# ---- study and doctor ------------------------------------------------------------------------------------------------


@verb
def study(
    name: Annotated[
        str,
        typer.Argument(
            help="of the study, all or merge; of one of your own its file, or its module with a dot",
            metavar="NAME",
            autocompletion=completing(lambda: (*EXPERIMENTS, *STUDIES, ALL, "merge")),
        ),
    ],
    scenes: Annotated[
        list[str] | None,
        typer.Argument(
            help="scene XML, or the name of a shipped scene; of merge, folders",
            metavar="[SCENE]",
            autocompletion=complete_scene,
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="folder of the study", metavar="DIR", rich_help_panel=OUTPUT)
    ] = Path("study-output"),
    *,
    asked: Annotated[StudyOptions, show(patterns={"default": "dots:7"})],
    common: Common,
) -> int:
    """An experiment with figures, CSV and JSON.

    `mitsim list studies` says what each is for; all is those of the paper on one page, and merge joins the parts of
    --shard. One of your own is a file, or a module named with a dot.

    $ mitsim study patterns -o patterns --quick
    $ mitsim study sweep photograph --over sheet_z=395,400 --over accuracy=0.03
    $ mitsim study accuracy cookie_bag -o accuracy
    """
    with common.job() as job:
        result = mitsim.study(name, scenes, output, job=job, **asked.given)
    return finish(common.as_json, result.payload(), result.lines(), result.warnings)


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
