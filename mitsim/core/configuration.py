"""Configuration files: a TOML path in, a checked pydantic model out; where the shipped ones lie."""

import os
import re
import reprlib
import sys
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

import pydantic

from mitsim.core.errors import MitsimError, cut, near_name
from mitsim.core.files import BYTE_ORDER_MARK, read_text

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_MOST_BYTES = 1 << 16
"""Ten times the longest file that is shipped."""
_MOST_DOTS = 200
"""The parser takes a tenth of a second for a name of that many parts."""
_SHORT = reprlib.Repr()  # values as a message shows them
_SHORT.maxstring = _SHORT.maxother = 100  # characters: a line of 120 with what stands around them
DEFAULT_CAMERA = "imx249"
"""Of a bench where none is named: the paper's."""
_SERVES = "Serves: "
"""Begin of the sentence of a file's first comment that says what the file is for."""
Model = TypeVar("Model", bound=pydantic.BaseModel)
LARGEST = 1e12
"""Largest number of a device, and one over the smallest: far from any device, and products of a few stay finite."""
Positive = Annotated[float, pydantic.Field(ge=1 / LARGEST, le=LARGEST, allow_inf_nan=False)]
NonNegative = Annotated[float, pydantic.Field(ge=0, le=LARGEST, allow_inf_nan=False)]


class Configuration(pydantic.BaseModel):
    """A frozen model of finite numbers, of the very types that it states, without further fields."""

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


def shipped_path(*parts: str) -> Path:
    """A file or folder that comes with mitsim, for example ``shipped_path("calibration", "imx249.toml")`` of ``parts``.

    A wheel carries them inside the package, a source tree beside it. MitsimError when it is in neither.
    """
    package = Path(__file__).resolve().parents[1]
    inside = package / "_shipped"
    path = (inside if inside.is_dir() else package.parent).joinpath(*parts)
    if not path.exists():
        raise MitsimError(f"{'/'.join(parts)}: not found at {path}; install mitsim again")
    return path


def read_toml(path: Path | str) -> dict[str, Any]:
    """The table in the TOML file ``path`` of at most 64 KiB. MitsimError when it cannot be read or is not TOML."""
    try:
        text = read_text(path, _MOST_BYTES).removeprefix(BYTE_ORDER_MARK)
        # The parser's time grows with the square of the parts of a dotted name.
        if any(line.count(".") > _MOST_DOTS for line in text.splitlines()):
            raise ValueError(f"a line with over {_MOST_DOTS} dots")
        return tomllib.loads(text)
    except RecursionError as error:
        raise MitsimError(f"file {path}: not valid TOML (it is nested too deep); flatten it") from error
    except ValueError as error:
        raise MitsimError(f"file {path}: not valid TOML ({error}); correct that line") from error


def load_model(path: Path | str, model: type[Model]) -> Model:
    """The TOML file ``path`` as a ``model``. MitsimError naming field, value and rule when it breaks one."""
    return validate(model, read_toml(path), f"file {path}")


def validate(model: type[Model], data: dict[str, Any], where: str, context: object = None) -> Model:
    """A dictionary as a checked model.

    Parameters
    ----------
    model
        what to make of it.
    data
        names and values, as read from a file.
    where
        what the message begins with.
    context
        passed on to the model's validators.

    Raises
    ------
    MitsimError
        in one line, for the first field that breaks a rule: its value, the rule, and what to do.
    """
    try:
        return model.model_validate(data, context=context)
    except pydantic.ValidationError as error:
        raise refusal(model, error, where) from error


def refusal(model: type[pydantic.BaseModel], error: pydantic.ValidationError, where: str) -> MitsimError:
    """What pydantic found wrong, as :func:`validate` raises it.

    Parameters
    ----------
    model
        that was to be made.
    error
        that pydantic raised.
    where
        what the message begins with.
    """
    problems = error.errors(include_url=False)
    # A mistyped name is both an unknown field and a missing one; the first tells more.
    first = next((problem for problem in problems if problem["type"] == "extra_forbidden"), problems[0])
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return MitsimError(f"{where}: {_complaint(model, first)}{more}")


def _complaint(model: type[pydantic.BaseModel], problem: Any) -> str:
    """Field, value and rule of one problem that pydantic found."""
    field = ".".join(cut(str(part)) for part in problem["loc"])
    if problem["type"] == "value_error":  # a validator of ours, whose text says all
        return f"{field}: {problem['ctx']['error']}" if field else str(problem["ctx"]["error"])
    rule = problem["msg"][0].lower() + problem["msg"][1:]
    if problem["type"] == "string_pattern_mismatch" and "/" in problem["ctx"]["pattern"]:
        rule = "a name without folders is needed"
    hint = _range(model, problem["loc"])
    if problem["type"] in ("extra_forbidden", "missing") and (holder := _holder(model, problem["loc"][:-1])):
        known = [*holder.model_fields]
        meant = near_name(str(problem["loc"][-1]), known) if problem["type"] == "extra_forbidden" else ""
        rule = "no such field" if problem["type"] == "extra_forbidden" else rule
        hint = f"; {meant}known fields: {', '.join(known)}"
    value = "nothing" if problem["type"] == "missing" else _short_text(problem["input"])
    return f"{field or 'contents'}: got {value}, {rule}{hint}; correct this field"


def _holder(model: type[pydantic.BaseModel], place: tuple[str | int, ...]) -> type[pydantic.BaseModel] | None:
    """The model of the part at ``place`` inside a ``model``; None for another kind of part."""
    for name in place:
        if isinstance(name, str) and name in model.model_fields:
            kinds = [model.model_fields[name].annotation]
            for kind in kinds:  # grows: a part may stand in a tuple, or be optional
                kinds += get_args(kind)
            models = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, pydantic.BaseModel)]
            if not models:
                return None
            model = models[0]
    return model


def _range(model: Any, location: tuple[int | str, ...]) -> str:
    """What a number at ``location`` of a model may be, where it has two ends."""
    marks: list[Any] = []
    for part in location:
        holders = (getattr(kind, "model_fields", {}) for kind in (model, *get_args(model)))  # a part may be optional
        field = next((fields[part] for fields in holders if part in fields), None)
        if field is None:
            return ""
        model, marks = field.annotation, field.metadata
    ends = {name: getattr(mark, name) for mark in marks for name in ("ge", "gt", "le", "lt") if hasattr(mark, name)}
    if len(ends) != 2:
        return ""
    low, high = (f"{end:g}" for end in ends.values())
    return f" (range: {'above ' if 'gt' in ends else ''}{low} to {'below ' if 'lt' in ends else ''}{high})"


def _short_text(value: object) -> str:
    """A value on one short line, however large it is."""
    try:
        return cut(_SHORT.repr(value), 120)
    except (ValueError, RecursionError):  # a number of thousands of digits
        return f"a {type(value).__name__} too large to show"


def locate(name: Path | str, shelf: Literal["scenes", "calibration"], ending: str) -> Path:
    """The path of a file: that of a shipped one by its bare name, else ``name`` itself.

    Parameters
    ----------
    name
        a shipped file's name, or a path; a bare name that is shipped comes first, ``./name`` is always a path.
    shelf
        where shipped ones lie.
    ending
        what follows the name: a file in the folder ``name``, or a suffix.

    Raises
    ------
    MitsimError
        for a bare name that is neither shipped nor the name of a file here.
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
    names = shipped_files(shelf, ending)
    raise MitsimError(
        f"{name}: no such file, and none of that name is shipped; {near_name(text, names)}"
        f"shipped are {', '.join(names)}"
    )


def shipped_files(shelf: Literal["scenes", "calibration"], ending: str, field: str = "") -> dict[str, Path]:
    """Paths of shipped files by their names.

    Parameters
    ----------
    shelf, ending
        as :func:`locate` takes them.
    field
        which each of the files has, where they are TOML: cameras, projectors and lists lie on one shelf.
    """
    if not ending.startswith("."):
        return {path.parent.name: path for path in sorted(shipped_path(shelf).glob(f"*/{ending}"))}
    files = sorted(shipped_path(shelf).glob(f"*{ending}"))
    return {path.stem: path for path in files if not field or field in read_toml(path)}


_OPENING = re.compile(r"\s*(?:<\?xml[^>]*\?>)?\s*(?:<scene[^>]*>)?\s*<!--(.*?)-->|((?:#[^\n]*\n)+)", re.DOTALL)
"""Comment that opens a scene, or a TOML file."""


def opening_words(path: Path) -> tuple[str, str]:
    """What the comment that opens the scene or TOML file ``path`` says: its first sentence, and what follows "Serves:"
    in it; empty where it does not."""
    opening = _OPENING.match(path.read_text(encoding="utf-8"))
    if opening is None:
        return "", ""
    text = " ".join((opening[1] or re.sub("(?m)^#", "", opening[2] or "")).split())
    # A full stop that ends a sentence stands before a capital; "0.90" and "e.g. a sheet" do not.
    sentences = re.split(r"(?<=\.) (?=[A-Z])", text)
    serves = next((each for each in sentences if each.startswith(_SERVES)), "")
    return sentences[0], serves.removeprefix(_SERVES).removesuffix(".")
