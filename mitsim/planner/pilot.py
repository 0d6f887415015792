"""A short look at a scene before the real work: a bench and a lighting in, numbers that the plan decides by out.

Every error is relative, ``||a - b|| / ||b||``, over up to four shots of the family.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property

import numpy as np

from mitsim.bench import effects
from mitsim.bench.apparatus import Apparatus
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import integer
from mitsim.devices.patterns import Lighting
from mitsim.light.cost_model import FIXED, Numbers, forming_seconds
from mitsim.light.passes import PASSES
from mitsim.light.settings import (
    REPLICATES,
    Approximation,
    Drawn,
    ErrorCovariance,
    Forming,
    PilotResult,
    SampleCost,
    Settings,
)
from mitsim.light.simulation import Simulation
from mitsim.planner.pilot_anchors import AnchorRuns, FollowedRuns, PenumbraRuns
from mitsim.planner.pilot_direct import SMOOTH, DirectRuns, occluded_pixels, sharp_pixels
from mitsim.planner.pilot_effects import EffectRuns
from mitsim.planner.pilot_samples import GOOD_ENOUGH, Sample
from mitsim.scene.darkness import why_dark
from mitsim.transport.missed import LeftOut, SharpLight, highlights, left_out_light, sharp_light, with_neighbours

RUNS = ("cells", "effects", "anchors", "followed", "occluded")
"""What is looked at apart: cells and layers of direct light, effects switched off, anchors, those of followed light,
and of occluded pixels."""
_RUN_OF = {
    "layers": "cells",
    "cells": "cells",
    "followed_width": "followed",
    **{row.anchors: row.pilot for row in PASSES.values() if row.anchors},
}
"""What tells the error of the numbers that a plan chooses."""
FINER = 4
"""Samples of a run over those of the look before: standard errors are halved at least."""
_ROUGH = 0.5
"""Part of the accuracy that a few anchors may leave at most before it is asked which pixels are to blame."""
_OF_FOLLOWED = 0.5
"""The same for followed light: every further step takes twice as many connections, and its own noise is as large as
what it tells."""
_FRAMES_AS_MANY = 20.0
"""Frames whose forming takes as long as one more change does: four shots seen by four looks, and finer cells."""
_OF_EFFECTS = 3
"""Changes that each effect's look takes as long as: it forms all light with and without, and coarse cells besides."""
_OVER_WORK, _LESS_S = 4.2, 0.6
"""Seconds of a look over the price of its samples, and less what flat scenes have less: kernels, searches for lobes and
edges, chains of changes (processor seconds in a new process: photograph 1.0, gift_card 2, corner 3, cookie_bag 7.5; six
tenths of them by the clock on two cores)."""
_LOBE_RAYS = 2**22
"""Rays that look for sharp lobes, some 0.5 s: a lobe of 1e-4 of the hemisphere is met 400 times, a metal ball of 20 mm
at 370 twelve times on a sensor of 6.4 mm; a quarter of them overlooked it in one plan of twenty."""
_CAUSTIC_PATHS = 2**20
"""Paths that look for light that is left out: a thousandth of the light that all curved glass sends is met 30 times."""
_FEWEST_HITS = 30.0
"""Below so many hits the pilot's connections do not tell how much light a lobe sends, nor how noisy it is."""
_FEWEST_MET = 3.0
"""Below so many meetings of the projector's own lens the pilot may see none, one time in twenty: where it sees one, the
run samples until it knows the light; else neither may."""
_FAINT = 1e-3
"""Part of the mean light on the sensor below which its centre sees nothing but rounding."""
_MOST_RAYS = 2**26
"""Rays that look for what a scene shows while few have met it, some 0.5 s: they meet 2e-4 of the window's width."""
_MORE = 4
"""Times as many rays as before: a power of two keeps the places of each pixel's rays even."""
_LOOSELY = 0.3
"""Part of the light of highlights that the search for lobes may lack where it has found them: some 30 hits tell it to a
fifth."""
_FEWEST_IN_RUN = 8.0
"""Hits that a look at a small target must count on: the looks then tell its light to a fifth."""
_ALIGNED = 1e-6
"""Relative distance from the aligned plane that is rounding: the plane keeps its exact cells."""


# ---- Runs of the pilot, each repeated with more samples ----


class PilotRuns:
    """A look at a scene, as short as it can be at first; each of its runs is repeated with more samples.

    Parameters
    ----------
    bench
        what is looked at.
    lighting
        of the family that will be captured.
    accuracy
        where the search for enough anchors, layers and cells may stop.
    seed
        root of the random streams.
    lines
        that share the paths, of which the bench shows one.

    Raises
    ------
    MitsimError
        when no light of the projector reaches the camera, or none passes its mask.
    """

    def __init__(self, bench: Apparatus, lighting: Lighting, accuracy: float, seed: int, lines: int = 1) -> None:
        self.bench, self.lighting, self.accuracy, self.seed, self._lines = bench, lighting, accuracy, seed, lines
        self.present = effects.present(bench)
        first_pilot_run = frozenset(self.present) & effects.names(lambda effect: effect.first_pilot_run)
        first = Simulation(bench, Settings(depth=bench.geometry.scene_distance, effects=first_pilot_run))
        self._sharp = _sharp(first, seed)
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
            sample = _enough(sample, hits, bench)
            self._hits = hits if hits < _FEWEST_HITS else math.inf
        self.samples = dict.fromkeys(RUNS, sample)
        self.occluded: PenumbraRuns | None = None
        for run in RUNS:
            self._measure(run)
        if self._rough:
            self._look_for_occluded()

    def _look_for_occluded(self) -> None:
        """Give pixels that are hidden from part of the sensor anchors of their own."""
        own = integer(self.seed, "pilot", "occluded")
        occluded = occluded_pixels(Simulation(self.bench, self._base), self.accuracy, own)
        shown = np.isin(self.samples["occluded"].shown, occluded)
        # Unless the sample's shots show some of either kind, nobody knows how many anchors each takes.
        if shown.any() and not shown.all():
            self._base = replace(self._base, occluded=occluded)
            known = self.anchored
            for run in ("anchors", "occluded"):
                self._measure(run)
            self.anchored.take_over(known.traced)

    # ---- More samples: their work, and where they are called for ----

    def refine(self, run: str) -> None:
        """Repeat a ``run`` with so many more samples that its standard errors are halved."""
        self.samples[run] = self._finer(run)
        self._measure(run)
        vars(self).pop("pilot_result", None)

    def work(self, run: str) -> float:
        """Work of repeating a ``run``, in seconds at fixed unit costs; infinite where it has all the samples it may."""
        now, finer = self.samples[run], self._finer(run)
        if (finer.fine, finer.direct) == (now.fine, now.direct):
            return math.inf
        costs, followed = FIXED.passes, self.switched.paths_per_sample
        one = forming_seconds(self.forming, Numbers.coarsest(), _FRAMES_AS_MANY, FIXED)
        if run == "cells":
            paths, changes = costs["direct"] * len(finer.shown) * finer.fine, len(self.fine.changes)
        elif run == "anchors":
            paths = costs["anchor_residual"] * len(finer.shown) * finer.anchored * self.anchored.connections
            changes = len(self.anchored.changes)
        elif run == "followed":
            paths = costs["indirect_residual"] * sum(followed.values()) * finer.followed * self.followed.connections
            changes = len(self.followed.changes)
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
        """What the look took, about, at fixed unit costs."""
        repeats = [work / FINER for work in map(self.work, RUNS) if math.isfinite(work)]
        return max(_OVER_WORK * sum(repeats) - _LESS_S, 0.0)

    @property
    def _rough(self) -> bool:
        """Whether a few anchors may leave too much: light that is hidden from part of the sensor, or sharp gloss."""
        few = ErrorCovariance.between(self.anchored.of_few, self.switched.light**2).estimate(
            [Approximation("anchors", SMOOTH)]
        )
        return few.bound > _ROUGH * self.accuracy

    def heavy(self, samples: int) -> dict[str, SampleCost]:
        """What passes from the camera take, by name, as looks of more ``samples`` see it: a lobe that is met in one of
        a million paths, and brings most of the noise, is in none of the short ones."""
        found = {
            "from_camera": self.switched.with_more(samples),
            "camera_residual": self.followed.with_more(self.switched.light, samples),
        }
        return {name: sample_cost for name, sample_cost in found.items() if sample_cost.noise.error}

    def _finer(self, run: str) -> Sample:
        sample = self.samples[run]
        return replace(sample, times=FINER * sample.times)

    # ---- What is measured, and how frames are formed for it ----

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
                    "no light of the projector passes the mask: what lies between the scene and the sensor is closed; "
                    f"give a mask that opens there (its features are {feature:g} mm wide)"
                )
        elif run == "followed":
            tolerance, lit = self._tolerance(_OF_FOLLOWED), self.switched.received > 0
            before = vars(self).get("followed")
            others = sample, tolerance, seed, self.fine.judging, lit
            self.followed = FollowedRuns(bench, self._everything, *others, before=before)
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
        """Norm of that ``part`` of all light that the capture may leave out."""
        return part * self.accuracy * self.switched.light

    def _over_tolerance(self, parts: tuple[float, float]) -> tuple[float, float]:
        cells, layer = parts
        return cells / self._tolerance(), layer / self._tolerance()

    @property
    def _everything(self) -> Settings:
        return replace(self._base, effects=frozenset(self.present), subdivision=2)

    @cached_property
    def forming(self) -> Forming:
        """How frames are formed."""
        return self.fine.forming(self.lighting)

    @cached_property
    def _raster(self) -> tuple[Drawn, Drawn]:
        return self.fine.raster()

    @cached_property
    def _left_out(self) -> LeftOut:
        return _left_out(self.switched.simulation, self.seed)

    # ---- Light that neither rays nor connections find ----

    @property
    def _unmet(self) -> float:
        """Irradiance of glossy balls' highlights that neither the search for lobes nor the looks' rays meet."""
        if not self.bench.loaded.glossy:
            return 0.0
        every = highlights(self._seen.setup)
        unmet = every.unmet(self.samples["cells"].fine * REPLICATES)
        if not len(unmet.pixels):
            return 0.0
        near = with_neighbours(np.isin(np.arange(self.bench.n**2), unmet.pixels), self.bench.n)
        missing = float(unmet.irradiance.sum() - self._sharp.by_pixel[near].sum())
        return missing if missing > _LOOSELY * float(unmet.irradiance.sum()) else 0.0

    # ---- The pilot's result ----

    @cached_property
    def pilot_result(self) -> PilotResult:
        """What has been found."""
        fine, switched, anchored = self.fine, self.switched, self.anchored
        seen = {**anchored.changes, **fine.changes, **switched.changes, **self.followed.changes}
        if self.occluded:
            seen |= self.occluded.changes
        light, sharp, apart = switched.light, self._sharp, self._base.sharp
        rows, columns = (np.unique(each).size / self.bench.n for each in np.divmod(self._base.occluded, self.bench.n))
        samples = self.samples["effects"].followed * REPLICATES
        indirect, shared, repeats = switched.indirect_cost()
        sample_costs = {
            **switched.sample_costs,
            **self.followed.sample_costs(light),
            **anchored.sample_costs(light),
            **(self.occluded.sample_costs(light) if self.occluded else {}),
            "direct": fine.sample_cost(light),
            "indirect": indirect,
        }
        left_out, mirror = self._left_out.unseen(_FEWEST_HITS / samples, _FEWEST_MET / samples)
        # Light over mirrors alone, and what of it is in no frame or may be in the wrong pixels.
        mirrors = self.bench.loaded.mirrors
        alone, unsure = self.bench.specular.irradiance(self.bench.geometry) if mirrors else (0.0, 0.0)
        found = self._light + sharp.irradiance + switched.received + alone
        few = not apart and sharp.hits * self.samples["cells"].fine * REPLICATES < _FEWEST_HITS
        unmet = self._unmet
        unresolved = unmet + (sharp.irradiance if few else 0.0)
        return PilotResult(
            depth=self._base.depth,
            layers=fine.layers,
            changes=ErrorCovariance.between(seen, light**2),
            sample_costs=sample_costs,
            spread=fine.spread(light),
            shared=shared,
            repeats=repeats,
            forming=replace(self.forming, lines=self._lines, occluded=(rows, columns)),
            apart=switched.apart,
            unresolved=unresolved / (self._light + sharp.irradiance + unmet) if unresolved else 0.0,
            left_out=left_out / (left_out + found) if left_out else 0.0,
            unresolved_specular=unsure / (found + unsure) if unsure else 0.0,
            mirror=mirror,
            reach=self._base.reach,
            sharp=apart,
            occluded=self._base.occluded,
            raster=self._raster,
            hits=self._hits,
        )


def run_of(part: Approximation) -> str:
    """The run that tells the error of a ``part``."""
    light, _, _ = part.name.rpartition(" ")
    if light:
        return PASSES[light].pilot if PASSES[light].anchors else "effects"
    return _RUN_OF.get(part.name, "effects")


# ---- Sharp lobes, and light that no tracer finds ----


def _enough(sample: Sample, hits: float, bench: Apparatus) -> Sample:
    """The ``sample`` with so many rays that some meet what the camera sees, where one of each pixel has few ``hits``.

    MitsimError where that takes more than a look may trace.
    """
    times = math.ceil(_FEWEST_IN_RUN / (hits * sample.direct)) if hits else 1
    more = replace(sample, times=times * sample.times)
    if times > 1 and hits * more.direct < _FEWEST_IN_RUN:
        n, side = bench.n, math.sqrt(hits)
        raise MitsimError(
            f"what the camera sees is too small for the projector's light: all that it lights fills {hits:.1e} of one "
            f"of {n} x {n} projector pixels ({side:.1e} a side); give the projector a narrower fov, or a larger target"
        )
    return more


def _sharp(simulation: Simulation, seed: int) -> SharpLight:
    """Direct light over lobes that are too sharp to be met by connections."""
    pixels = simulation.bench.n**2
    if not simulation.bench.loaded.glossy:
        return SharpLight.none(pixels)
    return sharp_light(simulation.setup, integer(seed, "pilot", "lobes"), max(1, _LOBE_RAYS // pixels))


def _left_out(simulation: Simulation, seed: int) -> LeftOut:
    """Light that no tracer finds, or connections may not meet."""
    if not simulation.bench.loaded.mirrors:
        return LeftOut.none()
    samples = max(1, _CAUSTIC_PATHS // (simulation.aim.shape[0] * simulation.aim.shape[1]))
    return left_out_light(simulation.setup, simulation.aim, integer(seed, "pilot", "caustics"), samples)


# ---- Where light is first seen, and how many rays bring it ----


def _first_light(simulation: Simulation, seed: int, sharp: SharpLight) -> tuple[float, float, float]:
    """Where light is seen, 1 / mean(1/z) [mm], how much of it, and how many rays bring it if each pixel sends one.

    From one ray of each projector pixel, or, where hardly one meets what the camera sees, from more. Rays count by
    their light, as so many equal ones.
    """
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
    """How many equal ``values`` would scatter as much about their sum as these."""
    squares = float(np.square(values, dtype=np.float64).sum())
    return float(values.sum(dtype=np.float64)) ** 2 / squares if squares else 0.0


# ---- How far from the axis light comes ----

_CONNECTIONS = 2**16
"""Connections that look for near surfaces, some 10 ms; what they overlook is counted when the light is accumulated."""
_FLAT = 1e-4
"""Relative distance of the nearest light from the mean below which the scene is flat: single precision is 1e-7."""


def light_reach(simulation: Simulation, seed: int) -> float | None:
    """Largest tan-angle of direct light at any point of the sensor, seen from its centre; None: that of its depth.

    At the field stop's edge the sensor sees surfaces nearer than the mean depth beyond the cells of a flat scene.
    Found by connections to random points of the sensor, plus a projector pixel for what they did not meet; never more
    than the nearest light can have.

    Parameters
    ----------
    simulation
        with the depth that the cells are made for.
    seed
        of the connections.
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
