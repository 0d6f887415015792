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


def png(values: npt.ArrayLike, largest: int | None = None, smallest: int = 1) -> bytes:
    """A PNG of reflectances, or of linear sRGB, shown as :func:`lightness`.

    Parameters
    ----------
    values
        (rows, columns), or (rows, columns, 3) in colour.
    largest, smallest
        as for :func:`grey_png`.
    """
    return grey_png(lightness(values), largest, smallest)


def lightness(reflectance: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """``reflectance`` cut to 0..1 and encoded for a screen by the sRGB curve (IEC 61966-2-1)."""
    linear = np.clip(np.asarray(reflectance, dtype=np.float64), 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def grey_png(values: npt.ArrayLike, largest: int | None = None, smallest: int = 1) -> bytes:
    """A PNG of ``values`` as they are.

    Parameters
    ----------
    values
        (rows, columns), or (rows, columns, 3) in colour, 0 black, 1 white.
    largest
        pixels a side beyond which every picture pixel is the mean of 2 x 2 (3 x 3, ...).
    smallest
        pixels a side that there are at least: each value then takes a square of them.
    """
    # Imported here: most work shows nothing.
    from PIL import Image

    shown = np.asarray(values, dtype=np.float64)
    copies = -(-smallest // max(shown.shape[:2]))
    levels = np.rint(255 * np.clip(shown.repeat(copies, axis=0).repeat(copies, axis=1), 0, 1))
    picture = Image.fromarray(levels.astype(np.uint8))
    if largest:
        picture = picture.reduce(max(1, -(-max(picture.size) // largest)))
    buffer = io.BytesIO()
    picture.save(buffer, format="png", optimize=True)
    return buffer.getvalue()


def data_uri(picture: bytes) -> str:
    """A PNG ``picture`` as the address that holds it, for a page that refers to nothing outside itself."""
    return "data:image/png;base64," + base64.b64encode(picture).decode("ascii")


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
    """HTML of an object in a notebook.

    Parameters
    ----------
    title
        above all.
    pictures
        reflectances, or numbers scaled to 0..1, or linear sRGB (rows, columns, 3), by caption.
    facts
        lines below them.
    """
    sources = {caption: data_uri(png(values, _LARGEST_INLINE)) for caption, values in pictures.items()}
    figures = "".join(
        '<figure style="display:inline-block;vertical-align:top;margin:4px 12px 4px 0">'
        f'<img style="height:{_SHOWN_HEIGHT}px;image-rendering:pixelated" src="{source}">'
        f'<figcaption style="font-size:85%;white-space:pre-line">{html.escape(caption)}</figcaption></figure>'
        for caption, source in sources.items()
    )
    return _with_title(title, f"<div>{figures}</div>", facts)


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
    return _with_title(title, f"<table><tr>{line(headings, 'th')}</tr>{body}</table>", facts)


def _with_title(title: str, body: str, facts: Iterable[str]) -> str:
    lines = "".join(f"<div>{html.escape(fact)}</div>" for fact in facts)
    return f"<div><b>{html.escape(title)}</b></div>{body}{lines}"
