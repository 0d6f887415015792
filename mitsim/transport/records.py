"""Light per cell from path samples: a sparse matrix light[row, layer x (anchor, cell) x (anchor, cell)].

A row is a projector pixel, or a class of pixels that a pattern family always lights together; the last rows are ambient
light. A path's light is split between the two layers (in 1/z) that enclose its depth.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from itertools import pairwise, product
from operator import or_
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from scipy import sparse

from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.environment import device_array
from mitsim.core.errors import MitsimError
from mitsim.core.job import compiled_kernels
from mitsim.optics.shadow import Directions
from mitsim.transport.plugins.base import Light, panchromatic

IntArray = npt.NDArray[np.int64]
Anchor: TypeAlias = "tuple[mi.UInt32, mi.UInt32]"
AMBIENT, DIRECT, INDIRECT = 0, 1, 2
"""Kinds of light: of lamps, of the projector over one surface that is no mirror, and over several."""
_COUNTED = 4


# -------- Light of connections in the renderer


@dataclass
class Sightings:
    value: mi.Float
    pixel: mi.UInt32
    row: mi.Float
    column: mi.Float
    inverse_depth: mi.Float
    lines: mi.UnpolarizedSpectrum | None = None

    @classmethod
    def of(cls, light: Light, by_line: bool, pixel: mi.UInt32, *place: mi.Float) -> Sightings:
        row, column, inverse_depth = place
        lines = light / len(light) if by_line else None
        return cls(panchromatic(light), pixel, row, column, inverse_depth, lines)

    @classmethod
    def none(cls, by_line: bool = False) -> Sightings:
        return cls.of(mi.UnpolarizedSpectrum(0), by_line, mi.UInt32(0), mi.Float(0), mi.Float(0), mi.Float(0))

    def joined_by(self, more: Sightings, number: mi.Float) -> Sightings:
        """Draw one of these and ``more`` in proportion to its light; it carries the light of both.

        By line it carries its own light over the chance that it is drawn.
        """
        total = self.value + more.value
        new = number * total < more.value
        joined: Sightings = dr.select(new, more, self)
        own, joined.value = joined.value, total
        if joined.lines is not None:
            joined.lines = dr.select(own == 0, 0, joined.lines * (total / own))
        return joined

    def by_line(self, lines: int) -> list[mi.Float]:
        return [self.value] if self.lines is None or lines == 1 else [self.lines[line] for line in range(lines)]


def check_finite(light: npt.NDArray[Any]) -> None:
    if not np.isfinite(light).all():
        raise MitsimError("the scene reflects NaN or infinite light toward the camera; check its materials")


# -------- Path samples, fetched from the renderer


@dataclass(frozen=True, eq=False)
class PathSamples:
    """Light that paths brought to the camera, one entry (m,) a connection.

    ``pixel`` is n^2 plus the band for ambient light. ``row`` and ``column`` are tan-angles from the sensor's centre,
    ``inverse_depth`` is 1/z of the point where the light is seen [1/mm], ``value`` its irradiance [W m^-2]. ``lines``
    (4, m) is ``value`` by line, then zeros, in single precision.
    """

    pixel: IntArray
    anchor_row: IntArray
    anchor_column: IntArray
    row: FloatArray
    column: FloatArray
    inverse_depth: FloatArray
    value: FloatArray
    kind: npt.NDArray[np.int16]
    lines: npt.NDArray[np.float32] | None = None
    lane: IntArray | None = None

    @classmethod
    def join(cls, parts: Sequence[PathSamples]) -> PathSamples:
        parts = parts or [cls.none()]
        if len(parts) == 1:
            return parts[0]
        by_line = [part.lines for part in parts if part.lines is not None]
        lines = np.concatenate(by_line, axis=1) if by_line and len(by_line) == len(parts) else None
        arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
        return cls(**arrays, lines=lines)

    def by_line(self, lines: int) -> list[PathSamples]:
        if lines == 1 or not len(self.value):
            return [self] * lines
        assert self.lines is not None, "traced by line"
        return [replace(self, value=self.lines[line].astype(np.float64), lines=None) for line in range(lines)]

    @classmethod
    def fetch(cls, seen: Sightings, kind: int, anchors: Anchor | None = None) -> PathSamples:
        # Together: one by one, each would trace all paths again.
        dr.eval(seen, anchors)
        light = np.array(seen.value)
        check_finite(light)
        lit = np.flatnonzero(light)
        whole = lit.size == light.size

        def lit_ones(values: mi.Float, dtype: type) -> npt.NDArray[Any]:
            found = np.asarray(values)
            return (found if whole else found[..., lit]).astype(dtype)

        none = np.zeros(lit.size, np.int64)
        return cls(
            pixel=lit_ones(seen.pixel, np.int64),
            anchor_row=none if anchors is None else lit_ones(anchors[0], np.int64),
            anchor_column=none if anchors is None else lit_ones(anchors[1], np.int64),
            row=lit_ones(seen.row, np.float64),
            column=lit_ones(seen.column, np.float64),
            inverse_depth=lit_ones(seen.inverse_depth, np.float64),
            value=lit_ones(light, np.float64),
            kind=np.full(lit.size, kind, dtype=np.int16),
            lines=None if seen.lines is None else lit_ones(seen.lines, np.float32),
            lane=lit,
        )

    @classmethod
    def none(cls) -> PathSamples:
        index, number = np.zeros(0, dtype=np.int64), np.zeros(0)
        return cls(index, index, index, number, number, number, number, np.zeros(0, dtype=np.int16))

    def average(self, weights: FloatArray) -> PathSamples:
        first = np.zeros_like(self.pixel)
        value = self.value * weights[self.anchor_row] * weights[self.anchor_column]
        return replace(self, anchor_row=first, anchor_column=first, value=value)

    def where(self, chosen: npt.NDArray[np.bool_] | slice) -> PathSamples:
        lines = None if self.lines is None else self.lines[:, chosen]
        return PathSamples(**{name: getattr(self, name)[chosen] for name in _ARRAYS}, lines=lines)


_ARRAYS = tuple(name for name in PathSamples.__dataclass_fields__ if name not in ("lines", "lane"))


# -------- Accumulation by layer, anchor and cell


@dataclass(frozen=True)
class Bundle:
    """Accumulation of light in cells, anchors and layers, whose ``depths`` [mm] are far to near.

    ``between`` splits light between the two nearest cell centres, because sharp lobes send it from a small part of a
    cell.
    """

    grid: CellGrid
    anchors: int
    depths: tuple[float, ...]
    between: bool = False
    lamps: int = 1

    @property
    def directions(self) -> tuple[Directions, Directions]:
        rows, columns = (Directions.cells(axis.edges) for axis in (self.grid.rows, self.grid.columns))
        return (Directions(rows.centres, 0.0), Directions(columns.centres, 0.0)) if self.between else (rows, columns)

    @property
    def cells(self) -> tuple[int, int]:
        return self.grid.shape

    @property
    def size(self) -> int:
        return len(self.depths) * self.anchors**2 * self.cells[0] * self.cells[1]

    def accumulate(self, path_samples: PathSamples, labels: IntArray, samples: int = 1) -> sparse.csr_array:
        flat, values, pixel = self.entries(path_samples, samples)
        count = int(labels.max()) + 1
        shape = (count + self.lamps, self.size)
        index = _index_type(*shape)
        row = np.append(labels, count + np.arange(self.lamps))[pixel]
        light = sparse.coo_array((values, (row.astype(index), flat.astype(index))), shape=shape)
        # By way of columns two passes of counting take half the time of sorting; but they go through all places.
        light = light.tocsc().tocsr() if self.size < _COUNTED * len(values) else light.tocsr()
        light.sum_duplicates()
        light.eliminate_zeros()
        return light

    def entries(self, path_samples: PathSamples, samples: int = 1) -> tuple[IntArray, FloatArray, IntArray]:
        inside = self._inside(path_samples)
        if not inside.all():
            path_samples = path_samples.where(inside)
        width = self.anchors * self.cells[1]
        plane = self.anchors * self.cells[0] * width
        layers = [(np.zeros(1, dtype=np.int64), np.ones(1))]
        if len(self.depths) > 1:
            nodes = 1 / np.asarray(self.depths)
            position = np.interp(path_samples.inverse_depth, nodes, np.arange(len(nodes), dtype=np.float64))
            first = np.minimum(position.astype(np.int64), len(nodes) - 2)
            layers = [(first, 1 - (position - first)), (first + 1, position - first)]
        parts = [
            (layer * plane + (first + line) * width + second + place, share * line_share * place_share)
            for first, second in [(path_samples.anchor_row * self.cells[0], path_samples.anchor_column * self.cells[1])]
            for line, line_share in self._cells(self.grid.rows, path_samples.row)
            for place, place_share in self._cells(self.grid.columns, path_samples.column)
            for layer, share in layers
        ]
        values = np.concatenate([path_samples.value * (share / samples) for _, share in parts])
        return np.concatenate([place for place, _ in parts]), values, np.tile(path_samples.pixel, len(parts))

    def outside(self, path_samples: PathSamples) -> float:
        return float(path_samples.value[~self._inside(path_samples)].sum())

    def _inside(self, path_samples: PathSamples) -> npt.NDArray[np.bool_]:
        return self.grid.rows.holds(path_samples.row) & self.grid.columns.holds(path_samples.column)

    def repeat(self, light: sparse.csr_array) -> sparse.csr_array:
        entries = light.tocoo()
        height, width = self.cells
        layer, place = np.divmod(entries.col.astype(np.int64), height * width)
        row, column = np.divmod(place, width)
        places = [
            ((layer * self.anchors + a) * height + row) * self.anchors * width + b * width + column
            for a, b in np.ndindex(self.anchors, self.anchors)
        ]
        copies, index = self.anchors**2, _index_type(light.shape[0], self.size)
        rows, columns = (np.concatenate(each).astype(index) for each in ([entries.row] * copies, places))
        copied = np.tile(entries.data, copies), (rows, columns)
        return sparse.coo_array(copied, shape=(light.shape[0], self.size)).tocsr()

    def average(self, light: sparse.csr_array, weights: FloatArray) -> sparse.csr_array:
        entries = light.tocoo()
        height, width = self.cells
        line, place = np.divmod(entries.col.astype(np.int64), self.anchors * width)
        (layer, line), (b, column) = np.divmod(line, self.anchors * height), np.divmod(place, width)
        a, row = np.divmod(line, height)
        shape = light.shape[0], len(self.depths) * height * width
        places = ((layer * height + row) * width + column).astype(_index_type(*shape))
        return sparse.coo_array((entries.data * weights[a] * weights[b], (entries.row, places)), shape=shape).tocsr()

    def _cells(self, axis: CellAxis, tau: FloatArray) -> list[tuple[IntArray, FloatArray]]:
        if not self.between or axis.count == 1:
            return [(axis.cell(tau), np.ones(1))]
        position = np.clip((tau - axis.start) / axis.size - 0.5, 0, axis.count - 1)
        first = np.minimum(position.astype(np.int64), axis.count - 2)
        beyond = position - first
        return [(first, 1 - beyond), (first + 1, beyond)]


def _index_type(*shape: int) -> type[np.int32] | type[np.int64]:
    return np.int32 if max(shape) < 2**31 else np.int64


# -------- The grid of directions on which light is accumulated

_ROUNDING = 1e-9
"""Part of a pixel by which the field stop may exceed cells: float64 rounds 1e-13 of it, a whole row costs 1 %."""


@dataclass(frozen=True)
class CellAxis:
    start: float
    size: float
    count: int

    @property
    def edges(self) -> FloatArray:
        return np.asarray(self.start + self.size * np.arange(self.count + 1), dtype=np.float64)

    def holds(self, tau: FloatArray) -> npt.NDArray[np.bool_]:
        return np.asarray((tau >= self.start) & (tau < self.start + self.count * self.size))

    def part(self, first: float, last: float) -> CellAxis:
        low = max(int(self.cell(np.array(first))) - 1, 0)
        high = min(int(self.cell(np.array(last))) + 1, self.count - 1)
        return CellAxis(self.start + low * self.size, self.size, high - low + 1)

    def cell(self, tau: FloatArray) -> npt.NDArray[np.int64]:
        return np.clip(np.floor((tau - self.start) / self.size).astype(np.int64), 0, self.count - 1)


@dataclass(frozen=True)
class CellGrid:
    rows: CellAxis
    columns: CellAxis

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows.count, self.columns.count


def aligned_grid(
    row_window: tuple[float, float], column_window: tuple[float, float], n: int, subdivision: int, tan_half_fov: float
) -> CellGrid:
    """Return cells that divide the projector's pixels, and more of them to cover the field stop.

    Light that a plane at the aligned distance reflects then never shares a cell with a neighbouring pixel. Grids of
    different subdivisions nest.
    """

    def axis(window: tuple[float, float]) -> CellAxis:
        size = (window[1] - window[0]) / (n * subdivision)
        before = subdivision * max(0, math.ceil((window[0] + tan_half_fov) / size / subdivision - _ROUNDING))
        after = subdivision * max(0, math.ceil((tan_half_fov - window[1]) / size / subdivision - _ROUNDING))
        return CellAxis(window[0] - before * size, size, n * subdivision + before + after)

    return CellGrid(axis(row_window), axis(column_window))


# -------- Accumulation on the device
#
# Light is added in whole numbers of a small unit, so that sums do not depend on the order in which threads add. Only
# the sums are fetched. Where a Bundle splits light between two layers, the accumulator splits too, or draws one layer:
# the mean is the same.

MOST_PLACES = 2**26
_UNIT_BITS = 30
"""Power of two of units in a bright path's light, whose rounding is 5e-10 at most; a place holds 2^34 such paths."""
_PAYS = 4
"""Places for each part of a path below which an accumulator pays: 0.03 us a place, 0.1 us a part on the host."""
_MOST_BITS = 52
"""Power of two of units that one path may bring, four million times a bright path's."""


@dataclass(frozen=True, eq=False)
class Lit:
    accumulator: DeviceAccumulator
    numbers: npt.NDArray[np.uint32]

    @cached_property
    def inside(self) -> int:
        return int(np.searchsorted(self.numbers, np.uint32(self.accumulator.bundle.size * self.accumulator.rows)))

    @cached_property
    def layout(self) -> sparse.csr_array:
        # All places fit 32 bits, in which matrices take half the time.
        bundle, rows, numbers = self.accumulator.bundle, self.accumulator.rows, self.numbers[: self.inside]
        places = (numbers // np.uint32(rows)).astype(np.int32)
        row = numbers.astype(np.int32) - places * np.int32(rows)
        starts = np.append(0, np.cumsum(np.bincount(places, minlength=bundle.size))).astype(np.int32)
        which = np.arange(len(numbers), dtype=np.int32)
        found = sparse.csc_array((which, row, starts), shape=(rows + bundle.lamps, bundle.size)).tocsr()
        for shared in (found.indices, found.indptr):
            shared.flags.writeable = False
        return found


class DeviceAccumulator:
    """Sums of light by row and place; ``one`` is the irradiance of about a bright path [W m^-2].

    ``sums`` ((places * rows + 1) * lines,) are in units. A place's rows lie side by side, because neighbouring pixels
    have different rows and light one place at a time.
    """

    def __init__(self, bundle: Bundle, labels: Labels, one: float, lines: int = 1) -> None:
        self.bundle, self.rows, self.lines = bundle, int(labels.max()) + 1, lines
        self._width = bundle.size + bundle.anchors**2
        self._unit = 2.0 ** (math.floor(math.log2(one)) - _UNIT_BITS)
        self._labels = device_array(mi.UInt32, labels)
        # The last entry counts refused light: negative, not finite or too bright.
        self._entries = self.rows * self._width + 1
        self.sums = dr.zeros(mi.UInt64, self._entries * lines)
        self.traced = 0

    @staticmethod
    def holds(bundle: Bundle, labels: Labels, lines: int = 1, paths: float = math.inf) -> bool:
        entries = (int(labels.max()) + 1) * (bundle.size + bundle.anchors**2)
        parts = (4 if bundle.between else 1) * min(len(bundle.depths), 2)
        return lines * entries < MOST_PLACES and entries < _PAYS * parts * paths

    def place(self, seen: Sightings, chosen: mi.Float, anchor: Anchor | None = None) -> mi.UInt32:
        layer = mi.UInt32(0)
        for part in self._parts_beyond(seen):
            layer += dr.select(chosen < part, mi.UInt32(1), mi.UInt32(0))
        axes = (self.bundle.grid.rows, seen.row), (self.bundle.grid.columns, seen.column)
        return self._place(seen, layer, [self._cell(axis, tau) for axis, tau in axes], anchor)

    def shares(self, seen: Sightings, anchor: Anchor) -> Iterator[tuple[mi.UInt32, mi.Float]]:
        """Yield the places that light is split between, and its share in each."""
        passed = [dr.clip(part, 0, 1) for part in self._parts_beyond(seen)]
        layers = [(mi.UInt32(k), a - b) for k, (a, b) in enumerate(pairwise([mi.Float(1), *passed, mi.Float(0)]))]
        cells = []
        for axis, tau in ((self.bundle.grid.rows, seen.row), (self.bundle.grid.columns, seen.column)):
            if not self.bundle.between or axis.count == 1:
                cells.append([(self._cell(axis, tau), mi.Float(1))])
                continue
            position = dr.clip(self._position(axis, tau) - 0.5, 0, dr.opaque(mi.Float, axis.count - 1))
            first = dr.minimum(mi.UInt32(position), dr.opaque(mi.UInt32, axis.count - 2))
            beyond = position - mi.Float(first)
            cells.append([(first, 1 - beyond), (first + 1, beyond)])
        for (layer, part), (row, row_part), (column, column_part) in product(layers, *cells):
            yield self._place(seen, layer, [row, column], anchor), part * row_part * column_part

    def _parts_beyond(self, seen: Sightings) -> Iterator[mi.Float]:
        for low, high in pairwise(1 / depth for depth in self.bundle.depths):
            yield (seen.inverse_depth - dr.opaque(mi.Float, low)) / dr.opaque(mi.Float, high - low)

    @staticmethod
    def _position(axis: CellAxis, tau: mi.Float) -> mi.Float:
        return (tau - dr.opaque(mi.Float, axis.start)) * dr.opaque(mi.Float, 1 / axis.size)

    def _cell(self, axis: CellAxis, tau: mi.Float) -> mi.UInt32:
        return mi.UInt32(dr.maximum(dr.floor(self._position(axis, tau)), 0))

    def _place(self, seen: Sightings, layer: mi.UInt32, cells: Sequence[mi.UInt32], anchor: Anchor | None) -> mi.UInt32:
        inside, grid = mi.Bool(True), self.bundle.grid
        for axis, tau in ((grid.rows, seen.row), (grid.columns, seen.column)):
            position = self._position(axis, tau)
            inside &= (position >= 0) & (position < dr.opaque(mi.Float, axis.count))
        rows, columns, anchors = (dr.opaque(mi.UInt32, count) for count in (*grid.shape, self.bundle.anchors))
        line, column = anchor or (mi.UInt32(0), mi.UInt32(0))
        place = ((layer * anchors + line) * rows + cells[0]) * (anchors * columns) + column * columns + cells[1]
        return dr.select(inside, place, dr.opaque(mi.UInt32, self.bundle.size) + line * anchors + column)

    def add(
        self, lights: Sequence[mi.Float], pixel: mi.UInt32, place: mi.UInt32, active: mi.Bool | bool = True
    ) -> None:
        for line, light in enumerate(lights):
            units = light * dr.opaque(mi.Float, 1 / self._unit)
            fits = (units >= 0) & (units < 2.0**_MOST_BITS)
            lit = mi.Bool(active) & ~(light == 0)  # not a number is light to be refused
            row = dr.gather(mi.UInt32, self._labels, pixel, lit)
            entry = dr.select(fits, place * dr.opaque(mi.UInt32, self.rows) + row, self.rows * self._width)
            amount = dr.select(fits, mi.UInt64(dr.round(units)), mi.UInt64(1))
            index = entry * self.lines + line
            dr.scatter_reduce(dr.ReduceOp.Add, self.sums, amount, index, lit, mode=dr.ReduceMode.Direct)

    def fetch(self) -> list[DeviceSums]:
        """Return the sums of each line, and begin anew."""
        rows = self.sums
        if self.lines > 1:
            every = dr.arange(mi.UInt32, self._entries)
            by_line = [dr.gather(mi.UInt64, self.sums, every * self.lines + line) for line in range(self.lines)]
            rows = reduce(or_, (each != 0 for each in by_line))
        lit = dr.compress(rows != 0 if self.lines == 1 else rows)
        # Of no entries there are no multiples.
        units = [
            dr.gather(mi.UInt64, self.sums, lit * self.lines + line) if len(lit) else mi.UInt64()
            for line in range(self.lines)
        ]
        dr.eval(lit, units)
        self.sums = dr.zeros(mi.UInt64, self._entries * self.lines)
        found = Lit(self, np.array(lit))
        compiled_kernels()
        return [DeviceSums(found, np.array(each)) for each in units]


@dataclass(frozen=True, eq=False)
class DeviceSums:
    lit: Lit
    units: npt.NDArray[np.uint64]

    def light(self, samples: int = 1) -> tuple[sparse.csr_array, float, float]:
        """Return light (rows + lamps, places) per sample, all light received, and the light outside [W m^-2].

        Raises MitsimError for light that is NaN, infinite, or four million times a bright path's.
        """
        lit, units, accumulator = self.lit, self.units, self.lit.accumulator
        if len(lit.numbers) and lit.numbers[-1] == accumulator.rows * accumulator._width and units[-1]:
            raise MitsimError(
                "the scene reflects NaN, infinite or boundless light toward the camera; check its materials"
            )
        light, layout = units.astype(np.float64) * (accumulator._unit / samples), lit.layout
        matrix = sparse.csr_array((light[layout.data], layout.indices, layout.indptr), shape=layout.shape)
        return matrix, float(light.sum()), float(light[lit.inside :].sum())

    def beyond(self, samples: int = 1) -> FloatArray:
        """Return the light outside by row and anchor, (rows, anchors, anchors)."""
        lit, accumulator = self.lit, self.lit.accumulator
        rows, anchors = accumulator.rows, accumulator.bundle.anchors
        # The last entry counts refused light: negative, not finite or too bright.
        found = np.zeros(rows * anchors**2 + 1)
        found[lit.numbers[lit.inside :] - np.uint32(rows * accumulator.bundle.size)] = self.units[lit.inside :]
        by_row = np.moveaxis(found[:-1].reshape(anchors, anchors, rows), 2, 0)
        return np.asarray(by_row * (accumulator._unit / samples))
