"""Eight test images, as the paper's means are over eight: names in, pictures to print on a sheet out.

They come with scikit-image, which states their licences: the paper does not name its own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mitsim.core.errors import MitsimError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from mitsim.core.arrays import FloatArray

TEST_IMAGES = ("astronaut", "camera", "chelsea", "coffee", "coins", "rocket", "page", "brick")
"""Portraits, an animal, things, a page of text and a texture."""
QUICK_IMAGES = ("chelsea", "page")
"""For a first look: fur and letters."""
PRINT_MM = 128.0
"""Width of the photograph's sheet, which they are printed on."""
EDGE_DEGREES = 5.0
"""Of the slanted edge, as ISO 12233 has it."""
SIDE = 512
"""Pixels a side: four of each of 128 projector pixels."""
_INK, _PAPER = 0.05, 0.90
"""Reflectances of black and white print, as on the shipped scenes."""


def picture(name: str) -> npt.NDArray[np.uint8]:
    """(512, 512) eight-bit reflectance of the test image ``name``: the middle square of it, grey.

    Besides, ``bars 0.26`` are bars of so many line pairs a mm of the print, upright on the left, lying on the right,
    and ``edge`` is one edge 5 degrees off the upright. MitsimError for another name.
    """
    import numpy as np
    from skimage import data
    from skimage.transform import resize

    kind, _, frequency = name.partition(" ")
    if kind == "bars" and frequency:
        return _printed(_bars(float(frequency)))
    if name == "edge":
        return _printed(_edge())
    if name not in TEST_IMAGES:
        raise MitsimError(f"picture {name!r}: use {', '.join((*TEST_IMAGES, 'edge', 'bars PAIRS_A_MM'))}")
    image = np.asarray(getattr(data, name)(), dtype=np.float64)
    grey = image.mean(axis=2) if image.ndim == 3 else image
    side = min(grey.shape)
    top, left = ((size - side) // 2 for size in grey.shape)
    square = resize(grey[top : top + side, left : left + side], (SIDE, SIDE), anti_aliasing=True)
    return _printed((square - square.min()) / (square.max() - square.min()))


def _printed(grey: FloatArray) -> npt.NDArray[np.uint8]:
    """Eight-bit reflectance of ``grey``, 0 black to 1 white."""
    import numpy as np

    return np.asarray(np.rint(255 * (_INK + (_PAPER - _INK) * grey)), dtype=np.uint8)


def _bars(frequency: float) -> FloatArray:
    """(512, 512) bars of so many pairs a mm, each texel the mean of the bars over it."""
    import numpy as np

    edges = np.arange(SIDE + 1) * PRINT_MM / SIDE * frequency
    white = np.floor(edges) / 2 + np.minimum(edges % 1, 0.5)  # integral of the bars, in periods
    profile = np.diff(white) / np.diff(edges)
    across = np.broadcast_to(profile, (SIDE, SIDE))
    return np.concatenate([across[:, : SIDE // 2], across.T[:, SIDE // 2 :]], axis=1)


def _edge() -> FloatArray:
    """(512, 512) black to white, each texel the part of it that is right of the edge, by 8 points a row of it."""
    import numpy as np

    rows, columns = ((np.arange(8 * SIDE) + 0.5) / 8, np.arange(SIDE))
    place = SIDE / 2 + (rows - SIDE / 2) * np.tan(np.radians(EDGE_DEGREES))
    return np.asarray(np.clip(columns + 1 - place[:, None], 0, 1).reshape(SIDE, 8, SIDE).mean(axis=1))
