"""What `mitsim calibrate --plan` promises against what sessions by its recipe come to.

    python benchmarks/plan_promise.py [-o promise.json] [--scenes NAME[:PATTERNS] ...] [--psnr DB ...] [--seeds N]
    python benchmarks/plan_promise.py --scenes resolution_target:dots:5 --psnr 35
    python benchmarks/plan_promise.py --scenes photograph:uniform --psnr 25

For each scene and wanted PSNR: the plan (seed 0), then another capture, another session's light, and N sessions by the
planned recipe in it, whose every frame is exposed with noise of its own, calibrated and reconstructed. Prints a row of
Markdown for each: predicted PSNR, the mean of the N images with its standard error, and their difference.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import mitsim as ms
from mitsim.calibrate.board_session import Session
from mitsim.calibrate.calibrate import estimate
from mitsim.calibrate.lit_session import LitSession
from mitsim.core.job import Job
from mitsim.core.manifests import CalibrationManifest
from mitsim.devices.sensor import digital_of
from mitsim.reconstruct.factors import Factors

HEAD = (
    "| scene, patterns | asked | fraction, repeats | predicted [dB] | mean of {seeds} sessions | minus predicted |\n"
    "|---|---|---|---|---|---|"
)


def session_psnrs(bench: Any, patterns: str, recipe: Any, seeds: range) -> list[float]:
    """PSNR [dB] of a capture with factors of a session of each of the ``seeds``, as `mitsim capture`, `calibrate` and
    `reconstruct` make them; responses without noise, which `calibrate` forms for its report alone, are left out."""
    shots = bench.capture(patterns, seed=seeds[0])
    session = Session(bench, recipe, seeds[0])
    lit = LitSession.of(session, session.trace(session.plan(1e-3, Job()), Job()), Job())
    manifest = CalibrationManifest(
        camera=bench.identity(),
        centre=session.centre,
        board_reflectance=recipe.board_reflectance,
        digital=digital_of(bench.sensor, lit.exposure_s),
    )
    found = []
    for seed in seeds:
        estimated, _ = estimate(replace(lit, session=replace(session, seed=seed)), Job())
        found.append(ms.psnr(ms.reconstruct(shots, Factors.of(estimated, manifest)).image, shots.truth))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--scenes", nargs="+", default=["photograph", "colour_chart", "resolution_target:dots:5"])
    parser.add_argument("--psnr", nargs="+", type=float, default=[30.0, 40.0])
    parser.add_argument("--seeds", type=int, default=6)
    asked = parser.parse_args()
    print(HEAD.format(seeds=asked.seeds), flush=True)
    rows: list[dict[str, Any]] = []
    for name in asked.scenes:
        scene, _, patterns = name.partition(":")
        patterns = patterns or "dots:7"
        bench = ms.open_bench(scene)
        for wanted in asked.psnr:
            plan = ms.plan_calibration(bench, wanted, patterns)
            first = 1 + asked.seeds * len(rows)
            seeds = range(first, first + asked.seeds)
            found = session_psnrs(bench, patterns, plan.recipe, seeds) if plan.reached else []
            rows.append({**plan.payload(), "scene": scene, "found": found, "seeds": list(seeds)})
            if asked.output:
                asked.output.write_text(json.dumps(rows, indent=1, default=str), encoding="utf-8")
            print(_row(scene, plan, found), flush=True)


def _row(scene: str, plan: ms.CalibrationPlan, found: list[float]) -> str:
    """A row of the table."""
    if not found:
        return f"| {scene}, {plan.patterns} | {plan.psnr_asked:g} | - | ceiling {plan.ceiling.psnr_db:.1f} | - | - |"
    mean, error = np.mean(found), np.std(found, ddof=1) / np.sqrt(len(found)) if len(found) > 1 else np.nan
    recipe = plan.recipe
    return (
        f"| {scene}, {plan.patterns} | {plan.psnr_asked:g} | {recipe.exposure_fraction:g}, {recipe.repeats} | "
        f"{plan.trial.psnr_db:.2f} | {mean:.2f} +- {error:.2f} | {mean - plan.trial.psnr_db:+.2f} |"
    )


if __name__ == "__main__":
    main()
