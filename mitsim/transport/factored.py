"""The factored estimator's light: from a scene to how much of each projector pixel's light reaches each tan-angle cell.

A path starts at an *anchor* (a point of the sensor), goes through a cell of directions, and ends in a connection to the
projector, which names the projector pixel that it used (the ``uv`` of Mitsuba's direction sample). Collected over one
pass, the paths are a sparse matrix ``light[projector pixel, anchor x cell]``; every frame of every pattern family is a
sum of its rows, because light is linear. The mask and the sensor pixels are applied afterwards in closed form
(:mod:`mitsim.optics`), which is what makes the estimator fast.

Value collected, for anchor a and tan-angle t from it (the integrand of the reference estimator without its mask)::

    g_a(t) dt = L(a, t) (1 + |t|^2)^-2 dt          [W m^-2]

Cells are seen from the sensor's centre, tau = (x/z, y/z) of the point that was hit. The ray from anchor a is aimed at
tau on a plane at the depth of the light (t = tau - a/z, so dt = dtau at any depth) and its light is filed under the tau
of the point it really hits; on that plane the two agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from scipy import sparse

from mitsim.core.errors import MitsimError
from mitsim.optics.camera import anchor_positions
from mitsim.transport.cells import CellGrid

FloatArray = npt.NDArray[np.float64]
LANES_PER_LAUNCH = 2**24
_ROUNDING = 1e-3


@dataclass(frozen=True, eq=False)
class LightSample:
    """One batch: light that reaches the camera, and where it comes from.

    Attributes
    ----------
    light
        (n * n, rows * columns) CSR, W m^-2 per cell; rows = anchors x cell rows, columns = anchors x cell columns.
    depth_mean, depth_spread
        mean of 1/z over the light [1/mm], and its standard deviation.
    """

    light: sparse.csr_array
    depth_mean: float
    depth_spread: float


@dataclass(frozen=True)
class Projector:
    """The emitter and its window: n x n pixels from (first_row, first_column) of a (rows, columns) canvas."""

    emitter: Any
    n: int
    first_row: int
    first_column: int
    canvas: tuple[int, int]


class Tracer:
    """Prepared once for a scene, a cell grid and a number of anchors; each call of :meth:`batch` is independent."""

    def __init__(
        self,
        scene: Any,
        camera: Any,
        projector: Projector,
        grid: CellGrid,
        anchors: int,
        depth: float | None = None,
        common: bool = False,
    ) -> None:
        """Settings of the estimator.

        ``depth`` [mm] is where the rays of different anchors through one cell meet: best at the depth of the light, and
        the camera's scene distance without it. ``common`` gives every anchor the same random numbers, so that
        differences between anchors are smooth.
        """
        self.scene, self.camera, self.projector, self.grid = scene, camera, projector, grid
        self.anchors, self.common = anchors, common
        self.depth = camera.geometry.scene_distance if depth is None else depth
        self.positions = anchor_positions(anchors, camera.geometry.half_width)

    @property
    def lanes(self) -> int:
        """Paths in one batch: one per anchor and cell."""
        return self.anchors**2 * self.grid.shape[0] * self.grid.shape[1]

    def batch(self, seed: int) -> LightSample:
        """One jittered path through every cell from every anchor."""
        launches = [
            self._launch(seed, first, min(LANES_PER_LAUNCH, self.lanes - first))
            for first in range(0, self.lanes, LANES_PER_LAUNCH)
        ]
        pixel, row, column, value, inverse_depth = (np.concatenate(part) for part in zip(*launches, strict=True))
        total_columns = self.anchors * self.grid.shape[1]
        flat = row.astype(np.int64) * total_columns + column
        shape = (self.projector.n**2, self.anchors * self.grid.shape[0] * total_columns)
        entries = (value.astype(np.float64), (pixel.astype(np.int32), flat))
        light = sparse.coo_array(entries, shape=shape).tocsr()
        return LightSample(light, *_weighted_moments(inverse_depth, value))

    def _launch(self, seed: int, first: int, count: int) -> list[npt.NDArray[Any]]:
        """Arrays of :meth:`_trace` for some lanes, without the dark ones."""
        found = [np.array(values) for values in self._trace(seed, first, count)]
        if not np.isfinite(found[3]).all():
            raise MitsimError("the scene reflects NaN or infinite light toward the camera; check its materials")
        lit = found[3] != 0
        return [values[lit] for values in found]

    def _trace(self, seed: int, first: int, count: int) -> tuple[Any, Any, Any, Any, Any]:
        """Per path: projector pixel, row and column of (anchor, cell), light [W m^-2], 1/depth."""
        geometry, grid = self.camera.geometry, self.grid
        # Opaque numbers keep the compiled kernel the same for every grid and seed.
        rows, columns = dr.opaque(mi.UInt32, grid.shape[0]), dr.opaque(mi.UInt32, grid.shape[1])
        lane = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
        column = lane % columns
        row = (lane // columns) % rows
        anchor = lane // (rows * columns)
        anchors = dr.opaque(mi.UInt32, self.anchors)
        anchor_row, anchor_column = anchor // anchors, anchor % anchors
        stream_index = lane % (rows * columns) if self.common else lane
        # Neighbouring streams of PCG32 are correlated; the cipher TEA scatters their seeds, as in Mitsuba's samplers.
        state, sequence = mi.sample_tea_32(dr.opaque(mi.UInt32, seed), stream_index)
        random = mi.PCG32(initstate=mi.UInt64(state), initseq=mi.UInt64(sequence))
        tau_row = self._edge(grid.rows, row, random.next_float32())
        tau_column = self._edge(grid.columns, column, random.next_float32())
        wavelength_sample = random.next_float32()
        positions = mi.Float(self.positions.astype(np.float32))
        u = mi.Point2f(-dr.gather(mi.Float, positions, anchor_column), -dr.gather(mi.Float, positions, anchor_row))
        z = dr.opaque(mi.Float, self.depth)
        t = mi.Vector2f(-tau_column, -tau_row) - mi.Vector2f(u) / z
        squared = 1 + dr.squared_norm(t)
        to_world = self.camera.world_transform()
        wavelengths, spectral = self.camera.sample_wavelengths(
            dr.zeros(mi.SurfaceInteraction3f), wavelength_sample, True
        )
        ray = mi.Ray3f(
            to_world @ mi.Point3f(u.x, u.y, 0),
            to_world @ (mi.Vector3f(t.x, t.y, 1) * dr.rsqrt(squared)),
            0.0,
            wavelengths,
        )
        pixel, radiance, point = self._direct(ray, spectral)
        local = to_world.inverse() @ point
        inverse_depth = dr.rcp(local.z)
        hit_row = self._cell(grid.rows, -local.y * inverse_depth, row, tau_row)
        hit_column = self._cell(grid.columns, -local.x * inverse_depth, column, tau_column)
        inside = (hit_row >= 0) & (hit_row < mi.Int32(rows)) & (hit_column >= 0) & (hit_column < mi.Int32(columns))
        inside &= local.z > geometry.mask_distance
        stop = dr.opaque(mi.Float, geometry.tan_half_fov)
        inside &= (dr.abs(t.x) <= stop) & (dr.abs(t.y) <= stop)
        solid = dr.opaque(mi.Float, grid.rows.size * grid.columns.size) / dr.square(squared)
        weight = dr.select(inside, panchromatic(radiance) * solid, 0)
        full_row = anchor_row * rows + mi.UInt32(dr.maximum(hit_row, 0))
        full_column = anchor_column * columns + mi.UInt32(dr.maximum(hit_column, 0))
        dr.eval(pixel, full_row, full_column, weight, inverse_depth)
        return pixel, full_row, full_column, weight, inverse_depth

    def _direct(self, ray: Any, spectral: Any) -> tuple[Any, Any, Any]:
        """Radiance of light that goes projector - surface - camera: (projector pixel, radiance, surface point).

        The same quantity as Mitsuba's ``path`` at depth 2 with this one delta light.
        """
        si = self.scene.ray_intersect(mi.RayDifferential3f(ray), mi.RayFlags.All, True)
        active = si.is_valid()
        ds, emitted = self.projector.emitter.sample_direction(si, mi.Point2f(0.5), active)
        active &= ds.pdf > 0
        active &= ~self.scene.ray_test(si.spawn_ray_to(ds.p), active)
        bsdf = si.bsdf()
        reflected = bsdf.eval(mi.BSDFContext(), si, si.to_local(ds.d), active)
        radiance = dr.select(active, mi.unpolarized_spectrum(reflected * emitted) * spectral, 0)
        canvas_rows, canvas_columns = self.projector.canvas
        row = dr.floor(ds.uv.y * canvas_rows) - self.projector.first_row
        column = dr.floor(ds.uv.x * canvas_columns) - self.projector.first_column
        last = self.projector.n - 1
        row, column = dr.clip(row, 0, last), dr.clip(column, 0, last)
        return mi.UInt32(row * self.projector.n + column), radiance, si.p

    @staticmethod
    def _edge(axis: Any, index: Any, jitter: Any) -> Any:
        start, size = dr.opaque(mi.Float, axis.start), dr.opaque(mi.Float, axis.size)
        return start + (mi.Float(index) + jitter) * size

    @staticmethod
    def _cell(axis: Any, tau: Any, aimed: Any, aimed_tau: Any) -> Any:
        """Cell of tau; a point within rounding of where its ray was aimed stays in the cell that was aimed at."""
        start, rate = dr.opaque(mi.Float, axis.start), dr.opaque(mi.Float, 1 / axis.size)
        found = mi.Int32(dr.floor((tau - start) * rate))
        return dr.select(dr.abs(tau - aimed_tau) * rate < _ROUNDING, mi.Int32(aimed), found)


def panchromatic(radiance: Any) -> Any:
    """One number for a spectrum, by a flat response: the mean over channels, or over wavelength 360-830 nm.

    In spectral variants the radiance has been divided by the density of its sampled wavelengths, so the mean over
    samples is an integral; dividing by the range makes a flat spectrum of 1 count as 1, as in the other variants.
    """
    mean = dr.mean(radiance)
    return mean / (mi.MI_CIE_MAX - mi.MI_CIE_MIN) if mi.is_spectral else mean


def _weighted_moments(values: FloatArray, weights: FloatArray) -> tuple[float, float]:
    total = float(weights.sum(dtype=np.float64))
    if total == 0:
        return 0.0, 0.0
    mean = float((values * weights).sum(dtype=np.float64)) / total
    spread = float((np.square(values - mean) * weights).sum(dtype=np.float64)) / total
    return mean, max(spread, 0.0) ** 0.5
