"""A camera and the sizes of a characterisation in; what EMVA 1288 needs of both out, or a refusal, without numpy."""

from __future__ import annotations

import math

from mitsim.bench.request import Lit, Seeded, SeedKeys
from mitsim.core.errors import MitsimError
from mitsim.core.options import option
from mitsim.devices.sensor import SensorModel


class Procedure(Lit, Seeded):
    """How a camera is characterised on simulated frames.

    Below 32 rows a row's part is known to a quarter; 50 steps and 16 frames are the least that EMVA 1288 asks for.
    """

    VERB = "characterise"

    pixels: int = option(256, "rows and columns of the frames", ge=32, le=4096)
    steps: int = option(50, "steps of light, from dark to beyond saturation", ge=20, le=1000)
    frames: int = option(100, "frames of each stack", kind=False, ge=2, le=10_000)
    wavelength: float = option(550.0, "of the light, for a curve of quantum efficiency [nm]", ge=1, le=1e6)

    @property
    def wavelength_nm(self) -> float:
        """Wavelength of the light [nm]."""
        return self.wavelength

    @property
    def stated(self) -> dict[str, float]:
        """What JSON states of the procedure."""
        sizes = {name: getattr(self, name) for name in ("pixels", "steps", "frames", "seed")}
        return {**sizes, "wavelength_nm": self.wavelength}


class ProcedureKeys(SeedKeys, total=False):
    """Keywords of :class:`Procedure`, without the frames."""

    pixels: int
    steps: int
    wavelength: float


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
