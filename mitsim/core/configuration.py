"""TOML files as checked pydantic models, models of options, and the shipped files."""

from __future__ import annotations

import functools
import inspect
import os
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, ParamSpec, TypeVar, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from mitsim.core import errors
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, cut, near_name, short_text
from mitsim.core.files import BYTE_ORDER_MARK, read_json, read_text

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_MOST_BYTES = 1 << 16
_MOST_DOTS = 200
"""The parser takes 0.1 s for a dotted name of that many parts."""
DEFAULT_CAMERA = "imx249"
"""The paper's camera."""
_SERVES = "Serves: "
"""Introduces the purpose of a shipped file in its first comment."""
Model = TypeVar("Model", bound=BaseModel)
LARGEST = 1e12
"""Largest number of a device, and inverse of the smallest, so that products of a few stay finite."""
Positive = Annotated[float, Field(ge=1 / LARGEST, le=LARGEST, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST, allow_inf_nan=False)]


class Configuration(BaseModel):
    """Frozen model of finite numbers with exact types and no further fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, defer_build=True)


# ---- Mistakes in files -----------------------------------------------------------------------------------------------

_MOST_MISTAKES = 20
Place = tuple[str | int, ...]
"""Keys and list indices that lead to a part of nested data."""


def refusal(model: type[BaseModel], error: ValidationError, where: str, data: Any = None) -> MitsimError:
    """Convert pydantic's ``error``: one sentence for each place, misspelt names first."""
    found, meant = dict[Place, str](), set[Place]()
    for one in sorted(error.errors(include_url=False), key=lambda one: one["type"] != "extra_forbidden"):
        place, kind, value = one["loc"], one["type"], short_text(one["input"], 100)
        holder = data
        for end, part in enumerate(place if kind not in ("missing", "extra_forbidden") else ()):
            try:
                holder = holder[part]
            except (KeyError, IndexError, TypeError):  # the name of a union's alternative
                place = place[:end] or place
                break
        fields = model.model_fields
        for name in place[:-1]:
            if isinstance(name, str) and name in fields:
                kinds = [fields[name].annotation]
                for each in kinds:  # grows, because a part may be in a tuple, or optional
                    kinds += get_args(each)
                parts = (each for each in kinds if isinstance(each, type) and issubclass(each, BaseModel))
                fields = getattr(next(parts, None), "model_fields", {})
        if kind == "value_error":  # a validator of ours, whose message has the value
            text = str(one["ctx"]["error"])
        elif kind == "missing":
            if place in meant:  # a misspelt name is both unknown and missing
                continue
            text = "is missing"
        elif kind == "extra_forbidden":
            text = f"got {value}, no such field; {known_names(str(place[-1]), fields) if fields else 'remove it'}"
            meant |= {(*place[:-1], name) for name in fields if f"did you mean {name}?" in text}
        else:
            text = f"got {value}; {rule_of(one['msg'], fields.get(str(place[-1]) if place else ''))}"
        name = ".".join(cut(str(part)) for part in place)
        found.setdefault(place, f"{name}: {text}" if name else text if kind == "value_error" else f"contents: {text}")
    return refuse_together(where, [*found.values()])


def refuse_together(where: str, mistakes: Sequence[str]) -> MitsimError:
    if len(mistakes) == 1:
        return MitsimError(f"{where}: {mistakes[0]}")
    more = [f"and {len(mistakes) - _MOST_MISTAKES} more"] if len(mistakes) > _MOST_MISTAKES else []
    return MitsimError(f"{where}: has {len(mistakes)} mistakes:", *mistakes[:_MOST_MISTAKES], *more)


def known_names(name: str, known: Iterable[str], word: str = "known fields:") -> str:
    """Return the nearest of the ``known`` names as a question, or all of them after a ``word``."""
    return near_name(name, known).strip() or f"{word} {', '.join(known)}"


_PLAINER = {"a valid integer": "a whole number", "a valid string": "text", "a valid boolean": "true or false"}


def rule_of(message: str, field: FieldInfo | None = None) -> str:
    """Return the rule in pydantic's ``message`` as a command, with both limits of a ``field``."""
    if "pattern '^[^/" in message:
        return "give a name without folders"
    if not message.startswith("Input should be "):
        return message[0].lower() + message[1:]
    words = re.split(", (?:got|unable)", message.removeprefix("Input should be "))[0]
    limits, crossed = limits_of(field) if field else "", words.startswith(("greater", "less"))
    kind = f"a number{'' if limits else f' {words}'}" if crossed else _PLAINER.get(words, words.replace(" valid ", " "))
    return f"give {kind} {limits}".rstrip()


# ---- Reading files ---------------------------------------------------------------------------------------------------


def shipped_path(*parts: str) -> Path:
    """Return the path of a shipped file, inside the package of a wheel or beside it in a source tree."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "_shipped"
    path = (inside if inside.is_dir() else package.parent).joinpath(*parts)
    if not path.exists():
        raise MitsimError(f"{'/'.join(parts)}: not found at {path}; install mitsim again")
    return path


def read_toml(path: Path | str, most: int = _MOST_BYTES) -> dict[str, Any]:
    try:
        text = read_text(path, most).removeprefix(BYTE_ORDER_MARK)
        # The parser's time grows with the square of the parts of a dotted name. Numbers of a list have dots, too.
        lines = (line.split(",") if not {'"', "'"} & {*line} else [line] for line in text.splitlines())
        if any(part.count(".") > _MOST_DOTS for parts in lines for part in parts):
            raise ValueError(f"a line with over {_MOST_DOTS} dots")
        return tomllib.loads(text)
    except RecursionError as error:
        raise MitsimError(f"file {path}: not valid TOML (it is nested too deep); flatten it") from error
    except ValueError as error:
        raise MitsimError(f"file {path}: not valid TOML ({error}); correct that line") from error


def read_table(path: Path, what: str) -> dict[str, Any]:
    data = read_json(path) if path.suffix.lower() == ".json" else read_toml(path)
    if not isinstance(data, dict):
        raise MitsimError(f"{what} {path}: holds a {type(data).__name__}; give a table of names and values")
    return data


def load_model(path: Path | str, model: type[Model]) -> Model:
    return validate(model, read_toml(path), f"file {path}")


def validate(model: type[Model], data: dict[str, Any], where: str, context: object = None) -> Model:
    """Return ``data`` as a checked ``model``; MitsimError, beginning with ``where``, if it breaks rules."""
    try:
        return model.model_validate(data, context=context)
    except ValidationError as error:
        raise refusal(model, error, where, data) from error


CAMERA, PROJECTOR, RECIPE, LIST = "full_well_e", "effective_wavelength_nm", "board_reflectance", "patterns"
"""Required fields that identify shipped cameras, projectors, recipes and lists of known frames."""
_SHIPPED = {CAMERA: "camera", PROJECTOR: "projector", RECIPE: "recipe", LIST: "list", "chart.json": "chart"}
"""Words for shipped files of a field or an ending."""


def locate(name: Path | str, shelf: Literal["scenes", "calibration", "sessions"], ending: str, field: str = "") -> Path:
    """Return a path, or that of a shipped file by its bare name; ``./name`` is always a path.

    ``ending`` is a file inside the folder ``name``, or a suffix. MitsimError for a bare name that is neither shipped
    nor a file here; it offers shipped files that have the ``field``.
    """
    inside = not ending.startswith(".")
    text, path = str(name), Path(name)
    if (isinstance(name, str) and (os.sep in text or path.suffix)) or len(path.parts) != 1 or path.suffix:
        return path / ending if inside and path.is_dir() else path
    folder = shipped_path(shelf)
    known = folder / text / ending if inside else folder / f"{text}{ending}"
    if known.is_file() and (not field or field in read_toml(known)):
        return known
    if path.exists():
        return path / ending if inside and path.is_dir() else path
    names, kind = shipped_files(shelf, ending, field), _SHIPPED.get(field or ending, shelf.removesuffix("s"))
    raise MitsimError(
        f"{kind} {name}: no such file, and no shipped {kind} has that name; {near_name(text, names)}"
        f"shipped {kind}s are {', '.join(names)}"
    )


def shipped_files(shelf: Literal["scenes", "calibration", "sessions"], ending: str, field: str = "") -> dict[str, Path]:
    """Return paths of shipped files by name; of TOML files, those that have the ``field``."""
    if not ending.startswith("."):
        return {path.parent.name: path for path in sorted(shipped_path(shelf).glob(f"*/{ending}"))}
    files = sorted(shipped_path(shelf).glob(f"*{ending}"))
    return {path.stem: path for path in files if not field or field in read_toml(path)}


_OPENING = re.compile(r"\s*(?:<\?xml[^>]*\?>)?\s*(?:<scene[^>]*>)?\s*<!--(.*?)-->|((?:#[^\n]*\n)+)", re.DOTALL)


def opening_words(path: Path) -> tuple[str, str]:
    """Return the first sentence of a file's opening comment, and the text after "Serves:" in it."""
    opening = _OPENING.match(path.read_text(encoding="utf-8"))
    if opening is None:
        return "", ""
    text = " ".join((opening[1] or re.sub("(?m)^#", "", opening[2] or "")).split())
    # A full stop that ends a sentence precedes a capital; "0.90" and "e.g. a sheet" do not.
    sentences = re.split(r"(?<=\.) (?=[A-Z])", text)
    serves = next((each for each in sentences if each.startswith(_SERVES)), "")
    return sentences[0], serves.removeprefix(_SERVES).removesuffix(".")


_PARAMETER = re.compile(r'<default name="([^"]+)" value="([^"]*)"/>[ \t]*(?:<!-- *(.*?) *-->)?')


def scene_parameters(path: Path) -> list[tuple[str, str]]:
    """Return each parameter of a scene file as NAME=DEFAULT, with the comment on its line: its unit and meaning."""
    try:
        found = _PARAMETER.findall(read_text(path, _MOST_BYTES << 8))
    except ValueError as error:
        raise MitsimError(f"file {path}: is not UTF-8 ({error}); save it so") from error
    return [(f"{name}={value}", words) for name, value, words in found]


def toml_value(value: object) -> str:
    import tomli_w

    # In a list with a number a table is inline. Line ends are those of lists, because texts have theirs escaped.
    text = tomli_w.dumps({"": [value, 0]}).partition("\n")[2].rpartition(",\n    0,")[0].strip()
    return re.sub(r",\n\s*", ", ", re.sub(r"(?<=\[)\n\s*|,\n\s*(?=\])", "", text))


def value_of(text: str) -> Any:
    """Return the TOML value in a ``text``; the text itself if it has none."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text


# -------- Options of verbs

WHAT, QUALITY, DEVICES = "Main options", "Quality", "Scene and devices"
OUTPUT, LIMITS = "Output", "Machine and limits"
PANELS = WHAT, QUALITY, DEVICES, OUTPUT, LIMITS

P = ParamSpec("P")
R = TypeVar("R")
M = TypeVar("M", bound="Options")


def option(default: Any, help: str, *names: str, kind: Any = None, **shown: Any) -> Any:
    """Declare a field of a model of options.

    Parameters
    ----------
    default
        Default value; ``...`` for a required option.
    help
        Sentence of the help.
    names
        Spellings on the command line, if they differ from the field's name.
    kind
        Type on the command line, if it differs from the field's; False for an option of Python alone.
    shown
        Arguments of :class:`typer.Option`; ``panel``, a heading; ``complete``, which lists words; ``read``, which
        converts
        the word; and limits ``ge``, ``gt``, ``le``, ``lt``, or ``min`` and ``max`` if the help states them.
    """
    limits: Any = {name: shown.pop(name) for name in ("ge", "gt", "le", "lt") if name in shown}
    limits |= {name: shown[own] for name, own in (("ge", "min"), ("le", "max")) if own in shown}
    extra: Any = {"names": names, "kind": kind, **shown}
    return Field(default, description=help, json_schema_extra=extra, **limits)


class _Refused(ValueError):
    """MitsimError wrapped as a ValueError, so that pydantic collects it."""


def validated_by(check: Callable[[Any], Any]) -> AfterValidator:
    """Return a field validator from ``check``, which raises MitsimError and returns a new value or None."""

    def validate(value: Any) -> Any:
        try:
            result = check(value)
        except MitsimError as error:
            raise _Refused(error) from error
        return value if result is None else result

    return AfterValidator(validate)


def _can_be_path(value: Path | str) -> Path | str:
    if not errors.is_path(value):
        raise ValueError("a path")
    return value


FilePath = Annotated[Path | str, AfterValidator(_can_be_path)]


def shipped_names(field: str) -> list[str]:
    return [*shipped_files("calibration", ".toml", field)]


class Options(BaseModel):
    """Options that belong together; an invalid value raises ArgumentError, which names the option."""

    model_config = ConfigDict(
        frozen=True, strict=True, extra="forbid", arbitrary_types_allowed=True, defer_build=True, validate_default=False
    )
    PANEL: ClassVar[str] = WHAT
    """Heading of the options in the help."""
    VERB: ClassVar[str] = ""
    """Function that takes the options, as refusals name it."""

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**{name: errors.plain_number(value) for name, value in values.items()})
        except ValidationError as error:
            found, fields = dict[str, ArgumentError](), type(self).model_fields
            problems = error.errors(include_url=False)
            for one in sorted(problems, key=lambda one: one["type"] != "extra_forbidden"):
                name, wrapped = str(one["loc"][0]), one.get("ctx", {}).get("error")
                if isinstance(wrapped, _Refused):
                    (refused,) = wrapped.args
                    if not isinstance(refused, ArgumentError):
                        refused = ArgumentError(name, re.sub(f"^{name}:? ", "", str(refused)))
                    found.setdefault(name, refused)
                elif one["type"] == "extra_forbidden" and len(one["loc"]) == 1:
                    found[name] = unknown_option(name, self.VERB, fields)
                elif one["type"] == "missing":
                    found.setdefault(name, ArgumentError(name, "is missing; give it"))
                elif name not in found:
                    rules = (rule_of(each["msg"], fields[name]) for each in problems if each["loc"][0] == name)
                    rule = " or ".join(dict.fromkeys(rule.removeprefix("give ") for rule in rules))
                    found[name] = ArgumentError(name, f"{short_text(one['input'])}: give {rule}")
            first, *others = found.values()
            first.others = tuple(others)
            raise first from error

    @property
    def given(self) -> dict[str, Any]:
        """Return the options that were given explicitly."""
        return {name: getattr(self, name) for name in type(self).model_fields if name in self.model_fields_set}

    def part(self, model: type[M]) -> M:
        """Return the given options that another ``model`` shares."""
        return model(**{name: value for name, value in self.given.items() if name in model.model_fields})

    def refuse(self, names: Iterable[str], where: str) -> None:
        """Refuse given options that have no effect under the condition ``where``."""
        for name in names:
            if name in self.model_fields_set:
                raise ArgumentError(name, f"has no effect {where}; leave it out")


class Styled(Options):
    """Style of figures."""

    PANEL = OUTPUT

    style: Literal["screen", "paper"] = option(
        "screen",
        "sizes of the figures: screen, or paper (89 or 183 mm wide, letters of 8 pt, thin lines)",
        metavar="screen|paper",
        complete=lambda: ("screen", "paper"),
    )


class Drawn(Styled):
    """Options of a drawing."""

    VERB = "plot"

    output: FilePath | None = option(None, "files to write, without ending: a PNG, an SVG and a PDF of the figure")


def limits_of(field: FieldInfo) -> str:
    names, marks, kinds = ("ge", "gt", "le", "lt"), [*field.metadata], [field.annotation]
    for kind in kinds:  # grows, because a number may be optional, or one of several
        kinds += get_args(kind)
        marks += kind.metadata if isinstance(kind, FieldInfo) else []
    found = {name: getattr(mark, name) for mark in marks for name in names if hasattr(mark, name)}
    ends = {name: f"{end:g}" if isinstance(end, float) else str(end) for name, end in found.items()}
    if {"ge", "le"} <= ends.keys():
        return f"from {ends['ge']} to {ends['le']}"
    words = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
    return ", ".join(f"{words[name]} {end}" for name, end in ends.items())


def takes(*models: type[Options], without: str = "") -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Add the fields of ``models``, except those listed in ``without``, as keywords of a function with ``**options``.

    Other arguments are checked as in :func:`mitsim.core.errors.check_arguments`.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        checked, signature = check_arguments(function), inspect.signature(function)
        left_out = {*without.split(), *signature.parameters}
        fields = {name: each for model in models for name, each in model.model_fields.items() if name not in left_out}

        @functools.wraps(function)
        def call(*arguments: P.args, **named: P.kwargs) -> R:
            for name in named:
                if name not in fields and name not in signature.parameters:
                    raise unknown_option(name, function.__name__, [*fields])
            return checked(*arguments, **named)

        parameters = [each for each in signature.parameters.values() if each.kind != each.VAR_KEYWORD]
        for name, field in fields.items():
            default = inspect.Parameter.empty if field.is_required() else field.default
            keyword = inspect.Parameter.KEYWORD_ONLY
            parameters.append(inspect.Parameter(name, keyword, default=default, annotation=field.annotation))
        call.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        lines = [f"{name}\n    {each.description}" for name, each in fields.items()]
        call.__doc__ = "\n".join([inspect.getdoc(function) or "", "", "Other Parameters", "----------------", *lines])
        return call

    return decorate


def unknown_option(name: str, function: str, known: Iterable[str]) -> ArgumentError:
    of = f"option of {function}" if function else "such option"
    return ArgumentError(name, f"is no {of}; {near_name(name, known)}use {', '.join(known)}")
