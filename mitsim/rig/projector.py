"""A projector's light: a TOML file in, a checked and frozen model with the spectrum of its photons out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Wavelengths and the share of the photons at each.

    Attributes
    ----------
    wavelengths_nm
        (w,) wavelengths [nm], above 0; read-only.
    weights
        (w,) shares, not negative, that sum to 1; read-only.
    """

    wavelengths_nm: FloatArray
    weights: FloatArray

    def __post_init__(self) -> None:
        wavelengths, weights = (np.array(v, dtype=np.float64) for v in (self.wavelengths_nm, self.weights))
        if wavelengths.ndim != 1 or wavelengths.size == 0 or wavelengths.shape != weights.shape:
            raise MitsimError(
                f"spectrum of {wavelengths.shape} wavelengths and {weights.shape} weights; give one weight a wavelength"
            )
        if not (np.isfinite(wavelengths).all() and (wavelengths > 0).all()):
            raise MitsimError(f"spectrum has a wavelength of {wavelengths.min()} nm; give finite numbers above 0")
        if not ((weights >= 0).all() and abs(weights.sum() - 1) < 1e-6):
            raise MitsimError(
                f"spectrum weights are at least {weights.min()} and sum to {weights.sum()}; "
                "give shares of 0 or more that sum to 1"
            )
        for name, array in (("wavelengths_nm", wavelengths), ("weights", weights)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)


class ProjectorModel(BaseModel):
    """What mitsim uses of a projector file; the rest of the file documents its sources."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    name: str = Field(description="what the projector is called in reports")
    effective_wavelength_nm: float = Field(
        gt=0, allow_inf_nan=False, description="one wavelength that carries as many photons per watt [nm]"
    )
    wavelengths_nm: tuple[float, ...] = Field((), description="spectral lines [nm]; none: the effective wavelength")
    radiant_shares: tuple[float, ...] = Field((), description="part of the power in each line")
    contrast_ratio: float = Field(math.inf, gt=1, description="light of a white pixel over that of a black one")
    aperture_radius_mm: float = Field(0.0, ge=0, allow_inf_nan=False, description="radius of the lens [mm]; 0: pinhole")
    focus_mm: float | None = Field(None, gt=0, description="distance of the sharp plane [mm]; none: scene_distance")
    speckle_contrast: float = Field(0.0, ge=0, le=1, description="of one sensor pixel's light; see docs/physics.md")
    blur_pixels: float = Field(0.0, ge=0, allow_inf_nan=False, description="spot's standard deviation [pixels]")

    @model_validator(mode="after")
    def _lines_have_shares(self) -> ProjectorModel:
        if len(self.wavelengths_nm) != len(self.radiant_shares):
            raise ValueError(
                f"{len(self.wavelengths_nm)} wavelengths_nm and {len(self.radiant_shares)} radiant_shares; "
                "give one share a line"
            )
        return self

    @property
    def black_level(self) -> float:
        """Light of a black pixel, as a part of a white one's."""
        return 1 / self.contrast_ratio

    @property
    def spectrum(self) -> Spectrum:
        """Photons at each line: power times wavelength."""
        wavelengths = np.array(self.wavelengths_nm or (self.effective_wavelength_nm,))
        photons = np.array(self.radiant_shares or (1.0,)) * wavelengths
        return Spectrum(wavelengths, photons / photons.sum())
