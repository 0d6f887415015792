"""Frames are added one at a time to W = sum_ij U_Li^T Y_ij U_Rj; memory does not grow with their number."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.reconstruct.sides import Halves, Side, Strips

_LARGEST = 1e100
"""Largest norm of a frame, and one over the smallest: its square, the energy, is then told from 0 and infinity."""


class Accumulator:
    """Sum over frames of what the solver needs: W by quarters of the sensor, the frames' energy, and which frames came.

    Made by :meth:`mitsim.reconstruct.solver.Prepared.accumulator`; belongs to the factors that made it.

    Parameters
    ----------
    left, right
        the factorised model.
    centre
        whether row and column means are taken out of each frame.
    """

    def __init__(self, left: Side, right: Side, centre: bool) -> None:
        self._left = left
        self._right = right
        self._centre = centre
        self._quarters = np.zeros((2, 2, left.accumulated_size, right.accumulated_size))
        self._energy = 0.0
        self._seen = np.zeros((left.pattern_count, right.pattern_count), dtype=np.bool_)

    @property
    def sum(self) -> FloatArray:
        """W (r_left, r_right), or for the Gram method the paper's Q (n, n); a copy."""
        return np.asarray(self._quarters.sum(axis=(0, 1)))

    @property
    def quarters(self) -> FloatArray:
        """(2, 2, r_left, r_right) parts of :attr:`sum` by half of the sensor's rows and of its columns; a copy."""
        return self._quarters.copy()

    @property
    def energy(self) -> float:
        """Sum of the squares of all added frames, after centring when that was asked for."""
        return self._energy

    @property
    def missing(self) -> list[tuple[int, int]]:
        """Pattern indices (i, j) whose frame has not been added."""
        return [(int(i), int(j)) for i, j in np.argwhere(~self._seen)]

    def belongs_to(self, left: Side, right: Side) -> bool:
        """Whether ``left`` and ``right`` are the factors the frames were projected on."""
        return self._left is left and self._right is right

    def add(self, frame: npt.ArrayLike, row: int, column: int) -> None:
        """Add one frame; sums are float64.

        Parameters
        ----------
        frame
            (m, m') of any real dtype; for a signed pattern the difference of its two shots.
        row, column
            of its pattern P_L[:, row] P_R[:, column]^T.

        Raises
        ------
        MitsimError
            for another shape, a value that is not finite, numbers whose squares leave double precision, a pattern
            index out of range, or a pattern added twice (average repeated shots first).
        """
        self._check_index(row, column)
        values = self._checked(frame, row, column)
        if self._centre:
            values = centred(values)
        flat = values.ravel()
        energy = float(np.dot(flat, flat))
        if not 1 / _LARGEST**2 <= energy <= _LARGEST**2 and (energy or values.any()):
            raise MitsimError(_out_of_range(f"frame of pattern ({row}, {column})", values))
        left, right = self._left.slabs[row], self._right.slabs[column]
        where: Any = (left.columns, right.columns)
        if isinstance(left.columns, np.ndarray) and isinstance(right.columns, np.ndarray):
            where = np.ix_(left.columns, right.columns)
        halves = self._left.halves, self._right.halves
        self._quarters[(slice(None), slice(None), *where)] += _project(values, left.matrix, right.matrix, halves)
        self._energy += energy
        self._seen[row, column] = True

    def _check_index(self, row: int, column: int) -> None:
        rows, columns = self._seen.shape
        whole = all(isinstance(k, (int, np.integer)) and not isinstance(k, bool) for k in (row, column))
        if not (whole and 0 <= row < rows and 0 <= column < columns):
            raise MitsimError(f"pattern index is ({row}, {column}); allowed are 0 to {rows - 1} and 0 to {columns - 1}")
        if self._seen[row, column]:
            raise MitsimError(f"frame of pattern ({row}, {column}) was added before; average repeated captures first")

    def _checked(self, frame: npt.ArrayLike, row: int, column: int) -> FloatArray:
        values = np.asarray(frame)
        expected = (self._left.sensor_size, self._right.sensor_size)
        if values.shape != expected or values.dtype.kind not in "buif":
            raise MitsimError(
                f"frame of pattern ({row}, {column}) is {values.dtype} of shape {values.shape}; "
                f"the factors take real numbers of shape {expected}"
            )
        return values.astype(np.float64, copy=False)


def projected(left: Side, right: Side, frames: FloatArray) -> FloatArray:
    """:attr:`Accumulator.sum` of all frames at once, without the halves, the energy and the checks: half the time.

    Parameters
    ----------
    left, right
        the factorised model.
    frames
        (K, m, K', m'), of pattern (i, j) ``frames[i, :, j]``, centred where the model is.
    """
    total = np.zeros((left.accumulated_size, right.accumulated_size))
    for slab, own in zip(left.slabs, frames, strict=True):
        seen = (slab.matrix.T @ own.reshape(len(own), -1)).reshape(-1, *own.shape[1:])
        rows = np.arange(len(total))[slab.columns]
        for j, other in enumerate(right.slabs):
            total[rows[:, None], np.arange(total.shape[1])[other.columns]] += seen[:, j] @ other.matrix
    return total


def centred_columns(matrix: FloatArray) -> FloatArray:
    """C ``matrix``: the mean of each column taken out."""
    return np.asarray(matrix - matrix.mean(axis=0, keepdims=True))


def centred(frame: FloatArray) -> FloatArray:
    """C Y C of a ``frame`` Y, C = I - 1 1^T / m: row and column means out, as FlatCam's constant term demands."""
    return centred_columns(frame - frame.mean(axis=1, keepdims=True))


def _out_of_range(name: str, values: FloatArray) -> str:
    """Why a frame whose energy is not a usable number is refused."""
    bad = int(np.count_nonzero(~np.isfinite(values)))
    if bad:
        return f"{name} has {bad} values that are not finite; capture it again"
    return (
        f"{name} has numbers up to {np.abs(values).max():.1e}; "
        f"allowed are 0 and {1 / _LARGEST:g} to {_LARGEST:g}, choose another unit"
    )


def _project(frame: FloatArray, left: FloatArray, right: FloatArray, halves: tuple[Halves, Halves]) -> FloatArray:
    """(2, 2, c, c') left^T frame right by ``halves`` of the rows and of the columns, the thinner factor first: the
    frame is then read with the least arithmetic, and never copied."""
    rows, columns = halves
    if left.shape[1] < right.shape[1]:
        seen = [_product(left, frame, strips) for strips in rows]
        return np.array([[_product(part.T, right, strips) for strips in columns] for part in seen])
    seen = [_product(frame.T, right, strips) for strips in columns]
    return np.array([[_product(left, part, strips) for part in seen] for strips in rows])


def _product(first: FloatArray, second: FloatArray, strips: Strips) -> FloatArray:
    """first^T second over the rows in ``strips``."""
    total = np.zeros((first.shape[1], second.shape[1]))
    for strip in strips:
        total += first[strip].T @ second[strip]
    return total
