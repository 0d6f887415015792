"""The help of the program and of its verbs: parameters, their panels and a docstring in; lines of text out.

Text alone, on a terminal or not. Typer's panels of rich take half as long again to show, leave a sentence 22 of 80
characters, and take `mitsim[learn]` for markup.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

WHAT, QUALITY, DEVICES = "What", "Quality", "Scene and devices"
OUTPUT, LIMITS = "Output", "Machine and limits"
_PANELS = WHAT, QUALITY, DEVICES, OUTPUT, LIMITS
"""Headings of options, in the order of a page."""
_NARROWEST = 30
"""Columns that a page has at least: an option and a word beside it."""
_FIRST_COLUMN = 3 / 8
"""Part of the width that names of options have at most, so that what is said of them has twelve words of 80 columns and
five of 40; chosen."""
_METAVARS: Mapping[type, str] = {float: "NUMBER", int: "N", str: "TEXT", Path: "PATH"}


def metavar_of(kinds: Iterable[Any]) -> str | None:
    """What stands for the value of an option whose type is one of some ``kinds``; None of a flag."""
    return next((_METAVARS[kind] for kind in kinds if kind in _METAVARS), None)


def parts_of(text: str | None) -> tuple[str, str, tuple[str, ...]]:
    """A docstring's ``text`` in three: its first line, all else that is said, and the commands, its lines after a $."""
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
        for name in _PANELS:
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
    """Write rows of names and meanings below a heading each, with the same columns in all of them."""
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
    """What is typed for a parameter: its names, shortest first, and what stands for its value."""
    if not _is_option(parameter):
        return str(parameter.metavar)
    names = ", ".join(sorted(parameter.opts, key=len))
    return names if parameter.is_flag or not parameter.metavar else f"{names} {parameter.metavar}"


def _meaning(parameter: Any) -> str:
    """What the help says of a parameter, with its default."""
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
