import numpy as np
import pytest

from mitsim.core.arrays import integer, stream
from mitsim.core.errors import MitsimError


def first(*args: int | str) -> int:
    return int(stream(*args).integers(2**63))


def test_a_name_always_gives_the_same_stream() -> None:
    # Written down once: saved runs must stay reproducible from one version of mitsim to the next.
    assert integer(0, "rendering") == 3712657640
    assert first(7, "shot", 17) == 7436103382523395007


def test_other_streams_do_not_change_a_stream() -> None:
    alone = first(1, "read", 3)
    for frame in range(3):
        stream(1, "read", frame).random(100)
    assert first(1, "read", 3) == alone


def test_different_names_give_different_streams() -> None:
    names = [(), ("a",), ("b",), ("a", "b"), ("ab",), ("b", "a"), (1,), ("1",), (-1,), (12,), (1, 2), ("", "a")]
    values = [first(root, *name) for root in (0, 1, 2**64 - 1) for name in names]
    assert len(set(values)) == len(values)


def test_integers_are_32_bit_and_spread() -> None:
    values = [integer(3, "pass", index) for index in range(2000)]
    assert all(isinstance(value, int) and 0 <= value < 2**32 for value in values)
    assert len(set(values)) == 2000
    # Uniform: the mean of 2000 has standard deviation 2^32 sqrt(1/12/2000) = 0.65 %, five of them 3.2 %.
    assert abs(np.mean(values) / 2**31 - 1) < 0.065


@pytest.mark.parametrize("root", [-1, 2**64])
def test_a_root_out_of_range_is_refused(root: int) -> None:
    with pytest.raises(MitsimError, match=f"seed: got {root}"):
        stream(root, "shot")
