"""Folders of several spectral lines, and their file colour.json, without importing numpy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from mitsim.core.configuration import validate
from mitsim.core.errors import ArgumentError, MitsimError, cut
from mitsim.core.files import read_json, write_json
from mitsim.core.manifests import kind_of
from mitsim.core.picture_files import PLANES

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


def lines_of_planes(kind: str, wavelengths_nm: tuple[float, ...], names: tuple[str, ...] = PLANES) -> ColourManifest:
    lengths = dict(zip("rgb", wavelengths_nm, strict=True))
    lines = [{"name": name, "wavelength_nm": lengths[name[0]]} for name in names]
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
