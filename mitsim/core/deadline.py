"""A time at which work ends wherever it is: seconds in, the block's own end or one exception out.

Work that is made of many steps of unknown length - looks at a scene, a search for light in small mirrors, a drawing's
shadow - would need a check in each of them. An alarm (SIGALRM) interrupts whatever the main thread does; what takes
long in native code is interrupted after its call.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from mitsim.core.worker import OutOfTime, stopped

_AGAIN_S = 1.0
"""After which the alarm comes again: an exception that fell into a callback of native code is dropped there."""


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Interrupt the block by :class:`mitsim.core.worker.OutOfTime` once so many wall ``seconds`` are over.

    Where there are no alarms (Windows, other threads than the main one), or somebody else has set one, the block runs
    to its own end.
    """
    if seconds <= 0:
        raise OutOfTime
    if (
        not hasattr(signal, "setitimer")
        or threading.current_thread() is not threading.main_thread()
        or signal.getitimer(signal.ITIMER_REAL)[0]
    ):
        yield
        return
    before = signal.signal(signal.SIGALRM, _ring)
    signal.setitimer(signal.ITIMER_REAL, seconds, _AGAIN_S)
    try:
        yield
    finally:
        _silence(before)


def _ring(_: int, __: FrameType | None) -> None:
    if stopped():  # by a signal, whose interrupt was lost: see mitsim.core.worker
        raise KeyboardInterrupt
    raise OutOfTime


def _silence(before: object) -> None:
    """Take the alarm back, also where it rings meanwhile."""
    while True:
        try:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)  # type: ignore[arg-type]
            return
        except OutOfTime:
            continue
