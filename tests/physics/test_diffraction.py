"""The wave-optical shadow against fields propagated by FFT, closed forms, and its limit of short waves.

The package sums Fresnel integrals over a mask's edges and relies on the effective distance d (z - d) / z. Here light is
propagated by the transfer function of free space on a grid of points, its own code throughout: numbers that the two
share are the mask's code and the geometry. Expectation: 1e-3 of the norm for means over pixels (what the grid's highest
frequency leaves on either side is 3e-4, measured by halving both).
"""

import numpy as np
import pytest
from scipy.fft import next_fast_len
from scipy.special import fresnel

from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.projector import Spectrum
from mitsim.optics import diffraction
from mitsim.optics.diffraction import EdgeWaves, edge_wave, fast_length, grid_step, wave_profiles
from mitsim.optics.shadow import Antiderivative, Directions, ShadowGeometry, Steps
from mitsim.optics.terms import shadow_terms
from tests.shadow_factor import steps_of

STEP = 2.5e-4
LAMBDA_NM = 550.0
PIXELS = 64
NEAR = {"pixels": PIXELS, "mask_order": 5, "scene_distance": 40.0}
"""A small mask (31 features of 60 um) so near that the source's distance matters: 1 - d/z = 0.95."""


def line(nm: float = LAMBDA_NM) -> Spectrum:
    return Spectrum(np.array([nm]), np.array([1.0]))


def relative(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def grid(count: int, step: float = STEP) -> np.ndarray:
    return (np.arange(count) - count / 2 + 0.5) * step


def code(order: int, signed: bool = False) -> np.ndarray:
    from scipy.signal import max_len_seq

    bits = max_len_seq(order)[0].astype(float)
    return 2 * bits - 1 if signed else bits


def pattern(bits: np.ndarray, feature: float, s: np.ndarray) -> np.ndarray:
    """Transmission of a centred row of features at points, 0 outside."""
    index = np.floor(s / feature + len(bits) / 2).astype(int)
    return np.where((index >= 0) & (index < len(bits)), bits[np.clip(index, 0, len(bits) - 1)], 0.0)


def propagated(
    field: np.ndarray, step: float, distance: float, paraxial: bool = True, nm: float = LAMBDA_NM
) -> np.ndarray:
    """The field after ``distance`` along its last axis, without the common phase."""
    f, wavelength = np.fft.fftfreq(field.shape[-1], step), nm * 1e-6
    if paraxial:
        transfer = np.exp(-1j * np.pi * wavelength * distance * f**2)
    else:
        root = np.sqrt(np.asarray(1 - (wavelength * f) ** 2, complex))
        transfer = np.exp(2j * np.pi * distance / wavelength * (root - 1))
    return np.fft.ifft(np.fft.fft(field) * transfer)


def pixel_means(values: np.ndarray, s: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Means of sampled values (their last axis lies on s) between coordinates."""
    step = s[1] - s[0]
    edges = np.append(s - step / 2, s[-1] + step / 2)
    sums = np.concatenate((np.zeros((*values.shape[:-1], 1)), np.cumsum(values, axis=-1)), axis=-1) * step

    def upto(x: np.ndarray) -> np.ndarray:
        return np.apply_along_axis(lambda one: np.interp(x, edges, one), -1, sums)

    return (upto(high) - upto(low)) / (high - low)


def by_point_source(
    geometry: CameraGeometry, tau: float, depth: float, paraxial: bool = True, nm: float = LAMBDA_NM
) -> np.ndarray:
    """(pixels,) means of |U|^2 for the source's own field on the mask, propagated by d; relative to an open mask."""
    d, s = geometry.mask_distance, grid(1 << 16)
    wavelength = nm * 1e-6
    if paraxial:
        source = np.exp(1j * np.pi * (s - tau * depth) ** 2 / (wavelength * (depth - d)))
    else:
        source = np.exp(2j * np.pi / wavelength * np.hypot(s - tau * depth, depth - d))
    mask = pattern(code(geometry.mask_order), geometry.mask_feature, s)
    field = propagated(source * mask, STEP, d, paraxial, nm)
    # Energy spreads over z / (z - d) of the width that it had at the mask.
    means = pixel_means(np.abs(field) ** 2, s, geometry.pixel_edges[:-1], geometry.pixel_edges[1:])
    return means / (1 - d / depth)


@pytest.mark.parametrize("tau", [0.0, 0.013, -0.15])
def test_a_point_source_equals_its_field_propagated_without_any_scaling(tau: float) -> None:
    geometry = CameraGeometry(**NEAR)
    ((left, right),) = shadow_terms(geometry, Directions([tau], 0.0), Directions([tau], 0.0), 40.0, line())
    expected = by_point_source(geometry, tau, 40.0)
    assert relative(left[:, 0], expected) < 1e-3
    assert np.array_equal(left, right)


@pytest.mark.parametrize(("tau", "left_over"), [(0.0, 0.006), (0.1, 0.016), (0.15, 0.035)])
def test_what_the_paraxial_approximation_leaves(tau: float, left_over: float) -> None:
    """Against the exact transfer function of free space and a true spherical wave, on one side (1-D).

    Half a percent on the axis, 3.5 % where the paper's scene ends: an oblique beam diffracts as over a distance longer
    by (1 + tau^2)^(3/2). That is a tenth of what diffraction does to the shadow there.
    """
    geometry = CameraGeometry(**NEAR)
    at = Directions([tau], 0.0)
    (((wave, _),), ((rays, _),)) = (shadow_terms(geometry, at, at, 40.0, light) for light in (line(), None))
    exact = by_point_source(geometry, tau, 40.0, paraxial=False)
    assert relative(wave[:, 0], exact) == pytest.approx(left_over, rel=0.2)
    assert relative(rays[:, 0], exact) > 8 * relative(wave[:, 0], exact)


def test_a_thick_mask_propagates_the_field_behind_its_clear_aperture() -> None:
    """The model, not the whole truth: both faces multiply, then free space from the exit face."""
    geometry = CameraGeometry(**NEAR, mask_thickness=0.2)
    tau, depth, d = 0.15, 40.0, 2.0
    ((left, _),) = shadow_terms(geometry, Directions([tau], 0.0), Directions([0.0], 0.0), depth, line())
    s, bits = grid(1 << 16), code(5)
    # The entrance's edges fall between points: the mean of 32 points in each step, or slits come out 0.5 % too wide.
    leaves = (s[:, None] + (np.arange(32) - 15.5) / 32 * STEP).ravel()
    enters = leaves + 0.2 * (tau * depth - leaves) / (depth - d)
    clear = (pattern(bits, 0.06, leaves) * pattern(bits, 0.06, enters)).reshape(-1, 32).mean(axis=1)
    field = propagated(clear, STEP, d * (1 - d / depth))
    edges = geometry.pixel_edges * (1 - d / depth) + d * tau
    expected = pixel_means(np.abs(field) ** 2, s, edges[:-1], edges[1:])
    assert relative(left[:, 0], expected) < 1e-3
    thin = shadow_terms(CameraGeometry(**NEAR), Directions([tau], 0.0), Directions([0.0], 0.0), depth, line())
    assert relative(thin[0][0][:, 0], expected) > 0.1, "a wall shift of half a feature has to show"


def test_the_four_terms_of_a_flatcam_mask_equal_a_field_propagated_in_two_dimensions() -> None:
    """A 7 x 7 mask of 240 um at 30 mm, so that a grid of 2048 x 2048 points is fine enough: 0.004 of sqrt(lambda d)."""
    d, feature, step = 30.0, 0.24, 2.5e-3
    geometry = CameraGeometry(
        mask="flatcam", mask_order=3, mask_feature=feature, mask_distance=d, pixels=24, pixel_pitch=0.06
    )
    tau_row, tau_column = 0.004, -0.007
    depth = 300.0
    terms = shadow_terms(geometry, Directions([tau_row], 0.0), Directions([tau_column], 0.0), depth, line())
    assert len(terms) == 4
    got = sum(np.outer(left[:, 0], right[:, 0]) for left, right in terms)
    s, signed = grid(2048, step), code(3, signed=True)
    row, inside = pattern(signed, feature, s), pattern(np.ones(7), feature, s)
    field = (np.outer(inside, inside) + np.outer(row, row)) / 2
    distance = d * (1 - d / depth)
    field = propagated(propagated(field, step, distance).T, step, distance).T
    edges = geometry.pixel_edges * (1 - d / depth)
    expected = np.abs(field) ** 2
    for tau in (tau_column, tau_row):
        expected = pixel_means(expected, s, edges[:-1] + d * tau, edges[1:] + d * tau).T
    assert relative(got, expected) < 1e-3
    without = sum(np.outer(left[:, 0], right[:, 0]) for left, right in terms[:3])
    assert relative(without, expected) > 0.01, "every term has to matter here"


def test_a_half_plane_has_a_quarter_at_its_geometric_edge_and_1_37_beside_it() -> None:
    # The other edge is 5 mm away; its wave is faded out there.
    waves = EdgeWaves(LAMBDA_NM, 2.0, STEP, 400, 6.0)
    irradiance = np.abs(waves.field(Steps(np.array([0.0, 5.0]), np.ones(1)), -STEP / 2)) ** 2
    assert irradiance[0] == pytest.approx(0.25, abs=1e-12)
    # First maximum at w = 1.2172: 1.3704 times the open irradiance (Born & Wolf, Principles of Optics, 8.7.3).
    unit = (LAMBDA_NM * 1e-6 * 2.0 / 2) ** 0.5
    assert irradiance.max() == pytest.approx(1.3704, abs=1e-4)
    assert irradiance.argmax() * STEP == pytest.approx(1.2172 * unit, abs=STEP)


def test_the_wave_from_an_edge_is_fresnels_integrals() -> None:
    """To rounding, from where the pole makes nearly all of it to thousands of turns away. (Planted: 9 nodes; a phase
    whose whole turns stay.)"""
    x = np.concatenate([np.geomspace(1e-9, 1, 500), np.linspace(1, 10, 5000), np.linspace(10, 2000, 5000)])
    sine, cosine = fresnel(x)
    assert np.abs(edge_wave(x) - ((0.5 - 0.5j) * (cosine + 1j * sine) - 0.5)).max() < 5e-16


def test_lengths_of_transforms_are_scipys() -> None:
    assert [fast_length(n) for n in (*range(1, 2000), 44063)] == [next_fast_len(n) for n in (*range(1, 2000), 44063)]


def test_fringes_that_the_grid_cannot_hold_fade_out() -> None:
    """Beyond lambda D / (2 step) = 2.2 mm from an edge its fringes are finer than two cells.

    The last quarter of the way they lose amplitude, half of it in the middle, until nothing is left: no step, whose own
    fringes would be seen. The other edge is too far to be seen.
    """
    unit, fade = (LAMBDA_NM * 1e-6 * 2.0 / 2) ** 0.5, LAMBDA_NM * 1e-6 * 2.0 / (2 * STEP)
    waves = EdgeWaves(LAMBDA_NM, 2.0, STEP, 10_000, 6.0)
    wave = np.abs(waves.field(Steps(np.array([0.0, 5.0]), np.ones(1)), 0.0) - 1)
    for part, left in ((0.7, 1.0), (0.875, 0.5)):
        k = round(part * fade / STEP)
        whole = unit / (2**0.5 * np.pi * (k + 0.5) * STEP)  # of the Fresnel integral's tail, to 1e-8
        assert wave[k] == pytest.approx(left * whole, rel=0.01, abs=1e-9)
    assert wave[round(0.98 * fade / STEP) :].max() < 0.02 * whole
    assert wave[round(fade / STEP) + 1 :].max() < 1e-12


@pytest.mark.parametrize("low", [-3.0, 0.4])
def test_a_range_s_profile_is_part_of_a_wider_one_s(low: float) -> None:
    """To rounding: every edge that reaches the range's ends is in, also the farthest, 5 and 3 mm away."""
    shadow = ShadowGeometry.of(CameraGeometry(**{**NEAR, "mask_distance": 8.0}), 40.0)
    (((_, part),), start, step), (((_, wide),), wide_start, _) = (
        wave_profiles(shadow, LAMBDA_NM, *ends, 0.0) for ends in ((low, low + 1.0), (-6.0, 6.0))
    )
    first = round((start - wide_start) / step)
    np.testing.assert_allclose(part, wide[first : first + len(part)], rtol=0, atol=1e-11)


def test_a_thick_mask_s_grid_is_twice_as_wide_and_each_feature_holds_whole_cells() -> None:
    thin, thick = (ShadowGeometry.of(CameraGeometry(**NEAR, mask_thickness=t), 40.0) for t in (0.0, 0.02))
    assert STEP * 0.98 < grid_step(thin, LAMBDA_NM) <= STEP
    assert grid_step(thick, LAMBDA_NM) == pytest.approx(2 * grid_step(thin, LAMBDA_NM), rel=1e-12)
    near = ShadowGeometry.of(CameraGeometry(**{**NEAR, "mask_distance": 0.1}), 40.0)
    step, fresnel_length = grid_step(near, LAMBDA_NM), (LAMBDA_NM * 1e-6 * 0.1 * (1 - 0.1 / 40)) ** 0.5
    assert 0.98 * fresnel_length / 130 < step <= fresnel_length / 130, "finer where fringes are"
    assert 0.06 / step == pytest.approx(round(0.06 / step), abs=1e-9)


def test_light_is_neither_made_nor_lost() -> None:
    """The integral of |U|^2 over the sensor's plane is the open area, but for light that left past 4 mm."""
    bits = code(5)
    waves = EdgeWaves(LAMBDA_NM, 2.0, STEP, 40_000, 20.0)
    got = float((np.abs(waves.field(steps_of(bits, 0.06), -5.0)) ** 2).sum() * STEP)
    # An edge sends lambda D / (4 pi^2 x) of the light per unit length past a distance x on either side; the fade-out
    # from 1.65 mm to 2.2 mm takes that of about 2 mm.
    edges = int(np.abs(np.diff(bits, prepend=0, append=0)).sum())
    beyond = 2 * edges * LAMBDA_NM * 1e-6 * 2.0 / (4 * np.pi**2 * 2.0)
    assert got == pytest.approx(bits.sum() * 0.06 - beyond, rel=3e-4)
    assert beyond < 1e-3 * got


@pytest.mark.parametrize("kind", ["separable", "flatcam"])
def test_short_waves_cast_the_geometric_shadow(kind: str) -> None:
    """The difference of means over a pixel and a cell falls with lambda D (its logarithm aside)."""
    geometry = CameraGeometry(mask=kind, pixels=64, mask_order=5)
    at = Directions(np.linspace(-0.05, 0.05, 9), 0.002)

    def whole(spectrum: Spectrum | None) -> np.ndarray:
        terms = shadow_terms(geometry, at, at, 400.0, spectrum)
        return np.asarray(sum(np.einsum("ir,jc->ijrc", left, right) for left, right in terms))

    geometric = whole(None)
    found = [relative(whole(line(nm)), geometric) for nm in (550.0, 550 / 16, 550 / 64, 550 / 256)]
    assert found[0] > 0.3
    assert found[1] / found[2] > 3
    assert found[2] / found[3] > 3.3
    assert found[3] < 8e-3


SCENE = Directions.cells((np.arange(129) - 64) * (120 / 128 / 400))


@pytest.mark.parametrize("distance", [0.5, 2.0, 10.0])
def test_a_finer_grid_changes_little(monkeypatch: pytest.MonkeyPatch, distance: float) -> None:
    from mitsim.optics import diffraction

    geometry = CameraGeometry(mask_distance=distance)
    ((coarse, _),) = shadow_terms(geometry, SCENE, SCENE, 400.0, line())
    monkeypatch.setattr(diffraction, "_STEP_MM", diffraction._STEP_MM / 4)
    monkeypatch.setattr(diffraction, "_STEPS_PER_FRESNEL_LENGTH", diffraction._STEPS_PER_FRESNEL_LENGTH * 4)
    ((fine, _),) = shadow_terms(geometry, SCENE, SCENE, 400.0, line())
    assert 0 < relative(coarse, fine) < 4e-4


def test_a_hopeless_grid_is_refused() -> None:
    geometry = CameraGeometry(pixels=64, mask_distance=1e-9)
    with pytest.raises(MitsimError, match=r"needs 1.31e\+08 points, .*move the mask off sensor"):
        shadow_terms(geometry, Directions([0.0], 0.0), Directions([0.0], 0.0), 400.0, line())


@pytest.mark.parametrize("kind", ["separable", "flatcam"])
@pytest.mark.parametrize("distance", [0.5, 8.0])
def test_interpolated_shadows_are_as_good_as_their_grid(kind: str, distance: float) -> None:
    """Between the grid's cells a shadow is interpolated where there are many points: against all points one by one.

    Cubic polynomials leave 2e-6 to 3.1e-5, a tenth of the grid's own 3.2e-4; straight lines 3.8e-5 to 1.5e-4.
    """
    shadow = ShadowGeometry.of(CameraGeometry(mask=kind, mask_distance=distance), 400.0)
    directions = Directions.cells(np.linspace(-0.15, 0.15, 128 * 4 + 1))
    parts, start, step = wave_profiles(shadow, 520.0, -4.4, 4.4, 0.0)
    values = np.stack([profile for _, profile in parts])
    boxes = shadow.crossings(directions), shadow.half_pixel, shadow.half_cell(directions)
    sampled = Antiderivative.of_samples(values, start, step)
    exact, found = sampled.means(*boxes), sampled.smooth_means(*boxes)
    assert 0 < np.linalg.norm(found - exact) / np.linalg.norm(exact) < 4e-5


def test_rows_columns_and_cells_of_any_size_share_the_waves_behind_a_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    """Waves of three lines are worked out once at each of two depths, and to rounding the shadow is what it is without
    sharing. (Planted: waves kept whatever their wavelength; whatever the depth.)"""
    geometry = CameraGeometry(pixels=64, mask_distance=1.7)  # waves of which no other test has kept
    lines = Spectrum(np.array([638.0, 520.0, 445.0]), np.array([0.5, 0.3, 0.2]))
    cells = {
        count: (
            Directions.cells(np.linspace(-0.15, 0.15, count + 1)),
            Directions.cells(np.linspace(-0.14, 0.16, count + 1)),
        )
        for count in (16, 32)
    }

    def shadows() -> list[np.ndarray]:
        found = [shadow_terms(geometry, *axes, depth, lines) for axes in cells.values() for depth in (400.0, 390.0)]
        return [factor for terms in found for term in terms for factor in term]

    made = list[float]()
    prepare = EdgeWaves.__init__

    def count(waves: EdgeWaves, wavelength_nm: float, *others: float, **options: bool) -> None:
        made.append(wavelength_nm)
        prepare(waves, wavelength_nm, *others, **options)

    monkeypatch.setattr(EdgeWaves, "__init__", count)
    shared = shadows()
    assert sorted(made) == [445.0, 445.0, 520.0, 520.0, 638.0, 638.0]
    monkeypatch.setattr(diffraction, "_LARGEST_KEPT", 0)
    for one, other in zip(shared, shadows(), strict=True):
        assert np.allclose(one, other, rtol=0, atol=1e-11)
    assert len(made) == 6 + 24
