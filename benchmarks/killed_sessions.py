"""Sessions that are killed at each file which `mitsim run` writes: whether `--resume` ends as if nothing had happened.

    python benchmarks/killed_sessions.py --json FILE [--kills 40] [--steps all|folders]

A small scene is planned, captured, calibrated and reconstructed twice, and its frames are exported as a file and as a
folder; with ``--steps folders`` the run and the calibration are given. The process is killed (SIGKILL) just before or
just after one of its files takes its name, at ``--kills`` places spread over all of them. Then the session is resumed.
FILE has a row for each kill. Ends with 1, and names it, where a resumed session does not end with 0, leaves a hidden
file behind, or has numbers (OpenEXR channels, exported files) other than those of the session that nobody killed.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import h5py
import numpy as np

import mitsim.cli
from mitsim.core.exr import read_frame
from tests.conftest import write_small_scene
from tests.system.conftest import CAMERA, PROJECTOR, photograph

IMAGES = """
[[reconstruct]]
{given}
[[reconstruct]]
{given}method = "tv"
lambda = 2e8
output = "smooth"

[[export]]
{run}format = "hdf5"
output = "all.h5"

[[export]]
{run}format = "png"
projector = "mp_cl1"
output = "pngs"
"""
ALL = """
[scene]
scene = "{scene}"
camera = "camera.toml"
projector = "projector.toml"

[plan]
patterns = "dots:4"
accuracy = 0.02

[capture]
patterns = "dots:4"

[calibrate]
accuracy = 0.02
"""


def ran(arguments: Sequence[str], at: int | None = None, after: bool = False) -> tuple[int, int, str]:
    """Run mitsim in a process of its own; its status, how many files took their names, and what it said.

    Parameters
    ----------
    arguments
        of the command line.
    at
        number of the file at which the process is killed; None: it is not.
    after
        whether it is killed after the file took its name, and not before.
    """
    with tempfile.TemporaryDirectory() as name:
        said, counted = Path(name, "said"), Path(name, "count")
        child = os.fork()
        if not child:
            os.setpgid(0, 0)
            _serve(arguments, said, counted, at, after)
        _, ended = os.waitpid(child, 0)
        number = int(counted.read_text() or 0) if counted.is_file() else 0
        return os.waitstatus_to_exitcode(ended), number, said.read_text(errors="replace") if said.is_file() else ""


def _serve(arguments: Sequence[str], said: Path, counted: Path, at: int | None, after: bool) -> None:
    """Run mitsim in this process, and end it."""
    count, rename = 0, os.replace
    counted.touch()

    def replace(source: Any, target: Any) -> None:
        """Rename as ``os.replace``, and die at file number ``at``."""
        nonlocal count
        if count == at and not after:
            os.kill(os.getpid(), signal.SIGKILL)
        rename(source, target)
        if count == at:
            os.kill(os.getpid(), signal.SIGKILL)
        count += 1
        with counted.open("w") as file:
            file.write(str(count))

    os.replace = replace  # type: ignore[assignment]
    for number in (1, 2):
        os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT | os.O_APPEND), number)
    sys.argv, status = ["mitsim", *arguments], 70
    try:
        mitsim.cli.run()
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else int(error.code is not None)
    sys.stdout.flush()
    os._exit(status)


def numbers(folder: Path) -> dict[str, Any]:
    """All numbers in a ``folder``: channels of OpenEXR, data sets of HDF5, bytes of pictures but those of pages."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.suffix == ".exr":
            found |= {f"{name}:{channel}": values for channel, values in read_frame(path)[0].items()}
        elif path.suffix == ".h5":
            with h5py.File(path) as file:
                keys: list[str] = []
                file.visit(keys.append)
                found |= {f"h5:{key}": _of(file[key]) for key in keys}
        elif path.suffix == ".png" and "pictures" not in path.parts:
            found[name] = path.read_bytes()
    return {name: value for name, value in found.items() if value is not None}


def _of(item: Any) -> Any:
    """The numbers of a data set; None of anything else, and of manifests, which hold seconds."""
    held = isinstance(item, h5py.Dataset) and item.dtype.kind in "iuf" and not item.name.endswith("manifest")
    return np.array(item) if held else None


def differs(found: dict[str, Any], right: dict[str, Any]) -> list[str]:
    """Names of numbers that are not the ``right`` ones."""
    return [
        name
        for name in sorted({*found, *right})
        if name not in found or name not in right or not np.array_equal(found[name], right[name])
    ]


def main() -> int:
    """Kill, resume and compare; 1 where one differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--kills", type=int, default=40)
    parser.add_argument("--steps", choices=("all", "folders"), default="all")
    asked = parser.parse_args()
    rows, broken = [], 0
    with tempfile.TemporaryDirectory(prefix="mitsim-killed-") as name:
        folder = Path(name)
        os.chdir(folder)
        scene = write_small_scene(folder / "scenes", reflectance=photograph())
        Path("camera.toml").write_text(CAMERA)
        Path("projector.toml").write_text(PROJECTOR)
        text = ALL.format(scene=scene) + IMAGES.format(given="", run="")
        Path("all.toml").write_text(text)
        status, count, said = ran(["run", "all.toml", "-o", "whole", "--quiet"])
        assert status in (0, 1), said
        if asked.steps == "folders":
            given = 'run = "whole/run"\n'
            Path("all.toml").write_text(IMAGES.format(given=given + 'calibration = "whole/calibration"\n', run=given))
            status, count, said = ran(["run", "all.toml", "-o", "made", "--quiet"])
            assert status in (0, 1), said
        right = numbers(Path("whole" if asked.steps == "all" else "made"))
        assert len(right) > 5
        for kill in range(asked.kills):
            at, after = kill * count // asked.kills, bool(kill % 2)
            out, started = Path(f"out{kill}"), time.monotonic()
            killed, *_ = ran(["run", "all.toml", "-o", str(out), "--quiet"], at, after)
            had = len([path for path in out.rglob("*") if path.is_file()])
            ended, _, said = ran(["run", "all.toml", "-o", str(out), "--quiet", "--resume"])
            others = differs(numbers(out), right)
            hidden = [str(path) for path in out.rglob(".*")]
            bad = ended != status or bool(others) or bool(hidden)
            broken += bad
            row = {"file": at, "after": after, "killed": killed, "files": had, "resumed": ended, "differ": others[:3]}
            rows.append({**row, "hidden": hidden[:3], "seconds": round(time.monotonic() - started, 1), "bad": bad})
            print(json.dumps(rows[-1]) + (f"\n  {said[-400:]}" if bad else ""), flush=True)
            shutil.rmtree(out, ignore_errors=True)
    print(f"{len(rows)} kills at {count} files, {broken} broken; status of the session {status}")
    if asked.json:
        asked.json.write_text(json.dumps({"files": count, "broken": broken, "kills": rows}, indent=1) + "\n")
    return int(broken > 0)


if __name__ == "__main__":
    sys.exit(main())
