"""Options of a simulated characterisation; importing them does not import numpy."""

from __future__ import annotations

from mitsim.bench.request import Lit, Seeded
from mitsim.core.configuration import option
from mitsim.devices.sensor import SensorModel


class Procedure(Lit, Seeded):
    """Options of a characterisation on simulated frames.

    Below 32 rows a row's part is uncertain by a quarter; EMVA 1288 requires at least 50 steps and 16 frames.
    """

    VERB = "characterise"

    pixels: int = option(256, "rows and columns of the frames", ge=32, le=4096)
    steps: int = option(50, "steps of light, from dark to beyond saturation", ge=20, le=1000)
    frames: int = option(100, "frames of each stack", kind=False, ge=2, le=10_000)
    wavelength: float = option(550.0, "of the light, for a curve of quantum efficiency [nm]", ge=1, le=1e6)

    @property
    def wavelength_nm(self) -> float:
        return self.wavelength

    @property
    def stated(self) -> dict[str, float]:
        sizes = {name: getattr(self, name) for name in ("pixels", "steps", "frames", "seed")}
        return {**sizes, "wavelength_nm": self.wavelength}

    def efficiency(self, sensor: SensorModel) -> float:
        """Return electrons per photon; 1 if the sensor states none or has filters, because electrons are counted."""
        return sensor.efficiency(self.wavelength) if sensor.states_efficiency else 1.0
