"""Direct light over sharp lobes: rays of chosen projector pixels, aimed at the anchors that their lobes meet.

Connected to an anchor u of the sensor, light over a lobe of roughness alpha comes from a patch of some alpha r about
the point that mirrors the projector into u; even rays of a projector pixel seldom meet it. Where in the pixel it lies
is told by a few rays that are sent on along their lobes' axes, past holes and through panes: they arrive at about
u0 + J (x - 1/2), x the place in the pixel, so x is drawn from a Cauchy density about 1/2 + J^-1 (u - u0), as wide as
the lobe. Any such density leaves the estimate unbiased; a part of the rays stays even, so that what the axes do not
tell of is found as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.rig.camera import CameraGeometry
from mitsim.transport.coordinates import rows_columns
from mitsim.transport.direct import DirectTracer
from mitsim.transport.landing import landing
from mitsim.transport.projector import ProjectorOptics
from mitsim.transport.receiver import sampled_wavelengths
from mitsim.transport.sampling import stratified, streams

IntArray = npt.NDArray[np.int64]
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
        pixels: IntArray,
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
