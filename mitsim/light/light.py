"""Light of a scene, sampled to an accuracy, with its frames and their error."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial, reduce
from itertools import product
from operator import add
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import sparse

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import Physics, names
from mitsim.bench.layout import before_board
from mitsim.core.arrays import PACKED, FloatArray, Labels, mean_of_neighbours, whole_hdf5
from mitsim.core.errors import MitsimError, check_arguments
from mitsim.core.job import Progress, silent
from mitsim.core.parallel import Behind, single_threaded_blas
from mitsim.core.seeds import integer
from mitsim.devices.patterns import Lighting, PatternFamily
from mitsim.devices.session import load_recipe
from mitsim.light import cost_model
from mitsim.light.passes import EVEN, GRIDS, PASSES, Grid, LightEstimate, Simulation, even, expected_of
from mitsim.light.plan import Plan
from mitsim.light.settings import GROUPS, MOST_PATHS, PATHS_AT_ONCE, Estimate, Settings
from mitsim.optics.frames import ExpectedFrames, bound_of
from mitsim.optics.image_formation import anchor_positions, anchor_weights
from mitsim.optics.terms import shadow_terms
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.transport.direct import FluxTracer, IntArray
from mitsim.transport.path_reuse import PathReuseTracer
from mitsim.transport.records import DeviceSums, PathSamples
from mitsim.version import __version__

if TYPE_CHECKING:
    import h5py

# -------- Truth: the apparent reflectance that a perfect reconstruction shows, with its standard error
#
# It is each projector pixel's flux of direct light toward the sensor over that of the calibration board, with its own
# random streams, so that an error of the frames is never an error of the truth.

_FINEST = 1e-4
_BOARD_PART = 0.5
_RATE = 2.0
"""Power of the samples with which a pixel's variance falls: 1 random, 2 about an edge, 3 over smooth light."""
_ANYWHERE = 0.01
_AIM = 0.98
_DOUBLINGS, _AT_ONCE = 8, 4


@dataclass(frozen=True, eq=False)
class Truth:
    reflectance: FloatArray
    standard_error: FloatArray
    board_flux: FloatArray
    rays: int

    @property
    def error(self) -> float:
        return float(np.sqrt(np.square(self.standard_error).mean()))

    def error_of(self, flux_error: FloatArray) -> float:
        """Return the rms error that sampling leaves in any image, from the frames' ``flux_error`` (n^2,)."""
        return float(_rms(_over(flux_error, self.board_flux)))


def trace_truth(bench: Apparatus, settings: Settings, seed: int, flux_error: FloatArray) -> Truth:
    """Trace until the truth's standard error, rms over the image, is a sixth of the frames', or 1e-4.

    ``flux_error`` (n^2,) is the standard error of each projector pixel's direct light in the frames [W m^-2].
    """
    (truth,) = trace_truths(bench, settings, seed, flux_error[None])
    return truth


def trace_truths(bench: Apparatus, settings: Settings, seed: int, flux_errors: FloatArray) -> list[Truth]:
    effects = names(lambda effect: effect.in_truth) & settings.effects
    white = before_board(bench, load_recipe().board_reflectance)
    board = _Flux(white, effects, seed, "board", cost_model.BOARD_SAMPLES)
    unit = board.mean
    target = np.maximum(cost_model.TRUTH_PART * _rms(_over(flux_errors, unit)), _FINEST)
    board.refine(unit, _BOARD_PART * target, np.ones(unit.shape[1]))
    scene = _Flux(bench, effects, seed, "scene", cost_model.TRUTH_SAMPLES)
    likely = np.square(_over(flux_errors, unit)).sum(axis=0)
    scene.refine(unit, float(np.sqrt(1 - _BOARD_PART**2)) * target, likely)
    reflectance = _over(scene.mean, board.mean)
    error = np.hypot(_over(scene.standard_error, board.mean), reflectance * _over(board.standard_error, board.mean))
    shape, rays = (bench.n, bench.n), scene.rays + board.rays
    lines = zip(reflectance, error, board.mean, strict=True)
    return [Truth(own.reshape(shape), its.reshape(shape), flux, rays) for own, its, flux in lines]


class _Flux:
    def __init__(self, bench: Apparatus, effects: frozenset[str], seed: int, name: str, samples: int) -> None:
        physics, loaded, pixels = Physics.with_effects(bench, effects), bench.loaded, bench.n**2
        setup = replace(bench.setup, projector=physics.projector, geometry=physics.geometry)
        self._tracer = FluxTracer(setup, loaded.glossy)
        self._seed = integer(seed, "truth", name)
        lines = len(bench.lines.shares) if physics.projector.by_line and bench.lines else 1
        self._sums, self._samples = np.zeros((lines, cost_model.TRUTH_GROUPS, pixels)), np.zeros(pixels, np.int64)
        self._shape, self._first = (bench.n, bench.n), samples
        self._sample(np.full(pixels, samples))

    @property
    def rays(self) -> int:
        return int(cost_model.TRUTH_GROUPS * self._samples.sum())

    @property
    def mean(self) -> FloatArray:
        return np.asarray(self._sums.mean(axis=1) / self._samples)

    @property
    def standard_error(self) -> FloatArray:
        return np.asarray(self._sums.std(axis=1, ddof=1) / self._samples / np.sqrt(cost_model.TRUTH_GROUPS))

    def refine(self, unit: FloatArray, target: FloatArray, likely: FloatArray) -> None:
        """Trace more where that reduces the error most, until every line meets its target or needs too many rays.

        ``likely`` (n^2,) has variances from other knowledge, because a pixel whose samples happen to agree would get no
        more.
        """
        # An edge goes on in the next pixel, where all samples so far may have missed it.
        likely = likely + mean_of_neighbours(likely.reshape(self._shape)).ravel()
        likely += _ANYWHERE * likely.mean() or 1.0
        most = max(cost_model.MOST_RAYS, cost_model.MOST_SAMPLES * len(unit)) // cost_model.TRUTH_GROUPS
        while ((error := _rms(_over(self.standard_error, unit))) > target).any():
            part = float(np.square(_AIM * target / np.maximum(error, np.finfo(float).tiny)).min())
            # The doublings that reduce the variance most for their rays come first.
            samples, doublings = self._samples, np.arange(_DOUBLINGS)
            left = (likely * (samples / self._first) ** -_RATE)[:, None] * 2.0 ** (-_RATE * doublings)
            gain, cost = (1 - 2.0**-_RATE) * left, samples[:, None] * 2.0**doublings
            best = np.argsort(-(gain / cost), axis=None, kind="stable")
            enough = int(np.searchsorted(np.cumsum(gain.ravel()[best]), (1 - part) * left[:, 0].sum())) + 1
            affordable = int(np.searchsorted(np.cumsum(cost.ravel()[best]), most - samples.sum(), side="right"))
            made = np.bincount(best[: min(enough, affordable)] // _DOUBLINGS, minlength=len(likely))
            if not made.any():
                return
            self._sample(np.asarray(samples << np.minimum(made, _AT_ONCE)))

    def _sample(self, wanted: IntArray) -> None:
        pixels = np.flatnonzero(wanted > self._samples)
        done, more = self._samples[pixels], (wanted - self._samples)[pixels]
        block = int(np.gcd.reduce(more))
        blocks = more // block
        place = np.repeat(np.arange(len(pixels)), blocks)
        within = np.arange(len(place)) - np.repeat(np.cumsum(blocks) - blocks, blocks)
        starts = done[place] + block * within
        light = self._tracer.sums(self._seed, cost_model.TRUTH_GROUPS, pixels[place], starts, block)
        for groups, parts in zip(self._sums, light, strict=True):
            for sums, part in zip(groups, parts, strict=True):
                sums += np.bincount(pixels[place], part, len(sums))
        self._samples = wanted


def _over(flux: FloatArray, unit: FloatArray) -> FloatArray:
    return np.divide(flux, unit, out=np.zeros_like(flux), where=unit > 0)


def _rms(values: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.square(values).mean(axis=-1)))


# -------- Light of a scene

_TOLD, _OF_HEAVY = 1.2, 0.55
"""Ratio of bound and error beyond which few heavy paths dominate both; the bound then falls with power 0.8 to 0.93."""
_LOST = 0.1
"""Part of the accuracy that light beyond all cells may use; a hundredth of the pixels may have all of it."""
_BY_CHANCE = 1.5
"""Ratio of variances over 49 and 16 shots that four groups of equal shots exceed once in fifty (20000 trials)."""


@dataclass(frozen=True)
class Sampling:
    """Options of sampling; lights for two purposes share no random streams.

    ``excess`` returns a ratio of errors: frames that contain all lines, over frames of single lines.
    """

    purpose: str = "scene"
    by_pixel: bool = True
    excess: Callable[[Sequence[SampledLight]], float] | None = None


@dataclass(frozen=True, eq=False)
class FrameCheck:
    groups: tuple[LightEstimate, ...]
    simulation: Simulation
    rows: Labels
    probed: FloatArray


@dataclass(frozen=True, eq=False)
class SampledLight:
    """Sampled light of one scene, in independent groups.

    ``labels`` (n^2,) is the row of each projector pixel: its class, or the pixel itself if any family is to be formed.
    ``flux`` (n^2,) is the mean irradiance over the sensor of each pixel's direct light without the mask. ``restated``
    multiplies the Monte Carlo error from the groups' differences, because sampling stops where these happen to be
    small.
    """

    groups: tuple[LightEstimate, ...]
    simulation: Simulation
    plan: Plan
    seed: int
    labels: Labels
    flux: FloatArray
    flux_error: FloatArray
    paths: int
    sampling_error: float
    reached: bool
    samples: Mapping[str, int] = field(default_factory=dict)
    looked: FrameCheck | None = None
    known_truth: Truth | None = None
    restated: float = 1.0

    def __repr__(self) -> str:
        return f"SampledLight({self.paths:.2g} paths, relative error {self.sampling_error:.1e}, of {self.bench!r})"

    @property
    def lost(self) -> float:
        outside = sum(group.outside for group in self.groups)
        return outside / sum(group.received for group in self.groups) if outside else 0.0

    @property
    def warnings(self) -> tuple[str, ...]:
        if self.lost <= _LOST * self.plan.accuracy:
            return self.plan.warnings
        return (
            *self.plan.warnings,
            f"{self.lost:.1e} of the light is missing in the frames, because it comes from directions outside the "
            "plan: at the edge of the view, surfaces are nearer than the pilot measured; widen the projector's "
            "window, or move these surfaces",
        )

    @property
    def unreached(self) -> tuple[str, ...]:
        if self.reached:
            return ()
        return (f"sampling stopped at {self.sampling_error:.1e}; the accuracy {self.plan.accuracy:g} was not reached",)

    @property
    def error_bound(self) -> float:
        """Return the upper limit (95 %) of the frames' relative error from sampling and from the plan's omissions."""
        target = self.plan.sampling_target
        sampling = max(self.sampling_error, target) if self.reached else self.sampling_error
        return self.plan.total(Estimate(self.sampling_error, sampling)).bound

    @property
    def bench(self) -> Apparatus:
        return self.simulation.bench

    def frames(self, lighting: Lighting, seed: int, leaking: bool = True) -> ExpectedFrames:
        """Return the expected frames of some shots; raise ValueError if they split a class of the light."""
        rows = self.rows_of(lighting)
        known, probed = self.looked, None
        if known and seed == self.seed and self.groups is known.groups and self.simulation is known.simulation:
            alike = len(known.probed) == lighting.weights.shape[1] and np.array_equal(rows, known.rows)
            probed = known.probed if alike else None
        return expected_of([(self.simulation, self.groups)], rows, lighting, seed, leaking, probed, self.restated)

    @check_arguments
    def rows_of(self, lighting: Lighting) -> Labels:
        rows = np.zeros(int(self.labels.max()) + 1, dtype=np.int64)
        rows[self.labels] = lighting.labels
        if not np.array_equal(rows[self.labels], lighting.labels):
            raise ValueError("the light was traced for another family of patterns")
        return rows

    def summary(self) -> dict[str, Any]:
        return {
            "n": self.bench.n,
            "shape": list(self.bench.geometry.frame_shape),
            "entries": sum(light.nnz for group in self.groups for light in group.light.values()),
            "accuracy": self.plan.accuracy,
            "mc_error": self.sampling_error,
            "total_error_bound": self.error_bound,
            "lost_light": self.lost,
            "paths": self.paths,
            "seed": self.seed,
            "variant": self.bench.variant,
            "warnings": [*self.warnings, *self.unreached],
        }

    @check_arguments
    def behind(self, bench: Apparatus) -> SampledLight:
        return replace(self, simulation=Simulation(bench, self.simulation.settings))

    @check_arguments
    def speckle(self, family: PatternFamily | None = None) -> float:
        """Return the contrast of speckle in frames of a family (None for a white picture); 0 if speckle is off."""
        return self.bench.speckle(family) if self.simulation.physics.speckle else 0.0

    def merge(self) -> SampledLight:
        return replace(self, groups=(reduce(add, self.groups) / len(self.groups),))

    @cached_property
    def apparent(self) -> Truth:
        return self.known_truth or trace_truth(self.bench, self.plan.settings, self.seed, self.flux_error)

    @property
    def truth(self) -> FloatArray:
        """Return the apparent reflectance (n, n), where a calibration board of reflectance 0.99 counts as 1."""
        return self.apparent.reflectance


# -------- Tracing until the error meets its target


def trace_light(
    bench: Apparatus,
    plan: Plan,
    lighting: Lighting,
    seed: int,
    sampling: Sampling | None = None,
    progress: Progress = silent,
) -> SampledLight:
    (light,) = trace_lines(bench, (bench,), plan, lighting, seed, sampling, progress)
    return light


@single_threaded_blas()
def trace_lines(
    bench: Apparatus,
    benches: Sequence[Apparatus],
    plan: Plan,
    lighting: Lighting,
    seed: int,
    sampling: Sampling | None = None,
    progress: Progress = silent,
) -> list[SampledLight]:
    """Trace each line's light from shared paths until the frames of every line meet the target."""
    sampling = sampling or Sampling()
    simulation = Simulation(bench, plan.settings)
    own = [simulation if each is bench else Simulation(each, plan.settings) for each in benches]
    for each in own[1:]:
        each.by_band = own[0].by_band  # lamps' light diffracts beside each line alike: its optics are prepared once
    labels = np.arange(bench.n**2) if sampling.by_pixel else lighting.labels
    followed = any(not each.row.even for each in simulation.passes.values())
    groups = Group.all_of(simulation, labels, seed, sampling.purpose, len(benches))
    samples, reached, predicted = first_samples(simulation), 0.0, dict[int, float]()
    while True:

        def report(part: float, before: float = reached) -> None:
            progress("transport", before + (1 - before) * part)

        trace_groups(groups, samples, report)
        lines = [_line_of(groups, line, each, plan, seed) for line, each in enumerate(own)]
        last = lines[0].paths >= MOST_PATHS
        target = plan.sampling_target
        enough = math.inf if last or sampling.excess else target
        noise = [float(np.square(light.flux_error).sum() / (np.square(light.flux).sum() or 1.0)) for light in lines]
        checks = dict[int, _Check]()
        for line in sorted(range(len(lines)), key=lambda line: -noise[line]):  # until one is not good enough
            parts = {name: [group.part(name, line) for group in groups] for name in groups[0].done}
            checks[line] = _check(lines[line], parts, lighting, followed, predicted.get(line, 0.0))
            if checks[line].bound > enough:
                break
        lights, near, worst, excess = dict[int, SampledLight](), 1.0, 0, 0.0
        more = sampling.excess([checks[line].light for line in sorted(checks)]) if sampling.excess else 1.0
        for line, check in checks.items():
            light, error = check.light, check.light.sampling_error
            seen = more * check.bound
            lights[line] = replace(light, reached=seen <= target)
            beyond = seen / target  # by which the next round must lower the error
            if followed:  # Of direct light no path is heavy.
                beyond = min(beyond, max(_TOLD * more * error / target, math.pow(beyond, _OF_HEAVY)))
            if seen > target and beyond > excess:
                worst, excess = line, beyond
            near = min(near, (target / seen) ** 2 if seen > 0 else 1.0)
        progress("transport", near)
        if last or all(light.reached for light in lights.values()):
            return [lights[line] for line in range(len(own))]
        done, samples = samples, next_samples(simulation, samples, checks[worst].variances, excess)
        reached = near
        predicted = {
            line: check.light.sampling_error * error_left(done, samples, check.variances)
            for line, check in checks.items()
        }
        # Results that the next round replaces are released first, because new memory is expensive.
        del lines, checks, check, lights, light


@single_threaded_blas()
def traced_again(light: SampledLight, simulation: Simulation) -> SampledLight:
    groups = Group.all_of(simulation, light.labels, light.seed, "scene")
    trace_groups(groups, light.samples)
    estimates = tuple(group.light() for group in groups)
    return replace(light, groups=estimates, simulation=simulation, flux=np.mean(_flux(estimates, light.flux), axis=0))


def _line_of(groups: Sequence[Group], line: int, simulation: Simulation, plan: Plan, seed: int) -> SampledLight:
    estimates = tuple(group.light(line) for group in groups)
    flux = _flux(estimates, np.zeros(simulation.bench.n**2))
    return SampledLight(
        groups=estimates,
        simulation=simulation,
        plan=plan,
        seed=seed,
        labels=groups[0].labels,
        flux=np.mean(flux, axis=0),
        flux_error=np.std(flux, axis=0, ddof=1) / GROUPS**0.5,
        paths=sum(group.paths for group in groups),
        sampling_error=math.inf,
        reached=False,
        samples=dict(groups[0].done),
    )


def _flux(estimates: Sequence[LightEstimate], like: FloatArray) -> list[FloatArray]:
    return [np.zeros_like(like) if each.flux is None else each.flux for each in estimates]


# -------- Checks of the error, by the frames of some shots


@dataclass(frozen=True)
class _Check:
    light: SampledLight
    bound: float
    variances: Mapping[str, float]


def _check(
    light: SampledLight,
    parts: Mapping[str, Sequence[LightEstimate]],
    lighting: Lighting,
    followed: bool,
    predicted: float,
) -> _Check:
    shots, classes = lighting.weights.shape
    whole = cost_model.tells_all(classes, shots, light.bench.geometry.frame_side)
    seen = lighting if whole else _some(lighting, cost_model.MOST_CHECKED if followed else cost_model.CHECKED_SHOTS)
    # What black pixels leak moves the error as little as the frames, and would make every shot a sum of all light.
    each = [(light.simulation, groups) for groups in parts.values()]
    expected = expected_of(each, light.rows_of(seen), seen, light.seed, leaking=False)
    more = _error_growth(light, lighting, seen)
    error, bound = (ratio * of_seen for ratio, of_seen in zip(more, expected.sampling_error(), strict=True))
    restated = math.sqrt((1 + max(predicted / error, 1.0) ** 2) / 2) if error else 1.0
    light, bound = replace(light, sampling_error=restated * error, restated=restated), restated * bound
    if whole and expected.probed is not None:
        found = FrameCheck(light.groups, light.simulation, light.rows_of(lighting), expected.probed)
        light = replace(light, looked=found)
    by_part = np.concatenate([each.reshape(len(parts), -1, GROUPS, GROUPS) for each in expected.noise], axis=1)
    variances = dict(zip(parts, np.einsum("plgg->p", by_part).tolist(), strict=True))
    if not whole:
        for name, groups in parts.items():
            more_of_part, _ = _error_growth(replace(light, groups=tuple(groups)), lighting, seen)
            variances[name] *= more_of_part**2
    return _Check(light, bound, variances)


def _some(lighting: Lighting, count: int) -> Lighting:
    shots = len(lighting.weights)
    return lighting.shots(np.unique(np.linspace(0, shots - 1, min(shots, count)).astype(int)))


def _error_growth(light: SampledLight, lighting: Lighting, checked: Lighting) -> tuple[float, float]:
    """Return the growth of the error, and of its bound, from the checked shots to all shots.

    The groups' differences in total light show a heavy path that no checked shot sees.
    """
    rows = np.zeros(int(light.labels.max()) + 1, dtype=np.int64)
    rows[light.labels] = lighting.labels
    totals = np.array(
        [np.bincount(rows, group.totals[: len(rows)], lighting.weights.shape[1]) for group in light.groups]
    )
    totals -= totals.mean(axis=0)
    of_shots = [totals @ shots.weights.T for shots in (lighting, checked)]
    every, some = (np.einsum("gs,hs->gh", each, each) / each.shape[1] for each in of_shots)
    if not some.any():
        return 1.0, 1.0
    ratios = np.trace(every) / np.trace(some), (bound_of(every, 1.0) / bound_of(some, 1.0)) ** 2
    error, bound = (math.sqrt(max(ratio / _BY_CHANCE, 1.0)) for ratio in ratios)
    return error, bound


# -------- Independent estimates

Accumulation = Callable[[], None]


class Group:
    def __init__(self, simulation: Simulation, labels: Labels, seed: int, lines: int = 1) -> None:
        self.simulation, self.labels = simulation, labels
        self.seed, self._lines = seed, lines
        self.done: dict[str, int] = {}
        self.paths = 0
        self._means: list[dict[str, LightEstimate]] = [{} for _ in range(lines)]

    @classmethod
    def all_of(cls, simulation: Simulation, labels: Labels, seed: int, purpose: str, lines: int = 1) -> list[Group]:
        return [cls(simulation, labels, integer(seed, "transport", purpose, group), lines) for group in range(GROUPS)]

    def trace(self, wanted: Mapping[str, int], accumulating: Behind[Accumulation]) -> None:
        at_once = min(PATHS_AT_ONCE, self.simulation.paths_at_once)
        for name, each in self.simulation.passes.items():
            samples = wanted.get(name, 0)
            if self.done.get(name, 0) >= samples:
                continue
            seed = integer(self.seed, each.row.stream)
            accumulator = self.simulation.accumulator(name, self.labels, self._lines)
            if name in self.done:
                accumulating.wait()
                for means in self._means:
                    means[name] /= samples / self.done[name]
            while (done := self.done.get(name, 0)) < samples:
                count = min(max(1, at_once // each.tracer.paths_per_sample), samples - done)
                path_samples = each.trace(seed, done, count, accumulator)
                self._give(accumulating, name, path_samples.by_line(self._lines), samples)
                self.done[name] = done + count
                self.paths += count * each.tracer.paths_per_sample
            if accumulator is not None:
                self._give(accumulating, name, accumulator.fetch(), samples)

    def _give(
        self, accumulating: Behind[Accumulation], name: str, by_line: Sequence[PathSamples | DeviceSums], samples: int
    ) -> None:
        def add(line: int, found: PathSamples | DeviceSums) -> None:
            means, light = self._means[line], self.simulation.accumulate(name, found, self.labels, samples)
            means[name] = means[name] + light if name in means else light

        accumulating.give([partial(add, line, light) for line, light in enumerate(by_line)])

    def light(self, line: int = 0) -> LightEstimate:
        return reduce(add, self._means[line].values())

    def part(self, name: str, line: int = 0) -> LightEstimate:
        return self._means[line][name]


def trace_groups(
    groups: Sequence[Group], wanted: Mapping[str, int], report: Callable[[float], None] = lambda part: None
) -> None:
    with Behind[Accumulation](lambda accumulation: accumulation()) as accumulating:
        for number, group in enumerate(groups):
            if number:
                report(number / len(groups))
            group.trace(wanted, accumulating)
        accumulating.wait()


# -------- Samples of the next round: from the variance that each pass leaves, and its cost

_LARGEST_GROWTH = 8
_LEAST_LESS, _MOST_LESS = 1.1, 6.0
"""Least and largest reduction of the variance in a round: each costs a check, and the first know their error badly."""
_BEYOND = 1.05
"""Variance permitted by the error over the aim, so that another round is rare."""
_UNEVEN = 1.2
"""Variance of 3 * 2^k samples over that interpolated from 2^k (measured: 0.49 to 0.70; 0.36 for doubling)."""
_FIRST = 0.8
"""Part of the predicted samples in the first round of followed light; at 0.7 the corner needed a second round."""


def first_samples(simulation: Simulation) -> dict[str, int]:
    paths = {
        name: int(PASSES[name].whole(each.predicted)) * each.tracer.paths_per_sample
        for name, each in simulation.passes.items()
    }
    followed = sum(count for name, count in paths.items() if name not in EVEN)
    part = _FIRST if followed > sum(paths.values()) / 2 else 1.0
    return {name: int(PASSES[name].whole(part * each.predicted)) for name, each in simulation.passes.items()}


def next_samples(
    simulation: Simulation, done: Mapping[str, int], variances: Mapping[str, float], excess: float
) -> dict[str, int]:
    work = {
        name: PASSES[name].unit_cost
        * each.tracer.paths_per_sample
        * (cost_model.SHARED_COST if isinstance(each.tracer, PathReuseTracer) else 1)
        for name, each in simulation.passes.items()
    }
    lights = [SampledPass(name, count, variances[name], work[name]) for name, count in done.items()]
    # A target that was set very low would overflow the square.
    less = max(_BEYOND * min(excess, _MOST_LESS) ** 2, _LEAST_LESS)
    return cheapest_samples(lights, sum(variances.values()) / min(less, _MOST_LESS))


def error_left(done: Mapping[str, int], samples: Mapping[str, int], variances: Mapping[str, float]) -> float:
    left = [SampledPass(name, done[name], variances[name], 1.0).variance_left(samples[name]) for name in done]
    return math.sqrt(sum(left) / (sum(variances.values()) or 1.0))


@dataclass(frozen=True)
class SampledPass:
    name: str
    done: int
    variance: float
    work: float

    def variance_left(self, samples: int) -> float:
        rate = PASSES[self.name].variance_rate
        if rate == 1:
            return self.variance * self.done / samples
        after, before = (
            float(count**-rate) * (1.0 if count & (count - 1) == 0 else _UNEVEN) for count in (samples, self.done)
        )
        return self.variance * after / before

    @property
    def gain(self) -> float:
        return self.variance / (self.done * self.work)

    @property
    def steps(self) -> list[int]:
        found = [self.done]
        while (following := int(even(found[-1] + 1.0))) <= _LARGEST_GROWTH * self.done:
            found.append(following)
        return found


def cheapest_samples(lights: Sequence[SampledPass], allowed: float) -> dict[str, int]:
    stepped = [light for light in lights if light.name in EVEN]
    others = [light for light in lights if light.name not in EVEN]
    best, least = {light.name: light.steps[-1] for light in stepped}, math.inf
    best |= {light.name: _LARGEST_GROWTH * light.done for light in others}
    for counts in product(*(light.steps for light in stepped)):
        left = allowed - sum(light.variance_left(count) for light, count in zip(stepped, counts, strict=True))
        shared = _shared_out(others, left)
        if shared is None:
            continue
        found = {light.name: count for light, count in zip(stepped, counts, strict=True)} | shared
        work = sum(light.work * (found[light.name] - light.done) for light in lights)
        if work < least:
            best, least = found, work
    return {light.name: best[light.name] for light in lights}


def _shared_out(lights: Sequence[SampledPass], allowed: float) -> dict[str, int] | None:
    """Return the cheapest samples if any number serves.

    By Lagrange, samples that grow go with sqrt(variance of one / work of one).
    """
    found = {light.name: light.done for light in lights}
    if sum(light.variance for light in lights) <= allowed:
        return found
    resting, growing = sorted(lights, key=lambda light: light.gain), list[SampledPass]()
    while resting:
        growing.append(resting.pop())
        left = allowed - sum(light.variance for light in resting)
        if left <= 0:
            continue
        scale = sum(math.sqrt(light.variance * light.done * light.work) for light in growing) / left
        if not resting or scale**2 * resting[-1].gain <= 1:
            return found | {light.name: math.ceil(scale * math.sqrt(light.gain) * light.done) for light in growing}
    return None


# -------- Light by projector pixel in an HDF5 file, from which NumPy and SciPy form the frame of any pattern
#
# The file has sparse matrices for the light, and dense factors for the mask's shadow. docs/exchange.md has the layout.

LAYOUT, LAYOUT_OF_TWO_SIDES = 1, 2
"""The second version has separate weights of anchors for columns."""
_SPECULAR_BYTES = 2**31
"""Memory of frames of light over mirrors, one for each projector pixel."""


def write_light(path: Path, light: SampledLight) -> None:
    """Write light by projector pixel to one file as a whole.

    Raises MitsimError for light by class, too many projector pixels with light over mirrors, or an unwritable file.
    """
    count = light.bench.n**2
    if not np.array_equal(light.labels, np.arange(count)):
        raise MitsimError(f"file {path}: the light was traced for one family alone; trace it by pixel, by bench.light")
    specular = _specular(path, light)
    bench, plan, devices = light.bench, light.plan, light.bench.devices
    rows, columns = bench.geometry.frame_shape
    joule = electrons_from_irradiance(1.0, 1.0, devices.sensor, devices.projector.effective_wavelength_nm)
    facts = {
        "mitsim_transport": LAYOUT if bench.geometry.axes_alike else LAYOUT_OF_TWO_SIDES,
        "mitsim_version": __version__,
        "n": bench.n,
        **({"pixels": rows} if rows == columns else {}),
        "rows": rows,
        "columns": columns,
        "groups": len(light.groups),
        "black_level": light.simulation.physics.black_level,
        "electrons_per_j_m2": float(joule),
        "patterns": plan.request.patterns if plan.request else "",
        "accuracy": plan.accuracy,
        "seed": light.seed,
        "mc_error": light.sampling_error,
        "total_error_bound": light.error_bound,
        "lost_light": light.lost,
        "provenance": json.dumps({**bench.provenance(), **bench.identity()}, default=str),
        "warnings": json.dumps([*light.warnings, *light.unreached]),
    }
    with whole_hdf5(path) as file:
        file.attrs.update(facts)
        grids = file.create_group("light", track_order=True)
        for name, row in GRIDS.items():
            groups = [group[name][:count] for group in light.groups]
            if any(group.nnz for group in groups):
                place = grids.create_group(row.key, track_order=True)
                _write_matrix(place, sparse.csr_array(sparse.vstack(groups, format="csr")))
                _write_shadow(place, light.simulation.grids[name])
        if light.simulation.physics.lamps:
            frames = np.zeros((len(light.groups), rows, columns), np.float64)
            for accumulated in light.simulation.with_optics(light.groups, count)[1]:
                for frame, group in zip(frames, accumulated.groups, strict=True):
                    group.sort_indices()
                    frame += accumulated.optics.frame(group.indices, group.data)
            file.create_dataset("ambient", data=frames.astype(np.float32), **PACKED)
        if specular is not None:
            _write_matrix(file.create_group("glint", track_order=True), specular)


def _write_matrix(group: h5py.Group, matrix: sparse.csr_array) -> None:
    group.attrs["shape"] = matrix.shape
    parts = {"data": np.float32, "indices": np.int64 if matrix.shape[1] > 2**31 else np.int32, "indptr": np.int64}
    for name, kind in parts.items():
        group.create_dataset(name, data=getattr(matrix, name).astype(kind), **PACKED)


def _write_shadow(group: h5py.Group, grid: Grid) -> None:
    bundle, geometry, spectrum, _ = grid.key
    rows, columns = bundle.directions
    layers = [shadow_terms(geometry, rows, columns, depth, spectrum) for depth in bundle.depths]
    for side, name in enumerate(("left", "right")):
        factors = np.stack([[term[side] for term in terms] for terms in layers])
        group.create_dataset(name, data=factors.astype(np.float32), **PACKED)
    positions = anchor_positions(bundle.anchors, geometry.half_width)
    arrays = {
        "anchors": anchor_weights(positions, geometry.centres(0)),
        **({"column_anchors": anchor_weights(positions, geometry.centres(1))} if not geometry.axes_alike else {}),
        "rows": rows.centres,
        "columns": columns.centres,
        "depths_mm": np.array(bundle.depths),
    }
    for name, values in arrays.items():
        group.create_dataset(name, data=values)


def _specular(path: Path, light: SampledLight) -> sparse.csr_array | None:
    if not light.simulation.physics.mirrors:
        return None
    (rows, columns), count = light.bench.geometry.frame_shape, light.bench.n**2
    shining = len(np.unique(light.bench.specular.beams.pixel))
    if shining * rows * columns * 8 > _SPECULAR_BYTES:
        raise MitsimError(
            f"file {path}: {shining} projector pixels shine over mirrors, in frames of over {_SPECULAR_BYTES >> 30} "
            f"GiB at {rows}x{columns}; leave the mirror out, or take a sensor of fewer pixels"
        )
    found = light.simulation.specular_frames(light.labels)
    if found is None:
        return None
    lit = sparse.csr_array(found.irradiance.reshape(len(found.classes), -1))
    places = np.ones(len(found.classes)), (found.classes, np.arange(len(found.classes)))
    return sparse.csr_array(sparse.csr_array(places, shape=(count, len(found.classes))) @ lit)
