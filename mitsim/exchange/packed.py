"""RUN and CAL folders as :class:`Content`, independent of their storage, and one HDF5 file for both, bit for bit.

A mono folder has one part, a coloured one a part for each line. A run behind colour filters is one RUN folder with a
truth for each line. docs/exchange.md describes the layout of HDF5 files.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np

from mitsim.core import colour_files, files, manifests
from mitsim.core.arrays import PACKED, checked_hdf5, hdf5_errors, whole_hdf5
from mitsim.core.colour_files import ColourManifest
from mitsim.core.errors import ArgumentError, MitsimError, cut
from mitsim.core.exr import Channel, Channels, Metadata, Value, checksum, read_frame, verify, write_frame
from mitsim.core.files import MOST_BYTES, parse_json, read_text, write_text
from mitsim.core.job import Cost, Limits
from mitsim.core.manifests import CalibrationManifest, RunManifest, ShotFile
from mitsim.core.runs import TRUTH, load_run
from mitsim.version import __version__

if TYPE_CHECKING:
    import h5py

Manifest = TypeVar("Manifest", RunManifest, CalibrationManifest)
FACTORS = tuple(f"{name}.exr" for name in manifests.SIDES)

# -------- The content of a folder


@dataclass(frozen=True, eq=False)
class Packed(Generic[Manifest]):
    """Content of a folder, whose files are read on request.

    Attributes
    ----------
    text
        Exact text of `manifest.json`; empty if only the model is known.
    read
        Function from a file name to channels, (rows, columns) each, and metadata.
    """

    manifest: Manifest
    text: str
    names: tuple[str, ...]
    read: Callable[[str], tuple[Channels, Metadata]]
    place: Path

    def fill(self, folder: Path) -> None:
        """Write all files into a ``folder`` that this process holds.

        The manifest keeps its text, except checksums of files whose bytes differ because of another OpenEXR or omitted
        channels.
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
            write_text(folder / manifests.MANIFEST, self.text)
        else:
            manifests.write_manifest(folder, self.manifest.model_copy(update={"checksums": sums}))


@dataclass(frozen=True, eq=False)
class Content(colour_files.Coloured, Generic[Manifest]):
    """Content of a RUN or CAL folder.

    Attributes
    ----------
    parts
        Content of each line's folder by the line's name; of the folder itself by "".
    text
        Exact text of its `colour.json`.
    truths
        Channels and metadata of each line's `truth.exr` behind filters; none for a real camera.
    """

    parts: Mapping[str, Packed[Manifest]]
    colours: ColourManifest | None = None
    text: str = ""
    truths: Mapping[str, tuple[Channels, Metadata]] = field(default_factory=dict)

    def fill(self, folder: Path) -> None:
        for name, part in self.parts.items():
            (folder / name).mkdir(exist_ok=True)
            part.fill(folder / name)
        for name, truth in self.truths.items():
            (folder / name).mkdir()
            write_frame(folder / name / TRUTH, *truth)
        if self.colours:
            write_text(folder / colour_files.COLOUR, self.text)


Run = Content[RunManifest]
Calibration = Content[CalibrationManifest]
Loaded = tuple[Run | None, Calibration | None]
"""Run and calibration of an exchanged file, if present."""


def pack_run(folder: Path) -> Packed[RunManifest]:
    shots = load_run(folder)
    return Packed(shots.manifest, read_text(folder / manifests.MANIFEST, MOST_BYTES), shots.files, shots.read, folder)


def pack_calibration(folder: Path) -> Packed[CalibrationManifest]:
    manifest = manifests.read_manifest(folder, CalibrationManifest)

    def read(name: str) -> tuple[Channels, Metadata]:
        verify(folder, name, manifest.checksums, "calibrate again")
        return read_frame(folder / name)

    for name in FACTORS:
        if "factor" not in (channels := read(name)[0]):
            raise MitsimError(f"{folder / name}: channels are {', '.join(channels)}; factor is needed")
    return Packed(manifest, read_text(folder / manifests.MANIFEST, MOST_BYTES), FACTORS, read, folder)


def read_content(folder: Path, *kinds: str) -> Content[Any]:
    """Return a CAL folder if ``kinds`` of several lines are of calibrations, else a RUN folder."""
    lines = colour_files.open_lines(folder, *kinds)
    pack: Any = pack_calibration if colour_files.CALIBRATION in kinds else pack_run
    files = {name: folder / name / TRUTH for name in (lines.names if lines.filters else ())}
    truths = {name: read_frame(path) for name, path in files.items() if path.is_file()}
    text = read_text(folder / colour_files.COLOUR, MOST_BYTES) if lines.colours else ""
    return Content({name: pack(part) for name, part in lines.parts.items()}, lines.colours, text, truths)


def shots_of(run: Packed[RunManifest]) -> Iterator[tuple[ShotFile, Channels, Metadata]]:
    """Yield every shot with its channels, (rows, columns) each, and metadata, read one at a time.

    MitsimError for a shot that does not have the shape and channels of the first, because other formats use one array.
    """
    first = ""
    for shot in run.manifest.patterns.captures:
        channels, metadata = run.read(shot.file)
        kinds = ", ".join(
            f"{name} ({' '.join(map(str, (values.dtype.name, *values.shape)))})"
            for name, values in sorted(channels.items())
        )
        first = first or kinds
        if "DN" not in channels or kinds != first:
            raise MitsimError(
                f"{run.place / shot.file}: holds {kinds}, but the first frame {first}; "
                "frames of one shape with the same channels, DN among them, can be exchanged"
            )
        yield shot, channels, metadata


# -------- HDF5 files: shots are chunks of their own, so that one is read without the others


def as_channel(values: object, name: str, place: Path) -> Channel:
    """Return an array as a channel of a frame; MitsimError unless it is (rows, columns) float32 or uint32."""
    array = np.asarray(values)
    fits = array.ndim == 2 and array.size and files.fits_a_frame(array.shape)
    if array.dtype not in (np.float32, np.uint32) or not fits:
        raise MitsimError(
            f"{place}: {name} is {array.dtype} of shape {array.shape}; float32 or uint32 of rows x columns is needed"
        )
    return np.ascontiguousarray(array)


_LINES = "lines"
"""Group of the lines' groups."""
LAYOUT = 1
"""Layout version that is written, and the newest that is read: attribute `mitsim_exchange` of the file."""


def write_hdf5(path: Path, run: Run, calibration: Calibration | None = None) -> tuple[str, ...]:
    """Write a run, and a calibration of the same lines, to one file, whole or not at all; nothing is omitted.

    MitsimError for shots of a line that differ in shape or channels, or a file that cannot be read or written.
    """

    def write_text(group: h5py.Group, name: str, text: str) -> None:
        # Of bytes with their length: manifests outgrow an attribute, and an HDF5 text ends at its first zero.
        group.create_dataset(name, data=np.frombuffer(text.encode(), dtype=np.uint8), **PACKED)

    def write_frames(group: h5py.Group, files: Mapping[str, tuple[Channels, Metadata]]) -> None:
        for name, (channels, metadata) in files.items():
            held = group.create_group(name)
            for channel, values in channels.items():
                held.create_dataset(channel, data=values, **PACKED)
            held.create_dataset("metadata", data=[json.dumps(dict(metadata))])

    def write_shots(place: h5py.Group, shots: Packed[RunManifest]) -> None:
        group = place.create_group("run", track_order=True)
        write_text(group, "manifest", shots.text)
        captures, stacks, texts = shots.manifest.patterns.captures, group.create_group("shots", track_order=True), []
        for index, (_, channels, known) in enumerate(shots_of(shots)):
            for name, values in channels.items():
                if index == 0:
                    shape = len(captures), *values.shape
                    stacks.create_dataset(name, shape, values.dtype, chunks=(1, *values.shape), **PACKED)
                stacks[name][index] = values
            texts.append(json.dumps(dict(known)))
        group.create_dataset("metadata", data=texts)
        numbers = np.array([(shot.row, shot.column, shot.sign) for shot in captures], np.int32)
        group.create_dataset("pattern", data=numbers).attrs["columns"] = (
            "column of P_L from 0, column of P_R from 0, sign"
        )
        for name, matrix in zip(("P_L", "P_R"), shots.manifest.patterns.matrices, strict=True):
            group.create_dataset(name, data=matrix, **PACKED)
        others = {**shots.manifest.others, "truth": TRUTH}
        write_frames(group, {name: shots.read(file) for name, file in others.items() if file in shots.names})

    with whole_hdf5(path) as file:
        file.attrs["mitsim_exchange"] = LAYOUT
        file.attrs["mitsim_version"] = __version__
        for held in (run, calibration):
            if held is not None and held.colours:
                write_text(file, held.colours.kind, held.text)
        if "" in run.parts:
            write_shots(file, run.parts[""])
        lines = file.create_group(_LINES, track_order=True) if run.colours else None
        for name in run.names:
            place = file if lines is None else lines.create_group(name, track_order=True)
            if name and name in run.parts:
                write_shots(place, run.parts[name])
            if name in run.truths:
                write_frames(place, {"truth": run.truths[name]})
            if calibration is not None:
                factors, group = calibration.parts[name], place.create_group("calibration", track_order=True)
                write_text(group, "manifest", factors.text)
                write_frames(group, {Path(name).stem: factors.read(name) for name in FACTORS})
    return ()


@contextmanager
def load_hdf5(path: Path | str, channel: str | None = None) -> Iterator[Loaded]:
    """Open the folders in a file while the context lasts; MitsimError if it is unknown or unsafe."""
    path = Path(path)
    if channel is not None:
        raise ArgumentError("channel", f"{channel}: {path} has frames of one; leave it out")
    with checked_hdf5(path, lambda _: 0.0) as file:  # _frame checks what is read at once
        with hdf5_errors(path):
            layout = file.attrs.get("mitsim_exchange")
            if not isinstance(layout, (int, np.integer)) or not 1 <= layout <= LAYOUT:
                raise MitsimError(
                    f"{path}: is no HDF5 file of `mitsim export` (mitsim_exchange is {layout}, 1 to {LAYOUT} are read)"
                )
            kind = colour_files.RUN if colour_files.RUN in file else colour_files.MOSAIC
            own = {"": _run_in(file, path)} if _LINES not in file or kind == colour_files.MOSAIC else {}
            if _LINES not in file:
                run, factors = Content(own), _calibration_in(file, path) if "calibration" in file else None
                calibration = Content({"": factors}) if factors else None
            else:
                text, colours = _colours_in(file, kind, path, own[""].names if own else ())
                group = hdf5_item(file, _LINES, path, "Group")
                lines = {name: hdf5_item(group, name, path, "Group") for name in colours.names}
                truths = {name: line for name, line in lines.items() if "truth" in line and own}
                run = Content(
                    own or {name: _run_in(line, path) for name, line in lines.items()},
                    colours,
                    text,
                    {name: _frame_in(line, "truth", path) for name, line in truths.items()},
                )
                calibration = None
                if colour_files.CALIBRATION in file:
                    text, colours = _colours_in(file, colour_files.CALIBRATION, path)
                    for name in colours.names:
                        if "calibration" not in lines.get(name, ()):
                            raise MitsimError(f"{path}: has no calibration of {name}; export it again")
                    parts = {name: _calibration_in(lines[name], path) for name in colours.names}
                    calibration = Content(parts, colours, text)
        yield run, calibration


def _run_in(place: h5py.Group, path: Path) -> Packed[RunManifest]:
    group = hdf5_item(place, "run", path, "Group")
    text, data = _json_in(group, "manifest", path)
    manifest = manifests.checked_manifest(data, RunManifest, path)
    for name in (*(shot.file for shot in manifest.patterns.captures), *manifest.others.values()):
        if name in (".", "..", manifests.MANIFEST, files.LOCK, TRUTH) or not name.isprintable():
            raise MitsimError(f"{path}: a frame is called {cut(name)!r}; give it a name of its own")
    captures, stacks = manifest.patterns.captures, hdf5_item(group, "shots", path, "Group")
    channels = {name: hdf5_item(stacks, name, path) for name in stacks}
    shapes = {values.shape for values in channels.values()}
    if "DN" not in channels or len(shapes) != 1 or next(iter(shapes))[0] != len(captures):
        raise MitsimError(
            f"{path}: /run/shots holds arrays of shapes {sorted(shapes)}; one shape of {len(captures)} x rows x "
            "columns, DN among them, is needed"
        )
    metadata = hdf5_item(group, "metadata", path)
    index = {shot.file: number for number, shot in enumerate(captures)}
    others = {file: name for name, file in manifest.others.items()} | ({TRUTH: "truth"} if "truth" in group else {})

    def read(name: str) -> tuple[Channels, Metadata]:
        with hdf5_errors(path):
            if name in others:
                return _frame_in(group, others[name], path)
            number = index[name]
            frame = {key: as_channel(values[number], f"/run/shots/{key}", path) for key, values in channels.items()}
            return frame, _metadata_in(metadata, number, path)

    return Packed(manifest, text, (*(shot.file for shot in captures), *others), read, path)


def _calibration_in(place: h5py.Group, path: Path) -> Packed[CalibrationManifest]:
    group = hdf5_item(place, "calibration", path, "Group")
    text, data = _json_in(group, "manifest", path)

    def read(name: str) -> tuple[Channels, Metadata]:
        with hdf5_errors(path):
            return _frame_in(group, Path(name).stem, path)

    return Packed(manifests.checked_manifest(data, CalibrationManifest, path), text, FACTORS, read, path)


def _colours_in(place: h5py.Group, kind: str, path: Path, beside: Sequence[str] = ()) -> tuple[str, ColourManifest]:
    """Return text and content of a colour.json of that ``kind``; ``beside`` are names beside the lines' folders."""
    text, data = _json_in(place, kind, path)
    colours = colour_files.checked_colours(data, kind, path)
    taken = {colour_files.COLOUR, files.LOCK, *((manifests.MANIFEST, *beside) if kind == colour_files.MOSAIC else ())}
    for name in taken.intersection(colours.names):
        raise MitsimError(f"{path}: a line is called {name}; give it a name of its own")
    return text, colours


def _json_in(group: h5py.Group, name: str, path: Path) -> tuple[str, Any]:
    """Return a text that is stored as bytes, and the data in it; MitsimError if it is invalid or too long."""
    held = hdf5_item(group, name, path)
    if held.dtype != np.uint8 or held.size > MOST_BYTES:
        raise MitsimError(
            f"{path}: {held.name} is {held.dtype} of shape {held.shape}; a text of at most {MOST_BYTES} bytes is needed"
        )
    text = str(held[()].tobytes().decode("utf-8"))
    try:
        return text, parse_json(text)
    except ValueError as error:
        raise MitsimError(f"{path}: {held.name} is not valid JSON ({error}); export it again") from error


def _frame_in(place: h5py.Group, name: str, path: Path) -> tuple[Channels, Metadata]:
    group, channels = hdf5_item(place, name, path, "Group"), {}
    for key in group:
        if key != "metadata":
            array = hdf5_item(group, key, path)
            Cost(memory_bytes=array.nbytes).check(f"{path}: {array.name}", Limits())
            channels[key] = as_channel(array[()], array.name, path)
    return channels, _metadata_in(hdf5_item(group, "metadata", path), 0, path)


def _metadata_in(texts: h5py.Dataset, number: int, path: Path) -> dict[str, Value]:
    # HDF5 reads zeros beyond the end of a file that was cut short after it was opened.
    if path.stat().st_size < texts.file.id.get_filesize():
        raise ValueError("it was cut short while it was read")
    text = texts[number] if texts.ndim == 1 else None
    if not isinstance(text, bytes):
        raise MitsimError(f"{path}: {texts.name} is {texts.dtype} of shape {texts.shape}; a text a frame is needed")
    known = parse_json(text.decode("utf-8"))
    if not isinstance(known, dict) or not all(isinstance(value, (str, int, float)) for value in known.values()):
        raise MitsimError(f"{path}: metadata of a frame is no object of texts and numbers; export it again")
    return known


def hdf5_item(parent: h5py.Group, name: str, path: Path, kind: str = "Dataset") -> Any:
    """Return an item of a group; MitsimError if it is not of that ``kind``, or an array too large for frames."""
    item = parent.get(name)
    if type(item).__name__ != kind:
        what = "is missing" if item is None else f"is no {kind.lower()}"
        raise MitsimError(f"{path}: {parent.name.rstrip('/')}/{name} {what}; export it again")
    if kind == "Dataset" and item.shape is None:
        raise MitsimError(f"{path}: {item.name} is empty; export it again")
    if kind == "Dataset" and not files.fits_a_frame(item.shape[1:]):
        raise MitsimError(f"{path}: {item.name} claims {item.shape}; {files.FRAME_LIMITS} are allowed")
    return item
