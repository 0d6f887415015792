"""`mitsim calibrate`: words of a command line in; a session's or a plan's words, or a refusal, out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mitsim.cli.colour import MOSAIC, NO, Colour, check_colour, in_colour, of_calibration, variant_for
from mitsim.cli.options import (
    DAY,
    SPELLED,
    Accuracy,
    Camera,
    Defines,
    Json,
    MaxMemory,
    MaxSeconds,
    Outside,
    Projector,
    Quiet,
    Resume,
    SceneOrFrames,
    Seed,
    Variant,
    bench_of,
    check_camera,
    check_shown,
    check_work,
    is_given,
    job_of,
    request_of,
)
from mitsim.cli.screen import finish
from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.errors import MitsimError
from mitsim.core.worker import RESUME, advise

if TYPE_CHECKING:
    from mitsim.api.bench import Bench
    from mitsim.core.job import Job
    from mitsim.devices.session import Modelling, SessionRecipe


app = typer.Typer()

PATTERNS = "dots:7"
"""Of the capture, where none are given."""
_MODELS = "geometric|wave"
"""What --model may be."""
_OF_FRAMES = {"frames", "camera", "output", "as_json", "quiet"}
"""Options of `mitsim calibrate` that go with --frames."""


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
        return calibrate_model(context, modelling, folder)
    for option, value in (("--frames-used", frames_used), ("--fit", fit), ("--model", model)):
        if value is not None:
            raise MitsimError(f"{option} {value}: is for --model without --plan; leave it out")
    if frames is not None:
        given = (name for name in context.params if is_given(context, name))
        others = sorted({*given} - _OF_FRAMES)
        return _calibrate_frames(frames, check_no_plan(None, None, output), camera, others, as_json, quiet)
    if scene is None:
        raise MitsimError("calibrate: give a scene, or --frames DIR with the frames of a real session")
    from mitsim.bench.request import Exposure
    from mitsim.core.files import check_output
    from mitsim.core.resources import memory_from_here, memory_since
    from mitsim.devices.session import load_recipe

    request = request_of(accuracy=accuracy, seed=seed)
    session = load_recipe(recipe)
    exposure = Exposure(None, session.exposure_fraction)
    if planning or write_frames is not None or colour != NO:
        session.of_one_depth()
    if write_frames is not None and resume:
        raise MitsimError("--write-frames: a resumed session shows its finished patterns no more; leave out --resume")
    if colour != NO and write_frames is not None:
        raise MitsimError(
            f"--write-frames {write_frames}: frames are kept of light that is not told apart; leave one out"
        )
    if planning:
        if write_frames is not None:
            raise MitsimError(f"--write-frames {write_frames}: --plan takes no frames; leave one of them out")
        if colour != NO:
            raise MitsimError(f"--colour {colour}: --plan is for light that is not told apart; leave one of them out")
        wanted = Wanted.of(psnr, patterns, output, resume)
        check_camera(camera, exposure)
        check_shown([wanted.patterns], scene, define, outside)
        with job_of(quiet or as_json, max_seconds, max_memory) as job:
            with job.clock.stage("open scene"):
                bench = bench_of(scene, variant, camera, projector, define, outside)
            return wanted.planned(bench, session, request, job, as_json)
    folder, traced_in = check_no_plan(psnr, patterns, output), variant_for(colour, variant, camera)
    check_work(folder, resume, "calibration", several=colour != NO or bool(session.depths))
    if write_frames is not None:
        check_output(write_frames)
    check_colour(colour, variant, projector)
    if colour != MOSAIC:
        check_camera(camera, exposure)
    advise(RESUME)
    with job_of(quiet or as_json, max_seconds, max_memory) as job:
        with job.clock.stage("open scene"):
            bench = bench_of(scene, traced_in, camera, projector, define, outside)
        held = memory_from_here()
        if colour != NO:
            seen = in_colour(bench, colour)
            by_line = seen.calibrate_mosaic if colour == MOSAIC else seen.calibrate_lines
            shown = None if recipe is None else session
            colours = by_line(**request, recipe=shown, output=folder, resume=resume, job=job)
            payload, lines = of_calibration(colours, folder)
            payload["memory_bytes"] = memory_since(held)
            return finish(as_json, payload, lines, payload["warnings"])
        whole: dict[str, Any] = {**request, "recipe": session, "output": folder, "job": job}
        if write_frames is not None:
            found = [bench.write_session(write_frames, **whole)]
        elif session.depths:
            found = [*bench.calibrate_depths(**whole, resume=resume).values()]
        else:
            found = [bench.calibrate(**whole, resume=resume)]
    taken = memory_since(held)
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
    shadow = payload["shadow_residual"]
    return [
        f"{payload['frames']} frames of {payload['n']} stripes in {payload['seconds']['total']:.1f} s: "
        f"{payload['output']}",
        f"separability residual {residual:.2%} ({clean:.1e} without noise), factor error {error:.1e}, condition "
        f"{condition:.2e}",
        *([] if shadow is None else [f"of single pixels' shadows the factors lack {shadow:.1e}"]),
        f"memory {payload['memory_bytes'] / 2**30:.2g} GiB of at most {payload['predicted_memory_bytes'] / 2**30:.2g} "
        "predicted",
    ]


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
        name = SPELLED.get(others[0], f"--{others[0].replace('_', '-')}")
        raise MitsimError(f"--frames {folder}: frames and their list decide; leave out {name}")
    from mitsim.core.resources import memory_from_here, memory_since
    from mitsim.devices.framelist import load_frames

    session = load_frames(folder)  # refused before the estimator is imported
    from mitsim.reconstruct.captured_session import calibrate_frames

    held = memory_from_here()
    with job_of(quiet or as_json) as job:
        factors = calibrate_frames(session, output, job, camera)
    payload = {
        **factors.manifest.result,
        "memory_bytes": memory_since(held),
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


@dataclass(frozen=True)
class Wanted:
    """What --plan is asked for: PSNR [dB] under patterns, and a file for the recipe; None: none is written."""

    psnr: float
    patterns: str
    output: Path | None

    @classmethod
    def of(cls, psnr: float | None, patterns: str | None, output: Path | None, resume: bool) -> Wanted:
        """Of the command line's options; refused before work.

        Parameters
        ----------
        psnr, patterns, output, resume
            as `mitsim calibrate` has them.

        Raises
        ------
        MitsimError
            for a missing PSNR, values that are not allowed, and a file that cannot be written.
        """
        from mitsim.bench.request import Request, check_psnr
        from mitsim.core.files import prepare_output

        if psnr is None:
            raise MitsimError("--plan: give the PSNR that the image is to have, such as --psnr 35")
        if resume:
            raise MitsimError("--resume: a plan writes no parts to go on with; leave it out")
        if output is not None:
            prepare_output(output, kind="file")
        asked = Request.of(patterns=patterns or PATTERNS)
        return cls(check_psnr(psnr), asked.patterns, output)

    def planned(self, bench: Bench, recipe: SessionRecipe, request: dict[str, Any], job: Job, as_json: bool) -> int:
        """Make, write and print the plan; returns the exit status.

        Parameters
        ----------
        bench, recipe, request, job
            the scene, the session's recipe, accuracy and seed, progress and limits.
        as_json
            one JSON object instead of text.
        """
        from mitsim.calibrate.plan import plan_calibration
        from mitsim.core.files import output_file, whole_file
        from mitsim.devices.session import recipe_text

        with nullcontext() if self.output is None else output_file(self.output):
            found = plan_calibration(bench, self.psnr, self.patterns, recipe, **request, job=job)
            lines = found.lines()
            if self.output is not None:
                with whole_file(self.output) as part:
                    part.write_text(recipe_text(found.recipe), encoding="utf-8")
                lines.append(f"Recipe: {self.output}")
        payload = {**found.payload(), "output": None if self.output is None else str(self.output)}
        return finish(as_json, payload, lines, found.warnings)


def check_no_plan(psnr: float | None, patterns: str | None, output: Path | None) -> Path:
    """The output of a calibration that is no plan.

    Parameters
    ----------
    psnr, patterns
        options of --plan; MitsimError where one is given.
    output
        the folder; MitsimError without one.
    """
    for name, value in (("--psnr", psnr), ("--patterns", patterns)):
        if value is not None:
            raise MitsimError(f"{name} {value}: is for --plan; a calibration serves all patterns, so leave it out")
    if output is None:
        raise MitsimError("Missing option '-o' / '--output': give the calibration folder to make")
    return output


# -------- `mitsim calibrate --model`


def modelling_of(model: str, frames_used: int | None, fit: str | None, accuracy: float) -> Modelling:
    """What `--model` is asked for; MitsimError for words that it does not know.

    Parameters
    ----------
    model, frames_used, fit, accuracy
        the options; None where not given.
    """
    from mitsim.devices.session import FITTED, Modelling

    names = FITTED if fit is None else tuple(name.strip() for name in fit.split(","))
    words: Any = model  # checked there
    return Modelling(words, **({} if frames_used is None else {"frames": frames_used}), fitted=names, accuracy=accuracy)


def calibrate_model(context: typer.Context, modelling: Modelling, output: Path) -> int:
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
    from mitsim.bench.request import Exposure
    from mitsim.core.files import check_output
    from mitsim.devices.framelist import load_frames
    from mitsim.devices.session import load_recipe

    asked = context.params
    if asked["scene"] is None:
        raise MitsimError("--model: give the scene too, which states the camera and projector as they were to be built")
    frames_alone = ("recipe", "seed", "accuracy") if asked["frames"] else ()
    for name in ("resume", "write_frames", "colour", *frames_alone):
        if is_given(context, name):
            other = " of --frames" if name in frames_alone else ""
            raise MitsimError(f"--{name.replace('_', '-')}: is of no use with --model{other}; leave it out")
    request_of(accuracy=asked["accuracy"], seed=asked["seed"])
    recipe, frames = load_recipe(asked["recipe"]), asked["frames"] and load_frames(asked["frames"])
    check_output(output)
    if frames is None:
        check_camera(asked["camera"], Exposure(None, recipe.exposure_fraction))
    bench_words = (asked[name] for name in ("scene", "variant", "camera", "projector", "define", "outside"))
    with job_of(asked["quiet"] or asked["as_json"], asked["max_seconds"], asked["max_memory"]) as job:
        with job.clock.stage("open scene"):
            bench = bench_of(*bench_words)
        from mitsim.calibrate.model import calibrate_model as fit_model

        factors = fit_model(bench, modelling, frames, recipe, asked["seed"], output, job)
    result = factors.manifest.result
    return finish(asked["as_json"], {**result, "output": str(output)}, model_lines(result, output), factors.warnings)


def model_lines(result: Mapping[str, Any], output: Path) -> list[str]:
    """What people read of a fit's ``result``, in the folder ``output``."""
    numbers = [
        f"{name.replace('_', ' ')} {number['value']:.6g} +-{number['standard_error']:.2g} {number['unit']}"
        for name, number in result["parameters"].items()
        if number["standard_error"] is not None
    ]
    return [
        f"{result['model']} model fitted to {result['frames']} frames in {result['seconds']['total']:.1f} s: {output}",
        *numbers,
        f"unexplained {result['unexplained_residual']:.2%}, chi-square {result['chi_square']:.3g} a datum, condition "
        f"{result['condition']:.2e}",
    ]
