"""Measurements under shifting dots in; out come the change of 1/z at which most light of each projector pixel arrives.

Every frame is reconstructed at the calibrated depth as if all pixels along the baseline were lit, which shows where
each dot's light arrives; dots a period apart do not meet as long as their parallax differs by less.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.ndimage import gaussian_filter, median_filter

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.runs import Capture
from mitsim.reconstruct.depth import AllDepths
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.focus import STEP, dotted, pixels_of_parallax, stated_parallax, unambiguous
from mitsim.reconstruct.solver import prepare

LAMBDAS = 1e-5, 1e-6, 1e-7
"""Of the largest sigma^2: at less, noise rules, at more, dots blur (cookie_bag under dots:7x16 at 1.4 s: median errors
of 1.2, 0.6, 0.4 mm)."""
OFFSETS = -1.0, -0.5, 0.5, 1.0
"""Projector pixels by which the range of displacements may be moved: it is the period wide, and a surface at its end
would else be taken for one at the other."""
MEDIAN = 5
"""Projector pixels: width of the median of places; wider ones round the edges of cards."""
_POOLED = 1.0
"""Projector pixels: standard deviation over which light is pooled before its place is taken; with 2 edges blur, with
none single pixels go astray."""
_MARGIN = 2
"""Projector pixels beyond the largest displacement, so that a dot's image is not cut."""
_LEAST_PARALLAX = 0.5
"""Projector pixels that the range of depths must move light along an axis, or it is one without parallax."""
_NEIGHBOURHOOD = 2.0
"""Projector pixels of displacement beside the largest light that belong to it: a second one further off is a doubt."""


class Arrivals:
    """Where light arrives, by pixel and change of 1/z.

    Parameters
    ----------
    shots, factors
        under shifting dots, and of the same camera; MitsimError for other patterns, and for a rig without parallax.
    ends
        least and largest change of 1/z [1/mm] of the depths that are looked for.
    beside
        change of 1/z [1/mm] of the middle of those that are told apart, at most.

    Attributes
    ----------
    depths
        frames and factors.
    pixel
        change of 1/z [1/mm] that moves light by one projector pixel.
    width, reach
        changes of 1/z that are told apart, and the largest that is tried, either way.
    """

    def __init__(self, shots: Capture, factors: Factors, ends: tuple[float, float], beside: float) -> None:
        self._classes = [_classes(patterns) for patterns in shots.patterns]
        parallax, counts = stated_parallax(factors), (factors.left.shape[1], factors.right.shape[1])
        self._span = ends[1] - ends[0]
        moves = [max(map(abs, pixels_of_parallax(parallax, axis, count)[:2])) for axis, count in enumerate(counts)]
        self._open = [move * self._span > _LEAST_PARALLAX for move in moves]
        if not any(self._open):
            raise MitsimError(
                f"focus map: camera and projector of calibration {factors.name} have no baseline, so depth moves no "
                "light; give a depth, or auto"
            )
        self.pixel = 1 / max(moves)
        periods = [own.shape[1] for own in shots.patterns]
        self.width = min(self._span, unambiguous(np.where(self._open, moves, 0.0) * self.pixel, periods) * self.pixel)
        self.reach = beside + self.width / 2 + (max(OFFSETS) + _MARGIN) * self.pixel
        self.depths = AllDepths(shots, factors, (-self.reach, self.reach))
        self._margin = int(np.ceil(self.reach / self.pixel)) + 1

    @property
    def limited(self) -> bool:
        """Whether the dots' period limits the range of depths."""
        return self.width < self._span

    def most(self, lam: float, offset: float) -> tuple[FloatArray, FloatArray]:
        """Changes of 1/z by pixel where most light arrives, and how much more than elsewhere.

        Parameters
        ----------
        lam
            of the look, over the largest sigma^2.
        offset
            middle of the displacements [projector pixels].
        """
        count = 2 * int(np.ceil(self.width / self.pixel / STEP / 2)) + 1
        shifts = np.linspace(-self.width / 2, self.width / 2, count) + offset * self.pixel
        light = np.stack([self._arriving(self._seen[lam], shift) for shift in shifts])
        light = np.maximum(gaussian_filter(light, (0, _POOLED, _POOLED)), 0.0)
        place, step = light.argmax(axis=0), shifts[1] - shifts[0]
        near = round(_NEIGHBOURHOOD * self.pixel / step)
        beside = np.arange(count)[:, None, None] - place
        own = np.where(np.abs(beside) <= near, light, 0.0)
        other = np.where(np.abs(beside) <= near, 0.0, light).max(axis=0)
        peak = light.max(axis=0)
        dark = peak <= np.finfo(float).tiny
        centroid = (own * beside).sum(axis=0) / np.where(dark, 1.0, own.sum(axis=0))
        found = median_filter(shifts[place] + step * centroid, MEDIAN)
        elsewhere = np.maximum(other, np.median(other))  # of a dark pixel alone it would be small by chance
        return found, np.where(dark, 0.0, np.maximum(1 - elsewhere / np.where(dark, 1.0, peak), 0.0))

    def _arriving(self, seen: FloatArray, shift: float) -> FloatArray:
        """(n, n') light of ``seen`` images that arrives where pixels of a changed 1/z would be seen."""
        keys, places, parts = [], [], []
        for axis, (classes, opened) in enumerate(zip(self._classes, self._open, strict=True)):
            place = np.arange(classes.size) + (self.depths.edges(axis) * shift + self._margin if opened else 0.0)
            whole = np.floor(place).astype(np.intp)
            whole = np.clip(whole, 0, max(seen.shape[2 + axis] - 2, 0)) if opened else whole
            keys.append(classes if opened else np.zeros_like(classes))
            places.append(whole)
            parts.append(place - whole)
        total = np.zeros(self.depths.shape)
        for row in (0, 1) if self._open[0] else (0,):
            for column in (0, 1) if self._open[1] else (0,):
                weights = [part if end else 1 - part for part, end in zip(parts, (row, column), strict=True)]
                value = seen[keys[0][:, None], keys[1], (places[0] + row)[:, None], places[1] + column]
                total += np.outer(*weights) * value
        return total

    @cached_property
    def _seen(self) -> dict[float, FloatArray]:
        """By lambda, (K, K', rows, columns) images of each class of dots along axes with parallax, all pixels of these
        axes, and so many beside the window, taken for lit; K = 1 along an axis without."""
        sides, patterns = [], []
        for axis, opened in enumerate(self._open):
            side = self.depths.widened(axis, self._margin) if opened else self.depths.side(axis, 0.0)
            sides.append(side)
            patterns.append(np.ones((side.shape[1], 1)) if opened else self.depths.patterns[axis])
        prepared = prepare(sides[0], sides[1], patterns[0], patterns[1])
        counts = [own.shape[1] if opened else 1 for own, opened in zip(self.depths.patterns, self._open, strict=True)]
        sums = {key: prepared.accumulator() for key in np.ndindex(*counts)}
        for each in self.depths.frames:
            key = (each.row if self._open[0] else 0, each.column if self._open[1] else 0)
            sums[key].add(each.frame, 0 if self._open[0] else each.row, 0 if self._open[1] else each.column)
        problems = {key: prepared.problem(own) for key, own in sums.items()}
        found = {}
        for lam in LAMBDAS:
            images = [prepared.solve(own, lam * problems[key].scale).image for key, own in sums.items()]
            found[lam] = np.stack(images).reshape(*counts, *images[0].shape)
        return found


def _classes(patterns: FloatArray) -> np.ndarray:
    """(n,) which of the (n, K) ``patterns`` lights each pixel; MitsimError where it is not one of them, as of dots."""
    if not dotted(patterns):
        raise MitsimError("focus map: needs shifting dots, such as dots:7x16, whose displacement tells depth")
    return np.asarray(patterns.argmax(axis=1))
