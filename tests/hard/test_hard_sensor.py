"""The sensor where its numbers are extreme: counts from 1e-6 to 1e17, wells below the noise, 1 to 16 bits.

Frames are judged by statistics with fixed seeds, whose gates are Bonferroni's share of 1e-6, or five standard
deviations where a test says so. Moments are judged by 45-digit sums and integrals (mpmath), and by exact sums over
counts and codes.
"""

import math
from types import SimpleNamespace
from typing import Any

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special, stats

from mitsim.acquire.exposure import Exposer
from mitsim.core.configuration import shipped_path, validate
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import stream
from mitsim.devices.sensor import SensorModel, load_sensor
from mitsim.sensor import chain
from tests.invented import draw_electrons, sensor
from tests.robustness import Recorder

pytestmark = pytest.mark.robustness("Sensor")
SEED = 41_2026
SIGNIFICANCE = 1e-6
MEANS = (1e-6, 1e-4, 1e-2, 0.3, 1.0, 7.5, 60.0, 1e3, 1e5, 1e8, 1e10, 1e12, 1e13, 1e14, 1e15, 1e17)
DRAWS = 200_000


def exposed(model: SensorModel, mean: float, count: int, *names: object) -> np.ndarray:
    rngs = (stream(SEED, noise, *map(str, names)) for noise in ("shot", "read"))
    return np.asarray(chain.expose(np.full(count, mean), 0.0, model, *rngs), dtype=np.float64)


# ---- Poisson


@pytest.mark.parametrize("mean", MEANS)
def test_drawn_electrons_are_poisson_from_a_millionth_to_1e17(mean: float) -> None:
    """Pearson's chi-square, the sum's own law and the variance; numpy's draw alone has 190 sigma at 1e16.

    The sum of n draws is Poisson of mean n mu, exactly. The variance of a sample variance is (mu + 2 mu^2) / n.
    Significance: 1e-6 over three statistics for each of the means.
    """
    share = SIGNIFICANCE / (3 * len(MEANS))
    drawn = draw_electrons(np.full(DRAWS, mean), stream(SEED, "poisson", str(mean)))
    assert drawn.dtype == np.float64 and np.array_equal(drawn, np.rint(drawn))
    # Beyond 1e11 a sum of counts rounds; deviations from the mean do not.
    z = math.fsum(drawn - mean) / math.sqrt(DRAWS * mean)
    total = DRAWS * mean
    if total < 1e9:
        tail = min(stats.poisson.cdf(drawn.sum(), total), stats.poisson.sf(drawn.sum() - 1, total))
    else:
        tail = stats.norm.sf(abs(z))
    assert 2 * tail > share
    if mean >= 1e3:
        spread = np.mean(np.square(drawn - mean)) / mean
        assert abs(spread - 1) < stats.norm.isf(share / 2) * math.sqrt((2 + 1 / mean) / DRAWS)
    statistic, freedom = pearson(drawn, mean)
    if freedom:
        assert stats.chi2.sf(statistic, freedom) > share


def pearson(drawn: np.ndarray, mean: float) -> tuple[float, int]:
    """Chi-square of the counts in up to 50 cells of whole numbers, and its degrees of freedom."""
    edges = np.unique(np.floor(mean + math.sqrt(mean) * stats.norm.ppf(np.arange(1, 50) / 50)))
    edges = edges[edges >= 0] if mean >= 20 else np.arange(math.ceil(mean + 6 * math.sqrt(mean)) + 1.0)
    # Within 4.5 deviations scipy's distribution function has 15 digits up to 1e12, and beyond it the normal one with
    # the term of skewness has 1 / mu.
    if mean <= 1e12:
        below = special.pdtr(edges, mean)
    else:
        x = (edges + 0.5 - mean) / math.sqrt(mean)
        below = special.ndtr(x) - (x**2 - 1) * np.exp(-(x**2) / 2) / math.sqrt(2 * math.pi * mean) / 6
    predicted = len(drawn) * np.diff(below, prepend=0.0, append=1.0)
    seen = np.bincount(np.searchsorted(edges, drawn), minlength=len(edges) + 1)
    kept = predicted >= 10
    expected, observed = np.append(predicted[kept], predicted[~kept].sum()), np.append(seen[kept], seen[~kept].sum())
    if expected[-1] < 1:
        expected, observed = expected[:-1], observed[:-1]
    return float(np.sum((observed - expected) ** 2 / expected)), len(expected) - 1


# ---- frames against their moments


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    bits=st.integers(1, 20) | st.none(),
    binning=st.sampled_from([1, 2, 64]),
    well=st.floats(-0.99, 11.99).map(lambda x: 10**x) | st.just(math.inf),
    gain=st.floats(-11.99, 5.99).map(lambda x: 10**x),
    read=st.floats(-12, 5.99).map(lambda x: 10**x) | st.just(0.0),
    mean=st.floats(-6, 12).map(lambda x: 10**x) | st.just(0.0),
)
def test_everything_is_finite_for_any_camera_and_light(bits, binning, well, gain, read, mean) -> None:
    model = sensor(bits=bits, binning=binning, full_well_e=well, gain_dn_per_e=gain, read_noise_e=read)
    first, variance = chain.frame_moments(mean, 0.0, model)
    frame = exposed(model, mean, 16)
    assert np.isfinite(first) and np.isfinite(variance) and variance >= 0 and np.isfinite(frame).all()
    if model.largest_dn is not None:
        # A distribution between 0 and M has a variance of at most M^2 / 4.
        assert 0 <= first <= model.largest_dn * (1 + 1e-12) and frame.max() <= model.largest_dn
        assert variance <= model.largest_dn**2 / 4 * (1 + 1e-6) + 1 / 12
    assert np.isfinite(chain.dn_to_electrons(frame, model)).all()


@pytest.mark.parametrize("bits", range(1, 17))
def test_frames_of_1_to_16_bits_have_their_moments(measured: Recorder, bits: int) -> None:
    """A camera of 2000 electrons whose ADC ends at 95 % of them, over 13 levels from dark to far saturation.

    z of the mean and of the variance, whose own spread comes from the draws; 1e-6 over 16 x 13 x 2 statistics.
    """
    top, count = 2**bits - 1, 8_000
    model = sensor(
        bits=bits, full_well_e=2000.0, read_noise_e=5.0, gain_dn_per_e=0.9 * top / 1900, black_level_dn=0.1 * top
    )
    bound = stats.norm.isf(SIGNIFICANCE / (2 * 2 * 16 * 13))
    for level, mean in enumerate(
        (0.0, 1e-6, 0.1, 3.0, 30.0, 200.0, 700.0, 844.0, 1200.0, 1600.0, 1900.0, 2300.0, 1e12)
    ):
        frame = exposed(model, mean, count, bits, level)
        first, variance = (float(value) for value in chain.frame_moments(mean, 0.0, model))
        deviation = np.sqrt(max(variance, frame.var()) / count)
        square = np.square(frame - first)
        spread = max(square.std() / math.sqrt(count), 0.01 * variance, 1e-3)
        measured(abs(frame.mean() - first) / max(deviation, 1e-3), at_most=bound, what="mean", unit="sigma")
        measured(abs(square.mean() - variance) / spread, at_most=bound, what="variance", unit="sigma")


@pytest.mark.parametrize("bits", range(6, 17))
def test_photon_transfer_finds_gain_and_a_straight_line(measured: Recorder, bits: int) -> None:
    """EMVA 1288: the gain is the slope of variance over mean, the linearity error the departure from a fitted line.

    Variance of n values has a relative deviation of sqrt(2/n), and the slope through the dark level averages J of them:
    5 sqrt(2/(n J)). From 6 bits on, where read noise is above 0.8 DN and dithers the codes; 10 levels from 5 to 50 % of
    the ADC. A code's noise over sqrt(n) bounds the linearity, 6 deviations of a mean over the ADC's range.
    """
    top, count, levels = 2**bits - 1, 30_000, np.linspace(0.05, 0.5, 10)
    # The well grows with the ADC, so that noise in codes stays above one.
    gain = 0.9 if bits < 12 else 0.9 * top / 4096
    model = sensor(
        bits=bits, full_well_e=2 * top / gain, read_noise_e=1.0, gain_dn_per_e=gain, black_level_dn=0.1 * top
    )
    frames = [exposed(model, level * top / gain, count, "transfer", bits, level) for level in (0.0, *levels)]
    means, variances = np.array([f.mean() for f in frames]), np.array([f.var() for f in frames])
    slopes = (variances[1:] - variances[0]) / (means[1:] - means[0])
    # Few electrons: a Poisson count's excess adds 1/mu to the 2 of a normal variance, and the dark level its own share.
    dark = variances[0] / (variances[1:] - variances[0])
    electrons = levels * top / gain
    gate = (
        5 * (math.sqrt(np.sum(2 * (1 + dark) ** 2 + 1 / electrons) / count) + np.sum(dark) * math.sqrt(2 / count)) / 10
    )
    error = slopes.mean() / gain - 1
    measured(abs(error), at_most=gate, what="gain")
    line = np.polyfit(levels, means[1:], 1)
    departure = np.abs(means[1:] - np.polyval(line, levels)).max()
    measured(departure / top, at_most=6 * math.sqrt(variances.max() / count) / top, what="linearity")


def test_rounding_has_no_offset_and_flooring_would_show(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dark frames of a camera with 1.5 DN of noise: the black level is the mean to 5 deviations; floored, 0.5 DN less.

    The black level is no whole number, so that a level rounded on its own would show too.
    """
    model = sensor(bits=12, read_noise_e=3.0, gain_dn_per_e=0.5, black_level_dn=100.3)
    gate = 5 * math.sqrt((1.5**2 + 1 / 12) / 250_000)
    assert gate < 0.02
    assert exposed(model, 0.0, 250_000, "round").mean() == pytest.approx(100.3, abs=gate)

    quantise = chain.quantise

    def floored(signal_dn: Any, which: Any) -> Any:
        return quantise(signal_dn - 0.5, which)

    monkeypatch.setattr(chain, "quantise", floored)
    assert exposed(model, 0.0, 250_000, "round").mean() == pytest.approx(99.8, abs=gate)


def test_a_superpixel_is_rounded_once() -> None:
    """Binned 8 x 8: 1/12 DN^2 once. Rounding every pixel would add 64/12, twelve times its noise."""
    model = sensor(binning=8, read_noise_e=0.6, gain_dn_per_e=0.5, black_level_dn=10.0, bits=12)
    count = 200_000
    frame = exposed(model, 0.0, count, "binned")
    expected = (8 * 0.6 * 0.5) ** 2 + 1 / 12
    assert frame.var() == pytest.approx(expected, rel=5 * math.sqrt(2 / count))
    assert 50 * expected * math.sqrt(2 / count) < 63 / 12


def test_electrons_are_whole_below_a_well_that_is_not() -> None:
    """Drawn as counts, then cut at 10.5 of them: no other fraction occurs."""
    values = exposed(sensor(full_well_e=10.5), 9.0, 5000, "whole")
    assert set(np.unique(values)) <= {*range(11), 10.5} and (values == 10.5).any()


# ---- saturation


def exposer(**changes: object) -> Exposer:
    return Exposer(SimpleNamespace(sensor=sensor(**changes)), 1.0, SEED)  # type: ignore[arg-type]


@pytest.mark.parametrize("well", [0.5, 3.0, 10.0])
@pytest.mark.parametrize("bits", [None, 12])
def test_read_noise_above_a_small_full_well_is_no_saturation(well: float, bits: int | None) -> None:
    """Read noise of 20 electrons reads above the well in half of all pixels, in the dark as well."""
    camera = exposer(full_well_e=well, read_noise_e=20.0, bits=bits, black_level_dn=500.0)
    dark, light = np.zeros((64, 64)), np.full((64, 64), 1.0 + 2 * well)
    frame = camera.digital(dark, "dark")
    assert frame.max() > 500 + well and not camera.saturates(frame, dark)
    assert camera.saturates(camera.digital(light, "light"), light)


def test_saturation_is_seen_where_it_is() -> None:
    shape = (64, 64)
    for changes, mean, expected in (
        ({}, 700.0, False),  # 9 deviations below the well
        ({}, 1000.0, True),
        ({"full_well_e": math.inf}, 1e12, False),
        ({"full_well_e": math.inf, "bits": 8}, 300.0, True),
        ({"full_well_e": math.inf, "bits": 8}, 100.0, False),
        ({"bits": 1}, 5.0, True),  # a 1 is the ADC's end
        ({"bits": 1}, 0.0, False),
        ({"dark_current_e_per_s": 1500.0}, 0.0, True),
        ({"dark_current_e_per_s": 1500.0, "prnu_pixel": 0.01}, 0.0, True),
    ):
        camera, light = exposer(**changes), np.full(shape, mean)
        assert camera.saturates(camera.digital(light, "any"), light) == expected, (changes, mean)


# ---- refusals


@pytest.mark.parametrize(
    ("bits", "binning", "fits"), [(16, 64, True), (20, 64, True), (21, 64, False), (24, 17, False)]
)
def test_codes_that_a_frame_cannot_hold_are_refused(bits: int, binning: int, fits: bool) -> None:
    """uint32 wraps at 2^32: 21 bits binned 64 x 64 would have stored 2^33 - 4096 as 4294963200 or 0."""
    fields = {**sensor().model_dump(), "bits": bits, "binning": binning, "full_well_e": 1e9}
    if not fits:
        with pytest.raises(MitsimError, match=r"^[^\n]*at most 4294967295, so bin less[^\n]*$"):
            validate(SensorModel, fields, "camera.toml")
        return
    model = validate(SensorModel, fields, "camera.toml")
    assert (exposed(model, 1e14, 8) == (2**bits - 1) * binning**2).all()


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0, 1e13, 1e300])
@pytest.mark.parametrize("field", ["pixel_pitch_um", "read_noise_e", "dark_current_e_per_s", "gain_dn_per_e"])
def test_numbers_beyond_all_cameras_are_refused_in_one_line(field: str, value: float) -> None:
    fields = {**load_sensor(shipped_path("calibration", "imx249.toml")).model_dump(), field: value}
    with pytest.raises(MitsimError, match=rf"^camera\.toml: {field}: got [^\n]+$"):
        validate(SensorModel, fields, "camera.toml")


@pytest.mark.parametrize("seconds", [math.nan, math.inf, -1.0])
def test_times_that_cannot_be_are_refused(seconds: float) -> None:
    with pytest.raises(ValueError, match="exposure_s is"):
        chain.electrons_from_irradiance([1.0], seconds, sensor(), 550.0)


# ---- Moments of frames ----


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


@settings(max_examples=200, deadline=None, derandomize=True)
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
