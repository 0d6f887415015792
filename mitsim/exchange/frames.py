"""Frames that a real camera wrote in, as PNG, TIFF, NPY or bare digital numbers; digital numbers as they were out.

Nothing is scaled, inverted or made grey: a file whose numbers its reader would change is refused.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.plainfile import check_plain
from mitsim.exchange.packed import MOST_SIDE

Numbers = npt.NDArray[Any]
"""(rows, columns) digital numbers: whole, or of a camera with real output."""
_PNG_DEPTHS, _TIFF_DEPTHS = (8, 16), (8, 12, 16, 32)
"""Bits of a pixel whose numbers Pillow leaves as they are; it spreads fewer over 0 to 255."""
_BITS, _PHOTOMETRIC = 258, 262
"""Tags of TIFF 6.0: BitsPerSample, and PhotometricInterpretation, whose 1 is a black zero."""
_HEAD = 33
"""Bytes of a PNG's signature and first chunk."""


@dataclass(frozen=True)
class Raw:
    """How files without a header are read.

    Attributes
    ----------
    shape
        rows and columns.
    bits
        of a number; up to 8 take a byte, up to 16 two, up to 32 four.
    byte_order
        which byte of a number comes first.
    """

    shape: tuple[int, int]
    bits: int
    byte_order: Literal["little", "big"] = "little"

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
        return cls((int(sides[1]), int(sides[2])), bits, "little" if byte_order == "little" else "big")

    @property
    def kind(self) -> np.dtype[Any]:
        """The type of a number."""
        width = 1 if self.bits <= 8 else 2 if self.bits <= 16 else 4
        return np.dtype(f"{'<' if self.byte_order == 'little' else '>'}u{width}")


def frame_files(source: Path) -> tuple[Path, ...]:
    """The files of frames in the folder ``source``, or that file itself, in the order of the numbers in their names.

    MitsimError where there is none.
    """
    if not source.is_dir():
        check_plain(source)
        return (source,)
    files = [path for path in source.iterdir() if path.suffix.lower() in READERS and not path.name.startswith(".")]
    if not files:
        raise MitsimError(f"{source}: holds no file that ends in {', '.join(READERS)}")
    return tuple(sorted(files, key=_natural))


def frames_in(path: Path, raw: Raw | None) -> Iterator[Numbers]:
    """Digital numbers of every frame in a file.

    Parameters
    ----------
    path
        of the file; `.npy` and TIFF may hold several frames.
    raw
        how it is read if it has no header.

    Raises
    ------
    MitsimError
        for a file that is damaged, is not monochrome, or whose numbers would not be read as they are.
    """
    check_plain(path)
    try:
        found = list(READERS[path.suffix.lower()](path, raw))
    except MitsimError:
        raise
    except Exception as error:  # Pillow's readers raise of all kinds
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MitsimError(
            f"{path}: damaged, or of another kind than its name says ({reason}); save it again"
        ) from error
    for frame in found:
        if frame.ndim != 2 or not 0 < max(frame.shape) <= MOST_SIDE or 0 in frame.shape:
            raise MitsimError(f"{path}: has shape {frame.shape}; rows x columns are needed, one number a pixel")
        yield frame


def _png(path: Path, raw: Raw | None) -> Iterator[Numbers]:
    from PIL import Image

    with open(path, "rb") as file:
        head = file.read(_HEAD)
    # Width, height, bits and colour type of a PNG (ISO/IEC 15948, 11.2.2).
    if len(head) < _HEAD or head[24] not in _PNG_DEPTHS or head[25] != 0:
        raise MitsimError(f"{path}: is no grey PNG of 8 or 16 bits; save one number a pixel")
    _check_size(path, int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big"))
    with Image.open(path, formats=("PNG",)) as image:
        yield np.array(image).astype(np.uint8 if head[24] == 8 else np.uint16)


def _tiff(path: Path, raw: Raw | None) -> Iterator[Numbers]:
    from PIL import Image, ImageSequence

    with Image.open(path, formats=("TIFF",)) as file:
        for image in ImageSequence.Iterator(file):
            tags: Any = image.tag_v2  # type: ignore[attr-defined]
            bits, photometric = tags.get(_BITS, (1,)), tags.get(_PHOTOMETRIC)
            if len(bits) != 1 or bits[0] not in _TIFF_DEPTHS or photometric != 1:
                raise MitsimError(
                    f"{path}: is no grey TIFF of {', '.join(map(str, _TIFF_DEPTHS))} bits whose zero is black; "
                    "save one number a pixel"
                )
            _check_size(path, *image.size)
            values = np.array(image)
            yield values.astype(values.dtype.newbyteorder("="))


def _npy(path: Path, raw: Raw | None) -> Iterator[Numbers]:
    values = np.load(path, mmap_mode="r", allow_pickle=False)
    yield from values if values.ndim == 3 else (values,)


def _bare(path: Path, raw: Raw | None) -> Iterator[Numbers]:
    if raw is None:
        raise MitsimError(f"{path}: has no header; say how it is read by shape and bits")
    needed, size = math.prod(raw.shape) * raw.kind.itemsize, path.stat().st_size
    if size != needed:
        raise MitsimError(
            f"{path}: has {size} bytes, but {raw.shape[0]}x{raw.shape[1]} numbers of {raw.bits} bits take {needed}; "
            "correct shape or bits"
        )
    values = np.fromfile(path, raw.kind).reshape(raw.shape)
    if values.max() >= 2**raw.bits:
        raise MitsimError(f"{path}: has the number {values.max()}, beyond {raw.bits} bits; correct bits or byte_order")
    yield values.astype(raw.kind.newbyteorder("="))


READERS = {
    ".png": _png,
    ".tif": _tiff,
    ".tiff": _tiff,
    ".npy": _npy,
    **dict.fromkeys((".raw", ".bin", ".dat"), _bare),
}
"""What reads a file, by the end of its name."""


def _check_size(path: Path, width: int, height: int) -> None:
    """Before pixels are read: what a header claims is allocated."""
    if not (0 < width <= MOST_SIDE and 0 < height <= MOST_SIDE):
        raise MitsimError(f"{path}: claims {width}x{height} pixels; 1 to {MOST_SIDE} a side are allowed")


def _natural(path: Path) -> list[tuple[int, str]]:
    """A key by which shot 10 comes after shot 9."""
    return [
        (int(part), "") if part.isascii() and part.isdigit() else (-1, part)
        for part in re.split(r"([0-9]+)", path.name)
    ]
