"""Configuration files: a TOML path in, a checked pydantic model out; where the shipped ones lie."""

import sys
from pathlib import Path
from typing import Any, TypeVar

import pydantic

from mitsim.core.errors import MitsimError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Model = TypeVar("Model", bound=pydantic.BaseModel)


def shipped(*parts: str) -> Path:
    """A file or folder that comes with mitsim beside the package, for example `shipped("calibration",
    "imx249.toml")`. Raises MitsimError when it is not there (mitsim installed without its source tree)."""
    path = Path(__file__).resolve().parents[2].joinpath(*parts)
    if not path.exists():
        raise MitsimError(f"{'/'.join(parts)}: not found at {path}; run mitsim from its source tree (`make setup`)")
    return path


def read_toml(path: Path | str) -> dict[str, Any]:
    """The table in a TOML file. Raises MitsimError when it cannot be read or is not TOML."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise MitsimError(f"file {path}: cannot be read ({error.strerror}); check the path") from error
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
        field = ".".join(str(part) for part in first["loc"]) or "contents"
        rule = first["msg"][0].lower() + first["msg"][1:]
        known = ", ".join(model.model_fields)
        hint = f"; known fields: {known}" if first["type"] in ("extra_forbidden", "missing") else ""
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        value = "nothing" if first["type"] == "missing" else repr(first["input"])
        raise MitsimError(f"{where}: {field}: got {value}, {rule}{hint}; correct this field{more}") from error
