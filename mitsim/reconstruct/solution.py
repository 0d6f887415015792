"""What a solver found: an image, its statistics, and a status, which is a verdict with its sentence and remedy."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from mitsim.core.arrays import FloatArray


class Verdict(Enum):
    """What a solver or a calibration found; the value is its name in files."""

    SOLVED = "solved"
    """Every direction of the image is measured."""
    PARTLY_MEASURED = "partly measured"
    """Some directions of the image follow from regularisation alone."""
    UNDER_DETERMINED = "under-determined"
    """There are fewer sensor rows or columns than scene rows or columns."""
    RANK_DEFICIENT = "rank deficient"
    """Some directions are not measured, and nothing fills them."""
    ILL_CONDITIONED = "ill-conditioned"
    """Rounding may change what is seen."""
    MISFIT = "misfit"
    """Measurements hold more than any image explains."""
    NOT_CONVERGED = "not converged"
    """The iterations ended before the image stood still."""
    CALIBRATED = "calibrated"
    """Factors explain the responses."""
    NOT_SEPARABLE = "not separable"
    """Responses hold more than any factors explain."""
    MOSTLY_NOISE = "mostly noise"
    """Factors have a large error."""
    UNKNOWN = "unknown"
    """Factors from elsewhere, without a word on how good they are."""

    @property
    def good(self) -> bool:
        """Whether the result can be used as it is."""
        return self in (Verdict.SOLVED, Verdict.PARTLY_MEASURED, Verdict.CALIBRATED, Verdict.UNKNOWN)


@dataclass(frozen=True)
class Status:
    """Whether a result can be trusted; as text, all of it in one or more sentences.

    Attributes
    ----------
    verdict
        what was found.
    sentence
        the same in words, with its figures, without a full stop.
    remedy
        what to do; empty where nothing is to be done.
    figures
        rank, condition, rounding: a sentence.
    flags
        sentences on what the result inherits from flagged captures and calibrations.
    """

    verdict: Verdict
    sentence: str
    remedy: str = ""
    figures: str = ""
    flags: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether the result can be used as it is: a good verdict, and nothing flagged before."""
        return self.verdict.good and not self.flags

    def __str__(self) -> str:
        remedy = f"; {self.remedy}" if self.remedy else ""
        return " ".join(part for part in (f"{self.sentence}{remedy}.", self.figures, *self.flags) if part)


@dataclass(frozen=True, eq=False)
class Solution:
    """An image, and what its solver says of it.

    Attributes
    ----------
    image
        (n, n') estimate of X, neither clipped nor normalised.
    lam
        lambda that was used, in the unit of the model squared; for total variation its weight [data^2 / image].
    residual
        ||Y - model|| / ||Y|| over all frames, where rounding hides what is below about 1e-8; of a convolutional camera
        that of the normal equations, relative to their right-hand side.
    status
        not ok when the image lacks something that no lambda explains, rounding may have changed too much of it, or
        iterations did not converge; with rank and condition, where they are known.
    rounding
        what rounding may have changed, ||error|| / ||image||; None where the solver does not bound it.
    iterations
        that were spent; 0 in closed form.
    objective, relative_gap
        what was minimised, and an upper bound of how far it is above its minimum, relative to the part of it that
        images change; None in closed form.
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
        """Whether the image can be used as it is."""
        return self.status.ok
