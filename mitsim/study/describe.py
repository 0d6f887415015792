"""A scene file in, one line for people out."""

from __future__ import annotations

import re
from pathlib import Path

_OPENING = re.compile(r"\s*(?:<\?xml[^>]*\?>)?\s*(?:<scene[^>]*>)?\s*<!--(.*?)-->", re.DOTALL)


def scene_line(path: Path) -> str:
    """Name of the folder of the scene ``path``, and the first sentence of the comment that opens the file, if any.

    A comment further down speaks of its own element and is left alone.
    """
    name = path.resolve().parent.name
    opening = _OPENING.match(path.read_text(encoding="utf-8"))
    if opening is None:
        return name
    text = " ".join(opening[1].split())
    # A full stop that ends a sentence stands before a capital; "0.90" and "e.g. a sheet" do not.
    sentence = re.split(r"(?<=\.) (?=[A-Z])", text)[0]
    return f"{name}: {sentence}" if sentence else name
