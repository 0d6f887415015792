"""From paths to light per cell: deposits in, a sparse matrix out, light[row, layer x (anchor, cell) x (anchor, cell)].

A row is a projector pixel, or a class of pixels that a pattern family always lights together. Ambient light has the
last row. A path's light is filed in the cell that holds its direction, over which it is then taken as even, and split
between the two layers (in 1/z) that enclose its depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt
from scipy import sparse

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.optics.shadow import Directions
from mitsim.transport.cells import CellGrid

IntArray = npt.NDArray[np.int64]
AMBIENT, DIRECT, INDIRECT = 0, 1, 2
"""Kinds of light, the ``order`` of a deposit."""


@dataclass(frozen=True, eq=False)
class Deposits:
    """Light that paths brought to the camera, one entry a connection.

    Attributes
    ----------
    source
        (m,) projector pixel 0..n^2-1 (row-major), or n^2 for ambient light.
    anchor_row, anchor_column
        (m,) anchor that the path started from.
    row, column
        (m,) tan-angle seen from the sensor's centre, index coordinates.
    inverse_depth
        (m,) 1/z [1/mm] of the point that the light is seen at.
    value
        (m,) irradiance [W m^-2].
    order
        (m,) 1 for direct light of the projector, 2 for its indirect light, 0 for ambient light.
    """

    source: IntArray
    anchor_row: IntArray
    anchor_column: IntArray
    row: FloatArray
    column: FloatArray
    inverse_depth: FloatArray
    value: FloatArray
    order: npt.NDArray[np.int16]

    @classmethod
    def joined(cls, parts: Sequence[Deposits]) -> Deposits:
        """All parts in one; no light where there are none."""
        parts = parts or [cls.none()]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))

    @classmethod
    def fetched(
        cls,
        value: Any,
        source: Any,
        row: Any,
        column: Any,
        inverse_depth: Any,
        order: int,
        anchor_row: Any = None,
        anchor_column: Any = None,
    ) -> Deposits:
        """Lit connections of one kind from the renderer's arrays; those of the first anchor when none is named.

        Raises
        ------
        MitsimError
            when the light is NaN or infinite.
        """
        # Together: one by one, each would trace all paths again.
        dr.eval(value, source, row, column, inverse_depth, anchor_row, anchor_column)
        light = np.array(value)
        if not np.isfinite(light).all():
            raise MitsimError("the scene reflects NaN or infinite light toward the camera; check its materials")
        lit = np.flatnonzero(light)

        def taken(values: Any, kind: type) -> Any:
            return np.zeros(lit.size, kind) if values is None else np.array(values)[lit].astype(kind)

        return cls(
            source=taken(source, np.int64),
            anchor_row=taken(anchor_row, np.int64),
            anchor_column=taken(anchor_column, np.int64),
            row=taken(row, np.float64),
            column=taken(column, np.float64),
            inverse_depth=taken(inverse_depth, np.float64),
            value=light[lit].astype(np.float64),
            order=np.full(lit.size, order, dtype=np.int16),
        )

    @classmethod
    def none(cls) -> Deposits:
        """No light at all."""
        index, number = np.zeros(0, dtype=np.int64), np.zeros(0)
        return cls(index, index, index, number, number, number, number, np.zeros(0, dtype=np.int16))

    def averaged(self, weights: FloatArray) -> Deposits:
        """Light of one anchor: the mean over all of them, with ``weights`` (anchors,) along rows and columns."""
        none = np.zeros_like(self.source)
        value = self.value * weights[self.anchor_row] * weights[self.anchor_column]
        return replace(self, anchor_row=none, anchor_column=none, value=value)

    def where(self, chosen: npt.NDArray[np.bool_]) -> Deposits:
        """The chosen entries."""
        return Deposits(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Bundle:
    """How light is filed: cells, anchors a side, layers as depths [mm] (far to near)."""

    grid: CellGrid
    anchors: int
    depths: tuple[float, ...]

    @property
    def rows(self) -> Directions:
        """Directions of the cells' rows, for the mask's shadow."""
        return Directions.cells(self.grid.rows.edges)

    @property
    def columns(self) -> Directions:
        """Directions of the cells' columns."""
        return Directions.cells(self.grid.columns.edges)

    @property
    def cells(self) -> tuple[int, int]:
        """Rows and columns of cells."""
        return self.grid.shape

    @property
    def size(self) -> int:
        """Places for light in all."""
        return len(self.depths) * self.anchors**2 * self.cells[0] * self.cells[1]

    def file(self, found: Deposits, labels: IntArray, samples: int = 1) -> sparse.csr_array:
        """(C + 1, size) light a row, divided by ``samples``; ``labels`` (n^2,) gives the row 0..C-1 of each pixel."""
        inside = self.grid.rows.holds(found.row) & self.grid.columns.holds(found.column)
        if not inside.all():
            found = found.where(inside)
        width = self.anchors * self.cells[1]
        plane = self.anchors * self.cells[0] * width
        count = int(labels.max()) + 1
        row = np.append(labels, count)[found.source]
        line = found.anchor_row * self.cells[0] + self.grid.rows.cell(found.row)
        place = line * width + found.anchor_column * self.cells[1] + self.grid.columns.cell(found.column)
        layers = self._layers(found.inverse_depth)
        values = np.concatenate([found.value * (share / samples) for _, share in layers])
        flat = np.concatenate([layer * plane + place for layer, _ in layers])
        shape = (count + 1, self.size)
        # 32-bit indices sort twice as fast.
        index = np.int32 if max(shape) < 2**31 else np.int64
        entries = values, (np.tile(row, len(layers)).astype(index), flat.astype(index))
        # By way of columns, for two passes of counting take half the time of sorting.
        light = sparse.coo_array(entries, shape=shape).tocsc().tocsr()
        light.eliminate_zeros()
        return light

    def repeated(self, light: sparse.csr_array) -> sparse.csr_array:
        """Light that was filed with one anchor, (rows, size / anchors^2), as if every anchor saw it."""
        found = light.tocoo()
        height, width = self.cells
        layer, place = np.divmod(found.col.astype(np.int64), height * width)
        row, column = np.divmod(place, width)
        places = [
            ((layer * self.anchors + a) * height + row) * self.anchors * width + b * width + column
            for a, b in np.ndindex(self.anchors, self.anchors)
        ]
        copies = self.anchors**2
        entries = np.tile(found.data, copies), (np.tile(found.row, copies), np.concatenate(places))
        return sparse.coo_array(entries, shape=(light.shape[0], self.size)).tocsr()

    def _layers(self, inverse_depth: FloatArray) -> list[tuple[IntArray, FloatArray]]:
        """Pairs of layers that share the light, each with its part; beyond the first or the last all goes to it."""
        if len(self.depths) == 1:
            return [(np.zeros(1, dtype=np.int64), np.ones(1))]
        nodes = 1 / np.asarray(self.depths)
        position = np.interp(inverse_depth, nodes, np.arange(len(nodes), dtype=np.float64))
        layer = np.minimum(position.astype(np.int64), len(nodes) - 2)
        nearer = position - layer
        return [(layer, 1 - nearer), (layer + 1, nearer)]
