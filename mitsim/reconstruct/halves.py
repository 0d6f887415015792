"""W by quarters of the sensor in; how much noise its numbers hold out, wherever it comes from.

Where Y = U S X' + noise, with X' the image in the diagonal basis, the half W_0 = U_0^T Y of the sum over the sensor's
rows is G W up to noise, G = U_0^T U_0: in W_0 - G W there is no image, and nothing else that both halves agree on.
White noise gives its number i the variance G (I - G)_ii times its own, since G and I - G commute. An error E of the
left factor that is independent from sensor row to row, as a calibration's noise is, shows too: U^T E X S' strikes all
numbers of a column of W alike, by that column's light. Halves of the columns tell the same of the right factor.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.reconstruct.sides import Side

_LEAST_SPREAD = 0.01
"""Least G (I - G)_ii that a half is told from the whole by: 1/4 where both halves see as much, 0 where a side has no
more rows than unknowns."""
_MEDIAN = 0.4549
"""Median of the square of a standard normal number."""
MEDIAN_SPREAD = 2.33
"""Relative standard deviation of the median of n such squares, times the square root of n."""
_SIGNIFICANT = 2.0
"""Standard deviations above which a row or column is noisier than others: of chance excess, one in forty is left."""


@dataclass(frozen=True, eq=False)
class Halves:
    """Quarters (2, 2, r, r') of W in the diagonal basis, and the sides whose halves they are sums over."""

    quarters: FloatArray
    left: Side
    right: Side

    @cached_property
    def differences(self) -> tuple[FloatArray, FloatArray]:
        """(r, r') W_0 - G W of the halves of rows, and of the halves of columns."""
        total = self.quarters.sum(axis=(0, 1))
        by_row = self.quarters[0].sum(axis=0) - self.left.first_half @ total
        by_column = self.quarters[:, 0].sum(axis=0) - total @ self.right.first_half
        return by_row, by_column

    @cached_property
    def _squares(self) -> tuple[FloatArray, FloatArray]:
        """The squares of :attr:`differences` in units of a number's variance; NaN where halves cannot be told apart."""
        rows, columns = (_told(half_spread(side.first_half)) for side in (self.left, self.right))
        by_row, by_column = self.differences
        return np.square(by_row) / rows[:, None], np.square(by_column) / columns

    @cached_property
    def typical(self) -> float:
        """Noise variance of most numbers, by the median; NaN when unknown."""
        return float(_medians(np.concatenate([square[self._measured] for square in self._squares])[None])[0])

    @cached_property
    def excess(self) -> FloatArray:
        """(r, r') noise variance of each number above that of most: what is significant in its row and its column."""
        row, column = (np.where(self._measured, square, np.nan) for square in self._squares)
        return _excess(row.T) + _excess(column)[:, None]

    @property
    def _measured(self) -> npt.NDArray[np.bool_]:
        return np.asarray(np.outer(self.left.singular, self.right.singular) > 0)


def half_spread(half: FloatArray) -> FloatArray:
    """(r,) variance of W_0 - G W for white noise of variance 1, G being ``half``: the diagonal of G (I - G)."""
    return np.asarray(np.diag(half) - np.einsum("ij,ji->i", half, half))


def _told(spread: FloatArray) -> FloatArray:
    """``spread`` where it is not too small; otherwise NaN."""
    return np.where(spread >= _LEAST_SPREAD, spread, np.nan)


def _medians(squares: FloatArray) -> FloatArray:
    """Variance of each row of normal numbers by the median of their ``squares``, which a few that are no noise do not
    move; NaN where none is known."""
    ordered, count = np.sort(squares, axis=1), np.count_nonzero(~np.isnan(squares), axis=1)  # NaN come last
    middle = [
        np.take_along_axis(ordered, place[:, None], axis=1) for place in (np.maximum(count - 1, 0) // 2, count // 2)
    ]
    return np.asarray((middle[0] + middle[1])[:, 0] / (2 * _MEDIAN))


def _excess(squares: FloatArray) -> FloatArray:
    """(rows,) variance of each row of ``squares`` above that of the middle row, beyond what chance explains."""
    level = _medians(squares)
    count = np.maximum((~np.isnan(squares)).sum(axis=1), 1)
    middle = np.nanmedian(level) if not np.isnan(level).all() else np.nan
    significant = level > middle * (1 + _SIGNIFICANT * MEDIAN_SPREAD / np.sqrt(count))
    return np.where(significant, level - middle, 0.0)
