"""What the terminal shows: results, warnings and progress in; text, JSON and an exit status out."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import sys
import textwrap
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsim.core.errors import MitsimError, printable
from mitsim.core.job import Watch
from mitsim.core.spectral_manifests import RUN, read_colours
from mitsim.core.worker import has_rows

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions
    from rich.table import Table

    from mitsim.light.plan import Plan, PlanRow

SECONDS_A_LINE = 60.0
"""Least time between two lines of progress in a log [s]: a run of an hour leaves a page of them, a short one none."""
_SHORTEST_S = 0.05
"""Stages below this get no row: they would say 0.0 s."""
_REFRESHES = 5
"""Times a second that rows are written: 2.7 ms of a processor each, eight of them, 1.3 % of one."""
_COLUMNS = 80
"""Of the usual terminal, and of what is no terminal."""
_BAR = 24
"""Characters of a bar: with a stage's name and two times it fits into a terminal of 80."""


@contextmanager
def showing_progress(hidden: bool, start: float = 0.0) -> Iterator[Watch]:
    """Progress on stderr: on a terminal a row for each stage, else a line a minute; nothing when ``hidden``.

    ``start``: seconds that the program has run already.
    """
    if hidden:
        yield Watch()
    elif not has_rows():
        yield _Log()
    else:
        from rich.console import Console
        from rich.live import Live

        rows = _Rows(start)
        with Live(rows, console=Console(stderr=True), transient=True, refresh_per_second=_REFRESHES):
            yield rows


class _Log(Watch):
    """Progress as lines of a log on stderr, the first after :data:`SECONDS_A_LINE`."""

    def __init__(self) -> None:
        self._written = time.monotonic()

    def report(self, stage: str, fraction: float) -> None:
        """Write ``stage``, its finished ``fraction``, if the last line is old enough."""
        if time.monotonic() - self._written >= SECONDS_A_LINE:
            self._written = time.monotonic()
            print(f"mitsim: {printable(stage)} ({fraction:.0%})", file=sys.stderr, flush=True)


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


def _rest_text(seconds: float) -> str:
    return f"{_text(seconds)} left" if seconds >= _SHORTEST_S else ""


def _text(seconds: float) -> str:
    """Seconds as a clock shows them."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def plan_lines(plan: Plan, everything: bool = False) -> list[str]:
    """What people read of a ``plan``: first what it comes to, then what it is made of.

    What is left out is named where its error is within two decades of the accuracy, or not known; ``everything`` tells
    all rows and their whole reasons. Rows that a screen has no room for are named at its end.
    """
    most = math.hypot(plan.systematic_bound, plan.sampling_target)
    gist = f"Plan at accuracy {plan.accuracy:g}: {plan.predicted_seconds:.3g} s, error up to {most:.1e}"
    stages = ", ".join(f"{name} {seconds:.3g}" for name, seconds in plan.predicted.items())
    after = [f"Seconds: {stages}", *filter(None, [plan.range_words]), *plan.notes]
    if plan.colour is not None and (everything or len(plan.colour.candidates) > 1):
        after.append(plan.colour.words)
    if plan.asked_seconds is not None:
        after.append(f"Accuracy {plan.accuracy:g} is the finest that {plan.asked_seconds:g} s buy")
    if plan.cost:
        memory, disk = plan.cost.memory_bytes / 2**30, plan.cost.disk_bytes / 2**20
        after.append(f"At most {memory:.2g} GiB of memory, {disk:.3g} MiB of disk")
    if everything:
        texts = [line for row in plan.effects for line in (_row_text(row, row.state), f"    {row.reason}")]
        return [gist, _HEAD.format("effect", "error if off", "seconds", "state"), *texts, *after]
    room = _SCREEN_LINES - sum(len(wrap_text(line)) for line in (gist, *after)) - 2  # what has no room
    rows = sorted(plan.effects, key=lambda row: -(row.error_if_off or 0.0))
    small = plan.accuracy * _WORTH_NAMING
    left_out = [row for row in rows if row.state == "off" and (row.error_if_off is None or row.error_if_off >= small)]
    off, no_room = _table("left out", "why", left_out, room // 2)
    on, more = _table("on", "how", [row for row in rows if row.state != "off"], room - len(off))
    silent = sum(row.state == "off" for row in rows) - len(left_out)
    unshown = ", ".join(row.name for row in (*more, *no_room))
    rest = f"No room for {unshown}, and for " if unshown else ""
    rest += f"{silent} {'' if unshown else 'more '}that nothing calls for (--all)"
    return [gist, *on, *off, rest, *after]


_HEAD = "{:16} {:>12} {:>7}  {}"
"""Columns of a plan: a name, two numbers and words."""
_SCREEN_LINES = 24
"""Of the usual terminal."""
_WORTH_NAMING = 1e-2
"""Part of the accuracy from which on what is left out is named: two decades, so a hundred may add up to it."""


def _row_text(row: PlanRow, words: str) -> str:
    error = "-" if row.error_if_off is None else f"{row.error_if_off:.1e}" if row.error_if_off else "0"
    return _HEAD.format(row.name, error, f"{row.seconds:.2f}", words)


def _table(heading: str, words: str, rows: Sequence[PlanRow], room: int) -> tuple[list[str], list[PlanRow]]:
    """Lines of the ``rows`` that have ``room`` under a ``heading`` and that of their ``words``, and the other rows."""
    indent, lines = " " * len(_HEAD.format("", "", "", "")), [_HEAD.format(heading, "error if off", "seconds", words)]
    for number, row in enumerate(rows):
        text = wrap_text(_row_text(row, row.gist), indent)
        if len(lines) + len(text) > room:
            return lines, [*rows[number:]]
        lines += text
    return (lines if rows else []), []


def wrap_text(text: str, indent: str = "") -> list[str]:
    """A ``text`` in lines as wide as the terminal, or of 80 characters, after the first behind an ``indent``; names and
    paths stay whole."""
    width = shutil.get_terminal_size((_COLUMNS, _SCREEN_LINES)).columns
    indent = indent or text[: len(text) - len(text.lstrip())] or "  "
    lines = textwrap.wrap(text, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return lines or [""]


def finish(as_json: bool, payload: Any, lines: Sequence[str], warnings: Sequence[str]) -> int:
    """Print the result; exit status 1 when there are warnings.

    Parameters
    ----------
    as_json
        one JSON object instead of text.
    payload, lines
        the result as that object, and as lines of text: first what it comes to, then where it is.
    warnings
        on stderr, in either case.
    """
    with write_at_end():
        if as_json:
            from mitsim.core.files import plain

            print(json.dumps(plain(payload), allow_nan=False))
        else:
            for line in lines:
                for part in printable(line).split("\n"):
                    # Columns of a table stay one below the other.
                    print(*([part] if "  " in part.strip() else wrap_text(part)), sep="\n")
    for warning in warnings:
        print(f"mitsim: warning: {printable(warning)}", file=sys.stderr)
    return 1 if warnings else 0


def payload_of_lines(kind: str, results: Mapping[str, Mapping[str, Any]], output: Path) -> dict[str, Any]:
    """JSON of a coloured run or calibration.

    Parameters
    ----------
    kind
        of its folder, one of :data:`mitsim.core.spectral_manifests.KINDS`.
    results
        JSON of each line, by its name.
    output
        the folder.
    """
    colours = read_colours(output, kind)
    return {
        "kind": colours.kind,
        "channels": [{**line.model_dump(), **results[line.name]} for line in colours.channels],
        **{name: results[colours.names[-1]].get(name) for name in ("seconds", "kernels")},
        **{name: results[colours.names[0]].get(name) for name in ("colour",) if kind == RUN},
        "warnings": tuple(f"{name}: {text}" for name, result in results.items() for text in result["warnings"]),
        "output": str(output),
    }


def kernel_lines(kernels: Mapping[str, float]) -> list[str]:
    """The line that is said of compiled ``kernels``: their number and seconds; none where there are none."""
    if not kernels["number"]:
        return []
    return [f"{kernels['number']} kernels compiled in {kernels['seconds']:.1f} s of these; Dr.Jit's cache keeps them"]


def memory_line(payload: Mapping[str, Any]) -> str:
    """The line that is said of the memory that a capture or calibration took, by its ``payload``."""
    taken, most = payload["memory_bytes"] / 2**30, payload["predicted_memory_bytes"] / 2**30
    return f"Memory {taken:.2g} GiB of at most {most:.2g} predicted"


def total_of_lines(payload: Mapping[str, Any]) -> str:
    """The first line of text of a ``payload`` as of :func:`payload_of_lines`."""
    return f"{len(payload['channels'])} lines in {payload['seconds']['total']:.1f} s: {payload['output']}"


@contextmanager
def write_at_end() -> Iterator[None]:
    """What is printed in this context is written when it ends. Where nobody reads any more, the program ends as by
    SIGPIPE, quietly; MitsimError where standard output takes no more for another reason, such as a full disk."""
    try:
        yield
        sys.stdout.flush()
    except OSError as error:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - what the exit writes has to go somewhere
        if isinstance(error, BrokenPipeError):
            sys.exit(128 + signal.SIGPIPE)
        raise MitsimError(f"standard output: cannot be written ({error.strerror}); give it another place") from None
