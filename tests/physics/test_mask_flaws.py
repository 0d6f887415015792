"""Shadows of masks that are blurred, turned and tilted, against drawings of them and rays counted.

Rationale: a drawing of a flawed mask, in pixels of 1 um, is that mask; so is what the mask says of single points.

Shadows of tilted masks against rays counted through the mask where each crosses it, Fresnel's integrals, and the
reference estimator.

Rationale: the factored form moves profiles by what the other axis says, between nodes; a ray knows nothing of that.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage, special
from scipy.special import fresnel

from mitsim.api.bench import open_bench
from mitsim.core.configuration import shipped_path
from mitsim.devices.camera import CameraGeometry, MaskProfile
from mitsim.devices.mask import Plate, mls_mask
from mitsim.devices.projector import Spectrum
from mitsim.optics.fft_shadow import SampledTerm, geometric_samplers, wave_samplers
from mitsim.optics.shadow import Directions
from mitsim.optics.terms import shadow_terms
from mitsim.planner.planner import SceneFacts

BARE = CameraGeometry(pixels=40, mask_offset_row=0.0131)
AT = Directions(np.linspace(-0.1, 0.12, 7), 0.003)
UNIT = 60
"""Drawn pixels a feature: 1 um each."""
LINES = Spectrum(np.array([450.0, 638.0]), np.array([0.4, 0.6]))


def made(**fields: object) -> CameraGeometry:
    return MaskProfile.model_validate({"kind": "separable", "feature_mm": 0.06, "order": 5, **fields}).put_on(
        BARE, Path()
    )


def profile() -> np.ndarray:
    """The code of order 5 in drawn pixels, 20 more on each side."""
    return np.pad(mls_mask(order=5).bits.repeat(UNIT), 20)


def drawn(values: np.ndarray) -> CameraGeometry:
    plate = Plate(0.06 / UNIT, np.outer(values, values), "it")
    return BARE.model_copy(update={"mask": "plate", "mask_plate": plate})


def whole(camera: CameraGeometry, depth: float, spectrum: Spectrum | None = None) -> np.ndarray:
    return sum(np.einsum("ij,kl->ikjl", *term) for term in shadow_terms(camera, AT, AT, depth, spectrum))


def test_a_drawing_of_a_blurred_mask_casts_its_shadow() -> None:
    """Blurred by scipy.ndimage, sigma 6 um; pixels of 1 um smear by 1 / 12 um^2 more, whose effect is that of a twelfth
    of a part in 36 of the blur's own. (Planted: the second box left out; the density's sign.)"""
    blurred, sharp = whole(made(edge_blur_um=6.0), 90.0), whole(made(), 90.0)
    smooth = ndimage.gaussian_filter1d(profile().astype(float), 6.0, truncate=9)
    expected = whole(drawn(np.clip(smooth, 0, 1)), 90.0)
    effect = np.abs(blurred - sharp).max()
    assert effect > 0.05
    np.testing.assert_allclose(blurred, expected, rtol=0, atol=0.003 * effect)
    assert len(shadow_terms(made(edge_blur_um=6.0), AT, AT, 90.0)) == 1


def test_waves_behind_a_blurred_edge_are_those_of_the_root_of_its_transmission() -> None:
    """A drawing with as fine a grid of grey, whose amplitude is the root of each; and energy is kept. (Planted: the
    amplitude blurred for the power.)"""
    smooth = ndimage.gaussian_filter1d(profile().astype(float), 6.0, truncate=9)
    expected = whole(drawn(np.clip(smooth, 0, 1)), 400.0, LINES)
    got = whole(made(edge_blur_um=6.0), 400.0, LINES)
    np.testing.assert_allclose(got, expected, rtol=0, atol=2e-3)
    assert np.abs(got - whole(made(), 400.0, LINES)).max() > 0.02


def mean_over(terms: list[SampledTerm], s: np.ndarray, width: float) -> np.ndarray:
    axes = [[side(s, np.asarray(width)) for side in sides] for _, *sides in terms]
    return sum(weight * np.outer(*axis) for (weight, *_), axis in zip(terms, axes, strict=True))


def test_specular_chains_see_the_same_flaws() -> None:
    """Samplers at points and over 12 um, of a mask off the axis, sharp and blurred, and of a turned one, whose raster
    has edges a cell wide. (Planted: the mask's offset left out.)"""
    s = np.linspace(-0.5, 0.5, 41)
    grey = made(opaque_transmission=0.1)
    expected = grey.build_mask().transmission((s - 0.0131)[:, None], s)
    np.testing.assert_allclose(mean_over(geometric_samplers(grey), s, 0.0), expected, rtol=0, atol=1e-12)
    steps = s + np.linspace(-0.006, 0.006, 1201)[:, None]
    smooth = ndimage.gaussian_filter1d(profile().astype(float), 3.0, truncate=9)
    means = [
        np.interp(steps - at, (np.arange(len(smooth)) + 0.5 - len(smooth) / 2) * 1e-3, smooth) for at in (0.0131, 0)
    ]
    got = mean_over(geometric_samplers(made(edge_blur_um=3.0)), s, 0.012)
    np.testing.assert_allclose(got, np.outer(*(mean.mean(axis=0) for mean in means)), rtol=0, atol=2e-3)
    turned = made(rotation_deg=3.0)
    got = mean_over(geometric_samplers(turned), s, 0.012)
    fine = np.add.outer(s, np.linspace(-0.006, 0.006, 25)).ravel()
    seen = turned.build_mask().transmission((fine - 0.0131)[:, None], fine).reshape(41, 25, 41, 25).mean(axis=(1, 3))
    assert np.abs(got - seen).mean() < 0.02 < seen.std()
    assert np.abs(mean_over(wave_samplers(turned, LINES, 400.0, (0.0, 0.0)), s, 0.012) - seen).mean() < 0.2


def test_a_frame_equals_rays_counted_through_a_turned_mask() -> None:
    """A point source: its rays to 30 x 30 points of each pixel. (Planted: turned the other way; rows for columns.)"""
    random = {"kind": "random", "feature_mm": 0.06, "features": 31, "rotation_deg": 3.0}
    camera = MaskProfile.model_validate(random).put_on(BARE, Path())
    plate = camera.build_mask()
    tau, depth = np.array([0.03, -0.02]), 30.0
    fine = (np.arange(40 * 30) + 0.5) / 30 * 0.01172 - camera.half_width
    row, column = (fine * (1 - 2 / depth) + at * 2 - off for at, off in zip(tau, camera.mask_offset, strict=True))
    counted = plate.transmission(row[:, None], column).reshape(40, 30, 40, 30).mean(axis=(1, 3))
    rows, columns = (Directions([at], 0.0) for at in tau)
    frame = sum(left @ right.T for left, right in shadow_terms(camera, rows, columns, depth))
    # The raster of a turned mask has its own smear, sqrt(1 / 6) / 4 pixel.
    assert np.sqrt(np.mean(np.square(frame - counted))) < 0.02 and counted.std() > 0.2


def test_the_reference_meets_turned_blurred_and_tilted_masks(variant: str) -> None:
    """Ray by ray: the weight is the mask's own transmission where the ray crosses its plane, a tilted one in space; and
    behind a blurred edge it is, on the mean, the normal distribution function. (Planted: tilt of rows for columns;
    turned the other way; no move.)"""
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": 40, "height": 40, "rfilter": {"type": "box"}}
    sensor = mi.load_dict({"type": "mitsim_lensless", "film": film})
    samples = np.random.default_rng(5).random((4, 40_000)).astype(np.float32)
    drawn_samples = mi.Point2f(*samples[:2]), mi.Point2f(*samples[2:])

    def rays(camera: CameraGeometry) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        sensor.wear(camera)
        ray, weight = sensor.sample_ray(0.0, 0.5, *drawn_samples)
        origin, way, light = np.array(ray.o).T, np.array(ray.d).T, np.array(weight).ravel()
        return origin, way / way[:, 2:], light / ((2 * camera.tan_half_fov) ** 2 * way[:, 2] ** 4)

    camera = MaskProfile.model_validate(
        {"kind": "random", "feature_mm": 0.06, "features": 31, "rotation_deg": 5.0, "tilt_row_mrad": 40.0,
         "tilt_column_mrad": -25.0}
    ).put_on(BARE, Path())  # fmt: skip
    origin, way, light = rays(camera)
    plate = camera.build_mask()
    # The tilted plane: z = d + tan(a) (row - o) + tan(b) column; index coordinates are -y and -x.
    slope = np.tan([0.040, -0.025])
    centre = np.array([0.0131, 0.0])
    start, along = -origin[:, 1::-1], -way[:, 1::-1]
    path = (2 + (start - centre) @ slope) / (1 - along @ slope)
    place = (start + path[:, None] * along - centre) * np.sqrt(1 + slope**2)
    known = plate.transmission(*place.T)
    part = light[light > 0].max()
    same = np.abs(light / part - known) < 1e-3
    assert same.mean() > 0.999 and 0.2 < known.mean() < 0.9  # float32 at edges
    even = plate.transmission(*(start + 2 * along - centre).T)
    assert np.mean(even != known) > 0.01

    blurred = BARE.model_copy(
        update={"mask": "plate", "mask_plate": MaskProfile(
            kind="open", feature_mm=0.06, order=4, edge_blur_um=20.0).plate(Path()), "mask_offset_row": 0.0}
    )  # fmt: skip
    origin, way, light = rays(blurred)
    place = -(origin + 2 * way)[:, 1::-1]
    edge = special.ndtr((place + 0.45) / 0.02) - special.ndtr((place - 0.45) / 0.02)
    near = np.abs(place).max(axis=1) < 0.55
    part = light[light > 0].max()
    expected = edge.prod(axis=1)[near]
    error = np.sqrt((expected * (1 - expected)).sum()) / near.sum()
    assert abs((light[near] / part).mean() - expected.mean()) < 5 * error and error < 0.01
    outer = near & (np.abs(place[:, 0]) > 0.45)
    expected = edge.prod(axis=1)[outer]
    error = np.sqrt((expected * (1 - expected)).sum()) / outer.sum()
    assert abs((light[outer] / part).mean() - expected.mean()) < 5 * error and expected.mean() > 10 * error


# -------- Tilted masks

TILTED = CameraGeometry(pixels=96, pixel_pitch=0.03, mask_offset_row=0.1, mask_offset_column=-0.21)
LINE = Spectrum(np.array([550.0]), np.array([1.0]))


def tilted_camera(kind: str, row: float, column: float, bare: CameraGeometry = TILTED) -> CameraGeometry:
    own = {"features": 127} if kind == "mura" else {"order": 7}
    table = {"kind": kind, "feature_mm": 0.06, "tilt_row_mrad": row, "tilt_column_mrad": column, **own}
    return MaskProfile.model_validate(table).put_on(bare, Path())


def met(camera: CameraGeometry, tau: tuple[float, float], depth: float, fine: np.ndarray) -> tuple[np.ndarray, ...]:
    """Where rays from sensor points (``fine``, ``fine``) to a point at ``depth`` cross the tilted mask, in coordinates
    of the mask, and how far from the sensor."""
    slope = np.tan(np.multiply(camera.mask_plate.flaws.tilt_mrad, 1e-3))
    across = [at - fine / depth for at in tau]
    start = [fine - off for off in camera.mask_offset]
    leaning = slope[0] * start[0][:, None] + slope[1] * start[1]
    path = (camera.mask_distance + leaning) / (1 - slope[0] * across[0][:, None] - slope[1] * across[1])
    row = (start[0][:, None] + path * across[0][:, None]) * np.hypot(1, slope[0])
    return row, (start[1] + path * across[1]) * np.hypot(1, slope[1]), path


def frame_of(
    camera: CameraGeometry, tau: tuple[float, float], depth: float, spectrum: Spectrum | None = None
) -> np.ndarray:
    rows, columns = (Directions([each], 0.0) for each in tau)
    return sum(left @ right.T for left, right in shadow_terms(camera, rows, columns, depth, spectrum))


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(
    ("kind", "tilt"), [("separable", (30.0, 0.0)), ("flatcam", (-15.0, 18.0)), ("mura", (0.0, 30.0))]
)
def test_a_frame_equals_rays_counted_through_a_tilted_mask(kind: str, tilt: tuple[float, float]) -> None:
    """Off the axis, obliquely, near by. Counting is off by up to 1/48 of a pixel at each edge, as an even mask shows;
    what the form leaves besides is less than half of that. (Planted: tilt of rows for columns; the other axis's part
    left out; weights of rows for columns; no offset; the slope without u / z.)"""
    camera, even = tilted_camera(kind, *tilt), tilted_camera(kind, 1e-9, 0.0)
    assert camera.tilt_nodes(waves=False) is not None and not camera.tilt_left_out(waves=False)
    tau, depth, points, pixels = (0.15, -0.12), 60.0, 24, TILTED.pixels
    fine = (np.arange(pixels * points) + 0.5) / points * TILTED.pixel_pitch - TILTED.half_width
    shape = pixels, points, pixels, points

    def counted(seen: CameraGeometry) -> np.ndarray:
        return seen.mask_plate.transmission(*met(seen, tau, depth, fine)[:2]).reshape(shape).mean(axis=(1, 3))

    expected, flat = counted(camera), frame_of(even, tau, depth)
    floor = rms(flat - counted(even))
    assert rms(frame_of(camera, tau, depth) - expected) < 1.1 * floor < 0.01
    assert rms(flat - expected) > 6 * floor


def test_waves_behind_a_tilted_mask_are_fresnels_integrals() -> None:
    """Of a point, on 5 x 5 pixels of 5 um at 8 x 8 points, each as far behind the mask as it is: beside the mask's
    centre, 2.3 % nearer than at it, where fringes are narrower. The grid of waves leaves half as
    much of an even mask's.
    (Planted: waves of the even place; one distance for all; the other axis's part of it left out.)"""
    bare = CameraGeometry(pixels=64, pixel_pitch=0.005, mask_offset_row=1.5, mask_offset_column=-0.21)
    camera, even = tilted_camera("separable", 30.0, 0.0, bare), tilted_camera("separable", 1e-9, 0.0, bare)
    tau, depth, chosen = (0.15, -0.12), 60.0, np.arange(4, 64, 13)
    fine = ((np.arange(8) + 0.5) / 8 + chosen[:, None]).ravel() * bare.pixel_pitch - bare.half_width
    bits = np.pad(camera.mask_plate.values.max(axis=0), 1)
    edges, jumps = (np.arange(128) - 63.5) * 0.06, np.diff(bits)

    def integrated(one: CameraGeometry, flat: float | None = None) -> np.ndarray:
        *places, path = met(one, tau, depth, fine)
        far = path if flat is None else np.full(path.shape, flat)
        light = np.ones_like(path)
        for place in places:
            field = np.zeros(path.shape, dtype=complex)
            for edge, jump in zip(edges[jumps != 0], jumps[jumps != 0], strict=True):
                sine, cosine = fresnel((place - edge) * np.sqrt(2 / (550e-6 * far * (depth - far) / depth)))
                field += jump * (0.5 + (0.5 - 0.5j) * (cosine + 1j * sine))
            light *= np.square(np.abs(field))
        return light.reshape(5, 8, 5, 8).mean(axis=(1, 3))

    expected = integrated(camera)
    got, flat = (frame_of(one, tau, depth, LINE)[np.ix_(chosen, chosen)] for one in (camera, even))
    floor, one_distance = rms(flat - integrated(even)), rms(integrated(camera, 2.0) - expected)
    assert rms(got - expected) < 2 * floor < 0.4 * one_distance < 0.2 * rms(flat - expected)


@pytest.mark.slow
def test_the_reference_tilts_its_mask_alike(small_scene: Callable[..., Path], variant: str, tmp_path: Path) -> None:
    """Slope of what the tilt changes in the reference's frame on what it changes in the factored one, 8 seeds of 256
    samples a pixel: 1 to five standard errors of their mean. (Planted: the sign; rows for columns.)"""
    text = shipped_path("calibration", "imx249.toml").read_text(encoding="utf-8")
    benches = []
    for name, tilt in (("even", 1e-9), ("tilted", 80.0)):
        table = f'kind = "separable"\nfeature_mm = 0.06\norder = 7\ntilt_column_mrad = {tilt}\n'
        (tmp_path / f"{name}.toml").write_text(f"{text}\n[mask]\n{table}", encoding="utf-8")
        benches.append(open_bench(small_scene(mask_order=7), variant, tmp_path / f"{name}.toml"))
    assert not SceneFacts.of(benches[1]).warnings
    effects = {"diffraction": False, "black-level": False}
    even, tilted = (bench.render("factored", effects=effects).mean for bench in benches)
    change = tilted - even
    assert np.linalg.norm(change) > 0.01 * np.linalg.norm(even)
    seeds = [benches[1].render("reference", spp=256, seed=seed).mean for seed in range(8)]
    slopes = np.array([np.vdot(frame - even, change) / np.vdot(change, change) for frame in seeds])
    error = slopes.std(ddof=1) / 8**0.5
    assert error < 0.15 and abs(slopes.mean() - 1) < 5 * error, (slopes, error)
