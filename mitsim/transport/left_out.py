"""Light that no tracer finds: a scene and its pinhole projector in, how much of it there is and over which mirror out.

Light that mirrors or curved glass bring both from the projector to a surface and from there to the camera (a print in a
bottle), or that comes over a mirror and a lobe too sharp for connections, and the part of indirect light that is
followed from the camera to a caustic: a path from the camera meets no pinhole, and none from the projector the sensor's
centre. A small lens in the pinhole's place casts the same light, and paths run into it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.rig.camera import CameraGeometry
from mitsim.transport.cells import CellGrid
from mitsim.transport.from_camera import CameraWalk, FromCameraTracer, Paths
from mitsim.transport.histogram import Deposits
from mitsim.transport.paths import camera_part
from mitsim.transport.projector import ProjectorOptics

_LENS = 0.02
"""Radius of the lens over the scene's distance: 8 mm at 400, which one path in 3000 meets from a matt surface."""
_SELDOM_MET = 1e3
"""Density [1/sr] of a turn above which connections seldom meet its lobe, a thousandth of a steradian, as of a GGX lobe
of roughness 0.009: direct light over such lobes is traced apart, light over a mirror besides is not."""


@dataclass(frozen=True)
class LeftOut:
    """Light that is left out.

    Attributes
    ----------
    irradiance
        at the sensor's centre [W m^-2].
    mirror
        place, among the scene's shapes, of the mirror or glass that most of it comes over; None where there is none.
    """

    irradiance: float = 0.0
    mirror: int | None = None


def left_out_light(
    scene: mi.Scene,
    camera: mi.Sensor,
    projector: ProjectorOptics,
    grid: CellGrid,
    geometry: CameraGeometry,
    seed: int,
    samples: int,
) -> LeftOut:
    """Light that is left out; none where a lens of its own lets it be found.

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
    if projector.aperture > 0:
        return LeftOut()
    lens = replace(projector, aperture=_LENS * geometry.scene_distance, focus=geometry.scene_distance)
    paths = Paths(mirrors=True, interreflection=True)
    found = _LeftOutTracer(scene, camera, lens, grid, paths, geometry).trace(seed, 0, samples)
    light = np.bincount(found.pixel, found.value)
    if not light.size:
        return LeftOut()
    shapes = np.array(dr.reinterpret_array(mi.UInt32, scene.shapes_dr()))
    place = np.flatnonzero(shapes == np.argmax(light))
    return LeftOut(float(light.sum()) / samples, int(place[0]))


class _LeftOutTracer(FromCameraTracer):
    """Light that no other tracer finds, filed under the mirror that it meets last, seen from the camera."""

    def _launch(self, seed: int, sample: mi.UInt32, lane: mi.UInt32) -> list[Deposits]:
        return _LeftOutWalk(self, seed, sample, lane).deposits(further=True)


class _LeftOutWalk(CameraWalk):
    """Paths from the camera that only running into the lens can end."""

    STATE: ClassVar[tuple[str, ...]] = (*CameraWalk.STATE, "mirror")

    def __init__(self, tracer: FromCameraTracer, seed: int, sample: mi.UInt32, lane: mi.UInt32) -> None:
        super().__init__(tracer, seed, sample, lane)
        self.mirror = mi.UInt32(0)

    def _connect(self, si: mi.SurfaceInteraction3f, bsdf: mi.BSDF) -> None:
        """Nothing: what connections find is not left out."""

    def _projector_hit(self, si: mi.SurfaceInteraction3f) -> None:
        """Light that a mirror brings from the lens to the last surface, or over a mirror and a sharp lobe."""
        active = (self._foreign & self.by_delta) | self._over_mirror_and_lobe()
        hit = self.connector.hit(self.ray, si.t, self.rng, active, self.since)
        self._keep_of_projector(hit.met, self._radiance(hit.radiance), self.mirror, self.surfaces - 1)

    def _over_mirror_and_lobe(self) -> mi.Bool:
        """Paths over one sharp lobe that was seen in a mirror, or whose light came over one: connections of either side
        would have to meet the lobe by chance."""
        seen = self.in_mirror & ~self.by_delta & (self.came_pdf > _SELDOM_MET)
        lit = ~self.in_mirror & self.by_delta & (self.part > camera_part(mi.Float(_SELDOM_MET)))
        return self.active & (self.surfaces == 2) & (seen | lit)

    def _leave(self, si: mi.SurfaceInteraction3f, first: bool) -> mi.Bool:
        passing = super()._leave(si, first)
        met = dr.select(si.instance != None, si.instance, si.shape)  # noqa: E711 - a Dr.Jit comparison, lane by lane
        self.mirror = dr.select(self.by_delta & ~passing, dr.reinterpret_array(mi.UInt32, met), self.mirror)
        return passing
