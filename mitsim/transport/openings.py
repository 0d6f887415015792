"""Where a mask is open: from the part of it that a sensor point sees to open places in it, drawn evenly.

A mask is a sum of grids that do not overlap (:attr:`mitsim.rig.mask.Mask.openings`): open where both its row and its
column are. On each axis the open length up to a coordinate is piecewise linear and so is its inverse, which makes a
random number a place: whatever rows are open, those within the range are met in proportion to their length.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.rig.mask import BoolArray, Mask
from mitsim.rig.plate import Plate


class OpenAxis:
    """The open rows of a grid, or its columns; coordinates count features from the first one's edge.

    ``bits`` (N,) tell which are open.
    """

    def __init__(self, bits: BoolArray) -> None:
        self._size = len(bits)
        # Once more at the end, and a place that is not there after the last one: nothing is open beyond the mask.
        before = np.cumsum(np.concatenate([[0], bits, [0]]))
        self._before = mi.UInt32(before.astype(np.uint32))
        self._places = mi.UInt32(np.append(np.flatnonzero(bits), len(bits)).astype(np.uint32))

    def seen(self, low: mi.Float, width: float) -> _Seen:
        """What is open from ``low`` on over a ``width``."""
        # From the feature that holds its start: the width of a narrow view keeps its digits.
        start = mi.UInt32(dr.clip(low, 0, self._size))
        within = low - mi.Float(start)
        last = dr.clip(within + width, 0, self._size - mi.Float(start))
        end = mi.UInt32(last)
        before, first = self._open(start)
        after, tail = self._open(start + end)
        skipped = first * dr.maximum(within, 0)
        length = mi.Float(after - before) + tail * (last - mi.Float(end)) - skipped
        return _Seen(self._places, start, within, before, skipped, dr.maximum(length, 0))

    def _open(self, index: mi.UInt32) -> tuple[mi.UInt32, mi.Float]:
        """How many features are open before the one of an ``index``, and whether it is itself: 1 or 0."""
        before = dr.gather(mi.UInt32, self._before, index)
        return before, mi.Float(dr.gather(mi.UInt32, self._before, index + 1) - before)


@dataclass
class _Seen:
    """An axis from the range's start: the feature that holds it, how far inside, what is open before, and within."""

    places: mi.UInt32
    start: mi.UInt32
    within: mi.Float
    before: mi.UInt32
    skipped: mi.Float
    length: mi.Float

    def drawn(self, number: mi.Float) -> mi.Float:
        """Distance from the range's start, in features, of the open place that a ``number`` in [0, 1) means."""
        place = self.skipped + number * self.length
        whole = mi.UInt32(place)
        feature = dr.gather(mi.UInt32, self.places, dr.minimum(self.before + whole, dr.width(self.places) - 1))
        return (mi.Float(feature) - mi.Float(self.start)) + (place - mi.Float(whole)) - self.within


class Openings:
    """The open places of a ``mask``; of a plate without grids of them, a rectangle that holds them."""

    def __init__(self, mask: Mask | Plate) -> None:
        self._grids = [(OpenAxis(rows), OpenAxis(columns)) for rows, columns in mask.openings]

    def drawn(self, corner: mi.Point2f, width: float, number: mi.Point2f) -> tuple[mi.Float, mi.Float, mi.Float]:
        """An open place of a square window, each as likely as any other.

        Parameters
        ----------
        corner
            the window's first (row, column), in features from the mask's first corner.
        width
            its side, in features.
        number
            of the unit square: the same for the same place.

        Returns
        -------
        row and column from the window's first corner, in features, and the part of the window that is open: where it is
        0 the place means nothing.
        """
        grids = [(rows.seen(corner.x, width), columns.seen(corner.y, width)) for rows, columns in self._grids]
        areas = [rows.length * columns.length for rows, columns in grids]
        total = sum(areas[1:], areas[0])
        left, (rows, columns) = number.y * total, grids[0]
        chosen = [rows.drawn(number.x), columns.drawn(_part(left, areas[0]))]
        for (rows, columns), area, before in zip(grids[1:], areas[1:], areas, strict=False):
            further, left = left >= before, left - before
            place = rows.drawn(number.x), columns.drawn(_part(left, area))
            chosen = [dr.select(further, new, old) for new, old in zip(place, chosen, strict=True)]
        row, column = (dr.clip(place, 0, width) for place in chosen)
        return row, column, total / width**2


def _part(amount: mi.Float, whole: mi.Float) -> mi.Float:
    """An ``amount`` in units of the ``whole``; 0 of nothing."""
    return dr.select(whole > 0, amount / whole, 0)
