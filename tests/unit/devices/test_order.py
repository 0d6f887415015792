"""Orders of a session's frames: every frame once, halves of a pair side by side."""

from typing import get_args

import pytest
from pydantic import ValidationError

from mitsim.devices.session import SIDES, Order, SessionRecipe, halves, halves_in_order

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
    h, v = SIDES
    listed = [(side, index, sign) for side in SIDES for index in (0, 1) for sign in (1, -1)]
    assert listed == halves_in_order(2, True) and listed[:3] == [(h, 0, 1), (h, 0, -1), (h, 1, 1)]
    assert [half[:2] for half in halves_in_order(2, True, "reversed")[::2]] == [(v, 1), (v, 0), (h, 1), (h, 0)]
    assert [half[:2] for half in halves_in_order(2, True, "interleaved")[::2]] == [(h, 0), (v, 0), (h, 1), (v, 1)]
    assert halves_in_order(2, False, "interleaved")[:4] == [(h, 0, 0), (v, 0, 0), (h, 0, 1), (v, 0, 1)]
    drawn = [halves_in_order(64, True, "random", seed) for seed in (1, 1, 2)]
    assert drawn[0] == drawn[1] != drawn[2]


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
