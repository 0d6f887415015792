"""Each stage of the chain against its closed form; statistics of whole frames are in tests/physics."""

import math

import numpy as np
import pytest
from scipy import special, stats

from mitsim.core.errors import MitsimError
from mitsim.core.seeds import stream
from mitsim.sensor import chain
from tests.invented import draw_electrons, sensor


def test_photon_energy_of_green_light() -> None:
    # E[eV] = 1239.841984 / lambda[nm] (CODATA 2018), and 1 eV = 1.602176634e-19 J.
    # In eV: approx's absolute tolerance of 1e-12 would swallow an energy in joules.
    assert chain.photon_energy(550.0) / 1.602176634e-19 == pytest.approx(1239.841984 / 550, rel=1e-9)


def test_photons_from_irradiance_as_emva_counts_them() -> None:
    # EMVA 1288 gives mu_p = 50.34 A[um^2] t[ms] lambda[um] E[uW/cm^2]: an independent, rounded constant.
    light = 3.0  # uW/cm^2 = 1e-2 W/m^2
    electrons = chain.electrons_from_irradiance(light * 1e-2, 10e-3, sensor(binning=2), 525.0)
    assert electrons == pytest.approx(50.34 * (2 * 5.86) ** 2 * 10 * 0.525 * light, rel=1e-4)


def test_a_curve_is_taken_at_the_light_s_wavelength() -> None:
    curve = {"wavelengths_nm": [500.0, 550.0, 600.0], "efficiency": [0.0, 0.5, 0.5]}
    model = sensor(quantum_efficiency=None, quantum_efficiency_curve=curve)
    light = np.array([1e-9, 2e-9])
    by_number = chain.electrons_from_irradiance(light, 0.1, sensor(quantum_efficiency=0.25), 525.0)
    np.testing.assert_array_equal(chain.electrons_from_irradiance(light, 0.1, model, 525.0), by_number)
    number = chain.exposure_for_peak(1e-9, 0.5, sensor(quantum_efficiency=0.25), 525.0)
    assert chain.exposure_for_peak(1e-9, 0.5, model, 525.0) == number
    with pytest.raises(MitsimError, match="blind at 500 nm"):
        chain.exposure_for_peak(1e-9, 0.5, model, 500.0)


def test_the_exposure_fills_the_fraction_asked_for() -> None:
    model = sensor(binning=2, dark_current_e_per_s=50.0, quantum_efficiency=0.6)
    seconds = chain.exposure_for_peak(2e-6, 0.8, model, 550.0)
    light = chain.electrons_from_irradiance(2e-6, seconds, model, 550.0)
    assert chain.add_dark_current(light, seconds, model) == pytest.approx(0.8 * 4000.0, rel=1e-12)


@pytest.mark.parametrize("peak", [0.0, math.nan, math.inf])
def test_an_impossible_exposure_is_refused(peak: float) -> None:
    with pytest.raises(MitsimError, match="light reaches"):
        chain.exposure_for_peak(peak, 0.5, sensor(), 550.0)


@pytest.mark.parametrize("bad", [-1e-9, math.nan, math.inf])
def test_light_that_cannot_be_is_refused_not_clipped(bad: float) -> None:
    light = np.array([1.0, bad])
    with pytest.raises(ValueError, match="irradiance"):
        chain.electrons_from_irradiance(light, 1.0, sensor(), 550.0)
    with pytest.raises(ValueError, match="expected_electrons"):
        chain.expose(light, 1.0, sensor(), stream(0, "a"), stream(0, "b"))


def test_noise_streams_are_separate() -> None:
    # Another read stream leaves the electrons as they were; with no read noise the stream does not matter.
    model = sensor()
    expected = np.full((30, 30), 50.0)
    frames = [chain.expose(expected, 0.0, model, stream(1, "shot"), stream(1, "read", index)) for index in (0, 1)]
    assert np.array_equal(frames[0], frames[1])
    other = chain.expose(expected, 0.0, model, stream(2, "shot"), stream(1, "read", 0))
    assert not np.array_equal(frames[0], other)


def test_inputs_are_left_as_they_were() -> None:
    expected = np.full((4, 4), 10.0)
    chain.expose(expected, 1.0, sensor(dark_current_e_per_s=5.0), stream(0, "a"), stream(0, "b"))
    assert (expected == 10.0).all()


# ---- drawn electrons


@pytest.mark.parametrize(("mean", "apart"), [(64.0, 3.0e-6), (256.0, 1.9e-7), (1e3, 1.3e-8)])
def test_counts_of_normal_deviates_have_poisson_s_law(mean: float, apart: float) -> None:
    """Total variation between the law of :func:`poisson_count` and Poisson's, without a draw: the limits are measured.

    A count rises with its deviate, so P(N <= k) is the normal distribution function where the count passes k. Without
    the term of 1/mu the law is 3e-5 apart at 64, without that of 1/sqrt(mu) more; variance and third moment follow.
    """
    counts = np.arange(int(mean - 9 * math.sqrt(mean)), int(mean + 9 * math.sqrt(mean)))
    low, high = np.full(counts.size, -12.0), np.full(counts.size, 12.0)
    for _ in range(60):
        middle = (low + high) / 2
        above = chain.poisson_count(np.full(counts.size, mean), middle) > counts
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    law = np.diff(special.ndtr(low), prepend=0.0)
    assert np.abs(law - stats.poisson.pmf(counts, mean)).sum() / 2 < apart
    off = counts - mean
    assert law @ off == pytest.approx(0, abs=1e-8)
    assert law @ off**2 == pytest.approx(mean, rel=7e-6)
    assert law @ off**3 == pytest.approx(mean, rel=2e-6)


def test_bright_pixels_draw_the_same_counts_whatever_dim_ones_do() -> None:
    bright = np.full(200, 5e4)
    alone = draw_electrons(np.append(bright, 64.0), stream(3, "shot"))
    beside = draw_electrons(np.append(bright, 63.99), stream(3, "shot"))
    assert np.array_equal(alone[:-1], beside[:-1])


def test_dim_pixels_of_a_bright_frame_are_poisson_themselves() -> None:
    """Mean and variance of 40 000 counts of mean 3 beside as many of 1e6, to six deviations; none below zero."""
    light = np.tile([3.0, 1e6], 40_000)
    drawn = draw_electrons(light, stream(4, "shot"))
    dim, bright = drawn[::2], drawn[1::2]
    for counts, mean in ((dim, 3.0), (bright, 1e6)):
        assert counts.mean() == pytest.approx(mean, abs=6 * math.sqrt(mean / 40_000))
        assert counts.var() == pytest.approx(mean, rel=6 * math.sqrt((2 + 1 / mean) / 40_000))
    assert dim.min() == 0 and np.array_equal(drawn, np.rint(drawn))


def test_large_frames_go_through_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of any size: each block's pixels have deviates of their own. (Planted: every block's lanes counted from 0; the
    rest of a block that is no whole number of lanes left out.)"""
    model = sensor(read_noise_e=5.0, full_well_e=30000.0)
    monkeypatch.setattr(chain, "_BLOCK", 64)
    frame = chain.expose(np.full((9, 39), 9e3), 0.0, model, stream(1, "shot"), stream(1, "read")).reshape(-1)
    blocks = frame[: 5 * 64].reshape(5, 64).astype(float)
    assert np.all(np.abs(np.corrcoef(blocks) - np.eye(5)) < 6 / 8)
    assert abs(frame.mean() - chain.amplify(9e3, model)) < 6 * math.sqrt(9e3 / frame.size) * model.gain_dn_per_e
    assert frame.std() == pytest.approx(model.gain_dn_per_e * math.sqrt(9e3 + 25), rel=6 / math.sqrt(2 * frame.size))
