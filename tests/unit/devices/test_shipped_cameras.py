"""Each shipped camera serves for what its file says, and capture names what the others lack."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mitsim.api.bench import open_bench
from mitsim.core.configuration import shipped_path
from mitsim.core.errors import MitsimError
from mitsim.devices.sensor import load_sensor

SERVES = re.compile(r"^# Serves: ([a-z, ]+)\. ", flags=re.M)
SENSORS = sorted(
    path
    for path in Path(shipped_path("calibration")).glob("*.toml")
    if "full_well_e" in path.read_text(encoding="utf-8")
)


def serves(camera: Path) -> list[str]:
    found = SERVES.findall(camera.read_text(encoding="utf-8").split("\nname = ")[0])
    assert len(found) == 1, f"{camera} says in its head what it serves for"
    return str(found[0]).split(", ")


@pytest.mark.parametrize("camera", SENSORS, ids=lambda path: path.stem)
def test_a_camera_captures_as_its_file_says_or_is_told_what_it_lacks(camera: Path) -> None:
    """(Seen failing: files that said nothing, and a refusal that named one of the two things that were missing.)"""
    sensor, verbs = load_sensor(camera), serves(camera)
    pitch = f"{sensor.superpixel_pitch_um * 1e-3:g}"
    assert "characterise" in verbs and {*verbs} <= {"capture", "sense", "characterise"}
    assert ("sense" in verbs) == (sensor.states_efficiency and sensor.mosaic is None)
    if "capture" in verbs and sensor.mosaic is None:
        assert open_bench("photograph", camera=camera).devices.sensor == sensor
        return
    with pytest.raises(MitsimError) as caught:
        open_bench("photograph", camera=camera)
    lacking = "--colour mosaic" if sensor.mosaic else "put one, with its source, into a copy of the file"
    assert lacking in (line := str(caught.value)) and line.endswith(f"scenes whose pixel_pitch is {pitch} mm")
    own = f"`pixel_pitch` is {pitch}" if sensor.mosaic else "`quantum_efficiency`"
    assert "capture" in verbs or own in camera.read_text(encoding="utf-8")


def test_the_page_of_formats_lists_every_camera() -> None:
    page = (Path(__file__).parents[3] / "docs" / "formats.md").read_text(encoding="utf-8")
    rows = [
        line.split("|")[1:4]
        for line in page.splitlines()
        if re.match(r"\| `(imx|mt9|ov)\w*\d", line) and line.count("|") == 5
    ]
    listed = {name: verbs for names, _, verbs in rows for name in re.findall(r"`(\w+)`", names)}
    assert listed.keys() == {camera.stem for camera in SENSORS}
    for camera in SENSORS:
        assert re.findall(r"`([a-z]+)[ `]", listed[camera.stem]) == serves(camera)


@pytest.mark.slow
@pytest.mark.parametrize("camera", SENSORS, ids=lambda path: path.stem)
def test_every_verb_of_a_camera(camera: Path, small_scene: Callable[..., Path], tmp_path: Path) -> None:
    from tests.system.conftest import shell

    def code(*arguments: Any) -> int:
        return shell(*arguments, cwd=tmp_path).code

    verbs, scene = serves(camera), small_scene()
    colour = ("--colour", "mosaic") if load_sensor(camera).mosaic else ()
    captured = code(
        "capture", scene, "--camera", camera, *colour, "--patterns", "dots:2", "--accuracy", "0.1", "-o", "run"
    )
    assert (captured in (0, 1)) == ("capture" in verbs)
    quick = "--pixels", 32, "--steps", 20, "--frames", 4
    assert code("characterise", camera, "-o", "figures", *quick) in (0, 1)
    assert code("render", scene, "-o", "frame.exr", "--spp", 4) == 0
    assert (code("sense", "frame.exr", "--camera", camera, "-o", "frame.png") in (0, 1)) == ("sense" in verbs)
