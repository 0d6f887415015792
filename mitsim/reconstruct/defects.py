"""Residuals of all measurements by sensor pixel in, pixels that are dead or hot out, and a capture without them.

A pixel that reads nothing of the light, or more than it, is off in every frame, and its neighbours are not. A separable
solver cannot weigh single pixels, so their readings are replaced by what the model tells of them from all others:
setting y - r / (1 - h) at a datum of leverage h leaves an image as if it had not been measured. Pixels that share
frames are set in rounds, each of which leaves the part h of the step before.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter, uniform_filter

from mitsim.core.arrays import FloatArray
from mitsim.core.runs import Measurement
from mitsim.reconstruct.accumulation import Accumulation
from mitsim.reconstruct.factorisation import IndexArray
from mitsim.reconstruct.focus import DerivedCapture

_SPREADS = 7.0
"""Standard deviations of noise, 1e-12 for a pixel, beyond which its residual's energy is no chance."""
_AROUND, _CROWD = 3, 0.35
"""Pixels to each side whose median energy is what a pixel's is compared with, and part of these 7 x 7 that are off at
most: two dead lines side by side, or two that cross, are less than a third of them."""
_MOST, _LEAKS = 0.02, 0.1
"""Part of the sensor that may be defective, because the scene does not fit where more is off; and part of the largest
energy of a pixel that others may have by it: the square of what the fit takes from one reading for the next, 0.03 where
the scene has 0.4 of the sensor's pixels a side."""
_LEAST_VARIANCE, _MOST_VARIANCE = 1e-3, 4.0
"""Part of the mean variance that a pixel's counts as at least, as one that reads nothing has none of light; and times
the mean at most, as that of a hot one is not light's: frames are four times as bright at their brightest."""
_ROUNDS, _SHOWN = 8, 5
"""Rounds in which defective readings are replaced: leverages are below 1/4 where the sensor has twice the scene's
pixels a side, and 4^-8 of a reading is below noise. And places that a sentence names."""


@dataclass(frozen=True, eq=False)
class Defects:
    """Defective pixels of a sensor, in ``rows`` and ``columns``, 1 or more."""

    rows: IndexArray
    columns: IndexArray

    def __str__(self) -> str:
        count, more = len(self.rows), ", ..." if len(self.rows) > _SHOWN else ""
        places = ", ".join(map(str, self.places[:_SHOWN]))
        return f"{count} defective pixel{'s' * (count > 1)} left out, at (row, column) {places}{more}"

    @property
    def places(self) -> list[tuple[int, int]]:
        """Row and column of each."""
        return list(zip(self.rows.tolist(), self.columns.tolist(), strict=True))

    def summary(self) -> dict[str, object]:
        """Return the entry of result.json."""
        return {"count": len(self.rows), "first": self.places[:_SHOWN]}

    def with_others(self, others: Defects | None) -> Defects:
        """Return these defects and ``others``."""
        return Defects(*np.array(sorted({*self.places, *(others.places if others else ())}), dtype=np.intp).T)


class LeftOut(DerivedCapture):
    """The capture of ``data`` with other readings at ``defects``: those that all other readings predict."""

    def __init__(self, data: Accumulation, defects: Defects) -> None:
        super().__init__(data.shots)
        self._data, self._places = data, (defects.rows, defects.columns)
        prepared, weights, whole = data.prepared, data.weights, lit_everywhere(data)
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
        """Yield the measurements of the capture, whose ``shape`` is known, with other readings at these places."""
        for each in self._data.measurements_again():
            frame, light = each.frame.copy(), each.light.copy()
            frame[self._places] += self._moved[each.row, each.column]
            light[self._places] = np.maximum(np.abs(frame[self._places]), self._total)
            yield replace(each, frame=frame, light=light)


def lit_everywhere(data: Accumulation) -> tuple[int, int] | None:
    """Return a pattern of ``data`` that lights all scene pixels; None where there is none."""
    lit = [np.flatnonzero((side > 0).all(axis=0)) for side in data.shots.patterns]
    return (int(lit[0][0]), int(lit[1][0])) if all(map(len, lit)) else None


def find_defects(data: Accumulation, squares: FloatArray, ratio: float) -> Defects | None:
    """Return pixels that are off in all measurements of ``data``; None where there are none.

    Parameters
    ----------
    data
        the run.
    squares
        (m, m') sum of the squares of the residuals of each pixel.
    ratio
        measured over stated variance of the noise.
    """
    noise, prepared, count = data.noise, data.prepared, data.noise.variance.size
    mean = noise.light / count
    variance = ratio * noise.of(mean, noise.shots)
    found = defects_of(squares, count * variance, count)
    if noise.shots == 1 or (whole := lit_everywhere(data)) is None:
        return found
    # Differences of halves show little of pixels that stand still, and their sums show all of it.
    still = defects_of(np.square(prepared.as_solved(mean) - prepared.frame(data.weights, whole)), variance / count, 1)
    return still.with_others(found) if still else found


def defects_of(squares: FloatArray, variance: FloatArray, count: int) -> Defects | None:
    """Pixels whose residual is beyond noise, and beyond that of their neighbours; None where there are none.

    Parameters
    ----------
    squares, variance
        (rows, columns) energy that the model leaves of all measurements at each pixel, and that of their noise.
    count
        of the measurements.
    """
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
    """Quantile of a chi-square of ``count`` degrees of freedom over their number, after Wilson and Hilferty (1931)."""
    return float((1 - 2 / (9 * count) + _SPREADS * np.sqrt(2 / (9 * count))) ** 3)
