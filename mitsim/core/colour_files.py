"""Pictures to read, planes of colour filters, and folders of several spectral lines, without importing numpy."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from mitsim.core.configuration import Configuration, validate
from mitsim.core.errors import ArgumentError, MitsimError, cut
from mitsim.core.files import MOST_SIDE, check_plain, read_json, write_json
from mitsim.core.manifests import kind_of

# -------- Pictures to read, and planes of colour filters

FORMATS = (".png", ".tif", ".tiff", ".npy", ".exr")
"""Formats whose header describes the content."""
JPEG = (".jpg", ".jpeg")
"""Pictures that are not read as frames."""
PRINTS = (*FORMATS, *JPEG)
"""Formats of pictures for prints."""
BARE = (".raw", ".bin", ".dat")
"""Formats without a header."""
_Side = Annotated[int, Field(ge=1, le=MOST_SIDE)]
_Place = Annotated[int, Field(ge=0, lt=MOST_SIDE)]
PLANES = ("r", "gb", "gr", "b")
"""FlatCam's names: gb is the green plane in the rows of blue pixels."""
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


class Raw(Configuration):
    """How files without a header (`.raw`, `.bin`, `.dat`) are read."""

    shape: tuple[_Side, _Side] = Field(strict=False)
    """Rows and columns."""
    bits: int = Field(ge=1, le=32)
    """Bits of a number; up to 8 take a byte, up to 16 two, up to 32 four."""
    byte_order: Literal["little", "big"] = "little"
    """Order of the bytes of a number."""

    @classmethod
    def of(cls, shape: str, bits: int | None, byte_order: str) -> Raw:
        """Return a Raw from words of the command line; MitsimError for invalid ones."""
        sides = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", shape)
        if not sides or not all(0 < int(side) <= MOST_SIDE for side in sides.groups()):
            raise ArgumentError("shape", f"{shape!r}: give ROWSxCOLUMNS, 1 to {MOST_SIDE} each")
        if bits is None or not 1 <= bits <= 32:
            raise ArgumentError("bits", f"{bits}: give the bits of a number in such a file, 1 to 32")
        if byte_order not in ("little", "big"):
            raise ArgumentError("byte_order", f"{byte_order!r}: use little or big")
        return validate(cls, {"shape": [int(sides[1]), int(sides[2])], "bits": bits, "byte_order": byte_order}, "raw")

    @property
    def kind(self) -> Any:
        """Return NumPy's type of the numbers."""
        import numpy as np  # here: most who state it read no numbers

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
        bare = "" if wanted.raw else f"; {', '.join(BARE)} count where shape and bits are stated"
        raise MitsimError(f"{source}: holds no file that ends in {', '.join(endings)}{bare}")

    def natural(path: Path) -> tuple[list[tuple[int, str]], str]:
        parts = re.split(r"([0-9]+)", path.name)
        return [(int(part), "") if part.isascii() and part.isdigit() else (-1, part) for part in parts], path.name

    return tuple(sorted(files, key=natural))


# -------- Folders of several spectral lines

COLOUR = "colour.json"
RUN, CALIBRATION, IMAGE, MOSAIC = KINDS = ("colour-run", "colour-calibration", "colour-image", "mosaic-run")
_COMMANDS = {
    RUN: "capture --colour lines",
    CALIBRATION: "calibrate --colour lines",
    IMAGE: "reconstruct",
    MOSAIC: "capture --colour mosaic",
}
"""Commands that make a folder of each kind."""
MONO, LINES, BANDS = "mono", "lines", "bands"
"""Ways to simulate a projector's light: one effective wavelength, each line, or ``bands:K`` of lines."""
MOST_LINES = 4
"""Lines traced together: wavelengths of a path in Mitsuba's spectral variants."""
JOINT = "joint"
"""Way from frames behind colour filters to images of lines, as image folders name it."""
_Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


def bands_of(name: str) -> int:
    """Return K of ``bands:K``, 1 to :data:`MOST_LINES`; ArgumentError for another ``name``."""
    word, _, count = name.partition(":")
    if word != BANDS or count not in map(str, range(1, MOST_LINES + 1)):
        raise ArgumentError("colour", f"{name!r}: give {BANDS}:1 to {BANDS}:{MOST_LINES}")
    return int(count)


def spectral_of(variant: str) -> str:
    return f"{variant.rpartition('_')[0]}_spectral"


class Line(BaseModel):
    """Spectral line and the folder that holds it."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore")

    name: Annotated[str, Field(pattern=r"^[\w.+-]+$", max_length=255)]
    """Name of the line and of its folder."""
    wavelength_nm: float = Field(ge=1, le=1e6, allow_inf_nan=False)
    """Wavelength of the line."""
    radiant_share: float | None = Field(default=None, ge=0, le=1, allow_inf_nan=False)
    """Fraction of the projector's power; none: unknown."""

    @field_validator("name")
    @classmethod
    def _a_folder_inside(cls, name: str) -> str:
        if not name.strip("."):
            raise ValueError(f"{name!r} is no folder of its own; give a name such as 638nm")
        return name


class ColourManifest(BaseModel):
    """Content of colour.json: kind of the folder, and its lines."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore")

    kind: Literal["colour-run", "colour-calibration", "colour-image", "mosaic-run"]
    """Kind of the folder."""
    channels: Annotated[tuple[Line, ...], Field(strict=False, min_length=1, max_length=256)]
    """Spectral lines, each in a folder of its name."""

    @field_validator("channels")
    @classmethod
    def _each_once(cls, channels: tuple[Line, ...]) -> tuple[Line, ...]:
        names = [line.name for line in channels]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"{twice!r} is there twice; give each line a name of its own")
        return channels

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(line.name for line in self.channels)

    @property
    def wavelengths_nm(self) -> tuple[float, ...]:
        return tuple(line.wavelength_nm for line in self.channels)


class MosaicManifest(ColourManifest):
    """Content of colour.json for a run behind colour filters."""

    mosaic: Literal["RGGB", "BGGR", "GRBG", "GBRG"]
    """Filters of 2 x 2 pixels, row by row from the frame's first pixel."""
    weights: Annotated[
        tuple[Annotated[tuple[_Share, ...], Field(strict=False)], ...], Field(strict=False, min_length=4, max_length=4)
    ]
    """Electrons per photon of each line, for each of these four pixels."""

    @model_validator(mode="after")
    def _a_weight_for_each_line(self) -> MosaicManifest:
        counts = [len(row) for row in self.weights]
        if {*counts} != {len(self.channels)}:
            told = f"weights have {', '.join(map(str, counts))} numbers"
            raise ValueError(f"{told}; give each of the four pixels one for each of {len(self.channels)} lines")
        return self


def lines_of_planes(kind: str, wavelengths_nm: tuple[float, ...]) -> ColourManifest:
    lengths = dict(zip("rgb", wavelengths_nm, strict=True))
    lines = [{"name": name, "wavelength_nm": lengths[name[0]]} for name in PLANES]
    return validate(ColourManifest, {"kind": kind, "channels": lines}, "planes")


def is_coloured(folder: Path | str) -> bool:
    return (Path(folder) / COLOUR).is_file()


class Coloured:
    """Mixin for a folder or its content with ``colours``, None if wavelengths are not separated."""

    colours: ColourManifest | None

    @property
    def filters(self) -> MosaicManifest | None:
        """Return the colour filters in front of the sensor, if any."""
        return self.colours if isinstance(self.colours, MosaicManifest) else None

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the lines; one empty name if wavelengths are not separated."""
        return self.colours.names if self.colours else ("",)


@dataclass(frozen=True)
class SpectralFolder(Coloured):
    folder: Path
    colours: ColourManifest | None

    @property
    def parts(self) -> dict[str, Path]:
        """Return the folder of each line; the folder itself, by "", behind filters and without lines."""
        return {"": self.folder} if self.filters else {name: self.folder / name for name in self.names}

    def check_calibration(self, calibration: Path) -> SpectralFolder:
        if self.colours is not None:
            check_lines(self.colours, str(self.folder), calibration)
        elif is_coloured(calibration):
            fault = f"{calibration}: is coloured, but {self.folder} is not; give a line's folder"
            raise ArgumentError("calibration", fault)
        return open_lines(calibration, CALIBRATION)


def open_lines(folder: Path | str, *kinds: str) -> SpectralFolder:
    """Return a folder with its spectral lines; MitsimError if colour.json is invalid or not in ``kinds``."""
    if not is_coloured(folder):
        return SpectralFolder(Path(folder), None)
    return SpectralFolder(Path(folder), checked_colours(read_json(Path(folder) / COLOUR), Path(folder), *kinds))


def read_colours(folder: Path | str, kind: str) -> ColourManifest:
    """Return the lines of a folder; MitsimError if colour.json is missing, of another ``kind``, or invalid."""
    if not is_coloured(folder):
        raise MitsimError(f"{folder}: holds no {COLOUR}; give a coloured folder, of `mitsim {_COMMANDS[kind]}`")
    return checked_colours(read_json(Path(folder) / COLOUR), Path(folder), kind)


def check_lines(lines: ColourManifest, run: str, calibration: Path) -> None:
    calibrated = read_colours(calibration, CALIBRATION)
    ours, theirs = (dict(zip(each.names, each.wavelengths_nm, strict=True)) for each in (lines, calibrated))
    if ours != theirs:
        raise MitsimError(
            f"calibration {calibration}: its lines are {', '.join(theirs)}, but {run} has {', '.join(ours)}; "
            "calibrate each line of this projector"
        )


def checked_colours(data: Any, place: Path, *kinds: str) -> ColourManifest:
    if kind_of(data) not in kinds:
        raise MitsimError(f"{place}: holds a {cut(kind_of(data))}, not a {kinds[0]}; give the right folder")
    return validate(MosaicManifest if kind_of(data) == MOSAIC else ColourManifest, data, f"{place}/{COLOUR}")


def write_colours(folder: Path, colours: ColourManifest, **more: Any) -> None:
    write_json(folder / COLOUR, {**colours.model_dump(), **more})
