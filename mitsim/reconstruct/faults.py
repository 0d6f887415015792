"""What may be wrong with frames, of captures and of calibration sessions, and how it is said."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from enum import Enum, auto
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.devices.session import UNIFORM, Half, Side

# ---- Frames of a capture ---------------------------------------------------------------------------------------------


class Fault(Enum):
    """What may be wrong with frames of a capture."""

    BLACK = auto()
    DIM = auto()
    BRIGHT = auto()
    REPEATED = auto()
    SWAPPED = auto()
    """Two frames are in each other's place."""
    MISPLACED = auto()
    """It holds the light of another pattern."""
    HALF_LOST = auto()
    SHIFTED = auto()
    CLIPPED = auto()
    NOISELESS = auto()
    FLICKER = auto()
    """The lamp's power differs from frame to frame."""


@dataclass(frozen=True)
class FrameFault:
    """A ``fault`` of the shots of some ``numbers``, in ``files``, from 0 in the manifest's order; ``words`` say it."""

    fault: Fault
    numbers: tuple[int, ...]
    files: tuple[str, ...]
    words: str

    def __str__(self) -> str:
        return self.words

    def summary(self) -> dict[str, Any]:
        """For result.json."""
        return {
            "fault": self.fault.name.lower(),
            "frames": list(self.numbers),
            "files": list(self.files),
            "words": self.words,
        }


def frame_list(numbers: tuple[int, ...], files: tuple[str, ...]) -> str:
    """Frames by their ``numbers`` and ``files``, the first few."""
    shown = ", ".join(f"{number} ({file})" for number, file in zip(numbers[:4], files[:4], strict=True))
    more = f" and {len(numbers) - 4} more" if len(numbers) > 4 else ""
    return f"frame{'s' if len(numbers) > 1 else ''} {shown}{more}"


# ---- Frames of a calibration session ---------------------------------------------------------------------------------


DARK = 0.03
"""Light of a black frame, as a part of what it should have: stray light and the projector's own black level."""


def robust_scatter(values: FloatArray, middle: float = 0.0) -> float:
    """Standard deviation of normal ``values`` about their ``middle``, by the median, which a few others do not move."""
    return 1.4826 * float(np.median(np.abs(values - middle)))


@dataclass(frozen=True)
class SessionFault:
    """One pattern, or one of its frames, that is not what it should be.

    Attributes
    ----------
    side, index
        of the pattern.
    sign
        of the frame; None: both frames.
    kind
        ``black``, ``dim``, ``bright``, ``half lost``, ``repeated``, ``shifted``, ``clipped``, ``exchanged``,
        ``swapped``, ``wrong``.
    detail
        the same in words, after the frame's name.
    other
        the frame that it repeats, or the pattern that it is swapped with.
    repair
        what is done about it, in words.
    cost
        relative error of its factor that this leaves beyond the noise.
    """

    side: Side
    index: int
    sign: int | None
    kind: str
    detail: str
    repair: str
    other: Half | None = None
    cost: float = 0.0

    def _names(self, name: Callable[[Half], str], index: int) -> list[str]:
        """Names of a pattern's frames, both or that of its sign."""
        return [name((self.side, index, sign)) for sign in ((1, -1) if self.sign is None else (self.sign,))]

    def words(self, name: Callable[[Half], str]) -> str:
        """A sentence; ``name`` says which frame it is."""
        others = []
        if self.other is not None:
            others = self._names(name, self.other[1]) if self.other[2] == UNIFORM else [name(self.other)]
        other = f" ({' and '.join(others)})" if others else ""
        cost = f", at a factor error of {self.cost:.1e}" if self.cost else ""
        names = " and ".join(self._names(name, self.index))
        return f"frames: {names}: {self.detail}{other}; {self.repair}{cost}"

    def listed(self, name: Callable[[Half], str]) -> dict[str, Any]:
        """The same for a manifest; ``name`` says which frame it is."""
        return {"frames": self._names(name, self.index), **asdict(self)}


@dataclass(frozen=True)
class Lamp:
    """How the projector's power changes over the session.

    Attributes
    ----------
    drift
        from the session's begin to its end, as a part of its mean.
    flicker
        from frame to frame, rms, as a part of it.
    drift_cost, flicker_cost
        relative error of both factors that each would leave, or leaves, in them.
    remaining
        the error that is left after correction.
    corrected
        whether factors are corrected for it.
    """

    drift: float = 0.0
    flicker: float = 0.0
    drift_cost: float = 0.0
    flicker_cost: float = 0.0
    remaining: float = 0.0
    corrected: bool = False

    def listed(self) -> dict[str, float] | None:
        """The same for a manifest; None of a steady one."""
        return asdict(self) if self.drift or self.flicker else None

    def warnings(self) -> Iterator[str]:
        """What is said of an unsteady lamp."""
        left = "frames are divided by its power" + (f", and {self.remaining:.1e} is left" if self.remaining else "")
        left = left if self.corrected else "its error is in what is stated"
        if self.drift:
            yield (
                f"lamp: its power drifts by {self.drift:+.1%} over the session, a factor error of "
                f"{self.drift_cost:.1e} if nothing is done; {left}: let it warm up"
            )
        if self.flicker:
            yield (
                f"lamp: its power flickers by {self.flicker:.2%} from frame to frame, a factor error of "
                f"{self.flicker_cost:.1e} if nothing is done; {left}: use a steadier one, or expose for whole periods"
            )


def frame_words(half: Half) -> str:
    """Which frame of a session a ``half`` is, in words."""
    side, index, sign = half
    return f"{side} stripes {index} of sign {sign:+d}" if sign != UNIFORM else f"{side} stripes {index}"


def name_by_light(part: float) -> tuple[str, str]:
    """Kind and words of a frame with a ``part`` of its light."""
    kind = "dim" if part < 1 else "bright"
    return kind, f"is {kind}: it has {part:.3g} of its light"
