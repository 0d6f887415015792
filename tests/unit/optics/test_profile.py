"""Piecewise constant functions and their means over boxes, against quadrature and exact numbers."""

import numpy as np
import pytest
from scipy.special import ndtr

from mitsim.devices.camera import centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.optics.shadow import Antiderivative, Steps, blurred_step
from tests.shadow_factor import scene_factor, steps_of


def test_a_product_holds_at_every_point() -> None:
    rng = np.random.default_rng(4)
    one, other = (steps_of(rng.integers(-1, 2, 12), 0.3) for _ in range(2))
    product = one.seen_through(other, 0.9, 0.17)
    s = rng.uniform(-3, 3, 2000)
    assert np.array_equal(product.at(s), one.at(s) * other.at(0.9 * s + 0.17))
    assert (np.diff(product.edges) > 0).all()


@pytest.mark.parametrize(("half_pixel", "half_cell"), [(0.2, 0.07), (0.03, 0.4), (0.1, 0.1), (0.2, 0.0), (0.2, 1e-9)])
def test_means_over_two_boxes_equal_quadrature(half_pixel: float, half_cell: float) -> None:
    steps = Steps(np.array([-1.0, -0.4, -0.1, 0.35, 1.0]), np.array([0.5, -1.0, 2.0, 1.0]))
    centres = np.array([[-1.6, -1.0, -0.3], [0.0, 0.2, 1.05]])
    middle = (np.arange(1500) + 0.5) / 750 - 1
    s = centres[..., None, None] + half_pixel * middle[:, None] + half_cell * middle[None, :]
    # The midpoint rule places each of four edges to 1/1500 of a box.
    assert np.allclose(steps.box_means(centres, half_pixel, half_cell), steps.at(s).mean(axis=(-2, -1)), atol=5e-3)
    fine = steps.cell_means(-2.2, 1e-3, 4400)
    sampled = Antiderivative.of_samples(np.stack([fine, 2 * fine]), -2.2, 1e-3).means(centres, half_pixel, half_cell)
    assert np.allclose(sampled[0], steps.box_means(centres, half_pixel, half_cell), rtol=0, atol=1e-12)
    assert np.allclose(sampled[1], 2 * sampled[0])


def test_the_second_difference_loses_nothing_that_matters() -> None:
    """At the paper's geometry against the trapezoid sum, which does not cancel: 1e-11 of values between 0 and 1."""
    profile = mls_mask().terms[0][1]
    pixels, scene = centred_edges(512, 0.01172), centred_edges(128, 120 / 128)
    expected = scene_factor(profile, 0.06, pixels, scene, 2.0, 400.0)
    u, tau = (pixels[:-1] + pixels[1:]) / 2, (scene[:-1] + scene[1:]) / 2 / 400
    centres = u[:, None] * (1 - 2 / 400) + 2 * tau
    half_pixel, half_cell = 0.01172 / 2 * (1 - 2 / 400), 2 * 120 / 128 / 400 / 2
    steps = steps_of(profile, 0.06)
    assert np.abs(steps.box_means(centres, half_pixel, half_cell) - expected).max() < 1e-11
    # The same from 26 000 samples: features hold a whole number of them, so this too is exact.
    fine = steps.cell_means(-3.6, 2.5e-4, 28_800)
    found = Antiderivative.of_samples(fine[None], -3.6, 2.5e-4).means(centres, half_pixel, half_cell)[0]
    assert np.abs(found - expected).max() < 1e-11


def test_a_blurred_step_is_a_normal_law_and_its_means() -> None:
    """Over a box, over none, and nothing infinitely far before it. (Planted: the far side of both bounds.)"""
    x, blur, middle = np.linspace(-1.5, 1.5, 31), 0.2, (np.arange(2000) + 0.5) / 1000 - 1
    expected = ndtr((x[:, None] + 0.3 * middle) / blur).mean(axis=1)
    np.testing.assert_allclose(blurred_step(x, 0.3, 0.0, blur), expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(blurred_step(x, 0.0, 0.0, blur), ndtr(x / blur), rtol=0, atol=1e-15)
    assert blurred_step(np.array([-np.inf, -50.0]), 0.3, 0.0, blur) == pytest.approx([0, 0], abs=1e-15)


def test_a_blurred_fields_factor_is_the_root_of_blurred_power() -> None:
    """Cell by cell, against its mean at 100 points of each. (Planted: the mean over the cells.)"""
    blur, step, count = 0.05, 0.02, 80
    s = -0.3 + step / 100 * (np.arange(100 * count) + 0.5)
    power = 4 * (ndtr(s / blur) - ndtr((s - 1) / blur))
    found = Steps(np.array([0.0, 1.0]), np.array([2.0]), blur).amplitude_means(-0.3, step, count)
    np.testing.assert_allclose(found, np.sqrt(power).reshape(count, 100).mean(axis=1), rtol=0, atol=2e-4)
