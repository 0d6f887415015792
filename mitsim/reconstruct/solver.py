"""Factorised solver of a separable lensless camera, and the automatic lambda.

The solver minimises sum_ij ||Y_ij - Phi_L (P_ij o X) Phi_R^T||^2 + lambda ||X||^2 (arXiv 2111.12862, eq. 6). The
factors are prepared once, and frames are added one by one:

>>> prepared = prepare(left, right, P_L, P_R)
>>> frames = prepared.accumulator()
>>> frames.add(Y, i, j)                           # for each pattern P_L[:, i] P_R[:, j]^T
>>> solution = prepared.solve(frames, "auto")

With B = U S V^T on each side and W = sum_ij U_Li^T Y_ij U_Rj, the solution
is X = V_L [(s_L s_R^T o W) / (s_L^2 s_R^2^T + lambda)] V_R^T. The rounding error is about eps / sqrt(lambda_rel),
where lambda_rel = lambda / (max s_L^2 max s_R^2). The paper's Q = sum (Phi_L^T Y Phi_R) o P in place of W would give
eps / lambda_rel (docs/decisions.md).

*One side.* With K patterns p_i, the stacked matrix B = [Phi diag(p_1); ...; Phi diag(p_K)] (m K, n) describes one
side: the paper's A = Phi^T Phi o P P^T (arXiv 2111.12862, eq. 7) is B^T B. Forming A squares the condition number, so
B = U S V^T itself is factorised, and row block i of U is kept as *slab* i, on which frames of pattern i are projected.

Where P P^T vanishes between groups of scene pixels, each *block* of B is factorised alone, and slab i contains only the
blocks that pattern i lights.

*Correlated neighbours.* With the covariance rho^|p - p'| along rows and columns (a separable first-order Markov field;
Jain, Fundamentals of Digital Image Processing, 1989, chapter 2), X = F_L Z F_R^T with independent Z, so that the SVD
of S V^T F keeps the closed form.

*Lambda.* Coefficient W_ij is kept by the share sigma_ij^2 / (sigma_ij^2 + lambda). Where the model explains the
frames, lambda minimises an unbiased estimate of the image's error. Elsewhere the image must also be stable when lambda
changes.

*Noise by halves of the sensor.* With G = U_0^T U_0 of half of the sensor's rows, W_0 - G W contains no image: white
noise of variance v gives its number i the variance v (G (I - G))_ii. If the left factor's errors are independent
between sensor rows, each error changes a whole column of W. Halves of the sensor's columns show errors of the right
factor in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar
from scipy.sparse.csgraph import connected_components

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas

# ---- Solution and status ---------------------------------------------------------------------------------------------


class Verdict(Enum):
    """Result of a solver or a calibration; the value is its name in files."""

    SOLVED = "solved"
    """Every direction of the image is measured."""
    PARTLY_MEASURED = "partly measured"
    """Some directions of the image follow from regularisation alone."""
    UNDER_DETERMINED = "under-determined"
    """There are fewer sensor rows or columns than scene rows or columns."""
    RANK_DEFICIENT = "rank deficient"
    """Some directions are not measured, and nothing fills them."""
    ILL_CONDITIONED = "ill-conditioned"
    """Rounding may change the visible image."""
    MISFIT = "misfit"
    """The measurements contain more than any image explains."""
    NOT_CONVERGED = "not converged"
    """The iterations ended before the image was constant."""
    CALIBRATED = "calibrated"
    """Factors explain the responses."""
    NOT_SEPARABLE = "not separable"
    """The responses contain more than any factors explain."""
    MOSTLY_NOISE = "mostly noise"
    """Factors have a large error."""
    UNKNOWN = "unknown"
    """Factors of another program, of unknown quality."""

    @property
    def good(self) -> bool:
        return self in (Verdict.SOLVED, Verdict.PARTLY_MEASURED, Verdict.CALIBRATED, Verdict.UNKNOWN)


@dataclass(frozen=True)
class Status:
    """Verdict on a result, with the reason and the remedy; ``str`` gives all of it in sentences."""

    verdict: Verdict
    sentence: str
    remedy: str = ""
    figures: str = ""
    flags: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether the verdict is good and nothing was flagged before."""
        return self.verdict.good and not self.flags

    @property
    def reasons(self) -> tuple[str, ...]:
        """Reasons why the result is flagged, each with its remedy."""
        own = f"{self.sentence}; {self.remedy}" if self.remedy else self.sentence
        if self.verdict.good:
            return (*self.flags, own) if self.flags and self.remedy else self.flags
        return own, *self.flags

    def __str__(self) -> str:
        remedy = f"; {self.remedy}" if self.remedy else ""
        return " ".join(part for part in (f"{self.sentence}{remedy}.", self.figures, *self.flags) if part)

    def with_misfit(self, sentence: str, remedy: str) -> Status:
        """Return the status with a misfit, as the verdict if it is good so far and as a flag otherwise."""
        if self.verdict.good:
            return replace(self, verdict=Verdict.MISFIT, sentence=sentence, remedy=remedy)
        return replace(self, flags=(*self.flags, f"{sentence}; {remedy}."))


@dataclass(frozen=True, eq=False)
class Solution:
    """Image with the statistics and the status of its solver.

    Attributes
    ----------
    image : (n, n') array
        Estimate of X, neither clipped nor normalised.
    lam
        Lambda in the unit of the model squared; for total variation its weight [data^2 / image].
    residual
        ||Y - model|| / ||Y|| over all frames, above a rounding of about 1e-8; of conjugate gradients the residual of
        the normal equations, relative to their right-hand side.
    rounding
        Bound of ||error|| / ||image|| by rounding; None if the solver has no bound.
    iterations
        0 in closed form.
    objective, relative_gap
        Minimised function, and an upper bound of its excess over the minimum, relative to the part that images change;
        None in closed form.
    """

    image: FloatArray
    lam: float
    residual: float
    status: Status
    rounding: float | None = None
    iterations: int = 0
    objective: float | None = None
    relative_gap: float | None = None

    @property
    def ok(self) -> bool:
        """Whether the image can be used without a correction."""
        return self.status.ok


# ---- One side of the model -------------------------------------------------------------------------------------------

IndexArray = npt.NDArray[np.intp]
Pair = tuple[FloatArray, FloatArray]
Strips = tuple[slice, ...]


@dataclass(frozen=True, eq=False)
class Group:
    """Scene pixels (c,) factorised together; ``shared`` is (weights (c,), psi (K,)) if patterns are weights psi^T."""

    pixels: IndexArray
    patterns: FloatArray
    shared: Pair | None


@dataclass(frozen=True, eq=False)
class Slab:
    columns: slice | IndexArray
    matrix: FloatArray


@dataclass(frozen=True, eq=False)
class Side:
    """Factorised side of the model: right singular vectors ``basis`` (n, r) and singular values (r,) of B.

    Numerically zero singular values are exactly 0. ``data_rows`` is m K, less K once frames are centred. ``dual`` (n,
    r) is V' with B = U S V'^T, None if V' is the basis. ``spread`` is the condition of the matrix that makes the
    basis, which magnifies rounding.
    """

    basis: FloatArray
    singular: FloatArray
    slabs: tuple[Slab, ...]
    pattern_count: int
    sensor_size: int
    scene_size: int
    data_rows: int
    dual: FloatArray | None = None
    spread: float = 1.0

    @cached_property
    def response(self) -> FloatArray:
        """B^T U (n, r), the response of the coefficients to each scene pixel."""
        return _frozen(self.duals * self.singular)

    @property
    def duals(self) -> FloatArray:
        return self.basis if self.dual is None else self.dual

    @property
    def common(self) -> FloatArray:
        total = np.zeros((self.sensor_size, len(self.singular)))
        for slab in self.slabs:
            total[:, slab.columns] += slab.matrix
        return total

    def columns(self, index: int) -> IndexArray:
        return np.arange(len(self.singular))[self.slabs[index].columns]

    @property
    def rank(self) -> int:
        return int(np.count_nonzero(self.singular))

    @property
    def condition(self) -> float:
        if self.rank < self.scene_size:
            return float("inf")
        return float((self.singular.max() / self.singular.min()) ** 2)

    @cached_property
    def halves(self) -> tuple[Strips, Strips]:
        """Sensor rows of the two halves as strips, because an index array would copy each frame."""
        width = -(-self.sensor_size // 8)
        strips = tuple(slice(first, first + width) for first in range(0, self.sensor_size, width))
        return strips[::2], strips[1::2]

    @cached_property
    def first_half(self) -> FloatArray:
        """G = U_0^T U_0 (r, r), with U_0 the rows of U in the first half of the sensor."""
        gram = np.zeros((len(self.singular), len(self.singular)))
        for index, slab in enumerate(self.slabs):
            rows = np.concatenate([slab.matrix[strip] for strip in self.halves[0]])
            columns = self.columns(index)
            gram[np.ix_(columns, columns)] += rows.T @ rows
        return gram


def pattern_blocks(patterns: FloatArray) -> tuple[IndexArray, ...]:
    """Return the groups of scene pixels between which P P^T vanishes, sorted by their first pixel.

    Whole-number ``patterns`` P (n, K) are multiplied in integers, so that orthogonal rows give an exact zero.
    Otherwise two pixels are separated only if no pattern lights both.
    """
    kinds, kind = np.unique(patterns, axis=0, return_inverse=True)
    whole = np.rint(kinds)
    if np.array_equal(whole, kinds) and np.abs(whole).max(initial=0) < 2**24:
        linked = (whole.astype(np.int64) @ whole.astype(np.int64).T) != 0
    else:
        lit = (kinds != 0).astype(np.int64)
        linked = (lit @ lit.T) != 0
    count, label = connected_components(linked, directed=False)
    found = [np.flatnonzero(label[kind.ravel()] == block) for block in range(count)]
    return tuple(sorted(found, key=lambda block: int(block[0])))


def group_pixels(patterns: FloatArray) -> tuple[Group, ...]:
    groups = []
    for block in pattern_blocks(patterns):
        lit, own = np.flatnonzero(patterns[block].any(axis=1)), patterns[block]
        psi = own[lit[0]] if len(lit) else np.zeros(own.shape[1])
        weights = np.zeros(len(own))
        if len(lit):
            pivot = int(np.flatnonzero(psi)[0])
            weights = own[:, pivot] / psi[pivot]
        groups.append(Group(block, own, (weights, psi) if np.array_equal(np.outer(weights, psi), own) else None))
    return tuple(groups)


def factorise(phi: FloatArray, patterns: FloatArray, groups: tuple[Group, ...], centred: bool = False) -> Side:
    """Return a side from its factor ``phi`` (m, n) and ``patterns`` (n, K), whose pixels fall into ``groups``.

    The SVD is numpy's, because scipy's wheel has a second thread pool (2.5 s instead of 15 ms on a busy machine).
    """
    sensor, scene = phi.shape
    parts: list[tuple[Sequence[FloatArray], FloatArray, FloatArray]] = []
    for group in groups:
        if group.shared is not None:
            # B = psi (x) Phi diag(w): the SVD of one slab serves all, whatever K.
            weights, psi = group.shared
            norm = float(np.linalg.norm(psi))
            left, values, right = np.linalg.svd(phi[:, group.pixels] * weights, full_matrices=False)
            # Without the work for 1, and without columns for 0.
            scaled = [left[:, :0] if k == 0.0 else left if k == 1.0 else left * k for k in psi / (norm or 1.0)]
            parts.append((scaled, values * norm, right))
        else:
            # Phi = Q R once: B = (I (x) Q) [R diag(p_1); R diag(p_2); ...] is then as short as R, and as accurate.
            q, small = np.linalg.qr(phi[:, group.pixels])
            stacked = np.concatenate([small * column for column in group.patterns.T])
            left, values, right = np.linalg.svd(stacked, full_matrices=False)
            parts.append(([q @ slab for slab in np.split(left, group.patterns.shape[1])], values, right))
    singular = np.concatenate([part[1] for part in parts])
    starts = np.concatenate(([0], np.cumsum([len(part[1]) for part in parts])))
    basis = np.zeros((scene, len(singular)))
    for group, part, start, stop in zip(groups, parts, starts[:-1], starts[1:], strict=True):
        basis[group.pixels, start:stop] = part[2].T
    # Rank cut of numpy.linalg.matrix_rank, against the largest value of the whole side, not of the block.
    longest = max(sensor * patterns.shape[1], scene)
    singular[singular <= singular.max() * longest * np.finfo(np.float64).eps] = 0.0
    slabs = []
    for index in range(patterns.shape[1]):
        lit = [b for b, group in enumerate(groups) if group.patterns[:, index].any()]
        columns = np.concatenate([np.arange(starts[b], starts[b + 1]) for b in lit] or [np.arange(0)])
        pieces = [parts[b][0][index] for b in lit] or [np.zeros((sensor, 0))]
        # Equally spaced columns are a slice, because basic indexing is a view and twice as fast.
        step = int(columns[1] - columns[0]) if len(columns) > 1 else 1
        even = len(columns) > 0 and bool((np.diff(columns) == step).all())
        places = slice(int(columns[0]), int(columns[-1]) + 1, step) if even else columns
        slabs.append(Slab(places, _frozen(np.concatenate(pieces, axis=1))))
    return Side(
        basis=_frozen(basis),
        singular=_frozen(singular),
        slabs=tuple(slabs),
        pattern_count=patterns.shape[1],
        sensor_size=sensor,
        scene_size=scene,
        data_rows=(sensor - centred) * patterns.shape[1],
    )


def _frozen(array: FloatArray) -> FloatArray:
    array = np.ascontiguousarray(array)
    array.flags.writeable = False
    return array


NEIGHBOURS = 0.9
"""Correlation rho of neighbouring pixels; 0.8 to 0.98 are within 0.7 dB of each other (docs/decisions.md)."""


def _correlate_side(side: Side) -> Side:
    place = np.arange(side.scene_size)
    # F F^T is the covariance rho^|p - p'| of a row of pixels.
    root = np.asarray(np.linalg.cholesky(NEIGHBOURS ** np.abs(place[:, None] - place)))
    turned, singular, right = np.linalg.svd(side.response.T @ root, full_matrices=False)
    singular[singular <= singular.max() * side.scene_size * np.finfo(np.float64).eps] = 0.0
    # The dual of F V' is F^-T V': both made with the triangular root, neither with an inverse of C.
    return replace(
        side,
        basis=root @ right.T,
        dual=np.linalg.solve(root.T, right.T),
        singular=singular,
        slabs=tuple(Slab(slice(0, len(singular)), slab.matrix @ turned[slab.columns]) for slab in side.slabs),
        spread=float(np.linalg.cond(root)),
    )


# ---- Lambda ----------------------------------------------------------------------------------------------------------


def check_lambda(lam: float | str) -> float:
    if isinstance(lam, str) or not (np.isfinite(lam) and lam >= 0):
        raise MitsimError(f"lambda is {lam}; give a finite number of at least 0")
    return float(lam)


RISK_POWER = 0.5
"""Power of sigma that weights errors: 0 is the image's error, 2 that of the frames (docs/decisions.md)."""
MISFIT_RATIO = 1.2
"""Limit of noise outside the range over noise inside: prints have 0.92 to 1.02, depth and gloss 1.4 and more."""
_TAKEN, _TAKEN_RISE = 30.0, 4
_EXPONENTS = np.arange(np.log10(np.finfo(np.float64).eps), 1.01, 0.25)
_FAINT, _FEWEST = 2.0, 20


@dataclass(frozen=True, eq=False)
class DiagonalProblem:
    """Inverse problem in its diagonal basis.

    ``sigma`` (r, r') are the singular values, exact zeros beyond the rank, and ``projected`` (r, r') the data W, of
    which ``struck`` is known to be neither image nor noise, up to its sign. ``halves`` show the noise; None assumes
    white noise.
    """

    sigma: FloatArray
    projected: FloatArray
    energy: float
    data_count: int
    halves: Halves | None = None
    struck: FloatArray | float = 0.0
    least: float = 0.0

    def taken_energy(self, lam: float) -> float:
        return float(np.sum(np.square((1 - self.kept_share(lam)) * self.projected)))

    def kept_share(self, lam: float) -> FloatArray:
        squared = np.square(self.sigma)
        return np.divide(squared, squared + lam, out=np.zeros_like(squared), where=squared > 0)

    @property
    def scale(self) -> float:
        return float(np.square(self.sigma.max()))


def risk_score(problem: DiagonalProblem, lam: float, noise: float | FloatArray) -> float:
    """Return an unbiased estimate of the weighted squared error of the image at ``lam``, up to a constant.

    With kept shares k, coefficient (k W / sigma) has the expected squared error (1 - k)^2 x^2 + k^2 noise / sigma^2,
    and (W^2 - noise) / sigma^2 estimates x^2 without bias.
    """
    measured = problem.sigma > 0
    sigma, data = problem.sigma[measured], np.square(problem.projected[measured])
    variance = np.broadcast_to(noise, problem.sigma.shape)[measured]
    kept = problem.kept_share(lam)[measured]
    errors = ((kept - 2) * (data - variance) + kept * variance) / (np.square(sigma) + lam)
    return float(np.sum(sigma**RISK_POWER * errors))


def noise_variance(problem: DiagonalProblem) -> float:
    spare = problem.data_count - np.count_nonzero(problem.sigma)
    if spare <= 0:
        raise MitsimError("too few data to estimate the noise; use more patterns (dots:7), or give a number for lambda")
    inside = np.square(problem.projected[problem.sigma > 0]).sum()
    return max(problem.energy - float(inside), 0.0) / spare


def is_misfit(problem: DiagonalProblem) -> bool:
    if not problem.halves:
        return False
    chance = 3 * MEDIAN_SPREAD / float(np.sqrt(2 * np.count_nonzero(problem.sigma)))
    return noise_variance(problem) > (MISFIT_RATIO + chance) * problem.halves.typical


def coefficient_noise(problem: DiagonalProblem) -> float | FloatArray:
    """Return the noise variance of each number (r, r') of ``problem.projected``, or of all.

    It is the noise outside the model's range or, where larger or without a fit, that of the sensor's halves.
    """
    white, halves = noise_variance(problem), problem.halves
    if not halves:
        return white + np.square(problem.struck)
    least = halves.typical if is_misfit(problem) else float(np.fmax(white, halves.typical))
    noise = least + halves.excess + np.square(problem.struck)
    # Octaves of sigma whose signal would need a scene brighter than the octaves before contain more noise.
    measured = problem.sigma > 0
    sigma, found = problem.sigma[measured], noise[measured]
    octave = np.log2(sigma.max() / sigma).astype(np.intp)
    sizes = np.bincount(octave)
    values = np.square(problem.projected[measured]), found, np.square(sigma)
    data, level, square = (np.bincount(octave, each) / np.maximum(sizes, 1) for each in values)
    power = np.divide(np.maximum(data - level, 0.0), square, out=np.zeros_like(square), where=square > 0)
    before = np.cumsum(sizes * power) / np.cumsum(sizes)
    seen = sizes >= _FEWEST
    doubtful = ((data < _FAINT * level) & seen)[1:] & (power[1:] > before[:-1])
    doubtful[: np.flatnonzero((data >= _FAINT * level) & seen).max(initial=0)] = False
    if doubtful.any():
        beyond = octave > int(np.argmax(doubtful))
        noise[measured] = np.where(beyond, found * np.maximum(data[octave] / level[octave], 1.0), found)
    return noise


def automatic_lambda(problem: DiagonalProblem, explained: bool = True) -> float:
    """Return the lambda in the unit of sigma^2 that minimises :func:`risk_score`, but at least ``problem.least``.

    Where the model does not explain the frames, the steadiest image above that lambda is used.
    Raises MitsimError without more data than unknowns, or without a signal.
    """
    noise = coefficient_noise(problem)
    if problem.energy == 0:
        raise MitsimError("all frames are zero: lambda cannot be chosen; check exposure and black level")

    lam = best_lambda(lambda lam: risk_score(problem, lam, noise), problem.scale)
    if is_misfit(problem) or not explained:
        # Beyond the largest sigma^2 all goes to black, and at lambda 0 nothing moves, however large its noise.
        candidates = problem.scale * 10.0 ** _EXPONENTS[_EXPONENTS <= 0]
        lam = _steadiest(problem, [max(lam, candidates[0]), *candidates[candidates > max(lam, candidates[0])].tolist()])
    return max(lam, problem.least)


def best_lambda(risk: Callable[[float], float], scale: float) -> float:
    """Return the lambda, 0 or a part of ``scale``, of the least ``risk``."""

    def score(exponent: float) -> float:
        return risk(scale * 10.0**exponent)

    best = int(np.argmin([score(exponent) for exponent in _EXPONENTS]))
    if best == 0 and risk(0.0) <= score(_EXPONENTS[0]):
        return 0.0
    ends = _EXPONENTS[max(best - 1, 0)], _EXPONENTS[min(best + 1, len(_EXPONENTS) - 1)]
    refined = minimize_scalar(score, bounds=ends, method="bounded", options={"xatol": 1e-3})
    return float(scale * 10.0 ** float(refined.x))


def end_of_range(problem: DiagonalProblem, lam: float) -> tuple[str, ...]:
    lowest, highest = problem.scale * 10.0 ** np.array([_EXPONENTS[0], 0.0])
    if lam >= highest:
        return ("Automatic lambda is the largest that is tried: the frames show hardly more than noise.",)
    if lam <= lowest and np.square(problem.sigma[problem.sigma > 0]).min() < 100.0 * lowest:
        return (
            "Automatic lambda is the smallest that is tried, so that weakly measured directions of the image may be "
            "noise; compare with a larger lambda.",
        )
    return ()


def _steadiest(problem: DiagonalProblem, lambdas: list[float]) -> float:
    """Return the rising lambda at which the image moves least, as far as misfit explains the removed energy.

    The movement ||lambda dX / dlambda||^2 of the image needs no noise level (Tikhonov and Glasko 1965).
    """
    moved, sizes = np.zeros((2, len(lambdas)))
    for number, lam in enumerate(lambdas):
        kept = problem.kept_share(lam)
        measured = kept > 0
        sigma, data = problem.sigma[measured], (kept * problem.projected)[measured]
        moved[number] = np.sum(np.square((kept * (1 - kept) * problem.projected)[measured] / sigma))
        sizes[number] = np.sum(np.square(data / sigma))
    if len(moved) > 1 and moved[-1] < moved[-2]:
        moved /= sizes
    count = len(moved)
    if problem.halves and np.isfinite(problem.halves.typical):
        noise = noise_variance(problem)
        excess = max(noise / problem.halves.typical, 1.0)
        most = _TAKEN * excess**_TAKEN_RISE * noise * np.count_nonzero(problem.sigma)
        while count > 1 and problem.taken_energy(lambdas[count - 1]) > most:
            count -= 1
        while 1 < count < len(moved) and moved[count] < moved[count - 1]:
            count -= 1
    return lambdas[int(np.argmin(moved[:count]))]


# -------- W by quarters of the sensor in

MEDIAN_SPREAD = 2.33


@dataclass(frozen=True, eq=False)
class Halves:
    quarters: FloatArray
    left: Side
    right: Side

    @cached_property
    def differences(self) -> Pair:
        total = self.quarters.sum(axis=(0, 1))
        by_row = self.quarters[0].sum(axis=0) - self.left.first_half @ total
        by_column = self.quarters[:, 0].sum(axis=0) - total @ self.right.first_half
        return by_row, by_column

    @cached_property
    def _squares(self) -> Pair:
        spreads = (half_spread(side.first_half) for side in (self.left, self.right))
        rows, columns = (np.where(spread >= 0.01, spread, np.nan) for spread in spreads)
        measured, (by_row, by_column) = np.outer(self.left.singular, self.right.singular) > 0, self.differences
        found = np.square(by_row) / rows[:, None], np.square(by_column) / columns
        return np.where(measured, found[0], np.nan), np.where(measured, found[1], np.nan)

    @cached_property
    def typical(self) -> float:
        return float(_medians(np.concatenate(self._squares, axis=None)[None])[0])

    @cached_property
    def excess(self) -> FloatArray:
        found = []
        for squares in (self._squares[0].T, self._squares[1]):
            level, count = _medians(squares), np.maximum((~np.isnan(squares)).sum(axis=1), 1)
            middle = np.nan if np.isnan(level).all() else np.nanmedian(level)
            significant = level > middle * (1 + 2.0 * MEDIAN_SPREAD / np.sqrt(count))
            found.append(np.where(significant, level - middle, 0.0))
        return np.asarray(found[0] + found[1][:, None])


def half_spread(half: FloatArray) -> FloatArray:
    return np.asarray(np.diag(half) - np.einsum("ij,ji->i", half, half))


def robust_scatter(values: FloatArray) -> float:
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def _medians(squares: FloatArray) -> FloatArray:
    ordered, count = np.sort(squares, axis=1), np.count_nonzero(~np.isnan(squares), axis=1)  # NaN come last
    rows = np.arange(len(squares))
    return np.asarray((ordered[rows, np.maximum(count - 1, 0) // 2] + ordered[rows, count // 2]) / (2 * 0.4549))


ROUNDING_LIMIT = 0.01
_ROUNDING_UNITS = 110 * float(np.finfo(np.float64).eps)
"""Rounding before magnification: 2 x 49 eps neglected by LAPACK's dbdsqr and 12 of products; 44 in 5500 models."""
_SMALLEST, _LARGEST = 1e-30, 1e30


@dataclass(frozen=True, eq=False)
class Prepared:
    left: Side
    right: Side
    centre: bool
    stated: tuple[int, int] | None = None
    noise: tuple[float, float] = (0.0, 0.0)
    light: tuple[float, float] = (1.0, 1.0)

    @property
    def least_lambda(self) -> float:
        """Lambda at which the stated noise of the factors alone outweighs the image.

        Errors of deviation s_L in Phi_L add noise of variance n s_L^2 x^2 sigma_R^2 to a datum of singular value
        sigma_R, for n scene pixels of mean square x^2 (times ``light``).
        """
        sides = zip((self.left, self.right), (self.right, self.left), self.noise, self.light, strict=True)
        both = (own.scene_size * light * float(noise * other.singular.max()) ** 2 for own, other, noise, light in sides)
        return max(both)

    @property
    def condition(self) -> float:
        return max(self.left.condition, self.right.condition)

    @property
    def rank(self) -> int:
        return self.left.rank * self.right.rank

    @property
    def lost(self) -> tuple[int, str]:
        sides = zip((self.left, self.right), self.stated or (), strict=False)
        told = [min(side.rank, side.pattern_count * rank) for side, rank in sides] or [self.rank]
        limit = "rounding" if math.prod(told) == self.rank else "the calibration's noise"
        return self.unknowns - math.prod(told), limit

    @property
    def spare(self) -> float:
        left, right = self.left, self.right
        numbers = left.sensor_size * left.pattern_count * right.sensor_size * right.pattern_count
        return (left.data_rows * right.data_rows - self.rank) / numbers

    @property
    def unknowns(self) -> int:
        return self.left.scene_size * self.right.scene_size

    @property
    def sigma(self) -> FloatArray:
        return np.outer(self.left.singular, self.right.singular)

    def gain(self, lam: float) -> FloatArray:
        """Return sigma / (sigma^2 + ``lam``) (r, r'), the image's coefficients by data; 0 where sigma is."""
        sigma = self.sigma
        return np.divide(sigma, np.square(sigma) + lam, out=np.zeros_like(sigma), where=sigma > 0)

    def as_solved(self, frame: FloatArray) -> FloatArray:
        return centre_frame(frame) if self.centre else frame

    def slabs(self, pattern: tuple[int, int]) -> tuple[Slab, Slab]:
        return self.left.slabs[pattern[0]], self.right.slabs[pattern[1]]

    def places(self, pattern: tuple[int, int]) -> Any:
        return np.ix_(self.left.columns(pattern[0]), self.right.columns(pattern[1]))

    def frame(self, weights: FloatArray, pattern: tuple[int, int]) -> FloatArray:
        left, right = self.slabs(pattern)
        return np.asarray(left.matrix @ weights[left.columns][:, right.columns] @ right.matrix.T)

    def weights(self, frame: FloatArray, pattern: tuple[int, int]) -> FloatArray:
        left, right = self.slabs(pattern)
        return np.asarray(left.matrix.T @ frame @ right.matrix)

    @property
    def extent(self) -> str:
        left, right = self.left, self.right
        return (
            f"Rank {self.rank} of {self.unknowns} (rows {left.rank} of {left.scene_size}, columns {right.rank} of "
            f"{right.scene_size}), condition {left.condition * right.condition:.1e} (rows {left.condition:.1e}, "
            f"columns {right.condition:.1e})"
        )

    def with_correlation(self) -> Prepared:
        """Return the model with correlated neighbours of the scene's pixels."""
        with single_threaded_blas():
            left = _correlate_side(self.left)
            return replace(self, left=left, right=left if self.right is self.left else _correlate_side(self.right))

    def accumulator(self, measurements: Iterable[tuple[FloatArray, int, int]] = ()) -> Accumulator:
        """Return the sum of ``measurements``, frames with the numbers of their patterns, to which more can be added."""
        sums = Accumulator(self)
        for measurement in measurements:
            sums.add(*measurement)
        return sums

    def problem(self, frames: Accumulator) -> DiagonalProblem:
        if frames.prepared.left is not self.left or frames.prepared.right is not self.right:
            raise MitsimError("frames were added to an accumulator of other factors; use this one's accumulator()")
        missing = frames.missing
        if missing:
            total = self.left.pattern_count * self.right.pattern_count
            raise MitsimError(f"{len(missing)} of {total} frames are missing, first {missing[0]}; add them all")
        sigma = self.sigma
        quarters = frames.quarters.copy()
        data_count = self.left.data_rows * self.right.data_rows
        halves = Halves(quarters, self.left, self.right)
        data = quarters.sum(axis=(0, 1))
        return DiagonalProblem(sigma, data, frames.energy, data_count, halves, least=self.least_lambda)

    def image(self, coefficients: npt.ArrayLike) -> FloatArray:
        return np.asarray(self.left.basis @ np.asarray(coefficients) @ self.right.basis.T)

    def coefficients(self, image: npt.ArrayLike) -> FloatArray:
        return np.asarray(self.left.basis.T @ np.asarray(image) @ self.right.basis)

    def solve(
        self,
        frames: Accumulator,
        lam: float | Literal["auto"] = "auto",
        explained: bool = True,
        lack: tuple[FloatArray, float] | None = None,
    ) -> Solution:
        """Return the Tikhonov solution of the added ``frames``.

        ``lam`` is >= 0 in the unit of (Phi_L Phi_R)^2, or "auto" (:func:`automatic_lambda`); 0 gives the
        pseudo-inverse, in which singular values below max(rows, columns) eps of the largest count as zero. ``lack`` is
        a known part of the frames beside the image, (r, r') in the diagonal basis and as energy beyond it, which
        "auto" treats as noise.
        """
        problem, flags = self.problem(frames), tuple[str, ...]()
        if isinstance(lam, str):
            if lam != "auto":
                raise MitsimError(f"lambda is {lam!r}; give a number of at least 0, or auto")
            known = replace(problem, struck=lack[0], energy=max(problem.energy - lack[1], 0.0)) if lack else problem
            lam = automatic_lambda(known, explained)
            flags = end_of_range(problem, lam)
        lam = check_lambda(lam)
        sigma = problem.sigma
        filtered, squares = np.zeros_like(sigma), np.square(sigma) + lam
        np.divide(sigma * problem.projected, squares, out=filtered, where=sigma > 0)
        outside = max(problem.energy - float(np.sum(np.square(problem.projected))), 0.0)
        residual = outside + problem.taken_energy(lam)
        measured = sigma[sigma > 0]
        magnified = float(float(measured.max()) * (measured / (np.square(measured) + lam)).max())
        rounding = _ROUNDING_UNITS * max(magnified, 1.0) * self.left.spread * self.right.spread
        share = float(np.sqrt(residual / problem.energy)) if problem.energy > 0 else 0.0
        status = replace(self._status(lam, rounding, problem.scale), flags=flags)
        return Solution(self.image(filtered), lam, share, status, rounding)

    def _status(self, lam: float, rounding: float, scale: float) -> Status:
        status, (lost, limit) = partial(Status, figures=f"{self.extent}, rounding below {rounding:.0e}."), self.lost
        for name, side in (("row", self.left), ("column", self.right)):
            if side.data_rows < side.scene_size:
                words = f"Under-determined: {side.data_rows} sensor {name}s in all for {side.scene_size} scene {name}s"
                remedy = "use more patterns, more sensor pixels or fewer scene pixels"
                return status(Verdict.UNDER_DETERMINED, words, remedy)
        if self.rank < self.unknowns and lam == 0:
            words = f"Rank deficient: {self.unknowns - self.rank} of {self.unknowns} directions are not measured"
            remedy = "use more patterns, or lambda above 0"
            return status(Verdict.RANK_DEFICIENT, f"{words} and left at zero by the pseudo-inverse", remedy)
        if rounding > ROUNDING_LIMIT:
            least = scale * (_ROUNDING_UNITS / ROUNDING_LIMIT / 2) ** 2
            words = f"Ill-conditioned: rounding may change more than {ROUNDING_LIMIT:.0%} of the image"
            return status(Verdict.ILL_CONDITIONED, words, f"raise lambda above {least:.1e}, or use more patterns")
        if lost:
            words = f"Partly measured: {lost} of {self.unknowns} directions are not measured above {limit}"
            remedy = "use more patterns" if limit == "rounding" else "calibrate with more frames, or use more patterns"
            return status(Verdict.PARTLY_MEASURED, f"{words} and follow from lambda alone", remedy)
        return status(Verdict.SOLVED, "Solved: every direction of the image is measured")


def prepare(
    left: npt.ArrayLike, right: npt.ArrayLike, P_L: npt.ArrayLike, P_R: npt.ArrayLike, centre: bool = False
) -> Prepared:
    """Factorise the model of a camera (Phi_L, Phi_R) and a pattern family (P_L (n, K), P_R (n', K')).

    ``centre`` removes row and column means, so that the constant term of a FlatCam mask (1 + m m^T)/2 vanishes if the
    mask covers all that the sensor sees; else the leak is (C Phi_1) X (C Phi_1)^T / 2, with Phi_1 the shadow of its
    outline. Raises MitsimError if shapes do not fit, values cannot be squared, or no light is seen.
    """
    factors = [_matrix("left factor", left), _matrix("right factor", right)]
    patterns = [_matrix("patterns P_L", P_L), _matrix("patterns P_R", P_R)]
    for name, factor, pattern in zip(("left", "right"), factors, patterns, strict=True):
        if factor.shape[1] != pattern.shape[0]:
            own = f"{name} factor of shape {factor.shape} has {factor.shape[1]} scene pixels"
            raise MitsimError(f"{own} but its patterns have {pattern.shape[0]}; both need the same number")
    same = np.array_equal(factors[0], factors[1]) and np.array_equal(patterns[0], patterns[1])
    if centre:
        centred = [centre_columns(factor) for factor in factors]
        # Exact zeros for a column of equal numbers.
        dust = [len(factor) * np.finfo(np.float64).eps * np.abs(factor).max(axis=0) for factor in factors]
        kept = (np.abs(own).max(axis=0) > least for own, least in zip(centred, dust, strict=True))
        factors = [np.where(own, factor, 0.0) for own, factor in zip(kept, centred, strict=True)]
    for name, factor, pattern in zip(("left", "right"), factors, patterns, strict=True):
        if not (factor.any() and pattern.any()):
            what = " once centred" if centre else ""
            raise MitsimError(f"{name} factor{what} or its patterns are all zero; there is nothing to solve for")
    # Products this small gain little from threads of BLAS, and lose a hundredfold when the cores are busy.
    with single_threaded_blas():
        left_side = factorise(factors[0], patterns[0], group_pixels(patterns[0]), centre)
        right_side = left_side if same else factorise(factors[1], patterns[1], group_pixels(patterns[1]), centre)
    for name, factorised in (("left", left_side), ("right", right_side)):
        if factorised.singular.max() < 1e-60:
            raise MitsimError(f"patterns light no scene pixel that the {name} factor sees; light those that it sees")
    return Prepared(left_side, right_side, centre)


def _matrix(name: str, array: npt.ArrayLike) -> FloatArray:
    values = np.asarray(array, dtype=np.float64)
    if values.ndim != 2 or values.size == 0:
        raise MitsimError(f"{name} have shape {values.shape}; give a 2-D array")
    if not np.isfinite(values).all():
        raise MitsimError(f"{name} hold {np.count_nonzero(~np.isfinite(values))} values that are not finite")
    largest = np.abs(values).max()
    if largest and not _SMALLEST <= largest <= _LARGEST:
        allowed = f"allowed are {_SMALLEST:g} to {_LARGEST:g}, choose another unit"
        raise MitsimError(f"{name} hold numbers up to {largest:.1e}; {allowed}")
    return values


# -------- Frames are added one at a time to W = sum_ij U_Li^T Y_ij U_Rj

_LARGEST_SUM = 1e100


class Accumulator:
    def __init__(self, prepared: Prepared) -> None:
        left, right = prepared.left, prepared.right
        self.prepared = prepared
        self.quarters = np.zeros((2, 2, len(left.singular), len(right.singular)))
        self.energy = 0.0
        self._seen = np.zeros((left.pattern_count, right.pattern_count), dtype=np.bool_)

    @property
    def sum(self) -> FloatArray:
        return np.asarray(self.quarters.sum(axis=(0, 1)))

    @property
    def missing(self) -> list[tuple[int, int]]:
        return [(int(i), int(j)) for i, j in np.argwhere(~self._seen)]

    def add(self, frame: npt.ArrayLike, row: int, column: int) -> FloatArray:
        """Add one ``frame`` (m, m'), and return its contribution (c, c') to W at its places.

        The frame of a signed pattern is the difference of its two shots. Raises MitsimError if the shape, a value or
        the index is not allowed, or a pattern is added twice.
        """
        (rows, columns), name, given = self._seen.shape, f"frame of pattern ({row}, {column})", np.asarray(frame)
        whole = all(isinstance(k, (int, np.integer)) and not isinstance(k, bool) for k in (row, column))
        if not (whole and 0 <= row < rows and 0 <= column < columns):
            raise MitsimError(f"pattern index is ({row}, {column}); allowed are 0 to {rows - 1} and 0 to {columns - 1}")
        if self._seen[row, column]:
            raise MitsimError(f"{name} was added before; average repeated captures first")
        expected = (self.prepared.left.sensor_size, self.prepared.right.sensor_size)
        if given.shape != expected or given.dtype.kind not in "buif":
            wrong = f"{name} is {given.dtype} of shape {given.shape}"
            raise MitsimError(f"{wrong}; the factors take real numbers of shape {expected}")
        values = self.prepared.as_solved(given.astype(np.float64, copy=False))
        flat = values.ravel()
        energy = float(np.dot(flat, flat))
        if not 1 / _LARGEST_SUM**2 <= energy <= _LARGEST_SUM**2 and (energy or values.any()):
            bad = int(np.count_nonzero(~np.isfinite(values)))
            if bad:
                raise MitsimError(f"{name} has {bad} values that are not finite; capture it again")
            allowed = f"allowed are 0 and {1 / _LARGEST_SUM:g} to {_LARGEST_SUM:g}, choose another unit"
            raise MitsimError(f"{name} has numbers up to {np.abs(values).max():.1e}; {allowed}")
        left, right = self.prepared.slabs((row, column))
        where = self.prepared.places((row, column))
        rows_of, columns_of = self.prepared.left.halves, self.prepared.right.halves

        def product(first: FloatArray, second: FloatArray, strips: Strips) -> FloatArray:
            total = np.zeros((first.shape[1], second.shape[1]))
            for strip in strips:
                total += first[strip].T @ second[strip]
            return total

        # The side with fewer columns is multiplied first.
        if left.matrix.shape[1] < right.matrix.shape[1]:
            seen = [product(left.matrix, values, strips) for strips in rows_of]
            found = np.array([[product(part.T, right.matrix, strips) for strips in columns_of] for part in seen])
        else:
            seen = [product(values.T, right.matrix, strips) for strips in columns_of]
            found = np.array([[product(left.matrix, part, strips) for part in seen] for strips in rows_of])
        self.quarters[(slice(None), slice(None), *where)] += found
        self.energy += energy
        self._seen[row, column] = True
        return np.asarray(found.sum(axis=(0, 1)))


def centre_columns(matrix: FloatArray) -> FloatArray:
    return np.asarray(matrix - matrix.mean(axis=0, keepdims=True))


def centre_frame(frame: FloatArray) -> FloatArray:
    return centre_columns(frame - frame.mean(axis=1, keepdims=True))
