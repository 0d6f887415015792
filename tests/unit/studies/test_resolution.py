"""Contrast of bars, and ISO 12233's slanted edge on edges whose transfer is known in closed form."""

import numpy as np
import pytest
from scipy.special import erf

from mitsim.core.errors import MitsimError
from mitsim.studies.camera_studies import contrast, modulation, slanted_edge

ROWS = COLUMNS = 96


def edge(degrees: float, sigma: float, noise: float = 0.0, shift: float = 0.3) -> np.ndarray:
    """An edge of a Gaussian point spread [pixels], averaged over pixels by 16 x 16 points."""
    fine = 16
    y, x = ((np.arange(fine * size) + 0.5) / fine for size in (ROWS, COLUMNS))
    angle = np.radians(degrees)
    distance = (x[None, :] - COLUMNS / 2 - shift) * np.cos(angle) - (y[:, None] - ROWS / 2) * np.sin(angle)
    values = 0.1 + 0.4 * (1 + erf(distance / (np.sqrt(2) * max(sigma, 1e-6))))
    image = values.reshape(ROWS, fine, COLUMNS, fine).mean(axis=(1, 3))
    return image + noise * np.random.default_rng(0).standard_normal(image.shape)


@pytest.mark.parametrize("degrees", [3.0, 5.0, -7.0])
@pytest.mark.parametrize("sigma", [0.0, 0.7, 1.5])
def test_an_edge_has_the_transfer_of_its_blur_and_of_the_pixels(degrees: float, sigma: float) -> None:
    """exp(-2 (pi f sigma)^2) of a Gaussian, times a pixel's along the normal. (Planted: the bins' own transfer left in;
    one bin a pixel.)"""
    frequency, transfer = slanted_edge(edge(degrees, sigma))
    angle = np.radians(degrees)
    pixel = np.sinc(frequency * np.cos(angle)) * np.sinc(frequency * np.sin(angle))
    expected = np.exp(-2 * np.square(np.pi * frequency * sigma)) * pixel
    assert frequency[-1] > 0.45
    np.testing.assert_allclose(transfer, expected, atol=0.02)


def test_noise_moves_the_edge_little() -> None:
    frequency, transfer = slanted_edge(edge(5.0, 0.7, 0.02))
    _, clean = slanted_edge(edge(5.0, 0.7))
    assert np.abs(transfer - clean)[frequency < 0.4].max() < 0.08


def test_an_image_without_an_edge_is_refused() -> None:
    with pytest.raises(MitsimError, match="no step"):
        slanted_edge(np.full((32, 32), 0.5))


def test_contrast_of_bars_is_the_papers() -> None:
    """Bars of 0.2 and 0.6 are of contrast 0.5, whichever way they lie."""
    bars = np.where(np.arange(64) // 4 % 2, 0.6, 0.2) * np.ones((64, 1))
    assert contrast(bars, 0) == pytest.approx(0.5) and contrast(bars.T, 1) == pytest.approx(0.5)
    assert contrast(bars, 1) == pytest.approx(0)


@pytest.mark.parametrize("frequency", [0.1, 0.2437, 0.4])
def test_modulation_is_that_of_the_bars_and_not_of_noise(frequency: float) -> None:
    """A sine of amplitude 0.2 about 0.5 is the fundamental of bars of contrast 0.1 pi; noise as strong makes no more
    than a tenth of it. (Planted: the frequency doubled; the mean left out.)"""
    wave = 0.5 + 0.2 * np.sin(2 * np.pi * frequency * np.arange(60) + 0.7)
    assert modulation(np.tile(wave, (40, 1)), 0, frequency) == pytest.approx(0.1 * np.pi, rel=1e-9)
    noise = 0.5 + 0.14 * np.random.default_rng(1).standard_normal((40, 60))
    assert modulation(noise, 0, frequency) < 0.03
    assert contrast(noise, 0) > 0.05
