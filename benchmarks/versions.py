"""Version 0.3.0 and this checkout on the same machine, side by side: seconds, memory and errors of the same commands.

    python benchmarks/versions.py --json FILE [--case NAME ...] [--repeat 5] [--old FOLDER]

0.3.0 is commit 2be4e7e, cloned into FOLDER and installed there by its own set-up when FOLDER does not exist. Both
versions run the scene files of 0.3.0, each command as a process of its own from the shell to its exit, in turn, after
one run of each that compiles kernels and byte code and is not counted. Of ``--repeat`` pairs the least and the median
are stated, of wall seconds, processor seconds, and memory of the largest process; `ratio` is the median over pairs.
What FILE holds already is not repeated. Cases named *warm* are later captures of one process. Equal seconds are not
equal errors: 0.3.0 promises the error of sampling, later versions all of it; `benchmarks/accuracy.py --old` tells both.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

OLD_COMMIT, ROOT = "2be4e7e", Path(__file__).parents[1]
OLD_FOLDER = Path.home() / ".cache" / "mitsim-benchmarks" / "0.3.0"
LIMIT = 600.0
"""Seconds that a command may take before it is killed, and its case says so."""
_WARM = """
import sys, time, json, tempfile, pathlib
scene, repeat = sys.argv[1], int(sys.argv[2])
{imports}
with tempfile.TemporaryDirectory() as folder:
    seconds, stages = [], []
    for index in range(repeat + 1):
        started = time.perf_counter()
        bench = {open}
        run = {capture}
        seconds.append(time.perf_counter() - started)
        stages.append(dict(run.seconds))
print(json.dumps({{"each": seconds[1:], "seconds": stages[-1]}}))
"""
_WARM_OLD = _WARM.format(
    imports="from mitsim.capture.bench import open_bench\nfrom mitsim.capture.run import capture",
    open="open_bench(pathlib.Path(scene))",
    capture="capture(bench, 'dots:7', pathlib.Path(folder) / str(index), 1e-3)",
)
_WARM_NEW = _WARM.format(
    imports="import mitsim as ms",
    open="ms.open_bench(scene)",
    capture="bench.capture('dots:7', pathlib.Path(folder) / str(index), accuracy=1e-3).manifest",
)


@dataclass(frozen=True)
class Version:
    """An installed version: its name, its interpreter, and the script of warm captures."""

    name: str
    python: Path
    warm: str

    def command(self, arguments: Sequence[str]) -> list[str]:
        """What the shell would be given for ``mitsim`` with these ``arguments``, or for the interpreter."""
        if arguments[0] == "python":
            return [str(self.python), *arguments[1:]]
        if arguments[0] == "warm":
            return [str(self.python), "-c", self.warm, *arguments[1:]]
        return [str(self.python.with_name("mitsim")), *arguments]


@dataclass(frozen=True)
class Case:
    """A command of both versions.

    Attributes
    ----------
    arguments
        of ``mitsim``; or after ``python`` those of the interpreter, after ``warm`` scene and number of captures.
        ``OUT`` is a new folder, ``SCENES`` that of 0.3.0's scenes.
    status
        that it may end with.
    aim
        seconds that the case should take today.
    window, pixels
        projector and sensor pixels a side of a scene that is drawn for the case, in place of the photograph's.
    """

    arguments: tuple[str, ...]
    status: tuple[int, ...] = (0, 1)
    aim: float | None = None
    window: int | None = None
    pixels: int | None = None


def _capture(scene: str, patterns: str = "dots:7", **facts: Any) -> Case:
    return Case(("capture", f"SCENES/{scene}/scene.xml", "--patterns", patterns, "-o", "OUT", "--json"), **facts)


CASES: Mapping[str, Case] = {
    "photograph": _capture("photograph", aim=3.5),
    "cookie_bag": _capture("cookie_bag", aim=9.0),
    **{name: _capture(name) for name in ("corner", "gift_card", "metal_blade", "compact_disc")},
    "photograph warm": Case(("warm", "SCENES/photograph/scene.xml", "3"), aim=1.5),
    "plan photograph": Case(("plan", "SCENES/photograph/scene.xml", "--json")),
    "demo": Case(("demo", "-o", "OUT"), aim=20.0),
    "import": Case(("python", "-c", "import mitsim.cli"), aim=1.0),
    "help": Case(("--help",), aim=1.0),
    "scene misspelt": Case(("capture", "phtograph", "--patterns", "dots:7", "-o", "OUT"), (2,), aim=0.3),
    "patterns misspelt": Case(("capture", "photograph", "--patterns", "dost:7", "-o", "OUT"), (2,), aim=0.3),
    "patterns of no dots": Case(("capture", "photograph", "--patterns", "dots:0", "-o", "OUT"), (2,), aim=0.3),
    "accuracy of zero": Case(("plan", "photograph", "--accuracy", "0"), (2,), aim=0.3),
    "run missing": Case(("reconstruct", "nothing", "--calibration", "nothing"), (2,), aim=0.3),
    "scene broken": Case(("plan", "OUT.xml"), (2,), aim=1.0),
    "sensor 512": _capture("drawn", pixels=512),
    "sensor 1024": _capture("drawn", pixels=1024),
    "sensor 2048": _capture("drawn", pixels=2048),
    "projector 256": _capture("drawn", window=256),
    "projector 512": _capture("drawn", window=512),
    "frames 256": _capture("photograph", "dots:16"),
    "frames 1024": _capture("photograph", "dots:32"),
    "study accuracy": Case(("study", "accuracy", "SCENES/photograph/scene.xml", "-o", "OUT"), aim=120.0),
}


def installed(folder: Path) -> Version:
    """0.3.0 in an environment of its own in ``folder``, made by its own set-up where it is not there."""
    if not folder.exists():
        part = folder.with_name(folder.name + ".part")
        shutil.rmtree(part, ignore_errors=True)
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(part)], check=True)
        subprocess.run(["git", "-C", str(part), "checkout", "--quiet", OLD_COMMIT], check=True)
        part.rename(folder)
    python = folder / ".venv" / "bin" / "python"
    if not python.with_name("mitsim").exists():
        subprocess.run(["make", "-C", str(folder), "setup"], check=True)
    return Version("0.3.0", python, _WARM_OLD)


def measured(version: Version, case: Case, scenes: Path) -> dict[str, Any]:
    """Wall and processor seconds and memory of one run; where it prints JSON, its stages."""
    with tempfile.TemporaryDirectory() as folder:
        inside = Path(folder)
        (inside / "OUT.xml").write_text("<scene version='3.0.0'><sensor type='mitsim_lensless'")
        words = [word.replace("OUT", str(inside / "OUT")) for word in case.arguments]
        if case.window or case.pixels:
            scene, camera = drawn(inside, scenes, case.pixels, case.window)
            words = [str(scene) if "/drawn/" in word else word for word in (*words, "--camera", str(camera))]
        words = [word.replace("SCENES", str(scenes)) for word in words]
        printed, reported = inside / "stdout", inside / "stderr"
        environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONDONTWRITEBYTECODE")}
        started = time.perf_counter()
        with printed.open("wb") as out, reported.open("wb") as err:
            process = subprocess.Popen(
                version.command(words), stdout=out, stderr=err, cwd=folder, env=environment, start_new_session=True
            )
        stop = threading.Timer(LIMIT, os.killpg, (process.pid, signal.SIGKILL))
        stop.start()
        _, ended, usage = os.wait4(process.pid, 0)
        stop.cancel()
        process.returncode = os.waitstatus_to_exitcode(ended)
        seconds = time.perf_counter() - started
        found: dict[str, Any] = {
            "seconds": seconds,
            "processor_seconds": usage.ru_utime + usage.ru_stime,
            "memory_mib": usage.ru_maxrss / 1024,
        }
        if process.returncode in (-signal.SIGKILL, 137) and seconds >= LIMIT:
            return {**found, "killed": True}
        if process.returncode not in case.status:
            raise SystemExit(
                f"{version.name} ended with {process.returncode}: {' '.join(words)}\n{reported.read_text()}"
            )
        try:
            payload = json.loads(printed.read_text())
        except ValueError:
            return found
        if "each" in payload:
            found["seconds"] = statistics.median(payload["each"])
        if isinstance(payload.get("seconds"), dict):
            found["stages"] = payload["seconds"]
        for key in ("mc_error", "total_error", "predicted_seconds"):
            if payload.get(key) is not None:
                found[key] = payload[key]
        return found


def drawn(folder: Path, scenes: Path, pixels: int | None = None, window: int | None = None) -> tuple[Path, Path]:
    """Scene and camera file of the photograph with other numbers of pixels on the same areas, made in ``folder``.

    Parameters
    ----------
    folder, scenes
        where they are made, and the shipped scenes, beside which the shipped cameras lie.
    pixels, window
        of the sensor and of the projector, a side; those of the photograph where not given.
    """
    import numpy as np
    from skimage import io

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


def summary(pairs: Sequence[Mapping[str, dict[str, Any]]]) -> dict[str, Any]:
    """Least and median of both versions, and the median ratio of the pairs."""
    found: dict[str, Any] = {}
    for name in ("0.3.0", "today"):
        runs = [pair[name] for pair in pairs]
        found[name] = {
            "least": min(run["seconds"] for run in runs),
            "median": statistics.median(run["seconds"] for run in runs),
            "processor_median": statistics.median(run["processor_seconds"] for run in runs),
            "memory_mib": max(run["memory_mib"] for run in runs),
            "killed": any(run.get("killed", False) for run in runs),
        }
        if "stages" in runs[-1]:
            stages = [run["stages"] for run in runs]
            found[name]["stages"] = {key: statistics.median(each[key] for each in stages) for key in stages[0]}
            found[name]["light"] = statistics.median(each["transport"] + each["optics"] for each in stages)
    found["ratio"] = statistics.median(pair["0.3.0"]["seconds"] / pair["today"]["seconds"] for pair in pairs)
    return found


def table(results: Mapping[str, Any]) -> str:
    """One line a case, for people."""
    lines = [
        f"{'case':<22} {'0.3.0 least, median s':>24} {'today least, median s':>24} {'ratio':>6} {'aim s':>6}  light s"
    ]
    for name, case in CASES.items():
        if name not in results["cases"]:
            continue
        row = results["cases"][name]["summary"]
        sides = [f"{row[v]['least']:.2f}, {row[v]['median']:.2f}" for v in ("0.3.0", "today")]
        sides = [
            side + (" killed" if row[v]["killed"] else "") for side, v in zip(sides, ("0.3.0", "today"), strict=True)
        ]
        light = " -> ".join(f"{row[v]['light']:.1f}" for v in ("0.3.0", "today") if "light" in row[v])
        lines.append(f"{name:<22} {sides[0]:>24} {sides[1]:>24} {row['ratio']:6.2f} {case.aim or '':>6}  {light}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--case", action="append", default=[], choices=list(CASES), metavar="NAME")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--old", type=Path, default=OLD_FOLDER)
    options = parser.parse_args()
    versions = installed(options.old), Version("today", Path(sys.executable), _WARM_NEW)
    scenes = options.old / "scenes"
    results: dict[str, Any] = json.loads(options.json.read_text()) if options.json.exists() else {"cases": {}}
    results["machine"] = f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
    for name in options.case or CASES:
        kept = results["cases"].setdefault(name, {"pairs": []})
        if len(kept["pairs"]) < options.repeat and not kept["pairs"]:
            for version in versions:
                measured(version, CASES[name], scenes)
        while len(kept["pairs"]) < options.repeat:
            kept["pairs"].append({version.name: measured(version, CASES[name], scenes) for version in versions})
            kept["summary"] = summary(kept["pairs"])
            options.json.write_text(json.dumps(results, indent=1) + "\n")
        print(f"{name}: {kept['summary']['ratio']:.2f} times", file=sys.stderr, flush=True)
    print(table(results))


if __name__ == "__main__":
    main()
