"""Arrays: means over neighbours against scipy's own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from mitsim.core.arrays import mean_of_neighbours


@pytest.mark.parametrize("shape", [(5, 7), (1, 4), (2, 1), (16, 16)])
def test_the_mean_of_neighbours_is_scipy_s(shape: tuple[int, int]) -> None:
    """To rounding: scipy keeps a running sum, whose error grows along a line."""
    values = np.random.default_rng(3).random(shape)
    np.testing.assert_allclose(mean_of_neighbours(values), uniform_filter(values, 3, mode="nearest"), rtol=1e-13)


def test_what_has_no_neighbour_stays_zero() -> None:
    values = np.zeros((6, 6))
    values[2, 3] = 0.1
    assert np.array_equal(mean_of_neighbours(values) > 0, np.pad(np.ones((3, 3), bool), ((1, 2), (2, 1))))
