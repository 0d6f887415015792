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
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from mitsim.core.exr import read_frame
from mitsim.core.files import LOCK
from tests.system.interrupted import PATTERNS, RESUME, assert_equal_runs, cut_short, ended, running

pytestmark = pytest.mark.robustness("Faults")

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
LAST = 505  # of 512 frames, which are written 16 at a time


def finished(run: Path, whole: Path) -> dict[Path, int]:
    """Frames of a disturbed run with the time of their writing; each must be whole and right."""
    frames = sorted(run.glob("frame_*.exr"))
    for path in frames:
        if path.read_bytes() == (whole / path.name).read_bytes():
            continue
        ours, theirs = read_frame(path)[0], read_frame(whole / path.name)[0]
        assert all(np.array_equal(ours[name], theirs[name]) for name in ("DN", "electrons")), path.name
    return {path: path.stat().st_mtime_ns for path in frames}


def assert_resumed(call: Callable[..., Any], lab: Any, run: Path, whole: Path) -> None:
    """``--resume`` ends in the frames of ``whole``, and writes none of the finished ones again."""
    kept = finished(run, whole) if run.exists() else {}
    outcome = call("capture", *lab.arguments, "-o", run, "--patterns", PATTERNS, "--resume")
    assert outcome.code == 0, outcome.err
    assert_equal_runs(run, whole)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert not (run / LOCK).exists() and not list(run.glob(".*.part"))


# ---- signals ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("least", [0, 64, LAST])
@pytest.mark.parametrize("how", STOPS, ids=lambda how: how.name)
def test_no_moment_is_a_bad_one(
    call: Callable[..., Any], lab: Any, tmp_path: Path, whole: Path, how: signal.Signals, least: int
) -> None:
    """Before the first frame (while light is traced), between frames, and close to the last; then resumed."""
    run = tmp_path / "run"
    done = cut_short(how, least, "capture", *lab.arguments, "-o", run, "--patterns", PATTERNS, "--json")
    # The last frames take milliseconds: the signal may find the result printed, but then all of it, or the run over.
    if least < LAST or done.returncode != 0:
        words = {signal.SIGINT: "mitsim: interrupted", signal.SIGTERM: "mitsim: ended by SIGTERM"}.get(how, "")
        # Between the folder and its manifest nothing is kept yet.
        allowed = [words and words + RESUME, *([words and f"{words}\n"] if least == 0 else [])]
        assert done.returncode == (-how if how == signal.SIGKILL else 128 + how) and done.stderr in allowed
    assert done.stdout == "" or (least == LAST and json.loads(done.stdout)["frames"] == 512)
    assert len(list(run.glob("frame_*.exr"))) >= least
    assert_resumed(call, lab, run, whole)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "words"),
    [(signal.SIGKILL, "out of memory, or killed from outside"), (signal.SIGABRT, "a crash in native code")],
)
def test_a_worker_that_dies_while_it_renders(
    lab: Any, tmp_path: Path, whole: Path, how: signal.Signals, words: str
) -> None:
    """The kernel's out-of-memory killer, and an abort inside LLVM: the parent is left to say so."""
    run = tmp_path / "run"
    least = 30 if how == signal.SIGKILL else 0
    process = running(least or "manifest.json", "capture", *lab.arguments, "-o", run, "--patterns", PATTERNS)
    (worker,) = psutil.Process(process.pid).children()
    worker.send_signal(how)
    done = ended(process)
    assert done.returncode == 128 + how and done.stdout == ""
    line = done.stderr.splitlines()[-1]
    assert line.startswith(f"mitsim: the worker process was ended by {how.name} ({words})") and "--resume" in line
    # That such a run is resumed is held above: a run that is killed leaves the same.
    assert len(finished(run, whole)) >= least


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
def test_a_disk_that_fills_up_during_a_run(call: Callable[..., Any], lab: Any, whole: Path, small_disk: Path) -> None:
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


# ---- the folder ------------------------------------------------------------------------------------------------------


@pytest.fixture
def interrupted(whole: Path, tmp_path: Path) -> Path:
    """The run as a kill after 40 frames leaves it: frames, and a manifest that says incomplete."""
    run = tmp_path / "run"
    run.mkdir()
    for path in sorted(whole.glob("frame_*.exr"))[:40]:
        shutil.copy2(path, run)
    manifest = json.loads((whole / "manifest.json").read_text())
    kept = {key: manifest[key] for key in ("kind", "configuration", "configuration_sha256")}
    (run / "manifest.json").write_text(json.dumps({**kept, "status": "incomplete"}))
    return run


def test_damaged_frames_of_an_interrupted_run_are_made_again(
    call: Callable[..., Any], lab: Any, interrupted: Path, whole: Path
) -> None:
    """No manifest holds checksums yet, so each frame carries that of its own pixels.

    Flipped bits, frames cut by a full disk, of another place and of another run, a text, and a missing one.
    """
    flipped = {7: -64 * 64 * 8 + 64, 8: -1, 9: 300}  # a bit in the first pixels, in the last one, in the header
    for index, spot in flipped.items():
        path = interrupted / f"frame_{index:05d}.exr"
        data = bytearray(path.read_bytes())
        data[spot] ^= 4
        path.write_bytes(data)
    os.truncate(interrupted / "frame_00010.exr", 20000)
    os.truncate(interrupted / "frame_00011.exr", 0)
    shutil.copy(interrupted / "frame_00020.exr", interrupted / "frame_00012.exr")
    shutil.copy(lab.run / "frame_00013.exr", interrupted)
    (interrupted / "frame_00014.exr").write_text("DN")
    (interrupted / "frame_00015.exr").unlink()
    kept = {path: path.stat().st_mtime_ns for path in interrupted.glob("frame_*.exr")}
    assert call("capture", *lab.arguments, "-o", interrupted, "--patterns", PATTERNS, "--resume").code == 0
    assert_equal_runs(interrupted, whole)
    written = {path.name for path, time in kept.items() if path.stat().st_mtime_ns != time}
    assert written == {f"frame_{index:05d}.exr" for index in range(7, 15)}, "and no others"


# ---- another configuration, version, variant -------------------------------------------------------------------------


def test_resume_with_another_version_is_refused(
    refused: Callable[..., str], lab: Any, interrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mitsim.core.environment import versions

    for package in ("mitsim", "mitsuba", "numpy"):
        monkeypatch.setattr("mitsim.core.environment.versions", lambda name=package: {**versions(), name: "99.0"})
        line = refused("capture", *lab.arguments, "-o", interrupted, "--patterns", PATTERNS, "--resume")
        assert "resume" in line and "another configuration (versions differ)" in line


@pytest.mark.slow
def test_resume_with_another_variant_is_refused(shell: Callable[..., Any], lab: Any, interrupted: Path) -> None:
    options = "--patterns", PATTERNS, "--resume", "--variant", "llvm_ad_rgb"
    assert "(variant differ)" in shell("capture", *lab.arguments, "-o", interrupted, *options).refusal


def test_resume_with_another_texture_is_refused(
    refused: Callable[..., str], call: Callable[..., Any], lab: Any, tmp_path: Path
) -> None:
    """The scene's XML is the same, the picture that it shows is not."""
    scene = Path(shutil.copytree(lab.scene.parent, tmp_path / "scenes")) / lab.scene.name
    options = *lab.electronics, "-o", tmp_path / "run", "--patterns", "dots:4"
    assert call("capture", scene, *options).code == 0
    picture = next(scene.parent.glob("laboratory_reflectance.png"))
    shutil.copy(next(scene.parent.glob("laboratory_projector.png")), picture)
    line = refused("capture", scene, *options, "--resume")
    assert "another configuration (scene_files differ)" in line


# ---- the machine -----------------------------------------------------------------------------------------------------


def test_a_home_that_takes_no_kernels(
    shell: Callable[..., Any], call: Callable[..., Any], lab: Any, tmp_path: Path
) -> None:
    """Dr.Jit's kernel cache lies in the home folder; without it the program compiles anew, to the same frame."""
    environment = {**os.environ, "HOME": "/proc/nowhere", "XDG_CACHE_HOME": "/proc/nowhere"}
    options = "render", lab.scene, "--spp", 16, "--json", "-o"
    outcome = shell(*options, tmp_path / "anew.exr", env=environment)
    assert outcome.payload["mean"] == call(*options, tmp_path / "kept.exr").payload["mean"]
    ours, theirs = (read_frame(tmp_path / f"{name}.exr")[0] for name in ("anew", "kept"))
    assert all(np.array_equal(ours[name], theirs[name]) for name in theirs)
