"""Shadows of a mask that is turned or shakes, against the mask itself, point by point."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

from mitsim.devices.camera import CameraGeometry
from mitsim.devices.projector import Spectrum
from mitsim.devices.session import MaskMotion
from mitsim.optics.diffraction import wave_profiles
from mitsim.optics.shadow import Directions, SeparableTerms, ShadowGeometry
from mitsim.optics.terms import shadow_terms

DEPTH = 400.0
CAMERA = CameraGeometry(pixels=24, pixel_pitch=0.25, mask_offset_row=0.1, mask_offset_column=-0.07)
"""As wide as the anchor's sensor, with pixels 20 times as large: what turns moves by up to 3 um at its edge."""
ROWS = Directions.cells(np.linspace(-0.1, 0.1, 6))
COLUMNS = Directions.cells(np.linspace(-0.12, 0.08, 5))


def moving(**motion: float) -> CameraGeometry:
    return CAMERA.model_copy(update={"mask_motion": MaskMotion(**motion)})


def operator(terms: SeparableTerms) -> np.ndarray:
    return np.asarray(sum(np.einsum("ir,jc->irjc", left, right) for left, right in terms))


def drawn(angle: float, pixel: tuple[int, int], cell: tuple[int, int], parts: int = 1000) -> float:
    """Mean transmission over one pixel toward points, from the mask's own transmission at turned coordinates.

    A pixel of 0.25 mm holds four features; cells are points here, so that a plain sum does.
    """
    shadow = ShadowGeometry.of(CAMERA, DEPTH)
    steps = (np.arange(parts) + 0.5) / parts - 0.5
    row, column = (
        shadow.shrink * (CAMERA.centres(0)[index] + CAMERA.pixel_pitch * steps)
        + CAMERA.mask_distance * directions.centres[place]
        - offset
        for index, directions, place, offset in zip(pixel, (ROWS, COLUMNS), cell, CAMERA.mask_offset, strict=True)
    )
    row, column = row[:, None], column[None, :]
    turned = np.cos(angle) * row + np.sin(angle) * column, np.cos(angle) * column - np.sin(angle) * row
    return float(CAMERA.build_mask().transmission(*turned).mean())


def test_a_turned_mask_is_the_mask_at_turned_coordinates() -> None:
    """At the sensor's corners, where 2 mrad move the mask by 6 um: to 4 % of what turning changes, twice what sums of
    1000 x 1000 points leave. (Planted: the other sense; one axis alone; the offset left out.)"""
    points = Directions(ROWS.centres, 0.0), Directions(COLUMNS.centres, 0.0)
    turned, still = (operator(shadow_terms(camera, *points, DEPTH)) for camera in (moving(rotation_mrad=2.0), CAMERA))
    places = [((0, 23), (0, 1)), ((23, 23), (4, 3)), ((1, 0), (2, 0)), ((22, 1), (1, 2)), ((0, 11), (4, 3))]
    changed = [turned[i, r, j, c] - still[i, r, j, c] for (i, j), (r, c) in places]
    expected = [drawn(2e-3, *place) - drawn(0.0, *place) for place in places]
    assert np.linalg.norm(np.subtract(changed, expected)) < 0.04 * np.linalg.norm(expected)
    assert np.linalg.norm(expected) > 0.005


def test_fine_nodes_are_as_good_as_finer_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """The anchor's pixels of 11.7 um: hats 0.5 um apart leave 1 % of what turning by 1 mrad changes, against a tenth of
    that spacing. (Planted: 5 um apart, 17 %.)"""
    small = CameraGeometry(pixels=512).model_copy(update={"mask_motion": MaskMotion(rotation_mrad=1.0)})
    cell, few = Directions.cells(np.array([0.05, 0.0523])), (3, 4, 5, 250, 508, 509)
    shadow = [operator(shadow_terms(small, cell, cell, DEPTH, places=(few, few)))]
    monkeypatch.setattr("mitsim.optics.terms.NODE_UM", 0.05)
    shadow.append(operator(shadow_terms(small, cell, cell, DEPTH, places=(few, few))))
    still = operator(shadow_terms(small.model_copy(update={"mask_motion": None}), cell, cell, DEPTH, places=(few, few)))
    assert np.linalg.norm(shadow[0] - shadow[1]) < 0.01 * np.linalg.norm(shadow[1] - still)


@pytest.mark.parametrize("spectrum", [None, Spectrum(np.array([520.0]), np.ones(1))])
def test_vibration_is_the_convolution_of_the_shadow(spectrum: Spectrum | None) -> None:
    """With a normal law, along each axis: a pixel's mean of the mask's edges smeared to error functions; in waves, of
    the fine profile smeared point by point. To 1 % of what shaking changes. (Planted: half the deviation.)"""
    deviation, camera = 0.02, CAMERA.model_copy(update={"mask_offset_row": 0.0, "mask_offset_column": 0.0})
    point = Directions(np.array([0.03]), 0.0)
    shaking = camera.model_copy(update={"mask_motion": MaskMotion(vibration_um=1e3 * deviation)})
    (found,), (still,) = (shadow_terms(each, point, point, DEPTH, spectrum) for each in (shaking, camera))
    shadow = ShadowGeometry.of(camera, DEPTH)
    s = ((np.arange(1000) + 0.5) / 1000 - 0.5) * 2 * shadow.half_pixel + shadow.crossings(point)
    if spectrum is None:
        weight, profile, _ = camera.build_mask().terms[0]
        edges = (np.arange(len(profile) + 1) - len(profile) / 2) * camera.mask_feature
        jumps = np.diff(profile, prepend=0.0, append=0.0)
        expected = np.array(
            [(jumps * (1 + erf((each[:, None] - edges) / (deviation * 2**0.5))) / 2).sum(axis=1).mean() for each in s]
        )
    else:
        low, high = s.min() - 0.2, s.max() + 0.2
        ((weight, values), *_), start, step = wave_profiles(shadow, 520.0, low, high, 0.03)
        reach = int(5 * deviation / step)
        kernel = np.exp(-np.square(np.arange(-reach, reach + 1) * step / deviation) / 2)
        smeared = np.convolve(values, kernel / kernel.sum(), mode="same")
        expected = np.array(
            [np.interp(each, start + step * (np.arange(len(values)) + 0.5), smeared).mean() for each in s]
        )
    before, after = still[0][:, 0], found[0][:, 0]
    scale = np.vdot(expected, after) / np.vdot(expected, expected)
    assert np.linalg.norm(after - scale * expected) < 0.01 * np.linalg.norm(after - before)
    assert scale == pytest.approx(weight, rel=1e-3) or spectrum is not None
