"""Types of arrays that several rooms exchange."""

from dataclasses import fields

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
"""Real numbers in double precision."""
SeparableTerm = tuple[FloatArray, FloatArray]
"""Left (m, n) and right (m', n') of one of the products that an operator from scene pixels to a sensor is a sum of."""
Labels = npt.NDArray[np.int64]
"""Index of the class or row that each item belongs to."""


def sum_of_squares(values: FloatArray) -> float:
    """Sum of the squares of ``values`` (any shape), without an array of them, and in one order, unlike BLAS."""
    flat = np.ravel(values, order="K")  # as they lie in memory: transposed ones are not copied
    return float(np.einsum("i,i->", flat, flat))


def mean_of_neighbours(values: FloatArray) -> FloatArray:
    """(rows, columns) mean over the 3 x 3 neighbours of each of the ``values``; beyond an edge, what stands there.

    scipy.ndimage has the same, and takes 50 ms to import.
    """
    for _ in ("rows", "columns"):
        wide = np.pad(values, ((1, 1), (0, 0)), mode="edge")
        values = ((wide[:-2] + wide[1:-1] + wide[2:]) / 3).T
    return values


class ByValue:
    """A dataclass (with ``eq=False``) that compares and hashes by its values, arrays by their bytes."""

    def _values(self) -> tuple[object, ...]:
        values = (getattr(self, field.name) for field in fields(self))  # type: ignore[arg-type]
        return tuple(value.tobytes() if isinstance(value, np.ndarray) else value for value in values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ByValue) and type(other) is type(self) and other._values() == self._values()

    def __hash__(self) -> int:
        return hash(self._values())

    def _hold(self, **arrays: npt.NDArray[np.generic]) -> None:
        """Set fields of a frozen dataclass to arrays that nobody can write to."""
        for name, array in arrays.items():
            array.flags.writeable = False
            object.__setattr__(self, name, array)
