"""The verb `mitsim list` prints the shipped entries of a kind; `mitsim new` writes a commented file to begin with."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import itertools
import re
import shutil
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel

from mitsim.bench.effects import DISCRETISED, EFFECTS
from mitsim.cli.commands import Common, Replaced, argument, command, to_make
from mitsim.core import configuration
from mitsim.core.errors import MitsimError, near_name
from mitsim.core.files import output_file, whole_folder, write_bytes, write_text
from mitsim.design.goal import Goal
from mitsim.devices.pattern_files import OWN
from mitsim.devices.patterns import FAMILIES
from mitsim.devices.sensor import load_sensor
from mitsim.devices.session import load_recipe
from mitsim.exchange.capture_list import CaptureList
from mitsim.learn.requests import METHODS
from mitsim.studies import EXPERIMENTS, SHARED

# ---- What is shipped -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Entry:
    """A name on a command line, its purpose ``serves``, and a description ``what`` if that is another line."""

    name: str
    serves: str
    what: str = ""


def _cameras() -> Iterator[Entry]:
    for name, path in configuration.shipped_files("calibration", ".toml", configuration.CAMERA).items():
        sensor = load_sensor(path)
        verbs = "capture, sense, characterise" if sensor.states_efficiency else "capture in colour, characterise"
        if sensor.sensor_only:
            verbs = "sensor only, to characterise"
        yield Entry(name, verbs, f"{sensor.name}, pixels of {sensor.superpixel_pitch_um:g} um")


def _masks() -> Iterator[Entry]:
    from mitsim.devices.camera import KINDS as MASKS

    return (Entry(*each) for each in MASKS.items())


def _studies() -> Iterator[Entry]:
    """Read the studies from their source, because importing all of them takes three seconds."""
    for name in EXPERIMENTS:
        tree = ast.parse(_source(f"mitsim.studies.{SHARED.get(name, f'{name}_study')}"))
        calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call) and len(node.args) > 2)
        named = next(call for call in calls if isinstance(call.args[0], ast.Constant) and call.args[0].value == name)
        yield Entry(name, ast.literal_eval(named.args[2]))


def _methods() -> Iterator[Entry]:
    """Iterate over the solver's methods and the learned ones, read from the source because torch may be missing."""
    from mitsim.reconstruct.solvers import SOLVERS

    for name, solver in SOLVERS.items():
        yield Entry(name, _clause(str(type(solver).__doc__)))
    nodes = ast.parse(_source("mitsim.learn.networks")).body
    classes = {node.name: node for node in nodes if isinstance(node, ast.ClassDef)}
    words = {name.lower(): _clause(ast.get_docstring(node) or "") for name, node in classes.items()}
    for name in METHODS:
        yield Entry(name, f"{words[name.replace('-', '')]}; to be trained")


KINDS: Mapping[str, Callable[[], Iterator[Entry]]] = {
    "scenes": lambda: (
        Entry(name, *configuration.opening_words(path)[::-1])
        for name, path in configuration.shipped_files("scenes", "scene.xml").items()
    ),
    "cameras": _cameras,
    "projectors": lambda: (
        Entry(name, configuration.opening_words(path)[1], configuration.read_toml(path)["name"])
        for name, path in configuration.shipped_files("calibration", ".toml", configuration.PROJECTOR).items()
    ),
    "masks": _masks,
    "studies": _studies,
    "effects": lambda: (
        Entry(*each) for each in {**DISCRETISED, **{name: effect.what for name, effect in EFFECTS.items()}}.items()
    ),
    "methods": _methods,
    "patterns": lambda: (
        Entry(*each)
        for each in [
            *((", ".join(each.forms), _clause(str(each.factor.__doc__))) for each in FAMILIES.values()),
            ("PATH", f"own patterns: {OWN}"),
        ]
    ),
}
"""Entries of each kind that `mitsim list` knows, as the files and modules state them."""


def _source(module: str) -> str:
    found = importlib.util.find_spec(module)
    assert found is not None and found.origin is not None, module
    return Path(found.origin).read_text(encoding="utf-8")


def _clause(text: str) -> str:
    """Return the start of a docstring, up to its first colon or full stop, as a part of a sentence."""
    first = " ".join(text.split("\n\n")[0].split()).split(": ")[0].split(". ")[0].removesuffix(".")
    return first[0].lower() + first[1:] if first[1:2].islower() or first[1:2] == " " else first


class Listing(Common):
    """Options of `mitsim list`."""

    kind: str | None = argument(None, f"{', '.join(KINDS)}; or a scene", "[KIND|SCENE]", complete=lambda: KINDS)


@command
def list_(asked: Listing) -> int:
    """List scenes, devices, studies and methods, or a scene's parameters.

    $ mitsim list scenes
    $ mitsim list lamp_bench
    $ mitsim list cameras --json
    """
    kind = asked.kind
    if kind is not None and is_scene(kind):
        return list_parameters(kind, asked)
    if kind is not None and kind not in KINDS:
        raise MitsimError(f"list {kind}: no such kind; {near_name(kind, KINDS)}use {', '.join(KINDS)}, or a scene")
    return _print_entries({name: [*entries()] for name, entries in KINDS.items() if kind in (None, name)}, asked)


def is_scene(name: str) -> bool:
    """Return True for a scene's file or folder, and for the name of a shipped scene if there is no such folder."""
    shipped = name in configuration.shipped_files("scenes", "scene.xml") and not Path(name).exists()
    return shipped or name.endswith(".xml") or (Path(name) / "scene.xml").is_file()


def list_parameters(scene: str, asked: Common) -> int:
    """Print the parameters of a ``scene`` for -D, with default, unit and meaning."""
    path = configuration.locate(scene, "scenes", "scene.xml")
    return _print_entries({"parameters": [Entry(*each) for each in configuration.scene_parameters(path)]}, asked)


def _print_entries(found: Mapping[str, Sequence[Entry]], asked: Common) -> int:
    lines, kind = list[str](), len(found) == 1
    for name, entries in found.items():
        lines += [] if kind else [*([""] if lines else []), f"{name}:"]
        indent = 0 if kind else 2
        first = max((len(each.name) for each in entries), default=0) + indent + 2
        width = max(shutil.get_terminal_size().columns, first + 20)
        for each in entries:
            text = each.serves if not each.what or each.what.endswith(".") else f"{each.what}: {each.serves}"
            line = f"{'':{indent}}{each.name}".ljust(first) + text
            lines += textwrap.wrap(line, width, subsequent_indent=" " * first, break_on_hyphens=False)
        lines += ["", "Parameters of a scene, with units: mitsim list NAME"] if name == "scenes" else []
    return asked.finish({name: [asdict(each) for each in entries] for name, entries in found.items()}, lines)


# ---- Files to begin with ---------------------------------------------------------------------------------------------

_MASKS: dict[str, dict[str, Any]] = {
    **{kind: {"order": 9} for kind in ("separable", "flatcam", "open")},
    **{kind: {"features": 127} for kind in ("mura", "random")},
    "drawing": {"file": "mask.png"},
    "psf": {"file": "psf.png", "psf_distance_mm": 400.0, "aperture_mm2": 1.0},
}
"""Fields that masks of each kind begin with: features as fine and about as many as those of the shipped scenes, or a
picture beside the file."""
_MASK = {"feature_mm": 0.06, "distance_mm": 2.0}
"""Side of a feature, and distance, of the shipped scenes' mask."""
_HEAD = (
    '# Use it in a command as --{field} {path}, in a session file as {field} = "{path}" in the table [scene],',
    '# in Python as mitsim.open_bench("photograph", {field}="{path}"). The scene states the place of the {field}.',
)
"""Places that take a device, for the file of a ``field`` at a ``path``."""
_MORE = "# Further fields are in docs/device_files.md.", ""
_CAPTURE = "mitsim capture photograph -o run --patterns dots:7 --camera {}"


@dataclass(frozen=True)
class _Starter:
    """A kind of file to begin with.

    ``use`` is the command that takes the file {}, ``like`` the shipped file that it begins as unless another is asked
    for (empty: none), and ``field`` what such shipped files are known by.
    """

    use: str
    like: str = ""
    field: str = ""


_STARTERS = {
    "camera": _Starter(_CAPTURE, configuration.DEFAULT_CAMERA, configuration.CAMERA),
    "projector": _Starter("mitsim plan photograph --projector {}", "mp_cl1", configuration.PROJECTOR),
    "scene": _Starter("mitsim plan {}/scene.xml", "photograph"),
    "mask": _Starter(_CAPTURE, configuration.DEFAULT_CAMERA, configuration.CAMERA),
    "recipe": _Starter("mitsim calibrate photograph -o cal --recipe {}", "session", configuration.RECIPE),
    "session": _Starter("mitsim run {} -o session-output", "demo"),
    "study": _Starter("mitsim study {} -o study --quick"),
    "goal": _Starter("mitsim design {} -o design"),
    "list": _Starter("mitsim import FRAMES -o run --list {} --camera NAME --exposure SECONDS"),
}


def _shipped(kind: str) -> Mapping[str, Path]:
    if field := _STARTERS[kind].field:
        return configuration.shipped_files("calibration", ".toml", field)
    if kind == "scene":
        return configuration.shipped_files("scenes", "scene.xml")
    return configuration.shipped_files("sessions", ".toml")


def _lines(kind: str, name: str, like: Path, mask: str) -> Iterator[str]:
    """Iterate over the lines of a file of a ``kind``, as the shipped file ``like``; a mask is of the kind ``mask``."""
    from mitsim.devices.camera import MaskProfile
    from mitsim.devices.projector import ProjectorModel

    def begun(model: BaseModel, **more: str) -> Iterator[str]:
        source = f"as the shipped {like.stem}, to be replaced"
        return starter(type(model), {**model.model_dump(exclude_unset=True), **more, "source": source})

    if kind in ("camera", "mask"):
        yield from begun(load_sensor(like), name=name)
    if kind == "mask":
        yield ""
        yield from starter(MaskProfile, {"kind": mask, **_MASK, **_MASKS[mask]}, "mask")
    elif kind == "projector":
        yield from begun(configuration.load_model(like, ProjectorModel), name=name)
    elif kind == "recipe":
        yield from begun(load_recipe(like))
    elif kind == "session":
        yield from like.read_text(encoding="utf-8").splitlines()[1:]
    elif kind == "list":  # what `mitsim import` needs beside a camera and an exposure
        yield from starter(CaptureList, {"patterns": "dots:7", "n": 128})
    elif kind == "goal":
        begun_goal = Goal(scene="photograph", exposure_total_s=4.0, mask_distance_mm=(2.0,)).model_dump(mode="json")
        yield from starter(Goal, {name: value for name, value in begun_goal.items() if value not in (None, [])})
    elif kind == "study":
        yield _source("mitsim.studies.starter_study").replace('"starter"', f'"{name}"').rstrip()


class Beginning(Replaced, Common):
    """Options of `mitsim new`."""

    MARKS = ("scene.xml",)

    kind: str = argument(..., ", ".join(_STARTERS), "KIND", complete=lambda: _STARTERS)
    name: str = argument(..., "name of letters, digits, - and _ that begins with a letter", "NAME")
    output: Path | None = to_make(None, "file to write, or folder for a scene; by default named after NAME", "PATH")
    like: str | None = configuration.option(
        None,
        "shipped file to copy from; for a mask also a kind of masks (`mitsim list masks`)",
        metavar="NAME",
        show_default="imx249, mp_cl1, photograph, session, demo",
        panel=configuration.WHAT,
        complete=lambda: dict.fromkeys(
            name for kind, each in _STARTERS.items() if each.like for name in [*_shipped(kind), *_MASKS]
        ),
    )

    @property
    def places(self) -> list[Path]:
        return [self.output or Path(self.name)]


@command
def new(asked: Beginning) -> int:
    """Write a commented, valid file to start from.

    A mask is a camera file with a table [mask]. A recipe is for `mitsim calibrate --recipe`, a list for
    `mitsim import --list`.

    $ mitsim new camera mine
    $ mitsim new scene bench --like cookie_bag
    $ mitsim new mask noise --like random
    $ mitsim new study tilt -o studies/tilt.py
    """
    kind, name, like = asked.kind, asked.name, asked.like
    if kind not in _STARTERS:
        raise MitsimError(f"new {kind}: no such kind; {near_name(kind, _STARTERS)}use {', '.join(_STARTERS)}")
    if not re.fullmatch(r"[A-Za-z][\w-]*", name):
        raise MitsimError(f"new {kind} {name!r}: give a name of letters, digits, - and _ that begins with a letter")
    begin = _STARTERS[kind]
    if not begin.like:
        asked.refuse(["like"], f"on a {kind}, of which there is one to begin with")
    ending = {"study": ".py", "scene": ""}.get(kind, ".toml")
    output = asked.output or Path(f"{name}{ending}")
    if output.suffix != ending and ending:
        raise MitsimError(f"--output {output}: a {kind} is a file that ends in {ending}; give such a name")
    known = _shipped(kind) if begin.like else {"": Path()}
    masks = _MASKS if kind == "mask" else ()
    source = known.get(begin.like if like is None or like in masks else like)
    if source is None:
        names = [*masks, *known]
        raise MitsimError(f"--like {like}: is no shipped {kind}; {near_name(str(like), names)}give {', '.join(names)}")
    use = begin.use.format(output)
    if begin.field == configuration.CAMERA and not load_sensor(source).states_efficiency:
        use = f"mitsim characterise {output} -o figures"
    if kind == "scene":
        with whole_folder(output) as folder:
            shutil.copytree(source.parent, folder, dirs_exist_ok=True)
    else:
        field = {"mask": "camera"}.get(kind, kind)
        places = [line.format(field=field, path=output) for line in _HEAD if field in ("camera", "projector")]
        head = [f"# {kind.capitalize()} {name}. For example: {use}", *places, *([] if kind == "session" else _MORE)]
        lines = _lines(kind, name, source, like if like is not None and like in masks else "separable")
        text = "\n".join([*(head if ending == ".toml" else []), *lines]) + "\n"
        with output_file(output, asked.overwrite) as place:
            write_text(place, text)
    said = [f"{kind.capitalize()} {name}: {output}", f"Try: {use}"]
    if like in ("drawing", "psf") and not (picture := output.parent / _MASKS[like]["file"]).exists():
        said.insert(1, f"{picture} is missing: put your picture of the light of one point there")
        if like == "drawing":
            from mitsim.core.images import png
            from mitsim.devices.mask import mls_code

            code = mls_code(9)
            write_bytes(picture, png(code[:, None] * code))
            said[1] = f"{picture} is an example: replace it by your drawing, in grey"
    payload = {"kind": kind, "name": name, "output": str(output), "use": use}
    return asked.finish(payload, said)


# ---- Fields of a file, explained -------------------------------------------------------------------------------------


def meanings(model: type[BaseModel]) -> dict[str, str]:
    """Return the meaning of each field of a ``model``: the first paragraph of the docstring below the field."""
    found: dict[str, str] = {}
    for base in reversed([one for one in model.__mro__ if issubclass(one, BaseModel) and one.model_fields]):
        (written,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        for field, below in itertools.pairwise(getattr(written, "body", [])):
            text = getattr(getattr(below, "value", None), "value", None)
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(text, str):
                text = " ".join(text.split("\n\n")[0].split()).removesuffix(".")
                plain = len(text) > 1 and (text[1].islower() or text[1] == " ")
                found[ast.unparse(field.target)] = text[0].lower() + text[1:] if plain else text
    return found


def starter(model: type[BaseModel], values: Mapping[str, Any], table: str = "") -> Iterator[str]:
    """Iterate over the lines of a file with a ``model``'s ``values``, each below its meaning.

    ``table`` is the name of the table that the fields are in; empty for none.
    """
    known = meanings(model)
    if table:
        yield f"[{table}]"
    for name, value in sorted(values.items(), key=lambda each: isinstance(each[1], Mapping)):
        text = f"{known[name][0].upper()}{known[name][1:]}."
        comment = textwrap.wrap(text, 100, initial_indent="# ", subsequent_indent="# ")
        if isinstance(value, Mapping):
            kinds = [model.model_fields[name].annotation, *get_args(model.model_fields[name].annotation)]
            part = next(kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel))
            yield from ("", *comment, *starter(part, value, f"{table}.{name}".removeprefix(".")))
        else:
            yield from (*comment, f"{name} = {configuration.toml_value(value)}")
