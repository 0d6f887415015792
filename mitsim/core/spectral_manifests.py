"""Coloured folders: runs, calibrations and images that separate the spectral lines of a projector's light.

`colour.json` names the lines, and `FOLDER/638nm/` is an ordinary RUN, CAL or image folder of that line. Behind a mosaic
of colour filters every frame shows all lines, so that a run is one RUN folder, and the lines' folders hold what a
perfect image of each line would show.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from mitsim.core.configuration import validate
from mitsim.core.errors import ArgumentError, MitsimError, cut
from mitsim.core.files import read_json, write_json
from mitsim.core.imagelist import PLANES

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
"""Ways to simulate a projector's light: wavelengths not separated, each line, or ``bands:K`` of lines."""
MOST_LINES = 4
"""Lines at which light is traced together: wavelengths that a path carries in Mitsuba's spectral variants."""
JOINT, HALF, DEMOSAIC = WAYS = ("joint", "half", "demosaic")
"""Ways from frames behind colour filters to images of lines (:mod:`mitsim.report.reconstruct_run`), the best first."""
Weight = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


def bands_of(name: str) -> int:
    """Return K of ``bands:K``, 1 to :data:`MOST_LINES`; ArgumentError for another ``name``."""
    word, _, count = name.partition(":")
    if word != BANDS or count not in map(str, range(1, MOST_LINES + 1)):
        raise ArgumentError("colour", f"{name!r}: give {BANDS}:1 to {BANDS}:{MOST_LINES}")
    return int(count)


def spectral_of(variant: str) -> str:
    """Return the spectral variant of the same backend as ``variant``."""
    return f"{variant.rpartition('_')[0]}_spectral"


def check_undecided(variant: str) -> None:
    """Raise ArgumentError for a spectral ``variant``, with which colours cannot be compared with mono light."""
    if variant.endswith("_spectral"):
        raise ArgumentError("variant", f"{variant}: open the bench with a mono variant; colours are looked at too")


class Line(BaseModel):
    """One spectral line and the folder that holds it."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore")

    name: Annotated[str, Field(pattern=r"^[\w.+-]+$", max_length=255)]
    """Name of the line and of its folder."""
    wavelength_nm: float = Field(ge=1, le=1e6, allow_inf_nan=False)
    """Wavelength of the line."""
    radiant_share: float | None = Field(default=None, ge=0, le=1, allow_inf_nan=False)
    """Part of the projector's power; none: not known."""

    @field_validator("name")
    @classmethod
    def _a_folder_inside(cls, name: str) -> str:
        if not name.strip("."):
            raise ValueError(f"{name!r} is no folder of its own; give a name such as 638nm")
        return name


class ColourManifest(BaseModel):
    """Content of colour.json: the kind of folder, and its lines."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore")

    kind: Literal["colour-run", "colour-calibration", "colour-image", "mosaic-run"]
    """What the folder is."""
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
        """Names of the lines."""
        return tuple(line.name for line in self.channels)

    @property
    def wavelengths_nm(self) -> tuple[float, ...]:
        """Wavelengths of the lines."""
        return tuple(line.wavelength_nm for line in self.channels)


class MosaicManifest(ColourManifest):
    """Content of the colour.json of a run behind colour filters."""

    mosaic: Literal["RGGB", "BGGR", "GRBG", "GBRG"]
    """Filters of 2 x 2 pixels, row by row from the frame's first pixel."""
    weights: Annotated[
        tuple[Annotated[tuple[Weight, ...], Field(strict=False)], ...], Field(strict=False, min_length=4, max_length=4)
    ]
    """Of each of these four pixels, electrons per photon of each line."""

    @model_validator(mode="after")
    def _a_weight_for_each_line(self) -> MosaicManifest:
        if any(len(row) != len(self.channels) for row in self.weights):
            raise ValueError(
                f"weights have {', '.join(str(len(row)) for row in self.weights)} numbers; give each of the four "
                f"pixels one for each of {len(self.channels)} lines"
            )
        return self


def lines_of_planes(kind: str, wavelengths_nm: tuple[float, ...]) -> ColourManifest:
    """Return the planes of a mosaic as lines of a folder of a ``kind``, with wavelengths of red, green and blue."""
    lengths = dict(zip("rgb", wavelengths_nm, strict=True))
    lines = [{"name": name, "wavelength_nm": lengths[name[0]]} for name in PLANES]
    return validate(ColourManifest, {"kind": kind, "channels": lines}, "planes")


def is_coloured(folder: Path | str) -> bool:
    """Return True if ``folder`` has a colour.json."""
    return (Path(folder) / COLOUR).is_file()


@dataclass(frozen=True)
class SpectralFolder:
    """A run, calibration or image, and its spectral lines.

    Attributes
    ----------
    folder
        The folder.
    colours
        Content of its colour.json; None where the folder does not separate wavelengths.
    """

    folder: Path
    colours: ColourManifest | None

    @property
    def filters(self) -> MosaicManifest | None:
        """The colour filters that the frames were seen through."""
        return self.colours if isinstance(self.colours, MosaicManifest) else None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the lines; one empty name where wavelengths are not separated."""
        return self.colours.names if self.colours else ("",)

    @property
    def parts(self) -> dict[str, Path]:
        """Folders of frames or factors by line; behind filters, and without lines, the folder itself by ""."""
        return {"": self.folder} if self.filters else {name: self.folder / name for name in self.names}

    def check_calibration(self, calibration: Path) -> SpectralFolder:
        """Return the ``calibration`` of this run; MitsimError where it has other lines than the run."""
        if self.colours is not None:
            check_lines(self.colours, str(self.folder), calibration)
        elif is_coloured(calibration):
            raise ArgumentError(
                "calibration", f"{calibration}: is coloured, but {self.folder} is not; give a line's folder"
            )
        return open_lines(calibration, CALIBRATION)


def open_lines(folder: Path | str, *kinds: str) -> SpectralFolder:
    """Return a folder of one of the ``kinds`` (:data:`KINDS`) with its spectral lines, if it separates wavelengths.

    MitsimError for a colour.json of another kind, or one that breaks a rule.
    """
    if not is_coloured(folder):
        return SpectralFolder(Path(folder), None)
    data = read_json(Path(folder) / COLOUR)
    kind = _kind(data)
    return SpectralFolder(Path(folder), checked_colours(data, kind if kind in kinds else kinds[0], Path(folder)))


def read_colours(folder: Path | str, kind: str) -> ColourManifest:
    """Return the lines of a coloured ``folder`` of a ``kind``, one of :data:`KINDS`.

    MitsimError for a folder without colour.json, of another kind, or whose colour.json breaks a rule.
    """
    if not is_coloured(folder):
        raise MitsimError(f"{folder}: holds no {COLOUR}; give a coloured folder, of `mitsim {_COMMANDS[kind]}`")
    return checked_colours(read_json(Path(folder) / COLOUR), kind, Path(folder))


def check_lines(lines: ColourManifest, run: str, calibration: Path) -> None:
    """Raise MitsimError where a ``calibration`` folder does not have the ``lines`` of a ``run``."""
    calibrated = read_colours(calibration, CALIBRATION)
    ours, theirs = (dict(zip(each.names, each.wavelengths_nm, strict=True)) for each in (lines, calibrated))
    if ours != theirs:
        raise MitsimError(
            f"calibration {calibration}: its lines are {', '.join(theirs)}, but {run} has {', '.join(ours)}; "
            "calibrate each line of this projector"
        )


def checked_colours(data: Any, kind: str, place: Path) -> ColourManifest:
    """Validate the ``data`` of a colour.json, found at a ``place``, which has to be of a ``kind`` of :data:`KINDS`."""
    if _kind(data) != kind:
        raise MitsimError(f"{place}: holds a {cut(_kind(data))}, not a {kind}; give the right folder")
    return validate(MosaicManifest if kind == MOSAIC else ColourManifest, data, f"{place}/{COLOUR}")


def _kind(data: Any) -> str:
    """Return the kind of folder that the ``data`` of a colour.json states."""
    return str(data.get("kind") if isinstance(data, dict) else type(data).__name__)


def installed_ways() -> tuple[str, ...]:
    """Return the :data:`WAYS` that are installed, because demosaicing is an extra."""
    return WAYS if find_spec("colour_demosaicing") else WAYS[:-1]


def check_way(way: str) -> str:
    """Return the ``way``, one of :data:`WAYS`; ArgumentError for another, and for one that is not installed."""
    if way not in WAYS:
        raise ArgumentError("mosaic", f"{way!r}: use {', '.join(WAYS[:-1])} or {WAYS[-1]}")
    if way not in installed_ways():
        raise ArgumentError(
            "mosaic",
            f"{way}: colour-demosaicing is not installed; pip install 'mitsim[mosaic]' (Python 3.11 or newer), or use "
            f"{' or '.join(installed_ways())}",
        )
    return way


def write_colours(folder: Path, colours: ColourManifest, **more: Any) -> None:
    """Write colour.json, all or nothing, with the folder's kind and lines and ``more`` entries."""
    write_json(folder / COLOUR, {**colours.model_dump(), **more})
