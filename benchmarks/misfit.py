"""Measure how the misfit detects a sheet beside the calibrated distance, and passes good runs: by family and seed.

    python benchmarks/misfit.py RESULT.json [--seeds 4] [--families ...] [--offsets -2 2 ...] [--prints ...]

The photograph's sheet stands beside the calibrated 400 mm by each of the offsets [mm]; prints of ``--prints`` stand at
400 mm. Light is traced once for each, and the camera is calibrated once; the noise of a run is that of its seed.
RESULT.json holds, for each print, offset and family, one entry a seed: what `misfit.summary()` reports, whether the
image is flagged, and the rms error of the image. An interrupted run is resumed. 4 seeds of four families, two offsets
and three prints are 80 images of 512 x 512 pixels.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.acquire.capture import expose
from mitsim.api.bench import open_bench
from mitsim.light.light import SampledLight
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import reconstruct

ROOT = Path(__file__).parent.parent
FAMILIES = ("uniform", "dots:4", "dots:7", "hadamard:8")
PRINTS = ("photograph", "colour_chart", "resolution_target")
DISTANCE = 400.0
"""Distance of the calibration's board and of the good prints [mm]."""


def light(name: str, offset: float) -> SampledLight:
    """Return the light of a shipped scene whose sheet is moved by ``offset`` [mm]."""
    scene = ROOT / "scenes" / name / "scene.xml"
    bench = open_bench(scene, sheet_z=f"{DISTANCE + offset:g}") if offset else open_bench(scene)
    return bench.light(accuracy=1e-3)


def judged(traced: SampledLight, family: str, seed: int, factors: Factors) -> dict[str, Any]:
    """Return what the misfit reports of one run."""
    shots = expose(traced, family, seed=seed)
    image = reconstruct(shots, factors)
    assert image.misfit is not None and shots.truth is not None
    found = image.misfit.summary()
    return {
        **{name: found[name] for name in ("chi_square", "unexplained", "worst_tile", "flagged", "cause")},
        "words": f"{image.status} {'; '.join(image.trust)}",
        "error": float(np.sqrt(np.mean(np.square(image.image - shots.truth)))),
    }


def line(case: str, runs: list[dict[str, Any]]) -> str:
    """Return one line of text for a case."""
    chi_square, unexplained = ([run[name] for run in runs] for name in ("chi_square", "unexplained"))
    causes = sorted({run["cause"] for run in runs if run["cause"]})
    return (
        f"{case:34s} {sum(run['flagged'] for run in runs)} of {len(runs)} flagged, chi-square {min(chi_square):.3f} to "
        f"{max(chi_square):.3f}, unexplained {min(unexplained):.1e} to {max(unexplained):.1e} {', '.join(causes)}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--families", nargs="+", default=FAMILIES)
    parser.add_argument("--offsets", nargs="*", type=float, default=(-2.0, 2.0))
    parser.add_argument("--prints", nargs="*", default=PRINTS)
    options = parser.parse_args()
    done = json.loads(options.result.read_text()) if options.result.is_file() else {}
    factors: Factors | None = None
    for name, offset in [("photograph", offset) for offset in options.offsets] + [(one, 0.0) for one in options.prints]:
        traced: SampledLight | None = None
        for family in options.families:
            case = f"{name} {offset:+g} mm {family}"
            runs = done.setdefault(case, [])
            for seed in range(len(runs), options.seeds):
                factors = factors or open_bench(ROOT / "scenes" / "photograph" / "scene.xml").calibrate(seed=0)
                traced = traced or light(name, offset)
                runs.append(judged(traced, family, seed, factors))
                options.result.write_text(json.dumps(done), encoding="utf-8")
            print(line(case, runs), flush=True)


if __name__ == "__main__":
    main()
