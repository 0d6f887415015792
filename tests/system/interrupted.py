"""Captures and calibrations that are cut short, and what they must come to when they are resumed."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mitsim.core.exr import read_frame

PATTERNS = "hadamard:16"  # 512 frames: long enough to be hit in the middle


RESUME = "; finished work is kept; continue with --resume\n"


def started(command: Sequence[str], session: bool) -> subprocess.Popen[str]:
    """The program that a ``command`` is, with the signals of a terminal: a shell's background jobs ignore SIGINT, those
    of nohup SIGHUP, and so would what they start. ``session``: in a process group of its own."""
    before = {each: signal.signal(each, signal.SIG_DFL) for each in (signal.SIGINT, signal.SIGHUP)}
    try:
        return subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=session
        )
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


def running(least: int | str, *arguments: object, session: bool = False) -> subprocess.Popen[str]:
    """Start mitsim; back as soon as ``least`` frames, or the file of that name, are written; for 0 as soon as the
    output folder is there, or it is over. ``session``: in a process group of its own, which a terminal would have
    signalled."""
    folder = Path(str(arguments[arguments.index("-o") + 1]))
    command = [sys.executable, "-m", "mitsim", *map(str, arguments)]
    process = started(command, session)
    limit = time.monotonic() + 600
    wanted, count = (least, 1) if isinstance(least, str) else ("frame_*.exr", least)
    while (len(list(folder.glob(wanted))) < count or not folder.exists()) and process.poll() != 0:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < limit, "the program hangs"
        time.sleep(0.001)
    return process


def ended(process: subprocess.Popen[str]) -> subprocess.CompletedProcess[str]:
    """The process once it is over, with all that it said."""
    out, err = process.communicate(timeout=600)
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def cut_short(how: signal.Signals, least: int | str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Start mitsim, send it a signal as soon as ``least`` is written, as :func:`running` takes it."""
    process = running(least, *arguments)
    process.send_signal(how)
    return ended(process)


def assert_equal_runs(run: Path, whole: Path) -> None:
    """The same frames, whose pixels are compared where their bytes differ, and manifests that agree on all but time."""
    names = sorted(path.name for path in whole.glob("*.exr"))
    assert sorted(path.name for path in run.glob("*.exr")) == names
    for name in names:
        if (run / name).read_bytes() == (whole / name).read_bytes():
            continue
        ours, theirs = read_frame(run / name)[0], read_frame(whole / name)[0]
        assert ours.keys() == theirs.keys()
        assert all(np.array_equal(ours[channel], theirs[channel]) for channel in theirs), name
    ours, theirs = (json.loads((folder / "manifest.json").read_text()) for folder in (run, whole))
    for key in ("status", "camera", "digital", "patterns", "checksums", "configuration"):
        assert ours[key] == theirs[key], key
