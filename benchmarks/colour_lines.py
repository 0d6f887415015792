"""What three lines cost in the time of one: `capture --colour lines` beside captures of one line, side by side.

    python benchmarks/colour_lines.py --json FILE [--scene photograph ...] [--patterns dots:7] [--accuracy 1e-3]
        [--repeat 5]

Each command is a process of its own from the shell to its exit: ``mono``, all lines as one light; ``one line``, a
projector of its longest line alone; ``lines``, each line in a folder. They run in turn, ``--repeat`` times, after one
run of each that compiles kernels and is not counted. Ratios are of ``lines`` to the other two, each within one turn,
and the median over turns is stated with the least and the most: of wall seconds and processor seconds of the ``whole``
command, and of wall seconds of what is ``traced`` (plan, transport and truth). ``extra`` is what each further line adds
to the whole, in processor seconds: frames, noise and files of its own.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

SCENES = ("photograph", "colour_checker", "corner")
TRACED = ("plan", "transport", "truth")
PROJECTOR = Path(__file__).parents[1] / "calibration" / "mp_cl1.toml"
GOAL = 1.6
"""Times one line that three lines are to cost at equal accuracy."""


def longest_line(path: Path) -> tuple[Path, int]:
    """Write to ``path`` the projector that shows its longest line alone; returns it, and how many lines all are."""
    text = PROJECTOR.read_text(encoding="utf-8")
    lines = [float(number) for number in re.search(r"^wavelengths_nm = \[(.*)\]", text, re.M)[1].split(",")]  # type: ignore[index]
    alone = {"wavelengths_nm": f"[{max(lines)}]", "radiant_shares": "[1.0]", "effective_wavelength_nm": max(lines)}
    for name, value in alone.items():
        text = re.sub(rf"^{name} = .*", f"{name} = {value}", text, flags=re.M)
    path.write_text(text, encoding="utf-8")
    return path, len(lines)


def measured(options: Sequence[str], output: Path) -> dict[str, Any]:
    """Seconds of a capture with these ``options`` to the folder ``output``."""
    command = [sys.executable, "-m", "mitsim", "capture", *options, "-o", str(output), "--json", "--quiet"]
    before, started = os.times(), time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True)
    wall, after = time.perf_counter() - started, os.times()
    if done.returncode not in (0, 1):
        raise SystemExit(done.stderr)
    reported = json.loads(done.stdout)
    stages = reported["seconds"]
    processor = sum(getattr(after, name) - getattr(before, name) for name in ("children_user", "children_system"))
    errors = [run["total_error_bound"] for run in reported.get("channels", [reported])]
    traced = sum(stages[name] for name in TRACED)
    return {"wall": wall, "processor": processor, "traced": traced, "error_bounds": errors, "stages": stages}


def compared(turns: Sequence[Mapping[str, Any]], lines: int) -> dict[str, Any]:
    """Ratios of ``lines`` to the other commands, and what each further line adds, over all ``turns``."""
    found: dict[str, Any] = {}
    for other in ("mono", "one line"):
        found[other] = {
            kind: spread([turn["lines"][kind] / turn[other][kind] for turn in turns])
            for kind in ("wall", "processor", "traced")
        }
    more = [(turn["lines"]["processor"] - turn["one line"]["processor"]) / max(lines - 1, 1) for turn in turns]
    return {**found, "extra": spread(more)}


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, least and most of ``values``."""
    return {"median": statistics.median(values), "least": min(values), "most": max(values)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--scene", action="append", default=[])
    parser.add_argument("--patterns", default="dots:7")
    parser.add_argument("--accuracy", type=float, default=1e-3)
    parser.add_argument("--repeat", type=int, default=5)
    options = parser.parse_args()
    facts = {"patterns": options.patterns, "accuracy": options.accuracy, "processors": os.cpu_count(), "goal": GOAL}
    cases: dict[str, Any] = {}
    for scene in options.scene or SCENES:
        common = [scene, "--patterns", options.patterns, "--accuracy", str(options.accuracy)]
        turns = []
        with tempfile.TemporaryDirectory() as folder:
            alone, count = longest_line(Path(folder) / "one.toml")
            commands = {
                "mono": common,
                "one line": [*common, "--projector", str(alone)],
                "lines": [*common, "--colour", "lines"],
            }
            for turn in range(options.repeat + 1):
                turns.append({name: measured(each, Path(folder) / f"{name} {turn}") for name, each in commands.items()})
        cases[scene] = {**compared(turns[1:], count), "turns": turns[1:]}
        for other in ("mono", "one line"):
            ratios = cases[scene][other]
            reported = ", ".join(f"{kind} {ratio['median']:.2f}" for kind, ratio in ratios.items())
            print(f"{scene}: {count} lines over {other}: {reported} (goal {GOAL})", flush=True)
        options.json.write_text(json.dumps({**facts, "cases": cases}, indent=1) + "\n")


if __name__ == "__main__":
    main()
