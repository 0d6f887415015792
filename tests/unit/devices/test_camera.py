"""The camera model: numbers in, pixel grid, mask and the shadow's terms out."""

from pathlib import Path

import numpy as np
import pytest

from mitsim.core.configuration import validate
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry, MaskProfile
from mitsim.devices.projector import Spectrum
from mitsim.optics.shadow import Directions
from mitsim.optics.terms import shadow_terms


def test_a_region_of_a_sensor_that_is_not_square_lies_where_it_does() -> None:
    """By hand; light is followed to the square of the longer side."""
    camera = CameraGeometry(pixels=6, rows=4, row_pitch=0.2, pixel_pitch=0.1, pixel_fill_factor=0.25)
    assert (camera.shape, camera.frame_shape, camera.pitches) == ((4, 6), (4, 6), (0.2, 0.1))
    assert camera.half_width == pytest.approx(0.4) and camera.active_sides == pytest.approx((0.1, 0.05))
    part = camera.model_copy(update={"roi": (1, 2, 3, 2)})
    assert part.frame_shape == (3, 2) and part.frame_side == pytest.approx(6**0.5) and part.half_width == 0.4
    np.testing.assert_allclose(part.centres(0), [-0.1, 0.1, 0.3])
    np.testing.assert_allclose(part.centres(1), [-0.05, 0.05])
    assert not part.axes_alike and CameraGeometry(pixels=6).axes_alike
    assert not CameraGeometry(pixels=6, roi=(0, 1, 5, 5)).axes_alike
    known = {"rows", "row_pitch", "roi"}
    assert known < set(part.identity) and "columns" not in part.identity and not known & set(CameraGeometry().identity)


@pytest.mark.parametrize("kind", ["separable", "flatcam"])
@pytest.mark.parametrize("spectrum", [None, Spectrum([500.0, 600.0], [0.3, 0.7])])
def test_shadows_on_tall_pixels_are_means_of_those_on_small_ones(kind: str, spectrum: Spectrum | None) -> None:
    """Rows 2 to 4 of pixels of two rows each, columns 3 to 7; off the axis. (Planted: columns of the whole sensor; the
    row's number as the column's; the width of a pixel as its height.)"""
    rows, columns = Directions.cells(np.linspace(-0.1, 0.12, 6)), Directions.cells(np.linspace(-0.05, 0.1, 5))
    small = CameraGeometry(pixels=12, pixel_pitch=0.02, mask=kind, mask_order=6, mask_offset_row=0.03)
    tall = small.model_copy(update={"rows": 6, "columns": 12, "row_pitch": 0.04, "roi": (2, 3, 3, 5)})
    got, whole = (shadow_terms(camera, rows, columns, 300.0, spectrum) for camera in (tall, small))
    for (left, right), (every_left, every_right) in zip(got, whole, strict=True):
        assert np.allclose(left, (every_left[4:10:2] + every_left[5:10:2]) / 2, rtol=0, atol=1e-9)
        assert np.allclose(right, every_right[3:8], rtol=0, atol=1e-12)
    chosen = shadow_terms(tall, rows, columns, 300.0, spectrum, ((0, 2), (1, 3, 4)))
    for (left, right), (every_left, every_right) in zip(chosen, got, strict=True):
        assert np.allclose(left, every_left[[0, 2]], rtol=0, atol=1e-12)
        assert np.allclose(right, every_right[[1, 3, 4]], rtol=0, atol=1e-12)


def test_tall_pixels_behind_a_mask_on_a_raster_are_refused() -> None:
    """Its cells are square. A mask of one term has no raster. (Planted: let pass.)"""
    tall = CameraGeometry(pixels=8, row_pitch=0.02)
    with pytest.raises(MitsimError, match=r"row_pitch: got 0\.02 beside pixel_pitch 0\.01172; .* must be square"):
        MaskProfile(kind="separable", feature_mm=0.06, order=5, rotation_deg=1.0).put_on(tall, Path())
    assert MaskProfile(kind="flatcam", feature_mm=0.06, order=5).put_on(tall, Path()).row_pitch == 0.02


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("rows", 0), ("pixels", 8193), ("roi", (0, 1, 3, 512)), ("roi", (0, 0, 0, 3)), ("pixels", 2.5)),
        *(("pixel_pitch", float("nan")), ("mask_order", 1), ("mask_distance", float("inf"))),
        *(("mask_thickness", -0.1), ("pixel_fill_factor", 0.0), ("angular_exponent", -1.0), ("fov", 1e-6)),
        *(("pixel_fill_factor", 1e-9), ("mask_thickness", True), ("colour", 1)),
    ],
)
def test_bad_numbers_are_refused_in_one_line(field: str, value: object) -> None:
    with pytest.raises(MitsimError, match="here: ") as caught:
        validate(CameraGeometry, {field: value}, "here")
    assert "\n" not in str(caught.value) and field in str(caught.value)


@pytest.mark.parametrize("kind", ["separable", "flatcam", "open"])
def test_shadow_terms_sum_to_the_masks_mean_transmission(kind: str) -> None:
    """Each entry against a plain average of the mask over 200 x 200 points, axis by axis."""
    geometry = CameraGeometry(pixels=3, pixel_pitch=0.05, mask=kind, mask_order=4, mask_distance=3.0)
    rows, columns, depth = np.array([-0.11, -0.02, 0.07]), np.array([-0.06, 0.0, 0.06, 0.12]), 250.0
    terms = shadow_terms(geometry, Directions.cells(rows), Directions.cells(columns), depth)
    mask, edges = geometry.build_mask(), geometry.pixel_edges
    middle = (np.arange(200) + 0.5) / 200

    def crossings(pixel: int, cells: np.ndarray, cell: int) -> np.ndarray:
        u = edges[pixel] + middle[:, None] * 0.05
        tau = cells[cell] + middle[None, :] * (cells[cell + 1] - cells[cell])
        return (u * (1 - 3.0 / depth) + 3.0 * tau).ravel()

    for pixel, cell in ((0, 0), (1, 1), (2, 0)):
        row, column = crossings(pixel, rows, cell), crossings(2 - pixel, columns, cell + 1)
        pick = np.random.default_rng(pixel).integers(0, 40_000, size=(2, 200_000))
        sampled = mask.transmission(row[pick[0]], column[pick[1]]).mean()
        closed = sum(left[pixel, cell] * right[2 - pixel, cell + 1] for left, right in terms)
        # 200 000 pairs: standard deviation of a 0..1 transmission at most 0.0012; five of them.
        assert closed == pytest.approx(sampled, abs=0.006)


@pytest.mark.parametrize("kind", ["separable", "flatcam", "open"])
@pytest.mark.parametrize("spectrum", [None, Spectrum([500.0, 600.0], [0.3, 0.7])])
def test_a_fill_factor_averages_over_the_active_square_and_scales_by_it(kind: str, spectrum: Spectrum | None) -> None:
    """Pixels of pitch p, a quarter active, are every second pixel of pitch p / 2, shifted to its centre."""
    at = Directions(np.linspace(-0.15, 0.15, 7), 0.001)
    camera = CameraGeometry(pixels=9, pixel_pitch=0.04, mask=kind, mask_order=6, pixel_fill_factor=0.25)
    # 19 pixels of 0.02: numbers 1, 3, ... 17 have the centres of the nine.
    fine = camera.model_copy(update={"pixels": 19, "pixel_pitch": 0.02, "pixel_fill_factor": 1.0})
    got, parts = shadow_terms(camera, at, at, 300.0, spectrum), shadow_terms(fine, at, at, 300.0, spectrum)
    assert len(got) == len(parts)
    for (left, right), (every_left, every_right) in zip(got, parts, strict=True):
        assert np.allclose(left, 0.25 * every_left[1::2], rtol=0, atol=1e-9)
        assert np.allclose(right, every_right[1::2], rtol=0, atol=1e-9)


def test_rows_and_columns_each_take_their_own_directions() -> None:
    rows, columns = Directions([-0.03, 0.04], 0.001), Directions([0.0, 0.02, 0.05], 0.0)
    for extra in ({}, {"mask_thickness": 0.05}):
        camera = CameraGeometry(pixels=8, mask_order=5, **extra)
        for spectrum in (None, Spectrum([550.0], [1.0])):
            ((left, right),) = shadow_terms(camera, rows, columns, 400.0, spectrum)
            ((swapped_left, swapped_right),) = shadow_terms(camera, columns, rows, 400.0, spectrum)
            assert left.shape == (8, 2) and right.shape == (8, 3)
            assert np.array_equal(left, swapped_right) and np.array_equal(right, swapped_left)
            assert not np.allclose(left[:, 0], left[:, 1])
