"""JSON files: plain data in, a complete file out, and back."""

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mitsim.core.errors import MitsimError, cut
from mitsim.core.output import whole_file
from mitsim.core.plainfile import read_text

MOST_BYTES = 32 << 20
"""A little more than the largest manifest that a capture writes: 65536 shots of 4096 x 256 patterns make 29 MB."""


def plain(value: Any) -> Any:
    """``value`` as JSON can hold it: arrays become lists, paths text, pydantic models dictionaries, NaN and
    infinities null (JSON has no such numbers). TypeError for anything else."""
    if hasattr(value, "model_dump"):
        value = value.model_dump()
    if hasattr(value, "tolist"):  # arrays and numbers of numpy, which plain data can do without
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


def json_text(obj: Any) -> str:
    """``obj`` (see :func:`plain`) as indented JSON."""
    return json.dumps(plain(obj), indent=1, allow_nan=False) + "\n"


def write_json(path: Path | str, obj: Any) -> None:
    """Write ``obj`` to ``path`` as :func:`json_text`, all or nothing. MitsimError when the file cannot be written."""
    text = json_text(obj)
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")


def parse_json(text: str) -> Any:
    """The object in a JSON ``text``. ValueError when it is not JSON, has a key twice, or is nested too deep."""
    try:
        return json.loads(text, object_pairs_hook=_once)
    except RecursionError:
        raise ValueError("it is nested too deep") from None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    unique: dict[str, Any] = {}
    for key, value in pairs:
        if key in unique:
            raise ValueError(f"key {cut(key)!r} is there twice")
        unique[key] = value
    return unique


def read_json(path: Path | str) -> Any:
    """The object in the JSON file ``path`` of at most 32 MiB. MitsimError when it cannot be read, is not JSON, or has a
    key twice."""
    try:
        return parse_json(read_text(path, MOST_BYTES))
    except ValueError as error:
        raise MitsimError(f"file {path}: not valid JSON ({error}); write or copy it again") from error
