"""The closed-form shadow against exact rational arithmetic, quadrature, and what must hold for any mask."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry, centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.optics.shadow import Directions, ShadowGeometry, geometric_terms
from mitsim.optics.terms import shadow_terms
from tests.shadow_factor import scene_factor, shadow_factor

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
