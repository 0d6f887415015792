"""Light followed from the camera's side: of lamps, in mirrors, and over sharp turns before the sensor.

A path starts at the sensor, goes through a cell of directions, and connects to the lights at its vertices. Mask and
sensor pixels are applied afterwards in closed form (:mod:`mitsim.optics`). For tan-angle t a path collects::

    g(t) dt = L(t) (1 + |t|^2)^-2 r(t) dt          [W m^-2]        r: the pixel's angular response

Of the projector's light the camera's side finds that whose last surface before the sensor is a mirror, and the part of
indirect light over sharp turns (:func:`mitsim.transport.integrator.camera_part`). Light is accumulated under the
direction and depth of the first vertex that is no mirror, or of its image in plane mirrors.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.colour_files import MOST_LINES
from mitsim.core.environment import device_array
from mitsim.devices.projector import SPECTRA_NM, Band, Response
from mitsim.transport import integrator
from mitsim.transport.connect import OpticalSetup, ProjectorConnector, SensorPoints, sample_wavelengths
from mitsim.transport.plugins.base import Light, Surface, rows_columns, shuffle, sobol_point, streams, x_y
from mitsim.transport.records import CellGrid, DeviceAccumulator, PathSamples, Sightings
from mitsim.transport.transmission import refracted_way

_SELDOM = 0.125
"""Chance to continue a path whose last turn belongs to the projector's side (0.02 % of indirect light remains)."""
_MARGIN = 1e-4


class FromCameraTracer(integrator.Tracer):
    of_projector: ClassVar[bool] = True

    def __init__(
        self, setup: OpticalSetup, grid: CellGrid, paths: integrator.Paths, points: SensorPoints | None = None
    ) -> None:
        super().__init__(setup, paths, points)
        self.grid, self.connector = grid, ProjectorConnector(setup.projector)

    @property
    def paths_per_sample(self) -> int:
        return self.grid.shape[0] * self.grid.shape[1] * self.points.count

    def wavelengths(self, rng: mi.PCG32, sample: mi.UInt32, shared: mi.PCG32) -> tuple[mi.Color0f, mi.Spectrum]:
        return sample_wavelengths(self.setup.camera, rng, self.projector.lines)

    def _launch(self, flight: integrator.InFlight, accumulator: DeviceAccumulator | None = None) -> list[PathSamples]:
        return CameraPaths(self, flight).path_samples()


@dataclass(kw_only=True)
class CameraState(integrator.PathState):
    """Paths from the camera under way.

    ``inverse_depth`` is 1/z of the point at which their light is seen [1/mm]. ``part`` of the light over the turn
    before the sensor is found here; ``kept`` and ``turned`` are the projector's parts over the turns since the last
    mirror, and the last. ``since`` is the length of the way since the last turn [mm], ``came_pdf`` its density [1/sr].
    """

    inverse_depth: mi.Float = field(default_factory=lambda: mi.Float(0))
    part: mi.Float = field(default_factory=lambda: mi.Float(1))
    kept: mi.Float = field(default_factory=lambda: mi.Float(1))
    turned: mi.Float = field(default_factory=lambda: mi.Float(1))
    in_mirror: mi.Bool = field(default_factory=lambda: mi.Bool(False))
    travelled: mi.Float = field(default_factory=lambda: mi.Float(0))
    since: mi.Float = field(default_factory=lambda: mi.Float(0))
    behind_glass: mi.Bool = field(default_factory=lambda: mi.Bool(False))
    came_from: mi.Point3f = field(default_factory=lambda: dr.zeros(mi.Point3f))
    came_pdf: mi.Float = field(default_factory=lambda: mi.Float(0))
    by_delta: mi.Bool = field(default_factory=lambda: mi.Bool(True))


State = TypeVar("State", bound=CameraState)


class CameraPaths(integrator.PathIntegrator[State]):
    IMPORTANCE = False
    STATE: ClassVar[Any] = CameraState

    def __init__(self, tracer: FromCameraTracer, flight: integrator.InFlight) -> None:
        super().__init__(tracer)
        cell, row, column = tracer.points.of(flight.index, tracer.grid.shape[0] * tracer.grid.shape[1])
        self.anchor = row, column
        self.tracer, self.geometry, self.connector = tracer, tracer.setup.geometry, tracer.connector
        self.emitters, self.lens = tracer.paths.emitters, tracer.projector.aperture > 0

        # ---- Rays from the sensor through the cells
        grid, columns = tracer.grid, dr.opaque(mi.UInt32, tracer.grid.shape[1])
        shared, rng = streams(flight.seed, cell, flight.sample)
        # A path that leaves a cell's very edge could be accumulated in the next cell by rounding.
        jitter = _MARGIN + (1 - 2 * _MARGIN) * sobol_point(flight.sample, shared)
        sensor = tracer.points.at(*self.anchor, rng)
        self.origin, nearness = rows_columns(sensor.x, sensor.y), dr.opaque(mi.Float, 1 / tracer.points.distance)
        places = (grid.rows, cell // columns, jitter.x), (grid.columns, cell % columns, jitter.y)
        self.row, self.column = (
            dr.opaque(mi.Float, axis.start) + (mi.Float(index) + part) * dr.opaque(mi.Float, axis.size) - at * nearness
            for (axis, index, part), at in zip(places, self.origin, strict=True)
        )
        squared = 1 + dr.square(self.row) + dr.square(self.column)
        self.slope = dr.rsqrt(squared)
        wavelengths, spectral = tracer.wavelengths(rng, flight.sample, shared)
        to_world = tracer.setup.camera.world_transform()
        direction = mi.Vector3f(*x_y(self.row, self.column), 1) * self.slope
        ray = mi.Ray3f(to_world @ sensor, to_world @ direction, 0.0, wavelengths)
        stop = dr.opaque(mi.Float, self.geometry.tan_half_fov)
        active = (dr.abs(self.row) <= stop) & (dr.abs(self.column) <= stop)

        # ---- Their weight: dt of a cell times (1 + t^2)^-2, and a pixel's response cos^n
        solid = dr.opaque(mi.Float, grid.rows.size * grid.columns.size) / dr.square(squared)
        if self.geometry.angular_exponent > 0:
            solid *= dr.power(squared, -0.5 * dr.opaque(mi.Float, self.geometry.angular_exponent))
        self.weight = spectral * solid
        sightings = {kind: Sightings.none(tracer.by_line) for kind in integrator.KINDS}
        self.paths = self.STATE(active=active, ray=ray, rng=rng, sightings=sightings)

    def path_samples(self) -> list[PathSamples]:
        kept = self.follow(self.paths).sightings
        dr.eval(kept, self.anchor)
        return [PathSamples.fetch(seen, integrator.KINDS[kind], self.anchor) for kind, seen in kept.items()]

    # ---- lights that paths run into ---------------------------------------------------------------------------------

    def _run_into(self, paths: State, si: Surface, first: bool) -> None:
        if first or self.rules.mirrors or self.passage.open:
            # Where the camera sees this vertex, unless an earlier one that is no mirror has settled it.
            depth = dr.rcp((paths.travelled + si.t) * self.slope)
            paths.inverse_depth = dr.select(paths.scattered == 0, depth, paths.inverse_depth)
        if first:
            paths.active &= paths.inverse_depth < 1 / dr.opaque(mi.Float, self.geometry.mask_distance)
        elif self.tracer.of_projector and self.lens:
            self._hit_lens(paths, si)
        if self.emitters:
            emitter = si.emitter(self.scene, paths.active)
            before = dr.zeros(mi.Interaction3f)
            before.p = paths.came_from
            lamp = paths.active & (emitter != None)  # noqa: E711 - a Dr.Jit comparison, lane by lane
            ds = mi.DirectionSample3f(self.scene, si, before)
            unconnected = paths.by_delta | paths.behind_glass
            pdf = emitter.pdf_direction(before, ds, lamp & ~unconnected)
            share = dr.select(unconnected, 1, _share(paths.came_pdf, pdf))
            light = self._irradiance(paths, emitter.eval(si, lamp)) * share
            self._keep(paths, "ambient", lamp, light, self._lamps)

    def _hit_lens(self, paths: State, si: Surface) -> None:
        """Keep light of the projector's lens.

        Light over mirrors alone belongs to the beams (:mod:`mitsim.transport.specular`); light over one other surface,
        unless seen in a mirror, to the projector's side.
        """
        foreign = paths.active & (paths.scattered > dr.select(paths.in_mirror, mi.UInt32(0), mi.UInt32(1)))
        hit = self.connector.hit(paths.ray, si.t, paths.rng, foreign, paths.since)
        share = dr.select(paths.by_delta, 1, _share(paths.came_pdf, hit.pdf))
        light = self._irradiance(paths, hit.radiance) * share * self._part(paths, paths.kept)
        self._keep_projector(paths, hit.met, light, hit.pixel, paths.scattered)

    # ---- connections ------------------------------------------------------------------------------------------------

    def _connect(self, paths: State, si: Surface, first: bool) -> None:
        bsdf, passage = si.bsdf(), self.passage

        # ---- To the projector; a vertex that is seen straight is the projector's side's
        if not first and self.tracer.of_projector:
            active = paths.active & ~paths.straight
            if passage.panes:
                lens = self.connector.lens_point(paths.rng)
                way = refracted_way(passage, si, self.connector.projector.emitter.world_transform() @ lens, active)
                connection = self.connector.connect(_seen_at(si, way.apparent), paths.rng, active & way.open, lens)
                # The way's length is counted, as for a path that runs into the lens.
                connection.pdf *= dr.square(way.length) / dr.squared_norm(connection.target - way.apparent)
                connection.direction, passed = way.direction, way.part / dr.square(way.eta)
            else:
                connection = self.connector.connect(si, paths.rng, active)
                seen, passed = passage.between(si, connection.target, connection.valid)
                connection.valid = connection.valid & seen
            active, toward = connection.valid, si.to_local(connection.direction)
            if self.lens and self.rules.interreflection:
                value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, toward, active)
                value *= _share(connection.pdf, pdf)
            else:
                value = bsdf.eval(mi.BSDFContext(), si, toward, active)
            light = self._irradiance(paths, value * connection.weight * passed)
            kept = paths.kept * paths.turned * (integrator.matt_part(si) if self.rules.steep else 1)
            light *= self._part(paths, kept)
            self._keep_projector(paths, active, light, connection.pixel, paths.scattered + 1)

        # ---- To lamps
        for emitter in self.emitters:
            point = mi.Point2f(paths.rng.next_float32(), paths.rng.next_float32())
            ds, light = emitter.sample_direction(si, point, paths.active)
            active, direction = paths.active & (ds.pdf > 0), ds.d
            if passage.panes and mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaPosition):
                # No path runs into such a lamp behind glass, but there is one way to it.
                way = refracted_way(passage, si, ds.p, active)
                ds, light = emitter.sample_direction(_seen_at(si, way.apparent), point, active & way.open)
                seen, passed, direction = way.open, way.part / dr.square(way.eta), way.direction
            else:
                seen, passed = passage.between(si, ds.p, active)
            active &= seen
            value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(direction), active)
            # A path that does not go on cannot run into the lamp, so connecting is the only way to find it.
            share = dr.select(ds.delta, 1, _share(ds.pdf, pdf)) if self.rules.interreflection else 1
            self._keep(paths, "ambient", active, self._irradiance(paths, value * light * passed) * share, self._lamps)

    # ---- turns ------------------------------------------------------------------------------------------------------

    def _note_turn(self, paths: State, si: Surface, turn: integrator.Turn, first: bool) -> mi.Bool:
        passing, pdf, going = turn.passing, turn.sample.pdf, mi.Bool(True)
        before_sensor = paths.straight & ~passing
        if first or self.passage.open:
            paths.in_mirror = dr.select(before_sensor, turn.delta, paths.in_mirror)
            paths.part = dr.select(before_sensor, dr.select(turn.delta, 1, integrator.camera_part(pdf)), paths.part)
            if not self.emitters:
                going = paths.part > 0
        if self.rules.steep:
            leaving = dr.select(before_sensor, 1, integrator.tilt(si, -paths.ray.d))
            turned = integrator.projector_part(si, integrator.tilt(si, si.to_world(turn.sample.wo)) / leaving)
            kept = paths.kept * paths.turned * integrator.matt_part(si)
            paths.kept = dr.select(turn.delta, 1, dr.select(passing, paths.kept, kept))
            paths.turned = dr.select(turn.delta, 1, dr.select(passing, paths.turned, turned))
            # Light that only later turns may leave to this side is little: few paths go on for it.
            idle = ~going & (turned == 1)
            going = ~idle | (paths.rng.next_float32() < _SELDOM)
            paths.throughput *= dr.select(idle, 1 / _SELDOM, 1)
        paths.travelled += si.t
        paths.since = dr.select(passing, paths.since + si.t, 0)
        paths.behind_glass = passing & (paths.behind_glass | integrator.is_delta(turn.sample))
        paths.came_from = dr.select(passing, paths.came_from, si.p)
        paths.came_pdf = dr.select(passing, paths.came_pdf, pdf)
        paths.by_delta = dr.select(passing, paths.by_delta, turn.delta)
        return going

    # ---- light that is kept -----------------------------------------------------------------------------------------

    def _irradiance(self, paths: State, radiance: mi.Spectrum) -> Light:
        return mi.unpolarized_spectrum(radiance) * paths.throughput * self.weight

    @property
    def _lamps(self) -> mi.UInt32:
        return dr.opaque(mi.UInt32, self.tracer.projector.n**2)

    def _keep_projector(self, paths: State, active: mi.Bool, light: Light, pixel: mi.UInt32, order: mi.UInt32) -> None:
        self._keep(paths, "direct", active & (order == 1), light, pixel)
        if self.rules.interreflection:
            self._keep(paths, "indirect", active & (order > 1), light, pixel)

    def _part(self, paths: State, kept: mi.Float) -> mi.Float:
        return 1 - (1 - paths.part) * kept if self.rules.steep else paths.part

    def _keep(self, paths: State, kind: str, active: mi.Bool, light: Light, pixel: mi.UInt32) -> None:
        # Accumulated as the sensor's centre sees it.
        row, column = (t + s * paths.inverse_depth for t, s in zip((self.row, self.column), self.origin, strict=True))
        seen = Sightings.of(dr.select(active, light, 0), self.by_line, pixel, row, column, paths.inverse_depth)
        self._join(paths, kind, seen)

    def _join(self, paths: State, kind: str, seen: Sightings) -> None:
        paths.sightings[kind] = paths.sightings[kind].joined_by(seen, paths.rng.next_float32())


def _share(own: mi.Float, rival: mi.Float) -> mi.Float:
    return dr.select(own > 0, own / (own + rival), 1)


def _seen_at(si: Surface, point: mi.Point3f) -> Surface:
    apparent = mi.SurfaceInteraction3f(si)
    apparent.p = point
    return apparent


# -------- Lamps' light by their own spectra
#
# A path carries four wavelengths, one of each band, all at the same place in theirs. Places of a cell's paths follow a
# scrambled Sobol sequence, so that their mean is the integral over all wavelengths, unbiased for every spectrum:
#
#     sum over bands of L(lambda_b) counts(lambda_b) width_b / 470 nm
#
# A spectrum that is 1 everywhere is 1 W m^-2 (sr^-1) over the 470 nm from 360 to 830 nm, so L / 470 nm is spectral.


class LampTracer(FromCameraTracer):
    """Tracer of lamps, with a ``response`` of the camera in one band for each wavelength; ``units`` are in W m^-2."""

    of_projector = False
    by_line = True

    def __init__(
        self, like: FromCameraTracer, response: Response, bands: Sequence[Band], units: Sequence[float], first: int = 0
    ) -> None:
        super().__init__(like.setup, like.grid, like.paths, like.points)
        self._response, self._bands, self._units, self._first = response, bands, units, first
        self._alone: mi.UInt32 | None = None

    @property
    def per_wavelength(self) -> Sequence[LampTracer]:
        if not self.projector.parted:
            return [self]
        tracers = []
        for band, (first, last) in enumerate(self._bands):
            if last > first:
                tracers.append(copy(self))
                tracers[-1]._alone = dr.opaque(mi.UInt32, band)
        return tracers

    def wavelengths(self, rng: mi.PCG32, sample: mi.UInt32, shared: mi.PCG32) -> tuple[mi.Color0f, Light]:
        place = sobol_point(shuffle(sample, shared), shared).x
        counts = device_array(mi.Float, self._response.counts)
        steps = len(self._response.counts) - 1
        step = (SPECTRA_NM[1] - SPECTRA_NM[0]) / steps
        wavelengths, weights = [], []
        for first, last in self._bands:
            width = dr.opaque(mi.Float, last - first)
            wavelength = dr.opaque(mi.Float, first) + place * width
            position = (wavelength - SPECTRA_NM[0]) / step
            below = dr.minimum(mi.UInt32(dr.maximum(position, 0)), steps - 1)
            low, high = dr.gather(mi.Float, counts, below), dr.gather(mi.Float, counts, below + 1)
            count = low + (high - low) * (position - mi.Float(below))
            wavelengths.append(wavelength)
            weights.append(MOST_LINES * count * width / (SPECTRA_NM[1] - SPECTRA_NM[0]))
        if self._alone is not None:
            chosen = [self._alone == band for band in range(len(weights))]
            weights = [dr.select(here, weight, 0) for here, weight in zip(chosen, weights, strict=True)]
            own = [dr.select(here, wavelength, 0) for here, wavelength in zip(chosen, wavelengths, strict=True)]
            wavelengths = [sum(own, mi.Float(0))] * len(own)
        return type(dr.zeros(mi.Ray3f).wavelengths)(*wavelengths), mi.Spectrum(*weights)

    def _launch(self, flight: integrator.InFlight, accumulator: DeviceAccumulator | None = None) -> list[PathSamples]:
        traced = []
        for found in super()._launch(flight):
            assert found.lines is not None and found.lane is not None, "told apart by band"
            light = found.lines.T.ravel().astype(np.float64)
            alike = ("anchor_row", "anchor_column", "row", "column", "inverse_depth", "kind", "lane")
            several = PathSamples(
                **{name: np.repeat(getattr(found, name), MOST_LINES) for name in alike},
                pixel=(found.pixel[:, None] + self._first + np.arange(MOST_LINES)).ravel(),
                value=light * self._units[0],
            )
            if self.projector.by_line:
                units = np.zeros(MOST_LINES)
                units[: len(self._units)] = self._units
                several = replace(several, lines=(units[:, None] * light).astype(np.float32))
            traced.append(several)
        return traced


class CombinedTracer:
    def __init__(self, *tracers: integrator.Tracer) -> None:
        self.tracers = tracers

    @property
    def paths_per_sample(self) -> int:
        return sum(tracer.paths_per_sample for tracer in self.tracers)

    def trace(self, seed: int, first: int = 0, samples: int = 1) -> PathSamples:
        return PathSamples.join([tracer.trace(seed, first, samples) for tracer in self.tracers])

    def replicates(self, seeds: Sequence[int], *samples: int, first: int = 0) -> list[list[PathSamples]]:
        traced = [tracer.replicates(seeds, *samples, first=first) for tracer in self.tracers]
        return [list(map(PathSamples.join, zip(*by_number, strict=True))) for by_number in zip(*traced, strict=True)]
