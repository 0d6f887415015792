"""The projector as a light source: from points of the scene to connections that name the projector pixel they used.

A pinhole is the stock Mitsuba ``projector``. With a lens of finite radius, a point q of the lens shows the pattern that
is sharp on the focus plane: a ray from q through surface point p carries the projector pixel whose image lies where the
ray meets that plane. Radiance is ``pi scale texture / (A cos^4 theta)``, so that a small lens of area A casts the
pinhole's irradiance. A blurred spot moves each connection by a normal deviate in projector pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np


@dataclass(frozen=True)
class Projector:
    """The emitter and its window: n x n pixels from (first_row, first_column) of a (rows, columns) canvas.

    ``aperture`` is the lens radius [mm] (0: a pinhole), ``focus`` the distance of the sharp plane [mm], ``blur`` the
    standard deviation of a projector pixel's spot, in projector pixels.
    """

    emitter: Any
    n: int
    first_row: int
    first_column: int
    canvas: tuple[int, int]
    aperture: float = 0.0
    focus: float = 400.0
    blur: float = 0.0

    @property
    def ideal(self) -> bool:
        """A pinhole with sharp pixels."""
        return self.aperture == 0 and self.blur == 0


@dataclass
class Connection:
    """From a scene point to the projector: unit direction, lens point, weight (radiance / pdf), pdf [1/sr], pixel.

    ``pdf`` is 0 for a pinhole, which no sampled direction can find.
    """

    direction: Any
    target: Any
    weight: Any
    pdf: Any
    pixel: Any
    valid: Any


class Source:
    """Connections to one projector; prepared once."""

    def __init__(self, projector: Projector) -> None:
        self.projector, self.emitter = projector, projector.emitter
        if not projector.ideal:
            self._to_world = self.emitter.world_transform()
            self._pixel_at_unit = self._pixel_size()

    def connect(self, si: Any, rng: Any, active: Any) -> Connection:
        """Connect surface points to the projector; visibility is the caller's."""
        if self.projector.ideal:
            ds, weight = self.emitter.sample_direction(si, mi.Point2f(0.5), active)
            return Connection(ds.d, ds.p, weight, mi.Float(0), self._pixel(ds.uv), active & (ds.pdf > 0))
        local = self._to_world.inverse() @ si.p
        lens = mi.Point3f(0)
        if self.projector.aperture > 0:
            disk = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(rng.next_float32(), rng.next_float32()))
            lens = mi.Point3f(disk.x, disk.y, 0) * dr.opaque(mi.Float, self.projector.aperture)
        offset = local - lens
        pixel, strength, valid = self._seen(lens, offset, rng, active & (local.z > 0))
        distance = dr.norm(offset)
        cosine = offset.z / distance
        # Irradiance on a plane z = const is pi scale texture / z^2 from every point of the lens.
        weight = strength / (dr.square(local.z) * cosine)
        target = self._to_world @ lens
        pdf = dr.square(distance) / (cosine * self._area) if self.projector.aperture > 0 else mi.Float(0)
        return Connection(dr.normalize(target - si.p), target, weight, pdf, pixel, valid)

    def hit(self, ray: Any, reach: Any, rng: Any, active: Any) -> tuple[Any, Any, Any, Any]:
        """Sampled rays that meet the lens before ``reach``: radiance, pdf of :meth:`connect`, pixel, whether it is met.

        Needs a finite aperture.
        """
        inverse = self._to_world.inverse()
        origin, direction = inverse @ ray.o, inverse @ ray.d
        distance = -origin.z / direction.z
        lens = origin + direction * distance
        radius = dr.opaque(mi.Float, self.projector.aperture)
        met = active & (origin.z > 0) & (direction.z < 0) & (distance < reach)
        met &= dr.square(lens.x) + dr.square(lens.y) <= dr.square(radius)
        pixel, strength, met = self._seen(lens, -direction, rng, met)
        cosine = -direction.z
        radiance = strength / (self._area * dr.square(dr.square(cosine)))
        return radiance, dr.square(distance) / (cosine * self._area), pixel, met

    @property
    def _area(self) -> Any:
        return dr.pi * dr.square(dr.opaque(mi.Float, self.projector.aperture))

    def _seen(self, lens: Any, direction: Any, rng: Any, active: Any) -> tuple[Any, Any, Any]:
        """Pixel, pi scale texture, and validity of the light that leaves a lens point in a direction (both local)."""
        focus = dr.opaque(mi.Float, self.projector.focus)
        image = lens + direction * (focus / direction.z)
        if self.projector.blur > 0:
            spot = mi.warp.square_to_std_normal(mi.Point2f(rng.next_float32(), rng.next_float32()))
            step = dr.opaque(mi.Float, self.projector.blur) * focus
            image += mi.Vector3f(spot.x * self._pixel_at_unit[0], spot.y * self._pixel_at_unit[1], 0) * step
        at = dr.zeros(mi.SurfaceInteraction3f)
        # A point plus a vector is a vector to Mitsuba, and vectors are not moved.
        at.p = self._to_world @ mi.Point3f(image)
        ds, weight = self.emitter.sample_direction(at, mi.Point2f(0.5), active)
        strength = weight * (dr.square(image.z) * image.z / dr.norm(image))
        return self._pixel(ds.uv), strength, active & (ds.pdf > 0)

    def _pixel(self, uv: Any) -> Any:
        rows, columns = self.projector.canvas
        last = self.projector.n - 1
        row = dr.clip(dr.floor(uv.y * rows) - self.projector.first_row, 0, last)
        column = dr.clip(dr.floor(uv.x * columns) - self.projector.first_column, 0, last)
        return mi.UInt32(row * self.projector.n + column)

    def _pixel_size(self) -> tuple[float, float]:
        """Size (x, y) of a projector pixel on the plane at unit distance [mm]."""
        probe = dr.zeros(mi.SurfaceInteraction3f, 2)
        probe.p = self._to_world @ mi.Point3f([0.0, 1e-2], [0.0, 1e-2], [1.0, 1.0])
        ds, _ = self.emitter.sample_direction(probe, mi.Point2f(0.5))
        u, v = (np.array(axis, dtype=np.float64) for axis in (ds.uv.x, ds.uv.y))
        rows, columns = self.projector.canvas
        return 1e-2 / (abs(u[1] - u[0]) * columns), 1e-2 / (abs(v[1] - v[0]) * rows)
