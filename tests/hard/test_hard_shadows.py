"""The mask's geometric shadow where its numbers are extreme: against fractions, and closed forms.

Tolerances come from conditioning: a coordinate of size S is rounded by eps S, and an edge within a box of width w moves
the box's mean by eps S / w.
"""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask import Mask
from mitsim.optics.shadow import Directions, ShadowGeometry, geometric_terms
from tests.hard.exact_shadows import EPS, exact_mean, exact_shadow, mask_edges, power
from tests.robustness import Recorder

pytestmark = pytest.mark.robustness("Optics")
PAPER = Directions.cells((np.arange(129) - 64) * (120 / 128 / 400))


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
        CameraGeometry.build("here", mask_distance=distance, mask_thickness=thickness)


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
        CameraGeometry.build("here", **{field: value})
