"""Hostile camera files (TOML): refused in one line, in bounded memory and time."""

from __future__ import annotations

from pathlib import Path

import pytest

from mitsim.core.configuration import read_toml
from mitsim.devices.sensor import load_sensor
from tests.hard.hostile.folders import Damage, folder, pipe, raw, refusal, sparse

pytestmark = pytest.mark.robustness("Input")

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
