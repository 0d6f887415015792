"""Work on all processors: a function and items in, results in order out; BLAS kept to one thread meanwhile.

Frames are many and small, so threads of ours over frames beat threads of BLAS inside a product: those wait for each
other at every product, and on a busy machine that costs ten times the work. Results do not depend on the number of
threads, because each product is computed by one.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

Item = TypeVar("Item")
Result = TypeVar("Result")


def workers() -> int:
    """Processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


@contextmanager
def single_threaded_blas() -> Iterator[None]:
    """Keep BLAS to one thread inside the context."""
    with _controller().limit(limits=1, user_api="blas"):
        yield


@cache
def _controller() -> ThreadpoolController:
    """The thread pools of this process; looking for them takes a millisecond, so once."""
    # Imported here: threadpoolctl sets an environment variable when it is imported, and importing mitsim sets none.
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """``function`` of each of the ``items``, in order, one thread a processor; it should spend its time in numpy."""
    with single_threaded_blas(), ThreadPoolExecutor(workers()) as pool:
        return list(pool.map(function, items))
