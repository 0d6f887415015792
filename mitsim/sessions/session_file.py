"""Session files: tables of options become the steps of a session, or a refusal with all mistakes; and text again.

A table is a verb, and its fields are those of the models that the verb takes on the command line and in Python.
"""

from __future__ import annotations

import os
import sys
import unicodedata
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tomli_w
from pydantic.fields import FieldInfo

from mitsim.bench.request import NO, Coloured, Family, Opening, Planned, Request, Sampled, SessionRequest
from mitsim.core.configuration import (
    FilePath,
    Mistake,
    Options,
    Place,
    Table,
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


def _one_value(name: str, value: Any) -> Any:
    """Return a ``value`` of a parameter of a ``name``; ArgumentError for a list or a table."""
    if not isinstance(value, (str, int, float)):
        raise ArgumentError(name, f"{short_text(value)}: give a number, text in quotes, or true or false")
    return value


def _several_values(name: str, values: Any) -> Any:
    """Return a list of ``values``, or the ends and the count of a range; ArgumentError for anything else."""
    if isinstance(values, Mapping):
        numbers = [isinstance(values.get(end), (int, float)) for end in ("from", "to", "count")]
        if values.keys() == {"from", "to", "count"} and all(numbers):
            return values
    elif isinstance(values, (list, tuple)) and values:
        return [_one_value(name, value) for value in values]
    raise ArgumentError(name, f"{short_text(values)}: give a list of values, or {{ from = A, to = B, count = N }}")


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


class _Plan(_Placed, Planned):
    pass


class _Capture(_Placed, Request, Coloured):
    pass


class _Calibration(_Placed, SessionRequest, Coloured):
    recipe: Annotated[Any, validated_by(_recipe)] = None


class _Image(_Placed, ImageRequest):
    run: FilePath | None = None
    calibration: FilePath | None = None
    chart: FilePath | None = None


class _Demo(_Placed, Sampled, Family):
    pass


class _Sweep(_Placed):
    scene: Mapping[str, Any] = {}
    capture: Mapping[str, Any] = {}
    measure: str = "psnr"
    jobs: int | None = None

    def model_post_init(self, _: object) -> None:
        """Refuse values that a sweep cannot take."""
        for name, values in self.scene.items():
            _several_values(f"scene.{name}", values)
        for name, values in self.capture.items():
            if name not in _SWEPT:
                raise ArgumentError(f"capture.{name}", f"is not varied by a sweep; use {', '.join(_SWEPT)}")
            _several_values(f"capture.{name}", values)


class _Study(_Placed, StudyOptions):
    name: str
    scene: FilePath | None = None

    def model_post_init(self, _: object) -> None:
        """Refuse values that parameters and varied fields cannot have."""
        for name, value in self.parameters.items():
            _one_value(f"parameters.{name}", value)
        for name, values in self.over.items() if isinstance(self.over, Mapping) else ():
            _several_values(f"over.{name}", values)


class _Export(Exported):
    run: FilePath | None = None


_SWEPT = "patterns", "seed", "accuracy"
"""Fields of a capture that a sweep may vary."""
TABLES: dict[str, type[Options]] = {
    "scene": _Scene,
    "plan": _Plan,
    "transport": _Plan,
    "capture": _Capture,
    "calibrate": _Calibration,
    "reconstruct": _Image,
    "demo": _Demo,
    "sweep": _Sweep,
    "study": _Study,
    "export": _Export,
}
"""Model of each table, in the order in which the steps are taken."""
SEVERAL = "reconstruct", "study", "export"
"""Tables that may be there more than once, as ``[[reconstruct]]``."""
OF_A_BENCH = "plan", "transport", "capture", "calibrate", "demo"
"""Verbs that open the scene here; a sweep does so itself."""
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
    """Return the text of a session file.

    Parameters
    ----------
    tables
        names and values of each, or a list of such, with whole paths.
    base
        folder of the file, from which paths are written, so that it can be moved with the files that it names; None:
        paths stay whole.
    notes
        lines of comment that it begins with; line ends and control characters in them become spaces.
    """
    held = portable(tables, base) if base else _copy(tables, unset=False)
    head = "".join(" ".join(f"# {printable(note)}".split()) + "\n" for note in notes)
    parts = [head] if head else []
    for name in (name for name in TABLES if name in held):
        once = name not in SEVERAL
        # The library writes several short tables as one list on a line, which people read less well.
        each = [tomli_w.dumps({name: table}) for table in ([held[name]] if once else held[name])]
        parts += each if once else [text.replace(f"[{name}]", f"[[{name}]]", 1) for text in each]
    return "\n".join(parts)


def portable(tables: Mapping[str, Any], base: Path) -> dict[str, Any]:
    """Return ``tables`` with whole paths as relative ones, as seen from the folder ``base``."""
    held: dict[str, Any] = _copy(tables, unset=False)
    _replace_paths(held, lambda path: _path_from(path, base) if os.path.isabs(path) else path)
    return held


def _path_from(path: str, base: Path) -> str:
    """Return a ``path`` as seen from the folder ``base``, spelled so that it names no shipped file; the path itself
    where both have no folder in common."""
    place = resolve(base)
    if os.path.commonpath([place, path]) == os.path.sep:
        return path
    relative = os.path.relpath(path, place)
    return relative if os.sep in relative else os.path.join(os.curdir, relative)


def _copy(value: Any, unset: bool = True) -> Any:
    """Return a copy of nested tables and lists; with ``unset`` off, without the fields that are None."""
    if isinstance(value, Mapping):
        return {key: _copy(each, unset) for key, each in value.items() if unset or each is not None}
    return [_copy(each, unset) for each in value] if isinstance(value, (list, tuple)) else value


# ---- Reading ---------------------------------------------------------------------------------------------------------


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
        with all mistakes, each with its line, for names that are no tables or fields, and values that these cannot
        have; and for a file that cannot be read.
    """
    if isinstance(source, Mapping):
        data, base, where = Table(_copy(source)), Path.cwd(), "session"
    else:
        path = locate(source, "sessions", ".toml")
        data, base, where = read_toml(path), resolve(path.absolute().parent), f"file {path}"
    _replace_paths(data, lambda path: os.path.normpath(base / path), base)
    found = _Mistakes(data, {_change(data, name, value, where) for name, value in (changes or {}).items()})
    for name, held in data.items():
        if name not in TABLES:
            hint = near_name(name, TABLES).strip() or f"use {', '.join(TABLES)}"
            found.say((name,), f"got {short_text(held)}, no such field; {hint}")
    tables, steps = dict[str, Any](), list[Step]()
    for name in (name for name in TABLES if name in data):
        each = data[name] if name in SEVERAL and isinstance(data[name], list) else [data[name]]
        tables[name] = [*each] if name in SEVERAL else data[name]
        for number, values in enumerate(each):
            place: Place = (name, number) if name in SEVERAL else (name,)
            if not isinstance(values, Mapping):
                found.say(place, f"got {short_text(values)}; give a table of names and values")
                continue
            _check_table(name, values, place, found)
            own = {key: value for key, value in values.items() if key != "output"}
            first = str(own.get("name")) if name == "study" else FOLDERS.get(name, name)
            output = values.get("output") or f"{first}{f'-{number + 1}' if number else ''}"
            if name != "scene":
                steps.append(Step(name, own, str(output)))
    session = Session(dict(tables.get("scene") or {}), tuple(steps), tables)
    _check_steps(session, found)
    if found.mistakes:
        raise refuse_together(where, [*dict.fromkeys(found.mistakes)])
    return session


@dataclass
class _Mistakes:
    """Mistakes in the ``tables`` of a file, each with its line; a value that was ``changed`` has none."""

    data: Table
    changed: set[Place]
    mistakes: list[Mistake] = field(default_factory=list)
    tables: set[Place] = field(default_factory=set)

    def say(self, place: Place, text: str) -> None:
        """Note the mistake ``text`` at a ``place``."""
        once = len(place) > 1 and place[0] in SEVERAL and not isinstance(self.data.get(str(place[0])), list)
        there = (place[0], *place[2:]) if once else place
        self.tables.add(place[: 1 + (place[0] in SEVERAL)])
        line = 0 if place in self.changed or there in self.changed else self.data.line(there)
        self.mistakes.append((line, f"{'.'.join(map(str, place))}: {text}"))

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


def _check_table(name: str, values: Mapping[str, Any], place: Place, found: _Mistakes) -> None:
    """Note the mistakes in the ``values`` of a table."""
    fields = fields_of(name)
    for key, value in values.items():
        if name == "scene" and key not in fields and key != "parameters":
            found.attempt(place, _one_value, key, value)
        elif key not in fields:
            hint = near_name(key, fields).strip() or f"known fields: {', '.join(fields)}"
            found.say((*place, key), f"got {short_text(value)}, no such field; {hint}")
    asked = Step(name, {key: value for key, value in values.items() if key in fields}, "").of(TABLES[name])
    if name == "reconstruct" and str(asked.get("method")).endswith(MODEL):
        del asked["method"]
    found.attempt(place, TABLES[name], **asked)


def _change(data: Table, name: str, value: Any, where: str) -> Place:
    """Set the field of a dotted ``name`` to a ``value``; its place."""
    if not isinstance(name, str):
        raise MitsimError(f"values: {short_text(name)}: give names of fields, such as capture.patterns")
    place: list[str | int] = [int(part) if part.isdecimal() else part for part in name.split(".")]
    if len(place) < 2 or place[0] not in TABLES:
        raise MitsimError(
            f"-D {cut(name)}: {near_name(str(place[0]), TABLES)}give TABLE.FIELD=VALUE, such as "
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
    holder[place[-1]] = _copy(value)
    here = Path.cwd()
    _replace_paths(data, lambda path: os.path.normpath(here / path), here, {(str(place[0]), place[-1])})
    return tuple(place)


def value_of(text: str) -> Any:
    """Return the TOML value in a ``text``; the text itself if it has none."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text


def _replace_paths(
    data: dict[str, Any],
    replace: Callable[[str], str],
    base: Path = Path(os.path.sep),
    only: set[tuple[str, str]] | None = None,
) -> None:
    """Replace each path in some tables.

    Parameters
    ----------
    data
        tables, which are changed.
    replace
        makes the new path of the old one.
    base
        folder from which relative paths count.
    only
        table and name of the fields that are looked at; None: all.
    """
    for name, each in data.items():
        for table in each if isinstance(each, list) else [each]:
            for key, value in table.items() if isinstance(table, dict) and name != "sweep" else ():
                named = only is None or (name, key) in only
                if named and isinstance(value, str) and value and _is_file(name, key, value, base):
                    table[key] = replace(value)


def _is_file(table: str, key: str, value: str, base: Path) -> bool:
    """Return True if a ``value`` names a file beside the session's, and no shipped one; none does that is too long."""
    if "\0" in value or table not in TABLES:
        return False
    path, fields = Path(value), fields_of(table)
    if key not in fields:  # a parameter of the scene
        return bool(path.suffix) and os.path.isfile(base / path)
    if not (key == "recipe" or "Path" in str(fields[key].annotation)) or key == "output":
        return key == "method" and path.suffix == MODEL
    if os.sep in value or path.suffix:
        return True
    shipped = shipped_path("scenes") / value, shipped_path("calibration") / f"{value}.toml"
    return not any(map(os.path.exists, shipped)) and os.path.exists(base / path)


# ---- Steps that need each other --------------------------------------------------------------------------------------


def _check_steps(session: Session, found: _Mistakes) -> None:
    """Note steps that lack another, or that are in the way of another."""

    def same(name: str) -> str:
        """Return the spelling that names share which a file system may confuse, whatever their case and accents."""
        return unicodedata.normalize("NFC", name).casefold()

    numbers, outputs = dict[str, int](), [same(step.output) for step in session.steps]
    for step in session.steps:
        number = numbers[step.verb] = numbers.get(step.verb, -1) + 1
        place: Place = (step.verb, number) if step.verb in SEVERAL else (step.verb,)
        if place not in found.tables and not (step.verb == "sweep" and found.mistakes):
            _check_step(session, step, place, found)
        if Path(step.output).name != step.output or step.output.startswith("."):
            found.say((*place, "output"), f"{cut(repr(step.output))}: give a name without folders and no dot before it")
        elif (name := same(step.output)) in map(same, _RESERVED):
            others = ", ".join(_RESERVED)
            found.say((*place, "output"), f"{step.output!r} is the session's own; give another than {others}")
        elif outputs.count(name) > 1:
            given = cut(repr(step.output))
            found.say((*place, "output"), f"{given} is another step's too; give each a name of its own")
        if step.verb in (*OF_A_BENCH, "sweep") and not session.scene:
            found.say(place, 'is of a scene, and there is none; add a table [scene] with scene = "NAME"')
    if not session.steps:
        found.mistakes.append((0, f"asks for nothing; add a table, such as [capture]: {', '.join(TABLES)}"))


def _check_step(session: Session, step: Step, place: Place, found: _Mistakes) -> None:
    """Note the mistakes of a ``step`` beside the other ones."""
    values, capture = step.values, session.step("capture")
    colour, plan, light = values.get("colour", NO), session.step("plan"), session.step("transport")
    if step.verb == "capture" and (above := light or plan):
        for name in ("accuracy", "effects"):
            if name in values:
                found.say((*place, name), f"is the {above.verb}'s; give it in [{above.verb}]")
        if plan is not None and light is not None:
            found.say(("plan",), "stands beside [transport], which plans itself; leave one of them out")
        if colour != NO:
            found.say((*place, "colour"), f"stands beside [{above.verb}], which tells no light apart; leave one out")
    elif step.verb == "calibrate" and capture and colour != (other := capture.values.get("colour", NO)):
        found.say((*place, "colour"), f"{colour}, but the capture's is {other}; give both the same")
    elif step.verb == "export":
        calibration = values.get("calibration") or calibration_for(session, step)
        found.attempt(place, check_format, values["format"], step.output, calibration, values.get("projector"))
    elif step.verb == "sweep":
        found.attempt(place, sweep_options, session, step)
        for each in session.steps:
            if each.verb in ("plan", "transport", "demo", "export"):
                beside = "stands beside [sweep], whose points make no folders of it; leave one of them out"
                found.say((each.verb,), beside)
            fixed = _SWEPT if each.verb == "capture" else ()
            if each.verb in FOLDERS:
                for name in (name for name in each.values if name not in fixed):
                    few = f"[capture]'s {', '.join(fixed)}" if fixed else "none of it"
                    found.say((each.verb, name), f"is not in a sweep's points, which take {few}; leave it out")
    needed = {"run": "capture", "calibration": "calibrate"} if step.verb == "reconstruct" else {}
    for name, verb in ({"run": "capture"} if step.verb == "export" else needed).items():
        if name not in values and session.step(verb) is None:
            found.say((*place, name), f"is missing, and there is no [{verb}]; give the folder, or add the table")


def calibration_for(session: Session, step: Step) -> str | None:
    """Return the session's own calibration if the format of an export ``step`` can hold it."""
    own = session.step("calibrate")
    return own.output if own and step.values["format"] != PNG else None


def sweep_options(session: Session, step: Step) -> dict[str, Any]:
    """Return the options of the study that a ``step`` [sweep] is; MitsimError for values that it cannot vary."""
    from mitsim.studies.framework.experiment import NO_SCENE, check_sweep

    scene = step.values.get("scene") or {}
    over = swept_values({**scene, **(step.values.get("capture") or {})})
    if outside := [name for name in scene if name in (*NO_SCENE, *TABLES["scene"].model_fields)]:
        few = "a sweep varies these, and capture.patterns, capture.seed and capture.accuracy"
        raise ArgumentError("scene", f"{outside[0]}: is no parameter of the scene; {few}")
    capture = session.step("capture")
    fixed = dict(capture.values) if capture else {}
    if "accuracy" in fixed:
        over.setdefault("accuracy", [fixed["accuracy"]])
    check_sweep([(name, [str(value) for value in values]) for name, values in over.items()], 1)
    options: dict[str, Any] = {name: fixed[name] for name in ("patterns", "seed") if name in fixed and name not in over}
    return {**options, "over": over, **{name: step.values[name] for name in ("measure", "jobs") if name in step.values}}


def swept_values(swept: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Return the values that are ``swept``, by name, with ranges as lists of values."""
    from mitsim.studies.framework.experiment import values_of

    found = dict[str, list[Any]]()
    for name, each in swept.items():
        if isinstance(each, Mapping):
            each = values_of(f"{name}={each['from']!r}:{each['to']!r}:{each['count']}")[1]
        found[name] = list(each)
    return found
