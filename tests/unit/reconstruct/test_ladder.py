"""Several exposures of one frame: which of them a pixel is read at, and with what weight."""

import numpy as np
import pytest

from mitsim.core.manifests import Digital
from mitsim.reconstruct.captured_session import Ladder

FIRST = Digital(
    exposure_s=0.1, gain_dn_per_e=0.5, black_level_dn=20, dark_current_e_per_s=100, read_noise_e=10, saturation_dn=1020
)
DIGITALS = [FIRST.model_copy(update={"exposure_s": 0.1 * factor}) for factor in (1, 2, 8)]
LIGHT = np.array([[0.0, 1000.0, 9e3, 2e4]])
"""Electrons a second; 2000 electrons saturate."""


def test_pixels_are_read_where_a_uniform_frame_cannot_saturate_them() -> None:
    """Of 9000 electrons a second, 1820 in 0.2 s, dark ones too; five deviations of this frame, scaled from the first,
    are 400 more. (Planted: no room.)"""
    used = Ladder.of(DIGITALS, LIGHT, 1, "weighted")
    assert [used.used_pixels(number).tolist() for number in range(3)] == [
        [[True, True, True, True]],
        [[True, True, False, False]],
        [[True, True, False, False]],
    ]
    longest = Ladder.of(DIGITALS, LIGHT, 1, "longest")
    assert longest.weights is not None and np.argmax(longest.weights, axis=0).tolist() == [[2, 2, 0, 0]]
    assert longest.weights.sum(axis=0) == pytest.approx(1)


def test_weights_are_those_of_the_least_variance() -> None:
    """Of half of the light, in whole numbers: 1/v with v = (L/2 + D)/t + read^2/t^2; any other weights leave more."""
    found = Ladder.of(DIGITALS, LIGHT, 1, "weighted")
    assert found.weights is not None
    inverse = np.array([1 / ((500 + 100) / time + 100 / time**2) for time in (0.1, 0.2, 0.8)])
    np.testing.assert_allclose(found.weights[:, 0, 1], inverse / inverse.sum(), rtol=1e-12)
    assert found.weights[:, 0, 3].tolist() == [1, 0, 0]
    half = LIGHT[:, :2] / 2
    best = Ladder(tuple(DIGITALS), found.weights[:, :, :2]).variance(half)
    assert best == pytest.approx((1 / inverse.sum() + 1 / sum(1 / (100 / t + 100 / t**2) for t in (0.1, 0.2, 0.8))) / 2)
    for shift in (0.01, -0.01):
        other = Ladder(tuple(DIGITALS), found.weights[:, :, :2] + shift * np.array([1, -2, 1])[:, None, None])
        assert other.variance(half) > best


def test_one_exposure_is_left_as_it_is() -> None:
    alone = Ladder((FIRST,))
    assert alone.merge([LIGHT]) is LIGHT and alone.used_pixels(0) is True
    assert alone.variance(LIGHT, 2) == FIRST.variance(float(LIGHT.mean()), 2)
