"""The finest accuracy that a time buys: choices at fixed paces and seconds in, an accuracy out.

Accuracies are tried on a grid, by bisection: more seconds never buy a coarser one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from mitsim.capture.choice import Candidates
from mitsim.capture.request import HIGHEST_ACCURACY

FIRST_LOOK = 1e-3
"""Accuracy of the look that tells what accuracies cost: a looser one takes as long."""
_STEPS, _DECADES = 10, 5
"""Accuracies a decade: neighbours differ by a quarter, as predictions of time are good to. The finest, 1e-5, is
a thirtieth of what sensors tell, and ladders of anchors and cells end near it."""


@dataclass(frozen=True)
class Affordable:
    """An ``accuracy``, the ``seconds`` that its run is predicted to take at fixed paces, and whether that ``fits``."""

    accuracy: float
    seconds: float
    fits: bool


def accuracies(finest: float) -> list[float]:
    """Those that are tried, from the loosest down to ``finest``."""
    steps = (float(f"{10 ** (-step / _STEPS):.3g}") for step in range(_DECADES * _STEPS + 1))
    return [HIGHEST_ACCURACY, *(each for each in steps if finest <= each < HIGHEST_ACCURACY)]


def affordable(candidates: Candidates, seconds: float, finest: float, kept: bool = True) -> Affordable:
    """The finest accuracy whose light, frames and truth take at most so many seconds; the loosest where none does.

    Parameters
    ----------
    candidates
        choices.
    seconds
        for light, frames and truth.
    finest
        accuracy that the evidence is good for.
    kept
        whether the choice must be predicted to keep the accuracy; else only its price counts.
    """

    def tried(accuracy: float) -> Affordable:
        taken, keeps = candidates.seconds(accuracy)
        return Affordable(accuracy, taken, taken <= seconds and (keeps or not kept))

    grid = accuracies(finest)
    best, too_fine = tried(grid[0]), len(grid)
    if not best.fits:
        # What keeps no accuracy at all is for the plan to say; here only time counts.
        return Affordable(best.accuracy, best.seconds, best.seconds <= seconds)
    coarse = 0
    while too_fine - coarse > 1:
        middle = (coarse + too_fine) // 2
        found = tried(grid[middle])
        if found.fits:
            best, coarse = found, middle
        else:
            too_fine = middle
    return best


def told(found: Affordable, seconds: float, around: float) -> Iterator[str]:
    """Why a plan is flagged: more time was needed than was given.

    Parameters
    ----------
    found
        what was chosen.
    seconds, around
        that were asked for, and that all but light, frames and truth takes.
    """
    if not found.fits:
        yield (
            f"{seconds:g} seconds are too few: even accuracy {found.accuracy:g}, which was taken, is predicted to take "
            f"{found.seconds + around:.1f} s from start to finish; give more"
        )
