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
        inner, edges = np.arange(reach, rows - reach), np.array([*range(reach), *range(rows - reach, rows)], dtype=int)
        self._coefficients[inner] = self._fitted(factor, inner, np.arange(-reach, reach + 1))
        nearest = np.clip(edges - reach, 0, rows - 2 * reach - 1)[:, None] + np.arange(2 * reach + 1)
        self._coefficients[edges] = self._fitted_each(factor[nearest], nearest - edges[:, None])

    def at(self, row: npt.NDArray[np.intp], column: FloatArray) -> FloatArray:
        """Numbers of each ``row`` at each ``column``, from 0 to n - 1, whole or not; the two broadcast."""
        start, weights = self._weights(column * _KNOTS)
        first, numbers = row * self._coefficients.shape[1] + start, self._coefficients.ravel()
        return np.asarray(sum(weight * numbers.take(first + k) for k, weight in enumerate(weights)))

    def _fitted(self, factor: FloatArray, rows: npt.NDArray[np.intp], neighbours: npt.NDArray[np.intp]) -> FloatArray:
        """(len(``rows``), coefficients) of the spline of each row, from its ``neighbours``' numbers."""
        normal, start, weights = self._normal(neighbours[None])
        data = np.zeros((self._last + 3, len(rows)))
        for k, first, parts in zip(neighbours, start[0], np.moveaxis(weights[:, 0], 1, 0), strict=True):
            seen = factor[rows + k].T
            for a, part in enumerate(parts):
                # Columns are whole knots apart, so no place is named twice but by those without weight.
                inside = part != 0
                data[first[inside] + a] += part[inside, None] * seen[inside]
        return np.asarray(solveh_banded(normal[0], data, lower=True).T)

    def _fitted_each(self, seen: FloatArray, neighbours: npt.NDArray[np.intp]) -> FloatArray:
        """(rows, coefficients) of the spline of each row, from what is ``seen`` (rows, k, n) in the ``neighbours``
        (rows, k) of its own."""
        normal, start, weights = self._normal(neighbours)
        data = np.sum([self._collected(start + a, weight * seen) for a, weight in enumerate(weights)], axis=0)
        found = [solveh_banded(*each, lower=True) for each in zip(normal, data, strict=True)]
        return np.array(found).reshape(len(seen), self._last + 3)

    def _normal(self, neighbours: npt.NDArray[np.intp]) -> tuple[FloatArray, npt.NDArray[np.intp], FloatArray]:
        """Of fits to rows that are ``neighbours`` (fits, k): normal matrices (fits, 4, coefficients) by diagonal, first
        coefficient (fits, k, n) and weights (4, fits, k, n) of each number, 0 beyond the last knot."""
        place = (np.arange(self._last // _KNOTS + 1) + neighbours[..., None] * self._step) * _KNOTS
        start, parts = self._weights(place)
        weights = np.where((place >= 0) & (place <= self._last), parts, 0.0)
        normal = np.zeros((len(neighbours), 4, self._last + 3))
        for a, b in product(range(4), repeat=2):
            if b >= a:
                normal[:, b - a] += self._collected(start + a, weights[a] * weights[b])
                normal[:, b - a, a : self._last + a] += _STIFFNESS * _THIRD[a] * _THIRD[b]
        return normal, start, weights

    def _collected(self, place: npt.NDArray[np.intp], values: FloatArray) -> FloatArray:
        """(fits, coefficients) sums of the ``values`` (fits, k, n) at each ``place`` (fits, k, n)."""
        fits, size = len(place), self._last + 3
        own = (np.arange(fits) * size)[:, None, None] + place
        return np.asarray(np.bincount(own.ravel(), values.ravel(), fits * size).reshape(fits, size), dtype=np.float64)

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
