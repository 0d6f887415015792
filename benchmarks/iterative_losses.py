"""What images by iterations lose: decibels by the automatic weight, and how far above its minimum an objective ends.

    python benchmarks/iterative_losses.py weights [--data DATA] [--json FILE]
    python benchmarks/iterative_losses.py rule [--data DATA] [--json FILE]

``weights``: photographs that no rule was chosen on, simulated with noise; PSNR at the automatic weight beside the best
of 13 a quarter of a decade apart. By ``--psf`` behind a drawn array of lenses and a drawn field of speckle (and behind
the measured diffuser of DATA, see ``benchmarks/point_spread.py``); separable behind random codes, 96 x 96 pixels,
48 x 48 scene pixels. ``rule``: the objective at which a default run of ``--psf`` ends, over the least that 1500 steps
find.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter
from skimage import data
from skimage.transform import resize

from mitsim.devices.mask_profile import load_psf
from mitsim.devices.patterns import parse_patterns
from mitsim.metrics import psnr
from mitsim.reconstruct.point_spread import ShiftedLight, minimise
from mitsim.reconstruct.point_spread_image import solve_point_spread
from mitsim.reconstruct.solution import Solution
from mitsim.reconstruct.solver import prepare
from mitsim.reconstruct.solvers import Prior, solve_nonnegative, solve_tv

SCENES = "coins", "page", "rocket", "moon"
NOISES = 0.005, 0.04
"""Standard deviation over the frame's mean."""
SIDE = 80, 100
FACTORS = 10.0 ** np.arange(-1.5, 1.51, 0.25)


def picture(name: str, shape: tuple[int, int]) -> np.ndarray:
    """A photograph, cut to ``shape``'s proportions, 0 to 1."""
    image = np.asarray(getattr(data, name)(), float)
    image = image.mean(axis=2) if image.ndim == 3 else image
    rows = min(image.shape[0], int(image.shape[1] * shape[0] / shape[1]))
    image = resize(image[:rows, : int(rows * shape[1] / shape[0])], shape, anti_aliasing=True)
    return np.asarray((image - image.min()) / np.ptp(image))


def lights(place: Path | None) -> dict[str, np.ndarray]:
    """Point spread functions of sum 1."""
    rng = np.random.default_rng(11)
    dots = np.zeros(SIDE)
    dots[rng.integers(4, SIDE[0] - 4, 40), rng.integers(4, SIDE[1] - 4, 40)] = 1 + rng.random(40)
    found = {
        "lenses": gaussian_filter(dots, 0.7),
        "speckle": np.maximum(gaussian_filter(rng.normal(size=SIDE), 1.0), 0) ** 2,
    }
    if place:
        found["diffuser"] = load_psf(place / "psf_sample.tif", 15)
    return {name: light / light.sum() for name, light in found.items()}


def loss(solve: Callable[[Any], Solution], truth: np.ndarray) -> dict[str, Any]:
    """Decibels that the automatic weight loses, and whether the best one is at an end of those tried."""
    automatic, peak = solve("auto"), float(truth.max())
    found = [psnr(solve(automatic.lam * factor).image / peak, truth / peak) for factor in FACTORS]
    best = int(np.argmax(found))
    return {
        "psnr": psnr(automatic.image / peak, truth / peak),
        "loss": max(found[best] - psnr(automatic.image / peak, truth / peak), 0.0),
        "best_over_automatic": float(FACTORS[best]),
        "converged": automatic.ok,
    }


def weights(place: Path | None) -> list[dict[str, Any]]:
    """All cases of the first table."""
    rng, rows = np.random.default_rng(0), list[dict[str, Any]]()

    def add(case: dict[str, Any], solve: Callable[[Any], Solution], truth: np.ndarray) -> None:
        rows.append({**case, **loss(solve, truth)})
        print(rows[-1], flush=True)

    for name, psf in lights(place).items():
        light = ShiftedLight(psf, psf.shape, precision=np.float32)
        for scene in SCENES:
            whole = np.pad(picture(scene, psf.shape), [(k // 2, k - 1 - k // 2) for k in psf.shape])[: light.scene[0]]
            frame, truth = light.image_of(900 * whole), 900 * whole[light.window]
            for noise in NOISES:
                seen = frame + noise * frame.mean() * rng.normal(size=frame.shape)
                for method in ("tikhonov", "nonnegative", "tv"):
                    case = {"camera": name, "scene": scene, "noise": noise, "method": method}
                    add(case, partial(solve_point_spread, light, seen, method), truth)
    size, pixels = 48, 96
    left, right = (gaussian_filter((rng.random((pixels, size)) > 0.5).astype(float), (0.7, 0)) for _ in range(2))
    for name in ("uniform", "dots:3", "hadamard:4"):
        family = parse_patterns(name, size)
        prepared = prepare(left, right, family.left.astype(float), family.right.astype(float))
        for scene in SCENES:
            truth = picture(scene, (size, size))
            for noise in NOISES:
                sums = prepared.accumulator()
                for i, j in np.ndindex(family.left.shape[1], family.right.shape[1]):
                    frame = left @ (np.outer(family.left[:, i], family.right[:, j]) * truth) @ right.T
                    sums.add(frame + noise * np.abs(frame).mean() * rng.normal(size=frame.shape), i, j)
                for method, solver in (("nonnegative", solve_nonnegative), ("tv", solve_tv)):
                    case = {"camera": f"separable, {name}", "scene": scene, "noise": noise, "method": method}
                    add(case, partial(solver, prepared, sums), truth)
    return rows


def rule(place: Path | None) -> list[dict[str, Any]]:
    """All cases of the second table."""
    rng, rows = np.random.default_rng(1), list[dict[str, Any]]()
    for name, psf in lights(place).items():
        light = ShiftedLight(psf, psf.shape, precision=np.float32)
        for scene, brightness, noise in (
            ("coins", 1.0, 0.005), ("rocket", 1.0, 0.04), ("moon", 1e-4, 0.3), ("coins", 1e6, 0.002),
        ):  # fmt: skip
            whole = np.pad(picture(scene, psf.shape), [(k // 2, k - 1 - k // 2) for k in psf.shape])[: light.scene[0]]
            frame = brightness * light.image_of(whole)
            frame = (frame + noise * frame.mean() * rng.normal(size=frame.shape)).astype(np.float32)
            for method, times in (("tikhonov", 1.0), ("nonnegative", 1.0), ("tv", 1.0), ("tv", 100.0)):
                lam = times * solve_point_spread(light, frame, method, iterations=1).lam
                found = solve_point_spread(light, frame, method, lam)
                bounds = Prior.bounds if method == "tikhonov" else (0.0, np.inf)
                prior = Prior(weight=lam, bounds=bounds) if method == "tv" else Prior(ridge=lam, bounds=bounds)
                objective = found.objective or 0.0
                least = min(minimise(light, frame, prior, 1500, 1e-6).objective, objective)
                rows.append({
                    "camera": name, "scene": scene, "brightness": brightness, "noise": noise, "method": method,
                    "weight_over_automatic": times, "steps": found.iterations, "converged": found.ok,
                    "above": objective / least - 1, "gap": found.relative_gap,
                })  # fmt: skip
                print(rows[-1], flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=("weights", "rule"))
    parser.add_argument("--data", type=Path)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = (weights if options.table == "weights" else rule)(options.data)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    figure = "loss" if options.table == "weights" else "above"
    groups = sorted({(row["camera"], row["method"], row.get("weight_over_automatic", 1.0)) for row in rows})
    for camera, method, times in groups:
        part = [
            row[figure]
            for row in rows
            if (row["camera"], row["method"], row.get("weight_over_automatic", 1.0)) == (camera, method, times)
        ]
        print(f"{camera:22s} {method:12s} x{times:g}: median {np.median(part):.3f}, most {max(part):.3f}")


if __name__ == "__main__":
    main()
