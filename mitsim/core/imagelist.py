"""Which pictures are read, and how: a folder in, its files in the order of their numbers out; none is opened."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from mitsim.core.configuration import Configuration
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.files import MOST_SIDE, check_plain

if TYPE_CHECKING:
    import numpy as np

FORMATS = (".png", ".tif", ".tiff", ".npy", ".exr")
"""Endings of files that say themselves what they hold."""
BARE = (".raw", ".bin", ".dat")
"""Endings of files without a header."""
_Side = Annotated[int, Field(ge=1, le=MOST_SIDE)]


class Raw(Configuration):
    """How files without a header (`.raw`, `.bin`, `.dat`) are read."""

    shape: tuple[_Side, _Side] = Field(strict=False)
    """Rows and columns."""
    bits: int = Field(ge=1, le=32)
    """Of a number; up to 8 take a byte, up to 16 two, up to 32 four."""
    byte_order: Literal["little", "big"] = "little"
    """Which byte of a number comes first."""

    @classmethod
    def of(cls, shape: str, bits: int | None, byte_order: str) -> Raw:
        """From what the command line says.

        Parameters
        ----------
        shape
            ROWSxCOLUMNS.
        bits, byte_order
            as the class has them.

        Raises
        ------
        MitsimError
            for what is none.
        """
        sides = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", shape)
        if not sides or not all(0 < int(side) <= MOST_SIDE for side in sides.groups()):
            raise ArgumentError("shape", f"{shape!r}: give ROWSxCOLUMNS, 1 to {MOST_SIDE} each")
        if bits is None or not 1 <= bits <= 32:
            raise ArgumentError("bits", f"{bits}: give the bits of a number in such a file, 1 to 32")
        if byte_order not in ("little", "big"):
            raise ArgumentError("byte_order", f"{byte_order!r}: use little or big")
        return cls(
            shape=(int(sides[1]), int(sides[2])), bits=bits, byte_order="big" if byte_order == "big" else "little"
        )

    @property
    def kind(self) -> np.dtype[Any]:
        """The type of a number."""
        import numpy as np  # here: most who state it read no numbers

        width = 1 if self.bits <= 8 else 2 if self.bits <= 16 else 4
        return np.dtype(f"{'<' if self.byte_order == 'little' else '>'}u{width}")


@dataclass(frozen=True)
class Wanted:
    """What pictures are of, and which of them are read.

    Attributes
    ----------
    what
        that they are of, for messages.
    most
        pixels a side.
    bits
        of a number in PNG and TIFF files. Frames have none of 2 and 4, which Pillow spreads over 0 to 255.
    colour
        whether red, green and blue of 8 bits are read too.
    raw
        how files without a header are read; None: such files are refused.
    """

    what: str = "frame"
    most: int = MOST_SIDE
    bits: Sequence[int] = (8, 12, 16, 32)
    colour: bool = False
    raw: Raw | None = None

    def refusal(self, path: Path, reason: str) -> MitsimError:
        """A line that says for what ``reason`` the file ``path`` is not read."""
        return MitsimError(f"{self.what} {path}: {reason}")


FRAME = Wanted()
"""Frames of a camera, in files with a header."""


def image_files(source: Path, wanted: Wanted = FRAME) -> tuple[Path, ...]:
    """Pictures in a folder, in the order of the numbers in their names: shot 10 comes after shot 9.

    Parameters
    ----------
    source
        the folder; or a file, which is then all.
    wanted
        files without a header count where they can be read.

    Raises
    ------
    MitsimError
        where there is none.
    """
    if not source.is_dir():
        check_plain(source, wanted.what)
        return (source,)
    endings = tuple(ending for ending in (*FORMATS, *BARE) if wanted.raw or ending not in BARE)
    files = [path for path in source.iterdir() if path.suffix.lower() in endings and not path.name.startswith(".")]
    if not files:
        bare = "" if wanted.raw else f"; {', '.join(BARE)} count where shape and bits are stated"
        raise MitsimError(f"{source}: holds no file that ends in {', '.join(endings)}{bare}")
    return tuple(sorted(files, key=_natural))


def _natural(path: Path) -> tuple[list[tuple[int, str]], str]:
    """A key by which shot 10 comes after shot 9."""
    parts = re.split(r"([0-9]+)", path.name)
    return [(int(part), "") if part.isascii() and part.isdigit() else (-1, part) for part in parts], path.name
