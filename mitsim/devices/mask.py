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
from mitsim.core.errors import MitsimError

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
# Over-etching moves the edges of all openings outward and under-etching inward; corners stay square. Edge blur is a
# Gaussian over the transmission of power. Dust on the mask is discs that transmit less light. Then the mask is turned
# in its plane, and tilted to the sensor.

_REACH = 8.3
_LINES = 16
"""Lines that cross a disc of dust; they leave 1e-3 of its shadow."""
_CHORDS = 16
_MOST_DISCS = 100


@dataclass(frozen=True, eq=False)
class Dust(ByValue):
    """Discs on a mask: (k, 2) centres, one radius, and one opacity, also where discs overlap."""

    centres_mm: FloatArray
    radius_mm: float
    opacity: float

    def __post_init__(self) -> None:
        self._hold(centres_mm=np.array(self.centres_mm, dtype=np.float64))

    def turn(self, quarters: int) -> Dust:
        row, column = self.centres_mm.T
        for _ in range(quarters % 4):
            row, column = -column, row
        return Dust(np.stack((row, column), axis=1), self.radius_mm, self.opacity)


@dataclass(frozen=True)
class Flaws:
    """Flaws of a mask: blur of its edges, turn from rows to columns, tilt along rows and along columns, and dust."""

    blur_mm: float = 0.0
    turn_deg: float = 0.0
    tilt_mrad: tuple[float, float] = (0.0, 0.0)
    dust: Dust | None = None

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


# ---- Etching and dust ----


def etch(values: FloatArray, feature_mm: float, grow_mm: float) -> tuple[FloatArray, FloatArray]:
    """Return lines (2 N + 2,) and values (2 N + 1, 2 N + 1) of a mask whose openings grew on each side.

    Every place gets the greatest transmission within a square of half-side ``grow_mm``, or the least if negative.
    """
    count = len(values)
    even = (np.arange(count + 1) - count / 2) * feature_mm
    lines = np.unique(np.concatenate((even - abs(grow_mm), even + abs(grow_mm))))
    middles, reach = (lines[1:] + lines[:-1]) / 2 / feature_mm + count / 2, abs(grow_mm) / feature_mm
    first = np.floor(middles - reach).astype(np.intp)
    last = np.ceil(middles + reach).astype(np.intp) - 1
    choose = np.maximum if grow_mm > 0 else np.minimum
    for _ in ("rows", "columns"):
        padded = np.concatenate((np.zeros((1, values.shape[1])), values, np.zeros((1, values.shape[1]))))
        found = padded[np.clip(first + 1, 0, count + 1)]
        for further in range(1, int((last - first).max()) + 1):
            found = choose(found, padded[np.clip(np.minimum(first + further, last) + 1, 0, count + 1)])
        values = found.T
    return lines, values


def draw_dust(lines: FloatArray, values: FloatArray, dust: Dust, reach_mm: float) -> tuple[FloatArray, FloatArray]:
    """Return a mask's lines (N + 1,) and transmissions (N, N) with the dust within ``reach_mm`` of the centre.

    Raises MitsimError for more dust than can be drawn.
    """
    centres = dust.centres_mm[(np.abs(dust.centres_mm) < reach_mm + dust.radius_mm).all(axis=1)]
    if len(centres) > _MOST_DISCS:
        problem = f"mask: {len(centres)} discs of dust are in sight, and at most {_MOST_DISCS} are drawn"
        raise MitsimError(f"{problem}; set a lower dust_per_mm2, or fewer pixels")
    if not len(centres):
        return lines, values
    across = dust.radius_mm * -np.cos(np.linspace(0, np.pi, _LINES + 1))  # closer where a disc's edge is steep
    finer = np.unique(np.concatenate((lines, (centres.ravel()[:, None] + across).ravel())))
    finer = finer[(finer >= lines[0]) & (finer <= lines[-1])]
    place = np.searchsorted(lines, (finer[1:] + finer[:-1]) / 2) - 1
    result, radius = np.asarray(values[np.ix_(place, place)]), dust.radius_mm
    edges: list[tuple[float, Literal["left", "right"]]] = [(-radius, "right"), (radius, "left")]
    for centre in centres:
        row_lines, column_lines = (finer - at for at in centre)
        near = [[int(np.searchsorted(at, end, side)) for end, side in edges] for at in (row_lines, column_lines)]
        rows, columns = (slice(max(start - 1, 0), stop) for start, stop in near)  # cells that the disc meets
        r, c = row_lines[rows.start : rows.stop + 1], column_lines[columns.start : columns.stop + 1]
        chords = r[:-1, None] + np.diff(r)[:, None] * ((np.arange(_CHORDS) + 0.5) / _CHORDS)
        half = np.sqrt(np.maximum(radius**2 - chords**2, 0))[:, :, None]
        within = np.diff(np.clip(c, -half, half), axis=2).mean(axis=1)
        result[rows, columns] *= 1 - dust.opacity * np.minimum(within / np.diff(c), 1)
    return finer, result
