"""Light that no tracer finds: a scene and its pinhole projector in, how much of it there is and over which shape out.

Light that mirrors or curved glass bring both from the projector to a surface and from there to the camera (a print in a
bottle), and the part of indirect light that is followed from the camera to a caustic: a path from the camera meets no
pinhole, and none from the projector the sensor's centre. A small lens in the pinhole's place casts the same light, and
paths run into it. A lens of the projector's own they run into as well, but seldom where it is smaller.

So do paths over one mirror and one sharp lobe. Connections may meet such a lobe by chance: of the projector's side from
the lobe to the sensor, of the camera's side from the lobe, seen in a mirror, to the projector. With x the light of a
path that runs into the lens and I that of the connection along the same way, E[x I] is a connection's second moment, so
a sample of connections sees the light L of a shape's lobes as ``L^2 / E[x I]`` equal hits would
(:mod:`mitsim.transport.sharp_lobes`). Whether that is enough, whoever asks knows: lobes of curved surfaces are met
seldom however broad they are."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.devices.camera import CameraGeometry
from mitsim.transport.connect import sampled_wavelengths
from mitsim.transport.connection import LensHit
from mitsim.transport.from_camera import CameraWalk, FromCameraTracer, Paths
from mitsim.transport.integrator import camera_part
from mitsim.transport.projector import ProjectorOptics, ProjectorRays
from mitsim.transport.records import DIRECT, INDIRECT, CellGrid, Deposits, Sightings
from mitsim.transport.sampler import panchromatic, streams
from mitsim.transport.transmission import Passage

_LENS = 0.02
"""Radius of the lens over the scene's distance: 8 mm at 400, which one path in 3000 meets from a matt surface."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Light that is left out, by the place among the scene's shapes of what it comes over, (k,) each.

    Attributes
    ----------
    mirrors, lens_hits
        irradiance at the sensor's centre [W m^-2] that no connection finds, by the last mirror or glass, seen from the
        camera; equal hits of the projector's own lens that a sample of paths makes.
    lobes, hits
        irradiance over a mirror and one sharp lobe, by the shape that has the lobe; equal hits that a sample of
        connections makes.
    """

    mirrors: FloatArray
    lens_hits: FloatArray
    lobes: FloatArray
    hits: FloatArray

    @classmethod
    def none(cls) -> LeftOut:
        """Nothing."""
        return cls(*np.zeros((4, 0)))

    def unseen(self, fewest: float, of_lens: float) -> tuple[float, int | None]:
        """Irradiance that nothing tells of, and over which shape most of it comes.

        ``fewest``: hits of a sample that tell of a lobe; ``of_lens``: of the projector's own lens, that tell of light.
        """
        light = np.where(self.lens_hits < of_lens, self.mirrors, 0) + np.where(self.hits < fewest, self.lobes, 0)
        return float(light.sum()), int(np.argmax(light)) if light.any() else None


def left_out_light(
    scene: mi.Scene,
    camera: mi.Sensor,
    projector: ProjectorOptics,
    grid: CellGrid,
    geometry: CameraGeometry,
    seed: int,
    samples: int,
) -> LeftOut:
    """Light that is left out, or may be.

    Parameters
    ----------
    scene, camera, projector
        what light meets, the sensor that it is received on, and where it comes from.
    grid, geometry
        cells that paths start in, and the camera's own.
    seed, samples
        of the random numbers, and paths of each cell.

    Raises
    ------
    MitsimError
        when the scene sends NaN or infinite light to the camera.
    """
    lens = replace(projector, aperture=_LENS * geometry.scene_distance, focus=geometry.scene_distance)
    paths = Paths(mirrors=True, interreflection=True)
    found = _LeftOutTracer(scene, camera, lens, grid, paths, geometry).trace(seed, 0, samples)
    # Deposits name shapes by their number in Dr.Jit's registry.
    numbers = np.array(dr.reinterpret_array(mi.UInt32, scene.shapes_dr())).astype(np.int64)

    def by_shape(light: Deposits, values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(light.pixel, values, int(numbers.max()) + 1)[numbers] / samples)

    lost, met = (found.where(found.kind == kind) for kind in (INDIRECT, DIRECT))
    mirrors, hits = _seen(by_shape(lost, lost.value), by_shape(lost, np.square(lost.value)))
    # A lens of half the radius is met a quarter as often, and four times as bright.
    seldom = np.square(projector.aperture / lens.aperture)
    return LeftOut(mirrors, hits * seldom, *_seen(by_shape(met, met.value), by_shape(met, met.value * met.row)))


def _seen(light: FloatArray, moments: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``light`` (k,) by shape, and from the second ``moments`` of a sample how many equal hits it is."""
    return light, np.divide(np.square(light), moments, out=np.zeros(len(light)), where=light > 0)


class _LeftOutTracer(FromCameraTracer):
    """Light that a lens would bring, filed under shapes: that which no connection finds as indirect light, that over a
    mirror and a lobe as direct light, with what a connection brings in the row's stead."""

    def _launch(self, seed: mi.UInt32, sample: mi.UInt32, lane: mi.UInt32) -> list[Deposits]:
        return _LeftOutWalk(self, seed, sample, lane).deposits(further=True)


class _LeftOutWalk(CameraWalk):
    """Paths from the camera that only running into the lens can end.

    ``mirror`` and ``lobe`` are the last shape of either kind that a path met, ``density`` that of the turn there.
    """

    STATE: ClassVar[tuple[str, ...]] = (*CameraWalk.STATE, "mirror", "lobe", "density")

    def __init__(self, tracer: FromCameraTracer, seed: int, sample: mi.UInt32, lane: mi.UInt32) -> None:
        super().__init__(tracer, seed, sample, lane)
        self.mirror, self.lobe, self.density = mi.UInt32(0), mi.UInt32(0), mi.Float(0)
        self.rays = ProjectorRays(tracer.projector)

    def _connect(self, si: mi.SurfaceInteraction3f, bsdf: mi.BSDF) -> None:
        """Nothing: what connections find is not left out."""

    def _projector_hit(self, si: mi.SurfaceInteraction3f) -> None:
        """Light that mirrors bring from the lens to the last surface, or over a mirror and a sharp lobe."""
        lost = self._foreign & self.by_delta
        once = self.active & (self.surfaces == 2) & (self.in_mirror != self.by_delta)
        met = once & (camera_part(self.density) > 0)
        hit = self.connector.hit(self.ray, si.t, self.rng, lost | met, self.since)
        light, none = self._radiance(hit.radiance), mi.Float(0)
        missed = dr.select(hit.met & lost, light * self.part, 0)
        self._keep("indirect", Sightings.of(missed, self.by_line, self.mirror, none, none, none))
        met &= hit.met
        in_mirror = panchromatic(light) * self.density / hit.pdf
        connected = dr.select(met, dr.select(self.in_mirror, in_mirror, self._lit(hit)), 0)
        seen = Sightings.of(dr.select(met, light, 0), self.by_line, self.lobe, connected, none, none)
        self._keep("direct", seen)

    def _lit(self, hit: LensHit) -> mi.Float:
        """What a connection of the projector's side, from the first surface to the sensor, brings [W m^-2]."""
        grid = self.tracer.grid
        flux = self.rays.flux(hit.pixel, self.ray.wavelengths)
        # The path's weight without its part of the view; its first surface is at 1 / (inverse depth * slope).
        view = dr.opaque(mi.Float, grid.rows.size * grid.columns.size) * dr.square(dr.square(self.slope))
        return (
            panchromatic(self._radiance(flux))
            / view
            * self.density
            * self.slope
            * dr.square(self.inverse_depth * self.slope)
        )

    def _leave(self, si: mi.SurfaceInteraction3f, first: bool) -> mi.Bool:
        passing = super()._leave(si, first)
        shape = dr.reinterpret_array(mi.UInt32, dr.select(si.instance != None, si.instance, si.shape))  # noqa: E711
        turned = ~passing & ~self.by_delta
        self.mirror = dr.select(~passing & self.by_delta, shape, self.mirror)
        self.lobe = dr.select(turned, shape, self.lobe)
        self.density = dr.select(turned, self.came_pdf, self.density)
        return passing


def polished_shapes(scene: mi.Scene) -> tuple[int, ...]:
    """Places, among the shapes of a ``scene``, of those that reflect or bend light into single directions."""
    polished = int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.DeltaTransmission)
    shapes = enumerate(scene.shapes())
    return tuple(number for number, shape in shapes if shape.bsdf() is not None and shape.bsdf().flags() & polished)


# -------- Light of a lamp onto the sensor, over no surface

_POINTS = 9
"""Points along each side of the sensor, its edges with them: things in the way are larger than an eighth of it."""
_SAMPLES = 2**10
"""Points of a lamp: how much of it is seen is known to some percent."""


def shines_in(scene: mi.Scene, camera: mi.Sensor, lamp: mi.Emitter) -> bool:
    """Whether a point of the sensor sees the ``lamp`` within the field stop.

    Parameters
    ----------
    scene, camera
        what may stand in the way, and the sensor.
    lamp
        a point, spot or directional one.
    """
    edge = np.linspace(-1, 1, _POINTS) * camera.geometry.half_width
    x, y = (mi.Float(axis.ravel()) for axis in np.meshgrid(edge, edge))
    to_world, sensor = camera.world_transform(), dr.zeros(mi.SurfaceInteraction3f, _POINTS**2)
    sensor.p = to_world @ mi.Point3f(x, y, 0)
    _, rng = streams(0, dr.arange(mi.UInt32, _POINTS**2), mi.UInt32(0))
    sensor.wavelengths, _ = sampled_wavelengths(camera, rng)
    ds, light = lamp.sample_direction(sensor, mi.Point2f(0.5), True)
    met = _in_view(camera, ds.d) & (dr.max(mi.unpolarized_spectrum(light)) > 0)
    seen, _ = Passage(scene).between(sensor, ds.p, met)
    return bool(np.array(met & seen).any())


def part_of_view(scene: mi.Scene, camera: mi.Sensor, shape: mi.Shape) -> float:
    """Part of the field stop, in tan-angles, in which the sensor's centre sees a ``shape`` that shines; where nothing
    is before it.

    Parameters
    ----------
    scene, camera, shape
        as of :func:`shines_in`; the side that shines counts.
    """
    _, rng = streams(0, dr.arange(mi.UInt32, _SAMPLES), mi.UInt32(0))
    to_world, place = (
        camera.world_transform(),
        shape.sample_position(0, mi.Point2f(rng.next_float32(), rng.next_float32())),
    )
    sensor = dr.zeros(mi.SurfaceInteraction3f, _SAMPLES)
    sensor.p = to_world @ mi.Point3f(0)
    way = place.p - sensor.p
    distance = dr.norm(way)
    way /= distance
    facing = -dr.dot(place.n, way)
    met = _in_view(camera, way) & (facing > 0)
    seen, _ = Passage(scene).between(sensor, place.p, met)
    # Of dA on the lamp, in solid angle and on the plane at unit distance.
    area = facing / distance**2 / (to_world.inverse() @ way).z ** 3
    total = float(np.array(dr.select(met & seen, area, 0)).mean()) * float(shape.surface_area()[0])
    return total / float(2 * camera.geometry.tan_half_fov) ** 2


def _in_view(camera: mi.Sensor, direction: mi.Vector3f) -> mi.Bool:
    """Whether light from a ``direction`` comes through the field stop."""
    toward = camera.world_transform().inverse() @ direction
    stop = camera.geometry.tan_half_fov * toward.z
    return (dr.abs(toward.x) <= stop) & (dr.abs(toward.y) <= stop)
