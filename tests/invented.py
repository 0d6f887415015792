"""Sensors that no maker sells: every number stated, for tests of the chain from light to digits."""

import math

import numpy as np

from mitsim.core.seeds import stream
from mitsim.devices.sensor import SensorModel
from mitsim.sensor.chain import expose


def sensor(**changes: object) -> SensorModel:
    """1000 electrons, 1 DN an electron, no noise, unless ``changes`` say otherwise."""
    values: dict[str, object] = {
        "name": "invented",
        "pixel_pitch_um": 5.86,
        "full_well_e": 1000.0,
        "read_noise_e": 0.0,
        "quantum_efficiency": 1.0,
        "gain_dn_per_e": 1.0,
        "source": "invented for a test",
    }
    return SensorModel(**{**values, **changes})


def draw_electrons(expected: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Counts as a camera without a well, noise of reading or codes reads them."""
    return np.asarray(expose(expected, 0.0, sensor(full_well_e=math.inf), rng, stream(0, "no read noise")))
