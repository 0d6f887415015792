"""Moments of frames where numbers are extreme: counts from 1e-6 to 1e15, wells below the noise, 1 to 12 bits.

Judged by 45-digit sums and integrals (mpmath), and by exact sums over counts and codes.
"""

import math

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special, stats

from mitsim.devices.sensor import SensorModel
from mitsim.sensor import chain
from tests.invented import sensor
from tests.robustness import Recorder

pytestmark = pytest.mark.robustness("Sensor")


def tail(count: int, mean: mpmath.mpf) -> mpmath.mpf:
    """P(N >= count): the regularised gamma integral, cut where 1e-100 is left."""
    shape, spread = mpmath.mpf(count), mpmath.sqrt(max(count, 1))
    constant = mpmath.loggamma(shape)
    points = sorted({max(shape - k * spread, mpmath.mpf(0)) for k in (20, 16, 13, 10, 7, 4, 2, 0, -2, -4, -8, -20)})
    points = [point for point in points if point < mean]
    if mean < points[0] if points else True:
        return mpmath.mpf(0)
    end = min(mean, shape + 30 * spread + 100)
    if end > points[-1]:
        points.append(end)
    return mpmath.quad(lambda t: mpmath.exp((shape - 1) * mpmath.log(t) - t - constant) if t else mpmath.mpf(0), points)


def exact_clipped(mean: float, well: float) -> tuple[mpmath.mpf, mpmath.mpf]:
    """Moments of min(N, F) with 45 digits: summed for small wells, else by the integral for the tail."""
    with mpmath.workdps(45):
        mu, full, count = mpmath.mpf(mean), mpmath.mpf(well), math.ceil(well)
        if count <= 2000:
            first = second = mpmath.mpf(0)
            weight, left = mpmath.exp(-mu), mpmath.mpf(1)
            for k in range(count):
                first, second, left = first + weight * k, second + weight * k * k, left - weight
                weight *= mu / (k + 1)
            first, second = first + left * full, second + left * full**2
            return first, second - first**2
        over, above = mu - full, tail(count, mu)
        edge = mu * mpmath.exp((count - 1) * mpmath.log(mu) - mu - mpmath.loggamma(count))
        loss, square = over * above + edge, (over**2 + mu) * above + (mu + count - 2 * full) * edge
        return mu - loss, mu - square - loss**2 + 2 * loss * over


@pytest.mark.parametrize("well", [0.5, 1.0, 2.5, 100.0, 1500.25, 129_440.0, 1e6, 1e9, 1e12])
def test_clipped_moments_against_45_digits(measured: Recorder, well: float) -> None:
    """From thirteen deviations below the full well to a thousand times above it.

    The mean is right to 1e-14 of the smaller of light and well, the variance to 1e-9 of it. Forms that take the loss
    off the light cancel above the full well: a variance of 2.7e8 instead of 0 at 1e12 electrons in a well of 1.
    """
    deviations = np.array([-13, -11.99, -5, -2, 0, 0.5, 4.4, 6])
    means = [mean for mean in well + deviations * math.sqrt(well) if mean > 0]
    first, variance = chain.clipped_moments(np.array(means), well)
    for mean, *found in zip(means, first, variance, strict=True):
        exact = exact_clipped(float(mean), well)
        scale = min(float(mean), well)
        measured(abs(found[0] - exact[0]) / scale, at_most=1e-14, what="mean")
        measured(abs(found[1] - exact[1]) / scale, at_most=1e-9, what="variance")


@pytest.mark.parametrize("well", [0.5, 1.0, 129_440.0, 1e12])
def test_far_above_the_full_well_nothing_is_left_to_vary(well: float) -> None:
    for factor in (1e2, 1e6, 1e12):
        first, variance = chain.clipped_moments(max(factor * well, 2000.0), well)
        assert first == well and variance <= 1e-15 * well


# ---- behind the ADC


def behind_the_adc(mean: float, model: SensorModel) -> tuple[float, float]:
    """Mean and variance of `expose`, summed over counts (to 12 deviations) and codes; largest code below 2^13."""
    full, top = model.superpixel_full_well_e, model.largest_dn
    read = model.superpixel_read_noise_e * model.gain_dn_per_e
    assert top is not None
    counts = np.arange(max(0, int(mean - 12 * math.sqrt(mean) - 20)), int(mean + 12 * math.sqrt(mean) + 30))
    weight = stats.poisson.pmf(counts, mean)
    signal = np.minimum(counts, full) * model.gain_dn_per_e + model.superpixel_black_level_dn
    codes = np.arange(top + 1.0)
    if read == 0:
        code = np.clip(np.rint(signal), 0, top)
        middle = code[0]
        first = weight @ (code - middle)
        return float(middle + first), float(weight @ np.square(code - middle - first))
    upto = special.ndtr((codes + 0.5 - signal[:, None]) / read)
    upto[:, -1] = 1
    chance = weight @ np.diff(upto, prepend=0.0)
    middle = codes[int(np.argmax(chance))]
    first = chance @ (codes - middle)
    return float(middle + first), float(chance @ np.square(codes - middle - first))


models = st.builds(
    lambda bits, well, gain, read, black: sensor(
        bits=bits, full_well_e=well, gain_dn_per_e=gain, read_noise_e=read, black_level_dn=black * (2**bits - 1)
    ),
    bits=st.integers(1, 12),
    well=st.floats(-0.3, 3.5).map(lambda x: 10**x),
    gain=st.floats(-2, 0.5).map(lambda x: 10**x) | st.sampled_from([0.25, 0.5, 1.0, 2.0]),
    read=st.floats(-2, 1.5).map(lambda x: 10**x) | st.just(0.0),
    black=st.floats(0, 0.5) | st.just(0.0),
)


FEW, SOME = (st.floats(*ends).map(lambda x: 10**x) for ends in ((-6, math.log10(63.9)), (math.log10(64.1), 3.99)))


@settings(max_examples=400, deadline=None, derandomize=True)
@given(models, FEW | SOME)
def test_moments_of_few_electrons_are_exact_behind_any_adc(model: SensorModel, mean: float) -> None:
    """1 to 12 bits, wells of 0.5 to 3000 electrons, read noise of 0 to 30: 1e-5 of the variance, 1e-4 DN of the mean.

    1e-5 is what the dither of 0.8 DN and the integral over codes of 2 DN leave. 1/12 DN^2 and no ends would be off by
    any factor here: a quiet camera whose gain is 1 rounds nothing. 64 to 10 000 electrons are summed over the counts
    that occur, so that they are as good.
    """
    first, variance = chain.frame_moments(mean, 0.0, model)
    exact = behind_the_adc(mean, model)
    assert first == pytest.approx(exact[0], abs=1e-4)
    assert variance == pytest.approx(exact[1], rel=1e-3, abs=1e-9)


@pytest.mark.slow
@settings(max_examples=60, deadline=None, derandomize=True)
@given(models, st.floats(4.01, 5).map(lambda x: 10**x))
def test_moments_of_many_electrons_are_right_to_a_quarter_of_a_code(model: SensorModel, mean: float) -> None:
    """Above 10 000 electrons 129 counts stand for all: 0.25 DN of the mean, 1 % + 0.02 DN^2 of the variance."""
    first, variance = chain.frame_moments(mean, 0.0, model)
    exact = behind_the_adc(mean, model)
    assert first == pytest.approx(exact[0], abs=0.25)
    assert variance == pytest.approx(exact[1], rel=0.01, abs=0.02)


def test_moments_between_the_grid_s_points() -> None:
    """A frame of many pixels is interpolated: 1e-3 of the moments that single pixels have."""
    model = sensor(bits=8, full_well_e=3000.0, gain_dn_per_e=0.09, read_noise_e=1.0)
    light = np.linspace(70, 9000, 40_000)
    first, variance = chain.frame_moments(light, 0.0, model)
    for index in range(0, 40_000, 1999):
        one = chain.frame_moments(light[index], 0.0, model)
        assert first[index] == pytest.approx(float(one[0]), abs=1e-2)
        assert variance[index] == pytest.approx(float(one[1]), rel=5e-3, abs=1e-3)


def test_where_full_well_and_adc_end_together_the_variance_holds() -> None:
    """A camera whose full well is its largest code: half of a pixel's light is cut, and none of it twice.

    A cut normal signal in place of the average over counts was 60 % off; 5 % is what 129 counts leave.
    """
    model = sensor(bits=10, full_well_e=1023.0)
    for mean in np.linspace(900, 1100, 21):
        exact = behind_the_adc(mean, model)
        found = chain.frame_moments(mean, 0.0, model)
        assert found[0] == pytest.approx(exact[0], abs=0.1)
        assert found[1] == pytest.approx(exact[1], rel=0.05, abs=0.5)
