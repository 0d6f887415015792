"""Direct light from the projector's side: every projector pixel's light, followed to the surface and on to each anchor.

A ray leaves the projector through a point of a pixel (and of the lens), meets a surface at P, and P is connected to
every anchor of the sensor, or to one random point of it. A ray of a pixel that is cut into N rays carries the flux
``phi = pi scale texture a / N``, a being the pixel's area on the plane at unit distance (the same through every point
of a lens), and irradiates the sensor point with::

    E = f(P) cos_s / cos_g  phi  cos_P cos_a / r^2  r(t)        [W m^-2]

f is the BSDF, cos_s and cos_g the projector's cosines to the shading and the geometric normal at P, cos_P and cos_a
those of the connection at P and at the sensor, and r(t) the pixel's angular response. Every pixel has its share of the
rays, so light is never attributed to a pixel by chance, and all anchors see the same points.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.errors import MitsimError
from mitsim.optics.camera import CameraGeometry, anchor_positions
from mitsim.transport.histogram import DIRECT, Deposits
from mitsim.transport.pinhole import PinholeMap
from mitsim.transport.sampling import generator, panchromatic, stratified
from mitsim.transport.source import Projector

_LANES_PER_LAUNCH = 2**22


class DirectTracer:
    """Prepared once for a scene, a projector and a number of anchors; each seed is an independent estimate."""

    def __init__(
        self,
        scene: Any,
        camera: Any,
        projector: Projector,
        anchors: int,
        geometry: CameraGeometry | None = None,
        spread: bool = False,
    ) -> None:
        """``spread`` connects to random points of the sensor, all filed as one anchor: the mean over the sensor.

        ``geometry`` stands in for the camera's own.
        """
        self.spread = spread
        self.scene, self.camera, self.projector, self.anchors = scene, camera, projector, anchors
        self.geometry: CameraGeometry = geometry or camera.geometry
        self.positions = anchor_positions(anchors, self.geometry.half_width)
        self._map = PinholeMap.of(projector.emitter)

    @property
    def lanes(self) -> int:
        """Connections of one sample: one per projector pixel and anchor."""
        return self.projector.n**2 * self.anchors**2

    def trace(self, seed: int, first: int = 0, samples: int = 1) -> Deposits:
        """Samples ``first`` .. ``first + samples - 1`` of every pixel, as if ``samples`` of them were all.

        Raises
        ------
        MitsimError
            when the scene sends NaN or infinite light to the camera.
        """
        total, start = self.lanes * samples, self.lanes * first
        parts = [
            self._launch(seed, start + done, min(_LANES_PER_LAUNCH, total - done))
            for done in range(0, total, _LANES_PER_LAUNCH)
        ]
        return Deposits.joined(parts)

    def _launch(self, seed: int, first: int, count: int) -> Deposits:
        lane = dr.arange(mi.UInt64, count) + dr.opaque(mi.UInt64, first)
        per_sample = dr.opaque(mi.UInt64, self.lanes)
        sample, within = mi.UInt32(lane // per_sample), mi.UInt32(lane % per_sample)
        pixels = dr.opaque(mi.UInt32, self.projector.n**2)
        pixel, anchor = within % pixels, within // pixels
        anchors = dr.opaque(mi.UInt32, self.anchors)
        row, column = anchor // anchors, anchor % anchors
        value, point = self._irradiance(seed, pixel, sample, row, column)
        near = dr.rcp(point.z)
        found = [np.array(one) for one in (value, pixel, row, column, -point.y * near, -point.x * near, near)]
        if not np.isfinite(found[0]).all():
            raise MitsimError("the scene reflects NaN or infinite light toward the camera; check its materials")
        lit = np.flatnonzero(found[0])
        light, source, a, b, tau_row, tau_column, inverse = (one[lit] for one in found)
        return Deposits(
            source=source.astype(np.int64),
            anchor_row=a.astype(np.int64),
            anchor_column=b.astype(np.int64),
            row=tau_row.astype(np.float64),
            column=tau_column.astype(np.float64),
            inverse_depth=inverse.astype(np.float64),
            value=light.astype(np.float64),
            order=np.full(lit.size, DIRECT, dtype=np.int16),
        )

    def _irradiance(self, seed: int, pixel: Any, sample: Any, row: Any, column: Any) -> tuple[Any, Any]:
        """Irradiance [W m^-2] of each connection, and the lit point in the camera's frame."""
        # Streams belong to pixels: every anchor is connected to the same points.
        jitter = stratified(sample, generator(dr.opaque(mi.UInt32, seed), pixel))
        rng = generator(dr.opaque(mi.UInt32, seed) ^ (sample * 0x9E3779B9 + 1), pixel)
        wavelengths, spectral = self.camera.sample_wavelengths(
            dr.zeros(mi.SurfaceInteraction3f), rng.next_float32(), True
        )
        ray, toward = self._ray(pixel, jitter, rng, wavelengths)
        si = self.scene.ray_intersect(ray)
        power = self._power(pixel, wavelengths)
        to_world = self.camera.world_transform()
        positions = mi.Float(self.positions.astype(np.float32))
        local = mi.Point3f(-dr.gather(mi.Float, positions, column), -dr.gather(mi.Float, positions, row), 0)
        if self.spread:
            side = 2 * dr.opaque(mi.Float, self.geometry.half_width)
            local = mi.Point3f((rng.next_float32() - 0.5) * side, (rng.next_float32() - 0.5) * side, 0)
        anchor = to_world @ local
        point = to_world.inverse() @ si.p
        offset = anchor - si.p
        squared = dr.squared_norm(offset)
        direction = offset * dr.rsqrt(squared)
        t = mi.Vector2f(point.x - local.x, point.y - local.y) / point.z
        stop = dr.opaque(mi.Float, self.geometry.tan_half_fov)
        active = si.is_valid() & (point.z > dr.opaque(mi.Float, self.geometry.mask_distance))
        active &= (dr.abs(t.x) <= stop) & (dr.abs(t.y) <= stop)
        active &= ~self.scene.ray_test(si.spawn_ray_to(anchor), active)
        si.wi = si.to_local(direction)
        reflected = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(toward), active)
        cosine = dr.rsqrt(1 + dr.squared_norm(t))
        geometric = dr.abs(dr.dot(si.n, direction)) * cosine / (squared * dr.abs(dr.dot(si.n, toward)))
        if self.geometry.angular_exponent > 0:
            geometric *= dr.power(cosine, dr.opaque(mi.Float, self.geometry.angular_exponent))
        value = panchromatic(mi.unpolarized_spectrum(reflected) * power * spectral) * geometric
        return dr.select(active, value, 0), point

    def _ray(self, pixel: Any, jitter: Any, rng: Any, wavelengths: Any) -> tuple[Any, Any]:
        """A ray through a point of each pixel, and the direction back to the projector."""
        projector = self.projector
        n = dr.opaque(mi.UInt32, projector.n)
        row, column = mi.Float(pixel // n) + jitter.y, mi.Float(pixel % n) + jitter.x
        if projector.blur > 0:
            spot = mi.warp.square_to_std_normal(mi.Point2f(rng.next_float32(), rng.next_float32()))
            spread = dr.opaque(mi.Float, projector.blur)
            row, column = row + spread * spot.y, column + spread * spot.x
        u = (column + projector.first_column) / projector.canvas[1]
        v = (row + projector.first_row) / projector.canvas[0]
        x, y = ([dr.opaque(mi.Float, float(value)) for value in axis] for axis in (self._map.x, self._map.y))
        image = mi.Vector3f(x[0] * u + x[1], y[0] * v + y[1], 1)
        lens = mi.Vector3f(0)
        if projector.aperture > 0:
            disk = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(rng.next_float32(), rng.next_float32()))
            lens = mi.Vector3f(disk.x, disk.y, 0) * dr.opaque(mi.Float, projector.aperture)
            image = image - lens / dr.opaque(mi.Float, projector.focus)
        turn = mi.Matrix3f(self._map.turn.tolist())
        origin = mi.Point3f([float(value) for value in self._map.origin]) + turn @ lens
        direction = dr.normalize(turn @ image)
        return mi.Ray3f(origin, direction, 0.0, wavelengths), -direction

    def _power(self, pixel: Any, wavelengths: Any) -> Any:
        """Flux of each pixel [W m^-2 mm^2]: irradiance on the plane at unit distance times the pixel's area there."""
        projector, n = self.projector, dr.opaque(mi.UInt32, self.projector.n)
        u = (mi.Float(pixel % n) + 0.5 + projector.first_column) / projector.canvas[1]
        v = (mi.Float(pixel // n) + 0.5 + projector.first_row) / projector.canvas[0]
        centre = mi.Vector3f(
            float(self._map.x[0]) * u + float(self._map.x[1]), float(self._map.y[0]) * v + float(self._map.y[1]), 1
        )
        at = dr.zeros(mi.SurfaceInteraction3f)
        at.wavelengths = wavelengths
        depth = 1000.0  # mm; far from the projector float32 coordinates do not matter
        turn = mi.Matrix3f(self._map.turn.tolist())
        at.p = mi.Point3f([float(value) for value in self._map.origin]) + turn @ (centre * depth)
        _, weight = projector.emitter.sample_direction(at, mi.Point2f(0.5), True)
        area = abs(self._map.x[0] * self._map.y[0]) / (projector.canvas[0] * projector.canvas[1])
        return weight * (depth**2 * dr.rsqrt(dr.squared_norm(centre)) * float(area))
