"""Companions of long work: a clock, progress, limits, and the memory and disk that this machine has left.

Work that would take more than that is refused.
"""

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
"""Called with a stage's name and its finished part, 0 to 1."""


def silent(stage: str, fraction: float) -> None:
    """Ignore the progress of ``stage``, its finished ``fraction``: the :data:`Progress` of who wants none."""


@dataclass(frozen=True)
class CompiledKernels:
    """Kernels that were in no cache: their ``number``, and the wall ``seconds`` that it took to compile them."""

    number: int = 0
    seconds: float = 0.0

    def since(self, earlier: CompiledKernels) -> CompiledKernels:
        """Return those that were compiled after ``earlier``."""
        return CompiledKernels(self.number - earlier.number, self.seconds - earlier.seconds)


_compiled, _counting = CompiledKernels(), threading.Lock()


def compiled_kernels() -> CompiledKernels:
    """All kernels that this process has compiled. Waits for those that were launched, and takes Dr.Jit's history.

    Dr.Jit keeps a copy of each launched kernel's text, some 0.2 MB, until it is asked: who launches many asks now and
    then, where there is nothing to wait for.
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
    """A receiver of progress, such as the rows on a terminal. This one ignores it all."""

    def begin(self, stage: str) -> None:
        """Note that the ``stage`` goes on from here."""

    def end(self, stage: str, seconds: float) -> None:
        """Note that the ``stage`` is over, or waits for its next turn; ``seconds`` all in all so far."""

    def predict(self, seconds: Mapping[str, float]) -> None:
        """Note the ``seconds`` that stages to come are predicted to take, by name."""

    def report(self, stage: str, fraction: float) -> None:
        """Note the finished ``fraction``, 0 to 1, of a ``stage``, or of a loop over several: a :data:`Progress`."""


@checked_fields
class Clock:
    """Seconds by stage, in the order of first use.

    Parameters
    ----------
    start
        seconds that the program has run already, which count as a stage of that name.
    watch
        receiver of progress.
    prefix
        before their names, there.
    """

    def __init__(self, start: float = 0.0, watch: Watch | None = None, prefix: str = "") -> None:
        self._compiled = compiled_kernels()  # which may wait, and counts as nobody's time
        self._started, self._watch, self._prefix = time.perf_counter() - start, watch or Watch(), prefix
        self._stages: dict[str, float] = {}
        if start:
            self._add("start", start)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time spent inside the context to ``name``."""
        started = time.perf_counter()
        self._watch.begin(self._prefix + name)
        try:
            yield
        finally:
            self._add(name, time.perf_counter() - started)

    @check_arguments
    def predict(self, stages: Mapping[str, float]) -> None:
        """Report the predicted seconds of ``stages``; those that have begun are left out."""
        self._watch.predict({self._prefix + name: own for name, own in stages.items() if name not in self._stages})

    def apart(self, prefix: str) -> Clock:
        """Return a clock for a part of the work, watched by the same with ``prefix`` before its stages' names."""
        return Clock(0.0, self._watch, self._prefix + prefix)

    @check_arguments
    def add(self, stages: Mapping[str, float], prefix: str = "") -> None:
        """Take over the ``stages`` [s] of another clock, except its total, ``prefix`` before their names."""
        try:
            sum(stages.values())
        except TypeError:
            raise ArgumentError("stages", f"{cut(repr(stages))}: give seconds by name") from None
        for name, seconds in stages.items():
            if name != "total":
                self._add(prefix + name, seconds)

    def seconds(self) -> dict[str, float]:
        """Stages and ``total`` since the clock was made [s]."""
        return {**self._stages, "total": time.perf_counter() - self._started}

    def kernels(self) -> dict[str, float]:
        """Return the ``number`` of kernels compiled since the clock was made, and the ``seconds`` that it took.

        Later runs find them in Dr.Jit's cache, and are the faster by so much.
        """
        return asdict(compiled_kernels().since(self._compiled))

    def _add(self, name: str, seconds: float) -> None:
        self._stages[name] = self._stages.get(name, 0.0) + seconds
        self._watch.end(self._prefix + name, self._stages[name])


# ---- What work may take ----


@checked_fields
@dataclass(frozen=True)
class Limits:
    """Limits of one command: wall seconds, and bytes of memory (None: nine tenths of what is free)."""

    seconds: float = 86400.0
    memory_bytes: float | None = None

    def __post_init__(self) -> None:
        if not self.seconds > 0:
            raise ArgumentError("max_seconds", f"{self.seconds:g}: give a number above 0")
        if self.memory_bytes is not None and not self.memory_bytes > 0:
            raise ArgumentError("max_memory", f"{self.memory_bytes / 2**30:g}: give a number of GiB above 0")


@dataclass(frozen=True)
class Cost:
    """Estimated cost of a work: wall seconds, bytes of memory beyond those in use now, bytes of disk."""

    seconds: float = 0.0
    memory_bytes: float = 0.0
    disk_bytes: float = 0.0

    def check(self, what: str, limits: Limits, output: Path | None = None) -> None:
        """Refuse work that takes too much.

        Parameters
        ----------
        what
            the work, for the message.
        limits
            on time and memory.
        output
            where it writes, if it does.

        Raises
        ------
        MitsimError
            when the work takes more than its limits, or than the disk of ``output`` has free.
        """
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
    """How one piece of long work is watched and bounded; of no influence on its results.

    Attributes
    ----------
    clock
        takes the seconds of each stage.
    progress
        function that gets each stage and its finished part.
    limits
        beyond which the work is refused before it begins.
    command
        command line that asks for it, which manifests keep; None: Python does.
    """

    clock: Clock = field(default_factory=Clock)
    progress: Progress = silent
    limits: Limits = field(default_factory=Limits)
    command: str | None = None

    def apart(self, prefix: str) -> Job:
        """Return a job for a part of the work whose seconds are its own, ``prefix`` before its stages' names."""
        return replace(
            self, clock=self.clock.apart(prefix), progress=lambda stage, part: self.progress(prefix + stage, part)
        )

    @contextmanager
    def planning(self, what: str, least: Cost | None = None) -> Iterator[None]:
        """Enter the stage "plan", which is refused once the work has taken all seconds that its limits allow.

        Parameters
        ----------
        what
            the work, for the message.
        least
            least cost that is known before a plan; None: not known.

        Raises
        ------
        MitsimError
            where that is more than the limits allow, and when the seconds are over before the plan is made.
        """
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


# ---- What this machine has left, and what this process has taken ----

_CGROUPS = (
    (Path("/sys/fs/cgroup"), "memory.max", "memory.current", "inactive_file"),
    (Path("/sys/fs/cgroup/memory"), "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
)
"""Where control groups of version 2 and 1 say what a container may take, what it takes, and how much of that is cache
of files, which the kernel gives back when it is needed."""
_USABLE = 0.9
"""Part of the free memory that work may take: the rest is for what estimates and other programs add."""


def free_memory() -> float:
    """Bytes that this process can still take: the machine's, its control group's, or its own limit's, the least."""
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
    """Return the bytes of memory that this process holds, and count the peak from here where the system lets it."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # proc(5): the peak becomes what is held now
    import psutil

    return float(psutil.Process().memory_info().rss)


def memory_since(held: float) -> float:
    """Return the bytes of memory taken at most beyond those ``held`` at :func:`memory_from_here`."""
    try:
        # Not getrusage, where there is this: its peak is inherited from the process that started this one.
        lines = Path("/proc/self/status").read_text().splitlines()
        peak = next(int(line.split()[1]) * 1024.0 for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        import resource  # not on Windows

        peak = float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * (1 if sys.platform == "darwin" else 1024)
    return max(peak - held, 0.0)


def running_seconds() -> float:
    """Return the seconds since this process began, which its start took when work begins."""
    try:
        # proc(5): in ticks since boot. psutil adds the time of boot to it, which Linux tells in whole seconds.
        began = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19]) / os.sysconf("SC_CLK_TCK")
        return max(time.clock_gettime(time.CLOCK_BOOTTIME) - began, 0.0)
    except (OSError, AttributeError):  # not Linux
        import psutil

        return max(time.time() - float(psutil.Process().create_time()), 0.0)


def free_disk(path: Path) -> float:
    """Bytes left on the disk where ``path`` is, or will be."""
    existing = next(place for place in (path.absolute(), *path.absolute().parents) if place.exists())
    return float(shutil.disk_usage(existing).free)


def size_text(count: float) -> str:
    """Return a ``count`` of bytes for people."""
    return f"{count / 2**30:.3g} GiB" if count >= 1000 * 2**20 else f"{count / 2**20:.3g} MiB"


# -------- Progress on a terminal, in a notebook or in a log

SECONDS_A_LINE = 60.0
"""Least time between two lines of progress in a log [s]: a run of an hour leaves a page of them, a short one none."""
_SHORTEST_S = 0.05
"""Stages below this get no row: they would say 0.0 s."""
_REFRESHES = 5
"""Times a second that rows are written: 2.7 ms of a processor each, eight of them, 1.3 % of one."""
_BAR = 24
"""Characters of a bar: with a stage's name and two times it fits into a terminal of 80."""


@check_arguments
@contextmanager
def progress(limits: Limits | None = None, hidden: bool = False, start: float = 0.0) -> Iterator[Job]:
    """Make a job that shows how far it is while the context lasts.

    It shows rows on a terminal and in a notebook, else a line a minute on standard error.

    Parameters
    ----------
    limits
        on the work; None: a day, and nine tenths of the memory that is free.
    hidden
        whether nothing is shown.
    start
        seconds that the program has run already, which count as a stage of that name.

    Raises
    ------
    MitsimError
        for arguments of another kind.

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
    """Progress as lines of a log on stderr, the first after :data:`SECONDS_A_LINE`."""

    def __init__(self) -> None:
        self._written = time.monotonic()

    def report(self, stage: str, fraction: float) -> None:
        """Write ``stage`` and its finished ``fraction`` if the last line is old enough."""
        if time.monotonic() - self._written >= SECONDS_A_LINE:
            self._written = time.monotonic()
            sys.stderr.write(f"mitsim: {printable(stage)} ({fraction:.0%})\n")
            sys.stderr.flush()


@dataclass
class _Row:
    """One stage on a terminal.

    It has its name or last report, the seconds of earlier turns, the begin of the present turn, the seconds and the
    part that its rate counts from, and its seconds at its end by its rate or by the plan.
    """

    words: str
    spent: float = 0.0
    begun: float | None = None
    origin: tuple[float, float] = (0.0, 0.0)
    ends: float | None = None

    def seconds(self, now: float) -> float:
        """Return the seconds of all turns until ``now``."""
        return self.spent + (0.0 if self.begun is None else now - self.begun)

    def rest(self, now: float) -> float:
        """Return the seconds that are left; 0 where they are unknown, as once it takes longer than predicted."""
        return 0.0 if self.ends is None else max(self.ends - self.seconds(now), 0.0)


class _Rows(Watch):
    """Progress as rows of a terminal: a stage's bar, its seconds, and those that are left by its own rate or the plan.

    A loop over several stages, such as frames that are formed, exposed and written in turns, reports under a name of
    its own, of which no stage runs. It has a row too, and its rate says how long all goes on.
    """

    def __init__(self, start: float) -> None:
        self._rows: dict[str, _Row] = {}
        self._loop: _Row | None = None
        self._started = time.monotonic() - start

    def begin(self, stage: str) -> None:
        """Begin a turn of ``stage``."""
        row = self._rows.setdefault(stage, _Row(stage))
        if row is self._loop:
            self._loop = None
        row.begun, row.origin = time.monotonic(), (row.spent, 0.0)
        self._show_again()

    def end(self, stage: str, seconds: float) -> None:
        """End a turn of ``stage`` after ``seconds`` in all turns."""
        row = self._rows.setdefault(stage, _Row(stage))
        row.spent, row.begun = seconds, None
        self._show_again()

    def predict(self, seconds: Mapping[str, float]) -> None:
        """Add rows of stages to come, with the ``seconds`` that they are predicted to take."""
        for stage, own in seconds.items():
            row = self._rows.setdefault(stage, _Row(stage))
            row.ends = row.spent + own

    def report(self, stage: str, fraction: float) -> None:
        """Show that a ``fraction`` of a stage or of a loop is finished; the rest takes as long as that did."""
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
            # With 16 colours rich's own for what is finished is that of what is not begun.
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
        """Do nothing, because a terminal's rows are written again by rich."""


class _Cell(_Rows):
    """The same rows below a cell of a notebook.

    They are written anew at most :data:`_REFRESHES` times a second; the last ones stay.
    """

    _handle: Any = None
    _written = 0.0

    def _show_again(self) -> None:
        if time.monotonic() - self._written >= 1 / _REFRESHES:
            self.show()

    def show(self) -> None:
        """Write the rows as they are now."""
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
    """Return seconds as a clock shows them."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
