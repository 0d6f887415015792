"""Factor error of `calibrate --known` against the number of pictures and photons, on cameras whose codes were drawn.

    python benchmarks/known_pictures.py [--seeds 1 2 3 4 5] [--json FILE]

Codes of random features of 3 pixels, 64 x 72 pixels, 20 x 20 scene pixels, random pictures under even light, read noise
of 5 electrons (`tests/known_camera.py`). Stated are medians over the seeds of the relative error of both factors
together, of what the calibration states of it, how many runs took the right orientation and were not flagged, and
seconds of processor. One code a side; orientation and scales are found.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from mitsim import calibrate_known
from tests.known_camera import KnownCamera, factor_error

CASES = ((1, 3e4), (2, 3e4), (4, 3e4), (8, 3e4), (4, 3e3), (4, 3e5))
"""Pictures, and electrons of a pixel in a frame of a white picture."""


def calibrated(seed: int, pictures: int, electrons: float) -> dict[str, Any]:
    """One camera's calibration."""
    camera = KnownCamera(seed, electrons)
    with tempfile.TemporaryDirectory() as folder:
        listed = camera.write_session(Path(folder), pictures, terms=1)
        begin = time.process_time()
        (factors,) = calibrate_known(listed).values()
    result = factors.manifest.result
    return {
        "error": float(np.hypot(*factor_error((factors.left, factors.right), camera.factors()))),
        "stated": result["predicted_phi_error"],
        "upright": result["orientation"] == "upright",
        "ok": factors.ok,
        "seconds": time.process_time() - begin,
    }


def main() -> None:
    """Print a line for each case, and write all numbers."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = []
    print(
        "| pictures | electrons a pixel | error | stated | upright | not flagged | s |\n|---|---|---|---|---|---|---|"
    )
    for pictures, electrons in CASES:
        runs = [calibrated(seed, pictures, electrons) for seed in options.seeds]
        row: dict[str, Any] = {"pictures": pictures, "electrons": electrons, "seeds": options.seeds}
        for name in ("error", "stated", "seconds"):
            row[name] = float(np.median([run[name] for run in runs]))
            row[f"{name}_of_each"] = [run[name] for run in runs]
        row |= {name: sum(run[name] for run in runs) for name in ("upright", "ok")}
        rows.append(row)
        print(
            f"| {pictures} | {electrons:.0e} | {row['error']:.3f} | {row['stated']:.3f} | {row['upright']} of "
            f"{len(runs)} | {row['ok']} of {len(runs)} | {row['seconds']:.1f} |",
            flush=True,
        )
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
