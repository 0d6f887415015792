"""Image of a run by a measured point spread function: weight of the prior, image and misfit.

**Weight.** Blocks of sensor pixels are held out and predicted from the image of the rest. Where the best lambda asks
for clearly more noise than the frames have, the weight follows from that model error in place of the noise.

**Fit.** Any point spread function fits a frame with some image, because the scene has more pixels, but a wrong one
needs a negative or rough image. So the least of

    1/2 ||A X - Y||^2 + w TV(X),    X >= 0

is compared with that of the same light mirrored and turned, which has the same spectrum.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy import fft

from mitsim.core.arrays import FloatArray, single_threaded_blas
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, cut
from mitsim.core.job import Cost, Job, Limits
from mitsim.core.runs import Capture
from mitsim.devices.camera import load_psf
from mitsim.reconstruct.point_spread import Array, PointSpreadFit, ShiftedLight, minimise, reduce_frame
from mitsim.reconstruct.reconstruct import POINT_SPREAD, Reconstruction
from mitsim.reconstruct.request import TIKHONOV, TV, Bounds, ImageRequest
from mitsim.reconstruct.solution import Solution, Status, Verdict
from mitsim.reconstruct.solver import check_lambda
from mitsim.reconstruct.solvers import Prior

_NUMBERS = 24
_RIDGE, _WEIGHT = 50.0, 1.2
"""Lambda over the mean square of a pixel's light, by relative error; TV's weight in units of the gradient's error."""
_CLEARLY = 2.0
_SIDE, _STEPS = 128, 60
_BLOCKS, _KEPT = 12, 8
_HALVES = range(-16, 7)
_TURNED = {"turned by 180 degrees": (-1, -1), "mirrored left to right": (1, -1), "mirrored upside down": (-1, 1)}
_MODEL_ERROR, _ROUGH, _LEFT = 0.01, (3.0, 0.3), 4.0
_ALIKE = 0.9


# ---- Noise, weight and misfit ----------------------------------------------------------------------------------------


def frame_noise(frame: Array) -> float:
    """Return the noise by mixed second differences (Immerkaer, Comput. Vis. Image Underst. 64, 1996)."""
    if min(frame.shape) < 3:
        return 0.0
    bent = np.diff(np.diff(frame, n=2, axis=0), n=2, axis=1)
    # The 9 weights have squares of 36 in all; half of normal numbers are below 0.6745 deviations.
    return float(np.median(np.abs(bent))) / 6 / 0.6745


def _shrink(light: ShiftedLight, frames: Array) -> tuple[ShiftedLight, Array, int]:
    factor = 1 if light.patterns else max(min(*light.sensor, *light.psf.shape) // _SIDE, 1)
    return light.reduce(factor), np.stack([reduce_frame(frame, factor) for frame in frames]), factor


def frame_error(light: ShiftedLight, frames: Array) -> float:
    """Return the deviation of ``frames`` (K K', m, m') from the light that a model explains.

    It is their noise or, if clearly larger, the noise whose ridge predicts held-out pixels best.
    """
    mean = float(frames.mean())
    if mean <= 0:
        raise MitsimError(f"frame of mean {mean:g}: lambda cannot be chosen; check exposure and black level")
    noise = math.sqrt(float(np.mean([frame_noise(frame) ** 2 for frame in frames])))
    if light.patterns is not None:
        return noise
    small, seen, _ = _shrink(light, frames)
    row, column = np.indices(small.sensor) // max(min(small.sensor) // _BLOCKS, 1)
    counted = (row + 3 * column) % _KEPT > 0
    part = replace(small, seen=counted.astype(small.precision))

    @cache
    def error(half: int) -> float:
        prior = Prior(ridge=10 ** (half / 2) * small.column_power, bounds=(0.0, math.inf))
        scene = minimise(part, seen * part.seen, prior, _STEPS, 0.02).image
        return float(np.square((small.image_of(scene) - seen)[:, ~counted]).sum())

    best = 0
    while best in _HALVES and error(lower := min((best - 1, best + 1), key=error)) < error(best):
        best = lower
    before, here, after = (error(half) for half in (best - 1, best, best + 1))
    # The vertex of the parabola through these three.
    place = best + (before - after) / 2 / max(before - 2 * here + after, 1e-300)
    level = mean * 10 ** (place / 2) / _RIDGE
    return level if level > _CLEARLY * noise else noise


def find_fit(light: ShiftedLight, frames: Array, variance: float | None) -> PointSpreadFit:
    small, seen, factor = _shrink(light, frames)
    rows, columns = (max(size // 16, 1) for size in seen.shape[1:])
    strips = [strip for frame in seen for strip in np.array_split(frame, rows)]
    tiles = [tile for strip in strips for tile in np.array_split(strip, columns, axis=1)]
    measured = float(np.mean([frame_noise(tile) ** 2 for tile in tiles])) if variance is None else variance / factor**2
    noise = max(measured, 1e-300)
    error = math.hypot(math.sqrt(noise), _MODEL_ERROR * float(seen.mean()))

    def cost(psf: FloatArray, rough: float) -> tuple[float, float]:
        camera = replace(small, psf=np.ascontiguousarray(psf))
        prior = Prior(weight=rough * error * math.sqrt(camera.column_power), bounds=(0.0, math.inf))
        found = minimise(camera, seen, prior, 2 * _STEPS, 0.002)
        return found.objective, float(np.mean(np.square(camera.image_of(found.image) - seen))) / noise

    rough, fine = _ROUGH
    (objective, left), (alternative, chi_square) = cost(small.psf, rough), cost(small.psf, fine)
    rough, objective = (fine, alternative) if left > _LEFT else (rough, objective)
    others, grid = dict[str, float](), [2 * size for size in small.psf.shape]
    for name, (down, across) in _TURNED.items():
        copy = small.psf[::down, ::across]
        shifted = fft.irfft2(fft.rfft2(small.psf, grid) * fft.rfft2(copy, grid).conj(), grid)
        if shifted.max() < _ALIKE * math.sqrt(float(np.square(small.psf).sum() * np.square(copy).sum())):
            others[name] = cost(copy, rough)[0]
    reading = min(others, key=lambda name: others[name], default="")
    energy = max(float(np.mean(np.square(seen, dtype=np.float64))), 1e-300)
    off = [float(np.average(place, weights=np.abs(light.psf))) for place in np.indices(light.psf.shape)]
    rows, columns = light.psf.shape
    return PointSpreadFit(
        chi_square=chi_square,
        unexplained=math.sqrt(max(chi_square - 1, 0.0) * noise / energy),
        stated=variance is not None,
        gain=others[reading] / max(objective, 1e-300) if others else None,
        reading=reading,
        off=(off[0] - (rows - 1) / 2, off[1] - (columns - 1) / 2),
        size=(rows, columns),
    )


# ---- The image -------------------------------------------------------------------------------------------------------


def solve_point_spread(
    light: ShiftedLight,
    frames: Array,
    method: str,
    lam: float | Literal["auto"] = "auto",
    bounds: Bounds | None = None,
    iterations: int = 300,
    tolerance: float = 0.02,
) -> Solution:
    """Return the image of all frames (K K', m, m')."""
    light.check_frames(frames)
    if iterations < 1:
        raise MitsimError(f"iterations are {iterations}; give at least 1")
    prior = Prior(bounds=bounds or (Prior.bounds if method == TIKHONOV else (0.0, math.inf)))
    frames = frames.astype(light.precision)
    if lam != "auto":
        known = check_lambda(lam)
    elif method == TV:
        known = _WEIGHT * frame_error(light, frames) * math.sqrt(light.column_power)
    elif light.patterns is None:
        known = _RIDGE * frame_error(light, frames) / float(frames.mean()) * light.column_power
    else:
        raise MitsimError("lambda auto: is chosen under uniform light alone; under patterns give lambda as a number")
    prior = replace(prior, weight=known) if method == TV else replace(prior, ridge=known)
    energy = float(np.vdot(frames, frames))
    found = minimise(light, frames, prior, iterations, tolerance)
    residual = light.image_of(found.image) - frames
    figures = f"Objective {found.objective:.4g}."
    lowered = f"the last half of {found.iterations} iterations lowered the objective by {found.fall:.1%}"
    if found.fall <= tolerance:
        status = Status(Verdict.SOLVED, f"Converged: {lowered}", "", figures)
    else:
        remedy = "take a larger lambda, or allow more iterations"
        status = Status(Verdict.NOT_CONVERGED, f"Not converged: {lowered} or more", remedy, figures)
    return Solution(
        image=np.asarray(found.image[light.window], np.float64),
        lam=prior.weight or prior.ridge,
        residual=math.sqrt(float(np.vdot(residual, residual)) / energy) if energy else 0.0,
        status=status,
        iterations=found.iterations,
        objective=found.objective,
    )


# ---- From a run ------------------------------------------------------------------------------------------------------


@check_arguments
def reconstruct_psf(
    shots: Capture,
    psf: Path | str | FloatArray,
    reduce: int = 1,
    lam: float | Literal["auto"] = "auto",
    method: str = TIKHONOV,
    bounds: Bounds | None = None,
    iterations: int | None = None,
) -> Reconstruction:
    """Recover the image of a camera whose scene points all cast one pattern of light, each shifted by its place.

    One scene pixel shifts it by one pixel of the frames. Under uniform light the image is as large as the sensor, and
    under patterns as large as these.

    Parameters
    ----------
    shots
        Capture in memory, or of :func:`mitsim.core.runs.load_run`.
    psf
        Light (k, k') of a scene pixel, or a picture of it (:func:`mitsim.devices.camera.load_psf`), of the same
        pixels as the frames.
    reduce
        Pixels a side, of frames and of the picture, that become one.
    lam
        Lambda >= 0 in the unit of the point spread function squared, for ``tv`` the weight of the total variation;
        "auto" chooses it from the frames.
    method
        ``tikhonov``, ``nonnegative`` or ``tv``.
    bounds
        Least and largest number of the image [electrons/s], for ``nonnegative`` and ``tv``; None: 0 and inf.
    iterations
        Largest number of steps, for ``nonnegative`` and ``tv``; None: 300.

    Raises
    ------
    MitsimError
        For a picture without light, frames that do not fit, too little memory, and another lambda, method or bounds.
    """
    return reconstruct_psf_request(
        shots, psf, reduce, ImageRequest(lam=lam, method=method, bounds=bounds, iterations=iterations)
    )


@single_threaded_blas()
def reconstruct_psf_request(
    shots: Capture, psf: Path | str | FloatArray, reduce: int, request: ImageRequest, job: Job | None = None
) -> Reconstruction:
    request.check_point_spread(reduce)
    clock = (job or Job()).apart("").clock
    with clock.stage("read"):
        light, (left, right), digital, saturated = _light(psf, reduce), shots.patterns, shots.manifest.digital, 0
        rows, columns = shots.read(shots.manifest.patterns.captures[0].file)[0]["DN"].shape
        if min(rows, columns) < reduce:
            raise MitsimError(f"{shots.name}: frames of {rows} x {columns} pixels; reduce by less than {reduce}")
        uniform = left.shape[1] == right.shape[1] == 1 and bool((left == 1).all() and (right == 1).all())
        sensor = rows // reduce, columns // reduce
        camera = ShiftedLight(light, sensor, None if uniform else shots.patterns, np.float32)
        numbers = camera.grid[0] * camera.grid[1] + camera.count * sensor[0] * sensor[1]
        Cost(memory_bytes=4.0 * _NUMBERS * numbers).check(f"{shots.name}: its image", Limits())
        frames, variance = np.empty((camera.count, *sensor), np.float32), 0.0
        for each in shots.pattern_measurements((rows, columns)):
            frames[each.row * right.shape[1] + each.column] = reduce_frame(each.frame, reduce)
            saturated += each.saturated
            variance += float(np.mean(np.maximum(digital.variance(each.light, each.shots), 0.0)))
    with clock.stage("solve"):
        solution = solve_point_spread(camera, frames, request.name, request.lam, **request.iterative)
    with clock.stage("misfit"):
        known = variance / reduce**2 / camera.count if digital.noise_is_stated else None
        fit = find_fit(camera, frames, known)
    status = fit.judge(solution.status)
    flags = [f"The capture was flagged: {' '.join(warning.split()).rstrip('.')}." for warning in shots.warnings]
    if saturated:
        flags.append(f"{saturated} readings are at the full well or the ADC's end: expose for less.")
    return Reconstruction(
        **{**vars(solution), "status": replace(status, flags=(*status.flags, *flags))},
        fit=fit,
        seconds={stage: spent for stage, spent in clock.seconds().items() if stage != "total"},
        inputs=psf_inputs(shots, light, reduce, request),
    )


def psf_inputs(shots: Capture, psf: FloatArray, reduce: int, request: ImageRequest) -> dict[str, Any]:
    digest = hashlib.sha256(f"{psf.shape}".encode() + np.ascontiguousarray(psf).tobytes()).hexdigest()
    asked = {
        "run": shots.fingerprint,
        POINT_SPREAD: digest,
        "reduce": reduce,
        "lambda": request.lam,
        "method": request.method,
    }
    return {**asked, **request.plain}


def _light(psf: Path | str | FloatArray, reduce: int) -> FloatArray:
    if isinstance(psf, (str, Path)):
        return load_psf(psf, reduce)
    light = np.asarray(psf)
    if light.dtype.kind not in "uif":
        raise ArgumentError("psf", f"{cut(repr(psf))}: give rows x columns of real numbers, or a picture's path")
    light = light.astype(np.float64)
    if light.ndim != 2 or min(light.shape) < reduce:
        raise ArgumentError("psf", f"shape {light.shape}: give rows x columns, at least {reduce} a side")
    return reduce_frame(light, reduce)
