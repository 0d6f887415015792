"""Computed speckle contrast against fields of a rough surface that are added up, point by point and beam by beam."""

import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtri

from mitsim.core.arrays import single_threaded_blas, stream
from mitsim.devices.camera import CameraGeometry, Devices
from mitsim.devices.projector import Coherence, ProjectorModel
from mitsim.optics.frames import add_speckle, contrast_of
from tests.invented import sensor

LIGHT = np.full((400, 500), 3.0)
ALPHA = 1e-4  # of each test below; 200 000 pixels


def test_without_contrast_light_passes_unchanged() -> None:
    assert add_speckle(LIGHT, 0.0, stream(0, "speckle")) is LIGHT


@pytest.mark.parametrize("contrast", [0.02, 0.3, 1.0])
def test_speckle_follows_the_gamma_law_of_its_contrast(contrast: float) -> None:
    found = add_speckle(LIGHT, contrast, stream(1, "speckle")).ravel() / 3.0
    limit = stats.norm.isf(ALPHA / 2)
    assert abs(found.mean() - 1) < limit * contrast / found.size**0.5
    assert stats.kstest(found, stats.gamma(contrast**-2, scale=contrast**2).cdf).pvalue > ALPHA
    # Pixels are independent: neighbours are uncorrelated.
    field = found.reshape(LIGHT.shape) - 1
    correlation = (field[:, 1:] * field[:, :-1]).mean() / contrast**2
    assert abs(correlation) < limit / found.size**0.5


def test_dark_pixels_stay_dark() -> None:
    assert not add_speckle(np.zeros((4, 4)), 0.5, stream(2, "speckle")).any()


# -------- speckle contrast

N, POINTS, SIDE = 8, 6, 0.5  # projector pixels a side, points a pixel, a pixel's side [mm]
DISTANCE, PITCH, FEATURE, MASK = 100.0, 0.03, 0.02, 2.0
WAVELENGTH = 600.0
LINES = (638.0, 520.0, 445.0)


def devices(
    mask: str = "open", pitch: float = PITCH, lines: tuple[float, ...] = (WAVELENGTH,), **coherence: float
) -> Devices:
    camera = CameraGeometry(
        pixels=8, pixel_pitch=pitch, mask=mask, mask_feature=FEATURE, mask_distance=MASK, scene_distance=DISTANCE
    )
    projector = ProjectorModel(
        name="laser", effective_wavelength_nm=WAVELENGTH, wavelengths_nm=lines,
        radiant_shares=tuple(1 / wave for wave in lines), speckle=Coherence(**coherence),
    )  # fmt: skip
    return Devices(camera, sensor(), projector, "test")


def codes(rng: np.random.Generator, points: np.ndarray, mask: str) -> np.ndarray:
    """What of each point a pixel sees through a random code of features at a random place."""
    if mask == "open":
        return np.ones((len(points), len(points)))
    on_mask = points * MASK / DISTANCE / FEATURE
    row, column = (
        rng.integers(0, 2, 64)[np.floor(on_mask - on_mask.min() + rng.random()).astype(int)] for _ in range(2)
    )
    return np.outer(row, column) if mask == "separable" else (1 + np.outer(2 * row - 1, 2 * column - 1)) / 2


def simulated(lit: np.ndarray, mask: str, beam: float | None, count: int) -> tuple[float, float]:
    """Contrast of pixels' light over independent surfaces and places of the mask, and its standard error: speckle's
    energy over that of the light which the mask lets through in the mean."""
    rng, points = np.random.default_rng(5), (np.arange(N * POINTS) + 0.5 - N * POINTS / 2) * SIDE / POINTS
    source = np.sqrt(np.kron(lit, np.ones((POINTS, POINTS))))
    places = (np.arange(5) + 0.5) / 5 * PITCH
    waves = np.exp(2j * np.pi * points * places[:, None] / (WAVELENGTH * 1e-6 * DISTANCE))
    # Amplitude of a beam of 1/e^2 radius r at each of its places, which overlap by half.
    stops = np.arange(points[0] - 2 * (beam or 1), points[-1] + 2 * (beam or 1), (beam or 1) / 2)
    beams = np.ones((1, len(points))) if beam is None else np.exp(-np.square((points - stops[:, None]) / beam))
    rows = (beams[:, None] * waves).reshape(-1, len(points))
    power = (np.square(beams).sum(axis=0)[:, None] * np.square(beams).sum(axis=0)).astype(float)
    values, means = [], []
    for _ in range(count):
        seen = source * np.sqrt(codes(rng, points, mask))
        field = rows @ (seen * np.exp(2j * np.pi * rng.random(source.shape))) @ rows.T
        mean = (np.square(seen) * power).sum()
        values.append(np.square(np.abs(field)).sum() / len(places) ** 2)
        means.append(mean)
    energy = np.square(np.array(values) - means).reshape(20, -1).mean(axis=1) / np.mean(np.square(means))
    contrast = float(np.sqrt(energy.mean()))
    return contrast, float(energy.std(ddof=1) / np.sqrt(20) / (2 * contrast))


@pytest.mark.parametrize(
    ("mask", "beam", "dots"),
    [
        ("open", None, 1),
        ("flatcam", 0.4, 1),
        ("separable", 0.4, 4),
        pytest.param("open", 0.4, 4, marks=pytest.mark.slow),
        pytest.param("separable", 0.4, 1, marks=pytest.mark.slow),
    ],
)
def test_it_is_that_of_fields_added_up(mask: str, beam: float | None, dots: int) -> None:
    lit = np.zeros((N, N))
    lit[::dots, ::dots] = 1
    coherence = {} if beam is None else {"beam_radius_mm": beam}
    found = contrast_of(devices(mask, **coherence), (SIDE, SIDE), lit)
    with single_threaded_blas():  # the products are small
        expected, error = simulated(lit, mask, beam, 1000)
    # Four standard errors, and 3 % for points that are a sixth of a pixel apart.
    assert found * np.sqrt(2) == pytest.approx(expected, abs=4 * error + 0.03 * expected)


@pytest.mark.parametrize(("roughness_um", "linewidth_nm"), [(0.15, 0.0), (20.0, 2.0)])
def test_lines_are_as_coherent_as_the_surface_is_smooth(roughness_um: float, linewidth_nm: float) -> None:
    """Fields of 60 points of random height, at each of 8 wavelengths of every line; light falls and leaves upright."""
    rng, count, points = np.random.default_rng(8), 6400, 60
    quantiles = (np.arange(8) + 0.5) / 8
    waves = (np.array(LINES)[:, None] + linewidth_nm * ndtri(quantiles)).ravel()
    heights = 1e3 * roughness_um * rng.standard_normal((count, points))
    # A constant phase of a point's own stands for heights of many waves that no difference of wavelengths undoes.
    first = 2 * np.pi * rng.random((count, points))
    fields = [np.exp(1j * (first + 4 * np.pi * heights / wave)).sum(axis=1) for wave in waves]
    light = np.square(np.abs(fields)).mean(axis=0) / points
    given = {"roughness_um": roughness_um, "linewidth_nm": linewidth_nm}
    found = contrast_of(devices(pitch=1e-6, lines=LINES, polarisation=1.0, **given), (SIDE, SIDE), np.ones((N, N)))
    # One in sqrt(2 x 6400) of a standard deviation, four times; 60 points are not quite many.
    assert found == pytest.approx(float(light.std()), rel=4 / np.sqrt(2 * count) + 1 / points)
