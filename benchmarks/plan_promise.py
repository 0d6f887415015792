"""What `mitsim calibrate --plan` promises against what sessions by its recipe come to.

    python benchmarks/plan_promise.py [--json promise.json] [--scenes NAME[:PATTERNS] ...] [--psnr DB ...] [--seeds N]
    python benchmarks/plan_promise.py --scenes resolution_target:dots:5 --psnr 35
    python benchmarks/plan_promise.py --scenes photograph:uniform --psnr 25

For each scene and wanted PSNR: the plan (seed 0), then another capture, another session's light, and N sessions by the
planned recipe in it, whose every frame is exposed with noise of its own, calibrated and reconstructed. Prints a row of
Markdown for each: predicted PSNR, the mean of the N images with its standard error, and their difference.

    python benchmarks/plan_promise.py --seconds photograph corner ... [--sensor 32 512]

``--seconds``: instead, predicted and measured seconds of transport of scenes (dots:4, accuracy 1e-2), with so many
pixels a side: a later light, a first one, and what plan and first light took to compile kernels (with an empty HOME,
all of them). Needs an idle machine.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from accuracy import small
from harness import arguments, write

import mitsim as ms
from mitsim.calibrate.board_session import Session
from mitsim.calibrate.calibrate import estimate
from mitsim.calibrate.lit_session import LitSession
from mitsim.core.job import Job, compiled_kernels
from mitsim.core.manifests import CalibrationManifest
from mitsim.devices.sensor import digital_of
from mitsim.light.light import Sampling, trace_light
from mitsim.planner.planner import make_plan
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


def transport(scene: str, side: int | None, projector: str | None) -> str:
    """A row of predicted and measured seconds of transport."""
    given: dict[str, Any] = {"projector": projector} if projector else {}
    bench = ms.open_bench(scene, for_render=True, **given)
    if side:
        with tempfile.TemporaryDirectory() as folder:
            bench = ms.open_bench(small(Path(bench.loaded.path), side, Path(folder)), for_render=True, **given)
    lighting, compiled = bench.family("dots:4").lighting, [compiled_kernels().seconds]
    plan = make_plan(bench, lighting, 1e-2, 1)
    compiled.append(compiled_kernels().seconds)
    taken = []
    for seed in (2, 3):
        started = time.perf_counter()
        trace_light(bench, plan, lighting, seed, Sampling(by_pixel=False))
        taken.append(time.perf_counter() - started)
        compiled.append(compiled_kernels().seconds)
    predicted = plan.predicted["transport"]
    of_plan, of_light = compiled[1] - compiled[0], compiled[2] - compiled[1]
    return (
        f"| {Path(scene).parent.name or scene}, {side or 'as it is'} | {predicted:.2f} | {taken[1]:.2f} | "
        f"{predicted / taken[1]:.2f} | {taken[0]:.2f} | {of_plan:.1f}, {of_light:.1f} |"
    )


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--scenes", nargs="+", default=["photograph", "colour_chart", "resolution_target:dots:5"])
    parser.add_argument("--psnr", nargs="+", type=float, default=[30.0, 40.0])
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--seconds", nargs="+", metavar="SCENE")
    parser.add_argument("--sensor", nargs="+", type=int, default=[None])
    parser.add_argument("--projector")
    asked = parser.parse_args()
    if asked.seconds:
        print("| scene, pixels | predicted [s] | later run [s] | ratio | first run [s] | compiling: plan, light [s] |")
        print("|---|---|---|---|---|---|")
        for scene in asked.seconds:
            for side in asked.sensor:
                print(transport(scene, side, asked.projector), flush=True)
        return
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
            write(asked.json, rows)
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
