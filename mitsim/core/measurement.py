"""Shots of one pattern in, what was measured under it out; and what is taken off it where lamps burn."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mitsim.core.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Ambient:
    """What a camera sees with the projector off, as it is taken off every frame of a run.

    Attributes
    ----------
    rate
        (rows, columns) mean over the shots [electrons/s].
    variance
        (rows, columns) of that mean [(electrons/s)^2], of what the manifest states of the sensor's noise. It is one
        draw, the same in all frames.
    shots
        that were averaged.
    """

    rate: FloatArray
    variance: FloatArray
    shots: int


@dataclass(frozen=True, eq=False)
class Measurement:
    """What was measured under one pattern.

    Attributes
    ----------
    frame
        (rows, columns) [electrons/s], of a signed pattern the difference of its halves; of others without ambient
        light.
    row, column
        indices (i, j) of the pattern.
    light
        (rows, columns) [electrons/s] sum of its shots as they were read: what their shot noise is of.
    shots
        their number.
    saturated
        readings of them at the full well or the ADC's end.
    factor
        largest whole number that divides all of their digital numbers; 1 where they are not whole.
    digests
        of each shot, which no two that were read apart share; 0 where all of its numbers are equal.
    clipped
        of each shot, readings at its largest number, below the end of their range, where noise leaves fewer; 0 where
        it leaves as many.
    """

    frame: FloatArray
    row: int
    column: int
    light: FloatArray
    shots: int
    saturated: int
    factor: int = 1
    digests: tuple[int, ...] = ()
    clipped: tuple[int, ...] = ()

    def __add__(self, other: Measurement) -> Measurement:
        """Both halves of a signed pattern as one measurement."""
        shots, saturated = self.shots + other.shots, self.saturated + other.saturated
        light, factor = self.light + other.light, math.gcd(self.factor, other.factor)
        frame, digests = self.frame + other.frame, self.digests + other.digests
        clipped = self.clipped + other.clipped
        return Measurement(frame, self.row, self.column, light, shots, saturated, factor, digests, clipped)

    @property
    def power(self) -> float:
        """Sum of the squares of its shots [(electrons/s)^2]."""
        # For halves p and q, p^2 + q^2 = ((p - q)^2 + (p + q)^2) / 2.
        halves = (self.light,) if self.shots == 1 else (self.frame, self.light)
        return float(sum(np.vdot(values, values) for values in halves)) / len(halves)
