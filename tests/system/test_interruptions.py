"""Work that is killed, halted, interrupted twice, or done by two at once: what is there is whole, or says that it is
not, and what is done again or gone on with is the same bit by bit."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.system.conftest import tree
from tests.system.interrupted import PATTERNS, assert_equal_runs, ended, running, started

pytestmark = pytest.mark.slow

LATE = 505
"""Frames of 512, which are written 16 at a time."""
TRIES = 6
"""Of each work, killed when so many files are there."""


def begun(*arguments: object) -> subprocess.Popen[str]:
    """The program, just started."""
    return started([sys.executable, "-m", "mitsim", *map(str, arguments)], session=True)


def done(*arguments: object) -> tuple[int, str]:
    """Status and stderr of the program, undisturbed."""
    finished = ended(begun(*arguments))
    return finished.returncode, finished.stderr


# ---- long work, which can be gone on with ----------------------------------------------------------------------------


def twice(process: subprocess.Popen[str]) -> None:
    """Control-C of an impatient user: to the whole group, as a terminal sends it."""
    for pause in (0.0, 0.05):
        time.sleep(pause)
        os.killpg(process.pid, signal.SIGINT)


def halted(process: subprocess.Popen[str]) -> None:
    """Control-Z and `fg`, and then an end."""
    os.killpg(process.pid, signal.SIGSTOP)
    time.sleep(0.3)
    os.killpg(process.pid, signal.SIGCONT)
    time.sleep(0.02)
    os.killpg(process.pid, signal.SIGTERM)


ENDS: dict[str, Callable[[subprocess.Popen[str]], None]] = {
    "killed": lambda process: os.killpg(process.pid, signal.SIGKILL),
    "parent killed": lambda process: process.kill(),
    "ended": lambda process: process.terminate(),
    "hung up": lambda process: os.killpg(process.pid, signal.SIGHUP),
    "interrupted twice": twice,
    "halted": halted,
}


@pytest.mark.parametrize("how", ENDS)
@pytest.mark.parametrize("frames", [0, 60, LATE])
def test_a_capture_goes_on_to_the_same_frames(lab: Any, whole: Path, tmp_path: Path, how: str, frames: int) -> None:
    command = ("capture", *lab.arguments, "-o", tmp_path / "run", "--patterns", PATTERNS, "--quiet")
    process = running(frames, *command, session=True)
    workers = psutil.Process(process.pid).children(recursive=True) if process.poll() is None else []
    with contextlib.suppress(ProcessLookupError):  # it may be over
        ENDS[how](process)
    finished = ended(process)
    assert not psutil.wait_procs(workers, timeout=120)[1], "the worker goes on without its parent"
    assert "Traceback" not in finished.stderr and finished.stderr.count("\n") <= 1, finished.stderr
    # The last frames take milliseconds: the signal may find the run over.
    assert finished.returncode not in (0, 1, 2) or (frames == LATE and finished.returncode == 0)
    code, reported = done(*command, "--resume")
    assert code == 0, reported
    assert_equal_runs(tmp_path / "run", whole)


# ---- short work, which is done again ---------------------------------------------------------------------------------


def works(lab: Any, sources: Path, out: Path) -> dict[str, Sequence[object]]:
    """Commands that write, by name; all to ``out``."""
    return {
        "reconstruct": ("reconstruct", lab.run, "--calibration", lab.calibration, "-o", out / "image", "--no-pictures"),
        "export hdf5": ("export", lab.run, "--format", "hdf5", "-o", out / "run.h5", "--calibration", lab.calibration),
        "export mat": ("export", lab.run, "--format", "mat", "-o", out / "run.mat", "--calibration", lab.calibration),
        "export png": ("export", lab.run, "--format", "png", "--projector", "mp_cl1", "-o", out / "png"),
        "import": ("import", sources / "run.h5", "-o", out / "run", "--calibration-output", out / "cal"),
        "patterns": ("patterns", "dots:16", "--projector-pixels", "16", "-o", out / "patterns"),
        "sense": ("sense", lab.run / "truth.exr", "--channel", "reflectance", "--camera", lab.camera,
                  "--exposure", "0.1", "-o", out / "frame.png", "--no-pictures"),
        "characterise": ("characterise", lab.camera, "-o", out / "camera", "--pixels", "32", "--frames", "4"),
    }  # fmt: skip


NAMES = ("reconstruct", "export hdf5", "export mat", "export png", "import", "patterns", "sense", "characterise")
LAST = {"image": "result.json", "png": "patterns.json", "run": "manifest.json", "cal": "manifest.json",
        "patterns": "patterns.json", "camera": "characterise.json"}  # fmt: skip
"""What is written last into a folder: with it the folder is whole."""
WRITTEN_AGAIN = "reconstruct", "characterise"
"""Works whose folder may hold an earlier one of the same kind, which they replace."""
TIMED = "result.json", "characterise.json"
"""Files that hold the seconds that the work took."""
DATED = 116
"""Bytes at the beginning of a MATLAB file that are a text, with the date."""


@pytest.fixture(scope="module")
def sources(lab: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An exported run with its calibration."""
    folder: Path = tmp_path_factory.mktemp("sources")
    command = ("export", lab.run, "--format", "hdf5", "-o", folder / "run.h5", "--calibration", lab.calibration)
    assert done(*command)[0] == 0
    return folder


def contents(folder: Path) -> dict[str, object]:
    """Files and folders below, by digest; of those that say when they were written, what else they hold."""
    found: dict[str, object] = {}
    for name, digest in tree(folder).items():
        path = Path(name)
        if path.suffix == ".mat":
            found[path.name] = path.read_bytes()[DATED:]
        elif path.name not in TIMED:
            found[str(path.relative_to(folder))] = digest
    return found


@pytest.mark.parametrize("name", NAMES)
def test_what_is_killed_leaves_nothing_half_written(lab: Any, sources: Path, tmp_path: Path, name: str) -> None:
    """And the same command, where the place is free again, gives the same bits."""
    (tmp_path / "whole").mkdir()
    code, reported = done(*works(lab, sources, tmp_path / "whole")[name])
    assert code in (0, 1), reported
    whole, killed = contents(tmp_path / "whole"), 0
    for number in range(TRIES):
        out = tmp_path / f"try{number}"
        out.mkdir()
        process = begun(*works(lab, sources, out)[name])
        # Locks and files not yet in their place count too: there are few moments at which something is half done.
        while len(list(out.rglob("*"))) <= number and process.poll() is None:
            pass
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        killed += ended(process).returncode == -signal.SIGKILL
        left = {path: digest for path, digest in contents(out).items() if not Path(path).name.startswith(".")}
        for path, digest in left.items():
            place = out / path
            if place.is_dir() and place != out and (place / LAST[place.name]).is_file():
                inside = {each for each in whole if each.startswith(f"{path}/")}
                assert inside <= left.keys(), f"{path} counts as whole and lacks {inside - left.keys()}"
            assert digest == whole[path], f"{path} is half written"
        for path in sorted(out.rglob("*"), reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()
        assert done(*works(lab, sources, out)[name])[0] == code
        assert contents(out) == whole
    assert killed, "all ended before they were killed"


@pytest.mark.parametrize("name", NAMES)
def test_of_two_at_once_one_writes(lab: Any, sources: Path, tmp_path: Path, name: str) -> None:
    """The other is refused in a line, whichever comes later, and the place holds one whole work."""
    for each in ("whole", "both"):
        (tmp_path / each).mkdir()
    code, _ = done(*works(lab, sources, tmp_path / "whole")[name])
    for number in range(3):
        out = tmp_path / f"both{number}"
        out.mkdir()
        both = [begun(*works(lab, sources, out)[name]) for _ in range(2)]
        finished = [ended(each) for each in both]
        statuses = sorted(each.returncode for each in finished)
        reported = [each.stderr for each in finished if each.returncode == 2]
        # These may write the same again, over what the first has left when it ended.
        assert statuses == [code, 2] or (name in WRITTEN_AGAIN and statuses == [code, code]), reported
        for line in reported:
            assert line.count("\n") == 1 and ("another mitsim is writing there" in line or "already" in line), line
        assert contents(out) == contents(tmp_path / "whole")
