"""Reflectance by projector pixel and depth: a net before a board, in closed form (tests/ideal_sessions.py).

The camera is that of test_depthmap.py. The net at 370 mm covers half of each pixel of a rectangle, and the board at
430 mm takes the other half.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.exr import read_frame
from mitsim.core.runs import Capture
from mitsim.reconstruct.depth import CommonBasis
from mitsim.reconstruct.reconstruct import Reconstruction, reconstruct
from mitsim.reconstruct.volume import Planes
from tests.unit.reconstruct.test_depthmap import BESIDE, PRINT, Layers, N, calibrated, psnr, sides

NEAR = np.zeros((N, N))
NEAR[10:30, 8:26] = 0.5
RANGE = {"depth_range": (350.0, 450.0)}


def net(patterns: str) -> Capture:
    parts = ((NEAR, *sides(370.0, BESIDE)), (1 - NEAR, *sides(430.0, BESIDE)))
    return Layers(*sides(400.0, BESIDE), surfaces=parts).run(patterns, PRINT, 0)


def sheet(depth: float, patterns: str) -> Capture:
    return Layers(*sides(400.0, BESIDE), surfaces=((np.ones((N, N)), *sides(depth, BESIDE)),)).run(patterns, PRINT, 0)


@cache
def solved(method: str = "tv", patterns: str = "dots:4x8") -> Reconstruction:
    return reconstruct(net(patterns), calibrated(), focus="volume", method=method, **RANGE)


def test_products_are_those_of_the_model() -> None:
    """Frames are sum_z L_z (P o X_z) R_z^T, weighted; the adjoint and the energy belong to them. (Planted: rows of
    another pattern; depths in another order on one side; weights of one side left out of the energy.)"""
    basis, rng = CommonBasis(net("dots:4x8"), calibrated(), (-2e-4, 2e-4)), np.random.default_rng(0)
    shifts = np.linspace(-2e-4, 2e-4, 3)
    planes, volume = Planes(basis, shifts), rng.random((3, N, N)).astype(np.float32)
    stack, (P_L, P_R) = np.zeros_like(basis.stack), basis.patterns
    for shift, image in zip(shifts, volume, strict=True):
        left, right = (basis.side(axis, float(shift)) for axis in (0, 1))
        stack += np.einsum("rp,pi,pq,qj,sq->irjs", left, P_L, image, P_R, right, optimize=True)
    frames = planes.image_of(volume)
    assert np.allclose(frames, planes.weigh(stack), atol=1e-4 * np.abs(frames).max())
    other = rng.standard_normal(frames.shape).astype(np.float32)
    assert np.vdot(frames, other) == pytest.approx(np.vdot(volume, planes.correlate(other)), rel=1e-3)
    assert planes.energy(frames) == pytest.approx(np.square(stack).sum(), rel=1e-4)


def test_a_net_before_a_board() -> None:
    """A depth for each pixel has 24 dB, the volume 35; half of the net's light lies at its depth. A sensor that
    moved by a pixel costs 11 dB and is flagged. (Planted: depths in reverse order; no bounds; the misfit in the
    factors' space neglected.)"""
    image, one = solved(), reconstruct(net("dots:4x8"), calibrated(), focus="map", **RANGE)
    near = image.volume.slices[image.volume.depths_mm < 400].sum(axis=0) / image.image
    assert psnr(image.image) > psnr(one.image) + 10
    assert near[12:28, 10:24].mean() == pytest.approx(0.5, abs=0.05) and near[:, 30:].mean() < 0.05
    moved = replace(calibrated(), left=np.roll(calibrated().left, 1, axis=0))
    (flag,) = reconstruct(net("dots:4x8"), moved, focus="volume", method="tv", **RANGE).status.flags
    assert "Misfit" in flag and not image.status.flags
    assert image.volume.slices.min() >= 0 and image.misfit is None and image.uncertainty is None


def test_what_is_written(tmp_path: Path) -> None:
    image = solved()
    slices, _ = read_frame(image.save(tmp_path / "image") / "volume.exr")
    assert np.allclose(sum(slices.values()), image.image, atol=1e-5)
    assert len(slices) == len(image.summary()["volume_depths_mm"])
    assert (tmp_path / "image" / "depth.exr").is_file()


def test_ambiguous_depths_are_flagged_and_other_patterns_refused() -> None:
    """Parallax of 3.8 pixels exceeds dots that repeat after two, and uniform light. Without a range it is a period
    of the dots, and a scene outside is refused. (Planted: one end of the range unchecked; the default range without
    its two checks; twice as long.)"""
    for patterns in ("dots:2", "uniform"):
        image = solved("tikhonov", patterns)
        assert not image.ok and any("ambiguous" in flag for flag in image.status.flags) and image.depths is None
        with pytest.raises(ArgumentError, match=r"dots repeat within 4 .*give the nearest and the farthest depth"):
            reconstruct(net(patterns), calibrated(), focus="volume")
    default = reconstruct(net("dots:4x8"), calibrated(), method="tv", focus="volume", iterations=6)
    assert default.focus.range_mm == pytest.approx((1000 / 3, 500.0))
    tv = {"method": "tv", "focus": "volume", "iterations": 36}
    for depth, ends in ((370.0, (390.0, 450.0)), (430.0, (350.0, 410.0))):
        (flag,) = reconstruct(sheet(depth, "dots:4x8"), calibrated(), **tv, depth_range=ends).status.flags
        assert "End of range" in flag
    with pytest.raises(ArgumentError, match=r"364.3:443.5 mm, .* at 500 mm; give a range, such as 445.4:569.8"):
        reconstruct(sheet(500.0, "dots:4"), calibrated(), focus="volume")
    with pytest.raises(MitsimError, match="needs shifting dots"):
        reconstruct(net("hadamard:4"), calibrated(), focus="volume")
    with pytest.raises(ArgumentError, match="volumes come with"):
        reconstruct(net("dots:4x8"), calibrated(), focus="volume", method="markov")
