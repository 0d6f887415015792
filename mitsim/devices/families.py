"""Names of pattern families: a text such as ``dots:7`` in, the family and its periods out; no patterns are made."""

from __future__ import annotations

from mitsim.core.errors import MitsimError
from mitsim.devices.hadamard import way_to

_FAMILIES = ("uniform", "dots", "hadamard", "random")
NAMES = "uniform, dots:K, dots:RxC, hadamard:K or random:K"
"""How families are called."""
_MOST_ORDER = 4096
"""Hadamard orders that are looked up before the projector's pixels are known; patterns have no more a side."""
_MOST_DIGITS = 9
"""Digits of K that are read; no projector has 1e9 pixels a side."""


def check_patterns(text: str) -> str:
    """The ``text``, where it names a family that some projector has; MitsimError as :func:`read_name`."""
    read_name(text, None)
    return text


def read_name(text: str, n: int | None) -> tuple[str, list[int]]:
    """Family and periods (one, or those of rows and of columns) of the patterns ``text``, for ``n`` projector pixels a
    side; None: any number.

    Raises
    ------
    MitsimError
        for an unknown family, a K that is not a whole number, or K outside 1..n, and a Hadamard matrix of an order
        that is not known.
    """
    name, colon, size = text.partition(":")
    if name not in _FAMILIES or (name == "uniform") == bool(colon) or bool(colon) != bool(size):
        raise MitsimError(f"patterns {text!r}: use {NAMES}")
    rows, _, columns = size.partition("x")
    both = [rows, columns] if name == "dots" and rows and columns else [size or "1"]
    periods = [_period(text, period, n) for period in both]
    if name == "hadamard" and periods[0] <= _MOST_ORDER:
        way_to(periods[0])
    return name, periods


def shot_count(text: str) -> int:
    """How many shots the patterns ``text`` take, two of each with the value -1. MitsimError as :func:`read_name`."""
    name, periods = read_name(text, None)
    signs = 2 if name == "hadamard" and periods[0] > 1 else 1
    return periods[0] * periods[-1] * signs


def _period(text: str, size: str, n: int | None) -> int:
    """K of the patterns ``text``, written as ``size``, for ``n`` projector pixels a side, or any number of them."""
    most = "the projector's pixels a side" if n is None else n
    if not (size.isascii() and size.isdigit() and len(size) <= _MOST_DIGITS):
        raise MitsimError(f"patterns {text!r}: K is {size!r}; give a whole number from 1 to {most}")
    k = int(size)
    if k < 1 or (n is not None and k > n):
        most = most if n is None else f"{n}, the projector's pixels a side"
        raise MitsimError(f"patterns {text!r}: K is {k}; give 1 to {most}")
    return k
