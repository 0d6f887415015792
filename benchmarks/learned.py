"""A trained network beside the best classical images, on the eight pictures of the studies, which no network is taught.

    python benchmarks/learned.py MODEL.pt [--idealised] [--patterns uniform] [--seed 0] [--images FOLDER]

Equal peak of the photograph's print: PSNR of the network, and the best that Tikhonov, Markov and total variation (with
bounds 0 and 1, and without) reach with the weight that is best for each picture. ``beyond``: part of the frames, beyond
noise, that the network's image would not give. The gain's standard error is that of the mean over pictures.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mitsim.core.images import png
from mitsim.learn.verbs import load_network
from mitsim.metrics import psnr
from mitsim.reconstruct.solver import Accumulator, Prepared
from mitsim.reconstruct.solvers import solve_tv
from mitsim.report import EQUAL_PEAK, IDEALISED, RENDERED
from mitsim.report.lit_scene import LAMBDAS
from mitsim.studies.framework.experiment import TEST_IMAGES, Setup
from mitsim.studies.framework.studio import Studio

WEIGHTS = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Of total variation, over the automatic one: the best of eight pictures lies between 1 and 4."""


def classical(model: Prepared, sums: Accumulator, truth: np.ndarray) -> dict[str, float]:
    """Best PSNR [dB] of each classical method."""
    found = {"tikhonov": max(psnr(model.solve(sums, model.problem(sums).scale * lam).image, truth) for lam in LAMBDAS)}
    automatic = solve_tv(model, sums, "auto").lam
    for name, bounds in (("tv", None), ("tv 0:1", (0.0, 1.0))):
        images = (solve_tv(model, sums, automatic * weight, bounds=bounds).image for weight in WEIGHTS)
        found[name] = max(psnr(image, truth) for image in images)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("--idealised", action="store_true")
    parser.add_argument("--patterns", default="uniform")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--images", type=Path)
    asked = parser.parse_args()
    network, gains = load_network(asked.model), []
    with Studio() as studio:
        for picture in TEST_IMAGES:
            kind = IDEALISED if asked.idealised else RENDERED
            frames = studio.frames(Setup().with_print(picture), kind, asked.patterns, asked.seed)
            model, sums = frames.data(frames.seconds(EQUAL_PEAK))
            truth, best = frames.lit.truth, classical(model, sums, frames.lit.truth)
            solution = network.compute(model, sums, "auto")
            own = psnr(solution.image, truth)
            gains.append(own - max(best.values()))
            others = ", ".join(f"{name} {value:.2f}" for name, value in best.items())
            print(f"{picture:10} network {own:.2f} dB, {others}; {' '.join(solution.status.flags)}", flush=True)
            if asked.images:
                asked.images.mkdir(exist_ok=True)
                (asked.images / f"{picture}.png").write_bytes(png(np.hstack([truth, solution.image])))
    error = float(np.std(gains, ddof=1) / np.sqrt(len(gains)))
    print(f"gain over the best classical image {np.mean(gains):+.2f} +- {error:.2f} dB")


if __name__ == "__main__":
    main()
