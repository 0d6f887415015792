"""Folders of sessions and of images: what is left alone, made anew, refused and resumed, and where they can move."""

from __future__ import annotations

import copy
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mitsim as ms
from mitsim.core.exr import read_frame, write_frame
from mitsim.report.reconstruct_run import reconstruct_colours
from tests.coloured import folders

IMAGE: dict[str, Any] = {"run": "run", "calibration": "calibration"}


@pytest.fixture
def place(lab: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with copies of a run and of its calibration."""
    for name in ("run", "calibration"):
        lab.copy(name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def taken(tables: dict[str, Any], output: str = "out", **options: Any) -> list[bool]:
    """Run a session; for each step whether it was finished before."""
    done = ms.run(tables, output, pictures=False, **options)
    return [step.left_alone for step in done.steps]


def test_arguments_are_not_changed(place: Path) -> None:
    """Neither tables nor values, by `run`, `open_bench` and requests. (Planted: tables that are not copied.)"""
    tables: dict[str, Any] = {
        "reconstruct": [{**IMAGE}],
        "export": [{"format": "hdf5", "run": "run", "output": "a.h5"}],
    }
    values = {"reconstruct.0.lambda": 10.0, "reconstruct.0.bounds": [0.0, 1.0], "reconstruct.0.method": "nonnegative"}
    before = copy.deepcopy((tables, values))
    ms.run(tables, "one", values, pictures=False)
    assert (tables, values) == before
    ms.run(tables, "two", pictures=False)
    results = [json.loads((place / name / "image" / "result.json").read_text()) for name in ("one", "two")]
    assert [each["inputs"]["lambda"] for each in results] == [10.0, "auto"]


def test_an_export_is_made_anew_for_other_inputs_and_lost_files(place: Path) -> None:
    """By the contents of the run, whatever its name, and by its files. (Planted: a file that is there counts.)"""
    tables = {"export": [{"format": "hdf5", "run": "run", "output": "all.h5"}]}
    assert taken(tables) == [False] and taken(tables, resume=True) == [True]
    (place / "out" / "all.h5").unlink()
    assert taken(tables, resume=True) == [False] and (place / "out" / "all.h5").is_file()
    channels, metadata = read_frame(place / "run" / "frame_00000.exr")
    sums = json.loads((place / "run" / "manifest.json").read_text())
    sums["checksums"]["frame_00000.exr"] = write_frame(
        place / "run" / "frame_00000.exr", {**channels, "DN": channels["DN"] + np.uint32(1)}, metadata
    )
    (place / "run" / "manifest.json").write_text(json.dumps(sums))
    assert taken(tables, resume=True) == [False] and taken(tables, resume=True) == [True]


def test_a_refusal_leaves_an_earlier_image(place: Path) -> None:
    """An image that cannot be made anew stays. (Planted: removed before the work.)"""
    tables: dict[str, Any] = {"reconstruct": [{**IMAGE}]}
    ms.run(tables, "out", pictures=False)
    before = {path: path.read_bytes() for path in (place / "out" / "image").rglob("*") if path.is_file()}
    tables["reconstruct"][0]["focus"] = "map"  # refused as it works: these dots do not shift
    with pytest.raises(ms.MitsimError):
        ms.run(tables, "out", resume=True, pictures=False)
    assert before == {path: path.read_bytes() for path in (place / "out" / "image").rglob("*") if path.is_file()}


@pytest.mark.parametrize("how", ["cut", "flipped", "exchanged"])
def test_a_damaged_image_is_noticed(place: Path, call: Callable[..., Any], how: str) -> None:
    """By report, the file that repeats it, and a session that goes on. (Planted: no checksum in result.json.)"""
    tables = {"reconstruct": [{**IMAGE}, {**IMAGE, "lambda": 10.0, "output": "other"}]}
    ms.run(tables, "out", pictures=False)
    file, right = place / "out" / "image" / "image.exr", (place / "out" / "image" / "image.exr").read_bytes()
    damaged = {
        "cut": right[:-40],
        "flipped": right[:-9] + bytes([right[-9] ^ 1]) + right[-8:],
        "exchanged": (place / "out" / "other" / "image.exr").read_bytes(),
    }
    file.write_bytes(damaged[how])
    for verb in (("report", file.parent), ("run", "--from", file.parent)):
        told = call(*verb)
        assert told.code == 2 and "its checksum differs" in told.err and told.err.count("\n") == 1
    assert taken(tables, resume=True) == [False, True] and file.read_bytes() == right


KILLED = """
import os, sys
from mitsim import cli
name, rename = sys.argv[1], os.replace
def replace(source, target):
    rename(source, target)
    if str(target).endswith(name):
        os.kill(os.getpid(), 9)
os.replace = replace
sys.argv = ["mitsim", *sys.argv[2:], "-o", "out", "--quiet", "--no-pictures"]
cli.run()
"""


def kill(file: str, *arguments: str) -> None:
    """Run a command into the folder `out`, and kill it when a ``file`` has its name."""
    environment = {**os.environ, "PYTHONPATH": str(Path(ms.__file__).parents[1])}
    command = [sys.executable, "-c", KILLED, file, *arguments]
    killed = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert killed.returncode == -9, killed.stderr


@pytest.mark.parametrize("file", ["638nm/image.exr", "out/image.exr"])
def test_an_image_in_colour_that_was_killed_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str
) -> None:
    """By the same call, bit for bit; until then it has no page. A refusal leaves nothing. (Planted: colour.json
    written last.)"""
    run, calibration = folders(tmp_path)
    monkeypatch.chdir(tmp_path)
    kill(file, "reconstruct", str(run), "--calibration", str(calibration))
    with pytest.raises(ms.MitsimError, match="no result of a finished image"):
        ms.report_folder("out")
    for place in ("out", "whole"):
        reconstruct_colours(run, calibration, place, page=False)
    frames = [{path.relative_to(place): path.read_bytes() for path in Path(place).rglob("*.exr")}
              for place in ("out", "whole")]  # fmt: skip
    assert frames[0] == frames[1] and len(frames[0]) >= 4 and not [*Path("out").rglob(".*")]
    (run / "638nm" / "frame_00000.exr").write_bytes(b"")
    with pytest.raises(ms.MitsimError):
        reconstruct_colours(run, calibration, "new", page=False)
    assert not Path("new").exists()


@pytest.mark.parametrize("file", ["image/image.exr", "out/session.json"])
def test_a_session_killed_while_an_image_is_written_goes_on(place: Path, file: str) -> None:
    """An image without its result, and a session without its steps, are taken up again; 0.10.0 refused the first."""
    (place / "session.toml").write_text('[[reconstruct]]\nrun = "run"\ncalibration = "calibration"\n')
    kill(file, "run", "session.toml")
    assert taken({"reconstruct": [{**IMAGE}]}, resume=True) == [False]
    ms.run({"reconstruct": [{**IMAGE}]}, "whole", pictures=False)
    assert (place / "out/image/image.exr").read_bytes() == (place / "whole/image/image.exr").read_bytes()
    assert not [*(place / "out").rglob(".*")]


def test_an_image_that_was_begun_is_made_again(place: Path) -> None:
    """An image that was killed is made by the same call, but no image of other inputs, and it has no page.
    (Planted: no head before its files.)"""
    shots, factors = ms.load_run("run"), ms.load_calibration("calibration")
    image = ms.reconstruct(shots, factors)
    image.save("image")
    kill("image.exr", "reconstruct", "run", "--calibration", "calibration")
    with pytest.raises(ms.MitsimError, match="no result of a finished image"):
        ms.report_folder("out")
    with pytest.raises(ms.MitsimError, match="holds an image of other inputs"):
        ms.reconstruct(shots, factors, 10.0).save("out")
    image.save("out")
    assert json.loads((place / "out" / "result.json").read_text())["checksums"].keys() >= {"image.exr", "image.png"}
    assert (place / "out" / "image.exr").read_bytes() == (place / "image" / "image.exr").read_bytes()


@pytest.mark.parametrize("change", [{"seconds": "x"}, {"output": None}])
def test_a_session_json_of_other_kinds_is_refused_in_a_line(place: Path, change: dict[str, Any]) -> None:
    """Each wrong kind is refused in one line. (Planted: entries that are taken as they are.)"""
    tables = {"reconstruct": [{**IMAGE}]}
    ms.run(tables, "out", pictures=False)
    held = json.loads((place / "out" / "session.json").read_text())
    for damaged in ({**held, "steps": [{**held["steps"][0], **change}]}, {**held, "made": change}):
        (place / "out" / "session.json").write_text(json.dumps(damaged))
        with pytest.raises(ms.MitsimError) as refused:
            ms.run(tables, "out", resume=True)
        assert len(str(refused.value).splitlines()) == 1 and "session.json" in str(refused.value)


def test_nothing_is_left_where_a_later_step_is_refused(place: Path) -> None:
    """Requests are checked before the first step works. (Planted: pictures without their projector.)"""
    shutil.copytree(place / "run", place / "good")
    manifest = json.loads((shutil.copytree(place / "good", place / "imported") / "manifest.json").read_text())
    del manifest["configuration"]["projector_model"]
    (place / "imported" / "manifest.json").write_text(json.dumps(manifest))
    good = {**IMAGE, "run": "good"}
    for step, words in (
        ({"reconstruct": [good, {**good, "output": "b", "focus": 1e-3}]}, "focus"),
        ({"reconstruct": [good], "export": [{"format": "png", "run": "good", "output": "p", "projector": "no"}]}, "no"),
        ({"reconstruct": [good], "export": [{"format": "png", "run": "imported", "output": "p"}]}, "imported frames"),
        ({"reconstruct": [good], "study": [{"name": "no such"}]}, "no such"),
    ):
        with pytest.raises(ms.MitsimError) as refused:
            ms.run(step, "out", pictures=False)
        assert words in str(refused.value) and not (place / "out").exists(), step


def test_pictures_of_other_inputs_are_refused_before_any_step_works(place: Path) -> None:
    """A folder of exported pictures is not replaced. (Planted: refused only after the image is made anew.)"""
    tables = {
        "reconstruct": [{**IMAGE}],
        "export": [{"format": "png", "run": "run", "output": "shown", "projector": "mp_cl1"}],
    }
    ms.run(tables, "out", pictures=False)
    assert taken(tables, resume=True) == [True, True]
    (place / "out" / "shown" / "patterns.json").write_text("{}")
    (place / "out" / "image" / "image.png").unlink()
    summary = (place / "out" / "session.json").read_bytes()
    with pytest.raises(ms.MitsimError, match="the folder holds files already"):
        ms.run(tables, "out", resume=True)
    assert (place / "out" / "session.json").read_bytes() == summary and not (place / "out/image/image.png").exists()
