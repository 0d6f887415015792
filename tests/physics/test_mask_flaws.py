"""Shadows of masks that are blurred, turned and tilted, against drawings of them and rays counted.

Rationale: a drawing of a flawed mask, in pixels of 1 um, is that mask; so is what the mask says of single points.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy import ndimage, special

from mitsim.devices.camera import CameraGeometry, MaskProfile
from mitsim.devices.mask import Plate, mls_mask
from mitsim.devices.projector import Spectrum
from mitsim.optics.fft_shadow import SampledTerm, geometric_samplers, wave_samplers
from mitsim.optics.shadow import Directions
from mitsim.optics.terms import shadow_terms

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
