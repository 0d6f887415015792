"""Frames by FFT against the sum of separable terms of the same raster, which is exact."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry, MaskProfile
from mitsim.devices.mask import RASTER_LEFT_OUT, Plate
from mitsim.devices.projector import Spectrum
from mitsim.optics import fft_shadow as rasters
from mitsim.optics import image_formation
from mitsim.optics.image_formation import FrameOptics, anchor_positions, anchor_weights
from mitsim.optics.shadow import Directions, ShadowGeometry, geometric_terms

BARE = CameraGeometry(
    pixels=12, pixel_pitch=0.03, mask_offset_row=0.013, mask_offset_column=-0.04, pixel_fill_factor=0.6, fov=8.0
)
ROWS, COLUMNS = Directions.cells(np.linspace(-0.06, 0.07, 10)), Directions.cells(np.linspace(-0.05, 0.07, 12))


PART = BARE.model_copy(update={"rows": 20, "columns": 12, "roi": (3, 1, 8, 10)})
"""A region of interest of a sensor that is not square, off its middle."""


def turned(bare: CameraGeometry = BARE, **flaws: float) -> CameraGeometry:
    return MaskProfile(kind="separable", feature_mm=0.06, order=6, rotation_deg=2.0, **flaws).put_on(bare, Path())


def summed(camera: CameraGeometry, depth: float, light: np.ndarray) -> np.ndarray:
    """The frame of ``light`` by as many terms as the raster has rows."""
    plate = rasters.raster(camera, depth)
    terms = [(1.0, row, values) for row, values in zip(np.eye(len(plate.values)), plate.values, strict=True)]
    rows = SimpleNamespace(terms=terms, lines=plate.lines, blur_mm=plate.blur_mm, feature_mm=plate.feature_mm)
    shadow = replace(ShadowGeometry.of(camera, depth), mask=rows)
    return camera.pixel_fill_factor * sum(
        left @ light @ right.T for left, right in geometric_terms(shadow, ROWS, COLUMNS)
    )


@pytest.fixture
def correlated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames are correlations, however few terms hold the raster."""
    monkeypatch.setattr(image_formation, "SUMMED_BYTES", -1)


@pytest.mark.usefixtures("correlated")
@pytest.mark.parametrize(("bare", "flaws"), [(BARE, {}), (BARE, {"edge_blur_um": 3.0}), (PART, {})])
def test_a_correlation_is_the_sum_of_all_terms(bare: CameraGeometry, flaws: dict[str, float]) -> None:
    """Off the axis, with a part of each pixel active, blurred. (Planted: a phase's index swapped; X not conjugated; one
    raster cell off; rows' pixels for columns'.)"""
    camera, light = turned(bare, **flaws), np.random.default_rng(0).random((9, 11))
    expected = summed(camera, 300.0, light)
    optics = FrameOptics(camera, ROWS, COLUMNS, (300.0,), 1)
    frame = optics.frame(np.arange(99), light.ravel())
    np.testing.assert_allclose(frame, expected, rtol=0, atol=1e-6 * expected.mean())
    assert expected.std() > 0.1 * expected.mean()


@pytest.mark.usefixtures("correlated")
@pytest.mark.parametrize("bare", [PART, pytest.param(BARE, marks=pytest.mark.slow)])
def test_anchors_layers_and_places_are_those_of_separable_frames(bare: CameraGeometry) -> None:
    """(Planted: weights of rows for columns; places of rows for columns; the second layer left out.)"""
    camera, random = turned(bare), np.random.default_rng(1)
    places = (1, 4, 7), (0, 2, 5, 8)
    optics = FrameOptics(camera, ROWS, COLUMNS, (300.0, 200.0), 2, places=places)
    light = random.random((2, 2, 9, 2, 11)) * (random.random((2, 2, 9, 2, 11)) < 0.3)
    positions = anchor_positions(2, camera.half_width)
    by_row, by_column = (anchor_weights(positions, camera.centres(axis)) for axis in (0, 1))
    expected = np.zeros(camera.frame_shape)
    for depth, of_layer in zip((300.0, 200.0), light, strict=True):
        for row in range(2):
            for column in range(2):
                seen = summed(camera, depth, of_layer[row, :, column])
                expected += by_row[:, row, None] * seen * by_column[:, column]
    flat = np.flatnonzero(light)
    frame = optics.frame(flat, light.ravel()[flat])
    np.testing.assert_allclose(frame, expected[np.ix_(*places)], rtol=0, atol=1e-6 * expected.mean())
    vectors = random.random((4, 3))
    estimates = [(flat, light.ravel()[flat]), (flat[::2], light.ravel()[flat[::2]])]
    seen = optics.probe(estimates, vectors)
    assert seen.shape == (3, 6)
    np.testing.assert_allclose(seen[:, :3], frame @ vectors, rtol=1e-6)
    both, _ = optics.frame_and_products(estimates, None)
    half = optics.frame(*estimates[1])
    np.testing.assert_allclose(both, (frame + half) / 2, rtol=0, atol=1e-6 * expected.mean())


@pytest.mark.parametrize(("bare", "flaws"), [(BARE, {}), (BARE, {"edge_blur_um": 3.0}), (PART, {})])
def test_the_largest_terms_of_a_raster_form_the_correlations_frames(
    bare: CameraGeometry, flaws: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Off the axis, of a part of each pixel, at two anchors and on some pixels: 1e-5 of a frame of all light, and of a
    single cell's what is stated of single pixels. Few cells are summed and not correlated, as they take less.
    (Planted: places of rows for columns; a pixel's raster cells one off; means half a square apart; no fill factor.)
    """
    camera, random = turned(bare, **flaws), np.random.default_rng(0)
    light = random.random((2, 9, 2, 11))
    flat, one = np.arange(light.size), np.array([205])

    def optics(places: object = None) -> FrameOptics:
        return FrameOptics(camera, ROWS, COLUMNS, (300.0,), 2, places=places)

    summed, some = optics(), optics(((1, 4, 7), (0, 2, 5, 8)))
    largest = rasters.raster(camera, 300.0).largest
    assert 40 < largest.count < 120 and RASTER_LEFT_OUT / 3 < largest.left_out <= RASTER_LEFT_OUT
    with monkeypatch.context() as forced:
        forced.setattr(image_formation, "CORRELATION_PRODUCTS", 1e9)
        frames = [summed.frame(flat, light.ravel()), summed.frame(one, np.ones(1))]
        few, seen = some.frame(flat, light.ravel()), summed.probe([(flat, light.ravel())], np.eye(len(frames[0].T)))
    monkeypatch.setattr(image_formation, "SUMMED_BYTES", -1)
    correlated = optics()
    expected = [correlated.frame(flat, light.ravel()), correlated.frame(one, np.ones(1))]
    for frame, exact, left in zip(frames, expected, (1e-5, 2 * RASTER_LEFT_OUT), strict=True):
        assert 0 < np.linalg.norm(frame - exact) <= left * np.linalg.norm(exact)
    np.testing.assert_allclose(few, frames[0][np.ix_((1, 4, 7), (0, 2, 5, 8))], rtol=1e-9)
    np.testing.assert_allclose(seen, frames[0], rtol=1e-9)


@pytest.mark.parametrize("camera", [BARE, turned()])
def test_light_in_few_cells_is_where_it_is_among_all_cells(
    camera: CameraGeometry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Six of 99 cells in four rows and five columns are lit. (Planted: columns counted backwards.)"""
    flat, values = np.array([2, 14, 18, 58, 63, 97]), np.arange(1.0, 7.0)
    few = FrameOptics(camera, ROWS, COLUMNS, (300.0,), 1).frame(flat, values)
    monkeypatch.setattr(image_formation, "_FILLED", 0.0)
    whole = FrameOptics(camera, ROWS, COLUMNS, (300.0,), 1).frame(flat, values)
    np.testing.assert_allclose(few, whole, rtol=0, atol=1e-6 * whole.mean())


def test_the_error_of_a_raster_is_that_of_its_frame() -> None:
    """Of a turned mask, in light of 9 rows and 11 columns of cells, against a raster of half the cells. (Planted: rows
    for columns.)"""
    error, known = image_formation.raster_error(turned(), ROWS, COLUMNS, 300.0, None, np.eye(9, 11))
    assert not known and 0 < error < 0.02


def test_few_terms_are_summed_where_they_take_less_time_and_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Light in 6 rows and 4 columns of cells, a frame of 30 x 50 pixels: T terms take T x 4 x (6 + 30) multiplications
    for each column of the result, and 8 x T x (4 + 6) x 50 bytes. (Planted: the longer side first; fewer bytes; sums
    that take as long as a correlation.)"""
    lit = SimpleNamespace(rows=np.arange(6), columns=np.arange(4))
    raster = SimpleNamespace(shadow=(BARE, ROWS, COLUMNS, 300.0, None), weights=(np.zeros((30, 1)), np.zeros((50, 1))))
    whole = rasters.cells_per_pixel(BARE) ** 2 * 12 * 12
    take_less = image_formation._Raster._sums_take_less

    def found(terms: int, products: float, most_bytes: float, vectors: np.ndarray | None) -> bool:
        monkeypatch.setattr(image_formation, "CORRELATION_PRODUCTS", products / whole)
        monkeypatch.setattr(image_formation, "SUMMED_BYTES", most_bytes)
        return take_less(raster, SimpleNamespace(terms=[0] * terms), lit, vectors)  # type: ignore[arg-type]

    for vectors, columns in ((None, 50), (np.zeros((50, 7)), 7)):
        sums = 3 * 4 * (6 + 30) * columns
        assert found(3, sums * 1.001, 12_000, vectors) and not found(3, sums * 0.999, 12_000, vectors)
        assert not found(3, sums * 1.001, 11_999, vectors) and not found(0, 1.0, 12_000, vectors)


def test_cells_are_sorted_by_their_place_in_a_pixel_and_few_terms_are_counted() -> None:
    """(Planted: rows for columns; terms of a raster that leaves too much.)"""
    cells = np.arange(4 * 9).reshape(4, 9)
    found = rasters._by_phase(cells, (2, 3))
    assert all(np.array_equal(found[row, column], cells[row::2, column::3]) for row, column in np.ndindex(2, 3))
    for left_out, count in ((RASTER_LEFT_OUT, 7), (2 * RASTER_LEFT_OUT, np.inf)):
        drawn = SimpleNamespace(largest=SimpleNamespace(count=7, left_out=left_out))
        assert image_formation.number_of_terms(drawn) == count  # type: ignore[arg-type]


def test_an_even_drawings_waves_are_those_of_its_part(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a zone plate an eighth is worked out, of one that is mirrored along its rows alone a half, and of one whose
    rows are its columns what is not below its diagonal. (Planted: columns' half for rows'; the mirrored
    half not turned round; what is below the diagonal left 0.)"""
    lines, place = Spectrum(np.array([500.0]), np.ones(1)), (np.arange(14) + 0.5 - 7) * 0.05
    zones = (np.cos(np.pi * (place[:, None] ** 2 + place**2) / 0.15**2) > 0) * 1.0
    half = zones.copy()
    half[:, :4] = 0
    corner = np.triu(np.random.default_rng(0).integers(0, 2, (14, 14)))
    monkeypatch.setattr(rasters, "_AT_ONCE", 2**10)  # several blocks along the diagonal
    for values, mirrored, symmetric in (
        (zones, (True, True), True),
        (half, (True, False), False),
        (half.T, (False, True), False),
        (np.maximum(corner, corner.T).astype(float), (False, False), True),
    ):

        def drawn(values: np.ndarray = values) -> np.ndarray:
            camera = BARE.model_copy(update={"mask": "plate", "mask_plate": Plate(0.05, values, "zones")})
            rasters.draw_raster.cache_clear()
            return rasters.raster(camera, 300.0, lines).values

        assert Plate(0.05, values, "zones").mirrored == mirrored
        assert Plate(0.05, values, "zones").symmetric == symmetric
        even = drawn()
        with monkeypatch.context() as whole:
            whole.setattr(Plate, "mirrored", (False, False))
            whole.setattr(Plate, "symmetric", False)
            expected = drawn()
        np.testing.assert_allclose(even, expected, rtol=0, atol=1e-5 * expected.mean())
    rasters.draw_raster.cache_clear()


def test_waves_of_large_drawings_are_refused_before_they_are_drawn() -> None:
    """4096 features a side would take minutes for each line; their geometric shadow is drawn. (Planted: no check.)"""
    values = np.random.default_rng(0).integers(0, 2, (4096, 4096)).astype(np.float64)
    camera = CameraGeometry(mask="plate", mask_plate=Plate(0.003, values, "drawing noise.png"))
    with pytest.raises(MitsimError, match=r"drawing noise\.png: .* use --effects=-diffraction"):
        rasters.check_waves(camera, Spectrum(np.array([500.0]), np.ones(1)))
    assert camera.is_drawn(waves=False) and camera.mask_terms == 1


def test_a_raster_has_cells_for_the_light_that_the_longest_wave_carries_beyond_the_mask() -> None:
    """Twice as many cells a side where they are half as wide. (Planted: cells that grow; the shortest wave.)"""
    camera = turned(CameraGeometry(pixels=512, pixel_pitch=0.02))
    whole = rasters.cells_a_side(camera, None)
    assert abs(rasters.cells_a_side(camera, None, 0.5) - 2 * whole) <= 4
    short, long, both = (
        rasters.cells_a_side(camera, Spectrum(np.array(nm), np.ones(len(nm)) / len(nm)))
        for nm in ([400.0], [800.0], [400.0, 800.0])
    )
    assert whole < short < long == both
