"""A reconstruction and the truth in; how far it says to trust its image, and how far that holds, out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.reconstruct.result import Reconstruction

COVERED = 1.96
"""Standard uncertainties on either side of a pixel within which the truth is expected with a chance of 95 %."""


@dataclass(frozen=True, eq=False)
class Trust:
    """What an image states of itself, beside what it is.

    Attributes
    ----------
    uncertainty, error
        (n, n') stated standard uncertainty of each pixel, and actual |image - truth| [reflectance, 1 = the board].
    chi_square
        misfit a datum; None where there are no more data than unknowns.
    cause
        likely cause of a flagged misfit; empty where the frames fit.
    """

    uncertainty: FloatArray
    error: FloatArray
    chi_square: float | None = None
    cause: str = ""

    @classmethod
    def of(cls, image: Reconstruction, truth: FloatArray) -> Trust | None:
        """That of an ``image`` against the (n, n') ``truth``; None where its uncertainty is not known."""
        if image.uncertainty is None:
            return None
        misfit = image.misfit
        cause = misfit.reason if misfit else ""
        chi_square = misfit.chi_square if misfit else None
        return cls(image.uncertainty, np.abs(image.image - truth), chi_square, cause)

    @property
    def stated(self) -> float:
        """Standard uncertainty, rms over the image."""
        return float(np.sqrt(np.mean(np.square(self.uncertainty))))

    @property
    def actual(self) -> float:
        """Error, rms over the image."""
        return float(np.sqrt(np.mean(np.square(self.error))))

    @property
    def within(self) -> float:
        """Part of the pixels whose truth lies in their 95 % interval."""
        return float(np.mean(self.error <= COVERED * self.uncertainty))

    def summary(self) -> dict[str, Any]:
        """What demo.json says of it."""
        return {
            "uncertainty": self.stated,
            "rms_error": self.actual,
            "within_95": self.within,
            "chi_square": self.chi_square,
            "cause": self.cause or None,
        }
