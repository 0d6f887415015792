"""Direct light over sharp lobes, found from the surface: how much of it there is, and whether connections can see it.

Direct light is found by connecting lit points to the sensor. A connection rarely meets a lobe that is far narrower
than the projector's window: then no estimate holds its light, no spread of estimates tells of it, and the frames would
lack it in silence. Sampled from the surface instead, such a lobe meets the sensor easily. With I the irradiance that a
ray's connection to a sensor point stands for, uniform over the sensor's area A, and q the density [1/mm^2] of meeting
that point by sampling the surface, a met point estimates the mean irradiance by x = I / (A q), and the second moment of
a connection by x I. So N connections see the light L of the lobes as ``N L^2 / E[x I]`` equal hits would.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray, Labels, mean_of_neighbours
from mitsim.transport.connect import OpticalSetup, Reception, landing, sample_wavelengths
from mitsim.transport.direct import DirectTracer
from mitsim.transport.integrator import InFlight, launches
from mitsim.transport.plugins.base import rows_columns
from mitsim.transport.records import check_finite
from mitsim.transport.sampler import panchromatic, stratified, streams
from mitsim.transport.transmission import Arrival

_SHARP, _LEAST_SHARP = 100.0, 10.0
"""Density [1/sr] of a turn above which its lobe counts as sharp where all turns of a pixel are, as a GGX lobe of
roughness 0.03 does; where a part of them is, that part of it, but no less than the second: as a lobe of roughness 0.02
does that takes a twentieth of the light.

Such a lobe fills 0.01 sr, a tenth of the shipped projector's window: connections from all of it meet broader ones.
"""
_PLENTY = 2**12
"""Rays met on the sensor that tell the light of a few pixels to a few percent; fewer are followed by a second look."""
_CONNECTIONS = 2**18
"""Connections that tell all other light, some 0.1 s: it is bounded, so a percent of it or less is left open."""
_SEARCHING = 2**20
"""Connections that look for lobes which take little of the light, and are therefore seldom sampled, some 0.1 s: varnish
of roughness 0.005 that reflects a twentieth, on a ball of 100 mm at 390, is met eleven times, and sampled twice."""
_FEWER, _WIDER = 16, 16.0
"""A look at a sensor so many times as wide takes so many times fewer rays, and meets 16 times as much: where it meets
nothing, the full look, which is far longer, is spared."""
_SHARPEST = 0.1
"""Part of the light over sharper lobes than the width that is reported: the peak of a GGX lobe is met that often."""


# ---- How much light comes over sharp lobes ----


@dataclass(frozen=True, eq=False)
class SharpLight:
    """Light over sharp lobes, without the mask.

    Attributes
    ----------
    irradiance, error
        mean over the sensor [W m^-2], and its Monte Carlo error.
    hits
        of one connection of every projector pixel, those that would meet a lobe, as far as noise goes.
    by_pixel, moments
        (n^2,) ``irradiance`` of each projector pixel, and the second moment of its connection [W^2 m^-4].
    width
        radius of the lobes on the sensor [mm], sqrt(P / (pi q)) of all but the sharpest tenth of the light: with P the
        part of a pixel's turns that are sharp, q / P is the density of a lobe by itself.
    rest
        all other direct light, mean over the sensor [W m^-2].
    """

    irradiance: float
    error: float
    hits: float
    by_pixel: FloatArray
    moments: FloatArray
    width: float
    rest: float = 0.0

    @classmethod
    def none(cls, pixels: int) -> SharpLight:
        """Of a projector of so many ``pixels`` that lights no sharp lobe."""
        return cls(0.0, 0.0, math.inf, np.zeros(pixels), np.zeros(pixels), math.inf)


def sharp_light(setup: OpticalSetup, seed: int, samples: int) -> SharpLight:
    """Direct light over lobes too sharp for connections.

    Where a shorter look at a wider sensor meets none, there is none. What few rays find comes from small parts of a few
    pixels, as off curved surfaces: these pixels, those that connections find, and their neighbours are looked at once
    more, with as many rays.

    Parameters
    ----------
    setup
        scene, camera and projector.
    seed, samples
        of the random numbers, and rays of every projector pixel.

    Raises
    ------
    MitsimError
        when the scene sends NaN or infinite light to the camera.
    """
    n, paths_per_sample = setup.projector.n, setup.projector.n**2
    lobes = _Lobes(setup)
    first = lobes.trace(np.arange(paths_per_sample), seed, 0, -(-samples // _FEWER), _WIDER)
    if not len(first.widths):
        return SharpLight.none(paths_per_sample)
    lobes.least = least = mi.Float(np.clip(_SHARP * first.sharp, _LEAST_SHARP, _SHARP).astype(np.float32))
    found = lobes.trace(np.arange(paths_per_sample), seed, 0, samples)
    if len(found.widths) < _PLENTY:
        search = _Connections(setup, 1, spread=True).over(least, sharp=True)
        lit = np.bincount(
            search.trace(seed, 0, max(1, _SEARCHING // paths_per_sample)).pixel, minlength=paths_per_sample
        )
        pixels = with_neighbours((found.by_pixel > 0) | (lit > 0), n)
        if len(pixels):
            found = lobes.trace(pixels, seed, samples, samples * paths_per_sample // len(pixels))
    total, moment = float(found.by_pixel.sum()), float(found.moments.sum())
    hits = total**2 / moment if moment else 0.0
    rest = 0.0
    if total:
        others = _Connections(setup, 1, spread=True).over(least, sharp=False)
        count = max(1, _CONNECTIONS // paths_per_sample)
        rest = float(others.trace(seed, 0, count).value.sum()) / count
    width = _quantile(found.widths, found.weights, _SHARPEST)
    return SharpLight(total, found.error, hits, found.by_pixel, found.moments, width, rest)


def _quantile(values: FloatArray, weights: FloatArray, part: float) -> float:
    """Value below which ``part`` of the ``weights`` lie; inf for none."""
    order = np.argsort(values)
    sums = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(sums, part * sums[-1])]) if values.size else math.inf


def with_neighbours(chosen: npt.NDArray[np.bool_], side: int) -> Labels:
    """Numbers of the pixels that are chosen, and of all that touch one of them.

    Parameters
    ----------
    chosen
        (side^2,) of a square of pixels, row by row.
    side
        of the square.
    """
    return np.flatnonzero(mean_of_neighbours(chosen.reshape(side, side).astype(np.float64)) > 0)


# ---- What is found by pixel, and where it meets the sensor ----


@dataclass(frozen=True, eq=False)
class _LobeLight:
    """Irradiance and second moment of every projector pixel, the part of its turns that are sharp, the irradiance's
    error, and width and weight of each lobe."""

    by_pixel: FloatArray
    moments: FloatArray
    sharp: FloatArray
    error: float
    widths: FloatArray
    weights: FloatArray


@dataclass
class _SensorHits:
    """Of points met on the sensor: estimates x of the mean irradiance, x I, and density q of one, drawn by x; and sharp
    turns, wherever they went."""

    mean: mi.Float
    moment: mi.Float
    density: mi.Float
    turns: mi.Float

    def joined_by(self, more: _SensorHits, rng: mi.PCG32) -> _SensorHits:
        """These and ``more``; in x I, points that are met over one surface are no points of another."""
        mean = self.mean + more.mean
        new = rng.next_float32() * mean < more.mean
        density = dr.select(new, more.density, self.density)
        return _SensorHits(mean, self.moment + more.moment, density, self.turns + more.turns)


# ---- What connections find of it ----


class _Connections(DirectTracer):
    """Direct light over sharp lobes alone, or all other."""

    _over_sharp: bool
    _least: mi.Float
    _own_least: mi.Float

    def over(self, least: mi.Float, sharp: bool) -> _Connections:
        """The same over ``sharp`` lobes, of at ``least`` such a density [1/sr] by pixel, or over all others."""
        self._least, self._over_sharp = least, sharp
        return self

    def _place(
        self, number: mi.UInt32, row: mi.UInt32, column: mi.UInt32, jitter: mi.Point2f
    ) -> tuple[mi.Point2f, mi.Float]:
        self._own_least = dr.gather(mi.Float, self._least, number)
        return super()._place(number, row, column, jitter)

    def _by_connection(self, at: Arrival, sensor: mi.Point3f) -> tuple[Reception, mi.UnpolarizedSpectrum]:
        reception, received = super()._by_connection(at, sensor)
        sharp = reception.pdf > self._own_least
        return reception, dr.select(sharp == self._over_sharp, received, 0)


# ---- Rays that sharp lobes send to the sensor ----


class _Lobes:
    """Rays of the projector that sharp lobes of the surfaces that they light send to the sensor.

    Attributes
    ----------
    least
        (n^2,) density [1/sr] above which a lobe counts as sharp, by projector pixel.
    """

    def __init__(self, setup: OpticalSetup) -> None:
        self.setup, self.least = setup, dr.full(mi.Float, _LEAST_SHARP, setup.projector.n**2)

    def trace(self, pixels: Labels, seed: int, first: int, samples: int, wider: float = 1.0) -> _LobeLight:
        """What rays ``first`` to ``first + samples`` - 1 of ``pixels`` meet on a sensor so many times ``wider``."""
        squares, met, weights = 0.0, [], []
        by_pixel, moments = np.zeros((2, self.setup.projector.n**2))
        turned = dr.zeros(mi.Float, len(by_pixel))
        for sample, place in launches(len(pixels), first, samples):
            pixel = dr.gather(mi.UInt32, mi.UInt32(pixels), place)
            number, mean, product, density = self.meet(seed, sample, pixel, wider, turned)
            by_pixel += np.bincount(number, mean, minlength=len(by_pixel)) / samples
            moments += np.bincount(number, product, minlength=len(by_pixel)) / samples
            squares += float(np.square(mean).sum())
            met.append((number, density))
            weights.append(mean)
        sharp = np.array(turned, dtype=np.float64) / samples
        variance = max(squares / samples - float(by_pixel.sum()) ** 2 / len(pixels), 0.0)
        pixel_of, densities = (np.concatenate(parts) for parts in zip(*met, strict=True))
        widths = np.sqrt(sharp[pixel_of] / (np.pi * densities))
        return _LobeLight(by_pixel, moments, sharp, math.sqrt(variance / samples), widths, np.concatenate(weights))

    def meet(
        self, seed: int, sample: mi.UInt32, pixel: mi.UInt32, wider: float, turned: mi.Float
    ) -> tuple[Labels, FloatArray, FloatArray, FloatArray]:
        """Pixels of the rays that meet the sensor, and for each x, x I, and density q of one of the points met; sharp
        turns are added to those ``turned`` (n^2,). MitsimError where light is NaN or infinite."""
        half = dr.opaque(mi.Float, wider * self.setup.geometry.half_width)
        _, rng = streams(seed, pixel, sample)
        jitter = mi.Point2f(rng.next_float32(), rng.next_float32())
        wavelengths, spectral = sample_wavelengths(self.setup.camera, rng, self.setup.projector.lines)
        ray = self.setup.rays.sample(pixel, jitter, rng, wavelengths)
        flux = self.setup.rays.flux(pixel, wavelengths) * spectral
        none = _SensorHits(mi.Float(0), mi.Float(0), mi.Float(1), mi.Float(0))
        met, _ = self.setup.passage.along(
            ray, flux, (none, rng), partial(self._meet_sensor, half, dr.gather(mi.Float, self.least, pixel))
        )
        # Whole numbers, whose sums in any order are the same.
        dr.scatter_reduce(dr.ReduceOp.Add, turned, met.turns, pixel, met.turns > 0)
        dr.eval(met, turned)
        # Few rays meet the sensor: of the others nothing is fetched. What is not a number is no zero either.
        lit = dr.compress(~(met.mean == 0))
        number = np.array(dr.gather(mi.UInt32, pixel, lit), dtype=np.int64)
        mean, product, density = (
            np.array(dr.gather(mi.Float, values, lit), dtype=np.float64)
            for values in (met.mean, met.moment, met.density)
        )
        check_finite(mean)
        check_finite(product)
        return number, mean, product, density

    def _meet_sensor(
        self, half: mi.Float, least: mi.Float, at: Arrival, state: tuple[_SensorHits, mi.PCG32]
    ) -> tuple[_SensorHits, mi.PCG32]:
        """What a turn that is sampled at the surface meets on a sensor of a ``half`` width, over lobes of ``least``
        density."""
        met, rng = state
        turn = at.turn(rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()))
        density = at.density(turn.wo)
        active = at.active & (turn.pdf > 0) & (density > 0) & ~mi.has_flag(turn.sampled_type, mi.BSDFFlags.Delta)
        turns = dr.select(active & (density > least), mi.Float(1), 0)
        place = landing(self.setup, at.si, at.si.to_world(turn.wo), active)
        active &= place.arrives & (dr.abs(place.x) <= half) & (dr.abs(place.y) <= half)
        sensor = mi.Point3f(place.x, place.y, 0)
        reception = self.setup.receive(at.si, -at.direction, sensor, active)
        active &= reception.pdf > least
        per_area = density * reception.solid_angle(sensor)
        connected = dr.select(active, panchromatic(reception.irradiance * at.light), 0)
        mean = dr.select(active, connected / (4 * dr.square(half) * per_area), 0)
        return met.joined_by(_SensorHits(mean, mean * connected, per_area, turns), rng), rng


# ---- Direct light aimed at the anchors that sharp lobes meet ----
#
# Connected to an anchor u of the sensor, light over a lobe of roughness alpha comes from a patch of some alpha r about
# the point that mirrors the projector into u; even rays of a projector pixel seldom meet it. Where in the pixel it lies
# is told by a few rays that are sent on along their lobes' axes, past holes and through panes: they arrive at about u0
# + J (x - 1/2), x the place in the pixel, so x is drawn from a Cauchy density about 1/2 + J^-1 (u - u0), as wide as the
# lobe. Any such density leaves the estimate unbiased; a part of the rays stays even, so that what the axes do not tell
# of is found as well.

_EVEN = 0.25
"""Part of the rays that stays even: light that the axes do not tell of is found four times slower than without."""
_NEAR, _SELDOM = 6, 16
"""Lobes' widths from a pixel's light, beyond which there is a fortieth of a GGX lobe (1 / (1 + 6^2)): of the pairs of
pixel and anchor there, one in so many is connected, and stands for all."""
_AXES = 64
"""Rays of a pixel that tell its axes: three would do for a plane, and print or bumps may hide some."""
_FEWEST = 6
"""Axes below which nothing is told: three numbers along each direction are fitted."""
_SHARP_AXIS = 100.0
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

    def __init__(self, setup: OpticalSetup, anchors: int, pixels: Labels) -> None:
        """What is followed.

        Parameters
        ----------
        setup, anchors, pixels
            as for :class:`DirectTracer`.
        """
        super().__init__(setup, anchors, pixels=pixels)
        self._aims = self._aim()
        near = self._is_near().ravel()
        pairs = np.arange(len(near), dtype=np.int64)
        self._near, self.far = pairs[near], pairs[~near]

    @property
    def paths_per_sample(self) -> int:
        """Connections of one sample: all near pairs of pixel and anchor, and one of a few others."""
        return len(self._near) - (-len(self.far) // _SELDOM)

    def _pair(self, flight: InFlight) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
        near, far = (dr.opaque(mi.UInt32, len(pairs)) for pairs in (self._near, self.far))
        index, (_, rng) = flight.index, streams(flight.seed, flight.index, flight.sample)
        one_of = (index - near) * _SELDOM + dr.minimum(mi.UInt32(rng.next_float32() * _SELDOM), _SELDOM - 1)
        is_near = index < near
        place = dr.select(is_near, index, near + one_of)
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
        wavelengths, _ = sample_wavelengths(self.setup.camera, rng, self.projector.lines)
        ray = self.setup.rays.sample(pixel, jitter, rng, wavelengths)
        none = _Axis(mi.Float(0), mi.Float(0), mi.Float(1), mi.Bool(False))
        axis, _ = self.setup.passage.along(ray, mi.Spectrum(1), (none, rng), self._axis)
        row, column = rows_columns(axis.x, axis.y)
        width, valid = axis.width, axis.known
        dr.eval(jitter, row, column, width, valid)
        stacked = [np.stack([np.array(a), np.array(b)], axis=1) for a, b in ((jitter.y, jitter.x), (row, column))]
        return stacked[0], stacked[1], np.array(width, dtype=np.float64), np.array(valid, dtype=np.float64)

    def _axis(self, at: Arrival, state: tuple[_Axis, mi.PCG32]) -> tuple[_Axis, mi.PCG32]:
        """The axis of the first surface that turns a ray sharply."""
        axis, rng = state
        # The middle of the random numbers is the middle of a lobe, or near it.
        turn = at.turn(rng.next_float32(), mi.Point2f(0.5))
        sharp = at.active & (turn.pdf > dr.opaque(mi.Float, _SHARP_AXIS))
        sharp &= ~mi.has_flag(turn.sampled_type, mi.BSDFFlags.Delta)
        place = landing(self.setup, at.si, at.si.to_world(turn.wo), sharp & ~axis.known)
        # 1 / sqrt(pi q), q the density on the sensor.
        width = place.length * dr.rsqrt(dr.pi * turn.pdf * place.cosine)
        found = _Axis(place.x, place.y, width, place.arrives)
        chosen = (dr.select(place.arrives, getattr(found, name), getattr(axis, name)) for name in vars(axis))
        return _Axis(*chosen), rng
