"""Verbs that open a scene with its devices: demo, run, view, plan, capture, render, transport, pairs and study."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import mitsim
from mitsim.bench.request import (
    AUTO,
    NO,
    AnyColour,
    LitScene,
    Opening,
    Planned,
    Request,
    Task,
    Variant,
    by_line,
    check_samples,
    check_view,
)
from mitsim.cli.commands import (
    Common,
    KnownPlan,
    Limited,
    LimitedPictured,
    OfScene,
    Overwritten,
    Replaced,
    Replacing,
    Resumed,
    argument,
    command,
    scene_named,
    shown,
    to_make,
    wrap_text,
)
from mitsim.core.colour_files import MONO, RUN, read_colours
from mitsim.core.configuration import OUTPUT, QUALITY, WHAT, option, value_of
from mitsim.core.errors import MitsimError
from mitsim.core.files import PAIRS, check_apart, check_output, output_file
from mitsim.core.headline import each_once, frames_headline
from mitsim.core.job import compiled_kernels, memory_from_here, memory_since, running_seconds
from mitsim.core.manifests import MANIFEST, resumable
from mitsim.core.worker import RESUME, advise
from mitsim.devices.patterns import pattern_names, short_name
from mitsim.learn.requests import PairOptions, PairsRequest
from mitsim.studies import ALL, EXPERIMENTS
from mitsim.verbs import DemoRequest, DesignOptions, Predicted, RunOptions, StudyOptions, capture_in, open_as, plan_in

if TYPE_CHECKING:
    from mitsim.light.plan import Plan, PlanRow

# ---- demo, run, view, study and doctor -------------------------------------------------------------------------------


class Showing(DemoRequest, Replacing, Common):
    """Options of `mitsim demo`."""

    FIRST = "scene output patterns"

    scene: str = scene_named("photograph")
    output: Path = to_make(Path("demo-output"), "folder to make; an earlier demo there is replaced", "DIR")


@command
def demo(asked: Showing) -> int:
    """Plan, capture, calibrate and reconstruct one scene.

    The page report.html compares the images of five pattern families.

    $ mitsim demo
    $ mitsim demo cookie_bag -o bag --accuracy 0.01
    """
    return asked.call(mitsim.demo, asked.scene, asked.output, **asked.given_of(DemoRequest))


class Running(RunOptions, Replaced, Variant, LimitedPictured):
    """Options of `mitsim run`."""

    PANEL = WHAT
    MARKS = ("session",)

    session: str | None = argument(None, "session file, or the name of a shipped session", "SESSION.toml")
    output: Path | None = to_make(
        None, "folder to make; with --from, session file to write", "FOLDER", show_default="session-output"
    )
    values: list[str] | None = option(
        None, "set a field of the session file; repeatable", "-D", metavar="TABLE.FIELD=VALUE", kind=list[str]
    )
    repeated: Path | None = option(None, "write the session file that repeats this folder", "--from", metavar="FOLDER")

    @property
    def places(self) -> list[Path]:
        return [self.output or Path("session-output")]


@command
def run_(asked: Running) -> int:
    """Run all steps of a session file, or write one from a folder.

    Each step, such as capture, has its own folder inside the output folder.

    $ mitsim run demo -o out
    $ mitsim run fig1.toml -o out -D capture.patterns=dots:5
    $ mitsim run --from out/image -o figure.toml
    """
    if asked.repeated is not None:
        folder = asked.repeated
        if asked.session is not None:
            raise MitsimError(f"--from {folder}: writes a session file, and {asked.session} is one; give one of both")
        others = "values", "resume", "no_pictures", "variant", "max_seconds", "max_memory"
        asked.refuse(others, "with --from, which runs nothing")
        if asked.output is not None:
            check_output(asked.output, asked.overwrite, "file")
        found = mitsim.session_of(folder)
        written = None if asked.output is None else str(found.save(asked.output))
        payload = {"session": found.text, "output": written, "needs": found.needs, "warnings": found.warnings}
        needs = [f"Needs also: {', '.join(found.needs)}"] if found.needs else []
        lines = [found.text.rstrip()] if written is None else [f"Session file: {written}", *needs]
        return asked.finish(payload, lines, found.warnings)
    if asked.session is None:
        raise MitsimError("run: give a session file, or --from FOLDER to write one")
    texts = {}
    for text in asked.values or ():
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise MitsimError(f"-D {text!r}: give TABLE.FIELD=VALUE")
        texts[name] = value
    if "variant" in asked.given:
        texts["scene.variant"] = asked.variant
    values = {name: value_of(text) for name, text in texts.items()}
    advise(RESUME)
    options = {**asked.given_of(RunOptions), "pictures": not asked.no_pictures}
    return asked.call(mitsim.run, asked.session, asked.output or "session-output", values, **options)


class Viewing(OfScene, Opening, Replacing, Common):
    """Options of `mitsim view`."""

    output: Path = to_make(Path("view.png"), "picture or interactive page; replaces an old file", "FILE.png|FILE.html")


@command
def view(asked: Viewing) -> int:
    """Draw the bench to scale, without simulating light.

    The drawing shows distances, the depths of the lit surfaces, and the camera's view.

    $ mitsim view cookie_bag
    $ mitsim view photograph -D sheet_z=420 -o bench.html
    """
    check_output(check_view(asked.output), overwrite=True, kind="file")
    asked.check(asked.scene)
    with output_file(asked.output, overwrite=True) as place, asked.job() as job:
        bench = open_as(asked.scene, asked, job)
        check_apart(place, (*bench.loaded.files, *asked.models))
        with job.clock.stage("view"):
            seen = bench.view()
        with job.clock.stage("draw"):
            payload = {**seen.summary(), "output": str(seen.save(place))}
    return asked.finish(payload, [*seen.lines(), f"Drawn: {payload['output']}"], seen.warnings)


class Studying(StudyOptions, Replacing, Common):
    """Options of `mitsim study`."""

    CHANGES = shown(patterns={"default": "dots:7"})

    name: str = argument(
        ...,
        "study from `mitsim list studies`; all: those of the paper; merge: join the parts of --shard; or path or "
        "dotted module name of your own study",
        "NAME",
        complete=lambda: (*EXPERIMENTS, ALL, "merge"),
    )
    scenes: list[str] | None = scene_named(
        None, "scene XML file, or the name of a shipped scene; for merge, the folders of the parts", kind=list[str]
    )
    output: Path = to_make(Path("study-output"), "folder to make; an earlier run there is continued or replaced", "DIR")


@command
def study(asked: Studying) -> int:
    """Run an experiment, and write its figures, CSV and JSON.

    `mitsim list studies` shows the question of each study.

    $ mitsim study patterns -o patterns --quick
    $ mitsim study sweep photograph --over sheet_z=395,400 --over accuracy=0.03
    $ mitsim study accuracy cookie_bag -o accuracy
    """
    return asked.call(mitsim.study, asked.name, asked.scenes, asked.output, **asked.given_of(StudyOptions))


class Designing(DesignOptions, Common):
    """Options of `mitsim design`."""

    goal: Path = argument(..., "goal file, as `mitsim new goal NAME` writes one", "GOAL.toml")
    output: Path = to_make(Path("design-output"), "folder to make for camera files, page and design.json", "DIR")


@command
def design(asked: Designing) -> int:
    """Search the mask with the least error, and prove it by images.

    Its camera and those of the best simple masks (random, pinholes, maximum length sequence) are captured, calibrated
    and reconstructed. `mitsim design predict` is `mitsim predict`.

    $ mitsim new goal mine
    $ mitsim design mine.toml -o design
    $ mitsim capture photograph --camera design/design/camera.toml -o run
    """
    return asked.call(mitsim.design, asked.goal, asked.output, **asked.given_of(DesignOptions))


class Checking(Variant, Common):
    """Options of `mitsim doctor`."""


@command
def doctor(asked: Checking) -> int:
    """Check the installation, and name a command for each fault.

    $ mitsim doctor
    $ mitsim doctor --variant llvm_ad_spectral
    """
    checks = mitsim.doctor(asked.variant)
    bad = [f"{check.name}: {check.detail}" for check in checks if not check.ok]
    lines = [f"{sum(check.ok for check in checks)} of {len(checks)} checks pass"]
    for check in checks:
        remedy = f"\n     correct it with: {check.remedy}" if check.remedy and not check.ok else ""
        lines.append(f"{'ok  ' if check.ok else 'FAIL'} {check.name}: {check.detail}{remedy}")
    if not (bad or asked.verbose):
        lines = [f"All {len(checks)} checks pass (--verbose lists them)"]
    return asked.finish({"checks": [asdict(check) for check in checks], "ok": not bad}, lines, bad)


# ---- plan ------------------------------------------------------------------------------------------------------------


class Planning(OfScene, Planned, AnyColour, Opening, Overwritten, Common):
    """Options of `mitsim plan`."""

    FIRST = "scene patterns colour"

    output: Path | None = to_make(None, "file to write the plan to, for `mitsim capture --plan`", "FILE.json")
    everything: bool = option(False, "list all effects, with their reasons", "--all", panel=OUTPUT)


@command
def plan(asked: Planning) -> int:
    """Choose which effects to simulate, and predict the cost.

    Short simulations of the scene find the cheapest combination of effects whose error is within the accuracy.

    $ mitsim plan cookie_bag
    $ mitsim plan photograph --accuracy 1e-4 -D sheet_z=380
    $ mitsim plan cookie_bag -o plan.json
    """
    output = asked.output
    asked.check(asked.scene, asked.patterns, None, asked.colour)
    with nullcontext() if output is None else output_file(output, asked.overwrite) as place, asked.job() as job:
        bench = open_as(asked.scene, asked, job, asked.colour)
        if place is not None:
            check_apart(place, (*bench.loaded.files, *asked.models))
        from mitsim.light.cost_model import first_shadow

        starting = running_seconds()
        with job.planning(asked.patterns, first_shadow(bench, asked.effects)):
            found = plan_in(bench, asked.colour, asked.part(Planned)).taking(start=starting)
        if place is not None:
            found.save(place)
    written = {} if output is None else {"output": str(output)}
    kernels = compiled_kernels()
    lines = [] if asked.as_json else plan_lines(found, asked.everything or asked.verbose)
    lines += [*(f"Plan: {text}" for text in written.values()), *_kernel_lines(kernels)]
    return asked.finish({**found.payload(), **written, "kernels": kernels}, lines, found.warnings)


_WORTH_NAMING = 1e-2
"""Part of the accuracy from which on what is left out is named: two decades, so a hundred may add up to it."""


def plan_lines(plan: Plan, everything: bool = False) -> list[str]:
    """Return the lines that the terminal shows of a ``plan``: its result, then its effects by their size.

    An effect that is left out is shown if its error is unknown or within two decades of the accuracy; ``everything``
    shows all effects.
    """
    columns = "{:16} {:>12} {:>7}  {}"
    indent = " " * len(columns.format(*[""] * 4))

    def table(heading: str, words: str, rows: Sequence[PlanRow]) -> list[str]:
        lines = [columns.format(heading, "error if off", "seconds", words)] if rows else []
        for row in rows:
            error = "-" if row.error_if_off is None else f"{row.error_if_off:.1e}" if row.error_if_off else "0"
            lines += wrap_text(columns.format(row.name, error, f"{row.seconds:.2f}", row.reason or row.state), indent)
        return lines

    most = math.hypot(plan.systematic_bound, plan.sampling_target)
    stages = ", ".join(f"{name} {seconds:.3g}" for name, seconds in plan.predicted.items())
    small = 0.0 if everything else plan.accuracy * _WORTH_NAMING
    rows = sorted(plan.effects, key=lambda row: -(row.error_if_off or 0.0))
    left_out = [row for row in rows if row.state == "off" and (row.error_if_off is None or row.error_if_off >= small)]
    silent = sum(row.state == "off" for row in rows) - len(left_out)
    lines = [
        f"Plan at accuracy {plan.accuracy:g}: {plan.predicted_seconds:.3g} s, error up to {most:.1e}",
        *table("on", "how", [row for row in rows if row.state != "off"]),
        *table("left out", "why", left_out),
        *([f"{silent} more effects that this scene does not need (--all lists them)"] if silent else []),
        f"Seconds: {stages}",
        *plan.notes,
    ]
    if plan.asked_seconds is not None:
        lines.append(f"Accuracy {plan.accuracy:g} is the best that is reachable within {plan.asked_seconds:g} s")
    if plan.cost:
        memory, disk = plan.cost.memory_bytes / 2**30, plan.cost.disk_bytes / 2**20
        lines.append(f"At most {memory:.2g} GiB of memory, {disk:.3g} MiB of disk")
    return lines


class Predicting(OfScene, Predicted, Common):
    """Options of `mitsim predict`."""

    FIRST = "scene patterns"


@command
def predict(asked: Predicting) -> int:
    """Predict the PSNR of an image by cause, without frames.

    A short trace of the scene's light and closed forms take seconds. Causes that the prediction lacks are named.

    $ mitsim predict photograph --patterns dots:7
    $ mitsim predict photograph --exposure-total 1 --recipe session.toml
    $ mitsim predict photograph --prior 0.4,0.03,8 --json
    """
    return asked.call(mitsim.predict, asked.scene, **asked.given_of(Predicted))


# ---- capture ---------------------------------------------------------------------------------------------------------


class Capturing(OfScene, Request, KnownPlan, Resumed, Replaced, AnyColour, Opening, LimitedPictured):
    """Options of `mitsim capture`."""

    FIRST = "scene patterns exposure exposure_fraction ambient_frame"
    CHANGES = shown(patterns={"default": None, "help": f"{pattern_names()}; required unless --plan is given"})

    output: Path = to_make(..., "run folder to make", "RUN")


@command
def capture(asked: Capturing) -> int:
    """Simulate the frames of a scene, one for each pattern.

    With --colour lines there is one frame for each pattern and spectral line of the projector.

    $ mitsim capture photograph -o run --patterns dots:7
    $ mitsim capture cookie_bag -o bag --patterns hadamard:8 --seconds 20
    $ mitsim capture photograph -o again --plan plan.json
    """
    asked.refuse_idle()
    given, colour, output = asked.given_of(Request), asked.colour, asked.output
    if asked.plan is None and "patterns" not in given:
        raise MitsimError("Missing option '--patterns': give it, or a plan with --plan")
    known = asked.read(given, colour != NO)
    request = asked.part(Request) if known is None else known.request_with(given)
    if known is not None and colour == AUTO:
        chosen = (known.colour or {}).get("chosen", MONO)
        colour = NO if chosen == MONO else chosen
    begun_in_one = (output / MANIFEST).is_file()  # which auto may decide for
    check_work(output, asked.resume, "capture", several=by_line(colour) or (colour == AUTO and not begun_in_one))
    asked.check(asked.scene, request.patterns, request.timing, colour)
    advise(RESUME)
    with asked.job() as job:
        bench = open_as(asked.scene, asked, job, colour)
        held = memory_from_here()
        own = given if known and colour == NO else {name: each for name, each in given.items() if name != "patterns"}
        found = capture_in(bench, colour, known or request.patterns, own, Task(output, asked.resume, job))
        if isinstance(found, Mapping):
            payload = payload_of_lines(RUN, {name: run.summary() for name, run in found.items()}, output)
        else:
            payload = found.summary()
    runs = payload["channels"] if payload.get("kind") == RUN else [payload]  # filters have every line in each frame
    payload["headline"] = frames_headline(runs, payload["warnings"])
    payload["memory_bytes"] = memory_since(held)
    return asked.finish_folder(output, payload, _capture_lines(payload, asked))


def check_work(output: Path, resume: bool, kind: str, several: bool = False) -> None:
    """Refuse, before the renderer is imported, a RUN or CAL folder that cannot be written.

    Parameters
    ----------
    output, resume
        Folder, and whether work in it is to go on.
    kind
        "capture" or "calibration".
    several
        Whether the folder is to hold several such folders.
    """
    begun = (output / MANIFEST).is_file()
    if resume and begun and not several:
        resumable(output, kind)
    check_output(output, overwrite=resume and begun != several)


def payload_of_lines(kind: str, results: Mapping[str, Mapping[str, Any]], output: Path) -> dict[str, Any]:
    """Return the JSON of a coloured run or calibration in the folder ``output``, by that of each line."""
    colours = read_colours(output, kind)
    return {
        "kind": colours.kind,
        "channels": [{**line.model_dump(), **results[line.name]} for line in colours.channels],
        **{name: results[colours.names[-1]].get(name) for name in ("seconds", "kernels")},
        "warnings": each_once({name: result["warnings"] for name, result in results.items()}),
        "output": str(output),
    }


def memory_line(payload: Mapping[str, Any]) -> str:
    """Return the line on the memory that a capture or calibration used."""
    taken = f"Memory {payload['memory_bytes'] / 2**30:.2g} GiB"
    most = payload.get("predicted_memory_bytes")  # of real frames nothing is predicted
    return taken if most is None else f"{taken} of at most {most / 2**30:.2g} predicted"


def _kernel_lines(kernels: Mapping[str, float]) -> list[str]:
    if not kernels["number"]:
        return []
    return [(f"{kernels['number']} kernels were compiled in {kernels['seconds']:.1f} s of this time, and are kept")]


def _capture_lines(payload: Mapping[str, Any], common: Common) -> list[str]:
    taken = payload["seconds"]
    lines = [f"Run: {payload['output']} (in {taken['total']:.1f} s)"]
    if payload.get("kind") == RUN:
        for part in payload["channels"]:
            lines.append(
                f"{part['name']}: Monte Carlo error {part['mc_error']:.1e}, total error up to "
                f"{part['total_error_bound']:.1e}, exposure {part['exposure_s']:.3g} s a frame"
            )
    else:
        stages = ", ".join(f"{name} {seconds:.2f}" for name, seconds in taken.items() if name != "total")
        lines += [
            *([f"Frames are behind {payload['mosaic']} filters"] if "mosaic" in payload else []),
            f"Monte Carlo error {payload['mc_error']:.1e}, {payload['mc_to_sensor_noise']:.0%} of the sensor's noise"
            f"{', so that it limits the image' * (payload['mc_to_sensor_noise'] > 1)}; "
            f"exposure {payload['exposure_s']:.3g} s a frame",
            *common.details(f"Accuracy {payload['accuracy']:g}", f"Seconds: {stages}", memory_line(payload)),
        ]
    lines += _kernel_lines(payload["kernels"])
    if ambient := payload.get("ambient_frame"):
        lines.append(
            f"Ambient frame: the mean of {ambient['shots']} shots with the projector off, to be subtracted; "
            f"{ambient['part']:.1%} of the frames' light is ambient, noise {ambient['noise']:.2g} of the projector's, "
            f"total error up to {payload['total_error_of_projector']:.1e} of it"
        )
    return lines


# ---- render, transport and pairs -------------------------------------------------------------------------------------


class Rendering(OfScene, Planned, LitScene, Replacing, LimitedPictured):
    """Options of `mitsim render`."""

    FIRST, HIDDEN = "scene output estimator spp", "patterns seconds"

    output: Path = to_make(..., "frame to write; an existing file is replaced", "FRAME.exr")
    estimator: str = option("reference", "reference (path by path), or factored", metavar="NAME", panel=QUALITY)
    spp: int | None = option(
        None, "samples for each pixel of the reference", show_default="the scene's sample_count, or 64", panel=QUALITY
    )


_OF_OTHER = {"reference": ("accuracy", "effects"), "factored": ("spp",)}
"""Options of `mitsim render` without effect on an estimator: a note says so, because programs give all of them."""


@command
def render(asked: Rendering) -> int:
    """Render the irradiance on the sensor with the scene's lights.

    The reference estimator traces single paths through the mask, without diffraction. The factored estimator is the one
    that all other verbs use.

    $ mitsim render photograph -o frame.exr --spp 16
    $ mitsim render photograph -o fast.exr --estimator factored
    """
    output, method = asked.output, cast(Literal["reference", "factored"], asked.estimator)  # which is checked below
    if output.suffix.lower() != ".exr":
        raise MitsimError(f"--output {output}: the frame is an OpenEXR file; give a name that ends in .exr")
    check_samples(method, asked.spp)
    ignored = [f"--{name} has no effect on the {method}" for name in _OF_OTHER[method] if name in asked.given]
    check_output(output, overwrite=True, kind="file")
    with asked.job() as job:
        bench = mitsim.open_bench(
            asked.scene, asked.variant, None, asked.projector, asked.allow_outside_files, True, **asked.parameters
        )
        check_apart(output, bench.loaded.files)
        with output_file(output, overwrite=True) as place:
            light = {"accuracy": asked.accuracy, "seed": asked.seed, "effects": asked.effects}
            frame = bench.render(method, asked.spp, job=job, **light)
            payload = {**frame.summary(), "output": str(frame.save(place))}
    payload["notes"] = [*payload["notes"], *ignored]
    bound = payload["mc_error_bound"]
    most = "" if bound is None else f" (below {bound:.1e} at 95 %)"
    lines = [
        f"{method}: mean irradiance {payload['mean']:.4e} W/m^2, relative noise {payload['mc_error']:.1e}{most}, "
        f"{payload['seconds']:.2f} s: {payload['output']}",
        *payload["notes"],
    ]
    mean = frame.mean[..., 0] if frame.mean.shape[2] == 1 else frame.mean
    return asked.finish_frame((output, mean, "W/m^2"), payload, lines)


class Tracing(OfScene, Planned, KnownPlan, Overwritten, Opening, Limited):
    """Options of `mitsim transport`."""

    FIRST = "scene output patterns"

    output: Path = to_make(..., "HDF5 file to make", "FILE.h5")


@command
def transport(asked: Tracing) -> int:
    """Trace a scene's light once, to compute frames of any pattern.

    The HDF5 file holds the light of each projector pixel, for programs that do not use mitsim.

    $ mitsim transport photograph -o light.h5
    """
    given = asked.given_of(Planned)
    known = asked.read(given, True)
    patterns = asked.patterns if known is None else known.known_request.patterns
    asked.check(asked.scene, patterns)
    with asked.job() as job, output_file(asked.output, asked.overwrite) as output:
        bench = open_as(asked.scene, asked, job)
        check_apart(output, (*bench.loaded.files, *asked.models, *filter(None, [asked.plan])))
        light = bench.light(known or patterns, job=job, **{name: given[name] for name in given if name != "patterns"})
        with job.clock.stage("write"):
            light.save(output)
    size = output.stat().st_size
    payload = {**light.summary(), "bytes": size, "seconds": job.clock.seconds(), "output": str(output)}
    payload["kernels"] = job.clock.kernels()
    shape, taken = payload["shape"], payload["seconds"]
    lines = [
        f"Light of {payload['n']}x{payload['n']} projector pixels to {shape[0]}x{shape[1]} of the sensor in "
        f"{taken['total']:.1f} s, {payload['entries']} numbers, {size / 2**20:.3g} MiB: {output}",
        f"Monte Carlo error {payload['mc_error']:.1e} of the frames of {short_name(patterns)}, total error up to "
        f"{payload['total_error_bound']:.1e}",
    ]
    return asked.finish(payload, lines, payload["warnings"])


class Pairing(OfScene, PairOptions, Request, Resumed, Replaced, Opening, Limited):
    """Options of `mitsim pairs`."""

    FIRST, HIDDEN, MARKS = "scene output count", "seconds", (PAIRS,)
    CHANGES = shown(exposure={"help": "exposure time of each frame [s]; auto: chosen for each pair"})

    output: Path = to_make(..., "folder to make for the pairs", "DIR")


@command
def pairs(asked: Pairing) -> int:
    """Make training pairs: pictures, and the frames recorded of them.

    Each picture replaces the print of the scene, and the camera records its frames.

    $ mitsim pairs photograph --count 500 -o pairs
    $ mitsim pairs photograph --count 500 --pictures photos -o mine
    """
    asked.refuse_idle()
    output = asked.output
    wanted = PairsRequest(capture=asked.part(Request), **asked.given_of(PairOptions))
    check_output(output, overwrite=asked.resume and (output / PAIRS).is_file())
    asked.check(asked.scene, asked.patterns, asked.timing)
    advise(RESUME)
    with asked.job() as job:
        from mitsim.learn.pairs import make_pairs

        made, cost = make_pairs(open_as(asked.scene, asked, job), wanted, Task(output, asked.resume, job))
        payload = {**made.summary(), "predicted_seconds": cost.seconds, "predicted_bytes": cost.disk_bytes}
        payload |= {"seconds": job.clock.seconds(), "kernels": job.clock.kernels()}
    rows, columns = payload["shape"]
    lines = [
        f"{payload['count']} pairs of {payload['frames']} frames of {rows}x{columns} in "
        f"{payload['seconds']['total']:.1f} s ({cost.seconds:.3g} s predicted), "
        f"{payload['bytes'] / 2**20:.3g} MiB: {output}"
    ]
    return asked.finish(payload, lines, payload["warnings"])
