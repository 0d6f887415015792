"""Frames of simple scenes against float64 rays that know neither Mitsuba nor mitsim.

    python benchmarks/third_judge.py --json FILE [--scenes NAME ...] [--accuracy 1e-2]
    python benchmarks/third_judge.py --json FILE --reference 1024 [--scenes NAME ...]
    python benchmarks/third_judge.py --json FILE --hidden 10 [--scenes NAME ...] [--accuracy 1e-2]

Thirty scenes of rectangles, balls, rods, holes, a pane and mirrors (`tests/physics/judged_scenes.py`), ten by hand
and the rest drawn by a seeded generator. A row each: relative difference over all shots of dots:3 and 16 sensor pixels
between the factored estimator and the judge (`tests/physics/third_judge.py`), that of their sums, what both state as
their errors, whether the difference is within them, and why the run is flagged. With --reference, the reference's light
over an unmasked sensor, of so many samples a pixel, in uniform light: its sum over the judge's, both standard errors,
and z of the sixteenth of the sensor that is furthest off; three standard errors are allowed of the sum, four of a part.
Mirrors are matt there and the pane is left out, for paths do not meet a pinhole over them. With --hidden, eleven scenes
whose caustics are seen over mirrors or curved glass (`tests/physics/hidden_light.py`): at how many of so many seeds the
plan is flagged, and the part of the light that it says is left out, over the true one. FILE is written after each
scene, and what it holds is not done again.
"""

from __future__ import annotations

import re
import sys
import tempfile
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from harness import arguments, held, show, write

import mitsim as ms
from mitsim.api.bench import open_bench
from mitsim.devices.patterns import Lighting
from mitsim.planner.planner import make_plan
from tests.physics import hidden_light, judged_scenes
from tests.physics import third_judge as judge


def of_reference(name: str, spp: int) -> dict[str, Any]:
    """The reference's light of one scene over the judge's, whole and in parts."""
    judged = judged_scenes.scenes()[name]
    shapes = [
        replace(shape, albedo=shape.mirror, mirror=0.0) if shape.mirror else shape for shape in judged.scene.shapes
    ]
    scene = replace(judged.scene, camera=judged_scenes.OPEN, shapes=shapes, pane=None)
    judged = replace(judged, scene=scene)
    with tempfile.TemporaryDirectory() as folder:
        try:
            frame = judged_scenes.opened(judged, Path(folder), ms.open_bench).render("reference", spp=spp)
        except ms.MitsimError as error:
            return {"scene": name, "refused": str(error).replace(folder, "")}
    side = scene.camera.pixels // 4
    middles = [((i + 0.5) * side - 0.5, (j + 0.5) * side - 0.5) for i, j in np.ndindex(4, 4)]
    right = judge.answer(scene, middles, None, judged.k, judged.fine)
    parts, variance = (each.reshape(4, side, 4, side) for each in (frame.mean, np.square(frame.error)))
    mean, noise = parts.mean(axis=(1, 3)).ravel(), np.sqrt(variance.sum(axis=(1, 3))).ravel() / side**2
    own = right.error * right.light[0]
    whole = float(mean.sum() / right.light.sum() - 1)
    of_whole = float(np.sqrt(np.square(noise).sum()) / right.light.sum())
    worst = float(np.abs((mean - right.light[0]) / np.hypot(noise, own)).max())
    return {
        "scene": name,
        "total": whole,
        "error": of_whole,
        "uncertain": right.error,
        "worst_part": worst,
        "agrees": abs(whole) <= 3 * float(np.hypot(of_whole, right.error)) and worst <= 4,
    }


def of_hidden(name: str, seeds: int, accuracy: float) -> dict[str, Any]:
    """Plans of one scene whose light no tracer finds: flags, and the part left out over the true one."""
    scene, effects = hidden_light.SCENES[name], {"diffraction": False}
    true, stated = scene.light(), []
    with tempfile.TemporaryDirectory() as folder:
        bench = open_bench(scene.write(Path(folder), "hidden"), for_render=True)
        found = float(bench.render("factored", accuracy=accuracy, effects=effects).mean.mean())
        for seed in range(seeds):
            warnings = " ".join(make_plan(bench, Lighting.uniform(bench.n), accuracy, seed, effects).warnings)
            part = re.search(r"([-+.e\d]+) of the light comes over it", warnings)
            stated.append(float(part[1]) if part else 0.0)
    part_left_out = true / (true + found)
    over = [each / part_left_out for each in stated]
    return {
        "scene": name,
        "true": true,
        "part": part_left_out,
        "flagged": sum(each > 0 for each in stated),
        "least": min(over),
        "most": max(over),
        "agrees": min(over) > 0.5 and max(over) < 2,
    }


def row(name: str, accuracy: float) -> dict[str, Any]:
    """Verdict of one scene."""
    judged = judged_scenes.scenes()[name]
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        try:
            bench = judged_scenes.opened(judged, Path(folder), ms.open_bench)
        except ms.MitsimError as error:
            return {"scene": name, "refused": str(error).replace(folder, "")}
        found = judged_scenes.verdict(judged, bench, accuracy=accuracy)
    seconds = time.perf_counter() - started
    return {"scene": name, **asdict(found), "agrees": found.agrees, "seconds": round(seconds, 1)}


def main() -> None:
    """Judge the scenes; exit status 1 where one disagrees."""
    parser = arguments(__doc__, required=True)
    parser.add_argument("--scenes", nargs="+", metavar="NAME", help="all, if not given")
    parser.add_argument("--accuracy", type=float, default=1e-2)
    parser.add_argument("--reference", type=int, metavar="SPP", help="judge the reference")
    parser.add_argument("--hidden", type=int, metavar="SEEDS", help="judge what plans say of light that none finds")
    options = parser.parse_args()
    scenes = hidden_light.SCENES if options.hidden else judged_scenes.scenes()
    unknown = set(options.scenes or ()) - set(scenes)
    if unknown:
        parser.error(f"no scene {', '.join(sorted(unknown))}; there are {', '.join(scenes)}")
    rows = held(options.json, [])
    known = {each["scene"] for each in rows}
    for name in options.scenes or scenes:
        if name not in known:
            spp, seeds = options.reference, options.hidden
            if seeds:
                rows.append(of_hidden(name, seeds, options.accuracy))
            else:
                rows.append(of_reference(name, spp) if spp else row(name, options.accuracy))
            write(options.json, rows)
            show(name, rows[-1])
    agreeing = sum(each.get("agrees", False) for each in rows)
    print(f"{agreeing} of {len(rows)} agree")
    sys.exit(agreeing < len(rows))


if __name__ == "__main__":
    main()
