"""The factored estimator's light: from a scene to the light of each projector pixel, by where the camera sees it.

A path starts at an *anchor* (a point of the sensor), goes through a cell of directions, and connects to the projector
at every vertex; a connection names the projector pixel that it used. Collected over one pass, the connections give
every frame of every pattern family, because light is linear and indirect light keeps its pixel too. The mask and the
sensor pixels are applied afterwards in closed form (:mod:`mitsim.optics`), which is what makes the estimator fast.

Value collected, for anchor a and tan-angle t from it (the integrand of the reference estimator without its mask)::

    g_a(t) dt = L(a, t) (1 + |t|^2)^-2 r(t) dt          [W m^-2]        r: the pixel's angular response

A path's light is filed under the direction and depth of its first vertex that is no mirror: through plane mirrors, of
that vertex's image, which is where the camera sees it. Directions are those seen from the sensor's centre,
tau = (x/z, y/z). The ray from anchor a is aimed at tau on a plane at the depth of the light (t = tau - a/z, so
dt = dtau at any depth).

Paths end at random (Russian roulette) with a probability that keeps the estimate unbiased; there is no last bounce.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.errors import MitsimError
from mitsim.optics.camera import CameraGeometry, anchor_positions
from mitsim.transport.cells import CellGrid
from mitsim.transport.histogram import AMBIENT, DIRECT, INDIRECT, Deposits
from mitsim.transport.sampling import generator, panchromatic, stratified
from mitsim.transport.source import Projector, Source

LANES_PER_LAUNCH = 2**22
_ROUNDING = 1e-3
_MARGIN = 1e-4
_MIRRORS = 16
_KINDS = MappingProxyType({"direct": DIRECT, "indirect": INDIRECT, "ambient": AMBIENT})


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
        self.source = Source(projector)

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
        return Deposits.joined(parts) if parts else Deposits.none()

    def _launch(self, seed: int, first: int, count: int) -> list[Deposits]:
        lane = dr.arange(mi.UInt64, count) + dr.opaque(mi.UInt64, first)
        per_sample = dr.opaque(mi.UInt64, self.lanes)
        sample = mi.UInt32(lane // per_sample)
        walk = _Walk(self, seed, mi.UInt32(lane % per_sample), sample)
        return walk.deposits()


class _Walk:
    """One launch: paths from the camera in one kernel, the first vertex apart and all others in a loop.

    A path makes many connections, and the kernel hands out one of each kind: direct light of the projector, its
    indirect light, and ambient light. Which connection stands for its kind is drawn in proportion to its light
    (reservoir sampling), and it carries the light of all, so expectations are kept.
    """

    def __init__(self, tracer: Tracer, seed: int, lane: Any, sample: Any) -> None:
        self.tracer, self.paths, self.source, self.geometry = tracer, tracer.paths, tracer.source, tracer.geometry
        self.scene, self.lane = tracer.scene, lane
        cells = dr.opaque(mi.UInt32, tracer.grid.shape[0] * tracer.grid.shape[1])
        stream = lane % cells if tracer.common else lane
        scrambling = generator(dr.opaque(mi.UInt32, seed), stream)
        # A path that leaves a cell's very edge could be filed in the next cell by rounding.
        jitter = _MARGIN + (1 - 2 * _MARGIN) * stratified(sample, scrambling)
        self.rng = generator(dr.opaque(mi.UInt32, seed) ^ (sample * 0x9E3779B9 + 1), stream)
        self.strength = mi.Spectrum(1)
        self.travelled, self.bounce, self.order, self.left_at = mi.Float(0), mi.UInt32(0), mi.UInt32(1), mi.UInt32(1)
        self.by_delta, self.mirrored = mi.Bool(True), mi.Bool(True)
        self.came_from, self.came_pdf = dr.zeros(mi.Point3f), mi.Float(0)
        self._aim(jitter)
        self.kept = {kind: self._nothing() for kind in _KINDS}

    def deposits(self) -> list[Deposits]:
        """Follow every path to its end, and take its light to the host."""
        self._vertex(first=True)
        if self.paths.mirrors or self.paths.interreflection:
            self._load(dr.while_loop(self._values(), lambda *values: values[0], self._body, labels=self._STATE))
        return self._fetched()

    def _body(self, *values: Any) -> tuple[Any, ...]:
        self._load(values)
        self._vertex(first=False)
        return self._values()

    # ---- the camera's side ------------------------------------------------------------------------------------------

    def _aim(self, jitter: Any) -> None:
        """Rays from the anchors through the cells, and the weight of each."""
        tracer, grid = self.tracer, self.tracer.grid
        # Opaque numbers keep the compiled kernel the same for every grid and seed.
        rows, columns = dr.opaque(mi.UInt32, grid.shape[0]), dr.opaque(mi.UInt32, grid.shape[1])
        anchor, anchors = self.lane // (rows * columns), dr.opaque(mi.UInt32, tracer.anchors)
        self.anchor_row, self.anchor_column = anchor // anchors, anchor % anchors
        self.aimed_row = _edge(grid.rows, (self.lane // columns) % rows, jitter.x)
        self.aimed_column = _edge(grid.columns, self.lane % columns, jitter.y)
        positions = mi.Float(tracer.positions.astype(np.float32))
        self.u = mi.Point2f(
            -dr.gather(mi.Float, positions, self.anchor_column), -dr.gather(mi.Float, positions, self.anchor_row)
        )
        self.t = mi.Vector2f(-self.aimed_column, -self.aimed_row) - mi.Vector2f(self.u) / dr.opaque(
            mi.Float, tracer.depth
        )
        squared = 1 + dr.squared_norm(self.t)
        self.slope = dr.rsqrt(squared)
        wavelengths, spectral = tracer.camera.sample_wavelengths(
            dr.zeros(mi.SurfaceInteraction3f), self.rng.next_float32(), True
        )
        to_world = tracer.camera.world_transform()
        self.ray = mi.Ray3f(
            to_world @ mi.Point3f(self.u.x, self.u.y, 0),
            to_world @ (mi.Vector3f(self.t.x, self.t.y, 1) * self.slope),
            0.0,
            wavelengths,
        )
        stop = dr.opaque(mi.Float, self.geometry.tan_half_fov)
        self.active = (dr.abs(self.t.x) <= stop) & (dr.abs(self.t.y) <= stop)
        # dt of a cell times (1 + t^2)^-2, and a pixel's response cos^n.
        solid = dr.opaque(mi.Float, grid.rows.size * grid.columns.size) / dr.square(squared)
        if self.geometry.angular_exponent > 0:
            solid *= dr.power(squared, -0.5 * dr.opaque(mi.Float, self.geometry.angular_exponent))
        self.weight = spectral * solid
        self.near, self.tau_row, self.tau_column = mi.Float(0), mi.Float(self.aimed_row), mi.Float(self.aimed_column)

    def _file(self, distance: Any) -> None:
        """Where the camera sees this vertex, unless an earlier one that is no mirror has settled it."""
        near = dr.rcp((self.travelled + distance) * self.slope)
        row = self._snapped(-(self.t.y + self.u.y * near), self.aimed_row, self.tracer.grid.rows)
        column = self._snapped(-(self.t.x + self.u.x * near), self.aimed_column, self.tracer.grid.columns)
        self.near = dr.select(self.mirrored, near, self.near)
        self.tau_row = dr.select(self.mirrored, row, self.tau_row)
        self.tau_column = dr.select(self.mirrored, column, self.tau_column)

    @staticmethod
    def _snapped(tau: Any, aimed: Any, axis: Any) -> Any:
        """A point within rounding of where its ray was aimed lies there."""
        return dr.select(dr.abs(tau - aimed) * dr.opaque(mi.Float, 1 / axis.size) < _ROUNDING, aimed, tau)

    # ---- one vertex -------------------------------------------------------------------------------------------------

    def _vertex(self, first: bool) -> None:
        """Find the next vertex of every path, connect it to the lights, and leave it."""
        si = self.scene.ray_intersect(mi.RayDifferential3f(self.ray), mi.RayFlags.All, first, self.active)
        if first or self.paths.mirrors:
            self._file(si.t)
        if first:
            self.active &= self.near < 1 / dr.opaque(mi.Float, self.geometry.mask_distance)
        elif self.tracer.projector.aperture > 0 and self.paths.interreflection:
            self._projector_hit(si)
        if self.paths.emitters:
            self._emitter_hit(si)
        self.active &= si.is_valid()
        bsdf = si.bsdf()
        if not first or self.paths.mirrors:
            self._connect(si, bsdf, first)
        for emitter in self.paths.emitters:
            self._light(si, bsdf, emitter)
        if self.paths.mirrors or self.paths.interreflection:
            self._leave(si, bsdf, first)

    def _connect(self, si: Any, bsdf: Any, first: bool) -> None:
        """Light of the projector that this vertex sends on along its path; what the first one sends is direct light."""
        if first:
            return
        found = self.source.connect(si, self.rng, self.active)
        active = found.valid & ~self.scene.ray_test(si.spawn_ray_to(found.target), found.valid)
        toward = si.to_local(found.direction)
        if self.tracer.projector.aperture > 0 and self.paths.interreflection:
            value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, toward, active)
            value *= self._share(found.pdf, pdf)
        else:
            value = bsdf.eval(mi.BSDFContext(), si, toward, active)
        self._keep_of_projector(active, self._radiance(value * found.weight), found.pixel, self.order)

    def _light(self, si: Any, bsdf: Any, emitter: Any) -> None:
        """The same for another light of the scene."""
        point = mi.Point2f(self.rng.next_float32(), self.rng.next_float32())
        ds, light = emitter.sample_direction(si, point, self.active)
        active = self.active & (ds.pdf > 0)
        active &= ~self.scene.ray_test(si.spawn_ray_to(ds.p), active)
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), active)
        # A path that does not go on cannot run into the lamp, so connecting is the only way to find it.
        share = dr.select(ds.delta, 1, self._share(ds.pdf, pdf)) if self.paths.interreflection else 1
        self._keep("ambient", active, self._radiance(value * light) * share, self._lamps())

    def _emitter_hit(self, si: Any) -> None:
        """Light of a lamp that the path has run into."""
        emitter = si.emitter(self.scene, self.active)
        before = dr.zeros(mi.Interaction3f)
        before.p = self.came_from
        lamp = self.active & (emitter != None)  # noqa: E711 - a Dr.Jit comparison, lane by lane
        ds = mi.DirectionSample3f(self.scene, si, before)
        pdf = emitter.pdf_direction(before, ds, lamp & ~self.by_delta)
        share = dr.select(self.by_delta, 1, self._share(self.came_pdf, pdf))
        self._keep("ambient", lamp, self._radiance(emitter.eval(si, lamp)) * share, self._lamps())

    def _projector_hit(self, si: Any) -> None:
        """Light of a projector's lens that the path has run into.

        Paths that come from the projector over mirrors alone are the beams' (:mod:`mitsim.transport.beams`).
        """
        active = self.active & ~(self.by_delta & self.mirrored)
        radiance, pdf, pixel, met = self.source.hit(self.ray, si.t, self.rng, active)
        share = dr.select(self.by_delta, 1, self._share(self.came_pdf, pdf))
        self._keep_of_projector(met, self._radiance(radiance) * share, pixel, self.left_at)

    def _leave(self, si: Any, bsdf: Any, first: bool) -> None:
        """Sample where each path goes on, and end some of them."""
        number = self.rng.next_float32()
        point = mi.Point2f(self.rng.next_float32(), self.rng.next_float32())
        sample, value = bsdf.sample(mi.BSDFContext(), si, number, point, self.active)
        delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
        going = self.active & (sample.pdf > 0)
        if not self.paths.interreflection:
            going &= delta
        elif not self.paths.mirrors:
            going &= ~delta
        self.strength *= mi.unpolarized_spectrum(value)
        self.bounce += 1
        if not first:
            # Chains of mirrors are short and full of light; other paths go on with a chance of what they carry.
            chance = dr.select(self.mirrored & (self.bounce < _MIRRORS), 1, dr.minimum(dr.max(self.strength), 0.95))
            going &= self.rng.next_float32() < chance
            self.strength *= dr.rcp(dr.maximum(chance, 1e-6))
        self.active = going & (dr.max(self.strength) > 0)
        self.mirrored &= delta
        self.left_at = mi.UInt32(self.order)
        self.order = dr.select(delta, self.order, self.order + 1)
        self.travelled += si.t
        self.came_from, self.came_pdf, self.by_delta = mi.Point3f(si.p), mi.Float(sample.pdf), mi.Bool(delta)
        self.ray = si.spawn_ray(si.to_world(sample.wo))

    # ---- light that is kept -----------------------------------------------------------------------------------------

    def _radiance(self, light: Any) -> Any:
        """One number for the light of a connection, as irradiance at the anchor."""
        return panchromatic(mi.unpolarized_spectrum(light) * self.strength * self.weight)

    def _lamps(self) -> Any:
        return mi.UInt32(self.tracer.projector.n**2)

    @staticmethod
    def _share(own: Any, other: Any) -> Any:
        """Balance heuristic of two ways to find the same light; a pdf of 0 means that a way cannot find it."""
        return dr.select(own > 0, own / (own + other), 1)

    def _nothing(self) -> tuple[Any, ...]:
        """No light yet: total, source, and where it is filed."""
        return mi.Float(0), mi.UInt32(0), mi.Float(0), mi.Float(0), mi.Float(0)

    def _keep_of_projector(self, active: Any, value: Any, pixel: Any, order: Any) -> None:
        self._keep("direct", active & (order == 1), value, pixel)
        if self.paths.interreflection:
            self._keep("indirect", active & (order > 1), value, pixel)

    def _keep(self, kind: str, active: Any, value: Any, source: Any) -> None:
        """Add light to a kind, and let this connection stand for it with the chance of its part."""
        total, *standing = self.kept[kind]
        value = dr.select(active, value, 0)
        added = total + value
        chosen = active & (self.rng.next_float32() * added < value)
        new = source, self.tau_row, self.tau_column, self.near
        self.kept[kind] = (added, *(dr.select(chosen, a, b) for a, b in zip(new, standing, strict=True)))

    def _fetched(self) -> list[Deposits]:
        """Light of every path on the host."""
        dr.eval(self.kept, self.anchor_row, self.anchor_column)
        row, column = np.array(self.anchor_row), np.array(self.anchor_column)
        found = []
        for kind, order in _KINDS.items():
            value = np.array(self.kept[kind][0])
            if not np.isfinite(value).all():
                raise MitsimError("the scene reflects NaN or infinite light toward the camera; check its materials")
            lit = np.flatnonzero(value)
            if not lit.size:
                continue
            source, tau_row, tau_column, near = (np.array(one)[lit] for one in self.kept[kind][1:])
            found.append(
                Deposits(
                    source=source.astype(np.int64),
                    anchor_row=row[lit].astype(np.int64),
                    anchor_column=column[lit].astype(np.int64),
                    row=tau_row.astype(np.float64),
                    column=tau_column.astype(np.float64),
                    inverse_depth=near.astype(np.float64),
                    value=value[lit].astype(np.float64),
                    order=np.full(lit.size, order, dtype=np.int16),
                )
            )
        return found

    # ---- state of the loop ------------------------------------------------------------------------------------------

    _STATE = (
        *("active", "ray", "strength", "bounce", "order", "left_at", "mirrored", "by_delta", "travelled", "rng"),
        *("near", "tau_row", "tau_column", "came_from", "came_pdf", "kept"),
    )

    def _values(self) -> tuple[Any, ...]:
        return tuple(getattr(self, name) for name in self._STATE)

    def _load(self, values: tuple[Any, ...]) -> None:
        for name, value in zip(self._STATE, values, strict=True):
            setattr(self, name, value)


def _edge(axis: Any, index: Any, jitter: Any) -> Any:
    start, size = dr.opaque(mi.Float, axis.start), dr.opaque(mi.Float, axis.size)
    return start + (mi.Float(index) + jitter) * size
