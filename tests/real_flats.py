"""Frames of an invented camera under even light and in the dark, as somebody's bench writes them: files with a list."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.seeds import stream
from mitsim.devices.sensor import SensorModel
from mitsim.sensor.chain import expose
from tests.invented import sensor
from tests.real_session import write_image

PLAIN = {
    "full_well_e": 20_000.0, "read_noise_e": 4.0, "gain_dn_per_e": 0.19, "black_level_dn": 60.0, "bits": 12,
    "quantum_efficiency": 0.6, "dark_current_e_per_s": 50.0,
}  # fmt: skip
CAMERAS: dict[str, dict[str, Any]] = {
    "plain": {},
    "few bits": {
        "bits": 8, "full_well_e": 10_000.0, "read_noise_e": 25.0, "gain_dn_per_e": 0.0235, "black_level_dn": 3.0
    },
    "high read noise, cut darks": {
        "bits": 8, "full_well_e": 10_000.0, "read_noise_e": 25.0, "gain_dn_per_e": 0.0235, "black_level_dn": 1.0
    },
    "saturating ADC": {"full_well_e": 40_000.0, "gain_dn_per_e": 0.19},
    "dark current": {"dark_current_e_per_s": 20_000.0, "dark_current_spread_e_per_s": 4000.0},
    "high gain": {
        "bits": 16, "full_well_e": 10_000.0, "read_noise_e": 0.3, "gain_dn_per_e": 5.0, "black_level_dn": 100.0
    },
    "nonuniform": {
        "prnu_pixel": 0.03, "prnu_row": 0.004, "prnu_column": 0.01, "dsnu_pixel_e": 6.0, "dsnu_row_e": 1.5,
        "dsnu_column_e": 2.0,
    },
    "defects": {
        "dead_pixels": 0.002, "hot_pixels": 0.002, "hot_dark_current_e_per_s": 20_000.0, "row_noise_e": 3.0
    },
    "bent": {"linearity": (-0.05, 0.01)},
    "rows louder than pixels": {"row_noise_e": 20.0},
    "many hot pixels": {"hot_pixels": 0.1, "hot_dark_current_e_per_s": 30_000.0},
    "no black level": {"black_level_dn": 0.0},
    "no black level, rounding leaves noise at saturation": {
        "bits": 8, "gain_dn_per_e": 0.0115, "read_noise_e": 40.0, "black_level_dn": 0.0
    },
    "darks of one code": {"bits": 8, "gain_dn_per_e": 0.0115, "black_level_dn": 4.3},
    "six bits, next to no noise": {"bits": 6, "full_well_e": 10_000.0, "gain_dn_per_e": 0.006, "black_level_dn": 2.0},
}  # fmt: skip
"""Cameras that are hard to measure, each in its way; all saturate at 1.15 of the ladder or below."""
LONGEST_S = 0.04
"""Exposure of the brightest set, and of the longest dark one."""


def camera(name: str) -> SensorModel:
    return sensor(**{**PLAIN, **CAMERAS[name]})


Light = Callable[[float, int, int], Any]
"""Photons on a pixel, or (side, side) of them, of those stated, the number of the set and of the frame."""


def write_flats(
    folder: Path, model: SensorModel, side: int = 96, steps: int = 16, stack: int = 2, seed: int = 0,
    light: Light = lambda photons, number, frame: photons,
    read: Callable[[np.ndarray], np.ndarray] = lambda frame: frame,
    longest_s: float = LONGEST_S, ending: str = ".npy", **changes: Any,
) -> Path:  # fmt: skip
    """Pairs at ``steps`` exposures up to 1.15 of saturation, under light and in the dark, and ``stack`` frames at half.

    ``light`` is what falls on a pixel in place of what the list says, ``read`` what is done to frames; ``changes`` are
    of the list.
    """
    folder.mkdir()
    largest = float(model.largest_dn or np.inf)
    full = min(model.superpixel_full_well_e, (largest - model.superpixel_black_level_dn) / model.gain_dn_per_e)
    rate = 1.15 * full / model.efficiency(550) / longest_s
    sets: dict[str, list[dict[str, Any]]] = {"lit": [], "dark": []}
    middle = int(np.argmin(np.abs(1.15 * np.arange(1, steps + 1) / steps - 0.5)))
    for kind, photons_per_s in (("lit", rate), ("dark", 0.0)):
        for number in range(steps):
            seconds = longest_s * (number + 1) / steps
            files = []
            for frame in range(max(stack, 2) if number == middle else 2):
                shot, noise = (stream(seed, "flats", of, kind, number, frame) for of in ("shot", "read"))
                photons = photons_per_s * seconds
                photons = light(photons, number, frame) if photons else 0.0
                electrons = np.broadcast_to(model.efficiency(550) * np.asarray(photons), (side, side))
                values = read(np.asarray(expose(np.array(electrons), seconds, model, shot, noise), dtype=np.float64))
                files.append(f"{kind}_{number:02d}_{frame:02d}{ending}")
                write_image(folder / files[-1], values)
            sets[kind].append({"files": files, "exposure_s": seconds})
    given = {"name": "bench 3", "pixel_pitch_um": 5.86, "bits": model.bits, "photons_per_s": rate, **sets, **changes}
    (folder / "session.json").write_text(json.dumps(given))
    return folder
