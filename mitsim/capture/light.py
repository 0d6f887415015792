"""Light for a family of patterns: from a bench and an accuracy to sampled light, its frames and their error."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np

from mitsim.capture import pilot
from mitsim.capture.bench import Bench
from mitsim.capture.evidence import GROUPS, Settings
from mitsim.capture.plan import Plan, SceneFacts, check_accuracy, decide
from mitsim.capture.simulation import Estimate, Simulation
from mitsim.core.arrays import FloatArray, Labels, Progress
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer
from mitsim.optics.frames import ExpectedFrames, relative_error

Target = Callable[[ExpectedFrames], float]
_CHECKED_CAPTURES = 8
_MOST_PATHS = 2**32
_LARGEST_GROWTH = 8.0
_FIRST_ROUND = 0.5
_VIEW_SAMPLES = 64
_LANES_AT_ONCE = 2**21
"""Paths whose light is held in memory at a time."""


def silent(stage: str, fraction: float) -> None:
    """A progress report that goes nowhere: stage name, and its finished part 0..1."""


@dataclass(frozen=True, eq=False)
class Light:
    """Sampled light of one scene.

    Attributes
    ----------
    groups
        independent estimates.
    simulation
        what was simulated; it turns light into frames.
    labels
        (n^2,) row of each projector pixel: its class, or the pixel itself when any family is to be formed.
    flux
        (n^2,) irradiance that each pixel's direct light casts on the sensor without the mask, mean over the sensor.
    paths
        connections and paths traced.
    sampling_error
        relative Monte Carlo error of the frames that were checked; ``reached`` tells whether it met the target.
    """

    groups: tuple[Estimate, ...]
    simulation: Simulation
    labels: Labels
    flux: FloatArray
    paths: int
    sampling_error: float
    reached: bool

    def frames(self, labels: Labels, weights: FloatArray, seed: int) -> ExpectedFrames:
        """Expected frames of the captures that ``labels`` (n^2,) and ``weights`` (captures, classes) describe.

        Light by pixel serves every family; light by class only families that never split one of its classes.
        """
        rows = np.zeros(int(self.labels.max()) + 1, dtype=np.int64)
        rows[self.labels] = labels
        if not np.array_equal(rows[self.labels], labels):
            raise ValueError("the light was collected for another family of patterns")
        exact = self.simulation.mirrored(labels)
        return self.simulation.expected(self.groups, rows, weights, seed, exact)

    def merged(self) -> Light:
        """The same light as one group: frames come without a variance, and faster."""
        return replace(self, groups=(reduce(add, self.groups) / len(self.groups),))


@single_threaded_blas()
def make_plan(
    bench: Bench,
    labels: Labels,
    weights: FloatArray,
    accuracy: float,
    seed: int,
    forced: Mapping[str, bool] | None = None,
) -> Plan:
    """Look at the scene for a moment and decide what to simulate; ``forced`` overrides effects by name."""
    check_accuracy(accuracy)
    evidence = pilot.measure(bench, labels, weights, accuracy, seed)
    return decide(accuracy, evidence, len(weights), scene_facts(bench), forced)


def scene_facts(bench: Bench) -> SceneFacts:
    """What the plan says of a bench's devices."""
    geometry, projector = bench.geometry, bench.projector
    fresnel = geometry.fresnel_number(projector.effective_wavelength_nm)
    warnings = []
    if bench.field_stop_cuts:
        warnings.append(
            "the field stop (fov) cuts into the projector's window for part of the sensor; its edge is blurred over "
            "the anchors, so open it or accept an error there"
        )
    if geometry.wall_shift_features >= 1:
        warnings.append(
            f"mask_thickness {geometry.mask_thickness} mm shifts the far face by {geometry.wall_shift_features:.1f} "
            "features at the field stop; the two-face model holds below 1"
        )
    longest = float(bench.spectrum.wavelengths_nm.max())
    if geometry.mask_feature * 1e6 < longest:
        warnings.append(
            f"mask_feature {geometry.mask_feature:g} mm is below the wavelength of {longest:.0f} nm; scalar theory of "
            "masks needs features above it, so the shadow is a guess"
        )
    return SceneFacts(
        absent={
            "mirrors": "no surface reflects or transmits light in single directions",
            "ambient": "the projector is the only emitter",
            "mask-thickness": "the mask is thin",
            "pixel-response": "pixels are fully sensitive, whatever the angle",
            "aperture": "the projector is a pinhole: sharp at all distances",
            "blur": "the projector's pixels are sharp",
            "black-level": "the projector's black is black",
            "speckle": "the projector file gives no speckle contrast",
        },
        notes={
            "diffraction": f"a mask feature's Fresnel number is {fresnel:.1f} at "
            f"{projector.effective_wavelength_nm:.0f} nm, {len(bench.spectrum.weights)} line(s)",
            "ambient": f"{len(bench.loaded.lamps)} emitter(s) beside the projector",
        },
        keystone=bench.loaded.pixels.keystone,
        warnings=tuple(warnings),
    )


@single_threaded_blas()
def collect(
    bench: Bench,
    plan: Plan,
    labels: Labels,
    weights: FloatArray,
    seed: int,
    progress: Progress = silent,
    purpose: str = "scene",
    by_pixel: bool = True,
    target: Target | None = None,
) -> Light:
    """Trace until the Monte Carlo error of the frames meets the plan's target, or the limit of 2^32 paths.

    Each group gets the same number of samples; a few captures, evenly spread, are formed to see the error. ``purpose``
    names the random streams: light for two purposes shares none. ``by_pixel`` keeps the light of every projector pixel
    apart, for other families than this one. ``target`` gives the error to stop at from the frames seen so far, where
    the plan's own is not wanted.
    """
    simulation = Simulation(bench, plan.settings)
    kept = np.arange(bench.n**2) if by_pixel else labels
    chosen = np.unique(np.linspace(0, len(weights) - 1, min(len(weights), _CHECKED_CAPTURES)).astype(int))
    groups = [_Group(simulation, kept, integer(seed, "transport", purpose, group)) for group in range(GROUPS)]
    rounds = _FIRST_ROUND
    while True:
        for group in groups:
            group.sample(rounds)
        light = Light(
            groups=tuple(group.light for group in groups),
            simulation=simulation,
            labels=kept,
            flux=np.asarray(sum(group.flux for group in groups) / GROUPS),
            paths=sum(group.paths for group in groups),
            sampling_error=math.inf,
            reached=False,
        )
        expected = light.frames(labels, weights[chosen], seed)
        error = relative_error(expected)
        goal = target(expected) if target else plan.sampling_target
        progress("transport", min(1.0, (goal / error) ** 2) if error > 0 else 1.0)
        if error <= goal or light.paths >= _MOST_PATHS:
            return replace(light, sampling_error=error, reached=error <= goal)
        # Indirect light's error falls with the square root of the samples; direct light's falls faster.
        rate = 1.6 if simulation.indirect or simulation.other else 1.2
        rounds *= min(max(1.05 * (error / goal) ** rate, 1.1), _LARGEST_GROWTH)


class _Group:
    """One independent estimate of the light: the sum over its samples so far."""

    def __init__(self, simulation: Simulation, labels: Labels, seed: int) -> None:
        self.simulation, self.labels = simulation, labels
        self.seed = seed
        self.done: dict[str, int] = {}
        self.paths = 0
        self._sums: dict[str, Estimate] = {}
        self._flux = np.zeros(simulation.bench.n**2)

    def sample(self, rounds: float) -> None:
        """Trace until this many times the samples that the plan predicted are done."""
        for name, stage in self.simulation.tracers().items():
            wanted, seed = max(math.ceil(rounds * stage.predicted), 1), integer(self.seed, name)
            while (done := self.done.get(name, 0)) < wanted:
                count = min(max(1, _LANES_AT_ONCE // stage.tracer.lanes), wanted - done)
                found = stage.tracer.trace(seed, done, count)
                light = stage.file(found, self.labels, 1)
                self._sums[name] = self._sums[name] + light if name in self._sums else light
                if name == "direct":
                    self._flux += self.simulation.flux(found, 1)
                self.done[name] = done + count
                self.paths += count * stage.tracer.lanes

    @property
    def light(self) -> Estimate:
        """Mean over the samples."""
        return reduce(add, (light / self.done[name] for name, light in self._sums.items()))

    @property
    def flux(self) -> FloatArray:
        """(n^2,) mean over the samples."""
        return self._flux / self.done["direct"]


def speckle_of(bench: Bench, plan: Plan) -> float:
    """Speckle contrast of frames under a plan; 0 where the effect is off."""
    return bench.projector.speckle_contrast if "speckle" in plan.settings.effects else 0.0


def uniform_light(n: int) -> tuple[Labels, FloatArray]:
    """Labels and weights of one capture with every projector pixel fully lit."""
    return np.zeros(n * n, dtype=np.int64), np.ones((1, 1))


def pinhole_view(bench: Bench, board_reflectance: float, seed: int) -> FloatArray:
    """(rows, columns) apparent reflectance seen from the sensor's centre under uniform light, for people to look at.

    Direct light, two cells a side of a projector pixel; 0 where the projector does not light the board.
    """
    settings = Settings(depth=bench.geometry.scene_distance)

    def seen(which: Bench) -> FloatArray:
        simulation = Simulation(which, settings, pixels=2 * bench.n)
        found = simulation.direct.trace(integer(seed, "view"), 0, _VIEW_SAMPLES)
        light = simulation.file(found, np.zeros(bench.n**2, dtype=np.int64), 1).fine[[0]].toarray()
        return np.asarray(light).reshape(simulation.bundle.cells)

    scene, board = seen(bench), seen(bench.with_board(board_reflectance))
    return np.asarray(np.divide(scene, board, out=np.zeros(scene.shape), where=board > 0))
