"""Configuration files: a TOML path in, a checked pydantic model out; where the shipped ones lie."""

import os
import re
import sys
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import pydantic

from mitsim.core.errors import MitsimError, near_name
from mitsim.core.files import BYTE_ORDER_MARK, read_json, read_text
from mitsim.core.mistakes import Table, refusal

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_MOST_BYTES = 1 << 16
"""Ten times the longest file that is shipped."""
_MOST_DOTS = 200
"""The parser takes a tenth of a second for a name of that many parts."""
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

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, defer_build=True)


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


def read_toml(path: Path | str) -> Table:
    """The table in the TOML file ``path`` of at most 64 KiB. MitsimError when it cannot be read or is not TOML."""
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
    """The table in the TOML or JSON file ``path`` of a person's; MitsimError, which calls it ``what``, for a file that
    cannot be read or holds something else."""
    if path.suffix.lower() != ".json":
        return read_toml(path)
    data = read_json(path)
    if not isinstance(data, dict):
        raise MitsimError(f"{what} {path}: holds a {type(data).__name__}; give a table of names and values")
    return Table(data)


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
        for fields that break a rule: value, rule, and what to do. Of a :class:`Table` all of them, each on a line; of
        other data, which programs write, the first.
    """
    try:
        return model.model_validate(data, context=context)
    except pydantic.ValidationError as error:
        raise refusal(model, error, where, data) from error


CAMERA, PROJECTOR, RECIPE, LIST = "full_well_e", "effective_wavelength_nm", "board_reflectance", "patterns"
"""Fields by which a shipped file is known to be of a camera or a projector, a session's recipe, or a list of what is
known of frames."""


def locate(name: Path | str, shelf: Literal["scenes", "calibration", "sessions"], ending: str, field: str = "") -> Path:
    """The path of a file: that of a shipped one by its bare name, else ``name`` itself.

    Parameters
    ----------
    name
        a shipped file's name, or a path; a bare name that is shipped comes first, ``./name`` is always a path.
    shelf
        where shipped ones lie.
    ending
        what follows the name: a file in the folder ``name``, or a suffix.
    field
        which all files have that a message may offer, as :func:`shipped_files` takes it.

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
    names = shipped_files(shelf, ending, field)
    raise MitsimError(
        f"{name}: no such file, and none of that name is shipped; {near_name(text, names)}"
        f"shipped are {', '.join(names)}"
    )


def shipped_files(shelf: Literal["scenes", "calibration", "sessions"], ending: str, field: str = "") -> dict[str, Path]:
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
