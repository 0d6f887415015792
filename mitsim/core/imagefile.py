"""Pictures of other programs, as PNG, TIFF, NPY, OpenEXR or bare numbers: a path in; size, or numbers as stored, out.

Nothing is scaled, inverted or made grey: a file whose numbers its reader would change is refused.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mitsim.core.errors import MitsimError
from mitsim.core.imagelist import BARE, FORMATS, FRAME, Wanted
from mitsim.core.plainfile import check_plain

if TYPE_CHECKING:
    from PIL.Image import Image

Numbers = npt.NDArray[Any]
"""(rows, columns) numbers of a picture: whole, or real; where colours are wanted, (rows, columns, 3 or 4)."""
_SIGNATURE, _HEAD = b"\x89PNG\r\n\x1a\n", 26
"""First bytes of a PNG, and bytes up to its colour type (ISO/IEC 15948, 5.2 and 11.2.2)."""
_PNG_BITS = (1, 2, 4, 8, 16)
"""Of a grey number in a PNG."""
_GREY, _COLOURS = 0, (2, 6)
"""Colour types of a PNG: one number a pixel; red, green, blue, without and with alpha."""
_BITS, _PHOTOMETRIC, _SAMPLES = 258, 262, 339
"""Tags of TIFF 6.0: BitsPerSample, PhotometricInterpretation, SampleFormat."""
_BLACK_IS_ZERO, _RGB = 1, 2
"""PhotometricInterpretation of files that are read; 0 stores black as the largest number."""
_UNSIGNED = 1
"""SampleFormat of whole numbers from 0, which is also meant where the tag is missing."""
_CHANNEL = "DN"
"""Channel of an OpenEXR file of several that is read."""


@dataclass(frozen=True)
class _Found:
    """What a file's header says: pages, size of the first, and what reads the numbers of each page."""

    pages: int
    size: tuple[int, int]
    read: Callable[[], Iterator[Numbers]]


def image_size(path: Path | str, wanted: Wanted = FRAME) -> tuple[int, int]:
    """Rows and columns of a picture, from its header; of several pages, of the first.

    Parameters
    ----------
    path, wanted
        as for :func:`read_images`, whose errors it raises.
    """
    path = Path(path)
    with _told(path, wanted):
        return _look(path, wanted).size


def read_image(path: Path | str, wanted: Wanted = FRAME) -> Numbers:
    """Numbers of a picture of one page.

    Parameters
    ----------
    path, wanted
        as for :func:`read_images`.

    Raises
    ------
    MitsimError
        as there, and for several pages.
    """
    path = Path(path)
    with _told(path, wanted):
        pages = _look(path, wanted).pages
    if pages != 1:
        raise wanted.refusal(path, f"has {pages} pages; give each {wanted.what} a file of its own")
    return next(read_images(path, wanted))


def read_images(path: Path | str, wanted: Wanted = FRAME) -> Iterator[Numbers]:
    """Numbers of every page of a picture as they are stored: no gamma, no scale.

    PNG, TIFF (of one page or more), NPY of whole or real numbers (rows x columns, or pages before them), OpenEXR with a
    channel `DN` or one channel, and bare numbers.

    Parameters
    ----------
    path
        of the file.
    wanted
        what is read.

    Raises
    ------
    MitsimError
        for a file that is missing, damaged, of another kind or size, in colours that are not wanted, with numbers that
        its reader would change, or that are not finite.
    """
    path = Path(path)
    with _told(path, wanted):
        for values in _look(path, wanted).read():
            _check_size(path, wanted, values.shape[0], values.shape[1])
            bad = np.count_nonzero(~np.isfinite(values))
            if bad:
                raise wanted.refusal(path, f"{bad} values are not finite; write it again")
            yield values.astype(values.dtype.newbyteorder("="), copy=False)


def own_end(values: Numbers) -> float | None:
    """Largest number that a file of such ``values`` can hold: 255 or 65535; None where cameras seldom reach it."""
    return float(np.iinfo(values.dtype).max) if values.dtype.kind == "u" and values.dtype.itemsize < 4 else None


def _look(path: Path, wanted: Wanted) -> _Found:
    """What the header of a file says, before pixels are read: what it claims is allocated."""
    check_plain(path, wanted.what)
    ending = path.suffix.lower()
    if ending not in _READERS:
        raise wanted.refusal(path, f"ends in {ending or 'nothing'}; read are {', '.join(_READERS)}")
    found = _READERS[ending](path, wanted)
    _check_size(path, wanted, *found.size)
    return found


def _check_size(path: Path, wanted: Wanted, rows: int, columns: int) -> None:
    if not (0 < rows <= wanted.most and 0 < columns <= wanted.most):
        raise wanted.refusal(path, f"{rows} x {columns} pixels; 1 to {wanted.most} a side are allowed")


def _png(path: Path, wanted: Wanted) -> _Found:
    with open(path, "rb") as file:
        head = file.read(_HEAD)
    if len(head) < _HEAD or not head.startswith(_SIGNATURE):
        raise ValueError("it does not begin as a PNG")
    columns, rows = (int.from_bytes(head[place : place + 4], "big") for place in (16, 20))
    bits, colour = head[24], head[25]
    if not (colour == _GREY and bits in wanted.bits) and not (wanted.colour and colour in _COLOURS and bits == 8):
        raise wanted.refusal(
            path, f"is no {_allowed('PNG', (bits for bits in wanted.bits if bits in _PNG_BITS), wanted)}"
        )

    def read() -> Iterator[Numbers]:
        """Its one page."""
        with _opened(path, "PNG") as picture:
            if "transparency" in picture.info:
                raise wanted.refusal(path, "names a number that is transparent; save it without transparency")
            # Some versions of Pillow give 16 bits of a PNG as 32.
            yield np.array(picture).astype(bool if bits == 1 else np.uint8 if bits <= 8 else np.uint16)

    return _Found(1, (rows, columns), read)


def _tiff(path: Path, wanted: Wanted) -> _Found:
    def read() -> Iterator[Numbers]:
        """Its pages."""
        from PIL import ImageSequence

        with _opened(path, "TIFF") as file:
            for picture in ImageSequence.Iterator(file):
                unsigned = _check_tags(path, picture, wanted)
                _check_size(path, wanted, picture.height, picture.width)
                values = np.array(picture)
                # Pillow holds 32 bits as if they had a sign.
                yield values.view(np.uint32) if unsigned and values.dtype == np.int32 else values

    with _opened(path, "TIFF") as picture:
        _check_tags(path, picture, wanted)
        return _Found(getattr(picture, "n_frames", 1), (picture.height, picture.width), read)


def _check_tags(path: Path, picture: Image, wanted: Wanted) -> bool:
    """Whether numbers of a page of a TIFF ``picture`` have no sign; MitsimError for a page that is not ``wanted``."""
    tags: Any = picture.tag_v2  # type: ignore[attr-defined]
    bits, photometric, samples = tags.get(_BITS, (1,)), tags.get(_PHOTOMETRIC), tags.get(_SAMPLES, (_UNSIGNED,))
    grey = photometric == _BLACK_IS_ZERO and len(bits) == 1 and bits[0] in wanted.bits
    if not grey and not (wanted.colour and photometric == _RGB and set(bits) == {8}):
        raise wanted.refusal(path, f"is no {_allowed('TIFF', wanted.bits, wanted)}")
    return bool(samples[0] == _UNSIGNED)


def _npy(path: Path, wanted: Wanted) -> _Found:
    array = np.load(path, mmap_mode="r", allow_pickle=False)
    kinds = "buif" if 1 in wanted.bits else "uif"
    if not isinstance(array, np.ndarray) or array.ndim not in (2, 3) or array.dtype.kind not in kinds:
        told = f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else "several arrays"
        raise wanted.refusal(path, f"holds {told}; rows x columns of numbers are needed, or pages of them")
    pages = array if array.ndim == 3 else array[None]
    return _Found(len(pages), (pages.shape[1], pages.shape[2]), lambda: (np.array(page) for page in pages))


def _exr(path: Path, wanted: Wanted) -> _Found:
    from mitsim.core.exr import read_header  # most work reads no picture of this kind
    from mitsim.core.framefile import read_frame

    header = read_header(path)

    def read() -> Iterator[Numbers]:
        """Its one page."""
        channels = read_frame(path)[0]
        name = _CHANNEL if _CHANNEL in channels or len(channels) > 1 else next(iter(channels))
        if name not in channels:
            names = ", ".join(channels)
            raise wanted.refusal(path, f"its channels are {names}; {_CHANNEL}, or a single one, is needed")
        yield channels[name]

    return _Found(1, (header.height, header.width), read)


def _bare(path: Path, wanted: Wanted) -> _Found:
    raw = wanted.raw
    if raw is None:
        raise wanted.refusal(path, "has no header; say how it is read by shape and bits")
    needed, size = math.prod(raw.shape) * raw.kind.itemsize, path.stat().st_size
    if size != needed:
        raise wanted.refusal(
            path,
            f"has {size} bytes, but {raw.shape[0]}x{raw.shape[1]} numbers of {raw.bits} bits take {needed}; "
            "correct shape or bits",
        )

    def read() -> Iterator[Numbers]:
        """Its one page."""
        values = np.fromfile(path, raw.kind).reshape(raw.shape)
        if values.max() >= 2**raw.bits:
            most = values.max()
            raise wanted.refusal(path, f"has the number {most}, beyond {raw.bits} bits; correct bits or byte_order")
        yield values

    return _Found(1, raw.shape, read)


_READERS: dict[str, Callable[[Path, Wanted], _Found]] = {
    **dict(zip(FORMATS, (_png, _tiff, _tiff, _npy, _exr), strict=True)),
    **dict.fromkeys(BARE, _bare),
}
"""What looks into a file, by the end of its name in small letters."""


def _allowed(kind: str, bits: Any, wanted: Wanted) -> str:
    numbers = [str(count) for count in bits]
    colours = ", nor of red, green and blue of 8 bits" if wanted.colour else ""
    zero = " whose zero is black" if kind == "TIFF" else ""
    return f"grey {kind} of {', '.join(numbers[:-1])} or {numbers[-1]} bits{zero}{colours}; save one number a pixel"


@contextmanager
def _opened(path: Path, kind: str) -> Iterator[Image]:
    """A picture file of that ``kind``, its pixels not yet read."""
    from PIL import Image  # most work reads no picture

    with warnings.catch_warnings():
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        picture = Image.open(path, formats=(kind,))
    with picture:
        yield picture


@contextmanager
def _told(path: Path, wanted: Wanted) -> Iterator[None]:
    """Whatever readers raise, as one line that names the file."""
    try:
        yield
    except MitsimError:
        raise
    # Readers of damaged files raise whatever they stumble over.
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise wanted.refusal(
            path, f"cannot be read: damaged, or of another kind than its name says ({reason}); write or copy it again"
        ) from error
