"""Connections to the projector: from points of the scene to its lens, each with the projector pixel that it used.

A pinhole is the stock Mitsuba ``projector``. With a lens of finite radius, a point q of the lens shows the pattern that
is sharp on the focus plane: a ray from q through surface point p carries the projector pixel whose image lies where the
ray meets that plane. Radiance is ``pi scale texture / (A cos^4 theta)``, so that a small lens of area A casts the
pinhole's irradiance. A blurred spot moves each connection by a normal deviate in projector pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsim.transport.projector import ProjectorOptics


@dataclass
class Connection:
    """From a scene point to the projector: unit direction, lens point, weight (radiance / pdf), pdf [1/sr], pixel.

    ``pdf`` is 0 for a pinhole, which no sampled direction can find.
    """

    direction: mi.Vector3f
    target: mi.Point3f
    weight: mi.Spectrum
    pdf: mi.Float
    pixel: mi.UInt32
    valid: mi.Bool


@dataclass
class LensHit:
    """A ray that met the lens: radiance, pdf [1/sr] of a :class:`Connection` along it, pixel, and whether it did."""

    radiance: mi.Spectrum
    pdf: mi.Float
    pixel: mi.UInt32
    met: mi.Bool


class ProjectorConnector:
    """Connections to one ``projector``; prepared once."""

    def __init__(self, projector: ProjectorOptics) -> None:
        self.projector, self.emitter = projector, projector.emitter
        if not projector.ideal:
            self._to_world = self.emitter.world_transform()
            self._pixel_at_unit = projector.pixel_size()

    def lens_point(self, rng: mi.PCG32) -> mi.Point3f:
        """A point of the lens in the projector's frame, drawn by ``rng``; the pinhole where there is none."""
        if self.projector.aperture == 0:
            return mi.Point3f(0)
        disk = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(rng.next_float32(), rng.next_float32()))
        return mi.Point3f(disk.x, disk.y, 0) * dr.opaque(mi.Float, self.projector.aperture)

    def connect(
        self, si: mi.SurfaceInteraction3f, rng: mi.PCG32, active: mi.Bool, lens: mi.Point3f | None = None
    ) -> Connection:
        """Connect surface points to the projector; visibility is the caller's.

        Parameters
        ----------
        si
            the points.
        rng
            random numbers for lens and spot, if there are any.
        active
            lanes that count.
        lens
            points of the lens; None: random ones.
        """
        if self.projector.ideal:
            ds, weight = self.emitter.sample_direction(si, mi.Point2f(0.5), active)
            return Connection(ds.d, ds.p, weight, mi.Float(0), self.projector.pixel_at(ds.uv), active & (ds.pdf > 0))
        local = self._to_world.inverse() @ si.p
        lens = self.lens_point(rng) if lens is None else lens
        offset = local - lens
        pixel, strength, valid = self._seen(lens, offset, rng, active & (local.z > 0))
        distance = dr.norm(offset)
        cosine = offset.z / distance
        # Irradiance on a plane z = const is pi scale texture / z^2 from every point of the lens.
        weight = strength / (dr.square(local.z) * cosine)
        target = self._to_world @ lens
        pdf = dr.square(distance) / (cosine * self._area) if self.projector.aperture > 0 else mi.Float(0)
        return Connection(dr.normalize(target - si.p), target, weight, pdf, pixel, valid)

    def hit(
        self, ray: mi.Ray3f, reach: mi.Float, rng: mi.PCG32, active: mi.Bool, since: mi.Float | float = 0.0
    ) -> LensHit:
        """Rays of random directions that meet the lens; needs a finite aperture.

        Parameters
        ----------
        ray
            in world coordinates.
        reach
            distance [mm] to what the ray meets in the scene: the lens must lie before it.
        rng
            random numbers for the spot, if it is blurred.
        active
            lanes that count.
        since
            distance [mm] from the surface that the direction was drawn at to where the ray starts.
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
        return LensHit(radiance, dr.square(distance + since) / (cosine * self._area), pixel, met)

    @property
    def _area(self) -> mi.Float:
        return dr.pi * dr.square(dr.opaque(mi.Float, self.projector.aperture))

    def _seen(
        self, lens: mi.Point3f, direction: mi.Vector3f, rng: mi.PCG32, active: mi.Bool
    ) -> tuple[mi.UInt32, mi.Spectrum, mi.Bool]:
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
        return self.projector.pixel_at(ds.uv), strength, active & (ds.pdf > 0)
