"""Kinds of picture files, and the preparation of their numbers, without importing numpy."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from mitsim.core.configuration import Configuration, validate
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.files import MOST_SIDE, check_plain

FORMATS = (".png", ".tif", ".tiff", ".npy", ".exr")
"""Formats whose header describes the content."""
JPEG = (".jpg", ".jpeg")
"""Pictures that are not read as frames."""
PRINTS = (*FORMATS, *JPEG)
"""Formats of pictures for prints."""
BARE = (".raw", ".bin", ".dat")
"""Formats without a header."""
PixelFormat = Literal["Mono10p", "Mono12p", "Mono10Packed", "Mono12Packed"]
PIXEL_FORMATS: dict[PixelFormat, tuple[int, int]] = {
    "Mono10p": (10, 10), "Mono12p": (12, 12), "Mono10Packed": (10, 12), "Mono12Packed": (12, 12),
}  # fmt: skip
"""Bits of a number in each packed format of GenICam, and the bits that it takes in a file."""
_Side = Annotated[int, Field(ge=1, le=MOST_SIDE)]
_Place = Annotated[int, Field(ge=0, lt=MOST_SIDE)]
PLANES = ("r", "gb", "gr", "b")
"""FlatCam's names: gb is the green plane in the rows of blue pixels."""
RGB = ("r", "g", "b")
"""Channels of a picture in colour."""
ALL = "all"
WAVELENGTHS_NM = 600.0, 540.0, 460.0
"""Default wavelengths of red, green and blue planes [nm], as in calibration/ov5647.toml."""
_Wavelength = Annotated[float, Field(ge=1, le=1e6)]
BGGR = "BGGR"
"""Default mosaic, FlatCam's."""
CORRECTIONS = "dark", "flat", "flat_dark"
"""Fields of a preparation that are paths of frames."""
_LARGEST_TURN = 45.0
"""Degrees; beyond, no corner of the picture would remain."""
_LARGEST_FACTOR = 1 << 24
"""Whole numbers that single precision resolves."""


def picture_files(folder: Path) -> tuple[Path, ...]:
    """Return the pictures in a ``folder`` by their names; MitsimError if there are none."""
    if not folder.is_dir():
        raise MitsimError(f"pictures {folder}: is no folder; give one of pictures")
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in PRINTS)
    if not found:
        raise MitsimError(f"pictures {folder}: holds no file that ends in {', '.join(PRINTS)}")
    return tuple(found)


class Raw(Configuration):
    """How files without a header (`.raw`, `.bin`, `.dat`) are read."""

    shape: tuple[_Side, _Side] = Field(strict=False)
    """Rows and columns."""
    bits: int | None = Field(default=None, ge=1, le=32)
    """Bits of a number; up to 8 take a byte, up to 16 two, up to 32 four; none: as in `pixel_format`."""
    byte_order: Literal["little", "big"] = "little"
    """Order of the bytes of a number."""
    pixel_format: PixelFormat | None = None
    """Packed format of GenICam, in place of `bits` and `byte_order`; none: numbers take whole bytes."""

    @model_validator(mode="after")
    def _has_one_layout(self) -> Raw:
        whole = self.model_fields_set & {"bits", "byte_order"}
        if self.pixel_format is None and self.bits is None:
            raise ValueError("has neither bits nor pixel_format; give one")
        if self.pixel_format is not None and whole:
            raise ValueError(f"pixel_format states {' and '.join(sorted(whole))}, too; leave this out")
        return self

    @classmethod
    def of(cls, shape: str, bits: int | None, byte_order: str, pixel_format: PixelFormat | None = None) -> Raw:
        """Return a Raw from words of the command line; MitsimError for invalid ones."""
        sides = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", shape)
        if not sides or not all(0 < int(side) <= MOST_SIDE for side in sides.groups()):
            raise ArgumentError("shape", f"{shape!r}: give ROWSxCOLUMNS, 1 to {MOST_SIDE} each")
        size = {"shape": [int(sides[1]), int(sides[2])]}
        if pixel_format is not None:
            return validate(cls, {**size, "pixel_format": pixel_format}, "raw")
        if bits is None or not 1 <= bits <= 32:
            raise ArgumentError("bits", f"{bits}: give the bits of a number in such a file, 1 to 32")
        if byte_order not in ("little", "big"):
            raise ArgumentError("byte_order", f"{byte_order!r}: use little or big")
        return validate(cls, {**size, "bits": bits, "byte_order": byte_order}, "raw")

    @property
    def kind(self) -> Any:
        """Return NumPy's type of the numbers; of packed ones, of their bytes."""
        import numpy as np  # here: most who state it read no numbers

        if self.bits is None:
            return np.dtype(np.uint8)
        width = 1 if self.bits <= 8 else 2 if self.bits <= 16 else 4
        return np.dtype(f"{'<' if self.byte_order == 'little' else '>'}u{width}")


class Crop(Configuration):
    """The part of a picture that is a frame."""

    row: _Place = 0
    """First row."""
    column: _Place = 0
    """First column."""
    rows: _Side | None = None
    """Number of rows; none: all that follow."""
    columns: _Side | None = None
    """Number of columns; none: all that follow."""

    @classmethod
    def of(cls, text: str) -> Crop:
        """Return a Crop from ROW,COLUMN or ROW,COLUMN,ROWS,COLUMNS; MitsimError for another ``text``."""
        numbers = re.fullmatch(r"([0-9]{1,5}),([0-9]{1,5})(?:,([0-9]{1,5}),([0-9]{1,5}))?", text)
        if not numbers:
            raise ArgumentError("crop", f"{text!r}: give ROW,COLUMN or ROW,COLUMN,ROWS,COLUMNS [pixels]")
        found = {name: int(each) for name, each in zip(cls.model_fields, numbers.groups(), strict=True) if each}
        return validate(cls, found, f"crop {text!r}")


class Preparation(Configuration):
    """Steps that make a frame of a file's numbers, in the order of these fields."""

    divide_by: int | None = Field(default=None, ge=1, le=_LARGEST_FACTOR)
    """Common factor of all numbers; none: determined, if a camera's numbers were shifted to the high bits."""
    dark: str | None = None
    """Frame without any light, or a folder of such frames, whose mean is subtracted; a path from the list's folder."""
    flat: str | None = None
    """Frame of uniform light without mask, or a folder of such frames; frames are divided by its mean, normalised to 1.
    """
    flat_dark: str | None = None
    """Frames without light at the flat's exposure; none: those of `dark`, or the black level."""
    mosaic: Literal["RGGB", "BGGR", "GRBG", "GBRG"] | None = None
    """Colour filters of the first 2 x 2 pixels, row by row; none: the camera file's, else BGGR."""
    channel: Literal["r", "gb", "gr", "b", "all"] | None = None
    """Plane of the mosaic, or `all`; none: the picture is no mosaic."""
    wavelengths_nm: Annotated[tuple[_Wavelength, ...], Field(strict=False, min_length=3, max_length=3)] = WAVELENGTHS_NM
    """Wavelengths of red, green and blue planes in a colour image [nm]."""
    orientation: Literal[1, 2, 3, 4, 5, 6, 7, 8] | None = None
    """Rotation of the picture or plane, as Exif and TIFF number it; none: not rotated."""
    turn_deg: float = Field(default=0.0, ge=-_LARGEST_TURN, le=_LARGEST_TURN)
    """Angle of a further counter-clockwise rotation [degrees], by bilinear interpolation."""
    turn_about: Literal["centre", "corner"] = "centre"
    """Fixed point of that rotation: the middle of the picture, or the centre of its first pixel."""
    crop: Crop | None = None
    """Final crop; none: the whole picture, or for a calibrated plane the middle part of the calibration's size."""

    @model_validator(mode="after")
    def _is_whole(self) -> Preparation:
        if self.mosaic is not None and self.channel is None:
            raise ValueError("mosaic is of planes; give channel too")
        if self.flat_dark is not None and self.flat is None:
            raise ValueError("flat_dark is taken off a flat; give flat too")
        return self


def planes_of(mosaic: str) -> dict[str, tuple[int, int]]:
    """Return the first row and column of each of the :data:`PLANES`."""
    places = {(index // 2, index % 2): colour.lower() for index, colour in enumerate(mosaic)}
    names = {
        colour + (places[row, 1 - column] if colour == "g" else ""): (row, column)
        for (row, column), colour in places.items()
    }
    return {name: names[name] for name in PLANES}


def check_channel(name: str) -> str:
    if name not in (*PLANES, ALL):
        raise ArgumentError("channel", f"{name!r}: use {', '.join(PLANES)} or {ALL}")
    return name


@dataclass(frozen=True)
class Wanted:
    """Kind of pictures to read.

    Attributes
    ----------
    bits
        Allowed bits of PNG and TIFF; frames exclude 2 and 4, which Pillow scales to 0 to 255.
    raw
        Layout of files without a header; None: such files are refused.
    """

    what: str = "frame"
    most: int = MOST_SIDE
    bits: Sequence[int] = (8, 16, 32)
    colour: bool = False
    raw: Raw | None = None

    @property
    def grey(self) -> str:
        """Return how a picture of one number a pixel is saved."""
        frame = "save one number a pixel, raw and not demosaiced"
        return frame if self.what == "frame" else "save it in grey, one number a pixel"

    def refusal(self, path: Path, reason: str) -> MitsimError:
        return MitsimError(f"{self.what} {path}: {reason}")


FRAME = Wanted()


def image_files(source: Path, wanted: Wanted = FRAME) -> tuple[Path, ...]:
    """Return the pictures in a folder, sorted by the numbers in their names; MitsimError if there are none."""
    if not source.is_dir():
        check_plain(source, wanted.what)
        return (source,)
    endings = tuple(ending for ending in (*FORMATS, *BARE) if wanted.raw or ending not in BARE)
    files = [path for path in source.iterdir() if path.suffix.lower() in endings and not path.name.startswith(".")]
    if not files:
        bare = "" if wanted.raw else f"; {', '.join(BARE)} count where shape and bits or pixel_format are stated"
        raise MitsimError(f"{source}: holds no file that ends in {', '.join(endings)}{bare}")

    def natural(path: Path) -> tuple[list[tuple[int, str]], str]:
        parts = re.split(r"([0-9]+)", path.name)
        return [(int(part), "") if part.isascii() and part.isdigit() else (-1, part) for part in parts], path.name

    return tuple(sorted(files, key=natural))
