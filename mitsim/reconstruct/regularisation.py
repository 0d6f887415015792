"""Tikhonov weight from the data alone: the accumulated projections in, lambda out.

In the basis of the factors the fit is diagonal: coefficient W_ij is kept by the share
sigma_ij^2 / (sigma_ij^2 + lambda), so any lambda costs n^2 operations, whatever the number of frames. Where the model
explains the frames, lambda minimises an unbiased estimate of the image's error; where it does not, the image must also
stand still when lambda changes. What was tried instead: docs/decisions/0004-lambda-by-halves.md.

*Noise by halves of the sensor.* Where Y = U S X' + noise, with X' the image in the diagonal basis, the half W_0 = U_0^T
Y of the sum over the sensor's rows is G W up to noise, G = U_0^T U_0: in W_0 - G W there is no image, and nothing else
that both halves agree on. White noise gives its number i the variance G (I - G)_ii times its own, since G and I - G
commute. An error E of the left factor that is independent from sensor row to row, as a calibration's noise is, shows
too: U^T E X S' strikes all numbers of a column of W alike, by that column's light. Halves of the columns tell the same
of the right factor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.reconstruct.factorisation import Side

RISK_POWER = 0.5
"""Errors are weighted by sigma to this power: 0 is the image's error, 2 that of predicted frames; chosen in
docs/decisions/0002-automatic-lambda.md."""
MISFIT_RATIO = 1.2
"""Noise outside the model's range over the noise within, above which the model does not explain the frames: 0.92 to
1.02 in the captures of flat prints that benchmarks/lambda_losses.py makes, 1.4 and more with depth and gloss."""
_TAKEN, _TAKEN_RISE = 30.0, 4
"""What lambda may take away within the range where the model does not explain the frames, over the noise outside, and
the power of noise outside over noise within that this rises with: misfit that hardly shows outside is not most of what
is within. 15 to 60 and 4 lose alike, 3 and less too little of heavy misfit
(docs/decisions/0004-lambda-by-halves.md)."""
_EXPONENTS = np.arange(np.log10(np.finfo(np.float64).eps), 1.01, 0.25)
"""Powers of ten of the lambdas that are tried, over the largest sigma^2."""
_FELT = 100.0
"""Square of a singular value, over lambda, above which lambda changes its coefficient by less than one per cent."""
_FAINT, _FEWEST = 2.0, 20
"""An octave's energy over its noise below which its signal may be noise that was not told, and numbers that tell it:
twenty vary by a third."""


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
    halves
        ``projected`` by quarters of the sensor, which tell its noise; None: the noise is taken for white.
    struck
        (r, r') what ``projected`` is known to have beside the image and noise, up to its sign.
    least
        smallest automatic lambda: :attr:`mitsim.reconstruct.solver.Prepared.least_lambda`.
    """

    sigma: FloatArray
    projected: FloatArray
    energy: float
    data_count: int
    halves: Halves | None = None
    struck: FloatArray | float = 0.0
    least: float = 0.0

    def residual_energy(self, lam: float) -> float:
        """||Y - model||^2 of the Tikhonov solution at ``lam``; rounding leaves about 1e-16 of ``energy``."""
        outside = max(self.energy - float(np.sum(np.square(self.projected))), 0.0)
        return outside + self.taken_energy(lam)

    def taken_energy(self, lam: float) -> float:
        """Energy within the model's range that the Tikhonov solution at ``lam`` leaves out."""
        return float(np.sum(np.square((1 - self.kept_share(lam)) * self.projected)))

    def image_energy(self, lam: float) -> float:
        """||X||^2 of the Tikhonov image X at ``lam``."""
        kept = self.kept_share(lam)
        return float(np.sum(np.square((kept * self.projected)[kept > 0] / self.sigma[kept > 0])))

    def kept_share(self, lam: float) -> FloatArray:
        """(r, r') share sigma^2 / (sigma^2 + ``lam``) of each coefficient that is kept; 0 beyond the rank."""
        squared = np.square(self.sigma)
        return np.divide(squared, squared + lam, out=np.zeros_like(squared), where=squared > 0)

    @property
    def scale(self) -> float:
        """Largest sigma^2: lambda relative to it is lambda_rel."""
        return float(np.square(self.sigma.max()))


def risk_score(problem: DiagonalProblem, lam: float, noise: float | FloatArray) -> float:
    """Unbiased estimate of the weighted squared error of the image, up to a constant.

    Parameters
    ----------
    problem
        in its diagonal basis.
    lam
        lambda, in the unit of sigma^2.
    noise
        variance of one datum, or (r, r') of each number of ``projected``.

    Notes
    -----
    With kept shares k, coefficient (k W / sigma) has expected squared error (1 - k)^2 x^2 + k^2 noise /
    sigma^2; (W^2 - noise) / sigma^2 estimates x^2 without bias, and what does not depend on lambda is left
    out, so that small sigma do no harm.
    """
    measured = problem.sigma > 0
    sigma, data = problem.sigma[measured], np.square(problem.projected[measured])
    variance = np.broadcast_to(noise, problem.sigma.shape)[measured]
    kept = problem.kept_share(lam)[measured]
    errors = ((kept - 2) * (data - variance) + kept * variance) / (np.square(sigma) + lam)
    return float(np.sum(sigma**RISK_POWER * errors))


def movement(problem: DiagonalProblem, lam: float) -> float:
    """||lambda dX / dlambda||^2 of the Tikhonov image X of a ``problem`` at ``lam``.

    Small where neither coefficients that lambda cuts off nor noise that it lets through weigh much: the
    quasi-optimality criterion of Tikhonov and Glasko (1965), which takes no number for the noise and so holds for
    errors of any spectrum.
    """
    kept = problem.kept_share(lam)
    measured = kept > 0
    return float(np.sum(np.square((kept * (1 - kept) * problem.projected)[measured] / problem.sigma[measured])))


def noise_variance(problem: DiagonalProblem) -> float:
    """Mean noise variance of one datum of a ``problem`` [data unit squared], from the energy outside the model's range.

    MitsimError when there are no more data than unknowns.
    """
    spare = problem.data_count - np.count_nonzero(problem.sigma)
    if spare <= 0:
        raise MitsimError("there are no more data than unknowns, so noise cannot be told; give lambda as a number")
    inside = np.square(problem.projected[problem.sigma > 0]).sum()
    return max(problem.energy - float(inside), 0.0) / spare


def is_misfit(problem: DiagonalProblem) -> bool:
    """Whether a ``problem`` has more energy outside the model's range than the noise within it explains.

    Noise strikes both alike; what the model does not explain strikes few numbers within, which do not move the median
    of the halves' differences, and all beyond.
    """
    if not problem.halves:
        return False
    chance = 3 * MEDIAN_SPREAD / float(np.sqrt(2 * np.count_nonzero(problem.sigma)))
    return noise_variance(problem) > (MISFIT_RATIO + chance) * problem.halves.typical


def coefficient_noise(problem: DiagonalProblem) -> float | FloatArray:
    """Noise variance of each number (r, r') of ``problem.projected``, or of all.

    Most have the noise that is outside the model's range, where there are more data to tell it, or what the halves of
    the sensor disagree on where that is more: noise of the factors lies within the range alone. Where the model does
    not explain the frames, the halves know. What strikes single rows and columns comes on top, and what is known to
    strike single numbers.
    """
    white, halves = noise_variance(problem), problem.halves
    if not halves:
        return white + np.square(problem.struck)
    level = halves.typical if is_misfit(problem) else float(np.fmax(white, halves.typical))
    return _believable(problem, level + halves.excess + np.square(problem.struck))


def _believable(problem: DiagonalProblem, noise: FloatArray) -> FloatArray:
    """``noise`` (r, r') of a ``problem``, raised by the part of it that both halves of the sensor agree on.

    By octaves of sigma: what little exceeds the noise stands, at small sigma, for a scene of any brightness. Where that
    is brighter than the mean of all octaves before, there is noise alone, there and in all octaves beyond; unless one
    of these is clearly seen, as the brightness is behind a mask whose constant term is centred away.
    """
    measured = problem.sigma > 0
    sigma, found = problem.sigma[measured], noise[measured]
    octave = np.log2(sigma.max() / sigma).astype(np.intp)
    sizes = np.bincount(octave)
    data, level, square = (
        np.bincount(octave, values) / np.maximum(sizes, 1)
        for values in (np.square(problem.projected[measured]), found, np.square(sigma))
    )
    power = np.divide(np.maximum(data - level, 0.0), square, out=np.zeros_like(square), where=square > 0)
    before = np.cumsum(sizes * power) / np.cumsum(sizes)
    faint = (data < _FAINT * level) & (sizes >= _FEWEST)
    clear = np.flatnonzero((data >= _FAINT * level) & (sizes >= _FEWEST))
    doubtful = faint[1:] & (power[1:] > before[:-1])
    doubtful[: clear.max(initial=0)] = False
    if not doubtful.any():
        return noise
    beyond = octave > int(np.argmax(doubtful))
    raised = noise.copy()
    raised[measured] = np.where(beyond, found * np.maximum(data[octave] / level[octave], 1.0), found)
    return raised


def automatic_lambda(problem: DiagonalProblem, explained: bool = True) -> float:
    """Return the lambda that minimises :func:`risk_score` of a ``problem``, with the noise that halves of the sensor
    show, but at least ``problem.least``.

    Where the model does not explain the frames, as the frames show or as is known before (``explained`` is False), that
    lambda is a lower bound: both halves then agree on an error that follows no law, so the image that
    :func:`movement` finds steadiest is taken, as far as misfit explains what its lambda takes away.

    Returns lambda in the unit of sigma^2; 0 when no regularisation at all scores best. MitsimError when there
    are no more data than unknowns (the noise is then unknown) or no signal.
    """
    noise = coefficient_noise(problem)
    if problem.energy == 0:
        raise MitsimError("all frames are zero: lambda cannot be chosen; check exposure and black level")
    lam = _least(lambda lam: risk_score(problem, lam, noise), problem.scale, _EXPONENTS)
    if is_misfit(problem) or not explained:
        # Beyond the largest sigma^2 all goes to black, and at lambda 0 nothing moves, however large its noise.
        candidates = problem.scale * 10.0 ** _EXPONENTS[_EXPONENTS <= 0]
        lam = _steadiest(problem, [max(lam, candidates[0]), *candidates[candidates > max(lam, candidates[0])].tolist()])
    return max(lam, problem.least)


def end_of_range(problem: DiagonalProblem, lam: float) -> tuple[str, ...]:
    """Return a sentence for a status if the automatic lambda ``lam`` of a ``problem`` is an end of its search range and
    the image depends on where that end is; otherwise nothing."""
    lowest, highest = problem.scale * 10.0 ** np.array([_EXPONENTS[0], 0.0])
    if lam >= highest:
        return ("Automatic lambda is the largest that is tried: the frames show hardly more than noise.",)
    if lam <= lowest and np.square(problem.sigma[problem.sigma > 0]).min() < _FELT * lowest:
        return (
            "Automatic lambda is the smallest that is tried, so that weakly measured directions of the image may be "
            "noise; compare with a larger lambda.",
        )
    return ()


def _steadiest(problem: DiagonalProblem, lambdas: list[float]) -> float:
    """That of rising ``lambdas`` at which the image of a ``problem`` moves least, of those that misfit explains.

    Where the brightness has the largest sigma, as behind a mask that passes light, it holds the image up to there.
    Where a mask's constant term is centred away, all goes to black before, and moves less and less: movement then
    counts by what is left of the image. What lambda takes away is bounded by the misfit that is seen outside of the
    range, as a dark print without its stars is as steady as one of which nothing is lost; below that bound, a movement
    that still falls tells of no image either.
    """
    moved = np.array([movement(problem, lam) for lam in lambdas])
    if len(moved) > 1 and moved[-1] < moved[-2]:
        moved /= [problem.image_energy(lam) for lam in lambdas]
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


def _least(score: Callable[[float], float], scale: float, exponents: FloatArray) -> float:
    """Lambda of the least ``score``: of ``scale`` times ten to the ``exponents``, refined at the best, or 0."""
    best = int(np.argmin([score(scale * 10.0**exponent) for exponent in exponents]))
    if best == 0 and score(0.0) <= score(scale * 10.0 ** exponents[0]):
        return 0.0
    lower, upper = exponents[max(best - 1, 0)], exponents[min(best + 1, len(exponents) - 1)]
    refined = minimize_scalar(
        lambda exponent: score(scale * 10.0**exponent), bounds=(lower, upper), method="bounded", options={"xatol": 1e-3}
    )
    return float(scale * 10.0 ** float(refined.x))


# -------- W by quarters of the sensor in

_LEAST_SPREAD = 0.01
"""Least G (I - G)_ii that a half is told from the whole by: 1/4 where both halves see as much, 0 where a side has no
more rows than unknowns."""
_MEDIAN = 0.4549
"""Median of the square of a standard normal number."""
MEDIAN_SPREAD = 2.33
"""Relative standard deviation of the median of n such squares, times the square root of n."""
_SIGNIFICANT = 2.0
"""Standard deviations above which a row or column is noisier than others: of chance excess, one in forty is left."""


@dataclass(frozen=True, eq=False)
class Halves:
    """Quarters (2, 2, r, r') of W in the diagonal basis, and the sides whose halves they are sums over."""

    quarters: FloatArray
    left: Side
    right: Side

    @cached_property
    def differences(self) -> tuple[FloatArray, FloatArray]:
        """(r, r') W_0 - G W of the halves of rows, and of the halves of columns."""
        total = self.quarters.sum(axis=(0, 1))
        by_row = self.quarters[0].sum(axis=0) - self.left.first_half @ total
        by_column = self.quarters[:, 0].sum(axis=0) - total @ self.right.first_half
        return by_row, by_column

    @cached_property
    def _squares(self) -> tuple[FloatArray, FloatArray]:
        """The squares of :attr:`differences` in units of a number's variance; NaN where halves cannot be told apart."""
        spreads = (half_spread(side.first_half) for side in (self.left, self.right))
        rows, columns = (np.where(spread >= _LEAST_SPREAD, spread, np.nan) for spread in spreads)
        by_row, by_column = self.differences
        return np.square(by_row) / rows[:, None], np.square(by_column) / columns

    @cached_property
    def typical(self) -> float:
        """Noise variance of most numbers, by the median; NaN when unknown."""
        return float(_medians(np.concatenate([square[self._measured] for square in self._squares])[None])[0])

    @cached_property
    def excess(self) -> FloatArray:
        """(r, r') noise variance of each number above that of most: what is significant in its row and its column."""
        row, column = (np.where(self._measured, square, np.nan) for square in self._squares)
        return _excess(row.T) + _excess(column)[:, None]

    @property
    def _measured(self) -> npt.NDArray[np.bool_]:
        return np.asarray(np.outer(self.left.singular, self.right.singular) > 0)


def half_spread(half: FloatArray) -> FloatArray:
    """(r,) variance of W_0 - G W for white noise of variance 1, G being ``half``: the diagonal of G (I - G)."""
    return np.asarray(np.diag(half) - np.einsum("ij,ji->i", half, half))


def _medians(squares: FloatArray) -> FloatArray:
    """Variance of each row of normal numbers by the median of their ``squares``, which a few that are no noise do not
    move; NaN where none is known."""
    ordered, count = np.sort(squares, axis=1), np.count_nonzero(~np.isnan(squares), axis=1)  # NaN come last
    middle = [
        np.take_along_axis(ordered, place[:, None], axis=1) for place in (np.maximum(count - 1, 0) // 2, count // 2)
    ]
    return np.asarray((middle[0] + middle[1])[:, 0] / (2 * _MEDIAN))


def _excess(squares: FloatArray) -> FloatArray:
    """(rows,) variance of each row of ``squares`` above that of the middle row, beyond what chance explains."""
    level = _medians(squares)
    count = np.maximum((~np.isnan(squares)).sum(axis=1), 1)
    middle = np.nanmedian(level) if not np.isnan(level).all() else np.nan
    significant = level > middle * (1 + _SIGNIFICANT * MEDIAN_SPREAD / np.sqrt(count))
    return np.where(significant, level - middle, 0.0)
