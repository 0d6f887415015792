"""The projector for tracers: from a pixel of its window to the ray through it, its area, and its flux.

A stock ``projector`` emitter does not state its field of view, so that its map is fitted to the uv of many points. It
casts pi x scale x texture on the plane at unit distance. A ray of a pixel that is cut into N rays carries ``phi = pi
scale texture a / N``, a being the pixel's area on that plane: the same through every point of a lens.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.devices.projector import Lines
from mitsim.transport.plugins.base import Numbers, channels, device_vectors, host_values, turn_and_origin

_WAVELENGTH_SETS = 8
_FAR = 1000.0
_PROBES = 24
_FIRST_REACH = 0.02
_PROBE_STEP = 1e-2


@dataclass(frozen=True)
class ProjectorOptics:
    """The emitter and its window: n x n pixels from (first_row, first_column) of a (rows, columns) canvas.

    ``aperture`` is the lens radius [mm] (0: a pinhole), ``focus`` the distance of the sharp plane [mm], ``blur`` the
    standard deviation of a pixel's spot [pixels]. The lens scatters all but ``share`` of the light with a standard
    deviation of ``glare_spread`` pixels.
    """

    emitter: mi.Emitter
    n: int
    first_row: float
    first_column: float
    canvas: tuple[int, int]
    aperture: float = 0.0
    focus: float = 400.0
    blur: float = 0.0
    lines: Lines | None = None
    parted: bool = False
    share: float = 1.0
    glare_spread: float = 0.0

    @property
    def scattered(self) -> ProjectorOptics:
        spread = math.hypot(self.blur, self.glare_spread)
        return replace(self, share=1 - self.share, blur=spread, glare_spread=0.0)

    @property
    def per_wavelength(self) -> tuple[ProjectorOptics, ...]:
        if not (self.parted and mi.is_spectral):
            return (self,)
        if self.lines is None:
            raise MitsimError(
                f"variant {mi.variant()}: its paths carry drawn wavelengths, which glass of the scene sends different "
                "ways; trace the projector's lines (colour lines), or choose a mono variant"
            )
        return tuple(replace(self, lines=line) for line in self.lines.apart) if self.lines.several else (self,)

    @property
    def by_line(self) -> bool:
        return self.lines is not None and self.lines.several

    @cached_property
    def canvas_map(self) -> CanvasMap:
        return CanvasMap.of(self.emitter)

    @property
    def ideal(self) -> bool:
        return self.aperture == 0 and self.blur == 0

    def canvas_point(
        self, row: Numbers, column: Numbers, number: Callable[[float], Numbers] = float
    ) -> tuple[Numbers, Numbers]:
        rows, columns, first_row, first_column = map(number, (*self.canvas, self.first_row, self.first_column))
        return (column + first_column) / columns, (row + first_row) / rows

    def pixel_at(self, uv: mi.Point2f) -> mi.UInt32:
        n = _opaque(self.n)
        row, column = (
            dr.clip(dr.floor(place * _opaque(count) - _opaque(part)) - _opaque(first), 0, n - 1)
            for place, count, (part, first) in (
                (uv.y, self.canvas[0], math.modf(self.first_row)),
                (uv.x, self.canvas[1], math.modf(self.first_column)),
            )
        )
        return mi.UInt32(row * n + column)

    def pixel_size(self) -> tuple[float, float]:
        """Return the size (x, y) of a pixel on the plane at unit distance [mm], by the emitter's own float32.

        :class:`CanvasMap` is 1e-4 more exact, but frames of a blurred spot would not stay bit-equal.
        """
        probe = dr.zeros(mi.SurfaceInteraction3f, 2)
        probe.p = self.emitter.world_transform() @ mi.Point3f([0.0, _PROBE_STEP], [0.0, _PROBE_STEP], [1.0, 1.0])
        sample, _ = self.emitter.sample_direction(probe, mi.Point2f(0.5))
        u, v = host_values(sample.uv.x, 2), host_values(sample.uv.y, 2)
        rows, columns = self.canvas
        return _PROBE_STEP / (abs(u[1] - u[0]) * columns), _PROBE_STEP / (abs(v[1] - v[0]) * rows)


@dataclass(frozen=True, eq=False)
class CanvasMap:
    """Map of a stock ``projector``: local tan-angles x = x[0] u + x[1], y = y[0] v + y[1].

    ``turn`` (3, 3) and ``origin`` (3,) [mm] take local points to the world.
    """

    turn: FloatArray
    origin: FloatArray
    x: FloatArray
    y: FloatArray

    @classmethod
    def of(cls, emitter: mi.Emitter) -> CanvasMap:
        turn, origin = turn_and_origin(mi.traverse(emitter)["to_world"])
        reach = _FIRST_REACH
        for _ in range(2):  # first near the axis, to learn the field of view, then over all of it
            x, y = (part.ravel() for part in np.meshgrid(*[np.linspace(-reach, reach, _PROBES)] * 2))
            local = np.stack([x, y, np.ones(x.size)], axis=1)
            uv = _direction_samples(emitter, turn, origin, local, None)[0].uv
            fits = [
                np.linalg.lstsq(np.stack([host_values(part, x.size), np.ones(x.size)], axis=1), tangent, rcond=None)[0]
                for part, tangent in ((uv.x, x), (uv.y, y))
            ]
            reach = 0.49 * min(abs(fits[0][0]), abs(fits[1][0]))
        return cls(turn, origin, fits[0], fits[1])

    def tangents(self, u: Numbers, v: Numbers, number: Callable[[float], Numbers] = float) -> tuple[Numbers, Numbers]:
        x, y = ([number(float(value)) for value in axis] for axis in (self.x, self.y))
        return x[0] * u + x[1], y[0] * v + y[1]

    def pixel_area(self, canvas: Sequence[int]) -> float:
        return float(abs(self.x[0] * self.y[0]) / (canvas[0] * canvas[1]))


class ProjectorRays:
    def __init__(self, projector: ProjectorOptics) -> None:
        self.projector, self._map = projector, projector.canvas_map

    def sample(self, pixel: mi.UInt32, jitter: mi.Point2f, rng: mi.PCG32, wavelengths: mi.Color0f) -> mi.Ray3f:
        projector = self.projector
        n = dr.opaque(mi.UInt32, projector.n)
        row, column = mi.Float(pixel // n) + jitter.y, mi.Float(pixel % n) + jitter.x
        if projector.blur > 0:
            spot = mi.warp.square_to_std_normal(mi.Point2f(rng.next_float32(), rng.next_float32()))
            spread = dr.opaque(mi.Float, projector.blur)
            row, column = row + spread * spot.y, column + spread * spot.x
        image = self._image(row, column)
        lens = mi.Vector3f(0)
        if projector.aperture > 0:
            disk = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(rng.next_float32(), rng.next_float32()))
            lens = mi.Vector3f(disk.x, disk.y, 0) * dr.opaque(mi.Float, projector.aperture)
            image = image - lens / dr.opaque(mi.Float, projector.focus)
        return mi.Ray3f(self._origin + self._turn @ lens, dr.normalize(self._turn @ image), 0.0, wavelengths)

    def flux(self, pixel: mi.UInt32, wavelengths: mi.Color0f) -> mi.Spectrum:
        n = dr.opaque(mi.UInt32, self.projector.n)
        centre = self._image(mi.Float(pixel // n) + 0.5, mi.Float(pixel % n) + 0.5)
        at = dr.zeros(mi.SurfaceInteraction3f)
        at.wavelengths = wavelengths
        at.p = self._origin + self._turn @ (centre * _FAR)
        _, weight = self.projector.emitter.sample_direction(at, mi.Point2f(0.5), True)
        area = _opaque(self._map.pixel_area(self.projector.canvas) * self.projector.share)
        return weight * (_FAR**2 * dr.rsqrt(dr.squared_norm(centre)) * area)

    @cached_property
    def _origin(self) -> mi.Point3f:
        return mi.Point3f(*map(_opaque, self._map.origin))

    @cached_property
    def _turn(self) -> mi.Matrix3f:
        return mi.Matrix3f(*map(_opaque, self._map.turn.ravel()))

    def _image(self, row: mi.Float, column: mi.Float) -> mi.Vector3f:
        canvas_point = self.projector.canvas_point(row, column, _opaque)
        return mi.Vector3f(*self._map.tangents(*canvas_point, _opaque), 1)


def _opaque(value: float) -> mi.Float:
    return dr.opaque(mi.Float, float(value))


def line_wavelengths(lines: Lines) -> tuple[mi.Color0f, FloatArray]:
    """Return wavelengths [nm] of a path with some lines, and weights (4,) whose mean is the sum of the lines.

    Fewer than four lines are filled with the first, of weight 0.
    """
    size = len(dr.zeros(mi.UnpolarizedSpectrum))
    more = size - len(lines.shares)
    # Opaque numbers keep the compiled kernel the same for all lines.
    wavelengths = (dr.opaque(mi.Float, value) for value in (*lines.wavelengths_nm, *lines.wavelengths_nm[:1] * more))
    weights = np.array([*lines.shares, *[0.0] * more]) * size
    return type(dr.zeros(mi.Ray3f).wavelengths)(*wavelengths), weights


def wavelength_sets(lines: Lines | None = None) -> list[mi.Color0f | None]:
    if not mi.is_spectral:
        return [None]
    if lines is not None:
        return [line_wavelengths(lines)[0]]
    size = len(dr.zeros(mi.UnpolarizedSpectrum))
    step = (mi.MI_CIE_MAX - mi.MI_CIE_MIN) / (_WAVELENGTH_SETS * size)
    even = mi.MI_CIE_MIN + step * (np.arange(_WAVELENGTH_SETS * size) + 0.5)
    return [type(dr.zeros(mi.Ray3f).wavelengths)(*even[i::_WAVELENGTH_SETS].tolist()) for i in range(_WAVELENGTH_SETS)]


class PinholeRays:
    """Rays of a projector without lens and blur, in float64.

    ``area`` is that of a pixel at unit distance [mm^2], ``power`` (n * n, channels) its irradiance there [W m^-2].
    """

    def __init__(self, projector: ProjectorOptics, wavelengths: Sequence[mi.Color0f | None]) -> None:
        self._projector, n = projector, projector.n
        self._map = projector.canvas_map
        self.origin = self._map.origin
        self.area = self._map.pixel_area(projector.canvas)
        centre = np.stack(np.divmod(np.arange(n * n), n), axis=1) + 0.5
        self.power = np.concatenate([self._irradiance(centre, chosen) for chosen in wavelengths], axis=1)
        if mi.is_spectral and projector.lines is not None:
            self.power *= line_wavelengths(projector.lines)[1]

    def directions(self, points: FloatArray) -> FloatArray:
        world = self._local(points) @ self._map.turn.T
        return np.asarray(world / np.linalg.norm(world, axis=1, keepdims=True))

    def points(self, places: FloatArray) -> tuple[FloatArray, FloatArray]:
        local = np.linalg.solve(self._map.turn, (places - self.origin).T)
        depth, canvas = local[2], self._projector.canvas
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = ((local[i] / depth - axis[1]) / axis[0] for i, axis in enumerate((self._map.x, self._map.y)))
        row = v * canvas[0] - self._projector.first_row
        return np.stack([row, u * canvas[1] - self._projector.first_column], axis=1), depth

    def _local(self, points: FloatArray) -> FloatArray:
        tangents = self._map.tangents(*self._projector.canvas_point(points[:, 0], points[:, 1]))
        return np.stack([*tangents, np.ones(len(points))], axis=1)

    def _irradiance(self, points: FloatArray, wavelengths: mi.Color0f | None) -> FloatArray:
        _, emitted, depth, cosine = _direction_samples(
            self._projector.emitter, self._map.turn, self.origin, self._local(points), wavelengths
        )
        return channels(mi.unpolarized_spectrum(emitted), len(points)) * (cosine * depth**2)[:, None]


def _direction_samples(
    emitter: mi.Emitter, turn: FloatArray, origin: FloatArray, local: FloatArray, wavelengths: mi.Color0f | None
) -> tuple[mi.DirectionSample3f, mi.Spectrum, float, FloatArray]:
    depth = _FAR * max(1.0, float(np.abs(origin).max()) / 100)
    forward = turn[:, 2] / np.linalg.norm(turn[:, 2])
    world = local @ turn.T
    world *= depth / (world @ forward)[:, None]
    interaction = dr.zeros(mi.SurfaceInteraction3f, len(local))
    interaction.p = mi.Point3f(*device_vectors(origin + world))
    if wavelengths is not None:
        interaction.wavelengths = wavelengths
    sample, emitted = emitter.sample_direction(interaction, mi.Point2f(0.5), True)
    return sample, emitted, depth, depth / np.linalg.norm(world, axis=1)
