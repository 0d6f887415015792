"""Progress of long work: stages and their parts in; rows on a terminal or in a notebook, or lines of a log, out."""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mitsim.core.errors import check_arguments, printable
from mitsim.core.job import Clock, Job, Limits, Watch
from mitsim.core.worker import has_rows

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions
    from rich.table import Table

SECONDS_A_LINE = 60.0
"""Least time between two lines of progress in a log [s]: a run of an hour leaves a page of them, a short one none."""
_SHORTEST_S = 0.05
"""Stages below this get no row: they would say 0.0 s."""
_REFRESHES = 5
"""Times a second that rows are written: 2.7 ms of a processor each, eight of them, 1.3 % of one."""
_BAR = 24
"""Characters of a bar: with a stage's name and two times it fits into a terminal of 80."""
_CELL_WIDTH = 80
"""Characters of a line below a cell of a notebook: those of a terminal."""
_CELL_PAGE = '<pre style="font-family:monospace;line-height:1.3">{code}</pre>'
"""What rows are put into there, as rich fills it."""


# ---- A job that is watched -------------------------------------------------------------------------------------------


@check_arguments
@contextmanager
def progress(limits: Limits | None = None, hidden: bool = False, start: float = 0.0) -> Iterator[Job]:
    """A job that shows how far it is while the context lasts: rows on a terminal and in a notebook, else a line a
    minute on standard error.

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
    with _watch(hidden, start) as watch:
        yield Job(Clock(start, watch), watch.report, limits or Limits())


@contextmanager
def _watch(hidden: bool, start: float) -> Iterator[Watch]:
    """Who is told, and shows it."""
    if hidden:
        yield Watch()
    elif in_notebook():
        cell = _Cell(start)
        try:
            yield cell
        finally:
            cell.show()
    elif not has_rows():
        yield _Log()
    else:
        from rich.console import Console
        from rich.live import Live

        rows = _Rows(start)
        with Live(rows, console=Console(stderr=True), transient=True, refresh_per_second=_REFRESHES):
            yield rows


def in_notebook() -> bool:
    """Whether this process is the kernel of a notebook, whose cells can show something anew."""
    interactive = sys.modules.get("IPython")
    shell = interactive and interactive.get_ipython()
    return getattr(shell, "kernel", None) is not None


class _Log(Watch):
    """Progress as lines of a log on stderr, the first after :data:`SECONDS_A_LINE`."""

    def __init__(self) -> None:
        self._written = time.monotonic()

    def report(self, stage: str, fraction: float) -> None:
        """Write ``stage``, its finished ``fraction``, if the last line is old enough."""
        if time.monotonic() - self._written >= SECONDS_A_LINE:
            self._written = time.monotonic()
            sys.stderr.write(f"mitsim: {printable(stage)} ({fraction:.0%})\n")
            sys.stderr.flush()


@dataclass
class _Row:
    """What a terminal shows of one stage.

    Attributes
    ----------
    words
        its name, or what was reported of it last.
    spent, begun
        its seconds in earlier turns, and when the present turn began; None between turns.
    last
        when its last turn began; None before the first.
    origin
        its seconds when the loop that it is in began.
    part
        that is finished; None where nobody says.
    ends
        its seconds at its end, as its own rate says, or the plan; None where neither does.
    """

    words: str
    spent: float = 0.0
    begun: float | None = None
    last: float | None = None
    origin: float = 0.0
    part: float | None = None
    ends: float | None = None

    def seconds(self, now: float) -> float:
        """Its seconds until ``now``."""
        return self.spent + (0.0 if self.begun is None else now - self.begun)

    def begin(self, now: float) -> None:
        """A turn begins ``now``."""
        self.begun = self.last = now

    def reach(self, part: float, now: float) -> None:
        """So much is finished ``now``; what is left takes as long as that did."""
        self.part, taken = part, self.seconds(now) - self.origin
        if part > 0 and taken > 0:
            self.ends = self.origin + taken / part

    def part_at(self, now: float) -> float | None:
        """Part that is finished, by time as far as it is known; None where nothing tells it."""
        if self.last is None:
            return 0.0
        if left := self.rest(now):
            return 1 - left / (left + self.seconds(now) - self.origin)
        return self.part

    def rest(self, now: float) -> float:
        """Seconds that it goes on; 0 where nothing tells them, as once it takes longer than was predicted."""
        return 0.0 if self.ends is None else max(self.ends - self.seconds(now), 0.0)


class _Rows(Watch):
    """Progress as rows of a terminal: a stage's bar, its seconds, and those that are left by its own rate or the plan.

    A loop over several stages, such as the frames that are formed, exposed and written in turns, reports under a name
    of its own: it has a row too, and stages that have had a turn in it are as far as it is.
    """

    def __init__(self, start: float) -> None:
        self._rows: dict[str, _Row] = {}
        self._loop: _Row | None = None
        self._first = 0.0
        self._started = time.monotonic() - start

    def begin(self, stage: str) -> None:
        """A turn of ``stage`` begins."""
        row = self._row(stage)
        if row is self._loop:
            self._loop = None
        if self._loop is None:
            row.origin, row.part = row.spent, None
        row.begin(time.monotonic())

    def end(self, stage: str, seconds: float) -> None:
        """A turn of ``stage`` ends, after ``seconds`` in all turns."""
        row, now = self._row(stage), time.monotonic()
        row.spent, row.begun, row.last = seconds, None, now if row.last is None else row.last

    def predict(self, seconds: Mapping[str, float]) -> None:
        """Rows of stages to come, with the ``seconds`` that they are predicted to take."""
        for stage, own in seconds.items():
            row = self._row(stage)
            row.ends = row.spent + own

    def report(self, stage: str, fraction: float) -> None:
        """A ``fraction`` of a stage, or of a loop, is finished."""
        name, now = stage.partition(":")[0], time.monotonic()
        row = self._row(name)
        row.words = stage.partition(",")[0]
        if row.begun is None:
            self._end_loop(now)
            row.begin(now)
            self._loop, self._first = row, min(fraction, 0.999)  # a loop that is over when it begins
            for each in self._rows.values():
                each.origin = each.seconds(now)
        if row is self._loop:  # which may go on from where an earlier run left it
            done = max(fraction - self._first, 0.0) / (1 - self._first)
            for each in self._in_loop():
                each.reach(done, now)
        else:
            row.reach(fraction, now)
        if row is self._loop and fraction >= 1:
            self._end_loop(now)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table]:
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        now, table = time.monotonic(), Table.grid(padding=(0, 2))
        table.add_column(no_wrap=True, overflow="ellipsis", min_width=18)
        for _ in range(3):
            table.add_column(no_wrap=True, justify="right")
        rows = [row for row in list(self._rows.values()) if self._is_shown(row, now)]
        most = console.size.height - 2  # the last one and the cursor's
        if len(rows) > most:
            rows = [row for row in rows if not self._is_over(row)][:most]
        for row in rows:
            over = self._is_over(row)
            part = 1.0 if over else row.part_at(now)
            # With 16 colours rich's own for what is finished is that of what is not begun.
            bar = ProgressBar(1.0, part or 0.0, _BAR, pulse=part is None, finished_style="green")
            elapsed, left = row.seconds(now), 0.0 if over else row.rest(now)
            table.add_row(Text(printable(row.words)), bar, _text(elapsed) if elapsed else "", _rest_text(left))
        table.add_row("total", "", _text(now - self._started), _rest_text(self._rest(now)))
        yield table

    def _row(self, stage: str) -> _Row:
        return self._rows.setdefault(stage, _Row(stage))

    def _in_loop(self) -> list[_Row]:
        """The loop and the stages that have had a turn in it."""
        loop = self._loop
        if loop is None or loop.last is None:
            return []
        return [row for row in list(self._rows.values()) if row.last is not None and row.last >= loop.last]

    def _end_loop(self, now: float) -> None:
        if self._loop is not None:
            self._loop.spent, self._loop.begun, self._loop = self._loop.seconds(now), None, None

    def _is_over(self, row: _Row) -> bool:
        return row.last is not None and row.begun is None and not any(row is each for each in self._in_loop())

    def _is_shown(self, row: _Row, now: float) -> bool:
        length = row.seconds(now) if row.last is not None else row.rest(now)
        return row.begun is not None or length >= _SHORTEST_S

    def _rest(self, now: float) -> float:
        """Seconds that are left of everything: of all stages, or of a loop where nothing is known of these; 0 where one
        goes on for nobody knows how long."""
        loop = self._loop
        rows = [row for row in list(self._rows.values()) if not self._is_over(row)]
        if any(row.begun is not None and row is not loop and not row.rest(now) for row in rows):
            rows = []
        return sum(row.rest(now) for row in rows if row is not loop) or (loop.rest(now) if loop else 0.0)


class _Cell(_Rows):
    """The same rows below a cell of a notebook, written anew at most :data:`_REFRESHES` times a second; the last ones
    stay."""

    def __init__(self, start: float) -> None:
        super().__init__(start)
        self._handle: Any = None
        self._written = 0.0

    def begin(self, stage: str) -> None:
        """A turn of ``stage`` begins."""
        super().begin(stage)
        self._show_again()

    def end(self, stage: str, seconds: float) -> None:
        """A turn of ``stage`` ends, after ``seconds`` in all turns."""
        super().end(stage, seconds)
        self._show_again()

    def report(self, stage: str, fraction: float) -> None:
        """A ``fraction`` of a stage, or of a loop, is finished."""
        super().report(stage, fraction)
        self._show_again()

    def _show_again(self) -> None:
        if time.monotonic() - self._written >= 1 / _REFRESHES:
            self.show()

    def show(self) -> None:
        """Write the rows as they are now."""
        self._written = time.monotonic()
        from IPython.display import HTML, display
        from rich.console import Console

        console = Console(
            file=io.StringIO(), record=True, width=_CELL_WIDTH, force_jupyter=False, color_system="truecolor"
        )
        console.print(self)
        page = HTML(console.export_html(inline_styles=True, code_format=_CELL_PAGE))
        if self._handle is None:
            self._handle = display(page, display_id=True)
        else:
            self._handle.update(page)


def _rest_text(seconds: float) -> str:
    return f"{_text(seconds)} left" if seconds >= _SHORTEST_S else ""


def _text(seconds: float) -> str:
    """Seconds as a clock shows them."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
