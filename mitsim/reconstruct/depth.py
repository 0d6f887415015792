"""Shots and factors in; the one depth out whose factors leave least of the measurements unexplained.

Only what lies in the model's range counts, whatever lambda: the energy ||Y||^2 - sum_ij ||U_Li^T Y_ij U_Rj||^2 of
:mod:`mitsim.reconstruct.misfit`. It has a narrow valley at the true depth, and others where dots of period k see their
neighbours' light: parallax by k pixels moves the image by as much, and all that tells the two apart are the image's
edges and what the sensor's own width adds to parallax. So depths are tried in steps of a pixel of parallax, every
valley that may be the lowest is followed to its bottom, and those that chance or the model's own misfit may have made
lower are named beside the lowest.

*The basis that depths share.* Columns of neighbouring depths are much alike: a few hundred vectors span all of them,
and what of a frame lies outside is not explained at any depth. So frames are read once and kept small.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import Capture, Measurement
from mitsim.reconstruct.accumulation import FrameNoise, factor_energy
from mitsim.reconstruct.factorisation import Group, factorise, group_pixels
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.focus import LEAST_PART, FactorOfDepths, move_factors, parallax_of, parallax_period
from mitsim.reconstruct.residuals import CHANCE
from mitsim.reconstruct.solver import centre_columns, centre_frame, prepare, project_frames
from mitsim.reconstruct.subpixel import LitFrames

_STEP = 1.0
"""Projector pixels of parallax between depths that are tried first: the valley is some two wide on either side."""
_RESOLUTION = 0.01
"""Projector pixels of parallax to which valleys are refined: 0.06 mm at 400 mm and a baseline of 60 mm; chosen, below
the millimetre that is asked for."""
_FEWEST = 32
"""Steps at least, where there is no baseline and only the sensor's own width tells depth."""
_LEAST_RISE = 2e-5
"""Part of the measurements' energy that a pixel of parallax must add to what is left over, or depth is not told.
Uniform light stays below it (5e-8 to 2e-5), and there print within pixels moves depth by up to 12 standard errors."""
_SIMILAR = 2.0
"""A valley's depth below the step next to it is at most so many times that of the lowest valley; chosen, as valleys of
one scene are alike in shape."""
_OPPOSED = 4.0
"""Times the unexplained energy S by which two depths must differ: r being what the wrong one does not explain of the
light of the right one, less is left of it than of the right one only if 2 r.d > |r|^2 for the misfit d of energy S; so
|r|^2 < 4 S."""
_LAMBDA = 1e-3
"""Of the image by which the noise of factors is weighed, over the largest sigma^2: chosen, like that of pixeldepths."""


# ---- A depth, its error and its alternatives ----


@dataclass(frozen=True)
class Alternative:
    """Another depth [mm] that explains the measurements as well, and how much less it explains (rms, relative to all
    measurements)."""

    mm: float
    difference: float


@dataclass(frozen=True)
class Depth:
    """A depth whose factors are used.

    Attributes
    ----------
    mm
        depth.
    error_mm
        standard error of one that was found; where another depth explains as much, the distance to it.
    doubt
        why it is not to be trusted, or nothing.
    range_mm
        nearest and farthest depth that were tried; None where it was given.
    alternatives
        depths that explain the measurements as well.
    at_end
        whether it is an end of what was tried, where nothing fits.
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
    """Energy by which noise may make what two models leave over differ.

    The light that the wrong one does not explain, of energy D, meets noise: 4 v D. The noise that one of them takes up
    and the other does not has the variance 4 v^2 times the unknowns, or less.

    Parameters
    ----------
    difference
        D that was found.
    variance
        v of a datum.
    unknowns
        of each model.
    """
    return CHANCE * float(np.sqrt(4 * variance * max(difference, 0.0) + 4 * variance**2 * unknowns))


@single_threaded_blas()
def best_depth(shots: Capture, factors: Factors, depth_range: tuple[float, float] | None = None) -> Depth:
    """The one depth whose factors explain most of the measurements.

    Parameters
    ----------
    shots
        of a scene.
    factors
        of the same camera, with their parallax.
    depth_range
        nearest and farthest depth [mm] that are tried; None: a quarter of 1/z either way of the calibrated one.

    Raises
    ------
    MitsimError
        for a calibration without parallax, or a frame that cannot be read; ArgumentError for a range that too little of
        the sensor knows.
    """
    return _Search(shots, factors, depth_range).find()


class _Search:
    """What one depth for the whole scene leaves of all measurements.

    Attributes
    ----------
    pixel
        change of 1/z [1/mm] that moves light by one projector pixel, along the axis where it moves more.
    """

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
        self._groups = group_pixels(rows, "auto"), group_pixels(columns, "auto")
        self._all = CommonBasis(shots, factors, self._tried, self._groups)
        self._inverse, self._factor_noise = 1 / parallax_of(factors).depth_mm, factors.manifest.noise
        self.pixel = 1 / max(self._all.reach(axis) for axis in (0, 1))
        self._unknowns = self._all.shape[0] * self._all.shape[1]

    def find(self) -> Depth:
        """The lowest valley, and all that may be as low."""
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
        """Energy of the measurements that factors moved by ``shift`` of 1/z leave."""
        left, right = (
            factorise(self._all.side(axis, shift), patterns, groups, "svd", "auto", False)
            for axis, (patterns, groups) in enumerate(zip(self._all.patterns, self._groups, strict=True))
        )
        measured = np.outer(left.singular, right.singular) > 0
        return self._all.energy - float(np.square(project_frames(left, right, self._all.stack)[measured]).sum())

    # ---- Valleys of the energy over 1/z ----

    def _valleys(self, first: float, last: float) -> Iterator[tuple[float, float]]:
        """Energy left over at the bottom of the lowest valley between two changes of 1/z and of those that may be as
        low, and changes of 1/z."""
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
        """The same of depths beyond the range that are a period of the dots from the best ``shift`` within it, or
        several; and of all beyond an end that it is, within the ``margin``."""
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
        """Least energy left over between two changes of 1/z, and where."""
        least = minimize_scalar(
            self.left_over, bounds=(first, last), method="bounded", options={"xatol": _RESOLUTION * self.pixel}
        )
        return float(least.fun), float(least.x)

    # ---- Standard error, and valleys that may be as low ----

    def _certainty(self, shift: float, least: float) -> tuple[float, float]:
        """Standard error of the ``shift`` that leaves ``least``, from a parabola through quarters of a pixel: what is
        left over rises by its own mean over a datum; and how much more is left a pixel beside."""
        before, after = (self.left_over(shift + part * self.pixel) for part in (-0.25, 0.25))
        rise = min(self.left_over(shift + self.pixel), self.left_over(shift - self.pixel)) - least
        curvature = (before - 2 * least + after) / (self.pixel / 4) ** 2
        error = float(np.sqrt(2 * self._variance(least) / curvature)) if curvature > 0 else float("inf")
        return error, float(rise)

    def _variance(self, least: float) -> float:
        """Of a datum, by what the best depth leaves."""
        return float(least / max(self._all.data - self._unknowns, 1))

    def _indifferent(self, difference: float, least: float, misfit: float) -> float:
        """Energy by which two depths may differ of which either is the right one."""
        return max(chance_difference(difference, self._variance(least), self._unknowns), _OPPOSED * misfit)

    def _ties(self, valleys: list[tuple[float, float]], misfit: float) -> list[tuple[float, float]]:
        """Those of the sorted ``valleys`` that may be the right one, beside the lowest, by what its depth leaves beyond
        noise."""
        least = valleys[0][0]
        return [each for each in valleys[1:] if each[0] - least < self._indifferent(each[0] - least, least, misfit)]

    # ---- Print, and what stays unexplained ----

    def _print_part(self, shift: float) -> float:
        """Part of the misfit at the depth of ``shift`` that is print finer than a scene pixel: its light lies on either
        side of the pixels' centres, so no other depth explains it."""
        there = move_factors(self._factors, self._mm(shift))
        lit = LitFrames(there.factors.sides, self._all.patterns)
        for each in there.of(self._shots).pattern_measurements():
            frame = centre_frame(each.frame) if there.factors.manifest.centre else each.frame
            lit.collect(each, frame, float(self._all.noise.variance[each.row, each.column]))
        return float(np.nan_to_num(lit.print_part()))

    def _misfit(self, shift: float, least: float) -> float:
        """Energy that the depth of ``shift`` leaves beyond what noise of frames and factors and rendering leave; 0
        where the noise is not stated."""
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
"""Depths that are looked for where no range is given, as a part of 1/z: 320 to 533 mm for 400. A baseline of 60 mm
moves light by an eighth of a window of 0.3 rad."""
_LEFT_OUT = 1e-6
"""Part of the factors' energy that the common basis of all depths may leave out: below their noise's."""
_STILL, _BETWEEN = 2.0, 4
"""Projector pixels of parallax up to which dots have a basis of their own along an axis, as depth hardly moves their
shadows there: a quarter of the vectors (54 of 200, 20 of 126), where more parallax leaves none out; and depths a pixel
that these are made of, as no neighbour's column makes up for one between."""


class CommonBasis:
    """Frames of a capture, and factors of any depth within a range.

    Parameters
    ----------
    shots, factors
        of the same camera; MitsimError for factors without parallax.
    shifts
        least and largest change of 1/z [1/mm]; ArgumentError where too little of the sensor knows all these depths.
    groups
        scene pixels along both axes that patterns light apart
        (:func:`mitsim.reconstruct.factorisation.group_pixels`): where each pattern lights one group, its frames may be
        on a basis of that alone, and so are the columns of :meth:`side`. None: all frames of an axis share one.

    Attributes
    ----------
    parallax, patterns
        of the factors and the shots.
    noise
        of the measurements on the whole sensor.
    frames, stack
        measurements on the bases, one by one and all in one (K, r, K', r').
    energy, outside
        squared norm of the measurements on the part of the sensor where all depths are known, and what of it no depth
        explains.
    data, part
        their number, and what part of the sensor they are of.
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
        """(r, n) factor of an ``axis`` on its basis, 1/z changed by ``shift`` [1/mm] for all pixels or for each."""
        return self._bases[axis].project(self._own(self._columns_at(axis, shift)))

    def widen(self, axis: int, pixels: int) -> FloatArray:
        """(r, ``pixels`` + n + ``pixels``) columns of an ``axis`` on its basis, with those that light beside the window
        has: of the outermost pixels, moved there by their depth."""
        edges = self.edges(axis)
        before, beyond = (self._columns_at(axis, offset / edges) for offset in (-pixels, pixels))
        count = before.shape[1]
        columns = np.hstack([before[:, :pixels], self._columns_at(axis, 0.0), beyond[:, count - pixels :]])
        return self._bases[axis].project(self._own(columns))

    def edges(self, axis: int) -> FloatArray:
        """(n,) projector pixels along an ``axis`` that a change of 1/z by 1/mm moves the light of each."""
        return self._sides[axis].edges

    def reach(self, axis: int) -> float:
        """Projector pixels that a change of 1/z by 1/mm moves what some sensor pixel sees, along an ``axis``."""
        return self._sides[axis].reach

    def smoothing(self, shift: float) -> float:
        """Variance of noise in the factors at 1/z changed by ``shift`` [1/mm], over that of the calibrated ones."""
        return float(np.mean([side.noise(shift) ** 2 for side in self._sides]))

    def _columns_at(self, axis: int, shift: float | FloatArray) -> FloatArray:
        return self._sides[axis].at(shift)[0][self._parts[axis]]

    def _own(self, columns: FloatArray) -> FloatArray:
        return centre_columns(columns) if self._centre else columns


# ---- The range of depths, and vectors of the basis ----


def shifts_searched(factors: Factors, depth_range: tuple[float, float] | None) -> tuple[float, float]:
    """Least and largest change of 1/z [1/mm] of the depths that are looked for.

    Parameters
    ----------
    factors
        with their parallax.
    depth_range
        nearest and farthest depth [mm], ArgumentError where the mask is beyond the nearest; None: :data:`RANGE`.
    """
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
    """Scene pixels of each group, and which of the ``patterns`` (n, K) light it; None where one lights several."""
    lit = np.array([[group.lights(index) for index in range(patterns.shape[1])] for group in groups])
    if len(groups) == 1 or (lit.sum(axis=0) > 1).any():
        return None
    return [(group.pixels, [int(k) for k in np.flatnonzero(own)]) for group, own in zip(groups, lit, strict=True)]


class _Basis:
    """Orthonormal vectors (m, ``size``) that span the columns of all ``factors`` (m, n) but for a part of their energy;
    of those pixels that are lit ``alone``, where that is given, each with its patterns."""

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
        """(m, size) vectors for frames of pattern ``index``."""
        return self._by_pattern.get(index, self._vectors[0])

    def project(self, columns: FloatArray) -> FloatArray:
        """(size, n) the ``columns`` (m, n) on the basis of each."""
        if len(self._vectors) == 1:
            return np.asarray(self._vectors[0].T @ columns)
        seen = np.zeros((self.size, columns.shape[1]))
        for (pixels, _), vectors in zip(self._alone, self._vectors, strict=True):
            seen[:, pixels] = vectors.T @ columns[:, pixels]
        return seen
