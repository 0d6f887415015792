"""Linear maps from a histogram of light to a sensor frame, as sums of separable terms, with their adjoints.

A term takes T (r, c), light per row cell and column cell, to ``left @ T @ right.T`` (m, m').
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitsim.core.errors import MitsimError
from mitsim.optics.mask import Mask
from mitsim.optics.shadow import shadow_factor

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Separable:
    """T -> left @ T @ right.T, with left (m_rows, r) and right (m_cols, c)."""

    left: FloatArray
    right: FloatArray

    def __post_init__(self) -> None:
        if self.left.ndim != 2 or self.right.ndim != 2:
            raise MitsimError(
                f"separable factors have shapes {self.left.shape} and {self.right.shape}; give two 2-D arrays"
            )

    @property
    def input_shape(self) -> tuple[int, int]:
        """Shape (r, c) of the light it takes."""
        return self.left.shape[1], self.right.shape[1]

    @property
    def output_shape(self) -> tuple[int, int]:
        """Shape (m_rows, m_cols) of the frame it gives."""
        return self.left.shape[0], self.right.shape[0]

    def forward(self, light: npt.ArrayLike) -> FloatArray:
        """Frame (m_rows, m_cols) of light (r, c); MitsimError on another shape."""
        return np.asarray(self.left @ _checked("light", light, self.input_shape) @ self.right.T)

    def adjoint(self, frame: npt.ArrayLike) -> FloatArray:
        """Transpose map: frame (m_rows, m_cols) to (r, c); MitsimError on another shape."""
        return np.asarray(self.left.T @ _checked("frame", frame, self.output_shape) @ self.right)


@dataclass(frozen=True, eq=False)
class SeparableSum:
    """Sum of separable terms of equal shapes; weights are inside the terms."""

    terms: tuple[Separable, ...]

    def __post_init__(self) -> None:
        shapes = {(term.input_shape, term.output_shape) for term in self.terms}
        if len(shapes) != 1:
            raise MitsimError(f"separable terms of {len(shapes)} shapes cannot be added; give terms of one shape")

    @property
    def input_shape(self) -> tuple[int, int]:
        """Shape (r, c) of the light it takes."""
        return self.terms[0].input_shape

    @property
    def output_shape(self) -> tuple[int, int]:
        """Shape (m_rows, m_cols) of the frame it gives."""
        return self.terms[0].output_shape

    def forward(self, light: npt.ArrayLike) -> FloatArray:
        """Frame (m_rows, m_cols) of light (r, c)."""
        return np.sum([term.forward(light) for term in self.terms], axis=0)  # type: ignore[no-any-return]

    def adjoint(self, frame: npt.ArrayLike) -> FloatArray:
        """Transpose map: frame (m_rows, m_cols) to (r, c)."""
        return np.sum([term.adjoint(frame) for term in self.terms], axis=0)  # type: ignore[no-any-return]


def shadow_operator(
    mask: Mask,
    row_pixel_edges_mm: npt.ArrayLike,
    column_pixel_edges_mm: npt.ArrayLike,
    row_cell_edges_tan: npt.ArrayLike,
    column_cell_edges_tan: npt.ArrayLike,
    mask_distance_mm: float,
    depth_mm: float,
) -> SeparableSum:
    """Mask shadow of a layer at one depth: light per tan-angle cell to mean transmitted light per sensor
    pixel.

    Edges as in :func:`mitsim.optics.shadow.shadow_factor`; one term for each of the mask's own.
    """

    def factor(profile: FloatArray, pixels: npt.ArrayLike, cells: npt.ArrayLike) -> FloatArray:
        return shadow_factor(profile, mask.feature_mm, pixels, cells, mask_distance_mm, depth_mm)

    return SeparableSum(
        tuple(
            Separable(
                weight * factor(rows, row_pixel_edges_mm, row_cell_edges_tan),
                factor(columns, column_pixel_edges_mm, column_cell_edges_tan),
            )
            for weight, rows, columns in mask.terms
        )
    )


def _checked(name: str, array: npt.ArrayLike, shape: tuple[int, int]) -> FloatArray:
    values = np.asarray(array, dtype=np.float64)
    if values.shape != shape:
        raise MitsimError(f"{name} has shape {values.shape}; this operator takes {shape}")
    return values
