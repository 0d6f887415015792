"""What of a capture's seconds is spent in Mitsuba's kernels, products of matrices, noise, files and imports.

    python benchmarks/floors.py --json FILE [--scene photograph ...] [--patterns dots:7] [--accuracy 1e-3]

One new process a scene, kernels compiled and byte code written before. ``imports``: a bare process that imports
Mitsuba, NumPy and the parts of SciPy that a capture uses, and selects the variant. ``kernels``: Dr.Jit's own record of
what its compiled kernels run, on all processors. ``products``, ``noise`` and ``files``: processor seconds inside the
products that form frames, the sensor's draws, and writing and hashing frames, over the processors. Together they are a
floor: no order of work goes below it at the same samples, classes and frames. ``rest`` is all else of ``total``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

SCENES = ("photograph", "gift_card", "compact_disc", "metal_blade", "corner", "cookie_bag")
_IMPORTS = (
    "import numpy, scipy.sparse, scipy.special, scipy.fft, OpenEXR, pydantic, typer, mitsuba as mi;"
    "mi.set_variant('llvm_ad_mono'); import drjit as dr; dr.eval(dr.arange(mi.Float, 8))"
)
_CAPTURE = """
import json, sys, tempfile, threading, time
started = time.perf_counter()
import drjit as dr
import mitsim as ms
from mitsim.capture import exposer
from mitsim.core import framefile, recorders
from mitsim.core.worker import workers
from mitsim.optics.image_formation import _Terms

spent, lock = dict.fromkeys(("products", "noise", "files"), 0.0), threading.Lock()

def timed(home, name, kind):
    plain = getattr(home, name)
    def inside(*arguments, **options):
        begun = time.thread_time()
        try:
            return plain(*arguments, **options)
        finally:
            with lock:
                spent[kind] += time.thread_time() - begun
    setattr(home, name, inside)

launched, history = [], dr.kernel_history

def noted(types):  # mitsim takes Dr.Jit's history itself, to count what was compiled
    found = history()
    launched.extend(found)
    return [entry for entry in found if entry["type"] in types]

dr.kernel_history = noted
timed(_Terms, "frame", "products")
timed(_Terms, "probe", "products")
timed(exposer, "expose", "noise")
timed(recorders, "write_frame", "files")
timed(recorders, "checksum", "files")
scene, patterns, accuracy = sys.argv[1], sys.argv[2], float(sys.argv[3])
with tempfile.TemporaryDirectory() as folder:
    bench = ms.open_bench(scene)
    run = bench.capture(patterns, folder + "/run", accuracy=accuracy)
kernels = sum(entry["execution_time"] for entry in launched + history()) / 1e3
parts = {name: seconds / workers() for name, seconds in spent.items()}
stages = {name: seconds for name, seconds in run.manifest.seconds.items() if name != "total"}
print(json.dumps({"kernels": kernels, **parts, "total": time.perf_counter() - started, "stages": stages}))
"""


def seconds_of(command: list[str]) -> float:
    """Wall seconds of a command, from the shell to its exit."""
    started = time.perf_counter()
    subprocess.run(command, check=True)
    return time.perf_counter() - started


def measured(scene: str, patterns: str, accuracy: float) -> dict[str, Any]:
    """Parts of one capture's seconds; the second of two, so that kernels are compiled."""
    command = [sys.executable, "-c", _CAPTURE, scene, patterns, str(accuracy)]
    for _ in range(2):
        found: dict[str, Any] = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    imports = min(seconds_of([sys.executable, "-c", _IMPORTS]) for _ in range(3))
    parts = {"imports": imports, **{name: found[name] for name in ("kernels", "products", "noise", "files")}}
    floor = sum(parts.values())
    return {**parts, "floor": floor, "rest": found["total"] - floor, "total": found["total"], "stages": found["stages"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--scene", action="append", default=[])
    parser.add_argument("--patterns", default="dots:7")
    parser.add_argument("--accuracy", type=float, default=1e-3)
    options = parser.parse_args()
    cases = {}
    for scene in options.scene or SCENES:
        cases[scene] = row = measured(scene, options.patterns, options.accuracy)
        reported = ", ".join(f"{name} {seconds:.2f}" for name, seconds in row.items() if name != "stages")
        print(f"{scene}: {reported} s", flush=True)
    facts = {"patterns": options.patterns, "accuracy": options.accuracy, "processors": os.cpu_count()}
    options.json.write_text(json.dumps({**facts, "cases": cases}, indent=1))


if __name__ == "__main__":
    main()
