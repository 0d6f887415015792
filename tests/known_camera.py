"""A camera behind a mask whose code is known, and captures of known pictures by it, in folders with their list."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mitsim.core.arrays import FloatArray
from mitsim.core.colour_files import RUN, ColourManifest, write_colours
from mitsim.core.exr import write_frame
from mitsim.core.manifests import Digital, Patterns, RunManifest, write_manifest
from mitsim.devices.patterns import parse_patterns

ROWS, COLUMNS, N = 64, 72, 20
SCALES = 0.78, 0.74
PLANES = {
    "BGGR": {"r": (0.5, 0.5), "gb": (0.0, 0.5), "gr": (0.5, 0.0), "b": (0.0, 0.0)},
    "RGGB": {"r": (0.0, 0.0), "gr": (0.0, 0.5), "gb": (0.5, 0.0), "b": (0.5, 0.5)},
}
"""Places of the planes of a mosaic, down and to the right, in pixels of a plane: written out, not worked out."""


def write_known(path: Path, runs: list[dict[str, str]], **more: Any) -> Path:
    """The list of ``runs``, with what ``more`` says, at ``path``."""
    path.write_text(json.dumps({"known": runs, **more}))
    return path


class KnownCamera:
    """Codes of random features of 3 pixels on either side, seen through shifts.

    Parameters
    ----------
    seed
        of code, pictures and noise.
    light
        electrons of a pixel in a frame of a white picture, in the mean.
    falloff
        part of its code that a side loses from its middle to the edges of the scene.
    """

    def __init__(self, seed: int = 1, light: float = 3e4, falloff: float = 0.0, seconds: float = 0.01) -> None:
        self.rng, self.exposure_s = np.random.default_rng(seed), seconds
        self.codes = [self._code(count + 1 + int(s * N) + 3) for count, s in zip((ROWS, COLUMNS), SCALES, strict=True)]
        self._falloff = 1 - falloff * np.linspace(-1, 1, N)
        left, right = self.factors()
        self._scale = float(np.sqrt(light / seconds / np.mean(np.outer(left.sum(axis=1), right.sum(axis=1)))))

    def _code(self, length: int) -> FloatArray:
        features = np.repeat(self.rng.integers(0, 2, length // 3 + 2), 3)[:length]
        return np.convolve(features, [0.25, 0.5, 0.25], "same") + 0.1

    def factors(self, offset: tuple[float, float] = (0.0, 0.0)) -> tuple[FloatArray, FloatArray]:
        """Phi_L (64, 20) and Phi_R (72, 20) of pixels at an ``offset`` [sqrt(electrons/s)]."""
        found = []
        for code, count, scale, place in zip(self.codes, (ROWS, COLUMNS), SCALES, offset, strict=True):
            at = np.arange(count)[:, None] + place + scale * np.arange(N)
            found.append(np.interp(at, np.arange(len(code)), code) * self._falloff * getattr(self, "_scale", 1.0))
        return found[0], found[1]

    def picture(self) -> FloatArray:
        """(20, 20) random numbers 0 to 1 that no two ways of holding it share; of a whole number of 255 parts."""
        return np.asarray(np.rint(255 * self.rng.random((N, N))) / 255)

    def write_run(
        self, folder: Path, scene: FloatArray, patterns: str = "uniform", offset: tuple[float, float] = (0.0, 0.0),
        turn: Any = lambda light: light, **digital: Any,
    ) -> Path:  # fmt: skip
        """The RUN folder of a ``scene`` under ``patterns``, lit so and then turned as it lies before the camera."""
        folder.mkdir(parents=True)
        prepare = digital.pop("prepare", {})
        family, (left, right) = parse_patterns(patterns, N), self.factors(offset)
        names = [f"frame_{index}.exr" for index in range(len(family.shots))]
        stated = {
            "exposure_s": self.exposure_s, "black_level_dn": 100.0, "gain_dn_per_e": 0.5, "dark_current_e_per_s": 0.0,
            "read_noise_e": 5.0, "step_dn": 1.0, "saturation_dn": 1e6, **digital,
        }  # fmt: skip
        for name, shot in zip(names, family.shots, strict=True):
            electrons = self.exposure_s * left @ turn(scene * family.light(shot)) @ right.T
            electrons = self.rng.poisson(electrons) + 5 * self.rng.standard_normal(electrons.shape)
            dn = np.rint(np.maximum(electrons * stated["gain_dn_per_e"] + 100, 0))
            write_frame(folder / name, {"DN": np.minimum(dn, stated["saturation_dn"]).astype(np.float32)}, {})
        manifest = RunManifest(
            status="complete", camera={"name": "known"}, digital=Digital(**stated), patterns=Patterns.of(family, names),
            configuration={"prepare": prepare} if prepare else {},
        )  # fmt: skip
        write_manifest(folder, manifest)
        return folder

    def write_planes(
        self, folder: Path, scene: FloatArray, mosaic: str = "BGGR", further: tuple[float, float] = (0.0, 0.0)
    ) -> Path:
        """The coloured RUN folder of all planes of a sensor behind a ``mosaic``, of a ``scene`` (20, 20, 3), by pixels
        that lie so much ``further`` down and to the right."""
        lengths = {"r": 600.0, "g": 540.0, "b": 460.0}
        for name, place in PLANES[mosaic].items():
            self.write_run(
                folder / name, scene[:, :, "rgb".index(name[0])], offset=(place[0] + further[0], place[1] + further[1]),
                prepare={"mosaic": mosaic, "channel": name},
            )  # fmt: skip
        lines = [{"name": name, "wavelength_nm": lengths[name[0]]} for name in PLANES[mosaic]]
        write_colours(folder, ColourManifest.model_validate({"kind": RUN, "channels": lines}))
        return folder

    def write_session(self, folder: Path, pictures: int, turn: Any = lambda scene: scene, **more: Any) -> Path:
        """The list of so many captures, each of a picture that lies before the camera as ``turn`` has it."""
        runs = []
        patterns = more.pop("patterns", "uniform")
        for number in range(pictures):
            picture = self.picture()
            self.write_run(folder / f"run_{number}", picture, patterns, turn=turn)
            Image.fromarray(np.rint(255 * picture).astype(np.uint8)).save(folder / f"picture_{number}.png")
            runs.append({"run": f"run_{number}", "picture": f"picture_{number}.png"})
        return write_known(folder / "known.json", runs, **more)


def factor_error(found: tuple[FloatArray, FloatArray], truth: tuple[FloatArray, FloatArray]) -> tuple[float, float]:
    """Relative errors of two factors, which are known up to (c Phi_L, Phi_R / c)."""
    c = float(np.vdot(found[0], truth[0]) / np.vdot(found[0], found[0]))
    scaled = found[0] * c, found[1] / c
    left, right = (float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in zip(scaled, truth, strict=True))
    return left, right
