"""From paths to light per cell: path samples in, a sparse matrix out, light[row, layer x (anchor, cell) x (anchor,
cell)].

A row is a projector pixel, or a class of pixels that a pattern family always lights together. Ambient light has the
last row, or one of the last for each band of its wavelengths. A path's light is accumulated in the cell that holds its
direction, over which it is then taken as even, and split between the two layers (in 1/z) that enclose its depth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from scipy import sparse

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.optics.shadow import Directions
from mitsim.transport.plugins.base import panchromatic

IntArray = npt.NDArray[np.int64]
AMBIENT, DIRECT, INDIRECT = 0, 1, 2
"""Kinds of light: of lamps, of the projector over one surface that is no mirror, and over several."""
_COUNTED = 4
"""Places for each entry of light up to which entries are counted by place; where places are more, sorting is faster."""


# -------- Light of connections in the renderer


@dataclass
class Sightings:
    """Light of connections, a lane each, and where the camera sees it; meaning and units as in :class:`PathSamples`.
    ``lines`` is ``value`` by line, where it is told apart."""

    value: mi.Float
    pixel: mi.UInt32
    row: mi.Float
    column: mi.Float
    inverse_depth: mi.Float
    lines: mi.UnpolarizedSpectrum | None = None

    @classmethod
    def of(cls, light: mi.UnpolarizedSpectrum, by_line: bool, pixel: mi.UInt32, *place: mi.Float) -> Sightings:
        """Of light at the wavelengths of its paths.

        Parameters
        ----------
        light
            [W m^-2], by the weights of :func:`mitsim.transport.connect.sample_wavelengths`.
        by_line
            whether it is told apart by line.
        pixel
            of the projector.
        *place
            row, column and inverse depth.
        """
        row, column, inverse_depth = place
        lines = light / len(light) if by_line else None
        return cls(panchromatic(light), pixel, row, column, inverse_depth, lines)

    @classmethod
    def none(cls, by_line: bool = False) -> Sightings:
        """No light yet, which may be told apart ``by_line``."""
        return cls.of(mi.UnpolarizedSpectrum(0), by_line, mi.UInt32(0), mi.Float(0), mi.Float(0), mi.Float(0))

    def joined_by(self, more: Sightings, number: mi.Float) -> Sightings:
        """Of these and ``more`` one, drawn by a random ``number`` in proportion to its light, which carries the light
        of both.

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
        """The value, or of several ``lines`` that of each."""
        return [self.value] if self.lines is None or lines == 1 else [self.lines[line] for line in range(lines)]


def check_finite(light: npt.NDArray[Any]) -> None:
    """Refuse ``light`` toward the camera that is NaN or infinite: MitsimError."""
    if not np.isfinite(light).all():
        raise MitsimError("the scene reflects NaN or infinite light toward the camera; check its materials")


# -------- Path samples, fetched from the renderer


@dataclass(frozen=True, eq=False)
class PathSamples:
    """Light that paths brought to the camera, one entry a connection.

    Attributes
    ----------
    pixel
        (m,) projector pixel 0..n^2-1 (row-major), or n^2 for ambient light, or n^2 and the number of its band.
    anchor_row, anchor_column
        (m,) anchor that the path started from.
    row, column
        (m,) tan-angle seen from the sensor's centre, index coordinates.
    inverse_depth
        (m,) 1/z [1/mm] of the point that the light is seen at.
    value
        (m,) irradiance [W m^-2].
    kind
        (m,) :data:`DIRECT` or :data:`INDIRECT` light of the projector, or :data:`AMBIENT` light.
    lines
        (4, m) ``value`` by line, then zeros, in single precision as it was traced; None where it is not told apart.
    lane
        (m,) number of the connection among those of its launch, increasing; None but as it was fetched.
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
        """All ``parts`` in one; no light where there are none."""
        parts = parts or [cls.none()]
        if len(parts) == 1:
            return parts[0]
        by_line = [part.lines for part in parts if part.lines is not None]
        lines = np.concatenate(by_line, axis=1) if by_line and len(by_line) == len(parts) else None
        arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
        return cls(**arrays, lines=lines)

    def by_line(self, lines: int) -> list[PathSamples]:
        """These, or the same of each of several ``lines`` with its light."""
        if lines == 1 or not len(self.value):
            return [self] * lines
        assert self.lines is not None, "traced by line"
        return [replace(self, value=self.lines[line].astype(np.float64), lines=None) for line in range(lines)]

    @classmethod
    def fetch(cls, seen: Sightings, kind: int, anchors: tuple[mi.UInt32, mi.UInt32] | None = None) -> PathSamples:
        """Lit connections of one kind from the renderer's arrays.

        Parameters
        ----------
        seen
            the connections, a lane each.
        kind
            :data:`DIRECT`, :data:`INDIRECT` or :data:`AMBIENT`.
        anchors
            rows and columns of their anchors; the first anchor without them.

        Raises
        ------
        MitsimError
            when the light is NaN or infinite.
        """
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
        """No light at all."""
        index, number = np.zeros(0, dtype=np.int64), np.zeros(0)
        return cls(index, index, index, number, number, number, number, np.zeros(0, dtype=np.int16))

    def average(self, weights: FloatArray) -> PathSamples:
        """Light of one anchor: the mean over all of them, with ``weights`` (anchors,) along rows and columns."""
        first = np.zeros_like(self.pixel)
        value = self.value * weights[self.anchor_row] * weights[self.anchor_column]
        return replace(self, anchor_row=first, anchor_column=first, value=value)

    def by_lane(self, ranges: IntArray) -> list[PathSamples]:
        """Those of some ``ranges`` (parts, 2): the lane with which each begins, and before which it ends."""
        assert self.lane is not None, "as it was fetched"
        return [self.where(slice(*part)) for part in np.searchsorted(self.lane, ranges).tolist()]

    def where(self, chosen: npt.NDArray[np.bool_] | slice) -> PathSamples:
        """The entries that are ``chosen`` (m,); consecutive ones are not copied."""
        lines = None if self.lines is None else self.lines[:, chosen]
        return PathSamples(**{name: getattr(self, name)[chosen] for name in _ARRAYS}, lines=lines)


_ARRAYS = tuple(name for name in PathSamples.__dataclass_fields__ if name not in ("lines", "lane"))
"""What is told of each entry."""


# -------- Accumulation by layer, anchor and cell


@dataclass(frozen=True)
class Bundle:
    """How light is accumulated.

    Attributes
    ----------
    grid
        cells.
    anchors
        a side.
    depths
        of the layers [mm], far to near.
    between
        whether light is split between the two nearest cell centres along each axis, and taken to come from there. Light
        that an anchor sees over a sharp lobe comes from a small part of a cell, and where that lies counts.
    lamps
        rows of ambient light: one, or one for each band of its wavelengths.
    """

    grid: CellGrid
    anchors: int
    depths: tuple[float, ...]
    between: bool = False
    lamps: int = 1

    @property
    def rows(self) -> Directions:
        """Directions of the cells' rows, for the mask's shadow."""
        return self._directions(self.grid.rows)

    @property
    def columns(self) -> Directions:
        """Directions of the cells' columns."""
        return self._directions(self.grid.columns)

    def _directions(self, axis: CellAxis) -> Directions:
        cells = Directions.cells(axis.edges)
        return Directions(cells.centres, 0.0) if self.between else cells

    @property
    def cells(self) -> tuple[int, int]:
        """Rows and columns of cells."""
        return self.grid.shape

    @property
    def size(self) -> int:
        """Places for light in all."""
        return len(self.depths) * self.anchors**2 * self.cells[0] * self.cells[1]

    def accumulate(self, path_samples: PathSamples, labels: IntArray, samples: int = 1) -> sparse.csr_array:
        """(C + lamps, size) light of C classes of pixels and of lamps, per sample, but for what is :meth:`outside`.

        Parameters
        ----------
        path_samples
            light of ``samples`` samples.
        labels
            (n^2,) class 0..C-1 of each projector pixel.
        samples
            that the light is divided by.
        """
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
        """(e,) place, light and projector pixel of all that is accumulated, in no order and not summed.

        Parameters
        ----------
        path_samples, samples
            as for :meth:`accumulate`.
        """
        inside = self._inside(path_samples)
        if not inside.all():
            path_samples = path_samples.where(inside)
        width = self.anchors * self.cells[1]
        plane = self.anchors * self.cells[0] * width
        parts = [
            (layer * plane + (first + line) * width + second + place, share * line_share * place_share)
            for first, second in [(path_samples.anchor_row * self.cells[0], path_samples.anchor_column * self.cells[1])]
            for line, line_share in self._cells(self.grid.rows, path_samples.row)
            for place, place_share in self._cells(self.grid.columns, path_samples.column)
            for layer, share in self._layers(path_samples.inverse_depth)
        ]
        values = np.concatenate([path_samples.value * (share / samples) for _, share in parts])
        return np.concatenate([place for place, _ in parts]), values, np.tile(path_samples.pixel, len(parts))

    def outside(self, path_samples: PathSamples) -> float:
        """Light of ``path_samples`` from beyond all cells, which is not accumulated [W m^-2]."""
        return float(path_samples.value[~self._inside(path_samples)].sum())

    def _inside(self, path_samples: PathSamples) -> npt.NDArray[np.bool_]:
        return self.grid.rows.holds(path_samples.row) & self.grid.columns.holds(path_samples.column)

    def repeat(self, light: sparse.csr_array) -> sparse.csr_array:
        """``light`` that was accumulated with one anchor, (rows, size / anchors^2), as if every anchor saw it."""
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
        """``light`` (rows, size) as one anchor's, (rows, size / anchors^2): the mean with ``weights`` (anchors,) along
        rows and columns."""
        entries = light.tocoo()
        height, width = self.cells
        line, place = np.divmod(entries.col.astype(np.int64), self.anchors * width)
        (layer, line), (b, column) = np.divmod(line, self.anchors * height), np.divmod(place, width)
        a, row = np.divmod(line, height)
        shape = light.shape[0], len(self.depths) * height * width
        places = ((layer * height + row) * width + column).astype(_index_type(*shape))
        return sparse.coo_array((entries.data * weights[a] * weights[b], (entries.row, places)), shape=shape).tocsr()

    def _cells(self, axis: CellAxis, tau: FloatArray) -> list[tuple[IntArray, FloatArray]]:
        """Cells along an axis that share the light, each with its part."""
        if not self.between or axis.count == 1:
            return [(axis.cell(tau), np.ones(1))]
        position = np.clip((tau - axis.start) / axis.size - 0.5, 0, axis.count - 1)
        first = np.minimum(position.astype(np.int64), axis.count - 2)
        beyond = position - first
        return [(first, 1 - beyond), (first + 1, beyond)]

    def _layers(self, inverse_depth: FloatArray) -> list[tuple[IntArray, FloatArray]]:
        """Pairs of layers that share the light, each with its part; beyond the first or the last all goes to it."""
        if len(self.depths) == 1:
            return [(np.zeros(1, dtype=np.int64), np.ones(1))]
        nodes = 1 / np.asarray(self.depths)
        position = np.interp(inverse_depth, nodes, np.arange(len(nodes), dtype=np.float64))
        layer = np.minimum(position.astype(np.int64), len(nodes) - 2)
        nearer = position - layer
        return [(layer, 1 - nearer), (layer + 1, nearer)]


def _index_type(*shape: int) -> type[np.int32] | type[np.int64]:
    """Of a sparse matrix of such a ``shape``: 32-bit indices sort twice as fast, and take half the memory."""
    return np.int32 if max(shape) < 2**31 else np.int64


# -------- The grid of directions on which light is accumulated

_ROUNDING = 1e-9
"""Part of a pixel by which the field stop may reach over cells: float64 rounds 1e-13 of it, a whole row costs 1 %."""


@dataclass(frozen=True)
class CellAxis:
    """Equal cells along one axis: ``count`` cells of tan-angle ``size`` from ``start`` on (index coordinates)."""

    start: float
    size: float
    count: int

    @property
    def edges(self) -> FloatArray:
        """(count + 1,) tan-angles of the cell edges."""
        return np.asarray(self.start + self.size * np.arange(self.count + 1), dtype=np.float64)

    def holds(self, tau: FloatArray) -> npt.NDArray[np.bool_]:
        """Which of the tan-angles ``tau`` lie in one of the cells."""
        return np.asarray((tau >= self.start) & (tau < self.start + self.count * self.size))

    def part(self, first: float, last: float) -> CellAxis:
        """The cells from tan-angle ``first`` to ``last``, and one more on each side where there is one."""
        low = max(int(self.cell(np.array(first))) - 1, 0)
        high = min(int(self.cell(np.array(last))) + 1, self.count - 1)
        return CellAxis(self.start + low * self.size, self.size, high - low + 1)

    def cell(self, tau: FloatArray) -> npt.NDArray[np.int64]:
        """The cell of each tan-angle ``tau``; outside of all, the nearest."""
        return np.clip(np.floor((tau - self.start) / self.size).astype(np.int64), 0, self.count - 1)


@dataclass(frozen=True)
class CellGrid:
    """Rows and columns of cells."""

    rows: CellAxis
    columns: CellAxis

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.rows.count, self.columns.count


def aligned_grid(
    row_window: tuple[float, float], column_window: tuple[float, float], n: int, subdivision: int, tan_half_fov: float
) -> CellGrid:
    """Cells that divide the projector's pixels, and more of them to cover the field stop.

    Light that a plane at the aligned distance reflects then never shares a cell with a neighbouring projector pixel.
    The margin on each side is a multiple of ``subdivision`` cells, so that grids of different subdivisions nest.

    Parameters
    ----------
    row_window, column_window
        first and last tan-angle of the projector's window.
    n
        projector pixels a side.
    subdivision
        cells a side of a pixel.
    tan_half_fov
        largest tan-angle that light comes from.
    """

    def axis(window: tuple[float, float]) -> CellAxis:
        size = (window[1] - window[0]) / (n * subdivision)
        before = subdivision * max(0, math.ceil((window[0] + tan_half_fov) / size / subdivision - _ROUNDING))
        after = subdivision * max(0, math.ceil((tan_half_fov - window[1]) / size / subdivision - _ROUNDING))
        return CellAxis(window[0] - before * size, size, n * subdivision + before + after)

    return CellGrid(axis(row_window), axis(column_window))
