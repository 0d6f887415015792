"""Geometric shadow of a mask profile: from edges of sensor pixels and scene cells to mean transmissions.

The ray from sensor coordinate u toward the direction tau = x/z, meeting the scene at depth z, crosses the
mask plane (distance d) at s = u (1 - d/z) + d tau. The mean over a sensor pixel and a cell is the profile
weighted by the density of s, the convolution of two boxes: a trapezoid. Its integral over each feature is a
difference of a piecewise-quadratic distribution function, so the mean is exact. (Four corner values of the
profile's second cumulative sum give the same number in exact arithmetic, but they cancel in float64: the
sums reach N**2/2 features while the second difference is a hundredth of one.)

All coordinates are index coordinates, centred, in mm; tau is a pure number.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mitsim.core.errors import MitsimError

FloatArray = npt.NDArray[np.float64]


def centred_edges(count: int, pitch: float) -> FloatArray:
    """(count + 1,) edges of ``count`` equal cells centred on zero, in the unit of ``pitch``."""
    if count < 1 or not (np.isfinite(pitch) and pitch > 0):
        raise MitsimError(f"a grid of {count} cells of size {pitch} is empty; give at least 1 cell and a size above 0")
    return np.asarray((np.arange(count + 1, dtype=np.float64) - count / 2) * pitch)


def shadow_factor(
    profile: npt.ArrayLike,
    feature_mm: float,
    pixel_edges_mm: npt.ArrayLike,
    cell_edges_tan: npt.ArrayLike,
    mask_distance_mm: float,
    depth_mm: float,
) -> FloatArray:
    """Mean of a mask profile over sensor pixel i and tan-angle cell j, for points at one depth.

    Parameters
    ----------
    profile
        (N,) transmission of each feature, any real numbers; centred on the axis, zero outside.
    feature_mm
        feature size [mm].
    pixel_edges_mm
        (m + 1,) increasing edges of the sensor pixels [mm].
    cell_edges_tan
        (c + 1,) increasing edges of the cells in tau = x/z.
    mask_distance_mm
        sensor to mask, d [mm].
    depth_mm
        sensor to scene, z [mm], above d; ``inf`` is allowed.

    Returns
    -------
    (m, c) float64.

    Raises
    ------
    MitsimError
        for edges that do not increase, or a depth that is not beyond the mask.
    """
    values = np.asarray(profile, dtype=np.float64)
    if values.ndim != 1 or values.size == 0 or not np.isfinite(values).all():
        raise MitsimError(f"mask profile of shape {values.shape}; give a non-empty 1-D list of finite numbers")
    _require_positive("mask feature size", feature_mm)
    _require_positive("distance from sensor to mask", mask_distance_mm)
    if not depth_mm > mask_distance_mm:
        raise MitsimError(f"scene depth is {depth_mm} mm; it must lie beyond the mask at {mask_distance_mm} mm")
    pixels = _checked_edges("sensor pixel edges", pixel_edges_mm) * (1 - mask_distance_mm / depth_mm) / feature_mm
    cells = _checked_edges("cell edges", cell_edges_tan) * mask_distance_mm / feature_mm
    return _trapezoid_mean(values, pixels, cells)


def scene_factor(
    profile: npt.ArrayLike,
    feature_mm: float,
    pixel_edges_mm: npt.ArrayLike,
    scene_edges_mm: npt.ArrayLike,
    mask_distance_mm: float,
    depth_mm: float,
) -> FloatArray:
    """:func:`shadow_factor` for scene pixels: (c + 1,) edges [mm] on the plane at ``depth_mm``."""
    _require_positive("scene depth", depth_mm)
    tan_edges = np.asarray(scene_edges_mm, dtype=np.float64) / depth_mm
    return shadow_factor(profile, feature_mm, pixel_edges_mm, tan_edges, mask_distance_mm, depth_mm)


def _trapezoid_mean(profile: FloatArray, pixels: FloatArray, cells: FloatArray) -> FloatArray:
    """Mean of the profile where s = (point of a pixel) + (point of a cell); both edge lists in features."""
    half_pixel = np.diff(pixels)[:, None] / 2
    half_cell = np.diff(cells)[None, :] / 2
    pixel_centre = (pixels[:-1] + pixels[1:])[:, None] / 2
    cell_centre = (cells[:-1] + cells[1:])[None, :] / 2
    centre = pixel_centre + cell_centre + len(profile) / 2
    reach = half_pixel + half_cell
    first = np.floor(centre - reach)
    feature = first.astype(np.intp)
    offset = first - centre
    padded = np.concatenate(([0.0], profile, [0.0]))
    total = np.zeros_like(centre)
    below = np.zeros_like(centre)
    for step in range(int(np.ceil(2 * reach.max())) + 1):
        upto = _trapezoid_cdf(offset + (step + 1), half_pixel, half_cell)
        total += padded[np.clip(feature + (step + 1), 0, len(profile) + 1)] * (upto - below)
        below = upto
    return total


def _trapezoid_cdf(x: FloatArray, half_a: FloatArray, half_b: FloatArray) -> FloatArray:
    """Distribution function at x of the sum of two centred uniform variables of the given half-widths."""
    short, long = np.minimum(half_a, half_b), np.maximum(half_a, half_b)
    distance = np.abs(x)
    tail = np.square(np.maximum(short + long - distance, 0)) / (8 * short * long)
    centre = 0.5 - distance / (2 * long)
    upper = np.where(distance <= long - short, centre, tail)
    return np.asarray(np.where(x < 0, upper, 1 - upper))


def _checked_edges(name: str, edges: npt.ArrayLike) -> FloatArray:
    array = np.asarray(edges, dtype=np.float64)
    if array.ndim != 1 or array.size < 2 or not np.isfinite(array).all() or not (np.diff(array) > 0).all():
        raise MitsimError(f"{name} of shape {array.shape} are not at least 2 finite increasing numbers; sort them")
    return array


def _require_positive(name: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0):
        raise MitsimError(f"{name} is {value} mm; give a finite number above 0")
