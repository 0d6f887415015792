"""Clock, progress, and limits on time, memory and disk of long work."""

from __future__ import annotations

import math
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, checked_fields, cut, printable
from mitsim.core.worker import has_rows

if TYPE_CHECKING:
    from rich.progress import Progress as Bars
    from rich.progress import TaskID

Progress = Callable[[str, float], None]
"""Called with a stage's name and its finished fraction, 0 to 1."""


def silent(stage: str, fraction: float) -> None:
    """Ignore progress."""


_kernels, _counting = {"number": 0, "seconds": 0.0}, threading.Lock()


def compiled_kernels() -> dict[str, float]:
    """Return ``number`` and ``seconds`` of all kernels that this process compiled, and clear Dr.Jit's history.

    Dr.Jit keeps 0.2 MB of text for each launched kernel until its history is read, so call this now and then.
    """
    drjit = sys.modules.get("drjit")
    with _counting:
        if drjit is not None and hasattr(drjit, "kernel_history"):
            for launch in drjit.kernel_history([drjit.KernelType.JIT]):
                if not (launch["cache_hit"] or launch["cache_disk"]):
                    _kernels["number"] += 1
                    _kernels["seconds"] += launch["backend_time"] / 1000
        return dict(_kernels)


SECONDS_A_LINE = 60.0
"""Least time between two lines of progress in a log [s]."""


class Watch:
    """Receiver of progress that writes a line a minute to stderr if it ``logs``, and ignores progress otherwise."""

    def __init__(self, logs: bool = False) -> None:
        self._written = time.monotonic() if logs else math.inf

    def begin(self, stage: str) -> None:
        """Note that the ``stage`` goes on from here."""

    def end(self, stage: str, seconds: float) -> None:
        """Note that ``stage`` is over or pauses; ``seconds`` in total so far."""

    def report(self, stage: str, fraction: float) -> None:
        """Note the finished ``fraction`` of a ``stage``, or of a loop over several: a :data:`Progress`."""
        if time.monotonic() - self._written >= SECONDS_A_LINE:
            self._written = time.monotonic()
            sys.stderr.write(f"mitsim: {printable(stage)} ({fraction:.0%})\n")
            sys.stderr.flush()


@checked_fields
class Clock:
    """Wall seconds by stage, in order of first use.

    Parameters
    ----------
    start
        Seconds that the program has already run, counted as a stage "start".
    watch
        Receiver of progress.
    prefix
        Text before the stages' names in reports to ``watch``.
    """

    def __init__(self, start: float = 0.0, watch: Watch | None = None, prefix: str = "") -> None:
        self._compiled = compiled_kernels()  # which may wait, and counts as nobody's time
        self._started, self._watch, self._prefix = time.perf_counter() - start, watch or Watch(), prefix
        self._stages: dict[str, float] = {}
        if start:
            self._add("start", start)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time spent inside the context to stage ``name``."""
        started = time.perf_counter()
        self._watch.begin(self._prefix + name)
        try:
            yield
        finally:
            self._add(name, time.perf_counter() - started)

    def apart(self, prefix: str) -> Clock:
        """Return a clock for a part of the work, with the same watch and ``prefix`` before its stages' names."""
        return Clock(0.0, self._watch, self._prefix + prefix)

    @check_arguments
    def add(self, stages: Mapping[str, float], prefix: str = "") -> None:
        """Add the ``stages`` [s] of another clock, except its total, with ``prefix`` before their names."""
        try:
            sum(stages.values())
        except TypeError:
            raise ArgumentError("stages", f"{cut(repr(stages))}: give seconds by name") from None
        for name, seconds in stages.items():
            if name != "total":
                self._add(prefix + name, seconds)

    def seconds(self) -> dict[str, float]:
        """Return seconds by stage, and ``total`` since the clock was made [s]."""
        return {**self._stages, "total": time.perf_counter() - self._started}

    def kernels(self) -> dict[str, float]:
        """Return ``number`` and ``seconds`` of the kernels compiled since the clock was made.

        Later runs save this time because the kernels are then in Dr.Jit's cache.
        """
        return {name: value - self._compiled[name] for name, value in compiled_kernels().items()}

    def _add(self, name: str, seconds: float) -> None:
        self._stages[name] = self._stages.get(name, 0.0) + seconds
        self._watch.end(self._prefix + name, self._stages[name])


# ---- Limits and costs of work ----


@checked_fields
@dataclass(frozen=True)
class Limits:
    """Limits of one command: wall seconds, and bytes of memory (None: nine tenths of the free memory)."""

    seconds: float = 86400.0
    memory_bytes: float | None = None

    def __post_init__(self) -> None:
        if not self.seconds > 0:
            raise ArgumentError("max_seconds", f"{self.seconds:g}: give a number above 0")
        if self.memory_bytes is not None and not self.memory_bytes > 0:
            raise ArgumentError("max_memory", f"{self.memory_bytes / 2**30:g}: give a number of GiB above 0")


@dataclass(frozen=True)
class Cost:
    """Estimated wall seconds, bytes of additional memory, and bytes of disk."""

    seconds: float = 0.0
    memory_bytes: float = 0.0
    disk_bytes: float = 0.0

    def check(self, what: str, limits: Limits, output: Path | None = None) -> None:
        """Raise MitsimError if the work ``what`` exceeds its limits or the free space on the disk of ``output``."""
        if not self.seconds <= limits.seconds:
            raise MitsimError(
                f"{what}: would take about {self.seconds:.3g} s; allowed are {limits.seconds:.3g} s; "
                "ask for less accuracy or fewer frames, or raise max_seconds"
            )
        free = free_memory() * _USABLE
        allowed = free if limits.memory_bytes is None else min(limits.memory_bytes, free)
        if not self.memory_bytes <= allowed:
            raise MitsimError(
                f"{what}: would take about {size_text(self.memory_bytes)} of memory; allowed are {size_text(allowed)}; "
                "ask for fewer pixels or patterns, or free memory"
            )
        if output is not None:
            existing = next(place for place in (output.absolute(), *output.absolute().parents) if place.exists())
            left = float(shutil.disk_usage(existing).free)
            if not self.disk_bytes <= left:
                raise MitsimError(
                    f"{what}: would write about {size_text(self.disk_bytes)}, but {output} has {size_text(left)} left; "
                    "choose another place or fewer frames"
                )


# ---- A job ----


@checked_fields
@dataclass(frozen=True)
class Job:
    """Clock, progress and limits of one piece of work, which do not influence its results.

    Attributes
    ----------
    clock
        Takes the seconds of each stage.
    progress
        Function that receives each stage and its finished fraction.
    limits
        The work is refused before it begins if it would exceed them.
    command
        Command line, which manifests record; None: called from Python.
    """

    clock: Clock = field(default_factory=Clock)
    progress: Progress = silent
    limits: Limits = field(default_factory=Limits)
    command: str | None = None

    def apart(self, prefix: str) -> Job:
        """Return a job for a part of the work, with its own clock and ``prefix`` before its stages' names."""
        return replace(
            self, clock=self.clock.apart(prefix), progress=lambda stage, part: self.progress(prefix + stage, part)
        )

    @contextmanager
    def planning(self, what: str, least: Cost | None = None) -> Iterator[None]:
        """Enter the stage "plan"; MitsimError if planning, or the ``least`` cost known before, exceeds the limits."""
        if least is not None:
            least.check(what, self.limits)
        with self.clock.stage("plan"):
            yield
        if self.clock.seconds()["total"] > self.limits.seconds:
            raise MitsimError(
                f"{what}: was not planned within the {self.limits.seconds:.3g} s that are allowed; ask for less "
                "accuracy or fewer frames, or raise max_seconds"
            )


# ---- Free memory and disk, and memory in use ----

_CGROUPS = (
    (Path("/sys/fs/cgroup"), "memory.max", "memory.current", "inactive_file"),
    (Path("/sys/fs/cgroup/memory"), "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
)
"""Limit, use and reclaimable file cache of containers, in control groups of version 2 and 1."""
_USABLE = 0.9
"""Fraction of the free memory that work may use; the rest covers errors of estimates and other programs."""


def free_memory() -> float:
    """Return the bytes that the limits of machine, control group and process still allow."""
    import psutil  # here: it takes 10 ms to import, and no refusal needs it

    process = psutil.Process()
    soft, _ = process.rlimit(psutil.RLIMIT_AS)
    left = [float(psutil.virtual_memory().available)]
    if soft != psutil.RLIM_INFINITY:
        left.append(float(soft - process.memory_info().vms))
    for folder, limit, used, cached in _CGROUPS:
        with suppress(OSError, ValueError):  # no such group, or "max"
            counts = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
            taken = float((folder / used).read_text()) - float(counts.get(cached, 0))
            left.append(float((folder / limit).read_text()) - taken)
    return max(min(left), 0.0)


def memory_from_here() -> float:
    """Return the bytes of memory in use, and reset the peak where the system allows it."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # proc(5): the peak becomes what is held now
    return _status_bytes("VmRSS")


def memory_since(held: float) -> float:
    """Return the peak of memory beyond ``held`` since :func:`memory_from_here` [bytes]."""
    return max(_status_bytes("VmHWM") - held, 0.0)


def _status_bytes(name: str) -> float:
    # Not getrusage: its peak is inherited from the process that started this one.
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024.0 for line in lines if line.startswith(name))


def running_seconds() -> float:
    """Return the seconds since this process began."""
    # proc(5): in ticks since boot. psutil adds the time of boot, which Linux rounds to seconds.
    began = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19]) / os.sysconf("SC_CLK_TCK")
    return max(time.clock_gettime(time.CLOCK_BOOTTIME) - began, 0.0)


def size_text(count: float) -> str:
    return f"{count / 2**30:.3g} GiB" if count >= 1000 * 2**20 else f"{count / 2**20:.3g} MiB"


# -------- Progress on a terminal or in a log


@check_arguments
@contextmanager
def progress(limits: Limits | None = None, hidden: bool = False, start: float = 0.0) -> Iterator[Job]:
    """Yield a job that shows its progress: rows on a terminal, else a line a minute on stderr.

    Parameters
    ----------
    limits
        Limits on the work; None: a day, and nine tenths of the free memory.
    hidden
        True to show nothing.
    start
        Seconds that the program has already run, counted as a stage "start".

    Raises
    ------
    MitsimError
        for arguments of another type.

    Examples
    --------
    >>> import mitsim as ms
    >>> with ms.progress(ms.Limits(seconds=600)) as job:  # doctest: +SKIP
    ...     shots = ms.open_bench("photograph").capture("dots:7", job=job)
    """
    if hidden or not has_rows():
        watch = Watch(not hidden)
        yield Job(Clock(start, watch), watch.report, limits or Limits())
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    spent = TextColumn("{task.fields[spent]}", justify="right")
    columns = TextColumn("{task.description}", markup=False), BarColumn(24), spent, TimeRemainingColumn(compact=True)
    with Bars(*columns, console=Console(stderr=True), transient=True, refresh_per_second=5) as bars:
        rows = _Rows(bars)
        yield Job(Clock(start, rows), rows.report, limits or Limits())


class _Rows(Watch):
    """Progress as rows of a terminal: a stage's bar, its seconds, and the seconds that remain at its rate."""

    def __init__(self, bars: Bars) -> None:
        self._tasks: dict[str, TaskID] = {}
        self._bars, self._lock = bars, threading.Lock()

    def begin(self, stage: str) -> None:
        self._task(stage)

    def end(self, stage: str, seconds: float) -> None:
        self._bars.update(self._task(stage), total=1.0, completed=1.0, spent=f"{seconds:.1f} s")

    def report(self, stage: str, fraction: float) -> None:
        words = printable(stage.partition(",")[0])
        self._bars.update(self._task(stage.partition(":")[0]), description=words, total=1.0, completed=fraction)

    def _task(self, stage: str) -> TaskID:
        with self._lock:  # several threads may report
            if stage not in self._tasks:
                self._tasks[stage] = self._bars.add_task(printable(stage), total=None, spent="")
            return self._tasks[stage]
