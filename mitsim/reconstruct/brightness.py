"""An image under shifting dots in; the frame out whose pixels differ in brightness from their neighbours.

No pixel is in two frames, so that half of a frame's light fits as well; but dots:k are k^2 samples of one picture.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mitsim.core.arrays import FloatArray, sum_of_squares
from mitsim.reconstruct.leaveoneout import BoolArray, LeaveOneOut, Pattern

_SPREADS, _LEAST, _OTHERS = 4.0, 0.08, 2.0
"""Standard deviations, as half of the frames tell them, by which a frame's brightness may differ from what its
neighbours foretell, the least such part that is named, and times what any other frame differs by: chosen, of 49 normal
numbers one is so far away, and twice as far as any other, once in 800 runs."""
_FEW = 2.5
"""The least part times the number of frames: half of so few frames do not tell a spread."""
_BRIGHT_ENOUGH = 0.2
"""Of the mean foretold reflectance, from which a pixel counts when it is compared with its neighbours."""
_FEWEST_PIXELS = 8
"""Pixels of a frame that its neighbours foretell, below which their median is chance."""


def odd_brightness(check: LeaveOneOut, weights: FloatArray, good: BoolArray) -> Pattern | None:
    """The ``good`` pattern whose brightness differs most from what its pixels' neighbours foretell, if it does.

    The median of its pixels must differ, which highlights and edges do not move, its light as a whole to the same
    side, and by more than the others': stripes as fine as the dots make others differ as well.

    Parameters
    ----------
    check, weights
        of the run, and W of its measurements.
    good
        (K, K') which of them count.
    """
    image, lit = check.image(weights), check.lit(good)
    near = check.neighbours(image, lit)
    least = max(_LEAST, _FEW / good.size)
    middles = {pattern: _median(seen / told) for pattern, seen, told in _beside(check, image, near, good)}
    if len(middles) < 3:
        return None
    first = max(middles, key=lambda pattern: abs(_away(middles[pattern], middles)))
    if abs(_away(middles[first], middles)) < least / 2:
        return None
    (own,) = ((seen, told) for pattern, seen, told in _beside(check, image, near, good) if pattern == first)
    # Its neighbours are off by what it is off.
    lit[np.ix_(*(side[:, index] != 0 for side, index in zip(check.patterns, first, strict=True)))] = False
    near = check.neighbours(image, lit)
    middles, wholes = dict[Pattern, float](), dict[Pattern, float]()
    for pattern, seen, told in _beside(check, image, near, good):
        if pattern != first:
            middles[pattern], wholes[pattern] = _median(seen / told), float(np.vdot(seen, told)) / sum_of_squares(told)
    if len(middles) < 3:
        return None
    ratios = own[0] / own[1]
    middle, away = _median(ratios), np.array([abs(_away(ratio, middles)) for ratio in middles.values()])
    # The standard error of a median is 1.2533 times that of a mean, and a standard deviation 1.4826 times the
    # median deviation of normal numbers.
    error = 1.2533 * 1.4826 * _median(np.abs(ratios - middle)) / np.sqrt(ratios.size)
    spread = float(np.hypot(1.4826 * _median(away), error / max(_median(np.array(list(middles.values()))), 1e-300)))
    darker, whole = _away(middle, middles), _away(float(np.vdot(*own)) / sum_of_squares(own[1]), wholes)
    least = max(least, _SPREADS * spread, _OTHERS * float(away.max()))
    return first if abs(darker) > least and darker * whole > 0 else None


def _beside(
    check: LeaveOneOut, image: FloatArray, near: FloatArray, good: BoolArray
) -> Iterator[tuple[Pattern, FloatArray, FloatArray]]:
    """Of each ``good`` pattern the pixels of an ``image`` and what is ``near`` them, where that is bright."""
    bright = near > _BRIGHT_ENOUGH * max(float(near.mean()), 0.0)
    lit = [[np.flatnonzero(column) for column in side.T] for side in check.patterns]
    for row, column in np.ndindex(good.shape):
        place = np.ix_(lit[0][row], lit[1][column])
        chosen = bright[place]
        if good[row, column] and np.count_nonzero(chosen) >= _FEWEST_PIXELS:
            yield (row, column), image[place][chosen], near[place][chosen]


def _median(values: FloatArray) -> float:
    # np.median takes four times as long for so few.
    return float(np.partition(values, len(values) // 2)[len(values) // 2])


def _away(ratio: float, ratios: dict[Pattern, float]) -> float:
    """Part by which a ``ratio`` is below the median of all, negative, or that above it."""
    part = ratio / max(_median(np.array(list(ratios.values()))), 1e-300)
    return 1 - 1 / part if part > 1 else part - 1
