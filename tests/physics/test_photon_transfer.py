"""The chain measured as EMVA 1288 measures a camera: what was set must come out of frames alone.

Sizes are not chosen but computed: n independent pixel pairs give a variance with relative standard
deviation sqrt(2/n) (normal noise; the Poisson excess 1/mu is below 0.2 % of that here), so each gate below
is five standard deviations of an ideal camera, a chance of 6e-7 to fail, and sits at the error the gate
allows. Seeds are fixed.
"""

import math
from collections.abc import Callable

import numpy as np
import pytest

from mitsim.core.configuration import shipped_path
from mitsim.core.seeds import stream
from mitsim.devices.sensor import SensorModel, load_sensor
from mitsim.sensor import chain
from tests.invented import draw_electrons

Record = Callable[[str, object], None]
SEED = 20211
SIGMAS = 5.0
GAIN_GATE = 0.006
READ_NOISE_GATE = 0.015
LEVELS = (0.1, 0.2, 0.3, 0.45, 0.6, 0.75)  # of the full well: below 0.75 nothing clips
EXPOSURE_S = 0.01


@pytest.fixture(scope="module")
def camera() -> SensorModel:
    return load_sensor(shipped_path("calibration", "imx249.toml"))


def pair(model: SensorModel, mean_e: float, side: int, exposure_s: float, name: str) -> tuple[float, float]:
    """Mean (DN) and temporal variance (DN^2) of two frames under the same uniform light."""
    expected = np.full((side, side), mean_e)
    a, b = (
        chain.expose(
            expected, exposure_s, model, stream(SEED, name, index, "shot"), stream(SEED, name, index, "read")
        ).astype(np.float64)
        for index in (0, 1)
    )
    # EMVA 1288 4.0: half the mean square difference, free of anything fixed in space.
    return float((a + b).mean() / 2), float(((a - b) ** 2).mean() / 2)


def test_the_slope_of_variance_over_mean_is_the_gain(camera: SensorModel, record_property: Record) -> None:
    """On a side for which GAIN_GATE is SIGMAS deviations of the mean slope over LEVELS.

    Each level's slope (V - V_dark)/(m - m_dark) has relative deviation sqrt(2/n); their mean sqrt(2/(n J)).
    The dark pair's error is common to all levels but below 1 % of that: its variance is 2.9 DN^2 next to
    200 and more.
    """
    side = math.ceil(math.sqrt(2 / len(LEVELS)) * SIGMAS / GAIN_GATE)
    dark_mean, dark_variance = pair(camera, 0.0, side, 0.0, "dark")
    slopes = []
    for level in LEVELS:
        mean, variance = pair(camera, level * camera.superpixel_full_well_e, side, EXPOSURE_S, f"level {level}")
        slopes.append((variance - dark_variance) / (mean - dark_mean))
    error = np.mean(slopes) / camera.gain_dn_per_e - 1
    record_property("gain error", float(error))
    assert abs(error) < GAIN_GATE, f"gain off by {error:.2%} at {side} x {side}"


def test_the_dark_variance_is_the_read_noise(camera: SensorModel, record_property: Record) -> None:
    side = math.ceil(math.sqrt(1 / 2) * SIGMAS / READ_NOISE_GATE)  # a sigma's relative deviation is sqrt(1/(2n))
    _, variance = pair(camera, 0.0, side, 0.0, "read noise")
    # EMVA 1288 4.0: sigma_d^2 = (sigma_y.dark^2 - sigma_q^2) / K^2 with the ADC's 1/12 DN^2.
    measured = math.sqrt(variance - 1 / 12) / camera.gain_dn_per_e
    error = measured / camera.superpixel_read_noise_e - 1
    record_property("read noise error", float(error))
    assert abs(error) < READ_NOISE_GATE, f"read noise off by {error:.2%} at {side} x {side}"


def test_the_mean_is_linear_up_to_saturation_and_equals_its_closed_form(camera: SensorModel) -> None:
    # 16 levels from dark to beyond the full well; z-scores of the mean with the closed-form variance. Bound
    # 5: 16 x 6e-7 = 1e-5 chance that an ideal chain fails.
    side = 128
    for index, level in enumerate(np.linspace(0, 1.5, 16)):
        expected = np.full((side, side), level * camera.superpixel_full_well_e)
        frame = chain.expose(
            expected, EXPOSURE_S, camera, stream(SEED, "linear", index), stream(SEED, "linear read", index)
        )
        mean, variance = chain.frame_moments(expected[0, 0], EXPOSURE_S, camera)
        z = (frame.mean() - mean) / math.sqrt(variance / side**2)
        assert abs(z) < 5, f"level {level}: mean off by {z:.1f} standard deviations"


@pytest.mark.parametrize("level", [0.98, 1.0, 1.01])
def test_clipped_electrons_have_the_closed_form_moments(camera: SensorModel, level: float) -> None:
    # Mean within 5 deviations, variance within 5: the fourth moment is taken from the draws themselves.
    size = 400_000
    well = camera.superpixel_full_well_e
    drawn = chain.clip_at_full_well(
        draw_electrons(np.full(size, level * well), stream(SEED, "clip", str(level))), camera
    )
    mean, variance = chain.clipped_moments(level * well, well)
    assert abs(drawn.mean() - mean) < SIGMAS * math.sqrt(variance / size) + 1e-5
    spread = ((drawn - mean) ** 2).std() / math.sqrt(size)
    assert abs(((drawn - mean) ** 2).mean() - variance) < SIGMAS * spread + 1e-5


def test_a_frame_is_quantised_once(camera: SensorModel) -> None:
    # Dark frames: variance K^2 sigma^2 + 1/12 DN^2, no more. At gain 2 a second rounding, of electrons,
    # would add 4/12 DN^2, 22 % of 4 x 0.6^2 + 1/12; the gate of 2 % is 5 deviations at this
    # size.
    model = camera.model_copy(update={"binning": 1, "read_noise_e": 0.6, "gain_dn_per_e": 2.0, "bits": 16})
    side = math.ceil(math.sqrt(2) * SIGMAS / 0.02)
    _, variance = pair(model, 0.0, side, 0.0, "quantised once")
    assert variance == pytest.approx(4 * 0.6**2 + 1 / 12, rel=0.02)


def test_the_paper_s_noise_comes_out_of_the_same_chain() -> None:
    # Y_n = G/F (Poisson(F/G Y) + N(0, s^2)): mean Y, variance G/F Y + (G/F)^2 s^2, here at Y = 0.7 G.
    full_well, gain, decibel, side = 1e4, 2.0, 50.0, 300
    model = SensorModel(
        name="paper noise model", source="arXiv 2111.12862", pixel_pitch_um=11.72, quantum_efficiency=1.0,
        full_well_e=math.inf, gain_dn_per_e=gain / full_well, read_noise_e=full_well * 10 ** (-decibel / 20),
    )  # fmt: skip
    signal = 0.7 * gain
    mean, variance = pair(model, signal / model.gain_dn_per_e, side, 0.0, "paper")
    noise = full_well * 10 ** (-decibel / 20)
    expected = gain / full_well * signal + (gain / full_well * noise) ** 2
    assert abs(mean - signal) < SIGMAS * math.sqrt(expected / (2 * side**2))
    assert variance == pytest.approx(expected, rel=SIGMAS * math.sqrt(2) / side)
