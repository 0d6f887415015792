"""Pictures for people: numbers in, PNG bytes out, and the text that shows them in a notebook."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt

_LARGEST_INLINE = 256
"""Pixels a side that a notebook shows: the pictures of one object then stay below 100 kB."""


def png(values: npt.ArrayLike, largest: int | None = None) -> bytes:
    """A grey PNG of reflectances ``values`` (rows, columns): cut to 0..1, with the sRGB curve's approximate 1/2.2.

    ``largest`` is the number of pixels a side beyond which every second (third, ...) one is shown.
    """
    # Imported here: matplotlib takes a third of a second, and most work shows nothing.
    from matplotlib import image

    shown = np.asarray(values, dtype=np.float64)
    step = -(-max(shown.shape) // largest) if largest else 1
    buffer = io.BytesIO()
    image.imsave(buffer, np.clip(shown[::step, ::step], 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1, format="png")
    return buffer.getvalue()


def scaled(values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Numbers ``values`` with their range brought to 0..1; 0 where all are equal."""
    shown = np.asarray(values, dtype=np.float64)
    low, high = float(shown.min()), float(shown.max())
    return (shown - low) / (high - low) if high > low else np.zeros_like(shown)


def card(title: str, pictures: Mapping[str, npt.ArrayLike], facts: Iterable[str]) -> str:
    """HTML of an object in a notebook: its ``title``, reflectances or scaled ``pictures`` by caption, lines of
    ``facts``."""
    encoded = {caption: base64.b64encode(png(values, _LARGEST_INLINE)).decode() for caption, values in pictures.items()}
    figures = "".join(
        '<figure style="display:inline-block;margin:0 8px 4px 0">'
        f'<img style="height:144px" src="data:image/png;base64,{data}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        for caption, data in encoded.items()
    )
    lines = "".join(f"<div>{html.escape(fact)}</div>" for fact in facts)
    return f"<div><b>{html.escape(title)}</b></div>{figures}{lines}"
