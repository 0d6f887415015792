"""Points of the sensor from which radiance is evaluated, and the weights that interpolate between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError


def anchor_positions(count: int, half_width: float) -> FloatArray:
    """(``count``,) coordinates of anchors on a sensor of ``half_width``, in its unit.

    Chebyshev nodes, the near-best points for interpolation. MitsimError for less than one.
    """
    if count < 1:
        raise MitsimError(f"number of anchors a side is {count}; give at least 1")
    k = np.arange(count)
    return -half_width * np.cos(np.pi * (2 * k + 1) / (2 * count))


def anchor_weights(anchors: Sequence[float] | FloatArray, at: FloatArray) -> FloatArray:
    """(len(at), len(anchors)) Lagrange weights that interpolate values known at ``anchors`` to the points ``at``."""
    nodes = np.asarray(anchors, dtype=np.float64)
    weights = np.ones((len(at), len(nodes)))
    for j, node in enumerate(nodes):
        for zero in np.delete(nodes, j):
            weights[:, j] *= (at - zero) / (node - zero)
    return weights
