"""A coloured RUN or CAL folder in, the content of its lines' folders out; or the other way, from where it was kept.

A run behind colour filters is one RUN folder of all lines; of each there is what a perfect image would show.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic

from mitsim.core.colours import (
    CALIBRATION,
    COLOUR,
    RUN,
    ColourManifest,
    MosaicManifest,
    checked_colours,
    checked_mosaic,
    read_colours,
    read_mosaic,
)
from mitsim.core.errors import MitsimError
from mitsim.core.framefile import Channels, Metadata, read_frame, write_frame
from mitsim.core.jsonfile import MOST_BYTES, parse_json
from mitsim.core.manifests import MANIFEST, CalibrationManifest, RunManifest
from mitsim.core.output import LOCK, write_text
from mitsim.core.plainfile import read_text
from mitsim.core.recorders import TRUTH
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
        write_text(folder / COLOUR, self.text)


@dataclass(frozen=True, eq=False)
class Filtered:
    """Content of the folder of a run behind colour filters.

    Attributes
    ----------
    colours
        its lines and filters.
    text
        of its `colour.json`, letter by letter.
    shots
        frames of all lines at once.
    truths
        channels and metadata of each line's `truth.exr`, by the line's name; none of a real camera.
    """

    colours: MosaicManifest
    text: str
    shots: Packed[RunManifest]
    truths: Mapping[str, tuple[Channels, Metadata]]

    def fill(self, folder: Path) -> None:
        """Write all files into a ``folder`` that this process holds, and colour.json last."""
        self.shots.fill(folder)
        for name, truth in self.truths.items():
            (folder / name).mkdir()
            write_frame(folder / name / TRUTH, *truth)
        write_text(folder / COLOUR, self.text)


def filtered_run(folder: Path) -> Filtered:
    """The run behind colour filters in ``folder``. MitsimError when it is not a complete one."""
    colours = read_mosaic(folder)
    files = {name: folder / name / TRUTH for name in colours.names}
    truths = {name: read_frame(path) for name, path in files.items() if path.is_file()}
    return Filtered(colours, _text_of(folder), packed_run(folder), truths)


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
    colours = checked_colours(_parsed(text, place), kind, place)
    _check_names(colours, place, (COLOUR, LOCK))
    return colours


def unpacked_filters(text: str, shots: Packed[RunManifest], place: Path) -> MosaicManifest:
    """The lines and filters that an exchanged file has.

    Parameters
    ----------
    text
        of the colour.json that it holds.
    shots
        of the run, which lie beside the lines' folders.
    place
        the file, for messages.

    Raises
    ------
    MitsimError
        as :func:`unpacked_colours`.
    """
    colours = checked_mosaic(_parsed(text, place), place)
    _check_names(colours, place, (COLOUR, LOCK, MANIFEST, *shots.names))
    return colours


def _parsed(text: str, place: Path) -> Any:
    try:
        return parse_json(text)
    except ValueError as error:
        raise MitsimError(f"{place}: its {COLOUR} is not valid JSON ({error}); export it again") from error


def _check_names(colours: ColourManifest, place: Path, others: Sequence[str]) -> None:
    for name in {*others}.intersection(colours.names):
        raise MitsimError(f"{place}: a line is called {name}; give it a name of its own")


def line_of(held: Coloured[Manifest] | None, name: str) -> Packed[Manifest] | None:
    """The folder of the line ``name`` of ``held``; None of nothing."""
    return None if held is None else held.lines[name]


def run_parts(run: Packed[RunManifest] | Coloured[RunManifest] | Filtered) -> dict[str, Packed[RunManifest]]:
    """The shots that a ``run`` is of, as :func:`parts_of`."""
    return {"": run.shots} if isinstance(run, Filtered) else parts_of(run)


def parts_of(held: Packed[Manifest] | Coloured[Manifest]) -> dict[str, Packed[Manifest]]:
    """The folders that ``held`` is of, by the beginning of a message about each: of its line, or nothing."""
    if isinstance(held, Packed):
        return {"": held}
    return {f"{name}: ": part for name, part in held.lines.items()}


def _text_of(folder: Path) -> str:
    return read_text(folder / COLOUR, MOST_BYTES)
