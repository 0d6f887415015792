"""Laser speckle on the sensor: from irradiance to one realisation of what coherent light makes of it.

Integrated speckle after Goodman (Speckle Phenomena in Optics, section 4.6): light that averages over M independent
modes (polarisations, laser lines, grains within a pixel, moments of a scanned beam) follows a gamma distribution of
mean 1 and standard deviation C = M^(-1/2), the speckle contrast. Sensor pixels are independent: a grain lambda z / D of
an illuminated patch D = 120 mm is 2 um at 400 mm, below a pixel. Contrast 0 passes light through unchanged.
"""

from __future__ import annotations

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError


def speckled(irradiance: FloatArray, contrast: float, rng: np.random.Generator) -> FloatArray:
    """Irradiance times a gamma field of mean 1.

    Parameters
    ----------
    irradiance
        any shape and unit, which the result has.
    contrast
        the field's standard deviation, 0 to 1.
    rng
        where the field is drawn from.

    Raises
    ------
    MitsimError
        for a contrast outside 0..1: single fully developed speckle has 1.
    """
    if not 0 <= contrast <= 1:
        raise MitsimError(f"speckle contrast is {contrast}; give a number from 0 (none) to 1 (fully developed)")
    if contrast == 0:
        return irradiance
    return np.asarray(irradiance * rng.gamma(contrast**-2, contrast**2, size=irradiance.shape))
