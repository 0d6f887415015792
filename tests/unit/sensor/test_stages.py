"""Each stage that a camera may name: drawn frames against their closed-form mean and variance, and bit-equal without.

Gates are normal or chi-square quantiles of 1e-6 in all for each case; seeds are fixed.
"""

import math

import numpy as np
import pytest
from scipy import stats

from mitsim.core.seeds import stream
from mitsim.devices.sensor import SensorModel
from mitsim.sensor import chain
from mitsim.sensor.chain import dark_current_variance, mean_dark_current, neighbours, response_variance, specimen
from tests.invented import sensor

SEED = 1288
FRAMES, SIDE, EXPOSURE_S = 200, 24, 2.0
GATE = 1e-6 / 3
BASE: dict[str, object] = {
    "full_well_e": 2000.0, "read_noise_e": 3.0, "gain_dn_per_e": 1.5, "black_level_dn": 100.0, "bits": 12,
    "dark_current_e_per_s": 20.0,
}  # fmt: skip
STAGES: dict[str, dict[str, object]] = {
    "dark current with temperature": {"dark_current_temperature_c": 25, "dark_doubling_c": 8, "temperature_c": 41},
    "dark current spread": {"dark_current_spread_e_per_s": 8.0},
    "offsets": {"dsnu_pixel_e": 6.0, "dsnu_row_e": 3.0, "dsnu_column_e": 4.0},
    "response": {"prnu_pixel": 0.03, "prnu_row": 0.01, "prnu_column": 0.02},
    "row noise": {"row_noise_e": 5.0},
    "defects": {"hot_pixels": 0.02, "hot_dark_current_e_per_s": 300.0, "dead_pixels": 0.01},
    "linearity": {"linearity": (-0.08, 0.03)},
    "crosstalk": {"crosstalk": 0.2},
    "binned on chip": {"binning": 2, "binning_on_chip": True, "binned_full_well_e": 3000.0, "prnu_pixel": 0.05},
    "binned after": {"binning": 2, "dsnu_row_e": 2.0, "row_noise_e": 2.0, "crosstalk": 0.1},
    "cut at black": {"dsnu_pixel_e": 40.0, "black_level_dn": 20.0},
    "linearity at the well": {"linearity": (-0.1,), "full_well_e": 900.0},
    "all": {
        "dark_current_spread_e_per_s": 8.0, "dsnu_pixel_e": 6.0, "dsnu_column_e": 3.0, "prnu_pixel": 0.03,
        "row_noise_e": 2.0, "dead_pixels": 0.01, "linearity": (0.05,), "crosstalk": 0.1,
    },
}  # fmt: skip


def camera(**changes: object) -> SensorModel:
    return sensor(**{**BASE, **changes})


def light() -> np.ndarray:
    """A frame from dark to 900 electrons that is no product and changes from pixel to pixel."""
    row, column = np.mgrid[:SIDE, :SIDE]
    return np.asarray(900.0 * ((row * 7 + column * 5 + row * column) % 23) / 22)


def frames(model: SensorModel, expected: np.ndarray, count: int = FRAMES, exposure_s: float = EXPOSURE_S) -> np.ndarray:
    drawn = (
        chain.expose(expected, exposure_s, model, stream(SEED, "shot", index), stream(SEED, "read", index))
        for index in range(count)
    )
    return np.stack([np.asarray(frame, dtype=np.float64) for frame in drawn])


@pytest.mark.parametrize("name", STAGES)
def test_drawn_frames_have_the_closed_form_mean_and_variance_of_every_pixel(name: str) -> None:
    """Pixel by pixel, means and variances over 200 frames: sums of squares of z-scores, and their mean.

    A row's noise makes means of its pixels dependent: then the row's noise is taken off by the row's own mean, and the
    sum of squares has as many degrees of freedom less. (Planted: offsets 1.2 times as large; linearity before the well,
    and 5 % off; row noise of one pixel in a superpixel, and left out of the variance; its variance not that of the
    polynomial; offsets at the ADC's end taken for 0.)
    """
    model = camera(**STAGES[name])
    drawn = frames(model, light())
    mean, variance = chain.frame_moments(light(), EXPOSURE_S, model)
    noisy = variance > 0
    z = np.zeros_like(mean)
    z[noisy] = (drawn.mean(axis=0) - mean)[noisy] * np.sqrt(FRAMES / variance[noisy])
    own = variance - (model.superpixel_row_noise_e * model.gain_dn_per_e) ** 2
    if model.row_noise_e:
        # What a row shares: its mean over the row is its own test, and the rest is free of it.
        weight = np.where(own > 0, 1 / np.maximum(own, 1e-9), 0)
        off = drawn.mean(axis=0) - mean
        shared = (off * weight).sum(axis=1, keepdims=True) / weight.sum(axis=1, keepdims=True)
        spread = (model.superpixel_row_noise_e * model.gain_dn_per_e) ** 2 + 1 / weight.sum(axis=1)
        assert stats.chi2.sf((shared[:, 0] ** 2 / spread * FRAMES).sum(), SIDE) > GATE
        z = (off - shared) * np.sqrt(FRAMES * weight)
        assert two_sided((z**2).sum(), z.size - SIDE) > GATE
    else:
        assert two_sided((z**2).sum(), int(noisy.sum())) > GATE
        assert 2 * stats.norm.sf(abs(z.sum()) / math.sqrt(noisy.sum())) > GATE
    ratio = drawn.var(axis=0, ddof=1)[noisy] / variance[noisy]
    fourth = ((drawn - drawn.mean(axis=0)) ** 4).mean(axis=0)[noisy] / variance[noisy] ** 2
    # Variances of a row's pixels share the row's noise: correlation of squares is the square of that of the noise.
    shared_part = 1 - own[noisy] / variance[noisy]
    error = math.sqrt(((fourth - 1) / FRAMES).mean() / ratio.size + 2 * np.square(shared_part).mean() / FRAMES / SIDE)
    assert abs(ratio.mean() - 1) < stats.norm.isf(GATE / 2) * error
    assert (drawn[:, ~noisy] == mean[~noisy]).all()


def two_sided(statistic: float, freedom: int) -> float:
    return float(2 * min(stats.chi2.sf(statistic, freedom), stats.chi2.cdf(statistic, freedom)))


def test_row_noise_leaves_other_draws_as_they_were() -> None:
    """A row's noise has a stream of its own: taken off, it leaves the frame without it, and fixed offsets leave it.

    (Planted: rows as long as there are rows; the noise of a camera with offsets taken off, not added.)
    """
    expected = np.full((SIDE, SIDE + 6), 100.0)
    noises = []
    for offsets in ({}, {"dsnu_pixel_e": 6.0}):
        plain, noisy = (frames(camera(row_noise_e=noise, bits=None, **offsets), expected, 30) for noise in (0.0, 4.0))
        noises.append(noisy - plain)
        rows = noises[-1].mean(axis=2)  # 720 of them, of 6 DN, each apart from the next one
        assert noises[-1].std(axis=2).max() < 1e-9 and rows.std() == pytest.approx(6, rel=5 / math.sqrt(2 * rows.size))
        assert abs((rows[:, 1:] * rows[:, :-1]).mean()) < 5 * rows.var() / math.sqrt(rows.size)
    np.testing.assert_allclose(noises[1], noises[0], rtol=0, atol=1e-9)


def test_a_camera_without_effects_makes_no_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("specimen", "neighbours"):
        monkeypatch.setattr(chain, name, lambda *_: pytest.fail("a map was asked for"))
    frames(camera(), np.full((4, 4), 10.0), 1)
    chain.mean_variance(np.full((4, 4), 10.0), 1.0, camera())


# ---- what is fixed in space


@pytest.mark.parametrize(("binning", "on_chip"), [(1, False), (2, False), (2, True)])
def test_offsets_have_the_set_deviations_by_pixel_row_and_column(binning: int, on_chip: bool) -> None:
    """Split as EMVA 1288 4.0 splits them; a deviation of n values is known to 1/sqrt(2n), 5 of these are allowed.

    b^2 readings of a superpixel: a pixel's own add to b, those that a row shares to b^1.5; on chip there is one.
    """
    offsets = {"dsnu_pixel_e": 6.0, "dsnu_row_e": 3.0, "dsnu_column_e": 4.0}
    model = camera(binning=binning, binning_on_chip=on_chip, **offsets, bits=None)
    side = 300
    offset = specimen(model, (side, side)).offset_e
    assert offset is not None
    row, column = offset.mean(axis=1), offset.mean(axis=0)
    pixel = offset - row[:, None] - column[None, :] + offset.mean()
    readings = 1 if on_chip else binning
    for found, per_pixel, power in ((pixel.std(), 6.0, 1.0), (row.std(), 3.0, 1.5), (column.std(), 4.0, 1.5)):
        of = side**2 if power == 1 else side
        averaged = (6.0 * readings) ** 2 / side if power == 1.5 else 0.0
        expected = math.hypot(per_pixel * readings**power, math.sqrt(averaged))
        assert found == pytest.approx(expected, rel=5 / math.sqrt(2 * of) + 1 / side)


def test_responses_and_dark_currents_have_the_set_mean_and_variance() -> None:
    """Of 300 x 300 superpixels; gamma variates have an excess kurtosis of 6/k. Five standard errors."""
    side = 300
    parts = camera(binning=4, prnu_pixel=0.04, prnu_row=0.02, prnu_column=0.01).response_parts
    assert parts == pytest.approx((0.01, 0.01, 0.005))
    model = camera(
        binning=2, prnu_pixel=0.04, dead_pixels=0.02, dark_current_spread_e_per_s=10.0, hot_pixels=0.01,
        hot_dark_current_e_per_s=200.0, dark_current_temperature_c=20, dark_doubling_c=7, temperature_c=34,
    )  # fmt: skip
    assert model.dark_factor == pytest.approx(4)
    own = specimen(model, (side, side))
    assert own.response is not None and own.dark_e_per_s is not None
    assert own.response.mean() == pytest.approx(0.98, abs=5 * math.sqrt(response_variance(model)) / side)
    pairs = (own.response, response_variance(model)), (own.dark_e_per_s, dark_current_variance(model))
    for values, variance in pairs:
        off = (values - values.mean()) ** 2
        assert off.mean() == pytest.approx(variance, abs=float(5 * off.std() / side))
    error = math.sqrt(dark_current_variance(model)) / side
    assert own.dark_e_per_s.mean() == pytest.approx(mean_dark_current(model), abs=5 * error)
    assert own.dark_e_per_s.min() >= 0
    # Of 360 000 pixels 7200 are dead, nearly each in a superpixel of its own: 1 - 0.98^4 of them.
    assert own.dead == pytest.approx(side**2 * (1 - 0.98**4), rel=0.01)
    assert own.hot == pytest.approx(side**2 * (1 - 0.99**4), rel=0.01)


def test_a_specimen_is_the_same_in_every_shot_and_another_by_its_own_seed() -> None:
    models = [camera(dsnu_pixel_e=5.0, prnu_pixel=0.02, pattern_seed=seed) for seed in (0, 0, 1)]
    first, again, other = (specimen(model, (20, 30)) for model in models)
    assert np.array_equal(first.offset_e, again.offset_e) and not np.array_equal(first.offset_e, other.offset_e)
    assert not np.array_equal(first.response, other.response)
    # Another effect changes none of the maps.
    more = specimen(camera(dsnu_pixel_e=5.0, prnu_pixel=0.02, dead_pixels=0.1), (20, 30))
    assert np.array_equal(first.offset_e, more.offset_e)


def test_dead_pixels_see_no_light_and_hot_ones_more_dark_current() -> None:
    model = camera(dead_pixels=0.1, hot_pixels=0.1, hot_dark_current_e_per_s=100.0, read_noise_e=0.0, bits=None)
    own = specimen(model, (30, 30))
    mean, _ = chain.frame_moments(np.full((30, 30), 500.0), 2.0, model)
    hot = own.dark_e_per_s > 20
    dead = own.response == 0
    assert dead.sum() == own.dead == 90 and hot.sum() == own.hot == 90
    expected = (np.where(dead, 0, 500) + np.where(hot, 240, 40)) * 1.5 + 100
    np.testing.assert_allclose(mean, expected)
    # A tenth of the pixels to the last one, each a superpixel: variances over them are p (1 - p) of a square exactly.
    assert own.response.var() == pytest.approx(response_variance(model), rel=1e-5)
    assert own.dark_e_per_s.var() == pytest.approx(dark_current_variance(model), rel=1e-5)


def test_crosstalk_shares_light_with_four_neighbours_and_keeps_it() -> None:
    spot = np.zeros((5, 5))
    spot[2, 2] = 100.0
    shared = neighbours(spot, 0.2)
    assert shared[2, 2] == 80 and shared[1, 2] == shared[2, 1] == shared[3, 2] == shared[2, 3] == 5
    assert shared.sum() == pytest.approx(100)
    np.testing.assert_allclose(neighbours(np.full((4, 6), 3.0), 0.4), 3.0)
    # Of a superpixel's light that of the pixels at its sides is shared: 1/b of it.
    model = camera(binning=4, crosstalk=0.2, dark_current_e_per_s=0.0)
    assert chain.mean_electrons(spot, 1.0, model)[0][2, 2] == pytest.approx(95)


# ---- linearity


@pytest.mark.parametrize("mean", [0.0, 0.3, 20.0, 900.0])
@pytest.mark.parametrize("coefficients", [(-0.3,), (0.1, -0.2, 0.05, 0.1)])
def test_moments_of_a_polynomial_of_counts_equal_their_sum(mean: float, coefficients: tuple[float, ...]) -> None:
    model = camera(linearity=coefficients, full_well_e=1e4)
    counts = np.arange(3000.0)
    weights = stats.poisson.pmf(counts, mean)
    read = chain.bend(counts, model)
    first = weights @ read
    found = chain.bent_moments(np.array([mean]), model)
    assert found[0][0] == pytest.approx(first, rel=1e-10, abs=1e-12)
    assert found[1][0] == pytest.approx(weights @ (read - first) ** 2, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("bits", [None, 12])
@pytest.mark.parametrize("mean", [40.0, 850.0, 900.0, 1000.0])
def test_moments_of_a_bent_full_well_equal_the_sum_over_counts(mean: float, bits: int | None) -> None:
    """A polynomial of min(N, F), then 4.5 DN of read noise, which dithers codes: 1/12 DN^2 where there are any.

    (Planted: mean and variance of a reading without codes exchanged.)
    """
    model = camera(linearity=(-0.1,), full_well_e=900.0, bits=bits, dark_current_e_per_s=0.0)
    counts = np.arange(3000.0)
    weights = stats.poisson.pmf(counts, mean)
    read = chain.bend(np.minimum(counts, 900.0), model) * 1.5 + 100
    first = weights @ read
    second = weights @ (read - first) ** 2 + 4.5**2 + (1 / 12 if bits else 0)
    found = chain.frame_moments(np.array([mean]), 0.0, model)
    assert found[0][0] == pytest.approx(first, rel=1e-9)
    assert found[1][0] == pytest.approx(second, rel=1e-8)


# ---- binning on chip


def test_charge_that_is_binned_on_chip_is_read_once() -> None:
    after, on_chip = (camera(binning=2, binning_on_chip=chip, row_noise_e=1.0) for chip in (False, True))
    assert (after.superpixel_read_noise_e, on_chip.superpixel_read_noise_e) == (6.0, 3.0)
    assert after.superpixel_row_noise_e == pytest.approx(2**1.5) and on_chip.superpixel_row_noise_e == 1.0
    assert (after.superpixel_black_level_dn, on_chip.superpixel_black_level_dn) == (400.0, 100.0)
    assert (after.largest_dn, on_chip.largest_dn) == (4 * 4095, 4095)
    assert after.superpixel_full_well_e == on_chip.superpixel_full_well_e == 8000
    assert after.superpixel_dark_current_e_per_s == on_chip.superpixel_dark_current_e_per_s == 80


@pytest.mark.parametrize("name", ["offsets", "row noise", "crosstalk"])
def test_pixels_that_differ_need_a_frame(name: str) -> None:
    with pytest.raises(ValueError, match="rows and columns"):
        frames(camera(**STAGES[name]), np.full(16, 10.0), 1)
