"""What a calibration session of 2 x 128 patterns with noise takes, to 1e-3, by stage: a new process, and warm in one.

    python benchmarks/session.py --json FILE [--repeat 3] [--scene photograph ...] [--capture pair uniform]

``new_process``: `mitsim calibrate SCENE -o CAL` from the shell to its exit, kernels compiled by a process before it;
``wall`` and ``processor`` seconds of the fastest of all repeats, and its stages. ``warm``: medians of later sessions
in one process. ``pair`` takes 512 frames of 512 x 512 pixels, ``uniform`` 258. Ends with 1 where a new process takes
more than ``GOAL`` seconds.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import mitsim as ms
from mitsim.core.environment import versions
from mitsim.devices.session import SessionRecipe, load_recipe, recipe_text

GOAL = 15.0
"""Seconds that issue 17 allows."""
CAPTURES = ("pair", "uniform")


def recipe_of(capture: str) -> SessionRecipe:
    """The shipped recipe with this way to ``capture`` +-1 patterns."""
    return load_recipe().model_copy(update={"signed_capture": capture})


def new_process(scene: str, capture: str, repeat: int) -> dict[str, Any]:
    """Seconds of the fastest of so many processes, after one that compiles kernels.

    Parameters
    ----------
    scene, capture
        what is calibrated, and by which capture of +-1 patterns.
    repeat
        how many processes.
    """
    found = []
    with tempfile.TemporaryDirectory() as folder:
        recipe = Path(folder) / "recipe.toml"
        recipe.write_text(recipe_text(recipe_of(capture)))
        command = [sys.executable, "-m", "mitsim", "calibrate", scene, "--recipe", str(recipe), "--json", "--quiet"]
        for number in range(repeat + 1):
            before, started = os.times(), time.perf_counter()
            done = subprocess.run([*command, "-o", f"{folder}/{number}"], check=True, capture_output=True)
            wall, after = time.perf_counter() - started, os.times()
            processor = after.children_user + after.children_system - before.children_user - before.children_system
            reported = json.loads(done.stdout)
            facts = {name: reported[name] for name in ("frames", "phi_error", "predicted_seconds")}
            stages = {name: seconds for name, seconds in reported["seconds"].items() if name != "total"}
            found.append({"wall": wall, "processor": processor, **facts, "stages": stages})
    return min(found[1:], key=lambda row: row["wall"])


def warm(scene: str, capture: str, repeat: int) -> dict[str, Any]:
    """Median seconds by stage of so many sessions in one process, after a first one.

    Parameters
    ----------
    scene, capture, repeat
        as for :func:`new_process`.
    """
    bench, rows = ms.open_bench(scene), []
    for _ in range(repeat + 1):
        started = time.process_time()
        seconds = bench.calibrate(recipe=recipe_of(capture)).manifest.result["seconds"]
        rows.append({**seconds, "processor": time.process_time() - started})
    return {name: statistics.median(row[name] for row in rows[1:]) for name in rows[-1]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--scene", action="append", default=[])
    parser.add_argument("--capture", nargs="*", choices=CAPTURES, default=CAPTURES)
    options = parser.parse_args()
    cases: dict[str, Any] = {}
    for scene in options.scene or ["photograph"]:
        for capture in options.capture:
            row = {part.__name__: part(scene, capture, options.repeat) for part in (new_process, warm)}
            cases[f"{scene}, {capture}"] = row
            cold, again = row["new_process"], row["warm"]
            print(
                f"{scene}, {capture}: {cold['frames']} frames, new process {cold['wall']:.2f} s "
                f"({cold['processor']:.2f} of processors), warm {again['total']:.2f} s ({again['processor']:.2f})",
                flush=True,
            )
    late = [name for name, row in cases.items() if row["new_process"]["wall"] > GOAL]
    facts = {"goal": GOAL, "repeat": options.repeat, "processors": os.cpu_count(), "versions": versions()}
    options.json.write_text(json.dumps({**facts, "cases": cases, "late": late}, indent=1) + "\n")
    sys.exit(1 if late else 0)


if __name__ == "__main__":
    main()
