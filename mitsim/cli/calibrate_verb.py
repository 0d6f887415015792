"""`mitsim calibrate`: factors of a simulated session, of real frames, of known pictures, or of a fitted model.

`--plan` makes none of these, and plans a session.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsim.bench.request import NO, Coloured, Exposure, Opening, Request, SessionRequest, Task
from mitsim.cli.bench_verbs import check_work, memory_line, payload_of_lines, total_of_lines
from mitsim.cli.commands import LimitedPictured, Resumed, command, option_name, scene_named, to_make
from mitsim.core.configuration import OUTPUT, WHAT, option
from mitsim.core.errors import MitsimError
from mitsim.core.manifests import CALIBRATION
from mitsim.core.worker import RESUME, advise
from mitsim.devices.session import load_recipe
from mitsim.verbs import calibrate_in, open_as

if TYPE_CHECKING:
    from mitsim.reconstruct.factors import Factors


class Calibrating(SessionRequest, Coloured, Opening, LimitedPictured, Resumed):
    """Options of `mitsim calibrate`."""

    PANEL = WHAT

    scene: str | None = scene_named(None, "scene XML, or the name of a shipped scene; none with --frames")
    output: Path | None = to_make(None, "calibration folder to make; of --plan, recipe to write", "CAL")
    frames: Path | None = option(None, "folder with the frames of a real session, instead of a scene", metavar="DIR")
    known: Path | None = option(None, "list of captures of known pictures, instead of a scene", metavar="LIST.toml")
    write_frames: Path | None = option(
        None, "folder to write the simulated frames to, for --frames", metavar="DIR", panel=OUTPUT
    )
    planning: bool = option(False, "find the light that an image of --psnr needs; calibrates nothing", "--plan")
    psnr: float | None = option(None, "wanted of --plan's image [dB]", metavar="DB")
    patterns: str | None = option(None, "of --plan's capture", show_default="dots:7", metavar="PATTERNS")
    model: str | None = option(
        None, "model the factors, its devices fitted to a few frames; of --frames with SCENE", metavar="geometric|wave"
    )
    frames_used: int | None = option(None, "frames that --model is fitted to, at most", show_default="16", metavar="K")
    fit: str | None = option(None, "what --model fits", show_default="mask, magnification, gain", metavar="NAME,...")

    @property
    def folder(self) -> Path:
        """Folder of a calibration that is no plan; MitsimError without one, or with options of a plan."""
        for name, value in (("--psnr", self.psnr), ("--patterns", self.patterns)):
            if value is not None:
                raise MitsimError(f"{name} {value}: is for --plan; a calibration serves all patterns, so leave it out")
        if self.output is None:
            raise MitsimError("Missing option '-o' / '--output': give the calibration folder to make")
        return self.output

    def allow(self, names: str, reason: str) -> None:
        """Refuse, for a ``reason``, all given options but these ``names`` and those of the output."""
        allowed = {*names.split(), "output", "as_json", "quiet", "verbose", "no_pictures"}
        if others := sorted({*self.given} - allowed):
            raise MitsimError(f"{reason}; leave out {option_name(others[0])}")


@command
def calibrate(asked: Calibrating) -> int:
    """Estimate the camera's two factors, simulated or real.

    Renders a Hadamard session on a white board, or reads the frames of a real one (--frames) or of known pictures
    (--known).

    $ mitsim calibrate photograph -o cal
    $ mitsim calibrate photograph -o few --model wave
    $ mitsim calibrate --frames session -o cal --camera imx249
    """
    if asked.known is not None:
        asked.allow("known", f"--known {asked.known}: runs and their list decide")
        return _calibrate_known(asked.known, asked)
    if asked.model is not None and not asked.planning:
        return _fit(asked)
    for name in ("frames_used", "fit", "model"):
        if (value := getattr(asked, name)) is not None:
            raise MitsimError(f"{option_name(name)} {value}: is for --model without --plan; leave it out")
    if asked.frames is not None:
        asked.allow("frames camera", f"--frames {asked.frames}: frames and their list decide")
        return _calibrate_frames(asked.frames, asked)
    if asked.scene is None:
        raise MitsimError(
            "calibrate: give a scene, --frames DIR with the frames of a real session, or --known LIST of known pictures"
        )
    return (_plan if asked.planning else _calibrate)(asked.scene, asked)


def _finish(found: Mapping[str, Factors], folder: Path, asked: Calibrating, memory: float) -> int:
    """Print calibrations by the name of their folder in ``folder``, or one without a name; return the exit status."""
    results = {
        name: {
            **each.manifest.result,
            "memory_bytes": memory,
            "warnings": each.warnings,
            "output": str(folder / name),
        }
        for name, each in found.items()
    }
    lines = []
    for result in results.values():
        # JSON has null for infinite numbers.
        names = "separability_residual", "noise_free_residual", "phi_error", "predicted_phi_error", "condition"
        numbers = (result.get(name) for name in names)
        residual, clean, error, predicted, condition = (math.inf if each is None else each for each in numbers)
        simulated, shadow = "shadow_residual" in result, result.get("shadow_residual")
        divisor = result.get("divided_by", 1)
        lines += [
            f"{result['frames']} frames of {result['n']} stripes in {result['seconds']['total']:.1f} s: "
            f"{result['output']}",
            f"Factor error {error:.1e}, separability residual {residual:.2%} ({clean:.1e} without noise)"
            if simulated
            else f"Factor error {predicted:.1e} by its noise, separability residual {residual:.2%}",
            *asked.details(
                f"Condition {condition:.2e}",
                *([] if shadow is None else [f"Of single pixels' shadows the factors lack {shadow:.1e}"]),
                memory_line(result),
            ),
            *([] if divisor == 1 else [f"Numbers are divided by {divisor}, which all have"]),
            *(f"Not known: {text}" for text in result.get("not_known", ())),
        ]
    warnings = [text for each in found.values() for text in each.warnings]
    payload = results[""] if [*results] == [""] else {"depths": [*results.values()], "output": str(folder)}
    return asked.finish_folder(folder, {**payload, "warnings": warnings}, lines, warnings)


def _finish_lines(found: Mapping[str, Factors], folder: Path, asked: Calibrating, memory: float) -> int:
    """Print a coloured calibration; return the exit status."""
    results = {
        name: {**each.manifest.result, "warnings": each.warnings, "output": str(folder / name)}
        for name, each in found.items()
    }
    payload, lines = {**payload_of_lines(CALIBRATION, results, folder), "memory_bytes": memory}, []
    for part in payload["channels"]:
        residual = part["separability_residual"]
        error = part["predicted_phi_error"] if part["phi_error"] is None else part["phi_error"]
        lines.append(
            f"{part['name']}: {part['frames']} frames of {part['n']} stripes, separability residual "
            f"{'unknown' if residual is None else f'{residual:.2%}'}, factor error {error:.1e}"
        )
    return asked.finish_folder(folder, payload, [total_of_lines(payload), *lines], payload["warnings"])


def _calibrate(scene: str, asked: Calibrating) -> int:
    """Calibrate by a simulated session."""
    from mitsim.core.files import check_output
    from mitsim.core.job import memory_from_here, memory_since

    recipe, folder, colour, kept = asked.recipe or load_recipe(), asked.folder, asked.colour, asked.write_frames
    if kept is not None or colour != NO:
        recipe.of_one_depth()
    if kept is not None and asked.resume:
        raise MitsimError("--write-frames: a resumed session shows its finished patterns no more; leave out --resume")
    if kept is not None and colour != NO:
        raise MitsimError(f"--write-frames {kept}: frames are kept of light that is not told apart; leave one out")
    check_work(folder, asked.resume, "calibration", several=colour != NO or bool(recipe.depths))
    if kept is not None:
        check_output(kept)
    asked.check(scene, None, Exposure(None, recipe.exposure_fraction), colour)
    advise(RESUME)
    session = asked.part(SessionRequest)
    with asked.job() as job:
        bench = open_as(scene, asked, job, colour)
        held = memory_from_here()
        if kept is not None:
            found: Mapping[str, Factors] = {"": bench.write_session(kept, folder, job, **session.given)}
        else:
            found = calibrate_in(bench, colour, session, Task(folder, asked.resume, job))
    finish = _finish if colour == NO else _finish_lines
    return finish(found, folder, asked, memory_since(held))


def _calibrate_frames(frames: Path, asked: Calibrating) -> int:
    """Calibrate by the frames of a real session."""
    from mitsim.core.job import memory_from_here, memory_since
    from mitsim.devices.framelist import load_frames

    session, output = load_frames(frames), asked.folder  # refused before the estimator is imported
    from mitsim.reconstruct.captured_session import calibrate_frames, calibrate_planes

    held = memory_from_here()
    with asked.job() as job:
        if session.planes != ("",):
            found: Mapping[str, Factors] = calibrate_planes(session, output, job, asked.camera)
        else:
            found = {"": calibrate_frames(session, output, job, asked.camera)}
    finish = _finish if [*found] == [""] else _finish_lines
    return finish(found, output, asked, memory_since(held))


def _calibrate_known(listed: Path, asked: Calibrating) -> int:
    """Calibrate by captures of known pictures."""
    from mitsim.core.files import check_output
    from mitsim.core.job import memory_from_here, memory_since
    from mitsim.devices.framelist import load_known

    captures, output = load_known(listed), asked.folder  # refused before the fit is imported
    check_output(output)
    from mitsim.reconstruct.known_pictures import calibrate_known

    held = memory_from_here()
    with asked.job() as job:
        found = calibrate_known(captures, output, job)
    results = {
        name: {**each.manifest.result, "warnings": each.warnings, "output": str(output / name)}
        for name, each in found.items()
    }
    warnings = list(dict.fromkeys(text for each in results.values() for text in each["warnings"]))
    first = next(iter(results.values()))
    payload = {**first, "memory_bytes": memory_since(held), "warnings": warnings, "output": str(output)}
    if captures.lines is not None:
        payload["planes"] = results
    pictures = f"{first['pictures']} picture" + "s" * (first["pictures"] > 1)
    lines = [f"{first['frames']} frames of {pictures} in {first['seconds']['total']:.1f} s: {output}"]
    rows, columns = first["scale"]
    lines.append(
        f"Pictures lie {first['orientation']}, a scene pixel shifts the shadow by {rows:.4g} rows and {columns:.4g} "
        "columns of pixels"
    )
    planes = dict[str, list[str]]()
    for name, each in results.items():
        text = (
            f"{each['terms']} code{'s' if each['terms'] > 1 else ''} a side explain {each['explained']:.1%} of the "
            f"frames, left over beyond noise {each['unexplained_residual']:.2%}, factor error "
            f"{each['predicted_frame_error']:.1e} in frames of such pictures"
        )
        planes.setdefault(text, []).append(name)
    lines += [f"{', '.join(names)}: {text}" if any(names) else text for text, names in planes.items()]
    return asked.finish_folder(output, payload, lines, warnings)


def _plan(scene: str, asked: Calibrating) -> int:
    """Plan a session that an image of a given PSNR needs."""
    from mitsim.bench.request import check_psnr
    from mitsim.core.files import output_file, prepare_output, write_text
    from mitsim.devices.session import recipe_text

    recipe, output, colour = asked.recipe or load_recipe(), asked.output, asked.colour
    recipe.of_one_depth()
    for given, reason in (
        (asked.write_frames is not None, f"--write-frames {asked.write_frames}: --plan takes no frames"),
        (colour != NO, f"--colour {colour}: --plan is for light that is not told apart"),
        (asked.no_pictures, "--no-pictures: a plan has none"),
        (asked.resume, "--resume: a plan writes no parts to go on with"),
    ):
        if given:
            raise MitsimError(f"{reason}; leave it out")
    if asked.psnr is None:
        raise MitsimError("--plan: give the PSNR that the image is to have, such as --psnr 35")
    if output is not None:
        prepare_output(output, kind="file")
    patterns, psnr = Request(patterns=asked.patterns or "dots:7").patterns, check_psnr(asked.psnr)
    asked.check(scene, patterns, Exposure(None, recipe.exposure_fraction))
    with asked.job() as job:
        bench = open_as(scene, asked, job)
        from mitsim.calibrate.session_plan import plan_calibration

        with nullcontext() if output is None else output_file(output):
            found = plan_calibration(bench, psnr, patterns, recipe, seed=asked.seed, accuracy=asked.accuracy, job=job)
            lines = found.lines()
            if output is not None:
                write_text(output, recipe_text(found.recipe))
                lines.append(f"Recipe: {output}")
    return asked.finish({**found.payload(), "output": None if output is None else str(output)}, lines, found.warnings)


def _fit(asked: Calibrating) -> int:
    """Model the factors, with devices that are fitted to a few frames."""
    from mitsim.core.files import check_output
    from mitsim.devices.framelist import load_frames
    from mitsim.devices.session import FITTED, Modelling

    fitted = FITTED if asked.fit is None else tuple(name.strip() for name in asked.fit.split(","))
    count = {} if asked.frames_used is None else {"frames": asked.frames_used}
    model: Any = asked.model  # checked there
    modelling, folder = Modelling(model, **count, fitted=fitted, accuracy=asked.accuracy), asked.folder
    if asked.scene is None:
        raise MitsimError("--model: give the scene too, which states the camera and projector as they were to be built")
    of_frames_alone = ("recipe", "seed", "accuracy") if asked.frames else ()
    for name in ("resume", "write_frames", "colour", *of_frames_alone):
        if name in asked.given:
            other = " of --frames" if name in of_frames_alone else ""
            raise MitsimError(f"{option_name(name)}: is of no use with --model{other}; leave it out")
    recipe, frames = asked.recipe or load_recipe(), asked.frames and load_frames(asked.frames)
    check_output(folder)
    if frames is None:
        asked.check(asked.scene, None, Exposure(None, recipe.exposure_fraction))
    with asked.job() as job:
        bench = open_as(asked.scene, asked, job)
        from mitsim.calibrate.model import calibrate_model

        factors = calibrate_model(bench, modelling, frames, recipe, asked.seed, folder, job)
    result = factors.manifest.result
    numbers = [
        f"{name.replace('_', ' ')} {number['value']:.6g} +-{number['standard_error']:.2g} {number['unit']}"
        for name, number in result["parameters"].items()
        if number["standard_error"] is not None
    ]
    lines = [
        f"{result['model']} model fitted to {result['frames']} frames in {result['seconds']['total']:.1f} s: {folder}",
        *numbers,
        f"Unexplained {result['unexplained_residual']:.2%}, chi-square {result['chi_square']:.3g} a datum, condition "
        f"{result['condition']:.2e}",
    ]
    return asked.finish_folder(folder, {**result, "output": str(folder)}, lines, factors.warnings)
