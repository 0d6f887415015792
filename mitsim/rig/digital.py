"""How digital numbers become electrons a second: a camera's electronics and an exposure in, what a RUN states out."""

from __future__ import annotations

import math

from mitsim.core.manifests import Digital
from mitsim.rig.sensor import SensorModel


def digital_of(sensor: SensorModel, exposure_s: float) -> Digital:
    """What frames of the binned ``sensor`` mean at an exposure of ``exposure_s``."""
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
