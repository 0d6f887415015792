"""A mask given feature by feature: its transmission in, the separable terms that make it up out, and what they leave.

What is separable, as the product of two maximum length sequences is, has one term, FlatCam's and a MURA two, and these
are exact: crosses of the matrix (Bebendorf, Numerische Mathematik 86, 565, 2000), 0 and 1 where the mask's are. Any
other mask is the sum of its singular vectors. Coordinates are those of :mod:`mitsim.rig.mask`.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import ByValue, FloatArray
from mitsim.core.errors import MitsimError
from mitsim.rig.mask import BoolArray, Term

LEFT_OUT = 1e-7
"""Part of a transmission, rms, that singular vectors may leave: a tenth of the finest accuracy that a plan takes."""
FEW = 2
"""Terms that are looked for as exact crosses: FlatCam's, of whose fields diffraction makes four terms."""
LARGEST = 4096
"""Features a side: a transmission takes 128 MiB."""
_ROUNDING = 1e-12
"""Rest of a matrix of numbers up to 1 that is rounding after two crosses."""
_GRIDS = 4
"""Grids of openings that the reference draws from; with more it draws over the whole mask."""


@dataclass(frozen=True, eq=False)
class Plate(ByValue):
    """A square plate of square features, each of a transmission of its own; MitsimError for values out of range.

    Attributes
    ----------
    feature_mm
        side of one feature [mm].
    values
        (N, N) transmission of light's power, 0 to 1, read-only.
    words
        what it is, for messages and manifests.
    """

    feature_mm: float
    values: FloatArray = field(repr=False)
    words: str

    def __post_init__(self) -> None:
        values = np.array(self.values, dtype=np.float64)
        if values.ndim != 2 or values.shape[0] != values.shape[1] or not 1 <= len(values) <= LARGEST:
            raise MitsimError(
                f"{self.words}: has shape {values.shape}; give a square of 1 to {LARGEST} features a side"
            )
        if not (np.isfinite(self.feature_mm) and self.feature_mm > 0):
            raise MitsimError(f"{self.words}: feature size is {self.feature_mm} mm; give a finite number above 0")
        if not (values.min() >= 0 and values.max() <= 1):
            raise MitsimError(f"{self.words}: transmissions are {values.min():g} to {values.max():g}; give 0 to 1")
        if not values.any():
            raise MitsimError(f"{self.words}: no feature lets light through; open some")
        self._hold(values=values)

    def _values(self) -> tuple[object, ...]:
        return self.feature_mm, self.words, self.digest

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the transmissions, 64 hexadecimal digits."""
        return hashlib.sha256(np.ascontiguousarray(self.values).tobytes()).hexdigest()

    @property
    def identity(self) -> str:
        """What manifests say of it: equal for equal plates alone."""
        return f"{self.words}, features of {self.feature_mm:g} mm, sha256 {self.digest}"

    @property
    def extent_mm(self) -> float:
        """Side of the square [mm]; it spans -extent/2 .. +extent/2."""
        return len(self.values) * self.feature_mm

    @cached_property
    def crosses(self) -> tuple[Term, ...] | None:
        """The transmission as at most two exact terms (weight, row profile (N,), column profile (N,)), or None."""
        rest = self.values.copy()
        terms: list[Term] = []
        while True:
            row, column = np.unravel_index(np.argmax(np.abs(rest)), rest.shape)
            pivot = rest[row, column]
            if abs(pivot) <= _ROUNDING:
                return tuple(terms)
            if len(terms) == FEW:
                return None
            terms.append((1.0, rest[:, column].copy(), rest[row] / pivot))
            rest -= np.outer(terms[-1][1], terms[-1][2])

    @property
    def terms(self) -> tuple[Term, ...]:
        """The transmission as terms (weight, row profile (N,), column profile (N,)), but for :attr:`left_out`."""
        return self._terms_and_rest[0]

    @property
    def left_out(self) -> float:
        """What the terms leave of the transmission, root mean square, as a part of all; 0 where they are exact."""
        return self._terms_and_rest[1]

    @cached_property
    def _terms_and_rest(self) -> tuple[tuple[Term, ...], float]:
        if self.crosses is not None:
            return self.crosses, 0.0
        rows, columns, left, singular, right = _factors(self.values)
        beyond = np.sqrt(np.cumsum(np.square(singular[::-1]))[::-1])  # what the terms from each on hold
        count = int(np.count_nonzero(beyond > LEFT_OUT * beyond[0]))
        terms = tuple((float(singular[k]), left[rows, k], right[k, columns]) for k in range(count))
        return terms, float(beyond[count] / beyond[0]) if count < len(beyond) else 0.0

    @cached_property
    def residuals(self) -> tuple[float, float]:
        """What the best single term leaves of the transmission, rms, as a part of it: as it is, and of what is left
        when the means of rows and columns are taken off, as a part of that."""
        centred = self.values - self.values.mean(axis=0)
        centred -= centred.mean(axis=1, keepdims=True)
        return _beyond_one(self.values), _beyond_one(centred)

    @property
    def centred(self) -> bool:
        """Whether a separable solver does better without the means of rows and columns, as for a FlatCam mask."""
        plain, without = self.residuals
        return without < plain

    @property
    def residual(self) -> float:
        """What the best separable mask leaves of what a solver uses of this one, rms, as a part of it."""
        return min(self.residuals)

    @cached_property
    def amplitude(self) -> Plate:
        """The plate whose values are the factors of a field: roots of the transmissions, without phase."""
        return self if self.binary else Plate(self.feature_mm, np.sqrt(self.values), self.words)

    @cached_property
    def binary(self) -> bool:
        """Whether every feature is open or closed."""
        return bool(np.isin(self.values, (0, 1)).all())

    @cached_property
    def grids(self) -> tuple[tuple[BoolArray, BoolArray], ...] | None:
        """What is open as grids that do not overlap, as :attr:`mitsim.rig.mask.Mask.openings`; None where over 4."""
        if not self.binary:
            return None
        patterns, which = np.unique(self.values[self.values.any(axis=1)], axis=0, return_inverse=True)
        if len(patterns) > _GRIDS:
            return None
        row_of = np.full(len(self.values), -1)
        row_of[self.values.any(axis=1)] = which.ravel()
        return tuple((row_of == k, pattern.astype(bool)) for k, pattern in enumerate(patterns))

    @property
    def openings(self) -> tuple[tuple[BoolArray, BoolArray], ...]:
        """Grids that hold all that is open: exactly that with :attr:`grids`, else all rows and columns that let light
        through anywhere."""
        if self.grids is not None:
            return self.grids
        return ((np.asarray(self.values.any(axis=1)), np.asarray(self.values.any(axis=0))),)

    def transmission(self, s_row: npt.ArrayLike, s_col: npt.ArrayLike) -> FloatArray:
        """Transmission (0..1) at points (``s_row``, ``s_col``) of the mask plane [mm]; the arrays broadcast."""
        count = len(self.values)
        row, column = (np.floor(np.asarray(s) / self.feature_mm + count / 2) for s in (s_row, s_col))
        inside = (row >= 0) & (row < count) & (column >= 0) & (column < count)
        place = (np.where(inside, at, 0).astype(np.intp) for at in np.broadcast_arrays(row, column))
        return np.asarray(np.where(inside, self.values[tuple(place)], 0.0))


@lru_cache(maxsize=8)
def within(plate: Plate, reach_mm: float) -> Plate:
    """The ``plate`` without what lies beyond ``reach_mm`` of its centre, where that saves terms."""
    beyond = int((plate.extent_mm / 2 - reach_mm) / plate.feature_mm)
    if beyond <= 0 or plate.crosses is not None:
        return plate
    inside = slice(beyond, len(plate.values) - beyond)
    part = plate.values[inside, inside]
    return Plate(plate.feature_mm, part, plate.words) if part.any() else plate


def _factors(
    values: FloatArray,
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], FloatArray, FloatArray, FloatArray]:
    """Singular value decomposition of ``values`` by their distinct rows and columns, of which drawings have few.

    Returns
    -------
    (N,) which distinct row and which distinct column each is, their factors (rows, k) and (k, columns), and (k,)
    singular values between them.
    """
    rows, row, row_count = np.unique(values, axis=0, return_inverse=True, return_counts=True)
    columns, column, column_count = np.unique(rows, axis=1, return_inverse=True, return_counts=True)
    weights = np.sqrt(row_count)[:, None], np.sqrt(column_count)
    left, singular, right = np.linalg.svd(weights[0] * columns * weights[1], full_matrices=False)
    return row.ravel(), column.ravel(), left / weights[0], singular, right / weights[1]


def _beyond_one(values: FloatArray) -> float:
    """What the best separable product leaves of ``values``, root mean square, as a part of them."""
    singular = _factors(values)[3]
    total = np.square(singular).sum()
    rest = float(np.sqrt(np.square(singular[1:]).sum() / total)) if total else 0.0
    return rest if rest > _ROUNDING * len(values) else 0.0
