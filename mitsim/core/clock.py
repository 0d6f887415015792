"""Where time goes: named stages in, seconds by stage out."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager


class Clock:
    """Seconds by stage, in the order of first use."""

    def __init__(self) -> None:
        self._started = time.perf_counter()
        self._stages: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the time spent inside the context to ``name``."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self._stages[name] = self._stages.get(name, 0.0) + time.perf_counter() - started

    def add(self, stages: Mapping[str, float], prefix: str = "") -> None:
        """Take over the stages of another clock, except its total."""
        for name, seconds in stages.items():
            if name != "total":
                self._stages[prefix + name] = self._stages.get(prefix + name, 0.0) + seconds

    def seconds(self) -> dict[str, float]:
        """Stages and ``total`` since the clock was made."""
        return {**self._stages, "total": time.perf_counter() - self._started}
