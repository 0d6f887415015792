"""Frames that characterise a camera: the checked list of a real camera's frames, or the sizes of a simulation.

The list is `session.toml` or `session.json`, as that of a calibration. No frame is opened, and numpy is not imported.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import FailFast, Field

from mitsim.core.configuration import Configuration, Positive, validate
from mitsim.core.errors import MitsimError
from mitsim.core.imagelist import Raw, Wanted
from mitsim.core.manifests import FileName
from mitsim.devices.framelist import read_list
from mitsim.devices.sensor import SensorModel

_MOST_SETS, _MOST_FRAMES = 4096, 10_000
"""Of a list, and frames of a set: ten times what EMVA 1288's longest procedures take."""


def capacity_of(sensor: SensorModel) -> float:
    """Return the electrons that saturate a pixel: its full well, or the ADC's end; MitsimError without either."""
    full = sensor.superpixel_full_well_e
    if sensor.largest_dn is not None:
        full = min(full, (sensor.largest_dn - sensor.superpixel_black_level_dn) / sensor.gain_dn_per_e)
    if not math.isfinite(full):
        raise MitsimError(
            f"camera {sensor.name!r}: has neither a full well nor an ADC, so no light saturates it; "
            "give full_well_e or bits"
        )
    return full


class DarkSet(Configuration):
    """Frames that were taken alike, without light."""

    files: Annotated[tuple[FileName, ...], FailFast()] = Field(strict=False, max_length=_MOST_FRAMES)
    """Names of the frames in the folder, without a path: two, or more."""
    exposure_s: Positive
    """Exposure of each [s]."""


class LitSet(DarkSet):
    """Frames that were taken alike, under even light."""

    light: Positive = 1.0
    """Power of the lamp, over that which `photons_per_s` states."""


class FlatList(Configuration):
    """What a camera's frames are of, and how they are read."""

    name: str = Field(min_length=1, max_length=200)
    """What the camera is called."""
    pixel_pitch_um: float = Field(ge=1e-3, le=1e4)
    """Distance between centres of the frames' pixels, um."""
    bits: int | None = Field(default=None, ge=1, le=24)
    """Bits of a number; none: real numbers."""
    photons_per_s: Positive | None = None
    """Photons that fall on a pixel in a second under a `light` of 1; none: not known, and no quantum efficiency."""
    source: str = Field(default="measured by mitsim characterise", max_length=1000)
    """Which specimen, gain setting and temperature: goes into the camera's file."""
    raw: Raw | None = None
    """How frames without a header are read; none: there are none."""
    lit: Annotated[tuple[LitSet, ...], FailFast()] = Field(strict=False, max_length=_MOST_SETS)
    """Sets under even light."""
    dark: Annotated[tuple[DarkSet, ...], FailFast()] = Field(strict=False, max_length=_MOST_SETS)
    """Sets in the dark, one for each exposure under light."""


@dataclass(frozen=True)
class FlatFrames:
    """A camera's frames, every file of which is there.

    Attributes
    ----------
    folder
        that holds them.
    listed
        what its list says.
    """

    folder: Path
    listed: FlatList

    @property
    def wanted(self) -> Wanted:
        """How its frames are read."""
        return Wanted(raw=self.listed.raw)

    @property
    def sets(self) -> tuple[DarkSet, ...]:
        """All sets, lit ones first."""
        return (*self.listed.lit, *self.listed.dark)


def load_flats(folder: Path | str) -> FlatFrames:
    """Which file of the ``folder`` shows what.

    MitsimError for a folder without a list, a list that breaks a rule, and for frames that are missing or alone.
    """
    folder = Path(folder)
    place, data = read_list(folder, "name, pixel_pitch_um, bits, and sets lit and dark of files and exposure_s")
    flats = FlatFrames(folder, validate(FlatList, data, f"frames {place}"))
    _check_sets(flats)
    return flats


def _check_sets(flats: FlatFrames) -> None:
    """Every frame is there and has a partner, and every exposure under light one in the dark; MitsimError otherwise."""
    where, seen = f"frames {flats.folder}", set[str]()
    for kind, sets in (("lit", flats.listed.lit), ("dark", flats.listed.dark)):
        if not sets:
            raise MitsimError(f"{where}: no set is {kind}; give pairs of frames under even light, and in the dark")
        for number, each in enumerate(sets):
            if len(each.files) < 2:
                held = each.files[0] if each.files else "no frame"
                raise MitsimError(
                    f"{where}: {kind}.{number} holds {held} alone, of {each.exposure_s:g} s, and one frame tells no "
                    "noise; add its partner, taken alike"
                )
            for name in each.files:
                if name in seen:
                    raise MitsimError(f"{where}: {name} is listed twice; give each frame its own file")
                seen.add(name)
                if not (flats.folder / name).is_file():
                    raise MitsimError(f"{where}: {name} is listed, but no file of that name is there; copy it there")
    exposures = {each.exposure_s for each in flats.listed.dark}
    for number, each in enumerate(flats.listed.lit):
        if each.exposure_s not in exposures:
            raise MitsimError(
                f"{where}: lit.{number} ({each.files[0]}) is exposed for {each.exposure_s:g} s, and no dark set is; "
                "add a dark pair of that exposure"
            )
