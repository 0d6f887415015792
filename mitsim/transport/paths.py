"""What paths from the projector and paths from the camera share: launches, who finds which light, how they end."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from mitsim.transport.histogram import AMBIENT, DIRECT, INDIRECT, Deposits

_KINDS = MappingProxyType({"direct": DIRECT, "indirect": INDIRECT, "ambient": AMBIENT})
_LANES_PER_LAUNCH = 2**22
_SHARP = 1.0
"""Density [1/sr] of sampling a turn above which its light is looked for from the camera; 0.32 is a matt surface's."""
_MIRRORS = 16
_LONGEST = 0.999
"""Largest chance to go on: paths end even where nothing is absorbed.

In a closed room of reflectance rho the light of a path grows by rho / chance a reflection, and its second moment is
finite only while rho^2 < chance. A chance of 0.95 at most lost 10 % of the light at reflectance 0.99, 79 % at 0.999.
"""


def launches(lanes: int, first: int, samples: int) -> Iterator[tuple[Any, Any]]:
    """(sample, lane) of samples ``first`` .. ``first + samples - 1`` of ``lanes`` lanes each, one kernel at a time."""
    total, start = lanes * samples, lanes * first
    for done in range(0, total, _LANES_PER_LAUNCH):
        index = dr.arange(mi.UInt64, min(_LANES_PER_LAUNCH, total - done)) + dr.opaque(mi.UInt64, start + done)
        # An opaque number keeps the compiled kernel the same for every count.
        per_sample = dr.opaque(mi.UInt64, lanes)
        yield mi.UInt32(index // per_sample), mi.UInt32(index % per_sample)


def camera_part(pdf: Any) -> Any:
    """Part of the light over the last turn before the sensor that is followed from the camera; the rest is connected.

    ``pdf`` [1/sr] is that of sampling the turn from the camera's side, which both sides know, so the parts add up to
    one. A connection to a lobe sharper than ``_SHARP`` keeps ``_SHARP / pdf`` of its light: it is bounded however sharp
    the lobe. What is matt is never followed from the camera.
    """
    return dr.select(pdf > _SHARP, 1 - _SHARP * dr.rcp(pdf), 0)


def survival(strength: Any, mirrored: Any, bounce: Any) -> Any:
    """Chance that a path goes on: what it still carries; chains of mirrors are short and full of light."""
    return dr.select(mirrored & (bounce < _MIRRORS), 1, dr.minimum(dr.max(strength), _LONGEST))


@dataclass
class Reservoir:
    """Of many connections, one drawn in proportion to its light, which carries the light of all: ``value``.

    ``source`` is its projector pixel, the rest where it is filed.
    """

    value: Any
    source: Any
    tau_row: Any
    tau_column: Any
    near: Any

    @classmethod
    def empty(cls) -> Reservoir:
        """No light yet."""
        return cls(mi.Float(0), mi.UInt32(0), mi.Float(0), mi.Float(0), mi.Float(0))

    def joined_by(self, value: Any, source: Any, tau_row: Any, tau_column: Any, near: Any, rng: Any) -> Reservoir:
        """With one more connection, which stands for all with the chance of its part."""
        total = self.value + value
        new = rng.next_float32() * total < value
        mine = (self.source, self.tau_row, self.tau_column, self.near)
        chosen = (dr.select(new, a, b) for a, b in zip((source, tau_row, tau_column, near), mine, strict=True))
        return Reservoir(total, *chosen)


class Walk(ABC):
    """The paths of one launch, a lane each: the first surface apart, and all others in a loop of one kernel.

    Of each kind of light one connection a path is kept. ``STATE`` names the attributes that change on the way; the
    first tells which paths still go on.
    """

    STATE: ClassVar[tuple[str, ...]]

    def __init__(self) -> None:
        self.kept = {kind: Reservoir.empty() for kind in _KINDS}

    @abstractmethod
    def vertex(self, first: bool) -> None:
        """Find the next surface of every path, connect it, and leave it."""

    def keep(self, kind: str, value: Any, source: Any, tau_row: Any, tau_column: Any, near: Any, rng: Any) -> None:
        """Light of one connection, and where it is filed."""
        self.kept[kind] = self.kept[kind].joined_by(value, source, tau_row, tau_column, near, rng)

    def deposits(self, further: bool) -> list[Deposits]:
        """Follow every path to its end, or to the first surface only, and take its light to the host."""
        self.vertex(first=True)
        if further:
            self._load(dr.while_loop(self._values(), lambda *values: values[0], self._body, labels=self.STATE))
        dr.eval(self.kept)
        return [
            Deposits.fetched(kept.value, kept.source, kept.tau_row, kept.tau_column, kept.near, _KINDS[kind])
            for kind, kept in self.kept.items()
        ]

    def _body(self, *values: Any) -> tuple[Any, ...]:
        self._load(values)
        self.vertex(first=False)
        return self._values()

    def _values(self) -> tuple[Any, ...]:
        return tuple(getattr(self, name) for name in self.STATE)

    def _load(self, values: tuple[Any, ...]) -> None:
        for name, value in zip(self.STATE, values, strict=True):
            setattr(self, name, value)


def walked(walk: Callable[[Any, Any], Walk], lanes: int, first: int, samples: int, further: bool = True) -> Deposits:
    """Light of samples ``first`` .. ``first + samples - 1``; ``walk`` makes the paths of some (samples, lanes)."""
    parts = [walk(*one).deposits(further) for one in launches(lanes, first, samples)]
    return Deposits.joined([deposits for part in parts for deposits in part])
