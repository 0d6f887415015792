"""Work on all processors: a function and items in, results in order out; BLAS kept to one thread meanwhile.

Frames are many and small, so threads of ours over frames beat threads of BLAS inside a product: those wait for each
other at every product, and on a busy machine that costs ten times the work. Results do not depend on the number of
threads, because each product is computed by one.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from types import TracebackType
from typing import Any, Generic, TypeVar

from mitsim.core.worker import workers

Item = TypeVar("Item")
Result = TypeVar("Result")


_counting = threading.Lock()
_inside_blas = 0
_before = dict[str, tuple[Any, int]]()
"""Libraries of BLAS that are kept to one thread, by path, each with the number that it had."""

_BRING_BLAS = "scipy.linalg", "scipy.special"
"""Modules that load SciPy's own library of BLAS; whatever else of SciPy does imports one of them."""


@contextmanager
def single_threaded_blas() -> Iterator[None]:
    """Keep BLAS to one thread inside the context.

    The number of threads is the process's, and contexts of several threads overlap by chance. So earlier numbers are
    put back when the last context is left: at the first one's end BLAS had its threads again while another worked.
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
    """Let each of some libraries of BLAS have so many threads."""
    for library, number in numbers:
        # Since 3.8 threadpoolctl heeds one thread's wishes at a time, and ignores those of others in silence.
        forget = getattr(library, "clear_controlling_thread", lambda **_: None)
        forget(force=True)
        library.set_num_threads(number)
        forget(force=True)


@cache
def _libraries(*_: bool) -> tuple[Any, ...]:
    """Libraries of BLAS in this process, which has imported these of :data:`_BRING_BLAS`.

    Looking for them takes a millisecond, so it is done once, and again after such an import.
    """
    # Imported here: threadpoolctl sets an environment variable when it is imported, and importing mitsim sets none.
    from threadpoolctl import ThreadpoolController

    return tuple(ThreadpoolController().select(user_api="blas").lib_controllers)


def in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Return ``function`` of each of the ``items``, in order, one thread a processor; its time should be numpy's.

    The threads are kept. One item, and items of an item, are worked on where they are asked for. After an error, or
    Control-C, items that nobody has begun are left out, and those that somebody has are finished.
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
    """So many threads, kept for the next call: starting some takes as long as forming a small frame."""
    # Each thread is known as one of ours: were it to wait for others, all might wait.
    return ThreadPoolExecutor(threads, initializer=setattr, initargs=(_inside, "thread", True))


os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not live on in a forked process


class Behind(Generic[Item]):
    """Work on items in threads while the next ones are made; a context, which is left when all of it is done.

    Two lots of items are held: the one that is worked on, and the one that is made meanwhile. Errors are raised
    where the work is waited for. When the context is left by an error or Control-C, items that nobody has begun are
    left out, and those that somebody has are finished.
    """

    def __init__(self, function: Callable[[Item], Any]) -> None:
        """Make a context that does ``function`` to each item."""
        self._function, self._pool = function, ThreadPoolExecutor(workers())
        self._begun: list[Future[Any]] = []

    def __enter__(self) -> Behind[Item]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    def give(self, items: Iterable[Item]) -> None:
        """Wait for the items that were given before, and begin these ``items``."""
        self.wait()
        self._begun = [self._pool.submit(self._function, item) for item in items]

    def wait(self) -> None:
        """Wait for all items; the first error of theirs is raised."""
        for future in self._begun:
            future.result()
        self._begun = []
