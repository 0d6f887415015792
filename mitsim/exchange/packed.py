"""RUN and CAL folders as :class:`Content`, from folders, from one HDF5 file for both, and from a real camera's frames.

A mono folder has one part, a coloured one a part for each line. A run behind colour filters is one RUN folder with a
truth for each line. docs/exchange.md describes the layout of HDF5 files, which are exact to the bit.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

import numpy as np

from mitsim.core import colour_files, manifests
from mitsim.core.arrays import PACKED, checked_hdf5, hdf5_errors, whole_hdf5
from mitsim.core.colour_files import ColourManifest
from mitsim.core.configuration import validate
from mitsim.core.environment import versions
from mitsim.core.errors import ArgumentError, MitsimError, cut
from mitsim.core.exr import Channel, Channels, Metadata, Value, checksum, read_frame, verify, write_frame
from mitsim.core.files import (
    FRAME_LIMITS,
    LOCK,
    MOST_BYTES,
    fits_a_frame,
    parse_json,
    read_json,
    read_text,
    whole_folder,
    write_text,
)
from mitsim.core.headline import each_once, frames_headline
from mitsim.core.images import LEAST_RESPONSE, CommonFactor, Numbers, Preparer, image_header, read_images, size_of
from mitsim.core.job import Cost, Limits
from mitsim.core.picture_files import CORRECTIONS, Preparation, image_files
from mitsim.core.runs import AMBIENT, CLOSING, TRUTH, frame_name, load_run
from mitsim.devices.patterns import parse_patterns, shot_orders
from mitsim.devices.sensor import PITCH_TOLERANCE
from mitsim.exchange.capture_list import Electronics, RealCapture
from mitsim.version import __version__

if TYPE_CHECKING:
    import h5py

Manifest = TypeVar("Manifest", manifests.RunManifest, manifests.CalibrationManifest)
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


Run = Content[manifests.RunManifest]
Calibration = Content[manifests.CalibrationManifest]
Loaded = tuple[Run | None, Calibration | None]
"""Run and calibration of an exchanged file, if present."""


def pack_run(folder: Path) -> Packed[manifests.RunManifest]:
    shots = load_run(folder)
    return Packed(shots.manifest, read_text(folder / manifests.MANIFEST, MOST_BYTES), shots.files, shots.read, folder)


def pack_calibration(folder: Path) -> Packed[manifests.CalibrationManifest]:
    manifest = manifests.read_manifest(folder, manifests.CalibrationManifest)

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


def shots_of(run: Packed[manifests.RunManifest]) -> Iterator[tuple[manifests.ShotFile, Channels, Metadata]]:
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
    fits = array.ndim == 2 and array.size and fits_a_frame(array.shape)
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

    def write_shots(place: h5py.Group, shots: Packed[manifests.RunManifest]) -> None:
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


def _run_in(place: h5py.Group, path: Path) -> Packed[manifests.RunManifest]:
    group = hdf5_item(place, "run", path, "Group")
    text, data = _json_in(group, "manifest", path)
    manifest = manifests.checked_manifest(data, manifests.RunManifest, path)
    for name in (*(shot.file for shot in manifest.patterns.captures), *manifest.others.values()):
        if name in (".", "..", manifests.MANIFEST, LOCK, TRUTH) or not name.isprintable():
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


def _calibration_in(place: h5py.Group, path: Path) -> Packed[manifests.CalibrationManifest]:
    group = hdf5_item(place, "calibration", path, "Group")
    text, data = _json_in(group, "manifest", path)

    def read(name: str) -> tuple[Channels, Metadata]:
        with hdf5_errors(path):
            return _frame_in(group, Path(name).stem, path)

    return Packed(manifests.checked_manifest(data, manifests.CalibrationManifest, path), text, FACTORS, read, path)


def _colours_in(place: h5py.Group, kind: str, path: Path, beside: Sequence[str] = ()) -> tuple[str, ColourManifest]:
    """Return text and content of a colour.json of that ``kind``; ``beside`` are names beside the lines' folders."""
    text, data = _json_in(place, kind, path)
    colours = colour_files.checked_colours(data, path, kind)
    taken = {colour_files.COLOUR, LOCK, *((manifests.MANIFEST, *beside) if kind == colour_files.MOSAIC else ())}
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
    if kind == "Dataset" and not fits_a_frame(item.shape[1:]):
        raise MitsimError(f"{path}: {item.name} claims {item.shape}; {FRAME_LIMITS} are allowed")
    return item


# -------- Frames of a real camera; all planes of a mosaic make a coloured run

_SECONDS_PER_PIXEL = 1e-7
"""Every frame is read twice and written once: 30 s for 256 megapixels on a slow disk."""
_PLANE = {"g": "gb"}
"""Plane of a mosaic that the green of a picture in colour counts as."""
LEFT_OUT = ("truth", "scene", "expected electrons", "plan and predicted error")
"""Parts of a run that are unknown for a real capture."""


def import_capture(source: Path, output: Path, known: RealCapture, command: str | None = None) -> dict[str, Any]:
    """Write the RUN folder of a real capture, whole or not at all, and return the output of the command line.

    MitsimError for invalid values, frames that are missing, too many, unlike each other or beyond the camera's range,
    or a place that holds something.
    """
    known.check(source)
    files = image_files(source, known.wanted)
    pages = {path: image_header(path, known.wanted) for path in files}
    known = known.of_file(files[0], pages[files[0]][1])
    camera, prepare = known.electronics()
    colours, listed = known.colours, known.listed
    planes = [_Plane(known, camera, name) for name in (colours.names if colours else ("",))]
    shown = planes[0].patterns
    orders, count, order, closing = shot_orders(shown), len(shown.captures), listed.order, listed.closing_frame
    if order is not None and order not in orders:
        raise ArgumentError("order", f"{cut(repr(order))}: give {', '.join(orders)}")
    if (held := sum(number for number, _ in pages.values())) != count + bool(closing):
        last = " and a closing frame" if closing else ""
        hint = "; if the last one is a closing frame, give --closing-frame" if held == count + 1 else ""
        raise MitsimError(
            f"{source}: holds {held} frames, but patterns {known.patterns!r} need {count}{last}, in the order (row, "
            "column), and + before - for signed patterns; give exactly these frames (a page of a file is a "
            f"frame){hint}"
        )
    pixels = sum(number * math.prod(size) for number, size in pages.values())
    cost = Cost(seconds=pixels * _SECONDS_PER_PIXEL, disk_bytes=pixels * np.dtype(np.uint32).itemsize)
    cost.check(f"import of {count} frames", Limits(), output)
    found = survey(files, known, camera, prepare)
    places, notes, warnings, runs = found.places, found.notes, found.warnings, {}
    if order is not None:
        places[:count] = [places[frame] for frame in orders[order]]
    for plane in planes:
        how = found.of_line(plane.name)
        runs[plane.name], shape, unlit = plane.pack(how, source, places, found.first, command)
        if unlit:
            warnings.append(
                f"flat: {unlit} pixels{f' of {plane.name}' if plane.name else ''} have less than {LEAST_RESPONSE:g} of "
                "the mean response, and are not corrected; leave them out by a crop, or take a flat without a mask"
            )
    if prepare.turn_deg:
        notes.append(
            f"turned by {prepare.turn_deg:g} degrees: noise of neighbouring pixels is not independent any more, so "
            "that the stated uncertainty of an image is approximate"
        )
    content = Content(runs, colours, "" if colours is None else json.dumps(colours.model_dump(mode="json")))
    with whole_folder(output) as place:
        content.fill(place)
    imported = {"frames": count, "shape": shape, "total_error_bound": None}
    warnings = [*each_once({"": warnings})]
    return {
        "headline": frames_headline([imported] * len(runs), warnings),
        "frames": count * len(runs),
        "shape": [*shape],
        "output": str(output),
        "calibration_output": None,
        "holds": ["run"],
        "left_out": [*LEFT_OUT],
        "divided_by": found.prepare.divide_by,
        "planes": [name for name in runs if name],
        "notes": notes,
        "warnings": warnings,
    }


@dataclass(frozen=True, eq=False)
class Surveyed:
    """First of several frames, the ``places`` of all (file and page), and their preparation with the common factor."""

    first: Numbers
    places: list[tuple[Path, int]]
    prepare: Preparation
    notes: list[str]
    warnings: list[str]

    def of_line(self, name: str) -> Preparation:
        """Return the preparation of a line; "" is the whole picture."""
        return self.prepare.model_copy(update={"channel": _PLANE.get(name, name)}) if name else self.prepare


def survey(files: Sequence[Path], known: RealCapture, camera: Electronics, prepare: Preparation) -> Surveyed:
    """Read all frames once; MitsimError if their sizes differ, or for another factor than is stated."""
    first, common = np.empty(0), CommonFactor()
    places, notes, warnings = list[tuple[Path, int]](), list[str](), list[str]()
    for path in files:
        for number, frame in enumerate(read_images(path, known.wanted)):
            first = first if places else frame
            if frame.shape != first.shape:
                raise MitsimError(
                    f"{path}: is {size_of(frame)}, but {files[0].name} {size_of(first)}; give frames of one size"
                )
            places.append((path, number))
            common.add(frame)
    factor = prepare.divide_by
    if factor is None:
        factor = common.choose(camera.largest)
        if factor > 1:
            notes.append(f"numbers are divided by {factor}, because all are multiples of it")
        elif common.factor > 1:
            warnings.append(
                f"all numbers are multiples of {common.factor}, and are used unchanged: if the camera's numbers were "
                f"shifted or scaled, give --divide {common.factor}, else --divide 1"
            )
    elif common.factor % factor:
        raise ArgumentError("divide_by", f"{factor}: the numbers' common factor is {common.factor}; give that, or 1")
    if known.rgb:
        notes.append("numbers of red, green and blue are read as stored: a gamma curve in them is not undone")
    return Surveyed(first, places, prepare.model_copy(update={"divide_by": factor}), notes, warnings)


def check_range(path: Path, frame: Numbers, camera: Electronics, factor: int, mean: bool = False) -> None:
    """Raise MitsimError if numbers, divided by a factor, are none of the camera; ``mean`` marks means of frames."""
    largest, low, high, kind = camera.largest, float(frame.min()), float(frame.max()), frame.dtype
    if largest is None:
        return
    counts = f"camera {camera.name} counts"
    if not mean and kind.kind == "f" and not np.array_equal(frame, np.rint(frame)):
        raise MitsimError(f"{path}: holds fractions, but {counts} whole numbers; give single shots")
    if high / factor > largest or (low < 0 and not mean):
        raise MitsimError(
            f"{path}: has the number {(low if low < 0 else high) / factor:g}, but {counts} 0 to {largest}: they were "
            "scaled, contain more than light (for example a text), or come from another camera; save them unchanged, "
            "or give the right camera file"
        )
    if not mean and kind.kind != "f" and np.iinfo(kind).max < largest:
        raise MitsimError(
            f"{path}: holds numbers of {8 * kind.itemsize} bits, but {counts} to {largest}: they were reduced; save "
            "them unchanged, or give a camera file of these numbers"
        )


class _Plane:
    """One plane of a mosaic, or by the name "" the whole picture; a calibration states identity, shape and pixels."""

    def __init__(self, known: RealCapture, camera: Electronics, name: str) -> None:
        self.known, self.camera, self.name = known, camera, name
        self.identity: dict[str, Any] = {}
        self.shape: tuple[int, ...] | None = None
        n = known.listed.n
        scene: tuple[Any, ...] = (n, n)
        if known.calibration is not None:
            calibration = pack_calibration(known.calibration / name)
            self.identity = dict(calibration.manifest.camera)
            self.shape, scene = zip(*(calibration.read(file)[0]["factor"].shape for file in FACTORS), strict=True)
            if n is not None and (n, n) != scene:
                raise ArgumentError(
                    "projector_pixels", f"{n}: the calibration has {scene[0]} x {scene[1]}; leave it out"
                )
        # Otherwise frames of a camera with another pitch would count as frames of the calibration's camera.
        calibrated, own = (data.get("sensor", {}) for data in (self.identity, camera.stated))
        for axis in ("row", "pixel") if {"pixel_pitch_um", "binning"} <= calibrated.keys() & own.keys() else ():
            theirs, ours = (
                (each.get(f"{axis}_pitch_um") or each["pixel_pitch_um"]) * each["binning"] for each in (calibrated, own)
            )
            if abs(ours - theirs) > PITCH_TOLERANCE * theirs:
                raise ArgumentError(
                    "camera",
                    f"{camera.name}: has pixels of {ours:g} um, but the calibration's camera of {theirs:g} um; give "
                    "the camera of the calibration, or a calibration of this camera",
                )
        if known.patterns.endswith(".json"):
            data = read_json(known.patterns)
            if not isinstance(data, dict) or "shots" not in data:
                raise MitsimError(f"{known.patterns}: has no shots; give patterns.json of `mitsim export --format png`")
            shots = data["shots"] if isinstance(data["shots"], list) else []
            captures = [
                {**{key: shot.get(key) for key in ("row", "column", "sign")}, "file": frame_name(index)}
                for index, shot in enumerate(shots)
                if isinstance(shot, dict)
            ]
            named = {key: data[key] for key in ("family", "n", "P_L", "P_R") if key in data}
            self.patterns = validate(manifests.Patterns, {**named, "captures": captures}, known.patterns)
        else:
            family = parse_patterns(known.patterns, (scene[0], scene[1]), known.listed.seed)
            self.patterns = manifests.Patterns.of(family, [frame_name(index) for index in range(len(family.shots))])
        sides = tuple(len(matrix) for matrix in self.patterns.matrices)
        if sides != scene:
            raise MitsimError(
                f"{known.patterns}: is for {size_of(sides)} projector pixels, but {size_of(scene)} are calibrated or "
                "stated"
            )

    def pack(
        self, how: Preparation, source: Path, places: list[tuple[Path, int]], first: Numbers, command: str | None
    ) -> tuple[Packed[manifests.RunManifest], tuple[int, ...], int]:
        """Return the run, the shape of its frames, and the number of pixels with too little response."""
        known, camera, listed, captures = self.known, self.camera, self.known.listed, self.patterns.captures
        preparer = Preparer.of(how, camera.digital, known.wanted)
        kind = np.uint32 if camera.largest is not None and preparer.counts else np.float32
        shape = self._part(places[0][0], preparer.frame(places[0][0], first), how).shape
        ambient = listed.ambient and self._ambient(Path(listed.ambient), preparer, shape)
        seconds = listed.closing_exposure_s or camera.digital.exposure_s
        last = listed.closing_frame
        closing = last and manifests.ClosingFile(kind=last, file=CLOSING, exposure_s=seconds)
        # The dark level depends on the exposure.
        of_last = replace(preparer, digital=preparer.digital.model_copy(update={"exposure_s": seconds}))
        names = (
            *(shot.file for shot in captures), *((AMBIENT,) if ambient else ()), *((CLOSING,) if closing else ()),
        )  # fmt: skip
        own = camera.identity | ({} if listed.prepare.channel == how.channel else {"channel": self.name})
        more = () if listed.ambient is None else image_files(Path(listed.ambient), known.wanted)
        corrected = {
            name: {path.name: checksum(path) for path in image_files(Path(place), known.wanted)}
            for name in CORRECTIONS
            if (place := getattr(how, name)) is not None
        }
        configuration = {
            "imported": {path.name: checksum(path) for path in dict.fromkeys(path for path, _ in places)},
            "ambient": {path.name: checksum(path) for path in more},
            "patterns": known.patterns,
            **camera.stated,
            "exposure_s": camera.digital.exposure_s,
            "black_level_dn": known.black_level_dn,
            "channel": self.name or how.channel,
            "prepare": {**how.model_dump(mode="json", exclude_defaults=True), **corrected},
            "seed": listed.seed,
            **listed.model_dump(include={"closing_frame", "closing_exposure_s", "order"}, exclude_none=True),
        }
        head = manifests.RunHead.of(configuration)
        manifest = manifests.RunManifest(
            configuration=head.configuration,
            configuration_sha256=head.configuration_sha256,
            camera=self.identity or own,
            digital=preparer.digital,
            patterns=self.patterns,
            sensor_noise=None,
            ambient_frame=manifests.AmbientFile(file=AMBIENT, shots=ambient[1]) if ambient else None,
            closing_frame=closing,
            order=listed.order,
            checksums=dict.fromkeys(names, ""),  # worked out as the files are written
            versions=versions(),
            command=command,
        )
        index = {shot.file: number for number, shot in enumerate(captures)}
        index[CLOSING] = len(captures)
        pages: Iterator[Numbers] = iter(())
        following = places[0][0], -1

        def read(name: str) -> tuple[Channels, Metadata]:
            """Read and prepare a frame again; pages of one file are read in order."""
            nonlocal pages, following
            if ambient and name == AMBIENT:
                return {"DN": ambient[0]}, {"shots": ambient[1], "exposure_s": camera.digital.exposure_s}
            path, page = places[index[name]]
            if (path, page) != following:
                pages = islice(read_images(path, known.wanted), page, None)
            following = path, page + 1
            if (values := next(pages, None)) is None:
                raise MitsimError(f"{path}: has fewer frames than before; leave it alone while it is read")
            check_range(path, values, camera, how.divide_by or 1)
            made = (of_last if name == CLOSING else preparer).frame(path, values)
            channels = {"DN": cast(Channel, np.array(self._part(path, made, how), kind))}  # parts do not keep pictures
            if name == CLOSING:
                return channels, {"source": path.name, "exposure_s": seconds}
            shot = captures[index[name]]
            about: Metadata = {"row": shot.row, "column": shot.column, "sign": shot.sign, "source": path.name}
            return channels, {**about, "exposure_s": camera.digital.exposure_s}

        return Packed(manifest, "", names, read, source), shape, preparer.unlit

    def _part(self, path: Path, frame: Numbers, how: Preparation) -> Numbers:
        """Return the calibrated part of a ``frame``: all of it, or the middle of a plane without a stated crop.

        MitsimError for another size.
        """
        if self.shape is not None and how.channel is not None and how.crop is None:
            row, column = ((side - wanted) // 2 for side, wanted in zip(frame.shape, self.shape, strict=True))
            if min(row, column) >= 0:  # as FlatCam's loader cuts it
                frame = frame[row : row + self.shape[0], column : column + self.shape[1]]
        if self.shape is not None and frame.shape != self.shape:
            raise MitsimError(f"{path}: is {size_of(frame)}, but the calibration's frames are {size_of(self.shape)}")
        return frame

    def _ambient(self, source: Path, preparer: Preparer, shape: tuple[int, ...]) -> tuple[Channel, int]:
        total, count, stated = np.zeros(shape), 0, self.known.listed.ambient_shots
        for path in image_files(source, self.known.wanted):
            for frame in read_images(path, self.known.wanted):
                check_range(path, frame, self.camera, preparer.how.divide_by or 1, mean=True)
                part = self._part(path, preparer.frame(path, frame, mean=True), preparer.how)
                if part.shape != shape:
                    raise MitsimError(f"{path}: is {size_of(part)}, but others are {size_of(shape)}")
                total, count = total + part, count + 1
        if stated is not None and count != 1:
            raise ArgumentError("ambient_shots", f"{stated}: {source} holds {count} frames; leave it out")
        return (total / count).astype(np.float32), stated or count
