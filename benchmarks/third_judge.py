"""Frames of simple scenes against float64 rays that know neither Mitsuba nor mitsim.

    python benchmarks/third_judge.py --json FILE [--scenes NAME ...] [--accuracy 1e-2] [--spp 64]

Thirty scenes of rectangles, balls, wires, holes, a pane and mirrors (`tests/physics/judged_scenes.py`), twelve by hand
and the rest drawn by a seeded generator. A row each: relative difference over all shots of dots:3 and 16 sensor pixels
between the factored estimator and the judge (`tests/physics/third_judge.py`), that of their sums, what both state as
their errors, whether the difference is within them, and why the run is flagged; and the reference's sum in uniform
light over the judge's with its standard error, where the reference finds all light. FILE is written after each scene,
and what it holds is not done again.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # the judge lives with the tests

import mitsim as ms
from tests.physics import judged_scenes

if TYPE_CHECKING:
    from mitsim.capture.bench import Bench


def of_reference(judged: judged_scenes.Judged, bench: Bench, right: float, spp: int) -> dict[str, Any]:
    """Sum of the reference over the judge's, ``right``, less 1, and its standard error; empty where light is lost."""
    shapes = judged.scene.shapes
    if judged.scene.pane or any(shape.mirror for shape in shapes) or bench.loaded.unfit.reference is not None:
        return {}
    rows, columns = np.array(judged_scenes.POINTS).T
    frame = bench.render("reference", spp=spp)
    error = float(np.sqrt(np.square(frame.error[rows, columns]).sum()) / right)
    return {"reference": float(frame.mean[rows, columns].sum() / right - 1), "reference_error": error}


def row(name: str, accuracy: float, spp: int) -> dict[str, Any]:
    """Verdict of one scene."""
    judged = judged_scenes.scenes()[name]
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        try:
            bench = judged_scenes.opened(judged, Path(folder), ms.open_bench)
        except ms.MitsimError as error:
            return {"scene": name, "refused": str(error).replace(folder, "")}
        found = judged_scenes.verdict(judged, bench, accuracy=accuracy)
        reference = of_reference(judged, bench, found.right, spp) if spp else {}
    seconds = time.perf_counter() - started
    return {"scene": name, **asdict(found), "agrees": found.agrees, **reference, "seconds": round(seconds, 1)}


def main() -> None:
    """Judge the scenes; exit status 1 where one disagrees."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--scenes", nargs="+", choices=list(judged_scenes.scenes()), metavar="NAME")
    parser.add_argument("--accuracy", type=float, default=1e-2)
    parser.add_argument("--spp", type=int, default=64, help="of the reference; 0 leaves it out")
    options = parser.parse_args()
    rows = json.loads(options.json.read_text(encoding="utf-8")) if options.json.exists() else []
    known = {each["scene"] for each in rows}
    for name in options.scenes or judged_scenes.scenes():
        if name not in known:
            rows.append(row(name, options.accuracy, options.spp))
            options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
            print(json.dumps(rows[-1]), flush=True)
    agreeing = sum(each.get("agrees", False) for each in rows)
    print(f"{agreeing} of {len(rows)} agree")
    sys.exit(agreeing < len(rows))


if __name__ == "__main__":
    main()
