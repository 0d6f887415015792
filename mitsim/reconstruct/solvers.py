"""Ways from frames to an image, by name: each prepares a camera and its patterns once, and solves any number of scenes.

A further one is a class with ``init`` and ``compute`` (:class:`Solver`), a line in :data:`SOLVERS`, and its name in
:data:`mitsim.reconstruct.request.METHODS`, which is read before numpy is imported.

*Total variation and bounds.* Minimises P(X) = 1/2 sum_ij ||Y_ij - Phi_L (P_ij o X) Phi_R^T||^2 + weight TV(X) + ridge /
2 ||X||^2, isotropic TV, over all X whose numbers are within bounds, by ADMM (Boyd et al. 2011, section 3.1.1) on X = Z,
D = grad Z, B = Z: the X step is the Tikhonov solve around Z, diagonal in the basis of the prepared factors; the D step
shrinks gradients; the B step clips; the Z step is a Poisson equation, diagonal in cosines, so that it costs the same
whatever the weight. The image is Z, clipped.

How far an image is above the minimum is told by duality. With |Q| <= weight everywhere, Q . grad X <= weight TV(X); and
with N that pushes against bounds alone, N . X is nowhere within them above its value at the bounds. So P is there
nowhere below the quadratic that has Q . grad X and N . (X - bound) for these. Among all images that are no farther
from X than r, that quadratic is at its least not below its value at X less 1/2 sum c^2 / (sigma^2 + ridge + mu) + mu
r^2 / 2, for any mu >= 0, c being the coefficients of its gradient at X. Hence P(X) exceeds the minimum by no more than

    gap = weight TV(X) - Q . grad X + N . (bound - X) + 1/2 sum c^2 / (sigma^2 + ridge + mu) + mu r^2 / 2

with the Q and N that the D and B steps give, the best mu, and r = ||X||. (mu is for directions that frames hardly
measure: at mu = 0 these would divide by sigma^2.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import numpy as np
from scipy.fft import dctn, idctn

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.reconstruct.convolution import check_lambda
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.regularisation import DiagonalProblem, automatic_lambda, end_of_range, noise_variance
from mitsim.reconstruct.request import MARKOV, NONNEGATIVE, TIKHONOV, TV, Bounds
from mitsim.reconstruct.solution import Solution, Status, Verdict
from mitsim.reconstruct.solver import Accumulator, Prepared, prepare

# ---- Total variation and bounds --------------------------------------------------------------------------------------


_BALANCE, _STEP = 3.0, 2.0
"""Ratio of two residuals, or of two parts of the gap, beyond which a penalty changes, and by how much at most: they set
the speed only. Boyd et al. name 10 and 2."""
_RELAXED = 1.7
"""Over-relaxation: Boyd et al. name 1.5 to 1.8 (section 3.4.3)."""
_BALANCED_EACH, _JUDGED_EACH = 5, 10
"""Steps after which the penalty of X = Z is looked at, and the gap, which costs two steps: of 5, 10 and 20 those that
end soonest over seven decades of weights (128 x 128; uniform light, dots:3, hadamard:2)."""
_DAMPINGS = 10.0 ** np.arange(-20, 2.1, 0.5)
"""mu over the largest sigma^2: from where no direction feels it to where all do."""
_NOTHING = 1e-300
"""In place of a zero that is divided by: the smallest power of ten above what underflows."""


_SINGLE = float(np.finfo(np.float32).eps) ** 2 / 2
"""Objective over the data's energy that rounding frames to single precision adds: a gap is relative to no less."""


def automatic_weight(problem: DiagonalProblem) -> float:
    """Weight for a ``problem``: the root of its noise variance times Tikhonov's automatic lambda.

    Of noise of variance v, and slopes whose size is distributed as exp(-slope / b), the likeliest image is that of
    weight v / b. Automatic lambda is v over the mean square of what frames tell of the image, whose root stands for b.
    """
    return float(np.sqrt(noise_variance(problem) * automatic_lambda(problem)))


@dataclass(frozen=True)
class Prior:
    """What is known of an image X before it is seen: weight TV(X) + ridge / 2 ||X||^2 is added to half the squared
    misfit, and all numbers of X are within ``bounds``.

    Attributes
    ----------
    weight
        of the total variation [data^2 / image].
    ridge
        lambda [(data / image)^2].
    bounds
        least and largest number of an image.
    """

    weight: float = 0.0
    ridge: float = 0.0
    bounds: Bounds = (-math.inf, math.inf)

    @property
    def bounded(self) -> bool:
        """Whether not every number is allowed."""
        return math.isfinite(self.bounds[0]) or math.isfinite(self.bounds[1])

    def slack(self, image: FloatArray, pressed: FloatArray) -> float:
        """How far <``pressed``, X> may exceed <``pressed``, ``image``> within the bounds: 0 where ``pressed`` pushes
        against the bound that a pixel is at; inf where it pushes against none."""
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
    """Total-variation solution of the added frames.

    Parameters
    ----------
    prepared, frames
        the factorised model, and all its frames.
    weight
        >= 0 [data^2 / image], or ``"auto"``: :func:`automatic_weight`; 0 is least squares, without bounds in closed
        form.
    iterations, tolerance
        it stops when the relative gap is at most ``tolerance``, or after so many steps.
    bounds
        least and largest number of the image; None: any.

    Raises
    ------
    MitsimError
        for missing frames, another weight, or no iterations.
    """
    problem = prepared.problem(frames)
    lam = automatic_weight(problem) if weight == "auto" else check_lambda(weight)
    return _solve(prepared, problem, Prior(weight=lam, bounds=bounds or Prior.bounds), iterations, tolerance)


def solve_nonnegative(
    prepared: Prepared,
    frames: Accumulator,
    lam: float | str = "auto",
    iterations: int = 5000,
    tolerance: float = 1e-4,
    bounds: Bounds | None = None,
) -> Solution:
    """Tikhonov's solution of the added frames among images within bounds.

    Parameters
    ----------
    prepared, frames
        the factorised model, and all its frames.
    lam
        lambda >= 0, or ``"auto"``: Tikhonov's (:func:`mitsim.reconstruct.regularisation.automatic_lambda`).
    iterations, tolerance
        as :func:`solve_tv`; the objective is half of Tikhonov's.
    bounds
        least and largest number of the image; None: 0 and inf.

    Raises
    ------
    MitsimError
        for missing frames, another lambda, or no iterations.
    """
    problem = prepared.problem(frames)
    ridge = automatic_lambda(problem) if lam == "auto" else check_lambda(lam)
    found = _solve(prepared, problem, Prior(ridge=ridge, bounds=bounds or (0.0, math.inf)), iterations, tolerance)
    flags = end_of_range(problem, ridge) if lam == "auto" else ()
    return replace(found, status=replace(found.status, flags=flags))


def _solve(prepared: Prepared, problem: DiagonalProblem, prior: Prior, iterations: int, tolerance: float) -> Solution:
    if iterations < 1:
        raise MitsimError(f"iterations are {iterations}; give at least 1")
    if not prior.weight and not prior.bounded:
        square = np.square(problem.sigma) + prior.ridge
        measured = problem.sigma > 0
        least = np.divide(problem.sigma * problem.projected, square, out=np.zeros_like(square), where=measured)
        return _solution(prepared, problem, prior, prepared.image(least), 0, 0.0, True)
    image, spent, gap = _minimise(prepared, problem, prior, iterations, tolerance)
    return _solution(prepared, problem, prior, image, spent, gap, gap <= tolerance)


def _minimise(
    prepared: Prepared, problem: DiagonalProblem, prior: Prior, iterations: int, tolerance: float
) -> tuple[FloatArray, int, float]:
    """The image (n, n') whose relative gap is at most ``tolerance``, or that after ``iterations`` steps; the steps; its
    relative gap."""
    weight, ridge = prior.weight, prior.ridge
    squared, data = np.square(problem.sigma) + ridge, problem.sigma * problem.projected
    rho = _penalty(problem)
    smooth = prepared.image(data / (squared + rho))
    slopes = _gradient(smooth)
    rho_slopes = weight / max(float(_length(slopes).mean()), _NOTHING)
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
            length = _length(target)
            shrunk = target * (np.maximum(length - weight / rho_slopes, 0.0) / np.maximum(length, _NOTHING))
            bounded = rho_slopes * (target - shrunk)
            relaxed_slopes = _RELAXED * shrunk + (1 - _RELAXED) * slopes
            source += rho_slopes * _gradient_adjoint(relaxed_slopes + dual_slopes)
            total = total + rho_slopes * laplacian
        if prior.bounded:
            target = smooth - dual_inside
            inside = np.clip(target, *prior.bounds)
            pressed = rho_inside * (target - inside)
            relaxed_inside = _RELAXED * inside + (1 - _RELAXED) * smooth
            source += rho_inside * (relaxed_inside + dual_inside)
            total = total + rho_inside
        smooth = idctn(dctn(source, norm="ortho") / total, norm="ortho") if weight else source / total
        slopes = _gradient(smooth)
        dual += _RELAXED * updated + (1 - _RELAXED) * before - smooth
        if weight:
            dual_slopes += relaxed_slopes - slopes
        if prior.bounded:
            dual_inside += relaxed_inside - smooth
        if spent % _JUDGED_EACH == 0 or spent == iterations:
            image = np.clip(smooth, *prior.bounds)
            objective = _objective(prepared, problem, image, prior)
            parts = _gap(prepared, problem, image, prior, bounded, pressed)
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


def _towards(first: float, second: float, power: float) -> float:
    """Factor of a penalty that a ``first`` number above the ``second`` one calls for: a ``power`` of their ratio, at
    most ``_STEP``."""
    ratio = max(first, _NOTHING) / max(second, _NOTHING)
    return 1.0 if 1 / _BALANCE <= ratio <= _BALANCE else float(np.clip(ratio**power, 1 / _STEP, _STEP))


def _objective(prepared: Prepared, problem: DiagonalProblem, image: FloatArray, prior: Prior) -> float:
    """P(X) of an ``image`` (n, n') under a ``prior``, without the energy outside the model's range."""
    misfit = problem.projected - problem.sigma * prepared.coefficients(image)
    variation = prior.weight * float(_length(_gradient(image)).sum()) if prior.weight else 0.0
    return 0.5 * float(np.square(misfit).sum() + prior.ridge * np.square(image).sum()) + variation


def _gap(
    prepared: Prepared,
    problem: DiagonalProblem,
    image: FloatArray,
    prior: Prior,
    bounded: FloatArray,
    pressed: FloatArray,
) -> tuple[float, float]:
    """The gap of an ``image`` (n, n') in two parts, that of the ``prior`` and that of the quadratic; ``bounded`` (2, n,
    n') is Q, no longer than the weight anywhere, and ``pressed`` (n, n') is N."""
    pull, variation = pressed, prior.slack(image, pressed)
    if prior.weight:
        slopes = _gradient(image)
        variation += prior.weight * float(_length(slopes).sum()) - float(np.sum(bounded * slopes))
        pull = pull + _gradient_adjoint(bounded)
    pull = pull + prior.ridge * image
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


def _gradient(image: FloatArray) -> FloatArray:
    """(2, n, n') differences of an ``image`` (n, n') to the next row and column; 0 at the last."""
    return np.stack([np.diff(image, axis=axis, append=image.take([-1], axis)) for axis in (0, 1)])


def _gradient_adjoint(slopes: FloatArray) -> FloatArray:
    """(n, n') adjoint of :func:`_gradient`, of ``slopes`` (2, n, n')."""
    down, across = slopes[0, :-1], slopes[1, :, :-1]
    total = np.zeros(slopes.shape[1:])
    total[1:] += down
    total[:-1] -= down
    total[:, 1:] += across
    total[:, :-1] -= across
    return total


def _length(slopes: FloatArray) -> FloatArray:
    """(n, n') lengths of ``slopes`` (2, n, n')."""
    return np.asarray(np.sqrt(np.square(slopes).sum(axis=0)))


def _norm(values: FloatArray) -> float:
    return float(np.linalg.norm(values))


def _penalty(problem: DiagonalProblem) -> float:
    """ADMM penalty, which sets the speed only: the Tikhonov lambda balances both of its steps."""
    measured = np.square(problem.sigma[problem.sigma > 0])
    if problem.data_count > measured.size:
        lam = automatic_lambda(problem)
        if lam > problem.scale * np.finfo(np.float64).eps:
            return lam
    return float(np.exp(np.mean(np.log(measured))))


def _solution(
    prepared: Prepared,
    problem: DiagonalProblem,
    prior: Prior,
    image: FloatArray,
    iterations: int,
    gap: float,
    converged: bool,
) -> Solution:
    modelled = problem.sigma * prepared.coefficients(image)
    outside = max(problem.energy - float(np.sum(np.square(problem.projected))), 0.0)
    misfit = outside + float(np.sum(np.square(problem.projected - modelled)))
    lost, limit = prepared.lost
    figures, name = f"{prepared.extent}.", "total variation" if prior.weight else "least squares"
    if not converged:
        far = f"may still be {gap:.1e} above its minimum" if gap <= 1 else "is not proven to be near its minimum"
        status = Status(
            Verdict.NOT_CONVERGED,
            f"Not converged: after {iterations} iterations {name} {far}",
            f"take a {'weight' if prior.weight else 'lambda'} nearer the automatic one, or allow more iterations or a "
            "larger tolerance",
            figures,
        )
    elif lost:
        status = Status(
            Verdict.PARTLY_MEASURED,
            f"Solved in {iterations} iterations, but {lost} of {prepared.unknowns} directions are not measured above "
            f"{limit} and follow from {name} alone",
            "use more patterns",
            figures,
        )
    else:
        sentence = f"Solved: {name} converged in {iterations} iterations, {gap:.0e} or less above its minimum"
        status = Status(Verdict.SOLVED, sentence, "", figures)
    return Solution(
        image=image,
        lam=prior.weight or prior.ridge,
        iterations=iterations,
        objective=outside / 2 + _objective(prepared, problem, image, prior),
        relative_gap=gap,
        residual=float(np.sqrt(misfit / problem.energy)) if problem.energy > 0 else 0.0,
        status=status,
    )


# ---- Solvers by name -------------------------------------------------------------------------------------------------


Patterns = tuple[FloatArray, FloatArray]
"""P_L (n, K) and P_R (n', K')."""


class Solver(Protocol):
    """A way from frames to an image: prepared once for a camera and its patterns, and then applied to any scenes.

    Attributes
    ----------
    linear
        whether images at one lambda are linear in the frames, so that noise of the frames is told for each pixel.
    whole
        whether every pattern's slab has all coefficients, not those of the pixels that it lights alone.
    """

    linear: bool
    whole: bool

    @property
    def name(self) -> str:
        """The method's."""
        ...

    def init(self, camera: Factors, patterns: Patterns) -> Prepared:
        """What depends on the ``camera`` and the ``patterns`` alone; applying it changes nothing in it."""
        ...

    def compute(
        self, prepared: Prepared, frames: Accumulator, lam: float | Literal["auto"], **iterative: Any
    ) -> Solution:
        """The image of one scene.

        Parameters
        ----------
        prepared, frames
            what :meth:`init` gives, and all frames, added up.
        lam
            lambda; what ``auto`` does is the solver's own.
        **iterative
            what was asked for of ``bounds`` and ``iterations``; a solver that iterates has these arguments.
        """
        ...


class Tikhonov(Solver):
    """Least squares with lambda ||X||^2: pixels are independent, the solution is in closed form."""

    name, linear, whole = TIKHONOV, True, False

    def init(self, camera: Factors, patterns: Patterns) -> Prepared:
        """The ``camera``'s model under ``patterns``, factorised."""
        prepared = prepare(camera.left, camera.right, *patterns, centre=camera.manifest.centre)
        stated = camera.manifest.noise
        left, right = (float(np.square(side).sum(axis=1).mean()) for side in patterns)
        noise = (stated.left, stated.right) if stated else Prepared.noise
        return replace(prepared, stated=camera.stated_rank, noise=noise, light=(left, right))

    def compute(
        self, prepared: Prepared, frames: Accumulator, lam: float | Literal["auto"], **iterative: Any
    ) -> Solution:
        """The image of ``frames``.

        Parameters
        ----------
        prepared, frames
            what :meth:`init` gives, and all frames, added up.
        lam
            lambda; ``auto``: :func:`mitsim.reconstruct.regularisation.automatic_lambda`.
        **iterative
            nothing: a closed form has neither bounds nor steps.
        """
        return prepared.solve(frames, lam)


class Markov(Tikhonov):
    """Least squares where neighbouring pixels are alike, for noisy frames: lambda times X in the metric of their
    inverse covariance."""

    name, whole = MARKOV, True

    def init(self, camera: Factors, patterns: Patterns) -> Prepared:
        """The ``camera``'s model under ``patterns``, factorised in the basis of correlated pixels."""
        return super().init(camera, patterns).with_correlation()


class Nonnegative(Tikhonov):
    """Least squares among images within bounds, by iterations."""

    name, linear = NONNEGATIVE, False

    def compute(
        self, prepared: Prepared, frames: Accumulator, lam: float | Literal["auto"], **iterative: Any
    ) -> Solution:
        """The image of ``frames``.

        Parameters
        ----------
        prepared, frames, lam, **iterative
            as :func:`solve_nonnegative` takes them.
        """
        return solve_nonnegative(prepared, frames, lam, **iterative)


class TotalVariation(Tikhonov):
    """Least squares with lambda times the total variation of X, within bounds, by iterations."""

    name, linear = TV, False

    def compute(
        self, prepared: Prepared, frames: Accumulator, lam: float | Literal["auto"], **iterative: Any
    ) -> Solution:
        """The image of ``frames``.

        Parameters
        ----------
        prepared, frames, lam, **iterative
            as :func:`solve_tv` takes them.
        """
        return solve_tv(prepared, frames, lam, **iterative)


_ALL = Tikhonov(), Markov(), Nonnegative(), TotalVariation()
SOLVERS: dict[str, Solver] = {solver.name: solver for solver in _ALL}
"""By the method that an image is asked by."""
