"""Hostile RUN and CAL folders and camera files (TOML): refused in one line, in bounded memory and time.

Each case damages one file of a good folder.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mitsim.core.configuration import read_toml
from mitsim.devices.sensor import load_sensor
from tests.hard.hostile.folders import Damage, folder, linked, pipe, raw, refusal, solved, sparse

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


FILE = ("patterns", "captures", 1, "file")
P_L = ("patterns", "P_L")
BOTH = {
    "empty": (raw(""), "not valid JSON"),
    "cut short": (raw('{"kind": "capt'), "not valid JSON"),
    "no UTF-8": (raw(b'{"kind": "\xff\xfe"}'), "not valid JSON"),
    "UTF-16": (raw('{"kind": 1}'.encode("utf-16")), "not valid JSON"),
    "zero bytes": (raw(b"\0" * 4096), "not valid JSON"),
    "deep arrays": (raw("[" * 1_000_000), "nested too deep"),
    "deep objects": (raw('{"a":' * 500_000), "nested too deep"),
    "a number of a million digits": (raw("9" * 1_000_000), "not valid JSON"),
    "an array": (raw("[1, 2]"), "holds a list"),
    "a number": (raw("1e400"), "holds a float"),
    "null": (raw("null"), "holds a NoneType"),
    "huge": (sparse, "at most 33554432"),
    "a pipe": (pipe, "pipe or device"),
    "a folder": (folder, "Is a directory"),
    "a device": (linked("/dev/zero"), "pipe or device"),
    "a link to itself": (linked("manifest.json"), "cannot be read"),
    "key twice": (text('"status"', '"status": "complete", "status"'), "'status' is there twice"),
    "kind of 10 MB": (put("kind", value="k" * 10_000_000), "..."),
    "kind of several lines": (put("kind", value="a\nb\x1b[31m"), "holds a a b"),
    "status of several lines": (put("status", value="a\n" * 999), "..."),
    "camera is a list": (put("camera", value=[1]), "camera: got [1]"),
    "checksums of numbers": (put("checksums", value={"x": 3}), "checksums: that of 'x' is no text"),
    "200000 false checksums": (
        put("checksums", value=dict.fromkeys(map(str, range(200_000)), 1)),
        "checksums: that of",
    ),
    "wrong checksum": (put("checksums", value={"left.exr": "0", "frame_01.exr": "0"}), "its checksum differs"),
    "another camera of 10 MB": (put("camera", value={"name": "x" * 10_000_000}), "name is"),
    "another camera of several lines": (put("camera", value={"na\nme": "x"}), "calibrate the run's camera"),
}
RUN = {
    "file above": (put(*FILE, value="../cal/left.exr"), "captures.1.file"),
    "absolute file": (put(*FILE, value="/etc/passwd"), "captures.1.file"),
    "file in a folder": (put(*FILE, value="sub/a.exr"), "captures.1.file"),
    "file with a backslash": (put(*FILE, value="..\\a.exr"), "captures.1.file"),
    "file with a zero": (put(*FILE, value="a\0.exr"), "captures.1.file"),
    "file ..": (put(*FILE, value=".."), "leads out of its folder"),
    "file .": (put(*FILE, value="."), "Is a directory"),
    "file without name": (put(*FILE, value=""), "captures.1.file"),
    "file of 5000 letters": (put(*FILE, value="n" * 5000), "captures.1.file"),
    "file is the manifest": (put(*FILE, value="manifest.json"), "not an OpenEXR file"),
    "file is a number": (put(*FILE, value=7), "captures.1.file"),
    "missing file": (put(*FILE, value="none.exr"), "No such file"),
    "row beyond": (put("patterns", "captures", 1, "row", value=2), "pattern (2, 1)"),
    "negative row": (put("patterns", "captures", 1, "row", value=-1), "captures.1.row"),
    "row of 10^30": (
        put("patterns", "captures", 1, "row", value=10**30),
        "pattern (1000000000000000000000000000000, 1)",
    ),
    "row is true": (put("patterns", "captures", 1, "row", value="true"), "captures.1.row"),
    "sign 2": (put("patterns", "captures", 1, "sign", value=2), "captures.1.sign"),
    "pattern twice": (put("patterns", "captures", 1, "column", value=0), "frames of signs [0, 0]"),
    "no captures": (put("patterns", "captures", value=[]), "4 of 4 patterns"),
    "captures are a number": (put("patterns", "captures", value=10**9), "captures: got 1000000000"),
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
    "huge weight": (put(*P_L, 0, 0, value=1e300), "P_L.0.0: got 1e+300"),
    "weight beyond floats": (text('"P_L": [[1.0', '"P_L": [[1e400'), "P_L.0.0: got inf"),
    "weight not a number": (text('"P_L": [[1.0', '"P_L": [[NaN'), "P_L.0.0: got nan"),
    "weight of text": (put(*P_L, 0, 0, value="x"), "P_L.0.0: got 'x'"),
    "ragged weights": (put(*P_L, 0, value=[1]), "rows of 1, 2 numbers"),
    "no weights": (put(*P_L, value=[]), "rows of no numbers"),
    "deep weights": (put(*P_L, value=[[[[[1]]]]]), "P_L.0.0"),
    "too many scene pixels": (put(*P_L, value=[[1, 0], [0, 1]] * 4), "8 scene pixels"),
    "exposure 0": (put("digital", "exposure_s", value=0), "exposure_s: got 0"),
    "exposure 1e-300": (put("digital", "exposure_s", value=1e-300), "exposure_s: got 1e-300"),
    "exposure beyond floats": (text('"exposure_s": 0.02', '"exposure_s": 1e999'), "exposure_s: got inf"),
    "gain not a number": (text('"gain_dn_per_e": 0.1', '"gain_dn_per_e": NaN'), "gain_dn_per_e: got nan"),
    "negative black level": (put("digital", "black_level_dn", value=-1), "black_level_dn: got -1"),
    "digital is null": (put("digital", value=None), "digital: got None"),
}
CAL = {
    "board above 1": (put("board_reflectance", value=2), "board_reflectance: got 2"),
    "centre is text": (put("centre", value="yes"), "centre: got 'yes'"),
}


@pytest.mark.usefixtures("bounded")
@pytest.mark.parametrize("which", ["run", "cal"])
@pytest.mark.parametrize("name", BOTH)
def test_a_hostile_manifest(folders: tuple[Path, Path], name: str, which: str) -> None:
    damage, words = BOTH[name]
    damage(folders[which == "cal"] / "manifest.json")
    assert words in refusal(lambda: solved(*folders))


@pytest.mark.usefixtures("bounded")
@pytest.mark.parametrize("name", RUN)
def test_a_hostile_run(folders: tuple[Path, Path], name: str) -> None:
    damage, words = RUN[name]
    damage(folders[0] / "manifest.json")
    assert words in refusal(lambda: solved(*folders))


@pytest.mark.parametrize("name", CAL)
def test_a_hostile_calibration(folders: tuple[Path, Path], name: str) -> None:
    damage, words = CAL[name]
    damage(folders[1] / "manifest.json")
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
