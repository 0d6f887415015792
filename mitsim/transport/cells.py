"""The grid of directions on which the factored estimator collects light: tan-angle cells seen from the camera."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


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

    def centre(self, index: npt.NDArray[np.int64]) -> FloatArray:
        """Tan-angle of the centre of each cell."""
        return np.asarray(self.start + self.size * (index + 0.5), dtype=np.float64)


@dataclass(frozen=True)
class CellGrid:
    """Rows and columns of cells; each projector pixel on the aligned plane holds ``subdivision`` cells a side."""

    rows: CellAxis
    columns: CellAxis
    subdivision: int

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
    multiple: int = 1,
) -> CellGrid:
    """Cells whose edges fall on the edges of the n x n projector pixels, grown to cover the field stop.

    Light that a plane at the rig's distance reflects then never shares a cell with a neighbouring projector pixel.
    The margin on each side is a multiple of ``multiple`` cells, so that grids of different subdivisions nest.
    """

    def axis(window: tuple[float, float]) -> CellAxis:
        size = (window[1] - window[0]) / (n * subdivision)
        before = multiple * max(0, math.ceil((window[0] + tan_half_fov) / size / multiple - 1e-9))
        after = multiple * max(0, math.ceil((tan_half_fov - window[1]) / size / multiple - 1e-9))
        return CellAxis(window[0] - before * size, size, n * subdivision + before + after)

    return CellGrid(axis(row_window), axis(column_window), subdivision)
