"""What an image is predicted to take, from sizes: worked out by hand, each figure of the module by itself."""

from types import SimpleNamespace

import numpy as np
import pytest

from mitsim.reconstruct.request import ImageCost, keeps_frames, predict_cost, slab_numbers


def made(rows: tuple[int, int], lines: tuple[int, int], patterns: tuple[int, int], shots: int = 24) -> tuple:
    """Shots and factors of these sizes; each pattern lights its own line alone."""
    left, right = (np.zeros(size) for size in zip(rows, lines, strict=True))
    pairs = tuple(np.eye(line, count) for line, count in zip(lines, patterns, strict=True))
    manifest = SimpleNamespace(patterns=SimpleNamespace(captures=[None] * shots))
    return SimpleNamespace(manifest=manifest, patterns=pairs), SimpleNamespace(left=left, right=right)


def of(*sizes: tuple[int, int]) -> ImageCost:
    return predict_cost(*made(*sizes))


def test_seconds_are_those_of_frames_numbers_and_factors() -> None:
    """A sensor of 3000 x 2000 pixels by factors of 60 and 50 lines under 4 x 3 patterns, twice each: 24 frames.

    Beyond 2^24 numbers frames are read once more to be judged.
    """
    seconds = of((3000, 2000), (60, 50), (4, 3)).seconds
    reading, judging, adding = 24 * (6e6 * 3.5e-8 + 4e-3), 12 * 6e6 * 2e-8, 12 * 6e6 * 1.5e-8
    solving = (3000 * 60**2 + 2000 * 50**2) * 6e-10
    assert seconds["accumulate"] == pytest.approx(solving + reading + adding)
    assert seconds["misfit"] == pytest.approx(reading + judging)
    assert seconds["uncertainty"] - seconds["solve"] == pytest.approx(solving) and seconds["solve"] == 0.05
    few = of((300, 200), (60, 50), (4, 3)).seconds
    assert few["misfit"] == pytest.approx(12 * 6e4 * 2e-8), "kept, and so not read again"


def test_memory_is_that_of_frames_measurements_and_slabs() -> None:
    """In double precision: 16 frames, two for each measurement that is kept, and 32 bytes for each number of slabs."""
    none = of((1, 1), (1, 1), (1, 1)).memory_bytes - 8 * 18 - 32 * 4
    slabs = 300 * 4 + 200 * 3 + 300 * 60 + 200 * 50
    assert slab_numbers(*made((300, 200), (60, 50), (4, 3))) == slabs
    kept = of((300, 200), (60, 50), (4, 3)).memory_bytes
    assert kept - none == pytest.approx(8 * 6e4 * (16 + 2 * 12) + 32 * slabs)
    large = of((3000, 2000), (60, 50), (4, 3)).memory_bytes
    assert large - none == pytest.approx(8 * 6e6 * 16 + 320 * slabs)


def test_numbers_are_kept_up_to_two_to_the_24() -> None:
    assert keeps_frames(*made((2048, 2048), (2, 2), (2, 2)))
    assert not keeps_frames(*made((2048, 2049), (2, 2), (2, 2)))
    assert not keeps_frames(*made((2049, 2048), (2, 2), (2, 2)))
    assert not keeps_frames(*made((2048, 2048), (2, 3), (2, 3)))
