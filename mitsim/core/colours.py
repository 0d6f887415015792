"""Coloured folders: which spectral lines a run, calibration or image has; each line lies in a folder of its own.

`colour.json` names the lines; `FOLDER/638nm/` is an ordinary RUN, CAL or image folder of that line alone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from mitsim.core.configuration import validated
from mitsim.core.errors import MitsimError, cut
from mitsim.core.jsonfile import read_json, write_json

COLOUR = "colour.json"
RUN, CALIBRATION, IMAGE = KINDS = ("colour-run", "colour-calibration", "colour-image")
_COMMANDS = {RUN: "capture", CALIBRATION: "calibrate", IMAGE: "reconstruct"}
"""Verbs that make a folder of each kind."""


class Line(BaseModel):
    """One spectral line and the folder that holds it."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore")

    name: Annotated[str, Field(pattern=r"^[\w.+-]+$", max_length=255)] = Field(
        description="of the line, and of its folder"
    )
    wavelength_nm: float = Field(ge=1, le=1e6, allow_inf_nan=False, description="of the line's light [nm]")
    radiant_share: float | None = Field(
        None, ge=0, le=1, allow_inf_nan=False, description="part of the projector's power; none: not known"
    )

    @field_validator("name")
    @classmethod
    def _a_folder_inside(cls, name: str) -> str:
        if not name.strip("."):
            raise ValueError(f"{name!r} is no folder of its own; give a name such as 638nm")
        return name


class ColourManifest(BaseModel):
    """What colour.json says: the kind of folder, and its lines."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore")

    kind: Literal["colour-run", "colour-calibration", "colour-image"] = Field(description="what the folder is")
    channels: Annotated[tuple[Line, ...], Field(strict=False, min_length=1, max_length=256)] = Field(
        description="spectral lines, each in a folder of its name"
    )

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
        """Of the lines."""
        return tuple(line.name for line in self.channels)

    @property
    def wavelengths_nm(self) -> tuple[float, ...]:
        """Of the lines [nm]."""
        return tuple(line.wavelength_nm for line in self.channels)


def is_coloured(folder: Path | str) -> bool:
    """Whether ``folder`` has a colour.json."""
    return (Path(folder) / COLOUR).is_file()


def read_colours(folder: Path | str, kind: str) -> ColourManifest:
    """The lines of a coloured ``folder`` of a ``kind``, one of :data:`KINDS`.

    MitsimError when it has no colour.json, or one of another kind or that breaks a rule.
    """
    folder = Path(folder)
    if not is_coloured(folder):
        raise MitsimError(
            f"{folder}: holds no {COLOUR}; give a coloured folder, of `mitsim {_COMMANDS[kind]} --colour lines`"
        )
    return checked_colours(read_json(folder / COLOUR), kind, folder)


def checked_colours(data: Any, kind: str, place: Path) -> ColourManifest:
    """The lines of a coloured folder.

    Parameters
    ----------
    data
        as its colour.json holds it.
    kind
        of folder that it is to be, one of :data:`KINDS`.
    place
        where it was found, for messages.

    Raises
    ------
    MitsimError
        when it is of another kind or breaks a rule.
    """
    found = data.get("kind") if isinstance(data, dict) else type(data).__name__
    if found != kind:
        raise MitsimError(f"{place}: holds a {cut(str(found))}, not a {kind}; give the right folder")
    return validated(ColourManifest, data, f"{place}/{COLOUR}")


def same_lines(run: Path, calibration: Path) -> ColourManifest:
    """The lines of a coloured ``run``; MitsimError where its ``calibration`` has others, or either is not coloured."""
    lines, calibrated = read_colours(run, RUN), read_colours(calibration, CALIBRATION)
    ours, theirs = (dict(zip(each.names, each.wavelengths_nm, strict=True)) for each in (lines, calibrated))
    if ours != theirs:
        raise MitsimError(
            f"calibration {calibration}: its lines are {', '.join(theirs)}, but {run} has {', '.join(ours)}; "
            "calibrate each line of this projector"
        )
    return lines


def write_colours(folder: Path, colours: ColourManifest, **more: Any) -> None:
    """Write colour.json, all or nothing. MitsimError when it cannot be written.

    Parameters
    ----------
    folder
        that it is of.
    colours
        the folder's kind and lines.
    **more
        entries beside these.
    """
    write_json(folder / COLOUR, {**colours.model_dump(), **more})
