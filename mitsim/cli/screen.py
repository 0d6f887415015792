"""What the terminal shows: results, warnings and progress in; text, JSON and an exit status out."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsim.core.errors import MitsimError, printable
from mitsim.core.spectral_manifests import RUN, read_colours

if TYPE_CHECKING:
    from mitsim.core.job import Progress
    from mitsim.light.plan import Plan


SECONDS_A_LINE = 60.0
"""Least time between two lines of progress in a log [s]: a run of an hour leaves a page of them, a short one none."""


@contextmanager
def showing_progress(hidden: bool) -> Iterator[Progress]:
    """Progress on stderr: a bar on a terminal, else a line a minute; nothing when ``hidden``."""
    if hidden:
        from mitsim.core.job import silent

        yield silent
    elif not sys.stderr.isatty():
        yield _log()
    else:
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as Bar

        columns = TextColumn("{task.description:<18}", markup=False), BarColumn(), TimeElapsedColumn()
        with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task("starting", total=1.0)
            yield lambda stage, fraction: bar.update(task, description=printable(stage), completed=fraction)


def _log() -> Progress:
    """Progress as lines of a log on stderr, the first after :data:`SECONDS_A_LINE`."""
    written = time.monotonic()

    def line(stage: str, fraction: float) -> None:
        """Write ``stage``, its finished ``fraction``, if the last line is old enough."""
        nonlocal written
        if time.monotonic() - written >= SECONDS_A_LINE:
            written = time.monotonic()
            print(f"mitsim: {printable(stage)} ({fraction:.0%})", file=sys.stderr, flush=True)

    return line


def print_plan(plan: Plan) -> None:
    """Print the ``plan``'s effects, with reasons, and what it takes."""
    with write_at_end():
        _print_plan(plan)


def _print_plan(plan: Plan) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"Effect plan at accuracy {plan.accuracy:g}")
    for heading in ("effect", "state", "reason", "error if off", "seconds"):
        table.add_column(heading, justify="right" if heading in ("error if off", "seconds") else "left")
    for row in plan.effects:
        error = "-" if row.error_if_off is None else f"{row.error_if_off:.1e}"
        table.add_row(row.name, row.state, printable(row.reason), error, f"{row.seconds:.2f}")
    console = Console(markup=False)  # names of a scene stand in the reasons
    console.print(table)
    stages = ", ".join(f"{name} {seconds:.2f}" for name, seconds in plan.predicted.items())
    console.print(f"Predicted time from start to finish: {plan.predicted_seconds:.2f} s ({stages})")
    if plan.range_words:
        console.print(plan.range_words)
    for note in plan.notes:
        console.print(note)
    if plan.colour is not None:
        console.print(plan.colour.words)
    if plan.asked_seconds is not None:
        console.print(f"Accuracy {plan.accuracy:g} is the finest that {plan.asked_seconds:g} s buy")
    if plan.cost:
        memory, disk = plan.cost.memory_bytes / 2**30, plan.cost.disk_bytes / 2**20
        console.print(f"At most {memory:.2g} GiB of memory, {disk:.3g} MiB of disk")


def finish(as_json: bool, payload: Any, lines: Sequence[str], warnings: Sequence[str]) -> int:
    """Print the result; exit status 1 when there are warnings.

    Parameters
    ----------
    as_json
        one JSON object instead of text.
    payload, lines
        the result as that object, and as lines of text.
    warnings
        on stderr, in either case.
    """
    with write_at_end():
        if as_json:
            from mitsim.core.files import plain

            print(json.dumps(plain(payload), allow_nan=False))
        else:
            for line in lines:
                print(printable(line))
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
        "seconds": results[colours.names[-1]]["seconds"],
        **{name: results[colours.names[0]].get(name) for name in ("colour",) if kind == RUN},
        "warnings": tuple(f"{name}: {text}" for name, result in results.items() for text in result["warnings"]),
        "output": str(output),
    }


def total_of_lines(payload: Mapping[str, Any]) -> str:
    """The last line of text of a ``payload`` as of :func:`payload_of_lines`."""
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
