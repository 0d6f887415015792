"""Tikhonov weight from the data alone, by an unbiased estimate of the risk on the accumulated projections.

In the basis of the factors the fit is diagonal: coefficient W_ij is kept by the share
sigma_ij^2 / (sigma_ij^2 + lambda), and the energy of the frames outside the model's range tells the noise, so
any lambda costs n^2 operations, whatever the number of frames. Why not generalised cross-validation:
docs/decisions/0002-automatic-lambda.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError

RISK_POWER = 0.5
"""Errors are weighted by sigma to this power: 0 is the image's error, 2 that of predicted frames; chosen in
docs/decisions/0002-automatic-lambda.md."""


@dataclass(frozen=True, eq=False)
class DiagonalProblem:
    """The inverse problem in its diagonal basis.

    Attributes
    ----------
    sigma
        (r, r') singular values of the whole model, exact zeros beyond its rank.
    projected
        (r, r') data W projected on the left singular vectors.
    energy
        squared norm of all data.
    data_count
        number of independent data.
    """

    sigma: FloatArray
    projected: FloatArray
    energy: float
    data_count: int

    def residual_energy(self, lam: float) -> float:
        """||Y - model||^2 of the Tikhonov solution at ``lam``; rounding leaves about 1e-16 of ``energy``."""
        outside = max(self.energy - float(np.sum(np.square(self.projected))), 0.0)
        return outside + float(np.sum(np.square((1 - self.kept(lam)) * self.projected)))

    def kept(self, lam: float) -> FloatArray:
        """(r, r') share sigma^2 / (sigma^2 + ``lam``) of each coefficient that is kept; 0 beyond the rank."""
        squared = np.square(self.sigma)
        return np.divide(squared, squared + lam, out=np.zeros_like(squared), where=squared > 0)

    @property
    def scale(self) -> float:
        """Largest sigma^2: lambda relative to it is lambda_rel."""
        return float(np.square(self.sigma.max()))


def risk_score(problem: DiagonalProblem, lam: float, noise: float) -> float:
    """Unbiased estimate of the weighted squared error of the image, up to a constant.

    Parameters
    ----------
    problem
        in its diagonal basis.
    lam
        lambda, in the unit of sigma^2.
    noise
        variance of one datum.

    Notes
    -----
    With kept shares k, coefficient (k W / sigma) has expected squared error (1 - k)^2 x^2 + k^2 noise /
    sigma^2; (W^2 - noise) / sigma^2 estimates x^2 without bias, and what does not depend on lambda is left
    out, so that small sigma do no harm.
    """
    measured = problem.sigma > 0
    sigma, data = problem.sigma[measured], np.square(problem.projected[measured])
    kept = problem.kept(lam)[measured]
    errors = ((kept - 2) * (data - noise) + kept * noise) / (np.square(sigma) + lam)
    return float(np.sum(sigma**RISK_POWER * errors))


def noise_variance(problem: DiagonalProblem) -> float:
    """Mean noise variance of one datum of a ``problem`` [data unit squared], from the energy outside the model's range.

    MitsimError when there are no more data than unknowns.
    """
    spare = problem.data_count - np.count_nonzero(problem.sigma)
    if spare <= 0:
        raise MitsimError("there are no more data than unknowns, so noise cannot be told; give lambda as a number")
    inside = np.square(problem.projected[problem.sigma > 0]).sum()
    return max(problem.energy - float(inside), 0.0) / spare


def automatic_lambda(problem: DiagonalProblem) -> float:
    """Lambda that minimises :func:`risk_score` of a ``problem``: a grid over 16 decades, refined at its best.

    Returns lambda in the unit of sigma^2; 0 when no regularisation at all scores best. MitsimError when there
    are no more data than unknowns (the noise is then unknown) or no signal.
    """
    noise = noise_variance(problem)
    if problem.energy == 0:
        raise MitsimError("all frames are zero: lambda cannot be chosen; check exposure and black level")
    grid = np.arange(np.log10(np.finfo(np.float64).eps), 1.01, 0.25)

    def score(exponent: float) -> float:
        return risk_score(problem, problem.scale * 10.0**exponent, noise)

    best = int(np.argmin([score(exponent) for exponent in grid]))
    if best == 0 and risk_score(problem, 0.0, noise) <= score(grid[0]):
        return 0.0
    lower, upper = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    refined = minimize_scalar(score, bounds=(lower, upper), method="bounded", options={"xatol": 1e-3})
    return float(problem.scale * 10.0 ** float(refined.x))
