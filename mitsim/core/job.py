"""What goes with long work besides its inputs: where its time goes, who is told how far it is, what it may take."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType

from mitsim.core.arguments import checked, checked_fields
from mitsim.core.errors import ArgumentError, MitsimError, cut
from mitsim.core.resources import Limits
from mitsim.core.worker import OutOfTime, stopped

Progress = Callable[[str, float], None]
"""Called with a stage's name and its finished part, 0 to 1."""


def silent(stage: str, fraction: float) -> None:
    """Ignore the progress of ``stage``, its finished ``fraction``: the :data:`Progress` of who wants none."""


@checked_fields
class Clock:
    """Seconds by stage, in the order of first use.

    ``start``: seconds that the program has run already, which count as a stage of that name.
    """

    def __init__(self, start: float = 0.0) -> None:
        self._started = time.perf_counter() - start
        self._stages: dict[str, float] = {"start": start} if start else {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the time spent inside the context to ``name``."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self._stages[name] = self._stages.get(name, 0.0) + time.perf_counter() - started

    @checked
    def add(self, stages: Mapping[str, float], prefix: str = "") -> None:
        """Take over the ``stages`` [s] of another clock, except its total, ``prefix`` before their names."""
        try:
            sum(stages.values())
        except TypeError:
            raise ArgumentError("stages", f"{cut(repr(stages))}: give seconds by name") from None
        for name, seconds in stages.items():
            if name != "total":
                self._stages[prefix + name] = self._stages.get(prefix + name, 0.0) + seconds

    def seconds(self) -> dict[str, float]:
        """Stages and ``total`` since the clock was made [s]."""
        return {**self._stages, "total": time.perf_counter() - self._started}


@checked_fields
@dataclass(frozen=True)
class Job:
    """How one piece of long work is watched and bounded; of no influence on its results.

    Attributes
    ----------
    clock
        takes the seconds of each stage.
    progress
        is told each stage and its finished part.
    limits
        beyond which the work is refused before it begins.
    """

    clock: Clock = field(default_factory=Clock)
    progress: Progress = silent
    limits: Limits = field(default_factory=Limits)

    @contextmanager
    def planning(self, what: str) -> Iterator[None]:
        """The stage "plan" of the clock, refused once the whole work has taken all the seconds that its limits allow.

        Parameters
        ----------
        what
            the work, for the message.

        Raises
        ------
        MitsimError
            when they are over before the plan is made.
        """
        try:
            with self.clock.stage("plan"), within(self.limits.seconds - self.clock.seconds()["total"]):
                yield
        except OutOfTime:
            raise MitsimError(
                f"{what}: was not planned within the {self.limits.seconds:.3g} s that are allowed; ask for less "
                "accuracy or fewer frames, or raise max_seconds"
            ) from None


# ---- A time at which work ends wherever it is ----
#
# Work that is made of many steps of unknown length - looks at a scene, a search for light in small mirrors, a drawing's
# shadow - would need a check in each of them. An alarm (SIGALRM) interrupts whatever the main thread does; what takes
# long in native code is interrupted after its call.

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
