"""What moves between a calibration and a capture: the table [drift] of a recipe in, a checked and frozen model out.

Every number is 0 where nothing moves. Mask, projector, power, lamps, sensor and exposure are as they were in the
session before it, and as stated here in the capture after it; a session itself drifts by ``session_ramp`` and
``session_flicker`` alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from pydantic import Field, model_validator

from mitsim.core.configuration import Configuration, validate
from mitsim.core.errors import MitsimError

LARGEST_ROTATION_MRAD = 10.0
"""Beyond it the cosine, which is taken for 1, moves a mask's edge 3 mm off the axis by 0.15 um."""
LARGEST_TILT_MRAD = 50.0
"""It lifts that edge by 0.15 mm: a mask that has come loose."""
UNITS: Mapping[str, str] = MappingProxyType({
    "mask_rows_um": "um", "mask_columns_um": "um", "mask_axis_um": "um", "mask_rotation_mrad": "mrad",
    "mask_tilt_rows_mrad": "mrad", "mask_tilt_columns_mrad": "mrad", "vibration_um": "um rms", "temperature_k": "K",
    "exposure": "1", "power": "1", "power_ramp": "1", "power_flicker": "1 rms", "power_ripple": "1",
    "session_ramp": "1", "session_flicker": "1 rms", "lamp": "1", "lamp_flicker": "1 rms", "lamp_ripple": "1",
    "projector_rows": "pixels", "projector_columns": "pixels", "black_level_dn": "DN",
})  # fmt: skip
"""Unit of each kind of drift: every field of :class:`Drift` that moves something by itself."""

WORDS: Mapping[str, str] = MappingProxyType({
    "mask_rows_um": "mask down the rows", "mask_columns_um": "mask along the columns",
    "mask_axis_um": "mask away from the sensor", "mask_rotation_mrad": "mask turns in its plane",
    "mask_tilt_rows_mrad": "mask tilts down the rows", "mask_tilt_columns_mrad": "mask tilts along the columns",
    "vibration_um": "vibration of the mask", "temperature_k": "temperature", "exposure": "exposure time",
    "power": "projector's power", "power_ramp": "power over the capture",
    "power_flicker": "power from frame to frame", "power_ripple": "ripple of the power",
    "session_ramp": "power over the session", "session_flicker": "power from frame to frame of the session",
    "lamp": "lamp after its frame", "lamp_flicker": "lamp from frame to frame", "lamp_ripple": "ripple of the lamp",
    "projector_rows": "picture down the rows", "projector_columns": "picture along the columns",
    "black_level_dn": "black level",
})  # fmt: skip
"""What each kind of drift is, for people."""
STILL = "gap_um_per_k", "power_ripple_hz", "lamp_ripple_hz"
"""Fields of :class:`Drift` that move nothing by themselves: they say what a kind does."""


class MaskMotion(Configuration):
    """How a mask is turned in its plane about its centre, from rows to columns, and how it moves during an exposure."""

    rotation_mrad: float = Field(default=0.0, ge=-LARGEST_ROTATION_MRAD, le=LARGEST_ROTATION_MRAD)
    vibration_um: float = Field(default=0.0, ge=0, le=1000)
    """Rms along each axis, um."""


class Drift(Configuration):
    """What moves between a calibration and a capture, and by how much."""

    mask_rows_um: float = Field(default=0.0, ge=-1000, le=1000)
    """Mask moves down the rows, um."""
    mask_columns_um: float = Field(default=0.0, ge=-1000, le=1000)
    """The same along the columns, um."""
    mask_axis_um: float = Field(default=0.0, ge=-1000, le=1000)
    """Mask moves away from the sensor, um.

    A millimetre: a mask that has come loose."""
    mask_rotation_mrad: float = Field(default=0.0, ge=-LARGEST_ROTATION_MRAD, le=LARGEST_ROTATION_MRAD)
    """Mask turns in its plane, mrad."""
    mask_tilt_rows_mrad: float = Field(default=0.0, ge=-LARGEST_TILT_MRAD, le=LARGEST_TILT_MRAD)
    """Mask tilts about its centre, its distance growing down the rows, mrad."""
    mask_tilt_columns_mrad: float = Field(default=0.0, ge=-LARGEST_TILT_MRAD, le=LARGEST_TILT_MRAD)
    """The same along the columns, mrad."""
    vibration_um: float = Field(default=0.0, ge=0, le=1000)
    """Normal motion of the mask during each exposure, um rms along each axis."""
    temperature_k: float = Field(default=0.0, ge=-200, le=200)
    """Sensor and camera grow warmer, K."""
    gap_um_per_k: float = Field(default=0.0, ge=-100, le=100)
    """Gap from sensor to mask grows, um/K; moves nothing by itself.

    A metre of aluminium has 23 um/K."""
    exposure: float = Field(default=0.0, gt=-1, le=10)
    """Exposure time's error, as a part of it."""
    power: float = Field(default=0.0, ge=-1, le=10)
    """Projector's power changes, as a part of it."""
    power_ramp: float = Field(default=0.0, ge=-1, le=10)
    """The same, evenly from begin to end of the capture, as a part of it."""
    power_flicker: float = Field(default=0.0, ge=0, le=1)
    """The same from frame to frame, normal deviates, rms as a part of it."""
    power_ripple: float = Field(default=0.0, ge=0, le=1)
    """Power during each frame, a sine of any phase, amplitude as a part of it."""
    power_ripple_hz: float | None = Field(default=None, ge=1e-3, le=1e7)
    """Its frequency, Hz.

    Mains bring 100 or 120, a projector's pictures some 60, drivers of light-emitting diodes up to 1e6."""
    session_ramp: float = Field(default=0.0, ge=-1, le=10)
    """Power changes from begin to end of the session, as a part of it."""
    session_flicker: float = Field(default=0.0, ge=0, le=1)
    """Power from frame to frame of the session, rms as a part of it."""
    lamp: float = Field(default=0.0, ge=-1, le=10)
    """Lamps change after the ambient frame, as a part of their light."""
    lamp_flicker: float = Field(default=0.0, ge=0, le=1)
    """Lamps from frame to frame, normal deviates, rms as a part of their light."""
    lamp_ripple: float = Field(default=0.0, ge=0, le=1)
    """Lamps during each frame, a sine of any phase, amplitude as a part of it."""
    lamp_ripple_hz: float | None = Field(default=None, ge=1e-3, le=1e7)
    """Its frequency, Hz."""
    projector_rows: float = Field(default=0.0, gt=-0.5, lt=0.5)
    """Picture moves down the rows, its pixels."""
    projector_columns: float = Field(default=0.0, gt=-0.5, lt=0.5)
    """The same along the columns.

    Beyond half a pixel, pixels at the window's edge would light nothing."""
    black_level_dn: float = Field(default=0.0, ge=-1e4, le=1e4)
    """Black level of a pixel moves, DN."""

    @model_validator(mode="after")
    def _ripples_have_a_frequency(self) -> Drift:
        for name, amplitude, hertz in self._ripples:
            if amplitude and hertz is None:
                raise ValueError(f"{name}_ripple {amplitude:g} has no frequency; give {name}_ripple_hz")
        return self

    @property
    def _ripples(self) -> tuple[tuple[str, float, float | None], ...]:
        return ("power", self.power_ripple, self.power_ripple_hz), ("lamp", self.lamp_ripple, self.lamp_ripple_hz)

    @property
    def ripples(self) -> Mapping[str, tuple[float, float]]:
        """Amplitude, as a part of its light, and frequency [Hz] of each source that ripples: ``power``, ``lamp``."""
        return {name: (amplitude, hertz) for name, amplitude, hertz in self._ripples if amplitude and hertz}

    def alone(self, kind: str, amount: float | None = None) -> Drift:
        """One ``kind`` of it without the others, by another ``amount`` where one is given.

        MitsimError for a kind that there is not, or an amount that is not allowed.
        """
        if kind not in UNITS:
            raise MitsimError(f"drift {kind!r}: there is no such kind; use {', '.join(UNITS)}")
        chosen = getattr(self, kind) if amount is None else float(amount)
        return validate(Drift, {kind: chosen, **{name: getattr(self, name) for name in STILL}}, "drift")

    @property
    def kinds(self) -> tuple[str, ...]:
        """What moves."""
        return tuple(kind for kind in UNITS if getattr(self, kind))

    @property
    def mask_mm(self) -> tuple[float, float, float]:
        """How far the mask moves along rows, columns and axis [mm], for all reasons."""
        axis = self.mask_axis_um + self.gap_um_per_k * self.temperature_k
        return self.mask_rows_um / 1e3, self.mask_columns_um / 1e3, axis / 1e3

    @property
    def tilt_mrad(self) -> tuple[float, float] | None:
        """How the mask's distance comes to grow along rows and along columns [mrad]; None where it does not."""
        tilt = self.mask_tilt_rows_mrad, self.mask_tilt_columns_mrad
        return tilt if any(tilt) else None

    @property
    def motion(self) -> MaskMotion | None:
        """How the mask is turned and shakes; None where it does neither."""
        if not (self.mask_rotation_mrad or self.vibration_um):
            return None
        return MaskMotion(rotation_mrad=self.mask_rotation_mrad, vibration_um=self.vibration_um)


def amount_in_words(kind: str, amount: float) -> str:
    """An ``amount`` of a ``kind`` of drift with its unit; parts of a whole as a percentage."""
    unit = UNITS[kind]
    return f"{100 * amount:g} %{unit[1:]}" if unit.startswith("1") else f"{amount:g} {unit}"
