"""A shutter before light that ripples: the closed form of each row against the light itself, added up in time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.core.configuration import shipped_path
from mitsim.core.errors import MitsimError
from mitsim.devices.sensor import SensorModel, load_sensor
from mitsim.sensor.chain import expose, frame_moments, ripple_level, ripple_response

SENSOR = load_sensor(shipped_path("calibration", "imx249.toml"))
ROWS, HERTZ, AMPLITUDE = 40, 120.0, 0.7
LINE_US = 90.0
ROLLING, GLOBAL = ("imx477", "ov5647", "mt9m034"), ("imx249", "imx250", "imx255", "mt9m031")


def camera(**changes: Any) -> SensorModel:
    return SENSOR.model_copy(update={"shutter": "rolling", "line_time_us": LINE_US, **changes})


def added_up(begin_s: float, seconds: float, phase: float) -> float:
    """Mean of 1 + c cos(2 pi f t + phi) over an exposure, by Gauss's rule of 40 points: to rounding of so few waves."""
    places, weights = np.polynomial.legendre.leggauss(40)
    times = begin_s + seconds * (1 + places) / 2
    return float(weights @ (1 + AMPLITUDE * np.cos(2 * np.pi * HERTZ * times + phase)) / 2)


@pytest.mark.parametrize("seconds", [1e-4, 3.1e-3, 0.021])
@pytest.mark.parametrize(
    ("changes", "begins"),
    [
        ({"binning": 1}, [[r] for r in range(ROWS)]),
        ({"binning": 3}, [[3 * r, 3 * r + 1, 3 * r + 2] for r in range(ROWS)]),
        ({"binning": 3, "binning_on_chip": True}, [[r] for r in range(ROWS)]),
        ({"binning": 3, "shutter": "global", "line_time_us": None}, [[0] for _ in range(ROWS)]),
    ],
)  # fmt: skip
def test_a_rows_level_is_its_exposures_light(changes: dict[str, Any], begins: list[list[int]], seconds: float) -> None:
    """Of superpixels: the mean of their rows. (Planted: the begin in place of the middle of an exposure; a superpixel
    that begins with its first row; one line time a pixel row on chip; sin for cos.)"""
    for phase in (0.0, 2.0):
        level = ripple_level(ripple_response(camera(**changes), seconds, HERTZ, ROWS), AMPLITUDE, phase)
        lines = [[added_up(LINE_US * 1e-6 * line, seconds, phase) for line in each] for each in begins]
        assert level.shape == (ROWS, 1)
        assert np.allclose(level[:, 0], [np.mean(each) for each in lines], rtol=0, atol=1e-12)


def test_over_all_phases_levels_have_the_stated_mean_and_covariance() -> None:
    """1 and c^2 Re[A_r A_s*] / 2, exact over 64 even phases. (Planted: the variance of both parts of A.)"""
    response = ripple_response(camera(), 3e-3, HERTZ, ROWS)
    phases = 2 * np.pi * np.arange(64) / 64
    levels = np.array([ripple_level(response, AMPLITUDE, phase)[:, 0] for phase in phases])
    assert np.allclose(levels.mean(axis=0), 1, rtol=1e-12)
    expected = AMPLITUDE**2 / 2 * np.outer(response, response.conj()).real
    assert np.allclose(np.cov(levels.T, bias=True), expected, rtol=0, atol=1e-12)
    assert levels.min() >= 0


def test_noise_of_a_frame_in_ripple_is_that_of_its_rows_means() -> None:
    """200 frames of one phase against the closed-form mean and variance of every pixel: mean square of the deviations
    in standard errors, 800 pixels, within five of its own."""
    sensor, frames, seconds = camera(), 200, 3e-3
    expected = ripple_level(ripple_response(sensor, seconds, HERTZ, ROWS), AMPLITUDE, 1.0) * np.full((ROWS, 20), 3000.0)
    shot, read = (np.random.default_rng(seed) for seed in (3, 4))
    found = np.array([expose(expected, seconds, sensor, shot, read) for _ in range(frames)], dtype=np.float64)
    mean, variance = frame_moments(expected, seconds, sensor)
    bands = np.ptp(expected[:, 0]) / 3000
    assert bands > 0.5
    off = (found.mean(axis=0) - mean) / np.sqrt(variance / frames)
    spread = found.var(axis=0, ddof=1) / variance
    assert abs(np.square(off).mean() - 1) < 5 * np.sqrt(2 / off.size)
    assert abs(spread.mean() - 1) < 5 * np.sqrt(2 / (frames - 1) / off.size)
    by_row = spread.mean(axis=1) - 1  # as well where the light is weak as where it is strong
    assert np.abs(by_row).max() < 5 * np.sqrt(2 / (frames - 1) / off.shape[1])


def test_shutters_of_the_shipped_cameras(tmp_path: Path) -> None:
    """Nothing is said of a global one in manifests, so that they stay as they are."""
    shipped = {name: load_sensor(shipped_path("calibration", f"{name}.toml")) for name in (*ROLLING, *GLOBAL)}
    rolling = {name: shipped[name] for name in ROLLING}
    assert {name: sensor.shutter for name, sensor in rolling.items()} == dict.fromkeys(rolling, "rolling")
    assert rolling["imx477"].known_line_time_s() * 3040 == pytest.approx(0.0869, abs=1e-4)
    assert rolling["ov5647"].known_line_time_s() * 0x7B0 == pytest.approx(1 / 15.63, rel=1e-3)
    for sensor in map(shipped.get, GLOBAL):
        assert sensor.shutter == "global" and sensor.known_line_time_s() == 0
        assert not {"shutter", "line_time_us"} & set(sensor.identity)
    assert rolling["ov5647"].identity["shutter"] == "rolling"
    with pytest.raises(MitsimError, match=r"^sensor 'Aptina MT9M034': [^\n]*give line_time_us[^\n]*$"):
        rolling["mt9m034"].known_line_time_s()
