"""Orders of a session's frames: every frame once, halves of a pair side by side."""

from typing import get_args

import pytest
from pydantic import ValidationError

from mitsim.devices.session import Order, SessionRecipe, halves, halves_in_order

REQUIRED = {"board_reflectance": 0.9, "exposure_fraction": 0.5, "signed_capture": "uniform", "source": "chosen"}


@pytest.mark.parametrize("order", get_args(Order))
@pytest.mark.parametrize("pairs", [True, False])
def test_every_frame_is_taken_once_and_pairs_one_after_the_other(order: Order, pairs: bool) -> None:
    listed, shown = [half for pattern in halves(8, pairs) for half in pattern], halves_in_order(8, pairs, order, 3)
    assert sorted(shown) == sorted(listed) and len(listed) == (32 if pairs else 18)
    if pairs:
        for positive, negative in zip(shown[::2], shown[1::2], strict=True):
            assert positive[:2] == negative[:2] and (positive[2], negative[2]) == (1, -1)


def test_orders_are_what_their_names_say() -> None:
    """(Planted: one side before the other, signs reversed too, the seed not heeded.)"""
    assert halves_in_order(2, True) == [
        *(("horizontal", 0, 1), ("horizontal", 0, -1), ("horizontal", 1, 1), ("horizontal", 1, -1)),
        *(("vertical", 0, 1), ("vertical", 0, -1), ("vertical", 1, 1), ("vertical", 1, -1)),
    ]
    assert [half[:2] for half in halves_in_order(2, True, "reversed")[::2]] == [
        *(("vertical", 1), ("vertical", 0), ("horizontal", 1), ("horizontal", 0))
    ]
    assert [half[:2] for half in halves_in_order(2, True, "interleaved")[::2]] == [
        *(("horizontal", 0), ("vertical", 0), ("horizontal", 1), ("vertical", 1))
    ]
    assert halves_in_order(2, False, "interleaved")[:4] == [
        *(("horizontal", 0, 0), ("vertical", 0, 0), ("horizontal", 0, 1), ("vertical", 0, 1))
    ]
    assert (
        halves_in_order(64, True, "random", 1)
        == halves_in_order(64, True, "random", 1)
        != halves_in_order(64, True, "random", 2)
    )


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"depths": (400.0, 400.0)}, "400 is there twice"),
        ({"order": "sorted"}, "'listed', 'reversed', 'interleaved' or 'random'"),
    ],
)
def test_what_no_session_can_be_is_refused(wrong: dict[str, object], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        SessionRecipe(**REQUIRED | wrong)
