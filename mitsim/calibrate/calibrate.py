"""Rendered calibration sessions: factors of a camera and their error, estimated as from a user's frames."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np

from mitsim.acquire.capture import colour_folder
from mitsim.acquire.spectral import SpectralBench, without_filters
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.request import Exposure, SessionRequest, Task
from mitsim.calibrate.board_session import Session
from mitsim.calibrate.checkpoint import (
    MOST_TIFF,
    Checkpoint,
    KeptFrames,
    SessionSums,
    claimed_session,
    is_finished,
    keep_light,
    kept_light,
)
from mitsim.calibrate.lit_session import LitSession, Response
from mitsim.core.arrays import FloatArray
from mitsim.core.environment import deciding_versions, versions
from mitsim.core.errors import MitsimError
from mitsim.core.files import output_folder, whole_folder
from mitsim.core.job import Cost, Job, Limits
from mitsim.core.manifests import CALIBRATION, CalibrationManifest
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer
from mitsim.devices.sensor import digital_of
from mitsim.devices.session import SIDES, load_recipe
from mitsim.light.light import SampledLight
from mitsim.light.plan import Plan
from mitsim.optics.frames import Frame
from mitsim.optics.terms import Lacking, lacking
from mitsim.reconstruct.colour import behind
from mitsim.reconstruct.factors import (
    SEPARABLE_RESIDUAL,
    Estimate,
    Factors,
    ResponseFit,
    StripeSums,
    load_calibration,
    stripe_sums,
)
from mitsim.reconstruct.session_check import CheckedSession, SessionConditions, check_session

NOISY, NOISE_FREE = "noisy", "noise_free"
"""Kinds of responses from which factors are estimated."""
_SAVED_EVERY, _SAVED_AFTER_S = 8, 0.5
"""Responses and seconds between two checkpoints."""
_REPEATS_BEHIND_FILTERS = 4
"""Default repeats behind filters, because most pixels see a tenth of a line that fills others."""


def calibrate(bench: Apparatus, request: SessionRequest, task: Task) -> Factors:
    """Run a calibration session and estimate the camera's factors; see :meth:`mitsim.api.bench.Bench.calibrate`."""
    session = Session(bench, (request.recipe or load_recipe()).of_one_depth(), request.seed)
    return _run_sessions([session], request, task, [task.output])[0]


def calibrate_depths(bench: Apparatus, request: SessionRequest, task: Task) -> dict[float, Factors]:
    """Estimate the camera's factors at each of a recipe's ``depths``, by depth [mm], in a folder for each.

    Light and noise of each depth are independent of the others. Raises MitsimError as :func:`calibrate`, for a recipe
    without depths, and for one at which the mask or no light is.
    """
    recipe, found = request.recipe or load_recipe(), {}
    if not recipe.depths:
        raise MitsimError("recipe: has no depths; give depths = [350, 400, 450], or use calibrate")
    nearest = bench.geometry.mask_distance + bench.geometry.mask_thickness
    if min(recipe.depths) <= nearest:
        raise MitsimError(
            f"recipe: depths has {min(recipe.depths):g}, and the mask ends {nearest:g} mm from the sensor; give more"
        )
    with nullcontext() if task.output is None else output_folder(task.output, overwrite=task.resume) as folder:
        for depth in recipe.depths:
            session = Session(bench, recipe, integer(request.seed, "depth", f"{depth:g}"), depth)
            own = replace(task, job=task.job.apart(f"{depth:g} mm "))
            (found[depth],) = _run_sessions([session], request, own, [folder and folder / f"{depth:g}"])
    return found


def write_session(bench: Apparatus, frames: Path | str, request: SessionRequest, task: Task) -> Factors:
    """Run :func:`calibrate` and write its frames to a folder that `mitsim calibrate --frames` reads.

    Raises MitsimError as there, for a recipe with depths, a folder that holds something, and a full disk.
    """
    session = Session(bench, (request.recipe or load_recipe()).of_one_depth(), request.seed)
    with whole_folder(frames) as folder:
        number_bytes = 2 if (bench.sensor.largest_dn or math.inf) <= MOST_TIFF else 8
        size = Cost(disk_bytes=float(session.shots * math.prod(bench.geometry.frame_shape) * number_bytes))
        size.check("frames", Limits(), folder)
        return _run_sessions([session], request, task, [task.output], folder)[0]


def calibrate_lines(bench: Apparatus, request: SessionRequest, task: Task) -> dict[str, Factors]:
    """Estimate factors at each line, by its name; see :meth:`mitsim.api.bench.Bench.calibrate_lines`."""
    return _by_line(SpectralBench.of(bench, CALIBRATION), request, task)


def calibrate_mosaic(bench: Apparatus, request: SessionRequest, task: Task) -> dict[str, Factors]:
    """Estimate factors at each line behind filters; see :meth:`mitsim.api.bench.Bench.calibrate_mosaic`."""
    lines = SpectralBench.of(without_filters(bench), CALIBRATION)
    if request.recipe is None:
        request = replace(request, recipe=load_recipe().model_copy(update={"repeats": _REPEATS_BEHIND_FILTERS}))
    return _by_line(lines, request, task)


def _by_line(bench: SpectralBench, request: SessionRequest, task: Task) -> dict[str, Factors]:
    assert bench.manifest is not None
    names, filters = bench.names, bench.whole.filters
    passed: Sequence[FloatArray | None] = [None] * len(names)
    if filters is not None:
        weights = np.array(filters.planes(bench.manifest.wavelengths_nm))
        if (dark := np.argwhere(weights == 0)).size:
            plane, line = dark[0]
            raise MitsimError(
                f"camera {bench.whole.devices.camera_file}: its {str(filters.mosaic)[plane]} filters "
                f"pass nothing of {names[line]}, so its calibration lacks pixels; use a projector whose lines all "
                "filters pass"
            )
        passed = list(behind(weights, bench.whole.geometry.frame_shape))
    whole = Session(bench.whole, (request.recipe or load_recipe()).of_one_depth(), request.seed)
    sessions = [
        replace(whole, bench=each, filters=own, whole=whole) for each, own in zip(bench.benches, passed, strict=True)
    ]
    with colour_folder(task, bench.manifest) as folder:
        places = [folder and folder / name for name in names]
        return dict(zip(names, _run_sessions(sessions, request, task, places), strict=True))


@single_threaded_blas()
def _run_sessions(
    lines: Sequence[Session],
    request: SessionRequest,
    task: Task,
    places: Sequence[Path | None],
    frames: Path | None = None,
) -> list[Factors]:
    for session in lines:
        session.check_mask(task.job)
    found, job, whole = list[Factors](), task.job, lines[0].whole or lines[0]
    plan: Plan | None = None
    lights: list[SampledLight] = []
    for number, (session, place) in enumerate(zip(lines, places, strict=True)):
        bench, recipe = session.bench, session.recipe
        Exposure(None, recipe.exposure_fraction).check(bench.sensor, bench.devices.camera_file)
        configuration = {
            **bench.provenance(),
            **bench.identity(),
            "accuracy": request.accuracy,
            "seed": session.seed,
            **({} if session.depth is None else {"depth_mm": session.depth}),
            "recipe": recipe.model_dump(exclude_defaults=True, exclude={"depths"}),
            "versions": deciding_versions(),
        }
        if session.depth is not None and task.resume and place is not None and is_finished(place, configuration):
            return [load_calibration(place)]
        with claimed_session(place, configuration, task.resume) as checkpoint:
            plan = plan or whole.plan(request.accuracy, job)
            checkpoint.begin()
            light = kept_light(checkpoint, session, plan)
            if light is None:
                lights = lights or whole.trace_lines([each.board for each in lines], plan, job)
                light = lights[number]
                keep_light(checkpoint, light)
            lit = LitSession.of(session, light, job)
            lit = replace(lit, kept=KeptFrames(session, frames) if frames else None)
            found.append(_factors(lit, checkpoint, job))
    return found


def _factors(lit: LitSession, checkpoint: Checkpoint, job: Job) -> Factors:
    session, plan = lit.session, lit.light.plan
    bench, digital = session.bench, digital_of(session.bench.sensor, lit.exposure_s)
    (noisy, clean), saturated, faults = estimates(lit, job, (NOISY, NOISE_FREE), checkpoint)
    if lit.kept is not None:
        lit.kept.finish(digital)
    lacks = _lacking(lit, clean)
    warnings = lit.light.warnings + session.warnings + (() if noisy.ok else (str(noisy.status),))
    warnings += faults.warnings
    if saturated:
        warnings += (
            f"saturation: {saturated} of {session.shots} frames have pixels at the full well or the ADC's end, "
            "so responses are not linear; lower the recipe's exposure_fraction",
        )
    result = {
        "n": bench.n,
        "depth_mm": session.distance,
        "frames": session.shots,
        "separability_residual": noisy.separability_residual,
        "unexplained_residual": noisy.unexplained,
        "noise_free_residual": clean.separability_residual,
        "phi_error": _factor_error(noisy, clean),
        "faults": [asdict(fault) for fault in faults.faults],
        "lamp": faults.lamp,
        "shadow_residual": lacks and lacks.residual,
        "condition": noisy.condition,
        "exposure_s": lit.exposure_s,
        "seconds": job.clock.seconds(),
        "kernels": job.clock.kernels(),
        "predicted": plan.predicted,
        "predicted_seconds": plan.predicted_seconds,
        "predicted_memory_bytes": plan.cost and plan.cost.memory_bytes,
        "warnings": warnings,
    }
    manifest = CalibrationManifest(
        configuration=checkpoint.configuration,
        camera=bench.identity(),
        centre=session.centre,
        board_reflectance=session.recipe.board_reflectance,
        digital=digital,
        parallax=bench.parallax_from(session.distance),
        result=result,
        warnings=warnings,
        versions=versions(),
        command=job.command,
        opened=bench.opened,
    )
    much = lacks is not None and lacks.residual > SEPARABLE_RESIDUAL
    factors = Factors.of(noisy, manifest, lacks.terms if lacks and much else ())
    if checkpoint.folder is not None:
        factors.write(checkpoint.folder)
        checkpoint.clear()
    return factors


def estimate(
    lit: LitSession, job: Job, noise_free: bool = False, checkpoint: Checkpoint | None = None
) -> tuple[Estimate, int]:
    """Estimate factors from the responses of a session, and count its shots with saturated pixels.

    ``noise_free`` uses the expected frames; other parameters are those of :func:`session_sums`.
    """
    (found,), saturated, _ = estimates(lit, job, (NOISE_FREE if noise_free else NOISY,), checkpoint)
    return found, saturated


@single_threaded_blas()
def estimates(
    lit: LitSession, job: Job, kinds: Sequence[str], checkpoint: Checkpoint | None = None
) -> tuple[list[Estimate], int, CheckedSession]:
    """Estimate factors from each kind of responses, with saturated shots and faults that noisy frames show."""
    session, found = lit.session, session_sums(lit, job, kinds, checkpoint)
    drift = session.recipe.drift
    taken = SessionConditions(
        session.order,
        saturated=bool(found.saturated),
        # Who states that the lamp drifts asks what that costs, which is gone once it is divided out.
        unsteady=bool(drift.session_ramp or drift.session_flicker),
    )
    with job.clock.stage("estimate"):
        judged = [
            _check_session(session, sums, taken) if kind == NOISY else CheckedSession(sums)
            for kind, sums in found.sums.items()
        ]
        factors = [
            each.estimate(session.signs, lit.response_noise if kind == NOISY else None)
            for kind, each in zip(kinds, judged, strict=True)
        ]
    return factors, found.saturated, judged[0]


def _check_session(session: Session, sums: tuple[StripeSums, StripeSums], taken: SessionConditions) -> CheckedSession:
    """Return the checked session, flagged where real frames would be refused.

    Simulated frames are not refused because the bench asks for them, and the exact factors show what they cost.
    """
    try:
        return check_session(sums, session.signs, taken)
    except MitsimError as error:
        return CheckedSession(sums, doubts=[*session.mask_warnings[:1], str(error)])


def session_sums(lit: LitSession, job: Job, kinds: Sequence[str], checkpoint: Checkpoint | None = None) -> SessionSums:
    """Return sums over all responses to a session, whose frames are formed once.

    Parameters
    ----------
    lit
        Session with traced light.
    job
        Clock and progress.
    kinds
        ``NOISY`` and ``NOISE_FREE``, one or both.
    checkpoint
        Store of finished stripes, from which an interrupted session continues.
    """
    session, checkpoint = lit.session, checkpoint or Checkpoint()
    count = session.signs.shape[1]

    def response(kind: str, side: str, number: int, frame: Frame) -> Response:
        return lit.noisy(side, number, frame) if kind == NOISY else Response(lit.noise_free(frame))

    def fit_response(sums: Sequence[StripeSums], shown: tuple[int, Frame]) -> list[tuple[ResponseFit, int]]:
        each = [response(kind, sums[0].side, *shown) for kind in kinds]
        return [
            (own.fit_response(one.rate, shown[0], one.light), one.saturated)
            for own, one in zip(sums, each, strict=True)
        ]

    stripes = SessionSums.from_checkpoint(checkpoint, kinds)
    if stripes is None:
        stripes = SessionSums({}, 0)
        with job.clock.stage("sensor"):
            for kind in kinds:
                one, other = (response(kind, side, 0, lit.white) for side in SIDES)
                lights = one.light, other.light
                stripes.sums[kind] = stripe_sums(one.rate, other.rate, count, session.centre, lights=lights)
                stripes.saturated += one.saturated + other.saturated
    saved = time.monotonic()
    for side, sums in zip(SIDES, zip(*stripes.sums.values(), strict=True), strict=True):
        for looked in lit.each(side, partial(fit_response, sums), job, sums[0].done):
            for own, (vectors, saturated) in zip(sums, looked, strict=True):
                own.put(vectors)
                stripes.saturated += saturated
            due = sums[0].done % _SAVED_EVERY == 0 and time.monotonic() >= saved + _SAVED_AFTER_S
            if due or sums[0].done == count:
                stripes.save(checkpoint)
                saved = time.monotonic()
    return stripes


def _lacking(lit: LitSession, clean: Estimate) -> Lacking | None:
    physics = lit.light.simulation.physics
    if not physics.geometry.few_wave_terms:
        return None
    return lacking(lit.session.shadow(physics.geometry, physics.spectrum), clean.left, clean.right)


def _factor_error(noisy: Estimate, clean: Estimate) -> float:
    """Return the relative error of both factors in quadrature.

    (left, right) and (-left, -right) are one camera; centred factors have no sum that tells which it is.
    """
    sign = 1.0 if np.vdot(noisy.left, clean.left) >= 0 else -1.0
    left = np.linalg.norm(sign * noisy.left - clean.left) / np.linalg.norm(clean.left)
    right = np.linalg.norm(sign * noisy.right - clean.right) / np.linalg.norm(clean.right)
    return float(np.hypot(left, right))
