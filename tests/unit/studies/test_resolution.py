"""Contrast of bars at their own frequency."""

import numpy as np
import pytest

from mitsim.studies.camera_studies import modulation


@pytest.mark.parametrize("frequency", [0.1, 0.2437, 0.4])
def test_modulation_is_that_of_the_bars_and_not_of_noise(frequency: float) -> None:
    """A sine of amplitude 0.2 about 0.5 is the fundamental of bars of contrast 0.1 pi; noise as strong makes no more
    than a tenth of it. (Planted: the frequency doubled; the mean left out.)"""
    wave = 0.5 + 0.2 * np.sin(2 * np.pi * frequency * np.arange(60) + 0.7)
    assert modulation(np.tile(wave, (40, 1)), 0, frequency) == pytest.approx(0.1 * np.pi, rel=1e-9)
    noise = 0.5 + 0.14 * np.random.default_rng(1).standard_normal((40, 60))
    assert modulation(noise, 0, frequency) < 0.03
