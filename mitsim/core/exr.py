"""An OpenEXR file's path in; size, channels and decoded bytes out, as far as the file can hold what its header claims.

OpenEXR's own reader takes the header: it allocates nothing by what that claims, and damaged ones raise. Three things
are left to check here. It compares the names of channels with each other, which takes 18 s for a list of 100 000, so it
is given the beginning of the file alone. It passes over an attribute that claims 2 GB, for which the older reader in
Mitsuba allocates them. And reading the pixels allocates what a header claims, 4 GiB for a file of 300 bytes.
"""

from __future__ import annotations

import io
import os
import re
from dataclasses import dataclass
from pathlib import Path

import OpenEXR

from mitsim.core.plainfile import MOST_SIDE

MAGIC = b"\x76\x2f\x31\x01"
"""First bytes of every OpenEXR file."""
_ATTRIBUTE = re.compile(rb"[^\0]{1,255}\0[^\0]{1,255}\0(.{4})", re.DOTALL)
"""Name, type and length of an attribute, after the document "OpenEXR File Layout" (openexr.com)."""
_HEADER_BYTES = 1 << 18
"""Far more than the header of a frame; a list of channels that fits takes 0.15 s."""
_LARGEST_RATIO = 1100
"""Deflate cannot shrink more than 1032 times; a small file of any compression may claim ``_SMALL`` bytes."""
_SMALL = 1 << 24
"""16 MiB, so that an even image of 2048 x 2048 pixels is read whatever compresses it."""
_MOST_BYTES = 4 << 30
"""Four float32 channels of the largest sensor."""
_MOST_CHANNELS = 64
"""More than any renderer writes into one part."""


@dataclass(frozen=True)
class ExrHeader:
    """Size in pixels, number of channels and decoded size in bytes (float32 or uint32) of a plain scan-line image."""

    width: int
    height: int
    channels: int
    decoded: int


def read_header(path: Path) -> ExrHeader:
    """The header of the file at ``path``, checked against the file's own size.

    Raises
    ------
    ValueError
        when the file is no OpenEXR image of one part and of scan lines, or claims more than it can hold.
    OSError
        when it cannot be read.
    """
    size = os.stat(path).st_size
    with open(path, "rb") as file:
        start = file.read(_HEADER_BYTES)
    if not start.startswith(MAGIC) or len(start) < 8:
        raise ValueError(f"not an OpenEXR file (first bytes {start[:4]!r})")
    place = 8
    while attribute := _ATTRIBUTE.match(start, place):
        place = attribute.end() + int.from_bytes(attribute[1], "little")
    if start[place : place + 1] != b"\0":
        raise ValueError("its header is damaged, cut short, or over 256 KiB long")
    try:
        with OpenEXR.File(io.BytesIO(start), header_only=True) as image:
            parts = [dict(part.header) for part in image.parts]
    except (RuntimeError, TypeError, UnicodeDecodeError):
        raise ValueError("its header is damaged") from None
    (header,) = parts if len(parts) == 1 else ({},)
    if header.get("type", OpenEXR.scanlineimage) != OpenEXR.scanlineimage or "tiles" in header or not header:
        raise ValueError("the image is tiled, deep or of several parts; save it as one part of scan lines")
    (left, top), (right, bottom) = ([int(edge) for edge in corner] for corner in header["dataWindow"])
    width, height, channels = right - left + 1, bottom - top + 1, header["channels"]
    if not (0 < width <= MOST_SIDE and 0 < height <= MOST_SIDE):
        raise ValueError(f"claims {width}x{height} pixels; 1 to {MOST_SIDE} a side are allowed")
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
    return ExrHeader(width, height, len(channels), decoded)
