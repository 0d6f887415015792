"""How often the stated uncertainty covers the truth: a new calibration and new noise each session, by print and family.

    python benchmarks/coverage.py RESULT.json [--sessions 200] [--places 10] [--prints ...] [--families ...] [--n 16]

Shipped prints, and shades of noise, lie 400 mm before a small camera of 64 x 64 sensor and n x n scene pixels. What
print within a pixel does is the same in all sessions of a print, so each session takes the next of ``--places`` ways to
lay it: a part of 7/8 anywhere, turned. Light of board and prints is traced once. RESULT.json holds, by print and
family, the part of all pixels of all sessions that are within 1.96 standard uncertainties of the truth, and the rms of
error over uncertainty; an interrupted run goes on where it was. 200 sessions of four prints and five families take 12
minutes on two cores.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter
from skimage import io

from mitsim.capture.bench import Bench
from mitsim.capture.calibrate import estimate
from mitsim.capture.light import Light
from mitsim.capture.opening import open_bench
from mitsim.capture.responses import LitSession
from mitsim.capture.session import Session
from mitsim.core.job import Job
from mitsim.core.manifests import CalibrationManifest
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruction import reconstruct
from mitsim.rig.recipe import load_recipe

ROOT = Path(__file__).parent.parent
PRINTS = ("shades", "photograph", "colour_chart", "resolution_target")
FAMILIES = ("uniform", "dots:4", "dots:7", "hadamard:4", "random:4")
EXPOSURE = 0.1
"""Part of the full well, so that noise weighs as much as what else is wrong."""


def picture(name: str, place: int) -> np.ndarray:
    """Eight-bit reflectances of a print, laid the ``place``-th way; the first is the print as it is."""
    rng = np.random.default_rng(4 + place)
    if name == "shades":
        shades = gaussian_filter(rng.standard_normal((64, 64)), 8, mode="nearest")
        return 128 + 90 * shades / np.abs(shades).max()
    values = io.imread(ROOT / "scenes" / name / "reflectance.png")
    values = values if values.ndim == 2 else values[..., :3].mean(axis=2)
    if place == 0:
        return values
    side = 7 * len(values) // 8
    row, column = rng.integers(0, len(values) - side + 1, 2)
    return np.rot90(values[row : row + side, column : column + side], rng.integers(4))


def opened(name: str, place: int, n: int, folder: Path) -> Bench:
    """The small camera of the tests before a print."""
    sys.path.insert(0, str(ROOT))
    from tests.conftest import write_small_scene

    return open_bench(
        write_small_scene(folder / f"{name}{place}", name, reflectance=picture(name, place), n=n, sheet_z=400)
    )


def calibrated(board: LitSession, seed: int) -> Factors:
    """Factors of a session with noise of its own."""
    session = board.session
    noisy, _ = estimate(replace(board, session=replace(session, seed=1000 + seed)), Job())
    reflectance = session.recipe.board_reflectance
    camera = session.bench.identity()
    return Factors.of(noisy, CalibrationManifest(camera=camera, centre=session.centre, board_reflectance=reflectance))


def session(light: Light, family: str, factors: Factors, seed: int) -> dict[str, float]:
    """What one image is worth: part of its pixels inside, mean square of error over uncertainty, and what is stated."""
    shots = light.expose(family, seed=seed, exposure_fraction=EXPOSURE)
    image = reconstruct(shots, factors)
    assert image.uncertainty is not None and image.uncertainties is not None and shots.truth is not None
    error = (image.image - shots.truth) / image.uncertainty
    return {
        "inside": float(np.mean(np.abs(error) < 1.96)),
        "square": float(np.square(error).mean()),
        "error": float(np.sqrt(np.mean(np.square(image.image - shots.truth)))),
        "explained": float(not (image.misfit and image.misfit.flagged)),
        **image.uncertainties.budget,
    }


def put_together(sessions: list[dict[str, float]]) -> dict[str, float]:
    """Means over all sessions; rms of error over uncertainty."""
    mean = {name: float(np.mean([one[name] for one in sessions])) for name in sessions[0]}
    return {"sessions": len(sessions), "rms": mean.pop("square") ** 0.5, **mean}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path)
    parser.add_argument("--sessions", type=int, default=200)
    parser.add_argument("--prints", nargs="+", default=PRINTS)
    parser.add_argument("--families", nargs="+", default=FAMILIES)
    parser.add_argument("--places", type=int, default=10)
    parser.add_argument("--n", type=int, default=16)
    options = parser.parse_args()
    done = json.loads(options.result.read_text())["sessions"] if options.result.is_file() else {}
    with tempfile.TemporaryDirectory() as folder:
        kinds = [(name, place) for name in options.prints for place in range(options.places)]
        benches = {kind: opened(*kind, options.n, Path(folder)) for kind in kinds}
        lights = {kind: bench.light(options.families[-1], accuracy=3e-4) for kind, bench in benches.items()}
        camera = Session(benches[kinds[0]], load_recipe(), 0)
        board = camera.lit(camera.trace(camera.plan(2e-4, Job()), Job()), Job())
        for seed in range(options.sessions):
            factors: Factors | None = None
            for name in options.prints:
                light = lights[name, seed % options.places]
                for family in options.families:
                    found = done.setdefault(f"{name} {family}", [])
                    if len(found) == seed:
                        factors = factors or calibrated(board, seed)
                        found.append(session(light, family, factors, seed))
            if factors and (seed % 10 == 9 or seed == options.sessions - 1):
                together = {key: put_together(sessions) for key, sessions in done.items()}
                options.result.write_text(json.dumps({"together": together, "sessions": done}), encoding="utf-8")
                print(f"{seed + 1} sessions", flush=True)
    for key, one in together.items():
        print(f"{key:28s} {one['inside']:.1%} inside, rms {one['rms']:.2f}, {one['sessions']} sessions", flush=True)


if __name__ == "__main__":
    main()
