"""A mask off the axis against the same mask on it, with its features counted from elsewhere, and against rays.

Rationale: a mask that has moved by whole features is a centred mask with as many closed features before its code; one
that has moved by any length is a centred one before a sensor and a scene that moved the other way.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import open_bench
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask import Mask
from mitsim.devices.projector import Spectrum
from mitsim.optics.diffraction import wave_terms
from mitsim.optics.fft_shadow import SampledTerm, geometric_samplers, wave_samplers
from mitsim.optics.shadow import Directions, SeparableTerms, ShadowGeometry, geometric_terms
from mitsim.optics.terms import shadow_terms
from tests.physics.slopes import slope_of_reference

LINES = Spectrum(np.array([450.0, 638.0]), np.array([0.4, 0.6]))
CAMERA = CameraGeometry(pixels=40, pixel_pitch=0.017, mask_order=5, scene_distance=30.0)
ROWS, COLUMNS = Directions(np.linspace(-0.3, 0.28, 9), 0.01), Directions(np.linspace(-0.2, 0.3, 7), 0.01)


def terms_of(shadow: ShadowGeometry, spectrum: Spectrum | None) -> SeparableTerms:
    if spectrum is None:
        return geometric_terms(shadow, ROWS, COLUMNS)
    return wave_terms(shadow, ROWS, COLUMNS, spectrum)


@pytest.mark.parametrize("thickness", [0.0, 0.1])
@pytest.mark.parametrize("spectrum", [None, LINES])
def test_a_shift_by_whole_features_shifts_the_profile(spectrum: Spectrum | None, thickness: float) -> None:
    """By 4 features down the rows and 2 back along the columns: 8 closed features before the code, or 4 behind it, of
    a centred mask. Bound: what other samples of the same grid leave of a shadow (2.5e-4 mm: 1.4e-4), and 1e-11
    geometric. (Planted: the other sign; one axis for both; the axis's own directions kept, thick mask.)"""
    feature = CAMERA.mask_feature
    moved = CAMERA.model_copy(
        update={
            "mask_offset_row": 4 * feature,
            "mask_offset_column": -2 * feature,
            "mask_thickness": thickness,
        }
    )
    shadow = ShadowGeometry.of(moved, 30.0)
    bits = shadow.mask.bits
    padded = np.concatenate([np.zeros(8, np.int8), bits]), np.concatenate([bits, np.zeros(4, np.int8)])
    rows, columns = (
        terms_of(replace(shadow, mask=Mask("separable", feature, code), offset_mm=(0.0, 0.0)), spectrum)
        for code in padded
    )
    for (left, right), (row, _), (_, column) in zip(terms_of(shadow, spectrum), rows, columns, strict=True):
        allowed = 1e-11 if spectrum is None else 2e-3
        assert np.abs(left - row).max() < allowed * row.max()
        assert np.abs(right - column).max() < allowed * column.max()
        assert np.abs(left - terms_of(replace(shadow, offset_mm=(0.0, 0.0)), spectrum)[0][0]).max() > 0.1 * left.max()


@pytest.mark.parametrize("kind", ["separable", "flatcam", "open"])
@pytest.mark.parametrize("thickness", [0.0, 0.15])
def test_a_frame_equals_rays_counted_through_the_moved_mask(kind: str, thickness: float) -> None:
    """A point source: its rays to 40 x 40 points of each pixel, each asked whether both faces let it pass there. Alike
    along both axes but for the offset. (Planted: the sign of either offset; the entrance face left on the axis; one
    computation for both axes.)"""
    offset = np.array([0.131, -0.077])
    camera = CameraGeometry(
        pixels=40, pixel_pitch=0.03, mask=kind, mask_order=4, mask_thickness=thickness, scene_distance=30.0,
        mask_offset_row=offset[0], mask_offset_column=offset[1],
    )  # fmt: skip
    tau, depth, mask = np.array([0.05, 0.05]), 30.0, camera.build_mask()
    fine = (np.arange(40 * 40) + 0.5) / 40 * 0.03 - camera.half_width
    passed = np.ones((len(fine), len(fine)))
    for plane in {2.0, 2.0 + thickness}:
        row, column = (fine * (1 - plane / depth) + at * plane - off for at, off in zip(tau, offset, strict=True))
        passed = passed * mask.transmission(row[:, None], column[None, :])
    counted = passed.reshape(40, 40, 40, 40).mean(axis=(1, 3))
    rows, columns = (Directions([at], 0.0) for at in tau)
    frame = sum(left[:, :1] @ right[:, :1].T for left, right in shadow_terms(camera, rows, columns, depth))
    assert counted.std() > 0.1
    # An edge is counted to half a point: 1/80 of a pixel each, a few edges a pixel.
    assert np.abs(frame - counted).max() < 0.05 and np.abs(frame - counted).mean() < 0.01


@pytest.mark.parametrize("spectrum", [None, LINES])
def test_samplers_of_a_moved_mask_are_a_centred_ones_asked_elsewhere(spectrum: Spectrum | None) -> None:
    """As far as both reach. (Planted: the centre added to the places, or to the ends of the profile.)"""
    camera = CAMERA.model_copy(update={"mask_offset_row": 0.131, "mask_offset_column": -0.077})

    def samplers(of: CameraGeometry) -> list[SampledTerm]:
        return geometric_samplers(of) if spectrum is None else wave_samplers(of, spectrum, 400.0, (0.0, 0.1))

    s, width = np.linspace(-0.5, 0.5, 61), np.full(61, 0.02)
    for (weight, *moved), (other, *centred) in zip(samplers(camera), samplers(CAMERA), strict=True):
        assert weight == other
        for sampler, own, offset in zip(moved, centred, (0.131, -0.077), strict=True):
            found, expected = sampler(s, width), own(s - offset, width)
            np.testing.assert_allclose(found, expected, atol=1e-12 if spectrum is None else 2e-3 * expected.max())
            assert np.abs(found - own(s, width)).max() > 0.1 * found.max()


@pytest.mark.slow
def test_the_reference_moves_its_mask_alike(small_scene: Callable[..., Path], variant: str) -> None:
    """Slope of the reference's frame on the factored one less its mean, 8 seeds of 128 samples a pixel: 1 to five
    standard errors of their mean; it is 0 +- 0.1 for a mask elsewhere. (Planted: the sign, rows for columns.)"""
    path = small_scene(mask="separable")
    offsets = '<float name="mask_offset_row" value="0.3"/> <float name="mask_offset_column" value="-0.54"/>'
    path.write_text(path.read_text().replace('<float name="fov"', f'{offsets} <float name="fov"', 1))
    bench = open_bench(path, variant)
    assert bench.geometry.mask_offset == (0.3, -0.54)
    slope, error, _, _ = slope_of_reference(bench)
    assert error < 0.05 and abs(slope - 1) < 5 * error


def test_calibrations_of_cameras_without_an_offset_fit_on(small_scene: Callable[..., Path], variant: str) -> None:
    """Their manifests do not know the field: it is in a camera's identity where it is not 0."""
    path = small_scene()
    assert "mask_offset_row" not in open_bench(path, variant).identity()["geometry"]
    offset = '<float name="mask_offset_row" value="0.3"/>'
    path.write_text(path.read_text().replace('<float name="fov"', f'{offset} <float name="fov"', 1))
    geometry = open_bench(path, variant).identity()["geometry"]
    assert geometry["mask_offset_row"] == 0.3 and "mask_offset_column" not in geometry
