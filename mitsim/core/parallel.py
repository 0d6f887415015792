"""Threads over items, with BLAS restricted to one thread.

For many small frames they beat BLAS's own threads, which wait for each other at every product. Results do not depend on
the number of threads.
"""

from __future__ import annotations

import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from typing import Any, Generic, TypeVar

from mitsim.core.worker import workers

Item = TypeVar("Item")
Result = TypeVar("Result")
_counting = threading.Lock()
_inside_blas = 0
_before = dict[str, tuple[Any, int]]()
"""Libraries of BLAS that are restricted, by path, and their earlier numbers of threads."""

_BRING_BLAS = "scipy.linalg", "scipy.special"
"""Every part of SciPy that uses BLAS imports one of these modules, which load SciPy's own BLAS."""


@contextmanager
def single_threaded_blas() -> Iterator[None]:
    """Restrict BLAS to one thread inside the context.

    Contexts of several threads may overlap, therefore the last one that ends restores the earlier numbers of threads.
    """
    global _inside_blas
    with _counting:
        for library in _libraries(*(name in sys.modules for name in _BRING_BLAS)):
            _before.setdefault(library.filepath, (library, library.num_threads))
        _inside_blas += 1
        _set_threads((library, 1) for library, _ in _before.values())
    try:
        yield
    finally:
        with _counting:
            _inside_blas -= 1
            if _inside_blas == 0:
                _set_threads(_before.values())
                _before.clear()


def _set_threads(numbers: Iterable[tuple[Any, int]]) -> None:
    for library, number in numbers:
        # Since 3.8 threadpoolctl heeds one thread's wishes at a time, and ignores those of others in silence.
        forget = getattr(library, "clear_controlling_thread", lambda **_: None)
        forget(force=True)
        library.set_num_threads(number)
        forget(force=True)


@cache
def _libraries(*_: bool) -> tuple[Any, ...]:
    """Return the libraries of BLAS, cached until one of :data:`_BRING_BLAS` is imported: a search takes 1 ms."""
    # Imported here: threadpoolctl sets an environment variable when it is imported, and importing mitsim sets none.
    from threadpoolctl import ThreadpoolController

    return tuple(ThreadpoolController().select(user_api="blas").lib_controllers)


def in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Apply a numpy-bound ``function`` to ``items``, one thread a processor; results are in order.

    Nested calls and single items run in the calling thread. After an error or Control-C, items that have not begun are
    skipped, and running ones are finished.
    """
    todo = list(items)
    with single_threaded_blas():
        if len(todo) < 2 or getattr(_inside, "thread", False):
            return [function(item) for item in todo]
        begun = [_pool(workers()).submit(function, item) for item in todo]
        try:
            return [future.result() for future in begun]
        finally:
            for future in begun:
                future.cancel()
            wait(begun)


_inside = threading.local()


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Return a pool that is reused, because starting threads takes as long as forming a small frame."""
    # Each thread is known as one of ours: were it to wait for others, all might wait.
    return ThreadPoolExecutor(threads, initializer=setattr, initargs=(_inside, "thread", True))


os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not live on in a forked process


class Behind(Generic[Item]):
    """Context that works on items in threads while the caller makes the next ones; it ends when all are done.

    Errors are raised by the next wait. After an error or Control-C, items that have not begun are skipped, and running
    ones are finished.
    """

    def __init__(self, function: Callable[[Item], Any]) -> None:
        self._function, self._pool = function, ThreadPoolExecutor(workers())
        self._begun: Iterable[Any] = ()

    def __enter__(self) -> Behind[Item]:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    def give(self, items: Iterable[Item]) -> None:
        """Wait for the earlier items, and begin these ``items``."""
        self.wait()
        self._begun = self._pool.map(self._function, items)

    def wait(self) -> None:
        deque(self._begun, maxlen=0)
