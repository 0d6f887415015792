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
        self.pixels = len(shadow.pixel_centres_mm)
        pitch = shadow.pixel_centres_mm[-1] - shadow.pixel_centres_mm[0]
        step = pitch * shadow.shrink / max(self.pixels - 1, 1) / shadow.mask.feature_mm
        phases = self._phases = max(round(step), 1)
        if self.pixels > 1 and abs(step - phases) > _WHOLE:
            raise MitsimError(f"a pixel is {step:g} cells of the mask's raster; draw one of a whole number")
        sides = [
            _Side.of(*shadow.from_mask(directions, axis), phases) for axis, directions in enumerate((rows, columns))
        ]
        self._spread = [side.weights for side in sides]
        self._size = fft.next_fast_len(
            self.pixels + max(side.weights.shape[0] for side in sides) // phases - 1, real=True
        )
        values = _mask_values(shadow)
        seen = _part(_part(values, sides[0].first, self._size * phases).T, sides[1].first, self._size * phases).T
        by_phase = seen.reshape(self._size, phases, self._size, phases).transpose(1, 3, 0, 2)
        self._spectra = fft.rfft2(fill_factor * by_phase)

    def image(self, light: FloatArray, rows: npt.ArrayLike, columns: npt.ArrayLike) -> FloatArray:
        """(pixels, pixels) irradiance.

        Parameters
        ----------
        light
            (r, c) of some cells.
        rows, columns
            (r,) and (c,) which cells of the directions these are.
        """
        left, right = self._spread[0][:, np.asarray(rows)], self._spread[1][:, np.asarray(columns)]
        spread, phases = left @ light @ right.T, self._phases
        by_phase = spread.reshape(len(spread) // phases, phases, -1, phases).transpose(1, 3, 0, 2)
        seen = fft.fft(fft.rfft(by_phase, self._size), self._size, axis=-2)
        total = np.einsum("ijkl,ijkl->kl", self._spectra, np.conjugate(seen, out=seen))
        return np.asarray(fft.irfft2(total, (self._size, self._size))[: self.pixels, : self.pixels])


class _Side:
    """One axis: the first raster cell that pixel 0 sees, and how it weighs them (cells, c) for each direction."""

    def __init__(self, first: int, weights: FloatArray) -> None:
        self.first, self.weights = first, weights

    @classmethod
    def of(cls, shadow: ShadowGeometry, directions: Directions, phases: int) -> _Side:
        cell, blur = shadow.mask.feature_mm, shadow.mask.blur_mm
        halves = shadow.half_pixel / cell, shadow.half_cell(directions) / cell
        crossings = (shadow.shrink * shadow.pixel_centres_mm[0] + shadow.distance_mm * directions.centres) / cell
        crossings = crossings + len(_mask_values(shadow)) / 2
        reach = sum(halves) + 8.3 * blur / cell
        first = int(np.floor(crossings.min() - reach))
        count = -(-(int(np.ceil(crossings.max() + reach)) - first) // phases) * phases
        edges = first + np.arange(count + 1)
        below = blurred_step(edges[:, None] - crossings, halves[0], halves[1], blur / cell)
        return cls(first, np.diff(below, axis=0))


def _mask_values(shadow: ShadowGeometry) -> FloatArray:
    return np.asarray(shadow.mask.values)  # type: ignore[union-attr]


def _part(values: FloatArray, first: int, count: int) -> FloatArray:
    """(count, m) rows of ``values`` from ``first`` on, 0 beyond them."""
    result = np.zeros((count, values.shape[1]))
    low, high = max(first, 0), min(first + count, len(values))
    result[low - first : max(high, low) - first] = values[low : max(high, low)]
    return result
