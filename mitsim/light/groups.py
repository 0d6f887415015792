"""One independent estimate of the light: passes traced, and accumulated while the next are traced."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial, reduce
from operator import add

from mitsim.core.arrays import Labels
from mitsim.core.parallel import Behind
from mitsim.core.seeds import integer
from mitsim.light.light_estimate import LightEstimate
from mitsim.light.passes import Simulation
from mitsim.light.settings import GROUPS, LANES_AT_ONCE
from mitsim.transport.accumulator import DeviceSums, fetched
from mitsim.transport.records import Deposits

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
        at_once = min(LANES_AT_ONCE, self.simulation.paths_at_once)
        for name, each in self.simulation.passes.items():
            samples = wanted.get(name, 0)
            if self.done.get(name, 0) >= samples:
                continue
            seed, ledgers = integer(self.seed, each.row.stream), self.simulation.ledgers(name, self.labels, self._lines)
            if name in self.done:
                accumulating.wait()
                self._spread(name, samples / self.done[name])
            while (done := self.done.get(name, 0)) < samples:
                count = min(max(1, at_once // each.tracer.lanes), samples - done)
                deposits = each.trace(seed, done, count, ledgers)
                accumulating.give(self._accumulations(name, deposits.by_line(self._lines), samples))
                self.done[name] = done + count
                self.paths += count * each.tracer.lanes
            if ledgers:
                accumulating.give(self._accumulations(name, fetched(ledgers), samples))

    def _accumulations(self, name: str, by_line: Sequence[Deposits | DeviceSums], samples: int) -> list[Accumulation]:
        return [partial(self._add, name, line, light, samples) for line, light in enumerate(by_line)]

    def _spread(self, name: str, growth: float) -> None:
        """Make the light of a pass the mean over so many times the samples, of which no others are there yet."""
        for means in self._means:
            means[name] /= growth

    def _add(self, name: str, line: int, found: Deposits | DeviceSums, samples: int) -> None:
        means, light = self._means[line], self.simulation.accumulate(name, found, self.labels, samples)
        means[name] = means[name] + light if name in means else light

    def light(self, line: int = 0) -> LightEstimate:
        """Mean over the samples, of a ``line``."""
        return reduce(add, self._means[line].values())

    def part(self, name: str, line: int = 0) -> LightEstimate:
        """The same of one pass by its ``name``."""
        return self._means[line][name]


def trace_groups(groups: Sequence[Group], wanted: Mapping[str, int]) -> None:
    """Trace until every group has so many samples as are ``wanted`` of each pass by its name, and accumulate them."""
    with Behind[Accumulation](lambda accumulation: accumulation()) as accumulating:
        for group in groups:
            group.trace(wanted, accumulating)
        accumulating.wait()
