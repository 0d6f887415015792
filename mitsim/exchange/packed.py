"""A RUN or CAL folder in, its manifests and files by name out; or the other way, from wherever they were kept.

Whatever lines a folder tells apart, its content is one :class:`Content`: of a mono folder it has one part, of a
coloured one a part for each line. A run behind colour filters is one RUN folder of all lines; of each there is what a
perfect image would show.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from mitsim.core.errors import MitsimError, cut
from mitsim.core.exr import Channel, Channels, Metadata, checksum, read_frame, verify, write_frame
from mitsim.core.files import LOCK, MOST_BYTES, fits_a_frame, parse_json, read_text, whole_folder, write_text
from mitsim.core.manifests import (
    CALIBRATION,
    COLOUR,
    MANIFEST,
    MOSAIC,
    RUN,
    SIDES,
    CalibrationManifest,
    ColourManifest,
    MosaicManifest,
    RunManifest,
    ShotFile,
    SpectralFolder,
    checked_colours,
    checked_manifest,
    open_lines,
    read_manifest,
    write_manifest,
)
from mitsim.core.runs import TRUTH, load_run

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
        of its `manifest.json`, letter by letter; empty where only the model is known, as of what is not exported.
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
    for name in (*(shot.file for shot in manifest.patterns.captures), *manifest.others.values()):
        if name in _OWN or not name.isprintable():
            raise MitsimError(f"{place}: a frame is called {cut(name)!r}; give it a name of its own")
    return manifest


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


def _text_of(folder: Path, name: str = MANIFEST) -> str:
    return read_text(folder / name, MOST_BYTES)


def _kinds_text(kinds: Mapping[str, tuple[object, ...]]) -> str:
    return ", ".join(f"{name} ({' '.join(map(str, kind))})" for name, kind in kinds.items())


# -------- The content of a whole folder, whatever lines it tells apart


@dataclass(frozen=True, eq=False)
class Content(Generic[Manifest]):
    """What a RUN or CAL folder holds.

    Attributes
    ----------
    parts
        content of each line's folder, by the line's name; that of the folder itself by "".
    colours
        lines, and filters where there are some; None of a folder that tells no lines apart.
    text
        of its `colour.json`, letter by letter.
    truths
        of a run behind filters: channels and metadata of each line's `truth.exr`, by its name; none of a real camera.
    """

    parts: Mapping[str, Packed[Manifest]]
    colours: ColourManifest | None = None
    text: str = ""
    truths: Mapping[str, tuple[Channels, Metadata]] = field(default_factory=dict)

    @property
    def filters(self) -> MosaicManifest | None:
        """The filters that its frames were seen through."""
        return self.colours if isinstance(self.colours, MosaicManifest) else None

    @property
    def names(self) -> tuple[str, ...]:
        """Of its lines; "" alone where it tells none apart."""
        return self.colours.names if self.colours else ("",)

    def of_line(self, name: str) -> Packed[Manifest]:
        """The folder that a line called ``name`` is in: its own, or that of all lines."""
        return self.parts.get(name) or self.parts[""]

    def fill(self, folder: Path) -> None:
        """Write all files into a ``folder`` that this process holds, colour.json last."""
        for name, part in self.parts.items():
            (folder / name).mkdir(exist_ok=True)
            part.fill(folder / name)
        for name, truth in self.truths.items():
            (folder / name).mkdir()
            write_frame(folder / name / TRUTH, *truth)
        if self.colours:
            write_text(folder / COLOUR, self.text)


Run = Content[RunManifest]
Calibration = Content[CalibrationManifest]


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


def run_content(folder: Path) -> Run:
    """The RUN ``folder``, coloured, behind colour filters, or neither. MitsimError when it, or a line's folder, is not
    a complete one."""
    lines = open_lines(folder, RUN, MOSAIC)
    files = {name: folder / name / TRUTH for name in (lines.names if lines.filters else ())}
    truths = {name: read_frame(path) for name, path in files.items() if path.is_file()}
    return replace(_content(lines, pack_run), truths=truths)


def calibration_content(folder: Path) -> Calibration:
    """The CAL ``folder``, coloured or not. MitsimError when it, or a line's folder, is not a complete one."""
    return _content(open_lines(folder, CALIBRATION), pack_calibration)


def _content(lines: SpectralFolder, pack: Callable[[Path], Packed[Manifest]]) -> Content[Manifest]:
    text = _text_of(lines.folder, COLOUR) if lines.colours else ""
    return Content({name: pack(part) for name, part in lines.parts.items()}, lines.colours, text)


def unpack_colours(text: str, kind: str, place: Path, files: Sequence[str] = ()) -> ColourManifest:
    """The lines, and filters, that an exchanged file has.

    Parameters
    ----------
    text
        of the colour.json that it holds.
    kind
        of folder that this is to be of, one of :data:`mitsim.core.manifests.KINDS`.
    place
        the file, for messages.
    files
        names of what lies beside the lines' folders.

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
    for name in {COLOUR, LOCK, *((MANIFEST, *files) if kind == MOSAIC else ())}.intersection(colours.names):
        raise MitsimError(f"{place}: a line is called {name}; give it a name of its own")
    return colours
