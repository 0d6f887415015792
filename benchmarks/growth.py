"""How captures, calibrations and images grow with the sensor, the projector and the number of frames: seconds by stage
and memory, predicted and taken.

    python benchmarks/growth.py --json FILE [--case NAME ...] [--limit SECONDS]

The photograph is drawn with other numbers of pixels on the same areas; cases named *image* are captured, calibrated and
reconstructed, the others captured. Each command is a process of its own, after one small run of each that compiles
kernels and byte code and is not counted. It has wall and processor seconds, stages, and memory beyond what the program
held before, each beside its prediction; and the memory of the whole process. What FILE holds already is not repeated;
the tables are printed as markdown. A command that takes longer than ``--limit`` is killed, and says so.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
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

import numpy as np
from skimage import io

ROOT = Path(__file__).parents[1]
STAGES: Mapping[str, tuple[str, ...]] = {
    "capture": ("plan", "transport", "truth", "optics", "sensor", "write"),
    "calibrate": ("plan", "transport", "optics", "sensor"),
    "reconstruct": ("accumulate", "misfit", "uncertainty"),
}
"""Stages of each command that its table shows, predicted and taken; all others are in its total."""


@dataclass(frozen=True)
class Case:
    """Sensor and projector pixels a side, and the patterns; by default those of the shipped photograph.

    ``verbs``: the commands that are run in turn.
    """

    sensor: int = 512
    projector: int = 128
    patterns: str = "dots:7"
    verbs: tuple[str, ...] = ("capture",)


_IMAGE = ("capture", "calibrate", "reconstruct")
CASES: Mapping[str, Case] = {
    **{f"sensor {pixels}": Case(sensor=pixels) for pixels in (256, 512, 1024, 2048)},
    **{f"projector {pixels}": Case(projector=pixels) for pixels in (64, 128, 256, 512)},
    **{f"frames {k * k}": Case(patterns=f"dots:{k}") for k in (1, 4, 16, 32)},
    **{f"image, sensor {pixels}": Case(sensor=pixels, verbs=_IMAGE) for pixels in (256, 512, 1024, 2048)},
    **{f"image, projector {pixels}": Case(projector=pixels, verbs=_IMAGE) for pixels in (256, 512)},
}


def drawn(folder: Path, scenes: Path, pixels: int | None = None, window: int | None = None) -> tuple[Path, Path]:
    """Scene and camera file of the photograph with other numbers of pixels on the same areas, made in ``folder``.

    Parameters
    ----------
    folder, scenes
        where they are made, and the shipped scenes, beside which the shipped cameras lie.
    pixels, window
        of the sensor and of the projector, a side; those of the photograph where not given.
    """
    shutil.copytree(scenes / "photograph", folder / "scene")
    path, camera = folder / "scene" / "scene.xml", folder / "camera.toml"
    text, shipped = path.read_text(), (scenes.parent / "calibration" / "imx249.toml").read_text()
    if pixels:
        text = re.sub(r'name="(width|height)" value="512"', rf'name="\1" value="{pixels}"', text)
        text = text.replace('value="0.01172"', f'value="{0.01172 * 512 / pixels!r}"')
        # The same well and noise on other pixels, so that frames of all sizes are as noisy.
        shipped = shipped.replace("pixel_pitch_um = 5.86", f"pixel_pitch_um = {5.86 * 512 / pixels!r}")
    if window:
        canvas = np.zeros((window, 2 * window), np.uint8)
        canvas[:, window:] = 255
        io.imsave(folder / "scene" / "projector.png", canvas, check_contrast=False)
    path.write_text(text)
    camera.write_text(shipped)
    return path, camera


def measured(case: Case, limit: float) -> dict[str, Any]:
    """Seconds, memory and predictions of each command of a case, by its name."""
    with tempfile.TemporaryDirectory() as folder:
        inside = Path(folder)
        scene, camera = drawn(inside, ROOT / "scenes", case.sensor, case.projector)
        run, calibration = str(inside / "run"), str(inside / "cal")
        arguments = [str(scene), "--camera", str(camera)]
        words = {
            "capture": ["capture", *arguments, "--patterns", case.patterns, "-o", run],
            "calibrate": ["calibrate", *arguments, "-o", calibration],
            "reconstruct": ["reconstruct", run, "--calibration", calibration, "-o", str(inside / "image")],
        }
        found: dict[str, Any] = {}
        for verb in case.verbs:
            found[verb] = _counted([*words[verb], "--json"], inside, limit)
            if found[verb].get("killed"):
                break
        if "capture" in found and not found["capture"].get("killed"):
            manifest = json.loads((inside / "run" / "manifest.json").read_text())
            found["capture"]["predicted"] = manifest["plan"]["predicted"]
        return found


def _counted(words: list[str], inside: Path, limit: float) -> dict[str, Any]:
    """What ``mitsim`` with these ``words`` took in a process of its own, killed after ``limit`` seconds."""
    printed, message = inside / "stdout", inside / "stderr"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    started = time.perf_counter()
    with printed.open("wb") as out, message.open("wb") as err:
        process = subprocess.Popen(
            [sys.executable, "-m", "mitsim", *words],
            stdout=out,
            stderr=err,
            cwd=ROOT,
            env=environment,
            start_new_session=True,
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
        raise SystemExit(f"mitsim ended with {process.returncode}: {' '.join(words)}\n{message.read_text()}")
    payload = json.loads(printed.read_text())
    reported = "mc_error", "total_error_bound", "predicted", "memory_bytes", "predicted_memory_bytes", "warnings"
    return {**found, **{key: payload.get(key) for key in reported}, "stages": payload["seconds"]}


def table(results: Mapping[str, Any], verb: str) -> str:
    """What was measured of a command, as markdown: predicted / taken."""
    stages = STAGES[verb]
    sizes = "processor [s]", "memory [GiB]", "process [GiB]"
    heads = ("case", *(f"{stage} [s]" for stage in stages), "total [s]", *sizes)
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for name in CASES:
        row = results["cases"].get(name, {}).get(verb)
        if row is None or not _counts(name, verb):
            continue
        name = name.removeprefix("image, ")
        if row.get("killed"):
            lines.append(f"| {name} | killed after {row['seconds']:.0f} s |" + " |" * (len(heads) - 2))
            continue
        taken, predicted = row["stages"], row["predicted"]
        pairs = [f"{predicted.get(stage, 0.0):.1f} / {taken.get(stage, 0.0):.1f}" for stage in stages]
        total = f"{sum(predicted.values()):.1f} / {taken['total']:.1f}"
        held = (row[what] / 2**30 for what in ("predicted_memory_bytes", "memory_bytes", "process_bytes"))
        memory = "{:.2f} / {:.2f} | {:.2f}".format(*held)
        lines.append(f"| {' | '.join((name, *pairs, total, format(row['processor_seconds'], '.1f'), memory))} |")
    return "\n".join(lines)


def _counts(name: str, verb: str) -> bool:
    """Whether a case is in the table of a command: captures of cases of several commands are shown by others."""
    verbs = CASES[name].verbs
    return verb in verbs and (verb != "capture" or len(verbs) == 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--case", action="append", default=[], choices=list(CASES), metavar="NAME")
    parser.add_argument("--limit", type=float, default=1200.0)
    options = parser.parse_args()
    results: dict[str, Any] = json.loads(options.json.read_text()) if options.json.exists() else {"cases": {}}
    results["machine"] = f"{platform.machine()}, {len(os.sched_getaffinity(0))} processors"
    wanted = [name for name in options.case or CASES if name not in results["cases"]]
    if wanted:
        verbs = max((CASES[name].verbs for name in wanted), key=len)
        measured(Case(sensor=256, projector=64, patterns="uniform", verbs=verbs), options.limit)
    for name in wanted:
        results["cases"][name] = measured(CASES[name], options.limit)
        options.json.write_text(json.dumps(results, indent=1) + "\n")
        taken = ", ".join(f"{verb} {row['seconds']:.1f} s" for verb, row in results["cases"][name].items())
        print(f"{name}: {taken}", file=sys.stderr, flush=True)
    print(f"{results['machine']}; predicted / taken")
    counted = [verb for verb in STAGES if any(_counts(name, verb) for name in results["cases"])]
    for verb in counted:
        print(f"\n{verb}\n\n{table(results, verb)}")


if __name__ == "__main__":
    main()
