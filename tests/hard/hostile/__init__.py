"""Scenes, meshes and pictures that mean harm or are mistakes, made by code: each an edit of one good scene."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

GOOD = (Path(__file__).parent / "good.xml").read_text(encoding="utf-8")
MESH = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 500\n9 0 500\n0 9 500\n3 0 1 2\n"
)
OBJ = "v 0 0 500\nv 9 0 500\nv 0 9 500\nf 1 2 3\n"
Prepare = Callable[[Path], object]


def nothing(folder: Path) -> None:
    """Most cases need no further files."""


@dataclass(frozen=True)
class Case:
    """A scene file, what is put beside it, and words of the refusal; ``line`` tells whether the place has a line."""

    name: str
    content: str | bytes
    says: str | tuple[str, ...]
    prepare: Prepare = nothing
    line: bool = True
    defines: tuple[tuple[str, str], ...] = ()

    def write(self, folder: Path) -> Path:
        """The scene in a folder, its good files beside it."""
        beside(folder)
        self.prepare(folder)
        path = folder / "scene.xml"
        content = self.content.encode() if isinstance(self.content, str) else self.content
        path.write_bytes(content)
        return path


def beside(folder: Path) -> None:
    """The files of the good scene, and a good mesh of each kind."""
    (folder / "projector.png").write_bytes(png(4, 4))
    (folder / "mesh.ply").write_text(MESH)
    (folder / "mesh.obj").write_text(OBJ)


def png(width: int, height: int, claimed: tuple[int, int] | None = None) -> bytes:
    """A white 8-bit picture, or one whose header claims another size."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = struct.pack(">IIBBBBB", *(claimed or (width, height)), 8, 0, 0, 0, 0)
    rows = zlib.compress((b"\0" + b"\xff" * width) * height)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def jpeg(width: int, height: int, hidden: bool = False) -> bytes:
    """The header of a JPEG picture; ``hidden``: a reader that gives a length to the first marker lands in a comment."""

    def frame(width: int, height: int) -> bytes:
        return b"\xff\xc0" + struct.pack(">HBHHB", 17, 8, height, width, 3) + b"\1\x11\0\2\x11\0\3\x11\0"

    start = b"\xff\xd8" + b"\xff\xd0" * hidden + frame(width, height)
    lure = bytes(4 + 0xFFC0 - len(start) - 4) + frame(4, 4)
    comment = b"\xff\xfe" + struct.pack(">H", len(lure) + 2) + lure
    return start + comment * hidden + b"\xff\xda" + struct.pack(">HB", 6, 0) + bytes(3)


def put(text: str) -> str:
    """The good scene with something more at its end."""
    assert GOOD.count("<!--here-->") == 1
    return GOOD.replace("<!--here-->", text)


def swap(old: str, new: str) -> str:
    """The good scene with its first ``old`` replaced."""
    assert old in GOOD, old
    return GOOD.replace(old, new, 1)


def ball(inside: str) -> str:
    """A sphere with something in it."""
    return put(f'<shape type="sphere">{inside}</shape>')


def skin(kind: str, inside: str = "") -> str:
    """A sphere of one material."""
    return ball(f'<bsdf type="{kind}">{inside}</bsdf>')


def picture(name: str) -> str:
    """A sphere with a bitmap."""
    return skin(
        "diffuse", f'<texture name="reflectance" type="bitmap"><string name="filename" value="{name}"/></texture>'
    )


def mesh(name: str, kind: str = "ply") -> str:
    """A mesh file."""
    return put(f'<shape type="{kind}"><string name="filename" value="{name}"/></shape>')


def file(name: str, content: str | bytes) -> Prepare:
    """Puts a file beside the scene."""

    def write(folder: Path) -> None:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)

    return write
