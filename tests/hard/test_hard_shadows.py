"""The mask's geometric shadow and means of step functions where sizes are extreme: against fractions, and closed forms.

Tolerances come from conditioning: a coordinate of size S is rounded by eps S, and an edge within a box of width w moves
the box's mean by eps S / w. Then diffraction, against 30-digit Fresnel integrals, sums, and waves not paraxial.
"""

import math
import time
import tracemalloc
from collections.abc import Callable
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import mpmath
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.special import fresnel

from mitsim.core.configuration import validate
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry, MaskProfile
from mitsim.devices.mask import Mask, mls_mask
from mitsim.devices.projector import Spectrum
from mitsim.optics.diffraction import EdgeWaves
from mitsim.optics.fft_shadow import ProfileSampler
from mitsim.optics.image_formation import FrameOptics
from mitsim.optics.shadow import Antiderivative, Directions, ShadowGeometry, Steps, geometric_terms
from tests.robustness import Recorder
from tests.shadow_factor import steps_of

pytestmark = pytest.mark.robustness("Optics")
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


# ---- Diffraction ----


NM = 550.0


def edge_wave(x: float, product: float) -> mpmath.mpc:
    """E(x) of a half plane, x [mm] and lambda D [mm^2], with 30 digits."""
    with mpmath.workdps(30):
        v = mpmath.mpf(x) * mpmath.sqrt(2 / mpmath.mpf(product))
        return mpmath.mpf(1) / 2 + mpmath.mpc(1, -1) / 2 * mpmath.mpc(mpmath.fresnelc(v), mpmath.fresnels(v))


@pytest.mark.parametrize(
    ("name", "half", "distance"),
    [
        ("far", 5e-4, 2000.0),
        ("far", 5e-4, 2.0),
        ("near", 0.03, 2.0),
        ("near", 0.03, 2e-3),
        ("near", 1.0, 2.0),
        ("at the scene", 0.09, 399.6 * (1 - 399.6 / 400)),
    ],
)
def test_a_slit_equals_thirty_digits_in_the_far_and_the_near_field(
    measured: Recorder, name: str, half: float, distance: float
) -> None:
    """Fresnel numbers from 9e-7 to 900 against differences of Fresnel integrals, and the far field's sinc.

    1e-12 of an open mask is what the transform leaves; of the far field's 1e-3 that is nine digits. Where the other
    edge lies beyond the grid's fade-out (Fresnel numbers above 500) its wave is missing, by its asymptotic size.
    """
    product = NM * 1e-6 * distance
    step = min(half / 4, math.sqrt(product) / 130)
    step = half / math.ceil(half / step)
    waves = EdgeWaves(NM, distance, step, 24, 4 * half + 60 * step)
    found = waves.field(Steps(np.array([-half, half]), np.ones(1)), half - 12 * step)
    middles = half + (np.arange(24) - 11.5) * step
    with mpmath.workdps(30):
        exact = [complex(edge_wave(s + half, product) - edge_wave(s - half, product)) for s in middles]
    # A wave from further than 3/4 of the fade-out's end is faded: 1 / (pi sqrt(2) v) of it is left out.
    left = (
        0.0 if 2 * half + 12 * step < 0.75 * product / (2 * step) else 1.1 * math.sqrt(product) / (2 * np.pi * 2 * half)
    )
    measured(np.abs(found - exact).max(), at_most=1e-12 + left)
    if half**2 / product < 1e-5:
        # Fraunhofer: 2h / sqrt(i lambda D) exp(i pi s^2 / (lambda D)) sinc(2 h s / (lambda D)).
        far = 2 * half / np.sqrt(1j * product) * np.exp(1j * np.pi * middles**2 / product)
        far *= np.sinc(2 * half * middles / product)
        # Left: the phase over the slit, pi h^2 / (lambda D).
        assert np.abs(found - far).max() < np.pi * half**2 / product * np.abs(far).max()


def test_a_million_edges_equal_their_sum(measured: Recorder) -> None:
    """A mask of 1e6 edges in 1.25e6 cells against the plain sum of a million edge waves, by math.fsum.

    1e-9 of an open mask: 1e6 terms of order 1, and their mean square rounding of eps x 1e3 in either way. Memory stays
    below 400 bytes a cell of the grid.
    """
    distance, step, cells = 2000.0, 2.5e-4, 1_250_000
    rng = np.random.default_rng(11)
    places = np.sort(rng.choice(cells + 1, 1_000_000, replace=False))
    edges = (places - cells // 2) * step
    values = rng.random(len(edges) - 1)
    start = -4 * step
    tracemalloc.start()
    waves = EdgeWaves(NM, distance, step, 3, float(np.abs(edges).max()) + 8 * step)
    found = waves.field(Steps(edges, values), start)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    measured(peak / cells, at_most=400, what="memory a cell", unit="bytes")
    jumps = np.diff(values, prepend=0.0, append=0.0)
    for middle, field in zip(start + (np.arange(3) + 0.5) * step, found, strict=True):
        sine, cosine = fresnel((middle - edges) * math.sqrt(2 / (NM * 1e-6 * distance)))
        terms = jumps * (0.5 + (0.5 - 0.5j) * (cosine + 1j * sine))
        measured(
            abs(field - complex(math.fsum(terms.real), math.fsum(terms.imag))), at_most=1e-9, what="of an open mask"
        )


@pytest.mark.parametrize(("feature", "warned"), [(5e-4, True), (1e-3, False)])
def test_a_mask_below_the_wavelength_warns(
    small_scene: Callable[..., Path], variant: str, feature: float, warned: bool
) -> None:
    from mitsim.api.bench import open_bench
    from mitsim.planner.planner import SceneFacts

    found = [w for w in SceneFacts.of(open_bench(small_scene(mask_feature=feature))).warnings if "wavelength" in w]
    assert len(found) == warned and all("mask_feature 0.0005 mm" in w and "\n" not in w for w in found)


def test_a_plan_with_openings_below_half_a_wavelength_goes_without_diffraction(
    small_scene: Callable[..., Path], variant: str
) -> None:
    """Refused before the pilot looks, or flagged where diffraction is off. (Planted: the pilot's look has it on.)"""
    from mitsim.api.bench import open_bench

    bench = open_bench(small_scene(mask_feature=1.5e-4))
    with pytest.raises(MitsimError, match="half a wavelength"):
        bench.plan("uniform", accuracy=0.1)
    assert any(
        "shadow is a guess" in reported
        for reported in bench.plan("uniform", accuracy=0.1, effects="-diffraction").warnings
    )


FINE = {
    "code": {"kind": "separable"},
    "tilted": {"kind": "separable", "tilt_row_mrad": 300.0},
    "two terms": {"kind": "flatcam", "opaque_transmission": 1e-7},
    "MURA": {"kind": "mura", "features": 101},
    "random": {"kind": "random", "features": 1023},
    "turned": {"kind": "random", "features": 31, "rotation_deg": 3.0},
    "grey": {"kind": "separable", "order": 6, "opaque_transmission": 0.2},
    "slit": {"kind": "drawing", "file": "slit.npy"},
    "pinhole": {"kind": "drawing", "file": "pinhole.npy"},
}
"""Masks with openings of a few nanometres; slit and pinhole are one feature wide."""


@pytest.mark.parametrize("name", FINE)
def test_waves_through_openings_below_half_a_wavelength_are_refused(
    tmp_path: Path, measured: Recorder, name: str
) -> None:
    """At once, of every kind of mask, and not where they are half a micrometre. (Planted: no limit.)"""
    for file, place in (("slit", np.s_[:, 30]), ("pinhole", np.s_[30, 30])):
        drawing = np.zeros((61, 61))
        drawing[place] = 1
        np.save(tmp_path / f"{file}.npy", drawing)
    bare, at, line = CameraGeometry(pixels=32), Directions([0.0, 0.1], 0.0), Spectrum(np.array([638.0]), np.ones(1))

    def frame(feature: float) -> np.ndarray:
        camera = MaskProfile.model_validate({**FINE[name], "feature_mm": feature}).put_on(bare, tmp_path)
        return FrameOptics(camera, at, at, (400.0,), 1, line).frame(np.array([0]), np.ones(1))

    started = time.process_time()
    with pytest.raises(
        MitsimError, match=r"^mask: .*diffraction of 638 nm needs 0\.000319, .*feature_mm.*-diffraction"
    ):
        frame(1e-6)
    measured(time.process_time() - started, at_most=3.0, what="refused", unit="s of processor time")
    if name != "random":  # of half a micrometre it is drawn, like the turned one, and takes seconds
        assert np.isfinite(frame(4e-4)).all()


def test_fine_pixels_of_a_drawing_are_no_features(tmp_path: Path) -> None:
    """An opening of 16 um is the same drawn in pixels of 2 um as in 128 of 0.125 um, below any wavelength. (Planted:
    the limit asks for the feature.)"""
    frames = []
    for pixel, side in ((2e-3, 8), (1.25e-4, 128)):
        np.save(tmp_path / f"{side}.npy", np.pad(np.ones((side, side)), side // 8))
        table = {"kind": "drawing", "file": f"{side}.npy", "feature_mm": pixel}
        camera = MaskProfile.model_validate(table).put_on(CameraGeometry(pixels=32), tmp_path)
        at, line = Directions([0.0, 0.1], 0.0), Spectrum(np.array([638.0]), np.ones(1))
        frames.append(FrameOptics(camera, at, at, (400.0,), 1, line).frame(np.array([0]), np.ones(1)))
    np.testing.assert_allclose(frames[1], frames[0], rtol=0, atol=1e-3 * frames[0].max())
