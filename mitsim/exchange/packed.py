"""A RUN or CAL folder in, its manifest and files by name out; or the other way, from wherever they were kept.

A run behind colour filters is one RUN folder of all lines; of each there is what a perfect image would show.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from mitsim.core.errors import MitsimError, cut
from mitsim.core.exr import Channel, Channels, Metadata, checksum, read_frame, verify, write_frame
from mitsim.core.files import LOCK, MOST_BYTES, fits_a_frame, json_text, parse_json, read_text, whole_folder, write_text
from mitsim.core.manifests import (
    MANIFEST,
    SIDES,
    CalibrationManifest,
    RunManifest,
    ShotFile,
    checked_manifest,
    read_manifest,
    write_manifest,
)
from mitsim.core.runs import TRUTH, load_run
from mitsim.core.spectral_manifests import (
    CALIBRATION,
    COLOUR,
    RUN,
    ColourManifest,
    MosaicManifest,
    checked_colours,
    checked_mosaic,
    is_coloured,
    is_mosaic,
    read_colours,
    read_mosaic,
)

Manifest = TypeVar("Manifest", RunManifest, CalibrationManifest)
Reader = Callable[[str], tuple[Channels, Metadata]]
"""Channels and metadata of a file, by its name."""
FACTORS = tuple(f"{name}.exr" for name in SIDES)
"""Names of a CAL folder's files: the left factor's and the right one's."""
_OWN = frozenset((".", "..", MANIFEST, LOCK, TRUTH))
"""Names that no frame may have."""


@dataclass(frozen=True, eq=False)
class Packed(Generic[Manifest]):
    """A folder's content, its files read when they are asked for.

    Attributes
    ----------
    manifest
        of the folder.
    text
        of its `manifest.json`, letter by letter; empty where only the model is known.
    names
        of its files.
    read
        channels, (rows, columns) each, and metadata of a file, by its name.
    place
        folder or file that it was found in, for messages.
    """

    manifest: Manifest
    text: str
    names: tuple[str, ...]
    read: Reader
    place: Path

    def save(self, folder: Path | str) -> Path:
        """Write the ``folder``, new or empty, whole or not at all; returns it. MitsimError where that cannot be
        written, or a file cannot be read."""
        with whole_folder(folder) as place:
            self.fill(place)
        return Path(folder)

    def fill(self, folder: Path) -> None:
        """Write all files into a ``folder`` that this process holds (:func:`mitsim.core.files.whole_folder`).

        The manifest is written letter by letter, but for checksums of files whose bytes are others now: OpenEXR of
        another version, or channels that the exchange left out.
        """
        for name in dict.fromkeys(self.names):
            channels, metadata = self.read(name)
            try:
                write_frame(folder / name, channels, metadata)
            except (TypeError, ValueError) as error:
                raise MitsimError(f"{self.place}: {name} is no frame ({error}); export it again") from error
        stated = self.manifest.checksums
        sums = {name: checksum(folder / name) for name in stated if name in self.names}
        if sums == stated and self.text:
            write_text(folder / MANIFEST, self.text)
        else:
            write_manifest(folder, self.manifest.model_copy(update={"checksums": sums}))


def pack_run(folder: Path) -> Packed[RunManifest]:
    """The RUN ``folder``. MitsimError when it is not a complete one."""
    shots = load_run(folder)
    return Packed(shots.manifest, _text_of(folder), shots.files, shots.read, folder)


def pack_calibration(folder: Path) -> Packed[CalibrationManifest]:
    """The CAL ``folder``. MitsimError when it is not a complete one."""
    manifest = read_manifest(folder, CalibrationManifest)

    def read(name: str) -> tuple[Channels, Metadata]:
        verify(folder, name, manifest.checksums, "calibrate again")
        return read_frame(folder / name)

    for name in FACTORS:
        if "factor" not in read(name)[0]:
            raise MitsimError(f"{folder / name}: channels are {', '.join(read(name)[0])}; factor is needed")
    return Packed(manifest, _text_of(folder), FACTORS, read, folder)


def shots_of(run: Packed[RunManifest]) -> Iterator[tuple[ShotFile, Channels, Metadata]]:
    """Every shot of a ``run`` with its channels, (rows, columns) each, and metadata, read one at a time.

    MitsimError for a shot without DN, or of another shape or other channels than the first: elsewhere one array holds
    them all.
    """
    first: Mapping[str, tuple[object, ...]] | None = None
    for shot in run.manifest.patterns.captures:
        channels, metadata = run.read(shot.file)
        kinds = {name: (values.dtype.name, *values.shape) for name, values in sorted(channels.items())}
        first = first or kinds
        if "DN" not in kinds or kinds != first:
            raise MitsimError(
                f"{run.place / shot.file}: holds {_kinds_text(kinds)}, but the first frame {_kinds_text(first)}; "
                "frames of one shape with the same channels, DN among them, can be exchanged"
            )
        yield shot, channels, metadata


def unpack(text: str, model: type[Manifest], place: Path) -> Manifest:
    """The manifest in the ``text`` that an exchanged file holds.

    Parameters
    ----------
    text
        of a `manifest.json`.
    model
        of the manifest.
    place
        the file, for messages.

    Raises
    ------
    MitsimError
        when it is not JSON, or breaks a rule of its format.
    """
    try:
        if len(text) > MOST_BYTES:
            raise ValueError(f"it has {len(text)} letters; at most {MOST_BYTES} are allowed")
        data = parse_json(text)
    except ValueError as error:
        raise MitsimError(f"{place}: its manifest is not valid JSON ({error}); export it again") from error
    return checked_manifest(data, model, place)


def unpack_run(text: str, place: Path) -> RunManifest:
    """The manifest of a run in the ``text`` that an exchanged file holds, found at ``place``; with names of frames that
    a folder can have. MitsimError as for :func:`unpack`."""
    manifest = unpack(text, RunManifest, place)
    ambient = manifest.ambient_frame
    for name in (*(shot.file for shot in manifest.patterns.captures), *([ambient.file] if ambient else [])):
        if name in _OWN or not name.isprintable():
            raise MitsimError(f"{place}: a frame is called {cut(name)!r}; give it a name of its own")
    return manifest


def manifest_text(manifest: RunManifest | CalibrationManifest, text: str) -> str:
    """The ``text`` of a manifest's file, or, where there is none, that of the ``manifest``."""
    return text or json_text(manifest)


def as_channel(values: object, name: str, place: Path) -> Channel:
    """An array of an exchanged file as a channel of a frame.

    Parameters
    ----------
    values
        (rows, columns) float32 or uint32.
    name
        of the channel, for messages.
    place
        the file, for messages.

    Raises
    ------
    MitsimError
        for another type or shape.
    """
    array = np.asarray(values)
    if array.dtype not in (np.float32, np.uint32) or array.ndim != 2 or not array.size or not fits_a_frame(array.shape):
        raise MitsimError(
            f"{place}: {name} is {array.dtype} of shape {array.shape}; float32 or uint32 of rows x columns is needed"
        )
    return np.ascontiguousarray(array)


def _text_of(folder: Path) -> str:
    return read_text(folder / MANIFEST, MOST_BYTES)


def _kinds_text(kinds: Mapping[str, tuple[object, ...]]) -> str:
    return ", ".join(f"{name} ({' '.join(map(str, kind))})" for name, kind in kinds.items())


# -------- A coloured RUN or CAL folder in, the content of its lines' folders out


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


Run = Packed[RunManifest] | Coloured[RunManifest] | Filtered
Calibration = Packed[CalibrationManifest] | Coloured[CalibrationManifest]


@dataclass(frozen=True, eq=False)
class Loaded:
    """What an exchanged file holds.

    Attributes
    ----------
    run, calibration
        content of the folders, where the file has them.
    left_out
        parts of a run that the file does not hold.
    """

    run: Run | None
    calibration: Calibration | None
    left_out: tuple[str, ...] = ()


def any_run(folder: Path) -> Run:
    """The RUN ``folder``, coloured, behind colour filters, or neither. MitsimError when it, or a line's folder, is not
    a complete one."""
    if is_mosaic(folder):
        filters = read_mosaic(folder)
        files = {name: folder / name / TRUTH for name in filters.names}
        truths = {name: read_frame(path) for name, path in files.items() if path.is_file()}
        return Filtered(filters, _colour_text_of(folder), pack_run(folder), truths)
    if not is_coloured(folder):
        return pack_run(folder)
    colours = read_colours(folder, RUN)
    return Coloured(colours, _colour_text_of(folder), {name: pack_run(folder / name) for name in colours.names})


def any_calibration(folder: Path) -> Calibration:
    """The CAL ``folder``, coloured or not. MitsimError when it, or a line's folder, is not a complete one."""
    if not is_coloured(folder):
        return pack_calibration(folder)
    colours = read_colours(folder, CALIBRATION)
    lines = {name: pack_calibration(folder / name) for name in colours.names}
    return Coloured(colours, _colour_text_of(folder), lines)


def unpack_colours(text: str, kind: str, place: Path) -> ColourManifest:
    """The lines that an exchanged file has.

    Parameters
    ----------
    text
        of the colour.json that it holds.
    kind
        of folder that this is to be of, one of :data:`mitsim.core.spectral_manifests.KINDS`.
    place
        the file, for messages.

    Raises
    ------
    MitsimError
        when the text is not JSON, breaks a rule of its format, or names a folder that cannot be.
    """
    colours = checked_colours(_parse(text, place), kind, place)
    _check_names(colours, place, (COLOUR, LOCK))
    return colours


def unpack_filters(text: str, shots: Packed[RunManifest], place: Path) -> MosaicManifest:
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
        as :func:`unpack_colours`.
    """
    colours = checked_mosaic(_parse(text, place), place)
    _check_names(colours, place, (COLOUR, LOCK, MANIFEST, *shots.names))
    return colours


def _parse(text: str, place: Path) -> Any:
    try:
        return parse_json(text)
    except ValueError as error:
        raise MitsimError(f"{place}: its {COLOUR} is not valid JSON ({error}); export it again") from error


def _check_names(colours: ColourManifest, place: Path, others: Sequence[str]) -> None:
    for name in {*others}.intersection(colours.names):
        raise MitsimError(f"{place}: a line is called {name}; give it a name of its own")


def line_of(held: Packed[Manifest] | Coloured[Manifest] | None, name: str) -> Packed[Manifest] | None:
    """The folder of the line ``name`` of ``held``, which is that folder itself where it tells no lines apart."""
    return held.lines[name] if isinstance(held, Coloured) else held


def run_parts(run: Run) -> dict[str, Packed[RunManifest]]:
    """The shots that a ``run`` is of, as :func:`parts_of`."""
    return {"": run.shots} if isinstance(run, Filtered) else parts_of(run)


def parts_of(held: Packed[Manifest] | Coloured[Manifest]) -> dict[str, Packed[Manifest]]:
    """The folders that ``held`` is of, by the beginning of a message about each: of its line, or nothing."""
    if isinstance(held, Packed):
        return {"": held}
    return {f"{name}: ": part for name, part in held.lines.items()}


def _colour_text_of(folder: Path) -> str:
    return read_text(folder / COLOUR, MOST_BYTES)
