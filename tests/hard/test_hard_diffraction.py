"""Diffraction where its numbers are extreme: against 30-digit Fresnel integrals, sums, and waves not paraxial."""

import math
import time
import tracemalloc
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import mpmath
import numpy as np
import pytest
from scipy.special import fresnel

from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry, MaskProfile
from mitsim.devices.mask import mls_mask
from mitsim.devices.projector import Spectrum
from mitsim.optics.diffraction import EdgeWaves
from mitsim.optics.image_formation import FrameOptics
from mitsim.optics.shadow import Directions, Steps
from mitsim.optics.terms import shadow_terms
from tests.robustness import Recorder

pytestmark = pytest.mark.robustness("Optics")
NM = 550.0
LINE = Spectrum(np.array([NM]), np.array([1.0]))


def test_waves_of_a_mask_near_the_sensor_tend_to_its_shadow(measured: Recorder) -> None:
    """Relative difference over 16 pixels from 20 um down to 10 nm: it falls with the root of lambda d at least.

    Each edge sends light over sqrt(lambda d), 74 nm at 10 nm, of a pixel's 11.72 um. Below 4 nm at 512 pixels the grid
    is refused, in one line.
    """
    at = Directions([-0.1, 0.02], 0.002)
    errors = []
    for distance in (2e-2, 1e-3, 1e-4, 1e-5):
        geometry = CameraGeometry(pixels=16, mask_order=5, mask_distance=distance)
        ((wave, _),), ((rays, _),) = (shadow_terms(geometry, at, at, 400.0, light) for light in (LINE, None))
        assert np.isfinite(wave).all() and wave.min() > -1e-9
        errors.append(float(np.linalg.norm(wave - rays) / np.linalg.norm(rays)))
    measured(errors[0], at_most=0.2, what="20 um")
    measured(errors[-1], at_most=1e-3, what="10 nm")
    for (near, far), (small, large) in zip(pairwise(errors), pairwise((2e-2, 1e-3, 1e-4, 1e-5)), strict=True):
        assert far / near < 1.3 * math.sqrt(large / small)
    with pytest.raises(MitsimError, match=r"^mask: its diffraction[^\n]*move the mask off sensor[^\n]*$"):
        shadow_terms(CameraGeometry(mask_distance=1e-9), at, at, 400.0, LINE)


def edge_wave(x: float, product: float) -> mpmath.mpc:
    """E(x) of a half plane, x [mm] and lambda D [mm^2], with 30 digits."""
    with mpmath.workdps(30):
        v = mpmath.mpf(x) * mpmath.sqrt(2 / mpmath.mpf(product))
        return mpmath.mpf(1) / 2 + mpmath.mpc(1, -1) / 2 * mpmath.mpc(mpmath.fresnelc(v), mpmath.fresnels(v))


@pytest.mark.parametrize("x", [10.0**k for k in range(-8, 7)])
def test_fresnel_integrals_keep_their_digits_from_1e_8_to_1e6(measured: Recorder, x: float) -> None:
    """What waves are made of, against mpmath: 2e-15; of the oscillation 1 / (pi x) at 1e6 nine digits are left."""
    sine, cosine = fresnel(x)
    with mpmath.workdps(30):
        assert abs(sine - mpmath.fresnels(x)) < 1e-16 + 2e-16 * abs(mpmath.fresnels(x))
        measured(abs(cosine - mpmath.fresnelc(x)), at_most=2.5e-15)


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


def exact_waves(geometry: CameraGeometry, step: float) -> np.ndarray:
    """(pixels,) means of |U|^2 of a wave at normal incidence by the transfer function of free space, not paraxial."""
    count = 1 << 16
    s = (np.arange(count) - count / 2 + 0.5) * step
    bits = mls_mask(order=geometry.mask_order).bits
    index = np.floor(s / geometry.mask_feature + len(bits) / 2).astype(int)
    aperture = np.where((index >= 0) & (index < len(bits)), bits[np.clip(index, 0, len(bits) - 1)], 0.0)
    wavelength, f = NM * 1e-6, np.fft.fftfreq(count, step)
    root = np.sqrt(np.asarray(1 - (wavelength * f) ** 2, complex))
    transfer = np.exp(2j * np.pi * geometry.mask_distance / wavelength * (root - 1))
    upto = np.concatenate(([0.0], np.cumsum(np.abs(np.fft.ifft(np.fft.fft(aperture) * transfer)) ** 2))) * step
    edges = np.interp(geometry.pixel_edges, np.append(s - step / 2, s[-1] + step / 2), upto)
    return np.diff(edges) / geometry.pixel_pitch


@pytest.mark.parametrize(
    ("feature", "left"),
    [(1e-3, 0.05), (2e-3, 0.03), (5e-3, 0.015), (2e-2, 0.01), (0.06, 0.01), (0.2, 0.01), (1.0, 0.01)],
)
def test_features_from_a_micrometre_to_a_millimetre(measured: Recorder, feature: float, left: float) -> None:
    """A mask 0.2 mm away, wave by wave against scalar theory without the paraxial approximation.

    Paraxial waves leave 4 % at 1 um, where light spreads over tangents of 0.5, and 1 % from 20 um on.
    """
    # Features of whole steps; the widest mask, 3 mm, fits the 16 mm of the grid.
    order = 5 if feature <= 0.2 else 2
    geometry = CameraGeometry(pixels=64, mask_order=order, mask_feature=feature, mask_distance=0.2)
    at = Directions([0.0], 0.0)
    ((wave, _),) = shadow_terms(geometry, at, at, math.inf, LINE)
    exact = exact_waves(geometry, 2.5e-4)
    assert np.isfinite(wave).all() and wave.min() > -1e-9
    error = float(np.linalg.norm(wave[:, 0] - exact) / np.linalg.norm(exact))
    measured(error, at_most=left)


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
