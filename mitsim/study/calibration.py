"""A calibration session in; how far its factors are off, by entry, by singular value and by cause, and its cost, out.

Factors of noisy frames are compared with those of the expected frames of the same light, whose difference is noise
alone; how large it may be is predicted from the sensor's closed form, before any frame is drawn. What no separable
camera explains of the expected frames is told apart by forming them again with one cause left out. What the session's
noise, the capture's, the scene's light, and each drift of the recipe cost an image of the scene is told beside one
image that is solved, and what of it is not explained (:mod:`mitsim.study.budget`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from mitsim.capture.bench import Bench
from mitsim.capture.calibrate import NOISE_FREE, NOISY, estimate, estimates
from mitsim.capture.light import Light
from mitsim.capture.request import Exposure, Request
from mitsim.capture.responses import LitSession
from mitsim.capture.run import digital_scale
from mitsim.capture.session import Session
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.core.manifests import SIDES as FACTORS
from mitsim.core.manifests import CalibrationManifest
from mitsim.core.parallel import single_threaded_blas
from mitsim.reconstruct.calibration import Estimate, decibels
from mitsim.reconstruct.factors import Factors
from mitsim.rig.board import BoardShape
from mitsim.rig.drift import Drift
from mitsim.rig.order import SIDES
from mitsim.rig.recipe import SessionRecipe, load_recipe
from mitsim.study.budget import UNEXPLAINED, entry_variances, losses
from mitsim.study.calibration_findings import CalibrationFindings, CauseRow, EntryRow, SingularRow
from mitsim.study.drift import DriftStand
from mitsim.study.exposures import LitScene
from mitsim.study.knobs import reformed, without

_FORMED = frozenset({"diffraction", "mask-thickness", "black-level"})
"""Effects of which frames are formed again in the same light; for others light is traced again, by the same seed."""


def measure(bench: Bench, request: Request, job: Job, recipe: SessionRecipe | None = None) -> CalibrationFindings:
    """Run a session and judge it.

    Parameters
    ----------
    bench, request, job
        whose camera, seed and accuracy; clock, progress and limits.
    recipe
        how the session is run; None: the shipped one.

    Raises
    ------
    MitsimError
        for a recipe with depths, and for light beyond what is allowed.

    Notes
    -----
    The session is taken without its drift: what that costs is predicted, as of all other drifts.
    """
    recipe = recipe or load_recipe()
    if recipe.depths:
        raise MitsimError(
            f"study calibration: the recipe has {len(recipe.depths)} depths, and a report is of one session; leave "
            "depths out, and move the board's plane by -D or the scene's scene_distance"
        )
    family = bench.family(request.patterns, request.seed)
    Exposure(None, recipe.exposure_fraction).check(bench.sensor, bench.rig.camera_file)
    session = Session(bench, recipe.model_copy(update={"drift": Drift()}), request.seed)
    plan = session.plan(request.accuracy, job)
    lit = session.lit(session.trace(plan, job), job)
    (noisy, clean), _ = estimates(lit, job, (NOISY, NOISE_FREE))
    found = judged(lit, noisy, clean, tuple(_by_cause(lit, noisy, clean, job)))
    scene = LitScene(bench.light(request.patterns, job, accuracy=request.accuracy, seed=request.seed))
    stand = DriftStand(scene, _factors(lit, noisy), recipe, family, request.seed)
    rows, refused = losses(stand, lit, _factors(lit, clean))
    told = sum(row.squared_error for row in rows if row.of != UNEXPLAINED)
    return replace(found, image=_image(stand, told), losses=tuple(rows), not_predicted=tuple(refused))


def _factors(lit: LitSession, estimate: Estimate) -> Factors:
    """The ``estimate`` of a session ``lit`` as factors of its camera."""
    session = lit.session
    manifest = CalibrationManifest(
        camera=session.bench.identity(),
        centre=session.centre,
        board_reflectance=session.recipe.board_reflectance,
        digital=digital_scale(session.bench, lit.exposure_s),
        parallax=session.bench.parallax,
    )
    return Factors.of(estimate, manifest)


def _image(stand: DriftStand, told: float) -> dict[str, Any]:
    """PSNR of the image without a drift, that of the squared error which is ``told`` of all sources, and what its
    capture takes."""
    frames = len(stand.family.shots)
    electrons = stand.electrons
    return {
        "patterns": stand.family.name,
        "psnr_db": stand.before_db,
        "predicted_psnr_db": -decibels(np.sqrt(told)),
        "frames": frames,
        "exposure_seconds": frames * stand.exposure_s,
        "photoelectrons": electrons,
        "photons": electrons / (stand.lit.bench.sensor.quantum_efficiency or np.nan),
    }


@single_threaded_blas()
def judged(lit: LitSession, noisy: Estimate, clean: Estimate, causes: tuple[CauseRow, ...] = ()) -> CalibrationFindings:
    """Errors of ``noisy`` factors of a session against ``clean`` ones, beside their prediction.

    Parameters
    ----------
    lit
        the session.
    noisy, clean
        estimates from noisy and from expected frames.
    causes
        of its residual.
    """
    entries, singular, maps = [], [], {}
    pairs = zip(FACTORS, SIDES, (clean.left, clean.right), (noisy.left, noisy.right), strict=True)
    for name, side, exact, found in pairs:
        # Factors are known up to a common scale and sign; this one is not drawn towards zero by the noise.
        found = found * (np.vdot(exact, exact) / np.vdot(found, exact))
        deviation = entry_deviation(lit, clean, side)
        off = (found - exact) / deviation
        maps[name] = off
        norm = float(np.linalg.norm(exact))
        predicted = float(np.linalg.norm(deviation)) / norm
        error = float(np.linalg.norm(found - exact)) / norm
        entries.append(EntryRow(name, error, predicted, float(np.abs(off).max()), float(np.square(off).mean())))
        singular += list(singular_rows(name, exact, found, deviation))
    return CalibrationFindings(
        tuple(entries),
        tuple(singular),
        causes,
        maps,
        (clean.separability_residual, noisy.separability_residual),
        spent(lit),
    )


def entry_deviation(lit: LitSession, clean: Estimate, side: str) -> FloatArray:
    """(m, n) predicted standard deviation of the entries of a factor, from all sources.

    Parameters
    ----------
    lit, clean
        the session, and the estimate from its expected frames.
    side
        whose stripes give the factor.
    """
    variances = entry_variances(lit, (clean.left, clean.right), side)
    return np.asarray(np.sqrt(sum(variances.values(), np.zeros(1))))


def singular_rows(factor: str, exact: FloatArray, found: FloatArray, deviation: FloatArray) -> Iterator[SingularRow]:
    """Singular values and vectors of a factor with noise beside those without.

    With a_jk = u_j^T E v_k, to first order s_k moves by a_kk, to second order by the mean of sum_j (s_k (a_jk^2 +
    a_kj^2) + 2 s_j a_jk a_kj) / (2 (s_k^2 - s_j^2)) + |(1 - U U^T) E v_k|^2 / (2 s_k), and v_k turns by the root of
    sum_j (s_k a_kj + s_j a_jk)^2 / (s_k^2 - s_j^2)^2 (Stewart and Sun 1990, Matrix Perturbation Theory, chapter V).
    Both want gaps between values that are larger than their errors.

    Parameters
    ----------
    factor
        its name.
    exact, found
        (m, n) without and with noise.
    deviation
        (m, n) of each entry, independent.
    """
    left, values, right = np.linalg.svd(exact, full_matrices=False)
    _, noisy, turned = np.linalg.svd(found, full_matrices=False)
    variance = np.square(deviation)
    # Means of a_jk^2 and of a_jk a_kj, at [j, k]; and of what leaves the span of U, by k.
    squares = np.square(left).T @ variance @ np.square(right).T
    products = np.zeros_like(squares)
    for column, vector in zip(variance.T, right.T, strict=True):
        products += (left.T * column) @ left * np.outer(vector, vector)
    beyond = (1 - np.square(left).sum(axis=1)) @ variance @ np.square(right).T
    for number, value in enumerate(values):
        others = np.arange(len(values)) != number
        rest, gaps = values[others], value**2 - np.square(values[others])
        to, back, both = (each[others] for each in (squares[:, number], squares[number], products[:, number]))
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            bias = float(np.sum((value * (to + back) + 2 * rest * both) / (2 * gaps)) + beyond[number] / (2 * value))
            turns = (value**2 * back + rest**2 * to + 2 * value * rest * both) / np.square(gaps)
            angle = float(np.sqrt(turns.sum()))
        cosine = min(abs(float(np.dot(right[number], turned[number]))), 1.0)
        error = float(np.sqrt(squares[number, number]))
        yield SingularRow(
            factor=factor,
            number=number,
            value=float(value),
            noisy=float(noisy[number]),
            standard_error=error,
            bias=bias,
            off=float((noisy[number] - value - bias) / error),
            predicted_angle=min(angle, float(np.pi / 2)),
            angle=float(np.arccos(cosine)),
        )


def spent(lit: LitSession) -> dict[str, float]:
    """Frames, seconds of exposure, expected photoelectrons and photons of a session ``lit``, without its read-out."""
    recipe, order = lit.session.recipe, len(lit.session.order)
    lit_s = sum(lit.exposures_s) * recipe.repeats
    # Shots of uniform light: both of a pair together are one.
    uniform = order / 2 if lit.session.pairs else 2 + (order - 2) * lit.session.lit_lines
    electrons = float(lit.uniform_rate.sum()) * uniform * lit_s
    return {
        "frames": lit.session.shots,
        "exposure_seconds": order * lit_s + recipe.dark_frames * sum(lit.exposures_s),
        "photoelectrons": electrons,
        "photons": electrons / (lit.session.bench.sensor.quantum_efficiency or np.nan),
    }


def _by_cause(lit: LitSession, noisy: Estimate, clean: Estimate, job: Job) -> Iterator[CauseRow]:
    """Residual of a session's expected frames without each cause, and what noise adds to it."""
    residual = clean.separability_residual
    yield _row("noise", noisy.separability_residual, residual)
    simulation, session = lit.light.simulation, lit.session
    for name, settings in without(simulation.settings, simulation.settings.effects):
        if name in _FORMED:
            light = reformed(lit.light, frozenset({name}))
        else:
            light = session.trace(replace(lit.light.plan, settings=settings), job)
        yield _row(name, residual, _residual(session, light, job))
    if session.recipe.board != BoardShape():
        flat = replace(session, recipe=session.recipe.model_copy(update={"board": BoardShape()}))
        yield _row("board", residual, _residual(flat, flat.trace(lit.light.plan, job), job))


def _residual(session: Session, light: Light, job: Job) -> float:
    return estimate(session.lit(light, job), job, noise_free=True)[0].separability_residual


def _row(cause: str, residual: float, left: float) -> CauseRow:
    less = residual**2 - left**2
    return CauseRow(cause, left, float(np.copysign(np.sqrt(abs(less)), less)))
