"""The hand of DiffuserCam by mitsim and by LenslessPiCam, in one run: objective, background, processor time, memory.

    python benchmarks/point_spread.py DATA [--lensless PYTHON] [--reduce 4 2] [--json FILE]

DATA holds `psf_sample.tif` and `rawdata_hand_sample.tif` of the repository Waller-Lab/DiffuserCam-Tutorial (BSD
3-Clause), PYTHON is that of an environment with `lensless` 1.0.8. All are given the same numbers in single precision:
black level off, light of norm 1, the frame's largest number 1. Theirs: ADMM, 100 steps, and FISTA, 300, all else their
defaults. Ours: ``nonnegative`` and ``tv`` as the command line has them, with the automatic weight and rule of ending,
and by no weight (as FISTA) and 1e-4 (as ADMM). Each solves in a process of its own, one after the other, on one thread;
seconds are of making the solver and solving, memory is the process's largest.

Misfit: half the squared misfit of the whole scene that was solved for, cut at zero; of theirs at the best brightness
and place. Objective, of ours: with the weight's part. Background: mean outside of a box round the hand, over the
largest number.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy import fft

BOX = (0.17, 0.8, 0.3, 0.95)
"""Rows and columns of the hand, as parts of the image."""
BLACK = 48.0
"""Median of the edges of the point spread function's picture."""


def theirs(place: Path, name: str) -> dict[str, Any]:
    """The scene that LenslessPiCam finds, saved beside its inputs."""
    from lensless import ADMM, FISTA  # type: ignore[import-not-found]

    given = np.load(place / "given.npz")
    psf, frame = (given[key].astype(np.float32)[..., None] for key in ("psf", "frame"))
    steps, kind = (100, ADMM) if name == "admm" else (300, FISTA)
    start, clock = time.process_time(), time.perf_counter()
    solver = kind(psf[None])
    solver.set_data(frame[None])
    image = np.asarray(solver.apply(n_iter=steps, plot=False, disp_iter=None))
    spent, wall = time.process_time() - start, time.perf_counter() - clock
    scene = np.asarray(solver._image_est).squeeze()
    np.savez(place / "found.npz", image=image.reshape(psf.shape[:2]), scene=np.maximum(scene, 0))
    return {"seconds": spent, "wall_seconds": wall, "steps": steps}


def ours(place: Path, name: str) -> dict[str, Any]:
    """The same by mitsim: METHOD:WEIGHT."""
    from mitsim.reconstruct.point_spread import ShiftedLight
    from mitsim.reconstruct.point_spread_image import solve_point_spread

    given, (method, lam) = np.load(place / "given.npz"), name.split(":")
    start, clock = time.process_time(), time.perf_counter()
    light, frame = ShiftedLight(given["psf"], given["frame"].shape, precision=np.float32), given["frame"]
    found = solve_point_spread(light, frame[None], method, "auto" if lam == "auto" else float(lam))
    spent, wall = time.process_time() - start, time.perf_counter() - clock
    np.savez(place / "found.npz", image=found.image, scene=found.image)
    return {
        "seconds": spent, "wall_seconds": wall, "steps": found.iterations, "converged": found.ok,
        "objective": found.objective, "gap": found.relative_gap, "weight": found.lam,
        "misfit": found.residual**2 * float(np.square(frame).sum()) / 2,
    }  # fmt: skip


def misfit(scene: np.ndarray, psf: np.ndarray, frame: np.ndarray) -> float:
    """Least half squared misfit over where the frame lies and how bright the scene is."""
    grid = [fft.next_fast_len(a + b + m) for a, b, m in zip(scene.shape, psf.shape, frame.shape, strict=True)]
    whole = scene.shape > psf.shape  # ADMM's scene is periodic
    grid = list(scene.shape) if whole else grid
    seen = fft.irfft2(fft.rfft2(scene, grid) * fft.rfft2(psf, grid), grid)
    placed = np.zeros(grid)
    placed[: frame.shape[0], : frame.shape[1]] = frame
    match = fft.irfft2(fft.rfft2(placed) * fft.rfft2(seen).conj(), grid)
    row, column = np.unravel_index(match.argmax(), match.shape)
    best = np.inf
    for down in range(-3, 4):
        for right in range(-3, 4):
            part = np.roll(seen, (row + down, column + right), (0, 1))[: frame.shape[0], : frame.shape[1]]
            gain = np.vdot(part, frame) / np.vdot(part, part)
            best = min(best, 0.5 * float(np.square(gain * part - frame).sum()))
    return best


def background(image: np.ndarray) -> float:
    rows, columns = image.shape
    outside = np.ones(image.shape, dtype=bool)
    top, bottom, left, right = BOX
    outside[int(rows * top) : int(rows * bottom), int(columns * left) : int(columns * right)] = False
    return float(image[outside].mean() / image.max())


def run(python: str, place: Path, name: str) -> dict[str, Any]:
    """One solver in a process of its own."""
    done = subprocess.run(
        [python, __file__, str(place), "--solve", name],
        capture_output=True, text=True, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    return dict(json.loads(done.stdout.splitlines()[-1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--lensless", help="python of an environment with lensless; without it mitsim alone")
    parser.add_argument("--reduce", type=int, nargs="+", default=[4, 2])
    parser.add_argument("--json", help="write the figures to this file")
    parser.add_argument("--solve", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.solve:
        solved = (ours if ":" in options.solve else theirs)(options.data, options.solve)
        print(json.dumps({**solved, "memory_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024}))
        return
    from PIL import Image

    from mitsim.devices.mask_profile import load_psf
    from mitsim.reconstruct.point_spread import reduce_frame

    raw = np.asarray(Image.open(options.data / "rawdata_hand_sample.tif"), float)
    rows: list[dict[str, Any]] = []
    for reduce in options.reduce:
        psf = load_psf(options.data / "psf_sample.tif", reduce)
        frame = reduce_frame(raw, reduce) - BLACK
        psf, frame = psf / np.linalg.norm(psf), frame / frame.max()
        names = ["nonnegative:auto", "tv:auto", "nonnegative:0", "tv:1e-4"]
        names += ["admm", "fista"] if options.lensless else []
        for name in names:
            with tempfile.TemporaryDirectory() as folder:
                np.savez(Path(folder) / "given.npz", psf=psf, frame=frame)
                row = run(sys.executable if ":" in name else options.lensless, Path(folder), name)
                found = np.load(Path(folder) / "found.npz")
                if ":" not in name:
                    row["misfit"] = misfit(found["scene"].astype(float), psf, frame)
                row["background"] = background(found["image"])
            rows.append({"shape": list(frame.shape), "solver": name, **row})
            print(rows[-1], flush=True)
    if options.json:
        Path(options.json).write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
