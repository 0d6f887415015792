"""Repeated times: spreads, differences that noise may hide, and a budget of wall time that is kept."""

import pytest

from mitsim.studies.accuracy_findings import ROUNDS, Budget, Extra, Spread, Timed, times


def test_a_spread_has_a_middle_between_its_ends() -> None:
    spread = Spread.of([3.0, 1.0, 2.0])
    assert spread == Spread(2.0, 1.0, 3.0, 3) and str(spread) == "2 s (1 to 3, 3 runs)"
    assert spread + 1.0 == Spread(3.0, 2.0, 4.0, 3) and spread * 2.0 == Spread(4.0, 2.0, 6.0, 3)
    assert str(Spread.of([1.5])) == "1.5 s (once)"
    assert times(spread) == {"seconds": 2.0, "least_s": 1.0, "most_s": 3.0, "repeats": 3}


@pytest.mark.parametrize(
    ("with_it", "without", "reported"),
    [
        ([2.0, 2.1, 2.2], [1.0, 1.1, 1.2], "1 s (0.8 to 1.2)"),
        ([1.0, 1.1, 1.2], [2.0, 2.1, 2.2], "within noise (at most 0 s)"),
        ([1.0, 1.5, 2.0], [0.9, 1.0, 1.1], "within noise (at most 1.1 s)"),
        ([1.15], [1.0], "within noise (at most 0.36 s)"),
        ([2.0], [1.0], "1 s (0.7 to 1.3)"),
    ],
    ids=["apart", "faster with it", "overlapping", "once, a little", "once, far apart"],
)
def test_a_difference_is_told_where_the_spreads_allow_no_other_sign(
    with_it: list[float], without: list[float], reported: str
) -> None:
    extra = Extra.between(Spread.of(with_it), Spread.of(without))
    assert str(extra) == reported and extra.within_noise is ("noise" in reported)
    assert "-" not in str(extra), "no cost is negative"


def test_what_does_not_fit_is_named() -> None:
    budget = Budget(10.0)
    assert budget.allows("short", 4.0) and not budget.allows("short", 4.0, share=0.3)
    assert not budget.allows("long", 11.0)
    assert [line.split(" (predicted")[0] for line in budget.left_out] == ["short", "long"]
    assert "11 s" in budget.left_out[1] and 9.5 < budget.left <= 10.0
    assert not budget.allows("other", 4.0, kept=7.0) and "3 s were left" in budget.left_out[2]


def test_a_slow_machine_is_believed_and_a_fast_one_is_not() -> None:
    budget = Budget(10.0)
    budget.saw(6.0, 2.0)
    assert budget.slower == 3.0
    budget.saw(1.0, 2.0)
    assert budget.slower == 1.0


def test_repeats_go_round_by_round_and_stop_with_the_time() -> None:
    order: list[str] = []

    def work(name: str, seconds: float) -> Timed:
        def again() -> float:
            order.append(name)
            return seconds

        return Timed(again, [seconds])

    slow, fast = work("slow", 0.2), work("fast", 0.1)
    Budget(60.0).repeat([slow, fast])
    assert order == ["fast", "slow"] * (ROUNDS - 1) and len(slow.seconds) == len(fast.seconds) == ROUNDS
    never = Timed(lambda: pytest.fail("no time is left for it"), [5.0])
    Budget(1.0).repeat([never])
