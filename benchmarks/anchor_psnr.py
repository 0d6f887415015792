"""Mean PSNR of eight photographs under an ideal camera, by pattern family and exposure convention.

    python benchmarks/anchor_psnr.py [--json FILE] [--seed 0] [--reflectance stored|linear]

Ideal model Y = Phi_L (P o X) Phi_R^T at the anchor geometry, sensor noise of the paper's model (Poisson,
read noise sigma = F 10^(-R/20)), Tikhonov solution at the oracle lambda (best PSNR over a fine grid) and at
the automatic one. PSNR has peak 1 and no gain or offset fit. Conventions: equal peak - the brightest frame
of each family is exposed to PEAK electrons; equal frame - one exposure for all frames, set by uniform
light's peak; equal total - that exposure shared among the family's frames.

The brightness of the images matters as much as the family: peak exposure follows the scene, PSNR's peak of 1
does not, so dark images score higher. ``--reflectance`` chooses.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator

import numpy as np
from skimage import color, data
from solver import dots, paper_factor

from mitsim.metrics import psnr
from mitsim.reconstruct.solver import prepare

N = 128
PHOTOGRAPHS = ("astronaut", "camera", "coffee", "chelsea", "rocket", "moon", "hubble_deep_field", "coins")
CONVENTIONS = (("equal peak", 1e4), ("equal frame", 1e4), ("equal frame", 33e3), ("equal total", 33e3))


def photograph(name: str, decode: bool) -> np.ndarray:
    """(128, 128) grey reflectance up to 1: centre square, block means; ``decode`` undoes the sRGB curve."""
    image = np.asarray(getattr(data, name)(), dtype=np.float64) / 255
    if decode:
        image = np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
    if image.ndim == 3:
        image = color.rgb2gray(image)
    block = min(image.shape) // N
    top, left = ((size - block * N) // 2 for size in image.shape)
    square = image[top : top + block * N, left : left + block * N]
    return square.reshape(N, block, N, block).mean(axis=(1, 3))


def frames(factor: np.ndarray, patterns: np.ndarray, image: np.ndarray) -> Iterator[tuple[int, int, np.ndarray]]:
    """Noise-free frames with their pattern indices."""
    for i, row in enumerate(patterns.T):
        for j, column in enumerate(patterns.T):
            yield i, j, (factor * row) @ image @ (factor * column).T


def trial(
    factor: np.ndarray, k: int, image: np.ndarray, convention: str, peak: float, full_well: float, seed: int
) -> dict[str, float]:
    """PSNR at the oracle and the automatic lambda for one image."""
    patterns = dots(N, k)
    clean = list(frames(factor, patterns, image))
    uniform_peak = float((factor @ image @ factor.T).max())
    gain = peak / uniform_peak
    if convention == "equal peak":
        gain = peak / max(float(frame.max()) for _, _, frame in clean)
    if convention == "equal total":
        gain /= k * k
    read_noise = full_well * 10 ** (-73 / 20)
    rng = np.random.default_rng([seed, k])
    prepared = prepare(factor, factor, patterns, patterns)
    sums = prepared.accumulator()
    for i, j, frame in clean:
        noisy = rng.poisson(gain * np.maximum(frame, 0)) + rng.normal(0, read_noise, frame.shape)
        sums.add(noisy / gain, i, j)
    scale = prepared.problem(sums).scale
    oracle = max(psnr(prepared.solve(sums, scale * lam).image, image) for lam in np.logspace(-10, 0, 81))
    automatic = prepared.solve(sums, "auto")
    return {
        "oracle": oracle,
        "automatic": psnr(automatic.image, image),
        "lam_relative": automatic.lam / scale,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", help="write the table to this file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--reflectance",
        choices=("stored", "linear"),
        default="stored",
        help="pixel value as it is, or with the sRGB curve taken out (darker: mean 0.2 instead of 0.4)",
    )
    parser.add_argument("--k", type=int, nargs="+", default=[1, 5, 7])
    options = parser.parse_args()
    factor = paper_factor()
    images = [photograph(name, options.reflectance == "linear") for name in PHOTOGRAPHS]
    rows = []
    for convention, peak in CONVENTIONS:
        for k in options.k:
            # R = 73 dB is the sensor's: full well equals the peak the convention names.
            results = [trial(factor, k, image, convention, peak, peak, options.seed) for image in images]
            row = {"convention": convention, "electrons": peak, "frames": k * k}
            row |= {key: float(np.mean([r[key] for r in results])) for key in ("oracle", "automatic")}
            row["oracle_by_image"] = [r["oracle"] for r in results]
            row["worst_gap_db"] = max(r["oracle"] - r["automatic"] for r in results)
            rows.append(row)
            print(
                f"{convention:12s} {peak:8.0f} e  {k * k:3d} frames  oracle {row['oracle']:6.2f} dB  "
                f"automatic {row['automatic']:6.2f} dB  worst gap {row['worst_gap_db']:.2f} dB",
                flush=True,
            )
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump(
                {
                    "seed": options.seed,
                    "reflectance": options.reflectance,
                    "photographs": PHOTOGRAPHS,
                    "rows": rows,
                },
                file,
                indent=1,
            )


if __name__ == "__main__":
    main()
