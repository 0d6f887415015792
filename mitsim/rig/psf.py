"""A picture of a point spread function in; the light that each sensor pixel gets of one point out, its sum 1.

Studies take it as a camera that shifts it (:mod:`mitsim.reconstruct.convolution`), a camera file's mask of the kind
``psf`` as a shadow that grows as the point comes nearer (:class:`mitsim.rig.profile.MaskProfile`).

Such as the picture that came with DiffuserCam (Antipa et al., Optica 5, 1, 2018; data of the repository
Waller-Lab/DiffuserCam-Tutorial, BSD 3-Clause), which mitsim does not ship: give its path.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.imagefile import image_size, read_image
from mitsim.core.imagelist import Wanted
from mitsim.core.resources import Cost, Limits

_PICTURE = Wanted("point spread function", colour=True)
_PIXEL_BYTES = 64
"""Of memory for a pixel: four colours of double precision, and as many arrays of their mean."""
_BORDER = 16
"""Width [pixels] of the frame along the picture's edges that shows the background, where the light of a point that
is centred does not reach."""


def load_psf(path: Path | str, reduce: int = 4, most: int | None = None) -> FloatArray:
    """The point spread function in a picture (PNG, TIFF, NPY, OpenEXR).

    Colours are averaged, the median of a frame along the edges is taken off as background, ``reduce`` x ``reduce``
    pixels are averaged, what is left below zero (noise around the background) is zero, and the sum is made 1.

    Parameters
    ----------
    path
        of the picture; rows first, any depth of grey, or colours of 8 bits.
    reduce
        pixels a side that become one; rows and columns that remain at the far edges are left out.
    most
        pixels a side that there may be then; None: any number.

    Raises
    ------
    MitsimError
        for a file that is no picture, has a palette or is too large, a ``reduce`` that does not fit, no light above the
        background.
    """
    path = Path(path)
    size = image_size(path, _PICTURE)
    rows, columns = (side // reduce for side in size) if reduce >= 1 else (0, 0)
    if min(rows, columns) < 1 or min(size) <= 2 * _BORDER:
        raise _PICTURE.refusal(
            path,
            f"{size[0]} x {size[1]} pixels, reduce {reduce}; it needs "
            f"more than {2 * _BORDER} pixels a side, and reduce from 1 to its shorter side",
        )
    if most is not None and max(rows, columns) > most:
        raise _PICTURE.refusal(
            path, f"{rows} x {columns} pixels; at most {most} a side make a mask, so set a larger psf_reduce"
        )
    values = _grey(path, size)
    inside = np.zeros(values.shape, dtype=bool)
    inside[_BORDER:-_BORDER, _BORDER:-_BORDER] = True
    above = values - np.median(values[~inside])
    means = above[: rows * reduce, : columns * reduce].reshape(rows, reduce, columns, reduce).mean(axis=(1, 3))
    light = np.maximum(means, 0)
    total = float(light.sum())
    if total <= 0:
        raise _PICTURE.refusal(path, "nothing is brighter than its edges; give another picture")
    return np.asarray(light / total)


def _grey(path: Path, size: tuple[int, int]) -> FloatArray:
    rows, columns = size
    Cost(memory_bytes=rows * columns * _PIXEL_BYTES).check(f"point spread function {path}", Limits())
    values = np.asarray(read_image(path, _PICTURE), dtype=np.float64)
    return values if values.ndim == 2 else np.asarray(values[..., :3].mean(axis=2))
