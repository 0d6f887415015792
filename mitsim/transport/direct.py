"""Direct light: every projector pixel's rays, followed to the first surface and on to each anchor of the sensor.

A ray meets a surface at P, and P is connected to every anchor (:mod:`mitsim.transport.receiver`), or to one random
point of the sensor; those are as even as the places in the projector's pixels, and together with them. All anchors see
the same points. Where surfaces let light pass (:mod:`mitsim.transport.passage`), so does the ray: of the points that it
meets one is handed out, drawn in proportion to its light.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.rig.camera import CameraGeometry
from mitsim.transport.histogram import DIRECT, Deposits, Sightings
from mitsim.transport.ledger import Ledger
from mitsim.transport.paths import Tracer
from mitsim.transport.projector import ProjectorOptics, ProjectorRays
from mitsim.transport.receiver import Receiver, Reception, SensorPoints, sampled_wavelengths
from mitsim.transport.sampling import shuffled, stratified, streams

IntArray = npt.NDArray[np.int64]
_LOBE = 2.0**8
"""Bright light over a board's. Mitsuba takes no roughness below 1e-4, whose lobe is 2.5e7 times as bright in its middle
as a board; ledgers pass 2^22 times what is bright, 40 times that, and round light to 1.2e-7 of a board's."""


class DirectTracer(Tracer):
    """Direct light of a projector at a number of anchors."""

    def __init__(
        self,
        scene: mi.Scene,
        camera: mi.Sensor,
        projector: ProjectorOptics,
        anchors: int,
        geometry: CameraGeometry | None = None,
        spread: bool = False,
        pixels: IntArray | None = None,
    ) -> None:
        """What is followed.

        Parameters
        ----------
        scene, camera, projector
            as loaded.
        anchors
            sensor points a side that light is connected to.
        geometry
            stands in for the camera's own.
        spread
            connect to random points of the sensor instead, all filed as one anchor: the mean over the sensor.
        pixels
            (m,) of the projector that are traced; None: all.
        """
        self._pixels = np.arange(projector.n**2) if pixels is None else pixels
        self.scene, self.projector = scene, projector
        self.rays, self.receiver = ProjectorRays(projector), Receiver(scene, camera, geometry)
        self.points = SensorPoints(self.receiver.geometry.half_width, anchors, spread)

    @cached_property
    def board(self) -> float:
        """Irradiance [W m^-2] that light compares to: bright light, of sharp lobes too."""
        return _LOBE * self.receiver.of_board(self.rays)

    @property
    def lanes(self) -> int:
        """Connections of one sample: one per projector pixel and anchor."""
        return len(self._pixels) * self.points.count

    def trace_into(self, ledgers: Sequence[Ledger], seed: int, first: int, samples: int) -> Deposits:
        """The same as :meth:`trace`, all light filed in ledgers; none is left for the host.

        Parameters
        ----------
        ledgers
            of light by pixel; of several lines, one for each.
        seed, first, samples
            as for :meth:`trace`.
        """
        for tracer in self.apart:
            for sample, lane in self._launches(first, samples):
                seen, _, anchor = tracer._sightings(seed, sample, lane)
                lights = seen.by_line(len(ledgers))
                for place, share in ledgers[0].shares(seen, anchor):
                    for ledger, light in zip(ledgers, lights, strict=True):
                        ledger.add(light * share, seen.pixel, place, ~(light == 0))  # not a number is refused
                dr.eval([ledger.sums for ledger in ledgers])
        return Deposits.none()

    def _launch(self, seed: mi.UInt32, sample: mi.UInt32, lane: mi.UInt32) -> list[Deposits]:
        return [Deposits.fetched(*self._sightings(seed, sample, lane))]

    def _sightings(
        self, seed: int | mi.UInt32, sample: mi.UInt32, lane: mi.UInt32
    ) -> tuple[Sightings, int, tuple[mi.UInt32, mi.UInt32]]:
        """Light of each lane, its kind, and its anchor."""
        number, anchor, share = self._pair(seed, sample, lane)
        pixel = dr.gather(mi.UInt32, mi.UInt32(self._pixels), number)
        anchors = dr.opaque(mi.UInt32, self.points.anchors)
        row, column = anchor // anchors, anchor % anchors
        # Streams belong to pixels: every anchor is connected to the same points.
        shared, rng = streams(seed, pixel, sample)
        jitter, weight = self._place(number, row, column, stratified(sample, shared))
        wavelengths, spectral = sampled_wavelengths(self.receiver.camera, rng, self.projector.lines)
        ray = self.rays.sample(pixel, jitter, rng, wavelengths)
        sensor = self._sensor(row, column, sample, shared, rng)
        flux = self.rays.flux(pixel, wavelengths) * spectral * (weight * share)

        def seen_at(
            si: mi.SurfaceInteraction3f,
            direction: mi.Vector3f,
            light: mi.Spectrum,
            active: mi.Bool,
            state: tuple[Sightings, mi.PCG32],
        ) -> tuple[Sightings, mi.PCG32]:
            seen, rng = state
            reception, received = self._received(si, direction, light, sensor, active, rng)
            return seen.joined_by(reception.sightings(received, pixel, by_line), rng.next_float32()), rng

        by_line = self.projector.by_line
        seen, _ = self.receiver.passage.along(ray, flux, (Sightings.none(by_line), rng), seen_at)
        return seen, DIRECT, (row, column)

    def _received(
        self,
        si: mi.SurfaceInteraction3f,
        direction: mi.Vector3f,
        light: mi.Spectrum,
        sensor: mi.Point3f,
        active: mi.Bool,
        rng: mi.PCG32,
    ) -> tuple[Reception, mi.UnpolarizedSpectrum]:
        """What ``light`` that comes to surfaces in a ``direction`` brings to ``sensor`` points."""
        del rng
        return self._connected(si, direction, light, sensor, active)

    def _connected(
        self,
        si: mi.SurfaceInteraction3f,
        direction: mi.Vector3f,
        light: mi.Spectrum,
        sensor: mi.Point3f,
        active: mi.Bool,
    ) -> tuple[Reception, mi.UnpolarizedSpectrum]:
        """The same by one connection."""
        reception = self.receiver.receive(si, -direction, sensor, active)
        return reception, reception.irradiance * light

    def _pair(self, seed: int | mi.UInt32, sample: mi.UInt32, lane: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
        """A lane's place in the list of pixels, its anchor, and its weight."""
        del seed, sample
        count = dr.opaque(mi.UInt32, len(self._pixels))
        return lane % count, lane // count, mi.Float(1)

    def _place(
        self, number: mi.UInt32, row: mi.UInt32, column: mi.UInt32, jitter: mi.Point2f
    ) -> tuple[mi.Point2f, mi.Float]:
        """Where in its pixel a ray starts, by the pixel's place in the list and the anchor, and the ray's weight."""
        del number, row, column
        return jitter, mi.Float(1)

    def _sensor(
        self, row: mi.UInt32, column: mi.UInt32, sample: mi.UInt32, shared: mi.PCG32, rng: mi.PCG32
    ) -> mi.Point3f:
        """Points of the sensor, in the camera's frame; ``shared`` belongs to all samples of a stream."""
        if self.points.spread:
            # A sixth of the variance of plain random points in compact_disc, half in gift_card (32 samples a pixel).
            return self.points.inside(stratified(shuffled(sample, shared), shared))
        return self.points.at(row, column, rng)
