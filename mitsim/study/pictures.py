"""Eight test images, as the paper's means are over eight: names in, pictures to print on a sheet out.

They come with scikit-image, which states their licences: the paper does not name its own.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mitsim.core.errors import MitsimError

TEST_IMAGES = ("astronaut", "camera", "chelsea", "coffee", "coins", "rocket", "page", "brick")
"""Portraits, an animal, things, a page of text and a texture."""
QUICK_IMAGES = ("chelsea", "page")
"""For a first look: fur and letters."""
SIDE = 512
"""Pixels a side: four of each of 128 projector pixels."""
_INK, _PAPER = 0.05, 0.90
"""Reflectances of black and white print, as on the shipped scenes."""


def picture(name: str) -> npt.NDArray[np.uint8]:
    """(512, 512) eight-bit reflectance of the test image ``name``: the middle square of it, grey.

    MitsimError for another name.
    """
    from skimage import data
    from skimage.transform import resize

    if name not in TEST_IMAGES:
        raise MitsimError(f"picture {name!r}: use {', '.join(TEST_IMAGES)}")
    image = np.asarray(getattr(data, name)(), dtype=np.float64)
    grey = image.mean(axis=2) if image.ndim == 3 else image
    side = min(grey.shape)
    top, left = ((size - side) // 2 for size in grey.shape)
    square = resize(grey[top : top + side, left : left + side], (SIDE, SIDE), anti_aliasing=True)
    low, high = square.min(), square.max()
    printed = _INK + (_PAPER - _INK) * (square - low) / (high - low)
    return np.asarray(np.rint(255 * printed), dtype=np.uint8)
