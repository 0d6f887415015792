"""Frames behind a mask drawn on a raster: light by tan-angle cell in, irradiance on every sensor pixel out, by FFT.

A sensor pixel is a whole number q of raster cells. With w the part of raster cell a that pixel and light cell weigh
(two boxes, one after the other), pixel i sees raster cell a from light cell c with w(a - q i, c): what holds for one
pixel holds for all. The light is spread over the raster by those weights, X = D_row T D_column^T, and the frame is a
correlation, worked out for each of the q x q phases of the raster::

    frame[i, j] = sum_ab X[a, b] V[a + q i, b + q j]

It is exact for the raster, to rounding, whatever the cells; the sum of separable terms gives the same
(tests/unit/optics/test_correlation.py), and takes a product for each of them.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import fft

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.optics.profile import blurred_step
from mitsim.optics.shadow import Directions, ShadowGeometry

_WHOLE = 1e-6
"""Part of a raster cell by which a pixel may miss a whole number of them: rounding, of a frame 4096 pixels wide too."""


class Correlation:
    """A raster's shadow of one depth, prepared once; MitsimError for a raster of which a pixel is no whole number.

    Parameters
    ----------
    shadow
        of a camera whose mask is the raster.
    rows, columns
        directions of the cells.
    fill_factor
        active part of a pixel, which frames are scaled by.
    """

    def __init__(self, shadow: ShadowGeometry, rows: Directions, columns: Directions, fill_factor: float = 1.0) -> None:
        sides = [_Side.of(*shadow.from_mask(directions, axis)) for axis, directions in enumerate((rows, columns))]
        self.shape = sides[0].pixels, sides[1].pixels
        self._phases = sides[0].phases, sides[1].phases
        self._spread = [side.weights for side in sides]
        reach = max(len(side.weights) // side.phases for side in sides)
        self._size = [fft.next_fast_len(side.pixels + reach - 1, real=True) for side in sides]
        along = [size * phases for size, phases in zip(self._size, self._phases, strict=True)]
        seen = _part(_part(_mask_values(shadow), sides[0].first, along[0]).T, sides[1].first, along[1]).T
        self._spectra = fft.rfft2(fill_factor * self._by_phase(seen))

    def image(self, light: FloatArray, rows: npt.ArrayLike, columns: npt.ArrayLike) -> FloatArray:
        """(m, m') irradiance.

        Parameters
        ----------
        light
            (r, c) of some cells.
        rows, columns
            (r,) and (c,) which cells of the directions these are.
        """
        left, right = self._spread[0][:, np.asarray(rows)], self._spread[1][:, np.asarray(columns)]
        by_phase = self._by_phase(left @ light @ right.T)
        seen = fft.fft(fft.rfft(by_phase, self._size[1]), self._size[0], axis=-2)
        total = np.einsum("ijkl,ijkl->kl", self._spectra, np.conjugate(seen, out=seen))
        return np.asarray(fft.irfft2(total, self._size)[: self.shape[0], : self.shape[1]])

    def _by_phase(self, cells: FloatArray) -> FloatArray:
        """(q, q', m, m') every q-th and q'-th of raster ``cells`` (q m, q' m')."""
        rows, columns = self._phases
        return cells.reshape(len(cells) // rows, rows, -1, columns).transpose(1, 3, 0, 2)


class _Side:
    """One axis: its pixels, raster cells in each of them, the first cell that pixel 0 sees, and how it weighs them
    (cells, c) for each direction."""

    def __init__(self, pixels: int, phases: int, first: int, weights: FloatArray) -> None:
        self.pixels, self.phases, self.first, self.weights = pixels, phases, first, weights

    @classmethod
    def of(cls, shadow: ShadowGeometry, directions: Directions) -> _Side:
        pixels = len(shadow.pixel_centres_mm)
        length = shadow.pixel_centres_mm[-1] - shadow.pixel_centres_mm[0]
        step = length * shadow.shrink / max(pixels - 1, 1) / shadow.mask.feature_mm
        phases = max(round(step), 1)
        if pixels > 1 and abs(step - phases) > _WHOLE:
            raise MitsimError(f"a pixel is {step:g} cells of the mask's raster; draw one of a whole number")
        cell, blur = shadow.mask.feature_mm, shadow.mask.blur_mm
        halves = shadow.half_pixel / cell, shadow.half_cell(directions) / cell
        crossings = (shadow.shrink * shadow.pixel_centres_mm[0] + shadow.distance_mm * directions.centres) / cell
        crossings = crossings + len(_mask_values(shadow)) / 2
        reach = sum(halves) + 8.3 * blur / cell
        first = int(np.floor(crossings.min() - reach))
        count = -(-(int(np.ceil(crossings.max() + reach)) - first) // phases) * phases
        edges = first + np.arange(count + 1)
        below = blurred_step(edges[:, None] - crossings, halves[0], halves[1], blur / cell)
        return cls(pixels, phases, first, np.diff(below, axis=0))


def _mask_values(shadow: ShadowGeometry) -> FloatArray:
    return np.asarray(shadow.mask.values)  # type: ignore[union-attr]


def _part(values: FloatArray, first: int, count: int) -> FloatArray:
    """(count, m) rows of ``values`` from ``first`` on, 0 beyond them."""
    result = np.zeros((count, values.shape[1]))
    low, high = max(first, 0), min(first + count, len(values))
    result[low - first : max(high, low) - first] = values[low : max(high, low)]
    return result
