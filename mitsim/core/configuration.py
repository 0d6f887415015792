"""Configuration files: a TOML path in, a checked pydantic model out; where the shipped ones lie."""

import reprlib
import sys
from pathlib import Path
from typing import Any, TypeVar

import pydantic

from mitsim.core.errors import MitsimError, cut
from mitsim.core.plainfile import read_text

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_MOST_BYTES = 1 << 16
_MOST_DOTS = 200
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 100
Model = TypeVar("Model", bound=pydantic.BaseModel)


def shipped(*parts: str) -> Path:
    """A file or folder that comes with mitsim, for example ``shipped("calibration", "imx249.toml")`` of ``parts``.

    A wheel carries them inside the package, a source tree beside it. MitsimError when it is in neither.
    """
    package = Path(__file__).resolve().parents[1]
    inside = package / "_shipped"
    path = (inside if inside.is_dir() else package.parent).joinpath(*parts)
    if not path.exists():
        raise MitsimError(f"{'/'.join(parts)}: not found at {path}; install mitsim again")
    return path


def read_toml(path: Path | str) -> dict[str, Any]:
    """The table in a TOML file of at most 64 KiB. Raises MitsimError when it cannot be read or is not TOML."""
    try:
        text = read_text(path, _MOST_BYTES)
        # The parser's time grows with the square of the parts of a dotted name.
        if any(line.count(".") > _MOST_DOTS for line in text.splitlines()):
            raise ValueError(f"a line with over {_MOST_DOTS} dots")
        return tomllib.loads(text)
    except RecursionError as error:
        raise MitsimError(f"file {path}: not valid TOML (it is nested too deep); flatten it") from error
    except ValueError as error:
        raise MitsimError(f"file {path}: not valid TOML ({error}); correct that line") from error


def load_model(path: Path | str, model: type[Model]) -> Model:
    """The TOML file `path` checked against `model`. Raises MitsimError naming field, value and rule."""
    return validated(model, read_toml(path), f"file {path}")


def validated(model: type[Model], data: dict[str, Any], where: str) -> Model:
    """`data` as a `model`; `where` opens the one-line MitsimError for the first field that breaks a rule."""
    try:
        return model.model_validate(data)
    except pydantic.ValidationError as error:
        problems = error.errors(include_url=False)
        first = problems[0]
        field = ".".join(cut(str(part)) for part in first["loc"]) or "contents"
        rule = first["msg"][0].lower() + first["msg"][1:]
        known = ", ".join(model.model_fields)
        hint = f"; known fields: {known}" if first["type"] in ("extra_forbidden", "missing") else ""
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        value = "nothing" if first["type"] == "missing" else _shown(first["input"])
        raise MitsimError(f"{where}: {field}: got {value}, {rule}{hint}; correct this field{more}") from error


def _shown(value: object) -> str:
    """A value on one short line, however large it is."""
    try:
        return cut(_SHORT.repr(value), 120)
    except (ValueError, RecursionError):  # a number of thousands of digits
        return f"a {type(value).__name__} too large to show"
