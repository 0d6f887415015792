"""A trained network beside the best classical images, on the eight pictures of the studies, which no network is taught.

    python benchmarks/learned.py MODEL.pt [--idealised] [--patterns uniform] [--seed 0] [--images FILE.png]

Equal peak of the photograph's print: PSNR of the network, and the best that Tikhonov, Markov, nonnegative and total
variation (with bounds 0 and 1, and without) reach. The network's gain is told over each at the weight that is best for
each picture, which takes the truth to choose, and at the one that is best in the mean; and over whichever method is
best for each picture. Standard errors are those of means over pictures.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from mitsim.learn.verbs import load_network
from mitsim.metrics import psnr
from mitsim.reconstruct.solution import Solution
from mitsim.reconstruct.solver import Accumulator, Prepared
from mitsim.reconstruct.solvers import solve_nonnegative, solve_tv
from mitsim.report import EQUAL_PEAK, IDEALISED, RENDERED
from mitsim.report.lit_scene import LAMBDAS, accumulate
from mitsim.studies.framework.experiment import TEST_IMAGES, Setup
from mitsim.studies.framework.studio import Studio

WEIGHTS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0)
"""Of total variation, over the automatic one."""


def classical(model: Prepared, sums: Accumulator, alike: Accumulator, truth: np.ndarray) -> dict[str, list[float]]:
    """PSNR [dB] of each classical method by weight; ``alike`` are the frames for images whose neighbours are alike."""

    def judge(images: Iterable[Solution]) -> list[float]:
        return [psnr(solution.image, truth) for solution in images]

    scale, automatic = model.problem(sums).scale, solve_tv(model, sums, "auto").lam
    markov = alike.prepared.problem(alike).scale
    return {
        "tikhonov": judge(model.solve(sums, scale * lam) for lam in LAMBDAS),
        "markov": judge(alike.prepared.solve(alike, markov * lam) for lam in LAMBDAS),
        "nonnegative": judge(solve_nonnegative(model, sums, scale * lam) for lam in LAMBDAS),
        "tv": judge(solve_tv(model, sums, automatic * weight) for weight in WEIGHTS),
        "tv, automatic": judge([solve_tv(model, sums)]),
        "tv 0:1": judge(solve_tv(model, sums, automatic * weight, bounds=(0.0, 1.0)) for weight in WEIGHTS),
    }


def told(gains: np.ndarray) -> str:
    """The mean of ``gains`` [dB] over pictures, with its standard error."""
    return f"{gains.mean():+.2f} +- {gains.std(ddof=1) / np.sqrt(len(gains)):.2f} dB"


def draw(path: Path, shown: list[tuple[tuple[str, np.ndarray], ...]]) -> None:
    """Truth, total variation at its automatic weight, and the network's image of each picture."""
    figure, axes = plt.subplots(3, len(shown), figsize=(1.5 * len(shown), 5.2), layout="constrained", squeeze=False)
    for column, images in enumerate(shown):
        for row, (words, image) in enumerate(images):
            axes[row, column].imshow(image, cmap="gray", vmin=0, vmax=1)
            axes[row, column].set(title=words, xticks=[], yticks=[])
    for row, words in enumerate(("truth", "total variation", "network")):
        axes[row, 0].set_ylabel(words)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("--idealised", action="store_true")
    parser.add_argument("--patterns", default="uniform")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--images", type=Path)
    asked = parser.parse_args()
    network, seconds = load_network(asked.model), list[float]()
    gains: dict[str, list[np.ndarray]] = {}
    shown = list[tuple[tuple[str, np.ndarray], ...]]()
    with Studio() as studio:
        for picture in TEST_IMAGES:
            kind = IDEALISED if asked.idealised else RENDERED
            frames = studio.frames(Setup().with_print(picture), kind, asked.patterns, asked.seed)
            model, truth = frames.prepare(), frames.lit.truth
            exposed = frames.exposer(frames.seconds(EQUAL_PEAK))
            both = [model, model.with_correlation()]
            sums, alike = accumulate(exposed, frames.family, frames.expected, both)
            found = classical(model, sums, alike, truth)
            started = time.perf_counter()
            solution = network.compute(model, sums, "auto")
            seconds.append(time.perf_counter() - started)
            own = psnr(solution.image, truth)
            for name, values in found.items():
                gains.setdefault(name, []).append(own - np.array(values))
            others = ", ".join(f"{name} {max(values):.2f}" for name, values in found.items())
            print(f"{picture:10} network {own:.2f} dB, {others}; {' '.join(solution.status.flags)}", flush=True)
            automatic = solve_tv(model, sums)
            shown.append(
                (
                    (picture, truth),
                    (f"{psnr(automatic.image, truth):.1f} dB", automatic.image),
                    (f"{own:.1f} dB", solution.image),
                )
            )
    if asked.images:
        draw(asked.images, shown)
    for name, each in gains.items():
        by_weight = np.array(each)  # (pictures, weights)
        one = by_weight[:, by_weight.mean(axis=0).argmin()]
        print(f"gain over {name}: {told(by_weight.min(axis=1))} at the best weight of each picture, {told(one)} of all")
    least = np.min([np.min(each, axis=1) for each in gains.values()], axis=0)
    print(f"gain over the best of each picture: {told(least)}")
    print(f"{np.median(seconds):.2f} s an image")


if __name__ == "__main__":
    main()
