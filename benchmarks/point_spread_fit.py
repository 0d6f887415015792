"""How often a right and a wrong point spread function are flagged, on drawn cameras with noise and model errors.

    python benchmarks/point_spread_fit.py [--seeds 0 1 2 3] [--shape 64 80] [--json FILE]

Each seed draws a camera (lenses, speckle, a coded mask), a photograph, noise of 0.2, 1 or 5 % of the mean, and a model
error: none, light that is 2 % larger, or a tone curve. Beyond the image the scene goes on at a fifth of its brightness
for half of the seeds. Right light is compared with the same turned and mirrored, moved by a quarter, that of another
camera, and random numbers.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import affine_transform, gaussian_filter
from skimage import data
from skimage.transform import resize

from mitsim.reconstruct.point_spread import ShiftedLight, find_fit

PICTURES = "camera", "coins", "astronaut", "text", "cell", "page"


def light_of(kind: int, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Light of a point, of sum 1: of lenses, speckle or a mask."""
    light: np.ndarray
    row, column = ((np.indices(shape).T - np.array(shape) / 2) / np.array(shape)).T
    if kind == 0:
        light = np.zeros(shape)
        places = [rng.integers(size // 6, 5 * size // 6, 20) for size in shape]
        light[places[0], places[1]] = 0.3 + rng.random(20)
    elif kind == 1:
        light = np.maximum(gaussian_filter(rng.normal(size=shape), 1.5), 0) ** 2
        light *= np.exp(-(row**2 + column**2) / 0.045)
    else:
        light = np.kron(rng.random([size // 3 + 1 for size in shape]) > 0.5, np.ones((3, 3)))[: shape[0], : shape[1]]
        light = light * (np.maximum(np.abs(row), np.abs(column)) < 0.3)
    light = gaussian_filter(light, 0.8)
    return np.asarray(light / light.sum())


def picture(name: str, shape: tuple[int, int]) -> np.ndarray:
    """A photograph, 0 to 1."""
    image = np.asarray(getattr(data, name)(), float)
    image = image.mean(axis=2) if image.ndim == 3 else image
    side = min(image.shape)
    return np.asarray(resize(image[:side, :side] / image.max(), shape, anti_aliasing=True))


def captured(seed: int, shape: tuple[int, int]) -> tuple[dict[str, np.ndarray], np.ndarray, float]:
    """Right and wrong light by name, the frame, and its noise."""
    rng = np.random.default_rng(seed)
    kind, noise, error = seed % 3, float(rng.choice([0.002, 0.01, 0.05])), seed // 3 % 3
    light = light_of(kind, shape, rng)
    size = 1 / 1.02 if error == 1 else 1.0
    moved = [(1 - size) * (side - 1) / 2 for side in shape]
    camera = ShiftedLight(affine_transform(light, [size, size], moved, order=1) / size**-2, shape)
    scene = np.full(camera.scene, 0.2 * rng.integers(2)) * picture("brick", camera.scene)
    scene[camera.window] = picture(PICTURES[rng.integers(6)], shape)
    frame = camera.image_of(scene)[0] ** (0.8 if error == 2 else 1.0)
    frame = frame / frame.mean()
    frame = np.maximum(frame + noise * np.sqrt(np.maximum(frame, 0.01)) * rng.normal(size=shape), 0)
    lights = {
        "right": light,
        "turned": light[::-1, ::-1],
        "mirrored": light[:, ::-1],
        "moved": np.roll(light, [side // 4 for side in shape], (0, 1)),
        "another camera": light_of((kind + 1) % 3, shape, rng),
        "random": rng.random(shape),
    }
    return {name: np.ascontiguousarray(each / each.sum()) for name, each in lights.items()}, frame, noise


def main() -> None:
    """Print how many of each kind are flagged, by noise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(36)))
    parser.add_argument("--shape", type=int, nargs=2, default=[64, 80])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    shape, rows = (options.shape[0], options.shape[1]), list[dict[str, Any]]()
    counts: dict[tuple[str, float], list[int]] = defaultdict(lambda: [0, 0])
    for seed in options.seeds:
        lights, frame, noise = captured(seed, shape)
        for name, light in lights.items():
            camera = ShiftedLight(light, shape, precision=np.float32)
            found = find_fit(camera, frame[None].astype(np.float32), None)
            rows.append({"seed": seed, "noise": noise, "light": name, "fault": found.fault[0], **found.summary()})
            counts[name, noise][0] += bool(found.fault[0])
            counts[name, noise][1] += 1
        if options.json:
            options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    for (name, noise), (flagged, count) in sorted(counts.items()):
        print(f"{name}, noise {noise:.1%}: {flagged} of {count} flagged")


if __name__ == "__main__":
    main()
