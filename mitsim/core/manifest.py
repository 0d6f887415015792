"""Run folders and their JSON: plain data in, a complete file out; versions of what computed it."""

import importlib.metadata
import json
import math
import os
import platform
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np

import mitsim
from mitsim.core.errors import MitsimError, cut
from mitsim.core.plainfile import read_text

_MOST_BYTES = 16 << 20
_PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "scikit-image", "OpenEXR")


def plain(value: Any) -> Any:
    """`value` as JSON can hold it: arrays become lists, paths text, pydantic models dictionaries, NaN and
    infinities null (JSON has no such numbers). Raises TypeError for anything else."""
    if hasattr(value, "model_dump"):
        value = value.model_dump()
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (str, bool, int)):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"plain: {value!r} is {type(value).__name__}, which JSON cannot hold; convert it first")


def write_json(path: Path | str, obj: Any) -> None:
    """Write `obj` (see `plain`) to `path` as indented JSON, all or nothing. Raises MitsimError when the file
    cannot be written."""
    path = Path(path)
    text = json.dumps(plain(obj), indent=1, allow_nan=False) + "\n"
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
    except OSError as error:
        raise MitsimError(
            f"file {path}: cannot be written ({error.strerror}); choose a writable folder with room"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def parse_json(text: str) -> Any:
    """The object in a JSON text. ValueError when it is not JSON, has a key twice, or is nested too deep."""
    try:
        return json.loads(text, object_pairs_hook=_once)
    except RecursionError:
        raise ValueError("it is nested too deep") from None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"key {cut(key)!r} is there twice")
        found[key] = value
    return found


def read_json(path: Path | str) -> Any:
    """The object in a JSON file of at most 16 MiB. Raises MitsimError when it cannot be read or is not JSON, or has a
    key twice."""
    try:
        return parse_json(read_text(path, _MOST_BYTES))
    except ValueError as error:
        raise MitsimError(f"file {path}: not valid JSON ({error}); write or copy it again") from error


def prepare_output(path: Path | str, overwrite: bool = False, kind: Literal["folder", "file"] = "folder") -> Path:
    """Make sure, before any work, that output can be written to `path`; returns it as a Path.

    A folder is created if its parent exists. Nothing is deleted: `overwrite` only allows a folder that
    holds files already, or an existing file. Raises MitsimError when the parent is missing, or the place is
    not writable, is of the other kind, or holds something and `overwrite` is off.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise MitsimError(f"output {path}: the folder {path.parent} does not exist; create it or choose another")
    if kind == "file":
        _prepare_file(path, overwrite)
    else:
        _prepare_folder(path, overwrite)
    return path


@contextmanager
def output_folder(path: Path | str, overwrite: bool = False) -> Iterator[Path]:
    """`prepare_output` for the time of a work: a folder made for nothing is taken away when the work fails."""
    new = not Path(path).exists()
    folder = prepare_output(path, overwrite)
    try:
        yield folder
    except BaseException:
        if new:
            with suppress(OSError):  # not empty: what was written stays
                folder.rmdir()
        raise


def versions() -> dict[str, str]:
    """Versions of mitsim, Python and the packages that decide the numbers, by name; imports none of them."""
    found = {"mitsim": mitsim.__version__, "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def _prepare_file(path: Path, overwrite: bool) -> None:
    if path.is_dir():
        raise MitsimError(f"output {path}: is a folder, but a file is to be written; give a file name")
    if path.exists() and not overwrite:
        raise MitsimError(f"output {path}: exists already; remove it or choose another name")
    _try_writing(path, path.parent)


def _prepare_folder(path: Path, overwrite: bool) -> None:
    if path.exists() and not path.is_dir():
        raise MitsimError(f"output {path}: is a file, but a folder is needed; choose another name")
    try:
        path.mkdir(exist_ok=True)
        occupied = any(path.iterdir())
    except OSError as error:
        raise MitsimError(f"output {path}: cannot be used ({error.strerror}); choose another place") from error
    if occupied and not overwrite:
        raise MitsimError(f"output {path}: the folder holds files already; choose a new one or empty it")
    _try_writing(path, path)


def _try_writing(path: Path, folder: Path) -> None:
    # Permission bits do not tell (root, read-only mounts, quotas): only a file that was really written does.
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"mitsim")
    except OSError as error:
        raise MitsimError(
            f"output {path}: the folder {folder} is not writable ({error.strerror}); choose another place"
        ) from error
