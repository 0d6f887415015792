"""What a result is worth: a verdict with its sentence and remedy."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


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
