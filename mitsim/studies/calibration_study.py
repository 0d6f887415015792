"""Limits of a calibration session, and of an image that is made with its factors, on one bench.

*entries*, *singular*: factors of noisy frames against those of expected frames. *causes*: residual of a separable
camera without one cause. *models*: factors of models fitted to a few frames. *shadows*: diffraction at the mask.
*losses*: cost of each source in one image.

The squared error E of the image is the sum of parts V. Parts of noise follow from a perturbation of the solver with a
fixed lambda (:mod:`mitsim.studies.causes`). Parts of the scene's light that the factors lack follow from noiseless
frames without one cause after another, less the part that lambda alone removes. The rest of E is unexplained and may
belong to any source. A source costs ``10 log10(E / (E - V))``, the gain of the image without the source; these decibels
do not add up. A drift that adds the squared error A costs ``10 log10((E + A) / E)``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeVar, get_args

import numpy as np

from mitsim.api.bench import Bench
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.request import Exposure
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
from mitsim.devices.patterns import read_name
from mitsim.devices.sensor import digital_of
from mitsim.devices.session import (
    DRIFT_WORDS,
    SIDES,
    BoardShape,
    Drift,
    Model,
    Modelling,
    SessionRecipe,
    amount_in_words,
    load_recipe,
)
from mitsim.light.light import SampledLight
from mitsim.reconstruct.factors import Estimate, Factors, decibels
from mitsim.report.lit_scene import LINE, SPECKLE, IdealCamera, LitScene, lights, point_profiles, shadow_row
from mitsim.report.pages import Value
from mitsim.studies import causes
from mitsim.studies.causes import Ablation, Noise, Scatter, ablations, reform
from mitsim.studies.drift_study import AMBIENT, SESSION, DriftStand, Prediction, squared_error
from mitsim.studies.framework.claims import Judged, measured
from mitsim.studies.framework.experiment import Found, Point, Results, Scope, Study
from mitsim.studies.framework.panels import Bars, Images, Lines, Part
from mitsim.studies.framework.studio import Studio, single_precision

if TYPE_CHECKING:
    from pandas import DataFrame

AnyBench = TypeVar("AnyBench", bound=Apparatus)
Row = dict[str, Value]

# -------- Cost of each source in an image

CAPTURE, SCENE, DRIFT, SOLVER, UNEXPLAINED = "capture", "scene", "drift", "solver", "unexplained"
RENDERING, LAMBDA, REST = "rendering", "lambda and resolution", "all else"
ERROR_SOURCES = MappingProxyType(
    {
        causes.DETAIL: "detail inside projector pixels",
        causes.DEPTH: "depth beside the board's",
        causes.OCCLUSION: "edges that hide pixels from part of the sensor",
        causes.INTERREFLECTION: "light over several surfaces",
        causes.MIRRORS: "light over mirrors",
        causes.GLOSS: "gloss over the sensor",
        causes.BLACK_LEVEL: "light that black pixels leak",
    }
)
"""Effects that factors lack, in the order of their removal."""
SURE = 3.0
"""Standard errors from which the unexplained part is not chance."""
_LEAST_LEFT = 1e-9


@dataclass(frozen=True)
class LossRow:
    """Loss of an image [dB] by a ``source`` of noise or a drift of an ``amount``; ``squared_error`` is the source's,
    mean over the image, negative where the image is worse without it.
    """

    of: str
    source: str
    amount: str
    lost_db: float
    error_db: float
    squared_error: float = 0.0
    deviation: float = 0.0

    @property
    def name(self) -> str:
        if self.of == UNEXPLAINED:
            return self.source
        what = DRIFT_WORDS.get(self.source, self.source) if self.of == DRIFT else f"{self.of}: {self.source}"
        return f"{what}, {self.amount}" if self.amount else what


@dataclass(frozen=True)
class Share:
    square: float
    deviation: float = 0.0


@dataclass(frozen=True, eq=False)
class Budget:
    parts: dict[tuple[str, str], Share]
    scatter: Scatter
    drawn: Noise
    steady: FloatArray


def losses(stand: DriftStand, lit: LitSession, clear: Factors) -> tuple[list[LossRow], list[str]]:
    budget = _budget(stand, lit, clear)
    measured, explained = squared_error(stand.before_db), sum(part.square for part in budget.parts.values())
    found = [
        LossRow(
            of, source, "", *gain_without(part.square, measured, explained, part.deviation), part.square, part.deviation
        )
        for (of, source), part in budget.parts.items()
    ]
    pixels = budget.steady.size
    found.append(_unexplained_row(measured, explained, budget.scatter.deviation(budget.drawn, budget.steady) / pixels))
    rows, refused = _drifts(stand, budget, measured)
    return found + rows, refused


def _drifts(stand: DriftStand, budget: Budget, measured: float) -> tuple[list[LossRow], list[str]]:
    """Return rows of drifts, and reasons why some were not predicted.

    The model's drift does not move light that the model lacks, so that all common parts of both errors are uncertain.
    """
    still, found, refused = stand.expected_image(Drift()), list[LossRow](), list[str]()
    target, scene, pixels = still.image - budget.steady, stand.lit.truth, budget.steady.size
    for kind in stand.recipe.drift.kinds:
        drift = stand.recipe.drift.alone(kind)
        try:
            moved = stand.expected_image(drift)
        except MitsimError as error:
            refused.append(f"{kind}: {error}")
            continue
        lost, apart = (
            Prediction(stand.before_db, still.psnr_db(truth), moved.psnr_db(truth)).predicted_lost_db
            for truth in (target, scene)
        )
        # Noise that happens to resemble the effect of the drift, and the draw of random drifts.
        alike = budget.scatter.common(budget.drawn, moved.image - still.image) / pixels
        chance = math.hypot(alike, math.sqrt(stand.scatter(drift, budget.steady))) / measured
        sure = math.hypot(lost - apart, 10 * math.log10(1 + chance / 10 ** (lost / 10)))
        amount = amount_in_words(kind, getattr(stand.recipe.drift, kind))
        found.append(LossRow(DRIFT, kind, amount, lost, sure))
    return found, refused


def _unexplained_row(measured: float, explained: float, chance: float) -> LossRow:
    left = measured - explained
    lost = _decibels(left / measured)
    error = abs(_decibels((left + chance) / measured) - lost)
    return LossRow(UNEXPLAINED, "not explained", "", lost, error, left, chance)


def _budget(stand: DriftStand, lit: LitSession, clear: Factors) -> Budget:
    scene, noises = stand.lit.truth, _noises(stand, lit)
    pixels, found = scene.size, dict[tuple[str, str], Share]()
    exact = replace(stand.linear, left=clear.left, right=clear.right)
    sampled = sum((noise for (_, name), noise in noises.items() if name == RENDERING), Noise())
    drawn = sum(noises.values(), Noise()) - sampled
    seen = dict(_clear_images(stand, clear))
    whole = next(iter(seen.values()))
    steady = whole + sum(stand.fixed.values(), np.zeros_like(scene)) - scene
    scatter = Scatter(exact, scene)
    for source, noise in noises.items():
        among = drawn + (noise if source[1] == RENDERING else Noise())
        found[source] = Share(
            stand.linear.variance(scene, noise) / pixels, scatter.share(noise, among, steady) / pixels
        )
    off = whole - scene
    for name, error in stand.fixed.items():
        found[CAPTURE, name] = Share(_square(off + error) - _square(off))
        off = off + error
    found |= _of_scene(scatter, seen, sampled)
    return Budget(found, scatter, drawn, off)


def _clear_images(stand: DriftStand, clear: Factors) -> Iterator[tuple[str, FloatArray]]:
    scene_ablation, off = Ablation.of(stand.lit.light), frozenset[str]()
    yield "", stand.clear(clear, stand.lit.light)
    for name in ERROR_SOURCES:
        if name in scene_ablation.effects:
            off |= {name}
            yield name, stand.clear(clear, scene_ablation.without(off))


def _of_scene(scatter: Scatter, seen: Mapping[str, FloatArray], sampled: Noise) -> dict[tuple[str, str], Share]:
    """Return the shares of a scene's light by cause, and of lambda."""
    exact, scene, found = scatter.solver, scatter.scene, {(SCENE, ERROR_SOURCES[causes.DETAIL]): Share(0.0)}
    (_, last), *others = seen.items()
    for name, image in others:
        moved = scatter.common(sampled, last - image) / scene.size
        found[SCENE, ERROR_SOURCES[name]] = Share(_square(last - scene) - _square(image - scene), moved)
        last = image
    bias = _square(exact.expected_image(scene).image - scene)
    rest = _square(last - scene) - bias - exact.variance(scene, sampled) / scene.size
    found[SCENE, REST] = Share(rest, scatter.deviation(sampled, last - scene) / scene.size)
    found[SOLVER, LAMBDA] = Share(bias)
    return found


def _square(error: FloatArray) -> float:
    return float(np.square(error).mean())


def gain_without(part: float, measured: float, explained: float, deviation: float = 0.0) -> tuple[float, float]:
    """Return the gain of an image without a source [dB], and its standard error, from squared errors."""
    most = max(measured, explained)
    lost = _decibels(part / most)
    chance = abs(_decibels((part + deviation) / most) - lost)
    if measured >= explained:
        return lost, math.hypot(chance, _decibels(part / explained if explained else 0.0) - lost)
    # The prediction exceeds the measurement, by this source at most.
    return lost, math.hypot(chance, _decibels(max(part - (explained - measured), 0.0) / measured) - lost)


def _decibels(part: float) -> float:
    return -10 * math.log10(max(1 - part, _LEAST_LEFT)) if part else 0.0


def _noises(stand: DriftStand, lit: LitSession) -> Mapping[tuple[str, str], Noise]:
    found = dict[tuple[str, str], Noise]()
    for name, noise in stand.noises.items():
        if name != SESSION and (name not in (AMBIENT, SPECKLE) or noise != Noise()):
            found[CAPTURE, name] = noise
    light, factors = stand.lit.light, (stand.factors.left, stand.factors.right)
    # The truth's own sampling is in the error as much as that of the light.
    sampled = light.apparent.error_of(light.flux_error) ** 2 + light.apparent.error**2
    found[CAPTURE, RENDERING] = Noise(light=sampled)
    left, right = (entry_variances(lit, factors, side) for side in SIDES)
    for source, variance in left.items():
        found[SESSION, source] = Noise(left=float(variance.mean()), right=float(right[source].mean()))
    found[SESSION, RENDERING] = session_rendering(lit.light.flux, lit.light.flux_error, factors)
    return found


def session_rendering(flux: FloatArray, flux_error: FloatArray, factors: tuple[FloatArray, FloatArray]) -> Noise:
    """Return the noise that sampling of a session's light leaves in its ``factors``.

    Where pixel (x, y) of the board is lit by 1 + e_xy of its light, column x of the left factor is multiplied by
    1 + sum_y e_xy w_y, w_y = Phi_R(y) . v / |v|^2, v the sum of all columns of Phi_R. ``flux`` and ``flux_error``
    (n^2,) are of each projector pixel.
    """
    lit = flux > 0
    error = float(np.mean(np.square(flux_error[lit] / flux[lit]))) if lit.any() else 0.0
    spread = []
    for factor in factors:
        common = factor.sum(axis=1)
        spread.append(float(np.square(common @ factor / np.dot(common, common)).sum()))
    return Noise(left_light=error * spread[1], right_light=error * spread[0])


def entry_variances(lit: LitSession, factors: tuple[FloatArray, FloatArray], side: str) -> dict[str, FloatArray]:
    """Return the predicted variance (m, n) of the entries of the factor of a ``side``, by source.

    u_i = Y_i v / |v|^2 has the variance sum_c V_rc v_c^2 / |v|^4 in row r, V being that of a response's pixels, and U
    H^T / N averages N of them with signs. Noise that all responses share enters column p by the mean of its signs:
    fully where they are all +1, and not at all elsewhere.
    """
    signs, common = lit.session.signs, (factors[1] if side == SIDES[0] else factors[0]).sum(axis=1)

    def spread(part: FloatArray) -> FloatArray:
        variance = np.broadcast_to(part, lit.uniform_rate.shape)
        weights = np.square(common) / np.dot(common, common) ** 2
        return np.asarray((variance if side == SIDES[0] else variance.T) @ weights)

    own, shared = lit.response_variances(side)
    even, first = np.full(len(signs), 1 / signs.shape[1]), np.square(signs.mean(axis=1))
    return {source: np.outer(spread(own[source]), even) + np.outer(spread(shared[source]), first) for source in own}


# -------- The study


def as_built(bench: AnyBench) -> AnyBench:
    camera = bench.geometry
    changed = camera.model_copy(update={name: getattr(camera, name) + off for name, off in OFF_MM.items()})
    return replace(bench, devices=replace(bench.devices, camera=changed))


OFF_MM = {"mask_distance": 0.05, "mask_offset_row": 0.037, "mask_offset_column": -0.021}
"""Placement errors of a mask that is glued on by hand."""
_MODEL_FRAMES = (2, 16)
_FORMED = frozenset({"diffraction", "mask-thickness", "black-level"})
_PROFILE_MM, _SAID_DB = 0.7, 0.005
"""Half range of a point's shadow: a dozen mask features; least loss that is drawn."""


def measure_session(
    bench: Bench, recipe: SessionRecipe, patterns: str, seed: int, accuracy: float
) -> tuple[list[Row], dict[str, FloatArray]]:
    job, family = Job(), bench.family(patterns, seed)
    Exposure(None, recipe.exposure_fraction).check(bench.sensor, bench.devices.camera_file)
    session = Session(bench, recipe.model_copy(update={"drift": Drift()}), seed)
    lit = LitSession.of(session, session.trace(session.plan(accuracy, job), job), job)
    (noisy, clean), _, _ = estimates(lit, job, (NOISY, NOISE_FREE))
    rows, maps = judge_session(lit, noisy, clean)
    rows += residuals(lit, noisy, clean, job)
    scene = LitScene(bench.light(patterns, job, accuracy=accuracy, seed=seed))
    stand = DriftStand(scene, _factors(lit, noisy), recipe, family, seed)
    lost, refused = losses(stand, lit, _factors(lit, clean))
    rows += [{"kind": "losses", **asdict(row), "name": row.name} for row in lost]
    left, right = IdealCamera(bench, bench.geometry.mask).calibrated(scene.board_flux)
    geometric = replace(stand, factors=replace(stand.factors, left=left, right=right)).before_db
    explained = sum(row.squared_error for row in lost if row.of != UNEXPLAINED)
    doubts = [f"losses: {verdict_of(row)}" for row in lost if row.of == UNEXPLAINED and _is_missing(row)]
    frames, electrons = len(family.shots), stand.electrons
    rows.append({
        "kind": "image", "psnr_db": stand.before_db, "predicted_psnr_db": -decibels(np.sqrt(explained)),
        "geometric_psnr_db": geometric, "frames": frames, "exposure_seconds": frames * stand.exposure_s,
        "photoelectrons": electrons, "photons": electrons / (bench.sensor.quantum_efficiency or np.nan),
        "flagged": bool(doubts), "reason": "; ".join(doubts),
    })  # fmt: skip
    models, unfitted = fit_models(lit, stand)
    rows += models + compare_shadows(bench)
    return rows + [{"kind": "not predicted", "reason": text} for text in (*refused, *unfitted)], maps


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


def fit_models(lit: LitSession, stand: DriftStand) -> tuple[list[Row], list[str]]:
    rows: list[Row] = []
    refused, planned = [], as_built(lit.session.bench)
    for model, wanted in product(get_args(Model), _MODEL_FRAMES):
        modelling = Modelling(model, wanted)
        try:
            camera, (shown, frames) = model_of(planned, model), simulate_responses(lit, modelling)
            placement = fit_placement(camera, shown, modelling.free)
        except MitsimError as error:  # no model is of this mask, or the frames can't tell its parameters apart
            refused.append(f"image of a {model} model of {wanted} frames ({error})")
            continue
        factors = modelled_factors(camera, placement, frames, stand.factors.manifest, Job())
        psnr_db = replace(stand, factors=factors).before_db
        unexplained = float(factors.manifest.result["unexplained_residual"])
        rows.append(
            {"kind": "models", "model": model, "frames": frames, "psnr_db": psnr_db, "unexplained": unexplained}
        )
    return rows, refused


def compare_shadows(bench: Bench) -> list[Row]:
    cameras = {name: IdealCamera(bench, bench.geometry.mask, spectrum) for name, spectrum in lights(bench).items()}
    rows: list[Row] = [{"kind": "shadows", **shadow_row(name, cameras)} for name in cameras]
    places = np.asarray(bench.geometry.centres(0))
    inside = np.abs(places - places.mean()) <= _PROFILE_MM
    for name, values in point_profiles(bench).items():
        if name != LINE:  # it coincides with that of the projector's lines, to the width of a plotted line
            rows += [
                {"kind": "profile", "light": name, "place_mm": float(place), "irradiance": float(value)}
                for place, value in zip(places[inside], values[inside], strict=True)
            ]
    return rows


@single_threaded_blas()
def judge_session(lit: LitSession, noisy: Estimate, clean: Estimate) -> tuple[list[Row], dict[str, FloatArray]]:
    rows, maps = [session_cost(lit, noisy, clean)], {}
    pairs = zip(FACTORS, SIDES, (clean.left, clean.right), (noisy.left, noisy.right), strict=True)
    for name, side, exact, found in pairs:
        # Factors are known up to a common scale and sign; this one is not drawn towards zero by the noise.
        found = found * (np.vdot(exact, exact) / np.vdot(found, exact))
        variances = entry_variances(lit, (clean.left, clean.right), side)
        deviation = np.asarray(np.sqrt(sum(variances.values(), np.zeros(1))))
        off = maps[name] = (found - exact) / deviation
        norm = float(np.linalg.norm(exact))
        rows.append({
            "kind": "entries", "factor": name, "error": float(np.linalg.norm(found - exact)) / norm,
            "predicted_error": float(np.linalg.norm(deviation)) / norm, "largest": float(np.abs(off).max()),
            "chi_square": float(np.square(off).mean()),
        })  # fmt: skip
        rows += [{"kind": "singular", "factor": name, **row} for row in singular_rows(exact, found, deviation)]
    return rows, maps


def singular_rows(exact: FloatArray, found: FloatArray, deviation: FloatArray) -> Iterator[Row]:
    """Yield singular values and vectors of a factor with noise (``found``) beside those without (``exact``).

    With a_jk = u_j^T E v_k, to first order s_k moves by a_kk, to second order by the mean of sum_j (s_k (a_jk^2 +
    a_kj^2) + 2 s_j a_jk a_kj) / (2 (s_k^2 - s_j^2)) + |(1 - U U^T) E v_k|^2 / (2 s_k), and v_k turns by the root of
    sum_j (s_k a_kj + s_j a_jk)^2 / (s_k^2 - s_j^2)^2 (Stewart and Sun 1990, Matrix Perturbation Theory, chapter V).
    Gaps between values must exceed their errors. ``deviation`` (m, n) is of independent entries.
    """
    left, values, right = np.linalg.svd(exact, full_matrices=False)
    _, noisy, turned = np.linalg.svd(found, full_matrices=False)
    variance = np.square(deviation)
    # Means of a_jk^2 and of a_jk a_kj, at [j, k]; and of the part outside the span of U, by k.
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
        error = float(np.sqrt(squares[number, number]))
        yield {
            "number": number, "value": float(value), "noisy": float(noisy[number]), "standard_error": error,
            "bias": bias, "off": float((noisy[number] - value - bias) / error),
            "predicted_angle": min(angle, float(np.pi / 2)),
            "angle": float(np.arccos(min(abs(float(np.dot(right[number], turned[number]))), 1.0))),
        }  # fmt: skip


def session_cost(lit: LitSession, noisy: Estimate, clean: Estimate) -> Row:
    recipe, order = lit.session.recipe, len(lit.session.order)
    lit_s = sum(lit.exposures_s) * recipe.repeats
    # Shots of uniform light: both of a pair together are one.
    uniform = order / 2 if lit.session.pairs else 2 + (order - 2) * lit.session.lit_lines
    electrons = float(lit.uniform_rate.sum()) * uniform * lit_s
    return {
        "kind": "session",
        "frames": lit.session.shots,
        "exposure_seconds": order * lit_s + recipe.dark_frames * sum(lit.exposures_s),
        "photoelectrons": electrons,
        "photons": electrons / (lit.session.bench.sensor.quantum_efficiency or np.nan),
        "separability_residual": noisy.separability_residual,
        "noise_free_residual": clean.separability_residual,
    }


def residuals(lit: LitSession, noisy: Estimate, clean: Estimate, job: Job) -> Iterator[Row]:
    whole, simulation, session = clean.separability_residual, lit.light.simulation, lit.session

    def without(session: Session, light: SampledLight) -> float:
        return estimate(LitSession.of(session, light, job), job, noise_free=True)[0].separability_residual

    yield residual_row("noise", noisy.separability_residual, whole)
    for name, settings in ablations(simulation.settings, simulation.settings.effects):
        if name in _FORMED:
            light = reform(lit.light, frozenset({name}))
        else:
            light = session.trace(replace(lit.light.plan, settings=settings), job)
        yield residual_row(name, whole, without(session, light))
    if session.recipe.board != BoardShape():
        flat = replace(session, recipe=session.recipe.model_copy(update={"board": BoardShape()}))
        yield residual_row("board", whole, without(flat, flat.trace(lit.light.plan, job)))


def residual_row(cause: str, residual: float, left: float) -> Row:
    """Return the row of a ``cause`` with the signed root of the difference of squared residuals."""
    less = residual**2 - left**2
    return {"kind": "causes", "cause": cause, "residual": left, "part": float(np.copysign(np.sqrt(abs(less)), less))}


def _is_missing(row: LossRow) -> bool:
    return abs(row.squared_error) > SURE * row.deviation


def verdict_of(row: LossRow) -> str:
    errors = abs(row.squared_error) / row.deviation if row.deviation else 0.0
    if errors <= 1:
        return "what is not explained is within its standard error"
    size = f"what is not explained is {errors:.1f} of its standard errors"
    if errors <= SURE:
        return f"{size}, of which chance makes {math.erfc(errors / math.sqrt(2)):.1%} of all studies see as much"
    return f"{size}: the sources do not make the image's error, and a cause is missing"


def _points(scope: Scope) -> list[Point]:
    read_name(scope.patterns)
    recipe = load_recipe(None if scope.recipe is None else Path(scope.recipe))
    if recipe.depths:
        raise MitsimError(
            f"study calibration: the recipe has {len(recipe.depths)} depths, and a report is of one session; leave "
            "depths out, and move the board's plane by -D or the scene's scene_distance"
        )
    return [Point.of(scope.setup, recipe=scope.recipe, patterns=scope.patterns, seed=scope.seeds[0])]


def _measure(studio: Studio, point: Point) -> Found:
    recipe = load_recipe(None if point["recipe"] is None else Path(point["recipe"]))
    asked = str(point["patterns"]), int(point["seed"]), point.setup.accuracy
    rows, maps = measure_session(studio.bench(point.setup), recipe, *asked)
    shown = {name: 0.5 + off / (2 * _SHOWN_DEVIATIONS) for name, off in maps.items()}
    return Found(tuple(point.row(**row) for row in rows), single_precision(shown))


_SHOWN_DEVIATIONS = 4.0
_TABLES = {
    "losses": ("What an image loses", "of source amount lost_db error_db squared_error deviation"),
    "session": (
        "Light and time of the session",
        "frames exposure_seconds photoelectrons photons separability_residual",
    ),
    "image": (
        "Light and time of the image",
        "psnr_db predicted_psnr_db geometric_psnr_db frames exposure_seconds photons",
    ),
    "entries": ("Errors of the factors", "factor error predicted_error chi_square largest"),
    "causes": ("What is not separable", "cause residual part"),
    "models": ("How few frames suffice", "model frames psnr_db unexplained"),
    "shadows": ("Diffraction at the mask", "light point_source scene_pixel separability separability_centred"),
    "not predicted": ("Not predicted", "reason"),
}


def _tables(results: Results) -> list[Part]:
    rows = sorted(results.rows, key=lambda row: -float(str(row.get("lost_db") or 0)))
    shown = {
        kind: [tuple(_text(row.get(name)) for name in columns.split()) for row in rows if row["kind"] == kind]
        for kind, (_, columns) in _TABLES.items()
    }
    return [
        Part(title, "", tuple(name.replace("_", " ") for name in columns.split()), tuple(shown[kind]))
        for kind, (title, columns) in _TABLES.items()
        if shown[kind]
    ]


def _text(value: Value) -> str:
    return (
        f"{value:.4g}" if isinstance(value, float) else DRIFT_WORDS.get(str(value), "" if value is None else str(value))
    )


def _explained(rows: DataFrame) -> tuple[str, bool | None]:
    (row,) = (LossRow(*(row[name] for name in _LOSS)) for row in rows.to_dict("records"))
    return verdict_of(row), not _is_missing(row)


_LOSS = ("of", "source", "amount", "lost_db", "error_db", "squared_error", "deviation")


def _as_predicted(rows: DataFrame) -> tuple[str, bool]:
    chi = rows["chi_square"].astype(float)
    return f"chi-square of an entry {chi.min():.3f} to {chi.max():.3f}", bool((abs(chi - 1) < 0.1).all())


STUDY = Study(
    "calibration",
    "What limits a calibration session and its image",
    "How far off are a session's factors, and what does each source of error cost an image?",
    points=_points,
    measure=_measure,
    claims=(
        Judged(
            "All sources together make the image's squared error", _explained,
            where={"kind": "losses", "of": UNEXPLAINED},
        ),
        Judged("Errors of the factors are as large as the noise predicts", _as_predicted, where={"kind": "entries"}),
    ),
    panels=(
        Bars(
            "name", file="losses", x="lost_db", x_label="PSNR lost [dB]", colour="of", ordered=True,
            where={"kind": "losses", "lost_db": lambda lost: measured(lost) and abs(lost) >= _SAID_DB},
            errors={"lost_db": "error_db"},
        ),
        Images(
            {name: (f"{name} factor", "") for name in FACTORS}, file="entries", down=("kind",),
            where={"kind": "session"},
            title=f"Errors of the factors' entries, black to white: {_SHOWN_DEVIATIONS:g} predicted deviations",
        ),
        Lines(
            "number", "number of the singular value [1]", file="singular", y="off", colour="factor", facet="",
            y_label="error beyond the bias [standard errors]", where={"kind": "singular"}, ticks=False,
        ),
        Bars(
            "cause", file="causes", x="part", colour="kind", x_label="part of the separability residual [1]",
            where={"kind": "causes", "part": lambda part: measured(part) and part > 0},
        ),
        Lines(
            "place_mm", "position on the sensor [mm]", file="shadow", y="irradiance", colour="light", facet="",
            y_label="irradiance, open sensor = 1 [1]", where={"kind": "profile"}, ticks=False,
        ),
    ),
    tables=(_tables,),
    about="Losses by noise, light of the scene and solver are the image's gain without that source; below 0, the "
    "image would be worse without it. Squared errors add up, decibels do not. Losses by drift between calibration and "
    "capture, by the amounts of the recipe's table [drift], are of each drift alone. Noise and drift are predicted "
    "with lambda as it is; light of the scene is found from frames without noise. Noise is drawn once, and what is not "
    "explained may belong to any source. Rendering is the simulation's own sampling, which no camera has. Models start "
    "from a plan whose mask is off by 50, 37 and -21 um; their frames have the wave model's shadow.",
    heads=("", "", "Found"),
)  # fmt: skip
