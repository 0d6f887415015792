"""A session file in; what each verb is asked for, or a refusal with all mistakes, out; and back to its text.

A table is a verb, and its fields are the arguments of the Python call that does the work: names, kinds and defaults are
read from there, so that each stands once.
"""

from __future__ import annotations

import inspect
import os
import sys
import unicodedata
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import pydantic
import tomli_w

from mitsim.api.bench import open_bench
from mitsim.bench.request import Request, SessionRequest
from mitsim.core.configuration import Configuration, locate, read_toml, shipped_path, validate
from mitsim.core.errors import ArgumentError, MitsimError, cut, is_path, near_name, printable, short_text
from mitsim.core.files import PAGE, PICTURES, resolve
from mitsim.core.mistakes import Mistake, Place, Table, mistakes, told_together
from mitsim.devices.session import SessionRecipe, load_recipe
from mitsim.exchange.formats import PNG, check_format, export
from mitsim.reconstruct.request import ImageRequest
from mitsim.verbs import StudyOptions, demo

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

# ---- Tables, from the calls that take their fields -------------------------------------------------------------------


def _one_value(value: Any) -> Any:
    """A ``value`` of a parameter; ValueError for another."""
    if not isinstance(value, (str, int, float)):
        raise ValueError(f"got {cut(repr(value))}; give a number, text in quotes, or true or false")
    return value


def _several_values(values: Any) -> Any:
    """A list of ``values``, or the ends and the count of a range; ValueError for anything else."""
    if isinstance(values, Mapping):
        numbers = [isinstance(values.get(name), (int, float)) for name in ("from", "to", "count")]
        if values.keys() == {"from", "to", "count"} and all(numbers):
            return values
    elif isinstance(values, (list, tuple)) and values:
        return [_one_value(value) for value in values]
    raise ValueError(f"got {cut(repr(values))}; give a list of values, or {{ from = A, to = B, count = N }}")


def _path(value: Any) -> Any:
    """A ``value`` that is no text, or one that can be a path; ValueError for another."""
    if isinstance(value, str) and not is_path(value):
        raise ValueError(f"got {cut(repr(value))}; give a path")
    return value


_Value = Annotated[Any, pydantic.AfterValidator(_one_value)]
_Values = Annotated[Any, pydantic.AfterValidator(_several_values)]
_Path = Annotated[str, pydantic.AfterValidator(_path)]
_Recipe = Annotated[str | dict[str, Any], pydantic.AfterValidator(_path)]
_Number = Annotated[float, pydantic.Field(allow_inf_nan=True)]
_Two = Annotated[tuple[_Number, _Number], pydantic.Field(strict=False)] | None
_OWN = {"self", "output", "resume", "job", "overwrite", "for_render"}
"""Arguments that are the session's own: where results go, and how work is watched."""


def _fields(call: Callable[..., Any], *leave_out: str, **other: Any) -> dict[str, Any]:
    """Fields of a table.

    Parameters
    ----------
    call
        whose arguments they are.
    leave_out
        names of some that it does not have.
    **other
        kinds and defaults of some: what another room's type is there is text or a number in a file.
    """
    known = vars(sys.modules[call.__module__])
    found = {}
    for name, each in inspect.signature(call).parameters.items():
        if name in _OWN or name in leave_out or each.kind == each.VAR_KEYWORD:
            continue
        if name in other:
            continue
        kind = eval(each.annotation, known)  # as typing.get_type_hints does
        if Path in getattr(kind, "__args__", (kind,)):
            kind = _Path | None if type(None) in kind.__args__ else _Path
            _PATHS.add(name)
        found[name] = kind, ... if each.default is each.empty else each.default
    return {**found, **other}


_PATHS = {"run", "calibration", "camera", "projector", "recipe", "scene"}
"""Fields that name files and folders."""
_REQUEST: dict[str, Any] = {
    name: (kind, Request.model_fields[name].default)
    for name, kind in get_type_hints(Request).items()
    if name in Request.model_fields
}
"""Without the request's own checks, which refuse one value and see no file."""
_REQUEST["effects"] = (str | dict[str, bool], {})
_PLANNED = {name: _REQUEST[name] for name in ("patterns", "accuracy", "seconds", "seed", "effects")}
_COLOUR = {"colour": (str, "no")}
_WHERE = {"output": (_Path | None, None)}


class _SceneTable(Configuration):
    """Further names are the scene's parameters."""

    model_config = pydantic.ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, _Value] = pydantic.Field(init=False)


class _SweptScene(Configuration):
    model_config = pydantic.ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, _Values] = pydantic.Field(init=False)


def _table(name: str, fields: Mapping[str, Any], base: type[Configuration] = Configuration) -> Any:
    return pydantic.create_model(name, __base__=base, **fields)


_SWEPT = _table("capture", {name: (_Values, None) for name in ("patterns", "seed", "accuracy")})
_IMAGE = _fields(
    ImageRequest, "lam", method=(str, "tikhonov"), depth_range=(_Two, None), bounds=(_Two, None)
)  # fmt: skip
TABLES: dict[str, Any] = {
    "scene": _table("scene", _fields(open_bench), _SceneTable),
    "plan": _table("plan", _PLANNED),
    "transport": _table("transport", {**_PLANNED, **_WHERE}),
    "capture": _table("capture", {**_REQUEST, **_COLOUR, **_WHERE}),
    "calibrate": _table(
        "calibrate", {**_fields(SessionRequest, recipe=(_Recipe | None, None)), **_COLOUR, **_WHERE}
    ),
    "reconstruct": _table(
        "reconstruct",
        {"run": (_Path | None, None), "calibration": (_Path | None, None), "lambda": (float | str, "auto"), **_IMAGE,
         "chart": (_Path | None, None), **_WHERE},
    ),
    "demo": _table("demo", {**_fields(demo, "scene"), **_WHERE}),
    "sweep": _table(
        "sweep",
        {"scene": (_SweptScene | None, None), "capture": (_SWEPT | None, None), "measure": (str, "psnr"),
         "jobs": (int | None, None), **_WHERE},
    ),
    "study": _table(
        "study",
        {"name": (str, ...), "scene": (_Path | None, None), "patterns": (str | None, None),
         **_fields(StudyOptions, "shard", "scheduler", "experiment", parameters=(dict[str, _Value], {}),
                   over=(dict[str, _Values], {})),
         **_WHERE},
    ),
    "export": _table("export", {**_fields(export, run=(_Path | None, None)), "output": (_Path, ...)}),
}  # fmt: skip
"""Model of each table, in the order in which the steps are taken."""
SEVERAL = "reconstruct", "study", "export"
"""Tables that may stand there more than once, as ``[[reconstruct]]``."""


def _kind_of(name: str, model: Any) -> Any:
    """Kind and default of the table of a ``name``."""
    if name in SEVERAL:
        return Annotated[tuple[model, ...], pydantic.Field(strict=False)], ()
    return model | None, None


_SESSION = _table("session", {name: _kind_of(name, model) for name, model in TABLES.items()})
FOLDERS = {"capture": "run", "calibrate": "calibration", "reconstruct": "image"}
"""Where the results of some steps go, which others are called like their table."""


# ---- Steps -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Step:
    """What one verb is asked for.

    Attributes
    ----------
    verb
        its name.
    values
        of its arguments, those that are given.
    output
        name of its folder, or file, in the session's.
    """

    verb: str
    values: Mapping[str, Any]
    output: str


@dataclass(frozen=True)
class Session:
    """What a session file says, checked.

    Attributes
    ----------
    scene
        arguments that open the bench; empty where no step needs one.
    steps
        in the order in which they are taken.
    tables
        as a file holds them, with whole paths; nothing of what the caller gave.
    where
        the file, for messages.
    """

    scene: Mapping[str, Any]
    steps: tuple[Step, ...]
    tables: Mapping[str, Any]
    where: str = "session"

    def step(self, verb: str) -> Step | None:
        """The first step of a ``verb``."""
        return next((step for step in self.steps if step.verb == verb), None)


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
    parts = [" ".join(f"# {printable(note)}".split()) for note in notes]
    parts = ["\n".join(parts) + "\n"] if parts else []
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


class _Lined(Table):
    """The tables of a session, those that may stand there twice as lists; ``written`` is what the file holds."""

    def __init__(self, written: Table, changed: set[Place]) -> None:
        once = {name for name in SEVERAL if isinstance(written.get(name), dict)}
        super().__init__({name: [each] if name in once else each for name, each in written.items()}, written.text)
        self._once, self._changed = once, changed

    def lines(self) -> dict[Place, int]:
        """As :meth:`Table.lines`; what was changed has no line."""
        found = super().lines()
        found |= {(place[0], 0, *place[1:]): line for place, line in found.items() if place[0] in self._once}
        return {**found, **dict.fromkeys(self._changed, 0)}


def read_session(source: Path | str | Mapping[str, Any], changes: Mapping[str, Any] | None = None) -> Session:
    """What a session file says.

    Parameters
    ----------
    source
        path of the file, the name of a shipped one, or its tables.
    changes
        values of fields by name, as ``capture.patterns``; paths in them count from the working folder.

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
    changed = {_change(data, name, value, where) for name, value in (changes or {}).items()}
    lined = _Lined(data, changed)
    found = mistakes(_SESSION, lined)
    if not found:
        model = _SESSION.model_validate(lined)
        session = _session_of(model, where)
        found = [*_mistakes_of_values(session, lined)]
    if found:
        raise told_together(where, found)
    return session


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
    """The value in a ``text`` as TOML has it; the text itself, where it is none."""
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
    """Whether a ``value`` names a file beside the session's, and no shipped one; none does that is too long."""
    if "\0" in value or table not in TABLES:
        return False
    path = Path(value)
    if key not in TABLES[table].model_fields:  # a parameter of the scene
        return bool(path.suffix) and os.path.isfile(base / path)
    if key not in _PATHS:
        return key == "method" and path.suffix == ".pt"
    if os.sep in value or path.suffix:
        return True
    shipped = shipped_path("scenes") / value, shipped_path("calibration") / f"{value}.toml"
    return not any(map(os.path.exists, shipped)) and os.path.exists(base / path)


def _session_of(model: Any, where: str) -> Session:
    tables: dict[str, Any] = {}
    steps: list[Step] = []
    for name in TABLES:
        held = getattr(model, name)
        for number, one in enumerate(held if name in SEVERAL else [held] if held is not None else []):
            values = one.model_dump(exclude_unset=True, by_alias=True)
            own = {key: value for key, value in values.items() if key != "output"}
            first = own["name"] if name == "study" else FOLDERS.get(name, name)
            steps.append(Step(name, own, values.get("output") or f"{first}{f'-{number + 1}' if number else ''}"))
            if name in SEVERAL:
                tables.setdefault(name, []).append(values)
            else:
                tables[name] = values
    scene = dict(tables.get("scene", {}))
    return Session(scene, tuple(step for step in steps if step.verb != "scene"), tables, where)


# ---- What a model of fields does not tell ----------------------------------------------------------------------------

OF_A_BENCH = "plan", "transport", "capture", "calibrate", "demo"
"""Verbs that open the scene here; a sweep does so itself."""
SESSION_FILE, SUMMARY = "session.toml", "session.json"
"""What a folder of a session says of itself: what was asked for, and what each step came to."""
_RESERVED = PAGE, PICTURES, SESSION_FILE, SUMMARY
"""Names in the session's folder that no step may write to."""


@dataclass
class _Mistakes:
    """Mistakes, each with its line."""

    lines: Mapping[Place, int]
    mistakes: list[Mistake] = field(default_factory=list)

    def say(self, place: Place, text: str) -> None:
        """That a ``text`` is wrong with what stands at a ``place``."""
        line = next((self.lines[place[:end]] for end in range(len(place), 0, -1) if place[:end] in self.lines), 0)
        self.mistakes.append((line, f"{'.'.join(map(str, place))}: {text}"))

    def attempt(self, place: Place, call: Callable[[], object]) -> bool:
        """Note what a ``call``, which checks values of a table at a ``place``, refuses; whether it refuses none."""
        try:
            call()
        except ArgumentError as error:
            argument = "lambda" if error.argument == "lam" else error.argument
            text = str(error).removeprefix(f"{error.argument} ")
            self.say(place if place[-1] == argument else (*place, argument), text)
        except MitsimError as error:
            self.say(place, str(error))
        else:
            return True
        return False


def _mistakes_of_values(session: Session, data: _Lined) -> Iterator[Mistake]:
    """What the calls would refuse before they look at files, and steps that lack another."""
    found, numbers = _Mistakes(data.lines()), dict[str, int]()
    for step in session.steps:
        number = numbers[step.verb] = numbers.get(step.verb, -1) + 1
        place: Place = (step.verb, number) if step.verb in SEVERAL else (step.verb,)
        if step.verb in _CHECKS:
            _CHECKS[step.verb](session, step, place, found)
        if Path(step.output).name != step.output or step.output.startswith("."):
            found.say((*place, "output"), f"{cut(repr(step.output))}: give a name without folders and no dot before it")
        elif (name := _same_name(step.output)) in map(_same_name, _RESERVED):
            found.say(
                (*place, "output"), f"{step.output!r} is the session's own; give another than {', '.join(_RESERVED)}"
            )
        elif [_same_name(other.output) for other in session.steps].count(name) > 1:
            found.say(
                (*place, "output"), f"{cut(repr(step.output))} is another step's too; give each a name of its own"
            )
        if step.verb in (*OF_A_BENCH, "sweep") and not session.scene:
            found.say(place, 'is of a scene, and there is none; add a table [scene] with scene = "NAME"')
    if not session.steps:
        found.mistakes.append((0, f"asks for nothing; add a table, such as [capture]: {', '.join(TABLES)}"))
    yield from dict.fromkeys(found.mistakes)


def _same_name(name: str) -> str:
    """Return the spelling that names share which a file system may take for one: whatever their case and accents."""
    return unicodedata.normalize("NFC", name).casefold()


def request_of(step: Step) -> dict[str, Any]:
    """Fields of the request in the values of a ``step``."""
    return {name: value for name, value in step.values.items() if name in Request.model_fields}


def _check_request(session: Session, step: Step, place: Place, found: _Mistakes) -> None:
    request = request_of(step)
    if all([found.attempt((*place, name), partial(Request.of, **{name: value})) for name, value in request.items()]):
        found.attempt(place, partial(Request.of, **request))


def _check_capture(session: Session, step: Step, place: Place, found: _Mistakes) -> None:
    _check_request(session, step, place, found)
    _check_colour(step, place, found)
    plan, light = session.step("plan"), session.step("transport")
    above = light or plan
    if above is None:
        return
    planned = ("accuracy", "seconds", "effects", *(("noise_fraction",) if light else ()))
    for name in (name for name in planned if name in step.values):
        found.say((*place, name), f"is the {above.verb}'s; give it in [{above.verb}]")
    if plan is not None and light is not None:
        found.say(("plan",), "stands beside [transport], which plans itself; leave one of them out")
    if step.values.get("colour", "no") != "no":
        found.say((*place, "colour"), f"stands beside [{above.verb}], which tells no light apart; leave one out")


def _check_colour(step: Step, place: Place, found: _Mistakes) -> None:
    from mitsim.core.spectral_manifests import BANDS, bands_of

    word = step.values.get("colour", "no")
    if word.startswith(f"{BANDS}:"):
        found.attempt(place, lambda: bands_of(word))
    elif word not in ("no", "lines", "mosaic"):
        found.say((*place, "colour"), f"{cut(repr(word))}: give no, lines, bands:K or mosaic")


def _check_calibrate(session: Session, step: Step, place: Place, found: _Mistakes) -> None:
    _check_request(session, step, place, found)
    _check_colour(step, place, found)
    capture = session.step("capture")
    if isinstance(step.values.get("recipe"), Mapping):
        found.attempt((*place, "recipe"), partial(recipe_of, step.values))
    words = [each.values.get("colour", "no") for each in (step, capture) if each]
    if len(set(words)) > 1:
        found.say((*place, "colour"), f"{words[0]}, but the capture's is {words[1]}; give both the same")


def recipe_of(values: Mapping[str, Any]) -> SessionRecipe:
    """The recipe of a calibration with these ``values``: in a file, in the session's, or the shipped one; MitsimError
    for one that breaks a rule."""
    recipe = values.get("recipe")
    return validate(SessionRecipe, dict(recipe), "recipe") if isinstance(recipe, Mapping) else load_recipe(recipe)


def image_request(step: Step) -> dict[str, Any]:
    """Arguments that an image is solved with, in the values of a ``step``."""
    own = {name: value for name, value in step.values.items() if name not in ("run", "calibration", "chart")}
    return {"lam" if name == "lambda" else name: value for name, value in own.items()}


def _check_reconstruct(session: Session, step: Step, place: Place, found: _Mistakes) -> None:
    asked = {name: value for name, value in image_request(step).items() if not str(value).endswith(".pt")}
    found.attempt(place, lambda: ImageRequest(**asked))
    for name, verb in (("run", "capture"), ("calibration", "calibrate")):
        if name not in step.values and session.step(verb) is None:
            found.say((*place, name), f"is missing, and there is no [{verb}]; give the folder, or add the table")


def _check_export(session: Session, step: Step, place: Place, found: _Mistakes) -> None:
    values = step.values
    calibration = values.get("calibration") or calibration_for(session, step)
    found.attempt(place, partial(check_format, values["format"], step.output, calibration, values.get("projector")))
    if "run" not in values and session.step("capture") is None:
        found.say((*place, "run"), "is missing, and there is no [capture]; give the folder, or add the table")


def calibration_for(session: Session, step: Step) -> str | None:
    """The calibration that an export ``step`` takes of its own ``session``: that which its format can hold."""
    own = session.step("calibrate")
    return own.output if own and step.values["format"] != PNG else None


def _check_sweep(session: Session, step: Step, place: Place, found: _Mistakes) -> None:
    found.attempt(place, lambda: sweep_options(session, step))
    for other in session.steps:
        if other.verb in ("plan", "transport", "demo", "export"):
            found.say((other.verb,), "stands beside [sweep], whose points make no folders of it; leave one of them out")
        fixed = {"capture": ("patterns", "seed", "accuracy")}.get(other.verb, ())
        if other.verb in ("capture", "calibrate", "reconstruct"):
            for name in (name for name in other.values if name not in fixed):
                few = f"[capture]'s {', '.join(fixed)}" if fixed else "none of it"
                found.say((other.verb, name), f"is not in a sweep's points, which take {few}; leave it out")


def sweep_options(session: Session, step: Step) -> dict[str, Any]:
    """Arguments of the study that a sweep is.

    Parameters
    ----------
    session, step
        which has a step ``[sweep]``.

    Raises
    ------
    MitsimError
        for what it cannot vary.
    """
    from mitsim.studies.framework.experiment import NO_SCENE, check_sweep

    over = swept_values({**(step.values.get("scene") or {}), **(step.values.get("capture") or {})})
    if outside := [
        name for name in step.values.get("scene") or {} if name in (*NO_SCENE, *TABLES["scene"].model_fields)
    ]:
        raise ArgumentError("scene", f"{outside[0]}: is no parameter of the scene; a sweep varies these, and "
                                     "capture.patterns, capture.seed and capture.accuracy")  # fmt: skip
    capture = session.step("capture")
    fixed = dict(capture.values) if capture else {}
    if "accuracy" in fixed:
        over.setdefault("accuracy", [fixed["accuracy"]])
    check_sweep([(name, [str(value) for value in values]) for name, values in over.items()], 1)
    options: dict[str, Any] = {name: fixed[name] for name in ("patterns", "seed") if name in fixed and name not in over}
    return {**options, "over": over, **{name: step.values[name] for name in ("measure", "jobs") if name in step.values}}


def swept_values(swept: Mapping[str, Any]) -> dict[str, list[Any]]:
    """What is ``swept``, values or a range of them by name, as values; MitsimError for a range of too many."""
    from mitsim.studies.framework.experiment import values_of

    def values(name: str, each: Any) -> list[Any]:
        if not isinstance(each, Mapping):
            return list(each)
        return list(values_of(f"{name}={each['from']!r}:{each['to']!r}:{each['count']}")[1])

    return {name: values(name, each) for name, each in swept.items()}


_CHECKS: dict[str, Callable[[Session, Step, Place, _Mistakes], None]] = {
    "plan": _check_request,
    "transport": _check_request,
    "capture": _check_capture,
    "calibrate": _check_calibrate,
    "reconstruct": _check_reconstruct,
    "demo": _check_request,
    "export": _check_export,
    "sweep": _check_sweep,
}
