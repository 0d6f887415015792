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

_BALANCE = 3.0
AUTO_WEIGHT = 0.12
"""Automatic weight in units of the noise that the data term's gradient carries to one scene pixel."""


@dataclass(frozen=True, eq=False)
class TVSolution:
    """Image (n, n') of :func:`solve_tv`, the weight used, iterations spent, the last relative change, and a
    sentence on convergence with one on rank and condition.
    """

    image: FloatArray
    weight: float
    iterations: int
    change: float
    residual: float
    ok: bool
    status: str


def automatic_weight(spectrum: DiagonalProblem) -> float:
    """Weight from the noise estimate: noise standard deviation times the root mean square of sigma, times a
    constant.

    Where the truth is flat the weight must beat the data term's gradient, which is noise of that standard
    deviation.
    """
    return AUTO_WEIGHT * float(np.sqrt(noise_variance(spectrum) * np.mean(np.square(spectrum.sigma))))


def solve_tv(
    prepared: Prepared,
    frames: Accumulator,
    weight: float | str = "auto",
    iterations: int = 100,
    tolerance: float = 1e-4,
) -> TVSolution:
    """Total-variation solution of the added frames.

    ``weight`` >= 0 is in the unit of data^2 / image (``"auto"``: :func:`automatic_weight`); it stops when
    the image changes by less than ``tolerance``, relative, or after ``iterations``. MitsimError for missing
    frames or another weight.
    """
    spectrum = prepared.spectrum(frames)
    if weight == "auto":
        weight = automatic_weight(spectrum)
    if isinstance(weight, str) or not (np.isfinite(weight) and weight >= 0):
        raise MitsimError(f"TV weight is {weight!r}; give a finite number of at least 0, or auto")
    if iterations < 1:
        raise MitsimError(f"TV iterations are {iterations}; give at least 1")
    squared = np.square(spectrum.sigma)
    rho = _penalty(spectrum)
    data = spectrum.sigma * spectrum.projected
    smooth = prepared.image(data / (squared + rho))
    dual = np.zeros_like(smooth)
    change, spent = float("inf"), 0
    while spent < iterations and change >= tolerance:
        spent += 1
        target = prepared.coefficients(smooth - dual)
        # Directions outside the basis (under-determined sides) are not measured: they keep the target.
        kept = smooth - dual - prepared.image(target)
        updated = prepared.image((data + rho * target) / (squared + rho)) + kept
        before = smooth
        # skimage minimises |u - f|^2 / (2 weight) + TV(u).
        if weight:
            smooth = denoise_tv_chambolle(updated + dual, weight=weight / rho, eps=1e-6, max_num_iter=60)
        else:
            smooth = updated + dual
        dual = dual + updated - smooth
        # Primal and dual residual (Boyd et al., section 3.3): one alone can be small far from the minimum.
        primal, moved = float(np.linalg.norm(updated - smooth)), float(np.linalg.norm(smooth - before))
        change = max(primal, moved) / max(float(np.linalg.norm(smooth)), 1e-300)
        # Residual balancing (section 3.4.1): the penalty sets the speed only, and costs nothing to change here.
        factor = 2.0 if primal > _BALANCE * moved else 0.5 if moved > _BALANCE * primal else 1.0
        rho, dual = rho * factor, dual / factor
    return _solution(prepared, spectrum, smooth, float(weight), spent, change, change < tolerance)


def _penalty(spectrum: DiagonalProblem) -> float:
    """ADMM penalty, which sets the speed only: the Tikhonov lambda balances both of its steps."""
    measured = np.square(spectrum.sigma[spectrum.sigma > 0])
    if spectrum.data_count > measured.size:
        lam = automatic_lambda(spectrum)
        if lam > spectrum.scale * np.finfo(np.float64).eps:
            return lam
    return float(np.exp(np.mean(np.log(measured))))


def _solution(
    prepared: Prepared,
    spectrum: DiagonalProblem,
    image: FloatArray,
    weight: float,
    iterations: int,
    change: float,
    converged: bool,
) -> TVSolution:
    modelled = spectrum.sigma * prepared.coefficients(image)
    outside = max(spectrum.energy - float(np.sum(np.square(spectrum.projected))), 0.0)
    misfit = outside + float(np.sum(np.square(spectrum.projected - modelled)))
    status = f"Solved: total variation converged in {iterations} iterations."
    lost = prepared.unknowns - prepared.rank
    if lost:
        status = (
            f"Solved in {iterations} iterations, but {lost} of {prepared.unknowns} directions are not measured and "
            "follow from total variation alone; use more patterns."
        )
    if not converged:
        status = (
            f"Not converged: after {iterations} iterations the image still changes by {change:.1e} a step; "
            "allow more iterations or a larger tolerance."
        )
    return TVSolution(
        image=image,
        weight=weight,
        iterations=iterations,
        change=change,
        residual=float(np.sqrt(misfit / spectrum.energy)) if spectrum.energy > 0 else 0.0,
        ok=converged,
        status=f"{status} {prepared.extent}.",
    )
