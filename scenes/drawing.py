"""Shapes and letters in millimetres in, 8-bit grey sheets out: the pen of the shipped scenes' pictures.

Coordinates are mm from the sheet's centre, x to the RIGHT and y up, as one sees the sheet. A shape is tested at 3 x 3
points a texel and the texel gets their mean, in whole numbers: no font, no resampling library and no function whose
last bit depends on a platform takes part, so a picture has the same pixels everywhere.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]
Bits = NDArray[np.bool_]
Plane = NDArray[np.float64]

_POINTS = 3  # a side and texel

FONT = {  # 5 x 7 dots, a row per number, most significant bit left
    "0": (14, 17, 19, 21, 25, 17, 14),
    "1": (4, 12, 4, 4, 4, 4, 14),
    "2": (14, 17, 1, 2, 4, 8, 31),
    "3": (31, 2, 4, 2, 1, 17, 14),
    "4": (2, 6, 10, 18, 31, 2, 2),
    "5": (31, 16, 30, 1, 1, 17, 14),
    "6": (6, 8, 16, 30, 17, 17, 14),
    "7": (31, 1, 2, 4, 8, 8, 8),
    "8": (14, 17, 17, 14, 17, 17, 14),
    "9": (14, 17, 17, 15, 1, 2, 12),
    ".": (0, 0, 0, 0, 0, 12, 12),
    " ": (0, 0, 0, 0, 0, 0, 0),
    "-": (0, 0, 0, 14, 0, 0, 0),
    "/": (1, 1, 2, 4, 8, 16, 16),
    "A": (4, 10, 17, 17, 31, 17, 17),
    "B": (30, 17, 17, 30, 17, 17, 30),
    "C": (14, 17, 16, 16, 16, 17, 14),
    "D": (30, 17, 17, 17, 17, 17, 30),
    "E": (31, 16, 16, 30, 16, 16, 31),
    "F": (31, 16, 16, 30, 16, 16, 16),
    "G": (14, 17, 16, 23, 17, 17, 15),
    "H": (17, 17, 17, 31, 17, 17, 17),
    "I": (14, 4, 4, 4, 4, 4, 14),
    "J": (7, 2, 2, 2, 2, 18, 12),
    "K": (17, 18, 20, 24, 20, 18, 17),
    "L": (16, 16, 16, 16, 16, 16, 31),
    "M": (17, 27, 21, 21, 17, 17, 17),
    "N": (17, 25, 21, 19, 17, 17, 17),
    "O": (14, 17, 17, 17, 17, 17, 14),
    "P": (30, 17, 17, 30, 16, 16, 16),
    "Q": (14, 17, 17, 17, 21, 18, 13),
    "R": (30, 17, 17, 30, 20, 18, 17),
    "S": (15, 16, 16, 14, 1, 1, 30),
    "T": (31, 4, 4, 4, 4, 4, 4),
    "U": (17, 17, 17, 17, 17, 17, 14),
    "V": (17, 17, 17, 17, 17, 10, 4),
    "W": (17, 17, 17, 21, 21, 27, 17),
    "X": (17, 17, 10, 4, 10, 17, 17),
    "Y": (17, 17, 10, 4, 4, 4, 4),
    "Z": (31, 1, 2, 4, 8, 16, 31),
}


class Sheet:
    """A sheet of paper of `width` x `height` mm, `per_mm` texels a mm, to draw reflectances on.

    Parameters
    ----------
    width, height
        mm; times `per_mm` they are rounded to whole texels, over which the sheet is then spread.
    paper
        reflectance 0..1 of what is not drawn on.
    """

    def __init__(self, width: float, height: float, per_mm: int, paper: float) -> None:
        columns, rows = round(width * per_mm), round(height * per_mm)
        self._fine = np.full((rows * _POINTS, columns * _POINTS), _code(paper), dtype=np.uint8)
        self._x = ((np.arange(columns * _POINTS) + 0.5) / (columns * _POINTS) - 0.5) * width
        self._y = (0.5 - (np.arange(rows * _POINTS) + 0.5) / (rows * _POINTS)) * height

    def grey(self) -> Grey:
        """(rows, columns) texels, row 0 on top, column 0 at the left: rounded means of the points drawn."""
        rows, columns = (size // _POINTS for size in self._fine.shape)
        total = self._fine.reshape(rows, _POINTS, columns, _POINTS).astype(np.int64).sum(axis=(1, 3))
        return np.asarray((total + _POINTS**2 // 2) // _POINTS**2, dtype=np.uint8)

    def paint(
        self, x: tuple[float, float], y: tuple[float, float], test: Callable[[Plane, Plane], Bits], value: float
    ) -> None:
        """Give the reflectance `value` to the points of the box `x`, `y` [mm] where `test(x, y)` holds."""
        columns = np.flatnonzero((self._x >= x[0]) & (self._x < x[1]))
        rows = np.flatnonzero((self._y >= y[0]) & (self._y < y[1]))
        if columns.size and rows.size:
            part = self._fine[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            inside = test(*np.broadcast_arrays(self._x[columns][None, :], self._y[rows][:, None]))
            part[inside] = _code(value)

    def box(self, left: float, bottom: float, right: float, top: float, value: float) -> None:
        """A filled rectangle between two corners [mm]."""
        self.paint((left, right), (bottom, top), lambda x, y: np.ones(x.shape, dtype=bool), value)

    def disc(self, x: float, y: float, radius: float, value: float, hole: float = 0.0) -> None:
        """A filled disc [mm]; with `hole`, the radius inside which nothing is painted, a ring."""

        def inside(px: Plane, py: Plane) -> Bits:
            squared = (px - x) * (px - x) + (py - y) * (py - y)
            return (squared < radius * radius) & (squared >= hole * hole)

        self.paint((x - radius, x + radius), (y - radius, y + radius), inside, value)

    def polygon(self, corners: list[tuple[float, float]], value: float) -> None:
        """A filled polygon [mm]; where it overlaps itself it is open (even-odd rule)."""

        def inside(px: Plane, py: Plane) -> Bits:
            result = np.zeros(px.shape, dtype=bool)
            for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1], strict=True):
                if y0 != y1:
                    result ^= ((y0 > py) != (y1 > py)) & (px < (x1 - x0) * (py - y0) / (y1 - y0) + x0)
            return result

        across, up = zip(*corners, strict=True)
        self.paint((min(across), max(across)), (min(up), max(up)), inside, value)

    def line(self, start: tuple[float, float], end: tuple[float, float], width: float, value: float) -> None:
        """A straight stroke with square ends [mm]."""
        (x0, y0), (x1, y1) = start, end
        length = float(np.sqrt((x1 - x0) ** 2 + (y1 - y0) ** 2))
        a, b = (y0 - y1) / length * width / 2, (x1 - x0) / length * width / 2
        self.polygon([(x0 + a, y0 + b), (x1 + a, y1 + b), (x1 - a, y1 - b), (x0 - a, y0 - b)], value)

    def text(self, words: str, left: float, bottom: float, height: float, value: float) -> None:
        """Capitals and digits of `height` mm on a line, bottom left corner at (left, bottom) [mm].

        A letter is 5/7 of its height wide and stands 6/7 of it from the next; see :func:`text_width`.
        """
        for position, character in enumerate(words):
            dots = _smooth(_smooth(glyph(character)))
            side = height / dots.shape[0]
            start = left + position * 6 / 7 * height

            def inside(x: Plane, y: Plane, dots: Bits = dots, side: float = side, start: float = start) -> Bits:
                row = np.clip(((bottom + height - y) / side).astype(int), 0, dots.shape[0] - 1)
                column = np.clip(((x - start) / side).astype(int), 0, dots.shape[1] - 1)
                return dots[row, column]

            self.paint((start, start + 5 / 7 * height), (bottom, bottom + height), inside, value)


def text_width(words: str, height: float) -> float:
    """Width [mm] of words that stand `height` mm tall."""
    return (6 * len(words) - 1) / 7 * height


def glyph(character: str) -> Bits:
    """(7, 5) dots of a character; KeyError for one that the font lacks."""
    return np.array([[bits >> (4 - bit) & 1 for bit in range(5)] for bits in FONT[character]], dtype=bool)


def _smooth(dots: Bits) -> Bits:
    """(n, m) to (2n, 2m) by the rule Scale2x: a corner between two equal neighbours takes their value."""
    padded = np.pad(dots, 1)
    up, down = padded[:-2, 1:-1], padded[2:, 1:-1]
    left, right = padded[1:-1, :-2], padded[1:-1, 2:]
    result = np.repeat(np.repeat(dots, 2, axis=0), 2, axis=1)
    for row, vertical, opposite in ((0, up, down), (1, down, up)):
        for column, side, other in ((0, left, right), (1, right, left)):
            cut = (vertical == side) & (vertical != other) & (side != opposite)
            result[row::2, column::2] = np.where(cut, vertical, dots)
    return result


def _code(value: float) -> int:
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"reflectance {value:g} is outside 0..1")
    return round(value * 255)
