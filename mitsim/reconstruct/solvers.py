"""Solvers by name: each prepares a camera and its patterns once, and solves any number of scenes.

A new solver is a class with ``init`` and ``compute`` (:class:`Solver`), a line in :data:`SOLVERS`, and its name in
:data:`mitsim.reconstruct.request.METHODS`.

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
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import numpy as np
from scipy.fft import dctn, idctn

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.request import MARKOV, NONNEGATIVE, TIKHONOV, TV, Bounds
from mitsim.reconstruct.solution import Solution, Status, Verdict
from mitsim.reconstruct.solver import (
    Accumulator,
    DiagonalProblem,
    Prepared,
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


def automatic_weight(problem: DiagonalProblem) -> float:
    """Return the root of the noise variance times Tikhonov's automatic lambda as the weight for a ``problem``.

    With noise of variance v and slopes distributed as exp(-slope / b), the likeliest image has the weight v / b, and
    the root of v over automatic lambda estimates b.
    """
    return float(np.sqrt(noise_variance(problem) * automatic_lambda(problem)))


@dataclass(frozen=True)
class Prior:
    """Prior of an image X within ``bounds``: weight TV(X) + ridge / 2 ||X||^2 is added to half the squared misfit."""

    weight: float = 0.0
    ridge: float = 0.0
    bounds: Bounds = (-math.inf, math.inf)

    @property
    def bounded(self) -> bool:
        return math.isfinite(self.bounds[0]) or math.isfinite(self.bounds[1])

    def slack(self, image: FloatArray, pressed: FloatArray) -> float:
        low, high = self.bounds
        down, up = np.minimum(pressed, 0.0), np.maximum(pressed, 0.0)
        total = 0.0
        for part, bound in ((down, low), (up, high)):
            if math.isfinite(bound):
                total += float(np.sum(part * (bound - image)))
            elif part.any():
                return math.inf
        return total


def solve_tv(
    prepared: Prepared,
    frames: Accumulator,
    weight: float | str = "auto",
    iterations: int = 5000,
    tolerance: float = 1e-4,
    bounds: Bounds | None = None,
) -> Solution:
    problem = prepared.problem(frames)
    lam = automatic_weight(problem) if weight == "auto" else check_lambda(weight)
    return _Minimum(prepared, problem, Prior(weight=lam, bounds=bounds or Prior.bounds)).find(iterations, tolerance)


def solve_nonnegative(
    prepared: Prepared,
    frames: Accumulator,
    lam: float | str = "auto",
    iterations: int = 5000,
    tolerance: float = 1e-4,
    bounds: Bounds | None = None,
) -> Solution:
    problem = prepared.problem(frames)
    ridge = automatic_lambda(problem) if lam == "auto" else check_lambda(lam)
    prior = Prior(ridge=ridge, bounds=bounds or (0.0, math.inf))
    found = _Minimum(prepared, problem, prior).find(iterations, tolerance)
    flags = end_of_range(problem, ridge) if lam == "auto" else ()
    return replace(found, status=replace(found.status, flags=flags))


class _Minimum:
    def __init__(self, prepared: Prepared, problem: DiagonalProblem, prior: Prior) -> None:
        self.prepared, self.problem, self.prior = prepared, problem, prior

    def find(self, iterations: int, tolerance: float) -> Solution:
        if iterations < 1:
            raise MitsimError(f"iterations are {iterations}; give at least 1")
        problem = self.problem
        if self.prior.weight or self.prior.bounded:
            image, iterations, gap = self._iterate(iterations, tolerance)
            converged = gap <= tolerance
        else:
            square, measured = np.square(problem.sigma) + self.prior.ridge, problem.sigma > 0
            least = np.divide(problem.sigma * problem.projected, square, out=np.zeros_like(square), where=measured)
            image, iterations, gap, converged = self.prepared.image(least), 0, 0.0, True
        modelled = problem.sigma * self.prepared.coefficients(image)
        outside = max(problem.energy - float(np.sum(np.square(problem.projected))), 0.0)
        misfit = outside + float(np.sum(np.square(problem.projected - modelled)))
        lost, limit = self.prepared.lost
        figures, name = f"{self.prepared.extent}.", "total variation" if self.prior.weight else "least squares"
        if not converged:
            far = f"may still be {gap:.1e} above its minimum" if gap <= 1 else "is not proven to be near its minimum"
            status = Status(
                Verdict.NOT_CONVERGED,
                f"Not converged: after {iterations} iterations {name} {far}",
                f"take a {'weight' if self.prior.weight else 'lambda'} nearer the automatic one, or allow more "
                "iterations or a larger tolerance",
                figures,
            )
        elif lost:
            status = Status(
                Verdict.PARTLY_MEASURED,
                f"Solved in {iterations} iterations, but {lost} of {self.prepared.unknowns} directions are not "
                f"measured above {limit} and follow from {name} alone",
                "use more patterns",
                figures,
            )
        else:
            sentence = f"Solved: {name} converged in {iterations} iterations, {gap:.0e} or less above its minimum"
            status = Status(Verdict.SOLVED, sentence, "", figures)
        return Solution(
            image=image,
            lam=self.prior.weight or self.prior.ridge,
            iterations=iterations,
            objective=outside / 2 + self._objective(image),
            relative_gap=gap,
            residual=float(np.sqrt(misfit / problem.energy)) if problem.energy > 0 else 0.0,
            status=status,
        )

    def _iterate(self, iterations: int, tolerance: float) -> tuple[FloatArray, int, float]:
        problem, weight, ridge = self.problem, self.prior.weight, self.prior.ridge
        squared, data = np.square(problem.sigma) + ridge, problem.sigma * problem.projected
        # The penalty sets the speed alone: Tikhonov's lambda balances both of its steps.
        measured = np.square(problem.sigma[problem.sigma > 0])
        rho = automatic_lambda(problem) if problem.data_count > measured.size else 0.0
        if rho <= problem.scale * np.finfo(np.float64).eps:
            rho = float(np.exp(np.mean(np.log(measured))))
        smooth = self.prepared.image(data / (squared + rho))
        slopes = slopes_of(smooth)
        rho_slopes = weight / max(float(lengths(slopes).mean()), _NOTHING)
        # Without bounds nothing is held to them.
        inside, rho_inside = np.clip(smooth, *self.prior.bounds), rho if self.prior.bounded else 0.0
        dual, dual_slopes, dual_inside = np.zeros_like(smooth), np.zeros_like(slopes), np.zeros_like(smooth)
        rows, columns = (2 - 2 * np.cos(np.pi * np.arange(size) / size) for size in smooth.shape)
        laplacian = rows[:, None] + columns
        spent, relative = 0, float("inf")
        while spent < iterations and relative > tolerance:
            spent += 1
            target = smooth - dual
            seen, kept = self.prepared.coefficients(target), rho / (ridge + rho)
            # Directions outside the basis (under-determined sides) are not measured: they keep the target.
            updated = kept * target + self.prepared.image((data + rho * seen) / (squared + rho) - kept * seen)
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
            if self.prior.bounded:
                target = smooth - dual_inside
                inside = np.clip(target, *self.prior.bounds)
                pressed = rho_inside * (target - inside)
                relaxed_inside = _RELAXED * inside + (1 - _RELAXED) * smooth
                source += rho_inside * (relaxed_inside + dual_inside)
                total = total + rho_inside
            smooth = idctn(dctn(source, norm="ortho") / total, norm="ortho") if weight else source / total
            slopes = slopes_of(smooth)
            dual += _RELAXED * updated + (1 - _RELAXED) * before - smooth
            if weight:
                dual_slopes += relaxed_slopes - slopes
            if self.prior.bounded:
                dual_inside += relaxed_inside - smooth
            if spent % _JUDGED_EACH == 0 or spent == iterations:
                image = np.clip(smooth, *self.prior.bounds)
                objective = self._objective(image)
                parts = self._gap(image, bounded, pressed)
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
                if self.prior.bounded:
                    apart = _norm(inside - smooth) / max(_norm(inside), _norm(smooth), _NOTHING)
                    moved = _norm(inside - before_inside) / max(_norm(dual_inside), _NOTHING)
                    factor = _towards(apart, moved, power=0.5)
                    rho_inside, dual_inside = rho_inside * factor, dual_inside / factor
        return np.asarray(np.clip(smooth, *self.prior.bounds)), spent, relative

    def _objective(self, image: FloatArray) -> float:
        misfit = self.problem.projected - self.problem.sigma * self.prepared.coefficients(image)
        variation = self.prior.weight * float(lengths(slopes_of(image)).sum()) if self.prior.weight else 0.0
        return 0.5 * float(np.square(misfit).sum() + self.prior.ridge * np.square(image).sum()) + variation

    def _gap(self, image: FloatArray, bounded: FloatArray, pressed: FloatArray) -> tuple[float, float]:
        problem = self.problem
        pull, variation = pressed, self.prior.slack(image, pressed)
        if self.prior.weight:
            slopes = slopes_of(image)
            variation += self.prior.weight * float(lengths(slopes).sum()) - float(np.sum(bounded * slopes))
            pull = pull + slopes_adjoint(bounded)
        pull = pull + self.prior.ridge * image
        along, seen = self.prepared.coefficients(pull), self.prepared.coefficients(image)
        unmeasured = float(np.square(pull - self.prepared.image(along)).sum())
        squared = np.square(problem.sigma) + self.prior.ridge
        gradient = np.square(problem.sigma * (problem.sigma * seen - problem.projected) + along)
        dampings, reach = problem.scale * _DAMPINGS, float(np.square(image).sum())
        quadratic = min(
            0.5 * (float(np.sum(gradient / (squared + mu))) + unmeasured / (self.prior.ridge + mu) + mu * reach)
            for mu in dampings.tolist()
        )
        return max(variation, 0.0), quadratic


def _towards(first: float, second: float, power: float) -> float:
    ratio = max(first, _NOTHING) / max(second, _NOTHING)
    return 1.0 if 1 / _BALANCE <= ratio <= _BALANCE else float(np.clip(ratio**power, 1 / _STEP, _STEP))


def _norm(values: FloatArray) -> float:
    return float(np.linalg.norm(values))


def slopes_of(image: FloatArray) -> FloatArray:
    return np.stack([np.diff(image, axis=axis, append=image.take([-1], axis)) for axis in (0, 1)])


def slopes_adjoint(slopes: FloatArray) -> FloatArray:
    down, across = slopes[0, :-1], slopes[1, :, :-1]
    total = np.zeros(slopes.shape[1:], slopes.dtype)
    total[1:] += down
    total[:-1] -= down
    total[:, 1:] += across
    total[:, :-1] -= across
    return total


def lengths(slopes: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.square(slopes).sum(axis=0)))


# ---- Solvers by name -------------------------------------------------------------------------------------------------


Patterns = tuple[FloatArray, FloatArray]


class Solver(Protocol):
    """Solver of images: prepared once for a camera and its patterns, and applied to any number of scenes.

    Images of a ``linear`` solver have an uncertainty for each pixel.
    """

    linear: bool
    whole: bool

    @property
    def name(self) -> str: ...

    def init(self, camera: Factors, patterns: Patterns) -> Prepared: ...

    def compute(
        self, prepared: Prepared, frames: Accumulator, lam: float | Literal["auto"], **iterative: Any
    ) -> Solution: ...


class Tikhonov(Solver):
    """Least squares with lambda ||X||^2 in closed form."""

    name, linear, whole = TIKHONOV, True, False

    def init(self, camera: Factors, patterns: Patterns) -> Prepared:
        prepared = prepare(camera.left, camera.right, *patterns, centre=camera.manifest.centre)
        stated = camera.manifest.noise
        left, right = (float(np.square(side).sum(axis=1).mean()) for side in patterns)
        noise = (stated.left, stated.right) if stated else Prepared.noise
        return replace(prepared, stated=camera.stated_rank, noise=noise, light=(left, right))

    def compute(
        self, prepared: Prepared, frames: Accumulator, lam: float | Literal["auto"], **iterative: Any
    ) -> Solution:
        return prepared.solve(frames, lam)


class Markov(Tikhonov):
    """Least squares for noisy frames, with the inverse covariance of neighbouring pixels as the metric of X."""

    name, whole = MARKOV, True

    def init(self, camera: Factors, patterns: Patterns) -> Prepared:
        return super().init(camera, patterns).with_correlation()


class Nonnegative(Tikhonov):
    """Least squares among images within bounds, by iterations."""

    name, linear = NONNEGATIVE, False

    def compute(
        self, prepared: Prepared, frames: Accumulator, lam: float | Literal["auto"], **iterative: Any
    ) -> Solution:
        return solve_nonnegative(prepared, frames, lam, **iterative)


class TotalVariation(Tikhonov):
    """Least squares with lambda times the total variation of X within bounds, by iterations."""

    name, linear = TV, False

    def compute(
        self, prepared: Prepared, frames: Accumulator, lam: float | Literal["auto"], **iterative: Any
    ) -> Solution:
        return solve_tv(prepared, frames, lam, **iterative)


_ALL = Tikhonov(), Markov(), Nonnegative(), TotalVariation()
SOLVERS: dict[str, Solver] = {solver.name: solver for solver in _ALL}
