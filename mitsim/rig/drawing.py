"""A drawing or scan of a mask: a picture's path in, its transmissions out."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.imagefile import image_size, own_end, read_image
from mitsim.core.imagelist import Wanted
from mitsim.rig.plate import LARGEST

_DRAWING = Wanted("mask drawing", most=LARGEST, bits=(1, 2, 4, 8, 16, 32))
"""2 and 4 bits are read as 8, in which white is the same."""
_PICTURES = ".png", ".tif", ".tiff"
"""Files whose whole numbers are parts of white; other files hold transmissions."""


def read_drawing(path: Path) -> FloatArray:
    """(rows, columns) transmissions, 0 to 1, of the drawing ``path``; a picture's values are linear in transmission.

    Row 0 is at the top and column 0 at the left of who looks from the sensor toward the scene. MitsimError for a file
    that is no PNG, TIFF, NPY or OpenEXR, has colours, transparency or several pages, or numbers outside 0 to 1.
    """
    rows, columns = image_size(path, _DRAWING)
    if (rows - columns) % 2 and 2 * max(rows, columns) > LARGEST:
        raise _DRAWING.refusal(
            path,
            f"{rows} x {columns} pixels: about its centre the shorter side needs half a pixel, so features become half "
            f"as large, of which {LARGEST} a side are allowed; make its sides differ by an even number",
        )
    values = read_image(path, _DRAWING)
    white = own_end(values) if path.suffix.lower() in _PICTURES else None
    transmissions = np.asarray(values, dtype=np.float64) / (white or 1.0)
    if transmissions.min() < 0 or transmissions.max() > 1:
        raise _DRAWING.refusal(path, "has values outside 0 to 1; give transmissions")
    return transmissions


def squared(values: FloatArray, feature_mm: float) -> tuple[float, FloatArray]:
    """A drawing ``values`` (rows, columns) of pixels of ``feature_mm`` with opaque margins that make it square about
    its centre, and before it the side of its pixels: half of that where the margins need half a pixel."""
    if (values.shape[0] - values.shape[1]) % 2:
        values, feature_mm = values.repeat(2, axis=0).repeat(2, axis=1), feature_mm / 2
    side = max(values.shape)
    margins = [((side - own) // 2,) * 2 for own in values.shape]
    return feature_mm, np.pad(values, margins)
