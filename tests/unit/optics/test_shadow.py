"""The closed-form shadow against exact rational arithmetic, quadrature, and what must hold for any mask."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry, centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.optics.shadow import Antiderivative, Directions, ShadowGeometry, Steps, blurred_step, geometric_terms
from mitsim.optics.terms import shadow_terms
from tests.shadow_factor import scene_factor, shadow_factor, steps_of


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


# -------- shadow

ANCHOR = (0.06, centred_edges(512, 0.01172), centred_edges(128, 120 / 128), 2.0, 400.0)


def second_sum(bits, s):
    """Exact second integral of the profile, in features, from its left edge to s (a Fraction)."""
    total, slope = Fraction(0), Fraction(0)
    for index, bit in enumerate(bits):
        step = min(max(s - index, Fraction(0)), Fraction(1))
        total += slope * step + Fraction(int(bit)) * step * step / 2
        slope += int(bit) * step
    return total + slope * max(s - len(bits), Fraction(0))


def exact_entry(bits, feature, pixel, cell, distance, depth):
    """Mean transmission by four corners of the second sum, all in rationals."""
    feature, distance, depth = (Fraction(v) for v in (feature, distance, depth))
    shrink = (1 - distance / depth) / feature
    u = [Fraction(v) * shrink for v in pixel]
    x = [Fraction(v) / depth * distance / feature for v in cell]
    half = Fraction(len(bits), 2)
    corner = [[second_sum(bits, a + b + half) for b in x] for a in u]
    return (corner[1][1] - corner[0][1] - corner[1][0] + corner[0][0]) / ((u[1] - u[0]) * (x[1] - x[0]))


@pytest.mark.parametrize("entry", [(0, 0), (511, 127), (255, 64), (100, 3), (400, 90)])
def test_entries_equal_rational_arithmetic(entry):
    # 1e-12: eps times 511 features over a kernel 0.2 features wide.
    feature, pixels, cells, distance, depth = ANCHOR
    bits = mls_mask().bits
    i, j = entry
    exact = exact_entry(bits, feature, pixels[i : i + 2], cells[j : j + 2], distance, depth)
    assert scene_factor(bits, *ANCHOR)[i, j] == pytest.approx(float(exact), abs=1e-12)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.integers(0, 1), min_size=1, max_size=40), st.floats(0.01, 1.0), st.floats(0.1, 3.0), st.floats(3.5, 1e6)
)
def test_energy_and_bounds(bits, feature, distance, depth):
    # Over pixels that see the whole mask, the mean transmission adds up to the open area's share, whatever
    # lies between; every entry stays within the profile's values.
    span = (len(bits) * feature + 4 * distance) / (1 - distance / depth)
    pixels, cells = centred_edges(50, span / 50), np.array([-0.7, -0.2, 0.01, 0.6])
    factor = shadow_factor(bits, feature, pixels, cells, distance, depth)
    assert factor.min() >= -1e-12
    assert factor.max() <= 1 + 1e-12
    area = factor.sum(axis=0) * (span / 50) * (1 - distance / depth)
    np.testing.assert_allclose(area, sum(bits) * feature, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("depth", [2.0, float("nan")])
def test_a_scene_at_the_mask_is_refused_in_one_line(depth):
    with pytest.raises(MitsimError, match=r"^[^\n]+$"):
        ShadowGeometry(mls_mask(), np.zeros(1), 0.1, 2.0, 0.0, depth)


def test_a_fill_factor_dims_both_axes_once_and_shades_each_by_its_own_directions():
    """Pixels of a quarter of the area: the shadow over half the side, and a quarter of the light."""
    camera = CameraGeometry(pixels=8, pixel_pitch=0.05, mask_order=5, pixel_fill_factor=0.25)
    rows, columns = Directions([0.0, 0.01], 0.0), Directions([-0.02, 0.0, 0.03], 0.0)
    ((left, right),) = shadow_terms(camera, rows, columns, 400.0)
    ((plain_left, plain_right),) = geometric_terms(ShadowGeometry.of(camera, 400.0), rows, columns)
    np.testing.assert_array_equal(left, 0.25 * plain_left)
    np.testing.assert_array_equal(right, plain_right)
    assert left.shape == (8, 2) and right.shape == (8, 3) and ShadowGeometry.of(camera, 400.0).active_mm == 0.025
