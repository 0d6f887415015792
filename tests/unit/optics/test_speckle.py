"""Speckle: mean 1, the contrast asked for, the gamma law, and nothing at contrast 0."""

import numpy as np
import pytest
from scipy import stats

from mitsim.core.seeds import stream
from mitsim.optics.frames import add_speckle

LIGHT = np.full((400, 500), 3.0)
ALPHA = 1e-4  # of each test below; 200 000 pixels


def test_without_contrast_light_passes_unchanged() -> None:
    assert add_speckle(LIGHT, 0.0, stream(0, "speckle")) is LIGHT


@pytest.mark.parametrize("contrast", [0.02, 0.3, 1.0])
def test_speckle_follows_the_gamma_law_of_its_contrast(contrast: float) -> None:
    found = add_speckle(LIGHT, contrast, stream(1, "speckle")).ravel() / 3.0
    limit = stats.norm.isf(ALPHA / 2)
    assert abs(found.mean() - 1) < limit * contrast / found.size**0.5
    assert stats.kstest(found, stats.gamma(contrast**-2, scale=contrast**2).cdf).pvalue > ALPHA
    # Pixels are independent: neighbours are uncorrelated.
    field = found.reshape(LIGHT.shape) - 1
    correlation = (field[:, 1:] * field[:, :-1]).mean() / contrast**2
    assert abs(correlation) < limit / found.size**0.5


def test_dark_pixels_stay_dark() -> None:
    assert not add_speckle(np.zeros((4, 4)), 0.5, stream(2, "speckle")).any()
