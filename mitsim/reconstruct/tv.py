"""Accumulated frames in, an image of little total variation out.

Minimises 1/2 sum_ij ||Y_ij - Phi_L (P_ij o X) Phi_R^T||^2 + weight TV(X), isotropic TV, by ADMM (Boyd et
al. 2011, section 3.1.1) on X = Z: the X step is the Tikhonov solve around Z, diagonal in the basis of the
prepared factors; the Z step is Chambolle's projection (2004) as skimage ships it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from skimage.restoration import denoise_tv_chambolle

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.reconstruct.accumulator import Accumulator
from mitsim.reconstruct.regularisation import DiagonalProblem, automatic_lambda, noise_variance
from mitsim.reconstruct.solver import Prepared
from mitsim.reconstruct.status import Status, Verdict

_BALANCE = 3.0
"""Ratio of the two residuals beyond which the penalty changes, which sets the speed only; Boyd et al. name 10."""
_DENOISE = {"eps": 1e-6, "max_num_iter": 60}
"""Chambolle's steps within one of ADMM, which need not converge: the next one goes on from there."""
AUTO_WEIGHT = 0.12
"""Automatic weight in units of the noise that the data term's gradient carries to one scene pixel; chosen by PSNR on
the anchor's photograph."""


@dataclass(frozen=True, eq=False)
class TVSolution:
    """What :func:`solve_tv` found.

    Attributes
    ----------
    image
        (n, n').
    lam
        weight of the total variation that was used [data^2 / image].
    iterations, change
        that were spent, and the last relative change of the image.
    residual
        ||Y - model|| / ||Y|| over all frames.
    status
        of the convergence, with rank and condition.
    """

    image: FloatArray
    lam: float
    iterations: int
    change: float
    residual: float
    status: Status

    @property
    def ok(self) -> bool:
        """Whether the iterations converged."""
        return self.status.ok


def automatic_weight(problem: DiagonalProblem) -> float:
    """Weight for a ``problem``: standard deviation of its noise times the root mean square of sigma, times a constant.

    Where the truth is flat the weight must beat the data term's gradient, which is noise of that standard
    deviation.
    """
    return AUTO_WEIGHT * float(np.sqrt(noise_variance(problem) * np.mean(np.square(problem.sigma))))


def solve_tv(
    prepared: Prepared,
    frames: Accumulator,
    weight: float | str = "auto",
    iterations: int = 100,
    tolerance: float = 1e-4,
) -> TVSolution:
    """Total-variation solution of the added frames.

    Parameters
    ----------
    prepared, frames
        the factorised model, and all its frames.
    weight
        >= 0 [data^2 / image], or ``"auto"``: :func:`automatic_weight`.
    iterations, tolerance
        it stops when the image changes by less than ``tolerance``, relative, or after so many.

    Raises
    ------
    MitsimError
        for missing frames, another weight, or no iterations.
    """
    problem = prepared.problem(frames)
    if weight == "auto":
        weight = automatic_weight(problem)
    if isinstance(weight, str) or not (np.isfinite(weight) and weight >= 0):
        raise MitsimError(f"TV weight is {weight!r}; give a finite number of at least 0, or auto")
    if iterations < 1:
        raise MitsimError(f"TV iterations are {iterations}; give at least 1")
    squared = np.square(problem.sigma)
    rho = _penalty(problem)
    data = problem.sigma * problem.projected
    smooth = prepared.image(data / (squared + rho))
    dual = np.zeros_like(smooth)
    change, spent = float("inf"), 0
    while spent < iterations and change >= tolerance:
        spent += 1
        target = prepared.coefficients(smooth - dual)
        # Directions outside the basis (under-determined sides) are not measured: they keep the target.
        unmeasured = smooth - dual - prepared.image(target)
        updated = prepared.image((data + rho * target) / (squared + rho)) + unmeasured
        before = smooth
        # skimage minimises |u - f|^2 / (2 weight) + TV(u).
        smooth = updated + dual
        if weight:
            smooth = denoise_tv_chambolle(smooth, weight=weight / rho, **_DENOISE)
        dual = dual + updated - smooth
        # Primal and dual residual (Boyd et al., section 3.3): one alone can be small far from the minimum.
        primal, moved = float(np.linalg.norm(updated - smooth)), float(np.linalg.norm(smooth - before))
        change = max(primal, moved) / max(float(np.linalg.norm(smooth)), 1e-300)
        # Residual balancing (section 3.4.1): the penalty sets the speed only, and costs nothing to change here.
        factor = 2.0 if primal > _BALANCE * moved else 0.5 if moved > _BALANCE * primal else 1.0
        rho, dual = rho * factor, dual / factor
    return _solution(prepared, problem, smooth, float(weight), spent, change, change < tolerance)


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
    image: FloatArray,
    weight: float,
    iterations: int,
    change: float,
    converged: bool,
) -> TVSolution:
    modelled = problem.sigma * prepared.coefficients(image)
    outside = max(problem.energy - float(np.sum(np.square(problem.projected))), 0.0)
    misfit = outside + float(np.sum(np.square(problem.projected - modelled)))
    lost = prepared.unknowns - prepared.rank
    figures = f"{prepared.extent}."
    if not converged:
        status = Status(
            Verdict.NOT_CONVERGED,
            f"Not converged: after {iterations} iterations the image still changes by {change:.1e} a step",
            "allow more iterations or a larger tolerance",
            figures,
        )
    elif lost:
        status = Status(
            Verdict.PARTLY_MEASURED,
            f"Solved in {iterations} iterations, but {lost} of {prepared.unknowns} directions are not measured and "
            "follow from total variation alone",
            "use more patterns",
            figures,
        )
    else:
        sentence = f"Solved: total variation converged in {iterations} iterations"
        status = Status(Verdict.SOLVED, sentence, "", figures)
    return TVSolution(
        image=image,
        lam=weight,
        iterations=iterations,
        change=change,
        residual=float(np.sqrt(misfit / problem.energy)) if problem.energy > 0 else 0.0,
        status=status,
    )
