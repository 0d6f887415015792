"""The shadow of one mask profile with edges of pixels and cells of any widths, which only tests and benchmarks need."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.optics.shadow import Steps, trapezoid_mean


def shadow_factor(
    profile: npt.ArrayLike,
    feature_mm: float,
    pixel_edges_mm: npt.ArrayLike,
    cell_edges_tan: npt.ArrayLike,
    mask_distance_mm: float,
    depth_mm: float,
) -> FloatArray:
    """Return the (m, c) mean of a profile (N,) over sensor pixel i and tan-angle cell j, for points at one depth."""
    shrink = (depth_mm - mask_distance_mm) / depth_mm if np.isfinite(depth_mm) else 1.0
    pixels = np.asarray(pixel_edges_mm, dtype=np.float64) * shrink / feature_mm
    cells = np.asarray(cell_edges_tan, dtype=np.float64) * mask_distance_mm / feature_mm
    centre = (pixels[:-1] + pixels[1:])[:, None] / 2 + (cells[:-1] + cells[1:])[None, :] / 2
    values = np.asarray(profile, dtype=np.float64)
    return trapezoid_mean(values, centre, np.diff(pixels)[:, None] / 2, np.diff(cells)[None, :] / 2)


def scene_factor(
    profile: npt.ArrayLike,
    feature_mm: float,
    pixel_edges_mm: npt.ArrayLike,
    scene_edges_mm: npt.ArrayLike,
    mask_distance_mm: float,
    depth_mm: float,
) -> FloatArray:
    """Return the shadow for scene pixels whose (c + 1,) edges on the plane at ``depth_mm`` are in mm."""
    tan_edges = np.asarray(scene_edges_mm, dtype=np.float64) / depth_mm
    return shadow_factor(profile, feature_mm, pixel_edges_mm, tan_edges, mask_distance_mm, depth_mm)


def steps_of(profile: npt.ArrayLike, feature_mm: float) -> Steps:
    """Return the centred ``profile`` (N,) of features of ``feature_mm``."""
    count = len(np.asarray(profile))
    return Steps.between(profile, np.asarray((np.arange(count + 1) - count / 2) * feature_mm))
