"""A bench and a few frames of a calibration session, simulated or real, in; factors of the fitted model, and what was
fitted with its standard errors, out.

Measured factors need all patterns, as each tells one direction of the projector's pixels; a model has half a dozen
unknowns, which a few frames tell. What it leaves unexplained is what no number of frames mends.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.request import SessionRequest
from mitsim.calibrate.board_session import Session
from mitsim.calibrate.lit_session import LitSession
from mitsim.calibrate.placement import GAIN_STEP, STEPS, Fitted, Shown, fit_placement
from mitsim.core.arrays import FloatArray
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError, checked
from mitsim.core.files import output_folder
from mitsim.core.job import Job
from mitsim.core.manifests import CalibrationManifest, Digital, FactorNoise, FittedNumber, ModelledFactors
from mitsim.devices.framelist import SessionFrames, load_frames
from mitsim.devices.patterns import Lighting, stripe_signs
from mitsim.devices.sensor import digital_of
from mitsim.devices.session import SIDES, UNITS, Model, Modelling, SessionRecipe, Side, frames_of, load_recipe
from mitsim.optics.camera_model import ModelledCamera
from mitsim.optics.frames import Frame
from mitsim.optics.separable import best_term
from mitsim.reconstruct.captured_session import chosen_responses
from mitsim.reconstruct.estimate_factors import SEPARABLE_RESIDUAL, decibels, squared_condition
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.solution import Status, Verdict
from mitsim.reconstruct.solver import centre_frame

_SIGNIFICANT = 3.0
"""Standard errors from which a rotation of the mask counts."""


@checked
def calibrate_model(
    bench: Apparatus,
    modelling: Modelling,
    frames: Path | str | SessionFrames | None = None,
    recipe: SessionRecipe | None = None,
    seed: int = 0,
    output: Path | str | None = None,
    job: Job | None = None,
) -> Factors:
    """The camera's factors by a model whose few unknown numbers are fitted.

    Parameters
    ----------
    bench
        the camera and projector as they were to be built.
    modelling
        which model, by how many frames, and what is fitted.
    frames
        folder with a real session's frames, or what its list says; None: a session of the bench is simulated.
    recipe
        of a simulated session; None: the shipped one.
    seed
        root of a simulated session's random streams.
    output
        CAL folder that is written; None keeps the factors in memory.
    job
        clock and progress.

    Returns
    -------
    Factors
        flagged where the model leaves more than 1 % of the responses unexplained.

    Raises
    ------
    MitsimError
        for numbers that these frames cannot tell apart, frames of another size than the bench's, an output that cannot
        be written, and as :meth:`mitsim.api.bench.Bench.calibrate`.
    """
    with nullcontext() if output is None else output_folder(output) as place:
        factors = _fit_factors(bench, modelling, frames, SessionRequest(seed, modelling.accuracy, recipe), job or Job())
        if place is not None:
            factors.write(place)
    return factors


def _fit_factors(
    bench: Apparatus, modelling: Modelling, frames: Path | str | SessionFrames | None, request: SessionRequest, job: Job
) -> Factors:
    if frames is not None:
        listed = frames if isinstance(frames, SessionFrames) else load_frames(frames)
        shown, digital, used = _of_frames(bench, listed, modelling)
        reflectance = listed.listed.board_reflectance
        configuration: dict[str, Any] = {"frames": str(listed.folder)}
    else:
        recipe = request.recipe or load_recipe()
        if recipe.depths:
            raise MitsimError("recipe: has depths; a model is fitted on the aligned plane, so leave them out")
        session = Session(bench, recipe, request.seed)
        plan = session.plan(request.accuracy, job)
        lit = LitSession.of(session, session.trace(plan, job), job)
        with job.clock.stage("sensor"):
            shown, used = simulate_responses(lit, modelling)
        digital, reflectance = digital_of(bench.sensor, lit.exposure_s), recipe.board_reflectance
        configuration = {"seed": request.seed, "recipe": recipe.model_dump(exclude_defaults=True)}
    job.progress("fit", 0.5)
    with job.clock.stage("fit"):
        camera = model_of(bench, modelling.model)
        fitted = fit_placement(camera, shown, modelling.free)
    manifest = CalibrationManifest(
        configuration={**bench.provenance(), **bench.identity(), **configuration},
        camera=bench.identity(),
        centre=bench.geometry.centred,
        board_reflectance=reflectance,
        digital=digital,
        parallax=bench.parallax,
        versions=versions(),
    )
    return modelled_factors(camera, fitted, used, manifest, job)


def model_of(bench: Apparatus, model: Model) -> ModelledCamera:
    """The ``model``, geometric or wave, of a ``bench`` as it was to be built. MitsimError for a mask that is tilted, or
    whose shadow is drawn on a raster: a fit moves a few profiles."""
    geometry = bench.geometry
    if geometry.drawn(model == "wave" and geometry.diffracts) or any(geometry.mask_tilt):
        raise MitsimError(
            f"calibrate: a {model} model has a mask of one or two separable terms, mounted straight, and "
            f"{geometry.mask_words} is not; describe it so in the camera's [mask] (a fit finds its rotation), or "
            "calibrate without a model"
        )
    return ModelledCamera(bench.geometry, bench.windows, bench.n, bench.spectrum if model == "wave" else None)


def simulate_responses(lit: LitSession, modelling: Modelling) -> tuple[list[Shown], int]:
    """Noisy responses of a session ``lit``, as many as a ``modelling`` uses, and of how many frames they are."""
    session, n = lit.session, lit.session.bench.n
    pairs, repeats, signs = session.pairs, session.recipe.repeats, session.signs
    chosen = modelling.chosen(_changes(signs), pairs, repeats)
    row, column = np.divmod(np.arange(n * n), n)
    formed: dict[tuple[str, int], Frame] = {}
    for side, labels in zip(SIDES, (row, column), strict=True):
        own = [index for each, index in chosen if each == side and index]
        lighting = Lighting(labels, (1 + signs.T[own]) / 2)
        frames = lit.light.frames(lighting, session.seed) if own else ()
        formed |= {(side, index): frame for index, frame in zip(own, frames, strict=True)}
    shown = [
        _response(
            signs[:, index],
            side,
            lit.noisy(side, index, formed.get((side, index), lit.white)).rate,
            lit.response_noise,
            session.centre,
        )
        for side, index in chosen
    ]
    return shown, frames_of(chosen, pairs, repeats) * len(session.recipe.exposure_ladder)


def _of_frames(bench: Apparatus, session: SessionFrames, modelling: Modelling) -> tuple[list[Shown], Digital, int]:
    """The same of a real session's frames, with their exposure."""
    listed, pairs = session.listed, session.pairs
    if listed.n != bench.n:
        raise MitsimError(
            f"frames {session.folder}: n is {listed.n}, but the scene's projector has {bench.n} pixels a side; give "
            "the scene of this rig"
        )
    signs = stripe_signs(listed.n).astype(np.float64)
    chosen = modelling.chosen(_changes(signs), pairs, listed.repeats)
    shown = []
    for (side, index), (rate, noise) in zip(chosen, chosen_responses(session, chosen), strict=True):
        rows, columns = bench.geometry.frame_shape
        if rate.shape != (rows, columns):
            raise MitsimError(
                f"frames {session.folder}: are {rate.shape[0]} x {rate.shape[1]} pixels, but the scene's camera has "
                f"{rows} x {columns}; give the scene of this rig"
            )
        shown.append(_response(signs[:, index], side, rate, noise, listed.centre))
    return shown, listed.digital, frames_of(chosen, pairs, listed.repeats) * len(listed.exposure_ladder)


def _changes(signs: FloatArray) -> list[int]:
    """Changes of sign in each column of ``signs`` (n, N)."""
    found: list[int] = np.count_nonzero(np.diff(signs, axis=0), axis=0).tolist()
    return found


def _response(signs: FloatArray, side: Side, rate: FloatArray, noise: float, centre: bool) -> Shown:
    across = side == SIDES[0]
    even = np.ones_like(signs)
    return Shown(signs if across else even, even if across else signs, centre_frame(rate) if centre else rate, noise)


def modelled_factors(
    camera: ModelledCamera, fitted: Fitted, frames: int, manifest: CalibrationManifest, job: Job
) -> Factors:
    """Factors of a fitted model.

    Parameters
    ----------
    camera, fitted
        the model, and where its parts are.
    frames
        that it was fitted to.
    manifest
        of which camera they are.
    job
        its clock's seconds are stated.
    """
    left, right = (side.astype(np.float32).astype(np.float64) for side in camera.factors(fitted.placement))
    noise = _noise(camera, fitted)
    model: Model = "wave" if camera.spectrum else "geometric"
    warnings, status = (*_rotation(camera, fitted),), _status(model, fitted, frames)
    if not status.ok:
        warnings = (str(status), *warnings)
    numbers = {
        name: FittedNumber(value=getattr(fitted.placement, name), standard_error=fitted.errors.get(name), unit=unit)
        for name, unit in UNITS.items()
    }
    result: dict[str, Any] = {
        "n": camera.n,
        "frames": frames,
        "model": model,
        "parameters": {name: number.model_dump() for name, number in numbers.items()},
        "chi_square": fitted.chi_square,
        "separability_residual": None,
        "unexplained_residual": fitted.unexplained,
        "noise_free_residual": None,
        "phi_error": None,
        "predicted_phi_error": float(
            np.hypot(
                *(
                    error * np.sqrt(side.size) / np.linalg.norm(side)
                    for error, side in zip((noise.left, noise.right), (left, right), strict=True)
                )
            )
        ),
        "condition": max(squared_condition(left), squared_condition(right)),
        "exposure_s": manifest.digital.exposure_s if manifest.digital else None,
        "seconds": job.clock.seconds(),
        "warnings": warnings,
    }
    update = {
        "result": result,
        "warnings": warnings,
        "noise": noise,
        "modelled": ModelledFactors(model=model, frames=frames, chi_square=fitted.chi_square, parameters=numbers),
        "estimate": str(status),
        "verdict": status.verdict.value,
    }
    return Factors(left, right, manifest.model_copy(update=update), status)


def _noise(camera: ModelledCamera, fitted: Fitted) -> FactorNoise:
    """How far the factors are off by what the fit does not know, rms over their numbers."""
    here, places = camera.factors(fitted.placement), []
    for name in fitted.free:
        step = STEPS.get(name, GAIN_STEP * fitted.placement.gain)
        there = camera.factors(fitted.placement.moved({name: step}))
        places.append([((on - at) / step).ravel() for on, at in zip(there, here, strict=True)])
    left, right = (
        float(np.sqrt(max(np.sum(fitted.covariance * (slopes @ slopes.T)), 0.0) / slopes.shape[1]))
        for slopes in (np.stack(side) for side in zip(*places, strict=True))
    )
    return FactorNoise(left=left, right=right, unexplained=fitted.unexplained)


def _status(model: Model, fitted: Fitted, frames: int) -> Status:
    left = fitted.unexplained
    if left > SEPARABLE_RESIDUAL:
        other = (
            "take the wave-optical model" if model == "geometric" else "check the scene's numbers of mask and window"
        )
        return Status(
            Verdict.NOT_SEPARABLE,
            f"The {model} model does not explain the responses: {left:.1%} of them is left over "
            f"({decibels(left):.1f} dB)",
            f"{other}, or measure the factors with all patterns",
        )
    return Status(Verdict.CALIBRATED, f"Modelled: the {model} model explains {frames} frames")


def _rotation(camera: ModelledCamera, fitted: Fitted) -> Sequence[str]:
    """What separable factors lack of a mask that is turned."""
    angle, error = fitted.placement.mask_rotation, fitted.errors.get("mask_rotation")
    if error is None or abs(angle) < _SIGNIFICANT * error:
        return ()
    turned = [(angle * left, right) for left, right in camera.turned(fitted.placement)]
    lost = best_term([camera.factors(fitted.placement), *turned]).residual
    if lost <= SEPARABLE_RESIDUAL:
        return ()
    return (
        f"the mask is turned by {1e3 * angle:.2f} mrad (+-{1e3 * error:.2g}): no separable factors have that, and "
        f"{lost:.1%} of the shadow is lacking ({decibels(lost):.1f} dB); straighten the mask",
    )
