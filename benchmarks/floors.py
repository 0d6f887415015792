"""What no order of work goes below at the same samples and frames: seconds of a capture's kernels and products alone.

    python benchmarks/floors.py --json FILE [--scene photograph ...] [--patterns dots:7] [--accuracy 1e-3]

One new process a scene, the second of two, so that kernels are compiled and byte code is written. ``kernels``: Dr.Jit's
own record of what its compiled kernels run once the plan is made, on all processors; ``products``: processor seconds
inside the products that form frames, over the processors. Their sum is the ``floor``: without planning, Python that
traces kernels anew, starting, noise and files. ``planning`` is what the plan's kernels and products run, counted alike.
``noise`` and ``files`` are processor seconds of the sensor's draws, and of writing and hashing frames, over the
processors; ``imports`` a bare process that imports Mitsuba, NumPy and the parts of SciPy that a capture uses, and
selects the variant. ``rest`` is all else of ``total``. ``compiled`` counts different kernels of the plan, of the run,
and of both.
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
from mitsim.acquire import exposure
from mitsim.core import recorders
from mitsim.core.worker import workers
from mitsim.optics import image_formation

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

def ran():
    '''Seconds of kernels and of products since the last call, and the kernels.'''
    entries = launched + history()
    launched.clear()
    seconds = sum(entry["execution_time"] for entry in entries) / 1e3
    products, spent["products"] = spent["products"], 0.0
    return seconds, products / workers(), {entry["hash"] for entry in entries if entry.get("hash")}

# Layers behind a mask, whatever it is made of.
layers = [each for each in vars(image_formation).values() if isinstance(each, type) and each.__name__.startswith("_")]
layers = [each for each in layers if {"frame", "probe"} <= vars(each).keys()]
assert layers, "the classes that form frames have other names"
for layer in layers:
    timed(layer, "frame", "products")
    timed(layer, "probe", "products")
timed(exposure, "expose", "noise")
timed(recorders, "write_frame", "files")
timed(recorders, "checksum", "files")
scene, patterns, accuracy = sys.argv[1], sys.argv[2], float(sys.argv[3])
with tempfile.TemporaryDirectory() as folder:
    bench = ms.open_bench(scene)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    begun = time.perf_counter()
    plan = bench.plan(patterns, accuracy=accuracy)
    planned = time.perf_counter() - begun
    *planning, of_plan = ran()
    run = bench.capture(plan, folder + "/run")
kernels, products, of_run = ran()
stages = {name: seconds for name, seconds in run.manifest.seconds.items() if name != "total"}
print(json.dumps({
    "kernels": kernels,
    "products": products,
    "planning": sum(planning),
    **{name: spent[name] / workers() for name in ("noise", "files")},
    "total": time.perf_counter() - started,
    "stages": {**stages, "plan": planned},
    "compiled": {"plan": len(of_plan), "run": len(of_run), "both": len(of_plan | of_run)},
}))
"""


def _environment() -> dict[str, str]:
    """In which byte code is kept from one process to the next."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def seconds_of(command: list[str]) -> float:
    """Wall seconds of a command, from the shell to its exit."""
    started = time.perf_counter()
    subprocess.run(command, check=True, env=_environment())
    return time.perf_counter() - started


def measured(scene: str, patterns: str, accuracy: float) -> dict[str, Any]:
    """Parts of one capture's seconds; the second of two, so that kernels are compiled."""
    command = [sys.executable, "-c", _CAPTURE, scene, patterns, str(accuracy)]
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, text=True, env=_environment())
        if done.returncode:
            raise SystemExit(f"{scene}: {done.stderr}")
        found: dict[str, Any] = json.loads(done.stdout)
    imports = min(seconds_of([sys.executable, "-c", _IMPORTS]) for _ in range(3))
    floor = found["kernels"] + found["products"]
    beside = imports + sum(found[name] for name in ("planning", "noise", "files"))
    return {"floor": floor, **found, "imports": imports, "rest": found["total"] - floor - beside}


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
        reported = ", ".join(f"{name} {seconds:.2f}" for name, seconds in row.items() if isinstance(seconds, float))
        kernels = ", ".join(f"{count} of {of}" for of, count in row["compiled"].items())
        print(f"{scene}: {reported} s; kernels: {kernels}", flush=True)
    facts = {"patterns": options.patterns, "accuracy": options.accuracy, "processors": os.cpu_count()}
    options.json.write_text(json.dumps({**facts, "cases": cases}, indent=1))


if __name__ == "__main__":
    main()
