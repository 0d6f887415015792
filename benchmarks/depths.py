"""Depths of prints beside the calibrated distance, as they are found: by print, dots and depth.

    python benchmarks/depths.py RESULT.json [--depths 330 340 ...] [--families dots:4 ...] [--prints ...] [--n 64]
        [--exposure 0.8]

A sheet is moved from 330 to 480 mm before a camera of 256 x 320 pixels that was calibrated at 400 mm with a projector
of n x n pixels 60 mm beside it. Light is traced once for each print and depth. RESULT.json holds of each run the depth
that ``--focus auto`` finds, its error, alternatives and doubt, whether the image is flagged, its unexplained part, what
beside that is print within pixels, PSNR, and the part of pixels within 1.96 uncertainties; and counts of runs that are
within two stated errors, flagged, or neither, which is silently wrong. An interrupted run goes on where it was. 256
runs take 15 minutes on two cores with n = 64.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from skimage import io
from skimage.draw import disk

from mitsim.api.bench import open_bench
from mitsim.metrics import psnr
from mitsim.reconstruct.depth import Depth
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import reconstruct

ROOT = Path(__file__).parent.parent
PRINTS = ("photograph", "ramp", "stars", "text")
FAMILIES = ("dots:4", "dots:5", "dots:6", "dots:7")
DEPTHS = tuple(range(330, 481, 10))
SIZE = 512
"""Texels a side of a print."""


def picture(name: str) -> np.ndarray:
    """Eight-bit reflectances of a print."""
    rng = np.random.default_rng(7)
    if name == "ramp":
        return np.tile(20 + 200 * np.arange(SIZE) / SIZE, (SIZE, 1))
    if name == "stars":
        sky = np.full((SIZE, SIZE), 15.0)
        for _ in range(120):
            row, column, radius = (*rng.integers(0, SIZE, 2), rng.integers(2, 9))
            sky[disk((row, column), radius, shape=sky.shape)] = rng.integers(120, 240)
        return sky
    if name == "text":
        page = np.full((SIZE, SIZE), 225.0)
        for top in range(20, SIZE - 20, 34):
            for left in range(20, SIZE - 40, 24):
                glyph = np.kron(rng.random((5, 3)) < 0.55, np.ones((4, 5))) > 0
                page[top : top + 20, left : left + 15][glyph] = 25
        return page
    return np.asarray(io.imread(ROOT / "scenes" / name / "reflectance.png"))


def scene(folder: Path, name: str, n: int) -> Path:
    """A print as a scene of the small camera; its sheet is at ``sheet_z``."""
    sys.path.insert(0, str(ROOT))
    from tests.conftest import write_png

    folder.mkdir()
    canvas = np.zeros((n, 2 * n))
    canvas[:, n:] = 255
    write_png(folder / "projector.png", canvas)
    write_png(folder / "reflectance.png", picture(name))
    text = (ROOT / "scenes" / "photograph" / "scene.xml").read_text(encoding="utf-8")
    text = text.replace('name="width" value="512"', 'name="width" value="320"')
    (folder / "scene.xml").write_text(text.replace('name="height" value="512"', 'name="height" value="256"'))
    return folder / "scene.xml"


def found(shots: Any, factors: Factors, z: float) -> dict[str, Any]:
    """What one run finds of a sheet at ``z`` mm."""
    image = reconstruct(shots, factors, focus="auto")
    depth = image.focus
    assert isinstance(depth, Depth) and depth.error_mm is not None and image.misfit is not None
    assert image.uncertainty is not None and shots.truth is not None
    # Light that was not traced as accurately as it was asked for is no fault of the depth.
    flags = [flag for flag in image.status.flags if not flag.startswith("The capture was flagged")]
    return {
        "mm": depth.mm,
        "error_mm": depth.error_mm,
        "alternatives": [each.mm for each in depth.alternatives],
        "doubt": depth.doubt,
        "flagged": bool(flags) or not image.status.verdict.good,
        "unexplained": image.misfit.unexplained,
        "detail": image.misfit.detail,
        "covered": float(np.mean(np.abs(image.image - shots.truth) < 1.96 * image.uncertainty)),
        "chi_square": image.misfit.chi_square,
        "psnr_db": psnr(image.image, shots.truth),
        "right": bool(abs(depth.mm - z) < 2 * depth.error_mm),
    }


def counted(runs: dict[str, dict[str, Any]]) -> dict[str, int]:
    """Runs that are right, right but flagged, wrong and flagged, and wrong without a word."""
    right, flagged = (np.array([run[key] for run in runs.values()]) for key in ("right", "flagged"))
    return {
        "runs": len(runs),
        "right": int((right & ~flagged).sum()),
        "right_flagged": int((right & flagged).sum()),
        "wrong_flagged": int((~right & flagged).sum()),
        "wrong_in_silence": int((~right & ~flagged).sum()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path)
    parser.add_argument("--depths", nargs="+", type=float, default=DEPTHS)
    parser.add_argument("--families", nargs="+", default=FAMILIES)
    parser.add_argument("--prints", nargs="+", default=PRINTS)
    parser.add_argument("--n", type=int, default=64)
    parser.add_argument("--exposure", type=float, default=0.8, help="part of the full well")
    options = parser.parse_args()
    done: dict[str, Any] = json.loads(options.result.read_text())["runs"] if options.result.is_file() else {}
    factors: Factors | None = None
    with tempfile.TemporaryDirectory() as temporary:
        for name in options.prints:
            path = scene(Path(temporary) / name, name, options.n)
            factors = factors or open_bench(path, sheet_z="400").calibrate(seed=0)
            for z in options.depths:
                keys = {
                    family: f"{name} {options.n} {family} {z:g} {options.exposure:g}" for family in options.families
                }
                if not set(keys.values()) <= set(done):
                    light = open_bench(path, sheet_z=f"{z:g}").light(accuracy=1e-3)
                    for family, key in keys.items():
                        shots = light.expose(family, seed=1, exposure_fraction=options.exposure)
                        done[key] = found(shots, factors, z)
                        print(
                            key, f"{done[key]['mm']:.3f} +- {done[key]['error_mm']:.2g}", done[key]["doubt"], flush=True
                        )
                    options.result.write_text(json.dumps({"counts": counted(done), "runs": done}), encoding="utf-8")
    print(counted(done))


if __name__ == "__main__":
    main()
