"""What is planned already: `--plan` on the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from mitsim.core.exr import read_frame
from tests.system.refusals import Call, Refused, mentions


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
    call: Call, refused: Refused, lab: Any, devices: tuple[object, ...], tmp_path: Path
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
    mentions(line, "--plan was made for another scene: the content of its XML differs")
    line = refused("capture", other, *devices[1:], "--plan", file, "-o", tmp_path / "new")
    mentions(line, "--plan was made for another scene: the content of its XML differs")


def test_what_is_read_is_not_replaced_and_another_mask_of_its_name_is_seen(
    call: Call, refused: Refused, lab: Any, devices: tuple[object, ...], tmp_path: Path
) -> None:
    """Neither the plan by light that is traced by it, nor files of camera, its drawn mask and projector, with
    --overwrite. (Planted: each left out; once, `transport --plan p.json -o p.json --overwrite` took the plan away.)"""
    np.save(tmp_path / "bars.npy", np.outer([1.0, 0, 1, 1], [0, 1.0, 1, 0]))
    drawn, projector, file = tmp_path / "drawn.toml", tmp_path / "projector.toml", tmp_path / "plan.json"
    drawn.write_text(lab.camera.read_text() + '\n[mask]\nkind = "drawing"\nfeature_mm = 0.06\nfile = "bars.npy"\n')
    projector.write_text(lab.projector.read_text())
    own = lab.scene, "--camera", drawn, "--projector", projector
    assert call("plan", *own, "--patterns", "dots:2", "--accuracy", 0.1, "-o", file).code in (0, 1)
    for path in (drawn, projector, tmp_path / "bars.npy"):
        mentions(refused("plan", *own, "-o", path, "--overwrite"), f"output {path}: would replace", "which is read")
    for path in (file, drawn):
        line = refused("transport", *own, "--plan", file, "-o", path, "--overwrite")
        mentions(line, f"output {path}: would replace", "which is read")
    np.save(tmp_path / "bars.npy", np.outer([1.0, 0, 1, 1], [0, 1.0, 1, 1]))  # of the same name
    line = refused("capture", *own, "--plan", file, "-o", tmp_path / "run")
    mentions(line, "--plan was made for another camera: the content of mask differs")


def test_what_python_warns_of_is_a_line_of_the_command_line(
    call: Call, lab: Any, devices: tuple[object, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A note on stderr when all is done, without file and line of a program, and not among the JSON. (Planted: Python's
    own words, as until 0.6.0 `mitsim demo --patterns dots:2` had them.)"""
    monkeypatch.setattr("mitsim.acquire.capture._foreign", lambda *_: "these frames are\nnoisier")
    known = "capture", *lab.arguments, "--patterns", "dots:2", "--json", "-o"
    done = call(*known, tmp_path / "run")
    assert done.code == 0 and done.payload["frames"] == 4 and done.err == "mitsim: note: these frames are noisier\n"
    assert len(call(*known, tmp_path / "run").refusal.splitlines()) == 1
