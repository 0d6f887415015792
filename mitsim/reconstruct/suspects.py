"""Frames that are suspected in; what was read of each out, what it is off by, and what others in its place leave.

Of a signed pattern whose halves' sum is off one half is wrong: which, is found here.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray, sum_of_squares
from mitsim.reconstruct.leaveoneout import CHANCE, OFF, BoolArray, LeaveOneOut, Pattern
from mitsim.reconstruct.solver import centred

EXPLAINS = 0.2
"""Part of what a frame is off by that a fault may leave: chosen, with room for what the others foretell badly."""
LEFT = 3.0
"""Standard deviations of noise that a fault may leave."""
_STEPS = 12
"""Rounds in which patterns left out are foretold from the rest: each brings what overlapping patterns know to a half or
less of its distance."""
_MOST_PAIRS = 6
"""Pairs of which it is tried which half is wrong: 64 images."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What was read at a pattern that is suspected: a shot, or of a signed pattern whose halves' sum is right both.

    Attributes
    ----------
    numbers
        of its shots.
    pattern
        that it is of.
    raw, frame
        (m, m') its light, and that as the solver takes it.
    foretold
        (m, m') the same as the other frames tell it; None: they do not.
    variance
        of a datum of ``frame``, and of what it is held against.
    off
        energy beyond noise that it is off by.
    """

    numbers: tuple[int, ...]
    pattern: Pattern
    raw: FloatArray
    frame: FloatArray
    foretold: FloatArray | None
    variance: float
    off: float


class Suspects:
    """Patterns that are suspected.

    Parameters
    ----------
    check
        of the run.
    bad
        the patterns, each with whether its brightness alone is off.
    weights
        W, with these as the others foretell them.
    """

    def __init__(self, check: LeaveOneOut, bad: dict[Pattern, bool], weights: FloatArray) -> None:
        self._check, self._bad, self._weights = check, bad, weights
        self._measured = check.measurements(bad)
        self._total = check.noise.light
        self._foretold = {pattern: check.modelled(weights, *pattern) for pattern in bad}
        self._rest = check.weights.copy()
        for pattern, each in self._measured.items():
            self._rest[check.columns(*pattern)] -= check.projected(check.as_solved(each.frame), *pattern)
        self._least = self._left({}, weights)

    def others_left(self, energy: float) -> float:
        """Of the ``energy`` of patterns that are not suspected, what the model leaves."""
        return energy + self._least

    # ---- what frames leave

    def _together(self, frames: dict[Pattern, FloatArray]) -> FloatArray:
        """W of the patterns that are not suspected, and of these ``frames`` of others; of the rest as foretold."""
        weights = self._rest.copy()
        for pattern, foretold in self._foretold.items():
            weights[self._check.columns(*pattern)] += self._check.projected(frames.get(pattern, foretold), *pattern)
        return np.where(self._check.sigma > 0, weights, 0.0)

    def _left(self, frames: dict[Pattern, FloatArray], weights: FloatArray) -> float:
        """Energy that ``frames`` of suspected patterns leave of all, but for a constant, their W being ``weights``."""
        light = sum(sum_of_squares(frames.get(pattern, foretold)) for pattern, foretold in self._foretold.items())
        return light - sum_of_squares(weights)

    def _beyond(self, frames: dict[Pattern, FloatArray], variance: float) -> float:
        """Energy beyond noise that all frames are off by with these, at a ``variance`` of a datum."""
        left = self._left(frames, self._together(frames)) - self._least
        return left - sum(frame.size for frame in frames.values()) * variance * self._check.prepared.spare

    def _filled(self, one: Seen, raw: FloatArray, known: BoolArray) -> float:
        """Energy beyond noise that ``raw`` light in the place of ``one`` leaves where it is ``known``; elsewhere it may
        be anything."""
        known = np.broadcast_to(known, raw.shape)
        fit, means = self._foretold[one.pattern], np.zeros(())
        if self._check.prepared.centre:
            means = np.where(known, raw, np.median(raw[known]))
            means = means - self._level(means)
        for _ in range(_STEPS):
            filled = np.where(known, raw, fit + means)
            frame = self._level(filled)
            means = filled - frame
            weights = self._together({one.pattern: frame})
            fit = self._check.modelled(weights, *one.pattern)
        left = self._left({one.pattern: frame}, weights) - self._least
        # The noise of a frame is that of its mean light, which what is lost makes too little.
        variance = max(one.variance, float(self._check.noise.of(float(raw[known].mean()), 1)))
        return left - float(known.sum()) * variance * self._check.prepared.spare

    # ---- what was read

    def _plain(self, pattern: Pattern) -> Seen:
        check, measurement = self._check, self._measured[pattern]
        number, frame = check.number[(*pattern, 0)], check.as_solved(measurement.frame)
        variance = float(check.noise.variance[pattern])
        foretold = (
            None
            if check.exclusive or len(self._bad) == check.noise.variance.size
            else check.modelled(self._weights, *pattern)
        )
        if foretold is None:
            off = self._outside(frame, pattern, variance)
            return Seen((number,), pattern, measurement.frame, frame, None, variance, off)
        off = self._beyond({pattern: frame}, variance)
        return Seen((number,), pattern, measurement.frame, frame, foretold, variance, off)

    def _signed(self) -> list[Seen]:
        """Of patterns whose sum is off the half that is wrong; of others the difference."""
        check = self._check
        good = max(check.noise.variance.size - len(self._bad), 1)
        total = self._total - sum(each.light for each in self._measured.values())
        mean = total / good
        found, off = [], dict[Pattern, float]()
        for pattern, each in self._measured.items():
            variance = float(check.noise.variance[pattern]) * (1 + 1 / good)
            beyond = sum_of_squares(each.light - mean) - each.light.size * variance
            if beyond > CHANCE * variance * np.sqrt(2 * each.light.size) and beyond > OFF**2 * each.power:
                off[pattern] = beyond
                continue
            numbers = tuple(check.number[(*pattern, sign)] for sign in (1, -1))
            foretold, frame = check.modelled(self._weights, *pattern), check.as_solved(each.frame)
            beyond = self._beyond({pattern: frame}, variance)
            found.append(Seen(numbers, pattern, each.frame, frame, foretold, variance, beyond))
        for pattern, sign in self._wrong_halves(off, mean).items():
            each, variance = self._measured[pattern], float(check.noise.variance[pattern]) * (1 + 1 / good)
            half, other = (each.light + sign * each.frame) / 2, (each.light - sign * each.frame) / 2
            number = check.number[(*pattern, sign)]
            if self._is_lit(pattern, sign):
                found.append(Seen((number,), pattern, half, half, mean - other, variance, off[pattern]))
        return found

    def _wrong_halves(self, off: dict[Pattern, float], mean: FloatArray) -> dict[Pattern, int]:
        """Sign of the half that is wrong of each pattern that is ``off``, by that energy, the ``mean`` of halves' sums.

        The other half foretells it either way, and no pattern of +-1 tells another's coefficients. First come those
        that explain each other, as frames that are exchanged; then those that make the image vary least from pixel to
        pixel, as coefficients that are wrong are a comb over all of it.
        """
        check, patterns = self._check, list(off)[:_MOST_PAIRS]

        def exchanged(one: tuple[Pattern, int], other: tuple[Pattern, int]) -> bool:
            noise = (
                mean.size * float(check.noise.variance[one[0]] + check.noise.variance[other[0]]) / 2
            )  # of a half each
            apart = (halves[one] + halves[other[0], -other[1]] - mean, halves[other] + halves[one[0], -one[1]] - mean)
            most = max(EXPLAINS * min(off[one[0]], off[other[0]]), LEFT * noise * float(np.sqrt(2 / mean.size)))
            return max(sum_of_squares(each) for each in apart) - noise < most

        halves = {
            (pattern, sign): (each.light + sign * each.frame) / 2
            for pattern, each in self._measured.items()
            for sign in (1, -1)
        }
        ranked = []
        for signs in product((1, -1), repeat=len(patterns)):
            wrong = list(zip(patterns, signs, strict=True))
            frames = {pattern: check.as_solved(sign * (mean - 2 * halves[pattern, -sign])) for pattern, sign in wrong}
            image = check.image(self._together(frames))
            variation = float(sum(np.abs(np.diff(image, axis=axis)).sum() for axis in (0, 1)))
            ranked.append((-sum(exchanged(*pair) for pair in combinations(wrong, 2)), variation, wrong))
        return dict(min(ranked)[2])

    def _is_lit(self, pattern: Pattern, sign: int) -> bool:
        """Whether the half of that ``sign`` of a signed pattern lights any pixel."""
        left, right = (side[:, index] for side, index in zip(self._check.patterns, pattern, strict=True))
        return bool((1 + sign * np.outer(left, right)).any())

    # ---- fits

    def _slabs(self, pattern: Pattern) -> tuple[Any, Any]:
        prepared = self._check.prepared
        return prepared.left.slabs[pattern[0]], prepared.right.slabs[pattern[1]]

    def _outside(self, frame: FloatArray, pattern: Pattern, variance: float) -> float:
        """Energy of a ``frame`` beyond noise that no light of the pixels of a ``pattern`` explains."""
        return (
            sum_of_squares(frame)
            - sum_of_squares(self._check.projected(frame, *pattern))
            - self._check.prepared.spare * frame.size * variance
        )

    def _ranges(self, pattern: Pattern, rows: Any, columns: Any) -> tuple[FloatArray, FloatArray]:
        """Orthonormal ranges of a ``pattern`` on part of the sensor's ``rows`` and ``columns``."""
        bases = []
        for slab, kept in zip(self._slabs(pattern), (rows, columns), strict=True):
            part = slab.matrix[kept]
            if self._check.prepared.centre:
                part = np.concatenate([part, np.ones((len(part), 1))], axis=1)
            bases.append(np.linalg.qr(part)[0])
        return bases[0], bases[1]

    def _outside_of_part(self, one: Seen, kept: BoolArray, axis: int) -> float:
        """Energy beyond noise that is off in the ``kept`` rows (``axis`` 0) or columns of the sensor."""
        window = (kept, slice(None)) if axis == 0 else (slice(None), kept)
        part = one.raw[window]
        # The noise of a frame is that of its mean light, which what is lost makes too little.
        variance = max(one.variance, float(self._check.noise.of(float(part.mean()), 1)))
        if one.foretold is not None:
            return sum_of_squares(self._level(part - one.foretold[window])) - part.size * variance
        left, right = self._ranges(one.pattern, *window)
        return (
            sum_of_squares(part)
            - sum_of_squares(left.T @ part @ right)
            - self._check.prepared.spare * part.size * variance
        )

    def _level(self, part: FloatArray) -> FloatArray:
        return centred(part) if self._check.prepared.centre else part

    def _inside(self, one: Seen, window: list[slice], still: list[slice]) -> float:
        """Energy beyond noise of a ``window`` of the sensor, held against the ``still`` middle of it."""
        part = one.raw[window[0], window[1]]
        if one.foretold is not None:
            return sum_of_squares(self._level(part - one.foretold[still[0], still[1]])) - part.size * one.variance
        left, right = self._ranges(one.pattern, *still)
        return (
            sum_of_squares(part)
            - sum_of_squares(left.T @ part @ right)
            - self._check.prepared.spare * part.size * one.variance
        )
