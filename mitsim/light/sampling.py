"""Sampling: independent estimates of the light, traced pass by pass in rounds, and how many samples a round takes.

A further round buys what is missing where that takes least: light that brings much noise for its work grows, other
light stays as it is. Work is that of paths at fixed paces: the same seed must mean the same samples.
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
"""Adds light of one line to what a group has."""


class Group:
    """One independent estimate of the light, by line and pass: the mean over its samples so far.

    Parameters
    ----------
    simulation
        what is traced.
    labels
        (n^2,) class of each projector pixel.
    seed
        of its random streams.
    lines
        that share the paths.

    Attributes
    ----------
    done
        samples of each pass by its name.
    paths
        that were traced.
    """

    def __init__(self, simulation: Simulation, labels: Labels, seed: int, lines: int = 1) -> None:
        self.simulation, self.labels = simulation, labels
        self.seed, self._lines = seed, lines
        self.done: dict[str, int] = {}
        self.paths = 0
        self._means: list[dict[str, LightEstimate]] = [{} for _ in range(lines)]

    @classmethod
    def all_of(cls, simulation: Simulation, labels: Labels, seed: int, purpose: str, lines: int = 1) -> list[Group]:
        """Every group of a light.

        Parameters
        ----------
        simulation, labels, lines
            as for one.
        seed, purpose
            root of the random streams, and what names them.
        """
        return [cls(simulation, labels, integer(seed, "transport", purpose, group), lines) for group in range(GROUPS)]

    def trace(self, wanted: Mapping[str, int], accumulating: Behind[Accumulation]) -> None:
        """Trace until so many samples as are ``wanted`` of each pass by its name are done.

        Parameters
        ----------
        wanted
            samples.
        accumulating
            what light is accumulated by while the next is traced: that takes one processor, and a tracer waits for its
            last paths. All is there when it has been waited for.
        """
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
        """Make the light of a pass the mean over so many times the samples, of which no others are there yet."""
        for means in self._means:
            means[name] /= growth

    def _add(self, name: str, line: int, found: PathSamples | DeviceSums, samples: int) -> None:
        means, light = self._means[line], self.simulation.accumulate(name, found, self.labels, samples)
        means[name] = means[name] + light if name in means else light

    def light(self, line: int = 0) -> LightEstimate:
        """Mean over the samples, of a ``line``."""
        return reduce(add, self._means[line].values())

    def part(self, name: str, line: int = 0) -> LightEstimate:
        """The same of one pass by its ``name``, of a ``line``."""
        return self._means[line][name]


def trace_groups(
    groups: Sequence[Group], wanted: Mapping[str, int], report: Callable[[float], None] = lambda part: None
) -> None:
    """Trace until all groups have as many samples as are wanted, accumulated.

    Parameters
    ----------
    groups, wanted
        what is traced, and samples of each pass by its name.
    report
        is called with the part that is traced, between groups.
    """
    with Behind[Accumulation](lambda accumulation: accumulation()) as accumulating:
        for number, group in enumerate(groups):
            if number:
                report(number / len(groups))
            group.trace(wanted, accumulating)
        accumulating.wait()


# -------- Samples of the next round: from the variance that each pass leaves, and its cost

_LARGEST_GROWTH = 8
"""Most that samples of even numbers grow by in one round."""
_LEAST_LESS, _MOST_LESS = 1.1, 6.0
"""By how much a round lowers the variance, as a ratio: least, as each costs a look; and most, because the first rounds
know their error badly."""
_BEYOND = 1.05
"""Variance that the error asks for over what is aimed at, so that another round is rare."""
_UNEVEN = 1.2
"""Variance of 3 * 2^k samples of direct light over what that of 2^k says, whose variance falls with their power 1.5: 24
to 32 samples left 0.49 to 0.58, 32 to 48 0.64 to 0.70, 32 to 64 0.36 (cookie_bag, metal_blade)."""
_FIRST = 0.8
"""Part of the samples that the plan predicts with which sampling begins where most paths are of followed light: the
prediction is safe. At 0.7 the corner needed a second round for the last tenth, by each of three seeds, which costs a
look more: 4 to 17 % of its processor seconds and of the cookie bag's."""


def first_samples(simulation: Simulation) -> dict[str, int]:
    """Samples of a group with which sampling begins in a ``simulation``, by the name of what is traced."""
    part = _FIRST if _mostly_followed(simulation) else 1.0
    return {name: int(PASSES[name].whole(part * each.predicted)) for name, each in simulation.passes.items()}


def next_samples(
    simulation: Simulation, done: Mapping[str, int], variances: Mapping[str, float], excess: float
) -> dict[str, int]:
    """Samples of a group after the next round, by the name of what is traced.

    Parameters
    ----------
    simulation
        whose light is traced.
    done
        samples so far.
    variances
        of the frames by each light, up to one factor.
    excess
        by how much the error is to be lowered, as a ratio.
    """
    work = _work(simulation)
    lights = [SampledPass(name, count, variances[name], work[name]) for name, count in done.items()]
    # A target that was set very low would overflow the square.
    less = max(_BEYOND * min(excess, _MOST_LESS) ** 2, _LEAST_LESS)
    return cheapest_samples(lights, sum(variances.values()) / min(less, _MOST_LESS))


def error_left(done: Mapping[str, int], samples: Mapping[str, int], variances: Mapping[str, float]) -> float:
    """Return the relative error that more samples leave of that which fewer left.

    Parameters
    ----------
    done, samples
        of a group before and after, by the name of the pass.
    variances
        that those done left, up to one factor.
    """
    left = [SampledPass(name, done[name], variances[name], 1.0).variance_left(samples[name]) for name in done]
    return math.sqrt(sum(left) / (sum(variances.values()) or 1.0))


@dataclass(frozen=True)
class SampledPass:
    """A pass by ``name``: samples ``done``, the variance that they leave, and the work of one."""

    name: str
    done: int
    variance: float
    work: float

    def variance_left(self, samples: int) -> float:
        """Variance of so many ``samples``."""
        rate = PASSES[self.name].variance_rate
        if rate == 1:
            return self.variance * self.done / samples
        return self.variance * _of_even(samples, rate) / _of_even(self.done, rate)

    @property
    def gain(self) -> float:
        """By how much a sample more lowers the variance, for its work."""
        return self.variance / (self.done * self.work)

    @property
    def steps(self) -> list[int]:
        """Even numbers of samples from those done to as many as a round may come to."""
        found = [self.done]
        while (following := int(even(found[-1] + 1.0))) <= _LARGEST_GROWTH * self.done:
            found.append(following)
        return found


def cheapest_samples(lights: Sequence[SampledPass], allowed: float) -> dict[str, int]:
    """Samples of ``lights`` by name that leave the ``allowed`` variance together with the least work, none fewer than
    are done; all that a round may take where nothing leaves so little."""
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
    """As :func:`cheapest_samples`, where any number of samples serves; None where nothing leaves so little.

    Samples of those that grow go with sqrt(variance of one / work of one), by Lagrange; a light whose next sample gains
    less for its work than theirs rests.
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
    """Variance of so many even ``samples``, to any scale, which falls with that ``rate``."""
    return float(samples**-rate) * (1.0 if samples & (samples - 1) == 0 else _UNEVEN)


def _work(simulation: Simulation) -> dict[str, float]:
    """Seconds by the table's unit costs of a sample of each pass."""
    return {
        name: PASSES[name].unit_cost
        * each.tracer.paths_per_sample
        * (SHARED_COST if isinstance(each.tracer, PathReuseTracer) else 1)
        for name, each in simulation.passes.items()
    }


def _mostly_followed(simulation: Simulation) -> bool:
    """Whether most paths that a plan predicts are of light over several surfaces."""
    paths = {
        name: int(PASSES[name].whole(each.predicted)) * each.tracer.paths_per_sample
        for name, each in simulation.passes.items()
    }
    return sum(count for name, count in paths.items() if name not in EVEN) > sum(paths.values()) / 2
