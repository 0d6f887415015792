"""Command lines from models of options: models become parameters of typer, and what is given becomes models again.

Errors of the library speak of arguments; :func:`message_of` writes them as options.
"""

from __future__ import annotations

import functools
import inspect
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import typer

from mitsim.bench.request import Variant
from mitsim.core.configuration import LIMITS, OUTPUT, WHAT, Options, option, shipped_files
from mitsim.core.errors import ArgumentError, MitsimError, printable
from mitsim.core.job import Limits, progress, running_seconds

if TYPE_CHECKING:
    from mitsim.core.job import Job
    from mitsim.light.plan import Plan

_SPELLED = {"scene": "SCENE"}
"""Options that are not called like their parameter; models add theirs."""
_METAVARS: Mapping[type, str] = {float: "NUMBER", int: "N", str: "TEXT", Path: "PATH"}


def completing(names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Return what completes a word in a shell: the ``names`` that begin with it."""

    def complete(incomplete: str) -> list[str]:
        return [name for name in names() if name.startswith(incomplete)]

    return complete


complete_scene = completing(lambda: shipped_files("scenes", "scene.xml"))
Scene = Annotated[
    str,
    typer.Argument(help="scene XML, or the name of a shipped scene", metavar="SCENE", autocompletion=complete_scene),
]


# ---- from models to a command line -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Shown:
    """How a verb shows a model: the fields ``only``, in this order (all if empty), with ``changes`` of some of them."""

    only: tuple[str, ...] = ()
    changes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


def show(only: str = "", **changes: Mapping[str, Any]) -> Shown:
    """Return how a verb shows a model, as an annotation of it; names of fields have spaces between."""
    return Shown(tuple(only.split()), changes)


def verb(function: Callable[..., int]) -> Callable[..., int]:
    """Make a function whose arguments are models of options, or typer's own, a command of typer.

    A model is made of the options that the command line gives, so that ``model_fields_set`` names them; an argument
    ``given`` gets the names of all options that are given.
    """
    parameters: dict[str, inspect.Parameter] = {}
    groups: dict[str, tuple[type[Options], Sequence[str], Mapping[str, Any]]] = {}
    hints = get_type_hints(function, include_extras=True)
    for name, each in inspect.signature(function).parameters.items():
        kind, *marks = (
            (hints[name].__origin__, *hints[name].__metadata__)
            if hasattr(hints[name], "__metadata__")
            else (hints[name],)
        )
        if not (isinstance(kind, type) and issubclass(kind, Options)):
            if name != "given":
                parameters[name] = inspect.Parameter(
                    name, inspect.Parameter.KEYWORD_ONLY, default=each.default, annotation=_own_hint(kind, marks)
                )
            continue
        how = next((mark for mark in marks if isinstance(mark, Shown)), Shown())
        declared = {n: kind for base in kind.__mro__ for n in inspect.get_annotations(base)}
        fields = [n for n in how.only or declared if n in kind.model_fields and _extra(kind, n)["kind"] is not False]
        readers = {}
        for one in fields:
            extra = {**_extra(kind, one), **how.changes.get(one, {})}
            readers[one] = _reader(kind, one, extra)
            parameters.setdefault(one, _parameter(kind, one, extra))
        groups[name] = kind, fields, readers

    @functools.wraps(function)
    def call(context: typer.Context, **values: Any) -> int:
        given = {name for name in values if _is_given(context, name)}
        made = {
            name: kind(**{one: readers[one](values[one]) for one in fields if one in given})
            for name, (kind, fields, readers) in groups.items()
        }
        taken = {one for _, fields, _ in groups.values() for one in fields}
        own = {name: value for name, value in values.items() if name not in taken}
        if "given" in hints:
            own["given"] = given
        return function(**own, **made)

    context = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
    call.__signature__ = inspect.Signature([context, *parameters.values()])  # type: ignore[attr-defined]
    call.__annotations__ = {name: each.annotation for name, each in parameters.items()} | {"context": typer.Context}
    return call


def _is_given(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _own_hint(kind: Any, marks: Sequence[Any]) -> Any:
    """Return the annotation of an argument that is no model, with a word for its value."""
    for mark in marks:
        mark.metavar = mark.metavar or _metavar(kind)
    return Annotated[(kind, *marks)] if marks else kind


def _extra(model: type[Options], name: str) -> Mapping[str, Any]:
    extra: Any = model.model_fields[name].json_schema_extra
    return extra  # type: ignore[no-any-return]


def _kinds(annotation: Any) -> Iterator[Any]:
    """Iterate over the alternatives of an ``annotation``, without None; of a Literal over its words."""
    if get_origin(annotation) in (Union, UnionType, Literal):
        for each in get_args(annotation):
            yield from _kinds(each)
    elif get_origin(annotation) is Annotated:
        yield from _kinds(get_args(annotation)[0])
    elif annotation is not NoneType:
        yield annotation


def _metavar(kind: Any) -> str | None:
    return next((_METAVARS[each] for each in _kinds(kind) if each in _METAVARS), None)


def _parameter(model: type[Options], name: str, extra: Mapping[str, Any]) -> inspect.Parameter:
    """Return typer's parameter of a field of a ``model``, which is shown as ``extra`` states."""
    declared = model.model_fields[name]
    kinds = [*_kinds(declared.annotation)]
    kind = extra["kind"] or (kinds[0] if len(kinds) == 1 and kinds[0] in (bool, int, float, str, Path) else str)
    names = extra["names"] or ((f"--{name.replace('_', '-')}",) if kind is bool else ())
    if names and f"--{name.replace('_', '-')}" not in names:
        _SPELLED[name] = names[0]
    shown = typer.Option(
        *names,
        help=extra.get("help", declared.description),
        metavar=extra.get("metavar") or _metavar(kind),
        rich_help_panel=extra.get("panel", _panel(model, name)) or None,
        show_default=extra.get("show_default", True),
        min=extra.get("min"),
        max=extra.get("max"),
        autocompletion=completing(extra["complete"]) if "complete" in extra else None,
    )
    default = inspect.Parameter.empty if declared.is_required() else extra.get("default", declared.default)
    if isinstance(default, (dict, tuple)):
        default = "" if kind is str else None
    hint = kind if default is not None else kind | None
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[hint, shown])


def _panel(model: type[Options], name: str) -> str:
    """Return the heading of a field: that of the class that declares it."""
    declaring = next(base for base in model.__mro__ if name in inspect.get_annotations(base))
    return str(getattr(declaring, "PANEL", WHAT))


def _reader(model: type[Options], name: str, extra: Mapping[str, Any]) -> Callable[[Any], Any]:
    """Return the function that makes the value of a field of a ``model`` of the word on the command line."""
    kinds, read = [*_kinds(model.model_fields[name].annotation)], extra.get("read")
    words = [kind for kind in kinds if isinstance(kind, str)]
    if read or not (float in kinds and words):
        return read or (lambda value: value)
    return lambda text: read_number(name, text, words)


def read_number(argument: str, text: str, words: Sequence[str]) -> float | str:
    """Return the number in a ``text``, or the text if it is one of the ``words``; ArgumentError otherwise."""
    if text in words:
        return text
    try:
        return float(text)
    except ValueError:
        raise ArgumentError(argument, f"{text!r}: give a number or {' or '.join(words)}") from None


# ---- options of all verbs --------------------------------------------------------------------------------------------


class Common(Variant):
    """Options that every verb has."""

    PANEL = OUTPUT

    as_json: bool = option(False, "one JSON object on stdout, nothing else there", "--json")
    quiet: bool = option(False, "no progress")
    verbose: bool = option(False, "say all that was found, not the result alone")

    def details(self, *lines: str) -> Sequence[str]:
        """Return those ``lines`` that are printed with --verbose alone."""
        return lines if self.verbose else ()

    @contextmanager
    def job(self) -> Iterator[Job]:
        """Yield a job within the verb's limits, whose progress is shown on stderr."""
        with progress(self.limits, self.quiet or self.as_json, running_seconds()) as job:
            yield replace(job, command=command_line())

    @property
    def limits(self) -> Limits:
        """Longest time and most memory of the job."""
        return Limits()


class Limited(Common):
    """Options of verbs that may work for long."""

    PANEL = LIMITS

    max_seconds: float = option(Limits().seconds, "refuse work that would take longer", metavar="S")
    max_memory: float | None = option(
        None, "refuse work that would take more; nine tenths of what is free if not given", metavar="GIB"
    )

    @property
    def limits(self) -> Limits:
        """Those that are asked for."""
        return Limits(self.max_seconds, None if self.max_memory is None else self.max_memory * 2**30)


class Pictured(Common):
    """Options of verbs whose work has pictures."""

    PANEL = ""

    no_pictures: bool = option(False, "leave out pictures and the page report.html")


class LimitedPictured(Limited, Pictured):
    """Options of verbs that may work for long, and whose work has pictures."""


class Resumed(Options):
    """Whether interrupted work goes on."""

    PANEL = OUTPUT

    resume: bool = option(False, "go on where an interrupted one of the same options stopped")


class Overwritten(Options):
    """Whether a file is replaced."""

    PANEL = OUTPUT

    overwrite: bool = option(False, "replace the file")


class KnownPlan(Options):
    """A plan that is made already."""

    plan: Path | None = option(None, "file of `mitsim plan -o`: nothing is planned again", metavar="FILE")

    def read(self, changes: Mapping[str, Any], same_patterns: bool) -> Plan | None:
        """Return the plan in the file, None without one; MitsimError for ``changes`` that need another plan, which
        those of patterns do if ``same_patterns`` are needed."""
        if self.plan is None:
            return None
        import mitsim

        found = mitsim.Plan.load(self.plan)
        asked = found.request_with(changes)
        if same_patterns and asked.patterns != found.known_request.patterns:
            raise ArgumentError("patterns", f"{asked.patterns!r}: {found.made_for('patterns')}")
        return found


def check_work(output: Path, resume: bool, kind: str, several: bool = False) -> None:
    """Refuse, before the renderer is imported, a RUN or CAL folder that cannot be written.

    Parameters
    ----------
    output, resume
        Folder, and whether work in it is to go on.
    kind
        "capture" or "calibration".
    several
        Whether the folder is to hold several such folders.
    """
    from mitsim.core.files import check_output
    from mitsim.core.manifests import MANIFEST, resumable

    begun = (output / MANIFEST).is_file()
    if resume and begun and not several:
        resumable(output, kind)
    check_output(output, overwrite=resume and begun != several)


# ---- words of a command line in messages -----------------------------------------------------------------------------


def command_line() -> str | None:
    """Return the command line of this program as a shell reads it; None if another program calls mitsim's code."""
    program = Path(sys.argv[0])
    if program.stem != "mitsim" and (program.parent.name, program.stem) != ("mitsim", "__main__"):
        return None
    return printable(shlex.join(["mitsim", *sys.argv[1:]]))


def option_name(name: str) -> str:
    """Return the option of the parameter ``name``."""
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
