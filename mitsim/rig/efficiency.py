"""Quantum efficiency by wavelength: tables of a camera file in, electrons per photon at one wavelength out."""

from __future__ import annotations

from bisect import bisect_left
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from mitsim.core.errors import MitsimError

Plane = Literal["R", "G", "B"]
"""Colour of a filter over a pixel."""
Mosaic = Literal["RGGB", "BGGR", "GRBG", "GBRG"]
"""Filters of 2 x 2 pixels, row by row from the frame's first pixel (Bayer, US patent 3 971 065)."""
_MOST_POINTS = 1024
"""The visible and near infrared in steps of a nanometre have 800."""


class EfficiencyCurve(BaseModel):
    """Electrons per photon over wavelength, linear between its points and unknown outside them."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    wavelengths_nm: tuple[Annotated[float, Field(ge=1, le=1e6)], ...] = Field(
        strict=False, min_length=2, max_length=_MOST_POINTS, description="wavelengths of its points, rising [nm]"
    )
    """As a projector's."""
    efficiency: tuple[Annotated[float, Field(ge=0, le=1)], ...] = Field(
        strict=False, min_length=2, max_length=_MOST_POINTS, description="electrons per photon at each"
    )

    @model_validator(mode="after")
    def _a_curve(self) -> EfficiencyCurve:
        if len(self.wavelengths_nm) != len(self.efficiency):
            raise ValueError(
                f"got {len(self.wavelengths_nm)} wavelengths_nm and {len(self.efficiency)} of efficiency; "
                "give one efficiency a wavelength"
            )
        for low, high in zip(self.wavelengths_nm, self.wavelengths_nm[1:], strict=False):
            if high <= low:
                raise ValueError(f"wavelengths_nm: got {high:g} after {low:g}; give rising wavelengths")
        if not any(self.efficiency):
            raise ValueError("efficiency: all are 0; give electrons per photon above 0 somewhere")
        return self

    def at(self, wavelength_nm: float) -> float:
        """Electrons per photon of ``wavelength_nm``; MitsimError outside the curve."""
        first, last = self.wavelengths_nm[0], self.wavelengths_nm[-1]
        if not first <= wavelength_nm <= last:
            raise MitsimError(
                f"got {wavelength_nm:g} nm; the curve of quantum efficiency is of {first:g} to {last:g} nm; "
                "use light of these"
            )
        # Without numpy, which would be half the time of a refusal.
        above = max(1, bisect_left(self.wavelengths_nm, wavelength_nm))
        part = (wavelength_nm - self.wavelengths_nm[above - 1]) / (
            self.wavelengths_nm[above] - self.wavelengths_nm[above - 1]
        )
        return self.efficiency[above - 1] * (1 - part) + self.efficiency[above] * part


class MosaicCurves(BaseModel):
    """Curves of the pixels under each colour of a filter array, filters included."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    R: EfficiencyCurve = Field(description="of pixels under red filters")
    G: EfficiencyCurve = Field(description="of pixels under green filters")
    B: EfficiencyCurve = Field(description="of pixels under blue filters")
