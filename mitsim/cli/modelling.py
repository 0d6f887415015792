"""`mitsim calibrate --model`: words of a command line in; a fit to a few frames, its words, or a refusal, out."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from mitsim.cli.options import bench_of, check_camera, is_given, job_of, request_of
from mitsim.cli.screen import finish
from mitsim.core.errors import MitsimError

if TYPE_CHECKING:
    from mitsim.rig.modelling import Modelling


def modelling_of(model: str, frames_used: int | None, fit: str | None, accuracy: float) -> Modelling:
    """What `--model` is asked for; MitsimError for words that it does not know.

    Parameters
    ----------
    model, frames_used, fit, accuracy
        the options; None where not given.
    """
    from mitsim.rig.modelling import FITTED, Modelling

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
    from mitsim.capture.request import Exposure
    from mitsim.core.output import check_output
    from mitsim.rig.framelist import load_frames
    from mitsim.rig.recipe import load_recipe

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
        from mitsim.capture.modelling import calibrate_model as fit_model

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
