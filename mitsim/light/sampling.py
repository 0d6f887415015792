"""Independent estimates of the light, traced pass by pass in rounds.

A round adds samples where they reduce the variance most for their work. Work is counted at fixed paces, because the
same seed must give the same samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from itertools import product
from operator import add

from mitsim.core.arrays import Labels
from mitsim.core.parallel import Behind
from mitsim.core.seeds import integer
from mitsim.light.cost_model import SHARED_COST
from mitsim.light.grids import LightEstimate
from mitsim.light.passes import EVEN, PASSES, even
from mitsim.light.settings import GROUPS, PATHS_AT_ONCE
from mitsim.light.simulation import Simulation
from mitsim.transport.accumulator import DeviceSums
from mitsim.transport.path_reuse import PathReuseTracer
from mitsim.transport.records import PathSamples

# -------- Independent estimates

Accumulation = Callable[[], None]


class Group:
    """One independent estimate of the light by line and pass: the mean over its samples so far."""

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
        """Trace until each pass has the wanted samples; `accumulating` adds light meanwhile."""
        at_once = min(PATHS_AT_ONCE, self.simulation.paths_at_once)
        for name, each in self.simulation.passes.items():
            samples = wanted.get(name, 0)
            if self.done.get(name, 0) >= samples:
                continue
            seed = integer(self.seed, each.row.stream)
            accumulator = self.simulation.accumulator(name, self.labels, self._lines)
            if name in self.done:
                accumulating.wait()
                self._spread(name, samples / self.done[name])
            while (done := self.done.get(name, 0)) < samples:
                count = min(max(1, at_once // each.tracer.paths_per_sample), samples - done)
                path_samples = each.trace(seed, done, count, accumulator)
                accumulating.give(self._accumulations(name, path_samples.by_line(self._lines), samples))
                self.done[name] = done + count
                self.paths += count * each.tracer.paths_per_sample
            if accumulator is not None:
                accumulating.give(self._accumulations(name, accumulator.fetch(), samples))

    def _accumulations(
        self, name: str, by_line: Sequence[PathSamples | DeviceSums], samples: int
    ) -> list[Accumulation]:
        return [partial(self._add, name, line, light, samples) for line, light in enumerate(by_line)]

    def _spread(self, name: str, growth: float) -> None:
        for means in self._means:
            means[name] /= growth

    def _add(self, name: str, line: int, found: PathSamples | DeviceSums, samples: int) -> None:
        means, light = self._means[line], self.simulation.accumulate(name, found, self.labels, samples)
        means[name] = means[name] + light if name in means else light

    def light(self, line: int = 0) -> LightEstimate:
        return reduce(add, self._means[line].values())

    def part(self, name: str, line: int = 0) -> LightEstimate:
        return self._means[line][name]


def trace_groups(
    groups: Sequence[Group], wanted: Mapping[str, int], report: Callable[[float], None] = lambda part: None
) -> None:
    """Trace and accumulate until all groups have the wanted samples."""
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
"""Variance of 3 * 2^k samples over that interpolated from 2^k (power 1.5): 0.49 to 0.70 measured, and 0.36 for doubling
(cookie_bag, metal_blade)."""
_FIRST = 0.8
"""Part of the predicted samples in the first round of followed light. At 0.7 the corner needed a second round, whose
check costs 4 to 17 % of the time."""


def first_samples(simulation: Simulation) -> dict[str, int]:
    part = _FIRST if _mostly_followed(simulation) else 1.0
    return {name: int(PASSES[name].whole(part * each.predicted)) for name, each in simulation.passes.items()}


def next_samples(
    simulation: Simulation, done: Mapping[str, int], variances: Mapping[str, float], excess: float
) -> dict[str, int]:
    """Return the samples of a group after the next round.

    `variances` are those by each pass, up to one factor; `excess` is the ratio by which the error must fall.
    """
    work = _work(simulation)
    lights = [SampledPass(name, count, variances[name], work[name]) for name, count in done.items()]
    # A target that was set very low would overflow the square.
    less = max(_BEYOND * min(excess, _MOST_LESS) ** 2, _LEAST_LESS)
    return cheapest_samples(lights, sum(variances.values()) / min(less, _MOST_LESS))


def error_left(done: Mapping[str, int], samples: Mapping[str, int], variances: Mapping[str, float]) -> float:
    """Return the ratio of the errors after and before more samples."""
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
        return self.variance * _of_even(samples, rate) / _of_even(self.done, rate)

    @property
    def gain(self) -> float:
        """Return the reduction of the variance by one more sample, over its work."""
        return self.variance / (self.done * self.work)

    @property
    def steps(self) -> list[int]:
        found = [self.done]
        while (following := int(even(found[-1] + 1.0))) <= _LARGEST_GROWTH * self.done:
            found.append(following)
        return found


def cheapest_samples(lights: Sequence[SampledPass], allowed: float) -> dict[str, int]:
    """Return the samples of least work whose joint variance is `allowed`, or all that a round may take."""
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

    By Lagrange, samples that grow go with sqrt(variance of one / work of one). A light whose next sample gains less
    rests.
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


def _of_even(samples: int, rate: float) -> float:
    return float(samples**-rate) * (1.0 if samples & (samples - 1) == 0 else _UNEVEN)


def _work(simulation: Simulation) -> dict[str, float]:
    return {
        name: PASSES[name].unit_cost
        * each.tracer.paths_per_sample
        * (SHARED_COST if isinstance(each.tracer, PathReuseTracer) else 1)
        for name, each in simulation.passes.items()
    }


def _mostly_followed(simulation: Simulation) -> bool:
    paths = {
        name: int(PASSES[name].whole(each.predicted)) * each.tracer.paths_per_sample
        for name, each in simulation.passes.items()
    }
    return sum(count for name, count in paths.items() if name not in EVEN) > sum(paths.values()) / 2
