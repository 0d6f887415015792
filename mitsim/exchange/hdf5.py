"""A RUN folder, and a CAL folder beside it, in one HDF5 file: folders in, the file out, and back, bit for bit.

The layout stands in docs/exchange.md. Shots are chunks of their own, so that one is read without the others.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsim.core.arrays import PACKED, checked_hdf5, hdf5_errors, whole_hdf5
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.exr import Channels, Metadata, Value
from mitsim.core.files import FRAME_LIMITS, MOST_BYTES, fits_a_frame, parse_json
from mitsim.core.job import Cost, Limits
from mitsim.core.manifests import CALIBRATION, MOSAIC, RUN, CalibrationManifest, RunManifest
from mitsim.core.runs import TRUTH
from mitsim.exchange.packed import (
    FACTORS,
    Calibration,
    Content,
    Loaded,
    Packed,
    Run,
    as_channel,
    shots_of,
    unpack,
    unpack_colours,
    unpack_run,
)
from mitsim.version import __version__

if TYPE_CHECKING:
    import h5py


_LINES = "lines"
"""Group that has a group of each line."""
LAYOUT = 1
"""Number of the layout that is written here, and the newest that is read: attribute `mitsim_exchange` of the file."""


def write_hdf5(path: Path, run: Run, calibration: Calibration | None = None) -> tuple[str, ...]:
    """Write a run to one file, whole or not at all; nothing is left out.

    Parameters
    ----------
    path
        of the file.
    run
        with shots of one shape, each line's where they are told apart.
    calibration
        that goes with it, of the same lines.

    Raises
    ------
    MitsimError
        for shots that differ in shape or channels, or a file that cannot be read or written.
    """
    with whole_hdf5(path) as file:
        file.attrs["mitsim_exchange"] = LAYOUT
        file.attrs["mitsim_version"] = __version__
        for held in (run, calibration):
            if held is not None and held.colours:
                _write_text(file, held.colours.kind, held.text)
        if "" in run.parts:
            _write_run(file, run.parts[""])
        lines = file.create_group(_LINES, track_order=True) if run.colours else None
        for name in run.names:
            place = file if lines is None else lines.create_group(name, track_order=True)
            if name and name in run.parts:
                _write_run(place, run.parts[name])
            if name in run.truths:
                _write_frame(place.create_group("truth"), *run.truths[name])
            if calibration is not None:
                _write_calibration(place, calibration.parts[name])
    return ()


@contextmanager
def open_folders(path: Path | str) -> Iterator[tuple[Run, Calibration | None]]:
    """The folders in the file ``path``, coloured or not, while the context lasts.

    MitsimError for a file that is missing or damaged, is none of these, or leads to other files.
    """
    path = Path(path)
    with checked_hdf5(path, lambda _: 0.0) as file:  # _whole checks what is read at once
        with hdf5_errors(path):
            layout = file.attrs.get("mitsim_exchange")
            if not isinstance(layout, (int, np.integer)) or not 1 <= layout <= LAYOUT:
                raise MitsimError(
                    f"{path}: is no HDF5 file of `mitsim export` (mitsim_exchange is {layout}, 1 to {LAYOUT} are read)"
                )
            run = _run_in(file, path)
            calibration = _calibration_in(file, run, path)
        yield run, calibration


@contextmanager
def load_hdf5(path: Path, channel: str | None) -> Iterator[Loaded]:
    """Open all of the file ``path`` while the context lasts.

    MitsimError as :func:`open_folders`, and for a ``channel``, because its frames have one.
    """
    if channel is not None:
        raise ArgumentError("channel", f"{channel}: {path} has frames of one; leave it out")
    with open_folders(path) as (run, calibration):
        yield Loaded(run, calibration)


# -------- MATLAB files of version 7.3, which are HDF5


_LETTERS = "char"
"""What MATLAB calls texts; they are stored as numbers of 16 bits."""
_CLASSES = {_LETTERS, "single", "double", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}
"""What it calls arrays of numbers and texts."""


def read_matlab(path: Path) -> dict[str, Any]:
    """The arrays of real numbers and the texts of the MATLAB file ``path`` of version 7.3, by name; cells, structures
    and sparse matrices are not looked into.

    MitsimError for a file that is damaged, leads to another one, or takes more memory than is free.
    """
    import h5py

    found = dict[str, Any]()

    def kind(dataset: h5py.Dataset) -> str:
        """Class of an array of the file's own; of what structures and cells hold, ""."""
        held = dataset.name.count("/") > 1 or dataset.dtype.kind not in "uif" or "MATLAB_empty" in dataset.attrs
        return "" if held else bytes(dataset.attrs.get("MATLAB_class", b"double")).decode("ascii")

    with hdf5_errors(path), checked_hdf5(path, lambda each: 2.0 * (kind(each) in _CLASSES)) as file:
        for name in file:
            # Groups are structures, sparse matrices, or what cells refer to.
            if isinstance(file[name], h5py.Dataset) and (known := kind(file[name])) in _CLASSES:
                values = _dataset(file, name, path)[()].T  # MATLAB stores columns first
                text = known == _LETTERS
                found[name] = np.array(["".join(map(chr, values.ravel("F").tolist()))]) if text else values
    return found


def _write_run(place: h5py.Group, run: Packed[RunManifest]) -> None:
    group = _begin(place, "run", run)
    _write_shots(group, run)
    for name, source in {**run.manifest.others, "truth": TRUTH}.items():
        if source in run.names:
            _write_frame(group.create_group(name), *run.read(source))


def _write_calibration(place: h5py.Group, calibration: Packed[CalibrationManifest]) -> None:
    group = _begin(place, "calibration", calibration)
    for name in FACTORS:
        _write_frame(group.create_group(Path(name).stem), *calibration.read(name))


def _begin(place: h5py.Group, name: str, packed: Packed[Any]) -> h5py.Group:
    group = place.create_group(name, track_order=True)
    _write_text(group, "manifest", packed.text)
    return group


def _write_text(group: h5py.Group, name: str, text: str) -> None:
    # Of bytes with their length: manifests outgrow an attribute, and an HDF5 text ends at its first zero.
    group.create_dataset(name, data=np.frombuffer(text.encode(), dtype=np.uint8), **PACKED)


def _write_shots(group: h5py.Group, run: Packed[RunManifest]) -> None:
    captures = run.manifest.patterns.captures
    stacks = group.create_group("shots", track_order=True)
    metadata = []
    for index, (_, channels, known) in enumerate(shots_of(run)):
        for name, values in channels.items():
            if index == 0:
                shape = len(captures), *values.shape
                stacks.create_dataset(name, shape, values.dtype, chunks=(1, *values.shape), **PACKED)
            stacks[name][index] = values
        metadata.append(json.dumps(dict(known)))
    group.create_dataset("metadata", data=metadata)
    group.create_dataset("pattern", data=np.array([(shot.row, shot.column, shot.sign) for shot in captures], np.int32))
    group["pattern"].attrs["columns"] = "column of P_L from 0, column of P_R from 0, sign"
    for name, matrix in zip(("P_L", "P_R"), run.manifest.patterns.matrices, strict=True):
        group.create_dataset(name, data=matrix, **PACKED)


def _write_frame(group: h5py.Group, channels: Channels, metadata: Metadata) -> None:
    for name, values in channels.items():
        group.create_dataset(name, data=values, **PACKED)
    group.create_dataset("metadata", data=[json.dumps(dict(metadata))])


def _run_in(file: h5py.File, path: Path) -> Run:
    """The run in a ``file``, of as many lines as it has."""
    if _LINES not in file:
        return Content({"": _run(file, path)})
    kind = RUN if RUN in file else MOSAIC
    text = _text_in(file, kind, path)
    own = {"": _run(file, path)} if kind == MOSAIC else {}
    colours = unpack_colours(text, kind, path, own[""].names if own else ())
    group = _group(file, _LINES, path)
    lines = {name: _group(group, name, path) for name in colours.names}
    if kind == RUN:
        return Content({name: _run(line, path) for name, line in lines.items()}, colours, text)
    truths = {name: _frame(_group(line, "truth", path), path) for name, line in lines.items() if "truth" in line}
    return Content(own, colours, text, truths)


def _calibration_in(file: h5py.File, run: Run, path: Path) -> Calibration | None:
    """The calibration in a ``file`` of a ``run``, where it holds one."""
    if not run.colours:
        return Content({"": _calibration(file, path)}) if "calibration" in file else None
    if CALIBRATION not in file:
        return None
    text, group, parts = _text_in(file, CALIBRATION, path), _group(file, _LINES, path), {}
    colours = unpack_colours(text, CALIBRATION, path)
    for name in colours.names:
        if name not in run.names or "calibration" not in group[name]:
            raise MitsimError(f"{path}: has no calibration of {name}; export it again")
        parts[name] = _calibration(_group(group, name, path), path)
    return Content(parts, colours, text)


def _run(file: h5py.Group, path: Path) -> Packed[RunManifest]:
    group = _group(file, "run", path)
    text = _text_in(group, "manifest", path)
    manifest = unpack_run(text, path)
    captures = manifest.patterns.captures
    stacks = _group(group, "shots", path)
    channels = {name: _dataset(stacks, name, path) for name in stacks}
    shapes = {values.shape for values in channels.values()}
    if "DN" not in channels or len(shapes) != 1 or next(iter(shapes))[0] != len(captures):
        raise MitsimError(
            f"{path}: /run/shots holds arrays of shapes {sorted(shapes)}; one shape of {len(captures)} x rows x "
            "columns, DN among them, is needed"
        )
    metadata = _dataset(group, "metadata", path)
    index = {shot.file: number for number, shot in enumerate(captures)}
    others = {file: name for name, file in manifest.others.items()} | ({TRUTH: "truth"} if "truth" in group else {})

    def read(name: str) -> tuple[Channels, Metadata]:
        with hdf5_errors(path):
            if name in others:
                return _frame(_group(group, others[name], path), path)
            number = index[name]
            frame = {key: as_channel(values[number], f"/run/shots/{key}", path) for key, values in channels.items()}
            return frame, _metadata(metadata, number, path)

    return Packed(manifest, text, (*(shot.file for shot in captures), *others), read, path)


def _calibration(file: h5py.Group, path: Path) -> Packed[CalibrationManifest]:
    group = _group(file, "calibration", path)
    text = _text_in(group, "manifest", path)

    def read(name: str) -> tuple[Channels, Metadata]:
        with hdf5_errors(path):
            return _frame(_group(group, Path(name).stem, path), path)

    return Packed(unpack(text, CalibrationManifest, path), text, FACTORS, read, path)


def _text_in(group: h5py.Group, name: str, path: Path) -> str:
    text = _dataset(group, name, path)
    if text.dtype != np.uint8 or text.size > MOST_BYTES:
        raise MitsimError(
            f"{path}: {text.name} is {text.dtype} of shape {text.shape}; a text of at most {MOST_BYTES} bytes is needed"
        )
    return str(text[()].tobytes().decode("utf-8"))


def _frame(group: h5py.Group, path: Path) -> tuple[Channels, Metadata]:
    arrays = {name: _dataset(group, name, path) for name in group if name != "metadata"}
    channels = {name: as_channel(_whole(array, path), array.name, path) for name, array in arrays.items()}
    return channels, _metadata(_dataset(group, "metadata", path), 0, path)


def _metadata(texts: h5py.Dataset, number: int, path: Path) -> dict[str, Value]:
    """Of a frame whose channels were read before."""
    # What is beyond the end of a file that was cut short after it was opened is read as zeros.
    if path.stat().st_size < texts.file.id.get_filesize():
        raise ValueError("it was cut short while it was read")
    text = texts[number] if texts.ndim == 1 else None
    if not isinstance(text, bytes):
        raise MitsimError(f"{path}: {texts.name} is {texts.dtype} of shape {texts.shape}; a text a frame is needed")
    known = parse_json(text.decode("utf-8"))
    if not isinstance(known, dict) or not all(isinstance(value, (str, int, float)) for value in known.values()):
        raise MitsimError(f"{path}: metadata of a frame is no object of texts and numbers; export it again")
    return known


def _group(parent: h5py.Group, name: str, path: Path, kind: str = "Group") -> Any:
    """Return the item ``name`` of a group, of that ``kind``."""
    item = parent.get(name)
    if type(item).__name__ != kind:
        what = "is missing" if item is None else f"is no {kind.lower()}"
        raise MitsimError(f"{path}: {parent.name.rstrip('/')}/{name} {what}; export it again")
    return item


def _dataset(parent: h5py.Group, name: str, path: Path) -> h5py.Dataset:
    dataset = _group(parent, name, path, "Dataset")
    if dataset.shape is None:
        raise MitsimError(f"{path}: {dataset.name} is empty; export it again")
    if not fits_a_frame(dataset.shape[1:]):
        raise MitsimError(f"{path}: {dataset.name} claims {dataset.shape}; {FRAME_LIMITS} are allowed")
    return dataset


def _whole(dataset: h5py.Dataset, path: Path) -> Any:
    """All of a ``dataset``; MitsimError where that takes more memory than is free."""
    Cost(memory_bytes=dataset.nbytes).check(f"{path}: {dataset.name}", Limits())
    return dataset[()]
