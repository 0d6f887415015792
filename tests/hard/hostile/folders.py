"""A good RUN and CAL folder, and what damages one file of them; the work that reads them, and its refusal.

The folders are of a camera of 8 x 8 pixels with 2 x 2 patterns, made here.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.core.exr import write_frame
from mitsim.core.runs import load_run
from mitsim.reconstruct.factors import load_calibration
from mitsim.reconstruct.reconstruct import reconstruct

LONGEST = 5.0
"""Seconds of processor time, so that a busy machine makes no verdict; the slowest takes 1 s here."""
PIXELS, SIDE = 8, 4
Damage = Callable[[Path], object]


def make(folder: Path) -> tuple[Path, Path]:
    """A good run and a good calibration."""
    run, calibration = folder / "run", folder / "cal"
    run.mkdir()
    calibration.mkdir()
    rng = np.random.default_rng(4)
    captures = []
    for row in range(2):
        for column in range(2):
            name = f"frame_{row}{column}.exr"
            write_frame(run / name, {"DN": rng.integers(100, 4000, (PIXELS, PIXELS), dtype=np.uint32)}, {"index": row})
            captures.append({"file": name, "row": row, "column": column, "sign": 0})
    patterns = np.eye(2)[np.arange(SIDE) % 2].tolist()
    manifest = {
        "kind": "capture",
        "status": "complete",
        "camera": {"name": "bench"},
        "digital": {"exposure_s": 0.02, "black_level_dn": 40, "gain_dn_per_e": 0.1, "dark_current_e_per_s": 1},
        "patterns": {"P_L": patterns, "P_R": patterns, "captures": captures},
    }
    (run / "manifest.json").write_text(json.dumps(manifest))
    for name in ("left", "right"):
        write_frame(calibration / f"{name}.exr", {"factor": rng.random((PIXELS, SIDE), dtype=np.float32)}, {})
    (calibration / "manifest.json").write_text(
        json.dumps({"kind": "calibration", "status": "complete", "camera": {"name": "bench"}})
    )
    return run, calibration


def solved(run: Path, calibration: Path) -> None:
    """All that `mitsim reconstruct` reads."""
    reconstruct(load_run(run), load_calibration(calibration), 1.0)


def refusal(work: Callable[[], object]) -> str:
    started = time.process_time()
    with pytest.raises(MitsimError) as caught:
        work()
    assert time.process_time() - started < LONGEST
    message = str(caught.value)
    assert all(line.isprintable() for line in message.splitlines()) and len(message) <= 1500
    return message


def raw(content: str | bytes) -> Damage:
    return lambda path: path.write_bytes(content.encode() if isinstance(content, str) else content)


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def sparse(path: Path) -> None:
    os.truncate(path, 1 << 40)


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def linked(to: str) -> Damage:
    def change(path: Path) -> None:
        path.unlink()
        path.symlink_to(to)

    return change
