"""What tests of refusals share: the call that must be refused, a new output's name, and words that a line must have."""

from __future__ import annotations

from collections.abc import Callable

Refused = Callable[..., str]
NEW = ("-o", "new")


def mentions(line: str, *fragments: str) -> None:
    """Every fragment stands in the line."""
    for fragment in fragments:
        assert fragment in line, (fragment, line)
