"""Images and figures in, PNGs as data URIs out: what a self-contained page needs."""

from __future__ import annotations

import base64
import math
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mitsim.core.errors import MitsimError

Array = NDArray[Any]

PATTERN_CORNER = 40
"""Projector pixels a side that are shown of a pattern."""


def reflectance_png(image: Array, name: str = "image") -> str:
    """Reflectance as an sRGB grey PNG: clipped to 0..1 for display only, so a screen shows its lightness."""
    linear = np.clip(finite(image, name), 0.0, 1.0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)  # IEC 61966-2-1
    return _grey_png(encoded)


def pattern_png(pattern: Array) -> str:
    """Top left corner of a pattern, where single pixels can be told apart: 0..1 as it is, -1..1 with -1 black."""
    values = finite(pattern, "pattern")[:PATTERN_CORNER, :PATTERN_CORNER]
    return _grey_png((values + 1.0) / 2.0 if values.min() < 0.0 else values)


def _grey_png(values: Array) -> str:
    """Values 0..1 as a grey PNG of at least 384 pixels a side, whole copies of each pixel, as a data URI."""
    from matplotlib.image import imsave

    copies = max(1, math.ceil(384 / max(values.shape)))
    buffer = BytesIO()
    large = np.kron(values, np.ones((copies, copies)))
    imsave(buffer, large, cmap="gray", vmin=0.0, vmax=1.0, format="png")
    return _data_uri(buffer)


def figure_png(figure: Figure) -> str:
    """A figure as a data URI, 160 pixels an inch."""
    figure.savefig(buffer := BytesIO(), format="png", dpi=160)
    return _data_uri(buffer)


def _data_uri(buffer: BytesIO) -> str:
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def finite(image: Array, name: str) -> NDArray[np.float64]:
    """The image as float64; MitsimError unless it is rows x columns of finite numbers."""
    values = np.asarray(image, dtype=np.float64)
    if values.ndim != 2 or values.size == 0 or not np.all(np.isfinite(values)):
        raise MitsimError(f"report: {name} of shape {values.shape} must be rows x columns of finite numbers")
    return values
