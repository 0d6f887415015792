"""What is planned or traced already: `capture --plan` and `capture --light` on the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import pytest

from mitsim.core.exr import read_frame
from tests.system.refusals import Refused, mentions


def frames_of(run: Path) -> dict[str, bytes]:
    return {path.name: read_frame(path)[0]["DN"].tobytes() for path in sorted(run.glob("frame_*.exr"))}


def numbers_of(light: Path) -> dict[str, bytes]:
    """All that a file of light holds but its plan, which states seconds."""
    found: dict[str, bytes] = {}
    with h5py.File(light) as file:
        file.visititems(
            lambda name, each: (
                found.update({name: each[()].tobytes()} if each.dtype.kind in "iuf" else {})
                if isinstance(each, h5py.Dataset)
                else None
            )
        )
    assert len(found) > 8
    return found


@pytest.fixture(scope="module")
def devices(lab: Any) -> tuple[object, ...]:
    return lab.arguments[:-2]  # without the accuracy


def test_a_plan_is_written_and_captured(
    call: Callable[..., Any], refused: Refused, lab: Any, devices: tuple[object, ...], tmp_path: Path
) -> None:
    """Frames are those of the capture that planned itself; what `plan --json` prints has a file's name more. (Planted:
    defaults of the options taken for asked for beside the plan.)"""
    file = tmp_path / "plan.json"
    options = "--patterns", "dots:4", "--json"
    plain, written = (call("plan", *lab.arguments, *options, *more).payload for more in ((), ("-o", file)))
    assert written.keys() - plain.keys() == {"output"} and written["output"] == str(file)
    mentions(refused("plan", *lab.arguments, "-o", file), str(file), "exists already")
    run = call("capture", *devices, "--plan", file, "-o", tmp_path / "run", "--json").payload
    assert run["accuracy"] == 0.005 and frames_of(tmp_path / "run") == frames_of(lab.run)
    configurations = [
        json.loads((folder / "manifest.json").read_text())["configuration"] for folder in (tmp_path / "run", lab.run)
    ]
    assert configurations[0] == configurations[1]
    again = call("capture", *lab.arguments, "--plan", file, "-o", tmp_path / "run", "--resume", "--json").payload
    assert again["frames"] == 16
    for options, fragments in (
        (("--patterns", "dots:2"), ("--patterns 'dots:2': the plan was made for 'dots:4'; plan anew",)),
        (("--accuracy", "1e-3"), ("--accuracy 0.001: the plan was made for 0.005",)),
        (("--effects=-diffraction",), ("--effects -diffraction: the plan was made for none",)),
        (("--colour", "auto"), ("--colour auto: the plan was made with another word",)),
        (("--light", "light.h5"), ("--plan", "leave out --plan or --light")),
    ):
        mentions(refused("capture", *devices, "--plan", file, *options, "-o", tmp_path / "new"), *fragments)
    traced = [
        call("transport", *(lab.arguments if "--patterns" in more else devices), *more, "-o", tmp_path / name)
        for name, more in (("one.h5", ("--patterns", "dots:4")), ("two.h5", ("--plan", file)))
    ]
    assert [each.code for each in traced] == [0, 0] and "frames of dots:4" in traced[1].out
    assert numbers_of(tmp_path / "one.h5") == numbers_of(tmp_path / "two.h5")
    for options, fragments in (
        (("--patterns", "dots:2"), ("--patterns 'dots:2': the plan was made for 'dots:4'; plan anew",)),
        (("--accuracy", "1e-3"), ("--accuracy 0.001: the plan was made for 0.005",)),
    ):
        mentions(refused("transport", *devices, "--plan", file, *options, "-o", tmp_path / "new.h5"), *fragments)
    other = lab.write_scene("laboratory_moved", sheet_z=390)
    line = refused("transport", other, *devices[1:], "--plan", file, "-o", tmp_path / "new.h5")
    mentions(line, "--plan was made of another scene: the content of its XML differs")
    line = refused("capture", other, *devices[1:], "--plan", file, "-o", tmp_path / "new")
    mentions(line, "--plan was made of another scene: the content of its XML differs")


def test_light_is_written_and_captured(
    call: Callable[..., Any], refused: Refused, lab: Any, devices: tuple[object, ...], tmp_path: Path
) -> None:
    """(Planted: a sparser family is exposed; the light's own family traced again.)"""
    file = tmp_path / "light.h5"
    assert call("transport", *lab.arguments, "--patterns", "dots:4", "-o", file).code == 0
    done = call("capture", *devices, "--light", file, "--patterns", "dots:2", "-o", tmp_path / "run", "--json").payload
    assert done["frames"] == 4 and done["accuracy"] == 0.005 and done["seconds"]["plan"] < 0.1
    lines = call("capture", *devices, "--light", file, "--patterns", "uniform", "-o", tmp_path / "one").out
    assert lines.startswith("1 frames of 64x64")
    for options, fragments in (
        (("--patterns", "dots:8"), ("--patterns 'dots:8': its shots light", "trace light for dots:8")),
        (("--patterns", "dots:2", "--accuracy", "1e-3"), ("--accuracy 0.001",)),
        (("--patterns", "dots:2", "--noise-fraction", "0.1"), ("--noise-fraction 0.1: light is traced already",)),
    ):
        mentions(refused("capture", *devices, "--light", file, *options, "-o", tmp_path / "new"), *fragments)
    lit = refused("capture", lab.scene, "--light", file, "--patterns", "dots:2", "-o", tmp_path / "new")
    mentions(lit, "--light was made of another projector: ")
