"""A run and its calibration on disk, of a made-up camera of which nothing is square: what exchange is tested with."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.manifests import (
    AmbientFile,
    CalibrationManifest,
    ClosingFile,
    Digital,
    Patterns,
    RunHead,
    RunManifest,
    ShotFile,
)
from mitsim.core.runs import AMBIENT, CLOSING, claim_run, frame_name
from mitsim.reconstruct.factors import Factors, load_calibration
from mitsim.reconstruct.solver import Status, Verdict

ROWS, COLUMNS = 40, 52
SCENE = 10, 14
"""Projector pixels: rows, columns."""
DIGITAL = Digital(
    exposure_s=0.0213, gain_dn_per_e=0.37, black_level_dn=160.0, dark_current_e_per_s=600.0, read_noise_e=3.0
)
CAMERA = {"name": "bench 3", "well": 12000.5}
CASES: dict[str, dict[str, Any]] = {"dots": {}, **{name: {name: True} for name in ("signed", "real_output", "ambient")}}
CASES["closing"] = {"closing": "uniform"}
"""Kinds of runs, as arguments of :func:`made`."""


@dataclass(frozen=True)
class Made:
    """Folders of a run and of a calibration that fits, and the scene that they show."""

    run: Path
    calibration: Path
    scene: np.ndarray


def stripes(pixels: int, period: int, signed: bool) -> np.ndarray:
    """(pixels, period) of 0/1, or (pixels, 2) of +-1."""
    columns = np.array([[1, 1], [1, -1]]) if signed else np.eye(period, dtype=int)
    return columns[np.arange(pixels) % len(columns)]


def made(
    folder: Path,
    signed: bool = False,
    ambient: bool = False,
    real_output: bool = False,
    scale: float = 1.0,
    closing: str = "",
) -> Made:
    """Frames of a separable camera with noise, recorded as `mitsim capture` does, with truth and expected electrons;
    its factors times ``scale``. A frame that is ``closing`` is exposed as the others."""
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(17)
    left, right = (rng.random((side, n)) * 300 * scale for side, n in zip((ROWS, COLUMNS), SCENE, strict=True))
    scene = rng.random(SCENE)
    manifest = CalibrationManifest(camera=CAMERA, board_reflectance=0.99, digital=DIGITAL)
    known = Factors(
        *(side.astype(np.float32).astype(np.float64) for side in (left, right)),
        manifest,
        Status(Verdict.CALIBRATED, "Fit"),
    )
    p_left, p_right = stripes(SCENE[0], 2, signed), stripes(SCENE[1], 3, signed)
    signs = (-1, 1) if signed else (0,)
    shots = [(i, j, sign) for i in range(p_left.shape[1]) for j in range(p_right.shape[1]) for sign in signs]
    head = RunHead.of({"scene": "none", "seed": 3})
    lamp = rng.random((ROWS, COLUMNS)) * 1e4 if ambient else np.zeros((ROWS, COLUMNS))
    kind = np.float32 if real_output else np.uint32

    def exposed(light: np.ndarray) -> dict[str, np.ndarray]:
        """Channels of a shot with so many electrons a second."""
        electrons = (light + lamp + DIGITAL.dark_current_e_per_s) * DIGITAL.exposure_s
        dn = (rng.poisson(electrons) + rng.normal(0, 3, light.shape)) * DIGITAL.gain_dn_per_e + DIGITAL.black_level_dn
        digital = dn if real_output else np.rint(np.maximum(dn, 0))
        return {"DN": digital.astype(kind), "electrons": electrons.astype(np.float32)}

    with claim_run(folder / "run", head, resume=False) as run:
        run.begin()
        run.write_truth(scene, 0.99, np.full(SCENE, 2e-3))
        for index, (i, j, sign) in enumerate(shots):
            pattern = np.outer(p_left[:, i], p_right[:, j])
            light = left @ (scene * ((1 + sign * pattern) / 2 if sign else pattern)) @ right.T
            metadata = {"row": i, "column": j, "sign": sign, "exposure_s": DIGITAL.exposure_s, "seed": 3}
            run.write_frame(index, exposed(light), metadata)
        if ambient:
            mean = np.mean([exposed(0 * lamp)["DN"] for _ in range(5)], axis=0)
            run.write(AMBIENT, {"DN": mean.astype(np.float32)}, {"shots": 5, "seed": 3})
        if closing:
            lit = np.outer(p_left[:, 0], p_right[:, 0]) if closing == "first" else np.ones(SCENE)
            lit = (1 + signs[0] * lit) / 2 if closing == "first" and signed else lit
            run.write(CLOSING, exposed(left @ (scene * lit) @ right.T), {"exposure_s": DIGITAL.exposure_s})
        captures = tuple(
            ShotFile(file=frame_name(index), row=i, column=j, sign=sign) for index, (i, j, sign) in enumerate(shots)
        )
        patterns = Patterns(n=SCENE[0], P_L=p_left.tolist(), P_R=p_right.tolist(), captures=captures)
        run.finish(
            RunManifest(
                configuration=head.configuration,
                configuration_sha256=head.configuration_sha256,
                camera=CAMERA,
                digital=DIGITAL,
                patterns=patterns,
                ambient_frame=AmbientFile(file=AMBIENT, shots=5) if ambient else None,
                closing_frame=ClosingFile(kind=closing, file=CLOSING, exposure_s=DIGITAL.exposure_s)
                if closing
                else None,
                plan={"effects": [], "wert": "ä"},
                mc_error=0.1 + 0.2,
            )
        )
    known.save(folder / "cal")
    assert np.array_equal(load_calibration(folder / "cal").left, known.left)
    return Made(folder / "run", folder / "cal", scene)


def bytes_of(folder: Path) -> dict[str, bytes]:
    """All files of a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def frame_of(path: Path, pattern: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the function of this name in docs/exchange.md makes of a file of `mitsim transport` and a ``pattern``."""
    page = (Path(__file__).parents[1] / "docs" / "exchange.md").read_text(encoding="utf-8")
    (lines,) = (block for block in re.findall(r"^```python\n(.*?)^```", page, re.M | re.S) if "def frame_of" in block)
    names: dict[str, Any] = {}
    exec(lines.split("\nwith h5py")[0], names)
    frame, error = names["frame_of"](path, pattern)
    return frame, error
