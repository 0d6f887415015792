"""What may befall a run: signals, a full or read-only disk, a second run, damage, another version. Nothing is lost.

In each case the frames that were finished stay whole, the program says in one line what happened, and ``--resume``
ends in the same frames as a run that nothing disturbed.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.core.exr import read_frame
from mitsim.core.files import LOCK
from tests.system.interrupted import PATTERNS, RESUME, assert_equal_runs, cut_short, ended, running
from tests.system.refusals import Call, Refused

pytestmark = pytest.mark.robustness("Faults")


def finished(run: Path, whole: Path) -> dict[Path, int]:
    """Frames of a disturbed run with the time of their writing; each must be whole and right."""
    frames = sorted(run.glob("frame_*.exr"))
    for path in frames:
        if path.read_bytes() == (whole / path.name).read_bytes():
            continue
        ours, theirs = read_frame(path)[0], read_frame(whole / path.name)[0]
        assert all(np.array_equal(ours[name], theirs[name]) for name in ("DN", "electrons")), path.name
    return {path: path.stat().st_mtime_ns for path in frames}


def assert_resumed(call: Call, lab: Any, run: Path, whole: Path) -> None:
    """``--resume`` ends in the frames of ``whole``, and writes none of the finished ones again."""
    kept = finished(run, whole) if run.exists() else {}
    outcome = call("capture", *lab.arguments, "-o", run, "--patterns", PATTERNS, "--resume")
    assert outcome.code == 0, outcome.err
    assert_equal_runs(run, whole)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert not (run / LOCK).exists() and not list(run.glob(".*.part"))


# ---- disks -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 24 MiB; the 512 frames of a run take 17."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=24m", "tmpfs", disk], capture_output=True).returncode:
        pytest.skip("mounting a small disk needs root and its capabilities")
    try:
        yield disk
    finally:
        subprocess.run(["umount", disk], check=True)


@pytest.mark.slow
def test_a_disk_that_fills_up_during_a_run(call: Call, lab: Any, whole: Path, small_disk: Path) -> None:
    run = small_disk / "run"
    process = running(20, "capture", *lab.arguments, "-o", run, "--patterns", PATTERNS, "--json")
    with pytest.raises(OSError, match="No space left"), open(small_disk / "filler", "wb", buffering=0) as filler:
        while True:
            filler.write(bytes(1 << 20))
    done = ended(process)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("mitsim: file ") and "No space left on device" in done.stderr
    assert done.stderr.count("\n") == 1
    frames = finished(run, whole)
    assert 20 <= len(frames) < 512
    (small_disk / "filler").unlink()
    assert_resumed(call, lab, run, whole)


# ---- another configuration, version, variant -------------------------------------------------------------------------


def test_resume_with_another_version_is_refused(
    refused: Refused, lab: Any, interrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mitsim.core.environment import versions

    for package in ("mitsim", "mitsuba", "numpy"):
        monkeypatch.setattr("mitsim.core.environment.versions", lambda name=package: {**versions(), name: "99.0"})
        line = refused("capture", *lab.arguments, "-o", interrupted, "--patterns", PATTERNS, "--resume")
        assert "resume" in line and "another configuration (versions differ)" in line


def test_resume_with_another_texture_is_refused(refused: Refused, call: Call, lab: Any, tmp_path: Path) -> None:
    """The scene's XML is the same, the picture that it shows is not."""
    scene = Path(shutil.copytree(lab.scene.parent, tmp_path / "scenes")) / lab.scene.name
    options = *lab.electronics, "-o", tmp_path / "run", "--patterns", "dots:4"
    assert call("capture", scene, *options).code == 0
    picture = next(scene.parent.glob("laboratory_reflectance.png"))
    shutil.copy(next(scene.parent.glob("laboratory_projector.png")), picture)
    line = refused("capture", scene, *options, "--resume")
    assert "another configuration (scene_files differ)" in line


# ---- the machine -----------------------------------------------------------------------------------------------------


def test_a_home_that_takes_no_kernels(shell: Call, call: Call, lab: Any, tmp_path: Path) -> None:
    """Dr.Jit's kernel cache lies in the home folder; without it the program compiles anew, to the same frame."""
    environment = {**os.environ, "HOME": "/proc/nowhere", "XDG_CACHE_HOME": "/proc/nowhere"}
    options = "render", lab.scene, "--spp", 16, "--json", "-o"
    outcome = shell(*options, tmp_path / "anew.exr", env=environment)
    assert outcome.payload["mean"] == call(*options, tmp_path / "kept.exr").payload["mean"]
    ours, theirs = (read_frame(tmp_path / f"{name}.exr")[0] for name in ("anew", "kept"))
    assert all(np.array_equal(ours[name], theirs[name]) for name in theirs)


# ---- A capture or calibration that was cut short ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def killed(lab: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same run, its process killed while it wrote frames; not to be changed."""
    run: Path = tmp_path_factory.mktemp("killed") / "run"
    done = cut_short(signal.SIGKILL, 100, "capture", *lab.arguments, "-o", run, "--patterns", PATTERNS, "--quiet")
    assert done.returncode == -signal.SIGKILL and done.stdout == "" and done.stderr == ""
    return run


@pytest.fixture
def interrupted(killed: Path, tmp_path: Path) -> Path:
    """A copy of the killed run."""
    return Path(shutil.copytree(killed, tmp_path / "run"))


def test_a_killed_run_is_no_run(refused: Refused, lab: Any, interrupted: Path) -> None:
    line = refused("reconstruct", "run", "--calibration", lab.calibration)
    assert "run: the capture is incomplete" in line and "--resume" in line
    line = refused("capture", *lab.arguments, "-o", "run", "--patterns", PATTERNS)
    assert "run: the folder holds files already" in line
    assert "continue with --resume" in line and "empty" not in line, "emptying it would throw the frames away"


def test_resume_finishes_it(call: Call, lab: Any, interrupted: Path, whole: Path) -> None:
    """And sweeps up what was half written."""
    kept = {path: path.stat().st_mtime_ns for path in interrupted.glob("frame_*.exr")}
    (interrupted / ".frame_00400.exr.4711-140703.part").write_bytes(b"\x76\x2f\x31\x01")
    outcome = call("capture", *lab.arguments, "-o", interrupted, "--patterns", PATTERNS, "--resume", "--json")
    assert outcome.code == 0 and outcome.payload["frames"] == 512
    assert_equal_runs(interrupted, whole)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept, "frames that were there are not written again"
    assert [path.name for path in interrupted.glob(".*")] == []


def test_resume_replaces_a_frame_that_was_changed(call: Call, lab: Any, tmp_path: Path) -> None:
    """`reconstruct` refuses such a frame and says: capture it again with --resume."""
    run = lab.copy("run", tmp_path / "run")
    data = bytearray((run / "frame_00005.exr").read_bytes())
    data[-2000] ^= 1
    (run / "frame_00005.exr").write_bytes(data)
    assert "resume" in call("reconstruct", run, "--calibration", lab.calibration).refusal
    assert call("capture", *lab.arguments, "-o", run, "--patterns", "dots:4", "--resume").code == 0
    assert_equal_runs(run, lab.run)


@pytest.mark.parametrize("text", ['{"kind": "capt', "[]", "{}"])
def test_resume_refuses_a_corrupted_manifest(refused: Refused, lab: Any, tmp_path: Path, text: str) -> None:
    run = lab.copy("run", tmp_path / "run")
    (run / "manifest.json").write_text(text)
    assert "run/manifest.json" in refused("capture", *lab.arguments, "-o", "run", "--resume", "--patterns", "dots:4")


# ---- calibrations ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wide(lab: Any) -> tuple[object, ...]:
    """The laboratory's devices with a projector of 32 x 32 pixels, whose 128 shots take long enough to be hit."""
    return lab.write_scene("wide", n=32), *lab.electronics[:-1], "0.02"


@pytest.fixture(scope="module")
def factors(call: Call, wide: tuple[object, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The calibration of those devices which nothing disturbed."""
    calibration: Path = tmp_path_factory.mktemp("factors") / "cal"
    assert call("calibrate", *wide, "-o", calibration).code in (0, 1)
    return calibration


@pytest.mark.parametrize("how", [pytest.param(signal.SIGKILL, marks=pytest.mark.slow), signal.SIGINT])
def test_a_calibration_that_is_stopped_loses_no_finished_part(
    call: Call, lab: Any, wide: tuple[object, ...], factors: Path, tmp_path: Path, how: signal.Signals
) -> None:
    """Between stripes; `reconstruct` does not take it for a calibration."""
    calibration, part = tmp_path / "cal", "stripes.part.npz"
    done = cut_short(how, part, "calibrate", *wide, "-o", calibration)
    reported = {signal.SIGINT: "mitsim: interrupted" + RESUME}
    assert (done.returncode, done.stderr) == (-how if how == signal.SIGKILL else 128 + how, reported.get(how, ""))
    assert (calibration / part).is_file()
    assert "the calibration is incomplete" in call("reconstruct", lab.run, "--calibration", calibration).refusal
    assert "(seed differ)" in call("calibrate", *wide, "-o", calibration, "--resume", "--seed", "1").refusal
    outcome = call("calibrate", *wide, "-o", calibration, "--resume")
    assert outcome.code in (0, 1), outcome.err
    assert sorted(path.name for path in calibration.iterdir()) == ["left.exr", "manifest.json", "right.exr"]
    ours, theirs = (json.loads((folder / "manifest.json").read_text()) for folder in (calibration, factors))
    assert ours["checksums"] == theirs["checksums"] and ours["configuration"] == theirs["configuration"]
