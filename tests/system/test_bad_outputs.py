"""Outputs that cannot be written (issue 2, item 10): exit 2, one line that names the place, and nothing written."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.system.refusals import Refused, mentions

VERBS: dict[str, Callable[[Any], tuple[object, ...]]] = {
    "capture": lambda lab: ("capture", *lab.arguments, "--patterns", "dots:4"),
    "calibrate": lambda lab: ("calibrate", *lab.arguments),
    "demo": lambda lab: ("demo", lab.scene),
    "reconstruct": lambda lab: ("reconstruct", lab.run, "--calibration", lab.calibration),
    "render": lambda lab: ("render", lab.scene, "--spp", "4"),
    "study": lambda lab: ("study", "accuracy", lab.scene),
}
"""Arguments of each verb that writes, but the output."""


@pytest.fixture(params=VERBS)
def to(request: pytest.FixtureRequest, lab: Any) -> Callable[[str], tuple[object, ...]]:
    return lambda output: (*VERBS[request.param](lab), "-o", output)


def test_an_output_that_cannot_be(refused: Refused, tmp_path: Path, to: Callable[[str], tuple[object, ...]]) -> None:
    """Below a file, where nothing can be written, of the other kind, and of a name that no file can have."""
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder.exr").mkdir()
    mentions(refused(*to("file/new.exr")), "file/new")
    # Tests may run as root, whom permission bits do not stop; in /proc nobody can make files.
    mentions(refused(*to("/proc/new.exr")), "/proc/new")
    mentions(refused(*to("nowhere/new.exr")), "nowhere/new")
    mentions(refused(*to("folder.exr" if "render" in to("") else "file")), "is a f")
    line = refused(*to("n" * 300 + ".exr"))
    assert "nnn" in line and ("name too long" in line or "give a path" in line)


def test_a_frame_that_is_no_exr(refused: Refused, lab: Any) -> None:
    mentions(refused("render", lab.scene, "-o", lab.scene), str(lab.scene), ".exr")


def test_no_input_is_replaced(refused: Refused, lab: Any, tmp_path: Path) -> None:
    """By verbs that replace files, with --overwrite or without. (Planted: each check left out.)"""
    frame = lab.copy("run", tmp_path / "run") / "frame_00000.exr"
    picture = lab.scene.with_name(f"{lab.scene.stem}_projector.png")
    mentions(refused("view", lab.scene, "--camera", lab.camera, "-o", picture), str(picture), "is read")
    mentions(refused("sense", frame, "--camera", lab.camera, "--channel", "DN", "-o", frame), str(frame), "is read")
    link = tmp_path / "link.exr"
    link.symlink_to(frame)
    mentions(refused("sense", frame, "--camera", lab.camera, "--channel", "DN", "-o", link), str(link), "is read")
    for place in (lab.scene, lab.camera):
        mentions(refused("transport", *lab.arguments, "-o", place, "--overwrite"), str(place), "is read")
    manifest = tmp_path / "run" / "manifest.json"
    mentions(refused("export", manifest.parent, "--format", "hdf5", "-o", manifest, "--overwrite"), "is read")


@pytest.mark.parametrize("verb", ["capture", "calibrate", "demo", "reconstruct"])
def test_a_folder_that_holds_something(refused: Refused, lab: Any, tmp_path: Path, verb: str) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("keep me")
    mentions(refused(*VERBS[verb](lab), "-o", "mine"), "mine", "holds files")


def test_a_working_folder_that_is_no_more(tmp_path: Path) -> None:
    """As after a clean-up from another terminal. (Planted: not looked for: a fault of mitsim's own.)"""
    gone = tmp_path / "gone"
    gone.mkdir()
    command = f'cd {gone} && rmdir {gone} && "{sys.executable}" -m mitsim capture photograph --patterns uniform -o run'
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.startswith("mitsim: the working folder does not exist any more")
    assert done.stderr.count("\n") == 1 and not done.stdout
