"""From beams to frames: conservation of flux, the mask's samplers, what falls where; beams are made by hand."""

import numpy as np
import pytest

from mitsim.devices.camera import CameraGeometry
from mitsim.devices.projector import Spectrum
from mitsim.optics.fft_shadow import geometric_samplers, wave_samplers
from mitsim.optics.frames import Beams, _cuts, specular_frames

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
    assert found.flux == pytest.approx(2.0, rel=1e-12)
    assert found.irradiance.sum() * PITCH**2 == pytest.approx(2.0, rel=1e-12)
    assert (found.classes.tolist(), found.lit_pixels.tolist(), found.unresolved) == ([1], [4], 0.25)


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
    stop = specular_frames(beams(corners, tangent=tangent), *args, boxes_per_pixel=64).flux
    assert stop == pytest.approx(2 * np.tan(np.radians(30)), rel=2e-3)
    # cos^2 theta is 1 / (1 + t^2), of mean pi / 4 over t from 0 to 1.
    wide = geometry(fov=120, angular_exponent=2.0)
    answered = specular_frames(beams(corners, tangent=tangent), wide, geometric_samplers(wide), LABELS, 64)
    assert answered.flux == pytest.approx(2 * np.pi / 4, rel=1e-5)


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
    assert found.classes.tolist() == [1, 2] and found.lit_pixels.tolist() == [4, 8]
    assert found.irradiance.sum(axis=(1, 2)) * PITCH**2 == pytest.approx([2.0, 5.0])
    one = specular_frames(both, geometry(), geometric_samplers(geometry()), np.zeros(9, np.int64))
    assert np.allclose(one.irradiance[0], found.irradiance.sum(axis=0))


ORDER = ("pixel", "flux", "sensor", "tangent", "throughput")
