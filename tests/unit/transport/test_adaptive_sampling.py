"""Blocks that are followed more often: the light stays, its noise moves; numbers from moments."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import open_bench
from mitsim.transport.integrator import adaptive_counts, by_pixel, effect_of
from tests.unit.transport.test_path_reuse import SCENES, SIGMAS, summed, tracers

pytestmark = pytest.mark.usefixtures("variant")
N, SEEDS = 18, 8
BLOCKS = 5
"""Blocks a side of 18 pixels: the last are of two pixels."""


@pytest.mark.slow
@pytest.mark.parametrize("shared", [False, True])
def test_repeated_light_is_the_same_light(shared_scene: Callable[..., Path], shared: bool) -> None:
    """Of each class of pixels, how much and from where, whatever the repeats; and less noise where there are more.

    (Planted: light that is not divided by the repeats, and turns of a block that share a sample's numbers.)
    """
    bench = open_bench(shared_scene(f"repeated {shared}", extra=SCENES["matt walls"], n=N))
    repeats = np.random.default_rng(2).choice([1, 2, 5], BLOCKS**2)
    plain = tracers(bench)[shared]
    again = plain.with_adaptive_counts(repeats.tolist())
    paths_per_sample = repeats.sum() * 16 if shared else by_pixel(repeats.tolist(), N).sum()
    assert again.paths_per_sample == paths_per_sample
    runs = [[side.trace(seed, 0, 256) for seed in range(SEEDS)] for side in (plain, again)]
    found = np.array([[summed(run, 256, N) for run in side] for side in runs])
    means, errors = found.mean(axis=1), found.std(axis=1, ddof=1) / np.sqrt(SEEDS)
    bound = SIGMAS * np.hypot(*errors)
    assert (np.abs(means[0] - means[1]) <= bound).all() and bound[0].sum() < 0.2 * means[0, 0].sum()
    each = [[np.bincount(run.pixel, run.value, N * N) for run in side] for side in runs]
    variance = np.var(each, axis=1).reshape(2, -1)
    for count in (1, 2, 5):
        such = by_pixel(repeats.tolist(), N) == count
        assert variance[1][such].sum() == pytest.approx(variance[0][such].sum() / count, rel=0.45), count


def test_repeats_leave_less_variance_for_the_cost() -> None:
    """Half of the blocks a hundred times as noisy: (1 + 10)^2 / (2 (1 + 100)) = 0.6 of variance times cost at best."""
    moments = np.ones((16, 16))
    moments[:, :8] = 100.0
    repeats = adaptive_counts(moments)
    variance, paths = effect_of(repeats, moments)
    assert variance * paths < 0.72
    assert repeats[:, :6].min() > 2 * repeats[:, 10:].max()
    assert set(adaptive_counts(np.ones((8, 8))).ravel()) == set(adaptive_counts(np.zeros((8, 8))).ravel()) == {1}
    assert effect_of(repeats, np.zeros((16, 16)))[0] == 1.0
