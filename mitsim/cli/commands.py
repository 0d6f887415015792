"""Commands from models of options, and their output on a terminal: pages of help, results, warnings and progress.

A verb is a function of one model, which declares all that its command line takes; :func:`command` makes the command.
Errors of the library speak of arguments; :func:`message_of` writes them as options.

Help is plain text, because rich's panels take half as long again to show.
"""

from __future__ import annotations

import copy
import functools
import inspect
import json
import os
import re
import shlex
import shutil
import signal
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import typer
from typer.core import TyperCommand, TyperGroup

from mitsim.core.colour_files import MOSAIC, RUN
from mitsim.core.configuration import LIMITS, OUTPUT, PANELS, WHAT, Options, option, shipped_files, validated_by
from mitsim.core.environment import DEFAULT_VARIANT, check_variant
from mitsim.core.errors import ArgumentError, MitsimError, printable
from mitsim.core.files import PICTURES, plain, replaced
from mitsim.core.job import Job, Limits, progress, running_seconds

if TYPE_CHECKING:
    import numpy.typing as npt

    from mitsim.light.plan import Plan

M = TypeVar("M", bound=Options)

# ---- Options that several verbs have ---------------------------------------------------------------------------------


def argument(default: Any, help: str, metavar: str, **shown: Any) -> Any:
    """Declare a field that the command line takes without a name; see :func:`mitsim.core.configuration.option`."""
    return option(default, help, metavar=metavar, positional=True, **shown)


def to_make(default: Any, help: str, metavar: str, **shown: Any) -> Any:
    """Declare the file or folder that a verb makes."""
    return option(default, help, "-o", "--output", metavar=metavar, kind=Path, panel=OUTPUT, **shown)


def scene_named(
    default: Any, help: str = "scene XML file, or the name of a shipped scene", metavar: str = "[SCENE]", **shown: Any
) -> Any:
    """Declare the scene of a verb."""
    return argument(default, help, metavar, complete=lambda: shipped_files("scenes", "scene.xml"), **shown)


def shown(**changes: Mapping[str, Any]) -> Mapping[str, Mapping[str, Any]]:
    """Return how a verb shows some fields, by their names, as arguments of :func:`option`."""
    return changes


class Common(Options):
    """Options of every verb; the variant is listed only by verbs that open a scene.

    Of the fields of a verb's model those of ``FIRST`` are listed first, those of ``HIDDEN`` belong to Python alone, and
    ``CHANGES`` has arguments of :func:`option` that replace those of the models; names have spaces between.
    """

    PANEL = OUTPUT
    FIRST: ClassVar[str] = ""
    HIDDEN: ClassVar[str] = ""
    CHANGES: ClassVar[Mapping[str, Mapping[str, Any]]] = shown()

    variant: Annotated[str, validated_by(check_variant)] = option(
        DEFAULT_VARIANT, "Mitsuba variant", metavar="VARIANT", panel=LIMITS, hidden=True
    )
    as_json: bool = option(False, "print one JSON object on standard output, and nothing else", "--json")
    quiet: bool = option(False, "show no progress")
    verbose: bool = option(False, "print details as well as the result")

    def given_of(self, model: type[Options]) -> dict[str, Any]:
        """Return the options that were given of those that a ``model`` has."""
        return {name: value for name, value in self.given.items() if name in model.model_fields}

    def details(self, *lines: str) -> Sequence[str]:
        """Return the ``lines``, which are printed with --verbose alone."""
        return lines if self.verbose else ()

    @property
    def limits(self) -> Limits:
        """Longest time and most memory of the job."""
        return Limits()

    @contextmanager
    def job(self) -> Iterator[Job]:
        """Yield a job within the verb's limits, whose progress is shown on stderr."""
        with progress(self.limits, self.quiet or self.as_json, running_seconds()) as job:
            yield replace(job, command=command_line())

    def call(self, function: Callable[..., Any], *arguments: Any, **named: Any) -> int:
        """Print the result of a ``function`` of the Python face, which takes a job; return the exit status."""
        with self.job() as job:
            result = function(*arguments, job=job, **named)
        return self.finish(result.payload(), result.lines(), result.warnings)

    def finish(self, payload: Any, lines: Sequence[str], warnings: Sequence[str] = ()) -> int:
        """Print a result, as JSON or as lines; return exit status 1 if there are ``warnings``, which go to stderr."""
        return print_result(self.as_json, payload, lines, warnings)


class Limited(Common):
    """Options of verbs that may work for long."""

    PANEL = LIMITS

    max_seconds: float = option(Limits().seconds, "refuse work that is predicted to take longer [s]", metavar="S")
    max_memory: float | None = option(
        None, "refuse work that is predicted to need more [GiB]; default: 0.9 of the free memory", metavar="GIB"
    )

    @property
    def limits(self) -> Limits:
        return Limits(self.max_seconds, None if self.max_memory is None else self.max_memory * 2**30)


class Pictured(Common):
    """Options of verbs whose work has pictures."""

    PANEL = OUTPUT

    no_pictures: bool = option(False, "make neither pictures nor the page report.html")

    def finish_folder(self, folder: Path, payload: Mapping[str, Any], lines: Sequence[str]) -> int:
        """Make the pictures and the page of a finished ``folder``, which JSON names as ``report``; print the result.

        The ``headline`` of the ``payload`` is printed before the ``lines``, and its ``warnings`` go to stderr.
        """
        made, failed = self._attempt(lambda: page_of(folder), f"`mitsim report {folder}` makes them later")
        said = [] if made is None else [page_line(made)]
        lines = [payload["headline"], *lines, *said]
        return self.finish({**payload, "report": made}, lines, [*payload["warnings"], *failed])

    def finish_frame(
        self, frame: tuple[Path, npt.NDArray[Any], str], payload: Mapping[str, Any], lines: Sequence[str]
    ) -> int:
        """Make a picture next to a file of one frame, which JSON names as ``picture``; print the result.

        ``frame`` is the file, its numbers (rows, columns) or (rows, columns, 3), and their unit.
        """

        def make() -> dict[str, Any]:
            from mitsim.report.pages import Picture

            start, (path, values, unit) = time.perf_counter(), frame
            drawn = Picture.of(path.name, path.name, values, unit=unit, ends=(None, None))
            written = str(drawn.write(path.parent))
            return {"file": written, "shows": drawn.scale, "seconds": time.perf_counter() - start}

        made, failed = self._attempt(make, "the frame is kept")
        said = [] if made is None else [f"picture {made['file']}: {made['shows']}"]
        return self.finish({**payload, "picture": made}, [*lines, *said], [*payload["warnings"], *failed])

    def _attempt(self, make: Callable[[], dict[str, Any]], kept: str) -> tuple[dict[str, Any] | None, list[str]]:
        """Return the result of ``make``, unless pictures are not wanted.

        If they cannot be made, return None and a warning that the work is ``kept``.
        """
        if self.no_pictures:
            return None, []
        try:
            return make(), []
        except MitsimError as error:
            return None, [f"pictures: {message_of(error)}; {kept}"]
        except (OSError, MemoryError) as error:
            return None, [f"pictures: {getattr(error, 'strerror', None) or 'out of memory'}; {kept}"]


class LimitedPictured(Limited, Pictured):
    """Options of verbs that may work for long, and whose work has pictures."""


class OfScene(Options):
    """The scene of a verb."""

    scene: str = scene_named(..., metavar="SCENE")


class Resumed(Options):
    """Whether interrupted work goes on."""

    PANEL = OUTPUT

    resume: bool = option(False, "continue interrupted work that was begun with the same options")


class Overwritten(Options):
    """Whether a file is replaced."""

    PANEL = OUTPUT

    overwrite: bool = option(False, "replace an existing file")


class Replacing(Options):
    """Options of verbs that replace an earlier result unasked."""

    overwrite: bool = option(False, "accepted, because other verbs need it", hidden=True)


class Replaced(Options):
    """Whether earlier results of the same kind are replaced as a whole; they are kept if the command is refused."""

    PANEL = OUTPUT
    MARKS: ClassVar[Sequence[str]] = ("capture", RUN, MOSAIC)
    """Kinds of the folders that the verb makes, or files in them."""

    overwrite: bool = option(False, "replace an earlier result, which is kept if this command is refused")

    @property
    def places(self) -> Iterable[Path | None]:
        """Return the files and folders that the verb makes."""
        return (getattr(self, name, None) for name in ("output", "calibration_output", "write_frames"))

    @contextmanager
    def replacing(self) -> Iterator[None]:
        """Move earlier results aside, if they are to be replaced, until new ones are begun."""
        if self.overwrite and getattr(self, "resume", False):
            raise ArgumentError("overwrite", "replaces the work that --resume continues; give one of both")
        with ExitStack() as stack:
            for place in filter(None, self.places if self.overwrite else ()):
                stack.enter_context(replaced(place, self.MARKS))
            yield


class KnownPlan(Options):
    """A plan that is made already."""

    plan: Path | None = option(None, "use a plan from a file of `mitsim plan -o` instead of a new one", metavar="FILE")

    def read(self, changes: Mapping[str, Any], same_patterns: bool) -> Plan | None:
        """Return the plan in the file, None without one.

        MitsimError for ``changes`` that need another plan, which those of patterns do if ``same_patterns`` are needed.
        """
        if self.plan is None:
            return None
        import mitsim

        found = mitsim.Plan.load(self.plan)
        asked = found.request_with(changes)
        if same_patterns and asked.patterns != found.known_request.patterns:
            raise ArgumentError("patterns", f"{asked.patterns!r}: {found.made_for('patterns')}")
        return found


def page_of(folder: Path) -> dict[str, Any]:
    """Make the page and the pictures of a ``folder``, and return their JSON."""
    started = time.perf_counter()
    from mitsim.report.folder_page import report_folder

    page = report_folder(folder)
    pictures = sorted(map(str, (folder / PICTURES).glob("*.png")))
    return {"page": str(page), "pictures": pictures, "seconds": time.perf_counter() - started}


def page_line(made: Mapping[str, Any]) -> str:
    return f"Page: {made['page']} (pictures in {made['seconds']:.1f} s)"


# ---- From models to a command line -----------------------------------------------------------------------------------

_METAVARS: Mapping[type, str] = {float: "NUMBER", int: "N", str: "TEXT", Path: "PATH"}
_SPELLED = {"scene": "SCENE"}
"""Options that are not called like their field; commands add theirs."""


def command(function: Callable[[M], int]) -> Callable[..., int]:
    """Convert a ``function`` with one model as its argument to a command of typer.

    The model receives only the given options, so that ``model_fields_set`` names them.
    """
    model: type[Options] = next(kind for name, kind in get_type_hints(function).items() if name != "return")
    first, hidden = (getattr(model, name, "").split() for name in ("FIRST", "HIDDEN"))
    declared = {name: base for base in reversed(model.__mro__) for name in inspect.get_annotations(base)}
    listed = [name for base in model.__mro__ for name in inspect.get_annotations(base) if declared[name] is base]
    names = [name for name in dict.fromkeys([*first, *listed]) if name in model.model_fields and name not in hidden]
    readers, named = dict[str, Callable[[Any], Any]](), inspect.Parameter.KEYWORD_ONLY
    parameters = [inspect.Parameter("context", named, annotation=typer.Context)]
    for name in names:
        field = model.model_fields[name]
        described: Any = field.json_schema_extra
        extra = {"panel": getattr(declared[name], "PANEL", WHAT), **described}
        extra |= getattr(model, "CHANGES", {}).get(name, {})
        if extra["kind"] is False:
            continue
        kinds, complete = _kinds(field.annotation), extra.get("complete")
        kind = extra["kind"] or (kinds[0] if len(kinds) == 1 and kinds[0] in (bool, int, float, str, Path) else str)
        shown: dict[str, Any] = {
            "help": extra.get("help", field.description),
            "metavar": extra.get("metavar") or next((_METAVARS[one] for one in _kinds(kind) if one in _METAVARS), None),
            "autocompletion": complete and _completion(complete),
            **{key: extra[key] for key in ("show_default", "min", "max", "hidden") if key in extra},
        }
        if extra.get("positional"):
            mark = typer.Argument(**shown)
        else:
            spelled = f"--{name.replace('_', '-')}"
            spellings = extra["names"] or ((spelled,) if kind is bool else ())
            if spellings and spelled not in spellings:
                _SPELLED[name] = spellings[0]
            mark = typer.Option(*spellings, rich_help_panel=extra["panel"] or None, **shown)
        default = inspect.Parameter.empty if field.is_required() else extra.get("default", field.default)
        if isinstance(default, (dict, tuple)):
            default = "" if kind is str else None
        hint = kind if default is not None else kind | None
        parameters.append(inspect.Parameter(name, named, default=default, annotation=Annotated[hint, mark]))
        words = [each for each in kinds if isinstance(each, str)]
        number = partial(_number_or_word, name, words) if float in kinds and words else None
        readers[name] = extra.get("read") or number or (lambda value: value)

    @functools.wraps(function)
    def call(context: typer.Context, **values: Any) -> int:
        sources = {name: context.get_parameter_source(name) for name in values}
        given = [name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"]
        asked: Any = model(**{name: readers[name](values[name]) for name in given})
        with asked.replacing() if isinstance(asked, Replaced) else nullcontext():
            return function(asked)

    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    call.__annotations__ = {each.name: each.annotation for each in parameters}
    return call


def _completion(words: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    return lambda incomplete: [word for word in words() if word.startswith(incomplete)]


def _number_or_word(name: str, words: Sequence[str], text: str) -> float | str:
    try:
        return text if text in words else float(text)
    except ValueError:
        raise ArgumentError(name, f"{text!r}: give a number or {' or '.join(words)}") from None


def _kinds(annotation: Any) -> list[Any]:
    """Return the alternatives of an ``annotation``, without None; of a Literal its words."""
    if get_origin(annotation) in (Union, UnionType, Literal):
        return [kind for each in get_args(annotation) for kind in _kinds(each)]
    if get_origin(annotation) is Annotated:
        return _kinds(get_args(annotation)[0])
    return [] if annotation is NoneType else [annotation]


def command_line() -> str | None:
    """Return the command line of this program as a shell reads it; None if another program calls mitsim's code."""
    program = Path(sys.argv[0])
    if program.stem != "mitsim" and (program.parent.name, program.stem) != ("mitsim", "__main__"):
        return None
    return printable(shlex.join(["mitsim", *sys.argv[1:]]))


def option_name(name: str) -> str:
    """Return the option of the field or argument ``name``."""
    return _SPELLED.get(name, f"--{name.replace('_', '-')}")


def message_of(error: MitsimError) -> str:
    """Return the message of an ``error`` with its arguments written as options."""
    text = str(error)
    if isinstance(error, ArgumentError):
        text = f"{option_name(error.argument)}{text.removeprefix(error.argument)}"
    text = re.sub(r"^parameter (?=\w+=)", "-D ", text)
    return re.sub(
        r"(?<!-)\b(\w+(?==True)|max_seconds|max_memory)(=True)?", lambda m: "--" + m[1].replace("_", "-"), text
    )


# ---- Pages of help ---------------------------------------------------------------------------------------------------


def help_of(text: str | None) -> str:
    """Return a docstring for click: the lines of tables are kept, and commands, the lines after a $, are examples."""
    prose, *examples = re.split(r"\n\s*\$ ", inspect.cleandoc(text or ""))
    prose = re.sub(r"\n\n(?=.*\S {2})", "\n\n\b\n", prose)
    return "\n\n".join([prose.rstrip(), "\b\n" + "\n".join(["Examples:", *(f"  {line}" for line in examples)])])


def _write_panels(formatter: Any, rows: Iterable[tuple[str, Any]]) -> None:
    panels = dict[str, list[Any]]()
    for heading, row in rows:
        panels.setdefault(heading, []).append(row)
    for heading in sorted(panels, key=lambda each: PANELS.index(each) if each in PANELS else -1):
        with formatter.section(heading):
            formatter.write_dl(panels[heading])


class Verb(TyperCommand):
    """Verb whose page has a heading for each panel of its options."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments and options, by panels; of several long spellings only the first, because others are old."""
        rows = []
        for each in map(copy.copy, self.get_params(ctx)):
            old = [name for name in each.opts if name.startswith("--")][1:]
            each.opts = [name for name in each.opts if name not in old]
            panel: str = getattr(each, "rich_help_panel", None) or OUTPUT
            rows.append((panel if each.param_type_name == "option" else "Arguments", each.get_help_record(ctx)))
        _write_panels(formatter, (row for row in rows if row[1]))


class Program(TyperGroup):
    """Program whose page has its verbs by panels."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the verb that ``args`` name; `design predict` is the verb `predict`."""
        return super().resolve_command(ctx, args[1:] if args[:2] == ["design", "predict"] else args)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write verbs and options."""
        verbs = ((verb.rich_help_panel, (name, verb.short_help)) for name, verb in self.commands.items())  # type: ignore[attr-defined]
        _write_panels(formatter, [*verbs, *(("Options", each.get_help_record(ctx)) for each in self.get_params(ctx))])


# ---- Results ---------------------------------------------------------------------------------------------------------

COLUMNS = 80
"""Width of the usual terminal, and of what is no terminal."""


def wrap_text(text: str, indent: str = "") -> list[str]:
    """Wrap a ``text`` to the width of the terminal. Further lines follow an ``indent``; names and paths stay whole."""
    width = shutil.get_terminal_size((COLUMNS, 24)).columns
    indent = indent or text[: len(text) - len(text.lstrip())] or "  "
    lines = textwrap.wrap(text, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return lines or [""]


def print_result(as_json: bool, payload: Any, lines: Iterable[str], warnings: Sequence[str]) -> int:
    """Print a result as one JSON object, the ``payload``, or as ``lines`` of text.

    Return exit status 1 if there are ``warnings``, which go to stderr in either case, after the first line. If nobody
    reads standard output any more, end the program quietly as SIGPIPE does; raise MitsimError if it cannot be written
    for another reason, such as a full disk.
    """

    def write(texts: Iterable[str]) -> None:
        try:
            for text in texts:
                print(text)
            sys.stdout.flush()
        except OSError as error:
            sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - what the exit writes has to go somewhere
            if isinstance(error, BrokenPipeError):
                sys.exit(128 + signal.SIGPIPE)
            raise MitsimError(f"standard output: cannot be written ({error.strerror}); give it another place") from None

    def wrapped(line: str) -> Iterable[str]:
        for part in printable(line).split("\n"):  # columns of a table stay one below the other
            yield from [part] if "  " in part.strip() else wrap_text(part)

    first, *rest = [[json.dumps(plain(payload), allow_nan=False)]] if as_json else [*map(wrapped, lines)] or [[]]
    write(first)
    for warning in warnings:
        print(f"mitsim: warning: {printable(warning)}", file=sys.stderr)
    write(line for each in rest for line in each)
    return 1 if warnings else 0
