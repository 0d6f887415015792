"""The exact image of the solver's problem, and error and seconds of every form of the solver against it.

At the paper's geometry (49 dots, 49 frames of 512 x 512, an image of 128 x 128) the noise-free frames of a random image
are solved in these precisions:

``float64``; ``float32 frames``, stored in single precision and summed in double; ``float32 products``, where frames and
slabs are multiplied in single precision as well (computed here, because the solver does not offer it).

Seconds count what one reconstruction takes: prepare, add all frames, solve; best of REPEATS, BLAS kept to one thread.

The judge. For frames of the model without rounding, Y_ij = Phi (P_ij o X0) Phi^T, the Tikhonov image satisfies
A E A + lambda E = lambda X0 with E = X0 - X, block by block, A = Phi_r^T Phi_r. E is refined from zero: residuals in
exact integer arithmetic, corrections in double precision. Nothing of :mod:`mitsim.reconstruct` is in it. Its own error
is the size of its last correction. Errors include the rounding of the frames, which are computed in double precision.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import product
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.job import Progress
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import stream
from mitsim.devices.camera import CameraGeometry, centred_edges
from mitsim.metrics import relative_error
from mitsim.reconstruct.solver import Prepared, prepare
from tests.shadow_factor import scene_factor

Precision = Literal["float64", "float32 frames", "float32 products"]
Timed = list[tuple[float, FloatArray]]
"""Seconds and image, for every lambda."""
PRECISIONS: tuple[Precision, ...] = ("float64", "float32 frames", "float32 products")
LAMBDAS = (1e-4, 1e-8, 1e-12)
"""From what noise calls for to where double precision ends."""
REPEATS = 3
"""The best of three is what an idle machine takes."""
_SCENE_PIXELS, _DOTS, _SCENE_WIDTH = 128, 7, 120.0
"""The paper's: pixels a side, 49 dots, and the scene's side [mm]."""
_DIGITS = 1e-18
"""A hundredth of the rounding of double precision: the exact image is then right to the last bit."""
_FRACTION_BITS = 160
"""Of numbers in the judge: 48 digits, far below what is asked of them."""
_DIVERGED = 10.0
"""A correction larger than the image times this grows on."""
_MOST_STEPS = 20
"""Each correction gains the digits that the conditioning leaves of 16; one digit each is enough."""


@dataclass(frozen=True)
class SolverRow:
    """One form of the solution at one lambda.

    ``lambda_rel`` is lambda over the largest squared singular value; ``seconds`` wall time of one reconstruction,
    the least of its ``repeats``, the longest of which took ``most_s``; ``error`` relative, against the exact image;
    ``judge_error`` what that image is uncertain by, relative.
    """

    precision: str
    lambda_rel: float
    seconds: float
    error: float
    judge_error: float
    seed: int
    most_s: float = 0.0
    repeats: int = 1


@dataclass(frozen=True, eq=False)
class Problem:
    """Noise-free measurement of one image (n, n): ``factor`` Phi (m, n) of both sides, ``k`` x ``k`` shifting dots.

    ``frames`` are (k * k, m, m), pattern (i, j) at i k + j.
    """

    factor: FloatArray
    k: int
    image: FloatArray
    frames: FloatArray

    @property
    def patterns(self) -> FloatArray:
        """(n, k) pattern columns of both sides."""
        return dots(len(self.image), self.k)

    @cached_property
    def largest_power(self) -> float:
        """Largest squared singular value of the whole model, what lambda_rel is relative to; both sides are equal."""
        return max(float(np.linalg.norm(self.factor[:, i :: self.k], 2)) for i in range(self.k)) ** 4


def dots(n: int, k: int) -> FloatArray:
    """(n, k) shifting dots: column i lights every ``k``-th of ``n`` pixels from i on."""
    return np.asarray(np.arange(n)[:, None] % k == np.arange(k), dtype=np.float64)


def paper_factor() -> FloatArray:
    """Phi (512, 128) of the paper's camera and scene: both sides of its idealised model."""
    camera = CameraGeometry()
    scene = centred_edges(_SCENE_PIXELS, _SCENE_WIDTH / _SCENE_PIXELS)
    mask = camera.build_mask()
    return scene_factor(
        mask.terms[0][1], mask.feature_mm, camera.pixel_edges, scene, camera.mask_distance, camera.scene_distance
    )


def make_problem(factor: FloatArray, k: int, seed: int) -> Problem:
    """A random image in 0..1 and its frames.

    Parameters
    ----------
    factor, k, seed
        Phi (m, n) of both sides, dots a side, and the image's.
    """
    image = stream(seed, "solver cost").random((factor.shape[1],) * 2)
    sides = [factor[:, i::k] for i in range(k)]
    frames = [sides[i] @ image[i::k, j::k] @ sides[j].T for i, j in product(range(k), repeat=2)]
    return Problem(factor, k, image, np.stack(frames))


def time_solver(
    seed: int, progress: Progress, problem: Problem | None = None, repeats: int = REPEATS
) -> tuple[SolverRow, ...]:
    """Error and seconds of every form at every lambda of LAMBDAS.

    MitsimError for a model too ill-conditioned for the judge to reach its own precision.

    Parameters
    ----------
    seed, progress
        of the image, and who is told how far the work is.
    problem, repeats
        None: the paper's geometry; rounds, of which the fastest counts.
    """
    with single_threaded_blas():
        problem = problem or make_problem(paper_factor(), _DOTS, seed)
        judge, answers = Judge(problem), []
        for index, relative in enumerate(LAMBDAS):
            answers.append(judge.image(relative * problem.largest_power))
            progress("solver", 0.4 * (index + 1) / len(LAMBDAS))
        measured: dict[Precision, list[Timed]] = {form: [] for form in PRECISIONS}
        forms = list(measured)
        # Round by round rather than form by form, so that a busy moment does not fall on one form alone.
        for index, (_, form) in enumerate(product(range(repeats), forms)):
            measured[form].append(_reconstruct(problem, form))
            progress("solver", 0.4 + 0.6 * (index + 1) / (repeats * len(forms)))
    return tuple(
        SolverRow(
            precision=precision,
            lambda_rel=relative,
            seconds=min(timed[index][0] for timed in rounds),
            error=relative_error(rounds[-1][index][1], answers[index][0]),
            judge_error=answers[index][1],
            seed=seed,
            most_s=max(timed[index][0] for timed in rounds),
            repeats=repeats,
        )
        for precision, rounds in measured.items()
        for index, relative in enumerate(LAMBDAS)
    )


def _reconstruct(problem: Problem, precision: Precision) -> Timed:
    """Lambdas share the factorisation and the sums, and each is charged with both."""
    frames = problem.frames if precision == "float64" else problem.frames.astype(np.float32)
    patterns, add = problem.patterns, _add_single if precision == "float32 products" else _add
    started = time.perf_counter()
    prepared = prepare(problem.factor, problem.factor, patterns, patterns)
    solve = add(prepared, frames, problem.k)
    shared = time.perf_counter() - started
    timed = []
    for relative in LAMBDAS:
        started = time.perf_counter()
        image = solve(relative * problem.largest_power)
        timed.append((shared + time.perf_counter() - started, image))
    return timed


def _add(prepared: Prepared, frames: npt.NDArray[Any], k: int) -> Callable[[float], FloatArray]:
    """The solver as it is: frames added, then lambda to image."""
    sums = prepared.accumulator()
    for index, frame in enumerate(frames):
        sums.add(frame, *divmod(index, k))
    return lambda lam: prepared.solve(sums, lam).image


def _add_single(prepared: Prepared, frames: npt.NDArray[Any], k: int) -> Callable[[float], FloatArray]:
    """The same with slabs and products in single precision; sums and what follows in double."""
    slabs = [(slab.columns, slab.matrix.astype(np.float32)) for slab in prepared.left.slabs]
    total = np.zeros((len(prepared.left.singular),) * 2)
    for index, frame in enumerate(frames):
        (rows, left), (columns, right) = (slabs[i] for i in divmod(index, k))
        where: Any = (rows, columns)
        if isinstance(rows, np.ndarray) and isinstance(columns, np.ndarray):
            where = np.ix_(rows, columns)
        total[where] += left.T @ (frame @ right)
    sigma = np.outer(prepared.left.singular, prepared.right.singular)
    return lambda lam: prepared.image(np.where(sigma > 0, sigma * total / (np.square(sigma) + lam), 0.0))


class Judge:
    """The Tikhonov image of the exact frames of a ``problem``, refined with residuals in exact integer arithmetic."""

    def __init__(self, problem: Problem) -> None:
        self._image, self._k = problem.image, problem.k
        # A double is a whole number times a power of two: in units of the smallest such power, Phi is whole.
        self._bits = 53 - int(np.frexp(problem.factor[problem.factor != 0])[1].min())
        whole = _whole(problem.factor, self._bits)
        blocks = [whole[:, i :: self._k] for i in range(self._k)]
        self._gram = [block.T @ block for block in blocks]  # units of 2^(-2 bits)
        self._eigen = [np.linalg.eigh(_double(gram, 2 * self._bits)) for gram in self._gram]

    def image(self, lam: float) -> tuple[FloatArray, float]:
        """X (n, n) for a lambda ``lam`` > 0, rounded to double precision, and its relative error (that of X before
        rounding). MitsimError when double precision cannot correct it."""
        image, largest = np.empty_like(self._image), 0.0
        for i, j in product(range(self._k), repeat=2):
            block = (slice(i, None, self._k), slice(j, None, self._k))
            image[block], error = self._block(i, j, self._image[block], lam)
            largest = max(largest, error)
        return image, largest

    def _block(self, i: int, j: int, truth: FloatArray, lam: float) -> tuple[FloatArray, float]:
        unit = 4 * self._bits
        whole_lam = int(Fraction(lam) * 2**unit)
        (left_values, left), (right_values, right) = self._eigen[i], self._eigen[j]
        weight = np.outer(left_values, right_values) + lam
        target = _whole(truth, _FRACTION_BITS)
        gap: Any = np.zeros_like(target)  # E, units of 2^-160
        size = float(np.linalg.norm(truth))
        for _ in range(_MOST_STEPS):
            residual = whole_lam * (target - gap) - self._gram[i] @ gap @ self._gram[j]
            correction = left @ (left.T @ _double(residual, unit + _FRACTION_BITS) @ right / weight) @ right.T
            step = float(np.linalg.norm(correction)) / size
            if not step < _DIVERGED:
                break
            gap = gap + _whole(correction, _FRACTION_BITS)
            if step < _DIGITS:
                return _double(target - gap, _FRACTION_BITS), step
        raise MitsimError(f"solver cost: the exact image did not settle ({step:.1e} left); raise lambda ({lam:g})")


def _whole(values: FloatArray, bits: int) -> Any:
    """Object array of Python integers: values in units of 2^-bits, cut to whole ones."""
    flat = [int(math.ldexp(value, bits)) for value in values.ravel().tolist()]
    return np.array(flat, dtype=object).reshape(values.shape)


def _double(values: Any, bits: int) -> FloatArray:
    """Integers in units of 2^-bits, rounded to double precision."""
    unit = 2**bits
    return np.array([value / unit for value in values.ravel().tolist()], dtype=np.float64).reshape(values.shape)
