"""Limits of a calibration session, and of an image that is made with its factors, on one bench.

*entries*: factors of noisy frames against those of expected frames. *losses*: cost of each source in one image.

The squared error E of the image is the sum of parts V. Parts of noise follow from a perturbation of the solver with a
fixed lambda (:mod:`mitsim.studies.causes`). Parts of the scene's light that the factors lack follow from noiseless
frames without one cause after another, less the part that lambda alone removes. The rest of E is unexplained and may
belong to any source. A source costs ``10 log10(E / (E - V))``, the gain of the image without the source; these decibels
do not add up. The loss by a drift after the session is measured by :mod:`mitsim.studies.drift_study`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsim.bench.request import Exposure
from mitsim.calibrate.board_session import LitSession, Session, manifest_of
from mitsim.calibrate.calibrate import NOISE_FREE, NOISY, estimates
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.core.manifests import SIDES as FACTORS
from mitsim.core.parallel import single_threaded_blas
from mitsim.devices.patterns import read_name
from mitsim.devices.sensor import digital_of
from mitsim.devices.session import SIDES, Drift, load_recipe
from mitsim.reconstruct.factors import Estimate, Factors, decibels
from mitsim.report.lit_scene import SPECKLE, IdealCamera, LitScene
from mitsim.studies import waterfall_study as waterfall
from mitsim.studies.causes import Noise, Scatter
from mitsim.studies.drift_study import AMBIENT, SESSION, DriftStand, squared_error
from mitsim.studies.framework.claims import Judged, measured
from mitsim.studies.framework.experiment import Found, Point, Results, Scope, Study
from mitsim.studies.framework.panels import Bars, Part
from mitsim.studies.framework.studio import Studio

if TYPE_CHECKING:
    from pandas import DataFrame

Row = dict[str, Any]

# -------- Cost of each source in an image

CAPTURE, SCENE, SOLVER, UNEXPLAINED = "capture", "scene", "solver", "unexplained"
RENDERING, LAMBDA, REST = "rendering", "lambda and resolution", "all else"
ERROR_SOURCES = {
    "interreflection": "light over several surfaces",
    "mirrors": "light over mirrors",
    "black-level": "light that black pixels leak",
    waterfall.SCENE: "depth, gloss, edges and detail",
}
"""Effects that factors lack, in the order of their removal."""
SURE = 3.0
"""Standard errors from which the unexplained part is not chance."""
_LEAST_LEFT = 1e-9


def losses(stand: DriftStand, lit: LitSession, clear: Factors) -> list[Row]:
    """Return the loss [dB] by each source of error, and by the rest that no source explains.

    ``squared_error`` is the source's, mean over the image, negative where the image is worse without the source.
    """

    def row(of: str, source: str, lost: tuple[float, float], square: float, deviation: float) -> Row:
        name = source if of == UNEXPLAINED else f"{of}: {source}"
        found = {"lost_db": lost[0], "error_db": lost[1], "squared_error": square, "deviation": deviation}
        return {"kind": "losses", "of": of, "source": source, **found, "name": name}

    scene, light, noises = stand.lit.truth, stand.lit.light, noises_of(stand, lit)
    exact = replace(stand.linear, left=clear.left, right=clear.right)
    pixels, scatter = scene.size, Scatter(exact, scene)
    sampled = sum((noise for (_, name), noise in noises.items() if name == RENDERING), Noise())
    drawn = sum(noises.values(), Noise()) - sampled
    # Images of the scene's light without noise: whole, and without one cause after another.
    ablation, off, seen = waterfall.Ablation(light), frozenset[str](), [stand.clear(clear, light)]
    removed = [name for name in ERROR_SOURCES if name in ablation.effects]
    for name in removed:
        off |= {name}
        seen.append(stand.clear(clear, ablation.without(off)))
    steady = seen[0] + sum(stand.fixed.values(), np.zeros_like(scene)) - scene

    parts = dict[tuple[str, str], tuple[float, float]]()  # squared errors and their standard deviations
    for source, noise in noises.items():
        among = drawn + (noise if source[1] == RENDERING else Noise())
        parts[source] = stand.linear.variance(scene, noise) / pixels, scatter.share(noise, among, steady) / pixels
    error = seen[0] - scene
    for name, more in stand.fixed.items():
        parts[CAPTURE, name] = _square(error + more) - _square(error), 0.0
        error = error + more
    parts[SCENE, ERROR_SOURCES[waterfall.SCENE]] = 0.0, 0.0
    for name, before, after in zip(removed, seen, seen[1:], strict=False):
        moved = scatter.common(sampled, before - after) / pixels
        parts[SCENE, ERROR_SOURCES[name]] = _square(before - scene) - _square(after - scene), moved
    bias, left = _square(exact.expected_image(scene).image - scene), seen[-1] - scene
    rest = _square(left) - bias - exact.variance(scene, sampled) / pixels
    parts[SCENE, REST] = rest, scatter.deviation(sampled, left) / pixels
    parts[SOLVER, LAMBDA] = bias, 0.0

    whole, explained = squared_error(stand.before_db), sum(square for square, _ in parts.values())
    left_over, chance = whole - explained, scatter.deviation(drawn, steady) / pixels
    lost = _decibels(left_over / whole)
    rest_lost = lost, abs(_decibels((left_over + chance) / whole) - lost)
    return [
        *(
            row(*source, gain_without(square, whole, explained, deviation), square, deviation)
            for source, (square, deviation) in parts.items()
        ),
        row(UNEXPLAINED, "not explained", rest_lost, left_over, chance),
    ]


def judge_rest(squared_error: float, deviation: float) -> tuple[str, bool]:
    """Return a sentence on the squared error that no source explains, and True if chance may have caused it."""
    errors = abs(squared_error) / deviation if deviation else 0.0
    size = f"the unexplained part is {errors:.1f} of its standard errors"
    if abs(squared_error) > SURE * deviation:
        return f"{size}: the sources do not make the image's error, and a cause is missing", False
    return size, True


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


def noises_of(stand: DriftStand, lit: LitSession) -> Mapping[tuple[str, str], Noise]:
    """Return the noise of capture and session by its source."""
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
    """Return the predicted variance (m, n) of the entries in one ``side``'s factor, by source.

    u_i = Y_i v / |v|^2 has the variance sum_c V_rc v_c^2 / |v|^4 in row r, V being that of a response's pixels, and U
    H^T / N averages N of them with signs. Noise that all responses share enters column p by the mean of its signs:
    fully where they are all +1, and not at all elsewhere.
    """
    signs, common = lit.session.signs, (factors[1] if side == SIDES[0] else factors[0]).sum(axis=1)

    def spread(part: FloatArray) -> FloatArray:
        variance = np.broadcast_to(part, lit.uniform_rate.shape)
        weights = np.square(common) / np.dot(common, common) ** 2
        return np.asarray((variance if side == SIDES[0] else variance.T) @ weights)

    own, shared = lit.response_variances()
    even, first = np.full(len(signs), 1 / signs.shape[1]), np.square(signs.mean(axis=1))
    return {source: np.outer(spread(own[source]), even) + np.outer(spread(shared[source]), first) for source in own}


# -------- The study

_SAID_DB = 0.005
"""Least loss that is drawn."""


@single_threaded_blas()
def judge_factors(lit: LitSession, noisy: Estimate, clean: Estimate) -> list[Row]:
    """Return errors of each factor beside their prediction, and those of its entries in predicted deviations."""
    rows = list[Row]()
    pairs = zip(FACTORS, SIDES, (clean.left, clean.right), (noisy.left, noisy.right), strict=True)
    for name, side, exact, found in pairs:
        # Factors are known up to a common scale and sign; this one is not drawn towards zero by the noise.
        found = found * (np.vdot(exact, exact) / np.vdot(found, exact))
        variances = entry_variances(lit, (clean.left, clean.right), side)
        deviation = np.asarray(np.sqrt(sum(variances.values(), np.zeros(1))))
        off = (found - exact) / deviation
        norm = float(np.linalg.norm(exact))
        rows.append({
            "kind": "entries", "factor": name, "error": float(np.linalg.norm(found - exact)) / norm,
            "predicted_error": float(np.linalg.norm(deviation)) / norm, "largest": float(np.abs(off).max()),
            "chi_square": float(np.square(off).mean()),
        })  # fmt: skip
    return rows


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
    bench, recipe = studio.bench(point.setup), load_recipe(None if point["recipe"] is None else Path(point["recipe"]))
    job, seed, accuracy = Job(), int(point["seed"]), point.setup.accuracy
    family = bench.family(point["patterns"], seed)
    Exposure(None, recipe.exposure_fraction).check(bench.sensor, bench.devices.camera_file)
    session = Session(bench, recipe.model_copy(update={"drift": Drift()}), seed)
    lit = LitSession.of(session, session.trace(session.plan(accuracy, job), job)[0], job)
    (noisy, clean), _, _ = estimates(lit, job, (NOISY, NOISE_FREE))
    digital, depth = digital_of(bench.sensor, lit.exposure_s), bench.geometry.scene_distance
    manifest = manifest_of(bench, digital, recipe.board_reflectance, depth)
    scene = LitScene(bench.light(point["patterns"], job=job, accuracy=accuracy, seed=seed))
    stand = DriftStand(scene, Factors.of(noisy, manifest), recipe, family, seed)
    *lost, rest = losses(stand, lit, Factors.of(clean, manifest))
    left, right = IdealCamera(bench, bench.geometry.mask).calibrated(scene.board_flux)
    geometric = replace(stand, factors=replace(stand.factors, left=left, right=right)).before_db
    words, by_chance = judge_rest(rest["squared_error"], rest["deviation"])
    session_row: Row = {
        "kind": "session", "frames": session.shots,
        "exposure_seconds": len(session.order) * (lit.exposure_s * recipe.repeats),
        "separability_residual": noisy.separability_residual, "noise_free_residual": clean.separability_residual,
    }  # fmt: skip
    image_row: Row = {
        "kind": "image", "psnr_db": stand.before_db,
        "predicted_psnr_db": -decibels(np.sqrt(sum(row["squared_error"] for row in lost))),
        "geometric_psnr_db": geometric, "frames": len(family.shots),
        "exposure_seconds": len(family.shots) * stand.exposure_s, "flagged": not by_chance,
        "reason": "" if by_chance else f"losses: {words}",
    }  # fmt: skip
    rows = [session_row, *judge_factors(lit, noisy, clean), *lost, rest, image_row]
    return Found(tuple(point.row(**row) for row in rows))


_TABLES = {
    "losses": ("What an image loses", "of source lost_db error_db squared_error deviation"),
    "session": ("The session", "frames exposure_seconds separability_residual noise_free_residual"),
    "image": ("The image", "psnr_db predicted_psnr_db geometric_psnr_db frames exposure_seconds"),
    "entries": ("Errors of the factors", "factor error predicted_error chi_square largest"),
}


def _tables(results: Results) -> list[Part]:
    rows, found = sorted(results.rows, key=lambda row: -float(str(row.get("lost_db") or 0))), list[Part]()
    for kind, (title, columns) in _TABLES.items():
        values = [[row.get(name) for name in columns.split()] for row in rows if row["kind"] == kind]
        cells = (tuple(f"{each:.4g}" if isinstance(each, float) else str(each) for each in line) for line in values)
        found.append(Part(title, "", tuple(name.replace("_", " ") for name in columns.split()), tuple(cells)))
    return found


def _explained(rows: DataFrame) -> tuple[str, bool]:
    (row,) = rows.to_dict("records")
    return judge_rest(row["squared_error"], row["deviation"])


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
    ),
    tables=(_tables,),
    about="A loss is the image's gain without that source; below 0, the image would be worse without it. Squared "
    "errors add up, decibels do not. Noise is predicted with lambda as it is; light of the scene is found from frames "
    "without noise. Noise is drawn once, and what is not explained may belong to any source. Rendering is the "
    "simulation's own sampling. Geometric is the image with factors of the mask's geometric shadow. The recipe's "
    "drift is left out of this session: mitsim study drift measures its loss.",
    heads=("", "", "Found"),
)  # fmt: skip
