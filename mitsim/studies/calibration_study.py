"""`mitsim study calibration`: how far a session's factors are off, by entry, singular value and cause; what it costs.

Factors of noisy frames are compared with those of the expected frames of the same light, whose difference is noise
alone; how large it may be is predicted from the sensor's closed form, before any frame is drawn. What no separable
camera explains of the expected frames is told apart by forming them again with one cause left out. What the session's
noise, the capture's, the scene's light, and each drift of the recipe cost an image of the scene is told beside one
image that is solved, and what of it is not explained (:mod:`mitsim.studies.error_budget`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from typing import Any, ClassVar, TypeVar, get_args

import numpy as np
from matplotlib.figure import Figure

from mitsim.api.bench import Bench
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.request import Exposure, Request
from mitsim.calibrate.board_session import Session
from mitsim.calibrate.calibrate import NOISE_FREE, NOISY, estimate, estimates
from mitsim.calibrate.lit_session import LitSession
from mitsim.calibrate.model import fit_placement, model_of, modelled_factors, simulate_responses
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.core.manifests import SIDES as FACTORS
from mitsim.core.manifests import CalibrationManifest
from mitsim.core.parallel import single_threaded_blas
from mitsim.devices.sensor import digital_of
from mitsim.devices.session import (
    DRIFT_WORDS,
    SIDES,
    BoardShape,
    Drift,
    Model,
    Modelling,
    SessionRecipe,
    load_recipe,
)
from mitsim.light.light import SampledLight
from mitsim.reconstruct.factors import Estimate, Factors, decibels
from mitsim.report import plots
from mitsim.report.lit_scene import LINE, IdealCamera, LitScene, ShadowRow, lights, point_profiles, shadow_row
from mitsim.report.pages import Mean, with_error
from mitsim.report.plots import grouped_bars
from mitsim.studies import error_budget
from mitsim.studies.causes import ablations, reform
from mitsim.studies.drift_study import SESSION, DriftStand, squared_error
from mitsim.studies.error_budget import LossRow
from mitsim.studies.framework.campaign import Findings
from mitsim.studies.framework.panels import Part

AnyBench = TypeVar("AnyBench", bound=Apparatus)
OFF_MM = {"mask_distance": 0.05, "mask_offset_row": 0.037, "mask_offset_column": -0.021}
"""Differences of a camera and its plan: as of a mask that is glued on by hand, under a microscope."""
_MODEL_FRAMES = (2, 16)
"""Frames that models are fitted to: uniform light alone, and a few stripes."""
_FORMED = frozenset({"diffraction", "mask-thickness", "black-level"})
"""Effects of which frames are formed again in the same light; for others light is traced again, by the same seed."""


# ---- A session and the image made with it ----


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
    Exposure(None, recipe.exposure_fraction).check(bench.sensor, bench.devices.camera_file)
    session = Session(bench, recipe.model_copy(update={"drift": Drift()}), request.seed)
    plan = session.plan(request.accuracy, job)
    lit = LitSession.of(session, session.trace(plan, job), job)
    (noisy, clean), _, _ = estimates(lit, job, (NOISY, NOISE_FREE))
    found = judge_session(lit, noisy, clean, tuple(_by_source(lit, noisy, clean, job)))
    scene = LitScene(bench.light(request.patterns, job, accuracy=request.accuracy, seed=request.seed))
    stand = DriftStand(scene, _factors(lit, noisy), recipe, family, request.seed)
    rows, refused = error_budget.losses(stand, lit, _factors(lit, clean))
    explained = sum(row.squared_error for row in rows if row.of != error_budget.UNEXPLAINED)
    shadows, profiles = compare_shadows(bench)
    left, right = IdealCamera(bench, bench.geometry.mask).calibrated(scene.board_flux)
    geometric = replace(stand, factors=replace(stand.factors, left=left, right=right))
    image = _image(stand, explained) | {"geometric_psnr_db": geometric.before_db}
    models, unfitted = fit_models(lit, stand)
    return replace(
        found,
        image=image,
        losses=tuple(rows),
        not_predicted=(*refused, *unfitted),
        models=models,
        shadows=shadows,
        profiles=profiles,
    )


def as_built(bench: AnyBench) -> AnyBench:
    """Return a ``bench`` whose mask is off its place by :data:`OFF_MM`."""
    camera = bench.geometry
    changed = camera.model_copy(update={name: getattr(camera, name) + off for name, off in OFF_MM.items()})
    return replace(bench, devices=replace(bench.devices, camera=changed))


def fit_models(lit: LitSession, stand: DriftStand) -> tuple[tuple[ModelRow, ...], tuple[str, ...]]:
    """Return the quality of images with factors of models that are fitted to a few frames of a session, and the reasons
    why some can't be fitted.

    Parameters
    ----------
    lit, stand
        session, and the frames of the scene. The models start from a plan that the camera differs from.
    """
    rows, refused, planned = [], [], as_built(lit.session.bench)
    for model, wanted in product(get_args(Model), _MODEL_FRAMES):
        modelling = Modelling(model, wanted)
        try:
            camera, (shown, frames) = model_of(planned, model), simulate_responses(lit, modelling)
            fitted = fit_placement(camera, shown, modelling.free)
        except MitsimError as error:  # no model is of this mask, or the frames can't tell its parameters apart
            refused.append(f"image of a {model} model of {wanted} frames ({error})")
            continue
        factors = modelled_factors(camera, fitted, frames, stand.factors.manifest, Job())
        unexplained = float(factors.manifest.result["unexplained_residual"])
        rows.append(ModelRow(model, frames, replace(stand, factors=factors).before_db, unexplained))
    return tuple(rows), tuple(refused)


def compare_shadows(bench: Bench) -> tuple[tuple[ShadowRow, ...], dict[str, FloatArray]]:
    """Return the shadow of the mask of a ``bench`` in each light against the geometric one, and a point's shadows down
    the rows of the sensor [1] by light, with the rows' places [mm]."""
    cameras = {name: IdealCamera(bench, bench.geometry.mask, spectrum) for name, spectrum in lights(bench).items()}
    profiles = {_PLACES: np.asarray(bench.geometry.centres(0)), **point_profiles(bench)}
    del profiles[LINE]  # it coincides with that of the projector's lines, to the width of a plotted line
    return tuple(shadow_row(name, cameras) for name in cameras), profiles


def _factors(lit: LitSession, estimate: Estimate) -> Factors:
    session = lit.session
    manifest = CalibrationManifest(
        camera=session.bench.identity(),
        centre=session.centre,
        board_reflectance=session.recipe.board_reflectance,
        digital=digital_of(session.bench.sensor, lit.exposure_s),
        parallax=session.bench.parallax,
    )
    return Factors.of(estimate, manifest)


def _image(stand: DriftStand, explained: float) -> dict[str, Any]:
    """PSNR of the image without a drift, that of the squared error which is ``told`` of all sources, and what its
    capture takes."""
    frames = len(stand.family.shots)
    electrons = stand.electrons
    return {
        "patterns": stand.family.name,
        "psnr_db": stand.before_db,
        "predicted_psnr_db": -decibels(np.sqrt(explained)),
        "frames": frames,
        "exposure_seconds": frames * stand.exposure_s,
        "photoelectrons": electrons,
        "photons": electrons / (stand.lit.bench.sensor.quantum_efficiency or np.nan),
    }


# ---- Noisy factors against clean ones ----


@single_threaded_blas()
def judge_session(
    lit: LitSession, noisy: Estimate, clean: Estimate, causes: tuple[ErrorSourceRow, ...] = ()
) -> CalibrationFindings:
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
        session_cost(lit),
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
    variances = error_budget.entry_variances(lit, (clean.left, clean.right), side)
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


# ---- Cost of a session ----


def session_cost(lit: LitSession) -> dict[str, float]:
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


# ---- What is not separable, by cause ----


def _by_source(lit: LitSession, noisy: Estimate, clean: Estimate, job: Job) -> Iterator[ErrorSourceRow]:
    """Residual of a session's expected frames without each cause, and what noise adds to it."""
    residual = clean.separability_residual
    yield _row("noise", noisy.separability_residual, residual)
    simulation, session = lit.light.simulation, lit.session
    for name, settings in ablations(simulation.settings, simulation.settings.effects):
        if name in _FORMED:
            light = reform(lit.light, frozenset({name}))
        else:
            light = session.trace(replace(lit.light.plan, settings=settings), job)
        yield _row(name, residual, _residual(session, light, job))
    if session.recipe.board != BoardShape():
        flat = replace(session, recipe=session.recipe.model_copy(update={"board": BoardShape()}))
        yield _row("board", residual, _residual(flat, flat.trace(lit.light.plan, job), job))


def _residual(session: Session, light: SampledLight, job: Job) -> float:
    return estimate(LitSession.of(session, light, job), job, noise_free=True)[0].separability_residual


def _row(cause: str, residual: float, left: float) -> ErrorSourceRow:
    less = residual**2 - left**2
    return ErrorSourceRow(cause, left, float(np.copysign(np.sqrt(abs(less)), less)))


# ---- Rows of the findings, and their words ----

_APART = 0.3
"""Predicted turn of its vectors [rad] up to which a singular value stands apart from others: beyond, noise mixes them,
and bias and angle to first order do not hold."""
_WHERE = {
    error_budget.CAPTURE: "noise of the capture",
    error_budget.SCENE: "light of the scene",
    error_budget.DRIFT: "drift, not in this image",
    error_budget.SOLVER: "the solver",
    error_budget.UNEXPLAINED: "anywhere",
    SESSION: "noise of the session",
}
"""Where a loss comes from, in words."""
_HAS, _WOULD = "has lost by noise, light and solver", "would lose by a drift"
"""What becomes of the image, as the figure calls it."""
_LOSS_NOTES = (
    "Noise, light of the scene and solver: what the image would gain without that source alone, and the source's "
    "part of the squared error. These parts add up to the whole, decibels do not. Below 0: the image would be worse "
    "without it.",
    "Drift between calibration and capture, by the amounts of the recipe: what the image would lose, each alone.",
    "Noise and drift are predicted in closed form with lambda as it is. Light of the scene is what factors, measured "
    "on an even white board, do not hold of it, found from frames without noise.",
    "The uncertainty is one standard error: noise is drawn once, and the part that is not explained may belong to "
    "any source; none is told where it is below 0.005.",
    "Nonuniformity: the session has seen the same pixels, so its factors hold what the pixels of a row or of a "
    "column have alike, and the image loses by the rest. Rendering is the simulation's own sampling, which no camera "
    "has.",
)
"""How the table of losses is to be read."""
_ERROR_SOURCES = {
    "noise": "noise of the sensor",
    "black-level": "light that black pixels leak",
    "diffraction": "diffraction at the mask",
    "anchors": "light that changes over the sensor",
    "layers": "shadows that change with depth",
    "cells": "light that changes inside projector pixels",
}
"""Causes of what is not separable, in words; others have names that say it."""
_PLACES = "places"
"""Name of the places of pixels among profiles of shadows."""
_PROFILE_MM = 0.7
"""Half of the range of a point's shadow that is shown: a dozen mask features, whose fringes can be seen."""
_NO_DRIFT = " The recipe has no table [drift]: calibration/drift.toml is one that has."
_SAID_DB = 0.005
"""Loss from which it is told in text: less is 0.00 there."""
_SHOWN_DEVIATIONS = 4.0
"""Range of the maps: one of 16 000 entries lies beyond."""


@dataclass(frozen=True)
class EntryRow:
    """Error of a factor's entries [its rms]: found, predicted from the noise, and the largest in predicted deviations;
    ``chi_square`` is the mean square of all in these."""

    factor: str
    error: float
    predicted_error: float
    largest: float
    chi_square: float


@dataclass(frozen=True)
class SingularRow:
    """A singular value of a factor and of the same with noise, its predicted standard error and bias, how far it is
    off in standard errors beyond the bias; and the angle [rad] of its two vectors, predicted and found."""

    factor: str
    number: int
    value: float
    noisy: float
    standard_error: float
    bias: float
    off: float
    predicted_angle: float
    angle: float


@dataclass(frozen=True)
class ErrorSourceRow:
    """Separability residual without one cause; ``part`` is the root of what it takes away from the squared residual,
    below 0 where the residual grows without it."""

    cause: str
    residual: float
    part: float


@dataclass(frozen=True)
class ModelRow:
    """PSNR [dB] of the image with factors of a ``model`` that was fitted to some ``frames`` of the session, and the
    part of these frames that it leaves ``unexplained``."""

    model: str
    frames: int
    psnr_db: float
    unexplained: float


# ---- Findings as text, figures and tables ----


@dataclass(frozen=True, eq=False)
class CalibrationFindings(Findings):
    """What a session came to.

    Attributes
    ----------
    entries, singular, causes
        rows of the report.
    maps
        (m, n) error of each factor's entries in predicted deviations, by factor.
    residual
        separability residual of the expected frames, and of the noisy ones.
    session
        frames, seconds of exposure, photoelectrons and photons.
    image
        of a capture with these factors: ``patterns``, ``psnr_db``, ``predicted_psnr_db`` of all sources together, and
        ``frames``, ``exposure_seconds``, ``photoelectrons`` and ``photons`` of the capture; empty where none was made.
    losses
        what each source of noise, the scene's light and each drift costs it, and what is not explained.
    not_predicted
        drifts whose cost is not, each with the reason.
    models
        images with factors of models that are fitted to a few frames of the session.
    shadows, profiles
        the mask's shadow in each light against its geometric one; a point's shadow by light, with the places of the
        sensor's rows.
    """

    entries: tuple[EntryRow, ...]
    singular: tuple[SingularRow, ...]
    causes: tuple[ErrorSourceRow, ...]
    maps: dict[str, FloatArray]
    residual: tuple[float, float]
    session: dict[str, float]
    image: dict[str, Any] = field(default_factory=dict)
    losses: tuple[LossRow, ...] = ()
    not_predicted: tuple[str, ...] = ()
    models: tuple[ModelRow, ...] = ()
    shadows: tuple[ShadowRow, ...] = ()
    profiles: dict[str, FloatArray] = field(default_factory=dict)
    title: ClassVar[str] = "What limits a calibration session and its image"

    def payload(self) -> dict[str, Any]:
        """The JSON of the command line."""
        return {
            "separability_residual": self.residual[1],
            "noise_free_residual": self.residual[0],
            "entries": [asdict(row) for row in self.entries],
            "singular": [asdict(row) for row in self.singular],
            "causes": [asdict(row) for row in self.causes],
            "session": self.session,
            "image": self.image,
            "losses": [asdict(row) for row in self.losses],
            "not_predicted": self.not_predicted,
            "models": [asdict(row) for row in self.models],
            "shadows": [asdict(row) for row in self.shadows],
            "warnings": self.warnings,
        }

    @property
    def warnings(self) -> list[str]:
        """That the sources do not make the image's squared error, where chance does not either."""
        return [
            f"losses: {_verdict(row)}, {100 * row.squared_error / squared_error(self.image['psnr_db']):+.1f} % of its "
            "squared error, which may have a share in every other row; look for what the scene or the camera has that "
            "no row names"
            for row in self.losses
            if row.of == error_budget.UNEXPLAINED and abs(row.squared_error) > error_budget.SURE * row.deviation
        ]

    @property
    def message(self) -> str:
        """What costs the image the most; without an image, how good the factors are."""
        lost = [row for row in self.losses if row.of not in (error_budget.UNEXPLAINED, error_budget.DRIFT)]
        if not lost:
            errors = " and ".join(f"{row.error:.1e} ({row.factor})" for row in self.entries)
            return f"The factors' relative errors are {errors}"
        most = max(lost, key=lambda row: row.lost_db)
        return f"{most.name} costs the image most: {most.lost_db:.2f} of {self.image['psnr_db']:.1f} dB"

    def figures(self) -> dict[str, Figure]:
        """Maps of the entries' errors, singular values with their errors, and the residual by cause."""
        parts = {_cause(row): row.part for row in self.causes if row.part > 0}
        found = {
            f"{name}.png": plots.deviations(values, _SHOWN_DEVIATIONS, f"Errors of the {name} factor")
            for name, values in self.maps.items()
        }
        rows = {
            name: np.array(
                [(row.value, row.noisy - row.bias, row.standard_error) for row in self.singular if row.factor == name]
            )
            for name in self.maps
        }
        found["singular.png"] = plots.singular_errors(rows)
        if parts:
            found["causes.png"] = plots.error_bars(parts)
        rated: dict[str, dict[str, Mean]] = {_HAS: {}, _WOULD: {}}
        for row in self.losses:
            if abs(row.lost_db) >= _SAID_DB:
                rated[_WOULD if row.of == error_budget.DRIFT else _HAS][row.name] = Mean(row.lost_db, row.error_db, 1)
        if any(rated.values()):
            groups = {name: {kind: mean} for kind, means in rated.items() for name, mean in means.items()}
            found["losses.png"] = grouped_bars(groups, "PSNR lost [dB]", ordered=True)
        if self.profiles:
            found["shadow.png"] = shadow_profiles(self.profiles, _PROFILE_MM)
        return found

    def parts(self) -> Sequence[Part]:
        """Of the page: what an image loses, light and time, errors of the factors, what is not separable."""
        entries = [
            (row.factor, *(f"{each:.2e}" for each in (row.error, row.predicted_error)),
             f"{row.chi_square:.3f}", f"{row.largest:.1f}")
            for row in self.entries
        ]  # fmt: skip
        offs = np.array([row.off for row in self.singular if row.predicted_angle < _APART])
        rms = f", rms {np.sqrt(np.mean(offs**2)):.2f} standard errors off" if len(offs) else ""
        causes = [
            (_cause(row), f"{row.residual:.2e}", "nothing" if not row.part else f"{row.part:+.1e}")
            for row in self.causes
        ]
        return [
            *([self._losses_part()] if self.losses else []),
            self._light_part(),
            Part(
                "Errors of the factors",
                "The left factor takes rows of the scene to rows of the sensor, the right one columns. Noisy factors "
                "against those of frames without noise of the same light: relative error, found and predicted "
                "from the sensor's closed form; mean square (1 if the prediction holds) and largest error of an entry, "
                "in predicted standard deviations. Then each singular value's error, beside its predicted standard "
                f"error: {len(offs)} of {len(self.singular)} stand apart from others{rms}.",
                ("Factor", "Relative error", "Predicted", "Chi-square an entry", "Largest [deviations]"),
                tuple(entries),
                (*(f"{name}.png" for name in self.maps), "singular.png"),
            ),
            Part(
                "What is not separable",
                f"No separable camera explains {self.residual[1]:.2e} of the noisy responses, {self.residual[0]:.2e} "
                "of those without noise (relative rms). Without each cause alone, so much is left; its part is the "
                "root of the difference of the squares, below 0 where more is left without it.",
                ("Cause", "Residual without it", "Part"),
                tuple(causes),
                ("causes.png",),
            ),
            *([self._models_part()] if self.models else []),
            *([self._shadows_part()] if self.shadows else []),
        ]

    def _models_part(self) -> Part:
        rows = [(row.model, f"{row.frames}", f"{row.psnr_db:.1f}", f"{row.unexplained:.1e}") for row in self.models]
        measured = ("measured", f"{self.session['frames']:.0f}", f"{self.image['psnr_db']:.1f}", "")
        return Part(
            "How few frames suffice",
            "The image with factors of a model whose mask and projector are fitted to a few frames of the session: the "
            "closed-form shadow with diffraction (wave) and without (geometric). The fit starts from a plan whose mask "
            "is 50 um too far off, and 37 and 21 um beside its place. Frames are simulated with the very shadow that "
            "the wave model has: what a real mask has beside it only measured factors hold.",
            ("Factors", "Frames", "PSNR [dB]", "Not explained [1]"),
            (*rows, measured),
        )

    def _shadows_part(self) -> Part:
        rows = [
            (row.light, *(f"{100 * each:.1f}" for each in (row.point_source, row.scene_pixel)),
             *(f"{each:.1e}" for each in (row.separability, row.separability_centred)))
            for row in self.shadows
        ]  # fmt: skip
        return Part(
            "Diffraction at the mask",
            f"Factors of the mask's geometric shadow, as if light did not diffract, give the image a PSNR of "
            f"{self.image['geometric_psnr_db']:.1f} dB in place of {self.image['psnr_db']:.1f} dB. The mask's shadow "
            "in each light against the geometric one, of a point and of a pixel of the scene; and what one separable "
            "term leaves of it, of frames as they are and centred.",
            ("Light", "Point [%]", "Pixel [%]", "Not separable [1]", "The same, centred [1]"),
            tuple(rows),
            ("shadow.png",),
        )

    def _losses_part(self) -> Part:
        whole, image = sum(row.squared_error for row in self.losses) or np.nan, self.image
        rest = [row for row in self.losses if row.of == error_budget.UNEXPLAINED]
        ordered = sorted((row for row in self.losses if row not in rest), key=lambda row: -row.lost_db)
        rows = [
            (
                _WHERE[row.of],
                DRIFT_WORDS.get(row.source, row.source),
                row.amount,
                with_error(row.lost_db, row.error_db),
                ""
                if row.of == error_budget.DRIFT
                else with_error(100 * row.squared_error / whole, 100 * row.deviation / whole, " %"),
            )
            for row in [*(row for row in ordered if abs(row.lost_db) >= _SAID_DB), *rest]
        ]
        small = ", ".join(row.name for row in ordered if abs(row.lost_db) < _SAID_DB)
        untold = "".join(f" Not predicted: {text}." for text in self.not_predicted)
        others = "".join(f" {_verdict(row).capitalize()}." for row in rest)
        return Part(
            "What an image loses",
            f"The image of this scene under {image['patterns']} has a PSNR of {image['psnr_db']:.2f} dB with "
            f"these factors; all sources together say {image['predicted_psnr_db']:.2f} dB.{others}"
            + ("" if any(row.of == error_budget.DRIFT for row in self.losses) else _NO_DRIFT)
            + untold,
            ("Where", "Source", "Amount", "PSNR lost [dB]", "Part of the error"),
            tuple(rows),
            ("losses.png",),
            (*_LOSS_NOTES, *([f"Below {_SAID_DB:g} dB each: {small}."] if small else [])),
        )

    def _light_part(self) -> Part:
        columns = {"session": self.session, "capture": self.image}
        names = ("frames", "exposure_seconds", "photoelectrons", "photons")
        rows = [
            (where, *(f"{facts[name]:.4g}" for name in names)) for where, facts in columns.items() if "frames" in facts
        ]
        return Part(
            "Light and time",
            "Frames, their exposure without read-out, and what the whole sensor gets in all of them. How much a wanted "
            "PSNR needs: mitsim calibrate SCENE --plan --psnr DB.",
            ("", "Frames", "Exposure [s]", "Photoelectrons", "Photons"),
            tuple(rows),
        )

    def tables(self) -> dict[str, list[dict[str, Any]]]:
        """By file name."""
        return {
            "singular.csv": [asdict(row) for row in self.singular],
            "causes.csv": [asdict(row) for row in self.causes],
            "losses.csv": [asdict(row) for row in self.losses],
        }


# ---- Losses and causes in words ----


def _verdict(row: LossRow) -> str:
    """What is to be said of what is not explained."""
    errors = abs(row.squared_error) / row.deviation if row.deviation else 0.0
    if errors <= 1:
        return "what is not explained is within its standard error"
    size = f"what is not explained is {errors:.1f} of its standard errors"
    if errors <= error_budget.SURE:
        return f"{size}, of which chance makes {math.erfc(errors / math.sqrt(2)):.1%} of all studies see as much"
    return f"{size}: the sources do not make the image's error, and a cause is missing"


def _cause(row: ErrorSourceRow) -> str:
    return _ERROR_SOURCES.get(row.cause, row.cause.replace("-", " "))


def shadow_profiles(profiles: Mapping[str, FloatArray], reach_mm: float) -> Figure:
    """Draw a point's shadows in the middle of the sensor.

    Parameters
    ----------
    profiles, reach_mm
        (pixels,) relative irradiance by light, and the pixels' places [mm]; half of the range that is shown.
    """
    figure, axes = plots.figure_of(0.4 * plots.WIDTH)
    places = profiles[_PLACES]
    inside = np.abs(places - places.mean()) <= reach_mm
    for index, (name, values) in enumerate((name, values) for name, values in profiles.items() if name != _PLACES):
        axes.plot(places[inside], values[inside], lw=1.8, label=name, **plots.line_style(index))
    plots.label_axes(axes, "position on the sensor [mm]", "irradiance, open sensor = 1 [1]")
    axes.legend(fontsize=plots.FONT - 1, frameon=False, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    return figure
