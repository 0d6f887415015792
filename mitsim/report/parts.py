"""What several pages show alike: a plan in, bars of its errors and seconds out; seconds by stage, and plain data as
lines of a table."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mitsim.core.job import size_text
from mitsim.light.plan import PlanRow

_WORTH_TELLING = 0.01
"""Part of the total time below which a stage has no line of its own: its bar would be three pixels wide."""
_LEAST_ERROR = 1e-7
"""Smallest end of the scale of errors: what plans state below is rounding."""
_MOST_LISTED = 6
"""Numbers of a list that a line of a table holds."""


@dataclass(frozen=True)
class EffectBar:
    """What a plan's chart shows of an effect: its ``row``, and the widths of its two bars [%]."""

    row: PlanRow
    error: float
    seconds: float


@dataclass(frozen=True)
class PlanChart:
    """A plan as bars.

    Attributes
    ----------
    bars
        of effects that are on, or would change frames.
    idle
        rows of all others.
    decades
        powers of ten that the logarithmic scale of errors begins and ends at.
    accuracy, mark
        that was asked for, and its place on that scale [%]; None where nobody asked.
    """

    bars: tuple[EffectBar, ...]
    idle: tuple[PlanRow, ...]
    decades: tuple[int, int]
    accuracy: float | None
    mark: float | None

    @classmethod
    def of(cls, rows: Iterable[PlanRow], accuracy: float | None) -> PlanChart:
        """The chart of a plan's ``rows`` at an ``accuracy``."""
        shown = [row for row in rows if row.state != "off" or row.error_if_off]
        errors = [max(row.error_if_off, _LEAST_ERROR) for row in shown if row.error_if_off]
        errors += [accuracy] if accuracy else []
        low, high = (math.floor(math.log10(min(errors))), math.ceil(math.log10(max(errors)))) if errors else (-6, 0)
        high = max(high, low + 1)

        def place(error: float | None) -> float:
            """Of an error on the scale [%]."""
            return 100 * (math.log10(max(error, 10.0**low)) - low) / (high - low) if error else 0.0

        longest = max((row.seconds for row in shown), default=0.0) or math.inf
        bars = (EffectBar(row, place(row.error_if_off), 100 * row.seconds / longest) for row in shown)
        idle = tuple(row for row in rows if row not in shown)
        return cls(tuple(bars), idle, (low, high), accuracy, place(accuracy) if accuracy else None)

    @property
    def costly(self) -> bool:
        """Whether any effect takes time."""
        return any(bar.row.seconds for bar in self.bars)


def plan_rows(plan: Mapping[str, Any] | None) -> tuple[PlanRow, ...]:
    """Rows of a ``plan`` as a manifest holds it; those that others wrote in another form are left out."""
    listed = (plan or {}).get("effects")
    rows = []
    for each in listed if isinstance(listed, list) else ():
        match each:
            case {
                "name": str(name),
                "state": ("exact" | "approximate" | "off") as state,
                "reason": str(reason),
                "error_if_off": (float() | int() | None) as error,
                "seconds": (float() | int()) as seconds,
            }:
                rows.append(PlanRow(name, state, reason, error, seconds))
    return tuple(rows)


def stages_of(seconds: Mapping[str, float]) -> dict[str, float]:
    """Seconds of each stage that is worth telling, and as "all else" what the total of ``seconds`` holds beside."""
    stages = {name: value for name, value in seconds.items() if name != "total"}
    total = total_of(seconds)
    reported = {name: value for name, value in stages.items() if value >= _WORTH_TELLING * total}
    rest = total - math.fsum(reported.values())
    return reported | ({"all else": rest} if stages and rest > _WORTH_TELLING * total else {})


def total_of(seconds: Mapping[str, float]) -> float:
    """The total of ``seconds`` by stage, stated or added up."""
    return seconds.get("total", math.fsum(seconds.values()))


def lines_of(data: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Plain data as lines of a table, by name; long lists and what is None are left out.

    Parameters
    ----------
    data
        as JSON holds it.
    prefix
        before the names.
    """
    lines: dict[str, str] = {}
    for key, value in data.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            lines |= lines_of(value, f"{name}.")
        elif isinstance(value, Sequence) and not isinstance(value, str):
            plain = not any(isinstance(each, (Mapping, list, tuple)) for each in value)
            if value and plain and len(value) <= _MOST_LISTED:
                lines[name] = ", ".join(map(_text, value))
        elif value is not None:
            lines[name] = size_text(value) if key.endswith("_bytes") else _text(value)
    return lines


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
