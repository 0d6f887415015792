"""The order in which a session's frames are taken: its patterns and an order's name in; what each frame shows out."""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import Literal

Side = Literal["horizontal", "vertical"]
SIDES: tuple[Side, Side] = ("horizontal", "vertical")
"""Stripes of a calibration: h_i 1^T, and 1 h_i^T."""
Order = Literal["listed", "reversed", "interleaved", "random"]
UNIFORM = 0
"""Sign of a frame under uniform light."""
Half = tuple[Side, int, int]
"""Side, number of the pattern and sign of a frame."""


def halves(count: int, pairs: bool) -> Iterator[list[Half]]:
    """What shows each pattern, in the order of the list: horizontal stripes, then vertical ones.

    Parameters
    ----------
    count
        patterns of a side.
    pairs
        whether a +-1 pattern is the difference of two frames. If not, each side begins with a uniform frame.
    """
    for side in SIDES:
        if not pairs:
            yield [(side, 0, UNIFORM)]
        for index in range(count):
            yield [(side, index, sign) for sign in ((1, -1) if pairs else (1,))]


def taken(count: int, pairs: bool, order: Order = "listed", seed: int = 0) -> list[Half]:
    """The same in the order in which they are taken. What is subtracted in a pair is taken one after the other.

    Parameters
    ----------
    count, pairs
        as :func:`halves`.
    order
        ``listed``; ``reversed``; ``interleaved``: a pattern of one side, then the same of the other; ``random``.
    seed
        of a random order.
    """
    patterns = list(halves(count, pairs))
    if order == "reversed":
        patterns.reverse()
    elif order == "interleaved":
        middle = len(patterns) // 2
        patterns = [pattern for both in zip(patterns[:middle], patterns[middle:], strict=True) for pattern in both]
    elif order == "random":
        random.Random(seed).shuffle(patterns)
    return [half for pattern in patterns for half in pattern]
