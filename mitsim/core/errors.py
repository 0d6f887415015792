"""Exceptions for faults that a user can repair, and type checks of public functions' arguments."""

from __future__ import annotations

import ast
import difflib
import functools
import inspect
import os
import reprlib
from collections.abc import Callable, Iterable, Mapping
from numbers import Integral, Real
from typing import ParamSpec, TypeVar

_LONGEST = 1500


class MitsimError(Exception):
    """Request that cannot be served; the command line prints it and exits with status 2.

    The ``message`` is one line: the fault, its place, the value received, the values allowed, and the remedy. Each of
    several ``mistakes`` in one file has its own line. All lines are printable and of limited length, even if they quote
    a hostile file.
    """

    def __init__(self, message: str, *mistakes: str) -> None:
        super().__init__("\n  ".join(cut(line, _LONGEST) for line in (message, *mistakes)))


class ArgumentError(MitsimError):
    """Invalid value of one ``argument``.

    The ``message`` begins with the argument's name in Python; the command line replaces it by the option. If several
    arguments of a call are wrong, ``others`` has the further errors.
    """

    def __init__(self, argument: str, message: str) -> None:
        super().__init__(f"{argument} {message}")
        self.argument, self._message = argument, message
        self.others: tuple[ArgumentError, ...] = ()

    def __reduce__(self) -> tuple[type[ArgumentError], tuple[str, str]]:
        return ArgumentError, (self.argument, self._message)


def printable(text: str) -> str:
    """Return ``text`` with control characters and bidirectional marks replaced by spaces."""
    return "".join(letter if letter.isprintable() or letter == "\n" else " " for letter in text)


def cut(text: str, length: int = 60) -> str:
    shown = printable(text[: length + 1]).replace("\n", " ")
    return shown if len(text) <= length else shown[: length - 3] + "..."


def reason_of(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def near_name(text: str, known: Iterable[str]) -> str:
    """Return "did you mean NAME? " for the nearest ``known`` name, or an empty text."""
    near = difflib.get_close_matches(text, [*known], 1)
    return f"did you mean {near[0]}? " if near else ""


# -------- Arguments of public functions
# Annotations are read as text, and classes are matched by name, so that no other room is imported. Each function checks
# ranges itself.

P = ParamSpec("P")
R = TypeVar("R")
C = TypeVar("C", bound=type)
_ANY = "object", "Any"
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 100
_LONGEST_PATH, _LONGEST_NAME = 4095, 255
"""Bytes of a path, and of a name in it, that Linux allows."""
Kind = tuple[str, Callable[[object], bool]]
"""Allowed values in words, and their test."""
_KINDS: dict[str, Kind] = {
    "None": ("None", lambda value: value is None),
    "bool": ("True or False", lambda value: type(value).__name__ in ("bool", "bool_")),
    "int": ("a whole number", lambda value: isinstance(value, Integral) and not isinstance(value, bool)),
    "float": ("a number", lambda value: _is_number(value)),
    "str": ("text", lambda value: isinstance(value, str)),
    "Path": ("a path", lambda value: is_path(value)),
    "Mapping": ("a mapping", lambda value: isinstance(value, Mapping)),
    "tuple": ("a tuple", lambda value: isinstance(value, tuple)),
    "Iterable": ("several values", lambda value: isinstance(value, Iterable)),
    "Sequence": ("a list", lambda value: isinstance(value, (list, tuple))),
    "Progress": ("a function", callable),
    "FloatArray": (
        "an array of real numbers, none of them masked",
        lambda value: _is_real(value) and not is_masked(value) and getattr(value, "ndim", 0) > 0,
    ),
}


def check_arguments(function: Callable[P, R]) -> Callable[P, R]:
    """Make ``function`` raise ArgumentError for arguments that do not fit its annotations.

    NumPy scalars are converted to Python's. ``**options`` are checked by the function's models.
    """
    signature = inspect.signature(function)
    kinds = {name: _kinds(each.annotation, function) for name, each in signature.parameters.items()}

    @functools.wraps(function)
    def call(*arguments: P.args, **named: P.kwargs) -> R:
        for name, bound in signature.bind(*arguments, **named).arguments.items():
            given, several = [(name, bound)], signature.parameters[name].kind
            if several == inspect.Parameter.VAR_KEYWORD:
                given = [*bound.items()]
            elif several == inspect.Parameter.VAR_POSITIONAL:
                given = [(name, each) for each in bound]
            for told, value in given:
                if kinds[name] and not any(allows(value) for _, allows in kinds[name]):
                    words = " or ".join(dict.fromkeys(words for words, _ in kinds[name]))
                    raise ArgumentError(told, f"{short_text(value)}: give {words}")
        plain = {name: plain_number(value) for name, value in named.items()}
        return function(*map(plain_number, arguments), **plain)  # type: ignore[arg-type]

    return call


def plain_number(value: object) -> object:
    """Convert a NumPy scalar to Python's without importing NumPy."""
    is_scalar = type(value).__module__ == "numpy" and getattr(value, "shape", None) == () and _is_real(value)
    return value.item() if is_scalar else value  # type: ignore[attr-defined]


def _is_real(value: object) -> bool:
    """Return True for real or boolean NumPy arrays and scalars; NumPy is not imported."""
    return getattr(getattr(value, "dtype", None), "kind", "") in tuple("biuf")


def checked_fields(made: C) -> C:
    """Apply :func:`check_arguments` to a class's constructor."""
    made.__init__ = check_arguments(vars(made)["__init__"])  # type: ignore[misc]
    return made


def _kinds(annotation: object, function: Callable[..., object]) -> list[Kind]:
    """Return what an annotation such as ``float | Literal["auto"] | None`` allows; empty: anything."""
    if not isinstance(annotation, str):
        return []
    found: list[Kind] = []
    terms: list[ast.expr] = [ast.parse(annotation, mode="eval").body]
    while terms:
        term = terms.pop()
        if isinstance(term, ast.BinOp):
            terms += [term.right, term.left]
            continue
        name = ast.unparse(term.value if isinstance(term, ast.Subscript) else term)
        if name == "Literal" and isinstance(term, ast.Subscript):
            for each in term.slice.elts if isinstance(term.slice, ast.Tuple) else [term.slice]:
                word = ast.literal_eval(each)
                found.append((repr(word), functools.partial(_is_word, word)))
        elif name in _KINDS:
            found.append(_KINDS[name])
        elif name not in _ANY and isinstance(getattr(function, "__globals__", {}).get(name, type), type):
            found.append((f"a {name}", functools.partial(_is_a, name)))
        else:
            return []  # another name for several types
    # Text is a path there.
    return [kind for kind in found if not (_KINDS["Path"] in found and kind == _KINDS["str"])]


def _is_word(word: object, value: object) -> bool:
    return isinstance(value, str) and value == word


def _is_a(name: str, value: object) -> bool:
    return name in (each.__name__ for each in type(value).__mro__)


def _is_number(value: object) -> bool:
    try:
        return not isinstance(value, bool) and isinstance(value, Real) and float(value) is not None
    except OverflowError:
        return False


def is_masked(value: object) -> bool:
    return _is_a("MaskedArray", value)


def short_text(value: object, length: int = 60) -> str:
    try:
        return cut(str(os.fspath(value)) if isinstance(value, os.PathLike) else _SHORT.repr(value), length)
    except (TypeError, ValueError, RecursionError):
        return f"a {type(value).__name__}"


def is_path(value: object) -> bool:
    """Return True if ``value`` can be a path: not empty (the working folder), and not longer than Linux allows."""
    try:
        text = os.fspath(value)  # type: ignore[call-overload]
        data = os.fsencode(text) if isinstance(text, str) else b""
    except (TypeError, UnicodeEncodeError):
        return False
    short = len(data) <= _LONGEST_PATH and all(len(name) <= _LONGEST_NAME for name in data.split(os.sep.encode()))
    return bool(data) and b"\0" not in data and short
