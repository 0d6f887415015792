"""What the terminal shows: pages of help; results, warnings and the pages of their folders, as text or JSON.

Help is plain text, on a terminal or not. Typer's panels of rich take half as long again to show, leave a sentence 22 of
80 characters, and take `mitsim[learn]` for markup.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import signal
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperCommand, TyperGroup

from mitsim.cli.commands import Pictured, message_of
from mitsim.core.configuration import OUTPUT, PANELS
from mitsim.core.errors import MitsimError, printable
from mitsim.core.files import PICTURES
from mitsim.core.manifests import RUN, read_colours

if TYPE_CHECKING:
    import numpy.typing as npt

    from mitsim.light.plan import Plan, PlanRow

# ---- pages of help ---------------------------------------------------------------------------------------------------

_NARROWEST = 30
"""Columns that a page has at least: an option and a word beside it."""
_FIRST_COLUMN = 3 / 8
"""Part of the width that names of options have at most, so that what is said of them has twelve words of 80 columns and
five of 40; chosen."""


def parts_of(text: str | None) -> tuple[str, str, tuple[str, ...]]:
    """Split the ``text`` of a docstring into its first line, its other prose, and its commands, the lines after a $."""
    prose, *examples = re.split(r"\n\s*\$ ", (text or "").rstrip())
    summary, _, more = prose.partition("\n")
    return summary, more.strip(), tuple(examples)


class _Page:
    """What the pages of verbs and of the program share."""

    help: str | None

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the page.

        Parameters
        ----------
        ctx, formatter
            of the command line, and what takes the text; click makes it no narrower than 50 columns.
        """
        formatter.width = min(formatter.width, max(shutil.get_terminal_size().columns - 2, _NARROWEST))
        self.format_usage(ctx, formatter)  # type: ignore[attr-defined]
        summary, more, examples = parts_of(self.help)
        for text in filter(None, (summary, more)):
            formatter.write_paragraph()
            with formatter.indentation():
                formatter.write_text(text)
        self.format_options(ctx, formatter)  # type: ignore[attr-defined]
        if examples:
            with formatter.section(_heading("Examples")):
                for line in examples:
                    formatter.write(f"  {line}\n")


class Verb(_Page, TyperCommand):
    """A verb, whose page has a heading for each panel of its options, and examples in the end."""

    def format_usage(self, ctx: Any, formatter: Any) -> None:
        """Write the line of what must be given.

        Parameters
        ----------
        ctx, formatter
            as :meth:`format_help` takes them.
        """
        words = [f"{each.opts[0]} {each.metavar}" if _is_option(each) else _name(each) for each in self.params
                 if each.required or not _is_option(each)]  # fmt: skip
        formatter.write_usage(ctx.command_path, " ".join([*words, "[OPTIONS]"]))

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write all that may be given, by panels.

        Parameters
        ----------
        ctx, formatter
            as :meth:`format_help` takes them.
        """
        shown = self.get_params(ctx)
        panels = {"Arguments": [each for each in shown if not _is_option(each)]}
        for name in PANELS:
            panels[name] = [each for each in shown if _is_option(each) and (_panel(each) or OUTPUT) == name]
        _write_panels({name: [(_name(each), _meaning(each)) for each in panel] for name, panel in panels.items()},
                      formatter)  # fmt: skip


class Program(_Page, TyperGroup):
    """The program, whose page has its verbs by panels, a whole line for each."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write verbs and options.

        Parameters
        ----------
        ctx, formatter
            as :meth:`format_help` takes them.
        """
        panels = {
            str(panel): [(str(verb.name), parts_of(verb.help)[0]) for verb in verbs]
            for panel, verbs in groupby(self.commands.values(), _panel)
        }
        _write_panels(panels, formatter)
        _write_panels({"Options": [(_name(each), _meaning(each)) for each in self.get_params(ctx)]}, formatter)


def _write_panels(panels: Mapping[str, Sequence[tuple[str, str]]], formatter: Any) -> None:
    """Write rows of names and meanings under their headings, with the same columns for all headings."""
    most = int(_FIRST_COLUMN * formatter.width)
    width = max((len(name) for rows in panels.values() for name, _ in rows if len(name) <= most), default=0)
    for heading, rows in panels.items():
        if rows:
            with formatter.section(_heading(heading)):
                formatter.write_dl([(name.ljust(width), meaning) for name, meaning in rows], col_max=width)


def _heading(text: str) -> str:
    return typer.style(text, bold=True)  # left out where nobody would see it


def _is_option(parameter: Any) -> bool:
    return bool(parameter.param_type_name == "option")


def _panel(holder: Any) -> Any:
    return holder.rich_help_panel if hasattr(holder, "rich_help_panel") else None


def _name(parameter: Any) -> str:
    """Return what a user types for a parameter: its names, the shortest first, and the word for its value."""
    if not _is_option(parameter):
        return str(parameter.metavar)
    names = ", ".join(sorted(parameter.opts, key=len))
    return names if parameter.is_flag or not parameter.metavar else f"{names} {parameter.metavar}"


def _meaning(parameter: Any) -> str:
    least, most = (getattr(parameter, end, None) for end in ("min", "max"))
    allowed = f"{least} to {most}" if most is not None else f"at least {least}" if least is not None else ""
    needed = "required" if parameter.required and _is_option(parameter) else ""
    return "; ".join(filter(None, [parameter.help, allowed, _default(parameter), needed]))


def _default(parameter: Any) -> str:
    shown = parameter.show_default
    if isinstance(shown, str):
        return f"default {shown}"
    value = parameter.default
    if not shown or value in (None, "", ()) or isinstance(value, bool):
        return ""
    return f"default {value:g}" if isinstance(value, float) else f"default {value}"


# ---- results ---------------------------------------------------------------------------------------------------------

_COLUMNS = 80
"""Of the usual terminal, and of what is no terminal."""


def plan_lines(plan: Plan, everything: bool = False) -> list[str]:
    """Return the lines that the terminal shows of a ``plan``: its result, then its effects. An effect that is left out
    is shown if its error is unknown or within two decades of the accuracy; ``everything`` shows all effects with their
    whole reasons. Effects without room on the screen are named at its end."""
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
    """Return the lines of the ``rows`` for which there is ``room`` under two headings, and the other rows."""
    indent, lines = " " * len(_HEAD.format("", "", "", "")), [_HEAD.format(heading, "error if off", "seconds", words)]
    for number, row in enumerate(rows):
        text = wrap_text(_row_text(row, row.reason or row.state), indent)
        if len(lines) + len(text) > room:
            return lines, [*rows[number:]]
        lines += text
    return (lines if rows else []), []


def wrap_text(text: str, indent: str = "") -> list[str]:
    """Wrap a ``text`` to the width of the terminal. Further lines follow an ``indent``; names and paths stay whole."""
    width = shutil.get_terminal_size((_COLUMNS, _SCREEN_LINES)).columns
    indent = indent or text[: len(text) - len(text.lstrip())] or "  "
    lines = textwrap.wrap(text, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return lines or [""]


def finish(as_json: bool, payload: Any, lines: Sequence[str], warnings: Sequence[str]) -> int:
    """Print a result; return exit status 1 if there are warnings.

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
    """Return the JSON of a coloured run or calibration.

    Parameters
    ----------
    kind
        of its folder, one of :data:`mitsim.core.manifests.KINDS`.
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
    """Return the line on compiled ``kernels``, if there are any."""
    if not kernels["number"]:
        return []
    return [f"{kernels['number']} kernels compiled in {kernels['seconds']:.1f} s of these; Dr.Jit's cache keeps them"]


def memory_line(payload: Mapping[str, Any]) -> str:
    """Return the line on the memory that a capture or calibration used."""
    taken = f"Memory {payload['memory_bytes'] / 2**30:.2g} GiB"
    most = payload.get("predicted_memory_bytes")  # of real frames nothing is predicted
    return taken if most is None else f"{taken} of at most {most / 2**30:.2g} predicted"


def total_of_lines(payload: Mapping[str, Any]) -> str:
    return f"{len(payload['channels'])} lines in {payload['seconds']['total']:.1f} s: {payload['output']}"


@contextmanager
def write_at_end() -> Iterator[None]:
    """Write what is printed in this context at its end. If nobody reads standard output any more, end the program
    quietly as SIGPIPE does; raise MitsimError if it cannot be written for another reason, such as a full disk."""
    try:
        yield
        sys.stdout.flush()
    except OSError as error:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - what the exit writes has to go somewhere
        if isinstance(error, BrokenPipeError):
            sys.exit(128 + signal.SIGPIPE)
        raise MitsimError(f"standard output: cannot be written ({error.strerror}); give it another place") from None


# ---- pages and pictures of results -----------------------------------------------------------------------------------


def finish_folder(
    options: Pictured, folder: Path, payload: dict[str, Any], lines: Sequence[str], warnings: Sequence[str]
) -> int:
    """Make the pictures and the page of a finished folder, and print the result; return the exit status.

    Parameters
    ----------
    options
        of the verb.
    folder
        of the work, which is not lost where they cannot be made: a warning says so.
    payload, lines, warnings
        as for :func:`mitsim.cli.screen.finish`; JSON gains ``report``, null without a page.
    """
    again = f"`mitsim report {folder}` makes them later"
    made, failed = _attempt(options, lambda: page_of(folder), again)
    said = [] if made is None else [page_line(made)]
    return finish(options.as_json, {**payload, "report": made}, [*lines, *said], [*warnings, *failed])


def finish_frame(
    options: Pictured,
    frame: tuple[Path, npt.NDArray[Any], str],
    payload: dict[str, Any],
    lines: Sequence[str],
    warnings: Sequence[str],
) -> int:
    """Make a picture next to a file of one frame, and print the result; return the exit status.

    Parameters
    ----------
    options
        of the verb.
    frame
        its file, its numbers (rows, columns), or (rows, columns, 3) in colour, and their unit.
    payload, lines, warnings
        as for :func:`mitsim.cli.screen.finish`; JSON gains ``picture``, null without one.
    """

    def make() -> dict[str, Any]:
        from mitsim.report.pages import write_beside

        started = time.perf_counter()
        file, words = write_beside(*frame)
        return {"file": str(file), "shows": words, "seconds": time.perf_counter() - started}

    made, failed = _attempt(options, make, "the frame is kept")
    said = [] if made is None else [f"picture {made['file']}: {made['shows']}"]
    return finish(options.as_json, {**payload, "picture": made}, [*lines, *said], [*warnings, *failed])


def page_of(folder: Path) -> dict[str, Any]:
    """Make the page and the pictures of a ``folder``, and return their JSON."""
    started = time.perf_counter()
    from mitsim.report.folder_page import report_folder

    page = report_folder(folder)
    pictures = sorted(map(str, (folder / PICTURES).glob("*.png")))
    return {"page": str(page), "pictures": pictures, "seconds": time.perf_counter() - started}


def page_line(made: dict[str, Any]) -> str:
    return f"Page: {made['page']} (pictures in {made['seconds']:.1f} s)"


def _attempt(
    options: Pictured, make: Callable[[], dict[str, Any]], kept: str
) -> tuple[dict[str, Any] | None, tuple[str, ...]]:
    """Return what ``make`` makes, unless pictures are not wanted. If it fails, return nothing and a warning that states
    what is ``kept``."""
    if options.no_pictures:
        return None, ()
    try:
        return make(), ()
    except MitsimError as error:
        return None, (f"pictures: {message_of(error)}; {kept}",)
    except (OSError, MemoryError) as error:
        return None, (f"pictures: {getattr(error, 'strerror', None) or 'out of memory'}; {kept}",)
