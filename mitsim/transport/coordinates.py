"""Coordinates: from Mitsuba's camera frame to rows and columns of images and back, and from transforms to matrices.

Index coordinates grow as rows and columns of images do: row = -y, column = -x, as lengths or as tan-angles.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from mitsim.core.arrays import FloatArray

if TYPE_CHECKING:
    import mitsuba as mi

Numbers: TypeAlias = "mi.Float | FloatArray"
"""What the formulas of this room take: the renderer's numbers, a lane each, or NumPy's."""
RIGID = 1e-4
"""Largest :func:`rigidity_error` of a rigid transform: matrices of five digits pass, a scale of 1.0001 does not."""


def rows_columns(x: Numbers, y: Numbers) -> tuple[Numbers, Numbers]:
    """Index coordinates (row, column) of a point ``x``, ``y`` of the camera's frame, in their unit."""
    return -y, -x


def x_y(row: Numbers, column: Numbers) -> tuple[Numbers, Numbers]:
    """Camera coordinates (x, y) of index coordinates ``row``, ``column``, in their unit."""
    return -column, -row


def turn_and_origin(transform: mi.AffineTransform4f) -> tuple[FloatArray, FloatArray]:
    """(3, 3) linear part and (3,) origin [mm] of a ``transform``, in double precision."""
    matrix = np.array(transform.matrix, dtype=np.float64).reshape(4, 4, -1)[..., 0]
    return matrix[:3, :3], matrix[:3, 3]


def rigidity_error(turn: FloatArray) -> float:
    """Largest entry of R^T R - 1 for the linear part ``turn`` (3, 3) of a transform: 0 where it only turns."""
    return float(np.abs(turn.T @ turn - np.eye(3)).max())
