"""Options and files of devices that cannot be used (issue 2, item 10): exit 2, one line, and nothing written."""

from __future__ import annotations

import errno
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from tests.system.refusals import NEW, Refused, mentions


@pytest.mark.parametrize(
    ("options", "fragments"),
    [
        (["--patterns", "dots:17"], ["dots:17", "17", "16"]),
        (["--patterns", "dots:0"], ["dots:0", "give 1 to the projector's pixels a side"]),
        (["--patterns", "dots:x"], ["'x'", "whole number"]),
        (["--patterns", ""], ["''"]),
        (["--patterns", "hadamard:7"], ["order 7", "use 4 or 8"]),
        (["--patterns", "nowhere.npy"], ["nowhere.npy: cannot be read", "check the path"]),
        (["--patterns", "own.txt"], ["'own.txt'", "a file (.npy, .png"]),
        (["--exposure", "-1"], ["exposure -1", "to 1e+06"]),
        (["--exposure", "long"], ["'long'", "auto"]),
        (["--exposure-fraction", "1.5"], ["1.5", "to 1"]),
        (["--accuracy", "nan"], ["--accuracy nan"]),
        (["--accuracy", "fine"], ["'fine'"]),
        (["--seed", "-1"], ["-1", "seed"]),
        (["--seed", "1.5"], ["'1.5'"]),
        (["--variant", "llvm_ad_grey"], ["llvm_ad_grey", "llvm_ad_mono"]),
        (["--resumee"], ["--resumee"]),
        (["--max-seconds", "1e-4"], ["dots:4: would take about", "allowed are 0.0001 s", "--max-seconds"]),
        (["--max-memory", "0.1"], ["dots:4: would take about", "of memory", "102 MiB"]),
        (["--max-memory", "0"], ["--max-memory 0", "above 0"]),
    ],
    ids=lambda value: " ".join(value) if value and value[0].startswith("--") else None,
)
def test_capture_refuses(refused: Refused, lab: Any, options: list[str], fragments: list[str]) -> None:
    patterns = () if "--patterns" in options else ("--patterns", "dots:4")
    mentions(refused("capture", *lab.arguments, *NEW, *patterns, *options), *fragments)


@pytest.mark.parametrize(
    ("options", "fragments"),
    [
        (["--max-seconds", "0.001"], ["calibration: would take about", "allowed are 0.001 s"]),
        (["--max-memory", "0.1"], ["calibration: would take about", "of memory"]),
    ],
    ids=lambda value: " ".join(value) if value[0].startswith("--") else None,
)
def test_calibrate_refuses(refused: Refused, lab: Any, options: list[str], fragments: list[str]) -> None:
    mentions(refused("calibrate", *lab.arguments, *NEW, *options), *fragments)


@pytest.mark.parametrize(
    ("options", "fragments"),
    [
        (["--count", "0"], ["--count 0", "give a number from 1 to 1000000"]),
        (["--vary", "nowhere.toml"], ["nowhere.toml"]),
        (["--max-seconds", "0.001"], ["pairs: was not planned within the 0.001 s", "--max-seconds"]),
        (["--count", "1000000", "--max-seconds", "600"], ["1000000 pairs: would take about", "allowed are 600 s"]),
        (["--max-memory", "0.01"], ["5 pairs: would take about", "of memory"]),
    ],
    ids=lambda value: " ".join(value) if value[0].startswith("--") else None,
)
def test_pairs_refuses(refused: Refused, lab: Any, options: list[str], fragments: list[str]) -> None:
    count = () if "--count" in options else ("--count", "5")
    mentions(refused("pairs", *lab.arguments, *NEW, *count, *options), *fragments)


@pytest.mark.parametrize(
    ("options", "fragments"),
    [
        (["--spp", "0"], ["--spp 0", "at least 4"]),
        (["--spp", "100000", "--max-seconds", "0.1"], ["100000 samples a pixel: would take about", "are 0.1 s"]),
        (["--estimator", "factored", "--max-memory", "0.1"], ["would take about", "of memory"]),
    ],
    ids=" ".join,
)
def test_render_refuses(refused: Refused, lab: Any, options: list[str], fragments: list[str]) -> None:
    mentions(refused("render", lab.scene, "-o", "new.exr", *options), *fragments)


@pytest.mark.parametrize(
    ("options", "fragments"),
    [
        (["--lambda", "-1"], ["--lambda -1", "at least 0"]),
        (["--lambda", "small"], ["'small'", "auto"]),
        (["--method", "wiener"], ["'wiener'", "tikhonov, markov, nonnegative, tv or the file of a trained network"]),
        (["--method", "none.pt"], ["model none.pt: cannot be read"]),
    ],
    ids=" ".join,
)
def test_reconstruct_refuses(refused: Refused, lab: Any, options: list[str], fragments: list[str]) -> None:
    mentions(refused("reconstruct", lab.run, "--calibration", lab.calibration, *options), *fragments)


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (["study", "twin", "photograph", *NEW], ["study twin photograph", "leave the scene out"]),
        (["study", "twin", "--data", "nowhere", *NEW], ["--data nowhere", "no such folder"]),
        (["plan", "photograph", "--camera", "none.toml"], ["none.toml", "No such file"]),
        (["plan", "photograph", "--projector", "none.toml"], ["none.toml", "No such file"]),
        (["doctor", "--variant", "llvm_ad_grey"], ["llvm_ad_grey", "llvm_ad_mono"]),
        (["capture", "photograph"], ["--output"]),
        (["capture", "photograph", *NEW], ["--patterns", "a plan with --plan"]),
        (["reconstruct"], ["RUN"]),
        (["plan"], ["SCENE"]),
    ],
    ids=lambda value: " ".join(value[:4]),
)
def test_others_refuse(refused: Refused, arguments: list[str], fragments: list[str]) -> None:
    mentions(refused(*arguments), *fragments)


# ---- camera, projector and recipe files ------------------------------------------------------------------------------


def test_binary_files_where_text_is_expected(refused: Refused, lab: Any, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_bytes(b"\x80\xff\x00name")
    mentions(refused("plan", lab.scene, "--camera", "mine.toml"), "mine.toml")
    (tmp_path / "scene.xml").write_bytes(b"\x80\xff\x00<scene/>")
    mentions(refused("plan", "scene.xml"), "scene.xml")


# ---- what no check foresees ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "fragment"),
    [
        (MemoryError(), "out of memory"),
        (OSError(errno.ENOSPC, "No space left on device"), "output: No space left on device"),
        (OSError(errno.ENAMETOOLONG, "File name too long", "a" * 9), "aaaaaaaaa: File name too long"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Exception) else None,
)
def test_faults_of_the_machine_are_one_line(
    refused: Refused, monkeypatch: pytest.MonkeyPatch, error: Exception, fragment: str
) -> None:
    monkeypatch.setattr("mitsim.core.environment.run_child", Mock(side_effect=error))
    mentions(refused("doctor"), fragment)


def test_a_fault_of_ours_is_not_dressed_up(refused: Refused, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "mitsim.core.environment.run_child", Mock(side_effect=OSError(errno.EINVAL, "Invalid argument"))
    )
    mentions(refused("doctor"), "a fault of mitsim's own, OSError: [Errno 22] Invalid argument")


# ---- Scenes that cannot be used --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "verb",
    [
        ("plan",),
        ("calibrate", *NEW),
        ("render", "-o", "new.exr"),
        ("study", "accuracy", *NEW),
        ("demo", *NEW),
    ],
    ids=lambda verb: verb[0],
)
def test_every_verb_refuses_a_scene_it_cannot_load(refused: Refused, tmp_path: Path, verb: tuple[str, ...]) -> None:
    mentions(refused(*verb, "nowhere.xml"), "nowhere.xml", "no such scene file")
    mentions(refused(*verb, "nowhere"), "nowhere", "shipped", "photograph", "resolution_target")
    (tmp_path / "broken.xml").write_text('<scene version="3.0.0">\n<bsdf>\n</scene>')
    mentions(refused(*verb, "broken.xml"), "broken.xml:3", "not well-formed")


def test_a_folder_without_scene(refused: Refused, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    mentions(refused("plan", "empty"), "empty/scene.xml")


@pytest.mark.parametrize(
    ("define", "fragments"),
    [
        ("albdo=0.5", ["albdo", "albedo"]),
        ("albedo", ["'albedo'", "NAME=VALUE"]),
        ("=3", ["'=3'", "NAME=VALUE"]),
        ("albedo=half", ["half"]),
    ],
)
def test_a_bad_define(refused: Refused, small_scene: Callable[..., Path], define: str, fragments: list[str]) -> None:
    path = small_scene()
    for verb in (("plan",), ("capture", *NEW, "--patterns", "dots:4"), ("render", "-o", "new.exr")):
        mentions(refused(*verb, path, "-D", define), *fragments)


# ---- Outputs that cannot be written ----------------------------------------------------------------------------------


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
