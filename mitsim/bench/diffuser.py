"""A sensor's shape and pitch in; the point spread function of a rendered diffuser before it, of sum 1, out."""

from __future__ import annotations

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import DEFAULT_VARIANT, load_variant


def rendered_psf(
    shape: tuple[int, int], pitch_mm: float, variant: str = DEFAULT_VARIANT, rays: int = 4096, seed: int = 0
) -> FloatArray:
    """Light of a distant point behind the default diffuser of :mod:`mitsim.transport.plugins.diffuser`.

    Parameters
    ----------
    shape, pitch_mm
        rows and columns of the sensor, and its pixels' distance.
    variant
        of Mitsuba; it is selected for the process.
    rays, seed
        as for :func:`mitsim.transport.plugins.diffuser.point_spread`.
    """
    load_variant(variant)
    from mitsim.transport.plugins.diffuser import Diffuser, point_spread

    light = point_spread(Diffuser(), shape, pitch_mm, rays=rays, seed=seed)
    return np.asarray(light / light.sum())
