"""Shadows of tilted masks against rays counted through the mask where each crosses it, Fresnel's integrals, and the
reference estimator.

Rationale: the factored form moves profiles by what the other axis says, between nodes; a ray knows nothing of that.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.special import fresnel

from mitsim.api.bench import open_bench
from mitsim.core.configuration import shipped_path
from mitsim.devices.camera import CameraGeometry, MaskProfile
from mitsim.devices.projector import Spectrum
from mitsim.optics.shadow import Directions
from mitsim.optics.terms import shadow_terms
from mitsim.planner.planner import SceneFacts

BARE = CameraGeometry(pixels=96, pixel_pitch=0.03, mask_offset_row=0.1, mask_offset_column=-0.21)
LINE = Spectrum(np.array([550.0]), np.array([1.0]))


def made(kind: str, row: float, column: float, bare: CameraGeometry = BARE) -> CameraGeometry:
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
    camera, even = made(kind, *tilt), made(kind, 1e-9, 0.0)
    assert camera.tilt_nodes(waves=False) is not None and not camera.tilt_left_out(waves=False)
    tau, depth, points, pixels = (0.15, -0.12), 60.0, 24, BARE.pixels
    fine = (np.arange(pixels * points) + 0.5) / points * BARE.pixel_pitch - BARE.half_width
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
    camera, even = made("separable", 30.0, 0.0, bare), made("separable", 1e-9, 0.0, bare)
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
