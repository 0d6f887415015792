"""Piecewise constant transmission of one axis of a mask, and its means over a sensor pixel and a cell.

Means over the two boxes follow from the second antiderivative. The mean of the values is subtracted first, so that
the
second difference errs by 1e-11 for values of order 1. A unit step that is blurred by a Gaussian of standard deviation
sigma is Phi(x / sigma), and its means are differences of these antiderivatives, with phi the normal density::

    x Phi + sigma phi    and    ((x^2 + sigma^2) Phi + x sigma phi) / 2
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from mitsim.core.arrays import ByValue, FloatArray

_FEW = 4
"""Edges in the narrower box up to which edges are summed one by one; beyond, a second difference keeps 1e-11."""
_DENSE = 2
_WIDE = 16
"""Product of the half-widths of two boxes, in grid steps, from which cubic interpolation errs by less than 4e-5."""
_BEYOND = 8.3
_POINTLIKE = 1e-4
"""Half-width in standard deviations of the blur below which a box is neglected (error 2e-9)."""
_PER_CELL = 4


@dataclass(frozen=True, eq=False)
class Steps(ByValue):
    """A piecewise constant function: ``values[k]`` from ``edges[k]`` to ``edges[k + 1]`` [mm], 0 outside.

    ``blur_mm`` is the standard deviation of a Gaussian that blurs it.
    """

    edges: FloatArray
    values: FloatArray
    blur_mm: float = 0.0

    @classmethod
    def between(cls, profile: npt.ArrayLike, lines_mm: FloatArray, blur_mm: float = 0.0) -> Steps:
        values = np.asarray(profile, dtype=np.float64)
        starts = np.flatnonzero(np.diff(values, prepend=np.nan))
        return cls(np.append(lines_mm[starts], lines_mm[-1]), values[starts], blur_mm)

    def at(self, s: FloatArray) -> FloatArray:
        """Return the values at points ``s`` [mm]; an edge belongs to the interval that begins there."""
        if self.blur_mm:
            return self._blurred_means(s, 0.0, 0.0)
        padded = np.concatenate(([0.0], self.values, [0.0]))
        return np.asarray(padded[np.searchsorted(self.edges, s, side="right")])

    def seen_through(self, far: Steps, scale: float, shift: float) -> Steps:
        """Return ``self(s) * far(scale * s + shift)``, with scale > 0 and shift in mm."""
        edges = np.unique(np.concatenate((self.edges, (far.edges - shift) / scale)))
        middle = (edges[:-1] + edges[1:]) / 2
        return Steps(edges, self.at(middle) * far.at(scale * middle + shift))

    def cell_means(self, start: float, step: float, count: int) -> FloatArray:
        if self.blur_mm:
            return self._blurred_means(np.asarray(start + step * (np.arange(count) + 0.5)), step / 2, 0.0)
        bounds = start + step * np.arange(count + 1)
        index = np.searchsorted(self.edges, bounds, side="right")
        means = np.concatenate(([0.0], self.values, [0.0]))[index[:-1]]
        # Only cells that an edge cuts are computed from sums, because a difference of large sums loses digits.
        cut = np.flatnonzero(np.diff(index))
        covered = np.concatenate(([0.0], np.cumsum(self.values * np.diff(self.edges))))
        at = np.interp(bounds[[cut, cut + 1]], self.edges, covered)
        means[cut] = (at[1] - at[0]) / step
        return np.asarray(means)

    def amplitude_means(self, start: float, step: float, count: int) -> FloatArray:
        """Return means of the root of the blurred profile, because a blur acts on power."""
        if not self.blur_mm:
            return self.cell_means(start, step, count)
        power = Steps(self.edges, np.square(self.values), self.blur_mm)
        points = np.asarray(start + step / _PER_CELL * (np.arange(count * _PER_CELL) + 0.5))
        return np.asarray(np.sqrt(np.maximum(power.at(points), 0)).reshape(count, _PER_CELL).mean(axis=1))

    def over(self, centres: FloatArray, half: FloatArray) -> FloatArray:
        """Return the means over boxes about ``centres`` [mm]; at half-width 0 the value."""
        return self._blurred_means(centres, half, 0.0)

    def _blurred_means(self, centres: FloatArray, half: FloatArray | float, other: float) -> FloatArray:
        reach = half + other + _BEYOND * self.blur_mm
        jumps = np.diff(self.values, prepend=0.0, append=0.0)
        first = np.searchsorted(self.edges, centres - reach, side="right")
        most = int((np.searchsorted(self.edges, centres + reach, side="right") - first).max(initial=0))
        total = np.concatenate(([0.0], self.values, [0.0]))[first]
        for further in range(most):
            edge = np.minimum(first + further, len(jumps))
            beyond = centres - np.append(self.edges, np.inf)[edge]
            total += np.append(jumps, 0.0)[edge] * blurred_step(beyond, half, other, self.blur_mm)
        return np.asarray(total)

    def box_means(self, centres: FloatArray, half_pixel: float, half_cell: float) -> FloatArray:
        if self.blur_mm:
            return self._blurred_means(centres, half_pixel, half_cell)
        reach = half_pixel + half_cell
        low, high = centres.min() - reach, centres.max() + reach
        inside = self.edges[(self.edges > low) & (self.edges < high)]
        edges = np.concatenate(([low], inside, [high]))
        values = self.at((edges[:-1] + edges[1:]) / 2)
        return np.asarray(Antiderivative(edges, values[None]).means(centres, half_pixel, half_cell)[0])


def blurred_step(x: FloatArray, half: FloatArray | float, other: float, blur: float) -> FloatArray:
    """Return the mean over boxes of half-widths ``half`` and ``other`` about x of a unit step that a Gaussian blurs.

    Lengths have one unit, x may be -inf, and ``blur`` may be 0 only if there is no second box.
    """
    if other > _POINTLIKE * blur and other > 0:
        ends = (_twice(x + half + other, blur) - _twice(x + half - other, blur)) / (2 * other)
        ends -= (_twice(x - half + other, blur) - _twice(x - half - other, blur)) / (2 * other)
        return np.asarray(ends / (2 * half))
    wide = np.asarray(half) > _POINTLIKE * blur
    width = np.where(wide, half, 1.0)
    means = (_once(x + width, blur) - _once(x - width, blur)) / (2 * width)
    point = scipy.special.ndtr(x / blur) if blur else np.asarray(x >= 0, dtype=np.float64)
    return np.asarray(np.where(wide, means, point))


def _once(x: FloatArray, blur: float) -> FloatArray:
    if not blur:
        return np.asarray(np.maximum(x, 0))
    z = np.maximum(x / blur, -2 * _BEYOND)  # both parts are 0 before
    density = np.exp(-np.square(z) / 2) / np.sqrt(2 * np.pi)
    return np.asarray(blur * (z * scipy.special.ndtr(z) + density))


def _twice(x: FloatArray, blur: float) -> FloatArray:
    if not blur:
        return np.asarray(np.square(np.maximum(x, 0)) / 2)
    z = np.maximum(x / blur, -2 * _BEYOND)
    density = np.exp(-np.square(z) / 2) / np.sqrt(2 * np.pi)
    return np.asarray(blur**2 / 2 * ((np.square(z) + 1) * scipy.special.ndtr(z) + z * density))


def _cubic(nodes: FloatArray, places: FloatArray) -> FloatArray:
    index = places.astype(np.intp)
    beyond = places - index
    result = np.empty((len(nodes), *places.shape))
    for function, out in zip(nodes, result, strict=True):
        before, left, right, after = function[:-3], function[1:-2], function[2:-1], function[3:]
        third = (after - before) / 6 + (left - right) / 2
        second = (before + right) / 2 - left
        first = right - left - second - third
        np.take(third, index, out=out)
        for coefficient in (second, first, left):
            out *= beyond
            out += coefficient[index]
    return result


def _running_sums(parts: FloatArray) -> FloatArray:
    sums = np.zeros((len(parts), parts.shape[1] + 1))
    np.cumsum(parts, axis=1, out=sums[:, 1:])
    return sums


class Antiderivative:
    """First and second antiderivative of piecewise constant functions whose means are subtracted."""

    def __init__(self, edges: FloatArray, values: FloatArray, step: float | None = None) -> None:
        width = np.diff(edges)
        self._edges, self._step = edges, step
        self._mean = (values @ width) / (edges[-1] - edges[0])
        self._values = values - self._mean[:, None]
        self._first = _running_sums(self._values * width)
        # The slope is removed because it cancels in the second difference, where its size would cost digits.
        self._first -= self._first.mean(axis=1, keepdims=True)
        self._second = _running_sums((self._first[:, :-1] + self._first[:, 1:]) * (width / 2))

    @classmethod
    def of_samples(cls, values: FloatArray, start: float, step: float) -> Antiderivative:
        return cls(start + step * np.arange(values.shape[1] + 1), values, step)

    def means(self, centres: FloatArray, half_pixel: float, half_cell: float) -> FloatArray:
        wide, narrow = max(half_pixel, half_cell), min(half_pixel, half_cell)
        total = (self._ends(centres + wide, narrow) - self._ends(centres - wide, narrow)) / (2 * wide)
        return np.asarray(total + self._mean.reshape(-1, *[1] * centres.ndim))

    def smooth_means(self, centres: FloatArray, half_pixel: float, half_cell: float) -> FloatArray:
        step, low = self._step, float(centres.min())
        assert step is not None, "on equal cells"
        count = int((float(centres.max()) - low) / step) + 4
        if centres.size < _DENSE * count or half_pixel * half_cell < _WIDE * step**2:
            return self.means(centres, half_pixel, half_cell)
        nodes = self.means(np.asarray(low + step * (np.arange(count) - 1)), half_pixel, half_cell)
        return _cubic(nodes, (centres - low) / step)

    def _ends(self, points: FloatArray, half: float) -> FloatArray:
        if half == 0:
            return self._at(points, order=1)
        # Edge k opens interval k, so these are the edges inside.
        first = self._index(points - half) + 1
        most = int((self._index(points + half) + 1 - first).max())
        if most > _FEW:
            return (self._at(points + half, order=2) - self._at(points - half, order=2)) / (2 * half)
        means = self._at(points, order=1)
        jumps = np.diff(self._values, axis=1, append=self._values[:, -1:])
        for edge in range(most):
            opened = np.minimum(first + edge, self._values.shape[1])
            corner = np.square(np.maximum(half - np.abs(points - self._edges[opened]), 0)) / (4 * half)
            for jump, out in zip(jumps, means, strict=True):
                out += jump[opened - 1] * corner
        return means

    def _index(self, points: FloatArray) -> npt.NDArray[np.intp]:
        if self._step is None:
            index = np.searchsorted(self._edges, points, side="right") - 1
        else:
            index = ((points - self._edges[0]) / self._step).astype(np.intp)
        return np.clip(index, 0, self._values.shape[1] - 1)

    def _at(self, points: FloatArray, order: int) -> FloatArray:
        index = self._index(points)
        beyond = points - self._edges[index]
        result = np.empty((len(self._values), *points.shape))
        for values, first, second, out in zip(self._values, self._first, self._second, result, strict=True):
            if order == 1:
                out[...] = first[index] + values[index] * beyond
            else:
                out[...] = second[index] + (first[index] + values[index] * (beyond / 2)) * beyond
        return result
