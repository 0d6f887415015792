"""The mask's geometric shadow and means of step functions where sizes are extreme: against fractions, and closed forms.

Tolerances come from conditioning: a coordinate of size S is rounded by eps S, and an edge within a box of width w moves
the box's mean by eps S / w.
"""

import math
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mitsim.core.configuration import validate
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask import Mask, mls_mask
from mitsim.optics.fft_shadow import ProfileSampler
from mitsim.optics.shadow import Antiderivative, Directions, ShadowGeometry, Steps, geometric_terms
from tests.robustness import Recorder
from tests.shadow_factor import steps_of

pytestmark = pytest.mark.robustness("Optics")
PAPER = Directions.cells((np.arange(129) - 64) * (120 / 128 / 400))
EPS = np.finfo(float).eps
power = lambda low, high: st.floats(low, high).map(lambda x: 10.0**x)  # noqa: E731


def exact_mean(edges: list[Fraction], values: list[Fraction], centre: Fraction, a: Fraction, b: Fraction) -> Fraction:
    """Mean of a step function, 0 outside, over two boxes of half-widths a > 0 and b >= 0 one after the other.

    Every edge turns the second antiderivative's slope, as in (x - e)^2 / 2 beyond it, and the first's as in x - e.
    """
    total = Fraction(0)
    for edge, before, after in zip(edges, [Fraction(0), *values], [*values, Fraction(0)], strict=True):
        if before == after:
            continue
        if b == 0:
            part = sum(sign * max(centre + x - edge, Fraction(0)) for sign, x in ((1, a), (-1, -a))) / (2 * a)
        else:
            corners = ((1, a + b), (-1, a - b), (-1, b - a), (1, -a - b))
            part = sum(sign * max(centre + x - edge, Fraction(0)) ** 2 for sign, x in corners) / (8 * a * b)
        total += (after - before) * part
    return total


def mask_edges(mask: Mask) -> list[Fraction]:
    count = len(mask.bits)
    return [(k - Fraction(count, 2)) * Fraction(mask.feature_mm) for k in range(count + 1)]


def exact_shadow(setting: ShadowGeometry, at: Directions, pixel: int, cell: int) -> Fraction:
    """One entry of the thin or thick geometric shadow of a mask's own profile, in rationals of the given floats."""
    u, tau = Fraction(float(setting.pixel_centres_mm[pixel])), Fraction(float(at.centres[cell]))
    d, h = Fraction(setting.distance_mm), Fraction(setting.thickness_mm)
    z = Fraction(setting.depth_mm) if math.isfinite(setting.depth_mm) else None
    shrink = 1 - d / z if z else Fraction(1)
    edges, values = mask_edges(setting.mask), [Fraction(int(bit)) for bit in setting.mask.bits]
    if h:
        scale, shift = 1 - h / (z - d) if z else Fraction(1), h * tau / shrink
        both = sorted({*edges, *((edge - shift) / scale for edge in edges)})

        def at_face(s: Fraction) -> Fraction:
            k = math.floor(s / Fraction(setting.mask.feature_mm) + Fraction(len(values), 2))
            return values[k] if 0 <= k < len(values) else Fraction(0)

        middles = [(low + high) / 2 for low, high in pairwise(both)]
        edges, values = both, [at_face(s) * at_face(scale * s + shift) for s in middles]
    centre = u * shrink + d * tau
    return exact_mean(edges, values, centre, Fraction(setting.active_mm) * shrink / 2, d * Fraction(at.width) / 2)


def conditioning(setting: ShadowGeometry, at: Directions) -> float:
    """What rounding of coordinates may do to a mean: each of the edges within the boxes moves by eps of its place."""
    size = setting.mask.extent_mm / 2 + float(np.abs(setting.crossings(at)).max())
    wide = max(setting.half_pixel, setting.half_cell(at))
    return 4 * EPS * size * (1 / wide + 2 / setting.mask.feature_mm) + 4 * EPS


bits_of_masks = st.lists(st.integers(0, 1), min_size=1, max_size=24).map(lambda bits: np.array([1, *bits]))


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    bits=bits_of_masks,
    feature=power(-3, 0),
    pitch=power(-6, 1),
    distance=power(-9, 2.6),
    beyond=power(-3, 6),
    width=power(-9, 0) | st.just(0.0),
    thickness=power(-4, -0.5) | st.just(0.0),
)
@example(np.array([1, 0, 1]), 0.18111005, 0.0029468356, 6.136185125, 0.0010824002457, 0.0, 0.0)
@example(np.array([1]), 0.0336731820, 0.0076961102, 115.6449334894, 0.0054989479, 0.0, 0.0)
def test_shadows_equal_fractions_at_any_scale(
    measured: Recorder, bits, feature, pitch, distance, beyond, width, thickness
) -> None:
    """Features 1 um to 1 mm, pixels 1 nm to 10 mm, masks 1 pm to 400 mm from the sensor, scenes from 1 um behind them.

    Within the conditioning, which is 1e-8 for pixels of 1 nm under a mask of 24 mm and 1e-13 for those of 10 um.
    """
    mask = Mask("separable", feature, bits)
    at = Directions([-0.11, 0.0, 0.07], width)
    depth, reach = distance + thickness + beyond, mask.extent_mm / 2
    # The last one sees the mask's rim in its middle, however small it is.
    pixels = np.array([-0.9 * reach, -0.1 * reach, 0.31 * reach, -reach / (1 - distance / depth)])
    setting = ShadowGeometry(mask, pixels, pitch, distance, thickness, depth)
    ((found, other),) = geometric_terms(setting, at, at)
    assert np.array_equal(other, found) and np.isfinite(found).all()
    assert found.min() > -1e-9 and found.max() < 1 + 1e-9
    bound = conditioning(setting, at)
    for pixel in range(4):
        for cell in range(3):
            error = abs(found[pixel, cell] - float(exact_shadow(setting, at, pixel, cell)))
            measured(error / bound, at_most=1, what="of the conditioning")


EXTREMES = {
    "the paper's": ({}, 1e-12),
    "pixels of 1 nm": ({"pixel_pitch": 1e-6}, 1e-8),
    "pixels of 10 mm": ({"pixel_pitch": 10.0}, 1e-12),
    "features of 1 um": ({"mask_feature": 1e-3}, 1e-12),
    "features of 1 um, pixels of 10 mm": ({"mask_feature": 1e-3, "pixel_pitch": 10.0}, 1e-11),
    "features of 1 mm": ({"mask_feature": 1.0}, 1e-11),
    "mask at 20 um": ({"mask_distance": 0.02}, 1e-12),
    "mask at 1 pm": ({"mask_distance": 1e-9}, 1e-11),
    "mask at 0.999 z": ({"mask_distance": 399.6}, 1e-8),
    "thick mask at 1 nm": ({"mask_distance": 1e-6, "mask_thickness": 0.01}, 1e-11),
    "thick mask, pixels of 1 nm": ({"mask_thickness": 0.2, "pixel_pitch": 1e-6}, 1e-8),
}


@pytest.mark.parametrize("name", EXTREMES)
def test_the_papers_mask_at_extremes_equals_fractions(measured: Recorder, name: str) -> None:
    """511 features: 4 partly open entries and a corner against fractions, and all entries between 0 and 1.

    Gates are the conditioning, eps x 15 mm over the wider box: 7e-9 for a pixel of 1 nm, 6e-13 for the paper's.
    """
    numbers, gate = EXTREMES[name]
    geometry = CameraGeometry(**numbers)
    setting = ShadowGeometry.of(geometry, 400.0)
    ((found, _),) = geometric_terms(setting, PAPER, PAPER)
    assert np.isfinite(found).all() and found.min() > -1e-9 and found.max() < 1 + 1e-9
    partial = np.argwhere((found > 1e-6) & (found < 1 - 1e-6))
    chosen = np.random.default_rng(7).choice(len(partial), 4)
    entries = [(0, 0), *partial[chosen].tolist()]
    worst = max(abs(found[i, j] - float(exact_shadow(setting, PAPER, i, j))) for i, j in entries)
    measured(worst, at_most=gate)


@settings(max_examples=80, deadline=None, derandomize=True)
@given(bits=bits_of_masks, feature=power(-3, 0), distance=power(-6, 2), beyond=power(-2, 4), parts=st.integers(1, 40))
def test_light_through_the_mask_is_neither_made_nor_lost(
    measured: Recorder, bits, feature, distance, beyond, parts
) -> None:
    """Columns over pixels that see the whole mask sum to its open width, for pixels of a tenth of a feature to 40."""
    mask, at = Mask("separable", feature, bits), Directions([-0.2, 0.01, 0.3], 0.01)
    depth = distance + beyond
    shrink = 1 - distance / depth
    span = (mask.extent_mm + distance * 0.7) / shrink * 1.01
    count = int(max(4, min(span * shrink / feature * 10 / parts, 4000)))
    pixels = (np.arange(count) + 0.5 - count / 2) * (span / count)
    ((factor, _),) = geometric_terms(ShadowGeometry(mask, pixels, span / count, distance, 0.0, depth), at, at)
    width = factor.sum(axis=0) * (span / count) * shrink
    # Neighbours share their ends but for eps of the span, which each of `count` pixels rounds on its own.
    bound = 8 * EPS * span * shrink * count + 1e-9 * span * shrink
    measured(np.abs(width - bits.sum() * feature).max() / bound, at_most=1, what="of the rounding")


def test_a_mask_on_the_sensor_is_its_own_shadow(measured: Recorder) -> None:
    """d to 0: the shadow tends to the mask's mean over each pixel, exact in fractions, in proportion to d.

    A crossing moves by d |tau - u / z|, at most 0.16 d here, and a mean over a pixel by 2 x that over its half width.
    """
    cells = Directions(np.linspace(-0.15, 0.15, 5), 0.01)
    ends = {}
    for distance in (1e-9, 1e-6, 1e-3):
        setting = ShadowGeometry.of(CameraGeometry(pixels=12, pixel_pitch=0.05, mask_distance=distance), 400.0)
        ((found, _),) = geometric_terms(setting, cells, cells)
        edges, values = mask_edges(setting.mask), [Fraction(int(bit)) for bit in setting.mask.bits]
        half = Fraction(setting.active_mm) / 2
        exact = [
            float(exact_mean(edges, values, Fraction(float(u)), half, Fraction(0))) for u in setting.pixel_centres_mm
        ]
        ends[distance] = np.abs(found - np.array(exact)[:, None]).max()
        measured(ends[distance], at_most=2 * 0.16 * distance / (setting.active_mm / 2) + 1e-12, what=f"{distance:g} mm")
    assert ends[1e-9] < 1e-4 * ends[1e-3]


@pytest.mark.parametrize(("distance", "thickness"), [(400.0, 0.0), (399.9, 0.1), (500.0, 0.0), (1e6, 0.0)])
def test_a_mask_at_the_scene_is_refused_and_says_what_is_allowed(distance: float, thickness: float) -> None:
    with pytest.raises(MitsimError, match=r"^here: [^\n]*must be less than scene_distance 400\.0 mm[^\n]*$"):
        validate(CameraGeometry, {"mask_distance": distance, "mask_thickness": thickness}, "here")


@pytest.mark.parametrize(
    ("field", "value"),
    [("pixel_pitch", 1e-7), ("pixel_pitch", 1001.0), ("mask_feature", 1e-300), ("mask_feature", 1e300)]
    + [
        ("mask_distance", 0.0),
        ("mask_distance", -1.0),
        ("mask_distance", math.nan),
        ("mask_distance", 1e300),
        ("pixel_pitch", math.inf),
    ],
)
def test_lengths_beyond_all_cameras_are_refused_in_one_line(field: str, value: float) -> None:
    """Features of 1e-300 mm gave a transmission of 1e-296, and a refusal of waves 300 digits long."""
    with pytest.raises(MitsimError, match=rf"^here: {field}: got [^\n]{{1,150}}$"):
        validate(CameraGeometry, {field: value}, "here")


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
@given(count=st.integers(1, 30), place=st.floats(-1.5, 1.5), width=power(-15, 3) | st.just(0.0), many=st.booleans())
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
