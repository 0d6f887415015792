"""Coded illumination with a diffuser camera: image quality by pattern family, the direct solver against iterations.

    python benchmarks/convolutional.py PICTURE [--json FILE] [--seed 0] [--reduce 4] [--part speed quality]
        [--sensor whole cropped] [--periods 1 2 3 5 7]

PICTURE shows the point spread function, such as `psf_sample.tif` of the repository Waller-Lab/DiffuserCam-Tutorial (BSD
3-Clause); ``rendered`` takes that of a diffuser that Mitsuba traces (mitsim.transport.plugins.diffuser). A scene of 128
x 128 pixels; the sensor is as large as the picture (cropped), or gets all light (whole); electronics of
calibration/imx249.toml.

Quality: PSNR at the best lambda to a quarter of a decade, peak 1, no gain or offset fit; under equal peak and equal
frame exposure (mitsim.report.lit_scene).

Speed: CPU seconds on one thread, all within this run. Iterative: conjugate gradients on frames, to two marks: an error
against the truth within 1 % of the direct solution's (0.09 dB; residual 1e-6), and a difference from it below 1e-6
(`exact`). Direct: `prepare` is what is done once for a camera, a family and a lambda; every set of frames takes the
rest, their transforms included. Both solve for the lambda that is best for the first photograph on the whole sensor.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from anchor_psnr import photograph
from solver import dots, frames_of, paper_factor, summed

from mitsim.core.configuration import shipped_path
from mitsim.core.parallel import single_threaded_blas
from mitsim.devices.mask_profile import load_psf
from mitsim.devices.patterns import parse_patterns
from mitsim.devices.sensor import load_sensor
from mitsim.reconstruct.convolution import Classes
from mitsim.reconstruct.point_spread import ShiftedLight
from mitsim.reconstruct.solver import prepare
from mitsim.report import CONVENTIONS
from mitsim.studies.convolutional_study import best_image, race, take

N = 128
PERIODS = (1, 2, 3, 5, 7)
PHOTOGRAPHS = ("astronaut", "camera", "coffee")


Row = dict[str, object]
Case = tuple[bool, int]
"""Whether the sensor crops, and the dots' period."""


def camera_of(psf: np.ndarray, cropped: bool) -> ShiftedLight:
    return ShiftedLight.of(psf, N, psf.shape if cropped else None)


def quality(psf: np.ndarray, case: Case, seed: int) -> Iterator[Row]:
    """PSNR of every photograph and convention."""
    sensor, (cropped, k) = load_sensor(shipped_path("calibration", "imx249.toml")), case
    classes = Classes(camera_of(psf, cropped), k)
    for convention in CONVENTIONS[: 2 if k > 1 else 1]:
        for name in PHOTOGRAPHS:
            truth = photograph(name, False)
            shots = take(classes.camera, parse_patterns(f"dots:{k}", N), truth, sensor, convention, seed)
            solution, db = best_image(classes, shots, truth)
            yield {
                "convention": convention,
                "image": name,
                "psnr_db": round(db, 2),
                "lambda_relative": solution.lam / classes.largest,
                "saturated": shots.saturated,
            }


def speed(psf: np.ndarray, case: Case, seed: int) -> Iterator[Row]:
    """CPU seconds of both solvers (mitsim.studies.convolutional_study.race)."""
    sensor, truth = load_sensor(shipped_path("calibration", "imx249.toml")), photograph(PHOTOGRAPHS[0], False)
    classes, whole = (Classes(camera_of(psf, cropped), case[1]) for cropped in (case[0], False))
    row = race(classes, whole, truth, sensor, seed)
    for mark in ("", "_exact"):
        ours, theirs = row[f"direct{mark}_s"], row[f"iterative{mark}_s"]
        row |= {f"speedup{mark}": theirs / ours, f"speedup{mark}_with_prepare": theirs / (ours + row["prepare_s"])}
    yield {"factorised": classes.factorised, **row}


def separable_seconds() -> float:
    """CPU seconds of the separable solver for 49 frames of 512 x 512, prepared before."""
    factor, patterns = paper_factor(), dots(N, 7)
    frames = frames_of(factor, patterns, np.random.default_rng(0).random((N, N)))
    prepared = prepare(factor, factor, patterns, patterns)
    start = time.process_time()
    prepared.solve(summed(prepared, frames), 1e-3)
    return time.process_time() - start


def rendered(reduce: int) -> np.ndarray:
    """Point spread function of a traced diffuser, at the size of the measured one."""
    from mitsim.core.environment import load_variant

    load_variant("llvm_ad_mono")
    from mitsim.transport.plugins.diffuser import Diffuser, point_spread

    return point_spread(Diffuser(), (1200 // reduce, 1600 // reduce), 5.86e-3 * reduce)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture")
    parser.add_argument("--json", help="write the figures to this file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--reduce", type=int, default=4)
    parser.add_argument("--part", choices=("quality", "speed"), nargs="+", default=("speed", "quality"))
    parser.add_argument("--sensor", choices=("whole", "cropped"), nargs="+", default=("whole", "cropped"))
    parser.add_argument("--periods", type=int, nargs="+", default=PERIODS)
    options = parser.parse_args()
    psf = rendered(options.reduce) if options.picture == "rendered" else load_psf(options.picture, options.reduce)
    report: dict[str, Any] = {"seed": options.seed, "psf": list(psf.shape), "n": N, "load": os.getloadavg()[0]}
    with single_threaded_blas():
        if "speed" in options.part:
            report["separable_solve_s"] = separable_seconds()
        for part, sensor, k in product(options.part, options.sensor, options.periods):
            for row in {"quality": quality, "speed": speed}[part](psf, (sensor == "cropped", k), options.seed):
                rows = report.setdefault(part, [])
                rows.append({"sensor": sensor, "patterns": k * k, **row})
                print(part, rows[-1], flush=True)
                if options.json:
                    Path(options.json).write_text(json.dumps(report, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
