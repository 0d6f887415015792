"""`mitsim calibrate`: words of a command line in; a session's or a plan's words, or a refusal, out.

Five ways to factors: a simulated session, the frames of a real one, captures of known pictures, a fitted model, and a
plan, which makes none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mitsim.cli.help_page import OUTPUT, WHAT
from mitsim.cli.options import (
    MOSAIC,
    NO,
    Accuracy,
    Coloured,
    Common,
    LimitedPictured,
    Resume,
    Seed,
    check_work,
    complete_scene,
    in_colour,
    is_given,
    option,
    option_name,
    request_of,
    verb,
)
from mitsim.cli.report_verb import finish_folder
from mitsim.cli.screen import finish, memory_line, payload_of_lines, total_of_lines
from mitsim.core.errors import MitsimError
from mitsim.core.spectral_manifests import CALIBRATION
from mitsim.core.worker import RESUME, advise

if TYPE_CHECKING:
    from mitsim.devices.session import Modelling
    from mitsim.reconstruct.factors import Factors

_OF_FRAMES = {"frames", "camera", "output", "as_json", "quiet", "verbose", "no_pictures"}
"""Options of `mitsim calibrate` that go with --frames."""
_OF_KNOWN = {"known", "aged", "output", "as_json", "quiet", "verbose", "no_pictures"}
"""Those that go with --known."""


@dataclass(frozen=True)
class Session:
    """Frames that factors come from, and where they go."""

    PANEL = WHAT

    output: Path | None = option(
        None,
        "calibration folder to make; of --plan, recipe to write",
        "-o",
        "--output",
        metavar="CAL",
        rich_help_panel=OUTPUT,
    )
    frames: Path | None = option(None, "folder with the frames of a real session, instead of a scene", metavar="DIR")
    known: Path | None = option(None, "list of captures of known pictures, instead of a scene", metavar="LIST.toml")
    aged: Path | None = option(
        None, "calibration that has aged: moved until the frames of --known fit", "--from", metavar="CAL"
    )
    accuracy: Accuracy = 1e-3
    seed: Seed = 0
    recipe: Path | None = option(None, "session recipe, TOML", metavar="FILE.toml")
    write_frames: Path | None = option(
        None, "folder to write the simulated frames to, for --frames", metavar="DIR", rich_help_panel=OUTPUT
    )
    resume: Resume = False

    @property
    def request(self) -> dict[str, Any]:
        """Accuracy and seed, checked."""
        return request_of(accuracy=self.accuracy, seed=self.seed)


@dataclass(frozen=True)
class Planned:
    """What --plan is asked for."""

    PANEL = WHAT

    planning: bool = option(False, "find the light that an image of --psnr needs; calibrates nothing", "--plan")
    psnr: float | None = option(None, "wanted of --plan's image [dB]", metavar="DB")
    patterns: str | None = option(None, "of --plan's capture", show_default="dots:7", metavar="PATTERNS")

    def folder(self, output: Path | None) -> Path:
        """The ``output`` of a calibration that is no plan; MitsimError without one, or with options of a plan."""
        for name, value in (("--psnr", self.psnr), ("--patterns", self.patterns)):
            if value is not None:
                raise MitsimError(f"{name} {value}: is for --plan; a calibration serves all patterns, so leave it out")
        if output is None:
            raise MitsimError("Missing option '-o' / '--output': give the calibration folder to make")
        return output


@dataclass(frozen=True)
class Modelled:
    """What --model is asked for."""

    PANEL = WHAT

    model: str | None = option(
        None, "model the factors, its devices fitted to a few frames; of --frames with SCENE", metavar="geometric|wave"
    )
    frames_used: int | None = option(None, "frames that --model is fitted to, at most", show_default="16", metavar="K")
    fit: str | None = option(None, "what --model fits", show_default="mask, magnification, gain", metavar="NAME,...")

    def modelling(self, accuracy: float) -> Modelling:
        """The fit, of light of an ``accuracy``; MitsimError for words that it does not know."""
        from mitsim.devices.session import FITTED, Modelling

        names = FITTED if self.fit is None else tuple(name.strip() for name in self.fit.split(","))
        model: Any = self.model  # checked there
        frames = {} if self.frames_used is None else {"frames": self.frames_used}
        return Modelling(model, **frames, fitted=names, accuracy=accuracy)


@verb
def calibrate(
    *,
    context: typer.Context,
    session: Session,
    scene: Annotated[
        str | None,
        typer.Argument(
            help="scene XML, or the name of a shipped scene; none with --frames",
            metavar="[SCENE]",
            autocompletion=complete_scene,
        ),
    ] = None,
    planned: Planned,
    modelled: Modelled,
    devices: Coloured,
    limited: LimitedPictured,
) -> int:
    """Estimate the camera's two factors, simulated or real.

    Renders a Hadamard session on a white board, or reads the frames of a real one (--frames) or of known pictures
    (--known).

    $ mitsim calibrate photograph -o cal
    $ mitsim calibrate photograph -o few --model wave
    $ mitsim calibrate --frames session -o cal --camera imx249
    """
    if session.known is not None:
        folder = Planned().folder(session.output)
        _check_alone(context, f"--known {session.known}: runs and their list decide", _OF_KNOWN)
        return _calibrate_known(session.known, session.aged, folder, limited)
    if session.aged is not None:
        raise MitsimError(f"--from {session.aged}: is mended by captures of known pictures; give --known LIST too")
    if modelled.model is not None and not planned.planning:
        modelling, folder = modelled.modelling(session.accuracy), planned.folder(session.output)
        return _fit(context, scene, modelling, folder, session, devices, limited)
    for name in ("frames_used", "fit", "model"):
        if (value := getattr(modelled, name)) is not None:
            raise MitsimError(f"{option_name(name)} {value}: is for --model without --plan; leave it out")
    if session.frames is not None:
        folder = Planned().folder(session.output)
        _check_alone(context, f"--frames {session.frames}: frames and their list decide", _OF_FRAMES)
        return _calibrate_frames(session.frames, folder, devices.camera, limited)
    if scene is None:
        raise MitsimError(
            "calibrate: give a scene, --frames DIR with the frames of a real session, or --known LIST of known pictures"
        )
    if planned.planning:
        return _plan(scene, session, planned, devices, limited)
    return _calibrate(scene, session, planned, devices, limited)


def _check_alone(context: typer.Context, reason: str, taken: set[str]) -> None:
    """MitsimError, for a ``reason``, where options are given that are not ``taken``."""
    if others := sorted({name for name in context.params if is_given(context, name)} - taken):
        raise MitsimError(f"{reason}; leave out {option_name(others[0])}")


# ---- a simulated session ---------------------------------------------------------------------------------------------


def _calibrate(scene: str, session: Session, planned: Planned, devices: Coloured, limited: LimitedPictured) -> int:
    from mitsim.bench.request import Exposure
    from mitsim.core.files import check_output
    from mitsim.core.job import memory_from_here, memory_since
    from mitsim.devices.session import load_recipe

    request, recipe, colour = session.request, load_recipe(session.recipe), devices.colour
    if session.write_frames is not None or colour != NO:
        recipe.of_one_depth()
    if session.write_frames is not None:
        if session.resume:
            raise MitsimError(
                "--write-frames: a resumed session shows its finished patterns no more; leave out --resume"
            )
        if colour != NO:
            raise MitsimError(
                f"--write-frames {session.write_frames}: frames are kept of light that is not told apart; leave one out"
            )
    folder, variant = planned.folder(session.output), devices.traced_in(limited.variant)
    check_work(folder, session.resume, "calibration", several=colour != NO or bool(recipe.depths))
    if session.write_frames is not None:
        check_output(session.write_frames)
    devices.check_colour(limited.variant)
    if colour != MOSAIC:
        devices.check_exposure(Exposure(None, recipe.exposure_fraction))
    advise(RESUME)
    with limited.job() as job:
        bench = devices.open(scene, variant, job)
        held = memory_from_here()
        whole: dict[str, Any] = {**request, "output": folder, "job": job}
        if colour != NO:
            seen = in_colour(bench, colour)
            by_line = seen.calibrate_mosaic if colour == MOSAIC else seen.calibrate_lines
            shown = None if session.recipe is None else recipe
            payload, lines = _of_lines(by_line(**whole, recipe=shown, resume=session.resume), folder)
            payload["memory_bytes"] = memory_since(held)
            return finish_folder(limited, folder, payload, lines, payload["warnings"])
        if session.write_frames is not None:
            found = [bench.write_session(session.write_frames, **whole, recipe=recipe)]
        elif recipe.depths:
            found = [*bench.calibrate_depths(**whole, recipe=recipe, resume=session.resume).values()]
        else:
            found = [bench.calibrate(**whole, recipe=recipe, resume=session.resume)]
    taken = memory_since(held)
    places = [str(folder / f"{depth:g}") for depth in recipe.depths] or [str(folder)]
    payloads = [
        {**factors.manifest.result, "memory_bytes": taken, "output": place}
        for factors, place in zip(found, places, strict=True)
    ]
    lines = [line for payload in payloads for line in _session_lines(payload, limited)]
    warnings = [text for factors in found for text in factors.warnings]
    if not recipe.depths:
        return finish_folder(limited, folder, payloads[0], lines, warnings)
    whole = {"depths": payloads, "output": str(folder), "warnings": warnings}
    return finish_folder(limited, folder, whole, lines, warnings)


def _session_lines(payload: dict[str, Any], common: Common) -> list[str]:
    """What is said of a simulated session, by its ``payload``, as ``common`` options have it."""
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
    """JSON and lines of text of a coloured calibration: its ``factors`` by line, in the folder ``output``."""
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
    """Numbers of a ``payload``; JSON has none beyond the finite ones."""
    return [math.inf if payload[name] is None else payload[name] for name in names]


# ---- frames of a real session ----------------------------------------------------------------------------------------


def _calibrate_frames(folder: Path, output: Path, camera: str | None, limited: LimitedPictured) -> int:
    from mitsim.core.job import memory_from_here, memory_since
    from mitsim.devices.framelist import load_frames

    session = load_frames(folder)  # refused before the estimator is imported
    from mitsim.reconstruct.captured_session import calibrate_frames, calibrate_planes

    held = memory_from_here()
    with limited.job() as job:
        if session.planes != ("",):
            payload, lines = _of_lines(calibrate_planes(session, output, job, camera), output)
            payload["memory_bytes"] = memory_since(held)
            return finish_folder(limited, output, payload, lines, payload["warnings"])
        factors = calibrate_frames(session, output, job, camera)
    payload = {**factors.manifest.result, "memory_bytes": memory_since(held), "output": str(output)}
    residual, error, condition = _finite(payload, "separability_residual", "predicted_phi_error", "condition")
    lines = [
        f"{payload['frames']} frames of {payload['n']} stripes in {payload['seconds']['total']:.1f} s: {output}",
        f"Factor error {error:.1e} by its noise, separability residual {residual:.2%}",
        *limited.details(f"Condition {condition:.2e}", memory_line(payload)),
        *([] if payload["divided_by"] == 1 else [f"Numbers are divided by {payload['divided_by']}, which all have"]),
        *(f"Not known: {text}" for text in payload["not_known"]),
    ]
    return finish_folder(limited, output, payload, lines, factors.warnings)


# ---- captures of known pictures --------------------------------------------------------------------------------------


def _calibrate_known(listed: Path, aged: Path | None, output: Path, limited: LimitedPictured) -> int:
    from mitsim.core.files import check_output
    from mitsim.core.job import memory_from_here, memory_since
    from mitsim.devices.knownlist import load_known

    captures = load_known(listed)  # refused before the fit is imported
    check_output(output)
    from mitsim.reconstruct.known_pictures import calibrate_known, moved_in_words

    held = memory_from_here()
    with limited.job() as job:
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
        return finish_folder(limited, output, payload, [said, moved, left], warnings)
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
    return finish_folder(limited, output, payload, lines, warnings)


# ---- `mitsim calibrate --plan` ---------------------------------------------------------------------------------------


def _plan(scene: str, session: Session, planned: Planned, devices: Coloured, limited: LimitedPictured) -> int:
    from mitsim.bench.request import Exposure, Request, check_psnr
    from mitsim.core.files import output_file, prepare_output, write_text
    from mitsim.devices.session import load_recipe, recipe_text

    request, recipe, output = session.request, load_recipe(session.recipe), session.output
    recipe.of_one_depth()
    if session.write_frames is not None:
        raise MitsimError(f"--write-frames {session.write_frames}: --plan takes no frames; leave one of them out")
    if devices.colour != NO:
        raise MitsimError(
            f"--colour {devices.colour}: --plan is for light that is not told apart; leave one of them out"
        )
    if planned.psnr is None:
        raise MitsimError("--plan: give the PSNR that the image is to have, such as --psnr 35")
    if limited.no_pictures:
        raise MitsimError("--no-pictures: a plan has none; leave it out")
    if session.resume:
        raise MitsimError("--resume: a plan writes no parts to go on with; leave it out")
    if output is not None:
        prepare_output(output, kind="file")
    patterns = Request.of(patterns=planned.patterns or "dots:7").patterns
    psnr = check_psnr(planned.psnr)
    devices.check_exposure(Exposure(None, recipe.exposure_fraction))
    devices.check(scene, patterns)
    with limited.job() as job:
        bench = devices.open(scene, limited.variant, job)
        from mitsim.calibrate.session_plan import plan_calibration

        with nullcontext() if output is None else output_file(output):
            found = plan_calibration(bench, psnr, patterns, recipe, **request, job=job)
            lines = found.lines()
            if output is not None:
                write_text(output, recipe_text(found.recipe))
                lines.append(f"Recipe: {output}")
    payload = {**found.payload(), "output": None if output is None else str(output)}
    return finish(limited.as_json, payload, lines, found.warnings)


# ---- `mitsim calibrate --model` --------------------------------------------------------------------------------------


def _fit(
    context: typer.Context,
    scene: str | None,
    modelling: Modelling,
    folder: Path,
    session: Session,
    devices: Coloured,
    limited: LimitedPictured,
) -> int:
    from mitsim.bench.request import Exposure
    from mitsim.core.files import check_output
    from mitsim.devices.framelist import load_frames
    from mitsim.devices.session import load_recipe

    if scene is None:
        raise MitsimError("--model: give the scene too, which states the camera and projector as they were to be built")
    of_frames_alone = ("recipe", "seed", "accuracy") if session.frames else ()
    for name in ("resume", "write_frames", "colour", *of_frames_alone):
        if is_given(context, name):
            other = " of --frames" if name in of_frames_alone else ""
            raise MitsimError(f"{option_name(name)}: is of no use with --model{other}; leave it out")
    seed = session.request["seed"]
    recipe, frames = load_recipe(session.recipe), session.frames and load_frames(session.frames)
    check_output(folder)
    if frames is None:
        devices.check_exposure(Exposure(None, recipe.exposure_fraction))
    with limited.job() as job:
        bench = devices.open(scene, limited.variant, job)
        from mitsim.calibrate.model import calibrate_model

        factors = calibrate_model(bench, modelling, frames, recipe, seed, folder, job)
    result = factors.manifest.result
    lines = _model_lines(result, folder)
    return finish_folder(limited, folder, {**result, "output": str(folder)}, lines, factors.warnings)


def _model_lines(result: Mapping[str, Any], output: Path) -> list[str]:
    """What people read of a fit's ``result``, in the folder ``output``."""
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
