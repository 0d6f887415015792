"""Measured total error of `mitsim capture` against an independent answer, and its seconds, predicted and taken.

    python benchmarks/accuracy.py --json FILE [--scene photograph ...] [--accuracy 1e-2 ...] [--old PATH]

The answer is light of two other seeds with every effect of the scene, one step finer in anchors, layers, cells and
coarse cells than the plan at 3e-4. With r1, r2 its two halves, <a - r1, a - r2> / <r1, r2> is the
squared error of all frames a without the noise of the answer; its standard error is the jackknife's over shots.
Captures are processes of their own, from the shell to their exit. ``--old`` names a checkout of an earlier version to
be timed and judged beside this one. What FILE and the answers beside it hold already is not repeated, so the work can
be cut short at any time; ``--answers`` makes those alone, which need no idle machine. ``--seeds N`` tells of how many
captures with other seeds the error lies within the accuracy, and below the bound that the run states; it is not timed.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import mitsim as ms
from mitsim.capture.choice import predicted
from mitsim.capture.evidence import Estimate
from mitsim.capture.exposer import Exposer
from mitsim.capture.light import Sampling, trace_light
from mitsim.capture.planning import make_plan
from mitsim.core.framefile import read_frame
from mitsim.core.job import Job
from mitsim.core.seeds import integer
from mitsim.optics.frames import monte_carlo_bound, monte_carlo_error
from mitsim.study.knobs import Stand

SCENES = (
    *("photograph", "colour_chart", "resolution_target", "keystone", "gift_card", "corner", "cards", "metal_blade"),
    *("compact_disc", "mirror", "lamp_bench", "cookie_bag"),
)
PATTERNS, ACCURACIES = "dots:7", (1e-2, 3e-3, 1e-3, 3e-4)
FINEST, NOISE = 3e-4, 1e-3
"""Accuracy whose settings the answer goes one step beyond, and the Monte Carlo error of each of its halves, whose own
energy drops out."""
SEEN = 3
"""How many times as closely the pilot of the answer looks, so that more pixels count as occluded, and more is tried."""
_OLD_START = "import sys; from mitsim.cli import main; sys.exit(main())"
SEED, ANSWERS = 0, (811, 812)
Frames = npt.NDArray[np.floating[Any]]


def answer(scene: str, noise: float) -> npt.NDArray[np.float32]:
    """(2, shots, pixels, pixels) irradiance of all shots in two independent halves."""
    bench = ms.open_bench(scene)
    family = bench.family(PATTERNS, SEED)
    stand = Stand(bench, family, ANSWERS[0], Job(), FINEST / SEEN)
    finest = stand.finest(stand.plan(FINEST))
    samples = predicted(noise, stand.evidence, finest.settings, {}).settings
    plan = replace(finest, settings=samples, sampling_target=noise)
    halves = []
    for seed in ANSWERS:
        light = trace_light(bench, plan, family.lighting, integer(seed, "answer"), Sampling(by_pixel=False)).merged()
        halves.append([frame.irradiance.astype(np.float32) for frame in light.frames(family.lighting, 0)])
    return np.array(halves)


def captured(scene: str, accuracy: float, tree: Path | None) -> dict[str, Any]:
    """Seconds and manifest of a capture by the version in ``tree`` (this one without), and its frames."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        command = [
            sys.executable,
            *(["-c", _OLD_START] if tree else ["-m", "mitsim"]),
            "capture",
            scene,
            "--patterns",
            PATTERNS,
            "--seed",
            str(SEED),
        ]
        command += ["--accuracy", str(accuracy), "-o", str(run), "--json"]
        path = {"PYTHONPATH": str(tree)} if tree else {}
        started = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **path}, cwd=folder)
        seconds = time.perf_counter() - started
        if not (run / "manifest.json").exists():
            raise SystemExit(f"{scene} at {accuracy:g}: {done.stderr}")
        manifest = json.loads((run / "manifest.json").read_text())
        frames = [read_frame(run / shot["file"])[0]["electrons"] for shot in manifest["patterns"]["captures"]]
    exposure = manifest.get("digital", manifest)["exposure_s"]
    return {"seconds": seconds, "manifest": manifest, "frames": np.stack(frames), "exposure_s": exposure}


def squared_error(frames: Frames, halves: Frames) -> tuple[float, float]:
    """Squared relative error of ``frames`` and its standard error, by the jackknife over shots."""
    first, second = halves
    each = zip(frames.astype(np.float64), first, second, strict=True)
    products, energies = np.array([[((a - r) * (a - s)).sum(), (r * s).sum(dtype=np.float64)] for a, r, s in each]).T
    without = (products.sum() - products) / (energies.sum() - energies)
    count = len(products)
    spread = np.sqrt((count - 1) / count * np.square(without - without.mean()).sum())
    return float(products.sum() / energies.sum()), float(spread)


def judged(scene: str, accuracy: float, halves: Frames, tree: Path | None) -> dict[str, Any]:
    """One capture, held against the answer."""
    run = captured(scene, accuracy, tree)
    bench = ms.open_bench(scene)
    unit = float(Exposer(bench.rig, run["exposure_s"], 0).electrons(_Unit()))
    square, spread = squared_error(run["frames"] / unit, halves)
    manifest = run["manifest"]
    plan = manifest["plan"]
    return {
        "error": float(np.sqrt(max(square, 0))),
        "low": float(np.sqrt(max(square - 2 * spread, 0))),
        "high": float(np.sqrt(max(square + 2 * spread, 0))),
        "seconds": run["seconds"],
        "predicted_seconds": plan["predicted_seconds"],
        **{name: manifest.get(name) for name in ("total_error", "total_error_bound", "mc_error", "warnings")},
        "stages": manifest["seconds"],
        "predicted": plan.get("predicted"),
        "settings": plan["settings"],
    }


def covered(scene: str, accuracy: float, seeds: int, halves: Frames) -> dict[str, Any]:
    """Errors and stated bounds of captures with ``seeds`` other seeds, and how many hold."""
    bench, rows = ms.open_bench(scene), []
    for seed in range(1, seeds + 1):
        family = bench.family(PATTERNS, SEED)
        plan = make_plan(bench, family.lighting, accuracy, seed)
        expected = trace_light(bench, plan, family.lighting, seed, Sampling(by_pixel=False)).frames(family.lighting, 0)
        square, _ = squared_error(np.array([frame.irradiance for frame in expected]), halves)
        noise = Estimate(monte_carlo_error(expected), monte_carlo_bound(expected))
        rows.append((math.sqrt(max(square, 0)), *plan.total(noise)))
    errors, totals, bounds = np.array(rows).T
    return {
        "seeds": seeds,
        "within_accuracy": int((errors <= accuracy).sum()),
        "within_bound": int((errors <= bounds).sum()),
        "errors": errors.tolist(),
        "totals": totals.tolist(),
        "bounds": bounds.tolist(),
    }


class _Unit:
    """A frame of 1 W m^-2."""

    irradiance = 1.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--scene", action="append", default=[])
    parser.add_argument("--accuracy", action="append", type=float, default=[])
    parser.add_argument("--old", type=Path)
    parser.add_argument("--answers", action="store_true")
    parser.add_argument("--seeds", type=int, default=0)
    parser.add_argument("--noise", type=float, default=NOISE)
    options = parser.parse_args()
    found = json.loads(options.json.read_text()) if options.json.exists() else {}
    for scene in options.scene or SCENES:
        rows = found.setdefault(scene, {})
        kept = options.json.with_suffix(f".{Path(scene).stem}.npy")
        if not kept.exists():
            np.save(kept, answer(scene, options.noise))
        for accuracy in (options.accuracy or ACCURACIES) if options.seeds else ():
            if (key := f"seeds {accuracy:g}") not in rows:
                rows[key] = row = covered(scene, accuracy, options.seeds, np.load(kept))
                print(f"{scene} {accuracy:g}: within {row['within_accuracy']}, {row['within_bound']} of {row['seeds']}")
                options.json.write_text(json.dumps(found, indent=1))
        for accuracy in () if options.answers or options.seeds else options.accuracy or ACCURACIES:
            for name, tree in (("new", None), ("old", options.old)):
                key = f"{name} {accuracy:g}"
                if key in rows or (name == "old" and tree is None):
                    continue
                rows[key] = row = judged(scene, accuracy, np.load(kept), tree)
                said = f"error {row['error']:.2e} [{row['low']:.1e}, {row['high']:.1e}]"
                print(
                    f"{scene} {key}: {said}, {row['seconds']:.1f} s, predicted {row['predicted_seconds']:.1f}",
                    flush=True,
                )
                options.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
