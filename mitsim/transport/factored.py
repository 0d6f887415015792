"""The factored estimator's light: from a scene to the light of each projector pixel that reaches the camera, by direction.

A path starts at an *anchor* (a point of the sensor), goes through a cell of directions, and connects to the projector
at every vertex; a connection names the projector pixel that it used. Collected over one pass, the connections give every
frame of every pattern family, because light is linear and indirect light keeps its pixel too. The mask and the sensor
pixels are applied afterwards in closed form (:mod:`mitsim.optics`), which is what makes the estimator fast.

Value collected, for anchor a and tan-angle t from it (the integrand of the reference estimator without its mask)::

    g_a(t) dt = L(a, t) (1 + |t|^2)^-2 r(t) dt          [W m^-2]        r: the pixel's angular response

A path's light is filed under the direction and depth of its first vertex that is no mirror: through plane mirrors, of
that vertex's image, which is where the camera sees it. Directions are those seen from the sensor's centre,
tau = (x/z, y/z). The ray from anchor a is aimed at tau on a plane at the depth of the light (t = tau - a/z, so
dt = dtau at any depth).

Paths end at random (Russian roulette) with a probability that keeps the estimate unbiased; there is no last bounce.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.errors import MitsimError
from mitsim.optics.camera import CameraGeometry, anchor_positions
from mitsim.transport.cells import CellGrid
from mitsim.transport.histogram import Deposits
from mitsim.transport.sampling import generator, stratified
from mitsim.transport.source import Projector, Source

LANES_PER_LAUNCH = 2**22
_ROUNDING = 1e-3
_MARGIN = 1e-4
_CAMERA, _BOUNCE = 0, 1
_ROULETTE_FROM = 3
_LONGEST = 1000


@dataclass(frozen=True)
class Paths:
    """Which light is followed besides projector - surface - camera.

    ``mirrors``: over delta reflections and transmissions on the camera's side; ``interreflection``: any number of
    bounces; ``emitters``: other lights of the scene, all of them one class of ambient light.
    """

    mirrors: bool = False
    interreflection: bool = False
    emitters: tuple[Any, ...] = ()


class Tracer:
    """Prepared once for a scene, a cell grid and a number of anchors; each seed is an independent estimate."""

    def __init__(
        self,
        scene: Any,
        camera: Any,
        projector: Projector,
        grid: CellGrid,
        anchors: int,
        depth: float | None = None,
        paths: Paths | None = None,
        common: bool = False,
        geometry: CameraGeometry | None = None,
    ) -> None:
        """Settings of the estimator.

        ``depth`` [mm] is where the rays of different anchors through one cell meet: best at the depth of the light, and
        the camera's scene distance without it. ``common`` gives every anchor the same random numbers, so that
        differences between anchors are smooth. ``geometry`` stands in for the camera's own.
        """
        self.geometry: CameraGeometry = geometry or camera.geometry
        self.scene, self.camera, self.projector, self.grid = scene, camera, projector, grid
        self.anchors, self.common, self.paths = anchors, common, paths or Paths()
        self.depth = self.geometry.scene_distance if depth is None else depth
        self.positions = anchor_positions(anchors, self.geometry.half_width)
        self._source = Source(projector)

    @property
    def lanes(self) -> int:
        """Paths in one sample: one per anchor and cell."""
        return self.anchors**2 * self.grid.shape[0] * self.grid.shape[1]

    def trace(self, seed: int, first: int = 0, samples: int = 1) -> Deposits:
        """Samples ``first`` .. ``first + samples - 1`` of the sequence ``seed``, a path each a cell and an anchor.

        Raises
        ------
        MitsimError
            when the scene sends NaN or infinite light to the camera.
        """
        total, start = self.lanes * samples, self.lanes * first
        parts = [
            part
            for done in range(0, total, LANES_PER_LAUNCH)
            for part in self._launch(seed, start + done, min(LANES_PER_LAUNCH, total - done))
        ]
        return Deposits.joined(parts)

    def _launch(self, seed: int, first: int, count: int) -> list[Deposits]:
        lane = dr.arange(mi.UInt64, count) + dr.opaque(mi.UInt64, first)
        per_sample = dr.opaque(mi.UInt64, self.lanes)
        sample = mi.UInt32(lane // per_sample)
        walk = _Walk(self, seed, mi.UInt32(lane % per_sample), sample)
        return walk.deposits()


class _Walk:
    """One launch: paths from the camera, bounce by bounce; ended paths are dropped between bounces."""

    def __init__(self, tracer: Tracer, seed: int, lane: Any, sample: Any) -> None:
        self.tracer, self.paths, self.source = tracer, tracer.paths, tracer._source
        self.seed, self.lane, self.sample = seed, lane, sample
        self.found: list[Deposits] = []
        self.rng = generator(dr.opaque(mi.UInt32, seed), self._stream())
        self._aim()
        self.strength = mi.Spectrum(1)
        self.travelled = mi.Float(0)
        self.seen_at_mirror = mi.Bool(True)
        self.came_from, self.came_pdf = dr.zeros(mi.Point3f), mi.Float(0)
        self.by_delta = mi.Bool(True)
        self.order, self.left_at = mi.UInt32(1), mi.UInt32(1)

    def deposits(self) -> list[Deposits]:
        """Follow every path to its end."""
        for bounce in range(_LONGEST):
            if not self._step(bounce):
                break
        return self.found

    # ---- the camera's side ------------------------------------------------------------------------------------------

    def _stream(self) -> Any:
        """Stream of random numbers: one a cell and anchor (a cell alone when anchors share theirs)."""
        cells = dr.opaque(mi.UInt32, self.tracer.grid.shape[0] * self.tracer.grid.shape[1])
        return self.lane % cells if self.tracer.common else self.lane

    def _aim(self) -> None:
        """Rays from the anchors through the cells, and the weight of each."""
        tracer, grid, geometry = self.tracer, self.tracer.grid, self.tracer.geometry
        # Opaque numbers keep the compiled kernel the same for every grid and seed.
        rows, columns = dr.opaque(mi.UInt32, grid.shape[0]), dr.opaque(mi.UInt32, grid.shape[1])
        anchor = self.lane // (rows * columns)
        anchors = dr.opaque(mi.UInt32, tracer.anchors)
        self.anchor_row, self.anchor_column = anchor // anchors, anchor % anchors
        # A path that leaves a cell's very edge could be filed in the next cell by rounding.
        jitter = _MARGIN + (1 - 2 * _MARGIN) * stratified(self.sample, self.rng)
        self.aimed_row = _edge(grid.rows, (self.lane // columns) % rows, jitter.x)
        self.aimed_column = _edge(grid.columns, self.lane % columns, jitter.y)
        positions = mi.Float(tracer.positions.astype(np.float32))
        self.u = mi.Point2f(
            -dr.gather(mi.Float, positions, self.anchor_column), -dr.gather(mi.Float, positions, self.anchor_row)
        )
        z = dr.opaque(mi.Float, tracer.depth)
        self.t = mi.Vector2f(-self.aimed_column, -self.aimed_row) - mi.Vector2f(self.u) / z
        squared = 1 + dr.squared_norm(self.t)
        # The plugin's parameters may carry other random numbers in every sample, so this draw is made anew.
        fresh = generator(dr.opaque(mi.UInt32, self.seed) ^ self.sample, self._stream())
        wavelengths, spectral = tracer.camera.sample_wavelengths(
            dr.zeros(mi.SurfaceInteraction3f), fresh.next_float32(), True
        )
        to_world = tracer.camera.world_transform()
        self.ray = mi.Ray3f(
            to_world @ mi.Point3f(self.u.x, self.u.y, 0),
            to_world @ (mi.Vector3f(self.t.x, self.t.y, 1) * dr.rsqrt(squared)),
            0.0,
            wavelengths,
        )
        stop = dr.opaque(mi.Float, geometry.tan_half_fov)
        self.active = (dr.abs(self.t.x) <= stop) & (dr.abs(self.t.y) <= stop)
        # dt of a cell times (1 + t^2)^-2, and a pixel's response cos^n.
        solid = dr.opaque(mi.Float, grid.rows.size * grid.columns.size) / dr.square(squared)
        if geometry.angular_exponent > 0:
            solid *= dr.power(squared, -0.5 * dr.opaque(mi.Float, geometry.angular_exponent))
        self.weight = spectral * solid
        self.inverse_depth, self.tau_row, self.tau_column = mi.Float(0), self.aimed_row, self.aimed_column

    def _file(self, distance: Any) -> None:
        """Where the camera sees this vertex, unless an earlier one that is no mirror has settled it."""
        slope = dr.rsqrt(1 + dr.squared_norm(self.t))
        near = dr.rcp((self.travelled + distance) * slope)
        row, column = -(self.t.y + self.u.y * near), -(self.t.x + self.u.x * near)
        rate_row = dr.opaque(mi.Float, 1 / self.tracer.grid.rows.size)
        rate_column = dr.opaque(mi.Float, 1 / self.tracer.grid.columns.size)
        row = dr.select(dr.abs(row - self.aimed_row) * rate_row < _ROUNDING, self.aimed_row, row)
        column = dr.select(dr.abs(column - self.aimed_column) * rate_column < _ROUNDING, self.aimed_column, column)
        unsettled = self.seen_at_mirror
        self.inverse_depth = dr.select(unsettled, near, self.inverse_depth)
        self.tau_row = dr.select(unsettled, row, self.tau_row)
        self.tau_column = dr.select(unsettled, column, self.tau_column)

    # ---- one bounce -------------------------------------------------------------------------------------------------

    def _step(self, bounce: int) -> bool:
        """Find the next vertex of every path, connect it, and leave it; False when all paths have ended."""
        scene, seed = self.tracer.scene, dr.opaque(mi.UInt32, (self.seed + bounce) & 0xFFFFFFFF)
        self.rng = generator(seed ^ (self.sample * 0x9E3779B9), self._stream() + 1)
        si = scene.ray_intersect(mi.RayDifferential3f(self.ray), mi.RayFlags.All, bounce == 0, self.active)
        if bounce == 0 or self.paths.mirrors:
            self._file(si.t)
            if bounce == 0:
                behind_mask = self.inverse_depth < 1 / dr.opaque(mi.Float, self.tracer.geometry.mask_distance)
                self.active &= behind_mask
        waiting: list[tuple[Any, Any, Any]] = []
        if bounce > 0 and self.tracer.projector.aperture > 0 and self.paths.interreflection:
            waiting.append(self._projector_hit(si))
        if self.paths.emitters:
            waiting.append(self._emitter_hit(si))
        self.active &= si.is_valid()
        bsdf = si.bsdf()
        waiting.append(self._connected(si, bsdf))
        waiting += [self._lit(si, bsdf, emitter) for emitter in self.paths.emitters]
        going = self.paths.mirrors or self.paths.interreflection
        if going:
            self._leave(si, bsdf, bounce)
        self._keep(waiting)
        return going and self._drop_ended()

    def _connected(self, si: Any, bsdf: Any) -> tuple[Any, Any, Any]:
        """Light of the projector that this vertex sends on along its path."""
        found = self.source.connect(si, self.rng, self.active)
        active = found.valid & ~self.tracer.scene.ray_test(si.spawn_ray_to(found.target), found.valid)
        toward = si.to_local(found.direction)
        if self.tracer.projector.aperture > 0 and self.paths.interreflection:
            value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, toward, active)
            value *= self._share(found.pdf, pdf)
        else:
            value = bsdf.eval(mi.BSDFContext(), si, toward, active)
        return found.pixel, dr.select(active, self._radiance(value * found.weight), 0), self.order

    def _lit(self, si: Any, bsdf: Any, emitter: Any) -> tuple[Any, Any, Any]:
        """The same for another light of the scene."""
        point = mi.Point2f(self.rng.next_float32(), self.rng.next_float32())
        ds, light = emitter.sample_direction(si, point, self.active)
        active = self.active & (ds.pdf > 0)
        active &= ~self.tracer.scene.ray_test(si.spawn_ray_to(ds.p), active)
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), active)
        # A path that does not go on cannot run into the lamp, so connecting is the only way to find it.
        share = dr.select(ds.delta, 1, self._share(ds.pdf, pdf)) if self.paths.interreflection else 1
        return self._ambient(), dr.select(active, self._radiance(value * light) * share, 0), self.order

    def _emitter_hit(self, si: Any) -> tuple[Any, Any, Any]:
        """Light of a lamp that the path has run into."""
        emitter = si.emitter(self.tracer.scene, self.active)
        ds = mi.DirectionSample3f(self.tracer.scene, si, self._reference())
        lamp = self.active & (emitter != None)  # noqa: E711 - a Dr.Jit comparison, lane by lane
        pdf = emitter.pdf_direction(self._reference(), ds, lamp & ~self.by_delta)
        share = dr.select(self.by_delta, 1, self._share(self.came_pdf, pdf))
        return self._ambient(), dr.select(lamp, self._radiance(emitter.eval(si, lamp)) * share, 0), self.left_at

    def _projector_hit(self, si: Any) -> tuple[Any, Any, Any]:
        """Light of a projector's lens that the path has run into.

        Paths that come from the projector over mirrors alone are the beams' (:mod:`mitsim.transport.beams`).
        """
        active = self.active & ~(self.by_delta & self.seen_at_mirror)
        radiance, pdf, pixel, met = self.source.hit(self.ray, si.t, self.rng, active)
        share = dr.select(self.by_delta, 1, self._share(self.came_pdf, pdf))
        return pixel, dr.select(met, self._radiance(radiance) * share, 0), self.left_at

    def _leave(self, si: Any, bsdf: Any, bounce: int) -> None:
        """Sample where each path goes on, and end some of them."""
        sample, value = bsdf.sample(
            mi.BSDFContext(),
            si,
            self.rng.next_float32(),
            mi.Point2f(self.rng.next_float32(), self.rng.next_float32()),
            self.active,
        )
        delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
        going = self.active & (sample.pdf > 0)
        if not self.paths.interreflection:
            going &= delta
        elif not self.paths.mirrors:
            going &= ~delta
        self.strength *= value
        if bounce + 1 >= _ROULETTE_FROM:
            chance = dr.minimum(dr.max(self.strength), 0.95)
            going &= self.rng.next_float32() < chance
            self.strength *= dr.rcp(dr.maximum(chance, 1e-6))
        self.active = going & (dr.max(self.strength) > 0)
        self.seen_at_mirror &= delta
        self.left_at = self.order
        self.order = dr.select(delta, self.order, self.order + 1)
        self.travelled += si.t
        self.came_from, self.came_pdf, self.by_delta = mi.Point3f(si.p), sample.pdf, delta
        self.ray = si.spawn_ray(si.to_world(sample.wo))

    # ---- bookkeeping ------------------------------------------------------------------------------------------------

    def _radiance(self, light: Any) -> Any:
        """One number for the light of a connection, as irradiance at the anchor."""
        return panchromatic(mi.unpolarized_spectrum(light) * self.strength * self.weight)

    def _ambient(self) -> Any:
        return mi.UInt32(self.tracer.projector.n**2)

    def _reference(self) -> Any:
        before = dr.zeros(mi.Interaction3f)
        before.p = self.came_from
        return before

    @staticmethod
    def _share(own: Any, other: Any) -> Any:
        """Balance heuristic of two ways to find the same light; a pdf of 0 means that a way cannot find it."""
        return dr.select(own > 0, own / (own + other), 1)

    def _keep(self, waiting: Sequence[tuple[Any, Any, Any]]) -> None:
        """Evaluate a bounce in one kernel and take its light to the host."""
        shared = (self.anchor_row, self.anchor_column, self.tau_row, self.tau_column, self.inverse_depth)
        dr.eval(waiting, shared, *self._state())
        for source, value, order in waiting:
            light = np.array(value)
            if not np.isfinite(light).all():
                raise MitsimError("the scene reflects NaN or infinite light toward the camera; check its materials")
            lit = np.flatnonzero(light)
            a, b, row, column, near = (np.resize(np.array(one), light.shape)[lit] for one in shared)
            pixel, vertex = (np.resize(np.array(one), light.shape)[lit] for one in (source, order))
            self.found.append(
                Deposits(
                    *(index.astype(np.int64) for index in (pixel, a, b)),
                    *(one.astype(np.float64) for one in (row, column, near, light[lit])),
                    vertex.astype(np.int16),
                )
            )

    _STATE = (
        *("lane", "sample", "anchor_row", "anchor_column", "u", "t", "weight", "strength", "travelled", "active"),
        *("seen_at_mirror", "inverse_depth", "tau_row", "tau_column", "aimed_row", "aimed_column", "ray"),
        *("came_from", "came_pdf", "by_delta", "order", "left_at"),
    )

    def _state(self) -> list[Any]:
        return [getattr(self, name) for name in self._STATE]

    def _drop_ended(self) -> bool:
        """Keep only the paths that go on."""
        going = dr.compress(self.active)
        if len(going) == 0:
            return False
        width = len(self.active)
        for name in self._STATE:
            value = getattr(self, name)
            if dr.width(value) == width:
                setattr(self, name, dr.gather(type(value), value, going))
        return True


def panchromatic(radiance: Any) -> Any:
    """One number for a spectrum, by a flat response: the mean over channels, or over wavelength 360-830 nm.

    In spectral variants the radiance has been divided by the density of its sampled wavelengths, so the mean over
    samples is an integral; dividing by the range makes a flat spectrum of 1 count as 1, as in the other variants.
    """
    mean = dr.mean(radiance)
    return mean / (mi.MI_CIE_MAX - mi.MI_CIE_MIN) if mi.is_spectral else mean


def _edge(axis: Any, index: Any, jitter: Any) -> Any:
    start, size = dr.opaque(mi.Float, axis.start), dr.opaque(mi.Float, axis.size)
    return start + (mi.Float(index) + jitter) * size
