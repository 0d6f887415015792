"""Frames as OpenEXR files: named 2-D channels (float32 or uint32, lossless) and metadata.

Metadata are header attributes `mitsim.<key>` of JSON text, because EXR's 32-bit numbers cut seeds and exposure times.
OpenEXR's reader is given only the beginning of a file, because it compares all channel names with each other; sizes
that the file cannot hold are refused, because the reader would allocate them.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import OpenEXR

from mitsim.core import files
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError, cut, is_path, reason_of
from mitsim.core.files import check_plain, parse_json, resolve, stderr_silenced, whole_file

Value = str | int | float
Channel = npt.NDArray[np.float32] | npt.NDArray[np.uint32]
Channels = Mapping[str, Channel]
Metadata = Mapping[str, Value]

_PREFIX = "mitsim."


def write_frame(path: Path | str, channels: Channels, metadata: Metadata) -> str:
    """Write a frame, whole or not at all, and return its :func:`checksum`.

    TypeError or ValueError for channels or metadata that cannot be stored exactly; MitsimError if writing fails.
    """
    if not channels:
        raise ValueError("write_frame: no channels given; a frame needs at least one")
    shapes = {np.shape(values) for values in channels.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2 or 0 in next(iter(shapes)):
        raise ValueError(f"write_frame: channel shapes are {sorted(shapes)}; all must be one non-empty 2-D shape")
    for name, values in channels.items():
        if np.asarray(values).dtype not in (np.float32, np.uint32):
            raise TypeError(f"write_frame: channel {name!r} is {np.asarray(values).dtype}; make it float32 or uint32")
    # Noise does not compress: ZIP saves a tenth of the room for four times the time.
    header: dict[str, Any] = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
    for key, value in metadata.items():
        plain: Any = value.item() if isinstance(value, np.generic) else value
        if not isinstance(plain, (str, int, float)):
            raise TypeError(f"write_frame: metadata value {value!r} is {type(value).__name__}; use str, int or float")
        header[_PREFIX + key] = json.dumps(plain)
    pixels = {name: np.ascontiguousarray(values) for name, values in channels.items()}
    image = io.BytesIO()
    with whole_file(path) as part:
        # In memory first: to have OpenEXR write the file, and to read that for its checksum, takes twice as long, and
        # it reports a folder that it cannot write to on stderr, past any caller.
        try:
            OpenEXR.File(header, pixels).write(image)
        except RuntimeError as error:
            raise OSError(reason_of(error)) from error
        part.write_bytes(image.getbuffer())
    return hashlib.sha256(image.getbuffer()).hexdigest()


def read_frame(path: Path | str) -> tuple[dict[str, Channel], dict[str, Value]]:
    """Return channels (float32 or uint32; half floats become float32) and metadata of a frame.

    Metadata of other programs' files are empty. MitsimError for a file that is missing, damaged or not OpenEXR.
    """
    path = Path(path)
    check_plain(path, "frame")
    try:
        header = read_header(path)
        if not files.fits_a_frame((header.height, header.width)):
            raise ValueError(f"claims {header.width}x{header.height} pixels; {files.FRAME_LIMITS} are read")
        # OpenEXR prints a warning to stdout for pixels it cannot read, where --json promises JSON alone, and its C++
        # part one to stderr, past Python; it raises later on. The lock keeps two threads from restoring each other's
        # streams.
        with stderr_silenced(), contextlib.redirect_stdout(io.StringIO()):
            opened = OpenEXR.File(str(path), separate_channels=True)
        with opened as file:
            header = file.header()
            # Both are emptied when the file closes, so they are copied here.
            own = (key for key in header if key.startswith(_PREFIX))
            metadata = {key[len(_PREFIX) :]: parse_json(header[key]) for key in own}
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
        if wrong := [key for key, value in metadata.items() if not isinstance(value, (str, int, float))]:
            raise ValueError(f"metadata {cut(wrong[0])!r} is no text or number")
    except (OSError, RuntimeError, ValueError, TypeError) as error:
        raise MitsimError(
            f"frame {path}: damaged or incomplete OpenEXR file ({reason_of(error)}); write or copy it again"
        ) from error
    wide = {name: c.astype(np.float32) if c.dtype == np.float16 else c for name, c in channels.items()}
    return wide, metadata


def checksum(path: Path | str) -> str:
    """Return a file's SHA-256; MitsimError if it cannot be read."""
    digest = hashlib.sha256()
    check_plain(path)
    try:
        with open(path, "rb") as file:
            for block in iter(lambda: file.read(1 << 20), b""):
                digest.update(block)
    except OSError as error:
        raise MitsimError(f"file {path}: cannot be read ({error.strerror}); check the path") from error
    return digest.hexdigest()


def verify(folder: Path, name: str, checksums: Mapping[str, str], remedy: str) -> None:
    """Compare a file with its recorded SHA-256 in ``checksums``; a file without one passes.

    MitsimError, with the ``remedy``, if they differ, or if a link leads out of the folder.
    """
    if not resolve(folder / name).is_relative_to(resolve(folder)):
        raise MitsimError(f"{folder / name}: leads out of its folder; copy the file there")
    expected = checksums.get(name)
    if expected is not None and checksum(folder / name) != expected:
        raise MitsimError(f"{folder / name}: not the file that was written (its checksum differs); {remedy}")


def verify_files(folder: Path, stated: object, remedy: str) -> None:
    """Check that all files in ``folder`` with recorded checksums exist and are unchanged."""
    for name, value in stated.items() if isinstance(stated, dict) else ():
        if not is_path(name):
            raise MitsimError(f"{folder}: notes a checksum of {cut(name)!r}, which names no file; {remedy}")
        verify(folder, name, {name: str(value)}, remedy)


def finite_channel(channels: Channels, name: str, path: Path) -> FloatArray:
    """Return channel ``name`` in double precision; MitsimError if it is missing or not finite."""
    if name not in channels:
        raise MitsimError(f"{path}: channels are {', '.join(channels)}; {name} is needed")
    values = channels[name].astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        total = values.sum()
    if not np.isfinite(total) and (bad := int(np.count_nonzero(~np.isfinite(values)))):
        raise MitsimError(f"{path}: {bad} values are not finite; capture or calibrate again")
    return values


# -------- An OpenEXR file's path in

MAGIC = b"\x76\x2f\x31\x01"
_ATTRIBUTE = re.compile(rb"[^\0]{1,255}\0[^\0]{1,255}\0(.{4})", re.DOTALL)
"""Name, type and length of an attribute, after "OpenEXR File Layout" (openexr.com)."""
_CHANNEL = re.compile(rb"[^\0]{1,255}\0([\0-\2])\0{3}.{12}", re.DOTALL)
"""Name and type of a channel in the attribute `channels`."""
_HEADER_BYTES = 1 << 18
"""Far more than a frame's header; a list of channels that fits takes 0.15 s."""
_LARGEST_RATIO = 1100
"""Deflate shrinks at most 1032 times; files that claim less than ``_SMALL`` bytes are not checked."""
_SMALL = 1 << 24
"""Lets a uniform image of 2048 x 2048 pixels pass under every compression."""
_MOST_BYTES = 4 << 30
"""Four float32 channels of the largest sensor."""
_MOST_CHANNELS = 64


@dataclass(frozen=True)
class ExrHeader:
    width: int
    height: int
    channels: int
    types: frozenset[str]


def read_header(path: Path) -> ExrHeader:
    """Return the header of a file, checked against the file's size.

    ValueError if it is no single-part scan-line image, or claims more than the file can hold, or if the data window is
    not the display window (Mitsuba crashes on negative ones); OSError if it cannot be read.
    """
    size = os.stat(path).st_size
    with open(path, "rb") as file:
        start = file.read(_HEADER_BYTES)
    if not start.startswith(MAGIC) or len(start) < 8:
        raise ValueError(f"not an OpenEXR file (first bytes {start[:4]!r})")
    place, listed = 8, b""
    while attribute := _ATTRIBUTE.match(start, place):
        begin, place = attribute.end(), attribute.end() + int.from_bytes(attribute[1], "little")
        listed = start[begin:place] if attribute[0].startswith(b"channels\0") else listed
    if start[place : place + 1] != b"\0":
        raise ValueError("its header is damaged, cut short, or over 256 KiB long")
    try:
        with OpenEXR.File(io.BytesIO(start), header_only=True) as image:
            parts = [dict(part.header) for part in image.parts]
    except (RuntimeError, TypeError, UnicodeDecodeError):
        raise ValueError("its header is damaged") from None
    (header,) = parts if len(parts) == 1 else ({},)
    if header.get("type", OpenEXR.scanlineimage) != OpenEXR.scanlineimage or "tiles" in header or not header:
        raise ValueError("is tiled, deep or of several parts; save it as one part of scan lines")
    window, shown = ([int(edge) for edge in np.ravel(header[name])] for name in ("dataWindow", "displayWindow"))
    left, top, right, bottom = window
    width, height, channels = right - left + 1, bottom - top + 1, header["channels"]
    if not (0 < width <= files.MOST_SIDE and 0 < height <= files.MOST_SIDE):
        raise ValueError(f"claims {width}x{height} pixels; 1 to {files.MOST_SIDE} a side are allowed")
    if (left, top) != (0, 0) or window != shown:
        raise ValueError(f"has the data window {window} and the display window {shown}; save equal ones from 0, 0")
    if not 0 < len(channels) <= _MOST_CHANNELS:
        raise ValueError(f"has {len(channels)} channels; 1 to {_MOST_CHANNELS} are allowed")
    if any((channel.xSampling, channel.ySampling) != (1, 1) for channel in channels):
        raise ValueError("some of its channels leave out pixels; save them in full")
    decoded = width * height * len(channels) * 4
    smallest = decoded // 2  # should all channels be half floats
    if header["compression"] != OpenEXR.NO_COMPRESSION:
        smallest = max(smallest - _SMALL, 0) // _LARGEST_RATIO
    if decoded > _MOST_BYTES or smallest >= size:
        raise ValueError(f"claims {width}x{height} pixels of {len(channels)} channels, more than its {size} bytes hold")
    types = frozenset(("uint", "half", "float")[code[0]] for code in _CHANNEL.findall(listed))
    return ExrHeader(width, height, len(channels), types)
