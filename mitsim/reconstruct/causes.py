"""Measurements, their residuals and the factors in; out comes which cause explains best what the model does not.

Each cause leaves its own mark. Where a surface is not at the calibrated distance, parallax moves its light along the
baseline: a few measurements of single groups of lit pixels are then explained by light of *any* pixel of the same rows
(or the same columns). Ambient light is the same in every shot, and comes from all pixels. Gloss comes from the lit
pixels, but changes over the sensor: the factors times a polynomial of the place explain it. Another rig explains
nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.runs import Measurement
from mitsim.reconstruct.estimate_factors import SEPARABLE_RESIDUAL
from mitsim.reconstruct.factorisation import IndexArray, group_pixels
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.subpixel import LitFrame, block_indices, factor_slope, orthonormal, print_part

_PLACES = (0.1, 0.3), (0.4, 0.8), (0.7, 0.1), (0.9, 0.6)
"""Which groups of lit rows and columns are looked at, as parts of their number: chosen, four spread over both."""
_DEGREE = 2
"""Of the polynomials that gloss is told by: chosen, a highlight is wider than half of the sensor."""
_SATURATED = 1e-5
"""Part of the readings at the end of their range that is no accident: 2.6 pixels of 512 x 512."""
_MOST = 0.5
"""Part of the unexplained energy that names a cause: more than all others together."""
_COMMON = 0.15
"""The same of what is common to all shots; less than half, as most of ambient light looks like an image and leaves the
residual. Light that changes from shot to shot has 1 / shots."""
_EVERYWHERE = 0.75
"""The same of what light of all scene pixels explains: a lamp's own colours leave 0.06 to 0.2 of theirs."""
_ALL = 0.3
"""Unexplained part of the measurements above which neither depth nor ambient light is the cause, but another rig."""
STEPS = (
    "one step late: each shot shows the pattern of the shot before",
    "one step early: each shot shows the pattern of the next",
)
"""Ways in which shots are a step beside their patterns."""


class Cause(Enum):
    """Why measurements do not fit; the value is its sentence and the remedy."""

    FRAMES = ("frames that are not what they say", "capture these frames again")
    ORIENTATION = ("frames that are turned or mirrored", "turn them back, or calibrate with the camera as it is")
    ORDER = ("frames in another order than their patterns", "bring the frames into the order of the patterns")
    GAMMA = (
        "numbers that are not proportional to the light",
        "save the camera's raw numbers, without gamma or tone curve",
    )
    SCALE = (
        "numbers that were multiplied, as of few bits left-aligned in more",
        "divide the numbers by that factor, or give a camera file of these numbers",
    )
    SATURATION = ("readings at the full well or the ADC's end", "expose for less")
    AMBIENT = ("ambient light, the same in every shot", "darken the room, or capture with ambient_frame=yes")
    DEPTH = (
        "depth, light that lands beside where the calibration saw it",
        "put the scene at the calibrated distance, calibrate at the scene's, or give its depth as focus",
    )
    INDIRECT = (
        "light from scene pixels that are not lit, over other surfaces or from depths along both axes",
        "cover shiny and near surfaces, or use patterns with more dots",
    )
    GLOSS = (
        "gloss, light that changes over the sensor",
        "turn the highlight away from the sensor, or take it as an image of the matt parts alone",
    )
    RIG = (
        "another rig, mask or pattern than was calibrated, or light over mirrors",
        "calibrate this camera with this projector",
    )
    MASK = (
        "a camera that is not separable, which its calibration shows as well",
        "straighten the mask, or take a separable one",
    )
    DETAIL = (
        "print finer than a scene pixel, light beside the centres of the pixels",
        "use a projector of more pixels, or bring projector and scene closer together",
    )
    UNKNOWN = ("unknown: depth, gloss or indirect light", "compare the map of the misfit with the scene")


@dataclass(frozen=True, eq=False)
class Reading:
    """Another way to take the frames: the ``cause`` that it is, in ``words``; which leaves the part ``left`` of all
    measurements, rms."""

    cause: Cause
    words: str
    left: float = 0.0


@dataclass(frozen=True)
class Signatures:
    """Parts of the unexplained energy, 1 is all; NaN where the patterns cannot tell.

    ``rows``, ``columns``, ``everywhere``: explained by light of any scene row, of any column, of any pixel.
    ``gloss``: explained by factors that change over the sensor. ``common``: the same in every shot. ``saturated``: part
    of the readings at the end of their range. ``mask``: predicted by what the calibration knows that its factors lack.
    ``detail``: light beside the centres of the lit pixels, but not because of depth; NaN where pixels of patterns
    overlap.
    """

    rows: float
    columns: float
    everywhere: float
    gloss: float
    common: float
    saturated: float
    mask: float = np.nan
    detail: float = np.nan


class Evidence:
    """Gathers what tells causes apart, from one measurement after the other.

    Parameters
    ----------
    factors
        of the model.
    patterns
        P_L (n, K) and P_R (n', K').
    predicted
        energy that terms of the camera which the factors lack leave; None: not known.
    """

    def __init__(
        self, factors: Factors, patterns: tuple[FloatArray, FloatArray], predicted: float | None = None
    ) -> None:
        self.predicted = predicted
        self._factors = factors.sides
        noise = factors.manifest.noise
        self.of_factors = noise.unexplained if noise else 0.0
        sides, apart = zip(*(_lit_groups(side) for side in patterns), strict=True)
        self._told_apart = all(apart)
        places = {(int(row * len(sides[0])), int(column * len(sides[1]))) for row, column in _PLACES}
        self._groups = [(sides[0][row], sides[1][column]) for row, column in sorted(places)]
        shape = len(factors.left), len(factors.right)
        self._frames: list[FloatArray] = [np.zeros(shape) for _ in self._groups]
        self._variances = [0.0] * len(self._groups)
        self._common: FloatArray = np.zeros(shape)
        self._common_noise, self._shots = 0.0, 0

    def add(self, measurement: Measurement, frame: FloatArray, residual: FloatArray, variance: float) -> None:
        """Count in one measurement.

        Parameters
        ----------
        measurement
            which pattern it is of.
        frame, residual
            (rows, columns) as the solver takes it, and what the model leaves of it.
        variance
            mean noise variance of its data.
        """
        if measurement.shots == 1:  # the same light in both halves of a pair is gone
            self._common += residual
            self._common_noise += variance * residual.size
            self._shots += 1
        self.collect(measurement, frame, variance)

    def collect(self, measurement: Measurement, frame: FloatArray, variance: float) -> None:
        """Count in one measurement for :meth:`print_part` alone.

        Parameters
        ----------
        measurement, frame, variance
            as of :meth:`add`.
        """
        for k, (rows, columns) in enumerate(self._groups):
            weight = rows.weights[measurement.row] * columns.weights[measurement.column]
            if weight:
                self._frames[k] += weight * frame
                self._variances[k] += weight**2 * variance

    def signatures(self, unexplained: float, saturated: float) -> Signatures:
        """What was gathered; ``unexplained`` is the energy beyond all that is expected, ``saturated`` a part of all
        readings."""
        common = np.nan
        if self._shots > 1 and unexplained > 0:
            common = (float(np.square(self._common).sum()) - self._common_noise) / self._shots / unexplained
        everything = [orthonormal(side) for side in self._factors]
        left = np.zeros(5)
        for each in self._lit_frames:
            own = each.ranges
            glossy = [orthonormal(_modulate(side)) for side in each.factors]
            ranges = own, (everything[0], own[1]), (own[0], everything[1]), everything, glossy
            left += [each.beyond(*pair) for pair in ranges]
        rows, columns, everywhere, gloss = 1 - left[1:] / left[0] if left[0] > 0 else np.full(4, np.nan)
        mask = self.predicted / unexplained if self.predicted is not None and unexplained > 0 else np.nan
        told = rows, columns, everywhere, gloss, common, saturated, mask, self.print_part()
        return Signatures(*(float(value) for value in told))

    def print_part(self) -> float:
        """Part of what the lit pixels leave of their frames that is print finer than a pixel; NaN where pixels of
        patterns overlap."""
        return print_part(self._lit_frames) if self._told_apart else np.nan

    @cached_property
    def _lit_frames(self) -> list[LitFrame]:
        slopes = [factor_slope(side, spline=True) for side in self._factors]
        frames = []
        for groups, frame, variance in zip(self._groups, self._frames, self._variances, strict=True):
            rows, columns = (group.pixels for group in groups)
            lit = self._factors[0][:, rows], self._factors[1][:, columns]
            blocks = block_indices(rows, self._factors[0].shape[1]), block_indices(columns, self._factors[1].shape[1])
            frames.append(LitFrame(frame, variance, lit, (slopes[0][:, rows], slopes[1][:, columns]), blocks))
        return frames


@dataclass(frozen=True, eq=False)
class _Lit:
    """Scene ``pixels`` of one side, and the ``weights`` (K,) with which measurements add up to light of these alone."""

    pixels: IndexArray
    weights: FloatArray


def _lit_groups(patterns: FloatArray) -> tuple[list[_Lit], bool]:
    """Groups of one side that measurements can be added up for, and whether there are such; otherwise each pattern's
    own lit pixels."""
    groups = group_pixels(patterns, "block")
    if all(group.shared is not None for group in groups):
        lit = [(group.pixels, group.shared[1]) for group in groups if group.shared and group.shared[1].any()]
        return [_Lit(pixels, psi / np.dot(psi, psi)) for pixels, psi in lit], True
    alone = np.eye(patterns.shape[1])
    own = [_Lit(np.flatnonzero(column), one) for column, one in zip(patterns.T, alone, strict=True) if column.any()]
    return own, False


def likely_cause(signatures: Signatures, unexplained: float, of_factors: float = 0.0) -> Cause:
    """The cause that the signatures point to.

    Parameters
    ----------
    signatures
        parts of what is unexplained.
    unexplained, of_factors
        a part of the measurements, and of the responses that the factors were told from, rms.
    """
    along, across = max(signatures.columns, signatures.rows), min(signatures.columns, signatures.rows)
    if signatures.saturated > _SATURATED:
        return Cause.SATURATION
    if signatures.mask > _MOST or of_factors > max(SEPARABLE_RESIDUAL, unexplained):
        return Cause.MASK
    # One axis explains what the other does not: a baseline. NaN compares as False throughout.
    if along > _MOST and along > 2 * across and not along < signatures.detail:
        return Cause.DEPTH
    if signatures.detail > _MOST:
        return Cause.DETAIL
    if signatures.common > _COMMON and signatures.everywhere > _EVERYWHERE:
        return Cause.AMBIENT
    if unexplained > _ALL:
        return Cause.RIG
    if signatures.everywhere > _MOST:
        return Cause.INDIRECT
    return Cause.GLOSS if signatures.gloss > _MOST else Cause.UNKNOWN


def _modulate(factor: FloatArray) -> FloatArray:
    """A factor's columns (m, c), and these times powers of the place along the sensor: (m, c (degree + 1))."""
    place = np.linspace(-1, 1, len(factor))[:, None]
    return np.concatenate([factor * place**power for power in range(_DEGREE + 1)], axis=1)
