"""Work that ends when its time is over, whatever it is doing; and nothing of that is left behind."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable

import pytest

from mitsim.core.errors import MitsimError
from mitsim.core.job import Job, Limits, within
from mitsim.core.worker import OutOfTime

LIMIT, LATE, END = 0.1, 60.0, 120.0
"""Seconds allowed; by which a loaded machine has surely given the main thread its turn; and after which work ends by
itself where no alarm ends it, so that a test fails and does not hang."""


def spin() -> None:
    end = time.perf_counter() + END
    while time.perf_counter() < end:
        sum(range(1000))


def swallow() -> None:
    end = time.perf_counter() + END
    while time.perf_counter() < end:
        try:
            spin()
        except Exception:
            continue


@pytest.mark.parametrize("work", [spin, swallow, lambda: threading.Event().wait(END), lambda: time.sleep(END)])
def test_work_ends_in_time(work: Callable[[], object]) -> None:
    """Loops, what goes on after failures, waiting for a thread, and sleep. (Planted: no alarm is set.)"""
    before, started = signal.getsignal(signal.SIGALRM), time.perf_counter()
    with pytest.raises(OutOfTime), within(LIMIT):
        work()
    assert LIMIT <= time.perf_counter() - started < LATE
    assert signal.getsignal(signal.SIGALRM) is before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_work_that_is_done_is_left_alone() -> None:
    with within(LIMIT):
        pass
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    time.sleep(2 * LIMIT)


def test_no_time_at_all() -> None:
    with pytest.raises(OutOfTime), within(0.0):
        pytest.fail("began")


def test_an_alarm_of_somebody_else_is_kept() -> None:
    rung: list[int] = []
    before = signal.signal(signal.SIGALRM, lambda number, _: rung.append(number))
    try:
        signal.setitimer(signal.ITIMER_REAL, LIMIT)
        with within(LIMIT / 2):
            time.sleep(2 * LIMIT)
        assert rung == [signal.SIGALRM]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_lost_alarm_comes_again() -> None:
    """An exception in a destructor is dropped by Python."""

    class Slow:
        def __del__(self) -> None:
            time.sleep(2 * LIMIT)

    with pytest.raises(OutOfTime), within(LIMIT):
        Slow()
        spin()


def test_plans_are_held_against_the_job() -> None:
    """The whole work's seconds count, and the plan's own are kept."""
    job = Job(limits=Limits(seconds=LIMIT))
    refused = r"dots:3: was not planned within the 0.1 s that are allowed.*max_seconds"
    with pytest.raises(MitsimError, match=refused), job.planning("dots:3"):
        spin()
    assert LIMIT / 2 < job.clock.seconds()["plan"] < LATE
    with pytest.raises(MitsimError, match="was not planned"), job.planning("dots:3"):
        pytest.fail("began after all seconds were over")
