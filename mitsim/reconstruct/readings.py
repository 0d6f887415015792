"""Measurements that fit no image in; out comes how else their frames may be read, where they fit that way.

Each other reading is added up anew by the same factorised model: frames turned or mirrored, shots in another order,
numbers without a tone curve (:mod:`mitsim.reconstruct.tonecurve`). U of the model is orthonormal, so that
|Y|^2 - |W|^2 is what a reading leaves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.manifests import RunManifest
from mitsim.core.runs import Measurement
from mitsim.reconstruct.causes import Cause
from mitsim.reconstruct.faults import STEPS
from mitsim.reconstruct.noise import FrameNoise
from mitsim.reconstruct.solver import Prepared
from mitsim.reconstruct.tonecurve import ToneCurves

_FITS = 0.05
"""Part of the unexplained energy that a reading may leave: chosen, so that it explains nearly all of it."""
_AT_MOST = 2e-2
"""Part of the measurements, rms, that it may leave: one that is right leaves 1e-2 of a sheet 2 mm beside the calibrated
distance."""
_CHANCE = 3.0
"""Standard deviations of noise that a reading may leave in any case, where that is less than half of what is
unexplained."""
_CUT = 1.5
"""Part of the unexplained energy that another order may leave, times the number of patterns: of a cycle that was
entered late one frame was taken before it."""
_CUT_AT_MOST = 0.3
"""The most of that: runs of a few frames do not tell an order."""
_MULTIPLIED, _LEAST_MULTIPLIED = 0.15, 1.5
"""Chi-square of multiplied numbers, over their factor, and at least: shot noise alone makes that the factor, and
a black level that was multiplied too, which then counts as light, 0.3 of it; what is rounded to a factor has 1.1."""

Frames = Iterator[tuple[FloatArray, int, int, float]]
"""Measurements, their patterns, and the energy that their noise is expected to have."""

_TURNS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "upside down, their rows reversed": lambda frame: frame[::-1],
    "mirrored, their columns reversed": lambda frame: frame[:, ::-1],
    "turned by 180 degrees": lambda frame: frame[::-1, ::-1],
    "transposed, their rows and columns exchanged": lambda frame: frame.T,
    "turned by 90 degrees counter-clockwise": lambda frame: np.rot90(frame, -1),
    "turned by 90 degrees clockwise": lambda frame: np.rot90(frame),
    "transposed about the other diagonal": lambda frame: frame[::-1, ::-1].T,
}
"""What frames may be, and what brings them back."""


@dataclass(frozen=True, eq=False)
class Reading:
    """Another way to take the frames: the ``cause`` that it is, in ``words``; which leaves the part ``left`` of all
    measurements, rms."""

    cause: Cause
    words: str
    left: float


@dataclass(frozen=True, eq=False)
class Readings:
    """Other readings of a run.

    Attributes
    ----------
    prepared
        the factorised model.
    manifest, noise
        of the run, and of its measurements.
    measured
        reads all measurements once more.
    """

    prepared: Prepared
    manifest: RunManifest
    noise: FrameNoise
    measured: Callable[[], Iterable[Measurement]]

    def fitting(self, unexplained: float, beside_noise: float, all_off: bool) -> Reading | None:
        """The reading that fits best, where one does.

        Parameters
        ----------
        unexplained
            part of the measurements, rms, that is left of them as they are.
        beside_noise
            part of their energy that rendering, the factors' noise and print put there.
        all_off
            whether most frames are off: then an order counts that leaves one frame of a cycle.
        """
        fits: list[Reading] = []
        for cause, words, frames, most in self._tried(all_off):
            left_over, expected = self._left_over(frames)
            left = max(left_over - expected - beside_noise, 0.0)
            numbers = self.noise.readings / self.noise.shots * self.prepared.spare
            chance = min(_CHANCE * expected * np.sqrt(2 / numbers), 0.5 * unexplained**2) if self.noise.stated else 0.0
            fit = left < most * unexplained**2 and (left < _AT_MOST**2 or most > _FITS)
            if fit or left < chance:
                fits.append(Reading(cause, words, float(np.sqrt(left))))
        return min(fits, key=lambda reading: reading.left, default=None) or self.curved()

    def curved(self) -> Reading | None:
        """The tone curve that the numbers went through, where one is likelier than none."""
        words = ToneCurves(self.prepared, self.manifest, self.measured).likeliest()
        return Reading(Cause.GAMMA, words, 0.0) if words else None

    def _left_over(self, frames: Frames) -> tuple[float, float]:
        """Part of the energy of ``frames`` that the model leaves, and that noise is expected to leave."""
        sums, noise = self.prepared.accumulator(), 0.0
        for frame, row, column, own in frames:
            sums.add(frame, row, column)
            noise += own
        problem = self.prepared.problem(sums)
        explained = float(np.square(problem.projected[problem.sigma > 0]).sum())
        energy = max(problem.energy, np.finfo(float).tiny)
        return 1 - explained / energy, noise * self.prepared.spare / energy

    def _tried(self, with_cut: bool) -> Iterator[tuple[Cause, str, Frames, float]]:
        """Cause, words and frames of each reading, and the part of the unexplained energy that it may leave;
        ``with_cut`` as ``all_off`` of :meth:`fitting` takes it."""
        shape = self.prepared.left.sensor_size, self.prepared.right.sensor_size
        for words, turn in _TURNS.items():
            if turn(np.zeros(shape)).shape == shape:
                yield Cause.ORIENTATION, f"the frames are {words}", self._each(turn), _FITS
        shots = self.manifest.patterns.captures
        size = self.prepared.left.pattern_count * self.prepared.right.pattern_count
        if size > 1:
            cut = min(max(_FITS, _CUT / size), _CUT_AT_MOST) if with_cut else _FITS
            orders = {"in the reverse order": lambda number: len(shots) - 1 - number}
            if any(shot.sign for shot in shots):  # of a step their light tells, as FrameCheck.out_of_step has it
                orders["with the halves of each pair exchanged"] = lambda number: number ^ 1
            else:
                orders |= {STEPS[0]: lambda number: number - 1, STEPS[1]: lambda number: number + 1}
            for words, order in orders.items():
                yield Cause.ORDER, f"the frames are {words}", self._ordered(order), cut

    def _each(self, turn: Callable[[FloatArray], FloatArray]) -> Frames:
        for each in self.measured():
            noise = float(self.noise.variance[each.row, each.column]) * each.frame.size
            yield np.ascontiguousarray(turn(each.frame)), each.row, each.column, noise

    def _shots(self) -> Iterator[tuple[int, FloatArray]]:
        """Number and light of each shot."""
        number = {(shot.row, shot.column, shot.sign): n for n, shot in enumerate(self.manifest.patterns.captures)}
        for each in self.measured():
            if each.shots == 1:
                yield number[each.row, each.column, 0], each.frame
                continue
            for sign in (1, -1):
                yield number[each.row, each.column, sign], (each.light + sign * each.frame) / 2

    def _ordered(self, order: Callable[[int], int]) -> Frames:
        """Measurements of the shots, each taken for that which ``order`` gives for its number."""
        return self._paired((order(number), light) for number, light in self._shots())

    def _paired(self, shots: Iterable[tuple[int, FloatArray]]) -> Frames:
        """Measurements of ``shots``, by their number: halves of signed patterns as their difference."""
        captures = self.manifest.patterns.captures
        waiting: dict[tuple[int, int], tuple[FloatArray, float]] = {}
        for number, light in shots:
            shot = captures[number % len(captures)]
            noise = float(np.maximum(self.manifest.digital.variance(light), 0.0).sum())
            own = (shot.sign * light if shot.sign else light), noise
            if shot.sign and (shot.row, shot.column) not in waiting:
                waiting[shot.row, shot.column] = own
                continue
            other = waiting.pop((shot.row, shot.column)) if shot.sign else (np.zeros(()), 0.0)
            yield own[0] + other[0], shot.row, shot.column, own[1] + other[1]


def multiple(noise: FrameNoise, chi_square: float) -> Reading | None:
    """That all numbers of a run are multiples of one, where its noise says that they were multiplied.

    Multiplied numbers count too many electrons: their variance is that many times the shot noise of so many. A camera
    whose file knows of the factor has the noise that it states.

    Parameters
    ----------
    noise
        of the run.
    chi_square
        of its misfit.
    """
    factor = noise.factor
    if factor < 2 or not chi_square > max(_MULTIPLIED * factor, _LEAST_MULTIPLIED):
        return None
    words = f"all numbers are multiples of {factor}"
    if factor & (factor - 1) == 0:
        words += f", as of fewer bits that were moved up by {factor.bit_length() - 1}"
    return Reading(Cause.SCALE, words, 0.0)
