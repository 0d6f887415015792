"""Tikhonov weight from the data alone, by generalised cross-validation on the accumulated projections.

In the basis of the factors the fit is diagonal: coefficient W_ij is kept by the share
sigma_ij^2 / (sigma_ij^2 + lambda), so residual and degrees of freedom cost n^2 operations for any lambda,
whatever the number of frames (Golub, Heath and Wahba, Technometrics 21 (1979), eq. 1.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar

from mitsim.core.errors import MitsimError

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Spectrum:
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
        """||Y - model||^2 of the Tikhonov solution; rounding leaves about 1e-16 of ``energy``."""
        outside = max(self.energy - float(np.sum(np.square(self.projected))), 0.0)
        return outside + float(np.sum(np.square((1 - self.kept(lam)) * self.projected)))

    def kept(self, lam: float) -> FloatArray:
        """Share sigma^2 / (sigma^2 + lambda) of each coefficient that is kept; 0 beyond the rank."""
        squared = np.square(self.sigma)
        return np.divide(squared, squared + lam, out=np.zeros_like(squared), where=squared > 0)

    @property
    def scale(self) -> float:
        """Largest sigma^2: lambda relative to it is lambda_rel."""
        return float(np.square(self.sigma.max()))


def gcv_score(spectrum: Spectrum, lam: float) -> float:
    """N ||residual||^2 / (N - trace)^2: the estimated mean squared error of predicting one left-out datum."""
    free = spectrum.data_count - float(spectrum.kept(lam).sum())
    return spectrum.data_count * spectrum.residual_energy(lam) / free**2


def noise_variance(spectrum: Spectrum) -> float:
    """Mean noise variance of one datum [data unit squared], from the energy outside the model's range."""
    spare = spectrum.data_count - np.count_nonzero(spectrum.sigma)
    if spare <= 0:
        raise MitsimError(
            "there are no more data than unknowns, so noise cannot be told; give lambda as a number"
        )
    inside = np.square(spectrum.projected[spectrum.sigma > 0]).sum()
    return max(spectrum.energy - float(inside), 0.0) / spare


def automatic_lambda(spectrum: Spectrum) -> float:
    """Lambda that minimises :func:`gcv_score`: a grid over 16 decades, refined between its best neighbours.

    Returns lambda in the unit of sigma^2; 0 when no regularisation at all scores best. MitsimError when
    there are no more data than unknowns (the score then has no minimum) or no signal.
    """
    noise_variance(spectrum)
    if spectrum.energy == 0:
        raise MitsimError("all frames are zero: lambda cannot be chosen; check exposure and black level")
    floor = np.finfo(np.float64).eps
    grid = np.arange(np.log10(floor), 1.01, 0.25)

    def score(exponent: float) -> float:
        return gcv_score(spectrum, spectrum.scale * 10.0**exponent)

    best = int(np.argmin([score(exponent) for exponent in grid]))
    if best == 0 and gcv_score(spectrum, 0.0) <= score(grid[0]):
        return 0.0
    lower, upper = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    refined = minimize_scalar(score, bounds=(lower, upper), method="bounded", options={"xatol": 1e-3})
    return float(spectrum.scale * 10.0 ** float(refined.x))
