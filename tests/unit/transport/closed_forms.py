"""What tests of the tracers share: a stock projector, an even radiance in closed form, and a mean with its error."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np


def stock_projector(
    n: int, scale: float, place: tuple[float, ...], turn: float = 0.0, canvas: np.ndarray | None = None, **more: Any
) -> Any:
    """A projector with an n x 2n canvas, the window in its right half; fov_axis x has tan 0.3 on either side."""
    if canvas is None:
        canvas = np.zeros((n, 2 * n))
        canvas[:, n:] = 1
    bitmap = mi.Bitmap(canvas[..., None].astype(np.float32))
    picture = {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "nearest", "wrap_mode": "clamp"}
    to_world = mi.ScalarAffineTransform4f().translate(list(place)).rotate([0, 1, 0], turn)
    light = {"type": "projector", "to_world": to_world, "fov_axis": "x", "fov": 33.398488, "scale": scale}
    return mi.load_dict({**light, "irradiance": picture, **more})


def seen(stop: float) -> float:
    """Integral of (1 + t^2)^-2 over |t_x|, |t_y| < stop: the irradiance of an even radiance of 1."""
    node, weight = np.polynomial.legendre.leggauss(12)
    t, w = stop * node, stop * weight
    return float(w @ (1 + np.square(t)[:, None] + np.square(t)[None, :]) ** -2 @ w)


def mean(values: np.ndarray) -> tuple[float, float]:
    """Mean of independent values and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def in_child(module: str, folder: Path, *words: str) -> Any:
    """What ``traced`` of a module returns in a child process, because a process keeps its variant."""
    program = f"import json, sys; from {module} import traced; print(json.dumps(traced(*sys.argv[1:]), default=float))"
    command, root = [sys.executable, "-c", program, str(folder), *words], Path(__file__).parents[3]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, cwd=root, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])
