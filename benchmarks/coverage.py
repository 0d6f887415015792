"""How often the stated uncertainty covers the truth, with a new calibration and new noise for each image.

    python benchmarks/coverage.py --json FILE --closed-form [--seeds 3] [--families ...] [--fractions ...]
    python benchmarks/coverage.py --json FILE --regimes 200

Frames of an ideal camera are formed in numpy (tests/ideal_sessions.py). ``--closed-form`` goes over scenes, cameras,
families and parts of the full well: FILE holds, for each, the part of the pixels within 1.96 uncertainties, and the rms
that is stated and that the image is off by, all seeds together. The table at the end is of images that state their
uncertainty as it is, of those that say that it is extrapolated, and of flagged ones. 1056 rows of a seed take 10
minutes.

``--regimes 200`` counts 200 images in each of six regimes of light and patterns: the part of all pixels within the 68,
90 and 95 % intervals, and stated over actual error of each image.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from harness import arguments, held, ratios, show, write
from scipy.ndimage import gaussian_filter
from skimage import data
from skimage.transform import resize

from mitsim.devices.camera import centred_edges
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import reconstruct
from tests.ideal_sessions import PITCH, PIXELS, Bench, shadow
from tests.shadow_factor import scene_factor

FAMILIES = ("uniform", "dots:4", "dots:7", "hadamard:4", "random:4")
FRACTIONS = (0.003, 0.008, 0.02, 0.05)
FULL_WELL, CELLS = 1e4, 64
REGIMES = {
    "bright, uniform": ("uniform", 0.5), "dim, uniform": ("uniform", 0.02), "bright, dots": ("dots:7", 0.5),
    "dim, dots": ("dots:4", 0.02), "bright, Hadamard": ("hadamard:4", 0.5), "dim, random": ("random:4", 0.02),
}  # fmt: skip
"""Patterns and part of the full well of each regime."""
INTERVALS = {0.68: 0.9945, 0.90: 1.6449, 0.95: 1.9600}
"""Standard deviations of normal intervals."""


def scenes() -> dict[str, np.ndarray]:
    """(CELLS, CELLS) reflectances of kinds that lose detail differently."""
    rng = np.random.default_rng(5)

    def of(picture: np.ndarray) -> np.ndarray:
        grey = picture.mean(axis=2) if picture.ndim == 3 else picture
        side = min(grey.shape)
        return resize(grey[:side, :side] / 255, (CELLS, CELLS), anti_aliasing=True)

    text, stars = np.full((CELLS, CELLS), 0.92), np.full((CELLS, CELLS), 0.02)
    for row in range(3, CELLS - 4, 7):
        column = 3
        while column < CELLS - 6:
            width = int(rng.integers(1, 4))
            text[row : row + 4, column : column + width][rng.random((4, width)) < 0.5] = 0.05
            column += width + 1
    stars[rng.integers(0, CELLS, 40), rng.integers(0, CELLS, 40)] = 0.1 + 0.9 * rng.random(40)
    shades = gaussian_filter(rng.standard_normal((CELLS, CELLS)), 8)
    bars, card = np.full((CELLS, CELLS), 0.9), np.full((CELLS, CELLS), 0.15)
    for row, width in enumerate((1, 2, 3, 5, 8)):
        bars[6 + 11 * row : 14 + 11 * row, 4:60][:, (np.arange(56) // width) % 2 == 0] = 0.1
    card[10:50, 14:56], card[20:30, 20:34] = 0.8, 0.3
    return {
        "photograph": of(data.camera()), "cat": of(data.chelsea()), "coffee": of(data.coffee()),
        "page": of(data.page()), "text": text, "stars": stars,
        "checker": 0.1 + 0.8 * ((np.indices((CELLS, CELLS)) // 5).sum(axis=0) % 2),
        "grey": np.full((CELLS, CELLS), 0.5), "bars": bars, "card": card,
        "shades": 0.5 + 0.35 * shades / np.abs(shades).max(),
    }  # fmt: skip


@dataclass(frozen=True, eq=False)
class FlatCam(Bench):
    """A mask (1 + m m^T) / 2, whose constant term is centred away."""

    def light(self, shown: np.ndarray) -> np.ndarray:
        return np.maximum(shown.sum() * np.abs(self.left).max() ** 2 + super().light(shown), 0.0) / 2

    def calibrated(self, seed: int, error: float = 2e-3) -> Factors:
        found = super().calibrated(seed, error)
        manifest = found.manifest.model_copy(update={"centre": True})
        return Factors(found.left / np.sqrt(2), found.right / np.sqrt(2), manifest, found.status)


def cameras() -> dict[str, Bench]:
    def cast(profile: np.ndarray) -> np.ndarray:
        """Shadow of a mask of 60 um features, where :func:`shadow` has that of the MLS."""
        edges = centred_edges(PIXELS, PITCH), centred_edges(CELLS, 120 / CELLS)
        return scene_factor(profile, 0.06, *edges, 2.0, 400.0)

    side = shadow(n=CELLS)
    residues = np.isin(np.arange(101), np.square(np.arange(1, 101)) % 101).astype(float)
    return {
        "separable": Bench(side, side),
        "FlatCam": FlatCam(*2 * [2 * side - side.max()]),
        "MURA": FlatCam(*2 * [2 * cast(residues) - cast(np.ones(101))]),
    }


def kind_of(ok: bool, extrapolated: bool) -> str:
    return "flagged" if not ok else "extrapolated" if extrapolated else "as stated"


def count_regimes(result: Path, images: int) -> None:
    """Write and print the coverage of ``images`` in each regime; scenes in turn, with a new calibration and noise."""
    camera, shown = cameras()["separable"], list(scenes().values())
    rows = {}
    for name, (family, fraction) in REGIMES.items():
        found: dict[str, list[tuple[list[float], float]]] = {}
        for seed in range(images):
            truth = np.rot90(shown[seed % len(shown)], seed // len(shown))
            shots = replace(camera, peak=fraction * FULL_WELL).run(family, truth, 5000 + seed)
            image = reconstruct(shots, camera.calibrated(5000 + seed))
            assert image.uncertainty is not None and image.uncertainties is not None
            deviations = np.abs(image.image - truth) / image.uncertainty
            ratio = float(np.sqrt(np.square(image.uncertainty).mean() / np.square(image.image - truth).mean()))
            within = [float(np.mean(deviations < most)) for most in INTERVALS.values()]
            found.setdefault(kind_of(image.ok, image.uncertainties.extrapolated), []).append((within, ratio))
        for kind, pairs in found.items():
            inside = np.mean([within for within, _ in pairs], axis=0).tolist()
            own = [ratio for _, ratio in pairs]
            rows[f"{name}, {kind}"] = {
                "images": len(own), **{f"{part:.0%}": value for part, value in zip(INTERVALS, inside, strict=True)},
                **ratios(own), "error above twice the stated": sum(ratio < 0.5 for ratio in own),
            }  # fmt: skip
            show(f"{name}, {kind}", rows[f"{name}, {kind}"])
        write(result, rows)


def closed_form(result: Path, seeds: int, families: list[str], fractions: list[float]) -> None:
    """Write and print the table over scenes, cameras, families and parts of the full well."""
    rows = held(result, {"rows": []})["rows"]
    names = ("camera", "patterns", "scene", "fraction")
    done = {tuple(row[name] for name in names) for row in rows}
    for (name, camera), family, (scene, truth), fraction in itertools.product(
        cameras().items(), families, scenes().items(), fractions
    ):
        key = (name, family, scene, fraction)
        if key in done:
            continue
        found = []
        for seed in range(seeds):
            shots = replace(camera, peak=fraction * FULL_WELL).run(family, truth, seed)
            image = reconstruct(shots, camera.calibrated(seed))
            assert image.uncertainty is not None and image.uncertainties is not None
            error = image.image - truth
            squares = (float(np.square(each).mean()) for each in (image.uncertainty, error))
            inside = float(np.mean(np.abs(error) < 1.96 * image.uncertainty))
            found.append((inside, *squares, image.uncertainties.extrapolated, image.ok))
        inside, stated, actual, extrapolated, good = np.mean(found, axis=0).tolist()
        row = {"inside": inside, "stated": stated**0.5, "error": actual**0.5, "ratio": (stated / actual) ** 0.5}
        row |= {"extrapolated": extrapolated, "unflagged": good}
        rows.append({**dict(zip(names, key, strict=True)), **row})
        write(result, {"seeds": seeds, "rows": rows})
        show(" ".join(map(str, key)), row)
    for camera_name in (*cameras(), "all"):
        for kind in ("as stated", "extrapolated", "flagged"):
            chosen = [
                row for row in rows
                if camera_name in (row["camera"], "all") and kind_of(row["unflagged"] == 1, row["extrapolated"]) == kind
            ]  # fmt: skip
            if chosen:
                covered, over = (np.array([row[name] for row in chosen]) for name in ("inside", "ratio"))
                table = {
                    "images": len(chosen), "93 to 97 % inside": float(np.mean(np.abs(covered - 0.95) <= 0.02)),
                    "90 % and more": float(np.mean(covered >= 0.9)), "median inside": float(np.median(covered)),
                    **ratios(over), "above 2": int(np.sum(over > 2)), "below 0.5": int(np.sum(over < 0.5)),
                }  # fmt: skip
                show(f"{camera_name}, {kind}", table)


def main() -> None:
    parser = arguments(__doc__, required=True)
    parser.add_argument("--closed-form", action="store_true", help="scenes, cameras and exposures")
    parser.add_argument("--families", nargs="+", default=FAMILIES)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--fractions", nargs="+", type=float, default=FRACTIONS)
    parser.add_argument("--regimes", type=int, help="images in each regime")
    options = parser.parse_args()
    if options.regimes:
        count_regimes(options.json, options.regimes)
    else:
        closed_form(options.json, options.seeds, list(options.families), options.fractions)


if __name__ == "__main__":
    main()
