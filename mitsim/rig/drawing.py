"""A drawing or scan of a mask: a PNG, TIFF or NPY file in, its transmissions out."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.plainfile import check_plain
from mitsim.rig.plate import LARGEST

ENDINGS = ".png", ".tif", ".tiff", ".npy"
_WHITE = {"1": 1, "L": 255, "I;16": 65535, "I;16B": 65535, "I;16L": 65535, "F": 1}
"""The value of full transmission by Pillow's mode: bits, 8 and 16 bits, and real numbers."""


def read_drawing(path: Path) -> FloatArray:
    """(rows, columns) transmissions, 0 to 1, of the drawing ``path``; a picture's values are linear in transmission.

    Row 0 is at the top and column 0 at the left of who looks from the sensor toward the scene. MitsimError for a file
    that is no PNG, TIFF or NPY, has colours, transparency or several pages, or numbers outside 0 to 1.
    """
    check_plain(path, "mask drawing")
    if path.suffix.lower() not in ENDINGS:
        raise MitsimError(f"mask drawing {path}: ends in {path.suffix!r}; give a file {', '.join(ENDINGS)}")
    try:
        values = _array(path) if path.suffix.lower() == ".npy" else _picture(path)
    except (OSError, ValueError, SyntaxError, EOFError) as error:
        raise MitsimError(f"mask drawing {path}: {' '.join(str(error).split())}; draw or copy it again") from error
    if not (np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1):
        raise MitsimError(f"mask drawing {path}: has values outside 0 to 1; give transmissions")
    return values


def _picture(path: Path) -> FloatArray:
    # Imported here: most cameras have no drawing.
    from PIL import Image

    try:
        with Image.open(path, formats=("PNG", "TIFF")) as picture:
            _check_size(*picture.size)
            if getattr(picture, "n_frames", 1) > 1 or picture.mode not in _WHITE or "transparency" in picture.info:
                raise ValueError(f"is a picture of mode {picture.mode}; one grey page without transparency is read")
            return np.asarray(picture, dtype=np.float64) / _WHITE[picture.mode]
    except Image.DecompressionBombError as error:
        raise ValueError("is too large") from error


def _array(path: Path) -> FloatArray:
    array = np.load(path, mmap_mode="r", allow_pickle=False)
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.dtype.kind not in "biuf":
        raise ValueError("is no array of two dimensions of real numbers")
    _check_size(*array.shape)
    return np.array(array, dtype=np.float64)


def _check_size(*size: int) -> None:
    if not 1 <= min(size) <= max(size) <= LARGEST:
        raise ValueError(f"has {' x '.join(map(str, size))} pixels; 1 to {LARGEST} a side are read")


def squared(values: FloatArray, feature_mm: float) -> tuple[float, FloatArray]:
    """A drawing ``values`` (rows, columns) of pixels of ``feature_mm`` with opaque margins that make it square about
    its centre, and before it the side of its pixels: half of that where the margins need half a pixel."""
    if (values.shape[0] - values.shape[1]) % 2:
        values, feature_mm = values.repeat(2, axis=0).repeat(2, axis=1), feature_mm / 2
    side = max(values.shape)
    margins = [((side - own) // 2,) * 2 for own in values.shape]
    return feature_mm, np.pad(values, margins)
