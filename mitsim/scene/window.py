"""The projector's pixel grid: n x n pixels of a stock ``projector`` emitter and the directions that they light.

The emitter's texture is its all-white frame. The rectangle of lit texels is the *window* of n x n pixels that patterns
use; dark texels around it are canvas. A window off the canvas's centre is a lens shift, which causes no keystone. Row 0
is at +y and column 0 at +x for a viewer along +z.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError

_NO_KEYSTONE = 1e-3
"""Keystone in projector pixels that counts as rounding."""


_MOST_ACROSS = 16384
"""Largest number of projector pixels across the camera's field: 67 MB for 512 sensor pixels and a layer.
"""


_Place = tuple[int, float, float, tuple[int, int]]


@dataclass(frozen=True)
class ProjectorGrid:
    """A window of n x n projector pixels in a canvas (rows, columns), and its position on the camera's aligned plane.

    ``first_row`` and ``first_column`` are the texel of pixel (0, 0), fractional for a drifted picture. ``row_tan`` and
    ``column_tan`` are (first edge, last edge) of the window's bounding box as tan-angles in index coordinates.
    ``keystone`` is the largest deviation of the corners from that box in projector pixels.
    """

    n: int
    first_row: float
    first_column: float
    canvas: tuple[int, int]
    row_tan: tuple[float, float]
    column_tan: tuple[float, float]
    keystone: float

    @property
    def place(self) -> _Place:
        return self.n, self.first_row, self.first_column, self.canvas


def locate_projector(where: str, projector: mi.Emitter, camera: mi.Sensor) -> ProjectorGrid:
    """Find the lit window of a projector and its position in front of a camera.

    Raises MitsimError, which begins with ``where``, if the texture is no bitmap with a lit square window, or does not
    light the camera's aligned plane.
    """
    parameters = mi.traverse(projector)
    if "irradiance.data" not in parameters:
        problem = f"{where}: the projector's irradiance is not a bitmap"
        raise MitsimError(f"{problem}; give a raw bitmap texture whose white texels are the projector's pixels")
    texels = np.array(parameters["irradiance.data"])
    lit = texels.reshape(texels.shape[0], texels.shape[1], -1).max(axis=-1) > 0
    rows, columns = np.flatnonzero(lit.any(axis=1)), np.flatnonzero(lit.any(axis=0))
    if not rows.size:
        raise MitsimError(f"{where}: the projector's bitmap is all black; its white texels are the projector's pixels")
    height, width = int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1
    if height != width or not lit[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].all():
        problem = f"{where}: the lit texels of the projector's bitmap span {height}x{width} and must fill a square"
        raise MitsimError(f"{problem}; paint the window white")
    z = camera.geometry.scene_distance
    window = width, int(rows[0]), int(columns[0]), (int(lit.shape[0]), int(lit.shape[1]))
    corners = _window_corners(where, projector, camera, window, z)
    low, high = corners.min(axis=0), corners.max(axis=0)
    span = float((high - low).min())
    across = 2 * camera.geometry.tan_half_fov * width / span if span > 0 else np.inf
    if across > _MOST_ACROSS:
        problem = f"{where}: the camera's field is {across:.3g} pixels of the projector wide"
        remedy = f"at most {_MOST_ACROSS} are simulated, so widen the projector's fov, or narrow the camera's"
        raise MitsimError(f"{problem}; {remedy}")
    ideal = np.array([[low[0], low[1]], [low[0], high[1]], [high[0], low[1]], [high[0], high[1]]])
    keystone = float(np.abs((corners - ideal) / (high - low)).max()) * width
    tangents = (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))
    return ProjectorGrid(*window, *tangents, keystone if keystone > _NO_KEYSTONE else 0.0)


def window_at(
    where: str, projector: mi.Emitter, camera: mi.Sensor, grid: ProjectorGrid, depth: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return row and column tan-angles (first edge, last edge) on a plane, or raise MitsimError if it is unlit."""
    corners = _window_corners(where, projector, camera, grid.place, depth)
    (top, left), (bottom, right) = corners.min(axis=0), corners.max(axis=0)
    return (float(top), float(bottom)), (float(left), float(right))


def straightening(where: str, projector: mi.Emitter, camera: mi.Sensor, grid: ProjectorGrid, z: float) -> FloatArray:
    """Return the (3, 3) homography that removes the keystone from tan-angles (row, column, 1) at the depth ``z``.

    It maps to the positions of the projector pixels if the window filled its bounding box evenly. Raises MitsimError if
    the projector does not light the plane.
    """
    corners = _window_corners(where, projector, camera, grid.place, z)
    low, high = corners.min(axis=0), corners.max(axis=0)
    return _homography(corners, np.where([[0, 0], [0, 1], [1, 0], [1, 1]], high, low))


def _window_corners(where: str, projector: mi.Emitter, camera: mi.Sensor, window: _Place, z: float) -> FloatArray:
    """Return the (4, 2) tan-angles (row, column) of the window's corners on the plane at ``z``, from four probes."""
    half = 0.25 * z  # any four points do
    probes = np.array([[half, half], [half, -half], [-half, half], [-half, -half]])
    interaction = dr.zeros(mi.SurfaceInteraction3f, len(probes))
    # Opaque numbers keep the compiled kernel the same for every plane.
    place, across, away = dr.arange(mi.UInt32, len(probes)), dr.opaque(mi.Float, half), dr.opaque(mi.Float, z)
    x, y = (dr.select((place & bit) == 0, across, -across) for bit in (2, 1))
    interaction.p = camera.world_transform() @ mi.Point3f(x, y, away)
    sample, _ = projector.sample_direction(interaction, mi.Point2f(0.5))
    uv = np.array(sample.uv, dtype=np.float64).T
    uv = uv.T if uv.shape[0] == 2 and uv.shape[1] == len(probes) else uv
    homography = _homography(uv, probes) if np.isfinite(uv).all() else np.full((3, 3), np.nan)
    n, row, column, canvas = window
    rows = (row + n * np.array([0, 0, 1, 1])) / canvas[0]
    columns = (column + n * np.array([0, 1, 0, 1])) / canvas[1]
    mapped = np.stack([columns, rows, np.ones(4)], axis=1) @ homography.T
    points = mapped[:, :2] / mapped[:, 2:]
    if not np.isfinite(points).all():
        problem = f"{where}: the projector does not light the plane at {z:g} mm from the camera"
        raise MitsimError(f"{problem}; aim it at the scene")
    return np.stack([-points[:, 1] / z, -points[:, 0] / z], axis=1)


def _homography(source: FloatArray, target: FloatArray) -> FloatArray:
    rows = []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows.append([x, y, 1, 0, 0, 0, -u * x, -u * y, -u])
        rows.append([0, 0, 0, x, y, 1, -v * x, -v * y, -v])
    return np.asarray(np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3))
