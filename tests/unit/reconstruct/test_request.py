"""What may be asked of an image, up to the ends of every range, and what is refused."""

from __future__ import annotations

import math

import pytest

from mitsim.core.errors import ArgumentError
from mitsim.reconstruct.request import ImageRequest, check_joint, plain_bounds
from mitsim.reconstruct.solvers import SOLVERS

TAKEN = [
    *(("auto", method, None, 0) for method in SOLVERS),
    *((lam, "tikhonov", None, 0) for lam in (0.0, 1e-300, 5)),
    *(("auto", "tikhonov", focus, 0) for focus in ("auto", "map", 1e-3, 400)),
    *(("auto", method, 400.0, 0) for method in SOLVERS),
    *(("auto", "tikhonov", None, margin) for margin in (1, 2)),
]
REFUSED = [
    *((("auto", method, None, 0), "method", "use tikhonov, markov") for method in ("gram", "")),
    *(((lam, "tv", None, 0), "lam", "at least 0, or auto") for lam in (-1e-300, math.inf, math.nan)),
    (("none", "tv", None, 0), "lam", "give a number or 'auto'"),
    *((("auto", "tv", focus, 0), "focus", "above 0 mm") for focus in (0.0, -1.0, math.inf, math.nan)),
    (("auto", "tv", "near", 0), "focus", "give a number or 'auto' or 'map'"),
    *((("auto", method, "map", 0), "method", "tikhonov alone") for method in ("markov", "nonnegative", "tv")),
    *((("auto", "tikhonov", None, margin), "margin", "at least 0") for margin in (-1, 1.0, True, False)),
    *((("auto", "tikhonov", focus, 1), "margin", "leave out focus") for focus in ("auto", "map", 400.0)),
    *((("auto", method, None, 1), "margin", "tikhonov at the calibrated depth alone") for method in ("markov", "tv")),
]


@pytest.mark.parametrize("asked", TAKEN)
def test_what_an_image_may_be_asked_by_is_taken(asked: tuple[float | str, str, float | str | None, int]) -> None:
    ImageRequest(**dict(zip(("lam", "method", "focus", "margin"), asked, strict=True)))


@pytest.mark.parametrize(("asked", "name", "reported"), REFUSED)
def test_what_no_image_is_made_by_is_refused(
    asked: tuple[float | str, str, float | str | None, int], name: str, reported: str
) -> None:
    """By the name of the argument, and by what it may be. (Planted: 0 taken for a depth, a bool for a number.)"""
    with pytest.raises(ArgumentError, match=reported) as refusal:
        ImageRequest(**dict(zip(("lam", "method", "focus", "margin"), asked, strict=True)))
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
    assert plain_bounds((0.0, math.inf)) == [0.0, None]
    asked = ImageRequest(method="tv", bounds=(0.0, math.inf), iterations=7)
    assert asked.iterative == {"bounds": (0.0, math.inf), "iterations": 7} and asked.plain["bounds"] == [0.0, None]
    for iterations in (0, -1, 2.5, True, "7"):
        with pytest.raises(ArgumentError, match="at least 1"):
            ImageRequest(method="tv", iterations=iterations)  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match="tikhonov has none"):
        ImageRequest(iterations=7)
