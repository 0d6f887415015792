"""Direct light: every projector pixel's rays, followed to the first surface and on to each anchor of the sensor.

A ray meets a surface at P, and P is connected to every anchor (:mod:`mitsim.transport.connect`), or to one random point
of the sensor; those are as even as the places in the projector's pixels, and together with them. All anchors see the
same points. Where surfaces let light pass (:mod:`mitsim.transport.transmission`), so does the ray: of the points that
it meets one is handed out, drawn in proportion to its light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.devices.projector import Lines
from mitsim.transport.accumulator import DeviceAccumulator
from mitsim.transport.connect import OpticalSetup, Reception, SensorPoints, landing, sample_wavelengths
from mitsim.transport.integrator import PATHS_PER_LAUNCH, InFlight, Tracer
from mitsim.transport.records import DIRECT, PathSamples, Sightings, check_finite
from mitsim.transport.sampler import shuffled, split_by_line, stratified, streams
from mitsim.transport.transmission import Arrival

IntArray = npt.NDArray[np.int64]
_LOBE = 2.0**8
"""Bright light over a board's. Mitsuba takes no roughness below 1e-4, whose lobe is 2.5e7 times as bright in its middle
as a board; accumulators pass 2^22 times what is bright, 40 times that, and round light to 1.2e-7 of a board's."""


class DirectTracer(Tracer):
    """Direct light of a projector at a number of anchors."""

    def __init__(self, setup: OpticalSetup, anchors: int, spread: bool = False, pixels: IntArray | None = None) -> None:
        """What is followed.

        Parameters
        ----------
        setup
            scene, camera and projector.
        anchors
            sensor points a side that light is connected to.
        spread
            connect to random points of the sensor instead, all filed as one anchor: the mean over the sensor.
        pixels
            (m,) of the projector that are traced; None: all.
        """
        super().__init__(setup, SensorPoints(setup.geometry.half_width, anchors, spread))
        self._pixels = np.arange(setup.projector.n**2) if pixels is None else pixels

    @property
    def board(self) -> float:
        """Irradiance [W m^-2] that light compares to: bright light, of sharp lobes too."""
        return _LOBE * self.setup.board

    @property
    def paths_per_sample(self) -> int:
        """Connections of one sample: one per projector pixel and anchor."""
        return len(self._pixels) * self.points.count

    def _launch(self, flight: InFlight, accumulators: Sequence[DeviceAccumulator] = ()) -> list[PathSamples]:
        seen, anchor = self._sightings(flight)
        if not accumulators:
            return [PathSamples.fetched(seen, DIRECT, anchor)]
        lights = seen.by_line(len(accumulators))
        for place, share in accumulators[0].shares(seen, anchor):
            for accumulator, light in zip(accumulators, lights, strict=True):
                accumulator.add(light * share, seen.pixel, place, ~(light == 0))  # not a number is refused
        dr.eval([accumulator.sums for accumulator in accumulators])
        return []

    def _sightings(self, flight: InFlight) -> tuple[Sightings, tuple[mi.UInt32, mi.UInt32]]:
        """Light of each sample, and its anchor."""
        number, anchor, share = self._pair(flight)
        pixel = dr.gather(mi.UInt32, mi.UInt32(self._pixels), number)
        anchors = dr.opaque(mi.UInt32, self.points.anchors)
        row, column = anchor // anchors, anchor % anchors
        # Streams belong to pixels: every anchor is connected to the same points.
        shared, rng = streams(flight.seed, pixel, flight.sample)
        jitter, weight = self._place(number, row, column, stratified(flight.sample, shared))
        wavelengths, spectral = sample_wavelengths(self.setup.camera, rng, self.projector.lines)
        ray = self.setup.rays.sample(pixel, jitter, rng, wavelengths)
        sensor = self._sensor(row, column, flight.sample, shared, rng)
        flux = self.setup.rays.flux(pixel, wavelengths) * spectral * (weight * share)

        def add_light(at: Arrival, state: tuple[Sightings, mi.PCG32]) -> tuple[Sightings, mi.PCG32]:
            seen, rng = state
            reception, received = self._by_connection(at, sensor)
            return seen.joined_by(reception.sightings(received, pixel, by_line), rng.next_float32()), rng

        by_line = self.projector.by_line
        seen, _ = self.setup.passage.along(ray, flux, (Sightings.none(by_line), rng), add_light)
        return seen, (row, column)

    def _by_connection(self, at: Arrival, sensor: mi.Point3f) -> tuple[Reception, mi.UnpolarizedSpectrum]:
        """What light that comes to surfaces brings to ``sensor`` points."""
        reception = self.setup.receive(at.si, -at.direction, sensor, at.active)
        return reception, reception.irradiance * at.light

    def _pair(self, flight: InFlight) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
        """Place of each sample in the list of pixels, its anchor, and its weight."""
        count = dr.opaque(mi.UInt32, len(self._pixels))
        return flight.index % count, flight.index // count, mi.Float(1)

    def _place(
        self, number: mi.UInt32, row: mi.UInt32, column: mi.UInt32, jitter: mi.Point2f
    ) -> tuple[mi.Point2f, mi.Float]:
        """Where in its pixel a ray starts, by the pixel's place in the list and the anchor, and the ray's weight."""
        return jitter, mi.Float(1)

    def _sensor(
        self, row: mi.UInt32, column: mi.UInt32, sample: mi.UInt32, shared: mi.PCG32, rng: mi.PCG32
    ) -> mi.Point3f:
        """Points of the sensor, in the camera's frame; ``shared`` belongs to all samples of a stream."""
        if self.points.spread:
            # A sixth of the variance of plain random points in compact_disc, half in gift_card (32 samples a pixel).
            return self.points.inside(stratified(shuffled(sample, shared), shared))
        return self.points.at(row, column, rng)


# -------- Direct light on the sensor as a whole
#
# With A the sensor's area, a connection to an even point of it finds the irradiance I there; over glossy surfaces a
# turn that is sampled as the surface scatters, and lands on the sensor with density q [1/mm^2], finds I / (A q). By the
# balance heuristic (Veach 1997, 9.2) either counts I / (1 + A q): unbiased, and bounded however sharp the lobe. Places
# in the pixel, points of the sensor and turns are as even as each other, and independent.


class FluxTracer:
    """Direct light at the sensor as a whole, of each projector pixel.

    Attributes
    ----------
    paths_per_launch
        rays of one kernel, unless those of one block are more.
    """

    paths_per_launch = PATHS_PER_LAUNCH

    def __init__(self, setup: OpticalSetup, glossy: bool = False) -> None:
        """Light that is followed in a ``setup``; ``glossy``: it has glossy surfaces, whose turns are sampled too."""
        self._setup, self._glossy = setup, glossy
        self._sensor = SensorPoints(setup.geometry.half_width, spread=True)

    def sums(self, seed: int, groups: int, pixels: IntArray, first: IntArray, samples: int) -> FloatArray:
        """(lines, groups, m) light of m blocks of samples, each summed [W m^-2]; one line where light is not told
        apart.

        Parameters
        ----------
        seed
            of the random numbers.
        groups
            independent estimates.
        pixels, first
            (m,) projector pixel of each block, and the number of its first sample: samples ``first`` .. ``first +
            samples - 1`` of the pixel's sequence are traced.
        samples
            of each block.

        Raises
        ------
        MitsimError
            when the scene sends NaN or infinite light to the camera.
        """
        blocks, at_once = groups * len(pixels), max(1, self.paths_per_launch // samples)
        lines, projectors = self._setup.projector.lines, self._setup.projector.per_wavelength
        total = np.zeros((len(lines.shares) if lines and lines.several else 1, blocks))
        numbers, starts = mi.UInt32(pixels), mi.UInt32(first)
        # Opaque numbers keep the compiled kernel the same for all of them.
        each, count = dr.opaque(mi.UInt32, samples), dr.opaque(mi.UInt32, len(pixels))
        for start in range(0, blocks, at_once):
            stop = min(start + at_once, blocks)
            lane = dr.arange(mi.UInt32, (stop - start) * samples)
            place = lane // each
            block = place + dr.opaque(mi.UInt32, start)
            group = block // count
            number = block - group * count
            sample = dr.gather(mi.UInt32, starts, number) + (lane - place * each)
            for projector in projectors:
                light = self._light(seed, group, dr.gather(mi.UInt32, numbers, number), sample, projector.lines)
                if len(total) > 1:
                    dr.eval(light)  # together: apart, each line would trace it
                for own, value in zip(total, split_by_line(light, len(total)), strict=True):
                    own[start:stop] += np.array(dr.block_sum(mi.Float64(value), samples))
        check_finite(total)
        return total.reshape(len(total), groups, -1)

    def _light(
        self, seed: int, group: mi.UInt32, pixel: mi.UInt32, sample: mi.UInt32, lines: Lines | None
    ) -> mi.UnpolarizedSpectrum:
        """Mean irradiance that one ray of each ``pixel`` brings to the sensor."""
        pixels = dr.opaque(mi.UInt32, self._setup.projector.n**2)
        shared, rng = streams(seed, pixel + group * pixels, sample)
        jitter = stratified(sample, shared)
        wavelengths, spectral = sample_wavelengths(self._setup.camera, rng, lines)
        ray = self._setup.rays.sample(pixel, jitter, rng, wavelengths)
        point = stratified(shuffled(sample, shared), shared)
        turn = stratified(shuffled(sample, shared), shared) if self._glossy else None
        sensor, flux = self._sensor.inside(point), self._setup.rays.flux(pixel, wavelengths) * spectral

        def add_light(
            at: Arrival, state: tuple[mi.UnpolarizedSpectrum, mi.PCG32]
        ) -> tuple[mi.UnpolarizedSpectrum, mi.PCG32]:
            total, rng = state
            if turn is not None:
                total = total + self._by_turn(at, rng.next_float32(), turn)
            return total + self._by_connection(at, sensor), rng

        total, _ = self._setup.passage.along(ray, flux, (mi.UnpolarizedSpectrum(0), rng), add_light)
        return total

    def _by_turn(self, at: Arrival, number: mi.Float, point: mi.Point2f) -> mi.UnpolarizedSpectrum:
        """What light that comes to surfaces brings over turns, drawn by a ``number`` and a ``point``."""
        turn = at.turn(number, point)
        lobe = at.active & (turn.pdf > 0) & ~mi.has_flag(turn.sampled_type, mi.BSDFFlags.Delta)
        place = landing(self._setup, at.si, at.si.to_world(turn.wo), lobe)
        half = dr.opaque(mi.Float, self._sensor.half_width)
        lobe = place.arrives & (dr.abs(place.x) <= half) & (dr.abs(place.y) <= half)
        return self._by_connection(replace(at, active=lobe), mi.Point3f(place.x, place.y, 0))

    def _by_connection(self, at: Arrival, point: mi.Point3f) -> mi.UnpolarizedSpectrum:
        """What it brings to a ``point`` of the sensor; over glossy surfaces, over 1 + A q."""
        reception = self._setup.receive(at.si, -at.direction, point, at.active)
        value = reception.irradiance * at.light
        if not self._glossy:
            return value
        density = at.density(at.si.to_local(reception.way.direction))
        area = 4 * dr.square(dr.opaque(mi.Float, self._sensor.half_width))
        # As a spectrum: by a number, Dr.Jit would multiply with the reciprocal, which is rounded.
        share = mi.UnpolarizedSpectrum(1 + area * density * reception.solid_angle(point))
        # A choice between a spectrum and a number is a plain array, which loops of spectral variants refuse.
        return mi.UnpolarizedSpectrum(dr.select(value > 0, value / share, 0))
