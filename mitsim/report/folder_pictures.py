"""Numbers of frames, factors and images in, pictures that people open out: each with what its black and white are.

Small pictures are enlarged by whole factors, large ones reduced by them; nothing is rescaled but for display.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.files import write_bytes
from mitsim.core.images import data_uri, png
from mitsim.core.parallel import in_threads

SMALLEST, LARGEST = 512, 1024
"""Pixels a side of a picture: an image of 128 is shown four times as large, and 1024 fill a page in one dot each."""
MOST_FRAMES = 64
"""Frames of a contact sheet: eight rows of eight are still told apart on a page."""
_MOST_READ = MOST_FRAMES << 18
"""Pixels that are read for a contact sheet: 64 frames of 512 x 512 take 0.3 s, and larger frames are fewer."""
_LONGEST = 4
"""Rows over columns of a contact sheet, and columns over rows, that a page still shows."""
_GAP = 2
"""Pixels between the frames of a contact sheet, in which there is nothing else."""
_WHOLE = 1000
"""From which a number has no places behind the point."""
_SHOWN_PERCENT = 99.0
"""Of errors, those that the scale of a picture holds: single pixels at edges are off by far more."""


@dataclass(frozen=True)
class Scale:
    """What black and white of a picture are: ``black`` and ``white``, in a ``unit``."""

    black: float
    white: float
    unit: str

    @classmethod
    def of(cls, values: npt.ArrayLike, unit: str, black: float | None = None) -> Scale:
        """The scale of numbers.

        Parameters
        ----------
        values, unit
            the largest of these is white.
        black
            what is black; None: the least of them.
        """
        return cls(float(np.min(values)) if black is None else black, float(np.max(values)), unit)

    def levels(self, values: npt.NDArray[Any]) -> FloatArray:
        """``values`` with black at 0 and white at 1; all black where both are one."""
        span = self.white - self.black
        return (np.asarray(values, dtype=np.float64) - self.black) / (span if span > 0 else np.inf)

    def words(self, values: npt.NDArray[Any]) -> str:
        """Both in words, and the part of the ``values`` beyond them."""
        beyond = float(np.mean((values < self.black) | (values > self.white)))
        cut = f"; {beyond:.2g} of the pixels lie beyond" if beyond else ""
        black, white = (f"{end:.0f}" if abs(end) >= _WHOLE else f"{end:.3g}" for end in (self.black, self.white))
        return f"black {black}, white {white} {self.unit}{cut}"


REFLECTANCE = Scale(0.0, 1.0, "of the board's reflectance")
"""Of images and truths."""


@dataclass(frozen=True)
class Picture:
    """A picture as a file and as a figure of a page.

    Attributes
    ----------
    name
        of its file, without the ending.
    title, caption
        what it shows; more of that, with what black and white are.
    data
        its PNG.
    wide
        whether it takes the whole width of a page.
    """

    name: str
    title: str
    caption: str
    data: bytes
    wide: bool = False

    @classmethod
    def of(
        cls, name: str, title: str, values: npt.NDArray[Any], scale: Scale, about: str = "", wide: bool = False
    ) -> Picture:
        """Of numbers.

        Parameters
        ----------
        name, title, about, wide
            as the attributes; the caption is ``about`` and the scale.
        values
            (rows, columns).
        scale
            what is black and white.
        """
        words = scale.words(values)
        caption = f"{about}: {words}" if about else words
        return cls(name, title, caption, png(scale.levels(values), LARGEST, SMALLEST), wide)

    @property
    def uri(self) -> str:
        """Its PNG as the address that holds it."""
        return data_uri(self.data)

    def write(self, folder: Path) -> Path:
        """Write it to a ``folder``, whole or not at all; its path. MitsimError when it cannot be written."""
        path = folder / f"{self.name}.png"
        write_bytes(path, self.data)
        return path


def write_beside(path: Path, values: npt.NDArray[Any], unit: str) -> tuple[Path, str]:
    """A picture beside a frame's file, named after all of its name, so that it takes no other file's place.

    Parameters
    ----------
    path
        of the frame.
    values, unit
        its numbers (rows, columns), or (rows, columns, 3) in colour.

    Returns
    -------
    tuple of Path and str
        of the picture, ``FRAME.exr.png``, and what is black and white.

    Raises
    ------
    MitsimError
        when it cannot be written.
    """
    picture = Picture.of(path.name, path.name, values, Scale.of(values, unit))
    return picture.write(path.parent), picture.caption


def shown_error(errors: FloatArray) -> float:
    """What is white of ``errors``: all but the largest hundredth are below."""
    return float(np.percentile(errors, _SHOWN_PERCENT))


def error_picture(image: FloatArray, truth: FloatArray) -> Picture:
    """Where an ``image`` is off its ``truth``, (n, n') each [reflectance]."""
    error = np.abs(image - truth)
    scale = Scale(0.0, shown_error(error), REFLECTANCE.unit)
    return Picture.of("error", "How they differ", error, scale, "|image \N{MINUS SIGN} truth|")


def contact_sheet(read: Callable[[int], FloatArray], count: int, shape: tuple[int, int], columns: int) -> Picture:
    """All frames of a capture side by side, or as many of them, evenly taken, as a page shows.

    Parameters
    ----------
    read
        gives frame number i less the black level, (rows, columns) [DN].
    count, shape
        number of frames, and (rows, columns) of each.
    columns
        frames a row, as the patterns have them; of so many that they do not fit a square is made.
    """
    most = max(1, min(MOST_FRAMES, _MOST_READ // (shape[0] * shape[1])))
    chosen: Sequence[int] = range(count)
    if count > most:
        chosen = [number * count // most for number in range(most)]
    if count > most or columns**2 > _LONGEST * count or columns**2 * _LONGEST < count:
        columns = ceil(sqrt(len(chosen)))
    rows = ceil(len(chosen) / columns)
    factor = max(1, ceil(max(rows * shape[0], columns * shape[1]) / LARGEST))
    frames = in_threads(lambda number: _block_means(read(number), factor), chosen)
    tall, broad = frames[0].shape
    white = max(float(frame.max()) for frame in frames)
    sheet = np.full((rows * (tall + _GAP) - _GAP, columns * (broad + _GAP) - _GAP), white)
    for place, frame in enumerate(frames):
        top, left = (number * (side + _GAP) for number, side in zip(divmod(place, columns), frame.shape, strict=True))
        sheet[top : top + tall, left : left + broad] = frame
    scale = Scale(0.0, white, "DN above the black level")
    which = f"all {count}" if len(chosen) == count else f"{len(chosen)} of {count}, evenly taken"
    order = f"row by row, {columns} a row" if columns > 1 else "one below the other"
    mean = f"; a pixel is the mean of {factor} x {factor}" if factor > 1 else ""
    caption = f"{which}, {order}{mean}: {scale.words(sheet)}"
    return Picture(
        "frames", "What the camera recorded", caption, png(scale.levels(sheet), smallest=SMALLEST), wide=True
    )


def _block_means(frame: FloatArray, factor: int) -> FloatArray:
    """Means of ``factor`` x ``factor`` pixels of a ``frame``; what is left over at its ends is left out."""
    rows, columns = (max(side // factor, 1) for side in frame.shape)
    whole = frame[: rows * factor, : columns * factor]
    down, across = (min(factor, side) for side in frame.shape)
    return np.asarray(whole.reshape(rows, down, columns, across).mean(axis=(1, 3)))
