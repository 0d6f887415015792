"""`mitsim list` and `mitsim new`: the name of a kind in; what there is of it, or a file to begin with, out."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import itertools
import re
import shutil
import textwrap
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from mitsim.cli.commands import Common, completing, verb
from mitsim.cli.screen import finish
from mitsim.core.configuration import (
    CAMERA,
    DEFAULT_CAMERA,
    PROJECTOR,
    RECIPE,
    WHAT,
    load_model,
    opening_words,
    read_toml,
    refuse_unused,
    shipped_files,
    toml_value,
)
from mitsim.core.errors import MitsimError, near_name

# ---- What is shipped -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Entry:
    """One thing that a command line may name.

    Attributes
    ----------
    name
        as it is typed.
    serves
        what it is for, in a line.
    what
        it is, where that is another line.
    """

    name: str
    serves: str
    what: str = ""


def _scenes() -> Iterator[Entry]:
    for name, path in shipped_files("scenes", "scene.xml").items():
        what, serves = opening_words(path)
        yield Entry(name, serves, what)


def _cameras() -> Iterator[Entry]:
    from mitsim.devices.sensor import load_sensor

    for name, path in shipped_files("calibration", ".toml", CAMERA).items():
        sensor = load_sensor(path)
        verbs = "capture, sense, characterise" if sensor.states_efficiency else "capture in colour, characterise"
        if sensor.sensor_only:
            verbs = "sensor only, to characterise; its quantum efficiency is not known"
        yield Entry(name, verbs, f"{sensor.name}, pixels of {sensor.superpixel_pitch_um:g} um")


def _projectors() -> Iterator[Entry]:
    for name, path in shipped_files("calibration", ".toml", PROJECTOR).items():
        yield Entry(name, opening_words(path)[1], read_toml(path)["name"])


def _masks() -> Iterator[Entry]:
    from mitsim.devices.mask_profile import KINDS as MASKS

    yield from (Entry(name, what) for name, what in MASKS.items())


def _studies() -> Iterator[Entry]:
    """Read the studies from their source, because importing all of them takes three seconds."""
    from mitsim.studies import EXPERIMENTS, SHARED, STUDIES

    for name in EXPERIMENTS:
        tree = _source(f"mitsim.studies.{SHARED.get(name, f'{name}_study')}")
        calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call) and len(node.args) > 2)
        named = next(call for call in calls if isinstance(call.args[0], ast.Constant) and call.args[0].value == name)
        yield Entry(name, ast.literal_eval(named.args[2]))
    for name in STUDIES:
        yield Entry(name, _first_line(_source(f"mitsim.studies.{name}_study")).partition("`: ")[2].removesuffix("."))


def _effects() -> Iterator[Entry]:
    from mitsim.bench.effects import DISCRETISED, EFFECTS

    yield from (Entry(name, what) for name, what in DISCRETISED.items())
    yield from (Entry(name, effect.what) for name, effect in EFFECTS.items())


def _methods() -> Iterator[Entry]:
    """Iterate over the solver's methods and the learned ones, read from the source because torch may be missing."""
    from mitsim.learn.requests import METHODS
    from mitsim.reconstruct.solvers import SOLVERS

    for name, solver in SOLVERS.items():
        yield Entry(name, _clause(str(type(solver).__doc__)))
    classes = {node.name: node for node in _source("mitsim.learn.methods").body if isinstance(node, ast.ClassDef)}
    words = {name.lower(): _clause(_first_line(node)) for name, node in classes.items()}
    for name in METHODS:
        yield Entry(name, f"{words[name.replace('-', '')]}; to be trained")


def _patterns() -> Iterator[Entry]:
    from mitsim.devices.patterns import FAMILIES

    for family in FAMILIES.values():
        yield Entry(", ".join(family.forms), _clause(str(family.factor.__doc__)))


KINDS: Mapping[str, Callable[[], Iterator[Entry]]] = {
    "scenes": _scenes,
    "cameras": _cameras,
    "projectors": _projectors,
    "masks": _masks,
    "studies": _studies,
    "effects": _effects,
    "methods": _methods,
    "patterns": _patterns,
}
"""What `mitsim list` knows: of each kind all that there is, as the files and modules say that have it."""


def _source(module: str) -> ast.Module:
    found = importlib.util.find_spec(module)
    assert found is not None and found.origin is not None, module
    return ast.parse(Path(found.origin).read_text(encoding="utf-8"))


def _first_line(node: ast.Module | ast.ClassDef) -> str:
    return " ".join((ast.get_docstring(node) or "").partition("\n\n")[0].split())


def _clause(text: str) -> str:
    """Return the start of a docstring, up to its first colon or full stop, as a part of a sentence."""
    first = " ".join(text.split("\n\n")[0].split()).split(": ")[0].split(". ")[0].removesuffix(".")
    return first[0].lower() + first[1:] if first[1:2].islower() or first[1:2] == " " else first


@verb
def list_(
    *,
    kind: Annotated[
        str | None,
        typer.Argument(
            help=f"{', '.join(KINDS)}; all if not given", metavar="[KIND]", autocompletion=completing(lambda: KINDS)
        ),
    ] = None,
    common: Common,
) -> int:
    """Scenes, devices, studies, effects, methods: what each is for.

    $ mitsim list scenes
    $ mitsim list cameras --json
    """
    if kind is not None and kind not in KINDS:
        raise MitsimError(f"list {kind}: no such kind; {near_name(kind, KINDS)}use {', '.join(KINDS)}")
    found = {name: [*entries()] for name, entries in KINDS.items() if kind in (None, name)}
    lines: list[str] = []
    for name, entries in found.items():
        lines += [] if kind else [*([""] if lines else []), f"{name}:"]
        lines += _rows(entries, 0 if kind else 2)
    return finish(
        common.as_json, {name: [asdict(each) for each in entries] for name, entries in found.items()}, lines, ()
    )


def _rows(entries: list[Entry], indent: int) -> Iterator[str]:
    """Iterate over the lines of ``entries``: names, and what each is for, wrapped to the terminal."""
    first = max(len(each.name) for each in entries) + indent + 2
    width = max(shutil.get_terminal_size().columns, first + 20)
    for each in entries:
        text = each.serves if not each.what or each.what.endswith(".") else f"{each.what}: {each.serves}"
        name = f"{'':{indent}}{each.name}".ljust(first)
        yield from textwrap.wrap(name + text, width, subsequent_indent=" " * first, break_on_hyphens=False)


# ---- Files to begin with ---------------------------------------------------------------------------------------------

_NAME = re.compile(r"[A-Za-z][\w-]*")
_MASKS: dict[str, dict[str, Any]] = {
    "separable": {"order": 9},
    "flatcam": {"order": 9},
    "open": {"order": 9},
    "mura": {"features": 127},
    "random": {"features": 127},
    "drawing": {"file": "mask.png"},
    "psf": {"file": "psf.png", "psf_distance_mm": 400.0, "aperture_mm2": 1.0},
}
"""What masks of each kind begin with: features as fine and about as many as those of the shipped scenes, or a picture
beside the file."""
_FEATURE_MM = 0.06
"""Side of a feature of the shipped scenes' mask."""
_HEAD = "# To set a field after a #, take the # away, and that of its table; what it says is its default.", ""
_LIST = {"patterns": "dots:7", "n": 128}
"""What `mitsim import` needs beside a camera and an exposure."""


@dataclass(frozen=True)
class _Starter:
    """What a kind begins with.

    Attributes
    ----------
    use
        command that takes the file {}.
    lines
        of the file, from its name and the path of the shipped one that it is like; None: a folder, a copy.
    like
        name of that one, unless another is asked for; empty: there is none.
    field
        by which shipped files of the kind are known, on the shelf that they share.
    """

    use: str
    lines: Callable[[str, Path], Iterator[str]] | None
    like: str = ""
    field: str = ""

    def files(self) -> Mapping[str, Path]:
        """Files that one may be like, by name."""
        if self.field:
            return shipped_files("calibration", ".toml", self.field)
        return shipped_files("scenes", "scene.xml") if self.lines is None else shipped_files("sessions", ".toml")


def _camera(name: str, like: Path) -> Iterator[str]:
    from mitsim.devices.sensor import SensorModel, load_sensor

    return starter(SensorModel, _begun_as(like, load_sensor(like), name=name))


def _mask(name: str, like: Path, kind: str = "separable") -> Iterator[str]:
    from mitsim.devices.mask_profile import MaskProfile

    yield from _camera(name, like)
    yield ""
    yield from starter(MaskProfile, {"kind": kind, "feature_mm": _FEATURE_MM, **_MASKS[kind]}, "mask")


def _projector(name: str, like: Path) -> Iterator[str]:
    from mitsim.devices.projector import ProjectorModel

    return starter(ProjectorModel, _begun_as(like, load_model(like, ProjectorModel), name=name))


def _session(_: str, like: Path) -> Iterator[str]:
    yield from like.read_text(encoding="utf-8").splitlines()[1:]


def _recipe(_: str, like: Path) -> Iterator[str]:
    from mitsim.devices.session import SessionRecipe, load_recipe

    return starter(SessionRecipe, _begun_as(like, load_recipe(like)))


def _list(_: str, __: Path) -> Iterator[str]:
    from mitsim.exchange.capture_list import CaptureList

    return starter(CaptureList, _LIST)


def _study(name: str, _: Path) -> Iterator[str]:
    found = importlib.util.find_spec("mitsim.studies.starter_study")
    assert found is not None and found.origin is not None
    yield Path(found.origin).read_text(encoding="utf-8").replace('"starter"', f'"{name}"').rstrip()


def _begun_as(like: Path, model: BaseModel, **more: str) -> dict[str, Any]:
    """Return the fields that the file ``like`` of a ``model`` sets, and ``more``."""
    return {**model.model_dump(exclude_unset=True), **more, "source": f"as the shipped {like.stem}, to be replaced"}


def _captures(like: Path) -> bool:
    """Return True if the camera of the file ``like`` states its quantum efficiency."""
    from mitsim.devices.sensor import load_sensor

    return load_sensor(like).states_efficiency


_CAPTURE = "mitsim capture photograph -o run --patterns dots:7 --camera {}"
_STARTERS = {
    "camera": _Starter(_CAPTURE, _camera, DEFAULT_CAMERA, CAMERA),
    "projector": _Starter("mitsim plan photograph --projector {}", _projector, "mp_cl1", PROJECTOR),
    "scene": _Starter("mitsim plan {}/scene.xml", None, "photograph"),
    "mask": _Starter(_CAPTURE, _mask, DEFAULT_CAMERA, CAMERA),
    "recipe": _Starter("mitsim calibrate photograph -o cal --recipe {}", _recipe, "session", RECIPE),
    "session": _Starter("mitsim run {} -o session-output", _session, "demo"),
    "study": _Starter("mitsim study {} -o study --quick", _study),
    "list": _Starter("mitsim import FRAMES -o run --list {} --camera NAME --exposure SECONDS", _list),
}


@verb
def new(
    *,
    kind: Annotated[
        str,
        typer.Argument(help=", ".join(_STARTERS), metavar="KIND", autocompletion=completing(lambda: _STARTERS)),
    ],
    name: Annotated[str, typer.Argument(help="letters, digits, - and _, a letter first", metavar="NAME")],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", help="file to make, of a scene a folder; named after NAME if not given", metavar="PATH"
        ),
    ] = None,
    like: Annotated[
        str | None,
        typer.Option(
            help="shipped one that it begins as; of a mask also its kind",
            metavar="NAME",
            show_default="imx249, mp_cl1, photograph, session, demo",
            rich_help_panel=WHAT,
            autocompletion=completing(
                lambda: {name: None for each in _STARTERS.values() if each.like for name in [*each.files(), *_MASKS]}
            ),
        ),
    ] = None,
    common: Common,
    given: set[str],
) -> int:
    """A file to begin with: commented, whole, valid as it is.

    Each field says what it is and what it may be. A mask is a camera file with a table [mask], a recipe is of
    calibrate --recipe, a list is of import --list.

    $ mitsim new camera mine
    $ mitsim new scene bench --like cookie_bag
    $ mitsim new mask noise --like random
    $ mitsim new study tilt -o studies/tilt.py
    """
    from mitsim.core.files import output_file, whole_folder, write_text

    if kind not in _STARTERS:
        raise MitsimError(f"new {kind}: no such kind; {near_name(kind, _STARTERS)}use {', '.join(_STARTERS)}")
    if not _NAME.fullmatch(name):
        raise MitsimError(f"new {kind} {name!r}: give a name of letters, digits, - and _ that begins with a letter")
    begin = _STARTERS[kind]
    if not begin.like:
        refuse_unused(given, ["like"], f"on a {kind}, of which there is one to begin with")
    ending = ".py" if kind == "study" else "" if begin.lines is None else ".toml"
    output = output or Path(f"{name}{ending}")
    if output.suffix != ending and ending:
        raise MitsimError(f"--output {output}: a {kind} is a file that ends in {ending}; give such a name")
    known = begin.files() if begin.like else {"": Path()}
    masks = _MASKS if kind == "mask" else ()
    source = known.get(begin.like if like is None or like in masks else like)
    if source is None:
        names = [*masks, *known]
        raise MitsimError(f"--like {like}: is no shipped {kind}; {near_name(str(like), names)}give {', '.join(names)}")
    use = begin.use.format(output)
    if begin.field == CAMERA and not _captures(source):
        use = f"mitsim characterise {output} -o figures"
    if begin.lines is None:
        with whole_folder(output) as folder:
            shutil.copytree(source.parent, folder, dirs_exist_ok=True)
    else:
        head = (
            [f"# {kind.capitalize()} {name}, for: {use}", *([] if kind == "session" else _HEAD)]
            if ending == ".toml"
            else []
        )
        lines = _mask(name, source, like) if like is not None and like in masks else begin.lines(name, source)
        text = "\n".join([*head, *lines]) + "\n"
        with output_file(output) as place:
            write_text(place, text)
    payload = {"kind": kind, "name": name, "output": str(output), "use": use}
    return finish(common.as_json, payload, [f"{kind.capitalize()} {name}: {output}", f"Try: {use}"], ())


# ---- what fields of a file are ---------------------------------------------------------------------------------------

_PLAIN = {"string": "text", "boolean": "true or false", "integer": "whole number", "number": "number"}
_WIDTH = 100
"""Columns of a comment: chosen, so that a file fits beside its neighbour on a screen."""


def meanings(model: type[BaseModel]) -> dict[str, str]:
    """Return the meaning of each field of a ``model``: the first paragraph of the docstring below the field. Without
    the source it is empty."""
    found: dict[str, str] = {}
    for base in reversed([one for one in model.__mro__ if issubclass(one, BaseModel) and one.model_fields]):
        try:
            (written,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        except (OSError, TypeError, SyntaxError):
            continue
        body = getattr(written, "body", [])
        for field, below in itertools.pairwise(body):
            text = getattr(getattr(below, "value", None), "value", None)
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(text, str):
                text = " ".join(text.split("\n\n")[0].split()).removesuffix(".")
                plain = len(text) > 1 and (text[1].islower() or text[1] == " ")
                found[ast.unparse(field.target)] = text[0].lower() + text[1:] if plain else text
    return found


def default_text(value: object) -> str:
    """Return a field's default ``value`` in words."""
    if value is None or value in ({}, (), "") or isinstance(value, BaseModel):
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    return "infinite" if value == float("inf") else f"{value:g}" if isinstance(value, float) else str(value)


def allowed_text(rules: Mapping[str, Any]) -> str:
    """Return the values that a field may have, from the ``rules`` of its JSON schema."""
    if "anyOf" in rules:
        choices = rules["anyOf"]
        return ", ".join("null" if choice.get("type") == "null" else allowed_text(choice) for choice in choices)
    if "const" in rules or "enum" in rules:
        return ", ".join(f"`{value}`" for value in rules.get("enum", [rules.get("const")]))
    if "$ref" in rules or rules.get("type") == "object":
        return "object"
    if "prefixItems" in rules:
        return f"list of {len(rules['prefixItems'])}: {allowed_text(rules['prefixItems'][0])}"
    if rules.get("type") == "array":
        length = f", at most {rules['maxItems']}" if "maxItems" in rules else ""
        return f"list: {allowed_text(rules['items'])}{length}"
    if "pattern" in rules:
        words = re.fullmatch(r"\^\(([\w|]+)\)\$", rules["pattern"])
        return ", ".join(f"`{word}`" for word in words[1].split("|")) if words else "text without / and \\"
    least, above = rules.get("minimum"), rules.get("exclusiveMinimum")
    most, below = rules.get("maximum"), rules.get("exclusiveMaximum")
    start = f"{least:g}" if least is not None else f"above {above:g}" if above is not None else ""
    end = f"{most:g}" if most is not None else f"below {below:g}" if below is not None else ""
    if start and end:
        return start if start == end else f"{start} to {end}"
    kind = _PLAIN.get(rules.get("type", ""), "anything")
    return f"{kind}, at least {start}" if least is not None else f"{kind}, {start}" if start else kind


def starter(model: type[BaseModel], values: Mapping[str, Any], table: str = "") -> Iterator[str]:
    """Iterate over the lines of a file of a ``model``, which explain every field; fields without a value follow a #.

    Parameters
    ----------
    model
        of the file.
    values
        fields that are set; they make the file whole.
    table
        name of the table that the fields are in; empty: of none.
    """
    parts = {name: _model_of(field.annotation) for name, field in model.model_fields.items()}
    schema, known = model.model_json_schema()["properties"], meanings(model)
    if table:
        yield f"{'' if values else '#'}[{table}]"
    plain = [name for name, part in parts.items() if part is None]
    given = [name for name in plain if name in values]
    for name in (*given, *(name for name in plain if name not in values)):
        if given and name not in values:
            yield from ("", *_comment("Further fields."))
            given = []
        allowed = allowed_text(schema[name]).replace("`", "").removesuffix(", null")
        default = model.model_fields[name].default
        lacks = default is PydanticUndefined or default_text(default) in ("none", "infinite")
        yield from _comment(f"{known[name]}. Allowed: {allowed}.")
        shown = "..." if lacks else toml_value(default)
        yield f"{name} = {toml_value(values[name])}" if name in values else f"#{name} = {shown}"
    for name, part in parts.items():
        if part is not None:
            yield from ("", *_comment(f"{known[name]}."))
            yield from starter(part, values.get(name) or {}, f"{table}.{name}".removeprefix("."))


def _comment(text: str) -> list[str]:
    text = text[0].upper() + text[1:] if text[1].islower() or text[1] == " " else text
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ", break_long_words=False)


def _model_of(kind: Any) -> type[BaseModel] | None:
    """Return the model of a table, if a field of a ``kind`` is one; None for other fields and for lists of tables."""
    kinds = [kind, *get_args(kind)]
    found = (each for each in kinds if isinstance(each, type) and issubclass(each, BaseModel))
    return next(found, None)
