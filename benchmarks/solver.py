"""Speed and accuracy of the solver at the anchor geometry: 49 frames of 512 x 512 to a 128 x 128 image.

    python benchmarks/solver.py [--json FILE] [--repeat 15] [--seed 0]
    python benchmarks/solver.py --forms [--json FILE] [--seed 0]

Speed: streaming sums against dense Phi_L^T Y Phi_R products of the same frames, and block against full
factorisation, each the median of warm repetitions within this run. Accuracy: noise-free recovery at
lambda = 0, and the error of three forms of the solution against a 50-digit answer over
lambda (gram: the paper's; svd+Q: singular vectors of the stacked matrix but the paper's Q; svd: projected
frames). Trust: seconds of the stages of whole reconstructions from noisy frames in memory, the best of the repetitions,
and what the uncertainty takes of adding up and solving; slopes of the factors, which the misfit needs too, count there.

``--forms`` measures what the solver's precision costs in time: error against exact arithmetic (exact_solver.py)
and seconds in double and single precision, at three lambdas.
"""

from __future__ import annotations

import os
from dataclasses import asdict

import mpmath
import numpy as np
from exact_solver import dots, paper_factor, time_solver
from harness import arguments, median_seconds, show, write

from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.reconstruct.solver import Accumulator, Prepared, prepare
from tests.ideal_sessions import Bench, picture

N, K = 128, 7
EPS = float(np.finfo(np.float64).eps)
Frames = dict[tuple[int, int], np.ndarray]


def frames_of(factor: np.ndarray, patterns: np.ndarray, image: np.ndarray) -> Frames:
    """Noise-free frames by pattern index."""
    count = range(patterns.shape[1])
    scaled = [factor * column for column in patterns.T]
    return {(i, j): scaled[i] @ image @ scaled[j].T for i in count for j in count}


def summed(prepared: Prepared, frames: Frames) -> Accumulator:
    """All frames, streamed."""
    sums = prepared.accumulator()
    for key, frame in frames.items():
        sums.add(frame, *key)
    return sums


def speed(factor: np.ndarray, repeat: int, rng: np.random.Generator) -> dict[str, float]:
    """Medians [s] and their ratio."""
    patterns = dots(N, K)
    frames = frames_of(factor, patterns, rng.random((N, N)))
    transposed = np.ascontiguousarray(factor.T)
    prepared = prepare(factor, factor, patterns, patterns)
    sums = summed(prepared, frames)
    total = sums.sum

    def dense() -> None:
        for frame in frames.values():
            transposed @ (frame @ factor)

    def prepare_and_solve() -> None:
        # The arithmetic of a solve on given sums: those belong to the factors that made them, so a fresh
        # factorisation cannot be handed the same ones through the public door.
        fresh = prepare(factor, factor, patterns, patterns)
        sigma = np.outer(fresh.left.singular, fresh.right.singular)
        fresh.image(sigma * total / (np.square(sigma) + 1e-3))

    other = factor[:, ::-1].copy()

    result = {
        "dense_products_s": median_seconds(dense, repeat),
        "streaming_s": median_seconds(lambda: summed(prepared, frames), repeat),
        "prepare_and_solve_s": median_seconds(prepare_and_solve, repeat),
        "prepare_unequal_sides_s": median_seconds(lambda: prepare(factor, other, patterns, patterns), repeat),
        "solve_auto_s": median_seconds(lambda: prepared.solve(sums, "auto"), repeat),
        "solve_given_lambda_s": median_seconds(lambda: prepared.solve(sums, 1e-3), repeat),
    }
    result["streaming_speedup"] = result["dense_products_s"] / result["streaming_s"]
    return result


def recovery(factor: np.ndarray, rng: np.random.Generator) -> dict[str, float]:
    """Largest error of an image in 0..1 from noise-free frames at lambda = 0, by family."""
    image = rng.random((N, N))
    result = {}
    for name, patterns in (("uniform", np.ones((N, 1))), ("dots:7", dots(N, K))):
        frames = frames_of(factor, patterns, image)
        prepared = prepare(factor, factor, patterns, patterns)
        found = prepared.solve(summed(prepared, frames), 0.0).image
        result[name] = float(np.abs(found - image).max())
    return result


def exact_solution(factor: np.ndarray, frame: np.ndarray, lam: float) -> np.ndarray:
    """Tikhonov solution of one uniform frame in 50 digits, by the eigenvectors of Phi^T Phi."""
    with mpmath.workdps(50):
        phi, data = mpmath.matrix(factor.tolist()), mpmath.matrix(frame.tolist())
        values, vectors = mpmath.eigsy(phi.T * phi)
        rotated = vectors.T * (phi.T * data * phi) * vectors
        for i in range(rotated.rows):
            for j in range(rotated.cols):
                rotated[i, j] /= values[i] * values[j] + mpmath.mpf(lam)
        image = vectors * rotated * vectors.T
        return np.array(image.tolist(), dtype=np.float64)


def rounding(rng: np.random.Generator) -> list[dict[str, float]]:
    """Relative error of three forms against 50 digits: n = 12, m = 24, cond(Phi) = 1e4."""
    u, _ = np.linalg.qr(rng.normal(size=(24, 12)))
    v, _ = np.linalg.qr(rng.normal(size=(12, 12)))
    factor = (u * np.logspace(0, -4, 12)) @ v.T
    one = np.ones((12, 1))
    frame = factor @ rng.random((12, 12)) @ factor.T
    rows = []
    for exponent in range(-2, -17, -2):
        lam = 10.0**exponent
        truth = exact_solution(factor, frame, lam)
        prepared = prepare(factor, factor, one, one)
        images = {"svd": prepared.solve(summed(prepared, {(0, 0): frame}), lam).image}
        values, vectors = np.linalg.eigh(factor.T @ factor)
        rotated = vectors.T @ (factor.T @ frame @ factor) @ vectors
        images["gram"] = vectors @ (rotated / (np.outer(values, values) + lam)) @ vectors.T
        side = prepared.left
        q = side.basis.T @ (factor.T @ frame @ factor) @ side.basis
        images["svd+Q"] = side.basis @ (q / (np.outer(side.singular, side.singular) ** 2 + lam)) @ side.basis.T
        row = {"lambda_rel": lam, "eps/lambda_rel": EPS / lam, "eps/sqrt(lambda_rel)": EPS / lam**0.5}
        row |= {form: float(np.linalg.norm(image - truth) / np.linalg.norm(truth)) for form, image in images.items()}
        rows.append(row)
    return rows


def trust(factor: np.ndarray, repeat: int, seed: int) -> dict[str, float]:
    """Best seconds by stage and family, and the uncertainty's part of adding up and solving."""
    camera, result = Bench(factor, factor), {}
    for family in ("uniform", "dots:4", "dots:7"):
        shots, factors = camera.run(family, picture(seed, N), seed), camera.calibrated(seed)
        runs = [reconstruct(shots, factors).seconds for _ in range(repeat)]
        best = {stage: min(run[stage] for run in runs) for stage in runs[0]}
        result |= {f"{family}, {stage}_s": seconds for stage, seconds in best.items()}
        result[f"{family}, uncertainty / solve"] = best["uncertainty"] / (best["accumulate"] + best["solve"])
    return result


def main() -> None:
    parser = arguments(__doc__, seed=True)
    parser.add_argument("--repeat", type=int, default=15)
    parser.add_argument("--forms", action="store_true", help="error and seconds of every form of the solver")
    options = parser.parse_args()
    if options.forms:
        rows = time_solver(options.seed, lambda stage, part: None)
        for row in sorted(rows, key=lambda row: (-row.lambda_rel, row.seconds)):
            others = [each for each in rows if each.lambda_rel == row.lambda_rel and each is not row]
            beaten = any(each.seconds <= row.seconds and each.error <= row.error for each in others)
            show("beaten in time and error" if beaten else "not beaten", asdict(row))
        write(options.json, [asdict(row) for row in rows])
        return
    factor = paper_factor()
    report = {
        "seed": options.seed,
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
        "speed": speed(factor, options.repeat, np.random.default_rng(options.seed)),
        "recovery": recovery(factor, np.random.default_rng(options.seed)),
        "trust": trust(factor, options.repeat, options.seed),
        "rounding": rounding(np.random.default_rng(options.seed)),
    }
    for section in ("speed", "recovery", "trust"):
        show(section, report[section])
    for each in report["rounding"]:
        show("rounding", each)
    write(options.json, report)


if __name__ == "__main__":
    main()
