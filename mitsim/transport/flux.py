"""Direct light on the sensor as a whole: from projector pixels to the mean irradiance that each casts, over any lobe.

With A the sensor's area, a connection to an even point of it finds the irradiance I there; over glossy surfaces a turn
that is sampled as the surface scatters, and lands on the sensor with density q [1/mm^2], finds I / (A q). By the
balance heuristic (Veach 1997, 9.2) either counts I / (1 + A q): unbiased, and bounded however sharp the lobe.
"""

from __future__ import annotations

from copy import copy

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.rig.camera import CameraGeometry
from mitsim.transport.direct import DirectTracer
from mitsim.transport.histogram import check_finite
from mitsim.transport.landing import landing
from mitsim.transport.paths import launches
from mitsim.transport.projector import ProjectorOptics
from mitsim.transport.receiver import Reception

IntArray = npt.NDArray[np.int64]


class FluxTracer(DirectTracer):
    """Direct light at the sensor as a whole, of each projector pixel."""

    def __init__(
        self,
        scene: mi.Scene,
        camera: mi.Sensor,
        projector: ProjectorOptics,
        geometry: CameraGeometry,
        glossy: bool = False,
    ) -> None:
        """What is followed.

        Parameters
        ----------
        scene, camera, projector
            as loaded.
        geometry
            stands in for the camera's own.
        glossy
            whether the scene has glossy surfaces, whose turns are sampled too.
        """
        super().__init__(scene, camera, projector, 1, geometry, spread=True)
        self._glossy = glossy

    def at(self, pixels: IntArray) -> FluxTracer:
        """The same for the projector pixels ``pixels`` (m,) alone."""
        part = copy(self)
        part._pixels = pixels
        return part

    def sums(self, seed: int, first: int = 0, samples: int = 1) -> FloatArray:
        """(m,) light of each pixel, summed over some samples [W m^-2].

        Parameters
        ----------
        seed, first, samples
            as for :meth:`mitsim.transport.paths.Tracer.trace`.

        Raises
        ------
        MitsimError
            when the scene sends NaN or infinite light to the camera.
        """
        lanes = len(self._pixels)
        total = np.zeros(lanes)
        for sample, lane in launches(lanes, first, samples, lanes * max(1, self.lanes_per_launch // lanes)):
            seen, *_ = self._sightings(seed, sample, lane)
            light = np.array(seen.value).reshape(-1, lanes)
            check_finite(light)
            total += light.sum(axis=0, dtype=np.float64)
        return total

    def _received(
        self,
        si: mi.SurfaceInteraction3f,
        direction: mi.Vector3f,
        light: mi.Spectrum,
        sensor: mi.Point3f,
        active: mi.Bool,
        rng: mi.PCG32,
    ) -> tuple[Reception, mi.Float]:
        if not self._glossy:
            return super()._received(si, direction, light, sensor, active, rng)
        si.wi = si.to_local(-direction)
        context = mi.BSDFContext(mi.TransportMode.Importance)
        number, point = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        turn, _ = si.bsdf().sample(context, si, number, point, active)
        lobe = active & (turn.pdf > 0) & ~mi.has_flag(turn.sampled_type, mi.BSDFFlags.Delta)
        place = landing(self.receiver, si, si.to_world(turn.wo), lobe)
        half = dr.opaque(mi.Float, self.receiver.geometry.half_width)
        lobe = place.arrives & (dr.abs(place.x) <= half) & (dr.abs(place.y) <= half)
        met = self._shared(si, direction, light, mi.Point3f(place.x, place.y, 0), lobe)
        connected = self._shared(si, direction, light, sensor, active)
        return connected[0], connected[1] + met[1]

    def _shared(
        self,
        si: mi.SurfaceInteraction3f,
        direction: mi.Vector3f,
        light: mi.Spectrum,
        point: mi.Point3f,
        active: mi.Bool,
    ) -> tuple[Reception, mi.Float]:
        """What comes to ``point`` of the sensor, over 1 + A q."""
        reception, value = self._connected(si, direction, light, point, active)
        si.wi = si.to_local(-direction)
        context = mi.BSDFContext(mi.TransportMode.Importance)
        density = si.bsdf().pdf(context, si, si.to_local(reception.direction), active)
        area = 4 * dr.square(dr.opaque(mi.Float, self.receiver.geometry.half_width))
        met = value > 0
        return reception, dr.select(met, value / (1 + area * density * reception.solid_angle(point)), 0)
