"""A coded mask: from a 0/1 code, a construction and a feature size to its transmission at any point of the mask plane.

Coordinates are index coordinates, ``s_row = -y`` and ``s_col = -x`` in mm, centred on the optical axis. The mask is
opaque outside its features.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import ClassVar, Literal

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import ByValue, FloatArray

MaskKind = Literal["separable", "flatcam", "open"]
CameraMask = Literal["separable", "flatcam", "open", "plate"]
Term = tuple[float, FloatArray, FloatArray]
"""Weight, row profile (N,) and column profile (N,) of a separable part of a transmission."""
BoolArray = npt.NDArray[np.bool_]
# fmt: off
_TAPS = {
    2: (1,), 3: (2,), 4: (3,), 5: (3,), 6: (5,), 7: (6,), 8: (7, 6, 1), 9: (5,), 10: (7,), 11: (9,), 12: (11, 10, 4),
    13: (12, 11, 8), 14: (13, 12, 2), 15: (14,), 16: (15, 13, 4),
}
# fmt: on
"""Feedback taps by order, as in ``scipy.signal.max_len_seq``."""


# ---- Flaws of making and mounting a mask ----
#
# Edge blur is a Gaussian over the transmission of power. The blurred mask is turned in its plane, and tilted to the
# sensor.

_REACH = 8.3


@dataclass(frozen=True)
class Flaws:
    """Flaws of a mask: blur of its edges, turn from rows to columns, and tilt along rows and along columns."""

    blur_mm: float = 0.0
    turn_deg: float = 0.0
    tilt_mrad: tuple[float, float] = (0.0, 0.0)

    @property
    def margin_mm(self) -> float:
        return _REACH * self.blur_mm

    def reach(self, extent_mm: float) -> float:
        angle = np.radians(self.turn_deg)
        # A ray meets a tilted mask farther out than an even one, by less than the tangent of the tilt.
        tilt = 1 + sum(abs(angle) for angle in self.tilt_mrad) * 1e-3
        return float(extent_mm * (abs(np.cos(angle)) + abs(np.sin(angle))) * tilt**2 + 2 * self.margin_mm)

    def turned_back(self, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        if not self.turn_deg:
            return row, column
        cosine, sine = np.cos(np.radians(self.turn_deg)), np.sin(np.radians(self.turn_deg))
        return cosine * row + sine * column, cosine * column - sine * row


NO_FLAWS = Flaws()
"""A mask as it is drawn."""


# ---- A mask made from a code ----


@dataclass(frozen=True, eq=False)
class Mask(ByValue):
    """An opaque plate with a square grid of features, each open or closed.

    Attributes
    ----------
    kind
        ``separable``: transmission a(row) a(column) with a the 0/1 bits (25 % open).
        ``flatcam``: (1 + m(row) m(column)) / 2 with m = 2 bits - 1 (50 % open).
        ``open``: every feature open, an aperture of the mask's size.
    bits
        (N,) 0/1 code of rows and columns, read-only.
    """

    kind: MaskKind
    feature_mm: float
    bits: npt.NDArray[np.int8]
    blur_mm: ClassVar[float] = 0.0
    """Standard deviation of its edges, which are sharp."""
    even: ClassVar[bool] = True
    """Features are squares of one size."""
    flaws: ClassVar[Flaws] = NO_FLAWS
    irradiance: ClassVar[bool] = False
    many: ClassVar[bool] = False
    """Two terms at most."""
    diffracts: ClassVar[bool] = True

    def __post_init__(self) -> None:
        self._hold(bits=np.array(self.bits, dtype=np.int8))

    @property
    def extent_mm(self) -> float:
        return len(self.bits) * self.feature_mm

    @property
    def lines(self) -> FloatArray:
        return np.asarray((np.arange(len(self.bits) + 1) - len(self.bits) / 2) * self.feature_mm)

    @property
    def terms(self) -> tuple[Term, ...]:
        ones = np.ones(len(self.bits))
        if self.kind == "open":
            return ((1.0, ones, ones),)
        if self.kind == "separable":
            profile = self.bits.astype(np.float64)
            return ((1.0, profile, profile),)
        signed = 2 * self.bits.astype(np.float64) - 1
        return ((0.5, ones, ones), (0.5, signed, signed))

    crosses = terms
    """Both terms are exact."""

    @property
    def centred(self) -> bool:
        return self.kind == "flatcam"

    @property
    def opening_mm(self) -> float:
        is_open = np.ones_like(self.bits) if self.kind == "open" else self.bits
        return mean_opening(is_open[:, None] > 0, np.diff(self.lines))

    @property
    def amplitude(self) -> Mask:
        return self

    @property
    def openings(self) -> tuple[tuple[BoolArray, BoolArray], ...]:
        """Return grids of openings that do not overlap, (N,) rows and (N,) columns each."""
        bits = self.bits.astype(bool)
        if self.kind == "open":
            return ((np.ones_like(bits), np.ones_like(bits)),)
        return ((bits, bits),) if self.kind == "separable" else ((bits, bits), (~bits, ~bits))

    def transmission(self, s_row: npt.ArrayLike, s_col: npt.ArrayLike) -> FloatArray:
        count = len(self.bits)
        row, column = (np.floor(np.asarray(s, dtype=np.float64) / self.feature_mm + count / 2) for s in (s_row, s_col))
        in_rows, in_columns = ((at >= 0) & (at < count) for at in (row, column))
        i, j = np.where(in_rows, row, 0).astype(np.intp), np.where(in_columns, column, 0).astype(np.intp)
        total = sum(weight * rows[i] * columns[j] for weight, rows, columns in self.terms)
        return np.asarray(np.where(in_rows & in_columns, total, 0.0), dtype=np.float64)


def mean_opening(is_open: BoolArray, widths: FloatArray) -> float:
    begins = np.diff(is_open, axis=0, prepend=False) & is_open
    return float((widths @ is_open).sum() / max(np.count_nonzero(begins), 1))


@cache
def mls_code(order: int) -> npt.NDArray[np.int8]:
    """Return the (2**order - 1,) bits of the maximum length sequence of an ``order`` from 2 to 16, read-only.

    They are ``scipy.signal.max_len_seq(order)[0]``, whose import takes a second. Polynomial and phase matter, because
    another sequence changes the condition number by tens of percent.
    """
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
    return Mask(kind, feature_mm, mls_code(order))
