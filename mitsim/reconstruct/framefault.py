"""What may be wrong with frames, and how it is said."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any


class Fault(Enum):
    """What may be wrong with frames; the value is what is said of them."""

    BLACK = "black"
    DIM = "dim"
    BRIGHT = "too bright"
    REPEATED = "a repeat of another"
    SWAPPED = "exchanged"
    MISPLACED = "of another pattern"
    HALF_LOST = "partly lost"
    SHIFTED = "shifted"
    CLIPPED = "clipped"
    NOISELESS = "free of noise"
    FLICKER = "of another lamp power each"


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


def listed(numbers: tuple[int, ...], files: tuple[str, ...]) -> str:
    """Frames by their ``numbers`` and ``files``, the first few."""
    shown = ", ".join(f"{number} ({file})" for number, file in zip(numbers[:4], files[:4], strict=True))
    more = f" and {len(numbers) - 4} more" if len(numbers) > 4 else ""
    return f"frame{'s' if len(numbers) > 1 else ''} {shown}{more}"
