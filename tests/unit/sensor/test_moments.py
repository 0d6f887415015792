"""Closed forms of the sensor's noise, where a wrong term is smaller than the tolerances of measured frames."""

import math
from types import SimpleNamespace

import mpmath
import numpy as np
import pytest
from scipy import special, stats

from mitsim.core.configuration import shipped_path
from mitsim.core.seeds import stream
from mitsim.devices.sensor import load_sensor
from mitsim.sensor import chain
from mitsim.sensor.camera_fit import average_moments, saturation_of
from mitsim.sensor.chain import poisson_quantile, specimen
from tests.invented import sensor


@pytest.mark.parametrize("mean", [1e4, 1e8, 1e12])
def test_the_quantile_has_a_poisson_count_s_mean_variance_and_skewness(mean: float) -> None:
    """Over all deviates: mean mu exactly, variance mu + 1/18, third moment mu + 1/27; Poisson's are mu, mu, mu.

    Gauss and Hermite's 20 nodes integrate these polynomials exactly. The count is rounded by 1e-16 mu, which times
    the weights' share of mu is what the tolerances allow.
    """
    z, weights = special.roots_hermitenorm(20)
    weights = weights / weights.sum()
    off = (poisson_quantile(np.full(20, mean), z) - mean) / np.sqrt(mean)
    rounding = 1e-15 * np.sqrt(mean)
    assert weights @ off == pytest.approx(0, abs=1e-13 + rounding)
    assert weights @ off**2 == pytest.approx(1 + 1 / 18 / mean, rel=1e-12 + 2 * rounding)
    assert weights @ off**3 * np.sqrt(mean) == pytest.approx(1 + 1 / 27 / mean, rel=1e-9 + 100 * rounding * mean**0.5)


@pytest.mark.parametrize("count", [1, 31, 32, 33, 60, 1000])
def test_a_poisson_probability_has_twelve_digits_on_both_sides_of_the_change_of_form(count: int) -> None:
    """At 32 counts the remainder's next term is 1/(1680 count^7) = 2e-14; logarithms of 1e2 to 1e3 round by 1e-13."""
    means = count * np.array([0.7, 1.0, 1.3])
    exact = [float(mpmath.exp(count * mpmath.log(mean) - mean - mpmath.loggamma(count + 1))) for mean in means]
    np.testing.assert_allclose(chain._poisson(count, means), exact, rtol=1e-12)


@pytest.mark.parametrize(("black", "well"), [(0.0, 10_000), (0.25, 10_000), (0.5, 10_000), (0.25, 10_100)])
def test_electrons_that_fill_the_well_are_one_code_and_not_dithered(black: float, well: int) -> None:
    """Half of the light's distribution lies at the full well, where 0.1 DN of read noise does not dither the rounding.

    The other half spreads over 20 codes, so shot noise seems to dither all: a well's worth of 1000.25 DN that is read
    as 1000 moves the mean by 0.12 DN, and by 0.04 DN where the light is a deviation below the well. Compared with the
    sum over all counts; 129 points stand for them to 0.01 DN. (Planted: light fills the well within 0.08 electrons.)
    """
    gain, read, light = 0.1, 1.0, 1e4
    model = sensor(full_well_e=well, read_noise_e=read, gain_dn_per_e=gain, black_level_dn=black, bits=12)
    counts = np.arange(9000, 11_000)
    weights = stats.poisson.pmf(counts, light)
    signal, codes = np.minimum(counts, well) * gain + black, np.arange(850, 1060)
    edges = special.ndtr((codes[None, :] + 0.5 - signal[:, None]) / (read * gain))
    share = weights @ np.diff(edges, axis=1)
    mean = share @ codes[1:]
    variance = share @ np.square(codes[1:] - mean)
    ours = chain.frame_moments(np.array([light]), 0.0, model)
    assert ours[0][0] == pytest.approx(mean, abs=0.01)
    assert ours[1][0] == pytest.approx(variance, rel=0.01)


def test_moments_of_linear_noise_are_those_without_short_cuts() -> None:
    """400 cameras whose well and ADC end anywhere, 40 lights of each, 1e-9 of the moments' own size, pixel by pixel.

    (Planted: 4 deviations from the ADC's upper end in place of 8; no dither asked of dim light; 5 deviations from the
    well. All differ.) 8 deviations from the ADC's ends leave 1e-15 of its range, 12 from the well 1e-30.
    """
    rng, seen = stream(7, "cameras"), 0
    for _ in range(400):
        bits = int(rng.integers(0, 17)) or None
        model = sensor(
            bits=bits,
            full_well_e=10 ** rng.uniform(2, 6),
            gain_dn_per_e=10 ** rng.uniform(-4, 2),
            read_noise_e=10 ** rng.uniform(-1, 2),
            black_level_dn=rng.uniform(0, 0.4) * (2 ** (bits or 12) - 1),
        )
        first, last = chain._linear(model)
        if first >= last:
            continue
        light = first + (last - first) * np.append(np.geomspace(1e-6, 0.5, 30), 1 - np.geomspace(1e-6, 0.4, 10))
        found, exact = chain.frame_moments(light, 0.0, model), chain._cut(light, model)
        np.testing.assert_allclose(found[0], exact[0], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found[1], exact[1], rtol=1e-9)
        for part in (light, np.append(light, last * 1.1))[: 1 + (seen < 10)]:
            mean = chain.frame_moments(part, 0.0, model)[1].mean()
            assert chain.mean_variance(part, 0.0, model) == pytest.approx(mean, rel=1e-12)
        seen += 1
    assert seen > 80


@pytest.mark.parametrize("read", [0.25, 1.0, 4.0])
def test_an_offset_is_another_black_level_to_1_500_of_the_noise_of_reading(read: float) -> None:
    """Pixels whose offsets differ, from the ADC's dark end to its bright one, against a camera each.

    Their moments are formed at offsets an eighth of the noise apart and are linear between; variances to 1e-3, or 1/300
    of the noise's own or of 1 DN^2. (Planted: steps of 1/8 DN over the noise in place of times; no end of the ADC near;
    sums that begin at 1.)
    """
    model = sensor(
        bits=8,
        read_noise_e=2 * read,
        gain_dn_per_e=0.5,
        black_level_dn=3 * read,
        dsnu_pixel_e=4 * read,
        full_well_e=510,
    )
    shape = 10, 20
    light = stream(5, "light").choice([0.0, 1.0, 20.0, 70.0, 300.0, 500.0, 600.0], shape)
    found = chain.frame_moments(light, 0.0, model)
    offset = specimen(model, shape).offset_e
    assert offset is not None
    for place in np.ndindex(shape):
        changes = {"dsnu_pixel_e": 0.0, "black_level_dn": 3 * read + 0.5 * float(offset[place])}
        mean, variance = chain.frame_moments(light[place], 0.0, model.model_copy(update=changes))
        assert found[0][place] == pytest.approx(float(mean), abs=read / 500)
        assert found[1][place] == pytest.approx(float(variance), rel=1e-3, abs=max(read**2, 1) / 300)


def test_without_noise_an_offset_is_rounded_with_the_pixel_s_signal() -> None:
    """Dark pixels that nothing blurs read the code next to black level and offset, but for 1/64 DN around a tie.

    (Planted: offsets 1/32 DN apart.)
    """
    model = sensor(bits=8, black_level_dn=4.0, dsnu_pixel_e=2.0)
    offset = specimen(model, (40, 50)).offset_e
    assert offset is not None
    signal = 4 + offset.astype(np.float64)
    clear = np.abs(signal - np.floor(signal) - 0.5) > 1 / 64
    mean, variance = chain.frame_moments(np.zeros((40, 50)), 0.0, model)
    np.testing.assert_array_equal(mean[clear], np.clip(np.rint(signal), 0, 255)[clear])
    assert not variance[clear].any()
    assert clear.mean() > 0.95


def test_the_shipped_camera_s_noise_is_linear_from_the_dark_to_a_percent_below_its_well() -> None:
    """What the short cut is for: a frame that leaves it costs four times as much."""
    model = load_sensor(shipped_path("calibration", "imx249.toml"))
    first, last = chain._linear(model)
    assert first == 0 and 0.95 < last / model.superpixel_full_well_e < 1


def test_rounding_shows_offsets_by_its_slope() -> None:
    """Of noise s [DN] at a code's middle, the slope of mean readings is 1 - 2 exp(-2 pi^2 s^2) + 2 exp(-8 pi^2 s^2).

    (Planted: all nodes with the same weight.)
    """
    model = sensor(bits=8, gain_dn_per_e=0.02, read_noise_e=12.0, black_level_dn=5.0, full_well_e=11_000.0)
    wave = [math.exp(-2 * (math.pi * k * 0.24) ** 2) for k in (1, 2)]
    mean, _, between = average_moments(np.zeros(1), model, 1e-3)
    assert mean[0] == pytest.approx(5, abs=1e-6)
    assert math.sqrt(between[0]) == pytest.approx(1e-3 * (1 - 2 * wave[0] + 2 * wave[1]), rel=2e-3)
    _, _, between = average_moments(np.array([1e4]), model, 0.05)
    assert math.sqrt(between[0]) == pytest.approx(0.05, rel=1e-2)  # noise of light dithers


def test_a_bright_set_is_saturated_where_mean_and_variance_rise_too_little() -> None:
    """Twice the light has a fifth of the variance, and 4 % or 1 % more signal above a dark level of 1000 DN. 5 % of the
    rise of the light are 2.5 %. (Planted: the dark level added to the signal.)"""
    for near, last in ((1960.0, None), (1990.0, 2)):
        sets = [(0.0, 1000.0, 1.0), (1.0, near, 100.0), (2.0, 2000.0, 21.0)]
        taken = [SimpleNamespace(light=light, mean=mean, variance=variance) for light, mean, variance in sets]
        assert saturation_of(taken) == (1, last)  # type: ignore[arg-type]


def test_the_mean_variance_is_that_of_the_pixels() -> None:
    """By the short form of linear noise, and by all moments where pixels share light. (Planted: a sum.)"""
    camera, electrons = load_sensor(shipped_path("calibration", "imx249.toml")), np.linspace(0, 2e5, 30).reshape(5, 6)
    for model in (camera, camera.model_copy(update={"crosstalk": 0.05})):
        expected = chain.frame_moments(electrons, 0.5, model)[1].mean()
        assert chain.mean_variance(electrons, 0.5, model) == pytest.approx(expected)
