"""Shadows that are drawn on a raster: waves behind masks of many terms, turned ones too, and pictures of light.

Rationale: the field behind square openings is a sum of Fresnel integrals at any point, whatever the mask's terms; and
behind a separable mask the raster has to give what the closed form gives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.special import fresnel

from mitsim.api.bench import open_bench
from mitsim.bench.effects import EFFECTS, Physics
from mitsim.core.configuration import shipped_path
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry, MaskProfile
from mitsim.devices.mask import Flaws, Plate
from mitsim.devices.projector import Spectrum
from mitsim.light.cost_model import cells_to_choose
from mitsim.optics import fft_shadow as rasters
from mitsim.optics import image_formation
from mitsim.optics.diffraction import grid_step
from mitsim.optics.fft_shadow import Correlation, raster
from mitsim.optics.image_formation import FrameOptics, raster_error
from mitsim.optics.shadow import Directions, ShadowGeometry
from mitsim.optics.terms import shadow_terms
from mitsim.planner.planner import SceneFacts

BARE = CameraGeometry(pixels=40, mask_offset_row=0.013)
LINES = Spectrum(np.array([450.0, 638.0]), np.array([0.4, 0.6]))


def made(**fields: object) -> CameraGeometry:
    return MaskProfile.model_validate({"feature_mm": 0.06, **fields}).put_on(BARE, Path())


def as_plate(bare: CameraGeometry = BARE, **fields: object) -> CameraGeometry:
    """A code of two terms at most as a plate, feature by feature."""
    plate = MaskProfile.model_validate({"feature_mm": 0.06, **fields}).plate(Path())
    return bare.model_copy(update={"mask": "plate", "mask_plate": plate, "mask_feature": plate.feature_mm})


def irradiance(camera: CameraGeometry, tau: tuple[float, float], depth: float, degrees: float) -> np.ndarray:
    """(5, 5) light of a point on every eighth pixel from the third, by Fresnel integrals at 24 x 24 points."""
    values = MaskProfile(kind="random", feature_mm=0.06, features=31).plate(Path()).values
    edges = (np.arange(32) - 15.5) * 0.06
    fine = (np.arange(24) + 0.5) / 24 * 0.01172 + (np.arange(2, 40, 8)[:, None] - 20) * 0.01172
    shrink, angle = 1 - 2 / depth, np.radians(degrees)
    row, column = ((fine.ravel() * shrink + 2 * at) - off for at, off in zip(tau, camera.mask_offset, strict=True))
    row, column = (part.ravel() for part in np.meshgrid(row, column, indexing="ij"))
    row, column = np.cos(angle) * row + np.sin(angle) * column, np.cos(angle) * column - np.sin(angle) * row
    total = np.zeros((5, 5))
    for wavelength, share in zip(LINES.wavelengths_nm, LINES.weights, strict=True):

        def side(s: np.ndarray, product: float = wavelength * 1e-6 * 2 * shrink) -> np.ndarray:
            sine, cosine = fresnel((s[:, None] - edges) * (2 / product) ** 0.5)
            return -np.diff(0.5 + (0.5 - 0.5j) * (cosine + 1j * sine), axis=1)

        field = ((side(row) @ values) * side(column)).sum(axis=1)
        total += share * np.square(np.abs(field)).reshape(5, 24, 5, 24).mean(axis=(1, 3))
    return total


@pytest.mark.parametrize("degrees", [0.0, 3.0])
def test_waves_behind_a_random_mask_are_fresnels_integrals(degrees: float) -> None:
    """One point, single pixels: what the raster's cells and points leave there, in parts of the mean. (Planted: light
    turned the other way; no offset; a line's share squared.)"""
    camera = made(kind="random", features=31, rotation_deg=degrees)
    tau, depth = (0.03, -0.02), 30.0
    rows, columns = (Directions([at], 0.0) for at in tau)
    frame = FrameOptics(camera, rows, columns, (depth,), 1, LINES).frame(np.array([0]), np.ones(1))
    expected = irradiance(camera, tau, depth, degrees)
    geometric = FrameOptics(camera, rows, columns, (depth,), 1).frame(np.array([0]), np.ones(1))
    assert np.sqrt(np.mean(np.square(frame[2::8, 2::8] - expected))) < 0.02 * expected.mean()
    assert np.sqrt(np.mean(np.square(geometric[2::8, 2::8] - expected))) > 0.15 * expected.mean()


def rays_counted(camera: CameraGeometry, plate: Plate, at: list[np.ndarray], light: np.ndarray) -> np.ndarray:
    """The frame of points of ``light`` at tan-angles ``at``, 400 mm away: transmission met from 60 x 60 points a pixel,
    on which the mask is turned, moved and looked up here."""
    angle, count, shrink = np.radians(plate.flaws.turn_deg), len(plate.values), 1 - camera.mask_distance / 400
    fine = (np.arange(60) + 0.5) / 60 * camera.pixel_pitch
    total = np.zeros(camera.frame_shape)
    lines = [(np.arange(pixels)[:, None] - pixels / 2) * camera.pixel_pitch + fine for pixels in camera.frame_shape]
    for k, row in enumerate(at[0]):
        for j, column in enumerate(at[1]):
            x, y = (
                side.ravel() * shrink + camera.mask_distance * tau - off
                for side, tau, off in zip(lines, (row, column), camera.mask_offset, strict=True)
            )
            across = np.cos(angle) * x[:, None] + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x[:, None]
            place = [np.floor(each / plate.feature_mm + count / 2).astype(int) for each in across]
            inside = np.logical_and.reduce([(each >= 0) & (each < count) for each in place])
            seen = np.where(inside, plate.values[tuple(np.where(inside, each, 0) for each in place)], 0)
            total += light[k, j] * seen.reshape(camera.frame_shape[0], 60, camera.frame_shape[1], 60).mean(axis=(1, 3))
    return total


@pytest.mark.parametrize(
    ("feature", "degrees", "bare"),
    [
        pytest.param(0.05, 3.0, {}, marks=pytest.mark.slow),
        (0.05, 3.0, {"mask_offset_row": 0.11, "mask_offset_column": -0.07}),
        (0.05, 5.0, {"rows": 33, "columns": 21}),
        (0.004, 7.0, {"pixels": 31}),
    ],
)
def test_terms_and_correlations_are_rays_counted(
    feature: float, degrees: float, bare: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A turned disc, off the axis, on a sensor that is not square, of odd sides, and a disc narrower than a line of the
    projector is on the mask: points of light make the frame that is counted ray by ray. (Planted: turned the other way;
    rows' offset for columns'; rows' pixels for columns'; a pixel's raster cell one off; means a
    third of a pixel apart.)"""
    place = np.arange(15) - 7.0
    plate = Plate(feature, (place[:, None] ** 2 + place**2 < 40) * 1.0, "disc", flaws=Flaws(turn_deg=degrees))
    camera = BARE.model_copy(update={"mask_offset_row": 0.0, "mask": "plate", "mask_plate": plate, **bare})
    at = [np.array([-0.05, -0.01, 0.02]), np.array([-0.04, 0.03])]
    light = np.random.default_rng(0).random((3, 2))
    expected = rays_counted(camera, plate, at, light)

    def frame() -> np.ndarray:
        optics = FrameOptics(camera, *(Directions(each, 0.0) for each in at), (400.0,), 1)
        return optics.frame(np.arange(6), light.ravel())

    monkeypatch.setattr(image_formation, "CORRELATION_PRODUCTS", 1e9)
    summed = frame()
    monkeypatch.setattr(image_formation, "SUMMED_BYTES", -1)
    correlated = frame()
    for formed in (summed, correlated):
        assert np.linalg.norm(formed - expected) < 0.01 * np.linalg.norm(expected)
    assert np.linalg.norm(summed - correlated) < 1e-4 * np.linalg.norm(correlated)


@pytest.mark.parametrize("kind", ["separable", "flatcam"])
def test_the_raster_gives_the_closed_forms_frame(kind: str) -> None:
    """Of 40 x 40 cells of light, to 1e-3 of its mean. (Planted: a point's place in its cell.)"""
    camera = as_plate(kind=kind, order=7)
    edges = np.linspace(-0.15, 0.15, 41)
    at, light = Directions.cells(edges), np.random.default_rng(0).random((40, 40))
    expected = sum(left @ light @ right.T for left, right in shadow_terms(camera, at, at, 400.0, LINES))
    drawn = replace(ShadowGeometry.of(camera, 400.0), mask=raster(camera, 400.0, LINES))
    frame = Correlation(drawn, at, at).image(light, np.arange(40), np.arange(40))
    assert np.sqrt(np.mean(np.square(frame - expected))) < 1e-3 * expected.mean()
    geometric = sum(left @ light @ right.T for left, right in shadow_terms(camera, at, at, 400.0))
    assert np.sqrt(np.mean(np.square(geometric - expected))) > 3e-3 * expected.mean()


def off_the_closed_form(camera: CameraGeometry, lines: Spectrum, cells: int) -> float:
    """What a frame of uniform light from so many ``cells`` a side differs by, drawn and in closed form, relative."""
    at, light, row = Directions.cells(np.linspace(-0.15, 0.15, cells + 1)), np.ones((cells, cells)), np.arange(cells)
    expected = sum(left @ light @ right.T for left, right in shadow_terms(camera, at, at, 400.0, lines))
    drawn = replace(ShadowGeometry.of(camera, 400.0), mask=raster(camera, 400.0, lines))
    frame = Correlation(drawn, at, at).image(light, row, row)
    return float(np.linalg.norm(frame - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize(("feature", "order"), [(0.006, 5), (0.001, 7)])
def test_waves_beyond_a_small_mask_are_drawn(feature: float, order: int) -> None:
    """Masks of 0.2 and 0.1 mm, 2 mm off, light a sensor of 0.5 mm by waves, features far below a pixel: to 3e-3 of the
    closed form's frame. (Planted: a raster as wide as the mask: half of it is missing.)"""
    camera = as_plate(kind="separable", order=order, feature_mm=feature)
    assert off_the_closed_form(camera, LINES, 40) < 3e-3


def test_waves_of_too_many_points_are_refused() -> None:
    """A random mask 1 um from 512 pixels needs 2 nm from point to point. (Planted: no limit: hours.)"""
    camera = made(kind="random", features=31).model_copy(update={"mask_distance": 1e-3, "pixels": 512})
    with pytest.raises(MitsimError, match=r"0\.001 mm from the sensor.* points a side, more than 65536"):
        raster(camera, 400.0, LINES)


def test_fringes_of_far_edges_do_not_add_up() -> None:
    """Uniform light behind 511 features a side, of which the farthest are 15 mm away: to 5e-4 of its closed form.
    (Planted: the field at points, not its means from one to the next: 2.5e-3.)"""
    camera, line = as_plate(CameraGeometry(pixels=64), kind="separable"), Spectrum(np.array([562.0]), np.ones(1))
    assert off_the_closed_form(camera, line, 64) < 5e-4


def test_sharpened_cells_are_read_half_as_blurred() -> None:
    """Means of x^2 over unit cells are a twelfth above it, sharpened ones a twelfth below: reading them in cells adds
    one. (Planted: one axis alone; the sign.)"""
    x = np.arange(-5, 6.0)
    means = np.add.outer(x**2, 2 * x**2) + 3 / 12
    inner = slice(1, -1)
    got = rasters.sharpen(means)[inner, inner]
    np.testing.assert_allclose(got, (np.add.outer(x**2, 2 * x**2) - 3 / 12)[inner, inner], rtol=0, atol=1e-12)


def test_waves_of_grey_masks_keep_their_light() -> None:
    """0.3 of the transmission everywhere: 0.3 of the light, exactly. (Planted: no root.)"""
    values = MaskProfile(kind="random", feature_mm=0.06, features=31).plate(Path())
    full, grey = (
        raster(BARE.model_copy(update={"mask": "plate", "mask_plate": plate}), 400.0, LINES)
        for plate in (values, replace(values, values=0.3 * values.values))
    )
    np.testing.assert_allclose(grey.values, 0.3 * full.values, rtol=0, atol=1e-6)
    assert full.values.mean() > 0.2


def psf_camera(folder: Path, pixel: float = 0.02) -> tuple[CameraGeometry, np.ndarray]:
    """A camera with a picture of light 400 mm away, in pixels of half the sensor's, and the picture, its sum 1."""
    light = np.zeros((140, 120))
    light[30:-30, 20:-20] = np.random.default_rng(2).random((80, 80)) ** 4
    np.save(folder / "light.npy", 3.0 + light)
    table = {"kind": "psf", "feature_mm": pixel / 2, "file": "light.npy", "psf_distance_mm": 400.0, "aperture_mm2": 1.5}
    bare = CameraGeometry(pixels=50, pixel_pitch=pixel)
    return MaskProfile.model_validate(table).put_on(bare, folder), light / light.sum()


def test_a_picture_of_light_is_the_frame_of_its_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the axis, and beside it by whole pixels, the picture itself: irradiance over that without a mask, of which the
    aperture's area lets light through. (Planted: no shrink in the aperture; moved the other way.)"""
    monkeypatch.setattr(image_formation, "SUMMED_BYTES", -1)  # its largest terms leave 1e-4 of a single point
    camera, light = psf_camera(tmp_path)
    by_pixel = light.reshape(70, 2, 60, 2).sum(axis=(1, 3)) * 1.5 / (0.02 * (1 - 2 / 400)) ** 2
    single = 1e-6 * by_pixel.max()
    at = Directions(np.array([0.0, 3 * 0.02 * (1 - 2 / 400) / 2]), 0.0)
    optics = FrameOptics(camera, at, at, (400.0,), 1)
    np.testing.assert_allclose(optics.frame(np.array([0]), np.ones(1)), by_pixel[10:60, 5:55], rtol=0, atol=single)
    moved = optics.frame(np.array([2]), np.ones(1))
    np.testing.assert_allclose(moved, by_pixel[13:63, 5:55], rtol=0, atol=single)
    ((left, right), *_) = shadow_terms(camera, at, at, 400.0)
    assert left.shape == right.shape == (50, 2)


def test_a_nearer_points_light_is_wider(tmp_path: Path) -> None:
    """By (1 - d/z0) / (1 - d/z), about the axis: its second moment along a side. (Planted: the point's own shrink.)"""
    camera, _ = psf_camera(tmp_path, pixel=0.04)
    at = Directions([0.0], 0.0)
    spreads = []
    for depth in (400.0, 20.0):
        frame = FrameOptics(camera, at, at, (depth,), 1).frame(np.array([0]), np.ones(1))
        place = np.arange(50) - 24.5
        along = frame.sum(axis=0)
        spreads.append(np.sqrt((along * place**2).sum() / along.sum()))
    assert spreads[1] / spreads[0] == pytest.approx((1 - 2 / 400) / (1 - 2 / 20), rel=3e-3)


def test_a_camera_with_a_picture_of_light_misses_nothing(
    small_scene: Callable[..., Path], variant: str, tmp_path: Path
) -> None:
    """No diffraction is added, and none is told to be left out. (Planted: the warning of blurred masks for it.)"""
    light = np.zeros((80, 80))
    light[20:60, 20:60] = 200 * np.random.default_rng(2).random((40, 40))
    Image.fromarray(light.astype(np.uint8)).save(tmp_path / "light.png")
    text = shipped_path("calibration", "imx249.toml").read_text(encoding="utf-8")
    table = 'kind = "psf"\nfeature_mm = 0.01172\nfile = "light.png"\npsf_distance_mm = 400.0\naperture_mm2 = 0.3\n'
    (tmp_path / "camera.toml").write_text(f"{text}\n[mask]\n{table}", encoding="utf-8")
    bench = open_bench(small_scene(), variant, tmp_path / "camera.toml")
    assert not SceneFacts.of(bench).warnings and Physics.of(bench).spectrum is None
    assert not EFFECTS["diffraction"].present(bench) and "light.png of 400 mm" in str(
        bench.geometry.identity["mask_plate"]
    )
    table = table.replace("400.0", "1.5")
    (tmp_path / "camera.toml").write_text(f"{text}\n[mask]\n{table}", encoding="utf-8")
    with pytest.raises(MitsimError, match=r"psf_distance_mm is 1\.5"):
        open_bench(small_scene(), variant, tmp_path / "camera.toml")


def judged(camera: CameraGeometry, at: Directions, light: np.ndarray) -> tuple[float, float, bool]:
    """What the raster leaves as it is predicted, and as all pixels show it: against sums, or a third of the cells."""
    row = np.arange(len(light))
    by_fft = camera.model_copy(update={"mask_fft": True})
    places = np.flatnonzero(light)
    coarse = FrameOptics(by_fft, at, at, (400.0,), 1).frame(places, light.ravel()[places])
    if camera.is_drawn(waves=False):
        third = camera.model_copy(update={"mask_cells": 3 * rasters.cells_per_pixel(camera)})
        drawn = replace(ShadowGeometry.of(camera, 400.0), mask=raster(third, 400.0))
        fine = Correlation(drawn, at, at).image(light, row, row)
    else:
        assert by_fft.is_correlated(waves=False) and not camera.is_correlated(waves=False)
        fine = FrameOptics(camera, at, at, (400.0,), 1).frame(places, light.ravel()[places])
    predicted, known = raster_error(camera, at, at, 400.0, None, light)
    return predicted, float(np.linalg.norm(coarse - fine) / np.linalg.norm(fine)), known


@pytest.mark.parametrize(
    "mask",
    [
        {"kind": "random", "features": 63},
        {"kind": "random", "features": 63, "edge_blur_um": 2.0},
        pytest.param({"kind": "separable", "order": 6, "rotation_deg": 0.3}, marks=pytest.mark.slow),
    ],
)
def test_what_a_raster_leaves_is_predicted(mask: dict[str, object]) -> None:
    """Of dots, from 64 x 64 of 96 x 96 pixels; sums and FFT agree to it. (Planted: not sharpened.)"""
    camera = MaskProfile.model_validate({"feature_mm": 0.06, **mask}).put_on(CameraGeometry(pixels=96), Path())
    light = np.zeros((40, 40))
    light[3::7, 3::7] = 1
    predicted, found, known = judged(camera, Directions.cells(np.linspace(-0.15, 0.15, 41)), light)
    assert known == (not camera.is_drawn(waves=False))
    assert predicted / 2 < found < 1.5 * predicted
    assert found < (2.5e-4 if mask["kind"] == "random" else 4.5e-4)


def test_each_line_of_a_raster_has_its_own_shadow() -> None:
    """The frame of two lines is theirs, by their shares, but for what largest terms leave, and a shadow that is drawn
    for one is not taken for another. (Planted: rasters kept by mask and depth alone.)"""
    camera = made(kind="random", features=31)
    at, light = Directions.cells(np.linspace(-0.15, 0.15, 81)), np.zeros((80, 80))
    light[3::20, 5::20] = 1

    def frame(spectrum: Spectrum) -> np.ndarray:
        return FrameOptics(camera, at, at, (400.0,), 1, spectrum).frame(np.arange(6400), light.ravel())

    lines = [Spectrum(LINES.wavelengths_nm[k : k + 1], np.ones(1)) for k in (0, 1)]
    blue, red = (frame(line) for line in lines)
    np.testing.assert_allclose(frame(LINES), 0.4 * blue + 0.6 * red, rtol=0, atol=3e-4 * blue.mean())
    assert np.linalg.norm(blue - red) > 0.01 * np.linalg.norm(red)


def test_a_plan_may_choose_cells_that_memory_holds() -> None:
    """4/3 of 6 and twice as many a pixel, of 512 pixels a side not the latter; frames are drawn with what is chosen.
    (Planted: no bound.)"""

    def turned_by_a_degree(pixels: int) -> CameraGeometry:
        profile = MaskProfile(kind="separable", feature_mm=0.06, rotation_deg=1.0)
        return profile.put_on(CameraGeometry(pixels=pixels), Path())

    assert [cells_to_choose(turned_by_a_degree(pixels), None) for pixels in (40, 512)] == [(6, 8, 12), (6, 8)]
    camera = turned_by_a_degree(40)
    six, twelve = (raster(camera.model_copy(update={"mask_cells": cells}), 400.0).feature_mm for cells in (0, 12))
    assert six == pytest.approx(2 * twelve)


def test_what_a_raster_leaves_of_other_rows_than_columns_and_of_no_light() -> None:
    """Judged by the light's own rows and columns; a black frame has no error. (Planted: columns are rows; all.)"""
    camera = made(kind="random", features=31)
    rows, columns = Directions.cells(np.linspace(-0.15, 0.1, 7)), Directions.cells(np.linspace(-0.05, 0.15, 5))
    error, known = raster_error(camera, rows, columns, 400.0, None, np.random.default_rng(0).random((6, 4)))
    assert known and 0 < error < 1e-3
    assert raster_error(camera, rows, columns, 400.0, None, np.zeros((6, 4))) == (0.0, True)


def test_a_mask_turned_by_all_but_a_right_angle_is_drawn_as_by_it() -> None:
    """About its centre, edges to a sixteenth of a cell, sharpened; the other's features are counted turned. (Planted:
    cells counted from the middle on; turned the other way.)"""
    right, nearly, other = (
        raster(made(kind="random", features=11, rotation_deg=turn), 400.0).values for turn in (90.0, 90 - 1e-6, -90.0)
    )
    np.testing.assert_allclose(nearly, right, rtol=0, atol=0.2)
    assert np.abs(other - right).max() > 0.9


def test_fields_have_a_grid_as_fine_as_waves_need(monkeypatch: pytest.MonkeyPatch) -> None:
    """Far behind a mask, where points at which waves are squared are many of the grid's cells apart. (Planted: as many
    cells from point to point wherever the mask is.)"""

    class Asked(Exception):
        """For waves on a grid; which takes long."""

    def ask(_: float, __: float, step_mm: float, *others: float, single: bool) -> None:
        raise Asked(step_mm)

    monkeypatch.setattr(rasters, "EdgeWaves", ask)
    bare = CameraGeometry(pixels=4, pixel_pitch=0.03, mask_distance=20.0)
    camera = as_plate(bare, kind="separable", order=2)
    with pytest.raises(Asked) as asked:
        raster(camera, 400.0, Spectrum(np.array([550.0]), np.ones(1)))
    assert asked.value.args[0] <= grid_step(ShadowGeometry.of(camera, 400.0), 550.0)
