"""What traces the light of a bench with settings: one tracer for each pass, prepared when it is first asked for."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from mitsim.core.arrays import Labels
from mitsim.light.grids import Grids
from mitsim.transport.connect import SensorPoints
from mitsim.transport.direct import AimedTracer, DirectTracer
from mitsim.transport.from_camera import Counted, FromCameraTracer, LampTracer, Paths, Together
from mitsim.transport.indirect import IndirectTracer
from mitsim.transport.path_reuse import NeighbourTracer

FromCamera = FromCameraTracer | Together
"""What follows light from the camera's side."""
PassTracer = DirectTracer | IndirectTracer | FromCamera
"""What traces a pass."""


class Tracers(Grids):
    """What is traced of a bench with settings; its parameters are those of :class:`mitsim.light.grids.Grids`."""

    # ---- Direct light

    @cached_property
    def direct(self) -> DirectTracer:
        """Follows direct light from the projector to the sensor's centre, or to all of it where anchors are used."""
        return self._direct(1, spread=self.settings.anchors > 1)

    @property
    def spread(self) -> DirectTracer:
        """Follows direct light to random points of the sensor."""
        return self._direct(1, spread=True)

    @cached_property
    def anchored(self) -> DirectTracer | None:
        """The same to every anchor, but for occluded pixels."""
        settings = self.settings
        return self._direct(settings.anchors, settings.with_own_anchors) if settings.anchors > 1 else None

    @cached_property
    def anchored_occluded(self) -> DirectTracer | None:
        """Follows direct light of occluded pixels to anchors of their own; none where there are none."""
        settings = self.settings
        others = np.setdiff1d(np.arange(self.bench.n**2), settings.with_own_anchors)
        return self._direct(settings.occluded_anchors, others) if settings.with_own_anchors else None

    @cached_property
    def sharp(self) -> AimedTracer | None:
        """Follows direct light of the sharp pixels to their anchors; none where there are none."""
        loaded, physics, sharp = self.bench.loaded, self.physics, self.settings.sharp
        if sharp is None:
            return None
        parts = loaded.scene, loaded.camera, physics.projector, sharp.anchors, physics.geometry
        return AimedTracer(*parts, np.array(sharp.pixels))

    def _direct(self, anchors: int, without: Labels | tuple[int, ...] = (), spread: bool = False) -> DirectTracer:
        """Of all pixels that are not sharp, ``without`` some."""
        loaded, physics, sharp = self.bench.loaded, self.physics, self.settings.sharp
        absent = np.union1d(without, sharp.pixels if sharp else ()).astype(np.int64)
        pixels = np.setdiff1d(np.arange(self.bench.n**2), absent) if len(absent) else None
        return DirectTracer(loaded.scene, loaded.camera, physics.projector, anchors, physics.geometry, spread, pixels)

    # ---- Light that is followed further

    @cached_property
    def indirect(self) -> IndirectTracer | None:
        """Follows light over several surfaces from the projector to the sensor's centre, or to all of it where it has
        anchors; none where there is none."""
        tracer, repeats = self._indirect(self._mean_points, self.settings.shared), self.settings.repeats
        return tracer.repeating(repeats) if tracer and repeats else tracer

    @cached_property
    def from_camera(self) -> FromCamera | None:
        """Follows all other light, from the same points; none where there is none."""
        return self._from_camera(self._mean_points)

    @cached_property
    def at_anchors(self) -> tuple[IndirectTracer | None, FromCamera | None]:
        """Both, to every anchor of followed light."""
        points = self._points(self.settings.followed_anchors)
        return self._indirect(points), self._from_camera(points)

    @property
    def _mean_points(self) -> SensorPoints:
        return self._points(1, self.settings.followed_anchors > 1)

    @property
    def lamps_apart(self) -> bool:
        """Whether lamps' paths are followed for no light of the projector."""
        return not self._from_camera_of_projector

    @property
    def _from_camera_of_projector(self) -> bool:
        return self.physics.mirrors or (self.physics.interreflection and self.bench.loaded.glossy)

    def _points(self, anchors: int, spread: bool = False) -> SensorPoints:
        return SensorPoints(self.physics.geometry.half_width, anchors, spread, self.settings.depth)

    def _indirect(self, points: SensorPoints, shared: bool = False) -> IndirectTracer | None:
        loaded, physics = self.bench.loaded, self.physics
        paths = physics.mirrors, physics.interreflection
        if not any(paths):
            return None
        parts = loaded.scene, loaded.camera, physics.projector, *paths, physics.geometry, points
        return NeighbourTracer(*parts) if shared else IndirectTracer(*parts)

    def _from_camera(self, points: SensorPoints) -> FromCamera | None:
        loaded, physics, lamplight = self.bench.loaded, self.physics, self.bench.lamplight
        of_projector = self._from_camera_of_projector
        if not (physics.lamps or of_projector):
            return None
        paths = Paths(physics.mirrors, physics.interreflection, physics.lamps)
        parts = loaded.scene, loaded.camera, physics.projector
        tracer = FromCameraTracer(*parts, self.aim, paths, physics.geometry, points)
        if lamplight is None or not physics.lamps:
            return tracer
        # Lamps have wavelengths of their own, and filters of each colour count them on their own.
        units = lamplight.units_of(self.bench.projector.lines)
        lamps: list[FromCameraTracer] = []
        for number, response in enumerate(lamplight.responses):
            rows = lamplight.rows(number)
            own = [unit * response.part for unit in units]
            lamps.append(LampTracer(tracer, Counted(response, lamplight.bands[rows], own, rows.start)))
        if of_projector:
            lamps.insert(0, FromCameraTracer(*parts, self.aim, replace(paths, emitters=()), physics.geometry, points))
        return lamps[0] if len(lamps) == 1 else Together(*lamps)
