"""Calibration by captures of known pictures: prints, screens or images by another calibration.

All planes of a colour sensor see one mask, so that their codes are fitted together.

A mask before a sensor casts the same shadow from every direction, shifted. So a side's factor is an unknown code c on
a grid of sensor pixels, seen from scene pixel i through a shift::

    Phi[u, i] = sum_k b_k(i) c_k(u + o + s i)

with s the sensor pixels that one scene pixel shifts the shadow by, o the place of this frame's pixels (planes of a
Bayer sensor lie half a pixel apart), and b_k polynomials over the scene, b_0 = 1, for falloff or thick masks.

*Alternating least squares.* With Z = X Phi_R^T a frame is Y = Phi_L Z, linear in the codes of Phi_L; left and right
take turns. A code's numbers have an independent prior of variance 1 / alpha, estimated from the frames (MacKay 1992,
Neural Computation 4, 415): alpha = gamma / |c|^2, where gamma = tr N (N + alpha)^-1 is the number of parameters that
the frames determine, and (N + alpha)^-1 is their covariance.

*Start.* A frame's spectrum is Y(f, g) = C_L(f) C_R(g) X(-s f, -s' g), up to the sensor's edges. Y over X is a product
of two vectors only for the right orientation and scale of the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize_scalar

from mitsim.core.arrays import FloatArray
from mitsim.core.colour_files import CALIBRATION, write_colours
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError, check_arguments
from mitsim.core.exr import checksum, finite_channel, read_frame
from mitsim.core.files import output_folder
from mitsim.core.images import ORIENTATIONS, orient, own_end, read_image
from mitsim.core.job import Cost, Job, Limits
from mitsim.core.manifests import MANIFEST, CalibrationManifest, FactorNoise
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.picture_files import BGGR, PLANES, Preparation, Wanted, planes_of
from mitsim.core.runs import load_run
from mitsim.devices.framelist import MOST_TERMS, KnownCaptures, load_known, preparation_of
from mitsim.reconstruct.factors import (
    LARGEST_ERROR,
    SEPARABLE_RESIDUAL,
    UNKNOWN_NOISE,
    Factors,
    rank_above_noise,
    squared_condition,
)
from mitsim.reconstruct.solver import Pair, Status, Verdict, centre_columns, centre_frame

# ---- What is seen ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Exposure:
    """Frame (m, m') [electrons/s], and the light (n, n') that it shows: a picture times its pattern."""

    scene: FloatArray
    frame: FloatArray
    group: int = 0
    plane: str = ""
    offset: tuple[float, float] = (0.0, 0.0)

    def turn_scene(self, orientation: str) -> Self:
        return replace(self, scene=orient(self.scene, ORIENTATIONS[orientation]))


def plane_offsets(how: Preparation) -> dict[str, tuple[float, float]]:
    cell = np.empty((2, 2), dtype=object)
    for name, place in planes_of(how.mosaic or BGGR).items():
        cell[place] = name
    turned = orient(cell, how.orientation) if isinstance(how.orientation, int) else cell
    return {str(turned[row, column]): (row / 2, column / 2) for row in (0, 1) for column in (0, 1)}


@dataclass(frozen=True)
class Shape:
    scales: tuple[float, float]
    terms: int = 1
    centre: bool = False


@dataclass(eq=False)
class Side:
    sensor: int
    scene: int
    scale: float
    terms: int
    centre: bool

    def __post_init__(self) -> None:
        self.width = int(np.floor(self.scale * (self.scene - 1))) + 3
        self.length = self.sensor + self.width - 1
        place = np.linspace(-1, 1, self.scene) if self.scene > 1 else np.zeros(1)
        bases = ((np.polynomial.legendre.Legendre.basis(k), 2 * k + 1) for k in range(self.terms))
        self.weights: FloatArray = np.stack([basis(place) * np.sqrt(size) for basis, size in bases])

    def hats(self, offset: float) -> FloatArray:
        place, rows = offset + self.scale * np.arange(self.scene), np.arange(self.scene)
        first = np.floor(place).astype(int)
        found = np.zeros((self.scene, self.width))
        found[rows, first] = 1 - (place - first)
        found[rows, first + 1] += place - first
        return found

    def spread(self, offset: float) -> FloatArray:
        return (self.weights[:, :, None] * self.hats(offset)[None]).transpose(1, 0, 2)

    def factor(self, codes: FloatArray, offset: float) -> FloatArray:
        hats, phi = self.hats(offset), np.zeros((self.sensor, self.scene))
        for code, weight in zip(codes, self.weights, strict=True):
            phi += (sliding_window_view(code, self.width) @ hats.T) * weight
        return centre_columns(phi) if self.centre else phi

    def normal(self, offset: float, gram: FloatArray, product: FloatArray) -> Pair:
        spread, w, k = self.spread(offset), self.width, self.terms
        flat = spread.reshape(self.scene, k * w)
        block = (flat.T @ gram @ flat).reshape(k, w, k, w)
        side = (product @ flat).reshape(self.sensor, k, w)
        matrix, right = np.zeros((k, self.length, k, self.length)), np.zeros((k, self.length))
        total = np.zeros((self.scene, k, self.length))
        for row in range(self.sensor):
            window = slice(row, row + w)
            matrix[:, window, :, window] += block
            right[:, window] += side[row]
            total[:, :, window] += spread
        whole, every = matrix.reshape(k * self.length, -1), total.reshape(self.scene, -1)
        if self.centre:
            whole -= every.T @ (gram @ every) / self.sensor
        return whole, right.ravel()


# ---- The fit ---------------------------------------------------------------------------------------------------------

_NO_LIGHT = "known pictures: are dark or uniform, and do not determine the camera; give others"
_VAGUE, _SMALLEST, _LARGEST = 1e-3, 1e-9, 1e6


@dataclass(frozen=True, eq=False)
class Codes:
    """Fitted codes (terms, length) of both sides, with the gain of each plane."""

    sides: tuple[Side, Side]
    codes: Pair
    gains: dict[str, float]
    variances: FloatArray
    explained: float
    errors: tuple[float, float]
    seen_errors: tuple[float, float]
    told: tuple[float, float]

    def factors(self, offset: tuple[float, float] = (0.0, 0.0), plane: str = "") -> Pair:
        gain = self.gains[plane]
        sides, root = zip(self.sides, self.codes, offset, strict=True), np.sqrt(abs(gain))
        left, right = (side.factor(codes, place) * root for side, codes, place in sides)
        return np.sign(gain) * left, right

    @property
    def evidence(self) -> float:
        """Log-likelihood of the frames, less the penalty of the determined numbers (Schwarz 1978)."""
        size = self.sides[0].sensor * self.sides[1].sensor
        likelihood = -0.5 * size * float(np.log(self.variances).sum())
        return likelihood - 0.5 * sum(self.told) * float(np.log(size * len(self.variances)))

    def explains(self, exposures: Sequence[Exposure]) -> float:
        parts = []
        for each in exposures:
            left, right = self.factors(each.offset, each.plane)
            misfit = each.frame - left @ each.scene @ right.T
            parts.append(1 - float(np.sum(np.square(misfit)) / np.sum(np.square(each.frame))))
        return float(np.mean(parts))


@single_threaded_blas()
def fit_codes(exposures: Sequence[Exposure], shape: Shape, start: FloatArray | None = None, turns: int = 20) -> Codes:
    sizes = zip(exposures[0].frame.shape, exposures[0].scene.shape, shape.scales, strict=True)
    left, right = (Side(sensor, scene, scale, shape.terms, shape.centre) for sensor, scene, scale in sizes)
    sides = left, right
    if start is None:
        some = exposures[:: -(-len(exposures) // _COMPARED)]
        start = _Spectra(some).compare([each.scene for each in some], shape.scales)[1]
    codes = [np.zeros((shape.terms, side.length)) for side in sides]
    codes[1][0] = np.interp(np.arange(right.length), np.arange(len(start)), start)
    gains = dict.fromkeys((each.plane for each in exposures), 1.0)
    energies = np.array([np.mean(np.square(each.frame)) for each in exposures])
    if not (energies > 0).all():
        raise MitsimError("known pictures: a frame is uniform, and does not determine the camera; leave it out")

    def factors_of(axis: int) -> dict[float, FloatArray]:
        return {place: sides[axis].factor(codes[axis], place) for place in {each.offset[axis] for each in exposures}}

    variances, explained, alphas = energies.copy(), -1.0, [np.zeros(shape.terms), np.zeros(shape.terms)]
    errors, seen, told = [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]
    covariances = [np.zeros((0, 0)), np.zeros((0, 0))]
    for _ in range(turns):
        for axis in (0, 1):
            across = factors_of(1 - axis)
            sums: dict[float, list[FloatArray]] = {}
            for each, variance in zip(exposures, variances, strict=True):
                scene, frame = (each.scene, each.frame) if axis == 0 else (each.scene.T, each.frame.T)
                light = gains[each.plane] * (scene @ across[each.offset[1 - axis]].T)
                added = [light @ light.T / variance, frame @ light.T / variance]
                place = each.offset[axis]
                sums[place] = [a + b for a, b in zip(sums[place], added, strict=True)] if place in sums else added
            own = sides[axis]
            matrix, data = np.zeros((own.terms * own.length,) * 2), np.zeros(own.terms * own.length)
            for place, (gram, product) in sums.items():
                parts = own.normal(place, gram, product)
                matrix += parts[0]
                data += parts[1]
            # The codes of this side by their prior, and the variance of the prior by the numbers that frames tell.
            level = float(np.trace(matrix)) / len(matrix)
            if not level > 0:
                raise MitsimError(_NO_LIGHT)
            alphas[axis] = np.where(alphas[axis] > 0, alphas[axis], _VAGUE * level)
            factored = cho_factor(matrix + np.diag(np.repeat(alphas[axis], own.length)))
            codes[axis] = cho_solve(factored, data).reshape(own.terms, -1)
            covariances[axis] = cho_solve(factored, np.eye(len(matrix)))
            unknown = alphas[axis] * np.diag(covariances[axis]).reshape(own.terms, -1).sum(axis=1)
            numbers = np.maximum(own.length - unknown, 0.0)
            # Codes that explain nothing would make alpha infinite, and the matrix singular to rounding.
            sizes = np.maximum(np.square(codes[axis]).sum(axis=1), numbers / (_LARGEST * level))
            alphas[axis] = np.clip(numbers / np.maximum(sizes, 1e-300), _SMALLEST * level, _LARGEST * level)
            told[axis] = float(numbers.sum())
            lit = sum(float(np.trace(gram)) for gram, _ in sums.values())
            seen[axis] = float(np.sqrt(told[axis] / (sides[axis].sensor * lit)))
        phis = factors_of(0), factors_of(1)
        models = [phis[0][each.offset[0]] @ each.scene @ phis[1][each.offset[1]].T for each in exposures]
        # The light of each plane.
        above, below = dict.fromkeys(gains, 0.0), dict.fromkeys(gains, 0.0)
        for each, model in zip(exposures, models, strict=True):
            above[each.plane] += float(np.vdot(model, each.frame))
            below[each.plane] += float(np.vdot(model, model))
        if not all(energy > 0 for energy in below.values()):
            raise MitsimError(_NO_LIGHT)
        gains = {name: above[name] / below[name] for name in gains}
        pairs = zip(exposures, models, strict=True)
        left_over = [np.mean(np.square(each.frame - gains[each.plane] * model)) for each, model in pairs]
        variances, before = np.asarray(left_over), explained
        explained = 1 - float(np.mean(variances / energies))
        if explained - before < 1e-05:
            break
    # The error of all numbers of a factor, by the covariance of its code.
    for axis, (side, covariance) in enumerate(zip(sides, covariances, strict=True)):
        block = np.zeros((side.terms, side.width, side.terms, side.width))
        whole = covariance.reshape(side.terms, side.length, side.terms, side.length)
        for row in range(side.sensor):
            block += whole[:, row : row + side.width, :, row : row + side.width]
        spread = side.spread(0.0)
        total = float(np.einsum("iaw,awbv,ibv->", spread, block, spread, optimize=True))
        errors[axis] = float(np.sqrt(max(total, 0.0) / (side.sensor * side.scene)))
    balance = float(np.sqrt(np.linalg.norm(codes[1]) / np.linalg.norm(codes[0])))
    balanced, of_codes = (codes[0] * balance, codes[1] / balance), (errors[0] * balance, errors[1] / balance)
    shown = seen[0] * balance, seen[1] / balance
    return Codes(sides, balanced, gains, variances, explained, of_codes, shown, (told[0], told[1]))


# ---- Orientation and scale, by spectra -------------------------------------------------------------------------------

_COMPARED = 2
_STEP, _FINE, _STEPS = 1.1, 1.03, 10
_WIDEST, _NARROWEST = 1.0, 0.03


class _Spectra:
    def __init__(self, exposures: Sequence[Exposure]) -> None:
        rows, columns = exposures[0].frame.shape
        self._periods = 1.5 * rows, 1.5 * columns
        waves = [_waves(count, period) for count, period in zip((rows, columns), self._periods, strict=True)]
        self._frames = [waves[0] @ each.frame @ waves[1].T for each in exposures]

    def compare(self, scenes: Sequence[FloatArray], scales: tuple[float, float]) -> tuple[float, FloatArray]:
        """Return how nearly the spectra are a product of two vectors, 0 to 1, and the resulting code of columns."""
        above, below = np.zeros_like(self._frames[0]), np.zeros(self._frames[0].shape)
        sides = zip(scenes[0].shape, self._periods, scales, strict=True)
        left, right = (np.conj(_waves(count, period / scale)) for count, period, scale in sides)
        for frame, scene in zip(self._frames, scenes, strict=True):
            lit = left @ scene @ right.T
            above += frame * np.conj(lit)
            below += np.abs(frame * lit)
        # Phases alone: of amplitudes a few strong waves would decide, which any code has.
        _, values, code_waves = np.linalg.svd(above / np.maximum(below, np.finfo(np.float64).tiny))
        code = np.real(code_waves[0] @ np.conj(_waves(int(2 * self._periods[1]), self._periods[1])))
        return float(values[0] ** 2 / max(np.sum(np.square(values)), np.finfo(np.float64).tiny)), code


def _waves(count: int, period: float) -> npt.NDArray[np.complex128]:
    order = np.arange(1, 21)
    places = np.multiply.outer(np.concatenate([order, -order]), np.arange(count))
    return np.asarray(np.exp(-2j * np.pi / period * places))


@dataclass(frozen=True)
class Pose:
    """Orientation and scales [sensor pixels / scene pixel] of scenes before the camera."""

    orientation: str
    scales: tuple[float, float]
    margin: float | None = None
    certain: bool = True


@single_threaded_blas()
def find_pose(
    exposures: Sequence[Exposure], orientation: str | None = None, scales: tuple[float, float] | None = None
) -> Pose:
    exposures = [replace(each, frame=centre_frame(each.frame)) for each in exposures]
    some = exposures[:: -(-len(exposures) // _COMPARED)]
    spectra, scenes = _Spectra(some), {name: [each.turn_scene(name).scene for each in some] for name in ORIENTATIONS}
    ratio = some[0].frame.shape[0] / some[0].scene.shape[0]
    count = int(np.ceil(np.log(_WIDEST / _NARROWEST) / np.log(_STEP)))
    places = [(ratio * _NARROWEST * _STEP**power,) * 2 for power in range(count + 1)] if scales is None else [scales]
    scores = {name: np.array([spectra.compare(own, place)[0] for place in places]) for name, own in scenes.items()}
    # Of a scale near 0 a frame is the product of two vectors whichever way the scene lies; the right way is one alone.
    usual, tried = np.median(list(scores.values()), axis=0), []
    for name in scenes if orientation is None else [orientation]:
        own, place = scenes[name], max(zip(scores[name] - usual, places, strict=True))[1]
        if scales is None:
            place = _refine(lambda at, own=own: -spectra.compare(own, at)[0], place, _STEP)  # type: ignore[misc]
        fitted = fit_codes([each.turn_scene(name) for each in some], Shape(place, 1, True), turns=2)
        tried.append((fitted.evidence, fitted.explained, name, place))
    _, explained, best, place = max(tried)
    pose, others = Pose(best, place), [part for _, part, name, _ in tried if name != best]
    if others:
        pose = replace(pose, margin=explained - max(others), certain=1 - max(others) > 1.2 * (1 - explained))
    if scales is not None:
        return pose
    turned = [each.turn_scene(pose.orientation) for each in exposures]

    def misfit(at: tuple[float, float]) -> float:
        return -fit_codes(turned, Shape(at, 1, True), turns=3).evidence

    for _ in range(_STEPS):
        before, pose = pose.scales, replace(pose, scales=_refine(misfit, pose.scales, _FINE))
        if np.all(np.abs(np.log(pose.scales) - np.log(before)) < np.log(_FINE) / 2):
            break
    return pose


def _refine(
    misfit: Callable[[tuple[float, float]], float], start: tuple[float, float], reach: float
) -> tuple[float, float]:
    def least(score: Callable[[float], float]) -> float:
        ends, options = (-np.log(reach), np.log(reach)), {"xatol": np.log(reach) * 0.05}
        return float(np.exp(minimize_scalar(score, bounds=ends, method="bounded", options=options).x))

    rows = start[0] * least(lambda x: misfit((start[0] * np.exp(x), start[1])))
    return rows, start[1] * least(lambda x: misfit((rows, start[1] * np.exp(x))))


# ---- How many codes: by frames that are held out ---------------------------------------------------------------------


def choose_terms(exposures: Sequence[Exposure], shape: Shape, most: int) -> tuple[int, tuple[float, ...]]:
    """Choose the number of codes, at most ``most``, by holding out half of the pictures, or of the frames."""
    groups = sorted({each.group for each in exposures})
    numbers = [groups.index(each.group) for each in exposures] if len(groups) > 1 else range(len(exposures))
    folds = [[each for each, number in zip(exposures, numbers, strict=True) if number % 2 == own] for own in (0, 1)]
    planes = [{each.plane for each in fold} for fold in folds]
    if not all(folds) or (len(groups) > 1 and planes[0] != planes[1]):
        return shape.terms, ()
    found: list[float] = []
    for terms in range(1, most + 1):
        parts = []
        for kept, left_out in (folds, folds[::-1]):
            codes = fit_codes(kept, replace(shape, terms=terms))
            usual = float(np.mean([*codes.gains.values()]))
            gains = dict.fromkeys((each.plane for each in left_out), usual) | codes.gains
            parts.append(replace(codes, gains=gains).explains(left_out))
        found.append(float(np.mean(parts)))
        if len(found) > 1 and 1 - found[-1] > (1 - 0.02) * (1 - found[-2]):
            return terms - 1, tuple(found)
    return most, tuple(found)


# ---- The calibration -------------------------------------------------------------------------------------------------


@check_arguments
def calibrate_known(
    listed: Path | str | KnownCaptures, output: Path | str | None = None, job: Job | None = None
) -> dict[str, Factors]:
    """Calibrate a camera by captures of known pictures.

    Parameters
    ----------
    listed
        List of runs and pictures, TOML or JSON, or its contents.
    output
        CAL folder that is written, a coloured one for several planes; None keeps the factors in memory.
    job
        Clock and progress.

    Returns
    -------
    dict
        Factors by the runs' planes; "" where runs have none. They are flagged where frames contain more than the model
        explains, or pictures do not determine their orientation.

    Raises
    ------
    MitsimError
        For a list, run or picture that breaks a rule or does not fit, and an output that cannot be written.
    """
    captures = listed if isinstance(listed, KnownCaptures) else load_known(listed)
    job = job or Job()
    with nullcontext() if output is None else output_folder(output) as place:
        found = _calibrate(captures, job)
        if place is not None:
            for name, factors in found.items():
                (place / name).mkdir(exist_ok=True)
                factors.write(place / name)
            if captures.lines is not None:
                write_colours(place, captures.lines.model_copy(update={"kind": CALIBRATION}))
    return found


def _calibrate(captures: KnownCaptures, job: Job) -> dict[str, Factors]:
    listed, path = captures.listed, captures.path
    with job.clock.stage("read"):
        read = _KnownFrames(captures)
    job.progress("pose", 0.2)
    with job.clock.stage("pose"):
        pose = find_pose(read.exposures, listed.orientation, listed.scale)
    if "transposed" in pose.orientation:
        raise MitsimError(
            f"list {path}: pictures lie {pose.orientation} before the camera, and its factors are of rows and "
            "columns; save the pictures transposed, or turn the frames as they are imported"
        )
    turned, terms = [each.turn_scene(pose.orientation) for each in read.exposures], listed.terms
    held_out: tuple[float, ...] = ()
    job.progress("choice", 0.5)
    with job.clock.stage("choice"):
        if not terms:
            terms, held_out = choose_terms(turned, Shape(pose.scales, 1, listed.centre), min(3, MOST_TERMS))
    job.progress("fit", 0.8)
    with job.clock.stage("fit"):
        codes = fit_codes(turned, Shape(pose.scales, terms, listed.centre))
    explained, unexplained, chi_square = read.misfit(codes, turned)
    stated = bool(np.isfinite(read.noises).all())
    doubts = list[str]()
    if not pose.certain and pose.margin is not None:
        doubts.append(
            f"orientation: {pose.orientation!r} explains no more than {pose.margin:.1%} of the frames beyond another; "
            "give pictures that are not symmetric, or state orientation in the list"
        )
    if read.saturated:
        first = f"{len(read.saturated)} runs have readings at the full well or the ADC's end, first {read.saturated[0]}"
        doubts.append(f"saturation: {first}, so their frames are not linear; use a shorter exposure")
    found = {}
    for line, manifest in captures.manifests.items():
        left, right = codes.factors(read.places.get(line, (0.0, 0.0)), line)
        # Images lie as pictures do: a scene that is turned is one whose factors run the other way.
        left = left[:, ::-1] if pose.orientation in ("upside down", "turned") else left
        right = right[:, ::-1] if pose.orientation in ("mirrored", "turned") else right
        sides = [np.ascontiguousarray(side, dtype=np.float32).astype(np.float64) for side in (left, right)]
        root, norms = np.sqrt(abs(codes.gains[line])), [np.linalg.norm(side) / np.sqrt(side.size) for side in sides]
        errors = codes.errors, codes.seen_errors
        whole, seen = ([float(root * e / norm) for e, norm in zip(each, norms, strict=True)] for each in errors)
        rank = [rank_above_noise(side, error) for side, error in zip(sides, whole, strict=True)]
        error = float(np.hypot(seen[0], seen[1]))
        figures = (
            f"Frames determine {codes.told[0]:.0f} and {codes.told[1]:.0f} numbers of the codes, rank {rank[0]} of "
            f"{codes.sides[0].scene} and {rank[1]} of {codes.sides[1].scene}; in frames of such pictures the factors "
            f"have an error of {error:.1e}."
        )
        if error > LARGEST_ERROR:
            verdict, remedy = Verdict.MOSTLY_NOISE, "capture more pictures, or longer"
            sentence = f"Factors are mostly noise: in frames of such pictures they have an error of {error:.0%}"
            sentence += f", allowed are {LARGEST_ERROR:.0%}"
        elif unexplained > (SEPARABLE_RESIDUAL if stated else UNKNOWN_NOISE):
            verdict = Verdict.NOT_SEPARABLE
            left_over = f"{unexplained:.1%} of them is left over"
            sentence = f"Frames hold more than codes seen through shifts explain: {left_over}"
            remedy = "check that each run shows its picture, that pictures are as bright as they were shown (gamma)"
            remedy += ", and that the frames stand straight"
            if not stated:
                remedy = f"state digital.read_noise_e, as noise is guessed from neighbouring pixels; {remedy}"
        else:
            verdict, remedy = Verdict.CALIBRATED, ""
            code = "one code a side explains" if terms == 1 else f"{terms} codes that change over the scene explain"
            sentence = f"Calibrated by known pictures: {code} {explained:.1%} of the frames beside uniform light"
        status = Status(verdict, sentence, remedy, figures)
        warnings = (*doubts, *status.reasons)
        result: dict[str, Any] = {
            "n": left.shape[1],
            "frames": read.frames,
            "pictures": len(listed.known),
            "orientation": pose.orientation,
            "orientation_margin": pose.margin,
            "scale": list(pose.scales),
            "terms": terms,
            "held_out": list(held_out),
            "predicted_phi_error": float(np.hypot(whole[0], whole[1])),
            "predicted_frame_error": error,
            "code_numbers": [side.length * side.terms for side in codes.sides],
            "told": list(codes.told),
            "rank": rank,
            "explained": explained,
            "chi_square": chi_square,
            "separability_residual": float(np.sqrt(max(1 - explained, 0.0))),
            "unexplained_residual": unexplained,
            "noise_free_residual": None,
            "phi_error": None,
            "condition": max(squared_condition(side) for side in sides),
            "exposure_s": manifest.digital.exposure_s,
            "saturated_runs": read.saturated,
            "seconds": job.clock.seconds(),
            "warnings": warnings,
        }
        turn_deg = read.prepared.turn_deg
        of_list = {"known": str(path), "list": listed.model_dump(mode="json"), "sha256": read.sums}
        made = CalibrationManifest(
            configuration={**({"turn_deg": turn_deg} if turn_deg else {}), **of_list},
            camera=manifest.camera,
            centre=listed.centre,
            board_reflectance=listed.board_reflectance,
            noise=FactorNoise(left=seen[0] * norms[0], right=seen[1] * norms[1], unexplained=unexplained),
            digital=manifest.digital,
            result=result,
            warnings=warnings,
            versions=versions(),
            command=job.command,
            estimate=str(status),
            verdict=status.verdict.value,
        )
        found[line] = Factors(sides[0], sides[1], made, status)
    return found


# ---- Frames and pictures ---------------------------------------------------------------------------------------------

_REFLECTANCE = "reflectance"


class _KnownFrames:
    def __init__(self, captures: KnownCaptures) -> None:
        listed, manifests = captures.listed, captures.manifests
        self.exposures, self.noises, self.saturated, self.frames = list[Exposure](), list[float](), list[str](), 0
        self.sums: dict[str, str] = {}
        self.prepared = preparation_of(next(iter(manifests.values())), captures.path)
        self.places = plane_offsets(self.prepared)
        shape: tuple[int, int] | None = None
        for number, capture in enumerate(listed.known):
            path = captures.picture(capture)
            picture = _light_of_picture(path, listed.gamma)
            self.sums[capture.picture] = checksum(path)
            for line in manifests:
                if captures.lines is not None and line not in PLANES:
                    words = f"{capture.run} has the line {line}, whose code is its own"
                    raise MitsimError(f"list {captures.path}: {words}; calibrate each line alone")
                if picture.ndim == 3 and not line:
                    words = f"is in colour, and {capture.run} shows one plane"
                    raise MitsimError(f"picture {path}: {words}; give a grey picture of that")
                light = picture if picture.ndim == 2 else picture[:, :, "rgb".index(line[0])]
                folder, name = captures.run(capture, line), str(Path(capture.run) / line)
                shots, saturated = load_run(folder), 0
                self.sums[name] = checksum(folder / MANIFEST)
                left, right = shots.patterns
                if light.shape != (len(left), len(right)):
                    size = f"is {light.shape[0]} x {light.shape[1]} pixels"
                    theirs = f"the run {folder} has {len(left)} x {len(right)} scene pixels"
                    raise MitsimError(f"picture {path}: {size}, but {theirs}; give one of its size")
                digital = shots.manifest.digital
                for each in shots.pattern_measurements(shape):
                    if not self.exposures:
                        count = len(listed.known) * len(manifests) * left.shape[1] * right.shape[1]
                        held = Cost(memory_bytes=4 * float(each.frame.nbytes) * count)
                        held.check(f"list {captures.path}: its frames", Limits())
                    frame = centre_frame(each.frame) if listed.centre else each.frame
                    shape = frame.shape[0], frame.shape[1]
                    scene = light * np.multiply.outer(left[:, each.row], right[:, each.column])
                    self.exposures.append(Exposure(scene, frame, number, line, self.places.get(line, (0.0, 0.0))))
                    variance = float(np.mean(np.maximum(digital.variance(each.light, each.shots), 0.0)))
                    self.noises.append(variance if digital.noise_is_stated else np.nan)
                    self.frames += each.shots
                    saturated += each.saturated
                if saturated:
                    self.saturated.append(name)

    def misfit(self, codes: Codes, exposures: Sequence[Exposure]) -> tuple[float, float, float]:
        """Return the explained part of the frames' energy, the unexplained part beyond noise, and chi-square."""
        excess = energy = total = 0.0
        ratios = []
        for each, stated in zip(exposures, self.noises, strict=True):
            rows, columns = codes.factors(each.offset, each.plane)
            misfit = centre_frame(each.frame - rows @ each.scene @ columns.T)
            noise = stated if np.isfinite(stated) else guess_noise(misfit)
            left_over = float(np.mean(np.square(misfit)))
            excess += left_over - noise
            total += left_over
            energy += float(np.mean(np.square(centre_frame(each.frame))))
            ratios.append(left_over / noise if noise > 0 else 1.0)
        return 1 - total / energy, float(np.sqrt(max(excess, 0.0) / energy)), float(np.mean(ratios))


def guess_noise(misfit: FloatArray) -> float:
    """Return the variance by second differences of every second pixel, which interpolated frames do not share."""
    parts = (misfit[row::2, column::2] for row in (0, 1) for column in (0, 1))
    # The weights of a second difference have squares of 6.
    return float(np.mean([np.mean(np.square(np.diff(np.diff(part, 2, 0), 2, 1))) for part in parts])) / 36


def _light_of_picture(path: Path, gamma: float) -> FloatArray:
    channels = read_frame(path)[0] if path.suffix.lower() == ".exr" else {}
    if _REFLECTANCE in channels:
        values = finite_channel(channels, _REFLECTANCE, path)
    else:
        values = read_image(path, Wanted("picture", colour=True))
    if values.ndim == 3 and values.shape[2] != 3:
        raise MitsimError(f"picture {path}: has {values.shape[2]} channels; save it without transparency")
    light = np.asarray(values, dtype=np.float64) / (own_end(values) or 1.0)
    if gamma != 1 and light.min() < 0:
        raise MitsimError(f"picture {path}: has numbers below 0, which have no gamma; leave gamma out of the list")
    return np.asarray(light**gamma) if gamma != 1 else light
