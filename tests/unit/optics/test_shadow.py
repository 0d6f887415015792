"""The closed-form shadow against exact rational arithmetic, quadrature, and what must hold for any mask.

Operators of separable terms against the dense four-dimensional ones that they stand for.

Shadows of a mask that is turned or shakes, against the mask itself, point by point.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import hadamard
from scipy.special import erf, ndtr

from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry, centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.devices.projector import Spectrum
from mitsim.devices.session import MaskMotion
from mitsim.optics.diffraction import wave_profiles
from mitsim.optics.shadow import (
    Antiderivative,
    Directions,
    SeparableTerms,
    ShadowGeometry,
    Steps,
    blurred_step,
    geometric_terms,
)
from mitsim.optics.terms import best_term, lacking, shadow_terms
from tests.shadow_factor import scene_factor, shadow_factor, steps_of
from tests.stripes import estimated


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


Terms = list[tuple[np.ndarray, np.ndarray]]


# -------- Operators of separable terms


def random_terms(count: int, seed: int) -> Terms:
    """Factors (7, 4) and (6, 5): no two sizes are equal, so that no axis can be mistaken."""
    random = np.random.default_rng(seed)
    return [(random.normal(size=(7, 4)), 3 * random.normal(size=(6, 5))) for _ in range(count)]


def dense(terms: Terms) -> np.ndarray:
    """(7 * 4, 6 * 5) matrix with the operator's entries, left indices against right ones."""
    return sum(np.einsum("ir,jc->irjc", left, right).reshape(28, 30) for left, right in terms)


@pytest.mark.parametrize("count", [2, 3, 40])
def test_the_best_term_is_the_first_singular_pair_of_the_dense_operator(count: int) -> None:
    terms = random_terms(count, 1)
    whole = dense(terms)
    left, values, right = np.linalg.svd(whole)
    best = best_term(terms)
    assert np.allclose(dense([(best.left, best.right)]), values[0] * np.outer(left[:, 0], right[0]), atol=1e-10)
    assert best.residual == pytest.approx(np.linalg.norm(values[1:]) / np.linalg.norm(values), rel=1e-10)
    error = np.linalg.norm(whole - dense([(best.left, best.right)])) / np.linalg.norm(whole)
    assert best.residual == pytest.approx(error, rel=1e-10)


@pytest.mark.parametrize("count", [1, 3])
def test_what_factors_of_stripes_lack_is_the_rest_of_the_operator(count: int) -> None:
    """Pixels of a brightness of their own, which only their factors tell: the calibration's own estimate of the dense
    operator's responses, and the operator less these factors. (Planted: factors held against the best term.)"""
    random, signs = np.random.default_rng(6), hadamard(4).astype(np.float64)
    terms = [
        (part * random.normal(size=(7, 4)) + 0.5, part * random.normal(size=(6, 4)) + 0.5)
        for part in (1.0, 0.2, 0.1)[:count]
    ]
    rows, columns = 1 + 0.2 * random.random(4), 1 + 0.2 * random.random(4)
    bright = [(3 * rows * left, columns * right) for left, right in terms]
    horizontal, vertical = (
        [sum(left @ shown @ right.T for left, right in bright) for shown in shot]
        for shot in (np.stack([np.outer(h, np.ones(4)) for h in signs.T]), [np.outer(np.ones(4), h) for h in signs.T])
    )
    found = estimated(horizontal, vertical, signs)
    whole = sum(np.einsum("ir,jc->irjc", *term) for term in bright)
    rest = whole - np.einsum("ir,jc->irjc", found.left, found.right)
    lacks = lacking(terms, found.left, found.right)
    assert lacks.residual == pytest.approx(np.linalg.norm(rest) / np.linalg.norm(whole), rel=0.02, abs=1e-12)
    made = sum((np.einsum("ir,jc->irjc", *term) for term in lacks.terms), 0 * rest)
    assert np.linalg.norm(made - rest) <= 0.06 * np.linalg.norm(rest) + 1e-12 * np.linalg.norm(whole)


DEPTH = 400.0
CAMERA = CameraGeometry(pixels=24, pixel_pitch=0.25, mask_offset_row=0.1, mask_offset_column=-0.07)
"""As wide as the anchor's sensor, with pixels 20 times as large: what turns moves by up to 3 um at its edge."""
# -------- A mask that is turned or shakes

ROWS = Directions.cells(np.linspace(-0.1, 0.1, 6))
COLUMNS = Directions.cells(np.linspace(-0.12, 0.08, 5))


def moving(**motion: float) -> CameraGeometry:
    return CAMERA.model_copy(update={"mask_motion": MaskMotion(**motion)})


def operator(terms: SeparableTerms) -> np.ndarray:
    return np.asarray(sum(np.einsum("ir,jc->irjc", left, right) for left, right in terms))


def drawn(angle: float, pixel: tuple[int, int], cell: tuple[int, int], parts: int = 1000) -> float:
    """Mean transmission over one pixel toward points, from the mask's own transmission at turned coordinates.

    A pixel of 0.25 mm holds four features; cells are points here, so that a plain sum does.
    """
    shadow = ShadowGeometry.of(CAMERA, DEPTH)
    steps = (np.arange(parts) + 0.5) / parts - 0.5
    row, column = (
        shadow.shrink * (CAMERA.centres(0)[index] + CAMERA.pixel_pitch * steps)
        + CAMERA.mask_distance * directions.centres[place]
        - offset
        for index, directions, place, offset in zip(pixel, (ROWS, COLUMNS), cell, CAMERA.mask_offset, strict=True)
    )
    row, column = row[:, None], column[None, :]
    turned = np.cos(angle) * row + np.sin(angle) * column, np.cos(angle) * column - np.sin(angle) * row
    return float(CAMERA.build_mask().transmission(*turned).mean())


def test_a_turned_mask_is_the_mask_at_turned_coordinates() -> None:
    """At the sensor's corners, where 2 mrad move the mask by 6 um: to 4 % of what turning changes, twice what sums of
    1000 x 1000 points leave. (Planted: the other sense; one axis alone; the offset left out.)"""
    points = Directions(ROWS.centres, 0.0), Directions(COLUMNS.centres, 0.0)
    turned, still = (operator(shadow_terms(camera, *points, DEPTH)) for camera in (moving(rotation_mrad=2.0), CAMERA))
    places = [((0, 23), (0, 1)), ((23, 23), (4, 3)), ((1, 0), (2, 0)), ((22, 1), (1, 2)), ((0, 11), (4, 3))]
    changed = [turned[i, r, j, c] - still[i, r, j, c] for (i, j), (r, c) in places]
    expected = [drawn(2e-3, *place) - drawn(0.0, *place) for place in places]
    assert np.linalg.norm(np.subtract(changed, expected)) < 0.04 * np.linalg.norm(expected)
    assert np.linalg.norm(expected) > 0.005


def test_fine_nodes_are_as_good_as_finer_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """The anchor's pixels of 11.7 um: hats 0.5 um apart leave 1 % of what turning by 1 mrad changes, against a tenth of
    that spacing. (Planted: 5 um apart, 17 %.)"""
    small = CameraGeometry(pixels=512).model_copy(update={"mask_motion": MaskMotion(rotation_mrad=1.0)})
    cell, few = Directions.cells(np.array([0.05, 0.0523])), (3, 4, 5, 250, 508, 509)
    shadow = [operator(shadow_terms(small, cell, cell, DEPTH, places=(few, few)))]
    monkeypatch.setattr("mitsim.optics.terms.NODE_UM", 0.05)
    shadow.append(operator(shadow_terms(small, cell, cell, DEPTH, places=(few, few))))
    still = operator(shadow_terms(small.model_copy(update={"mask_motion": None}), cell, cell, DEPTH, places=(few, few)))
    assert np.linalg.norm(shadow[0] - shadow[1]) < 0.01 * np.linalg.norm(shadow[1] - still)


@pytest.mark.parametrize("spectrum", [None, Spectrum(np.array([520.0]), np.ones(1))])
def test_vibration_is_the_convolution_of_the_shadow(spectrum: Spectrum | None) -> None:
    """With a normal law, along each axis: a pixel's mean of the mask's edges smeared to error functions; in waves, of
    the fine profile smeared point by point. To 1 % of what shaking changes. (Planted: half the deviation.)"""
    deviation, camera = 0.02, CAMERA.model_copy(update={"mask_offset_row": 0.0, "mask_offset_column": 0.0})
    point = Directions(np.array([0.03]), 0.0)
    shaking = camera.model_copy(update={"mask_motion": MaskMotion(vibration_um=1e3 * deviation)})
    (found,), (still,) = (shadow_terms(each, point, point, DEPTH, spectrum) for each in (shaking, camera))
    shadow = ShadowGeometry.of(camera, DEPTH)
    s = ((np.arange(1000) + 0.5) / 1000 - 0.5) * 2 * shadow.half_pixel + shadow.crossings(point)
    if spectrum is None:
        weight, profile, _ = camera.build_mask().terms[0]
        edges = (np.arange(len(profile) + 1) - len(profile) / 2) * camera.mask_feature
        jumps = np.diff(profile, prepend=0.0, append=0.0)
        expected = np.array(
            [(jumps * (1 + erf((each[:, None] - edges) / (deviation * 2**0.5))) / 2).sum(axis=1).mean() for each in s]
        )
    else:
        low, high = s.min() - 0.2, s.max() + 0.2
        ((weight, values), *_), start, step = wave_profiles(shadow, 520.0, low, high, 0.03)
        reach = int(5 * deviation / step)
        kernel = np.exp(-np.square(np.arange(-reach, reach + 1) * step / deviation) / 2)
        smeared = np.convolve(values, kernel / kernel.sum(), mode="same")
        expected = np.array(
            [np.interp(each, start + step * (np.arange(len(values)) + 0.5), smeared).mean() for each in s]
        )
    before, after = still[0][:, 0], found[0][:, 0]
    scale = np.vdot(expected, after) / np.vdot(expected, expected)
    assert np.linalg.norm(after - scale * expected) < 0.01 * np.linalg.norm(after - before)
    assert scale == pytest.approx(weight, rel=1e-3) or spectrum is not None
