"""Numbers of an image sensor: a TOML file, checked to a frozen model."""

from __future__ import annotations

import math
import os
from bisect import bisect_left
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, cast

from pydantic import Field, field_validator, model_validator

from mitsim.core.configuration import CAMERA, Configuration, locate, read_toml, shipped_files, validate
from mitsim.core.errors import ArgumentError, MitsimError, near_name
from mitsim.core.manifests import Digital

EXPOSURE_S = 1e-12, 1e6
"""Shortest and longest exposure [s]: gated avalanche diodes open for 1e-10 s; cooled CCDs collect for some 1e4 s."""
EXPOSURE_FRACTION = 1e-6, 1.0
"""Mean of the brightest pixel as a part of the full well."""
_PART = Field(strict=True, ge=EXPOSURE_FRACTION[0], le=EXPOSURE_FRACTION[1], allow_inf_nan=False)
ExposureFraction = Annotated[float, _PART]
MOST_PIXELS = 1 << 20
"""Pixels along a side, before binning."""
PITCH_TOLERANCE = 1e-3
"""Relative difference of two pitches of the same pixels that is rounding in a data sheet."""
BASE = "base"
"""Name of a file's line that names the camera whose fields it inherits."""
_LARGEST_CODE = 2**32 - 1
"""What a frame's uint32 holds."""
_ALWAYS = {"binning", "dark_current_e_per_s", "black_level_dn", "bits"}
"""Fields that are always in manifests, because calibrations of 0.4 have them."""
_EFFICIENCIES = {"quantum_efficiency"}, {"quantum_efficiency_curve"}, {"mosaic", "mosaic_curves"}
"""Fields that replace each other when a file inherits from another."""
_LEVELS = 256


class SensorModel(Configuration, defer_build=True):
    """A camera after EMVA 1288 release 4.0: per-pixel electronics and how pixels are binned.

    The fields describe one **pixel**; a frame's element is a **superpixel** of `binning` x `binning` = b^2 pixels whose
    values are summed. Area, full well, dark current, black level and largest code are then b^2 times as large, and read
    noise b times. The sum is rounded once, which neglects (b^2 - 1)/12 DN^2 of variance. With `binning_on_chip` charge
    is read once: noises, offsets, black level and largest code are those of one reading. A field that is left out is an
    effect that the camera does not have.
    """

    name: str
    """Name of the sensor in reports."""
    pixel_pitch_um: float = Field(ge=1e-3, le=1e4)
    """Distance between centres of pixels in a row, um.

    Pixels of telephones have 0.5 um, those of X-ray panels some 100 um."""
    row_pitch_um: float | None = Field(default=None, ge=1e-3, le=1e4)
    """Distance between rows of pixels that are not square, um; none: the pitch of columns."""
    rows: int | None = Field(default=None, ge=1, le=MOST_PIXELS)
    """Rows of pixels that are read, before binning, about the sensor's middle; none: those of the scene's film."""
    columns: int | None = Field(default=None, ge=1, le=MOST_PIXELS)
    """Columns of pixels that are read, in the same way."""
    binning: int = Field(default=1, ge=1, le=64)
    """Pixels summed along each side of a superpixel.

    Cameras bin up to 16 x 16."""
    full_well_e: float = Field(ge=0.1, allow_inf_nan=True)
    """Electrons a pixel holds; inf = no limit.

    An avalanche diode counts one; read-outs of infrared arrays integrate 1e8, so 1e12 is the most, or inf."""
    read_noise_e: float = Field(ge=0, le=1e6)
    """Standard deviation of one pixel's reading, electrons.

    0.2 in the quietest cameras, some 1e4 in photodiode arrays."""
    dark_current_e_per_s: float = Field(default=0.0, ge=0, le=1e10)
    """Dark electrons a second and pixel.

    Warm infrared arrays have 1e8."""
    dark_current_temperature_c: float | None = Field(default=None, ge=-273.15, le=200)
    """Temperature of the stated dark current, degrees Celsius."""
    dark_doubling_c: float | None = Field(default=None, ge=1, le=100)
    """Rise of the temperature that doubles the dark current, kelvin.

    5 to 10 in silicon."""
    temperature_c: float | None = Field(default=None, ge=-273.15, le=200)
    """Temperature of the sensor, degrees Celsius; none: that of the stated dark current."""
    dark_current_spread_e_per_s: float = Field(default=0.0, ge=0, le=1e10)
    """Standard deviation of the dark current over the pixels, electrons a second."""
    dsnu_pixel_e: float = Field(default=0.0, ge=0, le=1e6)
    """Standard deviation of pixels' offsets, electrons."""
    dsnu_row_e: float = Field(default=0.0, ge=0, le=1e6)
    """Standard deviation of offsets that the pixels of a row share, electrons."""
    dsnu_column_e: float = Field(default=0.0, ge=0, le=1e6)
    """Standard deviation of offsets that the pixels of a column share, electrons.

    As read noise."""
    prnu_pixel: float = Field(default=0.0, ge=0, le=0.1)
    """Relative standard deviation of pixels' response."""
    prnu_row: float = Field(default=0.0, ge=0, le=0.1)
    """Relative standard deviation of the response that the pixels of a row share."""
    prnu_column: float = Field(default=0.0, ge=0, le=0.1)
    """Relative standard deviation of the response that the pixels of a column share.

    Cameras have some 1e-2; beyond 0.1 the normal law of the response would reach zero."""
    row_noise_e: float = Field(default=0.0, ge=0, le=1e6)
    """Standard deviation of noise that the pixels of a row share in each frame, electrons."""
    hot_pixels: float = Field(default=0.0, ge=0, le=0.5)
    """Fraction of hot pixels."""
    hot_dark_current_e_per_s: float = Field(default=0.0, ge=0, le=1e10)
    """Additional dark current of a hot pixel, electrons a second."""
    dead_pixels: float = Field(default=0.0, ge=0, le=0.5)
    """Fraction of pixels that do not respond to light."""
    pattern_seed: int = Field(default=0, ge=0, lt=2**64)
    """Seed of everything that is fixed in space (the specimen), independent of a run's seed."""
    linearity: Annotated[tuple[float, ...], Field(strict=False, max_length=4)] = ()
    """c_k of N (1 + sum c_k (N/F)^k), k = 1, 2, ..: the reading of N electrons in a full well of F."""
    crosstalk: float = Field(default=0.0, ge=0, le=0.5)
    """Fraction of a pixel's light that its four neighbours receive, a quarter each."""
    binning_on_chip: bool = False
    """True if charge is summed on chip and read once; otherwise readings are summed."""
    binned_full_well_e: float | None = Field(default=None, ge=0.1, le=1e14)
    """Electrons a superpixel holds on chip; none: binning^2 full wells."""
    shutter: Literal["global", "rolling"] = "global"
    """`global`: all rows are exposed at once; `rolling`: each row begins `line_time_us` after the row before."""
    line_time_us: float | None = Field(default=None, ge=1e-3, le=1e6)
    """Time between the beginnings of the exposures of two rows, us; needed if light ripples.

    Some 1 to 100 in cameras; long exposures of a telephone's sensor stretch it to 1e4."""
    quantum_efficiency: float | None = Field(default=None, ge=1e-6, le=1)
    """Electrons per photon, at the source's wavelength; none: no source states it.

    One electron a photon at most; photocathodes and silicon at their red end fall to 1e-4."""
    quantum_efficiency_curve: EfficiencyCurve | None = None
    """Table: electrons per photon over wavelength, in place of quantum_efficiency."""
    mosaic: Mosaic | None = None
    """Colour filters of 2 x 2 pixels, row by row; none: a monochrome sensor."""
    mosaic_curves: MosaicCurves | None = None
    """Tables R, G, B: curves of the pixels under each filter, in place of both."""
    gain_dn_per_e: float = Field(ge=1e-12, le=1e6)
    """Digital numbers per electron.

    1e-12 spreads the largest full well over one number; electron multiplication brings some 1e3."""
    black_level_dn: float = Field(default=0.0, ge=0, lt=2**24)
    """Digital number of a pixel without charge.

    Below the largest ADC's last number."""
    bits: int | None = Field(default=None, ge=1, le=24)
    """Bits of the ADC; none: real output.

    Cameras have up to 16, laboratory converters 24."""
    source: str
    """Source of the numbers."""

    @field_validator("full_well_e")
    @classmethod
    def _a_known_well_or_none(cls, electrons: float) -> float:
        if 1e12 < electrons < math.inf:
            raise ValueError(f"got {electrons:g}; a full well is 0.1 to 1e+12 electrons, or inf for none")
        return electrons

    @model_validator(mode="after")
    def _fields_fit_together(self) -> SensorModel:
        if self.bits is not None and self.black_level_dn >= 2**self.bits - 1:
            raise ValueError(f"black_level_dn {self.black_level_dn} leaves no room below 2^{self.bits} - 1")
        if self.largest_dn is not None and self.largest_dn > _LARGEST_CODE:
            problem = f"bits {self.bits} with binning {self.binning} has codes up to {self.largest_dn}"
            raise ValueError(f"{problem}; frames hold at most {_LARGEST_CODE}, so bin less or take fewer bits")
        for one, other in (
            ("rows", "columns"),
            ("hot_pixels", "hot_dark_current_e_per_s"),
            ("mosaic", "mosaic_curves"),
        ):
            if bool(getattr(self, one)) != bool(getattr(self, other)):
                raise ValueError(f"{one} and {other} go together; give both, or none")
        if self.rows is not None and self.columns is not None and min(self.rows, self.columns) < self.binning:
            raise ValueError(f"rows {self.rows} or columns {self.columns} are below binning {self.binning}; bin less")

        if self.temperature_c is not None and None in (self.dark_current_temperature_c, self.dark_doubling_c):
            needed = "dark_current_temperature_c and dark_doubling_c; give both, or leave it out"
            raise ValueError(f"temperature_c {self.temperature_c:g} moves the dark current only with {needed}")
        if self.dark_current_spread_e_per_s and not self.dark_current_e_per_s:
            raise ValueError("dark_current_spread_e_per_s is of a dark current of 0; give dark_current_e_per_s, too")
        if self.line_time_us is not None and self.shutter == "global":
            raise ValueError(f"line_time_us {self.line_time_us:g} is of a rolling shutter; set shutter 'rolling'")
        if self.binned_full_well_e is not None and not self.binning_on_chip:
            raise ValueError("binned_full_well_e is of charge summed on chip; set binning_on_chip, or leave it out")
        if self.linearity and not math.isfinite(self.full_well_e):
            raise ValueError("linearity is relative to the full well; give a finite full_well_e")
        for part in (level / _LEVELS for level in range(_LEVELS + 1)):
            if not 0 < 1 + sum((k + 1) * c * part**k for k, c in enumerate(self.linearity, 1)) < math.inf:
                raise ValueError(f"linearity {self.linearity} falls below the full well; more light must read as more")
        names = "quantum_efficiency", "quantum_efficiency_curve", "mosaic_curves"
        given = [name for name in names if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"got {' and '.join(given)}; give one of them")
        if self.mosaic is not None and self.binning > 1:
            raise ValueError(f"mosaic {self.mosaic}: binning {self.binning} would sum its colours; set binning 1")
        return self

    def efficiency(self, wavelength_nm: float, plane: Plane | None = None) -> float:
        """Return the electrons per photon of pixels under a ``plane`` of a mosaic, or of all pixels.

        Raises MitsimError outside the curve, without an efficiency, or for a plane that the camera does not have.
        """
        if (self.mosaic is None) != (plane is None):
            filters = f"a mosaic {self.mosaic}" if self.mosaic else "no mosaic"
            asked = f"plane {plane} was" if plane else "monochrome frames were"
            remedy = "use a monochrome camera, or --colour mosaic" if self.mosaic else "leave the plane out"
            raise MitsimError(f"sensor {self.name!r}: has {filters}, and {asked} asked for; {remedy}")
        curve = getattr(self.mosaic_curves, plane) if plane else self.quantum_efficiency_curve
        try:
            found = self.quantum_efficiency if curve is None else curve.at(wavelength_nm)
        except MitsimError as error:
            raise MitsimError(f"sensor {self.name!r}: {error}") from None
        if self.sensor_only or found is None:
            problem = f"sensor {self.name!r}: sensor only: its file states no quantum_efficiency, so light makes no"
            remedy = "give a file of two lines, base = (this camera) and quantum_efficiency = (yours)"
            raise MitsimError(f"{problem} known number of electrons; characterise works without; else {remedy}")
        return float(found)

    def planes(self, wavelengths_nm: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return the electrons per photon of the mosaic's four pixels at the ``wavelengths_nm``.

        Raises MitsimError without a mosaic, and outside its curves.
        """
        if self.mosaic is None:
            raise MitsimError(f"sensor {self.name!r}: has no mosaic of colour filters; use a camera that has one")
        mosaic = cast("Sequence[Plane]", self.mosaic)
        return tuple(tuple(self.efficiency(nm, plane) for nm in wavelengths_nm) for plane in mosaic)

    @property
    def states_efficiency(self) -> bool:
        return self.quantum_efficiency is not None or self.quantum_efficiency_curve is not None

    @property
    def sensor_only(self) -> bool:
        return not self.states_efficiency and self.mosaic is None

    @property
    def frame_shape(self) -> tuple[int, int] | None:
        if self.rows is None or self.columns is None:
            return None
        return self.rows // self.binning, self.columns // self.binning

    @property
    def pitches_mm(self) -> tuple[float, float]:
        row = self.row_pitch_um or self.pixel_pitch_um
        return row * self.binning * 1e-3, self.superpixel_pitch_um * 1e-3

    @property
    def identity(self) -> dict[str, object]:
        """Return all fields for manifests but the source and effects that the file does not name."""
        fields, stated = type(self).model_fields, self.model_dump(exclude={"source"}).items()
        return {name: value for name, value in stated if name in _ALWAYS or value != fields[name].default}

    @property
    def has_fixed_pattern(self) -> bool:
        parts = *self.offset_parts, *self.response_parts, self.dark_current_spread_e_per_s
        return any((*parts, self.hot_pixels, self.dead_pixels))

    @property
    def offset_parts(self) -> tuple[float, float, float]:
        """Return the standard deviations of a superpixel's offset by pixel, row and column [electrons].

        They are (b^2, b^3, b^3)^(1/2) times one pixel's, because b readings share a row's offset in each of b rows. On
        chip there is one reading.
        """
        pixel, line = self._readings
        return self.dsnu_pixel_e * pixel, self.dsnu_row_e * line, self.dsnu_column_e * line

    @property
    def response_parts(self) -> tuple[float, float, float]:
        line = math.sqrt(self.binning)
        return self.prnu_pixel / self.binning, self.prnu_row / line, self.prnu_column / line

    @property
    def _readings(self) -> tuple[float, float]:
        return (1.0, 1.0) if self.binning_on_chip else (float(self.binning), self.binning**1.5)

    @property
    def codes(self) -> int:
        return 1 if self.binning_on_chip else self.binning**2

    @property
    def dark_factor(self) -> float:
        if self.temperature_c is None or self.dark_current_temperature_c is None or self.dark_doubling_c is None:
            return 1.0
        return float(2 ** ((self.temperature_c - self.dark_current_temperature_c) / self.dark_doubling_c))

    def known_line_time_s(self) -> float:
        """Return the time between rows' exposures [s], 0 for a global shutter; MitsimError if it is not stated."""
        if self.shutter == "global":
            return 0.0
        if self.line_time_us is None:
            problem = f"sensor {self.name!r}: its shutter is rolling and its file states no line_time_us, so a ripple"
            remedy = "give line_time_us, with its source, or leave ripples out"
            raise MitsimError(f"{problem} of the light falls on no known rows; {remedy}")
        return self.line_time_us * 1e-6

    @property
    def superpixel_row_noise_e(self) -> float:
        return self.row_noise_e * self._readings[1]

    @property
    def superpixel_reading_noise_e(self) -> float:
        own = self.superpixel_read_noise_e
        return math.hypot(own, self.superpixel_row_noise_e) if self.row_noise_e else own

    @property
    def full_well_dn(self) -> float:
        full = self.superpixel_full_well_e
        bent = full * (1 + sum(self.linearity)) if self.linearity else full
        return bent * self.gain_dn_per_e + self.superpixel_black_level_dn

    @property
    def superpixel_pitch_um(self) -> float:
        return self.pixel_pitch_um * self.binning

    @property
    def superpixel_area_m2(self) -> float:
        """Return the area [m^2]; the fill factor is part of the quantum efficiency."""
        if self.row_pitch_um is None:
            return (self.superpixel_pitch_um * 1e-6) ** 2
        return self.superpixel_pitch_um * self.row_pitch_um * self.binning * 1e-12

    @property
    def superpixel_full_well_e(self) -> float:
        full = self.full_well_e * self.binning**2
        return full if self.binned_full_well_e is None else min(full, self.binned_full_well_e)

    @property
    def superpixel_read_noise_e(self) -> float:
        return self.read_noise_e * self._readings[0]

    @property
    def superpixel_dark_current_e_per_s(self) -> float:
        return self.dark_current_e_per_s * self.binning**2 * self.dark_factor

    @property
    def superpixel_black_level_dn(self) -> float:
        return self.black_level_dn * self.codes

    @property
    def largest_dn(self) -> int | None:
        return None if self.bits is None else (2**self.bits - 1) * self.codes


def check_exposure(seconds: float) -> float:
    shortest, longest = EXPOSURE_S
    if not shortest <= seconds <= longest:
        raise ArgumentError("exposure", f"{seconds:g}: give the seconds of every frame, {shortest:g} to {longest:g}")
    return seconds


def load_sensor(path: Path | str) -> SensorModel:
    """Return the sensor in a TOML file without its table ``[mask]``; a MitsimError names file, field, value and rule.

    A line ``base`` names a shipped camera, or a file beside it, whose fields are inherited. Raises MitsimError if there
    is no such base.
    """
    table = read_toml(path)
    if (base := table.pop(BASE, None)) is not None:
        if not isinstance(base, str):
            raise MitsimError(f"file {path}: {BASE}: got {base!r}; give the name of a camera, or a file")
        beside, known = Path(path).parent / base, shipped_files("calibration", ".toml", CAMERA)
        is_beside = os.path.isfile(beside)  # False of a name that is too long
        if not is_beside and Path(base).name == base and not Path(base).suffix and base not in known:
            problem = f"file {path}: {BASE}: got {base!r}, no such camera"
            raise MitsimError(f"{problem}; {near_name(base, known)}shipped are {', '.join(known)}")
        place = beside if is_beside else locate(base, "calibration", ".toml", CAMERA)
        below: dict[str, object] = read_toml(place)
        for name in (BASE, "mask"):
            if name in below and name not in table:
                raise MitsimError(f"file {path}: {BASE}: {place} has {name}, which is not inherited; give its own here")
        for name in ("rows", "columns"):
            most, asked = below.get(name), table.get(name)
            if isinstance(most, int) and isinstance(asked, int) and asked > most:
                raise MitsimError(f"file {path}: {name}: got {asked}, but {place.stem} has {most}; give no more")
        if any(kind & table.keys() for kind in _EFFICIENCIES):
            others = [kind for kind in _EFFICIENCIES if not kind & table.keys()]
            below = {name: below[name] for name in below.keys() - set().union(*others)}
        table = {**below, **table}
    table.pop("mask", None)
    return validate(SensorModel, table, f"file {path}")


# -------- How digital numbers become electrons a second


def digital_of(sensor: SensorModel, exposure_s: float) -> Digital:
    full = sensor.full_well_dn
    largest = math.inf if sensor.largest_dn is None else float(sensor.largest_dn)
    end = min(full if math.isinf(full) else float(math.floor(full)), largest)
    return Digital(
        exposure_s=exposure_s,
        black_level_dn=sensor.superpixel_black_level_dn,
        gain_dn_per_e=sensor.gain_dn_per_e,
        dark_current_e_per_s=sensor.superpixel_dark_current_e_per_s,
        read_noise_e=sensor.superpixel_reading_noise_e,
        step_dn=0.0 if sensor.largest_dn is None else 1.0,
        saturation_dn=None if math.isinf(end) else end,
    )


# -------- Quantum efficiency by wavelength

Plane = Literal["R", "G", "B"]
"""Colour of a filter over a pixel."""
Mosaic = Literal["RGGB", "BGGR", "GRBG", "GBRG"]
"""Filters of 2 x 2 pixels, row by row from the frame's first pixel (Bayer, US patent 3 971 065)."""
_POINTS = Field(strict=False, min_length=2, max_length=1024)
"""Points of a curve: the visible and near infrared in steps of a nanometre have 800."""


class EfficiencyCurve(Configuration):
    """Electrons per photon over wavelength, linear between its points and unknown outside them."""

    wavelengths_nm: Annotated[tuple[Annotated[float, Field(ge=1, le=1e6)], ...], _POINTS]
    """Wavelengths of its points, rising [nm].

    As a projector's."""
    efficiency: Annotated[tuple[Annotated[float, Field(ge=0, le=1)], ...], _POINTS]
    """Electrons per photon at each."""

    @model_validator(mode="after")
    def _a_curve(self) -> EfficiencyCurve:
        if len(self.wavelengths_nm) != len(self.efficiency):
            problem = f"got {len(self.wavelengths_nm)} wavelengths_nm and {len(self.efficiency)} of efficiency"
            raise ValueError(f"{problem}; give one efficiency a wavelength")
        for low, high in zip(self.wavelengths_nm, self.wavelengths_nm[1:], strict=False):
            if high <= low:
                raise ValueError(f"wavelengths_nm: got {high:g} after {low:g}; give rising wavelengths")
        if not any(self.efficiency):
            raise ValueError("efficiency: all are 0; give electrons per photon above 0 somewhere")
        return self

    def at(self, wavelength_nm: float) -> float:
        """Return the electrons per photon; raise MitsimError outside the curve."""
        first, last = self.wavelengths_nm[0], self.wavelengths_nm[-1]
        if not first <= wavelength_nm <= last:
            raise MitsimError(f"got {wavelength_nm:g} nm; the curve is of {first:g} to {last:g} nm; use light of these")
        # numpy is avoided because its import takes half the time of a refusal.
        above = max(1, bisect_left(self.wavelengths_nm, wavelength_nm))
        below, beyond = self.wavelengths_nm[above - 1 : above + 1]
        part = (wavelength_nm - below) / (beyond - below)
        return self.efficiency[above - 1] * (1 - part) + self.efficiency[above] * part


class MosaicCurves(Configuration):
    """Curves of the pixels under each colour of a filter array, filters included."""

    R: EfficiencyCurve
    """Of pixels under red filters."""
    G: EfficiencyCurve
    """Of pixels under green filters."""
    B: EfficiencyCurve
    """Of pixels under blue filters."""
