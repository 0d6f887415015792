"""What system tests share: types of the calls, a new output's name, and words that a line must have."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Call, Refused = Callable[..., Any], Callable[..., str]
NEW = ("-o", "new")


def mentions(line: str, *fragments: str) -> None:
    """Every fragment stands in the line."""
    for fragment in fragments:
        assert fragment in line, (fragment, line)
