"""A coded mask: from a 0/1 code, a construction and a feature size to its transmission at any point of the mask plane.

Coordinates are the project's index coordinates, ``s_row = -y`` and ``s_col = -x`` in mm, centred on the
optical axis, so that an index grows with its coordinate. The mask is opaque outside its features.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import ClassVar, Literal, get_args

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import ByValue, FloatArray
from mitsim.core.errors import MitsimError

MaskKind = Literal["separable", "flatcam", "open"]
"""How a plate is made from a code; see :class:`Mask`."""
CameraMask = Literal["separable", "flatcam", "open", "plate"]
"""The mask of a camera: a :class:`Mask`, or a :class:`mitsim.devices.plate.Plate`."""
Term = tuple[float, FloatArray, FloatArray]
"""Weight, row profile (N,) and column profile (N,) of a separable part of a transmission."""
BoolArray = npt.NDArray[np.bool_]
# fmt: off
_TAPS = {
    2: (1,), 3: (2,), 4: (3,), 5: (3,), 6: (5,), 7: (6,), 8: (7, 6, 1), 9: (5,), 10: (7,), 11: (9,), 12: (11, 10, 4),
    13: (12, 11, 8), 14: (13, 12, 2), 15: (14,), 16: (15, 13, 4),
}
# fmt: on
"""Feedback taps by order: those of ``scipy.signal.max_len_seq``, so that masks are the papers'."""


@dataclass(frozen=True, eq=False)
class Mask(ByValue):
    """An opaque plate with a square grid of features, each open or closed; MitsimError for values out of range.

    Attributes
    ----------
    kind
        ``separable``: transmission a(row) a(column) with a the 0/1 bits (25 % open).
        ``flatcam``: (1 + m(row) m(column)) / 2 with m = 2 bits - 1 (50 % open).
        ``open``: every feature open, an aperture of the mask's size.
    feature_mm
        side of one feature [mm].
    bits
        (N,) 0/1 code, read-only; the same code serves rows and columns.
    """

    kind: MaskKind
    feature_mm: float
    bits: npt.NDArray[np.int8]
    blur_mm: ClassVar[float] = 0.0
    """Its edges are sharp."""
    even: ClassVar[bool] = True
    """Its features are squares of one size."""

    def __post_init__(self) -> None:
        if self.kind not in get_args(MaskKind):
            raise MitsimError(f"mask kind is {self.kind!r}; use one of {', '.join(get_args(MaskKind))}")
        if not (np.isfinite(self.feature_mm) and self.feature_mm > 0):
            raise MitsimError(f"mask feature size is {self.feature_mm} mm; give a finite number above 0")
        bits = np.asarray(self.bits)
        if bits.ndim != 1 or bits.size == 0 or not np.isin(bits, (0, 1)).all():
            raise MitsimError(
                f"mask code of shape {bits.shape} is not a list of 0 and 1; give one such number a feature"
            )
        self._hold(bits=bits.astype(np.int8))

    @property
    def extent_mm(self) -> float:
        """Side of the patterned square [mm]; it spans -extent/2 .. +extent/2."""
        return len(self.bits) * self.feature_mm

    @property
    def lines(self) -> FloatArray:
        """(N + 1,) coordinates of the lines between rows, and between columns [mm]."""
        return np.asarray((np.arange(len(self.bits) + 1) - len(self.bits) / 2) * self.feature_mm)

    @property
    def terms(self) -> tuple[Term, ...]:
        """Transmission as a sum of terms (weight, row profile (N,), column profile (N,))."""
        ones = np.ones(len(self.bits))
        if self.kind == "open":
            return ((1.0, ones, ones),)
        if self.kind == "separable":
            profile = self.bits.astype(np.float64)
            return ((1.0, profile, profile),)
        signed = 2 * self.bits.astype(np.float64) - 1
        return ((0.5, ones, ones), (0.5, signed, signed))

    @property
    def opening_mm(self) -> float:
        """Mean width of its openings [mm]."""
        is_open = np.ones_like(self.bits) if self.kind == "open" else self.bits
        return mean_opening(is_open[:, None] > 0, np.diff(self.lines))

    @property
    def amplitude(self) -> Mask:
        """The mask whose values are the factors of a field: itself, as roots of 0 and 1 are 0 and 1."""
        return self

    @property
    def openings(self) -> tuple[tuple[BoolArray, BoolArray], ...]:
        """What is open, as grids that do not overlap: (N,) rows and (N,) columns of each, open where both say so."""
        bits = self.bits.astype(bool)
        if self.kind == "open":
            return ((np.ones_like(bits), np.ones_like(bits)),)
        return ((bits, bits),) if self.kind == "separable" else ((bits, bits), (~bits, ~bits))

    def transmission(self, s_row: npt.ArrayLike, s_col: npt.ArrayLike) -> FloatArray:
        """Transmission (0..1) at points (``s_row``, ``s_col``) of the mask plane [mm]; the arrays broadcast."""
        row, row_inside = self._feature(s_row)
        column, column_inside = self._feature(s_col)
        total = sum(weight * rows[row] * columns[column] for weight, rows, columns in self.terms)
        return np.asarray(np.where(row_inside & column_inside, total, 0.0), dtype=np.float64)

    def _feature(self, s: npt.ArrayLike) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.bool_]]:
        """Index of the feature that holds each coordinate, and whether the mask reaches there at all."""
        count = len(self.bits)
        position = np.floor(np.asarray(s, dtype=np.float64) / self.feature_mm + count / 2)
        inside = (position >= 0) & (position < count)
        return np.where(inside, position, 0).astype(np.intp), inside


def mean_opening(is_open: BoolArray, widths: FloatArray) -> float:
    """Mean width of openings down the rows of a mask, in the unit of ``widths``; 0 without one.

    Parameters
    ----------
    is_open
        (N, c) of each place.
    widths
        (N,) of the rows.
    """
    begins = np.diff(is_open, axis=0, prepend=False) & is_open
    return float((widths @ is_open).sum() / max(np.count_nonzero(begins), 1))


@cache
def mls_code(order: int) -> npt.NDArray[np.int8]:
    """(2**order - 1,) bits of the maximum length sequence of an ``order`` from 2 to 16, read-only.

    The bits of ``scipy.signal.max_len_seq(order)[0]``, whose import alone takes a second: a linear feedback shift
    register that starts with ones. Polynomial and phase matter: another sequence moves the system's condition number
    by tens of percent. MitsimError for another order.
    """
    if isinstance(order, bool) or not isinstance(order, int) or order not in _TAPS:
        raise MitsimError(f"mask order is {order!r}; give a whole number from 2 to 16 (2**order - 1 features a side)")
    bits = [1] * order
    for start in range(2**order - 1 - order):
        bit = bits[start]
        for tap in _TAPS[order]:
            bit ^= bits[start + tap]
        bits.append(bit)
    code = np.array(bits, dtype=np.int8)
    code.flags.writeable = False
    return code


def mls_mask(kind: MaskKind = "separable", feature_mm: float = 0.06, order: int = 9) -> Mask:
    """The mask of :func:`mls_code`; the defaults are the paper's.

    Parameters
    ----------
    kind
        construction, see :class:`Mask`.
    feature_mm
        side of a feature [mm].
    order
        2 to 16: the mask has 2**order - 1 features a side.
    """
    return Mask(kind, feature_mm, mls_code(order))
