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
