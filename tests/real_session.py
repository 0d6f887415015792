"""A real calibration session as tests make it: digital numbers of a camera that mitsim has never seen, in a folder with
its list."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mitsim.core.exr import write_frame
from mitsim.devices.patterns import stripe_signs
from mitsim.devices.session import SIDES

DIGITAL = {
    "exposure_s": 0.02,
    "black_level_dn": 160,
    "gain_dn_per_e": 0.125,
    "dark_current_e_per_s": 4000,
    "read_noise_e": 10,
    "step_dn": 1,
    "saturation_dn": 4095,
}
ROWS, COLUMNS, N = 24, 20, 4


def write_image(path: Path, numbers: np.ndarray) -> None:
    """``numbers`` as a PNG or TIFF of 16 bits, as NPY or OpenEXR, or bare: the large byte first, or Mono12p."""
    if path.suffix == ".npy":
        np.save(path, numbers.astype(np.uint16))
    elif path.suffix == ".raw":
        numbers.astype(">u2").tofile(path)
    elif path.suffix == ".bin":
        bits = sum(int(number) << 12 * place for place, number in enumerate(numbers.ravel()))
        path.write_bytes(bits.to_bytes(numbers.size * 12 // 8, "little"))
    elif path.suffix == ".exr":
        write_frame(path, {"DN": numbers.astype(np.uint32)}, {})
    else:
        Image.fromarray(numbers.astype(np.uint16)).save(path)


def write_list(folder: Path, **changes: Any) -> None:
    """The list of a session of pairs, with ``changes``."""
    fields = {"camera": "bench 3", "n": N, "signed_capture": "pair", "digital": DIGITAL, **changes}
    (folder / "session.json").write_text(json.dumps(fields))


class RealSession:
    """Bench 3 of tests/system/test_real_camera.py, smaller, before a white board.

    Its frames are the paper's model with factors of its own, ``left`` (24, n) and ``right`` (20, n), with Poisson and
    read noise.
    """

    def __init__(self, seed: int = 1, scale: float = 280.0, n: int = N) -> None:
        rng = np.random.default_rng(seed)
        self.left, self.right = rng.random((ROWS, n)) * scale, rng.random((COLUMNS, n)) * scale
        self.n, self._rng, self._signs = n, rng, stripe_signs(n)

    def shown(self, mode: str) -> Iterator[tuple[str, int, int, np.ndarray]]:
        """Side, index, sign and light (n, n) of every frame, in order."""
        for side in SIDES:
            if mode == "uniform":
                yield side, 0, 0, np.ones((self.n, self.n))
            for index, column in enumerate(self._signs.T):
                lines = np.broadcast_to(column[:, None] if side == "horizontal" else column, (self.n, self.n))
                for sign in (1, -1) if mode == "pair" else (1,):
                    yield side, index, sign, (1 + sign * lines) / 2

    def frame(self, light: np.ndarray, exposure_s: float = DIGITAL["exposure_s"], offset: float = 0.0) -> np.ndarray:
        """What the camera reads out, with ``offset`` [DN] that its list does not know of."""
        rate = self.left @ light @ self.right.T + DIGITAL["dark_current_e_per_s"]
        electrons = self._rng.poisson(rate * exposure_s) + self._rng.normal(0, DIGITAL["read_noise_e"], rate.shape)
        return np.clip(np.rint(electrons * DIGITAL["gain_dn_per_e"] + DIGITAL["black_level_dn"] + offset), 0, 4095)

    def write(
        self, folder: Path, mode: str = "pair", name: Callable[[int], str] = "f_{}.png".format, offset: float = 0.0
    ) -> Path:
        """All frames in a new ``folder``, number by number, with a list that leaves their order to their names."""
        folder.mkdir()
        for number, (*_, light) in enumerate(self.shown(mode)):
            write_image(folder / name(number), self.frame(light, offset=offset))
        write_list(folder, n=self.n, signed_capture=mode)
        return folder
