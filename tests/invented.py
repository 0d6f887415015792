"""Sensors that no maker sells: every number stated, for tests of the chain from light to digits."""

from mitsim.devices.sensor import SensorModel


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
