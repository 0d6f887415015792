"""Image of a run by a measured point spread function, with the weight of its prior and a check of the fit.

*Weight.* Blocks of sensor pixels are left out, the image of the rest is made, and the light that it sends to these
blocks is compared with theirs. Where the lambda that predicts them best asks for clearly more noise than the frames
have, the model is wrong by as much, and the weight follows from that error in place of the noise.

*Fit.* A frame has fewer pixels than the scene, so that any point spread function fits it with some image. A wrong one
needs a negative or rough image. So the least of

    1/2 ||A X - Y||^2 + w TV(X),    X >= 0

is compared with that of the same light mirrored and turned, which has the same spectrum and thus the same power to
explain frames."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy import fft

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, cut
from mitsim.core.job import Cost, Job, Limits
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import Capture
from mitsim.devices.mask_profile import load_psf
from mitsim.reconstruct.point_spread import Array, ShiftedLight, minimise, reduce_frame
from mitsim.reconstruct.reconstruct import POINT_SPREAD, Reconstruction
from mitsim.reconstruct.request import TIKHONOV, TV, Bounds, ImageRequest
from mitsim.reconstruct.solver import Solution, Status, Verdict, check_lambda
from mitsim.reconstruct.solvers import Prior

RIDGE, _WEIGHT = 50.0, 1.2
"""Automatic lambda over the mean square of a scene pixel's light, by a frame's relative error; and automatic weight of
TV in units of the error of the data term's gradient. Chosen on photographs (benchmarks/iterative_losses.py)."""
_CLEARLY = 2.0
"""Ratio of the error by held-out pixels to the measured noise above which the model is wrong."""
_SIDE, _STEPS = 128, 60
"""Least side of reduced frames, and steps for held-out pixels."""
_BLOCKS, _KEPT = 12, 8
"""Blocks along the shorter side, of which one in eight is held out."""
_HALVES = range(-16, 7)
"""Tried weights in half decades."""
_TURNED = {"turned by 180 degrees": (-1, -1), "mirrored left to right": (1, -1), "mirrored upside down": (-1, 1)}
_MODEL_ERROR, _ROUGH, _LEFT = 0.01, (3.0, 0.3), 4.0
"""Least relative error of a model; TV's two weights in a comparison; and the chi-square above which the second one is
used.
"""
_ALIKE = 0.9
"""Correlation above which light equals its turned copy."""
_BETTER, _EQUAL = 0.85, 0.98
"""Cost ratio of the best turned copy to the light as given: below the first the copy is recommended, below the second
the light is wrong even if noise explains the frames."""
_LEAST_GAIN, _RISE, _NOISY = 1.015, 0.02, 1.2
"""Least cost ratio of right light: the first times chi-square to the power of the second. Below the last chi-square
noise explains the frames."""
_OFF = 1 / 8
"""Flagged distance of the light's mean from the middle of the picture, over its side."""
_GROSS, _GROSS_CHI_SQUARE = 0.1, 4.0
"""Part of the frames, rms, and chi-square, above which a fit is flagged without a comparison."""


def frame_noise(frame: Array) -> float:
    """Return the noise of a ``frame`` by the median of its mixed second differences; 0 for fewer than 3 x 3 pixels.

    Light of a few sharp lines does not change that median (Immerkaer, Comput. Vis. Image Underst. 64, 1996).
    """
    if min(frame.shape) < 3:
        return 0.0
    bent = np.diff(np.diff(frame, n=2, axis=0), n=2, axis=1)
    # The 9 weights have squares of 36 in all; half of normal numbers are below 0.6745 deviations.
    return float(np.median(np.abs(bent))) / 6 / 0.6745


def _noise_variance(frames: Array) -> float:
    rows, columns = (max(size // 16, 1) for size in frames.shape[1:])
    strips = [strip for frame in frames for strip in np.array_split(frame, rows)]
    tiles = [tile for strip in strips for tile in np.array_split(strip, columns, axis=1)]
    return float(np.mean([frame_noise(tile) ** 2 for tile in tiles]))


def _shrink(light: ShiftedLight, frames: Array) -> tuple[ShiftedLight, Array, int]:
    factor = 1 if light.patterns else max(min(*light.sensor, *light.psf.shape) // _SIDE, 1)
    return light.reduce(factor), np.stack([reduce_frame(frame, factor) for frame in frames]), factor


# ---- The weight ----


def frame_error(light: ShiftedLight, frames: Array) -> float:
    """Return the deviation of ``frames`` (K K', m, m') from the light that a model explains.

    This is their noise or, under uniform light, the noise whose ridge predicts held-out pixels best, if clearly more.
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
    level = mean * 10 ** (place / 2) / RIDGE
    return level if level > _CLEARLY * noise else noise


def automatic_prior(light: ShiftedLight, frames: Array, prior: Prior, kind: Literal["ridge", "weight"]) -> Prior:
    """Return ``prior`` with an automatic ridge or weight of TV.

    Raises MitsimError for frames without light, and for a ridge under patterns.
    """
    if kind == "weight":
        return replace(prior, weight=_WEIGHT * frame_error(light, frames) * math.sqrt(light.column_power))
    if light.patterns is not None:
        raise MitsimError("lambda auto: is chosen under uniform light alone; under patterns give lambda as a number")
    return replace(prior, ridge=RIDGE * frame_error(light, frames) / float(frames.mean()) * light.column_power)


# ---- The misfit ----


@dataclass(frozen=True)
class PointSpreadFit:
    """Fit of frames to a point spread function.

    Attributes
    ----------
    chi_square, unexplained
        Residual energy over that of noise, and residual beyond noise, rms, over the frames.
    stated
        Whether the sensor states its noise; otherwise it is measured from the frames.
    gain
        Cost of the best turned or mirrored copy over the cost of the light as given; None where all copies are alike.
    reading
        Orientation of that copy.
    off
        Rows and columns from the middle of the picture to the light's centre.
    size
        Rows and columns of the picture.
    """

    chi_square: float
    unexplained: float
    stated: bool
    gain: float | None
    reading: str
    off: tuple[float, float]
    size: tuple[int, int]

    @property
    def fault(self) -> tuple[str, str]:
        """Sentence and remedy; empty for a good fit."""
        left = (
            f"{self.unexplained:.1%} of the frames is left unexplained, {self.chi_square:.3g} times the noise's energy"
        )
        same = "use the light of one point as this camera sees it, as it lies in the frames"
        if self.gain is not None and self.gain < _BETTER:
            return f"Misfit: the point spread function fits better {self.reading}; {left}", f"turn it so, or {same}"
        least = _EQUAL if self.chi_square < _NOISY else _LEAST_GAIN * self.chi_square**_RISE
        if self.gain is not None and self.gain < least:
            return f"Misfit: the point spread function fits no better as given than {self.reading}; {left}", same
        if self.unexplained > _GROSS and self.chi_square > _GROSS_CHI_SQUARE:
            return f"Misfit: {left}", same
        rows, columns = self.off
        if max(abs(rows) / self.size[0], abs(columns) / self.size[1]) > _OFF:
            return (
                f"Misfit: the point's light is centred {rows:+.0f} rows and {columns:+.0f} columns from the middle of "
                "its picture, and the image is displaced as much",
                "take the picture of a point in the middle of the field, or shift it there",
            )
        return "", ""

    @property
    def gist(self) -> str:
        """Misfit in a few words."""
        return f"{self.unexplained:.1%} unexplained"

    def __str__(self) -> str:
        noise = "its stated noise" if self.stated else "noise, measured from the frames"
        cost = "" if self.gain is None else f"; turned or mirrored, the light costs {self.gain:.3g} times as much"
        return f"misfit: {self.unexplained:.1e} unexplained, chi-square {self.chi_square:.3g} against {noise}{cost}"

    def summary(self) -> dict[str, Any]:
        """Return the misfit's entries of result.json."""
        sentence, _ = self.fault
        return {
            "chi_square": self.chi_square,
            "unexplained": self.unexplained,
            "noise_stated": self.stated,
            "flagged": bool(sentence),
            "turned_cost": self.gain,
            "reading": self.reading if self.gain is not None and self.gain < _BETTER else None,
            "off_centre": list(self.off),
        }

    def judge(self, status: Status) -> Status:
        """Return the ``status`` of a solution with this misfit."""
        sentence, remedy = self.fault
        if not sentence:
            return status
        if not status.verdict.good:
            return replace(status, flags=(*status.flags, f"{sentence}; {remedy}."))
        return replace(status, verdict=Verdict.MISFIT, sentence=sentence, remedy=remedy)


def find_fit(light: ShiftedLight, frames: Array, variance: float | None) -> PointSpreadFit:
    """Return the fit of ``frames`` to ``light``; ``variance`` is their mean noise variance, None if not stated."""
    small, seen, factor = _shrink(light, frames)
    noise = max(_noise_variance(seen) if variance is None else variance / factor**2, 1e-300)
    error = math.hypot(math.sqrt(noise), _MODEL_ERROR * float(seen.mean()))

    def cost(psf: FloatArray, rough: float) -> tuple[float, float]:
        camera = replace(small, psf=np.ascontiguousarray(psf))
        prior = Prior(weight=rough * error * math.sqrt(camera.column_power), bounds=(0.0, math.inf))
        found = minimise(camera, seen, prior, 2 * _STEPS, 0.002)
        return found.objective, float(np.mean(np.square(camera.image_of(found.image) - seen))) / noise

    rough, fine = _ROUGH
    (objective, left), (alternative, chi_square) = cost(small.psf, rough), cost(small.psf, fine)
    rough, objective = (fine, alternative) if left > _LEFT else (rough, objective)
    copies = {name: small.psf[::rows, ::columns] for name, (rows, columns) in _TURNED.items()}
    others = {name: cost(copy, rough)[0] for name, copy in copies.items() if _likeness(small.psf, copy) < _ALIKE}
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


def _likeness(first: FloatArray, second: FloatArray) -> float:
    grid = [2 * size for size in first.shape]
    shifted = fft.irfft2(fft.rfft2(first, grid) * fft.rfft2(second, grid).conj(), grid)
    return float(shifted.max() / math.sqrt(float(np.square(first).sum() * np.square(second).sum())))


_NUMBERS = 24
"""Single-precision numbers in memory for each of a grid and of all frames."""


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
    """Return the image of all frames (K K', m, m').

    Parameters
    ----------
    method
        ``tikhonov``, ``nonnegative`` or ``tv``.
    lam
        Lambda, or the weight of ``tv``; "auto": :func:`automatic_prior`.
    bounds
        Least and largest number; None: any for ``tikhonov``, otherwise 0 and inf.
    iterations, tolerance
        See :func:`mitsim.reconstruct.point_spread.minimise`.
    """
    light.check_frames(frames)
    if iterations < 1:
        raise MitsimError(f"iterations are {iterations}; give at least 1")
    prior = Prior(bounds=bounds or (Prior.bounds if method == TIKHONOV else (0.0, math.inf)))
    frames = frames.astype(light.precision)
    if lam == "auto":
        prior = automatic_prior(light, frames, prior, "weight" if method == TV else "ridge")
    else:
        known = check_lambda(lam)
        prior = replace(prior, weight=known) if method == TV else replace(prior, ridge=known)
    energy = float(np.vdot(frames, frames))
    found = minimise(light, frames, prior, iterations, tolerance)
    residual = light.image_of(found.image) - frames
    figures = f"Objective {found.objective:.4g}, at most {found.gap:.1%} above its minimum, as far as is proven."
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
        relative_gap=found.gap,
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
    return reconstruct_psf_request(shots, psf, reduce, ImageRequest(lam, method, bounds=bounds, iterations=iterations))


@single_threaded_blas()
def reconstruct_psf_request(
    shots: Capture, psf: Path | str | FloatArray, reduce: int, request: ImageRequest, job: Job | None = None
) -> Reconstruction:
    """Recover the image of a request, see :func:`reconstruct_psf`."""
    request.check_point_spread(reduce)
    clock = (job or Job()).apart("").clock
    with clock.stage("read"):
        light, seen = _light(psf, reduce), _Frames(shots, reduce)
        patterns = None if seen.uniform else shots.patterns
        camera = ShiftedLight(light, seen.sensor, patterns, np.float32)
        grid = camera.grid[0] * camera.grid[1]
        numbers = grid + camera.count * camera.sensor[0] * camera.sensor[1]
        Cost(memory_bytes=4.0 * _NUMBERS * numbers).check(f"{shots.name}: its image", Limits())
        frames = seen.read()
    with clock.stage("solve"):
        solution = solve_point_spread(camera, frames, request.name, request.lam, **request.iterative)
    with clock.stage("misfit"):
        fit = find_fit(camera, frames, seen.variance)
    status = fit.judge(solution.status)
    flags = [f"The capture was flagged: {' '.join(warning.split()).rstrip('.')}." for warning in shots.warnings]
    if seen.saturated:
        flags.append(f"{seen.saturated} readings are at the full well or the ADC's end: expose for less.")
    return Reconstruction(
        **{**vars(solution), "status": replace(status, flags=(*status.flags, *flags))},
        rank=None,
        condition=None,
        rank_sides=None,
        condition_sides=None,
        misfit=None,
        fit=fit,
        uncertainties=None,
        seconds={stage: spent for stage, spent in clock.seconds().items() if stage != "total"},
        inputs=psf_inputs(shots, light, reduce, request),
    )


def psf_inputs(shots: Capture, psf: FloatArray, reduce: int, request: ImageRequest) -> dict[str, Any]:
    """Return what decides an image: fingerprints of the ``shots`` and of the ``psf``, and the request."""
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


class _Frames:
    def __init__(self, shots: Capture, reduce: int) -> None:
        self._shots, self._reduce = shots, reduce
        self.saturated = 0
        self.variance: float | None = 0.0 if shots.manifest.digital.noise_is_stated else None
        left, right = shots.patterns
        self.uniform = left.shape[1] == right.shape[1] == 1 and bool((left == 1).all() and (right == 1).all())
        first = shots.read(shots.manifest.patterns.captures[0].file)[0]["DN"].shape
        if min(first) < reduce:
            raise MitsimError(f"{shots.name}: frames of {first[0]} x {first[1]} pixels; reduce by less than {reduce}")
        self.sensor = (first[0] // reduce, first[1] // reduce)
        self._shape, self._columns, self._count = (first[0], first[1]), right.shape[1], left.shape[1] * right.shape[1]

    def read(self) -> FloatArray:
        frames = np.empty((self._count, *self.sensor), np.float32)
        for each in self._shots.pattern_measurements(self._shape):
            frames[each.row * self._columns + each.column] = reduce_frame(each.frame, self._reduce)
            self.saturated += each.saturated
            if self.variance is not None:
                variance = np.maximum(self._shots.manifest.digital.variance(each.light, each.shots), 0.0)
                self.variance += float(np.mean(variance)) / self._reduce**2 / self._count
        return frames
