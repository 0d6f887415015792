"""Measurements and the factorised model in; out comes how much of them the model leaves unexplained, and where.

Of data Y the model can explain what lies in its range, U_L W U_R^T, whatever the image: the residual R = Y - U_L W
U_R^T hangs on no lambda. Its energy is held against what the sensor's stated noise, that of the calibrated factors and
the error of simulated frames put there; what is more is *unexplained*: light that no flat, matt scene at the calibrated
distance sends.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.runs import Measurement
from mitsim.reconstruct.accumulation import Accumulation, FrameNoise
from mitsim.reconstruct.causes import Cause, Evidence, Reading, Readings, Signatures, likely_cause, multiple
from mitsim.reconstruct.defects import Defects, defects_of
from mitsim.reconstruct.estimate_factors import decibels
from mitsim.reconstruct.frame_check import FrameCheck
from mitsim.reconstruct.frame_faults import FrameFault, FrameSums
from mitsim.reconstruct.solution import Solution, Status, Verdict
from mitsim.reconstruct.solver import Prepared
from mitsim.reconstruct.subpixel import print_energy

UNEXPLAINED = 3.5e-3
"""Part of the measurements, rms, that a fitting scene may leave unexplained: prints leave up to 6e-4 (the shipped ones)
and 3e-3 (edges under pixels of 7.5 mm); a sheet 2 mm off 400 leaves 4.2e-3 (16 dots) to 1.0e-2 (49)."""
UNEXPLAINED_TILE = 2e-2
"""The same of a single tile, where print is not averaged: above all that fitting scenes left
(tests/physics/test_misfit.py)."""
CHANCE = 6.0
"""Standard deviations of the noise's own energy that are left to chance: with 64 tiles once in 10^7 images."""
GROSS = 0.1
"""Unexplained part from which an image is flagged where the noise was not stated; few photons leave as much, so that
the part has to be four times the energy of their shot noise, too."""
_GROSS_CHI_SQUARE = 4.0
"""The same as a chi-square, of shot noise alone: read noise of as many electrons makes 2."""
_SHOWN = 4
"""Faults that a sentence holds; result.json has them all."""
_LAMBDA_BESIDE = 1e-3
"""Lambda, over the largest sigma^2, by which frames are predicted beside an image whose own weight says nothing of it,
as of total variation: chosen, between those of bright and of dim runs."""
_MOSTLY = 0.5
"""Part of the unexplained energy at defective pixels from which frames are not blamed: most of it."""
_QUIET = 0.03
"""Of the sensor's noise, beside half of :data:`CHANCE`, that may be missing before tone curves are tried: chosen, gains
are stated to a few per cent."""
_TINY = 1e-300
"""Stands for 0 in a denominator."""
_TILES = 8
"""Tiles a side of the sensor's map: 64 x 64 pixels each of 512 x 512, so that a highlight fills some of them."""


# ---- The misfit, and what is said of it ----


@dataclass(frozen=True, eq=False)
class Misfit:
    """What the model leaves unexplained.

    Attributes
    ----------
    chi_square
        energy of the residual over what is expected of it; 1 where the model fits.
    unexplained
        square root of the energy beyond that and beyond what print within a pixel may add, relative to the
        measurements; 0 where nothing is.
    tiles
        (rows, columns) the chi-square of each tile of the sensor.
    worst_tile
        largest unexplained part of a tile.
    stated
        whether the noise of sensor and calibration were stated; otherwise only gross misfit is flagged.
    flagged
        whether more is left than chance and a fitting scene leave.
    cause
        the likely one of a flagged image.
    signatures
        of a flagged image: the parts of the unexplained energy by which causes are told apart.
    predicted
        what the calibration predicts of ``unexplained``, print apart, from what its factors lack of the camera; None
        where it does not know.
    faults
        frames that are not what they say; with any the image is flagged.
    reading
        of a flagged image: how else its frames fit; None where they do not.
    defects
        pixels of the sensor whose readings were left out, or are to be; None: there are none.
    detail
        part of the measurements, rms, that the frames themselves show to be print finer than a scene pixel, where the
        image would be flagged without; no part of ``unexplained``.
    """

    chi_square: float
    unexplained: float
    tiles: FloatArray
    worst_tile: float
    stated: bool
    flagged: bool
    cause: Cause | None
    signatures: Signatures | None
    predicted: float | None = None
    faults: tuple[FrameFault, ...] = ()
    reading: Reading | None = None
    defects: Defects | None = None
    detail: float = 0.0

    @property
    def gist(self) -> str:
        """The misfit in a few words."""
        return f"chi-square {chi_square_text(self.chi_square)} a datum"

    def __str__(self) -> str:
        noise = "" if self.stated else " of shot noise alone, as no other was stated"
        cause = f"; likely cause: {self.reason}" if self.cause else ""
        defects = f"; {self.defects}" if self.defects else ""
        detail = f" beside {self.detail:.1e} of print finer than a scene pixel" if self.detail else ""
        return f"misfit: {self.gist}{noise}, {self.unexplained:.1e} unexplained{detail}{cause}{defects}"

    @property
    def reason(self) -> str:
        """The cause in words; empty where none is known."""
        if self.reading:
            return self.reading.words
        return self.cause.value[0] if self.cause else ""

    def read_as(self, reading: Reading) -> Misfit:
        """The same of frames that fit when they are taken as another ``reading`` has them."""
        return replace(self, flagged=True, cause=reading.cause, reading=reading)

    def summary(self) -> dict[str, Any]:
        """What result.json and the command line's JSON say of it."""
        return {
            "chi_square": self.chi_square,
            "unexplained": self.unexplained,
            "worst_tile": self.worst_tile,
            "noise_stated": self.stated,
            "flagged": self.flagged,
            "cause": self.cause.name.lower() if self.cause else None,
            "signatures": asdict(self.signatures) if self.signatures else None,
            "foretold": self.predicted,
            "detail": self.detail,
            "defective_pixels": self.defects.summary() if self.defects else None,
            "reading": self.reading.words if self.reading else None,
            "faults": [fault.summary() for fault in self.faults],
            "map": self.tiles.tolist(),
        }

    def judge(self, status: Status) -> Status:
        """The ``status`` of a solution with this misfit."""
        if self.cause is None:
            return status
        if self.faults:
            more = f"; and {len(self.faults) - _SHOWN} more" if len(self.faults) > _SHOWN else ""
            named = "; ".join(map(str, self.faults[:_SHOWN]))
            return self._flag(status, f"Faulty frames: {named}{more}", Cause.FRAMES)
        times = f", {chi_square_text(self.chi_square)} times what its noise makes" if self.stated else ""
        predicted = ""
        if self.predicted:
            predicted = f"; its calibration foretells up to {self.predicted:.1%} ({decibels(self.predicted):.1f} dB)"
        sentence = (
            f"{self.unexplained:.1%} of the measurements fit no image{times}{predicted}; likely cause: {self.reason}"
        )
        return self._flag(status, f"Misfit: {sentence}", self.cause)

    def _flag(self, status: Status, sentence: str, cause: Cause) -> Status:
        """The ``status`` of a solution with a ``sentence`` and the remedy of a ``cause``."""
        remedy = cause.value[1]
        if not status.verdict.good:
            return replace(status, flags=(*status.flags, f"{sentence}; {remedy}."))
        return replace(status, verdict=Verdict.MISFIT, sentence=sentence, remedy=remedy)


def chi_square_text(chi_square: float) -> str:
    """A ``chi_square`` as people read it: fitting images differ in the third decimal, others by orders of magnitude."""
    return f"{chi_square:.3f}" if chi_square < 10 else f"{chi_square:.3g}"


# ---- Residuals of all measurements ----


class Residuals:
    """Sums over what the model leaves of every measurement, by tile of the sensor.

    Parameters
    ----------
    prepared
        the factorised model.
    weights
        (r, r') W of all measurements.
    noise
        of the measurements.
    evidence
        empty; gathers what tells causes apart.

    Attributes
    ----------
    energy, power
        (tiles, tiles) sums of the squares of measurements and of shots.
    pixels
        (tiles, tiles) pixels of each tile.
    by_pattern
        energies by pattern.
    squares
        (m, m') sum of the squares of residuals of each sensor pixel.
    """

    @classmethod
    def of(cls, data: Accumulation, evidence: Evidence) -> Residuals:
        """Of all measurements of accumulated ``data``, which are read once more; ``evidence`` is empty."""
        sums = cls(data.prepared, data.weights, data.noise, evidence)
        for measurement in data.measurements_again():
            sums.add(measurement)
        return sums

    def __init__(self, prepared: Prepared, weights: FloatArray, noise: FrameNoise, evidence: Evidence) -> None:
        self._prepared, self._weights, self._noise, self.evidence = prepared, weights, noise, evidence
        sizes = prepared.left.sensor_size, prepared.right.sensor_size
        edges = [np.linspace(0, size, min(_TILES, size) + 1).astype(np.intp) for size in sizes]
        self._strips = [slice(*ends) for ends in pairwise(edges[0])]
        self._starts = edges[1][:-1]
        self.pixels: FloatArray = np.outer(*(np.diff(edge) for edge in edges)).astype(np.float64)
        self.energy, self.power = (np.zeros(self.pixels.shape) for _ in range(2))
        self.squares: FloatArray = np.zeros(sizes)
        # Of one frame: to make them anew takes longer than to fill them.
        self._residual, self._squared = np.zeros(sizes), np.zeros(sizes)
        self.by_pattern = FrameSums((prepared.left.pattern_count, prepared.right.pattern_count))

    def add(self, measurement: Measurement) -> None:
        """Count in one ``measurement``."""
        frame = self._prepared.as_solved(measurement.frame)
        left, right = self._prepared.slabs((measurement.row, measurement.column))
        modelled = left.matrix @ self._weights[left.columns][:, right.columns]
        residual = np.matmul(modelled, right.matrix.T, out=self._residual)
        np.subtract(frame, residual, out=residual)
        flat = residual.ravel()
        self.squares += np.multiply(residual, residual, out=self._squared)
        energy = self._squares(frame)
        power = energy if frame is measurement.light else self._squares(measurement.light)
        if measurement.shots == 2:  # as Measurement.power has it
            power = (power + (energy if frame is measurement.frame else self._squares(measurement.frame))) / 2
        self.energy += energy
        self.power += power
        left_over, given = float(np.dot(flat, flat)), float(energy.sum())
        self.by_pattern.add(measurement, left_over, float(power.sum()), given, self._noise.light)
        mean = float(self._noise.means[measurement.row, measurement.column])
        self.evidence.add(measurement, frame, residual, float(self._noise.of(mean, measurement.shots)))

    @cached_property
    def variance(self) -> FloatArray:
        """(tiles, tiles) sum of the noise's variance."""
        # It is linear in the light: that of a tile's mean light is the tile's mean variance.
        count = self._noise.variance.size
        light = self._sums(self._noise.light) / self.pixels / count
        return self._noise.of(light, self._noise.shots) * self.pixels * count

    @property
    def residual(self) -> FloatArray:
        """(tiles, tiles) sum of the squares of residuals."""
        return self._sums(self.squares)

    def defects(self, whole: FloatArray | None) -> Defects | None:
        """Pixels that are off in all measurements, where the sensor's noise is stated.

        Parameters
        ----------
        whole
            (rows, columns) the halves' sum of signed patterns, as the model has it; None: it has none.
        """
        if not self._noise.stated:
            return None
        count = self._noise.variance.size
        mean = self._noise.light / count
        variance = self._noise.of(mean, self._noise.shots)
        found = defects_of(self.squares, count * variance, count)
        if whole is None:
            return found
        # Differences of halves tell little of pixels that stand still, their sums all.
        still = defects_of(np.square(self._prepared.as_solved(mean) - whole), variance / count, 1)
        return still.with_others(found) if still else found

    def at(self, defects: Defects) -> float:
        """Energy that is left at pixels that are ``defects``."""
        return float(self.squares[defects.rows, defects.columns].sum())

    @property
    def quiet(self) -> bool:
        """Whether less is left than the sensor's noise alone makes."""
        noise = float(self.variance.sum()) * self._prepared.spare
        return float(self.squares.sum()) < noise * (1 - _QUIET - _chance(self._noise, float(self.pixels.sum())) / 2)

    def expected_energy(self, factor_energy: float) -> FloatArray:
        """(tiles, tiles) energy that is expected of the residual: the sensor's noise less what the fit takes up, the
        error of simulated frames where the light is, and ``factor_energy`` evenly."""
        rendering = self._noise.rendering * self.power / max(float(self.power.sum()), _TINY)
        return np.asarray(
            self.variance * self._prepared.spare + rendering + factor_energy * self.pixels / self.pixels.sum()
        )

    def _sums(self, values: FloatArray) -> FloatArray:
        # Not reduceat along the rows: it takes five times as long.
        rows = np.stack([values[strip].sum(axis=0) for strip in self._strips])
        return np.asarray(np.add.reduceat(rows, self._starts, axis=1))

    def _squares(self, values: FloatArray) -> FloatArray:
        rows = np.stack([np.einsum("ij,ij->j", values[strip], values[strip]) for strip in self._strips])
        return np.asarray(np.add.reduceat(rows, self._starts, axis=1))


# ---- Measurements held against the model ----


def find_misfit(data: Accumulation, solution: Solution, with_defects: bool = True) -> Misfit | None:
    """Hold all measurements of accumulated ``data`` against the model; None where there are no more data than unknowns.

    Parameters
    ----------
    data
        whose frames are read again if they were not kept.
    solution
        of them, for what print and the factors' noise add to the frames.
    with_defects
        whether defective pixels are looked for, and no cause where there are some.
    """
    prepared, noise, image = data.prepared, data.noise, solution.image
    if prepared.spare <= 0:
        return None
    lack, factor_energy, of_ramps = data.lack(image), data.factor_energy(image), print_energy(data.model, image)
    evidence = Evidence(data.factors, data.shots.patterns, lack.energy if lack else None)
    lam = solution.lam if data.solver.linear else _LAMBDA_BESIDE * prepared.problem(data.frames).scale
    check, sums = FrameCheck(data, lam), Residuals.of(data, evidence)
    expected = sums.expected_energy(factor_energy or 0.0)
    balance = Balance(sums.residual, sums.energy, expected, sums.pixels, factor_energy is not None)
    found, excess = balance.misfit(noise, of_ramps)
    if evidence.predicted is not None:
        found = replace(found, predicted=float(np.sqrt(evidence.predicted / max(float(sums.energy.sum()), _TINY))))
    beside_noise = noise.rendering + (factor_energy or 0.0) + of_ramps
    if reading := multiple(noise, found.chi_square) or check.out_of_step(sums.by_pattern):
        return found.read_as(reading)
    defects = sums.defects(check.whole()) if with_defects else None
    if defects and excess > 0 and sums.at(defects) > _MOSTLY * excess:
        return replace(found, defects=defects)
    readings = Readings(data)
    chance = _chance(noise, float(sums.pixels.sum()))
    hinted = found.flagged or (found.stated and found.unexplained > UNEXPLAINED and found.chi_square > 1 + chance / 2)
    if hinted:
        beside = beside_noise / max(float(sums.energy.sum()), _TINY)
        reading = readings.fitting(found.unexplained, beside, check.all_off(sums.by_pattern, beside_noise))
    elif noise.stated and sums.quiet:
        reading = readings.tone_curve()
    if reading:
        return found.read_as(reading)
    faults = check.faults(sums.by_pattern, beside_noise)
    if faults:
        return replace(found, flagged=True, cause=Cause.FRAMES, faults=faults)
    if defects:
        return replace(found, defects=defects)
    if reading := check.negative():
        return found.read_as(reading)
    if not found.flagged:
        return found
    signatures = evidence.signatures(excess, noise.saturated / max(noise.readings, 1))
    # Of what is left beyond the sensor's noise, as signatures are.
    of_print = float(np.nan_to_num(signatures.detail)) * (excess + beside_noise)
    fine, _ = balance.misfit(noise, max(of_ramps, of_print))
    if not fine.flagged:
        return replace(fine, predicted=found.predicted, detail=float(np.sqrt(of_print / sums.energy.sum())))
    return replace(found, cause=likely_cause(signatures, found.unexplained, evidence.of_factors), signatures=signatures)


def faulty_frames(data: Accumulation, image: FloatArray, lam: float) -> tuple[FrameFault, ...]:
    """Frames at fault of a scene of several depths, of which the model fits a part.

    Parameters
    ----------
    data
        added up at the depth of most of the scene.
    image, lam
        (n, n') with a depth for each pixel, and its lambda.
    """
    beside = data.noise.rendering + (data.factor_energy(image) or 0.0) + print_energy(data.model, image)
    sums = Residuals.of(data, Evidence(data.factors, data.shots.patterns)).by_pattern
    return FrameCheck(data, lam).faults(sums, beside, fits=False)


# ---- Energies found and expected ----


@dataclass(frozen=True, eq=False)
class Balance:
    """Energies by tile of the sensor, or of all of it.

    Attributes
    ----------
    residual, energy, expected
        (rows, columns) of what a model leaves, of the measurements, and of what is expected to be left.
    pixels
        (rows, columns) of each tile.
    stated
        whether the noise of the factors was stated.
    """

    residual: FloatArray
    energy: FloatArray
    expected: FloatArray
    pixels: FloatArray
    stated: bool

    def misfit(self, noise: FrameNoise, print_energy: float) -> tuple[Misfit, float]:
        """How much is unexplained, of a cause that is not known, and its energy.

        Parameters
        ----------
        noise
            of the measurements.
        print_energy
            what print within a pixel may add.
        """
        beyond = self.residual - self.expected - print_energy * self.pixels / self.pixels.sum()
        energy, excess = float(self.energy.sum()), float(beyond.sum())
        unexplained = float(np.sqrt(max(excess, 0.0) / max(energy, _TINY)))
        tiles = np.sqrt(np.maximum(beyond, 0.0) / np.maximum(self.energy, _TINY))
        chi_square = float(self.residual.sum() / max(float(self.expected.sum()), _TINY))
        chi_squares = self.residual / np.maximum(self.expected, _TINY)
        stated = noise.stated and self.stated
        if stated:
            flagged = unexplained > UNEXPLAINED and chi_square > 1 + _chance(noise, float(self.pixels.sum()))
            local = (tiles > UNEXPLAINED_TILE) & (chi_squares > 1 + _chance(noise, float(self.pixels.min())))
            flagged = flagged or bool(local.any())
        else:
            flagged = unexplained > GROSS and chi_square > _GROSS_CHI_SQUARE
        found = Misfit(
            chi_square=chi_square,
            unexplained=unexplained,
            tiles=chi_squares,
            worst_tile=float(tiles.max()),
            stated=stated,
            flagged=flagged,
            cause=Cause.UNKNOWN if flagged else None,
            signatures=None,
        )
        return found, excess


def _chance(noise: FrameNoise, pixels: float) -> float:
    """What chance may add to the chi-square of that many ``pixels`` in all measurements: the energy of normal noise of
    variance v in n data varies by sqrt(2 n) v."""
    total = max(float(noise.variance.sum()), _TINY)
    return CHANCE * float(np.sqrt(2 * np.square(noise.variance).sum() / pixels)) / total
