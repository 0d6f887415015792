"""One frame taken at several exposure times in; the rate of each pixel, of the exposures that do not saturate it, out.

No frame of a session is brighter than the uniform one. A pixel that this one, read at the shortest exposure, would not
bring near saturation at a longer one is saturated by no frame at that exposure. So the weights of all exposures are
found once, and belong to pixels: found by a uniform frame of the other side's stripes, they hang on no noise of the
frames that they merge, which keeps merged rates without bias, of the variance sum_k w_k^2 v_k. With w_k in proportion
to 1/v_k that is least (Granados et al. 2010, "Optimal HDR reconstruction with linear digital cameras", CVPR).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.manifests import Digital
from mitsim.rig.recipe import Merge

Chosen = npt.NDArray[np.bool_] | bool
"""Pixels (rows, columns) that are chosen, or all or none."""
_ROOM = 5.0
"""Deviations of its noise that a uniform frame's pixel must stay below saturation: one of 3 million goes beyond."""
_LIT = 0.5
"""Light of stripes over that of the uniform frame, whose noise decides on the weights."""


@dataclass(frozen=True, eq=False)
class Ladder:
    """Exposures of every frame, and how their rates are merged.

    Attributes
    ----------
    digitals
        how numbers of each exposure become rates, the shortest first.
    weights
        (exposures, rows, columns), 1 in sum; None where there is one exposure.
    """

    digitals: tuple[Digital, ...]
    weights: FloatArray | None = None

    @classmethod
    def of(cls, digitals: Sequence[Digital], uniform: FloatArray, shots: int, merge: Merge) -> Ladder:
        """Weights of several exposures.

        Parameters
        ----------
        digitals
            of each, the shortest first.
        uniform
            (rows, columns) rate of the uniform frame at the shortest [electrons/s].
        shots
            that it is the mean of.
        merge
            ``weighted``: by variance; ``longest``: the longest exposure that does not saturate a pixel, alone.
        """
        first = digitals[0]
        light = np.maximum(uniform, 0.0)
        error = first.variance(light) / shots
        usable = np.ones((len(digitals), *uniform.shape), dtype=bool)
        variance = np.empty(usable.shape)
        for rung, digital in enumerate(digitals):
            variance[rung] = digital.variance(_LIT * light)
            if rung and digital.saturation_dn is not None:
                unit = digital.gain_dn_per_e * digital.exposure_s
                brightest = uniform + digital.dark_current_e_per_s + _ROOM * np.sqrt(error + digital.variance(light))
                usable[rung] = brightest * unit + digital.black_level_dn < digital.saturation_dn
        if merge == "longest":
            longest = len(digitals) - 1 - np.argmax(usable[::-1], axis=0)
            weights = (np.arange(len(digitals))[:, None, None] == longest).astype(np.float64)
        else:
            weights = usable / variance
            weights /= weights.sum(axis=0)
        return cls(tuple(digitals), weights)

    def merged(self, rates: Iterable[FloatArray], rows: slice = slice(None)) -> FloatArray:
        """``rates`` (rows, columns) of one frame at each exposure as one; ``rows`` are those that they are of."""
        each = iter(rates)
        if self.weights is None:
            return next(each)
        total = self.weights[0, rows] * next(each)
        for weight, rate in zip(self.weights[1:, rows], each, strict=True):
            total += weight * rate
        return total

    def used(self, exposure: int) -> Chosen:
        """(rows, columns) whether pixels are read at an ``exposure``."""
        return True if self.weights is None else np.asarray(self.weights[exposure] > 0)

    def variance(self, light: FloatArray | float, shots: int = 1) -> float:
        """Mean noise variance [(electrons/s)^2] of a merged sum or difference of frames.

        Parameters
        ----------
        light
            (rows, columns) sum of their rates [electrons/s]; one number will do where there is one exposure.
        shots
            their number.
        """
        if self.weights is None:
            return float(self.digitals[0].variance(float(np.mean(light)), shots))
        parts = zip(self.weights, self.digitals, strict=True)
        return float(sum((np.square(weight) * digital.variance(light, shots)).mean() for weight, digital in parts))
