"""TOML files as checked pydantic models, models of options, and the shipped files."""

from __future__ import annotations

import functools
import inspect
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
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
Mistake = tuple[int, str]
"""Line of a mistake (0: unknown), and its message."""


class Table(dict[str, Any]):
    """Content of a file that a person wrote; all mistakes in it are reported together.

    ``text`` is the TOML source, if known, and ``place`` has the names of the enclosing tables.
    """

    def __init__(self, values: Mapping[str, Any], text: str = "", place: Place = ()) -> None:
        super().__init__(values)
        self.text, self.place = text, place

    def part(self, name: str) -> Table:
        return Table(self[name], self.text, (*self.place, name))

    def line(self, place: Place) -> int:
        """Return the line on which the entry at ``place``, or its nearest parent, begins; 0 if unknown."""
        wanted, table, counts, best = (*self.place, *place), Place(), dict[Place, int](), (0, 0)
        for number, line in enumerate(self.text.split("\n"), 1):
            if not (found := _NAMED.match(line)):
                continue
            parts = [part.strip(" \"'") for part in (found[2] or found[3]).split(".")]
            here: Place = () if found[1] else table
            for part in parts:
                here = (*here, part)
                if found[1] == "[[" and part is parts[-1]:
                    counts[here] = counts.get(here, -1) + 1
                if found[1] and here in counts:
                    here = (*here, counts[here])
            table = here if found[1] else table
            if here == wanted[: len(here)] and len(here) > best[0]:
                best = len(here), number
        return best[1]


_NAMED = re.compile(r"\s*(?:(\[\[?)([^\]]+)\]|([\w\"' .-]+?)\s*=)")


def mistakes(model: type[BaseModel], data: Table) -> list[Mistake]:
    try:
        model.model_validate(data)
    except ValidationError as error:
        return _mistakes_in(model, error, data)
    return []


def refusal(model: type[BaseModel], error: ValidationError, where: str, data: object = None) -> MitsimError:
    """Convert pydantic's ``error``: all mistakes of a :class:`Table`, the first one of data that programs write."""
    found = _mistakes_in(model, error, data)
    if isinstance(data, Table):
        return refuse_together(where, found)
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    return MitsimError(f"{where}: {found[0][1]}{more}")


def refuse_together(where: str, found: Sequence[Mistake]) -> MitsimError:
    if len(found) == 1:
        ((line, text),) = found
        return MitsimError(f"{where}:{line}: {text}" if line else f"{where}: {text}")
    ordered = sorted(found, key=lambda one: one[0] or math.inf)
    listed = [f"line {line}: {text}" if line else text for line, text in ordered]
    more = [f"and {len(listed) - _MOST_MISTAKES} more"] if len(listed) > _MOST_MISTAKES else []
    return MitsimError(f"{where}: has {len(found)} mistakes:", *listed[:_MOST_MISTAKES], *more)


def _mistakes_in(model: type[BaseModel], error: ValidationError, data: object) -> list[Mistake]:
    """Convert pydantic's errors to mistakes, one for each place, misspelt names first."""
    above = data.place if isinstance(data, Table) else ()
    found, meant = dict[Place, Mistake](), set[Place]()
    errors = error.errors(include_url=False)
    for one in sorted(errors, key=lambda one: one["type"] != "extra_forbidden"):
        place, kind = one["loc"], one["type"]
        if kind == "too_short" and any(
            len(each["loc"]) > len(place) and each["loc"][: len(place)] == place for each in errors
        ):  # wrong items are missing from a list's length
            continue
        holder: Any = data
        for end, part in enumerate(place if kind not in ("missing", "extra_forbidden") else ()):
            try:
                holder = holder[part]
            except (KeyError, IndexError, TypeError):  # the name of a union's alternative
                place = place[:end] or place
                break
        field = ".".join(cut(str(part)) for part in (*above, *place))
        line, value = data.line(place) if isinstance(data, Table) else 0, short_text(one["input"], 100)
        if kind == "value_error":  # a validator of ours, whose message has the value
            text = f"{field}: {one['ctx']['error']}" if field else str(one["ctx"]["error"])
        elif kind == "missing":
            if place in meant:  # a misspelt name is both unknown and missing
                continue
            text = f"{field}: is missing"
        elif kind == "extra_forbidden":
            known = [*getattr(_model_at(model, place[:-1]), "model_fields", ())]
            near = near_name(str(place[-1]), known).strip()
            if near:
                meant.add((*place[:-1], near.removeprefix("did you mean ").removesuffix("?")))
            hint = near or (f"known fields: {', '.join(known)}" if known else "remove it")
            text = f"{field}: got {value}, no such field; {hint}"
        else:
            rule, named = rule_of(one["msg"]), [part for part in one["loc"] if isinstance(part, str)]
            if kind.startswith(("greater", "less")) and named:  # pydantic states the end that is crossed alone
                of = getattr(_model_at(model, one["loc"][: one["loc"].index(named[-1])]), "model_fields", {})
                limits = limits_of(of[named[-1]]) if named[-1] in of else ""
                rule = f"give a number {limits}" if limits.startswith("from") or ", " in limits else rule
            text = f"{field or 'contents'}: got {value}; {rule}"
        found.setdefault(place, (line, text))
    return [*found.values()]


_PLAINER = {"a valid integer": "a whole number", "a valid string": "text", "a valid boolean": "true or false"}


def rule_of(message: str) -> str:
    rule = message.removeprefix("Value error, ")
    if "pattern '^[^/" in rule:
        return "give a name without folders"
    if not rule.startswith("Input should be "):
        return rule[0].lower() + rule[1:]
    rule = re.split(", (?:got|unable)", rule.removeprefix("Input should be "))[0]
    if rule.startswith(("greater", "less")):
        return f"give a number {rule}"
    return f"give {_PLAINER.get(rule, rule.replace(' valid ', ' '))}"


def _model_at(model: type[BaseModel] | None, place: Place) -> type[BaseModel] | None:
    for name in place:
        if model is not None and isinstance(name, str) and name in model.model_fields:
            kinds = [model.model_fields[name].annotation]
            for kind in kinds:  # grows, because a part may be in a tuple, or optional
                kinds += get_args(kind)
            model = next((kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)), None)
    return model


# ---- Reading files ---------------------------------------------------------------------------------------------------


def shipped_path(*parts: str) -> Path:
    """Return the path of a shipped file, inside the package of a wheel or beside it in a source tree."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "_shipped"
    path = (inside if inside.is_dir() else package.parent).joinpath(*parts)
    if not path.exists():
        raise MitsimError(f"{'/'.join(parts)}: not found at {path}; install mitsim again")
    return path


def read_toml(path: Path | str) -> Table:
    try:
        text = read_text(path, _MOST_BYTES).removeprefix(BYTE_ORDER_MARK)
        # The parser's time grows with the square of the parts of a dotted name.
        if any(line.count(".") > _MOST_DOTS for line in text.splitlines()):
            raise ValueError(f"a line with over {_MOST_DOTS} dots")
        return Table(tomllib.loads(text), text)
    except RecursionError as error:
        raise MitsimError(f"file {path}: not valid TOML (it is nested too deep); flatten it") from error
    except ValueError as error:
        raise MitsimError(f"file {path}: not valid TOML ({error}); correct that line") from error


def read_table(path: Path, what: str) -> Table:
    if path.suffix.lower() != ".json":
        return read_toml(path)
    data = read_json(path)
    if not isinstance(data, dict):
        raise MitsimError(f"{what} {path}: holds a {type(data).__name__}; give a table of names and values")
    return Table(data)


def load_model(path: Path | str, model: type[Model]) -> Model:
    return validate(model, read_toml(path), f"file {path}")


def validate(model: type[Model], data: dict[str, Any], where: str, context: object = None) -> Model:
    """Return ``data`` as a checked ``model``; MitsimError, beginning with ``where``, if it breaks a rule."""
    try:
        return model.model_validate(data, context=context)
    except ValidationError as error:
        raise refusal(model, error, where, data) from error


CAMERA, PROJECTOR, RECIPE, LIST = "full_well_e", "effective_wavelength_nm", "board_reflectance", "patterns"
"""Required fields that identify shipped cameras, projectors, recipes and lists of known frames."""


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
    if known.is_file():
        return known
    if path.exists():
        return path / ending if inside and path.is_dir() else path
    names = shipped_files(shelf, ending, field)
    raise MitsimError(
        f"{name}: no such file, and none of that name is shipped; {near_name(text, names)}"
        f"shipped are {', '.join(names)}"
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


def toml_value(value: object) -> str:
    import tomli_w

    # In a list with a number a table is inline. Line ends are those of lists, because texts have theirs escaped.
    text = tomli_w.dumps({"": [value, 0]}).partition("\n")[2].rpartition(",\n    0,")[0].strip()
    return re.sub(r",\n\s*", ", ", re.sub(r"(?<=\[)\n\s*|,\n\s*(?=\])", "", text))


# -------- Options of verbs

WHAT, QUALITY, DEVICES = "What", "Quality", "Scene and devices"
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

    def of(self, name: str) -> ArgumentError:
        (error,) = self.args
        return error if isinstance(error, ArgumentError) else ArgumentError(name, re.sub(f"^{name}:? ", "", str(error)))


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
            first, *others = self._refusals(error)
            first.others = tuple(others)
            raise first from error

    @classmethod
    def _refusals(cls, error: ValidationError) -> list[ArgumentError]:
        found: dict[str, ArgumentError] = {}
        errors = error.errors(include_url=False)
        for one in sorted(errors, key=lambda one: one["type"] != "extra_forbidden"):
            name, original = str(one["loc"][0]), one.get("ctx", {}).get("error")
            if isinstance(original, _Refused):
                found.setdefault(name, original.of(name))
            elif one["type"] == "extra_forbidden" and len(one["loc"]) == 1:
                found[name] = unknown_option(name, cls.VERB, [*cls.model_fields])
            elif one["type"] == "missing":
                found.setdefault(name, ArgumentError(name, "is missing; give it"))
            elif name not in found:
                rules = (rule_of(each["msg"]).removeprefix("give ") for each in errors if each["loc"][0] == name)
                rule, limits = " or ".join(dict.fromkeys(rules)), limits_of(cls.model_fields[name])
                if limits:
                    kind = "a number" if one["type"].startswith(("greater", "less")) else rule
                    rule = f"{kind} {limits}"
                found[name] = ArgumentError(name, f"{short_text(one['input'])}: give {rule}")
        return [*found.values()]

    @property
    def given(self) -> dict[str, Any]:
        """Return the options that were given explicitly."""
        return {name: getattr(self, name) for name in type(self).model_fields if name in self.model_fields_set}

    def part(self, model: type[M]) -> M:
        """Return the given options that another ``model`` shares."""
        return model(**{name: value for name, value in self.given.items() if name in model.model_fields})

    def without(self, *names: str) -> dict[str, Any]:
        return {name: value for name, value in self.given.items() if name not in names}

    def refuse(self, names: Iterable[str], where: str) -> None:
        """Refuse given options that have no effect under the condition ``where``."""
        refuse_unused(self.model_fields_set, names, where)


def refuse_unused(given: Iterable[str], names: Iterable[str], where: str) -> None:
    """Raise ArgumentError for the first given option that has no effect under the condition ``where``."""
    for name in names:
        if name in given:
            raise ArgumentError(name, f"has no effect {where}; leave it out")


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


def unknown_option(name: str, function: str, known: Sequence[str]) -> ArgumentError:
    of = f"option of {function}" if function else "such option"
    return ArgumentError(name, f"is no {of}; {near_name(name, known)}use {', '.join(known)}")
