"""Rays of the projector: from a pixel and random numbers to a ray through it, and the flux that the pixel sends out.

A ray of a pixel that is cut into N rays carries ``phi = pi scale texture a / N``, a being the pixel's area on the plane
at unit distance: the same through every point of a lens. Every pixel has its own rays, so light is never attributed to
a pixel by chance.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mitsim.transport.pinhole import PinholeMap
from mitsim.transport.source import Projector


class ProjectorRays:
    """Prepared once for a projector; numbers are opaque, so one compiled kernel serves all projectors of a kind."""

    def __init__(self, projector: Projector) -> None:
        self.projector = projector
        self._map = PinholeMap.of(projector.emitter)

    def sample(self, pixel: Any, jitter: Any, rng: Any, wavelengths: Any) -> Any:
        """A ray through the point ``jitter`` of each pixel, and a random point of the lens and of the blurred spot."""
        projector = self.projector
        n = dr.opaque(mi.UInt32, projector.n)
        row, column = mi.Float(pixel // n) + jitter.y, mi.Float(pixel % n) + jitter.x
        if projector.blur > 0:
            spot = mi.warp.square_to_std_normal(mi.Point2f(rng.next_float32(), rng.next_float32()))
            spread = dr.opaque(mi.Float, projector.blur)
            row, column = row + spread * spot.y, column + spread * spot.x
        image = self._image(row, column)
        lens = mi.Vector3f(0)
        if projector.aperture > 0:
            disk = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(rng.next_float32(), rng.next_float32()))
            lens = mi.Vector3f(disk.x, disk.y, 0) * dr.opaque(mi.Float, projector.aperture)
            image = image - lens / dr.opaque(mi.Float, projector.focus)
        turn = mi.Matrix3f(self._map.turn.tolist())
        return mi.Ray3f(self._origin + turn @ lens, dr.normalize(turn @ image), 0.0, wavelengths)

    def flux(self, pixel: Any, wavelengths: Any) -> Any:
        """Flux of each pixel [W m^-2 mm^2]: irradiance on the plane at unit distance times the pixel's area there."""
        projector, n = self.projector, dr.opaque(mi.UInt32, self.projector.n)
        centre = self._image(mi.Float(pixel // n) + 0.5, mi.Float(pixel % n) + 0.5)
        at = dr.zeros(mi.SurfaceInteraction3f)
        at.wavelengths = wavelengths
        depth = 1000.0  # mm; far from the projector float32 coordinates do not matter
        at.p = self._origin + mi.Matrix3f(self._map.turn.tolist()) @ (centre * depth)
        _, weight = projector.emitter.sample_direction(at, mi.Point2f(0.5), True)
        area = abs(self._map.x[0] * self._map.y[0]) / (projector.canvas[0] * projector.canvas[1])
        return weight * (depth**2 * dr.rsqrt(dr.squared_norm(centre)) * float(area))

    @property
    def _origin(self) -> Any:
        return mi.Point3f([float(value) for value in self._map.origin])

    def _image(self, row: Any, column: Any) -> Any:
        """Where a point of the window lies on the plane at unit distance, in the projector's frame."""
        u = (column + self.projector.first_column) / self.projector.canvas[1]
        v = (row + self.projector.first_row) / self.projector.canvas[0]
        x, y = ([dr.opaque(mi.Float, float(value)) for value in axis] for axis in (self._map.x, self._map.y))
        return mi.Vector3f(x[0] * u + x[1], y[0] * v + y[1], 1)
