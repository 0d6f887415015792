"""The header of an OpenEXR file, read here before OpenEXR sees it: it allocates what a header claims.

Layout after the OpenEXR file layout document (openexr.com, "OpenEXR File Layout"): magic number, version and flags,
attributes (name, type, size, value), a table of chunk offsets, chunks of scan lines.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from pathlib import Path

MAGIC = b"\x76\x2f\x31\x01"
_HEADER_BYTES = 1 << 20
_FLAGS = {0x200: "tiled", 0x800: "deep", 0x1000: "of several parts"}
_LINES = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}
"""Scan lines a chunk, by compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB."""
_BYTES = {0: 4, 1: 2, 2: 4}
"""Bytes a sample, by pixel type: uint32, half, float32."""
_LARGEST_RATIO = 1100
"""Deflate cannot shrink more than 1032 times; a small file of any compression may claim ``_SMALL`` bytes."""
_SMALL = 1 << 24
_LARGEST_SIDE = 16384
_MOST_BYTES = 4 << 30
_MOST_CHANNELS = 64


@dataclass(frozen=True)
class ExrHeader:
    """Size in pixels, number of channels and decoded size in bytes of a plain scan-line image."""

    width: int
    height: int
    channels: int
    decoded: int


def read_header(path: Path) -> ExrHeader:
    """The header of a file, checked against the file's own size.

    Raises
    ------
    ValueError
        when the file is no OpenEXR image of one part and of scan lines, or claims more than it can hold.
    OSError
        when it cannot be read.
    """
    size = os.stat(path).st_size
    with open(path, "rb") as file:
        start = file.read(min(_HEADER_BYTES, size))
    attributes, end = _attributes(start)
    left, top, right, bottom = struct.unpack("<4i", _value(attributes, "dataWindow", "box2i", 16))
    width, height = right - left + 1, bottom - top + 1
    if not (0 < width <= _LARGEST_SIDE and 0 < height <= _LARGEST_SIDE):
        raise ValueError(f"claims {width}x{height} pixels; 1 to {_LARGEST_SIDE} a side are allowed")
    sizes = _channels(attributes)
    compression = _value(attributes, "compression", "compression", 1)[0]
    if compression not in _LINES:
        raise ValueError(f"compression {compression} is not known; save it without")
    decoded = width * height * sum(sizes)
    if decoded > _MOST_BYTES:
        raise ValueError(f"claims {width}x{height} pixels of {len(sizes)} channels; at most 4 GiB are read")
    chunks = -(-height // _LINES[compression])
    first = end + 8 * chunks
    room = size - first - 8 * chunks
    claim = decoded if compression == 0 else min(decoded, max(decoded - _SMALL, 0) // _LARGEST_RATIO)
    if claim > room or room <= 0:
        raise ValueError(f"claims {width}x{height} pixels of {len(sizes)} channels, more than its {size} bytes hold")
    _check_table(start if first <= len(start) else _beginning(path, first), end, chunks, size)
    return ExrHeader(width, height, len(sizes), decoded)


def _attributes(start: bytes) -> tuple[dict[str, tuple[str, bytes]], int]:
    """Type and value of each attribute by name, and where the header ends."""
    if start[:4] != MAGIC or len(start) < 8:
        raise ValueError(f"not an OpenEXR file (first bytes {start[:4]!r})")
    flags = int.from_bytes(start[4:8], "little")
    if flags & 0xFF != 2:
        raise ValueError(f"OpenEXR version {flags & 0xFF} is not known")
    for bit, word in _FLAGS.items():
        if flags & bit:
            raise ValueError(f"the image is {word}; save it as one part of scan lines")
    found: dict[str, tuple[str, bytes]] = {}
    place = 8
    while True:
        name, place = _text(start, place)
        if not name:
            return found, place
        kind, place = _text(start, place)
        if place + 4 > len(start):
            raise ValueError("its header is cut short")
        (length,) = struct.unpack_from("<i", start, place)
        place += 4
        if length < 0 or place + length > len(start):
            raise ValueError(f"attribute {name!r} claims {length} bytes, more than the header holds")
        if name in found:
            raise ValueError(f"attribute {name!r} is there twice")
        found[name] = kind, start[place : place + length]
        place += length


def _text(data: bytes, place: int) -> tuple[str, int]:
    end = data.find(b"\0", place, place + 256)
    if end < 0:
        raise ValueError("its header is cut short")
    return data[place:end].decode("latin-1"), end + 1


def _value(attributes: dict[str, tuple[str, bytes]], name: str, kind: str, length: int) -> bytes:
    found, value = attributes.get(name, ("nothing", b""))
    if found != kind or len(value) != length:
        raise ValueError(f"its {name} is {found!r} of {len(value)} bytes, not {kind}")
    return value


def _channels(attributes: dict[str, tuple[str, bytes]]) -> list[int]:
    """Bytes a pixel of each channel."""
    kind, value = attributes.get("channels", ("nothing", b""))
    if kind != "chlist":
        raise ValueError("it has no list of channels")
    sizes: list[int] = []
    place = 0
    while True:
        name, place = _text(value, place)
        if not name:
            break
        if place + 16 > len(value) or len(sizes) == _MOST_CHANNELS:
            raise ValueError(f"its list of channels is cut short, or longer than {_MOST_CHANNELS}")
        pixel, _, across, down = struct.unpack_from("<iiii", value, place)
        place += 16
        if pixel not in _BYTES or (across, down) != (1, 1):
            raise ValueError(f"channel {name!r} has type {pixel} and sampling {across}x{down}; use plain full channels")
        sizes.append(_BYTES[pixel])
    if not sizes:
        raise ValueError("it has no channels")
    return sizes


def _beginning(path: Path, length: int) -> bytes:
    with open(path, "rb") as file:
        return file.read(length)


def _check_table(start: bytes, end: int, chunks: int, size: int) -> None:
    """Every chunk begins after the table and before the end of the file."""
    for offset in struct.unpack_from(f"<{chunks}Q", start, end):
        if not end + 8 * chunks <= offset <= size - 8:
            raise ValueError(f"a chunk is said to begin at byte {offset} of {size}; the table of offsets is damaged")
