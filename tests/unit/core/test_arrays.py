"""Arrays: means over neighbours against scipy's own."""

from __future__ import annotations

import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from scipy.ndimage import uniform_filter
from threadpoolctl import threadpool_info, threadpool_limits

from mitsim.core.arrays import mean_of_neighbours
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import Behind, in_threads, single_threaded_blas
from mitsim.core.seeds import integer, stream


@pytest.mark.parametrize("shape", [(5, 7), (1, 4), (2, 1), (16, 16)])
def test_the_mean_of_neighbours_is_scipy_s(shape: tuple[int, int]) -> None:
    """To rounding: scipy keeps a running sum, whose error grows along a line."""
    values = np.random.default_rng(3).random(shape)
    np.testing.assert_allclose(mean_of_neighbours(values), uniform_filter(values, 3, mode="nearest"), rtol=1e-13)


def test_what_has_no_neighbour_stays_zero() -> None:
    values = np.zeros((6, 6))
    values[2, 3] = 0.1
    assert np.array_equal(mean_of_neighbours(values) > 0, np.pad(np.ones((3, 3), bool), ((1, 2), (2, 1))))


# ---- Random streams --------------------------------------------------------------------------------------------------


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


# ---- Work in threads -------------------------------------------------------------------------------------------------


def test_two_lots_are_held_and_no_more() -> None:
    """A lot is begun when the one before is done. (Planted: `give` that never waits.)"""
    done: list[int] = []

    def work(item: int) -> None:
        time.sleep(0.002)
        done.append(item)

    with Behind(work) as behind:
        for lot in range(4):
            behind.give(range(10 * lot, 10 * lot + 10))
            assert set(done) >= set(range(10 * lot)) and len(done) <= 10 * lot + 10
        behind.wait()
        assert sorted(done) == list(range(40))


def test_an_error_behind_is_raised_where_the_work_is_waited_for() -> None:
    """(Planted: errors of threads that nobody asks for.)"""

    def work(item: int) -> None:
        if item == 3:
            raise MitsimError("file frame_00003.exr: cannot be written (No space left on device)")

    with pytest.raises(MitsimError, match="No space left"), Behind(work) as behind:
        behind.give(range(8))
        behind.give(range(8, 16))
        pytest.fail("went on")


def test_an_interruption_leaves_begun_items_finished_and_others_undone() -> None:
    """Control-C while files are written: every file that was begun is whole. (Planted: items that are all finished.)"""
    begun, finished, go = [], [], threading.Event()

    def work(item: int) -> None:
        begun.append(item)
        go.wait(10)
        finished.append(item)

    def interrupted() -> None:
        with Behind(work) as behind:
            behind.give(range(500))
            threading.Timer(0.05, go.set).start()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert sorted(begun) == sorted(finished) and len(finished) < 500


def test_blas_has_one_thread_until_the_last_context_is_left() -> None:
    """Contexts of two threads overlap by chance, and how many threads of BLAS add up shows in last bits. (Planted: each
    puts back what it found; what is put back by another thread ignored, and one thread ever after.)"""

    def threads_of_blas() -> set[int]:
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    entered, left, inside = threading.Event(), threading.Event(), []

    def second() -> None:
        with single_threaded_blas():
            entered.set()
            left.wait(10)
            inside.append(threads_of_blas())

    with threadpool_limits(2):
        other = threading.Thread(target=second)
        with single_threaded_blas():
            other.start()
            entered.wait(10)
        left.set()
        other.join()
        assert inside == [{1}] and threads_of_blas() == {2}


@pytest.mark.parametrize("module", ["scipy.linalg", "scipy.special"])
def test_blas_that_is_loaded_later_has_one_thread_too(module: str) -> None:
    """SciPy brings a library of its own, which a capture need not load. (Seen failing: it had all threads in a process
    that had kept NumPy's to one before.)"""
    program = f"""if True:
        from threadpoolctl import threadpool_info, threadpool_limits
        from mitsim.core.parallel import single_threaded_blas
        import numpy

        def threads():
            return {{pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}}

        with single_threaded_blas():
            import {module}
            threadpool_limits(2)
            with single_threaded_blas():
                inside = threads()
        with single_threaded_blas():
            print(inside, threads())
    """
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "{1} {1}\n"


def test_items_of_items_do_not_wait_for_each_other() -> None:
    """The threads are kept, and few: were items of items given to them, all might wait. (Planted: so they are.)"""
    assert in_threads(lambda row: in_threads(lambda item: row * item, range(3)), range(64))[63] == [0, 63, 126]


def test_an_error_of_an_item_leaves_none_at_work() -> None:
    """(Planted: the error is raised while others go on.)"""
    begun, finished = [], []

    def work(item: int) -> None:
        begun.append(item)
        if item == 0:
            raise MitsimError("item 0")
        time.sleep(0.02)
        finished.append(item)

    with pytest.raises(MitsimError, match="item 0"):
        in_threads(work, range(500))
    assert sorted(begun) == [0, *sorted(finished)] and len(begun) < 500
