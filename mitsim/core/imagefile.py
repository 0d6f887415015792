"""Frames of other programs, as PNG, TIFF, NPY or OpenEXR: a path in; size, or digital numbers as stored, out."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mitsim.core.errors import MitsimError
from mitsim.core.exr import read_header
from mitsim.core.framefile import read_frame
from mitsim.core.plainfile import check_plain

if TYPE_CHECKING:
    from PIL.Image import Image

SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".exr")
"""Endings of files that are read, in small or capital letters."""
_GREY = ("L", "I;16", "I;16L", "I;16B", "I", "F")
"""Pillow's names of one channel of 8, 16 or 32 bits; it has none for one of 12, which it reads as 16."""
_LARGEST_SIDE = 16384
"""Pixels a side of the largest sensor."""
_WHITE_IS_ZERO, _PHOTOMETRIC = 0, 262
"""TIFF 6.0, section 3: such files store black as their largest number, and not all programs turn them round."""
_CHANNEL = "DN"


def image_size(path: Path | str) -> tuple[int, int]:
    """Rows and columns of the frame ``path``, from its header; MitsimError as :func:`read_image`."""
    path = Path(path)
    check_plain(path, "frame")
    with _told(path):
        if _suffix(path) == ".npy":
            size = _array(path).shape
        elif _suffix(path) == ".exr":
            header = read_header(path)
            size = header.height, header.width
        else:
            with _picture(path) as picture:
                size = picture.height, picture.width
    if max(size) > _LARGEST_SIDE or min(size) < 1:
        raise MitsimError(f"frame {path}: {size[0]} x {size[1]} pixels; 1 to {_LARGEST_SIDE} a side are allowed")
    return size[0], size[1]


def read_image(path: Path | str) -> npt.NDArray[Any]:
    """(rows, columns) numbers of the frame ``path`` as they are stored: one channel, no gamma, no scale.

    PNG and TIFF of 8 or 16 bits, TIFF of 32, NPY of whole or real numbers, OpenEXR with a channel `DN` or one channel.

    Raises
    ------
    MitsimError
        for a file that is missing, damaged, of another kind, in colour, of several pages, too large, or with values
        that are not finite.
    """
    path = Path(path)
    image_size(path)
    with _told(path):
        if _suffix(path) == ".npy":
            values: npt.NDArray[Any] = np.array(_array(path))
        elif _suffix(path) == ".exr":
            channels = read_frame(path)[0]
            name = _CHANNEL if _CHANNEL in channels or len(channels) > 1 else next(iter(channels))
            if name not in channels:
                raise ValueError(f"its channels are {', '.join(channels)}; {_CHANNEL}, or a single one, is needed")
            values = channels[name]
        else:
            with _picture(path) as picture:
                values = np.asarray(picture)
                # Some versions of Pillow give 16 bits of a PNG as 32.
                values = values.astype(np.uint16) if picture.format == "PNG" and picture.mode == "I" else values
        bad = np.count_nonzero(~np.isfinite(values))
        if bad:
            raise ValueError(f"{bad} values are not finite")
    return values


def own_end(values: npt.NDArray[Any]) -> float | None:
    """Largest number that a file of such ``values`` can hold: 255 or 65535; None where cameras seldom reach it."""
    return float(np.iinfo(values.dtype).max) if values.dtype.kind == "u" and values.dtype.itemsize < 4 else None


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"ends in {suffix or 'nothing'}; read are {', '.join(SUFFIXES)}")
    return suffix


def _array(path: Path) -> npt.NDArray[Any]:
    """The array in an NPY file, its numbers left on disk."""
    array = np.load(path, mmap_mode="r", allow_pickle=False)
    if array.ndim != 2 or array.dtype.kind not in "uif":
        raise ValueError(f"holds {array.dtype} of shape {array.shape}; rows x columns of numbers are needed")
    return np.asarray(array)


@contextmanager
def _picture(path: Path) -> Iterator[Image]:
    """A PNG or TIFF file, its pixels not yet read."""
    from PIL import Image  # most work reads no picture

    with warnings.catch_warnings():
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        picture = Image.open(path, formats=("PNG", "TIFF"))
    with picture:
        if picture.mode not in _GREY:
            raise ValueError(f"is of Pillow's mode {picture.mode}; one grey channel of 8, 16 or 32 bits is needed")
        if getattr(picture, "n_frames", 1) != 1:
            raise ValueError(f"has {getattr(picture, 'n_frames', 1)} pages; give each frame a file of its own")
        if getattr(picture, "tag_v2", {}).get(_PHOTOMETRIC) == _WHITE_IS_ZERO:
            raise ValueError("stores black as its largest number (TIFF's WhiteIsZero); save it with black as 0")
        yield picture


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Whatever readers raise, as one line that names the file."""
    try:
        yield
    except MitsimError:
        raise
    # Readers of damaged files raise whatever they stumble over.
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MitsimError(f"frame {path}: cannot be read ({reason}); write or copy it again") from error
