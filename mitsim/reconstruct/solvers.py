"""Solvers by name: each prepares a camera and its patterns once, and solves any number of scenes.

A new solver is a function that :class:`ByIterations` names, or a class with ``init`` and ``compute`` (:class:`Solver`).
It needs an entry of :data:`_ALL`, and its name in :data:`mitsim.reconstruct.request.METHODS`.

*Total variation and bounds.* P(X) = 1/2 sum_ij ||Y_ij - Phi_L (P_ij o X) Phi_R^T||^2 + weight TV(X) + ridge / 2
||X||^2, isotropic TV, is minimised within bounds by ADMM (Boyd et al. 2011, section 3.1.1) on X = Z, D = grad Z, B = Z.
The X step is the Tikhonov solve around Z, diagonal in the basis of the prepared factors; the D step shrinks gradients;
the B step clips; the Z step is a Poisson equation, diagonal in cosines. The image is Z, clipped.

*Gap.* With |Q| <= weight everywhere, Q . grad X <= weight TV(X). With N that pushes against bounds alone, N . X is
nowhere within them above its value at the bounds. So P exceeds nowhere the quadratic that has Q . grad X and N . (X -
bound) for these terms. Among images not farther from X than r that quadratic is at least its value at X less 1/2 sum
c^2 / (sigma^2 + ridge + mu) + mu r^2 / 2, for any mu >= 0, c being the coefficients of its gradient at X. Hence P(X)
exceeds the minimum by at most

    gap = weight TV(X) - Q . grad X + N . (bound - X) + 1/2 sum c^2 / (sigma^2 + ridge + mu) + mu r^2 / 2

with the Q and N of the D and B steps, the best mu, and r = ||X||.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, Protocol

import numpy as np
from scipy.fft import dctn, idctn

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.request import MARKOV, NONNEGATIVE, TIKHONOV, TV, Bounds
from mitsim.reconstruct.solver import (
    Accumulator,
    DiagonalProblem,
    Prepared,
    Solution,
    Status,
    Verdict,
    automatic_lambda,
    check_lambda,
    end_of_range,
    noise_variance,
    prepare,
)

# ---- Total variation and bounds --------------------------------------------------------------------------------------


_BALANCE, _STEP = 3.0, 2.0
_RELAXED = 1.7
_BALANCED_EACH, _JUDGED_EACH = 5, 10
_DAMPINGS = 10.0 ** np.arange(-20, 2.1, 0.5)
_NOTHING = 1e-300


_SINGLE = float(np.finfo(np.float32).eps) ** 2 / 2


@dataclass(frozen=True)
class Prior:
    """Prior of an image X within ``bounds``: weight TV(X) + ridge / 2 ||X||^2 is added to half the squared misfit."""

    weight: float = 0.0
    ridge: float = 0.0
    bounds: Bounds = (-math.inf, math.inf)

    @property
    def bounded(self) -> bool:
        return math.isfinite(self.bounds[0]) or math.isfinite(self.bounds[1])


def _solve_by_iterations(
    prepared: Prepared,
    frames: Accumulator,
    lam: float | str = "auto",
    iterations: int = 5000,
    tolerance: float = 1e-4,
    bounds: Bounds | None = None,
    *,
    variation: bool,
) -> Solution:
    problem, automatic = prepared.problem(frames), lam == "auto"
    known = automatic_lambda(problem) if automatic else check_lambda(lam)
    if not variation:
        found = _find_minimum(prepared, problem, Prior(0.0, known, bounds or (0.0, math.inf)), iterations, tolerance)
        flags = end_of_range(problem, known) if automatic else ()
        return replace(found, status=replace(found.status, flags=flags))
    if automatic:
        # With noise of variance v and slopes distributed as exp(-slope / b), the likeliest image has the weight v / b,
        # and the root of v over Tikhonov's automatic lambda estimates b.
        known = float(np.sqrt(noise_variance(problem) * known))
    return _find_minimum(prepared, problem, Prior(known, 0.0, bounds or Prior.bounds), iterations, tolerance)


solve_tv, solve_nonnegative = (partial(_solve_by_iterations, variation=variation) for variation in (True, False))


def _find_minimum(
    prepared: Prepared, problem: DiagonalProblem, prior: Prior, iterations: int, tolerance: float
) -> Solution:
    if iterations < 1:
        raise MitsimError(f"iterations are {iterations}; give at least 1")
    if prior.weight or prior.bounded:
        image, iterations, gap = _iterate(prepared, problem, prior, iterations, tolerance)
        converged = gap <= tolerance
    else:
        square, measured = np.square(problem.sigma) + prior.ridge, problem.sigma > 0
        least = np.divide(problem.sigma * problem.projected, square, out=np.zeros_like(square), where=measured)
        image, iterations, gap, converged = prepared.image(least), 0, 0.0, True
    modelled = problem.sigma * prepared.coefficients(image)
    outside = max(problem.energy - float(np.sum(np.square(problem.projected))), 0.0)
    misfit = outside + float(np.sum(np.square(problem.projected - modelled)))
    lost, limit = prepared.lost
    status = partial(Status, figures=f"{prepared.extent}.")
    name = "total variation" if prior.weight else "least squares"
    if not converged:
        far = f"may still be {gap:.1e} above its minimum" if gap <= 1 else "is not proven to be near its minimum"
        remedy = f"take a {'weight' if prior.weight else 'lambda'} nearer the automatic one, or allow more iterations"
        words = f"Not converged: after {iterations} iterations {name} {far}"
        found = status(Verdict.NOT_CONVERGED, words, f"{remedy} or a larger tolerance")
    elif lost:
        words = f"Partly measured: {lost} of {prepared.unknowns} directions are not measured above {limit}"
        words += f" and follow from {name} alone, which converged in {iterations} iterations"
        found = status(Verdict.PARTLY_MEASURED, words, "use more patterns")
    else:
        words = f"Solved: {name} converged in {iterations} iterations, {gap:.0e} or less above its minimum"
        found = status(Verdict.SOLVED, words)
    residual = float(np.sqrt(misfit / problem.energy)) if problem.energy > 0 else 0.0
    objective = outside / 2 + _objective(prepared, problem, prior, image)
    return Solution(image, prior.weight or prior.ridge, residual, found, None, iterations, objective, gap)


def _iterate(
    prepared: Prepared, problem: DiagonalProblem, prior: Prior, iterations: int, tolerance: float
) -> tuple[FloatArray, int, float]:
    weight, ridge = prior.weight, prior.ridge
    squared, data = np.square(problem.sigma) + ridge, problem.sigma * problem.projected
    # The penalty sets the speed alone: Tikhonov's lambda balances both of its steps.
    measured = np.square(problem.sigma[problem.sigma > 0])
    rho = automatic_lambda(problem) if problem.data_count > measured.size else 0.0
    if rho <= problem.scale * np.finfo(np.float64).eps:
        rho = float(np.exp(np.mean(np.log(measured))))
    smooth = prepared.image(data / (squared + rho))
    slopes = slopes_of(smooth)
    rho_slopes = weight / max(float(lengths(slopes).mean()), _NOTHING)
    # Without bounds nothing is held to them.
    inside, rho_inside = np.clip(smooth, *prior.bounds), rho if prior.bounded else 0.0
    dual, dual_slopes, dual_inside = np.zeros_like(smooth), np.zeros_like(slopes), np.zeros_like(smooth)
    rows, columns = (2 - 2 * np.cos(np.pi * np.arange(size) / size) for size in smooth.shape)
    laplacian = rows[:, None] + columns
    spent, relative = 0, float("inf")
    while spent < iterations and relative > tolerance:
        spent += 1
        target = smooth - dual
        seen, kept = prepared.coefficients(target), rho / (ridge + rho)
        # Directions outside the basis (under-determined sides) are not measured: they keep the target.
        updated = kept * target + prepared.image((data + rho * seen) / (squared + rho) - kept * seen)
        before, before_inside = smooth, inside
        source = rho * (_RELAXED * updated + (1 - _RELAXED) * smooth + dual)
        total: FloatArray | float = rho
        bounded, pressed = dual_slopes, dual_inside
        if weight:
            target = slopes - dual_slopes
            length = lengths(target)
            shrunk = target * (np.maximum(length - weight / rho_slopes, 0.0) / np.maximum(length, _NOTHING))
            bounded = rho_slopes * (target - shrunk)
            relaxed_slopes = _RELAXED * shrunk + (1 - _RELAXED) * slopes
            source += rho_slopes * slopes_adjoint(relaxed_slopes + dual_slopes)
            total = total + rho_slopes * laplacian
        if prior.bounded:
            target = smooth - dual_inside
            inside = np.clip(target, *prior.bounds)
            pressed = rho_inside * (target - inside)
            relaxed_inside = _RELAXED * inside + (1 - _RELAXED) * smooth
            source += rho_inside * (relaxed_inside + dual_inside)
            total = total + rho_inside
        smooth = idctn(dctn(source, norm="ortho") / total, norm="ortho") if weight else source / total
        slopes = slopes_of(smooth)
        dual += _RELAXED * updated + (1 - _RELAXED) * before - smooth
        if weight:
            dual_slopes += relaxed_slopes - slopes
        if prior.bounded:
            dual_inside += relaxed_inside - smooth
        if spent % _JUDGED_EACH == 0 or spent == iterations:
            image = np.clip(smooth, *prior.bounds)
            objective = _objective(prepared, problem, prior, image)
            parts = _gap(prepared, problem, prior, image, bounded, pressed)
            relative = sum(parts) / max(objective, _SINGLE * problem.energy, _NOTHING)
            # Gradients that are bound too tightly leave the data behind, and the other way round.
            factor = _towards(*parts, power=0.25)
            rho_slopes, dual_slopes = rho_slopes * factor, dual_slopes / factor
        if spent % _BALANCED_EACH == 0:
            # Primal and dual residual, each over what it is a difference of (Boyd et al., sections 3.3 and 3.4.1).
            apart = _norm(updated - smooth) / max(_norm(updated), _norm(smooth), _NOTHING)
            moved = _norm(smooth - before) / max(_norm(dual), _NOTHING)
            factor = _towards(apart, moved, power=0.5)
            rho, dual = rho * factor, dual / factor
            if prior.bounded:
                apart = _norm(inside - smooth) / max(_norm(inside), _norm(smooth), _NOTHING)
                moved = _norm(inside - before_inside) / max(_norm(dual_inside), _NOTHING)
                factor = _towards(apart, moved, power=0.5)
                rho_inside, dual_inside = rho_inside * factor, dual_inside / factor
    return np.asarray(np.clip(smooth, *prior.bounds)), spent, relative


def _objective(prepared: Prepared, problem: DiagonalProblem, prior: Prior, image: FloatArray) -> float:
    misfit = problem.projected - problem.sigma * prepared.coefficients(image)
    variation = prior.weight * float(lengths(slopes_of(image)).sum()) if prior.weight else 0.0
    return 0.5 * float(np.square(misfit).sum() + prior.ridge * np.square(image).sum()) + variation


def _gap(
    prepared: Prepared,
    problem: DiagonalProblem,
    prior: Prior,
    image: FloatArray,
    bounded: FloatArray,
    pressed: FloatArray,
) -> tuple[float, float]:
    variation, pull = 0.0, pressed + prior.ridge * image
    for part, bound in zip((np.minimum(pressed, 0.0), np.maximum(pressed, 0.0)), prior.bounds, strict=True):
        # Nothing pushes against a bound that is not there.
        variation += float(np.sum(part * (bound - image))) if math.isfinite(bound) else 0.0
    if prior.weight:
        slopes = slopes_of(image)
        variation += prior.weight * float(lengths(slopes).sum()) - float(np.sum(bounded * slopes))
        pull = pull + slopes_adjoint(bounded)
    along, seen = prepared.coefficients(pull), prepared.coefficients(image)
    unmeasured = float(np.square(pull - prepared.image(along)).sum())
    squared = np.square(problem.sigma) + prior.ridge
    gradient = np.square(problem.sigma * (problem.sigma * seen - problem.projected) + along)
    dampings, reach = problem.scale * _DAMPINGS, float(np.square(image).sum())
    quadratic = min(
        0.5 * (float(np.sum(gradient / (squared + mu))) + unmeasured / (prior.ridge + mu) + mu * reach)
        for mu in dampings.tolist()
    )
    return max(variation, 0.0), quadratic


def _towards(first: float, second: float, power: float) -> float:
    ratio = max(first, _NOTHING) / max(second, _NOTHING)
    return 1.0 if 1 / _BALANCE <= ratio <= _BALANCE else float(np.clip(ratio**power, 1 / _STEP, _STEP))


def _norm(values: FloatArray) -> float:
    return float(np.linalg.norm(values))


def slopes_of(image: FloatArray) -> FloatArray:
    """Return the differences (axes, ...) of neighbouring numbers of an image or a volume, 0 beyond the last."""
    return np.stack([np.diff(image, axis=axis, append=image.take([-1], axis)) for axis in range(image.ndim)])


def slopes_adjoint(slopes: FloatArray) -> FloatArray:
    """Return the adjoint of :func:`slopes_of`."""
    total = np.zeros(slopes.shape[1:], slopes.dtype)
    for axis, along in enumerate(slopes):
        sums, part = np.moveaxis(total, axis, 0), np.moveaxis(along, axis, 0)[:-1]
        sums[1:] += part
        sums[:-1] -= part
    return total


def lengths(slopes: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.square(slopes).sum(axis=0)))


# ---- Solvers by name -------------------------------------------------------------------------------------------------


Patterns = tuple[FloatArray, FloatArray]
Lambda = float | Literal["auto"]


class Solver(Protocol):
    """Solver of images: prepared once for a camera and its patterns, and applied to any number of scenes.

    Images of a ``linear`` solver have an uncertainty for each pixel.
    """

    linear: bool
    whole: bool

    @property
    def name(self) -> str: ...

    def init(self, camera: Factors, patterns: Patterns) -> Prepared: ...

    def compute(self, prepared: Prepared, frames: Accumulator, lam: Lambda, **iterative: Any) -> Solution: ...


class Tikhonov(Solver):
    """Least squares with lambda ||X||^2 in closed form."""

    name: str = TIKHONOV
    linear, whole = True, False

    def init(self, camera: Factors, patterns: Patterns) -> Prepared:
        prepared = prepare(camera.left, camera.right, *patterns, centre=camera.manifest.centre)
        stated = camera.manifest.noise
        left, right = (float(np.square(side).sum(axis=1).mean()) for side in patterns)
        noise = (stated.left, stated.right) if stated else Prepared.noise
        return replace(prepared, stated=camera.stated_rank, noise=noise, light=(left, right))

    def compute(self, prepared: Prepared, frames: Accumulator, lam: Lambda, **iterative: Any) -> Solution:
        return prepared.solve(frames, lam)


class Markov(Tikhonov):
    """Least squares for noisy frames, with the inverse covariance of neighbouring pixels as the metric of X."""

    name, whole = MARKOV, True

    def init(self, camera: Factors, patterns: Patterns) -> Prepared:
        return super().init(camera, patterns).with_correlation()


class ByIterations(Tikhonov):
    """Least squares within bounds, or with total variation."""

    linear = False

    def __init__(self, name: str, solve: Callable[..., Solution]) -> None:
        self.name, self._solve = name, solve

    def compute(self, prepared: Prepared, frames: Accumulator, lam: Lambda, **iterative: Any) -> Solution:
        return self._solve(prepared, frames, lam, **iterative)


_ALL = Tikhonov(), Markov(), ByIterations(NONNEGATIVE, solve_nonnegative), ByIterations(TV, solve_tv)
SOLVERS: dict[str, Solver] = {solver.name: solver for solver in _ALL}
