"""A camera and the sizes of a characterisation in; what EMVA 1288 needs of both out, or a refusal, without numpy."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mitsim.bench.request import check_wavelength
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.seeds import check_root
from mitsim.devices.sensor import SensorModel

_PIXELS, _STEPS, _FRAMES = (32, 4096), (20, 1000), (2, 10_000)
"""Least and most. Below 32 rows a row's part is known to a quarter; 50 steps and 16 frames are EMVA's own least."""


@dataclass(frozen=True)
class Procedure:
    """How a camera is characterised.

    Attributes
    ----------
    pixels
        rows and columns of the frames, of binned pixels.
    steps
        of the light.
    frames
        of each stack.
    seed
        root of every draw; the camera's fixed pattern has its own.
    wavelength_nm
        of the light, where the camera has a curve of quantum efficiency.
    """

    pixels: int = 256
    steps: int = 50
    frames: int = 100
    seed: int = 0
    wavelength_nm: float = 550.0

    def __post_init__(self) -> None:
        for name, (least, most) in (("pixels", _PIXELS), ("steps", _STEPS), ("frames", _FRAMES)):
            value = getattr(self, name)
            if not least <= value <= most:
                raise ArgumentError(name, f"{value}: give a whole number from {least} to {most}")
        check_root(self.seed)
        check_wavelength(self.wavelength_nm)


def efficiency_of(sensor: SensorModel, procedure: Procedure) -> float:
    """Electrons per photon of a ``sensor`` at the ``procedure``'s wavelength.

    1 where the camera states none, or has colour filters: light is counted in electrons.
    """
    return sensor.efficiency(procedure.wavelength_nm) if sensor.states_efficiency else 1.0


def capacity_of(sensor: SensorModel) -> float:
    """Electrons that saturate a pixel of a ``sensor``: its full well, or the ADC's end; MitsimError without either."""
    full = sensor.superpixel_full_well_e
    if sensor.largest_dn is not None:
        full = min(full, (sensor.largest_dn - sensor.superpixel_black_level_dn) / sensor.gain_dn_per_e)
    if not math.isfinite(full):
        raise MitsimError(
            f"camera {sensor.name!r}: has neither a full well nor an ADC, so no light saturates it; "
            "give full_well_e or bits"
        )
    return full
