"""Measurements and the factorised model in; each frame as the others tell it, and faults of frames in words, out.

Where patterns overlap the model does it: patterns are left out of the sums W, and normal equations of the others are
solved. Under shifting dots no pixel is in two frames, and those left out have light as their pixels' neighbours.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter

from mitsim.core.arrays import FloatArray, sum_of_squares
from mitsim.core.runs import Measurement
from mitsim.reconstruct.accumulation import Accumulation
from mitsim.reconstruct.factorisation import group_pixels

Pattern = tuple[int, int]
BoolArray = npt.NDArray[np.bool_]

CHANCE = 6.0
"""Standard deviations of a frame's noise energy that are left to chance: 1e-9 for each of up to 65536 shots."""
OFF = 7e-3
"""Part of a frame, rms, by which it may be off: twice what all measurements together may, as print is not averaged."""
_ALIKE = 1e-3
"""Square of the sine between sum and difference of a pair's halves, below which one of them is as good as black."""
_SETTLED, _MOST_STEPS = 0.1, 100
"""Of :data:`CHANCE`, the energy below which a step of predicting changes nothing that counts; and the most steps,
which patterns that know nothing of each other do not need: chosen."""


# ---- Faults, and how they are said ----


class Fault(Enum):
    """What may be wrong with frames of a capture."""

    BLACK = auto()
    DIM = auto()
    BRIGHT = auto()
    REPEATED = auto()
    SWAPPED = auto()
    """Two frames are in each other's place."""
    MISPLACED = auto()
    """It holds the light of another pattern."""
    HALF_LOST = auto()
    SHIFTED = auto()
    CLIPPED = auto()
    NOISELESS = auto()
    FLICKER = auto()
    """The lamp's power differs from frame to frame."""


@dataclass(frozen=True)
class FrameFault:
    """A ``fault`` of the shots of some ``numbers``, in ``files``, from 0 in the manifest's order; ``words`` say it."""

    fault: Fault
    numbers: tuple[int, ...]
    files: tuple[str, ...]
    words: str

    def __str__(self) -> str:
        return self.words

    def summary(self) -> dict[str, Any]:
        """For result.json."""
        return {
            "fault": self.fault.name.lower(),
            "frames": list(self.numbers),
            "files": list(self.files),
            "words": self.words,
        }


# ---- Energies by pattern ----


class FrameSums:
    """Energies by pattern, (K, K') each, gathered as measurements are held against a model.

    ``residual``, ``power``, ``energy``: what is left of a pattern's measurement, sum of the squares of its shots, and
    of the measurement as the solver takes it. ``sums``: of signed patterns, energy by which the halves' sum differs
    from that of all others. ``halves``: light of a signed pattern's shots. ``digests``: patterns, and which of their
    shots, by a number that frames which are one and the same share. ``clipped``: of the shots that are, readings at
    their largest number. ``powers``: of signed patterns, how much brighter than their pair's mean light both halves
    are, and the first beside the second, as parts of it, by what the sum of the halves differs from that of all others;
    and the energies of sum and difference with the determinant of their products. Patterns with a black half do not
    tell the two apart.
    """

    def __init__(self, counts: tuple[int, int]) -> None:
        """Nothing yet, of ``counts`` K and K' of patterns."""
        self.residual, self.power, self.energy, self.sums = (np.zeros(counts) for _ in range(4))
        self.digests: dict[int, list[tuple[Pattern, int]]] = {}
        self.clipped: dict[tuple[Pattern, int], int] = {}
        self.halves: dict[Pattern, tuple[float, float]] = {}
        self.powers: dict[Pattern, tuple[float, float, float, float, float]] = {}

    def add(self, measurement: Measurement, residual: float, power: float, energy: float, total: FloatArray) -> None:
        """Count in one measurement.

        Parameters
        ----------
        measurement
            which pattern it is of.
        residual, power, energy
            of what is left of it, of its shots, and of itself as the solver takes it.
        total
            (rows, columns) light of all patterns' shots.
        """
        pattern = measurement.row, measurement.column
        self.residual[pattern], self.power[pattern], self.energy[pattern] = residual, power, energy
        for half, (digest, clipped) in enumerate(zip(measurement.digests, measurement.clipped, strict=True)):
            self.digests.setdefault(digest, []).append((pattern, half))
            if clipped:
                self.clipped[pattern, half] = clipped
        if measurement.shots == 2:
            light, difference = float(measurement.light.sum()), float(measurement.frame.sum())
            self.halves[pattern] = (light + difference) / 2, (light - difference) / 2
        others = self.residual.size - 1
        if measurement.shots == 2 and others:
            # light - (total - light) / others
            beyond = (measurement.light * (1 + others) - total) / others
            self.sums[pattern] = sum_of_squares(beyond)
            both, signed = measurement.light, measurement.frame
            # beyond = common both + apart signed, by least squares.
            whole, difference, shared = sum_of_squares(both), sum_of_squares(signed), float(np.vdot(both, signed))
            square = whole * difference - shared**2
            if square > _ALIKE * whole * difference:
                with_both, with_signed = float(np.vdot(beyond, both)), float(np.vdot(beyond, signed))
                common = (with_both * difference - with_signed * shared) / square
                apart = (with_signed * whole - with_both * shared) / square
                self.powers[pattern] = common, apart, whole, difference, square


# ---- Each frame as the others tell it ----


class LeaveOneOut:
    """Predicts each frame of a run from its others: of accumulated ``data``, whose image has the lambda ``lam``."""

    def __init__(self, data: Accumulation, lam: float) -> None:
        self.data, self.prepared, self.weights, self.noise = data, data.prepared, data.weights, data.noise
        self.manifest, self.patterns = data.shots.manifest, data.shots.patterns
        patterns, self.shots = self.patterns, self.manifest.patterns.captures
        self.number = {(shot.row, shot.column, shot.sign): index for index, shot in enumerate(self.shots)}
        self.signed = any(shot.sign for shot in self.shots)
        all_lit = [np.flatnonzero((side > 0).all(axis=0)) for side in patterns]
        self._whole = (int(all_lit[0][0]), int(all_lit[1][0])) if self.signed and all(map(len, all_lit)) else None
        self.sigma = sigma = self.prepared.sigma
        self._kept = np.divide(np.square(sigma), np.square(sigma) + lam, out=np.zeros_like(sigma), where=sigma > 0)
        self._periods = tuple(len(group_pixels(side, "block")) for side in patterns)
        lit = [(side != 0).sum(axis=1) for side in patterns]
        self.exclusive = bool(max(lit[0]) == 1 and max(lit[1]) == 1) and self.noise.variance.size > 1
        self.size = self.prepared.left.sensor_size * self.prepared.right.sensor_size

    def image(self, weights: FloatArray) -> FloatArray:
        """(n, n') image of the ``weights`` W at the image's lambda."""
        filtered = np.divide(self._kept * weights, self.sigma, out=np.zeros_like(weights), where=self.sigma > 0)
        return self.prepared.image(filtered)

    def lit_pixels(self, good: BoolArray) -> BoolArray:
        """(n, n') pixels that a ``good`` pattern lights."""
        left, right = ((side != 0).astype(np.float64) for side in self.patterns)
        return np.asarray(left @ good @ right.T > 0)

    def neighbours(self, image: FloatArray, lit: BoolArray) -> FloatArray:
        """(n, n') mean of each pixel's neighbours in an ``image``, along sides of several groups, that are ``lit``."""
        size = [3 if period > 1 else 1 for period in self._periods]
        light, count = (
            uniform_filter(values, size, mode="constant") * np.prod(size) - values
            for values in (image * lit, lit.astype(np.float64))
        )
        return np.asarray(np.divide(light, count, out=np.zeros_like(light), where=count > 0.5))

    def measurements(self, patterns: Iterable[Pattern]) -> dict[Pattern, Measurement]:
        """Those of ``patterns``."""
        wanted = set(patterns)
        return {key: each for each in self.data.measurements_again() if (key := (each.row, each.column)) in wanted}

    def all_but(self, bad: Iterable[Pattern]) -> BoolArray:
        """(K, K') whether patterns are none of the ``bad``."""
        good = np.ones(self.noise.variance.shape, dtype=np.bool_)
        for pattern in bad:
            good[pattern] = False
        return good

    def rest(self, measurements: Mapping[Pattern, Measurement]) -> FloatArray:
        """W without what some ``measurements`` add to it."""
        rest = self.weights.copy()
        for pattern, each in measurements.items():
            rest[self.prepared.places(pattern)] -= self.prepared.weights(self.prepared.as_solved(each.frame), pattern)
        return rest

    def without(self, bad: tuple[Pattern, ...]) -> tuple[FloatArray, float]:
        """W of all patterns, the ``bad`` ones as the others predict them, and what it explains of these others'
        energy."""
        rest = self.rest(self.measurements(bad))
        image = self.image(self.weights)
        if not self.exclusive and max(self._periods) > 1:
            # One pattern of +-1 that is wrong is a comb of the dots' period, without a mean.
            image = uniform_filter(image, self._periods, mode="nearest")
        lit = self.lit_pixels(self.all_but(bad))
        image = np.where(lit, image, self.neighbours(image, lit))
        left_duals, right_duals = self.prepared.left.duals, self.prepared.right.duals
        weights = np.asarray(self.sigma * (left_duals.T @ image @ right_duals))
        grams = {pattern: [slab.matrix.T @ slab.matrix for slab in self.prepared.slabs(pattern)] for pattern in bad}

        def of_bad(values: FloatArray) -> FloatArray:
            own = np.zeros_like(values)
            for pattern, (left, right) in grams.items():
                places = self.prepared.places(pattern)
                own[places] += left @ values[places] @ right
            return own

        if self.exclusive:
            weights = np.asarray(rest + of_bad(weights))
            return weights, float(np.vdot(weights, rest))
        # W - of_bad(W) = rest are the normal equations of the good ones: conjugate gradients after Hestenes and Stiefel
        # (1952), until a step brings these frames less than chance does.
        enough = _SETTLED * CHANCE * float(self.noise.variance.mean()) * np.sqrt(2 * self.size)
        left_over = rest + of_bad(weights) - weights
        step, squared = left_over.copy(), sum_of_squares(left_over)
        for _ in range(_MOST_STEPS):
            moved = step - of_bad(step)
            curvature = float(np.vdot(step, moved))
            if not curvature > 0:
                break
            length = squared / curvature
            weights = weights + length * step
            if length * squared < enough:
                break
            left_over -= length * moved
            before, squared = squared, sum_of_squares(left_over)
            step = left_over + squared / before * step
        return weights, float(np.vdot(weights, rest))

    def sums_against(self, weights: FloatArray, bad: Iterable[Pattern]) -> FrameSums:
        """Sums of all measurements against other ``weights``; the light of all is that of those not ``bad``."""
        sums = FrameSums((self.noise.variance.shape[0], self.noise.variance.shape[1]))
        total = np.zeros(0)
        if self.signed:
            good = zip(*np.nonzero(self.all_but(bad)), strict=True)
            total = sum((each.light for each in self.measurements(good).values()), start=np.zeros(()))
        others = max(self.noise.variance.size - len(set(bad)), 2)
        for each in self.data.measurements_again():
            pattern, frame = (each.row, each.column), self.prepared.as_solved(each.frame)
            residual = frame - self.prepared.frame(weights, pattern)
            sums.residual[pattern], sums.power[pattern] = sum_of_squares(residual), each.power
            sums.energy[pattern] = sum_of_squares(frame)
            if self.signed:
                sums.sums[pattern] = sum_of_squares((each.light * others - total) / (others - 1))
        return sums

    def fault(self, fault: Fault, numbers: Iterable[int], words: str) -> FrameFault:
        """That, of the first few frames by number and file.

        Parameters
        ----------
        fault, numbers, words
            as :class:`FrameFault` takes them, the files apart.
        """
        numbers = tuple(sorted(numbers))
        files = tuple(self.shots[number].file for number in numbers)
        shown = ", ".join(f"{number} ({file})" for number, file in zip(numbers[:4], files[:4], strict=True))
        more = f" and {len(numbers) - 4} more" if len(numbers) > 4 else ""
        return FrameFault(fault, numbers, files, f"frame{'s' if len(numbers) > 1 else ''} {shown}{more} {words}")
