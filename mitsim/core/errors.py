"""The one exception for what a user can cause and mend."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

_LONGEST = 1500
"""Characters of a message: a screen of 80 x 20."""


class MitsimError(Exception):
    """A request that cannot be served; the command line prints it on one line and exits with status 2.

    The ``message`` is one line: what is wrong, where, the value received, what is allowed, and what to do. Whatever a
    hostile file brought into it, it is printable and not long.
    """

    def __init__(self, message: str) -> None:
        super().__init__(cut(message, _LONGEST))


class ArgumentError(MitsimError):
    """A value that one argument cannot have; ``argument`` names it.

    The ``message`` begins with the argument, as Python spells it; the command line writes it as its option.
    """

    def __init__(self, argument: str, message: str) -> None:
        super().__init__(f"{argument} {message}")
        self.argument = argument


def printable(text: str) -> str:
    """A ``text`` without what a terminal would obey: control characters and those that turn its direction are spaces,
    line ends stay."""
    return "".join(letter if letter.isprintable() or letter == "\n" else " " for letter in text)


def cut(text: str, length: int = 60) -> str:
    """One printable line of ``text``, of at most ``length`` characters."""
    shown = printable(text[: length + 1]).replace("\n", " ")
    return shown if len(text) <= length else shown[: length - 3] + "..."


def reason_of(error: BaseException) -> str:
    """What an ``error`` of a library says, on one line; its name where it says nothing."""
    return " ".join(str(error).split()) or type(error).__name__


def near_name(text: str, known: Iterable[str]) -> str:
    """ "did you mean NAME? " for the ``known`` name that a mistyped ``text`` is nearest to; empty without one."""
    near = difflib.get_close_matches(text, [*known], 1)
    return f"did you mean {near[0]}? " if near else ""
