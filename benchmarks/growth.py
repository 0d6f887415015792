"""How a capture grows with the sensor, the projector and the number of frames: seconds by stage and memory, predicted
and taken.

    python benchmarks/growth.py --json FILE [--case NAME ...] [--limit SECONDS]

The photograph is drawn with other numbers of pixels on the same areas, and captured by the command line in a process of
its own, after one small run that compiles kernels and byte code and is not counted. Each case has wall and processor
seconds, stages, and memory beyond what the program held before, each beside its prediction; and the memory of the
whole process. What FILE holds already is not repeated; the table is printed as markdown. A case that takes longer than
``--limit`` is killed, and says so.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from versions import drawn

ROOT = Path(__file__).parents[1]
STAGES = ("plan", "transport", "truth", "optics", "sensor", "write")
"""Stages of a capture that the table shows, predicted and taken; all others are in its total."""


@dataclass(frozen=True)
class Case:
    """Sensor and projector pixels a side, and the patterns; by default those of the shipped photograph."""

    sensor: int = 512
    projector: int = 128
    patterns: str = "dots:7"


CASES: Mapping[str, Case] = {
    **{f"sensor {pixels}": Case(sensor=pixels) for pixels in (256, 512, 1024, 2048)},
    **{f"projector {pixels}": Case(projector=pixels) for pixels in (64, 128, 256, 512)},
    **{f"frames {k * k}": Case(patterns=f"dots:{k}") for k in (1, 4, 16, 32)},
}


def measured(case: Case, limit: float) -> dict[str, Any]:
    """Seconds, memory and predictions of one capture."""
    with tempfile.TemporaryDirectory() as folder:
        inside = Path(folder)
        scene, camera = drawn(inside, ROOT / "scenes", case.sensor, case.projector)
        words = ["capture", str(scene), "--camera", str(camera), "--patterns", case.patterns, "--json"]
        command = [sys.executable, "-m", "mitsim", *words, "-o", str(inside / "run")]
        printed, said = inside / "stdout", inside / "stderr"
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        started = time.perf_counter()
        with printed.open("wb") as out, said.open("wb") as err:
            process = subprocess.Popen(
                command, stdout=out, stderr=err, cwd=ROOT, env=environment, start_new_session=True
            )
        stop = threading.Timer(limit, os.killpg, (process.pid, signal.SIGKILL))
        stop.start()
        _, ended, usage = os.wait4(process.pid, 0)
        stop.cancel()
        process.returncode = os.waitstatus_to_exitcode(ended)
        found: dict[str, Any] = {
            "seconds": time.perf_counter() - started,
            "processor_seconds": usage.ru_utime + usage.ru_stime,
            "process_bytes": usage.ru_maxrss * 1024,
        }
        if found["seconds"] >= limit:
            return {**found, "killed": True}
        if process.returncode not in (0, 1):
            raise SystemExit(f"mitsim ended with {process.returncode}: {' '.join(words)}\n{said.read_text()}")
        payload = json.loads(printed.read_text())
        manifest = json.loads((inside / "run" / "manifest.json").read_text())
        told = "mc_error", "total_error_bound", "memory_bytes", "predicted_memory_bytes", "warnings"
        kept = {key: payload.get(key) for key in told}
        plan = manifest["plan"]
        return {**found, **kept, "stages": payload["seconds"], "predicted": plan["predicted"]}


def table(results: Mapping[str, Any]) -> str:
    """What was measured, as markdown: predicted / taken."""
    heads = (
        "case",
        *(f"{stage} [s]" for stage in STAGES),
        "total [s]",
        "processor [s]",
        "memory [GiB]",
        "process [GiB]",
    )
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for name in CASES:
        row = results["cases"].get(name)
        if row is None:
            continue
        if row.get("killed"):
            lines.append(f"| {name} | killed after {row['seconds']:.0f} s |" + " |" * (len(heads) - 2))
            continue
        stages, predicted = row["stages"], row["predicted"]
        pairs = [f"{predicted.get(stage, 0.0):.1f} / {stages.get(stage, 0.0):.1f}" for stage in STAGES]
        total = f"{sum(predicted.values()):.1f} / {stages['total']:.1f}"
        sizes = (row[what] / 2**30 for what in ("predicted_memory_bytes", "memory_bytes", "process_bytes"))
        memory = "{:.2f} / {:.2f} | {:.2f}".format(*sizes)
        lines.append(f"| {' | '.join((name, *pairs, total, format(row['processor_seconds'], '.1f'), memory))} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--case", action="append", default=[], choices=list(CASES), metavar="NAME")
    parser.add_argument("--limit", type=float, default=600.0)
    options = parser.parse_args()
    results: dict[str, Any] = json.loads(options.json.read_text()) if options.json.exists() else {"cases": {}}
    results["machine"] = f"{platform.machine()}, {len(os.sched_getaffinity(0))} processors"
    wanted = [name for name in options.case or CASES if name not in results["cases"]]
    if wanted:
        measured(Case(sensor=256, projector=64, patterns="uniform"), options.limit)
    for name in wanted:
        results["cases"][name] = measured(CASES[name], options.limit)
        options.json.write_text(json.dumps(results, indent=1) + "\n")
        print(f"{name}: {results['cases'][name]['seconds']:.1f} s", file=sys.stderr, flush=True)
    print(f"{results['machine']}; predicted / taken\n\n{table(results)}")


if __name__ == "__main__":
    main()
