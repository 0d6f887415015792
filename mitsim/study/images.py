"""Images and figures in, PNGs as data URIs out: what a self-contained page needs."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.pictures import data_uri, grey_png, lightness

PATTERN_CORNER = 40
"""Projector pixels a side that are shown of a pattern, so that single ones can be told apart."""
_SMALLEST = 384
"""Pixels a side of a picture: the width of a column of the page, on a screen of two dots a pixel."""
_FIGURE_DPI = 160
"""Figures are 8.6 inches wide: 1376 pixels, what the page's width shows on the same screen."""


def reflectance_uri(image: npt.ArrayLike, name: str = "image") -> str:
    """Reflectance as a grey PNG: cut to 0..1 for display only, so a screen shows its lightness.

    ``image`` is (rows, columns), ``name`` what messages call it. MitsimError as :func:`finite`.
    """
    return data_uri(grey_png(lightness(finite(image, name)), smallest=_SMALLEST))


def pattern_uri(pattern: npt.ArrayLike) -> str:
    """Top left corner of a ``pattern`` (n, n): 0..1 as it is, -1..1 with -1 black. MitsimError as :func:`finite`."""
    values = finite(pattern, "pattern")[:PATTERN_CORNER, :PATTERN_CORNER]
    return data_uri(grey_png((values + 1.0) / 2.0 if values.min() < 0.0 else values, smallest=_SMALLEST))


def figure_uri(figure: Figure) -> str:
    """A ``figure`` as a PNG."""
    figure.savefig(buffer := BytesIO(), format="png", dpi=_FIGURE_DPI)
    return data_uri(buffer.getvalue())


def finite(image: npt.ArrayLike, name: str) -> FloatArray:
    """The ``image`` in double precision; MitsimError, with its ``name``, unless it is rows x columns of finite
    numbers."""
    values = np.asarray(image, dtype=np.float64)
    if values.ndim != 2 or values.size == 0 or not np.all(np.isfinite(values)):
        raise MitsimError(f"report: {name} of shape {values.shape} must be rows x columns of finite numbers")
    return values
