"""Accumulation of light on the device: from connections to a sparse matrix of light per row and place.

Light is added in whole numbers of a small unit, so that sums do not depend on the order in which threads add, and only
the sums are fetched. Where :class:`mitsim.transport.records.Bundle` splits light between two layers, the accumulator
splits too, or draws one layer: the mean is the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import pairwise, product
from operator import or_

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from scipy import sparse

from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.errors import MitsimError
from mitsim.core.job import compiled_kernels
from mitsim.transport.records import Bundle, CellAxis, Sightings

MOST_PLACES = 2**26
_UNIT_BITS = 30
"""Power of two of units in a bright path's light: rounding moves a path's by 5e-10 of it at most, and a place holds
2^34 times as much."""
_PAYS = 4
"""Places for each part of a path below which an accumulator pays: fetching a place takes 0.03 us, and a part of a path
on the host 0.1 us or more (balls of the highlight)."""
_MOST_BITS = 52
"""Power of two of units that one path may bring, four million times a bright path's; a place would hold 4096 of
them."""


@dataclass(frozen=True, eq=False)
class Lit:
    """Sums that hold light of any line, and their places in a matrix.

    Attributes
    ----------
    numbers
        Numbers of the sums, increasing.
    rows, size, lamps
        Rows of the projector's light, places, and rows of lamps after them.
    """

    numbers: npt.NDArray[np.uint32]
    rows: int
    size: int
    lamps: int

    @property
    def inside(self) -> int:
        return int(np.searchsorted(self.numbers, np.uint32(self.size * self.rows)))

    @cached_property
    def layout(self) -> sparse.csr_array:
        # All places fit 32 bits, in which matrices take half the time.
        numbers = self.numbers[: self.inside]
        places = (numbers // np.uint32(self.rows)).astype(np.int32)
        row = numbers.astype(np.int32) - places * np.int32(self.rows)
        starts = np.append(0, np.cumsum(np.bincount(places, minlength=self.size))).astype(np.int32)
        which = np.arange(len(numbers), dtype=np.int32)
        found = sparse.csc_array((which, row, starts), shape=(self.rows + self.lamps, self.size)).tocsr()
        for shared in (found.indices, found.indptr):
            shared.flags.writeable = False
        return found

    def matrix(self, light: FloatArray) -> sparse.csr_array:
        layout = self.layout
        return sparse.csr_array((light[layout.data], layout.indices, layout.indptr), shape=layout.shape)


class DeviceAccumulator:
    """Sums of light by row and place.

    Parameters
    ----------
    labels
        (n^2,) row of each projector pixel.
    one
        Irradiance of about a bright path [W m^-2].

    Attributes
    ----------
    sums
        ((places * rows + 1) * lines,) on the device, in units. A place's rows lie side by side, because neighbouring
        pixels have different rows and light one place at a time; so do the lines, because a path has light of every
        line.
    traced
        Number of traces that have added light.
    """

    def __init__(self, bundle: Bundle, labels: Labels, one: float, lines: int = 1) -> None:
        self._bundle, self._rows, self.lines = bundle, int(labels.max()) + 1, lines
        self._width = self._places(bundle)
        self._unit = 2.0 ** (math.floor(math.log2(one)) - _UNIT_BITS)
        self._labels = mi.UInt32(labels.astype(np.uint32))
        # A last entry that counts what is no light.
        self._entries = self._rows * self._width + 1
        self.sums = dr.zeros(mi.UInt64, self._entries * lines)
        self.traced = 0

    def _of_line(self, line: int, entries: mi.UInt32 | None = None) -> mi.UInt64:
        if entries is None and self.lines == 1:
            return self.sums
        if entries is None:
            entries = dr.arange(mi.UInt32, self._entries)
        if not len(entries):  # of which there are no multiples
            return mi.UInt64()
        return dr.gather(mi.UInt64, self.sums, entries * self.lines + line)

    @staticmethod
    def _places(bundle: Bundle) -> int:
        return bundle.size + bundle.anchors**2

    @staticmethod
    def holds(bundle: Bundle, labels: Labels, lines: int = 1, paths: float = math.inf) -> bool:
        """Return True if an accumulator has room, and takes less time than the host."""
        entries = (int(labels.max()) + 1) * DeviceAccumulator._places(bundle)
        parts = (4 if bundle.between else 1) * min(len(bundle.depths), 2)
        return lines * entries < MOST_PLACES and entries < _PAYS * parts * paths

    def place(self, seen: Sightings, chosen: mi.Float, anchor: tuple[mi.UInt32, mi.UInt32] | None = None) -> mi.UInt32:
        """Return the one place that accumulates light; numbers `chosen` in [0, 1) choose its layer."""
        layer = mi.UInt32(0)
        for part in self._parts_beyond(seen):
            layer += dr.select(chosen < part, mi.UInt32(1), mi.UInt32(0))
        cells = [self._cell(axis, tau) for axis, tau in self._axes(seen)]
        return self._place(seen, layer, cells, anchor)

    def shares(self, seen: Sightings, anchor: tuple[mi.UInt32, mi.UInt32]) -> Iterator[tuple[mi.UInt32, mi.Float]]:
        passed = [dr.clip(part, 0, 1) for part in self._parts_beyond(seen)]
        layers = [(mi.UInt32(k), a - b) for k, (a, b) in enumerate(pairwise([mi.Float(1), *passed, mi.Float(0)]))]
        rows, columns = (self._cells(axis, tau) for axis, tau in self._axes(seen))
        for (layer, part), (row, row_part), (column, column_part) in product(layers, rows, columns):
            yield self._place(seen, layer, [row, column], anchor), part * row_part * column_part

    def _axes(self, seen: Sightings) -> tuple[tuple[CellAxis, mi.Float], tuple[CellAxis, mi.Float]]:
        return (self._bundle.grid.rows, seen.row), (self._bundle.grid.columns, seen.column)

    def _parts_beyond(self, seen: Sightings) -> Iterator[mi.Float]:
        for low, high in pairwise(1 / depth for depth in self._bundle.depths):
            yield (seen.inverse_depth - dr.opaque(mi.Float, low)) / dr.opaque(mi.Float, high - low)

    @staticmethod
    def _position(axis: CellAxis, tau: mi.Float) -> mi.Float:
        return (tau - dr.opaque(mi.Float, axis.start)) * dr.opaque(mi.Float, 1 / axis.size)

    def _cell(self, axis: CellAxis, tau: mi.Float) -> mi.UInt32:
        return mi.UInt32(dr.maximum(dr.floor(self._position(axis, tau)), 0))

    def _cells(self, axis: CellAxis, tau: mi.Float) -> list[tuple[mi.UInt32, mi.Float]]:
        if not self._bundle.between or axis.count == 1:
            return [(self._cell(axis, tau), mi.Float(1))]
        position = dr.clip(self._position(axis, tau) - 0.5, 0, dr.opaque(mi.Float, axis.count - 1))
        first = dr.minimum(mi.UInt32(position), dr.opaque(mi.UInt32, axis.count - 2))
        beyond = position - mi.Float(first)
        return [(first, 1 - beyond), (first + 1, beyond)]

    def _place(
        self, seen: Sightings, layer: mi.UInt32, cells: Sequence[mi.UInt32], anchor: tuple[mi.UInt32, mi.UInt32] | None
    ) -> mi.UInt32:
        inside = mi.Bool(True)
        for axis, tau in self._axes(seen):
            position = self._position(axis, tau)
            inside &= (position >= 0) & (position < dr.opaque(mi.Float, axis.count))
        grid = self._bundle.grid
        rows, columns, anchors = (dr.opaque(mi.UInt32, count) for count in (*grid.shape, self._bundle.anchors))
        line, column = anchor or (mi.UInt32(0), mi.UInt32(0))
        place = ((layer * anchors + line) * rows + cells[0]) * (anchors * columns) + column * columns + cells[1]
        return dr.select(inside, place, dr.opaque(mi.UInt32, self._bundle.size) + line * anchors + column)

    def add(
        self, lights: Sequence[mi.Float], pixel: mi.UInt32, place: mi.UInt32, active: mi.Bool | bool = True
    ) -> None:
        for line, light in enumerate(lights):
            units = light * dr.opaque(mi.Float, 1 / self._unit)
            fits = (units >= 0) & (units < 2.0**_MOST_BITS)
            lit = mi.Bool(active) & ~(light == 0)  # not a number is light to be refused
            row = dr.gather(mi.UInt32, self._labels, pixel, lit)
            entry = dr.select(fits, place * dr.opaque(mi.UInt32, self._rows) + row, self._rows * self._width)
            amount = dr.select(fits, mi.UInt64(dr.round(units)), mi.UInt64(1))
            index = entry * self.lines + line
            dr.scatter_reduce(dr.ReduceOp.Add, self.sums, amount, index, lit, mode=dr.ReduceMode.Direct)

    def fetch(self) -> list[DeviceSums]:
        lines = range(self.lines)
        lit = dr.compress(reduce(or_, (self._of_line(line) != 0 for line in lines)))
        units = [self._of_line(line, lit) for line in lines]
        dr.eval(lit, units)
        self.sums = dr.zeros(mi.UInt64, self._entries * self.lines)
        found = Lit(np.array(lit), self._rows, self._bundle.size, self._bundle.lamps)
        compiled_kernels()
        return [DeviceSums(self, found, np.array(each)) for each in units]


@dataclass(frozen=True, eq=False)
class DeviceSums:
    accumulator: DeviceAccumulator
    lit: Lit
    units: npt.NDArray[np.uint64]

    def light(self, samples: int = 1) -> tuple[sparse.csr_array, float, float]:
        """Return light (rows + lamps, places) per sample, all light received, and the light outside [W m^-2].

        Raise MitsimError for light that is NaN, infinite, or four million times a bright path's.
        """
        lit, units, accumulator = self.lit, self.units, self.accumulator
        if len(lit.numbers) and lit.numbers[-1] == accumulator._rows * accumulator._width and units[-1]:
            raise MitsimError(
                "the scene reflects NaN, infinite or boundless light toward the camera; check its materials"
            )
        light = units.astype(np.float64) * (accumulator._unit / samples)
        return lit.matrix(light), float(light.sum()), float(light[lit.inside :].sum())

    def beyond(self, samples: int = 1) -> FloatArray:
        lit, accumulator = self.lit, self.accumulator
        rows, anchors = accumulator._rows, accumulator._bundle.anchors
        # Its last one counts what is no light.
        found = np.zeros(rows * anchors**2 + 1)
        found[lit.numbers[lit.inside :] - np.uint32(rows * accumulator._bundle.size)] = self.units[lit.inside :]
        by_row = np.moveaxis(found[:-1].reshape(anchors, anchors, rows), 2, 0)
        return np.asarray(by_row * (accumulator._unit / samples))
