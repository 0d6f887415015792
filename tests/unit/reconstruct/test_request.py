"""What may be asked of an image, up to the ends of every range, and what is refused.

What an image is predicted to take, from sizes: worked out by hand, each figure of the module by itself.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mitsim.core.errors import ArgumentError
from mitsim.reconstruct.request import ImageCost, ImageRequest, check_joint, keeps_frames, slab_numbers
from mitsim.reconstruct.solvers import SOLVERS

NAMES = "lam", "method", "focus", "depth_range"
TAKEN = [
    *(("auto", method, None) for method in SOLVERS),
    *((lam, "tikhonov", None) for lam in (0.0, 1e-300, 5)),
    *(("auto", "tikhonov", focus) for focus in ("auto", "map", 1e-3, 400)),
    *(("auto", method, 400.0) for method in SOLVERS),
]
REFUSED = [
    *((("auto", method, None), "method", "use tikhonov, markov") for method in ("gram", "")),
    *(((lam, "tv", None), "lam", "at least 0, or auto") for lam in (-1e-300, math.inf, math.nan)),
    (("none", "tv", None), "lam", "give a number or 'auto'"),
    *((("auto", "tv", focus), "focus", "above 0 mm") for focus in (0.0, -1.0, math.inf, math.nan)),
    (("auto", "tv", "near"), "focus", "give a number or 'auto', 'map' or 'volume'"),
    *((("auto", method, "map"), "method", "tikhonov alone") for method in ("markov", "nonnegative", "tv")),
    (("auto", "tikhonov", 350.0, (300.0, 400.0)), "depth_range", "focus auto, map or volume alone"),
    (("auto", "tikhonov", "map", (400.0, 300.0)), "depth_range", "the smaller one first"),
]


@pytest.mark.parametrize("asked", TAKEN)
def test_what_an_image_may_be_asked_by_is_taken(asked: tuple[Any, ...]) -> None:
    ImageRequest(**dict(zip(NAMES, asked, strict=False)))


@pytest.mark.parametrize(("asked", "name", "reported"), REFUSED)
def test_wrong_ones_are_refused(asked: tuple[Any, ...], name: str, reported: str) -> None:
    """By the name of the argument, and by what it may be. (Planted: 0 taken for a depth, a bool for a number.)"""
    with pytest.raises(ArgumentError, match=reported) as refusal:
        ImageRequest(**dict(zip(NAMES, asked, strict=False)))
    assert refusal.value.argument == name


def test_behind_filters_lambda_is_above_zero() -> None:
    """(Planted: 0 taken, and infinity.)"""
    for lam in ("auto", 1e-300, 7):
        check_joint(lam)
    for lam in (0.0, -1.0, math.inf, math.nan, "none"):
        with pytest.raises(ArgumentError, match="a finite number above 0, or auto"):
            check_joint(lam)


def test_bounds_are_two_numbers_of_a_method_that_heeds_them() -> None:
    """(Planted: bounds that Tikhonov passes over; equal ends.)"""
    for bounds in ((0, math.inf), (-math.inf, 1.0), (0.2, 0.3)):
        for method in ("nonnegative", "tv"):
            assert ImageRequest(method=method, bounds=bounds).bounds == bounds
        for method in ("tikhonov", "markov"):
            with pytest.raises(ArgumentError, match="come with method nonnegative or tv"):
                ImageRequest(method=method, bounds=bounds)
    for wrong in ((1.0, 0.0), (1.0, 1.0), (math.nan, 1), (0, math.nan), (0,), (0, True), (math.inf, math.inf), "01"):
        with pytest.raises(ArgumentError, match="the smaller one first"):
            ImageRequest(method="tv", bounds=wrong)  # type: ignore[arg-type]
    asked = ImageRequest(method="tv", bounds=(0.0, math.inf), iterations=7)
    assert asked.iterative == {"bounds": (0.0, math.inf), "iterations": 7} and asked.plain["bounds"] == [0.0, None]
    for iterations in (0, -1, 2.5, True, "7"):
        with pytest.raises(ArgumentError, match="at least 1"):
            ImageRequest(method="tv", iterations=iterations)  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match="tikhonov has none"):
        ImageRequest(iterations=7)


# ---- Predicted cost ----


def made(rows: tuple[int, int], lines: tuple[int, int], patterns: tuple[int, int], shots: int = 24) -> tuple:
    """Shots and factors of these sizes; each pattern lights its own line alone."""
    left, right = (np.zeros(size) for size in zip(rows, lines, strict=True))
    pairs = tuple(np.eye(line, count) for line, count in zip(lines, patterns, strict=True))
    manifest = SimpleNamespace(patterns=SimpleNamespace(captures=[None] * shots))
    return SimpleNamespace(manifest=manifest, patterns=pairs), SimpleNamespace(left=left, right=right)


def of(*sizes: tuple[int, int]) -> ImageCost:
    return ImageCost.of(*made(*sizes))


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
