"""Clock, progress, and limits on time, memory and disk of long work."""

from __future__ import annotations

import io
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, checked_fields, cut, printable
from mitsim.core.worker import OutOfTime, has_rows, is_stopped

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions
    from rich.table import Table

Progress = Callable[[str, float], None]
"""Called with a stage's name and its finished fraction, 0 to 1."""


def silent(stage: str, fraction: float) -> None:
    """Ignore progress."""


@dataclass(frozen=True)
class CompiledKernels:
    """Kernels that were not in a cache, and the wall ``seconds`` of compiling them."""

    number: int = 0
    seconds: float = 0.0

    def since(self, earlier: CompiledKernels) -> CompiledKernels:
        return CompiledKernels(self.number - earlier.number, self.seconds - earlier.seconds)


_compiled, _counting = CompiledKernels(), threading.Lock()


def compiled_kernels() -> CompiledKernels:
    """Return all kernels compiled by this process, and clear Dr.Jit's history.

    Dr.Jit keeps 0.2 MB of text for each launched kernel until its history is read, so call this now and then.
    """
    global _compiled
    drjit = sys.modules.get("drjit")
    with _counting:
        if drjit is not None and hasattr(drjit, "kernel_history"):
            new = [
                launch["backend_time"] / 1000
                for launch in drjit.kernel_history([drjit.KernelType.JIT])
                if not (launch["cache_hit"] or launch["cache_disk"])
            ]
            _compiled = CompiledKernels(_compiled.number + len(new), _compiled.seconds + sum(new))
        return _compiled


class Watch:
    """Receiver of progress that ignores it."""

    def begin(self, stage: str) -> None:
        """Note that the ``stage`` goes on from here."""

    def end(self, stage: str, seconds: float) -> None:
        """Note that ``stage`` is over or pauses; ``seconds`` in total so far."""

    def predict(self, seconds: Mapping[str, float]) -> None:
        """Note the predicted ``seconds`` of coming stages."""

    def report(self, stage: str, fraction: float) -> None:
        """Note the finished ``fraction`` of a ``stage``, or of a loop over several: a :data:`Progress`."""


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

    @check_arguments
    def predict(self, stages: Mapping[str, float]) -> None:
        """Report predicted seconds of the ``stages`` that have not begun."""
        self._watch.predict({self._prefix + name: own for name, own in stages.items() if name not in self._stages})

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
        return asdict(compiled_kernels().since(self._compiled))

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
        if output is not None and not self.disk_bytes <= (left := free_disk(output)):
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
        try:
            with self.clock.stage("plan"), within(self.limits.seconds - self.clock.seconds()["total"]):
                yield
        except OutOfTime:
            raise MitsimError(
                f"{what}: was not planned within the {self.limits.seconds:.3g} s that are allowed; ask for less "
                "accuracy or fewer frames, or raise max_seconds"
            ) from None


# ---- Interruption of work after a given time ----
#
# An alarm (SIGALRM) interrupts the main thread, or native code after its call, so that the many steps of unknown length
# need no checks of their own.

_AGAIN_S = 1.0
"""The alarm repeats, because an exception inside a callback of native code is dropped."""


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Raise :class:`mitsim.core.worker.OutOfTime` in the block after so many wall ``seconds``.

    Without alarms (Windows, other threads than the main one), or if another alarm is set, the block runs to its end.
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

    def ring(_: int, __: FrameType | None) -> None:
        # Stopped by a signal, whose interrupt was lost: see mitsim.core.worker.
        raise KeyboardInterrupt if is_stopped() else OutOfTime

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds, _AGAIN_S)
    try:
        yield
    finally:
        while signal.getsignal(signal.SIGALRM) is ring:
            with suppress(OutOfTime):  # it may ring while it is taken back
                signal.setitimer(signal.ITIMER_REAL, 0)
                signal.signal(signal.SIGALRM, before)


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

    left = [float(psutil.virtual_memory().available)]
    for folder, limit, used, cached in _CGROUPS:
        try:
            counts = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
            taken = float((folder / used).read_text()) - float(counts.get(cached, 0))
            left.append(float((folder / limit).read_text()) - taken)
        except (OSError, ValueError):  # no such group, or "max"
            continue
    if hasattr(psutil, "RLIMIT_AS"):  # Linux and FreeBSD
        process = psutil.Process()
        soft, _ = process.rlimit(psutil.RLIMIT_AS)
        if soft != psutil.RLIM_INFINITY:
            left.append(float(soft - process.memory_info().vms))
    return max(min(left), 0.0)


def memory_from_here() -> float:
    """Return the bytes of memory in use, and reset the peak where the system allows it."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # proc(5): the peak becomes what is held now
    import psutil

    return float(psutil.Process().memory_info().rss)


def memory_since(held: float) -> float:
    """Return the peak of memory beyond ``held`` since :func:`memory_from_here` [bytes]."""
    try:
        # Not getrusage, where there is this: its peak is inherited from the process that started this one.
        lines = Path("/proc/self/status").read_text().splitlines()
        peak = next(int(line.split()[1]) * 1024.0 for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        import resource  # not on Windows

        peak = float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * (1 if sys.platform == "darwin" else 1024)
    return max(peak - held, 0.0)


def running_seconds() -> float:
    try:
        # proc(5): in ticks since boot. psutil adds the time of boot, which Linux rounds to seconds.
        began = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19]) / os.sysconf("SC_CLK_TCK")
        return max(time.clock_gettime(time.CLOCK_BOOTTIME) - began, 0.0)
    except (OSError, AttributeError):  # not Linux
        import psutil

        return max(time.time() - float(psutil.Process().create_time()), 0.0)


def free_disk(path: Path) -> float:
    existing = next(place for place in (path.absolute(), *path.absolute().parents) if place.exists())
    return float(shutil.disk_usage(existing).free)


def size_text(count: float) -> str:
    return f"{count / 2**30:.3g} GiB" if count >= 1000 * 2**20 else f"{count / 2**20:.3g} MiB"


# -------- Progress on a terminal, in a notebook or in a log

SECONDS_A_LINE = 60.0
"""Least time between two lines of progress in a log [s]."""
_SHORTEST_S = 0.05
"""Shorter stages get no row, because they would show 0.0 s."""
_REFRESHES = 5
"""Updates per second; eight rows take 1.3 % of a processor."""
_BAR = 24


@check_arguments
@contextmanager
def progress(limits: Limits | None = None, hidden: bool = False, start: float = 0.0) -> Iterator[Job]:
    """Yield a job that shows its progress: rows on a terminal and in a notebook, else a line a minute on stderr.

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
    interactive = sys.modules.get("IPython")
    in_notebook = getattr(interactive and interactive.get_ipython(), "kernel", None) is not None
    with ExitStack() as stack:
        watch: Watch = Watch() if hidden else _Cell(start) if in_notebook else _Rows(start) if has_rows() else _Log()
        if isinstance(watch, _Cell):
            stack.callback(watch.show)
        elif isinstance(watch, _Rows):
            from rich.console import Console
            from rich.live import Live

            live = Live(watch, console=Console(stderr=True), transient=True, refresh_per_second=_REFRESHES)
            stack.enter_context(live)
        yield Job(Clock(start, watch), watch.report, limits or Limits())


class _Log(Watch):
    def __init__(self) -> None:
        self._written = time.monotonic()

    def report(self, stage: str, fraction: float) -> None:
        if time.monotonic() - self._written >= SECONDS_A_LINE:
            self._written = time.monotonic()
            sys.stderr.write(f"mitsim: {printable(stage)} ({fraction:.0%})\n")
            sys.stderr.flush()


@dataclass
class _Row:
    words: str
    spent: float = 0.0
    begun: float | None = None
    origin: tuple[float, float] = (0.0, 0.0)
    ends: float | None = None

    def seconds(self, now: float) -> float:
        return self.spent + (0.0 if self.begun is None else now - self.begun)

    def rest(self, now: float) -> float:
        """Return the remaining seconds; 0 if unknown."""
        return 0.0 if self.ends is None else max(self.ends - self.seconds(now), 0.0)


class _Rows(Watch):
    """Progress as rows of a terminal: bar, elapsed seconds, and remaining seconds by rate or plan.

    A loop over several stages that take turns reports under its own name; its row shows the remaining time of the loop.
    """

    def __init__(self, start: float) -> None:
        self._rows: dict[str, _Row] = {}
        self._loop: _Row | None = None
        self._started = time.monotonic() - start

    def begin(self, stage: str) -> None:
        row = self._rows.setdefault(stage, _Row(stage))
        if row is self._loop:
            self._loop = None
        row.begun, row.origin = time.monotonic(), (row.spent, 0.0)
        self._show_again()

    def end(self, stage: str, seconds: float) -> None:
        row = self._rows.setdefault(stage, _Row(stage))
        row.spent, row.begun = seconds, None
        self._show_again()

    def predict(self, seconds: Mapping[str, float]) -> None:
        for stage, own in seconds.items():
            row = self._rows.setdefault(stage, _Row(stage))
            row.ends = row.spent + own

    def report(self, stage: str, fraction: float) -> None:
        name, now = stage.partition(":")[0], time.monotonic()
        row = self._rows.setdefault(name, _Row(name))
        row.words = stage.partition(",")[0]
        if row.begun is None:  # a loop, which may go on from where an earlier run left it
            self._end_loop(now)
            self._loop, row.begun, row.origin = row, now, (row.spent, min(fraction, 0.999))
        seconds, first = row.origin
        done, taken = (fraction - first) / (1 - first), row.seconds(now) - seconds
        if done > 0 and taken > 0:
            row.ends = seconds + taken / done
        if row is self._loop and fraction >= 1:
            self._end_loop(now)
        self._show_again()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table]:
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        now, table, loop = time.monotonic(), Table.grid(padding=(0, 2)), self._loop
        table.add_column(no_wrap=True, overflow="ellipsis", min_width=18)
        for _ in range(3):
            table.add_column(no_wrap=True, justify="right")

        def left(seconds: float) -> str:
            return f"{_text(seconds)} left" if seconds >= _SHORTEST_S else ""

        known = list(self._rows.values())  # which another thread may add to
        rests = {id(row): row.rest(now) for row in known if row.begun is not None or not row.spent or loop}
        rows = [row for row in known if row.begun is not None or max(row.spent, rests.get(id(row), 0)) >= _SHORTEST_S]
        if len(rows) > (most := console.size.height - 2):  # the last one and the cursor's
            rows = [row for row in rows if id(row) in rests][:most]
        for row in rows:
            rest, elapsed = rests.get(id(row)), row.seconds(now)
            part = 1.0 if rest is None else elapsed / (elapsed + rest) if rest else None if elapsed else 0.0
            # With 16 colours rich shows finished and unfinished parts alike by default.
            bar = ProgressBar(1.0, part or 0.0, _BAR, pulse=part is None, finished_style="green")
            table.add_row(Text(printable(row.words)), bar, _text(elapsed) if elapsed else "", left(rest or 0.0))
        # The end is unknown where a stage goes on for an unknown time.
        unknown = any(row.begun is not None and not rests[id(row)] for row in known)
        rest = loop.rest(now) if loop else 0.0 if unknown else sum(rests.values())
        table.add_row("total", "", _text(now - self._started), left(rest))
        yield table

    def _end_loop(self, now: float) -> None:
        if self._loop is not None:
            self._loop.spent, self._loop.begun, self._loop = self._loop.seconds(now), None, None

    def _show_again(self) -> None:
        """Do nothing, because rich refreshes a terminal's rows itself."""


class _Cell(_Rows):
    _handle: Any = None
    _written = 0.0

    def _show_again(self) -> None:
        if time.monotonic() - self._written >= 1 / _REFRESHES:
            self.show()

    def show(self) -> None:
        self._written = time.monotonic()
        from IPython.display import HTML, display
        from rich.console import Console

        console = Console(file=io.StringIO(), record=True, width=80, force_jupyter=False, color_system="truecolor")
        console.print(self)
        page = '<pre style="font-family:monospace;line-height:1.3">{code}</pre>'
        html = HTML(console.export_html(inline_styles=True, code_format=page))
        if self._handle is None:
            self._handle = display(html, display_id=True)
        else:
            self._handle.update(html)


def _text(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
