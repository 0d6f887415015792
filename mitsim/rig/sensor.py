"""The numbers that describe an image sensor: a TOML file in, a checked and frozen model out."""

import math
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from mitsim.core.configuration import load_model

EXPOSURE_S = 1e-12, 1e6
"""Shortest and longest exposure [s]: gated avalanche diodes open for 1e-10 s; cooled CCDs collect for some 1e4 s."""
EXPOSURE_FRACTION = 1e-6, 1.0
"""Mean of the brightest pixel as a part of the full well; a millionth is less than an electron of most wells."""
ExposureFraction = Annotated[
    float, Field(strict=True, ge=EXPOSURE_FRACTION[0], le=EXPOSURE_FRACTION[1], allow_inf_nan=False)
]
_LARGEST_CODE = 2**32 - 1
"""What a frame's uint32 holds."""


class SensorModel(BaseModel):
    """A linear camera after EMVA 1288: per-pixel electronics and how pixels are binned.

    The fields describe one **pixel**; a frame's element is a **superpixel** of `binning` x `binning` = b^2
    pixels whose values are summed. The `superpixel_` properties follow: area, full well and dark current
    times b^2, gain unchanged, read noise times b (b^2 independent readings), black level and largest code
    times b^2 (the sum of b^2 codes needs more bits than one). The sum is rounded once where a camera rounds
    each pixel, which leaves out (b^2 - 1)/12 DN^2 of variance.

    Ranges hold every device known, with room: what lies outside is a slip of the unit or of the keyboard.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, defer_build=True)

    name: str = Field(description="what the sensor is called in reports")
    pixel_pitch_um: float = Field(ge=1e-3, le=1e4, description="distance between centres of the square pixels, um")
    """Pixels of telephones have 0.5 um, those of X-ray panels some 100 um."""
    binning: int = Field(default=1, ge=1, le=64, description="pixels summed along each side of a superpixel")
    """Cameras bin up to 16 x 16."""
    full_well_e: float = Field(ge=0.1, allow_inf_nan=True, description="electrons a pixel holds; inf = no limit")
    """An avalanche diode counts one; read-outs of infrared arrays integrate 1e8, so 1e12 is the most, or inf."""
    read_noise_e: float = Field(ge=0, le=1e6, description="standard deviation of one pixel's reading, electrons")
    """0.2 in the quietest cameras, some 1e4 in photodiode arrays."""
    dark_current_e_per_s: float = Field(default=0.0, ge=0, le=1e10, description="electrons a second and pixel")
    """Warm infrared arrays have 1e8."""
    quantum_efficiency: float = Field(ge=1e-6, le=1, description="electrons per photon, at source's wavelength")
    """One electron a photon at most; photocathodes and silicon at their red end fall to 1e-4."""
    gain_dn_per_e: float = Field(ge=1e-12, le=1e6, description="digital numbers per electron")
    """1e-12 spreads the largest full well over one number; electron multiplication brings some 1e3."""
    black_level_dn: float = Field(default=0.0, ge=0, lt=2**24, description="digital number of a pixel without charge")
    """Below the largest ADC's last number."""
    bits: int | None = Field(default=None, ge=1, le=24, description="bits of the ADC; None = real output")
    """Cameras have up to 16, laboratory converters 24."""
    source: str = Field(description="where the numbers come from")

    @field_validator("full_well_e")
    @classmethod
    def _a_known_well_or_none(cls, electrons: float) -> float:
        if 1e12 < electrons < math.inf:
            raise ValueError(f"got {electrons:g}; a full well is 0.1 to 1e+12 electrons, or inf for none")
        return electrons

    @model_validator(mode="after")
    def _room_above_black(self) -> "SensorModel":
        if self.bits is not None and self.black_level_dn >= 2**self.bits - 1:
            raise ValueError(f"black_level_dn {self.black_level_dn} leaves no room below 2^{self.bits} - 1")
        return self

    @model_validator(mode="after")
    def _fits_a_frame(self) -> "SensorModel":
        if self.largest_dn is not None and self.largest_dn > _LARGEST_CODE:
            raise ValueError(
                f"bits {self.bits} with binning {self.binning} has codes up to {self.largest_dn}; "
                f"frames hold at most {_LARGEST_CODE}, so bin less or take fewer bits"
            )
        return self

    @property
    def superpixel_pitch_um(self) -> float:
        """Distance between superpixel centres, um."""
        return self.pixel_pitch_um * self.binning

    @property
    def superpixel_area_m2(self) -> float:
        """Light-collecting area, m^2 (the fill factor is part of the quantum efficiency)."""
        return (self.superpixel_pitch_um * 1e-6) ** 2

    @property
    def superpixel_full_well_e(self) -> float:
        """Electrons a superpixel holds: b^2 full wells."""
        return self.full_well_e * self.binning**2

    @property
    def superpixel_read_noise_e(self) -> float:
        """Standard deviation of a superpixel's reading, electrons: b^2 independent readings add in
        variance.
        """
        return self.read_noise_e * self.binning

    @property
    def superpixel_dark_current_e_per_s(self) -> float:
        """Dark electrons a second and superpixel."""
        return self.dark_current_e_per_s * self.binning**2

    @property
    def superpixel_black_level_dn(self) -> float:
        """Digital number of a superpixel without charge."""
        return self.black_level_dn * self.binning**2

    @property
    def largest_dn(self) -> int | None:
        """The largest code of a superpixel, b^2 (2^bits - 1); None for real-valued output."""
        return None if self.bits is None else (2**self.bits - 1) * self.binning**2


def load_sensor(path: Path | str) -> SensorModel:
    """The sensor in the TOML file at ``path``. MitsimError names the file, field, value and rule."""
    return load_model(path, SensorModel)


def paper_sensor(full_well_e: float, gain: float, dynamic_range_db: float) -> SensorModel:
    """The noise model of Zheng & Asif (arXiv 2111.12862, simulation setup) as a preset of the same chain.

    Y_n = G/F (Poisson(F/G Y) + N(0, s^2)) with s = F 10^(-R/20): a measurement Y (0 to G) is F/G Y
    electrons, and the output is in the unit of Y. It neither clips at the full well nor quantises, so
    `full_well_e` is infinite here and F sets only gain and noise; expected electrons are `measurement /
    model.gain_dn_per_e`. The pitch is the binned one of the paper's camera and plays no part in the noise.

    Parameters
    ----------
    full_well_e
        F, electrons of the largest measurement.
    gain
        G, the largest measurement.
    dynamic_range_db
        R, of F over the read noise.
    """
    return SensorModel(
        name="paper noise model",
        pixel_pitch_um=11.72,
        full_well_e=math.inf,
        read_noise_e=full_well_e * 10 ** (-dynamic_range_db / 20),
        quantum_efficiency=1.0,
        gain_dn_per_e=gain / full_well_e,
        source=f"arXiv 2111.12862, noise model with F={full_well_e}, G={gain}, R={dynamic_range_db} dB",
    )
