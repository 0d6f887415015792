"""Direct light: every projector pixel's rays, followed to the first surface and on to each anchor of the sensor.

A ray meets a surface at P, and P is connected to every anchor (:mod:`mitsim.transport.receiver`), or to one random
point of the sensor. All anchors see the same points.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.optics.anchors import anchor_positions
from mitsim.rig.camera import CameraGeometry
from mitsim.transport.histogram import DIRECT, Deposits
from mitsim.transport.paths import launches
from mitsim.transport.rays import ProjectorRays
from mitsim.transport.receiver import Receiver
from mitsim.transport.sampling import panchromatic, stratified, streams
from mitsim.transport.source import Projector

IntArray = npt.NDArray[np.int64]


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
        pixels: IntArray | None = None,
    ) -> None:
        """``spread`` connects to random points of the sensor, all filed as one anchor: the mean over the sensor.

        ``geometry`` stands in for the camera's own; ``pixels`` (m,) are those of the projector that are traced, all of
        them without it.
        """
        self._pixels = np.arange(projector.n**2) if pixels is None else pixels
        self.scene, self.projector, self.anchors, self.spread = scene, projector, anchors, spread
        self.rays, self.receiver = ProjectorRays(projector), Receiver(scene, camera, geometry)
        self.positions = anchor_positions(anchors, self.receiver.geometry.half_width)

    @property
    def lanes(self) -> int:
        """Connections of one sample: one per projector pixel and anchor."""
        return len(self._pixels) * self.anchors**2

    def trace(self, seed: int, first: int = 0, samples: int = 1) -> Deposits:
        """Samples ``first`` .. ``first + samples - 1`` of every pixel, as if ``samples`` of them were all.

        Raises
        ------
        MitsimError
            when the scene sends NaN or infinite light to the camera.
        """
        parts = [self._launch(seed, *lanes) for lanes in launches(self.lanes, first, samples)]
        return Deposits.joined(parts)

    def _launch(self, seed: int, sample: Any, within: Any) -> Deposits:
        count = dr.opaque(mi.UInt32, len(self._pixels))
        pixel, anchor = dr.gather(mi.UInt32, mi.UInt32(self._pixels), within % count), within // count
        anchors = dr.opaque(mi.UInt32, self.anchors)
        row, column = anchor // anchors, anchor % anchors
        # Streams belong to pixels: every anchor is connected to the same points.
        shared, rng = streams(seed, pixel, sample)
        jitter = stratified(sample, shared)
        wavelengths, spectral = self.receiver.wavelengths(rng)
        ray = self.rays.sample(pixel, jitter, rng, wavelengths)
        si = self.scene.ray_intersect(ray)
        found = self.receiver.receive(si, -ray.d, self._sensor_point(row, column, rng), si.is_valid())
        value = panchromatic(found.irradiance * self.rays.flux(pixel, wavelengths) * spectral)
        return Deposits.fetched(
            value, pixel, found.tau_row, found.tau_column, found.near, DIRECT, anchor_row=row, anchor_column=column
        )

    def _sensor_point(self, row: Any, column: Any, rng: Any) -> Any:
        """Anchors, or random points of the sensor, in the camera's frame."""
        if self.spread:
            side = 2 * dr.opaque(mi.Float, self.receiver.geometry.half_width)
            return mi.Point3f((rng.next_float32() - 0.5) * side, (rng.next_float32() - 0.5) * side, 0)
        positions = mi.Float(self.positions.astype(np.float32))
        return mi.Point3f(-dr.gather(mi.Float, positions, column), -dr.gather(mi.Float, positions, row), 0)
