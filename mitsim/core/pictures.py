"""Pictures for people: numbers in, PNG bytes out, and the text that shows them in a notebook."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

_LARGEST_INLINE = 256
"""Pixels a side that a notebook shows: the pictures of one object then stay below 100 kB."""


def png(values: npt.ArrayLike, largest: int | None = None) -> bytes:
    """A grey PNG of reflectances ``values`` (rows, columns), shown as :func:`lightness`; ``largest`` as for
    :func:`grey_png`."""
    return grey_png(lightness(values), largest)


def lightness(reflectance: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """``reflectance`` cut to 0..1 and encoded for a screen by the sRGB curve (IEC 61966-2-1)."""
    linear = np.clip(np.asarray(reflectance, dtype=np.float64), 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def grey_png(values: npt.ArrayLike, largest: int | None = None, smallest: int = 1) -> bytes:
    """A grey PNG of ``values`` as they are.

    Parameters
    ----------
    values
        (rows, columns), 0 black, 1 white.
    largest
        pixels a side beyond which every second (third, ...) value is shown.
    smallest
        pixels a side that there are at least: each value then takes a square of them.
    """
    # Imported here: matplotlib takes a third of a second, and most work shows nothing.
    from matplotlib import image

    shown = np.asarray(values, dtype=np.float64)
    step = -(-max(shown.shape) // largest) if largest else 1
    shown = shown[::step, ::step]
    copies = -(-smallest // max(shown.shape))
    buffer = io.BytesIO()
    image.imsave(buffer, np.kron(shown, np.ones((copies, copies))), cmap="gray", vmin=0, vmax=1, format="png")
    return buffer.getvalue()


def data_uri(picture: bytes) -> str:
    """A PNG ``picture`` as the address that holds it, for a page that refers to nothing outside itself."""
    return "data:image/png;base64," + base64.b64encode(picture).decode("ascii")


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
        reflectances, or numbers scaled to 0..1, by caption.
    facts
        lines below them.
    """
    sources = {caption: data_uri(png(values, _LARGEST_INLINE)) for caption, values in pictures.items()}
    figures = "".join(
        '<figure style="display:inline-block;margin:0 8px 4px 0">'
        f'<img style="height:144px" src="{source}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        for caption, source in sources.items()
    )
    lines = "".join(f"<div>{html.escape(fact)}</div>" for fact in facts)
    return f"<div><b>{html.escape(title)}</b></div>{figures}{lines}"


def table(title: str, headings: Sequence[str], rows: Iterable[Sequence[str]], facts: Iterable[str] = ()) -> str:
    """HTML of a table in a notebook.

    Parameters
    ----------
    title, headings
        above the table, and above its columns.
    rows
        of cells.
    facts
        lines below it.
    """
    head = "".join(f"<th style='text-align:left'>{html.escape(heading)}</th>" for heading in headings)
    body = "".join(
        "<tr>" + "".join(f"<td style='text-align:left'>{html.escape(cell)}</td>" for cell in row) + "</tr>"
        for row in rows
    )
    lines = "".join(f"<div>{html.escape(fact)}</div>" for fact in facts)
    return f"<div><b>{html.escape(title)}</b></div><table><tr>{head}</tr>{body}</table>{lines}"
