"""A short look at a scene before the real work: the error that each effect or coarseness would leave, and the pace.

Numbers in, numbers out: the effect plan (:mod:`mitsim.capture.plan`) reads them and decides. Every error is relative,
``||a - b|| / ||b||``, over up to four captures of the family. Two independent halves A and B see the same change with
independent noise, so ``<a_A - b_A, a_B - b_B>`` estimates ``||a - b||^2`` without the noise's own energy.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from mitsim.capture.bench import Bench
from mitsim.capture.evidence import GROUPS, PHYSICAL, Effort, Evidence, Noise, Settings
from mitsim.capture.simulation import Simulation
from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import integer
from mitsim.optics.frames import ExpectedFrames
from mitsim.scene.darkness import why_dark
from mitsim.transport.direct import DirectTracer
from mitsim.transport.histogram import AMBIENT, INDIRECT, Deposits
from mitsim.transport.lobes import SharpLight, sharp_light

Halves = tuple[FloatArray, FloatArray]
ANCHOR_LADDER = (1, 2, 3, 5, 8)
LAYER_LADDER = (1, 2, 3, 4, 6, 8, 12)
CELL_LADDER = (1, 2, 4, 8)
_FIRST_JUDGE, _FEW_ANCHORS = 5, 3
_CAPTURES = 4
_LOBE_RAYS = 2**20
"""Rays that look for sharp lobes."""
_FEWEST_HITS = 30.0
"""Below so many hits the pilot's connections do not tell how much light a lobe sends, nor how noisy it is."""
_FAINT = 1e-3
"""Part of the mean light on the sensor below which its centre sees nothing but rounding."""
_PIXELS = 64**2
"""Few pixels are sampled more often, until they take as many samples as so many pixels."""


@dataclass(frozen=True)
class _Family:
    """The captures that the pilot looks at."""

    labels: Labels
    weights: FloatArray

    @property
    def shown(self) -> Labels:
        """Projector pixels that the captures show."""
        return np.flatnonzero((self.weights != 0).any(axis=0)[self.labels])

    @property
    def fine(self) -> int:
        """Samples a shown pixel to tell cells and layers apart."""
        return 16 * max(1, _PIXELS // len(self.shown))

    @property
    def anchored(self) -> int:
        """Samples a shown pixel to tell anchors apart."""
        return self.fine // 4

    @property
    def direct(self) -> int:
        """Samples a projector pixel to tell effects apart."""
        return 4 * max(1, _PIXELS // len(self.labels))

    @property
    def other(self) -> int:
        """Samples a projector pixel of indirect light, and a cell of light that is followed from the camera."""
        return self.direct // 2


def applicable(bench: Bench) -> tuple[str, ...]:
    """Effects that the scene or its devices have anything to do with."""
    geometry, projector = bench.geometry, bench.projector
    there = {
        "interreflection": True,
        "mirrors": bench.loaded.mirrors,
        "ambient": bool(bench.loaded.lamps),
        "diffraction": True,
        "mask-thickness": geometry.mask_thickness > 0,
        "pixel-response": geometry.pixel_fill_factor < 1 or geometry.angular_exponent > 0,
        "aperture": projector.aperture_radius_mm > 0,
        "blur": projector.blur_pixels > 0,
        "black-level": projector.black_level > 0,
        "speckle": projector.speckle_contrast > 0,
    }
    return tuple(name for name in PHYSICAL if there[name])


def measure(bench: Bench, labels: Labels, weights: FloatArray, accuracy: float, seed: int) -> Evidence:
    """Trace a few small batches and compare effects and discretisations on a handful of the family's captures.

    ``labels`` and ``weights`` describe the family as in :class:`mitsim.optics.frames.ExpectedFrames`; ``accuracy`` is
    where the search for enough anchors and layers may stop.

    Raises
    ------
    MitsimError
        when no light of the projector reaches the camera.
    """
    family = _Family(labels, _some(weights, _CAPTURES))
    names = applicable(bench)
    direct = frozenset(names) & {"mirrors", "aperture", "blur", "diffraction"}
    first = Simulation(bench, Settings(depth=bench.geometry.scene_distance, effects=direct))
    sharp = _sharp(first, seed)
    depth, light = _depth(first, seed, sharp)
    base = Settings(depth=depth, effects=direct)
    fine = _Fine(bench, base, family, accuracy, seed)
    layer_error = fine.layer_errors()
    cell_error = fine.cell_errors()
    effects = _Effects(bench, replace(base, effects=frozenset(names), subdivision=2), family, seed)
    anchors = _Anchors(bench, base, family, accuracy, seed, _norm(effects.frames))
    effect_error = effects.errors(names)
    if "speckle" in names:
        effect_error["speckle"] = bench.projector.speckle_contrast
    return Evidence(
        depth=depth,
        layers=fine.layers,
        anchor_error=anchors.errors,
        layer_error=layer_error,
        cell_error=cell_error,
        effect_error=effect_error,
        direct_part=anchors.part,
        direct=fine.effort(_norm(effects.frames)),
        anchored=anchors.effort(fine.pace),
        indirect=effects.effort("indirect"),
        other=effects.effort("other"),
        seconds_per_frame=fine.seconds_per_frame,
        terms=float(len(bench.spectrum.weights) * (2 if bench.geometry.mask == "flatcam" else 1)),
        unresolved=sharp.irradiance / (light + sharp.irradiance) if sharp.hits * family.fine < _FEWEST_HITS else 0.0,
    )


def _sharp(simulation: Simulation, seed: int) -> SharpLight:
    """Direct light over lobes that are too sharp to be met by connections."""
    loaded = simulation.bench.loaded
    if not loaded.glossy:
        return SharpLight(0.0, 0.0, math.inf)
    parts = loaded.scene, loaded.camera, simulation.source, simulation.geometry
    return sharp_light(*parts, integer(seed, "pilot", "lobes"), max(1, _LOBE_RAYS // simulation.bench.n**2))


def _depth(simulation: Simulation, seed: int, sharp: SharpLight) -> tuple[float, float]:
    """Where the light is seen, 1 / mean(1/z) [mm], and how much of it, from one ray of each projector pixel."""
    bench, own = simulation.bench, integer(seed, "pilot", "depth")
    found = simulation.direct.trace(own)
    total = float(found.value.sum())
    if not bench.loaded.mirrors and not sharp.irradiance:
        everywhere = Simulation(bench, replace(simulation.settings, anchors=2)).direct.trace(own)
        if total < _FAINT * float(everywhere.value.sum()):
            raise MitsimError(
                "the sensor's centre sees no light of the projector, though other parts of the sensor do: "
                + why_dark(bench.loaded)
            )
    if not total and not bench.loaded.mirrors:
        raise MitsimError(f"no light of the projector reaches the camera: {why_dark(bench.loaded)}")
    # Sums by numpy, here and below: those of BLAS depend on the number of its threads in the last bits.
    mean = float((found.inverse_depth * found.value).sum()) / total if total else 0.0
    # A plane is met at its own depth but for rounding; the aligned plane keeps its exact cells.
    flat = abs(mean * bench.geometry.scene_distance - 1) < 1e-6
    return bench.geometry.scene_distance if flat or mean <= 0 else 1 / mean, total


class _Fine:
    """Direct light in many samples a cell, filed in different ways."""

    def __init__(self, bench: Bench, base: Settings, family: _Family, accuracy: float, seed: int) -> None:
        self.bench, self.base, self.family, self.accuracy, self.seed = bench, base, family, accuracy, seed
        self.simulation = Simulation(bench, base)
        tracer = _tracer(self.simulation, family)
        seeds = [integer(seed, "pilot", "fine", half) for half in range(2)]
        first = tracer.trace(seeds[0], 0, family.fine)
        started = time.perf_counter()
        second = tracer.trace(seeds[1], 0, family.fine)
        self.pace = (time.perf_counter() - started) / (tracer.lanes * family.fine)
        few = [tracer.trace(one, 0, family.fine // 4) for one in seeds]
        self.deposits, self.few = (first, second), (few[0], few[1])
        near, far = self._range()
        self.layers: dict[int, tuple[float, ...]] = {1: (base.depth,)}
        if far > near * (1 + 1e-4):
            for count in LAYER_LADDER[1:]:
                nodes = 1 / np.linspace(1 / far, 1 / near, count)
                self.layers[count] = tuple(float(node) for node in nodes)
        self.seconds_per_frame = 0.0

    def _range(self) -> tuple[float, float]:
        """Nearest and farthest depth that the light is seen at [mm]."""
        inverse = np.concatenate([found.inverse_depth for found in self.deposits])
        if not inverse.size:
            return self.base.depth, self.base.depth
        limit = 1e-4 / self.base.depth  # light from beyond ten thousand times the scene counts as infinitely far
        return 1 / float(inverse.max()), 1 / max(float(inverse.min()), limit)

    def layer_errors(self) -> dict[int, float]:
        """Error by number of layers, judged by the most; the search stops where it is good enough."""
        if len(self.layers) == 1:
            return {1: 0.0}
        return _ladder(self.layers, lambda count: self._frames(self.layers[count], 2), 3, self.accuracy)

    def cell_errors(self) -> dict[int, float]:
        """Error by cells a side of a projector pixel, judged by the finest that were tried."""
        errors = _ladder(CELL_LADDER, lambda count: self._frames((), count), 2, self.accuracy)
        judge, before = max(errors), max(count for count in errors if count < max(errors))
        # Even cells are of second order: with k a side, the error falls with 1/k^2, and the judge has its own part.
        whole = {count: error / (1 - (count / judge) ** 2) for count, error in errors.items() if count < judge}
        return {**whole, judge: whole[before] * (before / judge) ** 2}

    def effort(self, light: float) -> Effort:
        """Monte Carlo error of one estimate, relative to all ``light``, how fast it falls, and what it takes."""
        many = _noise(self._frames((), 1), light)
        few = _noise(self._frames((), 1, self.few, self.family.fine // 4), light)
        rate = math.log(few / many) / math.log(4) if many > 0 and few > 0 else 1.0
        noise = Noise(many, self.family.fine, min(max(rate, 0.5), 1.0))
        return Effort(noise, self.bench.n**2, self.pace)

    def _frames(
        self,
        layers: tuple[float, ...],
        subdivision: int,
        deposits: tuple[Deposits, Deposits] | None = None,
        samples: int | None = None,
    ) -> Halves:
        samples = samples or self.family.fine
        settings = replace(self.base, layers=layers, subdivision=subdivision)
        simulation = Simulation(self.bench, settings)
        found = deposits or self.deposits
        halves = tuple(_form(simulation, one, samples, self.family) for one in found)
        self.seconds_per_frame = self.seconds_per_frame or _pace(simulation, found[0], samples, self.family)
        return halves[0], halves[1]


class _Effects:
    """All effects at once, and each of them switched off."""

    def __init__(self, bench: Bench, everything: Settings, family: _Family, seed: int) -> None:
        self.bench, self.everything, self.family = bench, everything, family
        self.seeds = tuple(integer(seed, "pilot", "effects", half) for half in range(2))
        self.simulation = Simulation(bench, everything)
        self.direct, self.other = self._direct(self.simulation), self._other(self.simulation)
        self.frames = self._form(self.simulation, self.direct, self.other)

    def errors(self, names: tuple[str, ...]) -> dict[str, float]:
        """Change of the frames when each effect is left out."""
        return {name: _difference(self._without(name), self.frames) for name in names if name != "speckle"}

    def effort(self, name: str) -> Effort:
        """Monte Carlo error of one estimate of indirect or other light, relative to all light, and what it takes."""
        stage = self.simulation.tracers().get(name)
        if stage is None:
            return Effort.none()
        none = tuple(Deposits.none() for _ in self.seeds)
        started = time.perf_counter()
        found = tuple(stage.tracer.trace(seed, 0, self.family.other) for seed in self.seeds)
        pace = (time.perf_counter() - started) / (2 * stage.tracer.lanes * self.family.other)
        error = _noise(self._form(self.simulation, none, found), _norm(self.frames))
        noise = Noise(error, self.family.other, 0.5)
        return Effort(noise, stage.tracer.lanes, pace)

    def _without(self, name: str) -> Halves:
        simulation = Simulation(self.bench, replace(self.everything, effects=self.everything.effects - {name}))
        direct, other = self.direct, self.other
        if name in ("aperture", "blur", "pixel-response"):
            direct = self._direct(simulation)
        if name in ("aperture", "blur", "pixel-response", "mirrors"):
            other = self._other(simulation)
        if name == "interreflection":
            # Lamps' light bounces as well, and only paths that were never followed tell how much of it.
            lamps = simulation.lit_by_lamps
            other = self._other(simulation) if lamps else tuple(found.where(found.order != INDIRECT) for found in other)
        if name == "ambient":
            other = tuple(found.where(found.order != AMBIENT) for found in other)
        return self._form(simulation, direct, other)

    def _direct(self, simulation: Simulation) -> tuple[Deposits, ...]:
        return tuple(simulation.direct.trace(seed, 0, self.family.direct) for seed in self.seeds)

    def _other(self, simulation: Simulation) -> tuple[Deposits, ...]:
        return tuple(simulation.followed(seed, self.family.other) for seed in self.seeds)

    def _form(self, simulation: Simulation, direct: tuple[Deposits, ...], other: tuple[Deposits, ...]) -> Halves:
        first, second = (
            _form(simulation, one, self.family.direct, self.family, two) for one, two in zip(direct, other, strict=True)
        )
        return first, second


class _Anchors:
    """The frames with fewer anchors; every anchor is connected to the same points, so little noise is left.

    Frames, not radiance: the falloff's error is odd in the scene's coordinates and mostly cancels in a frame.
    """

    def __init__(self, bench: Bench, base: Settings, family: _Family, accuracy: float, seed: int, light: float) -> None:
        """``light`` is the norm of frames of all light, of which direct light is ``part``."""
        self.bench, self.base, self.family, self.light = bench, base, family, light
        self.seeds = [integer(seed, "pilot", "anchors", half) for half in range(2)]
        self.part = _norm(self._frames(1)) / light if light else 0.0
        errors = _ladder(ANCHOR_LADDER, self._frames, ANCHOR_LADDER.index(_FIRST_JUDGE), accuracy)
        self.errors = {count: self.part * error for count, error in errors.items()}

    def effort(self, pace: float) -> Effort:
        """Monte Carlo error of one estimate of what a few anchors see beyond their mean, relative to all light."""
        simulation = self._simulation(_FEW_ANCHORS)
        halves = []
        for found in self._traced(simulation):
            alike = found.averaged(simulation.mean_weights)
            mean = simulation.smooth.file(alike, self.family.labels, self.family.anchored)
            everything = self._formed(simulation, self._filed(simulation, found))
            halves.append(everything - self._formed(simulation, simulation.coarse.repeated(mean)))
        noise = Noise(_noise((halves[0], halves[1]), self.light), self.family.anchored, 0.5)
        return Effort(noise, self.bench.n**2, pace)

    def _frames(self, anchors: int) -> Halves:
        simulation = self._simulation(anchors)
        traced = self._traced(simulation)
        first, second = (self._formed(simulation, self._filed(simulation, found)) for found in traced)
        return first, second

    def _simulation(self, anchors: int) -> Simulation:
        return Simulation(self.bench, replace(self.base, anchors=anchors))

    def _traced(self, simulation: Simulation) -> Iterator[Deposits]:
        """Light to every anchor, in two halves."""
        tracer = _tracer(simulation, self.family)
        return (tracer.trace(seed, 0, self.family.anchored) for seed in self.seeds)

    def _filed(self, simulation: Simulation, found: Deposits) -> sparse.csr_array:
        return simulation.coarse.file(found, self.family.labels, self.family.anchored)

    def _formed(self, simulation: Simulation, light: sparse.csr_array) -> FloatArray:
        """(captures, pixels, pixels) frames of light to every anchor."""
        rows = np.arange(self.family.weights.shape[1])
        groups = [light[: len(rows)]]
        frames = ExpectedFrames(simulation.coarse_optics, groups, rows, self.family.weights, 0)
        return np.stack([frame.irradiance for frame in frames])


def _tracer(simulation: Simulation, family: _Family) -> DirectTracer:
    """Direct light to every anchor, of those projector pixels only that the family's captures show."""
    loaded = simulation.bench.loaded
    parts = loaded.scene, loaded.camera, simulation.source, simulation.settings.anchors, simulation.geometry
    return DirectTracer(*parts, pixels=family.shown)


def _ladder(
    steps: Mapping[int, object] | tuple[int, ...], frames: Callable[[int], Halves], first: int, accuracy: float
) -> dict[int, float]:
    """Error of each step against the last one tried; more are tried until the one before the judge is good enough."""
    counts = list(steps)
    made = {count: frames(count) for count in counts[: first + 1]}
    while True:
        judge, before = list(made)[-1], list(made)[-2]
        errors = {count: _difference(found, made[judge]) for count, found in made.items() if count != judge}
        if errors[before] <= 0.3 * accuracy or judge == counts[-1]:
            break
        following = counts[counts.index(judge) + 1]
        made[following] = frames(following)
    # The judge's own error: what the last step gained, once more.
    earlier = list(made)[-3]
    gain = errors[before] / errors[earlier] if errors[earlier] > 0 else 1.0
    return {**errors, judge: errors[before] * min(gain, 1.0)}


def _form(
    simulation: Simulation, found: Deposits, samples: int, family: _Family, other: Deposits | None = None
) -> FloatArray:
    """(captures, pixels, pixels) frames of some direct light, and of other light in ``family.other``."""
    light = simulation.file(found, family.labels, samples)
    if other is not None:
        light = light + simulation.file_other(other, family.labels, family.other)
    rows = np.arange(family.weights.shape[1])
    exact = simulation.mirrored(family.labels)
    frames = simulation.expected([light], rows, family.weights, 0, exact)
    return np.stack([frame.irradiance for frame in frames])


def _pace(simulation: Simulation, found: Deposits, samples: int, family: _Family) -> float:
    """Seconds to form one frame, with its share of the eight groups' errors."""
    light = simulation.file(found, family.labels, samples)
    started = time.perf_counter()
    rows = np.arange(family.weights.shape[1])
    list(ExpectedFrames(simulation.optics, [light.fine[: len(rows)]] * GROUPS, rows, family.weights, 0))
    return (time.perf_counter() - started) / len(family.weights)


def _some(weights: FloatArray, most: int) -> FloatArray:
    """Up to ``most`` captures, evenly spread over the family."""
    chosen: FloatArray = weights[np.unique(np.linspace(0, len(weights) - 1, min(len(weights), most)).astype(int))]
    return chosen


def _difference(changed: Halves, judge: Halves) -> float:
    """||changed - judge|| / ||judge||, from two independent halves."""
    energy = float((judge[0] * judge[1]).sum())
    product = float(((changed[0] - judge[0]) * (changed[1] - judge[1])).sum())
    return math.sqrt(max(product, 0.0) / energy) if energy > 0 else 0.0


def _norm(halves: Halves) -> float:
    """Norm of the frames, without their noise."""
    return math.sqrt(max(float((halves[0] * halves[1]).sum()), 0.0))


def _noise(halves: Halves, light: float) -> float:
    """Error of one of two independent halves, relative to frames of the norm ``light``."""
    return math.sqrt(float(np.square(halves[0] - halves[1]).sum()) / 2) / light if light else 0.0
