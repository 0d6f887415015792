"""Light beside the centres of its pixels, against factors that are moved."""

import numpy as np
import pytest

from mitsim.reconstruct.noise import moved_responses
from mitsim.reconstruct.solver import prepare


def test_moved_light_is_seen_by_the_difference_of_neighbours() -> None:
    """A response that grows evenly from pixel to pixel changes by one step everywhere."""
    rng = np.random.default_rng(4)
    first, step, patterns = rng.random((12, 1)), rng.random((12, 1)), rng.random((5, 2))
    factor = first + step * np.arange(5)
    side = prepare(factor, factor, patterns, patterns).left
    expected = np.zeros((5, len(side.singular)))
    for pattern, slab in zip(patterns.T, side.slabs, strict=True):
        expected[:, slab.columns] += np.outer(pattern, step[:, 0] @ slab.matrix)
    assert moved_responses(side, factor, patterns) == pytest.approx(expected, abs=1e-12)


def test_a_single_pixel_has_no_neighbour() -> None:
    factor, one = np.random.default_rng(5).random((6, 1)), np.ones((1, 1))
    assert not moved_responses(prepare(factor, factor, one, one).left, factor, one).any()
