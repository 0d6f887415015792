"""Whether frames, factors and images are bit-equal to those of another version of mitsim.

    python benchmarks/bit_equal.py note FILE.json [--python PY] [--scenes NAME ...]
    python benchmarks/bit_equal.py compare FILE.json [--python PY] [--scenes NAME ...] [--json RESULT.json]

``note`` runs the command line (of the environment that ``--python`` belongs to) on the twelve shipped scenes, one of
them also by lines and behind a mosaic, with a calibration, images and a study of two points, and writes a checksum of
every result; ``compare`` runs the same and exits with 1 when one differs. Checksums are of pixel values, not of files,
so that metadata and file layout may change. Numbers depend on the processor's vector width and on LLVM, which are noted
too: note the old version on the same machine, in an environment of its own.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import OpenEXR
from harness import arguments, write

SCENES = (
    "photograph", "colour_chart", "resolution_target", "keystone", "lamp_bench", "cards", "corner", "gift_card",
    "metal_blade", "mirror", "compact_disc", "cookie_bag",
)  # fmt: skip
# Coarser than the default, so that all twelve take a few minutes: every effect of the default plan is still on.
ACCURACY = "3e-3"
ACCEPTED = (0, 1)  # a flagged result is a result


def runs(scene: str, folder: Path) -> list[tuple[str, list[str], list[str]]]:
    """Name, arguments and result files of each run of a scene."""
    capture = ["capture", scene, "--accuracy", ACCURACY, "--seed", "0"]
    jobs = [("dots:3", [*capture, "--patterns", "dots:3", "-o", str(folder / "dots")], ["dots"])]
    if scene in ("photograph", "cookie_bag", "mirror"):
        signed = [
            *capture,
            *["--patterns", "hadamard:2", "--seed", "7", "--exposure", "0.1", "-o"],
            str(folder / "hadamard"),
        ]
        jobs.append(("hadamard:2", signed, ["hadamard"]))
        render = ["render", scene, "--accuracy", ACCURACY]
        reference = [*render, "--spp", "8", "-o", str(folder / "reference.exr")]
        factored = [*render, "--estimator", "factored", "-o", str(folder / "factored.exr")]
        jobs.append(("reference", reference, ["reference.exr"]))
        jobs.append(("factored", factored, ["factored.exr"]))
    if scene == "colour_chart":
        few = ["capture", scene, "--accuracy", ACCURACY, "--patterns", "dots:2"]
        mosaic = ["--colour", "mosaic", "--camera", "imx249_rggb"]
        jobs.append(("lines", [*few, "--colour", "lines", "-o", str(folder / "lines")], ["lines"]))
        jobs.append(("mosaic", [*few, *mosaic, "-o", str(folder / "mosaic")], ["mosaic"]))
    if scene == "photograph":
        sweep = ["study", "sweep", scene, "--over", "sheet_z=398:402:2", "--patterns", "dots:2"]
        jobs.append(("sweep", [*sweep, "-o", str(folder / "sweep")], ["sweep/sweep.csv"]))
        calibrate = ["calibrate", scene, "--accuracy", ACCURACY, "-o", str(folder / "cal")]
        image = ["reconstruct", str(folder / "dots"), "--calibration", str(folder / "cal"), "-o", str(folder / "image")]
        jobs.append(("calibrate", calibrate, ["cal"]))
        jobs.append(("image", image, ["image/image.exr"]))
        jobs.append(("tv", [*image[:-1], str(folder / "tv"), "--method", "tv"], ["tv/image.exr"]))
    return jobs


def digest(path: Path) -> str:
    """SHA-256 over names, types, shapes and values of all channels of a file, or of all OpenEXR files of a folder; of
    the text of a table."""
    if path.suffix == ".csv":
        return hashlib.sha256(path.read_bytes()).hexdigest()
    total = hashlib.sha256()
    for file in sorted(path.rglob("*.exr")) if path.is_dir() else [path]:
        with OpenEXR.File(str(file), separate_channels=True) as image:
            for name, channel in sorted(image.channels().items()):
                pixels = np.ascontiguousarray(channel.pixels)
                total.update(f"{file.name} {name} {pixels.dtype} {pixels.shape}".encode())
                total.update(pixels.tobytes())
    return total.hexdigest()


def machine(python: str) -> dict[str, str]:
    """What the last bits may depend on."""
    program = (
        "import importlib.metadata as m; from mitsim.core.environment import find_llvm;"
        "print(m.version('mitsuba'), m.version('numpy'), m.version('scipy'), find_llvm().name)"
    )
    done = subprocess.run([python, "-c", program], capture_output=True, text=True, check=True)
    mitsuba, numpy, scipy, llvm = done.stdout.split()
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    cpu = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "")
    avx512 = any("avx512f" in line for line in lines)
    return {
        "cpu": cpu or platform.machine(), "avx512": str(avx512), "mitsuba": mitsuba, "numpy": numpy, "scipy": scipy,
        "llvm": llvm,
    }  # fmt: skip


def measure(python: str, scenes: list[str]) -> dict[str, dict[str, str]]:
    """Checksum of each result, by scene and run."""
    found: dict[str, dict[str, str]] = {}
    environment = {**os.environ, "PYTHONPATH": ""}
    for scene in scenes:
        with tempfile.TemporaryDirectory() as folder:
            for name, arguments, results in runs(scene, Path(folder)):
                started = time.perf_counter()
                command = [str(Path(python).with_name("mitsim")), *arguments, "--quiet", "--json"]
                done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment)
                if done.returncode not in ACCEPTED:
                    raise SystemExit(f"{scene} {name}: exit status {done.returncode}\n{done.stderr}")
                for result in results:
                    key = f"{name} {result.rpartition('/')[2]}"
                    found.setdefault(scene, {})[key] = digest(Path(folder) / result)
                print(f"{scene:18s} {name:10s} {time.perf_counter() - started:5.1f} s", file=sys.stderr, flush=True)
    return found


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("what", choices=("note", "compare"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--python", default=sys.executable, help="of the environment whose mitsim is run")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    options = parser.parse_args()
    here, results = machine(options.python), measure(options.python, options.scenes)
    if options.what == "note":
        noted = {"machine": here, "accuracy": ACCURACY, "checksums": results}
        write(options.file, noted)
        return
    noted = json.loads(options.file.read_text(encoding="utf-8"))
    if noted["machine"] != here:
        print(f"note: checksums are of another machine: {noted['machine']} instead of {here}")
    rows = [
        {"scene": scene, "result": name, "equal": noted["checksums"].get(scene, {}).get(name) == value}
        for scene, checksums in results.items()
        for name, value in checksums.items()
    ]
    different = [row for row in rows if not row["equal"]]
    for row in different:
        print(f"{row['scene']} {row['result']}: differs")
    print(f"{len(rows) - len(different)} of {len(rows)} results bit-equal")
    write(options.json, {"machine": here, "rows": rows})
    sys.exit(bool(different))


if __name__ == "__main__":
    main()
