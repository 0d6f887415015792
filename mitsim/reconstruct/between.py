"""A factor, columns by sensor rows, in; the same as a smooth function of the place between columns out.

Sensor row u + k sees in column i what row u sees at i + k s, s being the columns that one sensor pixel's step makes up
for: the mask's shadow hangs on one coordinate. So each row has the numbers of its neighbours too, at places between its
own, and a cubic spline with knots finer than columns is fitted to all of them: where a projector pixel is wide, a
polynomial through columns alone misses the edges of the mask's features.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import numpy.typing as npt
from scipy.linalg import solveh_banded

from mitsim.core.arrays import FloatArray

_ROWS = 5
"""Sensor rows to either side whose numbers a row is given: of 2, 3 and 5 the most leave least, 1.9e-3, 1.7e-3, 1.5e-3
of columns of 15 um with noise of 2e-3 (a polynomial through their own row: 2.8e-2); more are another shadow behind
masks with thickness."""
_KNOTS = 4
"""Knots a column: with 2, columns of 15 um are off by 2.5e-3 with noise of 2e-3 instead of 1.5e-3."""
_STIFFNESS = 1e-2
"""Weight of the squared third differences of neighbouring coefficients over that of a number's error: with 1e-3 noise
of 2e-3 leaves 1.7e-3 instead of 1.5e-3, without noise 1.0e-3 instead of 1.2e-3."""
_THIRD = np.array([-1.0, 3.0, -3.0, 1.0])
"""Third difference of four neighbours."""


class Between:
    """A ``factor`` (m, n) at any place between its columns.

    Parameters
    ----------
    factor
        free of what changes from column to column but the shadow.
    step
        columns by which the next sensor row sees the shadow moved.
    """

    def __init__(self, factor: FloatArray, step: float) -> None:
        rows, count = factor.shape
        self._last, self._step = (count - 1) * _KNOTS, step
        reach = min(_ROWS, (rows - 1) // 2)
        self._coefficients = np.empty((rows, self._last + 3))
        inner = np.arange(reach, rows - reach)
        self._coefficients[inner] = self._fitted(factor, inner, range(-reach, reach + 1))
        for row in (*range(reach), *range(rows - reach, rows)):
            first = min(max(row - reach, 0), rows - 2 * reach - 1) - row
            self._coefficients[row] = self._fitted(factor, np.array([row]), range(first, first + 2 * reach + 1))[0]

    def at(self, row: npt.NDArray[np.intp], column: FloatArray) -> FloatArray:
        """Numbers of each ``row`` at each ``column``, from 0 to n - 1, whole or not; the two broadcast."""
        start, weights = self._weights(column * _KNOTS)
        return np.asarray(sum(weight * self._coefficients[row, start + k] for k, weight in enumerate(weights)))

    def _fitted(self, factor: FloatArray, rows: npt.NDArray[np.intp], neighbours: range) -> FloatArray:
        """(len(``rows``), coefficients) of the spline of each row, from its ``neighbours``' numbers."""
        normal, data = np.zeros((4, self._last + 3)), np.zeros((self._last + 3, len(rows)))
        for k in neighbours:
            place = (np.arange(factor.shape[1]) + k * self._step) * _KNOTS
            inside = (place >= 0) & (place <= self._last)
            start, weights = self._weights(place[inside])
            seen = factor[rows + k][:, inside].T
            for a, weight in enumerate(weights):
                np.add.at(data, start + a, weight[:, None] * seen)
                for b in range(a, 4):
                    np.add.at(normal[b - a], start + a, weight * weights[b])
        for a, b in product(range(4), repeat=2):
            if b >= a:
                normal[b - a, a : self._last + a] += _STIFFNESS * _THIRD[a] * _THIRD[b]
        return np.asarray(solveh_banded(normal, data, lower=True).T)

    def _weights(self, place: FloatArray) -> tuple[npt.NDArray[np.intp], tuple[FloatArray, ...]]:
        """First of the four coefficients at each ``place`` [knots], and the weights of all four: uniform cubic
        B-splines."""
        start = np.clip(np.floor(place).astype(np.intp), 0, self._last - 1)
        t = place - start
        square = t * t
        last = square * t / 6  # powers of arrays take ten times as long
        first = (1 + 3 * (square - t)) / 6 - last
        third = (1 + 3 * (t + square)) / 6 - 3 * last
        return start, (first, 1 - first - third - last, third, last)
