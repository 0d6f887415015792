"""`mitsim capture` of 49 dots at 512x512 to 1e-3: cold from the shell, warm in one process, and against the reference.

    python benchmarks/capture.py [--json FILE] [--repeat 5] [--scene cookie_bag --scene compact_disc]

Cold: a new process, with an empty kernel cache and LLVM probe (a temporary HOME), from the shell to its exit. Warm:
medians of later captures in one process. The reference's time at equal error is measured at a feasible error and
extrapolated by 1/sqrt(samples). With ``--scene`` only the warm seconds of these scenes are measured.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import mitsim as ms
from mitsim.core.environment import versions
from mitsim.studies.framework.run import find_study

SCENE, PATTERNS, ACCURACY = "photograph", "dots:7", 1e-3


def cold() -> dict[str, float]:
    """Seconds of two processes in a row: caches empty, then kernels compiled before."""
    seconds = {}
    with tempfile.TemporaryDirectory() as home:
        for name in ("empty_caches", "new_process"):
            run = str(Path(home) / name)
            command = [sys.executable, "-m", "mitsim", "capture", SCENE, "--patterns", PATTERNS]
            command += ["--accuracy", str(ACCURACY), "-o", run, "--json"]
            started = time.perf_counter()
            subprocess.run(command, check=True, capture_output=True, env={**os.environ, "HOME": home})
            seconds[name] = time.perf_counter() - started
    return seconds


def warm(repeat: int, scene: str = SCENE) -> dict[str, float]:
    """Median seconds by stage over ``repeat`` captures of the ``scene`` after a first one."""
    bench = ms.open_bench(scene)
    runs = []
    with tempfile.TemporaryDirectory() as folder:
        for index in range(repeat + 1):
            runs.append(bench.capture(PATTERNS, Path(folder) / str(index), accuracy=ACCURACY).manifest)
    stages = {key: statistics.median(run.seconds[key] for run in runs[1:]) for key in runs[0].seconds}
    return {**stages, "transport_and_optics": stages["transport"] + stages["optics"], "mc_error": runs[1].mc_error}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--scene", action="append", default=[])
    options = parser.parse_args()
    if options.scene:
        report(
            {
                "warm_seconds": {name: warm(options.repeat, name) for name in options.scene},
                **_circumstances(options.repeat),
            },
            options.json,
        )
        return
    with tempfile.TemporaryDirectory() as folder:
        request = ms.Request.of(patterns=PATTERNS)
        study = find_study("accuracy")(ms.open_bench(SCENE), folder, request, None).payload()
    result = {
        "cold_seconds": cold(),
        "warm_seconds": warm(options.repeat),
        "speedup_at_equal_error": study["speedup_at_equal_error"],
        "accuracy_rows": study["rows"],
        **_circumstances(options.repeat),
    }
    report(result, options.json)


def _circumstances(repeat: int) -> dict[str, object]:
    machine = f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
    return {"repeat": repeat, "seed": 0, "machine": machine, "versions": versions()}


def report(result: dict[str, object], path: Path | None) -> None:
    """Print a result, and write it to ``path``."""
    text = json.dumps(result, indent=1)
    print(text)
    if path:
        path.write_text(text + "\n")


if __name__ == "__main__":
    main()
