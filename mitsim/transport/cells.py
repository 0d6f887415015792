"""The grid of directions on which the factored estimator collects light: tan-angle cells seen from the camera."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray

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
    row_window: tuple[float, float],
    column_window: tuple[float, float],
    n: int,
    subdivision: int,
    tan_half_fov: float,
) -> CellGrid:
    """Cells that divide the projector's pixels, and more of them to cover the field stop.

    Light that a plane at the rig's distance reflects then never shares a cell with a neighbouring projector pixel.
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
