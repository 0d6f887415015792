"""Hostile inputs through the command line: how each kind ends, in how many lines, seconds and bytes of memory.

    python benchmarks/hostile.py --json FILE [--count 1000] [--seed 0] [--kind pictures ...]

Inputs are made from a seed: good files of every kind that mitsim reads with bytes changed, and files that lie in one
place. Each goes through its verb in a process that is forked for it, as the command line runs there, without the parent
that would watch it, so that a crash in native code is seen. Ends with 1, and names them, where an input gives a
traceback, a fault of mitsim's own, or another status than 0, 1 or 2; a refusal of other than one printable line, or of
which a file is left; or where one takes more than ``SECONDS`` of processor time or ``MEMORY``. FILE has
a row for each kind and one for each input that broke a rule.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import random
import shutil
import signal
import struct
import sys
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import h5py
import numpy as np
import psutil
import scipy.io
from PIL import Image

import mitsim.cli
from mitsim.core.framefile import write_frame
from mitsim.core.versions import versions
from mitsim.exchange.export import export_run
from mitsim.study.experiment import Found, Point, Scope, Setup
from mitsim.study.points import Store
from tests.exchanged import made
from tests.hard.fuzz import bytes_changed, json_changed
from tests.hard.test_hostile_scenes import CASES as SCENES

SECONDS, MEMORY = 20.0, 2 << 30
"""Of one input: processor time, so that a busy machine makes no verdict, and memory beyond what the command has when it
starts. Refusals take 0.3 s; the largest good inputs here some 2 s."""
_ALARM = 120
"""Seconds after which an input counts as hanging, on a machine that is busy too."""
FRAMES = ("--camera", "imx249", "--patterns", "uniform", "--exposure", "0.1", "--projector-pixels", "4")
Make = Callable[[random.Random, Path], Sequence[str]]
"""Puts an input into a folder, and gives the command that reads it, writing to ``folder / "out"`` alone."""


@dataclass
class Outcome:
    """How one input ended."""

    kind: str
    seed: int
    command: list[str]
    status: int
    lines: int
    seconds: float
    memory_bytes: int
    broken: list[str] = field(default_factory=list)
    said: str = ""


class Good:
    """Good files of every kind, made once."""

    def __init__(self, folder: Path) -> None:
        self.bench = made(folder)
        self.folder = folder
        for ending, name in (("hdf5", "run.h5"), ("mat", "run.mat")):
            export_run(self.bench.run, ending, folder / name, self.bench.calibration)
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
        (folder / "camera.toml").write_text(
            (Path(__file__).parents[1] / "calibration" / "imx249.toml").read_text(encoding="utf-8")
        )


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
    if path.name.startswith("run."):
        return ("import", str(path), "-o", out, "--calibration-output", out + "2")
    if path.name.startswith("light."):
        return ("sense", str(path), "--camera", "imx249", "-o", out + ".npy")
    return ("import", str(path), *FRAMES, "-o", out)


def pictures(good: Good) -> Make:
    """Pictures that claim, hide, turn or repeat."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    def png(width: int, height: int, more: bytes = b"", bits: int = 8, lines: int | None = None) -> bytes:
        rows = zlib.compress(bytes((width * bits // 8 + 1) * (height if lines is None else lines)))
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
            kind = chance.choice(
                (b"acTL", b"eXIf", b"tRNS", b"iCCP", b"zTXt", b"tEXt", b"gAMA", b"sBIT", b"fcTL", b"qqqq")
            )
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
            pixels, bits = (
                chance.choice(("8x8", "16384x16384", "0x4", "99999x1", "axb")),
                chance.choice(("8", "16", "0")),
            )
            return (
                "import",
                str(folder / "a.raw"),
                *FRAMES,
                "-o",
                str(folder / "out"),
                "--shape",
                pixels,
                "--bits",
                bits,
            )
        name = chance.choice(("a.png", "a.tif", "a.npy", "a.exr", "a.raw", "a.h5", "a.mat"))
        (folder / name).write_bytes(
            chance.choice((b"", b"\0" * 100, b"hello", b"\x89PNG\r\n\x1a\n", b"II*\0", b"MATLAB 5.0"))
        )
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


def studies(good: Good) -> Make:
    """Parts of studies that name modules, claim arrays or are none."""

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        part = folder / "part"
        shutil.copytree(good.folder / "part", part)
        head = json.loads((part / "patterns.json").read_text())
        names: tuple[Any, ...] = (
            "os.path",
            "patterns",
            "all",
            "..a",
            "a.b\x1b[2J",
            None,
            [],
            "antigravity",
            "this.that",
            "sweep",
            "x" * 9999,
        )
        if chance.random() < 0.7:
            head["study"] = chance.choice(names)
        head = json_changed(head, chance) if chance.random() < 0.6 else head
        text = json.dumps(head)
        (part / "patterns.json").write_bytes(
            bytes_changed(text.encode(), chance) if chance.random() < 0.2 else text.encode()
        )
        file = next((part / "points").iterdir())
        which = chance.randrange(4)
        if which == 0:
            file.write_bytes(b"")
        elif which == 1:
            file.write_bytes(bytes_changed(file.read_bytes(), chance))
        elif which == 2:
            with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
                packed.writestr("rows.npy", bytes(1 << 24))
        return ("study", "merge", str(part), "-o", str(folder / "out"))

    return make


def runs(good: Good) -> Make:
    """RUN and CAL folders with one file changed, reconstructed or exported."""

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        shutil.copytree(good.bench.run, folder / "run")
        shutil.copytree(good.bench.calibration, folder / "cal")
        place = folder / chance.choice(("run", "cal"))
        path = chance.choice(sorted(place.iterdir()))
        if path.suffix == ".json" and chance.random() < 0.8:
            path.write_text(json.dumps(json_changed(json.loads(path.read_text()), chance)))
        elif chance.random() < 0.2:
            path.unlink()
            chance.choice((lambda: path.mkdir(), lambda: os.mkfifo(path), lambda: path.symlink_to("/dev/zero")))()
        else:
            path.write_bytes(bytes_changed(path.read_bytes(), chance))
        out, cal = str(folder / "out"), str(folder / "cal")
        if chance.random() < 0.5:
            return ("reconstruct", str(folder / "run"), "--calibration", cal, "-o", out)
        kind, ending = chance.choice((("hdf5", ".h5"), ("mat", ".mat")))
        return ("export", str(folder / "run"), "--format", kind, "--calibration", cal, "-o", out + ending)

    return make


def cameras(good: Good) -> Make:
    """Camera files with a line changed, behind which an image is put."""
    lines = (good.folder / "camera.toml").read_text().splitlines()
    keys = [number for number, line in enumerate(lines) if " = " in line]
    odd = (
        "0",
        "-1",
        "1e308",
        "1e-308",
        "nan",
        "inf",
        '"x"',
        "[]",
        "{}",
        "true",
        "1" * 400,
        "[[" * 500,
        '"\\u0000"',
        "1_0",
        "",
    )

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        text = [*lines]
        number = chance.choice(keys)
        name = text[number].partition(" = ")[0]
        text[number] = chance.choice(
            (f"{name} = {chance.choice(odd)}", f"{name}{name} = 1", "", f"[{name}]", "[mask]\nkind = 3")
        )
        content = "\n".join(text).encode()
        (folder / "camera.toml").write_bytes(bytes_changed(content, chance) if chance.random() < 0.2 else content)
        camera = str(folder / "camera.toml")
        return ("sense", str(good.folder / "light.npy"), "--camera", camera, "-o", str(folder / "out.npy"))

    return make


def arguments(good: Good) -> Make:
    """Words that no argument can have."""
    odd = (
        "",
        "0",
        "-1",
        "nan",
        "inf",
        "1e99",
        "x",
        "dots:",
        "dots:4096",
        "hadamard:4096",
        "random:4096",
        "dots:1x4096",
        "\x1b[2J",
    )

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        out, word = str(folder / "out"), chance.choice(odd)
        light = str(good.folder / "light.npy")
        return chance.choice(
            (
                ("patterns", word, "-o", out, "--projector-pixels", chance.choice(("4", "128", "4096", "0", "x"))),
                ("patterns", "stripes", "-o", out, "--camera", "imx249", "--exposure", word, "--projector-pixels", "2"),
                (
                    "sense",
                    light,
                    "--camera",
                    "imx249",
                    "-o",
                    out + ".png",
                    chance.choice(("--scale", "--exposure", "--f-number")),
                    word,
                ),
                (
                    "import",
                    str(good.folder / "a.png"),
                    *FRAMES[:4],
                    "--exposure",
                    word,
                    "--projector-pixels",
                    "4",
                    "-o",
                    out,
                ),
                (
                    "export",
                    str(good.bench.run),
                    "--format",
                    chance.choice(("png", "hdf5", word)),
                    "--projector",
                    word,
                    "-o",
                    out,
                ),
                (
                    "reconstruct",
                    str(good.bench.run),
                    "--calibration",
                    str(good.bench.calibration),
                    "--lambda",
                    word,
                    "-o",
                    out,
                ),
                (
                    "plan",
                    "photograph",
                    chance.choice(("--patterns", "--accuracy", "--seconds", "--effects", "-D")),
                    word,
                ),
                (
                    "characterise",
                    "imx249",
                    "-o",
                    out,
                    chance.choice(("--pixels", "--steps", "--frames", "--wavelength")),
                    "-" + word,
                ),
            )
        )

    return make


def scenes(good: Good) -> Make:
    """Scenes that tests/hard/hostile has, which the guard refuses."""

    def make(chance: random.Random, folder: Path) -> Sequence[str]:
        case = chance.choice(SCENES)
        defines = [f"-D{name}={value}" for name, value in case.defines]
        (folder / "in").mkdir()
        return ("plan", str(case.write(folder / "in")), *defines)

    return make


BEFOREHAND = (
    *("capture.sense", "exchange.hdf5", "exchange.matlab", "exchange.real", "exchange.load", "exchange.pngs"),
    *("study.campaign", "study.page", "study.quality", "study.characterise", "study.paper.patterns", "core.worker"),
    *("scene.guard.check", "capture.opening", "reconstruct.reconstruction", "rig.recipe", "capture.request"),
)
"""Modules that commands import where they use them: here before all, so that an input takes less than a second."""
KINDS: dict[str, tuple[int, list[Callable[[Good], Make]]]] = {
    "pictures": (18, [pictures]),
    "pictures, bytes": (16, [changed(name) for name in ("a.png", "a.tif", "b.tif", "a.npy", "a.exr")]),
    "HDF5": (12, [hdf5]),
    "HDF5, bytes": (6, [changed("run.h5")]),
    "MATLAB": (12, [matlab]),
    "MATLAB, bytes": (4, [changed("run.mat")]),
    "images of sense": (6, [changed("light.npy"), changed("light.exr")]),
    "studies": (8, [studies]),
    "runs": (8, [runs]),
    "cameras": (6, [cameras]),
    "arguments": (6, [arguments]),
    "scenes": (8, [scenes]),
}
"""Share of all inputs, and what makes them."""


def serve(command: Sequence[str], stdout: Path, stderr: Path) -> None:
    """Run a command as the worker does, in this process, and end it."""
    for number, path in ((1, stdout), (2, stderr)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    signal.alarm(_ALARM)
    sys.argv = ["mitsim", *command]
    status = 70
    try:
        mitsim.cli.run()
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else 1
    except BaseException:
        import traceback

        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def tried(kind: str, seed: int, make: Make) -> Outcome:
    """One input, made and run; what it broke."""
    with tempfile.TemporaryDirectory(prefix="mitsim-hostile-") as name:
        folder = Path(name)
        work = folder / "work"
        work.mkdir()
        command = [*make(random.Random(seed), work)]
        before = listed(work)
        started, held = time.perf_counter(), psutil.Process().memory_info().rss
        child = os.fork()
        if not child:
            serve(command, folder / "stdout", folder / "stderr")
        _, ended, usage = os.wait4(child, 0)
        status = os.waitstatus_to_exitcode(ended)
        said = (folder / "stderr").read_bytes().decode(errors="replace")
        lines = [line for line in said.split("\n") if line]
        outcome = Outcome(
            kind,
            seed,
            command,
            status,
            len(lines),
            time.perf_counter() - started,
            max(usage.ru_maxrss * 1024 - held, 0),
        )
        broken = outcome.broken
        if status not in (0, 1, 2):
            broken.append(f"status {status}")
        if "Traceback" in said or "a fault of mitsim's own" in said:
            broken.append("traceback")
        if status == 2 and len(lines) != 1:
            broken.append(f"{len(lines)} lines of a refusal")
        if not all(line.isprintable() for line in lines):
            broken.append("control characters")
        if status == 2 and (left := sorted({*listed(work)} - {*before})):
            broken.append(f"left behind: {left[:3]}")
        if (used := usage.ru_utime + usage.ru_stime) > SECONDS:
            broken.append(f"{used:.1f} s")
        if outcome.memory_bytes > MEMORY:
            broken.append(f"{outcome.memory_bytes / 2**30:.2f} GiB")
        outcome.said = said[-1500:] if broken else said[:200]
        return outcome


def listed(folder: Path) -> list[str]:
    """All that is in a folder, links not followed."""
    return [
        str(Path(place, name).relative_to(folder)) for place, dirs, files in os.walk(folder) for name in (*dirs, *files)
    ]


def table(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """A row for each kind."""
    rows = []
    for kind in dict.fromkeys(each.kind for each in outcomes):
        own = [each for each in outcomes if each.kind == kind]
        statuses = {
            str(status): sum(each.status == status for each in own) for status in sorted({e.status for e in own})
        }
        rows.append(
            {
                "kind": kind,
                "inputs": len(own),
                "status": statuses,
                "most_lines": max(each.lines for each in own),
                "most_seconds": round(max(each.seconds for each in own), 2),
                "most_memory_bytes": max(each.memory_bytes for each in own),
                "broken": sum(bool(each.broken) for each in own),
            }
        )
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Run them all, print and write the table; 1 where a rule was broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", nargs="*", choices=KINDS, default=[*KINDS])
    asked = parser.parse_args(arguments)
    whole = sum(KINDS[kind][0] for kind in asked.kind)
    outcomes: list[Outcome] = []
    for module in BEFOREHAND:
        importlib.import_module(f"mitsim.{module}")
    with tempfile.TemporaryDirectory(prefix="mitsim-good-") as folder:
        good = Good(Path(folder) / "good")
        for kind in asked.kind:
            share, makers = KINDS[kind]
            makes = [maker(good) for maker in makers]
            for number in range(max(round(asked.count * share / whole), 1)):
                seed = asked.seed + number
                outcome = tried(kind, seed, makes[number % len(makes)])
                outcomes.append(outcome)
                if outcome.broken:
                    print(f"{kind} {seed}: {'; '.join(outcome.broken)}: {outcome.said.strip()[-300:]!r}", flush=True)
            print(json.dumps(table(outcomes)[-1]), flush=True)
    broken = [asdict(each) for each in outcomes if each.broken]
    if asked.json:
        result = {"seed": asked.seed, "inputs": len(outcomes), "kinds": table(outcomes), "broken": broken}
        asked.json.write_text(json.dumps(result, indent=1) + "\n")
    print(f"{len(outcomes)} inputs, {len(broken)} broke a rule")
    return int(bool(broken))


if __name__ == "__main__":
    sys.exit(main())
