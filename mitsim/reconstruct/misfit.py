"""Misfit of a run: the residual of the factorised model, compared with the noise of the measurements.

A run either fits its model at the level of its noise, or it is flagged, with the place and with the readings of the
data that restore the fit. Four measurements decide, in this order:

1. Noise: second differences of the residuals (:mod:`mitsim.reconstruct.residuals`).
2. Energy: the residuals' energy beyond that of noise, calibration error, rendering and print finer than a scene pixel,
   for the whole sensor, its tiles, rows, columns and pixels.
3. Frames: each frame against the prediction of the others (:mod:`mitsim.reconstruct.frame_check`).
4. Readings, if one of these is off: turned frames and shots in another order.

*Defective pixels.* A defective pixel is off in every frame, and its neighbours are not. A separable solver cannot
weigh single pixels, so their readings are replaced by the prediction from all others: setting y - r / (1 - h) at a
datum of leverage h leaves an image as if it had not been measured. Pixels that share frames are set in rounds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter, uniform_filter

from mitsim.core.arrays import FloatArray
from mitsim.core.runs import Measurement
from mitsim.reconstruct.accumulation import Accumulation, FrameNoise, print_energy
from mitsim.reconstruct.factors import decibels
from mitsim.reconstruct.focus import DerivedCapture
from mitsim.reconstruct.frame_check import FrameCheck, FrameFault, PictureCheck
from mitsim.reconstruct.residuals import (
    TINY,
    NoiseTest,
    Place,
    Reading,
    Residuals,
    find_readings,
    is_negative,
    noise_chance,
)
from mitsim.reconstruct.solution import Solution, Status, Verdict
from mitsim.reconstruct.solver import IndexArray

# ---- Defective pixels -----------------------------------------------------------------------------------------------

_SPREADS = 7.0
_AROUND, _CROWD = 3, 0.35
_MOST, _LEAKS = 0.02, 0.1
_LEAST_VARIANCE, _MOST_VARIANCE = 1e-3, 4.0
_ROUNDS, _PLACES_SHOWN = 8, 5


@dataclass(frozen=True, eq=False)
class Defects:
    rows: IndexArray
    columns: IndexArray

    def __str__(self) -> str:
        count, more = len(self.rows), ", ..." if len(self.rows) > _PLACES_SHOWN else ""
        places = ", ".join(map(str, self.places[:_PLACES_SHOWN]))
        return f"{count} defective pixel{'s' * (count > 1)} left out, at (row, column) {places}{more}"

    @property
    def places(self) -> list[tuple[int, int]]:
        return list(zip(self.rows.tolist(), self.columns.tolist(), strict=True))

    def summary(self) -> dict[str, object]:
        return {"count": len(self.rows), "first": self.places[:_PLACES_SHOWN]}

    def with_others(self, others: Defects | None) -> Defects:
        return Defects(*np.array(sorted({*self.places, *(others.places if others else ())}), dtype=np.intp).T)


class LeftOut(DerivedCapture):
    def __init__(self, data: Accumulation, defects: Defects) -> None:
        super().__init__(data.shots)
        self._data, self._places = data, (defects.rows, defects.columns)
        prepared, weights, whole = data.prepared, data.weights, data.lit_everywhere
        frames = ((each.row, each.column, prepared.as_solved(each.frame)) for each in data.measurements_again())
        values = {(row, column): frame[self._places] for row, column, frame in frames}
        self._moved = {pattern: np.zeros(len(defects.rows)) for pattern in values}
        # If a reading changes, the means of its row and column take up their part.
        gain = (1 - 1 / prepared.left.sensor_size) * (1 - 1 / prepared.right.sensor_size) if prepared.centre else 1.0
        for _ in range(_ROUNDS):
            change = np.zeros_like(weights)
            for pattern, value in values.items():
                left, right = prepared.slabs(pattern)
                own, other = left.matrix[defects.rows], right.matrix[defects.columns]
                predicted = (own @ weights[left.columns][:, right.columns] * other).sum(axis=1)
                step = (predicted - value) / gain - self._moved[pattern]
                self._moved[pattern] += step
                change[prepared.places(pattern)] += own.T @ (step[:, None] * other)
            weights += change
        # The sum of the halves of a signed pattern, which is that of all pairs.
        self._total = prepared.frame(weights, whole)[self._places] if whole else np.zeros(len(defects.rows))

    def pattern_measurements(self, shape: tuple[int, int] | None = None) -> Iterator[Measurement]:
        for each in self._data.measurements_again():
            frame, light = each.frame.copy(), each.light.copy()
            frame[self._places] += self._moved[each.row, each.column]
            light[self._places] = np.maximum(np.abs(frame[self._places]), self._total)
            yield replace(each, frame=frame, light=light)


def find_defects(data: Accumulation, squares: FloatArray, ratio: float) -> Defects | None:
    noise, prepared, count = data.noise, data.prepared, data.noise.variance.size
    mean = noise.light / count
    variance = ratio * noise.of(mean, noise.shots)
    found = defects_of(squares, count * variance, count)
    if noise.shots == 1 or (whole := data.lit_everywhere) is None:
        return found
    # Differences of halves show little of pixels that stand still, and their sums show all of it.
    still = defects_of(np.square(prepared.as_solved(mean) - prepared.frame(data.weights, whole)), variance / count, 1)
    return still.with_others(found) if still else found


def defects_of(squares: FloatArray, variance: FloatArray, count: int) -> Defects | None:
    mean = float(variance.mean()) or 1.0
    ratio = squares / np.clip(variance, _LEAST_VARIANCE * mean, _MOST_VARIANCE * mean)
    limit, typical, most, width = _limit(count), (1 - 2 / (9 * count)) ** 3, float(ratio.max()), 2 * _AROUND + 1
    # What the scene's light is off by at a pixel may be the same in all frames: the square of one number.
    # What bright ones are off by leaks into others: these first.
    least = limit + _limit(1) * max(float(np.median(ratio)) / typical - 1, 0.0)
    off = (ratio > least) & (ratio > _LEAKS * most)
    places = np.argwhere(off)
    if not most > limit or not 0 < len(places) <= _MOST * ratio.size:
        return None
    padded = np.pad(ratio, _AROUND, mode="reflect")
    around = np.array([np.median(padded[row : row + width, column : column + width]) for row, column in places])
    # A spot of light is off in pixels side by side, and so are its edges.
    crowd = np.where(off, uniform_filter(off.astype(np.float64), width, mode="constant"), 0.0)
    kept = ratio[off] > limit * np.maximum(around / typical, 1.0)
    rows, columns = places[kept & (maximum_filter(crowd, width)[off] < _CROWD)].T
    return Defects(rows, columns) if len(rows) else None


def _limit(count: int) -> float:
    """Return the quantile of a chi-square of ``count`` degrees of freedom over ``count`` (Wilson and Hilferty 1931)."""
    return float((1 - 2 / (9 * count) + _SPREADS * np.sqrt(2 / (9 * count))) ** 3)


UNEXPLAINED = 3.5e-3
"""Unexplained part of the measurements, rms, at most: prints leave up to 3e-3; 2 mm off 400 leaves 4.2e-3 or more."""
GROSS, _GROSS_CHI_SQUARE = 0.1, 4.0
_LAMBDA_BESIDE = 1e-3
_SHOWN, _MOSTLY = 4, 0.5


class Cause(Enum):
    NOISE = (
        "the frames' noise",
        "check gain, read noise and black level of the camera file, and that the numbers are raw",
    )
    READING = "another reading of the frames", "see which of the readings is true, and import the frames so"
    FRAMES = "frames that do not fit the others", "capture these frames again"
    PIXELS = "a part of the sensor or of the session", "look at the map of the misfit, and capture again"
    SATURATION = "readings at the full well or the ADC's end", "expose for less"
    MODEL = (
        "light that the calibrated camera does not see from a flat matt scene at the calibrated distance: depth, "
        "gloss, indirect light, light of the room, print finer than a scene pixel, numbers that are not linear in the "
        "light, or another camera",
        "try `--focus auto`, darken the room or take an ambient_frame, check that the camera is the calibrated one "
        "and compare the misfit's map with the scene",
    )


@dataclass(frozen=True, eq=False)
class Misfit:
    """Part of the measurements that the model does not explain, and its cause.

    ``chi_square`` is the residual's energy over the expected one, by tile in ``tiles``; ``unexplained`` is the rms of
    the excess beyond print, relative to the measurements, of which the calibration predicts ``predicted``. Without
    ``stated`` noise only gross misfit is flagged. ``noise`` is measured over stated noise, ``gain`` the camera's stated
    gain [DN per electron].
    """

    chi_square: float
    unexplained: float
    tiles: FloatArray
    worst_tile: float
    stated: bool
    flagged: bool
    cause: Cause | None = None
    noise: NoiseTest | None = None
    gain: float | None = None
    predicted: float | None = None
    faults: tuple[FrameFault, ...] = ()
    places: tuple[Place, ...] = ()
    readings: tuple[Reading, ...] = ()
    defects: Defects | None = None
    picture: PictureCheck | None = None
    limits: tuple[dict[str, Any], ...] = ()

    @property
    def gist(self) -> str:
        return f"chi-square {chi_square_text(self.chi_square)} a datum"

    def __str__(self) -> str:
        noise = "" if self.stated else " of shot noise alone, as no other was stated"
        others = "".join(f"; {other}" for other in (self.reason, self.defects) if other)
        return f"misfit: {self.gist}{noise}, {self.unexplained:.1e} unexplained{others}"

    @property
    def reason(self) -> str:
        words = self.cause.value[0] if self.cause else ""
        if self.cause is Cause.READING:
            words = f"the frames fit if {'; or if '.join(each.words for each in self.readings[:_SHOWN])}"
            if len(self.readings) > 1:
                words += f" ({len(self.readings)} readings fit alike, and the frames cannot decide)"
        elif self.cause is Cause.FRAMES:
            words = "; ".join(map(str, self.faults[:_SHOWN]))
        elif self.cause is Cause.PIXELS and self.places:
            words = f"the misfit is in {self.places[0].words}"
        elif self.cause is Cause.NOISE and self.noise:
            words = f"the frames' noise has {self.noise.ratio:.3g} times the variance that the camera file states"
            if self.gain and self.noise.gain_error < 0.1 * self.noise.gain:
                measured, error = self.gain * self.noise.gain, self.gain * self.noise.gain_error
                words += f"; stated gain {self.gain:.4g} DN per electron, measured {measured:.3g} +- {error:.1g}"
        return words

    def summary(self) -> dict[str, Any]:
        measured = self.gain * self.noise.gain if self.gain and self.noise and self.noise.gain > 0 else None
        return {
            "chi_square": self.chi_square,
            "unexplained": self.unexplained,
            "worst_tile": self.worst_tile,
            "flagged": self.flagged,
            "detail": 0.0,  # of earlier versions, which measured print finer than a scene pixel
            "noise_stated": self.stated,
            "cause": self.cause.name.lower() if self.cause else None,
            "reason": self.reason or None,
            "noise_ratio": self.noise.ratio if self.noise else None,
            "gain_stated": self.gain,
            "gain_measured": measured,
            "foretold": self.predicted,
            "defective_pixels": self.defects.summary() if self.defects else None,
            "reading": self.readings[0].words if len(self.readings) == 1 else None,
            "readings": [reading.summary() for reading in self.readings],
            "places": [place.words for place in self.places],
            "faults": [fault.summary() for fault in self.faults],
            "limits": list(self.limits),
            "power_error": float(np.median(self.picture.power_error)) if self.picture else None,
            "map": self.tiles.tolist(),
        }

    def judge(self, status: Status) -> Status:
        if self.cause is None:
            return status
        times = f", {chi_square_text(self.chi_square)} times what its noise makes" if self.stated else ""
        head = f"Misfit: {self.unexplained:.1%} of the measurements fit no image{times}; "
        head = {Cause.NOISE: "Noise is not as stated: ", Cause.FRAMES: "Faulty frames: "}.get(self.cause, head)
        sentence, remedy = head + self.reason, self.cause.value[1]
        if self.predicted:
            sentence += f"; its calibration foretells up to {self.predicted:.1%} ({decibels(self.predicted):.1f} dB)"
        if len(self.faults) > _SHOWN and self.cause is Cause.FRAMES:
            sentence += f"; and {len(self.faults) - _SHOWN} more"
        if status.verdict.good:
            return replace(status, verdict=Verdict.MISFIT, sentence=sentence, remedy=remedy)
        return replace(status, flags=(*status.flags, f"{sentence}; {remedy}."))


def chi_square_text(chi_square: float) -> str:
    return f"{chi_square:.3f}" if chi_square < 10 else f"{chi_square:.3g}"


# ---- Measurements held against the model ----


def find_misfit(data: Accumulation, solution: Solution, with_defects: bool = True) -> Misfit | None:
    """Compare all measurements with the model; return None where there are no more data than unknowns."""
    prepared, noise, image = data.prepared, data.noise, solution.image
    if prepared.spare <= 0:
        return None
    factor_energy, of_ramps = data.factor_energy(image), print_energy(data.model, image)
    beside, known = noise.rendering + (factor_energy or 0.0), factor_energy is not None
    stated = float(noise.variance.sum()) * noise.light.size * prepared.spare
    lam = solution.lam if data.solver.linear else _LAMBDA_BESIDE * prepared.problem(data.frames).scale
    sums = Residuals(data)
    test, energy, whole = sums.noise_test, max(float(sums.energy.sum()), TINY), float(sums.squares.sum())
    # Numbers without an ADC may be means of many shots.
    off = test is not None and test.off(noise, whole, stated, beside) and bool(test.ratio >= 1 or data.digital.step_dn)
    ratio = 1.0 if test is None or (noise.stated and not off) else test.ratio if off else max(test.ratio, 1.0)
    energies = sums.residual, sums.energy, sums.expected_energy(ratio, factor_energy or 0.0), sums.pixels
    found, excess = weigh(energies, known, noise, of_ramps)
    chi_square = whole / max(stated + beside, TINY) if off else found.chi_square  # by the stated noise
    found = replace(found, noise=test, gain=data.digital.gain_dn_per_e, chi_square=chi_square)
    if lack := data.lack(image):
        found = replace(found, predicted=float(np.sqrt(lack.energy / energy)))
    if with_defects and noise.stated and not sums.clipped and (defects := find_defects(data, sums.squares, ratio)):
        return replace(found, defects=defects)  # the caller leaves them out, and tries again
    check = FrameCheck(data, sums, lam, ratio, beside + of_ramps)
    faults, places = check.faults(), tuple(sums.places(ratio)) if noise.stated and not off else ()
    turned = noise.shots == 2 and is_negative(prepared, data.shots.patterns, sums.weights)
    # A reading is looked for in dim light, too, where chance hides half of what is off.
    hint = 1 + noise_chance(noise, float(sums.pixels.sum())) / 2
    hinted = found.stated and found.unexplained > UNEXPLAINED and found.chi_square > hint
    suspect = found.flagged or faults or places or off or turned or hinted
    readings = find_readings(data, ratio, beside + of_ramps) if suspect else ()
    full, local = noise.saturated > 1e-5 * noise.readings, bool(places) and places[0].energy > _MOSTLY * excess
    unlike = Cause.SATURATION if full else Cause.PIXELS if local else Cause.MODEL
    findings = {Cause.READING: readings, Cause.FRAMES: faults, unlike: found.flagged and not off}
    later = {Cause.PIXELS: places, Cause.MODEL: turned, Cause.NOISE: off}
    cause = next((cause for some in (findings, later) for cause, finding in some.items() if finding), None)
    found = replace(found, faults=faults, places=places, readings=readings, flagged=cause is not None, cause=cause)
    return replace(found, picture=check.picture, limits=check.limits())


def faulty_frames(data: Accumulation, image: FloatArray, lam: float) -> tuple[FrameFault, ...]:
    beside = data.noise.rendering + (data.factor_energy(image) or 0.0) + print_energy(data.model, image)
    return FrameCheck(data, Residuals(data), lam, 1.0, beside).faults()


# ---- Energies found and expected ----


def weigh(
    energies: tuple[FloatArray, ...], factors_stated: bool, noise: FrameNoise, print_energy: float
) -> tuple[Misfit, float]:
    residual, energy, expected, pixels = energies
    beyond = residual - expected - print_energy * pixels / pixels.sum()
    excess = float(beyond.sum())
    unexplained = float(np.sqrt(max(excess, 0.0) / max(float(energy.sum()), TINY)))
    tiles = np.sqrt(np.maximum(beyond, 0.0) / np.maximum(energy, TINY))
    chi_square = float(residual.sum() / max(float(expected.sum()), TINY))
    chi_squares = residual / np.maximum(expected, TINY)
    stated = noise.stated and factors_stated
    part, most = (UNEXPLAINED, 1 + noise_chance(noise, float(pixels.sum()))) if stated else (GROSS, _GROSS_CHI_SQUARE)
    flagged = unexplained > part and chi_square > most
    cause = Cause.MODEL if flagged else None
    return Misfit(chi_square, unexplained, chi_squares, float(tiles.max()), stated, flagged, cause), excess
