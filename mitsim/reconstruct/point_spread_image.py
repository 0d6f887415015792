"""Image of a run by a measured point spread function."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, cut
from mitsim.core.job import Cost, Job, Limits
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import Capture
from mitsim.devices.mask_profile import load_psf
from mitsim.reconstruct.point_spread import ShiftedLight, find_fit, reduce_frame, solve_point_spread
from mitsim.reconstruct.reconstruct import POINT_SPREAD, Reconstruction
from mitsim.reconstruct.request import TIKHONOV, Bounds, ImageRequest

_NUMBERS = 24


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
        Light (k, k') of a scene pixel, or a picture of it (:func:`mitsim.devices.mask_profile.load_psf`), of the same
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
