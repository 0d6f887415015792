"""Means of step functions over boxes where sizes differ by many orders: against fractions, within conditioning."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsim.devices.mask import mls_mask
from mitsim.optics.fft_shadow import ProfileSampler
from mitsim.optics.shadow import Antiderivative, Steps
from tests.hard.exact_shadows import EPS, exact_mean, power
from tests.robustness import Recorder
from tests.shadow_factor import steps_of

pytestmark = pytest.mark.robustness("Optics")


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    sizes=st.lists(power(-6, 1), min_size=2, max_size=30),
    values=st.lists(st.floats(-1, 1), min_size=30, max_size=30),
    a=power(-6, 1),
    b=power(-9, 1) | st.just(0.0),
)
def test_means_of_uneven_steps_equal_fractions(measured: Recorder, sizes, values, a, b) -> None:
    """Steps from 1 nm to 10 mm side by side: differences of antiderivatives keep eps of their size over the box."""
    edges = np.concatenate(([0.0], np.cumsum(sizes))) - sum(sizes) / 2
    steps = Steps(edges, np.array(values[: len(sizes)]))
    centres = np.concatenate((edges[:4], edges[-3:] - a, [0.1 * edges[-1], edges[-1] + a]))
    found = steps.box_means(centres, a, b)
    exact_edges, exact_values = [Fraction(float(e)) for e in edges], [Fraction(float(v)) for v in steps.values]
    extent = float(edges[-1] - edges[0]) + 4 * (a + b)
    for centre, mean in zip(centres, found, strict=True):
        exact = exact_mean(exact_edges, exact_values, Fraction(float(centre)), Fraction(a), Fraction(b))
        bound = 20 * EPS * extent / max(a, b) * (1 + len(sizes)) + 1e-14
        measured(abs(mean - float(exact)) / bound, at_most=1, what="of the conditioning")


@pytest.mark.parametrize(("a", "b"), [(5.8e-3, 2.3e-3), (5.8e-3, 6e-7), (5e-7, 2.3e-3), (5e-7, 1e-9), (5e-7, 0.0)])
def test_means_of_a_fine_grid_equal_fractions(measured: Recorder, a: float, b: float) -> None:
    """What the wave-optical shadow is averaged with: 1000 cells of a quarter micrometre, boxes down to 1 pm."""
    values = np.random.default_rng(5).random((1, 1000))
    step = 2.0**-12
    centres = np.array([0.05, 0.0865678, 0.125 - 3e-7])
    found = Antiderivative.of_samples(values, 0.0, step).means(centres, a, b)[0]
    edges = [Fraction(k, 4096) for k in range(1001)]
    exact_values = [Fraction(float(v)) for v in values[0]]
    for centre, mean in zip(centres, found, strict=True):
        exact = exact_mean(edges, exact_values, Fraction(float(centre)), Fraction(a), Fraction(b))
        measured(abs(mean - float(exact)), at_most=16 * EPS / max(a, b) + 1e-12)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    count=st.integers(1, 30),
    place=st.floats(-1.5, 1.5),
    width=power(-15, 3) | st.just(0.0),
    many=st.booleans(),
)
def test_samplers_of_mirrored_light_equal_fractions(
    measured: Recorder, count: int, place: float, width: float, many: bool
) -> None:
    """Means over any width, 0 included, of up to 30 000 values; a difference of two sums had 5e-3 left at width 0."""
    numerators = np.random.default_rng(count).integers(0, 2**20, count * (1000 if many else 1))
    feature = 2.0**-14 if many else 2.0**-4
    sampler, length = ProfileSampler(numerators / 2**20, feature), len(numerators) * feature
    s = place * length / 2
    (found,) = sampler(np.array([s]), np.array([width]))

    def upto(x: Fraction) -> Fraction:
        """Integral of the profile up to x, in features from its first edge."""
        k = min(max(math.floor(x), 0), len(numerators))
        cut = int(numerators[k]) * (x - k) if x >= 0 and k < len(numerators) else Fraction(0)
        return Fraction(int(numerators[:k].sum())) + cut

    middle, half = (
        Fraction(s) / Fraction(feature) + Fraction(len(numerators), 2),
        Fraction(width) / Fraction(feature) / 2,
    )
    # The place of an end is rounded by eps of the profile's length.
    slack = Fraction(8 * EPS * (abs(s) + length) / feature)
    if half < slack:
        values = [upto(middle + x + slack) - upto(middle + x - slack) for x in (-2 * slack, 0, 2 * slack)]
        near = [float(value / (2 * slack * 2**20)) for value in values]
        assert min(near) - 1e-9 <= found <= max(near) + 1e-9
        return
    exact = float((upto(middle + half) - upto(middle - half)) / (2 * half * 2**20))
    bound = float(slack / half) + 4 * EPS * len(numerators)
    measured(abs(found - exact) / bound, at_most=1, what="of the conditioning")
    assert -1e-12 < found < 1 + 1e-12


def test_cells_of_a_fine_grid_keep_their_values_in_a_mask_of_four_metres() -> None:
    """65 535 features and cells of 1 nm: exact inside features; differences of sums of 2 m had 1e-7 left."""
    bits = mls_mask(order=16).bits
    steps = steps_of(bits, 0.06)
    for k in range(60_000, 60_020):
        start = (k - len(bits) / 2) * 0.06 + 0.013
        assert (steps.cell_means(start, 1e-6, 100) == bits[k]).all()
