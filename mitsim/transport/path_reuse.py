"""Indirect light with shared second surfaces: neighbouring projector pixels light each other's second points.

Light of projector pixel i comes to x1_i, is turned there toward x2_i, and goes on. x1_i may see as well x2_k, which
pixel k of the same block of ``SIDE`` x ``SIDE`` pixels found. The balance heuristic over the block's N directions, each
drawn by its own BSDF, gives::

    L_i = sum_k  f_i(x2_k) V(x1_i, x2_k) / sum_j p_j(x2_k)  x  (light from x1_i that x2_k sends on)

f_i is the light that x1_i sends per area at x2_k, p_j the density per area of x1_j, 0 where x1_j sends nothing. The
estimate is unbiased (Veach and Guibas 1995; Bekaert, Sbert, Halton 2002, "Accelerating path tracing by re-using
paths"), and bounded near edges where f_i grows. Shifting dots never light neighbours together, so that common points
make no frame noisier.

A diffuse x2 also sends light of each x1_i along the path of pixel k, which leaves x2 on the side that x1_k lights; only
x1_i and x1_j that light the same side count. Mirrors at x1, wavelengths drawn for each path, and scenes with straight
transmission are not shared.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, reduce
from itertools import cycle
from operator import or_
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.transport import integrator
from mitsim.transport.connect import Way
from mitsim.transport.integrator import MEMBERS, SIDE, IndirectTracer, InFlight, ProjectorPaths, blocks_of, tilt
from mitsim.transport.plugins.base import Light, Surface, generator, sobol_point, split_by_line
from mitsim.transport.records import INDIRECT, DeviceAccumulator, PathSamples, Sightings, check_finite

ByLine: TypeAlias = "list[mi.Float]"
Store: TypeAlias = "Callable[[mi.UInt32, mi.UInt32, tuple[ByLine, ByLine], mi.Bool], None]"
Sender: TypeAlias = "Callable[[mi.Vector3f, mi.Bool], tuple[ByLine, mi.Float]]"
Turner: TypeAlias = "Callable[[mi.UInt32, mi.Bool], tuple[ByLine, ByLine]]"
_STEP, _TURN = 5, 16
"""Each sample begins five members on, and every sixteenth one more, which spreads points over the sequence."""
_PATHS_PER_LAUNCH = 2**20
_MOST_COMPARED = 32
_REFLECTANCE = re.compile(r"(brdf_\d\.)?reflectance\.")


class PathReuseTracer(IndirectTracer):
    paths_per_launch, in_blocks = _PATHS_PER_LAUNCH, True

    @property
    def paths_per_sample(self) -> int:
        return MEMBERS * (len(self.adaptive) if self.adaptive else blocks_of(self.projector.n) ** 2)

    def shares(self) -> bool:
        lines = mi.is_monochromatic or (mi.is_spectral and self.projector.lines is not None)
        several = self.points.count > 1 or not lines or mi.is_polarized
        return self.paths.interreflection and not several and not self.setup.passage.open

    @property
    def lines(self) -> int:
        lines = self.projector.lines
        return len(lines.shares) if lines is not None and mi.is_spectral else 1

    @cached_property
    def diffuse(self) -> frozenset[int]:
        bsdfs = [shape.bsdf() for shape in self.setup.scene.shapes()]
        plain = [bsdf is not None and bsdf.class_name() in ("SmoothDiffuse", "TwoSidedBRDF") for bsdf in bsdfs]
        names = [mi.traverse(bsdf).keys() if some else () for bsdf, some in zip(bsdfs, plain, strict=True)]
        return frozenset(at for at, some in enumerate(plain) if some and all(map(_REFLECTANCE.match, names[at])))

    @property
    def all_diffuse(self) -> bool:
        return len(self.diffuse) == len(self.setup.scene.shapes()) and not self.paths.steep

    def emission(self, flight: InFlight) -> tuple[Any, ...]:
        block, member, sample, weight = flight.index // MEMBERS, flight.index % MEMBERS, flight.sample, 1.0
        if self.adaptive:
            block, sample, weight = self.adaptive.at(block, sample)
        n, blocks = (dr.opaque(mi.UInt32, count) for count in (self.projector.n, blocks_of(self.projector.n)))
        row = (block // blocks) * SIDE + member // SIDE
        column = (block % blocks) * SIDE + member % SIDE
        inside = (row < n) & (column < n)
        pixel = dr.minimum(row, n - 1) * n + dr.minimum(column, n - 1)
        none, seed = dr.zeros(mi.UInt32, dr.width(flight.index)), flight.seed
        rng = generator(seed ^ (sample * 0x9E3779B9 + 1), pixel)
        place = (member + sample * _STEP + sample // _TURN) % MEMBERS
        first_turn = sobol_point(sample * MEMBERS + place, generator(seed, block))
        return pixel, (none, none), rng, first_turn, dr.select(inside, mi.Float(weight), 0)

    def _launch(self, flight: InFlight, accumulator: DeviceAccumulator | None = None) -> list[PathSamples]:
        kind = DiffuseReusedPaths if self.all_diffuse else ReusedPaths
        return kind(self, flight).path_samples(accumulator)


class ReusedPaths(ProjectorPaths):
    tracer: PathReuseTracer

    def __init__(self, tracer: PathReuseTracer, flight: InFlight) -> None:
        super().__init__(tracer, flight)
        self.tracer = tracer
        self.member = dr.arange(mi.UInt32, dr.width(self.pixel)) % MEMBERS

    def path_samples(self, accumulator: DeviceAccumulator | None = None) -> list[PathSamples]:
        own, count, way = self._own(), dr.width(self.lit) * MEMBERS, self.to_sensor_way
        if accumulator is not None:
            seen = Sightings(way.geometric, self.pixel, way.row, way.column, way.inverse_depth)
            places = [accumulator.place(each, self.paths.rng.next_float32()) for each in (seen, self.further)]
            dr.eval(places)

            def add(place: mi.UInt32, at: mi.UInt32, light: tuple[ByLine, ByLine], active: mi.Bool) -> None:
                for each, by_line in zip(places, light, strict=True):
                    accumulator.add(by_line, self.pixel, dr.gather(mi.UInt32, each, at, active), active)

            self._pair_light(*self._weights(), add)
            return own
        values = [[dr.zeros(mi.Float, count) for _ in range(self.tracer.lines)] for _ in range(2)]

        def store(place: mi.UInt32, at: mi.UInt32, light: tuple[ByLine, ByLine], active: mi.Bool) -> None:
            for kept, by_line in zip(values, light, strict=True):
                for each, value in zip(kept, by_line, strict=True):
                    dr.scatter(each, value, place, active)

        self._pair_light(*self._weights(), store)
        dr.eval(values)
        return [*own, self._pair_samples(values[0], way), self._pair_samples(values[1], self.further)]

    # ---- the paths themselves ---------------------------------------------------------------------------------------

    def _own(self) -> list[PathSamples]:
        self._first_vertex()
        self._second_vertex()
        self.paths = self.follow_on(self.paths)
        kept = self.paths.sightings["indirect"]
        place = kept.pixel, kept.row, kept.column, kept.inverse_depth
        self.further = Sightings(dr.select(self.follows, kept.value, 0), *place)
        # For unit light, whose mean over wavelengths is in the sightings.
        self.beyond = [self.further.value]
        if kept.lines is not None:
            unit = dr.select(self.follows, kept.lines * len(kept.lines), 0)
            self.beyond = [unit[line] for line in range(self.tracer.lines)]
        kept.value = dr.select(self.follows, 0, kept.value)
        dr.eval(vars(self))
        return self.connections.fetch(self.paths.sightings, tuple(self.paths.sightings))

    def _first_vertex(self) -> None:
        paths = self.paths
        self.first_ray, self.power = mi.Ray3f(paths.ray), split_by_line(self.flux, self.tracer.lines)
        self.first_hit = self.scene.ray_intersect_preliminary(paths.ray, True, active=paths.active)
        si = self.first_hit.compute_surface_interaction(paths.ray, active=paths.active)
        paths.active &= si.is_valid()
        self.lit = mi.Bool(paths.active)
        self.scatter(paths, si, True)

    def _second_vertex(self) -> None:
        paths = self.paths
        self.second_ray = mi.Ray3f(paths.ray)
        self.second_hit = self.scene.ray_intersect_preliminary(paths.ray, active=paths.active)
        si = self.second_hit.compute_surface_interaction(paths.ray, active=paths.active)
        paths.active &= si.is_valid()
        # Outside of a loop, ended paths are evaluated too, and a NaN throughput would outlast a light of 0.
        paths.throughput = dr.select(paths.active, paths.throughput, 0)
        self.shared = paths.active & (paths.scattered == 1)
        self.point, self.normal = mi.Point3f(si.p), mi.Normal3f(si.n)
        number = mi.UInt32(0)
        self.to_sensor_way = self.setup.way(si, self.connections.sensor(number), paths.active & ~paths.straight)
        own = replace(self.to_sensor_way, open=self.to_sensor_way.open & ~self.shared)
        drawn = {kind: paths.rng.next_float32() for kind in ("direct", "indirect")}
        self._keep_light(paths, si, own, drawn, (paths.sightings, number))
        # Shapes that are diffuse, or all but those that are not; no comparison where both are many.
        shapes, diffuse, found = self.scene.shapes(), self.tracer.diffuse, mi.Bool(False)
        few = min(diffuse, frozenset(range(len(shapes))) - diffuse, key=len)
        for place in few if len(few) <= _MOST_COMPARED else ():
            found |= si.shape == mi.ShapePtr(shapes[place])
        self.follows = self.shared & (found if few is diffuse or len(few) > _MOST_COMPARED else ~found)
        self.shading = mi.Normal3f(si.sh_frame.n)
        self.side = dr.sign(dr.dot(self.shading, -self.second_ray.d))
        paths.throughput = dr.select(self.follows, 1, paths.throughput)
        self.flux = dr.select(self.follows, 1, self.flux)
        self.scatter(paths, si, False)
        self.own_turn = self._turn_on(si, -self.second_ray.d, paths.ray.d, paths.active & self.follows)
        self.onward = mi.Vector3f(paths.ray.d)

    def _factors(self, spectrum: Light) -> ByLine:
        return [spectrum[line] for line in range(self.tracer.lines)]

    def _turn(self, si: Surface, toward: mi.Vector3f, onward: mi.Vector3f, active: mi.Bool) -> ByLine:
        si.wi = si.to_local(toward)
        context = mi.BSDFContext(mi.TransportMode.Importance)
        value = mi.unpolarized_spectrum(si.bsdf().eval(context, si, si.to_local(onward), active))
        value *= dr.abs(mi.Frame3f.cos_theta(si.wi) / dr.dot(si.n, toward))
        return self._factors(dr.select(active & dr.isfinite(value), value, 0))

    def _turn_on(self, si: Surface, toward: mi.Vector3f, onward: mi.Vector3f, active: mi.Bool) -> ByLine:
        kept = integrator.projector_part(si, tilt(si, toward) / tilt(si, onward)) if self.rules.steep else 1
        return [light * kept for light in self._turn(si, toward, onward, active)]

    def _weights(self) -> tuple[ByLine, mi.Float, mi.Float]:
        """Return the light from each pixel to each second point of its block, and the points' densities.

        The light (lanes * members,) is negative to the point's other side.
        """
        width = dr.width(self.lit)
        density = dr.zeros(mi.Float, width * MEMBERS)
        index, si = dr.arange(mi.UInt32, width), self._first_points()
        first = index - self.member

        send = self._sender(si)
        sent = [dr.zeros(mi.Float, width * MEMBERS) for _ in range(self.sends)]

        def pair(other: mi.UInt32) -> tuple[mi.UInt32]:
            known = self.point, self.normal, self.shading, self.side
            point, normal, shading, side = (dr.gather(type(each), each, first + other) for each in known)
            active = self.lit & dr.gather(mi.Bool, self.shared, first + other)
            offset = point - si.p
            squared = dr.squared_norm(offset)
            direction = offset * dr.rsqrt(squared)
            by_line, pdf = send(direction, active)
            to_area = dr.abs(dr.dot(normal, direction)) / squared
            values = [value * to_area for value in by_line]
            some = reduce(dr.maximum, values)
            active &= (some > 0) & (some < dr.inf) & (pdf > 0)
            another = active & (other != self.member)
            active &= ~self.scene.ray_test(si.spawn_ray_to(point), another) | ~another
            place, sign = index * MEMBERS + other, dr.select(dr.dot(shading, direction) * side < 0, mi.Float(1), -1)
            for each, value in zip(sent, values, strict=True):
                dr.scatter(each, value * sign, place, active)
            dr.scatter(density, pdf * to_area * sign, place, active)
            return (other + 1,)

        dr.while_loop((mi.UInt32(0),), lambda other: other < MEMBERS, pair)
        dr.eval(sent, density)
        # Gathered in one order: sums of floating-point numbers that are scattered hang on the threads.
        whole, same_side = mi.Float(0), mi.Float(0)
        for member in range(MEMBERS):
            each = dr.gather(mi.Float, density, (first + member) * MEMBERS + self.member)
            whole, same_side = whole + dr.abs(each), same_side + dr.maximum(each, 0)
        return sent, whole, same_side

    def _pair_light(self, sent: ByLine, whole: mi.Float, same_side: mi.Float, store: Store) -> None:
        index, si = dr.arange(mi.UInt32, dr.width(self.lit)), self._first_points()
        first = index - self.member
        dr.eval(whole, same_side)
        turn = self._turner(si)

        def pair(other: mi.UInt32) -> tuple[mi.UInt32]:
            place, at = index * MEMBERS + other, first + other
            given = [dr.gather(mi.Float, each, place) for each in sent]
            active = self.lit & reduce(or_, (each != 0 for each in given))
            connected, further = turn(at, active)
            all_ways, same_way = (1 / dr.gather(mi.Float, density, at) for density in (whole, same_side))
            light = [power * each for power, each in zip(self.power, cycle(given))]
            straight = [value * dr.abs(each) * all_ways for value, each in zip(connected, light, strict=True)]
            onward = [value * each * same_way for value, each in zip(further, light, strict=True)]
            store(place, at, (straight, [dr.select(each > 0, each, 0) for each in onward]), active)
            return (other + 1,)

        dr.while_loop((mi.UInt32(0),), lambda other: other < MEMBERS, pair)

    @property
    def sends(self) -> int:
        return self.tracer.lines

    def _sender(self, si: Surface) -> Sender:
        context, toward = mi.BSDFContext(mi.TransportMode.Importance), -self.first_ray.d

        def send(direction: mi.Vector3f, active: mi.Bool) -> tuple[ByLine, mi.Float]:
            local = si.to_local(direction)
            reflected, pdf = si.bsdf().eval_pdf(context, si, local, active)
            correction = dr.abs(integrator.shading_correction(si, local, direction, toward))
            correction *= integrator.matt_part(si) if self.rules.steep else 1
            return self._factors(mi.unpolarized_spectrum(reflected) * correction), pdf

        return send

    def _turner(self, si: Surface) -> Turner:
        def turn(at: mi.UInt32, active: mi.Bool) -> tuple[ByLine, ByLine]:
            met, ray = (dr.gather(type(each), each, at, active) for each in (self.second_hit, self.second_ray))
            second = met.compute_surface_interaction(ray, active=active)
            toward = dr.normalize(si.p - second.p)
            way = dr.gather(Way, self.to_sensor_way, at, active)
            reception = self.setup.received(second, toward, replace(way, open=way.open & active))
            part = 1 - integrator.camera_part(reception.pdf)
            if self.rules.steep:
                part *= integrator.projector_part(second, tilt(second, toward))
            connected = self._factors(reception.irradiance * part)
            beyond, turned = (
                [dr.gather(mi.Float, each, at, active) for each in lines] for lines in (self.beyond, self.own_turn)
            )
            handed = [active & (light > 0) & (own > 0) for light, own in zip(beyond, turned, strict=True)]
            onward = dr.gather(mi.Vector3f, self.onward, at, active)
            others = self._turn_on(second, toward, onward, reduce(or_, handed))
            further = [light * other / own for light, other, own in zip(beyond, others, turned, strict=True)]
            return connected, [dr.select(some, light, 0) for some, light in zip(handed, further, strict=True)]

        return turn

    def _first_points(self) -> Surface:
        return self.first_hit.compute_surface_interaction(self.first_ray, active=self.lit)

    def _pair_samples(self, values: ByLine, seen: Way | Sightings) -> PathSamples:
        by_line = np.array(values)
        light = by_line.sum(axis=0)
        check_finite(light)
        pairs = np.flatnonzero(light)
        lines = np.zeros((len(mi.Spectrum()), len(pairs)), np.float32)
        lines[: len(by_line)] = by_line[:, pairs]
        index, other = np.divmod(pairs, MEMBERS)
        at = index - index % MEMBERS + other
        none = np.zeros(len(pairs), np.int64)
        row, column, inverse = (np.array(part)[at] for part in (seen.row, seen.column, seen.inverse_depth))
        return PathSamples(
            pixel=np.array(self.pixel)[index].astype(np.int64),
            anchor_row=none,
            anchor_column=none,
            row=row.astype(np.float64),
            column=column.astype(np.float64),
            inverse_depth=inverse.astype(np.float64),
            value=light[pairs].astype(np.float64),
            kind=np.full(len(pairs), INDIRECT, dtype=np.int16),
            lines=lines if self.by_line else None,
            lane=index,
        )


class DiffuseReusedPaths(ReusedPaths):
    """Paths where all surfaces are diffuse, so that turns depend on two cosines and no material.

    A surface of shading normal s and geometric normal n turns light from w by rho / pi |s w| / |n w| on the side of s
    w.
    """

    sends = 1

    def _first_vertex(self) -> None:
        super()._first_vertex()
        si = self._first_points()
        self.facing = dr.sign(mi.Frame3f.cos_theta(si.wi))
        turned = self._turn(si, -self.first_ray.d, si.sh_frame.n * self.facing, self.lit)
        self.lit &= reduce(dr.maximum, turned) > 0
        self.power = [power * own for power, own in zip(self.power, turned, strict=True)]

    def _second_vertex(self) -> None:
        super()._second_vertex()
        second = self.second_hit.compute_surface_interaction(self.second_ray, active=self.shared)
        self.sensor_side = dr.sign(dr.dot(self.shading, self.to_sensor_way.direction))
        facing = self.shading * self.sensor_side
        way = replace(self.to_sensor_way, open=self.to_sensor_way.open & self.shared)
        reception = self.setup.received(second, facing, way)
        self.to_sensor = self._factors(reception.irradiance * dr.abs(dr.dot(self.normal, facing)))

    def _sender(self, si: Surface) -> Sender:
        def send(direction: mi.Vector3f, active: mi.Bool) -> tuple[ByLine, mi.Float]:
            cosine = dr.dot(si.sh_frame.n, direction) * self.facing
            value = dr.abs(dr.dot(si.n, direction))
            return [dr.select(active & (cosine > 0), value, 0)], cosine * dr.inv_pi

        return send

    def _turner(self, si: Surface) -> Turner:
        own = self._cosines(self.shading, self.normal, -self.second_ray.d)
        further = [dr.select(own > 0, light / own, 0) for light in self.beyond]
        dr.eval(further)

        def turn(at: mi.UInt32, active: mi.Bool) -> tuple[ByLine, ByLine]:
            known = self.point, self.normal, self.shading, self.sensor_side
            point, normal, shading, side = (dr.gather(type(each), each, at, active) for each in known)
            to_sensor, beyond = (
                [dr.gather(mi.Float, each, at, active) for each in lines] for lines in (self.to_sensor, further)
            )
            toward = dr.normalize(si.p - point)
            cosines = self._cosines(shading, normal, toward)
            seen = dr.select(dr.dot(shading, toward) * side > 0, cosines, 0)
            return [light * seen for light in to_sensor], [light * cosines for light in beyond]

        return turn

    @staticmethod
    def _cosines(shading: mi.Normal3f, normal: mi.Normal3f, toward: mi.Vector3f) -> mi.Float:
        return dr.abs(dr.dot(shading, toward)) / dr.abs(dr.dot(normal, toward))
