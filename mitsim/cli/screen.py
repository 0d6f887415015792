"""What the terminal shows: results and warnings in; text, JSON and an exit status out."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsim.core.errors import MitsimError, printable
from mitsim.core.spectral_manifests import RUN, read_colours

if TYPE_CHECKING:
    from mitsim.light.plan import Plan, PlanRow

_COLUMNS = 80
"""Of the usual terminal, and of what is no terminal."""


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
    taken = f"Memory {payload['memory_bytes'] / 2**30:.2g} GiB"
    most = payload.get("predicted_memory_bytes")  # of real frames nothing is predicted
    return taken if most is None else f"{taken} of at most {most / 2**30:.2g} predicted"


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
