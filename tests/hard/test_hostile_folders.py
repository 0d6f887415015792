"""Hostile RUN and CAL folders, camera files (TOML) and frames: refused in one line, in bounded memory and time.

Each case damages one file of a good folder. Frames are OpenEXR files with a lie each; odd ones are read.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from mitsim.core.configuration import read_toml
from mitsim.core.errors import MitsimError
from mitsim.core.exr import read_frame, write_frame
from mitsim.devices.sensor import load_sensor
from tests.hard.hostile.folders import PIXELS, Damage, folder, linked, pipe, raw, refusal, solved, sparse

pytestmark = pytest.mark.robustness("Input")


def test_the_good_folders_are_read(folders: tuple[Path, Path]) -> None:
    solved(*folders)


def put(*keys: str | int, value: object) -> Damage:
    def change(path: Path) -> None:
        manifest = item = json.loads(path.read_text())
        for key in keys[:-1]:
            item = item[key]
        item[keys[-1]] = value
        path.write_text(json.dumps(manifest))

    return change


def text(old: str, new: str) -> Damage:
    def change(path: Path) -> None:
        content = path.read_text()
        assert old in content
        path.write_text(content.replace(old, new, 1))

    return change


CASES: dict[str, dict[str, tuple[Damage, str]]] = {
    "both": {
        "no UTF-8": (raw(b'{"kind": "\xff\xfe"}'), "not valid JSON"),
        "UTF-16": (raw('{"kind": 1}'.encode("utf-16")), "not valid JSON"),
        "zero bytes": (raw(b"\0" * 4096), "not valid JSON"),
        "deep arrays": (raw("[" * 1_000_000), "nested too deep"),
        "deep objects": (raw('{"a":' * 500_000), "nested too deep"),
        "a number of a million digits": (raw("9" * 1_000_000), "not valid JSON"),
        "huge": (sparse, "at most 33554432"),
        "a pipe": (pipe, "pipe or device"),
        "a folder": (folder, "Is a directory"),
        "a device": (linked("/dev/zero"), "pipe or device"),
        "a link to itself": (linked("manifest.json"), "cannot be read"),
        "kind of 10 MB": (put("kind", value="k" * 10_000_000), "..."),
        "status of several lines": (put("status", value="a\n" * 999), "..."),
        "200000 false checksums": (
            put("checksums", value=dict.fromkeys(map(str, range(200_000)), 1)),
            "checksums: that of",
        ),
        "another camera of 10 MB": (put("camera", value={"name": "x" * 10_000_000}), "name is"),
    },
    "run": {
        "file of 5000 letters": (put("patterns", "captures", 1, "file", value="n" * 5000), "captures.1.file"),
        "10^12 patterns": (
            lambda path: [put("patterns", side, value=[[0] * 10**6])(path) for side in ("P_L", "P_R")],
            "P_L.0: got [0, 0, 0, 0, 0, 0, ...]; tuple should have at most 4096 items",
        ),
        "16 million patterns": (
            lambda path: [put("patterns", side, value=[[0] * 4096])(path) for side in ("P_L", "P_R")],
            "16777212 of 16777216 patterns have no frame, first (0, 2)",
        ),
        "60000 captures of one pattern": (
            put("patterns", "captures", value=[{"file": "a", "row": 0, "column": 0, "sign": 0}] * 60_000),
            "give each its own frame",
        ),
        "a million captures": (raw('{"patterns": {"captures": [' + "0," * 1_000_000 + "0]}}"), "holds a None"),
        "a million false captures": (text('"captures": [', '"captures": [' + "0," * 1_000_000), "captures.0: got 0"),
        "a million false weights": (text('"P_L": [', '"P_L": [' + "{}," * 1_000_000), "P_L.0: got {}"),
        "digital is null": (put("digital", value=None), "digital: got None"),
    },
    "cal": {},
}
for section, listed in read_toml(Path(__file__).parent / "hostile" / "manifests.toml").items():
    for name, told in listed.items():
        if "at" in told:
            keys = [int(key) if key.isdigit() else key for key in told["at"].split(".")]
            damage = put(*keys, value=told["value"])
        else:
            damage = text(*told["text"]) if "text" in told else raw(told["raw"])
        CASES[section][name] = damage, told["says"]


@pytest.mark.usefixtures("bounded")
@pytest.mark.parametrize(
    ("which", "section", "name"),
    [(which, each, name) for which in ("run", "cal") for each in ("both", which) for name in CASES[each]],
)
def test_a_hostile_manifest(folders: tuple[Path, Path], which: str, section: str, name: str) -> None:
    damage, words = CASES[section][name]
    damage(folders[which == "cal"] / "manifest.json")
    assert words in refusal(lambda: solved(*folders))


@pytest.mark.parametrize("name", ["run/frame_01.exr", "cal/left.exr"])
def test_a_link_out_of_the_folder(folders: tuple[Path, Path], tmp_path: Path, name: str) -> None:
    """Also to a good frame: a folder that was handed on must not show other files of its reader."""
    path = tmp_path / name
    path.rename(tmp_path / "away.exr")
    path.symlink_to(tmp_path / "away.exr")
    assert "leads out of its folder" in refusal(lambda: solved(*folders))


# ---- Camera files ----


TOML = {
    "deep arrays": ("a = " + "[" * 50_000, "nested too deep"),
    "deep tables": ("a = " + "{a=" * 20_000, "nested too deep"),
    "a name of 20000 parts": ("a." * 20_000 + "a = 1", "over 200 dots"),
    "key twice": ("a = 1\na = 2", "not valid TOML"),
    "2 MiB": ("#" * (2 << 20), "at most 65536"),
    "no UTF-8": (b"\xff\xfe", "not valid TOML"),
    "zero bytes": (b"\0" * 99, "not valid TOML"),
    "a number of 10000 digits": ("bits = " + "9" * 10_000, "TOML"),
    "a number of 60000 hexadecimal digits": ("bits = 0x" + "f" * 60_000, "name"),
    "bits of 10^400": ("bits = 1" + "0" * 400, "name"),
    "a name of 60000 letters": ("name = '" + "x" * 60_000 + "'", "pixel_pitch_um"),
    "a field of 60000 letters": ("x" * 60_000 + " = 1", "name"),
}


@pytest.mark.usefixtures("bounded")
@pytest.mark.parametrize("name", TOML)
def test_a_hostile_camera(tmp_path: Path, name: str) -> None:
    content, words = TOML[name]
    path = tmp_path / "camera.toml"
    raw(content)(path)
    message = refusal(lambda: load_sensor(path))
    assert str(path) in message and words in message


@pytest.mark.parametrize("value", ["0x" + "f" * 50_000, "1e400", "nan", "'" + "x" * 50_000 + "'", "[[[[[[[[1]]]]]]]]"])
def test_a_camera_with_one_hostile_value(tmp_path: Path, lab_camera: str, value: str) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(lab_camera.replace("bits = 12", f"bits = {value}"))
    assert "bits: got" in refusal(lambda: load_sensor(path))


@pytest.fixture
def lab_camera() -> str:
    from mitsim.core.configuration import shipped_path

    text = shipped_path("calibration", "imx249.toml").read_text()
    assert "bits = 12" in text
    return text


@pytest.mark.parametrize("damage", [pipe, folder, sparse], ids=["pipe", "folder", "huge"])
def test_a_camera_that_is_no_file(tmp_path: Path, damage: Damage) -> None:
    path = tmp_path / "camera.toml"
    path.write_text("")
    damage(path)
    assert str(path) in refusal(lambda: read_toml(path))


# ---- Frames ----


def exr_file(window: tuple[int, int, int, int] = (0, 0, 7, 7), **changes: Any) -> bytes:
    """An OpenEXR file of one float32 channel "DN", written byte by byte; ``changes`` put lies into it.

    After the OpenEXR file layout: magic, version and flags, attributes, chunk table, chunks of one line each.
    """

    def attribute(name: str, kind: str, value: bytes, length: int | None = None) -> bytes:
        size = struct.pack("<i", len(value) if length is None else length)
        return name.encode() + b"\0" + kind.encode() + b"\0" + size + value

    box = struct.pack("<4i", *window)
    channel = changes.get(
        "channel", b"DN\0" + struct.pack("<iiii", changes.get("pixel", 2), 0, *changes.get("sampling", (1, 1)))
    )
    header = struct.pack("<II", 20000630, changes.get("flags", 2))
    header += attribute("channels", "chlist", channel * changes.get("times", 1) + b"\0", changes.get("length"))
    header += attribute("compression", "compression", bytes([changes.get("compression", 0)]))
    header += attribute("dataWindow", changes.get("box", "box2i"), box) + attribute("displayWindow", "box2i", box)
    header += attribute("lineOrder", "lineOrder", b"\0") + attribute("pixelAspectRatio", "float", struct.pack("<f", 1))
    header += attribute("screenWindowCenter", "v2f", bytes(8)) + attribute(
        "screenWindowWidth", "float", struct.pack("<f", 1)
    )
    header += changes.get("more", b"") + b"\0"
    lines, line = changes.get("lines", 8), struct.pack("<8f", *range(8))
    start = len(header) + 8 * lines + changes.get("shift", 0)
    table = b"".join(struct.pack("<Q", start + i * (8 + len(line))) for i in range(lines))
    chunks = b"".join(struct.pack("<ii", i, changes.get("size", len(line))) + line for i in range(lines))
    return header + table + chunks


def text_attribute(name: str, value: bytes) -> bytes:
    return f"{name}\0string\0".encode() + struct.pack("<i", len(value)) + value


FRAMES = {
    "text": (b"hello", "not an OpenEXR file"),
    "magic alone": (exr_file()[:4], "not an OpenEXR file"),
    "cut in the header": (exr_file()[:100], "cut short"),
    "cut in the last line": (exr_file()[:-1], "damaged"),
    "2^31 pixels": (exr_file((0, 0, 65535, 32767)), "65536x32768"),
    "window turned round": (exr_file((7, 7, 0, 0)), "damaged"),
    "tiled": (exr_file(flags=2 | 0x200), "damaged"),
    "of several parts": (exr_file(flags=2 | 0x1000), "damaged"),
    "version 77": (exr_file(flags=77), "damaged"),
    "compression 99": (exr_file(compression=99), "damaged"),
    "pixels of type 9": (exr_file(pixel=9), "damaged"),
    "sampling 0": (exr_file(sampling=(0, 0)), "damaged"),
    "sampling 2": (exr_file(sampling=(2, 2)), "leave out pixels"),
    "no channels": (exr_file(channel=b""), "damaged"),
    "attribute of -1 bytes": (exr_file(length=-1), "damaged"),
    "attribute twice": (exr_file(more=text_attribute("a", b"1") * 2), "damaged"),
    "header without end": (exr_file()[:60] + b"x" * 5000, "cut short"),
    "100000 channels": (
        exr_file(channel=b"".join(b"c%d\0" % i + struct.pack("<iiii", 2, 0, 1, 1) for i in range(100_000))),
        "over 256 KiB",
    ),
    "chunks of -1 bytes": (exr_file(size=-1), "damaged"),
    "metadata that is no JSON": (exr_file(more=text_attribute("mitsim.run", b"{")), "damaged"),
    "metadata deeply nested": (exr_file(more=text_attribute("mitsim.run", b"[" * 100_000)), "nested too deep"),
    "metadata that is a list": (exr_file(more=text_attribute("mitsim.run", b"[1]")), "no text or number"),
    "metadata of no UTF-8": (exr_file(more=text_attribute("mitsim.run", b"\xff\xfe")), "damaged"),
}


def test_the_file_written_by_hand_is_good(tmp_path: Path) -> None:
    """Without its lie, each file below is a frame: what is refused is the lie."""
    (tmp_path / "a.exr").write_bytes(exr_file(more=text_attribute("mitsim.run", b'"x"')))
    channels, metadata = read_frame(tmp_path / "a.exr")
    assert np.array_equal(channels["DN"], np.tile(np.arange(8, dtype=np.float32), (8, 1))) and metadata == {"run": "x"}


@pytest.mark.parametrize("shift", [2**40, -300])
def test_a_damaged_table_of_offsets_is_mended_by_openexr(tmp_path: Path, shift: int) -> None:
    """It finds the chunks by itself, and gives the right pixels."""
    (tmp_path / "a.exr").write_bytes(exr_file(shift=shift))
    assert np.array_equal(read_frame(tmp_path / "a.exr")[0]["DN"], np.tile(np.arange(8, dtype=np.float32), (8, 1)))


@pytest.mark.usefixtures("bounded")
@pytest.mark.parametrize("name", FRAMES)
def test_a_hostile_frame(folders: tuple[Path, Path], capfd: pytest.CaptureFixture[str], name: str) -> None:
    """Refused with the file's name; OpenEXR says nothing beside."""
    content, words = FRAMES[name]
    path = folders[0] / "frame_01.exr"
    path.write_bytes(content)
    message = refusal(lambda: solved(*folders))
    assert str(path) in message and words in message
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIP", "PIZ", "PXR24", "B44", "DWAB"])
def test_compressed_frames_of_other_programs_are_read(tmp_path: Path, compression: str) -> None:
    """A constant picture of 1024 x 1024 shrinks most: the guard against bombs must let it pass."""
    pixels = {"DN": np.full((1024, 1024), 7, np.float32)}
    header = {"type": OpenEXR.scanlineimage, "compression": getattr(OpenEXR, f"{compression}_COMPRESSION")}
    OpenEXR.File(header, pixels).write(str(tmp_path / "a.exr"))
    assert np.allclose(read_frame(tmp_path / "a.exr")[0]["DN"], 7)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_frame_that_is_not_finite(folders: tuple[Path, Path], value: float) -> None:
    pixels = np.ones((PIXELS, PIXELS), np.float32)
    pixels[3, 4] = value
    write_frame(folders[0] / "frame_01.exr", {"DN": pixels}, {})
    assert "1 values are not finite" in refusal(lambda: solved(*folders))


@pytest.mark.parametrize("damage", [pipe, folder, linked("/dev/zero")], ids=["pipe", "folder", "device"])
def test_a_frame_that_is_no_file(folders: tuple[Path, Path], damage: Damage) -> None:
    damage(folders[0] / "frame_01.exr")
    assert "frame_01.exr" in refusal(lambda: solved(*folders))
    with pytest.raises(MitsimError):
        read_frame(folders[0] / "frame_01.exr")


def test_a_frame_of_other_channels_or_size(folders: tuple[Path, Path]) -> None:
    path = folders[0] / "frame_01.exr"
    write_frame(path, {"other\nname": np.ones((PIXELS, PIXELS), np.float32)}, {})
    assert "DN is needed" in refusal(lambda: solved(*folders))
    write_frame(path, {"DN": np.ones((PIXELS, PIXELS + 1), np.float32)}, {})
    assert "8x9" in refusal(lambda: solved(*folders))
