"""Limits of a calibration session, and of an image that is made with its factors, on one bench.

*entries*: factors of noisy frames against those of expected frames. *losses*: cost of each source in one image.

The squared error E of the image is the sum of parts V. With lambda fixed the solver is linear, so that parts of noise,
and how much one image's error scatters, follow from draws of the noise in the solver's data. Parts of the scene's light
that the factors lack follow from noiseless frames without one cause after another, less the part that lambda alone
removes. The rest of E is unexplained and may
belong to any source. A source costs ``10 log10(E / (E - V))``, the gain of the image without the source; these decibels
do not add up. The loss by a drift after the session is measured by :mod:`mitsim.studies.drift_study`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsim.acquire.exposure import ambient_shots, takes_ambient_frame
from mitsim.bench.request import Exposure
from mitsim.calibrate.board_session import LitSession, Session, entry_variances, manifest_of
from mitsim.calibrate.calibrate import NOISE_FREE, NOISY, estimates
from mitsim.core.arrays import FloatArray
from mitsim.core.job import Job
from mitsim.core.manifests import SIDES as FACTORS
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import stream
from mitsim.devices.patterns import read_name
from mitsim.devices.sensor import digital_of
from mitsim.devices.session import Drift, load_recipe
from mitsim.reconstruct.accumulation import pattern_response
from mitsim.reconstruct.factors import Estimate, Factors, decibels
from mitsim.reconstruct.solver import Pair, Prepared
from mitsim.report.lit_scene import NONUNIFORMITY, SPECKLE, IdealCamera, LitScene
from mitsim.sensor.chain import specimen
from mitsim.studies import waterfall_study as waterfall
from mitsim.studies.drift_study import DriftStand
from mitsim.studies.framework.claims import Judged, measured
from mitsim.studies.framework.experiment import Found, Point, Results, Scope, Study
from mitsim.studies.framework.panels import Bars, Part
from mitsim.studies.framework.studio import Studio

if TYPE_CHECKING:
    from pandas import DataFrame

Row = dict[str, Any]

# -------- Cost of each source in an image

CAPTURE, SESSION, SCENE, SOLVER, UNEXPLAINED = "capture", "session", "scene", "solver", "unexplained"
AMBIENT, OFFSETS = "ambient frame", "offset nonuniformity"
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
_DRAWS = 200
"""Draws of each noise: they determine its squared error to 7 % of its deviation, and the deviation to 5 %."""

Noise = Mapping[str, float]
"""Variances of independent noise by kind.

*datum*: of each datum; *ambient*: of each pixel of a frame that is subtracted from all others; *left*, *right*: of each
number of a factor; *light*: of each scene pixel's light relative to a white board's, in all frames alike.
"""


def draw(noise: Noise, model: Prepared, patterns: Pair, scene: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return a draw of the error (r, r') that normal ``noise`` makes in a ``model``'s data of a ``scene``.

    U of both sides is orthonormal, so that noise of variance v in each datum is noise of variance v in W.
    """
    left, right, normal = model.left, model.right, rng.standard_normal
    rows, columns = ((side.sensor_size, side.scene_size) for side in (left, right))
    kinds: Mapping[str, Callable[[], FloatArray]] = {
        "datum": lambda: normal(model.sigma.shape),
        "ambient": lambda: left.common.T @ normal((rows[0], columns[0])) @ right.common,
        "left": lambda: pattern_response(left, normal(rows), patterns[0]) @ scene @ right.response,
        "right": lambda: left.response.T @ scene @ pattern_response(right, normal(columns), patterns[1]).T,
        "light": lambda: left.response.T @ normal(scene.shape) @ right.response,
    }
    drawn = (math.sqrt(variance) * kinds[kind]() for kind, variance in noise.items() if variance)
    return sum(drawn, np.zeros_like(model.sigma))


def losses(stand: DriftStand, lit: LitSession, clear: Factors) -> list[Row]:
    """Return the loss [dB] by each source of error, and by the rest that no source explains.

    ``squared_error`` is the source's, mean over the image, negative where the image is worse without the source.
    """
    scene, light = stand.lit.truth, stand.lit.light
    model, pixels = stand.lit.rendered_frames(clear, stand.family, stand.seed).prepare(), scene.size
    patterns = stand.family.left.astype(np.float64), stand.family.right.astype(np.float64)
    gain = model.gain(stand.before.lam)

    def draws(source: tuple[str, str], noise: Noise) -> FloatArray:
        rng = stream(stand.seed, "losses", *source)
        return np.array([gain * draw(noise, model, patterns, scene, rng) for _ in range(_DRAWS)], dtype=np.float32)

    def part(noise: FloatArray, beside: FloatArray) -> tuple[float, float]:
        """Return what draws (k, r, r') of noise add to the squared error of all else, and its standard deviation."""
        alone, added = np.square(noise).sum(axis=(1, 2)), (noise * (noise + 2 * beside)).sum(axis=(1, 2))
        return float(alone.mean()) / pixels, float(added.std()) / pixels

    with single_threaded_blas():
        noises = {source: draws(source, noise) for source, noise in noises_of(stand, lit).items()}
        uneven, offsets = (model.image(gain * data) for data in fixed_data(stand, model))
    # Images without noise: whole, and without one cause after another.
    ablation, off, clean = waterfall.Ablation(light), frozenset[str](), stand.clear(clear, light)
    seen, removed = [clean + uneven + offsets, clean + uneven, clean], [(CAPTURE, OFFSETS), (CAPTURE, NONUNIFORMITY)]
    for name in ERROR_SOURCES:
        if name in ablation.effects:
            off |= {name}
            seen.append(stand.clear(clear, ablation.without(off)))
            removed.append((SCENE, ERROR_SOURCES[name]))

    # Squared errors of the parts and their standard deviations. Light is sampled once, also in images without noise.
    parts = {(SCENE, ERROR_SOURCES[waterfall.SCENE]): (0.0, 0.0)}
    sampled = noises[CAPTURE, RENDERING]
    drawn, steady = np.sum([*noises.values()], axis=0) - sampled, model.coefficients(seen[0] - scene)
    for cause, noise in noises.items():
        parts[cause] = part(noise, steady + drawn - (0.0 if noise is sampled else noise))
    for cause, (before, after) in zip(removed, pairwise(seen), strict=True):
        moved = 2 * (sampled * model.coefficients(before - after)).sum(axis=(1, 2)).std() / pixels
        parts[cause] = _square(before - scene) - _square(after - scene), float(moved)
    bias = _square(model.image(gain * model.sigma * model.coefficients(scene)) - scene)
    rendering, chance = part(sampled, model.coefficients(seen[-1] - scene))
    parts[SCENE, REST] = _square(seen[-1] - scene) - bias - rendering, chance
    parts[SOLVER, LAMBDA] = bias, 0.0

    whole, explained = _square(stand.before.image - scene), sum(square for square, _ in parts.values())
    parts[UNEXPLAINED, "not explained"] = whole - explained, part(drawn, steady)[1]
    rows = list[Row]()
    for (of, source), (square, deviation) in parts.items():
        name, most = (source, whole) if of == UNEXPLAINED else (f"{of}: {source}", explained)
        lost, error_db = gain_without(square, whole, most, deviation)
        found = {"lost_db": lost, "error_db": error_db, "squared_error": square, "deviation": deviation, "name": name}
        rows.append({"kind": "losses", "of": of, "source": source, **found})
    return rows


def judge_rest(row: Mapping[str, Any]) -> tuple[str, bool]:
    """Return a sentence on the squared error that no source explains, and True if chance may have caused it."""
    errors = abs(row["squared_error"]) / row["deviation"] if row["deviation"] else 0.0
    size = f"the unexplained part is {errors:.1f} of its standard errors"
    if abs(row["squared_error"]) > SURE * row["deviation"]:
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
    found, frames, seconds = dict[tuple[str, str], Noise](), stand.frames, stand.exposure_s
    for name, variance in frames.noises(seconds).items():
        if name != NONUNIFORMITY and (variance or name != SPECKLE):
            found[CAPTURE, name] = {"datum": variance * (2 if stand.family.signed else 1)}
    if takes_ambient_frame("auto", stand.family, frames.expected):
        exposer = frames.exposer(seconds)
        variance = (exposer.sensor_noise(exposer.electrons(frames.expected.projector_off)) / seconds) ** 2
        found[CAPTURE, AMBIENT] = {"ambient": variance / ambient_shots(stand.family)}
    # The truth's own sampling is in the error as much as that of the light. A session's is averaged over lines.
    light, factors = stand.lit.light, (stand.factors.left, stand.factors.right)
    sampled = light.apparent.error_of(light.flux_error) ** 2 + light.apparent.error**2
    found[CAPTURE, RENDERING] = {"light": sampled}
    left, right = entry_variances(lit.session, lit.uniform_rate, lit.exposure_s, factors)
    for source, own in left.items():
        found[SESSION, source] = {"left": float(own.mean()), "right": float(right[source].mean())}
    return found


def fixed_data(stand: DriftStand, model: Prepared) -> Pair:
    """Return the data (r, r') of a ``model`` that responses and offsets of pixels add, beyond what factors have."""
    sensor, frames, shape = stand.lit.bench.sensor, stand.frames, stand.lit.bench.geometry.frame_shape
    own, response, offsets = specimen(sensor, shape), np.ones(shape), np.zeros(shape)
    if own.response is not None:
        rows, columns = own.response.mean(axis=1), own.response.mean(axis=0)
        response = own.response * rows.mean() / np.outer(rows, columns)
    if own.offset_e is not None and not frames.expected.has_ambient:
        offsets += own.offset_e / stand.exposure_s
    if own.dark_e_per_s is not None and not frames.expected.has_ambient:
        offsets += own.dark_e_per_s - sensor.superpixel_dark_current_e_per_s
    lit = [frames.exposer(1.0).electrons(frame) for frame in frames.expected]
    rates = ((response - 1) * each for each in lit), (offsets for _ in lit)
    uneven, added = (model.accumulator(stand.family.measurements(each)).sum for each in rates)
    return uneven, added


# -------- The study

_SAID_DB = 0.005
"""Least loss that is drawn."""


@single_threaded_blas()
def judge_factors(lit: LitSession, noisy: Estimate, clean: Estimate) -> list[Row]:
    """Return errors of each factor beside their prediction, and those of its entries in predicted deviations."""
    rows = list[Row]()
    exacts = clean.left, clean.right
    every = entry_variances(lit.session, lit.uniform_rate, lit.exposure_s, exacts)
    for name, variances, exact, found in zip(FACTORS, every, exacts, (noisy.left, noisy.right), strict=True):
        # Factors are known up to a common scale and sign; this one is not drawn towards zero by the noise.
        found = found * (np.vdot(exact, exact) / np.vdot(found, exact))
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
    load_recipe(scope.recipe).of_one_depth()
    return [Point.of(scope.setup, recipe=scope.recipe, patterns=scope.patterns, seed=scope.seeds[0])]


def _measure(studio: Studio, point: Point) -> Found:
    bench, recipe = studio.bench(point.setup), load_recipe(point["recipe"])
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
    words, by_chance = judge_rest(rest)
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
            "All sources together make the image's squared error", lambda rows: judge_rest(rows.iloc[0]),
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
