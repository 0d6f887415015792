"""From beams to frames: conservation of flux, the mask's samplers, what falls where; beams are made by hand.

Computed speckle contrast against fields of a rough surface that are added up, point by point and beam by beam.
"""

import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtri

from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import stream
from mitsim.devices.camera import CameraGeometry, Devices
from mitsim.devices.projector import Coherence, ProjectorModel, Spectrum
from mitsim.optics import frames as module
from mitsim.optics.fft_shadow import geometric_samplers, wave_samplers
from mitsim.optics.frames import Beams, _cuts, add_speckle, contrast_of, specular_frames
from tests.invented import sensor

PITCH = 0.05
LABELS = np.arange(9) % 3


def geometry(mask: str = "open", **numbers: object) -> CameraGeometry:
    return CameraGeometry(**{"pixels": 16, "pixel_pitch": PITCH, "mask": mask, "fov": 60, **numbers})


def beams(corners: np.ndarray, pixel: int = 4, flux: float = 2.0, depth: float = 800.0, **changes: object) -> Beams:
    """One beam with corners (2, 2, 2) [mm] from a virtual source on the axis."""
    sensor = np.asarray(corners, dtype=float)[None]
    values = {"tangent": -sensor / depth, "throughput": np.ones((1, 2, 2)), **changes}
    return Beams(np.array([pixel]), np.array([flux]), sensor, values["tangent"], values["throughput"], 0.25)


def square(low: tuple[float, float], high: tuple[float, float]) -> np.ndarray:
    rows, columns = np.meshgrid([low[0], high[0]], [low[1], high[1]], indexing="ij")
    return np.stack([rows, columns], axis=-1)


def turned(angle: float, side: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return square((-side / 2, -side / 2), (side / 2, side / 2)) @ np.array([[c, s], [-s, c]])


@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 4, np.pi / 2, 2.5])
def test_a_beam_on_the_sensor_keeps_its_flux(angle: float) -> None:
    found = specular_frames(beams(turned(angle, 0.4)), geometry(), geometric_samplers(geometry()), LABELS)
    assert found.irradiance.sum() * PITCH**2 == pytest.approx(2.0, rel=1e-12)
    assert found.classes.tolist() == [1]


def test_a_beam_aligned_with_the_pixels_covers_parts_of_them_exactly() -> None:
    low, high = (-0.13, 0.02), (0.21, 0.377)
    frame = specular_frames(beams(square(low, high)), geometry(), geometric_samplers(geometry()), LABELS).irradiance[0]
    edges = geometry().pixel_edges
    cover = [
        np.maximum(np.minimum(edges[1:], b) - np.maximum(edges[:-1], a), 0) / PITCH
        for a, b in zip(low, high, strict=True)
    ]
    area = (high[0] - low[0]) * (high[1] - low[1])
    assert np.allclose(frame, 2.0 / area * np.outer(*cover), rtol=0, atol=1e-9 * 2.0 / area)


def test_a_part_of_a_sensor_and_tall_pixels_see_what_the_sensor_does() -> None:
    """Rows 3 to 12 of 14, columns 2 to 10 of 16, behind a mask; without one pixels of two rows. (Planted: the region's
    first row left out; rows' number or height as columns'.)"""
    lit = beams(turned(0.3, 0.5))

    def frame(camera: CameraGeometry) -> np.ndarray:
        return specular_frames(lit, camera, geometric_samplers(camera), LABELS).irradiance[0]

    whole, part = geometry("separable"), geometry("separable", rows=14, columns=16, roi=(3, 2, 10, 9))
    np.testing.assert_allclose(frame(part), frame(whole)[4:14, 2:11], rtol=0, atol=1e-9)
    every, tall = frame(geometry()), frame(geometry(rows=6, columns=16, row_pitch=2 * PITCH))
    np.testing.assert_allclose(tall, (every[2:14:2] + every[3:14:2]) / 2, rtol=0, atol=1e-9)


def test_the_field_stop_and_a_response_weigh_directions() -> None:
    corners = square((-0.2, -0.2), (0.2, 0.2))
    tangent = np.zeros((1, 2, 2, 2))
    tangent[..., 0] = [[0.0, 0.0], [1.0, 1.0]]  # 0 on the first row, 1 on the last
    args = geometry(), geometric_samplers(geometry()), LABELS
    stop = specular_frames(beams(corners, tangent=tangent), *args, boxes_per_pixel=64).irradiance.sum()
    assert stop * PITCH**2 == pytest.approx(2 * np.tan(np.radians(30)), rel=2e-3)
    # cos^2 theta is 1 / (1 + t^2), of mean pi / 4 over t from 0 to 1.
    wide = geometry(fov=120, angular_exponent=2.0)
    answered = specular_frames(beams(corners, tangent=tangent), wide, geometric_samplers(wide), LABELS, 64)
    assert answered.irradiance.sum() * PITCH**2 == pytest.approx(2 * np.pi / 4, rel=1e-5)


@pytest.mark.parametrize("depth", [800.0, 30.0, 4.0, -50.0])
def test_the_mask_is_magnified_as_from_the_virtual_source(depth: float) -> None:
    """s = u (1 - d/z); a converging beam (z < 0: it would meet behind the sensor) stretches the shadow's code instead.

    The beam ends beside the sensor's edge, so that its boxes lie across the edges of pixels.
    """
    camera = geometry("separable")
    lit = beams(square((-0.41, -0.41), (0.41, 0.41)), depth=depth)
    assert 1 / lit.inverse_depth == pytest.approx(np.full((1, 2), depth))
    frame = specular_frames(lit, camera, geometric_samplers(camera), LABELS).irradiance[0]
    mask = camera.build_mask()
    fine = (np.arange(16 * 4000) + 0.5) / 4000 * PITCH - 0.4
    s = fine * (1 - camera.mask_distance / depth)
    index = np.floor(s / mask.feature_mm + len(mask.bits) / 2).astype(int)
    profile = mask.bits[index].reshape(16, -1).mean(axis=1)
    assert np.allclose(frame, 2 / 0.82**2 * np.outer(profile, profile), rtol=0, atol=2e-3)


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 2, 2.5])
def test_the_virtual_source_is_found_however_a_beam_lies(angle: float) -> None:
    """Tan-angles are linear in place, t = M u: dt_row/du_row and dt_column/du_column are M's diagonal.

    An astigmatic mirror has two depths; what it adds across (off the diagonal) belongs to neither.
    """
    corners = turned(angle, 0.4) @ np.array([[1.0, 0.3], [0.0, 0.7]])
    slopes = np.array([[1 / 500, 1 / 3000], [-1 / 4000, -1 / 200]])
    found = beams(corners, tangent=-(corners @ slopes.T)[None]).inverse_depth
    np.testing.assert_allclose(found, [[1 / 500, -1 / 200]], rtol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 0.1, np.pi / 4, np.pi / 2])
@pytest.mark.parametrize("side", [0.01, 0.06, 0.3, 7.7])
def test_beams_are_cut_into_boxes_that_tile_them_and_are_small_enough(angle: float, side: float) -> None:
    """No side above 0.025 mm, and no more boxes than that takes up to eight, or a quarter more above.

    Askew beams get up to three times as many along each side.
    """
    box = 0.025
    cuts = list(_cuts(beams(turned(angle, side)), np.array([0]), box))
    sizes = {size for *_, size in cuts}
    assert len(sizes) == 1 and sum(len(those) * len(a) * len(b) for those, a, b, _ in cuts) == pytest.approx(
        1 / np.prod(next(iter(sizes)))
    )
    places = np.unique(np.concatenate([a for _, a, *_ in cuts]))
    np.testing.assert_allclose(places, (np.arange(len(places)) + 0.5) * cuts[0][3][0], atol=1e-12)
    # How far from the axes: twice the smaller share of a side in one axis, up to 1.
    finer = 1 + 2 * min(4 * min(abs(np.sin(angle)), abs(np.cos(angle))), 1)
    need = max(side / box * finer, 1)
    for size in cuts[0][3]:
        assert need - 1e-9 <= 1 / size <= max(np.ceil(need), 1.25 * need) + 1e-9


@pytest.mark.parametrize("kind", ["separable", "flatcam"])
def test_wave_samplers_hold_all_that_a_box_at_the_sensor_s_and_the_field_stop_s_edge_sees(kind: str) -> None:
    """A box ends up to a pixel beyond the sensor's edge; a camera with a wider field has its numbers there too."""
    spectrum = Spectrum(np.array([550.0]), np.array([1.0]))
    narrow, wide = (geometry(kind, mask_order=8, fov=fov) for fov in (20, 40))
    edge = narrow.half_width + narrow.mask_distance * narrow.tan_half_fov + PITCH / 2
    ours, theirs = (wave_samplers(camera, spectrum, 400.0, (0.0, 0.0)) for camera in (narrow, wide))
    for (weight, *samplers), (other_weight, *others) in zip(ours, theirs, strict=True):
        assert weight == other_weight
        for sampler, other in zip(samplers, others, strict=True):
            at, width = np.array([-edge, edge]), np.full(2, PITCH)
            np.testing.assert_allclose(sampler(at, width), other(at, width), atol=1e-9)
            assert np.abs(other(at, width)).max() > 0.01, "there is light to lose"


def test_classes_are_told_apart_and_add_up() -> None:
    first, second = beams(square((-0.2, -0.2), (0.2, 0.2)), 4), beams(square((0.0, 0.0), (0.3, 0.3)), 8, 5.0)
    both = Beams(*(np.concatenate([getattr(b, name) for b in (first, second)]) for name in ORDER), 0.5)
    found = specular_frames(both, geometry(), geometric_samplers(geometry()), LABELS)
    assert found.classes.tolist() == [1, 2]
    assert found.irradiance.sum(axis=(1, 2)) * PITCH**2 == pytest.approx([2.0, 5.0])
    one = specular_frames(both, geometry(), geometric_samplers(geometry()), np.zeros(9, np.int64))
    assert np.allclose(one.irradiance[0], found.irradiance.sum(axis=0))


ORDER = ("pixel", "flux", "sensor", "tangent", "throughput")

# -------- Speckle

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
DISTANCE, PIXEL_MM, FEATURE, MASK = 100.0, 0.03, 0.02, 2.0
WAVELENGTH = 600.0
LINES = (638.0, 520.0, 445.0)


def devices(
    mask: str = "open", pitch: float = PIXEL_MM, lines: tuple[float, ...] = (WAVELENGTH,), **coherence: float
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
    places = (np.arange(5) + 0.5) / 5 * PIXEL_MM
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


def test_gradients_of_a_beam_are_its_differences() -> None:
    """Places are bilinear in both sides of a beam, so that central differences are exact. (Planted: one corner for
    another.)"""
    corners = np.random.default_rng(3).normal(size=(2, 2, 2, 2))
    a, b, step = np.array([0.2, 0.7]), np.array([0.1, 0.4, 0.9]), 0.05
    along, across = module._gradients(corners, a, b)
    place = module._bilinear
    by_a = (place(corners, a + step, b) - place(corners, a - step, b)) / (2 * step)
    by_b = (place(corners, a, b + step) - place(corners, a, b - step)) / (2 * step)
    np.testing.assert_allclose(np.broadcast_to(along, by_a.shape), by_a, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.broadcast_to(across, by_b.shape), by_b, rtol=1e-9, atol=1e-12)


def test_frames_of_beams_are_formed_if_there_are_any_and_fit_into_memory() -> None:
    """(Planted: none where there are some; memory of frames that shrinks with the pixels.)"""
    for beams, formed in (([], None), ([1], "frames")):
        light = module.SpecularLight(beams)  # type: ignore[arg-type]
        light._kept = lambda *_: "frames"  # type: ignore[assignment, return-value]
        assert light.frames(np.zeros(4, int), None, None) == formed  # type: ignore[arg-type]
    assert module.at_once(4096) == 1 and module.at_once(64) == 32
