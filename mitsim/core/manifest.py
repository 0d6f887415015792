"""JSON files: plain data in, a complete file out, and back; versions of what computed it."""

import importlib.metadata
import json
import math
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import mitsim
from mitsim.core.errors import MitsimError, cut
from mitsim.core.output import whole_file
from mitsim.core.plainfile import read_text

DECIDING = ("mitsim", "mitsuba", "drjit", "numpy", "scipy")
"""Packages of which another version may give other frames from the same seed."""
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
    text = json.dumps(plain(obj), indent=1, allow_nan=False) + "\n"
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")


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


def versions() -> dict[str, str]:
    """Versions of mitsim, Python and the packages that decide the numbers, by name; imports none of them."""
    found = {"mitsim": mitsim.__version__, "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found
