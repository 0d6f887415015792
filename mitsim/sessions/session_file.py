"""Session files: tables of options become the steps of a session, or a refusal with all mistakes, and text again.

A table is a verb, and its fields are those of the models that the verb takes on the command line and in Python.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tomli_w
from pydantic import BaseModel, Field
from pydantic.fields import FieldInfo

from mitsim.bench.request import NO, Coloured, Opening, Planned, PredictRequest, Request, SessionRequest
from mitsim.core.colour_files import COLOUR, IMAGE, KINDS, is_coloured, open_lines, spectral_of
from mitsim.core.configuration import (
    FilePath,
    Options,
    Place,
    known_names,
    load_model,
    locate,
    option,
    read_toml,
    refuse_together,
    shipped_path,
    validate,
    validated_by,
    value_of,
)
from mitsim.core.environment import DEFAULT_VARIANT, deciding_versions
from mitsim.core.errors import (
    ArgumentError,
    MitsimError,
    check_arguments,
    cut,
    is_path,
    near_name,
    printable,
    short_text,
)
from mitsim.core.files import PAGE, PICTURES, plain, read_json, resolve, write_text
from mitsim.core.manifests import MANIFEST, CalibrationManifest, RunManifest, read_manifest
from mitsim.design.goal import Goal
from mitsim.devices.patterns import is_own
from mitsim.devices.sensor import load_sensor
from mitsim.devices.session import SessionRecipe, load_recipe
from mitsim.exchange.formats import PNG, Exported, check_format
from mitsim.reconstruct.request import METHODS, MODEL, RESULT_FILE, ImageRequest
from mitsim.verbs import StudyOptions

# ---- Tables ----------------------------------------------------------------------------------------------------------


def _one_value(name: str, value: Any) -> None:
    if not isinstance(value, (str, int, float)):
        raise ArgumentError(name, f"{short_text(value)}: give a number, text in quotes, or true or false")


def _recipe(recipe: Any) -> None:
    if isinstance(recipe, Mapping):
        validate(SessionRecipe, dict(recipe), "recipe")
    elif not is_path(recipe):
        raise ArgumentError("recipe", f"{short_text(recipe)}: give a path, or a table of a recipe's fields")


class _Placed(Options):
    """Name of a step's folder or file in that of the session."""

    output: FilePath | None = option(None, "folder of the step")


class _Scene(Opening):
    scene: FilePath


class _Prediction(_Placed, PredictRequest):
    recipe: Annotated[Any, validated_by(_recipe)] = None


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


class _Design(_Placed, Goal):
    pass


class _Export(Exported):
    run: FilePath | None = None


TABLES: dict[str, type[Options]] = {
    "scene": _Scene,
    "predict": _Prediction,
    "transport": _Light,
    "capture": _Capture,
    "calibrate": _Calibration,
    "reconstruct": _Image,
    "study": _Study,
    "design": _Design,
    "export": _Export,
}
"""Model of each table, in the order in which the steps are taken."""
SEVERAL = "reconstruct", "study", "export"
"""Tables that may be there more than once, as ``[[reconstruct]]``."""
OF_A_BENCH = "predict", "transport", "capture", "calibrate"
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


def own_files(tables: Mapping[str, Any]) -> dict[str, Path]:
    """Return the files and folders that ``tables`` read beside the shipped ones, by field; a mask's drawing too."""
    found, scene = dict[str, Path](), tables.get("scene") or {}
    for name in (name for name in TABLES if name in tables):
        for number, table in enumerate(tables[name] if name in SEVERAL else [tables[name]]):
            place = f"{name}.{number}" if name in SEVERAL else name
            texts = {key: value for key, value in table.items() if key != "output" and isinstance(value, str)}
            found |= {f"{place}.{key}": Path(value) for key, value in texts.items() if os.path.isabs(value)}
    camera = found.get("scene.camera", Path())
    if drawing := camera.is_file() and (read_toml(camera).get("mask") or {}).get("file"):
        found["scene.camera: mask.file"] = camera.parent / drawing
    for name in scene.keys() - fields_of("scene").keys():
        value = Path(str(scene[name]))
        beside = locate(scene["scene"], "scenes", "scene.xml").parent / value
        if value.suffix[1:].isalpha() and not beside.exists():
            found[f"scene.{name}"] = value
    return found


def _change(data: dict[str, Any], name: str, value: Any, where: str) -> None:
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
    if isinstance(value, list):
        return [_whole(table, key, each, base) for each in value]
    if not isinstance(value, str) or not value or "\0" in value or table not in TABLES:
        return value
    path, fields = Path(value), fields_of(table)
    if key not in fields:  # a parameter of the scene
        is_file = bool(path.suffix) and os.path.isfile(base / path)
    elif key == "patterns":
        is_file = is_own(value, base)
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
        values, capture = step.values, session.step("capture")
        colour, needed = values.get("colour", NO), dict[str, str]()
        if place in found.tables:
            pass
        elif step.verb == "capture" and session.step("transport"):
            for name in ("accuracy", "seconds", "effects"):
                if name in values:
                    found.say((*place, name), "is the transport's; give it in [transport]")
            if colour != NO:
                found.say((*place, "colour"), "cannot go with [transport], which sums all light; leave one out")
        elif step.verb == "calibrate" and capture and colour != (other := capture.values.get("colour", NO)):
            found.say((*place, "colour"), f"{colour}, but the capture's is {other}; give both the same")
        elif step.verb == "reconstruct":
            needed = {"run": "capture", "calibration": "calibrate"}
        elif step.verb == "export":
            own, needed = {"output": step.output, "calibration": calibration_for(session, step)}, {"run": "capture"}
            found.attempt(place, check_format, Exported(**{**own, **step.of(Exported)}))
        for name, verb in needed.items():
            if name not in values and session.step(verb) is None:
                found.say((*place, name), f"is missing, and there is no [{verb}]; give the folder, or add the table")
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
        found.texts.append(f"has no step; add a table, such as [capture]: {', '.join(TABLES)}")


def calibration_for(session: Session, step: Step) -> str | None:
    """Return the session's own calibration if the format of an export ``step`` can hold it."""
    own = session.step("calibrate")
    return own.output if own and step.values["format"] != PNG else None


# ---- The session file that repeats a folder, from the folder's own files ---------------------------------------------


class _Opened(BaseModel):
    """Files in a manifest that opened its bench."""

    camera: str | None = None
    projector: str | None = None
    allow_outside_files: bool = False


class _Traced(BaseModel):
    """The scene in the configuration of a manifest."""

    scene: str
    defines: dict[str, str]
    variant: str
    scene_sha256: str | None = None
    scene_files: dict[str, str] = Field(default_factory=dict)


@dataclass(frozen=True)
class Repeat:
    """The ``text`` of a session file that repeats a folder, and reasons why its results may differ.

    Attributes
    ----------
    text
        Text of the file, with whole paths.
    warnings
        Sentences.
    needs
        Files and folders that the session reads beside the shipped ones.
    tables, notes, needs
        Tables of the file, lines of comment before them, and files that the session reads beside the shipped ones.
    """

    text: str
    warnings: tuple[str, ...] = ()
    tables: Mapping[str, Any] = field(default_factory=dict, repr=False)
    notes: tuple[str, ...] = field(default=(), repr=False)
    needs: tuple[str, ...] = ()

    @check_arguments
    def save(self, path: Path | str) -> Path:
        """Write the session file to ``path``, which is replaced, with paths as seen from there; return the path.

        MitsimError when it cannot be written.
        """
        write_text(path, session_text(self.tables, Path(path).absolute().parent, *self.notes))
        return Path(path)


@check_arguments
def session_of(folder: Path | str) -> Repeat:
    """Return the session file that repeats a folder, with the calibration and the images that belong to its frames.

    Parameters
    ----------
    folder
        Folder of a session, a capture, a calibration, or an image.

    Returns
    -------
    Repeat
        The ``text``; ``warnings`` name files that have changed since, or that the folder does not name.

    Raises
    ------
    MitsimError
        for a folder that holds none of these, and for work that no session file describes: frames of a real camera,
        a bench before a board, a capture by a stored plan, a calibration that is fitted to pictures.
    """
    folder = Path(folder)
    if (folder / SUMMARY).is_file() and (folder / SESSION_FILE).is_file():
        tables = read_session(folder / SESSION_FILE).tables
        return Repeat(session_text(tables), (), tables, (), tuple(map(str, own_files(tables).values())))
    place, found, coloured = folder.absolute(), _Found(), is_coloured(folder)
    data = read_json(folder / COLOUR) if coloured else {}
    if (folder / RESULT_FILE).is_file() or (isinstance(data, dict) and data.get("kind") == IMAGE):
        found.add_image(place)
    elif coloured or (folder / MANIFEST).is_file():
        manifest_data = read_json(_first(place) / MANIFEST)
        if isinstance(manifest_data, dict) and manifest_data.get("kind") == "calibration":
            found.add_calibration(place)
        else:
            found.add_run(place)
            for path in sorted([*place.iterdir(), *place.parent.iterdir()]):
                if path.is_dir() and _made_of(path).get("run") == str(place):
                    found.add_image(path)
    else:
        raise MitsimError(
            f"{folder}: holds nothing that a session file repeats; give a folder of mitsim run, capture, calibrate or "
            "reconstruct"
        )
    tables = read_session(found.tables).tables  # which refuses values that a damaged folder states
    needs = tuple(map(str, own_files(tables).values()))
    said = [f"Needs also: {', '.join(needs)}"] if needs else []
    notes = f"Repeats {place}: mitsim run FILE -o FOLDER", *said, *found.warnings
    return Repeat(session_text(tables, None, *notes), tuple(found.warnings), tables, notes, needs)


@dataclass
class _Found:
    """Tables of a session that were found in folders, and ``warnings`` on changes since.

    ``taken`` has the folders that the tables of capture and calibration were taken from.
    """

    tables: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    taken: dict[str, str] = field(default_factory=dict)

    def warn(self, text: str) -> None:
        if text not in self.warnings:
            self.warnings.append(text)

    def add_scene(self, manifest: RunManifest | CalibrationManifest, folder: Path, coloured: bool) -> None:
        """Add the table of the scene that a ``manifest`` describes; MitsimError if it differs from an earlier one.

        Warn of files that differ from those that it describes.
        """
        from mitsim.bench.apparatus import check_devices, spelling
        from mitsim.core.exr import checksum
        from mitsim.devices.projector import ProjectorModel

        conf, where = manifest.configuration, f"{folder}/{MANIFEST}"
        if "scene" not in conf or "defines" not in conf:
            raise MitsimError(f"{folder}: is not of a simulated scene, so that no session file can repeat it")
        if "board" in conf:
            raise MitsimError(f"{folder}: is of a bench with a board, which only Python can make")
        if manifest.opened is None:
            self.warn(f"{folder} does not state the files of its devices: the default devices are used")
        files, scene = validate(_Opened, dict(manifest.opened or {}), where), validate(_Traced, dict(conf), where)
        if own := scene.defines.keys() & fields_of("scene").keys():
            raise MitsimError(f"{where}: defines.{min(own)} is no parameter of a scene; remove it")
        devices = {name: _short_name(getattr(files, name), "calibration") for name in ("camera", "projector")}
        usual = spectral_of(DEFAULT_VARIANT) if coloured else DEFAULT_VARIANT
        given: dict[str, Any] = {
            "scene": _short_name(scene.scene, "scenes"),
            **devices,
            "variant": None if scene.variant == usual else scene.variant,
            "allow_outside_files": files.allow_outside_files or None,
        }
        for name, text in scene.defines.items():  # a number or truth that a scene spells as this text; else the text
            value = value_of(text)
            given[name] = value if isinstance(value, (bool, int, float)) and spelling(value) == text else text
        table = {name: value for name, value in given.items() if value is not None}
        known = self.tables.setdefault("scene", table)
        if differ := [name for name in {**known, **table} if known.get(name) != table.get(name)]:
            both = "; ".join(f"{name} {table.get(name, 'unset')}, not {known.get(name, 'unset')}" for name in differ)
            raise MitsimError(f"{folder}: has another scene or other devices than its frames ({both})")
        for name, known in {scene.scene: scene.scene_sha256, **scene.scene_files}.items():
            if not Path(name).is_file():
                self.warn(f"{name} is not there")
            elif checksum(Path(name)) != known:
                self.warn(f"{name} was changed since")
        try:
            camera, projector = check_devices(devices["camera"], devices["projector"])
            sensor, light = load_sensor(camera), load_model(projector, ProjectorModel)
        except MitsimError as error:
            self.warn(str(error))
            return
        shown = {**light.model_dump(mode="json", exclude={"contrast_ratio"}), "black_level": light.black_level}
        if plain(sensor.identity) != conf.get("sensor"):
            self.warn(f"camera {camera} differs from that in the manifest")
        if plain(shown) != conf.get("projector_model") and not coloured:
            self.warn(f"projector {projector} differs from that in the manifest")
        if (made := conf.get("versions")) != deciding_versions():
            self.warn(f"it was made by {made}, but this is {deciding_versions()}")

    def add_run(self, folder: Path) -> None:
        """Add the request of the frames in a ``folder``."""
        manifest = read_manifest(_first(folder), RunManifest)
        conf = manifest.configuration
        self.add_scene(manifest, folder, is_coloured(folder))
        request = {name: conf[name] for name in Request.model_fields if name in conf}
        if gone := [name for name in ("noise_fraction", "closing_frame", "ambient_shots") if conf.get(name)]:
            self.warn(f"it was made with {' and '.join(gone)}, which this version does not have any more")
        if request.pop("seconds", None) is not None:
            request["accuracy"] = (manifest.plan or {}).get("accuracy")
            self.warn("it was planned for a given time: the accuracy is that which was reached then")
        always = "patterns", "accuracy", "seed"
        asked = {
            name: value
            for name, value in request.items()
            if name in always or value != Request.model_fields[name].default
        }
        if "plan_seed" in conf:
            raise MitsimError(f"{folder}: was captured with a stored plan, which a session file cannot contain")
        if "light" in conf:
            above = {name: asked[name] for name in (*always, "effects") if name in asked}  # on which light depends
            self.tables["transport"] = {**above, **conf["light"]}
            asked = {name: value for name, value in asked.items() if name not in ("accuracy", "effects")}
        self.tables["capture"] = {**asked, **self.colour_of(folder)}
        self.taken["capture"] = str(folder)

    def colour_of(self, folder: Path) -> dict[str, str]:
        """Return the option ``colour`` of a ``folder``; nothing for light of all lines together."""
        lines = open_lines(folder, *KINDS)
        if lines.colours is None or lines.filters:
            return {"colour": "mosaic"} if lines.filters else {}
        from mitsim.bench.apparatus import check_devices
        from mitsim.devices.projector import ProjectorModel

        count = len(lines.names)
        _, projector = check_devices(None, self.tables["scene"].get("projector"))
        several = load_model(projector, ProjectorModel).wavelengths_nm or ()
        return {"colour": "lines" if count == len(several) else f"bands:{count}"}

    def add_calibration(self, folder: Path) -> None:
        """Add the request of the calibration in a ``folder``."""
        manifest = read_manifest(_first(folder), CalibrationManifest)
        conf = manifest.configuration
        simulated = {"accuracy", "seed", "recipe"} <= conf.keys() and not {"aged", "depth_mm"} & conf.keys()
        if manifest.modelled or not simulated:
            raise MitsimError(f"{folder}: is not of one simulated session, so that no session file can repeat it")
        self.add_scene(manifest, folder, is_coloured(folder))
        own = load_recipe().model_dump(exclude_defaults=True, exclude={"depths"})
        recipe = {} if conf["recipe"] == plain(own) else {"recipe": conf["recipe"]}
        colour = self.colour_of(folder)
        if colour and (capture := self.tables.get("capture")):
            colour = {"colour": capture["colour"]}
        self.tables["calibrate"] = {"seed": conf["seed"], "accuracy": conf["accuracy"], **recipe, **colour}
        self.taken["calibrate"] = str(folder)

    def add_image(self, folder: Path) -> None:
        """Add the request of the image in a ``folder``, of its frames and of its calibration."""
        from mitsim.reconstruct.reconstruct import read_result

        made_of, first = _made_of(folder), _first(folder)
        if "calibration" not in made_of:
            raise MitsimError(f"{folder}: does not state which calibration it was made with")
        stated = read_result(first).get("inputs") if (first / RESULT_FILE).is_file() else {}
        stated = stated if isinstance(stated, dict) else {}
        inputs = {name: value for name, value in stated.items() if name not in made_of}
        if inputs.get("method", METHODS[0]) not in METHODS:
            method = cut(str(inputs["method"]))
            raise MitsimError(f"{folder}: was solved by {method}, a trained network, whose file is not recorded")
        if isinstance(ends := inputs.get("bounds"), list):
            infinite = -math.inf, math.inf
            inputs["bounds"] = [infinite[place % 2] if end is None else end for place, end in enumerate(ends)]
        for name, verb, add in (("run", "capture", self.add_run), ("calibration", "calibrate", self.add_calibration)):
            if self.taken.get(verb) == made_of[name]:
                continue
            try:
                if verb in self.taken:
                    raise MitsimError(f"{made_of[name]}: differs from that of the first image")
                add(Path(made_of[name]))
            except MitsimError as error:
                self.warn(f"{error}; it is read where it is")
                inputs[name] = made_of[name]
        images = self.tables.setdefault("reconstruct", [])
        named = {} if folder.name in (each.get("output") for each in images) else {"output": folder.name}
        images.append({**inputs, **named})


def _first(folder: Path) -> Path:
    return next(iter(open_lines(folder, *KINDS).parts.values()))


def _made_of(folder: Path) -> dict[str, str]:
    from mitsim.reconstruct.reconstruct import MADE_OF

    for name in (RESULT_FILE, COLOUR):
        data = read_json(folder / name) if (folder / name).is_file() else {}
        if isinstance(data, dict) and isinstance(data.get(MADE_OF), dict):
            return {str(key): str(value) for key, value in data[MADE_OF].items()}
    return {}


def _short_name(path: str | None, shelf: str) -> str | None:
    if path is None:
        return None
    own = Path(path).parent if shelf == "scenes" else Path(path)
    return own.stem if own.parent == shipped_path(shelf) else path
