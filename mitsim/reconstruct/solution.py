"""Solution of an image: its statistics, and a status with the reason and the remedy."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from mitsim.core.arrays import FloatArray


class Verdict(Enum):
    """Result of a solver or a calibration; the value is its name in files."""

    SOLVED = "solved"
    """Every direction of the image is measured."""
    PARTLY_MEASURED = "partly measured"
    """Some directions of the image follow from regularisation alone."""
    UNDER_DETERMINED = "under-determined"
    """There are fewer sensor rows or columns than scene rows or columns."""
    RANK_DEFICIENT = "rank deficient"
    """Some directions are not measured, and nothing fills them."""
    ILL_CONDITIONED = "ill-conditioned"
    """Rounding may change the visible image."""
    MISFIT = "misfit"
    """The measurements contain more than any image explains."""
    NOT_CONVERGED = "not converged"
    """The iterations ended before the image was constant."""
    CALIBRATED = "calibrated"
    """Factors explain the responses."""
    NOT_SEPARABLE = "not separable"
    """The responses contain more than any factors explain."""
    MOSTLY_NOISE = "mostly noise"
    """Factors have a large error."""
    UNKNOWN = "unknown"
    """Factors of another program, of unknown quality."""

    @property
    def good(self) -> bool:
        return self in (Verdict.SOLVED, Verdict.PARTLY_MEASURED, Verdict.CALIBRATED, Verdict.UNKNOWN)


@dataclass(frozen=True)
class Status:
    """Verdict on a result, with the reason and the remedy; ``str`` gives all of it in sentences."""

    verdict: Verdict
    sentence: str
    remedy: str = ""
    figures: str = ""
    flags: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether the verdict is good and nothing was flagged before."""
        return self.verdict.good and not self.flags

    def __str__(self) -> str:
        remedy = f"; {self.remedy}" if self.remedy else ""
        return " ".join(part for part in (f"{self.sentence}{remedy}.", self.figures, *self.flags) if part)


@dataclass(frozen=True, eq=False)
class Solution:
    """Image with the statistics and the status of its solver.

    Attributes
    ----------
    image : (n, n') array
        Estimate of X, neither clipped nor normalised.
    lam
        Lambda in the unit of the model squared; for total variation its weight [data^2 / image].
    residual
        ||Y - model|| / ||Y|| over all frames, above a rounding of about 1e-8; of conjugate gradients the residual of
        the normal equations, relative to their right-hand side.
    rounding
        Bound of ||error|| / ||image|| by rounding; None if the solver has no bound.
    iterations
        0 in closed form.
    objective, relative_gap
        Minimised function, and an upper bound of its excess over the minimum, relative to the part that images change;
        None in closed form.
    """

    image: FloatArray
    lam: float
    residual: float
    status: Status
    rounding: float | None = None
    iterations: int = 0
    objective: float | None = None
    relative_gap: float | None = None

    @property
    def ok(self) -> bool:
        """Whether the image can be used without a correction."""
        return self.status.ok
