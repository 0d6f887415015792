"""Direct light: every projector pixel's rays, followed to the first surface and on to each anchor of the sensor.

A ray meets a surface at P, and P is connected to every anchor (:mod:`mitsim.transport.connect`), or to one random point
of the sensor; those are as even as the places in the projector's pixels, and together with them. All anchors see the
same points. Where surfaces let light pass (:mod:`mitsim.transport.transmission`), so does the ray: of the points that
it meets one is handed out, drawn in proportion to its light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray, Labels
from mitsim.devices.camera import CameraGeometry
from mitsim.transport.accumulator import Ledger
from mitsim.transport.connect import Receiver, Reception, SensorPoints, landing, sampled_wavelengths
from mitsim.transport.coordinates import rows_columns
from mitsim.transport.integrator import Tracer
from mitsim.transport.projector import ProjectorOptics, ProjectorRays
from mitsim.transport.records import DIRECT, Deposits, Sightings
from mitsim.transport.sampler import shuffled, stratified, streams

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


# -------- Direct light over sharp lobes

_EVEN = 0.25
"""Part of the rays that stays even: light that the axes do not tell of is found four times slower than without."""
_NEAR, _SELDOM = 6, 16
"""Lobes' widths from a pixel's light, beyond which there is a fortieth of a GGX lobe (1 / (1 + 6^2)): of the pairs of
pixel and anchor there, one in so many is connected, and stands for all."""
_AXES = 64
"""Rays of a pixel that tell its axes: three would do for a plane, and print or bumps may hide some."""
_FEWEST = 6
"""Axes below which nothing is told: three numbers along each direction are fitted."""
_SHARP = 100.0
"""Density [1/sr] of a turn above which it tells an axis: of lobes that take most of the light. To aim at fainter ones
costs the rest of a pixel's light more than it gains (varnish that takes a twentieth: 1 to 3.7 times connections)."""
_SEED = 20
"""Of the axes' rays: any will do, for they decide how fast light is found and not how much of it there is."""
_ROUND = 1e-6
"""Relative size of a determinant below which pixels that are folded to a line have no inverse."""


@dataclass(frozen=True, eq=False)
class _Aims:
    """Where light for a sensor point lies in each pixel: centre + slope (u - u0); ``scale`` is the density's width.

    All (m, 2) or (m, 2, 2) in parts of a pixel along (row, column); ``known`` (m,) tells pixels without an answer.
    """

    centre: FloatArray
    slope: FloatArray
    scale: FloatArray
    known: npt.NDArray[np.bool_]


@dataclass
class _Axis:
    """Where rays along a lobe's axis meet the sensor's plane (x, y) and the lobe's radius there [mm], if known."""

    x: mi.Float
    y: mi.Float
    width: mi.Float
    known: mi.Bool


class AimedTracer(DirectTracer):
    """Direct light of some projector pixels at a number of anchors.

    Attributes
    ----------
    far
        pairs, anchor * pixels + place of the pixel, that are connected seldom.
    """

    def __init__(
        self,
        scene: mi.Scene,
        camera: mi.Sensor,
        projector: ProjectorOptics,
        anchors: int,
        geometry: CameraGeometry,
        pixels: Labels,
    ) -> None:
        """What is followed.

        Parameters
        ----------
        scene, camera, projector, anchors, geometry, pixels
            as for :class:`DirectTracer`.
        """
        super().__init__(scene, camera, projector, anchors, geometry, pixels=pixels)
        self._aims = self._aim()
        near = self._is_near().ravel()
        pairs = np.arange(len(near), dtype=np.int64)
        self._near, self.far = pairs[near], pairs[~near]

    @property
    def lanes(self) -> int:
        """Connections of one sample: all near pairs of pixel and anchor, and one of a few others."""
        return len(self._near) - (-len(self.far) // _SELDOM)

    def _pair(self, seed: int | mi.UInt32, sample: mi.UInt32, lane: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
        near, far = (dr.opaque(mi.UInt32, len(pairs)) for pairs in (self._near, self.far))
        _, rng = streams(seed, lane, sample)
        one_of = (lane - near) * _SELDOM + dr.minimum(mi.UInt32(rng.next_float32() * _SELDOM), _SELDOM - 1)
        is_near = lane < near
        place = dr.select(is_near, lane, near + one_of)
        share = dr.select(is_near, 1.0, dr.select(one_of < far, float(_SELDOM), 0.0))
        pairs = mi.UInt32(np.concatenate([self._near, self.far]))
        pair = dr.gather(mi.UInt32, pairs, place, place < near + far)
        count = dr.opaque(mi.UInt32, len(self._pixels))
        return pair % count, pair // count, mi.Float(share)

    def _place(
        self, number: mi.UInt32, row: mi.UInt32, column: mi.UInt32, jitter: mi.Point2f
    ) -> tuple[mi.Point2f, mi.Float]:
        aims, positions = self._aims, mi.Float(self.points.positions.astype(np.float32))
        at = [dr.gather(mi.Float, positions, index) for index in (row, column)]
        aimed = (self._of(aims.known, number) > 0) & (jitter.x >= _EVEN)
        even = dr.select(self._of(aims.known, number) > 0, mi.Float(_EVEN), 1)
        # The part that is even is a strip of the unit square: both parts stay stratified.
        strip = dr.select(aimed, (jitter.x - even) / (1 - _EVEN), jitter.x / even)
        places, density = [], 1 - even
        for axis, x in enumerate((jitter.y, strip)):
            centre = self._of(aims.centre[:, axis], number)
            for other in range(2):
                centre += self._of(aims.slope[:, axis, other], number) * at[other]
            scale = self._of(aims.scale[:, axis], number)
            low, high = dr.atan(-centre / scale), dr.atan((1 - centre) / scale)
            drawn = dr.clip(centre + scale * dr.tan(dr.lerp(low, high, x)), 0, 1)
            places.append(dr.select(aimed, drawn, x))
            density *= scale / (dr.square(scale) + dr.square(places[axis] - centre)) / (high - low)
        return mi.Point2f(places[1], places[0]), dr.rcp(even + density)

    @staticmethod
    def _of(values: npt.NDArray[np.generic], number: mi.UInt32) -> mi.Float:
        return dr.gather(mi.Float, mi.Float(np.ascontiguousarray(values, dtype=np.float32)), number)

    def _aim(self) -> _Aims:
        """Fit the axes of each pixel."""
        count = len(self._pixels)
        place, sensor, width, valid = (values.reshape(_AXES, count, -1) for values in self._axes())
        aims = _Aims(np.zeros((count, 2)), np.zeros((count, 2, 2)), np.ones((count, 2)), np.zeros(count, bool))
        for number in range(count):
            told = valid[:, number, 0] > 0
            if np.count_nonzero(told) < _FEWEST:
                continue
            design = np.concatenate([np.ones((told.sum(), 1)), place[told, number] - 0.5], axis=1)
            fit = np.linalg.lstsq(design, sensor[told, number], rcond=None)[0]
            jacobian, spread = fit[1:].T, sensor[told, number] - design @ fit
            if abs(np.linalg.det(jacobian)) < _ROUND * np.square(jacobian).sum():
                continue
            slope = np.linalg.inv(jacobian)
            radius = np.hypot(np.median(width[told, number]), np.median(np.abs(spread)))
            aims.known[number] = True
            aims.slope[number], aims.centre[number] = slope, 0.5 - slope @ fit[0]
            aims.scale[number] = np.linalg.norm(slope, axis=1) * radius
        return aims

    def _is_near(self) -> npt.NDArray[np.bool_]:
        """(anchors^2, pixels): whether an anchor lies within a few lobes of the pixel's light, as far as known."""
        aims = self._aims
        row, column = np.meshgrid(self.points.positions, self.points.positions, indexing="ij")
        at = np.stack([row.ravel(), column.ravel()], axis=1)
        place = aims.centre + np.einsum("mij,aj->ami", aims.slope, at)
        beyond = np.abs(place - np.clip(place, 0, 1)) / aims.scale
        return np.asarray((np.hypot(beyond[..., 0], beyond[..., 1]) < _NEAR) | ~aims.known)

    def _axes(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Rays sent on along their lobes' axes: place in the pixel (k, 2), on the sensor (k, 2) [mm], width, valid."""
        count = len(self._pixels)
        index = dr.arange(mi.UInt32, _AXES * count)
        number, sample = index % dr.opaque(mi.UInt32, count), index // dr.opaque(mi.UInt32, count)
        pixel = dr.gather(mi.UInt32, mi.UInt32(self._pixels), number)
        shared, rng = streams(_SEED, pixel, sample)
        jitter = stratified(sample, shared)
        wavelengths, _ = sampled_wavelengths(self.receiver.camera, rng, self.projector.lines)
        ray = self.rays.sample(pixel, jitter, rng, wavelengths)
        none = _Axis(mi.Float(0), mi.Float(0), mi.Float(1), mi.Bool(False))
        axis, _ = self.receiver.passage.along(ray, mi.Spectrum(1), (none, rng), self._axis)
        row, column = rows_columns(axis.x, axis.y)
        width, valid = axis.width, axis.known
        dr.eval(jitter, row, column, width, valid)
        stacked = [np.stack([np.array(a), np.array(b)], axis=1) for a, b in ((jitter.y, jitter.x), (row, column))]
        return stacked[0], stacked[1], np.array(width, dtype=np.float64), np.array(valid, dtype=np.float64)

    def _axis(
        self,
        si: mi.SurfaceInteraction3f,
        direction: mi.Vector3f,
        light: mi.Spectrum,
        active: mi.Bool,
        state: tuple[_Axis, mi.PCG32],
    ) -> tuple[_Axis, mi.PCG32]:
        """The axis of the first surface that turns a ray sharply."""
        del light
        axis, rng = state
        si.wi = si.to_local(-direction)
        # The middle of the random numbers is the middle of a lobe, or near it.
        context = mi.BSDFContext(mi.TransportMode.Importance)
        turn, _ = si.bsdf().sample(context, si, rng.next_float32(), mi.Point2f(0.5), active)
        active = active & (turn.pdf > dr.opaque(mi.Float, _SHARP)) & ~mi.has_flag(turn.sampled_type, mi.BSDFFlags.Delta)
        place = landing(self.receiver, si, si.to_world(turn.wo), active & ~axis.known)
        # 1 / sqrt(pi q), q the density on the sensor.
        width = place.length * dr.rsqrt(dr.pi * turn.pdf * place.cosine)
        found = _Axis(place.x, place.y, width, place.arrives)
        chosen = (dr.select(place.arrives, getattr(found, name), getattr(axis, name)) for name in vars(axis))
        return _Axis(*chosen), rng
