"""Depth of the scene as a whole or for each projector pixel, by the least unexplained energy.

*One depth.* The energy ||Y||^2 - sum_ij ||U_Li^T Y_ij U_Rj||^2, which no lambda changes, has a narrow valley at the
true depth, and others where dots of period k see their neighbours' light. So depths are tried in steps of a pixel of
parallax, every valley that may be the lowest is followed to its bottom, and valleys that chance or the model's own
misfit may have raised are named beside the lowest. Columns of neighbouring depths are much alike: a few hundred vectors
span them, so that frames are read once and kept small.

*A depth for each pixel.* Every frame is first reconstructed at the calibrated depth as if all pixels along the baseline
were lit, which shows where each dot's light arrives. Then each pixel has columns of both factors at its own depth. The
model is linear in (X, X o d), d a change of 1/z, so that each Gauss-Newton step, with the d of neighbours pooled, is
one closed-form solve for each frame: its normal matrix is (L^T L) o (R^T R). Last, single pixels beside an edge take
the depth on its other side where that explains more. Depths whose parallax spans more than a period of the dots are
ambiguous."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter, maximum_filter, median_filter, minimum_filter
from scipy.optimize import minimize_scalar

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import Capture, Measurement
from mitsim.reconstruct.accumulation import FrameNoise, LitFrames, factor_energy
from mitsim.reconstruct.factorisation import Group, factorise, group_pixels
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.focus import (
    LEAST_PART,
    STEP,
    FactorOfDepths,
    are_dots,
    move_factors,
    parallax_of,
    parallax_period,
    pixels_of_parallax,
    unambiguous_parallax,
)
from mitsim.reconstruct.misfit import Misfit, weigh
from mitsim.reconstruct.residuals import CHANCE
from mitsim.reconstruct.solution import Solution, Status, Verdict
from mitsim.reconstruct.solver import centre_columns, centre_frame, prepare, project_frames

_STEP = 1.0
"""Projector pixels of parallax between depths that are tried first."""
_RESOLUTION = 0.01
"""Projector pixels of parallax to which valleys are refined: 0.06 mm at 400 mm and a baseline of 60 mm."""
_FEWEST = 32
"""Least number of steps, for devices without a baseline."""
_LEAST_RISE = 2e-5
"""Part of the measurements' energy that a pixel of parallax must add, or depth is undetermined. Uniform light stays
below."""
_SIMILAR = 2.0
"""Largest ratio of a valley's depth to that of the lowest valley."""
_OPPOSED = 4.0
"""Times the unexplained energy S by which two depths must differ. With r the light of the right depth that the wrong
one does not explain, the wrong one leaves less only if 2 r.d > |r|^2 for the misfit d of energy S, so |r|^2 < 4 S."""
_LAMBDA = 1e-3
"""Lambda over the largest sigma^2 of the image that weighs the noise of factors."""


# ---- A depth, its error and its alternatives ----


@dataclass(frozen=True)
class Alternative:
    """Another depth [mm] that explains the measurements as well, and its residual beyond the best (rms, relative)."""

    mm: float
    difference: float


@dataclass(frozen=True)
class Depth:
    """Depth whose factors are used.

    Attributes
    ----------
    error_mm
        Standard error, or the distance to an alternative; None for a given depth.
    doubt
        Reason for not trusting the depth, or nothing.
    range_mm
        Nearest and farthest tried depth.
    alternatives
        Depths that explain the measurements as well.
    at_end
        Whether the depth is an end of the tried range.
    """

    mm: float
    error_mm: float | None = None
    doubt: str = ""
    range_mm: tuple[float, float] | None = None
    alternatives: tuple[Alternative, ...] = ()
    at_end: bool = False

    def __str__(self) -> str:
        others = "".join(f" or {other.mm:.6g}" for other in self.alternatives)
        found = f"focus: {self.mm:.6g}{others} mm"
        if self.error_mm is None or self.range_mm is None:
            return found
        near, far = self.range_mm
        return f"{found} +- {self.error_mm:.1g}, by the least misfit from {near:.0f} to {far:.0f} mm"


# ---- The search for the depth that leaves least ----


def chance_difference(difference: float, variance: float, unknowns: int) -> float:
    """Return the energy by which noise may make the residuals of two models differ.

    Light of energy D (``difference``) that the wrong model does not explain meets noise of variance v: 4 v D. Noise
    that only one of the models takes up has the variance 4 v^2 times the ``unknowns``, or less.
    """
    return CHANCE * float(np.sqrt(4 * variance * max(difference, 0.0) + 4 * variance**2 * unknowns))


@single_threaded_blas()
def best_depth(shots: Capture, factors: Factors, depth_range: tuple[float, float] | None = None) -> Depth:
    """Return the depth whose factors explain most of the measurements.

    ``depth_range`` are the nearest and farthest tried depth [mm], by default a quarter of 1/z either way. Raises
    MitsimError without a stated parallax, and ArgumentError for a range that too little of the sensor knows.
    """
    return _Search(shots, factors, depth_range).find()


class _Search:
    def __init__(self, shots: Capture, factors: Factors, depth_range: tuple[float, float] | None) -> None:
        self._ends, self._period = shifts_searched(factors, depth_range), np.inf
        beyond = 0.0
        if depth_range is None:
            # A surface beyond the range, but for a period, is within it: only where a range is given that is excluded.
            self._period = parallax_period(shots.patterns, parallax_of(factors))
            beyond = min(self._period, self._ends[1])
        self._tried = self._ends[0] - beyond, self._ends[1] + beyond
        self._shots, self._factors = shots, factors
        rows, columns = shots.patterns
        self._groups = group_pixels(rows), group_pixels(columns)
        self._all = CommonBasis(shots, factors, self._tried, self._groups)
        self._inverse, self._factor_noise = 1 / parallax_of(factors).depth_mm, factors.manifest.noise
        self.pixel = 1 / max(self._all.reach(axis) for axis in (0, 1))
        self._unknowns = self._all.shape[0] * self._all.shape[1]

    def find(self) -> Depth:
        margin = 2 * _RESOLUTION * self.pixel
        valleys = sorted(self._valleys(*self._ends))
        valleys = sorted([*valleys, *self._beyond(valleys[0][1], margin)])
        least, shift = valleys[0]
        error, rise = self._certainty(shift, least)
        mm, range_mm = self._mm(shift), (self._mm(self._ends[1]), self._mm(self._ends[0]))
        at_end = min(abs(end - shift) for end in (*self._ends, *self._tried)) < margin
        local = float(np.hypot(error, _RESOLUTION * self.pixel)) * mm**2
        misfit = self._misfit(shift, least)
        if misfit and (self._ties(valleys, misfit) or rise < self._indifferent(rise, least, misfit)):
            misfit *= 1 - self._print_part(shift)
        ties = self._ties(valleys, misfit)
        others = tuple(
            Alternative(self._mm(other), float(np.sqrt((left - least) / self._all.energy))) for left, other in ties
        )
        doubt = ""
        if at_end or not self._ends[0] < shift < self._ends[1]:
            doubt = (
                f"End of range: {mm:.1f} mm explains most, and depths from {range_mm[0]:.0f} to {range_mm[1]:.0f} mm "
                "were tried, so the scene may lie beyond; give a range of depths that holds it, with --depth-range "
                "NEAR:FAR or depth_range, or calibrate nearer to it."
            )
        elif not (
            error < self.pixel and rise > max(self._indifferent(rise, least, misfit), _LEAST_RISE * self._all.energy)
        ):
            doubt = "These patterns hardly tell depth: use shifting dots."
        elif others:
            named = " and ".join(f"{other.mm:.1f} mm (by {other.difference:.1e} of them less, rms)" for other in others)
            doubt = (
                f"Depth may be another by whole periods of the dots: {mm:.1f} mm explains the measurements no better "
                f"than {named}, within chance and what no depth explains; use dots of a longer period, or give the "
                "range of depths."
            )
        return Depth(
            mm,
            float(np.hypot(local, max((abs(other.mm - mm) for other in others), default=0.0))),
            doubt,
            range_mm,
            others,
            at_end,
        )

    def left_over(self, shift: float) -> float:
        left, right = (
            factorise(self._all.side(axis, shift), patterns, groups)
            for axis, (patterns, groups) in enumerate(zip(self._all.patterns, self._groups, strict=True))
        )
        measured = np.outer(left.singular, right.singular) > 0
        return self._all.energy - float(np.square(project_frames(left, right, self._all.stack)[measured]).sum())

    # ---- Valleys of the energy over 1/z ----

    def _valleys(self, first: float, last: float) -> Iterator[tuple[float, float]]:
        steps = max(int(np.ceil((last - first) / (_STEP * self.pixel))), _FEWEST)
        shifts = np.linspace(first, last, steps + 1)
        scores = np.array([self.left_over(shift) for shift in shifts])
        beside = np.minimum(np.append(scores[1:], np.inf), np.append(np.inf, scores[:-1]))
        lows = sorted(map(int, np.flatnonzero(scores <= beside)), key=lambda index: float(scores[index]))
        least = below = np.inf
        for index in lows:
            if scores[index] - _SIMILAR * below > least:
                break
            left, shift = self._bottom(shifts[max(index - 1, 0)], shifts[min(index + 1, steps)])
            if left < least:
                half = shifts[1] - shifts[0]
                around = [self.left_over(float(np.clip(shift + part * half, first, last))) for part in (-0.5, 0.5)]
                least, below = left, max(around) - left
            yield left, shift

    def _beyond(self, shift: float, margin: float) -> Iterator[tuple[float, float]]:
        """Yield valleys beyond the range, whole periods of the dots from the best ``shift`` or beside it at an end."""
        for end, tried, step in zip(self._ends, self._tried, (-self._period, self._period), strict=True):
            if tried == end:
                continue
            if abs(shift - end) < margin:
                yield from self._valleys(*sorted((end, tried)))
            elif np.isfinite(self._period):
                away = shift + step
                while self._ends[0] <= away <= self._ends[1]:
                    away += step
                if abs(away) < abs(tried):
                    yield self._bottom(away - _STEP * self.pixel, away + _STEP * self.pixel)

    def _bottom(self, first: float, last: float) -> tuple[float, float]:
        least = minimize_scalar(
            self.left_over, bounds=(first, last), method="bounded", options={"xatol": _RESOLUTION * self.pixel}
        )
        return float(least.fun), float(least.x)

    # ---- Standard error, and valleys that may be as low ----

    def _certainty(self, shift: float, least: float) -> tuple[float, float]:
        before, after = (self.left_over(shift + part * self.pixel) for part in (-0.25, 0.25))
        rise = min(self.left_over(shift + self.pixel), self.left_over(shift - self.pixel)) - least
        curvature = (before - 2 * least + after) / (self.pixel / 4) ** 2
        error = float(np.sqrt(2 * self._variance(least) / curvature)) if curvature > 0 else float("inf")
        return error, float(rise)

    def _variance(self, least: float) -> float:
        return float(least / max(self._all.data - self._unknowns, 1))

    def _indifferent(self, difference: float, least: float, misfit: float) -> float:
        """Return the energy by which two depths may differ of which either is the right one."""
        return max(chance_difference(difference, self._variance(least), self._unknowns), _OPPOSED * misfit)

    def _ties(self, valleys: list[tuple[float, float]], misfit: float) -> list[tuple[float, float]]:
        least = valleys[0][0]
        return [each for each in valleys[1:] if each[0] - least < self._indifferent(each[0] - least, least, misfit)]

    # ---- Print, and what stays unexplained ----

    def _print_part(self, shift: float) -> float:
        there = move_factors(self._factors, self._mm(shift))
        lit = LitFrames(there.factors.sides, self._all.patterns)
        for each in there.of(self._shots).pattern_measurements():
            frame = centre_frame(each.frame) if there.factors.manifest.centre else each.frame
            lit.collect(each, frame, float(self._all.noise.variance[each.row, each.column]))
        return float(np.nan_to_num(lit.print_part()))

    def _misfit(self, shift: float, least: float) -> float:
        noise, stated = self._all.noise, self._factor_noise
        if not (noise.stated and stated):
            return 0.0
        prepared = prepare(self._all.side(0, shift), self._all.side(1, shift), *self._all.patterns)
        sums = prepared.accumulator()
        for each in self._all.frames:
            sums.add(each.frame, each.row, each.column)
        image = prepared.solve(sums, _LAMBDA * prepared.problem(sums).scale).image
        expected = float(noise.variance.mean()) * (self._all.data - self._unknowns) + self._all.part * noise.rendering
        of_factors = self._all.smoothing(shift) * factor_energy(prepared, self._all.patterns, stated, image)
        return float(max(least - expected - of_factors, 0.0))

    def _mm(self, shift: float) -> float:
        return 1 / (self._inverse + shift)


# ---- A basis that factors of all depths share ----

RANGE = 0.25
"""Searched part of 1/z on either side: 320 to 533 mm for 400."""
_LEFT_OUT = 1e-6
"""Part of the factors' energy that the common basis may omit."""
_STILL, _BETWEEN = 2.0, 4
"""Projector pixels of parallax up to which dots have a basis of their own along an axis, and depths a pixel of the
basis."""


class CommonBasis:
    """Frames of a capture, and factors of any depth within a range, on a basis that depths share.

    Parameters
    ----------
    shifts
        Least and largest change of 1/z [1/mm].
    groups
        Groups of scene pixels that patterns light apart (:func:`mitsim.reconstruct.factorisation.group_pixels`), each
        of which may have a basis of its own. None: all frames of an axis share one.

    Attributes
    ----------
    noise
        Noise of the measurements on the whole sensor.
    frames, stack
        Measurements on the bases, one by one and in one array (K, r, K', r').
    energy, outside
        Squared norm of the measurements where all depths are known, and the part that no depth explains.
    data, part
        Number of these measurements, and their part of the sensor.
    """

    def __init__(
        self,
        shots: Capture,
        factors: Factors,
        shifts: tuple[float, float],
        groups: tuple[tuple[Group, ...], tuple[Group, ...]] | None = None,
    ) -> None:
        self.parallax, self.patterns = parallax_of(factors), shots.patterns
        self._sides = tuple(
            FactorOfDepths(side, self.parallax, axis) for axis, side in enumerate((factors.left, factors.right))
        )
        self._centre = factors.manifest.centre
        self._parts, self._bases = [], list[_Basis]()
        for axis, side in enumerate(self._sides):
            pixels = (shifts[1] - shifts[0]) * side.reach
            alone = _alone(groups[axis], self.patterns[axis]) if groups and pixels <= _STILL else None
            tried = np.linspace(*shifts, max(int(np.ceil(pixels * (_BETWEEN if alone else 1))) + 1, 2))
            found = [side.at(shift) for shift in tried]
            part = slice(max(each.start for _, each in found), min(each.stop for _, each in found))
            if part.stop - part.start < LEAST_PART * len(side.factor):
                near, far = (1 / (1 / self.parallax.depth_mm + shift) for shift in reversed(shifts))
                raise ArgumentError(
                    "depth_range",
                    f"{near:.4g} to {far:.4g} mm: {max(part.stop - part.start, 0)} of {len(side.factor)} sensor rows "
                    f"or columns know the shadow at all of these depths; give a range nearer to the calibrated "
                    f"{self.parallax.depth_mm:g} mm",
                )
            self._parts.append(part)
            self._bases.append(_Basis([self._own(columns[part]) for columns, _ in found], alone))
        self.energy, kept = 0.0, list[Measurement]()
        left, right = self._bases
        self.stack = np.zeros((self.patterns[0].shape[1], left.size, self.patterns[1].shape[1], right.size))
        self.noise = FrameNoise(shots.manifest)
        for each in shots.pattern_measurements((len(factors.left), len(factors.right))):
            frame = each.frame[self._parts[0], self._parts[1]]
            frame = centre_frame(frame) if self._centre else frame
            self.energy += float(np.square(frame).sum())
            self.noise.add(each)
            small = self.stack[each.row, :, each.column]
            small[:] = left.of(each.row).T @ frame @ right.of(each.column)
            kept.append(Measurement(small, each.row, each.column, small, each.shots, 0))
        self.frames = tuple(kept)
        self.outside = self.energy - sum(float(np.square(each.frame).sum()) for each in kept)
        sizes = [part.stop - part.start for part in self._parts]
        self.data = len(kept) * sizes[0] * sizes[1]
        self.part = sizes[0] * sizes[1] / (len(factors.left) * len(factors.right))

    @property
    def shape(self) -> tuple[int, int]:
        """Scene pixels along both axes."""
        return self._sides[0].factor.shape[1], self._sides[1].factor.shape[1]

    def side(self, axis: int, shift: float | FloatArray) -> FloatArray:
        """Return the factor (r, n) of an ``axis`` on its basis, with 1/z changed by ``shift`` [1/mm]."""
        return self._bases[axis].project(self._own(self._columns_at(axis, shift)))

    def widen(self, axis: int, pixels: int) -> FloatArray:
        """Return the columns of an ``axis`` with ``pixels`` more a side, of the outermost pixels at other depths."""
        edges = self.edges(axis)
        before, beyond = (self._columns_at(axis, offset / edges) for offset in (-pixels, pixels))
        count = before.shape[1]
        columns = np.hstack([before[:, :pixels], self._columns_at(axis, 0.0), beyond[:, count - pixels :]])
        return self._bases[axis].project(self._own(columns))

    def edges(self, axis: int) -> FloatArray:
        """Return the projector pixels (n,) along an ``axis`` that a change of 1/z by 1/mm moves each pixel's light."""
        return self._sides[axis].edges

    def reach(self, axis: int) -> float:
        """Return the largest parallax along an ``axis`` by a change of 1/z by 1/mm [projector pixels]."""
        return self._sides[axis].reach

    def smoothing(self, shift: float) -> float:
        """Return the variance of noise in the factors at 1/z changed by ``shift``, over that of the calibrated ones."""
        return float(np.mean([side.noise(shift) ** 2 for side in self._sides]))

    def _columns_at(self, axis: int, shift: float | FloatArray) -> FloatArray:
        return self._sides[axis].at(shift)[0][self._parts[axis]]

    def _own(self, columns: FloatArray) -> FloatArray:
        return centre_columns(columns) if self._centre else columns


# ---- The range of depths, and vectors of the basis ----


def shifts_searched(factors: Factors, depth_range: tuple[float, float] | None) -> tuple[float, float]:
    """Return the least and largest change of 1/z [1/mm] of the searched depths."""
    parallax = parallax_of(factors)
    if depth_range is None:
        return -RANGE / parallax.depth_mm, RANGE / parallax.depth_mm
    near, far = depth_range
    if near <= parallax.mask_distance_mm:
        raise ArgumentError(
            "depth_range", f"{near:g} to {far:g} mm: begin above {parallax.mask_distance_mm:g} mm, where the mask is"
        )
    return 1 / far - 1 / parallax.depth_mm, 1 / near - 1 / parallax.depth_mm


def _alone(groups: tuple[Group, ...], patterns: FloatArray) -> list[tuple[npt.NDArray[np.intp], list[int]]] | None:
    lit = np.array([[group.lights(index) for index in range(patterns.shape[1])] for group in groups])
    if len(groups) == 1 or (lit.sum(axis=0) > 1).any():
        return None
    return [(group.pixels, [int(k) for k in np.flatnonzero(own)]) for group, own in zip(groups, lit, strict=True)]


class _Basis:
    def __init__(self, factors: list[FloatArray], alone: list[tuple[npt.NDArray[np.intp], list[int]]] | None) -> None:
        self._alone = alone or [(np.arange(factors[0].shape[1]), [])]
        found = [np.linalg.eigh(sum(own @ own.T for own in (f[:, px] for f in factors))) for px, _ in self._alone]
        lost = [np.cumsum(np.maximum(energies, 0.0)) for energies, _ in found]
        self.size = max(int((each > _LEFT_OUT * each[-1]).sum()) for each in lost)
        self._vectors = [vectors[:, -self.size :] for _, vectors in found]
        self._by_pattern = {
            index: vectors
            for (_, indices), vectors in zip(self._alone, self._vectors, strict=True)
            for index in indices
        }

    def of(self, index: int) -> FloatArray:
        return self._by_pattern.get(index, self._vectors[0])

    def project(self, columns: FloatArray) -> FloatArray:
        if len(self._vectors) == 1:
            return np.asarray(self._vectors[0].T @ columns)
        seen = np.zeros((self.size, columns.shape[1]))
        for (pixels, _), vectors in zip(self._alone, self._vectors, strict=True):
            seen[:, pixels] = vectors.T @ columns[:, pixels]
        return seen


_STEPS, _STEP_POOLED = 4, 3.0
"""Largest number of Gauss-Newton steps, and the standard deviation [pixels] over which changes of depth are pooled."""
_ROUNDS, _BESIDE = 4, 5
"""Largest number of rounds in which single pixels take another depth of the 5 x 5 around them."""
_SURE = 25.0
"""Variances of a datum that a pixel must explain more to take another depth: 5 standard deviations."""
_RIVAL, _ASTRAY = 2.0, 0.05
"""Starts that leave less than twice as much as the best one may place at most this part of the reliable pixels half a
period beside it.
"""
_RELIABLE = 0.5
"""Least confidence of a reliable depth: twice as much light arrives there as anywhere else."""
SPARE = 2.0
"""Projector pixels of the period that reliable depths must leave free, as many as a dot's image is wide."""


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Depths by projector pixel, and their image.

    Attributes
    ----------
    image, mm, confidence : (n, n') arrays
        Reflectance; depth; and 1 less the light at the second place over that at the first.
    lam
        Lambda of the image.
    left_over, energy, data
        Residual energy, energy and number of the measurements.
    part
        Part of the sensor of these measurements.
    doubt
        Reason for not trusting the depths, or nothing.
    range_mm
        Nearest and farthest searched depth.
    smoothing
        Variance of the factors' noise at these depths, over that of the calibrated ones.
    """

    image: FloatArray
    mm: FloatArray
    confidence: FloatArray
    lam: float
    left_over: float
    energy: float
    data: int
    part: float
    doubt: str = ""
    range_mm: tuple[float, float] | None = None
    smoothing: float = 1.0
    alternatives: tuple[Alternative, ...] = ()

    def __str__(self) -> str:
        if self.doubt:
            return "focus: no depths are told; the image is that of the calibrated one"
        message = self.summary()
        depths = f"{message['least_mm']:.4g} to {message['most_mm']:.4g} mm, median {message['median_mm']:.4g}"
        return f"focus: depths of {depths}, told for {message['told_part']:.0%} of pixels"

    @property
    def solution(self) -> Solution:
        """Image as a solution; dots leave fewer unknowns in a frame than the sensor has data."""
        residual = float(np.sqrt(self.left_over / self.energy))
        status = Status(Verdict.SOLVED, "Solved: a depth and a reflectance for each projector pixel")
        return Solution(self.image, self.lam, residual, status)

    @property
    def reliable(self) -> np.ndarray:
        """Whether each depth (n, n') is reliable."""
        return np.asarray(self.confidence >= _RELIABLE)

    def misfit(self, noise: FrameNoise, factor_energy: float | None, print_energy: float) -> Misfit:
        """Return the misfit of the measurements at these depths, over the sensor as a whole.

        ``factor_energy`` and ``print_energy`` are the energies that noise of the calibrated factors and print within a
        pixel may add to all frames.
        """
        spare = 1 - 2 * self.image.size / self.data  # a reflectance and a depth for each pixel
        variance = float(noise.variance.mean()) * self.data * spare
        expected = variance + self.part * (noise.rendering + self.smoothing * (factor_energy or 0.0))
        whole = self.left_over, self.energy, expected, self.data / noise.variance.size
        energies = tuple(np.array([[value]]) for value in whole)
        return weigh(energies, factor_energy is not None, noise, self.part * print_energy)[0]

    def channels(self) -> dict[str, npt.NDArray[np.float32]]:
        """Return the channels of depth.exr: depth [mm] and confidence."""
        return {"depth_mm": self.mm.astype(np.float32), "confidence": self.confidence.astype(np.float32)}

    def summary(self) -> dict[str, float]:
        """Return the entries of result.json."""
        reliable = self.mm[self.reliable] if self.reliable.any() else self.mm
        low, middle, high = (float(value) for value in np.percentile(reliable, (1, 50, 99)))
        return {"least_mm": low, "median_mm": middle, "most_mm": high, "told_part": float(self.reliable.mean())}


@single_threaded_blas()
def depth_map(
    shots: Capture,
    factors: Factors,
    lam: float | Literal["auto"] = "auto",
    depth_range: tuple[float, float] | None = None,
) -> DepthMap:
    """Return the depth of each projector pixel under shifting dots, and the image with all of them in focus.

    ``depth_range`` are the nearest and farthest searched depth [mm], by default a quarter of 1/z either way. Raises
    MitsimError for other patterns, and without parallax.
    """
    return _MapSearch(shots, factors, depth_range).find(lam)


class _MapSearch:
    def __init__(self, shots: Capture, factors: Factors, depth_range: tuple[float, float] | None) -> None:
        # Of a flat scene far from the calibrated depth dots of any period tell the rest.
        self._ends = shifts_searched(factors, depth_range)
        self._inverse = 1 / parallax_of(factors).depth_mm
        self._range_mm = 1 / (self._inverse + self._ends[1]), 1 / (self._inverse + self._ends[0])
        self._plane = best_depth(shots, factors, self._range_mm)
        self._middle = (self._ends[0] + self._ends[1]) / 2
        # A start, so in doubt any of several depths will do; but an end of the range is the depth of nothing.
        self._start = self._middle if self._plane.at_end else 1 / self._plane.mm - self._inverse
        self._arrivals = Arrivals(shots, factors, self._ends, max(abs(self._start), abs(self._middle)))
        self._all, self.width, self.pixel = self._arrivals.depths, self._arrivals.width, self._arrivals.pixel
        self._pixels = PixelDepths(self._all, self._arrivals.reach, STEP * self.pixel)

    def find(self, lam: float | Literal["auto"]) -> DepthMap:
        middle = self._middle / self.pixel
        tried = {(look, middle): self._left_over(self._arrivals.most(look, middle)[0]) for look in LAMBDAS}
        if self._arrivals.limited:
            look = min(tried, key=lambda start: tried[start])[0]
            plane = self._start / self.pixel
            offsets = {start + offset for start in (middle, plane) for offset in (0.0, *OFFSETS)} - {middle}
            tried |= {(look, offset): self._left_over(self._arrivals.most(look, offset)[0]) for offset in offsets}
        start = min(tried, key=lambda start: tried[start])
        rivals = [other for other, left_over in tried.items() if left_over < _RIVAL * tried[start]]
        shift, confidence = self._arrivals.most(*start)
        shift = self._sharpen(self._refine(shift, start[1] * self.pixel, tried[start]))
        doubt = self._doubt(shift, confidence, rivals)
        if doubt:
            shift, confidence = np.zeros(shift.shape), np.zeros(shift.shape)
        solved = self._pixels.solve(shift, None if lam == "auto" else lam)
        solved = self._pixels.final(shift, solved) if lam == "auto" else solved
        return DepthMap(
            solved.image,
            1 / (self._inverse + shift),
            confidence,
            solved.lam,
            solved.left_over,
            *(self._all.energy, self._all.data, self._all.part),
            doubt,
            self._range_mm,
            self._all.smoothing(float(np.median(shift))),
        )

    def _doubt(self, shift: FloatArray, confidence: FloatArray, rivals: Sequence[tuple[float, float]]) -> str:
        reliable = confidence >= _RELIABLE
        found = self._pixels.solve(shift)
        variance, unknowns = self._pixels.variance(found), 2 * shift.size
        less = found.left_over - self._left_over(np.zeros(shift.shape))
        # Of a sheet at the calibrated depth either may leave more.
        if not reliable.any() or less > chance_difference(less, variance, unknowns):
            return "Depths by pixel explain no more of the measurements than the calibrated one, which the image is of."
        span = float(np.ptp(np.percentile(shift[reliable], (1, 99))))
        astray = max(
            float((np.abs(self._arrivals.most(*rival)[0] - shift)[reliable] > self.width / 2).mean())
            for rival in rivals
        )
        spared = not self._arrivals.limited or self.width - span >= SPARE * self.pixel
        if not spared or astray > _ASTRAY:
            period = self.width / self.pixel
            why = f"Depths a period of the dots away, {period:.0f} projector pixels, explain nearly as much"
            if not spared:
                why = f"Parallax seems to span {span / self.pixel:.1f} of the {period:.0f} pixels of a period"
            return (
                f"{why}: depths may be off by a whole period, so the image is that of the calibrated one. Use dots of "
                f"a period of {2 * period:.0f} along the baseline, and of a short one across it."
            )
        ties = [(other.mm, other.difference**2 * self._all.energy) for other in self._plane.alternatives]
        others = [f"{mm:.1f}" for mm, more in ties if more < chance_difference(more, variance, unknowns)]
        if others:
            return (
                f"Depths may be off by a whole period of the dots: {self._plane.mm:.1f} or {' or '.join(others)} mm "
                "explain a flat scene as well, so the image is that of the calibrated one. Use dots of a longer period "
                "along the baseline, or give the range of depths."
            )
        return ""

    def _left_over(self, shift: FloatArray) -> float:
        return self._pixels.solve(shift).left_over

    def _refine(self, shift: FloatArray, offset: float, left_over: float) -> FloatArray:
        for _ in range(_STEPS):
            image, moved = self._pixels.step(shift, self.pixel)
            weight = gaussian_filter(np.square(image), _STEP_POOLED)
            change = gaussian_filter(image * moved, _STEP_POOLED) / np.maximum(weight, np.finfo(float).tiny)
            half = self.width / 2
            ahead = np.clip(shift + self.pixel * np.clip(change, -1, 1), offset - half, offset + half)
            ahead = median_filter(ahead, MEDIAN)
            now = self._left_over(ahead)
            if now >= left_over:
                break
            shift, left_over = ahead, now
        return shift

    def _sharpen(self, shift: FloatArray) -> FloatArray:
        solved = self._pixels.solve(shift)
        for _ in range(_ROUNDS):
            others = [of(shift, _BESIDE) for of in (minimum_filter, maximum_filter, median_filter)]
            gains = self._pixels.gains(shift, solved.image, others)
            sure = gains.max(axis=0) > _SURE * self._pixels.variance(solved)
            ahead = np.where(sure, np.choose(gains.argmax(axis=0), others), shift)
            now = self._pixels.solve(ahead)
            if now.left_over >= solved.left_over:
                break
            shift, solved = ahead, now
        return shift


# -------- Measurements and a depth for each projector pixel in, the image out

_SMALL = 1e-3
"""Lambda over the mean diagonal of the normal matrix while depths are searched."""
_LARGEST = 1e-2
"""Largest such lambda of the final image."""
_MOST_LIT = 4096
"""Pixels of one frame whose normal matrix has 128 MiB."""
_CUBIC = np.array([[0, -2, 3, -1], [6, -3, -6, 3], [0, 6, 3, -3], [0, -1, 0, 1]]) / 6
"""Lagrange cubic through -1, 0, 1, 2: weight of each by power of the place."""


@dataclass(frozen=True, eq=False)
class Solved:
    """Image (n, n') at given depths, its lambda, and the residual energy."""

    image: FloatArray
    lam: float
    left_over: float


class PixelDepths:
    """Model with a depth for each projector pixel.

    ``limit`` and ``step`` are the largest change of 1/z [1/mm], and the distance between those that columns are
    computed at.
    """

    def __init__(self, depths: CommonBasis, limit: float, step: float) -> None:
        self._all = depths
        self._shifts = np.linspace(-limit, limit, max(2 * int(np.ceil(limit / step)) + 1, len(_CUBIC)))
        self._tables = [np.stack([depths.side(axis, shift).T for shift in self._shifts], axis=1) for axis in (0, 1)]
        self._lit = [[np.flatnonzero(column) for column in patterns.T] for patterns in depths.patterns]
        most = max(len(row) for row in self._lit[0]) * max(len(column) for column in self._lit[1])
        if most > _MOST_LIT:
            raise MitsimError(
                f"focus map: {most} pixels are lit at a time, and {_MOST_LIT} can be told; use dots further apart"
            )
        middle = len(self._shifts) // 2
        left, right = (float(np.square(table[:, middle]).sum(axis=1).mean()) for table in self._tables)
        self._scale = left * right

    def solve(self, shift: FloatArray, lam: float | None = None) -> Solved:
        """Return the image with 1/z of each pixel changed by ``shift`` (n, n') [1/mm]; ``lam`` None: a small one."""
        lam = _SMALL * self._scale if lam is None else lam
        image, left_over = np.zeros(shift.shape), self._all.outside
        for frame in self._all.frames:
            lit = self._pixels(frame)
            left, right = (self._columns(axis, place, shift[lit]) for axis, place in enumerate(lit))
            normal, data = (left @ left.T) * (right @ right.T), ((left @ frame.frame) * right).sum(axis=1)
            found = np.linalg.solve(normal + lam * np.eye(len(data)), data)
            image[lit] = found
            left_over += float(np.square(frame.frame).sum() + found @ (normal @ found - 2 * data))
        return Solved(image, lam, left_over)

    def variance(self, solved: Solved) -> float:
        """Return the variance of a datum from the residual of a ``solved`` image."""
        return float(solved.left_over / max(self._all.data - 2 * solved.image.size, 1))

    def final(self, shift: FloatArray, solved: Solved) -> Solved:
        """Return the image at the lambda of its own residual: variance of a datum over the mean square of pixels."""
        ideal = self.variance(solved) / max(float(np.square(solved.image).mean()), np.finfo(float).tiny)
        return self.solve(shift, min(ideal, _LARGEST * self._scale))

    def step(self, shift: FloatArray, unit: float) -> tuple[FloatArray, FloatArray]:
        """Return X and X o d, both (n, n'), that explain most together; d changes ``shift``, in ``unit`` [1/mm]."""
        lam, image, moved = _SMALL * self._scale, np.zeros(shift.shape), np.zeros(shift.shape)
        for frame in self._all.frames:
            lit = self._pixels(frame)
            (u, du), (v, dv) = (
                (self._columns(axis, place, shift[lit]), unit * self._columns(axis, place, shift[lit], slope=True))
                for axis, place in enumerate(lit)
            )
            # Columns of the model are u v^T, and by d du v^T + u dv^T.
            uu, uv, vv = u @ u.T, (u @ du.T, v @ dv.T), v @ v.T
            across = uv[0] * vv + uu * uv[1]
            own = (du @ du.T) * vv + uu * (dv @ dv.T) + uv[0].T * uv[1] + uv[0] * uv[1].T
            normal = np.block([[uu * vv, across], [across.T, own]])
            seen, slid = u @ frame.frame, du @ frame.frame
            data = np.concatenate([(seen * v).sum(axis=1), (slid * v + seen * dv).sum(axis=1)])
            both = np.linalg.solve(normal + lam * np.eye(len(data)), data)
            image[lit], moved[lit] = np.split(both, 2)
        return image, moved

    def gains(self, shift: FloatArray, image: FloatArray, others: Sequence[FloatArray]) -> FloatArray:
        """Return the energy (others, n, n') that each pixel alone explains more at other changes of 1/z.

        Pixels of a frame are a period apart and hardly share measurements, so that each is judged with all else fixed.
        """
        gains = np.zeros((len(others), *shift.shape))
        for frame in self._all.frames:
            lit = self._pixels(frame)
            left, right = self._columns(0, lit[0], shift[lit]), self._columns(1, lit[1], shift[lit])
            rest = frame.frame - (left * image[lit][:, None]).T @ right
            for index, other in enumerate((shift, *others)):
                u, v = self._columns(0, lit[0], other[lit]), self._columns(1, lit[1], other[lit])
                own = image[lit] * (left * u).sum(axis=1) * (right * v).sum(axis=1)
                size = np.square(u).sum(axis=1) * np.square(v).sum(axis=1)
                explained = np.square(((u @ rest) * v).sum(axis=1) + own) / size
                if index == 0:
                    gains[:, lit[0], lit[1]] -= explained
                else:
                    gains[index - 1][lit] += explained
        return gains

    def _pixels(self, frame: Measurement) -> tuple[np.ndarray, np.ndarray]:
        rows, columns = np.meshgrid(self._lit[0][frame.row], self._lit[1][frame.column], indexing="ij")
        return rows.ravel(), columns.ravel()

    def _columns(self, axis: int, pixels: np.ndarray, shift: FloatArray, slope: bool = False) -> FloatArray:
        """Return columns (k, r) of the ``pixels`` of an axis at changes ``shift`` (k,) of 1/z, or their derivatives."""
        step = self._shifts[1] - self._shifts[0]
        place = (shift - self._shifts[0]) / step
        start = np.clip(np.floor(place).astype(np.intp), 1, len(self._shifts) - 3)
        part = place - start
        one, zero = np.ones_like(part), np.zeros_like(part)
        powers = [zero, one / step, 2 * part / step, 3 * part**2 / step] if slope else [one, part, part**2, part**3]
        weights = _CUBIC @ np.stack(powers)
        table = self._tables[axis]
        return np.asarray(sum(weight[:, None] * table[pixels, start + k - 1] for k, weight in enumerate(weights)))


# ---- Where most light of each projector pixel arrives ----------------------------------------------------------------


LAMBDAS = 1e-5, 1e-6, 1e-7
"""Tried lambdas over the largest sigma^2: smaller ones add noise, larger ones blur dots."""
OFFSETS = -1.0, -0.5, 0.5, 1.0
"""Projector pixels by which the range of displacements may be moved, because a surface at its end is ambiguous."""
MEDIAN = 5
"""Width of the median of places [projector pixels]."""
_POOLED = 1.0
"""Standard deviation over which light is pooled [projector pixels]."""
_BESIDE_LARGEST = 2
"""Projector pixels beyond the largest displacement, so that a dot's image is not cut."""
_LEAST_PARALLAX = 0.5
"""Least parallax of an axis over the range of depths [projector pixels]."""
_NEIGHBOURHOOD = 2.0
"""Projector pixels beside the largest light that belong to it."""


class Arrivals:
    """Places where light arrives, by pixel and change of 1/z.

    Parameters
    ----------
    ends
        Least and largest change of 1/z [1/mm] of the searched depths.
    beside
        Largest change of 1/z [1/mm] of the middle of the distinguishable depths.

    Attributes
    ----------
    pixel
        Change of 1/z [1/mm] that moves light by one projector pixel.
    width, reach
        Distinguishable changes of 1/z, and the largest tried one, either way.
    """

    def __init__(self, shots: Capture, factors: Factors, ends: tuple[float, float], beside: float) -> None:
        self._classes = [_classes(patterns) for patterns in shots.patterns]
        parallax, counts = parallax_of(factors), (factors.left.shape[1], factors.right.shape[1])
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
        self.width = min(
            self._span, unambiguous_parallax(np.where(self._open, moves, 0.0) * self.pixel, periods) * self.pixel
        )
        self.reach = beside + self.width / 2 + (max(OFFSETS) + _BESIDE_LARGEST) * self.pixel
        self.depths = CommonBasis(shots, factors, (-self.reach, self.reach))
        self._margin = int(np.ceil(self.reach / self.pixel)) + 1

    @property
    def limited(self) -> bool:
        """Whether the dots' period limits the range of depths."""
        return self.width < self._span

    def most(self, lam: float, offset: float) -> tuple[FloatArray, FloatArray]:
        """Return changes of 1/z by pixel where most light arrives, and the confidence.

        ``lam`` is relative to the largest sigma^2, ``offset`` the middle of the displacements [projector pixels].
        """
        count = 2 * int(np.ceil(self.width / self.pixel / STEP / 2)) + 1
        shifts = np.linspace(-self.width / 2, self.width / 2, count) + offset * self.pixel
        light = np.stack([self._arriving(self._class_images[lam], shift) for shift in shifts])
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
    def _class_images(self) -> dict[float, FloatArray]:
        sides, patterns = [], []
        for axis, opened in enumerate(self._open):
            side = self.depths.widen(axis, self._margin) if opened else self.depths.side(axis, 0.0)
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
    if not are_dots(patterns):
        raise MitsimError("focus map: needs shifting dots, such as dots:7x16, whose displacement tells depth")
    return np.asarray(patterns.argmax(axis=1))
