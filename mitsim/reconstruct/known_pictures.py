"""Calibration by captures of known pictures, anew or by moving the factors of an aged calibration.

Prints, screens or images by another calibration serve as pictures. All planes of a colour sensor see one mask, so that
their codes are fitted together.

*Aged calibration.* A factor is a shadow Phi[u, i] = M(u + s i), with M of any mask. A shadow that has moved by b sensor
pixels, in steps that are 1 + k times as long as the mask's distance is, is M(u - b + s i + k (s (i - i_c) - r (u -
u_c))), r = d / (z - d) where the depth z is known, else 0. M between sensor pixels is a spline through all numbers of
the factor, each at its own u + s i. The light, b of either side and k are fitted by Gauss-Newton steps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded
from scipy.optimize import minimize_scalar

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError, check_arguments
from mitsim.core.files import output_folder
from mitsim.core.job import Job
from mitsim.core.manifests import CALIBRATION, RUN, CalibrationManifest, FactorNoise, open_lines, write_colours
from mitsim.core.parallel import single_threaded_blas
from mitsim.devices.framelist import MOST_TERMS, KnownCaptures, load_known
from mitsim.reconstruct.factors import (
    LARGEST_ERROR,
    SEPARABLE_RESIDUAL,
    UNKNOWN_NOISE,
    Factors,
    load_calibration,
    rank_above_noise,
    squared_condition,
)
from mitsim.reconstruct.moving_shadow import shadow_step
from mitsim.reconstruct.shifted_codes import (
    TURNS,
    Choice,
    Codes,
    Exposure,
    KnownFrames,
    Pose,
    Shape,
    choose_terms,
    find_pose,
    fit_codes,
)
from mitsim.reconstruct.solution import Status, Verdict
from mitsim.reconstruct.solver import centre_columns, centre_frame

_KNOTS = 4
"""Knots of the spline for each sensor pixel."""
_STIFFNESS = 1e-3
"""Weight of squared third differences of the spline's coefficients over that of a number of the factor."""
_WAY_ERROR = 0.02
"""Tolerance of the shadow's way s n over the whole scene [pixels]."""
_PASSES, _MOVED = 20, 0.05
"""Largest number of Gauss-Newton steps, and the last step's largest size in standard errors."""
_HALVINGS = 8
"""Largest number of halvings of a step that increases the misfit."""
_REACH = 8
"""The shadow is sought within one part in so many of the sensor."""
_STARTED = 4
"""Largest number of frames that start the search."""
_CLEARER = 1.5
"""Ratio of residuals above which another orientation of the pictures is certain."""
_MASK = "mask_rows_um", "mask_columns_um", "mask_axis_um"
"""Names of the mask's displacements in results [um]."""


def mend_factors(captures: KnownCaptures, folder: Path, job: Job) -> dict[str, Factors]:
    """Move the factors of an aged calibration until frames of known pictures fit.

    Parameters
    ----------
    captures
        Runs and pictures, which lie as images by that calibration do.
    folder
        CAL folder of this camera before its mask, projector or light moved.

    Returns
    -------
    dict
        Factors by the runs' planes; "" where runs have none.

    Raises
    ------
    MitsimError
        For fields that the calibration decides, other orientations of pictures, and another camera.
    """
    listed = captures.listed
    for name in ("orientation", "scale", "terms"):
        if getattr(listed, name) is not None:
            raise MitsimError(
                f"list {captures.path}: {name} is of codes that are found from nothing, and calibration {folder} has "
                f"its own; leave {name} out, and give pictures as images by that calibration lie"
            )
    aged = _load_aged(captures, folder)
    for name in ("centre", "board_reflectance"):
        own = getattr(next(iter(aged.values())).manifest, name)
        if name in listed.model_fields_set and getattr(listed, name) != own:
            raise MitsimError(
                f"list {captures.path}: {name} is {getattr(listed, name)}, but {own} in calibration {folder}, which "
                "decides; leave it out"
            )
    with job.clock.stage("read"):
        read = KnownFrames.of(captures, aged)
    job.progress("fit", 0.3)
    with job.clock.stage("fit"):
        camera = _AgedCamera(aged)
        start = camera.first_guess(read, str(captures.path))
        before = camera.misfit(read, start.still())
        fitted = camera.fit(read, start)
        after = camera.misfit(read, fitted)
    return {name: _mended_factors(captures, read, camera, fitted, (before, after), name, job) for name in aged}


def _load_aged(captures: KnownCaptures, folder: Path) -> dict[str, Factors]:
    run = open_lines(captures.run(captures.listed.known[0]), RUN)
    return {name: load_calibration(part) for name, part in run.check_calibration(folder).parts.items()}


@dataclass(frozen=True, eq=False)
class _Moved:
    move: FloatArray
    gains: dict[str, float]
    covariance: FloatArray
    converged: bool = True
    unknown: float = 0.0

    def still(self) -> _Moved:
        return replace(self, move=np.zeros(3))

    def after_step(self, step: FloatArray) -> _Moved:
        gains = {name: gain + more for (name, gain), more in zip(self.gains.items(), step[3:].tolist(), strict=True)}
        return replace(self, move=self.move + step[:3], gains=gains)


@dataclass(frozen=True, eq=False)
class _Normal:
    matrix: FloatArray
    right: FloatArray
    systematic: FloatArray
    misfit: float


class _Shadow:
    def __init__(self, factor: FloatArray, scale: float) -> None:
        self.factor, self.scale = factor, scale
        rows, count = factor.shape
        self._place = np.arange(rows)[:, None] + scale * np.arange(count)
        self._first, self._last = float(self._place.min()), float(self._place.max())
        size = int(np.ceil((self._last - self._first) * _KNOTS)) + 1
        self._knots = self._first + np.arange(-3, size + 4) / _KNOTS
        self._brightness = np.ones(count)
        design = BSpline.design_matrix(self._place.ravel(), self._knots, 3)
        for _ in range(2):
            lit = design.multiply(np.broadcast_to(self._brightness, factor.shape).reshape(-1, 1)).tocsr()
            normal = lit.T @ lit
            bands = np.zeros((4, normal.shape[0]))
            for k, stiff in enumerate((20, -15, 6, -1)):  # of third differences, each with the next ones
                bands[k, : normal.shape[0] - k] = normal.diagonal(-k) + _STIFFNESS * stiff
            self._spline = BSpline(self._knots, solveh_banded(bands, lit.T @ factor.ravel(), lower=True), 3)
            still = self._spline(self._place)
            below = np.maximum(np.square(still).sum(axis=0), np.finfo(np.float64).tiny)
            self._brightness = (still * factor).sum(axis=0) / below
        self._still = still

    @classmethod
    def of(cls, factor: FloatArray, name: str) -> _Shadow:
        count = factor.shape[1]
        first = -shadow_step(factor)
        if abs(first) * count < 1:
            raise MitsimError(
                f"calibration {name}: its columns are no shadow that moves over the sensor, so nothing tells how they "
                "move with a mask; calibrate anew"
            )
        bounds, options = (first - 0.5 / count, first + 0.5 / count), {"xatol": _WAY_ERROR / count}
        best = minimize_scalar(
            lambda scale: cls(factor, scale)._unlike, bounds=bounds, method="bounded", options=options
        )
        return cls(factor, float(best.x))

    @property
    def _unlike(self) -> float:
        return float(np.linalg.norm(self._still * self._brightness - self.factor))

    def move_by(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]:
        place = self._place + pixels
        within = (place >= self._first) & (place <= self._last)
        place = np.clip(place, self._first, self._last)
        moved = self.factor + self._brightness * (self._spline(place) - self._still)
        return moved, self._brightness * self._spline(place, 1) * within, within


class _AgedCamera:
    def __init__(self, factors: Mapping[str, Factors]) -> None:
        self.factors = factors
        self.first = next(iter(factors.values())).manifest
        one = next(iter(factors.values()))
        # All planes see one mask.
        scales = [_Shadow.of(side, one.name).scale for side in (one.left, one.right)]
        self._shadows = {
            name: [_Shadow(side, scale) for side, scale in zip((each.left, each.right), scales, strict=True)]
            for name, each in factors.items()
        }
        parallax = self.first.parallax
        self._ratio = parallax.mask_distance_mm / (parallax.depth_mm - parallax.mask_distance_mm) if parallax else 0.0

    def side(self, line: str, axis: int, move: FloatArray) -> tuple[FloatArray, float]:
        moved, _, known = self._shadows[line][axis].move_by(self._longer(line, axis) * move[2] - move[axis])
        return moved, float(1 - known.mean())

    def _seen_rows(self, line: str, axis: int, move: FloatArray) -> npt.NDArray[np.bool_]:
        known = self._shadows[line][axis].move_by(self._longer(line, axis) * move[2] - move[axis])[2]
        return np.asarray(known.all(axis=1))

    def _longer(self, line: str, axis: int) -> FloatArray:
        """Return the displacement (m, n) along the sensor [pixels] of the shadow of a mask at twice the distance."""
        shadow = self._shadows[line][axis]
        rows, count = shadow.factor.shape
        further = shadow.scale * (np.arange(count) - (count - 1) / 2)
        return np.asarray(further - self._ratio * (np.arange(rows)[:, None] - (rows - 1) / 2))

    def sides(self, line: str, move: FloatArray) -> tuple[FloatArray, FloatArray]:
        left, right = (self._without_means(self.side(line, axis, move)[0]) for axis in (0, 1))
        return left, right

    def _without_means(self, side: FloatArray) -> FloatArray:
        return centre_columns(side) if self.first.centre else side

    def _slopes(self, line: str, move: FloatArray) -> tuple[FloatArray, FloatArray]:
        found = []
        for axis in (0, 1):
            longer = self._longer(line, axis)
            _, slope, _ = self._shadows[line][axis].move_by(longer * move[2] - move[axis])
            own = [np.zeros_like(slope), np.zeros_like(slope), slope * longer]
            own[axis] = -slope
            found.append(np.stack([self._without_means(each) for each in own]))
        return found[0], found[1]

    # -------- Where to begin

    def first_guess(self, read: KnownFrames, name: str) -> _Moved:
        some = read.exposures[:: -(-len(read.exposures) // _STARTED)]
        likeness = {
            turn: self._shift([each.turn_scene(turn) for each in some])
            for turn in TURNS
            if "transposed" not in turn or some[0].scene.shape[0] == some[0].scene.shape[1]
        }
        best = max(likeness, key=lambda turn: likeness[turn][0])
        if 1 - likeness["upright"][0] ** 2 > _CLEARER * (1 - likeness[best][0] ** 2):
            raise MitsimError(
                f"list {name}: the calibration's images lie {best} beside these pictures: frames correlate by "
                f"{likeness[best][0]:.3f} so, as they are by {likeness['upright'][0]:.3f}; save the pictures {best}"
            )
        move = np.array([*likeness["upright"][1], 0.0])
        guess = _Moved(move, dict.fromkeys(self.factors, 1.0), np.zeros((3 + len(self.factors),) * 2))
        return replace(guess, gains=self._gains(read, move))

    def _shift(self, exposures: Sequence[Exposure]) -> tuple[float, tuple[int, int]]:
        rows, columns = exposures[0].frame.shape
        reach = rows // _REACH, columns // _REACH
        size = [count + most for count, most in zip((rows, columns), reach, strict=True)]
        total: FloatArray = np.zeros((2 * reach[0] + 1, 2 * reach[1] + 1))
        places = [np.arange(-most, most + 1) for most in reach]
        for each in exposures:
            left, right = self.sides(each.plane, np.zeros(3))
            pair = [centre_frame(frame) for frame in (each.frame, left @ each.scene @ right.T)]
            length = float(np.prod([np.linalg.norm(frame) for frame in pair]))
            seen, predicted = (np.fft.rfft2(frame, size) for frame in pair)
            alike = np.fft.irfft2(seen * np.conj(predicted), size)[np.ix_(*places)]
            total += alike / max(length, np.finfo(np.float64).tiny) / len(exposures)
        row, column = np.unravel_index(int(np.argmax(total)), total.shape)
        return float(total.max()), (int(places[0][row]), int(places[1][column]))

    def _gains(self, read: KnownFrames, move: FloatArray) -> dict[str, float]:
        above, below = dict.fromkeys(self.factors, 0.0), dict.fromkeys(self.factors, 0.0)
        sides = {line: self.sides(line, move) for line in self.factors}
        for each in read.exposures:
            model = sides[each.plane][0] @ each.scene @ sides[each.plane][1].T
            above[each.plane] += float(np.vdot(model, each.frame))
            below[each.plane] += float(np.vdot(model, model))
        if not all(energy > 0 for energy in below.values()):
            raise MitsimError(
                "known pictures: have no light, or an even one, and tell nothing of the camera; give others"
            )
        return {line: above[line] / below[line] for line in self.factors}

    # -------- Steps of Gauss and Newton

    @single_threaded_blas()
    def fit(self, read: KnownFrames, start: _Moved) -> _Moved:
        variances = self._variances(read, start)
        at, here, converged = start, self._normal(read, start, variances), False
        for _ in range(_PASSES):
            step = np.asarray(np.linalg.solve(here.matrix, here.right), dtype=np.float64)
            errors = np.sqrt(np.diag(np.linalg.inv(here.matrix)))
            for _ in range(_HALVINGS):
                there = self._normal(read, at.after_step(step), variances)
                if there.misfit <= here.misfit * (1 + 1e-12):
                    break
                step = step / 2
            at, here = at.after_step(step), there
            converged = bool((np.abs(step) < _MOVED * errors).all())
            if converged:
                break
        inverse = np.linalg.inv(here.matrix)
        _, _, ratio = self.misfit(read, at)
        covariance = inverse @ (here.matrix + here.systematic) @ inverse * max(ratio, 1.0)
        shape = read.exposures[0].frame.shape
        within = all(abs(way) < count / _REACH for way, count in zip(at.move[:2], shape, strict=True))
        unknown = max(self.side(line, axis, at.move)[1] for line in self.factors for axis in (0, 1))
        return replace(at, covariance=covariance, converged=converged and within, unknown=unknown)

    def _variances(self, read: KnownFrames, at: _Moved) -> list[float]:
        found = []
        for number, (each, (model, _)) in enumerate(zip(read.exposures, self._models(read, at), strict=True)):
            found.append(read.noise(number, each.frame - model))
        floor = max(max(found), np.finfo(np.float64).tiny) * 1e-6
        return [max(each, floor) for each in found]

    def _normal(self, read: KnownFrames, at: _Moved, variances: Sequence[float]) -> _Normal:
        size, lines = 3 + len(self.factors), [*self.factors]
        matrix, systematic, right, misfit = np.zeros((size, size)), np.zeros((size, size)), np.zeros(size), 0.0
        for line in lines:
            left, other = self.sides(line, at.move)
            slopes, gain, noise = self._slopes(line, at.move), at.gains[line], self.factors[line].manifest.noise
            own = [0, 1, 2, 3 + lines.index(line)]
            # Sensor rows and columns that see what no pixel saw before tell nothing of where the shadow is.
            seen = np.multiply.outer(*(self._seen_rows(line, axis, at.move) for axis in (0, 1)))
            pulls = [np.zeros((4, *side.shape)) for side in (left, other)]
            for each, variance in zip(read.exposures, variances, strict=True):
                if each.plane != line:
                    continue
                lit, shown = each.scene @ other.T, left @ each.scene
                model = left @ lit
                changes = [gain * (a @ lit + shown @ b.T) for a, b in zip(*slopes, strict=True)]
                jacobian = np.stack([*changes, model]) * seen
                rest = (each.frame - gain * model) * seen
                flat = jacobian.reshape(4, -1)
                matrix[np.ix_(own, own)] += flat @ flat.T / variance
                right[own] += flat @ rest.ravel() / variance
                misfit += float(np.sum(np.square(rest))) / variance
                pulls[0] += gain / variance * (jacobian @ lit.T)
                pulls[1] += gain / variance * (jacobian.transpose(0, 2, 1) @ shown)
            for pull, error in zip(pulls, (noise.left, noise.right) if noise else (0.0, 0.0), strict=True):
                pull = pull.reshape(4, -1)
                systematic[np.ix_(own, own)] += error**2 * (pull @ pull.T)
        return _Normal(matrix, right, systematic, misfit)

    def _models(self, read: KnownFrames, at: _Moved) -> Iterator[tuple[FloatArray, float]]:
        sides = {line: self.sides(line, at.move) for line in self.factors}
        for each in read.exposures:
            (left, right), gain = sides[each.plane], at.gains[each.plane]
            lit, shown, noise = each.scene @ right.T, left @ each.scene, self.factors[each.plane].manifest.noise
            error = 0.0
            if noise is not None:
                parts = (
                    noise.left**2 * float(np.sum(lit**2)) / len(right),
                    noise.right**2 * float(np.sum(shown**2)) / len(left),
                )
                error = gain**2 * sum(parts)
            yield gain * (left @ lit), error

    def misfit(self, read: KnownFrames, at: _Moved) -> tuple[float, float, float]:
        return read.misfit(self._models(read, replace(at, gains=self._gains(read, at.move))))

    # -------- In words and numbers

    def numbers(self, at: _Moved) -> dict[str, dict[str, Any]]:
        values = [*at.move.tolist(), *at.gains.values()]
        names = ["shadow_rows", "shadow_columns", "mask_distance", *(f"light {line}".strip() for line in at.gains)]
        units = ["pixels", "pixels", *["1"] * (1 + len(at.gains))]
        errors = np.sqrt(np.diag(at.covariance)).tolist()
        parallax = self.first.parallax
        if parallax is not None:
            distance = parallax.mask_distance_mm
            ways: FloatArray = np.zeros((3, len(values)))
            for axis, window in enumerate((parallax.row_tan, parallax.column_tan)):
                ways[axis, axis] = 1e3 * parallax.pitch_mm(axis) * (1 - distance / parallax.depth_mm)
                ways[axis, 2] = 1e3 * distance * (window[0] + window[1]) / 2
            ways[2, 2] = 1e3 * distance
            names, units = [*names, *_MASK], [*units, *["um"] * 3]
            values += (ways @ values).tolist()
            errors += np.sqrt(np.diag(ways @ at.covariance @ ways.T)).tolist()
        return {
            name: {"value": value, "standard_error": error, "unit": unit}
            for name, value, error, unit in zip(names, values, errors, units, strict=True)
        }


def _mended_factors(
    captures: KnownCaptures,
    read: KnownFrames,
    camera: _AgedCamera,
    at: _Moved,
    misfits: tuple[tuple[float, float, float], tuple[float, float, float]],
    line: str,
    job: Job,
) -> Factors:
    aged = camera.factors[line]
    old = aged.manifest
    root = float(np.sqrt(abs(at.gains[line])))
    left, right = (
        (root * camera.side(line, axis, at.move)[0]).astype(np.float32).astype(np.float64) for axis in (0, 1)
    )
    noise = old.noise and old.noise.model_copy(update={"left": old.noise.left * root, "right": old.noise.right * root})
    (_, unexplained_before, chi_before), (explained, unexplained, chi_square) = misfits
    numbers = camera.numbers(at)
    status = _aged_status(numbers, at, (unexplained_before, unexplained), bool(np.isfinite(read.noises).all()))
    flagged = (f"the calibration was flagged before it was mended: {text}" for text in aged.warnings)
    warnings = (*flagged, *read.warnings(), *(() if status.ok else (str(status),)))
    result: dict[str, Any] = {
        "n": left.shape[1],
        "frames": read.frames,
        "pictures": len(captures.listed.known),
        "moved": numbers,
        "unknown": at.unknown,
        "explained": explained,
        "chi_square": chi_square,
        "chi_square_before": chi_before,
        "separability_residual": float(np.sqrt(max(1 - explained, 0.0))),
        "unexplained_residual": unexplained,
        "unexplained_before": unexplained_before,
        "noise_free_residual": None,
        "phi_error": None,
        "condition": max(squared_condition(left), squared_condition(right)),
        "exposure_s": captures.manifests[line].digital.exposure_s,
        "saturated_runs": read.saturated,
        "seconds": job.clock.seconds(),
        "warnings": warnings,
    }
    distance = 1 + float(at.move[2])
    parallax = old.parallax and old.parallax.model_copy(
        update={"mask_distance_mm": old.parallax.mask_distance_mm * distance}
    )
    stated = old.model_copy(
        update={
            "configuration": {
                **old.configuration,
                "aged": {"calibration": aged.name, "factors": aged.fingerprint},
                "known": str(captures.path),
                "list": captures.listed.model_dump(mode="json"),
                "sha256": read.sums,
            },
            "digital": captures.manifests[line].digital,
            "noise": noise,
            "parallax": parallax,
            "modelled": None,
            "result": result,
            "warnings": warnings,
            "versions": versions(),
            "command": job.command,
            "estimate": str(status),
            "verdict": status.verdict.value,
        }
    )
    return Factors(left, right, stated, status)


def _aged_status(
    numbers: Mapping[str, Mapping[str, Any]], at: _Moved, parts: tuple[float, float], stated: bool
) -> Status:
    before, after = parts
    figures = moved_in_words(numbers) + f"; left over {before:.2%} before, {after:.2%} after."
    if not (at.converged and all(gain > 0 for gain in at.gains.values())):
        return Status(
            Verdict.NOT_CONVERGED,
            "The shadow of the calibration was not found in these frames: it has moved by more than an eighth of the "
            "sensor, or is another one",
            "check that pictures and runs belong together, or calibrate anew",
            figures,
        )
    if after > (SEPARABLE_RESIDUAL if stated else UNKNOWN_NOISE):
        return Status(
            Verdict.NOT_SEPARABLE,
            f"Frames hold more than the calibration's factors explain however they move: {after:.1%} of them is left "
            f"over, {before:.1%} before",
            "calibrate anew if the mask has turned or tilted, or stands otherwise; check that each run is of its "
            "picture"
            + ("" if stated else "; state digital.read_noise_e, as noise is guessed from neighbouring pixels"),
            figures,
        )
    return Status(Verdict.CALIBRATED, "Mended by known pictures: factors moved until frames fit", "", figures)


def moved_in_words(numbers: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the ``numbers`` of a mended calibration in a line."""
    return ", ".join(
        f"{name.replace('_um', '').replace('_', ' ')} {each['value']:.4g} +-{each['standard_error']:.2g}"
        + (f" {each['unit']}" if each["unit"] != "1" else "")
        for name, each in numbers.items()
    )


_MOST_TRIED = 3
"""Largest number of codes of a side that is tried."""


@check_arguments
def calibrate_known(
    listed: Path | str | KnownCaptures,
    output: Path | str | None = None,
    job: Job | None = None,
    aged: Path | str | None = None,
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
    aged
        CAL folder of this camera before its mask, projector or light moved, whose factors are moved until frames fit.
        None makes factors of the pictures alone.

    Returns
    -------
    dict
        Factors by the runs' planes; "" where runs have none. They are flagged where frames contain more than the model
        explains, or pictures do not determine their orientation.

    Raises
    ------
    MitsimError
        For a list, run or picture that breaks a rule or does not fit, another camera, and an output that cannot be
        written.
    """
    captures = listed if isinstance(listed, KnownCaptures) else load_known(listed)
    job = job or Job()
    with nullcontext() if output is None else output_folder(output) as place:
        found = _calibrate(captures, job) if aged is None else mend_factors(captures, Path(aged), job)
        if place is not None:
            for name, factors in found.items():
                (place / name).mkdir(exist_ok=True)
                factors.write(place / name)
            if captures.lines is not None:
                write_colours(place, captures.lines.model_copy(update={"kind": CALIBRATION}))
    return found


def _calibrate(captures: KnownCaptures, job: Job) -> dict[str, Factors]:
    listed = captures.listed
    with job.clock.stage("read"):
        read = KnownFrames.of(captures)
    job.progress("pose", 0.2)
    with job.clock.stage("pose"):
        pose = find_pose(read.exposures, listed.orientation, listed.scale)
    turned = [each.turn_scene(pose.orientation) for each in read.exposures]
    shape = Shape(pose.scales, 1, listed.centre)
    job.progress("choice", 0.5)
    with job.clock.stage("choice"):
        choice = Choice(listed.terms) if listed.terms else choose_terms(turned, shape, min(_MOST_TRIED, MOST_TERMS))
    job.progress("fit", 0.8)
    with job.clock.stage("fit"):
        codes = fit_codes(turned, Shape(pose.scales, choice.terms, listed.centre))
    return {name: _factors(captures, read, pose, choice, codes, name, job) for name in captures.manifests}


# ---- Codes as factors ----


def _factors(
    captures: KnownCaptures, read: KnownFrames, pose: Pose, choice: Choice, codes: Codes, line: str, job: Job
) -> Factors:
    listed, manifest = captures.listed, captures.manifests[line]
    if "transposed" in pose.orientation:
        raise MitsimError(
            f"list {captures.path}: pictures lie {pose.orientation} before the camera, and its factors are of rows and "
            "columns; save the pictures transposed, or turn the frames as they are imported"
        )
    left, right = codes.factors(read.places.get(line, (0.0, 0.0)), line)
    # Images lie as pictures do: a scene that is turned is one whose factors run the other way.
    left = left[:, ::-1] if pose.orientation in ("upside down", "turned") else left
    right = right[:, ::-1] if pose.orientation in ("mirrored", "turned") else right
    left, right = (np.ascontiguousarray(side, dtype=np.float32).astype(np.float64) for side in (left, right))
    root = np.sqrt(abs(codes.gains[line]))
    norms = [float(np.linalg.norm(side) / np.sqrt(side.size)) for side in (left, right)]
    whole, seen = (
        [root * error / norm for error, norm in zip(errors, norms, strict=True)]
        for errors in (codes.errors, codes.seen_errors)
    )
    explained, unexplained, chi_square = read.misfit(
        (_model(codes, each.turn_scene(pose.orientation)), 0.0) for each in read.exposures
    )
    rank = [rank_above_noise(side, error) for side, error in zip((left, right), whole, strict=True)]
    status = _status(
        choice, codes, (explained, unexplained), bool(np.isfinite(read.noises).all()), float(np.hypot(*seen)), rank
    )
    # Without its figures, which differ by plane.
    warnings = (*_warnings(captures, read, pose), *(() if status.ok else (f"{status.sentence}; {status.remedy}.",)))
    lengths = [side.length * side.terms for side in codes.sides]
    result: dict[str, Any] = {
        "n": left.shape[1],
        "frames": read.frames,
        "pictures": len(listed.known),
        "orientation": pose.orientation,
        "orientation_margin": pose.margin,
        "scale": list(pose.scales),
        "terms": choice.terms,
        "held_out": list(choice.held_out),
        "explained": explained,
        "chi_square": chi_square,
        "separability_residual": float(np.sqrt(max(1 - explained, 0.0))),
        "unexplained_residual": unexplained,
        "noise_free_residual": None,
        "phi_error": None,
        "predicted_phi_error": float(np.hypot(*whole)),
        "predicted_frame_error": float(np.hypot(*seen)),
        "code_numbers": lengths,
        "told": list(codes.told),
        "rank": rank,
        "condition": max(squared_condition(left), squared_condition(right)),
        "exposure_s": manifest.digital.exposure_s,
        "saturated_runs": read.saturated,
        "seconds": job.clock.seconds(),
        "warnings": warnings,
    }
    stated = CalibrationManifest(
        configuration={
            "known": str(captures.path),
            "list": listed.model_dump(mode="json"),
            "sha256": read.sums,
            **({"turn_deg": read.prepared.turn_deg} if read.prepared.turn_deg else {}),
        },
        camera=manifest.camera,
        centre=listed.centre,
        board_reflectance=listed.board_reflectance,
        digital=manifest.digital,
        noise=FactorNoise(left=seen[0] * norms[0], right=seen[1] * norms[1], unexplained=unexplained),
        result=result,
        warnings=warnings,
        versions=versions(),
        command=job.command,
        estimate=str(status),
        verdict=status.verdict.value,
    )
    return Factors(left, right, stated, status)


def _model(codes: Codes, exposure: Exposure) -> FloatArray:
    left, right = codes.factors(exposure.offset, exposure.plane)
    return np.asarray(left @ exposure.scene @ right.T)


def _status(
    choice: Choice, codes: Codes, parts: tuple[float, float], stated: bool, error: float, rank: list[int]
) -> Status:
    explained, unexplained = parts
    sides = [side.scene for side in codes.sides]
    figures = (
        f"Frames tell {codes.told[0]:.0f} and {codes.told[1]:.0f} numbers of the codes, rank {rank[0]} of {sides[0]} "
        f"and {rank[1]} of {sides[1]}; in frames of such pictures the factors have an error of {error:.1e}."
    )
    if error > LARGEST_ERROR:
        return Status(
            Verdict.MOSTLY_NOISE,
            f"Factors are mostly noise: in frames of such pictures they have an error of {error:.0%}, allowed are "
            f"{LARGEST_ERROR:.0%}",
            "capture more pictures, or longer",
            figures,
        )
    if unexplained > (SEPARABLE_RESIDUAL if stated else UNKNOWN_NOISE):
        return Status(
            Verdict.NOT_SEPARABLE,
            f"Frames hold more than codes seen through shifts explain: {unexplained:.1%} of them is left over",
            ("" if stated else "state digital.read_noise_e, as noise is guessed from neighbouring pixels; ")
            + "check that each run is of its picture, that pictures are as light as what was shown (gamma), and that "
            "the frames stand straight",
            figures,
        )
    code = "one code" if choice.terms == 1 else f"{choice.terms} codes that change over the scene"
    return Status(
        Verdict.CALIBRATED,
        f"Calibrated by known pictures: {code} a side explain{'s' if choice.terms == 1 else ''} {explained:.1%} "
        "of what frames have beside even light",
        "",
        figures,
    )


def _warnings(captures: KnownCaptures, read: KnownFrames, pose: Pose) -> Iterator[str]:
    if not pose.certain and pose.margin is not None:
        yield (
            f"orientation: {pose.orientation!r} explains no more than {pose.margin:.1%} of the frames beyond another; "
            "give pictures that are not symmetric, or state orientation in the list"
        )
    yield from read.warnings()
