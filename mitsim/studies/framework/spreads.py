"""Repeated times in, what they tell out: medians with their spread, differences of two, and the time that is left."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field

ROUNDS = 3
"""Fewest repeats that have a middle between a least and a most."""
_ALIKE = 0.1
"""Part of a time that two single runs of the same work differ by on an idle machine, and more on a busy one."""


@dataclass(frozen=True)
class Spread:
    """Seconds of so many ``repeats`` of the same work: ``median``, ``least`` and ``most``."""

    median: float
    least: float
    most: float
    repeats: int

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Spread:
        """Of measured ``seconds``, at least one."""
        return cls(statistics.median(seconds), min(seconds), max(seconds), len(seconds))

    def __add__(self, more: float) -> Spread:
        return Spread(self.median + more, self.least + more, self.most + more, self.repeats)

    def __mul__(self, factor: float) -> Spread:
        return Spread(self.median * factor, self.least * factor, self.most * factor, self.repeats)

    def __str__(self) -> str:
        if self.repeats == 1:
            return f"{self.median:.3g} s (once)"
        return f"{self.median:.3g} s ({self.least:.3g} to {self.most:.3g}, {self.repeats} runs)"


@dataclass(frozen=True)
class Extra:
    """Seconds that work takes beyond work without a part of it: a difference of two spreads.

    ``least`` and ``most`` are the ends that both spreads allow. Where ``least`` is not above 0 the part costs nothing
    that these repeats could tell.
    """

    median: float
    least: float
    most: float

    @classmethod
    def between(cls, with_it: Spread, without: Spread) -> Extra:
        """The difference of two spreads; single runs may be a tenth off either way.

        Parameters
        ----------
        with_it, without
            of the same work with and without the part.
        """
        wide, narrow = (_widened(each) for each in (with_it, without))
        return cls(with_it.median - without.median, wide.least - narrow.most, wide.most - narrow.least)

    @property
    def within_noise(self) -> bool:
        """Whether the difference may be chance."""
        return self.least <= 0

    def __str__(self) -> str:
        if self.within_noise:
            return f"within noise (at most {max(self.most, 0.0):.2g} s)"
        return f"{self.median:.2g} s ({self.least:.2g} to {self.most:.2g})"


def _widened(spread: Spread) -> Spread:
    """A single run with the spread that it was not given."""
    if spread.repeats > 1:
        return spread
    return Spread(spread.median, (1 - _ALIKE) * spread.median, (1 + _ALIKE) * spread.median, 1)


@dataclass
class Timed:
    """Work that can be done ``again``, which gives its seconds, and the ``seconds`` of each time so far."""

    again: Callable[[], float]
    seconds: list[float] = field(default_factory=list)

    @property
    def spread(self) -> Spread:
        """Of what was measured."""
        return Spread.of(self.seconds)


class Budget:
    """Wall seconds that a study may take, from now on, and what did not fit in them.

    ``seconds`` is all that it may take; ``slower`` what work takes here over what it is predicted to, by what was seen.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._started = time.perf_counter()
        self.left_out: list[str] = []
        self.slower = 1.0

    @property
    def left(self) -> float:
        """Seconds that are left."""
        return self.seconds - (time.perf_counter() - self._started)

    def saw(self, taken: float, predicted: float) -> None:
        """Work has ``taken`` so many seconds and was ``predicted`` to take others; a faster machine is not believed."""
        self.slower = max(taken / predicted, 1.0)

    def allows(self, name: str, seconds: float, share: float = 1.0, kept: float = 0.0) -> bool:
        """Whether work of so many predicted seconds fits; what does not is kept under its ``name``.

        Parameters
        ----------
        name, seconds
            of the work.
        share, kept
            part of what is left that it may take, less seconds that are kept for other work.
        """
        left = share * self.left - kept
        if seconds <= left:
            return True
        self.left_out.append(f"{name} (predicted {seconds:.0f} s, {max(left, 0.0):.0f} s were left)")
        return False

    def repeat(self, works: Iterable[Timed]) -> None:
        """Do all ``works`` again, round by round, so that a busy moment does not fall on one alone, and the shortest
        first, as long as there is time."""
        ordered = sorted(works, key=lambda work: work.spread.median)
        for _ in range(ROUNDS - 1):
            for work in ordered:
                if work.spread.most <= self.left:
                    work.seconds.append(work.again())


def times(spread: Spread) -> dict[str, float | int]:
    """A ``spread`` as JSON rows hold it: ``seconds``, ``least_s``, ``most_s``, ``repeats``."""
    found = asdict(spread)
    return {
        "seconds": found["median"],
        "least_s": found["least"],
        "most_s": found["most"],
        "repeats": found["repeats"],
    }
