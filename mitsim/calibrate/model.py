"""Calibration by a model whose few unknown numbers are fitted to a few frames of a session, simulated or real.

Measured factors need all patterns, a model with half a dozen unknowns only a few. Its residual does not shrink with
more frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.request import SessionRequest, Task, Working
from mitsim.calibrate.board_session import LitSession, Session, manifest_of
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import takes
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError
from mitsim.core.files import output_folder
from mitsim.core.job import Job
from mitsim.core.manifests import CalibrationManifest, FactorNoise, FittedNumber, ModelledFactors
from mitsim.core.parallel import single_threaded_blas
from mitsim.devices.framelist import SessionFrames, load_frames
from mitsim.devices.patterns import Lighting, stripe_signs
from mitsim.devices.sensor import digital_of
from mitsim.devices.session import SIDES, UNITS, Model, Modelling, Side, frames_of, load_recipe
from mitsim.optics.shadow import SeparableTerms
from mitsim.optics.terms import ModelledCamera, Placement, best_term
from mitsim.reconstruct.captured_session import chosen_responses
from mitsim.reconstruct.factors import SEPARABLE_RESIDUAL, Factors, decibels, squared_condition
from mitsim.reconstruct.solver import Status, Verdict, centre_frame

_SIGNIFICANT = 3.0
"""Standard errors from which a rotation of the mask counts."""


# -------- Factors of the fitted model


@takes(SessionRequest, Working, without="accuracy resume")
def calibrate_model(
    bench: Apparatus,
    modelling: Modelling,
    frames: Path | str | SessionFrames | None = None,
    output: Path | str | None = None,
    **request: Any,
) -> Factors:
    """Estimate the camera's factors by a fitted model.

    Parameters
    ----------
    bench
        Camera and projector as designed.
    modelling
        Model, number of frames, and free parameters.
    frames
        Folder or list of a real session's frames; None simulates a session of the bench.
    output
        CAL folder; None keeps the factors in memory.

    Returns
    -------
    Factors
        Flagged if the model leaves more than 1 % of the responses unexplained.

    Raises
    ------
    MitsimError
        For numbers that these frames cannot distinguish, frames of another size, an output that cannot be written, and
        as :meth:`mitsim.api.bench.Bench.calibrate`.
    """
    job, asked = Task.taken(None, request).job, SessionRequest(accuracy=modelling.accuracy, **request)
    with nullcontext() if output is None else output_folder(output) as place:
        camera = model_of(bench, modelling.model)
        if frames is not None:
            session = frames if isinstance(frames, SessionFrames) else load_frames(frames)
            listed, shape = session.listed, tuple(bench.geometry.frame_shape)
            if listed.n != bench.n:
                raise MitsimError(
                    f"frames {session.folder}: n is {listed.n}, but the scene's projector has {bench.n} pixels a side; "
                    "give the scene of these devices"
                )
            signs = stripe_signs(listed.n).astype(np.float64)
            chosen = modelling.used_patterns(_changes(signs), session.pairs, listed.repeats)
            rates = [*chosen_responses(session, chosen)]
            if wrong := [rate.shape for rate, _ in rates if rate.shape != shape]:
                raise MitsimError(
                    f"frames {session.folder}: are {wrong[0][0]} x {wrong[0][1]} pixels, but the scene's camera has "
                    f"{shape[0]} x {shape[1]}; give the scene of these devices"
                )
            used = frames_of(chosen, session.pairs, listed.repeats) * len(listed.exposure_ladder)
            shown, digital = _shown(signs, chosen, rates, listed.centre), listed.digital
            reflectance, configuration = listed.board_reflectance, dict[str, Any](frames=str(session.folder))
        else:
            recipe = (asked.recipe or load_recipe()).of_one_depth()
            board = Session(bench, recipe, asked.seed)
            plan = board.plan(asked.accuracy, job)
            lit = LitSession.of(board, board.trace(plan, job)[0], job)
            with job.clock.stage("sensor"):
                shown, used = simulate_responses(lit, modelling)
            digital, reflectance = digital_of(bench.sensor, lit.exposure_s), recipe.board_reflectance
            configuration = {"seed": asked.seed, "recipe": recipe.model_dump(exclude_defaults=True)}
        job.progress("fit", 0.5)
        with job.clock.stage("fit"):
            fitted = fit_placement(camera, shown, modelling.free)
        made: dict[str, Any] = {"configuration": {**bench.provenance(), **bench.identity(), **configuration}}
        made |= {"versions": versions(), "command": job.command}
        manifest = manifest_of(bench, digital, reflectance, bench.geometry.scene_distance, **made)
        factors = modelled_factors(camera, fitted, used, manifest, job)
        if place is not None:
            factors.write(place)
    return factors


def model_of(bench: Apparatus, model: Model) -> ModelledCamera:
    """Return the geometric or wave ``model`` of a ``bench``; MitsimError for a mask that is tilted or on a raster."""
    geometry = bench.geometry
    if geometry.is_drawn(model == "wave" and geometry.diffracts) or any(geometry.mask_tilt):
        raise MitsimError(
            f"calibrate: a {model} model needs a mask of one or two separable terms, mounted straight, not "
            f"{geometry.mask_words}; change the camera's [mask] (a fit finds its rotation), or leave out --model"
        )
    return ModelledCamera(bench.geometry, bench.windows, bench.n, bench.spectrum if model == "wave" else None)


def simulate_responses(lit: LitSession, modelling: Modelling) -> tuple[list[Shown], int]:
    """Return the responses of a session with traced light that a model is fitted to, and their number of frames."""
    session, n = lit.session, lit.session.bench.n
    pairs, repeats, signs = session.pairs, session.recipe.repeats, session.signs
    chosen = modelling.used_patterns(_changes(signs), pairs, repeats)
    formed, rates = dict.fromkeys(chosen, lit.white), []
    for side, labels in zip(SIDES, np.divmod(np.arange(n * n), n), strict=True):
        if own := [index for each, index in chosen if each == side and index]:
            frames = lit.light.frames(Lighting(labels, (1 + signs.T[own]) / 2), session.seed)
            formed |= {(side, index): frame for index, frame in zip(own, frames, strict=True)}
    rates = [(lit.noisy(side, index, formed[side, index]).rate, lit.response_noise) for side, index in chosen]
    return _shown(signs, chosen, rates, session.bench.geometry.centred), frames_of(chosen, pairs, repeats)


def _changes(signs: FloatArray) -> list[int]:
    found: list[int] = np.count_nonzero(np.diff(signs, axis=0), axis=0).tolist()
    return found


def _shown(
    signs: FloatArray, chosen: Sequence[tuple[Side, int]], rates: Iterable[tuple[FloatArray, float]], centre: bool
) -> list[Shown]:
    shown, even = [], np.ones(len(signs))
    for (side, index), (rate, noise) in zip(chosen, rates, strict=True):
        rows, columns = (signs[:, index], even) if side == SIDES[0] else (even, signs[:, index])
        shown.append(Shown(rows, columns, centre_frame(rate) if centre else rate, noise))
    return shown


@single_threaded_blas()
def modelled_factors(
    camera: ModelledCamera, fitted: Fitted, frames: int, manifest: CalibrationManifest, job: Job
) -> Factors:
    left, right = (side.astype(np.float32).astype(np.float64) for side in camera.factors(fitted.placement))
    # The slopes of the factors and the covariance of the fitted numbers give the error of the factors.
    here, slopes = camera.factors(fitted.placement), list[list[FloatArray]]()
    for name in fitted.free:
        step = STEPS.get(name, GAIN_STEP * fitted.placement.gain)
        there = camera.factors(fitted.placement.move({name: step}))
        slopes.append([((on - at) / step).ravel() for on, at in zip(there, here, strict=True)])
    deviations = [
        float(np.sqrt(max(np.sum(fitted.covariance * (each @ each.T)), 0.0) / each.shape[1]))
        for each in (np.stack(side) for side in zip(*slopes, strict=True))
    ]
    noise = FactorNoise(left=deviations[0], right=deviations[1], unexplained=fitted.unexplained)
    model: Model = "wave" if camera.spectrum else "geometric"
    warnings, unexplained = list[str](), fitted.unexplained
    status = Status(Verdict.CALIBRATED, f"Modelled: the {model} model explains {frames} frames")
    if unexplained > SEPARABLE_RESIDUAL:
        other = "check the scene's numbers of mask and window" if camera.spectrum else "take the wave-optical model"
        status = Status(
            Verdict.NOT_SEPARABLE,
            f"The {model} model does not explain the responses: {unexplained:.1%} of them is left over "
            f"({decibels(unexplained):.1f} dB)",
            f"{other}, or measure the factors with all patterns",
        )
        warnings += status.reasons
    angle, error = fitted.placement.mask_rotation, fitted.errors.get("mask_rotation")
    if error is not None and abs(angle) >= _SIGNIFICANT * error:
        turned = [(angle * one, other) for one, other in camera.rotation_terms(fitted.placement)]
        lost = best_term([camera.factors(fitted.placement), *turned]).residual
        if lost > SEPARABLE_RESIDUAL:
            warnings.append(
                f"the mask is rotated by {1e3 * angle:.2f} mrad (+-{1e3 * error:.2g}), which separable factors cannot "
                f"describe: they miss {lost:.1%} of the shadow ({decibels(lost):.1f} dB); straighten the mask"
            )
    numbers = {
        name: FittedNumber(value=getattr(fitted.placement, name), standard_error=fitted.errors.get(name), unit=unit)
        for name, unit in UNITS.items()
    }
    both = zip(deviations, (left, right), strict=True)
    relative = [error * np.sqrt(side.size) / np.linalg.norm(side) for error, side in both]
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
        "predicted_phi_error": float(np.hypot(*relative)),
        "condition": max(squared_condition(left), squared_condition(right)),
        "exposure_s": manifest.digital.exposure_s if manifest.digital else None,
        "seconds": job.clock.seconds(),
        "kernels": job.clock.kernels(),
        "warnings": tuple(warnings),
    }
    update = {
        "result": result,
        "warnings": tuple(warnings),
        "noise": noise,
        "modelled": ModelledFactors(model=model, frames=frames, chi_square=fitted.chi_square, parameters=numbers),
        "estimate": str(status),
        "verdict": status.verdict.value,
    }
    return Factors(left, right, manifest.model_copy(update=update), status)


# -------- Where mask and projector are
# Model frames and their derivatives are sums of few products u v^T. Therefore each response is replaced by its
# coefficients in the directions of sensor rows and columns that these span, which loses nothing for the fit and keeps
# white noise white. :func:`scipy.optimize.least_squares` minimises the sum of squares, with bounded variables in units
# of a step each, because the directions are valid for small steps only. They are computed again where the fit ended,
# until it stays there. The covariance is (J^T J)^-1 for data in units of their noise, times a chi-square above 1.
#
# A mask displaced by more than half a feature resembles another mask, so the shift is first searched over several.

STEPS = {
    "mask_distance": 2e-3,
    "mask_shift_row": 5e-4,
    "mask_shift_column": 5e-4,
    "mask_rotation": 1e-4,
    "magnification": 1e-4,
    "projector_row": 2.5e-4,
    "projector_column": 2.5e-4,
}
"""Step of each number in its unit: at most half a micrometre on the mask."""
GAIN_STEP = 0.01
"""Relative step of the gain, in which the model is linear."""
_ALIKE = 0.9999
"""Correlation from which two numbers count as one: each is then known 70 times worse than alone."""
_FEATURES = 5
"""Features by which the mask may be displaced along either axis: 0.3 mm of a mask of 60 um."""
_REACH = 10.0
"""Steps within which the directions represent a changed response: half a pixel on the mask, or less."""
_SHIFTS = ("mask_shift_row", "mask_shift_column")
"""Shifts of the mask that are tried before the fit."""
_PASSES, _STILL = 20, 0.05
"""Largest number of passes, and standard errors by which the last may still move."""


@dataclass(frozen=True, eq=False)
class Shown:
    """A response and its pattern.

    Attributes
    ----------
    rows, columns
        (n,) weights, whose product is the pattern.
    rate
        (m, m') response [electrons / s], centred if the camera's factors are.
    noise
        Standard deviation of one number of it.
    """

    rows: FloatArray
    columns: FloatArray
    rate: FloatArray
    noise: float


@dataclass(frozen=True, eq=False)
class Fitted:
    """Result of a fit.

    Attributes
    ----------
    free
        Names of the fitted numbers.
    covariance
        (free, free) covariance.
    chi_square
        Chi-square per datum: 1 for a correct model.
    unexplained
        Part of the responses (rms) that neither model nor stated noise explain.
    """

    placement: Placement
    free: tuple[str, ...]
    covariance: FloatArray
    chi_square: float
    unexplained: float

    @property
    def errors(self) -> dict[str, float]:
        return dict(zip(self.free, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


@single_threaded_blas()
def fit_placement(camera: ModelledCamera, shown: Sequence[Shown], free: Sequence[str]) -> Fitted:
    """Fit the placement of mask and projector, starting from the design.

    The first of ``shown`` is the response to uniform light, and ``gain`` is in ``free``. MitsimError for numbers that
    these responses cannot distinguish, and a mask that is too far off.
    """

    def fit_near(start: Placement) -> tuple[Placement, bool, float, FloatArray, float]:
        """Return placement, end of the search, chi-square per datum, covariance and unexplained part of one fit."""
        steps = {name: STEPS.get(name, GAIN_STEP * start.gain) for name in free}
        turned = camera.rotation_terms(start) if "mask_rotation" in free else []

        def place(x: FloatArray) -> Placement:
            return start.move({name: step * float(value) for (name, step), value in zip(steps.items(), x, strict=True)})

        def vectors(placement: Placement, each: Shown) -> SeparableTerms:
            terms = [camera.factors(placement), *((placement.mask_rotation * left, right) for left, right in turned)]
            return _vectors_of(terms, each)

        far = [{name: sign * _REACH * step} for name, step in steps.items() if name != "gain" for sign in (-1, 1)]
        # A rotation of 0 would leave out its directions.
        spanning = [*turned, *(camera.factors(start.move(moves)) for moves in ({}, *far))]
        directions, parts = list[tuple[FloatArray, FloatArray]](), list[FloatArray]()
        for each in shown:
            across, along = (
                np.linalg.qr(np.stack(pair, axis=1))[0] for pair in zip(*_vectors_of(spanning, each), strict=True)
            )
            directions.append((across, along))
            parts.append((across.T @ each.rate @ along / each.noise).ravel())
        data = np.concatenate(parts)

        def residual(x: FloatArray) -> FloatArray:
            model, placement = list[FloatArray](), place(x)
            for each, (across, along) in zip(shown, directions, strict=True):
                frame = sum(np.outer(across.T @ left, along.T @ right) for left, right in vectors(placement, each))
                model.append(np.ravel(frame) / each.noise)
            return np.asarray(np.concatenate(model) - data)

        def jacobian(x: FloatArray) -> FloatArray:
            here = residual(x)
            return np.stack([residual(x + one) - here for one in np.eye(len(x))], axis=1)

        bounds = -_REACH, _REACH
        done = least_squares(residual, np.zeros(len(free)), jacobian, bounds, xtol=1e-6, ftol=1e-10)
        inverse, at, scale = _inverse(jacobian(done.x), free), place(done.x), np.array([*steps.values()])
        chi_square = 2 * float(done.cost) / (len(data) - len(free))
        left_over = energy = 0.0
        for each in shown:
            frame = sum(np.outer(*pair) for pair in vectors(at, each))
            left_over += float(np.square(each.rate - frame).sum()) - each.rate.size * each.noise**2
            energy += float(np.square(each.rate).sum())
        still = bool(np.all(np.abs(done.x) <= _STILL * np.sqrt(np.diag(inverse))))
        covariance = max(chi_square, 1.0) * inverse * scale[:, None] * scale
        return at, still, chi_square, covariance, float(np.sqrt(max(left_over, 0.0) / energy))

    at, still = _first_guess(camera, shown[0], free), False
    for _ in range(_PASSES):
        at, still, chi_square, covariance, unexplained = fit_near(at)
        if still:
            break
    return Fitted(at, tuple(free), covariance, chi_square, unexplained)


def _vectors_of(terms: SeparableTerms, shown: Shown) -> SeparableTerms:
    return [(left @ shown.rows, right @ shown.columns) for left, right in terms]


def _inverse(jacobian: FloatArray, free: Sequence[str]) -> FloatArray:
    lengths = np.linalg.norm(jacobian, axis=0)
    if not lengths.all():
        raise MitsimError(
            f"{free[int(np.argmin(lengths))]}: changes nothing in these responses; leave it out of the fit"
        )
    inverse = np.linalg.pinv(jacobian / lengths, rcond=1e-12)
    covariance = inverse @ inverse.T
    spread = np.sqrt(np.diag(covariance))
    alike = np.abs(covariance / np.outer(spread, spread)) - np.eye(len(free))
    first, second = map(int, np.unravel_index(int(np.argmax(alike)), alike.shape))
    if alike[first, second] > _ALIKE:
        raise MitsimError(
            f"{free[first]} and {free[second]} cannot be distinguished with these responses (correlation "
            f"{alike[first, second]:.5f}); leave one of them out of the fit"
        )
    return np.asarray(covariance / np.outer(lengths, lengths))


def _first_guess(camera: ModelledCamera, uniform: Shown, free: Sequence[str]) -> Placement:
    """Return the placement with the shift of the mask, within some features, and the gain that fit uniform light."""
    shifts = np.zeros(1)
    if {*_SHIFTS} & {*free}:
        shifts = camera.geometry.mask_feature * np.arange(-_FEATURES, _FEATURES + 0.125, 0.25)
    geometric = replace(camera, spectrum=None)  # a shadow's fringes move with it
    moved = [geometric.factors(camera.built.move(dict.fromkeys(_SHIFTS, float(shift)))) for shift in shifts]
    lefts, rights = (np.stack(side) for side in zip(*(_vectors_of([pair], uniform)[0] for pair in moved), strict=True))
    products = lefts @ uniform.rate @ rights.T
    norms = np.outer(np.linalg.norm(lefts, axis=1), np.linalg.norm(rights, axis=1))
    found = dict(
        zip(_SHIFTS, map(int, np.unravel_index(int(np.argmax(products / norms)), products.shape)), strict=True)
    )
    for name, index in found.items():
        if name in free and len(shifts) > 1 and index in (0, len(shifts) - 1):
            raise MitsimError(
                f"{name}: the mask is off by {abs(shifts[-1]):g} mm or more; state mask_offset_row and "
                "mask_offset_column in the scene, within some features"
            )
    place = tuple(found.values())
    gain = float(products[place] / norms[place] ** 2)
    if not gain > 0:
        raise MitsimError("the response to uniform light does not contain the mask's shadow; check mask and geometry")
    moves = {name: float(shifts[index]) for name, index in found.items() if name in free}
    return camera.built.move({**moves, "gain": gain - camera.built.gain})
