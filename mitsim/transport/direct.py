"""Direct light: every projector pixel's rays, followed to the first surface and on to each anchor of the sensor.

Where surfaces let light pass (:mod:`mitsim.transport.transmission`), one of the points that the ray meets is drawn in
proportion to its light.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import device_array, keep_scenes
from mitsim.devices.projector import Lines
from mitsim.transport.connect import OpticalSetup, Reception, SensorPoints, landing, sample_wavelengths
from mitsim.transport.integrator import PATHS_PER_LAUNCH, InFlight, Tracer
from mitsim.transport.plugins.base import Light, rows_columns, shuffle, sobol_point, split_by_line, streams
from mitsim.transport.records import DIRECT, Anchor, DeviceAccumulator, PathSamples, Sightings, check_finite
from mitsim.transport.transmission import Arrival

IntArray = npt.NDArray[np.int64]
_LOBE = 2.0**8
"""Bright light over a board's; accumulators hold 2^22 times that, 40 times Mitsuba's sharpest lobe."""


class DirectTracer(Tracer):
    brightest = _LOBE

    def __init__(self, setup: OpticalSetup, anchors: int, spread: bool = False, pixels: IntArray | None = None) -> None:
        super().__init__(setup, points=SensorPoints(setup.geometry.half_width, anchors, spread))
        self._pixels = np.arange(setup.projector.n**2) if pixels is None else pixels

    @property
    def paths_per_sample(self) -> int:
        return len(self._pixels) * self.points.count

    @keep_scenes()
    def sums(self, seed: int, samples: int) -> FloatArray:
        """Return the light (m, anchors, anchors) of each pixel at each anchor, summed over samples [W m^-2]."""
        total = np.zeros(self.paths_per_sample)
        for tracer in self.per_wavelength:
            parts = list[npt.NDArray[np.float32]]()
            for flight in tracer._flights([seed], 0, samples):
                # All that other traces fetch, in the same kernel.
                found = tracer._sightings(flight)
                dr.eval(found)
                parts.append(np.array(found[0].value))
            light = np.concatenate(parts)
            check_finite(light)
            total += light.reshape(samples, -1).sum(axis=0, dtype=np.float64)
        return total.reshape(self.points.anchors, self.points.anchors, len(self._pixels)).transpose(2, 0, 1)

    def _launch(self, flight: InFlight, accumulator: DeviceAccumulator | None = None) -> list[PathSamples]:
        seen, anchor = self._sightings(flight)
        if accumulator is None:
            return [PathSamples.fetch(seen, DIRECT, anchor)]
        for place, share in accumulator.shares(seen, anchor):
            accumulator.add([light * share for light in seen.by_line(accumulator.lines)], seen.pixel, place)
        dr.eval(accumulator.sums)
        return []

    def _sightings(self, flight: InFlight) -> tuple[Sightings, Anchor]:
        number, anchor, share = self._pair(flight)
        pixel = dr.gather(mi.UInt32, device_array(mi.UInt32, self._pixels), number)
        anchors = dr.opaque(mi.UInt32, self.points.anchors)
        row, column = anchor // anchors, anchor % anchors
        # Streams belong to pixels: every anchor is connected to the same points.
        shared, rng = streams(flight.seed, pixel, flight.sample)
        jitter, weight = self._place(number, row, column, sobol_point(flight.sample, shared))
        wavelengths, spectral = sample_wavelengths(self.setup.camera, rng, self.projector.lines)
        ray = self.setup.rays.sample(pixel, jitter, rng, wavelengths)
        # A sixth of the variance of plain random points in compact_disc, half in gift_card (32 samples a pixel).
        sensor = self.points.place(row, column, sobol_point(shuffle(flight.sample, shared), shared))
        flux = self.setup.rays.flux(pixel, wavelengths) * spectral * (weight * share)

        def add_light(at: Arrival, state: tuple[Sightings, mi.PCG32]) -> tuple[Sightings, mi.PCG32]:
            seen, rng = state
            reception, received = self._by_connection(at, sensor, pixel)
            return seen.joined_by(reception.sightings(received, pixel, by_line), rng.next_float32()), rng

        by_line = self.projector.by_line
        seen, _ = self.setup.passage.along(ray, flux, (Sightings.none(by_line), rng), add_light)
        return seen, (row, column)

    def _by_connection(self, at: Arrival, sensor: mi.Point3f, pixel: mi.UInt32) -> tuple[Reception, Light]:
        reception = self.setup.receive(at.si, -at.direction, sensor, at.active)
        return reception, reception.irradiance * at.light

    def _pair(self, flight: InFlight) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
        count = dr.opaque(mi.UInt32, len(self._pixels))
        return flight.index % count, flight.index // count, mi.Float(1)

    def _place(
        self, number: mi.UInt32, row: mi.UInt32, column: mi.UInt32, jitter: mi.Point2f
    ) -> tuple[mi.Point2f, mi.Float]:
        return jitter, mi.Float(1)


# -------- Direct light on the sensor as a whole
#
# With A the sensor's area, a connection to an even point of it finds the irradiance I there; over glossy surfaces a
# turn that is sampled as the surface scatters, and lands on the sensor with density q [1/mm^2], finds I / (A q). By the
# balance heuristic (Veach 1997, 9.2) either counts I / (1 + A q): unbiased, and bounded however sharp the lobe. Places
# in the pixel, points of the sensor and turns are as even as each other, and independent.


class FluxTracer:
    paths_per_launch = PATHS_PER_LAUNCH

    def __init__(self, setup: OpticalSetup, glossy: bool = False) -> None:
        self._setup, self._glossy = setup, glossy
        self._sensor = SensorPoints(setup.geometry.half_width, spread=True)

    @keep_scenes()
    def sums(self, seed: int, groups: int, pixels: IntArray, first: IntArray, samples: int) -> FloatArray:
        """Return the light (lines, groups, m) of m blocks of samples [W m^-2]."""
        blocks, at_once = groups * len(pixels), max(1, self.paths_per_launch // samples)
        lines, projectors = self._setup.projector.lines, self._setup.projector.per_wavelength
        total = np.zeros((len(lines.shares) if lines and lines.several else 1, blocks))
        numbers, starts = (device_array(mi.UInt32, each) for each in (pixels, first))
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

    def _light(self, seed: int, group: mi.UInt32, pixel: mi.UInt32, sample: mi.UInt32, lines: Lines | None) -> Light:
        setup, glossy = self._setup, self._glossy
        pixels = dr.opaque(mi.UInt32, setup.projector.n**2)
        shared, rng = streams(seed, pixel + group * pixels, sample)
        jitter = sobol_point(sample, shared)
        wavelengths, spectral = sample_wavelengths(setup.camera, rng, lines)
        ray = setup.rays.sample(pixel, jitter, rng, wavelengths)
        point = sobol_point(shuffle(sample, shared), shared)
        turned = sobol_point(shuffle(sample, shared), shared) if glossy else None
        sensor, flux = self._sensor.inside(point), setup.rays.flux(pixel, wavelengths) * spectral
        half = dr.opaque(mi.Float, self._sensor.half_width) if glossy else None

        def connected(at: Arrival, point: mi.Point3f) -> Light:
            reception = setup.receive(at.si, -at.direction, point, at.active)
            value = reception.irradiance * at.light
            if half is None:
                return value
            density = at.density(at.si.to_local(reception.way.direction))
            area = 4 * dr.square(half)
            # A spectrum is used, because Dr.Jit divides by a number as multiplication with the rounded reciprocal.
            share = mi.UnpolarizedSpectrum(1 + area * density * reception.solid_angle(point))
            # A choice between a spectrum and a number is a plain array, which loops of spectral variants refuse.
            return mi.UnpolarizedSpectrum(dr.select(value > 0, value / share, 0))

        def add_light(at: Arrival, state: tuple[Light, mi.PCG32]) -> tuple[Light, mi.PCG32]:
            total, rng = state
            if turned is not None and half is not None:
                turn = at.turn(rng.next_float32(), turned)
                lobe = at.active & (turn.pdf > 0) & ~mi.has_flag(turn.sampled_type, mi.BSDFFlags.Delta)
                place = landing(setup, at.si, at.si.to_world(turn.wo), lobe)
                lobe = place.arrives & (dr.abs(place.x) <= half) & (dr.abs(place.y) <= half)
                total = total + connected(replace(at, active=lobe), mi.Point3f(place.x, place.y, 0))
            return total + connected(at, sensor), rng

        total, _ = setup.passage.along(ray, flux, (mi.UnpolarizedSpectrum(0), rng), add_light)
        return total


# -------- Direct light aimed at the anchors that sharp lobes meet
#
# Connected to an anchor u of the sensor, light over a lobe of roughness alpha comes from a patch of some alpha r about
# the point that mirrors the projector into u; even rays of a projector pixel seldom meet it. Where in the pixel it lies
# is found by a few rays that are sent on along their lobes' axes, past holes and through panes: they arrive at about u0
# + J (x - 1/2), x the place in the pixel, so x is drawn from a Cauchy density about 1/2 + J^-1 (u - u0), as wide as the
# lobe. Any such density leaves the estimate unbiased; a part of the rays stays even, so that light that the axes miss
# is found as well.

_EVEN = 0.25
"""Part of the rays that stays even: light that the axes miss is found four times more slowly without."""
_NEAR, _SELDOM = 6, 16
"""Lobe widths beyond which a fortieth of a GGX lobe lies: one in so many of these pairs is connected."""
_AXES = 64
_FEWEST = 6
_SHARP_AXIS = 100.0
_SEED = 20
_ROUND = 1e-6


@dataclass
class _Axis:
    x: mi.Float
    y: mi.Float
    width: mi.Float
    known: mi.Bool


class AimedTracer(DirectTracer):
    def __init__(self, setup: OpticalSetup, anchors: int, pixels: IntArray) -> None:
        super().__init__(setup, anchors, pixels=pixels)
        count = len(pixels)
        place, sensor, width, valid = (values.reshape(_AXES, count, -1) for values in self._axes())
        self._centre, self._slope, self._scale = np.zeros((count, 2)), np.zeros((count, 2, 2)), np.ones((count, 2))
        self._known = np.zeros(count, bool)
        for number in range(count):
            known = valid[:, number, 0] > 0
            if np.count_nonzero(known) < _FEWEST:
                continue
            design = np.concatenate([np.ones((known.sum(), 1)), place[known, number] - 0.5], axis=1)
            fit = np.linalg.lstsq(design, sensor[known, number], rcond=None)[0]
            jacobian, spread = fit[1:].T, sensor[known, number] - design @ fit
            if abs(np.linalg.det(jacobian)) < _ROUND * np.square(jacobian).sum():
                continue
            slope = np.linalg.inv(jacobian)
            radius = np.hypot(np.median(width[known, number]), np.median(np.abs(spread)))
            self._known[number] = True
            self._slope[number], self._centre[number] = slope, 0.5 - slope @ fit[0]
            self._scale[number] = np.linalg.norm(slope, axis=1) * radius
        # Pairs of an anchor and a pixel, by whether the place that is lit most lies in the pixel or near it.
        row, column = np.meshgrid(self.points.positions, self.points.positions, indexing="ij")
        at = np.stack([row.ravel(), column.ravel()], axis=1)
        middle = self._centre + np.einsum("mij,aj->ami", self._slope, at)
        beyond = np.abs(middle - np.clip(middle, 0, 1)) / self._scale
        near = ((np.hypot(beyond[..., 0], beyond[..., 1]) < _NEAR) | ~self._known).ravel()
        pairs = np.arange(len(near), dtype=np.int64)
        self._near, self.far = pairs[near], pairs[~near]

    @property
    def paths_per_sample(self) -> int:
        return len(self._near) - (-len(self.far) // _SELDOM)

    def _pair(self, flight: InFlight) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
        near, far = (dr.opaque(mi.UInt32, len(pairs)) for pairs in (self._near, self.far))
        index, (_, rng) = flight.index, streams(flight.seed, flight.index, flight.sample)
        one_of = (index - near) * _SELDOM + dr.minimum(mi.UInt32(rng.next_float32() * _SELDOM), _SELDOM - 1)
        is_near = index < near
        place = dr.select(is_near, index, near + one_of)
        share = dr.select(is_near, 1.0, dr.select(one_of < far, float(_SELDOM), 0.0))
        pairs = device_array(mi.UInt32, np.concatenate([self._near, self.far]))
        pair = dr.gather(mi.UInt32, pairs, place, place < near + far)
        count = dr.opaque(mi.UInt32, len(self._pixels))
        return pair % count, pair // count, mi.Float(share)

    def _place(
        self, number: mi.UInt32, row: mi.UInt32, column: mi.UInt32, jitter: mi.Point2f
    ) -> tuple[mi.Point2f, mi.Float]:
        def of(values: npt.NDArray[np.generic]) -> mi.Float:
            return dr.gather(mi.Float, device_array(mi.Float, values), number)

        positions = device_array(mi.Float, self.points.positions)
        at = [dr.gather(mi.Float, positions, index) for index in (row, column)]
        aimed = (of(self._known) > 0) & (jitter.x >= _EVEN)
        even = dr.select(of(self._known) > 0, mi.Float(_EVEN), 1)
        # The part that is even is a strip of the unit square: both parts stay stratified.
        strip = dr.select(aimed, (jitter.x - even) / (1 - _EVEN), jitter.x / even)
        places, density = [], 1 - even
        for axis, x in enumerate((jitter.y, strip)):
            centre = of(self._centre[:, axis])
            for other in range(2):
                centre += of(self._slope[:, axis, other]) * at[other]
            scale = of(self._scale[:, axis])
            low, high = dr.atan(-centre / scale), dr.atan((1 - centre) / scale)
            drawn = dr.clip(centre + scale * dr.tan(dr.lerp(low, high, x)), 0, 1)
            places.append(dr.select(aimed, drawn, x))
            density *= scale / (dr.square(scale) + dr.square(places[axis] - centre)) / (high - low)
        return mi.Point2f(places[1], places[0]), dr.rcp(even + density)

    def _axes(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        count = len(self._pixels)
        index = dr.arange(mi.UInt32, _AXES * count)
        number, sample = index % dr.opaque(mi.UInt32, count), index // dr.opaque(mi.UInt32, count)
        pixel = dr.gather(mi.UInt32, device_array(mi.UInt32, self._pixels), number)
        shared, rng = streams(_SEED, pixel, sample)
        jitter = sobol_point(sample, shared)
        wavelengths, _ = sample_wavelengths(self.setup.camera, rng, self.projector.lines)
        ray = self.setup.rays.sample(pixel, jitter, rng, wavelengths)
        none = _Axis(mi.Float(0), mi.Float(0), mi.Float(1), mi.Bool(False))

        def follow(at: Arrival, state: tuple[_Axis, mi.PCG32]) -> tuple[_Axis, mi.PCG32]:
            axis, rng = state
            # The middle of the random numbers is the middle of a lobe, or near it.
            turn = at.turn(rng.next_float32(), mi.Point2f(0.5))
            sharp = at.active & (turn.pdf > dr.opaque(mi.Float, _SHARP_AXIS))
            sharp &= ~mi.has_flag(turn.sampled_type, mi.BSDFFlags.Delta)
            place = landing(self.setup, at.si, at.si.to_world(turn.wo), sharp & ~axis.known)
            # 1 / sqrt(pi q), q the density on the sensor.
            width = place.length * dr.rsqrt(dr.pi * turn.pdf * place.cosine)
            return dr.select(place.arrives, _Axis(place.x, place.y, width, place.arrives), axis), rng

        axis, _ = self.setup.passage.along(ray, mi.Spectrum(1), (none, rng), follow)
        row, column = rows_columns(axis.x, axis.y)
        width, valid = axis.width, axis.known
        dr.eval(jitter, row, column, width, valid)
        stacked = [np.stack([np.array(a), np.array(b)], axis=1) for a, b in ((jitter.y, jitter.x), (row, column))]
        return stacked[0], stacked[1], np.array(width, dtype=np.float64), np.array(valid, dtype=np.float64)
