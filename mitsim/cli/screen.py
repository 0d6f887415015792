"""What the terminal shows: results and warnings in; text, JSON and an exit status out."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsim.core.errors import MitsimError, printable
from mitsim.core.spectral_manifests import RUN, read_colours

if TYPE_CHECKING:
    from mitsim.light.plan import Plan


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
        **{name: results[colours.names[-1]].get(name) for name in ("seconds", "kernels")},
        **{name: results[colours.names[0]].get(name) for name in ("colour",) if kind == RUN},
        "warnings": tuple(f"{name}: {text}" for name, result in results.items() for text in result["warnings"]),
        "output": str(output),
    }


def kernel_lines(kernels: Mapping[str, float]) -> list[str]:
    """The line that is said of compiled ``kernels``: their number and seconds; none where there are none."""
    if not kernels["number"]:
        return []
    return [
        f"{kernels['number']} kernels compiled in {kernels['seconds']:.1f} s of these; Dr.Jit's cache holds them for "
        "later runs"
    ]


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
