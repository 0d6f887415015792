"""A picture to be printed on a sheet: a file in, the reflectance of each of its pixels out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.files import check_plain
from mitsim.core.imagelist import JPEG, PRINTS, Wanted
from mitsim.core.images import own_end, read_image

_JPEG_SIDE = 16384
"""Pixels a side of the largest JPEG that is read, as of other pictures."""
_MOST_SIDE = 4096
"""Texels a side of a print: 0.03 mm of a sheet of 128 mm, a thirtieth of a projector pixel; four fill the texels that a
scene may have (:data:`mitsim.scene.headers.MOST_TEXELS`)."""


def read_reflectance(path: Path) -> FloatArray:
    """Reflectances of a picture's pixels: its numbers as they are stored, without a gamma curve.

    Whole numbers of 8 or 16 bits are divided by 255 or 65 535; real ones, and whole ones of more bits, are reflectances
    as they are. Of colours the mean is taken. A JPEG is turned as it is to be shown.

    Parameters
    ----------
    path
        of a PNG, TIFF, NPY, OpenEXR or JPEG file.

    Returns
    -------
    (rows, columns), 0 to 1.

    Raises
    ------
    MitsimError
        for a file that cannot be read, one with transparent pixels, and numbers that are no reflectances.
    """
    suffix = path.suffix.lower()
    if suffix not in PRINTS:
        raise MitsimError(f"picture {path}: ends in {suffix or 'nothing'}; read are {', '.join(PRINTS)}")
    values = _read_jpeg(path) if suffix in JPEG else read_image(path, Wanted("picture", colour=True))
    grey = np.asarray(values, dtype=np.float64) / (own_end(values) or 1.0)
    if grey.ndim == 3:
        if (grey[..., 3:] < 1).any():
            raise MitsimError(f"picture {path}: has transparent pixels; lay it on a ground, and save it without")
        grey = grey[..., :3].mean(axis=2)
    if not (np.isfinite(grey).all() and grey.min() >= 0 and grey.max() <= 1):
        raise MitsimError(f"picture {path}: its numbers reach from {grey.min():g} to {grey.max():g}; give 0 to 1")
    return np.asarray(grey)


def _read_jpeg(path: Path) -> npt.NDArray[np.uint8]:
    from PIL import Image, ImageOps

    check_plain(path, "picture")
    try:
        with Image.open(path, formats=("JPEG",)) as picture:
            if max(picture.size) > _JPEG_SIDE:
                raise MitsimError(f"picture {path}: {picture.size} pixels; at most {_JPEG_SIDE} a side are read")
            return np.asarray(ImageOps.exif_transpose(picture).convert("RGB"))
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        raise MitsimError(f"picture {path}: cannot be read as a JPEG ({error}); write it again") from error


def fit_square(reflectance: FloatArray) -> FloatArray:
    """A picture in the middle of a square: as high to wide as it is, black beside or above and below it.

    Parameters
    ----------
    reflectance
        (rows, columns), 0 to 1; of over 4096 pixels a side equal blocks of pixels become their mean first.

    Returns
    -------
    (k, k), 0 to 1, k the larger of its sides.
    """
    block = -(-max(reflectance.shape) // _MOST_SIDE)
    if block > 1:
        for axis, size in enumerate(reflectance.shape):
            starts = np.arange(0, size, block)
            counts = np.diff(np.append(starts, size))
            sums = np.add.reduceat(reflectance, starts, axis=axis)
            reflectance = sums / (counts[:, None] if axis == 0 else counts)
    rows, columns = reflectance.shape
    side = max(rows, columns)
    square = np.zeros((side, side))
    top, left = (side - rows) // 2, (side - columns) // 2
    square[top : top + rows, left : left + columns] = reflectance
    return square
