"""Short runs of a scene that measure the quantities of a plan.

Every error is relative, ``||a - b|| / ||b||``, over a few shots of the family.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property

import numpy as np

from mitsim.bench import effects
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import EFFECTS
from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import integer
from mitsim.devices.patterns import Lighting
from mitsim.light.cost_model import Numbers, forming_seconds
from mitsim.light.passes import PASSES, Simulation
from mitsim.light.settings import (
    REPLICATES,
    Approximation,
    ErrorCovariance,
    Forming,
    PilotResult,
    Settings,
    SharpPixels,
)
from mitsim.planner.pilot_direct import FINER, GOOD_ENOUGH, SHARP_RATE, DirectRuns, Sample
from mitsim.planner.pilot_effects import AnchorRuns, EffectRuns, FollowedRuns, PenumbraRuns
from mitsim.scene.load import why_dark
from mitsim.transport.direct import DirectTracer
from mitsim.transport.missed import LeftOut, SharpLight, highlights, left_out_light, sharp_light, with_neighbours

RUNS = ("cells", "effects", "anchors", "followed", "occluded")
"""Runs: cells and layers of direct light, effects, anchors, anchors of followed light, and of occluded pixels."""
_RUN_OF = {
    "layers": "cells",
    "cells": "cells",
    "followed_width": "followed",
    **{row.anchors: row.pilot for row in PASSES.values() if row.anchors},
}
"""Run that measures the error of each number."""
_ROUGH = 0.5
"""Part of the accuracy that a few anchors may leave before occluded pixels are searched."""
_OF_FOLLOWED = 0.5
"""Part of the accuracy at which more anchors of followed light are no longer tried."""
_FRAMES_AS_MANY = 20.0
_OF_EFFECTS = 3
_OVER_WORK, _LESS_S = 4.2, 0.6
"""Ratio and offset [s] of a pilot's time to the work of its samples."""
_LOBE_RAYS = 2**22
"""Rays that search for sharp lobes, 0.5 s."""
_CAUSTIC_PATHS = 2**20
_FEWEST_HITS = 30.0
_FEWEST_MET = 3.0
"""Hits of the projector's lens below which the pilot may see none (one time in twenty)."""
_FAINT = 1e-3
_MOST_RAYS = 2**26
_MORE = 4
_LOOSELY = 0.3
"""Part of the light of highlights that the search for lobes may miss."""
_FEWEST_IN_RUN = 8.0
_ALIGNED = 1e-6


# ---- Runs of the pilot, each repeated with more samples ----


class PilotRuns:
    """Runs of the pilot at a scene, each of which can be repeated with more samples.

    Finer numbers are tried until they keep ``accuracy``. ``lines`` share the paths; the bench has one of them.
    """

    def __init__(self, bench: Apparatus, lighting: Lighting, accuracy: float, seed: int, lines: int = 1) -> None:
        self.bench, self.lighting, self.accuracy, self.seed, self._lines = bench, lighting, accuracy, seed, lines
        self.present = effects.present(bench)
        first_pilot_run = frozenset(self.present) & effects.names(lambda effect: effect.first_pilot_run)
        first = Simulation(bench, Settings(depth=bench.geometry.scene_distance, effects=first_pilot_run))
        pixels, own = bench.n**2, integer(seed, "pilot", "lobes")
        self._sharp = SharpLight.none(pixels)
        if bench.loaded.glossy:
            self._sharp = sharp_light(first.setup, own, max(1, _LOBE_RAYS // pixels))
        depth, centre, hits = _first_light(first, seed, self._sharp)
        # A connection that meets a sharp lobe by chance may be all that the centre sees.
        self._light = self._sharp.rest if self._sharp.irradiance else centre
        self._seen = seen = Simulation(bench, Settings(depth=depth, effects=first_pilot_run))
        reach = light_reach(seen, integer(seed, "pilot", "reach"))
        own = integer(seed, "pilot", "sharp")
        apart = sharp_pixels(seen, self._sharp, self._light, accuracy, own)
        self._base = Settings(depth=depth, effects=first_pilot_run, reach=reach, sharp=apart)
        sample, self._hits = Sample.of(lighting, bench.geometry.frame_shape, bench.loaded.mirrors), math.inf
        if not bench.loaded.mirrors and not self._sharp.irradiance:
            self._hits = hits if hits < _FEWEST_HITS else math.inf
            # Enough rays for a small target.
            times = math.ceil(_FEWEST_IN_RUN / (hits * sample.direct)) if hits else 1
            sample = replace(sample, times=times * sample.times)
            if times > 1 and hits * sample.direct < _FEWEST_IN_RUN:
                n, side = bench.n, math.sqrt(hits)
                raise MitsimError(
                    "the lit surfaces in the camera's view are too small for the projector: together they fill "
                    f"{hits:.1e} of one of {n} x {n} projector pixels ({side:.1e} a side); give the projector a "
                    "narrower fov, or a larger target"
                )
        self.samples = dict.fromkeys(RUNS, sample)
        self.occluded: PenumbraRuns | None = None
        for run in RUNS:
            self._measure(run)
        few = ErrorCovariance.between(self.anchored.until(math.inf), self.switched.light**2)
        if few.estimate([Approximation("anchors", SMOOTH)]).bound <= _ROUGH * accuracy:
            return
        occluded = occluded_pixels(Simulation(bench, self._base), accuracy, integer(seed, "pilot", "occluded"))
        shown = np.isin(sample.shown, occluded)
        # The anchors that each kind needs are unknown unless the sample's shots show some of both kinds.
        if shown.any() and not shown.all():
            self._base = replace(self._base, occluded=occluded)
            known = self.anchored
            for run in ("anchors", "occluded"):
                self._measure(run)
            self.anchored.take_over(known.traced)

    # ---- More samples: their work, and where they are called for ----

    def refine(self, run: str) -> None:
        self.samples[run] = self.samples[run].finer
        self._measure(run)
        vars(self).pop("pilot_result", None)

    def work(self, run: str) -> float:
        now, finer = self.samples[run], self.samples[run].finer
        if (finer.fine, finer.direct) == (now.fine, now.direct):
            return math.inf
        costs = {name: row.unit_cost for name, row in PASSES.items()}
        followed = {name: cost.paths for name, cost in self.switched.sample_costs.items() if name != "sharp"}
        one = forming_seconds(self.forming, Numbers(*[1.0] * 6), _FRAMES_AS_MANY)
        if run == "cells":
            paths, changes = costs["direct"] * len(finer.shown) * finer.fine, len(self.fine.changes)
        elif run == "anchors":
            paths = costs["anchor_residual"] * len(finer.shown) * finer.anchored * self.anchored.connections
            changes = len(self.anchored.changes)
        elif run == "followed":
            paths = costs["indirect_residual"] * sum(followed.values()) * finer.followed * self.followed.connections
            changes = len(self.followed.changes) + 2  # Finer cells, and layers, judge wide cells.
        elif run == "occluded":
            count = len(self.occluded.pixels) if self.occluded else 0
            if self.occluded is None or finer.samples_of_occluded(count) == now.samples_of_occluded(count):
                return math.inf
            paths = costs["penumbra"] * FINER * self.occluded.paths / REPLICATES * self.occluded.connections
            changes = len(self.occluded.changes)
        else:
            indirect = sum(costs[name] * paths_per_sample for name, paths_per_sample in followed.items())
            paths = costs["direct"] * self.bench.n**2 * finer.direct + indirect * finer.followed
            changes = _OF_EFFECTS * len(self.present)
        return REPLICATES * paths + changes * float(one)

    @property
    def seconds(self) -> float:
        repeats = [work / FINER for work in map(self.work, RUNS) if math.isfinite(work)]
        return max(_OVER_WORK * sum(repeats) - _LESS_S, 0.0)

    # ---- Measured quantities, and the frames for them ----

    def _measure(self, run: str) -> None:
        bench, base, sample, seed = self.bench, self._base, self.samples[run], self.seed
        if run == "cells":
            self.fine = DirectRuns(bench, base, sample, self.accuracy, seed)
        elif run == "effects":
            judged = self.fine.judging, self.accuracy, lambda: self.fine.coarse
            self.switched = EffectRuns(bench, self._everything, sample, seed, *judged)
            if not self.switched.light:
                feature = bench.geometry.build_mask().feature_mm
                raise MitsimError(
                    "no light of the projector passes the mask: the part of the mask between scene and sensor is "
                    f"closed; use a mask that is open there (its features are {feature:g} mm wide)"
                )
        elif run == "followed":
            tolerance, lit = self._tolerance(_OF_FOLLOWED), self.switched.received > 0
            others = sample, tolerance, seed, self.fine.judging, lit
            self.followed = FollowedRuns(bench, self._everything, *others)
            self.followed.coarse = self._over_tolerance(self.switched.coarse)
        elif run == "occluded":
            if base.occluded:
                self.occluded = PenumbraRuns(bench, base, sample, self._tolerance(), seed, self.fine.judging)
        else:
            self.anchored = AnchorRuns(bench, base, sample, self._tolerance(), seed, self.fine.judging)
            if sample.anchored == self.samples["cells"].anchored:
                self.anchored.take_over({1: self.fine.first})
            self.anchored.coarse = self._over_tolerance(self.fine.coarse)

    def _tolerance(self, part: float = GOOD_ENOUGH) -> float:
        return part * self.accuracy * self.switched.light

    def _over_tolerance(self, parts: tuple[float, float]) -> tuple[float, float]:
        return parts[0] / self._tolerance(), parts[1] / self._tolerance()

    @property
    def _everything(self) -> Settings:
        return replace(self._base, effects=frozenset(self.present), subdivision=2)

    @cached_property
    def forming(self) -> Forming:
        return self.fine.forming(self.lighting)

    @cached_property
    def pilot_result(self) -> PilotResult:
        fine, switched, anchored = self.fine, self.switched, self.anchored
        seen = {**anchored.changes, **fine.changes, **switched.changes, **self.followed.changes}
        if self.occluded:
            seen |= self.occluded.changes
        light, sharp, apart = switched.light, self._sharp, self._base.sharp
        rows, columns = (np.unique(each).size / self.bench.n for each in np.divmod(self._base.occluded, self.bench.n))
        samples = self.samples["effects"].followed * REPLICATES
        indirect, shared, repeats = switched.indirect_cost
        sample_costs = {
            **switched.sample_costs,
            **self.followed.sample_costs(light),
            **anchored.sample_costs(light),
            **(self.occluded.sample_costs(light) if self.occluded else {}),
            "direct": fine.sample_cost(light),
            "indirect": indirect,
        }
        missed, simulation = LeftOut.none(), switched.simulation
        if self.bench.loaded.mirrors:
            each = max(1, _CAUSTIC_PATHS // (simulation.aim.shape[0] * simulation.aim.shape[1]))
            missed = left_out_light(simulation.setup, simulation.aim, integer(self.seed, "pilot", "caustics"), each)
        left_out, _ = missed.unseen(_FEWEST_HITS / samples, _FEWEST_MET / samples)
        # Light over mirrors alone, and the part that is in no frame or may be in the wrong pixels.
        mirrors = self.bench.loaded.mirrors
        alone, unsure = self.bench.specular.irradiance(self.bench.geometry) if mirrors else (0.0, 0.0)
        found = self._light + sharp.irradiance + switched.received + alone
        few = not apart and sharp.hits * self.samples["cells"].fine * REPLICATES < _FEWEST_HITS
        # Highlights that neither the search for lobes nor ordinary rays meet.
        unmet, spots = 0.0, highlights(self._seen.setup) if self.bench.loaded.glossy else None
        if spots is not None and len((spots := spots.unmet(self.samples["cells"].fine * REPLICATES)).pixels):
            near = with_neighbours(np.isin(np.arange(self.bench.n**2), spots.pixels), self.bench.n)
            missing = float(spots.irradiance.sum() - sharp.by_pixel[near].sum())
            unmet = missing if missing > _LOOSELY * float(spots.irradiance.sum()) else 0.0
        unresolved = unmet + (sharp.irradiance if few else 0.0)
        return PilotResult(
            depth=self._base.depth,
            layers=fine.layers,
            changes=ErrorCovariance.between(seen, light**2),
            sample_costs=sample_costs,
            spread=fine.sample_cost(light, spread=True),
            shared=shared,
            repeats=repeats,
            forming=replace(self.forming, lines=self._lines, occluded=(rows, columns)),
            apart={name: simulation.physics.speckle for name in self.present if not EFFECTS[name].in_frames},
            unresolved=unresolved / (self._light + sharp.irradiance + unmet) if unresolved else 0.0,
            left_out=left_out / (left_out + found) if left_out else 0.0,
            unresolved_specular=unsure / (found + unsure) if unsure else 0.0,
            reach=self._base.reach,
            sharp=apart,
            occluded=self._base.occluded,
            raster=fine.raster,
            hits=self._hits,
        )


def run_of(part: Approximation) -> str:
    light, _, _ = part.name.rpartition(" ")
    if light:
        return PASSES[light].pilot if PASSES[light].anchors else "effects"
    return _RUN_OF.get(part.name, "effects")


# ---- Where light is first seen, and how many rays bring it ----


def _first_light(simulation: Simulation, seed: int, sharp: SharpLight) -> tuple[float, float, float]:
    """Return the depth of the light, 1 / mean(1/z) [mm], its irradiance, and its hits per ray of a pixel."""
    bench, own = simulation.bench, integer(seed, "pilot", "depth")
    enough = min(_FEWEST_HITS, simulation.bench.n**2 / 4)
    first, samples = 0, 1
    path_samples = simulation.direct.trace(own)
    while _equal(path_samples.value) < enough and not bench.loaded.mirrors and not sharp.irradiance:
        if _MORE * (first + samples) * bench.n**2 > _MOST_RAYS:
            break
        first, samples = first + samples, (_MORE - 1) * (first + samples)
        path_samples = simulation.direct.trace(own, first, samples)
    total = float(path_samples.value.sum()) / samples
    if not bench.loaded.mirrors and not sharp.irradiance:
        everywhere = Simulation(bench, replace(simulation.settings, anchors=2)).direct.trace(own, first, samples)
        if total < _FAINT * float(everywhere.value.sum()) / samples:
            raise MitsimError(
                "the sensor's centre sees no light of the projector, though other parts of the sensor do: "
                + why_dark(bench.loaded)
            )
    if not total and not bench.loaded.mirrors:
        raise MitsimError(f"no light of the projector reaches the camera: {why_dark(bench.loaded)}")
    # Sums by numpy, here and elsewhere: those of BLAS depend on the number of its threads in the last bits.
    mean = float((path_samples.inverse_depth * path_samples.value).sum()) / (samples * total) if total else 0.0
    # A plane is met at its own depth but for rounding; the aligned plane keeps its exact cells.
    flat = abs(mean * bench.geometry.scene_distance - 1) < _ALIGNED
    depth = bench.geometry.scene_distance if flat or mean <= 0 else 1 / mean
    return depth, total, _equal(path_samples.value) / samples


def _equal(values: FloatArray) -> float:
    squares = float(np.square(values, dtype=np.float64).sum())
    return float(values.sum(dtype=np.float64)) ** 2 / squares if squares else 0.0


# ---- How far from the axis light comes ----

_CONNECTIONS = 2**16
_FLAT = 1e-4


def light_reach(simulation: Simulation, seed: int) -> float | None:
    """Return the largest tan-angle of direct light, seen from the sensor's centre, or None for that of its depth.

    At the edge of the field stop the sensor sees near surfaces outside the cells of a flat scene.
    """
    bench, depth = simulation.bench, simulation.settings.depth
    if float(bench.loaded.scene.bbox().min.z) > depth * (1 - _FLAT):
        return None
    tracer = simulation.spread
    path_samples = tracer.trace(seed, 0, max(1, _CONNECTIONS // tracer.paths_per_sample))
    if not path_samples.value.size:
        return None
    nearest = 1 / float(path_samples.inverse_depth.max())
    if nearest > depth * (1 - _FLAT):
        return None
    farthest = max(float(abs(angle).max()) for angle in (path_samples.row, path_samples.column))
    pixel = max((last - first) / bench.n for first, last in bench.windows_at(depth))
    reach = min(farthest + pixel, simulation.physics.geometry.reach(nearest))
    return reach if reach > simulation.reach else None


# -------- Projector pixels whose light is hidden from part of the sensor

_ANCHORS, SMOOTH = 5, 3
"""Anchors a side that sample light over the sensor, and coefficients a side of its smooth part."""
_FIRST, _NEAR = 2, 16
"""Rays of each pixel, and of each pixel near one that is partly hidden."""
_LEFT = 0.1
"""Part of the accuracy that may stay on the other pixels."""
_MOST = 1 / 16
"""Largest part of the pixels that may be occluded."""


def occluded_pixels(simulation: Simulation, accuracy: float, seed: int) -> tuple[int, ...]:
    """Return the pixels whose light is hidden from part of the sensor, in increasing order.

    An object's edge hides light only along a line of projector pixels. All other light is smooth over the sensor.
    """
    n, sharp = simulation.bench.n, simulation.settings.sharp
    pixels = np.setdiff1d(np.arange(n**2), sharp.pixels) if sharp else np.arange(n**2)
    rough, whole = _roughness(simulation, pixels, _FIRST, seed)
    rest = (_LEFT * accuracy) ** 2 * whole
    found = pixels[_most(rough, rest)]
    every, looked = np.zeros(n**2), np.zeros(n**2, dtype=bool)
    # A few rays miss slightly hidden pixels, which are neighbours of strongly hidden ones.
    while len(near := np.intersect1d(with_neighbours(np.isin(np.arange(n**2), found), n), pixels[~looked[pixels]])):
        if looked.sum() + len(near) > 9 * _MOST * n**2:
            return ()
        every[near], _ = _roughness(simulation, near, _NEAR, integer(seed, "near", int(looked.sum())))
        looked[near] = True
        found = _most(every, rest)
    return tuple(np.sort(found).tolist()) if len(found) <= _MOST * n**2 else ()


def _most(rough: FloatArray, rest: float) -> Labels:
    order = np.argsort(-rough, kind="stable")
    left = rough.sum() - np.cumsum(rough[order])
    return order[: int(np.argmax(left <= rest)) + 1] if rough.sum() > rest else order[:0]


def _roughness(simulation: Simulation, pixels: Labels, samples: int, seed: int) -> tuple[FloatArray, float]:
    light = DirectTracer(simulation.setup, _ANCHORS, pixels=pixels).sums(seed, samples) / samples
    # Orthonormal polynomials at Chebyshev's nodes, by degree: the discrete cosine transform.
    angle = (np.arange(_ANCHORS) + 0.5) * np.pi / _ANCHORS
    basis = np.cos(np.outer(np.arange(_ANCHORS), angle)) * np.sqrt(2 / _ANCHORS)
    basis[0] /= np.sqrt(2)
    squares = np.square(basis @ light @ basis.T)
    smooth = squares[:, :SMOOTH, :SMOOTH].sum(axis=(1, 2))
    whole = squares.sum(axis=(1, 2))
    return np.asarray(whole - smooth), float(whole.sum())


# -------- Projector pixels that light sharp lobes

_FEW = 8
_MOST_SHARP = 384
_LEFT_SHARP = 0.25
"""Part of the accuracy that interpolation, and pixels not traced separately, may leave."""
_EVEN = 0.1
"""Relative variance of an ordinary pixel's connection (photograph: 0.05 to 0.2)."""
_WORTH = 0.5
_WELL_MET = 30.0
_SEEN = 0.5
_TRIAL, _LARGEST_TRIAL = 16, 2**21
_MOST_CONNECTIONS = 2.0**29
"""Connections, 100 s, above which sharp lobes stay unresolved."""
_RAYS_OF_WINDOW = 64


def sharp_pixels(
    simulation: Simulation, sharp: SharpLight, light: float, accuracy: float, seed: int
) -> SharpPixels | None:
    """Return the pixels that are better traced separately, or None; ``light`` is all other direct light [W m^-2].

    A lobe of radius w on a sensor of half-width H is analytic except for poles at distance w, so interpolation between
    N Chebyshev nodes converges as exp(-N asinh(w / H)) (Trefethen, Approximation Theory, theorem 8.2).
    """
    if not sharp.irradiance:
        return None
    whole, rate = sharp.irradiance + light, math.asinh(sharp.width / simulation.physics.geometry.half_width)
    anchors = max(2, math.ceil(math.log(1 / (_LEFT_SHARP * accuracy)) / rate))
    if anchors > _MOST_SHARP or (anchors <= _FEW and sharp.hits >= _WELL_MET):
        return None
    order = np.argsort(-sharp.moments, kind="stable")
    lit = min(int(np.count_nonzero(sharp.moments)), len(order) - 1)
    moments = np.cumsum(sharp.moments[order])[:lit]
    if anchors <= _FEW:
        # Paths, to a factor, with the first 0..k pixels apart: two kinds of light with variances V and paths
        # P per sample take (sum sqrt(V P))^2.
        count_apart, apart = np.arange(len(moments) + 1), np.concatenate([[0.0], moments])
        rest = np.maximum(moments[-1] - apart, 0) + light**2 / len(order) * _EVEN
        paths = (np.sqrt(rest * (len(order) - count_apart)) + np.sqrt(apart * count_apart * anchors**2)) ** 2
        # Pixels whose light replicates may miss, until the rest is negligible or well sampled.
        light_left, moments_left = (np.cumsum(v[order[:lit]][::-1])[::-1] for v in (sharp.by_pixel, sharp.moments))
        settled = (light_left <= _LEFT_SHARP * accuracy * whole) | (np.square(light_left) >= _SEEN * moments_left)
        count = max(int(np.argmin(paths[1:])) + 1, int(np.argmax(settled)) if settled.any() else lit)
        if paths[count] > _WORTH * paths[0]:
            return None
    else:
        order = np.argsort(-sharp.by_pixel, kind="stable")
        held = np.cumsum(sharp.by_pixel[order])[:lit]
        count = min(int(np.searchsorted(held, sharp.irradiance - _LEFT_SHARP * accuracy * whole)) + 1, lit)
    # Ordinary replicates meet the tails of a small lobe as seldom as the lobe itself.
    pixels = with_neighbours(np.isin(np.arange(len(order)), order[:count]), simulation.bench.n)
    # One pixel at least stays with the others.
    if len(pixels) == len(order):
        pixels = np.sort(order[:count])
    seen = DirectTracer(simulation.setup, 2, pixels=pixels).trace(seed, 0, _RAYS_OF_WINDOW)
    window = (0.0, 0.0, 0.0, 0.0)
    if seen.value.size:
        window = float(seen.row.min()), float(seen.row.max()), float(seen.column.min()), float(seen.column.max())
    left = math.exp(-anchors * rate) * sharp.irradiance / whole
    chosen = SharpPixels(tuple(pixels.tolist()), anchors, window, left)

    # ---- Connections for the accuracy, from the noise of two halves of a trial
    if len(pixels) * anchors**2 > _MOST_CONNECTIONS:
        return None
    tracer = Simulation(simulation.bench, replace(simulation.settings, sharp=chosen)).sharp
    assert tracer is not None
    samples = min(max(_LARGEST_TRIAL // tracer.paths_per_sample, 2), _TRIAL)
    halves = [tracer.trace(integer(seed, half), 0, samples) for half in range(2)]
    place = [(light.pixel * anchors + light.anchor_row) * anchors + light.anchor_column for light in halves]
    every, where = np.unique(np.concatenate(place), return_inverse=True)
    parts = np.split(where, [len(place[0])])
    first, second = (np.bincount(at, light.value, len(every)) for at, light in zip(parts, halves, strict=True))
    energy = float((first * second).sum())
    noise = math.sqrt(float(np.square(first - second).sum()) / 2 / energy) if energy > 0 else math.inf
    needed = tracer.paths_per_sample * samples * (noise / accuracy) ** (1 / SHARP_RATE)
    return chosen if needed <= _MOST_CONNECTIONS else None
