"""Sensor frames of a separable lensless camera under separable patterns in; the scene's image out.

Solves min_X sum_ij ||Y_ij - Phi_L (P_ij o X) Phi_R^T||^2 + lambda ||X||^2 (arXiv 2111.12862, eq. 6) with the
factors prepared once and the frames added one by one:

>>> prepared = prepare(left, right, P_L, P_R)
>>> frames = prepared.accumulator()
>>> frames.add(Y, i, j)                           # for each pattern P_L[:, i] P_R[:, j]^T
>>> solution = prepared.solve(frames, "auto")

With B_L = U_L S_L V_L^T (see :mod:`mitsim.reconstruct.factorisation`) and W = sum_ij U_Li^T Y_ij U_Rj the
solution is X = V_L [(s_L s_R^T o W) / (s_L^2 s_R^2^T + lambda)] V_R^T. Its rounding error is about eps /
sqrt(lambda_rel), with lambda_rel = lambda / (max s_L^2 max s_R^2); with the paper's Q = sum (Phi_L^T Y
Phi_R) o P in place of W it is eps / lambda_rel (docs/decisions/0001-projected-accumulation.md).
``method="gram"`` keeps that form for comparison.

Every solution says how much rounding may have moved it: 110 units of eps, nearly all of them LAPACK's way
of ending the SVD of a side, magnified by sigma_max max_ij sigma_ij / (sigma_ij^2 + lambda) <= 1 / (2
sqrt(lambda_rel)); for ``gram``, whose data carry sigma_max^2 eps, by sigma_max^2 / min_ij (sigma_ij^2 +
lambda). That is relative to the image, for frames that the model explains; what it does not explain is
magnified as noise, and by more.

*Neighbours alike.* Tikhonov's lambda ||X||^2 says that every pixel is near black and knows nothing of the next one.
Where the frames are noisy lambda then darkens the image, its large even parts too. Pictures are not so: with the
covariance rho^|p - p'| along rows and along columns (a separable first-order Markov field; Jain, Fundamentals of
Digital Image Processing, 1989, chapter 2) an even part of many pixels has many times the variance of a single pixel,
and is kept.

With C = F F^T on each side the image is X = F_L Z F_R^T, Z independent numbers, so that the penalty lambda ||Z||^2 is
Tikhonov's of the model B F in the place of B = U S V^T. From the SVD S V^T F = U' S' V'^T follow U U', S', and the
columns F V' that make an image of coefficients: all that was a closed form stays one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas
from mitsim.reconstruct.factorisation import (
    Method,
    Side,
    Slab,
    StripHalves,
    Strips,
    Structure,
    check_choices,
    factorise,
    group_pixels,
)
from mitsim.reconstruct.regularisation import DiagonalProblem, Halves, automatic_lambda, end_of_range
from mitsim.reconstruct.solution import Solution, Status, Verdict

ROUNDING_LIMIT = 0.01
"""Rounding above this part of the image flags a solution: two digits are the least that anyone can see or use."""
_ROUNDING_UNITS = 110 * float(np.finfo(np.float64).eps)
"""Rounding of a number before it is magnified. LAPACK's dbdsqr, in which gesdd and gesvd both end, takes for zero what
is below u^(-1/8) u = 49 eps of its neighbour (u = eps / 2), in each of two sides; a dozen are left to reductions and
products. Close singular values come near it: 44 units were seen in 5500 models, a third of those of nearly equal values
above ten (tests/hard/test_solver_digits.py holds some). A QR iteration without that shortcut is not in LAPACK."""
_SMALLEST, _LARGEST = 1e-30, 1e30
"""Largest number of a factor or pattern: sigma^2, a product of eight of them, then stays far from 1e-308 and 1e308."""
_UNSEEN = 1e-60
"""Singular values below it are zero: the square of ``_SMALLEST``, a factor that small times a pattern that small."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """Factorised model, ready for any number of scenes; applying it changes nothing in it.

    Attributes
    ----------
    stated
        directions of either factor that the calibration states to be above its noise; None: not stated.
    noise
        standard deviation of each number of the left and of the right factor, as the calibration states it.
    light
        mean over scene pixels of the sum of squared patterns, of either side.
    """

    left: Side
    right: Side
    method: Method
    centre: bool
    stated: tuple[int, int] | None = None
    noise: tuple[float, float] = (0.0, 0.0)
    light: tuple[float, float] = (1.0, 1.0)

    @property
    def least_lambda(self) -> float:
        """Lambda at which the stated noise of the factors alone outweighs the image.

        Independent errors of deviation s_L in Phi_L put noise of the variance n s_L^2 x^2 sigma_R^2 into a datum whose
        column has the singular value sigma_R, for n scene pixels of mean square x^2 (times ``light``). Its ratio to x^2
        is the weight that the datum deserves; the largest of all columns, and of all rows, is taken.
        """
        sides = zip((self.left, self.right), (self.right, self.left), self.noise, self.light, strict=True)
        return max(
            own.scene_size * light * float(noise * other.singular.max()) ** 2 for own, other, noise, light in sides
        )

    @property
    def condition(self) -> float:
        """The larger cond(A) of the two sides; inf when rank deficient."""
        return max(self.left.condition, self.right.condition)

    @property
    def condition_whole(self) -> float:
        """cond(A) of the whole model, the product of its sides'; inf when rank deficient."""
        return self.left.condition * self.right.condition

    @property
    def rank(self) -> int:
        """Numerical rank of the whole model."""
        return self.left.rank * self.right.rank

    @property
    def lost(self) -> tuple[int, str]:
        """Directions of the image that are not measured, and above what: a factor of a stated rank tells at most that
        many under each pattern."""
        sides = zip((self.left, self.right), self.stated or (), strict=False)
        told = [min(side.rank, side.pattern_count * rank) for side, rank in sides] or [self.rank]
        limit = "rounding" if math.prod(told) == self.rank else "the calibration's noise"
        return self.unknowns - math.prod(told), limit

    @property
    def spare(self) -> float:
        """Part of the energy of white noise in all frames that neither centring nor an image takes up."""
        left, right = self.left, self.right
        numbers = left.sensor_size * left.pattern_count * right.sensor_size * right.pattern_count
        return (left.data_rows * right.data_rows - self.rank) / numbers

    @property
    def unknowns(self) -> int:
        """Number of scene pixels."""
        return self.left.scene_size * self.right.scene_size

    @property
    def sigma(self) -> FloatArray:
        """(r, r') singular values of the whole model, exact zeros beyond its rank."""
        return np.outer(self.left.singular, self.right.singular)

    def as_solved(self, frame: FloatArray) -> FloatArray:
        """A ``frame`` (m, m') as the solver takes it: centred where the model is."""
        return centre_frame(frame) if self.centre else frame

    def slabs(self, pattern: tuple[int, int]) -> tuple[Slab, Slab]:
        """What the row and the column of a ``pattern`` contribute."""
        return self.left.slabs[pattern[0]], self.right.slabs[pattern[1]]

    def places(self, pattern: tuple[int, int]) -> Any:
        """Where the coefficients of a ``pattern`` are in W."""
        return np.ix_(self.left.columns(pattern[0]), self.right.columns(pattern[1]))

    def frame(self, weights: FloatArray, pattern: tuple[int, int]) -> FloatArray:
        """(m, m') frame of a ``pattern``, as the ``weights`` W tell it."""
        left, right = self.slabs(pattern)
        return np.asarray(left.matrix @ weights[left.columns][:, right.columns] @ right.matrix.T)

    def weights(self, frame: FloatArray, pattern: tuple[int, int]) -> FloatArray:
        """What a ``frame`` (m, m') of a ``pattern``, as the solver takes it, adds to W at its :meth:`places`."""
        left, right = self.slabs(pattern)
        return np.asarray(left.matrix.T @ frame @ right.matrix)

    @property
    def extent(self) -> str:
        """Rank and condition of the whole model and of its two sides, as every status ends with them."""
        left, right = self.left, self.right
        return (
            f"Rank {self.rank} of {self.unknowns} (rows {left.rank} of {left.scene_size}, columns {right.rank} of "
            f"{right.scene_size}), condition {self.condition_whole:.1e} (rows {left.condition:.1e}, columns "
            f"{right.condition:.1e})"
        )

    def with_correlation(self) -> Prepared:
        """The same model for images whose neighbouring pixels are alike; frames go to its own accumulator. MitsimError
        for the Gram method."""
        with single_threaded_blas():
            left = correlate_side(self.left)
            return replace(self, left=left, right=left if self.right is self.left else correlate_side(self.right))

    def accumulator(self) -> Accumulator:
        """An empty sum to add frames to."""
        return Accumulator(self)

    def problem(self, frames: Accumulator) -> DiagonalProblem:
        """Data of all ``frames`` and singular values in the basis where the problem is diagonal.

        MitsimError when frames are missing: the closed form holds for all patterns or none.
        """
        if frames.prepared.left is not self.left or frames.prepared.right is not self.right:
            raise MitsimError("frames were added to an accumulator of other factors; use this one's accumulator()")
        missing = frames.missing
        if missing:
            total = self.left.pattern_count * self.right.pattern_count
            raise MitsimError(f"{len(missing)} of {total} frames are missing, first {missing[0]}; add them all")
        sigma = self.sigma
        quarters = frames.quarters
        if self.method == "gram":
            rotated = self.left.basis.T @ quarters @ self.right.basis
            quarters = np.divide(rotated, sigma, out=np.zeros_like(quarters), where=sigma > 0)
        data_count = self.left.data_rows * self.right.data_rows
        halves = Halves(quarters, self.left, self.right)
        data = quarters.sum(axis=(0, 1))
        return DiagonalProblem(sigma, data, frames.energy, data_count, halves, least=self.least_lambda)

    def image(self, coefficients: npt.ArrayLike) -> FloatArray:
        """Scene image (n, n') of ``coefficients`` (r, r') in the diagonal basis: V_L coefficients V_R^T."""
        return np.asarray(self.left.basis @ np.asarray(coefficients) @ self.right.basis.T)

    def coefficients(self, image: npt.ArrayLike) -> FloatArray:
        """Adjoint of :meth:`image`: coefficients (r, r') V_L^T ``image`` V_R of an image (n, n')."""
        return np.asarray(self.left.basis.T @ np.asarray(image) @ self.right.basis)

    def solve(
        self,
        frames: Accumulator,
        lam: float | Literal["auto"] = "auto",
        explained: bool = True,
        lack: tuple[FloatArray, float] | None = None,
    ) -> Solution:
        """Tikhonov solution of the added ``frames``.

        Parameters
        ----------
        frames
            all of them.
        lam
            lambda >= 0 in the unit of (Phi_L Phi_R)^2; 0 gives the pseudo-inverse, in which singular values below
            max(rows, columns) eps of the largest of their side count as zero; ``"auto"`` chooses it by
            :func:`mitsim.reconstruct.regularisation.automatic_lambda`.
        explained
            False where factors are known not to explain what the camera sees, which ``auto`` then heeds.
        lack
            what the frames are known to have beside the image, (r, r') in the diagonal basis and as energy beyond it,
            which ``auto`` takes for noise.

        Raises
        ------
        MitsimError
            for missing frames or another lambda.
        """
        problem, flags = self.problem(frames), tuple[str, ...]()
        if isinstance(lam, str):
            if lam != "auto":
                raise MitsimError(f"lambda is {lam!r}; give a number of at least 0, or auto")
            known = replace(problem, struck=lack[0], energy=max(problem.energy - lack[1], 0.0)) if lack else problem
            lam = automatic_lambda(known, explained)
            flags = end_of_range(problem, lam)
        lam = float(lam)
        if not (np.isfinite(lam) and lam >= 0):
            raise MitsimError(f"lambda is {lam}; give a finite number of at least 0, or auto")
        sigma = problem.sigma
        filtered = np.divide(
            sigma * problem.projected, np.square(sigma) + lam, out=np.zeros_like(sigma), where=sigma > 0
        )
        residual = problem.residual_energy(lam)
        rounding = self._rounding(problem, lam)
        return Solution(
            image=self.image(filtered),
            lam=lam,
            residual=float(np.sqrt(residual / problem.energy)) if problem.energy > 0 else 0.0,
            status=replace(self._status(lam, rounding, problem.scale), flags=flags),
            rounding=rounding,
        )

    def _rounding(self, problem: DiagonalProblem, lam: float) -> float:
        """Bound on ||error|| / ||image|| by rounding; the module's text says where it comes from."""
        sigma = problem.sigma[problem.sigma > 0]
        power = np.square(sigma) + lam
        top = float(sigma.max())
        magnified = top * (sigma / power).max() if self.method == "svd" else top**2 / power.min()
        return _ROUNDING_UNITS * max(float(magnified), 1.0) * self.left.spread * self.right.spread

    def _status(self, lam: float, rounding: float, scale: float) -> Status:
        """Whether the image is complete, and what to do where it is not."""
        figures = f"{self.extent}, rounding below {rounding:.0e}."
        lost, limit = self.lost
        for name, side in (("row", self.left), ("column", self.right)):
            if side.data_rows < side.scene_size:
                return Status(
                    Verdict.UNDER_DETERMINED,
                    f"Under-determined: {side.data_rows} sensor {name}s in all for {side.scene_size} scene {name}s",
                    "use more patterns, more sensor pixels or fewer scene pixels",
                    figures,
                )
        if self.rank < self.unknowns and lam == 0:
            return Status(
                Verdict.RANK_DEFICIENT,
                f"Rank deficient: {self.unknowns - self.rank} of {self.unknowns} directions are not measured and left "
                "at zero by the pseudo-inverse",
                "use more patterns, or lambda above 0",
                figures,
            )
        if rounding > ROUNDING_LIMIT:
            least = _ROUNDING_UNITS / ROUNDING_LIMIT
            least = scale * (least if self.method == "gram" else (least / 2) ** 2)
            return Status(
                Verdict.ILL_CONDITIONED,
                f"Ill-conditioned: rounding may change more than {ROUNDING_LIMIT:.0%} of the image",
                f"raise lambda above {least:.1e}, or use more patterns",
                figures,
            )
        if lost:
            return Status(
                Verdict.PARTLY_MEASURED,
                f"Solved, but {lost} of {self.unknowns} directions are not measured above {limit} and follow from "
                "lambda alone",
                "use more patterns" if limit == "rounding" else "calibrate with more frames, or use more patterns",
                figures,
            )
        return Status(Verdict.SOLVED, "Solved: every direction of the image is measured", "", figures)


def prepare(
    left: npt.ArrayLike,
    right: npt.ArrayLike,
    P_L: npt.ArrayLike,
    P_R: npt.ArrayLike,
    method: Method = "svd",
    structure: Structure = "auto",
    centre: bool = False,
) -> Prepared:
    """Factorise the model of a camera and a pattern family.

    Parameters
    ----------
    left, right
        Phi_L (m, n) and Phi_R (m', n'): scene rows to sensor rows, scene columns to sensor columns.
    P_L, P_R
        (n, K) and (n', K') pattern columns; pattern (i, j) is P_L[:, i] P_R[:, j]^T.
    method
        ``svd``: factorise the stacked matrix. ``gram``: the paper's Gram matrices, for comparison.
    structure
        ``block`` and ``auto`` factorise each group of scene pixels that shares no pattern energy with the
        others alone; ``full`` takes one group.
    centre
        True takes row and column means out of factors and of each added frame: the constant term of a
        FlatCam mask (1 + m m^T)/2 vanishes as long as the mask covers all that the sensor sees. Where it
        does not, the leak is (C Phi_1) X (C Phi_1)^T / 2, with Phi_1 the shadow of the mask's outline.

    Raises
    ------
    MitsimError
        for shapes that do not fit, values that are not finite, too large or too small to be squared, patterns
        that light nothing that the factor sees, unknown choices.
    """
    check_choices(method, structure)
    factors = [_matrix("left factor", left), _matrix("right factor", right)]
    patterns = [_matrix("patterns P_L", P_L), _matrix("patterns P_R", P_R)]
    for name, factor, pattern in zip(("left", "right"), factors, patterns, strict=True):
        if factor.shape[1] != pattern.shape[0]:
            raise MitsimError(
                f"{name} factor of shape {factor.shape} has {factor.shape[1]} scene pixels "
                f"but its patterns have {pattern.shape[0]}; both need the same number"
            )
    same = np.array_equal(factors[0], factors[1]) and np.array_equal(patterns[0], patterns[1])
    if centre:
        factors = [_centre_factor(factor) for factor in factors]
    for name, factor, pattern in zip(("left", "right"), factors, patterns, strict=True):
        if not (factor.any() and pattern.any()):
            what = " once centred" if centre else ""
            raise MitsimError(f"{name} factor{what} or its patterns are all zero; there is nothing to solve for")
    groups = [group_pixels(own, structure) for own in patterns]

    def side(index: int) -> Side:
        return factorise(factors[index], patterns[index], groups[index], method, structure, centre)

    # Products this small gain little from threads of BLAS, and lose a hundredfold when the cores are busy.
    with single_threaded_blas():
        first = side(0)
        sides = first, first if same else side(1)
    for name, factorised in zip(("left", "right"), sides, strict=True):
        if factorised.singular.max() < _UNSEEN:
            raise MitsimError(f"patterns light no scene pixel that the {name} factor sees; light those that it sees")
    return Prepared(*sides, method, centre)


def _centre_factor(factor: FloatArray) -> FloatArray:
    """The factor without the means of its columns; a column of equal numbers leaves exact zeros, not rounding."""
    centre_frame = centre_columns(factor)
    dust = len(factor) * np.finfo(np.float64).eps * np.abs(factor).max(axis=0)
    return np.where(np.abs(centre_frame).max(axis=0) > dust, centre_frame, 0.0)


def _matrix(name: str, array: npt.ArrayLike) -> FloatArray:
    values = np.asarray(array, dtype=np.float64)
    if values.ndim != 2 or values.size == 0:
        raise MitsimError(f"{name} have shape {values.shape}; give a 2-D array")
    if not np.isfinite(values).all():
        raise MitsimError(f"{name} hold {np.count_nonzero(~np.isfinite(values))} values that are not finite")
    largest = np.abs(values).max()
    if largest and not _SMALLEST <= largest <= _LARGEST:
        raise MitsimError(
            f"{name} hold numbers up to {largest:.1e}; allowed are {_SMALLEST:g} to {_LARGEST:g}, choose another unit"
        )
    return values


# -------- Frames are added one at a time to W = sum_ij U_Li^T Y_ij U_Rj

_LARGEST_SUM = 1e100
"""Largest norm of a frame, and one over the smallest: its square, the energy, is then told from 0 and infinity."""


class Accumulator:
    """Sum over frames of what the solver needs: W by quarters of the sensor, the frames' energy, and which frames came.

    Made by :meth:`Prepared.accumulator`; belongs to the factors of the ``prepared`` model that made it.
    """

    def __init__(self, prepared: Prepared) -> None:
        left, right = prepared.left, prepared.right
        self.prepared = prepared
        self._quarters = np.zeros((2, 2, left.accumulated_size, right.accumulated_size))
        self._energy = 0.0
        self._seen = np.zeros((left.pattern_count, right.pattern_count), dtype=np.bool_)

    @classmethod
    def of_sums(cls, prepared: Prepared, quarters: FloatArray, energy: float) -> Accumulator:
        """That of all frames, whose sums were kept.

        Parameters
        ----------
        prepared
            the model that they were added up for, bit for bit: its singular vectors have signs of their own.
        quarters, energy
            as the accumulator of the frames had them.
        """
        found = cls(prepared)
        found._quarters += quarters
        found._energy = energy
        found._seen[:] = True
        return found

    @property
    def sum(self) -> FloatArray:
        """W (r_left, r_right), or for the Gram method the paper's Q (n, n); a copy."""
        return np.asarray(self._quarters.sum(axis=(0, 1)))

    @property
    def quarters(self) -> FloatArray:
        """(2, 2, r_left, r_right) parts of :attr:`sum` by half of the sensor's rows and of its columns; a copy."""
        return self._quarters.copy()

    @property
    def energy(self) -> float:
        """Sum of the squares of all added frames, after centring when that was asked for."""
        return self._energy

    @property
    def missing(self) -> list[tuple[int, int]]:
        """Pattern indices (i, j) whose frame has not been added."""
        return [(int(i), int(j)) for i, j in np.argwhere(~self._seen)]

    def add(self, frame: npt.ArrayLike, row: int, column: int) -> FloatArray:
        """Add one frame, and return what it adds to W at its places (c, c'); sums are float64.

        Parameters
        ----------
        frame
            (m, m') of any real dtype; for a signed pattern the difference of its two shots.
        row, column
            of its pattern P_L[:, row] P_R[:, column]^T.

        Raises
        ------
        MitsimError
            for another shape, a value that is not finite, numbers whose squares leave double precision, a pattern
            index out of range, or a pattern added twice (average repeated shots first).
        """
        self._check_index(row, column)
        values = self.prepared.as_solved(self._check_frame(frame, row, column))
        flat = values.ravel()
        energy = float(np.dot(flat, flat))
        if not 1 / _LARGEST_SUM**2 <= energy <= _LARGEST_SUM**2 and (energy or values.any()):
            raise MitsimError(_out_of_range(f"frame of pattern ({row}, {column})", values))
        left, right = self.prepared.slabs((row, column))
        where = self.prepared.places((row, column))
        halves = self.prepared.left.halves, self.prepared.right.halves
        found = _project(values, left.matrix, right.matrix, halves)
        self._quarters[(slice(None), slice(None), *where)] += found
        self._energy += energy
        self._seen[row, column] = True
        return np.asarray(found.sum(axis=(0, 1)))

    def _check_index(self, row: int, column: int) -> None:
        rows, columns = self._seen.shape
        whole = all(isinstance(k, (int, np.integer)) and not isinstance(k, bool) for k in (row, column))
        if not (whole and 0 <= row < rows and 0 <= column < columns):
            raise MitsimError(f"pattern index is ({row}, {column}); allowed are 0 to {rows - 1} and 0 to {columns - 1}")
        if self._seen[row, column]:
            raise MitsimError(f"frame of pattern ({row}, {column}) was added before; average repeated captures first")

    def _check_frame(self, frame: npt.ArrayLike, row: int, column: int) -> FloatArray:
        values = np.asarray(frame)
        expected = (self.prepared.left.sensor_size, self.prepared.right.sensor_size)
        if values.shape != expected or values.dtype.kind not in "buif":
            raise MitsimError(
                f"frame of pattern ({row}, {column}) is {values.dtype} of shape {values.shape}; "
                f"the factors take real numbers of shape {expected}"
            )
        return values.astype(np.float64, copy=False)


def project_frames(left: Side, right: Side, frames: FloatArray) -> FloatArray:
    """:attr:`Accumulator.sum` of all frames at once, without the halves, the energy and the checks: half the time.

    Parameters
    ----------
    left, right
        the factorised model.
    frames
        (K, m, K', m'), of pattern (i, j) ``frames[i, :, j]``, centred where the model is.
    """
    total = np.zeros((left.accumulated_size, right.accumulated_size))
    for slab, own in zip(left.slabs, frames, strict=True):
        seen = (slab.matrix.T @ own.reshape(len(own), -1)).reshape(-1, *own.shape[1:])
        rows = np.arange(len(total))[slab.columns]
        for j, other in enumerate(right.slabs):
            total[rows[:, None], np.arange(total.shape[1])[other.columns]] += seen[:, j] @ other.matrix
    return total


def centre_columns(matrix: FloatArray) -> FloatArray:
    """C ``matrix``: the mean of each column taken out."""
    return np.asarray(matrix - matrix.mean(axis=0, keepdims=True))


def centre_frame(frame: FloatArray) -> FloatArray:
    """C Y C of a ``frame`` Y, C = I - 1 1^T / m: row and column means out, as FlatCam's constant term demands."""
    return centre_columns(frame - frame.mean(axis=1, keepdims=True))


def _out_of_range(name: str, values: FloatArray) -> str:
    """Why a frame whose energy is not a usable number is refused."""
    bad = int(np.count_nonzero(~np.isfinite(values)))
    if bad:
        return f"{name} has {bad} values that are not finite; capture it again"
    return (
        f"{name} has numbers up to {np.abs(values).max():.1e}; "
        f"allowed are 0 and {1 / _LARGEST_SUM:g} to {_LARGEST_SUM:g}, choose another unit"
    )


def _project(
    frame: FloatArray, left: FloatArray, right: FloatArray, halves: tuple[StripHalves, StripHalves]
) -> FloatArray:
    """(2, 2, c, c') left^T frame right by ``halves`` of the rows and of the columns, the thinner factor first: the
    frame is then read with the least arithmetic, and never copied."""
    rows, columns = halves
    if left.shape[1] < right.shape[1]:
        seen = [_product(left, frame, strips) for strips in rows]
        return np.array([[_product(part.T, right, strips) for strips in columns] for part in seen])
    seen = [_product(frame.T, right, strips) for strips in columns]
    return np.array([[_product(left, part, strips) for part in seen] for strips in rows])


def _product(first: FloatArray, second: FloatArray, strips: Strips) -> FloatArray:
    """first^T second over the rows in ``strips``."""
    total = np.zeros((first.shape[1], second.shape[1]))
    for strip in strips:
        total += first[strip].T @ second[strip]
    return total


# -------- One side of a factorised model in, whose scene pixels are taken for independent

NEIGHBOURS = 0.9
"""rho, correlation of neighbouring pixels: chosen on scenes/colour_checker under 49 dots and 64 Hadamard patterns, in
the dark and in two daylights, where 0.8 to 0.98 are within 0.7 dB of each other (docs/decisions/0005-neighbours.md)."""


def covariance_root(size: int) -> FloatArray:
    """F (n, n), n = ``size``, lower triangular, with F F^T the covariance rho^|p - p'| of a row of pixels."""
    place = np.arange(size)
    return np.asarray(np.linalg.cholesky(NEIGHBOURS ** np.abs(place[:, None] - place)))


def correlate_side(side: Side) -> Side:
    """A ``side`` whose scene pixels are correlated with their neighbours. MitsimError for one of Gram matrices."""
    if not side.projected:
        raise MitsimError("method gram: has no image of correlated pixels; prepare by svd")
    root = covariance_root(side.scene_size)
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
