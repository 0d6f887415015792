"""A coloured RUN or CAL folder in, the content of its lines' folders out; or the other way, from where it was kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Generic

from mitsim.core.colours import CALIBRATION, COLOUR, RUN, ColourManifest, checked_colours, read_colours
from mitsim.core.errors import MitsimError
from mitsim.core.jsonfile import MOST_BYTES, parse_json
from mitsim.core.manifests import CalibrationManifest, RunManifest
from mitsim.core.output import LOCK
from mitsim.core.plainfile import read_text
from mitsim.exchange.packed import Manifest, Packed, packed_calibration, packed_run


@dataclass(frozen=True, eq=False)
class Coloured(Generic[Manifest]):
    """A coloured folder's content.

    Attributes
    ----------
    colours
        its lines.
    text
        of its `colour.json`, letter by letter.
    lines
        content of each line's folder, by its name.
    """

    colours: ColourManifest
    text: str
    lines: Mapping[str, Packed[Manifest]]

    def fill(self, folder: Path) -> None:
        """Write all folders into a ``folder`` that this process holds, and colour.json last."""
        for name, held in self.lines.items():
            (folder / name).mkdir()
            held.fill(folder / name)
        (folder / COLOUR).write_text(self.text, encoding="utf-8")


def coloured_run(folder: Path) -> Coloured[RunManifest]:
    """The coloured RUN ``folder``. MitsimError when it, or a line's folder, is not a complete one."""
    colours = read_colours(folder, RUN)
    return Coloured(colours, _text_of(folder), {name: packed_run(folder / name) for name in colours.names})


def coloured_calibration(folder: Path) -> Coloured[CalibrationManifest]:
    """The coloured CAL ``folder``. MitsimError when it, or a line's folder, is not a complete one."""
    colours = read_colours(folder, CALIBRATION)
    return Coloured(colours, _text_of(folder), {name: packed_calibration(folder / name) for name in colours.names})


def unpacked_colours(text: str, kind: str, place: Path) -> ColourManifest:
    """The lines that an exchanged file has.

    Parameters
    ----------
    text
        of the colour.json that it holds.
    kind
        of folder that this is to be of, one of :data:`mitsim.core.colours.KINDS`.
    place
        the file, for messages.

    Raises
    ------
    MitsimError
        when the text is not JSON, breaks a rule of its format, or names a folder that cannot be.
    """
    try:
        data = parse_json(text)
    except ValueError as error:
        raise MitsimError(f"{place}: its {COLOUR} is not valid JSON ({error}); export it again") from error
    colours = checked_colours(data, kind, place)
    for name in {COLOUR, LOCK}.intersection(colours.names):
        raise MitsimError(f"{place}: a line is called {name}; give it a name of its own")
    return colours


def line_of(held: Coloured[Manifest] | None, name: str) -> Packed[Manifest] | None:
    """The folder of the line ``name`` of ``held``; None of nothing."""
    return None if held is None else held.lines[name]


def parts_of(held: Packed[Manifest] | Coloured[Manifest]) -> dict[str, Packed[Manifest]]:
    """The folders that ``held`` is of, by the beginning of a message about each: of its line, or nothing."""
    if isinstance(held, Packed):
        return {"": held}
    return {f"{name}: ": part for name, part in held.lines.items()}


def _text_of(folder: Path) -> str:
    return read_text(folder / COLOUR, MOST_BYTES)
