"""Factors that are hard to invert, their frames and the solver's sums of them; and the end of its status, checked."""

from __future__ import annotations

import re

import numpy as np
import pytest

from mitsim.devices.camera import centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.reconstruct.solver import Prepared
from tests.shadow_factor import scene_factor

EPS = float(np.finfo(np.float64).eps)
NUMBER = r"(inf|\d\.\de[+-]\d\d)"
ENDING = re.compile(
    r"Rank (\d+) of (\d+) \(rows (\d+) of (\d+), columns (\d+) of (\d+)\), "
    rf"condition {NUMBER} \(rows {NUMBER}, columns {NUMBER}\)"
)
LAMBDAS = (*(10.0**-power for power in range(2, 17, 2)), 0.0)
Frames = dict[tuple[int, int], np.ndarray]


def shadow(distance_mm: float = 2.0, pixels: int = 512, n: int = 128) -> np.ndarray:
    """(pixels, n) geometric shadow of the anchor geometry; fewer pixels are larger, on the same sensor and scene."""
    profile = mls_mask().terms[0][1]
    sensor, scene = centred_edges(pixels, 512 * 0.01172 / pixels), centred_edges(n, 120 / n)
    return scene_factor(profile, 0.06, sensor, scene, distance_mm, 400.0)


def spread(condition: float, n: int = 8, rows: int = 16, seed: int = 0) -> np.ndarray:
    """(rows, n) factor of this condition number, singular values a geometric series from 1 down."""
    rng = np.random.default_rng(seed)
    u, v = (np.linalg.qr(rng.normal(size=(size, n)))[0] for size in (rows, n))
    return (u * np.geomspace(1, 1 / condition, n)) @ v.T


def frames_of(left: np.ndarray, right: np.ndarray, P_L: np.ndarray, P_R: np.ndarray, image: np.ndarray) -> Frames:
    return {(i, j): left @ (np.outer(p, q) * image) @ right.T for i, p in enumerate(P_L.T) for j, q in enumerate(P_R.T)}


def summed(prepared: Prepared, frames: Frames):
    sums = prepared.accumulator()
    for key, frame in frames.items():
        sums.add(frame, *key)
    return sums


def check_ending(status: str, prepared: Prepared) -> None:
    """Rank and condition of the whole and of both sides stand in the status, and are those of the model.

    (Planted: the condition of one side in the place of the whole's.)
    """
    found = ENDING.search(status)
    assert found and status.endswith("."), status
    left, right = prepared.left, prepared.right
    ranks = prepared.rank, prepared.unknowns, left.rank, left.scene_size, right.rank, right.scene_size
    assert tuple(map(int, found.groups()[:6])) == ranks
    conditions = tuple(map(float, found.groups()[6:]))
    # Two digits are written.
    assert conditions[1:] == pytest.approx((left.condition, right.condition), rel=0.06)
    assert conditions[0] == pytest.approx(left.condition * right.condition, rel=0.06)
