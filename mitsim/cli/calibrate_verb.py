"""The verb `mitsim calibrate` computes factors.

They come from a simulated session, real frames, known pictures or a fitted model. `--plan-session` only plans a
session.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsim.bench.request import NO, Coloured, Exposure, Opening, Request, SessionRequest, Task, check_psnr
from mitsim.cli.bench_verbs import check_work, memory_line, payload_of_lines
from mitsim.cli.commands import LimitedPictured, Replaced, Resumed, command, option_name, scene_named, to_make
from mitsim.core.colour_files import CALIBRATION, is_coloured
from mitsim.core.configuration import OUTPUT, WHAT, option
from mitsim.core.errors import MitsimError
from mitsim.core.files import check_output, output_file, prepare_output, write_text
from mitsim.core.headline import calibration_headline, each_once
from mitsim.core.job import memory_from_here, memory_since
from mitsim.core.worker import RESUME, advise
from mitsim.devices.framelist import load_frames, load_known
from mitsim.devices.session import FITTED, Modelling, load_recipe, recipe_text
from mitsim.verbs import calibrate_in, open_as

if TYPE_CHECKING:
    from mitsim.reconstruct.factors import Factors


class Calibrating(SessionRequest, Coloured, Opening, LimitedPictured, Resumed, Replaced):
    """Options of `mitsim calibrate`."""

    PANEL = WHAT
    MARKS = "calibration", CALIBRATION

    scene: str | None = scene_named(None, "scene XML file, or the name of a shipped scene")
    output: Path | None = to_make(None, "folder to make; with --plan-session, recipe file to write", "CAL")
    frames: Path | None = option(None, "folder with the frames of a real session", metavar="DIR")
    known: Path | None = option(None, "list of real captures of known pictures", metavar="LIST.toml")
    write_frames: Path | None = option(
        None, "also write the simulated frames to this folder, which --frames reads", metavar="DIR", panel=OUTPUT
    )
    planning: bool = option(False, "calibrate nothing; find the light that --psnr needs", "--plan-session", "--plan")
    psnr: float | None = option(None, "with --plan-session: PSNR that the image is to reach [dB]", metavar="DB")
    patterns: str | None = option(None, "patterns for --plan-session", show_default="dots:7", metavar="PATTERNS")
    model: str | None = option(
        None, "compute the factors from a device model that is fitted to a few frames", metavar="geometric|wave"
    )
    frames_used: int | None = option(None, "with --model: limit of the frames to fit", show_default="16", metavar="K")
    fit: str | None = option(
        None, "with --model: quantities to fit", show_default="mask, magnification, gain", metavar="NAME,..."
    )


def _finish(found: Mapping[str, Factors], folder: Path, asked: Calibrating, memory: float) -> int:
    """Print calibrations by the name of their folder in ``folder``, or one without a name; return the exit status."""
    results = {
        name: {**each.manifest.result, "memory_bytes": memory, "warnings": each.warnings, "output": str(folder / name)}
        for name, each in found.items()
    }
    lines = list[str]()
    for name, result in results.items():
        # JSON has null for infinite numbers.
        names = "separability_residual", "noise_free_residual", "phi_error", "predicted_phi_error", "condition"
        numbers = (result.get(name) for name in names)
        residual, clean, error, predicted, condition = (math.inf if each is None else each for each in numbers)
        simulated, divisor = "shadow_residual" in result, result.get("divided_by", 1)
        lines += [
            f"Calibration: {result['output']} ({result['frames']} frames in {result['seconds']['total']:.1f} s)",
            *([f"Factor error {error if simulated else predicted:.1e}"] if name else []),
            f"Separability residual {residual:.2%}"
            + (f" ({clean:.1e} without noise)" if simulated else "; the factor error is predicted from the noise"),
            *asked.details(f"Condition {condition:.2e}", memory_line(result)),
            *([] if divisor == 1 else [f"Numbers are divided by {divisor}, their common factor"]),
            *(f"Not known: {text}" for text in result.get("not_known", ())),
        ]
    warnings = each_once({name: each.warnings for name, each in found.items()})
    payload = results[""] if [*results] == [""] else {"depths": [*results.values()], "output": str(folder)}
    if is_coloured(folder):
        payload = {**payload_of_lines(CALIBRATION, results, folder), "memory_bytes": memory}
    payload = {**payload, "headline": calibration_headline([*results.values()], warnings), "warnings": warnings}
    return asked.finish_folder(folder, payload, lines)


def _simulated(asked: Calibrating, folder: Path) -> int:
    recipe, colour, kept = asked.recipe or load_recipe(), asked.colour, asked.write_frames
    if kept is not None or colour != NO:
        recipe.of_one_depth()
    if kept is not None and (asked.resume or colour != NO):
        other = "--resume" if asked.resume else "--colour"
        raise MitsimError(f"--write-frames {kept}: frames are those of a whole session in one light; leave out {other}")
    check_work(folder, asked.resume, "calibration", several=colour != NO or bool(recipe.depths))
    if kept is not None:
        check_output(kept)
    asked.check(str(asked.scene), None, Exposure(None, recipe.exposure_fraction), colour)
    advise(RESUME)
    session = asked.part(SessionRequest)
    with asked.job() as job:
        bench = open_as(str(asked.scene), asked, job, colour)
        held = memory_from_here()
        if kept is not None:
            found: Mapping[str, Factors] = {"": bench.write_session(kept, folder, job=job, **session.given)}
        else:
            found = calibrate_in(bench, colour, session, Task(folder, asked.resume, job))
    return _finish(found, folder, asked, memory_since(held))


def _frames(asked: Calibrating, folder: Path) -> int:
    session = load_frames(Path(str(asked.frames)))  # refused before the estimator is imported
    from mitsim.reconstruct.captured_session import calibrate_frames, calibrate_planes

    held = memory_from_here()
    with asked.job() as job:
        if session.planes != ("",):
            found: Mapping[str, Factors] = calibrate_planes(session, folder, job, asked.camera)
        else:
            found = {"": calibrate_frames(session, folder, job, asked.camera)}
    return _finish(found, folder, asked, memory_since(held))


def _known(asked: Calibrating, folder: Path) -> int:
    captures = load_known(Path(str(asked.known)))  # refused before the fit is imported
    check_output(folder)
    from mitsim.reconstruct.known_pictures import calibrate_known

    held = memory_from_here()
    with asked.job() as job:
        found = calibrate_known(captures, folder, job)
    results = {
        name: {**each.manifest.result, "warnings": each.warnings, "output": str(folder / name)}
        for name, each in found.items()
    }
    warnings = each_once({name: each["warnings"] for name, each in results.items()})
    first = next(iter(results.values()))
    payload = {"headline": calibration_headline([*results.values()], warnings), **first, "output": str(folder)}
    payload |= {"memory_bytes": memory_since(held), "warnings": warnings}
    if captures.lines is not None:
        payload["planes"] = results
    rows, columns = first["scale"]
    lines = [
        f"Calibration: {folder} ({first['frames']} frames of {first['pictures']} pictures in "
        f"{first['seconds']['total']:.1f} s)",
        f"Pictures lie {first['orientation']}, a scene pixel shifts the shadow by {rows:.4g} rows and {columns:.4g} "
        "columns of pixels",
    ]
    for name, each in results.items():
        lines.append(
            f"{name or 'Frames'}: {each['terms']} codes a side explain {each['explained']:.1%}, left over beyond noise "
            f"{each['unexplained_residual']:.2%}, factor error {each['predicted_frame_error']:.1e} in such frames"
        )
    return asked.finish_folder(folder, payload, lines)


def _plan(asked: Calibrating, _: Path) -> int:
    if asked.scene is None or asked.psnr is None:
        raise MitsimError("--plan-session: give a scene, and the PSNR that the image is to reach, such as --psnr 35")
    recipe, output = asked.recipe or load_recipe(), asked.output
    recipe.of_one_depth()
    if output is not None:
        prepare_output(output, asked.overwrite, "file")
    patterns, psnr = Request(patterns=asked.patterns or "dots:7").patterns, check_psnr(asked.psnr)
    asked.check(asked.scene, patterns, Exposure(None, recipe.exposure_fraction))
    with asked.job() as job:
        bench = open_as(asked.scene, asked, job)
        from mitsim.design.session_plan import plan_calibration

        with nullcontext() if output is None else output_file(output, asked.overwrite):
            light = {"seed": asked.seed, "accuracy": asked.accuracy}
            found = plan_calibration(bench, psnr, patterns, recipe=recipe, job=job, **light)
            lines = found.lines()
            if output is not None:
                write_text(output, recipe_text(found.recipe))
                lines.append(f"Recipe: {output}")
    return asked.finish({**found.payload(), "output": None if output is None else str(output)}, lines, found.warnings)


def _fit(asked: Calibrating, folder: Path) -> int:
    fitted = FITTED if asked.fit is None else tuple(name.strip() for name in asked.fit.split(","))
    count = {} if asked.frames_used is None else {"frames": asked.frames_used}
    model: Any = asked.model  # checked there
    modelling = Modelling(model, **count, fitted=fitted, accuracy=asked.accuracy)
    if asked.scene is None:
        raise MitsimError("--model: give the scene too, which states the camera and projector as they were to be built")
    recipe, frames = asked.recipe or load_recipe(), asked.frames and load_frames(asked.frames)
    check_output(folder)
    if frames is None:
        asked.check(asked.scene, None, Exposure(None, recipe.exposure_fraction))
    with asked.job() as job:
        bench = open_as(asked.scene, asked, job)
        from mitsim.calibrate.model import calibrate_model

        factors = calibrate_model(bench, modelling, frames, folder, recipe=recipe, seed=asked.seed, job=job)
    result = factors.manifest.result
    numbers = [
        f"{name.replace('_', ' ')} {number['value']:.6g} +-{number['standard_error']:.2g} {number['unit']}"
        for name, number in result["parameters"].items()
        if number["standard_error"] is not None
    ]
    result["headline"] = calibration_headline([result], factors.warnings)
    lines = [
        f"Calibration: {folder} ({result['model']} model fitted to {result['frames']} frames in "
        f"{result['seconds']['total']:.1f} s)",
        *numbers,
        f"Unexplained {result['unexplained_residual']:.2%}, chi-square {result['chi_square']:.3g} a datum, condition "
        f"{result['condition']:.2e}",
    ]
    return asked.finish_folder(folder, {**result, "output": str(folder)}, lines)


_OPENING = " ".join((*Opening.model_fields, "max_seconds", "max_memory"))
_MODES = {
    "known": (_known, "known"),
    "planning": (_plan, f"scene planning psnr patterns recipe seed accuracy {_OPENING}"),
    "model": (_fit, f"scene model frames frames_used fit recipe seed accuracy {_OPENING}"),
    "frames": (_frames, "frames camera"),
    "scene": (_simulated, f"scene recipe seed accuracy colour write_frames resume {_OPENING}"),
}
"""Function and options of each kind of calibration, beside those of the output; the first kind that is given counts."""


@command
def calibrate(asked: Calibrating) -> int:
    """Estimate the calibration factors of a simulated or real camera.

    There are five ways:

    simulate a session     mitsim calibrate SCENE -o CAL
    real session's frames  mitsim calibrate --frames DIR -o CAL --camera NAME
    known pictures         mitsim calibrate --known LIST.toml -o CAL
    fit a device model     mitsim calibrate SCENE --model wave -o CAL
    only plan a session    mitsim calibrate SCENE --plan-session --psnr 35

    A session records stripe patterns on a white board. --model fits simulated frames, or those of --frames.

    $ mitsim calibrate photograph -o cal
    $ mitsim calibrate photograph -o few --model wave
    $ mitsim calibrate --frames session -o cal --camera imx249
    """
    mode = next((name for name in _MODES if getattr(asked, name)), None)
    if mode is None:
        raise MitsimError(
            "calibrate: give a scene, --frames DIR with the frames of a real session, or --known LIST of known pictures"
        )
    calibrated, words = _MODES[mode]
    allowed = {*words.split()}
    if mode == "model" and asked.frames:
        allowed -= {"recipe", "seed", "accuracy"}
    if others := sorted(
        {*asked.given} - allowed - {"output", "overwrite", "as_json", "quiet", "verbose", "no_pictures"}
    ):
        kind = mode if mode == "scene" else option_name(mode)
        raise MitsimError(f"{option_name(others[0])}: has no effect on a calibration by {kind}; leave it out")
    if asked.output is None and mode != "planning":
        raise MitsimError("Missing option '-o' / '--output': give the calibration folder to make")
    return calibrated(asked, asked.output or Path())
