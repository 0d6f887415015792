"""Estimators of EMVA 1288 on frames whose statistics are known without them."""

import math

import numpy as np
import pytest

from mitsim.core.seeds import stream
from mitsim.sensor.emva import Session, Stack, alike, figures


def test_a_pair_s_variance_is_free_of_what_is_fixed_and_of_drift() -> None:
    """(Planted: the drift's square left in; the variance of a difference not halved.)"""
    rng = stream(1, "pair")
    fixed = rng.normal(0, 50, (200, 300))
    first, second = (fixed + drift + rng.normal(0, 2, fixed.shape) for drift in (0.0, 3.0))
    pair = alike((first, second))
    assert pair.variance == pytest.approx(4, rel=5 * np.sqrt(2 / fixed.size))
    assert pair.rows == pytest.approx(0, abs=5 * 4 / 300 * np.sqrt(2 / 200))
    assert pair.mean == pytest.approx((first.mean() + second.mean()) / 2)


def test_statistics_of_frames_are_numpys_of_their_stack() -> None:
    """Five small frames whose light drifts and whose rows share noise, as one array: means over pixels, rows and frames
    by numpy. The scatter of the light is that of means beyond what noise of pixels and rows leaves in them. The error
    of the variance has the spread between pixels, and rows' noise, which moves all pixels of a row together.
    Neighbours are correlated in the last difference without its rows and columns. (Planted: each term left out, added
    in place of subtracted, or with another degree of freedom.)"""
    count, m, n = 5, 7, 9
    rng = stream(5, "stack")
    light = 40 + 6 * np.arange(count)[:, None, None] + rng.normal(0, 3, (count, m, 1))
    frames = np.clip(np.rint(light + rng.normal(0, 5, (count, m, n))), 0, 63)
    frames[0, 0, 0], frames[1, :2, 0] = 0, 63
    found, means = alike(frames, 63), frames.mean(axis=(1, 2))
    off = frames - means[:, None, None]
    variance = off.var(axis=0, ddof=1).sum() / (m * n - 1)
    rows = (off.mean(axis=2).var(axis=0, ddof=1).sum() / (m - 1) - variance / n) * n / (n - 1)
    own = variance - rows
    flicker = math.sqrt(means.var(ddof=1) - own / (m * n) - rows / m)
    square = off.var(axis=0, ddof=1).var() + (4 * own * rows + 2 * rows**2 * n) / (count - 1)
    last = off[-1] - off[-2]
    last -= last.mean(axis=1, keepdims=True)
    last -= last.mean(axis=0)
    pairs = (last[:, 1:], last[:, :-1]), (last[1:], last[:-1])
    beside, below = ((one * other).mean() / np.square(last).mean() for one, other in pairs)
    assert rows > 1 and own > 1 and flicker > 5
    expected = {
        "mean": frames.mean(), "variance": variance, "rows": rows, "flicker": flicker,
        "variance_error": math.sqrt(square / (m * n)), "mean_error": math.sqrt((own / (m * n) + rows / m) / count),
    }  # fmt: skip
    for name, value in expected.items():
        assert getattr(found, name) == pytest.approx(value, rel=1e-9), name
    assert found.neighbours == pytest.approx((beside, below), rel=1e-9)
    assert found.cut == pytest.approx((np.mean(frames <= 0), np.mean(frames >= 63))) and min(found.cut) > 0


def test_noise_that_rows_share_is_told_from_the_pixels_own() -> None:
    rng = stream(2, "rows")
    frames = [rng.normal(0, 3, (400, 1)) + rng.normal(0, 2, (400, 100)) for _ in range(2)]
    assert alike(frames).rows == pytest.approx(9, rel=5 * np.sqrt(2 / 400))


def test_a_stack_tells_rows_columns_and_pixels_apart() -> None:
    """Three parts of known mean squares, exact to (M + N)/MN."""
    rng = stream(3, "stack")
    rows, columns, pixels = rng.normal(0, 3, (60, 1)), rng.normal(0, 2, (1, 80)), rng.normal(0, 4, (60, 80))
    pixels -= pixels.mean(axis=0)
    pixels -= pixels.mean(axis=1, keepdims=True)
    image = rows + columns + pixels
    still = alike([image, image]).stack.parts((60, 80))
    exact = rows.var() + columns.var() + pixels.var(), rows.var(), columns.var(), pixels.var()
    # Made without means, pixels have none in rows, where as many of random ones would leave 1/N of their variance.
    np.testing.assert_allclose(still, exact, rtol=0.06)


def test_what_noise_leaves_in_the_mean_of_a_stack_is_taken_off_all_its_parts() -> None:
    """Frames of noise alone: sigma^2/L of it is left in their mean, 1/N of that in rows and 1/M in columns.

    A mean of n squares is known to sqrt(2/n), five of which are a quarter to a third of what is taken off. (Planted:
    rows' part N^2 times as large; any one of the three not taken off.)
    """
    rng, shape, count = stream(4, "noise"), (400, 300), 4
    found = alike(rng.normal(0, 3, shape) for _ in range(count)).stack
    left = 9 / count
    for name, part, size in (("total", 1, 400 * 300), ("rows", 300, 400), ("columns", 400, 300)):
        assert getattr(found, name) == pytest.approx(0, abs=5 * left / part * np.sqrt(2 / size)), name


def test_figures_of_an_ideal_camera_are_its_numbers() -> None:
    """Statistics by the linear model's own formulas, no frame: K 0.5, eta 0.4, sigma_d 3, saturation at 9000."""
    gain, efficiency, read, full, dark = 0.5, 0.4, 3.0, 9000.0, 7.0
    electrons = np.linspace(200, 10_000, 50)
    light = np.minimum(electrons, full)
    variance = np.where(electrons < full, electrons, 0) * gain**2 + gain**2 * read**2 + 1 / 12
    times = np.linspace(0, 10, 6)
    still, rows = np.full(6, gain**2 * read**2 + 1 / 12), np.asarray(gain**2 * 2.5)
    spatial = {"total": 14.0, "row": 4.0, "column": 1.0}

    def stack(light: float) -> Stack:
        each = {name: part * gain**2 + (0.01 * light) ** 2 * part / 14 for name, part in spatial.items()}
        pixel = each["total"] - each["row"] - each["column"]
        size = 100 * 200
        left = pixel * (size - 300) / size
        rows, columns = each["row"] + pixel / 200, each["column"] + pixel / 100
        return Stack(np.asarray(100 + light), np.asarray(rows + columns + left), np.asarray(rows), np.asarray(columns))

    session = Session(
        shape=(100, 200),
        photons=np.concatenate([electrons / efficiency, np.zeros(6)]),
        exposure_s=np.concatenate([np.zeros(50), times]),
        mean=np.concatenate([100 + gain * light, 100 + gain * dark * times]),
        variance=np.concatenate([variance, still + gain**2 * dark * times]),
        rows=np.concatenate([np.zeros(50), [rows], np.zeros(5)]),
        dark=50,
        bright=25,
        dark_stack=stack(0.0),
        bright_stack=stack(2000.0),
    )
    found = figures(session)
    expected = {
        "system_gain": gain, "quantum_efficiency": efficiency, "dark_noise": read, "full_well": full,
        "saturation_capacity": electrons[electrons < full].max(),
        "dark_current": dark, "dark_current_by_variance": dark,
        "dsnu_row": 4.0, "dsnu_column": 1.0, "dsnu_pixel": 9.0, "prnu_row": 0.01**2 * 4 / 14,
        "prnu_pixel": 0.01**2 * 9 / 14, "row_noise": 2.5, "linearity_min": 0.0, "linearity_max": 0.0,
    }  # fmt: skip
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, rel=1e-9, abs=1e-12), name


def test_linearity_is_the_least_and_the_largest_relative_deviation() -> None:
    """A square term of 2 % at saturation, against numpy's weighted fit of the same points."""
    photons = np.linspace(100, 10_000, 50)
    signal = photons * (1 - 0.02 * photons / 10_000)
    variance = np.append(np.linspace(1, 50, 49), 0.0)
    zero = Stack(*(np.ones(()) for _ in range(4)))
    sets = [np.append(part, 0.0) for part in (photons, 0 * photons, signal, variance, 0 * signal)]
    bright = Stack(np.full((), 2.0), np.ones(()), np.ones(()), np.ones(()))
    session = Session((9, 9), sets[0], sets[1], *sets[2:], 50, 25, zero, bright)
    found = figures(session)
    used = (signal >= 0.05 * signal[48]) & (signal <= 0.95 * signal[48])
    line = np.polynomial.polynomial.polyfit(photons[used], signal[used], 1, w=1 / signal[used])
    off = signal[used] / (line[0] + line[1] * photons[used]) - 1
    assert found["linearity_min"] == pytest.approx(off.min(), rel=1e-6)
    assert found["linearity_max"] == pytest.approx(off.max(), rel=1e-6)


def test_missing_codes_make_a_pattern_of_known_amplitude() -> None:
    """floor(1.5 n) leaves two of three codes, of amplitude |1 + w| / 2 = 1/2; bit 2 at 0 one of 1 / (4 sin(pi/8)).

    (Planted: the power of the pattern in place of its amplitude.)
    """
    noisy = [np.rint(np.random.default_rng(k).normal(1000, 12, (64, 64))) for k in range(2)]
    assert alike(noisy, 4095).comb[0] < 6 / 64
    for read, amplitude, period in (
        (lambda frame: np.floor(1.5 * frame), 0.5, 3.0),
        (lambda frame: frame - 4 * ((frame // 4) % 2), 1 / (4 * math.sin(math.pi / 8)), 8.0),
    ):
        found = alike([read(frame) for frame in noisy], 4095).comb
        assert found[0] == pytest.approx(amplitude, abs=3 / 64) and found[1] == pytest.approx(period, rel=0.01)
    assert alike(noisy).comb == (0.0, 1.0)  # real numbers have no codes
    assert len({*alike(noisy, 4095).digests}) == 2 and alike([np.ones((16, 16))] * 2).digests == (b"", b"")
