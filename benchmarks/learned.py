"""A trained network beside the best classical images, on the eight pictures of the studies, which no network is taught.

    python benchmarks/learned.py MODEL.pt [--idealised] [--patterns uniform] [--seed 0] [--images FOLDER]

Equal peak of the photograph's print: PSNR of the network, and the best that Tikhonov, Markov, nonnegative and total
variation (with bounds 0 and 1, and without) reach with the weight that is best for each picture. The network's gain is
told over each, and over whichever is best for each picture; standard errors are those of means over pictures.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from mitsim.core.images import png
from mitsim.learn.verbs import load_network
from mitsim.metrics import psnr
from mitsim.reconstruct.solver import Accumulator, Prepared
from mitsim.reconstruct.solvers import solve_nonnegative, solve_tv
from mitsim.report import EQUAL_PEAK, IDEALISED, RENDERED
from mitsim.report.lit_scene import LAMBDAS, accumulate
from mitsim.studies.framework.experiment import TEST_IMAGES, Setup
from mitsim.studies.framework.studio import Studio

WEIGHTS = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Of total variation, over the automatic one: the best of eight pictures lies between 1 and 4."""


def classical(model: Prepared, sums: Accumulator, alike: Accumulator, truth: np.ndarray) -> dict[str, float]:
    """Best PSNR [dB] of each classical method; ``alike`` are the frames for images whose neighbours are alike."""

    def best(images: Iterable[np.ndarray]) -> float:
        return max(psnr(image, truth) for image in images)

    scale, automatic = model.problem(sums).scale, solve_tv(model, sums, "auto").lam
    markov = alike.prepared.problem(alike).scale
    return {
        "tikhonov": best(model.solve(sums, scale * lam).image for lam in LAMBDAS),
        "markov": best(alike.prepared.solve(alike, markov * lam).image for lam in LAMBDAS),
        "nonnegative": best(solve_nonnegative(model, sums, scale * lam).image for lam in LAMBDAS),
        "tv": best(solve_tv(model, sums, automatic * weight).image for weight in WEIGHTS),
        "tv 0:1": best(solve_tv(model, sums, automatic * weight, bounds=(0.0, 1.0)).image for weight in WEIGHTS),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("--idealised", action="store_true")
    parser.add_argument("--patterns", default="uniform")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--images", type=Path)
    asked = parser.parse_args()
    network, gains, seconds = load_network(asked.model), [], []
    with Studio() as studio:
        for picture in TEST_IMAGES:
            kind = IDEALISED if asked.idealised else RENDERED
            frames = studio.frames(Setup().with_print(picture), kind, asked.patterns, asked.seed)
            model, truth = frames.prepare(), frames.lit.truth
            exposed = frames.exposer(frames.seconds(EQUAL_PEAK))
            both = [model, model.with_correlation()]
            sums, alike = accumulate(exposed, frames.family, frames.expected, both)
            best = classical(model, sums, alike, truth)
            started = time.perf_counter()
            solution = network.compute(model, sums, "auto")
            seconds.append(time.perf_counter() - started)
            own = psnr(solution.image, truth)
            gains.append([own - value for value in best.values()])
            others = ", ".join(f"{name} {value:.2f}" for name, value in best.items())
            print(f"{picture:10} network {own:.2f} dB, {others}; {' '.join(solution.status.flags)}", flush=True)
            if asked.images:
                asked.images.mkdir(exist_ok=True)
                (asked.images / f"{picture}.png").write_bytes(png(np.hstack([truth, solution.image])))
    by_method = np.array(gains).T
    for name, one in (*zip(best, by_method, strict=True), ("the best of each picture", by_method.min(axis=0))):
        error = np.std(one, ddof=1) / np.sqrt(len(one))
        print(f"gain over {name} {np.mean(one):+.2f} +- {error:.2f} dB")
    print(f"{np.median(seconds):.2f} s an image")


if __name__ == "__main__":
    main()
