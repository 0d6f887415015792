"""`mitsim calibrate`: factors of a simulated session, of real frames, of known pictures, or of a fitted model.

`--plan` makes none of these, and plans a session.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mitsim.bench.request import NO, Exposure, FixedColour, Opening, Request, SessionRequest, Task
from mitsim.cli.commands import Common, LimitedPictured, Resumed, check_work, complete_scene, option_name, verb
from mitsim.cli.screen import finish, finish_folder, memory_line, payload_of_lines, total_of_lines
from mitsim.core.configuration import OUTPUT, WHAT, option
from mitsim.core.errors import MitsimError
from mitsim.core.manifests import CALIBRATION
from mitsim.core.worker import RESUME, advise
from mitsim.verbs import calibrate_in, open_as

if TYPE_CHECKING:
    from mitsim.devices.session import Modelling
    from mitsim.reconstruct.factors import Factors

_OF_FRAMES = {"frames", "camera", "output", "as_json", "quiet", "verbose", "no_pictures"}
"""Options of `mitsim calibrate` that go with --frames."""
_OF_KNOWN = {"known", "aged", "output", "as_json", "quiet", "verbose", "no_pictures"}
"""Those that go with --known."""


class Calibrating(SessionRequest, FixedColour, Opening, LimitedPictured, Resumed):
    """What factors are found from, how, and where they go."""

    PANEL = WHAT

    output: Path | None = option(
        None,
        "calibration folder to make; of --plan, recipe to write",
        "-o",
        "--output",
        metavar="CAL",
        panel=OUTPUT,
    )
    frames: Path | None = option(None, "folder with the frames of a real session, instead of a scene", metavar="DIR")
    known: Path | None = option(None, "list of captures of known pictures, instead of a scene", metavar="LIST.toml")
    aged: Path | None = option(
        None, "calibration that has aged: moved until the frames of --known fit", "--from", metavar="CAL"
    )
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

    def modelling(self, accuracy: float) -> Modelling:
        """Return the fit of --model, of light of an ``accuracy``; MitsimError for words that it does not have."""
        from mitsim.devices.session import FITTED, Modelling

        names = FITTED if self.fit is None else tuple(name.strip() for name in self.fit.split(","))
        model: Any = self.model  # checked there
        frames = {} if self.frames_used is None else {"frames": self.frames_used}
        return Modelling(model, **frames, fitted=names, accuracy=accuracy)

    def refuse_others(self, scene: str | None, allowed: set[str], reason: str) -> None:
        """Refuse, for a ``reason``, a ``scene`` and the first option that is given and not ``allowed``."""
        given = {*self.given, *(() if scene is None else ("scene",))}
        if others := sorted(given - allowed):
            raise MitsimError(f"{reason}; leave out {option_name(others[0])}")


@verb
def calibrate(
    asked: Calibrating,
    scene: Annotated[
        str | None,
        typer.Argument(
            help="scene XML, or the name of a shipped scene; none with --frames",
            metavar="[SCENE]",
            autocompletion=complete_scene,
        ),
    ] = None,
) -> int:
    """Estimate the camera's two factors, simulated or real.

    Renders a Hadamard session on a white board, or reads the frames of a real one (--frames) or of known pictures
    (--known).

    $ mitsim calibrate photograph -o cal
    $ mitsim calibrate photograph -o few --model wave
    $ mitsim calibrate --frames session -o cal --camera imx249
    """
    if asked.known is not None:
        asked.refuse_others(scene, _OF_KNOWN, f"--known {asked.known}: runs and their list decide")
        return _calibrate_known(asked.known, asked)
    if asked.aged is not None:
        raise MitsimError(f"--from {asked.aged}: is mended by captures of known pictures; give --known LIST too")
    if asked.model is not None and not asked.planning:
        return _fit(scene, asked)
    for name in ("frames_used", "fit", "model"):
        if (value := getattr(asked, name)) is not None:
            raise MitsimError(f"{option_name(name)} {value}: is for --model without --plan; leave it out")
    if asked.frames is not None:
        asked.refuse_others(scene, _OF_FRAMES, f"--frames {asked.frames}: frames and their list decide")
        return _calibrate_frames(asked.frames, asked)
    if scene is None:
        raise MitsimError(
            "calibrate: give a scene, --frames DIR with the frames of a real session, or --known LIST of known pictures"
        )
    if asked.planning:
        return _plan(scene, asked)
    return _calibrate(scene, asked)


# ---- a simulated session ---------------------------------------------------------------------------------------------


def _calibrate(scene: str, asked: Calibrating) -> int:
    from mitsim.core.files import check_output
    from mitsim.core.job import memory_from_here, memory_since
    from mitsim.devices.session import load_recipe

    recipe, folder, colour = asked.recipe or load_recipe(), asked.folder, asked.colour
    if asked.write_frames is not None or colour != NO:
        recipe.of_one_depth()
    if asked.write_frames is not None:
        if asked.resume:
            raise MitsimError(
                "--write-frames: a resumed session shows its finished patterns no more; leave out --resume"
            )
        if colour != NO:
            raise MitsimError(
                f"--write-frames {asked.write_frames}: frames are kept of light that is not told apart; leave one out"
            )
    check_work(folder, asked.resume, "calibration", several=colour != NO or bool(recipe.depths))
    if asked.write_frames is not None:
        check_output(asked.write_frames)
    asked.check(scene, None, Exposure(None, recipe.exposure_fraction), colour)
    advise(RESUME)
    session = asked.part(SessionRequest)
    with asked.job() as job:
        bench = open_as(scene, asked, job, colour)
        held = memory_from_here()
        if asked.write_frames is not None:
            found: Mapping[str, Factors] = {"": bench.write_session(asked.write_frames, folder, job, **session.given)}
        else:
            found = calibrate_in(bench, colour, session, Task(folder, asked.resume, job))
    taken = memory_since(held)
    if colour != NO:
        payload, lines = _of_lines(found, folder)
        payload["memory_bytes"] = taken
        return finish_folder(asked, folder, payload, lines, payload["warnings"])
    payloads = [
        {**factors.manifest.result, "memory_bytes": taken, "output": str(folder / name)}
        for name, factors in found.items()
    ]
    lines = [line for payload in payloads for line in _session_lines(payload, asked)]
    warnings = [text for factors in found.values() for text in factors.warnings]
    if not recipe.depths:
        return finish_folder(asked, folder, payloads[0], lines, warnings)
    whole = {"depths": payloads, "output": str(folder), "warnings": warnings}
    return finish_folder(asked, folder, whole, lines, warnings)


def _session_lines(payload: dict[str, Any], common: Common) -> list[str]:
    names = "separability_residual", "noise_free_residual", "phi_error", "condition"
    residual, clean, error, condition = _finite(payload, *names)
    shadow = payload["shadow_residual"]
    return [
        f"{payload['frames']} frames of {payload['n']} stripes in {payload['seconds']['total']:.1f} s: "
        f"{payload['output']}",
        f"Factor error {error:.1e}, separability residual {residual:.2%} ({clean:.1e} without noise)",
        *common.details(
            f"Condition {condition:.2e}",
            *([] if shadow is None else [f"Of single pixels' shadows the factors lack {shadow:.1e}"]),
            memory_line(payload),
        ),
    ]


def _of_lines(factors: Mapping[str, Factors], output: Path) -> tuple[dict[str, Any], list[str]]:
    """Return the JSON and the lines of text of a coloured calibration, by its ``factors``."""
    results = {
        name: {**each.manifest.result, "warnings": each.warnings, "output": str(output / name)}
        for name, each in factors.items()
    }
    payload = payload_of_lines(CALIBRATION, results, output)
    lines = [
        f"{part['name']}: {part['frames']} frames of {part['n']} stripes, separability residual "
        f"{_percent(part['separability_residual'])}, factor error "
        f"{part['predicted_phi_error'] if part['phi_error'] is None else part['phi_error']:.1e}"
        for part in payload["channels"]
    ]
    return payload, [total_of_lines(payload), *lines]


def _percent(part: float | None) -> str:
    return "unknown" if part is None else f"{part:.2%}"


def _finite(payload: Mapping[str, Any], *names: str) -> list[float]:
    """Return numbers of a ``payload``, where JSON has null for infinite ones."""
    return [math.inf if payload[name] is None else payload[name] for name in names]


# ---- frames of a real session ----------------------------------------------------------------------------------------


def _calibrate_frames(folder: Path, asked: Calibrating) -> int:
    from mitsim.core.job import memory_from_here, memory_since
    from mitsim.devices.framelist import load_frames

    session, output = load_frames(folder), asked.folder  # refused before the estimator is imported
    from mitsim.reconstruct.captured_session import calibrate_frames, calibrate_planes

    held = memory_from_here()
    with asked.job() as job:
        if session.planes != ("",):
            payload, lines = _of_lines(calibrate_planes(session, output, job, asked.camera), output)
            payload["memory_bytes"] = memory_since(held)
            return finish_folder(asked, output, payload, lines, payload["warnings"])
        factors = calibrate_frames(session, output, job, asked.camera)
    payload = {**factors.manifest.result, "memory_bytes": memory_since(held), "output": str(output)}
    residual, error, condition = _finite(payload, "separability_residual", "predicted_phi_error", "condition")
    lines = [
        f"{payload['frames']} frames of {payload['n']} stripes in {payload['seconds']['total']:.1f} s: {output}",
        f"Factor error {error:.1e} by its noise, separability residual {residual:.2%}",
        *asked.details(f"Condition {condition:.2e}", memory_line(payload)),
        *([] if payload["divided_by"] == 1 else [f"Numbers are divided by {payload['divided_by']}, which all have"]),
        *(f"Not known: {text}" for text in payload["not_known"]),
    ]
    return finish_folder(asked, output, payload, lines, factors.warnings)


# ---- captures of known pictures --------------------------------------------------------------------------------------


def _calibrate_known(listed: Path, asked: Calibrating) -> int:
    from mitsim.core.files import check_output
    from mitsim.core.job import memory_from_here, memory_since
    from mitsim.devices.framelist import load_known

    captures, output, aged = load_known(listed), asked.folder, asked.aged  # refused before the fit is imported
    check_output(output)
    from mitsim.reconstruct.known_pictures import calibrate_known, moved_in_words

    held = memory_from_here()
    with asked.job() as job:
        found = calibrate_known(captures, output, job, aged)
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
    said = f"{first['frames']} frames of {pictures} in {first['seconds']['total']:.1f} s: {output}"
    if aged is not None:
        left = f"Left over beyond noise {first['unexplained_residual']:.2%}, before {first['unexplained_before']:.2%}"
        moved = f"Moved: {moved_in_words(first['moved'])}"
        return finish_folder(asked, output, payload, [said, moved, left], warnings)
    rows, columns = first["scale"]
    planes = dict[str, list[str]]()
    for name, each in results.items():
        text = (
            f"{each['terms']} code{'s' if each['terms'] > 1 else ''} a side explain {each['explained']:.1%} of the "
            f"frames, left over beyond noise {each['unexplained_residual']:.2%}, factor error "
            f"{each['predicted_frame_error']:.1e} in frames of such pictures"
        )
        planes.setdefault(text, []).append(name)
    lines = [
        said,
        f"Pictures lie {first['orientation']}, a scene pixel shifts the shadow by {rows:.4g} rows and {columns:.4g} "
        "columns of pixels",
        *(f"{', '.join(names)}: {text}" if any(names) else text for text, names in planes.items()),
    ]
    return finish_folder(asked, output, payload, lines, warnings)


# ---- `mitsim calibrate --plan` ---------------------------------------------------------------------------------------


def _plan(scene: str, asked: Calibrating) -> int:
    from mitsim.bench.request import check_psnr
    from mitsim.core.files import output_file, prepare_output, write_text
    from mitsim.devices.session import load_recipe, recipe_text

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
    payload = {**found.payload(), "output": None if output is None else str(output)}
    return finish(asked.as_json, payload, lines, found.warnings)


# ---- `mitsim calibrate --model` --------------------------------------------------------------------------------------


def _fit(scene: str | None, asked: Calibrating) -> int:
    from mitsim.core.files import check_output
    from mitsim.devices.framelist import load_frames
    from mitsim.devices.session import load_recipe

    modelling, folder = asked.modelling(asked.accuracy), asked.folder
    if scene is None:
        raise MitsimError("--model: give the scene too, which states the camera and projector as they were to be built")
    of_frames_alone = ("recipe", "seed", "accuracy") if asked.frames else ()
    for name in ("resume", "write_frames", "colour", *of_frames_alone):
        if name in asked.given:
            other = " of --frames" if name in of_frames_alone else ""
            raise MitsimError(f"{option_name(name)}: is of no use with --model{other}; leave it out")
    recipe, frames = asked.recipe or load_recipe(), asked.frames and load_frames(asked.frames)
    check_output(folder)
    if frames is None:
        asked.check(scene, None, Exposure(None, recipe.exposure_fraction))
    with asked.job() as job:
        bench = open_as(scene, asked, job)
        from mitsim.calibrate.model import calibrate_model

        factors = calibrate_model(bench, modelling, frames, recipe, asked.seed, folder, job)
    result = factors.manifest.result
    lines = _model_lines(result, folder)
    return finish_folder(asked, folder, {**result, "output": str(folder)}, lines, factors.warnings)


def _model_lines(result: Mapping[str, Any], output: Path) -> list[str]:
    numbers = [
        f"{name.replace('_', ' ')} {number['value']:.6g} +-{number['standard_error']:.2g} {number['unit']}"
        for name, number in result["parameters"].items()
        if number["standard_error"] is not None
    ]
    return [
        f"{result['model']} model fitted to {result['frames']} frames in {result['seconds']['total']:.1f} s: {output}",
        *numbers,
        f"Unexplained {result['unexplained_residual']:.2%}, chi-square {result['chi_square']:.3g} a datum, condition "
        f"{result['condition']:.2e}",
    ]
