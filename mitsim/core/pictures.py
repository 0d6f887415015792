"""Pictures for people: numbers in, PNG bytes out, and the text that shows them in a notebook."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

_LARGEST_INLINE = 128
"""Pixels a side that a notebook shows: the pictures of one object then stay below 100 kB."""
_SHORT_CELL = 20
"""A table's cells of fewer letters are not broken into lines: names and numbers."""
_SHOWN_HEIGHT = 144
"""Height of a notebook's pictures [screen pixels]: four stand side by side."""


def png(values: npt.ArrayLike, largest: int | None = None) -> bytes:
    """A grey PNG of reflectances ``values`` (rows, columns): cut to 0..1, with the sRGB curve's approximate 1/2.2.

    Beyond ``largest`` pixels a side, every picture pixel is the mean of 2 x 2 (3 x 3, ...).
    """
    # Imported here: most work shows nothing.
    from PIL import Image

    grey = np.rint(255 * np.clip(np.asarray(values, dtype=np.float64), 0, 1) ** (1 / 2.2))
    picture = Image.fromarray(grey.astype(np.uint8))
    if largest:
        picture = picture.reduce(max(1, -(-max(picture.size) // largest)))
    buffer = io.BytesIO()
    picture.save(buffer, format="png", optimize=True)
    return buffer.getvalue()


def span(values: npt.ArrayLike, unit: str) -> str:
    """The range of numbers ``values``, with their ``unit``, for the caption of a picture of them :func:`scaled`."""
    ends = np.min(values), np.max(values)
    low, high = (f"{end:.0f}" if abs(end) >= 1000 else f"{end:.3g}" for end in ends)
    return f"{low} to {high} {unit}"


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
        '<figure style="display:inline-block;vertical-align:top;margin:4px 12px 4px 0">'
        f'<img style="height:{_SHOWN_HEIGHT}px;image-rendering:pixelated" src="data:image/png;base64,{data}">'
        f'<figcaption style="font-size:85%;white-space:pre-line">{html.escape(caption)}</figcaption></figure>'
        for caption, data in encoded.items()
    )
    return _titled(title, f"<div>{figures}</div>", facts)


def table(
    title: str, headings: Sequence[str], rows: Iterable[Sequence[str]], facts: Iterable[str] = (), numbers: int = 0
) -> str:
    """HTML of a table in a notebook.

    Parameters
    ----------
    title, headings
        above the table, and above its columns.
    rows
        of cells.
    facts
        lines below it.
    numbers
        how many of the last columns hold numbers.
    """

    def wrap(cell: str) -> str:
        return ";white-space:nowrap" if len(cell) < _SHORT_CELL else ""

    def line(cells: Sequence[str], tag: str) -> str:
        sides = ["left"] * (len(cells) - numbers) + ["right"] * numbers
        return "".join(
            f'<{tag} style="padding:2px 10px 2px 0;text-align:{side};vertical-align:top{wrap(cell)}">'
            f"{html.escape(cell)}</{tag}>"
            for cell, side in zip(cells, sides, strict=True)
        )

    body = "".join(f"<tr>{line(row, 'td')}</tr>" for row in rows)
    return _titled(title, f"<table><tr>{line(headings, 'th')}</tr>{body}</table>", facts)


def _titled(title: str, body: str, facts: Iterable[str]) -> str:
    lines = "".join(f"<div>{html.escape(fact)}</div>" for fact in facts)
    return f"<div><b>{html.escape(title)}</b></div>{body}{lines}"
