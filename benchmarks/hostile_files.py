"""Binary files that lie, made from a seed: good ones of every kind that mitsim reads in, hostile ones and the command
that reads them out. For ``benchmarks/hostile.py``."""

from __future__ import annotations

import json
import os
import random
import shutil
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import OpenEXR
import scipy.io
from harness import ROOT
from PIL import Image, ImageCms

from mitsim.core.environment import versions
from mitsim.core.exr import write_frame
from mitsim.core.files import stderr_silenced
from mitsim.exchange.formats import export
from mitsim.studies.framework.campaign import Store
from mitsim.studies.framework.experiment import Found, Point, Scope, Setup
from tests.exchanged import made
from tests.hard.fuzz import bytes_changed
from tests.real_session import RealSession

FRAMES = ("--camera", "imx249", "--patterns", "uniform", "--exposure", "0.1", "--projector-pixels", "4")
ENDINGS = (".png", ".tif", ".tiff", ".jpg", ".webp", ".bmp", ".gif", ".PNG", ".Tif", ".npy", ".exr")
MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr", "LAB", "I", "I;16", "I;16B", "F")
PACKINGS = ("raw", "tiff_lzw", "tiff_adobe_deflate", "packbits", "group4", "jpeg", "zstd", "lzma", "webp")
Make = Callable[[random.Random, Path], Sequence[str]]
"""Puts an input into a folder, and gives the command that reads it, writing to ``folder / "out"`` alone."""


class Good:
    """Good files of every kind, made once."""

    def __init__(self, folder: Path) -> None:
        self.bench = made(folder)
        self.folder = folder
        export(self.bench.run, "hdf5", folder / "run.h5", self.bench.calibration)
        factors = {"P1b": np.ones((50, 16)), "Q1b": np.ones((62, 18)), "angle": -0.4, "text": "calibration"}
        scipy.io.savemat(folder / "run.mat", factors)  # as a FlatCam's calibration
        numbers = (np.arange(80).reshape(8, 10) * 40).astype(np.uint16)
        for name in ("a.png", "a.tif", "b.tif"):
            Image.fromarray(numbers).save(folder / name, **({"compression": "tiff_lzw"} if name == "b.tif" else {}))
        np.save(folder / "a.npy", numbers)
        write_frame(folder / "a.exr", {"DN": numbers.astype(np.uint32)}, {"run": "x"})
        write_frame(folder / "light.exr", {"Y": numbers.astype(np.float32)}, {})
        np.save(folder / "light.npy", numbers.astype(float))
        part = folder / "part"
        (part / "points").mkdir(parents=True)
        self.points = [Point.of(Setup("photograph"), number=number) for number in range(2)]
        for point in self.points:
            Store(part / "points").save(point, Found(({"psnr": 1.0},), {"image": np.ones((4, 4))}))
        head = {"kind": "patterns", "study": "patterns", "scope": asdict(Scope(Setup("photograph"), (None,)))}
        (part / "patterns.json").write_text(json.dumps({**head, "versions": versions()}))
        for name, kept in (("imx249", "camera"), ("drift", "recipe"), ("mp_cl1", "projector")):
            text = (ROOT / "calibration" / f"{name}.toml").read_text(encoding="utf-8")
            (folder / f"{kept}.toml").write_text(text, encoding="utf-8")
        RealSession().write(folder / "session")
        export(self.bench.run, "png", folder / "shown", None, projector="mp_cl1")


def changed(name: str) -> Callable[[Good], Make]:
    """The good file ``name`` with bytes changed, flipped in its header for the most part."""

    def of(good: Good) -> Make:
        data = (good.folder / name).read_bytes()

        def make(chance: random.Random, folder: Path) -> Sequence[str]:
            cut = len(data) if chance.random() < 0.3 else min(len(data), 700)
            (folder / name).write_bytes(bytes_changed(data[:cut], chance) + data[cut:])
            return _read(folder / name)

        return make

    return of


def _read(path: Path) -> Sequence[str]:
    """What reads a file, writing beside it."""
    out = str(path.parent / "out")
    if path.name == "run.mat":
        return ("import", str(path), "--channel", "b", "--calibration-output", out)
    if path.name.startswith("run."):
        return ("import", str(path), "-o", out, "--calibration-output", out + "2")
    if path.name.startswith("light."):
        return ("sense", str(path), "--camera", "imx249", "-o", out + ".npy")
    return ("import", str(path), *FRAMES, "-o", out)


def pictures(good: Good) -> Make:
    """Pictures that claim, hide, turn or repeat."""

    def png(width: int, height: int, more: bytes = b"", bits: int = 8, lines: int | None = None) -> bytes:
        size = (width * bits // 8 + 1) * (height if lines is None else lines)
        rows = zlib.compress(bytes(min(size, 1 << 20)))
        head = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
        return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + more + chunk(b"IDAT", rows) + chunk(b"IEND", b"")

    def tiff(tags: dict[int, int], data: bytes = bytes(64), order: str = "<", following: int = 0) -> bytes:
        entries = b"".join(struct.pack(f"{order}HHII", tag, 4, 1, value) for tag, value in sorted(tags.items()))
        head = (b"II" if order == "<" else b"MM") + struct.pack(f"{order}HI", 42, 8 + len(data))
        return head + data + struct.pack(f"{order}H", len(tags)) + entries + struct.pack(f"{order}I", following)

    plain = {256: 8, 257: 8, 258: 8, 259: 1, 262: 1, 273: 8, 277: 1, 278: 8, 279: 64}

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        many = chance.choice((1, 8, 255, 4096, 16384, 16385, 65535, 2**31 - 1, 2**32 - 1))
        which = chance.randrange(9)
        if which == 0:
            (folder / "a.png").write_bytes(png(min(many, 2**31 - 1), chance.choice((1, 8, 65535)), lines=4))
            return _read(folder / "a.png")
        if which == 1:
            kind = chance.choice(b"acTL eXIf tRNS iCCP zTXt tEXt gAMA sBIT fcTL qqqq".split())
            content = chance.randbytes(chance.choice((0, 1, 8, 26, 5000)))
            if kind in (b"iCCP", b"zTXt"):
                content = b"a\0\0" + zlib.compress(bytes(1 << 24))
            (folder / "a.png").write_bytes(png(8, 8, chunk(kind, content) * chance.choice((1, 2, 1200))))
            return _read(folder / "a.png")
        if which == 2:
            exif = Image.Exif()
            exif[274] = chance.randrange(0, 12)
            name = chance.choice(("a.png", "a.tif"))
            Image.new("L", (8, 6), 9).save(folder / name, exif=exif)
            return _read(folder / name)
        if which in (3, 4):
            tags = {**plain, chance.choice((*plain, 254, 266, 274, 284, 317, 322, 323, 330, 338, 339)): many}
            order = chance.choice("<>")
            following = chance.choice((0, 0, 8, 72, many))
            (folder / "a.tif").write_bytes(tiff(tags, order=order, following=following))
            return _read(folder / "a.tif")
        if which == 5:
            stack = [Image.new("L", (8, 6)) for _ in range(chance.randrange(1, 5))]
            name = chance.choice(("a.png", "a.tif", "a.gif", "a.webp"))
            stack[0].save(folder / name, save_all=True, append_images=stack[1:])
            shutil.move(folder / name, folder / f"b{chance.choice((name[1:], '.png', '.tif'))}")
            return _read(next(folder.glob("b.*")))
        if which == 6:
            shape = tuple(chance.choice((1, 8, 16000, 16384, 16385, 10**6)) for _ in range(chance.randrange(1, 5)))
            held = BytesIO()
            letters = chance.choice(("<u2", ">f8", "|b1", "|O", "<c16", "<U9", "<f4"))
            head = {"descr": letters, "fortran_order": chance.random() < 0.3, "shape": shape}
            np.lib.format.write_array_header_1_0(held, head)
            (folder / "a.npy").write_bytes(held.getvalue())
            size = int(np.prod([float(side) for side in shape])) * np.dtype(letters).itemsize
            if chance.random() < 0.6 and size < 1 << 43:
                os.truncate(folder / "a.npy", len(held.getvalue()) + size + chance.choice((0, 0, 1)))
            return _read(folder / "a.npy")
        if which == 7:
            (folder / "a.raw").write_bytes(bytes(chance.choice((0, 63, 64, 128, 129))))
            if chance.random() < 0.4:
                os.truncate(folder / "a.raw", chance.choice((1 << 30, 1 << 40)))
            form = (
                "--shape",
                chance.choice("8x8 16384x16384 0x4 99999x1 axb".split()),
                "--bits",
                chance.choice("8 16 0".split()),
            )
            return ("import", str(folder / "a.raw"), *FRAMES, "-o", str(folder / "out"), *form)
        name = chance.choice(("a.png", "a.tif", "a.npy", "a.exr", "a.raw", "a.h5", "a.mat"))
        starts = (b"", b"\0" * 100, b"hello", b"\x89PNG\r\n\x1a\n", b"II*\0", b"MATLAB 5.0")
        (folder / name).write_bytes(chance.choice(starts))
        return _read(folder / name)

    return make


def hdf5(good: Good) -> Make:
    """Exported files in which one thing is another."""
    data = (good.folder / "run.h5").read_bytes()
    with h5py.File(BytesIO(data)) as file:
        names: list[str] = []
        file.visit(names.append)

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        path = folder / "run.h5"
        path.write_bytes(data)
        with h5py.File(path, "r+") as file:
            name, huge = chance.choice(names), chance.choice((1, 6, 16000, 16385, 1 << 33))
            shape = tuple(chance.choice((1, 6, huge)) for _ in range(chance.randrange(4)))
            which = chance.randrange(8)
            group = isinstance(file[name], h5py.Group)
            del file[name]
            if which == 0:
                file[name] = chance.choice(
                    (h5py.SoftLink("/run"), h5py.ExternalLink("/etc/passwd", "/"), h5py.SoftLink(name))
                )
            elif which in (1, 2):
                chunks = tuple(min(side, 1000) for side in shape) or None
                kind = chance.choice(("u1", "u4", "f4", "f8", "S9", h5py.string_dtype()))
                file.create_dataset(name, shape, kind, chunks=chunks if which == 1 and shape else None)
            elif which == 3:
                file.create_group(name)
            elif which == 4:
                file.create_dataset(name, data=np.zeros(tuple(min(side, 50) for side in shape), "u4"))
            elif which == 5 and not group:
                layout = h5py.VirtualLayout((6, 40, 52), "u4")
                layout[:] = h5py.VirtualSource("other.h5", "a", (6, 40, 52))
                file.create_virtual_dataset(name, layout)
            elif which == 6:
                file.create_dataset(name, (6, 40, 52), "u4", external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)])
            # 7: it is gone.
        return _read(path)

    return make


def matlab(good: Good) -> Make:
    """Exported files in which a variable is another, or with elements that lie."""
    held = {name: value for name, value in scipy.io.loadmat(good.folder / "run.mat").items() if name[0] != "_"}

    def element(kind: int, content: bytes) -> bytes:
        return struct.pack("<2I", kind, len(content)) + content + bytes(-len(content) % 8)

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        path = folder / "run.mat"
        if chance.random() < 0.5:
            nested: Any = 1.0
            for _ in range(chance.choice((1, 40))):
                nested = np.array([nested], object)
            other = chance.choice(
                (None, 1.0, "text", np.zeros((3, 4, 5)), np.zeros((0, 0)), {"a": 1}, nested, 1j * np.ones(4))
            )
            name = chance.choice([*held])
            values = {key: value for key, value in {**held, name: other}.items() if value is not None}
            scipy.io.savemat(path, values, do_compression=chance.random() < 0.5)
            return _read(path)
        sides = tuple(chance.choice((0, 1, -1, 1 << 20, 1 << 30)) for _ in range(chance.choice((1, 2, 3, 900))))
        flags = chance.choice((6, 6, 1, 4, 9, 17, 255, 0x806, 0x206))
        claimed = element(9, bytes(chance.choice((0, 8, 4096))))
        if chance.random() < 0.5:
            claimed = struct.pack("<2I", 9, chance.choice((1 << 31, 1 << 20, 9))) + bytes(8)
        parts = element(6, struct.pack("<2I", flags, 0)) + element(5, struct.pack(f"<{len(sides)}i", *sides))
        array = element(14, parts + element(1, b"P1b" * chance.choice((1, 3000))) + claimed)
        if flags == 1:
            for _ in range(chance.choice((10, 3000))):
                array = element(14, parts + element(1, b"") + array)
        if chance.random() < 0.5:
            array = struct.pack("<2I", 15, len(zlib.compress(array))) + zlib.compress(array)
        path.write_bytes(b"MATLAB 5.0".ljust(124) + b"\0\1IM" + array * chance.choice((1, 1, 2)))
        channel = ("--channel", "b") if chance.random() < 0.7 else ("-o", str(folder / "out"))
        return ("import", str(path), *channel, "--calibration-output", str(folder / "out2"))

    return make


def interlaced(bits: int, colour: int) -> bytes:
    """A PNG of 10 x 8 pixels whose lines come in seven passes (ISO/IEC 15948, 8.2)."""
    samples = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colour]
    passes = ((8, 8, 0, 0), (8, 8, 0, 4), (8, 4, 4, 0), (4, 4, 0, 2), (4, 2, 2, 0), (2, 2, 0, 1), (2, 1, 1, 0))
    rows = b""
    for down, right, top, left in passes:
        lines, columns = -(-(8 - top) // down), -(-(10 - left) // right)
        rows += bytes(1 + -(-columns * bits * samples // 8)) * lines
    head = struct.pack(">IIBBBBB", 10, 8, bits, colour, 0, 0, 1)
    palette = chunk(b"PLTE", bytes(3 * 2 ** min(bits, 8))) if colour == 3 else b""
    body = palette + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + body


def save_picture(folder: Path, chance: random.Random) -> Path:
    """A picture as a program writes it: in colours, with a palette, transparency or a profile, packed, interlaced,
    signed, of real numbers, or under the name of another kind."""
    path = folder / f"a{chance.choice(ENDINGS)}"
    if chance.random() < 0.15:
        path.write_bytes(interlaced(chance.choice((1, 2, 4, 8, 16)), chance.choice((0, 2, 3, 4, 6))))
        return path
    picture = Image.new(chance.choice(MODES), chance.choice(((10, 8), (1, 1), (400, 3))), chance.choice((0, 1)))
    kind = chance.choice(("PNG", "TIFF", "TIFF", "JPEG", "WEBP", "BMP", "GIF", "PPM", "ICO", "JPEG2000"))
    if kind in ("PNG", "TIFF", "JPEG") and chance.random() < 0.8:
        path = folder / {"PNG": "a.png", "TIFF": "a.tif", "JPEG": "a.jpg"}[kind]
    more: dict[str, Any] = {}
    if kind == "TIFF":
        more = {"compression": chance.choice(PACKINGS), "big_tiff": chance.random() < 0.4}
        if chance.random() < 0.4:
            number = chance.choice((254, 262, 266, 284, 317, 322, 339, 270, 33432, 34675, 65000))
            more["tiffinfo"] = {number: chance.choice((0, 1, 2, 65535, "x" * 9999))}
    if chance.random() < 0.3:
        profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
        more["icc_profile"] = chance.choice((profile, b"", bytes(70_000)))
    if chance.random() < 0.2 and kind == "PNG":
        more["transparency"] = 0
    try:
        with stderr_silenced():
            picture.save(path, format=kind, **more)
    except (OSError, ValueError, TypeError, KeyError, SystemError, RuntimeError, struct.error):
        Image.new("L", (10, 8)).save(path, format="PNG")  # what the writer has not: a good one under some name
    return path


def saved(good: Good) -> Make:
    """Pictures as programs write them, of which most are no frames."""
    return lambda chance, folder: reading(save_picture(folder, chance), chance)


def openexr(good: Good) -> Make:
    """OpenEXR files of other kinds than a frame is: tiled, deep, of several parts, half floats, other channels, windows
    off the origin, values that are no numbers."""

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        shape = chance.choice(((8, 10), (8, 10), (1, 1), (3, 400)))
        values = chance.choice((0.0, 1.0, -1.0, np.nan, np.inf, 1e38, 0.5))
        kinds = (np.float32, np.float16, np.uint32) if 0 <= values <= 1 else (np.float32,)
        numbers: Any = np.full(shape, values, chance.choice(kinds))
        names = chance.choice(
            (("DN",), ("Y",), ("R", "G", "B"), ("Z", "A"), ("DN", "Y"), ("a.b.c",), ("x" * 300,), ("é",))
        )
        channels: dict[str, Any] = {name: numbers for name in names}
        which = chance.randrange(6)
        header: dict[str, Any] = {
            "compression": chance.choice((OpenEXR.NO_COMPRESSION, OpenEXR.ZIP_COMPRESSION, OpenEXR.B44_COMPRESSION)),
            "type": OpenEXR.scanlineimage,
        }
        if which == 0:
            header["type"] = OpenEXR.tiledimage
            header["tiles"] = OpenEXR.TileDescription()
        elif which == 1:
            corner = np.array(chance.choice(((-5, -5), (7, 3), (10**6, 0))), np.int32)
            end = corner + np.array(shape[::-1], np.int32) - 1
            header["dataWindow"] = (corner, end)
            header["displayWindow"] = (corner, end + chance.choice((0, 1, 100)))
        elif which == 2:
            header[chance.choice(("mitsim.run", "mitsim.exposure_s", "owner", "worldToCamera"))] = chance.choice(
                ("{", "[" * 5000, "1e999", "\x1b[2J", "NaN", '"' + "x" * 70_000 + '"')
            )
        path = folder / chance.choice(("a.exr", "light.exr"))
        try:
            if which == 3:
                parts = [OpenEXR.Part(dict(header), channels, name) for name in ("a", "b")]
                OpenEXR.File(parts).write(str(path))
            else:
                OpenEXR.File(header, channels).write(str(path))
        except (RuntimeError, ValueError, TypeError, AttributeError):
            write_frame(path, {"DN": np.ones((8, 10), np.float32)}, {})
        if which == 4:  # deep: the flag alone, before data that are none
            data = bytearray(path.read_bytes())
            data[5] |= 0x08
            path.write_bytes(bytes(data))
        return reading(path, chance)

    return make


def arrays(good: Good) -> Make:
    """HDF5 and MATLAB files whose arrays are of other types, or that are of each other's kind: compound, enumerated,
    references, texts of any length, time, empty, attributes of megabytes, groups that hold themselves, v7.3."""
    data = {name: (good.folder / name).read_bytes() for name in ("run.h5", "run.mat")}
    with h5py.File(BytesIO(data["run.h5"])) as file:
        names: list[str] = []
        file.visit(names.append)

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        which = chance.randrange(9)
        if which == 0:  # each under the other's name, or before bytes of another program
            own, other = chance.sample(("run.h5", "run.mat"), 2)
            (folder / own).write_bytes(data[other])
            return _read(folder / own)
        if which == 1:
            (folder / "run.h5").write_bytes(bytes(chance.choice((512, 1024, 700))) + data["run.h5"])
            return _read(folder / "run.h5")
        path = folder / chance.choice(("run.h5", "run.h5", "run.mat"))
        path.write_bytes(data["run.h5"])
        with h5py.File(path, "r+") as file:
            name = chance.choice(names)
            if which == 2:
                file[name].attrs[chance.choice(("mitsim_exchange", "MATLAB_class", "x"))] = chance.choice(
                    (b"x", -1, 10**9, np.zeros(7000), "\x1b[2J", np.nan)
                )
                if chance.random() < 0.5:
                    file.attrs["mitsim_exchange"] = chance.choice(
                        (0, 2, 10**9, -1, "1", np.ones(3), 1.5, h5py.Empty("f"))
                    )
                return _read(path)
            del file[name]
            if which == 3:
                kind = np.dtype([("a", "u4"), ("b", "f8", (3,))])
                file.create_dataset(name, data=np.zeros((6, 4), kind))
            elif which == 4:
                kinds = ("i1", ">u4", "f2", ">f4", "f8", "c16", "?", h5py.enum_dtype({"A": 1}, "u4"), h5py.ref_dtype)
                file.create_dataset(name, (6, 40, 52), chance.choice(kinds))
            elif which == 5:
                file.create_dataset(name, data=h5py.Empty(chance.choice(("f4", "u1", "S3"))))
            elif which == 6:
                file.create_dataset(name, data=[b"{" * chance.choice((1, 99_999))] * chance.choice((1, 6)))
            elif which == 7:
                file[name] = file["run" if "run" in file and chance.random() < 0.5 else "/"]
            else:
                shape = chance.choice(((0,), (0, 0), (6, 0, 52), (1,) * 30, (6, 40, 52, 1)))
                file.create_dataset(name, data=np.zeros(shape, chance.choice(("u4", "f4", "u1"))))
        return _read(path)

    return make


def chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk of a PNG."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def reading(path: Path, chance: random.Random) -> Sequence[str]:
    """One of the ways in which a picture is read: as a frame, its own or the ambient one; as light that is sensed; in a
    folder of frames."""
    out = str(path.parent / "out")
    which = chance.randrange(4)
    if which == 0:
        return ("sense", str(path), "--camera", "imx249", "-o", out + chance.choice((".png", ".exr", ".npy")))
    if which == 1:
        folder = path.parent / "frames"
        folder.mkdir()
        shutil.move(path, folder / path.name)
        return ("import", str(folder), *FRAMES, "-o", out)
    if which == 2:
        frame = path.parent / "frame.npy"
        np.save(frame, np.ones((8, 10), np.uint16))
        return ("import", str(frame), "--ambient-frame", str(path), *FRAMES, "-o", out)
    return ("import", str(path), *FRAMES, "-o", out)
