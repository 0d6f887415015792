"""Random numbers of the tracer: stratified in their first two dimensions, unbiased, and independent between streams.

Gates on random quantities are five standard deviations of what uniform numbers would give, at fixed seeds.
"""

import mitsuba as mi
import numpy as np
import pytest

from mitsim.transport.plugins.base import generator, shuffle, sobol_point

pytestmark = pytest.mark.usefixtures("variant")
SIGMAS = 5.0


def points(samples: int, streams: int = 1, seed: int = 7, first: int = 0) -> np.ndarray:
    """(streams, samples, 2) points ``first``.. of some streams of one seed."""
    lane = np.arange(streams * samples)
    index, stream = mi.UInt32(first + lane % samples), mi.UInt32(lane // samples)
    found = sobol_point(index, generator(mi.UInt32(seed), stream))
    return np.stack([np.array(found.x), np.array(found.y)], axis=1).reshape(streams, samples, 2).astype(np.float64)


@pytest.mark.parametrize("power", [0, 1, 3, 4, 7, 10])
@pytest.mark.parametrize("seed", [0, 12345])
def test_every_prefix_is_a_net(power: int, seed: int) -> None:
    """2^k points put one in each box of every partition into 2^j x 2^(k-j) equal boxes: a (0, 2)-sequence in base 2."""
    count = 2**power
    for found in points(count, streams=5, seed=seed):
        assert found.min() >= 0 and found.max() < 1
        for j in range(power + 1):
            across = np.floor(found[:, 0] * 2**j).astype(int)
            along = np.floor(found[:, 1] * 2 ** (power - j)).astype(int)
            boxes = across * 2 ** (power - j) + along
            assert len(np.unique(boxes)) == count, f"boxes of 2^-{j} x 2^-{power - j}"


def test_streams_dimensions_and_seeds_are_independent() -> None:
    """Correlations of the first point between neighbouring streams, its two dimensions, and neighbouring seeds."""
    streams = 2**14
    found, other = points(1, streams)[:, 0], points(1, streams, seed=8)[:, 0]
    gate = SIGMAS / np.sqrt(streams)
    assert abs(np.corrcoef(found[:, 0], found[:, 1])[0, 1]) < gate
    for axis in (0, 1):
        assert abs(np.corrcoef(found[1:, axis], found[:-1, axis])[0, 1]) < gate
        assert abs(np.corrcoef(found[:, axis], other[:, axis])[0, 1]) < gate


def test_an_average_over_a_step_converges_faster_than_random_points() -> None:
    """A corner of a cell in another pixel: 256 points leave below a fifth of sqrt(p (1 - p) / 256)."""
    found = points(256, streams=512)
    inside = (found[..., 0] + 0.4 * found[..., 1] < 0.7).mean(axis=1)
    assert inside.mean() == pytest.approx(0.5, abs=SIGMAS * inside.std() / np.sqrt(512))
    assert inside.std() < 0.2 * np.sqrt(0.25 / 256)


def test_two_pairs_of_dimensions_pad_to_four() -> None:
    """Shuffled, 64 points of each stream are a net as before, and tell nothing of the unshuffled pair of dimensions.

    Over 256 streams no product of one dimension of each pair has a mean beyond its five deviations. (Planted: the same
    order for both pairs.)
    """
    streams, samples = 256, 64
    lane = np.arange(streams * samples)
    index, rng = mi.UInt32(lane % samples), generator(mi.UInt32(7), mi.UInt32(lane // samples))
    first, second = sobol_point(index, rng), sobol_point(shuffle(index, rng), rng)
    pairs = [np.stack([np.array(p.x), np.array(p.y)], axis=1).reshape(streams, samples, 2) for p in (first, second)]
    for found in pairs[1]:
        assert len(np.unique(np.floor(found * 8).astype(int) @ [8, 1])) == samples
    for a in (0, 1):
        for b in (0, 1):
            for power in (1, 2, 4):  # coarse structure shared by both pairs
                cells = [
                    np.floor(part[..., axis] * 2**power) % 2 - 0.5 for part, axis in zip(pairs, (a, b), strict=True)
                ]
                product = (cells[0] * cells[1]).mean(axis=1)
                assert abs(product.mean()) < SIGMAS * 0.25 / np.sqrt(streams * samples)
