"""Session files: tables of options become the steps of a session, or a refusal with all mistakes; and text again.

A table is a verb, and its fields are those of the models that the verb takes on the command line and in Python.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tomli_w
from pydantic.fields import FieldInfo

from mitsim.bench.request import NO, Coloured, Opening, Planned, Request, SessionRequest
from mitsim.core.configuration import (
    FilePath,
    Options,
    Place,
    known_names,
    locate,
    option,
    read_toml,
    refuse_together,
    shipped_path,
    validate,
    validated_by,
)
from mitsim.core.errors import ArgumentError, MitsimError, cut, is_path, near_name, printable, short_text
from mitsim.core.files import PAGE, PICTURES, resolve
from mitsim.devices.session import SessionRecipe
from mitsim.exchange.formats import PNG, Exported, check_format
from mitsim.reconstruct.request import MODEL, ImageRequest
from mitsim.verbs import StudyOptions

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

# ---- Tables ----------------------------------------------------------------------------------------------------------


def _one_value(name: str, value: Any) -> None:
    if not isinstance(value, (str, int, float)):
        raise ArgumentError(name, f"{short_text(value)}: give a number, text in quotes, or true or false")


def _recipe(recipe: Any) -> None:
    """Refuse a ``recipe`` that is neither a file's path nor a table of a recipe."""
    if isinstance(recipe, Mapping):
        validate(SessionRecipe, dict(recipe), "recipe")
    elif not is_path(recipe):
        raise ArgumentError("recipe", f"{short_text(recipe)}: give a path, or a table of a recipe's fields")


class _Placed(Options):
    """Name of a step's folder or file in that of the session."""

    output: FilePath | None = option(None, "folder of the step")


class _Scene(Opening):
    scene: FilePath


class _Light(_Placed, Planned):
    pass


class _Capture(_Placed, Request, Coloured):
    pass


class _Calibration(_Placed, SessionRequest, Coloured):
    recipe: Annotated[Any, validated_by(_recipe)] = None


class _Image(_Placed, ImageRequest):
    run: FilePath | None = None
    calibration: FilePath | None = None
    chart: FilePath | None = None


class _Study(_Placed, StudyOptions):
    name: str
    scene: FilePath | None = None

    def model_post_init(self, _: object) -> None:
        """Refuse values that parameters and varied fields cannot have."""
        for name, value in self.parameters.items():
            _one_value(f"parameters.{name}", value)
        for name, values in self.over.items() if isinstance(self.over, Mapping) else ():
            for value in values if isinstance(values, (list, tuple)) else [values]:
                _one_value(f"over.{name}", value)


class _Export(Exported):
    run: FilePath | None = None


TABLES: dict[str, type[Options]] = {
    "scene": _Scene,
    "transport": _Light,
    "capture": _Capture,
    "calibrate": _Calibration,
    "reconstruct": _Image,
    "study": _Study,
    "export": _Export,
}
"""Model of each table, in the order in which the steps are taken."""
SEVERAL = "reconstruct", "study", "export"
"""Tables that may be there more than once, as ``[[reconstruct]]``."""
OF_A_BENCH = "transport", "capture", "calibrate"
"""Verbs that open the scene."""
FOLDERS = {"capture": "run", "calibrate": "calibration", "reconstruct": "image"}
"""Where the results of some steps go; those of others are called like their table."""
SESSION_FILE, SUMMARY = "session.toml", "session.json"
"""Files in a session's folder: the request, and the result of each step."""
_RESERVED = PAGE, PICTURES, SESSION_FILE, SUMMARY
"""Names in the session's folder that no step may write to."""
_LEFT_OUT = {"scene": {"parameters"}, "export": {"overwrite"}, "study": {"shard", "scheduler", "experiment"}}
"""Fields of the models that a table does not have."""
_SPELLED = {"lam": "lambda"}
"""Fields that a file calls otherwise than Python."""


def fields_of(table: str) -> dict[str, FieldInfo]:
    """Return the fields of a ``table`` by the names that a file gives them."""
    fields, left_out = TABLES[table].model_fields, _LEFT_OUT.get(table, set())
    return {_SPELLED.get(name, name): each for name, each in fields.items() if name not in left_out}


@dataclass(frozen=True)
class Step:
    """One verb, the ``values`` of its arguments that are given, and the name of its ``output`` in the session's."""

    verb: str
    values: Mapping[str, Any]
    output: str

    def of(self, model: type[Options]) -> dict[str, Any]:
        """Return the values of the fields of a ``model``."""
        spelled = {name: _SPELLED.get(name, name) for name in model.model_fields}
        return {name: self.values[key] for name, key in spelled.items() if key in self.values}


@dataclass(frozen=True)
class Session:
    """A session file, checked.

    Attributes
    ----------
    scene
        Arguments that open the bench; empty where no step needs one.
    steps
        Steps in the order in which they are taken.
    tables
        Tables as a file holds them, with whole paths; a copy of those of the caller.
    """

    scene: Mapping[str, Any]
    steps: tuple[Step, ...]
    tables: Mapping[str, Any]

    def step(self, verb: str) -> Step | None:
        """Return the first step of a ``verb``."""
        return next((step for step in self.steps if step.verb == verb), None)


# ---- Text ------------------------------------------------------------------------------------------------------------


def session_text(tables: Mapping[str, Any], base: Path | None = None, *notes: str) -> str:
    """Return the text of a session file, which begins with ``notes`` as comments without line ends.

    Paths are written as seen from the folder ``base``, so that the file can be moved with the files that it names.
    """
    head = "".join(" ".join(f"# {printable(note)}".split()) + "\n" for note in notes)
    parts = [head] if head else []
    for name in (name for name in TABLES if name in tables):
        once = name not in SEVERAL
        # The library writes several short tables as one list on a line, which people read less well.
        each = [tomli_w.dumps({name: stated(table, base)}) for table in ([tables[name]] if once else tables[name])]
        parts += each if once else [text.replace(f"[{name}]", f"[[{name}]]", 1) for text in each]
    return "\n".join(parts)


def stated(value: Any, base: Path | None = None) -> Any:
    """Return a copy of nested tables and lists without the fields that are None, with paths as seen from ``base``."""
    if isinstance(value, Mapping):
        return {key: stated(each, base) for key, each in value.items() if each is not None}
    if isinstance(value, (list, tuple)):
        return [stated(each, base) for each in value]
    if base is None or not isinstance(value, str) or not os.path.isabs(value):
        return value
    if os.path.commonpath([place := resolve(base), value]) == os.path.sep:
        return value
    relative = os.path.relpath(value, place)
    return relative if os.sep in relative else os.path.join(os.curdir, relative)  # a bare name could be a shipped one


def value_of(text: str) -> Any:
    """Return the TOML value in a ``text``; the text itself if it has none."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text


# ---- Reading ---------------------------------------------------------------------------------------------------------


class _Mistakes:
    """Sentences on the mistakes of a file, and the ``tables`` that have any."""

    def __init__(self) -> None:
        self.texts: list[str] = []
        self.tables: set[Place] = set()

    def say(self, place: Place, text: str) -> None:
        """Note the mistake ``text`` at a ``place``."""
        self.tables.add(place[: 1 + (place[0] in SEVERAL)])
        self.texts.append(f"{'.'.join(map(str, place))}: {text}")

    def attempt(self, place: Place, call: Callable[..., object], *arguments: Any, **named: Any) -> None:
        """Note all that a ``call`` refuses of a table at a ``place``."""
        try:
            call(*arguments, **named)
        except ArgumentError as error:
            for one in (error, *error.others):
                argument = _SPELLED.get(one.argument, one.argument)
                self.say((*place, *argument.split(".")), str(one).removeprefix(f"{one.argument} "))
        except MitsimError as error:
            self.say(place, str(error))


def read_session(source: Path | str | Mapping[str, Any], changes: Mapping[str, Any] | None = None) -> Session:
    """Return the session in a file.

    Parameters
    ----------
    source
        Path of the file, the name of a shipped one, or its tables.
    changes
        Values of fields by name, as ``capture.patterns``; paths in them count from the working folder.

    Raises
    ------
    MitsimError
        with all mistakes, for names that are no tables or fields, and values that these cannot have; and for a file
        that cannot be read.
    """
    if isinstance(source, Mapping):
        data, base, where = stated(source), Path.cwd(), "session"
    else:
        path = locate(source, "sessions", ".toml")
        data, base, where = read_toml(path), resolve(path.absolute().parent), f"file {path}"
    for name, each in data.items():
        for table in each if isinstance(each, list) else [each]:
            if isinstance(table, dict):
                table.update({key: _whole(name, key, value, base) for key, value in table.items()})
    for name, value in (changes or {}).items():
        _change(data, name, value, where)
    found, tables, steps = _Mistakes(), dict[str, Any](), list[Step]()
    for name, held in data.items():
        if name not in TABLES:
            found.say((name,), f"got {short_text(held)}, no such field; {known_names(name, TABLES, 'use')}")
    for name in (name for name in TABLES if name in data):
        each = data[name] if name in SEVERAL and isinstance(data[name], list) else [data[name]]
        tables[name] = [*each] if name in SEVERAL else data[name]
        fields = fields_of(name)
        for number, values in enumerate(each):
            place: Place = (name, number) if name in SEVERAL else (name,)
            if not isinstance(values, Mapping):
                found.say(place, f"got {short_text(values)}; give a table of names and values")
                continue
            for key, value in values.items():
                if name == "scene" and key not in fields and key != "parameters":
                    found.attempt(place, _one_value, key, value)
                elif key not in fields:
                    found.say((*place, key), f"got {short_text(value)}, no such field; {known_names(key, fields)}")
            asked = Step(name, {key: value for key, value in values.items() if key in fields}, "").of(TABLES[name])
            if name == "reconstruct" and str(asked.get("method")).endswith(MODEL):
                del asked["method"]
            found.attempt(place, TABLES[name], **asked)
            own = {key: value for key, value in values.items() if key != "output"}
            first = str(own.get("name")) if name == "study" else FOLDERS.get(name, name)
            output = values.get("output") or f"{first}{f'-{number + 1}' if number else ''}"
            if name != "scene":
                steps.append(Step(name, own, str(output)))
    session = Session(dict(tables.get("scene") or {}), tuple(steps), tables)
    _check_steps(session, found)
    if found.texts:
        raise refuse_together(where, [*dict.fromkeys(found.texts)])
    return session


def _change(data: dict[str, Any], name: str, value: Any, where: str) -> None:
    """Set the field of a dotted ``name`` to a ``value``."""
    place: list[str | int] = [int(part) if part.isdecimal() else part for part in str(name).split(".")]
    if len(place) < 2 or place[0] not in TABLES:
        raise MitsimError(
            f"-D {cut(str(name))}: {near_name(str(place[0]), TABLES)}give TABLE.FIELD=VALUE, such as "
            f"capture.patterns=dots:4; tables are {', '.join(TABLES)}"
        )
    holder: Any = data
    for part in place[:-1]:
        if isinstance(part, str) and isinstance(holder, dict):
            holder = holder.setdefault(part, {})
        elif isinstance(part, int) and isinstance(holder, list) and part < len(holder):
            holder = holder[part]
        else:
            raise MitsimError(f"-D {cut(name)}: {where} has no {part} there; count tables from 0")
    if not isinstance(holder, dict) or not isinstance(place[-1], str):
        some = f"{place[0]}.0.{place[-1]}"
        raise MitsimError(f"-D {cut(name)}: {where} has several [[{place[0]}]]; say which, as {some}, counted from 0")
    holder[place[-1]] = _whole(str(place[0]), place[-1], stated(value), Path.cwd())


def _whole(table: str, key: str, value: Any, base: Path) -> Any:
    """Return the ``value`` of a field, as a whole path if it names a file from the folder ``base``."""
    if not isinstance(value, str) or not value or "\0" in value or table not in TABLES:
        return value
    path, fields = Path(value), fields_of(table)
    if key not in fields:  # a parameter of the scene
        is_file = bool(path.suffix) and os.path.isfile(base / path)
    elif not (key == "recipe" or "Path" in str(fields[key].annotation)) or key == "output":
        is_file = key == "method" and path.suffix == MODEL
    else:
        shipped = shipped_path("scenes") / value, shipped_path("calibration") / f"{value}.toml"
        there = not any(map(os.path.exists, shipped)) and os.path.exists(base / path)
        is_file = os.sep in value or bool(path.suffix) or there
    return os.path.normpath(base / path) if is_file else value


# ---- Steps that need each other --------------------------------------------------------------------------------------


def _check_steps(session: Session, found: _Mistakes) -> None:
    """Note steps that lack another, or that are in the way of another."""
    numbers, outputs = dict[str, int](), [step.output.casefold() for step in session.steps]
    for step in session.steps:
        number = numbers[step.verb] = numbers.get(step.verb, -1) + 1
        place: Place = (step.verb, number) if step.verb in SEVERAL else (step.verb,)
        if place not in found.tables:
            _check_step(session, step, place, found)
        name = step.output.casefold()
        if Path(step.output).name != step.output or step.output.startswith("."):
            found.say((*place, "output"), f"{cut(repr(step.output))}: give a name without folders and no dot before it")
        elif name in _RESERVED:
            others = ", ".join(_RESERVED)
            found.say((*place, "output"), f"{step.output!r} is the session's own; give another than {others}")
        elif outputs.count(name) > 1:
            given = cut(repr(step.output))
            found.say((*place, "output"), f"{given} is another step's too; give each a name of its own")
        if step.verb in OF_A_BENCH and not session.scene:
            found.say(place, 'is of a scene, and there is none; add a table [scene] with scene = "NAME"')
    if not session.steps:
        found.texts.append(f"asks for nothing; add a table, such as [capture]: {', '.join(TABLES)}")


def _check_step(session: Session, step: Step, place: Place, found: _Mistakes) -> None:
    """Note the mistakes of a ``step`` beside the other ones."""
    values, capture = step.values, session.step("capture")
    colour = values.get("colour", NO)
    needed = {"run": "capture", "calibration": "calibrate"} if step.verb == "reconstruct" else {}
    if step.verb == "capture" and session.step("transport"):
        for name in ("accuracy", "seconds", "effects"):
            if name in values:
                found.say((*place, name), "is the transport's; give it in [transport]")
        if colour != NO:
            found.say((*place, "colour"), "stands beside [transport], which tells no light apart; leave one out")
    elif step.verb == "calibrate" and capture and colour != (other := capture.values.get("colour", NO)):
        found.say((*place, "colour"), f"{colour}, but the capture's is {other}; give both the same")
    elif step.verb == "export":
        calibration, needed = values.get("calibration") or calibration_for(session, step), {"run": "capture"}
        found.attempt(place, check_format, values["format"], step.output, calibration, values.get("projector"))
    for name, verb in needed.items():
        if name not in values and session.step(verb) is None:
            found.say((*place, name), f"is missing, and there is no [{verb}]; give the folder, or add the table")


def calibration_for(session: Session, step: Step) -> str | None:
    """Return the session's own calibration if the format of an export ``step`` can hold it."""
    own = session.step("calibrate")
    return own.output if own and step.values["format"] != PNG else None
